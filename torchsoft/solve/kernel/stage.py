"""One stage of the implicit step: the rates k that solve k = f(t, y* + a h k), by Newton's method.

Stretches are local, pads are linear, so Newton's unknowns are the forces at the touched nodes, pad by pad, and then the
velocities of the free coordinates.
"""

from typing import Any

import numpy as np

from torchsoft.codegen.invoke import call_linearise, call_value
from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.arrays import Array
from torchsoft.solve.kernel.inertia import base_velocity, inertia_force, solve, stiffness_force
from torchsoft.solve.kernel.interface import assemble, evaluate, frames, linearise, mobility_scale, scan, set_in, displacements
from torchsoft.solve.kernel.linear import solve_dense

SEARCH_AFTER, SHORTEST = 2, 1.0 / 64.0
"""After so many iterations a Newton step that does not lessen the mismatch is halved, down to this part of it."""


@compiled
def drive(bodies: Any, y: Array, q: Array, V: Array, signals: Array, a: float) -> None:
    """All coordinates at the end of the stage: those of the state for the free velocities in V, signals for the others."""
    for c in range(bodies.free.size):
        if bodies.free[c] >= 0:
            q[c] = y[bodies.q_start + bodies.free[c]] + a * V[c]
        elif bodies.signal[c] >= 0:
            q[c], V[c] = signals[bodies.signal[c], 0], signals[bodies.signal[c], 1]


@compiled
def actuate(s: Any, i: int, q: Array, V: Array, signals: Array, x: Array, out: Array, J: Array) -> float:
    """Effort [N or N.m] of actuator i; x receives (setpoint, its rate, feed-forward, measured coordinate, its rate)."""
    act = s.actuators
    m, at, ff = act.measured[i], act.setpoint[i], act.feed_forward[i]
    x[0], x[1], x[2] = signals[at, 0], signals[at, 1], signals[ff, 0] if ff >= 0 else 0.0
    x[3], x[4] = q[m], V[m]
    call_linearise(act.linearise[i], x, s.p[act.p_start[i] : act.p_start[i + 1]], out, J)
    return out[0]


@compiled
def balance(s: Any, w: Any, y: Array, signals: Array, a: float, r: Array, Rv: Array) -> None:
    """Loads less M V' on the free coordinates without contact, r (free,), and their derivative by the velocities, Rv."""
    bodies, act, p = s.bodies, s.actuators, s.p
    Rv[:], r[:] = 0.0, 0.0
    for i in range(bodies.coordinate.size):
        mass = p[bodies.mass_at[i]]
        r[i] = -mass * ((w.V[bodies.coordinate[i]] - y[bodies.V_start + i]) / a + bodies.weight[i] * p[bodies.gravity_at])
        Rv[i, i] = -mass / a  # (17)
    x, out, J = np.empty(5), np.empty(1), np.empty((1, 5))
    for i in range(act.measured.size):
        number, towards = bodies.free[act.pushed[i]], bodies.free[act.measured[i]]
        if number >= 0:
            r[number] += actuate(s, i, w.q, w.V, signals, x, out, J)  # (32), (34)
            if towards >= 0:
                Rv[number, towards] += a * J[0, 3] + J[0, 4]


@compiled
def residual(s: Any, w: Any, pad: int, y: Array, a: float, n: int, r: Array) -> None:
    """Right-hand side of Newton's block in the first column of w.X, and the pad's part in r."""
    pads, contacts, points, free = s.pads, s.contacts, s.points, s.bodies.free
    at, c, first = contacts.point_start[pads.contact_start[pad]], pads.contact_start[pad], pads.node_start[pad]
    inertial = pads.v_start[pad] >= 0
    b = w.X[2 * first : 2 * (first + n)]
    b[:, 0] = 0.0
    vx, vy = base_velocity(s, pad, w.V, w.q)
    for i in range(w.actives[pad]):
        k = w.active[at + i]
        while k >= contacts.point_start[c + 1]:
            c += 1
        dx, dy, H, G, L = 0.0, 0.0, w.H[at + i], w.G[at + i], w.L[at + i]
        for j in range(2):
            node, N = points.node[k, j], points.N[k, j]
            dx += N * (w.free[node, 0] - w.u_dot[node, 0])
            dy += N * (w.free[node, 1] - w.u_dot[node, 1])
            if inertial:
                D = s.inertia.D[s.inertia.dof_start[pad] + s.inertia.surface[2 * node] :]
                dx -= N * (D[0, 0] * vx + D[0, 1] * vy)
                dy -= N * (D[1, 0] * vx + D[1, 1] * vy)
        fx = w.out[k, 0] + H[0, 0] * dx + H[0, 1] * dy
        fy = w.out[k, 1] + H[1, 0] * dx + H[1, 1] * dy
        for j in range(2):
            if points.N[k, j] != 0.0:
                row = 2 * w.slot[points.node[k, j]]
                b[row, 0] += points.N[k, j] * fx
                b[row + 1, 0] += points.N[k, j] * fy
        for row in range(6):
            number = free[contacts.body[c] + row] if row < 3 else free[pads.base[pad] + row - 3]
            if number >= 0:
                r[number] += G[row, 0] * fx + G[row, 1] * fy + a * (L[row, 0] * dx + L[row, 1] * dy)
    if inertial:
        B, base = s.inertia.B[pad], pads.base[pad]
        mx, my = reaction_without_contact(s, w, pad, y, a)
        mx, my = mx + B[0, 0] * vx + B[0, 1] * vy, my + B[1, 0] * vx + B[1, 1] * vy
        cos, sin = np.cos(w.q[base + 2]), np.sin(w.q[base + 2])
        if free[base] >= 0:
            r[free[base]] -= cos * mx - sin * my
        if free[base + 1] >= 0:
            r[free[base + 1]] -= sin * mx + cos * my


