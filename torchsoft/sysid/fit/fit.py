"""Two ways down the same misfit: Gauss-Newton on exact sensitivities, and gradient descent on the discrete adjoint."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear

from torchsoft.sysid.fit.information import shift, standard_deviations
from torchsoft.sysid.fit.robust import REACH, Loss, spared
from torchsoft.sysid.problem.prediction import FailedRun
from torchsoft.sysid.problem.problem import Problem, Residuals, StepsByName
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.workers import Runner

Notify = Callable[[float], None]

SETTLED = 0.2
"""Part of a standard deviation by which a coordinate may still move where a fit has ended."""


class Unreachable(RuntimeError):
    """The model cannot follow a recording with the parameters that a fit starts from; `lost` has reason and time, `looks`
    what looked wrong with the recordings themselves."""

    def __init__(self, lost: dict[str, FailedRun], looks: Sequence[str] = ()) -> None:
        reasons = "; ".join(f"recording `{name}`: {loss.reason}" for name, loss in lost.items())
        behind = f"; what may be behind it: {'; '.join(looks)}" if looks else ""
        super().__init__(f"the model cannot reach the data from this start: {reasons}{behind}")
        self.lost, self.looks = lost, tuple(looks)


class Fit(NamedTuple):
    """Where a fit on `steps` ended: coordinates x (n,), chi2 (sum of squared residuals over their number), evaluations, whether
    it converged, and the residuals there with their Jacobian, if that was computed."""

    x: Array
    chi2: float
    evaluations: int
    converged: bool
    steps: StepsByName
    at: Residuals | None = None


def gauss_newton(
    problem: Problem, runner: Runner, x: Array, *, which: Sequence[str], free: NDArray[np.bool_], steps: StepsByName,
    evaluations: int = 30, tolerance: float = 1e-6, loss: Loss = "linear", notify: Notify = lambda chi2: None,
    first: Residuals | None = None,
) -> Fit:  # fmt: skip
    """`scipy.optimize.least_squares` (trust-region reflective, bounded, robust `loss` but for priors) on the coordinates that
    are `free`.

    `tolerance` is relative, on the misfit and on the coordinates. A trial that cannot be simulated shortens the step. `first`
    holds residuals and Jacobian at x, if they are known.
    Raises `Unreachable` where the start cannot be simulated.
    """
    low, high = problem.coordinates.bounds
    gap = 1e-9 * (high - low)
    begin = np.clip(x, low + gap, high - gap)
    zero = np.zeros(int(free.sum()))
    seen = {zero.tobytes(): first} if first is not None and (begin == x).all() else {}  # the best and the latest

    def moved(z: Array) -> Array:
        trial = begin.copy()
        trial[free] += z
        return trial

    def at(z: Array) -> Residuals:
        key = z.tobytes()
        if key not in seen:
            best = min(seen, key=lambda k: float(seen[k].r @ seen[k].r), default=key)
            for old in seen.keys() - {best}:
                del seen[old]
            seen[key] = problem.residuals(runner, moved(z), which, steps, free)
            notify(float(np.mean(seen[key].r ** 2)))
        return seen[key]

    if lost := at(zero).lost:
        raise Unreachable(lost)
    solve: Any = least_squares
    out = solve(
        lambda z: at(z).r, zero, jac=lambda z: at(z).J[:, free], bounds=(low[free] - begin[free], high[free] - begin[free]),
        loss=spared(loss, len(problem.coordinates.priors)), f_scale=REACH[loss], max_nfev=evaluations, ftol=tolerance,
        xtol=tolerance, gtol=1e-12,
    )  # fmt: skip
    return Fit(moved(out.x), float(np.mean(out.fun**2)), int(out.nfev), out.status > 0, steps, at(out.x))


def chord(
    problem: Problem, runner: Runner, x: Array, at: Residuals, *, which: Sequence[str], free: NDArray[np.bool_],
    steps: StepsByName, rounds: int = 5, notify: Notify = lambda chi2: None,
) -> Fit:  # fmt: skip
    """From a fit on other steps to the one on these: `at` holds the residuals at x on these steps, and the Jacobian on the
    others, which is kept; until a coordinate would move by less than `SETTLED` standard deviations. A round costs a run, not
    a Jacobian. It ends where a run fails or the misfit grows.
    """
    count = 0
    while not (converged := settled(problem, x, at, free)) and count < rounds:
        trial = x.copy()
        trial[free] = x[free] + newton_step(problem, x, at, free)
        there, count = problem.residuals(runner, trial, which, steps), count + 1
        if there.lost or there.r @ there.r > at.r @ at.r:
            break
        x, at = trial, there._replace(J=at.J)
        notify(float(np.mean(at.r**2)))
    return Fit(x, float(np.mean(at.r**2)), count, converged, steps, at)


def newton_step(problem: Problem, x: Array, at: Residuals, free: NDArray[np.bool_]) -> Array:
    """What Gauss-Newton adds to the free coordinates at x: the least squares within their bounds. To clip the free step would
    not do: what is held at a bound leaves the others where they are."""
    low, high = (bound[free] - x[free] for bound in problem.coordinates.bounds)
    step = -shift(at.J[:, free], at.r)
    if ((low <= step) & (step <= high)).all():
        return step
    Q, R = np.linalg.qr(at.J[:, free])
    return np.asarray(lsq_linear(R, -Q.T @ at.r, (np.minimum(low, 0.0), np.maximum(high, 0.0))).x)


def settled(problem: Problem, x: Array, at: Residuals, free: NDArray[np.bool_]) -> bool:
    """Whether that is less than `SETTLED` standard deviations for all of them."""
    return bool((np.abs(newton_step(problem, x, at, free)) <= SETTLED * standard_deviations(at.J[:, free])).all())


def descend(
    problem: Problem, runner: Runner, x: Array, *, which: Sequence[str], free: NDArray[np.bool_], steps: StepsByName,
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
        value, gradient, lost = problem.misfit(runner, now.detach().numpy(), which, steps, free)
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
    return Fit(best[1], 2 * best[0] / samples, count, count < evaluations, steps)
