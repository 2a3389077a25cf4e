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
from hostile.processes import ended, fork, restore
from hostile.specimens import dataset, make, problem, run
from hostile.trial import LIMIT, count, random, sentence
from torchsoft.datasets import Trajectories, open_dataset
from torchsoft.datasets.check import check
from torchsoft.datasets.files import StoreError
from torchsoft.files import SEAL
from torchsoft.rigs import RigFile
from torchsoft.solve.netcdf import load
from torchsoft.sysid import identify
from torchsoft.sysid.columns import read_table
from torchsoft.sysid.measured import vocabulary
from torchsoft.sysid.result import load_answer

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::zarr.errors.ZarrUserWarning")]

RTOL = 1e-3


class Specimen(NamedTuple):
    """A folder of sound files; what is wrong with a copy of it in which a file was damaged, empty
    if nothing is; how a content is sealed for a file; and what may happen to one."""

    sound: Path
    wrong: Callable[[Path], str]
    seal: Callable[[Path, bytes], bytes] = lambda path, content: content
    damages: Damages = BYTES | GONE | FOREIGN


def misread(read: Callable[[], bool], name: str = "") -> str:
    """What is wrong with how a file is read: neither rejected in a sentence, nor as it was."""
    try:
        return "" if read() else "other values were read"
    except (ValueError, OSError, StoreError) as error:
        fine = sentence(str(error)) and name in str(error)
        return "" if fine else f"not one sentence with the file's name: {error}"


# identifications
# ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """The runs of an identification, which gives the same answer after any damage to them."""
    recorded, sound = problem(), tmp_path_factory.mktemp("checkpoint") / "runs"
    numbers = lambda answer: (answer.x, answer.estimates, answer.covariance, answer.residuals)
    truth = repr(numbers(identify(recorded, rtol=RTOL, checkpoint=sound)))

    def wrong(path: Path) -> str:
        again = repr(numbers(identify(recorded, rtol=RTOL, checkpoint=path.parent)))
        return "" if again == truth and path.is_file() else f"another answer: {again}"

    seal = lambda path, content: forged(bytes.fromhex(path.stem), content)
    replaceable = {kind: how for kind, how in GONE.items() if kind != "a folder"}
    return Specimen(sound, wrong, seal, BYTES | replaceable | PLANTED | FOREIGN | SPECIAL)


@pytest.fixture(scope="module")
def answer(tmp_path_factory):
    sound, found = tmp_path_factory.mktemp("answer"), identify(problem(), rtol=RTOL)
    found.save(sound / "answer.json")
    same = lambda path: load_answer(path).to_json() == found.to_json()
    wrong = lambda path: misread(partial(same, path), path.name)
    return Specimen(sound, wrong, damages=BYTES | GONE | PLANTED | SPECIAL)


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

    def wrong(path: Path) -> str:
        root = next(folder for folder in path.parents if folder.name == "copy")
        found = findings(root)
        noticed = "" if found and all(map(sentence, found)) else f"found: {found}"
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
    wrong = lambda path: misread_table(path, truth)
    seal = lambda path, content: content + sha256(content).hexdigest().encode() + SEAL
    return Specimen(sound, wrong, seal, BYTES | GONE | PLANTED | SPECIAL)


# all
# ----------------------------------------------------------------------

FILES: dict[str, tuple[str, str, int]] = {
    "runs of an identification": ("checkpoint", "*.run", 24),
    "answers": ("answer", "*.json", 200),
    "trajectory files": ("trajectory", "*.nc", 1400),
    "metadata of a dataset": ("generated", "**/*.json", 280),
    "series of its trajectories": ("generated", "*/c/**/*", 450),
    "records of its shards": ("generated", "finished/*", 90),
}
"""Kinds of files: the specimen, the pattern of names, and how often one is damaged."""


@pytest.mark.filterwarnings("ignore:the checkpoint")
@pytest.mark.parametrize("files", FILES)
def test_a_damaged_file_is_noticed(files, request, tmp_path, tally):
    """Runs of an identification are made again."""
    fixture, pattern, number = FILES[files]
    specimen: Specimen = request.getfixturevalue(fixture)
    copy, trap = tmp_path / "copy", Trap(tmp_path / "executed")
    for trial in range(count(number)):
        rng = random(files, trial)
        restore(copy, specimen.sound)
        paths = [path for path in sorted(copy.glob(pattern)) if path.is_file()]
        path = paths[rng.integers(len(paths))]
        others = [other for other in paths if other.read_bytes() != path.read_bytes()]
        kind = [*specimen.damages][trial % len(specimen.damages)]
        if not others and kind in FOREIGN:
            kind = "a bit"
        other = others[rng.integers(len(others))] if others else path
        damage(specimen.damages[kind], Victim(path, rng, other, trap, partial(specimen.seal, path)))

        def judged(path: Path = path) -> None:
            assert not (wrong := specimen.wrong(path)), wrong
            assert not trap.path.exists(), "executed"

        tally.call(f"{trial}, {kind}, {path.name}", judged, ())
