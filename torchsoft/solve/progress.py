"""State and results of a run of the stepper, chunk by chunk, and its failures."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchsoft.physics.rig import Rig
from torchsoft.solve.kernel.arrays import first_rows
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.steps import Plan


class SimulationFailed(RuntimeError):
    """A run that ended early: when and why. `time` [s]; `trajectory` holds the run until then, if
    any."""

    def __init__(self, reason: str, time: float) -> None:
        super().__init__(reason)
        self.reason, self.time = reason, time
        self.trajectory: Any = None


@dataclass
class Progress:
    """Results of the stepper so far: rows of the output grid, its steps, and its counters.

    integrals: as `Integrals` names them; recorded: forces, as `recorded_size` orders them; rate: of
    the displacements of nodal pads [m/s]; signals: values and rates, fixed coordinates last;
    stored: energy [J], nan with nodal pads.
    """

    y: Array
    integrals: Array
    recorded: Array
    rate: Array
    signals: Array
    stored: Array
    rows: int = 1
    steps: int = 0
    solves: int = 0
    failed: int = 0
    refused: int = 0
    starts: list[Array] = field(default_factory=list)
    end: float = 0.0
    origin: float = 0.0

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Rows of the outputs: states, integrals, forces, rates, signals, energies."""
        return self.y, self.integrals, self.recorded, self.rate, self.signals, self.stored

    def apart(self) -> "Progress":
        """The same with rows of its own."""
        own = ("y", "integrals", "recorded", "rate", "signals", "stored")
        return replace(self, **{name: getattr(self, name).copy() for name in own})

    @property
    def knots(self) -> Array:
        """Times of the steps' begins and ends [s] (steps + 1,); empty without steps. Of steps
        below the float64 resolution of their times one is left."""
        since = np.concatenate([*self.starts, np.full(min(self.steps, 1), self.end)])
        return since if self.origin == 0 else np.unique(self.origin + since)


@dataclass
class Segment:
    """One chunk of a taped run, or its start, which has no steps: where it began, the signals at
    its stages and outputs, and the tapes of both, or None where they are to be made again when
    needed."""

    plan: Plan
    signals: Array
    at_outputs: Array
    y: Array
    V: Array
    u_dot: Array
    rate: Array
    rows: slice
    tapes: tuple[Any, Any] | None


class Integrals:
    """Names of the running integrals [J]: energies dissipated and supplied by element, and the
    positive part of the sources' work."""

    def __init__(self, rig: Rig) -> None:
        self.dissipated = (*(f"pad_{name}" for name in rig.pads), "contact_dashpots", "slip")
        drives = tuple(f"drive_{name}" for name in rig.bodies)
        self.supplied = (*(f"control_{name}" for name in rig.actuators), "gravity", *drives)
        self.names = (*self.dissipated, *self.supplied, "injected")
        driven = {
            f"drive_{name}"
            for name, body in rig.bodies.items()
            if "driven" in body.freedom.values()
        }
        self.active = {name for name in self.supplied if not name.startswith("drive_")} | driven


@dataclass
class RunState:
    """A run in progress: the state, the rig's arrays, Newton's scratch, the last step, the
    integrals, and where its results go."""

    y: Array
    system: Any
    work: Any
    step: Any
    integrals: Array
    out: Progress
    segments: list[Segment] | None
    tape_bytes: float
    outputs_too: bool = True
    taped: int = 0

    @property
    def taping(self) -> bool:
        return self.segments is not None and self.taped < self.tape_bytes

    @property
    def _kept(self) -> tuple[Array, ...]:
        """Where the run stands: state, Newton's guesses, integrals."""
        return self.y, self.work.V, self.work.u_dot, self.work.rate, self.integrals

    def copy(self) -> tuple[Array, ...]:
        return tuple(part.copy() for part in self._kept)

    def back(self, before: tuple[Array, ...]) -> None:
        for part, value in zip(self._kept, before):
            part[:] = value

    def keep(
        self, plan: Plan, signals: Array, at_outputs: Array,
        before: tuple[Array, ...], rows: slice, tapes: tuple[Any, Any] | None,
    ) -> None:  # fmt: skip
        """Note the steps that were taken, and the tape of their derivatives."""
        if len(plan.h) > 0:
            self.out.starts.append(plan.starts)
            self.out.end = float(plan.starts[-1] + plan.h[-1])
        elif len(plan.out_step) == 0:
            return
        if self.segments is not None:
            kept = None
            if tapes is not None:
                counts = 2 * len(plan.h), len(plan.out_step) if self.outputs_too else 0
                kept = first_rows(tapes[0], counts[0]), first_rows(tapes[1], counts[1])
                self.taped += sum(x.nbytes for tape in kept for x in tape)
            y, V, u_dot, rate, _ = before
            self.segments.append(Segment(plan, signals, at_outputs, y, V, u_dot, rate, rows, kept))
