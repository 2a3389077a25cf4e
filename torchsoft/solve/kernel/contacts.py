"""Contacts: relative motion of the bodies, the laws of contact points, and one block of equations
for each pad.

Everything is written in the frame of the pad's base. With u' the nodal rates, F the nodal forces,
P the pad's mobility at this stage and f = law(u', V) at the touching points, spread over the nodes
by N,

    u' = free + P F,   F = N^T f,   f = f0 + H_u du' + H_V dV,

eliminating f leaves A F = b + Hc dV with A = 1 - N^T H_u N P, and the bodies' equations get Rf F +
Rv dV + r. Newton's iteration, the tangent and, transposed, the adjoint solve this one block.

The law of relative motion is a transformer: it takes velocities to the relative rates of a contact,
and its wrench back to loads on both bodies. Derivatives of a point by (u (2), body (3), base (3)):
S by positions, H by rates of the stage, which move positions by a h.
"""

from typing import Any

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.arrays import AXES, MOTION, PAIR, SIDE, WRENCH
from torchsoft.solve.kernel.invoke import call_linearise, call_value
from torchsoft.solve.kernel.linear import add, bounds, put, solve_dense
from torchsoft.solve.kernel.table import Array


@compiled
def relate(rig: Any, work: Any, c: int, derivatives: bool) -> None:
    """Relative motion of contact c and its loads under the wrench in work.pair[c]."""
    x = work.pair[c]
    for i in range(PAIR):
        coordinate = rig.contact_coordinate[c, i]
        x[i], x[PAIR + i] = work.q[coordinate], work.V[coordinate]
    if derivatives:
        call_linearise(rig.contact_relative_linearise, x, rig.p, work.relative[c], work.by_pair[c])
    else:
        call_value(rig.contact_relative, x, rig.p, work.relative[c])


@compiled
def relate_all(rig: Any, work: Any) -> None:
    """The same of all contacts, without a wrench."""
    for c in range(rig.contact_pad.size):
        work.pair[c, 2 * PAIR :] = 0.0
        relate(rig, work, c, False)


@compiled
def load(rig: Any, work: Any, c: int) -> None:
    """Sum of the points' wrenches on the pad of contact c into work.pair[c]."""
    at, wrench = rig.pad_point_start[rig.contact_pad[c]], work.pair[c, 2 * PAIR :]
    wrench[:] = 0.0
    for i in range(at, at + work.actives[rig.contact_pad[c]]):
        if rig.point_contact[work.active[i]] == c:
            add(1.0, work.out[work.active[i]], wrench)


@compiled
def at_point(rig: Any, k: int, nodal: Array) -> tuple[float, float]:
    """A nodal quantity (nodes, 2) at point k."""
    x = y = 0.0
    for j in range(SIDE):
        node, N = rig.point_node[k, j], rig.point_N[k, j]
        x += N * nodal[node, 0]
        y += N * nodal[node, 1]
    return x, y


@compiled
def place(
    rig: Any, work: Any, k: int, ux: float, uy: float, vx: float, vy: float, x: Array
) -> None:
    """Motion at point k into x, for its displacement (ux, uy) and rate (vx, vy)."""
    relative = work.relative[rig.point_contact[k]]
    x[0], x[1], x[5], x[6] = rig.point_X[k, 0] + ux, rig.point_X[k, 1] + uy, vx, vy
    x[2], x[3], x[4] = relative[0], relative[1], relative[2]
    x[7], x[8], x[9] = relative[3], relative[4], relative[5]


@compiled
def separation(rig: Any, work: Any, k: int, x: Array) -> float:
    """Signed distance [m] of point k from the body."""
    c = rig.point_contact[k]
    call_value(rig.contact_distance[c], x, rig.p[bounds(rig.contact_p_start, c)], work.phi)
    return work.phi[0]


@compiled
def state_at(rig: Any, k: int, j: int) -> int:
    """Place in the state of number j of the states of point k."""
    c = rig.point_contact[k]
    return rig.point_y_start[k] + j * (rig.contact_point_start[c + 1] - rig.contact_point_start[c])


@compiled
def fill(rig: Any, work: Any, k: int, y: Array, a: float) -> None:
    """The inputs of the law at point k besides its motion."""
    n, x = rig.contact_states[rig.point_contact[k]], work.x[k]
    for j in range(n):
        x[MOTION + j] = y[state_at(rig, k, j)]
    x[MOTION + n], x[MOTION + n + 1] = rig.point_weight[k], a


