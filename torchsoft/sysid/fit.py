"""Least squares on frozen steps: Gauss-Newton with exact sensitivities, descent with the adjoint,
covariance and robust losses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear, minimize

from torchsoft.plan.search import ProjectedAdam
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.problem import Problem, Residuals, StepsByName
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import Runner


def fisher(J: Array) -> tuple[Array, Array, Array]:
    """Covariance (n, n) of the coordinates, eigenvalues (n,) and eigenvectors (n, n) of the Fisher
    matrix of a whitened Jacobian J (m, n). Directions without information get a very large
    variance, not an infinite one."""
    values, vectors = np.linalg.eigh(J.T @ J)
    floor = np.maximum(values, 1e-12 * max(values.max(initial=0.0), 1e-300))
    return (vectors / floor) @ vectors.T, values, vectors


def standard_deviations(J: Array) -> Array:
    """Cramer-Rao bound: standard deviations (n,) of the coordinates for a whitened Jacobian (m, n);
    huge without information."""
    return np.sqrt(np.diag(fisher(J)[0]))


def shift(J: Array, difference: Array) -> Array:
    """Shift (n,) of the coordinates of a least-squares fit from those of a finer model;
    `difference` (m,) is the residuals of the finer model at the fit less those of the fit."""
    return np.asarray(np.linalg.lstsq(J, difference, rcond=None)[0], np.float64)


CLOSER = 3.0
"""Least ratio of each parameter's standard deviation to that of a combination that is reported."""

AS_GOOD = 1.3
"""Largest growth of a combination's standard deviation by rounding its exponents."""

MINE = 0.7
"""Correlation of a parameter with a direction above which it takes part in that direction."""

EXPONENTS = {1.0: 0.1, 0.5: 0.1, 0.1: 0.2, 0.05: 0.2}
"""Units to which exponents are rounded, the coarsest first, and the fraction of its parameters'
least standard deviation that a combination may always have."""


@dataclass(frozen=True)
class Combination:
    """A product of powers of parameters that the data determine better than each of its factors:
    exponents and standard deviations of the parameters by label, and the standard deviation of the
    product, all relative."""

    exponents: dict[str, float]
    sds: dict[str, float]
    sd: float

    @property
    def formula(self) -> str:
        """The product as text, such as `contact.K_n / contact.R_n` or `pad.E * contact.K_n^0.4`."""
        powers = {name: "" if abs(p) == 1 else f"^{abs(p):g}" for name, p in self.exponents.items()}
        above = [name + powers[name] for name, p in self.exponents.items() if p > 0]
        below = [name + powers[name] for name, p in self.exponents.items() if p < 0]
        return " * ".join(above) + "".join(f" / {one}" for one in below)

    @property
    def sentence(self) -> str:
        each = ", ".join(f"{name} {percent(sd)}" for name, sd in self.sds.items())
        return f"only {self.formula} is determined ({percent(self.sd)}), not each ({each})"


def percent(sd: float) -> str:
    """A relative standard deviation in words."""
    return "not at all" if sd >= 10 else f"{100 * sd:.2g} %"


def combinations(labels: Sequence[str], C: Array, blurred: float) -> list[Combination]:
    """Identifiable combinations of parameters that are not identifiable themselves: for every
    direction with a standard deviation above `blurred`, the best determined product of powers of
    the participating parameters.

    C (n, n) is the covariance of the logarithms of the parameters `labels`, marginal over all else
    that was fitted. A direction whose product is not `CLOSER` times better determined than each of
    its factors is left out: its parameters leave no trace in the data.
    """
    values, vectors = np.linalg.eigh(C)
    out: list[Combination] = []
    for k in np.argsort(values)[::-1]:
        part = np.flatnonzero(np.abs(vectors[:, k]) * np.sqrt(values[k] / np.diag(C)) > MINE)
        if values[k] < blurred**2 or len(part) < 2:
            continue
        own = C[np.ix_(part, part)]
        exponents = rounded(np.linalg.eigh(own)[1][:, 0], own)
        sd, sds = float(np.sqrt(exponents @ own @ exponents)), np.sqrt(np.diag(own))
        used, names = exponents != 0, [labels[int(i)] for i in part]
        found = Combination(
            {name: float(p) for name, p in zip(names, exponents) if p},
            {name: float(s) for name, s, p in zip(names, sds, exponents) if p},
            sd,
        )
        if (
            used.sum() > 1
            and CLOSER * sd < (sds * np.abs(exponents))[used].min()
            and found not in out
        ):
            out.append(found)
    return out


