"""Inertial pads inside the kernels: M (u' + V_B - v*)/(a h) + K (u* + (tau + a h) u') = F on all
nodes that move.

Their bases translate only. With A = M/(a h) + (tau + a h) K the nodal rates are u' = free + A^-1 F
- D V_B, D = A^-1 M 1/(a h), and the base feels -sum of M v'.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.linear import solve_banded
from torchsoft.solve.kernel.table import Array


@compiled
def add_stiffness(s: Any, pad: int, lame: Array, u: Array, out: Array) -> None:
    """Add (lambda K_lambda + mu K_mu) u to out, (dofs,) both, of depth times the Lame moduli."""
    first = s.inertia_dof_start[pad]
    for i in range(u.size):
        total = 0.0
        for k in range(s.inertia_K_column.shape[1]):
            stiffness = (
                lame[0] * s.inertia_K_lambda[first + i, k] + lame[1] * s.inertia_K_mu[first + i, k]
            )
            total += stiffness * u[s.inertia_K_column[first + i, k]]
        out[i] += total


@compiled
def stiffness_force(s: Any, pad: int, u: Array, out: Array) -> None:
    """K u, (dofs,) both."""
    out[:] = 0.0
    add_stiffness(s, pad, s.p[s.inertia_material_at[pad] :], u, out)


@compiled
def pull_stiffness(s: Any, pad: int, u: Array, out_bar: Array, p_bar: Array) -> None:
    """Add to p_bar the cotangents of a pad's moduli in K u, from out_bar, (dofs,) both."""
    at, first = s.inertia_material_at[pad], s.inertia_dof_start[pad]
    for i in range(u.size):
        for k in range(s.inertia_K_column.shape[1]):
            product = out_bar[i] * u[s.inertia_K_column[first + i, k]]
            p_bar[at] += s.inertia_K_lambda[first + i, k] * product
            p_bar[at + 1] += s.inertia_K_mu[first + i, k] * product


@compiled
def elastic_wrench(s: Any, w: Any, pad: int, y: Array, wrench: Array) -> None:
    """Force and moment in a pad, sums of K (u + tau u') at the state y with the rates in w.k: in a
    stage of no length F - M v' would be rounding."""
    first, last, U = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1], s.pad_y_start[pad]
    strain, force = w.inertial[0, first:last], w.inertial[1, first:last]
    for i in range(last - first):
        strain[i] = y[U + i] + s.p[s.inertia_material_at[pad] + 2] * w.k[U + i]
    stiffness_force(s, pad, strain, force)
    wrench[:] = 0.0
    for i in range(0, last - first, 2):
        wrench[0] += force[i]
        wrench[1] += force[i + 1]
        wrench[2] += s.inertia_X[first + i] * force[i + 1] - s.inertia_X[first + i + 1] * force[i]


@compiled
def solve(s: Any, pad: int, b: Array) -> None:
    """A^-1 b in place."""
    first, last = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1]
    solve_banded(s.inertia_factor[: s.inertia_band[pad], first:last], b)


@compiled
def free_rates(s: Any, w: Any, pad: int, y: Array, a: float) -> None:
    """A^-1 (M v*/(a h) - K u*) of one pad into its part of w.full."""
    first, last = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1]
    free, mass, v_start = (
        w.full[first:last],
        s.p[s.inertia_material_at[pad] + 3],
        s.pad_v_start[pad],
    )
    u_start = s.pad_y_start[pad]
    stiffness_force(s, pad, y[u_start : u_start + last - first], free)
    for i in range(last - first):
        free[i] = mass * s.inertia_area[first + i] / a * y[v_start + i] - free[i]
    solve(s, pad, free)


@compiled
def to_base(s: Any, w: Any, pad: int, x: float, y: float) -> tuple[float, float]:
    """A vector of the world in the axes of a pad's base."""
    angle = w.q[s.pad_base[pad] + 2]
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * x + sin * y, cos * y - sin * x


