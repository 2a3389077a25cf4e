"""One stage of the implicit step: the rates k that solve k = f(t, y* + a h k), by Newton's method.

States of contact points are local, pads are blocks, so Newton's unknowns are the forces at the
touched nodes, pad by pad, and then the velocities of the free coordinates.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, contacts, pads
from torchsoft.solve.kernel.arrays import SIDE
from torchsoft.solve.kernel.linear import put, solve_dense
from torchsoft.solve.kernel.sources import drive, keep_states, resist
from torchsoft.solve.kernel.table import Array

SEARCH_AFTER, SHORTEST = 2, 2.0**-10
"""After so many iterations a Newton step that does not lessen the mismatch is halved, down to this
part of it; before, one whose mismatch is not a number."""

ROUNDED = 10.0
"""Mismatch, in tolerances, that is accepted where rounding stops Newton's iteration: no shorter
step lessens it."""


@compiled
def place_bodies(rig: Any, work: Any, y: Array, signals: Array, a: float) -> None:
    """All coordinates at the end of the stage: those of the state for the free velocities in V,
    signals for the others."""
    q, V = work.q, work.V
    for c in range(rig.body_free.size):
        if rig.body_free[c] >= 0:
            q[c] = y[rig.body_q_start + rig.body_free[c]] + a * V[c]
        elif rig.body_signal[c] >= 0:
            q[c], V[c] = signals[rig.body_signal[c], 0], signals[rig.body_signal[c], 1]


@compiled
def scan(rig: Any, work: Any, y: Array, margin: float) -> None:
    """List the points within `margin` [m] of touching at the stage's start, work.q, in
    `work.window`; needs `pads.begin`."""
    contacts.relate_all(rig, work)
    for pad in range(rig.pad_base.size):
        first, last = rig.pad_node_start[pad], rig.pad_node_start[pad + 1]
        pads.displace(rig, work, pad, y, first, last)
        at = rig.pad_point_start[pad]
        count, low, high = 0, last, first
        for k in range(at, rig.pad_point_start[pad + 1]):
            ux, uy = contacts.at_point(rig, k, work.u)
            contacts.place(rig, work, k, ux, uy, 0.0, 0.0, work.probe)
            if not contacts.separation(rig, work, k, work.probe) > margin:
                work.window[at + count] = k
                count += 1
                for j in range(SIDE):
                    node = rig.point_node[k, j]
                    low, high = min(low, node), max(high, node + 1)
        for node in range(first, last):
            if node < work.low[pad] or node >= work.high[pad]:
                work.u_dot[node, 0], work.u_dot[node, 1] = work.free[node, 0], work.free[node, 1]
        work.windows[pad], work.low[pad], work.high[pad] = count, low, max(low, high)
    work.travelled[0], work.travelled[1], work.travelled[2] = 0.0, margin, work.travelled[2] + 1.0


@compiled
def beyond_linear(work: Any, part: float) -> tuple[float, float]:
    """Largest difference [N or N.m] between the efforts of the sources and what their derivatives
    say of Newton's step, or a part of it; and the sum of its squares."""
    worst = total = 0.0
    for i in range(work.dV.size):
        error = work.r[i, 0] - work.r_before[i, 0]
        for j in range(work.dV.size):
            error -= part * work.Rv_before[i, j] * work.dV[j]
        worst = abs(error) if not abs(error) <= worst else worst
        total += error * error
    return worst, total


