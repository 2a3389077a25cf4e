"""Many steps in one compiled call, given or of lengths that tolerances choose: the error estimate
and the controller.

The estimate is the third divided difference of the solution: the rates at the step's start and at
its two stages give the step's leading error, C h^3 y''' where the motion is smooth. Where a law has
a kink (touch-down, break-away, the onset of slip, a node that comes into contact) the same
difference is of the order of the kink's own error, h^2 times the change of y''.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.arrays import (
    CONVERGED,
    GAMMA,
    NEWTON_FAILED,
    NOT_FINITE,
    PASSED,
    REFUSED,
)
from torchsoft.solve.kernel.invoke import call_value
from torchsoft.solve.kernel.linear import put
from torchsoft.solve.kernel.sources import effort
from torchsoft.solve.kernel.step import departed, solve_near, take_back, take_step, write_rows
from torchsoft.solve.kernel.table import Array

ERROR = 2.0 * abs(3.0 * GAMMA**2 - 2.0 * GAMMA**3 - 1.0 / 6.0)
"""Twice the coefficient of h^3 y''' in the step's error."""

SAFETY, LARGEST, SMALLEST = 0.9, 4.0, 0.2
"""The controller aims at this part of the tolerance, and changes a step by these factors at
most."""

INTEGRAL, PROPORTIONAL = 0.7 / 3.0, 0.4 / 3.0
"""Exponents of the PI controller (Gustafsson, ACM TOMS 17, 1991)."""

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
        if e.rate[part] != 0:  # an error of a rate counts by what it displaces within the step
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
        speed = np.hypot(w.relative[c, 3], w.relative[c, 4])
        most = max(most, speed / s.contact_size[c])
    return most


@compiled
def next_end(t: float, length: float, stops: Array) -> float:
    """End of the next step: at the next stop, half way to it, or after the wanted length."""
    stop = np.searchsorted(stops, t, side="right")
    left = stops[min(stop, stops.size - 1)] - t
    if length >= left * (1.0 - 1e-9):
        return stops[min(stop, stops.size - 1)]
    return t + (0.5 * left if length > 0.5 * left else length)


@compiled
def guess(s: Any, w: Any, y: Array) -> None:
    """Newton's first guess: the velocities of the state."""
    w.V[:], w.u_dot[:], w.rate[:] = 0.0, 0.0, 0.0
    for i in range(s.body_coordinate.size):
        w.V[s.body_coordinate[i]] = y[s.body_V_start + i]


@compiled
def afresh(w: Any) -> None:
    """Forget which points are near and what is held, so that what is made again has the same
    bits."""
    w.travelled[0] = np.inf
    w.low[:], w.high[:], w.held[:] = 0, 0, 0.0


@compiled
def run(r: Any) -> None:
    """Take up to h.size steps of the rig's arrays `s`, with `begin` after the output 0, that of y
    itself, of step -1.

    starts, h (steps,) [s], signals (steps, 2, signals, 2), value and rate at the stages, and the
    steps and parts of the outputs. With `given` these prescribe the steps. Otherwise they receive
    the steps taken, until the last of t_out; the tolerances choose: clock holds the time, the next
    step's length and the last step's error, k the rates at y. No step passes a time of `stops`,
    whose last is t_out's.

    `tape` has two rows a step, or none. y, `integrals` and the guesses in w are advanced in place;
    after a failure they hold the last good step.

    counts receives steps and outputs done, status, linear solves, steps that were refused for their
    error and that Newton did not solve, and the part of the state whose error was largest in the
    last one.
    """
    s, w, d, y, out, given, begin = r.s, r.w, r.d, r.y, r.out, r.given != 0, r.begin != 0
    clock, counts, h, t_out = r.clock, r.counts, r.h, r.t_out
    steps, row, solves, refused, failed, which, status = 0, 0, 0, 0, 0, -1, CONVERGED
    afresh(w)
    while (steps < h.size and (given or row < t_out.size)) or begin:
        t, length, end, error, last = clock[0], min(clock[1], r.longest), 0.0, 0.0, row
        if begin:  # nothing has moved
            d.K[:], d.powers[:], now, last = 0.0, 0.0, 0.0, 1
            guess(s, w, y)
            put(y, d.y)
            put(r.integrals, d.integrals)
            put(w.travelled, d.travelled)
            out.step[0], out.part[0] = -1, 0.0
            if not given:
                follow(r.f, t_out[0], t_out[0], out.signals)
        else:
            now = h[steps]
            if not given:
                end = next_end(t, length, r.stops)
                now = end - t
                follow(r.f, t + GAMMA * now, end, r.signals[steps])
            status, count = take_step(r, now, r.signals[steps], 2 * steps)
            solves += count
            if status == CONVERGED and not given:
                error, which = estimate(r.e, d, y, r.k, now, r.rtol)
                error = max(error, (now * passing(s, w) / PASSED) ** 3)
                if not error <= 1.0:
                    status = REFUSED
            if status == CONVERGED:
                status = departed(s, w)
            if status == CONVERGED:
                while last < out.step.size and (
                    out.step[last] == steps if given else t_out[last] <= end
                ):
                    if not given:
                        part = (t_out[last] - t) / now
                        out.step[last], out.part[last] = steps, part if part < 1.0 - 1e-9 else 1.0
                        follow(r.f, t_out[last], t_out[last], out.signals[last : last + 1])
                    last += 1
        if status == CONVERGED:
            limits = r.start if begin else r.limits
            status, count = write_rows(r, limits, now, row, last)
            solves += count
        if begin and status != CONVERGED:
            break
        if begin:
            put(w.k, r.k)
            afresh(w)
            begin, row, solves = False, last, 0
        elif status == CONVERGED:
            if not given:
                r.starts[steps], h[steps] = t, now
                put(d.K[1], r.k)
                enlarge(r.e, y)
                error = max(error, LEAST_ERROR)
                longer = now * min(
                    LARGEST, max(SMALLEST, SAFETY * error**-INTEGRAL * clock[2] ** PROPORTIONAL)
                )
                length = max(longer, length) if now < length else longer
                clock[0], clock[1], clock[2] = end, length, error
            row, steps = last, steps + 1
        else:
            take_back(r)
            # not `now`, which rounding leaves a little longer
            again = not given and length > r.shortest
            if again and status == REFUSED:
                refused, smaller = refused + 1, SAFETY * error ** (-1.0 / 3.0)
                clock[1] = max(now * (smaller if smaller > SMALLEST else SMALLEST), r.shortest)
            elif again and status in (NEWTON_FAILED, NOT_FINITE):
                failed, clock[1] = failed + 1, max(now * SMALLEST, r.shortest)
            else:
                break
            status = CONVERGED
    counts[0], counts[1], counts[2] = steps, row, status
    counts[3], counts[4], counts[5], counts[6] = solves, refused, failed, which


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


@compiled
def rates(r: Any) -> None:
    """dy/dt of the state y at t [s] into out, of a rig whose pads are massless; converged receives
    0 if Newton finds no forces there.

    A stage of no length gives all rates; those of the velocities are a difference over its length
    and come from the loads instead. signals (1, signals, 2) is scratch, as are powers and wrenches.
    """
    s, w, y, out = r.s, r.w, r.y, r.out
    follow(r.f, r.t, r.t, r.signals)
    for i in range(s.body_coordinate.size):
        w.V[s.body_coordinate[i]] = y[s.body_V_start + i]
    w.travelled[0] = np.inf  # the last state was any other one
    converged, _, _ = solve_near(s, w, r.limits, y, r.signals[0], AT_ONCE, r.powers, r.wrenches)
    put(w.k, out)
    for i in range(s.source_pushed.size):
        w.load[s.source_pushed[i]] += effort(s, w, i, y, r.signals[0], AT_ONCE)
    for i in range(s.body_coordinate.size):
        load = w.load[s.body_coordinate[i]]
        out[s.body_V_start + i] = load / s.p[s.body_mass_at[i]]  # (17), (18)
        out[s.body_q_start + i] = y[s.body_V_start + i]
    r.converged[0] = 1 if converged else 0
