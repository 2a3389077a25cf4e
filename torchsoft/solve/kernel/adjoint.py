"""The transposed stage: the discrete adjoint of `run`.

The stage's relations are differentiated as they stand (implicit function theorem) and solved
backwards. Cotangents: phi of the nodal forces, mu of the points' forces, nu of the free
coordinates' equations, sigma of a point's displacement, omega of its rate; "_bar" marks the
cotangent of a name.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.arrays import FELT, GAMMA, INSTANT, MIX, STEPPED
from torchsoft.solve.kernel.inertia import (
    base_velocity,
    pull_stiffness,
    solve,
    stiffness_force,
    to_base,
    to_world,
)
from torchsoft.solve.kernel.interface import NEGLIGIBLE, assemble, branch_rate, restore, softness
from torchsoft.solve.kernel.invoke import call_linearise, call_pullback
from torchsoft.solve.kernel.linear import add, bounds, dot, put, row_of, solve_dense
from torchsoft.solve.kernel.stage import actuate, balance
from torchsoft.solve.kernel.step import TINY, dense_states
from torchsoft.solve.kernel.table import Array


@compiled
def nodal_cotangent(
    s: Any,
    w: Any,
    z: Any,
    pad: int,
    y_bar: Array,
    a: float,
    n: int,
    X: Array,
    full: Array,
    V_bar: Array,
    outputs: int,
) -> None:
    """F_bar of the touched nodes into X[:, 0], from the cotangents of the pad's state and of the
    law's outputs at the touching points, z.out."""
    free = s.body_free
    first, at = s.pad_node_start[pad], s.pad_point_start[pad]
    b = z.surface[0, : 2 * n]
    b[:] = 0.0
    for i in range(w.actives[pad]):
        k = w.active[at + i]
        c = s.point_contact[k]
        for r in range(outputs):
            H, bar = w.H[at + i, r], z.out[k, r]
            if bar == 0.0:
                continue
            for j in range(2):
                if s.point_N[k, j] != 0.0:
                    row = 2 * w.slot[s.point_node[k, j]]
                    b[row] += s.point_N[k, j] * H[0] * bar
                    b[row + 1] += s.point_N[k, j] * H[1] * bar
            for row in range(6):
                number = s.contact_number[c, row]
                if number >= 0:
                    V_bar[number] += H[2 + row] * bar
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
        x_bar = y_axis = 0.0
        for i in range(i1 - i0):
            x_bar -= s.inertia_D[i0 + i, 0] * own[i]
            y_axis -= s.inertia_D[i0 + i, 1] * own[i]
            if i % 2 == 0:
                x_bar += v_bar[i]
            else:
                y_axis += v_bar[i]
        push = to_world(s, w, pad, x_bar, y_axis)
        for axis in range(2):
            if free[base + axis] >= 0:
                V_bar[free[base + axis]] += push[axis]
        rates = z.dofs[0, i0:i1]
        put(own, rates)
        solve(s, pad, rates)
        for i in range(n):
            for r in range(2):
                X[2 * i + r, 0] = rates[s.inertia_surface[2 * w.touched[first + i] + r]]
        return
    size, chain, branches = (
        2 * (s.pad_node_start[pad + 1] - first),
        s.pad_chain_at[pad],
        s.pad_branches[pad],
    )
    for i in range(n):
        for r in range(2):
            dof, total = 2 * (w.touched[first + i] - first) + r, dot(b, w.P[2 * i + r])
            for branch in range(branches):
                z_bar = y_bar[s.pad_y_start[pad] + branch * size + dof]
                total += a * z_bar / (s.p[chain + branches + branch] + a)
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
    """Cotangents of a massless pad's state at the stage's start, and of its material, from those of
    its nodal rates and displacements (nodes, 2)."""
    p, first, start = s.p, s.pad_node_start[pad], s.pad_y_start[pad]
    size = 2 * (s.pad_node_start[pad + 1] - first)
    chain, branches = s.pad_chain_at[pad], s.pad_branches[pad]
    start_C, material = s.pad_C_start[pad], chain + 2 * branches
    soft = softness(s, pad)
    by_rate, by_u = scratch.surface[0], scratch.surface[1]
    zeta, z_dot = scratch.surface[2], scratch.surface[3]
    scratch.surface[:, :size] = 0.0
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            c, d = soft * rate_bar[node, r], soft * u_bar[node, r]
            if c != 0.0 or d != 0.0:
                row = row_of(s.pad_C, start_C, 2 * (node - first) + r, size)
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
            c, d = soft * rate_bar[node, r], soft * u_bar[node, r]
            if c != 0.0 or d != 0.0:
                row = row_of(s.pad_dC, start_C, 2 * (node - first) + r, size)[left:right]
                p_bar[material + 1] += c * dot(row, z_dot[left:]) + d * dot(row, zeta[left:])


