"""Derivatives through the laws of a stage, from the state and the parameters to its equations, in
as many directions as arrays have columns; or `back`, which is the transpose: every array that is
read receives then, and every one that receives is read.

`along` has the arrays of `Directions`; dy (state, columns) and dp (parameters, columns) are the
derivatives of the state and of the parameters, or their cotangents.
"""

from typing import Any

from torchsoft.solve.kernel import compiled, contacts
from torchsoft.solve.kernel.arrays import AXES, PAIR, SIDE, TINY, WRENCH
from torchsoft.solve.kernel.invoke import call_pull, call_push
from torchsoft.solve.kernel.linear import add, bounds, carry, dot
from torchsoft.solve.kernel.nodal import inertial
from torchsoft.solve.kernel.sources import effort
from torchsoft.solve.kernel.table import Array


@compiled
def carry_parameters(
    along: Any, push: int, pull: int, x: Array, p: Array, here: slice, dp: Array, out: Array,
    back: bool,
) -> None:  # fmt: skip
    """The outputs (rows, columns) of a law at x by its parameters, p[here]."""
    if back:
        call_pull(pull, x, p[here], out, dp[here])
        return
    direction, change = along.direction[: here.stop - here.start], along.change
    for k in range(dp.shape[1]):
        moved = False
        for j in range(direction.size):
            direction[j] = dp[here.start + j, k]
            moved |= direction[j] != 0.0
        if moved:
            call_push(push, x, p[here], direction, change)
            for o in range(out.shape[0]):
                out[o, k] += change[o]


@compiled
def carry_state(rig: Any, along: Any, dy: Array, dsignals: Array, back: bool) -> None:
    """What sources read and bodies are moved by, along.ports, from the state and the signals
    (2 signals, columns), which may have no rows where none changes."""
    for i in range(along.ports.shape[0]):
        if rig.port_y[i] >= 0:
            carry(1.0, dy[rig.port_y[i]], along.ports[i], back)
        elif rig.port_signal[i] >= 0 and dsignals.shape[0] > 0:
            carry(1.0, dsignals[rig.port_signal[i]], along.ports[i], back)


@compiled
def carry_source(rig: Any, work: Any, along: Any, i: int, out: Array, back: bool) -> None:
    """The effort of source i and the rates of its states by what it reads; needs `effort`."""
    inputs = rig.source_input[bounds(rig.source_input_start, i)]
    for o in range(out.shape[0]):
        for j in range(inputs.size):
            J = work.effort_J[o * inputs.size + j]
            carry(J, along.ports[inputs[j]], out[o], back)


@compiled
def carry_source_parameters(
    rig: Any, work: Any, along: Any, i: int, dp: Array, out: Array, back: bool
) -> None:
    """The same by its parameters."""
    here, push, pull = bounds(rig.source_p_start, i), rig.source_push[i], rig.source_pull[i]
    carry_parameters(along, push, pull, work.effort_x, rig.p, here, dp, out, back)


@compiled
def carry_bodies(
    rig: Any, work: Any, along: Any, y: Array, a: float, dy: Array, dp: Array, back: bool
) -> None:
    """The bodies' equations without contact, along.r, at the same velocities; back also from the
    states of sources at the stage's end."""
    for i in range(rig.source_pushed.size):
        number, states = rig.body_free[rig.source_pushed[i]], rig.source_states[i]
        if number < 0 and (states == 0 or not back):
            continue
        out = along.effort[: 1 + states]
        out[:] = 0.0
        if back:
            for o in range(states):
                add(a, dy[rig.source_y_start[i] + o], out[1 + o])
        if back and number >= 0:
            add(1.0, along.r[number], out[0])
        effort(rig, work, i, a)
        carry_source(rig, work, along, i, out, back)
        carry_source_parameters(rig, work, along, i, dp, out, back)
        if not back:
            add(1.0, out[0], along.r[number])
    for i in range(rig.body_coordinate.size):
        rate = (work.V[rig.body_coordinate[i]] - y[rig.body_V_start + i]) / a
        mass = rig.body_mass_at[i]
        if back:
            dy[rig.body_V_start + i] = 0.0
        carry(rig.p[mass] / a, dy[rig.body_V_start + i], along.r[i], back)
        carry(-rate, dp[mass], along.r[i], back)


