"""Variations of a recording: each does what it says, by closed forms and by invariances; readings
behind a low-pass."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RUBBER, dry, excited, stroked

from torchsoft import Body, Circle, Contact, KelvinVoigt, Pad, PadMesh, Reference, Rig
from torchsoft.sysid import Known, Problem, Recording, Sensor, Unknown, record
from torchsoft.sysid.assumptions import AMOUNTS, assumptions
from torchsoft.sysid.prediction import Prediction, Readout, Signals, Term, lagged, predict
from torchsoft.sysid.problem import DIFFERENCE
from torchsoft.sysid.recording import Grid, extended
from torchsoft.sysid.refits import assuming, start_under
from torchsoft.sysid.runs import Runner

E, MU_K = "materials.rubber.E", "laws.steel_on_rubber.friction.mu_k"
SENSORS = {"x_C": Sensor(noise=1e-5), "effort_x": Sensor(noise=0.1), "effort_y": Sensor(noise=0.1)}
FINER = {"pad.elements_x": 120, "pad.elements_y": 4}
STROKES = stroked(travel=8e-3, stroke_time=0.15, duration=0.4, grasp=0.15, since=0.2)


def run_of(recording: Recording, derived: bool = False, /) -> Prediction:
    return predict(recording.run_context(), {}, recording.grid(True), (), 1e-6)


def variation(recording: Recording, name: str, sensors: dict[str, Sensor] | None = None) -> Any:
    """The assumption of that name, with its variation."""
    every = assumptions([recording], {E}, SENSORS if sensors is None else sensors)
    return next(one for one in every if one.name == name)


def varied(recording: Recording, name: str, amount: float) -> Any:
    """The recording with an assumption varied by an amount, in the unit of its test."""
    return variation(recording, name).vary(recording, amount, run_of)


@cache
def strokes(kind: str = "kelvin_voigt") -> Recording:
    file = PAPER.override({**COARSE, "materials.rubber.kind": kind})
    return record("strokes", excited(STROKES, file), {E: 0.9e6}, SENSORS)


@cache
def thrown() -> Recording:
    """A disc in free flight, which spins; the pad is far below."""
    mesh = PadMesh(length=20e-3, height=4e-3, elements_x=4, elements_y=2)
    rig = Rig(
        bodies={"disc": Body(0.4, Circle(19e-3))},
        pads={"floor": Pad(mesh, KelvinVoigt(**RUBBER, tau=0.01))},
        contacts={"floor": Contact("floor", "disc", dry(), may_leave=True)}, reference=Reference(),
    )  # fmt: skip
    y0 = rig.state(disc={"x": 0.01, "y": 2.0, "v_x": 0.3, "v_y": 1.0, "omega": 20.0})
    t = np.linspace(0.0, 0.2, 21)
    return Recording("flight", rig, {"x_disc": (t, 0 * t)}, Known(y0))


def test_a_recording_starts_where_its_rig_does():
    """Also a body that presses another, by a depth, onto a pad that gives way."""
    built = excited(STROKES, PAPER.override(COARSE))
    stated = record("strokes", built, {}, SENSORS, rtol=1e-3)
    poses = [built.rig.unpack(y).pose for y in (stated.run_context().y0({}), built.y0)]
    for body in ("disc", "bracket"):
        np.testing.assert_allclose(*(one[body].detach() for one in poses), atol=1e-9)
    unsure = replace(stated, start=stated.start._replace(position_sd={"disc.x": 1e-3}))
    place = torch.tensor(60.4e-3, dtype=torch.float64)
    initial = built.rig.unpack(unsure.run_context().y0({"start.disc.x": place})).pose
    assert initial["disc"][0].item() == pytest.approx(60.4e-3, abs=1e-12)


@pytest.mark.parametrize("c", [(2e-3, 0.0), (0.0, -1e-3)])
def test_a_body_whose_mass_is_off_its_contour_flies_about_its_centre_of_mass(c):
    """Which goes on a parabola, while the spin stays what it is."""
    flight, axis = thrown(), "x" if c[0] else "y"
    made = varied(flight, f"bodies.disc.centre_{axis}", 1e3 * sum(c))
    at = run_of(made)
    named = dict(zip(made.channels, at.signals.T))
    angle, t = 20.0 * at.t, at.t[:, None]
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    start = np.array([0.01, 2.0]) + c
    speed = np.array([0.3, 1.0]) + 20.0 * np.array([-c[1], c[0]])
    mass_centre = start + speed * t + 0.5 * np.array([0.0, -9.81]) * t**2
    exact = mass_centre - np.einsum("ijt,j->ti", R, c)
    found = np.stack([named["x_disc"], named["y_disc"]], -1)
    np.testing.assert_allclose(found, exact, atol=1e-3 * np.linalg.norm(c))
    np.testing.assert_allclose(named["theta_disc"], angle, atol=1e-5)


@pytest.mark.parametrize(("parameter", "late"), [("actuators.lag", "xy"), ("actuators.y.lag", "y")])
def test_a_controller_that_is_late_pushes_behind_a_low_pass(parameter, late):
    """The y loop has a feed-forward of its own beside it."""
    made = extended(strokes(), [parameter])
    torch.nn.init.constant_(made.rig.parameter(parameter), 5e-4)
    fine = torch.arange(made.run_start, 0.4, 1e-4, dtype=torch.float64)
    at = predict(made.run_context(), {}, Grid(fine, 0), (), 1e-6)
    named = dict(zip(made.channels, at.signals.T))
    for name, actuator in made.rig.actuators.items():
        signals = made.rig.reference(torch.from_numpy(at.t), actuator.reads).numpy()
        body, axis = actuator.measured.split(".")
        channel, law = f"{axis}_{made.rig.symbols[body]}", strokes().rig.actuators[name].law
        effort = law.Kp.item() * (signals[:, 0, 0] - named[channel])
        effort += law.Kd.item() * (signals[:, 0, 1] - named[f"v_{channel}"])
        effort += signals[:, 1:, 0].sum(1)
        behind = lagged(at.t, effort, 5e-4 if name in late else 0.0)
        changes = np.abs(lagged(at.t, effort, 5e-4) - effort).max()
        assert changes > 0.05
        assert np.abs(behind - named[f"effort_{name}"]).max() < 0.02 * changes, name


@pytest.mark.parametrize("name", ["x", "y"])
def test_a_limit_cuts_the_largest_efforts_off(name):
    """By a part of the largest one without it, and no other effort, with what that does later."""
    channel = strokes().channels.index(f"effort_{name}")
    without, cut = (
        run_of(varied(strokes(), f"limit of the controller {name}", part)).signals[:, channel]
        for part in (0.0, 10.0)
    )
    np.testing.assert_allclose(without, run_of(strokes()).signals[:, channel], atol=1e-3)
    most = 0.9 * np.abs(without).max()
    assert np.abs(cut).max() == pytest.approx(most, rel=1e-4)
    first = np.flatnonzero(np.abs(without) > most)[0]
    np.testing.assert_allclose(cut[:first], without[:first], atol=1e-3)


def face(recording: Recording, name: str) -> np.ndarray:
    """Places (k, 2) of the nodes of a pad's face."""
    pad = recording.rig.pads[name]
    return np.array(pad.placed(pad.mesh.nodes[pad.mesh.face]))


