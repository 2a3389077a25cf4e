"""Optimal design of motions: the knots of set-points, moved by gradient."""

import time as clock
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from tqdm import tqdm

from torchsoft.plan.adam import ProjectedAdam
from torchsoft.plan.knots import Bounds, Moves
from torchsoft.solve.adjoint import GradientFailed
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.criterion import Optimality
from torchsoft.sysid.planner import PRICE, DesignEvaluation, Planner, Range
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array, Recording

OUTLIER = 10.0
"""Largest gradient component, in medians; larger ones are clipped."""

MEMORY = 0.85, 0.97
"""Adam's decay rates of the first and second moments of the gradient."""

LOOK = 10
"""Iterations between two evaluations at the motion itself, without a random shift."""

FAILURES = 5
"""Consecutive failed runs after which the search returns to the best motion."""


@dataclass(frozen=True)
class Visit:
    """The motion after some iterations: the criterion, and the largest fraction of its limit that a
    channel reaches."""

    iteration: int
    value: float
    peak: float

    @property
    def score(self) -> float:
        """The criterion with a penalty on excess."""
        return self.value + PRICE * max(0.0, self.peak - 1.0)


class Search:
    """Projected Adam on the smoothed criterion at coordinates x (n,). Keeps the best evaluated
    motion. Raises `SimulationFailed` where the given motion cannot be run."""

    def __init__(
        self, planner: Planner, x: Array, rate: float, smoothing: float, seed: int
    ) -> None:
        self.planner, self.x, self.rate, self.smoothing = planner, x, rate, smoothing
        self.rng, self.iteration, self.lost, self.in_a_row = np.random.default_rng(seed), 0, 0, 0
        self.z = planner.moves.start
        self.adam = ProjectedAdam(self.z, planner.moves.nearest, MEMORY)
        self.seen = planner.evaluate(self.z, x)
        self.best = self.visit(self.seen)
        self.history = [self.best]

    def visit(self, seen: DesignEvaluation) -> Visit:
        return Visit(self.iteration, seen.value, max(seen.peaks.values(), default=0.0))

    def look(self) -> None:
        """Evaluate the current motion, and keep it if it is the best."""
        z, seen, visit = self.adam.z, None, Visit(self.iteration, np.inf, np.inf)
        with suppress(SimulationFailed):
            seen = self.planner.evaluate(z, self.x)
            visit = self.visit(seen)
        self.history.append(visit)
        if seen is not None and visit.score < self.best.score:
            self.best, self.seen, self.z = visit, seen, z

    def move(self, iterations: int) -> None:
        """Take one step, or none where the run fails."""
        moves, z = self.planner.moves, self.adam.z
        try:
            shifted = moves.nearest(z + self.smoothing * self.rng.standard_normal(moves.n))
            there = self.planner.evaluate(shifted, self.x)
            slopes = self.planner.slopes(shifted, self.x, there)
        except (SimulationFailed, GradientFailed):
            self.lost, self.in_a_row = self.lost + 1, self.in_a_row + 1
            if self.in_a_row >= FAILURES:
                self.in_a_row, self.rate = 0, 0.5 * self.rate
                self.adam.set(self.z)
            return
        self.iteration, self.in_a_row = self.iteration + 1, 0
        most = OUTLIER * float(np.median(np.abs(slopes)))
        part = self.iteration / iterations
        rate = self.rate * min(1.0, self.iteration / 5) * (0.1 + 0.9 * (1 - part))
        self.adam.step(np.clip(slopes, -most, most), rate)
        if self.iteration % LOOK == 0:
            self.look()


# The design of a motion


RTOL = 1e-3
"""Relative tolerance of the runs: standard deviations are right to some percent."""

BENT = 1.0
"""Largest error, in standard deviations, of a fit's Gauss-Newton step that gets no notice."""


@dataclass(frozen=True)
class Design:
    """A designed motion and its information.

    `recording` follows it, with noiseless samples at the nominal parameters; so does `given`, with
    the motion at the start of the search. `before` and `after` are the relative standard deviations
    with either, including the other recordings and priors. `history` has the criterion over the
    search, `limits` the active constraints, `notices` other facts about the search.
    """

    given: Recording
    recording: Recording
    before: dict[str, float]
    after: dict[str, float]
    history: tuple[Visit, ...]
    limits: tuple[str, ...]
    notices: tuple[str, ...]
    made_by: dict[str, Any]

    def table(self) -> str:
        """A line for each parameter."""
        rows = [f"{'relative standard deviation':28s} {'before':>9s} {'after':>9s} {'ratio':>7s}"]
        rows += [
            f"{n:28s} {was:9.2%} {self.after[n]:9.2%} {self.after[n] / was:7.2f}"
            for n, was in self.before.items()
        ]
        return "\n".join(rows)


