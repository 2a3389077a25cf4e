"""One stage of the implicit step as a compiled kernel.

A stage of a diagonally implicit Runge-Kutta method solves k = f(t, y* + a h k) for the rates k. Three things keep it small:

- stretches are local (see `kernels.node`);
- pads are linear: the stage's nodal velocities are `free + P f - D dV`, P being the pad's mobility at this a h and dV
  the bracket's change of velocity;
- only touching nodes carry force, so Newton's system is one dense block per pad, and then five rigid velocities.

The rigid velocities are V = (v_C, omega, v_Br) and the poses q = (r_C, theta, r_Br), five each.
"""

from typing import Any

import numpy as np

from torchsoft.kernels import compiled
from torchsoft.kernels.linear import solve_dense
from torchsoft.kernels.node import Array, contact_node, tangential
from torchsoft.kernels.pad import free_rates, full_rates, lever, near

SEARCH_AFTER, SHORTEST = 2, 1.0 / 64.0
"""After so many iterations a Newton step that does not lessen the mismatch is halved, down to this part of it."""


@compiled
def evaluate_window(
    pad: Any, state: Any, work: Any, count: int, q: Array, V: Array, ah: float, c: Any
) -> tuple[int, float, float]:
    """Contact law on the window; returns the number of touching nodes (in `work.active`) and the mismatch between the law
    and the forces that the linear relations were solved with: the largest [N], and the sum of squares [N2]."""
    theta = q[2] + ah * V[2]
    place, out, J = np.empty(4), np.empty(10), np.empty((3, 7))
    active, mismatch, squares = 0, 0.0, 0.0
    for k in range(count):
        i = work.window[k]
        lever(pad, state, work, q, V, ah, i, place)
        work.f[i, 0], work.f[i, 1] = 0.0, 0.0
        touches = contact_node(
            place[0], place[1], place[2], place[3], V[2], theta, state.s[i], pad.share[i], ah, c, J, out
        )
        if touches:
            for r in range(2):  # lever and angle move with w and omega over a h
                work.G[i, r, 0] = J[r, 0] - ah * J[r, 3]
                work.G[i, r, 1] = J[r, 1] - ah * J[r, 4]
                work.G[i, r, 2] = J[r, 2] + ah * J[r, 5]
            work.d[i, 0], work.d[i, 1], work.w[i, 0], work.w[i, 1] = place
            work.f[i, 0], work.f[i, 1] = out[0], out[1]
            work.active[active] = i
            active += 1
        for r in range(2):
            off = work.f[i, r] - work.f_linear[i, r]
            mismatch = max(mismatch, abs(off))
            squares += off * off
    return active, mismatch, squares


@compiled
def eliminate_pad(pad: Any, work: Any, active: int, V: Array, V_star: Array, rigid: Array, ah: float) -> None:
    """Newton's forces as f = rhs[:, 0] + rhs[:, 1:] V, and their part in the rigid equations `rigid` (5, 6).

    Rows of `rigid` are the equations of disc, spin and bracket; column 0 the constant, columns 1-5 the velocities.
    """
    A, b = work.system, work.rhs
    for k in range(active):
        i = work.active[k]
        ni = pad.surface[i]
        for r in range(2):
            row = 2 * k + r
            g0, g1, g2 = work.G[i, r, 0], work.G[i, r, 1], work.G[i, r, 2]
            for m in range(active):
                j = work.active[m]
                for col in range(2):
                    P = pad.P[2 * j + col]
                    A[row, 2 * m + col] = g0 * P[2 * ni] + g1 * P[2 * ni + 1]
            A[row, row] += 1.0
            b[row, 1], b[row, 2], b[row, 3], b[row, 4], b[row, 5] = g0, g1, g2, 0.0, 0.0
            drift0, drift1 = work.w[i, 0] + work.free[2 * ni], work.w[i, 1] + work.free[2 * ni + 1]
            if pad.moving_base:
                D = pad.D[2 * ni : 2 * ni + 2]
                b[row, 4] = g0 * (D[0, 0] - 1.0) + g1 * D[1, 0]
                b[row, 5] = g0 * D[0, 1] + g1 * (D[1, 1] - 1.0)
                drift0 += D[0, 0] * V_star[3] + D[0, 1] * V_star[4]
                drift1 += D[1, 0] * V_star[3] + D[1, 1] * V_star[4]
            b[row, 0] = work.f[i, r] - g0 * drift0 - g1 * drift1 - g2 * V[2]
    solve_dense(A, b, 2 * active, 6)
    for k in range(active):
        i = work.active[k]
        ni = pad.surface[i]
        fx, fy = work.f[i]
        dx, dy = work.d[i]
        for col in range(6):
            px, py = b[2 * k, col], b[2 * k + 1, col]
            rigid[0, col] -= px  # (16), (19)
            rigid[1, col] -= py
            # torque -d x f (18), with d = d_k - a h (w - w_k)
            wx = wy = 0.0
            for m in range(active):
                j = work.active[m]
                for s in range(2):
                    wx -= pad.P[2 * j + s, 2 * ni] * b[2 * m + s, col]
                    wy -= pad.P[2 * j + s, 2 * ni + 1] * b[2 * m + s, col]
            if col == 0:
                wx -= work.free[2 * ni] + work.w[i, 0]
                wy -= work.free[2 * ni + 1] + work.w[i, 1]
            elif col == 1:
                wx += 1.0
            elif col == 2:
                wy += 1.0
            if pad.moving_base:
                D = pad.D[2 * ni : 2 * ni + 2]
                if col == 0:
                    wx -= D[0, 0] * V_star[3] + D[0, 1] * V_star[4]
                    wy -= D[1, 0] * V_star[3] + D[1, 1] * V_star[4]
                elif col >= 4:
                    wx += D[0, col - 4] - (1.0 if col == 4 else 0.0)
                    wy += D[1, col - 4] - (1.0 if col == 5 else 0.0)
                rigid[3, col] += (1.0 - D[0, 0]) * px - D[1, 0] * py
                rigid[4, col] += (1.0 - D[1, 1]) * py - D[0, 1] * px
            rigid[2, col] -= dx * py - dy * px - ah * (wx * fy - wy * fx)


