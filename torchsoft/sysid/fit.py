"""Least squares on frozen steps: Gauss-Newton with exact sensitivities, covariance, and robust
losses."""

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear

from torchsoft.sysid.noise import NoiseFit
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.problem import Problem, Residuals, StepsByName
from torchsoft.sysid.recording import Array, Mask
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sentences import Finding
from torchsoft.sysid.unknowns import Coordinate


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


Loss = Literal["linear", "soft_l1", "huber"]

REACH: dict[Loss, float] = {
    "linear": 1.0,
    "soft_l1": 1.287,
    "huber": 1.345,
}
"""Tuning constant c of every loss, at which it has the `EFFICIENCY` under Gaussian noise."""

ROUNDED = 1e-12
"""Mean slope of a loss's influence below which it is zero: every residual counts as an outlier."""

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
    if slope <= ROUNDED:
        raise ValueError(
            f"the loss `{loss}` holds on to nothing: most residuals count as outliers; state more "
            "noise, or take another loss"
        )
    inverse, _, _ = fisher(np.concatenate((slope**0.5 * J[:m], J[m:])))
    least = slope**2 / (1.0 if loss == "linear" else EFFICIENCY)
    return inverse @ (max(power, least) * J[:m].T @ J[:m] + J[m:].T @ J[m:]) @ inverse


# A fit, from its start to its end


Notify = Callable[[float], None]
"""Called with chi2 after every evaluation."""


def silent(chi2: float) -> None:
    """Notify nobody."""


SMALL_STEP = 0.2
"""Largest remaining move of a coordinate, in standard deviations, at which a fit has ended."""


HEADWAY, LITTLE, FAR_OFF = 6, 0.01, 25.0
"""Number of evaluations over which chi2 must fall by more than a part for a fit to go on, that
part, and the chi2 up to which any fall counts."""


class Unreachable(RuntimeError):
    """The model cannot follow a recording at the start of a fit; `failed` has reason and time by
    recording, `findings` what looks wrong with the recordings themselves."""

    def __init__(self, failed: dict[str, FailedRun], findings: Sequence[Finding] = ()) -> None:
        reasons = "; ".join(f"recording `{name}`: {loss.reason}" for name, loss in failed.items())
        behind = f". It may be caused by this: {' '.join(map(str, findings))}" if findings else ""
        super().__init__(f"the model cannot reach the data from this start: {reasons}{behind}")
        self.failed, self.findings = failed, tuple(findings)


@dataclass(frozen=True)
class Stage:
    """One fit: recordings, free coordinates by label, the relative tolerance that chooses its
    steps, limits of its iteration, and coordinates to set or scan before it.

    `tied` sets coordinates to values; `scanned` tries each value of a ratio with the relative
    tolerance `LOOSE`, the others held but for its denominator, and keeps the best. With `starts`
    above one, that many Sobol points within a factor `spread` of the start are fitted, and the best
    end is kept.
    """

    name: str
    recordings: tuple[str, ...]
    free: tuple[str, ...]
    rtol: float
    evaluations: int = 30
    tolerance: float = 1e-6
    tied: tuple[tuple[str, float], ...] = ()
    scanned: tuple[tuple[str, tuple[float, ...]], ...] = ()
    starts: int = 1
    spread: float = 3.0


NOTHING = Residuals(np.zeros(0), np.zeros((0, 0)), {})
"""Residuals of a fit that has not been evaluated."""


class Check(NamedTuple):
    """Check of the steps of a fit by `rtol`: residuals and Jacobian with a tenth of it, or the
    fit's own where such runs fail.

    `bias` is the shift of every coordinate (n,) by finite steps, None where it could not be
    checked; `jacobian_error` is that of `plan.JACOBIAN_ERROR`. `rough` names the coordinates that
    would move although steps do not matter, the largest move first: samples are not smooth in them.
    """

    rtol: float = float("nan")
    finer: Residuals = NOTHING
    bias: Array | None = None
    jacobian_error: float = 0.0
    rough: tuple[str, ...] = ()


