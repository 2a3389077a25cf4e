"""Two ways down the same misfit: Gauss-Newton on exact sensitivities, and gradient descent on the discrete adjoint."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from torchsoft.sysid.information import standard_deviations
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.workers import Runner

Loss = Literal["linear", "soft_l1", "huber", "cauchy", "arctan"]
Notify = Callable[[float], None]


class Unreachable(RuntimeError):
    """The model cannot follow a recording with the parameters that a fit starts from; `lost` has reason and time."""

    def __init__(self, lost: dict[str, FailedRun]) -> None:
        reasons = "; ".join(f"recording `{name}`: {loss.reason}" for name, loss in lost.items())
        super().__init__(f"the model cannot reach the data from this start: {reasons}")
        self.lost = lost


class Fit(NamedTuple):
    """Where a fit ended: coordinates x (n,), chi2 (sum of squared residuals over their number), evaluations, and whether
    it converged."""

    x: Array
    chi2: float
    evaluations: int
    converged: bool


def gauss_newton(
    problem: Problem, runner: Runner, x: Array, *, which: Sequence[str], free: NDArray[np.bool_], step: float,
    evaluations: int = 30, tolerance: float = 1e-6, loss: Loss = "linear", notify: Notify = lambda chi2: None,
) -> Fit:  # fmt: skip
    """`scipy.optimize.least_squares` (trust-region reflective, bounded, robust `loss`) on the coordinates that are `free`.

    `tolerance` is relative, on the misfit and on the coordinates. A trial that cannot be simulated shortens the step.
    Raises `Unreachable` where the start cannot be simulated.
    """
    low, high = problem.coordinates.bounds
    gap = 1e-9 * (high - low)
    begin = np.clip(x, low + gap, high - gap)
    latest: dict[bytes, Residuals] = {}

    def at(z: Array) -> Residuals:
        key = z.tobytes()
        if key not in latest:
            trial = begin.copy()
            trial[free] += z
            latest.clear()
            latest[key] = problem.residuals(runner, trial, which, step, free)
            notify(float(np.mean(latest[key].r ** 2)))
        return latest[key]

    zero = np.zeros(int(free.sum()))
    if (first := at(zero)).lost:
        raise Unreachable(first.lost)
    solve: Any = least_squares
    out = solve(
        lambda z: at(z).r, zero, jac=lambda z: at(z).J[:, free], bounds=(low[free] - begin[free], high[free] - begin[free]),
        loss=loss, max_nfev=evaluations, ftol=tolerance, xtol=tolerance, gtol=1e-12,
    )  # fmt: skip
    end = begin.copy()
    end[free] += out.x
    return Fit(end, float(np.mean(out.fun**2)), int(out.nfev), out.status > 0)


def polish(
    problem: Problem, runner: Runner, x: Array, J: Array, *, which: Sequence[str], free: NDArray[np.bool_], step: float,
    rounds: int = 5, notify: Notify = lambda chi2: None,
) -> tuple[Fit, Residuals]:  # fmt: skip
    """From a fit at a coarse step to the one at a finer `step` [s]: residuals of the finer runs, and the coarse Jacobian J
    (m, n), a chord method, until the coordinates move by less than a fifth of a standard deviation. A round costs a run, not
    a Jacobian. Returns where that ended, and the residuals there, with J. Failed runs end it where it began.
    """
    low, high = problem.coordinates.bounds
    sd = standard_deviations(J[:, free])
    at, count, converged = problem.residuals(runner, x, which, step), 1, False
    while count <= rounds and not at.lost:
        notify(float(np.mean(at.r**2)))
        move, trial = np.linalg.lstsq(J[:, free], -at.r, rcond=None)[0], x.copy()
        trial[free] = np.clip(x[free] + move, low[free], high[free])
        there, count = problem.residuals(runner, trial, which, step), count + 1
        if there.lost or there.r @ there.r > at.r @ at.r:
            break
        x, at = trial, there
        converged = bool((np.abs(move) < 0.2 * sd).all())
        if converged:
            break
    return Fit(x, float(np.mean(at.r**2)), count, converged), Residuals(at.r, J, at.lost)


def descend(
    problem: Problem, runner: Runner, x: Array, *, which: Sequence[str], free: NDArray[np.bool_], step: float,
    method: Literal["lbfgs", "adam"] = "lbfgs", evaluations: int = 100, rate: float = 0.05,
    notify: Notify = lambda chi2: None,
) -> Fit:  # fmt: skip
    """torch's LBFGS (strong Wolfe) or Adam (learning `rate`) on the misfit, bounds kept by a sigmoid; the best point visited.

    For many unknowns: a gradient costs less than one run more, however many there are. For a handful `gauss_newton` needs far
    fewer runs. Raises `Unreachable` where the start cannot be simulated.
    """
    low, high = (torch.from_numpy(b) for b in problem.coordinates.bounds)
    mask, fraction = torch.from_numpy(free), (torch.from_numpy(x) - low) / (high - low)
    z = torch.logit(fraction[mask].clamp(1e-6, 1 - 1e-6)).requires_grad_(True)
    samples, best, count = problem.samples(which), (np.inf, x), 0

    def coordinates() -> torch.Tensor:
        return torch.from_numpy(x).masked_scatter(mask, low[mask] + (high - low)[mask] * torch.sigmoid(z))

    def closure() -> float:
        nonlocal best, count
        now = coordinates()
        value, gradient, lost = problem.misfit(runner, now.detach().numpy(), which, step, free)
        if lost and count == 0:
            raise Unreachable(lost)
        count += 1
        if value < best[0]:
            best = (value, now.detach().numpy().copy())
        slope = torch.from_numpy(np.nan_to_num(gradient)) / samples
        (z.grad,) = torch.autograd.grad(now, z, slope)
        notify(2 * value / samples)
        return value / samples if np.isfinite(value) else 1e9

    if method == "lbfgs":
        optimiser: Any = torch.optim.LBFGS(
            [z], max_iter=evaluations, max_eval=evaluations, line_search_fn="strong_wolfe", tolerance_change=1e-12,
            tolerance_grad=1e-9, history_size=20,
        )  # fmt: skip
        optimiser.step(closure)
    else:
        optimiser = torch.optim.Adam([z], lr=rate)
        for _ in range(evaluations):
            optimiser.step(closure)
    return Fit(best[1], 2 * best[0] / samples, count, count < evaluations)