def rounded(direction: Array, C: Array) -> Array:
    """A direction (n,) with largest component 1, and the others rounded as far as the variance in C
    (n, n) allows."""
    exact = direction / direction[np.argmax(np.abs(direction))]
    own, least = float(exact @ C @ exact), float(np.diag(C).min())
    for part, small in EXPONENTS.items():
        p = np.round(part * np.round(exact / part), 3)
        if float(p @ C @ p) <= max(AS_GOOD**2 * own, small**2 * least):
            return p
    return np.round(exact, 3)


# Robust losses and their covariance


Loss = Literal["linear", "soft_l1", "huber", "cauchy", "arctan"]

REACH: dict[Loss, float] = {
    "linear": 1.0,
    "soft_l1": 1.287,
    "huber": 1.345,
    "cauchy": 2.385,
    "arctan": 2.571,
}
"""Tuning constant c of every loss, at which it has the `EFFICIENCY` under Gaussian noise."""

EFFICIENCY = 0.95
"""Variance of the least-squares estimate over that of the robust one, under Gaussian noise."""


def rho(loss: Loss, z: Array) -> Array:
    """rho, rho' and rho'' (3, m) at z (m,), the squares of residuals over c."""
    one, zero = np.ones_like(z), np.zeros_like(z)
    match loss:
        case "linear":
            return np.stack((z, one, zero))
        case "soft_l1":
            root = np.sqrt(1 + z)
            return np.stack((2 * (root - 1), 1 / root, -0.5 / root**3))
        case "huber":
            root, near = np.sqrt(np.maximum(z, 1.0)), z <= 1
            return np.stack(
                (np.where(near, z, 2 * root - 1), 1 / root, np.where(near, 0.0, -0.5 / root**3))
            )
        case "cauchy":
            return np.stack((np.log1p(z), 1 / (1 + z), -1 / (1 + z) ** 2))
        case "arctan":
            return np.stack((np.arctan(z), 1 / (1 + z**2), -2 * z / (1 + z**2) ** 2))


def robust_loss_except_priors(loss: Loss, priors: int) -> Callable[[Array], Array]:
    """The loss in the form of `least_squares`, linear in the last `priors` rows; its `f_scale` is
    `REACH[loss]`."""

    def rows(z: Array) -> Array:
        data = len(z) - priors
        return np.concatenate((rho(loss, z[:data]), rho("linear", z[data:])), axis=1)

    return rows


def covariance(
    J: Array, r: Array, loss: Loss, priors: int = 0, exact: NDArray[np.int_] | None = None
) -> Array:
    """Sandwich covariance (n, n) of the coordinates at the end of a robust fit: J (m, n) and
    residuals r (m,) there, of which the last `priors` rows are priors.

    With psi = rho' r, A = E[psi'] J'J and B = E[psi^2] J'J, both with the priors' own J'J, it is
    A^-1 B A^-1. Expectations are means over the residuals, that of psi^2 over the degrees of
    freedom; where some samples are saturated, over the residuals `exact` (k,) only. They are not
    taken below their values under the stated Gaussian noise, 1 over the loss's efficiency. Raises
    `ValueError` where most residuals are outliers.
    """
    m, n = len(r) - priors, J.shape[1]
    own = r[:m] if exact is None else r[exact]
    z = (own / REACH[loss]) ** 2
    _, first, second = rho(loss, z)
    slope, power = (
        float(np.mean(first + 2 * z * second)),
        float(np.sum((first * own) ** 2)) / max(len(own) - n, 1),
    )
    if slope <= 0:
        raise ValueError(
            f"the loss `{loss}` holds on to nothing: most residuals count as outliers; state more "
            "noise, or take another loss"
        )
    inverse, _, _ = fisher(np.concatenate((slope**0.5 * J[:m], J[m:])))
    least = slope**2 / (1.0 if loss == "linear" else EFFICIENCY)
    return inverse @ (max(power, least) * J[:m].T @ J[:m] + J[m:].T @ J[m:]) @ inverse


