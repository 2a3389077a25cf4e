"""Damage to every kind of file that is read back: it is noticed, or what is read is what was
written."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hostile.small import config, make, restore
from hostile.trial import Tally
from torchsoft.datasets import Trajectories, open_dataset
from torchsoft.datasets.check import check
from torchsoft.datasets.files import StoreError
from torchsoft.paper.equilibrium import rest
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import SoftGrasp
from torchsoft.solve.simulate import simulate
from torchsoft.sysid.columns import read_table

pytestmark = pytest.mark.slow

Damage = Callable[[Path, np.random.Generator, list[Path]], None]


def flip(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    """One bit."""
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)


def zero(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    """64 bytes, or all that there are; of which one is not zero before."""
    data = bytearray(path.read_bytes())
    somewhere = int(rng.choice(np.flatnonzero(np.frombuffer(data, np.uint8))))
    begin = max(0, somewhere - int(rng.integers(min(64, len(data)))))
    data[begin : begin + 64] = bytes(len(data[begin : begin + 64]))
    path.write_bytes(data)


def scramble(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    """Up to 4096 bytes at random."""
    data = bytearray(path.read_bytes())
    begin = int(rng.integers(len(data)))
    length = len(data[begin : begin + int(rng.integers(8, 4097))])
    data[begin : begin + length] = rng.integers(0, 256, length, np.uint8).tobytes()
    path.write_bytes(data)


def truncate(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: rng.integers(len(data))])


def empty(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    path.write_bytes(b"")


def append(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    """A few bytes, white space among them."""
    more = (b" ", b"\n", b"\0", b"{}", bytes(64), b"0" * 5000)
    path.write_bytes(path.read_bytes() + more[rng.integers(len(more))])


def delete(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    path.unlink()


def folder(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    """A folder of the same name in its place."""
    path.unlink()
    path.mkdir()


def swap(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    """With a file of the same kind."""
    other = others[rng.integers(len(others))]
    a, b = path.read_bytes(), other.read_bytes()
    path.write_bytes(b)
    other.write_bytes(a)


def duplicate(path: Path, rng: np.random.Generator, others: list[Path]) -> None:
    """A file of the same kind over it."""
    shutil.copyfile(others[rng.integers(len(others))], path)


ANY: tuple[Damage, ...] = (flip, flip, zero, scramble, truncate, empty, append, delete, folder)
SEVERAL: tuple[Damage, ...] = (*ANY, swap, duplicate)
"""Where there are others of its kind."""

KINDS: dict[str, tuple[str, int]] = {
    "manifest": ("manifest.json", 90),
    "metadata of the group": ("zarr.json", 70),
    "metadata of arrays": ("*/zarr.json", 120),
    "coordinates": ("*/c/0", 60),
    "numbers of trajectories": ("*/c/[0-9]", 150),
    "series": ("*/c/*/*", 240),
    "records of shards": ("finished/*", 90),
}
"""Files by what they hold: a pattern, and how often they are damaged. The coordinates are those of
`COORDINATES`."""

COORDINATES = ("time", "trajectory", "axis", "lower_surface", "upper_surface")


def matching(root: Path, kind: str) -> list[Path]:
    found = [p for p in sorted(root.glob(KINDS[kind][0])) if p.is_file()]
    if kind in ("coordinates", "numbers of trajectories"):
        found = [p for p in found if (p.parts[-3] in COORDINATES) == (kind == "coordinates")]
    return found


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("damage")
    small, _ = config(place)
    make(small, place / "sound")
    return place / "sound"


def repair(path: Path, data: bytes) -> None:
    """Make the file what it was."""
    if path.is_dir():
        path.rmdir()
    if not path.exists() or path.read_bytes() != data:
        path.write_bytes(data)


def everything(root: Path) -> tuple[Any, Any]:
    """All that there is to read, in both ways of reading it."""
    numbers = Trajectories(
        str(root), ["disc_position", "feed_forward", "grasp_force", "contact_upper", "steps"]
    )
    return open_dataset(str(root)).load(), [numbers[i] for i in range(len(numbers))]


def same(a: tuple[Any, Any], b: tuple[Any, Any]) -> bool:
    windows = len(a[1]) == len(b[1]) and all(
        torch.equal(x[k], y[k]) for x, y in zip(a[1], b[1]) for k in y
    )
    return bool(a[0].identical(b[0])) and windows


def one_line(text: str) -> bool:
    return bool(text) and "\n" not in text and len(text) < 2000


@pytest.mark.filterwarnings("ignore::zarr.errors.ZarrUserWarning")
@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_dataset_is_noticed(
    kind: str,
    sound: Path,
    tmp_path: Path,
    tally: Callable[[str], Tally],
    random: Any,
    count: Callable[[int], int],
) -> None:
    """By the check, which never raises, and by either way of reading: refused in one sentence, or
    the very same values."""
    line, truth, out = tally(f"damaged {kind}"), everything(sound), tmp_path / "set"
    assert [x for x in check(str(sound)) if "no commit" not in x] == []
    restore(out, sound)
    files = {path: path.read_bytes() for path in matching(out, kind)}
    for trial in range(count(KINDS[kind][1])):
        rng = random(trial, list(KINDS).index(kind))
        for path, data in files.items():
            repair(path, data)
        path = list(files)[rng.integers(len(files))]
        kinds = [other for other, data in files.items() if data != files[path]]
        damage = (SEVERAL if kinds else ANY)[rng.integers(len(SEVERAL if kinds else ANY))]
        what = f"trial {trial}, {damage.__name__} {path.relative_to(out)}"
        damage(path, rng, kinds)
        try:
            findings = [x for x in check(str(out)) if "no commit" not in x]
        except Exception as error:
            line.held(False, f"{what}: the check raised {error!r}")
            continue
        try:
            reads = "" if same(everything(out), truth) else "other values were read"
        except StoreError as error:
            reads = "" if one_line(str(error)) else f"not one sentence: {error}"
        except Exception as error:
            reads = f"reading raised {error!r}"
        noticed = bool(findings) and all(map(one_line, findings))
        line.held(noticed and not reads, f"{what}: findings {findings}; {reads}")


def test_a_damaged_trajectory_file_is_noticed(
    tmp_path: Path, tally: Callable[[str], Tally], random: Any, count: Callable[[int], int]
) -> None:
    """Refused in one sentence, or the very same values."""
    model = SoftGrasp(
        Parameters().override({"pad.elements_x": 40, "pad.elements_y": 1, "contact.v_s": 0.05})
    )
    run = simulate(
        model, torch.linspace(0, 0.05, 11, dtype=torch.float64), y0=rest(model).detach(), step=5e-3
    )
    good, path, line = tmp_path / "good.nc", tmp_path / "run.nc", tally("damaged trajectory files")
    run.save(good)
    truth = read_table(good).values
    for trial in range(count(200)):
        rng = random(trial, 100)
        repair(path, good.read_bytes())
        damage = ANY[rng.integers(len(ANY))]
        damage(path, rng, [])
        what = f"trial {trial}, {damage.__name__}"
        try:
            found = read_table(path).values
        except (ValueError, OSError) as error:
            line.held(one_line(str(error)), f"{what}: not one sentence: {error}")
        except Exception as error:
            line.held(False, f"{what}: {error!r}")
        else:
            equal = found.keys() == truth.keys() and all(
                np.array_equal(found[k], truth[k]) for k in truth
            )
            line.held(equal, f"{what}: other values were read")
