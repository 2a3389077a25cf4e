"""Condensed pads: massless and linear, on their surface alone.

The state are the nodal forces that have set in, z' = (F - z) / tau in every branch of the chain,
and u = C sum of J z. At the end of a stage, with rest = tau + a h,

    u' = free + P F,   P = C sum of J / rest,   free = -C sum of J z* / rest.
"""

from typing import Any

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.arrays import AXES
from torchsoft.solve.kernel.linear import add, dot, put
from torchsoft.solve.kernel.table import Array

NEGLIGIBLE = 1e-14
"""Nodal force that has set in [N] below which a node counts as never loaded: its displacements are
below rounding."""

NEGLIGIBLE_RATE = 1e-16
"""Change of a nodal force in a stage [N] that counts as none."""

NEGLIGIBLE_PART = 1e-17
"""Part of the largest derivative of nodal forces below which a node's counts as none."""


@compiled
def softness(rig: Any, pad: int) -> float:
    """1 / (E depth) [m/N]; the stored compliance is that for E depth = 1."""
    return rig.p[rig.condensed_chain_at[pad] + 2 * rig.condensed_branches[pad]]


@compiled
def mobility(rig: Any, pad: int, a: float) -> float:
    """Factor of the stored compliance in P: sum of J / rest, by 1 / (E depth)."""
    at, n, total = rig.condensed_chain_at[pad], rig.condensed_branches[pad], 0.0
    for b in range(n):
        total += rig.p[at + b] / (rig.p[at + n + b] + a)
    return total * softness(rig, pad)


@compiled
def size_of(rig: Any, pad: int) -> int:
    """Number of surface dofs."""
    return 2 * (rig.pad_node_start[pad + 1] - rig.pad_node_start[pad])


@compiled
def row_of(rig: Any, pad: int, dof: int) -> slice:
    """Row of a surface dof in the compliances."""
    start, size = rig.condensed_C_start[pad], size_of(rig, pad)
    return slice(start + dof * size, start + (dof + 1) * size)


@compiled
def branch_rate(
    rig: Any, work: Any, pad: int, b: int, i: int, F: Array, y: Array, a: float
) -> float:
    """Rate of the force that has set in at surface dof i, in branch b of the chain, under the nodal
    forces F (nodes, 2)."""
    size, node = size_of(rig, pad), rig.pad_node_start[pad] + i // 2
    force = F[node, i % 2] if work.low[pad] <= node < work.high[pad] else 0.0
    tau = rig.p[rig.condensed_chain_at[pad] + rig.condensed_branches[pad] + b]
    return (force - y[rig.pad_y_start[pad] + b * size + i]) / (tau + a)


@compiled
def begin(rig: Any, work: Any, pad: int, y: Array, a: float) -> None:
    """Start of a stage: zeta = sum of J z and sum of J z / rest."""
    p, first, start = rig.p, rig.pad_node_start[pad], rig.pad_y_start[pad]
    last = rig.pad_node_start[pad + 1]
    at, n = rig.condensed_chain_at[pad], rig.condensed_branches[pad]
    zeta, rate = work.zeta[2 * first : 2 * last], work.zeta_rate[2 * first : 2 * last]
    for i in range(zeta.size):
        zeta[i], rate[i] = 0.0, 0.0
    for b in range(n):
        J, rest = p[at + b], p[at + b] / (p[at + n + b] + a)
        z = y[start + b * zeta.size : start + (b + 1) * zeta.size]
        for i in range(zeta.size):
            zeta[i] += J * z[i]
            rate[i] += rest * z[i]


@compiled
def displace(rig: Any, work: Any, pad: int, low: int, high: int) -> None:
    """u* and the rates without contact of the surface nodes from `low` to `high`, from the result
    of `begin`."""
    first, last = rig.pad_node_start[pad], rig.pad_node_start[pad + 1]
    zeta, rate = work.zeta[2 * first : 2 * last], work.zeta_rate[2 * first : 2 * last]
    left, right = 0, 2 * (last - first)
    while left < right and abs(zeta[left]) < NEGLIGIBLE:
        left += 1
    while right > left and abs(zeta[right - 1]) < NEGLIGIBLE:
        right -= 1
    zeta, rate, soft = zeta[left:right], rate[left:right], softness(rig, pad)
    for i in range(2 * low, 2 * high):
        row = rig.condensed_C[row_of(rig, pad, i - 2 * first)][left:right]
        work.u[i // 2, i % 2], work.free[i // 2, i % 2] = (
            soft * dot(row, zeta),
            -soft * dot(row, rate),
        )


