"""Mutated recordings and identification files: accepted and then finite, or refused by file, row,
column and field."""

import csv
import io
import json
import select
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from hostile import mutation
from hostile.asked import LIMIT, ask
from hostile.mutation import TEXTS, Mutant, cut, flip, toml, zeroed
from hostile.trial import Tally, count, random, sentence
from torchsoft import Parameters, simulate
from torchsoft.excitation import Excitation, Strokes, begin
from torchsoft.files import sealed, unsealed
from torchsoft.sysid import measured
from torchsoft.sysid.columns import COLUMNS, read_table
from torchsoft.sysid.measured import cost, paper_settings
from torchsoft.sysid.runs import Runner

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[2] / "examples" / "identify"
RTOL = 1e-3

Table = list[list[str]]


def table() -> Table:
    """Cells of the first 0.2 s of the example, with its heading."""
    with (EXAMPLE / "rolling.csv").open(newline="") as file:
        return list(csv.reader(file))[:42]


def config(whole: bool = True) -> dict[str, Any]:
    """What a file may state; `whole` with what takes longer, a recording that begins in motion and
    competing laws."""
    tree = tomllib.loads((EXAMPLE / "rolling.toml").read_text())
    tree["settings"]["pad"] = {"elements_x": 20, "elements_y": 1, "height": 4.59e-3, "nu": 0.45}
    tree["settings"]["disc"] = {"radius": 19.37e-3}
    tree["unknowns"]["contact.R_t"] = {
        "nominal": 400.0,
        "low": 100.0,
        "high": 1e3,
        "scale": "log",
        "per": "recording",
        "prior": {"median": 400.0, "sd": 0.5, "kind": "log-normal"},
        "fixed": False,
    }
    tree["unknowns"]["contact.mu_s"] |= {"nominal": 0.9, "low": 0.5, "high": 2.0}
    tree["unknowns"]["pad.nu"] = {"scale": "linear", "low": 0.3, "high": 0.49}
    tree["sensors"]["theta"] = {"noise": 0.5e-3, "bias": 1e-3, "delay": 2e-3, "per": "all"}
    tree["sensors"]["F_y"] = {
        "noise": 0.1,
        "gain": 0.02,
        "drift": 0.1,
        "low": -500.0,
        "high": 500.0,
        "colour": "white",
    }
    tree["fit"] = {
        "rtol": RTOL,
        "starts": 1,
        "loss": "linear",
        "method": "gauss_newton",
        "workers": 1,
        "seed": 0,
    }
    second = {
        "files": ["second.csv", "force.csv"],
        "name": "second",
        "settings": {"contact.v_s": 0.06},
    }
    tree["recordings"] = [second | {"missing": {"F_ff": 0.0}}]
    tree |= {
        "heldout": ["second"],
        "ignore": ["Temp"],
        "acknowledged": ["sign of F_x"],
        "missing": {"F_ff": -1.0},
    }
    tree["start"] = {"kind": "rest", "position_sd": 1e-5}
    if whole:
        moving = {
            "kind": "moving",
            "lead": 40e-3,
            "given": {"disc.y": {"mean": 23.5e-3, "sd": 1e-4}},
        }
        tree["recordings"].append({"file": "third.csv", "name": "third", "start": moving})
        tree["pads"] = {"kind": "kelvin_voigt"}
        tree["compare"] = {
            "coulomb": {"settings": {"contact.friction": "coulomb"}, "without": ["contact.R_t"]},
            "solid": {
                "pads": {"kind": "standard_linear_solid", "E_instant": 2e6, "tau_instant": 1e-4}
            },
        }
    return tree


def written(cells: Table, delimiter: str = ",", end: str = "\n") -> bytes:
    out = io.StringIO()
    csv.writer(out, delimiter=delimiter, lineterminator=end).writerows(cells)
    return out.getvalue().encode()


def one_run(case: measured.Case) -> None:
    """The estimate, and one run from the start: residuals are finite, or the reason is a
    sentence."""
    problem, fit = case.problem, case.config.fit
    expected = cost(problem, fit.rtol, fit.starts, fit.workers, case.config.heldout)
    assert np.isfinite(expected).all(), f"no estimate: {expected}"
    if (
        max(paper_settings(r).pad.memory for r in problem.recordings) > 1e-3
        or cost(problem, RTOL, 1, 1).steps > 1e5
    ):
        return
    runner = Runner(problem.recordings)
    out = problem.residuals(
        runner, problem.coordinates.start, problem.names[:1], RTOL, problem.coordinates.free
    )
    if out.lost:
        assert all(sentence(lost.reason) for lost in out.lost.values()), out.lost
    else:
        assert np.isfinite(out.r).all(), "residuals are not finite"
        assert np.isfinite(out.J).all(), "derivatives are not finite"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    cells = table()
    (tmp_path / "data.csv").write_bytes(written(cells))
    force = [[row[i] for i in (0, 10, 11)] for row in cells]
    (tmp_path / "second.csv").write_bytes(written([[*row[:5], *row[6:10]] for row in cells]))
    (tmp_path / "force.csv").write_bytes(
        written([[*row, "Temp [K]" if i == 0 else "warm"] for i, row in enumerate(force)])
    )
    (tmp_path / "third.csv").write_bytes(written(cells))
    (tmp_path / "rig.toml").write_text(toml(config()))
    return tmp_path


