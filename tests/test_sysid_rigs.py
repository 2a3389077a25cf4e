"""Identification of the rig that a rig file describes, by the names of that file."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from torchsoft import simulate
from torchsoft.cli import main
from torchsoft.physics.motion import Sampled
from torchsoft.rigs.build import RigFile
from torchsoft.sysid import (
    Problem,
    Sensor,
    Unknown,
    estimate_initial_state,
    identify,
    load_answer,
    record,
)
from torchsoft.sysid.assumptions import assumptions
from torchsoft.sysid.columns import wraps
from torchsoft.sysid.measured import load, vocabulary
from torchsoft.sysid.prediction import Frozen
from torchsoft.sysid.runs import Runner, since

RIG = RigFile.path("two_fingers")
SENSORS = {"x_disc": 10e-6, "y_disc": 10e-6, "x_left": 10e-6, "effort_left_x": 0.05}
TRUTH: dict[str, float] = {"materials.silicone.E": 0.45e6, "actuators.left_x.Kd": 180.0}
FIT = """
rig = "rig.toml"
start = {kind = "rest", lead = 0.0}
columns.camera = "x_disc"
[settings]
pads.table.elements_x = 25
pads.left_tip.elements_x = 18
pads.right_tip.elements_x = 18
[unknowns]
"materials.silicone.E" = {}
"actuators.left_x.Kd" = {}
[sensors]
x_disc.noise = 1e-5
y_disc.noise = 1e-5
x_left.noise = 1e-5
effort_left_x.noise = 0.05
"""


def coarse(**groups: Any) -> RigFile:
    tips = {name: {"elements_x": 18} for name in ("left_tip", "right_tip")}
    file = RigFile.from_toml(RIG).override(pads={"table": {"elements_x": 25}, **tips})
    return file.override(**groups)


@pytest.fixture(scope="module")
def run():
    """The truth: the fingers close and lift the disc."""
    rig, y0, _ = coarse(
        materials={"silicone": {"E": TRUTH["materials.silicone.E"]}},
        actuators={"left_x": {"Kd": TRUTH["actuators.left_x.Kd"]}},
    ).build()
    return simulate(rig, torch.linspace(0, 1.2, 241, dtype=torch.float64), y0=y0, rtol=1e-6)


@pytest.fixture
def folder(tmp_path, run):
    """The rig's file, a recording, and what is to be found."""
    noise = np.random.default_rng(1)
    (tmp_path / "rig.toml").write_text(RIG.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "fit.toml").write_text(FIT, encoding="utf-8")
    columns = [run[name].numpy() + sd * noise.standard_normal(241) for name, sd in SENSORS.items()]
    head = "t (s),camera (mm),y_disc [mm],x_left [mm],effort_left_x [N]"
    table = np.stack([run.t.numpy(), *(1e3 * x for x in columns[:3]), columns[3]], 1)
    np.savetxt(tmp_path / "run.csv", table, "%.9g", ",", header=head, comments="")
    return tmp_path


def test_numbers_of_a_rig_file_are_found_by_their_names(folder):
    case = load([folder / "run.csv"], folder / "fit.toml")
    shown = str(case.problem).splitlines()
    assert shown[0] == "Problem: 2 unknowns, recordings run"
    assert shown[1].split() == ["materials.silicone.E", "5e+04", "to", "5e+06,", "from", "5e+05"]
    assert shown[-1].split() == ["effort_left_x", "measured", "to", "0.05", "N"]
    result = identify(case.problem, **case.config.fit.model_dump() | {"assumptions": "trusted"})
    for one in result.estimates:
        assert one.value == pytest.approx(TRUTH[one.name], rel=4 * one.relative_sd)
        assert one.relative_sd < 0.05
    assert result.chi2 == pytest.approx(1.0, abs=0.15)


def test_parameters_have_the_names_of_their_tables():
    rig, y0, _ = coarse().build()
    assert rig.parameter("materials.silicone.E") is rig.pads["left_tip"].material.E
    assert rig.parameter("laws.dry.friction.mu_s") is rig.contacts["left"].law.friction.mu_s
    assert rig.parameter("bodies.left.inertia").item() == 1e-4
    assert rig.quantity("laws.dry.K_n").unit == "N/m"
    t = torch.linspace(0, 0.05, 6, dtype=torch.float64)
    by = simulate(rig, t, y0=y0, gradient="forward", wrt=["materials.silicone.E"], rigid=True)
    own = simulate(rig, t, y0=y0, gradient="forward", wrt=["pads.table.material.E"], rigid=True)
    assert torch.equal(by.sensitivities, own.sensitivities)


