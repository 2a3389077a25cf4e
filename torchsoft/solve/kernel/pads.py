"""Blocks of pads behind one set of operations; the kind of a pad decides who does them.

A pad is to its contacts one affine relation at every iterate, u' = free + P F - D dV_base, whatever
its material: `begin` and `displace` a stage, `evaluate` what a trial leaves, `assemble` its block,
`propose` and `move`, `finish`; `push_...` belong to the tangent, `pull_...` to the adjoint.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, condensed, contacts, nodal
from torchsoft.solve.kernel.arrays import CONDENSED
from torchsoft.solve.kernel.linear import put
from torchsoft.solve.kernel.table import Array


@compiled
def begin(rig: Any, work: Any, pad: int, y: Array, a: float) -> None:
    """Start of a stage from y."""
    if rig.pad_kind[pad] == CONDENSED:
        condensed.begin(rig, work, pad, y, a)


@compiled
def displace(rig: Any, work: Any, pad: int, y: Array, low: int, high: int) -> None:
    """u* and the rates without contact of the surface nodes from `low` to `high`; needs `begin`."""
    if rig.pad_kind[pad] == CONDENSED:
        condensed.displace(rig, work, pad, low, high)
    else:
        nodal.displace(rig, work, pad, y, low, high)


@compiled
def evaluate(rig: Any, work: Any, pad: int, y: Array, a: float) -> tuple[float, float]:
    """How far the law's forces work.F are from those that the linear relations were solved with,
    and the pad from its own balance: the largest difference [N], and the sum of squares [N2]."""
    worst, squares = 0.0, 0.0
    for node in range(work.low[pad], work.high[pad]):
        for r in range(2):
            off = abs(work.F[node, r] - work.F_linear[node, r])
            if not off <= worst:  # a force that is not a number is the largest
                worst = off
            squares += off * off
    if rig.pad_kind[pad] != CONDENSED:
        most, total = nodal.evaluate(rig, work, pad, y, a)
        worst, squares = most if not most <= worst else worst, squares + total
    return worst, squares


@compiled
def assemble(rig: Any, work: Any, pad: int, y: Array, a: float, Rv: Array) -> None:
    """The block of a pad, with its mobility between the touched nodes, work.P, its rates without
    contact, work.free, and the effects of its inertia."""
    if rig.pad_kind[pad] == CONDENSED:
        condensed.relation(rig, work, pad, a)
    else:
        nodal.relation(rig, work, pad, y, a)
    contacts.assemble(rig, work, pad, a, Rv)
    if nodal.inertial(rig, pad):
        nodal.couple(rig, work, pad, Rv)


@compiled
def restore(rig: Any, work: Any, tape: Any, row: int, a: float, recorded: bool) -> None:
    """A stage from the tape, with the derivatives of the pads' materials where it ended."""
    contacts.restore(rig, work, tape, row, a, recorded)
    put(tape.rate[row], work.rate)
    for pad in range(rig.pad_base.size):
        if rig.pad_kind[pad] != CONDENSED:
            nodal.relinearise(rig, work, pad, tape.y[row], a)


@compiled
def react(rig: Any, work: Any, pad: int, y: Array, a: float, r: Array) -> None:
    """The reaction of a pad's inertia on its base, in r."""
    if nodal.inertial(rig, pad):
        nodal.react(rig, work, pad, y, a, r)


@compiled
def propose(rig: Any, work: Any, pad: int, a: float, m: int, dV: Array) -> None:
    """Newton's forces and nodal rates for the change of velocity dV, from the solution of m
    right-hand sides in work.X."""
    first, n, low, high = rig.pad_node_start[pad], work.counts[pad], work.low[pad], work.high[pad]
    X = work.X[2 * first : 2 * (first + n)]
    for node in range(low, high):
        for r in range(2):
            work.F_old[node, r], work.u_dot_old[node, r] = (
                work.F_linear[node, r],
                work.u_dot[node, r],
            )
            work.F_new[node, r] = 0.0
    for i in range(n):
        for r in range(2):
            f = X[2 * i + r, 0]
            for number in range(dV.size):
                if rig.pad_column[pad, number] >= 0:
                    f += X[2 * i + r, m + rig.pad_column[pad, number]] * dV[number]
            work.F_new[work.touched[first + i], r] = f
    if rig.pad_kind[pad] == CONDENSED:
        condensed.propose(rig, work, pad, a)
    else:
        nodal.propose(rig, work, pad, dV)


