"""Alternatives to a recording: each does what it states, by closed forms and by invariances; faults
of readings at their neutral values."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, excited, stroked

from torchsoft import Rig, RigFile
from torchsoft.sysid import Known, Problem, Recording, Sensor, Unknown, record
from torchsoft.sysid.assumptions import AMOUNTS, Suspect, suspects
from torchsoft.sysid.initial_state import Standing
from torchsoft.sysid.prediction import Prediction, Readout, Term, predict
from torchsoft.sysid.problem import DIFFERENCE
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.search import problem_with

E, MU_K = "materials.rubber.E", "laws.steel_on_rubber.friction.mu_k"
SENSORS = {"x_C": Sensor(noise=1e-5), "effort_x": Sensor(noise=0.1), "effort_y": Sensor(noise=0.1)}
FINER = {"pad.elements_x": 120, "pad.elements_y": 4}
STROKES = stroked(travel=8e-3, stroke_time=0.15, duration=0.4, grasp=0.15, since=0.2)


EFFORTS = {"x": 5.0, "y": 60.0}


def run_of(recording: Recording) -> Prediction:
    return predict(recording.run_context(), {}, recording.grid(True), (), 1e-6)


def suspect(recording: Recording, name: str, sensors: dict[str, Sensor] | None = None) -> Suspect:
    """The suspect of that name."""
    every = suspects([recording], {E}, SENSORS if sensors is None else sensors, EFFORTS)
    return next(one for one in every if one.name == name)


def changed(recording: Recording, name: str, amount: float, **how: Any) -> Any:
    """The recording changed by an amount [SI]."""
    change = suspect(recording, name, **how).change
    assert change is not None
    return change(recording, amount)


@cache
def strokes(kind: str = "kelvin_voigt") -> Recording:
    file = PAPER.override({**COARSE, "materials.rubber.kind": kind})
    return record("strokes", excited(STROKES, file), {E: 0.9e6}, SENSORS)


@cache
def thrown() -> Recording:
    """A body in free flight, which spins; the pad is far below."""
    start = {"x": 0.01, "y": 2.0, "theta": 0.0, "v_x": 0.3, "v_y": 1.0, "omega": 20.0}
    changes = {"pads.ground.elements_x": 8, "contacts.ground.may_leave": True}
    file = RigFile.ready("drop").override(changes, bodies={"ellipse": {"start": start}})
    rig, y0, _ = file.build()
    t = np.linspace(0.0, 0.2, 21)
    samples = dict.fromkeys(("x_ellipse", "y_ellipse"), (t, 0 * t))
    samples |= {"theta_ellipse": (t, 20.0 * t)}
    return Recording("flight", rig, samples, Standing.of(rig, y0, lead=0.0))


@pytest.mark.parametrize("c", [(2e-3, 0.0), (0.0, -1e-3)])
def test_a_body_whose_mass_is_off_its_contour_flies_about_its_centre_of_mass(c):
    """Which goes on a parabola, while the spin stays what it is."""
    flight, axis = thrown(), "x" if c[0] else "y"
    made = changed(flight, f"bodies.ellipse.centre_{axis}", sum(c))
    at = run_of(made)
    found = dict(zip(made.channels, at.signals.T))
    t, offset = at.t, np.array(c)[:, None]
    speed = [0.3 - 20.0 * c[1], 1.0 + 20.0 * c[0]]
    exact = [0.01 + c[0] + speed[0] * t, 2.0 + c[1] + speed[1] * t - 0.5 * 9.81 * t**2]
    np.testing.assert_allclose([found["x_ellipse"], found["y_ellipse"]], exact, atol=1e-9)
    np.testing.assert_allclose(found["theta_ellipse"], 20.0 * t, atol=1e-5)
    times, angle = flight.samples["theta_ellipse"]
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = [made.samples[name][1] - flight.samples[name][1] for name in ("x_ellipse", "y_ellipse")]
    np.testing.assert_allclose(shift, (R * offset[None]).sum(1), atol=1e-12)
    blind = replace(flight, samples={"x_ellipse": (times, 0 * times)})
    assert changed(blind, f"bodies.ellipse.centre_{axis}", sum(c)) is None


@pytest.mark.parametrize("name", ["x", "y"])
def test_a_limit_cuts_the_largest_efforts_off(name):
    """By a part of the largest one, and no other effort, with what that does later."""
    channel = strokes().channels.index(f"effort_{name}")
    without = run_of(strokes()).signals[:, channel]
    largest = float(np.abs(without).max())
    every = suspects([strokes()], {E}, SENSORS, {name: largest})
    (limit,) = (one for one in every if one.name == f"limit of the controller {name}")
    assert limit.change is not None
    cut = run_of(limit.change(strokes(), 0.1)).signals[:, channel]  # pyright: ignore[reportArgumentType]
    assert np.abs(cut).max() == pytest.approx(0.9 * largest, rel=1e-4)
    first = np.flatnonzero(np.abs(without) > 0.9 * largest)[0]
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
            other = changed(stated, f"{extent} of {who}", 0.02)
            new = other.rig.pads[name]
            assert getattr(new.mesh, extent) == pytest.approx(1.02 * getattr(pad.mesh, extent))
            np.testing.assert_allclose(face(other, name)[0], at[0], atol=1e-15)
            assert new.material.E is not pad.material.E
    turned = face(changed(stated, f"tilt of the pad {name}", 5e-3), name)
    np.testing.assert_allclose(turned.mean(0), at.mean(0), atol=1e-15)
    slope = (turned[-1, 1] - turned[0, 1]) / (turned[-1, 0] - turned[0, 0])
    assert slope == pytest.approx(np.tan(5e-3))
    nearer = face(changed(stated, f"place of the pad {name}", 1e-4), name) - at
    np.testing.assert_allclose(nearer, np.broadcast_to([0.0, up], nearer.shape), atol=1e-15)
    fine = changed(stated, "mesh", 1.0).rig.pads[name]
    assert (fine.mesh.elements_x, fine.mesh.elements_y, fine.points) == (120, 4, pad.points)
    assert changed(stated, "contact points", 1.0).rig.pads[name].points == pad.points + 2
    np.testing.assert_allclose(fine.positions[[0, -1]], pad.positions[[0, -1]], atol=1e-15)
    step = face(changed(stated, "mesh phase", 1.0), name) - at
    np.testing.assert_allclose(np.abs(step[:, 0]), 0.25 * pad.mesh.length / 60, rtol=1e-9)


def test_springs_that_follow_the_pads_follow_those_of_an_alternative():
    coarse, finer = (
        PAPER.override(COARSE | {"contact.K_n": "auto"} | more).assemble() for more in ({}, FINER)
    )
    coarse.reference = strokes().rig.reference
    made = changed(replace(strokes(), rig=coarse), "mesh", 1.0).rig
    stated, found, built = (rig.contacts["U"].law.K_n.item() for rig in (coarse, made, finer))
    assert found == pytest.approx(built)
    assert found > 1.5 * stated


def test_a_run_from_a_state_of_the_pads_has_no_other_pads():
    known = replace(thrown(), start=Known(thrown().run_context().y0({})))
    for name in ("tilt of the pad ground", "height of the pad ground", "mesh"):
        assert changed(known, name, 0.1) is None


def test_a_camera_has_a_scale_about_zero_or_its_first_sample():
    data, places = strokes(), {**SENSORS, **dict.fromkeys(("y_C", "x_Br"), Sensor(noise=1e-5))}
    t, x = data.samples["x_C"]
    data = replace(data, samples=data.samples | {"x_Br": (t, x)})
    for name, zero in (("scale of the camera", 0.0), ("scale about the start of the camera", x[0])):
        samples = changed(data, name, 0.01, sensors=places).samples
        np.testing.assert_allclose(samples["x_C"][1], x - 0.01 * (x - zero))
        assert samples["effort_x"] is data.samples["effort_x"]
    samples = changed(data, "scale of the camera on disc", 0.01, sensors=places).samples
    np.testing.assert_allclose(samples["x_C"][1], 0.99 * x)
    assert samples["x_Br"] is data.samples["x_Br"]


def test_a_camera_that_is_turned_mixes_coordinates_about_their_first_samples():
    """Of a disc in the plane, at other times in one coordinate."""
    t, late = np.linspace(0.0, 1.0, 11), np.linspace(0.0, 1.0, 21)
    path = {"x_ellipse": lambda t: 0.1 + t, "y_ellipse": lambda t: 2.0 - 3.0 * t}
    c, s = np.cos(1e-3), np.sin(1e-3)
    seen = {
        "x_ellipse": (t, 0.1 + c * t - 3.0 * s * t),
        "y_ellipse": (late, 2.0 - 3.0 * c * late - s * late),
    }
    data = replace(thrown(), samples=seen)
    sensors = dict.fromkeys(seen, Sensor(noise=1e-5))
    turned = changed(data, "angle of the camera on ellipse", 1e-3, sensors=sensors).samples
    for channel, (at, _) in seen.items():
        np.testing.assert_allclose(turned[channel][1], path[channel](at), atol=4e-6)


def test_what_is_unknown_is_not_taken_for_granted():
    some = {"bodies.disc.shape.radius", "start.disc.x", "bias of x_C"}
    names, left = (
        {one.name for one in suspects([strokes()], unknown, SENSORS, EFFORTS)}
        for unknown in (set(), some)
    )
    assert names - left == {"bodies.disc.shape.radius", "start of disc.x", "bias x_C"}


def test_a_number_is_free_as_far_as_there_is_a_rig():
    """Friction in slip must not exceed that at rest."""
    first = strokes()
    data = replace(first, rig=with_value(first, MU_K, 0.795))
    one = suspect(data, MU_K)
    c = problem_with(Problem([data], SENSORS, {E: Unknown()}), one).coordinates
    sliding = next(a for a in c.all if a.name == MU_K)
    reach = AMOUNTS * one.step / one.nominal
    assert sliding.low == pytest.approx((1 - reach) * 0.795)
    assert 0.795 < sliding.high < 0.8 < (1 + reach) * 0.795


@pytest.mark.parametrize("name", ["height of pads", "scale of the camera"])
def test_amounts_of_alternatives_are_coordinates_with_differences_as_derivatives(name):
    """At zero they change nothing; at an amount residuals are those of the changed recording, of
    its rig or its samples, and the column of a free one is a difference by a part of its amount."""
    data, sensors = strokes(), {**SENSORS, "y_C": Sensor(noise=1e-5)}
    data = replace(data, samples=data.samples | {"y_C": data.samples["x_C"]})
    problem, runner = Problem([data], sensors, {E: Unknown()}), Runner([data])
    one = suspect(data, name, sensors)
    other = problem_with(problem, one)
    c, which, start = other.coordinates, problem.names, problem.coordinates.start
    assert c.labels == (E, one.name)
    base = problem.residuals(runner, start, which, 1e-4)
    x = c.with_known({E: start[0]})
    at = other.residuals(other.runner(runner), x, which, base.steps, c.free)
    np.testing.assert_allclose(at.r, base.r, atol=1e-6)
    own = Problem([changed(data, name, DIFFERENCE * one.step, sensors=sensors)], sensors,
                  {E: Unknown()})  # fmt: skip
    moved = own.residuals(Runner(own.recordings), start, which, base.steps)
    change = at.J[:, 1] * c.all[1].to_x(DIFFERENCE * one.step)
    assert np.abs(change).max() > 1e-6
    np.testing.assert_allclose(change, moved.r - base.r, rtol=1e-9, atol=1e-9)
    assert problem_with(problem, one, held=True).coordinates.free.tolist() == [True, False]


NOISE = 0.02


def reading(lag: float = 0.0, backlash: float = 0.0) -> Readout:
    """The channel y by a sensor with a gain of 1.2."""
    return Readout(
        "y", NOISE, None, None, gain=1.2, bias=0.0, drift=0.0, delay=0.0, middle=0.05,
        terms=(Term(0, 0, 1.0),), lag=lag, backlash=backlash,
    )  # fmt: skip


T = np.linspace(0.0, 0.1, 401)
SWING = np.sin(60 * T)


def test_neutral_faults_have_derivatives_and_weights_are_pulled_back_by_the_transpose():
    """At zero the derivative with respect to a lag is that of a delay, and with respect to backlash
    a difference by a play of the noise."""
    run, times = Prediction(T, SWING[:, None], SWING[:, None, None]), T[3:-3]
    value, _, by = reading().expected(run, times)
    np.testing.assert_array_equal(by["lag"], by["delay"])
    just_shown = reading(backlash=NOISE).expected(run, times)[0]
    np.testing.assert_allclose(by["backlash"], (just_shown - value) / NOISE, atol=1e-9)
    both, v = reading(4e-3, 0.2), np.random.default_rng(0).standard_normal(len(times))
    slopes, pulled = both.expected(run, times)[1], both.pulled_back(run, times, v)
    assert float(np.sum(pulled[:, 0] * SWING)) == pytest.approx(float(v @ slopes[:, 0]), rel=1e-9)


def test_a_number_that_recordings_state_otherwise_is_changed_in_each():
    first, mass = strokes(), "bodies.disc.mass"
    other = replace(first, name="other", rig=with_value(first, mass, 0.5))
    (one,) = (v for v in suspects([first, other], {E}, SENSORS, {}) if v.name == mass)
    assert not one.parameter
    assert one.change is not None
    made = [one.change(r, 0.02) for r in (first, other)]
    found = [r.parameters[mass] for r in made if r is not None]
    np.testing.assert_allclose(found, [1.02 * first.parameters[mass], 1.02 * 0.5])


def with_value(recording: Recording, name: str, value: float) -> Rig:
    rig = recording.run_context().rig
    with torch.no_grad():
        rig.parameter(name).fill_(value)
    return rig


@pytest.mark.slow
def test_linear_pads_at_finite_strain_are_those_of_a_neo_hookean_file():
    """With the same names of numbers, of which both pads have one."""
    made = changed(strokes(), "finite strain", 1.0)
    built = replace(strokes("neo_hookean"), start=strokes().start)
    built.rig.reference = strokes().rig.reference
    assert made.parameters == built.parameters
    again = {one.name for one in suspects([made], {E}, SENSORS, EFFORTS)}
    assert "finite strain" not in again
    grid = made.grid(False)
    one, other = (predict(r.run_context(), {E: 0.8e6}, grid, (), 1e-3) for r in (made, built))
    assert (one.signals == other.signals).all()
    linear = predict(strokes().run_context(), {E: 0.8e6}, grid, (), 1e-3)
    y = strokes().channels.index("effort_y")
    assert one.signals[-1, y] / linear.signals[-1, y] > 1.03
