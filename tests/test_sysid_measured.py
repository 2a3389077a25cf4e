"""Measured data: what is read is what was written, and every mistake is named with its place."""

import csv
import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from conftest import IDENTIFIED as CONFIG
from conftest import PAPER, paper

from torchsoft.physics.channels import measurable
from torchsoft.physics.contact import Coulomb
from torchsoft.physics.material import StandardLinearSolid
from torchsoft.solve.netcdf import save
from torchsoft.sysid import MovingStart
from torchsoft.sysid.columns import read_table
from torchsoft.sysid.measured import STATED, load, stem, vocabulary

EXAMPLE = Path(__file__).parent.parent / "examples" / "identify"


LAW = "laws.steel_on_rubber"
COULOMB = f"""[compare.coulomb.settings]
{LAW}.friction = {{kind = "coulomb", mu_s = 0.8, mu_k = 0.7}}
"""
KNOWN = vocabulary(PAPER.assemble(), {})


def rubber(kind: str, strengths: str) -> str:
    """The setting of another material."""
    return (
        f'materials.rubber = {{kind = "{kind}", E = 0.75e6, nu = 0.45, {strengths}, '
        "depth = 44e-3}\n"
    )


def setting(text: str) -> str:
    return CONFIG.replace("bodies.disc", text + "bodies.disc", 1)


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
def loaded(example, tmp_path):
    """Loads the example, changed, with a configuration."""

    def load_case(change=len, config=CONFIG):
        table = [list(cells) for cells in example]
        change(table)
        (tmp_path / "rig.toml").write_text(config)
        return load([write(tmp_path / "data.csv", table)], tmp_path / "rig.toml")

    return load_case


def put(row: int, column: int, text: str) -> Change:
    """Replace a cell; the heading is row 1 and the time column 0."""
    return lambda table: table[row - 1].__setitem__(column, text)


def scale(column: int, factor: float, offset: float = 0.0, since: int = 2) -> Change:
    def change(table):
        for cells in table[since - 1 :]:
            cells[column] = repr(float(cells[column]) * factor + offset)

    return change


def ramp(column: int, start: float, rise: float) -> Change:
    return lambda table: [
        cells.__setitem__(column, f"{start + rise * i}") for i, cells in enumerate(table[1:])
    ]


def both(*changes: Change) -> Change:
    return lambda table: [change(table) for change in changes]


def cut(begin: int, end: int | None = None) -> Change:
    return lambda table: table.__delitem__(slice(begin, end))


T, X_D, Y_D, F_FF, X_C, THETA, Y_BR, F_X, F_Y = 0, 1, 3, 5, 6, 7, 9, 10, 11

