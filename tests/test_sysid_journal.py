"""The journal of an identification: data with checksums, to the bit, in a folder of its own."""

import struct
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hostile.damage import BYTES, PLANTED, Trap, Victim, archive, damage, forged

from torchsoft.sysid import runs
from torchsoft.sysid.prediction import FailedRun, Frozen, Misfit, Prediction
from torchsoft.sysid.runs import CHECKPOINT, Job, Journal, Runner, decoded, encoded, forget

ODD = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 0.1 + 0.2, 1e308])
PREDICTION = Prediction(
    ODD, np.stack([ODD, -ODD], 1), np.asfortranarray(np.ones((8, 2, 3)) * ODD[:, None, None]),
    ODD[5:]
)  # fmt: skip
RESULTS = {
    "prediction": PREDICTION,
    "without derivatives": PREDICTION._replace(derivatives=None),
    "on frozen steps": PREDICTION._replace(knots=None),
    "nothing": Prediction(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 0))),
    "misfit": Misfit(0.1 + 0.2, ODD, -ODD[None]),
    "infinite misfit": Misfit(float("inf"), ODD, np.stack([ODD, ODD])),
    "failed": FailedRun("the disc was lost at t = 0.1 s: µ_s, 'quoted'", 0.1),
    "failed without a reason": FailedRun("", float("nan")),
}
RUN, OTHER = ("run", 1.0), ("run", 1.0000000000000002)


def same(a: Any, b: Any) -> bool:
    """To the bit, and of the same types."""
    return type(a) is type(b) and all(
        type(x) is type(y)
        and (
            (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())
            if isinstance(x, np.ndarray)
            else struct.pack("d", x) == struct.pack("d", y)
            if isinstance(x, float)
            else x == y
        )
        for x, y in zip(a, b)
    )


def journal(folder: Path, print_: str = "a") -> Journal:
    return Journal(folder, [SimpleNamespace(fingerprint=print_)])


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.run"))


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_is_read_as_it_was_written(tmp_path, name):
    journal(tmp_path).keep(RUN, RESULTS[name])
    again = journal(tmp_path)
    assert same(again.recall(RUN), RESULTS[name])
    assert again.recall(OTHER) is None
    assert journal(tmp_path, "b").recall(RUN) is None


