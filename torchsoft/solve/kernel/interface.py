"""The interface between one pad and the bodies it touches: kinematics, the law at its points, and
one block of equations.

Everything is written in the frame of the pad's base. With u' the nodal rates, F the nodal forces, P
the pad's mobility at this stage and f = law(u', V) at the touching points, spread over the nodes by
N,

    u' = free + P F,   F = N^T f,   f = f0 + H_u du' + H_V dV,

eliminating f leaves A F = b + Hc dV with A = 1 - N^T H_u N P, and the bodies' equations get Rf F +
Rv dV + r. Newton's iteration, the tangent and, transposed, the adjoint solve this one block.

Derivatives of a point by (u (2), body (3), base (3)): S by positions, H = T + a h S by rates of the
stage, T by velocities; G maps a force to (body, base), L is the derivative of that by positions at
the same force.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.inertia import couple_base, couple_point, free_rates
from torchsoft.solve.kernel.invoke import call_linearise, call_value
from torchsoft.solve.kernel.linear import add, bounds, dot, put, row_of
from torchsoft.solve.kernel.table import Array

NEGLIGIBLE = 1e-14
"""Nodal force that has set in [N] below which a node counts as never loaded: its displacements are
below rounding."""


@compiled
def frames(s: Any, w: Any) -> None:
    """Per contact, in the base's frame: cos and sin of its angle, the body's centre, its velocity
    less the base's, the spin."""
    for c in range(s.contact_pad.size):
        q, V, frame, B, C = w.q, w.V, w.frame, s.pad_base[s.contact_pad[c]], s.contact_body[c]
        cos, sin = np.cos(q[B + 2]), np.sin(q[B + 2])
        rx, ry, vx, vy = q[C] - q[B], q[C + 1] - q[B + 1], V[C] - V[B], V[C + 1] - V[B + 1]
        frame[c, 0], frame[c, 1] = cos, sin
        frame[c, 2], frame[c, 3] = cos * rx + sin * ry, cos * ry - sin * rx
        frame[c, 4], frame[c, 5] = cos * vx + sin * vy, cos * vy - sin * vx
        frame[c, 6] = V[B + 2]


@compiled
def kinematics(
    s: Any, w: Any, k: int, ux: float, uy: float, vx: float, vy: float, x: Array
) -> None:
    """w, omega, d and theta of point k (Eq. 4-7) into x: the body's velocity less the point's, its
    spin, the moment arm from its centre, its angle; (ux, uy) is the displacement and (vx, vy) its
    rate."""
    c = s.point_contact[k]
    frame, body, base = w.frame[c], s.contact_coordinate[c, 2], s.contact_coordinate[c, 5]
    px, py = s.point_X[k, 0] + ux, s.point_X[k, 1] + uy
    x[0], x[1], x[2] = frame[4] + frame[6] * py - vx, frame[5] - frame[6] * px - vy, w.V[body]
    x[3], x[4], x[5] = px - frame[2], py - frame[3], w.q[body] - w.q[base]


@compiled
def at_point(s: Any, k: int, nodal: Array) -> tuple[float, float]:
    """A nodal quantity (nodes, 2) at point k."""
    n0, n1, N0, N1 = s.point_node[k, 0], s.point_node[k, 1], s.point_N[k, 0], s.point_N[k, 1]
    return N0 * nodal[n0, 0] + N1 * nodal[n1, 0], N0 * nodal[n0, 1] + N1 * nodal[n1, 1]


@compiled
def apply_law(s: Any, w: Any, k: int, stretch: float, a: float) -> None:
    """The law at point k with its derivatives, into w.out and w.J, and its force at the nodes, into
    w.F."""
    c, x = s.point_contact[k], w.x[k]
    x[6], x[7], x[8] = stretch, s.point_weight[k], a
    own = s.p[bounds(s.contact_p_start, c)]
    call_linearise(s.contact_linearise[c], x, own, w.out[k], w.J[k])
    for j in range(2):
        for r in range(2):
            w.F[s.point_node[k, j], r] += s.point_N[k, j] * w.out[k, r]


@compiled
def mobility_scale(s: Any, pad: int, a: float) -> float:
    """Factor of the stored mobility: sum of J / (tau + a h) over the chain, by 1 / (E depth); 1 for
    inertial pads."""
    if s.pad_v_start[pad] >= 0:
        return 1.0
    at, n, p, total = s.pad_chain_at[pad], s.pad_branches[pad], s.p, 0.0
    for b in range(n):
        total += p[at + b] / (p[at + n + b] + a)
    return total * softness(s, pad)


