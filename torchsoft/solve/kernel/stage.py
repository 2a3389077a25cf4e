"""One stage of the implicit step: the rates k that solve k = f(t, y* + a h k), by Newton's method.

Stretches are local, pads are linear, so Newton's unknowns are the forces at the touched nodes, pad
by pad, and then the velocities of the free coordinates.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.arrays import STEPPED
from torchsoft.solve.kernel.inertia import (
    base_velocity,
    inertia_force,
    solve,
    stiffness_force,
    to_base,
    to_world,
)
from torchsoft.solve.kernel.interface import (
    assemble,
    branch_rate,
    displacements,
    evaluate,
    frames,
    linearise,
    mobility_scale,
    scan,
    set_in,
    softness,
)
from torchsoft.solve.kernel.invoke import call_linearise, call_value
from torchsoft.solve.kernel.linear import add, bounds, dot, put, row_of, solve_dense
from torchsoft.solve.kernel.table import Array

SEARCH_AFTER, SHORTEST = 2, 2.0**-10
"""After so many iterations a Newton step that does not lessen the mismatch is halved, down to this
part of it; before, one whose mismatch is not a number."""

ROUNDED = 10.0
"""Mismatch, in tolerances, that is accepted where rounding stops Newton's iteration: no shorter
step lessens it."""


@compiled
def drive(s: Any, w: Any, y: Array, signals: Array, a: float) -> None:
    """All coordinates at the end of the stage: those of the state for the free velocities in V,
    signals for the others."""
    q, V = w.q, w.V
    for c in range(s.body_free.size):
        if s.body_free[c] >= 0:
            q[c] = y[s.body_q_start + s.body_free[c]] + a * V[c]
        elif s.body_signal[c] >= 0:
            q[c], V[c] = signals[s.body_signal[c], 0], signals[s.body_signal[c], 1]


@compiled
def actuate(
    s: Any, i: int, q: Array, V: Array, signals: Array, x: Array, out: Array, J: Array
) -> float:
    """Effort [N or N.m] of actuator i; x receives (set-points and their rates, feed-forward,
    coordinates and their rates)."""
    ff, n = s.act_feed_forward[i], 0
    for k in range(s.act_setpoint_start[i], s.act_setpoint_start[i + 1]):
        x[n], x[n + 1] = signals[s.act_setpoint[k], 0], signals[s.act_setpoint[k], 1]
        n += 2
    x[n] = signals[ff, 0] if ff >= 0 else 0.0
    for k in range(s.act_measured_start[i], s.act_measured_start[i + 1]):
        x[n + 1], x[n + 2] = q[s.act_measured[k]], V[s.act_measured[k]]
        n += 2
    call_linearise(s.act_linearise[i], x, s.p[bounds(s.act_p_start, i)], out, J)
    return out[0]


@compiled
def coordinates_at(s: Any, i: int) -> int:
    """Index of the first coordinate among the inputs of actuator i."""
    return 2 * (s.act_setpoint_start[i + 1] - s.act_setpoint_start[i]) + 1


@compiled
def by_velocities(s: Any, i: int, J: Array, a: float, row: Array) -> None:
    """Add the derivative of actuator i's effort by the free velocities (free,), which move
    coordinates by a."""
    n = coordinates_at(s, i)
    for k in range(s.act_measured_start[i], s.act_measured_start[i + 1]):
        towards = s.body_free[s.act_measured[k]]
        if towards >= 0:
            row[towards] += a * J[0, n] + J[0, n + 1]
        n += 2


@compiled
def balance(s: Any, w: Any, y: Array, signals: Array, a: float, r: Array, Rv: Array) -> None:
    """Loads less M V' on the free coordinates without contact, r (free, 1), and their derivative by
    the velocities, Rv."""
    p = s.p
    Rv[:], r[:] = 0.0, 0.0
    for i in range(s.body_coordinate.size):
        mass = p[s.body_mass_at[i]]
        r[i, 0] = -mass * (
            (w.V[s.body_coordinate[i]] - y[s.body_V_start + i]) / a
            + s.body_weight[i] * p[s.body_gravity_at]
        )
        Rv[i, i] = -mass / a  # (17)
    for i in range(s.act_pushed.size):
        number = s.body_free[s.act_pushed[i]]
        if number >= 0:
            r[number, 0] += actuate(
                s, i, w.q, w.V, signals, w.effort_x, w.effort, w.effort_J
            )  # (32), (34)
            by_velocities(s, i, w.effort_J, a, Rv[number])


@compiled
def residual(s: Any, w: Any, pad: int, y: Array, a: float, n: int, r: Array) -> None:
    """Right-hand side of Newton's block in the first column of w.X, and the pad's part in r."""
    free = s.body_free
    at, first = s.pad_point_start[pad], s.pad_node_start[pad]
    inertial = s.pad_v_start[pad] >= 0
    b = w.X[2 * first : 2 * (first + n)]
    b[:, 0] = 0.0
    vx, vy = base_velocity(s, w, pad)
    for i in range(w.actives[pad]):
        k = w.active[at + i]
        c = s.point_contact[k]
        dx, dy, H, G, L = 0.0, 0.0, w.H[at + i], w.G[at + i], w.L[at + i]
        for j in range(2):
            node, N = s.point_node[k, j], s.point_N[k, j]
            dx += N * (w.free[node, 0] - w.u_dot[node, 0])
            dy += N * (w.free[node, 1] - w.u_dot[node, 1])
            if inertial:
                D = s.inertia_D[s.inertia_dof_start[pad] + s.inertia_surface[2 * node] :]
                dx -= N * (D[0, 0] * vx + D[0, 1] * vy)
                dy -= N * (D[1, 0] * vx + D[1, 1] * vy)
        fx = w.out[k, 0] + H[0, 0] * dx + H[0, 1] * dy
        fy = w.out[k, 1] + H[1, 0] * dx + H[1, 1] * dy
        for j in range(2):
            if s.point_N[k, j] != 0.0:
                row = 2 * w.slot[s.point_node[k, j]]
                b[row, 0] += s.point_N[k, j] * fx
                b[row + 1, 0] += s.point_N[k, j] * fy
        for row in range(6):
            number = s.contact_number[c, row]
            if number >= 0:
                r[number, 0] += (
                    G[row, 0] * fx + G[row, 1] * fy + a * (L[row, 0] * dx + L[row, 1] * dy)
                )
    if inertial:
        B, base = s.inertia_B[pad], s.pad_base[pad]
        mx, my = reaction_without_contact(s, w, pad, y, a)
        mx, my = mx + B[0, 0] * vx + B[0, 1] * vy, my + B[1, 0] * vx + B[1, 1] * vy
        X, Y = to_world(s, w, pad, mx, my)
        if free[base] >= 0:
            r[free[base], 0] -= X
        if free[base + 1] >= 0:
            r[free[base + 1], 0] -= Y


@compiled
def reaction_without_contact(s: Any, w: Any, pad: int, y: Array, a: float) -> tuple[float, float]:
    """Sum of M (free - v*)/(a h) of an inertial pad, in the base's axes."""
    first, last = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1]
    vx, vy = base_velocity(s, w, pad)
    x, z = inertia_force(s, w, pad, y, a, w.full[first:last])
    mass = s.p[s.inertia_material_at[pad] + 3] / a
    for i in range(first, last, 2):
        x -= mass * s.inertia_area[i] * vx
        z -= mass * s.inertia_area[i + 1] * vy
    return x, z


