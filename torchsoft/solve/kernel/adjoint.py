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
def load_cotangent(rig: Any, bars: Any, c: int, row: int) -> float:
    """Cotangent of the load of contact c on coordinate `row` of its body and its pad's base. The
    base of a pad with inertia is moved by the forces of its elements."""
    if inertial(rig, rig.contact_pad[c]) and 3 <= row < 5:
        return 0.0
    return bars.load[rig.contact_coordinate[c, row]]


@compiled
def seed(
    rig: Any, work: Any, bars: Any, tape: Any, row: int, a: float, y_bar: Array, p_bar: Array,
    forces_bar: Array,
) -> None:  # fmt: skip
    """Cotangents of the law's outputs at the touching points into bars.out, of loads and of the
    pads' forces and moments into bars.load and bars.wrenches; those of the forces of elements go on
    to displacements and rates."""
    bars.load[:], bars.wrenches[:], bars.rate_of[:] = 0.0, 0.0, 0.0
    felt, points, count = forces_bar.size > 0, rig.point_contact.size, rig.pad_base.size
    if felt:
        put(forces_bar[2 * points + 3 * count :], bars.load)
        for pad in range(count):
            first = 2 * points + 3 * pad
            put(forces_bar[first : first + 3], bars.wrenches[pad])
    for pad in range(count):
        at, wrench = rig.pad_point_start[pad], bars.wrenches[pad]
        for i in range(at, at + work.actives[pad]):
            k = work.active[i]
            bar, c = bars.out[k], rig.point_contact[k]
            n = rig.contact_states[c]
            bar[:] = 0.0
            for j in range(n):
                bar[WRENCH + j] = a * y_bar[contacts.state_at(rig, k, j)]
            if not felt:
                continue
            bar[WRENCH + n], bar[WRENCH + n + 1] = forces_bar[2 * k], forces_bar[2 * k + 1]
            for o in range(6):
                add(load_cotangent(rig, bars, c, o), work.by_pair[c, 6 + o, 12:], bar[:WRENCH])
            if not inertial(rig, pad):
                bar[0] += wrench[0] - rig.point_X[k, 1] * wrench[2]
                bar[1] += wrench[1] + rig.point_X[k, 0] * wrench[2]
        if felt and inertial(rig, pad):
            pull_felt(rig, work, bars, pad, tape.y[row], a, y_bar, p_bar)


@compiled
def stage_adjoint(
    rig: Any, work: Any, bars: Any, tape: Any, row: int, a: float, signals: Array, y_bar: Array,
    p_bar: Array, signals_bar: Array, forces_bar: Array,
) -> None:  # fmt: skip
    """Turn the cotangent y_bar (size,) of a stage's end into that of its y*, in place; add to p_bar
    and signals_bar. forces_bar (recorded,) are those of its forces, or empty."""
    free, count, y, felt = (
        rig.body_coordinate.size,
        rig.pad_base.size,
        tape.y[row],
        forces_bar.size > 0,
    )
    Rv, matrix, nu, V_bar = work.Rv, bars.matrix, bars.nu, bars.V_bar
    pads.restore(rig, work, tape, row, a, felt)
    seed(rig, work, bars, tape, row, a, y_bar, p_bar, forces_bar)
    balance(rig, work, y, signals, a, work.r, Rv)
    matrix[:], nu[:], bars.q[:], bars.V[:] = 0.0, 0.0, 0.0, 0.0
    for i in range(free):
        V_bar[i] = y_bar[rig.body_V_start + i] + a * y_bar[rig.body_q_start + i]
    pull_source_states(rig, work, y, a, signals, y_bar, V_bar)
    for pad in range(count):
        pads.assemble(rig, work, pad, y, a, Rv)
        pads.pull_forces(rig, work, bars, pad, y_bar, a, V_bar, felt)
        contacts.transpose(rig, work, pad)
        contacts.eliminate(rig, work, pad, 1, nu, matrix)
    for i in range(free):
        nu[i, 0] = -nu[i, 0] - V_bar[i]
        for j in range(free):
            matrix[i, j] += Rv[j, i]
    solve_dense(matrix, nu, free, 1)

    for pad in range(count):
        contacts.load_nodes(rig, work, pad, 1, nu)
        pull_points(rig, work, bars, pad, a, y_bar, p_bar, felt)
        pull_faded(rig, work, bars, pad, y, y_bar, a, p_bar)
        pads.pull_state(rig, work, bars, pad, y, y_bar, a, nu, bars.V, p_bar)
    pull_bodies(rig, work, bars, y, a, signals, y_bar, p_bar, signals_bar)


