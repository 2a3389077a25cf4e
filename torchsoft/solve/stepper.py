"""The implicit stepper: the compiled kernels fed from a rig, chunk by chunk."""

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.parallel import released_turn
from torchsoft.physics.arguments import positive, whole
from torchsoft.physics.motion import CLOSEST, Reference
from torchsoft.physics.rig import Rig
from torchsoft.physics.structure import Structure
from torchsoft.physics.validity import check_array
from torchsoft.solve.kernel.arrays import (
    CONVERGED,
    CRUSHED,
    INSTANT,
    LOST,
    NEWTON_FAILED,
    NOT_FINITE,
    OFF_THE_PAD,
    PASSED_THROUGH,
    REFUSED,
    TAPE_FULL,
    Limits,
    Outputs,
    Run,
    scratch,
)
from torchsoft.solve.kernel.objects import call
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.laws import reference_fault
from torchsoft.solve.parameters import Parameters
from torchsoft.solve.progress import Progress, RunState, Segment, SimulationFailed
from torchsoft.solve.steps import (
    LONGEST,
    Followed,
    Plan,
    check_knots,
    check_times,
    equal_steps,
    given_steps,
)

HALVINGS = 6
"""Most halvings of a step that Newton does not solve before the run fails."""

START_ITERATIONS = 400
"""Most Newton iterations of a start, which no step before it has brought near its rates."""

FIRST, SHORTEST, PART = 1e-3, CLOSEST, 1e-7
"""Length [s] of the first step that tolerances try, the shortest that they may choose, and the part
of a run that is the shortest where that is less."""

SMALLEST_TOLERANCE = 1e-10
"""Newton tolerance [N] that the ready excitations can meet, in units of the rig's forces: at a
tenth of it one step in ten is halved because of rounding."""

METHOD = "sdirk2"
"""Name under which `torchdiffeq.odeint` knows the stepper once torchsoft is imported."""