@compiled
def reaction_without_contact(s: Any, w: Any, pad: int, y: Array, a: float) -> tuple[float, float]:
    """Sum of M (free - v*)/(a h) of an inertial pad, in the base's axes."""
    first, last = s.inertia.dof_start[pad], s.inertia.dof_start[pad + 1]
    vx, vy = base_velocity(s, pad, w.V, w.q)
    x, z = inertia_force(s, w, pad, y, a, w.full[first:last])
    mass = s.p[s.inertia.material_at[pad] + 3] / a
    for i in range(first, last, 2):
        x -= mass * s.inertia.area[i] * vx
        z -= mass * s.inertia.area[i + 1] * vy
    return x, z


@compiled
def propose(s: Any, w: Any, pad: int, a: float, n: int, columns: int, dV: Array) -> None:
    """Newton's forces and nodal rates for the change of velocity dV; w.V holds the old velocities still."""
    pads, first = s.pads, s.pads.node_start[pad]
    size, scale = 2 * (pads.node_start[pad + 1] - first), mobility_scale(pads, s.p, pad, a)
    C = pads.C[pads.C_start[pad] : pads.C_start[pad] + size * size].reshape(size, size)
    X = w.X[2 * first : 2 * (first + n)]
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            w.F_old[node, r], w.u_dot_old[node, r] = w.F_linear[node, r], w.u_dot[node, r]
            w.F_new[node, r], w.u_dot_new[node, r] = 0.0, w.free[node, r]
    for i in range(n):
        node = w.touched[first + i]
        for r in range(2):
            f = X[2 * i + r, 0]
            for number in range(dV.size):
                if pads.column[pad, number] >= 0:
                    f += X[2 * i + r, columns + pads.column[pad, number]] * dV[number]
            w.F_new[node, r] = f
    low, high = 2 * w.low[pad], 2 * w.high[pad]
    rates = w.u_dot_new.reshape(-1)
    for i in range(n):
        node = w.touched[first + i]
        for r in range(2):
            row, f = C[2 * (node - first) + r], scale * w.F_new[node, r]
            for m in range(low, high):
                rates[m] += row[m - 2 * first] * f
    if pads.v_start[pad] >= 0:
        base, free = pads.base[pad], s.bodies.free
        cos, sin = np.cos(w.q[base + 2]), np.sin(w.q[base + 2])
        Vx = w.V[base] + (dV[free[base]] if free[base] >= 0 else 0.0)
        Vy = w.V[base + 1] + (dV[free[base + 1]] if free[base + 1] >= 0 else 0.0)
        vx, vy = cos * Vx + sin * Vy, cos * Vy - sin * Vx
        for m in range(low, high):
            dof = s.inertia.dof_start[pad] + s.inertia.surface[m]
            rates[m] -= s.inertia.D[dof, 0] * vx + s.inertia.D[dof, 1] * vy


@compiled
def move(w: Any, pad: int, part: float) -> None:
    """Go `part` of the way from the old iterate to the proposed one. Both satisfy the linear relations, so this does."""
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            w.F_linear[node, r] = w.F_old[node, r] + part * (w.F_new[node, r] - w.F_old[node, r])
            w.u_dot[node, r] = w.u_dot_old[node, r] + part * (w.u_dot_new[node, r] - w.u_dot_old[node, r])


