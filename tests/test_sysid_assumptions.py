"""Variations of a recording: each does what it says, by closed forms and by invariances; readings
behind a low-pass."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RUBBER, dry, excited, stroked

from torchsoft import Body, Circle, Contact, KelvinVoigt, Pad, PadMesh, Reference, Rig
from torchsoft.physics.motion import Sampled
from torchsoft.sysid import Known, Problem, Recording, Sensor, Unknown, record
from torchsoft.sysid.assumptions import (
    COORDINATES,
    assumptions,
    at_finite_strain,
    lifted,
    limited,
    linear_pads,
    of_fifth_degree,
    off_centre,
    read_across,
    rescaled,
    resized,
    seen_askew,
    tilted,
    with_loads,
)
from torchsoft.sysid.prediction import Frozen, Prediction, Readout, Signals, Term, lagged, predict
from torchsoft.sysid.problem import DIFFERENCE
from torchsoft.sysid.recording import Grid, extended
from torchsoft.sysid.refits import assuming, begun
from torchsoft.sysid.runs import Runner

E = "materials.rubber.E"
SENSORS = {"x_C": Sensor(noise=1e-5), "effort_x": Sensor(noise=0.1), "effort_y": Sensor(noise=0.1)}


def run_of(recording: Recording, derived: bool = False, /) -> Prediction:
    return predict(recording.begin(), {}, recording.grid(True), (), 1e-6)


@cache
def strokes(kind: str = "kelvin_voigt") -> Recording:
    motion = stroked(travel=8e-3, stroke_time=0.15, duration=0.4, grasp=0.15, since=0.2)
    file = PAPER.override({**COARSE, "materials.rubber.kind": kind})
    return record("strokes", excited(motion, file), {E: 0.9e6}, SENSORS)


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


def test_a_body_whose_mass_is_off_its_contour_flies_about_its_centre_of_mass():
    """Which goes on a parabola, while the spin stays what it is."""
    c, flight = np.array([2e-3, -1e-3]), thrown()
    made = off_centre(flight, run_of, "disc", (c[0], c[1]))
    at = run_of(made)
    named = dict(zip(made.channels, at.signals.T))
    angle, t = 20.0 * at.t, at.t[:, None]
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    arm = np.einsum("ijt,j->ti", R, c)
    start = np.array([0.01, 2.0]) + c
    speed = np.array([0.3, 1.0]) + 20.0 * np.array([-c[1], c[0]])
    mass_centre = start + speed * t + 0.5 * np.array([0.0, -9.81]) * t**2
    exact = mass_centre - arm
    for k, axis in enumerate("xy"):
        moved = np.abs(named[f"{axis}_disc"] - exact[:, k]).max()
        assert moved < 1e-3 * np.linalg.norm(c), axis
    np.testing.assert_allclose(named["theta_disc"], angle, atol=1e-5)


def test_a_load_along_a_run_adds_to_gravity():
    """Its weight once more makes a body fall at 2 g."""
    flight = thrown()
    t = np.linspace(0.0, 0.2, 21)
    loads = np.zeros((21, len(COORDINATES)))
    loads[:, 1] = -0.4 * 9.81
    at = run_of(with_loads(flight, t, "disc", loads))
    y = at.signals[:, with_loads(flight, t, "disc", loads).channels.index("y_disc")]
    np.testing.assert_allclose(y, 2.0 + 1.0 * at.t - 9.81 * at.t**2, atol=1e-7)


@pytest.mark.parametrize(("parameter", "late"), [("actuators.lag", "xy"), ("actuators.y.lag", "y")])
def test_a_controller_that_is_late_pushes_behind_a_low_pass(parameter, late):
    """The y loop has a feed-forward of its own beside it."""
    made = extended(strokes(), [parameter])
    torch.nn.init.constant_(made.rig.parameter(parameter), 5e-4)
    fine = torch.arange(made.begins, 0.4, 1e-4, dtype=torch.float64)
    at = predict(made.begin(), {}, Grid(fine, 0), (), 1e-6)
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
        run_of(limited(strokes(), run_of, name, part)).signals[:, channel] for part in (0.0, 10.0)
    )
    np.testing.assert_allclose(without, run_of(strokes()).signals[:, channel], atol=1e-3)
    most = 0.9 * np.abs(without).max()
    assert np.abs(cut).max() == pytest.approx(most, rel=1e-4)
    first = np.flatnonzero(np.abs(without) > most)[0]
    np.testing.assert_allclose(cut[:first], without[:first], atol=1e-3)


def first_end(recording: Recording, name: str) -> np.ndarray:
    pad = recording.rig.pads[name]
    return pad.placed(pad.mesh.nodes[pad.mesh.face][0])


def middle(recording: Recording, name: str) -> np.ndarray:
    pad = recording.rig.pads[name]
    return pad.placed(pad.mesh.nodes[pad.mesh.face].mean(0))


@pytest.mark.parametrize("name", ["L", "U"])
def test_pads_keep_their_faces_and_first_ends_or_turn_about_the_middle(name):
    stated = strokes()
    pad = stated.rig.pads[name]
    for extent in ("height", "length"):
        other = resized(stated, [name], extent, 0.02)
        new = other.rig.pads[name]
        assert getattr(new.mesh, extent) == pytest.approx(1.02 * getattr(pad.mesh, extent))
        at = first_end(stated, name)
        np.testing.assert_allclose(first_end(other, name), at, atol=1e-15)
        assert new.material.E is not pad.material.E
    turned = tilted(stated, name, 5e-3)
    np.testing.assert_allclose(middle(turned, name), middle(stated, name), atol=1e-15)
    face = turned.rig.pads[name].positions
    slope = (face[-1, 1] - face[0, 1]) / (face[-1, 0] - face[0, 0])
    assert slope.item() == pytest.approx(np.tan(5e-3))
    nearer = middle(lifted(stated, name, 1e-4), name) - middle(stated, name)
    np.testing.assert_allclose(nearer, [0.0, 1e-4 if name == "L" else -1e-4], atol=1e-15)


def test_a_run_from_a_state_of_the_pads_has_no_other_pads():
    assert tilted(thrown(), "floor", 1e-3) is None
    assert resized(thrown(), ["floor"], "height", 0.01) is None


def test_a_channel_reads_a_part_of_another_and_a_camera_has_a_scale():
    data = strokes()
    (_, x), (_, fy) = data.samples["effort_x"], data.samples["effort_y"]
    np.testing.assert_allclose(
        read_across(data, "effort_x", "effort_x", "effort_y", 0.02), -0.02 * fy
    )
    assert not read_across(data, "effort_y", "effort_x", "effort_y", 0.02).any()
    place = data.samples["x_C"][1]
    np.testing.assert_allclose(rescaled(data, "x_C", ["x_C"], 0.01), -0.01 * (place - place[0]))
    assert not rescaled(data, "effort_x", ["x_C"], 0.01).any()
    assert len(x) == len(fy)


def test_a_camera_that_is_turned_mixes_coordinates_about_their_first_samples():
    """Of a disc in the plane, at other times in one coordinate."""
    t, late = np.linspace(0.0, 1.0, 11), np.linspace(0.0, 1.0, 21)
    path = {"x_disc": lambda t: 0.1 + t, "y_disc": lambda t: 2.0 - 3.0 * t}
    at = {"x_disc": t, "y_disc": late}
    c, s = np.cos(1e-3), np.sin(1e-3)
    seen = {
        "x_disc": (t, 0.1 + c * t - 3.0 * s * t),
        "y_disc": (late, 2.0 - 3.0 * c * late - s * late),
    }
    data = replace(thrown(), samples=seen)
    for channel in at:
        lost = seen_askew(data, channel, ("x_disc", "y_disc"), 1e-3)
        np.testing.assert_allclose(seen[channel][1] + lost, path[channel](at[channel]), atol=4e-6)
    names = {one.name for one in assumptions([data], set(), dict.fromkeys(at, Sensor(noise=1e-5)))}
    assert "angle of the camera on disc" in names


def test_amounts_of_variations_are_coordinates_with_differences_as_derivatives():
    """Held at zero they change nothing; at an amount residuals are those of the varied recording,
    and the column of a free one is a difference by a part of its amount."""
    data = strokes()
    problem = Problem([data], SENSORS, {E: Unknown()})
    known = {one.name: one for one in assumptions([data], {E}, SENSORS)}
    chosen = [known["height of pads"], known["crosstalk effort_y to effort_x"]]
    other = assuming(problem, chosen, free=True)
    c, which = other.coordinates, problem.names
    assert c.labels == (E, *(one.name for one in chosen))
    x = begun(other, chosen, {E: problem.coordinates.start[0]})
    base = problem.residuals(Runner([data]), problem.coordinates.start, which, 1e-4)
    steps = base.steps
    at = other.residuals(other.runner(Runner([data])), x, which, steps, c.free)
    np.testing.assert_allclose(at.r, base.r, atol=1e-6)
    thicker = resized(data, ["L", "U"], "height", 0.01 * DIFFERENCE)
    own = Problem([thicker], SENSORS, {E: Unknown()})
    moved = own.residuals(Runner([thicker]), problem.coordinates.start, which, steps)
    one = c.all[1]
    change = at.J[:, 1] * one.to_x(DIFFERENCE)
    np.testing.assert_allclose(change, moved.r - base.r, rtol=1e-9, atol=1e-9)
    rows = len(data.samples["effort_x"][0])
    crossed = -1e-3 * data.samples["effort_y"][1] / 0.1
    column = at.J[rows : 2 * rows, 2] * c.all[2].to_x(0.1)
    np.testing.assert_allclose(column, -crossed, rtol=1e-6, atol=1e-9)
    held = assuming(problem, chosen, free=False)
    assert held.coordinates.free.tolist() == [True, False, False]


def test_under_a_limit_derivatives_are_those_of_what_moves_it():
    """Those of the largest effort without it, a part of which it is, by differences on the steps;
    and what a tolerance chooses is what those steps are."""
    data = strokes()
    problem = Problem([data], SENSORS, {E: Unknown()})
    known = {one.name: one for one in assumptions([data], {E}, SENSORS)}
    other = assuming(problem, [known["limit of the controller x"]], free=True)
    c, which, runner = other.coordinates, problem.names, other.runner(Runner([data]))
    x = c.start.copy()
    x[1] = c.all[1].to_x(10.0)
    at = other.residuals(runner, x, which, 1e-5, c.free)
    again = other.residuals(runner, x, which, at.steps)
    np.testing.assert_allclose(again.r, at.r, atol=1e-9)
    ahead, behind = (
        other.residuals(runner, x + [step, 0.0], which, at.steps).r for step in (1e-4, -1e-4)
    )
    apart = at.J[:, 0] - (ahead - behind) / 2e-4
    assert np.linalg.norm(apart) < 1e-2 * np.linalg.norm(at.J[:, 0])


NOISE = 0.02


def reading(lag: float = 0.0, backlash: float = 0.0) -> Readout:
    """The channel y by a sensor with a gain of 1.2."""
    return Readout(
        "y", NOISE, None, None, gain=1.2, bias=0.0, drift=0.0, delay=0.0, middle=0.05,
        terms=(Term("y", 0, 1.0),), lag=lag, backlash=backlash,
    )  # fmt: skip


def test_a_reading_behind_a_low_pass_with_its_derivatives():
    """A step and a ramp by their closed forms; the derivative by the time constant by differences,
    and at zero that of a delay; weights pulled back by the transpose."""
    t = np.linspace(0.0, 0.1, 401)
    ramp = np.maximum(t - 0.02, 0.0)
    exact = np.where(t > 0.02, ramp - 5e-3 * (1 - np.exp(-ramp / 5e-3)), 0.0)
    np.testing.assert_allclose(lagged(t, ramp, 5e-3), exact, atol=1e-12)
    y = np.sin(60 * t)[:, None]
    signals, times = Signals(t, ("y",), y, y[..., None]), np.linspace(0.01, 0.09, 40)
    value, slopes, by = reading(4e-3).expected(signals, times)
    np.testing.assert_allclose(slopes[:, 0], value, rtol=1e-9)  # linear in the signal
    step = 1e-6
    near = [reading(4e-3 + part).expected(signals, times)[0] for part in (step, -step)]
    np.testing.assert_allclose(by["lag"], (near[0] - near[1]) / (2 * step), rtol=1e-5, atol=1e-3)
    *_, still = reading(0.0).expected(signals, times)
    np.testing.assert_array_equal(still["lag"], still["delay"])
    v = np.random.default_rng(0).standard_normal(len(times))
    pulled = reading(4e-3).pulled_back(signals, times, v)
    assert float(np.sum(pulled * y)) == pytest.approx(float(v @ value), rel=1e-9)


def test_a_reading_with_backlash_with_its_derivatives():
    """A swing by its closed form; the derivative by the width by differences, at zero by a play of
    the noise; weights pulled back by the transpose."""
    t = np.linspace(0.0, 0.1, 401)
    y = np.sin(60 * t)
    signals, times = Signals(t, ("y",), y[:, None], y[:, None, None]), t[3:-3]
    turns = 0.5 * np.pi / 60, 1.5 * np.pi / 60
    swing, value = y[3:-3], reading(backlash=0.2).expected(signals, times)[0] / 1.2
    early = np.maximum(swing - 0.1, 0.0)  # from the middle of the play
    falls = np.where(times < turns[0], early, np.minimum(swing + 0.1, 0.9))
    whole = np.where(times < turns[1], falls, np.maximum(swing - 0.1, -0.9))
    np.testing.assert_allclose(value, whole, atol=2e-3)
    for width, lag in ((0.2, 0.0), (0.2, 4e-3)):
        _, slopes, by = reading(lag, width).expected(signals, times)
        step = 1e-7
        near = [reading(lag, width + part).expected(signals, times)[0] for part in (step, -step)]
        np.testing.assert_allclose(by["backlash"], (near[0] - near[1]) / (2 * step), atol=1e-6)
        louder = Signals(t, ("y",), (1 + 1e-7) * y[:, None], None)
        (more, _, _), (same, _, _) = (
            reading(lag, width).expected(one, times) for one in (louder, signals)
        )
        np.testing.assert_allclose(slopes[:, 0], (more - same) / 1e-7, atol=1e-5)
        v = np.random.default_rng(0).standard_normal(len(times))
        pulled = reading(lag, width).pulled_back(signals, times, v)
        assert float(np.sum(pulled[:, 0] * y)) == pytest.approx(float(v @ slopes[:, 0]), rel=1e-9)
    value, _, by = reading().expected(signals, times)
    np.testing.assert_allclose(value, 1.2 * y[3:-3], rtol=1e-12)
    just_shown, *_ = reading(backlash=NOISE).expected(signals, times)
    np.testing.assert_allclose(by["backlash"], (just_shown - value) / NOISE, atol=1e-9)


def test_a_number_that_recordings_state_otherwise_is_varied_in_each():
    first = strokes()
    mass = "bodies.disc.mass"
    other = replace(first, name="other", rig=replace_mass(first, 0.5))
    (one,) = (v for v in assumptions([first, other], {E}, SENSORS) if v.name == mass)
    assert not one.parameter
    made = [one.vary(r, 2.0, run_of).parameters[mass] for r in (first, other)]
    np.testing.assert_allclose(made, [1.02 * first.parameters[mass], 1.02 * 0.5])


def replace_mass(recording: Recording, mass: float) -> Rig:
    rig = recording.begin().rig
    with torch.no_grad():
        rig.parameter("bodies.disc.mass").fill_(mass)
    return rig


# Numbers that drift along a recording


def drifted(by: float) -> Recording:
    return replace(strokes(), drifts={E: by})


def test_a_number_that_drifts_changes_along_the_samples():
    """Before them it is as stated; after them, where all is at rest, that of a softer pad, but for
    the friction on the way."""
    whole, grid = run_of(strokes()), strokes().grid(True)
    frozen = Frozen(np.array(whole.knots))
    as_stated, pieces, softer, soft = (
        predict(one.begin(), at, grid, (), frozen).signals
        for one, at in (
            (strokes(), {}), (drifted(0.0), {}), (drifted(-0.1), {}),
            (strokes(), {E: 0.9 * strokes().parameters[E]}),
        )
    )  # fmt: skip
    np.testing.assert_allclose(pieces, as_stated, atol=1e-8)
    assert (softer[whole.t < 0.0] == as_stated[whole.t < 0.0]).all()
    y = strokes().channels.index("effort_y")
    fallen = soft[-1, y] / as_stated[-1, y] - 1
    assert fallen < -0.05
    assert softer[-1, y] / as_stated[-1, y] - 1 == pytest.approx(fallen, rel=0.03)


def test_derivatives_of_a_run_that_drifts():
    names = [E, "laws.steel_on_rubber.friction.mu_s"]
    grid, made = strokes().grid(True), drifted(-0.05)
    frozen = Frozen(np.array(run_of(strokes()).knots))
    at = {name: strokes().parameters[name] for name in names}
    got = predict(made.begin(), at, grid, names, frozen)
    for k, name in enumerate(names):
        ends = [
            predict(made.begin(), at | {name: at[name] * (1 + part)}, grid, (), frozen).signals
            for part in (-1e-6, 1e-6)
        ]
        slope = (ends[1] - ends[0]) / (2e-6 * at[name])
        np.testing.assert_allclose(got.derivatives[..., k], slope, atol=1e-5 * np.abs(slope).max())


@pytest.mark.slow
def test_linear_pads_at_finite_strain_are_those_of_a_neo_hookean_file():
    """With the same names of numbers, of which both pads have one."""
    made = at_finite_strain(strokes())
    assert made is not None
    built = replace(strokes("neo_hookean"), start=strokes().start)
    built.rig.reference = strokes().rig.reference
    assert made.parameters == built.parameters
    assert not linear_pads(made.rig)
    grid = made.grid(False)
    one, other = (predict(r.begin(), {E: 0.8e6}, grid, (), 1e-3) for r in (made, built))
    assert (one.signals == other.signals).all()
    linear = predict(strokes().begin(), {E: 0.8e6}, grid, (), 1e-3)
    y = strokes().channels.index("effort_y")
    assert one.signals[-1, y] / linear.signals[-1, y] > 1.03


@pytest.mark.parametrize("rated", [False, True])
def test_curves_of_fifth_degree_show_the_error_of_cubics(rated):
    """Of a sine with 8 set-points a period, in its rates."""
    t = torch.linspace(0.0, 2.0, 33, dtype=torch.float64)
    angle = 4 * torch.pi * t
    one = Sampled(t, torch.sin(angle), 4 * torch.pi * torch.cos(angle) if rated else None)
    inside = torch.linspace(0.5, 1.5, 201, dtype=torch.float64)
    (_, own), (_, better) = one(inside), of_fifth_degree(one)(inside)
    error = 4 * torch.pi * torch.cos(4 * torch.pi * inside) - own
    shown = better - own
    assert shown @ error / (error @ error) == pytest.approx(1.0, abs=0.15)
    assert (shown - error).norm() < 0.3 * error.norm()
