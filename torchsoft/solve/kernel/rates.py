"""The right-hand side dy/dt at one moment, for integrators that ask for it."""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import entry
from torchsoft.solve.kernel.arrays import Array
from torchsoft.solve.kernel.linear import put
from torchsoft.solve.kernel.run import follow
from torchsoft.solve.kernel.stage import actuate
from torchsoft.solve.kernel.step import solve_near

AT_ONCE = 1e-18
"""Length a h [s] of the stage: no velocity changes in it by more than rounding does."""


@entry
def rates(
    s: Any, w: Any, f: Any, t: float, y: Array, tolerance: float, max_iterations: int, margin: float, signals: Array,
    powers: Array, moments: Array, out: Array,
) -> bool:  # fmt: skip
    """dy/dt of the state y at t [s] into out, of a rig whose pads are massless; False if Newton finds no forces there.

    A stage of no length gives all rates; those of the velocities are a difference over its length
    and come from the loads instead. signals (1, signals, 2) is scratch, as are powers and moments.
    """
    follow(f, t, t, signals)
    for i in range(s.body_coordinate.size):
        w.V[s.body_coordinate[i]] = y[s.body_V_start + i]
    w.travelled[0] = np.inf  # the last state was any other one
    converged, _, _ = solve_near(s, w, y, signals[0], AT_ONCE, tolerance, max_iterations, margin, powers, moments)
    put(w.k, out)
    for i in range(s.body_coordinate.size):
        c, mass = s.body_coordinate[i], s.p[s.body_mass_at[i]]
        load = w.load[c] - s.body_weight[i] * mass * s.p[s.body_gravity_at]
        for a in range(s.act_pushed.size):
            if s.act_pushed[a] == c:
                load += actuate(s, a, w.q, w.V, signals[0], w.effort_x, w.effort, w.effort_J)
        out[s.body_V_start + i] = load / mass  # (17), (18)
        out[s.body_q_start + i] = y[s.body_V_start + i]
    return converged
