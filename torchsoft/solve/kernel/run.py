"""Many steps in one compiled call, given or of lengths that tolerances choose: the error estimate
and the controller.

The estimate is the third divided difference of the solution: the rates at the step's start and at
its two stages give the step's leading error, C h^3 y''' where the motion is smooth. Where a law has
a kink (touch-down, break-away, the onset of slip, a node that comes into contact) the same
difference is of the order of the kink's own error, h^2 times the change of y''.
"""

from typing import Any

import numpy as np

from torchsoft.codegen.invoke import call_value
from torchsoft.solve.kernel import compiled, entry
from torchsoft.solve.kernel.arrays import Array
from torchsoft.solve.kernel.linear import put
from torchsoft.solve.kernel.stage import actuate
from torchsoft.solve.kernel.step import (
    CONVERGED,
    GAMMA,
    NEWTON_FAILED,
    NOT_FINITE,
    OFF_THE_RUNG,
    REFUSED,
    gone,
    solve_near,
    take_back,
    take_step,
    write_rows,
)

ERROR = 2.0 * abs(3.0 * GAMMA**2 - 2.0 * GAMMA**3 - 1.0 / 6.0)
"""Twice the coefficient of h^3 y''' in the step's error."""

SAFETY, LARGEST, SMALLEST = 0.9, 4.0, 0.2
"""The controller aims at this part of the tolerance, and changes a step by these factors at
most."""

INTEGRAL, PROPORTIONAL = 0.7 / 3.0, 0.4 / 3.0
"""Exponents of the PI controller (Gustafsson, ACM TOMS 17, 1991)."""

PASSED = 0.25
"""A step that tolerances choose moves no body by more than this part of its size over a pad that it
may touch: one that flies would else be through the pad between two steps."""

LEAST_ERROR = 1e-6
"""Errors below this part of the tolerance count as this."""


@compiled
def follow(f: Any, t_0: float, t_1: float, out: Array) -> None:
    """Value and rate of every signal into out (1 or 2, signals, 2): at t_0 [s], and at t_1."""
    for row in range(len(out)):
        t = t_0 if row == 0 else t_1
        if f.address != 0:
            f.room[0] = t
            call_value(f.address, f.room, f.room, out[row])
            continue
        for i in range(f.start.size - 1):
            piece = (
                f.start[i] + np.searchsorted(f.at[f.start[i] : f.start[i + 1]], t, side="right") - 1
            )
            piece = max(piece, f.start[i])
            u, n = (t - f.at[piece]) / f.span[piece], f.points[i]
            inside = 0.0 <= u <= 1.0
            u = min(max(u, 0.0), 1.0)
            points, slope = f.room, 0.0
            put(f.control[piece], points[: f.control.shape[1]])
            for level in range(n - 1, 0, -1):  # de Casteljau
                slope = (n - 1) * (points[1] - points[0])
                for j in range(level):
                    points[j] = (1.0 - u) * points[j] + u * points[j + 1]
            out[row, i, 0], out[row, i, 1] = points[0], slope / f.span[piece] if inside else 0.0


@compiled
def estimate(e: Any, d: Any, y: Array, k: Array, h: float, rtol: float) -> tuple[float, int]:
    """The step's error over what the tolerances allow, of the worst part of the state, and which
    part that is."""
    worst, which = 0.0, -1
    for part in range(e.first.size):
        total = size = 0.0
        for i in range(e.first[part], e.last[part]):
            error = (
                ERROR * h * ((d.K[1, i] - d.K[0, i]) / (1.0 - GAMMA) - (d.K[0, i] - k[i]) / GAMMA)
            )
            total += error * error
            change = y[i] - e.origin[i]
            size += change * change
        size = max(np.sqrt(size), e.size[part])
        if e.rate[part]:  # an error of a rate counts by what it displaces within the step
            total *= h * h
            size *= h
        ratio = np.sqrt(total) / (e.atol[part] + rtol * size)
        if not ratio <= worst:
            worst, which = ratio, part
    return worst, which


