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
from torchsoft.solve.kernel.arrays import MOTION, WRENCH
from torchsoft.solve.kernel.invoke import call_linearise, call_value
from torchsoft.solve.kernel.linear import add, bounds, put, solve_dense
from torchsoft.solve.kernel.table import Array


@compiled
def relate(s: Any, w: Any, c: int, derivatives: bool) -> None:
    """Relative motion of contact c and its loads under the wrench in w.pair[c]."""
    x = w.pair[c]
    for i in range(6):
        coordinate = s.contact_coordinate[c, i]
        x[i], x[6 + i] = w.q[coordinate], w.V[coordinate]
    if derivatives:
        call_linearise(s.contact_relative_linearise, x, s.p, w.relative[c], w.by_pair[c])
    else:
        call_value(s.contact_relative, x, s.p, w.relative[c])


@compiled
def relate_all(s: Any, w: Any) -> None:
    """The same of all contacts, without a wrench."""
    for c in range(s.contact_pad.size):
        w.pair[c, 12:] = 0.0
        relate(s, w, c, False)


@compiled
def load(s: Any, w: Any, c: int) -> None:
    """Sum of the points' wrenches on the pad of contact c into w.pair[c]."""
    at, wrench = s.pad_point_start[s.contact_pad[c]], w.pair[c, 12:]
    wrench[:] = 0.0
    for i in range(at, at + w.actives[s.contact_pad[c]]):
        if s.point_contact[w.active[i]] == c:
            add(1.0, w.out[w.active[i]], wrench)


@compiled
def at_point(s: Any, k: int, nodal: Array) -> tuple[float, float]:
    """A nodal quantity (nodes, 2) at point k."""
    n0, n1, N0, N1 = s.point_node[k, 0], s.point_node[k, 1], s.point_N[k, 0], s.point_N[k, 1]
    return N0 * nodal[n0, 0] + N1 * nodal[n1, 0], N0 * nodal[n0, 1] + N1 * nodal[n1, 1]


@compiled
def place(s: Any, w: Any, k: int, ux: float, uy: float, vx: float, vy: float, x: Array) -> None:
    """Motion at point k into x, for its displacement (ux, uy) and rate (vx, vy)."""
    relative = w.relative[s.point_contact[k]]
    x[0], x[1], x[5], x[6] = s.point_X[k, 0] + ux, s.point_X[k, 1] + uy, vx, vy
    x[2], x[3], x[4] = relative[0], relative[1], relative[2]
    x[7], x[8], x[9] = relative[3], relative[4], relative[5]


@compiled
def separation(s: Any, w: Any, k: int, x: Array) -> float:
    """Signed distance [m] of point k from the body."""
    c = s.point_contact[k]
    call_value(s.contact_distance[c], x, s.p[bounds(s.contact_p_start, c)], w.phi)
    return w.phi[0]


@compiled
def state_at(s: Any, k: int, j: int) -> int:
    """Place in the state of number j of the states of point k."""
    c = s.point_contact[k]
    return s.point_y_start[k] + j * (s.contact_point_start[c + 1] - s.contact_point_start[c])


@compiled
def fill(s: Any, w: Any, k: int, y: Array, a: float) -> None:
    """The inputs of the law at point k besides its motion."""
    n, x = s.contact_states[s.point_contact[k]], w.x[k]
    for j in range(n):
        x[MOTION + j] = y[state_at(s, k, j)]
    x[MOTION + n], x[MOTION + n + 1] = s.point_weight[k], a


@compiled
def press(s: Any, w: Any, k: int) -> None:
    """Add the force of point k to its nodes, in w.F."""
    for j in range(2):
        for r in range(2):
            w.F[s.point_node[k, j], r] += s.point_N[k, j] * w.out[k, r]


@compiled
def by_state(s: Any, w: Any, k: int, r: int, j: int) -> float:
    """Derivative of output r of the law at point k by its state j."""
    columns = MOTION + s.contact_states[s.point_contact[k]]
    return w.J[k, r * columns + MOTION + j]


@compiled
def outputs(s: Any, c: int, felt: bool) -> int:
    """Number of differentiated outputs of a contact's law: those that a stage needs, or with the
    normal and the friction force that are felt."""
    return WRENCH + s.contact_states[c] + (2 if felt else 0)


@compiled
def evaluate(s: Any, w: Any, pad: int, y: Array, a: float) -> None:
    """The law at the window's points with the trial rates in `w`, its forces at the nodes, and the
    touching points."""
    at, actives = s.pad_point_start[pad], 0
    for node in range(w.low[pad], w.high[pad]):
        w.F[node, 0], w.F[node, 1] = 0.0, 0.0
    for i in range(w.windows[pad]):
        k = w.window[at + i]
        ux, uy = at_point(s, k, w.u)
        vx, vy = at_point(s, k, w.u_dot)
        place(s, w, k, ux + a * vx, uy + a * vy, vx, vy, w.x[k])
        if separation(s, w, k, w.x[k]) >= 0.0:
            continue
        fill(s, w, k, y, a)
        own = s.p[bounds(s.contact_p_start, s.point_contact[k])]
        call_value(s.contact_value[s.point_contact[k]], w.x[k], own, w.out[k])
        press(s, w, k)
        w.active[at + actives] = k
        actives += 1
    w.actives[pad] = actives


