"""Comparison of competing laws: fits of each to the recordings, and the evidence for the rule of
`comparison`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from scipy.sparse.linalg import spsolve_triangular

from torchsoft.sysid.comparison import Comparison, LawFit, Versus, judged
from torchsoft.sysid.fit import Fit, Unreachable, gauss_newton
from torchsoft.sysid.identification import RTOL
from torchsoft.sysid.noise import Autoregression, fit_noise, log_det
from torchsoft.sysid.plan import FINER, Stage, default_plan, run_plan
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.residual_tests import (
    Part,
    allow_for_colour,
    judge_residuals,
    parts,
    residual_notices,
)
from torchsoft.sysid.runs import Runner

COLOUR = 3
"""Largest order of the autoregression that gives the variance of a likelihood ratio its
correlation."""


class Density(NamedTuple):
    """Predictive density of some recordings under a law: whitened residuals r (m,), s = S^-1 r with
    S = 1 + J C J' the covariance of the prediction in units of the noise, and the logarithm of the
    samples' density in SI units."""

    parts: list[Part]
    r: Array
    s: Array
    log: float

    @property
    def p(self) -> float:
        """p-value of the weighted sum of squared residuals."""
        return float(stats.chi2.sf(self.r @ self.s, self.samples))

    @property
    def samples(self) -> int:
        """Number of samples that saturation has not changed."""
        return sum(len(part.t) for part in self.parts)


def density(
    problem: Problem, which: Sequence[str], r: Array, spread: Array | None = None
) -> Density:
    """Density of whitened residuals r (m,), with the uncertainty of the estimates in `spread` (m,
    n) = J C^(1/2)."""
    mine, s, wider = parts(problem, r, which), r, 0.0
    if spread is not None:
        inner = np.eye(spread.shape[1]) + spread.T @ spread
        s, wider = (
            r - spread @ np.linalg.solve(inner, spread.T @ r),
            float(np.linalg.slogdet(inner)[1]),
        )
    log = -0.5 * (float(r @ s) + wider)
    for one in mine:
        log -= len(one.t) * np.log(problem.sensors[one.channel].sd * (2 * np.pi) ** 0.5)
        if one.noise is not None:
            log -= 0.5 * log_det(one.noise.whitener(one.t))
    return Density(mine, r, s, float(log))


class FittedLaw(NamedTuple):
    """A fitted law: final coordinates x (n,), mask `free` (n,) of the fitted ones, tolerance, and
    convergence. The problem includes the estimated noise."""

    name: str
    problem: Problem
    x: Array
    free: NDArray[np.bool_]
    rtol: float
    converged: bool


class Evidence:
    """A fitted law's densities of the fitted recordings `which` and of the held-out ones.

    They come from runs with a tenth of the fit's tolerance; `numerical` is the change that this
    makes. Raises `ValueError` where a run fails.
    """

    def __init__(
        self, law: FittedLaw, runner: Runner, which: Sequence[str], heldout: Sequence[str]
    ) -> None:
        self.law, self.name, self.which, self._runner = law, law.name, list(which), runner
        problem, free = law.problem, law.free
        self.parameters = int(free.sum()) + sum(one.order + 1 for one in problem.noise.values())
        m = problem.samples(which)
        usual = self._at(which, law.rtol, False).r[:m]
        r, J, _ = self._at(which, FINER * law.rtol, True)
        self.fitted = density(problem, which, r[:m])
        self.verdicts = judge_residuals(self.fitted.parts, r, J[:, free])
        self.numerical = abs(0.5 * float(usual @ usual - self.fitted.r @ self.fitted.r))
        self.dof, self.heldout = max(self.fitted.samples - int(free.sum()), 1), None
        if heldout:
            low, high = (bound[free] for bound in problem.coordinates.bounds)
            F = J[:, free].T @ J[:, free] + np.diag(
                12 / (high - low) ** 2
            )  # what is unknown is between its bounds
            m = problem.samples(heldout)
            r, J, _ = self._at(heldout, FINER * law.rtol, True)
            spread = np.linalg.solve(np.linalg.cholesky(F), J[:m, free].T).T
            self.heldout = density(problem, heldout, r[:m], np.asarray(spread, np.float64))

    def _at(self, which: Sequence[str], rtol: float, derivatives: bool) -> Residuals:
        """Residuals at the estimates, and their Jacobian with `derivatives`."""
        at = self.law.problem.residuals(
            self._runner, self.law.x, which, rtol, self.law.free if derivatives else None
        )
        if at.lost:
            raise ValueError(
                f"the law `{self.name}` cannot be run at its estimates: {Unreachable(at.lost)}"
            )
        return at

    @property
    def total(self) -> float:
        """Logarithm of the density of all recordings, less Schwarz's penalty."""
        penalty = 0.5 * self.parameters * np.log(len(self.fitted.r))
        return (
            self.fitted.log
            + (self.heldout.log if self.heldout is not None else 0.0)
            - float(penalty)
        )