def design(
    problem: Problem, plan: str, bounds: Mapping[str, Bounds], *,
    limits: Mapping[str, Range] | None = None, criterion: Optimality = "D",
    names: Sequence[str] | None = None, iterations: int = 100, rate: float = 0.03,
    smoothing: float = 0.02, rtol: float = RTOL, seed: int = 0, workers: int = 1,
    progress: bool = False,
) -> Design:  # fmt: skip
    """Move the knots of the recording `plan` of a problem to minimise the uncertainty of the
    parameters `names`, by default all.

    Of the plan's samples only the times count; the other recordings and the priors contribute their
    information. Faults of sensors are nuisances, which the criterion marginalises. Beside the
    covariance it counts errors of a fit from finite steps and nonlinear samples (`Planner.errors`),
    at the nominal values. `criterion` is "D" (the volume of the errors), "A" (their mean square) or
    "worst". `bounds` holds the travel, speed and free knots of signals of the reference, `limits`
    the ranges (low, high) [unit] of channels of the run, such as forces.

    The search begins with the plan's own motion. Each of the `iterations` moves knots by at most
    about `rate` times the distance that speed allows between two, shifted at random by `smoothing`
    times that, and takes a run with sensitivities and 2 n with the adjoint, of relative tolerance
    `rtol`. A motion that cannot be run is skipped; on Ctrl-C the best so far is returned, with a
    notice. Raises `ValueError` for arguments that do not fit together, and where the plan itself
    cannot be run.
    """
    if plan not in problem.names:
        raise ValueError(
            f"`plan` must be one of the recordings {list(problem.names)}, but is {plan!r}"
        )
    if iterations < 0 or not 0 < rate <= 1 or not 0 <= smoothing <= 1:
        raise ValueError(
            "`iterations` must not be negative, `rate` and `smoothing` must be parts of 1"
        )
    x, recording = problem.coordinates.start, problem.recordings[problem.names.index(plan)]
    if not bounds:
        raise ValueError("`bounds` names no signal whose knots may move")
    began = clock.perf_counter()
    moves = Moves(recording.rig.reference, bounds, float(recording.times[-1]))
    planner = Planner(problem, plan, moves, limits or {}, criterion, names, rtol, workers)
    try:
        search = Search(planner, x, rate, smoothing, seed)
    except SimulationFailed as failure:
        raise ValueError(
            f"the motion given cannot be run, so that nothing can begin with it: {failure}"
        ) from None
    before, given = planner.deviations(x, search.seen), planner.made(search.z, x, search.seen)
    with tqdm(total=iterations, desc="design", disable=not progress) as bar:
        try:
            while search.iteration < iterations:
                search.move(iterations)
                bar.set_postfix_str(f"criterion {search.best.value:.3f}", refresh=False)
                bar.update(search.iteration - bar.n)
            search.look()
            notices = []
        except KeyboardInterrupt:
            notices = [f"interrupted after {search.iteration} of {iterations} iterations"]
    last = search.seen
    peaks = [
        f"{name} goes {part:.0%} of the way to its limits"
        for name, part in last.peaks.items()
        if part > 0.9
    ]
    notices += [
        f"{name} goes beyond its limits, {part:.1%} of the way to them"
        for name, part in last.peaks.items()
        if part > 1
    ]
    bent = {name: float(np.abs(part).max()) for name, part in planner.bent(x, last).items()}
    most = max(bent, key=lambda name: bent[name])
    if bent[most] > BENT:
        notices.append(
            f"a fit on steps by rtol = {rtol:g} that begins a standard deviation from the truth "
            f"ends {bent[most]:.2g} of them from it in `{most}`: take finer steps, and count "
            "intervals that hold before this motion is used"
        )
    if search.lost:
        notices.append(f"{search.lost} motions that the search tried could not be run")
    return Design(
        given=given, recording=planner.made(search.z, x, last), before=before,
        after=planner.deviations(x, last), history=tuple(search.history),
        limits=(*planner.moves.active(search.z), *peaks), notices=tuple(notices),
        made_by={
            "torchsoft": version("torchsoft"), "criterion": criterion,
            "bounds": {name: one.model_dump() for name, one in bounds.items()},
            "limits": dict(limits or {}), "iterations": search.iteration, "rate": rate,
            "smoothing": smoothing, "rtol": rtol, "seed": seed,
            **planner.cost, "wall_s": clock.perf_counter() - began,
        },
    )  # fmt: skip
