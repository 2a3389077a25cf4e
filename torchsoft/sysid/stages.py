"""Stages of a fit: recordings, free coordinates, ties and tolerances, in order.

A fit of everything at once, from far away, ends in a local minimum or in runs that cannot be
simulated. So the first stage fits the slowest recording, for its identifiable coordinates; the next
fits all recordings, with ratios (kinetic over static friction) tied at their upper bound, because
friction that does not fall with slip always has a solution; then each ratio is scanned and
everything is free. Tolerances are loose at first, and full in the last stage.
"""

import time as clock
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.stats import qmc
from tqdm import tqdm

from torchsoft.display import hidden
from torchsoft.sysid.fit import (
    SMALL_STEP,
    Check,
    Fit,
    Stage,
    Unreachable,
    chord,
    fisher,
    gauss_newton,
    shift,
    silent,
    standard_deviations,
)
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array, Mask
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import Coordinate
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


def tie_ratios(problem: Problem, x: Array) -> Array:
    """x with every free ratio at its upper bound."""
    x, (_, high) = x.copy(), problem.coordinates.bounds
    for i, c in enumerate(problem.coordinates.all):
        if c.ratio_to and not c.fixed:
            x[i] = high[i]
    return x


def visible(J: Array, candidates: Mask) -> Mask:
    """The largest set, found greedily, whose members all have standard deviations below
    `FIRST_LOOK` with the rest held."""
    out = candidates.copy()
    while out.any():
        sd = standard_deviations(J[:, out])
        if sd.max() <= FIRST_LOOK:
            break
        out[np.flatnonzero(out)[sd.argmax()]] = False
    return out


def informative(problem: Problem, which: Sequence[str]) -> Mask:
    """Mask (n,) of coordinates that recordings can constrain: not those of other recordings, nor of
    sensors that they lack."""
    channels = {channel for _, channel, _ in problem.measured(which)}
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
    tied_ratios, labels = [c.all[i] for i in np.flatnonzero(ratios)], np.array(c.labels, object)
    speed = {recording.name: recording.speed for recording in problem.recordings}
    order = sorted(which, key=lambda name: speed[name])
    loose, usual = max(LOOSE, rtol), max(USUAL, rtol)
    look = problem.residuals(runner, tie_ratios(problem, c.start), order[:1], loose, free)
    if look.failed:
        raise Unreachable(look.failed)
    ties = tuple((one.label, one.high) for one in tied_ratios)
    slowest, first = (order[0],), tuple(labels[visible(look.J, free & ~ratios)])
    plan = [
        Stage(f"{order[0]}: first look", slowest, first, loose, FIRST, 1e-2, ties, starts=starts)
    ]
    everything, tied = tuple(order), tuple(labels[free & ~ratios])
    if len(order) > 1 or ties:
        plan.append(Stage("all data, ratios tied", everything, tied, loose, ALL, 1e-2))
    scans = scanned(tied_ratios)
    every, last = (everything, tuple(labels[free])), rtol >= USUAL
    plan.append(Stage("everything", *every, usual, FREE, 1e-3 if last else 1e-2, scanned=scans))
    if not last:
        plan.append(Stage("everything, full tolerance", *every, rtol, LAST, 1e-3))
    return plan


def scanned(ratios: Sequence[Coordinate]) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """Values to scan of ratios, by label."""
    return tuple((one.label, tuple(part * one.high for part in SCANNED)) for one in ratios)


# Stages: ties, scans, starts, and a fit on frozen steps


def shown(label: str, work: Callable[[Fit], Fit], fit: Fit) -> Fit:
    """Work on a fit with a progress bar, unless its evaluations are notified elsewhere."""
    if fit.notify is not silent:
        return work(fit)
    with tqdm(desc=plain(label), unit=" evaluations", disable=hidden(fit.progress)) as bar:

        def notify(chi2: float) -> None:
            bar.set_postfix_str(f"chi2 = {chi2:.4g}", refresh=False)
            bar.update()

        return work(fit._replace(notify=notify))._replace(notify=silent)


