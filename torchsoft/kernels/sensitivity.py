"""The tangent stage: forward sensitivities of `kernels.run.run` for several parameters at once, massless pads.

The relations that `kernels.adjoint` transposes are differentiated here along parameter directions: one factorisation of
Newton's system a stage, as many right-hand sides as there are directions. A `d` before a name is its derivative; the last
axis counts directions.
"""

from typing import Any, NamedTuple

import numpy as np

from torchsoft.kernels import compiled
from torchsoft.kernels.linear import solve_dense
from torchsoft.kernels.node import Array, contact_node
from torchsoft.kernels.run import GAMMA


class Tangent(NamedTuple):
    """Derivative of one state: u (dofs of both pads, n), s (surface of both, n), q (5, n), V (5, n)."""

    u: Array
    s: Array
    q: Array
    V: Array


class Explicit(NamedTuple):
    """Derivatives of the laws along the directions, with everything they act on held.

    law (stages, 2, cap, 3, n): of f_x, f_y, s' at the touching nodes; load (stages, 5, n): of F - M V' in the rigid
    balance; C_L, C_U (surface dofs, dofs), transposed, of the compliances along direction number `nu` (none if negative);
    softening (n), of log C where that is one number; tau (n) [s]; decay (n), of the rate r of free stretches.
    """

    law: Array
    load: Array
    C_L: Array
    C_U: Array
    nu: int
    softening: Array
    tau: Array
    decay: Array


