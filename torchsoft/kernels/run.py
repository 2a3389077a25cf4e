"""Many implicit steps in one compiled call: SDIRK2, its running energy integrals, and what ends a run early.

SDIRK2 is Alexander's two-stage method (SIAM J. Numer. Anal. 14, 1977): L-stable, stiffly accurate, of second order,
both stages with the same a = 1 - 1/sqrt(2), so that one mobility serves both.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.kernels import compiled
from torchsoft.kernels.node import Array
from torchsoft.kernels.stage import finish_pad, solve_stage

GAMMA = 1.0 - 1.0 / np.sqrt(2.0)

CONVERGED, NEWTON_FAILED, OFF_THE_PAD, LOST, TAPE_FULL = range(5)

DISSIPATED = ("pad_L", "pad_U", "contact_dashpots", "slip")
SUPPLIED = ("control_x", "control_y", "gravity")
INTEGRALS = (*DISSIPATED, *SUPPLIED, "injected")
"""Running integrals [J]: dissipated by, supplied by, and the positive part of what each source supplies."""


class Tape(NamedTuple):
    """What the adjoint and the sensitivities need of every stage, stages first; no rows where nothing is to be taped.

    count (., 2) touching nodes a pad, node (., 2, cap) their numbers, place (., 2, cap, 5) their d, w and s*, force
    (., 2, cap, 2) [N]; q_star, V_star, V (., 5); u_dot (., dofs of both pads) [m/s], s_star (., surface of both) [m].
    """

    count: NDArray[np.int64]
    node: NDArray[np.int64]
    place: Array
    force: Array
    q_star: Array
    V_star: Array
    V: Array
    u_dot: Array
    s_star: Array


def empty_tape(stages: int, dofs: int, surface: int, cap: int) -> Tape:
    """Room for that many stages; `cap` touching nodes a pad."""
    return Tape(
        np.zeros((stages, 2), np.int64), np.zeros((stages, 2, cap), np.int64), np.zeros((stages, 2, cap, 5)),
        np.zeros((stages, 2, cap, 2)), np.zeros((stages, 5)), np.zeros((stages, 5)), np.zeros((stages, 5)),
        np.zeros((stages, dofs)), np.zeros((stages, surface)),
    )  # fmt: skip


def first_stages(tape: Tape, stages: int) -> Tape:
    """The beginning of a tape, of a run that ended early."""
    parts: Any = [part[:stages] for part in tape]
    return Tape(*parts)


@compiled
def write_tape(tape: Any, row: int, pads: Any, states: Any, works: Any, q: Array, V_star: Array, V: Array) -> bool:
    """Put one solved stage on the tape; False if more nodes touch than it has room for."""
    dof, node = 0, 0
    tape.q_star[row], tape.V_star[row], tape.V[row] = q, V_star, V
    for p in range(2):
        work, state = works[p], states[p]
        k = 0
        while k < work.active.size and work.active[k] >= 0:
            if k == tape.node.shape[2]:
                return False
            i = work.active[k]
            tape.node[row, p, k] = i
            tape.place[row, p, k, :2], tape.place[row, p, k, 2:4] = work.d[i], work.w[i]
            tape.place[row, p, k, 4] = state.s[i]
            tape.force[row, p, k] = work.f_linear[i]
            k += 1
        tape.count[row, p] = k
        tape.u_dot[row, dof : dof + work.u_dot.size] = work.u_dot
        tape.s_star[row, node : node + state.s.size] = state.s
        dof += work.u_dot.size
        node += state.s.size
    return True


@compiled
def advance(state: Any, work: Any, dt: float) -> None:
    """y += dt k for one pad."""
    state.u[:] += dt * work.u_dot
    state.v[:] += dt * work.v_dot
    state.Ku[:] += dt * work.Ku_dot
    state.s[:] += dt * work.s_dot


@compiled
def record(states: Any, works: Any, q: Array, V: Array, y: Array, forces: Array) -> None:
    """The flat state vector (`state.Layout`) and (F_N, F_T) of every surface node."""
    k = 0
    for p in range(2):
        y[k : k + states[p].u.size] = states[p].u
        k += states[p].u.size
    for p in range(2):
        y[k : k + states[p].s.size] = states[p].s
        k += states[p].s.size
    y[k : k + 5] = q
    k += 5
    for p in range(2):
        y[k : k + states[p].v.size] = states[p].v
        k += states[p].v.size
    y[k : k + 5] = V
    lower = states[0].s.size
    forces[:lower] = works[0].forces
    forces[lower:] = works[1].forces


@compiled
def gone(pads: Any, works: Any, q: Array, c: Any) -> int:
    """Whether the disc has left: a contact at the end of a pad, or the bracket or the disc thrown clear."""
    for p in range(2):
        touching = 0
        while touching < works[p].active.size and works[p].active[touching] >= 0:
            touching += 1
        if touching > 0 and (works[p].active[0] == 0 or works[p].active[touching - 1] == pads[p].surface.size - 1):
            return OFF_THE_PAD
    half = 0.5 * c.pad_length
    beside = q[0] < 0.0 or q[0] > c.pad_length or abs(q[0] - q[3]) > half
    if beside or abs(q[1]) > c.pad_length or abs(q[4] - q[1]) > c.pad_length:
        return LOST
    return CONVERGED


@compiled
def run(
    pads: Any, states: Any, works: Any, q: Array, V: Array, wants: Array, h: float, c: Any, tolerance: float,
    max_iterations: int, margin: float, keep: Any, integrals: Array, ys: Array, forces: Array, extras: Array, tape: Any,
) -> tuple[int, int, int]:  # fmt: skip
    """Take len(wants) steps of h [s]; wants (steps, 2, 5) are the set-points at the stages; `tape` has two rows a step.

    After the steps marked in `keep`, the state goes to `ys`, nodal forces to `forces`, and integrals and the bracket's
    moment [N.m] to `extras`, one row each. `states`, q, V and `integrals` are advanced in place; after a failure they hold
    the last good step. Returns steps taken, status, and linear solves.
    """
    ah = GAMMA * h
    V_star, powers = np.empty(5), np.empty(len(INTEGRALS))
    moment, row, solves = 0.0, 0, 0
    for step in range(len(wants)):
        backup = (states[0].u.copy(), states[1].u.copy(), states[0].v.copy(), states[1].v.copy(), states[0].Ku.copy(),
                  states[1].Ku.copy(), states[0].s.copy(), states[1].s.copy())  # fmt: skip
        q_old, V_old, integrals_old = q.copy(), V.copy(), integrals.copy()
        V_star[:] = V
        status = CONVERGED
        for stage in range(2):
            want = wants[step, stage]
            converged, count = solve_stage(
                pads, states, works, q, V_star, V, want, ah, c, tolerance, max_iterations, margin
            )
            solves += count
            if not converged:
                status = NEWTON_FAILED
                break
            if tape.count.shape[0] > 0 and not write_tape(tape, 2 * step + stage, pads, states, works, q, V_star, V):
                return step, TAPE_FULL, solves
            powers[:] = 0.0
            for p in range(2):
                moment = finish_pad(pads[p], states[p], works[p], q, V, ah, c, powers, p)
            F_x = c.K_81 * (want[0] - q[c.sensed] - ah * V[c.sensed]) + c.R_80 * (want[1] - V[c.sensed])
            F_y = c.K_98 * (want[2] - q[4] - ah * V[4]) + c.R_99 * (want[3] - V[4]) + want[4]
            powers[4], powers[5], powers[6] = F_x * V[3], F_y * V[4], -c.m_C * c.gravity * V[1]
            powers[7] = max(powers[4], 0.0) + max(powers[5], 0.0) + max(powers[6], 0.0)
            dt = ah if stage == 1 else h - ah  # y* of stage 2 is y + (1 - gamma) h k1; then y + ... + gamma h k2
            integrals += dt * powers
            for p in range(2):
                advance(states[p], works[p], dt)
            q += dt * V
            V_star += dt / ah * (V - V_star)
        if status == CONVERGED:
            status = gone(pads, works, q, c)
        if status != CONVERGED:
            for p in range(2):
                states[p].u[:], states[p].v[:] = backup[p], backup[2 + p]
                states[p].Ku[:], states[p].s[:] = backup[4 + p], backup[6 + p]
            q[:], V[:], integrals[:] = q_old, V_old, integrals_old
            return step, status, solves
        if keep[step]:
            record(states, works, q, V, ys[row], forces[row])
            extras[row, : len(INTEGRALS)] = integrals
            extras[row, len(INTEGRALS)] = moment  # (35)
            row += 1
    return len(wants), CONVERGED, solves
