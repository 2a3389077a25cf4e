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
def push_bodies(
    s: Any, w: Any, z: Any, y: Array, a: float, signals: Array, dy: Array, dp: Array
) -> None:
    """Tangents of the bodies' equations without contact, at the same velocities, into z.r."""
    r = z.r
    for i in range(s.body_coordinate.size):
        mass = s.p[s.body_mass_at[i]]
        rate = (w.V[s.body_coordinate[i]] - y[s.body_V_start + i]) / a
        for k in range(dy.shape[1]):
            r[i, k] = mass * dy[s.body_V_start + i, k] / a - rate * dp[s.body_mass_at[i], k]
    for i in range(s.source_pushed.size):
        number = s.body_free[s.source_pushed[i]]
        if number < 0:
            continue
        effort(s, w, i, y, signals, a)
        own = bounds(s.source_p_start, i)
        law_derivatives(z, s.source_pullback[i], w.effort_x, s.p[own], dp[own], 1, z.change)
        add(1.0, z.change[0], r[number])
        push_inputs(s, w, i, 0, dy, r[number])


@compiled
def push_inputs(s: Any, w: Any, i: int, o: int, dy: Array, out: Array) -> None:
    """Add the tangents (m,) of output o of source i at the same velocities, by coordinates and its
    states, to out."""
    n, columns = first_coordinate(s, i), first_state(s, i) + s.source_states[i]
    J = w.effort_J[o * columns : (o + 1) * columns]
    for j in range(s.source_coordinate_start[i], s.source_coordinate_start[i + 1]):
        measured = s.body_free[s.source_coordinate[j]]
        if measured >= 0:
            add(J[n], dy[s.body_q_start + measured], out)
        n += 2
    for j in range(s.source_states[i]):
        add(J[n + j], dy[s.source_y_start[i] + j], out)


@compiled
def push_source_states(
    s: Any, w: Any, z: Any, y: Array, a: float, signals: Array, dy: Array, dp: Array
) -> None:
    """Tangents of the sources' states at the stage's end, by those of its velocities, z.V."""
    for i in range(s.source_pushed.size):
        states = s.source_states[i]
        if states == 0:
            continue
        effort(s, w, i, y, signals, a)
        own, columns = bounds(s.source_p_start, i), first_state(s, i) + states
        pullback, rows = s.source_pullback[i], 1 + states
        law_derivatives(z, pullback, w.effort_x, s.p[own], dp[own], rows, z.change)
        for o in range(1, rows):
            push_inputs(s, w, i, o, dy, z.change[o])
            n, J = first_coordinate(s, i), w.effort_J[o * columns : (o + 1) * columns]
            for j in range(s.source_coordinate_start[i], s.source_coordinate_start[i + 1]):
                measured = s.body_free[s.source_coordinate[j]]
                if measured >= 0:
                    add(a * J[n] + J[n + 1], z.V[measured], z.change[o])
                n += 2
        for o in range(states):
            add(a, z.change[1 + o], dy[s.source_y_start[i] + o])


@compiled
def gather(s: Any, w: Any, k: int, nodal: Array, slots: bool, bodies: Array, out: Array) -> None:
    """A quantity of nodes (., 2, m), by their slots or themselves, and of bodies (free, m) as that
    of point k (8, m)."""
    out[:] = 0.0
    for j in range(2):
        node, N = s.point_node[k, j], s.point_N[k, j]
        for o in range(2 if N != 0.0 else 0):
            add(N, nodal[w.slot[node] if slots else node, o], out[o])
    for o in range(6):
        number = s.contact_number[s.point_contact[k], o]
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
    s: Any, w: Any, z: Any, pad: int, dy: Array, dp: Array, r: Array, felt: bool
) -> None:
    """Tangents of the outputs of the law at the touching points of a pad, before the change of
    forces and velocities, into z.e; those of the nodes' forces into w.X, of loads into r."""
    at, q, m = s.pad_point_start[pad], s.body_q_start, dy.shape[1]
    dq, X = dy[q : q + r.shape[0]], w.X[2 * s.pad_node_start[pad] :]
    X[: 2 * w.counts[pad], :m] = 0.0
    for c in range(s.contact_pad.size):
        if s.contact_pad[c] == pad:
            push_positions(s, w, z, c, dy, felt)
    for i in range(at, at + w.actives[pad]):
        k = w.active[i]
        c = s.point_contact[k]
        own, e = bounds(s.contact_p_start, c), z.e[k, : contacts.outputs(s, c, felt)]
        law_derivatives(z, s.contact_pullback[c], w.x[k], s.p[own], dp[own], e.shape[0], e)
        gather(s, w, k, z.u, False, dq, z.moved)
        transform(w.S[i], 8, z.moved, e)
        gather(s, w, k, z.v, False, dq, z.moved)
        transform(w.H[i], 2, z.moved, e)
        for o in range(e.shape[0]):
            for j in range(s.contact_states[c]):
                add(contacts.by_state(s, w, k, o, j), dy[contacts.state_at(s, k, j)], e[o])
        for j in range(2):
            N, slot = s.point_N[k, j], 2 * w.slot[s.point_node[k, j]]
            for o in range(2 if N != 0.0 else 0):
                add(N, e[o], X[slot + o, :m])
        for o in range(6):
            number = s.contact_number[c, o]
            for j in range(WRENCH if number >= 0 else 0):
                add(w.by_pair[c, 6 + o, 12 + j], e[j], r[number])


