"""Nodal pads: the displacements u of all nodes that move, in one field or several, elements of any
law, inertia or none.

    f(u* + a h u', u') + M (u' + V_B - v*) / (a h) = F

with the forces f of the elements. At an iterate of Newton's method, with A the derivative of the
left side by u' (banded), the nodal rates are u' = free + A^-1 F - D dV_B, D = A^-1 M / (a h), and
the base feels - sum of M v'. With inertia a base may not turn, and there is one field.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, contacts
from torchsoft.solve.kernel.arrays import AXES, LANES, PAIR, SIDE, WRENCH
from torchsoft.solve.kernel.invoke import (
    call_linearise,
    call_pull,
    call_push,
    call_value,
)
from torchsoft.solve.kernel.linear import (
    add,
    carry,
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
def to_base(work: Any, base: int, x: float, y: float) -> tuple[float, float]:
    """A vector of the world in the axes of a base."""
    cos, sin = np.cos(work.q[base + 2]), np.sin(work.q[base + 2])
    return cos * x + sin * y, cos * y - sin * x


@compiled
def to_world(work: Any, base: int, x: float, y: float) -> tuple[float, float]:
    """A vector in the axes of a base in the world's."""
    cos, sin = np.cos(work.q[base + 2]), np.sin(work.q[base + 2])
    return cos * x - sin * y, sin * x + cos * y


@compiled
def inertial(rig: Any, pad: int) -> bool:
    """Whether a pad has inertia; condensed pads have none."""
    return rig.nodal_v_start[pad] >= 0


@compiled
def mass_rate(rig: Any, pad: int, i: int, a: float) -> float:
    """M / (a h) of a dof [N.s/m]; zero without inertia."""
    return rig.p[rig.nodal_density_at[pad]] * rig.nodal_area[i] / a if inertial(rig, pad) else 0.0


@compiled
def change_of_speed(rig: Any, work: Any, pad: int, i: int, y: Array, v_base: float) -> float:
    """a h v' of dof i of all, whose base moves at `v_base` along it."""
    at = rig.nodal_v_start[pad] + i - rig.nodal_dof_start[pad]
    return work.rate[i] + v_base - y[at] if inertial(rig, pad) else 0.0


@compiled
def groups(rig: Any, pad: int) -> tuple[int, int]:
    """Ends of a pad's elements among groups of `LANES`, whose law is called at once."""
    return rig.nodal_element_start[pad] // LANES, rig.nodal_element_start[pad + 1] // LANES


@compiled
def element_inputs(rig: Any, work: Any, pad: int, g: int, y: Array, a: float) -> None:
    """Displacements and rates of the corners of a group of elements at the stage's end into
    work.element_x, where their constants stand."""
    x, i0, U = work.element_x[g], rig.nodal_dof_start[pad], rig.pad_y_start[pad]
    corners = rig.nodal_dof.shape[1]
    for lane in range(LANES):
        for c in range(corners):
            dof = rig.nodal_dof[g * LANES + lane, c]
            x[c, lane], x[corners + c, lane] = 0.0, 0.0
            if dof >= 0:
                rate = work.rate[i0 + dof]
                x[c, lane], x[corners + c, lane] = y[U + dof] + a * rate, rate


@compiled
def element_parameters(rig: Any, pad: int) -> slice:
    """Places of the elements' parameters in p."""
    return slice(rig.nodal_p_first[pad], rig.nodal_p_last[pad])


@compiled
def displace(rig: Any, work: Any, pad: int, y: Array, low: int, high: int) -> None:
    """u* of the surface nodes from `low` to `high`, and their rates as they are."""
    for node in range(low, high):
        for r in range(2):
            dof = rig.nodal_surface[2 * node + r]
            work.u[node, r] = y[rig.pad_y_start[pad] + dof]
            work.free[node, r] = work.rate[rig.nodal_dof_start[pad] + dof]
            work.u_dot[node, r] = work.free[node, r]


