"""Motions designed for parameters of interest: the knots of set-points, moved by gradient."""

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from torchsoft.excitation import Excitation, Knots
from torchsoft.plan.adam import ProjectedAdam
from torchsoft.plan.knots import Bounds, Moves, profile
from torchsoft.solve.adjoint import GradientFailed
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.criterion import VOLUME, Criterion
from torchsoft.sysid.planner import PRICE, DesignEvaluation, Planner, Range
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array, Recording

OUTLIER = 10.0
"""Slopes beyond so many medians are cut."""

MEMORY = 0.85, 0.97
"""How much of its slopes, and of their squares, Adam remembers from one iteration to the next."""

LOOK = 10
"""Iterations between two evaluations at the motion itself, with all draws and no random shift."""

FAILURES = 5
"""Runs lost one after the other until the search goes back to the best motion so far."""


@dataclass(frozen=True)
class Visit:
    """The motion after some iterations: the criterion over all draws, and how much of the way to
    its limit a channel goes."""

    iteration: int
    value: float
    peak: float

    @property
    def score(self) -> float:
        """The criterion, and a price of excess."""
        return self.value + PRICE * max(0.0, self.peak - 1.0)


class Search:
    """Adam on the smoothed criterion, projected on what knots may do; keeps the best motion that
    was looked at."""

    def __init__(
        self,
        planner: Planner,
        points: Sequence[Array],
        robust: str,
        rate: float,
        smoothing: float,
        seed: int,
    ) -> None:
        self.planner, self.points, self.robust, self.rate, self.smoothing = (
            planner,
            points,
            robust,
            rate,
            smoothing,
        )
        self.rng, self.iteration, self.lost, self.in_a_row = np.random.default_rng(seed), 0, 0, 0

    def begin(self) -> DesignEvaluation:
        """The look at the motion given, which is the best so far. Raises `ValueError` where it
        cannot be run."""
        try:
            first = self.planner.evaluate(self.planner.moves.start, self.points[0])
        except SimulationFailed as failure:
            raise ValueError(
                f"the motion given cannot be run, so that nothing can begin with it: {failure}"
            ) from None
        self.set_out(self.planner.moves, first)
        return first

    def set_out(self, moves: Moves, seen: DesignEvaluation) -> None:
        """From the motion of some knots on, by gradient."""
        self.planner, self.seen, self.z = self.planner.of(moves), seen, moves.start
        self.adam = ProjectedAdam(self.z, moves.nearest, MEMORY)
        self.best, _ = self.visit(self.z)
        self.history = [self.best]

    def visit(self, z: Array) -> tuple[Visit, DesignEvaluation | None]:
        """What a motion is worth over all points, infinite where it is lost, and the look at it at
        the first."""
        try:
            evaluations = [self.planner.evaluate(z, x) for x in self.points]
        except SimulationFailed:
            return Visit(self.iteration, np.inf, np.inf), None
        values = [one.value for one in evaluations]
        peak = max(max(one.peaks.values(), default=0.0) for one in evaluations)
        value = max(values) if self.robust == "worst" else float(np.mean(values))
        return Visit(self.iteration, value, peak), evaluations[0]

    def look(self) -> None:
        """Keeps the motion as it is now, if it is the best."""
        z = self.adam.z
        visit, seen = self.visit(z)
        self.history.append(visit)
        if seen is not None and visit.score < self.best.score:
            self.best, self.seen, self.z = visit, seen, z

    def move(self, iterations: int) -> None:
        """One step, or none where the motion is lost."""
        moves, z = self.planner.moves, self.adam.z
        try:
            shifted = moves.nearest(z + self.smoothing * self.rng.standard_normal(moves.n))
            if self.robust == "worst":
                evaluations = [self.planner.evaluate(shifted, x) for x in self.points]
                k = int(np.argmax([one.value for one in evaluations]))
                x, there = self.points[k], evaluations[k]
            else:
                x = self.points[int(self.rng.integers(len(self.points)))]
                there = self.planner.evaluate(shifted, x)
            slopes = self.planner.slopes(shifted, x, there)
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
"""Standard deviations that a step of a fit may end from the truth without a word."""


@dataclass(frozen=True)
class Design:
    """A motion and what it is worth.

    `recording` follows it, and has the samples that the rig would give at the first draw of the
    parameters, without noise; so has `given`, the motion that the search began with. `before` and
    `after` are the relative standard deviations with either, from other recordings and priors too.
    `history` has the criterion as it went, `limits` names what holds the motion back, `notices`
    what a reader must know.
    """

    given: Recording
    recording: Recording
    before: dict[str, float]
    after: dict[str, float]
    history: tuple[Visit, ...]
    limits: tuple[str, ...]
    notices: tuple[str, ...]
    made_by: dict[str, Any]

    def excitation(self, given: Excitation) -> Excitation:
        """The motion as an excitation of the paper's rig, after the grasp of the one `given` that
        the search began with."""
        since = given.grasp_time + given.settle

        def course(name: str) -> tuple[tuple[float, float], ...]:
            signal = profile(self.recording.rig.reference, name)
            t, v = signal.times.numpy(), signal.values.detach().numpy()
            first = int(np.searchsorted(t, since * (1 + 1e-9), side="right"))
            return tuple(
                (float(at - since), float(to - v[first - 1]))
                for at, to in zip(t[first:], v[first:])
            )

        return given.model_copy(update={"motion": Knots(x=course("x_d"), y=course("y_d"))})

    def table(self) -> str:
        """One line a parameter."""
        rows = [f"{'relative standard deviation':28s} {'before':>9s} {'after':>9s} {'ratio':>7s}"]
        rows += [
            f"{n:28s} {was:9.2%} {self.after[n]:9.2%} {self.after[n] / was:7.2f}"
            for n, was in self.before.items()
        ]
        return "\n".join(rows)


