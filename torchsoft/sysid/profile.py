"""Profile likelihoods: the misfit with one coordinate held and all others fitted again."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.interpolate import PchipInterpolator
from tqdm import tqdm

from torchsoft.display import hidden, suggestion
from torchsoft.parallel import parallel_map, single_threaded
from torchsoft.sysid.fit import Fit, Stage, Unreachable, gauss_newton
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.result import IdentificationResult
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sentences import Finding

CHOSEN_ANEW = 1.0
"""Largest acceptable change of |r|^2 by steps that are chosen anew, in place of those of the
optimum."""


def optimum(problem: Problem, answer: IdentificationResult, workers: int = 1) -> Fit:
    """The end of the identification of `problem`, with its estimated noise and the factor on its
    variance by which intervals were widened; for profiles and posteriors, which `workers` threads
    evaluate side by side.

    Raises `ValueError` for another problem's answer, or one of a robust loss, which is no
    likelihood, and `Unreachable` where the end cannot be simulated.
    """
    last, labels = answer.stages[-1], problem.coordinates.labels
    if [one.label for one in answer.coordinates] != list(labels):
        raise ValueError(
            "this answer belongs to another problem: it does not have the same coordinates"
        )
    if answer.made_by["loss"] != "linear":
        raise ValueError(
            f"the loss `{answer.made_by['loss']}` is no likelihood, so there is no profile and "
            "no posterior; identify with loss = 'linear'"
        )
    if answer.noise:
        problem = problem.with_noise(answer.noise)
    stage = Stage("optimum", tuple(last["recordings"]), tuple(last["free"]), last["rtol"])
    runner, variance = Runner(problem.recordings, workers), max(1.0, answer.chi2_whitened)
    return Fit(problem, runner, np.array(answer.x), stage, variance=variance).evaluated()


# Profiles


RISE = float(stats.chi2.ppf(0.95, 1))
"""2 Delta(-log posterior) at the ends of a 95 % interval."""

STRIDE = 0.5
"""Change of the square root of the rise between two points of a profile, whose end is at 1.96."""

POINTS = 12
"""Most points on either side."""

EVALUATIONS = 10
"""Most evaluations of Gauss-Newton for a point."""

BEYOND = (RISE**0.5 + STRIDE) ** 2
"""Rise above which a point is too far beyond the end of the interval to locate it."""

SHORTER = 6
"""Most reductions of the stride on either side, after a failed run or a rise that goes too far."""

FITTED = 2e-3
"""Change of |r|^2 at which the fit of the others ends."""

LOWER = 0.1
"""Fall of |r|^2 below the optimum's that shows that the fit was not at its optimum."""


@dataclass(frozen=True)
class Profile:
    """The profile of one coordinate: its values in physical units, ascending, and the `rises` of 2
    (-log posterior) at them.

    `others` holds the values of the other coordinates by label, in physical units. `ci95` has None
    for an end that was not found, and `findings` the reason; `wald95` is the interval by the
    covariance. `variance` is the divisor of the rises, above one where residuals are larger than
    the stated noise.
    """

    label: str
    best: float
    values: list[float]
    rises: list[float]
    others: dict[str, list[float]] = field(repr=False)
    ci95: tuple[float | None, float | None]
    wald95: tuple[float, float]
    variance: float
    findings: list[Finding]


class Point(NamedTuple):
    """Coordinates (n,) of a point of a profile, its rise, and the residuals with their Jacobian."""

    x: Array
    rise: float
    at: Residuals


Side = tuple[list[Point], str]
"""The optimum and the points on one side of it, outwards, and why they end before the interval
does."""


def profiles(
    optimum: Fit, labels: Sequence[str] | None = None, *, progress: bool = False
) -> list[Profile]:
    """Profiles of some coordinates, by default all free ones, from an `optimum`; all sides are
    computed side by side in its threads.

    Raises `ValueError` for a label that is not a free coordinate's.
    """
    chosen, every = list(optimum.labels if labels is None else labels), optimum.labels
    for label in chosen:
        if label not in every:
            raise ValueError(
                f"there is no free coordinate {label!r} to profile; "
                f"{suggestion(label, every, 'there are')}"
            )
    where = [optimum.problem.coordinates.labels.index(label) for label in chosen]
    tasks = [(i, sign) for i in where for sign in (-1, 1)]
    with single_threaded():
        work = parallel_map(lambda k: walk(optimum, *tasks[k]), len(tasks), optimum.runner.workers)
        done = dict(tqdm(work, desc="profiles", total=len(tasks), disable=hidden(progress)))
    return [assemble(optimum, i, done[2 * k], done[2 * k + 1]) for k, i in enumerate(where)]


def sd(o: Fit, i: int) -> float:
    """Standard deviation of coordinate i, widened like its profile."""
    return float(o.sd[o.labels.index(o.problem.coordinates.labels[i])] * o.variance**0.5)


