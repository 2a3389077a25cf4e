"""Variations of a problem by one wrong assumption: effects on the residuals, and repeated fits."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.assumptions import AMOUNTS, FAULT_BOUNDS, Variation
from torchsoft.sysid.fit import Fit, Loss, Notify, Unreachable
from torchsoft.sysid.plan import ALL, LOOSE, SCANNED, USUAL, Stage, default_plan, run_plan
from torchsoft.sysid.prediction import Frozen
from torchsoft.sysid.problem import Problem, Residuals, check_possible
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import Unknown

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

TOGETHER = 4
"""Most suspects that explain a misfit between them."""


class End(NamedTuple):
    """End of a fit: coordinates x (n,), residuals there, mask `free` (n,), fitted recordings,
    residuals and steps of runs by the tolerance `rtol` of variations, the runner, and the tolerance
    `finest` of the fit itself."""

    x: Array
    at: Residuals
    free: NDArray[np.bool_]
    which: tuple[str, ...]
    base: Residuals
    steps: Mapping[str, Frozen]
    rtol: float
    runner: Runner
    finest: float

    @property
    def far(self) -> bool:
        """Whether the misfit is so large that tests to first order at this end are void."""
        return float(np.mean(self.base.r**2)) > FAR


def ended(
    problem: Problem, runner: Runner, x: Array, at: Residuals, free: NDArray[np.bool_],
    which: Sequence[str], rtol: float, own: Mapping[str, Frozen] | None = None,
) -> End:  # fmt: skip
    """The end of a fit with the tolerance `rtol`, with a run for each recording by the tolerance of
    the variations: `USUAL`, or that of the fit, if such runs fail; or `at` on its `own` steps,
    where these are given."""
    if own is not None:
        return End(x, at, free, tuple(which), at, own, rtol, runner, rtol)
    usual = max(rtol, USUAL)
    base, steps = problem.freeze(runner, x, which, usual)
    if base.failed and usual > rtol:
        usual = rtol
        base, steps = problem.freeze(runner, x, which, rtol)
    return End(x, at, free, tuple(which), base, steps, usual, runner, rtol)


def assuming(problem: Problem, some: Sequence[Variation], free: bool) -> Problem:
    """The problem with assumptions as more coordinates, `free` or held at what is stated; a law or
    a constant of the computation is held and, as by `begun`, otherwise. Raises `ValueError` for one
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
            scales = {"bias": sensors[channel].noise, "drift": sensors[channel].noise,
                      "clock": 1.0 / longest}  # fmt: skip
            most = FAULT_BOUNDS[kind] * scales.get(kind, 1.0)
            sensors[channel] = sensors[channel].model_copy(update={kind: most})
    more = [*problem.variations.values(), *(one for one in some if one.vary or one.read)]
    return Problem(problem.recordings, sensors, unknowns, problem.noise, more, held)


def begun(problem: Problem, some: Sequence[Variation], at: Mapping[str, float]) -> Array:
    """Coordinates (n,) of a problem under assumptions from those `at`, by label: laws and constants
    of the computation are otherwise, numbers as stated."""
    c = problem.coordinates
    x = c.begun(at)
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


def exact_columns(
    problem: Problem, end: End, taken: Sequence[Variation]
) -> tuple[list[Column], Array | None]:
    """Columns of parameters, of extensions of the rigs, of faults of sensors and of other readings,
    and the Jacobian (m, n) of the free coordinates on the same steps: all from one run for each
    recording. Empty where it fails."""
    mine, out = [one for one in taken if one.vary is None], list[Column]()
    if not mine or end.base.failed:
        return out, None
    try:
        wide = assuming(problem, mine, free=False)
    except ValueError:
        why = {one.name: impossible(problem, one) for one in mine}
        out += [(one, None, why[one.name]) for one in mine if why[one.name]]
        mine = [one for one in mine if not why[one.name]]
        wide = assuming(problem, mine, free=False)
    c = wide.coordinates
    x = c.begun(dict(zip(problem.coordinates.labels, end.x)))
    own = [c.labels.index(one.label) for one in problem.coordinates.within(end.free)]
    free = np.isin(c.labels, [one.label for one in mine])
    free[own] = True
    at = wide.residuals(wide.runner(end.runner), x, end.which, end.steps, free)
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


