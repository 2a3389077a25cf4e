"""The implicit stepper: the compiled kernels fed from a rig, chunk by chunk."""

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.parallel import released_turn
from torchsoft.physics.arguments import positive, whole
from torchsoft.physics.motion import CLOSEST, Reference
from torchsoft.physics.rig import Rig
from torchsoft.physics.validity import check_array
from torchsoft.solve.kernel.arrays import (
    CONVERGED,
    GAMMA,
    INSTANT,
    LOST,
    NEWTON_FAILED,
    NO_ERRORS,
    NO_SIGNALS,
    NOT_FINITE,
    OFF_THE_PAD,
    REFUSED,
    TAPE_FULL,
    Limits,
    Outputs,
    Run,
    Tape,
    room,
)
from torchsoft.solve.kernel.objects import call
from torchsoft.solve.kernel.table import Array, change
from torchsoft.solve.progress import Progress, RunState, Segment, SimulationFailed
from torchsoft.solve.steps import (
    CHUNK,
    LONGEST,
    Followed,
    Plan,
    check_knots,
    check_times,
    equal_steps,
    given_steps,
)
from torchsoft.solve.system import Compiled, Reading

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

NONE, START = np.zeros(0), np.zeros(3)
"""Placeholders for given steps: an array, and a clock."""

METHOD = "sdirk2"
"""Name under which `torchdiffeq.odeint` knows the stepper once torchsoft is imported."""


