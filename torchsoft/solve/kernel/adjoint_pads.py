"""Cotangents of the pads in the transposed stage: from those of their states to those of the touched nodes' forces, and on to
those of the stage's start and of the material. The names are those of `adjoint`.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.arrays import Array
from torchsoft.solve.kernel.inertia import base_velocity, solve, stiffness_force
from torchsoft.solve.kernel.interface import NEGLIGIBLE
from torchsoft.solve.kernel.linear import put, row_of


@compiled
def nodal_cotangent(
    s: Any, w: Any, z: Any, pad: int, y_bar: Array, a: float, n: int, X: Array, full: Array, V_bar: Array
) -> None:
    """F_bar of the touched nodes into X[:, 0], from the cotangents of the pad's state and of the touching points' stretches."""
    free = s.body_free
    first, at = s.pad_node_start[pad], s.contact_point_start[s.pad_contact_start[pad]]
    c, b = s.pad_contact_start[pad], z.surface[0, : 2 * n]
    b[:] = 0.0
    for i in range(w.actives[pad]):
        k = w.active[at + i]
        while k >= s.contact_point_start[c + 1]:
            c += 1
        s_bar = a * y_bar[s.point_y_start + k]
        for j in range(2):
            if s.point_N[k, j] != 0.0:
                row = 2 * w.slot[s.point_node[k, j]]
                b[row] += s.point_N[k, j] * w.H[at + i, 2, 0] * s_bar
                b[row + 1] += s.point_N[k, j] * w.H[at + i, 2, 1] * s_bar
        for row in range(6):
            number = free[s.contact_body[c] + row] if row < 3 else free[s.pad_base[pad] + row - 3]
            if number >= 0:
                V_bar[number] += w.H[at + i, 2, 2 + row] * s_bar
    if s.pad_v_start[pad] >= 0:
        i0, i1 = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1]
        u_bar, v_bar = y_bar[s.pad_y_start[pad] :], y_bar[s.pad_v_start[pad] :]
        own = full[i0:i1]
        for i in range(i1 - i0):
            own[i] = a * u_bar[i] + v_bar[i]
        for i in range(n):
            for r in range(2):
                own[s.inertia_surface[2 * w.touched[first + i] + r]] += b[2 * i + r]
        base = s.pad_base[pad]
        cos, sin = np.cos(w.q[base + 2]), np.sin(w.q[base + 2])
        x_bar = y_axis = 0.0
        for i in range(i1 - i0):
            x_bar -= s.inertia_D[i0 + i, 0] * own[i]
            y_axis -= s.inertia_D[i0 + i, 1] * own[i]
            if i % 2 == 0:
                x_bar += v_bar[i]
            else:
                y_axis += v_bar[i]
        if free[base] >= 0:
            V_bar[free[base]] += cos * x_bar - sin * y_axis
        if free[base + 1] >= 0:
            V_bar[free[base + 1]] += sin * x_bar + cos * y_axis
        rates = z.dofs[0, i0:i1]
        put(own, rates)
        solve(s, pad, rates)
        for i in range(n):
            for r in range(2):
                X[2 * i + r, 0] = rates[s.inertia_surface[2 * w.touched[first + i] + r]]
        return
    size, chain, branches = 2 * (s.pad_node_start[pad + 1] - first), s.pad_chain_at[pad], s.pad_branches[pad]
    for i in range(n):
        for r in range(2):
            dof, total = 2 * (w.touched[first + i] - first) + r, 0.0
            for m in range(2 * n):
                total += w.P[2 * i + r, m] * b[m]
            for branch in range(branches):
                total += a * y_bar[s.pad_y_start[pad] + branch * size + dof] / (s.p[chain + branches + branch] + a)
            X[2 * i + r, 0] = total


@compiled
def pad_state(
    s: Any,
    w: Any,
    scratch: Any,
    pad: int,
    y: Array,
    y_bar: Array,
    a: float,
    rate_bar: Array,
    u_bar: Array,
    p_bar: Array,
) -> None:
    """Cotangents of a massless pad's state at the stage's start, and of its material, from those of its nodal rates and
    displacements (nodes, 2)."""
    p, first, last, start = s.p, s.pad_node_start[pad], s.pad_node_start[pad + 1], s.pad_y_start[pad]
    size, chain, branches = 2 * (last - first), s.pad_chain_at[pad], s.pad_branches[pad]
    start_C, material, F = s.pad_C_start[pad], chain + 2 * branches, w.F.reshape(w.F.size)
    by_rate, by_u, zeta, z_dot = scratch.surface[0], scratch.surface[1], scratch.surface[2], scratch.surface[3]
    scratch.surface[:, :size] = 0.0
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            c, d = rate_bar[node, r], u_bar[node, r]
            if c != 0.0 or d != 0.0:
                row = row_of(s.pad_C, start_C, 2 * (node - first) + r, size)
                for m in range(size):
                    by_rate[m] += row[m] * c
                    by_u[m] += row[m] * d
    scale_bar, left, right = 0.0, size, 0
    for b in range(branches):
        J, rest, z = p[chain + b], p[chain + branches + b] + a, start + b * size
        J_bar = tau_bar = 0.0
        for m in range(size):
            loaded = 2 * w.low[pad] <= 2 * first + m < 2 * w.high[pad]
            total = (a * y_bar[z + m] + J * by_rate[m]) / rest
            if loaded or abs(y[z + m]) > NEGLIGIBLE:
                rate = ((F[2 * first + m] if loaded else 0.0) - y[z + m]) / rest
                left, right = min(left, m), m + 1 if m + 1 > right else right
                zeta[m] += J * y[z + m]
                z_dot[m] += J * rate
                J_bar += by_rate[m] * rate + by_u[m] * y[z + m]
                tau_bar -= total * rate
            y_bar[z + m] += J * by_u[m] - total
        p_bar[chain + b] += J_bar
        p_bar[chain + branches + b] += tau_bar
        scale_bar += J * J_bar
    p_bar[material] += scale_bar / p[material]
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            c, d = rate_bar[node, r], u_bar[node, r]
            if c != 0.0 or d != 0.0:
                row, by_nu = row_of(s.pad_dC, start_C, 2 * (node - first) + r, size), 0.0
                for m in range(left, right):
                    by_nu += row[m] * (c * z_dot[m] + d * zeta[m])
                p_bar[material + 1] += by_nu


@compiled
def inertial_state(
    s: Any, w: Any, z: Any, pad: int, y: Array, y_bar: Array, a: float, rate: Array, full: Array, rate_bar: Array,
    u_bar: Array, nu: Array, V_bar: Array, p_bar: Array,
) -> None:  # fmt: skip
    """The same for an inertial pad; `rate` is its taped u', `full` what `nodal_cotangent` left, V_bar of all coordinates."""
    free, at = s.body_free, s.inertia_material_at[pad]
    i0, i1, base = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1], s.pad_base[pad]
    U, W, mass = s.pad_y_start[pad], s.pad_v_start[pad], s.p[s.inertia_material_at[pad] + 3]
    cos, sin = np.cos(w.q[base + 2]), np.sin(w.q[base + 2])
    nx = nu[free[base], 0] if free[base] >= 0 else 0.0
    ny = nu[free[base + 1], 0] if free[base + 1] >= 0 else 0.0
    own, strain, force, back = z.dofs[0, i0:i1], z.dofs[1, i0:i1], z.dofs[2, i0:i1], z.dofs[3, i0:i1]  # own: of u'
    reaction, local = z.pair[0], z.pair[1]
    reaction[0], reaction[1] = -(cos * nx + sin * ny), -(cos * ny - sin * nx)
    for i in range(i1 - i0):
        own[i] = a * y_bar[U + i] + y_bar[W + i] + mass * s.inertia_area[i0 + i] / a * reaction[i % 2]
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            own[s.inertia_surface[2 * node + r]] += rate_bar[node, r]
    solve(s, pad, own)  # now the multiplier of the pad's equation
    vx, vy = base_velocity(s, pad, w.V, w.q)
    here = rate[i0:i1]
    stiffness_force(s, pad, here, force)
    stiffness_force(s, pad, own, back)
    for i in range(i1 - i0):
        v = vx if i % 2 == 0 else vy
        M = s.inertia_area[i0 + i] / a
        change = here[i] + v - y[W + i]
        p_bar[at + 2] -= own[i] * force[i]
        p_bar[at + 3] += M * change * (reaction[i % 2] - own[i])
        strain[i] = y[U + i] + (s.p[at + 2] + a) * here[i]
    for k in range(i1 - i0):
        for j in range(s.inertia_K_column.shape[1]):
            product = own[k] * strain[s.inertia_K_column[i0 + k, j]]
            p_bar[at] -= s.inertia_K_lambda[i0 + k, j] * product
            p_bar[at + 1] -= s.inertia_K_mu[i0 + k, j] * product
    local[:] = 0.0
    for i in range(i1 - i0):
        local[i % 2] += y_bar[W + i] + mass * s.inertia_area[i0 + i] / a * (reaction[i % 2] - own[i])
        y_bar[U + i] -= back[i]
        y_bar[W + i] = mass * s.inertia_area[i0 + i] / a * (own[i] - reaction[i % 2])
    V_bar[base] += cos * local[0] - sin * local[1]
    V_bar[base + 1] += sin * local[0] + cos * local[1]
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            y_bar[U + s.inertia_surface[2 * node + r]] += u_bar[node, r]