@compiled
def press(rig: Any, work: Any, k: int) -> None:
    """Add the force of point k to its nodes, in work.F."""
    for j in range(SIDE):
        for r in range(2):
            work.F[rig.point_node[k, j], r] += rig.point_N[k, j] * work.out[k, r]


@compiled
def by_state(rig: Any, work: Any, k: int, r: int, j: int) -> float:
    """Derivative of output r of the law at point k by its state j."""
    columns = MOTION + rig.contact_states[rig.point_contact[k]]
    return work.J[k, r * columns + MOTION + j]


@compiled
def outputs(rig: Any, c: int, recorded: bool) -> int:
    """Number of differentiated outputs of a contact's law: those that a stage needs, or with the
    normal and the friction force that are recorded."""
    return WRENCH + rig.contact_states[c] + (AXES if recorded else 0)


@compiled
def wrench_at(rig: Any, pad: int) -> int:
    """Place of a pad's force and moment in what is recorded."""
    return AXES * rig.point_contact.size + WRENCH * pad


@compiled
def load_at(rig: Any, c: int, o: int) -> int:
    """Place of the load on coordinate o of contact c in what is recorded; -1 for the place of a
    base whose pad has inertia, which is moved by the forces of its elements."""
    if rig.nodal_v_start[rig.contact_pad[c]] >= 0 and PAIR // 2 <= o < PAIR // 2 + AXES:
        return -1
    return wrench_at(rig, rig.pad_base.size) + rig.contact_coordinate[c, o]


@compiled
def evaluate(rig: Any, work: Any, pad: int, y: Array, a: float) -> None:
    """The law at the window's points with the trial rates in `work`, its forces at the nodes, and
    the touching points."""
    at, actives = rig.pad_point_start[pad], 0
    for node in range(work.low[pad], work.high[pad]):
        work.F[node, 0], work.F[node, 1] = 0.0, 0.0
    for i in range(work.windows[pad]):
        k = work.window[at + i]
        ux, uy = at_point(rig, k, work.u)
        vx, vy = at_point(rig, k, work.u_dot)
        place(rig, work, k, ux + a * vx, uy + a * vy, vx, vy, work.x[k])
        if separation(rig, work, k, work.x[k]) >= 0.0:
            continue
        fill(rig, work, k, y, a)
        p = rig.p[bounds(rig.contact_p_start, rig.point_contact[k])]
        call_value(rig.contact_value[rig.point_contact[k]], work.x[k], p, work.out[k])
        press(rig, work, k)
        work.active[at + actives] = k
        actives += 1
    work.actives[pad] = actives


@compiled
def combine(J: Array, by: Array, out: Array) -> None:
    """Derivatives (6,) of an output by a contact's coordinates, from its row J (10,) of derivatives
    by a point's motion, and from those of the relative motion, rows of `by`."""
    x, y, theta, x_dot, y_dot, theta_dot = J[2], J[3], J[4], J[7], J[8], J[9]
    for j in range(PAIR):
        position = x * by[0, j] + y * by[1, j] + theta * by[2, j]
        out[j] = position + x_dot * by[3, j] + y_dot * by[4, j] + theta_dot * by[5, j]


@compiled
def linearise(rig: Any, work: Any, pad: int, a: float, recorded: bool) -> None:
    """The law at the touching points of a pad with its derivatives, H, and the contacts' loads with
    theirs."""
    at = rig.pad_point_start[pad]
    for i in range(at, at + work.actives[pad]):
        k = work.active[i]
        c = rig.point_contact[k]
        p = rig.p[bounds(rig.contact_p_start, c)]
        call_linearise(rig.contact_linearise[c], work.x[k], p, work.out[k], work.J[k])
    for c in range(rig.contact_pad.size):
        if rig.contact_pad[c] != pad:
            continue
        load(rig, work, c)
        relate(rig, work, c, True)
        J = work.by_pair[c]
        for i in range(PAIR):
            for j in range(PAIR):
                work.by_stage[c, i, j] = J[i, PAIR + j] + a * J[i, j]
    for i in range(at, at + work.actives[pad]):
        k = work.active[i]
        c = rig.point_contact[k]
        columns, stage, slopes = MOTION + rig.contact_states[c], work.by_stage[c], work.J[k]
        for o in range(outputs(rig, c, recorded)):
            J, H = slopes[o * columns : o * columns + MOTION], work.H[i, o]
            H[0], H[1] = J[5] + a * J[0], J[6] + a * J[1]
            combine(J, stage, H[2:])


