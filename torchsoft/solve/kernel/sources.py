"""Sources: actuators and weights, each an effort on one coordinate by what it reads and by states
of its own.
"""

from typing import Any

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.invoke import call_linearise
from torchsoft.solve.kernel.linear import bounds, put
from torchsoft.solve.kernel.table import Array


@compiled
def effort(s: Any, w: Any, i: int, y: Array, signals: Array, a: float) -> float:
    """Effort [N or N.m] of source i at the end of a stage from y; w.effort receives it and the
    rates of its states, w.effort_x the signals that it reads with their rates, the coordinates with
    theirs, its states and a, w.effort_J derivatives by all but a, row by row."""
    x, n = w.effort_x, 0
    for k in range(s.source_signal_start[i], s.source_signal_start[i + 1]):
        x[n], x[n + 1] = signals[s.source_signal[k], 0], signals[s.source_signal[k], 1]
        n += 2
    for k in range(s.source_coordinate_start[i], s.source_coordinate_start[i + 1]):
        x[n], x[n + 1] = w.q[s.source_coordinate[k]], w.V[s.source_coordinate[k]]
        n += 2
    for k in range(s.source_states[i]):
        x[n] = y[s.source_y_start[i] + k]
        n += 1
    x[n] = a
    own = s.p[bounds(s.source_p_start, i)]
    call_linearise(s.source_linearise[i], x, own, w.effort, w.effort_J)
    return w.effort[0]


@compiled
def first_coordinate(s: Any, i: int) -> int:
    """Place of the first coordinate among the inputs of source i."""
    return 2 * (s.source_signal_start[i + 1] - s.source_signal_start[i])


@compiled
def first_state(s: Any, i: int) -> int:
    """Place of the first state among the inputs of source i."""
    coordinates = s.source_coordinate_start[i + 1] - s.source_coordinate_start[i]
    return first_coordinate(s, i) + 2 * coordinates


@compiled
def balance(s: Any, w: Any, y: Array, signals: Array, a: float, r: Array, Rv: Array) -> None:
    """Efforts of the sources less M V' on the free coordinates, r (free, 1), and their derivative
    by the velocities of a stage of length a, Rv."""
    Rv[:], r[:] = 0.0, 0.0
    for i in range(s.body_coordinate.size):
        mass = s.p[s.body_mass_at[i]]
        r[i, 0] = -mass * (w.V[s.body_coordinate[i]] - y[s.body_V_start + i]) / a
        Rv[i, i] = -mass / a  # (17)
    for i in range(s.source_pushed.size):
        number = s.body_free[s.source_pushed[i]]
        if number < 0:
            continue
        r[number, 0] += effort(s, w, i, y, signals, a)  # (32), (34)
        n = first_coordinate(s, i)
        for k in range(s.source_coordinate_start[i], s.source_coordinate_start[i + 1]):
            towards = s.body_free[s.source_coordinate[k]]
            if towards >= 0:
                Rv[number, towards] += a * w.effort_J[n] + w.effort_J[n + 1]
            n += 2


@compiled
def remember(s: Any, w: Any, y: Array, signals: Array, a: float) -> None:
    """Rates of the sources' states into w.k."""
    for i in range(s.source_pushed.size):
        first, states = s.source_y_start[i], s.source_states[i]
        if states > 0:
            effort(s, w, i, y, signals, a)
            put(w.effort[1 : 1 + states], w.k[first : first + states])


@compiled
def supply(s: Any, w: Any, y: Array, signals: Array, a: float, powers: Array, first: int) -> None:
    """Powers [W] of the sources and of the drives of bodies, from `first` on, and the sum of the
    positive ones, last."""
    powers[first:] = 0.0
    bodies = s.body_free.size // 3 - 1
    drive = powers.size - 1 - bodies
    for b in range(bodies):
        for c in range(3 * b, 3 * b + 3):
            if s.body_free[c] < 0:
                powers[drive + b] -= w.load[c] * w.V[c]
    for i in range(s.source_pushed.size):
        c = s.source_pushed[i]
        power = effort(s, w, i, y, signals, a) * w.V[c]
        powers[first + s.source_power[i]] += power
        if s.body_free[c] < 0:  # what pushes a driven coordinate is held by what drives it
            powers[drive + c // 3] -= power
    total = 0.0
    for i in range(first, powers.size - 1):
        total += max(powers[i], 0.0)
    powers[powers.size - 1] = total
