"""How probable recordings are under a law, and how far noise alone would move the ratio of two such probabilities."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.sparse.linalg import spsolve_triangular

from torchsoft.sysid.fit import Unreachable
from torchsoft.sysid.noise import Autoregression, fit_noise, log_det
from torchsoft.sysid.plan import FINER
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import Part, judge_residuals, parts
from torchsoft.sysid.runs import Runner

COLOUR = 3
"""Largest order of the autoregression by which residuals tell how much their colour moves a likelihood ratio."""


class Density(NamedTuple):
    """What a law says of some recordings: whitened residuals r (m,), s = S^-1 r with S = 1 + J C J' the covariance of the
    prediction in units of the noise, and the logarithm of the samples' density, in SI units."""

    parts: list[Part]
    r: Array
    s: Array
    log: float

    @property
    def p(self) -> float:
        """Of as large a sum of squares."""
        return float(stats.chi2.sf(self.r @ self.s, self.samples))

    @property
    def samples(self) -> int:
        """Those that saturation has not changed."""
        return sum(len(part.t) for part in self.parts)


def density(problem: Problem, which: Sequence[str], r: Array, spread: Array | None = None) -> Density:
    """Of whitened residuals r (m,), where the estimates are as uncertain as `spread` (m, n) = J C^(1/2) says."""
    mine, s, wider = parts(problem, r, which), r, 0.0
    if spread is not None:
        inner = np.eye(spread.shape[1]) + spread.T @ spread
        s, wider = r - spread @ np.linalg.solve(inner, spread.T @ r), float(np.linalg.slogdet(inner)[1])
    log = -0.5 * (float(r @ s) + wider)
    for one in mine:
        log -= len(one.t) * np.log(problem.sensors[one.channel].noise * (2 * np.pi) ** 0.5)
        if one.noise is not None:
            log -= 0.5 * log_det(one.noise.whitener(one.t))
    return Density(mine, r, s, float(log))


class FittedLaw(NamedTuple):
    """A law, and where its fit ended: coordinates x (n,), which of them were `free` (n,), by which tolerance, and whether it
    had converged. The problem has the noise that was found."""

    name: str
    problem: Problem
    x: Array
    free: NDArray[np.bool_]
    rtol: float
    converged: bool


class Evidence:
    """A fitted law's densities of the recordings `which` it was fitted to and of those that were held out.

    They are those of runs with a tenth of the fit's tolerance; `numerical` is what that changes. Raises `ValueError` where one
    cannot be made.
    """

    def __init__(self, law: FittedLaw, runner: Runner, which: Sequence[str], heldout: Sequence[str]) -> None:
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
            F = J[:, free].T @ J[:, free] + np.diag(12 / (high - low) ** 2)  # what is unknown is between its bounds
            m = problem.samples(heldout)
            r, J, _ = self._at(heldout, FINER * law.rtol, True)
            spread = np.linalg.solve(np.linalg.cholesky(F), J[:m, free].T).T
            self.heldout = density(problem, heldout, r[:m], np.asarray(spread, np.float64))

    def _at(self, which: Sequence[str], rtol: float, derivatives: bool) -> Residuals:
        """Residuals, and their Jacobian if wanted."""
        at = self.law.problem.residuals(self._runner, self.law.x, which, rtol, self.law.free if derivatives else None)
        if at.lost:
            raise ValueError(f"the law `{self.name}` cannot be run at its estimates: {Unreachable(at.lost)}")
        return at

    @property
    def total(self) -> float:
        """Logarithm of the density of everything, less Schwarz's penalty."""
        penalty = 0.5 * self.parameters * np.log(len(self.fitted.r))
        return self.fitted.log + (self.heldout.log if self.heldout is not None else 0.0) - float(penalty)


class Ratio(NamedTuple):
    """The logarithm of a ratio of densities, its variance by the noise as stated, and as the residuals have it."""

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
    """Of two laws, by the noise about the first one.

    The logarithm changes with the samples by the difference of the scores, and its variance is what the noise gives that: as
    stated, and with the size and the colour that the residuals of the first law have besides, as an autoregression of the
    order that they choose. The larger one is taken.
    """
    stated = variance = 0.0
    for mine, its in zip(a.parts, b.parts):
        score = b.s[its.rows] - a.s[mine.rows]
        if mine.noise != its.noise:
            theirs = b.s[its.rows] if its.noise is None else its.noise.whitener(its.t).T @ b.s[its.rows]
            score = coloured(theirs, mine.noise, mine.t) - a.s[mine.rows]
        left = fit_noise([(mine.t, a.r[mine.rows])], most=COLOUR).noise
        stated += float(score @ score)
        variance += float(np.sum(coloured(score, left, mine.t) ** 2))
    return Ratio(a.log - b.log, stated, max(stated, variance))


def coloured(score: Array, noise: Autoregression | None, t: Array) -> Array:
    """W'^-1 score (m,) for samples at t (m,) [s], W being what whitens noise: its square is the variance of score' noise."""
    if noise is None:
        return score
    return spsolve_triangular(noise.whitener(t).T.tocsr(), score, lower=False)
