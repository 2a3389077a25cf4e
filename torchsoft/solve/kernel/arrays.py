"""The arrays that the kernels work on: what a rig is made of, what it follows, and the tape of a run.

A rig has coordinates (x, y, theta) of its bodies, three each, and last those of the ground, which are zero. A coordinate is
free (a component of the state) or follows a signal. "At" in a name is a position in the vector p of all law parameters,
"start" one in another array. Nodes are the surface nodes of all pads, points the contact points of all contacts.
"""

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

INPUTS, OUTPUTS = 9, 7
"""A contact law's inputs (w, omega, d, theta, s*, weight, a h) and outputs (f, s', F_N, F_T, power of dashpots, of slip)."""


class Bodies(NamedTuple):
    """free (coordinates,): number among the free ones, or -1; signal (coordinates,): the one followed, or -1; coordinate,
    mass_at, weight (free,): coordinate, position of its mass in p, 1 where gravity pulls; gravity_at; y_start of q and V."""

    free: Index
    signal: Index
    coordinate: Index
    mass_at: Index
    weight: Array
    gravity_at: int
    q_start: int
    V_start: int


class Actuators(NamedTuple):
    """Per actuator: law addresses, its parameters' ends in p, coordinate pushed, signal fed forward (-1: none), the ends of its
    signals in setpoint and of its coordinates in measured."""

    linearise: Index
    pullback: Index
    p_start: Index
    pushed: Index
    feed_forward: Index
    setpoint_start: Index
    setpoint: Index
    measured_start: Index
    measured: Index


class Pads(NamedTuple):
    """Per pad: base (its first coordinate), node_start, contact_start, y_start of its displacements' states, v_start of its
    velocities (-1: massless), chain_at of its branches' fractions and then times in p, branches, C_start in C, reach: the
    largest displacement per force; column, columns: free coordinates that its contacts involve, and their number.

    C holds the surface mobilities (2 nodes, 2 nodes) one after the other: massless pads' compliance, inertial pads' mobility.
    """

    base: Index
    node_start: Index
    contact_start: Index
    y_start: Index
    v_start: Index
    chain_at: Index
    branches: Index
    C_start: Index
    C: Array
    dC: Array
    reach: Array
    column: Index
    columns: Index


class Inertia(NamedTuple):
    """Inertial pads, dof by dof from dof_start [pad] on: X (dofs, 2) arms, M, the sparse rows of K_lambda and K_mu per
    depth and
    modulus (dofs, 18), with their columns, and D, the rates per velocity of the base. surface: dof of every surface dof; factor
    (., band): the banded Cholesky factor of M/(a h) + (tau + a h) K; B (pads, 2, 2): the base's reaction per velocity.

    material_at (pads,): position of depth lambda, depth mu, tau, rho depth in p.
    """

    dof_start: Index
    surface: Index
    factor: Array
    band: Index
    X: Array
    area: Array
    K_column: Index
    K_lambda: Array
    K_mu: Array
    D: Array
    B: Array
    material_at: Index


class Contacts(NamedTuple):
    """Per contact: pad, body (first coordinate), law addresses, p_start of its parameters, point_start, size of the body,
    limits (x from, x to, y from, y to) of the body's centre in the base's frame."""

    pad: Index
    body: Index
    distance: Index
    linearise: Index
    pullback: Index
    free: Index
    free_linearise: Index
    free_pullback: Index
    p_start: Index
    point_start: Index
    size: Array
    limits: Array


class Points(NamedTuple):
    """Per contact point: undeformed place in the base's frame, weight, two surface nodes and their shape functions
    there; y_start
    of the stretches."""

    X: Array
    weight: Array
    node: Index
    N: Array
    y_start: int


PARTS = {"body": Bodies, "act": Actuators, "pad": Pads, "inertia": Inertia, "contact": Contacts, "point": Points}

System: Any = namedtuple("System", [*(f"{part}_{name}" for part, kind in PARTS.items() for name in kind._fields), "p"])
"""Everything that stays while a run is on, flat: the fields of `PARTS` by part_field, and p, the vector of law
parameters. Flat,
because numba's compiling takes time for every array in a tuple that is taken out of another."""


def system(*parts: Any, p: Array) -> Any:
    """A `System` of one of each of `PARTS`, in their order."""
    return System(*(field for part in parts for field in part), p)


class Signals(NamedTuple):
    """The reference: per signal the first of its pieces (signals + 1,) and their number of control points; per piece its start
    and span [s] and its control points. address: of a function that gives all values and rates instead, or 0; room: scratch."""

    start: Index
    points: Index
    at: Array
    span: Array
    control: Array
    address: int
    room: Array


NO_SIGNALS = Signals(
    np.zeros(1, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros((0, 1)), 0, np.zeros(1)
)
"""What given steps follow: nothing."""


class Errors(NamedTuple):
    """Parts of the state whose error is judged together: first and last component, whether it is a rate, its absolute
    tolerance, its largest size so far; origin (size,): what sizes are counted from."""

    first: Index
    last: Index
    rate: Any
    atol: Array
    size: Array
    origin: Array


NO_ERRORS = Errors(
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, bool), np.zeros(0), np.zeros(0), np.zeros(0)
)
"""What given steps are judged by: nothing."""


class Tape(NamedTuple):
    """What the derivatives need of every stage: y* (., size), q and V of all coordinates, the number of touching points of
    every pad (., pads), their numbers (., cap), u, u' and f there (., cap, 6); of inertial pads u' of all dofs."""

    y: Array
    q: Array
    V: Array
    count: Index
    point: Index
    state: Array
    rate: Array


def empty_tape(s: Any, size: int, stages: int, cap: int) -> Tape:
    """Room for that many stages, with `cap` touching points in all."""
    coordinates, i = len(s.body_free), np.int64
    return Tape(
        np.zeros((stages, size)), np.zeros((stages, coordinates)), np.zeros((stages, coordinates)),
        np.zeros((stages, len(s.pad_base)), i), np.zeros((stages, cap), i), np.zeros((stages, cap, 6)),
        np.zeros((stages, int(s.inertia_dof_start[-1]))),
    )  # fmt: skip


def first_stages(tape: Tape, stages: int) -> Tape:
    """The beginning of a tape, of a run that ended early."""
    parts: Any = [part if len(part) == stages else part[:stages].copy() for part in tape]
    return Tape(*parts)
