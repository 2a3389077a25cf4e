"""Variations of a problem by one wrong assumption: effects on the residuals, and repeated fits."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain

import numpy as np

from torchsoft.sysid.assumptions import AMOUNTS, WIDEST, Variation
from torchsoft.sysid.fit import Fit, Stage, Unreachable, gauss_newton
from torchsoft.sysid.plan import ALL, LOOSE, SCANNED, USUAL, continued, default_plan
from torchsoft.sysid.problem import DIFFERENCE, Problem, check_possible
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.unknowns import FAULTS, Unknown

REFITS, ROUGH = 20, 1e-3
"""Most evaluations of a repeated fit, and its relative tolerance: enough to see whether the misfit
vanishes."""


FAR = 2.0
"""Misfit per sample above which tests to first order at the end of the fit are void, and repeated
fits also start where the first fit did."""

HALVINGS = 10
"""Most halvings of that range where the rig is impossible at its end."""

NEARLY = 0.99
"""Fraction of the misfit above the noise that suspects must explain to make most other fits
needless."""

EVIDENT = 20.0
"""Fall of chi2, over the remaining misfit per sample, above which the data favour a variation: four
and a half standard deviations, since some twenty variations are tested."""

TOGETHER = 4
"""Most suspects that explain a misfit between them."""

PARTS = (1.0, 0.25, 0.0625)
"""Parts of a step that are tried where a fit is far off."""

REDUNDANT = 1e-6
"""Part of the square of an effect beside others at which it counts as one of theirs."""


def coarsened(fit: Fit) -> Fit:
    """The end of a fit with a run for each recording by the tolerance of variations: `USUAL`, or
    its own, if such runs fail. Its `check` has the tolerance of the fit, and the residuals by which
    assumptions are tested. One whose steps could not be checked stays on them."""
    if fit.check.bias is None:
        return fit._replace(at=fit.check.finer)
    usual = max(fit.rtol, USUAL)
    base = fit.residuals(steps=usual)
    if base.failed and usual > fit.rtol:
        usual = fit.rtol
        base = fit.residuals(steps=usual)
    return fit.by(usual)._replace(at=base)


def far_off(end: Fit) -> bool:
    """Whether the misfit is so large that tests to first order at this end are void."""
    return end.chi2 > FAR


def assuming(problem: Problem, some: Sequence[Variation], free: bool) -> Problem:
    """The problem with assumptions as more coordinates, `free` or held at what is stated; a law or
    a numerical setting is held and, as by `start_under`, otherwise. Raises `ValueError` for one
    that cannot be."""
    unknowns, sensors, held = dict(problem.unknowns), dict(problem.sensors), set(problem.held)
    longest = max(1.0, *(recording.duration for recording in problem.recordings))
    for one in some:
        if not free or one.kind in ("numerical", "law"):
            held.add(one.label)
        if one.extension or (one.parameter and not free and one.nominal > 0):
            unknowns[one.parameter] = Unknown()
        elif one.parameter:
            reach = AMOUNTS * one.step / one.nominal
            low, high = sorted(
                farthest(problem.recordings, one.parameter, one.nominal, part)
                for part in (-reach, reach)
            )
            scale = "log" if low > 0 else "linear"
            unknowns[one.parameter] = Unknown(nominal=one.nominal, low=low, high=high, scale=scale)
        elif one.fault is not None:
            channel, kind = one.fault
            most = FAULTS[kind].most * FAULTS[kind].scale(sensors[channel], longest)
            sensors[channel] = sensors[channel].model_copy(update={kind: most})
    more = [*problem.variations.values(), *(one for one in some if one.vary or one.read)]
    return Problem(problem.recordings, sensors, unknowns, problem.noise, more, held)


def start_under(problem: Problem, some: Sequence[Variation], at: Mapping[str, float]) -> Array:
    """Coordinates (n,) of a problem under assumptions from those `at`, by label: laws and constants
    of the computation are otherwise, numbers as stated."""
    c = problem.coordinates
    x = c.with_known(at)
    for one in some:
        if one.kind in ("numerical", "law"):
            i = c.labels.index(one.label)
            x[i] = c.all[i].to_x(1.0)
    return x


def farthest(recordings: Sequence[Recording], name: str, value: float, part: float) -> float:
    """A parameter changed by a relative `part`, halved until the rig is possible: friction in slip
    must not exceed that at rest. Raises `ValueError` where it never is."""
    for _ in range(HALVINGS):
        with suppress(ValueError):
            for recording in recordings:
                check_possible(recording, {name: value * (1 + part)})
            return value * (1 + part)
        part /= 2
    raise ValueError(f"{name} = {value:g} can hardly be varied")


Column = tuple[Variation, Array | None, str]
"""A variation with the change of the residuals (m,) by its amount, or None and the reason."""


def columns(end: Fit, taken: Sequence[Variation]) -> tuple[Iterator[Column], Array | None]:
    """Columns of assumptions, those that are exact first, the others when they are asked for, which
    takes a run each; and the Jacobian (m, n) of the fitted coordinates on the same steps."""
    exact, J = exact_columns(end, taken)
    others = (one for one in taken if one.vary is not None)
    return chain(exact, ((one, *difference(end, one)) for one in others)), J


def exact_columns(end: Fit, taken: Sequence[Variation]) -> tuple[list[Column], Array | None]:
    """Columns of parameters, of extensions of the rigs, of faults of sensors and of other readings,
    and the Jacobian (m, n) of the fitted coordinates on the same steps: all from one run for each
    recording. Empty where it fails."""
    mine, out = [one for one in taken if one.vary is None], list[Column]()
    if not mine or end.at.failed:
        return out, None
    try:
        wide = assuming(end.problem, mine, free=False)
    except ValueError:
        why = {one.name: impossible(end.problem, one) for one in mine}
        out += [(one, None, why[one.name]) for one in mine if why[one.name]]
        mine = [one for one in mine if not why[one.name]]
        wide = assuming(end.problem, mine, free=False)
    c = wide.coordinates
    own = [c.labels.index(label) for label in end.labels]
    free = np.isin(c.labels, [*end.labels, *(one.label for one in mine)])
    x = c.with_known(end.by_label)
    at = wide.residuals(wide.runner(end.runner), x, end.which, end.at.steps, free)
    if at.failed:
        return [], None
    for one in mine:
        i = c.labels.index(one.label)
        size = one.amount if one.read is not None else one.step
        out.append((one, at.J[:, i] * (size / c.all[i].slope(x[i])), ""))
    return out, at.J[:, own]


def impossible(problem: Problem, one: Variation) -> str:
    """Why an assumption cannot be a coordinate; empty if it can."""
    try:
        assuming(problem, [one], free=False)
    except ValueError as error:
        return str(error)
    return ""


def difference(end: Fit, one: Variation) -> tuple[Array | None, str]:
    """Change of the residuals (m,) by a variation of runs, on the same steps, or None and the
    reason. That of a number of either sign is by a part of its amount: coordinates take most of an
    effect, and what its curvature leaves must not hide the rest."""
    if end.at.failed:
        return None, "the estimates cannot be simulated by the tolerance of the checks"
    other = assuming(end.problem, [one], free=False)
    c = other.coordinates
    x, i = c.with_known(end.by_label), c.labels.index(one.label)
    part = 1.0 if one.one_sided or one.kind in ("numerical", "law") else DIFFERENCE
    x[i] = c.all[i].to_x(part * one.amount)
    got = other.residuals(other.runner(end.runner), x, end.which, end.at.steps)
    return (None, got.reason) if got.failed else ((got.r - end.at.r) / part, "")


def likeness(fit: Fit, cause: Variation, others: Sequence[Variation]) -> dict[str, float]:
    """Fraction of the effect of a cause that each of some other assumptions can have in a new fit,
    to first order at the end of the fit under the cause and beside its other coordinates, by name;
    without those whose run fails. A number has it within its range only."""
    c = fit.problem.coordinates
    k = c.labels.index(cause.label)
    own = fit.free & (np.arange(len(c.labels)) != k)
    Q, _ = np.linalg.qr(fit.at.J[:, own])
    effect = across(fit.at.J[:, k] * (fit.x[k] - c.start[k]), Q)
    square, out = max(float(effect @ effect), 1e-300), dict[str, float]()
    rough = fit if fit.check.bias is None else coarsened(fit)  # of many runs, on as few steps
    for one, d, _ in columns(rough, others)[0]:
        if d is not None:
            part = across(d, Q)
            size, along = max(float(part @ part), 1e-300), float(part @ effect)
            low, high = reach(fit.problem, one)
            if along != 0:  # amount at which it has most of the effect, and what there is of it
                there = float(np.clip(along / size, low, high)) * size / along
                out[one.name] = along**2 / size / square * there * (2 - there)
            else:
                out[one.name] = 0.0
    return out


def reach(problem: Problem, one: Variation) -> tuple[float, float]:
    """Range of an assumption in a new fit, over the amount of its variation; unlimited for a law or
    a constant of the computation, whose test to first order says little, and none where no new fit
    can be."""
    if one.kind in ("numerical", "law"):
        return -np.inf, np.inf
    try:
        c = assuming(problem, [one], free=True).coordinates
    except ValueError:
        return 0.0, 0.0
    mine = c.all[c.labels.index(one.label)]
    step = one.amount if one.vary is not None or one.read is not None else one.step
    ends = sorted((end - mine.nominal) / step for end in (mine.low, mine.high))
    return WIDEST * ends[0], WIDEST * ends[1]


def across(d: Array, Q: Array) -> Array:
    """Component (m,) of d orthogonal to the span of an orthonormal basis Q (m, n)."""
    return d - Q @ (Q.T @ d)


def unit(d: Array) -> Array:
    """d (m,) with length one."""
    return d / max(float(np.linalg.norm(d)), 1e-150)


def under(end: Fit, other: Problem, x: Array) -> Fit:
    """The start at x (n,) of the fit of a problem under assumptions, with the coordinates of the
    fit that has ended, and its own."""
    known, c = end.by_label, other.coordinates
    free = [
        label
        for label, own in zip(c.labels, c.free)
        if label in end.labels or (own and label not in known)
    ]
    stage = Stage("once more", end.which, tuple(free), end.rtol, REFITS, ROUGH)
    return Fit(other, other.runner(end.runner), x, stage, loss=end.loss, notify=end.notify)


def joint_fit(end: Fit, suspects: Sequence[Variation], enough: float) -> Fit | None:
    """The fit with all suspects that are parameters or faults of sensors as unknowns; None where
    there are none. It starts at the end of the first fit and, if the sum of squares stays above
    `enough`, also at the start of that fit; the better of the two by the tolerance `LOOSE` goes on.

    A fit with a wrong assumption may end far from the truth, where tests to first order rank
    suspects wrongly. The joint fit ends near it, where they rank them rightly. If the joint fit
    does not explain the data, none of its suspects does alone.
    """
    other = end.problem
    for one in suspects:
        with suppress(ValueError):
            if one.parameter or one.fault is not None:
                other = assuming(other, [one], free=True)
    if other is end.problem:
        return None
    c, fits = other.coordinates, list[Fit]()
    for x in (c.with_known(end.by_label), c.start):
        start = under(end, other, x)
        rough = replace(start.stage, name="joint, roughly", rtol=LOOSE, evaluations=ALL)
        fit = continued(start, rough)
        fits += [fit] if fit is not None else []
        if fits and fits[-1].square <= enough:
            break
    best = min(fits, key=lambda fit: fit.chi2, default=None)
    return best and continued(best, replace(best.stage, name="joint", rtol=end.rtol))


def shares(
    end: Fit, joint: Fit, suspects: Sequence[Variation]
) -> tuple[dict[str, float], list[list[str]]]:
    """The fraction of the misfit, with all suspects of a joint fit as stated, that each alone
    explains to first order there, by name; and those that explain all but chance between them, and
    nearly all, if a few do."""
    c, J = joint.problem.coordinates, joint.at.J
    tried = {one.name: c.labels.index(one.label) for one in suspects if one.label in c.labels}
    own = np.isin(c.labels, end.problem.coordinates.labels) & joint.free
    Q, _ = np.linalg.qr(J[:, own])

    columns = [*tried.values()]
    stated = across(joint.at.r - J[:, columns] @ (joint.x - c.start)[columns], Q)
    misfit = max(float(stated @ stated) - joint.square, 1e-300)
    effects = {name: unit(across(J[:, k], Q)) for name, k in tried.items()}
    parts = {name: float(d @ stated) ** 2 / misfit for name, d in effects.items()}
    chance = (EVIDENT + len(tried)) * max(1.0, joint.chi2)  # each takes one of any noise
    enough = sorted(joint.square + left for left in (chance, (1 - NEARLY) * misfit))
    return parts, [fewest(effects, stated, one) for one in enough]


def pursuit(
    effects: Mapping[str, Array],
    r: Array,
    most: int,
    enough: float = 0.0,
    one_sided: Collection[str] = (),
) -> list[str]:
    """Names of effects (m,), `most` at most, that leave at most `enough` of the square of r (m,):
    by orthogonal least squares, each explains most of what those before it leave. Those that are
    `one_sided` only lower r."""
    left, out = dict(effects), list[str]()
    least = {name: REDUNDANT * float(d @ d) for name, d in effects.items()}
    while len(out) < most and float(r @ r) > enough:
        gains = {
            name: float(d @ r) ** 2 / float(d @ d)
            for name, d in left.items()
            if float(d @ d) > least[name] and not (name in one_sided and float(d @ r) > 0)
        }
        if not gains:
            break
        out.append(max(gains, key=lambda name: gains[name]))
        Q = unit(left.pop(out[-1]))[:, None]
        r, left = across(r, Q), {name: across(d, Q) for name, d in left.items()}
    return out


def fewest(effects: Mapping[str, Array], r: Array, enough: float) -> list[str]:
    """Names of effects (m,) whose span leaves at most `enough` of the square of r (m,), without
    those that are not needed. None where that takes more than `TOGETHER`."""

    def left(names: Sequence[str]) -> float:
        A = np.array([effects[name] for name in names]).reshape(len(names), len(r)).T
        return float(np.sum((r - A @ np.linalg.lstsq(A, r, rcond=None)[0]) ** 2))

    out = pursuit(effects, r, TOGETHER, enough)
    if left(out) > enough:
        return []
    for name in tuple(out):
        others = [one for one in out if one != name]
        if left(others) <= enough:
            out = others
    return out


def first_step(end: Fit, one: Variation) -> Fit | None:
    """The fit with an assumption varied, one step from the end of the fit, by the tolerance
    `LOOSE`: the best of some `PARTS` of the Gauss-Newton step, or of one of length 1 where that is
    longer. None where it cannot start."""
    try:
        other = assuming(end.problem, [one], free=True)
        start = under(end, other, start_under(other, [one], end.by_label))
        start = start.by(max(LOOSE, end.rtol)).evaluated(start.within_bounds(start.x))
    except (ValueError, Unreachable):
        return None
    step, fits = start.newton_step(), [start]
    step /= max(1.0, float(np.linalg.norm(step)))
    for part in PARTS:
        x = start.place(start.x[start.free] + part * step)
        at = start.residuals(x)
        fits += [] if at.failed else [start._replace(x=x, at=at)]
    return min(fits, key=lambda fit: fit.square)


def carried_on(fit: Fit, evaluations: int) -> Fit:
    """The fit after some more evaluations on its steps, or as it is where these fail."""
    with suppress(Unreachable):
        return gauss_newton(fit, evaluations, ROUGH, anew=True)
    return fit


def refit(
    end: Fit,
    tried: Sequence[Variation],
    near: Fit | None = None,
    enough: float = 0.0,
    anew: bool = True,
    evaluations: int = REFITS,
) -> Fit | None:
    """The fit with some assumptions varied, or with all as stated, on its own steps, by so many
    `evaluations` at most; None where it cannot start.

    It starts at the end of one `near`, or of the fit where that fails; ratios at a bound are
    scanned again over their whole range. Under what is costly it is fitted by the tolerance `LOOSE`
    first, and no further where that leaves more than a fit as stated by it. With a misfit above
    `FAR`, variations other than of a sensor also start `anew`, where the first fit did, unless the
    sum of squares is below `enough`; the better end counts.
    """
    try:
        other = assuming(end.problem, tried, free=True)
    except ValueError:
        return None
    c, fit, start = other.coordinates, None, end
    for there in filter(None, (near, end)):
        start = under(end, other, start_under(other, tried, end.by_label | there.by_label))
        stuck = [one for one in c.within(start.free & c.at_bound(start.x)) if one.ratio_to]
        scans = tuple((one.label, tuple(part * one.high for part in SCANNED)) for one in stuck)
        stage = replace(start.stage, scanned=scans, evaluations=evaluations)
        if any(one.costly for one in tried):
            plain = under(end, end.problem, end.x)
            stated, rough = (
                continued(one, replace(own, rtol=max(LOOSE, end.rtol)))
                for one, own in ((plain, plain.stage), (start, stage))
            )
            if rough is None or (stated is not None and rough.square >= stated.square):
                return rough
            start = start._replace(x=rough.x)
        if (fit := continued(start, stage)) is not None:
            break
    fits, explains = [fit], fit is not None and fit.square <= enough
    if anew and any(one.kind != "sensor" for one in tried) and far_off(end) and not explains:
        with suppress(Unreachable):
            plan = default_plan(other, start.runner, end.rtol, end.which)
            if set(plan[-1].free) == set(start.stage.free):
                fits.append(continued(start._replace(x=start_under(other, tried, {})), *plan))
    done = [fit for fit in fits if fit is not None]
    if not tried and not done:  # it stays where it ended
        return end._replace(at=end.at._replace(J=end.check.finer.J), converged=False)
    return min(done, key=lambda fit: fit.chi2, default=None)