@compiled
def by_positions(rig: Any, work: Any, pad: int, recorded: bool) -> None:
    """S of the touching points of a pad; needs `linearise`."""
    at = rig.pad_point_start[pad]
    for i in range(at, at + work.actives[pad]):
        k = work.active[i]
        c = rig.point_contact[k]
        columns, by = MOTION + rig.contact_states[c], work.by_pair[c]
        for o in range(outputs(rig, c, recorded)):
            J, S = work.J[k, o * columns : o * columns + MOTION], work.S[i, o]
            S[0], S[1] = J[0], J[1]
            combine(J, by, S[2:])


@compiled
def touched_nodes(rig: Any, work: Any, pad: int) -> int:
    """Number the nodes that touching points load, in work.touched and work.slot; how many there
    are."""
    at, first, n = rig.pad_point_start[pad], rig.pad_node_start[pad], 0
    for node in range(work.low[pad], work.high[pad]):
        work.slot[node] = -1
    for i in range(work.actives[pad]):
        for j in range(SIDE):
            node = rig.point_node[work.active[at + i], j]
            if rig.point_N[work.active[at + i], j] != 0.0 and work.slot[node] < 0:
                work.slot[node], work.touched[first + n] = n, node
                n += 1
    work.counts[pad] = n
    return n


@compiled
def assemble(rig: Any, work: Any, pad: int, a: float, Rv: Array) -> None:
    """The block of one pad, of its mobility work.P: work.A, work.Hc, work.Rf, and its part in Rv
    (free, free)."""
    at, column, n = rig.pad_point_start[pad], rig.pad_column[pad], work.counts[pad]
    A, P, Hc, Rf, K, PB = work.A, work.P, work.Hc, work.Rf, work.K, work.PB
    Hc[: 2 * n, : rig.pad_columns[pad]] = 0.0
    Rf[: rig.pad_columns[pad], : 2 * n] = 0.0
    for i in range(2 * n):
        A[i, : 2 * n] = 0.0
        A[i, i] = 1.0
    for c in range(rig.contact_pad.size):
        for row in range(PAIR if rig.contact_pad[c] == pad else 0):
            for other in range(PAIR):
                if rig.contact_number[c, row] >= 0 and rig.contact_number[c, other] >= 0:
                    by = a * work.by_pair[c, PAIR + row, other]
                    Rv[rig.contact_number[c, row], rig.contact_number[c, other]] += by
    for i in range(work.actives[pad]):
        k = work.active[at + i]
        c = rig.point_contact[k]
        H, number = work.H[at + i], rig.contact_number[c]
        PB[:, : 2 * n] = 0.0
        for j in range(SIDE):
            N = rig.point_N[k, j]
            if N != 0.0:
                row = 2 * work.slot[rig.point_node[k, j]]
                for r in range(2):
                    add(N, P[row + r], PB[r, : 2 * n])
        for row in range(PAIR):
            if number[row] < 0:
                continue
            down = work.by_pair[c, PAIR + row, 2 * PAIR :]
            for m in range(AXES + PAIR):
                K[row, m] = down[0] * H[0, m] + down[1] * H[1, m] + down[2] * H[2, m]
            for r in range(2):
                add(K[row, r], PB[r], Rf[column[number[row]], : 2 * n])
            for other in range(PAIR):
                if number[other] >= 0:
                    Rv[number[row], number[other]] += K[row, AXES + other]
        for j in range(SIDE):
            N = rig.point_N[k, j]
            if N == 0.0:
                continue
            row = 2 * work.slot[rig.point_node[k, j]]
            for r in range(2):
                for q in range(2):
                    add(-N * H[r, q], PB[q], A[row + r, : 2 * n])
                for other in range(PAIR):
                    if number[other] >= 0:
                        Hc[row + r, column[number[other]]] += N * H[r, AXES + other]


