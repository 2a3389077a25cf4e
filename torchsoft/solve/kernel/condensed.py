"""Condensed pads: massless and linear, on their surface alone.

The state are the nodal forces that have set in, z' = (F - z) / tau in every branch of the chain,
and u = C sum of J z. At the end of a stage, with rest = tau + a h,

    u' = free + P F,   P = C sum of J / rest,   free = -C sum of J z* / rest.
"""

from typing import Any

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.linear import add, dot, row_of
from torchsoft.solve.kernel.table import Array

NEGLIGIBLE = 1e-14
"""Nodal force that has set in [N] below which a node counts as never loaded: its displacements are
below rounding."""

NEGLIGIBLE_RATE = 1e-16
"""Change of a nodal force in a stage [N] that counts as none."""

NEGLIGIBLE_PART = 1e-17
"""Part of the largest derivative of nodal forces below which a node's counts as none."""


@compiled
def softness(s: Any, pad: int) -> float:
    """1 / (E depth) [m/N]; the stored compliance is that for E depth = 1."""
    return s.p[s.condensed_chain_at[pad] + 2 * s.condensed_branches[pad]]


@compiled
def mobility(s: Any, pad: int, a: float) -> float:
    """Factor of the stored compliance in P: sum of J / rest, by 1 / (E depth)."""
    at, n, total = s.condensed_chain_at[pad], s.condensed_branches[pad], 0.0
    for b in range(n):
        total += s.p[at + b] / (s.p[at + n + b] + a)
    return total * softness(s, pad)


@compiled
def size_of(s: Any, pad: int) -> int:
    """Number of surface dofs."""
    return 2 * (s.pad_node_start[pad + 1] - s.pad_node_start[pad])


@compiled
def branch_rate(s: Any, w: Any, pad: int, b: int, i: int, F: Array, y: Array, a: float) -> float:
    """Rate of the force that has set in at surface dof i, in branch b of the chain, under the nodal
    forces F (nodes, 2)."""
    size, node = size_of(s, pad), s.pad_node_start[pad] + i // 2
    force = F[node, i % 2] if w.low[pad] <= node < w.high[pad] else 0.0
    tau = s.p[s.condensed_chain_at[pad] + s.condensed_branches[pad] + b]
    return (force - y[s.pad_y_start[pad] + b * size + i]) / (tau + a)


