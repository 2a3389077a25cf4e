"""The implicit stepper: the compiled kernels fed from a rig, chunk by chunk."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.arguments import positive, whole
from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig
from torchsoft.physics.validity import check_array
from torchsoft.solve.grid import Chunk, check_times, chunks
from torchsoft.solve.kernel.arrays import Array, Tape, Work, empty_tape, first_stages, scratch
from torchsoft.solve.kernel.run import (
    CONVERGED,
    GAMMA,
    LOST,
    NEWTON_FAILED,
    NOT_FINITE,
    OFF_THE_PAD,
    TAPE_FULL,
    run,
)
from torchsoft.solve.system import Compiled

HALVINGS = 6
"""How often a step that Newton does not solve is halved before the run is given up."""

SMALLEST_TOLERANCE = 1e-10
"""Newton tolerance [N] that the ready excitations can meet: at a tenth of it one step in ten is halved because of rounding."""

INSTANT = 1e-13
"""Length [s] of the stage that gives the forces at the start: nothing moves in it."""

METHOD = "sdirk2"
"""Name under which `torchdiffeq.odeint` knows the stepper once torchsoft is imported."""


class SimulationFailed(RuntimeError):
    """A run that ended early: when and why. `time` [s]; `trajectory` holds what was simulated until then, if any."""

    def __init__(self, reason: str, time: float) -> None:
        super().__init__(reason)
        self.reason, self.time = reason, time
        self.trajectory: Any = None


@dataclass
class Progress:
    """What the stepper has produced so far: rows of the output grid, and its counters.

    extras: running integrals, the pads' moments, the generalised contact forces on all coordinates (`Integrals` names them).
    """

    y: Array
    forces: Array
    extras: Array
    rows: int = 1
    steps: int = 0
    solves: int = 0
    failed: int = 0


@dataclass
class Segment:
    """One chunk of a taped run: where it began, its signals, and its tape, or None where it is to be made again when needed."""

    chunk: Chunk
    signals: Array
    y: Array
    V: Array
    u_dot: Array
    rows: slice
    tape: Tape | None


class Integrals:
    """Names of the running integrals [J]: dissipated by, supplied by, and the positive part of what the sources supply."""

    def __init__(self, rig: Rig) -> None:
        self.dissipated = (*(f"pad_{name}" for name in rig.pads), "contact_dashpots", "slip")
        drives = tuple(f"drive_{name}" for name in rig.bodies)
        self.supplied = (*(f"control_{name}" for name in rig.actuators), "gravity", *drives)
        self.names = (*self.dissipated, *self.supplied, "injected")
        driven = {f"drive_{name}" for name, body in rig.bodies.items() if "driven" in body.freedom.values()}
        self.active = {name for name in self.supplied if not name.startswith("drive_")} | driven


class ImplicitStepper:
    """SDIRK2 on one rig and reference as they are now: L-stable, second order, stiffly accurate.

    `step` [s] is the largest step; every output interval is cut into equal steps no longer than it. Newton stops when
    the contact law and the linear relations agree to `tolerance` [N] at every node; a step that it does not solve is taken as
    two of half the length, and so on up to `HALVINGS` times. `window` [m] is how near a point has to be to count as one
    that may
    touch (checked after every stage; only speed depends on it). Raises `ValueError` for a tolerance below
    `SMALLEST_TOLERANCE`.
    """

    def __init__(
        self, rig: Rig, reference: Reference | None = None, *, step: float = 2e-3, tolerance: float = 1e-9,
        max_iterations: int = 40, window: float = 2e-3,
    ) -> None:  # fmt: skip
        if not isinstance(rig, Rig):
            raise ValueError(f"`rig` must be a Rig, but is {rig if isinstance(rig, type) else type(rig).__name__}")
        followed = rig.reference if reference is None else reference
        if not isinstance(followed, Reference):
            raise ValueError(f"`reference` must be a Reference, but is {type(followed).__name__}")
        self.step, self.window = positive("step", step), positive("window", window)
        self.tolerance, self.max_iterations = (
            positive("tolerance", tolerance),
            whole("max_iterations", max_iterations, 1),
        )
        if self.tolerance < SMALLEST_TOLERANCE:
            raise ValueError(
                f"`tolerance` must be at least {SMALLEST_TOLERANCE:g} N, but is {tolerance:g} N, which rounding hides"
            )
        self.rig, self.reference = rig, followed
        self.compiled = Compiled(rig)
        self.layout, self.integrals = rig.layout, Integrals(rig)
        self._cap = 64

    @property
    def signals_at_start(self) -> Tensor:
        """The signals at one moment, to see whether they carry a graph."""
        return self.compiled.signals(torch.zeros(1, dtype=torch.float64), self.reference)

    def check_start(self, y0: Tensor) -> None:
        """Raises `ValueError` unless y0 is one finite state of this rig."""
        check_array("y0", y0)
        self.layout.check(y0)
        if y0.ndim != 1:
            raise ValueError(f"`y0` must be one state, shape ({self.layout.size},), but has shape {tuple(y0.shape)}")
        if not bool(torch.isfinite(y0).all()):
            raise ValueError(f"`y0` must be finite, but component {int((~torch.isfinite(y0)).nonzero()[0, 0])} is not")

    @torch.no_grad()
    def integrate(
        self, y0: Tensor, t: Tensor, segments: list[Segment] | None = None, tape_bytes: float = 0.0
    ) -> Iterator[Progress]:
        """Step from y0 (size,) through t (T,), yielding the same growing `Progress` after every compiled call.

        The last yield is the complete run. With `segments` given, what the derivatives need is appended to it, tapes for
        as long
        as they take less than `tape_bytes`. Raises `SimulationFailed`, and `ValueError` for a start that is not finite.
        """
        self.check_start(y0)
        check_times(t, self.step)
        todo = list(chunks(t, self.step))
        signals = self.signals(todo).numpy()
        first = self.compiled.system(todo[0].h)
        points, pads, coordinates = len(first.point_X), len(first.pad_base), len(first.body_free)
        n = len(self.integrals.names)
        out = Progress(
            np.empty((len(t), self.layout.size)),
            np.zeros((len(t), points, 2)),
            np.zeros((len(t), n + pads + coordinates)),
        )
        out.y[0] = y0.numpy()
        y, integrals, taped = y0.numpy().copy(), np.zeros(n), 0
        work = scratch(first, self.layout.size)
        set_velocities(first, work, y)
        self._start(y, t[0], work, out.forces, out.extras)
        set_velocities(first, work, y)
        ends = np.cumsum([0, *(2 * len(chunk.starts) for chunk in todo)])
        pending = [(chunk, signals[a:b], 0) for chunk, a, b in zip(todo, ends[:-1], ends[1:])][::-1]
        while pending:
            chunk, follow, halvings = pending.pop()
            rows = slice(out.rows, out.rows + int(chunk.keep.sum()))
            segment = Segment(chunk, follow, y.copy(), work.V.copy(), work.u_dot.copy(), rows, None)
            outputs = (out.y[rows], out.forces[rows], out.extras[rows])
            wanted = segments is not None and taped < tape_bytes
            steps, status, solves, tape = self._run(chunk, follow, y, work, integrals, outputs, wanted)
            if segments is not None and steps > 0:
                segment.chunk = chunk.part(0, steps)
                segment.signals = follow[: 2 * steps]
                segment.rows = slice(rows.start, rows.start + int(segment.chunk.keep.sum()))
                segment.tape = None if tape is None else first_stages(tape, 2 * steps)
                segments.append(segment)
                taped += sum(x.nbytes for x in tape) if tape is not None else 0
            out.rows += int(chunk.keep[:steps].sum())
            out.steps += steps
            out.solves += solves
            yield out
            if status == NEWTON_FAILED and halvings < HALVINGS:
                out.failed += 1
                work.u_dot[:] = 0.0
                if steps + 1 < len(chunk.starts):
                    rest = chunk.part(steps + 1, len(chunk.starts))
                    pending.append((rest, follow[2 * steps + 2 :], halvings))
                half = chunk.halved(steps)
                pending.append((half, self.signals([half]).numpy(), halvings + 1))
            elif status != CONVERGED:
                raise self._failure(status, float(chunk.starts[steps]), chunk.h)

    def _start(self, y0: Array, time: Tensor, work: Work, forces: Array, extras: Array) -> None:
        """Nodal forces, moments and loads at the start, the first row of `forces` and `extras`. Raises `SimulationFailed`."""
        s, signals = self.compiled.system(INSTANT / GAMMA), self.compiled.signals(time, self.reference).numpy()
        nothing = empty_tape(s, self.layout.size, 0, self._cap)
        _, status, _ = run(
            s, work, y0, signals[None, None], INSTANT, self.tolerance, self.max_iterations, self.window, np.zeros(0, np.bool_),
            np.zeros(len(self.integrals.names)), np.zeros((0, y0.size)), forces, extras, nothing, True,
        )  # fmt: skip
        if status != CONVERGED:
            raise self._failure(status, float(time), INSTANT)

    def signals(self, todo: Sequence[Chunk]) -> Tensor:
        """The signals at all stages of some chunks (stages, signals, 2)."""
        return self.compiled.signals(torch.cat([stage_times(chunk) for chunk in todo]), self.reference)

    def tape(self, segment: Segment) -> Tape:
        """The segment's tape, made again from where it began if it was not kept."""
        if segment.tape is not None:
            return segment.tape
        s, n = self.compiled.system(segment.chunk.h), int(segment.chunk.keep.sum())
        work = scratch(s, self.layout.size)
        work.V[:], work.u_dot[:] = segment.V, segment.u_dot
        extras = len(self.integrals.names) + len(s.pad_base) + len(s.body_free)
        outputs = (np.empty((n, self.layout.size)), np.empty((n, len(s.point_X), 2)), np.empty((n, extras)))
        *_, tape = self._run(
            segment.chunk, segment.signals, segment.y.copy(), work, np.zeros(len(self.integrals.names)), outputs, True
        )
        assert tape is not None
        return tape

    def _run(
        self, chunk: Chunk, signals: Array, y: Array, work: Work, integrals: Array, outputs: tuple[Array, Array, Array],
        taping: bool,
    ) -> tuple[int, int, int, Tape | None]:  # fmt: skip
        """One compiled call; with `taping` once more with a longer tape if more points touch than it has room for."""
        s, steps = self.compiled.system(chunk.h), len(chunk.starts)
        begin = y.copy(), work.V.copy(), work.u_dot.copy(), integrals.copy()
        while True:
            work.travelled[0] = np.inf  # look for near points afresh, so that a segment made again gives the same bits
            work.low[:] = work.high[:] = 0
            tape = empty_tape(s, self.layout.size, 2 * steps if taping else 0, self._cap)
            done, status, solves = run(
                s, work, y, signals.reshape(steps, 2, *signals.shape[1:]), chunk.h, self.tolerance, self.max_iterations,
                self.window, chunk.keep, integrals, *outputs, tape, False,
            )  # fmt: skip
            if status != TAPE_FULL:
                return done, status, solves, tape if taping else None
            self._cap *= 2
            y[:], work.V[:], work.u_dot[:], integrals[:] = begin

    def _failure(self, status: int, time: float, h: float) -> SimulationFailed:
        reasons = {
            NEWTON_FAILED: f"Newton's iteration did not converge within {self.max_iterations} iterations in the step of "
            f"{h:.3g} s, halved {HALVINGS} times; try a smaller step, or a larger v_s of the friction law: where friction "
            "falls with slip faster than the pads damp, massless pads have no unique velocity",
            OFF_THE_PAD: "the body was lost: its contact reached the end of a pad",
            LOST: "the body was lost: it left the space over a pad",
            NOT_FINITE: "the state is not finite any more; check the parameters and the reference",
        }
        return SimulationFailed(f"at t = {time:.4f} s {reasons[status]}", time)


def stage_times(chunk: Chunk) -> Tensor:
    """Times of the stages of a chunk (2 steps,) [s]."""
    return torch.from_numpy((chunk.starts[:, None] + chunk.h * np.array([GAMMA, 1.0])).ravel())


def set_velocities(s: Any, work: Work, y: Array) -> None:
    """Newton's first guess: the velocities of the state."""
    for i, c in enumerate(s.body_coordinate):
        work.V[c] = y[s.body_V_start + i]
