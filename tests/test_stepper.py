"""The stepper: order, grids, how runs end, halved steps, driven bodies."""

import numpy as np
import pytest
import torch
from conftest import COARSE, coarse, grasped, paper, times, towards

from torchsoft import Profile, Reference, Rig, SimulationFailed, simulate
from torchsoft.solve.progress import Segment
from torchsoft.solve.stepper import ImplicitStepper


def test_second_order_on_a_smooth_motion(fidelity):
    """A grasped disc set moving so gently that no node slips, touches or leaves: observed order >=
    1.8."""
    model = coarse(pad__inertial=fidelity == "inertial")
    y0, t = grasped(model, (1e-4, 5e-5)), times(0.032, 2)
    place = lambda h: simulate(model, t, y0=y0, step=h).state.pose["disc"][-1, :2]
    fine = place(3.2e-2 / 2048)
    errors = [float((place(h) - fine).norm()) for h in (2e-3, 1e-3, 5e-4)]
    orders = [float(np.log2(errors[i] / errors[i + 1])) for i in range(2)]
    assert min(orders) >= 1.8, (errors, orders)


@pytest.mark.parametrize("states", [{}, {"actuators.y.lag": 1e-4, "actuators.x.Ki": 10.0}])
def test_an_unstable_loop_ends_in_an_error_that_says_so(states):
    """E = 60 kPa, tau = 5 ms with the paper's gains, and controllers with states of their own."""
    built = paper(COARSE | {"pad.E": 6e4, "pad.tau": 5e-3} | states)
    with pytest.raises(
        SimulationFailed, match=r"the run was lost at t = .* s: the closed loop is unstable"
    ) as caught:
        built.run(rtol=1e-4)
    assert 0 < caught.value.time < 1
    assert bool(torch.isfinite(caught.value.trajectory.y).all())


def test_a_disc_rolled_off_the_pad_is_reported():
    """Only the reference knows the pad's length; a model driven beyond it says where the run
    ended."""
    model = coarse()
    y0 = grasped(model)
    beyond = towards(model, Profile([0.0, 1.0], [0.06, 0.13]))
    with pytest.raises(
        SimulationFailed, match="`disc` was lost: its contact reached the end of the pad"
    ) as caught:
        simulate(model, times(1.0, 101), y0=y0, reference=beyond)
    run = caught.value.trajectory
    assert len(run.t) == len(run.y) == len(run["x_C"]) < 101
    assert float(run.t[-1]) <= caught.value.time


def test_a_step_that_newton_does_not_solve_is_halved():
    """Too few iterations for the hardest steps: those are cut, the others are not, and the run ends
    where it should."""
    model = coarse(contact__mu_s=0.3, contact__mu_k=0.2)
    y0, t = grasped(model, (0.5, 0.0)), times(0.02, 11)
    runs = []
    for iterations in (40, 12):
        stepper = ImplicitStepper(model, step=2e-3, max_iterations=iterations)
        segments: list[Segment] = []
        *_, last = stepper.integrate(y0, t, segments)
        assert sum(len(segment.plan.h) for segment in segments) == last.steps
        assert last.rows == len(t)
        runs.append(last)
    free, cut = runs
    assert free.failed == 0
    assert cut.failed > 0
    assert 10 < cut.steps < 10 + 64 * cut.failed
    fine = simulate(model, t, y0=y0, step=6.25e-5).y.numpy()
    place = model.layout.slices["pose", "disc"]
    off_cut, off_free = (np.abs(run.y - fine)[:, place][:, :2].max() for run in (cut, free))
    assert off_cut < 1.2 * off_free


def test_the_adjoint_follows_halved_steps(monkeypatch):
    """Where steps were cut, the gradient is still that of the run; differences small enough to cut
    the same steps."""
    model = coarse(contact__mu_s=0.3, contact__mu_k=0.2)
    y0, t = grasped(model, (0.5, 0.0)), times(0.01, 6)
    E = model.parameter("pad.E")

    class Hasty(ImplicitStepper):
        def __init__(self, rig: Rig, reference: Reference | None = None, **options: float) -> None:
            super().__init__(rig, reference, max_iterations=12, **options)

    monkeypatch.setattr("torchsoft.solve.simulate.ImplicitStepper", Hasty)

    def angle() -> tuple[torch.Tensor, int]:
        run = simulate(model, t, y0=y0, step=2e-3, tolerance=1e-10, gradient="discrete")
        return run["theta"][-1], run.stats.failed_steps

    theta, failed = angle()
    (slope,) = torch.autograd.grad(theta, E)
    run = simulate(
        model, t, y0=y0, step=2e-3, tolerance=1e-10, gradient="forward", wrt=["pad.E"], rigid=True
    )
    assert float(run.sensitivities[-1, 2, 0]) == pytest.approx(slope.item(), rel=1e-9)
    assert failed == run.stats.failed_steps > 0
    with torch.no_grad():
        value, h = E.clone(), 1e-5 * E.item()
        ahead, behind = (
            angle() for E_near in (value + h, value - h) if E.copy_(E_near) is not None
        )
        E.copy_(value)
    assert ahead[1] == behind[1] == failed
    assert slope.item() == pytest.approx((ahead[0] - behind[0]).item() / (2 * h), rel=1e-4)