@compiled
def carry_source_states(
    rig: Any, work: Any, along: Any, a: float, dy: Array, dp: Array, back: bool
) -> None:
    """The states of sources at the stage's end; back only to what they read."""
    for i in range(rig.source_pushed.size):
        states = rig.source_states[i]
        if states == 0:
            continue
        out = along.effort[: 1 + states]
        out[:] = 0.0
        effort(rig, work, i, a)
        if not back:
            carry_source(rig, work, along, i, out, back)
            carry_source_parameters(rig, work, along, i, dp, out, back)
        for o in range(states):
            carry(a, out[1 + o], dy[rig.source_y_start[i] + o], back)
        if back:
            carry_source(rig, work, along, i, out, back)


@compiled
def carry_entry(factor: float, x: Array, out: Array, j: int, back: bool) -> None:
    """Add a multiple of x (columns,) to entry j of the rows of `out`, or back."""
    for k in range(x.size):
        if back:
            x[k] += factor * out[k, j]
        else:
            out[k, j] += factor * x[k]


@compiled
def carry_to_point(
    rig: Any, work: Any, k: int, nodes: Array, slots: bool, bodies: Array, out: Array, back: bool
) -> None:
    """A quantity of nodes (., 2, columns), by their slots or themselves, and of coordinates as that
    of point k (columns, 8)."""
    for j in range(SIDE):
        node, N = rig.point_node[k, j], rig.point_N[k, j]
        for o in range(AXES if N != 0.0 else 0):
            carry_entry(N, nodes[work.slot[node] if slots else node, o], out, o, back)
    coordinate = rig.contact_coordinate[rig.point_contact[k]]
    for o in range(PAIR):
        carry_entry(1.0, bodies[coordinate[o]], out, AXES + o, back)


@compiled
def carry_through(
    rig: Any, work: Any, along: Any, k: int, J: Array, nodes: Array, slots: bool, bodies: Array,
    out: Array, back: bool,
) -> None:  # fmt: skip
    """The outputs of the law at point k by a quantity of nodes and of bodies, with derivatives
    J."""
    point = along.at_point
    point[:] = 0.0
    if not back:
        carry_to_point(rig, work, k, nodes, slots, bodies, point, back)
    for o in range(out.shape[0]):
        for column in range(out.shape[1]):
            if back:
                add(out[o, column], J[o], point[column])
            else:
                out[o, column] += dot(J[o], point[column])
    if back:
        carry_to_point(rig, work, k, nodes, slots, bodies, point, back)


@compiled
def carry_force(rig: Any, work: Any, along: Any, k: int, X: Array, out: Array, back: bool) -> None:
    """The force of point k to its nodes, X, and its wrench to the equations of bodies, along.r."""
    c, columns = rig.point_contact[k], out.shape[1]
    for j in range(SIDE):
        N, slot = rig.point_N[k, j], AXES * work.slot[rig.point_node[k, j]]
        for o in range(AXES if N != 0.0 else 0):
            carry(N, out[o], X[slot + o, :columns], back)
    for o in range(rig.contact_number.shape[1]):
        number = rig.contact_number[c, o]
        if number >= 0:
            load = work.by_pair[c, PAIR + o, 2 * PAIR :]
            for j in range(WRENCH):
                carry(load[j], out[j], along.r[number], back)


@compiled
def carry_points(
    rig: Any, work: Any, along: Any, pad: int, dy: Array, dp: Array, recorded: bool, back: bool
) -> None:
    """The outputs of the laws of a pad's touching points, along.out, before the change of forces
    and velocities; on to the nodes' forces, work.X, and to along.r."""
    at, X = rig.pad_point_start[pad], work.X[AXES * rig.pad_node_start[pad] :]
    if not back:
        X[: AXES * work.counts[pad], : dy.shape[1]] = 0.0
    for i in range(at, at + work.actives[pad]):
        k = work.active[i]
        c = rig.point_contact[k]
        out = along.out[k, : contacts.outputs(rig, c, recorded)]
        if back:
            carry_force(rig, work, along, k, X, out, back)
        else:
            out[:] = 0.0
        here, push, pull = bounds(rig.contact_p_start, c), rig.contact_push[c], rig.contact_pull[c]
        carry_parameters(along, push, pull, work.x[k], rig.p, here, dp, out, back)
        carry_through(rig, work, along, k, work.S[i], along.u, False, along.q, out, back)
        carry_through(rig, work, along, k, work.H[i], along.rate, False, along.V, out, back)
        for o in range(out.shape[0]):
            for j in range(rig.contact_states[c]):
                by = contacts.by_state(rig, work, k, o, j)
                carry(by, dy[contacts.state_at(rig, k, j)], out[o], back)
        if not back:
            carry_force(rig, work, along, k, X, out, back)