class Ratio(NamedTuple):
    """Log likelihood ratio, its variance under the stated noise, and its variance with the size and
    colour of the residuals."""

    log: float
    stated: float
    variance: float

    @property
    def inflation(self) -> float:
        return self.variance / self.stated if self.stated > 0 else 1.0

    @property
    def z(self) -> float:
        return self.log / self.variance**0.5 if self.variance > 0 else 0.0


def ratio(a: Density, b: Density) -> Ratio:
    """Likelihood ratio of two laws, with its variance under noise about the prediction of the
    first.

    The logarithm changes with the samples by the difference of the scores. Its variance is computed
    for the noise as stated, and for noise with the size and the colour of the first law's
    residuals, modelled as an autoregression of estimated order. The larger variance counts.
    """
    stated = variance = 0.0
    for mine, its in zip(a.parts, b.parts):
        score = b.s[its.rows] - a.s[mine.rows]
        if mine.noise != its.noise:
            theirs = (
                b.s[its.rows] if its.noise is None else its.noise.whitener(its.t).T @ b.s[its.rows]
            )
            score = coloured(theirs, mine.noise, mine.t) - a.s[mine.rows]
        left = fit_noise([(mine.t, a.r[mine.rows])], most=COLOUR).noise
        stated += float(score @ score)
        variance += float(np.sum(coloured(score, left, mine.t) ** 2))
    return Ratio(a.log - b.log, stated, max(stated, variance))


def coloured(score: Array, noise: Autoregression | None, t: Array) -> Array:
    """W'^-1 score (m,) for samples at t (m,) [s], with the whitener W of the noise; its squared
    norm is the variance of score' noise."""
    if noise is None:
        return score
    return spsolve_triangular(noise.whitener(t).T.tocsr(), score, lower=False)


# Competing laws, each with its own unknowns


SAME = 1e-6
"""Relative difference below which signals of two references are equal."""

CLOSE = 1e-3
"""Relative tolerance of the last fits, on the misfit and on the coordinates."""


