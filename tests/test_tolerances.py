"""Steps by tolerance: accuracy, dense output, frozen steps and their gradients, and what cannot be
met."""

from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, coarse, f64, grasped, paper, times, towards
from torch import Tensor, nn
from torchdiffeq import odeint, odeint_adjoint

from torchsoft import Rig, SimulationFailed, Trajectory, simulate
from torchsoft.physics.motion import Profile, Sampled
from torchsoft.solve.steps import given_steps

T = times(0.4, 9)


def quick(grasp_time: float, changes: dict[str, Any]) -> tuple[Rig, Tensor]:
    """The paper's manipulation on a coarse mesh, that grasps within a time [s] by 80 N."""
    grasp = {f"motion.{name}.times": [0.0, grasp_time] for name in ("y_d", "F_ff")}
    model, y0, _ = paper(COARSE | {"motion.F_ff.values": [0.0, -80.0]} | grasp | changes)
    return model, y0


@pytest.fixture(scope="module")
def start():
    """The paper's manipulation on a coarse mesh, quickened: its touch-down and grasp within 0.3
    s."""
    return quick(
        0.25,
        {
            "motion.x_d.times": [0.0, 0.5, 0.6, 1.1],
            "motion.x_d.values": ["start", 56e-3, 56e-3, 60e-3],
        },
    )


@pytest.fixture(scope="module")
def exact(start):
    return simulate(start[0], T, y0=start[1], rtol=1e-8)


def worst(run: Trajectory, exact: Trajectory) -> float:
    """Largest error of the motion and of the forces, over their range."""
    return max(
        float((run[x] - exact[x]).detach().abs().max() / np.ptp(exact[x].detach().numpy()))
        for x in ("x_C", "y_C", "theta", "y_Br", "F_x", "F_y")
    )


def test_error_falls_with_the_tolerance(start, exact):
    model, y0 = start
    errors = []
    for rtol in (1e-3, 1e-5, 1e-7):
        run = simulate(model, T, y0=y0, rtol=rtol)
        errors.append(worst(run, exact))
        assert errors[-1] < 30 * rtol**0.8
        assert run.energy_residual_rel < 3 * rtol**0.7
    assert errors[0] > 5 * errors[1] > 10 * errors[2]


def test_steps_are_short_where_it_touches_down_and_long_where_it_rests(
    start,
):
    model, y0 = start
    run = simulate(model, times(2.0, 5), y0=y0, rtol=1e-4)
    h = run.knots.diff()
    assert run.stats.refused_steps > 0
    assert (
        float(h[run.knots[:-1] > 1.5].min()) > 0.02 > 2e-3 > float(h[run.knots[:-1] < 0.25].min())
    )


def test_outputs_do_not_change_the_run(start, exact):
    """Up to Newton's tolerance, which decides steps that are nearly refused."""
    model, y0 = start
    few, many = (simulate(model, times(0.4, n), y0=y0, rtol=1e-4) for n in (9, 161))
    assert few.stats.steps == pytest.approx(many.stats.steps, rel=0.03)
    assert torch.allclose(few.knots[:40], many.knots[:40], rtol=1e-6)
    apart = max(
        float((few[x] - many[x][::20]).abs().max() / np.ptp(exact[x].numpy()))
        for x in ("x_C", "y_C", "F_y")
    )
    assert apart < worst(few, exact)


def test_dense_output_is_as_good_as_the_steps(start):
    """Between its knots a run is as near to the exact one as at them, and the forces are those of
    the states."""
    model, y0 = start
    t = times(0.4, 161)
    dense, fine = (simulate(model, t, y0=y0, rtol=rtol) for rtol in (1e-4, 1e-7))
    at_knots = simulate(model, dense.knots, y0=y0, knots=dense.knots)
    fine_there = simulate(model, dense.knots, y0=y0, rtol=1e-7)
    for x in ("x_C", "y_C", "y_Br", "F_y"):
        between, ends = (
            float((dense[x] - fine[x]).abs().max()),
            float((at_knots[x] - fine_there[x]).abs().max()),
        )
        assert between < 3 * ends
    i = 121
    alone = simulate(
        model, t[i:], y0=dense.y[i], step=1e-3
    )  # its first row is the forces that belong to that state
    for name in "LU":
        assert float((alone.force[name][0] - dense.force[name][i]).abs().max()) < 1e-8


def test_steps_of_another_run_are_taken_again(start):
    model, y0 = start
    run = simulate(model, T, y0=y0, rtol=1e-4)
    again = simulate(model, T, y0=y0, knots=run.knots)
    assert float((again.y - run.y).abs().max()) < 1e-8
    for name in "LU":
        assert float((again.force[name] - run.force[name]).abs().max()) < 1e-8
    assert torch.allclose(again.knots, run.knots, rtol=0, atol=1e-15)


def test_outputs_lie_within_their_steps_however_these_differ():
    """A last step that is longer by far must not decide where the outputs of the short ones lie."""
    knots = np.array([0.0, 1e-9, 2e-9, 0.1])
    t = f64(0.0, 5e-10, 1e-9, 1.05e-9, 2e-9, 0.1)
    (plan,) = given_steps(t, knots)
    assert plan.out_step.tolist() == [0, 0, 1, 1, 2]
    assert plan.out_part.tolist() == pytest.approx([0.5, 1.0, 0.05, 1.0, 1.0])


