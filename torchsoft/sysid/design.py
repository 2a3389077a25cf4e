"""Optimal design of motions: a ranking of candidates, and knots of set-points moved by gradient;
rehearsal of an experiment."""

import time as clock
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from torchsoft import csvfile
from torchsoft.display import hidden
from torchsoft.plan.knots import Bounds, Moves, knots
from torchsoft.plan.search import ProjectedAdam
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.built import BuiltRig
from torchsoft.rigs.excite import excite
from torchsoft.rigs.fields import at_field
from torchsoft.solve.gradients import GradientFailed
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.configuration import Config, Entry, Rest, StartTable
from torchsoft.sysid.initial_state import Standing
from torchsoft.sysid.measured import vocabulary
from torchsoft.sysid.planner import PRICE, RTOL, DesignEvaluation, Optimality, Planner, Range
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.synthetic import record
from torchsoft.sysid.unknowns import Sensor, Unknown
from torchsoft.tables import line

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
        self.rng, self.iteration, self.failed, self.in_a_row = np.random.default_rng(seed), 0, 0, 0
        self.z = planner.moves.start
        self.adam = ProjectedAdam(self.z, planner.moves.nearest, MEMORY)
        self.seen = planner.evaluate(self.z, x)
        self.best = self.visit(self.seen)
        self.history = [self.best]

    def visit(self, seen: DesignEvaluation) -> Visit:
        return Visit(self.iteration, seen.value, max(seen.peaks.values(), default=0.0))

    def evaluate(self) -> None:
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
            self.failed, self.in_a_row = self.failed + 1, self.in_a_row + 1
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
            self.evaluate()


# The design of a motion


LINEARIZATION_ERROR = 1.0
"""Largest error, in standard deviations, of a fit's Gauss-Newton step that gets no notice."""


@dataclass(frozen=True)
class Design:
    """A designed motion and its information.

    `recording` follows it, with noiseless samples at the nominal parameters; so does `given`, with
    the motion at the start of the search. `before` and `after` are the relative standard deviations
    with either, including the other recordings and priors. `history` has the criterion over the
    search, `limits` the active constraints, `notices` other facts about the search, and
    `confirmed` whether the rig file written of it, run again, tells the same.
    """

    given: Recording
    recording: Recording
    before: dict[str, float]
    after: dict[str, float]
    history: tuple[Visit, ...]
    limits: tuple[str, ...]
    notices: tuple[str, ...]
    made_by: dict[str, Any]
    confirmed: bool = True

    def table(self) -> str:
        """A line for each parameter."""
        rows = [f"{'relative standard deviation':28s} {'before':>9s} {'after':>9s} {'ratio':>7s}"]
        rows += [
            f"{n:28s} {was:9.2%} {self.after[n]:9.2%} {self.after[n] / was:7.2f}"
            for n, was in self.before.items()
        ]
        return "\n".join(rows)


