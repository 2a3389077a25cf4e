"""torchdiffeq's verbs with the registered method, its own methods on a rig."""

import importlib
import subprocess
import sys
from itertools import pairwise

import pytest
import torch
from conftest import coarse, f64, grasped, manipulate, times
from torchdiffeq import odeint, odeint_adjoint

from torchsoft import METHOD, Rig, register_method, simulate
from torchsoft.solve.torchdiffeq import TorchdiffeqSolver

OPTIONS = {"step_size": 2e-3, "tolerance": 1e-10}

Rolling = tuple[Rig, torch.Tensor]
SOLVERS = importlib.import_module("torchdiffeq._impl.odeint").SOLVERS


def test_an_import_leaves_torchdiffeq_alone_and_pysindy_for_later():
    code = (
        "import torchdiffeq; from torchdiffeq._impl.odeint import SOLVERS; before = dict(SOLVERS); "
        "import torchsoft; assert SOLVERS == before; torchsoft.register_method(); assert SOLVERS "
        "!= before; import sys, torchsoft.reduced; assert 'pysindy' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_torchdiffeq_runs_the_stepper():
    """`odeint(model, y0, t, method="sdirk2")` is `simulate`, sample by sample."""
    model = coarse()
    y0 = manipulate(model, 75.0)
    t = times(0.1, 6)
    y0 = torch.stack((y0, y0.clone()))
    y0[1, model.layout.slices["velocity", "disc"]] = f64(1e-3, 0.0, 0.0)
    solution = odeint(model, y0, t, method=METHOD, options={"step_size": 2e-3})
    assert solution.shape == (6, 2, model.layout.size)
    assert torch.equal(solution[:, 0].detach(), simulate(model, t, y0=y0[0], step=2e-3).y)
    assert torch.equal(solution[:, 1].detach(), simulate(model, t, y0=y0[1], step=2e-3).y)


@pytest.mark.parametrize("verb", [odeint, odeint_adjoint])
def test_decreasing_times_are_rejected(verb):
    model = coarse()
    y0 = grasped(model, (0.01, 0.0))
    with pytest.raises(ValueError, match=r"`t` must increase strictly.*\[0.5, 0.48\]"):
        verb(model, y0, f64(0.5, 0.48, 0.46), method=METHOD)


@torch.no_grad()
def test_explicit_methods_warn_of_decreasing_times_without_a_graph():
    model = coarse()
    y0 = grasped(model, (0.01, 0.0))
    with pytest.warns(UserWarning, match="integrated backwards.*use increasing times"):
        odeint(model, y0, f64(2e-5, 0.0), method="rk4", options={"step_size": 5e-6})


@pytest.mark.slow
def test_an_explicit_integration_backwards_is_warned_about_once():
    """Pads decay, and backwards they grow; forwards, with a graph or without, nothing is said."""
    model = coarse()
    y0, t = grasped(model, (0.05, -0.01)), times(4e-5, 3)
    options = {"step_size": 1e-5}
    odeint(model, y0, t, method="rk4", options=options)[-1].sum().backward()
    end = odeint_adjoint(model, y0, t, method="rk4", options=options)[-1].sum()
    with pytest.warns(UserWarning, match='integrated backwards.*method="sdirk2"'):
        end.backward()
    odeint_adjoint(model, y0, t, method="rk4", options=options)[-1].sum().backward()


@pytest.mark.parametrize("method", ["rk4", "dopri5"])
@pytest.mark.slow
@torch.no_grad()
def test_explicit_methods_agree(method):
    """torchdiffeq's own methods integrate the same forward and meet the stepper on a short window,
    slip included."""
    model = coarse()
    y0, t = grasped(model, (0.05, -0.01)), times(4e-4, 3)
    options = {"step_size": 1e-5} if method == "rk4" else {}
    end = odeint(model, y0, t, method=method, rtol=1e-7, atol=1e-10, options=options)[-1]
    implicit = simulate(model, t, y0=y0, step=2e-6)
    assert float(implicit.dissipated["slip"][-1]) > 5e-9  # the window does contain slip
    first, last, explicit = (model.unpack(y) for y in (implicit.y[0], implicit.y[-1], end))
    parts = [lambda s: s.pose["disc"][:2], lambda s: s.pose["disc"][2:], lambda s: s.stretch["L"]]
    parts += [lambda s, k=k: model.displacement(k, s) for k in "LU"]
    for part in parts:
        moved = (part(last) - part(first)).abs().max()
        assert float((part(explicit) - part(last)).abs().max()) < 1e-4 * float(moved)


@pytest.fixture
def solver_of_theirs():
    """torchdiffeq with a solver of its own under the name, and the stepper registered after it."""

    class Theirs:
        """Euler's method, one step an output."""

        def __init__(
            self, func: object, y0: torch.Tensor, rtol: float, atol: float, **options: object
        ) -> None:
            self.func, self.y0 = func, y0

        def integrate(self, t: torch.Tensor) -> torch.Tensor:
            rows = [self.y0]
            for begin, end in pairwise(t):
                rows.append(rows[-1] + (end - begin) * self.func(begin, rows[-1]))
            return torch.stack(rows)

        @classmethod
        def valid_callbacks(cls) -> set[str]:
            return set()

    before = SOLVERS[METHOD]
    SOLVERS[METHOD] = Theirs
    register_method()
    register_method()
    yield Theirs
    SOLVERS[METHOD] = before


def test_a_solver_of_torchdiffeqs_own_is_left_to_other_functions(solver_of_theirs):
    """A foreign function is integrated by theirs, a rig by the stepper; registering twice changes
    nothing."""
    assert issubclass(SOLVERS[METHOD], TorchdiffeqSolver)
    assert SOLVERS[METHOD].theirs is solver_of_theirs
    y = odeint(
        lambda t, y: -y, torch.ones(1, dtype=torch.float64), f64(0.0, 0.5, 1.0), method=METHOD
    )
    assert y[:, 0].tolist() == [1.0, 0.5, 0.25]
    model = coarse()
    y0, t = grasped(model, (0.01, 0.0)), times(0.01, 3)
    got = odeint(model, y0, t, method=METHOD, options={"step_size": 2e-3})
    assert torch.equal(got.detach(), simulate(model, t, y0=y0, step=2e-3).y)


@pytest.fixture(scope="module")
def rolling():
    """A model and two states (2, size) in its grasp."""
    model = coarse()
    y0 = manipulate(model, 75.0)
    with torch.no_grad():
        y = odeint(model, y0, f64(0, 0.3, 0.5), method=METHOD)
    y0 = torch.stack((y[1], y[2])).detach()
    y0[:, model.layout.slices["velocity", "disc"]] += f64(0.02, 0.0, 0.0)
    return model, y0


def gradients(
    model: Rig, y0: torch.Tensor, verb: object
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    model.zero_grad(set_to_none=True)
    start = y0.clone().requires_grad_(True)
    t = f64(0.3, 0.31, 0.325, 0.34)
    y = verb(model, start, t, method=METHOD, options=dict(OPTIONS))
    state = model.unpack(y)
    x, theta, speed = (
        state.pose["disc"][..., 0],
        state.pose["disc"][..., 2],
        state.velocity["bracket"][..., 1],
    )
    (1e3 * x * t[:, None] + theta + speed).sum().backward()
    return start.grad, {name: p.grad for name, p in model.named_parameters() if p.grad is not None}


def test_odeint_adjoint_equals_odeint(rolling):
    """Interval by interval, for a batch of two, every parameter and the initial states: the same
    but for the order of sums, whose terms cancel."""
    model, y0 = rolling
    y0_bar, bars = gradients(model, y0, odeint)
    y0_bar_adjoint, bars_adjoint = gradients(model, y0, odeint_adjoint)
    assert float((y0_bar - y0_bar_adjoint).abs().max()) < 1e-11 * float(y0_bar.abs().max())
    parts = {name: p.detach() for name, p in model.named_parameters()}
    largest = max(float((bar * parts[name]).abs().max()) for name, bar in bars.items())
    for name, bar in bars.items():
        off = (bar - bars_adjoint[name]) * parts[name]
        assert float(off.abs().max()) <= 1e-13 * largest, name


def test_odeint_adjoint_of_a_forgotten_run_says_so(rolling):
    model, y0 = rolling
    t = f64(0.3, 0.31)
    y = odeint_adjoint(model, y0[0].clone().requires_grad_(True), t, method=METHOD)
    for shift in range(5):
        odeint(model, y0[0] + 1e-6 * shift, t, method=METHOD)
    with pytest.raises(RuntimeError, match="not among the last 4"):
        y.sum().backward()


@pytest.mark.filterwarnings("ignore:the rig is integrated backwards")
def test_continuous_adjoint_agrees_on_a_short_window(rolling):
    """0.2 ms of a sticking grasp by rk4 and its continuous adjoint, against fine steps and the
    discrete adjoint."""
    model, y0 = rolling
    start = y0[1].clone()
    start[model.layout.slices["velocity", "disc"]] -= f64(0.0195, 0.0, 0.0)  # slow enough to stick
    t = torch.linspace(0.5, 0.5002, 3, dtype=torch.float64)
    names = ("contact.K_t", "contact.R_t", "contact.K_n", "pad.E", "disc.mass")
    results = []
    for solve in (
        lambda y: odeint_adjoint(model, y, t, method="rk4", options={"step_size": 2.5e-5}),
        lambda y: odeint(model, y, t, method=METHOD, options={"step_size": 2e-6}),
    ):
        model.zero_grad(set_to_none=True)
        model.unpack(solve(start.clone().requires_grad_(True))).velocity["disc"][
            :, 2
        ].sum().backward()
        results.append({name: model.parameter(name).grad.item() for name in names})
    for name in names:
        continuous, discrete = (result[name] for result in results)
        assert abs(continuous - discrete) < 1e-4 * abs(discrete), name
