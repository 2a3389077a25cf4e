"""The compiled right-hand side of a rig, as a function of numpy arrays, for other integrators."""

import numpy as np

from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig
from torchsoft.solve.kernel import arrays
from torchsoft.solve.kernel.arrays import Limits, room
from torchsoft.solve.kernel.objects import call
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.progress import Integrals, SimulationFailed
from torchsoft.solve.system import Compiled
from torchsoft.solve.tolerances import Followed

LIMITS = Limits(1e-10, 40, 2e-3)
"""Newton's tolerance [N] and iterations, and how near [m] a point has to be to count as one that
may touch."""


class Rates:
    """dy/dt = f(t, y) of a rig and its reference as they are now, compiled: tens of microseconds a
    call.

    The same as `rig.forward` to Newton's tolerance, for one state y (size,) of numpy. `calls`
    counts. An object keeps scratch of its own and the last forces as Newton's guess: one thread may
    call it at a time.

    Raises `NotImplementedError` for inertial pads.
    """

    def __init__(self, rig: Rig, reference: Reference | None = None) -> None:
        compiled = Compiled(rig)
        if compiled.inertial:
            raise NotImplementedError(
                "the rates of inertial pads are not compiled for single states; use `rig.forward`"
            )
        self._system, self._limits = compiled.system(1.0), LIMITS
        self._work = room("Work", self._system, compiled.layout.size, columns=1)
        followed = rig.reference if reference is None else reference
        self._followed = Followed(lambda t: compiled.signals(t, followed), rig, followed)
        self._signals = np.zeros((1, compiled.signal_count, 2))
        self._powers, self._wrenches = (
            np.zeros(len(Integrals(rig).names)),
            np.zeros((len(rig.pads), 3)),
        )
        self.calls = 0

    def __call__(self, t: float, y: Array) -> Array:
        """dy/dt (size,) at t [s]. Raises `SimulationFailed` where Newton finds no forces."""
        out, y = np.empty(len(y)), np.ascontiguousarray(y)
        self.calls += 1
        found = self._solve(t, y, out)
        if not found:  # once more without the last call's guess
            self._work.u_dot[:] = 0.0
            found = self._solve(t, y, out)
        if self._followed.error is not None:
            raise self._followed.error
        if not found:
            self._work.u_dot[:] = 0.0
            raise SimulationFailed(
                f"at t = {t:.6g} s Newton's iteration found no forces for the state", float(t)
            )
        return out

    def _solve(self, t: float, y: Array, out: Array) -> bool:
        """Whether Newton found the forces; the rates go to `out`."""
        converged = np.zeros(1, np.int64)
        table = arrays.Rates(
            self._system, self._work, self._followed.arrays, self._limits, float(t), y,
            self._signals, self._powers, self._wrenches, out, converged,
        )  # fmt: skip
        call("rates", table)
        return bool(converged[0])