@compiled
def combine(J: Array, by: Array, out: Array) -> None:
    """Derivatives (6,) of an output by a contact's coordinates, from its row J (10,) of derivatives
    by a point's motion, and from those of the relative motion, rows of `by`."""
    x, y, theta, x_dot, y_dot, theta_dot = J[2], J[3], J[4], J[7], J[8], J[9]
    for j in range(6):
        position = x * by[0, j] + y * by[1, j] + theta * by[2, j]
        out[j] = position + x_dot * by[3, j] + y_dot * by[4, j] + theta_dot * by[5, j]


@compiled
def linearise(s: Any, w: Any, pad: int, a: float, felt: bool) -> None:
    """The law at the touching points of a pad with its derivatives, H, and the contacts' loads with
    theirs."""
    at = s.pad_point_start[pad]
    for i in range(at, at + w.actives[pad]):
        k = w.active[i]
        c = s.point_contact[k]
        own = s.p[bounds(s.contact_p_start, c)]
        call_linearise(s.contact_linearise[c], w.x[k], own, w.out[k], w.J[k])
    for c in range(s.contact_pad.size):
        if s.contact_pad[c] != pad:
            continue
        load(s, w, c)
        relate(s, w, c, True)
        J = w.by_pair[c]
        for i in range(6):
            for j in range(6):
                w.by_stage[c, i, j] = J[i, 6 + j] + a * J[i, j]
    for i in range(at, at + w.actives[pad]):
        k = w.active[i]
        c = s.point_contact[k]
        columns, stage, own = MOTION + s.contact_states[c], w.by_stage[c], w.J[k]
        for o in range(outputs(s, c, felt)):
            J, H = own[o * columns : o * columns + MOTION], w.H[i, o]
            H[0], H[1] = J[5] + a * J[0], J[6] + a * J[1]
            combine(J, stage, H[2:])


@compiled
def by_positions(s: Any, w: Any, pad: int, felt: bool) -> None:
    """S of the touching points of a pad; needs `linearise`."""
    at = s.pad_point_start[pad]
    for i in range(at, at + w.actives[pad]):
        k = w.active[i]
        c = s.point_contact[k]
        columns, by = MOTION + s.contact_states[c], w.by_pair[c]
        for o in range(outputs(s, c, felt)):
            J, S = w.J[k, o * columns : o * columns + MOTION], w.S[i, o]
            S[0], S[1] = J[0], J[1]
            combine(J, by, S[2:])


@compiled
def touched_nodes(s: Any, w: Any, pad: int) -> int:
    """Number the nodes that touching points load, in w.touched and w.slot; how many there are."""
    at, first, n = s.pad_point_start[pad], s.pad_node_start[pad], 0
    for node in range(w.low[pad], w.high[pad]):
        w.slot[node] = -1
    for i in range(w.actives[pad]):
        for j in range(2):
            node = s.point_node[w.active[at + i], j]
            if s.point_N[w.active[at + i], j] != 0.0 and w.slot[node] < 0:
                w.slot[node], w.touched[first + n] = n, node
                n += 1
    w.counts[pad] = n
    return n


@compiled
def assemble(s: Any, w: Any, pad: int, a: float, Rv: Array) -> None:
    """The block of one pad, of its mobility w.P: w.A, w.Hc, w.Rf, and its part in Rv (free,
    free)."""
    at, column, n = s.pad_point_start[pad], s.pad_column[pad], w.counts[pad]
    A, P, Hc, Rf, K, PB = w.A, w.P, w.Hc, w.Rf, w.K, w.PB
    Hc[: 2 * n, : s.pad_columns[pad]] = 0.0
    Rf[: s.pad_columns[pad], : 2 * n] = 0.0
    for i in range(2 * n):
        A[i, : 2 * n] = 0.0
        A[i, i] = 1.0
    for c in range(s.contact_pad.size):
        for row in range(6 if s.contact_pad[c] == pad else 0):
            for other in range(6):
                if s.contact_number[c, row] >= 0 and s.contact_number[c, other] >= 0:
                    by = a * w.by_pair[c, 6 + row, other]
                    Rv[s.contact_number[c, row], s.contact_number[c, other]] += by
    for i in range(w.actives[pad]):
        k = w.active[at + i]
        c = s.point_contact[k]
        H, number = w.H[at + i], s.contact_number[c]
        PB[:, : 2 * n] = 0.0
        for j in range(2):
            N = s.point_N[k, j]
            if N != 0.0:
                row = 2 * w.slot[s.point_node[k, j]]
                for r in range(2):
                    add(N, P[row + r], PB[r, : 2 * n])
        for row in range(6):
            if number[row] < 0:
                continue
            down = w.by_pair[c, 6 + row, 12:]
            for m in range(8):
                K[row, m] = down[0] * H[0, m] + down[1] * H[1, m] + down[2] * H[2, m]
            for r in range(2):
                add(K[row, r], PB[r], Rf[column[number[row]], : 2 * n])
            for other in range(6):
                if number[other] >= 0:
                    Rv[number[row], number[other]] += K[row, 2 + other]
        for j in range(2):
            N = s.point_N[k, j]
            if N == 0.0:
                continue
            row = 2 * w.slot[s.point_node[k, j]]
            for r in range(2):
                for q in range(2):
                    add(-N * H[r, q], PB[q], A[row + r, : 2 * n])
                for other in range(6):
                    if number[other] >= 0:
                        Hc[row + r, column[number[other]]] += N * H[r, 2 + other]


