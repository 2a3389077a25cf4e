"""Stages of a fit: recordings, free coordinates, ties and tolerances, in order.

A fit of everything at once, from far away, ends in a local minimum or in runs that cannot be
simulated. So the first stage fits the slowest recording, for its identifiable coordinates; the next
fits all recordings, with ratios (kinetic over static friction) tied at their upper bound, because
friction that does not fall with slip always has a solution; then each ratio is scanned and
everything is free. Tolerances are loose at first, and full in the last stage.
"""

import time as clock
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc
from tqdm import tqdm

from torchsoft.display import hidden
from torchsoft.sysid.fit import (
    SETTLED,
    Fit,
    Loss,
    Notify,
    Unreachable,
    chord,
    descend,
    fisher,
    gauss_newton,
    newton_step,
    settled,
    shift,
    standard_deviations,
)
from torchsoft.sysid.prediction import Frozen
from torchsoft.sysid.problem import Problem, Residuals, StepsByName
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import Runner
from torchsoft.tables import plain

FIRST_LOOK = 0.1
"""Largest predicted standard deviation [1] of a coordinate in the first stage: one that is barely
identifiable would compensate for errors elsewhere."""

LOOSE, USUAL = 1e-3, 1e-4
"""Relative tolerances of the stages with tied ratios, and of those between them and the last
one."""

FIRST, ALL, FREE, LAST = 8, 15, 30, 20
"""Most evaluations of each stage."""

SCANNED = (1.0, 0.85, 0.7, 0.55)
"""Fractions of its upper bound at which a ratio is tried before it is free."""

SPLITS = (0.0, 0.5)
"""Exponents of a ratio's change by which its denominator changes inversely in these trials: with 0
it stays, with 1/2 the product with the numerator does. Coefficients of friction that were fitted as
one lie between the two."""


@dataclass(frozen=True)
class Stage:
    """One fit: recordings, free coordinates by label, the relative tolerance that chooses its
    steps, limits of its iteration, and coordinates to set or scan before it.

    `tied` sets coordinates to values; `scanned` tries each value of a ratio with the relative
    tolerance `LOOSE`, the others held but for its denominator, and keeps the best. With `starts`
    above one, that many Sobol points within a factor `spread` of the start are fitted, and the best
    end is kept.
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


def visible(J: Array, candidates: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest set, found greedily, whose members all have standard deviations below
    `FIRST_LOOK` with the rest held."""
    out = candidates.copy()
    while out.any():
        sd = standard_deviations(J[:, out])
        if sd.max() <= FIRST_LOOK:
            break
        out[np.flatnonzero(out)[sd.argmax()]] = False
    return out


def informative(problem: Problem, which: Sequence[str]) -> NDArray[np.bool_]:
    """Mask (n,) of coordinates that recordings can constrain: not those of other recordings, nor of
    sensors that they lack."""
    channels = {
        channel
        for recording in problem.recordings
        if recording.name in which
        for channel in recording.samples
    }
    return np.array(
        [
            one.recording in (None, *which) and (one.of_the_rig or one.name in channels)
            for one in problem.coordinates.all
        ]
    )


def default_plan(
    problem: Problem, runner: Runner, rtol: float, which: Sequence[str], starts: int = 1
) -> list[Stage]:
    """Stages for some recordings; the first fits the slowest one, with the coordinates that its
    Fisher matrix at the start makes identifiable.

    Raises `Unreachable` where that recording cannot be simulated from the start.
    """
    c, free = problem.coordinates, problem.coordinates.free & informative(problem, which)
    ratios = np.array([bool(one.ratio_to) for one in c.all]) & free
    x, labels = tie_ratios(problem, c.start), np.array(c.labels, object)
    speed = {recording.name: recording.speed for recording in problem.recordings}
    order = sorted(which, key=lambda name: speed[name])
    loose, usual = max(LOOSE, rtol), max(USUAL, rtol)
    look = problem.residuals(runner, x, order[:1], loose, free)
    if look.failed:
        raise Unreachable(look.failed)
    ties = tuple((c.all[i].label, c.all[i].high) for i in np.flatnonzero(ratios))
    slowest, first = (order[0],), tuple(labels[visible(look.J, free & ~ratios)])
    plan = [
        Stage(f"{order[0]}: first look", slowest, first, loose, FIRST, 1e-2, ties, starts=starts)
    ]
    if len(order) > 1 or ratios.any():
        plan.append(
            Stage(
                "all data, ratios tied",
                tuple(order),
                tuple(labels[free & ~ratios]),
                loose,
                ALL,
                1e-2,
            )
        )
    scans = tuple(
        (c.all[i].label, tuple(part * c.all[i].high for part in SCANNED))
        for i in np.flatnonzero(ratios)
    )
    every, last = (tuple(order), tuple(labels[free])), rtol >= USUAL
    plan.append(Stage("everything", *every, usual, FREE, 1e-3 if last else 1e-2, scanned=scans))
    if not last:
        plan.append(Stage("everything, full tolerance", *every, rtol, LAST, 1e-3))
    return plan


