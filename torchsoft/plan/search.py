"""Optimisation of a plan's variables: SLSQP by SciPy, and projected Adam by torch for many
variables."""

import time as clock
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.stats import qmc
from tqdm import tqdm

from torchsoft.plan.knots import Array
from torchsoft.plan.problem import Evaluation, Evaluator
from torchsoft.solve.gradients import GradientFailed

WITHIN = 0.5
"""Fraction of a target's tolerance that a search aims for, since runs by a finer tolerance differ a
little."""

SLACK = 1e-3
"""Largest excess of a limit, over its scale, that counts as kept."""

EXCESS = 100.0
"""Weight of excess over its scale, relative to errors over their tolerance."""

UNIT = 0.3
"""Length of the first step along the objective, in units of the variables."""

PRICE = 30.0
"""Penalty factor of squared excess for Adam."""

CLIPPED = 1.0
"""Largest norm of a gradient for Adam."""

MEMORY = 0.9, 0.999
"""Adam's decay rates of the first and second moments of the gradient."""

STAGES, SHORTER, SHORTEST = 30, 0.4, 0.01
"""Most stages of SLSQP; the factor on the fraction of the way to the targets after a failed run;
and the least such fraction."""

DONE = 0.1
"""Errors, over those at the start, at which a stage on the way to the targets ends."""

ACCURACY = 1e-4
"""Change of the value and excess below which SLSQP ends."""


class Visit(NamedTuple):
    """An evaluation: its time [s], the value, and the miss of targets and limits, 0 if all are
    kept."""

    seconds: float
    value: float
    missed: float


PATIENCE, ENOUGH, BETTER = 6, 3, 3e-3
"""Evaluations without improvement after which SLSQP ends: in general, and where all targets and
limits are kept; and the least relative improvement, below which runs with step control are not
smooth."""


SAME = 1e-12
"""Largest difference of variables, in their units, that counts as rounding."""


class Stopped(Exception):
    """The time limit is reached."""


class Settled(Exception):
    """The search no longer improves, or a stage is complete."""


class Failed(Exception):
    """A run within a step of the search failed."""


