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
from torchsoft.sysid.design_criterion import (
    PRICE,
    RTOL,
    DesignEvaluation,
    DesignEvaluator,
    Optimality,
    Range,
)
from torchsoft.sysid.initial_state import Standing
from torchsoft.sysid.measured import vocabulary
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.sentences import Finding
from torchsoft.sysid.synthetic import record
from torchsoft.sysid.unknowns import Sensor, Unknown
from torchsoft.tables import line

# Search of a motion by projected Adam on the smoothed criterion


RATE = 0.03
"""Largest move of a knot in an iteration, over the distance that speed allows between two."""

SMOOTHING = 0.02
"""Random shift of the knots, over that distance, at which the criterion is differentiated."""

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

    @classmethod
    def of(cls, seen: DesignEvaluation, iteration: int) -> "Visit":
        return cls(iteration, seen.value, max(seen.peaks.values(), default=0.0))


class Search(NamedTuple):
    """Outcome of a search: the coordinates of the best motion and its evaluation, those at the
    start, the visits, and the numbers of iterations and of failed runs."""

    z: Array
    best: DesignEvaluation
    first: DesignEvaluation
    history: list[Visit]
    iterations: int
    failed: int


def search(evaluator: DesignEvaluator, iterations: int, seed: int, progress: bool) -> Search:
    """Move the knots from the motion given, and keep the best evaluated motion, also on Ctrl-C.
    Raises `SimulationFailed` where the motion given cannot be run."""
    moves, rng, rate = evaluator.moves, np.random.default_rng(seed), RATE
    adam, z = ProjectedAdam(moves.start, moves.nearest, MEMORY), moves.start
    first = best = evaluator.evaluate(z)
    history, done, failed, in_a_row = [least := Visit.of(best, 0)], 0, 0, 0
    with (
        suppress(KeyboardInterrupt),
        tqdm(total=iterations, desc="design", disable=hidden(progress)) as bar,
    ):
        while done < iterations:
            try:
                shifted = moves.nearest(adam.z + SMOOTHING * rng.standard_normal(moves.n))
                slopes = evaluator.slopes(shifted, evaluator.evaluate(shifted))
            except (SimulationFailed, GradientFailed):
                failed, in_a_row = failed + 1, in_a_row + 1
                if in_a_row >= FAILURES:
                    in_a_row, rate = 0, 0.5 * rate
                    adam.set(z)
                continue
            done, in_a_row = done + 1, 0
            most, part = OUTLIER * float(np.median(np.abs(slopes))), done / iterations
            warm, cool = min(1.0, done / 5), 0.1 + 0.9 * (1 - part)
            adam.step(np.clip(slopes, -most, most), rate * warm * cool)
            if done % LOOK == 0 or done == iterations:
                with suppress(SimulationFailed):
                    seen = evaluator.evaluate(adam.z)
                    history.append(visit := Visit.of(seen, done))
                    if visit.score < least.score:
                        least, best, z = visit, seen, adam.z
            bar.set_postfix_str(f"criterion {least.value:.3f}", refresh=False)
            bar.update()
    return Search(z, best, first, history, done, failed)


# The design of a motion


LINEARIZATION_ERROR = 1.0
"""Largest error, in standard deviations, of a fit's Gauss-Newton step that is not reported."""

NEAR = 0.9
"""Fraction of its limit from which on a channel is reported."""