# Stages: ties, scans, starts, and a fit on frozen steps


Method = Literal["gauss_newton", "lbfgs", "adam"]


def stage_entry(
    name: str, stage: Stage, rtol: float, fit: Fit, began: float, ended: float
) -> dict[str, Any]:
    """The result's entry on a stage, with its begin and end on the clock [s]."""
    return {
        "name": name, "recordings": list(stage.recordings), "free": list(stage.free), "rtol": rtol,
        "evaluations": fit.evaluations, "chi2": fit.chi2, "converged": fit.converged,
        "wall_s": ended - began,
    }  # fmt: skip


@contextmanager
def progress_bar(label: str, shown: bool) -> Iterator[Notify]:
    """A progress bar of one stage. Yields a function to call with chi2 after every evaluation."""
    with tqdm(desc=plain(label), unit=" evaluations", disable=hidden(shown)) as bar:

        def notify(chi2: float) -> None:
            bar.set_postfix_str(f"chi2 = {chi2:.4g}", refresh=False)
            bar.update()

        yield notify


class PlanEnd(NamedTuple):
    """End of a plan: the fit of the last stage that could begin, that stage, the result's entries
    on all stages, and the error of the stage after it."""

    fit: Fit
    stage: Stage
    entries: list[dict[str, Any]]
    failure: Unreachable | None = None

    @property
    def notices(self) -> list[str]:
        """Sentences where the last stage made no headway, and where a finer one could not begin."""
        if self.failure is None:
            return self.fit.notices
        return [
            *self.fit.notices,
            f"the fit ended by rtol = {self.stage.rtol:g}: by a finer tolerance {self.failure}; "
            "the model may lack something that drives its parameters to where it has no solution",
        ]


def run_plan(
    problem: Problem, runner: Runner, plan: Sequence[Stage], x: Array, *, loss: Loss = "linear",
    method: Method = "gauss_newton", seed: int = 0, label: str = "", progress: bool = False,
    notify: Notify | None = None,
) -> PlanEnd:  # fmt: skip
    """Fit stage after stage, each from the end of the one before, the first from x.

    A stage that cannot be simulated where the one before it ended, and repeats it by a finer
    tolerance, ends the plan; any other begins again from x. Raises `Unreachable` where it cannot be
    simulated there, and `ValueError` for a plan without stages.
    """
    end: PlanEnd | None = None
    for number, stage in enumerate(plan):
        began = clock.perf_counter()
        with progress_bar(f"{label}{number + 1}/{len(plan)} {stage.name}", progress) as bar:
            rest = loss, method, seed + number, notify or bar
            begin = end.fit.x if end is not None else x
            try:
                fit = run_stage(problem, runner, stage, begin, *rest)
            except Unreachable as failure:
                if end is None:
                    raise
                if (stage.recordings, stage.free) == (end.stage.recordings, end.stage.free):
                    return end._replace(failure=failure)
                fit = run_stage(problem, runner, stage, x, *rest)
        entry = stage_entry(stage.name, stage, stage.rtol, fit, began, clock.perf_counter())
        end = PlanEnd(fit, stage, [*end.entries, entry] if end is not None else [entry])
    if end is None:
        raise ValueError("`plan` has no stages")
    return end


def run_stage(
    problem: Problem,
    runner: Runner,
    stage: Stage,
    x: Array,
    loss: Loss,
    method: Method,
    seed: int,
    notify: Any,
) -> Fit:
    """One stage from x: ties, scans, and fits from Sobol starts, each on the steps of its start;
    returns the best. Raises `Unreachable` where no start can be simulated."""
    c = problem.coordinates
    for label in (*stage.free, *(label for label, _ in (*stage.tied, *stage.scanned))):
        if label not in c.labels:
            raise ValueError(
                f"stage `{stage.name}` names {label!r}; the coordinates are {', '.join(c.labels)}"
            )
    free, x = np.isin(c.labels, stage.free), x.copy()
    for label, value in stage.tied:
        i = c.labels.index(label)
        x[i] = c.all[i].to_x(value)
    for label, values in stage.scanned:
        x = scan(problem, runner, stage, x, c.labels.index(label), values, notify)
    best: Fit | None = None
    failure: Unreachable | None = None
    for start in (x, *sobol(problem, x, free, stage, seed)):
        try:
            jacobian = free if method == "gauss_newton" else None
            first, steps = problem.freeze(runner, start, stage.recordings, stage.rtol, jacobian)
            if first.failed:
                raise Unreachable(first.failed)
            fit = on_steps(problem, runner, stage, start, steps, loss, method, notify, first)
        except Unreachable as error:
            failure = failure or error
            continue
        if best is None or fit.chi2 < best.chi2:
            best = fit
    if best is None:
        assert failure is not None
        raise failure
    return best