@compiled
def add_loads(s: Any, w: Any, z: Any, c: int, first: int, change: Array) -> None:
    """Add the loads of contact c by its pair's quantities from `first` on, times `change` (n, m),
    to z.recorded. The base of a pad with inertia is moved by the forces of its elements."""
    start = 2 * s.point_contact.size + 3 * s.pad_base.size
    carried = inertial(s, s.contact_pad[c])
    for o in range(6):
        for j in range(0 if carried and 3 <= o < 5 else change.shape[0]):
            by = w.by_pair[c, 6 + o, first + j]
            add(by, change[j], z.recorded[start + s.contact_coordinate[c, o]])


@compiled
def stage_tangent(
    s: Any, w: Any, z: Any, tape: Any, row: int, a: float, signals: Array, dy: Array, dp: Array,
    felt: bool,
) -> None:  # fmt: skip
    """Turn the tangent dy (size, m) of a stage's y* into that of its end, in place, or if `felt`
    leave it and put those of its forces into z.recorded; dp (parameters, m)."""
    y, m, Rv, r, dV = tape.y[row], dy.shape[1], w.Rv, z.r, z.V
    pads.restore(s, w, tape, row, a, felt)
    if felt:
        z.recorded[:] = 0.0
    balance(s, w, y, signals, a, w.r, Rv)
    push_bodies(s, w, z, y, a, signals, dy, dp)
    for pad in range(s.pad_base.size):
        pads.assemble(s, w, pad, y, a, Rv)
        pads.push(s, w, z, pad, y, dy, dp, a, r)
        push_points(s, w, z, pad, dy, dp, r, felt)
        contacts.eliminate(s, w, pad, m, r, Rv)
    dV[:] = 0.0
    for i in range(dV.shape[0]):
        add(-1.0, r[i], dV[i])
    solve_dense(Rv, dV, dV.shape[0], m)

    for pad in range(s.pad_base.size):
        pads.push_rates(s, w, z, pad, a, m)
        if felt:
            feel(s, w, z, pad, y, a, dy, dp)
        else:
            push_states(s, w, z, pad, y, a, dy, dp)
            pads.push_state(s, w, z, pad, y, a, dy, dp)
    if not felt:
        push_source_states(s, w, z, y, a, signals, dy, dp)
    for i in range(0 if felt else dV.shape[0]):
        add(a, dV[i], dy[s.body_q_start + i])
        put(dV[i], dy[s.body_V_start + i])


@compiled
def push_positions(s: Any, w: Any, z: Any, c: int, dy: Array, felt: bool) -> None:
    """Tangents of the loads of contact c by positions at the same wrench, in z.r."""
    moved = z.moved[:6]
    moved[:] = 0.0
    for o in range(6):
        number = s.contact_number[c, o]
        if number >= 0:
            put(dy[s.body_q_start + number], moved[o])
    for o in range(6):
        number = s.contact_number[c, o]
        for j in range(6 if number >= 0 else 0):
            add(w.by_pair[c, 6 + o, j], moved[j], z.r[number])
    if felt:
        add_loads(s, w, z, c, 0, moved)


@compiled
def feel(s: Any, w: Any, z: Any, pad: int, y: Array, a: float, dy: Array, dp: Array) -> None:
    """Tangents of a pad's forces into z.recorded, whose loads hold the part at the same forces."""
    at, wrench = s.pad_point_start[pad], 2 * s.point_contact.size + 3 * pad
    into = z.recorded
    for i in range(at, at + w.actives[pad]):
        k = w.active[i]
        c = s.point_contact[k]
        e = z.e[k, : contacts.outputs(s, c, True)]
        gather(s, w, k, z.own_rate, True, z.V, z.moved)
        transform(w.H[i], 8, z.moved, e)
        forces = WRENCH + s.contact_states[c]
        put(e[forces], into[2 * k])
        put(e[forces + 1], into[2 * k + 1])
        add_loads(s, w, z, c, 12, e[:WRENCH])
        if not inertial(s, pad):
            add(1.0, e[0], into[wrench])
            add(1.0, e[1], into[wrench + 1])
            add(s.point_X[k, 0], e[1], into[wrench + 2])
            add(-s.point_X[k, 1], e[0], into[wrench + 2])
    if inertial(s, pad):
        push_felt(s, w, z, pad, y, a, dy, dp)