class Wave(nn.Module):
    """A signal that is no piecewise polynomial."""

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        return 0.06 + 1e-3 * torch.sin(20 * t), 2e-2 * torch.cos(20 * t)


def test_a_signal_of_ones_own_is_followed():
    model = coarse()
    y0 = grasped(model)
    own = towards(model, Wave())
    t = times(0.1, 6)
    run, fine = (simulate(model, t, y0=y0, reference=own, rtol=rtol) for rtol in (1e-4, 1e-7))
    assert float((run["x_C"] - fine["x_C"]).abs().max()) < 1e-7
    knots = times(0.1, 2001)
    value, rate = Wave()(knots)
    pieces = towards(model, Sampled(knots.tolist(), value.tolist(), rate.tolist()))
    same = simulate(model, t, y0=y0, reference=pieces, rtol=1e-7)
    assert float((same["x_C"] - fine["x_C"]).abs().max()) < 1e-9


class Broken(Wave):
    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        if bool((t > 0.05).any()):
            raise RuntimeError("the table of this signal ends at 0.05 s")
        return super().forward(t)


def test_what_a_signal_raises_is_raised():
    model = coarse()
    y0 = grasped(model)
    own = towards(model, Broken())
    with pytest.raises(RuntimeError, match="the table of this signal ends"):
        simulate(model, times(0.1, 6), y0=y0, reference=own, rtol=1e-4)


class Jump(Wave):
    """A setpoint that jumps by 1 mm, and whose stated rate jumps by `rate` [m/s]."""

    def __init__(self, rate: float, at: float = 0.0512345) -> None:
        super().__init__()
        self.rate, self.at = rate, at

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        value, rate = super().forward(t)
        return value + torch.where(t > self.at, 1e-3, 0.0), rate + torch.where(
            t > self.at, self.rate, 0.0
        )


def test_a_jump_is_stepped_over_or_said():
    model = coarse()
    y0 = grasped(model)
    jump = lambda rate: towards(model, Jump(rate))
    run = simulate(model, times(0.1, 6), y0=y0, reference=jump(0.0), rtol=1e-4)
    short = run.knots.diff().argmin()
    assert float((run.knots[short] - 0.0512345).abs()) < 1e-3 > 10 * float(run.knots.diff().min())
    with pytest.raises(
        SimulationFailed,
        match=r"at t = 0\.0512 s .* steps below 1e-09 s for the velocity of body `bracket`",
    ):
        simulate(model, times(0.1, 6), y0=y0, reference=jump(1e9), rtol=1e-4)


@pytest.mark.parametrize("at", [0.3, 7.3])
def test_a_run_whose_steps_cannot_get_shorter_ends(at):
    """However the shortest step is rounded at that time."""
    model = coarse()
    y0 = grasped(model)
    t = f64(at - 0.02, at + 0.02)
    with pytest.raises(SimulationFailed, match="steps below 1e-09 s"):
        simulate(model, t, y0=y0, reference=towards(model, Jump(1e9, at)), rtol=1e-4)


def test_no_step_passes_a_knot_of_the_reference():
    model = coarse()
    y0 = grasped(model)
    x = float(model.unpack(y0).pose["disc"][0])
    jerk = Profile([0.0, 0.501, 0.503, 0.505], [x, x, x + 1e-4, x])
    own = towards(model, jerk)
    run = simulate(model, times(0.6, 3), y0=y0, reference=own, rtol=1e-3)
    for time in (0.501, 0.503, 0.505):
        assert float((run.knots - time).abs().min()) < 1e-12


def test_inertial_pads_take_steps_by_tolerance():
    model, y0 = quick(0.1, {"pad.inertial": True})
    t = times(0.15, 7)
    loose, tight = (simulate(model, t, y0=y0, rtol=rtol) for rtol in (1e-3, 1e-5))
    assert float((loose["y_C"] - tight["y_C"]).abs().max()) < 1e-6
    assert len(np.unique(loose.knots.diff().numpy().round(12))) > 0.5 * len(loose.knots)
    again = simulate(model, t, y0=y0, knots=loose.knots)
    assert float((again.y - loose.y).abs().max()) < 1e-9


def test_torchdiffeqs_tolerances_are_the_steppers():
    model = coarse()
    y0 = grasped(model, (0.03, 0.0))
    t = times(0.02, 4)
    solution = odeint(model, y0, t, method="sdirk2", rtol=1e-4, atol=1e-5)
    exact = simulate(model, t, y0=y0, rtol=1e-8).y
    i = model.layout.slices["pose", "disc"]
    assert float((solution - exact)[:, i].detach().abs().max()) < 1e-6
    grads = []
    for solve in (odeint, odeint_adjoint):
        model.zero_grad()
        y = solve(model, y0, t, method="sdirk2", rtol=1e-4, atol=1e-5)
        y[1:].square().sum().backward()
        grads.append(float(model.parameter("contact.K_t").grad))
    assert grads[0] == pytest.approx(grads[1], rel=1e-7)