class Fit(NamedTuple):
    """A fit of a problem by a `stage`: coordinates x (n,), the residuals there with their Jacobian
    and the steps of their runs, evaluations, whether it has `converged`, or is `stalled` far above
    the noise.

    `stages` are the result's entries on the fits up to this one; `failure` is the error of a stage
    that could not start at its end; `colour` is declared noise, estimated from its residuals, by
    channel; `check` is that of its steps. `variance` is the factor on the stated variance of the
    noise; `progress` whether bars are shown.
    """

    problem: Problem
    runner: Runner
    x: Array
    stage: Stage = Stage("", (), (), float("nan"))
    at: Residuals = NOTHING
    loss: Loss = "linear"
    notify: Notify = silent
    progress: bool = False
    evaluations: int = 0
    converged: bool = False
    stalled: bool = False
    stages: tuple[dict[str, Any], ...] = ()
    failure: Unreachable | None = None
    colour: Mapping[str, NoiseFit] = MappingProxyType({})
    check: Check = Check()
    variance: float = 1.0

    @property
    def which(self) -> tuple[str, ...]:
        """Names of the fitted recordings."""
        return self.stage.recordings

    @property
    def rtol(self) -> float:
        return self.stage.rtol

    @property
    def free(self) -> Mask:
        """Mask (n,) of the fitted coordinates."""
        return np.isin(self.problem.coordinates.labels, self.stage.free)

    @property
    def coordinates(self) -> list[Coordinate]:
        """The fitted coordinates."""
        return self.problem.coordinates.within(self.free)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the fitted coordinates."""
        return tuple(one.label for one in self.coordinates)

    @property
    def by_label(self) -> dict[str, float]:
        """x by label."""
        return dict(zip(self.problem.coordinates.labels, self.x.tolist()))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Bounds of the fitted coordinates."""
        low, high = self.problem.coordinates.bounds
        return low[self.free], high[self.free]

    @property
    def J(self) -> Array:
        """Jacobian (m, fitted coordinates)."""
        return self.at.J[:, self.free]

    @property
    def covariance(self) -> Array:
        """Covariance of the fitted coordinates, by the Fisher matrix."""
        return fisher(self.J)[0]

    @property
    def sd(self) -> Array:
        """Standard deviations of the fitted coordinates."""
        return standard_deviations(self.J)

    @property
    def tested(self) -> Array:
        """Residuals (m,) by which the fit is tested: those of the check of its steps, if any."""
        return self.at.r if self.check.bias is None else self.check.finer.r

    @property
    def square(self) -> float:
        """Sum of squared residuals."""
        return float(self.at.r @ self.at.r)

    @property
    def chi2(self) -> float:
        """Mean squared residual."""
        return float(np.mean(self.at.r**2))

    def by(self, rtol: float) -> "Fit":
        """The fit with another tolerance."""
        return self._replace(stage=replace(self.stage, rtol=rtol))

    def within_bounds(self, x: Array) -> Array:
        """x (n,) within the bounds, and not on them."""
        low, high = self.problem.coordinates.bounds
        gap = 1e-9 * (high - low)
        return np.clip(x, low + gap, high - gap)

    def place(self, z: Array) -> Array:
        """x (n,) with other fitted coordinates z."""
        x = self.x.copy()
        x[self.free] = z
        return x

    def values(self, z: Array) -> Array:
        """Fitted coordinates z (..., fitted coordinates) in physical units."""
        return np.stack(
            [np.vectorize(c.to_value, [float])(z[..., i]) for i, c in enumerate(self.coordinates)],
            -1,
        )

    def residuals(
        self, x: Array | None = None, steps: StepsByName | None = None, jacobian: bool = False
    ) -> Residuals:
        """Residuals at x (n,), by default the fit's, on its steps or others."""
        return self.problem.residuals(
            self.runner,
            self.x if x is None else x,
            self.which,
            self.at.steps if steps is None else steps,
            self.free if jacobian else None,
        )

    def evaluated(self, x: Array | None = None) -> "Fit":
        """The fit at x (n,), on the steps that its tolerance chooses there. Raises `Unreachable`
        where x cannot be simulated."""
        x = self.x if x is None else x
        at = self.residuals(x, self.rtol, jacobian=True)
        if at.failed:
            raise Unreachable(at.failed)
        return self._replace(x=x, at=at)

    def step_effect(self, x: Array) -> float:
        """Change of |r|^2 at x (n,) by steps chosen there, in place of the fit's; NaN where a run
        fails."""
        frozen, fresh = self.residuals(x), self.residuals(x, self.rtol)
        failed = fresh.failed or frozen.failed
        return float("nan") if failed else float(fresh.r @ fresh.r - frozen.r @ frozen.r)

    def newton_step(self) -> Array:
        """Gauss-Newton step of the fitted coordinates: the linear least squares within their
        bounds. Clipping the free step would not do, since a coordinate at its bound changes the
        step of the others."""
        low, high = (bound - self.x[self.free] for bound in self.bounds)
        J, r = self.J, self.at.r
        step = -shift(J, r)
        if ((low <= step) & (step <= high)).all():
            return step
        Q, R = np.linalg.qr(J)
        return np.asarray(lsq_linear(R, -Q.T @ r, (np.minimum(low, 0.0), np.maximum(high, 0.0))).x)

    @property
    def step_is_small(self) -> bool:
        """Whether the Gauss-Newton step is below `SMALL_STEP` standard deviations for all fitted
        coordinates."""
        return bool((np.abs(self.newton_step()) <= SMALL_STEP * self.sd).all())

    def noted(self, name: str, started: float) -> "Fit":
        """The fit with the result's entry on it, which `started` on the clock [s]."""
        entry = {
            "name": name,
            "recordings": [*self.which],
            "free": [*self.stage.free],
            "rtol": self.rtol,
            "evaluations": self.evaluations,
            "chi2": self.chi2,
            "converged": self.converged,
            "wall_s": clock.perf_counter() - started,
        }
        return self._replace(stages=(*self.stages, entry))

    @property
    def findings(self) -> list[Finding]:
        """Whether the fit stalled far above the noise, or a finer stage could not start."""
        out = list[Finding]()
        if self.stalled:
            facts = {"evaluations": HEADWAY, "part": LITTLE, "chi2": self.chi2}
            out.append(Finding("stalled", "note", facts))
        if self.failure is not None:
            facts = {"rtol": self.rtol, "reason": str(self.failure)}
            out.append(Finding("stage-failed", "note", facts))
        return out