class ImplicitStepper:
    """SDIRK2 on one rig and reference as they are now: L-stable, second order, stiffly accurate.

    Steps are chosen by `rtol` and `atol`, or given: `step` [s] cuts every output interval into
    equal steps no longer than it, `knots` (n + 1,) [s] are the steps of another run. Tolerances
    hold the error that one step makes, in every part of the state (a pad's nodal forces, a
    contact's stretches, a body's position, its angle), below atol units (`own_units`) plus rtol
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
        reading: Reading | None = None, values: Mapping[int, Tensor] | None = None,
        differentiable: bool = True,
    ) -> None:  # fmt: skip
        if not isinstance(rig, Rig):
            raise ValueError(
                "`rig` must be a Rig, but is "
                f"{rig if isinstance(rig, type) else type(rig).__name__}"
            )
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
        self.compiled = Compiled(
            rig, reference, reading=reading, values=values, differentiable=differentiable
        )
        self.rig, self.reference = self.compiled.rig, self.compiled.reference
        if self.tolerance < (least := SMALLEST_TOLERANCE * self.compiled.units["force"]):
            raise ValueError(
                f"`tolerance` must be at least {least:.3g} N, but is {tolerance:g} N, "
                "which rounding hides"
            )
        self.layout, self.integrals = self.compiled.layout, self.compiled.model.integrals
        self.origin = 0.0
        self._motion: Followed | None = None
        self._cap, self._shortest = 64, SHORTEST

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

    def signals_at(self, times: Tensor) -> Tensor:
        """The signals at times (...) [s] since the origin (..., signals, 2)."""
        return self.compiled.signals(times, self.reference.since(self.origin))

    def _call(
        self, now: "RunState", plan: Plan, signals: Array, at_outputs: Array, rows: slice,
        *, taping: bool, given: bool = True, follow: Any = NO_SIGNALS, errors: Any = NO_ERRORS,
        k: Array = NONE, clock: Array = START, stops: Array = NONE, times: Array = NONE,
        row: int = 0,
    ) -> tuple[list[int], tuple[Any, Any] | None]:  # fmt: skip
        """One call of the compiled run, whose outputs go to `rows`: its counts, and the tapes of
        its stages and outputs with `taping`."""
        counts, steps, out = np.zeros(7, np.int64), len(plan.h), now.out
        # look for near points afresh, so that a segment made again has the same bits
        now.work.travelled[0] = np.inf
        now.work.low[:] = now.work.high[:] = 0
        now.work.held[:] = 0.0
        here = [part[rows] for part in out.arrays]
        tape = out_tape = self.compiled.model.no_tape
        if taping:
            tape, out_tape = (
                room("Tape", now.system, self.layout.size, stages=n, cap=self._cap)
                for n in (2 * steps, len(here[0]) if now.outputs_too else 0)
            )
            if now.outputs_too:
                out_tape = out_tape._replace(y=here[0])
        here[4] = at_outputs
        run = Run(
            now.system, now.work, now.step, follow, errors, *self.limits,
            outputs(plan, here, out_tape), tape, given,
            now.y, k, clock, stops, times, row, self.rtol, self.longest,
            self._shortest, now.integrals, plan.starts, plan.h,
            signals.reshape(steps, 2, *signals.shape[1:]), counts,
        )  # fmt: skip
        with released_turn():
            call("run", run)
        return counts.tolist(), (tape, out_tape) if taping else None

    @property
    def limits(self) -> tuple[Limits, Limits]:
        """Limits of Newton's method, and those at a start."""
        most = self.max_iterations, START_ITERATIONS
        limits, start = (Limits(self.tolerance, one, self.window) for one in most)
        return limits, start

    def signals_now(self, t: Tensor) -> Tensor:
        """The signals at t [s] of the last run, without fixed coordinates (..., signals, 2)."""
        known = self.followed.at(t) if self._motion is not None else None
        return self.rig.follow(t, self.reference) if known is None else known

    @property
    def signals_at_start(self) -> Tensor:
        """The signals at one moment, to see whether they carry a graph."""
        return self.compiled.signals(torch.zeros(1, dtype=torch.float64), self.reference)

    def check_start(self, y0: Tensor) -> None:
        """Raises `ValueError` unless y0 is one finite state of this rig."""
        check_array("y0", y0)
        self.layout.check(y0)
        if y0.ndim != 1:
            raise ValueError(
                f"`y0` must be one state, shape ({self.layout.size},), but has shape "
                f"{tuple(y0.shape)}"
            )
        if not bool(torch.isfinite(y0).all()):
            raise ValueError(
                f"`y0` must be finite, but component {int((~torch.isfinite(y0)).nonzero()[0, 0])} "
                "is not"
            )

    @torch.no_grad()
    def integrate(
        self, y0: Tensor, t: Tensor, segments: list[Segment] | None = None,
        tape_bytes: float = 0.0, outputs_too: bool = True,
    ) -> Iterator[Progress]:  # fmt: skip
        """Step from y0 (size,) through t (T,), yielding the same growing `Progress` after every
        compiled call.

        The last yield is the complete run. With `segments` given, the data of the derivatives are
        appended to it, tapes for as long as they take less than `tape_bytes`, of the outputs only
        where the forces there are to be differentiated. Raises `SimulationFailed`, and `ValueError`
        for a start that is not finite.
        """
        self.check_start(y0)
        check_times(t, self.step)
        self.origin = float(t[0])
        self.followed = self._motion or self.compiled.followed(self.reference, self.origin)
        self._shortest = min(SHORTEST, PART * float(t[-1] - t[0]))
        model, out = self.compiled.model, self._room(len(t))
        place = model.take(self.compiled.numbers)
        y, integrals = y0.numpy().copy(), np.zeros(len(self.integrals.names))
        set_velocities(place.system, place.work, y)
        state = RunState(y, *place, integrals, out, segments, tape_bytes, outputs_too)
        yield from (
            self._by_tolerance(t, state)
            if self.step is None and self.knots is None
            else self._as_given(t, state)
        )
        model.give(place)  # not after a failure, which may leave numbers that are none

    def _as_given(self, t: Tensor, now: "RunState") -> Iterator[Progress]:
        """Take the steps of a plan."""
        now.out.signals[0] = self.signals_at(torch.zeros(1, dtype=torch.float64)).numpy()
        self._start(now)
        todo = list(
            given_steps(t, self.knots)
            if self.knots is not None
            else equal_steps(t, self.step or 0.0)
        )
        signals, at_outputs = self.signals(todo).numpy(), self.signals_at_outputs(todo).numpy()
        ends, rows = (
            np.cumsum([0, *sizes])
            for sizes in ([2 * len(x.h) for x in todo], [len(x.out_step) for x in todo])
        )
        pending = [
            (plan, signals[ends[i] : ends[i + 1]], at_outputs[rows[i] : rows[i + 1]], 0)
            for i, plan in enumerate(todo)
        ][::-1]
        out = now.out
        while pending:
            plan, follow, at_rows, halvings = pending.pop()
            before = now.copy()
            here = slice(out.rows, out.rows + len(plan.out_step))
            steps, rows_done, status, solves, tapes = self._run(
                plan, follow, at_rows, now, here, now.taping
            )
            here = slice(out.rows, out.rows + rows_done)
            now.keep(
                plan.part(0, steps), follow[: 2 * steps], at_rows[:rows_done], before, here, tapes
            )
            out.rows, out.steps, out.solves = (
                out.rows + rows_done,
                out.steps + steps,
                out.solves + solves,
            )
            yield out
            if status == NEWTON_FAILED and halvings < HALVINGS:
                out.failed += 1
                now.work.u_dot[:], now.work.rate[:] = 0.0, 0.0
                if steps + 1 < len(plan.h):
                    rest = plan.part(steps + 1, len(plan.h))
                    pending.append(
                        (
                            rest,
                            follow[2 * steps + 2 :],
                            at_rows[len(at_rows) - len(rest.out_step) :],
                            halvings,
                        )
                    )
                half = plan.halved(steps)
                new = self.signals([half]).numpy(), self.signals_at_outputs([half]).numpy()
                pending.append((half, *new, halvings + 1))
            elif status != CONVERGED:
                since, h = float(plan.starts[steps]), float(plan.h[steps])
                raise self._failure(now, status, since, h)

    def _by_tolerance(self, t: Tensor, now: "RunState") -> Iterator[Progress]:
        """Take steps whose lengths the tolerances choose."""
        times, out, model = (
            np.ascontiguousarray(t.numpy() - self.origin),
            now.out,
            self.compiled.model,
        )
        followed = self.followed
        if now.segments is None:
            out.rows = 0  # the start is the first row of the first call
        else:
            self._start(now, followed)
        stops = np.union1d(followed.stops, times[1:] if self.landing else times[-1:])
        stops = stops[(stops > times[0]) & (stops <= times[-1])]
        errors = model.errors.of(now.y, self.atol, self.compiled.units)
        clock, k = np.array([times[0], min(FIRST, times[-1] - times[0]), 1.0]), now.step.K[0].copy()
        count, at_rows = self.compiled.signal_count, out.signals
        row_step, row_part = np.zeros(len(t), np.int64), np.zeros(len(t))
        while out.rows < len(t):
            plan = Plan(np.zeros(CHUNK), np.zeros(CHUNK), row_step, row_part)
            flat = np.zeros((2 * CHUNK, count, 2))
            before = now.copy() if now.segments is not None else ()
            counts, tapes = self._call(
                now, plan, flat, at_rows, slice(None),
                taping=now.taping, given=False, follow=followed.arrays, errors=errors, k=k,
                clock=clock, stops=stops, times=times, row=out.rows,
            )  # fmt: skip
            followed.check()
            row = out.rows
            failure = self.advanced(out, now, counts, clock)
            steps, here = counts[0], slice(row, out.rows)
            if row == 0:
                self._check_signals(at_rows[0])
            plan = Plan(
                plan.starts[:steps], plan.h[:steps], row_step[here].copy(), row_part[here].copy()
            )
            if tapes is not None:
                tapes = tapes[0], Tape(*(part[here] for part in tapes[1]))
            now.keep(plan, flat[: 2 * steps], at_rows[here], before, here, tapes)
            if row or out.rows:
                yield out
            if failure is not None:
                raise failure
            if counts[2] == TAPE_FULL:
                self._cap *= 2

    def advanced(
        self, out: Progress, now: Any, counts: Sequence[int], clock: Array
    ) -> SimulationFailed | None:
        """Note what a call by tolerances has done; why the run ends there, if it does. `now` is
        what the last stage left."""
        steps, done, status, solves, refused, failed, which = counts
        begun = out.rows + done > 0
        out.rows, out.steps, out.solves = out.rows + done, out.steps + steps, out.solves + solves
        out.refused, out.failed = out.refused + refused, out.failed + failed
        if not begun:
            return self._failure(now, status, 0.0, INSTANT)
        if status in (CONVERGED, TAPE_FULL):
            return None
        worst = self.compiled.model.errors.names[which] if which >= 0 else "the state"
        return self._failure(now, status, float(clock[0]), float(clock[1]), worst)

    def _start(self, now: "RunState", followed: Followed | None = None) -> None:
        """Nodal forces, moments and loads at the start, the first row, and the rates there; the
        signals are those in the first row, or are found by the kernel. Raises `SimulationFailed`
        and, for signals that are none, `ValueError`."""
        signals = now.out.signals[:1]
        none = np.zeros((0, *signals.shape[1:]))
        plan = Plan(np.zeros(1), np.zeros(0), np.zeros(1, np.int64), np.zeros(1))
        before, here = now.copy(), slice(0, 1)
        _, _, status, _, tapes = self._run(plan, none, signals, now, here, now.taping, followed)
        if followed is not None:
            followed.check()
            self._check_signals(signals)
        if status != CONVERGED:
            raise self._failure(now, status, 0.0, INSTANT)
        now.keep(plan, none, signals, before, here, tapes)
        set_velocities(now.system, now.work, now.y)

    def _check_signals(self, start: Array) -> None:
        """Raises `ValueError` for signals that are not finite at the start."""
        if not np.isfinite(start).all():
            self.signals_at(torch.zeros(1, dtype=torch.float64))

    def signals(self, todo: Sequence[Plan]) -> Tensor:
        """The signals at all stages of some plans (stages, signals, 2)."""
        return self.signals_at(torch.cat([stage_times(plan) for plan in todo]))

    def signals_at_outputs(self, todo: Sequence[Plan]) -> Tensor:
        """The signals at all outputs of some plans (outputs, signals, 2)."""
        times = np.concatenate([np.zeros(0), *(plan.output_times for plan in todo)])
        return self.signals_at(torch.from_numpy(times))

    def _room(self, rows: int) -> Progress:
        """Room for so many outputs."""
        widths = self.compiled.model.widths
        y, integrals, recorded, rate = (np.zeros((rows, width)) for width in widths)
        signals = np.zeros((rows, self.compiled.signal_count, 2))
        return Progress(y, integrals, recorded, rate, signals, np.zeros(rows), origin=self.origin)

    @property
    def system(self) -> Any:
        """The rig's arrays."""
        return self.compiled.system

    def tapes(self, segment: Segment) -> tuple[Any, Any]:
        """The tapes of a segment's stages and outputs, made again from where it began if they were
        not kept."""
        if segment.tapes is not None:
            return segment.tapes
        s, n = self.system, len(segment.plan.out_step)
        work, names = room("Work", s, self.layout.size, columns=1), len(self.integrals.names)
        work.V[:], work.u_dot[:], work.rate[:] = segment.V, segment.u_dot, segment.rate
        again = RunState(
            segment.y.copy(),
            s,
            work,
            room("Step", s, self.layout.size, integrals=names),
            np.zeros(names),
            self._room(n),
            None,
            0.0,
        )
        *_, tapes = self._run(
            segment.plan, segment.signals, segment.at_outputs, again, slice(0, n), True
        )
        assert tapes is not None
        return tapes

    def _run(
        self, plan: Plan, signals: Array, at_outputs: Array, now: "RunState", rows: slice,
        taping: bool, followed: Followed | None = None,
    ) -> tuple[int, int, int, int, tuple[Any, Any] | None]:  # fmt: skip
        """One compiled call of given steps, or of a start with the signals `followed`; with
        `taping` once more with longer tapes if more points touch than they have room for."""
        before, own = now.copy(), dict[str, Any]()
        if followed is not None:
            own = {"given": False, "follow": followed.arrays, "times": np.zeros(1)}
        while True:
            (done, rows_done, status, solves, *_), tapes = self._call(
                now, plan, signals, at_outputs, rows, taping=taping, **own
            )
            if status != TAPE_FULL:
                return done, rows_done, status, solves, tapes
            self._cap *= 2
            now.back(before)

    def _lost(self, now: "RunState") -> str:
        """A sentence on the first body that is no longer on its pad where the last stage ended;
        empty if none is."""
        s, work = now.system, now.work
        for c, contact in enumerate(self.rig.contacts.values()):
            pad, body = s.contact_pad[c], contact.body
            at, n = s.pad_point_start[pad], work.actives[pad]
            ends = s.contact_point_start[c], s.contact_point_start[c + 1] - 1
            if np.isin(work.active[at : at + n], ends).any():
                return f"`{body}` was lost: its contact reached the end of the pad `{contact.pad}`"
            x, y, limit = *work.relative[c, :2], s.contact_limits[c]
            if not (limit[0] <= x <= limit[1] and limit[2] <= y <= limit[3]):
                return f"`{body}` was lost: it left the space over the pad `{contact.pad}`"
        return ""

    def _failure(
        self, now: "RunState", status: int, since: float, h: float, worst: str = ""
    ) -> SimulationFailed:
        """The failure at a time `since` the origin [s], of what the last stage left."""
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
            **dict.fromkeys((OFF_THE_PAD, LOST), self._lost(now)),
            REFUSED: f"the tolerances would need steps below {self._shortest:.3g} s for {worst}; "
            "loosen rtol or atol, or look for a jump in the reference or in a law there",
            NOT_FINITE: "the state is not finite any more; check the parameters and the reference",
        }
        return SimulationFailed(f"at t = {time:.4f} s {reasons[status]}", time)


