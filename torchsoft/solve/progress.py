"""State and results of a run of the stepper, chunk by chunk, and its failures."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from torchsoft.solve.kernel.arrays import Tape
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.steps import Plan


class SimulationFailed(RuntimeError):
    """A run that ended early: when and why. `time` [s]; `contact` is that whose body was lost, ""
    for another cause, and `left` whether the body left the space over the pad; `trajectory` holds
    the run until then, if any."""

    def __init__(self, reason: str, time: float, contact: str = "", left: bool = False) -> None:
        super().__init__(reason)
        self.reason, self.time, self.contact, self.left = reason, time, contact, left
        self.trajectory: Any = None


@dataclass
class Stats:
    """Statistics of a run: steps, linear solves (Newton iterations), steps that Newton did not
    solve and that were shortened, steps rejected for their error, and wall time [s]."""

    steps: int
    newton_iterations: int
    failed_steps: int
    refused_steps: int
    wall_s: float

    @property
    def newton_per_step(self) -> float:
        return self.newton_iterations / max(self.steps, 1)


@dataclass
class Progress:
    """Results of the stepper so far: rows of the output grid, its steps, and its counters.

    integrals: energies [J], as `physics.energy.integrals` numbers them; recorded: forces, as
    `recorded_slices` orders them; rate: of the displacements of nodal pads [m/s]; signals: values
    and rates, fixed coordinates last; stored: energy [J], nan with nodal pads.
    """

    y: Array
    integrals: Array
    recorded: Array
    rate: Array
    signals: Array
    stored: Array
    rows: int = 0
    stats: Stats = field(default_factory=lambda: Stats(0, 0, 0, 0, 0.0))
    starts: list[Array] = field(default_factory=list)
    end: float = 0.0
    origin: float = 0.0

    def part(self, rows: slice) -> tuple[Array, ...]:
        """Some rows of the outputs: states, integrals, forces, rates, signals, energies."""
        every = self.y, self.integrals, self.recorded, self.rate, self.signals, self.stored
        return tuple(part[rows] for part in every)

    @property
    def knots(self) -> Array:
        """Times of the steps' begins and ends [s] (steps + 1,); empty without steps. Of steps
        below the float64 resolution of their times one is left."""
        since = np.concatenate([*self.starts, np.full(min(self.stats.steps, 1), self.end)])
        return since if self.origin == 0 else np.unique(self.origin + since)


class Segment(NamedTuple):
    """One chunk of a taped run: its steps, its rows of the outputs and their signals, where it
    began, and the tapes of its stages and outputs, or None where they are to be made again when
    needed."""

    plan: Plan
    rows: slice
    at_outputs: Array
    before: tuple[Array, ...]
    tapes: tuple[Any, Any] | None

    @property
    def stages(self) -> Array:
        """Signals at the stages (stages, signals, 2)."""
        signals = self.plan.signals
        return signals.reshape(2 * len(signals), *signals.shape[2:])


@dataclass
class RunState:
    """A run in progress: its room and the state in it, where its results go, and the segments of a
    taped run."""

    room: Any
    y: Array
    out: Progress
    segments: list[Segment] | None
    tape_bytes: float
    outputs_too: bool = True
    taped: int = 0

    @property
    def taping(self) -> bool:
        return self.segments is not None and self.taped < self.tape_bytes

    @property
    def stands(self) -> tuple[Array, ...]:
        """Where the run stands: state, Newton's guesses, and the places of the bodies."""
        work = self.room.work
        return self.y, work.V, work.u_dot, work.rate, work.inner_before

    def keep(
        self, plan: Plan, rows: slice, before: tuple[Array, ...], tapes: tuple[Any, Any] | None
    ) -> None:
        """Note the steps that were taken, and the tape of their derivatives."""
        if len(plan.h) > 0:
            self.out.starts.append(plan.starts.copy())
            self.out.end = float(plan.starts[-1] + plan.h[-1])
        if self.segments is not None and (len(plan.h) or len(plan.out_step)):
            if tapes is not None:
                counts = 2 * len(plan.h), len(plan.out_step)
                tapes = tuple(  # pyright: ignore[reportAssignmentType]
                    Tape(*(x if len(x) <= n else x[:n].copy() for x in tape))
                    for tape, n in zip(tapes, counts)
                )
                self.taped += sum(x.nbytes for tape in tapes for x in tape)
            at = self.out.signals[rows]
            self.segments.append(Segment(plan, rows, at, before, tapes))
