"""The transposed stage: the discrete adjoint of `kernels.run.run`, massless pads.

A stage's relations, with u' = (C f - u*) / (tau + a h) for the pads, f = law(w, omega, d, theta, s*) at each touching
node, s = s* + a h s', and the rigid balance M (V - V*) / (a h) = F(q, V, f), are differentiated as they stand (implicit
function theorem). Bars are cotangents: `u_bar` of the displacements at the end of the stage, and so on. The multipliers are
mu (per touching node, of the law) and nu (5, of the rigid balance); both come from the transpose of Newton's system.
"""

from typing import Any, NamedTuple

import numpy as np

from torchsoft.kernels import compiled
from torchsoft.kernels.linear import solve_dense
from torchsoft.kernels.node import Array, contact_node
from torchsoft.kernels.run import GAMMA


class Bars(NamedTuple):
    """Cotangents of one state: u (dofs of both pads), s (surface of both), q (5), V (5)."""

    u: Array
    s: Array
    q: Array
    V: Array


class Multipliers(NamedTuple):
    """What the parameter gradient needs of every stage: mu (., 2, cap, 2) [1/N], a h s_bar of the touching nodes
    (., 2, cap), and nu (., 5)."""

    mu: Array
    s_bar: Array
    nu: Array


class PadGradients(NamedTuple):
    """Sums over stages: cotangents of the compliances C (surface dofs x dofs, transposed), of tau, and of the decay
    rate of stretches away from contact."""

    C_L: Array
    C_U: Array
    tau: Array
    decay: Array


@compiled
def stage_adjoint(
    pads: Any, h: float, c: Any, tape: Any, row: int, bars: Any, decay_rate: float, out: Any, gradients: Any,
    nodes: Any, A: Array, b: Array,
) -> None:  # fmt: skip
    """Turn the cotangents `bars` of a stage's end into those of its y*, in place; add to `out` and `gradients`.

    `nodes` is scratch: per pad the Jacobians (surface, 3, 7); A and b hold the dense system, per pad.
    """
    ah = GAMMA * h
    stiff = c.tau + ah
    q, V = tape.q_star[row], tape.V[row]
    theta = q[2] + ah * V[2]
    discard = np.empty(10)
    rigid = np.zeros((5, 6))  # rigid[:, 0] + rigid[:, 1:] nu = 0
    for r, mass in enumerate((c.m_C, c.m_C, c.I_C, c.m_Br, c.m_Br)):
        rigid[r, 0] = bars.V[r] + ah * bars.q[r]
        rigid[r, 1 + r] = -mass / ah
    rigid[c.sensed, 4] -= c.K_81 * ah + c.R_80
    rigid[4, 5] -= c.K_98 * ah + c.R_99

    first_dof, first_node = 0, 0
    for p in range(2):
        pad, n = pads[p], tape.count[row, p]
        u_bar = bars.u[first_dof : first_dof + pad.P.shape[1]]
        side = 1.0 if pad.moving_base else 0.0
        for k in range(n):
            i = tape.node[row, p, k]
            d, w = tape.place[row, p, k, :2], tape.place[row, p, k, 2:4]
            contact_node(
                d[0], d[1], w[0], w[1], V[2], theta, tape.place[row, p, k, 4], pad.share[i], ah, c, nodes[p, k], discard
            )
        for k in range(n):  # (I + P G^T) mu = b0 + b1 nu
            j, force, d = tape.node[row, p, k], tape.force[row, p], tape.place[row, p, k]
            for axis in range(2):
                P, line = pad.P[2 * pad.surface[j] + axis], 2 * k + axis
                total = 0.0
                for dof in range(u_bar.size):
                    total += P[dof] * u_bar[dof]
                constant, turn = ah * total, 0.0
                for m in range(n):
                    i = pad.surface[tape.node[row, p, m]]
                    J, Px, Py = nodes[p, m], P[2 * i], P[2 * i + 1]
                    s_bar = ah * bars.s[first_node + tape.node[row, p, m]]
                    for col in range(2):
                        A[p, line, 2 * m + col] = Px * (J[col, 0] - ah * J[col, 3]) + Py * (J[col, 1] - ah * J[col, 4])
                    constant -= s_bar * (Px * (J[2, 0] - ah * J[2, 3]) + Py * (J[2, 1] - ah * J[2, 4]))
                    turn -= ah * (Px * force[m, 1] - Py * force[m, 0])
                A[p, line, line] += 1.0
                b[p, line, 0] = constant
                b[p, line, 1:] = 0.0
                b[p, line, 1 + axis] = -1.0
                b[p, line, 3] = turn + (d[1] if axis == 0 else -d[0])
                b[p, line, 4 + axis] = side
        solve_dense(A[p], b[p], 2 * n, 6)
        for k in range(n):
            J, f = nodes[p, k], tape.force[row, p, k]
            s_bar = ah * bars.s[first_node + tape.node[row, p, k]]
            for col in range(6):
                mx, my = b[p, 2 * k, col], b[p, 2 * k + 1, col]
                wx = (J[0, 0] - ah * J[0, 3]) * mx + (J[1, 0] - ah * J[1, 3]) * my
                wy = (J[0, 1] - ah * J[0, 4]) * mx + (J[1, 1] - ah * J[1, 4]) * my
                om = (J[0, 2] + ah * J[0, 5]) * mx + (J[1, 2] + ah * J[1, 5]) * my
                if col == 0:
                    wx += s_bar * (J[2, 0] - ah * J[2, 3])
                    wy += s_bar * (J[2, 1] - ah * J[2, 4])
                    om += s_bar * (J[2, 2] + ah * J[2, 5])
                elif col == 3:
                    wx += ah * f[1]
                    wy -= ah * f[0]
                rigid[0, col] += wx
                rigid[1, col] += wy
                rigid[2, col] += om
                rigid[3, col] -= side * wx
                rigid[4, col] -= side * wy
        first_dof += u_bar.size
        first_node += pad.surface.size
    nu = -rigid[:, :1].copy()
    solve_dense(rigid[:, 1:].copy(), nu, 5, 1)
    out.nu[row] = nu[:, 0]

    first_dof, first_node = 0, 0
    for p in range(2):
        pad, n, C_bar = pads[p], tape.count[row, p], gradients.C_L if p == 0 else gradients.C_U
        u_bar = bars.u[first_dof : first_dof + pad.P.shape[1]]
        s_bar_all = bars.s[first_node : first_node + pad.surface.size]
        u_dot = tape.u_dot[row, first_dof : first_dof + pad.P.shape[1]]
        zeta = ah * u_bar  # cotangent of u'
        k = 0
        for i in range(pad.surface.size):
            if k < n and tape.node[row, p, k] == i:
                J, f, s_bar = nodes[p, k], tape.force[row, p, k], ah * s_bar_all[i]
                mx, my = b[p, 2 * k, 0], b[p, 2 * k + 1, 0]
                for col in range(5):
                    mx += b[p, 2 * k, 1 + col] * nu[col, 0]
                    my += b[p, 2 * k + 1, 1 + col] * nu[col, 0]
                out.mu[row, p, k, 0], out.mu[row, p, k, 1], out.s_bar[row, p, k] = mx, my, s_bar
                back = np.empty(7)
                for col in range(7):
                    back[col] = J[0, col] * mx + J[1, col] * my + J[2, col] * s_bar
                dx, dy = back[3] - nu[2, 0] * f[1], back[4] + nu[2, 0] * f[0]
                zeta[2 * pad.surface[i]] -= back[0] - ah * dx
                zeta[2 * pad.surface[i] + 1] -= back[1] - ah * dy
                u_bar[2 * pad.surface[i]] += dx
                u_bar[2 * pad.surface[i] + 1] += dy
                bars.q[0] -= dx
                bars.q[1] -= dy
                bars.q[2] += back[5]
                if pad.moving_base:
                    bars.q[3] += dx
                    bars.q[4] += dy
                s_bar_all[i] += back[6]
                k += 1
            else:
                gradients.decay[0] -= ah * s_bar_all[i] * tape.s_star[row, first_node + i]
                s_bar_all[i] *= 1.0 - ah * decay_rate
        zeta /= stiff
        for k in range(n):
            j = pad.surface[tape.node[row, p, k]]
            for axis in range(2):
                f = tape.force[row, p, k, axis]
                C = C_bar[2 * j + axis]
                for dof in range(zeta.size):
                    C[dof] += zeta[dof] * f
        for dof in range(zeta.size):
            gradients.tau[0] -= zeta[dof] * u_dot[dof]
            u_bar[dof] -= zeta[dof]
        first_dof += u_bar.size
        first_node += pad.surface.size
    bars.q[c.sensed] -= c.K_81 * nu[3, 0]
    bars.q[4] -= c.K_98 * nu[4, 0]
    for r, mass in enumerate((c.m_C, c.m_C, c.I_C, c.m_Br, c.m_Br)):
        bars.V[r] = mass * nu[r, 0] / ah


