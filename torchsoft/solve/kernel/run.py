"""Many implicit steps in one compiled call: SDIRK2, its running energy integrals, and what ends a run early.

SDIRK2 is Alexander's two-stage method (SIAM J. Numer. Anal. 14, 1977): L-stable, stiffly accurate, of second order,
both stages with the same a = 1 - 1/sqrt(2), so that one mobility serves both. The second stage starts from
y* = (1 - MIX) y + MIX Y_1 and its end is the step's.
"""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, entry
from torchsoft.solve.kernel.arrays import Array
from torchsoft.solve.kernel.stage import actuate, finish, solve_stage

GAMMA = 1.0 - 1.0 / np.sqrt(2.0)
MIX = (1.0 - GAMMA) / GAMMA

CONVERGED, NEWTON_FAILED, OFF_THE_PAD, LOST, TAPE_FULL, NOT_FINITE = range(6)

TINY = 1e-60
"""Components of the state below this are set to zero, so that what decays does not end in denormal numbers."""


@compiled
def write_tape(s: Any, w: Any, tape: Any, row: int, y: Array) -> bool:
    """Put one solved stage on the tape; False if more points touch than it has room for."""
    tape.y[row], tape.q[row], tape.V[row], tape.rate[row] = y, w.q, w.V, w.full
    slot = 0
    for pad in range(s.pad_base.size):
        at = s.contact_point_start[s.pad_contact_start[pad]]
        tape.count[row, pad] = w.actives[pad]
        if slot + w.actives[pad] > tape.point.shape[1]:
            return False
        for i in range(w.actives[pad]):
            k = w.active[at + i]
            tape.point[row, slot] = k
            for r in range(2):
                u = v = 0.0
                for j in range(2):
                    node, N = s.point_node[k, j], s.point_N[k, j]
                    u += N * w.u[node, r]
                    v += N * w.u_dot[node, r]
                tape.state[row, slot, r], tape.state[row, slot, 2 + r], tape.state[row, slot, 4 + r] = u, v, w.out[k, r]
            slot += 1
    return True


@compiled
def gone(s: Any, w: Any) -> int:
    """Whether a contact has reached the end of a pad, or a body has left the space over one."""
    for c in range(s.contact_pad.size):
        at = s.contact_point_start[s.pad_contact_start[s.contact_pad[c]]]
        for i in range(w.actives[s.contact_pad[c]]):
            if w.active[at + i] == s.contact_point_start[c] or w.active[at + i] == s.contact_point_start[c + 1] - 1:
                return OFF_THE_PAD
        x, y, limit = w.frame[c, 2], w.frame[c, 3], s.contact_limits[c]
        if not (limit[0] <= x <= limit[1] and limit[2] <= y <= limit[3]):
            return LOST
    return CONVERGED


