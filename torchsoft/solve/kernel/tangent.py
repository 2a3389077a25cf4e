"""The tangent stage: forward sensitivities of `run` in several directions at once.

One factorisation of Newton's system a stage, as many right-hand sides as there are directions. A
`d` before a name is its derivative, the last axis counts directions.
"""

from typing import Any

from torchsoft.solve.kernel import compiled, contacts, pads
from torchsoft.solve.kernel.arrays import GAMMA, INSTANT, MIX, WRENCH
from torchsoft.solve.kernel.invoke import call_pullback
from torchsoft.solve.kernel.linear import add, bounds, put, solve_dense
from torchsoft.solve.kernel.nodal import inertial, push_felt
from torchsoft.solve.kernel.sources import balance, effort, first_coordinate, first_state
from torchsoft.solve.kernel.step import dense_states
from torchsoft.solve.kernel.table import Array

RESCAN = 64
"""Steps between two searches for negligible derivatives."""


@compiled
def law_derivatives(
    tangents: Any, address: int, x: Array, p: Array, dp: Array, rows: int, out: Array
) -> None:
    """d law / dp along dp (parameters, m), with x held, into out (rows, m)."""
    weights, gradient = tangents.weights, tangents.gradient[: p.size]
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
def push_bodies(
    rig: Any, work: Any, tangents: Any, y: Array, a: float, signals: Array, dy: Array, dp: Array,
    dsignals: Array,
) -> None:  # fmt: skip
    """Tangents of the bodies' equations without contact, at the same velocities, into
    tangents.r."""
    r = tangents.r
    for i in range(rig.body_coordinate.size):
        mass = rig.p[rig.body_mass_at[i]]
        rate = (work.V[rig.body_coordinate[i]] - y[rig.body_V_start + i]) / a
        for k in range(dy.shape[1]):
            r[i, k] = mass * dy[rig.body_V_start + i, k] / a - rate * dp[rig.body_mass_at[i], k]
    for i in range(rig.source_pushed.size):
        number = rig.body_free[rig.source_pushed[i]]
        if number < 0:
            continue
        effort(rig, work, i, y, signals, a)
        own = bounds(rig.source_p_start, i)
        law_derivatives(
            tangents, rig.source_pullback[i], work.effort_x, rig.p[own], dp[own], 1, tangents.change
        )
        add(1.0, tangents.change[0], r[number])
        push_inputs(rig, work, i, 0, dy, dsignals, r[number])


@compiled
def push_inputs(
    rig: Any, work: Any, i: int, o: int, dy: Array, dsignals: Array, out: Array
) -> None:
    """Add the tangents (m,) of output o of source i at the same velocities, by signals dsignals
    (2 signals, m), coordinates and its states, to out."""
    n, columns = first_coordinate(rig, i), first_state(rig, i) + rig.source_states[i]
    J = work.effort_J[o * columns : (o + 1) * columns]
    first = rig.source_signal_start[i]
    for k in range(first, rig.source_signal_start[i + 1] if dsignals.shape[0] > 0 else first):
        signal = rig.source_signal[k]
        add(J[2 * (k - first)], dsignals[2 * signal], out)
        add(J[2 * (k - first) + 1], dsignals[2 * signal + 1], out)
    for j in range(rig.source_coordinate_start[i], rig.source_coordinate_start[i + 1]):
        measured = rig.body_free[rig.source_coordinate[j]]
        if measured >= 0:
            add(J[n], dy[rig.body_q_start + measured], out)
        n += 2
    for j in range(rig.source_states[i]):
        add(J[n + j], dy[rig.source_y_start[i] + j], out)


@compiled
def push_source_states(
    rig: Any, work: Any, tangents: Any, y: Array, a: float, signals: Array, dy: Array, dp: Array,
    dsignals: Array,
) -> None:  # fmt: skip
    """Tangents of the sources' states at the stage's end, by those of its velocities,
    tangents.V."""
    for i in range(rig.source_pushed.size):
        states = rig.source_states[i]
        if states == 0:
            continue
        effort(rig, work, i, y, signals, a)
        own, columns = bounds(rig.source_p_start, i), first_state(rig, i) + states
        pullback, rows = rig.source_pullback[i], 1 + states
        law_derivatives(
            tangents, pullback, work.effort_x, rig.p[own], dp[own], rows, tangents.change
        )
        for o in range(1, rows):
            push_inputs(rig, work, i, o, dy, dsignals, tangents.change[o])
            n, J = first_coordinate(rig, i), work.effort_J[o * columns : (o + 1) * columns]
            for j in range(rig.source_coordinate_start[i], rig.source_coordinate_start[i + 1]):
                measured = rig.body_free[rig.source_coordinate[j]]
                if measured >= 0:
                    add(a * J[n] + J[n + 1], tangents.V[measured], tangents.change[o])
                n += 2
        for o in range(states):
            add(a, tangents.change[1 + o], dy[rig.source_y_start[i] + o])