@compiled
def inertial_state(
    s: Any, w: Any, z: Any, pad: int, y: Array, y_bar: Array, a: float, rate: Array, full: Array,
    rate_bar: Array, u_bar: Array, nu: Array, V_bar: Array, p_bar: Array,
) -> None:  # fmt: skip
    """The same for an inertial pad; `rate` is its taped u', `full` what `nodal_cotangent` left,
    V_bar of all coordinates."""
    free, at = s.body_free, s.inertia_material_at[pad]
    i0, i1, base = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1], s.pad_base[pad]
    U, W, mass = s.pad_y_start[pad], s.pad_v_start[pad], s.p[s.inertia_material_at[pad] + 3]
    nx = nu[free[base], 0] if free[base] >= 0 else 0.0
    ny = nu[free[base + 1], 0] if free[base + 1] >= 0 else 0.0
    own, strain, force, back = (
        z.dofs[0, i0:i1],
        z.dofs[1, i0:i1],
        z.dofs[2, i0:i1],
        z.dofs[3, i0:i1],
    )  # own: of u'
    reaction, local = z.pair[0], z.pair[1]
    reaction[0], reaction[1] = to_base(s, w, pad, -nx, -ny)
    for i in range(i1 - i0):
        own[i] = (
            a * y_bar[U + i] + y_bar[W + i] + mass * s.inertia_area[i0 + i] / a * reaction[i % 2]
        )
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            own[s.inertia_surface[2 * node + r]] += rate_bar[node, r]
    solve(s, pad, own)  # now the multiplier of the pad's equation
    vx, vy = base_velocity(s, w, pad)
    here = rate[i0:i1]
    stiffness_force(s, pad, here, force)
    stiffness_force(s, pad, own, back)
    for i in range(i1 - i0):
        v = vx if i % 2 == 0 else vy
        M = s.inertia_area[i0 + i] / a
        change = here[i] + v - y[W + i]
        p_bar[at + 2] -= own[i] * force[i]
        p_bar[at + 3] += M * change * (reaction[i % 2] - own[i])
        strain[i] = -y[U + i] - (s.p[at + 2] + a) * here[i]
    pull_stiffness(s, pad, strain, own, p_bar)
    local[:] = 0.0
    for i in range(i1 - i0):
        local[i % 2] += y_bar[W + i] + mass * s.inertia_area[i0 + i] / a * (
            reaction[i % 2] - own[i]
        )
        y_bar[U + i] -= back[i]
        y_bar[W + i] = mass * s.inertia_area[i0 + i] / a * (own[i] - reaction[i % 2])
    push = to_world(s, w, pad, local[0], local[1])
    V_bar[base] += push[0]
    V_bar[base + 1] += push[1]
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            y_bar[U + s.inertia_surface[2 * node + r]] += u_bar[node, r]


@compiled
def load_cotangent(s: Any, z: Any, c: int, row: int) -> float:
    """Cotangent of the load of contact c on coordinate `row` of its body and its pad's base. The
    base of an inertial pad is moved by the force in the pad."""
    if s.pad_v_start[s.contact_pad[c]] >= 0 and 3 <= row < 5:
        return 0.0
    return z.load[s.contact_coordinate[c, row]]


@compiled
def seed(
    s: Any, w: Any, z: Any, tape: Any, row: int, a: float, y_bar: Array, p_bar: Array,
    signals_bar: Array, forces_bar: Array,
) -> None:  # fmt: skip
    """Cotangents of the law's outputs at the touching points into z.out, of loads and of the pads'
    forces and moments into z.load and z.wrenches; those of the forces in inertial pads go on to
    displacements and rates."""
    z.load[:], z.wrenches[:] = 0.0, 0.0
    felt, points, pads = forces_bar.size > 0, s.point_contact.size, s.pad_base.size
    if felt:
        put(forces_bar[2 * points + 3 * pads :], z.load)
        put(forces_bar[2 * points : 2 * points + 3 * pads], z.wrenches)
    for pad in range(pads):
        at, inertial, wrench = s.pad_point_start[pad], s.pad_v_start[pad] >= 0, z.wrenches[pad]
        for i in range(w.actives[pad]):
            k, G = w.active[at + i], w.G[at + i]
            bar = z.out[k]
            bar[:] = 0.0
            bar[2] = a * y_bar[s.point_y_start + k]
            if not felt:
                continue
            bar[3], bar[4] = forces_bar[2 * k], forces_bar[2 * k + 1]
            for o in range(6):
                load = load_cotangent(s, z, s.point_contact[k], o)
                bar[0] += G[o, 0] * load
                bar[1] += G[o, 1] * load
            if not inertial:
                bar[0] += wrench[0] - s.point_X[k, 1] * wrench[2]
                bar[1] += wrench[1] + s.point_X[k, 0] * wrench[2]
        if felt and inertial:
            elastic_adjoint(s, w, z, pad, tape.y[row], tape.rate[row], y_bar, p_bar, signals_bar)