@compiled
def pull_points(
    rig: Any, work: Any, bars: Any, pad: int, a: float, y_bar: Array, p_bar: Array, felt: bool
) -> None:
    """Cotangents of the nodal rates and displacements of a pad (bars.rate, bars.u), of coordinates
    and velocities (bars.q, bars.V), of points' states and of parameters, through the laws of its
    touching points."""
    at, X, rate, position = (
        rig.pad_point_start[pad],
        work.X[2 * rig.pad_node_start[pad] :],
        bars.by,
        bars.moved,
    )
    bars.rate[work.low[pad] : work.high[pad]], bars.u[work.low[pad] : work.high[pad]] = 0.0, 0.0
    for c in range(rig.contact_pad.size):
        if rig.contact_pad[c] == pad:
            for row in range(6):
                number = rig.contact_number[c, row]
                force = bars.nu[number, 0] if number >= 0 else 0.0
                force += load_cotangent(rig, bars, c, row)
                for j in range(6):
                    bars.q[rig.contact_coordinate[c, j]] += work.by_pair[c, 6 + row, j] * force
    for i in range(at, at + work.actives[pad]):
        k = work.active[i]
        c, weights = rig.point_contact[k], bars.out[k]
        own, coordinate = bounds(rig.contact_p_start, c), rig.contact_coordinate[c]
        for j in range(2):
            if rig.point_N[k, j] != 0.0:
                slot = 2 * work.slot[rig.point_node[k, j]]
                add(rig.point_N[k, j], X[slot : slot + 2, 0], weights[:2])
        for row in range(6):
            number = rig.contact_number[c, row]
            if number >= 0:
                add(bars.nu[number, 0], work.by_pair[c, 6 + row, 12:], weights[:WRENCH])
        call_pullback(rig.contact_pullback[c], work.x[k], rig.p[own], weights, p_bar[own])
        rate[:], position[:] = 0.0, 0.0
        for r in range(contacts.outputs(rig, c, felt)):
            add(weights[r], work.H[i, r], rate)
            add(weights[r], work.S[i, r], position)
            for j in range(rig.contact_states[c]):
                by = contacts.by_state(rig, work, k, r, j)
                y_bar[contacts.state_at(rig, k, j)] += by * weights[r]
        for j in range(2):
            add(rig.point_N[k, j], rate, bars.rate[rig.point_node[k, j]])
            add(rig.point_N[k, j], position, bars.u[rig.point_node[k, j]])
        for o in range(6):
            bars.q[coordinate[o]] += position[2 + o]
            bars.V[coordinate[o]] += rate[2 + o] - a * position[2 + o]


@compiled
def pull_faded(
    rig: Any, work: Any, bars: Any, pad: int, y: Array, y_bar: Array, a: float, p_bar: Array
) -> None:
    """Cotangents of the states of points away from contact."""
    at, i = rig.pad_point_start[pad], rig.pad_point_start[pad]
    for k in range(at, rig.pad_point_start[pad + 1]):
        c, some = rig.point_contact[k], False
        n = rig.contact_states[c]
        if i < at + work.actives[pad] and work.active[i] == k:
            i += 1
            continue
        for o in range(n):
            some |= y_bar[contacts.state_at(rig, k, o)] != 0.0
        if not some:
            continue
        contacts.fade(rig, work, k, y, a)
        own = bounds(rig.contact_p_start, c)
        for o in range(n):
            bars.weights[o] = a * y_bar[contacts.state_at(rig, k, o)]
        call_pullback(
            rig.contact_free_pullback[c], work.decay_x, rig.p[own], bars.weights, p_bar[own]
        )
        for q in range(n):
            own_state = contacts.state_at(rig, k, q)
            for o in range(n):
                y_bar[own_state] += work.decay_J[o * n + q] * bars.weights[o]
            if abs(y_bar[own_state]) < TINY:
                y_bar[own_state] = 0.0


@compiled
def pull_source_states(
    rig: Any, work: Any, y: Array, a: float, signals: Array, y_bar: Array, V_bar: Array
) -> None:
    """Add the cotangents of the velocities at the stage's end to V_bar, by those of the sources'
    states."""
    for i in range(rig.source_pushed.size):
        states = rig.source_states[i]
        if states == 0:
            continue
        effort(rig, work, i, y, signals, a)
        columns = first_state(rig, i) + states
        for o in range(states):
            n, J = first_coordinate(rig, i), work.effort_J[(1 + o) * columns : (2 + o) * columns]
            bar = a * y_bar[rig.source_y_start[i] + o]
            for k in range(rig.source_coordinate_start[i], rig.source_coordinate_start[i + 1]):
                number = rig.body_free[rig.source_coordinate[k]]
                if number >= 0:
                    V_bar[number] += (a * J[n] + J[n + 1]) * bar
                n += 2