@compiled
def gather(
    rig: Any, work: Any, k: int, nodal: Array, slots: bool, bodies: Array, out: Array
) -> None:
    """A quantity of nodes (., 2, m), by their slots or themselves, and of bodies (free, m) as that
    of point k (8, m)."""
    out[:] = 0.0
    for j in range(2):
        node, N = rig.point_node[k, j], rig.point_N[k, j]
        for o in range(2 if N != 0.0 else 0):
            add(N, nodal[work.slot[node] if slots else node, o], out[o])
    for o in range(6):
        number = rig.contact_number[rig.point_contact[k], o]
        if number >= 0:
            put(bodies[number], out[2 + o])


@compiled
def transform(J: Array, columns: int, x: Array, out: Array) -> None:
    """Add J x to out (rows, m), of the first columns of J (., 8)."""
    for o in range(out.shape[0]):
        for j in range(columns):
            add(J[o, j], x[j], out[o])


@compiled
def push_points(
    rig: Any, work: Any, tangents: Any, pad: int, dy: Array, dp: Array, r: Array, felt: bool
) -> None:
    """Tangents of the outputs of the law at the touching points of a pad, before the change of
    forces and velocities, into tangents.e; those of the nodes' forces into work.X, of loads into
    r."""
    at, q, m = rig.pad_point_start[pad], rig.body_q_start, dy.shape[1]
    dq, X = dy[q : q + r.shape[0]], work.X[2 * rig.pad_node_start[pad] :]
    X[: 2 * work.counts[pad], :m] = 0.0
    for c in range(rig.contact_pad.size):
        if rig.contact_pad[c] == pad:
            push_positions(rig, work, tangents, c, dy, felt)
    for i in range(at, at + work.actives[pad]):
        k = work.active[i]
        c = rig.point_contact[k]
        own, e = bounds(rig.contact_p_start, c), tangents.e[k, : contacts.outputs(rig, c, felt)]
        law_derivatives(
            tangents, rig.contact_pullback[c], work.x[k], rig.p[own], dp[own], e.shape[0], e
        )
        gather(rig, work, k, tangents.u, False, dq, tangents.moved)
        transform(work.S[i], 8, tangents.moved, e)
        gather(rig, work, k, tangents.v, False, dq, tangents.moved)
        transform(work.H[i], 2, tangents.moved, e)
        for o in range(e.shape[0]):
            for j in range(rig.contact_states[c]):
                add(contacts.by_state(rig, work, k, o, j), dy[contacts.state_at(rig, k, j)], e[o])
        for j in range(2):
            N, slot = rig.point_N[k, j], 2 * work.slot[rig.point_node[k, j]]
            for o in range(2 if N != 0.0 else 0):
                add(N, e[o], X[slot + o, :m])
        for o in range(6):
            number = rig.contact_number[c, o]
            for j in range(WRENCH if number >= 0 else 0):
                add(work.by_pair[c, 6 + o, 12 + j], e[j], r[number])


@compiled
def add_loads(rig: Any, work: Any, tangents: Any, c: int, first: int, change: Array) -> None:
    """Add the loads of contact c by its pair's quantities from `first` on, times `change` (n, m),
    to tangents.recorded. The base of a pad with inertia is moved by the forces of its elements."""
    start = 2 * rig.point_contact.size + 3 * rig.pad_base.size
    carried = inertial(rig, rig.contact_pad[c])
    for o in range(6):
        for j in range(0 if carried and 3 <= o < 5 else change.shape[0]):
            by = work.by_pair[c, 6 + o, first + j]
            add(by, change[j], tangents.recorded[start + rig.contact_coordinate[c, o]])


