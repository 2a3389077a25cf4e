"""Measured data: what is read is what was written, every mistake is named with its place, and the
command continues."""

import csv
import math
import re
import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, get_args, get_origin

import numpy as np
import pytest
import torch
import xarray as xr
from conftest import PAPER, paper

from torchsoft.csvfile import UNITS
from torchsoft.physics.channels import measurable
from torchsoft.physics.contact import Coulomb
from torchsoft.physics.material import StandardLinearSolid
from torchsoft.solve.formats import save
from torchsoft.sysid import Sensor, Unknown, record
from torchsoft.sysid.columns import read_table
from torchsoft.sysid.identification import Settings
from torchsoft.sysid.initial_state import MovingStart, StartCoordinate
from torchsoft.sysid.measured import STATED, cost, load, stem, vocabulary

EXAMPLE = Path(__file__).parent.parent / "examples" / "identify"

CONFIG = """
rig = "paper"
[settings]
laws.steel_on_rubber.friction.v_s = 0.05
actuators.x.measures = "bracket.x"
bodies.disc.start.x = 60.3e-3
bodies.bracket.start.x = 60.3e-3

[unknowns."laws.steel_on_rubber.K_n"]
nominal = 1e5
[unknowns."materials.rubber.E"]
nominal = 0.7e6

[sensors]
x_C.noise = 10e-6
y_Br.noise = 10e-6
F_y.noise = 0.1

[fit]
rtol = 1e-3
"""

SIGNALS = ("x_d", "y_d", "F_ff")
LAW = "laws.steel_on_rubber"
SOLID = (
    'materials.rubber = {kind = "standard_linear_solid", E = 0.75e6, E_instant = 2e6, nu = 0.45, '
    "tau = 10e-3, depth = 44e-3}\n"
)
COULOMB = f"""[compare.coulomb.settings]
{LAW}.friction = {{kind = "coulomb", mu_s = 0.8, mu_k = 0.7}}
"""
KNOWN = vocabulary(PAPER.assemble(), {})
MEASURED = measurable(PAPER.assemble())


def series(kind: str, strengths: str) -> str:
    """The setting of a material of several retardation times."""
    return (
        f'materials.rubber = {{kind = "{kind}", E = 0.75e6, nu = 0.45, {strengths}, tau = [2e-3, '
        "0.01], depth = 44e-3}\n"
    )


Table = list[list[str]]
Change = Callable[[Table], object]


@pytest.fixture(scope="module")
def example():
    """Cells of the first 0.3 s of the example, with its heading."""
    with (EXAMPLE / "rolling.csv").open(newline="") as file:
        return list(csv.reader(file))[:62]


def write(path: Path, table: Table) -> Path:
    path.write_text("\n".join(",".join(cells) for cells in table) + "\n")
    return path


@pytest.fixture
def case(example, tmp_path):
    """Writes the example, changed, and a configuration; gives the paths."""

    def make(change: Change = lambda table: None, config: str = CONFIG) -> list[str]:
        table = [list(cells) for cells in example]
        change(table)
        (tmp_path / "rig.toml").write_text(config)
        return [str(write(tmp_path / "data.csv", table)), str(tmp_path / "rig.toml")]

    return make


@pytest.fixture
def loaded(case):
    """Loads the example, changed, with a configuration."""

    def load_case(*given: Any, **named: Any) -> Any:
        data, config = case(*given, **named)
        return load([data], config)

    return load_case


def put(row: int, column: int, text: str) -> Change:
    """Replace a cell; the heading is row 1 and the time column 0."""
    return lambda table: table[row - 1].__setitem__(column, text)


def scale(column: int, factor: float, offset: float = 0.0, since: int = 2) -> Change:
    def change(table: Table) -> None:
        for cells in table[since - 1 :]:
            cells[column] = repr(float(cells[column]) * factor + offset)

    return change


def drop(column: int) -> Change:
    return lambda table: [cells.pop(column) for cells in table]


T, X_D, Y_D, Y_D_DOT, F_FF, X_C, THETA, X_BR, Y_BR, F_X, F_Y = 0, 1, 3, 4, 5, 6, 7, 8, 9, 10, 11