@pytest.mark.parametrize("way", ["values", "text"])
def test_a_mutated_identification(way: str, folder: Path, tally: Callable[[str], Tally]) -> None:
    line, rng, path = tally(f"identifications: {way}"), random(2, len(way)), folder / "rig.toml"
    some, whole = config(False), config()
    for i in range(count(4000 if way == "values" else 1000)):
        changed = mutation.written(path, whole if i % 10 == 5 else some, way, i, rng)
        follow = one_run if i % 10 == 0 else None
        ask(
            line,
            "identification",
            changed,
            lambda: measured.load([folder / "data.csv"], path),
            follow,
        )


CELLS = (
    "",
    " ",
    "abc",
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e-300",
    "1_0",
    "1,5",
    "0x10",
    "１２",
    "1e5",
    "-3",
    "0",
    "True",
    "#N/A",
    "9" * 500,
)
NUMBERS = ("1e308", "-1e308", "1e-300", "1e5", "-3", "0", "9" * 500)
"""Those of them that are numbers."""

HEADINGS = (
    "",
    "x_c [mm]",
    "x_C",
    "x_C [inch]",
    "x_C [m",
    "[mm]",
    "t [s]",
    "t [ms]",
    "x_C [deg]",
    "y_C [mm]",
    "F_x [N]",
    "x_C [mm] [mm]",
    "\x00",
    "µ" * 300,
)


def mutated_cells(cells: Table, rng: np.random.Generator) -> tuple[bytes, Mutant]:
    """A table with one thing changed; the place names its column where only that changed."""
    cells, kind = [list(row) for row in cells], rng.integers(12)
    row, column = int(rng.integers(1, len(cells))), int(rng.integers(len(cells[0])))
    name = cells[0][column].partition(" ")[0]
    nothing = Mutant(None, (), new=int(kind))
    match kind:
        case 0 | 1 | 2:
            cell = cells[row][column] = str(rng.choice(CELLS))
            number = cell if cell.strip() and cell not in NUMBERS else None
            return written(cells), Mutant(None, (name,), old=1.0, new=number)
        case 3:
            cells[row][column] = repr(
                float(cells[row][column] or 0)
                * float(10.0 ** rng.uniform(-6, 6))
                * float(rng.choice([1, -1]))
            )
            return written(cells), Mutant(None, (name,), new=f"row {row + 1}: {cells[row][column]}")
        case 4:
            cells[0][column] = str(rng.choice(HEADINGS))
        case 5:
            for one in cells:
                del one[column]
        case 6:
            cells[row] = (
                cells[row][: int(rng.integers(1, len(cells[row])))]
                if rng.random() < 0.5
                else [*cells[row], "1"]
            )
        case 7:
            other = int(rng.integers(1, len(cells)))
            cells[row], cells[other] = cells[other], cells[row]
        case 8:
            return written(cells, delimiter=str(rng.choice([";", "\t", " ", "|"]))), nothing
        case 9:
            del cells[row : row + int(rng.integers(1, 40))]
        case 10:
            factor = float(10.0 ** rng.integers(-4, 5))
            for one in cells[1:]:
                one[column] = repr(float(one[column] or 0) * factor)
            return written(cells), Mutant(None, (name,), new=f"times {factor:g}")
        case 11:
            for one in cells[1:]:
                one[column] = ""
            return written(cells), Mutant(None, (name,), new="empty")
    return written(cells), nothing


