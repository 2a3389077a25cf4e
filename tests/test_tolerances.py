"""Steps by tolerance: accuracy, dense output, frozen steps, and what cannot be met."""

import numpy as np
import pytest
import torch
from conftest import COARSE, coarse, f64, grasped, paper, times, towards
from torch import Tensor, nn

from torchsoft import RigFile, SimulationFailed, Trajectory, simulate
from torchsoft.physics.motion import Profile, Sampled
from torchsoft.solve.steps import given_steps

T = times(0.4, 9)
ERRORS = "x_C", "y_C", "theta", "y_Br", "F_x", "F_y"
GRASP = {f"motion.{name}.times": [0.0, 0.25] for name in ("y_d", "F_ff")} | {
    "motion.F_ff.values": [0.0, -80.0], "motion.x_d.times": [0.0, 0.5, 0.6, 1.1],
    "motion.x_d.values": ["start", 56e-3, 56e-3, 60e-3],
}  # fmt: skip
"""The paper's manipulation, quickened: its touch-down and grasp within 0.3 s."""


@pytest.fixture(scope="module")
def go():
    model, y0, _ = paper(COARSE | {"pad.elements_x": 40} | GRASP)
    return lambda t, **how: simulate(model, t, y0=y0, **how)


@pytest.fixture(scope="module")
def exact(go):
    return go(times(0.4, 161), rtol=1e-8)


def worst(run: Trajectory, exact: Trajectory) -> float:
    """Largest error of the motion and of the forces, over their range."""
    every = (len(exact.t) - 1) // (len(run.t) - 1)
    ranges = {x: float(np.ptp(exact[x].numpy())) for x in ERRORS}
    return max(float((run[x] - exact[x][::every]).abs().max()) / ranges[x] for x in ERRORS)


def test_error_falls_with_the_tolerance(go, exact):
    errors = []
    for rtol in (1e-3, 1e-5, 1e-7):
        run = go(T, rtol=rtol)
        errors.append(worst(run, exact))
        assert errors[-1] < 30 * rtol**0.8
        assert run.energy_residual_rel < 3 * rtol**0.7
    assert errors[0] > 5 * errors[1] > 10 * errors[2]


def test_the_energy_residual_of_a_fall_falls_with_the_tolerance():
    """An ellipse in free flight and on a pad, with long steps between outputs."""
    ready = RigFile.ready("drop").override(outputs={"duration": 0.2, "snapshots": []}).build()
    runs = [simulate(ready.rig, ready.t, y0=ready.y0, rtol=rtol) for rtol in (1e-4, 1e-6)]
    assert runs[0].energy_residual_rel < 2e-4
    assert runs[1].energy_residual_rel < 0.2 * runs[0].energy_residual_rel
    flight = [float(run.energy_residual[run.t < 0.02].abs().max()) for run in runs]
    assert max(flight) < 1e-9 * float(runs[0].injected[-1])


def test_steps_are_short_where_it_touches_down_and_long_where_it_rests(go):
    run = go(times(2.0, 5), rtol=1e-4)
    h, start = run.knots.diff(), run.knots[:-1]
    assert run.stats.refused_steps > 0
    assert float(h[start > 1.5].min()) > 0.02
    assert float(h[start < 0.25].min()) < 2e-3


def test_outputs_do_not_change_the_run_and_are_as_good_as_its_steps(go, exact):
    """Up to Newton's tolerance, which decides steps that are nearly rejected. The forces between
    two knots are those of the states there, and the same steps can be taken again."""
    few, many = (go(times(0.4, n), rtol=1e-4) for n in (9, 161))
    assert few.stats.steps == pytest.approx(many.stats.steps, rel=0.03)
    assert torch.allclose(few.knots[:40], many.knots[:40], rtol=1e-6)
    assert worst(few, many) < worst(few, exact)
    ends, fine = go(many.knots, knots=many.knots), go(many.knots, rtol=1e-7)
    for x in ("x_C", "y_C", "y_Br", "F_y"):
        between, at_knots = (many[x] - exact[x]).abs().max(), (ends[x] - fine[x]).abs().max()
        assert between < 3 * at_knots
    alone = simulate(many.rig, many.t[121:123], y0=many.y[121], step=1e-3)
    again = go(many.t, knots=many.knots)
    assert float((again.y - many.y).abs().max()) < 1e-8
    for name, force in many.force.items():
        assert float((alone.force[name][0] - force[121]).abs().max()) < 1e-8
        assert float((again.force[name] - force).abs().max()) < 1e-8