BAD: dict[str, tuple[Change, str]] = {
    "no unit": (put(1, X_C, "x_C"),
        r"data\.csv, row 1, column `x_C` has no unit: write `x_C \[m\]`"),
    "wrong dimension": (put(1, THETA, "theta [mm]"),
        r"row 1, column `theta` cannot be in 'mm'; it can be in rad"),
    "unknown column": (
        put(1, X_C, "x_c [mm]"),
        r"`x_c` is not known: did you mean `x_C`\?.* ignore = \['x_c'\]; .*columns are t, x_d",
    ),
    "another column": (put(1, X_C, "Ventil"),
        r"column `Ventil` is not known; if it has nothing to do with the motion, say"),
    "column twice": (put(1, X_C, "x_Br [mm]"), r"row 1, column `x_Br` is there twice"),
    "no sensor": (put(1, X_C, "v_x [um/s]"),
        r"rig\.toml: sensors: no recording has samples of `x_C`"),
    "a cell too many": (lambda table: table[6].append("1"),
        r"row 7 has 13 cells, but there are 12 columns"),
    "text": (put(9, X_C, "n/a"), r"data\.csv, row 9, column `x_C`: 'n/a' is not a finite number; "
                                 r"leave the cell empty"),
    "nan": (put(9, F_Y, "NaN"), r"row 9, column `effort_y`: 'NaN' is not a finite number"),
    "digits of another script": (put(9, F_Y, "１２"),
        r"row 9, column `effort_y`: '１２' is not a finite number"),
    "times beyond their digits": (scale(T, 1.0, 5e12),
        r"row 3, column `t`: 5e\+12 s is too far from zero .*; count times from"),
    "empty time": (put(12, T, ""), r"row 12, column `t` is empty; only measured channels may have "
                                   r"gaps"),
    "empty set-point": (put(12, Y_D, " "), r"row 12, column `y_d` is empty"),
    "time twice": (put(12, T, "0.045"),
        r"row 12, column `t`: the time 0.045 s is there twice: delete one of the two rows"),
    "time goes back": (put(12, T, "0.01"),
        r"row 12, column `t`: time goes back, from 0.045 to 0.01 s: sort the rows by time"),
    "rows missing": (lambda table: table.__delitem__(slice(10, 40)),
        r"row 11, column `t`: 0.155 s are missing before it"),
    "few rows": (lambda table: table.__delitem__(slice(8, None)),
        r"has 7 rows of numbers, but needs at least 10"),
    "mm under m": (put(1, X_C, "x_C [m]"),
        r"row 2, column `x_C`: 60.3 m is not plausible, .* between -1.2 and 1.2 m, 10 times as f"
        r"ar as the rig reaches; is the unit in the heading right\?"),
    "a force in mN": (scale(F_Y, 1e3),
        r"row \d+, column `effort_y`: .* between -1e\+04 and 1e\+04 N"),
    "another start": (scale(X_C, 1.0, 5.0),
        r"row 2, column `x_C`: it begins at 0.065\d* m, but the rig file at 0.0603 m; say so"),
    "another sign": (scale(X_C, -1.0),
        r"it begins at -0.0603\d* m, but the rig file at 0.0603 m; is its sign opposite\?"),
    "turned already": (scale(THETA, 1.0, 500.0),
        r"row 2, column `theta_C`: it begins at 0.49\d* rad, but the rig file at 0 rad"),
    "another ground": (scale(Y_BR, 1.0, 3.0),
        r"row 2, column `y_Br`: it begins at .*, but the rig file at 0\.04999"),
    "moving": (
        lambda table: [cells.__setitem__(X_C, f"{60.3 + 0.3 * i}") for i,
        cells in enumerate(table[1:])],
        r"row 3, column `x_C` moves already, by 0.0003 m: a recording must begin at rest,.* or say "
        r"start = \{kind = \"moving\"\}",
    ),
    "degrees under radians": (
        lambda table: [scale(THETA, 0.18 / math.pi)(table), put(1, THETA, "theta [rad]")(table)],
        r"column `theta_C` moves already, by .* rad: is its unit right \(degrees taken for radians",
    ),
    "turning": (
        lambda table: [cells.__setitem__(THETA, f"{15.0 * i}") for i,
        cells in enumerate(table[1:])],
        r"row 3, column `theta_C` moves already",
    ),
    "asked to move": (
        lambda table: [cells.__setitem__(X_D, f"{60.3 + 0.3 * i}") for i,
        cells in enumerate(table[1:])],
        r"row 3, column `x_d` moves already",
    ),
    "in the grasp": (
        lambda table: [scale(k, 1.0, -0.6)(table) for k in (Y_D, Y_BR)],
        r"row 2, column `y_d`: it begins at 0.0493\d* m, but the rig file at 0\.04999",
    ),
    "one sample": (
        lambda table: [cells.__setitem__(X_C, "") for cells in table[2:]],
        r"column `x_C` has 1 samples, but needs at least two",
    ),
}  # fmt: skip


