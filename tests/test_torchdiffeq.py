"""torchdiffeq's verbs: the registered method under `odeint_adjoint`, and the guard of the continuous adjoint."""

import pytest
import torch
from conftest import coarse
from torchdiffeq import odeint, odeint_adjoint

from torchsoft import METHOD, SoftGrasp
from torchsoft.continuous import LONGEST, OutputsTooCoarse, continuous_adjoint_solution, stiffest_rate
from torchsoft.scenario import grasp_and_roll

OPTIONS = {"step_size": 2e-3, "tolerance": 1e-10}


def rolling() -> tuple[SoftGrasp, torch.Tensor]:
    """A model and two states (2, size) in its grasp."""
    model = coarse()
    manipulation = grasp_and_roll(model, grasp_force=75.0)
    with torch.no_grad():
        y = odeint(model, manipulation.y0, torch.tensor([0, 0.3, 0.5], dtype=torch.float64), method=METHOD)
    y0 = torch.stack((y[1], y[2])).detach()
    y0[:, model.layout.slices["v_C"]] += torch.tensor([0.02, 0.0], dtype=torch.float64)
    return model, y0


def gradients(model: SoftGrasp, y0: torch.Tensor, verb: object) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    model.zero_grad(set_to_none=True)
    start = y0.clone().requires_grad_(True)
    t = torch.tensor([0.3, 0.31, 0.325, 0.34], dtype=torch.float64)
    y = verb(model, start, t, method=METHOD, options=dict(OPTIONS))  # pyright: ignore[reportCallIssue]
    state = model.layout.unpack(y)
    (1e3 * state.r_C[..., 0] * t[:, None] + state.theta + state.v_Br[..., 1]).sum().backward()
    assert start.grad is not None
    return start.grad, {name: p.grad for name, p in model.named_parameters() if p.grad is not None}


def test_odeint_adjoint_equals_odeint() -> None:
    """Interval by interval, for a batch of two, every parameter and the initial states."""
    model, y0 = rolling()
    y0_bar, bars = gradients(model, y0, odeint)
    y0_bar_adjoint, bars_adjoint = gradients(model, y0, odeint_adjoint)
    assert float((y0_bar - y0_bar_adjoint).abs().max()) < 1e-11 * float(y0_bar.abs().max())
    for name, bar in bars.items():
        assert float((bar - bars_adjoint[name]).abs().max()) <= 1e-11 * float(bar.abs().max()), name


def test_odeint_adjoint_of_a_forgotten_run_says_so() -> None:
    model, y0 = rolling()
    t = torch.tensor([0.3, 0.31], dtype=torch.float64)
    y = odeint_adjoint(model, y0[0].clone().requires_grad_(True), t, method=METHOD)
    for shift in range(5):
        odeint(model, y0[0] + 1e-6 * shift, t, method=METHOD)
    with pytest.raises(RuntimeError, match="not among the last 4"):
        y.sum().backward()


def test_continuous_adjoint_agrees_on_a_short_window() -> None:
    """1 ms of a sticking grasp by rk4 and its continuous adjoint, against fine steps and the discrete adjoint."""
    model, y0 = rolling()
    start = y0[1]
    start[model.layout.slices["v_C"]] -= torch.tensor([0.0195, 0.0], dtype=torch.float64)  # slow enough to stick
    t = torch.linspace(0.5, 0.501, 3, dtype=torch.float64)
    names = ("contact.K_t", "contact.R_t", "contact.K_n", "material.E", "m_C")
    results = []
    for solve in (
        lambda y: continuous_adjoint_solution(model, y, t, method="rk4", options={"step_size": 2.5e-5}),
        lambda y: odeint(model, y, t, method=METHOD, options={"step_size": 2e-6}),
    ):
        model.zero_grad(set_to_none=True)
        model.layout.unpack(solve(start.clone().requires_grad_(True))).omega.sum().backward()
        results.append({name: dict(model.named_parameters())[name].grad.item() for name in names})
    for name in names:
        continuous, discrete = (result[name] for result in results)
        assert abs(continuous - discrete) < 1e-4 * abs(discrete), name


def test_coarse_outputs_are_refused() -> None:
    model, y0 = rolling()
    rate = stiffest_rate(model, y0[0], 0.3)
    t = torch.tensor([0.3, 0.3 + 1.2 * LONGEST / rate], dtype=torch.float64)
    with pytest.raises(OutputsTooCoarse, match="loses the gradient"):
        continuous_adjoint_solution(model, y0[0], t)