@compiled
def elastic_adjoint(
    s: Any, w: Any, z: Any, pad: int, y: Array, rate: Array, y_bar: Array, p_bar: Array,
    signals_bar: Array,
) -> None:  # fmt: skip
    """Adjoint of the force and the moment in an inertial pad, sums of K (u + tau u')."""
    i0, i1, at = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1], s.inertia_material_at[pad]
    base, tau, wrench, V_bar = s.pad_base[pad], s.p[at + 2], z.wrenches[pad], z.pair[0]
    x, y_axis = to_base(s, w, pad, z.load[base], z.load[base + 1])
    bar, back, strain = z.dofs[0, i0:i1], z.dofs[1, i0:i1], z.dofs[2, i0:i1]
    for i in range(0, i1 - i0, 2):
        bar[i] = wrench[0] + x - s.inertia_X[i0 + i + 1] * wrench[2]
        bar[i + 1] = wrench[1] + y_axis + s.inertia_X[i0 + i] * wrench[2]
    stiffness_force(s, pad, bar, back)
    V_bar[:] = 0.0
    for i in range(i1 - i0):
        y_bar[s.pad_y_start[pad] + i] += back[i]
        y_bar[s.pad_v_start[pad] + i] += tau * back[i]
        V_bar[i % 2] -= tau * back[i]
        p_bar[at + 2] += back[i] * rate[i0 + i]
        strain[i] = y[s.pad_y_start[pad] + i] + tau * rate[i0 + i]
    pull_stiffness(s, pad, strain, bar, p_bar)
    push = to_world(s, w, pad, V_bar[0], V_bar[1])
    for axis in range(2):
        if s.body_free[base + axis] >= 0:
            y_bar[s.body_V_start + s.body_free[base + axis]] += push[axis]
        elif s.body_signal[base + axis] >= 0:
            signals_bar[s.body_signal[base + axis], 1] += push[axis]