@compiled
def to_world(s: Any, w: Any, pad: int, x: float, y: float) -> tuple[float, float]:
    """A vector in the axes of a pad's base in the world's."""
    angle = w.q[s.pad_base[pad] + 2]
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * x - sin * y, sin * x + cos * y


@compiled
def base_velocity(s: Any, w: Any, pad: int) -> tuple[float, float]:
    """The base's velocity in its own axes."""
    return to_base(s, w, pad, w.V[s.pad_base[pad]], w.V[s.pad_base[pad] + 1])


@compiled
def couple_point(s: Any, w: Any, pad: int, k: int, c: int, K: Array, H: Array, Rv: Array) -> None:
    """Contribution of the base's velocity to the rate of point k, in Hc and Rv."""
    for axis in range(2):
        towards = s.body_free[s.pad_base[pad] + axis]
        if towards < 0:
            continue
        column = s.pad_column[pad, towards]
        ex, ey = to_base(s, w, pad, 1.0 - axis, axis)
        Dx, Dy = 0.0, 0.0
        for j in range(2):
            dof = s.inertia_dof_start[pad] + s.inertia_surface[2 * s.point_node[k, j]]
            N = s.point_N[k, j]
            Dx += N * (s.inertia_D[dof, 0] * ex + s.inertia_D[dof, 1] * ey)
            Dy += N * (s.inertia_D[dof + 1, 0] * ex + s.inertia_D[dof + 1, 1] * ey)
        for j in range(2):
            if s.point_N[k, j] != 0.0:
                row = 2 * w.slot[s.point_node[k, j]]
                for r in range(2):
                    w.Hc[row + r, column] -= s.point_N[k, j] * (H[r, 0] * Dx + H[r, 1] * Dy)
        for row in range(6):
            number = s.contact_number[c, row]
            if number >= 0:
                Rv[number, towards] -= K[row, 0] * Dx + K[row, 1] * Dy


@compiled
def couple_base(s: Any, w: Any, pad: int, n: int, Rv: Array) -> None:
    """The base's reaction to nodal forces and to its own velocity, in Rf and Rv."""
    base, free, first, B = s.pad_base[pad], s.body_free, s.pad_node_start[pad], s.inertia_B[pad]
    for axis in range(2):
        number = free[base + axis]
        if number < 0:
            continue
        ex, ey = to_base(s, w, pad, 1.0 - axis, axis)
        for m in range(2 * n):
            dof = (
                s.inertia_dof_start[pad] + s.inertia_surface[2 * w.touched[first + m // 2] + m % 2]
            )
            w.Rf[s.pad_column[pad, number], m] -= (
                ex * s.inertia_D[dof, 0] + ey * s.inertia_D[dof, 1]
            )
        for other in range(2):
            towards = free[base + other]
            if towards >= 0:
                ox, oy = to_base(s, w, pad, 1.0 - other, other)
                Rv[number, towards] -= ex * (B[0, 0] * ox + B[0, 1] * oy) + ey * (
                    B[1, 0] * ox + B[1, 1] * oy
                )


@compiled
def inertia_force(
    s: Any, w: Any, pad: int, y: Array, a: float, rates: Array
) -> tuple[float, float]:
    """Sum of M v' in the base's axes for the rates u' (dofs,) of the pad's own nodes and the base's
    velocity in w."""
    first, v_start, mass = (
        s.inertia_dof_start[pad],
        s.pad_v_start[pad],
        s.p[s.inertia_material_at[pad] + 3],
    )
    vx, vy = base_velocity(s, w, pad)
    x, z = 0.0, 0.0
    for i in range(0, rates.size, 2):
        x += mass * s.inertia_area[first + i] / a * (rates[i] + vx - y[v_start + i])
        z += mass * s.inertia_area[first + i + 1] / a * (rates[i + 1] + vy - y[v_start + i + 1])
    return x, z
