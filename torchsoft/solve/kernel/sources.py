"""Sources: actuators and weights, each an effort on one coordinate by what it reads."""

from typing import Any

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.invoke import call_linearise
from torchsoft.solve.kernel.linear import bounds
from torchsoft.solve.kernel.table import Array


@compiled
def effort(s: Any, w: Any, i: int, signals: Array) -> float:
    """Effort [N or N.m] of source i; w.effort_x receives the signals that it reads with their
    rates, then the coordinates with theirs, and w.effort_J its derivatives by them."""
    x, n = w.effort_x, 0
    for k in range(s.source_signal_start[i], s.source_signal_start[i + 1]):
        x[n], x[n + 1] = signals[s.source_signal[k], 0], signals[s.source_signal[k], 1]
        n += 2
    for k in range(s.source_coordinate_start[i], s.source_coordinate_start[i + 1]):
        x[n], x[n + 1] = w.q[s.source_coordinate[k]], w.V[s.source_coordinate[k]]
        n += 2
    own = s.p[bounds(s.source_p_start, i)]
    call_linearise(s.source_linearise[i], x, own, w.effort, w.effort_J)
    return w.effort[0]


@compiled
def first_coordinate(s: Any, i: int) -> int:
    """Place of the first coordinate among the inputs of source i."""
    return 2 * (s.source_signal_start[i + 1] - s.source_signal_start[i])


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
        r[number, 0] += effort(s, w, i, signals)  # (32), (34)
        n = first_coordinate(s, i)
        for k in range(s.source_coordinate_start[i], s.source_coordinate_start[i + 1]):
            towards = s.body_free[s.source_coordinate[k]]
            if towards >= 0:
                Rv[number, towards] += a * w.effort_J[0, n] + w.effort_J[0, n + 1]
            n += 2


@compiled
def supply(s: Any, w: Any, signals: Array, powers: Array, first: int) -> None:
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
        power = effort(s, w, i, signals) * w.V[c]
        powers[first + s.source_power[i]] += power
        if s.body_free[c] < 0:  # what pushes a driven coordinate is held by what drives it
            powers[drive + c // 3] -= power
    total = 0.0
    for i in range(first, powers.size - 1):
        total += max(powers[i], 0.0)
    powers[powers.size - 1] = total
