"""Every operation on files is once the last thing that a process does; then a normal start ends in
the same bytes."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from hostile.crash import die_at, points
from hostile.small import DIED, config, difference, in_memory, make, restore, tree
from hostile.trial import Tally
from torchsoft import Parameters, simulate
from torchsoft.datasets import check
from torchsoft.excitation import Excitation, Strokes
from torchsoft.paper.equilibrium import rest
from torchsoft.paper.rig import SoftGrasp
from torchsoft.sysid import Problem, Sensor, Unknown, identify, record
from torchsoft.sysid import report as page

pytestmark = pytest.mark.slow


@pytest.fixture
def tmp_path(tmp_path: Path) -> Iterator[Path]:
    yield from in_memory(tmp_path)


def crash(
    line: Tally,
    function: Callable[[], Any],
    out: Path,
    begin: Path,
    number: int,
    rng: np.random.Generator,
) -> None:
    """Die at `number` of the function's operations on `out`, or at all if there are fewer, begun
    from the folder `begin`; each time the function done again must leave what it leaves
    undisturbed."""
    restore(out, begin)
    operations = points(function, out.parent)
    assert operations
    expected = tree(out.parent)
    where = np.sort(rng.permutation(len(operations))[:number])
    seen: Counter[str] = Counter()
    for point in where.tolist():
        restore(out, begin)
        what = f"died at operation {point} of {len(operations)}, {operations[point]}"
        seen[operations[point]] += 1
        if (status := die_at(point, function, out.parent)) != DIED:
            line.held(False, f"{what}: it did not die there, but ended with {status}")
            continue
        try:
            function()
        except Exception as error:
            line.held(False, f"{what}: the next start raised {error!r}")
            continue
        wrong = difference(out.parent, expected)
        line.held(not wrong, f"{what}: after the next start not as it was: {wrong}")
    kinds = {"open", "os.fsync", "os.rename", "half a write"}
    assert number < 50 or kinds <= seen.keys(), seen


@pytest.mark.parametrize(("begun", "number"), [("nothing", 270), ("half", 200)])
def test_generation(
    begun: str,
    number: int,
    tmp_path: Path,
    tally: Callable[[str], Tally],
    random: Any,
    count: Callable[[int], int],
) -> None:
    """From an empty place; and from a folder in which one shard of two is finished and the other
    half written."""
    small, _ = config(tmp_path)
    place = tmp_path / "place"
    place.mkdir()
    make(small, tmp_path / "whole")
    begin = tmp_path / "begin"
    if begun == "half":
        operations = points(lambda: make(small, place / "set"), place)
        restore(place / "set", begin)
        assert die_at(len(operations) * 9 // 10, lambda: make(small, place / "set"), place) == DIED
        restore(begin, place / "set")
        assert sorted(p.name for p in (begin / "finished").iterdir()) == ["0.sha256"]
    line = tally(f"crash points of a generation begun from {begun}")
    crash(
        line,
        lambda: make(small, place / "set"),
        place / "set",
        begin,
        count(number),
        random(200, number),
    )
    assert difference(place / "set", tree(tmp_path / "whole")) == ""


def test_check(
    tmp_path: Path,
    tally: Callable[[str], Tally],
    random: Any,
    count: Callable[[int], int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Which writes nothing but its picture; here an empty one, as drawing takes long."""
    small, _ = config(tmp_path)
    make(small, tmp_path / "set")
    place = tmp_path / "place"
    place.mkdir()
    monkeypatch.setattr(check, "figure", lambda *_: Figure(figsize=(1, 1)))
    line = tally("crash points of a check")
    command = [str(tmp_path / "set"), "--picture", str(place / "out" / "coverage.png")]
    with dask.config.set(scheduler="synchronous"):  # whose threads would be missing after a fork
        crash(
            line,
            lambda: check.main(command),
            place / "out",
            tmp_path / "none",
            count(20),
            random(201),
        )


def test_trajectory_files(
    tmp_path: Path, tally: Callable[[str], Tally], random: Any, count: Callable[[int], int]
) -> None:
    model = SoftGrasp(
        Parameters().override({"pad.elements_x": 40, "pad.elements_y": 1, "contact.v_s": 0.05})
    )
    run = simulate(
        model, torch.linspace(0, 0.05, 11, dtype=torch.float64), y0=rest(model).detach(), step=5e-3
    )
    (tmp_path / "place").mkdir()
    out = tmp_path / "place" / "out"
    crash(
        tally("crash points of a trajectory file, new"),
        lambda: run.save(out / "run.nc"),
        out,
        tmp_path / "none",
        count(30),
        random(202),
    )
    other = replace(run, channels=run.channels | {"F_x": run.channels["F_x"] + 1.0})
    other.save(tmp_path / "old" / "run.nc")
    crash(
        tally("crash points of a trajectory file, written over"),
        lambda: run.save(out / "run.nc"),
        out,
        tmp_path / "old",
        count(30),
        random(203),
    )


def test_results_of_an_identification(
    tmp_path: Path,
    tally: Callable[[str], Tally],
    random: Any,
    count: Callable[[int], int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its answer, and its page."""
    p = Parameters().override({"contact.v_s": 0.05, "pad.elements_x": 40, "pad.elements_y": 1})
    sensors = {"theta": Sensor(noise=5e-4), "F_y": Sensor(noise=0.1)}
    grasp = Excitation(
        motion=Strokes(), duration=0.25, depth=1.2e-3, senses="bracket", grasp_time=0.15
    )
    recordings = [
        record("grasp", grasp, p.override({"pad.E": 0.9e6}), p, sensors, rtol=1e-3, seed=1)
    ]
    problem = Problem(recordings, sensors, {"pad.E": Unknown()})
    result = identify(problem, rtol=1e-3)
    text = page.page(result, *page.traces(result, problem, None))
    monkeypatch.setattr(page, "page", lambda *_: text)  # drawn once
    monkeypatch.setattr(page, "traces", lambda *_: ([], {}))
    (tmp_path / "place").mkdir()
    out = tmp_path / "place" / "out"

    def write() -> None:
        result.save(out / "answer.json")
        page.report(result, problem, out / "report.html")

    crash(
        tally("crash points of an identification's results"),
        write,
        out,
        tmp_path / "none",
        count(60),
        random(204),
    )
