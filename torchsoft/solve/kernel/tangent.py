"""The tangent stage: forward sensitivities of `run` in several directions at once.

One factorisation of Newton's system a stage, as many right-hand sides as there are directions. A
`d` before a name is its derivative, the last axis counts directions.
"""

from typing import Any

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.arrays import FELT, GAMMA, INSTANT, MIX, STEPPED
from torchsoft.solve.kernel.inertia import (
    add_stiffness,
    base_velocity,
    solve,
    stiffness_force,
    to_base,
    to_world,
)
from torchsoft.solve.kernel.interface import (
    NEGLIGIBLE,
    assemble,
    branch_rate,
    mobility_scale,
    restore,
    softness,
)
from torchsoft.solve.kernel.invoke import call_linearise, call_pullback
from torchsoft.solve.kernel.linear import add, bounds, dot, put, row_of, solve_dense
from torchsoft.solve.kernel.stage import actuate, balance, coordinates_at, eliminate
from torchsoft.solve.kernel.step import dense_states
from torchsoft.solve.kernel.table import Array

NEGLIGIBLE_PART = 1e-17
"""Part of the largest derivative of nodal forces below which a node's counts as none."""

RESCAN = 64
"""Steps between two searches for negligible derivatives."""


@compiled
def law_derivatives(
    z: Any, address: int, x: Array, p: Array, dp: Array, rows: int, out: Array
) -> None:
    """d law / dp along dp (parameters, m), with x held, into out (rows, m)."""
    weights, gradient = z.weights, z.gradient[: p.size]
    weights[:] = 0.0
    for r in range(rows):
        gradient[:] = 0.0
        weights[r] = 1.0
        call_pullback(address, x, p, weights, gradient)
        weights[r] = 0.0
        out[r] = 0.0
        for j in range(p.size):
            add(gradient[j], dp[j], out[r])


@compiled
def find_span(s: Any, y: Array, dy: Array, span: Array) -> None:
    """Per pad the first surface dof that is loaded or has a derivative, and the end; negligible
    derivatives become zero."""
    for pad in range(s.pad_base.size):
        size, start = 2 * (s.pad_node_start[pad + 1] - s.pad_node_start[pad]), s.pad_y_start[pad]
        span[pad, 0], span[pad, 1] = size, 0
        if s.pad_v_start[pad] >= 0:
            continue
        for b in range(s.pad_branches[pad]):
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
def massless_part(
    s: Any, w: Any, z: Any, pad: int, y: Array, dy: Array, dp: Array, a: float
) -> None:
    """Derivatives of u* (du) and of u' before the forces' own change (dv) at the loaded nodes,
    (nodes, 2, m)."""
    p, first, start, m = s.p, s.pad_node_start[pad], s.pad_y_start[pad], dy.shape[1]
    size, chain, branches = (
        2 * (s.pad_node_start[pad + 1] - first),
        s.pad_chain_at[pad],
        s.pad_branches[pad],
    )
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
            row, u, v = row_of(s.pad_C, s.pad_C_start[pad], dof, size), du[node, r], dv[node, r]
            u[:], v[:] = 0.0, 0.0
            for j in range(left, right):
                add(soft * row[j], dzeta[j], u)
                add(soft * row[j], drate[j], v)
            if stiffer:
                row = row_of(s.pad_dC, s.pad_C_start[pad], dof, size)[left:right]
                add(soft * dot(row, zeta[left:]), dp[material + 1], u)
                add(soft * dot(row, rate[left:]), dp[material + 1], v)


