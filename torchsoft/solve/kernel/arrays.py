"""The arrays that the kernels work on: what a rig is made of, scratch, and the tape of a run.

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
    """Per actuator: law addresses, its parameters' ends in p, coordinates measured and pushed, signals (-1: none)."""

    linearise: Index
    pullback: Index
    p_start: Index
    measured: Index
    pushed: Index
    setpoint: Index
    feed_forward: Index


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


class Work(NamedTuple):
    """Scratch. Per node (., 2): the force that has set in, zeta, and its free rate; displacement u*, rates (without
    contact, now, before and after a Newton step), forces by the law
    and by the linear relations (now, before, after). Per point: the law's inputs, outputs and Jacobian; of the touching ones
    (in the order of `active`) H, S (3, 8), G (6, 2), L (6, 8), see `interface`. window, active: numbers of points near and
    touching, pad by pad from its first point on, `windows` and `actives` many; low, high: nodes of the window.

    counts: touched nodes of every pad. A, P, Hc, Rf: one pad's share of Newton's system; X what Newton's elimination
    leaves, per surface dof. PB to effort_J: small arrays of Newton's iteration. k: rates of the flat
    state; load: generalised contact forces on all coordinates; full: u' of inertial pads;
    travelled: how far [m] anything moved since the last scan for near points, that scan's margin [m], and how many there were.
    """

    q: Array
    V: Array
    frame: Array
    zeta: Array
    zeta_rate: Array
    u: Array
    free: Array
    u_dot: Array
    u_dot_old: Array
    u_dot_new: Array
    F: Array
    F_linear: Array
    F_old: Array
    F_new: Array
    x: Array
    out: Array
    J: Array
    H: Array
    S: Array
    G: Array
    L: Array
    window: Index
    windows: Index
    active: Index
    actives: Index
    low: Index
    high: Index
    slot: Index
    touched: Index
    counts: Index
    A: Array
    P: Array
    PB: Array
    K: Array
    number: Index
    Hc: Array
    Rf: Array
    r: Array
    Rv: Array
    b: Array
    dV: Array
    V_old: Array
    phi: Array
    effort_x: Array
    effort: Array
    effort_J: Array
    X: Array
    k: Array
    load: Array
    full: Array
    travelled: Array


class Step(NamedTuple):
    """What one step leaves behind: its start (state, integrals, Newton's guesses V and u_dot, travelled), and of its two
    stages the rates K, the powers and bounds of the speeds; the pads' moments of the last one. at_row, scrap, guess_V, guess:
    scratch of the outputs before the step's end."""

    y: Array
    integrals: Array
    V: Array
    u_dot: Array
    travelled: Array
    K: Array
    powers: Array
    speed: Array
    moments: Array
    at_row: Array
    scrap: Array
    guess_V: Array
    guess: Array


def empty_step(s: Any, size: int, integrals: int) -> Step:
    """Room for one step of a rig whose running integrals are so many."""
    nodes, coordinates, z = int(s.pad_node_start[-1]), len(s.body_free), np.zeros
    return Step(
        z(size), z(integrals), z(coordinates), z((nodes, 2)), z(3), z((2, size)), z((2, integrals)), z(2),
        z(len(s.pad_base)), z(integrals), z(integrals), z(coordinates), z((nodes, 2)),
    )  # fmt: skip


class Signals(NamedTuple):
    """The reference: per signal the first of its pieces (signals + 1,) and their number of control points; per piece its start
    and span [s] and its control points. address: of a function that gives all values and rates instead, or 0."""

    start: Index
    points: Index
    at: Array
    span: Array
    control: Array
    address: int


NO_SIGNALS = Signals(np.zeros(1, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros((0, 1)), 0)
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


def scratch(s: Any, size: int, columns: int = 1) -> Work:
    """Scratch arrays for one run, with room for so many right-hand sides."""
    nodes, points, coordinates = int(s.pad_node_start[-1]), len(s.point_X), len(s.body_free)
    pads, contacts, free = len(s.pad_base), len(s.contact_pad), len(s.body_coordinate)
    widest = 2 * int(np.diff(s.pad_node_start).max(initial=0))
    z = lambda *shape: np.zeros(shape)
    i = lambda *shape: np.zeros(shape, np.int64)
    per_node = ("u", "free", "u_dot", "u_dot_old", "u_dot_new", "F", "F_linear", "F_old", "F_new")
    return Work(
        q=z(coordinates), V=z(coordinates), frame=z(contacts, 7), zeta=z(2 * nodes), zeta_rate=z(2 * nodes),
        **{name: z(nodes, 2) for name in per_node}, x=z(points, INPUTS), out=z(points, OUTPUTS), J=z(points, 3, 7),
        H=z(points, 3, 8), S=z(points, 3, 8), G=z(points, 6, 2), L=z(points, 6, 8), window=i(points), windows=i(pads),
        active=i(points), actives=i(pads), low=i(pads), high=i(pads), slot=i(nodes), touched=i(nodes), counts=i(pads),
        A=z(widest, widest), P=z(widest, widest), PB=z(2, widest), K=z(6, 8), number=i(6), r=z(free, 1),
        Rv=z(free, free), b=z(free, 1), dV=z(free), V_old=z(coordinates), phi=z(1), effort_x=z(5), effort=z(1),
        effort_J=z(1, 5), Hc=z(widest, free), Rf=z(free, widest), X=z(2 * nodes, columns + free), k=z(size),
        load=z(coordinates), full=z(int(s.inertia_dof_start[-1])), travelled=np.array([np.inf, 0.0, 0.0]),
    )  # fmt: skip


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
