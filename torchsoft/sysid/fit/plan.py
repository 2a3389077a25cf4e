"""Stages: which data, which unknowns, which ties, in which order.

A fit of everything at once, from far away, ends in a local minimum or in runs that cannot be simulated. So: first the
slowest recording, for what it can identify; then all of them, with ratios (kinetic over static friction) tied at their upper
bound, because friction that does not fall with slip always has a solution; then a scan over each ratio, and everything free.
Tolerances are loose in the beginning, and the last stage takes the full one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.fit.fit import Unreachable
from torchsoft.sysid.fit.information import standard_deviations
from torchsoft.sysid.problem.problem import Problem
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.workers import Runner

FIRST_LOOK = 0.1
"""A coordinate takes part in the first look if its predicted standard deviation [1] is below this: one that is barely
identifiable would run off to make up for what is still wrong elsewhere."""

LOOSE, USUAL = 1e-3, 1e-4
"""Relative tolerances of the stages with ratios tied, and of those before the last one."""

FIRST, ALL, FREE, LAST = 8, 15, 30, 20
"""Evaluations that each of the stages may take."""

SCANNED = (1.0, 0.85, 0.7, 0.55)
"""Parts of its upper bound at which a ratio is tried before it is set free."""


@dataclass(frozen=True)
class Stage:
    """One fit: recordings, free coordinates by label, the relative tolerance that chooses its steps, how long, and what is set
    or scanned before it.

    `tied` sets coordinates to values; `scanned` tries each value, by `LOOSE`, the others held, and keeps the best. With
    `starts` above one, that many Sobol points within a factor `spread` of the start are fitted, and the best end goes on.
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


def tie_ratios(problem: Problem, x: Array) -> Array:
    """x with every free ratio at its upper bound."""
    x, (_, high) = x.copy(), problem.coordinates.bounds
    for i, c in enumerate(problem.coordinates.all):
        if c.ratio_to and not c.fixed:
            x[i] = high[i]
    return x


def visible(J: Array, candidates: NDArray[np.bool_], limit: float = FIRST_LOOK) -> NDArray[np.bool_]:
    """The largest set, found greedily, whose members are all known to better than `limit` when the rest is held."""
    out = candidates.copy()
    while out.any():
        sd = standard_deviations(J[:, out])
        if sd.max() <= limit:
            break
        out[np.flatnonzero(out)[sd.argmax()]] = False
    return out


def told(problem: Problem, which: Sequence[str]) -> NDArray[np.bool_]:
    """Coordinates (n,) that recordings may tell something of: not those of other recordings, nor of sensors that they lack."""
    channels = {channel for recording in problem.recordings if recording.name in which for channel in recording.samples}
    return np.array(
        [
            one.recording in (None, *which) and (one.of_the_rig or one.name in channels)
            for one in problem.coordinates.all
        ]
    )


def default_plan(problem: Problem, runner: Runner, rtol: float, which: Sequence[str], starts: int = 1) -> list[Stage]:
    """Stages for some recordings: the slowest first, for what its Fisher matrix at the start makes identifiable.

    Raises `Unreachable` where that recording cannot be simulated from the start.
    """
    c, free = problem.coordinates, problem.coordinates.free & told(problem, which)
    ratios = np.array([bool(one.ratio_to) for one in c.all]) & free
    x, labels = tie_ratios(problem, c.start), np.array(c.labels, object)
    speed = {recording.name: recording.speed for recording in problem.recordings}
    order = sorted(which, key=lambda name: speed[name])
    loose, usual = max(LOOSE, rtol), max(USUAL, rtol)
    look = problem.residuals(runner, x, order[:1], loose, free)
    if look.lost:
        raise Unreachable(look.lost)
    ties = tuple((c.all[i].label, c.all[i].high) for i in np.flatnonzero(ratios))
    slowest, first = (order[0],), tuple(labels[visible(look.J, free & ~ratios)])
    plan = [Stage(f"{order[0]}: first look", slowest, first, loose, FIRST, 1e-2, ties, starts=starts)]
    if len(order) > 1 or ratios.any():
        plan.append(Stage("all data, ratios tied", tuple(order), tuple(labels[free & ~ratios]), loose, ALL, 1e-2))
    scans = tuple((c.all[i].label, tuple(part * c.all[i].high for part in SCANNED)) for i in np.flatnonzero(ratios))
    every, last = (tuple(order), tuple(labels[free])), rtol >= USUAL
    plan.append(Stage("everything", *every, usual, FREE, 1e-3 if last else 1e-2, scanned=scans))
    if not last:
        plan.append(Stage("everything, full tolerance", *every, rtol, LAST, 1e-3))
    return plan