class Search:
    """Evaluates plans and keeps the best: the smaller miss, then the lower value.

    With one draw, or `robust` "mean", the search minimises the mean of the objective and the spread
    of the errors, and brings the mean errors of the draws to zero; with "worst" it minimises the
    largest sum of the objective and half the squared errors.
    """

    def __init__(
        self, evaluator: Evaluator, robust: str, change: float, seconds: float, bar: tqdm
    ) -> None:
        self.evaluator, self.robust, self.change, self.bar = evaluator, robust, change, bar
        self.began, self.seconds = clock.perf_counter(), seconds
        self.origin = evaluator.variables.start
        self.best: Evaluation | None = None
        self.best_visit = Visit(0.0, np.inf, np.inf)
        self.history: list[Visit] = []
        self.failures: list[str] = []
        self.scale = 1.0
        self.at = 0  # number of the last evaluation that was clearly better
        self.aim: Array | None = None  # mean errors that a stage is to end with
        self._inverse: Array = np.linalg.inv(evaluator.variables.D).astype(np.float64)
        self._way = 0.0
        self.damping = 1.0  # of the objective, so that steps along it are shorter
        self.reached: Evaluation | None = None  # the end of a stage
        self._last: Evaluation | None = None

    def evaluate(self, z: Array, *, gradient: bool = True) -> Evaluation:
        """Evaluate the plan at z, and record it. Raises `Stopped`."""
        for known in (self._last, self.best):
            if known is not None and np.allclose(known.z, z, rtol=0, atol=SAME):
                return known
        if clock.perf_counter() - self.began > self.seconds and self.best is not None:
            raise Stopped
        try:
            evaluation = self.evaluator.evaluate(z, gradient=gradient)
        except ValueError as error:
            if not self.history:
                raise
            evaluation = Evaluation(z, torch.zeros(0), None, self.evaluator.terms, str(error))
        if evaluation.failure:
            self.failures.append(evaluation.failure)
        else:
            visit = Visit(
                clock.perf_counter() - self.began, self.value(evaluation), self.missed(evaluation)
            )
            self.history.append(visit)
            old = self.best_visit
            if visit.missed < (1 - BETTER) * old.missed or (
                visit.missed <= old.missed and visit.value < old.value - BETTER * abs(old.value)
            ):
                self.at = len(self.history)
            if (visit.missed, visit.value) < (old.missed, old.value):
                self.best, self.best_visit = evaluation, visit
        self._last = evaluation
        best = self.best_visit
        best_text = f"missed {best.missed:.3g}" if best.missed else f"value {best.value:.4g}"
        self.bar.set_postfix_str(f"best: {best_text}", refresh=False)
        self.bar.update()
        return evaluation

    def value(self, evaluation: Evaluation) -> float:
        """The function to minimise within targets and limits."""
        if self._worst:
            combined = self._costs(evaluation).max()
        else:
            spread = evaluation.errors - evaluation.errors.mean(0)
            combined = (self.scale * evaluation.value + 0.5 * np.square(spread).sum(1)).mean()
        return float(combined) + self.changed(evaluation.z)[0]

    def changed(self, z: Array) -> tuple[float, Array]:
        """Penalty of the change of distances and parameters since the start, and its gradient
        (n,)."""
        D = self.evaluator.variables.D
        way = D @ (z - self.origin)
        return 0.5 * self.change * float(way @ way), self.change * D.T @ way

    def missed(self, evaluation: Evaluation) -> float:
        """Miss of targets beyond `WITHIN` of their tolerance, and of limits beyond their slack."""
        errors = np.abs(evaluation.errors).max(initial=0.0)
        excess = evaluation.excess.max(initial=0.0)
        return float(max(errors - WITHIN, 0.0) + EXCESS * max(excess - SLACK, 0.0))

    @property
    def found(self) -> Evaluation:
        """The best plan so far."""
        assert self.best is not None
        return self.best

    def refine(self, rtol: float) -> None:
        """Change the relative tolerance, and evaluate the best plan anew, with its gradient. The
        old best is kept where that fails or is interrupted."""
        self.evaluator.rtol, z, known = rtol, self.found.z, (self.best, self.best_visit)
        self.best, self._last, self.best_visit = None, None, Visit(0.0, np.inf, np.inf)
        try:
            self.evaluate(z)
        finally:
            if self.best is None:
                self.best, self.best_visit = known

    def begin(self, starts: int, seed: int) -> None:
        """Evaluate the starts: the given plan, and Sobol points within all bounds. Raises
        `ValueError` where none can be run."""
        variables = self.evaluator.variables
        self.evaluate(self.origin, gradient=starts == 1)
        if starts > 1:
            sampler = qmc.Sobol(variables.n, rng=np.random.default_rng(seed))
            for u in sampler.random_base2((starts - 1).bit_length())[: starts - 1]:
                self.evaluate(variables.spread(u), gradient=False)
        if self.best is None:
            raise ValueError(f"no start of the plan can be run: {self.failures[0]}")
        if starts > 1:
            self.refine(self.evaluator.rtol)
        if self.evaluator.terms.objective is not None:
            slope = float(np.linalg.norm(self.evaluate(self.best.z).slopes[0].mean(0)))
            self.scale = UNIT / slope if slope > 0 else 1.0
            self.best_visit = self.best_visit._replace(value=self.value(self.best))

    def slsqp(self, z: Array, iterations: int) -> None:
        """Sequential quadratic programming from z. Where a step leads to a run that fails, it aims
        for a fraction of the way to the targets first."""
        share = 1.0
        for _ in range(STAGES):
            start = self.evaluate(z)
            errors = start.errors.mean(0)
            self.aim = (1 - share) * errors if share < 1 and len(errors) else None
            self._way = share * float(np.abs(errors).max(initial=0.0))
            self.reached = None
            self.at, before = len(self.history), self.best_visit
            try:
                found = minimize(
                    self._objective, self._x(z), jac=self._gradient, method="SLSQP",
                    bounds=self._bounds(), constraints=self._constraints(),
                    options={"maxiter": iterations, "ftol": ACCURACY},
                )  # fmt: skip
                failed, done = False, found.status == 0
            except Settled:
                failed, done = False, False
            except (Failed, GradientFailed):
                failed, done = True, False
            better = self.best_visit != before
            if self.reached is not None:
                z = self.reached.z
            elif better:
                z = self.found.z
            if failed or not (better or done or self.reached is not None):
                share, self.damping = share * SHORTER, self.damping * SHORTER
                if share < SHORTEST:
                    return
                continue
            if self.aim is None and (done or self.best_visit.missed == 0):
                return
            share = min(1.0, share / SHORTER)
            self.damping = min(1.0, self.damping / SHORTER)

    def adam(self, z: Array, iterations: int, rate: float) -> None:
        """Projected Adam from z, with a penalty on squared errors and excess."""
        adam = ProjectedAdam(z, self.evaluator.variables.nearest, MEMORY)
        for _ in range(iterations):
            evaluation = self.evaluate(adam.z)
            try:
                slope = None if evaluation.failure else self._priced(evaluation)
            except GradientFailed as failure:
                self.failures.append(str(failure))
                slope = None
            if slope is None or not np.isfinite(slope).all():
                adam.set(self.found.z)
                rate *= 0.5
                continue
            norm = float(np.linalg.norm(slope))
            rate *= 0.1 ** (1 / iterations)
            adam.step(slope * min(1.0, CLIPPED / max(norm, 1e-300)), rate)
        self.evaluate(adam.z, gradient=False)

    def _priced(self, evaluation: Evaluation) -> Array:
        """Gradient (n,) of the value with penalties on squared errors and excess."""
        dx = evaluation.slopes[2]
        over = 2 * PRICE * np.maximum(evaluation.excess, 0.0)
        each = self._cost_slopes(evaluation) + np.einsum("dm,dmn->dn", over, dx)
        of = each[int(np.argmax(self._costs(evaluation)))] if self._worst else each.mean(0)
        return of + self.changed(evaluation.z)[1]

    # SLSQP sees x = (ways, s): in these the price of change is round; s bounds what the worst draw
    # costs
    # ----------------------------------------------------------------------

    def _x(self, z: Array) -> Array:
        ways = self.evaluator.variables.D @ z
        return np.append(ways, self._costs(self.evaluate(z)).max()) if self._worst else ways

    def _by_x(self, slopes: Array, s: float = 0.0) -> Array:
        """Derivatives (..., n) by z, converted to derivatives by x."""
        by_ways = slopes @ self._inverse
        pad = [(0, 0)] * (slopes.ndim - 1) + [(0, int(self._worst))]
        return np.pad(by_ways, pad, constant_values=s)

    def _step(self, x: Array) -> Evaluation:
        """The plan at x. Raises `Failed`."""
        evaluation = self.evaluate(self._inverse @ x[: self.evaluator.variables.n])
        if evaluation.failure:
            raise Failed
        return evaluation

    def _objective(self, x: Array) -> float:
        evaluation = self._step(x)
        if len(self.history) - self.at > (PATIENCE if self.best_visit.missed else ENOUGH):
            raise Settled
        if self.aim is not None:
            left = evaluation.errors.mean(0) - self.aim
            over = evaluation.excess.max(initial=0.0)
            if over <= DONE and np.abs(left).max() <= DONE * self._way:
                self.reached = evaluation
                raise Settled
        value = (
            float(x[-1]) + self.changed(evaluation.z)[0] if self._worst else self.value(evaluation)
        )
        return self.damping * value

    def _gradient(self, x: Array) -> Array:
        evaluation = self._step(x)
        out = self.changed(evaluation.z)[1]
        if self._worst:
            return self.damping * self._by_x(out, 1.0)
        dv, de, _ = evaluation.slopes
        spread = evaluation.errors - evaluation.errors.mean(0)
        return self.damping * self._by_x(
            out + self.scale * dv.mean(0) + np.einsum("dk,dkn->n", spread, de) / len(dv)
        )

    def _constraints(self) -> list[dict[str, Any]]:
        variables, terms = self.evaluator.variables, self.evaluator.terms
        n, aim = variables.n, 0.0 if self.aim is None else self.aim
        out = []

        def add(
            kind: str, of: Callable[[Evaluation], Array], by: Callable[[Evaluation], Array]
        ) -> None:
            out.append({
                "type": kind, "fun": lambda x: of(self._step(x)),
                "jac": lambda x: self._by_x(by(self._step(x))),
            })  # fmt: skip

        if len(variables.b):
            rows = self._by_x(-variables.A)
            out.append({
                "type": "ineq", "fun": lambda x: variables.b + rows @ x, "jac": lambda x: rows,
            })  # fmt: skip
        if terms.targets and not self._worst:
            add("eq", lambda one: one.errors.mean(0) - aim, lambda one: one.slopes[1].mean(0))
        if terms.limits:
            add("ineq", lambda one: -one.excess.ravel(), lambda one: -one.slopes[2].reshape(-1, n))
        if self._worst:
            out.append({
                "type": "ineq", "fun": lambda x: x[-1] - self._costs(self._step(x)),
                "jac": lambda x: self._by_x(-self._cost_slopes(self._step(x)), 1.0),
            })  # fmt: skip
        return out

    @property
    def _worst(self) -> bool:
        return self.robust == "worst"

    def _costs(self, evaluation: Evaluation) -> Array:
        return self.scale * evaluation.value + 0.5 * np.square(evaluation.errors).sum(1)

    def _cost_slopes(self, evaluation: Evaluation) -> Array:
        dv, de, _ = evaluation.slopes
        return self.scale * dv + np.einsum("dk,dkn->dn", evaluation.errors, de)

    def _bounds(self) -> list[tuple[float | None, float | None]]:
        variables = self.evaluator.variables
        ends = [
            (None if np.isinf(low) else low, None if np.isinf(high) else high)
            for low, high in zip(variables.low, variables.high)
        ]
        return [*ends, *([(None, None)] if self._worst else [])]


# Projected Adam, for plans with many variables and for designed motions.


class ProjectedAdam:
    """Adam from a point z (n,) with projection by `nearest`. `memory` holds the decay rates of the
    first and second moments of the gradient."""

    def __init__(
        self, start: Array, nearest: Callable[[Array], Array], memory: tuple[float, float]
    ) -> None:
        self._z = torch.from_numpy(start.copy()).requires_grad_()
        self._adam, self._nearest = torch.optim.Adam([self._z], betas=memory), nearest

    @property
    def z(self) -> Array:
        return self._z.detach().numpy().copy()

    def step(self, slope: Array, rate: float) -> None:
        """Step against the gradient (n,), each variable by about `rate`."""
        self._adam.param_groups[0]["lr"] = rate
        self._z.grad = torch.from_numpy(slope)
        self._adam.step()
        self.set(self._nearest(self.z))

    def set(self, z: Array) -> None:
        """Move to another point and keep the moments of the gradient."""
        self._z.data.copy_(torch.from_numpy(z))
