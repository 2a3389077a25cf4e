"""Death at any moment: at every operation on files, and by SIGKILL or Ctrl-C at random. A normal
start then ends in the same bytes, and nothing is left over."""

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from conftest import IDENTIFIED

from hostile.processes import DIED, alive, difference, ended, execute, fork, performed, tree
from hostile.specimens import cells, csv_text, dataset, make, run
from hostile.trial import count, random
from torchsoft.cli import main

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]

# at every operation on files
# ----------------------------------------------------------------------


def generated(folder: Path) -> Callable[[Path], object]:
    return lambda place: make(dataset(folder), place / "set")


def saved(folder: Path) -> Callable[[Path], object]:
    ran = run()
    return lambda place: ran.save(place / "run.nc")


@pytest.mark.parametrize(("work", "number"), [(generated, 300), (saved, 30)])
def test_dead_at_any_operation_it_ends_the_same(work, number, memory, tally):
    """Dead twice, at one of all operations on files and in what goes on from there."""
    place, rng = memory / "place", random(work.__name__)
    function = partial(work(memory), place)
    status, operations = performed(function, place)
    assert status == 0
    assert {"open", "os.rename", "half a write"} <= {*operations}
    expected, last = tree(place), len(operations) - 1
    for first in rng.permutation(len(operations))[: count(number)].tolist():
        shutil.rmtree(place)
        assert performed(function, place, first)[0] == DIED
        second = int(rng.integers(last + 1))
        assert performed(function, place, second)[0] in (DIED, 0)
        function()
        wrong = difference(place, expected)
        tally.held(not wrong, f"died at {first} and {second} of {last}: {wrong}")


# at random moments
# ----------------------------------------------------------------------


class Work(NamedTuple):
    """A process that works into a folder: how it starts, how far it came, and what it leaves."""

    start: Callable[[Path], int]
    progress: Callable[[Path], int]
    result: Callable[[Path], Any]


def generation(folder: Path, workers: int = 0) -> Work:
    """In a fork, or by the command with its worker processes."""
    small = dataset(folder, 16 if workers else 3)
    command = "-m", "data_gen.generate", str(small), "--workers", str(workers), "--out"
    start = lambda out: fork(lambda: execute(*command, str(out)) if workers else make(small, out))
    return Work(start, lambda out: sum(1 for _ in out.rglob("*")), tree)


def identification(folder: Path) -> Work:
    """By the command, in two threads."""
    for name, rows in (("data", 42), ("more", 32)):
        (folder / f"{name}.csv").write_text(csv_text(cells(rows)), encoding="utf-8")
    (folder / "rig.toml").write_text(IDENTIFIED, encoding="utf-8")
    files = [str(folder / name) for name in ("data.csv", "more.csv", "rig.toml")]

    def command(out: Path) -> int:
        sys.stdout = sys.stderr = out.with_suffix(".txt").open("w", encoding="utf-8")
        # test runners may ignore it, which a child inherits
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return main(["identify", *files, "--out", str(out), "--workers", "2", "--no-progress"])

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


def interrupted(out: Path) -> bool:
    """Whether a command said in one line how to go on."""
    text = out.with_suffix(".txt").read_text(encoding="utf-8")
    return "the same command continues" in text and "Traceback" not in text


STOPS: dict[str, tuple[Callable[[Path], Work], int, signal.Signals, int]] = {
    "generations": (generation, 1, signal.SIGKILL, 40),
    "one of two generations at once": (generation, 2, signal.SIGKILL, 14),
    "commands with two workers": (partial(generation, workers=2), 1, signal.SIGKILL, 8),
    "identifications": (identification, 1, signal.SIGKILL, 10),
    "interrupted identifications": (identification, 1, signal.SIGINT, 6),
}
"""The work, how many work on one folder at once, the signal that ends one, and how often."""


@pytest.mark.parametrize("stops", STOPS)
def test_stopped_at_any_moment_it_ends_the_same(stops, memory, tally):
    """Stopped up to three times, at any moment or soon after it went on, and then started again.
    Nothing that it started outlives it; an interruption keeps what was done."""
    make_work, at_once, sign, number = STOPS[stops]
    work, rng = make_work(memory), random(stops)
    for out in (memory / "first", memory / "whole"):  # kernels are compiled once
        since = time.monotonic()
        assert ended(work.start(out)) == 0
    seconds, expected = time.monotonic() - since, work.result(memory / "whole")
    stopped = trial = 0
    while stopped < count(number):
        trial += 1
        assert trial < 10 * count(number), "most end before they are stopped"
        out = memory / f"out-{trial}"
        for _ in range(int(rng.integers(1, 4))):
            pids, soon = [work.start(out)], rng.random() < 0.6 or sign == signal.SIGINT
            if at_once > 1:
                time.sleep(rng.uniform(0, 0.1))
                pids.append(work.start(out))
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
                held = held and interrupted(out) and work.progress(out) >= kept
            else:
                held = held and status in (0, -signal.SIGKILL)
            stopped += status != 0
            tally.held(held, f"{trial}: {status}, others {others}, {kept} kept")
        status = ended(work.start(out))
        same = status == 0 and work.result(out) == expected
        tally.held(same, f"{trial}: the last start ended with {status}, or left something else")
        shutil.rmtree(out)
