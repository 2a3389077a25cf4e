"""One implicit step: SDIRK2, its running energy integrals and its dense output.

SDIRK2 is Alexander's two-stage method (SIAM J. Numer. Anal. 14, 1977): L-stable, stiffly accurate,
of second order, both stages with the same a = 1 - 1/sqrt(2), so that one mobility serves both. The
second stage starts from y* = (1 - MIX) y + MIX Y_1 and its end is the step's.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, contacts, pads, sources
from torchsoft.solve.kernel.arrays import (
    AXES,
    CONVERGED,
    GAMMA,
    INSTANT,
    MIX,
    NEWTON_FAILED,
    NOT_FINITE,
    TAPE_FULL,
    TINY,
    WRENCH,
)
from torchsoft.solve.kernel.linear import put
from torchsoft.solve.kernel.stage import finish, solve_stage
from torchsoft.solve.kernel.table import Array


@compiled
def write_tape(rig: Any, work: Any, tape: Any, row: int, y: Array, way: float) -> bool:
    """Put one solved stage on the tape, its displacements after `way` [s] at its rates; False if
    more points touch than it has room for."""
    put(y, tape.y[row])
    put(work.q, tape.q[row])
    put(work.V, tape.V[row])
    put(work.rate, tape.rate[row])
    slot = 0
    for pad in range(rig.pad_base.size):
        at = rig.pad_point_start[pad]
        tape.count[row, pad] = work.actives[pad]
        if slot + work.actives[pad] > tape.point.shape[1]:
            return False
        for i in range(work.actives[pad]):
            k = work.active[at + i]
            tape.point[row, slot] = k
            state = tape.state[row, slot]
            ux, uy = contacts.at_point(rig, k, work.u)
            state[2], state[3] = contacts.at_point(rig, k, work.u_dot)
            state[0], state[1] = ux + way * state[2], uy + way * state[3]
            slot += 1
    return True


@compiled
def record(rig: Any, work: Any, wrenches: Array, out: Array) -> None:
    """One row of forces, as `recorded_size` orders them."""
    out[:] = 0.0
    for pad in range(rig.pad_base.size):
        at = rig.pad_point_start[pad]
        for i in range(work.actives[pad]):
            k = work.active[at + i]
            force = WRENCH + rig.contact_states[rig.point_contact[k]]
            put(work.out[k, force : force + AXES], out[AXES * k : AXES * (k + 1)])
    first, last = contacts.wrench_at(rig, 0), contacts.wrench_at(rig, rig.pad_base.size)
    put(wrenches, out[first:last])
    put(work.load, out[last:])


@compiled
def stored(rig: Any, work: Any, y: Array) -> float:
    """Energy [J] of the rig in the state y where the last stage ended; nan with nodal pads."""
    total = 0.0
    for pad in range(rig.pad_base.size):
        total += pads.stored(rig, pad, y) + contacts.stored(rig, work, pad, y)
    for i in range(rig.body_coordinate.size):
        total += 0.5 * rig.p[rig.body_mass_at[i]] * y[rig.body_V_start + i] ** 2
    return total


@compiled
def solve_near(
    rig: Any,
    work: Any,
    limits: Any,
    y: Array,
    signals: Array,
    a: float,
    powers: Array,
    wrenches: Array,
) -> tuple[bool, int, float]:
    """A stage from y with every point that may touch in the window: success, linear solves, a bound
    of all speeds [m/s]."""
    solves, speed, margin, done, converged = 0, 0.0, limits.margin, False, True
    reach = margin
    while converged and not done:
        converged, count = solve_stage(rig, work, limits, y, signals, a, reach)
        solves += count
        if converged:
            speed = finish(rig, work, y, a, powers, wrenches)
            done = work.travelled[0] + a * speed <= work.travelled[1]
            if not done:  # a point may have come near that was not looked at
                converged = reach == margin  # one look further must do
                if work.travelled[0] == 0.0:
                    reach = margin + 1.5 * a * speed
                work.travelled[0] = np.inf
    return converged, solves, speed


@compiled
def take_step(call: Any, h: float, signals: Array, row: int) -> tuple[int, int]:
    """One step of h [s] from y, which goes to its end with `integrals`; signals (2, signals, 2) are
    those of the stages, `row` the first one's on the tape. The start stays in taken.y,
    taken.integrals; taken.K, taken.powers and taken.speed receive the stages' results. Returns
    status and solves."""
    rig, work, taken, y, integrals, tape = (
        call.rig,
        call.work,
        call.taken,
        call.y,
        call.integrals,
        call.tape,
    )
    a, solves = GAMMA * h, 0
    put(y, taken.y)
    put(integrals, taken.integrals)
    put(work.V, taken.V)
    put(work.u_dot, taken.u_dot)
    put(work.rate, taken.rate)
    put(work.travelled, taken.travelled)
    status = CONVERGED
    for stage in range(2):
        powers = taken.powers[stage]
        converged, count, speed = solve_near(
            rig, work, call.limits, y, signals[stage], a, powers, taken.wrenches
        )
        solves += count
        if not converged:
            status = NEWTON_FAILED
            break
        if tape.y.shape[0] > 0 and not write_tape(rig, work, tape, row + stage, y, 0.0):
            status = TAPE_FULL
            break
        sources.supply(rig, work, a, powers, rig.pad_base.size + 2)
        put(work.k, taken.K[stage])
        taken.speed[stage] = speed
        dt = a if stage == 1 else h - a
        for i in range(integrals.size):
            integrals[i] += dt * powers[i]
        for i in range(y.size):
            value = y[i] + dt * work.k[i]
            y[i] = value if abs(value) > TINY else 0.0
        work.travelled[0] += dt * speed
    if status == CONVERGED and not np.isfinite(y.sum()):
        status = NOT_FINITE
    return status, solves


@compiled
def take_back(call: Any) -> None:
    """Return to where `take_step` began."""
    work, taken = call.work, call.taken
    put(taken.y, call.y)
    put(taken.integrals, call.integrals)
    put(taken.V, work.V)
    put(taken.u_dot, work.u_dot)
    put(taken.rate, work.rate)
    work.travelled[0] = np.inf


@compiled
def dense(part: float) -> tuple[float, float]:
    """Weights b_1, b_2 of the stages' rates at a part of the step (0 to 1): the continuous
    extension of second order."""
    second = part * (0.5 * part - GAMMA) / (1.0 - GAMMA)
    return part - second, second


@compiled
def dense_states(part: float) -> tuple[float, float, float]:
    """The same as weights of the states at the step's start, its first stage and its end; (0, 0, 1)
    at the end."""
    if part == 1.0:
        return 0.0, 0.0, 1.0
    b_1, b_2 = dense(part)
    return 1.0 - b_1 / GAMMA - b_2 * (1.0 - MIX) / GAMMA, (b_1 - b_2 * MIX) / GAMMA, b_2 / GAMMA


@compiled
def write_rows(call: Any, limits: Any, h: float, first: int, last: int) -> tuple[int, int]:
    """The outputs from `first` to `last` of the step just taken. At its end they are what the last
    stage found; before it, dense output with the forces that belong to it, which take a stage of no
    length; that is what `out.tape` holds, if it has rows. Returns status and linear solves."""
    rig, work, taken, y, integrals, out = (
        call.rig,
        call.work,
        call.taken,
        call.y,
        call.integrals,
        call.out,
    )
    parts, ys, tape = out.part, out.y, out.tape
    solves, here = 0, work.travelled[0]
    put(work.V, taken.guess_V)
    put(work.u_dot, taken.guess)
    put(work.rate, taken.guess_rate)
    for i in range(
        last - 1, first - 1, -1
    ):  # the end comes first: the others disturb what the last stage left
        way, scans = GAMMA * h if parts[i] == 1.0 else 0.0, work.travelled[2]
        if parts[i] == 1.0:
            put(y, ys[i])
            put(integrals, taken.at_row)
        else:
            b_1, b_2 = dense(parts[i])
            for j in range(y.size):
                ys[i, j] = taken.y[j] + h * (b_1 * taken.K[0, j] + b_2 * taken.K[1, j])
            early = min(parts[i], 1.0 - GAMMA)
            for j in range(integrals.size):
                first_part, second_part = b_1, b_2
                if (
                    j < rig.pad_base.size + 2
                ):  # what is dissipated never falls: a stage's power until its weight is used up
                    first_part, second_part = early, parts[i] - early
                taken.at_row[j] = taken.integrals[j] + h * (
                    first_part * taken.powers[0, j] + second_part * taken.powers[1, j]
                )
            gone_by = taken.travelled[0] + h * (
                abs(b_1) * taken.speed[0] + abs(b_2) * taken.speed[1]
            )
            work.travelled[0] = gone_by if scans == taken.travelled[2] else np.inf
            converged, count, _ = solve_near(
                rig, work, limits, ys[i], out.signals[i], INSTANT, taken.scrap, taken.wrenches
            )
            solves += count
            if not converged:
                return NEWTON_FAILED, solves
        if tape.count.shape[0] > 0 and not write_tape(rig, work, tape, i, ys[i], way):
            return TAPE_FULL, solves
        put(taken.at_row, out.integrals[i])
        record(rig, work, taken.wrenches, out.recorded[i])
        put(work.rate, out.rate[i])
        out.stored[i] = stored(rig, work, ys[i])
        put(taken.guess_V, work.V)
        put(taken.guess, work.u_dot)
        put(taken.guess_rate, work.rate)
        work.travelled[0] = here if work.travelled[2] == scans else np.inf
    return CONVERGED, solves