BAD_CONFIG = {
    "no rig": (CONFIG.replace("rig =", "title ="),
        r'rig\.toml: rig is missing: say rig = "FILE.toml".*, such as "paper"'),
    "no ready rig": (CONFIG.replace('"paper"', '"papyrus"'),
        r"rig\.toml, rig: .*papyrus: No such file or directory; the ready rigs are .*, paper, "),
    "a short name as a table": (CONFIG.replace("actuators.x.measures", "control.senses"),
        r"rig\.toml, recording `data`: settings: `control` is not known .* mean `controllers`"),
    "the paper's pads": (CONFIG + '[pads]\nkind = "kelvin_voigt"\n',
        r"pads is not known: .* material of the rig file: say \[settings\.materials\.NAME\]"),
    "a law's pads": (CONFIG + '[compare.solid.pads]\nkind = "kelvin_voigt"\n',
        r"pads is not known: .* say \[settings\.materials\.NAME\]"),
    "a constant": (CONFIG + "[missing]\nF_ff = 0.0\n",
        r"missing is not known: .* follows the rig file: say \[settings\.motion\.NAME\]"),
    "not TOML": (CONFIG + "[[", r"rig\.toml is not a TOML file"),
    "unknown table": (CONFIG + "[sensor]\n",
        r"rig\.toml: `sensor` is not known here; did you mean `sensors`"),
    "unknown key": (CONFIG.replace("y_Br.noise", "y_Br.sigma"),
        r"sensors\.y_Br: `sigma` is not known here"),
    "no noise": (CONFIG.replace("F_y.noise = 0.1", "F_y.noise = 0.0"),
        r"sensors\.F_y\.noise should be .* 1e-15, not 0\.0"),
    "unknown channel": (CONFIG.replace("F_y.noise", "F_z.noise"),
        r"rig\.toml: sensors: `F_z` is not a channel"),
    "unknown parameter": (CONFIG.replace("rubber.K_n", "rubber.K"),
        r"rig\.toml: unknowns: `laws.steel_on_rubber.K` cannot be identified"),
    "unknown setting": (CONFIG.replace("friction.v_s", "friction.vs"),
        r"recording `data`: settings: .*friction: `vs` is not known here; did you mean `v_s`"),
    "not a table": (
        re.sub(r"bodies\..*\n", "", CONFIG).replace("actuators", "bodies = 3\nactuators"),
        r"`data`: settings.*bodies should be a table, not 3"),
    "other pads": (CONFIG.replace("bodies.disc", "pads.L.height = 3e-3\nbodies.disc", 1),
        r"column `y_d`: it begins at 0.0499\d* m, but the rig file at 0\.0484"),
    "nothing to fit": ('heldout = ["data"]\n' + CONFIG, r"heldout: it names every recording"),
    "a long delay": (CONFIG + "[sensors.theta]\nnoise = 1e-3\ndelay = 0.5\n",
    r"sensors\.theta\.delay should be less than"),
    "no such column": ('ignore = ["Temp"]\n' + CONFIG,
        r"rig\.toml, ignore: no file has a column `Temp`"),
    "another kind of start": (CONFIG + '[start]\nkind = "flying"\n',
        r"start\.kind should be one of 'rest', 'moving', not 'fl"),
    "a start that is hardly uncertain": (
        CONFIG + '[start]\nkind = "rest"\nposition_sd = {"disc.x" = 1e-300}\n',
        r"start\.position_sd\.disc\.x: should be 0, or at least 1e-12, but is 1e-300",
    ),
    "a start of nothing": (
        CONFIG + '[start]\nkind = "rest"\nposition_sd = {"disk.x" = 1e-3}\n',
        r"`position_sd` of the start speaks of `disk.x`; did you mean `disc.x`",
    ),
    "a start by a number": (
        CONFIG + '[start]\nkind = "rest"\nposition_sd = 1e-3\n',
        r"start\.position_sd should be a table, not 0\.001",
    ),
    "soft at first": (
        CONFIG.replace("bodies.disc", SOLID.replace("2e6", "1e5") + "bodies.disc", 1),
        r"rig\.toml, recording `data`: settings.*materials\.rubber.*E_instant",
    ),
    "more than all": (
        CONFIG.replace("bodies.disc", series("generalised_kelvin", "J = [0.8, 0.5]")
        + "bodies.disc", 1),
        r"materials\.rubber.*the fractions J sum to 1\.3, above one",
    ),
    "laws without likelihood": (
        CONFIG + 'loss = "huber"\n' + COULOMB,
        r"compare needs likelihoods: fit\.loss must be 'linear', not 'huber'",
    ),
    "without what is not there": (
        CONFIG + '[compare.coulomb]\nwithout = ["laws.steel_on_rubber.R_t"]\n',
        r"compare\.coulomb\.without: `laws\.steel_on_rubber\.R_t` is not an unknown",
    ),
    "a law's own mistake": (
        CONFIG + f'[compare.coulomb.unknowns."{LAW}.friction.v_s"]\nlow = -1.0\nscale = "linear"\n'
                 'high = 1.0\n',
        r"rig\.toml, compare\.coulomb: unknowns\.laws\.steel_on_rubber\.friction\.v_s\.low = -1 is "
        r"beyond what laws\.steel_on_rubber\.friction\.v_s may be",
    ),
    "a law of the same name": (
        CONFIG + '[compare."as stated"]\n',
        r"compare: the law of the file itself is called `as stated`",
    ),
    "file and files": (
        CONFIG + '[[recordings]]\nfile = "b.csv"\nfiles = ["c.csv"]\n',
        r"recordings\.0: .*a `file` or `files`, not both",
    ),
    "held out": ('heldout = ["other"]\n' + CONFIG,
        r"heldout: there is no recording `other`; the recordings' names are data"),
    "no such file": (
        CONFIG + '[[recordings]]\nname = "b"\nfiles = ["b.csv"]\n',
        r"rig\.toml, recordings: `files` of `b`: .*b\.csv: No such file or directory",
    ),
    "nameless": (CONFIG + "[[recordings]]\n", r"recordings\.0: a recording needs a `file`"),
    "a setting that is unknown": (
        CONFIG + '[[recordings]]\nname = "data"\nsettings.materials.rubber.E = 2e6\n',
        r"recordings\.0\.settings: materials\.rubber\.E is unknown, .* leave it out there, and say "
        r"by unknowns\.\"materials\.rubber\.E\"\.nominal where",
    ),
    "same name": (CONFIG + '[[recordings]]\nfile = "data.csv"\n',
        r"names of their own, but are called data, data"),
}  # fmt: skip