class ImplicitStepper:
    """SDIRK2 on one rig and reference as they are now: L-stable, second order, stiffly accurate.

    Steps are chosen by `rtol` and `atol`, or given: `step` [s] cuts every output interval into
    equal steps no longer than it, `knots` (n + 1,) [s] are the steps of another run. Tolerances
    hold the error that one step makes, in every part of the state (a pad's nodal forces, a
    contact's stretches, a body's position, its angle), below atol units (`rig_units`) plus rtol
    times the largest value so far; no step is longer than `longest` [s] or passes a knot of the
    reference, and with `landing` a step ends at every output.

    Inside, time counts from the `origin` of the last run [s], its first time: steps are as fine
    after 1.7e9 s as after none.

    Newton stops when the contact law and the linear relations agree to `tolerance` [N] at every
    node. A given step that it does not solve is taken as two of half the length, and so on up to
    `HALVINGS` times. `window` [m] is how near a point has to be to count as one that may touch
    (checked after every stage; only speed depends on it).

    Raises `ValueError` for a tolerance below `SMALLEST_TOLERANCE` and an rtol that is not below 1.
    """

    def __init__(
        self, rig: Rig, reference: Reference | None = None, *, step: float | None = None,
        rtol: float = 1e-3, atol: float = 1e-4, knots: Tensor | None = None,
        tolerance: float = 1e-9, max_iterations: int = 40, window: float = 2e-3,
        longest: float = LONGEST, landing: bool = False,
        structure: Structure | None = None, values: Mapping[int, Tensor] | None = None,
        differentiable: bool = True,
    ) -> None:  # fmt: skip
        if not isinstance(reference, Reference | None):
            raise ValueError(f"`reference` must be a Reference, but is {type(reference).__name__}")
        self.step = None if step is None else positive("step", step)
        self.rtol, self.atol = positive("rtol", rtol), positive("atol", atol)
        if self.rtol >= 1:
            raise ValueError(
                f"`rtol` must be below 1, but is {self.rtol:g}; where only `atol` is given, it is "
                "ten times that"
            )
        self.longest = positive("longest", longest)
        self.tolerance, self.window = positive("tolerance", tolerance), positive("window", window)
        self.max_iterations, self.landing = whole("max_iterations", max_iterations, 1), landing
        self.knots = None if knots is None else check_knots(knots)
        self.parameters = Parameters(
            rig, reference, structure=structure, values=values, differentiable=differentiable
        )
        self.rig, self.reference = self.parameters.rig, self.parameters.reference
        if self.tolerance < (least := SMALLEST_TOLERANCE * self.parameters.units["force"]):
            raise ValueError(
                f"`tolerance` must be at least {least:.3g} N, but is {tolerance:g} N, "
                "which rounding hides"
            )
        self.layout = self.parameters.layout
        self.origin = 0.0
        self._motion: Followed | None = None
        self._cap, self._shortest = 64, SHORTEST
        limits = Limits(self.tolerance, self.max_iterations, self.window)
        self._limits: tuple[Any, Any] = limits, limits._replace(max_iterations=START_ITERATIONS)

    def along(self, knots: Array) -> "ImplicitStepper":
        """The same with the steps between `knots` [s]."""
        other = copy(self)
        other.step, other.knots = None, knots
        return other

    def following(self, reference: Reference) -> "ImplicitStepper":
        """The same on another reference; the rig stays as it was read."""
        other = copy(self)
        other.reference, other._motion, other.origin = reference, None, 0.0
        return other

    def moving(self, motion: Followed, origin: float) -> "ImplicitStepper":
        """The same with signals as the kernels take them, time counting from `origin` [s]; no
        derivative can be taken by them."""
        other = copy(self)
        other._motion = other.followed = motion
        other.origin = origin
        return other

    def signals_at(self, times: Tensor | Array) -> Tensor:
        """The signals at times (...) [s] since the origin (..., signals, 2)."""
        return self.parameters.signals(torch.as_tensor(times), self.reference.since(self.origin))

    def signals_now(self, t: Tensor) -> Tensor:
        """The signals at t [s] of the last run, without fixed coordinates (..., signals, 2)."""
        known = self.followed.at(t) if self._motion is not None else None
        return self.rig.follow(t, self.reference) if known is None else known

    @property
    def signals_at_start(self) -> Tensor:
        """The signals at one moment, to see whether they carry a graph."""
        return self.parameters.signals(torch.zeros(1, dtype=torch.float64), self.reference)

    def check(self, y0: Tensor, t: Tensor) -> None:
        """Raises `ValueError` unless a run can go from y0, one finite state of this rig, through
        the times t; warns of signals whose gradient is not that of their values."""
        check_times(t, self.step)
        check_array("y0", y0)
        self.layout.check(y0)
        if y0.ndim != 1:
            raise ValueError(
                f"`y0` must be one state, shape ({self.layout.size},), but has shape "
                f"{tuple(y0.shape)}"
            )
        if not (finite := np.isfinite(y0.detach().numpy())).all():
            first = np.flatnonzero(~finite)[0]
            raise ValueError(f"`y0` must be finite, but component {first} is not")
        if not self.reference.is_plain(self.rig.signals) and (
            wrong := reference_fault(self.reference, self.rig.signals, t)
        ):
            warn(wrong)

    def integrate(
        self, y0: Tensor, t: Tensor, segments: list[Segment] | None = None,
        tape_bytes: float = 0.0, outputs_too: bool = True,
    ) -> Iterator[Progress]:  # fmt: skip
        """Step from y0 (size,) through t (T,), yielding the same growing `Progress` after every
        compiled call.

        The last yield is the complete run. With `segments` given, the data of the derivatives are
        appended to it, tapes for as long as they take less than `tape_bytes`, of the outputs only
        where the forces there are to be differentiated. Start and times are those that `check` lets
        pass. Raises `SimulationFailed`.
        """
        self.origin, times = float(t[0]), t.numpy() - float(t[0])
        self.followed = self._motion or self.parameters.kernel_signals(self.reference, self.origin)
        self._shortest = min(SHORTEST, PART * times[-1])
        room, out = self.parameters.model.take(self.parameters.numbers), self._progress(len(t))
        now = RunState(room, y0.numpy().copy(), out, segments, tape_bytes, outputs_too)
        given = self.step is not None or self.knots is not None
        table = self._table(now, times, given)
        todo = [(one, 0) for one in (self._given(t, out) if given else [self._blank(now, 0)])]
        while todo:
            plan, halvings = todo.pop()
            before = tuple(part.copy() for part in now.stands) if segments is not None else ()
            counts, tapes = self._call(now, plan, table)
            self.followed.check()
            steps, done, status, solves, refused, failed, which = counts
            if not out.rows and not np.isfinite(out.signals[0]).all():
                self.signals_at(np.zeros(1))  # which raises
            rows = slice(out.rows, out.rows + done)
            out.rows, stats = rows.stop, out.stats
            stats.steps, stats.newton_iterations = (
                stats.steps + steps,
                stats.newton_iterations + solves,
            )
            stats.refused_steps += refused
            stats.failed_steps += failed
            now.keep(plan.taken(steps, done), rows, before, tapes)
            if out.rows:
                yield out
            if status == TAPE_FULL:
                self._cap *= 2
            elif status == NEWTON_FAILED and given and out.rows and halvings < HALVINGS:
                stats.failed_steps += 1
                room.work.u_dot[:], room.work.rate[:] = 0.0, 0.0
                ends = int(np.searchsorted(plan.out_step, steps, side="right"))
                todo.append((plan.left(steps + 1, ends), halvings))
                half = plan.taken(steps + 1, ends).left(steps, done).halved()
                todo += [(one, halvings + 1) for one in self._followed_by([half], out, out.rows)]
                continue
            elif status != CONVERGED:
                since, h, worst = float(table.clock[0]), float(table.clock[1]), ""
                if not out.rows:
                    since, h = 0.0, INSTANT
                elif given:
                    since, h = float(plan.starts[steps]), float(plan.h[steps])
                elif status < OFF_THE_PAD:
                    names = self.parameters.model.errors.names
                    worst = names[which] if which >= 0 else "the state"
                raise self._failure(status, since, h, which, worst)
            if not given and out.rows < len(t):
                todo.append((self._blank(now, out.rows), 0))
            elif given and steps < len(plan.h):
                todo.append((plan.left(steps, done), halvings))
        self.parameters.model.give(
            room
        )  # not after a failure, which may leave numbers that are none

    def _blank(self, now: RunState, row: int) -> Plan:
        """Room for steps that tolerances choose, and for the outputs from `row` on."""
        starts, h, signals = now.room.chunk
        if now.segments is not None:
            starts, h, signals = starts.copy(), h.copy(), signals.copy()
        left = len(now.out.y) - row
        return Plan(starts, h, np.full(left, 0 if row else -1), np.zeros(left), signals)

    def _given(self, t: Tensor, out: Progress) -> list[Plan]:
        """The steps through t that are given, the last first."""
        knots = self.knots
        plans = list(equal_steps(t, self.step or 0.0) if knots is None else given_steps(t, knots))
        start = (
            np.concatenate(([-1], plans[0].out_step)),
            np.concatenate(([0.0], plans[0].out_part)),
        )
        plans[0] = plans[0]._replace(out_step=start[0], out_part=start[1])
        return self._followed_by(plans, out, 0)[::-1]

    @torch.no_grad()
    def _followed_by(self, plans: Sequence[Plan], out: Progress, row: int) -> list[Plan]:
        """Plans with the signals at their stages; those at their outputs go to rows from `row`
        on."""
        times = np.concatenate([plan.output_times for plan in plans])
        out.signals[row : row + len(times)] = self.signals_at(times).numpy()
        signals = self.signals_at(np.concatenate([plan.stage_times for plan in plans])).numpy()
        ends = np.cumsum([len(plan.h) for plan in plans])[:-1]
        parts = zip(plans, np.split(signals, ends))
        return [plan._replace(signals=part) for plan, part in parts]

    def _table(self, now: RunState, times: Array, given: bool) -> Any:
        """Arguments of the compiled run through times (T,) [s] since its start, but those of a
        single call."""
        room, followed, size = now.room, self.followed, self.layout.size
        stops = np.union1d(followed.stops, times[1:] if self.landing else times[-1:])
        stops = stops[(stops > 0.0) & (stops <= times[-1])]
        errors = self.parameters.model.errors.of(now.y, self.atol, self.parameters.units)
        clock = np.array([0.0, min(FIRST, times[-1]), 1.0])
        integrals, (starts, h, signals) = np.zeros(now.out.integrals.shape[1]), room.chunk
        nothing: Any = None
        return Run(
            room.system, room.work, room.step, followed.arrays, errors, *self._limits, nothing,
            nothing, given, False, now.y, np.zeros(size), clock, stops, times, self.rtol,
            self.longest, self._shortest, integrals, starts, h, signals, np.zeros(7, np.int64),
        )  # fmt: skip

    def _call(
        self, now: RunState, plan: Plan, table: Any
    ) -> tuple[list[int], tuple[Any, Any] | None]:
        """One call of the compiled run, which goes on with its rows: its counts, and the tapes of
        its stages and outputs with `taping`."""
        model, done, count = self.parameters.model, now.out.rows, len(plan.out_step)
        y, integrals, recorded, rate, signals, stored = now.out.part(slice(done, done + count))
        tape = out_tape = model.no_tape
        if now.taping:
            tape, out_tape = (
                scratch("Tape", table.rig, self.layout.size, stages=n, cap=self._cap)
                for n in (2 * len(plan.h), count if now.outputs_too else 0)
            )
            if now.outputs_too:
                out_tape = out_tape._replace(y=y)
        rows = plan.out_step, plan.out_part, signals, y, integrals, recorded, rate, stored, out_tape
        arguments = table._replace(
            out=Outputs(*rows), tape=tape, begin=count > 0 and plan.out_step[0] < 0,
            t_out=table.t_out[done:], starts=plan.starts, h=plan.h, signals=plan.signals,
        )  # fmt: skip
        with released_turn():
            call("run", arguments)
        return table.counts.tolist(), (tape, out_tape) if now.taping else None

    def _progress(self, rows: int) -> Progress:
        """Room for so many outputs."""
        widths = self.parameters.model.widths
        y, integrals, recorded, rate = (np.zeros((rows, width)) for width in widths)
        signals = np.zeros((rows, self.parameters.model.signal_count, 2))
        return Progress(y, integrals, recorded, rate, signals, np.zeros(rows), origin=self.origin)

    def tapes(self, segment: Segment, room: Any) -> tuple[Any, Any]:
        """The tapes of a segment's stages and outputs, made again in a room from where it began if
        they were not kept."""
        if segment.tapes is not None:
            return segment.tapes
        out = self._progress(len(segment.plan.out_step))
        out.signals[:] = segment.at_outputs
        now = RunState(room, segment.before[0].copy(), out, [], float("inf"))
        table, status, tapes = self._table(now, np.ones(1), True), TAPE_FULL, None
        while status == TAPE_FULL:
            for part, value in zip(now.stands, segment.before):
                part[:] = value
            (_, _, status, *_), tapes = self._call(now, segment.plan, table)
            self._cap *= 2 if status == TAPE_FULL else 1
        assert tapes is not None
        return tapes

    def _lost(self, number: int) -> dict[int, str]:
        """What is reported of a body that left the domain of a contact, by the kernels' status."""
        name, contact = list(self.rig.contacts.items())[number]
        pad = self.rig.pads[contact.pad]
        height, apart = f"{1e3 * pad.mesh.height:.3g} mm", 1e3 * float(pad.point_lengths.max())
        lost, of = f"`{contact.body}` was lost:", f"the pad `{contact.pad}`"
        leave = f"set may_leave = true in the contact `{name}` if the body may be there"
        return {
            OFF_THE_PAD: f"{lost} its contact reached the end of {of}, which is "
            f"{1e3 * pad.mesh.length:.3g} mm long; take a longer pad, or {leave}",
            LOST: f"{lost} it left the space over {of}; keep it nearer, or {leave}",
            CRUSHED: f"{lost} it compressed {of}, {height} high, down to its bonded base; press "
            "less, or take a thicker or stiffer pad",
            PASSED_THROUGH: f"{lost} it passed through {of}, whose contact points are up to "
            f"{apart:.3g} mm apart; take a finer pad or more points, stiffer springs K_n, shorter "
            "steps, or a slower body",
        }

    def _failure(
        self, status: int, since: float, h: float, which: int, worst: str = ""
    ) -> SimulationFailed:
        """The failure at a time `since` the origin [s]; `which` is the contact of a body that left
        its domain."""
        time = self.origin + since
        if h == INSTANT:
            most, tried, instead = START_ITERATIONS, "at the start", "another start"
        elif worst:
            most, tried = self.max_iterations, f"in steps down to {self._shortest:.3g} s"
            instead = "other tolerances"
        else:
            most, tried = self.max_iterations, f"in the step of {h:.3g} s, halved {HALVINGS} times"
            instead = "a smaller step"
        reasons = {
            NEWTON_FAILED: f"Newton's iteration did not converge within {most} iterations {tried}; "
            f"try {instead}, or a larger v_s of the friction law: where friction falls with slip "
            "faster than the pads damp, massless pads have no unique velocity",
            REFUSED: f"the tolerances would need steps below {self._shortest:.3g} s for {worst}; "
            "loosen rtol or atol, or look for a jump in the reference or in a law there",
            NOT_FINITE: "the state is not finite any more; check the parameters and the reference",
        }
        lost = status >= OFF_THE_PAD
        reasons |= self._lost(which) if lost else {}
        contact = list(self.rig.contacts)[which] if lost else ""
        left = status in (OFF_THE_PAD, LOST)
        return SimulationFailed(f"at t = {time:.4f} s {reasons[status]}", time, contact, left)
