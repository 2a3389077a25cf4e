"""The search of a plan: what is minimised, the best plan so far, and projected Adam for many
variables."""

import time as clock
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.stats import qmc
from tqdm import tqdm

from torchsoft.plan.knots import Array
from torchsoft.plan.problem import Evaluation, Evaluator, Variables
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

BETTER = 3e-3
"""Least relative improvement that counts, below which runs with step control are not smooth."""

PRICE = 30.0
"""Penalty factor of squared excess for Adam."""

CLIPPED = 1.0
"""Largest norm of a gradient for Adam."""

MEMORY = 0.9, 0.999
"""Adam's decay rates of the first and second moments of the gradient."""

SAME = 1e-12
"""Largest difference of variables, in their units, that counts as rounding."""


class Visit(NamedTuple):
    """An evaluation: its time [s], the value, and the miss of targets and limits, 0 if all are
    kept."""

    seconds: float
    value: float
    missed: float

    def better(self, other: "Visit") -> bool:
        """Whether it misses less, or as much at a lower value."""
        return (self.missed, self.value) < (other.missed, other.value)

    def clearly_better(self, other: "Visit") -> bool:
        """Whether it is better by more than runs with step control are rough."""
        return self.missed < (1 - BETTER) * other.missed or (
            self.missed <= other.missed and self.value < other.value - BETTER * abs(other.value)
        )


class Stopped(Exception):
    """The time limit is reached."""


class Criterion:
    """What a search minimises within targets and limits: the mean of the objective and the spread
    of the errors, while the mean errors of the draws are brought to zero."""

    def __init__(self, variables: Variables, change: float) -> None:
        self._change = change
        self._origin, self._D = variables.start, variables.D
        self.scale = 1.0  # of the objective

    def changed(self, z: Array) -> tuple[float, Array]:
        """Penalty of the change of distances and parameters since the start, and its gradient
        (n,)."""
        way = self._D @ (z - self._origin)
        return 0.5 * self._change * float(way @ way), self._change * self._D.T @ way

    def value(self, evaluation: Evaluation) -> float:
        """The function to minimise."""
        spread = evaluation.errors - evaluation.errors.mean(0)
        combined = self.scale * evaluation.value + 0.5 * np.square(spread).sum(1)
        return float(combined.mean()) + self.changed(evaluation.z)[0]

    def slope(self, evaluation: Evaluation, errors: Array) -> Array:
        """Gradient (n,) of the value, with half the squares of these `errors` (draws, k)."""
        dv, de, _ = evaluation.slopes
        slope = self.scale * dv.mean(0) + np.einsum("dk,dkn->n", errors, de) / len(dv)
        return slope + self.changed(evaluation.z)[1]

    def spread_slope(self, evaluation: Evaluation) -> Array:
        """Gradient (n,) of the value."""
        return self.slope(evaluation, evaluation.errors - evaluation.errors.mean(0))

    def priced_slope(self, evaluation: Evaluation) -> Array:
        """Gradient (n,) of the value with penalties on squared errors and excess."""
        over = 2 * PRICE * np.maximum(evaluation.excess, 0.0)
        price = np.einsum("dm,dmn->n", over, evaluation.slopes[2]) / len(over)
        return self.slope(evaluation, evaluation.errors) + price


def missed(evaluation: Evaluation) -> float:
    """Miss of targets beyond `WITHIN` of their tolerance, and of limits beyond their slack."""
    errors = np.abs(evaluation.errors).max(initial=0.0)
    excess = evaluation.excess.max(initial=0.0)
    return float(max(errors - WITHIN, 0.0) + EXCESS * max(excess - SLACK, 0.0))


class Search:
    """Evaluates plans and keeps the best: the smaller miss, then the lower value. It ends after so
    many `seconds`."""

    def __init__(
        self, evaluator: Evaluator, criterion: Criterion, seconds: float, bar: tqdm
    ) -> None:
        self.evaluator, self.criterion, self.bar = evaluator, criterion, bar
        self.began, self.seconds = clock.perf_counter(), seconds
        self.best: Evaluation | None = None
        self.best_visit = Visit(0.0, np.inf, np.inf)
        self.history: list[Visit] = []
        self.failures: list[str] = []
        self.improved = 0  # number of visits up to the last one that was clearly better
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
            self._record(evaluation)
        self._last = evaluation
        best = self.best_visit
        best_text = f"missed {best.missed:.3g}" if best.missed else f"value {best.value:.4g}"
        self.bar.set_postfix_str(f"best: {best_text}", refresh=False)
        self.bar.update()
        return evaluation

    def _record(self, evaluation: Evaluation) -> None:
        seconds = clock.perf_counter() - self.began
        visit = Visit(seconds, self.criterion.value(evaluation), missed(evaluation))
        self.history.append(visit)
        if visit.clearly_better(self.best_visit):
            self.improved = len(self.history)
        if visit.better(self.best_visit):
            self.best, self.best_visit = evaluation, visit

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
        self.evaluate(variables.start, gradient=starts == 1)
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
            self.criterion.scale = UNIT / slope if slope > 0 else 1.0
            self.best_visit = self.best_visit._replace(value=self.criterion.value(self.best))


def adam(search: Search, z: Array, iterations: int, rate: float) -> None:
    """Projected Adam from z, with a penalty on squared errors and excess."""
    adam = ProjectedAdam(z, search.evaluator.variables.nearest, MEMORY)
    for _ in range(iterations):
        evaluation = search.evaluate(adam.z)
        try:
            slope = None if evaluation.failure else search.criterion.priced_slope(evaluation)
        except GradientFailed as failure:
            search.failures.append(str(failure))
            slope = None
        if slope is None or not np.isfinite(slope).all():
            adam.set(search.found.z)
            rate *= 0.5
            continue
        norm = float(np.linalg.norm(slope))
        rate *= 0.1 ** (1 / iterations)
        adam.step(slope * min(1.0, CLIPPED / max(norm, 1e-300)), rate)
    search.evaluate(adam.z, gradient=False)


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