# Gauss-Newton and gradient descent


Notify = Callable[[float], None]

SETTLED = 0.2
"""Largest remaining move of a coordinate, in standard deviations, at which a fit has ended."""


HEADWAY, LITTLE, FAR_OFF = 6, 0.01, 25.0
"""Number of evaluations over which chi2 must fall by more than a part for a fit to go on, that
part, and the chi2 up to which any fall counts."""


class Unreachable(RuntimeError):
    """The model cannot follow a recording at the start of a fit; `failed` has reason and time by
    recording, `findings` the doubts about the recordings themselves."""

    def __init__(self, failed: dict[str, FailedRun], findings: Sequence[str] = ()) -> None:
        reasons = "; ".join(f"recording `{name}`: {loss.reason}" for name, loss in failed.items())
        behind = f"; what may be behind it: {'; '.join(findings)}" if findings else ""
        super().__init__(f"the model cannot reach the data from this start: {reasons}{behind}")
        self.failed, self.findings = failed, tuple(findings)


class Fit(NamedTuple):
    """End of a fit on `steps`: coordinates x (n,), chi2 (mean squared residual), evaluations,
    convergence, the residuals there with their Jacobian, and whether it was `stalled`, far above
    the noise."""

    x: Array
    chi2: float
    evaluations: int
    converged: bool
    steps: StepsByName
    at: Residuals
    stalled: bool = False

    @property
    def notices(self) -> list[str]:
        """A sentence on a fit that was stalled."""
        if not self.stalled:
            return []
        return [
            f"the fit made no headway: over {HEADWAY} evaluations chi2 fell by less than "
            f"{LITTLE:.0%}, to {self.chi2:.3g}, which is far above the noise, and there it ended: "
            "the model lacks something that these data show"
        ]


class Stalled(Exception):
    """A fit makes no headway."""


def no_headway(chi2: Sequence[float]) -> bool:
    """Whether chi2 by evaluation has fallen by too little, and is still far above the noise."""
    best = np.minimum.accumulate(chi2)
    return (
        len(best) > HEADWAY
        and best[-1] > FAR_OFF
        and bool(best[-1] > (1 - LITTLE) * best[-1 - HEADWAY])
    )


def gauss_newton(
    problem: Problem, runner: Runner, x: Array, *, which: Sequence[str], free: NDArray[np.bool_],
    steps: StepsByName, evaluations: int = 30, tolerance: float = 1e-6, loss: Loss = "linear",
    notify: Notify = lambda chi2: None, first: Residuals | None = None,
) -> Fit:  # fmt: skip
    """`scipy.optimize.least_squares` (trust-region reflective, bounded, robust `loss` but for
    priors) on the coordinates that are `free`.

    `tolerance` is relative, on the misfit and on the coordinates. A trial that cannot be simulated
    shortens the step. With the linear loss a fit that makes no headway far above the noise ends
    early, as `Fit.stalled`. `first` holds residuals and Jacobian at x, if they are known. Raises
    `Unreachable` where the start cannot be simulated.
    """
    low, high = problem.coordinates.bounds
    gap = 1e-9 * (high - low)
    begin = np.clip(x, low + gap, high - gap)
    zero = np.zeros(int(free.sum()))
    seen = (
        {zero.tobytes(): first} if first is not None and (begin == x).all() else {}
    )  # the best and the latest
    chi2 = [float(np.mean(one.r**2)) for one in seen.values()]

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
            chi2.append(float(np.mean(seen[key].r ** 2)))
            notify(chi2[-1])
            if loss == "linear" and no_headway(chi2):
                raise Stalled
        return seen[key]

    if failed := at(zero).failed:
        raise Unreachable(failed)
    solve: Any = least_squares
    try:
        out = solve(
            lambda z: at(z).r, zero, jac=lambda z: at(z).J[:, free],
            bounds=(low[free] - begin[free], high[free] - begin[free]),
            loss=robust_loss_except_priors(loss, len(problem.coordinates.priors)),
            f_scale=REACH[loss], max_nfev=evaluations, ftol=tolerance, xtol=tolerance,
            gtol=1e-12,
        )  # fmt: skip
    except Stalled:
        key = min(seen, key=lambda k: float(seen[k].r @ seen[k].r))
        x = moved(np.frombuffer(key))
        return Fit(x, min(chi2), len(chi2), False, steps, seen[key], stalled=True)
    return Fit(
        moved(out.x), float(np.mean(out.fun**2)), int(out.nfev), out.status > 0, steps, at(out.x)
    )