@pytest.mark.parametrize("name", ["L", "U"])
def test_pads_keep_their_faces_and_first_ends_or_turn_about_the_middle(name):
    stated, up = strokes(), 1e-4 if name == "L" else -1e-4
    pad, at = stated.rig.pads[name], face(stated, name)
    for extent in ("height", "length"):
        for who in (f"the pad {name}", "pads"):
            other = varied(stated, f"{extent} of {who}", 2.0)
            new = other.rig.pads[name]
            assert getattr(new.mesh, extent) == pytest.approx(1.02 * getattr(pad.mesh, extent))
            np.testing.assert_allclose(face(other, name)[0], at[0], atol=1e-15)
            assert new.material.E is not pad.material.E
    turned = face(varied(stated, f"tilt of the pad {name}", 5.0), name)
    np.testing.assert_allclose(turned.mean(0), at.mean(0), atol=1e-15)
    slope = (turned[-1, 1] - turned[0, 1]) / (turned[-1, 0] - turned[0, 0])
    assert slope == pytest.approx(np.tan(5e-3))
    nearer = face(varied(stated, f"place of the pad {name}", 100.0), name) - at
    np.testing.assert_allclose(nearer, np.broadcast_to([0.0, up], nearer.shape), atol=1e-15)
    fine = varied(stated, "mesh", 1.0).rig.pads[name]
    assert (fine.mesh.elements_x, fine.mesh.elements_y, fine.points) == (120, 4, pad.points)
    assert varied(stated, "contact points", 1.0).rig.pads[name].points == pad.points + 2
    np.testing.assert_allclose(fine.positions[[0, -1]], pad.positions[[0, -1]], atol=1e-15)
    step = face(varied(stated, "mesh phase", 1.0), name) - at
    np.testing.assert_allclose(np.abs(step[:, 0]), 0.25 * pad.mesh.length / 60, rtol=1e-9)


