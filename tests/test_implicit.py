"""The stepper: order, torchdiffeq, energy, and how runs end."""

import numpy as np
import pytest
import torch
from conftest import COARSE, coarse
from torchdiffeq import odeint

from torchsoft import METHOD, Parameters, SimulationFailed, SoftGrasp, press, rest, simulate
from torchsoft.adjoint import differentiable_solution
from torchsoft.control import Profile, Reference, hold
from torchsoft.implicit import ImplicitStepper, Segment
from torchsoft.scenario import grasp_and_roll
from torchsoft.stability import loop_modes


def grasped(model: SoftGrasp) -> torch.Tensor:
    """The frictionless grasp, held there by the controllers."""
    y = press(model, model.settings.scenario.y_Br_grasp).detach()
    state = model.layout.unpack(y)
    with torch.no_grad():
        port = model.evaluate(0.0, state).ports["pad_U"]
        load = float(port.transformer.effort(port.effort, model.junctions)["bracket"][..., 1].sum())
    model.reference = hold(float(state.r_C[0]), float(state.r_Br[1]), load)
    return y


def times(end: float, n: int) -> torch.Tensor:
    return torch.linspace(0, end, n, dtype=torch.float64)


def test_second_order_on_a_smooth_motion(fidelity: str) -> None:
    """A grasped disc set moving so gently that no node slips, touches or leaves: observed order >= 1.8."""
    model = coarse(pad__fidelity=fidelity)
    y0 = grasped(model)
    y0[model.layout.slices["v_C"]] = torch.tensor([1e-4, 5e-5], dtype=torch.float64)
    t = times(0.032, 2)
    fine = simulate(model, t, y0=y0, step=3.2e-2 / 2048).y[-1]
    part = model.layout.slices["r_C"]
    errors = [float((simulate(model, t, y0=y0, step=h).y[-1] - fine)[part].norm()) for h in (2e-3, 1e-3, 5e-4)]
    orders = [torch.log2(torch.tensor(errors[i] / errors[i + 1])).item() for i in range(2)]
    assert min(orders) >= 1.8, (errors, orders)


def test_torchdiffeq_runs_the_stepper() -> None:
    """`odeint(model, y0, t, method="sdirk2")` is `simulate`, sample by sample."""
    model = coarse()
    manipulation = grasp_and_roll(model, grasp_force=75.0)
    t = times(0.1, 6)
    y0 = torch.stack((manipulation.y0, manipulation.y0.clone()))
    y0[1, model.layout.slices["v_C"]] = torch.tensor([1e-3, 0.0], dtype=torch.float64)
    solution = odeint(model, y0, t, method=METHOD, options={"step_size": 2e-3})
    assert solution.shape == (6, 2, model.layout.size)
    assert torch.equal(solution[:, 0].detach(), simulate(model, t, y0=y0[0]).y)
    assert torch.equal(solution[:, 1].detach(), simulate(model, t, y0=y0[1]).y)


@pytest.mark.parametrize("method", ["rk4", "dopri5"])
def test_explicit_methods_agree(method: str) -> None:
    """torchdiffeq's own methods integrate the same forward and meet the stepper on a short window, slip included."""
    model = coarse()
    y0 = grasped(model)
    y0[model.layout.slices["v_C"]] = torch.tensor([0.05, -0.01], dtype=torch.float64)
    t = times(1e-3, 3)
    with torch.no_grad():
        options = {"step_size": 2e-5} if method == "rk4" else {}
        explicit = odeint(model, y0, t, method=method, rtol=1e-8, atol=1e-11, options=options)
    implicit = simulate(model, t, y0=y0, step=5e-6)
    assert bool(implicit.dissipated["slip"][-1] > 1e-8)  # the window does contain slip
    for name in ("r_C", "theta", "u_L", "u_U", "s_L"):
        part = model.layout.slices[name]
        moved = (implicit.y[-1] - implicit.y[0])[part].abs().max()
        assert float((explicit[-1] - implicit.y[-1])[part].abs().max()) < 1e-4 * float(moved), name


