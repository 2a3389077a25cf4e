"""Problems with one assumption otherwise: its effect on residuals, and fits repeated with it."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.assumptions import Variation
from torchsoft.sysid.fit import Fit, Loss, Notify, Unreachable
from torchsoft.sysid.plan import ALL, LOOSE, SCANNED, USUAL, Stage, default_plan, run_plan
from torchsoft.sysid.prediction import Frozen
from torchsoft.sysid.problem import Problem, Residuals, check_value
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import Unknown

REFITS, ROUGH = 20, 1e-3
"""Evaluations that a fit under another assumption may take, and its relative tolerance: it has to
find out whether the misfit goes away, not where exactly."""


FAR = 2.0
"""Misfit per sample from which where a fit ended tells nothing: under another assumption it begins
where the first one began, too."""

AMOUNTS = 10.0
"""How many amounts of a variation a number of the rig may be off where a fit is repeated."""

HALVINGS = 10
"""How often that is halved where there is no such rig."""


class End(NamedTuple):
    """A fit in whose place another is held: coordinates x (n,), residuals there, the free
    coordinates (n,), the recordings that were fitted, residuals and steps of runs by the tolerance
    `rtol`, the maker of runs, and the tolerance of the fit itself, `finest`."""

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
        """Whether the fit left so much that what is so to first order where it ended says
        nothing."""
        return float(np.mean(self.base.r**2)) > FAR


def ended(
    problem: Problem, runner: Runner, x: Array, at: Residuals, free: NDArray[np.bool_],
    which: Sequence[str], rtol: float, own: Mapping[str, Frozen] | None = None,
) -> End:  # fmt: skip
    """The end of a fit, which took steps by `rtol`, with a run a recording by the tolerance of the
    variations: `USUAL`, or that of the fit, if runs are lost with it; or with `at`, by its `own`
    steps, where no others have a run."""
    if own is not None:
        return End(x, at, free, tuple(which), at, own, rtol, runner, rtol)
    usual = max(rtol, USUAL)
    base, steps = problem.freeze(runner, x, which, usual)
    if base.lost and usual > rtol:
        usual = rtol
        base, steps = problem.freeze(runner, x, which, rtol)
    return End(x, at, free, tuple(which), base, steps, usual, runner, rtol)


EARLY = 2e-3
"""Steps [s] before those of the fit, where a run begins earlier in a variation."""

WRONG = {"bias": 1e4, "delay": 0.02, "gain": 0.5, "drift": 1e4, "clock": 0.05}
"""How far a fault of a sensor is looked for: bias and drift [/s] over the noise, delay [s], gain
[1], clock [1]."""


def varied(problem: Problem, which: Sequence[str], one: Variation) -> Problem | str:
    """The problem with one assumption otherwise in the recordings `which`, or why there is none. A
    parameter that is called known, or a fault of a sensor, becomes one more unknown."""
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
    """A number of the rig that is off by a relative `part`, or by half of that, a quarter and so on
    until there is such a rig: a smaller disc may leave the pads apart. Raises `ValueError` where
    there is none."""
    for _ in range(HALVINGS):
        with suppress(ValueError):
            for recording in recordings:
                check_value(recording, name, value * (1 + part))
            return value * (1 + part)
        part /= 2
    raise ValueError(f"{name} = {value:g} can hardly be varied")


def difference(problem: Problem, end: End, one: Variation) -> tuple[Array | None, str]:
    """What a variation adds to the residuals (m,), on the same steps, or None and why that is not
    known."""
    if end.base.lost:
        return None, "the estimates cannot be simulated by the tolerance of the checks"
    other = varied(problem, end.which, one)
    if isinstance(other, str):
        return None, other
    runner = end.runner.of(other.recordings)
    steps = {r.name: since(end.steps[r.name], float(r.times[0] - r.start.lead))
             for r in other.recordings if r.name in end.steps}  # fmt: skip
    got = other.residuals(runner, end.x, end.which, steps)
    if got.lost:
        return None, f"a run failed: {next(iter(got.lost.values())).reason}"
    return got.r - end.base.r, ""


def since(steps: Frozen, begin: float) -> Frozen:
    """The same steps of a run that begins at another time [s]."""
    knots = steps.knots
    if begin == knots[0]:
        return steps
    early = np.arange(begin, knots[0], EARLY) if begin < knots[0] else np.array([begin])
    return Frozen(np.concatenate((early, knots[knots > early[-1] + 1e-3 * EARLY])))


class Joint(NamedTuple):
    """A fit with many suspects unknown at once: coordinates by label, the sum of squares that it
    leaves, and how much each suspect alone takes, to first order there, of the misfit that is left
    with all of them as stated, as a part of it by name."""

    at: Mapping[str, float]
    left: float
    parts: Mapping[str, float]


def joint_fit(
    problem: Problem, end: End, suspects: Sequence[Variation], enough: float, loss: Loss,
    notify: Notify,
) -> Joint | None:  # fmt: skip
    """The fit with every suspect unknown that is a number or a fault of a sensor; None where there
    is none. It begins where the first fit ended and, if a sum of squares above `enough` is left,
    where that began, too.

    A fit that lacks something may end far from the truth, where tests to first order rank suspects
    wrongly. The joint fit ends near it, and there they rank them rightly. Where it does not explain
    the data, none of its suspects does alone.
    """
    other, tried = problem, list[Variation]()
    for one in suspects:
        added = varied(other, end.which, one) if one.label else ""
        if isinstance(added, Problem):
            other, tried = added, [*tried, one]
    if not tried:
        return None
    c, free = other.coordinates, freed(problem, other, end)
    labels = tuple(label for label, is_free in zip(c.labels, free) if is_free)
    plan = [
        Stage(f"joint by rtol = {rtol:g}", end.which, labels, rtol, ALL, ROUGH)
        for rtol in (LOOSE, end.rtol)
    ]
    at, fits = dict(zip(problem.coordinates.labels, end.x)), list[Fit]()
    runner = end.runner.of(other.recordings)
    for x in (np.array([at.get(one, own) for one, own in zip(c.labels, c.start)]), c.start):
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
        """What no coordinate of the first fit can do (m,)."""
        return d - Q @ (Q.T @ d)

    stated = across(fit.at.r - J[:, columns] @ (fit.x - c.start)[columns])
    left, parts = float(fit.at.r @ fit.at.r), dict[str, float]()
    misfit = max(float(stated @ stated) - left, 1e-300)
    for one, k in zip(tried, columns):
        d = across(J[:, k])
        parts[one.name] = float(d @ stated) ** 2 / max(float(d @ d), 1e-300) / misfit
    return Joint(dict(zip(c.labels, fit.x.tolist())), left, parts)


def freed(problem: Problem, other: Problem, end: End) -> NDArray[np.bool_]:
    """Mask of coordinates of a varied problem that are free: those of the fit, and its own."""
    fitted = dict(zip(problem.coordinates.labels, end.free))
    return np.array([bool(fitted.get(label, True)) for label in other.coordinates.labels])


class Refit(NamedTuple):
    """A fit that was repeated: the problem, its end, and which of its coordinates were free."""

    problem: Problem
    fit: Fit
    free: NDArray[np.bool_]

    def of(self, label: str) -> float:
        """A coordinate at the end."""
        return float(self.fit.x[self.problem.coordinates.labels.index(label)])


def refit(
    problem: Problem, end: End, one: Variation | None, loss: Loss, notify: Notify,
    joint: Joint | None = None,
) -> Refit | None:  # fmt: skip
    """The fit with one assumption otherwise, or with all as stated, on steps of its own; None where
    it cannot begin.

    It begins where the fit ended, or where a joint fit did; ratios that ended at a bound are looked
    for again over all of their range. Without a joint fit, with anything but a sensor otherwise,
    and a misfit above `FAR`, it begins where the first fit began, too, and the better end counts.
    """
    other = varied(problem, end.which, one) if one is not None else problem
    if isinstance(other, str):
        return None
    c, at = other.coordinates, dict(zip(problem.coordinates.labels, end.x))
    if joint is not None:
        at |= {label: joint.at[label] for label in c.labels if label in joint.at}
    x = np.array([at.get(label, own) for label, own in zip(c.labels, c.start)])
    free = freed(problem, other, end)
    stuck = [one for one, is_stuck in zip(c.all, free & c.at_bound(x)) if is_stuck and one.ratio_to]
    scans = tuple((one.label, tuple(part * one.high for part in SCANNED)) for one in stuck)
    labels = tuple(label for label, is_free in zip(c.labels, free) if is_free)
    runner = end.runner.of(other.recordings)

    def carried_out(plan: Sequence[Stage], x: Array) -> Iterator[Fit]:
        """The fit of the last stage, if none is lost."""
        with suppress(Unreachable):
            yield run_plan(other, runner, plan, x, loss=loss, notify=notify).fit

    once = Stage("once more", end.which, labels, end.rtol, REFITS, ROUGH, scanned=scans)
    fits = [*carried_out([once], x)]
    if one is not None and one.kind != "sensor" and end.far and joint is None:
        with suppress(Unreachable):
            plan = default_plan(other, runner, end.rtol, end.which)
            if set(plan[-1].free) == set(labels):
                fits += carried_out(plan, c.start)
    if one is None and not fits:  # it stays where it ended
        chi2 = float(np.mean(end.base.r**2))
        fits = [Fit(end.x, chi2, 0, False, end.steps, end.base._replace(J=end.at.J))]
    return Refit(other, min(fits, key=lambda fit: fit.chi2), free) if fits else None