def test_springs_that_follow_the_pads_follow_those_of_a_variation():
    coarse, finer = (
        PAPER.override(COARSE | {"contact.K_n": "auto"} | more).assemble() for more in ({}, FINER)
    )
    coarse.reference = strokes().rig.reference
    made = varied(replace(strokes(), rig=coarse), "mesh", 1.0).rig
    stated, found, built = (rig.contacts["U"].law.K_n.item() for rig in (coarse, made, finer))
    assert found == pytest.approx(built)
    assert found > 1.5 * stated


def test_a_run_from_a_state_of_the_pads_has_no_other_pads():
    for name in ("tilt of the pad floor", "height of the pad floor", "mesh"):
        assert varied(thrown(), name, 1.0) is None


def test_a_channel_reads_a_part_of_another_and_a_camera_has_a_scale():
    data, places = strokes(), {**SENSORS, "y_Br": Sensor(noise=1e-5)}
    (_, x), (_, fy) = data.samples["x_C"], data.samples["effort_y"]
    crossed, scaled = (
        variation(data, name, places).read
        for name in ("crosstalk effort_y to effort_x", "scale of the camera")
    )
    np.testing.assert_allclose(crossed(data, "effort_x", 2.0), -0.02 * fy)
    assert not crossed(data, "effort_y", 2.0).any()
    np.testing.assert_allclose(scaled(data, "x_C", 1.0), -0.01 * (x - x[0]))
    assert not scaled(data, "effort_x", 1.0).any()


def test_a_camera_that_is_turned_mixes_coordinates_about_their_first_samples():
    """Of a disc in the plane, at other times in one coordinate."""
    t, late = np.linspace(0.0, 1.0, 11), np.linspace(0.0, 1.0, 21)
    path = {"x_disc": lambda t: 0.1 + t, "y_disc": lambda t: 2.0 - 3.0 * t}
    c, s = np.cos(1e-3), np.sin(1e-3)
    seen = {
        "x_disc": (t, 0.1 + c * t - 3.0 * s * t),
        "y_disc": (late, 2.0 - 3.0 * c * late - s * late),
    }
    data = replace(thrown(), samples=seen)
    turned = variation(data, "angle of the camera on disc", dict.fromkeys(seen, Sensor(noise=1e-5)))
    for channel, (at, y) in seen.items():
        lost = turned.read(data, channel, 1.0)
        np.testing.assert_allclose(y + lost, path[channel](at), atol=4e-6)