@compiled
def inertial_part(
    s: Any,
    w: Any,
    z: Any,
    pad: int,
    y: Array,
    dy: Array,
    dp: Array,
    a: float,
    rate: Array,
    r: Array,
) -> None:
    """The same for an inertial pad; z.free (dofs, m) receives dv of all its dofs, and r the base's
    reaction."""
    at = s.inertia_material_at[pad]
    i0, i1 = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1]
    U, W, base = s.pad_y_start[pad], s.pad_v_start[pad], s.pad_base[pad]
    n, mass, tau = i1 - i0, s.p[at + 3], s.p[at + 2]
    vx, vy = base_velocity(s, w, pad)
    own, force, column, strain = (
        w.inertial[0, i0:i1],
        w.inertial[1, i0:i1],
        w.inertial[2, i0:i1],
        w.inertial[3, i0:i1],
    )
    here, du, dv, free = rate[i0:i1], z.u, z.v, z.free
    stiffness_force(s, pad, here, force)
    for i in range(n):
        strain[i] = y[U + i] + (tau + a) * here[i]
    for k in range(dy.shape[1]):
        for i in range(n):
            column[i] = dy[U + i, k]
        stiffness_force(s, pad, column, own)
        add_stiffness(s, pad, dp[at:, k], strain, own)
        for i in range(n):
            M = s.inertia_area[i0 + i] / a
            v_dot = here[i] + (vx if i % 2 == 0 else vy) - y[W + i]
            column[i] = M * (mass * dy[W + i, k] - dp[at + 3, k] * v_dot)
            column[i] -= own[i] + force[i] * dp[at + 2, k]
        solve(s, pad, column)
        along = across = 0.0
        for i in range(n):
            free[i0 + i, k] = column[i]
            M = s.inertia_area[i0 + i] / a
            v_dot = here[i] + (vx if i % 2 == 0 else vy) - y[W + i]
            change = M * (mass * (column[i] - dy[W + i, k]) + dp[at + 3, k] * v_dot)
            if i % 2 == 0:
                along += change
            else:
                across += change
        push = to_world(s, w, pad, along, across)
        for axis in range(2):
            number = s.body_free[base + axis]
            if number >= 0:
                r[number, k] -= push[axis]
        for i in range(w.counts[pad]):
            node = w.touched[s.pad_node_start[pad] + i]
            for axis in range(2):
                dof = s.inertia_surface[2 * node + axis]
                du[node, axis, k], dv[node, axis, k] = dy[U + dof, k], column[dof]


@compiled
def stage_tangent(
    s: Any, w: Any, z: Any, tape: Any, row: int, a: float, signals: Array, dy: Array, dp: Array,
    felt: bool,
) -> None:  # fmt: skip
    """Turn the tangent dy (size, m) of a stage's y* into that of its end, in place, or if `felt`
    leave it and put those of its forces into z.recorded; dp (parameters, m)."""
    p, outputs = s.p, FELT if felt else STEPPED
    free, count, y, m = s.body_coordinate.size, s.pad_base.size, tape.y[row], dy.shape[1]
    restore(s, w, tape, row, a, outputs)
    if felt:
        z.recorded[:] = 0.0
    Rv, r, du, dv = w.Rv, z.r, z.u, z.v
    balance(s, w, y, signals, a, w.r, Rv)
    for i in range(free):
        c, mass = s.body_coordinate[i], p[s.body_mass_at[i]]
        rate = (w.V[c] - y[s.body_V_start + i]) / a
        for k in range(m):
            r[i, k] = mass * dy[s.body_V_start + i, k] / a - rate * dp[s.body_mass_at[i], k]
            r[i, k] -= s.body_weight[i] * (
                dp[s.body_mass_at[i], k] * p[s.body_gravity_at] + mass * dp[s.body_gravity_at, k]
            )
    x, out, J, change = w.effort_x, w.effort, w.effort_J, z.change
    for i in range(s.act_pushed.size):
        number = s.body_free[s.act_pushed[i]]
        if number < 0:
            continue
        actuate(s, i, w.q, w.V, signals, x, out, J)
        own = bounds(s.act_p_start, i)
        law_derivatives(z, s.act_pullback[i], x, p[own], dp[own], 1, change)
        add(1.0, change[0], r[number])
        n = coordinates_at(s, i)
        for j in range(s.act_measured_start[i], s.act_measured_start[i + 1]):
            measured = s.body_free[s.act_measured[j]]
            if measured >= 0:
                add(J[0, n], dy[s.body_q_start + measured], r[number])
            n += 2

    e, moved, v = z.e, z.moved, z.at_point
    for pad in range(count):
        n = assemble(s, w, pad, a, Rv)
        w.counts[pad] = n
        if s.pad_v_start[pad] >= 0:
            inertial_part(s, w, z, pad, y, dy, dp, a, tape.rate[row], r)
        else:
            massless_part(s, w, z, pad, y, dy, dp, a)
        first, columns = s.pad_node_start[pad], s.pad_columns[pad]
        at = s.pad_point_start[pad]
        X = w.X[2 * first : 2 * (first + n)]
        X[:, :m] = 0.0
        for i in range(w.actives[pad]):
            k = w.active[at + i]
            c = s.point_contact[k]
            own = bounds(s.contact_p_start, c)
            law_derivatives(z, s.contact_pullback[c], w.x[k], p[own], dp[own], outputs, e[k])
            H, S, G, L = w.H[at + i], w.S[at + i], w.G[at + i], w.L[at + i]
            moved[:], v[:] = 0.0, 0.0
            for j in range(2):
                node, N = s.point_node[k, j], s.point_N[k, j]
                for o in range(2 if N != 0.0 else 0):
                    add(N, du[node, o], moved[o])
                    add(N, dv[node, o], v[o])
            for o in range(6):
                number = s.contact_number[c, o]
                if number >= 0:
                    put(dy[s.body_q_start + number], moved[2 + o])
            for o in range(outputs):
                add(w.J[k, o, 6], dy[s.point_y_start + k], e[k, o])
                for j in range(8):
                    add(S[o, j], moved[j], e[k, o])
                for j in range(2):
                    add(H[o, j], v[j], e[k, o])
            for j in range(2):
                N, slot = s.point_N[k, j], 2 * w.slot[s.point_node[k, j]]
                for o in range(2 if N != 0.0 else 0):
                    add(N, e[k, o], X[slot + o, :m])
            for o in range(6):
                number = s.contact_number[c, o]
                if number >= 0:
                    for j in range(2):
                        add(G[o, j], e[k, j], r[number])
                        add(a * L[o, j], v[j], r[number])
                    for j in range(8):
                        add(L[o, j], moved[j], r[number])
            if felt:
                add_loads(s, z, k, L, moved)
        for i in range(2 * n):
            for j in range(columns):
                X[i, m + j] = w.Hc[i, j]
        solve_dense(w.A, X, 2 * n, m + columns)
        eliminate(s, w, pad, n, m, X, r, Rv)
    dV = z.V
    dV[:] = 0.0
    for i in range(free):
        add(-1.0, r[i], dV[i])
    solve_dense(Rv, dV, free, m)

    for pad in range(count):
        nodal_rates(s, w, z, pad, a, m)
        if felt:
            feel_pad(s, w, z, pad, y, tape.rate[row], dy, dp)
        else:
            advance_pad(s, w, z, pad, y, a, dy, dp)
    for i in range(0 if felt else free):
        add(a, dV[i], dy[s.body_q_start + i])
        put(dV[i], dy[s.body_V_start + i])


