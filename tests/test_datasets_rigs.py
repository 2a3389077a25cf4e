"""Datasets of rig files: any number of their tables is drawn, by its name, and all that holds for
the paper's rig holds for them."""

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr
from scipy.stats import truncnorm

from torchsoft import simulate
from torchsoft.datasets import Trajectories, open_dataset
from torchsoft.datasets.check import check, figure
from torchsoft.datasets.config import Config
from torchsoft.datasets.distributions import Choice, Normal
from torchsoft.datasets.files import Manifest
from torchsoft.datasets.generate import Serial, generate, local_workers
from torchsoft.datasets.rig_files import embedded
from torchsoft.physics.energy import stores
from torchsoft.rigs import RigFile
from torchsoft.tables import InvalidTable

RIG = """
[bodies.disc]
mass = 0.4
shape = {kind = "circle", radius = 20e-3}
start = {x = 0.3e-3, y = "rest"}
[bodies.bracket]
mass = 0.4
theta = 0.0
weighted = false
start = {x = 0.0, y = 50.1e-3}
[materials.rubber]
kind = "kelvin_voigt"
E = 0.75e6
nu = 0.45
tau = 10e-3
depth = 44e-3
[pads.lower]
material = "rubber"
length = 80e-3
height = 5e-3
elements_x = 40
elements_y = 1
origin = [-40e-3, 0.0]
[pads.upper]
material = "rubber"
length = 80e-3
height = 5e-3
elements_x = 40
elements_y = 1
origin = [-40e-3, 0.0]
base = "bracket"
mirrored = true
[laws.dry]
K_n = 1.2e5
R_n = 400.0
K_t = 1.2e5
R_t = 400.0
friction = {kind = "smooth", mu_s = 0.8, mu_k = 0.7, v_s = 0.05}
[contacts]
below = {pad = "lower", body = "disc", law = "dry"}
above = {pad = "upper", body = "disc", law = "dry"}
[actuators.x]
pushes = "bracket.x"
setpoint = "x_d"
Kp = 1e5
Kd = 400.0
[controllers.lift]
measures = ["bracket.y"]
setpoints = ["y_d"]
pushes = ["bracket.y"]
gain = [[1e5, 400.0]]
[motion]
x_d = {kind = "csv", file = "x_d.csv", column = "x"}
y_d = {kind = "profile", times = [0.0, 0.05], values = ["start", 49.5e-3]}
[outputs]
duration = 0.1
interval = 0.005
snapshots = [0.1]
[solver]
rtol = 1e-5
"""

CONFIG = """
title = "Pressed"
seed = 3
trajectories = 3
trajectories_per_shard = 2
samples_per_chunk = 8
rig = "rigs/pressed.toml"
[fixed]
"pads.lower.elements_x" = 20
"laws.dry.friction.v_s" = 0.06
[parameters]
"materials.rubber.E" = { low = 0.6e6, high = 0.9e6, scale = "log" }
"bodies.disc.mass" = { choices = [0.3, 0.4] }
"bodies.disc.start.x" = { mean = 0.0, sd = 0.2e-3 }
"laws.dry.friction.mu_s" = { low = 0.7, high = 0.9 }
"laws.dry.friction.mu_k" = { low = 0.8, high = 1.0, ratio_to = "laws.dry.friction.mu_s" }
"actuators.x.Kp" = { low = 0.8e5, high = 1.2e5 }
"controllers.lift.gain_1_2" = { low = 300.0, high = 500.0 }
"motion.y_d.values_2" = { low = 49.4e-3, high = 49.6e-3 }
"pads.upper.origin_1" = { low = -41e-3, high = -39e-3 }
"""


