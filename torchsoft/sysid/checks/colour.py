"""Colour that is found in residuals: where, of which order, and what a reader must know of it.

Residuals are coloured because a sensor is, or because the model is wrong; they cannot tell. So intervals allow for colour
either way, and where nobody has declared it (`Sensor.colour`) a sentence says so.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.sparse.linalg import spsolve_triangular

from torchsoft.sysid.checks.misfit import FAINT, LEVEL, named
from torchsoft.sysid.checks.parts import Part, parts
from torchsoft.sysid.fit.fit import Fit, settled
from torchsoft.sysid.problem.noise import Autoregression, NoiseFit, fit_noise
from torchsoft.sysid.problem.problem import Problem, Residuals
from torchsoft.sysid.problem.recording import Array

ROUNDS = 2
"""How often noise is found: in what the fit leaves, and in what the fit with that noise leaves."""


class Coloured(NamedTuple):
    """A problem with the noise that was found, its fit, the noise by channel with every order that was tried, and the fits
    on the way."""

    problem: Problem
    fit: Fit
    found: dict[str, NoiseFit]
    fits: list[Fit]


def allow_for_colour(
    problem: Problem, fit: Fit, free: NDArray[np.bool_], which: Sequence[str], refit: Callable[[Problem, Fit, int], Fit]
) -> Coloured:
    """Find the noise that a fit leaves in the recordings `which`, and fit again with it, by `refit(problem, fit, round)`, from
    there, while coordinates that are `free` (n,) move.

    The fit must have its residuals, with their Jacobian. Where all noise is white nothing is changed.
    """
    declared = [channel for channel, sensor in problem.sensors.items() if sensor.colour == "ar"]
    found, fits = dict[str, NoiseFit](), list[Fit]()
    for number in range(ROUNDS):
        assert fit.at is not None
        now = parts(problem, fit.at.r, which)
        found = colours(now, fit.at.J[:, free], declared)
        if not found and not problem.noise:
            break
        problem = problem.with_noise({channel: one.noise for channel, one in found.items()})
        at = rewhitened(problem, fit.at, now)
        fit = fit._replace(at=at, chi2=float(np.mean(at.r**2)))
        if settled(problem, fit.x, at, free):
            break
        fit = refit(problem, fit, number)
        fits.append(fit)
    return Coloured(problem, fit, found, fits)


def rewhitened(problem: Problem, at: Residuals, now: Sequence[Part]) -> Residuals:
    """Residuals and their Jacobian with the noise of the problem in place of that of the parts."""
    r, J = at.r.copy(), at.J.copy()
    recordings = {recording.name: recording for recording in problem.recordings}
    for part in now:
        rows = J[part.rows] if part.noise is None else spsolve_triangular(part.noise.whitener(part.t), J[part.rows])
        r[part.rows] = problem.whitened(recordings[part.recording], part.channel, part.raw)
        J[part.rows] = problem.whitened(recordings[part.recording], part.channel, rows)
    return Residuals(r, J, at.lost)


def colours(parts: Sequence[Part], J: Array, declared: Sequence[str] = ()) -> dict[str, NoiseFit]:
    """The noise of channels whose residuals, all recordings together, are not white, by channel; J (m, n) is the Jacobian.

    White noise is refused by the ratio of likelihoods, at `LEVEL` for all channels and orders together; that of `declared`
    channels by the Bayesian criterion alone. Noise is never taken to be less than the sensor states. That of channels with
    saturated samples stays white: what their residuals have of colour is a verdict, with its sentence.
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
        p, ratio = found.noise.order, found.scores[0].deviance - found.scores[found.noise.order].deviance
        tests = len(channels) * max(len(found.scores) - 1, 1)
        if p > 0 and (channel in declared or tests * stats.chi2.sf(ratio, p) < LEVEL):
            out[channel] = found._replace(noise=found.noise.at_least(1.0))
    return out


def colour_notices(found: Mapping[str, NoiseFit], declared: Sequence[str] = ()) -> list[str]:
    """Sentences on colour that intervals allow for although nobody has declared it."""
    names = [
        f"{channel} (order {fit.noise.order}, neighbouring samples correlate by {correlation(fit.noise):.2f})"
        for channel, fit in found.items() if channel not in declared
    ]  # fmt: skip
    if not names:
        return []
    return [
        f"what the fit left is coloured in {named(names)}, which nobody has declared: intervals allow for it as noise, but a "
        "wrong model leaves such residuals too; where it is the sensor, declare its `colour`"
    ]


def correlation(noise: Autoregression) -> float:
    """Of neighbouring samples."""
    gamma = noise.autocovariance(2)
    return float(gamma[1] / gamma[0])