@compiled
def residual(rig: Any, work: Any, pad: int, r: Array) -> None:
    """Right-hand side of Newton's block in the first column of work.X, and the pad's part in r."""
    at, first, n = rig.pad_point_start[pad], rig.pad_node_start[pad], work.counts[pad]
    b = work.X[2 * first : 2 * (first + n)]
    b[:, 0] = 0.0
    for c in range(rig.contact_pad.size):
        for row in range(PAIR if rig.contact_pad[c] == pad else 0):
            if rig.contact_number[c, row] >= 0:
                r[rig.contact_number[c, row], 0] += work.relative[c, PAIR + row]
    for i in range(work.actives[pad]):
        k = work.active[at + i]
        c, H = rig.point_contact[k], work.H[at + i]
        dx = dy = 0.0
        for j in range(SIDE):
            node, N = rig.point_node[k, j], rig.point_N[k, j]
            dx += N * (work.free[node, 0] - work.u_dot[node, 0])
            dy += N * (work.free[node, 1] - work.u_dot[node, 1])
        for j in range(SIDE):
            if rig.point_N[k, j] != 0.0:
                row = 2 * work.slot[rig.point_node[k, j]]
                for o in range(2):
                    f = work.out[k, o] + H[o, 0] * dx + H[o, 1] * dy
                    b[row + o, 0] += rig.point_N[k, j] * f
        for o in range(WRENCH):
            change = H[o, 0] * dx + H[o, 1] * dy
            for row in range(PAIR):
                if rig.contact_number[c, row] >= 0:
                    down = work.by_pair[c, PAIR + row, 2 * PAIR + o]
                    r[rig.contact_number[c, row], 0] += down * change


@compiled
def eliminate(rig: Any, work: Any, pad: int, m: int, r: Array, Rv: Array) -> None:
    """Solve a pad's block for its forces, A^-1 (b | Hc) in work.X with m right-hand sides b, and
    put them into the bodies' equations r (free, m) and Rv."""
    column, columns = rig.pad_column[pad], rig.pad_columns[pad]
    first, n = rig.pad_node_start[pad], work.counts[pad]
    X = work.X[2 * first : 2 * (first + n)]
    for i in range(2 * n):
        for j in range(columns):
            X[i, m + j] = work.Hc[i, j]
    solve_dense(work.A, X, 2 * n, m + columns)
    for number in range(column.size):
        if column[number] < 0:
            continue
        line = work.Rf[column[number]]
        for i in range(2 * n):
            add(line[i], X[i], r[number, :m])
            for other in range(column.size):
                if column[other] >= 0:
                    Rv[number, other] += line[i] * X[i, m + column[other]]


@compiled
def transpose(rig: Any, work: Any, pad: int) -> None:
    """Exchange A and Hc of a pad's block with the transposes of A and Rf."""
    n = 2 * work.counts[pad]
    for i in range(n):
        for j in range(i):
            work.A[i, j], work.A[j, i] = work.A[j, i], work.A[i, j]
        for j in range(rig.pad_columns[pad]):
            work.Hc[i, j], work.Rf[j, i] = work.Rf[j, i], work.Hc[i, j]


@compiled
def load_nodes(rig: Any, work: Any, pad: int, m: int, dV: Array) -> None:
    """Add to the forces of the first m columns of work.X, after `eliminate`, their change with the
    velocities dV (free, m)."""
    first = rig.pad_node_start[pad]
    X = work.X[2 * first : 2 * (first + work.counts[pad])]
    for number in range(dV.shape[0]):
        column = rig.pad_column[pad, number]
        for i in range(X.shape[0] if column >= 0 else 0):
            add(X[i, m + column], dV[number], X[i, :m])


@compiled
def out_of_contact(rig: Any, work: Any, k: int, y: Array, a: float) -> None:
    """The law at point k away from contact into work.decay, with work.decay_J by its states."""
    c, x = rig.point_contact[k], work.decay_x
    n = rig.contact_states[c]
    for j in range(n):
        x[j] = y[state_at(rig, k, j)]
    x[n], x[n + 1] = rig.point_weight[k], a
    p = rig.p[bounds(rig.contact_p_start, c)]
    call_linearise(rig.contact_free_linearise[c], x, p, work.decay, work.decay_J)


@compiled
def rests(rig: Any, k: int, y: Array) -> bool:
    """Whether nothing changes at point k away from contact: a stretch alone that is zero stays
    so."""
    return rig.contact_states[rig.point_contact[k]] == 1 and y[rig.point_y_start[k]] == 0.0