@compiled
def propose(s: Any, w: Any, pad: int, a: float, n: int, columns: int, dV: Array) -> None:
    """Newton's forces and nodal rates for the change of velocity dV; w.V holds the old velocities
    still."""
    first = s.pad_node_start[pad]
    size, scale = 2 * (s.pad_node_start[pad + 1] - first), mobility_scale(s, pad, a)
    X = w.X[2 * first : 2 * (first + n)]
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            w.F_old[node, r], w.u_dot_old[node, r] = w.F_linear[node, r], w.u_dot[node, r]
            w.F_new[node, r], w.u_dot_new[2 * node + r] = 0.0, w.free[node, r]
    for i in range(n):
        node = w.touched[first + i]
        for r in range(2):
            f = X[2 * i + r, 0]
            for number in range(dV.size):
                if s.pad_column[pad, number] >= 0:
                    f += X[2 * i + r, columns + s.pad_column[pad, number]] * dV[number]
            w.F_new[node, r] = f
    low, high = 2 * w.low[pad], 2 * w.high[pad]
    rates = w.u_dot_new[low:high]
    for i in range(n):
        node = w.touched[first + i]
        for r in range(2):
            f = scale * w.F_new[node, r]
            row = row_of(s.pad_C, s.pad_C_start[pad], 2 * (node - first) + r, size)
            add(f, row[low - 2 * first :], rates)
    if s.pad_v_start[pad] >= 0:
        base, free = s.pad_base[pad], s.body_free
        Vx = w.V[base] + (dV[free[base]] if free[base] >= 0 else 0.0)
        Vy = w.V[base + 1] + (dV[free[base + 1]] if free[base + 1] >= 0 else 0.0)
        vx, vy = to_base(s, w, pad, Vx, Vy)
        for m in range(low, high):
            dof = s.inertia_dof_start[pad] + s.inertia_surface[m]
            rates[m - low] -= s.inertia_D[dof, 0] * vx + s.inertia_D[dof, 1] * vy


