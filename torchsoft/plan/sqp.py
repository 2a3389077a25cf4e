"""Sequential quadratic programming for a plan, by SciPy's SLSQP, in stages that go part of the way
to the targets where a whole step leads to a run that fails."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import minimize

from torchsoft.plan.knots import Array
from torchsoft.plan.problem import Evaluation
from torchsoft.plan.search import WITHIN, Search
from torchsoft.solve.gradients import GradientFailed

STAGES, SHORTER, SHORTEST = 30, 0.4, 0.01
"""Most stages; the factor on the fraction of the way to the targets after a failed run; and the
least such fraction."""

DONE = 0.1
"""Errors, over those at the start, at which a stage on the way to the targets ends."""

ACCURACY = 1e-4
"""Change of the value and excess below which SLSQP ends."""

PATIENCE, ENOUGH = 6, 3
"""Evaluations without improvement after which SLSQP ends: in general, and where all targets and
limits are kept."""


class Settled(Exception):
    """The search no longer improves, or a stage is complete."""


class Failed(Exception):
    """A run within a step of the search failed."""


def slsqp(search: Search, z: Array, iterations: int) -> None:
    """Search from z on. Where a step leads to a run that fails, it aims for a fraction of the way
    to the targets first."""
    share = 1.0
    for _ in range(STAGES):
        stage, before = Stage(search, z, share), search.best_visit
        try:
            failed, converged = False, stage.run(iterations)
        except Settled:
            failed, converged = False, False
        except (Failed, GradientFailed):
            failed, converged = True, False
        better = search.best_visit != before
        if stage.reached is not None:
            z = stage.reached.z
        elif better:
            z = search.found.z
        if failed or not (better or converged or stage.reached is not None):
            share *= SHORTER
            if share < SHORTEST:
                return
        elif stage.aim is None and (converged or search.best_visit.missed == 0):
            return
        else:
            share = min(1.0, share / SHORTER)


class Stage:
    """One call of SLSQP from z, a `share` of the way to the targets, with the objective lowered by
    that, so that steps along it are shorter. `aim` are the mean errors that it is to end with, None
    for the targets themselves, and `reached` is the plan that has them.

    SLSQP sees the ways x between knots, in which the price of change is round.
    """

    def __init__(self, search: Search, z: Array, share: float) -> None:
        self.search, self.criterion, self.share = search, search.criterion, share
        self.variables = search.evaluator.variables
        self._inverse: Array = np.linalg.inv(self.variables.D).astype(np.float64)
        start = search.evaluate(z)
        errors = start.errors.mean(0)
        self.aim = (1 - share) * errors if share < 1 and len(errors) else None
        self._way = share * float(np.abs(errors).max(initial=0.0))
        self.reached: Evaluation | None = None
        self._x = self.variables.D @ z
        search.improved = len(search.history)

    def run(self, iterations: int) -> bool:
        """Whether SLSQP converges. Raises `Settled`, `Failed` and `GradientFailed`."""
        found = minimize(
            self._objective, self._x, jac=self._gradient, method="SLSQP",
            bounds=list(zip(self.variables.low, self.variables.high)),
            constraints=self._constraints(), options={"maxiter": iterations, "ftol": ACCURACY},
        )  # fmt: skip
        return found.status == 0

    def _step(self, x: Array) -> Evaluation:
        """The plan at x. Raises `Failed`."""
        evaluation = self.search.evaluate(self._inverse @ x)
        if evaluation.failure:
            raise Failed
        return evaluation

    def _objective(self, x: Array) -> float:
        evaluation, search = self._step(x), self.search
        waited = len(search.history) - search.improved
        if waited > (PATIENCE if search.best_visit.missed else ENOUGH):
            raise Settled
        if self.aim is not None:
            left = np.abs(evaluation.errors.mean(0) - self.aim).max()
            if evaluation.excess.max(initial=0.0) <= DONE and left <= DONE * self._way:
                self.reached = evaluation
                raise Settled
        return self.share * self.criterion.value(evaluation)

    def _gradient(self, x: Array) -> Array:
        return self.share * self.criterion.spread_slope(self._step(x)) @ self._inverse

    def _constraints(self) -> list[dict[str, Any]]:
        """Bounds of motions, targets and limits, in SciPy's form. SLSQP accepts no more equations
        than variables: more targets than that become bands, of half of what a search aims for."""
        variables, terms, by_x = self.variables, self.search.evaluator.terms, self._inverse
        aim, rows = 0.0 if self.aim is None else self.aim, -variables.A @ by_x
        out = list[dict[str, Any]]()

        def add(kind: str, value: Callable[[Array], Any], slope: Callable[[Array], Any]) -> None:
            out.append({"type": kind, "fun": value, "jac": slope})

        if len(variables.b):
            add("ineq", lambda x: variables.b + rows @ x, lambda _: rows)
        if terms.targets:
            kind, signs, band = "eq", np.ones((1, 1)), 0.0
            if self.search.found.errors.shape[1] > variables.n:
                kind, signs, band = "ineq", np.array([[1.0], [-1.0]]), 0.5 * WITHIN
            add(
                kind,
                lambda x: (band + signs * (self._step(x).errors.mean(0) - aim)).ravel(),
                lambda x: np.kron(signs, self._step(x).slopes[1].mean(0) @ by_x),
            )
        if terms.limits:
            add(
                "ineq",
                lambda x: -self._step(x).excess.ravel(),
                lambda x: -self._step(x).slopes[2].reshape(-1, variables.n) @ by_x,
            )
        return out