def test_the_table_of_keys_has_every_key_with_its_values():
    """Numbers as such or by their unit, texts and truth values by those that are allowed."""
    text = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    for table in (Unknown, Sensor, Settings):
        for name, field in table.model_fields.items():
            assert f"`{name}`" in text or f"`{name} = " in text, name
            if get_origin(field.annotation) is Literal:
                assert all(f'"{value}"' in text for value in get_args(field.annotation)), name
    assert "`fixed` (true or false" in text


@pytest.mark.parametrize("name", [*BAD, *BAD_CONFIG])
def test_a_mistake_is_named_with_its_row_and_column_or_its_field(loaded, name):
    change, message = BAD.get(name, (lambda table: None, ""))
    config, message = BAD_CONFIG.get(name, (CONFIG, message))
    with pytest.raises(ValueError, match=message):
        loaded(change, config)


def test_empty_cells_are_missing_samples(case):
    def change(table: Table) -> None:
        for row in (5, 6, 40):
            table[row - 1][X_C] = ""
        table.insert(20, [])  # a blank line counts as a row, not as data

    data, config = case(change)
    made = load([data], config)
    (one,) = made.problem.recordings
    t, x = one.samples["x_C"]
    assert len(one.samples["effort_y"][0]) == 61
    assert len(x) == 58
    assert not {0.015, 0.02} & set(t)
    assert made.tables["data"].near(0.2) == f"{data}, row 43 (t = 0.2 s)"


@pytest.mark.parametrize("name", sorted({*SIGNALS, *MEASURED, "theta", "F_x"}))
def test_every_unit_is_understood(tmp_path, name):
    for unit, factor in UNITS[KNOWN.units[KNOWN.full(name)]].items():
        table = [["t [ms]", "x_d [m]", "y_d [m]"]] + [
            [str(5 * i), "0.06", "0.05"] for i in range(10)
        ]
        if name in ("x_d", "y_d"):
            table = [
                cells[:1] + [c for c, h in zip(cells[1:], ("x_d", "y_d")) if h != name]
                for cells in table
            ]
        table = [
            [*cells, f"{name} [{unit}]" if i == 0 else repr(0.03 / factor)]
            for i, cells in enumerate(table)
        ]
        read = read_table(write(tmp_path / "units.csv", table), (), KNOWN)
        np.testing.assert_allclose(read.values[KNOWN.full(name)], 0.03, rtol=1e-14)
        np.testing.assert_allclose(read.values["t"], 5e-3 * np.arange(10), rtol=1e-14)


@pytest.fixture(scope="module")
def made():
    """The example's own script, and a short recording."""
    script = SimpleNamespace(**runpy.run_path(str(EXAMPLE / "make.py")))
    sensors = {channel: Sensor(noise=1e-5) for channel in MEASURED}
    strokes = {"kind": "strokes", "travel": 4e-3, "stroke_time": 0.15, "since": 0.15}
    short = script.NOMINAL.override({"motion.x_d": strokes}, outputs={"duration": 0.4}).build()
    return script, record("short", short, script.TRUTH, sensors, rtol=1e-4)


