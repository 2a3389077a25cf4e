"""A taped stage brought back into the scratch arrays: what the adjoint and the tangent both start from."""

from typing import Any

from torchsoft.codegen.invoke import call_linearise
from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.interface import frames, kinematics, linearise
from torchsoft.solve.kernel.linear import put


@compiled
def restore(s: Any, w: Any, tape: Any, row: int, a: float) -> None:
    """Coordinates, touching points with the law's Jacobians there, H, S, G, L, nodal forces (w.F), displacements at the stage's
    start (w.u) and rates (w.u_dot) of points, by point number in the first columns of w.x's scratch."""
    put(tape.q[row], w.q)
    put(tape.V[row], w.V)
    frames(s, w)
    slot = 0
    for pad in range(s.pad_base.size):
        at, c = s.contact_point_start[s.pad_contact_start[pad]], s.pad_contact_start[pad]
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
            while k >= s.contact_point_start[c + 1]:
                c += 1
            body, x = s.contact_body[c], w.x[k]
            angle = w.q[body + 2] - w.q[s.pad_base[pad] + 2]
            ux, uy = state[0] + a * state[2], state[1] + a * state[3]
            kinematics(w.frame[c], s.point_X[k], ux, uy, state[2], state[3], w.V[body + 2], angle, x)
            x[6], x[7], x[8] = tape.y[row, s.point_y_start + k], s.point_weight[k], a
            call_linearise(
                s.contact_linearise[c], x, s.p[s.contact_p_start[c] : s.contact_p_start[c + 1]], w.out[k], w.J[k]
            )
            w.active[at + i] = k
            for j in range(2):
                for r in range(2):
                    w.F[s.point_node[k, j], r] += s.point_N[k, j] * w.out[k, r]
            slot += 1
        linearise(s, w, pad, a)