def draws(
    problem: Problem, count: int, *, spread: float | None = None, seed: int = 0
) -> list[Array]:
    """`count` points x (n,) of the coordinates, the first the nominal one, the others drawn from
    their priors, or with the standard deviation `spread` [1] of the logarithm of parameters that
    have none. Raises `ValueError` where there is neither."""
    c, rng = problem.coordinates, np.random.default_rng(seed)
    low, high = c.bounds
    out = [c.start]
    for _ in range(count - 1):
        x = c.start
        for i in np.flatnonzero(c.free):
            one = c.all[i]
            if one.prior is not None:
                x[i] = one.to_x(one.prior.draw(rng))
            elif one.kind == "parameter":
                if spread is None:
                    raise ValueError(
                        f"`{one.label}` has no prior to draw from: give it one, or a `spread`"
                    )
                x[i] += spread * float(rng.standard_normal())
        out.append(np.clip(x, low, high))
    return out


def design(
    problem: Problem, plan: str, bounds: Mapping[str, Bounds], *,
    limits: Mapping[str, Range] | None = None, criterion: Criterion = VOLUME,
    names: Sequence[str] | None = None, at: Sequence[Array] | None = None,
    robust: Literal["mean", "worst"] = "mean", iterations: int = 100, rate: float = 0.03,
    smoothing: float = 0.02, rtol: float = RTOL, seed: int = 0, workers: int = 1,
    progress: bool = False,
) -> Design:  # fmt: skip
    """Move the knots of the recording `plan` of a problem until the parameters `names` (all, by
    default) are known best.

    Of the plan's samples only the times count; the other recordings and the priors count with what
    they tell. Sensors' biases and the like are nuisances: what the criterion sees is what is left
    when they are fitted too; and, beside the covariance, how far finite steps and bent samples
    would lead a fit astray (`Planner.errors`). `bounds` holds the travel, speed and free knots of
    signals of the reference, `limits` the ranges (low, high) [unit] of channels of the run, such as
    forces. `at` are points x of the coordinates (`draws`), by default the nominal one; the
    criterion's "mean" over them is lowered, or the "worst".

    The search begins with the plan's own motion. Each of the `iterations` moves knots by at most
    about `rate` times what speed allows from one to the next, shifted at random by `smoothing`
    times that, and takes a run with sensitivities and 2 n with the adjoint, of relative tolerance
    `rtol`. A motion that cannot be run is left; with Ctrl-C the best so far is returned, with a
    notice. Raises `ValueError` for what does not fit together, and where the plan itself cannot be
    run.
    """
    if plan not in problem.names:
        raise ValueError(
            f"`plan` must be one of the recordings {list(problem.names)}, but is {plan!r}"
        )
    if iterations < 0 or not 0 < rate <= 1 or not 0 <= smoothing <= 1:
        raise ValueError(
            "`iterations` must not be negative, `rate` and `smoothing` must be parts of 1"
        )
    points, recording = (
        [problem.coordinates.start] if at is None else list(at),
        problem.recordings[problem.names.index(plan)],
    )
    if not points or any(x.shape != problem.coordinates.start.shape for x in points):
        raise ValueError(f"`at` must hold points of the {len(problem.coordinates)} coordinates")
    if not bounds:
        raise ValueError("`bounds` names no signal whose knots may move")
    began = clock.perf_counter()
    moves = Moves(recording.rig.reference, bounds, float(recording.times[-1]))
    planner = Planner(problem, plan, moves, limits or {}, criterion, names, rtol, workers)
    search = Search(planner, points, robust, rate, smoothing, seed)
    first = search.begin()
    before, given = (
        planner.deviations(points[0], first),
        planner.made(moves.start, points[0], first),
    )
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
    last, planner = search.seen, search.planner
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
    bent = {name: float(np.abs(part).max()) for name, part in planner.bent(points[0], last).items()}
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
        given=given, recording=planner.made(search.z, points[0], last), before=before,
        after=planner.deviations(points[0], last), history=tuple(search.history),
        limits=(*planner.moves.active(search.z), *peaks), notices=tuple(notices),
        made_by={
            "torchsoft": version("torchsoft"), "criterion": criterion.optimality,
            "targets": criterion.targets,
            "bounds": {name: one.model_dump() for name, one in bounds.items()},
            "limits": dict(limits or {}), "draws": len(points), "robust": robust,
            "iterations": search.iteration, "rate": rate, "smoothing": smoothing, "rtol": rtol,
            "seed": seed, **planner.cost, "wall_s": clock.perf_counter() - began,
        },
    )  # fmt: skip
