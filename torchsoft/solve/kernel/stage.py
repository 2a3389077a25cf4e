"""One stage of the implicit step: the rates k that solve k = f(t, y* + a h k), by Newton's method.

States of contact points are local, pads are blocks, so Newton's unknowns are the forces at the
touched nodes, pad by pad, and then the velocities of the free coordinates.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, contacts, pads
from torchsoft.solve.kernel.linear import put, solve_dense
from torchsoft.solve.kernel.sources import balance, remember
from torchsoft.solve.kernel.table import Array

SEARCH_AFTER, SHORTEST = 2, 2.0**-10
"""After so many iterations a Newton step that does not lessen the mismatch is halved, down to this
part of it; before, one whose mismatch is not a number."""

ROUNDED = 10.0
"""Mismatch, in tolerances, that is accepted where rounding stops Newton's iteration: no shorter
step lessens it."""


@compiled
def drive(s: Any, w: Any, y: Array, signals: Array, a: float) -> None:
    """All coordinates at the end of the stage: those of the state for the free velocities in V,
    signals for the others."""
    q, V = w.q, w.V
    for c in range(s.body_free.size):
        if s.body_free[c] >= 0:
            q[c] = y[s.body_q_start + s.body_free[c]] + a * V[c]
        elif s.body_signal[c] >= 0:
            q[c], V[c] = signals[s.body_signal[c], 0], signals[s.body_signal[c], 1]


@compiled
def scan(s: Any, w: Any, y: Array, margin: float) -> None:
    """List the points within `margin` [m] of touching at the stage's start, w.q, in `w.window`;
    needs `pads.begin`."""
    contacts.relate_all(s, w)
    for pad in range(s.pad_base.size):
        first, last = s.pad_node_start[pad], s.pad_node_start[pad + 1]
        pads.displace(s, w, pad, y, first, last)
        at = s.pad_point_start[pad]
        count, low, high = 0, last, first
        for k in range(at, s.pad_point_start[pad + 1]):
            n0, n1 = s.point_node[k, 0], s.point_node[k, 1]
            ux, uy = contacts.at_point(s, k, w.u)
            contacts.place(s, w, k, ux, uy, 0.0, 0.0, w.probe)
            if not contacts.separation(s, w, k, w.probe) > margin:
                w.window[at + count] = k
                count += 1
                low, high = min(low, min(n0, n1)), max(high, max(n0, n1) + 1)
        for node in range(first, last):
            if node < w.low[pad] or node >= w.high[pad]:
                w.u_dot[node, 0], w.u_dot[node, 1] = w.free[node, 0], w.free[node, 1]
        w.windows[pad], w.low[pad], w.high[pad] = count, low, max(low, high)
    w.travelled[0], w.travelled[1], w.travelled[2] = 0.0, margin, w.travelled[2] + 1.0


@compiled
def solve_stage(
    s: Any, w: Any, limits: Any, y: Array, signals: Array, a: float, margin: float
) -> tuple[bool, int]:
    """Velocities (w.V, on entry the guess), nodal forces and rates at the end of the stage that
    starts from y.

    Newton ends when the law and the linear relations agree to the tolerance at every node. Returns
    success and the number of linear solves.
    """
    count, free = s.pad_base.size, s.body_coordinate.size
    drive(s, w, y, signals, a)
    for pad in range(count):
        pads.begin(s, w, pad, y, a)
    if not w.travelled[0] <= w.travelled[1]:  # also where they are no numbers yet
        scan(s, w, y, margin)
    for pad in range(count):
        pads.displace(s, w, pad, y, w.low[pad], w.high[pad])
        w.F_linear[w.low[pad] : w.high[pad]] = 0.0
    V_old, dV, r, Rv, b = w.V_old, w.dV, w.r, w.Rv, w.b
    previous, part, iteration = np.inf, 1.0, 0
    while True:
        contacts.relate_all(s, w)
        mismatch, squares = 0.0, 0.0
        for pad in range(count):
            contacts.evaluate(s, w, pad, y, a)
            worst, total = pads.evaluate(s, w, pad, y, a)
            mismatch, squares = worst if not worst <= mismatch else mismatch, squares + total
        most = previous if iteration > SEARCH_AFTER else np.inf
        stuck = iteration > 0 and not squares < most
        if stuck and part > SHORTEST:
            part *= 0.5
            for pad in range(count):
                pads.move(s, w, pad, part)
            for i in range(free):
                c = s.body_coordinate[i]
                w.V[c] = V_old[c] + part * dV[i]
            drive(s, w, y, signals, a)
            continue
        if iteration > 0 and mismatch <= limits.tolerance:
            return True, iteration
        rounded = mismatch <= ROUNDED * limits.tolerance
        if not np.isfinite(mismatch) or iteration == limits.max_iterations or (stuck and rounded):
            return rounded, iteration
        balance(s, w, y, signals, a, r, Rv)
        for pad in range(count):
            contacts.linearise(s, w, pad, a, False)
            contacts.touched_nodes(s, w, pad)
            pads.assemble(s, w, pad, y, a, Rv)
            contacts.residual(s, w, pad, r)
            pads.react(s, w, pad, y, a, r)
            contacts.eliminate(s, w, pad, 1, r, Rv)
        for i in range(free):
            b[i, 0] = -r[i, 0]
        solve_dense(Rv, b, free, 1)
        for i in range(free):
            dV[i] = b[i, 0]
        put(w.V, V_old)
        for pad in range(count):
            pads.propose(s, w, pad, a, 1, dV)
            pads.move(s, w, pad, 1.0)
        for i in range(free):
            w.V[s.body_coordinate[i]] += dV[i]
        drive(s, w, y, signals, a)
        previous, part, iteration = squares, 1.0, iteration + 1


@compiled
def finish(
    s: Any, w: Any, y: Array, signals: Array, a: float, powers: Array, wrenches: Array
) -> float:
    """All rates of the accepted stage in w.k, what the pads and contacts dissipate in `powers`
    (pads, dashpots, slip) [W], generalised forces in w.load, the force on every pad [N] and its
    moment (Eq. 35) [N.m] in its base's axes. Returns a bound of every surface speed [m/s]."""
    count, fastest, bound = s.pad_base.size, 0.0, 0.0
    powers[: count + 2] = 0.0
    contacts.loads(s, w)
    for pad in range(count):
        contacts.finish(s, w, pad, y, a, powers, wrenches[pad])
        fastest = max(fastest, pads.finish(s, w, pad, y, a, powers, wrenches[pad]))
    for i in range(s.body_coordinate.size):
        c = s.body_coordinate[i]
        w.k[s.body_q_start + i] = w.V[c]
        w.k[s.body_V_start + i] = (w.V[c] - y[s.body_V_start + i]) / a
    remember(s, w, y, signals, a)
    for c in range(s.contact_pad.size):
        rate = w.relative[c, 3:]
        speed = np.hypot(rate[0], rate[1]) + abs(rate[2]) * s.contact_size[c]
        bound = max(bound, speed)
    return bound + fastest
