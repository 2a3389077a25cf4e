"""Arrays of the kernels: parts of a rig, its reference, and the tape of a run.

A rig has coordinates (x, y, theta) of its bodies, three each, and last those of the ground, which
are zero. A coordinate is free (a component of the state) or follows a signal. "At" in a name is a
position in the vector p of all law parameters, "start" one in another array. Nodes are the surface
nodes of all pads, points the contact points of all contacts.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np

from torchsoft.solve.kernel.table import (
    Array,
    Cube,
    Hypercube,
    Index,
    IndexMatrix,
    Matrix,
    table,
)

GAMMA = 1.0 - 1.0 / np.sqrt(2.0)
MIX = (1.0 - GAMMA) / GAMMA

CONVERGED, NEWTON_FAILED, OFF_THE_PAD, LOST, TAPE_FULL, NOT_FINITE, REFUSED, OFF_THE_RUNG = range(8)
"""Why a run ended."""

INSTANT = 1e-13
"""Length a h [s] of the stage that gives the forces at one moment: nothing moves in it."""

PASSED = 0.25
"""A step that tolerances choose moves no body by more than this part of its size over a pad that it
may touch: one that flies would else be through the pad between two steps."""

INPUTS, OUTPUTS, STEPPED, FELT = 9, 7, 3, 5
"""A contact law's inputs (w, omega, d, theta, s*, weight, a h) and outputs (f, s', F_N, F_T, power
of dashpots, of slip); how many of the outputs a stage needs, and how many are differentiated."""


class Bodies(NamedTuple):
    """free (coordinates,): number among the free ones, or -1; signal (coordinates,): the one
    followed, or -1; coordinate, mass_at, weight (free,): coordinate, position of its mass in p, 1
    where gravity pulls; gravity_at; y_start of q and V."""

    free: Index
    signal: Index
    coordinate: Index
    mass_at: Index
    weight: Array
    gravity_at: int
    q_start: int
    V_start: int


class Actuators(NamedTuple):
    """Per actuator: law addresses, its parameters' ends in p, coordinate pushed, signal fed forward
    (-1: none), the ends of its signals in setpoint and of its coordinates in measured."""

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
    """Per pad: base (its first coordinate), node_start, point_start, y_start of its displacements'
    states, v_start of its velocities (-1: massless), chain_at of its branches' fractions and then
    times in p, branches, C_start in C, reach: the largest entry of C; column, columns:
    free coordinates that its contacts involve, and their number.

    C holds the surface mobilities (2 nodes, 2 nodes) one after the other: massless pads'
    compliance for E depth = 1, inertial pads' mobility.
    """

    base: Index
    node_start: Index
    point_start: Index
    y_start: Index
    v_start: Index
    chain_at: Index
    branches: Index
    C_start: Index
    C: Array
    dC: Array
    reach: Array
    column: IndexMatrix
    columns: Index


class Inertia(NamedTuple):
    """Inertial pads, dof by dof from dof_start [pad] on: X (dofs, 2) arms, M, the sparse rows of
    K_lambda and K_mu per depth and modulus (dofs, 18), with their columns, and D, the rates per
    velocity of the base. surface: dof of every surface dof; factor (., band): the banded Cholesky
    factor of M/(a h) + (tau + a h) K; B (pads, 2, 2): the base's reaction per velocity.

    material_at (pads,): position of depth lambda, depth mu, tau, rho depth in p.
    """

    dof_start: Index
    surface: Index
    factor: Matrix
    band: Index
    X: Array
    area: Array
    K_column: IndexMatrix
    K_lambda: Matrix
    K_mu: Matrix
    D: Matrix
    B: Cube
    material_at: Index


class Contacts(NamedTuple):
    """Per contact: pad, body (first coordinate), free numbers of the coordinates of the body and of
    the pad's base (., 6) or -1, and those coordinates; law addresses, p_start of its parameters,
    point_start, size of the body, limits (x from, x to, y from, y to) of the body's centre in the
    base's frame."""

    pad: Index
    body: Index
    number: IndexMatrix
    coordinate: IndexMatrix
    distance: Index
    linearise: Index
    pullback: Index
    free: Index
    free_linearise: Index
    free_pullback: Index
    p_start: Index
    point_start: Index
    size: Array
    limits: Matrix


class Points(NamedTuple):
    """Per contact point: its contact, undeformed place in the base's frame, weight, two surface
    nodes and their shape functions there; y_start of the stretches."""

    contact: Index
    X: Matrix
    weight: Array
    node: IndexMatrix
    N: Matrix
    y_start: int


PARTS = {
    "body": Bodies,
    "act": Actuators,
    "pad": Pads,
    "inertia": Inertia,
    "contact": Contacts,
    "point": Points,
}

System: Any = table(
    NamedTuple(
        "System",
        [
            (f"{part}_{name}", hint)
            for part, kind in PARTS.items()
            for name, hint in kind.__annotations__.items()
        ]
        + [("p", Array)],
    )
)
"""Everything that stays while a run is on, flat: the fields of `PARTS` by part_field, and p, the
vector of law parameters."""


