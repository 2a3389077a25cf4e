"""Death at any moment: at every operation on files, and by SIGKILL or Ctrl-C at random. A normal
start then ends in the same bytes, and nothing is left over."""

import json
import os
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from conftest import IDENTIFIED

from hostile.processes import (
    DIED,
    alive,
    difference,
    ended,
    execute,
    fork,
    performed,
    restore,
    tree,
)
from hostile.specimens import cells, csv_text, dataset, make, run
from hostile.trial import Tally, count, random
from torchsoft.cli import main

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]

Lines = Callable[[str], Tally]

# at every operation on files
# ----------------------------------------------------------------------


def crash(
    line: Tally, function: Callable[[], Any], out: Path, number: int, begin: Path = Path("none")
) -> None:
    """Die at `number` of the function's operations on `out`, or at all if there are fewer, begun
    from the folder `begin`; each time the function done again must leave what it leaves
    undisturbed."""
    out.parent.mkdir(exist_ok=True)
    restore(out, begin)
    status, operations = performed(function, out.parent)
    assert status == 0
    assert operations
    expected, seen = tree(out.parent), Counter[str]()
    for point in random(line.kind).permutation(len(operations))[: count(number)].tolist():
        restore(out, begin)
        seen[operations[point]] += 1
        status, _ = performed(function, out.parent, point)

        def again(status: int = status) -> None:
            assert status == DIED
            function()
            assert not (wrong := difference(out.parent, expected)), wrong

        line.call(f"died at {point} of {len(operations)}, {operations[point]}", again, ())
    kinds = {"open", "os.fsync", "os.rename", "half a write"}
    assert count(number) < 50 or kinds <= seen.keys(), seen