@compiled
def backward(
    pads: Any,
    h: float,
    c: Any,
    tape: Any,
    keep: Any,
    y_bars: Array,
    bars: Any,
    decay_rate: float,
    out: Any,
    gradients: Any,
) -> int:
    """Sweep the steps of a tape backwards; `bars` goes from the end's cotangents to the start's, in place.

    y_bars (outputs, size) are added at the steps that `keep` marks, laid out as u, s, q, V. Returns -1, or the step at
    which a cotangent stopped being finite.
    """
    cap = tape.node.shape[2]
    nodes = np.empty((2, cap, 3, 7))
    A, b = np.empty((2, 2 * cap, 2 * cap)), np.empty((2, 2 * cap, 6))
    mix = (1.0 - GAMMA) / GAMMA  # y* of stage 2 is (1 - mix) y + mix Y_1
    output = len(y_bars)
    n_u, n_s = bars.u.size, bars.s.size
    u, s, q, V = np.empty(n_u), np.empty(n_s), np.empty(5), np.empty(5)
    for step in range(len(keep) - 1, -1, -1):
        if keep[step]:
            output -= 1
            y_bar = y_bars[output]
            bars.u[:] += y_bar[:n_u]
            bars.s[:] += y_bar[n_u : n_u + n_s]
            bars.q[:] += y_bar[n_u + n_s : n_u + n_s + 5]
            bars.V[:] += y_bar[n_u + n_s + 5 :]
        stage_adjoint(pads, h, c, tape, 2 * step + 1, bars, decay_rate, out, gradients, nodes, A, b)
        u[:], s[:], q[:], V[:] = (1.0 - mix) * bars.u, (1.0 - mix) * bars.s, (1.0 - mix) * bars.q, (1.0 - mix) * bars.V
        bars.u[:] *= mix
        bars.s[:] *= mix
        bars.q[:] *= mix
        bars.V[:] *= mix
        stage_adjoint(pads, h, c, tape, 2 * step, bars, decay_rate, out, gradients, nodes, A, b)
        bars.u[:] += u
        bars.s[:] += s
        bars.q[:] += q
        bars.V[:] += V
        if not np.isfinite(bars.V.sum()) or not np.isfinite(bars.q.sum()):
            return step
    return -1