def test_a_recorded_signal_takes_the_place_of_the_files_motion(folder):
    rows = (folder / "run.csv").read_text(encoding="utf-8").splitlines()
    wave = [f"{row},{-24 + 0.001 * i:.4f}" for i, row in enumerate(rows[1:])]
    text = "\n".join([f"{rows[0]},left_close [mm]", *wave])
    (folder / "run.csv").write_text(text, encoding="utf-8")
    rig = load([folder / "run.csv"], folder / "fit.toml").problem.recordings[0].rig
    at = torch.tensor([0.5], dtype=torch.float64)
    assert isinstance(rig.reference["left_close"], Sampled)
    assert float(rig.follow(at)[0, 0, 0]) == pytest.approx(-23.9e-3)
    motion = coarse().build().rig.reference["right_close"]
    assert torch.equal(rig.reference["right_close"](at)[0], motion(at)[0])


def test_the_time_before_the_first_sample_is_an_assumption(folder):
    """Said otherwise in both directions, on the steps of the fit with others before them."""
    (stated,) = load([folder / "run.csv"], folder / "fit.toml").problem.recordings
    (other,) = [one for one in assumptions([stated], set(), {}) if one.name == "lead"]
    made = other.vary(stated, 1.0, None)
    assert (stated.start.lead, made.start.lead) == (0.0, 0.2)
    (back,) = [one for one in assumptions([made], set(), {}) if one.name == "lead"]
    assert back.vary(made, 1.0, None).start.lead == 0.0
    knots = np.array([0.0, 4e-3, 0.01])
    earlier = since(Frozen(knots), -5e-3).knots
    assert earlier.tolist() == pytest.approx([-5e-3, -3e-3, -1e-3, 0.0, 4e-3, 0.01])
    assert np.array_equal(since(Frozen(earlier), 0.0).knots, knots)


def test_a_trajectory_file_of_the_rig_is_a_recording(folder, run):
    run.save(folder / "run.nc")
    fit = (folder / "fit.toml").read_text(encoding="utf-8").replace('columns.camera = "x_disc"', "")
    (folder / "fit.toml").write_text(fit, encoding="utf-8")
    recording = load([folder / "run.nc"], folder / "fit.toml").problem.recordings[0]
    assert np.array_equal(recording.samples["x_disc"][1], run["x_disc"].numpy())
    assert isinstance(recording.rig.reference["lean"], Sampled)


def replaced(old: str, new: str) -> Callable[[str], str]:
    return lambda text: text.replace(old, new)