@compiled
def begin(s: Any, w: Any, pad: int, y: Array, a: float) -> None:
    """Start of a stage: zeta = sum of J z and sum of J z / rest."""
    p, first, start = s.p, s.pad_node_start[pad], s.pad_y_start[pad]
    last = s.pad_node_start[pad + 1]
    at, n = s.condensed_chain_at[pad], s.condensed_branches[pad]
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
def displace(s: Any, w: Any, pad: int, low: int, high: int) -> None:
    """u* and the rates without contact of the surface nodes from `low` to `high`, from the result
    of `begin`."""
    first, last = s.pad_node_start[pad], s.pad_node_start[pad + 1]
    zeta, rate = w.zeta[2 * first : 2 * last], w.zeta_rate[2 * first : 2 * last]
    left, right, size = 0, 2 * (last - first), 2 * (last - first)
    while left < right and abs(zeta[left]) < NEGLIGIBLE:
        left += 1
    while right > left and abs(zeta[right - 1]) < NEGLIGIBLE:
        right -= 1
    zeta, rate, soft = zeta[left:right], rate[left:right], softness(s, pad)
    for i in range(2 * low, 2 * high):
        row = row_of(s.condensed_C, s.condensed_C_start[pad], i - 2 * first, size)[left:right]
        w.u[i // 2, i % 2], w.free[i // 2, i % 2] = soft * dot(row, zeta), -soft * dot(row, rate)


@compiled
def relation(s: Any, w: Any, pad: int, a: float) -> None:
    """The mobility between the touched nodes into w.P."""
    first, n, start = s.pad_node_start[pad], w.counts[pad], s.condensed_C_start[pad]
    P, size, scale = w.P, size_of(s, pad), mobility(s, pad, a)
    for i in range(n):
        row = 2 * (w.touched[first + i] - first)
        for j in range(n):
            col = 2 * (w.touched[first + j] - first)
            for r in range(2):
                line = start + (row + r) * size + col
                P[2 * i + r, 2 * j] = scale * s.condensed_C[line]
                P[2 * i + r, 2 * j + 1] = scale * s.condensed_C[line + 1]


@compiled
def propose(s: Any, w: Any, pad: int, a: float) -> None:
    """Nodal rates w.u_dot_new under the forces w.F_new, in the window."""
    first, start, size = s.pad_node_start[pad], s.condensed_C_start[pad], size_of(s, pad)
    scale, low, high = mobility(s, pad, a), 2 * w.low[pad], 2 * w.high[pad]
    rates = w.u_dot_new[low:high]
    for i in range(rates.size):
        rates[i] = w.free[(low + i) // 2, i % 2]
    for i in range(w.counts[pad]):
        node = w.touched[first + i]
        for r in range(2):
            row = row_of(s.condensed_C, start, 2 * (node - first) + r, size)
            add(scale * w.F_new[node, r], row[low - 2 * first :], rates)


@compiled
def quadratic(s: Any, pad: int, x: Array, low: int, high: int) -> float:
    """x C x of a vector of surface dofs that is zero but from `low` to `high`, with the stored
    compliance C."""
    total, size, inside = 0.0, size_of(s, pad), x[low:high]
    for m in range(inside.size):
        row = row_of(s.condensed_C, s.condensed_C_start[pad], low + m, size)
        total += inside[m] * dot(inside, row[low:])
    return total


@compiled
def stored(s: Any, pad: int, y: Array) -> float:
    """Strain energy of the pad [J] in a state."""
    size, chain, total = size_of(s, pad), s.condensed_chain_at[pad], 0.0
    for b in range(s.condensed_branches[pad]):
        start = s.pad_y_start[pad] + b * size
        z, low, high = y[start : start + size], 0, size
        while low < high and abs(z[low]) < NEGLIGIBLE:
            low += 1
        while high > low and abs(z[high - 1]) < NEGLIGIBLE:
            high -= 1
        total += 0.5 * s.p[chain + b] * quadratic(s, pad, z, low, high)
    return softness(s, pad) * total


@compiled
def finish(s: Any, w: Any, pad: int, y: Array, a: float, powers: Array) -> float:
    """Rates of the forces that have set in into w.k, and the power [W] that the pad dissipates;
    returns a bound of its nodes' speeds [m/s]."""
    p, k, size, start = s.p, w.k, size_of(s, pad), s.pad_y_start[pad]
    chain, branches = s.condensed_chain_at[pad], s.condensed_branches[pad]
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
        power = quadratic(s, pad, k[z : z + size], low, high)
        powers[pad] += J * tau * power * softness(s, pad)
    return total * s.condensed_reach[pad] * softness(s, pad)


# Tangent.


@compiled
def find_span(s: Any, pad: int, y: Array, dy: Array, span: Array) -> None:
    """The first surface dof that is loaded or has a derivative, and the end; negligible derivatives
    become zero."""
    size, start = size_of(s, pad), s.pad_y_start[pad]
    span[pad, 0], span[pad, 1] = size, 0
    for b in range(s.condensed_branches[pad]):
        rows = dy[start + b * size : start + (b + 1) * size]
        for k in range(dy.shape[1]):
            largest = 0.0
            for i in range(size):
                largest = max(largest, abs(rows[i, k]))
            for i in range(size):
                if (
                    abs(rows[i, k]) > NEGLIGIBLE_PART * largest
                    or abs(y[start + b * size + i]) > NEGLIGIBLE
                ):
                    span[pad, 0], span[pad, 1] = min(span[pad, 0], i), max(span[pad, 1], i + 1)
                else:
                    rows[i, k] = 0.0


@compiled
def push(s: Any, w: Any, z: Any, pad: int, y: Array, dy: Array, dp: Array, a: float) -> None:
    """Derivatives of u* (z.u) and of u' before the forces' own change (z.v) at the touched
    nodes."""
    p, first, start, m = s.p, s.pad_node_start[pad], s.pad_y_start[pad], dy.shape[1]
    size, chain, branches = size_of(s, pad), s.condensed_chain_at[pad], s.condensed_branches[pad]
    material, span, du, dv = chain + 2 * branches, z.span, z.u, z.v
    left = min(span[pad, 0], 2 * (w.low[pad] - first))
    right = max(span[pad, 1], 2 * (w.high[pad] - first))
    span[pad, 0], span[pad, 1] = left, right
    zeta, rate, dzeta, drate = z.zeta, z.rate, z.dzeta, z.drate
    zeta[:], rate[:], dzeta[:], drate[:] = 0.0, 0.0, 0.0, 0.0
    for b in range(branches):
        J, rest, at = p[chain + b], p[chain + branches + b] + a, start + b * size
        for i in range(left, right):
            z_dot = branch_rate(s, w, pad, b, i, w.F, y, a)
            zeta[i] += J * y[at + i]
            rate[i] += J * z_dot
            add(J, dy[at + i], dzeta[i])
            add(y[at + i], dp[chain + b], dzeta[i])
            add(z_dot, dp[chain + b], drate[i])
            add(-J / rest, dy[at + i], drate[i])
            add(-J / rest * z_dot, dp[chain + branches + b], drate[i])
    stiffer, soft = False, softness(s, pad)
    for k in range(m):
        stiffer |= dp[material + 1, k] != 0.0
    for i in range(left, right):  # C is proportional to the material's first entry
        add(zeta[i] / p[material], dp[material], dzeta[i])
        add(rate[i] / p[material], dp[material], drate[i])
    for i in range(w.counts[pad]):
        node = w.touched[first + i]
        for r in range(2):
            dof = 2 * (node - first) + r
            row = row_of(s.condensed_C, s.condensed_C_start[pad], dof, size)
            u, v = du[node, r], dv[node, r]
            u[:], v[:] = 0.0, 0.0
            for j in range(left, right):
                add(soft * row[j], dzeta[j], u)
                add(soft * row[j], drate[j], v)
            if stiffer:
                row = row_of(s.condensed_dC, s.condensed_C_start[pad], dof, size)[left:right]
                add(soft * dot(row, zeta[left:]), dp[material + 1], u)
                add(soft * dot(row, rate[left:]), dp[material + 1], v)


@compiled
def push_rates(s: Any, w: Any, z: Any, pad: int, a: float, X: Array) -> None:
    """Tangents of the touched nodes' rates, less z.v, under those of the nodal forces X."""
    first, n, size, scale = (
        s.pad_node_start[pad],
        w.counts[pad],
        size_of(s, pad),
        mobility(s, pad, a),
    )
    for i in range(n):
        for o in range(2):
            dof = 2 * (w.touched[first + i] - first) + o
            row = row_of(s.condensed_C, s.condensed_C_start[pad], dof, size)
            for j in range(n):
                for q in range(2):
                    c = scale * row[2 * (w.touched[first + j] - first) + q]
                    add(c, X[2 * j + q], z.own_rate[i, o])


@compiled
def push_state(
    s: Any, w: Any, z: Any, pad: int, y: Array, a: float, X: Array, dy: Array, dp: Array
) -> None:
    """Tangents of the state at the stage's end."""
    first, size, start = s.pad_node_start[pad], size_of(s, pad), s.pad_y_start[pad]
    chain, branches, span = s.condensed_chain_at[pad], s.condensed_branches[pad], z.span
    for b in range(branches):
        part, first_z = a / (s.p[chain + branches + b] + a), start + b * size
        for i in range(span[pad, 0], span[pad, 1]):
            z_dot = branch_rate(s, w, pad, b, i, w.F, y, a)
            add(-part, dy[first_z + i], dy[first_z + i])
            add(-part * z_dot, dp[chain + branches + b], dy[first_z + i])
        for i in range(w.counts[pad]):
            for o in range(2):
                dof = first_z + 2 * (w.touched[first + i] - first) + o
                add(part, X[2 * i + o], dy[dof])


# Adjoint.


@compiled
def pull_forces(s: Any, w: Any, pad: int, y_bar: Array, a: float, b: Array, X: Array) -> None:
    """Cotangents of the touched nodes' forces into X[:, 0], from those of the state and of the
    nodal rates, b."""
    first, size = s.pad_node_start[pad], size_of(s, pad)
    chain, branches = s.condensed_chain_at[pad], s.condensed_branches[pad]
    for i in range(w.counts[pad]):
        for r in range(2):
            dof, total = 2 * (w.touched[first + i] - first) + r, dot(b, w.P[2 * i + r])
            for branch in range(branches):
                z_bar = y_bar[s.pad_y_start[pad] + branch * size + dof]
                total += a * z_bar / (s.p[chain + branches + branch] + a)
            X[2 * i + r, 0] = total


@compiled
def pull_state(
    s: Any, w: Any, scratch: Any, pad: int, y: Array, y_bar: Array, a: float, p_bar: Array
) -> None:
    """Cotangents of the state at the stage's start and of the material, from those of the nodal
    rates and displacements, `scratch.rate` and `scratch.u`."""
    p, first, start = s.p, s.pad_node_start[pad], s.pad_y_start[pad]
    size, start_C = size_of(s, pad), s.condensed_C_start[pad]
    chain, branches = s.condensed_chain_at[pad], s.condensed_branches[pad]
    material, soft = chain + 2 * branches, softness(s, pad)
    by_rate, by_u = scratch.surface[0], scratch.surface[1]
    zeta, z_dot = scratch.surface[2], scratch.surface[3]
    scratch.surface[:, :size] = 0.0
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            c, d = soft * scratch.rate[node, r], soft * scratch.u[node, r]
            if c != 0.0 or d != 0.0:
                row = row_of(s.condensed_C, start_C, 2 * (node - first) + r, size)
                add(c, row, by_rate[:size])
                add(d, row, by_u[:size])
    scale_bar, left, right = 0.0, size, 0
    for b in range(branches):
        J, rest, z = p[chain + b], p[chain + branches + b] + a, start + b * size
        J_bar = tau_bar = 0.0
        for m in range(size):
            total = (a * y_bar[z + m] + J * by_rate[m]) / rest
            rate = branch_rate(s, w, pad, b, m, w.F, y, a)
            if abs(rate) * rest > NEGLIGIBLE or abs(y[z + m]) > NEGLIGIBLE:
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
            c, d = soft * scratch.rate[node, r], soft * scratch.u[node, r]
            if c != 0.0 or d != 0.0:
                row = row_of(s.condensed_dC, start_C, 2 * (node - first) + r, size)[left:right]
                p_bar[material + 1] += c * dot(row, z_dot[left:]) + d * dot(row, zeta[left:])
