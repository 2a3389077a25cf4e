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
from torchsoft.solve.kernel.domain import departed, innermost
from torchsoft.solve.kernel.invoke import call_value
from torchsoft.solve.kernel.linear import put
from torchsoft.solve.kernel.step import take_back, take_step, write_rows
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
def follow(followed: Any, t_0: float, t_1: float, out: Array) -> None:
    """Value and rate of every signal into out (1 or 2, signals, 2): at t_0 [s], and at t_1."""
    for row in range(len(out)):
        t = t_0 if row == 0 else t_1
        if followed.address != 0:
            followed.room[0] = t
            call_value(followed.address, followed.room, followed.room, out[row])
            continue
        for i in range(followed.start.size - 1):
            piece = (
                followed.start[i]
                + np.searchsorted(
                    followed.at[followed.start[i] : followed.start[i + 1]], t, side="right"
                )
                - 1
            )
            piece = max(piece, followed.start[i])
            u, n = (t - followed.at[piece]) / followed.span[piece], followed.points[i]
            inside = 0.0 <= u <= 1.0
            u = min(max(u, 0.0), 1.0)
            points, slope = followed.room, 0.0
            put(followed.control[piece], points[: followed.control.shape[1]])
            for level in range(n - 1, 0, -1):  # de Casteljau
                slope = (n - 1) * (points[1] - points[0])
                for j in range(level):
                    points[j] = (1.0 - u) * points[j] + u * points[j + 1]
            out[row, i, 0], out[row, i, 1] = (
                points[0],
                slope / followed.span[piece] if inside else 0.0,
            )


@compiled
def estimate(
    errors: Any, taken: Any, y: Array, k: Array, h: float, rtol: float
) -> tuple[float, int]:
    """The step's error over what the tolerances allow, of the worst part of the state, and which
    part that is."""
    worst, which = 0.0, -1
    for part in range(errors.first.size):
        total = size = 0.0
        for i in range(errors.first[part], errors.last[part]):
            error = (
                ERROR
                * h
                * ((taken.K[1, i] - taken.K[0, i]) / (1.0 - GAMMA) - (taken.K[0, i] - k[i]) / GAMMA)
            )
            total += error * error
            change = y[i] - errors.origin[i]
            size += change * change
        size = max(np.sqrt(size), errors.size[part])
        if errors.rate[part] != 0:  # an error of a rate counts by what it displaces within the step
            total *= h * h
            size *= h
        ratio = np.sqrt(total) / (errors.atol[part] + rtol * size)
        if not ratio <= worst:
            worst, which = ratio, part
    return worst, which


@compiled
def passing(rig: Any, work: Any) -> float:
    """The largest speed of a body over a pad that it may touch, over its size [1/s]."""
    most = 0.0
    for c in range(rig.contact_pad.size):
        speed = np.hypot(work.relative[c, 3], work.relative[c, 4])
        most = max(most, speed / rig.contact_size[c])
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
def guess(rig: Any, work: Any, y: Array) -> None:
    """Newton's first guess: the velocities of the state."""
    work.V[:], work.u_dot[:], work.rate[:] = 0.0, 0.0, 0.0
    for i in range(rig.body_coordinate.size):
        work.V[rig.body_coordinate[i]] = y[rig.body_V_start + i]


@compiled
def afresh(work: Any) -> None:
    """Forget which points are near and what is held, so that what is made again has the same
    bits."""
    work.travelled[0] = np.inf
    work.low[:], work.high[:], work.held[:] = 0, 0, 0.0