def system(*parts: Any, p: Array) -> Any:
    """A `System` of one of each of `PARTS`, in their order."""
    return System(*(field for part in parts for field in part), p)


@table
class Signals(NamedTuple):
    """The reference: per signal the first of its pieces (signals + 1,) and their number of control
    points; per piece its start and span [s] and its control points. address: of a function that
    gives all values and rates instead, or 0; room: scratch."""

    start: Index
    points: Index
    at: Array
    span: Array
    control: Matrix
    address: int
    room: Array


NO_SIGNALS = Signals(
    np.zeros(1, np.int64),
    np.zeros(0, np.int64),
    np.zeros(0),
    np.zeros(0),
    np.zeros((0, 1)),
    0,
    np.zeros(1),
)
"""Reference of given steps: none."""


@table
class Errors(NamedTuple):
    """Parts of the state whose error is judged together: first and last component, 1 for a rate,
    its absolute tolerance, its largest size so far; origin (size,) of those sizes."""

    first: Index
    last: Index
    rate: Index
    atol: Array
    size: Array
    origin: Array


NO_ERRORS = Errors(
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
)
"""Tolerances of given steps: none."""


SCRATCH: dict[str, dict[str, str]] = {
    "Work": {  # of a stage
        "coordinates": "q V V_old load",
        "contacts 7": "frame",
        "dofs": "zeta zeta_rate u_dot_new",  # zeta: of a massless pad's chain
        # displacement u*, rates (without contact, now, before and after a Newton step), forces by
        # the law and by the linear relations (now, before, after)
        "nodes 2": "u free u_dot u_dot_old F F_linear F_old F_new",
        "points 9": "x",  # the law's inputs, outputs and Jacobian
        "points 7": "out",
        "points 5 7": "J",
        "points 5 8": "H S",  # of the touching points in the order of `active`, see `interface`
        "points 6 2": "G",
        "points 6 8": "L",
        # numbers of points near and touching, from every pad's first point on
        "int points": "window active",
        # numbers of those, nodes of the window, numbers of touched nodes
        "int pads": "windows actives low high counts",
        "int nodes": "slot touched",
        "widest widest": "A P",  # one pad's share of Newton's system
        "2 widest": "PB",
        "6 8": "K",
        "widest free": "Hc",
        "free widest": "Rf",
        "free 1": "r b",
        "free free": "Rv",
        "free": "dV",
        "dofs columns+free": "X",  # left by Newton's elimination
        "1": "phi effort",
        "inputs": "effort_x",
        "1 inputs": "effort_J",
        "9": "probe",
        # way [m] since the last scan for near points, that scan's margin [m], number of scans
        "3": "decay travelled",
        "4 inertial": "inertial",
        "inertial": "full",  # u' of inertial pads
        "state": "k",
    },
    # what one step leaves: its start with Newton's guesses; rates, powers, bounds of the speeds of
    # its stages
    "Step": {
        "state": "y",
        "integrals": "integrals at_row scrap",
        "coordinates": "V guess_V",
        "nodes 2": "u_dot guess",
        "3": "travelled",
        "2 state": "K",
        "2 integrals": "powers",
        "2": "speed",
        "pads 3": "wrenches",
    },
    "Cotangents": {  # of u', rate and u, q and V, of a law's outputs and a point's bodies (by)
        "4 widest": "surface",
        "4 inertial": "dofs",
        "2 2": "pair",
        "free free": "matrix",
        "free 1": "nu",
        "free": "V_bar",
        "inertial": "full",
        "nodes 2": "rate u",
        "coordinates": "q V load",  # of an output's loads, and of the pads' forces and moments
        "pads 3": "wrenches",
        "points 5": "out",
        "5": "weights",
        "3": "decay_x",
        "6": "by",
        "1 1": "decay_J",
        "4 state": "state",
    },
    "Tangents": {  # in so many directions (columns); span: dofs of every pad that count
        "5": "weights",
        "3": "decay_x",
        "parameters": "gradient",
        "3 columns": "change",
        "free columns": "r V",
        "nodes 2 columns": "u v own_rate",
        "inertial columns": "free",
        "int pads 2": "span",
        "widest": "zeta rate",
        "widest columns": "dzeta drate",
        "2 columns": "base_rate at_point",
        "points 5 columns": "e",
        "recorded columns": "recorded",  # as `recorded_size` orders it
        "8 columns": "moved",
        "1 1": "decay_J",
        "state columns": "before first",
    },
    # of every stage y*, q, V, the touching points of every pad, their numbers with u and u',
    # inertial pads' u'
    "Tape": {
        "stages state": "y",
        "stages coordinates": "q V",
        "int stages pads": "count",
        "int stages cap": "point",
        "stages cap 4": "state",
        "stages inertial": "rate",
    },
}
"""Arrays that the kernels write to, by name and shape: they allocate nothing."""

DIMENSIONS = (Array, Matrix, Cube), (Index, IndexMatrix)