def test_a_recording_survives_the_way_through_csv(made, tmp_path):
    script, one = made
    script.UNITS["rad/s"] = ("deg/s", 180 / np.pi)
    script.write(one, tmp_path / "short.csv", digits=17)
    (tmp_path / "fit.toml").write_text(CONFIG)
    (back,) = load([tmp_path / "short.csv"], tmp_path / "fit.toml").problem.recordings
    assert back.name == one.name
    assert set(back.samples) == set(one.samples) == set(MEASURED)
    for channel, (t, y) in one.samples.items():
        np.testing.assert_allclose(back.samples[channel][0], t, rtol=0, atol=1e-12)
        np.testing.assert_allclose(back.samples[channel][1], y, rtol=1e-13)
    t = torch.from_numpy(np.linspace(-0.1, 0.5, 1201))
    with torch.no_grad():
        want, got = (some.rig.reference(t, SIGNALS).flatten(1).T for some in (one, back))
    for exact, read, tolerance in zip(want, got, (2e-8, 2e-5, 1e-8, 1e-5, 0.02)):
        assert float((read - exact).abs().max()) < tolerance


def test_the_examples_files_are_what_its_script_makes(made):
    script, _ = made
    case = load([EXAMPLE / "rolling.csv"], EXAMPLE / "rolling.toml")
    assert case.problem.names == ("rolling", "checking")
    rig = case.problem.recordings[0].rig
    noises = {rig.full(name): noise for name, noise in script.SENSORS.items()}
    assert {name: one.noise for name, one in case.problem.sensors.items()} == noises
    own = script.NOMINAL.override(script.TRUTH).assemble()
    text = (EXAMPLE / "README.md").read_text()
    truth, stated = (one.description()["parameters"] for one in (own, rig))
    for name in case.problem.unknowns:  # the file tells the truth, but for what is unknown
        assert re.search(rf"`{re.escape(name)}` +\| +{truth.pop(name):g} ", text), name
    assert truth.items() <= stated.items()
    for name, pad in own.pads.items():
        assert torch.equal(pad.positions, rig.pads[name].positions)
    for file in EXAMPLE.glob("*.csv"):
        assert file.stat().st_size < 150e3


@pytest.fixture(scope="module")
def run():
    """A grasp of 60 ms."""
    strokes = {"kind": "strokes", "travel": 5e-3, "stroke_time": 0.3, "since": 0.05}
    changes = {
        "contact.v_s": 0.05, "control.senses": "bracket.x", "bodies.disc.start.x": 60.3e-3,
        "bodies.bracket.start.x": 60.3e-3, "motion.x_d": strokes, "motion.y_d.times": [0.0, 0.05],
        "motion.y_d.values": ["start", 49.1e-3], "motion.F_ff.times": [0.0, 0.05],
        "motion.F_ff.values": [0.0, "held"],
    }  # fmt: skip
    return paper(changes).run(torch.linspace(0, 0.06, 31, dtype=torch.float64), step=2e-3)


def test_a_trajectory_file_is_a_recording(run, tmp_path):
    run.save(tmp_path / "run.nc")
    (tmp_path / "fit.toml").write_text(CONFIG)
    (one,) = load([tmp_path / "run.nc"], tmp_path / "fit.toml").problem.recordings
    assert set(one.samples) >= set(MEASURED)
    for channel in MEASURED:
        np.testing.assert_array_equal(one.samples[channel][1], run[channel].detach())
    desired = run.together("x_d", "x_d_dot", "y_d", "y_d_dot", "F_ff")
    with torch.no_grad():
        got = one.rig.reference(run.t, SIGNALS).flatten(1)[:, :5]
    np.testing.assert_allclose(got, desired, atol=1e-12)
    older = tmp_path / "older.nc"  # without the rate of y_d
    save(run.to_xarray().drop_vars("y_d_dot"), older)
    (again,) = load([older], tmp_path / "fit.toml").problem.recordings
    with torch.no_grad():
        got = again.rig.reference(run.t, SIGNALS)[:, 1, 1]
    np.testing.assert_allclose(got, desired[:, 3], atol=2e-4)


def not_finite(data: xr.Dataset) -> xr.Dataset:
    data["theta_C"][7] = np.nan
    return data