@compiled
def softness(s: Any, pad: int) -> float:
    """1 / (E depth) of a massless pad [m/N]; its stored compliance is that for E depth = 1."""
    return s.p[s.pad_chain_at[pad] + 2 * s.pad_branches[pad]]


@compiled
def set_in(s: Any, w: Any, pad: int, y: Array, a: float) -> None:
    """Start of a stage: zeta = sum of J z and sum of J z / (tau + a h) over a massless pad's chain
    and its support (`w.low`, `w.high` come later); an inertial pad's u' without contact and motion
    of its base."""
    p = s.p
    first, last, start = s.pad_node_start[pad], s.pad_node_start[pad + 1], s.pad_y_start[pad]
    if s.pad_v_start[pad] >= 0:
        free_rates(s, w, pad, y, a)
        return
    at, n = s.pad_chain_at[pad], s.pad_branches[pad]
    zeta, rate = w.zeta[2 * first : 2 * last], w.zeta_rate[2 * first : 2 * last]
    for i in range(zeta.size):
        zeta[i], rate[i] = 0.0, 0.0
    for b in range(n):
        J, rest = p[at + b], p[at + b] / (p[at + n + b] + a)
        z = y[start + b * zeta.size : start + (b + 1) * zeta.size]
        for i in range(zeta.size):
            zeta[i] += J * z[i]
            rate[i] += rest * z[i]


@compiled
def branch_rate(s: Any, w: Any, pad: int, b: int, i: int, F: Array, y: Array, a: float) -> float:
    """Rate of the force that has set in at surface dof i of a massless pad, in branch b of its
    chain, under the nodal forces F (nodes, 2)."""
    first = s.pad_node_start[pad]
    size, node = 2 * (s.pad_node_start[pad + 1] - first), first + i // 2
    force = F[node, i % 2] if w.low[pad] <= node < w.high[pad] else 0.0
    tau = s.p[s.pad_chain_at[pad] + s.pad_branches[pad] + b]
    return (force - y[s.pad_y_start[pad] + b * size + i]) / (tau + a)


