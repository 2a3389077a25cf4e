"""One pad inside the kernel: its arrays, its linear relations, and which of its nodes are near the object."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.kernels import compiled
from torchsoft.kernels.linear import solve_banded
from torchsoft.kernels.node import Array, body_distance


class PadArrays(NamedTuple):
    """A pad at one a h: node positions X (nodes, 2), surface node numbers, share, mobility P^T (2 surface, 2 nodes).

    D (2 nodes, 2) is the nodes' response to a bracket acceleration, B (2, 2) its reaction; M (2 nodes,) lumped masses;
    factor the banded Cholesky factor of M/(a h) + (tau + a h) K. The last four are empty or zero for massless pads.
    """

    X: Array
    surface: NDArray[np.int64]
    share: Array
    P: Array
    D: Array
    B: Array
    M: Array
    factor: Array
    moving_base: bool


class PadState(NamedTuple):
    """What moves in a pad: displacement u, velocity v (none if massless), elastic force K u, stretch s (surface,)."""

    u: Array
    v: Array
    Ku: Array
    s: Array


class PadWork(NamedTuple):
    """Scratch of one pad's stage: rates of `PadState`, forces, local Jacobians and Newton's dense system.

    `window` lists the surface nodes that can touch, `active` those that do. Per surface node: f is the law's force on it,
    f_linear the one that solves the linear relations, forces (F_N, F_T); G the Jacobian, d and w lever and velocity.
    """

    u_dot: Array
    v_dot: Array
    Ku_dot: Array
    s_dot: Array
    free: Array
    window: NDArray[np.int64]
    active: NDArray[np.int64]
    w: Array
    d: Array
    f: Array
    f_linear: Array
    f_old: Array
    f_new: Array
    v_old: Array
    v_new: Array
    G: Array
    system: Array
    rhs: Array
    forces: Array


def pad_work(pad: PadArrays) -> PadWork:
    """Scratch arrays for a pad."""
    nodes, surface = len(pad.X), len(pad.surface)
    z = lambda *shape: np.zeros(shape)
    index = np.full(surface, -1)
    rates = {"u_dot": z(2 * nodes), "v_dot": z(pad.M.size), "Ku_dot": z(2 * nodes), "s_dot": z(surface)}
    per_node = {
        name: z(surface, 2) for name in ("w", "d", "f", "f_linear", "f_old", "f_new", "v_old", "v_new", "forces")
    }
    system = {"G": z(surface, 2, 3), "system": z(2 * surface, 2 * surface), "rhs": z(2 * surface, 6)}
    return PadWork(**rates, **per_node, **system, free=z(2 * nodes), window=index, active=index.copy())


@compiled
def free_rates(pad: Any, state: Any, work: Any, v_Br: Array, ah: float, tau: float) -> None:
    """Nodal velocities relative to the base that the stage would have without contact and bracket acceleration."""
    if pad.M.size == 0:
        for i in range(state.u.size):
            work.free[i] = -state.u[i] / (tau + ah)
    else:
        for i in range(state.u.size):
            base = v_Br[i % 2] if pad.moving_base else 0.0
            work.free[i] = pad.M[i] * (state.v[i] - base) / ah - state.Ku[i]
        solve_banded(pad.factor, work.free)


@compiled
def lever(pad: Any, state: Any, work: Any, q: Array, V: Array, ah: float, i: int, out: Array) -> None:
    """d (out[0:2]) and w (out[2:4]) of surface node i at the end of the stage, from the trial rates in `work` and V."""
    n = pad.surface[i]
    for k in range(2):
        p = pad.X[n, k] + state.u[2 * n + k] + ah * work.u_dot[2 * n + k]
        out[2 + k] = V[k] - work.u_dot[2 * n + k]
        if pad.moving_base:
            p += q[3 + k] + ah * V[3 + k]
            out[2 + k] -= V[3 + k]
        out[k] = p - q[k] - ah * V[k]


@compiled
def near(pad: Any, state: Any, work: Any, q: Array, V: Array, ah: float, c: Any, margin: float, found: Any) -> int:
    """Surface nodes within `margin` [m] of touching at the trial state go to `found`; returns their number."""
    place = np.empty(4)
    cos, sin = np.cos(q[2] + ah * V[2]), np.sin(q[2] + ah * V[2])
    count = 0
    for i in range(pad.surface.size):
        lever(pad, state, work, q, V, ah, i, place)
        dx, dy = place[0], place[1]
        if body_distance(c.radius, cos * dx + sin * dy, cos * dy - sin * dx)[0] < margin:
            found[count] = i
            count += 1
    return count


@compiled
def full_rates(pad: Any, work: Any, count: int, V: Array, V_star: Array) -> None:
    """u' of every node from the accepted forces."""
    work.u_dot[:] = work.free
    if pad.moving_base and pad.M.size > 0:
        for i in range(work.u_dot.size):
            work.u_dot[i] -= pad.D[i, 0] * (V[3] - V_star[3]) + pad.D[i, 1] * (V[4] - V_star[4])
    for k in range(count):
        i = work.window[k]
        for r in range(2):
            f = work.f_linear[i, r]
            if f != 0.0:
                P = pad.P[2 * i + r]
                for row in range(work.u_dot.size):
                    work.u_dot[row] += P[row] * f
