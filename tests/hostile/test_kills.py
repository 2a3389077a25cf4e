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
from unittest import mock

import dask
import pytest
from matplotlib.figure import Figure

from hostile.processes import (
    DIED,
    alive,
    difference,
    ended,
    execute,
    fork,
    kernels,
    kill,
    memory,
    performed,
    restore,
    start,
    tree,
)
from hostile.specimens import IDENTIFICATION, cells, csv_text, dataset, make, problem, run
from hostile.trial import Tally, count, random
from torchsoft.cli import main
from torchsoft.datasets import check
from torchsoft.solve.kernel import cache
from torchsoft.sysid import identify
from torchsoft.sysid import report as page

__all__ = ["memory"]
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
def test_generation(begun: str, number: int, memory: Path, tally: Lines) -> None:
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
        assert sorted(p.name for p in (begin / "finished").iterdir()) == ["0.sha256"]
    line = tally(f"crash points of a generation begun from {begun}")
    crash(line, generate, place / "set", number, begin)
    make(dataset(memory), memory / "whole")
    assert difference(place / "set", tree(memory / "whole")) == ""


def test_results(memory: Path, tally: Lines) -> None:
    """The picture of a check, trajectory files, new and written over, and the answer and the page
    of an identification."""
    make(dataset(memory), memory / "set")
    out, ran, recorded = memory / "place" / "out", run(), problem()
    result = identify(recorded, rtol=1e-3)
    text = page.page(result, *page.traces(result, recorded, None))
    shifted = replace(ran, channels=ran.channels | {"F_x": ran.channels["F_x"] + 1.0})
    shifted.save(memory / "old" / "run.nc")
    picture = ["--picture", str(out / "coverage.png")]

    def report() -> None:
        result.save(out / "answer.json")
        page.report(result, recorded, out / "report.html")

    with (
        dask.config.set(scheduler="synchronous"),  # whose threads would be missing after a fork
        mock.patch.object(check, "figure", return_value=Figure(figsize=(1, 1))),  # is drawn slowly
        mock.patch.object(page, "page", return_value=text),
        mock.patch.object(page, "traces", return_value=([], {})),
    ):
        checked = lambda: check.main([str(memory / "set"), *picture])
        crash(tally("crash points of a check"), checked, out, 20)
        crash(tally("crash points of an identification's results"), report, out, 60)
        for begin in ("none", "old"):
            line = tally(f"crash points of a trajectory file, over {begin}")
            crash(line, lambda: ran.save(out / "run.nc"), out, 30, memory / begin)


# generations
# ----------------------------------------------------------------------


@pytest.mark.parametrize(("generators", "number"), [(1, 40), (2, 14)])
def test_killed_generations(generators: int, number: int, memory: Path, tally: Lines) -> None:
    """Killed up to three times and then started again; or two at once on one folder, of which one
    is killed and the other ends well."""
    small, out = dataset(memory), memory / "set"
    line = tally(f"kills of one of {generators} generators at once")
    make(small, memory / "whole")
    expected, begun = tree(memory / "whole"), time.perf_counter()
    generate = partial(fork, partial(make, small, out))
    ended(generate())
    longest, trial = time.perf_counter() - begun, 0
    while line.tried < count(number):
        trial += 1
        assert trial < 10 * count(number), "most end before they are killed"
        rng, killed, statuses = random(line.kind, trial), 0, []
        shutil.rmtree(out, ignore_errors=True)
        for moment in rng.uniform(0, longest, rng.integers(1, 4) if generators == 1 else 1):
            pids = [generate()]
            while len(pids) < generators:
                time.sleep(rng.uniform(0, 0.1))
                pids.append(generate())
            time.sleep(moment)
            killed += kill(pids.pop(rng.integers(len(pids))))
            statuses += map(ended, pids)
        make(small, out)
        wrong = difference(out, expected)
        for _ in range(killed):
            held = not wrong and not any(statuses)
            line.held(held, f"{trial}: others ended with {statuses}; differs in {wrong}")


@pytest.mark.parametrize("workers", [1, 2])
def test_killed_commands(workers: int, memory: Path, tally: Lines) -> None:
    """The command with its worker processes, killed again and again on one folder, most times soon
    after it wrote something."""
    line, out = tally(f"kills of the command with {workers} workers"), memory / "set"
    small, rng, killed = dataset(memory, 16), random("commands", workers), 0
    command = "-m", "data_gen.generate", str(small), "--out", str(out), "--workers", str(workers)
    written = lambda: sum(1 for _ in out.rglob("*"))
    for trial in range(count(8)):
        before, pid = written(), fork(lambda: execute(*command))
        while trial % 4 and written() == before and alive(pid):
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.3 if trial % 4 else 5.0))
        killed += kill(pid)
    status, _, err = start(*command)
    make(small, memory / "whole")
    wrong = difference(out, tree(memory / "whole"))
    assert killed
    for _ in range(killed):
        line.held(status == 0 and not wrong, f"{status} {err[-500:]}; differs in {wrong}")


# identifications
# ----------------------------------------------------------------------


