"""Arrays of the kernels: parts of a rig, its reference, and the tape of a run.

A rig has coordinates (x, y, theta) of its bodies, three each, and last those of the ground, which
are zero. A coordinate is free (a component of the state) or follows a signal. "At" in a name is a
position in the vector p of all law parameters, "start" one in another array. Nodes are the surface
nodes of all pads, points the contact points of all contacts, dofs those of all nodal pads.

Kernels call their tables alike: `rig` is a `System`, what they compute in is `work` (`Work`),
`along` (`Directions`), and `call` has the arguments of an entry.
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

CONVERGED, NEWTON_FAILED, TAPE_FULL, NOT_FINITE, REFUSED = range(5)
OFF_THE_PAD, LOST, CRUSHED, PASSED_THROUGH = range(5, 9)
"""Why a run ended; the last four: a body left the domain of a contact."""

INSTANT = 1e-13
"""Length a h [s] of the stage that gives the forces at one moment: nothing moves in it."""

TINY = 1e-60
"""Components of the state below this are set to zero, so that decaying ones do not become denormal
numbers."""

PASSED = 0.25
"""A step that tolerances choose moves no body by more than this part of its size over a pad that it
may touch: one that flies would else be through the pad between two steps."""

AXES = 2
"""Of the plane: components of a vector."""

SIDE = 2
"""Nodes of the side of an element, with which a contact point on it moves."""

PAIR = 6
"""Coordinates of a contact: of its body and of its pad's base. The law of relative motion has as
inputs these, their rates and the wrench, and as outputs the relative pose, its rates and the loads
on these coordinates."""

MOTION, WRENCH = 10, 3
"""A contact point's law has as inputs its place in the base's frame and the relative pose of the
body (5), their rates (5), its states s*, its weight and a h; as outputs its force on the pad with
the moment about the body's centre (3), s', F_N, F_T, and the powers of dashpots and of slip. All
but the powers are differentiated, by the motion and by s*."""

CONDENSED, NODAL = range(2)
"""Kinds of pads: condensed onto its surface, or with the displacements of all of its nodes."""

LANES = 4
"""Elements whose law is called at once."""


class Bodies(NamedTuple):
    """free (coordinates,): number among the free ones, or -1; signal (coordinates,): the one
    followed, or -1; coordinate, mass_at (free,): coordinate, position of its mass in p; y_start of
    q and V."""

    free: Index
    signal: Index
    coordinate: Index
    mass_at: Index
    q_start: int
    V_start: int


class Ports(NamedTuple):
    """What laws of sources read, one after the other: value and rate of every signal, positions of
    all coordinates, their velocities, and states of sources. Per port the component y of the state
    that it is, the free number of the coordinate whose position it is, and the row of the signals,
    value and rate of each, that it is or follows; or -1."""

    y: Index
    number: Index
    signal: Index


class Sources(NamedTuple):
    """Actuators and weights, each an effort on one coordinate: law addresses, its parameters' ends
    in p, coordinate pushed, power: its number among those that are integrated; the ends of its
    inputs, ports, a position before its velocity and its states last; how many states of its own
    its law has, and y_start of them. The law reads these and the length a h of the stage last, and
    gives the effort and then their rates."""

    linearise: Index
    push: Index
    pull: Index
    p_start: Index
    pushed: Index
    power: Index
    input_start: Index
    input: Index
    states: Index
    y_start: Index


class Pads(NamedTuple):
    """Per pad: kind, base (its first coordinate), node_start, point_start, y_start of its state;
    column, columns: free coordinates that its contacts involve, and their number."""

    kind: Index
    base: Index
    node_start: Index
    point_start: Index
    y_start: Index
    column: IndexMatrix
    columns: Index


class Backs(NamedTuple):
    """The boundary behind the face of every pad, in the base's frame: per pad the first of its
    corners (pads + 1,) and a box (x from, x to, y from, y to) around the undeformed pad; per corner
    its place, and whether the side to the next one is bonded and lies under the face."""

    start: Index
    box: Matrix
    X: Matrix
    bonded: Index


class Condensed(NamedTuple):
    """Per pad: chain_at of its branches' fractions and then times in p, branches, C_start in C,
    reach: the largest entry of C. C holds the compliances (2 nodes, 2 nodes) for E depth = 1 one
    after the other, dC their derivatives by nu; a nodal pad has none."""

    chain_at: Index
    branches: Index
    C_start: Index
    C: Array
    dC: Array
    reach: Array


class Nodal(NamedTuple):
    """Per pad: ends in the dofs and the elements, v_start of its velocities (-1: without inertia),
    density_at of rho depth in p, hold: strain up to which an element's derivatives are held while
    it changes, band: the largest difference between dofs of one element, its place in the banded
    matrices; law addresses of its elements, ends of their parameters in p. Per dof: X, place of its
    node (its own coordinate), and area. Per element: its dofs, -1 where it is bonded and for fields
    that its pad has not, and constants; their number is a multiple of `LANES`, the last without
    dofs. surface: dof of every surface dof. field: displacements of an element in one field; its
    law has as inputs those of as many fields as any pad of the rig has, their rates and the
    element's constants, of which the first are their gradients at the centre, and as outputs the
    forces on them and the power that it dissipates."""

    dof_start: Index
    element_start: Index
    v_start: Index
    density_at: Index
    hold: Array
    band: Index
    band_start: Index
    value: Index
    linearise: Index
    push: Index
    pull: Index
    p_first: Index
    p_last: Index
    X: Array
    area: Array
    dof: IndexMatrix
    constants: Matrix
    surface: Index
    field: int


class Contacts(NamedTuple):
    """Per contact: pad, free numbers of the coordinates of the body and of the pad's base (., 6) or
    -1, and those coordinates; states of each of its points, law addresses, p_start of its
    parameters, point_start, size of the body, its innermost point (x, y in the body's frame) with
    the depth there, limits (x from, x to, y from, y to) of the body's centre in the base's frame.
    relative, relative_linearise: addresses of the law of relative motion."""

    pad: Index
    number: IndexMatrix
    coordinate: IndexMatrix
    states: Index
    distance: Index
    value: Index
    linearise: Index
    push: Index
    pull: Index
    free_linearise: Index
    free_push: Index
    free_pull: Index
    stored: Index
    p_start: Index
    point_start: Index
    size: Array
    inner: Matrix
    limits: Matrix
    relative: int
    relative_linearise: int


class Points(NamedTuple):
    """Per contact point: its contact, undeformed place in the base's frame, weight, the surface
    nodes (points, `SIDE`) of the element's side that it is on and their shape functions there;
    y_start of its states."""

    contact: Index
    X: Matrix
    weight: Array
    node: IndexMatrix
    N: Matrix
    y_start: Index


PARTS = {
    "body": Bodies,
    "port": Ports,
    "source": Sources,
    "pad": Pads,
    "back": Backs,
    "condensed": Condensed,
    "nodal": Nodal,
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
    np.zeros(1, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros((0, 1)), 0,
    np.zeros(1),
)  # fmt: skip
"""No pieces."""


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


SCRATCH: dict[str, dict[str, str]] = {
    "Work": {  # of a stage
        "ports": "ports",  # with q and V
        "coordinates": "q V V_old load",
        # of every contact its bodies' motion and the wrench on its pad, their relative motion and
        # loads with derivatives, and those of the motion by velocities of the stage
        "contacts pair+pair+wrench": "pair",
        # places of the bodies' innermost points in the bases' frames, now and where a step began
        "contacts axes": "inner inner_before",
        "contacts pair+pair": "relative",
        "contacts pair+pair pair+pair+wrench": "by_pair",
        "contacts pair pair": "by_stage",
        "condensed": "zeta zeta_rate",  # of a chain
        # displacement u*, rates (without contact, now, before and after a Newton step), forces by
        # the law and by the linear relations (now, before, after)
        "nodes axes": "u free u_dot u_dot_old F F_linear F_old F_new",
        "nodes2": "u_dot_new",
        "points inputs": "x",  # the law's inputs, outputs and Jacobian by rows
        "points outputs": "out",
        "points jacobian": "J",
        # derivatives by (displacement (2), coordinates (6)): by rates of the stage and by positions
        "points rows axes+pair": "H S",
        # numbers of points near and touching, from every pad's first point on
        "int points": "window active",
        # numbers of those, nodes of the window, numbers of touched nodes
        "int pads": "windows actives low high counts held_count",
        # of nodal pads: power [W], and the a h that the held factor is of, or 0
        "pads": "power held",
        "int nodes": "slot touched held_touched",
        "widest widest": "A P",  # one pad's share of Newton's system
        "axes widest": "PB",
        "pair axes+pair": "K",
        "widest free": "Hc",
        "free widest": "Rf",
        "free 1": "r r_before b",
        "free free": "Rv Rv_before",
        "free": "dV",
        "nodes2 columns+free": "X",  # left by Newton's elimination
        "1": "phi",
        "reads": "effort_x",
        "efforts": "effort",  # of a source, with the rates of its states
        "effort_jacobian": "effort_J",
        "free_inputs": "decay_x",
        "free_outputs": "decay",
        "square": "decay_J",
        "inputs": "probe",
        # way [m] since the last scan for near points, that scan's margin [m], number of scans
        "3": "travelled",
        # of nodal pads: rates (now, before, without contact, after a Newton step), internal forces
        # with their sizes, loads of a solve
        "dofs": "rate rate_old rate_free rate_new internal noise load_dof",
        # rates per velocity of the base, and its reaction per force
        "dofs 2": "D D_left",
        "pads 2 2": "B",  # the base's reaction per velocity
        "banded": "band",
        "solves": "solves",
        # of every group of elements: inputs of its law, and held its derivatives with the
        # displacements and rates that they are of
        "groups element_inputs lanes": "element_x",
        "groups corners 2corners lanes": "element_J",
        "groups 2corners lanes": "element_at",
        "corners+1 lanes": "element",
        # of every nodal pad held: its dofs' rates per unit force on the touched nodes, row by row
        "responses": "responses",
        "state": "k",
    },
    # what one step leaves: its start with Newton's guesses; rates, powers, bounds of the speeds of
    # its stages
    "Step": {
        "state": "y",
        "integrals": "integrals at_row scrap",
        "coordinates": "V guess_V",
        "nodes 2": "u_dot guess",
        "dofs": "rate guess_rate",
        "3": "travelled",
        "2 state": "K",
        "2 integrals": "powers",
        "2": "speed",
        "pads 3": "wrenches",
    },
    # derivatives in so many directions (columns), or cotangents (one column)
    "Directions": {
        "ports columns": "ports",  # with q and V
        "coordinates columns": "q V",
        "free columns": "r dV",  # of the bodies' equations and their velocities
        # of nodes: displacements u*, rates before the change of forces, of touched ones after it
        "nodes axes columns": "u rate touched_rate",
        "dofs columns": "free rate_of",  # the same of nodal pads' rates
        "axes columns": "base_rate",
        "points rows columns": "out",  # of a law's outputs
        "columns axes+pair": "at_point",
        "rows columns": "effort",
        "recorded columns": "recorded",  # as `recorded_size` orders it
        "state columns": "start first end",
        # of laws: a direction of the parameters, and outputs along it, or weights of them
        "parameters": "direction",
        "outputs": "change",
        "corners+1 lanes": "element",
        "int pads 2": "span",  # dofs of every pad that count
        "widest": "zeta z_dot by_u by_rate",
        "widest columns": "dzeta dz_dot",
        "2 axes": "reaction",
        "free free": "matrix",
    },
    # of every stage y*, q, V, the touching points of every pad, their numbers with u and u',
    # nodal pads' u'
    "Tape": {
        "stages state": "y",
        "stages coordinates": "q V",
        "int stages pads": "count",
        "int stages cap": "point",
        "stages cap 4": "state",
        "stages dofs": "rate",
    },
}
"""Arrays that the kernels write to, by name and shape: they allocate nothing."""

DIMENSIONS = (Array, Matrix, Cube, Hypercube), (Index, IndexMatrix)


def declared(kind: str) -> Any:
    """The table of one of `SCRATCH`."""
    fields = []
    for shape, names in SCRATCH[kind].items():
        hints = DIMENSIONS[shape.startswith("int ")]
        hint = hints[len(shape.removeprefix("int ").split()) - 1]
        fields += [(name, hint) for name in names.split()]
    return table(NamedTuple(kind, fields))


KINDS: dict[str, Any] = {kind: declared(kind) for kind in SCRATCH}
Work, Step, Directions, Tape = KINDS.values()


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
    orders them), the rates of nodal pads' dofs to rate, its energy to stored; tape has one row an
    output, or none, each a stage of no length there, whose y it shares.
    """

    step: Index
    part: Array
    signals: Cube
    y: Matrix
    integrals: Matrix
    recorded: Matrix
    rate: Matrix
    stored: Array
    tape: Annotated[Any, Tape]


@table
class Run(NamedTuple):
    """Arguments of `run`, explained in its docstring."""

    rig: Annotated[Any, System]
    work: Annotated[Any, Work]
    taken: Annotated[Any, Step]
    followed: Signals
    errors: Errors
    limits: Limits
    start: Limits
    out: Outputs
    tape: Annotated[Any, Tape]
    given: int
    begin: int
    y: Array
    k: Array
    clock: Array
    stops: Array
    t_out: Array
    rtol: float
    longest: float
    shortest: float
    integrals: Array
    starts: Array
    h: Array
    signals: Hypercube
    counts: Index


@table
class Backward(NamedTuple):
    """Arguments of `backward`."""

    rig: Annotated[Any, System]
    work: Annotated[Any, Work]
    along: Annotated[Any, Directions]
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
    y_bar: Matrix
    p_bar: Matrix
    signals_bar: Cube
    failed: Index


@table
class Forward(NamedTuple):
    """Arguments of `forward`."""

    rig: Annotated[Any, System]
    work: Annotated[Any, Work]
    along: Annotated[Any, Directions]
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
    dsignals: Cube
    dys: Cube
    dsums: Cube


def recorded_size(rig: Any) -> int:
    """Number of forces of one output: (F_N, F_T) of every point, force and moment of every pad,
    loads on all coordinates, in this order."""
    return 2 * len(rig.point_X) + 3 * len(rig.pad_base) + len(rig.body_free)


def scratch(kind: str, rig: Any, state: int, **sizes: int) -> Any:
    """Zeros for one of `SCRATCH`, of a rig whose state has so many components; `sizes` are those
    that it does not decide."""
    states, nodes = int(rig.contact_states.max(initial=1)), int(rig.pad_node_start[-1])
    reads = 1 + int(np.diff(rig.source_input_start).max(initial=1))
    efforts = 1 + int(rig.source_states.max(initial=0))
    dofs, band = np.diff(rig.nodal_dof_start), 2 * rig.nodal_band + 1
    widest, corners = 2 * int(np.diff(rig.pad_node_start).max(initial=0)), rig.nodal_dof.shape[1]
    sizes |= {
        "state": state, "coordinates": len(rig.body_free), "free": len(rig.body_coordinate),
        "contacts": len(rig.contact_pad), "points": len(rig.point_X), "pads": len(rig.pad_base),
        "nodes": nodes, "nodes2": 2 * nodes, "condensed": 2 * nodes, "widest": widest,
        "reads": reads, "efforts": efforts, "effort_jacobian": reads * efforts,
        "ports": len(rig.port_y), "axes": AXES, "pair": PAIR, "wrench": WRENCH,
        "rows": max(WRENCH + states + AXES, efforts),
        "outputs": max(WRENCH + states + 4, efforts),
        "inputs": MOTION + states + 2, "jacobian": (WRENCH + states + 2) * (MOTION + states),
        "free_inputs": states + 2, "free_outputs": states + 2, "square": states**2,
        "lanes": LANES, "groups": int(rig.nodal_element_start[-1]) // LANES,
        "dofs": int(rig.nodal_dof_start[-1]), "banded": int((dofs * band).sum()),
        "corners": corners, "2corners": 2 * corners,
        "element_inputs": 2 * corners + rig.nodal_constants.shape[1], "parameters": len(rig.p),
        "recorded": recorded_size(rig),
    }  # fmt: skip
    sizes["responses"] = sizes["dofs"] * (widest + 2)
    sizes["solves"] = int(dofs.max(initial=0)) * max(widest + 3, sizes.get("columns", 1))
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
    if kind == "Work":
        constants = rig.nodal_constants
        grouped = constants.reshape(sizes["groups"], LANES, constants.shape[1])
        made["element_x"][:, 2 * corners :] = grouped.swapaxes(1, 2)
    if "ports" in made:
        count, end = sizes["coordinates"], sizes["ports"] - int(rig.source_states.sum())
        made["V"] = made["ports"][end - count : end]
        made["q"] = made["ports"][end - 2 * count : end - count]
    return KINDS[kind](**made)