@compiled
def stage_adjoint(
    s: Any, w: Any, z: Any, tape: Any, row: int, a: float, signals: Array, y_bar: Array,
    p_bar: Array, signals_bar: Array, forces_bar: Array,
) -> None:  # fmt: skip
    """Turn the cotangent y_bar (size,) of a stage's end into that of its y*, in place; add to p_bar
    and signals_bar. forces_bar (recorded,) are those of its forces, or empty."""
    p = s.p
    free, count, y = s.body_coordinate.size, s.pad_base.size, tape.y[row]
    outputs = FELT if forces_bar.size > 0 else STEPPED
    restore(s, w, tape, row, a, outputs)
    seed(s, w, z, tape, row, a, y_bar, p_bar, signals_bar, forces_bar)
    Rv, matrix, nu, V_bar, full, rate_bar, u_bar = (
        w.Rv,
        z.matrix,
        z.nu,
        z.V_bar,
        z.full,
        z.rate,
        z.u,
    )
    balance(s, w, y, signals, a, w.r, Rv)
    matrix[:] = 0.0
    for i in range(free):
        V_bar[i] = y_bar[s.body_V_start + i] + a * y_bar[s.body_q_start + i]
    for pad in range(count):
        n = assemble(s, w, pad, a, Rv)
        first, columns, column = s.pad_node_start[pad], s.pad_columns[pad], s.pad_column[pad]
        X = w.X[2 * first : 2 * (first + n)]
        nodal_cotangent(s, w, z, pad, y_bar, a, n, X, full, V_bar, outputs)
        for i in range(2 * n):
            for j in range(columns):
                X[i, 1 + j] = w.Rf[j, i]
            for j in range(i):
                w.A[i, j], w.A[j, i] = w.A[j, i], w.A[i, j]
        solve_dense(w.A, X, 2 * n, 1 + columns)
        for i in range(free):
            if column[i] < 0:
                continue
            for m in range(2 * n):
                V_bar[i] += w.Hc[m, column[i]] * X[m, 0]
                for j in range(free):
                    if column[j] >= 0:
                        matrix[i, j] -= w.Hc[m, column[i]] * X[m, 1 + column[j]]
        w.counts[pad] = n
    for i in range(free):
        nu[i, 0] = V_bar[i]
        for j in range(free):
            matrix[i, j] -= Rv[j, i]
    solve_dense(matrix, nu, free, 1)

    q_hat, V_hat, weights, by = z.q, z.V, z.weights, z.by
    q_hat[:], V_hat[:] = 0.0, 0.0
    for pad in range(count):
        first, n, column, at = (
            s.pad_node_start[pad],
            w.counts[pad],
            s.pad_column[pad],
            s.pad_point_start[pad],
        )
        X = w.X[2 * first : 2 * (first + n)]
        for i in range(2 * n):
            for j in range(free):
                if column[j] >= 0:
                    X[i, 0] += X[i, 1 + column[j]] * nu[j, 0]
        rate_bar[w.low[pad] : w.high[pad]], u_bar[w.low[pad] : w.high[pad]] = 0.0, 0.0
        for i in range(w.actives[pad]):
            k = w.active[at + i]
            c = s.point_contact[k]
            H, S, G, L = w.H[at + i], w.S[at + i], w.G[at + i], w.L[at + i]
            for row_ in range(6):
                number = s.contact_number[c, row_]
                by[row_] = nu[number, 0] if number >= 0 else 0.0
            put(z.out[k], weights)
            for r in range(2):
                for j in range(2):
                    if s.point_N[k, j] != 0.0:
                        weights[r] += s.point_N[k, j] * X[2 * w.slot[s.point_node[k, j]] + r, 0]
                for row_ in range(6):
                    weights[r] += G[row_, r] * by[row_]
            for row_ in range(6):
                by[row_] += load_cotangent(s, z, c, row_)
            own = bounds(s.contact_p_start, c)
            call_pullback(s.contact_pullback[c], w.x[k], p[own], weights, p_bar[own])
            for m in range(8):
                position = velocity = 0.0
                for r in range(outputs):
                    position += S[r, m] * weights[r]
                    velocity += (H[r, m] - a * S[r, m]) * weights[r]
                for row_ in range(6):
                    position += L[row_, m] * by[row_]
                if m < 2:
                    for j in range(2):
                        rate_bar[s.point_node[k, j], m] += s.point_N[k, j] * (
                            velocity + a * position
                        )
                        u_bar[s.point_node[k, j], m] += s.point_N[k, j] * position
                else:
                    coordinate = s.contact_coordinate[c, m - 2]
                    q_hat[coordinate] += position
                    V_hat[coordinate] += velocity
            s_bar = 0.0
            for r in range(outputs):
                s_bar += w.J[k, r, 6] * weights[r]
            y_bar[s.point_y_start + k] += s_bar
        free_stretches(s, w, z, pad, y, y_bar, a, p_bar)
        if s.pad_v_start[pad] >= 0:
            inertial_state(
                s, w, z, pad, y, y_bar, a, tape.rate[row], full, rate_bar, u_bar, nu, V_hat, p_bar
            )
        else:
            pad_state(s, w, z, pad, y, y_bar, a, rate_bar, u_bar, p_bar)

    x, out, J = w.effort_x, w.effort, w.effort_J
    for i in range(s.act_pushed.size):
        number = s.body_free[s.act_pushed[i]]
        if number < 0:
            continue
        actuate(s, i, w.q, w.V, signals, x, out, J)
        own, push = bounds(s.act_p_start, i), nu[number]
        call_pullback(s.act_pullback[i], x, p[own], push, p_bar[own])
        n = 0
        for k in range(s.act_setpoint_start[i], s.act_setpoint_start[i + 1]):
            signals_bar[s.act_setpoint[k], 0] += push[0] * J[0, n]
            signals_bar[s.act_setpoint[k], 1] += push[0] * J[0, n + 1]
            n += 2
        if s.act_feed_forward[i] >= 0:
            signals_bar[s.act_feed_forward[i], 0] += push[0] * J[0, n]
        for k in range(s.act_measured_start[i], s.act_measured_start[i + 1]):
            q_hat[s.act_measured[k]] += push[0] * J[0, n + 1]
            V_hat[s.act_measured[k]] += push[0] * J[0, n + 2]
            n += 2
    for i in range(free):
        c, mass = s.body_coordinate[i], p[s.body_mass_at[i]]
        rate = (w.V[c] - y[s.body_V_start + i]) / a
        p_bar[s.body_mass_at[i]] -= nu[i, 0] * (rate + s.body_weight[i] * p[s.body_gravity_at])
        p_bar[s.body_gravity_at] -= nu[i, 0] * mass * s.body_weight[i]
        y_bar[s.body_q_start + i] += q_hat[c]
        y_bar[s.body_V_start + i] = nu[i, 0] * mass / a
    for c in range(w.q.size):
        if s.body_free[c] < 0 and s.body_signal[c] >= 0:
            signals_bar[s.body_signal[c], 0] += q_hat[c]
            signals_bar[s.body_signal[c], 1] += V_hat[c]