@compiled
def run(call: Any) -> None:
    """Take up to h.size steps of the arrays of a rig, with `begin` after the output 0, that of y
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
    last one, or the contact whose domain a body left.
    """
    rig, work, taken, y, out, given, begin = (
        call.rig,
        call.work,
        call.taken,
        call.y,
        call.out,
        call.given != 0,
        call.begin != 0,
    )
    clock, counts, h, t_out = call.clock, call.counts, call.h, call.t_out
    steps, row, solves, refused, failed, which, status = 0, 0, 0, 0, 0, -1, CONVERGED
    afresh(work)
    while (steps < h.size and (given or row < t_out.size)) or begin:
        t, length, end, error, last = clock[0], min(clock[1], call.longest), 0.0, 0.0, row
        if begin:  # nothing has moved
            taken.K[:], taken.powers[:], now, last = 0.0, 0.0, 0.0, 1
            guess(rig, work, y)
            put(y, taken.y)
            put(call.integrals, taken.integrals)
            put(work.travelled, taken.travelled)
            out.step[0], out.part[0] = -1, 0.0
            if not given:
                follow(call.followed, t_out[0], t_out[0], out.signals)
        else:
            now = h[steps]
            if not given:
                end = next_end(t, length, call.stops)
                now = end - t
                follow(call.followed, t + GAMMA * now, end, call.signals[steps])
            status, count = take_step(call, now, call.signals[steps], 2 * steps)
            solves += count
            if status == CONVERGED and not given:
                error, which = estimate(call.errors, taken, y, call.k, now, call.rtol)
                error = max(error, (now * passing(rig, work) / PASSED) ** 3)
                if not error <= 1.0:
                    status = REFUSED
            if status == CONVERGED:
                status, lost = departed(rig, work, y, GAMMA * now)
                which = lost if status != CONVERGED else which
            if status == CONVERGED:
                while last < out.step.size and (
                    out.step[last] == steps if given else t_out[last] <= end
                ):
                    if not given:
                        part = (t_out[last] - t) / now
                        out.step[last], out.part[last] = steps, part if part < 1.0 - 1e-9 else 1.0
                        follow(
                            call.followed, t_out[last], t_out[last], out.signals[last : last + 1]
                        )
                    last += 1
        if status == CONVERGED:
            limits = call.start if begin else call.limits
            status, count = write_rows(call, limits, now, row, last)
            solves += count
        if begin and status != CONVERGED:
            break
        if begin:
            put(work.k, call.k)
            for c in range(rig.contact_pad.size):
                innermost(rig, work, c)
            put(work.inner, work.inner_before)
            afresh(work)
            begin, row, solves = False, last, 0
        elif status == CONVERGED:
            put(work.inner, work.inner_before)
            if not given:
                call.starts[steps], h[steps] = t, now
                put(taken.K[1], call.k)
                enlarge(call.errors, y)
                error = max(error, LEAST_ERROR)
                longer = now * min(
                    LARGEST, max(SMALLEST, SAFETY * error**-INTEGRAL * clock[2] ** PROPORTIONAL)
                )
                length = max(longer, length) if now < length else longer
                clock[0], clock[1], clock[2] = end, length, error
            row, steps = last, steps + 1
        else:
            take_back(call)
            # not `now`, which rounding leaves a little longer
            again = not given and length > call.shortest
            if again and status == REFUSED:
                refused, smaller = refused + 1, SAFETY * error ** (-1.0 / 3.0)
                clock[1] = max(now * (smaller if smaller > SMALLEST else SMALLEST), call.shortest)
            elif again and status in (NEWTON_FAILED, NOT_FINITE):
                failed, clock[1] = failed + 1, max(now * SMALLEST, call.shortest)
            else:
                break
            status = CONVERGED
    counts[0], counts[1], counts[2] = steps, row, status
    counts[3], counts[4], counts[5], counts[6] = solves, refused, failed, which


@compiled
def enlarge(errors: Any, y: Array) -> None:
    """Note how large every part of the state has become."""
    for part in range(errors.first.size):
        size = 0.0
        for i in range(errors.first[part], errors.last[part]):
            size += (y[i] - errors.origin[i]) ** 2
        errors.size[part] = max(errors.size[part], np.sqrt(size))