@compiled
def stage_tangent(
    pads: Any, h: float, c: Any, tape: Any, row: int, x: Any, explicit: Any, decay_rate: float, nodes: Any, A: Array, b: Array
) -> None:  # fmt: skip
    """Turn the tangent `x` of a stage's y* into that of its end, in place. `nodes`, A and b are scratch, per pad."""
    ah = GAMMA * h
    stiff = c.tau + ah
    n_dir = x.q.shape[1]
    q, V = tape.q_star[row], tape.V[row]
    theta = q[2] + ah * V[2]
    discard = np.empty(10)
    rigid = np.zeros((5, 5 + n_dir))  # rigid[:, :5] dV + rigid[:, 5:] = 0
    for r, mass in enumerate((c.m_C, c.m_C, c.I_C, c.m_Br, c.m_Br)):
        rigid[r, r] = -mass / ah
        for k in range(n_dir):
            rigid[r, 5 + k] = mass / ah * x.V[r, k] + explicit.load[row, r, k]
    rigid[3, c.sensed] -= c.K_81 * ah + c.R_80
    rigid[4, 4] -= c.K_98 * ah + c.R_99
    for k in range(n_dir):
        rigid[3, 5 + k] -= c.K_81 * x.q[c.sensed, k]
        rigid[4, 5 + k] -= c.K_98 * x.q[4, k]

    du_dots = np.empty_like(x.u)
    first_dof, first_node = 0, 0
    for p in range(2):
        pad, n, C = pads[p], tape.count[row, p], explicit.C_L if p == 0 else explicit.C_U
        side, dofs = 1.0 if pad.moving_base else 0.0, pad.P.shape[1]
        du = x.u[first_dof : first_dof + dofs]
        free = du_dots[first_dof : first_dof + dofs]  # of u', before the forces' own change
        for dof in range(dofs):
            u_dot = tape.u_dot[row, first_dof + dof]
            for k in range(n_dir):
                free[dof, k] = -(du[dof, k] + u_dot * explicit.tau[k]) / stiff
        if explicit.nu >= 0:
            for m in range(n):
                j = pad.surface[tape.node[row, p, m]]
                for axis in range(2):
                    f = tape.force[row, p, m, axis] / stiff
                    for dof in range(dofs):
                        free[dof, explicit.nu] += C[2 * j + axis, dof] * f
        for m in range(n):
            i = tape.node[row, p, m]
            place = tape.place[row, p, m]
            contact_node(
                place[0], place[1], place[2], place[3], V[2], theta, place[4], pad.share[i], ah, c, nodes[p, m], discard
            )
        for m in range(n):  # (I + G P) df = columns of dV, then of the directions
            i, J = pad.surface[tape.node[row, p, m]], nodes[p, m]
            node = first_node + tape.node[row, p, m]
            for axis in range(2):
                line = 2 * m + axis
                gx, gy = J[axis, 0] - ah * J[axis, 3], J[axis, 1] - ah * J[axis, 4]
                for k in range(n):
                    j = pad.surface[tape.node[row, p, k]]
                    for col in range(2):
                        P = pad.P[2 * j + col]
                        A[p, line, 2 * k + col] = gx * P[2 * i] + gy * P[2 * i + 1]
                A[p, line, line] += 1.0
                b[p, line, 0], b[p, line, 1] = gx, gy
                b[p, line, 2] = J[axis, 2] + ah * J[axis, 5]
                b[p, line, 3], b[p, line, 4] = -side * gx, -side * gy
                softer = 0.0  # the change of G w if C grew by its own size
                for k in range(n):
                    j = pad.surface[tape.node[row, p, k]]
                    for col in range(2):
                        P = pad.P[2 * j + col]
                        softer += (gx * P[2 * i] + gy * P[2 * i + 1]) * tape.force[row, p, k, col]
                for k in range(n_dir):
                    dx = du[2 * i, k] + side * x.q[3, k] - x.q[0, k]
                    dy = du[2 * i + 1, k] + side * x.q[4, k] - x.q[1, k]
                    b[p, line, 5 + k] = (
                        explicit.law[row, p, m, axis, k]
                        - gx * free[2 * i, k]
                        - gy * free[2 * i + 1, k]
                        - softer * explicit.softening[k]
                        + J[axis, 3] * dx
                        + J[axis, 4] * dy
                        + J[axis, 5] * x.q[2, k]
                        + J[axis, 6] * x.s[node, k]
                    )
        solve_dense(A[p], b[p], 2 * n, 5 + n_dir)
        for m in range(n):
            i = pad.surface[tape.node[row, p, m]]
            f, d = tape.force[row, p, m], tape.place[row, p, m]
            for col in range(5 + n_dir):
                px, py = b[p, 2 * m, col], b[p, 2 * m + 1, col]
                wx = wy = dx = dy = 0.0
                for k in range(n):
                    j = pad.surface[tape.node[row, p, k]]
                    for axis in range(2):
                        force = b[p, 2 * k + axis, col]
                        if col >= 5:
                            force += explicit.softening[col - 5] * tape.force[row, p, k, axis]
                        wx -= pad.P[2 * j + axis, 2 * i] * force
                        wy -= pad.P[2 * j + axis, 2 * i + 1] * force
                if col == 0:
                    wx += 1.0
                elif col == 1:
                    wy += 1.0
                elif col == 3:
                    wx -= side
                elif col == 4:
                    wy -= side
                elif col >= 5:
                    wx -= free[2 * i, col - 5]
                    wy -= free[2 * i + 1, col - 5]
                    dx = du[2 * i, col - 5] + side * x.q[3, col - 5] - x.q[0, col - 5]
                    dy = du[2 * i + 1, col - 5] + side * x.q[4, col - 5] - x.q[1, col - 5]
                dx, dy = dx - ah * wx, dy - ah * wy
                rigid[0, col] -= px
                rigid[1, col] -= py
                rigid[2, col] -= d[0] * py - d[1] * px + dx * f[1] - dy * f[0]
                rigid[3, col] += side * px
                rigid[4, col] += side * py
        first_dof += dofs
        first_node += pad.surface.size
    dV = -rigid[:, 5:].copy()
    solve_dense(rigid[:, :5].copy(), dV, 5, n_dir)

    first_dof, first_node = 0, 0
    for p in range(2):
        pad, n = pads[p], tape.count[row, p]
        side, dofs = 1.0 if pad.moving_base else 0.0, pad.P.shape[1]
        du, du_dot = x.u[first_dof : first_dof + dofs], du_dots[first_dof : first_dof + dofs]
        df, P = np.empty((2 * n, n_dir)), np.empty((2 * n, dofs))
        for m in range(n):
            j = pad.surface[tape.node[row, p, m]]
            for axis in range(2):
                line = 2 * m + axis
                P[line] = pad.P[2 * j + axis]
                for k in range(n_dir):
                    df[line, k] = b[p, line, 5 + k] + explicit.softening[k] * tape.force[row, p, m, axis]
                    for r in range(5):
                        df[line, k] += b[p, line, r] * dV[r, k]
        if n > 0:
            du_dot += np.dot(P.T, df)
        m = 0
        for i in range(pad.surface.size):
            node = first_node + i
            if m < n and tape.node[row, p, m] == i:
                J, dof = nodes[p, m], 2 * pad.surface[i]
                for k in range(n_dir):
                    wx = dV[0, k] - side * dV[3, k] - du_dot[dof, k]
                    wy = dV[1, k] - side * dV[4, k] - du_dot[dof + 1, k]
                    dx = du[dof, k] + side * x.q[3, k] - x.q[0, k] - ah * wx
                    dy = du[dof + 1, k] + side * x.q[4, k] - x.q[1, k] - ah * wy
                    x.s[node, k] += ah * (
                        explicit.law[row, p, m, 2, k]
                        + J[2, 0] * wx
                        + J[2, 1] * wy
                        + J[2, 2] * dV[2, k]
                        + J[2, 3] * dx
                        + J[2, 4] * dy
                        + J[2, 5] * (x.q[2, k] + ah * dV[2, k])
                        + J[2, 6] * x.s[node, k]
                    )
                m += 1
            else:
                s_star = tape.s_star[row, node]
                for k in range(n_dir):
                    x.s[node, k] -= ah * (decay_rate * x.s[node, k] + explicit.decay[k] * s_star)
        du += ah * du_dot
        first_dof += dofs
        first_node += pad.surface.size
    x.q[:] += ah * dV
    x.V[:] = dV