def test_what_is_unknown_is_not_taken_for_granted():
    some = {"bodies.disc.shape.radius", "start.disc.x", "bias of x_C"}
    names, left = (
        {one.name for one in assumptions([strokes()], unknown, SENSORS)}
        for unknown in (set(), some)
    )
    assert names - left == {"bodies.disc.shape.radius", "start of disc.x", "bias x_C"}


def test_a_number_is_varied_as_far_as_there_is_a_rig():
    """Friction in slip must not exceed that at rest."""
    first = strokes()
    data = replace(first, rig=changed(first, MU_K, 0.795))
    one = variation(data, MU_K)
    c = assuming(Problem([data], SENSORS, {E: Unknown()}), [one], free=True).coordinates
    sliding = next(a for a in c.all if a.name == MU_K)
    reach = AMOUNTS * one.step / one.nominal
    assert sliding.low == pytest.approx((1 - reach) * 0.795)
    assert 0.795 < sliding.high < 0.8 < (1 + reach) * 0.795


def test_amounts_of_variations_are_coordinates_with_differences_as_derivatives():
    """Held at zero they change nothing; at an amount residuals are those of the varied recording,
    and the column of a free one is a difference by a part of its amount."""
    data = strokes()
    problem, runner = Problem([data], SENSORS, {E: Unknown()}), Runner([data])
    chosen = [variation(data, n) for n in ("height of pads", "crosstalk effort_y to effort_x")]
    other = assuming(problem, chosen, free=True)
    c, which, start = other.coordinates, problem.names, problem.coordinates.start
    assert c.labels == (E, *(one.name for one in chosen))
    base = problem.residuals(runner, start, which, 1e-4)
    x = start_under(other, chosen, {E: start[0]})
    at = other.residuals(other.runner(runner), x, which, base.steps, c.free)
    np.testing.assert_allclose(at.r, base.r, atol=1e-6)
    thicker = varied(data, "height of pads", DIFFERENCE)
    own = Problem([thicker], SENSORS, {E: Unknown()})
    moved = own.residuals(Runner([thicker]), start, which, base.steps)
    change = at.J[:, 1] * c.all[1].to_x(DIFFERENCE)
    np.testing.assert_allclose(change, moved.r - base.r, rtol=1e-9, atol=1e-9)
    rows = len(data.samples["effort_x"][0])
    column = at.J[rows : 2 * rows, 2] * c.all[2].to_x(0.1)
    np.testing.assert_allclose(column, 1e-2 * data.samples["effort_y"][1], rtol=1e-6, atol=1e-9)
    held = assuming(problem, chosen, free=False)
    assert held.coordinates.free.tolist() == [True, False, False]


NOISE = 0.02


def reading(lag: float = 0.0, backlash: float = 0.0) -> Readout:
    """The channel y by a sensor with a gain of 1.2."""
    return Readout(
        "y", NOISE, None, None, gain=1.2, bias=0.0, drift=0.0, delay=0.0, middle=0.05,
        terms=(Term("y", 0, 1.0),), lag=lag, backlash=backlash,
    )  # fmt: skip


T = np.linspace(0.0, 0.1, 401)
SWING = np.sin(60 * T)


@pytest.mark.parametrize(
    ("lag", "backlash", "wrt"),
    [(4e-3, 0.0, "lag"), (0.0, 0.2, "backlash"), (4e-3, 0.2, "backlash")],
)
def test_derivatives_of_a_reading_are_those_of_differences(lag, backlash, wrt):
    """With respect to its fault and to the signal; weights are pulled back by the transpose."""
    times, step = T[3:-3], 1e-7
    signals = Signals(T, ("y",), SWING[:, None], SWING[:, None, None])
    _, slopes, by = reading(lag, backlash).expected(signals, times)
    near = [
        reading(lag + part * (wrt == "lag"), backlash + part * (wrt != "lag")).expected(
            signals, times
        )[0]
        for part in (step, -step)
    ]
    np.testing.assert_allclose(by[wrt], (near[0] - near[1]) / (2 * step), rtol=1e-5, atol=1e-3)
    louder = Signals(T, ("y",), (1 + step) * SWING[:, None], None)
    more, same = (reading(lag, backlash).expected(one, times)[0] for one in (louder, signals))
    np.testing.assert_allclose(slopes[:, 0], (more - same) / step, atol=1e-5)
    v = np.random.default_rng(0).standard_normal(len(times))
    pulled = reading(lag, backlash).pulled_back(signals, times, v)
    assert float(np.sum(pulled[:, 0] * SWING)) == pytest.approx(float(v @ slopes[:, 0]), rel=1e-9)


