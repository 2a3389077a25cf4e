"""Sources: actuators and weights, each an effort on one coordinate by what it reads and by states
of its own.
"""

from typing import Any

from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.invoke import call_linearise
from torchsoft.solve.kernel.linear import bounds, put
from torchsoft.solve.kernel.table import Array


@compiled
def read(rig: Any, work: Any, y: Array, signals: Array) -> None:
    """Put signals and states of sources where sources read them, beside positions and velocities,
    in work.ports."""
    put(signals, work.ports[: signals.size])
    for i in range(signals.size + 2 * work.q.size, work.ports.size):
        work.ports[i] = y[rig.port_y[i]]


@compiled
def effort(rig: Any, work: Any, i: int, a: float) -> float:
    """Effort [N or N.m] of source i at the end of a stage; work.effort receives it and the rates of
    its states, work.effort_x what it reads and a, work.effort_J derivatives by all but a, row by
    row. Needs `read`."""
    inputs, x = rig.source_input[bounds(rig.source_input_start, i)], work.effort_x
    for j in range(inputs.size):
        x[j] = work.ports[inputs[j]]
    x[inputs.size] = a
    p = rig.p[bounds(rig.source_p_start, i)]
    call_linearise(rig.source_linearise[i], x, p, work.effort, work.effort_J)
    return work.effort[0]


@compiled
def drive(rig: Any, work: Any, y: Array, signals: Array, a: float, r: Array, Rv: Array) -> None:
    """Efforts of the sources on the free coordinates, r (free, 1), and their derivative by the
    velocities of a stage of length a, Rv."""
    Rv[:], r[:] = 0.0, 0.0
    read(rig, work, y, signals)
    for i in range(rig.source_pushed.size):
        number = rig.body_free[rig.source_pushed[i]]
        if number < 0:
            continue
        r[number, 0] += effort(rig, work, i, a)  # (32), (34)
        inputs = rig.source_input[bounds(rig.source_input_start, i)]
        for j in range(inputs.size):
            towards = rig.port_number[inputs[j]]
            if towards >= 0:  # a position, and next its velocity
                Rv[number, towards] += a * work.effort_J[j] + work.effort_J[j + 1]


@compiled
def resist(rig: Any, work: Any, y: Array, a: float, r: Array, Rv: Array) -> None:
    """Less M V'."""
    for i in range(rig.body_coordinate.size):
        mass = rig.p[rig.body_mass_at[i]]
        r[i, 0] -= mass * (work.V[rig.body_coordinate[i]] - y[rig.body_V_start + i]) / a
        Rv[i, i] -= mass / a  # (17)


@compiled
def balance(rig: Any, work: Any, y: Array, signals: Array, a: float, r: Array, Rv: Array) -> None:
    """Efforts of the sources less M V', r (free, 1), and their derivative by the velocities, Rv."""
    drive(rig, work, y, signals, a, r, Rv)
    resist(rig, work, y, a, r, Rv)


@compiled
def keep_states(rig: Any, work: Any, a: float) -> None:
    """Rates of the sources' states into work.k; needs `read`."""
    for i in range(rig.source_pushed.size):
        first, states = rig.source_y_start[i], rig.source_states[i]
        if states > 0:
            effort(rig, work, i, a)
            put(work.effort[1 : 1 + states], work.k[first : first + states])


@compiled
def supply(rig: Any, work: Any, a: float, powers: Array, first: int) -> None:
    """Powers [W] of the sources and of the drives of bodies, from `first` on, and the sum of the
    positive ones, last; needs `read`."""
    powers[first:] = 0.0
    bodies = rig.body_free.size // 3 - 1
    drive = powers.size - 1 - bodies
    for b in range(bodies):
        for c in range(3 * b, 3 * b + 3):
            if rig.body_free[c] < 0:
                powers[drive + b] -= work.load[c] * work.V[c]
    for i in range(rig.source_pushed.size):
        c = rig.source_pushed[i]
        power = effort(rig, work, i, a) * work.V[c]
        powers[first + rig.source_power[i]] += power
        if rig.body_free[c] < 0:  # what pushes a driven coordinate is held by what drives it
            powers[drive + c // 3] -= power
    total = 0.0
    for i in range(first, powers.size - 1):
        total += max(powers[i], 0.0)
    powers[powers.size - 1] = total