# Gauss-Newton


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


class Trials:
    """Residuals of a fit at displacements z of its fitted coordinates, with new Jacobians; the best
    and the latest are kept. Raises `Stalled` where a fit with the linear loss makes no headway far
    above the noise."""

    def __init__(self, fit: Fit, known: bool) -> None:
        """`known` says that the fit has its residuals and Jacobian."""
        self.fit, self.chi2 = fit, list[float]()
        self.seen = dict[bytes, Residuals]()
        if known:
            self._keep(np.zeros(int(fit.free.sum())), fit.at)

    def __call__(self, z: Array) -> Residuals:
        if z.tobytes() not in self.seen:
            self._keep(z, self.fit.residuals(self.moved(z), jacobian=True))
            self.fit.notify(self.chi2[-1])
            if self.fit.loss == "linear" and no_headway(self.chi2):
                raise Stalled
        return self.seen[z.tobytes()]

    def _keep(self, z: Array, at: Residuals) -> None:
        self.seen = {key: self.seen[key] for key in [self.best] if self.seen}
        self.seen[z.tobytes()] = at
        self.chi2.append(float(np.mean(at.r**2)))

    @property
    def best(self) -> bytes:
        """Key of the trial that leaves least."""
        return min(self.seen, key=lambda k: float(self.seen[k].r @ self.seen[k].r), default=b"")

    def moved(self, z: Array) -> Array:
        """Coordinates x (n,) of the problem at a displacement."""
        return self.fit.place(self.fit.x[self.fit.free] + z)


def gauss_newton(
    fit: Fit, evaluations: int = 30, tolerance: float = 1e-6, anew: bool = False
) -> Fit:
    """`scipy.optimize.least_squares` (trust-region reflective, bounded, robust loss but for
    priors) on the steps of a fit, from its residuals and Jacobian, or from `anew` ones.

    `tolerance` is relative, on the misfit and on the coordinates. A trial that cannot be simulated
    shortens the step. With the linear loss a fit that makes no headway far above the noise ends
    early, as `Fit.stalled`. Raises `Unreachable` where the start cannot be simulated.
    """
    (low, high), free = fit.problem.coordinates.bounds, fit.free
    fit, start = fit._replace(x=fit.within_bounds(fit.x)), fit.x
    zero, solve = np.zeros(int(free.sum())), cast(Any, least_squares)
    trials = Trials(fit, bool(len(fit.at.r) and not anew and (fit.x == start).all()))
    if failed := trials(zero).failed:
        raise Unreachable(failed)
    try:
        out = solve(
            lambda z: trials(z).r,
            zero,
            jac=lambda z: trials(z).J[:, free],
            bounds=(low[free] - fit.x[free], high[free] - fit.x[free]),
            loss=robust_loss_except_priors(fit.loss, len(fit.problem.coordinates.priors)),
            f_scale=REACH[fit.loss],
            max_nfev=evaluations,
            ftol=tolerance,
            xtol=tolerance,
            gtol=1e-12,
        )
        z, count, converged, stalled = out.x, int(out.nfev), out.status > 0, False
    except Stalled:
        z, count, converged, stalled = np.frombuffer(trials.best), len(trials.chi2), False, True
    end = fit._replace(x=trials.moved(z), at=trials(z))
    return end._replace(evaluations=count, converged=converged, stalled=stalled)


def chord(fit: Fit, rounds: int = 5) -> Fit:
    """Chord iteration of a fit whose residuals are on the steps of `fit.at`, and whose Jacobian,
    which is kept, may be on others. A round costs a run, not a Jacobian. It ends where every
    coordinate would move by less than `SMALL_STEP` standard deviations, a run fails, or the misfit
    grows."""
    count = 0
    while not (converged := fit.step_is_small) and count < rounds:
        trial = fit.place(fit.x[fit.free] + fit.newton_step())
        there, count = fit.residuals(trial), count + 1
        if there.failed or there.r @ there.r > fit.at.r @ fit.at.r:
            break
        fit = fit._replace(x=trial, at=there._replace(J=fit.at.J))
        fit.notify(fit.chi2)
    return fit._replace(evaluations=count, converged=converged, stalled=False)