@compiled
def supply(s: Any, w: Any, signals: Array, powers: Array) -> None:
    """Powers [W] of the actuators, of gravity, of what drives the bodies, and the sum of the positive ones."""
    at = s.pad_base.size + 2
    x, out, J = w.effort_x, w.effort, w.effort_J
    for i in range(s.act_measured.size):
        powers[at + i] = actuate(s, i, w.q, w.V, signals, x, out, J) * w.V[s.act_pushed[i]]
    at += s.act_measured.size
    gravity = 0.0
    for i in range(s.body_coordinate.size):
        gravity -= s.body_weight[i] * s.p[s.body_mass_at[i]] * s.p[s.body_gravity_at] * w.V[s.body_coordinate[i]]
    powers[at] = gravity
    for b in range(s.body_free.size // 3 - 1):
        drive = 0.0
        for c in range(3 * b, 3 * b + 3):
            if s.body_free[c] < 0:
                drive -= w.load[c] * w.V[c]
        for i in range(s.act_measured.size):  # what pushes a driven coordinate is held by what drives it
            if s.act_pushed[i] // 3 == b and s.body_free[s.act_pushed[i]] < 0:
                drive -= powers[s.pad_base.size + 2 + i]
        powers[at + 1 + b] = drive
    total = 0.0
    for i in range(s.pad_base.size + 2, powers.size - 1):
        total += max(powers[i], 0.0)
    powers[-1] = total


@compiled
def record(s: Any, w: Any, integrals: Array, moments: Array, forces: Array, extras: Array) -> None:
    """One row of output: (F_N, F_T) of every point; integrals, the pads' moments and the generalised contact forces."""
    forces[:] = 0.0
    for pad in range(s.pad_base.size):
        at = s.contact_point_start[s.pad_contact_start[pad]]
        for i in range(w.actives[pad]):
            k = w.active[at + i]
            forces[k, 0], forces[k, 1] = w.out[k, 3], w.out[k, 4]
    n, m = integrals.size, moments.size
    extras[:n], extras[n : n + m], extras[n + m :] = integrals, moments, w.load


@entry
def run(
    s: Any, w: Any, y: Array, signals: Array, h: float, tolerance: float, max_iterations: int, margin: float, keep: Any,
    integrals: Array, ys: Array, forces: Array, extras: Array, tape: Any, instant: bool,
) -> tuple[int, int, int]:  # fmt: skip
    """Take len(signals) steps of h [s]; signals (steps, 2, signals, 2) hold value and rate at the stages; `tape` has two rows a
    step, or none.

    After the steps marked in `keep`, the state goes to `ys`, (F_N, F_T) of every point to `forces`, and integrals, the pads'
    moments and the generalised contact forces to `extras`, one row each. y, `integrals` and the guesses in w are advanced in
    place; after a failure they hold the last good step. With `instant` nothing advances: a stage as short as h is solved for
    the forces at one moment, which go to the first row. Returns steps taken, status, and linear solves.
    """
    a, pads, row, solves = GAMMA * h, s.pad_base.size, 0, 0
    powers, moments = np.empty(integrals.size), np.zeros(pads)
    before, integrals_before, V_before = np.empty(y.size), np.empty(integrals.size), np.empty(w.V.size)
    if instant:
        converged, solves = solve_stage(s, w, y, signals[0, 0], h, tolerance, max_iterations, margin)
        if converged:
            finish(s, w, y, h, powers, moments)
            record(s, w, integrals, moments, forces[0], extras[0])
        return 0, CONVERGED if converged else NEWTON_FAILED, solves
    for step in range(len(signals)):
        before[:], integrals_before[:], V_before[:] = y, integrals, w.V
        status = CONVERGED
        for stage in range(2):
            while True:
                converged, count = solve_stage(s, w, y, signals[step, stage], a, tolerance, max_iterations, margin)
                solves += count
                if not converged:
                    break
                speed = finish(s, w, y, a, powers, moments)
                if w.travelled[0] + a * speed <= w.travelled[1]:
                    break
                if w.travelled[0] == 0.0:  # points further away may have come near within this one stage
                    margin_now = margin + 1.5 * a * speed
                    w.travelled[0] = np.inf
                    converged, count = solve_stage(
                        s, w, y, signals[step, stage], a, tolerance, max_iterations, margin_now
                    )
                    solves += count
                    if not converged:
                        break
                    speed = finish(s, w, y, a, powers, moments)
                    if not w.travelled[0] + a * speed <= w.travelled[1]:
                        converged = False
                    break
                w.travelled[0] = np.inf
            if not converged:
                status = NEWTON_FAILED
                break
            if tape.y.shape[0] > 0 and not write_tape(s, w, tape, 2 * step + stage, y):
                y[:], integrals[:], w.V[:], w.travelled[0] = before, integrals_before, V_before, np.inf
                return step, TAPE_FULL, solves
            supply(s, w, signals[step, stage], powers)
            dt = a if stage == 1 else h - a
            for i in range(integrals.size):
                integrals[i] += dt * powers[i]
            for i in range(y.size):
                value = y[i] + dt * w.k[i]
                y[i] = value if abs(value) > TINY else 0.0
            w.travelled[0] += dt * speed
        if status == CONVERGED:
            status = gone(s, w)
            if status == CONVERGED and not np.isfinite(y.sum()):
                status = NOT_FINITE
        if status != CONVERGED:
            y[:], integrals[:], w.V[:], w.travelled[0] = before, integrals_before, V_before, np.inf
            return step, status, solves
        if keep[step]:
            ys[row] = y
            record(s, w, integrals, moments, forces[row], extras[row])
            row += 1
    return len(signals), CONVERGED, solves