def on_steps(
    problem: Problem, runner: Runner, stage: Stage, x: Array, steps: StepsByName, loss: Loss,
    method: Method, notify: Notify, first: Residuals | None = None,
) -> Fit:  # fmt: skip
    """The fit of a stage from x on frozen steps; `first` holds residuals and Jacobian at x, if
    known."""
    common: dict[str, Any] = {
        "which": stage.recordings, "free": np.isin(problem.coordinates.labels, stage.free),
        "steps": steps, "notify": notify,
    }  # fmt: skip
    if method == "gauss_newton":
        return gauss_newton(
            problem, runner, x, evaluations=stage.evaluations, tolerance=stage.tolerance,
            loss=loss, first=first, **common,
        )  # fmt: skip
    return descend(problem, runner, x, method=method, evaluations=4 * stage.evaluations, **common)


def scan(
    problem: Problem,
    runner: Runner,
    stage: Stage,
    x: Array,
    i: int,
    values: Sequence[float],
    notify: Notify,
) -> Array:
    """x with the best of some values for the ratio i, and of `SPLITS` for its denominator; all are
    run side by side."""
    rtol, c = max(LOOSE, stage.rtol), problem.coordinates.all
    now, trials = c[i].to_value(x[i]), list[Array]()
    below = [
        j for j, one in enumerate(c) if one.name == c[i].ratio_to and one.label in stage.free
        and one.recording in (None, c[i].recording)
    ]  # fmt: skip
    for value, split in product(values, SPLITS if below else SPLITS[:1]):
        if split and value == now:
            continue
        trials.append(x.copy())
        trials[-1][i] = c[i].to_x(value)
        for j in below:
            moved = c[j].to_value(x[j]) * (now / value) ** split
            trials[-1][j] = c[j].to_x(float(np.clip(moved, c[j].low, c[j].high)))
    jobs = [problem.jobs(trial, stage.recordings, rtol, None) for trial in trials]
    runs = iter(runner.run([job for some in jobs for job in some]))
    misfits = []
    for trial, some in zip(trials, jobs):
        misfits.append(
            float(np.mean(problem.gather(trial, some, [next(runs) for _ in some]).r ** 2))
        )
        notify(misfits[-1])
    return trials[int(np.argmin(misfits))]


def sobol(
    problem: Problem, x: Array, free: NDArray[np.bool_], stage: Stage, seed: int
) -> list[Array]:
    """`stage.starts` - 1 further points within the stage's spread of x, in the free coordinates and
    within their bounds."""
    if stage.starts == 1:
        return []
    low, high = problem.coordinates.bounds
    reach = np.array(
        [np.log(stage.spread) if c.scale == "log" else 0.5 for c in problem.coordinates.all]
    )
    low, high = np.maximum(low, x - reach), np.minimum(high, x + reach)
    power = (stage.starts - 1).bit_length()
    points = qmc.Sobol(int(free.sum()), rng=np.random.default_rng(seed)).random_base2(power)[
        : stage.starts - 1
    ]
    out = []
    for u in points:
        start = x.copy()
        start[free] = low[free] + u * (high - low)[free]
        out.append(start)
    return out


# Steps at the end of a fit


STEP_BIAS = 0.5
"""Largest shift of an estimate by finite steps, in standard deviations, before the tolerance counts
as too coarse."""

FINER = 0.1
"""Tolerance of the check, over the tolerance under check."""

JACOBIAN_ERROR = 0.3
"""Largest error of a Jacobian along one standard deviation of a coordinate, in units of the noise,
before the tolerance counts as too coarse: at 0.3 a standard deviation is up to 5 % too small, and
the scatter of the estimate up to 5 % larger."""

REFITS, EXACT = 15, 1e-6
"""Most evaluations with new Jacobians in the final fit, and its relative tolerance."""

ROUNDS = 3
"""Most fits that continue with steps chosen anew at their end."""


