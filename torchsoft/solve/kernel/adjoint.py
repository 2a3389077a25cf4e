"""The transposed stage: the discrete adjoint of `run`.

The stage's relations are differentiated as they stand (implicit function theorem) and solved
backwards. "_bar" marks the cotangent of a name; nu are the multipliers of the free coordinates'
equations.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, contacts, pads
from torchsoft.solve.kernel.arrays import GAMMA, INSTANT, MIX, TINY, WRENCH
from torchsoft.solve.kernel.invoke import call_pullback
from torchsoft.solve.kernel.linear import add, bounds, put, solve_dense
from torchsoft.solve.kernel.nodal import inertial, pull_felt
from torchsoft.solve.kernel.sources import balance, effort, first_coordinate, first_state
from torchsoft.solve.kernel.step import dense_states
from torchsoft.solve.kernel.table import Array


@compiled
def load_cotangent(s: Any, z: Any, c: int, row: int) -> float:
    """Cotangent of the load of contact c on coordinate `row` of its body and its pad's base. The
    base of a pad with inertia is moved by the forces of its elements."""
    if inertial(s, s.contact_pad[c]) and 3 <= row < 5:
        return 0.0
    return z.load[s.contact_coordinate[c, row]]


@compiled
def seed(
    s: Any, w: Any, z: Any, tape: Any, row: int, a: float, y_bar: Array, p_bar: Array,
    forces_bar: Array,
) -> None:  # fmt: skip
    """Cotangents of the law's outputs at the touching points into z.out, of loads and of the pads'
    forces and moments into z.load and z.wrenches; those of the forces of elements go on to
    displacements and rates."""
    z.load[:], z.wrenches[:], z.rate_of[:] = 0.0, 0.0, 0.0
    felt, points, count = forces_bar.size > 0, s.point_contact.size, s.pad_base.size
    if felt:
        put(forces_bar[2 * points + 3 * count :], z.load)
        for pad in range(count):
            first = 2 * points + 3 * pad
            put(forces_bar[first : first + 3], z.wrenches[pad])
    for pad in range(count):
        at, wrench = s.pad_point_start[pad], z.wrenches[pad]
        for i in range(at, at + w.actives[pad]):
            k = w.active[i]
            bar, c = z.out[k], s.point_contact[k]
            n = s.contact_states[c]
            bar[:] = 0.0
            for j in range(n):
                bar[WRENCH + j] = a * y_bar[contacts.state_at(s, k, j)]
            if not felt:
                continue
            bar[WRENCH + n], bar[WRENCH + n + 1] = forces_bar[2 * k], forces_bar[2 * k + 1]
            for o in range(6):
                add(load_cotangent(s, z, c, o), w.by_pair[c, 6 + o, 12:], bar[:WRENCH])
            if not inertial(s, pad):
                bar[0] += wrench[0] - s.point_X[k, 1] * wrench[2]
                bar[1] += wrench[1] + s.point_X[k, 0] * wrench[2]
        if felt and inertial(s, pad):
            pull_felt(s, w, z, pad, tape.y[row], a, y_bar, p_bar)


@compiled
def stage_adjoint(
    s: Any, w: Any, z: Any, tape: Any, row: int, a: float, signals: Array, y_bar: Array,
    p_bar: Array, signals_bar: Array, forces_bar: Array,
) -> None:  # fmt: skip
    """Turn the cotangent y_bar (size,) of a stage's end into that of its y*, in place; add to p_bar
    and signals_bar. forces_bar (recorded,) are those of its forces, or empty."""
    free, count, y, felt = s.body_coordinate.size, s.pad_base.size, tape.y[row], forces_bar.size > 0
    Rv, matrix, nu, V_bar = w.Rv, z.matrix, z.nu, z.V_bar
    pads.restore(s, w, tape, row, a, felt)
    seed(s, w, z, tape, row, a, y_bar, p_bar, forces_bar)
    balance(s, w, y, signals, a, w.r, Rv)
    matrix[:], nu[:], z.q[:], z.V[:] = 0.0, 0.0, 0.0, 0.0
    for i in range(free):
        V_bar[i] = y_bar[s.body_V_start + i] + a * y_bar[s.body_q_start + i]
    pull_source_states(s, w, y, a, signals, y_bar, V_bar)
    for pad in range(count):
        pads.assemble(s, w, pad, y, a, Rv)
        pads.pull_forces(s, w, z, pad, y_bar, a, V_bar, felt)
        contacts.transpose(s, w, pad)
        contacts.eliminate(s, w, pad, 1, nu, matrix)
    for i in range(free):
        nu[i, 0] = -nu[i, 0] - V_bar[i]
        for j in range(free):
            matrix[i, j] += Rv[j, i]
    solve_dense(matrix, nu, free, 1)

    for pad in range(count):
        contacts.load_nodes(s, w, pad, 1, nu)
        pull_points(s, w, z, pad, a, y_bar, p_bar, felt)
        pull_faded(s, w, z, pad, y, y_bar, a, p_bar)
        pads.pull_state(s, w, z, pad, y, y_bar, a, nu, z.V, p_bar)
    pull_bodies(s, w, z, y, a, signals, y_bar, p_bar, signals_bar)


@compiled
def pull_points(
    s: Any, w: Any, z: Any, pad: int, a: float, y_bar: Array, p_bar: Array, felt: bool
) -> None:
    """Cotangents of the nodal rates and displacements of a pad (z.rate, z.u), of coordinates and
    velocities (z.q, z.V), of points' states and of parameters, through the laws of its touching
    points."""
    at, X, rate, position = s.pad_point_start[pad], w.X[2 * s.pad_node_start[pad] :], z.by, z.moved
    z.rate[w.low[pad] : w.high[pad]], z.u[w.low[pad] : w.high[pad]] = 0.0, 0.0
    for c in range(s.contact_pad.size):
        if s.contact_pad[c] == pad:
            for row in range(6):
                number = s.contact_number[c, row]
                force = z.nu[number, 0] if number >= 0 else 0.0
                force += load_cotangent(s, z, c, row)
                for j in range(6):
                    z.q[s.contact_coordinate[c, j]] += w.by_pair[c, 6 + row, j] * force
    for i in range(at, at + w.actives[pad]):
        k = w.active[i]
        c, weights = s.point_contact[k], z.out[k]
        own, coordinate = bounds(s.contact_p_start, c), s.contact_coordinate[c]
        for j in range(2):
            if s.point_N[k, j] != 0.0:
                slot = 2 * w.slot[s.point_node[k, j]]
                add(s.point_N[k, j], X[slot : slot + 2, 0], weights[:2])
        for row in range(6):
            number = s.contact_number[c, row]
            if number >= 0:
                add(z.nu[number, 0], w.by_pair[c, 6 + row, 12:], weights[:WRENCH])
        call_pullback(s.contact_pullback[c], w.x[k], s.p[own], weights, p_bar[own])
        rate[:], position[:] = 0.0, 0.0
        for r in range(contacts.outputs(s, c, felt)):
            add(weights[r], w.H[i, r], rate)
            add(weights[r], w.S[i, r], position)
            for j in range(s.contact_states[c]):
                by = contacts.by_state(s, w, k, r, j)
                y_bar[contacts.state_at(s, k, j)] += by * weights[r]
        for j in range(2):
            add(s.point_N[k, j], rate, z.rate[s.point_node[k, j]])
            add(s.point_N[k, j], position, z.u[s.point_node[k, j]])
        for o in range(6):
            z.q[coordinate[o]] += position[2 + o]
            z.V[coordinate[o]] += rate[2 + o] - a * position[2 + o]


@compiled
def pull_faded(
    s: Any, w: Any, z: Any, pad: int, y: Array, y_bar: Array, a: float, p_bar: Array
) -> None:
    """Cotangents of the states of points away from contact."""
    at, i = s.pad_point_start[pad], s.pad_point_start[pad]
    for k in range(at, s.pad_point_start[pad + 1]):
        c, some = s.point_contact[k], False
        n = s.contact_states[c]
        if i < at + w.actives[pad] and w.active[i] == k:
            i += 1
            continue
        for o in range(n):
            some |= y_bar[contacts.state_at(s, k, o)] != 0.0
        if not some:
            continue
        contacts.fade(s, w, k, y, a)
        own = bounds(s.contact_p_start, c)
        for o in range(n):
            z.weights[o] = a * y_bar[contacts.state_at(s, k, o)]
        call_pullback(s.contact_free_pullback[c], w.decay_x, s.p[own], z.weights, p_bar[own])
        for q in range(n):
            own_state = contacts.state_at(s, k, q)
            for o in range(n):
                y_bar[own_state] += w.decay_J[o * n + q] * z.weights[o]
            if abs(y_bar[own_state]) < TINY:
                y_bar[own_state] = 0.0


@compiled
def pull_source_states(
    s: Any, w: Any, y: Array, a: float, signals: Array, y_bar: Array, V_bar: Array
) -> None:
    """Add the cotangents of the velocities at the stage's end to V_bar, by those of the sources'
    states."""
    for i in range(s.source_pushed.size):
        states = s.source_states[i]
        if states == 0:
            continue
        effort(s, w, i, y, signals, a)
        columns = first_state(s, i) + states
        for o in range(states):
            n, J = first_coordinate(s, i), w.effort_J[(1 + o) * columns : (2 + o) * columns]
            bar = a * y_bar[s.source_y_start[i] + o]
            for k in range(s.source_coordinate_start[i], s.source_coordinate_start[i + 1]):
                number = s.body_free[s.source_coordinate[k]]
                if number >= 0:
                    V_bar[number] += (a * J[n] + J[n + 1]) * bar
                n += 2


@compiled
def pull_bodies(
    s: Any, w: Any, z: Any, y: Array, a: float, signals: Array, y_bar: Array, p_bar: Array,
    signals_bar: Array,
) -> None:  # fmt: skip
    """Cotangents of the bodies' state, their masses, the sources' parameters and states, and the
    signals."""
    nu = z.nu
    for i in range(s.source_pushed.size):
        number, states, bar = s.body_free[s.source_pushed[i]], s.source_states[i], z.weights
        if number < 0 and states == 0:
            continue
        effort(s, w, i, y, signals, a)
        own, columns = bounds(s.source_p_start, i), first_state(s, i) + states
        bar[0] = nu[number, 0] if number >= 0 else 0.0
        for o in range(states):
            bar[1 + o] = a * y_bar[s.source_y_start[i] + o]
        call_pullback(s.source_pullback[i], w.effort_x, s.p[own], bar, p_bar[own])
        for o in range(1 + states):
            n, J = 0, w.effort_J[o * columns : (o + 1) * columns]
            for k in range(s.source_signal_start[i], s.source_signal_start[i + 1]):
                signals_bar[s.source_signal[k], 0] += bar[o] * J[n]
                signals_bar[s.source_signal[k], 1] += bar[o] * J[n + 1]
                n += 2
            for k in range(s.source_coordinate_start[i], s.source_coordinate_start[i + 1]):
                z.q[s.source_coordinate[k]] += bar[o] * J[n]
                z.V[s.source_coordinate[k]] += bar[o] * J[n + 1]
                n += 2
            for k in range(states):
                y_bar[s.source_y_start[i] + k] += bar[o] * J[n + k]
    for i in range(s.body_coordinate.size):
        c, mass = s.body_coordinate[i], s.p[s.body_mass_at[i]]
        p_bar[s.body_mass_at[i]] -= nu[i, 0] * (w.V[c] - y[s.body_V_start + i]) / a
        y_bar[s.body_q_start + i] += z.q[c]
        y_bar[s.body_V_start + i] = nu[i, 0] * mass / a
    for c in range(w.q.size):
        if s.body_free[c] < 0 and s.body_signal[c] >= 0:
            signals_bar[s.body_signal[c], 0] += z.q[c]
            signals_bar[s.body_signal[c], 1] += z.V[c]


@compiled
def output_adjoint(r: Any, i: int) -> None:
    """Add to the cotangents of output i's state, parameters and signals the share of its forces:
    the adjoint of the stage of no length that gives them."""
    bar, state = r.recorded_bar[i], r.z.state[0]
    some = False
    for j in range(bar.size):
        some |= bar[j] != 0.0
    if some:
        state[:] = 0.0
        stage_adjoint(
            r.s, r.w, r.z, r.out_tape, i, INSTANT, r.out_signals[i], state, r.p_bar,
            r.out_signals_bar[i], bar,
        )  # fmt: skip
        add(1.0, state, r.outputs_bar[i])


@compiled
def backward(r: Any) -> None:
    """Sweep the steps h of a tape backwards; y_bar goes from the end's cotangent to the start's, in
    place.

    outputs_bar (outputs, size) belong to the parts out_part of the steps out_step; where
    recorded_bar (outputs, recorded) of the forces there is not zero, they receive its share. The
    start is an output of step -1. signals and signals_bar are (stages, signals, 2),
    those of the outputs (outputs, signals, 2). failed receives -1, or the step at which a cotangent
    stopped being finite.
    """
    s, w, z, tape, h, signals, none = r.s, r.w, r.z, r.tape, r.h, r.signals, r.z.by[:0]
    y_bar, p_bar, signals_bar, row = r.y_bar, r.p_bar, r.signals_bar, r.out_step.size - 1
    first_bar, start_bar = z.state[1], z.state[2]
    r.failed[0] = -1
    for i in range(r.out_step.size):
        output_adjoint(r, i)
    for step in range(h.size - 1, -1, -1):
        a = GAMMA * h[step]
        first_bar[:], start_bar[:] = 0.0, 0.0
        while row >= 0 and r.out_step[row] == step:
            at_start, at_first, at_end = dense_states(r.out_part[row])
            add(at_end, r.outputs_bar[row], y_bar)
            add(at_first, r.outputs_bar[row], first_bar)
            add(at_start, r.outputs_bar[row], start_bar)
            row -= 1
        k = 2 * step + 1
        stage_adjoint(s, w, z, tape, k, a, signals[k], y_bar, p_bar, signals_bar[k], none)
        add(1.0 - MIX, y_bar, start_bar)
        add(MIX, y_bar, first_bar)
        k = 2 * step
        stage_adjoint(s, w, z, tape, k, a, signals[k], first_bar, p_bar, signals_bar[k], none)
        put(start_bar, y_bar)
        add(1.0, first_bar, y_bar)
        if not np.isfinite(y_bar.sum()):
            r.failed[0] = step
            return
    if row >= 0:  # the start
        add(1.0, r.outputs_bar[row], y_bar)