def test_a_mutated_table_of_measurements(folder: Path, tally: Callable[[str], Tally]) -> None:
    line, rng, cells, path = (
        tally("tables of measurements"),
        random(3),
        table(),
        folder / "data.csv",
    )
    for i in range(count(3000)):
        if i % 4 < 3:
            data, changed = mutated_cells(cells, rng)
        else:
            data, changed = TEXTS[i // 4 % len(TEXTS)](written(cells), rng), Mutant(None, (), new=i)
        path.write_bytes(data)
        follow = one_run if i % 10 == 0 else None
        ask(line, "table", changed, lambda: measured.load([path], folder / "rig.toml"), follow)


def test_a_long_table_is_read_in_seconds(folder: Path, tally: Callable[[str], Tally]) -> None:
    """1e5 rows, at the example's 0.2 s: the estimate is of minutes, because dense samples are
    interpolated."""
    line, cells = tally("long tables"), table()
    numbers = np.array([[float(x) for x in row] for row in cells[1:]])
    t = np.linspace(numbers[0, 0], numbers[-1, 0], 100_000)
    columns = [np.interp(t, numbers[:, 0], one) for one in numbers.T]
    with (folder / "data.csv").open("w", newline="") as file:
        csv.writer(file).writerows([cells[0], *np.stack(columns, 1).tolist()])
    case = ask(
        line,
        "1e5 rows",
        Mutant(None, ()),
        lambda: measured.load([folder / "data.csv"], folder / "rig.toml"),
    )
    expected = cost(case.problem, 1e-3, 1, 1)
    line.held(expected.seconds < 600 and expected.memory < 0.5, f"1e5 rows: {expected.sentence}")


class Reader:
    """A process that reads trajectory files; a new one where one crashed or hung."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("reading.py"))], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, bufsize=1,
        )  # fmt: skip
        assert self._line(120.0) == "ready\n"

    def _line(self, limit: float) -> str:
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], limit)
        return self.process.stdout.readline() if ready else "hang"

    def ask(self, path: Path) -> dict[str, Any]:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{path}\n")
        said = self._line(LIMIT)
        if said == "hang":
            return {"raised": f"still busy after {LIMIT} s"}
        return (
            json.loads(said)
            if said
            else {"raised": f"the process ended with {self.process.wait()}"}
        )

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grasp of 60 ms on a coarse mesh."""
    p = Parameters().override({"pad.elements_x": 20, "pad.elements_y": 1, "contact.v_s": 0.05})
    motion = Excitation(motion=Strokes(), grasp_time=0.05, settle=0.0, depth=1e-3)
    model, y0 = begin(motion, p)
    path = tmp_path_factory.mktemp("runs") / "run.nc"
    simulate(model, torch.linspace(0, 0.06, 31, dtype=torch.float64), y0=y0, step=2e-3).save(path)
    return path


def remake(path: Path, content: bytes, rng: np.random.Generator) -> None:
    """Another well-formed file: an array missing, renamed, of another type, shape or unit, or with
    values that cannot be."""
    path.write_bytes(content)
    with h5py.File(path, "r+") as file:
        name = str(rng.choice([k for k in file if k != "axis"]))
        match rng.integers(6):
            case 0:
                del file[name]
            case 1:
                file.move(name, name + "_")
            case 2:
                file[name].attrs["units"] = "furlong"
            case 3:
                values = file[name][...].astype(np.float64)
                values[rng.integers(len(values))] = rng.choice([np.nan, np.inf, 1e308, -1.0, 1e3])
                file[name][...] = values
            case 4:
                values = file[name][...]
                del file[name]
                file[name] = values.astype("S8")
            case 5:
                del file[name]
                file[name] = np.zeros((3, 2, 2))
    path.write_bytes(sealed(path.read_bytes()))


def test_a_mutated_trajectory_file(
    trajectory: Path, tmp_path: Path, tally: Callable[[str], Tally]
) -> None:
    damaged, remade, others = (
        tally("trajectory files: damaged"),
        tally("trajectory files: remade"),
        tally("trajectory files: others"),
    )
    rng, path, whole, reader = random(4), tmp_path / "mutant.nc", trajectory.read_bytes(), Reader()
    same, content = reader.ask(trajectory), unsealed(trajectory)
    assert "read" in same, same

    def one(line: Tally, what: str, unharmed: bool) -> None:
        nonlocal reader
        said = reader.ask(path)
        if "raised" in said:
            reader.end()
            reader = Reader()
        if "refused" in said:
            line.held(
                sentence(said["refused"]) and "mutant.nc" in said["refused"], f"{what}: {said}"
            )
        else:
            line.held(
                "read" in said and said["finite"] and (not unharmed or said == same),
                f"{what}: {said}",
            )

    for i in range(count(1200)):
        path.write_bytes((cut, flip, flip, zeroed)[i % 4](whole, rng))
        one(damaged, f"damage {i}", unharmed=True)
    for i in range(count(600)):
        remake(path, content, rng)
        one(remade, f"remade {i}", unharmed=False)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["time"] = np.arange(5.0)
    foreign = (
        b"",
        b"CDF\x01",
        b"\x89HDF\r\n\x1a\n",
        b"PK\x03\x04",
        written(table()),
        (tmp_path / "other.h5").read_bytes(),
        bytes(1000),
    )
    for i, data in enumerate((*foreign, *map(sealed, foreign))):
        path.write_bytes(data)
        one(others, f"file {i}", unharmed=False)
    reader.end()


def test_every_column_can_be_read(trajectory: Path) -> None:
    assert set(read_table(trajectory).values) == set(COLUMNS)