def written(folder: Path, config: str = CONFIG) -> Path:
    """The rig file, the motion that it names, and the configuration, in folders of their own."""
    (folder / "rigs").mkdir(exist_ok=True)
    (folder / "rigs" / "pressed.toml").write_text(RIG)
    (folder / "rigs" / "x_d.csv").write_text("t [s],x [mm]\n0,0\n0.05,0\n0.1,0.2\n")
    (folder / "set.toml").write_text(config)
    return folder / "set.toml"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    config = Config.from_toml(written(folder))
    assert generate(config, str(folder / "set"), Serial(), progress=False) == 0
    return folder / "set", config


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a store, the manifest included."""
    return {
        str(path.relative_to(folder)): same_commit(path.read_bytes())
        for path in folder.rglob("*")
        if path.is_file()
    }


def same_commit(data: bytes) -> bytes:
    """Without the commit, and so the digest: the repository may move on during a test."""
    return re.sub(rb'"(commit|digest)": "\w*"', b"", data)


def sound(url: Path) -> bool:
    return [one for one in check(str(url)) if "commit" not in one] == []


def test_a_trajectory_is_the_run_of_the_rig_file_with_its_numbers(made, tmp_path):
    folder, _ = made
    data = open_dataset(str(folder)).load()
    row = data.isel(trajectory=1)
    p = {name: float(row[name]) for name in tomllib.loads(CONFIG)["parameters"]}
    written(tmp_path)
    ready = (
        RigFile.from_toml(tmp_path / "rigs" / "pressed.toml")
        .override(
            pads={"lower": {"elements_x": 20},
                  "upper": {"origin": [p["pads.upper.origin_1"], 0.0]}},
            materials={"rubber": {"E": p["materials.rubber.E"]}},
            bodies={"disc": {"mass": p["bodies.disc.mass"],
                             "start": {"x": p["bodies.disc.start.x"]}}},
            laws={"dry": {"friction": {"v_s": 0.06, "mu_s": p["laws.dry.friction.mu_s"],
                                       "mu_k": p["laws.dry.friction.mu_k"]}}},
            actuators={"x": {"Kp": p["actuators.x.Kp"]}},
            controllers={"lift": {"gain": [[1e5, p["controllers.lift.gain_1_2"]]]}},
            motion={"y_d": {"values": ["start", p["motion.y_d.values_2"]]}},
        )
        .build()
    )  # fmt: skip
    run = simulate(ready.rig, ready.t, y0=ready.y0, rtol=1e-5)
    for name in ("x_disc", "y_bracket", "effort_x", "effort_lift_bracket_y", "x_d_dot", "M_upper"):
        there, here = row[name].values, run[name].numpy()
        assert data[name].attrs["units"] == run.units[name]
        np.testing.assert_allclose(there, here, atol=1e-3 * np.abs(here).max())
    force = run.force["above"][..., 0].numpy()
    np.testing.assert_allclose(row.normal_force_above, force, atol=1e-2 * force.max())
    assert force[-1].sum() > 1.0
    assert 0.7 <= p["laws.dry.friction.mu_s"] <= 0.9
    assert 0.8 <= p["laws.dry.friction.mu_k"] / p["laws.dry.friction.mu_s"] <= 1.0
    assert {*np.unique(data["bodies.disc.mass"])} <= {0.3, 0.4}


def test_arrays_have_the_names_of_the_rigs_parts_and_their_units(
    made,
):
    data = xr.open_zarr(made[0])
    assert data.normal_force_below.dims == ("trajectory", "time", "lower_point")
    assert data.displacement_upper.dims == ("trajectory", "time", "upper_point", "axis")
    assert dict(data.lower_places.sizes) == {"lower_point": 21, "axis": 2}
    np.testing.assert_allclose(data.lower_point, np.linspace(0, 80e-3, 21), atol=1e-15)
    np.testing.assert_allclose(data.upper_places[:, 1], 5e-3)
    units = {name: data[name].attrs["units"] for name in data.data_vars}
    wanted = {
        "omega_disc": "rad/s", "effort_x": "N", "actuators.x.Kp": "N/m", "motion.y_d.values_2": "m",
        "bodies.disc.mass": "kg", "laws.dry.friction.mu_k": "1", "pads.upper.origin_1": "m",
        "materials.rubber.E": "Pa", "angular_momentum_disc": "kg.m2/s",
    }  # fmt: skip
    assert {name: units[name] for name in wanted} == wanted
    assert all("units" in data[name].attrs for name in data.variables if name in data.data_vars)
    rest = data.normal_force_below[:, 0].sum("lower_point").values
    np.testing.assert_allclose(rest, data["bodies.disc.mass"] * 9.81, rtol=2e-3)


def test_it_is_sound_and_resumes_to_the_same_bytes_without_the_rig_file(made, tmp_path):
    """Everything that the rig file names is in the manifest."""
    folder, config = made
    assert sound(folder)
    again = Config.model_validate(Manifest.read(str(folder)).config)
    assert again.hash == config.hash
    with local_workers(2) as executor:
        generate(again, (tmp_path / "set").as_uri(), executor, 2, progress=False)
    assert contents(tmp_path / "set") == contents(folder)
    (tmp_path / "set" / "finished" / "1.sha256").unlink()
    (tmp_path / "set" / "x_disc" / "c" / "1" / "0").write_bytes(b"half")
    generate(again, str(tmp_path / "set"), Serial(), progress=False)
    assert contents(tmp_path / "set") == contents(folder)
    (tmp_path / "set" / "x_disc" / "c" / "1" / "0").write_bytes(b"half")
    assert any("x_disc/c/1/0 is damaged" in one for one in check(str(tmp_path / "set")))


def test_trajectories_show_themselves(made):
    shown = str(Trajectories(str(made[0]), ["effort_x", "bodies.disc.mass"]))
    title, force, mass = shown.splitlines()
    assert title == f"Trajectories: 3 windows of 21 samples, of 3 trajectories in {made[0]}"
    assert (force.split()[1:], mass.split()[1:]) == (["N,", "over", "time"], ["kg,", "a", "number"])


def test_the_bar_of_a_finished_set_shows_no_rate(made, capsys):
    """Not the simulated seconds of the shards that were there already. A log has lines."""
    folder, config = made
    generate(config, str(folder), Serial(), progress=True)
    log = capsys.readouterr().err
    assert "\r" not in log
    last = log.splitlines()[-1]
    total = re.escape(f"{config.duration * config.trajectories:.3g}")
    assert re.search(rf"100%.* {total}0?/{total}0? .*(\?|0\.00) ?simulated s/s", last), last


def test_another_file_is_another_dataset(tmp_path):
    path = written(tmp_path)
    before = Config.from_toml(path).hash
    (tmp_path / "rigs" / "x_d.csv").write_text("t [s],x [mm]\n0,0\n0.05,0\n0.1,0.3\n")
    assert Config.from_toml(path).hash != before
    (tmp_path / "rigs" / "x_d.csv").unlink()
    with pytest.raises(OSError, match=r"x_d\.csv"):
        Config.from_toml(path)


def test_channels_are_chosen_and_points_left_out(tmp_path):
    text = 'channels = ["theta_disc", "effort_x"]\nnodal = false\n' + CONFIG
    config = Config.from_toml(
        written(tmp_path, text.replace("trajectories = 3", "trajectories = 1"))
    )
    generate(config, str(tmp_path / "set"), Serial(), progress=False)
    assert sound(tmp_path / "set")
    data = open_dataset(str(tmp_path / "set")).load()
    assert {"theta_disc", "effort_x", "stored_energy"} <= {*data.data_vars}
    assert not [name for name in data.data_vars if "surface" in name or "force_" in str(name)]
    assert "x_disc" not in data
    item = Trajectories(str(tmp_path / "set"), ["theta_disc", "materials.rubber.E"], window=5)[1]
    assert item["theta_disc"].shape == (5,)
    drawn = figure(data, config)
    assert [one.get_text() for one in drawn.legends[0].get_texts()]
    assert not any(ax.get_legend() for ax in drawn.axes)
    assert all(ax.axison and ax.has_data() for ax in drawn.axes)


def tree(folder: Path) -> Any:
    return embedded(tomllib.loads(written(folder).read_text()), folder)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("parameters", "materials.silicone.E"), {"low": 1.0, "high": 2.0},
         r"parameters.materials.silicone.E: `materials.silicone.E` is not in the rig file: "
         "materials has rubber"),
        (("parameters", "motion.y_d.values_8"), {"low": 1.0, "high": 2.0},
         "it has motion.y_d.values_1 to _2"),
        (("parameters", "materials.rubber.nu"), {"low": 0.3, "high": 0.7},
         r"parameters.materials.rubber.nu.high = 0.7: impossible: .*nu.*0\.4999"),
        (("parameters", "bodies.disc.mass"), {"choices": [0.3, -0.4]},
         r"mass.choices.1 = -0.4: impossible"),
        (("parameters", "bodies.disc.mass"), {"choices": [0.3, 1e-300]},
         r"mass.choices.1 = 1e-300: impossible"),
        (("parameters", "bodies.disc.start.x"), {"mean": 0.06, "sd": 1e19},
         r"start.x: mean - 4 sd = -4e\+19: impossible"),
        (("parameters", "bodies.disc.start.x"), {"mean": -1e308, "sd": 1e-3},
         "they are 4 times sd = 0.001 from mean"),
        (("parameters", "bodies.disc.mass"), {"choices": []},
         "mass.choices: Tuple should have at least 1"),
        (("parameters", "bodies.disc.mass"), {"mean": 0.4},
         "parameters.bodies.disc.mass.sd is missing"),
        (("parameters", "bodies.disc.mass"), {"mean": 0.4, "sd": 0.01, "low": 0.5},
         "low = 0.5 should be below high = 0.44"),
        (("parameters", "bodies.disc.mass"), {"mean": 0.4, "sd": 0.01, "low": 1.5, "high": 1.6},
         "next to nothing of mean = 0.4"),
        (("parameters", "laws.dry.friction.mu_k"), {"low": 0.75, "high": 0.9},
         r"mu_k.high = 0.9: impossible: laws.dry.friction: mu_k must not exceed mu_s"),
        (("parameters", "laws.dry.friction.mu_k", "ratio_to"), "laws.dry.friction.mu",
         "mu_k.ratio_to: `laws.dry.friction.mu` is not in the rig file"),
        (("parameters", "materials.rubber.E"), {"low": 1.0, "high": 2.0,
                                                "ratio_to": "laws.dry.friction.mu_k"},
         "laws.dry.friction.mu_k is a ratio itself"),
        (("parameters", "pads.upper.elements_x"), {"low": 20, "high": 40},
         "pads.upper.elements_x must be the same in every trajectory; set it in `fixed`"),
        (("parameters", "pads.upper.length"), {"low": 70e-3, "high": 80e-3},
         "length.low = 0.07: it changes the contact points of pads.upper"),
        (("parameters", "bodies.disc.theta"), {"low": 0.0, "high": 1e-3},
         "bodies.disc.theta.low = 0: it changes the coordinates and energies of the rig"),
        (("parameters", "contacts.above.pad"), {"low": 0.0, "high": 1.0},
         "is no number, but 'upper'"),
        (("parameters", "outputs.duration"), {"low": 0.1, "high": 0.2},
         "`outputs.duration` has no part in a dataset, whose own duration and sample_interval"),
        (("parameters", "pads.lower.elements_x"), {"low": 1.0, "high": 2.0},
         "is in `fixed` as well"),
        (("fixed", "materials.rubber.nu"), 0.9,
         r"fixed.materials.rubber.nu: materials.rubber.nu.*0\.9"),
        (("fixed", "pads.lower.elements"), 3,
         "fixed.pads.lower.elements: .* did you mean `elements_y`"),
        (("channels",), ["x_disk"],
         "channels: `x_disk` is no channel of the rig; there are x_disc"),
        (("channels",), ["x_disc", "x_disc"], "channels: every name once"),
        (("grasp_depth",), {"low": 1e-3, "high": 1e-3}, "`grasp_depth` is not known here"),
        (("parameters",), {}, "parameters is missing: nothing would differ"),
        (("duration",), 0.102, "duration = 0.102 s is not a whole number of sample_interval"),
        (("rig", "bodies", "disc", "mass"), -1.0, r"rig: bodies\.disc\.mass"),
        (("rig", "bodies", "disc", "symbol"), "disc/1",
         r"rig: bodies\.disc\.symbol\.disc/1: the name should be letters, digits and"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_by_its_name(tmp_path, place, value, message):
    inner = config = tree(tmp_path)
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    with pytest.raises(InvalidTable) as error:
        Config.model_validate(config)
    assert re.search(message, str(error.value)), str(error.value)
    assert "\n" not in str(error.value)


def test_names_that_two_arrays_would_have_are_refused(tmp_path):
    config = tree(tmp_path)
    config["rig"]["motion"]["steps"] = config["rig"]["motion"].pop("x_d")
    config["rig"]["actuators"]["x"]["setpoint"] = "steps"
    with pytest.raises(InvalidTable, match="two arrays of the dataset would be called `steps`"):
        Config.model_validate(config)


def test_normal_and_chosen_numbers_have_their_distributions():
    u = np.linspace(0, 1, 101)
    one = Normal(mean=2.0, sd=0.5, low=1.0, high=4.5)
    wanted = truncnorm.ppf(u, (1.0 - 2.0) / 0.5, (4.5 - 2.0) / 0.5, loc=2.0, scale=0.5)
    np.testing.assert_allclose([one.at(x) for x in u], wanted, rtol=1e-9)
    assert (Normal(mean=1.0, sd=0.1).low, Normal(mean=1.0, sd=0.1).high) == (0.6, 1.4)
    choice = Choice(choices=(3.0, 1.0, 2.0))
    assert [choice.at(x) for x in (0.0, 0.33, 0.34, 0.67, 1.0)] == [3.0, 3.0, 1.0, 2.0, 2.0]


@pytest.mark.parametrize("change", [{}, {"pads": {"lower": {"inertial": True}}},
                                    {"bodies": {"disc": {"theta": 0.0}}}])  # fmt: skip
def test_stores_are_those_of_a_run(tmp_path, change):
    written(tmp_path)
    file = RigFile.from_toml(tmp_path / "rigs" / "pressed.toml").override(**change)
    rig, y0, t = file.build()
    run = simulate(rig, t[:2], y0=y0, step=1e-3)
    assert [*stores(rig)] == [*run.energy]
    assert torch.isfinite(run.y).all()