def test_gradients_of_inertial_pads_are_refused() -> None:
    model = coarse(pad__fidelity="inertial")
    y0 = grasped(model)
    with pytest.raises(NotImplementedError, match="for massless pads"):
        odeint(model, y0, times(4e-3, 2), method=METHOD)
    with torch.no_grad():
        odeint(model, y0, times(4e-3, 2), method=METHOD)


def test_only_soft_grasps_are_integrated() -> None:
    with pytest.raises(TypeError, match=r"integrates a torchsoft\.SoftGrasp"):
        odeint(torch.nn.Identity(), torch.zeros(3, dtype=torch.float64), times(1.0, 2), method=METHOD)


def test_energy_residual_falls_with_the_step() -> None:
    """The ledger closes to 1e-3 of the energy injected at 2 ms over grasp and first stroke, and better at 0.5 ms."""
    model = coarse()
    manipulation = grasp_and_roll(model, grasp_force=75.0)
    residual = [
        simulate(model, times(0.6, 61), y0=manipulation.y0, step=h).energy_residual_rel for h in (2e-3, 1e-3, 5e-4)
    ]
    assert residual[0] < 1e-3
    assert residual[2] < residual[1] < residual[0]
    assert residual[2] < 0.5 * residual[0]  # nodes touch and leave all along, so not second order


def test_kernel_forces_equal_the_module() -> None:
    """Recorded nodal forces, bracket moment and ledger powers are what `evaluate` gives at the recorded states."""
    model = coarse()
    manipulation = grasp_and_roll(model, grasp_force=75.0)
    run = simulate(model, times(0.5, 11), y0=manipulation.y0)
    for i in (0, 3, 7, 10):
        with torch.no_grad():
            graph = model.evaluate(run.t[i], model.layout.unpack(run.y[i]))
        for k, recorded in (("L", run.force_L), ("U", run.force_U)):
            contact = graph.interfaces[k].contact
            expected = torch.stack((contact.F_N, contact.F_T), -1)
            assert float((recorded[i] - expected).abs().max()) < 1e-8  # [N], ten times Newton's tolerance


def test_same_run_twice_to_the_bit() -> None:
    model = coarse()
    manipulation = grasp_and_roll(model, grasp_force=75.0)
    first, second = (simulate(model, times(0.4, 21), y0=manipulation.y0).y for _ in range(2))
    assert torch.equal(first, second)


def test_irregular_output_times_do_not_matter() -> None:
    """Outputs only cut the steps: the same instants reached with other outputs agree to the stepper's accuracy."""
    model = coarse()
    manipulation = grasp_and_roll(model, grasp_force=75.0)
    even = simulate(model, times(0.4, 5), y0=manipulation.y0, step=5e-4)
    odd = simulate(model, torch.tensor([0, 0.1003, 0.17, 0.3, 0.4], dtype=torch.float64), y0=manipulation.y0, step=5e-4)
    part = model.layout.slices["r_C"]
    assert float((even.y[-1] - odd.y[-1])[part].abs().max()) < 1e-8