@compiled
def stage_tangent(
    rig: Any, work: Any, tangents: Any, tape: Any, row: int, a: float, signals: Array, dy: Array,
    dp: Array, dsignals: Array, felt: bool,
) -> None:  # fmt: skip
    """Turn the tangent dy (size, m) of a stage's y* into that of its end, in place, or if `felt`
    leave it and put those of its forces into tangents.recorded; dp (parameters, m), dsignals (2
    signals, m), or (0, m) where no signal changes."""
    y, m, Rv, r, dV = tape.y[row], dy.shape[1], work.Rv, tangents.r, tangents.V
    pads.restore(rig, work, tape, row, a, felt)
    if felt:
        tangents.recorded[:] = 0.0
    balance(rig, work, y, signals, a, work.r, Rv)
    push_bodies(rig, work, tangents, y, a, signals, dy, dp, dsignals)
    for pad in range(rig.pad_base.size):
        pads.assemble(rig, work, pad, y, a, Rv)
        pads.push(rig, work, tangents, pad, y, dy, dp, a, r)
        push_points(rig, work, tangents, pad, dy, dp, r, felt)
        contacts.eliminate(rig, work, pad, m, r, Rv)
    dV[:] = 0.0
    for i in range(dV.shape[0]):
        add(-1.0, r[i], dV[i])
    solve_dense(Rv, dV, dV.shape[0], m)

    for pad in range(rig.pad_base.size):
        pads.push_rates(rig, work, tangents, pad, a, m)
        if felt:
            feel(rig, work, tangents, pad, y, a, dy, dp)
        else:
            push_states(rig, work, tangents, pad, y, a, dy, dp)
            pads.push_state(rig, work, tangents, pad, y, a, dy, dp)
    if not felt:
        push_source_states(rig, work, tangents, y, a, signals, dy, dp, dsignals)
    for i in range(0 if felt else dV.shape[0]):
        add(a, dV[i], dy[rig.body_q_start + i])
        put(dV[i], dy[rig.body_V_start + i])


@compiled
def push_positions(rig: Any, work: Any, tangents: Any, c: int, dy: Array, felt: bool) -> None:
    """Tangents of the loads of contact c by positions at the same wrench, in tangents.r."""
    moved = tangents.moved[:6]
    moved[:] = 0.0
    for o in range(6):
        number = rig.contact_number[c, o]
        if number >= 0:
            put(dy[rig.body_q_start + number], moved[o])
    for o in range(6):
        number = rig.contact_number[c, o]
        for j in range(6 if number >= 0 else 0):
            add(work.by_pair[c, 6 + o, j], moved[j], tangents.r[number])
    if felt:
        add_loads(rig, work, tangents, c, 0, moved)


@compiled
def feel(
    rig: Any, work: Any, tangents: Any, pad: int, y: Array, a: float, dy: Array, dp: Array
) -> None:
    """Tangents of a pad's forces into tangents.recorded, whose loads hold the part at the same
    forces."""
    at, wrench = rig.pad_point_start[pad], 2 * rig.point_contact.size + 3 * pad
    into = tangents.recorded
    for i in range(at, at + work.actives[pad]):
        k = work.active[i]
        c = rig.point_contact[k]
        e = tangents.e[k, : contacts.outputs(rig, c, True)]
        gather(rig, work, k, tangents.own_rate, True, tangents.V, tangents.moved)
        transform(work.H[i], 8, tangents.moved, e)
        forces = WRENCH + rig.contact_states[c]
        put(e[forces], into[2 * k])
        put(e[forces + 1], into[2 * k + 1])
        add_loads(rig, work, tangents, c, 12, e[:WRENCH])
        if not inertial(rig, pad):
            add(1.0, e[0], into[wrench])
            add(1.0, e[1], into[wrench + 1])
            add(rig.point_X[k, 0], e[1], into[wrench + 2])
            add(-rig.point_X[k, 1], e[0], into[wrench + 2])
    if inertial(rig, pad):
        push_felt(rig, work, tangents, pad, y, a, dy, dp)