def test_a_low_pass_and_backlash_have_closed_forms():
    """A ramp, and a swing from the middle of the play; at zero the derivative with respect to a lag
    is that of a delay, and with respect to backlash a difference by a play of the noise."""
    ramp = np.maximum(T - 0.02, 0.0)
    exact = np.where(T > 0.02, ramp - 5e-3 * (1 - np.exp(-ramp / 5e-3)), 0.0)
    np.testing.assert_allclose(lagged(T, ramp, 5e-3), exact, atol=1e-12)
    signals, times = Signals(T, ("y",), SWING[:, None], SWING[:, None, None]), T[3:-3]
    turns, swing = (0.5 * np.pi / 60, 1.5 * np.pi / 60), SWING[3:-3]
    falls = np.where(times < turns[0], np.maximum(swing - 0.1, 0.0), np.minimum(swing + 0.1, 0.9))
    whole = np.where(times < turns[1], falls, np.maximum(swing - 0.1, -0.9))
    read = reading(backlash=0.2).expected(signals, times)[0] / 1.2
    np.testing.assert_allclose(read, whole, atol=2e-3)
    value, _, by = reading().expected(signals, times)
    np.testing.assert_allclose(value, 1.2 * swing, rtol=1e-12)
    np.testing.assert_array_equal(by["lag"], by["delay"])
    just_shown = reading(backlash=NOISE).expected(signals, times)[0]
    np.testing.assert_allclose(by["backlash"], (just_shown - value) / NOISE, atol=1e-9)
    middle = reading().middle
    np.testing.assert_allclose(by["drift"], times - middle, atol=1e-12)


def test_a_number_that_recordings_state_otherwise_is_varied_in_each():
    first, mass = strokes(), "bodies.disc.mass"
    other = replace(first, name="other", rig=changed(first, mass, 0.5))
    (one,) = (v for v in assumptions([first, other], {E}, SENSORS) if v.name == mass)
    assert not one.parameter
    assert one.vary is not None
    made = [one.vary(r, 2.0, run_of).parameters[mass] for r in (first, other)]
    np.testing.assert_allclose(made, [1.02 * first.parameters[mass], 1.02 * 0.5])


def changed(recording: Recording, name: str, value: float) -> Rig:
    rig = recording.run_context().rig
    with torch.no_grad():
        rig.parameter(name).fill_(value)
    return rig


@pytest.mark.slow
def test_linear_pads_at_finite_strain_are_those_of_a_neo_hookean_file():
    """With the same names of numbers, of which both pads have one."""
    made = varied(strokes(), "finite strain", 1.0)
    built = replace(strokes("neo_hookean"), start=strokes().start)
    built.rig.reference = strokes().rig.reference
    assert made.parameters == built.parameters
    again = {one.name for one in assumptions([made], {E}, SENSORS)}
    assert "finite strain" not in again
    grid = made.grid(False)
    one, other = (predict(r.run_context(), {E: 0.8e6}, grid, (), 1e-3) for r in (made, built))
    assert (one.signals == other.signals).all()
    linear = predict(strokes().run_context(), {E: 0.8e6}, grid, (), 1e-3)
    y = strokes().channels.index("effort_y")
    assert one.signals[-1, y] / linear.signals[-1, y] > 1.03
