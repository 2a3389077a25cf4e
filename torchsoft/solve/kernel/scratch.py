"""Scratch: what the kernels write besides their results. None of them allocates anything."""

from typing import Any, NamedTuple

import numpy as np

from torchsoft.solve.kernel.arrays import INPUTS, OUTPUTS, Array, Index


class Work(NamedTuple):
    """Scratch. Per node (., 2): the force that has set in, zeta, and its free rate; displacement u*, rates (without
    contact, now, before and after a Newton step), forces by the law
    and by the linear relations (now, before, after). Per point: the law's inputs, outputs and Jacobian; of the touching ones
    (in the order of `active`) H, S (3, 8), G (6, 2), L (6, 8), see `interface`. window, active: numbers of points near and
    touching, pad by pad from its first point on, `windows` and `actives` many; low, high: nodes of the window.

    counts: touched nodes of every pad. A, P, Hc, Rf: one pad's share of Newton's system; X what Newton's elimination
    leaves, per surface dof. PB to effort_J, probe, decay: small arrays. inertial: (4, dofs of inertial pads). k: rates of the
    flat state; load: generalised contact forces on all coordinates; full: u' of inertial pads;
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
    probe: Array
    decay: Array
    inertial: Array
    X: Array
    k: Array
    load: Array
    full: Array
    travelled: Array


def scratch(s: Any, size: int, columns: int = 1) -> Work:
    """Scratch arrays for one run, with room for so many right-hand sides."""
    nodes, coordinates, free, dofs, widest = sizes(s)
    points, pads, contacts = len(s.point_X), len(s.pad_base), len(s.contact_pad)
    z = lambda *shape: np.zeros(shape)
    i = lambda *shape: np.zeros(shape, np.int64)
    inputs = 1 + 2 * int((np.diff(s.act_setpoint_start) + np.diff(s.act_measured_start)).max(initial=0))
    per_node = ("u", "free", "u_dot", "u_dot_old", "u_dot_new", "F", "F_linear", "F_old", "F_new")
    return Work(
        q=z(coordinates), V=z(coordinates), frame=z(contacts, 7), zeta=z(2 * nodes), zeta_rate=z(2 * nodes),
        **{name: z(nodes, 2) for name in per_node}, x=z(points, INPUTS), out=z(points, OUTPUTS), J=z(points, 3, 7),
        H=z(points, 3, 8), S=z(points, 3, 8), G=z(points, 6, 2), L=z(points, 6, 8), window=i(points), windows=i(pads),
        active=i(points), actives=i(pads), low=i(pads), high=i(pads), slot=i(nodes), touched=i(nodes), counts=i(pads),
        A=z(widest, widest), P=z(widest, widest), PB=z(2, widest), K=z(6, 8), number=i(6), r=z(free, 1),
        Rv=z(free, free), b=z(free, 1), dV=z(free), V_old=z(coordinates), phi=z(1), effort_x=z(inputs), effort=z(1),
        effort_J=z(1, inputs), probe=z(INPUTS), decay=z(3), inertial=z(4, dofs), Hc=z(widest, free), Rf=z(free, widest),
        X=z(2 * nodes, columns + free), k=z(size), load=z(coordinates), full=z(dofs), travelled=np.array([np.inf, 0.0, 0.0]),
    )  # fmt: skip


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


class Cotangents(NamedTuple):
    """Of the adjoint: surface (4, widest pad's dofs), dofs (4, dofs of inertial pads), pair (2, 2), matrix (free, free), nu
    (free, 1), V_bar (free,), cotangents full (dofs,) of u', rate and u (nodes, 2), q and V of all coordinates, of a law's
    outputs (3,) and of a point's bodies by (6,); inputs and Jacobian of a stretch that decays; state (3, size)."""

    surface: Array
    dofs: Array
    pair: Array
    matrix: Array
    nu: Array
    V_bar: Array
    full: Array
    rate: Array
    u: Array
    q: Array
    V: Array
    weights: Array
    by: Array
    decay_x: Array
    decay_J: Array
    state: Array


def cotangents(s: Any, size: int) -> Cotangents:
    """Room for the adjoint of a rig whose state has so many components."""
    nodes, coordinates, free, dofs, widest, z = *sizes(s), np.zeros
    return Cotangents(
        z((4, widest)), z((4, dofs)), z((2, 2)), z((free, free)), z((free, 1)), z(free), z(dofs), z((nodes, 2)),
        z((nodes, 2)), z(coordinates), z(coordinates), z(3), z(6), z(3), z((1, 1)), z((3, size)),
    )  # fmt: skip


class Tangents(NamedTuple):
    """Of the tangent in m directions: of a law its weights (3,), its gradient (parameters,) and its change (3, m); r and V
    (free, m); u and v (nodes, 2, m), free (dofs, m); span (pads, 2) of the dofs that count; of one pad zeta and its rate with
    their derivatives, own_rate (nodes, 2, m) and base_rate (2, m); of one point e (points, 3, m), known (2, m) and q (6, m);
    inputs and Jacobian of a stretch that decays; the state's before a step and after its first stage (size, m)."""

    weights: Array
    gradient: Array
    change: Array
    r: Array
    V: Array
    u: Array
    v: Array
    free: Array
    span: Index
    zeta: Array
    rate: Array
    dzeta: Array
    drate: Array
    own_rate: Array
    base_rate: Array
    e: Array
    known: Array
    q: Array
    decay_x: Array
    decay_J: Array
    before: Array
    first: Array


def tangents(s: Any, size: int, m: int) -> Tangents:
    """Room for the tangent in m directions of a rig whose state has so many components."""
    nodes, _, free, dofs, widest, z = *sizes(s), np.zeros
    return Tangents(
        z(3), z(len(s.p)), z((3, m)), z((free, m)), z((free, m)), z((nodes, 2, m)), z((nodes, 2, m)), z((dofs, m)),
        np.zeros((len(s.pad_base), 2), np.int64), z(widest), z(widest), z((widest, m)), z((widest, m)),
        z((widest // 2, 2, m)), z((2, m)), z((len(s.point_X), 3, m)), z((2, m)), z((6, m)), z(3), z((1, 1)), z((size, m)),
        z((size, m)),
    )  # fmt: skip


def sizes(s: Any) -> tuple[int, int, int, int, int]:
    """Numbers of surface nodes, coordinates, free ones, dofs of inertial pads, and surface dofs of the widest pad."""
    widest = 2 * int(np.diff(s.pad_node_start).max(initial=0))
    return int(s.pad_node_start[-1]), len(s.body_free), len(s.body_coordinate), int(s.inertia_dof_start[-1]), widest
