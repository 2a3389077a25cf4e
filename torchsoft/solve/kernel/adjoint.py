"""The transposed stage: the discrete adjoint of `run`.

The stage's relations are differentiated as they stand (implicit function theorem) and solved backwards. Cotangents: phi of the
nodal forces, mu of the points' forces, nu of the free coordinates' equations, sigma of a point's displacement, omega of its
rate; "_bar" of what it is put behind.
"""

from typing import Any

import numpy as np

from torchsoft.codegen.invoke import call_linearise, call_pullback
from torchsoft.solve.kernel import compiled, entry
from torchsoft.solve.kernel.adjoint_pads import inertial_state, nodal_cotangent, pad_state
from torchsoft.solve.kernel.arrays import Array
from torchsoft.solve.kernel.interface import assemble
from torchsoft.solve.kernel.linear import solve_dense
from torchsoft.solve.kernel.stage import actuate, by_velocities
from torchsoft.solve.kernel.step import GAMMA, MIX, TINY, dense_states
from torchsoft.solve.kernel.taped import restore


@compiled
def rigid_part(s: Any, w: Any, y: Array, signals: Array, a: float, Rv: Array) -> None:
    """Derivative of the free coordinates' equations by their velocities without contact."""
    Rv[:] = 0.0
    for i in range(s.body_coordinate.size):
        Rv[i, i] = -s.p[s.body_mass_at[i]] / a
    for i in range(s.act_pushed.size):
        number = s.body_free[s.act_pushed[i]]
        if number >= 0:
            actuate(s, i, w.q, w.V, signals, w.effort_x, w.effort, w.effort_J)
            by_velocities(s, i, w.effort_J, a, Rv[number])


