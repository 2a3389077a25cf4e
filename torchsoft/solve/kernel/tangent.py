"""The tangent stage: forward sensitivities of `run` in several directions at once.

One factorisation of Newton's system a stage, as many right-hand sides as there are directions. A
`d` before a name is its derivative, the last axis counts directions.
"""

from typing import Any

from torchsoft.solve.kernel import compiled, contacts, nodal, pads, transport
from torchsoft.solve.kernel.arrays import GAMMA, INSTANT, MIX
from torchsoft.solve.kernel.linear import add, put, solve_dense
from torchsoft.solve.kernel.sources import balance
from torchsoft.solve.kernel.step import dense_states
from torchsoft.solve.kernel.table import Array

RESCAN = 64
"""Steps between two searches for negligible derivatives."""


@compiled
def stage_tangent(
    rig: Any, work: Any, along: Any, tape: Any, row: int, a: float, signals: Array, dy: Array,
    dp: Array, dsignals: Array, recorded: bool,
) -> None:  # fmt: skip
    """Turn the tangent dy (state, columns) of a stage's y* into that of its end, in place, or if
    `recorded` leave it and put those of its forces into along.recorded."""
    y, columns = tape.y[row], dy.shape[1]
    pads.restore(rig, work, tape, row, a, recorded)
    balance(rig, work, y, signals, a, work.r, work.Rv)
    along.r[:], along.ports[:], along.recorded[:] = 0.0, 0.0, 0.0
    transport.carry_state(rig, along, dy, dsignals, False)
    transport.carry_bodies(rig, work, along, y, a, dy, dp, False)
    transport.carry_loads(rig, work, along, recorded, False)
    for pad in range(rig.pad_base.size):
        pads.assemble(rig, work, pad, y, a, work.Rv)
        pads.push(rig, work, along, pad, y, dy, dp, a)
        transport.carry_points(rig, work, along, pad, dy, dp, recorded, False)
        contacts.eliminate(rig, work, pad, columns, along.r, work.Rv)
    solve_dense(work.Rv, along.r, along.r.shape[0], columns)
    for i in range(along.r.shape[0]):
        along.dV[i] = 0.0
        add(-1.0, along.r[i], along.dV[i])
        add(1.0, along.dV[i], along.V[rig.body_coordinate[i]])
        add(a, along.dV[i], along.q[rig.body_coordinate[i]])

    for pad in range(rig.pad_base.size):
        pads.push_rates(rig, work, along, pad, a, columns)
        transport.carry_ends(rig, work, along, pad, a, dy, recorded, False)
        if recorded and nodal.inertial(rig, pad):
            nodal.carry_recorded(rig, work, along, pad, dy, dp, False)
        elif not recorded:
            transport.carry_out_of_contact(rig, work, along, pad, y, a, dy, dp, False)
            pads.push_state(rig, work, along, pad, y, a, dy, dp)
    if not recorded:
        transport.carry_source_states(rig, work, along, a, dy, dp, False)
        for i in range(along.dV.shape[0]):
            add(a, along.dV[i], dy[rig.body_q_start + i])
            put(along.dV[i], dy[rig.body_V_start + i])


@compiled
def read(call: Any, i: int) -> None:
    """Tangents of the sums of forces at output i into call.dsums."""
    out, recorded = call.dsums[i], call.along.recorded
    if out.shape[0] == 0:
        return
    stage_tangent(
        call.rig, call.work, call.along, call.out_tape, i, INSTANT, call.out_signals[i],
        call.dys[i], call.dp, call.dsignals[0, :0], True,
    )  # fmt: skip
    for c in range(out.shape[0]):
        out[c] = 0.0
        for j in range(call.sum_start[c], call.sum_start[c + 1]):
            add(call.sum_weight[j], recorded[call.sum_at[j]], out[c])


@compiled
def forward(call: Any) -> None:
    """Carry the tangent dy (state, columns) through the steps h of a tape, in place; dys (outputs,
    state, columns) receives it at the parts out_part of the steps out_step, dsums (outputs, sums,
    columns) those of the sums of forces, `Sums`. The start is an output of step -1."""
    rig, work, along, tape, h, signals = (
        call.rig, call.work, call.along, call.tape, call.h, call.signals
    )  # fmt: skip
    out_step, dy, dp, dys, dsignals, row = (
        call.out_step, call.dy, call.dp, call.dys, call.dsignals, 0
    )  # fmt: skip
    if out_step.size > 0 and out_step[0] < 0:  # the start
        put(dy, dys[0])
        if call.out_tape.y.shape[0] > 0:
            pads.find_spans(rig, call.out_tape.y[0], dy, along.span)
        read(call, 0)
        row = 1
    for step in range(h.size):
        a, i = GAMMA * h[step], 2 * step
        if step % RESCAN == 0:
            pads.find_spans(rig, tape.y[i], dy, along.span)
        put(dy, along.start)
        stage_tangent(rig, work, along, tape, i, a, signals[i], dy, dp, dsignals[i], False)
        put(dy, along.first)
        mix(1.0 - MIX, along.start, MIX, along.first, 0.0, dy, dy)
        i += 1
        stage_tangent(rig, work, along, tape, i, a, signals[i], dy, dp, dsignals[i], False)
        while row < out_step.size and out_step[row] == step:
            at_start, at_first, at_end = dense_states(call.out_part[row])
            mix(at_start, along.start, at_first, along.first, at_end, dy, dys[row])
            read(call, row)
            row += 1


@compiled
def mix(a: float, x: Array, b: float, y: Array, c: float, z: Array, out: Array) -> None:
    """a x + b y + c z into an array of their shape."""
    for i in range(out.size):
        out.flat[i] = a * x.flat[i] + b * y.flat[i] + c * z.flat[i]