@compiled
def propose(pad: Any, work: Any, count: int, active: int, V_star: Array, V_new: Array) -> None:
    """Newton's forces and window velocities for the rigid velocities V_new; the present ones become the old ones."""
    for k in range(count):
        i = work.window[k]
        n = pad.surface[i]
        for r in range(2):
            work.f_old[i, r], work.v_old[i, r] = work.f_linear[i, r], work.u_dot[2 * n + r]
            work.f_new[i, r] = 0.0
    for k in range(active):
        i = work.active[k]
        for r in range(2):
            f = work.rhs[2 * k + r, 0]
            for col in range(5):
                f += work.rhs[2 * k + r, 1 + col] * V_new[col]
            work.f_new[i, r] = f
    for k in range(count):
        n = pad.surface[work.window[k]]
        for r in range(2):
            row = 2 * n + r
            v = work.free[row]
            for m in range(active):
                j = work.active[m]
                v += pad.P[2 * j, row] * work.f_new[j, 0] + pad.P[2 * j + 1, row] * work.f_new[j, 1]
            if pad.moving_base:
                v -= pad.D[row, 0] * (V_new[3] - V_star[3]) + pad.D[row, 1] * (V_new[4] - V_star[4])
            work.v_new[work.window[k], r] = v


@compiled
def move(pad: Any, work: Any, count: int, part: float) -> None:
    """Go `part` of the way from the old iterate to the proposed one. Both satisfy the linear relations, so this does."""
    for k in range(count):
        i = work.window[k]
        n = pad.surface[i]
        for r in range(2):
            work.f_linear[i, r] = work.f_old[i, r] + part * (work.f_new[i, r] - work.f_old[i, r])
            work.u_dot[2 * n + r] = work.v_old[i, r] + part * (work.v_new[i, r] - work.v_old[i, r])


@compiled
def inertial_reaction(pad: Any, state: Any, work: Any, V_star: Array, ah: float, rigid: Array) -> None:
    """What the upper pad's own inertia adds to the bracket's equations."""
    for i in range(pad.M.size):
        r = i % 2
        rigid[3 + r, 0] -= pad.M[i] / ah * (work.free[i] + V_star[3 + r] - state.v[i])
    for r in range(2):
        for col in range(2):
            rigid[3 + r, 4 + col] -= pad.B[r, col]
            rigid[3 + r, 0] += pad.B[r, col] * V_star[3 + col]


