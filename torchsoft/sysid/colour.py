"""Coloured noise that residuals show, and fits that allow for it."""

import time as clock
from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.sparse.linalg import spsolve_triangular

from torchsoft.sysid.fit import Fit, settled
from torchsoft.sysid.noise import Autoregression, NoiseFit, fit_noise
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import FAINT, LEVEL, Part, named, parts

ROUNDS = 2
"""Most estimates of the noise: from the residuals of the fit, and from those of the fit with that
noise."""


WORSE = 4.0
"""Sum of squared residuals, over that of the fit with the noise as stated, above which undeclared
colour is a misfit of the model and no noise."""


Refit = Callable[[Problem, Fit, int], Fit]
"""The fit of a problem from the end of another, in a round."""


class Coloured(NamedTuple):
    """A problem with estimated noise, its fit, the noise by channel with the scores of every order,
    the fits on the way with their ends on the clock [s], and problem and fit `before`; `refused` is
    colour that would explain a misfit away that is larger by `worse` [1]."""

    problem: Problem
    fit: Fit
    found: dict[str, NoiseFit]
    fits: list[tuple[Fit, float]]
    before: tuple[Problem, Fit]
    refused: Mapping[str, NoiseFit] = MappingProxyType({})
    worse: float = 1.0

    @property
    def undeclared(self) -> dict[str, NoiseFit]:
        """Noise of channels whose sensors declare none."""
        sensors = self.problem.sensors
        return {name: one for name, one in self.found.items() if sensors[name].colour != "ar"}

    def grown(self, r: Array, which: Sequence[str]) -> float:
        """Sum of squares of residuals r (m,) of this problem over that before, in channels of
        undeclared colour."""
        problem, fit = self.before
        own = self.undeclared
        return misfit(self.problem, r, which, own) / max(
            misfit(problem, fit.at.r, which, own), 1e-300
        )


def allow_for_colour(
    problem: Problem,
    fit: Fit,
    free: NDArray[np.bool_],
    which: Sequence[str],
    refit: Refit,
    undeclared: bool = True,
) -> Coloured:
    """Estimate the noise from a fit's residuals in the recordings `which`, and continue the fit
    with it by `refit(problem, fit, round)`, while coordinates that are `free` (n,) move.

    Nothing changes where all noise is white. Without `undeclared`, only declared colour is
    estimated, and that of other channels stays as it is in the problem; so it does where undeclared
    colour would let the fit go to a misfit `WORSE` times as large, which no sensor makes.
    """
    before = problem, fit  # `WORSE` than this no noise may make it
    declared = [channel for channel, sensor in problem.sensors.items() if sensor.colour == "ar"]
    given = {} if undeclared else problem.noise
    found, fits = dict[str, NoiseFit](), list[tuple[Fit, float]]()
    for number in range(ROUNDS):
        now = parts(problem, fit.at.r, which)
        found = colours(now, fit.at.J[:, free], declared)
        if not undeclared:
            found = {channel: found[channel] for channel in declared if channel in found}
        if not found and not problem.noise:
            break
        problem = problem.with_noise(given | {name: one.noise for name, one in found.items()})
        at = rewhitened(problem, fit.at, now)
        fit = fit._replace(at=at, chi2=float(np.mean(at.r**2)))
        if settled(problem, fit.x, at, free):
            break
        fit = refit(problem, fit, number)
        fits.append((fit, clock.perf_counter()))
        coloured = Coloured(problem, fit, found, fits, before)
        if undeclared and (worse := coloured.grown(fit.at.r, which)) > WORSE:
            return without(coloured, worse, free, which, refit)
    return Coloured(problem, fit, found, fits, before)


def without(
    coloured: Coloured, worse: float, free: NDArray[np.bool_], which: Sequence[str], refit: Refit
) -> Coloured:
    """The fit before, with declared colour only: undeclared colour made the misfit `worse`."""
    kept = allow_for_colour(*coloured.before, free, which, refit, undeclared=False)
    return kept._replace(fits=coloured.fits + kept.fits, refused=coloured.undeclared, worse=worse)