@pytest.mark.parametrize(
    ("t", "match"),
    [
        ([0.0, 0.1, 0.1], "increase strictly"),
        ([0.0, 0.2, 0.1], r"t\[1:3\]"),
        ([0.0], "two times or more"),
        ([0.0, float("nan")], "finite"),
    ],
)
def test_bad_times_are_refused(t: list[float], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        simulate(coarse(), torch.tensor(t, dtype=torch.float64))


def test_bad_states_steps_and_parameters_are_refused() -> None:
    model, t = coarse(), times(0.1, 2)
    with pytest.raises(ValueError, match="must be float64"):
        simulate(model, t, y0=torch.zeros(model.layout.size))
    with pytest.raises(ValueError, match="must be float64 of shape"):
        simulate(model, t, y0=torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ValueError, match="one finite state"):
        simulate(model, t, y0=torch.full((model.layout.size,), torch.nan, dtype=torch.float64))
    with pytest.raises(ValueError, match="`step` must be a positive"):
        simulate(model, t, step=0.0)
    with torch.no_grad():
        model.contact.K_n.fill_(torch.nan)
    with pytest.raises(ValueError, match=r"`contact.K_n` must be finite"):
        simulate(model, t, y0=rest(coarse()).detach())


@pytest.mark.parametrize(
    ("tau", "leading"), [(1e-3, 38.9 + 610j), (2e-3, None), (5e-3, None), (10e-3, None)], ids=["1", "2", "5", "10"]
)
def test_loop_modes(tau: float, leading: complex | None) -> None:
    """The paper's gains at E = 0.75 MPa: unstable at tau = 1 ms with +39 +- 610j 1/s, stable from 2 ms on."""
    modes = loop_modes(SoftGrasp(Parameters().override({"pad.tau": tau})))
    if leading is None:
        assert float(modes.real.max()) < 0.1
    else:
        assert abs(modes[0].real.item() - leading.real) < 0.5
        assert abs(abs(modes[0].imag.item()) - leading.imag) < 2


def test_an_unstable_loop_ends_in_an_error_that_says_so() -> None:
    """E = 60 kPa, tau = 5 ms with the paper's gains."""
    model = SoftGrasp(Parameters().override(COARSE | {"pad.E": 6e4, "pad.tau": 5e-3}))
    with pytest.raises(SimulationFailed, match=r"disc was lost at t = .* s: the closed loop is unstable") as caught:
        grasp_and_roll(model)
    assert 0 < caught.value.time < 1
    assert bool(torch.isfinite(caught.value.trajectory.y).all())


def test_a_disc_rolled_off_the_pad_is_reported() -> None:
    """Only the reference knows the pad's length; a model driven beyond it says where the run ended."""
    model = coarse()
    y0 = grasped(model)
    feed = model.reference.F_y
    model.reference = Reference(Profile([0.0, 1.0], [0.06, 0.13]), model.reference.y, feed)
    with pytest.raises(SimulationFailed, match="contact reached the end of a pad"):
        simulate(model, times(1.0, 101), y0=y0)


def test_a_step_that_newton_does_not_solve_is_halved() -> None:
    """Too few iterations for the hardest steps: those are cut, the others are not, and the run ends where it should."""
    model = coarse(contact__mu_s=0.3, contact__mu_k=0.2)
    y0, t = grasped(model), times(0.02, 11)
    y0[model.layout.slices["v_C"]] = torch.tensor([0.15, 0.0], dtype=torch.float64)
    runs = []
    for iterations in (40, 10):
        stepper = ImplicitStepper(model, step=2e-3, max_iterations=iterations)
        segments: list[Segment] = []
        *_, last = stepper.integrate(y0, t, segments)
        assert sum(len(segment.chunk.starts) for segment in segments) == last.steps
        assert last.rows == len(t)
        runs.append(last)
    free, cut = runs
    assert free.failed == 0
    assert cut.failed > 0
    assert 10 < cut.steps < 10 + 64 * cut.failed
    fine = simulate(model, t, y0=y0, step=6.25e-5).y.numpy()
    off_cut, off_free = (np.abs(run.y - fine)[:, model.layout.slices["r_C"]].max() for run in (cut, free))
    assert off_cut < 1.2 * off_free


def test_the_adjoint_follows_halved_steps() -> None:
    """Where steps were cut, the gradient is still that of the run; differences small enough to cut the same steps."""
    model = coarse(contact__mu_s=0.3, contact__mu_k=0.2)
    y0, t = grasped(model), times(0.01, 6)
    y0[model.layout.slices["v_C"]] = torch.tensor([0.15, 0.0], dtype=torch.float64)
    E = model.material.E

    def angle() -> tuple[torch.Tensor, int]:
        y, run = differentiable_solution(ImplicitStepper(model, step=2e-3, tolerance=1e-10, max_iterations=10), y0, t)
        return model.layout.unpack(y).theta[-1], run.failed

    theta, failed = angle()
    (slope,) = torch.autograd.grad(theta, E)
    assert failed > 0
    with torch.no_grad():
        value, h = E.clone(), 1e-5 * E.item()
        ahead, behind = (angle() for E_near in (value + h, value - h) if E.copy_(E_near) is not None)
        E.copy_(value)
    assert ahead[1] == behind[1] == failed
    assert slope.item() == pytest.approx((ahead[0] - behind[0]).item() / (2 * h), rel=1e-4)