def test_outputs_lie_within_their_steps_however_these_differ():
    """A last step that is longer by far must not decide where the outputs of the short ones lie."""
    t = f64(0.0, 5e-10, 1e-9, 1.05e-9, 2e-9, 0.1)
    (plan,) = given_steps(t, np.array([0.0, 1e-9, 2e-9, 0.1]))
    assert plan.out_step.tolist() == [0, 0, 1, 1, 2]
    assert plan.out_part.tolist() == pytest.approx([0.5, 1.0, 0.05, 1.0, 1.0])


class Wave(nn.Module):
    """A signal that is no piecewise polynomial; from `at` on [s] it jumps by 1 mm, and its stated
    rate by `rate` [m/s]."""

    def __init__(self, rate: float = 0.0, at: float = torch.inf) -> None:
        super().__init__()
        self.rate, self.at = rate, at

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        late = (t > self.at).double()
        value, rate = 0.06 + 1e-3 * torch.sin(20 * t), 2e-2 * torch.cos(20 * t)
        return value + 1e-3 * late, rate + self.rate * late


def test_a_custom_signal_is_followed():
    model, t, knots = coarse(), times(0.1, 6), times(0.1, 2001)
    y0 = grasped(model)
    go = lambda signal, rtol: simulate(model, t, y0=y0, reference=towards(model, signal), rtol=rtol)
    fine = go(Wave(), 1e-7)["x_C"]
    assert float((go(Wave(), 1e-4)["x_C"] - fine).abs().max()) < 1e-7
    pieces = Sampled(*[x.tolist() for x in (knots, *Wave()(knots))])
    assert float((go(pieces, 1e-7)["x_C"] - fine).abs().max()) < 1e-9


def test_no_step_passes_a_knot_of_the_reference():
    model = coarse()
    y0, knots = grasped(model), [0.0, 0.501, 0.503, 0.505]
    jerk = towards(model, Profile(knots, [0.06, 0.06, 0.0601, 0.06]))
    run = simulate(model, times(0.6, 3), y0=y0, reference=jerk, rtol=1e-3)
    for time in knots:
        assert float((run.knots - time).abs().min()) < 1e-12


@pytest.mark.parametrize(("rate", "at"), [(0.0, 0.0512345), (1e9, 0.0512345), (1e9, 7.3)])
def test_a_jump_is_stepped_over_or_ends_the_run(rate, at):
    """However the shortest step is rounded at that time."""
    model = coarse()
    how = {"y0": grasped(model), "reference": towards(model, Wave(rate, at)), "rtol": 1e-4}
    t = f64(at - 0.02, at + 0.02)
    if rate:
        shortest = rf"at t = {at:.3g}\d* s .* steps below 1e-09 s for the velocity of body `br"
        with pytest.raises(SimulationFailed, match=shortest):
            simulate(model, t, **how)
    else:
        run = simulate(model, t, **how)
        short = run.knots.diff().argmin()
        assert float((run.knots[short] - at).abs()) < 1e-3
        assert float(run.knots.diff().min()) < 1e-4


def test_what_a_signal_raises_is_raised():
    def broken(t):
        if bool((t > 0.05).any()):
            raise RuntimeError("the table of this signal ends at 0.05 s")
        return Wave()(t)

    model, signal = coarse(), Wave()
    y0, signal.forward = grasped(model), broken
    with pytest.raises(RuntimeError, match="the table of this signal ends"):
        simulate(model, times(0.1, 6), y0=y0, reference=towards(model, signal), rtol=1e-4)
