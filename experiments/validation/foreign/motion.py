"""A run: the disc at rest on the lower pad, then whatever the set-points ask for."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import root

from experiments.validation.foreign.numbers import Numbers
from experiments.validation.foreign.pad import Array, compliance
from experiments.validation.foreign.step import TAKEN_IN, march

COLUMNS = (
    "x_C",
    "y_C",
    "theta",
    "x_Br",
    "y_Br",
    "v_x",
    "v_y",
    "omega",
    "v_x_Br",
    "v_y_Br",
    "F_x",
    "F_y",
)


class Run(NamedTuple):
    """Channels (n,) by name at times t (n,) [s], the fastest slip since the row before [m/s], and
    how many nodes touch."""

    t: Array
    channels: dict[str, Array]
    slip: Array
    touching: Array


def lying(p: Numbers, C: Array, X: Array, share: Array) -> tuple[float, Array]:
    """Height of the disc [m] at rest on the lower pad, without friction, and the displacements
    (nodes, 2) [m] under it."""
    near = np.flatnonzero(np.abs(X[0, :, 0] - p.x_C0) < 0.3 * p.radius)
    dofs = (2 * near[:, None] + np.arange(2)).ravel()
    soft, weight = C[dofs][:, dofs], p.mass * p.gravity

    def forces(y: float, u: Array) -> Array:
        d = X[0, near] + u - (p.x_C0, y)
        far = np.linalg.norm(d, axis=-1)
        g = np.maximum(0.0, p.radius - far)
        return (share[near] * (p.K_n * g - p.adhesion * g / (g + TAKEN_IN)) / far)[:, None] * d

    def residual(z: Array) -> Array:
        u = z[1:].reshape(-1, 2)
        f = forces(z[0], u)
        return np.append((-weight - f[:, 1].sum()) * soft[0, 0], z[1:] - soft @ f.ravel())

    first = np.append(p.height + p.radius - 1e-4, np.zeros(len(dofs)))
    found = root(residual, first, tol=1e-15)
    if np.abs(residual(found.x)).max() > 1e-12:
        raise RuntimeError(f"the disc finds no rest: {found.message}")
    f = np.zeros((len(share), 2))
    f[near] = forces(found.x[0], found.x[1:].reshape(-1, 2))
    return float(found.x[0]), (C @ f.ravel()).reshape(-1, 2)


def pads(p: Numbers) -> tuple[Array, Array, Array]:
    """Of both pads, the lower one first: nodes of the surfaces (2, nodes, 2) [m] from where their
    bases are, compliances (2, 2 nodes, 2 nodes) [m/N], and the spacings (nodes,) that each node
    stands for."""
    length, height = p.length * p.longer, p.height * p.thicker
    C_L = compliance(p._replace(length=length, height=height))
    C_U = compliance(p._replace(length=length, height=height * p.thicker_U))
    mirror = np.tile([1.0, -1.0], len(C_L) // 2)
    C = np.stack((C_L, mirror[:, None] * C_U * mirror / p.upper))
    x = np.linspace(0.0, length, p.across + 1)
    lower, upper = np.full_like(x, p.height), np.full_like(x, -p.cm_height - p.height)
    X = np.stack((np.stack((x, lower), -1), np.stack((x - p.length / 2, upper), -1)))
    for k, tilt in enumerate((p.tilt_L, p.tilt_U)):
        if tilt != 0.0:
            middle = X[k].mean(0)
            R = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
            X[k] = middle + (X[k] - middle) @ R.T
            turn = np.kron(np.eye(len(x)), R)
            C[k] = turn @ C[k] @ turn.T
    share = np.full(len(x), length / p.across / p.spacing)
    share[[0, -1]] /= 2
    return X, C, share


def simulate(p: Numbers, t: Array, signals: Array, every: int = 1) -> Run:
    """A run on equal steps t (steps + 1,) [s], with rows every so many of them.

    signals (steps + 1, 3, 2) are value and rate of x_d, y_d and F_ff there. The bracket begins at
    x_d and y_d, the disc where it lies at rest without friction. Raises `RuntimeError` where a step
    cannot be solved.
    """
    X, C, share = pads(p)
    y, under = lying(p, C[0], X, share)
    q, v = np.array([p.x_C0, y, 0.0, *signals[0, :2, 0]]), np.zeros(5)
    u = np.stack((under, np.zeros_like(under)))
    rows, lost = march(
        p, float(t[1] - t[0]), C, X, share, q, v, u, np.ascontiguousarray(signals), every
    )
    if lost >= 0:
        raise RuntimeError(f"the step that ends at t = {t[lost]:.6g} s was not solved")
    return Run(t[::every], dict(zip(COLUMNS, rows[:, :12].T)), rows[:, 12], rows[:, 13])
