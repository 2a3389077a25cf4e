"""Damage to every kind of file that is read back: it is never executed, and noticed, or the values
are those that were written."""

from collections.abc import Callable
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr

from hostile.damage import (
    BYTES,
    FOREIGN,
    GONE,
    PLANTED,
    SPECIAL,
    Damages,
    Trap,
    Victim,
    damage,
    forged,
)
from hostile.processes import ended, fork, restore, tree
from hostile.specimens import dataset, make, problem, run
from hostile.trial import LIMIT, count, random, sentence
from torchsoft.datasets import Trajectories, open_dataset
from torchsoft.datasets.check import check
from torchsoft.datasets.files import StoreError
from torchsoft.files import SEAL
from torchsoft.rigs import RigFile
from torchsoft.solve.formats import load
from torchsoft.sysid import IdentificationResult, Problem, identify
from torchsoft.sysid.columns import read_table
from torchsoft.sysid.measured import vocabulary
from torchsoft.sysid.result import load_answer

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::zarr.errors.ZarrUserWarning")]

RTOL = 1e-3
Make = pytest.TempPathFactory


class Specimen(NamedTuple):
    """A folder of sound files; what is wrong with a copy of it in which a file was damaged, empty
    if nothing is; how a content is sealed for a file; and damages beyond those to bytes."""

    sound: Path
    wrong: Callable[[Path, str], str]
    seal: Callable[[Path, bytes], bytes] = lambda path, content: content
    damages: Damages = FOREIGN


def misread(read: Callable[[], bool], name: str = "") -> str:
    """What is wrong with how a file is read: neither refused in a sentence, nor as it was."""
    try:
        return "" if read() else "other values were read"
    except (ValueError, OSError, StoreError) as refusal:
        fine = sentence(str(refusal)) and name in str(refusal)
        return "" if fine else f"not one sentence with the file's name: {refusal}"


# identifications
# ----------------------------------------------------------------------


class Identified(NamedTuple):
    """An identification, its answer, and the folder that its runs are kept in."""

    problem: Problem
    answer: IdentificationResult
    folder: Path


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    recorded, folder = problem(), tmp_path_factory.mktemp("checkpoint") / "runs"
    return Identified(recorded, identify(recorded, rtol=RTOL, checkpoint=folder), folder)


@pytest.fixture(scope="module")
def answer(identified, tmp_path_factory):
    sound, truth = tmp_path_factory.mktemp("answer"), identified.answer.to_json()
    identified.answer.save(sound / "answer.json")
    read = lambda path: load_answer(path).to_json() == truth
    wrong = lambda path, kind: misread(partial(read, path), path.name)
    return Specimen(sound, wrong, damages=PLANTED | SPECIAL)


@pytest.mark.filterwarnings("ignore:the checkpoint")
def test_the_answer_keeps_its_bits(identified, tally, tmp_path):
    """Whatever happened to however many files, and afterwards every file is whole again."""
    line, folder = tally("identifications resumed from damaged checkpoints"), tmp_path / "runs"
    kinds, trap = BYTES | GONE | PLANTED | FOREIGN | SPECIAL, Trap(tmp_path / "executed")
    kinds.pop("a folder")
    sound = tree(identified.folder)
    names = sorted(name for name in sound if name.endswith(".run"))
    data = lambda answer: (answer.x, answer.estimates, answer.covariance, answer.residuals)
    for number in range(count(24)):
        rng = random("resumed", number)
        restore(folder, identified.folder)
        for name in rng.permutation(names)[: 1 + number % len(names)].tolist():
            path, other = folder / name, identified.folder / str(rng.choice(names))
            seal = partial(forged, bytes.fromhex(path.stem))
            copy = tmp_path / "other.run"
            copy.write_bytes(other.read_bytes())
            damage(kinds[str(rng.choice([*kinds]))], Victim(path, rng, copy, trap, seal))
        again = identify(identified.problem, rtol=RTOL, checkpoint=folder)
        held = repr(data(again)) == repr(data(identified.answer)) and not trap.path.exists()
        whole = {*tree(folder)} >= {*names} and all((folder / name).is_file() for name in names)
        line.held(held and whole, f"{number}: {data(again)}")