def walk(o: Fit, i: int, sign: int) -> Side:
    """One side of the profile of coordinate i, from the optimum to the end of the interval."""
    c = o.problem.coordinates.all[i]
    low, high = (float(bound[i]) for bound in o.problem.coordinates.bounds)
    points, shorter = [Point(o.x, 0.0, o.at)], 0
    stride = min(STRIDE * sd(o, i), (high - low) / 8)
    while (here := points[-1]).rise < RISE:
        left = (high - here.x[i]) if sign > 0 else (here.x[i] - low)
        if left <= 1e-9 * (high - low):
            return points, f"{c.label} may not be {'larger' if sign > 0 else 'smaller'}"
        if len(points) > POINTS:
            return points, f"after {POINTS} points the rise is still {here.rise:.2g}"
        length = min(stride, left)
        there, reason = refit(o, i, here, here.x[i] + sign * length)
        if there is None and shorter == SHORTER:
            return points, reason
        gained = 0.0 if there is None else max(there.rise, 0.0) ** 0.5 - max(here.rise, 0.0) ** 0.5
        grow = STRIDE / max(gained, 1e-9)
        if there is None or (there.rise > BEYOND and shorter < SHORTER):
            stride, shorter = length * float(np.clip(grow, 0.1, 0.5)), shorter + 1
            continue
        if (less := -there.rise * o.variance) > LOWER:
            at = f"{c.label} = {c.to_value(there.x[i]):.4g}"
            return points, f"the fit did not end at the optimum, at {at} |r|^2 is {less:.2g} less"
        points.append(there)
        stride = length * float(np.clip(grow, 0.3, 3.0))
    return points, ""


def refit(o: Fit, i: int, here: Point, aim: float) -> tuple[Point | None, str]:
    """The optimum of the others with coordinate i at `aim`, started along the tangent of the
    profile; or None with the reason of failure."""
    label, (low, high) = o.problem.coordinates.labels[i], o.problem.coordinates.bounds
    held = o._replace(stage=replace(o.stage, free=tuple(one for one in o.labels if one != label)))
    others, x = held.free, here.x.copy()
    if others.any():
        tangent = -np.linalg.lstsq(here.at.J[:, others], here.at.J[:, i], rcond=None)[0]
        x[others] = np.clip(x[others] + tangent * (aim - x[i]), low[others], high[others])
    x[i] = aim
    at = o.residuals(x, jacobian=True)
    if others.any() and not at.failed:
        with suppress(Unreachable):
            close = FITTED / max(float(at.r @ at.r), FITTED)
            fit = gauss_newton(held._replace(x=x, at=at), EVALUATIONS, close)
            if not fit.converged:
                return None, "the other coordinates could not be fitted there"
            x, at = fit.x, fit.at
            x[i] = aim
    if at.failed:
        return None, at.reason
    return Point(x, (float(at.r @ at.r) - o.square) / o.variance, at), ""


def interval_end(
    o: Fit, i: int, side: Side, curve: tuple[Array, Array], sign: int
) -> tuple[float | None, list[Finding]]:
    """One end of the interval in physical units, by the `curve` of x and the signed square root
    of the rise, with a finding where it was not found or is uncertain."""
    one, (points, reason) = o.problem.coordinates.all[i], side
    facts: dict[str, Any] = {"estimate": one.label, "end": "upper" if sign > 0 else "lower"}
    if reason:
        facts |= {"value": one.to_value(points[-1].x[i]), "reason": reason}
        return None, [Finding("profile-open", "note", facts)]
    low, high = sorted((points[-1].x[i], points[-2].x[i]))
    roots = PchipInterpolator(*curve).solve(sign * RISE**0.5)
    end = one.to_value(float(roots[(roots >= low) & (roots <= high)][0]))
    change = o.step_effect(points[-1].x)
    if abs(change) < CHOSEN_ANEW * o.variance:
        return end, []
    return end, [Finding("profile-steps", "note", facts | {"change": change, "rtol": o.rtol})]


def assemble(o: Fit, i: int, below: Side, above: Side) -> Profile:
    """The profile of both sides, with its interval and findings."""
    c, one = o.problem.coordinates, o.problem.coordinates.all[i]
    points, half = [*below[0][:0:-1], *above[0]], RISE**0.5 * sd(o, i)
    x = np.array([point.x[i] for point in points])
    rises = np.maximum([point.rise for point in points], 0.0)
    curve = x, np.sign(x - o.x[i]) * np.sqrt(rises)
    lower, found = interval_end(o, i, below, curve, -1)
    upper, more = interval_end(o, i, above, curve, 1)
    others = [k for k in np.flatnonzero(o.free) if k != i]
    return Profile(
        one.label,
        one.to_value(o.x[i]),
        [one.to_value(v) for v in x],
        rises.tolist(),
        {c.labels[k]: [c.all[k].to_value(point.x[k]) for point in points] for k in others},
        (lower, upper),
        (one.to_value(max(o.x[i] - half, -700.0)), one.to_value(min(o.x[i] + half, 700.0))),
        o.variance,
        found + more,
    )