@compiled
def push_states(s: Any, w: Any, z: Any, pad: int, y: Array, a: float, dy: Array, dp: Array) -> None:
    """Tangents of the states of a pad's points at the stage's end."""
    at, i = s.pad_point_start[pad], s.pad_point_start[pad]
    for k in range(at, s.pad_point_start[pad + 1]):
        if i < at + w.actives[pad] and w.active[i] == k:
            e = z.e[k, WRENCH : WRENCH + s.contact_states[s.point_contact[k]]]
            gather(s, w, k, z.own_rate, True, z.V, z.moved)
            transform(w.H[i, WRENCH:], 8, z.moved, e)
            for o in range(e.shape[0]):
                add(a, e[o], dy[contacts.state_at(s, k, o)])
            i += 1
            continue
        some = not contacts.rests(s, k, y)
        for d in range(dy.shape[1]):
            some |= dy[s.point_y_start[k], d] != 0.0
        if some:
            push_faded(s, w, z, k, y, a, dy, dp)


@compiled
def push_faded(s: Any, w: Any, z: Any, k: int, y: Array, a: float, dy: Array, dp: Array) -> None:
    """The same at point k away from contact."""
    c = s.point_contact[k]
    n, own = s.contact_states[c], bounds(s.contact_p_start, c)
    contacts.fade(s, w, k, y, a)
    law_derivatives(z, s.contact_free_pullback[c], w.decay_x, s.p[own], dp[own], n, z.change)
    for o in range(n):
        put(z.change[o], z.decay[o])
        for q in range(n):
            add(w.decay_J[o * n + q], dy[contacts.state_at(s, k, q)], z.decay[o])
    for o in range(n):
        own_state = dy[contacts.state_at(s, k, o)]
        for d in range(dy.shape[1]):
            new = own_state[d] + a * z.decay[o, d]
            own_state[d] = new if abs(new) > 1e-200 else 0.0


@compiled
def read(r: Any, i: int) -> None:
    """Tangents of the sums of forces at output i into r.dsums."""
    out = r.dsums[i]
    if out.shape[0] == 0:
        return
    stage_tangent(r.s, r.w, r.z, r.out_tape, i, INSTANT, r.out_signals[i], r.dys[i], r.dp, True)
    for c in range(out.shape[0]):
        out[c] = 0.0
        for j in range(r.sum_start[c], r.sum_start[c + 1]):
            add(r.sum_weight[j], r.z.recorded[r.sum_at[j]], out[c])


@compiled
def forward(r: Any) -> None:
    """Carry the tangent dy (size, m) through the steps h of a tape, in place; dys (outputs, size,
    m) receives it at the parts out_part of the steps out_step, dsums (outputs, sums, m)
    those of the sums of forces, `Sums`. The start is an output of step -1."""
    s, w, z, tape, h, signals = r.s, r.w, r.z, r.tape, r.h, r.signals
    out_step, dy, dp, dys, row = r.out_step, r.dy, r.dp, r.dys, 0
    if out_step.size > 0 and out_step[0] < 0:  # the start
        put(dy, dys[0])
        if r.out_tape.y.shape[0] > 0:
            pads.find_spans(s, r.out_tape.y[0], dy, z.span)
        read(r, 0)
        row = 1
    for step in range(h.size):
        a = GAMMA * h[step]
        if step % RESCAN == 0:
            pads.find_spans(s, tape.y[2 * step], dy, z.span)
        put(dy, z.before)
        stage_tangent(s, w, z, tape, 2 * step, a, signals[2 * step], dy, dp, False)
        put(dy, z.first)
        mix(1.0 - MIX, z.before, MIX, z.first, 0.0, dy, dy)
        stage_tangent(s, w, z, tape, 2 * step + 1, a, signals[2 * step + 1], dy, dp, False)
        while row < out_step.size and out_step[row] == step:
            at_start, at_first, at_end = dense_states(r.out_part[row])
            mix(at_start, z.before, at_first, z.first, at_end, dy, dys[row])
            read(r, row)
            row += 1


@compiled
def mix(a: float, x: Array, b: float, y: Array, c: float, z: Array, out: Array) -> None:
    """a x + b y + c z into an array of their shape."""
    for i in range(out.size):
        out.flat[i] = a * x.flat[i] + b * y.flat[i] + c * z.flat[i]