@compiled
def residual(s: Any, w: Any, pad: int, r: Array) -> None:
    """Right-hand side of Newton's block in the first column of w.X, and the pad's part in r."""
    at, first, n = s.pad_point_start[pad], s.pad_node_start[pad], w.counts[pad]
    b = w.X[2 * first : 2 * (first + n)]
    b[:, 0] = 0.0
    for c in range(s.contact_pad.size):
        for row in range(6 if s.contact_pad[c] == pad else 0):
            if s.contact_number[c, row] >= 0:
                r[s.contact_number[c, row], 0] += w.relative[c, 6 + row]
    for i in range(w.actives[pad]):
        k = w.active[at + i]
        c, H = s.point_contact[k], w.H[at + i]
        dx = dy = 0.0
        for j in range(2):
            node, N = s.point_node[k, j], s.point_N[k, j]
            dx += N * (w.free[node, 0] - w.u_dot[node, 0])
            dy += N * (w.free[node, 1] - w.u_dot[node, 1])
        for j in range(2):
            if s.point_N[k, j] != 0.0:
                row = 2 * w.slot[s.point_node[k, j]]
                for o in range(2):
                    f = w.out[k, o] + H[o, 0] * dx + H[o, 1] * dy
                    b[row + o, 0] += s.point_N[k, j] * f
        for o in range(WRENCH):
            change = H[o, 0] * dx + H[o, 1] * dy
            for row in range(6):
                if s.contact_number[c, row] >= 0:
                    down = w.by_pair[c, 6 + row, 12 + o]
                    r[s.contact_number[c, row], 0] += down * change


@compiled
def eliminate(s: Any, w: Any, pad: int, m: int, r: Array, Rv: Array) -> None:
    """Solve a pad's block for its forces, A^-1 (b | Hc) in w.X with m right-hand sides b, and put
    them into the bodies' equations r (free, m) and Rv."""
    column, columns = s.pad_column[pad], s.pad_columns[pad]
    first, n = s.pad_node_start[pad], w.counts[pad]
    X = w.X[2 * first : 2 * (first + n)]
    for i in range(2 * n):
        for j in range(columns):
            X[i, m + j] = w.Hc[i, j]
    solve_dense(w.A, X, 2 * n, m + columns)
    for number in range(column.size):
        if column[number] < 0:
            continue
        line = w.Rf[column[number]]
        for i in range(2 * n):
            add(line[i], X[i], r[number, :m])
            for other in range(column.size):
                if column[other] >= 0:
                    Rv[number, other] += line[i] * X[i, m + column[other]]


@compiled
def transpose(s: Any, w: Any, pad: int) -> None:
    """Exchange A and Hc of a pad's block with the transposes of A and Rf."""
    n = 2 * w.counts[pad]
    for i in range(n):
        for j in range(i):
            w.A[i, j], w.A[j, i] = w.A[j, i], w.A[i, j]
        for j in range(s.pad_columns[pad]):
            w.Hc[i, j], w.Rf[j, i] = w.Rf[j, i], w.Hc[i, j]


@compiled
def load_nodes(s: Any, w: Any, pad: int, m: int, dV: Array) -> None:
    """Add to the forces of the first m columns of w.X, after `eliminate`, their change with the
    velocities dV (free, m)."""
    first = s.pad_node_start[pad]
    X = w.X[2 * first : 2 * (first + w.counts[pad])]
    for number in range(dV.shape[0]):
        column = s.pad_column[pad, number]
        for i in range(X.shape[0] if column >= 0 else 0):
            add(X[i, m + column], dV[number], X[i, :m])


