"""The journal of an identification: data with checksums, to the bit, in a folder of its own."""

import struct
import threading
import time
from copy import deepcopy
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hostile.damage import BYTES, PLANTED, Trap, Victim, archive, damage, forged

from torchsoft.sysid import runs
from torchsoft.sysid.prediction import FailedRun, Frozen, Prediction
from torchsoft.sysid.runs import CHECKPOINT, Job, Journal, Runner, forget

ODD = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 0.1 + 0.2, 1e308])
PREDICTION = Prediction(
    ODD, np.stack([ODD, -ODD], 1), np.asfortranarray(np.ones((8, 2, 3)) * ODD[:, None, None]),
    ODD[5:]
)  # fmt: skip
RESULTS = {
    "prediction": PREDICTION,
    "without derivatives": PREDICTION._replace(derivatives=None, knots=None),
    "nothing": Prediction(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 0))),
    "failed": FailedRun("the disc was lost at t = 0.1 s: µ_s, 'quoted'", float("nan")),
}
RUN, OTHER = ("run", 1.0), ("run", 1.0000000000000002)
KNOTS = np.array([0.0, 0.1, 0.3])
FROZEN = Job(0, {"pad.E": 1.0}, (), Frozen(KNOTS))
RUNS = [
    (RUN, OTHER), (FROZEN, FROZEN._replace(steps=Frozen(np.nextafter(KNOTS, 1.0)))),
    (FROZEN, FROZEN._replace(steps=1e-3)),
]  # fmt: skip
"""Runs that are not the same, if only by the last bit."""


def same(a: Any, b: Any) -> bool:
    """To the bit, and of the same types."""

    def bits(x: Any) -> Any:
        if isinstance(x, np.ndarray):
            return x.dtype, x.shape, x.tobytes()
        return type(x), struct.pack("d", x) if isinstance(x, float) else x

    return type(a) is type(b) and [*map(bits, a)] == [*map(bits, b)]


def recording(fingerprint: str = "a") -> Any:
    return SimpleNamespace(
        fingerprint=fingerprint,
        start_fingerprint="",
        duration=1.0,
        run_context=lambda: None,
        rig=None,
    )


def journal(folder: Path, fingerprint: str = "a") -> Journal:
    return Journal(folder, [recording(fingerprint)])


@pytest.mark.parametrize("name", RESULTS)
@pytest.mark.parametrize(("run", "other"), RUNS)
def test_a_result_is_read_as_it_was_written(tmp_path, name, run, other):
    journal(tmp_path).keep(deepcopy(run), RESULTS[name])
    again = journal(tmp_path)
    assert same(again.recall(run), RESULTS[name])
    assert again.recall(other) is None
    assert journal(tmp_path, "b").recall(run) is None


SEALED = {
    "a kind that is no name": archive(kind=np.ones(3)),
    "no fields": archive(kind=np.asarray("Prediction")),
    "unknown fields": archive(kind=np.asarray("Prediction"), path=np.ones(2)),
}
KINDS = BYTES | PLANTED | {name: lambda v, one=one: v.seal(one) for name, one in SEALED.items()}
KINDS["another run's"] = lambda v: v.other.read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_or_planted_file_is_noticed_and_never_executed(tmp_path, kind):
    folder, trap = tmp_path / "runs", Trap(tmp_path / "executed")
    journal(folder).keep(RUN, PREDICTION)
    (path,) = folder.glob("*.run")
    journal(folder).keep(OTHER, PREDICTION)
    (other,) = {*folder.glob("*.run")} - {path}
    seal = partial(forged, bytes.fromhex(path.stem))
    damage(KINDS[kind], Victim(path, np.random.default_rng(0), other, trap, seal))
    again = journal(folder)
    with pytest.warns(UserWarning, match="runs holds damaged results, whose runs are made again$"):
        assert again.recall(RUN) is None
    assert again.recall(RUN) is None  # it warns once
    assert not trap.path.exists()
    again.keep(RUN, PREDICTION)
    assert same(journal(folder).recall(RUN), PREDICTION)


def test_other_files_are_neither_joined_nor_removed(tmp_path):
    (tmp_path / "thesis.pickle").write_text("mine")
    for path, what in ((tmp_path, "holds other files"), (tmp_path / "thesis.pickle", "is a file")):
        with pytest.raises(ValueError, match=rf"{what}; give a new or an empty folder$"):
            journal(path)
    forget(tmp_path)
    folder = tmp_path / "runs"
    journal(folder).keep(RUN, PREDICTION)
    (path,) = folder.glob("*.run")
    (folder / f"{path.name}.0123456789abcdef.partial").write_text("killed while it was written")
    others = {"a.pickle", "b.partial", "c.run", f"{path.name}.old"}
    for other in others:
        (folder / other).write_text("mine")
    forget(folder)
    assert {path.name for path in folder.iterdir()} == {*others, CHECKPOINT}
    one = journal(folder)  # it is still one of ours
    for other in others:
        (folder / other).unlink()
    forget(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.pickle"]
    one.keep(RUN, PREDICTION)  # where another was done with the folder
    assert same(journal(folder).recall(RUN), PREDICTION)


@pytest.mark.parametrize("count", [1, 2])
def test_finished_runs_are_kept_at_an_interruption(tmp_path, monkeypatch, count):
    """Those before it, and what another thread still runs when it comes."""
    jobs = [Job(0, {"pad.E": float(k)}, (), 1e-3) for k in range(4)]
    running = threading.Barrier(count)

    def made(recording: Any, context: Any, job: Job, start: Any) -> Prediction:
        if job in jobs[:count]:
            running.wait()
        if job is jobs[count - 1]:
            raise KeyboardInterrupt
        time.sleep(0.1)
        return PREDICTION

    monkeypatch.setattr(runs, "simulated", made)
    with pytest.raises(KeyboardInterrupt):
        Runner([recording()], workers=count, journal=tmp_path).run(jobs)
    kept = [journal(tmp_path).recall(job) is not None for job in jobs]
    assert kept[:count] == [True, False][2 - count :]
    assert not all(kept)


def test_the_work_of_runs_counts_for_whom_they_are_made_also_where_remembered(
    tmp_path, monkeypatch
):
    """So that what a bound on the work leaves out does not depend on an interruption."""
    monkeypatch.setattr(runs, "simulated", lambda *_: PREDICTION)
    monkeypatch.setattr(runs, "rig_step", lambda rig, parameters: 1.0 + parameters)
    for remembered in (0, 3):
        parent = Runner([recording()], journal=tmp_path)
        child = parent.of(parent.recordings).of(parent.recordings)
        child.run([Job(0, {"pad.E": 1.0}, names, 1e-3) for names in ((), ("pad.E",))])
        parent.run([Job(0, {"pad.E": 2.0}, (), 1e-3)])
        assert (child.simulations, child.jacobians) == (1, 1)
        assert (parent.simulations, parent.jacobians) == (2, 1)
        assert parent.work == child.work == (1 + 2 + 1) * (len(ODD[5:]) - 1)
        assert parent.remembered == remembered