def difference(problem: Problem, end: End, one: Variation) -> tuple[Array | None, str]:
    """Change of the residuals (m,) by a variation of runs, on the same steps, or None and the
    reason."""
    if end.base.failed:
        return None, "the estimates cannot be simulated by the tolerance of the checks"
    other = assuming(problem, [one], free=False)
    c = other.coordinates
    x, i = c.begun(dict(zip(problem.coordinates.labels, end.x))), c.labels.index(one.label)
    x[i] = c.all[i].to_x(one.amount)
    got = other.residuals(other.runner(end.runner), x, end.which, end.steps)
    if got.failed:
        return None, got.reason
    return got.r - end.base.r, ""


class Joint(NamedTuple):
    """A fit with many suspects as unknowns: coordinates by label, the final sum of squares, and the
    fraction of the misfit, with all of them as stated, that each suspect alone explains to first
    order there, by name; and the suspects that explain nearly all of it between them, if a few
    do."""

    at: Mapping[str, float]
    left: float
    parts: Mapping[str, float]
    together: Sequence[str] = ()


def joint_fit(
    problem: Problem, end: End, suspects: Sequence[Variation], enough: float, loss: Loss,
    notify: Notify,
) -> Joint | None:  # fmt: skip
    """The fit with all suspects that are parameters or faults of sensors as unknowns; None where
    there are none. It starts at the end of the first fit and, if the sum of squares stays above
    `enough`, also at the start of that fit.

    A fit with a wrong assumption may end far from the truth, where tests to first order rank
    suspects wrongly. The joint fit ends near it, where they rank them rightly. If the joint fit
    does not explain the data, none of its suspects does alone.
    """
    other, tried = problem, list[Variation]()
    for one in suspects:
        with suppress(ValueError):
            if one.parameter or one.fault is not None:
                other, tried = assuming(other, [one], free=True), [*tried, one]
    if not tried:
        return None
    c, free = other.coordinates, freed(problem, other, end)
    labels = tuple(one.label for one in c.within(free))
    plan = [
        Stage(f"joint by rtol = {rtol:g}", end.which, labels, rtol, ALL, ROUGH)
        for rtol in (LOOSE, end.rtol)
    ]
    at, fits = dict(zip(problem.coordinates.labels, end.x)), list[Fit]()
    runner = other.runner(end.runner)
    for x in (c.begun(at), c.start):
        with suppress(Unreachable):
            fits.append(run_plan(other, runner, plan, x, loss=loss, notify=notify).fit)
            if float(fits[-1].at.r @ fits[-1].at.r) <= enough:
                break
    if not fits:
        return None
    fit = min(fits, key=lambda fit: fit.chi2)
    J, columns = fit.at.J, [c.labels.index(one.label) for one in tried]
    Q, _ = np.linalg.qr(J[:, np.isin(c.labels, problem.coordinates.labels) & free])

    def across(d: Array) -> Array:
        """Component (m,) orthogonal to the Jacobian of the first fit's coordinates."""
        return d - Q @ (Q.T @ d)

    stated = across(fit.at.r - J[:, columns] @ (fit.x - c.start)[columns])
    left, effects = float(fit.at.r @ fit.at.r), dict[str, Array]()
    misfit = max(float(stated @ stated) - left, 1e-300)
    for one, k in zip(tried, columns):
        d = across(J[:, k])
        effects[one.name] = d / max(float(np.linalg.norm(d)), 1e-150)
    parts = {name: float(d @ stated) ** 2 / misfit for name, d in effects.items()}
    together = fewest(effects, stated, left + (1 - NEARLY) * misfit)
    return Joint(dict(zip(c.labels, fit.x.tolist())), left, parts, together)


