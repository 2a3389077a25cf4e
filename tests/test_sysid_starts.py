"""Recordings that begin in motion: where they begin, by their first samples; derivatives; and
parameters found all the same."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RIG, RUBBER, dry, excited, still, stroked
from test_experiments import experiment
from test_sysid import check_derivatives
from torch import Tensor

from torchsoft import (
    Body,
    Circle,
    Contact,
    Pad,
    PadMesh,
    Rig,
    SimulationFailed,
    SmoothSlip,
    SoftContact,
    hold,
)
from torchsoft.physics.material import KelvinVoigt
from torchsoft.physics.motion import Profile, Reference
from torchsoft.sysid import Known, Problem, Recording, Sensor, Stage, Unknown, identify
from torchsoft.sysid.first_samples import WIDER, beginning, estimate_initial_state, lasting_stretch
from torchsoft.sysid.initial_state import SETTLE, MovingStart, Standing, Stretch
from torchsoft.sysid.runs import Runner

E, TAU, MU_S = "materials.rubber.E", "materials.rubber.tau", "laws.steel_on_rubber.friction.mu_s"
SINCE = 0.4
"""When the recording begins [s]: in the middle of the first stroke."""

Cut = tuple[Recording, Tensor]


@pytest.fixture(scope="module")
def cut():
    """A recording without noise that begins in mid-roll, as though at rest, and the state there."""
    motion = stroked(12e-3, 0.3, duration=0.86, grasp=0.2, since=0.25)
    built = excited(motion, PAPER.override(COARSE))
    model, y0, t = built
    at = np.arange(SINCE, float(t[-1]), 5e-3)
    run = built.run(torch.from_numpy(np.append(-SETTLE, at)), rtol=1e-6)
    samples = {channel: (at, run[channel][1:].detach().numpy()) for channel in RIG}
    at_rest = Standing.of(model, y0, rests={"disc": [1]})
    return Recording("roll", model, samples, at_rest), run.y[1].detach()


def noisy(recording: Recording, seed: int = 0) -> Recording:
    rng = np.random.default_rng(seed)
    samples = {
        c: (t, y + RIG[c].noise * rng.standard_normal(len(t)))
        for c, (t, y) in recording.samples.items()
    }
    return replace(recording, samples=samples)


def true_bodies(recording: Recording, y0: Tensor) -> dict[str, float]:
    state = recording.rig.unpack(y0)
    parts = (("", state.pose), ("v_", state.velocity))
    return {
        f"{body}.{v}{axis}": float(part[body][i])
        for v, part in parts
        for body in part
        for i, axis in enumerate(("x", "y", "theta"))
    }


def underway(recording: Recording) -> MovingStart:
    start = recording.start
    assert isinstance(start, MovingStart)
    return start


def tensors(values: Mapping[str, float]) -> dict[str, Tensor]:
    return {
        name: torch.tensor(value, dtype=torch.float64, requires_grad=True)
        for name, value in values.items()
    }


def test_the_first_samples_tell_where_a_run_begins_and_do_not_count(cut):
    recording, y0 = cut
    out, truth = (
        estimate_initial_state(noisy(recording), RIG, lead=0.05),
        true_bodies(recording, y0),
    )
    start = underway(out)
    assert start.lead == pytest.approx(0.05)
    assert out.times[0] == pytest.approx(SINCE + 0.05)
    assert len(out.samples["x_C"][0]) == len(recording.samples["x_C"][0]) - 10
    assert truth["disc.v_x"] > 0.02  # [m/s]
    for name, (mean, sd) in start.bodies.items():
        assert abs(mean - truth[name]) < sd, name  # deviations are `WIDER` times those of the fit
    assert start.bodies["disc.x"][1] < 2 * WIDER * RIG["x_C"].noise
    state = recording.rig.unpack(y0)
    for name, s in state.stretch.items():
        basis, known = start.stretch[name].basis(recording.rig.pads[name]), start.stretch[name]
        touching = recording.rig.penetration(name, state).detach() > 0
        assert basis[touching.numpy()].sum(1) == pytest.approx(
            1.0
        )  # every point that touches can be stretched
        assert float(s[touching].abs().max()) < 2 * known.sd


def test_samples_out_of_a_sensors_range_say_nothing():
    t = 5e-3 * np.arange(10.0)
    y = np.minimum(1.0 + 20 * t, 1.5)
    sensor = Sensor(noise=1e-3, high=1.5)
    (value, sd), (rate, _) = beginning("y", t, y, sensor, 0.0)
    assert value == pytest.approx(1.0)
    assert rate == pytest.approx(20.0)
    blind = beginning("y", t, y, Sensor(noise=1e-3), 0.0)
    assert blind[1][0] != pytest.approx(20.0, rel=0.1)
    biased = beginning("y", t, y, Sensor(noise=1e-3, high=1.5, bias=0.1), 0.0)
    assert biased[0][1] == pytest.approx(np.hypot(sd, 0.1))
    late = beginning("y", t, y, Sensor(noise=1e-3, high=1.5, delay=0.01), 0.0)
    assert late[0][1] == pytest.approx(np.hypot(sd, 0.2), rel=1e-3)


def test_what_no_sensor_measures_is_assumed(cut):
    recording, y0 = cut
    truth = true_bodies(recording, y0)
    few = {channel: RIG[channel] for channel in ("x_C", "effort_x", "effort_y")}
    start = underway(estimate_initial_state(noisy(recording), few))
    assert start.bodies["disc.theta"] == (0.0, 0.0)  # a circle has no angle
    for name in ("disc.y", "bracket.x", "bracket.y", "disc.v_theta", "disc.v_y", "bracket.v_x"):
        mean, sd = start.bodies[name]
        assert abs(mean - truth[name]) < 2 * sd, name
    turn, _ = start.bodies["disc.v_theta"]
    assert turn == pytest.approx(truth["disc.v_theta"], rel=0.1)  # rolling
    given = underway(
        estimate_initial_state(noisy(recording), few, given={"disc.y": (0.0233, 1e-3)})
    )
    assert given.bodies["disc.y"] == (0.0233, 1e-3)
    none = {name: RIG[name] for name in ("effort_x", "theta_C")}
    with pytest.raises(ValueError, match=r"no sensor tells where `disc\.x` is"):
        estimate_initial_state(recording, none)


def test_stretches_last_as_long_as_friction_holds_them():
    def contact(mu: float) -> Contact:
        return Contact(
            "L", "disc", SoftContact(1e5, 4e2, 1e5, 4e2, friction=SmoothSlip(mu, mu, 0.05))
        )

    assert lasting_stretch(contact(0.8), 10.0, 0.05) == pytest.approx(0.8 * 10.0 / 1e5, rel=0.1)
    assert lasting_stretch(contact(0.0), 10.0, 0.05) < 1e-6
    assert lasting_stretch(contact(1e6), 10.0, 0.05) == 1e-3


def test_derivatives_of_the_state_are_those_of_differences(cut):
    recording, _ = cut
    out = estimate_initial_state(recording, RIG)
    begun = out.begin()
    weights = torch.linspace(-1, 1, begun.rig.layout.size, dtype=torch.float64)
    means = {c.name: c.mean for c in out.start_coordinates}
    names = ("start.disc.x", "start.bracket.y", "start.disc.v_theta", "start.L.stretch.3")
    values, modulus = tensors(means), begun.rig.parameter(E)
    *exact, by_E = torch.autograd.grad(
        weights @ begun.y0(values), [*(values[name] for name in names), modulus]
    )

    def value(name: str, by: float) -> float:
        return float((weights @ begun.y0(tensors(means | {name: means[name] + by}))).detach())

    for name, slope in zip(names, exact):
        assert float(slope) == pytest.approx(
            (value(name, 1e-8) - value(name, -1e-8)) / 2e-8, rel=1e-4, abs=1e-5
        ), name
    assert float(by_E) != 0.0
    again, before = out.begin(), begun.y0(values)
    assert torch.equal(before, again.y0(tensors(means)))


def test_residuals_and_gradient_know_the_start(cut):
    recording, _ = cut
    out = estimate_initial_state(noisy(recording), RIG)
    problem = Problem([out], RIG, {E: Unknown(), MU_S: Unknown()})
    c, runner = problem.coordinates, Runner(problem.recordings)
    r = problem.residuals(runner, c.start, problem.names, 1e-3).r
    assert len(r) == problem.samples() + len(out.start_coordinates)
    assert r[problem.samples() :] == pytest.approx(0.0, abs=1e-12)  # from the priors' means
    moved = [f"start.{name} in roll" for name in ("disc.y", "disc.v_x", "U.stretch.4")]
    check_derivatives(
        problem, c.start + 1e-3, 1e-4, 2e-5, h=1e-6, only=[E, *moved], adjoint=1e-5
    )  # larger steps cross kinks of contact


def test_the_start_does_not_depend_on_the_mesh(cut):
    recording, _ = cut
    out = estimate_initial_state(recording, RIG)
    rig = recording.rig
    finer = still(COARSE | {"pad.elements_x": 120, "contact.points": 2})
    finer.reference = rig.reference
    other = replace(out, rig=finer)
    assert other.start_coordinates == out.start_coordinates
    values = {
        c.name: 1e-5 * k for k, c in enumerate(other.start_coordinates) if "stretch" in c.name
    }
    coarse, fine = (r.rig.unpack(r.begin().y0(tensors(values)).detach()) for r in (out, other))
    for name, s in coarse.stretch.items():
        at, knots = (one.pads[name].point_positions[:, 0].numpy() for one in (finer, rig))
        assert fine.stretch[name].numpy() == pytest.approx(
            np.interp(at, knots, s.numpy()), abs=1e-15
        )
        forces = [float(state.pads[name][0, :, 1].sum()) for state in (coarse, fine)]
        assert forces[0] == pytest.approx(forces[1], rel=0.1)


def test_another_rig_may_begin_underway():
    """A cylinder driven over a pad, of which only the place is free, from the samples of its
    rate."""
    rubber, law = KelvinVoigt(**RUBBER, tau=0.01), dry(node_spacing=2e-3)
    rig = Rig(
        bodies={"roll": Body(0.4, Circle(0.02), x="driven", theta="driven")},
        contacts={"P": Contact("P", "roll", law)},
        pads={"P": Pad(PadMesh(0.12, 4.59e-3, 60, 2), rubber)},
        reference=Reference(**{"roll.x": Profile([0.0, 1.0], [0.04, 0.08]),
        "roll.theta": hold(a=0.0)["a"]}),
    )  # fmt: skip
    t = np.arange(0.2, 0.5, 5e-3)
    sensors = {"y_roll": Sensor(noise=1e-6)}
    samples = {"y_roll": (t, np.full(len(t), 0.0245))}
    recording = Recording("over a pad", rig, samples, Known(torch.zeros(rig.layout.size)))
    out = estimate_initial_state(recording, sensors)
    assert [c.name for c in out.start_coordinates][:2] == ["start.roll.y", "start.roll.v_y"]
    state = rig.unpack(out.begin().y0({}).detach(), t=float(t[0]))
    assert float(state.pose["roll"][0]) == pytest.approx(float(rig.follow(0.2)[0, 0]))
    assert float(state.pads["P"][0, :, 1].sum()) < -1.0  # [N]


def test_a_run_that_cannot_begin_is_lost(cut):
    out = estimate_initial_state(cut[0], RIG)
    far = {"start.disc.y": 0.01} | {
        c.name: 1e-3 for c in out.start_coordinates if ".L.stretch" in c.name
    }
    with pytest.raises(SimulationFailed, match="cannot begin there: the pad `L` does not settle"):
        out.begin().y0(tensors(far))


def test_parameters_are_found_from_the_middle_of_a_roll(cut):
    out = estimate_initial_state(noisy(cut[0], seed=3), RIG)
    truth = {
        name: float(cut[0].rig.parameter(name).detach()) for name in (E, "materials.rubber.tau")
    }
    problem = Problem(
        [out], RIG, {name: Unknown(nominal=1.1 * value) for name, value in truth.items()}
    )
    plan = [Stage("all", problem.names, problem.coordinates.labels, 3e-4, tolerance=1e-3)]
    found = identify(problem, plan=plan, tightenings=0, assumptions="trusted")
    for name, value in truth.items():
        e = found[name]
        assert e.ci95[0] <= value <= e.ci95[1]
        assert e.relative_sd < 0.1
    assert found.chi2 == pytest.approx(1.0, abs=4 * (2 / problem.samples()) ** 0.5)


def test_refusals(cut):
    recording, _ = cut
    start = underway(estimate_initial_state(recording, RIG))
    rig, samples = recording.rig, recording.samples

    for change, message in (
        ({"bodies": {"disc.x": (0.0, 1.0)}}, "`disc.y` is missing"),
        ({"bodies": {**start.bodies, "ball.x": (0.0, 1.0)}}, "`ball.x` is none of them"),
        (
            {"bodies": {**start.bodies, "disc.x": (0.06, -1.0)}},
            "`start.disc.x` needs a finite mean",
        ),
        ({"stretch": {"M": Stretch((0.06,), 1e-5)}}, "speaks of `M`; the contacts are L, U"),
        ({"stretch": {"L": Stretch((0.06, 0.05), 1e-5)}}, "must be finite and increase"),
        ({"lead": -0.1}, "`lead` of the start must not be negative"),
    ):
        with pytest.raises(ValueError, match=message):
            start._replace(**change).coordinates(rig, samples)
    for how, message in (
        ({"lead": 0.01}, "`x_C` of recording `roll` has 2 samples in .*take a longer `lead`"),
        ({"lead": 5.0}, "no two samples of `x_C` left"),
        (
            {"sensors": RIG | {"x_C": Sensor(noise=1e-5, delay=0.08)}},
            "`x_C` may come late by 0.08 s, but runs are known only from 0.05 s",
        ),
        ({"given": {"disc.z": (0.0, 1.0)}}, r"`given` speaks of `disc\.z`"),
    ):
        with pytest.raises(ValueError, match=message):
            estimate_initial_state(recording, **{"sensors": RIG} | how)
    deep = deepcopy(dict(start.bodies)) | {"disc.y": (-1.0, 1.0)}
    assert MovingStart(deep, {}).coordinates(rig, samples)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Newton did not converge")  # where rest is assumed, wrongly
def test_unknown_start_smoke(tmp_path):
    """The experiment: errors of a few standard deviations, a price for not knowing the start, and
    rest not assumed in silence."""
    module = experiment("unknown_start")
    result = module.run(module.Config(out=tmp_path, smoke=True))
    ((case, (found,)),) = result.found.items()
    price = result.prices[case]
    assert list(price.unknown) == ["laws.steel_on_rubber.K_n", E, TAU]
    for name, sd in price.unknown.items():
        assert abs(np.log(found[name].last / module.TRUTH[name])) < 4 * sd, name
        assert 1.0 < sd / price.known[name] < 5.0, name
    assert result.rest[case]["library"]