CSV, TOML = "run.csv", "fit.toml"
REFUSALS: dict[str, tuple[str, Callable[[str], str], str]] = {
    "sensor": (
        TOML,
        replaced("x_left.n", "x_lft.n"),
        "`x_lft` is not a channel; did you mean `x_left`",
    ),
    "heading": (TOML, replaced('"x_disc"', '"x_dsc"'), "columns.camera = 'x_dsc' is no channel"),
    "unknown": (TOML, replaced("left_x.Kd", "left_x.Ki"), "`actuators.left_x.Ki` cannot be"),
    "paper's pads": (
        TOML,
        lambda text: text + '[pads]\nkind = "kelvin_voigt"\n',
        r"pads is not known: .* say \[settings\.materials\.NAME\]",
    ),
    "no file": (
        TOML,
        replaced('"rig.toml"', '"none.toml"'),
        "rig: .*none.toml: No such file.* the ready",
    ),
    "bad file": ("rig.toml", replaced("mass = 0.25", "mas = 0.25"), "rig: .*`mas` is not known"),
    "settings": (TOML, replaced("table.elements_x", "table.elements"), "settings.*`elements`"),
    "known place": (
        TOML,
        replaced("lead = 0.0", 'position_sd = {"disk.x" = 1e-3}'),
        "`position_sd` of the start speaks of `disk.x`; did you mean `disc.x`",
    ),
    "unit": (CSV, replaced("camera (mm)", "camera (kg)"), "column `camera` cannot be in 'kg'"),
    "column": (CSV, replaced("y_disc", "y_dsk"), "`y_dsk` is not known: did you mean `y_disc`"),
    "own name": (CSV, replaced("camera", "x_disc"), "`x_disc` is not known"),
    "too long": (
        TOML,
        replaced("[settings]", "[settings]\noutputs = {duration = 0.5, snapshots = []}"),
        "row 242, column `t`: 1.2 s is after the end of the file's own motions, 0.5 s",
    ),
    "begun before": (
        CSV,
        lambda text: re.sub(r"(?m)^0\.?[01]?\d*,.*\n", "", text),
        "column `t`: a recording that begins at rest .* at 0 s, not at 1 s",
    ),
    "elsewhere": (
        CSV,
        replaced(",19.8", ",24.8"),
        "column `y_disc`: it begins at .*, but the rig file at",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_what_a_rig_cannot_be_identified_from_is_refused(folder, case):
    name, change, words = REFUSALS[case]
    text = (folder / name).read_text(encoding="utf-8")
    assert change(text) != text
    (folder / name).write_text(change(text), encoding="utf-8")
    with pytest.raises(ValueError, match=words):
        load([folder / "run.csv"], folder / "fit.toml")


@pytest.mark.parametrize(("heading", "name"), [("theta_disc", "theta_disc"), ("eye", "theta_disc")])
@pytest.mark.parametrize("low", [-180.0, 0.0])
def test_an_angle_that_wraps_is_named_and_unwrapped(folder, heading, name, low):
    """Jumps by a turn, across a missing sample too; angles of the recording are those turned."""
    rows = (folder / "run.csv").read_text(encoding="utf-8").splitlines()
    turned = 500 * np.linspace(0, 1.2, 241) ** 2  # [deg], 1.2 turns and more
    column = [f",{(x - low) % 360 + low:.9g}" for x in turned]
    first = int(np.argmax(turned >= 360 + low)) + 1  # index of the row of the jump, from 1
    column[first - 2] = ","
    lines = [f"{rows[0]},{heading} [deg]", *(a + b for a, b in zip(rows[1:], column))]
    (folder / "run.csv").write_text("\n".join(lines), encoding="utf-8")
    fit, of = (folder / "fit.toml").read_text(encoding="utf-8"), f'of = "{name}", '
    named = f'columns.eye = "{name}"\ncolumns.camera' if heading != name else "columns.camera"
    (folder / "fit.toml").write_text(fit.replace("columns.camera", named), encoding="utf-8")
    words = rf"row {first + 1}, column `{heading}` jumps by a turn, .* columns.{heading}.unwrap = "
    with pytest.raises(ValueError, match=words):
        load([folder / "run.csv"], folder / "fit.toml")
    said = f"columns.{heading} = {{{of}unwrap = true}}\ncolumns.camera"
    (folder / "fit.toml").write_text(fit.replace("columns.camera", said), encoding="utf-8")
    (made,) = load([folder / "run.csv"], folder / "fit.toml").problem.recordings
    kept = np.delete(turned, first - 2)
    assert made.samples[name][1] == pytest.approx(np.radians(kept), abs=1e-9)


def test_what_is_no_angle_is_not_unwrapped(folder):
    fit = (folder / "fit.toml").read_text(encoding="utf-8")
    fit = fit.replace("columns.camera", "columns.y_disc.unwrap = true\ncolumns.camera")
    (folder / "fit.toml").write_text(fit, encoding="utf-8")
    with pytest.raises(ValueError, match=r"columns\.y_disc\.unwrap: `y_disc` is in m, and only"):
        load([folder / "run.csv"], folder / "fit.toml")
    assert not len(wraps(np.array([3.0])))
    assert wraps(np.array([3.0, 3.1, -3.1, -3.0])).tolist() == [1]
    assert not len(wraps(10.0 * np.arange(9)))  # degrees taken for radians are another mistake


def test_columns_are_channels_and_signals_with_a_unit():
    known = vocabulary(coarse().assemble(), {})
    assert known.units["lean"] == "rad"
    assert known.units["right_lift_dot"] == "m/s"
    assert "theta_disc" in known.measured
    assert "lean" not in known.measured


PLAN = FIT.replace(
    'start = {kind = "rest", lead = 0.0}',
    'rehearsal = {duration = 0.6, seed = 3}\nfit = {assumptions = "trusted"}',
)


def test_a_rehearsal_says_what_an_experiment_would_identify(folder):
    """Its recording is a template of the real one: the same configuration takes it."""
    (folder / "plan.toml").write_text(PLAN, encoding="utf-8")
    out = folder / "out"
    asked = ["rehearse", str(folder / "plan.toml"), "--out", str(out), "--no-progress"]
    assert main(asked) == 0
    answer = load_answer(out / "answer.json")
    truth = {"materials.silicone.E": 0.5e6, "actuators.left_x.Kd": 150.0}
    for one in answer.estimates:
        assert abs(np.log(one.start / truth[one.name])) == pytest.approx(np.log(1.3))
        assert one.value == pytest.approx(truth[one.name], rel=4 * one.relative_sd)
    head, first, *rows = (out / "rehearsal.csv").read_text(encoding="utf-8").splitlines()
    assert head.startswith("t [s],left_close [m],left_lift [m],lean [rad]")
    assert "camera [m]" in head
    assert first.startswith("0,-0.024,")
    assert len(rows) == 120
    made = load([out / "rehearsal.csv"], folder / "plan.toml").problem.recordings[0]
    assert made.samples["x_disc"][1].std() > 0


@pytest.mark.parametrize(
    ("change", "more", "words"),
    [
        (replaced('rig = "rig.toml"', ""), (), "rig is missing: say rig"),
        (
            lambda text: text,
            ("run.csv",),
            "a rehearsal makes its own data: leave .*run.csv out",
        ),
        (
            replaced("effort_left_x.n", "effort_lft_x.n"),
            (),
            "`effort_lft_x` is not a channel of the rig of `rehearsal`; did you mean",
        ),
    ],
)
def test_what_cannot_be_rehearsed_is_refused(folder, change, more, words, capsys):
    (folder / "plan.toml").write_text(change(PLAN), encoding="utf-8")
    files = [str(folder / name) for name in ("plan.toml", *more)]
    assert main(["rehearse", *files, "--out", str(folder / "out"), "--no-progress"]) == 2
    assert re.search(words, capsys.readouterr().err)


@pytest.mark.slow
def test_a_grasp_in_mid_air_says_that_its_poses_are_to_be_measured():
    """Contact points touch and slip within the intervals of where it begins: finer steps are not
    tried in vain."""
    sensors = {name: Sensor(noise=sd) for name, sd in SENSORS.items()}
    built = coarse(outputs={"duration": 2.0, "snapshots": []}).build()
    made = record("lift", built, TRUTH, sensors, seed=3)
    late = {c: (t[t >= 0.8], y[t >= 0.8]) for c, (t, y) in made.samples.items()}
    begun = estimate_initial_state(replace(made, samples=late), sensors)
    problem = Problem([begun], sensors, {name: Unknown() for name in TRUTH})
    result = identify(problem, assumptions="trusted")
    for name, value in TRUTH.items():
        assert result[name].value == pytest.approx(value, rel=4 * result[name].relative_sd)
    assert not result.converged
    assert len(result.stages) <= 7
    (said,) = result.notices
    assert re.search(r"not smooth in .*start\.right\.x", said)
    assert "measure every coordinate of the bodies when the recording begins" in said


def test_a_body_rests_where_the_parameters_let_it_rest(tmp_path, folder):
    """It sinks deeper into softer pads: at the truth nothing but noise is left, though the file has
    another modulus; derivatives by it count that."""
    truth = TRUTH | {"materials.silicone.E": 0.3e6}
    rig, y0, _ = coarse(
        materials={"silicone": {"E": truth["materials.silicone.E"]}},
        actuators={"left_x": {"Kd": truth["actuators.left_x.Kd"]}},
    ).build()
    run = simulate(rig, torch.linspace(0, 0.1, 51, dtype=torch.float64), y0=y0, rtol=1e-6)
    table = np.stack([run.t.numpy(), run["y_disc"].numpy()], 1)
    np.savetxt(folder / "run.csv", table, "%.12g", ",", header="t [s],y_disc [m]", comments="")
    fit = FIT.partition("x_disc.noise")[0].replace('columns.camera = "x_disc"\n', "")
    (folder / "fit.toml").write_text(fit + "y_disc.noise = 1e-7\n", encoding="utf-8")
    problem = load([folder / "run.csv"], folder / "fit.toml").problem
    c, runner = problem.coordinates, Runner(problem.recordings)
    x = np.array([np.log(truth[name]) for name in c.names])
    at = problem.residuals(runner, x, problem.names, 1e-6, c.free)
    assert np.abs(at.r).max() < 0.05
    h = np.array([1e-4, 0.0])
    ends = [problem.residuals(runner, x + s * h, problem.names, at.steps).r for s in (1, -1)]
    assert at.J[:, 0] == pytest.approx((ends[0] - ends[1]) / 2e-4, abs=1e-4 * np.abs(at.J).max())