@pytest.mark.parametrize(("begun", "number"), [("nothing", 270), ("half", 200)])
def test_generation(begun, number, memory, tally):
    """From an empty place; and from a folder in which one shard of two is finished and the other
    half written."""
    generate = partial(make, dataset(memory), memory / "place" / "set")
    place, begin = memory / "place", memory / "begin"
    if begun == "half":
        place.mkdir()
        _, operations = performed(generate, place)
        restore(place / "set", begin)
        assert performed(generate, place, len(operations) * 9 // 10)[0] == DIED
        restore(begin, place / "set")
        assert [p.name for p in (begin / "finished").glob("*.sha256")] == ["0.sha256"]
    line = tally(f"crash points of a generation begun from {begun}")
    crash(line, generate, place / "set", number, begin)
    make(dataset(memory), memory / "whole")
    assert difference(place / "set", tree(memory / "whole")) == ""


def test_a_trajectory_file(memory, tally):
    """New, and written over."""
    ran, out = run(), memory / "place" / "out"
    shifted = replace(ran, channels=ran.channels | {"effort_x": ran.channels["effort_x"] + 1.0})
    shifted.save(memory / "old" / "run.nc")
    for begin in ("none", "old"):
        line = tally(f"crash points of a trajectory file, over {begin}")
        crash(line, lambda: ran.save(out / "run.nc"), out, 30, memory / begin)


# at random moments
# ----------------------------------------------------------------------


class Work(NamedTuple):
    """A process that works into a folder: how it begins, how far it came, and what it leaves."""

    begin: Callable[[Path], int]
    progress: Callable[[Path], int]
    result: Callable[[Path], Any]


def generation(folder: Path, workers: int = 0) -> Work:
    """In a fork, or by the command with its worker processes."""
    small = dataset(folder, 16 if workers else 3)
    command = "-m", "data_gen.generate", str(small), "--workers", str(workers), "--out"
    begin = lambda out: fork(lambda: execute(*command, str(out)) if workers else make(small, out))
    return Work(begin, lambda out: sum(1 for _ in out.rglob("*")), tree)


def identification(folder: Path, workers: int) -> Work:
    for name, rows in (("data", 42), ("more", 32)):
        (folder / f"{name}.csv").write_text(csv_text(cells(rows)), encoding="utf-8")
    (folder / "rig.toml").write_text(IDENTIFIED, encoding="utf-8")
    files = [str(folder / name) for name in ("data.csv", "more.csv", "rig.toml")]
    how = ["--workers", str(workers), "--no-progress"]

    def command(out: Path) -> int:
        sys.stdout = sys.stderr = out.with_suffix(".txt").open("w", encoding="utf-8")
        # test runners may ignore it, which a child inherits
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return main(["identify", *files, "--out", str(out), *how])

    def answer(out: Path) -> Any:
        """Without times, numbers of remembered runs, the command, and the checksum of all that."""
        content = json.loads((out / "answer.json").read_text(encoding="utf-8"))
        for entry in (content, content["cost"], *content["stages"]):
            for key in ("checksum", "command", "wall_s", "remembered"):
                entry.pop(key, None)
        return content, sorted(path.name for path in out.iterdir())

    runs = lambda out: len(list(out.glob("unfinished/*.run")))
    return Work(lambda out: fork(lambda: command(out), 300), runs, answer)


def survivors(group: int) -> bool:
    """Whether any process of a group is left, half a minute after its end at the latest."""
    with suppress(ProcessLookupError):
        for _ in range(300):
            os.killpg(group, 0)
            time.sleep(0.1)
        return True
    return False


STOPS: dict[str, tuple[Callable[[Path], Work], int, signal.Signals, int]] = {
    "generations": (generation, 1, signal.SIGKILL, 40),
    "one of two generations at once": (generation, 2, signal.SIGKILL, 14),
    "commands with two workers": (partial(generation, workers=2), 1, signal.SIGKILL, 8),
    "identifications in two threads": (partial(identification, workers=2), 1, signal.SIGKILL, 10),
    "interrupted in two threads": (partial(identification, workers=2), 1, signal.SIGINT, 6),
}
"""The work, how many work on one folder at once, the signal that ends one, and how often."""


@pytest.mark.parametrize("stops", STOPS)
def test_stopped_it_ends_the_same(stops, memory, tally):
    """Stopped up to three times at any moment, or soon after it went on, and then started again.
    Nothing that it began outlives it; interrupted it says in one line how to go on, and keeps what
    was done."""
    make_work, at_once, sign, number = STOPS[stops]
    work, line, rng = make_work(memory), tally(f"stopped: {stops}"), random(stops)
    for out in (memory / "first", memory / "whole"):  # kernels are compiled once
        began = time.monotonic()
        assert ended(work.begin(out)) == 0
    seconds, expected = time.monotonic() - began, work.result(memory / "whole")
    stopped = trial = 0
    while stopped < count(number):
        trial += 1
        assert trial < 10 * count(number), "most end before they are stopped"
        out = memory / f"out-{trial}"
        for _ in range(int(rng.integers(1, 4))):
            pids, soon = [work.begin(out)], rng.random() < 0.6 or sign == signal.SIGINT
            if at_once > 1:
                time.sleep(rng.uniform(0, 0.1))
                pids.append(work.begin(out))
            pid, before = pids.pop(rng.integers(at_once)), work.progress(out)
            while soon and alive(pid) and work.progress(out) == before:
                time.sleep(0.002)
            time.sleep(rng.uniform(0, min(seconds, 0.3) if soon else seconds))
            kept = work.progress(out)
            if alive(pid):
                os.kill(pid, sign)
            status, others = ended(pid), [*map(ended, pids)]
            held = not any(others) and not survivors(pid)
            if status == 130 and sign == signal.SIGINT:
                said = out.with_suffix(".txt").read_text(encoding="utf-8")
                told = "the same command continues" in said and "Traceback" not in said
                held = held and told and work.progress(out) >= kept
            else:
                held = held and status in (0, -signal.SIGKILL)
            stopped += status != 0
            line.held(held, f"{trial}: {status}, others {others}, {kept} kept")
        status = ended(work.begin(out))
        same = status == 0 and work.result(out) == expected
        line.held(same, f"{trial}: the last start ended with {status}, or left something else")
        shutil.rmtree(out)