@compiled
def displacements(s: Any, w: Any, pad: int, y: Array, low: int, high: int) -> None:
    """u* and the rates without contact of the surface nodes from `low` to `high`, from the result
    of `set_in`."""
    first, last, start = s.pad_node_start[pad], s.pad_node_start[pad + 1], s.pad_y_start[pad]
    if s.pad_v_start[pad] >= 0:
        i0 = s.inertia_dof_start[pad]
        for i in range(2 * low, 2 * high):
            dof = s.inertia_surface[i]
            w.u[i // 2, i % 2], w.free[i // 2, i % 2] = y[start + dof], w.full[i0 + dof]
        return
    zeta, rate, size = (
        w.zeta[2 * first : 2 * last],
        w.zeta_rate[2 * first : 2 * last],
        2 * (last - first),
    )
    left, right = 0, size
    while left < right and abs(zeta[left]) < NEGLIGIBLE:
        left += 1
    while right > left and abs(zeta[right - 1]) < NEGLIGIBLE:
        right -= 1
    zeta, rate, soft = zeta[left:right], rate[left:right], softness(s, pad)
    for i in range(2 * low, 2 * high):
        row = row_of(s.pad_C, s.pad_C_start[pad], i - 2 * first, size)[left:right]
        w.u[i // 2, i % 2], w.free[i // 2, i % 2] = soft * dot(row, zeta), -soft * dot(row, rate)


@compiled
def scan(s: Any, w: Any, y: Array, margin: float) -> None:
    """List the points within `margin` [m] of touching at the stage's start, w.q, in `w.window`;
    needs `set_in`."""
    frames(s, w)
    x, phi = w.probe, w.phi
    for pad in range(s.pad_base.size):
        first, last = s.pad_node_start[pad], s.pad_node_start[pad + 1]
        displacements(s, w, pad, y, first, last)
        at = s.pad_point_start[pad]
        count, low, high = 0, last, first
        for k in range(at, s.pad_point_start[pad + 1]):
            c, n0, n1 = s.point_contact[k], s.point_node[k, 0], s.point_node[k, 1]
            ux, uy = at_point(s, k, w.u)
            kinematics(s, w, k, ux, uy, 0.0, 0.0, x)
            call_value(s.contact_distance[c], x, s.p[bounds(s.contact_p_start, c)], phi)
            if not phi[0] > margin:
                w.window[at + count] = k
                count += 1
                low, high = min(low, min(n0, n1)), max(high, max(n0, n1) + 1)
        for node in range(first, last):
            if node < w.low[pad] or node >= w.high[pad]:
                w.u_dot[node, 0], w.u_dot[node, 1] = w.free[node, 0], w.free[node, 1]
        w.windows[pad], w.low[pad], w.high[pad] = count, low, max(low, high)
    w.travelled[0], w.travelled[1], w.travelled[2] = 0.0, margin, w.travelled[2] + 1.0


@compiled
def evaluate(s: Any, w: Any, pad: int, y: Array, a: float) -> tuple[float, float]:
    """The law at the window's points with the trial rates in `w`, its forces at the nodes, and the
    touching points.

    Returns how far these forces are from the ones that the linear relations were solved with: the
    largest difference [N], and the sum of squares [N2].
    """
    at, count, actives = s.pad_point_start[pad], w.windows[pad], 0
    for node in range(w.low[pad], w.high[pad]):
        w.F[node, 0], w.F[node, 1] = 0.0, 0.0
    phi = w.phi
    for i in range(count):
        k = w.window[at + i]
        c = s.point_contact[k]
        ux, uy = at_point(s, k, w.u)
        vx, vy = at_point(s, k, w.u_dot)
        kinematics(s, w, k, ux + a * vx, uy + a * vy, vx, vy, w.x[k])
        call_value(s.contact_distance[c], w.x[k], s.p[bounds(s.contact_p_start, c)], phi)
        if phi[0] >= 0.0:
            continue
        apply_law(s, w, k, y[s.point_y_start + k], a)
        w.active[at + actives] = k
        actives += 1
    w.actives[pad] = actives
    mismatch, squares = 0.0, 0.0
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            off = abs(w.F[node, r] - w.F_linear[node, r])
            if not off <= mismatch:  # a force that is not a number is the largest
                mismatch = off
            squares += off * off
    return mismatch, squares


@compiled
def linearise(s: Any, w: Any, pad: int, a: float, outputs: int) -> None:
    """H and S of the law's first outputs, G and L of the touching points of a pad, from the law's
    Jacobians in `w.J`."""
    at = s.pad_point_start[pad]
    for i in range(w.actives[pad]):
        k = w.active[at + i]
        c = s.point_contact[k]
        cos, sin, rx, ry, vx, vy, spin = w.frame[c]
        dx, dy, fx, fy = w.x[k, 3], w.x[k, 4], w.out[k, 0], w.out[k, 1]
        px, py = dx + rx, dy + ry
        H, S, G, L = w.H[at + i], w.S[at + i], w.G[at + i], w.L[at + i]
        for r in range(outputs):
            J = w.J[k, r]
            S[r, 0], S[r, 1] = J[3] - spin * J[1], J[4] + spin * J[0]
            S[r, 2], S[r, 3], S[r, 4] = J[4] * sin - J[3] * cos, -J[3] * sin - J[4] * cos, J[5]
            S[r, 5], S[r, 6] = -S[r, 2], -S[r, 3]
            S[r, 7] = J[4] * rx - J[3] * ry + J[0] * vy - J[1] * vx - J[5]
            H[r, 0], H[r, 1] = a * S[r, 0] - J[0], a * S[r, 1] - J[1]
            tx, ty = J[0] * cos - J[1] * sin, J[0] * sin + J[1] * cos
            H[r, 2], H[r, 3], H[r, 4] = a * S[r, 2] + tx, a * S[r, 3] + ty, a * S[r, 4] + J[2]
            H[r, 5], H[r, 6], H[r, 7] = -H[r, 2], -H[r, 3], a * S[r, 7] + J[0] * py - J[1] * px
        G[0, 0], G[0, 1], G[1, 0], G[1, 1], G[2, 0], G[2, 1] = (
            -cos,
            sin,
            -sin,
            -cos,
            dy,
            -dx,
        )  # (16), (18), (19)
        G[3, 0], G[3, 1], G[4, 0], G[4, 1], G[5, 0], G[5, 1] = cos, -sin, sin, cos, -py, px
        X, Y = cos * fx - sin * fy, sin * fx + cos * fy
        L[:] = 0.0
        L[0, 7], L[1, 7], L[3, 7], L[4, 7] = Y, -X, -Y, X
        L[2, 0], L[2, 1], L[5, 0], L[5, 1] = -fy, fx, fy, -fx
        L[2, 2], L[2, 3], L[2, 5], L[2, 6], L[2, 7] = Y, -X, -Y, X, fy * ry + fx * rx


@compiled
def assemble(s: Any, w: Any, pad: int, a: float, Rv: Array) -> int:
    """The block of one pad: w.touched, w.slot, w.P, w.A, w.Hc, w.Rf, and its part in Rv (free,
    free). Returns how many nodes."""
    at, first = s.pad_point_start[pad], s.pad_node_start[pad]
    size, column = 2 * (s.pad_node_start[pad + 1] - first), s.pad_column[pad]
    n = 0
    for node in range(w.low[pad], w.high[pad]):
        w.slot[node] = -1
    for i in range(w.actives[pad]):
        for j in range(2):
            node = s.point_node[w.active[at + i], j]
            if s.point_N[w.active[at + i], j] != 0.0 and w.slot[node] < 0:
                w.slot[node], w.touched[first + n] = n, node
                n += 1
    A, P, Hc, Rf, scale = w.A, w.P, w.Hc, w.Rf, mobility_scale(s, pad, a)
    Hc[: 2 * n, : s.pad_columns[pad]] = 0.0
    Rf[: s.pad_columns[pad], : 2 * n] = 0.0
    for i in range(n):
        row = 2 * (w.touched[first + i] - first)
        for j in range(n):
            col = 2 * (w.touched[first + j] - first)
            for r in range(2):
                line = s.pad_C_start[pad] + (row + r) * size + col
                P[2 * i + r, 2 * j], P[2 * i + r, 2 * j + 1] = (
                    scale * s.pad_C[line],
                    scale * s.pad_C[line + 1],
                )
    for i in range(2 * n):
        A[i, : 2 * n] = 0.0
        A[i, i] = 1.0
    K, PB = w.K, w.PB
    for i in range(w.actives[pad]):
        k = w.active[at + i]
        c = s.point_contact[k]
        H, G, L = w.H[at + i], w.G[at + i], w.L[at + i]
        number = s.contact_number[c]
        PB[:, : 2 * n] = 0.0
        for j in range(2):
            N = s.point_N[k, j]
            if N != 0.0:
                row = 2 * w.slot[s.point_node[k, j]]
                for r in range(2):
                    add(N, P[row + r], PB[r, : 2 * n])
        for row in range(6):
            if number[row] < 0:
                continue
            for m in range(8):
                K[row, m] = G[row, 0] * H[0, m] + G[row, 1] * H[1, m] + a * L[row, m]
            for r in range(2):
                add(K[row, r], PB[r], Rf[column[number[row]], : 2 * n])
            for other in range(6):
                if number[other] >= 0:
                    Rv[number[row], number[other]] += K[row, 2 + other]
        for j in range(2):
            N = s.point_N[k, j]
            if N == 0.0:
                continue
            row = 2 * w.slot[s.point_node[k, j]]
            for r in range(2):
                for q in range(2):
                    add(-N * H[r, q], PB[q], A[row + r, : 2 * n])
                for other in range(6):
                    if number[other] >= 0:
                        Hc[row + r, column[number[other]]] += N * H[r, 2 + other]
        if s.pad_v_start[pad] >= 0:
            couple_point(s, w, pad, k, c, K, H, Rv)
    if s.pad_v_start[pad] >= 0:
        couple_base(s, w, pad, n, Rv)
    return n


@compiled
def restore(s: Any, w: Any, tape: Any, row: int, a: float, outputs: int) -> None:
    """Coordinates, touching points with the law's Jacobians there, H, S, G, L, nodal forces (w.F),
    displacements at the stage's start (w.u) and rates (w.u_dot) of points, by point number in the
    first columns of w.x's scratch."""
    put(tape.q[row], w.q)
    put(tape.V[row], w.V)
    frames(s, w)
    slot = 0
    for pad in range(s.pad_base.size):
        at = s.pad_point_start[pad]
        low, high = s.pad_node_start[pad + 1], s.pad_node_start[pad]
        w.actives[pad] = tape.count[row, pad]
        for i in range(w.actives[pad]):
            for j in range(2):
                node = s.point_node[tape.point[row, slot + i], j]
                low, high = min(low, node), max(high, node + 1)
        w.low[pad], w.high[pad] = min(low, high), high
        for node in range(low, high):
            w.F[node, 0], w.F[node, 1] = 0.0, 0.0
        for i in range(w.actives[pad]):
            k, state = tape.point[row, slot], tape.state[row, slot]
            ux, uy = state[0] + a * state[2], state[1] + a * state[3]
            kinematics(s, w, k, ux, uy, state[2], state[3], w.x[k])
            apply_law(s, w, k, tape.y[row, s.point_y_start + k], a)
            w.active[at + i] = k
            slot += 1
        linearise(s, w, pad, a, outputs)
