"""The search for a motion: Adam on the smoothed criterion; the best motion evaluated is kept.

The criterion's slopes (`planner`) are exact, and rough: points that touch, leave and slip earlier or later give it kinks at
distances of micrometres, each a large slope that means nothing a tenth of a millimetre on. So what is lowered is the
criterion smoothed over small random motions and over draws of the parameters, by stochastic gradients (Adam): each
iteration takes one draw and one random shift, which makes the motion robust at no further cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from torchsoft.solve.adjoint import GradientFailed
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.design.knots import Moves
from torchsoft.sysid.design.planner import PRICE, DesignEvaluation, Planner
from torchsoft.sysid.recording import Array

OUTLIER = 10.0
"""Slopes beyond so many medians are cut."""

MEMORY = 0.85, 0.97
"""How much of its slopes, and of their squares, Adam remembers from one iteration to the next."""

LOOK = 10
"""Iterations between two looks at the motion itself, with all draws and no random shift."""

FAILURES = 5
"""Runs lost one after the other until the search goes back to the best motion so far."""


@dataclass(frozen=True)
class Visit:
    """The motion after some iterations: the criterion over all draws, and how much of the way to its limit a channel goes."""

    iteration: int
    value: float
    peak: float

    @property
    def score(self) -> float:
        """The criterion, and a price of excess."""
        return self.value + PRICE * max(0.0, self.peak - 1.0)


class Search:
    """Adam on the smoothed criterion, projected on what knots may do; keeps the best motion that was looked at."""

    def __init__(
        self, planner: Planner, points: Sequence[Array], robust: str, rate: float, smoothing: float, seed: int
    ) -> None:
        self.planner, self.points, self.robust, self.rate, self.smoothing = planner, points, robust, rate, smoothing
        self.rng, self.iteration, self.lost, self.in_a_row = np.random.default_rng(seed), 0, 0, 0

    def begin(self) -> DesignEvaluation:
        """The look at the motion given, which is the best so far. Raises `ValueError` where it cannot be run."""
        try:
            first = self.planner.look(self.planner.moves.start, self.points[0])
        except SimulationFailed as failure:
            raise ValueError(f"the motion given cannot be run, so that nothing can begin with it: {failure}") from None
        self.set_out(self.planner.moves, first)
        return first

    def set_out(self, moves: Moves, seen: DesignEvaluation) -> None:
        """From the motion of some knots on, by gradient."""
        self.planner, self.seen, self.z = self.planner.of(moves), seen, moves.start
        self.now = torch.from_numpy(self.z.copy()).requires_grad_(True)
        self.adam = torch.optim.Adam([self.now], lr=self.rate, betas=MEMORY)
        self.best, _ = self.visit(self.z)
        self.history = [self.best]

    def visit(self, z: Array) -> tuple[Visit, DesignEvaluation | None]:
        """What a motion is worth over all points, infinite where it is lost, and the look at it at the first."""
        try:
            looks = [self.planner.look(z, x) for x in self.points]
        except SimulationFailed:
            return Visit(self.iteration, np.inf, np.inf), None
        values = [one.value for one in looks]
        peak = max(max(one.peaks.values(), default=0.0) for one in looks)
        value = max(values) if self.robust == "worst" else float(np.mean(values))
        return Visit(self.iteration, value, peak), looks[0]

    def look(self) -> None:
        """Keeps the motion as it is now, if it is the best."""
        z = self.now.detach().numpy().copy()
        visit, seen = self.visit(z)
        self.history.append(visit)
        if seen is not None and visit.score < self.best.score:
            self.best, self.seen, self.z = visit, seen, z

    def move(self, iterations: int) -> None:
        """One step, or none where the motion is lost."""
        moves, z = self.planner.moves, self.now.detach().numpy()
        try:
            shifted = moves.nearest(z + self.smoothing * self.rng.standard_normal(moves.n))
            if self.robust == "worst":
                looks = [self.planner.look(shifted, x) for x in self.points]
                k = int(np.argmax([one.value for one in looks]))
                x, there = self.points[k], looks[k]
            else:
                x = self.points[int(self.rng.integers(len(self.points)))]
                there = self.planner.look(shifted, x)
            slopes = self.planner.slopes(shifted, x, there)
        except (SimulationFailed, GradientFailed):
            self.lost, self.in_a_row = self.lost + 1, self.in_a_row + 1
            if self.in_a_row >= FAILURES:
                self.in_a_row, self.rate = 0, 0.5 * self.rate
                with torch.no_grad():
                    self.now.copy_(torch.from_numpy(self.z))
            return
        self.iteration, self.in_a_row = self.iteration + 1, 0
        most = OUTLIER * float(np.median(np.abs(slopes)))
        self.now.grad = torch.from_numpy(np.clip(slopes, -most, most))
        part = self.iteration / iterations
        self.adam.param_groups[0]["lr"] = self.rate * min(1.0, self.iteration / 5) * (0.1 + 0.9 * (1 - part))
        self.adam.step()
        with torch.no_grad():
            self.now.copy_(torch.from_numpy(moves.nearest(self.now.detach().numpy())))
        if self.iteration % LOOK == 0:
            self.look()