@compiled
def passing(s: Any, w: Any) -> float:
    """The largest speed of a body over a pad that it may touch, over its size [1/s]."""
    most = 0.0
    for c in range(s.contact_pad.size):
        f = w.frame[c]
        speed = np.hypot(f[4] + f[6] * f[3], f[5] - f[6] * f[2])
        most = max(most, speed / s.contact_size[c])
    return most


@compiled
def next_end(t: float, wanted: float, stops: Array, shift: bool) -> float:
    """Where the next step ends: at the next stop, half way to it, or after the wanted length."""
    if not shift:
        return t + wanted
    stop = np.searchsorted(stops, t, side="right")
    left = stops[min(stop, stops.size - 1)] - t
    if wanted >= left * (1.0 - 1e-9):
        return stops[min(stop, stops.size - 1)]
    return t + (0.5 * left if wanted > 0.5 * left else wanted)


@entry
def run(
    s: Any, s0: Any, w: Any, d: Any, f: Any, e: Any, given: bool, y: Array, k: Array, clock: Array,
    stops: Array, t_out: Array, row: int, rung: float, rtol: float, longest: float, shortest: float,
    tolerance: float, max_iterations: int, margin: float, integrals: Array, ys: Array,
    forces: Array, extras: Array, tape: Any, starts: Array, h: Array, signals: Array, out_step: Any,
    out_part: Array, out_signals: Array,
) -> tuple[int, int, int, int, int, int, int]:  # fmt: skip
    """Take up to h.size steps. `s` are the rig's arrays, `s0` those for a stage of no length.

    starts, h (steps,) [s], signals (steps, 2, signals, 2), value and rate at the stages; output i
    lies at the part out_part[i] of the step out_step[i], where the signals are out_signals[i]. With
    `given` these say what to do. Otherwise they receive what is done, from the output `row` on,
    until the last of t_out; the tolerances choose: clock holds the time, the next step's length and
    the last step's error, k the rates at y. No step passes a time of `stops`, whose last is
    t_out's. A positive `rung` [s] is the only length allowed, for arrays `s` that belong to it: the
    call ends when the controller wants half of it or twice.

    An output's state goes to `ys`, (F_N, F_T) of every point to `forces`, and integrals, the pads'
    moments and the generalised contact forces to `extras`; `tape` has two rows a step, or none. y,
    `integrals` and the guesses in w are advanced in place; after a failure they hold the last good
    step. With no steps the one output is that of y itself.

    Returns steps and outputs done, status, linear solves, steps that were refused for their error
    and that Newton did not solve, and the part of the state whose error was largest in the last
    one.
    """
    steps, solves, refused, failed, which, first = 0, 0, 0, 0, -1, row
    status, begin = CONVERGED, h.size == 0
    while (steps < h.size and (given or row < t_out.size)) or begin:
        t, wanted, end, error, last = clock[0], min(clock[1], longest), 0.0, 0.0, row
        if begin:  # the output at the start, where nothing has moved
            d.K[:], d.powers[:], w.travelled[0], now, last = 0.0, 0.0, np.inf, 0.0, row + 1
            put(y, d.y)
            put(integrals, d.integrals)
            put(w.travelled, d.travelled)
        else:
            now = h[steps]
            if not given:
                if rung > 0.0 and not rung * (1.0 - 1e-9) <= wanted < 2.0 * rung:
                    status = OFF_THE_RUNG
                    break
                end = next_end(t, rung if rung > 0.0 else wanted, stops, rung == 0.0)
                now = rung if rung > 0.0 else end - t
                follow(f, t + GAMMA * now, end, signals[steps])
            status, count = take_step(
                s,
                w,
                d,
                y,
                now,
                signals[steps],
                tolerance,
                max_iterations,
                margin,
                integrals,
                tape,
                2 * steps,
            )
            solves += count
            if status == CONVERGED and not given:
                error, which = estimate(e, d, y, k, now, rtol)
                error = max(error, (now * passing(s, w) / PASSED) ** 3)
                if not error <= 1.0:
                    status = REFUSED
            if status == CONVERGED:
                status = gone(s, w)
            if status == CONVERGED:
                while last < out_step.size and (
                    out_step[last] == steps if given else t_out[last] <= end
                ):
                    if not given:
                        part = (t_out[last] - t) / now
                        out_step[last], out_part[last] = steps, part if part < 1.0 - 1e-9 else 1.0
                        follow(f, t_out[last], t_out[last], out_signals[last : last + 1])
                    last += 1
        if status == CONVERGED:
            status, count = write_rows(
                s, s0, w, d, y, now, out_part, out_signals, row, last, tolerance, max_iterations,
                margin, integrals, ys, forces, extras,
            )  # fmt: skip
            solves += count
        if begin:
            put(w.k, d.K[0])
            begin, row = False, last
        elif status == CONVERGED:
            if not given:
                starts[steps], h[steps] = t, now
                put(d.K[1], k)
                enlarge(e, y)
                error = max(error, LEAST_ERROR)
                longer = now * min(
                    LARGEST, max(SMALLEST, SAFETY * error**-INTEGRAL * clock[2] ** PROPORTIONAL)
                )
                clock[0], clock[1], clock[2] = (
                    end,
                    max(longer, wanted) if now < wanted else longer,
                    error,
                )
            row, steps = last, steps + 1
        else:
            take_back(w, d, y, integrals)
            again = (
                not given and wanted > shortest
            )  # not `now`, which rounding leaves a little longer
            if again and status == REFUSED:
                refused, smaller = refused + 1, SAFETY * error ** (-1.0 / 3.0)
                clock[1] = max(now * (smaller if smaller > SMALLEST else SMALLEST), shortest)
            elif again and status in (NEWTON_FAILED, NOT_FINITE):
                failed, clock[1] = failed + 1, max(now * SMALLEST, shortest)
            else:
                break
            status = CONVERGED
    return steps, row - first, status, solves, refused, failed, which