@compiled
def carry_loads(rig: Any, work: Any, along: Any, recorded: bool, back: bool) -> None:
    """The loads of contacts by positions at the same wrench, to along.r and to what is recorded."""
    for c in range(rig.contact_pad.size):
        for o in range(rig.contact_coordinate.shape[1]):
            number, load = rig.contact_number[c, o], contacts.load_at(rig, c, o)
            for j in range(rig.contact_coordinate.shape[1]):
                by = work.by_pair[c, PAIR + o, j]
                q = along.q[rig.contact_coordinate[c, j]]
                if number >= 0:
                    carry(by, q, along.r[number], back)
                if recorded and load >= 0:
                    carry(by, q, along.recorded[load], back)


@compiled
def carry_recorded(rig: Any, work: Any, along: Any, k: int, out: Array, back: bool) -> None:
    """What is recorded of the force of point k, of its pad's force and moment, and of loads."""
    c, recorded = rig.point_contact[k], along.recorded
    pad, force = rig.contact_pad[c], WRENCH + rig.contact_states[c]
    for o in range(AXES):
        carry(1.0, out[force + o], recorded[AXES * k + o], back)
    for o in range(rig.contact_coordinate.shape[1]):
        load = contacts.load_at(rig, c, o)
        for j in range(WRENCH if load >= 0 else 0):
            by = work.by_pair[c, PAIR + o, 2 * PAIR + j]
            carry(by, out[j], recorded[load], back)
    if not inertial(rig, pad):  # whose base is moved by the forces of its elements
        wrench = contacts.wrench_at(rig, pad)
        carry(1.0, out[0], recorded[wrench], back)
        carry(1.0, out[1], recorded[wrench + 1], back)
        carry(rig.point_X[k, 0], out[1], recorded[wrench + 2], back)
        carry(-rig.point_X[k, 1], out[0], recorded[wrench + 2], back)


@compiled
def carry_ends(
    rig: Any, work: Any, along: Any, pad: int, a: float, dy: Array, recorded: bool, back: bool
) -> None:
    """The states of a pad's touching points at the stage's end, or what is recorded, after the
    change of velocities and of the touched nodes' rates, along.touched_rate."""
    at = rig.pad_point_start[pad]
    for i in range(at, at + work.actives[pad]):
        k = work.active[i]
        c = rig.point_contact[k]
        out, H = along.out[k, : contacts.outputs(rig, c, recorded)], work.H[i]
        if back:
            along.out[k] = 0.0
        else:
            carry_through(rig, work, along, k, H, along.touched_rate, True, along.V, out, back)
        if recorded:
            carry_recorded(rig, work, along, k, out, back)
        for j in range(0 if recorded else rig.contact_states[c]):
            carry(a, out[WRENCH + j], dy[contacts.state_at(rig, k, j)], back)
        if back:
            carry_through(rig, work, along, k, H, along.touched_rate, True, along.V, out, back)


@compiled
def carry_out_of_contact(
    rig: Any, work: Any, along: Any, pad: int, y: Array, a: float, dy: Array, dp: Array, back: bool
) -> None:
    """The states of a pad's points that do not touch, at the stage's end."""
    at, i = rig.pad_point_start[pad], rig.pad_point_start[pad]
    for k in range(at, rig.pad_point_start[pad + 1]):
        if i < at + work.actives[pad] and work.active[i] == k:
            i += 1
            continue
        c = rig.point_contact[k]
        n, changes = rig.contact_states[c], not back and not contacts.rests(rig, k, y)
        for o in range(n):
            for d in range(dy.shape[1]):
                changes |= dy[contacts.state_at(rig, k, o), d] != 0.0
        if not changes:
            continue
        contacts.out_of_contact(rig, work, k, y, a)
        out = along.out[k, :n]
        out[:] = 0.0
        for o in range(n if back else 0):
            add(a, dy[contacts.state_at(rig, k, o)], out[o])
        here, push, pull = (
            bounds(rig.contact_p_start, c),
            rig.contact_free_push[c],
            rig.contact_free_pull[c],
        )
        carry_parameters(along, push, pull, work.decay_x, rig.p, here, dp, out, back)
        for o in range(n):
            for q in range(n):
                carry(work.decay_J[o * n + q], dy[contacts.state_at(rig, k, q)], out[o], back)
        for o in range(n):
            state = dy[contacts.state_at(rig, k, o)]
            if not back:
                add(a, out[o], state)
            for d in range(state.size):
                if abs(state[d]) < TINY:
                    state[d] = 0.0