@compiled
def move(w: Any, pad: int, part: float) -> None:
    """Go `part` of the way from the old iterate to the proposed one. Both satisfy the linear
    relations, so this does."""
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            w.F_linear[node, r] = w.F_old[node, r] + part * (w.F_new[node, r] - w.F_old[node, r])
            w.u_dot[node, r] = w.u_dot_old[node, r] + part * (
                w.u_dot_new[2 * node + r] - w.u_dot_old[node, r]
            )


@compiled
def solve_stage(
    s: Any, w: Any, limits: Any, y: Array, signals: Array, a: float, margin: float
) -> tuple[bool, int]:
    """Velocities (w.V, on entry the guess), nodal forces and rates at the end of the stage that
    starts from y.

    Newton ends when the law and the linear relations agree to the tolerance at every node. Returns
    success and the number of linear solves.
    """
    pads, free = s.pad_base.size, s.body_coordinate.size
    drive(s, w, y, signals, a)
    for pad in range(pads):
        set_in(s, w, pad, y, a)
    if w.travelled[0] > w.travelled[1]:
        scan(s, w, y, margin)
    for pad in range(pads):
        displacements(s, w, pad, y, w.low[pad], w.high[pad])
        w.F_linear[w.low[pad] : w.high[pad]] = 0.0
    V_old, dV, r, Rv, b = w.V_old, w.dV, w.r, w.Rv, w.b
    previous, part, iteration = np.inf, 1.0, 0
    while True:
        frames(s, w)
        mismatch, squares = 0.0, 0.0
        for pad in range(pads):
            worst, total = evaluate(s, w, pad, y, a)
            mismatch, squares = worst if not worst <= mismatch else mismatch, squares + total
        most = previous if iteration > SEARCH_AFTER else np.inf
        stuck = iteration > 0 and not squares < most
        if stuck and part > SHORTEST:
            part *= 0.5
            for pad in range(pads):
                move(w, pad, part)
            for i in range(free):
                c = s.body_coordinate[i]
                w.V[c] = V_old[c] + part * dV[i]
            drive(s, w, y, signals, a)
            continue
        if iteration > 0 and mismatch <= limits.tolerance:
            return True, iteration
        rounded = mismatch <= ROUNDED * limits.tolerance
        if not np.isfinite(mismatch) or iteration == limits.max_iterations or (stuck and rounded):
            return rounded, iteration
        balance(s, w, y, signals, a, r, Rv)
        for pad in range(pads):
            n = 0
            linearise(s, w, pad, a, STEPPED)
            n = assemble(s, w, pad, a, Rv)
            residual(s, w, pad, y, a, n, r)
            first, columns = s.pad_node_start[pad], s.pad_columns[pad]
            X = w.X[2 * first : 2 * (first + n)]
            for i in range(2 * n):
                for j in range(columns):
                    X[i, 1 + j] = w.Hc[i, j]
            solve_dense(w.A, X, 2 * n, 1 + columns)
            eliminate(s, w, pad, n, 1, X, r, Rv)
            w.counts[pad] = n
        for i in range(free):
            b[i, 0] = -r[i, 0]
        solve_dense(Rv, b, free, 1)
        for i in range(free):
            dV[i] = b[i, 0]
        put(w.V, V_old)
        for pad in range(pads):
            propose(s, w, pad, a, w.counts[pad], 1, dV)
            move(w, pad, 1.0)
        for i in range(free):
            w.V[s.body_coordinate[i]] += dV[i]
        drive(s, w, y, signals, a)
        previous, part, iteration = squares, 1.0, iteration + 1