def design(
    problem: Problem,
    plan: str,
    bounds: Mapping[str, Bounds],
    *,
    limits: Mapping[str, Range] | None = None,
    criterion: Optimality = "D",
    names: Sequence[str] | None = None,
    iterations: int = 100,
    rate: float = 0.03,
    smoothing: float = 0.02,
    rtol: float = RTOL,
    seed: int = 0,
    workers: int = 1,
    progress: bool = False,
) -> Design:
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
    started = clock.perf_counter()
    moves = Moves(recording.rig.reference, bounds, float(recording.times[-1]))
    planner = Planner(problem, plan, moves, limits or {}, criterion, names, rtol, workers)
    try:
        search = Search(planner, x, rate, smoothing, seed)
    except SimulationFailed as failure:
        raise ValueError(
            f"the motion given cannot be run, so that nothing can begin with it: {failure}"
        ) from None
    before, given = planner.deviations(x, search.seen), planner.made(search.z, x, search.seen)
    with tqdm(total=iterations, desc="design", disable=hidden(progress)) as bar:
        try:
            while search.iteration < iterations:
                search.move(iterations)
                bar.set_postfix_str(f"criterion {search.best.value:.3f}", refresh=False)
                bar.update(search.iteration - bar.n)
            search.evaluate()
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
    off = {
        name: float(np.abs(part).max())
        for name, part in planner.linearization_error(x, last).items()
    }
    most = max(off, key=lambda name: off[name])
    if off[most] > LINEARIZATION_ERROR:
        notices.append(
            f"a fit on steps by rtol = {rtol:g} that begins a standard deviation from the truth "
            f"ends {off[most]:.2g} of them from it in `{most}`: take finer steps, and count "
            "intervals that hold before this motion is used"
        )
    if search.failed:
        notices.append(f"{search.failed} motions that the search tried could not be run")
    return Design(
        given=given,
        recording=planner.made(search.z, x, last),
        before=before,
        after=planner.deviations(x, last),
        history=tuple(search.history),
        limits=(*planner.moves.active(search.z), *peaks),
        notices=tuple(notices),
        made_by={
            "torchsoft": version("torchsoft"),
            "criterion": criterion,
            "bounds": {name: one.model_dump() for name, one in bounds.items()},
            "limits": planner.limits,
            "iterations": search.iteration,
            "rate": rate,
            "smoothing": smoothing,
            "rtol": rtol,
            "seed": seed,
            **planner.cost,
            "wall_s": clock.perf_counter() - started,
        },
    )


# Rehearsal of an experiment: simulated recordings with the sensors' noise, whose identification
# shows the information of the experiment before it is built.


FINER = 0.1
"""Tolerance of the simulated experiment, over the fit's."""


def planned(
    stated: Config,
    file: RigFile,
    built: BuiltRig,
    name: str,
    rtol: float,
    start: StartTable | None = None,
    **options: Any,
) -> Recording:
    """A planned recording of a file's rig, `built`, by a configuration, from a run with the
    tolerance `rtol`; `options` are further arguments of `record`. Raises `ValueError`, and
    `SimulationFailed`."""
    plan, start = stated.rehearsal, start or stated.start
    if plan.duration is not None:
        built = replace(built, t=torch.tensor([0.0, plan.duration]).double())
    lead = start.lead if isinstance(start, Rest) else 0.0
    at_rest = Standing.built(built, lead)._replace(followed={})
    return record(
        name, built, {}, stated.sensors, start=at_rest, rate=plan.rate, rtol=rtol, **options
    )


def rehearsed(config: Path, stated: Config, out: Path) -> tuple[Config, list[Path]]:
    """Simulate the recordings of a configuration, with the parameters of its rig file, and write
    them to `out` as CSV files, which are templates of those to record.

    Returns the configuration of their identification, whose search begins away from the truth, and
    the files. Raises `ValueError`, and `SimulationFailed` for a motion that the rig cannot follow.
    """
    file, plan = RigFile.from_toml(RigFile.path(stated.rig, config.parent)), stated.rehearsal
    entries = stated.recordings or (Entry(name="rehearsal"),)
    paths, random = [], np.random.default_rng(plan.seed)
    for entry in entries:
        name = entry.name or Path(entry.paths[0]).stem
        with at_field("settings"):
            mine = file.changed(stated.settings).changed(entry.settings)
        built = mine.build()
        known, rtol = vocabulary(built.rig, stated.columns), FINER * stated.fit.rtol
        try:
            made = planned(stated, mine, built, name, rtol, entry.start, seed=random)
        except ValueError as error:
            raise ValueError(f"{config}: {error}") from None
        rig = made.rig
        followed = rig.follow(torch.from_numpy(made.times)).detach()[..., 0].numpy().T
        columns = {"t": made.times} | dict(zip(rig.signals, followed))
        columns |= {channel: y for channel, (_, y) in made.samples.items()}
        called = {of: heading for heading, of in known.headings.items()}
        units = {called.get(one, one): known.units[one] for one in columns}
        paths.append(out / f"{name}.csv")
        csvfile.write(paths[-1], dict(zip(units, columns.values())), units)
    own = [
        entry.model_copy(update={"name": path.stem, "file": None, "files": ()})
        for entry, path in zip(entries, paths)
    ]
    unknowns = dict(away(stated.unknowns, file, plan.away))
    return stated.model_copy(update={"recordings": tuple(own), "unknowns": unknowns}), paths


