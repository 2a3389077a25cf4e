"""Checkpoints that are damaged, planted or another's: never executed, always noticed, and the
answer keeps its bits."""

import os
import pickle
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from conftest import COARSE
from test_sysid_journal import Trap, forged, objects, other_archive, same

from hostile.trial import Tally
from torchsoft import Parameters
from torchsoft.excitation import Excitation, Strokes
from torchsoft.sysid import IdentificationResult, Problem, Sensor, Unknown, identify, record
from torchsoft.sysid.runs import CHECKPOINT, Journal, Runner, forget

pytestmark = pytest.mark.slow

BASE = Parameters().override(COARSE)
SENSORS = {"x_C": Sensor(noise=1e-5), "y_Br": Sensor(noise=1e-5), "F_y": Sensor(noise=0.1)}
STROKES = Excitation(motion=Strokes(travel=5e-3, stroke_time=0.15), duration=0.4, senses="bracket")
RTOL = 1e-3


class Done(NamedTuple):
    """An identification, the folder that its runs are kept in, and the runs and results by file
    name."""

    problem: Problem
    answer: IdentificationResult
    folder: Path
    runs: dict[str, tuple[str, Any, Any]]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    recorded = record(
        "strokes", STROKES, BASE.override({"pad.E": 0.9e6}), BASE, SENSORS, rtol=RTOL, seed=3
    )
    problem = Problem(
        [recorded], SENSORS, {"pad.E": Unknown(nominal=1.1e6), "contact.K_n": Unknown()}
    )
    folder, runs = tmp_path_factory.mktemp("checkpoint") / "runs", {}
    inner = Journal.keep

    def noticed(self: Journal, run: Any, result: Any) -> None:
        runs[self._place(run)[1].name] = self._own, run, result
        inner(self, run, result)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Journal, "keep", noticed)
        answer = identify(problem, rtol=RTOL, checkpoint=folder)
    assert len(runs) >= 5
    return Done(problem, answer, folder, runs)


def of_the_same(folder: Path, own: str) -> Journal:
    """The journal of the recordings that it says are its own: those of a problem, or of one with
    another assumption."""
    journal = Journal(folder, [])
    journal._own = own
    return journal


def bits(answer: IdentificationResult) -> Any:
    """All that the data decide."""
    return (
        answer.x,
        answer.estimates,
        answer.covariance,
        answer.chi2,
        answer.residuals,
        answer.notices,
    )


