"""The implicit stepper: the compiled kernel fed from a `SoftGrasp`."""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.grid import Chunk, check_times, chunks
from torchsoft.kernel_inputs import constants, pad_arrays, pad_state
from torchsoft.kernels.node import Array
from torchsoft.kernels.pad import PadArrays, PadState, pad_work
from torchsoft.kernels.run import (
    CONVERGED,
    GAMMA,
    INTEGRALS,
    LOST,
    NEWTON_FAILED,
    OFF_THE_PAD,
    TAPE_FULL,
    Tape,
    empty_tape,
    first_stages,
    run,
)
from torchsoft.model import SoftGrasp
from torchsoft.state import State

log = logging.getLogger("torchsoft")

HALVINGS = 6
"""How often a step that Newton does not solve is halved before the run is given up."""

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
    """What the stepper has produced so far: rows of the output grid, and its counters."""

    y: Array
    forces: Array
    extras: Array
    rows: int = 1
    steps: int = 0
    solves: int = 0
    failed: int = 0


@dataclass
class Segment:
    """One chunk of a taped run: where it began, and its tape, or None where it is to be made again when needed."""

    chunk: Chunk
    states: tuple[PadState, PadState]
    q: Array
    V: Array
    rows: slice
    tape: Tape | None


class ImplicitStepper:
    """SDIRK2 on one model: L-stable, second order, stiffly accurate.

    `step` [s] is the largest step; every output interval is cut into equal steps no longer than it. Newton stops when
    the contact law and the linear relations agree to `tolerance` [N] at every node; a step that it does not solve is taken as
    two of half the length, and so on up to `HALVINGS` times. `window` [m] is how near a node has
    to be to count as one that may touch (checked after every stage; only speed depends on it). Parameters are read when
    the stepper is made.
    """

    def __init__(
        self,
        model: SoftGrasp,
        *,
        step: float = 2e-3,
        tolerance: float = 1e-9,
        max_iterations: int = 40,
        window: float = 3e-4,
    ) -> None:
        if not (math.isfinite(step) and step > 0):
            raise ValueError(f"`step` must be a positive number of seconds, but is {step}")
        for name, value in model.named_parameters():
            if not bool(torch.isfinite(value).all()):
                raise ValueError(f"parameter `{name}` must be finite, but is {value.tolist()}")
        self.model, self.step, self.tolerance, self.max_iterations, self.window = (
            model,
            step,
            tolerance,
            max_iterations,
            window,
        )
        self.constants = constants(model)
        self._arrays: dict[float, tuple[PadArrays, PadArrays]] = {}
        self._cap = 24

    def pad_arrays(self, h: float) -> tuple[PadArrays, PadArrays]:
        """Both pads' mobilities for the step h [s]."""
        if h not in self._arrays:
            if len(self._arrays) > 8:  # an irregular output grid has many step sizes; each holds some megabytes
                self._arrays.clear()
            self._arrays[h] = (pad_arrays(self.model, "L", GAMMA * h), pad_arrays(self.model, "U", GAMMA * h))
        return self._arrays[h]

    def setpoints(self, chunk: Chunk) -> Tensor:
        """Set-points at the stages of a chunk (steps, 2, 5)."""
        stage_times = torch.from_numpy(chunk.starts[:, None] + chunk.h * np.array([GAMMA, 1.0]))
        return torch.stack(self.model.reference(stage_times), -1)

    @torch.no_grad()
    def integrate(
        self, y0: Tensor, t: Tensor, segments: list[Segment] | None = None, tape_bytes: float = 0.0
    ) -> Iterator[Progress]:
        """Step from y0 (size,) through t (T,), yielding the same growing `Progress` after every compiled call.

        `extras` holds the running integrals (`kernels.run.INTEGRALS`) and the bracket's moment. The last yield is the
        complete run. With `segments` given, what the adjoint needs is appended to it, tapes for as long as they take
        less than `tape_bytes`. Raises `SimulationFailed`.
        """
        check_times(t)
        m = self.model
        state = m.layout.unpack(y0)
        if y0.ndim != 1 or not bool(torch.isfinite(y0).all()):
            raise ValueError(
                f"`y0` must be one finite state, shape ({m.layout.size},), but has shape {tuple(y0.shape)}"
            )
        surfaces = len(m.pad_L.surface) + len(m.pad_U.surface)
        out = Progress(
            np.empty((len(t), m.layout.size)), np.empty((len(t), surfaces, 2)), np.zeros((len(t), len(INTEGRALS) + 1))
        )
        out.y[0], out.forces[0], out.extras[0, -1] = y0.numpy(), *_start(m, t[0], state)
        states = (pad_state(m, "L", state), pad_state(m, "U", state))
        q = torch.cat((state.r_C, state.theta[None], state.r_Br)).numpy()
        V = torch.cat((state.v_C, state.omega[None], state.v_Br)).numpy()
        integrals, taped = np.zeros(len(INTEGRALS)), 0
        announce_compilation()
        pending = [(chunk, 0) for chunk in reversed(list(chunks(t, self.step)))]
        while pending:
            chunk, halvings = pending.pop()
            rows = slice(out.rows, out.rows + int(chunk.keep.sum()))
            segment = Segment(chunk, _copies(states), q.copy(), V.copy(), rows, None)
            outputs = (out.y[rows], out.forces[rows], out.extras[rows])
            wanted = segments is not None and taped < tape_bytes
            steps, status, solves, tape = self._run(chunk, states, q, V, integrals, outputs, wanted)
            if segments is not None and steps > 0:
                segment.chunk = chunk.part(0, steps)
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
                if steps + 1 < len(chunk.starts):
                    pending.append((chunk.part(steps + 1, len(chunk.starts)), halvings))
                pending.append((chunk.halved(steps), halvings + 1))
            elif status != CONVERGED:
                raise self._failure(status, float(chunk.starts[steps]), chunk.h)

    def tape(self, segment: Segment) -> Tape:
        """The segment's tape, made again from where it began if it was not kept."""
        if segment.tape is not None:
            return segment.tape
        m, n = self.model, int(segment.chunk.keep.sum())
        surfaces = len(m.pad_L.surface) + len(m.pad_U.surface)
        outputs = (np.empty((n, m.layout.size)), np.empty((n, surfaces, 2)), np.empty((n, len(INTEGRALS) + 1)))
        integrals = np.zeros(len(INTEGRALS))
        *_, tape = self._run(
            segment.chunk, _copies(segment.states), segment.q.copy(), segment.V.copy(), integrals, outputs, True
        )
        assert tape is not None
        return tape

    @torch.no_grad()
    def _run(
        self,
        chunk: Chunk,
        states: tuple[PadState, PadState],
        q: Array,
        V: Array,
        integrals: Array,
        outputs: tuple[Array, Array, Array],
        taping: bool,
    ) -> tuple[int, int, int, Tape | None]:
        """One compiled call; with `taping` once more with a longer tape if more nodes touch than it has room for."""
        pads, wants = self.pad_arrays(chunk.h), self.setpoints(chunk).numpy()
        dofs, surface = sum(s.u.size for s in states), sum(s.s.size for s in states)
        begin = (*_copies(states), q.copy(), V.copy(), integrals.copy())
        while True:
            tape = empty_tape(2 * len(wants) if taping else 0, dofs, surface, self._cap)
            steps, status, solves = run(
                pads, states, (pad_work(pads[0]), pad_work(pads[1])), q, V, wants, chunk.h, self.constants, self.tolerance,
                self.max_iterations, self.window, chunk.keep, integrals, *outputs, tape,
            )  # fmt: skip
            if status != TAPE_FULL:
                return steps, status, solves, tape if taping else None
            self._cap *= 2
            for pad, start in zip(states, begin[:2]):
                for now, before in zip(pad, start):
                    now[:] = before
            q[:], V[:], integrals[:] = begin[2:]

    def _failure(self, status: int, time: float, h: float) -> SimulationFailed:
        reasons = {
            NEWTON_FAILED: f"Newton's iteration did not converge within {self.max_iterations} iterations in the step of "
            f"{h:.3g} s, halved {HALVINGS} times; try a smaller step, or a larger contact.v_s: where friction falls with slip "
            "faster than the pads damp, massless pads have no unique velocity",
            OFF_THE_PAD: "the disc was lost: its contact reached the end of a pad",
            LOST: "the disc was lost: it left the space between the pads",
        }
        return SimulationFailed(f"at t = {time:.4f} s {reasons[status]}", time)


def _copies(states: tuple[PadState, PadState]) -> tuple[PadState, PadState]:
    lower, upper = (PadState(*(x.copy() for x in state)) for state in states)
    return lower, upper


def _start(model: SoftGrasp, time: Tensor, state: State) -> tuple[Array, float]:
    """Nodal forces and bracket moment at the start, from the module."""
    graph = model.evaluate(time, state)
    force = torch.cat([torch.stack(graph.interfaces[k].contact[:2], -1) for k in "LU"]).numpy()
    port = graph.ports["pad_U"]
    return force, float(port.transformer.effort(port.effort, model.junctions)["bracket_spin"].sum().neg())


_announced = False


def announce_compilation() -> None:
    """Say, once and only if nothing is cached, what the first run is waiting for."""
    global _announced
    cache = Path(run.stats.cache_path or "")
    if not _announced and not run.signatures and not list(cache.glob("run.run-*.nbi")):
        log.warning("compiling the implicit stepper (about half a minute, once; the result is cached in %s)", cache)
    _announced = True