@compiled
def pull_bodies(
    rig: Any, work: Any, bars: Any, y: Array, a: float, signals: Array, y_bar: Array, p_bar: Array,
    signals_bar: Array,
) -> None:  # fmt: skip
    """Cotangents of the bodies' state, their masses, the sources' parameters and states, and the
    signals."""
    nu = bars.nu
    for i in range(rig.source_pushed.size):
        number, states, bar = (
            rig.body_free[rig.source_pushed[i]],
            rig.source_states[i],
            bars.weights,
        )
        if number < 0 and states == 0:
            continue
        effort(rig, work, i, y, signals, a)
        own, columns = bounds(rig.source_p_start, i), first_state(rig, i) + states
        bar[0] = nu[number, 0] if number >= 0 else 0.0
        for o in range(states):
            bar[1 + o] = a * y_bar[rig.source_y_start[i] + o]
        call_pullback(rig.source_pullback[i], work.effort_x, rig.p[own], bar, p_bar[own])
        for o in range(1 + states):
            n, J = 0, work.effort_J[o * columns : (o + 1) * columns]
            for k in range(rig.source_signal_start[i], rig.source_signal_start[i + 1]):
                signals_bar[rig.source_signal[k], 0] += bar[o] * J[n]
                signals_bar[rig.source_signal[k], 1] += bar[o] * J[n + 1]
                n += 2
            for k in range(rig.source_coordinate_start[i], rig.source_coordinate_start[i + 1]):
                bars.q[rig.source_coordinate[k]] += bar[o] * J[n]
                bars.V[rig.source_coordinate[k]] += bar[o] * J[n + 1]
                n += 2
            for k in range(states):
                y_bar[rig.source_y_start[i] + k] += bar[o] * J[n + k]
    for i in range(rig.body_coordinate.size):
        c, mass = rig.body_coordinate[i], rig.p[rig.body_mass_at[i]]
        p_bar[rig.body_mass_at[i]] -= nu[i, 0] * (work.V[c] - y[rig.body_V_start + i]) / a
        y_bar[rig.body_q_start + i] += bars.q[c]
        y_bar[rig.body_V_start + i] = nu[i, 0] * mass / a
    for c in range(work.q.size):
        if rig.body_free[c] < 0 and rig.body_signal[c] >= 0:
            signals_bar[rig.body_signal[c], 0] += bars.q[c]
            signals_bar[rig.body_signal[c], 1] += bars.V[c]


@compiled
def output_adjoint(call: Any, i: int) -> None:
    """Add to the cotangents of output i's state, parameters and signals the share of its forces:
    the adjoint of the stage of no length that gives them."""
    bar, state = call.recorded_bar[i], call.bars.state[0]
    some = False
    for j in range(bar.size):
        some |= bar[j] != 0.0
    if some:
        state[:] = 0.0
        stage_adjoint(
            call.rig, call.work, call.bars, call.out_tape, i, INSTANT, call.out_signals[i], state,
            call.p_bar, call.out_signals_bar[i], bar,
        )  # fmt: skip
        add(1.0, state, call.outputs_bar[i])


@compiled
def backward(call: Any) -> None:
    """Sweep the steps h of a tape backwards; y_bar goes from the end's cotangent to the start's, in
    place.

    outputs_bar (outputs, size) belong to the parts out_part of the steps out_step; where
    recorded_bar (outputs, recorded) of the forces there is not zero, they receive its share. The
    start is an output of step -1. signals and signals_bar are (stages, signals, 2),
    those of the outputs (outputs, signals, 2). failed receives -1, or the step at which a cotangent
    stopped being finite.
    """
    rig, work, bars, tape, h, signals, none = (
        call.rig,
        call.work,
        call.bars,
        call.tape,
        call.h,
        call.signals,
        call.bars.by[:0],
    )
    y_bar, p_bar, signals_bar, row = (
        call.y_bar,
        call.p_bar,
        call.signals_bar,
        call.out_step.size - 1,
    )
    first_bar, start_bar = bars.state[1], bars.state[2]
    call.failed[0] = -1
    for i in range(call.out_step.size):
        output_adjoint(call, i)
    for step in range(h.size - 1, -1, -1):
        a = GAMMA * h[step]
        first_bar[:], start_bar[:] = 0.0, 0.0
        while row >= 0 and call.out_step[row] == step:
            at_start, at_first, at_end = dense_states(call.out_part[row])
            add(at_end, call.outputs_bar[row], y_bar)
            add(at_first, call.outputs_bar[row], first_bar)
            add(at_start, call.outputs_bar[row], start_bar)
            row -= 1
        k = 2 * step + 1
        stage_adjoint(rig, work, bars, tape, k, a, signals[k], y_bar, p_bar, signals_bar[k], none)
        add(1.0 - MIX, y_bar, start_bar)
        add(MIX, y_bar, first_bar)
        k = 2 * step
        stage_adjoint(
            rig, work, bars, tape, k, a, signals[k], first_bar, p_bar, signals_bar[k], none
        )
        put(start_bar, y_bar)
        add(1.0, first_bar, y_bar)
        if not np.isfinite(y_bar.sum()):
            call.failed[0] = step
            return
    if row >= 0:  # the start
        add(1.0, call.outputs_bar[row], y_bar)