def flipped(rng: np.random.Generator, content: bytes, count: int = 1) -> bytes:
    out = bytearray(content)
    for at in rng.choice(8 * len(out), count, replace=False):
        out[at // 8] ^= 1 << at % 8
    return bytes(out)


def zeroed(rng: np.random.Generator, content: bytes) -> bytes:
    at = int(rng.integers(len(content) - 64))
    while not any(content[at : at + 64]):  # zeros already
        at = int(rng.integers(len(content) - 64))
    return content[:at] + bytes(64) + content[at + 64 :]


Damage = Callable[[np.random.Generator, bytes, bytes, Trap], bytes]
BYTES: dict[str, Damage] = {
    "one bit": lambda rng, name, content, trap: flipped(rng, content),
    "some bits": lambda rng, name, content, trap: flipped(rng, content, 9),
    "a bit of the checksum": lambda rng, name, content, trap: (
        flipped(rng, content[:32]) + content[32:]
    ),
    "cut": lambda rng, name, content, trap: content[: rng.integers(len(content))],
    "empty": lambda rng, name, content, trap: b"",
    "longer": lambda rng, name, content, trap: content + rng.bytes(int(rng.integers(1, 5000))),
    "zeros": lambda rng, name, content, trap: zeroed(rng, content),
    "all zeros": lambda rng, name, content, trap: bytes(len(content)),
    "noise": lambda rng, name, content, trap: rng.bytes(len(content)),
    "text": lambda rng, name, content, trap: b"t [s], x_C [mm]\n0, 1\n",
    "a pickle": lambda rng, name, content, trap: pickle.dumps(trap),
    "a pickle with a checksum": lambda rng, name, content, trap: forged(name, pickle.dumps(trap)),
    "a pickle within an archive": lambda rng, name, content, trap: forged(name, objects(trap)),
    "a numpy file of objects": lambda rng, name, content, trap: forged(
        name,
        np.lib.format.magic(1, 0)
        + b"\x36\0{'descr': '|O', 'fortran_order': False, 'shape': ()}\n"
        + pickle.dumps(trap),
    ),
    "a header that is code": lambda rng, name, content, trap: forged(
        name,
        np.lib.format.magic(1, 0)
        + b"\x30\0__import__('os').mkdir("
        + repr(str(trap.path)).encode()
        + b")",
    ),
    "no result": lambda rng, name, content, trap: forged(
        name, other_archive(kind=np.asarray("Trap"), x=np.zeros(2))
    ),
    "damage that has a checksum": lambda rng, name, content, trap: forged(
        name, zeroed(rng, content[32:])
    ),
}


def plant(done: Done, path: Path, kind: str, rng: np.random.Generator, trap: Trap) -> None:
    """Damage one file of a copy of the folder."""
    content, others = path.read_bytes(), sorted(name for name in done.runs if name != path.name)
    if kind in BYTES:
        path.write_bytes(BYTES[kind](rng, bytes.fromhex(path.stem), content, trap))
    elif kind == "another run's":
        path.write_bytes((done.folder / str(rng.choice(others))).read_bytes())
    else:
        path.unlink()
        if kind == "a pipe":
            os.mkfifo(path)
        else:
            target = {
                "a link to another run's": done.folder / str(rng.choice(others)),
                "a link to itself": path,
            }
            path.symlink_to(target.get(kind, path.parent / "nothing"))


KINDS = [
    *BYTES,
    "another run's",
    "a pipe",
    "a link to another run's",
    "a link to itself",
    "a link to nothing",
]


def test_every_damaged_file_is_noticed(
    done: Done, tally: Callable[[str], Tally], count: Any, random: Any, tmp_path: Path
) -> None:
    noticed, executed = (
        tally("damaged, planted and foreign checkpoint files"),
        tally("of them executed: none"),
    )
    for number in range(count(420)):
        kind, rng = KINDS[number % len(KINDS)], random(91, number)
        trap, folder = Trap(tmp_path / "executed"), tmp_path / "runs"
        shutil.copytree(done.folder, folder)
        name = str(rng.choice(sorted(done.runs)))
        plant(done, folder / name, kind, rng, trap)
        own, run, expected = done.runs[name]
        try:
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                got = of_the_same(folder, own).recall(run)
            quiet = kind in ("a pipe", "a link to itself", "a link to nothing")  # there is no file
            held = got is None and (quiet or (len(said) == 1 and "\n" not in str(said[0].message)))
            if (
                kind == "damage that has a checksum" and got is not None
            ):  # what a forger gets: data, nothing else
                held = type(got) is type(expected)
            noticed.held(held, f"{number}, {kind}: {got!r:.200}, {[str(x.message) for x in said]}")
        except BaseException as error:
            noticed.held(False, f"{number}, {kind}: {error!r}")
        executed.held(not trap.path.exists(), f"{number}, {kind}")
        shutil.rmtree(folder)


def test_the_answer_keeps_its_bits(
    done: Done, tally: Callable[[str], Tally], count: Any, random: Any, tmp_path: Path
) -> None:
    """Whatever happened to however many files, and afterwards every file is whole again."""
    line = tally("identifications resumed from damaged checkpoints")
    kinds = [kind for kind in KINDS if kind != "damage that has a checksum"]
    for number in range(count(24)):
        rng, folder = random(92, number), tmp_path / "runs"
        shutil.copytree(done.folder, folder)
        trap, chosen = Trap(tmp_path / "executed"), rng.permutation(sorted(done.runs))
        for name in chosen[: 1 + number % len(chosen)]:
            plant(done, folder / str(name), str(rng.choice(kinds)), rng, trap)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            answer = identify(done.problem, rtol=RTOL, checkpoint=folder)
        held = bits(answer) == bits(done.answer) and not trap.path.exists()
        for name, (own, run, expected) in done.runs.items():
            held = held and same(of_the_same(folder, own).recall(run), expected)
            held = (
                held and (folder / name).read_bytes()[32:] == (done.folder / name).read_bytes()[32:]
            )
        line.held(held, f"{number}: {chosen[: 1 + number % len(chosen)]}")
        shutil.rmtree(folder)


def test_folders_of_others_are_left_alone(
    tally: Callable[[str], Tally], count: Any, random: Any, tmp_path: Path
) -> None:
    """Refused in one sentence where they are not ours; where they are, what others put in them
    stays."""
    refused, kept = (
        tally("checkpoint folders of others"),
        tally("others' files in a checkpoint folder"),
    )
    names = [
        "a.pickle",
        "b.partial",
        "c.run",
        "answer.json",
        ".hidden",
        "x.run.partial",
        "é.npz",
        f"{'0' * 64}.run.old",
    ]
    for number in range(count(100)):
        rng, folder = random(93, number), tmp_path / f"{number}"
        folder.mkdir()
        others = [str(name) for name in rng.choice(names, int(rng.integers(1, 5)), replace=False)]
        ours = bool(rng.integers(2))
        if ours:
            Journal(folder, [])
            for run in range(3):
                Journal(folder, []).keep(run, other(rng))
        for name in others:
            (folder / name).mkdir() if rng.random() < 0.3 else (folder / name).write_bytes(
                rng.bytes(9)
            )
        if not ours:
            refused.call(
                f"{number}", lambda folder=folder: Runner([], journal=folder), (ValueError,)
            )
            refused.held(not (folder / CHECKPOINT).exists(), f"{number}: marked")
        forget(folder)
        left = sorted(path.name for path in folder.iterdir() if path.name != CHECKPOINT)
        kept.held(left == sorted(others), f"{number}: {left} of {others}")


def other(rng: np.random.Generator) -> Any:
    from torchsoft.sysid.prediction import FailedRun

    return FailedRun("lost", float(rng.random()))