def compare(
    laws: Mapping[str, Problem], *, heldout: Sequence[str] = (),
    plans: Mapping[str, Sequence[Stage]] | None = None, rtol: float = RTOL, starts: int = 1,
    workers: int = 1, checkpoint: str | Path | None = None,
    progress: bool = False,
) -> Comparison:  # fmt: skip
    """Fit every law to the same recordings, and say which one made them, or that the data cannot
    tell: `Comparison.verdict`, by the rule of `torchsoft.sysid.comparison`.

    `laws` are problems by name with the same recordings and sensors, on rigs with other laws, and
    with unknowns of their own: `dataclasses.replace(recording, rig=...)` makes such a recording.
    Bounds belong to the law: one that contains another (a standard linear solid with any
    instantaneous modulus contains Kelvin and Voigt's) is never behind it by more than its penalty,
    unless its bounds keep it away from the other. Noise is what the sensors state: where one
    declares its `colour` it is found for every law, but no law may explain what it misses as noise
    that nobody declared.

    Recordings named in `heldout` are predicted, not fitted. `plans`, `rtol`, `starts`, `workers`
    and the folder `checkpoint` are those of `identify`. Every law but the best is fitted once more
    from where the best one ended, as far as they share coordinates, and the better end is kept: no
    law is to lose by its start.

    Raises `ValueError` for laws that were not given the same data, and for a law that cannot follow
    the data.
    """
    check_alike(laws, heldout)
    which = [name for name in next(iter(laws.values())).names if name not in heldout]
    folder = Path(checkpoint) if checkpoint is not None else None
    evidence, runners = dict[str, Evidence](), dict[str, Runner]()
    for name, problem in laws.items():
        runners[name] = Runner(
            problem.recordings, workers, folder / name if folder is not None else None
        )
        try:
            law = fitted(
                name, problem, runners[name], which, (plans or {}).get(name), rtol, starts, progress
            )
        except Unreachable as lost:
            raise ValueError(f"the law `{name}` cannot follow the recordings: {lost}") from None
        evidence[name] = Evidence(law, runners[name], which, heldout)
    best = max(evidence, key=lambda name: evidence[name].total)
    for name in (name for name in laws if name != best):
        other = refitted(evidence[name].law, evidence[best].law, runners[name], which)
        if other is not None:
            better = Evidence(other, runners[name], which, heldout)
            if better.fitted.log > evidence[name].fitted.log:
                evidence[name] = better
    first = max(evidence.values(), key=lambda one: one.total)
    against = [versus(first, one) for one in evidence.values() if one is not first]
    law_list = sorted(law_fits(evidence), key=lambda one: -evidence[one.name].total)
    samples = len(first.fitted.r)
    return Comparison(*judged(law_list, against), law_list, against, samples, list(heldout))


def check_alike(laws: Mapping[str, Problem], heldout: Sequence[str]) -> None:
    """Raises `ValueError` where the laws have different data."""
    if len(laws) < 2:
        raise ValueError(f"a comparison needs two laws or more, not {len(laws)}")
    (first, one), *others = laws.items()
    if set(heldout) - set(one.names) or not set(one.names) - set(heldout):
        raise ValueError(
            f"`heldout` must name some of {list(one.names)}, but not all; it is {list(heldout)}"
        )
    for name, other in others:
        both = f"the laws `{first}` and `{name}`"
        if one.names != other.names:
            raise ValueError(
                f"{both} have other recordings: {', '.join(one.names)} and {', '.join(other.names)}"
            )
        if one.sensors != other.sensors:
            raise ValueError(
                f"{both} have other sensors, so that their likelihoods are of other data"
            )
        for mine, its in zip(one.recordings, other.recordings):
            a, b = mine.samples, its.samples
            if a.keys() != b.keys() or not all(
                np.array_equal(a[c][i], b[c][i]) for c in a for i in (0, 1)
            ):
                raise ValueError(f"recording `{mine.name}` of {both} has other samples")
            if not same_reference(mine, its):
                raise ValueError(
                    f"the rigs of {both} follow another reference in recording `{mine.name}`"
                )


def same_reference(one: Recording, other: Recording) -> bool:
    """Whether the signals that both rigs have are equal."""
    t = torch.from_numpy(one.times)
    a, b = (
        dict(zip(r.rig.signals, r.rig.follow(t).detach()[..., 0].unbind(-1))) for r in (one, other)
    )
    return all(
        float((a[k] - b[k]).abs().max()) <= SAME * float(a[k].abs().max())
        for k in a.keys() & b.keys()
    )


def fitted(
    name: str, problem: Problem, runner: Runner, which: Sequence[str], plan: Sequence[Stage] | None,
    rtol: float, starts: int, progress: bool,
) -> FittedLaw:  # fmt: skip
    """A law at the end of its plan, with its noise estimated where sensors declare colour. Raises
    `Unreachable`."""
    if plan is None:
        plan = default_plan(problem, runner, rtol, which, starts)
    if not plan or list(plan[-1].recordings) != list(which):
        raise ValueError(f"the last stage of the plan of `{name}` must fit {', '.join(which)}")
    end = run_plan(
        problem, runner, plan, problem.coordinates.start, label=f"{name} ", progress=progress
    )
    if end.lost is not None:  # laws are compared by the same tolerance
        raise end.lost
    fit = end.fit
    free = np.isin(problem.coordinates.labels, plan[-1].free)

    def again(one: Problem, last: Fit, number: int) -> Fit:
        return gauss_newton(
            one, runner, last.x, which=which, free=free, steps=last.steps, tolerance=CLOSE,
            first=last.at,
        )  # fmt: skip

    if any(sensor.colour == "ar" for sensor in problem.sensors.values()):
        problem, fit, *_ = allow_for_colour(problem, fit, free, which, again, undeclared=False)
    return FittedLaw(name, problem, fit.x, free, plan[-1].rtol, fit.converged)


