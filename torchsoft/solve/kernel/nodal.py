"""Nodal pads: the displacements u of all nodes that move, in one field or several, elements of any
law, inertia or none.

    f(u* + a h u', u') + M (u' + V_B - v*) / (a h) = F

with the forces f of the elements. At an iterate of Newton's method, with A the derivative of the
left side by u' (banded), the nodal rates are u' = free + A^-1 F - D dV_B, D = A^-1 M / (a h), and
the base feels - sum of M v'. With inertia a base may not turn, and there is one field.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, inlined
from torchsoft.solve.kernel.arrays import FIELD, LANES
from torchsoft.solve.kernel.invoke import (
    call_linearise,
    call_pullback,
    call_push,
    call_value,
)
from torchsoft.solve.kernel.linear import (
    add,
    dot,
    factor_banded,
    put,
    solve_banded,
    solve_transposed,
)
from torchsoft.solve.kernel.table import Array

ROUNDING = 1e-15
"""Part of the terms of a node's balance that rounding leaves of it."""


@compiled
def to_base(w: Any, base: int, x: float, y: float) -> tuple[float, float]:
    """A vector of the world in the axes of a base."""
    cos, sin = np.cos(w.q[base + 2]), np.sin(w.q[base + 2])
    return cos * x + sin * y, cos * y - sin * x


@compiled
def to_world(w: Any, base: int, x: float, y: float) -> tuple[float, float]:
    """A vector in the axes of a base in the world's."""
    cos, sin = np.cos(w.q[base + 2]), np.sin(w.q[base + 2])
    return cos * x - sin * y, sin * x + cos * y


@compiled
def inertial(s: Any, pad: int) -> bool:
    """Whether a pad has inertia; condensed pads have none."""
    return s.nodal_v_start[pad] >= 0


@compiled
def mass_rate(s: Any, pad: int, i: int, a: float) -> float:
    """M / (a h) of a dof [N.s/m]; zero without inertia."""
    return s.p[s.nodal_density_at[pad]] * s.nodal_area[i] / a if inertial(s, pad) else 0.0


@compiled
def change_of_speed(s: Any, w: Any, pad: int, i: int, y: Array, v_base: float) -> float:
    """a h v' of dof i of all, whose base moves at `v_base` along it."""
    at = s.nodal_v_start[pad] + i - s.nodal_dof_start[pad]
    return w.rate[i] + v_base - y[at] if inertial(s, pad) else 0.0


@compiled
def groups(s: Any, pad: int) -> tuple[int, int]:
    """Ends of a pad's elements among groups of `LANES`, whose law is called at once."""
    return s.nodal_element_start[pad] // LANES, s.nodal_element_start[pad + 1] // LANES


@compiled
def element_inputs(s: Any, w: Any, pad: int, g: int, y: Array, a: float) -> None:
    """Displacements and rates of the corners of a group of elements at the stage's end into
    w.element_x, where their constants stand."""
    x, i0, U = w.element_x[g], s.nodal_dof_start[pad], s.pad_y_start[pad]
    corners = s.nodal_dof.shape[1]
    for lane in range(LANES):
        for c in range(corners):
            dof = s.nodal_dof[g * LANES + lane, c]
            x[c, lane], x[corners + c, lane] = 0.0, 0.0
            if dof >= 0:
                rate = w.rate[i0 + dof]
                x[c, lane], x[corners + c, lane] = y[U + dof] + a * rate, rate


@compiled
def element_parameters(s: Any, pad: int) -> slice:
    """Places of the elements' parameters in p."""
    return slice(s.nodal_p_first[pad], s.nodal_p_last[pad])


@compiled
def displace(s: Any, w: Any, pad: int, y: Array, low: int, high: int) -> None:
    """u* of the surface nodes from `low` to `high`, and their rates as they are."""
    for node in range(low, high):
        for r in range(2):
            dof = s.nodal_surface[2 * node + r]
            w.u[node, r] = y[s.pad_y_start[pad] + dof]
            w.free[node, r] = w.rate[s.nodal_dof_start[pad] + dof]
            w.u_dot[node, r] = w.free[node, r]


