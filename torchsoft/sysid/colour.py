"""Coloured noise: declared colour enters the fit, undeclared colour widens the intervals."""

import time as clock
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats
from scipy.sparse.linalg import spsolve_triangular

from torchsoft.sysid.fit import Fit, chord
from torchsoft.sysid.noise import Autoregression, NoiseFit, fit_noise
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import FAINT, LEVEL, Part, parts
from torchsoft.sysid.sentences import Finding
from torchsoft.sysid.stages import iterated

ROUNDS = 2
"""Most estimates of the noise: from the residuals of the fit, and from those of the fit with that
noise."""


def allow_for_colour(fit: Fit) -> Fit:
    """Estimate declared colour from a fit's residuals, and continue the fit with it, on its steps,
    while its coordinates move: with a new Jacobian first, then with the last one. Nothing changes
    where no sensor declares colour."""
    declared = declared_colour(fit.problem)
    for number in range(ROUNDS if declared else 0):
        started, problem = clock.perf_counter(), fit.problem
        now = parts(problem, fit.at.r, fit.which)
        every = colours(now, fit.J, declared)
        found = {channel: every[channel] for channel in declared if channel in every}
        fit = fit._replace(colour=found)
        if not found and not problem.noise:
            break
        noise = {**problem.noise, **{name: one.noise for name, one in found.items()}}
        problem = problem.with_noise(noise)
        fit = fit._replace(problem=problem, at=rewhitened(problem, fit.at, now))
        if fit.step_is_small:
            break
        fit = chord(fit) if number > 0 and fit.loss == "linear" else iterated(fit)
        fit = fit.noted("with the noise that was found", started)
    return fit


def declared_colour(problem: Problem) -> list[str]:
    """Channels whose sensors declare colour."""
    return [channel for channel, sensor in problem.sensors.items() if sensor.colour == "ar"]


def undeclared_colour(fit: Fit) -> dict[str, NoiseFit]:
    """Colour of a fit's residuals, by channel, in channels that the fit takes for white."""
    found = colours(parts(fit.problem, fit.at.r, fit.which), fit.J)
    known = {*declared_colour(fit.problem), *fit.problem.noise}
    return {channel: one for channel, one in found.items() if channel not in known}


def spread(J: Array, C: Array, left: Sequence[Part], undeclared: Mapping[str, NoiseFit]) -> Array:
    """Addition to the covariance C (n, n) of a fit with the Jacobian J (m, n) that takes
    `undeclared` colour for white noise: C J' K J C with the covariance K of that noise, less its
    white part (the sandwich covariance)."""
    extra = np.zeros_like(C)
    for part in left:
        if part.channel in undeclared:
            own = J[part.rows]
            W = undeclared[part.channel].noise.whitener(part.t)
            moved = spsolve_triangular(W.T.tocsr(), own, lower=False)
            extra += moved.T @ moved - own.T @ own
    return C @ extra @ C


def rewhitened(problem: Problem, at: Residuals, now: Sequence[Part]) -> Residuals:
    """Residuals and their Jacobian, whitened with the noise of the problem in place of that of the
    parts."""
    r, J = at.r.copy(), at.J.copy()
    for part in now:
        r[part.rows], rows = part.raw, J[part.rows]
        J[part.rows] = (
            rows if part.noise is None else spsolve_triangular(part.noise.whitener(part.t), rows)
        )
        if (noise := problem.noise.get(part.channel)) is not None:
            W = noise.whitener(part.t)
            r[part.rows], J[part.rows] = W @ r[part.rows], W @ J[part.rows]
    return at._replace(r=r, J=J)


def colours(parts: Sequence[Part], J: Array, declared: Sequence[str] = ()) -> dict[str, NoiseFit]:
    """Coloured noise by channel, of channels whose residuals, all recordings together, are not
    white; J (m, n) is the Jacobian.

    White noise is rejected by a likelihood-ratio test, at `LEVEL` for all channels and orders
    together; for `declared` channels by the Bayesian information criterion alone. The noise is at
    least as large as stated. That of channels with saturated samples stays white: the test of
    whiteness reports colour of their residuals.
    """
    Q, out = np.linalg.qr(J)[0], {}
    channels = list(dict.fromkeys(part.channel for part in parts))
    for channel in channels:
        mine = [part for part in parts if part.channel == channel]
        every = np.concatenate([part.raw for part in mine])
        if any(part.saturated for part in mine) or float(np.mean(every**2)) < FAINT**2:
            continue
        fitted = sum(float(np.sum(Q[part.rows] ** 2)) for part in mine)
        found = fit_noise([(part.t, part.raw) for part in mine], fitted)
        p, tests = found.noise.order, len(channels) * found.orders
        chance = tests * stats.chi2.sf(found.likelihood_ratio, max(p, 1))
        if p > 0 and (channel in declared or chance < LEVEL):
            out[channel] = found._replace(noise=found.noise.at_least(1.0))
    return out


def colour_findings(undeclared: Mapping[str, NoiseFit]) -> list[Finding]:
    """A finding on undeclared colour, for which intervals allow."""
    cases = [
        {"channel": name, "order": one.noise.order, "correlation": correlation(one.noise)}
        for name, one in undeclared.items()
    ]
    return [Finding("colour", "note", {"cases": cases})] if cases else []


def correlation(noise: Autoregression) -> float:
    """Correlation of neighbouring samples."""
    gamma = noise.autocovariance(2)
    return float(gamma[1] / gamma[0])
