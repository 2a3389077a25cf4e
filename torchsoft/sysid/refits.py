"""Variations of a problem by one wrong assumption: effects on the residuals, and repeated fits."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.assumptions import Variation
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

AMOUNTS = 10.0
"""Range of a parameter in a repeated fit, in amounts of its variation."""

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


EARLY = 2e-3
"""Steps [s] before those of the fit, where the run of a variation begins earlier."""

WRONG = {"bias": 1e4, "delay": 0.02, "gain": 0.5, "drift": 1e4, "clock": 0.05}
"""Range of a sensor's fault: bias and drift [/s] over the noise, delay [s], gain [1], clock [1]."""


def varied(problem: Problem, which: Sequence[str], one: Variation) -> Problem | str:
    """The problem with one assumption varied in the recordings `which`, or the reason why there is
    none. A known parameter, or a fault of a sensor, becomes another unknown."""
    made, unknowns, sensors = [], dict(problem.unknowns), dict(problem.sensors)
    for recording in problem.recordings:
        other = (
            one.vary(recording) if one.vary is not None and recording.name in which else recording
        )
        if other is None:
            return f"it has no meaning where recording `{recording.name}` begins"
        made.append(other)
    try:
        if one.extension:
            unknowns[one.parameter] = Unknown()
        elif one.parameter:
            reach = AMOUNTS * one.step / one.nominal
            low, high = sorted(
                farthest(problem.recordings, one.parameter, one.nominal, part)
                for part in (-reach, reach)
            )
            unknowns[one.parameter] = Unknown(nominal=one.nominal, low=low, high=high)
        if one.fault is not None:
            channel, kind = one.fault
            scale = sensors[channel].noise if kind in ("bias", "drift") else 1.0
            if kind == "clock":
                scale = 1.0 / max(1.0, *(recording.duration for recording in made))
            sensors[channel] = sensors[channel].model_copy(update={kind: WRONG[kind] * scale})
        return Problem(made, sensors, unknowns, problem.noise)
    except ValueError as error:  # an unknown that the varied rig has not, or that cannot be one
        return str(error)


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


def difference(problem: Problem, end: End, one: Variation) -> tuple[Array | None, str]:
    """Change of the residuals (m,) by a variation, on the same steps, or None and the reason."""
    if end.base.failed:
        return None, "the estimates cannot be simulated by the tolerance of the checks"
    other = varied(problem, end.which, one)
    if isinstance(other, str):
        return None, other
    runner = end.runner.of(other.recordings)
    steps = {
        r.name: since(end.steps[r.name], float(r.times[0] - r.start.lead))
        for r in other.recordings
        if r.name in end.steps
    }
    got = other.residuals(runner, end.x, end.which, steps)
    if got.failed:
        return None, f"a run failed: {got.reason}"
    return got.r - end.base.r, ""


def since(steps: Frozen, begin: float) -> Frozen:
    """The same steps for a run that begins at another time [s]."""
    knots = steps.knots
    if begin == knots[0]:
        return steps
    early = np.arange(begin, knots[0], EARLY) if begin < knots[0] else np.array([begin])
    return Frozen(np.concatenate((early, knots[knots > early[-1] + 1e-3 * EARLY])))


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
        added = varied(other, end.which, one) if one.label else ""
        if isinstance(added, Problem):
            other, tried = added, [*tried, one]
    if not tried:
        return None
    c, free = other.coordinates, freed(problem, other, end)
    labels = tuple(one.label for one in c.within(free))
    plan = [
        Stage(f"joint by rtol = {rtol:g}", end.which, labels, rtol, ALL, ROUGH)
        for rtol in (LOOSE, end.rtol)
    ]
    at, fits = dict(zip(problem.coordinates.labels, end.x)), list[Fit]()
    runner = end.runner.of(other.recordings)
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
    """Mask of the free coordinates of a varied problem: those of the fit, and its own."""
    fitted = dict(zip(problem.coordinates.labels, end.free))
    return np.array([bool(fitted.get(label, True)) for label in other.coordinates.labels])


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
    other = problem
    for one in tried:
        added = varied(other, end.which, one)
        if isinstance(added, str):
            return None
        other = added
    c, at = other.coordinates, dict(zip(problem.coordinates.labels, end.x))
    if joint is not None:
        at |= {label: joint.at[label] for label in c.labels if label in joint.at}
    x = c.begun(at)
    free = freed(problem, other, end)
    stuck = [one for one in c.within(free & c.at_bound(x)) if one.ratio_to]
    scans = tuple((one.label, tuple(part * one.high for part in SCANNED)) for one in stuck)
    labels = tuple(one.label for one in c.within(free))
    runner = end.runner.of(other.recordings)

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
                fits += carried_out(plan, c.start)
    if not tried and not fits:  # it stays where it ended
        chi2 = float(np.mean(end.base.r**2))
        fits = [Fit(end.x, chi2, 0, False, end.steps, end.base._replace(J=end.at.J))]
    return Refit(other, min(fits, key=lambda fit: fit.chi2), free) if fits else None