@compiled
def relation(rig: Any, work: Any, pad: int, a: float) -> None:
    """The mobility between the touched nodes into work.P."""
    first, n, start = rig.pad_node_start[pad], work.counts[pad], rig.condensed_C_start[pad]
    P, size, scale = work.P, size_of(rig, pad), mobility(rig, pad, a)
    for i in range(n):
        row = 2 * (work.touched[first + i] - first)
        for j in range(n):
            col = 2 * (work.touched[first + j] - first)
            for r in range(2):
                line = start + (row + r) * size + col
                P[2 * i + r, 2 * j] = scale * rig.condensed_C[line]
                P[2 * i + r, 2 * j + 1] = scale * rig.condensed_C[line + 1]


@compiled
def propose(rig: Any, work: Any, pad: int, a: float) -> None:
    """Nodal rates work.u_dot_new under the forces work.F_new, in the window."""
    first, scale = rig.pad_node_start[pad], mobility(rig, pad, a)
    low, high = 2 * work.low[pad], 2 * work.high[pad]
    rates = work.u_dot_new[low:high]
    for i in range(rates.size):
        rates[i] = work.free[(low + i) // 2, i % 2]
    for i in range(work.counts[pad]):
        node = work.touched[first + i]
        for r in range(2):
            row = rig.condensed_C[row_of(rig, pad, 2 * (node - first) + r)]
            add(scale * work.F_new[node, r], row[low - 2 * first :], rates)


@compiled
def quadratic(rig: Any, pad: int, x: Array, low: int, high: int) -> float:
    """x C x of a vector of surface dofs that is zero but from `low` to `high`, with the stored
    compliance C."""
    total, inside = 0.0, x[low:high]
    for m in range(inside.size):
        row = rig.condensed_C[row_of(rig, pad, low + m)]
        total += inside[m] * dot(inside, row[low:])
    return total


@compiled
def stored(rig: Any, pad: int, y: Array) -> float:
    """Strain energy of the pad [J] in a state."""
    size, chain, total = size_of(rig, pad), rig.condensed_chain_at[pad], 0.0
    for b in range(rig.condensed_branches[pad]):
        start = rig.pad_y_start[pad] + b * size
        z, low, high = y[start : start + size], 0, size
        while low < high and abs(z[low]) < NEGLIGIBLE:
            low += 1
        while high > low and abs(z[high - 1]) < NEGLIGIBLE:
            high -= 1
        total += 0.5 * rig.p[chain + b] * quadratic(rig, pad, z, low, high)
    return softness(rig, pad) * total


@compiled
def finish(rig: Any, work: Any, pad: int, y: Array, a: float, powers: Array) -> float:
    """Rates of the forces that have set in into work.k, and the power [W] that the pad dissipates;
    returns a bound of its nodes' speeds [m/s]."""
    p, k, size, start = rig.p, work.k, size_of(rig, pad), rig.pad_y_start[pad]
    chain, branches = rig.condensed_chain_at[pad], rig.condensed_branches[pad]
    total = 0.0
    for b in range(branches):
        J, tau, z = p[chain + b], p[chain + branches + b], start + b * size
        low, high = size, 0
        for m in range(size):
            rate = branch_rate(rig, work, pad, b, m, work.F_linear, y, a)
            k[z + m] = rate
            if abs(rate) * a > NEGLIGIBLE_RATE:
                low, high = min(low, m), m + 1
                total += J * abs(rate)
        power = quadratic(rig, pad, k[z : z + size], low, high)
        powers[pad] += J * tau * power * softness(rig, pad)
    return total * rig.condensed_reach[pad] * softness(rig, pad)


# Tangent.


@compiled
def find_span(rig: Any, pad: int, y: Array, dy: Array, span: Array) -> None:
    """The first surface dof that is loaded or has a derivative, and the end; negligible derivatives
    become zero."""
    size, start = size_of(rig, pad), rig.pad_y_start[pad]
    span[pad, 0], span[pad, 1] = size, 0
    for b in range(rig.condensed_branches[pad]):
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
def push(
    rig: Any, work: Any, along: Any, pad: int, y: Array, dy: Array, dp: Array, a: float
) -> None:
    """Derivatives of u* (along.u) and of u' before the forces' own change (along.rate) at the
    touched nodes."""
    p, first, start, m = rig.p, rig.pad_node_start[pad], rig.pad_y_start[pad], dy.shape[1]
    size, chain, branches = (
        size_of(rig, pad),
        rig.condensed_chain_at[pad],
        rig.condensed_branches[pad],
    )
    material, span, du, dv = chain + 2 * branches, along.span, along.u, along.rate
    left = min(span[pad, 0], 2 * (work.low[pad] - first))
    right = max(span[pad, 1], 2 * (work.high[pad] - first))
    span[pad, 0], span[pad, 1] = left, right
    zeta, z_dot, dzeta, dz_dot = along.zeta, along.z_dot, along.dzeta, along.dz_dot
    zeta[:], z_dot[:], dzeta[:], dz_dot[:] = 0.0, 0.0, 0.0, 0.0
    for b in range(branches):
        J, rest, at = p[chain + b], p[chain + branches + b] + a, start + b * size
        for i in range(left, right):
            rate = branch_rate(rig, work, pad, b, i, work.F, y, a)
            zeta[i] += J * y[at + i]
            z_dot[i] += J * rate
            add(J, dy[at + i], dzeta[i])
            add(y[at + i], dp[chain + b], dzeta[i])
            add(rate, dp[chain + b], dz_dot[i])
            add(-J / rest, dy[at + i], dz_dot[i])
            add(-J / rest * rate, dp[chain + branches + b], dz_dot[i])
    stiffer, soft = False, softness(rig, pad)
    for k in range(m):
        stiffer |= dp[material + 1, k] != 0.0
    for i in range(left, right):  # C is proportional to the material's first entry
        add(zeta[i] / p[material], dp[material], dzeta[i])
        add(z_dot[i] / p[material], dp[material], dz_dot[i])
    for i in range(work.counts[pad]):
        node = work.touched[first + i]
        for r in range(2):
            dof = 2 * (node - first) + r
            row = rig.condensed_C[row_of(rig, pad, dof)]
            u, v = du[node, r], dv[node, r]
            u[:], v[:] = 0.0, 0.0
            for j in range(left, right):
                add(soft * row[j], dzeta[j], u)
                add(soft * row[j], dz_dot[j], v)
            if stiffer:
                row = rig.condensed_dC[row_of(rig, pad, dof)][left:right]
                add(soft * dot(row, zeta[left:]), dp[material + 1], u)
                add(soft * dot(row, z_dot[left:]), dp[material + 1], v)


@compiled
def push_rates(rig: Any, work: Any, along: Any, pad: int, a: float, X: Array) -> None:
    """Tangents of the touched nodes' rates, less along.rate, under those of the nodal forces X."""
    first, n, scale = rig.pad_node_start[pad], work.counts[pad], mobility(rig, pad, a)
    for i in range(n):
        for o in range(2):
            dof = 2 * (work.touched[first + i] - first) + o
            row = rig.condensed_C[row_of(rig, pad, dof)]
            for j in range(n):
                for q in range(2):
                    c = scale * row[2 * (work.touched[first + j] - first) + q]
                    add(c, X[2 * j + q], along.touched_rate[i, o])


@compiled
def push_state(
    rig: Any, work: Any, along: Any, pad: int, y: Array, a: float, X: Array, dy: Array, dp: Array
) -> None:
    """Tangents of the state at the stage's end."""
    first, size, start = rig.pad_node_start[pad], size_of(rig, pad), rig.pad_y_start[pad]
    chain, branches, span = rig.condensed_chain_at[pad], rig.condensed_branches[pad], along.span
    for b in range(branches):
        part, first_z = a / (rig.p[chain + branches + b] + a), start + b * size
        for i in range(span[pad, 0], span[pad, 1]):
            z_dot = branch_rate(rig, work, pad, b, i, work.F, y, a)
            add(-part, dy[first_z + i], dy[first_z + i])
            add(-part * z_dot, dp[chain + branches + b], dy[first_z + i])
        for i in range(work.counts[pad]):
            for o in range(2):
                dof = first_z + 2 * (work.touched[first + i] - first) + o
                add(part, X[2 * i + o], dy[dof])


# Adjoint.


@compiled
def pull_forces(rig: Any, work: Any, along: Any, pad: int, y_bar: Array, a: float) -> None:
    """Cotangents of the touched nodes' forces into the first column of work.X, from those of the
    state and of the nodes' rates, along.touched_rate."""
    first, size = rig.pad_node_start[pad], size_of(rig, pad)
    chain, branches = rig.condensed_chain_at[pad], rig.condensed_branches[pad]
    rate_bar = along.by_rate[: AXES * work.counts[pad]]
    put(along.touched_rate[: work.counts[pad]], rate_bar)
    for i in range(work.counts[pad]):
        for r in range(AXES):
            dof = AXES * (work.touched[first + i] - first) + r
            total = dot(rate_bar, work.P[AXES * i + r])
            for branch in range(branches):
                z_bar = y_bar[rig.pad_y_start[pad] + branch * size + dof, 0]
                total += a * z_bar / (rig.p[chain + branches + branch] + a)
            work.X[AXES * (first + i) + r, 0] = total


@compiled
def pull_state(
    rig: Any, work: Any, along: Any, pad: int, y: Array, y_bar: Array, a: float, p_bar: Array
) -> None:
    """Cotangents of the state at the stage's start and of the material, from those of the nodal
    rates and displacements, along.rate and along.u."""
    p, first, start, size = rig.p, rig.pad_node_start[pad], rig.pad_y_start[pad], size_of(rig, pad)
    chain, branches = rig.condensed_chain_at[pad], rig.condensed_branches[pad]
    material, soft = chain + 2 * branches, softness(rig, pad)
    zeta, z_dot = along.zeta[:size], along.z_dot[:size]
    by_u, by_rate = along.by_u[:size], along.by_rate[:size]
    zeta[:], z_dot[:], by_u[:], by_rate[:] = 0.0, 0.0, 0.0, 0.0
    for node in range(work.low[pad], work.high[pad]):
        for r in range(AXES):
            c, d = soft * along.rate[node, r, 0], soft * along.u[node, r, 0]
            if c != 0.0 or d != 0.0:
                row = rig.condensed_C[row_of(rig, pad, AXES * (node - first) + r)]
                add(c, row, by_rate)
                add(d, row, by_u)
    scale_bar, left, right = 0.0, size, 0
    for b in range(branches):
        J, rest, z = p[chain + b], p[chain + branches + b] + a, start + b * size
        J_bar = tau_bar = 0.0
        for m in range(size):
            total = (a * y_bar[z + m, 0] + J * by_rate[m]) / rest
            rate = branch_rate(rig, work, pad, b, m, work.F, y, a)
            if abs(rate) * rest > NEGLIGIBLE or abs(y[z + m]) > NEGLIGIBLE:
                left, right = min(left, m), m + 1 if m + 1 > right else right
                zeta[m] += J * y[z + m]
                z_dot[m] += J * rate
                J_bar += by_rate[m] * rate + by_u[m] * y[z + m]
                tau_bar -= total * rate
            y_bar[z + m, 0] += J * by_u[m] - total
        p_bar[chain + b, 0] += J_bar
        p_bar[chain + branches + b, 0] += tau_bar
        scale_bar += J * J_bar
    p_bar[material, 0] += scale_bar / p[material]
    for node in range(work.low[pad], work.high[pad]):
        for r in range(AXES):
            c, d = soft * along.rate[node, r, 0], soft * along.u[node, r, 0]
            if c != 0.0 or d != 0.0:
                row = rig.condensed_dC[row_of(rig, pad, AXES * (node - first) + r)][left:right]
                p_bar[material + 1, 0] += c * dot(row, z_dot[left:]) + d * dot(row, zeta[left:])