@compiled
def nodal_rates(s: Any, w: Any, z: Any, pad: int, a: float, m: int) -> None:
    """Tangents of the nodal forces, in w.X, and of the nodal rates less what is in dv, from
    Newton's solution in w.X and dV."""
    first, n, column = s.pad_node_start[pad], w.counts[pad], s.pad_column[pad]
    size, base, dV = 2 * (s.pad_node_start[pad + 1] - first), s.pad_base[pad], z.V
    own_rate, base_rate, scale = z.own_rate, z.base_rate, mobility_scale(s, pad, a)
    X, inertial = w.X[2 * first : 2 * (first + n)], s.pad_v_start[pad] >= 0
    for number in range(column.size):
        if column[number] >= 0:
            for i in range(2 * n):
                add(X[i, m + column[number]], dV[number], X[i, :m])
    own_rate[:n], base_rate[:] = 0.0, 0.0
    if inertial:
        for axis in range(2):
            number = s.body_free[base + axis]
            if number >= 0:
                e = to_base(s, w, pad, 1.0 - axis, axis)
                add(e[0], dV[number], base_rate[0])
                add(e[1], dV[number], base_rate[1])
    for i in range(n):
        for o in range(2):
            row = row_of(s.pad_C, s.pad_C_start[pad], 2 * (w.touched[first + i] - first) + o, size)
            for j in range(n):
                for q in range(2):
                    c = scale * row[2 * (w.touched[first + j] - first) + q]
                    add(c, X[2 * j + q], own_rate[i, o])
            if inertial:
                dof = s.inertia_dof_start[pad] + s.inertia_surface[2 * w.touched[first + i] + o]
                for q in range(2):
                    add(-s.inertia_D[dof, q], base_rate[q], own_rate[i, o])


@compiled
def add_output(s: Any, w: Any, z: Any, k: int, H: Array, factor: float, out: Array) -> None:
    """Add to `out` (m,) the effect of the nodal rates and the velocities on an output of the law at
    point k, whose derivatives by them are H (8,)."""
    for j in range(2):
        N, slot = s.point_N[k, j], w.slot[s.point_node[k, j]]
        for o in range(2 if N != 0.0 else 0):
            add(factor * N * H[o], z.own_rate[slot, o], out)
    for o in range(6):
        number = s.contact_number[s.point_contact[k], o]
        if number >= 0:
            add(factor * H[2 + o], z.V[number], out)