@compiled
def move(rig: Any, work: Any, pad: int, part: float) -> None:
    """Go `part` of the way from the old iterate to the proposed one."""
    for node in range(work.low[pad], work.high[pad]):
        for r in range(2):
            F, rate = work.F_old[node, r], work.u_dot_old[node, r]
            work.F_linear[node, r] = F + part * (work.F_new[node, r] - F)
            work.u_dot[node, r] = rate + part * (work.u_dot_new[2 * node + r] - rate)
    if rig.pad_kind[pad] != CONDENSED:
        nodal.move(rig, work, pad, part)


@compiled
def stored(rig: Any, pad: int, y: Array) -> float:
    """Strain energy of a condensed pad [J]; that of a nodal one is not found here, but nan."""
    return condensed.stored(rig, pad, y) if rig.pad_kind[pad] == CONDENSED else np.nan


@compiled
def finish(
    rig: Any, work: Any, pad: int, y: Array, a: float, powers: Array, wrench: Array
) -> float:
    """Rates of the pad's state into work.k, and the power that it dissipates; returns a bound of
    its nodes' speeds [m/s]."""
    if rig.pad_kind[pad] == CONDENSED:
        return condensed.finish(rig, work, pad, y, a, powers)
    return nodal.finish(rig, work, pad, y, a, powers, wrench)


@compiled
def find_spans(rig: Any, y: Array, dy: Array, span: Array) -> None:
    """Dofs of condensed pads whose derivatives count."""
    for pad in range(rig.pad_base.size):
        if rig.pad_kind[pad] == CONDENSED:
            condensed.find_span(rig, pad, y, dy, span)


@compiled
def push(
    rig: Any, work: Any, along: Any, pad: int, y: Array, dy: Array, dp: Array, a: float
) -> None:
    """Derivatives of u* (along.u) and of u' before the forces' own change (along.rate) at the
    touched nodes, and the reaction of inertia on the base in along.r."""
    if rig.pad_kind[pad] == CONDENSED:
        condensed.push(rig, work, along, pad, y, dy, dp, a)
    else:
        nodal.push(rig, work, along, pad, y, dy, dp, a)


@compiled
def push_rates(rig: Any, work: Any, along: Any, pad: int, a: float, columns: int) -> None:
    """Tangents of the nodal forces, in work.X, and of the touched nodes' rates less along.rate,
    along.touched_rate, from the solution in work.X and along.dV."""
    first, n = rig.pad_node_start[pad], work.counts[pad]
    X = work.X[2 * first : 2 * (first + n)]
    contacts.load_nodes(rig, work, pad, columns, along.dV)
    along.touched_rate[:n] = 0.0
    if rig.pad_kind[pad] == CONDENSED:
        condensed.push_rates(rig, work, along, pad, a, X)
    else:
        nodal.push_rates(rig, work, along, pad, X, columns)


@compiled
def push_state(
    rig: Any, work: Any, along: Any, pad: int, y: Array, a: float, dy: Array, dp: Array
) -> None:
    """Tangents of the pad's state at the stage's end, after `push_rates`."""
    if rig.pad_kind[pad] == CONDENSED:
        first = rig.pad_node_start[pad]
        X = work.X[2 * first : 2 * (first + work.counts[pad])]
        condensed.push_state(rig, work, along, pad, y, a, X, dy, dp)
    else:
        nodal.push_state(rig, work, along, pad, a, dy)


@compiled
def pull_forces(rig: Any, work: Any, along: Any, pad: int, y_bar: Array, a: float) -> None:
    """Cotangents of the touched nodes' forces into the first column of work.X, and of the base's
    velocity, from those of the pad's state and of the touched nodes' rates, along.touched_rate."""
    if rig.pad_kind[pad] == CONDENSED:
        condensed.pull_forces(rig, work, along, pad, y_bar, a)
    else:
        nodal.pull_forces(rig, work, along, pad, y_bar, a)


@compiled
def pull_state(
    rig: Any, work: Any, along: Any, pad: int, y: Array, y_bar: Array, a: float, p_bar: Array
) -> None:
    """Cotangents of the pad's state at the stage's start and of its material, from those of the
    nodal rates and displacements, along.rate and along.u."""
    if rig.pad_kind[pad] == CONDENSED:
        condensed.pull_state(rig, work, along, pad, y, y_bar, a, p_bar)
    else:
        nodal.pull_state(rig, work, along, pad, y, y_bar, a, p_bar)