# datasets and trajectories
# ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """By the check, which never raises, and by either way of reading."""
    place = tmp_path_factory.mktemp("damage")
    make(dataset(place), place / "sound")
    names = ["x_C", "F_ff", "materials.rubber.E", "contact_U", "steps"]

    def windows(root: Path) -> list[bytes]:
        numbers = Trajectories(str(root), names)
        return [x.numpy().tobytes() for i in range(len(numbers)) for x in numbers[i].values()]

    def findings(root: Path) -> list[str]:
        return [x for x in check(str(root)) if "no commit" not in x]

    data, truth = open_dataset(str(place / "sound")).load(), windows(place / "sound")
    assert findings(place / "sound") == []

    def wrong(path: Path, kind: str) -> str:
        root = next(folder for folder in path.parents if folder.name == "copy")
        found = findings(root)
        noticed = "" if found and all(map(sentence, found)) else f"findings: {found}"
        same = lambda: data.identical(open_dataset(str(root)).load()) and windows(root) == truth
        return noticed + misread(same)

    return Specimen(place / "sound", wrong)


KNOWN = vocabulary(RigFile.ready("paper").assemble(), {})
"""Columns that a trajectory of the paper's rig may have."""


def misread_table(path: Path, truth: xr.Dataset) -> str:
    """What is wrong with how a trajectory file is read, in a process of its own: damage may make
    libraries crash."""

    def read() -> bool:
        values = read_table(path, (), KNOWN).values.values()
        finite = all(bool(np.isfinite(column).all()) for column in values)
        return finite and load(path).identical(truth)

    def child() -> int:
        print(said := misread(read, path.name))
        return 2 if said else 0

    status = ended(fork(child, int(LIMIT)))
    return f"the reader ended with {status}" if status else ""


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory):
    sound = tmp_path_factory.mktemp("runs")
    run().save(sound / "run.nc")
    truth = load(sound / "run.nc")
    assert set(read_table(sound / "run.nc", (), KNOWN).values) >= {"t", "x_d", "x_C", "effort_y"}
    wrong = lambda path, kind: misread_table(path, truth)
    seal = lambda path, content: content + sha256(content).hexdigest().encode() + SEAL
    return Specimen(sound, wrong, seal, PLANTED | SPECIAL)


# all
# ----------------------------------------------------------------------

FILES: dict[str, tuple[str, str, int]] = {
    "answers": ("answer", "*.json", 200),
    "trajectory files": ("trajectory", "*.nc", 1400),
    "metadata of a dataset": ("generated", "**/*.json", 280),
    "series of its trajectories": ("generated", "*/c/**/*", 450),
    "records of its shards": ("generated", "finished/*", 90),
}
"""Kinds of files: the specimen, the pattern of names, and how often one is damaged."""


@pytest.mark.parametrize("files", FILES)
def test_a_damaged_file_is_noticed(files, request, tmp_path, tally):
    fixture, pattern, number = FILES[files]
    specimen: Specimen = request.getfixturevalue(fixture)
    line, copy, trap = tally(f"damaged {files}"), tmp_path / "copy", Trap(tmp_path / "executed")
    damages = BYTES | GONE | specimen.damages
    for trial in range(count(number)):
        rng = random(files, trial)
        restore(copy, specimen.sound)
        paths = [path for path in sorted(copy.glob(pattern)) if path.is_file()]
        path = paths[rng.integers(len(paths))]
        others = [other for other in paths if other.read_bytes() != path.read_bytes()]
        kind = [*damages][trial % len(damages)]
        if not others and kind in FOREIGN:
            kind = "a bit"
        other = others[rng.integers(len(others))] if others else path
        damage(damages[kind], Victim(path, rng, other, trap, partial(specimen.seal, path)))

        def judged(path: Path = path, kind: str = kind) -> None:
            assert not (wrong := specimen.wrong(path, kind)), wrong
            assert not trap.path.exists(), "executed"

        line.call(f"{trial}, {kind}, {path.name}", judged, ())
