"""Profile likelihoods: the misfit with one coordinate held and all others fitted again."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

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
        problem = problem.with_noise({one.channel: one.model for one in answer.noise})
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

DIFFERENT = 0.2
"""Difference between the ends of both intervals, over the half width of Wald's, that gets a
notice."""


@dataclass(frozen=True)
class Profile:
    """The profile of one coordinate: its values in physical units, ascending, and the `rises` of 2
    (-log posterior) at them.

    `others` holds the values of the other coordinates by label, in physical units. `ci95` has None
    for an end that was not found, and `notices` the reason; `wald95` is the interval by the
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
    notices: list[str]


class Point(NamedTuple):
    """Coordinates (n,) of a point of a profile, its rise, and the residuals with their Jacobian."""

    x: Array
    rise: float
    at: Residuals


class Side(NamedTuple):
    """The points on one side of the optimum, outwards, the reason of an early end, and notices."""

    points: list[Point]
    ended: str
    notices: list[str]


def profiles(
    optimum: Fit, labels: Sequence[str] | None = None, *, progress: bool = False
) -> list[Profile]:
    """Profiles of some coordinates, by default all free ones, from an `optimum`; all sides are
    computed side by side in its threads.

    Raises `ValueError` for a label that is not a free coordinate's.
    """
    known = optimum.labels
    for label in labels or ():
        if label not in known:
            raise ValueError(
                f"there is no free coordinate {label!r} to profile; "
                f"{suggestion(label, known, 'there are')}"
            )
    chosen = list(known if labels is None else labels)
    where = {label: i for i, label in enumerate(optimum.problem.coordinates.labels)}
    tasks = [(label, sign) for label in chosen for sign in (-1, 1)]
    with single_threaded():
        work = parallel_map(
            lambda k: walk(optimum, where[tasks[k][0]], tasks[k][1]),
            len(tasks),
            optimum.runner.workers,
        )
        done = dict(tqdm(work, desc="profiles", total=len(tasks), disable=hidden(progress)))
    return [
        assemble(optimum, where[label], done[2 * k], done[2 * k + 1])
        for k, label in enumerate(chosen)
    ]


def sd(o: Fit, i: int) -> float:
    """Standard deviation of coordinate i, widened like its profile."""
    return float(o.sd[o.labels.index(o.problem.coordinates.labels[i])] * o.variance**0.5)


def walk(o: Fit, i: int, sign: int) -> Side:
    """One side of the profile of coordinate i, from the optimum to the end of the interval."""
    label, (low, high) = (
        o.problem.coordinates.labels[i],
        (float(b[i]) for b in o.problem.coordinates.bounds),
    )
    edge = high if sign > 0 else low
    here, stride = Point(o.x, 0.0, o.at), min(STRIDE * sd(o, i), (high - low) / 8)
    points, notices, shorter = list[Point](), list[str](), 0
    while here.rise < RISE and len(points) < POINTS:
        if sign * (edge - here.x[i]) <= 1e-9 * (high - low):
            return Side(
                points, f"{label} may not be {'larger' if sign > 0 else 'smaller'}", notices
            )
        length = min(stride, sign * (edge - here.x[i]))
        there, reason = refit(o, i, here, here.x[i] + sign * length)
        if there is None and shorter == SHORTER:
            return Side(points, reason, notices)
        gained = 0.0 if there is None else max(there.rise, 0.0) ** 0.5 - max(here.rise, 0.0) ** 0.5
        if there is None or (there.rise > BEYOND and shorter < SHORTER):
            stride, shorter = (
                length * float(np.clip(STRIDE / max(gained, 1e-9), 0.1, 0.5)),
                shorter + 1,
            )
            continue
        points.append(there)
        if there.rise * o.variance < -LOWER:
            value = o.problem.coordinates.all[i].to_value(there.x[i])
            notices.append(
                f"the fit did not end at the optimum: with {label} = {value:.4g} the misfit |r|^2 "
                f"is less by {-there.rise * o.variance:.2g}; fit again from there"
            )
            return Side(points, "the fit did not end at the optimum", notices)
        if there.rise < here.rise - LOWER:
            notices.append(f"the profile of {label} is not monotone: there may be another optimum")
        stride, here = length * float(np.clip(STRIDE / max(gained, 1e-9), 0.3, 3.0)), there
    return Side(
        points,
        "" if here.rise >= RISE else f"after {POINTS} points the rise is still {here.rise:.2g}",
        notices,
    )


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


def assemble(o: Fit, i: int, below: Side, above: Side) -> Profile:
    """The profile of both sides, with its interval and notices."""
    c = o.problem.coordinates
    one, points = c.all[i], [*below.points[::-1], Point(o.x, 0.0, o.at), *above.points]
    x = np.array([point.x[i] for point in points])
    zeta = np.sign(x - o.x[i]) * np.sqrt(np.maximum([point.rise for point in points], 0.0))
    ends, notices = list[float | None](), [*below.notices, *above.notices]
    for side, sign, name in ((below, -1, "lower"), (above, 1, "upper")):
        if side.ended or not side.points:
            last = one.to_value(side.points[-1].x[i] if side.points else o.x[i])
            notices.append(
                f"{one.label} has no {name} bound of its 95 % interval within {last:.4g}: "
                f"{side.ended}"
            )
            ends.append(None)
            continue
        a, b = sorted(
            (side.points[-1].x[i], side.points[-2].x[i] if len(side.points) > 1 else o.x[i])
        )
        roots = PchipInterpolator(x, zeta).solve(sign * RISE**0.5)
        ends.append(float(roots[(roots >= a) & (roots <= b)][0]))
        off = o.step_effect(side.points[-1].x)
        if not abs(off) < CHOSEN_ANEW * o.variance:
            notices.append(
                f"the {name} end of the profile of {one.label} is uncertain: steps chosen anew "
                f"there change |r|^2 by {off:.2g}; take a tighter tolerance than rtol = {o.rtol:g}"
            )
    half = RISE**0.5 * sd(o, i)
    wald = o.x[i] - half, o.x[i] + half
    worst = max((abs(e - w) / half for e, w in zip(ends, wald) if e is not None), default=0.0)
    physical = [None if e is None else one.to_value(e) for e in ends]
    straight = one.to_value(max(wald[0], -700.0)), one.to_value(min(wald[1], 700.0))
    if worst > DIFFERENT:
        bounds = [f"{e:.4g}" if e is not None else "open" for e in physical]
        notices.append(
            f"the misfit is no parabola in {one.label}: its profile's interval is {bounds[0]} .. "
            f"{bounds[1]}, the covariance's {straight[0]:.4g} .. {straight[1]:.4g}; take the "
            "profile's"
        )
    every = [k for k in np.flatnonzero(o.free) if k != i]
    return Profile(
        one.label,
        one.to_value(o.x[i]),
        [one.to_value(v) for v in x],
        [max(float(point.rise), 0.0) for point in points],
        {c.labels[k]: [c.all[k].to_value(point.x[k]) for point in points] for k in every},
        (physical[0], physical[1]),
        straight,
        o.variance,
        list(dict.fromkeys(notices)),
    )