@compiled
def finish(rig: Any, work: Any, pad: int, y: Array, a: float, powers: Array, wrench: Array) -> None:
    """Rates of the states of a pad's points into work.k, powers of dashpots and of slip [W], and
    the contacts' force on the pad [N] with its moment (Eq. 35) [N.m] in its base's axes."""
    at, i, count = rig.pad_point_start[pad], 0, rig.pad_base.size
    wrench[:] = 0.0
    for k in range(at, rig.pad_point_start[pad + 1]):
        n = rig.contact_states[rig.point_contact[k]]
        if i < work.actives[pad] and work.active[at + i] == k:
            i += 1
            fx, fy = work.out[k, 0], work.out[k, 1]
            wrench[0] += fx
            wrench[1] += fy
            wrench[2] += rig.point_X[k, 0] * fy - rig.point_X[k, 1] * fx
            for j in range(n):
                work.k[state_at(rig, k, j)] = work.out[k, WRENCH + j]
            powers[count] += work.out[k, WRENCH + n + 2]
            powers[count + 1] += work.out[k, WRENCH + n + 3]
        elif rests(rig, k, y):
            work.k[rig.point_y_start[k]] = 0.0
        else:
            out_of_contact(rig, work, k, y, a)
            for j in range(n):
                work.k[state_at(rig, k, j)] = work.decay[j]
            powers[count] += work.decay[n]
            powers[count + 1] += work.decay[n + 1]


@compiled
def stored(rig: Any, work: Any, pad: int, y: Array) -> float:
    """Energy [J] in the springs of a pad's points, in the state y where the last stage ended."""
    at, i, total, x, out = rig.pad_point_start[pad], 0, 0.0, work.decay_x, work.decay
    for k in range(at, rig.pad_point_start[pad + 1]):
        c, stretch, depth = rig.point_contact[k], y[rig.point_y_start[k]], 0.0
        if i < work.actives[pad] and work.active[at + i] == k:
            i, depth = i + 1, -separation(rig, work, k, work.x[k])
        if depth != 0.0 or stretch != 0.0:
            x[0], x[1], x[2] = depth, stretch, rig.point_weight[k]
            call_value(rig.contact_stored[c], x, rig.p[bounds(rig.contact_p_start, c)], out)
            total += out[0] + out[1]
    return total


@compiled
def loads(rig: Any, work: Any) -> None:
    """The contacts' generalised forces on all coordinates into work.load."""
    work.load[:] = 0.0
    for c in range(rig.contact_pad.size):
        load(rig, work, c)
        relate(rig, work, c, False)
        for row in range(PAIR):
            work.load[rig.contact_coordinate[c, row]] += work.relative[c, PAIR + row]


@compiled
def restore(rig: Any, work: Any, tape: Any, row: int, a: float, recorded: bool) -> None:
    """A stage from the tape: coordinates, touching points with their laws' derivatives, touched
    nodes and nodal forces (work.F)."""
    put(tape.q[row], work.q)
    put(tape.V[row], work.V)
    relate_all(rig, work)
    slot = 0
    for pad in range(rig.pad_base.size):
        at = rig.pad_point_start[pad]
        low, high = rig.pad_node_start[pad + 1], rig.pad_node_start[pad]
        work.actives[pad] = tape.count[row, pad]
        for i in range(work.actives[pad]):
            for j in range(SIDE):
                node = rig.point_node[tape.point[row, slot + i], j]
                low, high = min(low, node), max(high, node + 1)
        work.low[pad], work.high[pad] = min(low, high), high
        for node in range(low, high):
            work.F[node, 0], work.F[node, 1] = 0.0, 0.0
        for i in range(work.actives[pad]):
            k, state = tape.point[row, slot], tape.state[row, slot]
            ux, uy = state[0] + a * state[2], state[1] + a * state[3]
            place(rig, work, k, ux, uy, state[2], state[3], work.x[k])
            fill(rig, work, k, tape.y[row], a)
            work.active[at + i] = k
            slot += 1
        linearise(rig, work, pad, a, recorded)
        for i in range(at, at + work.actives[pad]):
            press(rig, work, work.active[i])
        by_positions(rig, work, pad, recorded)
        touched_nodes(rig, work, pad)