class Settled(NamedTuple):
    """End of a fit whose steps were checked: coordinates x (n,), residuals there on steps that
    `rtol` chooses at x, with the last Jacobian.

    `bias` is the shift of every coordinate (n,) by finite steps, None where it could not be
    checked; `jacobian_error` is that of `JACOBIAN_ERROR`, for `rtol`; `fits` are the fits on other
    steps since, with their tolerances and their end on the clock [s]; `finer` are residuals and
    Jacobian with a tenth of the tolerance, or those of `at` where such runs fail. `at_rest` is
    whether with steps chosen anew no coordinate would move by more than `SETTLED` standard
    deviations (where steps are only checked, whether the fit has converged). `rough` names the
    coordinates that would move although steps do not matter, the largest move first: samples are
    not smooth in them. `steps` are those of `at` where runs with steps chosen anew fail.
    """

    x: Array
    at: Residuals
    rtol: float
    bias: Array | None
    fits: list[tuple[float, Fit, float]]
    finer: Residuals
    at_rest: bool
    rough: tuple[str, ...] = ()
    steps: Mapping[str, Frozen] | None = None
    jacobian_error: float = 0.0


def jacobian_error(J: Array, exact: Array) -> float:
    """Largest error of a Jacobian J (m, n) along one standard deviation of a coordinate."""
    C = fisher(exact)[0]
    seen = np.sqrt(np.diag(C)) <= FIRST_LOOK
    steps = (C / np.sqrt(np.diag(C)))[:, seen]
    return float(np.linalg.norm((J - exact) @ steps, axis=0).max(initial=0.0))


def settle(
    problem: Problem,
    runner: Runner,
    stage: Stage,
    fit: Fit,
    free: NDArray[np.bool_],
    tightenings: int,
    notify: Notify,
) -> Settled:
    """Continue a fit with its Jacobian and a few runs: on steps chosen anew until they do not
    matter, and with a tighter tolerance, at most `tightenings` times, where a tenth of it shifts an
    estimate by more than `STEP_BIAS` or shows an error of the Jacobian above `JACOBIAN_ERROR`, or
    where steps keep the fit from settling. The Jacobian at the end is that of the check. With no
    tightenings the steps are kept, and only checked."""
    x, which, rtol, left, fits = fit.x, stage.recordings, stage.rtol, tightenings, []
    at = fit.at
    rounds = ROUNDS if tightenings else 0

    def along(start: Residuals, steps: StepsByName) -> bool:
        """Fit on other steps from residuals on them, with new Jacobians where the last one does not
        suffice; returns whether the coordinates changed."""
        nonlocal x, at, rounds, left
        common: dict[str, Any] = {"which": which, "free": free, "steps": steps, "notify": notify}
        end = chord(problem, runner, x, start._replace(J=at.J), **common)
        if not end.converged:
            end = gauss_newton(
                problem, runner, end.x, evaluations=REFITS, tolerance=EXACT, **common
            )
        if end.stalled:
            rounds = left = 0
        if further := bool((end.x != x).any()):
            fits.append((rtol, end, clock.perf_counter()))
            x, at = end.x, end.at
        return further

    while True:
        fresh, steps = problem.freeze(runner, x, which, rtol)
        if fresh.failed:
            own = fits[-1][1].steps if fits else fit.steps
            return Settled(
                x, at, rtol, None, fits, at, at_rest=False,
                steps=own if isinstance(own, Mapping) else None,
            )  # fmt: skip
        end = fresh._replace(J=at.J)
        at_rest = settled(problem, x, end, free) if tightenings else fit.converged
        if rounds and not at_rest:
            rounds -= 1
            if along(fresh, steps):
                continue
        finer, steps = problem.freeze(runner, x, which, FINER * rtol, free)
        if finer.failed:
            return Settled(x, end, rtol, None, fits, end, at_rest)
        J, bias = finer.J[:, free], np.zeros(len(x))
        error = jacobian_error(at.J[:, free], J)
        bias[free], sd = shift(J, finer.r - at.r), standard_deviations(J)
        anew = np.abs(shift(J, fresh.r - at.r)) / sd
        shifts, rough = np.abs(bias[free]) / sd, tuple[str, ...]()
        at, end = (one._replace(J=finer.J) for one in (at, end))
        if not at_rest and tightenings and max(anew.max(), shifts.max()) <= SETTLED:
            moves = np.abs(newton_step(problem, x, end, free)) / sd
            order = np.argsort(-moves)[: int(np.sum(moves > SETTLED))]
            rough = tuple(np.array(problem.coordinates.labels)[free][order].tolist())
        elif left and not (at_rest and shifts.max() <= STEP_BIAS and error <= JACOBIAN_ERROR):
            left, rounds, rtol = left - 1, ROUNDS, FINER * rtol
            if along(finer, steps):
                continue
            rtol, error = rtol / FINER, 0.0
        return Settled(x, end, rtol, bias, fits, finer, at_rest, rough, jacobian_error=error)