def away(
    unknowns: dict[str, Unknown], file: RigFile, factor: float
) -> Iterator[tuple[str, Unknown]]:
    """The unknowns, with unstated starts moved by a factor, up and down in turns. Parameters that
    bound each other stay."""
    rig = file.assemble()
    bound = {name for pair in rig.ordered.items() for name in pair}
    for k, (name, one) in enumerate(unknowns.items()):
        free = one.nominal is None and one.ratio_to is None and not one.fixed and name not in bound
        if free and one.scale == "log":
            value = rig.parameter(name).item() * factor ** (-1) ** k
            low, high = one.low or 0.0, np.inf if one.high is None else one.high
            one = one.model_copy(update={"nominal": float(np.clip(value, low, high))})
        yield name, one


# Design of a rig file's motion for an identification: a ranking of candidates, and the best one's
# knots moved by gradient, by one criterion.


AS_STATED = "as stated"
"""Name of the candidate that is the motion of the rig file itself."""


@dataclass(frozen=True)
class Rated:
    """A rated candidate: the criterion, a logarithm of standard deviations, the smaller the better;
    the relative standard deviations of the parameters, and the largest fraction of their limits
    that channels reach. `failure` is the reason of a failed run."""

    name: str
    value: float
    deviations: dict[str, float]
    peaks: dict[str, float]
    failure: str = ""

    @property
    def score(self) -> float:
        """The criterion; infinite beyond a limit."""
        beyond = self.failure or max(self.peaks.values(), default=0.0) > 1
        return np.inf if beyond else self.value


class Chosen(NamedTuple):
    """The candidates, the best first; the rig file with the best motion, and its design if knots
    were moved."""

    rated: list[Rated]
    file: RigFile
    found: Design | None

    def table(self) -> str:
        """A line for each candidate."""
        names = list(next((one.deviations for one in self.rated if not one.failure), {}))
        width = max([len(one.name) for one in self.rated] + [9])
        rows = [f"{'candidate':{width}s} criterion  {'  '.join(names)}"]
        for one in self.rated:
            cells = [f"{one.deviations.get(name, np.nan):{len(name)}.2%}" for name in names]
            content = (
                f"cannot be made: {line(one.failure, 120)}" if one.failure else "  ".join(cells)
            )
            limit = [f"{k} goes beyond its limits" for k, part in one.peaks.items() if part > 1]
            rows.append("  ".join([f"{one.name:{width}s} {one.value:9.3f}", content, *limit]))
        return "\n".join(rows)

    def summary(self) -> dict[str, Any]:
        """Content of `design.json`."""
        out: dict[str, Any] = {"candidates": [asdict(one) for one in self.rated]}
        if self.found is not None:
            one = self.found
            out |= {
                "before": one.before,
                "after": one.after,
                "limits": one.limits,
                "history": [asdict(visit) for visit in one.history],
                "notices": one.notices,
                "confirmed": one.confirmed,
                "made_by": one.made_by,
            }
        return out