def run_plan(start: Fit, plan: Sequence[Stage], *, seed: int = 0, label: str = "") -> Fit:
    """Fit stage after stage, each from the end of the one before; the end of the last that could
    start.

    A stage that cannot be simulated where the one before it ended, and repeats it by a finer
    tolerance, ends the plan as `Fit.failure`; any other starts again from the start. Raises
    `Unreachable` where it cannot be simulated there, and `ValueError` for a plan without stages.
    """
    if not plan:
        raise ValueError("`plan` has no stages")
    end = start
    for number, stage in enumerate(plan):
        started, title = clock.perf_counter(), f"{label}{number + 1}/{len(plan)} {stage.name}"
        work = partial(run_stage, seed=seed + number)
        try:
            fit = shown(title, work, end._replace(stage=stage))
        except Unreachable as failure:
            if number == 0:
                raise
            if (stage.recordings, stage.free) == (end.which, end.stage.free):
                return end._replace(failure=failure)
            fit = shown(title, work, start._replace(stage=stage, stages=end.stages))
        end = fit.noted(stage.name, started)
    return end


def continued(fit: Fit, *plan: Stage) -> Fit | None:
    """The end of a plan from a fit; None where it cannot start there."""
    with suppress(Unreachable):
        return run_plan(fit, plan)
    return None


def run_stage(fit: Fit, seed: int) -> Fit:
    """The fit's stage from where it is: ties, scans, and fits from Sobol starts, each on the steps
    of its start; returns the best. Raises `Unreachable` where no start can be simulated."""
    c, stage, x = fit.problem.coordinates, fit.stage, fit.x.copy()
    for label in (*stage.free, *(label for label, _ in (*stage.tied, *stage.scanned))):
        if label not in c.labels:
            raise ValueError(
                f"stage `{stage.name}` names {label!r}; the coordinates are {', '.join(c.labels)}"
            )
    for label, value in stage.tied:
        i = c.labels.index(label)
        x[i] = c.all[i].to_x(value)
    for label, values in stage.scanned:
        x = scan(fit._replace(x=x), c.labels.index(label), values)
    fits, failures = list[Fit](), list[Unreachable]()
    for start in (x, *sobol(fit._replace(x=x), seed)):
        try:
            fits.append(iterated(fit.evaluated(start)))
        except Unreachable as error:
            failures.append(error)
    if not fits:
        raise failures[0]
    return min(fits, key=lambda one: one.chi2)


def iterated(fit: Fit) -> Fit:
    """The fit of its stage, on its steps."""
    return gauss_newton(fit, fit.stage.evaluations, fit.stage.tolerance)


def scan(fit: Fit, i: int, values: Sequence[float]) -> Array:
    """x (n,) with the best of some values for the ratio i, and of `SPLITS` for its denominator; all
    are run side by side."""
    problem, stage, x = fit.problem, fit.stage, fit.x
    rtol, c = max(LOOSE, stage.rtol), problem.coordinates.all
    now, trials = c[i].to_value(x[i]), list[Array]()
    below = [
        j
        for j, one in enumerate(c)
        if one.name == c[i].ratio_to
        and one.label in stage.free
        and one.recording in (None, c[i].recording)
    ]
    for value, split in product(values, SPLITS if below else SPLITS[:1]):
        if split and value == now:
            continue
        trials.append(x.copy())
        trials[-1][i] = c[i].to_x(value)
        for j in below:
            moved = c[j].to_value(x[j]) * (now / value) ** split
            trials[-1][j] = c[j].to_x(float(np.clip(moved, c[j].low, c[j].high)))
    jobs = [problem.jobs(trial, fit.which, rtol, None) for trial in trials]
    runs = iter(fit.runner.run([job for some in jobs for job in some]))
    misfits = []
    for trial, some in zip(trials, jobs):
        misfits.append(
            float(np.mean(problem.gather(trial, some, [next(runs) for _ in some]).r ** 2))
        )
        fit.notify(misfits[-1])
    return trials[int(np.argmin(misfits))]


def sobol(fit: Fit, seed: int) -> list[Array]:
    """`stage.starts` - 1 further points within the stage's spread of x, in the fitted coordinates
    and within their bounds."""
    count, c = fit.stage.starts - 1, fit.problem.coordinates
    if not count:
        return []
    reach = np.array([np.log(fit.stage.spread) if one.scale == "log" else 0.5 for one in c.all])
    low, high = np.maximum(c.bounds[0], fit.x - reach), np.minimum(c.bounds[1], fit.x + reach)
    free = fit.free
    sequence = qmc.Sobol(int(free.sum()), rng=np.random.default_rng(seed))
    points = sequence.random_base2(count.bit_length())[:count]
    return [fit.place(low[free] + u * (high - low)[free]) for u in points]


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