REJECTED_DATA = [
    # headings
    (put(1, X_C, "x_C"), r"data\.csv, row 1, column `x_C` has no unit: write `x_C \[m\]`"),
    (put(1, THETA, "theta [mm]"), r"row 1, column `theta` cannot be in 'mm'; it can be in rad"),
    (put(1, X_C, "x_c [mm]"), r"`x_c` is not known: did you mean `x_C`\?.* ignore = \['x_c'\]"),
    (put(1, X_C, "x_Br [mm]"), r"row 1, column `x_Br` is there twice"),
    (put(1, X_C, "v_x [um/s]"), r"rig\.toml: sensors: no recording has samples of `x_C`"),
    # cells
    (lambda table: table[6].append("1"), r"row 7 has 13 cells, but there are 12 columns; complete"),
    (put(9, X_C, "n/a"), r"row 9, column `x_C`: 'n/a' is not a finite number; leave the cell empt"),
    (put(12, Y_D, " "), r"row 12, column `y_d` is empty; only measured channels may have gaps"),
    (both(*(put(row, X_C, "") for row in range(3, 63))), r"`x_C` has 1 samples, but needs at"),
    # times
    (put(12, T, "0.045"), r"row 12, column `t`: the time 0.045 s is there twice: delete one"),
    (put(12, T, "0.01"), r"row 12, column `t`: time goes back, from 0.045 to 0.01 s: sort"),
    (scale(T, 1.0, 5e12), r"row 3, column `t`: 5e\+12 s is too far from zero .*; count times from"),
    (cut(10, 40), r"row 11, column `t`: 0.155 s are missing before it"),
    (cut(8), r"has 7 rows of numbers, but needs at least 10"),
    # units
    (put(1, X_C, "x_C [m]"), r"row 2, column `x_C`: 60.3 m is not plausible, .*1.2 m.*is the unit"),
    (scale(F_Y, 1e3), r"row \d+, column `effort_y`: .* between -1e\+04 and 1e\+04 N"),
    (both(scale(THETA, 0.18 / math.pi), put(1, THETA, "theta [rad]")),
        r"column `theta_C` moves already, by .* rad: is its unit right\?"),
    # the start
    (scale(X_C, 1.0, 5.0), r"row 2, column `x_C`: it begins at 0.065\d* m, but .* m: are its unit"),
    (scale(X_C, 1.0, 1.25), r"row 2, column `x_C`: it begins at 0.0615"),
    (scale(X_C, -1.0), r"begins at -0.0603\d* m, but the rig file at 0.0603 m: are its unit, sign"),
    (scale(THETA, 1.0, 500.0), r"`theta_C`: it begins at 0.49\d* rad, but .* at 0 rad"),
    (both(*(scale(k, 1.0, -0.6) for k in (Y_D, Y_BR))), r"`y_d`: it begins at 0.0493\d* m"),
    (ramp(X_C, 60.3, 0.3), r"row 3, column `x_C` moves already, by 0.0003 m: .*\"moving"),
    (ramp(THETA, 0.0, 15.0), r"row 3, column `theta_C` moves already"),
    (ramp(X_D, 60.3, 0.3), r"row 3, column `x_d` moves already"),
]  # fmt: skip
REJECTED_CONFIG = [
    # the rig
    (CONFIG.replace('"paper"', '"papyrus"'), r"papyrus: No such file.*; the ready rigs .* paper"),
    (CONFIG.replace("actuators.x.measures", "control.senses"), r"`control` is .* `controllers`"),
    (CONFIG.replace("friction.v_s", "friction.vs"), r"settings: .*`vs` .*; did you mean `v_s`"),
    (setting("pads.L.height = 3e-3\n"), r"column `y_d`: it begins at 0.0499\d* m.* at 0\.0484"),
    (setting(rubber("standard_linear_solid", "E_instant = 1e5, tau = 1e-2")), r"rubber.*E_instant"),
    (setting(rubber("generalised_kelvin", "J = [0.8, 0.5], tau = [2e-3, 0.01]")),
        r"materials\.rubber.*the fractions J sum to 1\.3, above one"),
    # keys of an older form
    # the file
    (CONFIG + "[[", r"rig\.toml is not a TOML file"),
    (CONFIG + "[sensor]\n", r"`sensor` is not known here; did you mean `sensors`"),
    # names
    (CONFIG.replace("F_y.noise", "F_z.noise"), r"rig\.toml: sensors: `F_z` is not a channel"),
    (CONFIG.replace("rubber.K_n", "rubber.K"), r"unknowns: `laws.steel_on_rubber.K` cannot"),
    ('ignore = ["Temp"]\n' + CONFIG, r"rig\.toml, ignore: no file has a column `Temp`"),
    ('columns."Disc x" = "x_D"\n' + CONFIG, r"x_D' is no channel of the rig; did you mean"),
    (CONFIG + '[start]\nkind = "flying"\n', r"start\.kind should be one of .*not 'fl"),
    (CONFIG + '[start]\nkind = "rest"\nposition_sd = {"disk.x" = 1e-3}\n',
        r"`position_sd` of the start speaks of `disk.x`; did you mean `disc.x`"),
    # recordings
    ('heldout = ["data"]\n' + CONFIG, r"heldout: it names every recording"),
    ('heldout = ["other"]\n' + CONFIG, r"heldout: there is no recording `other`; .* data"),
    (CONFIG + '[[recordings]]\nname = "b"\nfiles = ["b.csv"]\n', r"`files` of `b`: .*b\.csv: No"),
    (CONFIG + "[[recordings]]\n", r"recordings\.0: a recording needs a `file`"),
    (CONFIG + '[[recordings]]\nfile = "b.csv"\nfiles = ["c.csv"]\n', r"a `file` or `files`, not"),
    (CONFIG + '[[recordings]]\nfile = "data.csv"\n', r"names of their own, .* data, data"),
    (CONFIG + '[[recordings]]\nname = "data"\nsettings."pad.E" = 2e6\n',
        r"recordings\.0\.settings: .*is unknown, .* set by unknowns\..*nominal where"),
    # laws to compare
    (CONFIG + 'loss = "huber"\n' + COULOMB, r"fit\.loss must be 'linear', not 'huber'"),
    (CONFIG + f'[compare.coulomb]\nwithout = ["{LAW}.R_t"]\n', r"without: `.*R_t` is not an"),
    (CONFIG + f'[compare.coulomb.unknowns."{LAW}.friction.v_s"]\nlow = -1.0\nscale = "linear"\n'
     "high = 1.0\n", r"compare\.coulomb: unknowns\..*v_s\.low = -1 is beyond"),
    (CONFIG + '[compare."as stated"]\n', r"compare: the law of the file itself"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), REJECTED_DATA)