def declared(kind: str) -> Any:
    """The table of one of `SCRATCH`."""
    fields = []
    for shape, names in SCRATCH[kind].items():
        hints = DIMENSIONS[shape.startswith("int ")]
        hint = hints[len(shape.removeprefix("int ").split()) - 1]
        fields += [(name, hint) for name in names.split()]
    return table(NamedTuple(kind, fields))


KINDS: dict[str, Any] = {kind: declared(kind) for kind in SCRATCH}
Work, Step, Cotangents, Tangents, Tape = KINDS.values()


@table
class Limits(NamedTuple):
    """Limits of Newton's iteration: tolerance [N], iterations, and distance [m] within which
    points take part."""

    tolerance: float
    max_iterations: int
    margin: float


@table
class Outputs(NamedTuple):
    """Outputs of a run: output i lies at the fraction out_part[i] of the step out_step[i], where
    the signals are signals[i].

    Its state goes to y, its integrals to integrals, its forces to recorded (as `recorded_size`
    orders them); tape has one row an output, or none, each a stage of no length there, whose y it
    shares.
    """

    step: Index
    part: Array
    signals: Cube
    y: Matrix
    integrals: Matrix
    recorded: Matrix
    tape: Annotated[Any, Tape]


@table
class Run(NamedTuple):
    """Arguments of `run`, explained in its docstring."""

    s: Annotated[Any, System]
    s0: Annotated[Any, System]
    w: Annotated[Any, Work]
    d: Annotated[Any, Step]
    f: Signals
    e: Errors
    limits: Limits
    out: Outputs
    tape: Annotated[Any, Tape]
    given: int
    y: Array
    k: Array
    clock: Array
    stops: Array
    t_out: Array
    row: int
    rung: float
    rtol: float
    longest: float
    shortest: float
    integrals: Array
    starts: Array
    h: Array
    signals: Hypercube
    counts: Index


@table
class Rates(NamedTuple):
    """Arguments of `rates`."""

    s: Annotated[Any, System]
    w: Annotated[Any, Work]
    f: Signals
    limits: Limits
    t: float
    y: Array
    signals: Cube
    powers: Array
    wrenches: Matrix
    out: Array
    converged: Index


@table
class Backward(NamedTuple):
    """Arguments of `backward`."""

    s: Annotated[Any, System]
    s0: Annotated[Any, System]
    w: Annotated[Any, Work]
    z: Annotated[Any, Cotangents]
    tape: Annotated[Any, Tape]
    h: Array
    signals: Cube
    out_step: Index
    out_part: Array
    out_tape: Annotated[Any, Tape]
    out_signals: Cube
    outputs_bar: Matrix
    recorded_bar: Matrix
    out_signals_bar: Cube
    y_bar: Array
    p_bar: Array
    signals_bar: Cube
    failed: Index


@table
class Forward(NamedTuple):
    """Arguments of `forward`."""

    s: Annotated[Any, System]
    s0: Annotated[Any, System]
    w: Annotated[Any, Work]
    z: Annotated[Any, Tangents]
    tape: Annotated[Any, Tape]
    h: Array
    signals: Cube
    out_step: Index
    out_part: Array
    out_tape: Annotated[Any, Tape]
    out_signals: Cube
    sum_start: Index
    sum_at: Index
    sum_weight: Array
    dy: Matrix
    dp: Matrix
    dys: Cube
    dsums: Cube


def recorded_size(s: Any) -> int:
    """Number of forces of one output: (F_N, F_T) of every point, force and moment of every pad,
    loads on all coordinates, in this order."""
    return 2 * len(s.point_X) + 3 * len(s.pad_base) + len(s.body_free)


def room(kind: str, s: Any, state: int, **sizes: int) -> Any:
    """Zeros for one of `SCRATCH`, of a rig whose state has so many components; `sizes` are those
    that it does not decide."""
    inputs = 1 + 2 * int(
        (np.diff(s.act_setpoint_start) + np.diff(s.act_measured_start)).max(initial=0)
    )
    sizes |= {
        "state": state, "coordinates": len(s.body_free), "free": len(s.body_coordinate),
        "contacts": len(s.contact_pad), "points": len(s.point_X), "pads": len(s.pad_base),
        "nodes": int(s.pad_node_start[-1]), "inputs": inputs, "dofs": 2 * int(s.pad_node_start[-1]),
        "widest": 2 * int(np.diff(s.pad_node_start).max(initial=0)),
        "inertial": int(s.inertia_dof_start[-1]), "parameters": len(s.p),
        "recorded": recorded_size(s),
    }  # fmt: skip
    made = {}
    for shape, names in SCRATCH[kind].items():
        whole = shape.startswith("int ")
        lengths = [
            sum(sizes[part] if part in sizes else int(part) for part in one.split("+"))
            for one in shape.removeprefix("int ").split()
        ]
        made |= {
            name: np.zeros(lengths, np.int64 if whole else np.float64) for name in names.split()
        }
    return KINDS[kind](**made)


def first_rows(tape: Any, rows: int) -> Any:
    """The beginning of a tape, of a run that ended early."""
    return Tape(*(part if len(part) == rows else part[:rows].copy() for part in tape))