@compiled
def enlarge(e: Any, y: Array) -> None:
    """Note how large every part of the state has become."""
    for part in range(e.first.size):
        size = 0.0
        for i in range(e.first[part], e.last[part]):
            size += (y[i] - e.origin[i]) ** 2
        e.size[part] = max(e.size[part], np.sqrt(size))


AT_ONCE = 1e-18
"""Length a h [s] of the stage: no velocity changes in it by more than rounding does."""


@entry
def rates(
    s: Any, w: Any, f: Any, t: float, y: Array, tolerance: float, max_iterations: int,
    margin: float, signals: Array, powers: Array, moments: Array, out: Array,
) -> bool:  # fmt: skip
    """dy/dt of the state y at t [s] into out, of a rig whose pads are massless; False if Newton
    finds no forces there.

    A stage of no length gives all rates; those of the velocities are a difference over its length
    and come from the loads instead. signals (1, signals, 2) is scratch, as are powers and moments.
    """
    follow(f, t, t, signals)
    for i in range(s.body_coordinate.size):
        w.V[s.body_coordinate[i]] = y[s.body_V_start + i]
    w.travelled[0] = np.inf  # the last state was any other one
    converged, _, _ = solve_near(
        s, w, y, signals[0], AT_ONCE, tolerance, max_iterations, margin, powers, moments
    )
    put(w.k, out)
    for i in range(s.body_coordinate.size):
        c, mass = s.body_coordinate[i], s.p[s.body_mass_at[i]]
        load = w.load[c] - s.body_weight[i] * mass * s.p[s.body_gravity_at]
        for a in range(s.act_pushed.size):
            if s.act_pushed[a] == c:
                load += actuate(s, a, w.q, w.V, signals[0], w.effort_x, w.effort, w.effort_J)
        out[s.body_V_start + i] = load / mass  # (17), (18)
        out[s.body_q_start + i] = y[s.body_V_start + i]
    return converged
