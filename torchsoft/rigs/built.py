"""A rig that is ready to run."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from torchsoft.physics.arguments import Numbers
from torchsoft.physics.rig import Rig
from torchsoft.physics.start import Starts, start
from torchsoft.solve.simulate import simulate
from torchsoft.solve.trajectory import Trajectory

STEPPING = ("rtol", "atol", "step", "knots")
"""Arguments of `simulate` that choose the steps."""


@dataclass(frozen=True)
class BuiltRig:
    """A rig with the reference that it follows, its state y0 (size,) at the start, and the times t
    (T,) [s] of the outputs, the last of which is the end of the motion.

    `starts` are the coordinates and rates from which `y0` was made, by body, and `solver` the
    choice of steps. Unpacks to rig, y0, t.
    """

    rig: Rig
    y0: Tensor
    t: Tensor
    starts: Starts = field(default_factory=dict, repr=False)
    solver: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __iter__(self) -> Iterator[Any]:
        return iter((self.rig, self.y0, self.t))

    def start(self) -> Tensor:
        """The state (size,) at the start, for the parameters that the rig has now, which it is
        differentiable in. Raises `NoEquilibrium`."""
        return start(self.rig, self.starts)

    def run(self, t: Numbers | None = None, **options: Any) -> Trajectory:
        """The run, by `simulate` with its `options`: over the times t, from `y0` and by steps as
        the rig file chooses them, where they are not given."""
        own = STEPPING if any(options.get(name) is not None for name in STEPPING) else ()
        solver = {name: value for name, value in self.solver.items() if name not in own}
        given: dict[str, Any] = {"y0": self.y0} | solver | options
        return simulate(self.rig, self.t if t is None else t, **given)
