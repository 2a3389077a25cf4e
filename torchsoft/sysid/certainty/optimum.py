"""Where a fit ended, and the posterior density around it on steps that are frozen there, so that it is smooth.

Profiles and posteriors look at the same thing: |r|^2 / 2, the negative logarithm of the posterior density in the coordinates.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.fit import Unreachable, fisher
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import Runner

if TYPE_CHECKING:
    from torchsoft.sysid.result import IdentificationResult

CHOSEN_ANEW = 1.0
"""Change of |r|^2 by steps that are chosen anew, in place of those of the optimum, above which these are too far off."""


class Optimum:
    """Coordinates x (n,) where a fit of the recordings `which` (all by default) ended, with the steps that `rtol` chooses
    there. `free` (n,) are the coordinates that were fitted. `variance` is what the noise's is larger than it was stated, and
    widens profiles. `workers` threads may look at it side by side.

    Raises `Unreachable` where x cannot be simulated.
    """

    def __init__(
        self, problem: Problem, x: Array, *, rtol: float, which: Sequence[str] | None = None,
        free: NDArray[np.bool_] | None = None, variance: float = 1.0, workers: int = 1,
    ) -> None:  # fmt: skip
        self.problem, self.x, self.rtol, self.variance, self.workers = (
            problem,
            np.array(x, float),
            rtol,
            variance,
            workers,
        )
        self.which = tuple(problem.names if which is None else which)
        self.free = problem.coordinates.free if free is None else free
        self.runner = Runner(problem.recordings)
        self.at, self.steps = problem.freeze(self.runner, self.x, self.which, rtol, self.free)
        if self.at.lost:
            raise Unreachable(self.at.lost)
        self.square = float(self.at.r @ self.at.r)

    @classmethod
    def of(cls, problem: Problem, answer: "IdentificationResult", workers: int = 1) -> Self:
        """Where the identification of `problem` ended, with the noise that it found. Raises `ValueError` for another problem's
        answer, or one of a robust loss, which says nothing of a likelihood."""
        last, labels = answer.stages[-1], problem.coordinates.labels
        if [one.label for one in answer.coordinates] != list(labels):
            raise ValueError("this answer belongs to another problem: it does not have the same coordinates")
        if answer.made_by["loss"] != "linear":
            raise ValueError(
                f"the loss `{answer.made_by['loss']}` is no likelihood, so there is no profile and no posterior; identify with "
                "loss = 'linear'"
            )
        noise = {one.channel: one.model for one in answer.noise}
        return cls(
            problem.with_noise(noise) if noise else problem, np.array(answer.x), rtol=last["rtol"],
            which=last["recordings"], free=np.isin(labels, last["free"]), variance=max(1.0, answer.chi2), workers=workers,
        )  # fmt: skip

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the free coordinates."""
        return tuple(label for label, free in zip(self.problem.coordinates.labels, self.free) if free)

    @property
    def J(self) -> Array:
        """Jacobian (m, free coordinates) at x."""
        return self.at.J[:, self.free]

    @property
    def covariance(self) -> Array:
        """Of the free coordinates, by the Fisher matrix at x."""
        return fisher(self.J)[0]

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Of the free coordinates."""
        low, high = self.problem.coordinates.bounds
        return low[self.free], high[self.free]

    def place(self, z: Array) -> Array:
        """x (n,) with other free coordinates z."""
        x = self.x.copy()
        x[self.free] = z
        return x

    def values(self, z: Array) -> Array:
        """Free coordinates z (..., free coordinates) in physical units."""
        mine = [c for c, free in zip(self.problem.coordinates.all, self.free) if free]
        return np.stack([np.vectorize(c.to_value, [float])(z[..., i]) for i, c in enumerate(mine)], -1)

    def residuals(self, x: Array, derivatives: bool = False) -> Residuals:
        """Residuals at x (n,), on the steps of the optimum."""
        return self.problem.residuals(self.runner, x, self.which, self.steps, self.free if derivatives else None)

    def misfit(self, x: Array) -> tuple[float, Array, str]:
        """|r|^2 / 2 at x (n,) with its gradient by the free coordinates, by the adjoint; where a run is lost, infinite, with
        the reason."""
        value, gradient, lost = self.problem.misfit(self.runner, x, self.which, self.steps, self.free)
        return value, gradient[self.free], next((one.reason for one in lost.values()), "")

    def off(self, x: Array) -> float:
        """How much larger |r|^2 at x (n,) is by steps that the tolerance chooses there than by those of the optimum; NaN where
        one of the two fails."""
        frozen = self.residuals(x)
        fresh, _ = self.problem.freeze(self.runner, x, self.which, self.rtol)
        return float("nan") if fresh.lost or frozen.lost else float(fresh.r @ fresh.r - frozen.r @ frozen.r)
