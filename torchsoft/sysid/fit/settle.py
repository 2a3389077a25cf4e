"""The end of a fit: are its frozen steps still those that the tolerance would choose, and is the tolerance tight enough?

Both are measured on the data at hand. A run at the estimates, whose steps are chosen anew, and one with a tenth of the
tolerance have other residuals; projected on the Jacobian, the difference is how far the estimates would move.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.fit.fit import Fit, Notify, chord, gauss_newton, settled
from torchsoft.sysid.fit.information import shift, standard_deviations
from torchsoft.sysid.fit.plan import Stage
from torchsoft.sysid.problem.problem import Problem, Residuals, StepsByName
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.workers import Runner

STEP_BIAS = 0.5
"""Shift of an estimate by the finite steps, over its standard deviation, above which the tolerance is called too coarse."""

FINER = 0.1
"""The tolerance of the check over the one that is checked."""

REFITS, EXACT = 15, 1e-6
"""Evaluations with Jacobians of their own that such a fit may take, and its relative tolerance."""

ROUNDS = 3
"""How often a fit goes on with steps chosen anew at its end."""


class Settled(NamedTuple):
    """A fit at its end: coordinates x (n,), residuals there by steps that `rtol` chooses at x, with the last Jacobian; how far
    the steps have moved every coordinate (n,), None where that could not be checked; the fits on other steps since; the
    residuals by a tenth of the tolerance, those of `at` where these could not be had; and whether the fit is `at_rest`: with
    steps chosen anew no coordinate would move by more than `SETTLED` standard deviations (where steps are only checked:
    whether the fit has converged)."""

    x: Array
    at: Residuals
    rtol: float
    bias: Array | None
    fits: list[tuple[float, Fit]]
    finer: Residuals
    at_rest: bool


def settle(
    problem: Problem, runner: Runner, stage: Stage, fit: Fit, free: NDArray[np.bool_], tightenings: int, notify: Notify
) -> Settled:
    """Go on from a fit, by its Jacobian and a few runs: with steps chosen anew until they do not matter, and with a tighter
    tolerance, at most so many times, where a tenth of it shifts an estimate by more than `STEP_BIAS`. With none the steps
    are kept, and only checked."""
    x, which, rtol, left, fits = fit.x, stage.recordings, stage.rtol, tightenings, []
    at = fit.at or problem.residuals(runner, x, which, fit.steps, free)
    rounds = ROUNDS if tightenings else 0

    def along(start: Residuals, steps: StepsByName) -> bool:
        """A fit on other steps from residuals on them, by new Jacobians where the last one does not lead to its end; whether
        it came any further."""
        nonlocal x, at
        common: dict[str, Any] = {"which": which, "free": free, "steps": steps, "notify": notify}
        end = chord(problem, runner, x, start._replace(J=at.J), **common)
        if not end.converged:
            end = gauss_newton(problem, runner, end.x, evaluations=REFITS, tolerance=EXACT, **common)
        assert end.at is not None
        if further := bool((end.x != x).any()):
            fits.append((rtol, end))
            x, at = end.x, end.at
        return further

    while True:
        fresh, steps = problem.freeze(runner, x, which, rtol)
        if fresh.lost:
            return Settled(x, at, rtol, None, fits, at, at_rest=False)
        end = fresh._replace(J=at.J)
        at_rest = settled(problem, x, end, free) if tightenings else fit.converged
        if rounds and not at_rest:
            rounds -= 1
            if along(fresh, steps):
                continue
        finer, steps = problem.freeze(runner, x, which, FINER * rtol)
        if finer.lost:
            return Settled(x, end, rtol, None, fits, end, at_rest)
        J, bias = at.J[:, free], np.zeros(len(x))
        bias[free] = shift(J, finer.r - at.r)
        if left and not (at_rest and (np.abs(bias[free]) <= STEP_BIAS * standard_deviations(J)).all()):
            left, rounds, rtol = left - 1, ROUNDS, FINER * rtol
            if along(finer, steps):
                continue
            rtol /= FINER
        return Settled(x, end, rtol, bias, fits, finer._replace(J=at.J), at_rest)