@compiled
def eliminate(s: Any, w: Any, pad: int, n: int, m: int, X: Array, r: Array, Rv: Array) -> None:
    """Put the pad's forces X = A^-1 (b | Hc), m right-hand sides, into the bodies' equations r
    (free, m) and Rv."""
    column = s.pad_column[pad]
    for number in range(column.size):
        if column[number] < 0:
            continue
        line = w.Rf[column[number]]
        for i in range(2 * n):
            add(line[i], X[i], r[number, :m])
            for other in range(column.size):
                if column[other] >= 0:
                    Rv[number, other] += line[i] * X[i, m + column[other]]


NEGLIGIBLE_RATE = 1e-16
"""Change of a nodal force in a stage [N] that counts as none."""


@compiled
def finish(s: Any, w: Any, y: Array, a: float, powers: Array, wrenches: Array) -> float:
    """All rates of the accepted stage in w.k, what the pads and contacts dissipate in `powers`
    (pads, dashpots, slip) [W], the contacts' generalised forces in w.load, the force on every pad
    [N] and its moment (Eq. 35) [N.m] in its base's axes. Returns a bound of every surface speed
    [m/s]."""
    p, k = s.p, w.k
    count, fastest = s.pad_base.size, 0.0
    powers[: count + 2] = 0.0
    w.load[:] = 0.0
    out = w.decay
    for pad in range(count):
        at = s.pad_point_start[pad]
        first, last, start = s.pad_node_start[pad], s.pad_node_start[pad + 1], s.pad_y_start[pad]
        wrench = wrenches[pad]
        wrench[:] = 0.0
        for i in range(w.actives[pad]):
            n = w.active[at + i]
            c = s.point_contact[n]
            fx, fy = w.out[n, 0], w.out[n, 1]
            wrench[0] += fx
            wrench[1] += fy
            wrench[2] += s.point_X[n, 0] * fy - s.point_X[n, 1] * fx
            frame, x, body, base = w.frame[c], w.x[n], s.contact_body[c], s.pad_base[pad]
            X, Y = frame[0] * fx - frame[1] * fy, frame[1] * fx + frame[0] * fy
            w.load[body] -= X
            w.load[body + 1] -= Y
            w.load[body + 2] -= x[3] * fy - x[4] * fx
            w.load[base] += X
            w.load[base + 1] += Y
            w.load[base + 2] += (x[3] + frame[2]) * fy - (x[4] + frame[3]) * fx
            powers[count] += w.out[n, 5]
            powers[count + 1] += w.out[n, 6]
        i = 0
        for n in range(at, s.pad_point_start[pad + 1]):
            j = s.point_y_start + n
            if i < w.actives[pad] and w.active[at + i] == n:
                k[j] = w.out[n, 2]
                i += 1
            elif y[j] != 0.0:  # away from contact the stretch decays through the slip element
                c = s.point_contact[n]
                w.x[n, 6], w.x[n, 7], w.x[n, 8] = y[j], s.point_weight[n], a
                call_value(s.contact_free[c], w.x[n, 6:], p[bounds(s.contact_p_start, c)], out)
                k[j] = out[0]
                powers[count] += out[1]
                powers[count + 1] += out[2]
            else:
                k[j] = 0.0
        if s.pad_v_start[pad] >= 0:
            fastest = max(fastest, finish_inertial(s, w, pad, y, a, powers, wrenches))
            continue
        chain, branches, size = s.pad_chain_at[pad], s.pad_branches[pad], 2 * (last - first)
        total = 0.0
        for b in range(branches):
            J, tau, z = p[chain + b], p[chain + branches + b], start + b * size
            low, high = size, 0
            for m in range(size):
                rate = branch_rate(s, w, pad, b, m, w.F_linear, y, a)
                k[z + m] = rate
                if abs(rate) * a > NEGLIGIBLE_RATE:
                    low, high = min(low, m), m + 1
                    total += J * abs(rate)
            power, changes = 0.0, k[z + low : z + high]
            for m in range(changes.size):
                row = row_of(s.pad_C, s.pad_C_start[pad], low + m, size)
                power += changes[m] * dot(changes, row[low:])
            powers[pad] += J * tau * power * softness(s, pad)
        fastest = max(fastest, total * s.pad_reach[pad] * softness(s, pad))
    for i in range(s.body_coordinate.size):
        c = s.body_coordinate[i]
        k[s.body_q_start + i] = w.V[c]
        k[s.body_V_start + i] = (w.V[c] - y[s.body_V_start + i]) / a
    bound = 0.0
    for c in range(s.contact_pad.size):
        f, C_ = w.frame[c], s.contact_body[c]
        arm = abs(f[2]) + abs(f[3]) + s.contact_size[c]
        speed = np.hypot(f[4], f[5]) + abs(w.V[C_ + 2]) * s.contact_size[c] + abs(f[6]) * arm
        bound = max(bound, speed)
    return bound + fastest