def test_a_mistake_in_a_recording_is_named_with_its_row_and_column(loaded, change, message):
    with pytest.raises(ValueError, match=message):
        loaded(change)


@pytest.mark.parametrize(("config", "message"), REJECTED_CONFIG)
def test_a_mistake_in_a_configuration_is_named_with_its_field(loaded, config, message):
    with pytest.raises(ValueError, match=message):
        loaded(config=config)


def test_empty_cells_are_missing_samples(loaded):
    gaps = both(*(put(row, X_C, "") for row in (5, 6, 40)))
    blank = lambda table: table.insert(20, [])  # it counts as a row, not as data
    made = loaded(both(gaps, blank))
    (one,) = made.problem.recordings
    t, x = one.samples["x_C"]
    assert (len(one.samples["effort_y"][0]), len(x)) == (61, 58)
    assert not {0.015, 0.02} & set(t)
    assert made.tables["data"].near(0.2).endswith("data.csv, row 43 (t = 0.2 s)")


@pytest.fixture(scope="module")
def run():
    """A grasp of 60 ms."""
    motion = """
x_d = {kind = "strokes", travel = 5e-3, stroke_time = 0.3, since = 0.05}
y_d = {times = [0.0, 0.05], values = ["start", 49.1e-3]}
F_ff = {times = [0.0, 0.05], values = [0.0, "held"]}
"""
    settings = tomllib.loads(CONFIG)["settings"] | {"motion": tomllib.loads(motion)}
    return paper(**settings).run(torch.linspace(0, 0.06, 31, dtype=torch.float64), step=2e-3)