def rank(
    recorded: Sequence[Recording],
    candidates: Sequence[Recording],
    sensors: dict[str, Sensor],
    unknowns: dict[str, Unknown],
    *,
    limits: Mapping[str, Range] | None = None,
    criterion: Optimality = "D",
    names: Sequence[str] | None = None,
    rtol: float = RTOL,
    workers: int = 1,
) -> list[Rated]:
    """Candidates for the next recording, the best first: by the uncertainty of the parameters
    `names` (all by default), at their nominal values, from each together with what is `recorded`.

    Only the times of a candidate's samples count. `limits` are ranges (low, high) [unit] of
    channels. Raises `ValueError` for candidates that do not fit the problem.
    """
    rated = list[Rated]()
    for one in candidates:
        problem = Problem([*recorded, one], sensors, unknowns)
        planner = Planner(
            problem,
            one.name,
            Moves(one.rig.reference, {}, 0.0),
            limits or {},
            criterion,
            names,
            rtol,
            workers,
        )
        x = problem.coordinates.start
        try:
            seen = planner.evaluate(np.zeros(0), x)
        except SimulationFailed as failure:
            rated.append(Rated(one.name, np.inf, {}, {}, str(failure)))
        else:
            rated.append(Rated(one.name, seen.value, planner.deviations(x, seen), seen.peaks))
    return sorted(rated, key=lambda one: (one.score, one.value))


SAME = 1e-6
"""Largest difference between a motion of the search and of the written file, over its largest
value."""


def unlike(found: Recording, again: Recording) -> list[str]:
    """Sentences on motions of a written file that are not those that the search found."""
    t, said = torch.from_numpy(found.times), list[str]()
    motions = [one.rig.follow(t).detach()[..., 0].mT for one in (found, again)]
    for name, was, now in zip(found.rig.signals, *motions):
        off, most = float((now - was).abs().max()), float(was.abs().max())
        if not off <= SAME * most:
            said.append(
                f"motion.{name} of the written file is up to {off:.3g} off what the search found, "
                f'of {most:.3g}: the file makes "start" or "held" anew with the new motion; give '
                "numbers in their place"
            )
    return said


def choose(
    config: Path,
    stated: Config,
    recorded: Sequence[Recording] = (),
    *,
    workers: int = 1,
    progress: bool = False,
) -> Chosen:
    """Rank a configuration's candidates for the motion by the uncertainty of its unknowns, together
    with the recordings in `recorded`, and move the knots of the best one that `bounds` name.

    The rig is that of its file. Raises `ValueError` for parts that do not fit together, and where
    no candidate can be run.
    """
    plan = stated.design
    with at_field("settings"):
        file = RigFile.from_toml(RigFile.path(stated.rig, config.parent)).changed(stated.settings)
    files, made, failures = dict[str, RigFile](), dict[str, Recording](), list[Rated]()
    for name, settings in ({AS_STATED: {}} | plan.candidates).items():
        with at_field(f"design.candidates.{name}"):
            known = isinstance(settings, str)
            files[name] = excite(file, settings) if known else file.changed(settings)
            built = files[name].build()
        try:
            made[name] = planned(stated, files[name], built, name, plan.rtol, noise=0.0)
        except SimulationFailed as failure:
            failures.append(Rated(name, np.inf, {}, {}, str(failure)))
    common: dict[str, Any] = {
        "limits": plan.limits,
        "criterion": plan.criterion,
        "names": plan.parameters or None,
        "rtol": plan.rtol,
        "workers": workers,
    }
    rated = rank(recorded, [*made.values()], stated.sensors, stated.unknowns, **common) + failures
    best = rated[0].name
    if rated[0].failure:
        raise ValueError(f"{config}: no candidate can be made: {rated[0].failure}")
    found, chosen = None, files[best]
    if plan.bounds:
        problem = Problem([*recorded, made[best]], stated.sensors, stated.unknowns)
        found = design(
            problem,
            best,
            plan.bounds,
            iterations=plan.iterations,
            seed=plan.seed,
            progress=progress,
            **common,
        )
        chosen = chosen.override(motion=knots(found.recording.rig.reference, plan.bounds))
        try:
            again = planned(stated, chosen, chosen.build(), best, plan.rtol, noise=0.0)
            said = unlike(found.recording, again)
        except (ValueError, SimulationFailed) as failure:
            said = [f"the written file cannot be run: {failure}"]
        found = replace(found, notices=(*found.notices, *said), confirmed=not said)
    return Chosen(rated, chosen, found)
