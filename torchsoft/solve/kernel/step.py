"""One implicit step: SDIRK2, its running energy integrals, its dense output, and causes of an early
end.

SDIRK2 is Alexander's two-stage method (SIAM J. Numer. Anal. 14, 1977): L-stable, stiffly accurate,
of second order, both stages with the same a = 1 - 1/sqrt(2), so that one mobility serves both. The
second stage starts from y* = (1 - MIX) y + MIX Y_1 and its end is the step's.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, contacts, pads, sources
from torchsoft.solve.kernel.arrays import (
    CONVERGED,
    GAMMA,
    INSTANT,
    LOST,
    MIX,
    NEWTON_FAILED,
    NOT_FINITE,
    OFF_THE_PAD,
    TAPE_FULL,
    TINY,
    WRENCH,
)
from torchsoft.solve.kernel.linear import put
from torchsoft.solve.kernel.stage import finish, solve_stage
from torchsoft.solve.kernel.table import Array


@compiled
def write_tape(s: Any, w: Any, tape: Any, row: int, y: Array, way: float) -> bool:
    """Put one solved stage on the tape, its displacements after `way` [s] at its rates; False if
    more points touch than it has room for."""
    put(y, tape.y[row])
    put(w.q, tape.q[row])
    put(w.V, tape.V[row])
    put(w.rate, tape.rate[row])
    slot = 0
    for pad in range(s.pad_base.size):
        at = s.pad_point_start[pad]
        tape.count[row, pad] = w.actives[pad]
        if slot + w.actives[pad] > tape.point.shape[1]:
            return False
        for i in range(w.actives[pad]):
            k = w.active[at + i]
            tape.point[row, slot] = k
            state = tape.state[row, slot]
            ux, uy = contacts.at_point(s, k, w.u)
            state[2], state[3] = contacts.at_point(s, k, w.u_dot)
            state[0], state[1] = ux + way * state[2], uy + way * state[3]
            slot += 1
    return True


@compiled
def departed(s: Any, w: Any) -> int:
    """Whether a contact has reached the end of a pad, or a body has left the space over one."""
    for c in range(s.contact_pad.size):
        at = s.pad_point_start[s.contact_pad[c]]
        for i in range(w.actives[s.contact_pad[c]]):
            if (
                w.active[at + i] == s.contact_point_start[c]
                or w.active[at + i] == s.contact_point_start[c + 1] - 1
            ):
                return OFF_THE_PAD
        x, y, limit = w.relative[c, 0], w.relative[c, 1], s.contact_limits[c]
        if not (limit[0] <= x <= limit[1] and limit[2] <= y <= limit[3]):
            return LOST
    return CONVERGED


@compiled
def record(s: Any, w: Any, wrenches: Array, out: Array) -> None:
    """One row of forces, as `recorded_size` orders them."""
    out[:] = 0.0
    for pad in range(s.pad_base.size):
        at = s.pad_point_start[pad]
        for i in range(w.actives[pad]):
            k = w.active[at + i]
            felt = WRENCH + s.contact_states[s.point_contact[k]]
            out[2 * k], out[2 * k + 1] = w.out[k, felt], w.out[k, felt + 1]
    first = 2 * s.point_contact.size
    put(wrenches, out[first : first + wrenches.size])
    put(w.load, out[first + wrenches.size :])


@compiled
def stored(s: Any, w: Any, y: Array) -> float:
    """Energy [J] of the rig in the state y where the last stage ended; nan with nodal pads."""
    total = 0.0
    for pad in range(s.pad_base.size):
        total += pads.stored(s, pad, y) + contacts.stored(s, w, pad, y)
    for i in range(s.body_coordinate.size):
        total += 0.5 * s.p[s.body_mass_at[i]] * y[s.body_V_start + i] ** 2
    return total


@compiled
def solve_near(
    s: Any, w: Any, limits: Any, y: Array, signals: Array, a: float, powers: Array, wrenches: Array
) -> tuple[bool, int, float]:
    """A stage from y with every point that may touch in the window: success, linear solves, a bound
    of all speeds [m/s]."""
    solves, speed, margin, done, converged = 0, 0.0, limits.margin, False, True
    reach = margin
    while converged and not done:
        converged, count = solve_stage(s, w, limits, y, signals, a, reach)
        solves += count
        if converged:
            speed = finish(s, w, y, signals, a, powers, wrenches)
            done = w.travelled[0] + a * speed <= w.travelled[1]
            if not done:  # a point may have come near that was not looked at
                converged = reach == margin  # one look further must do
                if w.travelled[0] == 0.0:
                    reach = margin + 1.5 * a * speed
                w.travelled[0] = np.inf
    return converged, solves, speed


@compiled
def take_step(r: Any, h: float, signals: Array, row: int) -> tuple[int, int]:
    """One step of h [s] from y, which goes to its end with `integrals`; signals (2, signals, 2) are
    those of the stages, `row` the first one's on the tape. The start stays in d.y, d.integrals;
    d.K, d.powers and d.speed receive the stages' results. Returns status and solves."""
    s, w, d, y, integrals, tape = r.s, r.w, r.d, r.y, r.integrals, r.tape
    a, solves = GAMMA * h, 0
    put(y, d.y)
    put(integrals, d.integrals)
    put(w.V, d.V)
    put(w.u_dot, d.u_dot)
    put(w.rate, d.rate)
    put(w.travelled, d.travelled)
    status = CONVERGED
    for stage in range(2):
        powers = d.powers[stage]
        converged, count, speed = solve_near(
            s, w, r.limits, y, signals[stage], a, powers, d.wrenches
        )
        solves += count
        if not converged:
            status = NEWTON_FAILED
            break
        if tape.y.shape[0] > 0 and not write_tape(s, w, tape, row + stage, y, 0.0):
            status = TAPE_FULL
            break
        sources.supply(s, w, y, signals[stage], a, powers, s.pad_base.size + 2)
        put(w.k, d.K[stage])
        d.speed[stage] = speed
        dt = a if stage == 1 else h - a
        for i in range(integrals.size):
            integrals[i] += dt * powers[i]
        for i in range(y.size):
            value = y[i] + dt * w.k[i]
            y[i] = value if abs(value) > TINY else 0.0
        w.travelled[0] += dt * speed
    if status == CONVERGED and not np.isfinite(y.sum()):
        status = NOT_FINITE
    return status, solves