@compiled
def fade(s: Any, w: Any, k: int, y: Array, a: float) -> None:
    """The law at point k away from contact into w.decay, with w.decay_J by its states."""
    c, x = s.point_contact[k], w.decay_x
    n = s.contact_states[c]
    for j in range(n):
        x[j] = y[state_at(s, k, j)]
    x[n], x[n + 1] = s.point_weight[k], a
    own = s.p[bounds(s.contact_p_start, c)]
    call_linearise(s.contact_free_linearise[c], x, own, w.decay, w.decay_J)


@compiled
def rests(s: Any, k: int, y: Array) -> bool:
    """Whether nothing changes at point k away from contact: a stretch alone that is zero stays
    so."""
    return s.contact_states[s.point_contact[k]] == 1 and y[s.point_y_start[k]] == 0.0


@compiled
def finish(s: Any, w: Any, pad: int, y: Array, a: float, powers: Array, wrench: Array) -> None:
    """Rates of the states of a pad's points into w.k, powers of dashpots and of slip [W], and the
    contacts' force on the pad [N] with its moment (Eq. 35) [N.m] in its base's axes."""
    at, i, count = s.pad_point_start[pad], 0, s.pad_base.size
    wrench[:] = 0.0
    for k in range(at, s.pad_point_start[pad + 1]):
        n = s.contact_states[s.point_contact[k]]
        if i < w.actives[pad] and w.active[at + i] == k:
            i += 1
            fx, fy = w.out[k, 0], w.out[k, 1]
            wrench[0] += fx
            wrench[1] += fy
            wrench[2] += s.point_X[k, 0] * fy - s.point_X[k, 1] * fx
            for j in range(n):
                w.k[state_at(s, k, j)] = w.out[k, WRENCH + j]
            powers[count] += w.out[k, WRENCH + n + 2]
            powers[count + 1] += w.out[k, WRENCH + n + 3]
        elif rests(s, k, y):
            w.k[s.point_y_start[k]] = 0.0
        else:
            fade(s, w, k, y, a)
            for j in range(n):
                w.k[state_at(s, k, j)] = w.decay[j]
            powers[count] += w.decay[n]
            powers[count + 1] += w.decay[n + 1]


@compiled
def stored(s: Any, w: Any, pad: int, y: Array) -> float:
    """Energy [J] in the springs of a pad's points, in the state y where the last stage ended."""
    at, i, total, x, out = s.pad_point_start[pad], 0, 0.0, w.decay_x, w.decay
    for k in range(at, s.pad_point_start[pad + 1]):
        c, stretch, depth = s.point_contact[k], y[s.point_y_start[k]], 0.0
        if i < w.actives[pad] and w.active[at + i] == k:
            i, depth = i + 1, -separation(s, w, k, w.x[k])
        if depth != 0.0 or stretch != 0.0:
            x[0], x[1], x[2] = depth, stretch, s.point_weight[k]
            call_value(s.contact_stored[c], x, s.p[bounds(s.contact_p_start, c)], out)
            total += out[0] + out[1]
    return total


@compiled
def loads(s: Any, w: Any) -> None:
    """The contacts' generalised forces on all coordinates into w.load."""
    w.load[:] = 0.0
    for c in range(s.contact_pad.size):
        load(s, w, c)
        relate(s, w, c, False)
        for row in range(6):
            w.load[s.contact_coordinate[c, row]] += w.relative[c, 6 + row]


@compiled
def restore(s: Any, w: Any, tape: Any, row: int, a: float, felt: bool) -> None:
    """A stage from the tape: coordinates, touching points with their laws' derivatives, touched
    nodes and nodal forces (w.F)."""
    put(tape.q[row], w.q)
    put(tape.V[row], w.V)
    relate_all(s, w)
    slot = 0
    for pad in range(s.pad_base.size):
        at = s.pad_point_start[pad]
        low, high = s.pad_node_start[pad + 1], s.pad_node_start[pad]
        w.actives[pad] = tape.count[row, pad]
        for i in range(w.actives[pad]):
            for j in range(2):
                node = s.point_node[tape.point[row, slot + i], j]
                low, high = min(low, node), max(high, node + 1)
        w.low[pad], w.high[pad] = min(low, high), high
        for node in range(low, high):
            w.F[node, 0], w.F[node, 1] = 0.0, 0.0
        for i in range(w.actives[pad]):
            k, state = tape.point[row, slot], tape.state[row, slot]
            ux, uy = state[0] + a * state[2], state[1] + a * state[3]
            place(s, w, k, ux, uy, state[2], state[3], w.x[k])
            fill(s, w, k, tape.y[row], a)
            w.active[at + i] = k
            slot += 1
        linearise(s, w, pad, a, felt)
        for i in range(at, at + w.actives[pad]):
            press(s, w, w.active[i])
        by_positions(s, w, pad, felt)
        touched_nodes(s, w, pad)