class Case(NamedTuple):
    """Folder of the data, number of workers, and of an undisturbed command the answer and the time
    it took [s]."""

    folder: Path
    workers: int
    answer: dict[str, Any]
    seconds: float

    def begin(self, out: Path) -> int:
        """The id of a process of the command."""
        files = [str(self.folder / name) for name in ("data.csv", "more.csv", "rig.toml")]
        how = ["--out", str(out), "--workers", str(self.workers), "--no-progress"]

        def command() -> int:
            sys.stdout = sys.stderr = out.with_suffix(".txt").open("w", encoding="utf-8")
            # test runners may ignore it, which a child inherits
            signal.signal(signal.SIGINT, signal.default_int_handler)
            return main(["identify", *files, *how])

        return fork(command, 300)


def answer(out: Path) -> dict[str, Any]:
    """The answer without times, numbers of remembered runs, the command with its folder, and the
    checksum of all that."""
    content = json.loads((out / "answer.json").read_text(encoding="utf-8"))
    for entry in (content, content["cost"], *content["stages"]):
        for key in ("checksum", "command", "wall_s", "remembered"):
            entry.pop(key, None)
    return content


def runs(out: Path) -> int:
    return len(list(out.glob("unfinished/*.run")))


def survivors(group: int) -> bool:
    """Whether any process of a group is left, half a minute after its end at the latest."""
    with suppress(ProcessLookupError):
        for _ in range(300):
            os.killpg(group, 0)
            time.sleep(0.1)
        return True
    return False


@pytest.fixture(scope="module", params=[1, 2], ids=["alone", "two workers"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("kills")
    for name, rows in (("data", 42), ("more", 32)):
        (folder / f"{name}.csv").write_text(csv_text(cells(rows)), encoding="utf-8")
    (folder / "rig.toml").write_text(IDENTIFICATION, encoding="utf-8")
    case = Case(folder, request.param, {}, 0.0)
    for out in (folder / "first", folder / "second"):  # kernels are compiled once
        began = time.monotonic()
        assert ended(case.begin(out)) == 0, out.with_suffix(".txt").read_text()
    return case._replace(answer=answer(out), seconds=time.monotonic() - began)


def wait(pid: int, out: Path, seconds: float, more: int) -> None:
    """Until so many seconds have passed, and so many more runs are kept, or the process has
    ended."""
    before, began = runs(out), time.monotonic()
    while alive(pid) and (time.monotonic() - began < seconds or runs(out) < before + more):
        time.sleep(0.002)


@pytest.mark.parametrize(
    ("sign", "number"), [(signal.SIGKILL, (20, 10)), (signal.SIGINT, (6, 3))], ids=["kill", "int"]
)
def test_stopped_it_ends_the_same(
    sign: signal.Signals, number: tuple[int, int], whole: Case, tally: Lines
) -> None:
    """Nothing that it began outlives it; interrupted it says in one line how to go on, and keeps
    what was done."""
    line = tally(f"identifications stopped by {sign.name}, {whole.workers} workers, and answers")
    rng, interrupted = random(line.kind), sign == signal.SIGINT
    while line.tried < count(number[whole.workers - 1]):
        out = whole.folder / f"out-{sign.name}-{line.tried}"
        for _ in range(int(rng.integers(1, 6))):
            pid, some = whole.begin(out), int(rng.integers(1, 16))
            moment = (whole.seconds * rng.random(), 0) if rng.integers(2) else (0.0, some)
            wait(pid, out, *moment)
            wait(pid, out, 0.02 * rng.random(), int(interrupted))
            kept, running = runs(out), alive(pid)
            if running:
                os.kill(pid, sign)
            status, said = ended(pid), out.with_suffix(".txt").read_text(encoding="utf-8")
            told = "the same command continues" in said and "Traceback" not in said
            right = runs(out) >= kept and status == 130 and told if interrupted else True
            held = (right or status == 0) and not survivors(pid)
            line.held(held, f"{status}, {kept} of {runs(out)} runs: {said[-1000:]}")
            if not running:
                break
        status = ended(whole.begin(out))
        left = {path.name for path in out.iterdir()} - {"answer.json", "report.html"}
        held = status == 0 and not left and answer(out) == whole.answer
        line.held(held, f"after the last start: {status}, another answer, or left: {left}")


# kernels
# ----------------------------------------------------------------------


def test_many_at_one_cache(tmp_path: Path, tally: Lines, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes that compile at once, some of them killed at it: every other has what it needs, and
    nothing is left."""
    line, folder = tally("processes at one cache, a third of them killed"), tmp_path / "kernels"
    monkeypatch.setattr(cache, "FOLDERS", [folder])
    monkeypatch.setattr(cache, "announce", lambda: None)
    monkeypatch.setattr(cache, "_said", set())
    wrong = lambda: int(kernels()(3.0, 4.0) != 25.0)
    for number in range(count(20)):
        pids = [fork(wrong) for _ in range(6)]
        time.sleep(0.4 * random("cache", number).random())
        for pid in pids[::3]:
            os.kill(pid, signal.SIGKILL)
        for k, status in enumerate(map(ended, pids)):
            line.held(status == 0 or (k % 3 == 0 and status == -signal.SIGKILL), f"{status}")
        line.held(not wrong(), f"{number}: wrong")
        if number % 4 == 3:
            for path in folder.glob("*.kernel"):
                path.unlink()
            line.held(not wrong() and not list(folder.glob("*.partial")), f"{number}: left over")
            shutil.rmtree(folder)