@dataclass(frozen=True)
class Design:
    """A designed motion and its information.

    `recording` follows it, with noiseless samples at the nominal parameters. `before` and `after`
    are the relative standard deviations with the motion given and with it, including the other
    recordings and priors. `history` has the criterion over the search, `limits` the active
    constraints of the knots, `findings` other facts about the search; `confirmed` is whether the
    rig file written of it, run again, has the same motion.
    """

    recording: Recording
    before: dict[str, float]
    after: dict[str, float]
    history: tuple[Visit, ...]
    limits: tuple[str, ...]
    findings: tuple[Finding, ...]
    made_by: dict[str, Any]

    @property
    def confirmed(self) -> bool:
        return not any(one.code == "design-file" for one in self.findings)

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
    rtol: float = RTOL,
    seed: int = 0,
    workers: int = 1,
    progress: bool = False,
) -> Design:
    """Move the knots of the recording `plan` of a problem to minimise the uncertainty of the
    parameters `names`, by default all.

    Of the plan's samples only the times count; the other recordings and the priors contribute their
    information. Faults of sensors are nuisances, which the criterion marginalises. Beside the
    covariance it counts errors of a fit from finite steps and nonlinear samples
    (`DesignEvaluator.errors`), at the nominal values. `criterion` is "D" (the volume of the errors)
    or "A" (their mean square). `bounds` holds the travel, speed and free knots of signals of the
    reference, `limits` the ranges (low, high) [unit] of channels of the run, such as forces.

    The search starts with the plan's own motion. Each of the `iterations` takes a run with
    sensitivities and 2 n with the adjoint, of relative tolerance `rtol`. A motion that cannot be
    run is skipped; on Ctrl-C the best so far is returned, with a finding. Raises `ValueError` for
    arguments that do not fit together, and where the plan itself cannot be run.
    """
    if plan not in problem.names:
        raise ValueError(
            f"`plan` must be one of the recordings {list(problem.names)}, but is {plan!r}"
        )
    if iterations < 0:
        raise ValueError(f"`iterations` must not be negative, but is {iterations}")
    if not bounds:
        raise ValueError("`bounds` names no signal whose knots may move")
    recording, started = problem.recordings[problem.names.index(plan)], clock.perf_counter()
    moves = Moves(recording.rig.reference, bounds, float(recording.times[-1]))
    evaluator = DesignEvaluator(problem, plan, moves, limits or {}, criterion, names, rtol, workers)
    try:
        found = search(evaluator, iterations, seed, progress)
    except SimulationFailed as failure:
        raise ValueError(
            f"the motion given cannot be run, so that nothing can begin with it: {failure}"
        ) from None
    return Design(
        recording=evaluator.made(found.z, found.best),
        before=found.first.deviations,
        after=found.best.deviations,
        history=tuple(found.history),
        limits=tuple(moves.active(found.z)),
        findings=tuple(search_findings(found, iterations, rtol)),
        made_by={
            "torchsoft": version("torchsoft"),
            "criterion": criterion,
            "bounds": {name: one.model_dump() for name, one in bounds.items()},
            "limits": evaluator.limits,
            "iterations": found.iterations,
            "rtol": rtol,
            "seed": seed,
            **evaluator.cost,
            "wall_s": clock.perf_counter() - started,
        },
    )


def search_findings(found: Search, iterations: int, rtol: float) -> Iterator[Finding]:
    """Findings on the best motion of a search, and on the search itself."""
    if found.iterations < iterations:
        facts = {"done": found.iterations, "iterations": iterations}
        yield Finding("design-interrupted", "note", facts)
    for name, part in found.best.peaks.items():
        if part > NEAR:
            facts = {"channel": name, "part": part}
            yield Finding("design-limit", "warning" if part > 1 else "note", facts)
    sds = found.best.deviations
    off = np.abs(found.best.errors).max(0) / [*sds.values()]
    if off.max() > LINEARIZATION_ERROR:
        facts = {"rtol": rtol, "off": float(off.max()), "estimate": [*sds][int(off.argmax())]}
        yield Finding("design-nonlinear", "note", facts)
    if found.failed:
        yield Finding("design-failed", "note", {"count": found.failed})


# Rehearsal of an experiment: simulated recordings with the sensors' noise, whose identification
# shows the information of the experiment before it is built.


FINER = 0.1
"""Tolerance of the simulated experiment, over the fit's."""