@compiled
def evaluate(s: Any, w: Any, pad: int, y: Array, a: float) -> tuple[float, float]:
    """Forces of the elements and their power at the trial rates; how far the nodes are from their
    balance under w.F_linear beyond rounding: the largest force [N], and the sum of squares
    [N2]."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    own = s.p[element_parameters(s, pad)]
    w.internal[first:last], w.noise[first:last], w.power[pad] = 0.0, 0.0, 0.0
    (low, high), corners = groups(s, pad), s.nodal_dof.shape[1]
    for g in range(low, high):
        element_inputs(s, w, pad, g, y, a)
        call_value(s.nodal_value[pad], w.element_x[g], own, w.element)
        for lane in range(LANES):
            w.power[pad] += w.element[corners, lane]
            for c in range(corners):
                dof = s.nodal_dof[g * LANES + lane, c]
                if dof >= 0:
                    w.internal[first + dof] += w.element[c, lane]
                    w.noise[first + dof] += abs(w.element[c, lane])
    vx, vy = to_base(w, base, w.V[base], w.V[base + 1])
    load = w.load_dof
    load[first:last] = 0.0
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            load[first + s.nodal_surface[2 * node + r]] = w.F_linear[node, r]
    worst, squares = 0.0, 0.0
    for i in range(first, last):
        v_base = vx if i % 2 == 0 else vy
        M, change = mass_rate(s, pad, i, a), change_of_speed(s, w, pad, i, y, v_base)
        size = w.noise[i] + M * (abs(w.rate[i]) + abs(v_base) + abs(change))
        off = abs(w.internal[i] + M * change - load[i]) - ROUNDING * size
        if not off <= worst:  # a force that is not a number is the largest
            worst = off
        squares += max(off, 0.0) ** 2
    return worst, squares


@inlined
def matrix(s: Any, w: Any, pad: int) -> Array:
    """A of a pad, a view."""
    n = s.nodal_dof_start[pad + 1] - s.nodal_dof_start[pad]
    at = s.nodal_band_start[pad]
    return w.band[at : at + n * (2 * s.nodal_band[pad] + 1)]


@compiled
def strained(s: Any, w: Any, g: int, a: float) -> float:
    """A bound of how far any element of a group is strained from where its derivatives are held."""
    x, held, worst = w.element_x[g], w.element_at[g], 0.0
    corners = s.nodal_dof.shape[1]
    for lane in range(LANES):
        total = 0.0
        for c in range(corners):
            off = abs(x[c, lane] - held[c, lane])
            off += a * abs(x[corners + c, lane] - held[corners + c, lane])
            total += off * abs(x[2 * corners + c % FIELD, lane])  # gradients at the centre
        if not total <= worst:
            worst = total
    return worst


@compiled
def linearise(s: Any, w: Any, pad: int, y: Array, a: float, hold: float) -> bool:
    """Derivatives of the elements' forces, w.element_J, anew where they are strained by more than
    `hold`; whether any are."""
    own, changed = s.p[element_parameters(s, pad)], False
    (low, high), corners = groups(s, pad), s.nodal_dof.shape[1]
    for g in range(low, high):
        element_inputs(s, w, pad, g, y, a)
        if w.held[pad] == 0.0 or not strained(s, w, g, a) <= hold:
            call_linearise(s.nodal_linearise[pad], w.element_x[g], own, w.element, w.element_J[g])
            put(w.element_x[g, : 2 * corners], w.element_at[g])
            changed = True
    return changed


@compiled
def relinearise(s: Any, w: Any, pad: int, y: Array, a: float) -> None:
    """Derivatives of all elements at the rates w.rate; `relation` factorises them."""
    w.held[pad] = 0.0
    linearise(s, w, pad, y, a, 0.0)


@compiled
def factor(s: Any, w: Any, pad: int, a: float) -> None:
    """A of a pad, factorised, in w.band, from the elements' derivatives."""
    first, last, band = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.nodal_band[pad]
    width, A, corners = 2 * band + 1, matrix(s, w, pad), s.nodal_dof.shape[1]
    A[:] = 0.0
    for e in range(s.nodal_element_start[pad], s.nodal_element_start[pad + 1]):
        J, lane = w.element_J[e // LANES], e % LANES
        for c in range(corners):
            row = s.nodal_dof[e, c]
            for d in range(corners if row >= 0 else 0):
                column = s.nodal_dof[e, d]
                if column >= 0:
                    by = a * J[c, d, lane] + J[c, corners + d, lane]
                    A[row * width + band + column - row] += by
    for i in range(last - first):
        A[i * width + band] += mass_rate(s, pad, first + i, a)
    factor_banded(A, last - first, band)


@compiled
def solve(s: Any, w: Any, pad: int, b: Array, m: int, first: int) -> None:
    """A^-1 of m right-hand sides b (dofs m,), zero before dof `first`, in place."""
    n = s.nodal_dof_start[pad + 1] - s.nodal_dof_start[pad]
    solve_banded(matrix(s, w, pad), n, s.nodal_band[pad], b, m, first)


@compiled
def solve_back(s: Any, w: Any, pad: int, b: Array) -> None:
    """A^-T of b (dofs,) in place."""
    solve_transposed(matrix(s, w, pad), b.size, s.nodal_band[pad], b)


@compiled
def relation(s: Any, w: Any, pad: int, y: Array, a: float) -> None:
    """The pad's relation at the rates w.rate and the forces w.internal that `evaluate` found there:
    free rates, which only Newton's method takes, w.P between the touched nodes, D and B of the
    base's motion. What nothing has changed since is held."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    nodes, n = s.pad_node_start[pad], w.counts[pad]
    fresh = w.held[pad] != a
    if linearise(s, w, pad, y, a, s.nodal_hold[pad]) or fresh:
        factor(s, w, pad, a)
        w.held[pad], fresh = a, True
    same = not fresh and n == w.held_count[pad]
    for i in range(nodes, nodes + (n if same else 0)):
        same &= w.touched[i] == w.held_touched[i]
    if not same:
        respond(s, w, pad, a)
    b, m = responses(s, w, pad), responses_width(s, w, pad)
    for j in range(2 * n):
        dof = s.nodal_surface[2 * w.touched[nodes + j // 2] + j % 2]
        put(b[dof * m : dof * m + 2 * n], w.P[j, : 2 * n])
    free = w.rate_free[first:last]
    vx, vy = to_base(w, base, w.V[base], w.V[base + 1])
    for i in range(last - first):
        change = change_of_speed(s, w, pad, first + i, y, vx if i % 2 == 0 else vy)
        free[i] = -w.internal[first + i] - mass_rate(s, pad, first + i, a) * change
    solve(s, w, pad, free, 1, 0)
    for i in range(last - first):
        free[i] += w.rate[first + i]
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            w.free[node, r] = free[s.nodal_surface[2 * node + r]]


@compiled
def responses_width(s: Any, w: Any, pad: int) -> int:
    """Number of held responses of a pad."""
    return 2 * w.held_count[pad] + (2 if inertial(s, pad) else 0)


@inlined
def responses(s: Any, w: Any, pad: int) -> Array:
    """Held responses of a pad's dofs, row by row, a view."""
    n = s.nodal_dof_start[pad + 1] - s.nodal_dof_start[pad]
    at = s.nodal_dof_start[pad] * (w.responses.size // s.nodal_dof_start[-1])
    return w.responses[at : at + n * responses_width(s, w, pad)]


@compiled
def respond(s: Any, w: Any, pad: int, a: float) -> None:
    """Responses to unit forces on the touched nodes, and to the base's motion, D and B."""
    first, last, nodes = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_node_start[pad]
    n, moved = w.counts[pad], 2 if inertial(s, pad) else 0
    w.held_count[pad] = n
    put(w.touched[nodes : nodes + n], w.held_touched[nodes : nodes + n])
    b, m = responses(s, w, pad), responses_width(s, w, pad)
    b[:] = 0.0
    for i in range(last - first if moved else 0):
        M = mass_rate(s, pad, first + i, a)
        b[i * m + 2 * n + i % 2] = M
        w.D_left[first + i, i % 2], w.D_left[first + i, 1 - i % 2] = M, 0.0
    loaded = 0 if moved else last - first
    for j in range(2 * n):
        dof = s.nodal_surface[2 * w.touched[nodes + j // 2] + j % 2]
        b[dof * m + j], loaded = 1.0, min(loaded, dof)
    solve(s, w, pad, b, m, loaded)
    if moved:
        B = w.B[pad]
        B[:] = 0.0
        for i in range(last - first):
            M = mass_rate(s, pad, first + i, a)
            B[i % 2, i % 2] += M
            for axis in range(2):
                w.D[first + i, axis] = b[i * m + 2 * n + axis]
                B[i % 2, axis] -= M * w.D[first + i, axis]
        for axis in range(2):
            left = w.load_dof[first:last]
            put(w.D_left[first:last, axis], left)
            solve_back(s, w, pad, left)
            put(left, w.D_left[first:last, axis])


@compiled
def couple(s: Any, w: Any, pad: int, Rv: Array) -> None:
    """Effects of the motion of the base of a pad with inertia on the points' rates, and its
    reaction to nodal forces and to its own velocity, in w.Hc, w.Rf and Rv."""
    at, base, free = s.pad_point_start[pad], s.pad_base[pad], s.body_free
    first = s.nodal_dof_start[pad]
    for axis in range(2):
        towards = free[base + axis]
        if towards < 0:
            continue
        column = s.pad_column[pad, towards]
        ex, ey = to_base(w, base, 1.0 - axis, axis)
        for i in range(w.actives[pad]):
            k = w.active[at + i]
            c, H = s.point_contact[k], w.H[at + i]
            Dx, Dy = 0.0, 0.0
            for j in range(2):
                dof, N = first + s.nodal_surface[2 * s.point_node[k, j]], s.point_N[k, j]
                Dx += N * (w.D[dof, 0] * ex + w.D[dof, 1] * ey)
                Dy += N * (w.D[dof + 1, 0] * ex + w.D[dof + 1, 1] * ey)
            for j in range(2):
                if s.point_N[k, j] != 0.0:
                    row = 2 * w.slot[s.point_node[k, j]]
                    for r in range(2):
                        w.Hc[row + r, column] -= s.point_N[k, j] * (H[r, 0] * Dx + H[r, 1] * Dy)
            for row in range(6):
                number = s.contact_number[c, row]
                if number >= 0:
                    down = w.by_pair[c, 6 + row, 12:]
                    for o in range(3):
                        Rv[number, towards] -= down[o] * (H[o, 0] * Dx + H[o, 1] * Dy)
        for m in range(2 * w.counts[pad]):
            node = w.touched[s.pad_node_start[pad] + m // 2]
            dof = first + s.nodal_surface[2 * node + m % 2]
            w.Rf[column, m] -= ex * w.D_left[dof, 0] + ey * w.D_left[dof, 1]
        for other in range(2):
            if free[base + other] >= 0:
                ox, oy = to_base(w, base, 1.0 - other, other)
                B = w.B[pad]
                Rv[towards, free[base + other]] -= ex * (B[0, 0] * ox + B[0, 1] * oy) + ey * (
                    B[1, 0] * ox + B[1, 1] * oy
                )


@compiled
def react(s: Any, w: Any, pad: int, y: Array, a: float, r: Array) -> None:
    """The base's reaction to the free rates, - sum of M v', in r."""
    base = s.pad_base[pad]
    vx, vy = to_base(w, base, w.V[base], w.V[base + 1])
    x = z = 0.0
    for i in range(s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], 2):
        M = mass_rate(s, pad, i, a)
        at = s.nodal_v_start[pad] + i - s.nodal_dof_start[pad]
        x += M * (w.rate_free[i] + vx - y[at])
        z += M * (w.rate_free[i + 1] + vy - y[at + 1])
    X, Y = to_world(w, base, x, z)
    if s.body_free[base] >= 0:
        r[s.body_free[base], 0] -= X
    if s.body_free[base + 1] >= 0:
        r[s.body_free[base + 1], 0] -= Y


@compiled
def propose(s: Any, w: Any, pad: int, dV: Array) -> None:
    """Rates of all nodes, w.rate_new, and of the surface, w.u_dot_new, under the forces w.F_new and
    the change of velocity dV."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    new, free, forces = w.rate_new[first:last], s.body_free, w.load_dof[: 2 * w.counts[pad]]
    for i in range(w.counts[pad]):
        node = w.touched[s.pad_node_start[pad] + i]
        forces[2 * i], forces[2 * i + 1] = w.F_new[node, 0], w.F_new[node, 1]
    b, m = responses(s, w, pad), responses_width(s, w, pad)
    x, y = 0.0, 0.0
    if inertial(s, pad):
        x = dV[free[base]] if free[base] >= 0 else 0.0
        y = dV[free[base + 1]] if free[base + 1] >= 0 else 0.0
    vx, vy = to_base(w, base, x, y)
    for i in range(last - first):
        new[i] = w.rate_free[first + i] + dot(forces, b[i * m :])
        if inertial(s, pad):
            new[i] -= w.D[first + i, 0] * vx + w.D[first + i, 1] * vy
        w.rate_old[first + i] = w.rate[first + i]
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            w.u_dot_new[2 * node + r] = new[s.nodal_surface[2 * node + r]]


@compiled
def move(s: Any, w: Any, pad: int, part: float) -> None:
    """Go `part` of the way from the old rates to the proposed ones."""
    for i in range(s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1]):
        w.rate[i] = w.rate_old[i] + part * (w.rate_new[i] - w.rate_old[i])


@compiled
def finish(s: Any, w: Any, pad: int, y: Array, a: float, powers: Array, wrench: Array) -> float:
    """Rates of the state into w.k, and the power [W] that the pad dissipates; with inertia also the
    force on it, its moment and its base's load, which are those of the elements. Returns a bound of
    the nodes' speeds [m/s]."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    vx, vy = to_base(w, base, w.V[base], w.V[base + 1])
    fastest, U, W = 0.0, s.pad_y_start[pad], s.nodal_v_start[pad]
    powers[pad] += w.power[pad]
    for i in range(last - first):
        w.k[U + i] = w.rate[first + i]
        fastest = max(fastest, abs(w.rate[first + i]))
        if inertial(s, pad):
            v_base = vx if i % 2 == 0 else vy
            w.k[W + i] = change_of_speed(s, w, pad, first + i, y, v_base) / a
    if inertial(s, pad):
        x, z = wrench[0], wrench[1]
        wrench[:] = 0.0
        for i in range(first, last, 2):
            fx, fy = w.internal[i], w.internal[i + 1]
            wrench[0] += fx
            wrench[1] += fy
            wrench[2] += s.nodal_X[i] * fy - s.nodal_X[i + 1] * fx
        X, Y = to_world(w, base, wrench[0] - x, wrench[1] - z)
        w.load[base] += X
        w.load[base + 1] += Y
    return 1.5 * fastest


# Tangent.


@compiled
def push_elements(
    s: Any, w: Any, z: Any, pad: int, du: Array, dv: Array, dp: Array, rates: bool, out: Array
) -> None:
    """Add the tangents of the elements' forces to `out` (all dofs, m): by displacements du (dofs,
    m), by the parameters, and with `rates` by rates dv (all dofs, m)."""
    own, i0, m = element_parameters(s, pad), s.nodal_dof_start[pad], dp.shape[1]
    d, (low, high) = z.direction[: own.stop - own.start], groups(s, pad)
    corners = s.nodal_dof.shape[1]
    for g in range(low, high):
        J, dofs = w.element_J[g], s.nodal_dof[g * LANES : (g + 1) * LANES]
        for lane in range(LANES):
            for c in range(corners):
                row = dofs[lane, c]
                for e in range(corners if row >= 0 else 0):
                    dof = dofs[lane, e]
                    if dof >= 0:
                        add(J[c, e, lane], du[dof], out[i0 + row])
                        if rates:
                            add(J[c, corners + e, lane], dv[i0 + dof], out[i0 + row])
    for k in range(m):
        moved = False
        for j in range(d.size):
            d[j] = dp[own.start + j, k]
            moved |= d[j] != 0.0
        for g in range(low, high if moved else low):
            call_push(s.nodal_push[pad], w.element_x[g], s.p[own], d, z.element)
            for lane in range(LANES):
                for c in range(corners):
                    row = s.nodal_dof[g * LANES + lane, c]
                    if row >= 0:
                        out[i0 + row, k] += z.element[c, lane]


@compiled
def push(
    s: Any, w: Any, z: Any, pad: int, y: Array, dy: Array, dp: Array, a: float, r: Array
) -> None:
    """Derivatives of u* (z.u) and of u' before the forces' own change (z.v) at the touched nodes,
    z.free of all of them, and the base's reaction in r."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    U, W, m, free = s.pad_y_start[pad], s.nodal_v_start[pad], dy.shape[1], z.free
    vx, vy = to_base(w, base, w.V[base], w.V[base + 1])
    du, at = dy[U : U + last - first], s.nodal_density_at[pad]
    free[first:last] = 0.0
    push_elements(s, w, z, pad, du, free, dp, False, free)
    for i in range(first, last):
        for k in range(m):
            free[i, k] = -free[i, k]
        if inertial(s, pad):
            change = change_of_speed(s, w, pad, i, y, vx if i % 2 == 0 else vy)
            add(mass_rate(s, pad, i, a), dy[W + i - first], free[i])
            add(-s.nodal_area[i] / a * change, dp[at], free[i])
    b = w.solves[: (last - first) * m]
    for i in range(last - first):
        put(free[first + i], b[i * m : (i + 1) * m])
    solve(s, w, pad, b, m, 0)
    for i in range(last - first):
        put(b[i * m : (i + 1) * m], free[first + i])
    for i in range(w.counts[pad]):
        node = w.touched[s.pad_node_start[pad] + i]
        for axis in range(2):
            dof = s.nodal_surface[2 * node + axis]
            put(du[dof], z.u[node, axis])
            put(free[first + dof], z.v[node, axis])
    for k in range(m if inertial(s, pad) else 0):
        along = across = 0.0
        for i in range(first, last):
            change = change_of_speed(s, w, pad, i, y, vx if i % 2 == 0 else vy)
            M = mass_rate(s, pad, i, a)
            push = (
                M * (free[i, k] - dy[W + i - first, k]) + s.nodal_area[i] / a * change * dp[at, k]
            )
            if i % 2 == 0:
                along += push
            else:
                across += push
        X, Y = to_world(w, base, along, across)
        if s.body_free[base] >= 0:
            r[s.body_free[base], k] -= X
        if s.body_free[base + 1] >= 0:
            r[s.body_free[base + 1], k] -= Y


@compiled
def push_rates(s: Any, w: Any, z: Any, pad: int, X: Array, m: int) -> None:
    """Tangents of all nodes' rates, z.rate_of, under those of the nodal forces X, and z.own_rate of
    the touched nodes, less z.v."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    nodes = s.pad_node_start[pad]
    z.base_rate[:] = 0.0
    for axis in range(2 if inertial(s, pad) else 0):
        number = s.body_free[base + axis]
        if number >= 0:
            ex, ey = to_base(w, base, 1.0 - axis, axis)
            add(ex, z.V[number], z.base_rate[0])
            add(ey, z.V[number], z.base_rate[1])
    b = w.solves[: (last - first) * m]
    b[:] = 0.0
    for i in range(w.counts[pad]):
        for o in range(2):
            dof = s.nodal_surface[2 * w.touched[nodes + i] + o]
            put(X[2 * i + o, :m], b[dof * m : (dof + 1) * m])
    solve(s, w, pad, b, m, 0)
    for i in range(last - first):
        rate = z.rate_of[first + i]
        put(z.free[first + i], rate)
        add(1.0, b[i * m : (i + 1) * m], rate)
        for q in range(2 if inertial(s, pad) else 0):
            add(-w.D[first + i, q], z.base_rate[q], rate)
    for i in range(w.counts[pad]):
        node = w.touched[nodes + i]
        for o in range(2):
            put(z.rate_of[first + s.nodal_surface[2 * node + o]], z.own_rate[i, o])
            add(-1.0, z.v[node, o], z.own_rate[i, o])


@compiled
def push_state(s: Any, w: Any, z: Any, pad: int, a: float, dy: Array) -> None:
    """Tangents of the state at the stage's end."""
    first, U, W = s.nodal_dof_start[pad], s.pad_y_start[pad], s.nodal_v_start[pad]
    for i in range(s.nodal_dof_start[pad + 1] - first):
        add(a, z.rate_of[first + i], dy[U + i])
        if inertial(s, pad):
            put(z.rate_of[first + i], dy[W + i])
            add(1.0, z.base_rate[i % 2], dy[W + i])


@compiled
def push_felt(s: Any, w: Any, z: Any, pad: int, y: Array, a: float, dy: Array, dp: Array) -> None:
    """Tangents of the force and the moment of the elements, and of the base's load, in
    z.recorded."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    U, m, into, out = s.pad_y_start[pad], dy.shape[1], z.recorded, z.free
    wrench = 2 * s.point_contact.size + 3 * pad
    load = 2 * s.point_contact.size + 3 * s.pad_base.size + base
    out[first:last] = 0.0
    du = dy[U : U + last - first]
    push_elements(s, w, z, pad, du, z.rate_of, dp, True, out)
    for k in range(m):
        x = z_axis = moment = 0.0
        for i in range(first, last, 2):
            x += out[i, k]
            z_axis += out[i + 1, k]
            moment += s.nodal_X[i] * out[i + 1, k] - s.nodal_X[i + 1] * out[i, k]
        into[wrench, k], into[wrench + 1, k], into[wrench + 2, k] = x, z_axis, moment
        X, Y = to_world(w, base, x, z_axis)
        into[load, k] += X
        into[load + 1, k] += Y


# Adjoint.


@compiled
def pull_elements(
    s: Any, w: Any, z: Any, pad: int, factor: float, forces_bar: Array, u_bar: Array,
    rate_bar: Array, p_bar: Array,
) -> None:  # fmt: skip
    """Add to the cotangents of displacements (dofs,), of rates (all dofs,) and of the parameters
    those of the elements' forces, `factor` forces_bar (all dofs,)."""
    own, i0, bar = element_parameters(s, pad), s.nodal_dof_start[pad], z.element
    (low, high), corners = groups(s, pad), s.nodal_dof.shape[1]
    for g in range(low, high):
        J, dofs = w.element_J[g], s.nodal_dof[g * LANES : (g + 1) * LANES]
        for c in range(corners):
            for lane in range(LANES):
                dof = dofs[lane, c]
                bar[c, lane] = factor * forces_bar[i0 + dof] if dof >= 0 else 0.0
        call_pullback(s.nodal_pullback[pad], w.element_x[g], s.p[own], bar, p_bar[own])
        for d in range(corners):
            for lane in range(LANES):
                dof = dofs[lane, d]
                if dof >= 0:
                    by_u = by_rate = 0.0
                    for c in range(corners):
                        by_u += J[c, d, lane] * bar[c, lane]
                        by_rate += J[c, corners + d, lane] * bar[c, lane]
                    u_bar[dof] += by_u
                    rate_bar[i0 + dof] += by_rate


@compiled
def pull_felt(
    s: Any, w: Any, z: Any, pad: int, y: Array, a: float, y_bar: Array, p_bar: Array
) -> None:
    """Adjoint of `push_felt`: the cotangents of rates go to z.rate_of."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    U, wrench, bar = s.pad_y_start[pad], z.wrenches[pad], z.own
    x, z_axis = to_base(w, base, z.load[base], z.load[base + 1])
    for i in range(first, last, 2):
        bar[i] = wrench[0] + x - s.nodal_X[i + 1] * wrench[2]
        bar[i + 1] = wrench[1] + z_axis + s.nodal_X[i] * wrench[2]
    pull_elements(s, w, z, pad, 1.0, bar, y_bar[U : U + last - first], z.rate_of, p_bar)


@compiled
def pull_forces(
    s: Any, w: Any, z: Any, pad: int, y_bar: Array, a: float, b: Array, X: Array, V_bar: Array
) -> None:
    """Cotangents of the touched nodes' forces into X[:, 0], and of the base's velocity, from those
    of the state and of the nodal rates, b, and z.rate_of."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    U, W, nodes, own = s.pad_y_start[pad], s.nodal_v_start[pad], s.pad_node_start[pad], z.own
    for i in range(first, last):
        own[i] = z.rate_of[i] + a * y_bar[U + i - first]
        if inertial(s, pad):
            own[i] += y_bar[W + i - first]
    for i in range(w.counts[pad]):
        for r in range(2):
            own[first + s.nodal_surface[2 * w.touched[nodes + i] + r]] += b[2 * i + r]
    if inertial(s, pad):
        reaction = z.pair[0]
        reaction[:] = 0.0
        for i in range(first, last):
            for axis in range(2):
                reaction[axis] -= w.D[i, axis] * own[i]
            reaction[i % 2] += y_bar[W + i - first]
        X_bar, Y_bar = to_world(w, base, reaction[0], reaction[1])
        if s.body_free[base] >= 0:
            V_bar[s.body_free[base]] += X_bar
        if s.body_free[base + 1] >= 0:
            V_bar[s.body_free[base + 1]] += Y_bar
    solve_back(s, w, pad, own[first:last])
    for i in range(w.counts[pad]):
        for r in range(2):
            X[2 * i + r, 0] = own[first + s.nodal_surface[2 * w.touched[nodes + i] + r]]


@compiled
def pull_state(
    s: Any, w: Any, z: Any, pad: int, y: Array, y_bar: Array, a: float, nu: Array, V_bar: Array,
    p_bar: Array,
) -> None:  # fmt: skip
    """Cotangents of the state at the stage's start, of the material and of the base's velocity,
    from those of the nodal rates and displacements, z.rate, z.rate_of and z.u, and nu of the
    bodies' equations."""
    first, last, base = s.nodal_dof_start[pad], s.nodal_dof_start[pad + 1], s.pad_base[pad]
    U, W, at = s.pad_y_start[pad], s.nodal_v_start[pad], s.nodal_density_at[pad]
    own, reaction, local = z.own, z.pair[0], z.pair[1]
    nx = nu[s.body_free[base], 0] if s.body_free[base] >= 0 else 0.0
    ny = nu[s.body_free[base + 1], 0] if s.body_free[base + 1] >= 0 else 0.0
    reaction[0], reaction[1] = to_base(w, base, -nx, -ny)
    for i in range(first, last):
        own[i] = z.rate_of[i] + a * y_bar[U + i - first]
        if inertial(s, pad):
            own[i] += y_bar[W + i - first] + mass_rate(s, pad, i, a) * reaction[i % 2]
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            own[first + s.nodal_surface[2 * node + r]] += z.rate[node, r]
            y_bar[U + s.nodal_surface[2 * node + r]] += z.u[node, r]
    solve_back(s, w, pad, own[first:last])  # now the multiplier of the pad's equation
    # the rates' cotangents are spent: what comes to them here is not read
    pull_elements(s, w, z, pad, -1.0, own, y_bar[U : U + last - first], z.rate_of, p_bar)
    if not inertial(s, pad):
        return
    vx, vy = to_base(w, base, w.V[base], w.V[base + 1])
    local[:] = 0.0
    for i in range(first, last):
        M = mass_rate(s, pad, i, a)
        change = change_of_speed(s, w, pad, i, y, vx if i % 2 == 0 else vy)
        balance = M * (reaction[i % 2] - own[i])
        local[i % 2] += y_bar[W + i - first] + balance
        p_bar[at] += s.nodal_area[i] / a * change * (reaction[i % 2] - own[i])
        y_bar[W + i - first] = -balance
    X_bar, Y_bar = to_world(w, base, local[0], local[1])
    V_bar[base] += X_bar
    V_bar[base + 1] += Y_bar
