"""The transposed stage: the discrete adjoint of `run`.

The stage's relations are differentiated as they stand (implicit function theorem) and solved
backwards. "_bar" marks the cotangent of a name; arrays of cotangents have one column. Those of
`along` (`Directions`) stand for the same quantities as in the tangent; along.nu are the multipliers
of the free coordinates' equations.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, contacts, nodal, pads, transport
from torchsoft.solve.kernel.arrays import GAMMA, INSTANT, MIX
from torchsoft.solve.kernel.linear import put, solve_dense
from torchsoft.solve.kernel.sources import balance
from torchsoft.solve.kernel.step import dense_states
from torchsoft.solve.kernel.table import Array


@compiled
def stage_adjoint(
    rig: Any, work: Any, along: Any, tape: Any, row: int, a: float, signals: Array, y_bar: Array,
    p_bar: Array, signals_bar: Array, recorded: bool,
) -> None:  # fmt: skip
    """Turn the cotangent y_bar (state, 1) of a stage's end into that of its y*, in place; add to
    p_bar (parameters, 1) and signals_bar (2 signals, 1). If `recorded`, along.recorded are those of
    its forces."""
    y, matrix, nu = tape.y[row], along.matrix, along.r
    pads.restore(rig, work, tape, row, a, recorded)
    balance(rig, work, y, signals, a, work.r, work.Rv)
    matrix[:], nu[:], along.ports[:], along.rate_of[:] = 0.0, 0.0, 0.0, 0.0
    for i in range(nu.shape[0]):
        c = rig.body_coordinate[i]
        along.V[c, 0], along.q[c, 0] = (
            y_bar[rig.body_V_start + i, 0],
            y_bar[rig.body_q_start + i, 0],
        )
    transport.carry_source_states(rig, work, along, a, y_bar, p_bar, True)
    for pad in range(rig.pad_base.size):
        pads.assemble(rig, work, pad, y, a, work.Rv)
        along.touched_rate[: work.counts[pad]] = 0.0
        if recorded and nodal.inertial(rig, pad):
            nodal.carry_recorded(rig, work, along, pad, y_bar, p_bar, True)
        transport.carry_ends(rig, work, along, pad, a, y_bar, recorded, True)
        pads.pull_forces(rig, work, along, pad, y_bar, a)
        contacts.transpose(rig, work, pad)
        contacts.eliminate(rig, work, pad, 1, nu, matrix)
    for i in range(nu.shape[0]):
        c = rig.body_coordinate[i]
        nu[i, 0] = -nu[i, 0] - along.V[c, 0] - a * along.q[c, 0]
        for j in range(nu.shape[0]):
            matrix[i, j] += work.Rv[j, i]
    solve_dense(matrix, nu, nu.shape[0], 1)

    along.ports[:] = 0.0
    for pad in range(rig.pad_base.size):
        low, high = work.low[pad], work.high[pad]
        along.rate[low:high], along.u[low:high] = 0.0, 0.0
        contacts.load_nodes(rig, work, pad, 1, nu)
        transport.carry_points(rig, work, along, pad, y_bar, p_bar, recorded, True)
        transport.carry_out_of_contact(rig, work, along, pad, y, a, y_bar, p_bar, True)
    for c in range(along.q.shape[0]):  # so far by rates of the stage, which move positions
        along.V[c, 0] -= a * along.q[c, 0]
    for pad in range(rig.pad_base.size):
        pads.pull_state(rig, work, along, pad, y, y_bar, a, p_bar)
    transport.carry_loads(rig, work, along, recorded, True)
    transport.carry_bodies(rig, work, along, y, a, y_bar, p_bar, True)
    transport.carry_state(rig, along, y_bar, signals_bar, True)


@compiled
def output_adjoint(call: Any, i: int) -> None:
    """Add to the cotangents of output i's state, parameters and signals the share of its forces:
    the adjoint of the stage of no length that gives them."""
    bar, state = call.recorded_bar[i], call.along.end
    some = False
    for j in range(bar.size):
        some |= bar[j] != 0.0
    if some:
        state[:] = 0.0
        put(bar, call.along.recorded)
        stage_adjoint(
            call.rig, call.work, call.along, call.out_tape, i, INSTANT, call.out_signals[i], state,
            call.p_bar, call.out_signals_bar[i], True,
        )  # fmt: skip
        mix_in(1.0, state, call.outputs_bar[i])


@compiled
def mix_in(factor: float, x: Array, out: Array) -> None:
    """Add a multiple of x to an array of as many numbers."""
    for i in range(out.size):
        out.flat[i] += factor * x.flat[i]


@compiled
def backward(call: Any) -> None:
    """Sweep the steps h of a tape backwards; y_bar (state, 1) goes from the end's cotangent to the
    start's, in place.

    outputs_bar (outputs, state) belong to the parts out_part of the steps out_step; where
    recorded_bar (outputs, recorded) of the forces there is not zero, they receive its share. The
    start is an output of step -1. signals are (stages, signals, 2), signals_bar (stages, 2 signals,
    1), those of the outputs alike. failed receives -1, or the step at which a cotangent stopped
    being finite.
    """
    rig, work, along, tape, h, signals = (
        call.rig, call.work, call.along, call.tape, call.h, call.signals
    )  # fmt: skip
    y_bar, p_bar, signals_bar, row = (
        call.y_bar, call.p_bar, call.signals_bar, call.out_step.size - 1
    )  # fmt: skip
    first_bar, start_bar = along.first, along.start
    call.failed[0] = -1
    for i in range(call.out_step.size):
        output_adjoint(call, i)
    for step in range(h.size - 1, -1, -1):
        a, i = GAMMA * h[step], 2 * step + 1
        first_bar[:], start_bar[:] = 0.0, 0.0
        while row >= 0 and call.out_step[row] == step:
            at_start, at_first, at_end = dense_states(call.out_part[row])
            mix_in(at_end, call.outputs_bar[row], y_bar)
            mix_in(at_first, call.outputs_bar[row], first_bar)
            mix_in(at_start, call.outputs_bar[row], start_bar)
            row -= 1
        stage_adjoint(rig, work, along, tape, i, a, signals[i], y_bar, p_bar, signals_bar[i], False)
        mix_in(1.0 - MIX, y_bar, start_bar)
        mix_in(MIX, y_bar, first_bar)
        i -= 1
        stage_adjoint(
            rig, work, along, tape, i, a, signals[i], first_bar, p_bar, signals_bar[i], False
        )
        put(start_bar, y_bar)
        mix_in(1.0, first_bar, y_bar)
        if not np.isfinite(y_bar.sum()):
            call.failed[0] = step
            return
    if row >= 0:  # the start
        mix_in(1.0, call.outputs_bar[row], y_bar)
