"""torchdiffeq's verbs with the registered method, and its own methods on a rig."""

import importlib
import subprocess
import sys
from contextlib import nullcontext

import pytest
import torch
from conftest import coarse, f64, grasped, times
from torchdiffeq import odeint, odeint_adjoint

from torchsoft import METHOD, register_method, simulate

SOLVERS = importlib.import_module("torchdiffeq._impl.odeint").SOLVERS


@pytest.mark.slow
def test_an_import_leaves_torchdiffeq_alone_and_pysindy_for_later():
    code = (
        "import torchdiffeq; from torchdiffeq._impl.odeint import SOLVERS; before = dict(SOLVERS); "
        "import torchsoft; assert SOLVERS == before; torchsoft.register_method(); assert SOLVERS "
        "!= before; import sys, torchsoft.reduced; assert 'pysindy' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_torchdiffeq_runs_the_stepper(monkeypatch):
    """`odeint(model, y0, t, method="sdirk2")` is `simulate`, sample by sample; another function is
    integrated by the solver that had the name before."""
    monkeypatch.setitem(SOLVERS, METHOD, SOLVERS["euler"])
    register_method()
    register_method()
    decay = lambda t, y: -y
    y = odeint(decay, torch.ones(1, dtype=torch.float64), f64(0.0, 0.5, 1.0), method=METHOD)
    assert y[:, 0].tolist() == [1.0, 0.5, 0.25]
    model, t = coarse(), times(0.02, 4)
    y0 = grasped(model, (0.01, 0.0))
    y0 = torch.stack((y0, 1.0001 * y0))
    solution = odeint(model, y0, t, method=METHOD, options={"step_size": 2e-3})
    for found, start in zip(solution.detach().unbind(1), y0):
        assert torch.equal(found, simulate(model, t, y0=start, step=2e-3).y)


def test_decreasing_times_are_rejected_or_warned_of():
    model = coarse(pad__elements_x=30)
    y0 = grasped(model, (0.01, 0.0))
    for verb in (odeint, odeint_adjoint):
        with pytest.raises(ValueError, match=r"`t` must increase strictly.*\[0.5, 0.48\]"):
            verb(model, y0, f64(0.5, 0.48, 0.46), method=METHOD)
    with torch.no_grad(), pytest.warns(UserWarning, match="backwards.*use increasing times"):
        odeint(model, y0, f64(4e-5, 0.0), method="rk4", options={"step_size": 5e-6})


@pytest.mark.parametrize(
    ("given", "rounding"),
    [
        ({"options": {"step_size": 2e-3, "tolerance": 1e-10}}, 1e-13),
        ({"rtol": 1e-4, "atol": 1e-5}, 1e-9),
    ],
    ids=["step", "tolerances"],
)
def test_odeint_adjoint_equals_odeint(given, rounding):
    """Interval by interval, for a batch of two, every parameter and the initial states: the same
    but for the order of sums, whose terms cancel, and the steps of each interval."""
    model, found = coarse(), []
    y0 = grasped(model, (0.02, 0.0))
    y0 = torch.stack((y0, 1.0001 * y0))
    for verb in (odeint, odeint_adjoint):
        model.zero_grad(set_to_none=True)
        start, t = y0.clone().requires_grad_(), f64(0.3, 0.31, 0.325, 0.34)
        state = model.unpack(verb(model, start, t, method=METHOD, **given))
        x, theta = state.pose["disc"][..., 0], state.pose["disc"][..., 2]
        (1e3 * x * t[:, None] + theta + state.velocity["bracket"][..., 1]).sum().backward()
        known = [p for p in model.parameters() if p.grad is not None]
        found.append([start.grad, *(p.grad * p.detach() for p in known)])
    (by_y0, *bars), (again, *others) = found
    assert float((by_y0 - again).abs().max()) < 1e2 * rounding * float(by_y0.abs().max())
    largest = max(float(bar.abs().max()) for bar in bars)
    for bar, other in zip(bars, others, strict=True):
        assert float((bar - other).abs().max()) <= rounding * largest


def test_odeint_adjoint_of_a_forgotten_run_says_so():
    model, t = coarse(), f64(0.3, 0.31)
    y0 = grasped(model)
    y = odeint_adjoint(model, y0.clone().requires_grad_(True), t, method=METHOD)
    for shift in range(5):
        odeint(model, y0 + 1e-6 * shift, t, method=METHOD)
    with pytest.raises(RuntimeError, match="not among the last 4"):
        y.sum().backward()


def test_the_continuous_adjoint_agrees_on_a_short_window():
    """0.1 ms of a sticking grasp by rk4 and its continuous adjoint, against fine steps and the
    discrete adjoint; it warns that it integrates backwards, and only then."""
    model, t = coarse(pad__elements_x=30, pad__elements_y=1), times(1e-4, 2)
    names = ("contact.K_t", "contact.R_t", "contact.K_n", "pad.E", "disc.mass")
    y0, results = grasped(model, (5e-4, 0.0)), []
    for solve, warns in (
        (lambda y: odeint_adjoint(model, y, t, method="rk4", options={"step_size": 2.5e-5}), True),
        (lambda y: odeint(model, y, t, method=METHOD, options={"step_size": 1e-6}), False),
    ):
        spin = model.unpack(solve(y0.clone().requires_grad_())).velocity["disc"][:, 2].sum()
        backwards = pytest.warns(UserWarning, match='integrated backwards.*method="sdirk2"')
        with backwards if warns else nullcontext():
            results.append(torch.autograd.grad(spin, [*map(model.parameter, names)]))
    for name, continuous, discrete in zip(names, *results):
        assert abs(float(continuous - discrete)) < 1e-4 * abs(float(discrete)), name