class Repeated:
    """Runs by tolerances of one stepper through so many times, one after the other, in arrays and
    tables that are made once: without given steps, `landing`, or a derivative. For one thread at a
    time."""

    def __init__(self, stepper: ImplicitStepper, rows: int, motion: Followed) -> None:
        model = stepper.compiled.model
        numbers, ends = np.zeros((2, CHUNK)), np.zeros(rows, np.int64)
        self._plan = plan = Plan(numbers[0], numbers[1], ends, np.zeros(rows))
        self.system, self.work, self.step = model.take(stepper.compiled.numbers)
        self._out, self._y = stepper._room(rows), np.zeros(model.layout.size)
        self._integrals, self._k = np.zeros(self._out.integrals.shape[1]), self._y.copy()
        self._clock, self._times, self._counts = START.copy(), np.zeros(rows), np.zeros(7, np.int64)
        self._stops, self._motion = np.zeros(len(motion.stops) + 1), motion.arrays
        self._errors = model.errors.of(self._y, stepper.atol, stepper.compiled.units)
        signals = np.zeros((CHUNK, 2, *self._out.signals.shape[1:]))
        self._table = Run(
            self.system, self.work, self.step, self._motion, self._errors, *stepper.limits,
            outputs(plan, self._out.arrays, model.no_tape), model.no_tape, False, self._y, self._k,
            self._clock, self._stops, self._times, 0, stepper.rtol, stepper.longest, SHORTEST,
            self._integrals, plan.starts, plan.h, signals, self._counts,
        )  # fmt: skip

    def run(
        self, stepper: ImplicitStepper, y0: Array, t: Array
    ) -> tuple[Progress, SimulationFailed | None]:
        """From y0 (size,) through the times t (rows,) [s], along a motion of as many pieces as the
        first; and why that ended early, if it did."""
        times, motion, out = t - t[0], stepper.followed, self._out
        self._y[:], self._times[:], self._integrals[:] = y0, times, 0.0
        reset(self.system, self.work, self._y)
        moving = ("at", "span", "control")
        errors = stepper.compiled.model.errors.of(self._y, stepper.atol, stepper.compiled.units)
        pairs = [(getattr(self._motion, k), getattr(motion.arrays, k)) for k in moving]
        for own, given in (*pairs, *zip(self._errors[3:], errors[3:])):
            own[:] = given
        stops = motion.stops[(motion.stops > 0.0) & (motion.stops <= times[-1])]
        self._stops[:] = times[-1]
        self._stops[: len(stops)] = stops
        self._clock[:] = 0.0, min(FIRST, times[-1]), 1.0
        done = Progress(*out.arrays, rows=0, origin=float(t[0]))
        failure, (starts, h) = None, self._plan[:2]
        while failure is None and done.rows < len(t):
            change(self._table, row=done.rows, shortest=min(SHORTEST, PART * times[-1]))
            with released_turn():
                call("run", self._table)
            failure = stepper.advanced(done, self, self._counts.tolist(), self._clock)
            if steps := int(self._counts[0]):
                done.starts.append(starts[:steps].copy())
                done.end = float(starts[steps - 1] + h[steps - 1])
        return done.apart(), failure


def outputs(plan: Plan, rows: Sequence[Array], tape: Any) -> Outputs:
    """Where the outputs of a plan go: to rows of a `Progress`."""
    y, integrals, recorded, rate, signals, stored = rows
    return Outputs(
        plan.out_step, plan.out_part, signals, y, integrals, recorded, rate, stored, tape
    )


def reset(s: Any, work: Any, y: Array) -> None:
    """Newton's first guess: the velocities of the state."""
    for part in (work.V, work.u_dot, work.rate):
        part.fill(0.0)
    set_velocities(s, work, y)


def stage_times(plan: Plan) -> Tensor:
    """Times of the stages of a plan (2 steps,) [s], counted as its starts."""
    return torch.from_numpy(
        (plan.starts[:, None] + plan.h[:, None] * np.array([GAMMA, 1.0])).ravel()
    )


def set_velocities(s: Any, work: Any, y: Array) -> None:
    """Newton's first guess: the velocities of the state."""
    for i, c in enumerate(s.body_coordinate):
        work.V[c] = y[s.body_V_start + i]