@compiled
def stage_adjoint(
    s: Any, w: Any, z: Any, tape: Any, row: int, a: float, signals: Array, y_bar: Array, p_bar: Array, signals_bar: Array,
) -> None:  # fmt: skip
    """Turn the cotangent y_bar (size,) of a stage's end into that of its y*, in place; add to p_bar and signals_bar."""
    p = s.p
    free, count, y = s.body_coordinate.size, s.pad_base.size, tape.y[row]
    restore(s, w, tape, row, a)
    Rv, matrix, nu, V_bar, full, rate_bar, u_bar = w.Rv, z.matrix, z.nu, z.V_bar, z.full, z.rate, z.u
    rigid_part(s, w, y, signals, a, Rv)
    matrix[:] = 0.0
    for i in range(free):
        V_bar[i] = y_bar[s.body_V_start + i] + a * y_bar[s.body_q_start + i]
    for pad in range(count):
        n = assemble(s, w, pad, a, Rv)
        first, columns, column = s.pad_node_start[pad], s.pad_columns[pad], s.pad_column[pad]
        X = w.X[2 * first : 2 * (first + n)]
        nodal_cotangent(s, w, z, pad, y_bar, a, n, X, full, V_bar)
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
        first, n, column = s.pad_node_start[pad], w.counts[pad], s.pad_column[pad]
        at, c = s.contact_point_start[s.pad_contact_start[pad]], s.pad_contact_start[pad]
        X = w.X[2 * first : 2 * (first + n)]
        for i in range(2 * n):
            for j in range(free):
                if column[j] >= 0:
                    X[i, 0] += X[i, 1 + column[j]] * nu[j, 0]
        for node in range(w.low[pad], w.high[pad]):
            rate_bar[node, 0], rate_bar[node, 1], u_bar[node, 0], u_bar[node, 1] = 0.0, 0.0, 0.0, 0.0
        for i in range(w.actives[pad]):
            k = w.active[at + i]
            while k >= s.contact_point_start[c + 1]:
                c += 1
            H, S, G, L = w.H[at + i], w.S[at + i], w.G[at + i], w.L[at + i]
            for row_ in range(6):
                number = s.body_free[s.contact_body[c] + row_] if row_ < 3 else s.body_free[s.pad_base[pad] + row_ - 3]
                by[row_] = nu[number, 0] if number >= 0 else 0.0
            for r in range(2):
                weights[r] = 0.0
                for j in range(2):
                    if s.point_N[k, j] != 0.0:
                        weights[r] += s.point_N[k, j] * X[2 * w.slot[s.point_node[k, j]] + r, 0]
                for row_ in range(6):
                    weights[r] += G[row_, r] * by[row_]
            weights[2] = a * y_bar[s.point_y_start + k]
            own = slice(s.contact_p_start[c], s.contact_p_start[c + 1])
            call_pullback(s.contact_pullback[c], w.x[k], p[own], weights, p_bar[own])
            for m in range(8):
                position = velocity = 0.0
                for r in range(3):
                    position += S[r, m] * weights[r]
                    velocity += (H[r, m] - a * S[r, m]) * weights[r]
                for row_ in range(6):
                    position += L[row_, m] * by[row_]
                if m < 2:
                    for j in range(2):
                        rate_bar[s.point_node[k, j], m] += s.point_N[k, j] * (velocity + a * position)
                        u_bar[s.point_node[k, j], m] += s.point_N[k, j] * position
                else:
                    coordinate = s.contact_body[c] + m - 2 if m < 5 else s.pad_base[pad] + m - 5
                    q_hat[coordinate] += position
                    V_hat[coordinate] += velocity
            s_bar = 0.0
            for r in range(3):
                s_bar += w.J[k, r, 6] * weights[r]
            y_bar[s.point_y_start + k] += s_bar
        free_stretches(s, w, z, pad, y, y_bar, a, p_bar)
        if s.pad_v_start[pad] >= 0:
            inertial_state(s, w, z, pad, y, y_bar, a, tape.rate[row], full, rate_bar, u_bar, nu, V_hat, p_bar)
        else:
            pad_state(s, w, z, pad, y, y_bar, a, rate_bar, u_bar, p_bar)

    x, out, J = w.effort_x, w.effort, w.effort_J
    for i in range(s.act_pushed.size):
        number = s.body_free[s.act_pushed[i]]
        if number < 0:
            continue
        actuate(s, i, w.q, w.V, signals, x, out, J)
        own, push = slice(s.act_p_start[i], s.act_p_start[i + 1]), nu[number]
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
def free_stretches(s: Any, w: Any, z: Any, pad: int, y: Array, y_bar: Array, a: float, p_bar: Array) -> None:
    """Cotangents of the stretches away from contact, which decay."""
    at, i = s.contact_point_start[s.pad_contact_start[pad]], 0
    x, out, J, weight = z.decay_x, w.decay, z.decay_J, z.weights
    for c in range(s.pad_contact_start[pad], s.pad_contact_start[pad + 1]):
        own = slice(s.contact_p_start[c], s.contact_p_start[c + 1])
        for k in range(s.contact_point_start[c], s.contact_point_start[c + 1]):
            j = s.point_y_start + k
            if i < w.actives[pad] and w.active[at + i] == k:
                i += 1
            elif y_bar[j] != 0.0:
                x[0], x[1], x[2] = y[j], s.point_weight[k], a
                call_linearise(s.contact_free_linearise[c], x, s.p[own], out, J)
                weight[0] = a * y_bar[j]
                call_pullback(s.contact_free_pullback[c], x, s.p[own], weight, p_bar[own])
                y_bar[j] += J[0, 0] * weight[0]
                if abs(y_bar[j]) < TINY:
                    y_bar[j] = 0.0


@entry
def backward(
    s: Any, w: Any, z: Any, h: Array, tape: Any, signals: Array, out_step: Any, out_part: Array, outputs_bar: Array,
    y_bar: Array, p_bar: Array, signals_bar: Array,
) -> int:  # fmt: skip
    """Sweep the steps of a tape backwards; y_bar goes from the end's cotangent to the start's, in place.

    outputs_bar (outputs, size) belong to the parts out_part of the steps out_step; signals and signals_bar are
    (stages, signals, 2). Returns -1, or the step at which a cotangent stopped being finite.
    """
    row = out_step.size - 1
    held, first_bar, start_bar = z.state[0], z.state[1], z.state[2]
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
        stage_adjoint(s, w, z, tape, k, a, signals[k], y_bar, p_bar, signals_bar[k])
        for i in range(y_bar.size):
            held[i] = (1.0 - MIX) * y_bar[i] + start_bar[i]
            y_bar[i] = MIX * y_bar[i] + first_bar[i]
        k = 2 * step
        stage_adjoint(s, w, z, tape, k, a, signals[k], y_bar, p_bar, signals_bar[k])
        for i in range(y_bar.size):
            y_bar[i] += held[i]
        if not np.isfinite(y_bar.sum()):
            return step
    return -1