def test_a_trajectory_file_is_a_recording(run, tmp_path):
    """Also one without the rate of a signal."""
    desired = run.together("x_d", "x_d_dot", "y_d", "y_d_dot", "F_ff")
    (tmp_path / "fit.toml").write_text(CONFIG)
    for without, tolerance in ([], 1e-12), (["y_d_dot"], 2e-4):
        save(run.to_xarray().drop_vars(without), tmp_path / "run.nc")
        (one,) = load([tmp_path / "run.nc"], tmp_path / "fit.toml").problem.recordings
        for channel in measurable(PAPER.assemble()):
            np.testing.assert_array_equal(one.samples[channel][1], run[channel].detach())
        with torch.no_grad():
            got = one.rig.reference(run.t, ("x_d", "y_d", "F_ff")).flatten(1)[:, :5]
        np.testing.assert_allclose(got, desired, atol=tolerance)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: xr.Dataset({"time": ("time", [0.0, 1.0])}), "it has no time and channels"),
        (lambda data: data.assign(theta_C=data.theta_C.where(data.time != data.time[7])),
         r", sample 7, column `theta_C` is not a finite number"),
        (lambda data: data.assign(theta_C=data.theta_C.assign_attrs(units="deg")),
         r", `theta_C` should be in rad, not 'deg'"),
        (lambda data: data.assign(x_d=("time", ["here"] * 31)), r"`x_d` should be float64"),
        (lambda data: data.isel(time=[0, 1, 2, 2, *range(3, 31)]), r", sample 3, column `t`"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_trajectory_file_is_named(run, tmp_path, change, message):
    path = tmp_path / "bad.nc"
    save(change(run.to_xarray().copy(deep=True)), path)
    with pytest.raises(ValueError, match=rf"bad\.nc.*{message}"):
        read_table(path, (), KNOWN)


def test_samples_much_denser_than_the_motion_are_not_all_simulated(loaded):
    (one,) = loaded().problem.recordings

    def simulated(t):
        return replace(one, samples={"x_C": (t, t)}).grid(False).t.numpy()

    dense = simulated(np.linspace(0.0, 0.3, 20_001))
    assert len(dense) < 600
    assert dense[1] <= 0.0 < 0.3 <= dense[-1]
    irregular = np.sort(np.random.default_rng(0).uniform(0.0, 0.3, 100))
    np.testing.assert_array_equal(simulated(irregular)[1:], irregular)
    assert np.all(np.diff(one.grid(True).t.numpy()) > 0)


def test_a_name_is_the_same_where_the_system_knows_ascii_only():
    """Which gives Python the bytes of a file's name one by one."""
    assert stem(Path("a/größe.csv")) == stem(Path("a/gr\udcc3\udcb6\udcc3\udc9fe.csv")) == "größe"
    assert stem(Path("a/\udcff.csv")) == "�"


def test_short_names_are_names_of_columns_settings_and_unknowns(loaded):
    """In the data, in every table of the configuration, and for each other."""
    stated, camera = 'columns.camera = "theta"\n', put(1, THETA, "camera [mrad]")
    text = CONFIG.replace(f"{LAW}.friction.v_s = 0.05", '"contact.v_s" = 0.05')
    text = text.replace("actuators.x.measures", '"control.senses"').replace(
        f"{LAW}.K_n", "contact.K_n"
    )
    more = f'[compare.stiff]\nwithout = ["{LAW}.K_n"]\nsettings."pad.E" = 2e6\n'
    made = loaded(both(camera, put(1, F_Y, "effort_y [N]")), stated + text + more)
    (plain,), (one,) = (case.problem.recordings for case in (loaded(), made))
    assert one.samples.keys() == plain.samples.keys()
    assert one.parameters == plain.parameters
    assert list(made.problem.unknowns) == [f"{LAW}.K_n", "materials.rubber.E"]
    assert list(made.laws["stiff"].unknowns) == ["materials.rubber.E"]
    assert made.laws["stiff"].recordings[0].parameters["materials.rubber.E"] == 2e6


def test_a_recording_has_settings_of_its_own_and_the_files_motion_without_a_column(
    loaded, example, tmp_path
):
    without = lambda table: [cells.pop(F_FF) for cells in table]
    own = (
        '[[recordings]]\nname = "data"\nsettings.motion.F_ff.values = [-2.5, -2.5]\n'
        '[[recordings]]\nfile = "b.csv"\nsettings.bodies.disc.mass = 0.5\n'
    )
    write(tmp_path / "b.csv", [cells[:F_FF] + cells[F_FF + 1 :] for cells in example])
    made = loaded(without, setting("motion.F_ff.values = [0.0, 0.0]\n") + own).problem
    for one, force, mass in zip(made.recordings, (-2.5, 0.0), (PAPER.bodies["disc"].mass, 0.5)):
        at = one.rig.reference(torch.tensor([0.1], dtype=torch.float64), ("F_ff",))
        assert at.flatten()[0] == force
        assert one.parameters["bodies.disc.mass"] == mass
        assert one.parameters[f"{LAW}.friction.v_s"] == 0.05


@pytest.mark.parametrize(
    ("asked", "camera", "late", "message"),
    [
        ((T, X_D, 2, Y_D, F_FF), (T, X_C, THETA), 0.0, ""),
        (
            (T, X_D, 2, Y_D, F_FF),
            (T, X_C),
            5.0,
            r"camera\.csv, row 17, .*t`: 5\.3 s is 5 s outside",
        ),
        ((T, X_D, 2, Y_D, F_FF), (T, X_C, F_X), 0.0, r"`effort_x` is in .*camera.* and in .*force"),
        ((T, X_D, Y_D, F_FF), (T, X_C, 2), 0.0, r"`x_d` and `x_d_dot` must be in one file"),
    ],
)
def test_a_recording_may_stand_in_several_files(example, tmp_path, asked, camera, late, message):
    """Each with times of its own, while there are set-points."""
    scale(T, 1.0, late)(slow := [[*cells] for cells in [example[0], *example[1::4]]])
    tables = {
        "asked": (asked, example),
        "camera": (camera, slow),
        "force": ((T, F_X, F_Y), example),
    }
    for name, (columns, rows) in tables.items():
        write(tmp_path / f"{name}.csv", [[cells[i] for i in columns] for cells in rows])
    config = tmp_path / "rig.toml"
    config.write_text(
        CONFIG.replace("y_Br.noise = 10e-6\n", "")
        + '[[recordings]]\nname = "roll"\nfiles = ["asked.csv", "camera.csv", "force.csv"]\n'
    )
    if message:
        with pytest.raises(ValueError, match=message):
            load([], config)
        return
    made = load([], config)
    (one,) = made.problem.recordings
    assert one.name == "roll"
    sizes = {channel: len(t) for channel, (t, _) in one.samples.items()}
    assert sizes == {"x_C": 16, "theta_C": 16, "effort_x": 61, "effort_y": 61}
    assert made.tables["roll"].near(0.1) == f"{tmp_path / 'asked.csv'}, row 22 (t = 0.1 s)"


def test_a_file_may_state_everything_that_a_problem_can_have(loaded):
    text = CONFIG.replace(
        "nominal = 1e5",
        'nominal = 1e5\nper = "recording"\nprior = {median = 1e5, sd = 0.3, kind = "log-normal"}\n'
        f'[unknowns."{LAW}.friction.mu_k"]\nratio_to = "{LAW}.friction.mu_s"\nnominal = 0.9\n'
        "high = 1.0",
    ).replace(
        "F_y.noise = 0.1",
        'F_y = {noise = 0.1, gain = 0.02, inertia = 0.4, per = "recording", colour = "ar"}\n'
        "F_x = {noise = 0.1, misalignment = 0.01, low = -50.0, high = 50.0}",
    )
    text = text.replace("[settings]", "[settings]\ngravity = 9.8\nactuators.y.Kp = 1.1e5")
    made = loaded(config=text + '[start]\nkind = "rest"\nposition_sd = {"disc.x" = 1e-4}\n').problem
    (one,) = made.recordings
    stated = {"gravity": 9.8, "actuators.y.Kp": 1.1e5, f"{LAW}.friction.v_s": 0.05}
    assert {name: one.parameters[name] for name in stated} == stated
    (place,) = one.start_coordinates
    assert tuple(place) == ("start.disc.x", 60.3e-3, 1e-4)
    assert sorted(made.coordinates.labels) == sorted([
        f"{LAW}.K_n in data", f"{LAW}.friction.mu_k / {LAW}.friction.mu_s", "materials.rubber.E",
        "start.disc.x in data", "gain of effort_y in data", "inertia of effort_y in data",
        "misalignment of effort_x",
    ])  # fmt: skip
    assert len(made.coordinates.priors) == 2
    assert made.sensors["effort_y"].colour == "ar"
    assert made.sensors["effort_x"].high == 50.0


def test_a_recording_may_begin_anywhere_if_that_is_stated(loaded):
    """Cut from the middle of the grasp."""
    sensors = CONFIG.replace("F_y.noise", "theta.noise = 0.5e-3\nx_Br.noise = 10e-6\nF_y.noise")
    given = 'given = {"disc.y" = {mean = 23.5e-3, sd = 1e-4}}\n'
    text = sensors + '[start]\nkind = "moving"\nlead = 40e-3\n' + given
    with pytest.raises(ValueError, match=r"row 2, column `\w+`.* start = \{kind = \"moving\""):
        loaded(cut(1, 31), sensors)
    with pytest.raises(ValueError, match=r"rig\.toml, recording `data`: .*disc\.z"):
        loaded(cut(1, 31), text.replace("disc.y", "disc.z"))
    start = loaded(cut(1, 31), text).problem.recordings[0].start
    assert isinstance(start, MovingStart)
    assert start.lead == pytest.approx(0.04, abs=6e-3)
    assert start.bodies["disc.y"] == (23.5e-3, 1e-4)
    assert start.bodies["disc.x"][0] == pytest.approx(60.5e-3, abs=5e-4)


def test_an_uncertain_start_widens_what_a_recording_may_begin_with(loaded):
    """By a multiple of its standard deviation, and by a sensor's bias."""
    change = scale(X_C, 1.0, 1.25)
    start = '[start]\nkind = "rest"\nposition_sd = {"disc.x" = 1e-3}\n'
    biased = CONFIG.replace("x_C.noise = 10e-6", "x_C = {noise = 10e-6, bias = 1e-3}")
    for config in (CONFIG + start, biased):
        assert loaded(change, config).problem.names == ("data",)


def test_competing_laws_have_the_same_data(loaded):
    solid = rubber("standard_linear_solid", "E_instant = 2e6, tau = 1e-2")
    made = loaded(config=CONFIG + (
        f'[unknowns."{LAW}.friction.v_s"]\n{COULOMB}[compare.coulomb]\nwithout = '
        f'["{LAW}.friction.v_s"]\n[compare.solid]\nsettings.{solid}'
        'unknowns."materials.rubber.E_instant" = {ratio_to = "materials.rubber.E", low = 1.01, '
        "high = 20.0}\n"
    ))  # fmt: skip
    assert made.laws[STATED] is made.problem
    two, v_s = [f"{LAW}.K_n", "materials.rubber.E"], f"{LAW}.friction.v_s"
    assert {name: list(law.unknowns) for name, law in made.laws.items()} == {
        STATED: [*two, v_s], "coulomb": two, "solid": [*two, v_s, "materials.rubber.E_instant"],
    }  # fmt: skip
    rigs = {name: law.recordings[0].rig for name, law in made.laws.items()}
    assert isinstance(rigs["coulomb"].contacts["L"].law.friction, Coulomb)
    assert isinstance(rigs["solid"].pads["U"].material, StandardLinearSolid)
