"""Problems whose residuals are a formula, so that profiles and densities are known exactly."""

from collections.abc import Callable
from typing import Any

import numpy as np

from torchsoft.sysid.fit import Fit, Stage
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import Coordinate, Coordinates, Prior

WALL = "the disc has left the pads"


class ClosedForm:
    """A problem with n unknowns p0, p1, ..., logarithmic from 0.01 to 100, whose coordinates x (n,)
    have the residuals `of(x)` (m,); where `fails(x)`, there are none. Priors are rows more."""

    names, recordings, noise = ("data",), (), {}

    def __init__(
        self, of: Callable[[np.ndarray], Any], n: int,
        fails: Callable[[np.ndarray], bool] = lambda x: False, low: float = 1e-2, high: float = 1e2,
        prior: Prior | None = None, scale: Any = "log",
    ) -> None:  # fmt: skip
        self.of, self.fails = of, fails
        self.coordinates = Coordinates.__new__(Coordinates)
        middle = np.sqrt(low * high) if scale == "log" else 0.5 * (low + high)
        self.coordinates.all = [
            Coordinate(f"p{i}", "parameter", None, middle, low, high, scale, prior=prior)
            for i in range(n)
        ]

    def rows(self, x: np.ndarray) -> np.ndarray:
        c = self.coordinates
        return np.append(
            self.of(x), [prior.row(c.all[i].to_value(x[i]))[0] for i, prior in c.priors]
        )

    def samples(self, which: object = None) -> int:
        return len(self.of(self.coordinates.start))

    def residuals(
        self, runner: Any, x: np.ndarray, which: object, steps: object, free: Any = None
    ) -> Residuals:
        r, J, h = self.rows(x), np.zeros((len(self.rows(x)), len(x))), 1e-6
        if free is not None:
            J = (
                np.stack([self.rows(x + h * e) - self.rows(x - h * e) for e in np.eye(len(x))], -1)
                / (2 * h)
                * free
            )
        return (
            Residuals(r, J, {})
            if not self.fails(x)
            else Residuals(r + np.inf, J, {"data": FailedRun(WALL, 0.1)})
        )

    log_density, log_density_and_gradient = (
        Problem.log_density, Problem.log_density_and_gradient,
    )  # fmt: skip
    _log_density = Problem._log_density


def optimum(
    problem: Any, *x: float, free: Any = None, workers: int = 1, variance: float = 1.0
) -> Fit:
    """At the coordinates x, of which the names in `free` are fitted, by default all."""
    labels = problem.coordinates.labels if free is None else free
    stage, runner = Stage("optimum", tuple(problem.names), labels, 1e-4), Runner((), workers)
    return Fit(problem, runner, np.array(x, float), stage, variance=variance).evaluated()