def in_degrees(data: xr.Dataset) -> xr.Dataset:
    data["theta_C"].attrs["units"] = "deg"
    return data


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: xr.Dataset({"time": ("time", [0.0, 1.0])}),
         r"is not a trajectory file of this rig: it has no time and channels"),
        (not_finite, r", sample 7, `theta_C` is not a finite number"),
        (in_degrees, r", `theta_C` should be in rad, not 'deg'"),
        (lambda data: data.assign(x_d=("time", ["here"] * 31)),
         r"is not a trajectory file: `x_d` should be float64 over time"),
        (lambda data: data.isel(time=[0, 1, 2, 2, *range(3, 31)]),
         r", sample 3, column `t`: the time 0.004 s is there twice"),
        (None, "has no checksum at its end"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_trajectory_file_is_named(run, tmp_path, change, message):
    path = tmp_path / "bad.nc"
    if change is None:
        path.write_text("not a file of this kind")
    else:
        save(change(run.to_xarray().copy(deep=True)), path)
    with pytest.raises(ValueError, match=rf"bad\.nc ?{message}"):
        read_table(path, (), KNOWN)


def test_samples_much_denser_than_the_motion_are_not_all_simulated(
    loaded,
):
    (one,) = loaded().problem.recordings
    t, x = one.samples["x_C"]
    dense = np.linspace(t[0], t[-1], 20_001)
    many = replace(one, samples={"x_C": (dense, np.interp(dense, t, x))})
    grid = many.grid(False).t.numpy()
    assert len(grid) < 600
    assert grid[1] <= dense[0] < dense[-1] <= grid[-1]
    np.testing.assert_array_equal(one.grid(False).t[1:], one.times)
    irregular = np.sort(np.random.default_rng(0).uniform(t[0], t[-1], 100))
    few = replace(one, samples={"x_C": (irregular, np.interp(irregular, t, x))})
    np.testing.assert_array_equal(few.grid(False).t[1:], irregular)
    between = one.grid(True).t.numpy()  # begins after the disc has begun to settle
    assert np.all(np.diff(between) > 0)


def test_a_long_identification_is_priced(loaded):
    made = loaded().problem
    assert cost(made, 1e-3, 1, 1).seconds < 60
    assert cost(made, 1e-3, 1_000_000, 1).seconds > 1e5
    assert cost(made, 1e-8, 1, 1).seconds > 3 * cost(made, 1e-5, 1, 1).seconds
    delayed = loaded(config=CONFIG + "[sensors.theta]\nnoise = 1e-3\ndelay = 2e-3\n").problem
    assert cost(delayed, 1e-5, 1, 1, method="adam").memory > cost(delayed, 1e-5, 1, 1).memory


def test_recordings_have_settings_of_their_own(case, tmp_path):
    more = (
        '[[recordings]]\nname = "data"\nsettings.bodies.disc.mass = 0.5\n'
        '[[recordings]]\nfile = "second.csv"\nname = "b"\n'
    )
    data, config = case(config=CONFIG + more)
    (tmp_path / "second.csv").write_text(Path(data).read_text())
    first, second = load([data], config).problem.recordings
    mass, v_s = "bodies.disc.mass", f"{LAW}.friction.v_s"
    assert (first.name, first.parameters[mass]) == ("data", 0.5)
    assert (second.name, second.parameters[mass]) == ("b", PAPER.bodies["disc"].mass)
    assert first.parameters[v_s] == second.parameters[v_s] == 0.05


def test_a_name_is_the_same_where_the_system_knows_ascii_only():
    """Which gives Python the bytes of a file's name one by one."""
    assert stem(Path("a/größe.csv")) == stem(Path("a/gr\udcc3\udcb6\udcc3\udc9fe.csv")) == "größe"
    assert stem(Path("a/\udcff.csv")) == "�"


def test_columns_may_stand_in_any_order_beside_others(loaded):
    def change(table: Table) -> None:
        for i, cells in enumerate(table):
            cells.reverse()
            cells.insert(3, "Temp [K]" if i == 0 else "warm")

    plain = loaded().problem.recordings[0]
    one = loaded(change, 'ignore = ["Temp"]\n' + CONFIG).problem.recordings[0]
    assert one.fingerprint == plain.fingerprint


def test_a_laboratorys_headings_stand_for_ours(loaded):
    def change(table: Table) -> None:
        at = next(i for i, cell in enumerate(table[0]) if cell.startswith("x_C "))
        table[0][at] = table[0][at].replace("x_C", "Disc x")

    plain = loaded().problem.recordings[0]
    one = loaded(change, 'columns."Disc x" = "x_C"\n' + CONFIG).problem.recordings[0]
    assert one.fingerprint == plain.fingerprint
    with pytest.raises(ValueError, match="x_D' is no channel of the rig; did you mean"):
        loaded(change, 'columns."Disc x" = "x_D"\n' + CONFIG)


@pytest.mark.parametrize("stated", ["", 'columns.camera = "theta"\n', 'ignore = ["theta"]\n'])
def test_short_names_stand_for_columns_settings_and_unknowns(loaded, stated):
    """In the data, in every table of the configuration, and for each other."""

    def change(table: Table) -> None:
        if "columns" in stated:
            table[0][THETA] = "camera [mrad]"
        table[0][F_Y] = "effort_y [N]"

    text = CONFIG.replace(f"{LAW}.friction.v_s = 0.05", '"contact.v_s" = 0.05')
    text = text.replace("actuators.x.measures", '"control.senses"')
    text = text.replace(f"{LAW}.K_n", "contact.K_n")
    more = '[compare.stiff]\nwithout = ["laws.steel_on_rubber.K_n"]\nsettings."pad.E" = 2e6\n'
    made = loaded(change, stated + text + more)
    (plain,), (one,) = (case.problem.recordings for case in (loaded(), made))
    assert one.samples.keys() == plain.samples.keys() - ({"theta_C"} if "ignore" in stated else ())
    assert one.parameters == plain.parameters
    assert list(made.problem.unknowns) == [f"{LAW}.K_n", "materials.rubber.E"]
    assert list(made.laws["stiff"].unknowns) == ["materials.rubber.E"]
    assert made.laws["stiff"].recordings[0].parameters["materials.rubber.E"] == 2e6
    known = '[[recordings]]\nname = "data"\nsettings."contact.K_n" = 2e5\n'
    with pytest.raises(ValueError, match=r"toml: recordings\.0\.settings: contact\.K_n is unknown"):
        loaded(change, stated + text + known)


def test_a_motion_of_the_file_stands_for_a_column_that_is_missing(loaded):
    own = '[[recordings]]\nname = "data"\nsettings.motion.F_ff.values = [-2.5, -2.5]\n'
    none = CONFIG.replace("bodies.disc", "motion.F_ff.values = [0.0, 0.0]\nbodies.disc", 1)
    for text, force in ((none, 0.0), (none + own, -2.5)):
        (one,) = loaded(drop(F_FF), text).problem.recordings
        at = one.rig.reference(torch.tensor([0.0, 0.1], dtype=torch.float64), ("F_ff",))
        np.testing.assert_array_equal(at[:, 0].detach(), [[force, 0.0]] * 2)


def parts(table: Table, *columns: list[int]) -> list[Table]:
    """Tables of some columns each."""
    return [[[cells[i] for i in chosen] for cells in table] for chosen in columns]


def test_a_recording_may_stand_in_several_files(example, tmp_path):
    asked, camera, force = parts(
        example, [T, X_D, 2, Y_D, Y_D_DOT, F_FF], [T, X_C, THETA], [T, X_BR, Y_BR, F_X, F_Y]
    )
    slow = [camera[0], *camera[1::4]]
    for name, one in (("asked", asked), ("camera", slow), ("force", force)):
        write(tmp_path / f"{name}.csv", one)
    text = (
        CONFIG + '[[recordings]]\nname = "roll"\nfiles = ["asked.csv", "camera.csv", "force.csv"]\n'
    )
    (tmp_path / "rig.toml").write_text(text)
    made = load([], tmp_path / "rig.toml")
    (one,) = made.problem.recordings
    assert one.name == "roll"
    assert {channel: len(t) for channel, (t, _) in one.samples.items()} == {
        "x_C": 16, "theta_C": 16, "x_Br": 61, "y_Br": 61, "effort_x": 61, "effort_y": 61,
    }  # fmt: skip
    assert made.tables["roll"].near(0.1) == f"{tmp_path / 'asked.csv'}, row 22 (t = 0.1 s)"

    for cells in (late := [list(row) for row in slow])[1:]:
        cells[0] = str(float(cells[0]) + 5.0)
    write(tmp_path / "camera.csv", late)
    with pytest.raises(
        ValueError,
        match=r"camera\.csv, row 17, column `t`: 5\.3 s is 5 s outside the times of `x_d`, which "
        r"ends",
    ):
        load([], tmp_path / "rig.toml")
    write(tmp_path / "camera.csv", parts(example, [T, X_C, F_X])[0])
    with pytest.raises(
        ValueError,
        match=r"`effort_x` is in .*camera\.csv and in .*force\.csv: one recording has it once",
    ):
        load([], tmp_path / "rig.toml")
    (tmp_path / "camera.csv").write_text(
        "t [s],x_d_dot [mm/s]\n" + "".join(f"{0.01 * i},0\n" for i in range(20))
    )
    write(tmp_path / "asked.csv", parts(example, [T, X_D, Y_D, F_FF])[0])
    with pytest.raises(ValueError, match=r"the columns `x_d` and `x_d_dot` must be in one file"):
        load([], tmp_path / "rig.toml")


def test_a_file_may_state_everything_that_a_problem_can_have(
    loaded,
):
    text = CONFIG.replace(
        f'[unknowns."{LAW}.K_n"]\nnominal = 1e5',
        f'[unknowns."{LAW}.K_n"]\nnominal = 1e5\nper = "recording"\nprior = {{median = 1e5, sd = '
        f'0.3, kind = "log-normal"}}\n[unknowns."{LAW}.friction.mu_k"]\nratio_to = '
        f'"{LAW}.friction.mu_s"\nnominal = 0.9\nhigh = 1.0',
    ).replace(
        "F_y.noise = 0.1",
        'F_y = {noise = 0.1, gain = 0.02, drift = 0.1, inertia = 0.4, per = "recording", colour = '
        '"ar"}\n'
        "F_x = {noise = 0.1, misalignment = 0.01, low = -50.0, high = 50.0}",
    )
    text = text.replace("[settings]", "[settings]\ngravity = 9.8\nactuators.y.Kp = 1.1e5")
    made = loaded(config=text + '[start]\nkind = "rest"\nposition_sd = {"disc.x" = 1e-4}\n').problem
    (one,) = made.recordings
    stated = {"gravity": 9.8, "actuators.y.Kp": 1.1e5, f"{LAW}.friction.v_s": 0.05}
    assert {name: one.parameters[name] for name in stated} == stated
    assert one.start_coordinates == (StartCoordinate("start.disc.x", 60.3e-3, 1e-4),)
    labels = (
        f"{LAW}.K_n in data", f"{LAW}.friction.mu_k / {LAW}.friction.mu_s", "materials.rubber.E",
        "start.disc.x in data",
        "gain of effort_y in data", "drift of effort_y in data", "inertia of effort_y in data",
        "misalignment of effort_x",
    )  # fmt: skip
    assert sorted(made.coordinates.labels) == sorted(labels)
    assert len(made.coordinates.priors) == 2
    assert made.sensors["effort_y"].colour == "ar"
    assert made.sensors["effort_x"].high == 50.0


def test_a_recording_may_begin_anywhere_if_that_is_said(loaded):
    """Cut from the middle of the grasp."""

    def cut(table: Table) -> None:
        del table[1:31]

    sensors = CONFIG.replace("F_y.noise", "theta.noise = 0.5e-3\nx_Br.noise = 10e-6\nF_y.noise")
    with pytest.raises(
        ValueError, match=r"data\.csv, row 2, column `\w+`.* or say start = \{kind = \"moving\"\}"
    ):
        loaded(cut, sensors)
    text = (
        sensors
        + '[start]\nkind = "moving"\nlead = 40e-3\ngiven = {"disc.y" = {mean = 23.5e-3, sd = '
        "1e-4}}\n"
    )
    (one,) = loaded(cut, text).problem.recordings
    assert isinstance(one.start, MovingStart)
    assert one.start.lead == pytest.approx(0.04, abs=6e-3)
    assert one.start.bodies["disc.y"] == (23.5e-3, 1e-4)
    priced = cost(loaded(cut, text).problem, 1e-3, 1, 1)
    plain = cost(loaded(config=sensors).problem, 1e-3, 1, 1)
    assert (
        priced.seconds / priced.steps > 2 * plain.seconds / plain.steps
    )  # of many more coordinates
    assert one.start.bodies["disc.x"][0] == pytest.approx(60.5e-3, abs=5e-4)
    with pytest.raises(ValueError, match=r"rig\.toml, recording `data`: .*disc\.z"):
        loaded(cut, text.replace("disc.y", "disc.z"))


def test_competing_laws_have_the_same_data(loaded):
    text = CONFIG + (
        f'[unknowns."{LAW}.friction.v_s"]\n{COULOMB}[compare.coulomb]\nwithout = '
        f'["{LAW}.friction.v_s"]\n[compare.solid]\nsettings.{SOLID}'
        'unknowns."materials.rubber.E_instant" = {ratio_to = "materials.rubber.E", low = 1.01, '
        "high = 20.0}\n"
    )
    made = loaded(config=text)
    assert list(made.laws) == [STATED, "coulomb", "solid"]
    assert made.laws[STATED] is made.problem
    both = [f"{LAW}.K_n", "materials.rubber.E"]
    assert {name: list(law.unknowns) for name, law in made.laws.items()} == {
        STATED: [*both, f"{LAW}.friction.v_s"],
        "coulomb": both,
        "solid": [*both, f"{LAW}.friction.v_s", "materials.rubber.E_instant"],
    }
    rigs = {name: law.recordings[0].rig for name, law in made.laws.items()}
    assert isinstance(rigs["coulomb"].contacts["L"].law.friction, Coulomb)
    assert isinstance(rigs["solid"].pads["U"].material, StandardLinearSolid)


@pytest.mark.parametrize(
    ("kind", "strengths", "first", "bound"),
    [
        ("prony", "moduli = [2e5, 1e5]", "moduli_1", ""),
        ("generalised_kelvin", "J = [0.3, 0.2]", "J_1", "\nhigh = 0.7"),
    ],
)
def test_pads_may_be_of_any_series(loaded, kind, strengths, first, bound):
    """Of the relaxed modulus; their coefficients may be unknown."""
    config = CONFIG.replace(
        f'[unknowns."{LAW}.K_n"]\nnominal = 1e5', f'[unknowns."materials.rubber.{first}"]{bound}'
    ).replace("bodies.disc", series(kind, strengths) + "bodies.disc", 1)
    problem = loaded(config=config).problem
    assert set(problem.unknowns) == {f"materials.rubber.{first}", "materials.rubber.E"}
    one = problem.recordings[0]
    assert one.rig.pads["L"].material.branches == 3
    assert one.rig.pads["L"].material.E.item() == one.parameters["materials.rubber.E"]
