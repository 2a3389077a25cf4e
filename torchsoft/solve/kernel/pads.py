"""Blocks of pads behind one set of operations; the kind of a pad decides who does them.

A pad is to its contacts one affine relation at every iterate, u' = free + P F - D dV_base, whatever
its material: `begin` and `displace` a stage, `evaluate` what a trial leaves, `assemble` its block,
`propose` and `move`, `finish`; `push_...` and `pull_...` are the tangent's and the adjoint's.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, condensed, contacts, nodal
from torchsoft.solve.kernel.arrays import CONDENSED
from torchsoft.solve.kernel.linear import add, put
from torchsoft.solve.kernel.table import Array


@compiled
def begin(s: Any, w: Any, pad: int, y: Array, a: float) -> None:
    """Start of a stage from y."""
    if s.pad_kind[pad] == CONDENSED:
        condensed.begin(s, w, pad, y, a)


@compiled
def displace(s: Any, w: Any, pad: int, y: Array, low: int, high: int) -> None:
    """u* and the rates without contact of the surface nodes from `low` to `high`; needs `begin`."""
    if s.pad_kind[pad] == CONDENSED:
        condensed.displace(s, w, pad, low, high)
    else:
        nodal.displace(s, w, pad, y, low, high)


@compiled
def evaluate(s: Any, w: Any, pad: int, y: Array, a: float) -> tuple[float, float]:
    """How far the law's forces w.F are from those that the linear relations were solved with, and
    the pad from its own balance: the largest difference [N], and the sum of squares [N2]."""
    worst, squares = 0.0, 0.0
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            off = abs(w.F[node, r] - w.F_linear[node, r])
            if not off <= worst:  # a force that is not a number is the largest
                worst = off
            squares += off * off
    if s.pad_kind[pad] != CONDENSED:
        most, total = nodal.evaluate(s, w, pad, y, a)
        worst, squares = most if not most <= worst else worst, squares + total
    return worst, squares


@compiled
def assemble(s: Any, w: Any, pad: int, y: Array, a: float, Rv: Array) -> None:
    """The block of a pad, with its mobility between the touched nodes, w.P, its rates without
    contact, w.free, and the effects of its inertia."""
    if s.pad_kind[pad] == CONDENSED:
        condensed.relation(s, w, pad, a)
    else:
        nodal.relation(s, w, pad, y, a)
    contacts.assemble(s, w, pad, a, Rv)
    if nodal.inertial(s, pad):
        nodal.couple(s, w, pad, Rv)


@compiled
def restore(s: Any, w: Any, tape: Any, row: int, a: float, felt: bool) -> None:
    """A stage from the tape, with the derivatives of the pads' materials where it ended."""
    contacts.restore(s, w, tape, row, a, felt)
    put(tape.rate[row], w.rate)
    for pad in range(s.pad_base.size):
        if s.pad_kind[pad] != CONDENSED:
            nodal.relinearise(s, w, pad, tape.y[row], a)


@compiled
def react(s: Any, w: Any, pad: int, y: Array, a: float, r: Array) -> None:
    """The reaction of a pad's inertia on its base, in r."""
    if nodal.inertial(s, pad):
        nodal.react(s, w, pad, y, a, r)


@compiled
def propose(s: Any, w: Any, pad: int, a: float, m: int, dV: Array) -> None:
    """Newton's forces and nodal rates for the change of velocity dV, from the solution of m
    right-hand sides in w.X."""
    first, n, low, high = s.pad_node_start[pad], w.counts[pad], w.low[pad], w.high[pad]
    X = w.X[2 * first : 2 * (first + n)]
    for node in range(low, high):
        for r in range(2):
            w.F_old[node, r], w.u_dot_old[node, r] = w.F_linear[node, r], w.u_dot[node, r]
            w.F_new[node, r] = 0.0
    for i in range(n):
        for r in range(2):
            f = X[2 * i + r, 0]
            for number in range(dV.size):
                if s.pad_column[pad, number] >= 0:
                    f += X[2 * i + r, m + s.pad_column[pad, number]] * dV[number]
            w.F_new[w.touched[first + i], r] = f
    if s.pad_kind[pad] == CONDENSED:
        condensed.propose(s, w, pad, a)
    else:
        nodal.propose(s, w, pad, dV)


@compiled
def move(s: Any, w: Any, pad: int, part: float) -> None:
    """Go `part` of the way from the old iterate to the proposed one."""
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            F, rate = w.F_old[node, r], w.u_dot_old[node, r]
            w.F_linear[node, r] = F + part * (w.F_new[node, r] - F)
            w.u_dot[node, r] = rate + part * (w.u_dot_new[2 * node + r] - rate)
    if s.pad_kind[pad] != CONDENSED:
        nodal.move(s, w, pad, part)