@compiled
def add_loads(s: Any, z: Any, k: int, by: Array, change: Array) -> None:
    """Add the loads `by` (6, n) times `change` (n, m) of point k on its body and its pad's base to
    z.recorded. An inertial pad's base is moved by the force in the pad."""
    c, start = s.point_contact[k], 2 * s.point_contact.size + 3 * s.pad_base.size
    inertial = s.pad_v_start[s.contact_pad[c]] >= 0
    for o in range(6):
        for j in range(0 if inertial and 3 <= o < 5 else by.shape[1]):
            add(by[o, j], change[j], z.recorded[start + s.contact_coordinate[c, o]])


@compiled
def feel_pad(s: Any, w: Any, z: Any, pad: int, y: Array, rate: Array, dy: Array, dp: Array) -> None:
    """Tangents of a pad's forces into z.recorded, whose loads hold the part at the same forces."""
    at, wrench = s.pad_point_start[pad], 2 * s.point_contact.size + 3 * pad
    inertial, into = s.pad_v_start[pad] >= 0, z.recorded
    for i in range(w.actives[pad]):
        k, e = w.active[at + i], z.e[w.active[at + i]]
        for o in range(FELT):
            add_output(s, w, z, k, w.H[at + i, o], 1.0, e[o])
        put(e[3], into[2 * k])
        put(e[4], into[2 * k + 1])
        add_loads(s, z, k, w.G[at + i], e)
        if not inertial:
            add(1.0, e[0], into[wrench])
            add(1.0, e[1], into[wrench + 1])
            add(s.point_X[k, 0], e[1], into[wrench + 2])
            add(-s.point_X[k, 1], e[0], into[wrench + 2])
    if inertial:
        feel_inertial(s, w, z, pad, y, rate, dy, dp)


@compiled
def feel_inertial(
    s: Any, w: Any, z: Any, pad: int, y: Array, rate: Array, dy: Array, dp: Array
) -> None:
    """The same of the force and the moment in an inertial pad, sums of K (u + tau u')."""
    at, base, U, W = (
        s.inertia_material_at[pad],
        s.pad_base[pad],
        s.pad_y_start[pad],
        s.pad_v_start[pad],
    )
    i0, i1, tau = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1], s.p[at + 2]
    wrench = 2 * s.point_contact.size + 3 * pad
    load = wrench + 3 * (s.pad_base.size - pad)
    strain, force, held = w.inertial[0, i0:i1], w.inertial[1, i0:i1], w.inertial[2, i0:i1]
    into = z.recorded
    for i in range(i1 - i0):
        held[i] = y[U + i] + tau * rate[i0 + i]
    for k in range(dy.shape[1]):
        for i in range(i1 - i0):
            change = tau * (dy[W + i, k] - z.base_rate[i % 2, k]) + dp[at + 2, k] * rate[i0 + i]
            strain[i] = dy[U + i, k] + change
        stiffness_force(s, pad, strain, force)
        add_stiffness(s, pad, dp[at:, k], held, force)
        x = y_axis = moment = 0.0
        for i in range(0, i1 - i0, 2):
            x += force[i]
            y_axis += force[i + 1]
            moment += s.inertia_X[i0 + i] * force[i + 1] - s.inertia_X[i0 + i + 1] * force[i]
        into[wrench, k], into[wrench + 1, k], into[wrench + 2, k] = x, y_axis, moment
        X, Y = to_world(s, w, pad, x, y_axis)
        into[load + base, k] += X
        into[load + base + 1, k] += Y


@compiled
def advance_pad(s: Any, w: Any, z: Any, pad: int, y: Array, a: float, dy: Array, dp: Array) -> None:
    """Tangents of a pad's state and of its stretches at the stage's end, after `nodal_rates`."""
    p = s.p
    first, last, n, m = s.pad_node_start[pad], s.pad_node_start[pad + 1], w.counts[pad], dy.shape[1]
    size, span, at, start = 2 * (last - first), z.span, s.pad_point_start[pad], s.pad_y_start[pad]
    chain, branches, X = s.pad_chain_at[pad], s.pad_branches[pad], w.X[2 * first : 2 * (first + n)]
    i, x, out, J, change = 0, z.decay_x, w.decay, z.decay_J, z.change
    for k in range(at, s.pad_point_start[pad + 1]):
        j, c = s.point_y_start + k, s.point_contact[k]
        own = bounds(s.contact_p_start, c)
        if i < w.actives[pad] and w.active[at + i] == k:
            add(a, z.e[k, 2], dy[j])
            add_output(s, w, z, k, w.H[at + i, 2], a, dy[j])
            i += 1
            continue
        moved = False
        for d in range(m):
            moved |= dy[j, d] != 0.0
        if moved or y[j] != 0.0:
            x[0], x[1], x[2] = y[j], s.point_weight[k], a
            call_linearise(s.contact_free_linearise[c], x, p[own], out, J)
            law_derivatives(z, s.contact_free_pullback[c], x, p[own], dp[own], 1, change)
            for d in range(m):
                new = dy[j, d] + a * (J[0, 0] * dy[j, d] + change[0, d])
                dy[j, d] = new if abs(new) > 1e-200 else 0.0
    if s.pad_v_start[pad] >= 0:
        advance_inertial(s, w, z, pad, a, dy)
        return
    for b in range(branches):
        part, first_z = a / (p[chain + branches + b] + a), start + b * size
        for i in range(span[pad, 0], span[pad, 1]):
            z_dot = branch_rate(s, w, pad, b, i, w.F, y, a)
            add(-part, dy[first_z + i], dy[first_z + i])
            add(-part * z_dot, dp[chain + branches + b], dy[first_z + i])
        for i in range(n):
            for o in range(2):
                dof = first_z + 2 * (w.touched[first + i] - first) + o
                add(part, X[2 * i + o], dy[dof])