@compiled
def free_stretches(
    s: Any, w: Any, z: Any, pad: int, y: Array, y_bar: Array, a: float, p_bar: Array
) -> None:
    """Cotangents of the stretches away from contact, which decay."""
    at, i = s.pad_point_start[pad], 0
    x, out, J, weight = z.decay_x, w.decay, z.decay_J, z.weights
    for k in range(at, s.pad_point_start[pad + 1]):
        j = s.point_y_start + k
        if i < w.actives[pad] and w.active[at + i] == k:
            i += 1
        elif y_bar[j] != 0.0:
            c = s.point_contact[k]
            own = bounds(s.contact_p_start, c)
            x[0], x[1], x[2] = y[j], s.point_weight[k], a
            call_linearise(s.contact_free_linearise[c], x, s.p[own], out, J)
            weight[0] = a * y_bar[j]
            call_pullback(s.contact_free_pullback[c], x, s.p[own], weight, p_bar[own])
            y_bar[j] += J[0, 0] * weight[0]
            if abs(y_bar[j]) < TINY:
                y_bar[j] = 0.0


@compiled
def output_adjoint(r: Any, i: int) -> None:
    """Add to the cotangents of output i's state, parameters and signals the share of its forces:
    the adjoint of the stage of no length that gives them."""
    bar, state = r.recorded_bar[i], r.z.state[3]
    some = False
    for j in range(bar.size):
        some |= bar[j] != 0.0
    if some:
        state[:] = 0.0
        stage_adjoint(
            r.s0, r.w, r.z, r.out_tape, i, INSTANT, r.out_signals[i], state, r.p_bar,
            r.out_signals_bar[i], bar,
        )  # fmt: skip
        for j in range(state.size):
            r.outputs_bar[i, j] += state[j]


@compiled
def backward(r: Any) -> None:
    """Sweep the steps h of a tape backwards; y_bar goes from the end's cotangent to the start's, in
    place.

    outputs_bar (outputs, size) belong to the parts out_part of the steps out_step; where
    recorded_bar (outputs, recorded) of the forces there is not zero, they receive its share.
    Without steps the one output is the start. signals and signals_bar are (stages, signals, 2),
    those of the outputs (outputs, signals, 2). failed receives -1, or the step at which a cotangent
    stopped being finite.
    """
    s, w, z, tape, h, signals, none = r.s, r.w, r.z, r.tape, r.h, r.signals, r.z.by[:0]
    out_step, out_part, outputs_bar = r.out_step, r.out_part, r.outputs_bar
    y_bar, p_bar, signals_bar = r.y_bar, r.p_bar, r.signals_bar
    r.failed[0] = -1
    row = out_step.size - 1
    held, first_bar, start_bar = z.state[0], z.state[1], z.state[2]
    for i in range(out_step.size):
        output_adjoint(r, i)
    if h.size == 0:
        for i in range(y_bar.size):
            y_bar[i] += outputs_bar[0, i]
    for step in range(h.size - 1, -1, -1):
        a = GAMMA * h[step]
        first_bar[:], start_bar[:] = 0.0, 0.0
        while row >= 0 and out_step[row] == step:
            at_start, at_first, at_end = dense_states(out_part[row])
            for i in range(y_bar.size):
                y_bar[i] += at_end * outputs_bar[row, i]
                first_bar[i] += at_first * outputs_bar[row, i]
                start_bar[i] += at_start * outputs_bar[row, i]
            row -= 1
        k = 2 * step + 1
        stage_adjoint(s, w, z, tape, k, a, signals[k], y_bar, p_bar, signals_bar[k], none)
        for i in range(y_bar.size):
            held[i] = (1.0 - MIX) * y_bar[i] + start_bar[i]
            y_bar[i] = MIX * y_bar[i] + first_bar[i]
        k = 2 * step
        stage_adjoint(s, w, z, tape, k, a, signals[k], y_bar, p_bar, signals_bar[k], none)
        for i in range(y_bar.size):
            y_bar[i] += held[i]
        if not np.isfinite(y_bar.sum()):
            r.failed[0] = step
            return
