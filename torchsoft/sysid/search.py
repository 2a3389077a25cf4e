"""Search for the cause of a misfit: refits with one suspect free after the other.

1. Score tests of all suspects order them: those that would explain most come first, and those with
   costly runs last.
2. Successive halving: every suspect of a bracket gets one step; then the best third goes on with
   three times as many evaluations, until a few finalists are left. The likeliest by its score test
   is a finalist, too, and so are those whose score tests explain as much as the best fit.
3. Finalists are fitted until they converge, on fine steps, the best one first. The search ends
   after a bracket in which one explains the misfit, or when refits took all of the effort and none
   does.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from torchsoft.display import hidden
from torchsoft.sysid.assumption_tests import EVIDENT, AssumptionTest, Linearised
from torchsoft.sysid.assumptions import AMOUNTS, Suspect
from torchsoft.sysid.fit import Fit, Stage, Unreachable, gauss_newton
from torchsoft.sysid.prediction import Frozen
from torchsoft.sysid.problem import DIFFERENCE, Problem, check_possible
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.runs import EARLY
from torchsoft.sysid.stages import LOOSE, USUAL, continued, continued_on, refine_steps, scanned
from torchsoft.sysid.unknowns import FAULTS, Unknown
from torchsoft.tables import plain

BRACKET, FINALISTS = 16, 3
"""Suspects of a bracket, and those of it that are fitted until they converge."""

FAR = 2.0
"""Misfit per sample above which rounds of halving have steps of the tolerance `LOOSE`, whose errors
are small beside the misfit."""

FAINT = 0.05
"""Part of the misfit above the noise that a suspect explains by its score test to be in the first
bracket, however large that is: far from the data score tests order suspects wrongly, and causes had
0.16 and more. A refit that leaves as little, besides chance, may explain the misfit."""

KEPT = 3
"""One in so many suspects goes on after a round, with so many times as many evaluations."""

COMPLETE, ROUGH = 20, 1e-3
"""Most evaluations of a finalist, and its relative tolerance."""

TIGHTENINGS = 2
"""Most times that a finalist goes on with a tenth of its tolerance."""

UNLIKELY = 3.0
"""Standard deviations of a sum of squares that count as chance."""

COMPARABLE = 2 * EVIDENT
"""A finalist that leaves more than this beyond the best one is stopped: `EVIDENT`, and as much for
the error of its steps."""

PARTS = (1.0, 0.25, 0.0625)
"""Parts of the first step that are tested."""

FIRST_STEP = 1.0
"""Longest first step of the fitted coordinates together."""

NEARLY = 0.99
"""Part of the misfit above the noise from which on a suspect seems to explain it."""

RIVAL = 0.5
"""Part of the gain of such a suspect from which on another is its rival."""

HALVINGS = 10
"""Most halvings of the range of a suspect where the rig is impossible at its end."""


# A suspect becomes free


def problem_with(problem: Problem, *some: Suspect, held: bool = False) -> Problem:
    """The problem with the coordinates of some suspects, which are free unless `held`; that of an
    alternative that holds or does not is held always. Raises `ValueError` where one cannot be."""
    unknowns, sensors, fixed = dict(problem.unknowns), dict(problem.sensors), set(problem.held)
    alternatives = [*problem.alternatives.values()]
    longest = max(1.0, *(recording.duration for recording in problem.recordings))
    for one in some:
        if held or not one.has_amount:
            fixed.add(one.label)
        if one.extension or (one.parameter and held and one.nominal > 0):
            unknowns[one.parameter] = Unknown()
        elif one.parameter:
            unknowns[one.parameter] = unknown_near(problem.recordings, one)
        elif one.fault is not None:
            channel, kind = one.fault
            most = FAULTS[kind].most * FAULTS[kind].scale(sensors[channel], longest)
            sensors[channel] = sensors[channel].model_copy(update={kind: most})
        else:
            alternatives.append(one)
    return Problem(problem.recordings, sensors, unknowns, problem.noise, alternatives, fixed)


def unknown_near(recordings: Sequence[Recording], one: Suspect) -> Unknown:
    """The parameter of a suspect as an unknown, from its stated value. Raises `ValueError`."""
    reach = AMOUNTS * one.step / one.nominal
    low, high = sorted(
        farthest(recordings, one.parameter, one.nominal, part) for part in (-reach, reach)
    )
    scale = "log" if low > 0 else "linear"
    return Unknown(nominal=one.nominal, low=low, high=high, scale=scale)


def farthest(recordings: Sequence[Recording], name: str, value: float, part: float) -> float:
    """A parameter changed by a relative `part`, halved until the rig is possible: kinetic friction
    must not exceed static friction. Raises `ValueError` where it never is."""
    for _ in range(HALVINGS):
        with suppress(ValueError):
            for recording in recordings:
                check_possible(recording, {name: value * (1 + part)})
            return value * (1 + part)
        part /= 2
    raise ValueError(f"{name} = {value:g} can hardly be varied")


def fit_with(end: Fit, one: Suspect) -> Fit:
    """The fit with a suspect free, at its end and at the suspect's neutral value; an alternative
    that holds or does not is in force. Raises `ValueError` for one that cannot be free."""
    problem = problem_with(end.problem, one)
    c = problem.coordinates
    x, i = c.with_known(end.by_label), c.labels.index(one.label)
    x[i] = c.all[i].to_x(one.nominal if one.has_amount else 1.0)
    labels = (*end.labels, *(one.label for _ in range(one.has_amount)))
    stage = Stage(one.name, end.which, labels, end.rtol, COMPLETE, ROUGH)
    return Fit(problem, problem.runner(end.runner), x, stage, loss=end.loss, notify=end.notify)


# Columns of suspects


def coarsened(end: Fit) -> Fit:
    """The end of a fit at the tolerance of score tests: `USUAL`, or its own if such runs fail. Its
    `check` has the tolerance of the fit, and the residuals that are tested. A fit whose steps could
    not be checked stays on them."""
    if end.check.bias is None:
        return end._replace(at=end.check.finer)
    usual = max(end.rtol, USUAL)
    base = end.residuals(steps=usual)
    if base.failed and usual > end.rtol:
        usual = end.rtol
        base = end.residuals(steps=usual)
    return end.by(usual)._replace(at=base)


Column = tuple[Suspect, Array | None, str]
"""A suspect with the change of the residuals (m,) by its amount, or None and the reason."""


def exact_columns(end: Fit, some: Sequence[Suspect]) -> tuple[list[Column], Array | None]:
    """Columns of suspects that are coordinates, and the Jacobian (m, n) of the fitted coordinates,
    from one run of each recording."""
    mine, out = [one for one in some if one.change is None], list[Column]()
    try:
        wide = problem_with(end.problem, *mine, held=True)
    except ValueError:  # which suspects cannot be
        reasons = {one.name: impossible(end.problem, one) for one in mine}
        out += [(one, None, reasons[one.name]) for one in mine if reasons[one.name]]
        mine = [one for one in mine if not reasons[one.name]]
        wide = problem_with(end.problem, *mine, held=True)
    c = wide.coordinates
    names = np.isin(c.labels, [*end.labels, *(one.label for one in mine)])
    x = c.with_known(end.by_label)
    at = wide.residuals(wide.runner(end.runner), x, end.which, end.at.steps, names)
    if at.failed:
        return [*out, *((one, None, at.reason) for one in mine)], None
    for one in mine:
        i = c.labels.index(one.label)
        out.append((one, at.J[:, i] * (one.step / c.all[i].slope(x[i])), ""))
    return out, at.J[:, [c.labels.index(label) for label in end.labels]]


def impossible(problem: Problem, one: Suspect) -> str:
    """Why a suspect cannot be a coordinate; empty if it can."""
    try:
        problem_with(problem, one, held=True)
    except ValueError as error:
        return str(error)
    return ""


def difference_column(end: Fit, one: Suspect) -> Column:
    """Column of an alternative, from a run of each recording on the same steps. That of one of
    either sign is by a part of its amount: coordinates take most of an effect, and what its
    curvature leaves must not hide the rest."""
    part = DIFFERENCE if one.has_amount and not one.one_sided else 1.0
    try:
        problem = problem_with(end.problem, one, held=True)
    except ValueError as error:
        return one, None, str(error)
    c = problem.coordinates
    x, i = c.with_known(end.by_label), c.labels.index(one.label)
    x[i] = c.all[i].to_x(part * one.step)
    got = problem.residuals(problem.runner(end.runner), x, end.which, end.at.steps)
    return (one, None, got.reason) if got.failed else (one, (got.r - end.at.r) / part, "")


# The search


def search(
    end: Fit, some: Sequence[Suspect], tests: Mapping[str, AssumptionTest], linear: Linearised,
    effort: float,
) -> Iterator[tuple[AssumptionTest, Fit | None]]:  # fmt: skip
    """Refit with one suspect free after the other, as the head of this module says, from the `end`
    of a fit and the score `tests` of the suspects.

    Yields the test of every suspect that was tried: of finalists that of the refit, and the refit.
    It ends when refits took `effort` times the work of the fit, unless one explains the misfit:
    then its rivals are completed.
    """
    queue = sorted(some, key=lambda one: (one.costly, -tests[one.name].gain))  # 1.
    most, finest = end.runner.work * (1.0 + effort), end.check.rtol
    bar = tqdm(total=len(queue), unit="suspect", disable=hidden(end.progress))
    with bar, warnings.catch_warnings(action="ignore"):
        end = on_loose_steps(end) if end.chi2 > FAR else end
        end = end._replace(notify=lambda chi2: bar.set_postfix_str(f"chi2 = {chi2:.4g}"))
        least = max(EVIDENT, FAINT * (linear.square - linear.dof))
        size = max(BRACKET, sum(tests[one.name].gain >= least for one in queue if not one.costly))
        while queue and end.runner.work < most:
            bracket, queue = queue[:size], queue[size:]
            reached, evaluations = first_steps(end, bracket, tests, linear, bar), KEPT  # 2.
            fits = reached
            while len(fits) > FINALISTS:
                kept = best_of(fits, linear)
                bar.set_description(f"{len(kept)} suspects, {evaluations} evaluations each")
                fits = {one: carried_on(fits[one], evaluations) for one in kept}
                reached = reached | fits
                evaluations *= KEPT
            fits = comparable(reached, tests, fits) | fits
            dropped = (replace(tests[one.name], dropped=True) for one in bracket if one not in fits)
            yield from ((test, None) for test in dropped)
            explained = False
            for one, refit in refits(fits, finest, linear, bar):  # 3.
                test = linear.refit_test(one, refit, tests[one.name])
                yield test, refit
                explained = explained or bool(test.suspected and test.passed)
                if not explained and end.runner.work >= most:
                    return
            if explained:
                return


def first_steps(
    end: Fit, bracket: Sequence[Suspect], tests: Mapping[str, AssumptionTest], linear: Linearised,
    bar: "tqdm[Any]",
) -> dict[Suspect, Fit]:  # fmt: skip
    """First steps with each suspect of a bracket, of those that can be simulated."""
    fits = dict[Suspect, Fit]()
    for one in bracket:
        bar.set_description(plain(f"first step with {one.name} free"))
        if (fit := first_step(end, one, tests[one.name], linear)) is not None:
            fits[one] = fit
        bar.update()
    return fits


def first_step(end: Fit, one: Suspect, test: AssumptionTest, linear: Linearised) -> Fit | None:
    """The fit with a suspect free after the step that its score test predicts, or the best of some
    parts of it, on the steps of the end; None where it cannot be simulated."""
    try:
        start = fit_with(end, one.within(test.favoured))
    except ValueError:
        return None
    steps = covering(end.at.steps, start.problem)
    c, step = start.problem.coordinates, np.zeros(len(start.x))
    for (label, move), sd in zip(test.moves.items(), linear.sd):
        step[c.labels.index(label)] = move * sd
    times, i = 1.0, c.labels.index(one.label)
    if one.has_amount:
        times = test.favoured / test.amount
        step[i] = one.step / c.all[i].slope(start.x[i])
    longest = abs(times) * float(np.linalg.norm(step[start.free]))
    times, best = times / max(1.0, longest / FIRST_STEP), None
    for part in PARTS:
        x = start.within_bounds(start.x + part * times * step)
        at = start.residuals(x, steps=steps)
        if not at.failed:
            fit = start._replace(x=x, at=at)
            best = fit if best is None or fit.square < best.square else best
        if best is not None and best.square < linear.square:
            break
    return best


def covering(steps: Mapping[str, Frozen], problem: Problem) -> Mapping[str, Frozen]:
    """Steps that go on to the end of the runs of a problem, which a delay of a sensor makes longer
    than those of the fit."""
    out = dict[str, Frozen]()
    for one in (one for one in problem.recordings if one.name in steps):
        knots, last = steps[one.name].knots, float(one.grid(problem.interpolated).t[-1])
        later = [*np.arange(knots[-1] + EARLY, last, EARLY), last]
        out[one.name] = Frozen(np.append(knots, later if last > knots[-1] else []))
    return out


def best_of(fits: Mapping[Suspect, Fit], linear: Linearised) -> list[Suspect]:
    """The fits that go on after a round: those that leave least, without those far behind one that
    explains the misfit."""
    ranked = sorted(fits, key=lambda one: fits[one].square)
    kept = ranked[: max(len(ranked) // KEPT, FINALISTS)]
    gains = {one: linear.square - fits[one].square for one in kept}
    if gains[kept[0]] < max(NEARLY * (linear.square - linear.dof), EVIDENT):
        return kept
    return [one for one in kept if gains[one] >= RIVAL * gains[kept[0]]]


def comparable(
    reached: Mapping[Suspect, Fit], tests: Mapping[str, AssumptionTest], fits: Mapping[Suspect, Fit]
) -> dict[Suspect, Fit]:
    """Of the fits that a bracket `reached`, that with the likeliest suspect by its score test, and
    those that explain as much by theirs as the best of some `fits`: a few evaluations do not
    exclude them."""
    most = min((fit.square for fit in fits.values()), default=0.0) + COMPARABLE
    likeliest = max(reached, key=lambda one: tests[one.name].gain, default=None)
    return {
        one: fit
        for one, fit in reached.items()
        if one is likeliest or (tests[one.name].passed and tests[one.name].left < most)
    }


def carried_on(fit: Fit, evaluations: int) -> Fit:
    """The fit after some more evaluations on its steps, or as it is where these fail."""
    with suppress(Unreachable):
        return gauss_newton(fit, evaluations, ROUGH, anew=True)
    return fit


def refits(
    fits: Mapping[Suspect, Fit], finest: float, linear: Linearised, bar: "tqdm[Any]"
) -> Iterator[tuple[Suspect, Fit]]:
    """The fits, completed, the one that leaves least first."""
    best = np.inf
    for one in sorted(fits, key=lambda one: fits[one].square):
        bar.set_description(plain(f"refit with {one.name} free"))
        refit = completed(fits[one], finest, best + COMPARABLE, linear)
        best = min(best, refit.square)
        yield one, refit


def on_loose_steps(end: Fit) -> Fit:
    """The end of a fit on steps of the tolerance `LOOSE`, or as it is where such a run fails."""
    at = end.residuals(steps=max(LOOSE, end.rtol))
    return end if at.failed else end._replace(at=at)


def completed(fit: Fit, finest: float, most: float, linear: Linearised) -> Fit:
    """The fit, continued until it converges, with ratios at a bound scanned over their whole range;
    on steps of the tolerance `finest` where it leaves at most `most` of the sum of squares. Where
    it may explain the misfit, finer steps must not matter."""
    c = fit.problem.coordinates
    stuck = [one for one in c.within(fit.free & c.at_bound(fit.x)) if one.ratio_to]
    stage = replace(fit.stage, scanned=scanned(stuck), evaluations=COMPLETE, tolerance=ROUGH)
    end = continued(fit, stage) or fit
    if end.square > most:
        return end._replace(converged=False)
    end = end.by(finest)
    fresh = end.residuals(steps=finest)
    end = end if fresh.failed else continued_on(end, fresh, "steps chosen anew")
    tighten = end.loss == "linear" and may_explain(end, linear)
    return refine_steps(end, TIGHTENINGS if tighten else 0)


def may_explain(fit: Fit, linear: Linearised) -> bool:
    """Whether a fit leaves little of the misfit above the noise, and what chance leaves."""
    chance = UNLIKELY * (2 * linear.dof) ** 0.5
    return fit.square - linear.dof <= FAINT * (linear.square - linear.dof) + chance