@compiled
def push_states(
    rig: Any, work: Any, tangents: Any, pad: int, y: Array, a: float, dy: Array, dp: Array
) -> None:
    """Tangents of the states of a pad's points at the stage's end."""
    at, i = rig.pad_point_start[pad], rig.pad_point_start[pad]
    for k in range(at, rig.pad_point_start[pad + 1]):
        if i < at + work.actives[pad] and work.active[i] == k:
            e = tangents.e[k, WRENCH : WRENCH + rig.contact_states[rig.point_contact[k]]]
            gather(rig, work, k, tangents.own_rate, True, tangents.V, tangents.moved)
            transform(work.H[i, WRENCH:], 8, tangents.moved, e)
            for o in range(e.shape[0]):
                add(a, e[o], dy[contacts.state_at(rig, k, o)])
            i += 1
            continue
        some = not contacts.rests(rig, k, y)
        for d in range(dy.shape[1]):
            some |= dy[rig.point_y_start[k], d] != 0.0
        if some:
            push_faded(rig, work, tangents, k, y, a, dy, dp)


@compiled
def push_faded(
    rig: Any, work: Any, tangents: Any, k: int, y: Array, a: float, dy: Array, dp: Array
) -> None:
    """The same at point k away from contact."""
    c = rig.point_contact[k]
    n, own = rig.contact_states[c], bounds(rig.contact_p_start, c)
    contacts.fade(rig, work, k, y, a)
    law_derivatives(
        tangents,
        rig.contact_free_pullback[c],
        work.decay_x,
        rig.p[own],
        dp[own],
        n,
        tangents.change,
    )
    for o in range(n):
        put(tangents.change[o], tangents.decay[o])
        for q in range(n):
            add(work.decay_J[o * n + q], dy[contacts.state_at(rig, k, q)], tangents.decay[o])
    for o in range(n):
        own_state = dy[contacts.state_at(rig, k, o)]
        for d in range(dy.shape[1]):
            new = own_state[d] + a * tangents.decay[o, d]
            own_state[d] = new if abs(new) > 1e-200 else 0.0


@compiled
def read(call: Any, i: int) -> None:
    """Tangents of the sums of forces at output i into r.dsums."""
    out = call.dsums[i]
    if out.shape[0] == 0:
        return
    stage_tangent(
        call.rig,
        call.work,
        call.tangents,
        call.out_tape,
        i,
        INSTANT,
        call.out_signals[i],
        call.dys[i],
        call.dp,
        call.dsignals[0, :0],
        True,
    )
    for c in range(out.shape[0]):
        out[c] = 0.0
        for j in range(call.sum_start[c], call.sum_start[c + 1]):
            add(call.sum_weight[j], call.tangents.recorded[call.sum_at[j]], out[c])


@compiled
def forward(call: Any) -> None:
    """Carry the tangent dy (size, m) through the steps h of a tape, in place; dys (outputs, size,
    m) receives it at the parts out_part of the steps out_step, dsums (outputs, sums, m)
    those of the sums of forces, `Sums`. The start is an output of step -1."""
    rig, work, tangents, tape, h, signals = (
        call.rig,
        call.work,
        call.tangents,
        call.tape,
        call.h,
        call.signals,
    )
    out_step, dy, dp, dys, row = call.out_step, call.dy, call.dp, call.dys, 0
    dsignals = call.dsignals
    if out_step.size > 0 and out_step[0] < 0:  # the start
        put(dy, dys[0])
        if call.out_tape.y.shape[0] > 0:
            pads.find_spans(rig, call.out_tape.y[0], dy, tangents.span)
        read(call, 0)
        row = 1
    for step in range(h.size):
        a = GAMMA * h[step]
        if step % RESCAN == 0:
            pads.find_spans(rig, tape.y[2 * step], dy, tangents.span)
        put(dy, tangents.before)
        stage_tangent(
            rig, work, tangents, tape, 2 * step, a, signals[2 * step], dy, dp, dsignals[2 * step],
            False,
        )  # fmt: skip
        put(dy, tangents.first)
        mix(1.0 - MIX, tangents.before, MIX, tangents.first, 0.0, dy, dy)
        stage_tangent(
            rig, work, tangents, tape, 2 * step + 1, a, signals[2 * step + 1], dy, dp,
            dsignals[2 * step + 1], False,
        )  # fmt: skip
        while row < out_step.size and out_step[row] == step:
            at_start, at_first, at_end = dense_states(call.out_part[row])
            mix(at_start, tangents.before, at_first, tangents.first, at_end, dy, dys[row])
            read(call, row)
            row += 1


@compiled
def mix(a: float, x: Array, b: float, y: Array, c: float, z: Array, out: Array) -> None:
    """a x + b y + c z into an array of their shape."""
    for i in range(out.size):
        out.flat[i] = a * x.flat[i] + b * y.flat[i] + c * z.flat[i]