@compiled
def finish_inertial(
    s: Any, w: Any, pad: int, y: Array, a: float, powers: Array, wrenches: Array
) -> float:
    """Rates of an inertial pad, its part in powers, load and force; returns its largest nodal rate
    [m/s]."""
    p = s.p
    first, last = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1]
    base, at = s.pad_base[pad], s.inertia_material_at[pad]
    vx, vy = base_velocity(s, w, pad)
    extra, effort, forces, stiffness = (
        w.inertial[0, first:last], w.inertial[1, first:last], w.inertial[2, first:last],
        w.inertial[3, first:last]
    )  # fmt: skip
    extra[:] = 0.0
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            extra[s.inertia_surface[2 * node + r]] = w.F_linear[node, r]
    put(extra, forces)
    for i in range(last - first):
        extra[i] -= p[at + 3] * s.inertia_area[first + i] / a * (vx if i % 2 == 0 else vy)
    solve(s, pad, extra)
    fastest = 0.0
    rates = w.full[first:last]
    for i in range(last - first):
        rates[i] += extra[i]
        w.k[s.pad_y_start[pad] + i] = rates[i]
        speed = rates[i] + (vx if i % 2 == 0 else vy)
        w.k[s.pad_v_start[pad] + i] = (speed - y[s.pad_v_start[pad] + i]) / a
        fastest = max(fastest, abs(rates[i]))
    stiffness_force(s, pad, rates, stiffness)
    for i in range(0, last - first):
        powers[pad] += p[at + 2] * rates[i] * stiffness[i]
        effort[i] = forces[i] - p[at + 3] * s.inertia_area[first + i] * w.k[s.pad_v_start[pad] + i]
    wrenches[pad] = 0.0
    for i in range(last - first):
        wrenches[pad, i % 2] += effort[i]
    mx, my = inertia_force(s, w, pad, y, a, rates)
    X, Y = to_world(s, w, pad, mx, my)
    w.load[base] -= X
    w.load[base + 1] -= Y
    return fastest * 1.5