def fewest(effects: Mapping[str, Array], r: Array, enough: float) -> list[str]:
    """Names of effects (m,), of length one, whose span leaves at most `enough` of the square of r
    (m,): by orthogonal matching pursuit, then without those that are not needed. None where that
    takes more than `TOGETHER`."""

    def left(names: Sequence[str]) -> Array:
        A = np.array([effects[name] for name in names]).reshape(len(names), len(r)).T
        return r - A @ np.linalg.lstsq(A, r, rcond=None)[0]

    out, rest = list[str](), r
    while float(rest @ rest) > enough:
        if len(out) == min(TOGETHER, len(effects)):
            return []
        out.append(max(effects.keys() - out, key=lambda name: abs(float(effects[name] @ rest))))
        rest = left(out)
    for name in tuple(out):
        others = [one for one in out if one != name]
        if float(np.sum(left(others) ** 2)) <= enough:
            out = others
    return out


def freed(problem: Problem, other: Problem, end: End) -> NDArray[np.bool_]:
    """Mask of the free coordinates of a problem under assumptions: those of the fit, and its
    own."""
    fitted, c = dict(zip(problem.coordinates.labels, end.free)), other.coordinates
    return np.array([bool(fitted.get(label, own)) for label, own in zip(c.labels, c.free)])


class Refit(NamedTuple):
    """A repeated fit: the problem, its end, and the mask of free coordinates."""

    problem: Problem
    fit: Fit
    free: NDArray[np.bool_]

    def of(self, label: str) -> float:
        """Final value of a coordinate."""
        return float(self.fit.x[self.problem.coordinates.labels.index(label)])


def refit(
    problem: Problem, end: End, tried: Sequence[Variation], loss: Loss, notify: Notify,
    joint: Joint | None = None,
) -> Refit | None:  # fmt: skip
    """The fit with some assumptions varied, or with all as stated, on its own steps; None where it
    cannot begin.

    It starts at the end of the fit, or of a joint fit; ratios at a bound are scanned again over
    their whole range. Without a joint fit, and with a misfit above `FAR`, variations other than of
    a sensor also start where the first fit did, and the better end counts.
    """
    try:
        other = assuming(problem, tried, free=True)
    except ValueError:
        return None
    c, at = other.coordinates, dict(zip(problem.coordinates.labels, end.x))
    if joint is not None:
        at |= {label: joint.at[label] for label in c.labels if label in joint.at}
    x = begun(other, tried, at)
    free = freed(problem, other, end)
    stuck = [one for one in c.within(free & c.at_bound(x)) if one.ratio_to]
    scans = tuple((one.label, tuple(part * one.high for part in SCANNED)) for one in stuck)
    labels = tuple(one.label for one in c.within(free))
    runner = other.runner(end.runner)

    def carried_out(plan: Sequence[Stage], x: Array) -> Iterator[Fit]:
        """The fit of the last stage, nothing where one fails."""
        with suppress(Unreachable):
            yield run_plan(other, runner, plan, x, loss=loss, notify=notify).fit

    once = Stage("once more", end.which, labels, end.rtol, REFITS, ROUGH, scanned=scans)
    fits = [*carried_out([once], x)]
    if any(one.kind != "sensor" for one in tried) and end.far and joint is None:
        with suppress(Unreachable):
            plan = default_plan(other, runner, end.rtol, end.which)
            if set(plan[-1].free) == set(labels):
                fits += carried_out(plan, begun(other, tried, {}))
    if not tried and not fits:  # it stays where it ended
        chi2 = float(np.mean(end.base.r**2))
        fits = [Fit(end.x, chi2, 0, False, end.steps, end.base._replace(J=end.at.J))]
    return Refit(other, min(fits, key=lambda fit: fit.chi2), free) if fits else None