@compiled
def take_back(r: Any) -> None:
    """Return to where `take_step` began."""
    w, d = r.w, r.d
    put(d.y, r.y)
    put(d.integrals, r.integrals)
    put(d.V, w.V)
    put(d.u_dot, w.u_dot)
    put(d.rate, w.rate)
    w.travelled[0] = np.inf


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
def write_rows(r: Any, limits: Any, h: float, first: int, last: int) -> tuple[int, int]:
    """The outputs from `first` to `last` of the step just taken. At its end they are what the last
    stage found; before it, dense output with the forces that belong to it, which take a stage of no
    length; that is what `out.tape` holds, if it has rows. Returns status and linear solves."""
    s, w, d, y, integrals, out = r.s, r.w, r.d, r.y, r.integrals, r.out
    parts, ys, tape = out.part, out.y, out.tape
    solves, here = 0, w.travelled[0]
    put(w.V, d.guess_V)
    put(w.u_dot, d.guess)
    put(w.rate, d.guess_rate)
    for i in range(
        last - 1, first - 1, -1
    ):  # the end comes first: the others disturb what the last stage left
        way, scans = GAMMA * h if parts[i] == 1.0 else 0.0, w.travelled[2]
        if parts[i] == 1.0:
            put(y, ys[i])
            put(integrals, d.at_row)
        else:
            b_1, b_2 = dense(parts[i])
            for j in range(y.size):
                ys[i, j] = d.y[j] + h * (b_1 * d.K[0, j] + b_2 * d.K[1, j])
            early = min(parts[i], 1.0 - GAMMA)
            for j in range(integrals.size):
                first_part, second_part = b_1, b_2
                if (
                    j < s.pad_base.size + 2
                ):  # what is dissipated never falls: a stage's power until its weight is used up
                    first_part, second_part = early, parts[i] - early
                d.at_row[j] = d.integrals[j] + h * (
                    first_part * d.powers[0, j] + second_part * d.powers[1, j]
                )
            gone_by = d.travelled[0] + h * (abs(b_1) * d.speed[0] + abs(b_2) * d.speed[1])
            w.travelled[0] = gone_by if scans == d.travelled[2] else np.inf
            converged, count, _ = solve_near(
                s, w, limits, ys[i], out.signals[i], INSTANT, d.scrap, d.wrenches
            )
            solves += count
            if not converged:
                return NEWTON_FAILED, solves
        if tape.count.shape[0] > 0 and not write_tape(s, w, tape, i, ys[i], way):
            return TAPE_FULL, solves
        put(d.at_row, out.integrals[i])
        record(s, w, d.wrenches, out.recorded[i])
        put(w.rate, out.rate[i])
        out.stored[i] = stored(s, w, ys[i])
        put(d.guess_V, w.V)
        put(d.guess, w.u_dot)
        put(d.guess_rate, w.rate)
        w.travelled[0] = here if w.travelled[2] == scans else np.inf
    return CONVERGED, solves
