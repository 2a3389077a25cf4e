"""Coloured noise that residuals show, and fits that allow for it."""

import time as clock
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats
from scipy.sparse.linalg import spsolve_triangular

from torchsoft.sysid.fit import Colour, Fit, chord
from torchsoft.sysid.noise import Autoregression, NoiseFit, fit_noise
from torchsoft.sysid.plan import iterated
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import FAINT, LEVEL, Part, named, parts

ROUNDS = 2
"""Most estimates of the noise: from the residuals of the fit, and from those of the fit with that
noise."""


WORSE = 4.0
"""Sum of squared residuals, over that of the fit with the noise as stated, above which undeclared
colour is a misfit of the model and no noise."""


def allow_for_colour(fit: Fit, undeclared: bool = True) -> Fit:
    """Estimate the noise from a fit's residuals, and continue the fit with it, on its steps, while
    its coordinates move: with a new Jacobian first, then with the last one.

    Nothing changes where all noise is white. Without `undeclared`, only declared colour is
    estimated, and that of other channels stays as it is in the problem; so it does where undeclared
    colour would let the fit go to a misfit `WORSE` times as large, which no sensor makes.
    """
    given = {} if undeclared else fit.problem.noise
    stated = fit.colour.stated or fit
    for number in range(ROUNDS):
        began, problem = clock.perf_counter(), fit.problem
        now, declared = parts(problem, fit.at.r, fit.which), declared_colour(problem)
        found = colours(now, fit.J, declared)
        if not undeclared:
            found = {channel: found[channel] for channel in declared if channel in found}
        fit = fit._replace(colour=Colour(found, stated))
        if not found and not problem.noise:
            break
        problem = problem.with_noise(given | {name: one.noise for name, one in found.items()})
        fit = fit._replace(problem=problem, at=rewhitened(problem, fit.at, now))
        if fit.settled:
            break
        fit = chord(fit) if number > 0 and fit.loss == "linear" else iterated(fit)
        fit = fit.noted("with the noise that was found", began)
        if undeclared and growth(fit) > WORSE:
            return without_colour(fit)
    return fit


def without_colour(fit: Fit) -> Fit:
    """The fit as it was before its noise was estimated, with declared colour only: undeclared
    colour made its misfit worse."""
    before = fit.colour.stated or fit
    before = before._replace(stages=fit.stages, stage=fit.stage, notify=fit.notify)
    kept = allow_for_colour(before, undeclared=False)
    return kept._replace(
        colour=kept.colour._replace(refused=undeclared_colour(fit), worse=growth(fit))
    )


def declared_colour(problem: Problem) -> list[str]:
    """Channels whose sensors declare colour."""
    return [channel for channel, sensor in problem.sensors.items() if sensor.colour == "ar"]


def undeclared_colour(fit: Fit) -> dict[str, NoiseFit]:
    """Noise of channels whose sensors declare none."""
    declared = declared_colour(fit.problem)
    return {channel: one for channel, one in fit.colour.found.items() if channel not in declared}


def growth(fit: Fit) -> float:
    """Sum of squared residuals, over the stated noise, in channels of undeclared colour, over that
    of the fit before its noise was estimated."""
    own = undeclared_colour(fit)

    def misfit(one: Fit) -> float:
        now = parts(one.problem, one.at.r, one.which)
        return sum(float(part.raw @ part.raw) for part in now if part.channel in own)

    return misfit(fit) / max(misfit(fit.colour.stated or fit), 1e-300)


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
    return at._replace(r=r, J=J)


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


def colour_notices(undeclared: Mapping[str, NoiseFit], colour: Colour) -> list[str]:
    """Sentences on colour that was refused, and on undeclared colour, which intervals allow for."""
    out = list[str]()
    if colour.refused:
        out.append(
            f"what the fit left is coloured in {named(list(colour.refused))}; taken for noise, "
            f"that would move the estimates to {colour.worse:.2g} times the sum of squares, which "
            "is a misfit of the model and no noise: the estimates are those of white noise, and "
            "intervals count the misfit as if it were the sensor's"
        )
    if names := [
        f"{channel} (order {one.noise.order}, neighbouring samples correlate by "
        f"{correlation(one.noise):.2f})"
        for channel, one in undeclared.items()
    ]:
        out.append(
            f"what the fit left is coloured in {named(names)}, which nobody has declared: "
            "intervals allow for it as noise, but a wrong model leaves such residuals too; where "
            "it is the sensor, declare its `colour`"
        )
    return out


def correlation(noise: Autoregression) -> float:
    """Correlation of neighbouring samples."""
    gamma = noise.autocovariance(2)
    return float(gamma[1] / gamma[0])