@compiled
def stored(s: Any, pad: int, y: Array) -> float:
    """Strain energy of a condensed pad [J]; that of a nodal one is not found here, but nan."""
    return condensed.stored(s, pad, y) if s.pad_kind[pad] == CONDENSED else np.nan


@compiled
def finish(s: Any, w: Any, pad: int, y: Array, a: float, powers: Array, wrench: Array) -> float:
    """Rates of the pad's state into w.k, and the power that it dissipates; returns a bound of its
    nodes' speeds [m/s]."""
    if s.pad_kind[pad] == CONDENSED:
        return condensed.finish(s, w, pad, y, a, powers)
    return nodal.finish(s, w, pad, y, a, powers, wrench)


@compiled
def find_spans(s: Any, y: Array, dy: Array, span: Array) -> None:
    """Dofs of condensed pads whose derivatives count."""
    for pad in range(s.pad_base.size):
        if s.pad_kind[pad] == CONDENSED:
            condensed.find_span(s, pad, y, dy, span)


@compiled
def push(
    s: Any, w: Any, z: Any, pad: int, y: Array, dy: Array, dp: Array, a: float, r: Array
) -> None:
    """Derivatives of u* (z.u) and of u' before the forces' own change (z.v) at the touched nodes,
    and the reaction of inertia on the base in r."""
    if s.pad_kind[pad] == CONDENSED:
        condensed.push(s, w, z, pad, y, dy, dp, a)
    else:
        nodal.push(s, w, z, pad, y, dy, dp, a, r)


@compiled
def push_rates(s: Any, w: Any, z: Any, pad: int, a: float, m: int) -> None:
    """Tangents of the nodal forces, in w.X, and of the touched nodes' rates less z.v, z.own_rate,
    from the solution in w.X and z.V."""
    first, n = s.pad_node_start[pad], w.counts[pad]
    X = w.X[2 * first : 2 * (first + n)]
    contacts.load_nodes(s, w, pad, m, z.V)
    z.own_rate[:n] = 0.0
    if s.pad_kind[pad] == CONDENSED:
        condensed.push_rates(s, w, z, pad, a, X)
    else:
        nodal.push_rates(s, w, z, pad, X, m)


@compiled
def push_state(s: Any, w: Any, z: Any, pad: int, y: Array, a: float, dy: Array, dp: Array) -> None:
    """Tangents of the pad's state at the stage's end, after `push_rates`."""
    if s.pad_kind[pad] == CONDENSED:
        first = s.pad_node_start[pad]
        X = w.X[2 * first : 2 * (first + w.counts[pad])]
        condensed.push_state(s, w, z, pad, y, a, X, dy, dp)
    else:
        nodal.push_state(s, w, z, pad, a, dy)


@compiled
def pull_forces(
    s: Any, w: Any, z: Any, pad: int, y_bar: Array, a: float, V_bar: Array, felt: bool
) -> None:
    """Cotangents of the touched nodes' forces into the first column of w.X, from those of the pad's
    state and of the law's outputs at the touching points, z.out; those of the velocities are added
    to V_bar."""
    at, b, by = s.pad_point_start[pad], z.surface[0, : 2 * w.counts[pad]], z.by
    b[:] = 0.0
    for i in range(at, at + w.actives[pad]):
        k = w.active[i]
        c = s.point_contact[k]
        by[:] = 0.0
        for r in range(contacts.outputs(s, c, felt)):
            add(z.out[k, r], w.H[i, r], by)
        for j in range(2):
            if s.point_N[k, j] != 0.0:
                row = 2 * w.slot[s.point_node[k, j]]
                add(s.point_N[k, j], by, b[row : row + 2])
        for row in range(6):
            if s.contact_number[c, row] >= 0:
                V_bar[s.contact_number[c, row]] += by[2 + row]
    first = s.pad_node_start[pad]
    X = w.X[2 * first : 2 * (first + w.counts[pad])]
    if s.pad_kind[pad] == CONDENSED:
        condensed.pull_forces(s, w, pad, y_bar, a, b, X)
    else:
        nodal.pull_forces(s, w, z, pad, y_bar, a, b, X, V_bar)


@compiled
def pull_state(
    s: Any, w: Any, z: Any, pad: int, y: Array, y_bar: Array, a: float, nu: Array, V_bar: Array,
    p_bar: Array,
) -> None:  # fmt: skip
    """Cotangents of the pad's state at the stage's start and of its material, from those of the
    nodal rates and displacements, z.rate and z.u."""
    if s.pad_kind[pad] == CONDENSED:
        condensed.pull_state(s, w, z, pad, y, y_bar, a, p_bar)
    else:
        nodal.pull_state(s, w, z, pad, y, y_bar, a, nu, V_bar, p_bar)