@compiled
def evaluate(rig: Any, work: Any, pad: int, y: Array, a: float) -> tuple[float, float]:
    """Forces of the elements and their power at the trial rates; how far the nodes are from their
    balance under work.F_linear beyond rounding: the largest force [N], and the sum of squares
    [N2]."""
    first, last, base = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.pad_base[pad]
    p = rig.p[element_parameters(rig, pad)]
    work.internal[first:last], work.noise[first:last], work.power[pad] = 0.0, 0.0, 0.0
    (low, high), corners = groups(rig, pad), rig.nodal_dof.shape[1]
    for g in range(low, high):
        element_inputs(rig, work, pad, g, y, a)
        call_value(rig.nodal_value[pad], work.element_x[g], p, work.element)
        for lane in range(LANES):
            work.power[pad] += work.element[corners, lane]
            for c in range(corners):
                dof = rig.nodal_dof[g * LANES + lane, c]
                if dof >= 0:
                    work.internal[first + dof] += work.element[c, lane]
                    work.noise[first + dof] += abs(work.element[c, lane])
    vx, vy = to_base(work, base, work.V[base], work.V[base + 1])
    load = work.load_dof
    load[first:last] = 0.0
    for node in range(work.low[pad], work.high[pad]):
        for r in range(2):
            load[first + rig.nodal_surface[2 * node + r]] = work.F_linear[node, r]
    worst, squares = 0.0, 0.0
    for i in range(first, last):
        v_base = vx if i % 2 == 0 else vy
        M, change = mass_rate(rig, pad, i, a), change_of_speed(rig, work, pad, i, y, v_base)
        size = work.noise[i] + M * (abs(work.rate[i]) + abs(v_base) + abs(change))
        off = abs(work.internal[i] + M * change - load[i]) - ROUNDING * size
        if not off <= worst:  # a force that is not a number is the largest
            worst = off
        squares += max(off, 0.0) ** 2
    return worst, squares


@compiled
def matrix_of(rig: Any, pad: int) -> slice:
    """Place of a pad's A in work.band."""
    n = rig.nodal_dof_start[pad + 1] - rig.nodal_dof_start[pad]
    at = rig.nodal_band_start[pad]
    return slice(at, at + n * (2 * rig.nodal_band[pad] + 1))


@compiled
def strained(rig: Any, work: Any, g: int, a: float) -> float:
    """A bound of how far any element of a group is strained from where its derivatives are held."""
    x, held, worst = work.element_x[g], work.element_at[g], 0.0
    corners = rig.nodal_dof.shape[1]
    for lane in range(LANES):
        total = 0.0
        for c in range(corners):
            off = abs(x[c, lane] - held[c, lane])
            off += a * abs(x[corners + c, lane] - held[corners + c, lane])
            total += off * abs(
                x[2 * corners + c % rig.nodal_field, lane]
            )  # gradients at the centre
        if not total <= worst:
            worst = total
    return worst


@compiled
def linearise(rig: Any, work: Any, pad: int, y: Array, a: float, hold: float) -> bool:
    """Derivatives of the elements' forces, work.element_J, anew where they are strained by more
    than `hold`; whether any are."""
    p, changed = rig.p[element_parameters(rig, pad)], False
    (low, high), corners = groups(rig, pad), rig.nodal_dof.shape[1]
    for g in range(low, high):
        element_inputs(rig, work, pad, g, y, a)
        if work.held[pad] == 0.0 or not strained(rig, work, g, a) <= hold:
            call_linearise(
                rig.nodal_linearise[pad], work.element_x[g], p, work.element, work.element_J[g]
            )
            put(work.element_x[g, : 2 * corners], work.element_at[g])
            changed = True
    return changed


@compiled
def relinearise(rig: Any, work: Any, pad: int, y: Array, a: float) -> None:
    """Derivatives of all elements at the rates work.rate; `relation` factorises them."""
    work.held[pad] = 0.0
    linearise(rig, work, pad, y, a, 0.0)