def refitted(
    law: FittedLaw, best: FittedLaw, runner: Runner, which: Sequence[str]
) -> FittedLaw | None:
    """The law fitted once more, from the estimates of another; None where they share no coordinate,
    or the fit cannot start there."""
    c, x = law.problem.coordinates, law.x.copy()
    known = {
        label: one.to_value(v)
        for label, one, v in zip(
            best.problem.coordinates.labels, best.problem.coordinates.all, best.x
        )
    }
    for i, one in enumerate(c.all):
        if law.free[i] and one.label in known:
            x[i] = one.to_x(float(np.clip(known[one.label], one.low, one.high)))
    if (x == law.x).all():
        return None
    free = tuple(one.label for one in c.within(law.free))
    try:
        stage = Stage("again", tuple(which), free, law.rtol, tolerance=CLOSE)
        fit = run_plan(law.problem, runner, [stage], x).fit
    except Unreachable:
        return None
    return FittedLaw(law.name, law.problem, fit.x, law.free, law.rtol, fit.converged)


def versus(best: Evidence, other: Evidence) -> Versus:
    """The best law against another, by the rule of `torchsoft.sysid.comparison`."""
    fitted, n = ratio(best.fitted, other.fitted), len(best.fitted.r)
    evidence = fitted.log / fitted.inflation
    log, stated, variance, held, z = fitted.log, fitted.stated, fitted.variance, None, None
    if best.heldout is not None and other.heldout is not None:
        ahead = ratio(best.heldout, other.heldout)
        evidence, log = evidence + ahead.log / ahead.inflation, log + ahead.log
        stated, variance = stated + ahead.stated, variance + ahead.variance
        held, z = ahead.log, ahead.z
    evidence -= 0.5 * max(best.parameters - other.parameters, 0) * float(np.log(n))
    return Versus(
        best.name, other.name, fitted.log, held,
        stated**0.5, variance / stated if stated > 0 else 1.0, evidence,
        log / variance**0.5 if variance > 0 else 0.0, z,
        (best.numerical + other.numerical) / fitted.inflation,
    )  # fmt: skip


def law_fits(evidence: Mapping[str, Evidence]) -> list[LawFit]:
    """Results of every law, with its information criteria."""
    k = np.array([one.parameters for one in evidence.values()])
    n, deviance = (
        len(next(iter(evidence.values())).fitted.r),
        np.array([-2 * e.fitted.log for e in evidence.values()]),
    )
    aic, bic = deviance + 2 * k, deviance + k * np.log(n)
    aicc = aic + 2 * k * (k + 1) / np.maximum(n - k - 1, 1)
    weight = np.exp(-0.5 * (aicc - aicc.min()))
    out = []
    for i, (name, one) in enumerate(evidence.items()):
        square, held, c = (
            float(one.fitted.r @ one.fitted.r),
            one.heldout,
            one.law.problem.coordinates,
        )
        out.append(
            LawFit(
                name, int(k[i]),
                {a.label: a.to_value(x) for a, x,
                free in zip(c.all, one.law.x, one.law.free) if free}, one.fitted.log,
                square / one.dof, float(stats.chi2.sf(square, one.dof)), float(aic[i]),
                float(aicc[i]), float(bic[i]), float(weight[i] / weight.sum()),
                None if held is None else held.log / len(held.r), None if held is None else held.p,
                one.numerical, one.law.converged, residual_notices(one.verdicts),
                any(verdict.alarming and verdict.test == "motion" for verdict in one.verdicts),
            )
        )  # fmt: skip
    return out