def chord(
    problem: Problem, runner: Runner, x: Array, at: Residuals, *, which: Sequence[str],
    free: NDArray[np.bool_], steps: StepsByName, rounds: int = 5,
    notify: Notify = lambda chi2: None,
) -> Fit:  # fmt: skip
    """Chord iteration from a fit on other steps to the fit on `steps`: `at` holds the residuals at
    x on these steps, and the Jacobian on the others, which is kept. A round costs a run, not a
    Jacobian. It ends where every coordinate would move by less than `SETTLED` standard deviations,
    a run fails, or the misfit grows."""
    count = 0
    while not (converged := settled(problem, x, at, free)) and count < rounds:
        trial = x.copy()
        trial[free] = x[free] + newton_step(problem, x, at, free)
        there, count = problem.residuals(runner, trial, which, steps), count + 1
        if there.failed or there.r @ there.r > at.r @ at.r:
            break
        x, at = trial, there._replace(J=at.J)
        notify(float(np.mean(at.r**2)))
    return Fit(x, float(np.mean(at.r**2)), count, converged, steps, at)


def newton_step(problem: Problem, x: Array, at: Residuals, free: NDArray[np.bool_]) -> Array:
    """Gauss-Newton step of the free coordinates at x: the linear least squares within their bounds.
    Clipping the free step would not do, since a coordinate at its bound changes the step of the
    others."""
    low, high = (bound[free] - x[free] for bound in problem.coordinates.bounds)
    step = -shift(at.J[:, free], at.r)
    if ((low <= step) & (step <= high)).all():
        return step
    Q, R = np.linalg.qr(at.J[:, free])
    return np.asarray(lsq_linear(R, -Q.T @ at.r, (np.minimum(low, 0.0), np.maximum(high, 0.0))).x)


def settled(problem: Problem, x: Array, at: Residuals, free: NDArray[np.bool_]) -> bool:
    """Whether the Gauss-Newton step is below `SETTLED` standard deviations for all free
    coordinates."""
    return bool(
        (
            np.abs(newton_step(problem, x, at, free))
            <= SETTLED * standard_deviations(at.J[:, free])
        ).all()
    )


def descend(
    problem: Problem, runner: Runner, x: Array, *, which: Sequence[str], free: NDArray[np.bool_],
    steps: StepsByName, method: Literal["lbfgs", "adam"] = "lbfgs", evaluations: int = 100,
    rate: float = 0.05, notify: Notify = lambda chi2: None,
) -> Fit:  # fmt: skip
    """scipy's L-BFGS-B, or Adam (learning `rate`) projected on the bounds, on the misfit; the best
    point visited.

    For many unknowns: a gradient costs less than one run more, however many there are. For a
    handful `gauss_newton` needs far fewer runs. Raises `Unreachable` where the start cannot be
    simulated.
    """
    low, high = (bound[free] for bound in problem.coordinates.bounds)
    samples, best, count = problem.samples(which), (np.inf, x), 0

    def slope(z: Array) -> tuple[float, Array]:
        nonlocal best, count
        now = x.copy()
        now[free] = z
        value, gradient, failed = problem.misfit(runner, now, which, steps, free)
        if failed and count == 0:
            raise Unreachable(failed)
        count += 1
        if value < best[0]:
            best = value, now
        notify(2 * value / samples)
        return min(value / samples, 1e9), np.nan_to_num(gradient)[free] / samples

    start = np.clip(x[free], low, high)
    if method == "lbfgs":
        options = {"maxfun": evaluations, "maxcor": 20, "ftol": 1e-12, "gtol": 1e-9}
        bounds = list(zip(low, high))
        minimize(slope, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    else:
        adam = ProjectedAdam(start, lambda z: np.clip(z, low, high), (0.9, 0.999))
        for _ in range(evaluations):
            adam.step(slope(adam.z)[1], rate)
    at = problem.residuals(runner, best[1], which, steps, free)
    return Fit(best[1], 2 * best[0] / samples, count, count < evaluations, steps, at)