@compiled
def solve_stage(
    pads: Any, states: Any, works: Any, q: Array, V_star: Array, V: Array, want: Array, ah: float, c: Any,
    tolerance: float, max_iterations: int, margin: float,
) -> tuple[bool, int]:  # fmt: skip
    """Velocities at the end of one stage: V (on entry the guess), nodal rates and touching nodes in `works`.

    q and V_star are the stage's y*; `want` is the set-point (x_d, x_d', y_d, y_d', F_y). Newton ends when the law and the
    linear relations agree to `tolerance` [N] at every node. Returns success and the number of linear solves.
    """
    counts, actives = np.zeros(2, np.int64), np.zeros(2, np.int64)
    rigid = np.empty((5, 6))
    A, b = np.empty((5, 5)), np.empty((5, 1))
    V_new, V_old = np.empty(5), np.empty(5)
    found = np.empty(max(pads[0].surface.size, pads[1].surface.size), np.int64)
    for p in range(2):
        free_rates(pads[p], states[p], works[p], V_star[3:], ah, c.tau)
        counts[p] = near(pads[p], states[p], works[p], q, V, ah, c, margin, works[p].window)
        works[p].f_linear[:] = 0.0
    previous, part, iteration = np.inf, 1.0, 0
    while True:
        mismatch, squares = 0.0, 0.0
        for p in range(2):
            actives[p], worst, total = evaluate_window(pads[p], states[p], works[p], counts[p], q, V, ah, c)
            mismatch, squares = max(mismatch, worst), squares + total
        if iteration > SEARCH_AFTER and squares >= previous and part > SHORTEST:
            part *= 0.5
            for p in range(2):
                move(pads[p], works[p], counts[p], part)
            V[:] = V_old + part * (V_new - V_old)
            continue
        if iteration > 0 and mismatch <= tolerance:
            missed = False
            for p in range(2):  # a node outside the window may touch after all
                full_rates(pads[p], works[p], counts[p], V, V_star)
                missed |= near(pads[p], states[p], works[p], q, V, ah, c, 0.0, found) > actives[p]
            if not missed:
                for p in range(2):
                    works[p].active[actives[p] :] = -1
                return True, iteration
            for p in range(2):
                counts[p] = near(pads[p], states[p], works[p], q, V, ah, c, margin, works[p].window)
        if not np.isfinite(mismatch) or iteration == max_iterations:
            return False, iteration

        # rigid equations: rigid[:, 0] + rigid[:, 1:] V = 0, first without contact
        rigid[:] = 0.0
        for r, mass in enumerate((c.m_C, c.m_C, c.I_C, c.m_Br, c.m_Br)):
            rigid[r, 0] = mass * V_star[r] / ah
            rigid[r, 1 + r] = -mass / ah
        rigid[1, 0] -= c.m_C * c.gravity  # (17)
        rigid[3, 0] += c.K_81 * (want[0] - q[c.sensed]) + c.R_80 * want[1]  # (34)
        rigid[3, 1 + c.sensed] -= c.K_81 * ah + c.R_80
        rigid[4, 0] += c.K_98 * (want[2] - q[4]) + c.R_99 * want[3] + want[4]  # (32)
        rigid[4, 5] -= c.K_98 * ah + c.R_99
        if pads[1].M.size > 0:
            inertial_reaction(pads[1], states[1], works[1], V_star, ah, rigid)
        for p in range(2):
            eliminate_pad(pads[p], works[p], actives[p], V, V_star, rigid, ah)
        for r in range(5):
            b[r, 0] = -rigid[r, 0]
            for col in range(5):
                A[r, col] = rigid[r, 1 + col]
        solve_dense(A, b, 5, 1)
        V_old[:], V_new[:] = V, b[:, 0]
        for p in range(2):
            propose(pads[p], works[p], counts[p], actives[p], V_star, V_new)
            move(pads[p], works[p], counts[p], 1.0)
        V[:] = V_new
        previous, part, iteration = squares, 1.0, iteration + 1


@compiled
def finish_pad(
    pad: Any, state: Any, work: Any, q: Array, V: Array, ah: float, c: Any, powers: Array, index: int
) -> float:  # fmt: skip
    """All rates of a pad from the accepted velocities, its forces, and its part in `powers` [W].

    Returns the moment of the pad's effort about its base's origin [N.m], sum of X x e: what Eq. 35 sums at the bonded
    nodes, because a rigid rotation of the undeformed pad costs no effort.
    """
    theta = q[2] + ah * V[2]
    place, out, J = np.empty(4), np.empty(10), np.empty((3, 7))
    work.forces[:] = 0.0
    work.s_dot[:] = 0.0
    work.Ku_dot[:] = 0.0
    k = 0
    for i in range(state.s.size):
        share = pad.share[i]
        if k < work.active.size and work.active[k] == i:
            k += 1
            lever(pad, state, work, q, V, ah, i, place)
            contact_node(place[0], place[1], place[2], place[3], V[2], theta, state.s[i], share, ah, c, J, out)
            F_N, F_T, e, gamma_dot, rho, g, g_dot, v_T = out[2:]
            work.s_dot[i] = rho * v_T - gamma_dot
            work.forces[i, 0], work.forces[i, 1] = F_N, F_T
            powers[2] += (F_N - share * c.K_n * g) * g_dot
            n = pad.surface[i]
            work.Ku_dot[2 * n], work.Ku_dot[2 * n + 1] = work.f_linear[i]
        elif state.s[i] != 0.0:  # away from contact the stretch decays through the slip element
            e, gamma_dot, _, _, _, _ = tangential(
                state.s[i], 0.0, 0.0, share * (c.R_t + ah * c.K_t), share * c.K_t, share, c
            )
            work.s_dot[i] = -gamma_dot
        else:
            continue
        powers[2] += share * c.R_t * work.s_dot[i] ** 2
        powers[3] += e * gamma_dot

    moment = 0.0
    inertial = pad.M.size > 0
    for i in range(state.u.size):
        effort = work.Ku_dot[i]  # of the Kelvin-Voigt field: the contact force less the node's inertia
        n, r = i // 2, i % 2
        if inertial:
            base = V[3 + r] if pad.moving_base else 0.0
            work.v_dot[i] = (work.u_dot[i] + base - state.v[i]) / ah
            effort -= pad.M[i] * work.v_dot[i]
        moment += (pad.X[n, 0] if r == 1 else -pad.X[n, 1]) * effort
        work.Ku_dot[i] = (effort - state.Ku[i]) / (c.tau + ah)
        powers[index] += c.tau * work.u_dot[i] * work.Ku_dot[i]
    return moment