SEALED = {
    "a kind that is no name": archive(kind=np.ones(3)),
    "no fields": archive(kind=np.asarray("Prediction")),
    "unknown fields": archive(kind=np.asarray("Prediction"), path=np.ones(2)),
}
KINDS = BYTES | PLANTED | {name: lambda v, one=one: v.seal(one) for name, one in SEALED.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_or_planted_file_is_noticed_and_never_executed(tmp_path, kind):
    folder, trap = tmp_path / "runs", Trap(tmp_path / "executed")
    journal(folder).keep(RUN, PREDICTION)
    (path,) = files(folder)
    seal = partial(forged, bytes.fromhex(path.stem))
    damage(KINDS[kind], Victim(path, np.random.default_rng(0), path, trap, seal))
    again = journal(folder)
    with pytest.warns(UserWarning, match="runs holds damaged results, whose runs are made again$"):
        assert again.recall(RUN) is None
    assert again.recall(RUN) is None  # says so once
    assert not trap.path.exists()
    again.keep(RUN, PREDICTION)
    assert same(journal(folder).recall(RUN), PREDICTION)


def test_a_result_of_another_run_is_noticed(tmp_path):
    one = journal(tmp_path)
    one.keep(RUN, PREDICTION)
    one.keep(OTHER, PREDICTION._replace(knots=None))
    first, second = files(tmp_path)
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    again = journal(tmp_path)
    with pytest.warns(UserWarning, match="damaged"):
        assert again.recall(RUN) is None
    assert again.recall(OTHER) is None


def test_an_archive_is_no_pickle():
    assert same(decoded(encoded(PREDICTION)), PREDICTION)
    content = encoded(FailedRun(np.array([{}], dtype=object), 0.0))
    with pytest.raises(ValueError, match="allow_pickle"):
        decoded(content)


def test_a_folder_of_others_is_refused(tmp_path):
    (tmp_path / "thesis.pickle").write_text("mine")
    with pytest.raises(
        ValueError, match=r"the checkpoint .* holds other files; give a new or an empty folder$"
    ):
        journal(tmp_path)
    with pytest.raises(
        ValueError, match=r"thesis.pickle is a file; give a new or an empty folder$"
    ):
        journal(tmp_path / "thesis.pickle")
    forget(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.pickle"]


def test_only_its_own_files_are_removed(tmp_path):
    folder = tmp_path / "runs"
    journal(folder).keep(RUN, PREDICTION)
    name = files(folder)[0].name
    (folder / f"{name}.0123456789abcdef.partial").write_text("killed while it was written")
    others = ["a.pickle", "b.partial", "c.run", "notes.txt", f"{name}.old"]
    for other in others:
        (folder / other).write_text("mine")
    forget(folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted([*others, CHECKPOINT])
    journal(folder)  # it is still one of ours
    for other in others:
        (folder / other).unlink()
    forget(folder)
    assert not folder.exists()
    forget(folder)


def test_it_goes_on_where_another_was_done_with_the_folder(tmp_path):
    one = journal(tmp_path / "runs")
    forget(tmp_path / "runs")
    one.keep(RUN, PREDICTION)
    assert same(journal(tmp_path / "runs").recall(RUN), PREDICTION)


@pytest.mark.parametrize("count", [1, 2])
def test_what_is_done_is_kept_at_an_interruption(tmp_path, monkeypatch, count):
    """What was done before it, and what another thread still runs when it comes."""
    jobs = [Job(0, {"pad.E": float(k)}, (), 1e-3) for k in range(4)]
    running = threading.Barrier(count)

    def made(recording: Any, begun: Any, job: Job, start: Any) -> Prediction:
        if job is jobs[0] or (job is jobs[1] and count == 2):
            running.wait()
        if job is jobs[count - 1]:
            raise KeyboardInterrupt
        time.sleep(0.1)
        return PREDICTION

    monkeypatch.setattr(runs, "simulated", made)
    one = {"beginning": "", "fingerprint": "a", "duration": 1.0, "begin": lambda: None}
    recordings: Any = [SimpleNamespace(**one)]
    with pytest.raises(KeyboardInterrupt):
        Runner(recordings, workers=count, journal=tmp_path).run(jobs)
    again = Journal(tmp_path, recordings)
    kept = [again.recall(job) is not None for job in jobs]
    assert kept[:count] == [True, False][2 - count :]
    assert not all(kept)


def test_frozen_steps_are_named_to_the_bit(tmp_path):
    knots = np.array([0.0, 0.1, 0.3])
    job = Job(0, {"pad.E": 1.0}, (), Frozen(knots))
    journal(tmp_path).keep(job, PREDICTION)
    assert same(journal(tmp_path).recall(job._replace(steps=Frozen(knots.copy()))), PREDICTION)
    assert journal(tmp_path).recall(job._replace(steps=Frozen(np.nextafter(knots, 1.0)))) is None
    assert journal(tmp_path).recall(job._replace(steps=1e-3)) is None


def test_runs_of_varied_recordings_count_where_they_were_asked_for(monkeypatch):
    """The runs of tests and of new fits are a part of what an identification costs."""
    monkeypatch.setattr(runs, "simulated", lambda *_: PREDICTION)
    monkeypatch.setattr(runs, "rig_step", lambda rig, parameters: 1.0 + parameters)
    one = {"beginning": "", "fingerprint": "a", "duration": 1.0, "begin": lambda: None}
    recordings: Any = [SimpleNamespace(**one, rig=None)]
    parent = Runner(recordings)
    child = parent.of(recordings).of(recordings)
    child.run([Job(0, {"pad.E": 1.0}, (), 1e-3), Job(0, {"pad.E": 1.0}, ("pad.E",), 1e-3)])
    parent.run([Job(0, {"pad.E": 2.0}, (), 1e-3)])
    assert (child.simulations, child.jacobians) == (1, 1)
    assert (parent.simulations, parent.jacobians) == (2, 1)
    steps = len(PREDICTION.knots) - 1
    assert parent.work == child.work == (1 + 2 + 1) * steps


def test_a_varied_run_is_as_much_work_as_all_of_its_runs(monkeypatch):
    """But that of the recording as stated, which is made once for many."""
    monkeypatch.setattr(runs, "simulated", lambda *_, **__: PREDICTION)
    monkeypatch.setattr(runs, "rig_step", lambda rig, parameters: 1.0 + parameters)
    one = {
        "beginning": "", "fingerprint": "a", "duration": 1.0, "begin": lambda: None, "begins": 0.0,
        "channels": ("x",), "tied": {}, "rig": None,
    }  # fmt: skip
    stated, other = SimpleNamespace(**one), SimpleNamespace(**one)
    monkeypatch.setattr(runs, "between", lambda *_: None)

    def late(recording, amount, run):
        run(recording), run(other), run(other)
        return other

    runner = Runner([stated], variations={"late": late})  # pyright: ignore
    for names in ((), ("pad.E",)):
        runner.run([Job(0, {"pad.E": 1.0}, names, 1e-3, varied=(("late", 1.0),))])
    assert runner.work == (3 + 4) * (len(PREDICTION.knots) - 1)


def test_remembered_runs_are_as_much_work(tmp_path, monkeypatch):
    """So that what a bound on the work leaves out does not hang on an interruption."""
    monkeypatch.setattr(runs, "simulated", lambda *_: PREDICTION)
    monkeypatch.setattr(runs, "rig_step", lambda rig, parameters: 1.0 + parameters)
    one = {"beginning": "", "fingerprint": "a", "duration": 1.0, "begin": lambda: None}
    recordings: Any = [SimpleNamespace(**one, rig=None)]
    works = list[float]()
    for _ in range(2):
        runner = Runner(recordings, journal=tmp_path)
        runner.run([Job(0, {"pad.E": 1.0}, ("pad.E",), 1e-3)])
        works.append(runner.work)
    assert runner.remembered == 1
    assert works[0] == works[1] > 0.0