def misfit(problem: Problem, r: Array, which: Sequence[str], channels: Collection[str]) -> float:
    """Sum of squared residuals of some channels over their stated noise; r (m,) are whitened."""
    now = parts(problem, r, which)
    return sum(float(part.raw @ part.raw) for part in now if part.channel in channels)


def spread(J: Array, C: Array, left: Sequence[Part], refused: Mapping[str, NoiseFit]) -> Array:
    """What errors of `refused` colour in some channels add to the covariance C (n, n) of a fit that
    took them for white, J (m, n): C J' K J C less its white part."""
    extra = np.zeros_like(C)
    for part in left:
        if part.channel in refused:
            own = J[part.rows]
            W = refused[part.channel].noise.whitener(part.t)
            moved = spsolve_triangular(W.T.tocsr(), own, lower=False)
            extra += moved.T @ moved - own.T @ own
    return C @ extra @ C


def rewhitened(problem: Problem, at: Residuals, now: Sequence[Part]) -> Residuals:
    """Residuals and their Jacobian, whitened with the noise of the problem in place of that of the
    parts."""
    r, J = at.r.copy(), at.J.copy()
    recordings = {recording.name: recording for recording in problem.recordings}
    for part in now:
        rows = (
            J[part.rows]
            if part.noise is None
            else spsolve_triangular(part.noise.whitener(part.t), J[part.rows])
        )
        r[part.rows] = problem.whitened(recordings[part.recording], part.channel, part.raw)
        J[part.rows] = problem.whitened(recordings[part.recording], part.channel, rows)
    return Residuals(r, J, at.failed)


def colours(parts: Sequence[Part], J: Array, declared: Sequence[str] = ()) -> dict[str, NoiseFit]:
    """Coloured noise by channel, of channels whose residuals, all recordings together, are not
    white; J (m, n) is the Jacobian.

    White noise is rejected by a likelihood-ratio test, at `LEVEL` for all channels and orders
    together; for `declared` channels by the Bayesian information criterion alone. The noise is at
    least as large as stated. That of channels with saturated samples stays white: colour of their
    residuals is a verdict, with its sentence.
    """
    Q, out = np.linalg.qr(J)[0], {}
    channels = list(dict.fromkeys(part.channel for part in parts))
    for channel in channels:
        mine = [part for part in parts if part.channel == channel]
        if any(part.saturated for part in mine):
            continue
        if float(np.mean(np.concatenate([part.raw for part in mine]) ** 2)) < FAINT**2:
            continue
        fitted = sum(float(np.sum(Q[part.rows] ** 2)) for part in mine)
        found = fit_noise([(part.t, part.raw) for part in mine], fitted)
        p, ratio = (
            found.noise.order,
            found.scores[0].deviance - found.scores[found.noise.order].deviance,
        )
        tests = len(channels) * max(len(found.scores) - 1, 1)
        if p > 0 and (channel in declared or tests * stats.chi2.sf(ratio, p) < LEVEL):
            out[channel] = found._replace(noise=found.noise.at_least(1.0))
    return out


def refusal(coloured: Coloured) -> list[str]:
    """Sentence on colour that was refused."""
    if not coloured.refused:
        return []
    return [
        f"what the fit left is coloured in {named(list(coloured.refused))}; taken for noise, that "
        f"would move the estimates to {coloured.worse:.2g} times the sum of squares, which is a "
        "misfit of the model and no noise: the estimates are those of white noise, and intervals "
        "count the misfit as if it were the sensor's"
    ]


def colour_notices(found: Mapping[str, NoiseFit], declared: Sequence[str] = ()) -> list[str]:
    """Sentences on undeclared colour, which intervals allow for."""
    names = [
        f"{channel} (order {fit.noise.order}, neighbouring samples correlate by "
        f"{correlation(fit.noise):.2f})"
        for channel, fit in found.items() if channel not in declared
    ]  # fmt: skip
    if not names:
        return []
    return [
        f"what the fit left is coloured in {named(names)}, which nobody has declared: intervals "
        "allow for it as noise, but a wrong model leaves such residuals too; where it is the "
        "sensor, declare its `colour`"
    ]


def correlation(noise: Autoregression) -> float:
    """Correlation of neighbouring samples."""
    gamma = noise.autocovariance(2)
    return float(gamma[1] / gamma[0])
