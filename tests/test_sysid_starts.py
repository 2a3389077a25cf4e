"""Recordings that begin in motion: the initial state from the first samples, its derivatives, and
parameters found all the same."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RIG, excited, still, stroked
from test_sysid import check_derivatives, fit
from torch import Tensor

from torchsoft import Contact, SimulationFailed, SmoothSlip, SoftContact
from torchsoft.sysid import Problem, Recording, Sensor, Unknown, estimate_initial_state
from torchsoft.sysid.first_samples import WIDER, first_value, lasting_stretch
from torchsoft.sysid.initial_state import SETTLE, Standing, Stretch
from torchsoft.sysid.runs import Runner

E, TAU, MU_S = "materials.rubber.E", "materials.rubber.tau", "laws.steel_on_rubber.friction.mu_s"
SINCE = 0.4
"""When the recording begins [s]: in the middle of the first stroke."""


@pytest.fixture(scope="module")
def cut():
    """A recording without noise that begins in mid-roll, as though at rest, and the bodies' poses
    and velocities there."""
    motion = stroked(12e-3, 0.3, duration=0.86, grasp=0.2, since=0.25)
    built = excited(motion, PAPER.override(COARSE))
    model, y0, t = built
    at = np.arange(SINCE, float(t[-1]), 5e-3)
    run = built.run(torch.from_numpy(np.append(-SETTLE, at)), rtol=1e-6)
    samples = {channel: (at, run[channel][1:].detach().numpy()) for channel in RIG}
    recording = Recording("roll", model, samples, Standing.of(model, y0, rests={"disc": [1]}))
    return recording, model.unpack(run.y[1].detach())


@pytest.fixture(scope="module")
def moving(cut):
    return estimate_initial_state(cut[0], RIG)


@pytest.fixture(scope="module")
def noisy(cut):
    rng = np.random.default_rng(3)
    samples = {
        c: (t, y + RIG[c].noise * rng.standard_normal(len(t)))
        for c, (t, y) in cut[0].samples.items()
    }
    return replace(cut[0], samples=samples)


def true_bodies(state: Any) -> dict[str, float]:
    return {
        f"{body}.{v}{axis}": float(part[body][i])
        for v, part in (("", state.pose), ("v_", state.velocity))
        for body in part
        for i, axis in enumerate(("x", "y", "theta"))
    }


def tensors(values: Mapping[str, float]) -> dict[str, Tensor]:
    make = lambda x: torch.tensor(x, dtype=torch.float64, requires_grad=True)
    return {name: make(value) for name, value in values.items()}


def test_the_first_samples_determine_the_start_and_do_not_count(cut, noisy):
    recording, state = cut
    out, truth = estimate_initial_state(noisy, RIG, lead=0.05), true_bodies(state)
    start = out.start
    assert start.lead == pytest.approx(0.05)
    assert out.times[0] == pytest.approx(SINCE + 0.05)
    assert len(out.samples["x_C"][0]) == len(recording.samples["x_C"][0]) - 10
    assert truth["disc.v_x"] > 0.02  # [m/s]
    for name, (mean, sd) in start.bodies.items():
        assert abs(mean - truth[name]) < sd, name  # deviations are `WIDER` times those of the fit
    assert start.bodies["disc.x"][1] < 2 * WIDER * RIG["x_C"].noise
    for name, s in state.stretch.items():  # every point that touches can be stretched
        basis = start.stretch[name].basis(recording.rig.pads[name])
        touching = recording.rig.penetration(name, state).detach() > 0
        assert basis[touching.numpy()].sum(1) == pytest.approx(1.0)
        assert float(s[touching].abs().max()) < 2 * start.stretch[name].sd


def test_faults_of_a_sensor_widen_what_its_first_samples_tell():
    """Samples out of its range tell nothing."""
    t = 5e-3 * np.arange(10.0)
    y = np.minimum(1.0 + 20 * t, 1.5)

    def at(**faults):
        return first_value("y", t, y, Sensor(noise=1e-3, **faults), 0.0)

    (value, sd), (rate, rate_sd) = at(high=1.5)
    assert (value, rate) == pytest.approx((1.0, 20.0))
    assert at()[1][0] != pytest.approx(20.0, rel=0.1)
    for fault, amount, wrong, wrong_rate in (
        ("bias", 0.1, 0.1, 0.0), ("delay", 0.01, 0.2, 0.0), ("gain", 0.1, 0.1, 2.0),
        ("drift", 3.0, 0.0, 3.0),
    ):  # fmt: skip
        wide = at(high=1.5, **{fault: amount})
        assert wide[0][1] == pytest.approx(np.hypot(sd, wrong), rel=1e-3), fault
        assert wide[1][1] == pytest.approx(np.hypot(rate_sd, wrong_rate), rel=1e-3), fault


def test_what_no_sensor_measures_is_assumed_or_given(cut, noisy):
    truth = true_bodies(cut[1])
    few = {channel: RIG[channel] for channel in ("x_C", "effort_x", "effort_y")}
    start = estimate_initial_state(noisy, few).start
    assert start.bodies["disc.theta"] == (0.0, 0.0)  # a circle has no angle
    for name in ("disc.y", "bracket.x", "bracket.y", "disc.v_theta", "disc.v_y", "bracket.v_x"):
        mean, sd = start.bodies[name]
        assert abs(mean - truth[name]) < 2 * sd, name
    assert start.bodies["disc.v_theta"][0] == pytest.approx(truth["disc.v_theta"], rel=0.1)
    stated = estimate_initial_state(noisy, few, given={"disc.y": (0.0233, 1e-3)}).start
    assert stated.bodies["disc.y"] == (0.0233, 1e-3)
    none = {name: RIG[name] for name in ("effort_x", "theta_C")}
    with pytest.raises(ValueError, match=r"no sensor tells where `disc\.x` is"):
        estimate_initial_state(cut[0], none)


@pytest.mark.parametrize(
    ("mu", "low", "high"), [(0.8, 7.2e-5, 8.8e-5), (0, 0, 1e-6), (1e6, 1e-3, 1e-3)]
)
def test_stretches_last_as_long_as_friction_holds_them(mu, low, high):
    """mu_s F_N / K_t, with a bound where friction has none."""
    law = SoftContact(1e5, 4e2, 1e5, 4e2, friction=SmoothSlip(mu, mu, 0.05))
    assert low <= lasting_stretch(Contact("L", "disc", law), 10.0, 0.05) <= high


def test_residuals_and_gradient_depend_on_the_start(moving):
    problem = Problem([moving], RIG, {E: Unknown(), MU_S: Unknown()})
    c = problem.coordinates
    r = problem.residuals(Runner([moving]), c.start, problem.names, 1e-3).r
    assert len(r) == problem.samples() + len(moving.start_coordinates)
    assert r[problem.samples() :] == pytest.approx(0.0, abs=1e-12)  # from the priors' means
    moved = [f"start.{name} in roll" for name in ("disc.y", "disc.v_x", "U.stretch.4")]
    check_derivatives(
        problem, c.start + 1e-3, 1e-4, 2e-5, h=1e-6, only=[E, *moved]
    )  # larger steps cross kinks of contact


def test_the_start_does_not_depend_on_the_mesh(moving):
    finer = still(COARSE | {"pad.elements_x": 120, "contact.points": 2})
    finer.reference = moving.rig.reference
    other = replace(moving, rig=finer)
    assert other.start_coordinates == moving.start_coordinates
    names = [c.name for c in other.start_coordinates]
    values = {name: 1e-5 * k for k, name in enumerate(names) if "stretch" in name}
    states = [r.rig.unpack(r.run_context().y0(tensors(values)).detach()) for r in (moving, other)]
    for name in moving.rig.contacts:
        knots, at = (one.pads[name].point_positions[:, 0].numpy() for one in (moving.rig, finer))
        coarse, fine = (state.stretch[name].numpy() for state in states)
        assert fine == pytest.approx(np.interp(at, knots, coarse), abs=1e-15)
        forces = [float(state.pads[name][0, :, 1].sum()) for state in states]
        assert forces[0] == pytest.approx(forces[1], rel=0.1)


def test_a_body_starts_at_its_unknown_place(cut):
    context = replace(
        cut[0], start=cut[0].start._replace(position_sd={"disc.x": 1e-3})
    ).run_context()
    pose = context.rig.unpack(context.y0(tensors({"start.disc.x": 0.0608}))).pose
    assert pose["disc"][0].item() == pytest.approx(0.0608, rel=1e-12)


def test_a_run_that_cannot_begin_is_lost(moving):
    names = [c.name for c in moving.start_coordinates]
    far = {"start.disc.y": 0.01} | dict.fromkeys((n for n in names if ".L.stretch" in n), 1e-3)
    with pytest.raises(SimulationFailed, match="cannot begin there: the pad `L` does not settle"):
        moving.run_context().y0(tensors(far))


def test_parameters_are_found_from_the_middle_of_a_roll(noisy):
    out = estimate_initial_state(noisy, RIG)
    truth = {name: float(noisy.rig.parameter(name).detach()) for name in (E, TAU)}
    unknowns = {name: Unknown(nominal=1.1 * value) for name, value in truth.items()}
    found = fit(out, unknowns, sensors=RIG, tightenings=0)
    for name, value in truth.items():
        assert found[name].ci95[0] <= value <= found[name].ci95[1]
        assert found[name].relative_sd < 0.1
    samples = sum(len(t) for t, _ in out.samples.values())
    assert found.chi2 == pytest.approx(1.0, abs=4 * (2 / samples) ** 0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bodies": {"disc.x": (0.0, 1.0)}}, "`disc.y` is missing"),
        ({"more": {"ball.x": (0.0, 1.0)}}, "`ball.x` is none of them"),
        ({"more": {"disc.x": (0.06, -1.0)}}, "`start.disc.x` needs a finite mean"),
        ({"stretch": {"M": Stretch((0.06,), 1e-5)}}, "speaks of `M`; the contacts are L, U"),
        ({"stretch": {"L": Stretch((0.06, 0.05), 1e-5)}}, "must be finite and increase"),
        ({"lead": -0.1}, "`lead` of the start must not be negative"),
    ],
)
def test_a_start_that_does_not_fit_its_rig_is_rejected(moving, change, message):
    if "more" in change:
        change = {"bodies": {**moving.start.bodies, **change["more"]}}
    with pytest.raises(ValueError, match=message):
        moving.start._replace(**change).coordinates(moving.rig, moving.samples)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"lead": 0.01}, "`x_C` of recording `roll` has 2 samples in .*take a longer `lead`"),
        ({"lead": 5.0}, "no two samples of `x_C` left"),
        (
            {"sensors": RIG | {"x_C": Sensor(noise=1e-5, delay=0.08)}},
            "`x_C` may come late by 0.08 s, but runs are known only from 0.05 s",
        ),
        ({"given": {"disc.z": (0.0, 1.0)}}, r"`given` speaks of `disc\.z`"),
    ],
)
def test_first_samples_that_do_not_suffice_are_rejected(cut, how, message):
    with pytest.raises(ValueError, match=message):
        estimate_initial_state(cut[0], **{"sensors": RIG} | how)