@compiled
def factor(rig: Any, work: Any, pad: int, a: float) -> None:
    """A of a pad, factorised, in work.band, from the elements' derivatives."""
    first, last, band = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.nodal_band[pad]
    width, A, corners = 2 * band + 1, work.band[matrix_of(rig, pad)], rig.nodal_dof.shape[1]
    A[:] = 0.0
    for e in range(rig.nodal_element_start[pad], rig.nodal_element_start[pad + 1]):
        J, lane = work.element_J[e // LANES], e % LANES
        for c in range(corners):
            row = rig.nodal_dof[e, c]
            for d in range(corners if row >= 0 else 0):
                column = rig.nodal_dof[e, d]
                if column >= 0:
                    by = a * J[c, d, lane] + J[c, corners + d, lane]
                    A[row * width + band + column - row] += by
    for i in range(last - first):
        A[i * width + band] += mass_rate(rig, pad, first + i, a)
    factor_banded(A, last - first, band)


@compiled
def solve(rig: Any, work: Any, pad: int, b: Array, m: int, first: int) -> None:
    """A^-1 of m right-hand sides b (dofs m,), zero before dof `first`, in place."""
    n = rig.nodal_dof_start[pad + 1] - rig.nodal_dof_start[pad]
    solve_banded(work.band[matrix_of(rig, pad)], n, rig.nodal_band[pad], b, m, first)


@compiled
def solve_back(rig: Any, work: Any, pad: int, b: Array) -> None:
    """A^-T of b (dofs,) in place."""
    solve_transposed(work.band[matrix_of(rig, pad)], b.size, rig.nodal_band[pad], b)


@compiled
def relation(rig: Any, work: Any, pad: int, y: Array, a: float) -> None:
    """The pad's relation at the rates work.rate and the forces work.internal that `evaluate` found
    there: free rates, which only Newton's method takes, work.P between the touched nodes, D and B
    of the base's motion. What nothing has changed since is held."""
    first, last, base = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.pad_base[pad]
    nodes, n = rig.pad_node_start[pad], work.counts[pad]
    fresh = work.held[pad] != a
    if linearise(rig, work, pad, y, a, rig.nodal_hold[pad]) or fresh:
        factor(rig, work, pad, a)
        work.held[pad], fresh = a, True
    same = not fresh and n == work.held_count[pad]
    for i in range(nodes, nodes + (n if same else 0)):
        same &= work.touched[i] == work.held_touched[i]
    if not same:
        respond(rig, work, pad, a)
    b, m = work.responses[responses_of(rig, work, pad)], responses_width(rig, work, pad)
    for j in range(2 * n):
        dof = rig.nodal_surface[2 * work.touched[nodes + j // 2] + j % 2]
        put(b[dof * m : dof * m + 2 * n], work.P[j, : 2 * n])
    free = work.rate_free[first:last]
    vx, vy = to_base(work, base, work.V[base], work.V[base + 1])
    for i in range(last - first):
        change = change_of_speed(rig, work, pad, first + i, y, vx if i % 2 == 0 else vy)
        free[i] = -work.internal[first + i] - mass_rate(rig, pad, first + i, a) * change
    solve(rig, work, pad, free, 1, 0)
    for i in range(last - first):
        free[i] += work.rate[first + i]
    for node in range(work.low[pad], work.high[pad]):
        for r in range(2):
            work.free[node, r] = free[rig.nodal_surface[2 * node + r]]


@compiled
def responses_width(rig: Any, work: Any, pad: int) -> int:
    """Number of held responses of a pad."""
    return 2 * work.held_count[pad] + (2 if inertial(rig, pad) else 0)


@compiled
def responses_of(rig: Any, work: Any, pad: int) -> slice:
    """Place of the held responses of a pad's dofs, row by row, in work.responses."""
    n = rig.nodal_dof_start[pad + 1] - rig.nodal_dof_start[pad]
    at = rig.nodal_dof_start[pad] * (work.responses.size // rig.nodal_dof_start[-1])
    return slice(at, at + n * responses_width(rig, work, pad))


@compiled
def respond(rig: Any, work: Any, pad: int, a: float) -> None:
    """Responses to unit forces on the touched nodes, and to the base's motion, D and B."""
    first, last, nodes = (
        rig.nodal_dof_start[pad],
        rig.nodal_dof_start[pad + 1],
        rig.pad_node_start[pad],
    )
    n, moved = work.counts[pad], 2 if inertial(rig, pad) else 0
    work.held_count[pad] = n
    put(work.touched[nodes : nodes + n], work.held_touched[nodes : nodes + n])
    b, m = work.responses[responses_of(rig, work, pad)], responses_width(rig, work, pad)
    b[:] = 0.0
    for i in range(last - first if moved else 0):
        M = mass_rate(rig, pad, first + i, a)
        b[i * m + 2 * n + i % 2] = M
        work.D_left[first + i, i % 2], work.D_left[first + i, 1 - i % 2] = M, 0.0
    loaded = 0 if moved else last - first
    for j in range(2 * n):
        dof = rig.nodal_surface[2 * work.touched[nodes + j // 2] + j % 2]
        b[dof * m + j], loaded = 1.0, min(loaded, dof)
    solve(rig, work, pad, b, m, loaded)
    if moved:
        B = work.B[pad]
        B[:] = 0.0
        for i in range(last - first):
            M = mass_rate(rig, pad, first + i, a)
            B[i % 2, i % 2] += M
            for axis in range(2):
                work.D[first + i, axis] = b[i * m + 2 * n + axis]
                B[i % 2, axis] -= M * work.D[first + i, axis]
        for axis in range(2):
            left = work.load_dof[first:last]
            put(work.D_left[first:last, axis], left)
            solve_back(rig, work, pad, left)
            put(left, work.D_left[first:last, axis])


@compiled
def couple(rig: Any, work: Any, pad: int, Rv: Array) -> None:
    """Effects of the motion of the base of a pad with inertia on the points' rates, and its
    reaction to nodal forces and to its own velocity, in work.Hc, work.Rf and Rv."""
    at, base, free = rig.pad_point_start[pad], rig.pad_base[pad], rig.body_free
    first = rig.nodal_dof_start[pad]
    for axis in range(2):
        towards = free[base + axis]
        if towards < 0:
            continue
        column = rig.pad_column[pad, towards]
        ex, ey = to_base(work, base, 1.0 - axis, axis)
        for i in range(work.actives[pad]):
            k = work.active[at + i]
            c, H = rig.point_contact[k], work.H[at + i]
            Dx, Dy = 0.0, 0.0
            for j in range(SIDE):
                dof, N = first + rig.nodal_surface[2 * rig.point_node[k, j]], rig.point_N[k, j]
                Dx += N * (work.D[dof, 0] * ex + work.D[dof, 1] * ey)
                Dy += N * (work.D[dof + 1, 0] * ex + work.D[dof + 1, 1] * ey)
            for j in range(SIDE):
                if rig.point_N[k, j] != 0.0:
                    row = 2 * work.slot[rig.point_node[k, j]]
                    for r in range(2):
                        work.Hc[row + r, column] -= rig.point_N[k, j] * (
                            H[r, 0] * Dx + H[r, 1] * Dy
                        )
            for row in range(PAIR):
                number = rig.contact_number[c, row]
                if number >= 0:
                    down = work.by_pair[c, PAIR + row, 2 * PAIR :]
                    for o in range(WRENCH):
                        Rv[number, towards] -= down[o] * (H[o, 0] * Dx + H[o, 1] * Dy)
        for m in range(2 * work.counts[pad]):
            node = work.touched[rig.pad_node_start[pad] + m // 2]
            dof = first + rig.nodal_surface[2 * node + m % 2]
            work.Rf[column, m] -= ex * work.D_left[dof, 0] + ey * work.D_left[dof, 1]
        for other in range(2):
            if free[base + other] >= 0:
                ox, oy = to_base(work, base, 1.0 - other, other)
                B = work.B[pad]
                Rv[towards, free[base + other]] -= ex * (B[0, 0] * ox + B[0, 1] * oy) + ey * (
                    B[1, 0] * ox + B[1, 1] * oy
                )


@compiled
def react(rig: Any, work: Any, pad: int, y: Array, a: float, r: Array) -> None:
    """The base's reaction to the free rates, - sum of M v', in r."""
    base = rig.pad_base[pad]
    vx, vy = to_base(work, base, work.V[base], work.V[base + 1])
    x = z = 0.0
    for i in range(rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], 2):
        M = mass_rate(rig, pad, i, a)
        at = rig.nodal_v_start[pad] + i - rig.nodal_dof_start[pad]
        x += M * (work.rate_free[i] + vx - y[at])
        z += M * (work.rate_free[i + 1] + vy - y[at + 1])
    X, Y = to_world(work, base, x, z)
    if rig.body_free[base] >= 0:
        r[rig.body_free[base], 0] -= X
    if rig.body_free[base + 1] >= 0:
        r[rig.body_free[base + 1], 0] -= Y


@compiled
def propose(rig: Any, work: Any, pad: int, dV: Array) -> None:
    """Rates of all nodes, work.rate_new, and of the surface, work.u_dot_new, under the forces
    work.F_new and the change of velocity dV."""
    first, last, base = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.pad_base[pad]
    new, free, forces = (
        work.rate_new[first:last],
        rig.body_free,
        work.load_dof[: 2 * work.counts[pad]],
    )
    for i in range(work.counts[pad]):
        node = work.touched[rig.pad_node_start[pad] + i]
        forces[2 * i], forces[2 * i + 1] = work.F_new[node, 0], work.F_new[node, 1]
    b, m = work.responses[responses_of(rig, work, pad)], responses_width(rig, work, pad)
    x, y = 0.0, 0.0
    if inertial(rig, pad):
        x = dV[free[base]] if free[base] >= 0 else 0.0
        y = dV[free[base + 1]] if free[base + 1] >= 0 else 0.0
    vx, vy = to_base(work, base, x, y)
    for i in range(last - first):
        new[i] = work.rate_free[first + i] + dot(forces, b[i * m :])
        if inertial(rig, pad):
            new[i] -= work.D[first + i, 0] * vx + work.D[first + i, 1] * vy
        work.rate_old[first + i] = work.rate[first + i]
    for node in range(work.low[pad], work.high[pad]):
        for r in range(2):
            work.u_dot_new[2 * node + r] = new[rig.nodal_surface[2 * node + r]]


@compiled
def move(rig: Any, work: Any, pad: int, part: float) -> None:
    """Go `part` of the way from the old rates to the proposed ones."""
    for i in range(rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1]):
        work.rate[i] = work.rate_old[i] + part * (work.rate_new[i] - work.rate_old[i])


@compiled
def finish(
    rig: Any, work: Any, pad: int, y: Array, a: float, powers: Array, wrench: Array
) -> float:
    """Rates of the state into work.k, and the power [W] that the pad dissipates; with inertia also
    the force on it, its moment and its base's load, which are those of the elements. Returns a
    bound of the nodes' speeds [m/s]."""
    first, last, base = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.pad_base[pad]
    vx, vy = to_base(work, base, work.V[base], work.V[base + 1])
    fastest, U, W = 0.0, rig.pad_y_start[pad], rig.nodal_v_start[pad]
    powers[pad] += work.power[pad]
    for i in range(last - first):
        work.k[U + i] = work.rate[first + i]
        fastest = max(fastest, abs(work.rate[first + i]))
        if inertial(rig, pad):
            v_base = vx if i % 2 == 0 else vy
            work.k[W + i] = change_of_speed(rig, work, pad, first + i, y, v_base) / a
    if inertial(rig, pad):
        x, z = wrench[0], wrench[1]
        wrench[:] = 0.0
        for i in range(first, last, 2):
            fx, fy = work.internal[i], work.internal[i + 1]
            wrench[0] += fx
            wrench[1] += fy
            wrench[2] += rig.nodal_X[i] * fy - rig.nodal_X[i + 1] * fx
        X, Y = to_world(work, base, wrench[0] - x, wrench[1] - z)
        work.load[base] += X
        work.load[base + 1] += Y
    return 1.5 * fastest


# Tangent.


@compiled
def carry_elements(
    rig: Any, work: Any, along: Any, pad: int, factor: float, du: Array, drate: Array, dp: Array,
    out: Array, back: bool,
) -> None:  # fmt: skip
    """Add the derivatives of the elements' forces, times a factor, to `out` (all dofs, columns): by
    displacements du (dofs, columns), by rates (all dofs, columns, or none) and by the parameters;
    or `back`."""
    here, i0, (low, high) = element_parameters(rig, pad), rig.nodal_dof_start[pad], groups(rig, pad)
    corners, direction, force = rig.nodal_dof.shape[1], along.direction, along.element
    for g in range(low, high):
        J, dofs = work.element_J[g], rig.nodal_dof[g * LANES : (g + 1) * LANES]
        for lane in range(LANES):
            for c in range(corners):
                row = dofs[lane, c]
                for d in range(corners if row >= 0 else 0):
                    dof = dofs[lane, d]
                    if dof >= 0:
                        carry(factor * J[c, d, lane], du[dof], out[i0 + row], back)
                        if drate.shape[0] > 0:
                            by_rate = factor * J[c, corners + d, lane]
                            carry(by_rate, drate[i0 + dof], out[i0 + row], back)
    direction = along.direction[: here.stop - here.start]
    for k in range(dp.shape[1]):
        moved = back
        for j in range(direction.size):
            direction[j] = dp[here.start + j, k]
            moved |= direction[j] != 0.0
        for g in range(low, high if moved else low):
            if not back:
                call_push(rig.nodal_push[pad], work.element_x[g], rig.p[here], direction, force)
            for lane in range(LANES):
                for c in range(corners):
                    dof = rig.nodal_dof[g * LANES + lane, c]
                    if back:
                        force[c, lane] = factor * out[i0 + dof, k] if dof >= 0 else 0.0
                    elif dof >= 0:
                        out[i0 + dof, k] += factor * force[c, lane]
            if back:
                call_pull(rig.nodal_pull[pad], work.element_x[g], rig.p[here], force, dp[here])


@compiled
def push(
    rig: Any, work: Any, along: Any, pad: int, y: Array, dy: Array, dp: Array, a: float
) -> None:
    """Derivatives of u* (along.u) and of u' before the forces' own change (along.rate) at the
    touched nodes, along.free of all of them, and the base's reaction in along.r."""
    first, last, base = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.pad_base[pad]
    U, W, m, free = rig.pad_y_start[pad], rig.nodal_v_start[pad], dy.shape[1], along.free
    vx, vy = to_base(work, base, work.V[base], work.V[base + 1])
    du, at = dy[U : U + last - first], rig.nodal_density_at[pad]
    free[first:last] = 0.0
    carry_elements(rig, work, along, pad, -1.0, du, along.rate_of[:0], dp, free, False)
    for i in range(first, last if inertial(rig, pad) else first):
        change = change_of_speed(rig, work, pad, i, y, vx if i % 2 == 0 else vy)
        add(mass_rate(rig, pad, i, a), dy[W + i - first], free[i])
        add(-rig.nodal_area[i] / a * change, dp[at], free[i])
    b = work.solves[: (last - first) * m]
    put(free[first:last], b)
    solve(rig, work, pad, b, m, 0)
    put(b, free[first:last])
    for i in range(work.counts[pad]):
        node = work.touched[rig.pad_node_start[pad] + i]
        for axis in range(AXES):
            dof = rig.nodal_surface[AXES * node + axis]
            put(du[dof], along.u[node, axis])
            put(free[first + dof], along.rate[node, axis])
    for k in range(m if inertial(rig, pad) else 0):
        reaction = along.reaction[0]
        reaction[:] = 0.0
        for i in range(first, last):
            change = change_of_speed(rig, work, pad, i, y, vx if i % 2 == 0 else vy)
            reaction[i % 2] += mass_rate(rig, pad, i, a) * (free[i, k] - dy[W + i - first, k])
            reaction[i % 2] += rig.nodal_area[i] / a * change * dp[at, k]
        X, Y = to_world(work, base, reaction[0], reaction[1])
        if rig.body_free[base] >= 0:
            along.r[rig.body_free[base], k] -= X
        if rig.body_free[base + 1] >= 0:
            along.r[rig.body_free[base + 1], k] -= Y


@compiled
def push_rates(rig: Any, work: Any, along: Any, pad: int, X: Array, m: int) -> None:
    """Tangents of all nodes' rates, along.rate_of, under those of the nodal forces X, and
    along.touched_rate of the touched nodes, less along.rate."""
    first, last, base = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.pad_base[pad]
    nodes = rig.pad_node_start[pad]
    along.base_rate[:] = 0.0
    for axis in range(AXES if inertial(rig, pad) else 0):
        ex, ey = to_base(work, base, 1.0 - axis, axis)
        add(ex, along.V[base + axis], along.base_rate[0])
        add(ey, along.V[base + axis], along.base_rate[1])
    b = work.solves[: (last - first) * m]
    b[:] = 0.0
    for i in range(work.counts[pad]):
        for o in range(AXES):
            dof = rig.nodal_surface[AXES * work.touched[nodes + i] + o]
            put(X[AXES * i + o, :m], b[dof * m : (dof + 1) * m])
    solve(rig, work, pad, b, m, 0)
    for i in range(last - first):
        rate = along.rate_of[first + i]
        put(along.free[first + i], rate)
        add(1.0, b[i * m : (i + 1) * m], rate)
        for q in range(AXES if inertial(rig, pad) else 0):
            add(-work.D[first + i, q], along.base_rate[q], rate)
    for i in range(work.counts[pad]):
        node = work.touched[nodes + i]
        for o in range(AXES):
            put(along.rate_of[first + rig.nodal_surface[AXES * node + o]], along.touched_rate[i, o])
            add(-1.0, along.rate[node, o], along.touched_rate[i, o])


@compiled
def push_state(rig: Any, work: Any, along: Any, pad: int, a: float, dy: Array) -> None:
    """Tangents of the state at the stage's end."""
    first, U, W = rig.nodal_dof_start[pad], rig.pad_y_start[pad], rig.nodal_v_start[pad]
    for i in range(rig.nodal_dof_start[pad + 1] - first):
        add(a, along.rate_of[first + i], dy[U + i])
        if inertial(rig, pad):
            put(along.rate_of[first + i], dy[W + i])
            add(1.0, along.base_rate[i % 2], dy[W + i])


@compiled
def carry_recorded(
    rig: Any, work: Any, along: Any, pad: int, dy: Array, dp: Array, back: bool
) -> None:
    """The force and the moment of the elements of a pad with inertia, and its base's load, in
    along.recorded, by the state, the nodes' rates along.rate_of and the parameters; or `back`."""
    first, last, base = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.pad_base[pad]
    wrench, load = contacts.wrench_at(rig, pad), contacts.wrench_at(rig, rig.pad_base.size) + base
    out, recorded = along.free, along.recorded
    du = dy[rig.pad_y_start[pad] : rig.pad_y_start[pad] + last - first]
    out[first:last] = 0.0
    if not back:
        carry_elements(rig, work, along, pad, 1.0, du, along.rate_of, dp, out, back)
    for i in range(first, last):
        axis = i % 2
        arm = rig.nodal_X[i - 1] if axis == 1 else -rig.nodal_X[i + 1]
        X, Y = to_world(work, base, 1.0 - axis, axis)
        carry(1.0, out[i], recorded[wrench + axis], back)
        carry(arm, out[i], recorded[wrench + AXES], back)
        carry(X, out[i], recorded[load], back)
        carry(Y, out[i], recorded[load + 1], back)
    if back:
        carry_elements(rig, work, along, pad, 1.0, du, along.rate_of, dp, out, back)


# Adjoint.


@compiled
def pull_forces(rig: Any, work: Any, along: Any, pad: int, y_bar: Array, a: float) -> None:
    """Cotangents of the touched nodes' forces into the first column of work.X, and of the base's
    velocity, from those of the state, of all nodes' rates and of the touched ones', along.rate_of
    and along.touched_rate."""
    first, last, base = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.pad_base[pad]
    U, W, nodes, bar = (
        rig.pad_y_start[pad], rig.nodal_v_start[pad], rig.pad_node_start[pad], work.load_dof
    )  # fmt: skip
    for i in range(first, last):
        bar[i] = along.rate_of[i, 0] + a * y_bar[U + i - first, 0]
        if inertial(rig, pad):
            bar[i] += y_bar[W + i - first, 0]
    for i in range(work.counts[pad]):
        for r in range(AXES):
            dof = rig.nodal_surface[AXES * work.touched[nodes + i] + r]
            bar[first + dof] += along.touched_rate[i, r, 0]
    if inertial(rig, pad):
        reaction = along.reaction[0]
        reaction[:] = 0.0
        for i in range(first, last):
            for axis in range(AXES):
                reaction[axis] -= work.D[i, axis] * bar[i]
            reaction[i % 2] += y_bar[W + i - first, 0]
        X_bar, Y_bar = to_world(work, base, reaction[0], reaction[1])
        along.V[base, 0] += X_bar
        along.V[base + 1, 0] += Y_bar
    solve_back(rig, work, pad, bar[first:last])
    for i in range(work.counts[pad]):
        for r in range(AXES):
            dof = rig.nodal_surface[AXES * work.touched[nodes + i] + r]
            work.X[AXES * (nodes + i) + r, 0] = bar[first + dof]


@compiled
def pull_state(
    rig: Any, work: Any, along: Any, pad: int, y: Array, y_bar: Array, a: float, p_bar: Array
) -> None:
    """Cotangents of the state at the stage's start, of the material and of the base's velocity,
    from those of the nodal rates and displacements, along.rate, along.rate_of and along.u, and
    along.r of the bodies' equations."""
    first, last, base = rig.nodal_dof_start[pad], rig.nodal_dof_start[pad + 1], rig.pad_base[pad]
    U, W, at = rig.pad_y_start[pad], rig.nodal_v_start[pad], rig.nodal_density_at[pad]
    bar, reaction, local = work.load_dof, along.reaction[0], along.reaction[1]
    nx = along.r[rig.body_free[base], 0] if rig.body_free[base] >= 0 else 0.0
    ny = along.r[rig.body_free[base + 1], 0] if rig.body_free[base + 1] >= 0 else 0.0
    reaction[0], reaction[1] = to_base(work, base, -nx, -ny)
    for i in range(first, last):
        bar[i] = along.rate_of[i, 0] + a * y_bar[U + i - first, 0]
        if inertial(rig, pad):
            bar[i] += y_bar[W + i - first, 0] + mass_rate(rig, pad, i, a) * reaction[i % 2]
    for node in range(work.low[pad], work.high[pad]):
        for r in range(AXES):
            bar[first + rig.nodal_surface[AXES * node + r]] += along.rate[node, r, 0]
            y_bar[U + rig.nodal_surface[AXES * node + r], 0] += along.u[node, r, 0]
    solve_back(rig, work, pad, bar[first:last])  # now the multiplier of the pad's equation
    put(bar[first:last], along.free[first:last])
    u_bar, none = y_bar[U : U + last - first], along.rate_of[:0]
    carry_elements(rig, work, along, pad, -1.0, u_bar, none, p_bar, along.free, True)
    if not inertial(rig, pad):
        return
    vx, vy = to_base(work, base, work.V[base], work.V[base + 1])
    local[:] = 0.0
    for i in range(first, last):
        M = mass_rate(rig, pad, i, a)
        change = change_of_speed(rig, work, pad, i, y, vx if i % 2 == 0 else vy)
        balance = M * (reaction[i % 2] - bar[i])
        local[i % 2] += y_bar[W + i - first, 0] + balance
        p_bar[at, 0] += rig.nodal_area[i] / a * change * (reaction[i % 2] - bar[i])
        y_bar[W + i - first, 0] = -balance
    X_bar, Y_bar = to_world(work, base, local[0], local[1])
    along.V[base, 0] += X_bar
    along.V[base + 1, 0] += Y_bar