def jacobian_error(J: Array, exact: Array) -> float:
    """Largest error of a Jacobian J (m, n) along one standard deviation of a coordinate."""
    C = fisher(exact)[0]
    seen = np.sqrt(np.diag(C)) <= FIRST_LOOK
    steps = (C / np.sqrt(np.diag(C)))[:, seen]
    return float(np.linalg.norm((J - exact) @ steps, axis=0).max(initial=0.0))


def continued_on(fit: Fit, steps: Residuals, name: str) -> Fit:
    """The fit, continued on other steps from the residuals on them, with new Jacobians where the
    last one does not suffice; the same fit where no coordinate moves."""
    started, end = clock.perf_counter(), chord(fit._replace(at=steps._replace(J=fit.at.J)))
    if not end.converged:
        end = gauss_newton(end, REFITS, EXACT, anew=True)
    return end.noted(name, started) if (end.x != fit.x).any() else fit


class StepEffect(NamedTuple):
    """Effect of finer steps on a fit: the shift of every coordinate (n,), its size and that by
    steps chosen anew, in standard deviations, and the error of the Jacobian."""

    bias: Array
    finer: float
    anew: float
    jacobian_error: float

    @property
    def small(self) -> bool:
        """Whether the tolerance is fine enough."""
        return self.finer <= STEP_BIAS and self.jacobian_error <= JACOBIAN_ERROR


def step_effect(fit: Fit, fresh: Residuals, finer: Residuals) -> StepEffect:
    """Effect of steps chosen anew, and of those at a tenth of the tolerance."""
    J, bias = finer.J[:, fit.free], np.zeros(len(fit.x))
    sd, bias[fit.free] = standard_deviations(J), shift(J, finer.r - fit.at.r)
    anew = float((np.abs(shift(J, fresh.r - fit.at.r)) / sd).max())
    return StepEffect(
        bias, float((np.abs(bias[fit.free]) / sd).max()), anew, jacobian_error(fit.J, J)
    )


def rough_coordinates(end: Fit) -> tuple[str, ...]:
    """Coordinates that would still move, the largest move first."""
    moves = np.abs(end.newton_step()) / end.sd
    order = np.argsort(-moves)[: int(np.sum(moves > SMALL_STEP))]
    return tuple(end.labels[i] for i in order)


def refine_steps(fit: Fit, tightenings: int) -> Fit:
    """Continue a fit with its Jacobian and a few runs: on steps chosen anew until they do not
    matter, and with a tighter tolerance, at most `tightenings` times, where a tenth of it shifts an
    estimate by more than `STEP_BIAS` or shows an error of the Jacobian above `JACOBIAN_ERROR`, or
    where steps keep the fit from converging. With no tightenings the steps are kept, and only
    checked.

    At the end residuals are those on steps that the tolerance chooses there, where these can be
    run, and the Jacobian is that of the check. It has converged if with steps chosen anew no
    coordinate would move by more than `SMALL_STEP` standard deviations (where steps are only
    checked, if it had before).
    """
    left, rounds = tightenings, ROUNDS if tightenings else 0
    while True:
        fresh = fit.residuals(steps=fit.rtol)
        if fresh.failed:
            return fit._replace(converged=False, check=Check(fit.rtol, fit.at))
        end = fit._replace(at=fresh._replace(J=fit.at.J))
        end = end._replace(converged=end.step_is_small if tightenings else fit.converged)
        if rounds and not end.converged:
            rounds -= 1
            moved = continued_on(fit, fresh, "steps chosen anew")
            if moved is not fit:
                fit, rounds, left = moved, *((0, 0) if moved.stalled else (rounds, left))
                continue
        finer = fit.residuals(steps=FINER * fit.rtol, jacobian=True)
        if finer.failed:
            return end._replace(check=Check(fit.rtol, end.at))
        effect, rough = step_effect(fit, fresh, finer), tuple[str, ...]()
        error = effect.jacobian_error
        fit, end = (one._replace(at=one.at._replace(J=finer.J)) for one in (fit, end))
        if not end.converged and tightenings and max(effect.anew, effect.finer) <= SMALL_STEP:
            rough = rough_coordinates(end)
        elif left and not (end.converged and effect.small):
            left, rounds, tighter = left - 1, ROUNDS, fit.by(FINER * fit.rtol)
            moved = continued_on(tighter, finer, "tighter tolerance")
            if moved is not tighter:
                fit, rounds, left = moved, *((0, 0) if moved.stalled else (rounds, left))
                continue
            error = 0.0
        return end._replace(check=Check(end.rtol, finer, effect.bias, error, rough))