def planned(
    stated: Config,
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

    Returns the configuration of their identification, whose search starts away from the truth, and
    the files. Raises `ValueError`, and `SimulationFailed` for a motion that the rig cannot follow.
    """
    file = RigFile.from_toml(RigFile.path(stated.rig, config.parent))
    rtol, random = FINER * stated.fit.rtol, np.random.default_rng(stated.rehearsal.seed)
    own, paths = list[Entry](), list[Path]()
    for entry in stated.recordings or (Entry(name="rehearsal"),):
        name = entry.name or Path(entry.paths[0]).stem
        with at_field("settings"):
            built = file.changed(stated.settings).changed(entry.settings).build()
        try:
            made = planned(stated, built, name, rtol, entry.start, seed=random)
        except ValueError as error:
            raise ValueError(f"{config}: {error}") from None
        paths.append(out / f"{name}.csv")
        write_template(stated, made, paths[-1])
        own.append(entry.model_copy(update={"name": name, "file": None, "files": ()}))
    unknowns = dict(away(stated.unknowns, file, stated.rehearsal.away))
    return stated.model_copy(update={"recordings": tuple(own), "unknowns": unknowns}), paths


def write_template(stated: Config, made: Recording, path: Path) -> None:
    """Write a planned recording with the headings of a configuration."""
    rig, known = made.rig, vocabulary(made.rig, stated.columns)
    followed = rig.follow(torch.from_numpy(made.times)).detach()[..., 0].numpy().T
    columns = {"t": made.times} | dict(zip(rig.signals, followed))
    columns |= {channel: y for channel, (_, y) in made.samples.items()}
    units = {known.heading(one): known.units[one] for one in columns}
    csvfile.write(path, dict(zip(units, columns.values())), units)


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

SAME = 1e-6
"""Largest difference between a motion of the search and of the written file, over its largest
value."""


class Rated(NamedTuple):
    """A rated candidate: the criterion, a logarithm of standard deviations, the smaller the better;
    the relative standard deviations of the parameters, and the largest fraction of their limits
    that channels reach. `failure` is the reason of a failed run."""

    name: str
    value: float = np.inf
    deviations: Mapping[str, float] = {}
    peaks: Mapping[str, float] = {}
    failure: str = ""

    @property
    def score(self) -> float:
        """The criterion; infinite beyond a limit."""
        return np.inf if max(self.peaks.values(), default=0.0) > 1 else self.value


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
            if one.failure:
                cells = [f"cannot be made: {line(one.failure, 120)}"]
            cells += [f"{k} goes beyond its limits" for k, part in one.peaks.items() if part > 1]
            rows.append("  ".join([f"{one.name:{width}s} {one.value:9.3f}", *cells]))
        return "\n".join(rows)

    def summary(self) -> dict[str, Any]:
        """Content of `design.json`."""
        out: dict[str, Any] = {"candidates": [one._asdict() for one in self.rated]}
        if (one := self.found) is not None:
            history = [asdict(visit) for visit in one.history]
            said = [asdict(finding) | {"text": str(finding)} for finding in one.findings]
            own = {name: value for name, value in vars(one).items() if name != "recording"}
            out |= own | {"history": history, "findings": said, "confirmed": one.confirmed}
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
        problem, moves = (
            Problem([*recorded, one], sensors, unknowns),
            Moves(one.rig.reference, {}, 0.0),
        )
        evaluator = DesignEvaluator(
            problem, one.name, moves, limits or {}, criterion, names, rtol, workers
        )
        try:
            seen = evaluator.evaluate(np.zeros(0))
        except SimulationFailed as failure:
            rated.append(Rated(one.name, failure=str(failure)))
        else:
            rated.append(Rated(one.name, seen.value, seen.deviations, seen.peaks))
    return sorted(rated, key=lambda one: (one.score, one.value))


def candidates(
    config: Path, stated: Config
) -> tuple[dict[str, RigFile], dict[str, Recording], list[Rated]]:
    """Rig files of a configuration's candidates by name, their planned recordings, and those that
    cannot be run. Raises `ValueError` for settings that do not fit the rig file."""
    with at_field("settings"):
        file = RigFile.from_toml(RigFile.path(stated.rig, config.parent)).changed(stated.settings)
    files, made, failures = dict[str, RigFile](), dict[str, Recording](), list[Rated]()
    for name, settings in ({AS_STATED: {}} | stated.design.candidates).items():
        with at_field(f"design.candidates.{name}"):
            known = isinstance(settings, str)
            files[name] = excite(file, settings) if known else file.changed(settings)
            built = files[name].build()
        try:
            made[name] = planned(stated, built, name, stated.design.rtol, noise=0.0)
        except SimulationFailed as failure:
            failures.append(Rated(name, failure=str(failure)))
    return files, made, failures


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
    plan, (files, made, failures) = stated.design, candidates(config, stated)
    how: dict[str, Any] = plan.model_dump(include={"limits", "criterion", "rtol"})
    how |= {"names": plan.parameters or None, "workers": workers}
    rated = rank(recorded, [*made.values()], stated.sensors, stated.unknowns, **how) + failures
    best = rated[0].name
    if rated[0].failure:
        raise ValueError(f"{config}: no candidate can be made: {rated[0].failure}")
    if not plan.bounds:
        return Chosen(rated, files[best], None)
    problem = Problem([*recorded, made[best]], stated.sensors, stated.unknowns)
    how |= {"iterations": plan.iterations, "seed": plan.seed, "progress": progress}
    found = design(problem, best, plan.bounds, **how)
    moved = files[best].override(motion=knots(found.recording.rig.reference, plan.bounds))
    more = file_findings(stated, moved, found.recording)
    return Chosen(rated, moved, replace(found, findings=(*found.findings, *more)))


def file_findings(stated: Config, written: RigFile, found: Recording) -> Iterator[Finding]:
    """Findings on motions of a written file that are not those that the search found."""
    try:
        again = planned(stated, written.build(), found.name, stated.design.rtol, noise=0.0)
    except (ValueError, SimulationFailed) as failure:
        yield Finding("design-file", "warning", {"failure": str(failure)})
        return
    t = torch.from_numpy(found.times)
    motions = [one.rig.follow(t).detach()[..., 0].mT for one in (found, again)]
    for name, was, now in zip(found.rig.signals, *motions):
        off, most = float((now - was).abs().max()), float(was.abs().max())
        if not off <= SAME * most:
            yield Finding("design-file", "warning", {"signal": name, "off": off, "most": most})