@compiled
def forward(
    pads: Any, h: float, c: Any, tape: Any, keep: Any, x: Any, explicit: Any, decay_rate: float, dys: Array
) -> None:
    """Carry the tangent x through the steps of a tape, in place; after the steps that `keep` marks it goes to dys, whole or,
    where dys (outputs, 10, n) has no room for more, only q and V."""
    cap, n_dir = tape.node.shape[2], x.q.shape[1]
    nodes = np.empty((2, cap, 3, 7))
    A, b = np.empty((2, 2 * cap, 2 * cap)), np.empty((2, 2 * cap, 5 + n_dir))
    mix = (1.0 - GAMMA) / GAMMA
    row, n_u, n_s = 0, x.u.shape[0], x.s.shape[0]
    for step in range(len(keep)):
        u, s, q, V = x.u.copy(), x.s.copy(), x.q.copy(), x.V.copy()
        stage_tangent(pads, h, c, tape, 2 * step, x, explicit, decay_rate, nodes, A, b)
        x.u[:] = u + mix * (x.u - u)
        x.s[:] = s + mix * (x.s - s)
        x.q[:] = q + mix * (x.q - q)
        x.V[:] = V + mix * (x.V - V)
        stage_tangent(pads, h, c, tape, 2 * step + 1, x, explicit, decay_rate, nodes, A, b)
        if keep[step]:
            rigid = dys.shape[1] - 10
            if rigid > 0:
                dys[row, :n_u] = x.u
                dys[row, n_u : n_u + n_s] = x.s
            dys[row, rigid : rigid + 5] = x.q
            dys[row, rigid + 5 :] = x.V
            row += 1
