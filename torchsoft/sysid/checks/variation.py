"""A problem in which one assumption is otherwise: what that adds to the residuals of a fit, and where the fit would end."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.checks.assumptions import Assumption
from torchsoft.sysid.fit.fit import Fit, Notify, gauss_newton
from torchsoft.sysid.fit.robust import Loss
from torchsoft.sysid.problem.prediction import Frozen
from torchsoft.sysid.problem.problem import Problem, Residuals
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.workers import Runner

REFITS, ROUGH = 12, 1e-2
"""Evaluations that a fit under another assumption may take, and its relative tolerance: it has to find out whether the misfit
goes away, not where exactly."""


class End(NamedTuple):
    """A fit in whose place another is held: coordinates x (n,), residuals there, the free coordinates (n,), the recordings that
    were fitted, residuals and steps of runs by the tolerance `rtol`, and how runs are made and kept."""

    x: Array
    at: Residuals
    free: NDArray[np.bool_]
    which: tuple[str, ...]
    base: Residuals
    steps: dict[str, Frozen]
    rtol: float
    workers: int
    journal: Path | None


def ended(
    problem: Problem, x: Array, at: Residuals, free: NDArray[np.bool_], which: Sequence[str], rtol: float, workers: int,
    journal: Path | None,
) -> End:  # fmt: skip
    """The end of a fit, with a run a recording by the tolerance of the variations."""
    base, steps = problem.freeze(Runner(problem.recordings, workers, journal), x, which, rtol)
    return End(x, at, free, tuple(which), base, steps, rtol, workers, journal)


def varied(problem: Problem, which: Sequence[str], one: Assumption) -> Problem | str:
    """The problem with one assumption otherwise in the recordings `which`, or why there is none."""
    assert one.vary is not None
    made = []
    for recording in problem.recordings:
        other = one.vary(recording) if recording.name in which else recording
        if other is None:
            return f"it has no meaning where recording `{recording.name}` begins"
        made.append(other)
    try:
        return Problem(made, problem.sensors, problem.unknowns, problem.noise)
    except ValueError as error:  # an unknown that the varied rig has not
        return str(error)


def difference(problem: Problem, end: End, one: Assumption) -> tuple[Array | None, str]:
    """What a variation adds to the residuals (m,), on the same steps, or None and why that is not known."""
    if end.base.lost:
        return None, "the estimates cannot be simulated by the tolerance of the checks"
    other = varied(problem, end.which, one)
    if isinstance(other, str):
        return None, other
    got = other.residuals(Runner(other.recordings, end.workers, end.journal), end.x, end.which, end.steps)
    if got.lost:
        return None, f"a run failed: {next(iter(got.lost.values())).reason}"
    return got.r - end.base.r, ""


def refit(problem: Problem, end: End, one: Assumption | None, loss: Loss, notify: Notify) -> Fit | None:
    """Where the fit would end with one assumption otherwise, or with all as stated, on steps of its own; None where it cannot
    begin."""
    other = varied(problem, end.which, one) if one is not None else problem
    if isinstance(other, str):
        return None
    runner = Runner(other.recordings, end.workers, end.journal)
    first, steps = other.freeze(runner, end.x, end.which, end.rtol, end.free)
    if first.lost:
        return None
    return gauss_newton(
        other, runner, end.x, which=end.which, free=end.free, steps=steps, evaluations=REFITS, tolerance=ROUGH, loss=loss,
        first=first, notify=notify,
    )  # fmt: skip