@compiled
def solve_stage(
    rig: Any, work: Any, limits: Any, y: Array, signals: Array, a: float, margin: float
) -> tuple[bool, int]:
    """Velocities (work.V, on entry the guess), nodal forces and rates at the end of the stage that
    starts from y.

    Newton ends when the law and the linear relations agree to the tolerance at every node, and the
    sources with their derivatives. Returns success and the number of linear solves.
    """
    count, free = rig.pad_base.size, rig.body_coordinate.size
    place_bodies(rig, work, y, signals, a)
    for pad in range(count):
        pads.begin(rig, work, pad, y, a)
    if not work.travelled[0] <= work.travelled[1]:  # also where they are no numbers yet
        scan(rig, work, y, margin)
    for pad in range(count):
        pads.displace(rig, work, pad, y, work.low[pad], work.high[pad])
        work.F_linear[work.low[pad] : work.high[pad]] = 0.0
    V_old, dV, r, Rv, b = work.V_old, work.dV, work.r, work.Rv, work.b
    previous, part, iteration = np.inf, 1.0, 0
    while True:
        contacts.relate_all(rig, work)
        mismatch, squares = 0.0, 0.0
        for pad in range(count):
            contacts.evaluate(rig, work, pad, y, a)
            worst, total = pads.evaluate(rig, work, pad, y, a)
            mismatch, squares = worst if not worst <= mismatch else mismatch, squares + total
        drive(rig, work, y, signals, a, r, Rv)
        if iteration > 0:
            worst, total = beyond_linear(work, part)
            mismatch, squares = worst if not worst <= mismatch else mismatch, squares + total
        most = previous if iteration > SEARCH_AFTER else np.inf
        stuck = iteration > 0 and not squares < most
        if stuck and part > SHORTEST:
            part *= 0.5
            for pad in range(count):
                pads.move(rig, work, pad, part)
            for i in range(free):
                c = rig.body_coordinate[i]
                work.V[c] = V_old[c] + part * dV[i]
            place_bodies(rig, work, y, signals, a)
            continue
        if iteration > 0 and mismatch <= limits.tolerance:
            return True, iteration
        rounded = mismatch <= ROUNDED * limits.tolerance
        if not np.isfinite(mismatch) or iteration == limits.max_iterations or (stuck and rounded):
            return rounded, iteration
        put(r, work.r_before)
        put(Rv, work.Rv_before)
        resist(rig, work, y, a, r, Rv)
        for pad in range(count):
            contacts.linearise(rig, work, pad, a, False)
            contacts.touched_nodes(rig, work, pad)
            pads.assemble(rig, work, pad, y, a, Rv)
            contacts.residual(rig, work, pad, r)
            pads.react(rig, work, pad, y, a, r)
            contacts.eliminate(rig, work, pad, 1, r, Rv)
        for i in range(free):
            b[i, 0] = -r[i, 0]
        solve_dense(Rv, b, free, 1)
        for i in range(free):
            dV[i] = b[i, 0]
        put(work.V, V_old)
        for pad in range(count):
            pads.propose(rig, work, pad, a, 1, dV)
            pads.move(rig, work, pad, 1.0)
        for i in range(free):
            work.V[rig.body_coordinate[i]] += dV[i]
        place_bodies(rig, work, y, signals, a)
        previous, part, iteration = squares, 1.0, iteration + 1


@compiled
def finish(rig: Any, work: Any, y: Array, a: float, powers: Array, wrenches: Array) -> float:
    """All rates of the accepted stage in work.k, what the pads and contacts dissipate in `powers`
    (pads, dashpots, slip) [W], generalised forces in work.load, the force on every pad [N] and its
    moment (Eq. 35) [N.m] in its base's axes. Returns a bound of every surface speed [m/s]."""
    count, fastest, bound = rig.pad_base.size, 0.0, 0.0
    powers[: count + 2] = 0.0
    contacts.loads(rig, work)
    for pad in range(count):
        contacts.finish(rig, work, pad, y, a, powers, wrenches[pad])
        fastest = max(fastest, pads.finish(rig, work, pad, y, a, powers, wrenches[pad]))
    for i in range(rig.body_coordinate.size):
        c = rig.body_coordinate[i]
        work.k[rig.body_q_start + i] = work.V[c]
        work.k[rig.body_V_start + i] = (work.V[c] - y[rig.body_V_start + i]) / a
    keep_states(rig, work, a)
    for c in range(rig.contact_pad.size):
        rate = work.relative[c, 3:]
        speed = np.hypot(rate[0], rate[1]) + abs(rate[2]) * rig.contact_size[c]
        bound = max(bound, speed)
    return bound + fastest