@compiled
def solve_stage(
    s: Any, w: Any, y: Array, signals: Array, a: float, tolerance: float, max_iterations: int, margin: float
) -> tuple[bool, int]:
    """Velocities (w.V, on entry the guess), nodal forces and rates at the end of the stage that starts from y.

    Newton ends when the law and the linear relations agree to `tolerance` [N] at every node. Returns success and the number
    of linear solves.
    """
    pads, free = s.pads.base.size, s.bodies.coordinate.size
    drive(s.bodies, y, w.q, w.V, signals, a)
    for pad in range(pads):
        set_in(s, w, pad, y, a)
    if w.travelled[0] > w.travelled[1]:
        scan(s, w, y, margin)
    for pad in range(pads):
        displacements(s, w, pad, y, w.low[pad], w.high[pad])
        w.F_linear[w.low[pad] : w.high[pad]] = 0.0
    V_old, dV = np.empty(w.V.size), np.zeros(free)
    r, Rv, b = np.empty(free), np.empty((free, free)), np.empty((free, 1))
    previous, part, iteration = np.inf, 1.0, 0
    while True:
        frames(s.contacts, s.pads.base, w.q, w.V, w.frame)
        mismatch, squares = 0.0, 0.0
        for pad in range(pads):
            worst, total = evaluate(s, w, pad, y, a)
            mismatch, squares = worst if not worst <= mismatch else mismatch, squares + total
        if iteration > SEARCH_AFTER and not squares < previous and part > SHORTEST:
            part *= 0.5
            for pad in range(pads):
                move(w, pad, part)
            for i in range(free):
                c = s.bodies.coordinate[i]
                w.V[c] = V_old[c] + part * dV[i]
            drive(s.bodies, y, w.q, w.V, signals, a)
            continue
        if iteration > 0 and mismatch <= tolerance:
            return True, iteration
        if not np.isfinite(mismatch) or iteration == max_iterations:
            return False, iteration
        balance(s, w, y, signals, a, r, Rv)
        for pad in range(pads):
            n = 0
            linearise(s, w, pad, a)
            n = assemble(s, w, pad, a, Rv)
            residual(s, w, pad, y, a, n, r)
            first, columns = s.pads.node_start[pad], s.pads.columns[pad]
            X = w.X[2 * first : 2 * (first + n)]
            X[:, 1 : 1 + columns] = w.Hc[: 2 * n, :columns]
            solve_dense(w.A, X, 2 * n, 1 + columns)
            eliminate(s, w, pad, n, 1, X, r.reshape(-1, 1), Rv)
            w.counts[pad] = n
        b[:, 0] = -r
        solve_dense(Rv, b, free, 1)
        dV[:], V_old[:] = b[:, 0], w.V
        for pad in range(pads):
            propose(s, w, pad, a, w.counts[pad], 1, dV)
            move(w, pad, 1.0)
        for i in range(free):
            w.V[s.bodies.coordinate[i]] += dV[i]
        drive(s.bodies, y, w.q, w.V, signals, a)
        previous, part, iteration = squares, 1.0, iteration + 1


@compiled
def eliminate(s: Any, w: Any, pad: int, n: int, m: int, X: Array, r: Array, Rv: Array) -> None:
    """Put the pad's forces X = A^-1 (b | Hc), m right-hand sides, into the bodies' equations r (free, m) and Rv."""
    column = s.pads.column[pad]
    for number in range(column.size):
        if column[number] < 0:
            continue
        line = w.Rf[column[number]]
        for i in range(2 * n):
            for j in range(m):
                r[number, j] += line[i] * X[i, j]
            for other in range(column.size):
                if column[other] >= 0:
                    Rv[number, other] += line[i] * X[i, m + column[other]]