@compiled
def advance_inertial(s: Any, w: Any, z: Any, pad: int, a: float, dy: Array) -> None:
    """u and v of an inertial pad: u' = free + A^-1 F - D V_B, v = u' + V_B."""
    i0, i1, first = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1], s.pad_node_start[pad]
    X, column = w.X[2 * first : 2 * (first + w.counts[pad])], w.inertial[0, i0:i1]
    free_rates, base_rate = z.free, z.base_rate
    for k in range(dy.shape[1]):
        column[:] = 0.0
        for i in range(w.counts[pad]):
            for o in range(2):
                column[s.inertia_surface[2 * w.touched[first + i] + o]] = X[2 * i + o, k]
        solve(s, pad, column)
        for i in range(i1 - i0):
            rate = free_rates[i0 + i, k] + column[i]
            rate -= (
                s.inertia_D[i0 + i, 0] * base_rate[0, k] + s.inertia_D[i0 + i, 1] * base_rate[1, k]
            )
            dy[s.pad_y_start[pad] + i, k] += a * rate
            dy[s.pad_v_start[pad] + i, k] = rate + base_rate[i % 2, k]


@compiled
def read(r: Any, i: int) -> None:
    """Tangents of the sums of forces at output i into r.dsums."""
    out = r.dsums[i]
    if out.shape[0] == 0:
        return
    stage_tangent(r.s0, r.w, r.z, r.out_tape, i, INSTANT, r.out_signals[i], r.dys[i], r.dp, True)
    for c in range(out.shape[0]):
        out[c] = 0.0
        for j in range(r.sum_start[c], r.sum_start[c + 1]):
            add(r.sum_weight[j], r.z.recorded[r.sum_at[j]], out[c])


@compiled
def forward(r: Any) -> None:
    """Carry the tangent dy (size, m) through the steps h of a tape, in place; dys (outputs, size,
    m) receives it at the parts out_part of the steps out_step, dsums (outputs, sums, m)
    those of the sums of forces, `Sums`. Without steps the one output is the start."""
    s, w, z, tape, h, signals = r.s, r.w, r.z, r.tape, r.h, r.signals
    out_step, out_part, dy, dp, dys = r.out_step, r.out_part, r.dy, r.dp, r.dys
    m, row, before, first = dy.shape[1], 0, z.before, z.first
    if h.size == 0:
        put(dy, dys[0])
        if r.out_tape.count.shape[0] > 0:
            find_span(s, r.out_tape.y[0], dy, z.span)
        read(r, 0)
    for step in range(h.size):
        a = GAMMA * h[step]
        if step % RESCAN == 0:
            find_span(s, tape.y[2 * step], dy, z.span)
        put(dy, before)
        stage_tangent(s, w, z, tape, 2 * step, a, signals[2 * step], dy, dp, False)
        put(dy, first)
        for i in range(dy.shape[0]):
            for k in range(m):
                dy[i, k] = before[i, k] + MIX * (dy[i, k] - before[i, k])
        stage_tangent(s, w, z, tape, 2 * step + 1, a, signals[2 * step + 1], dy, dp, False)
        while row < out_step.size and out_step[row] == step:
            at_start, at_first, at_end = dense_states(out_part[row])
            for i in range(dy.shape[0]):
                for k in range(m):
                    dys[row, i, k] = (
                        at_start * before[i, k] + at_first * first[i, k] + at_end * dy[i, k]
                    )
            read(r, row)
            row += 1