@compiled
def finish(s: Any, w: Any, y: Array, a: float, powers: Array, moments: Array) -> float:
    """All rates of the accepted stage in w.k, what the pads and contacts dissipate in `powers` (pads, dashpots, slip) [W], the
    contacts' generalised forces in w.load, the pads' moments (Eq. 35) [N.m]. Returns a bound of every surface speed [m/s]."""
    pads, contacts, points, p, k = s.pads, s.contacts, s.points, s.p, w.k
    count, fastest = pads.base.size, 0.0
    powers[: count + 2] = 0.0
    w.load[:] = 0.0
    out = np.empty(3)
    for pad in range(count):
        at, c = contacts.point_start[pads.contact_start[pad]], pads.contact_start[pad]
        first, last, start = pads.node_start[pad], pads.node_start[pad + 1], pads.y_start[pad]
        linearise(s, w, pad, a)
        moments[pad] = 0.0
        for i in range(w.actives[pad]):
            n = w.active[at + i]
            while n >= contacts.point_start[c + 1]:
                c += 1
            fx, fy = w.out[n, 0], w.out[n, 1]
            moments[pad] += points.X[n, 0] * fy - points.X[n, 1] * fx
            for row in range(6):
                coordinate = contacts.body[c] + row if row < 3 else pads.base[pad] + row - 3
                w.load[coordinate] += w.G[at + i, row, 0] * fx + w.G[at + i, row, 1] * fy
            powers[count] += w.out[n, 5]
            powers[count + 1] += w.out[n, 6]
        i = 0
        for c in range(pads.contact_start[pad], pads.contact_start[pad + 1]):
            own = p[contacts.p_start[c] : contacts.p_start[c + 1]]
            for n in range(contacts.point_start[c], contacts.point_start[c + 1]):
                j = points.y_start + n
                if i < w.actives[pad] and w.active[at + i] == n:
                    k[j] = w.out[n, 2]
                    i += 1
                elif y[j] != 0.0:  # away from contact the stretch decays through the slip element
                    w.x[n, 6], w.x[n, 7], w.x[n, 8] = y[j], points.weight[n], a
                    call_value(contacts.free[c], w.x[n, 6:], own, out)
                    k[j] = out[0]
                    powers[count] += out[1]
                    powers[count + 1] += out[2]
                else:
                    k[j] = 0.0
        if pads.v_start[pad] >= 0:
            fastest = max(fastest, finish_inertial(s, w, pad, y, a, powers, moments))
            continue
        chain, branches, size = pads.chain_at[pad], pads.branches[pad], 2 * (last - first)
        C = pads.C[pads.C_start[pad] : pads.C_start[pad] + size * size].reshape(size, size)
        F, total = w.F_linear.reshape(-1), 0.0
        for b in range(branches):
            J, tau, z = p[chain + b], p[chain + branches + b], start + b * size
            low, high = size, 0
            for m in range(size):
                loaded = 2 * w.low[pad] <= 2 * first + m < 2 * w.high[pad]
                rate = ((F[2 * first + m] if loaded else 0.0) - y[z + m]) / (tau + a)
                k[z + m] = rate
                if abs(rate) * a > NEGLIGIBLE_RATE:
                    low, high = min(low, m), m + 1
                    total += J * abs(rate)
            power = 0.0
            for m in range(low, high):
                row, u = C[m], 0.0
                for other in range(low, high):
                    u += row[other] * k[z + other]
                power += k[z + m] * u
            powers[pad] += J * tau * power
        fastest = max(fastest, total * pads.reach[pad])
    for i in range(s.bodies.coordinate.size):
        c = s.bodies.coordinate[i]
        k[s.bodies.q_start + i] = w.V[c]
        k[s.bodies.V_start + i] = (w.V[c] - y[s.bodies.V_start + i]) / a
    bound = 0.0
    for c in range(contacts.pad.size):
        f, C_ = w.frame[c], contacts.body[c]
        arm = abs(f[2]) + abs(f[3]) + contacts.size[c]
        speed = np.hypot(f[4], f[5]) + abs(w.V[C_ + 2]) * contacts.size[c] + abs(f[6]) * arm
        bound = max(bound, speed)
    return bound + fastest


NEGLIGIBLE_RATE = 1e-16
"""Change of a nodal force in a stage [N] that counts as none."""


@compiled
def finish_inertial(s: Any, w: Any, pad: int, y: Array, a: float, powers: Array, moments: Array) -> float:
    """Rates of an inertial pad, its part in powers, load and moment; returns its largest nodal rate [m/s]."""
    inertia, pads, p = s.inertia, s.pads, s.p
    first, last = inertia.dof_start[pad], inertia.dof_start[pad + 1]
    base, at = pads.base[pad], inertia.material_at[pad]
    vx, vy = base_velocity(s, pad, w.V, w.q)
    extra, effort = np.zeros(last - first), np.empty(last - first)
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            extra[inertia.surface[2 * node + r]] = w.F_linear[node, r]
    forces = extra.copy()
    for i in range(last - first):
        extra[i] -= p[at + 3] * inertia.area[first + i] / a * (vx if i % 2 == 0 else vy)
    solve(inertia, pad, extra)
    fastest = 0.0
    rates = w.full[first:last]
    for i in range(last - first):
        rates[i] += extra[i]
        w.k[pads.y_start[pad] + i] = rates[i]
        speed = rates[i] + (vx if i % 2 == 0 else vy)
        w.k[pads.v_start[pad] + i] = (speed - y[pads.v_start[pad] + i]) / a
        fastest = max(fastest, abs(rates[i]))
    stiffness = np.empty(last - first)
    stiffness_force(inertia, p, pad, rates, stiffness)
    for i in range(0, last - first):
        powers[pad] += p[at + 2] * rates[i] * stiffness[i]
        effort[i] = forces[i] - p[at + 3] * inertia.area[first + i] * w.k[pads.v_start[pad] + i]
    moments[pad] = 0.0
    for i in range(0, last - first, 2):
        moments[pad] += inertia.X[first + i] * effort[i + 1] - inertia.X[first + i + 1] * effort[i]
    mx, my = inertia_force(s, w, pad, y, a, rates)
    cos, sin = np.cos(w.q[base + 2]), np.sin(w.q[base + 2])
    w.load[base] -= cos * mx - sin * my
    w.load[base + 1] -= sin * mx + cos * my
    return fastest * 1.5
