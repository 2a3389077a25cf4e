"""Theory of steady rolling on a viscoelastic layer, by small deformations: independent of the engine but for the material's
complex modulus and chain.

In the frame of a body that moves at v every field is a function of xi = x - v t, so that a wave exp(i k xi) of the tractions
is felt by the rubber at the angular frequency -k v. With one Poisson's ratio for all times the layer's surface then gives way
by C(k) E / E*(-k v), C(k) its elastic compliance. Contact springs k_n, k_t per area stand between layer and body, as in the
contact law; points stick. The resistance is what the lateral offset of the pressure's centre asks for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import expm
from scipy.optimize import brentq

from torchsoft.physics.material import Material
from torchsoft.physics.mesh import Array

DEEP = 12.0
"""k h above which a layer of height h is a half-plane, to 1e-9."""

CELLS = 8192
"""Cells of the periodic surface; many more than the contact and its wake need."""

WAYS, SETTLED = 60, 20
"""Changes of the set of touching cells at the most; and after how many a cell at either edge may still come and go."""


@dataclass(frozen=True)
class Rolling:
    """A disc of `radius` [m] on a layer of `height` and `depth` [m], with contact springs K_n, K_t [N/m2], per length along
    the layer and penetration."""

    radius: float
    height: float
    depth: float
    K_n: float
    K_t: float


@dataclass(frozen=True)
class Steady:
    """Resistance over load [1], depth of the disc in the undeformed surface [m], where the contact ends in front and behind
    [m], and cells xi [m] with the forces p, q [N/m] per length on them (cells,)."""

    coefficient: float
    depth: float
    front: float
    behind: float
    xi: Array
    p: Array
    q: Array


def layer_compliance(k: Array, height: float, nu: float) -> Array:
    """Surface displacement over traction (n, 2, 2) [m/Pa] of a layer with E = 1 Pa in plane strain, bonded at its base, for
    waves exp(i k x): the exact solution through the height.

    The state (u_x, u_y, sigma_xy, sigma_yy) obeys d/dy state = A(k) state, with u = 0 at the base.
    """
    mu, lame = 1 / (2 * (1 + nu)), nu / ((1 + nu) * (1 - 2 * nu))
    M = lame + 2 * mu
    out = np.empty((len(k), 2, 2), complex)
    deep = abs(k * height) > DEEP
    i = 1j * k[~deep]
    zero = np.zeros_like(i)
    A = np.array([
        [zero, -i, zero + 1 / mu, zero],
        [-lame * i / M, zero, zero, zero + 1 / M],
        [-i * i * (M - lame**2 / M), zero, zero, -lame * i / M],
        [zero, zero, -i, zero],
    ]).transpose(2, 0, 1)  # fmt: skip
    through = expm(A * height)
    out[~deep] = through[:, :2, 2:] @ np.linalg.inv(through[:, 2:, 2:])
    size, side = 1 / (2 * mu * abs(k[deep])), 1j * np.sign(k[deep]) * (1 - 2 * nu)
    own = 2 * (1 - nu) + 0 * side
    out[deep] = np.array([[own, -side], [side, own]]).transpose(2, 0, 1) * size[:, None, None]
    return out


def complex_modulus(material: Material, omega: Array) -> Array:
    """E* [Pa] at omega (n,) [rad/s]."""
    return material.complex_modulus(torch.from_numpy(omega)).detach().numpy()


def moving_contact(at: Rolling, material: Material, load: float, v: float) -> Steady:
    """Steady rolling at v [m/s] under a load [N], on cells of constant traction.

    Touching cells: p / K_n + (C_yy p - C_yx q) = d - (R - sqrt(R^2 - xi^2)), and, for points that stick from the front on,
    q / K_t + (C_xx q - C_xy p) = c_0 - c xi, with d, c_0 and the creep c from the load, no stretch in front, and no moment on
    the disc. Raises `RuntimeError` where the contact is not found.
    """
    cell = min(5e-3 * at.radius, at.height / 20)
    k: Array = 2 * np.pi * np.fft.fftfreq(CELLS, cell).astype(np.float64)
    modulus = complex_modulus(material, -k * v)[:, None, None]
    waves = layer_compliance(k, at.height, material.nu.item()) / modulus
    kernel = np.fft.ifft(waves * np.sinc(0.5 * k * cell / np.pi)[:, None, None], axis=0).real / at.depth
    half = round(0.45 * at.radius / cell)
    xi: Array = cell * np.arange(-half, half + 1, dtype=np.float64)
    G = kernel[np.subtract.outer(np.arange(len(xi)), np.arange(len(xi))) % CELLS]
    gap = at.radius - np.sqrt(at.radius**2 - xi**2)
    touching = gap < 0.02 * at.radius
    for change in range(WAYS):
        a = np.flatnonzero(touching)
        n, block = len(a), np.ix_(a, a)
        A, b = np.zeros((2 * n + 3, 2 * n + 3)), np.zeros(2 * n + 3)
        P, Q, (d, c, c_0) = slice(0, n), slice(n, 2 * n), range(2 * n, 2 * n + 3)
        A[P, P], A[P, Q], A[P, d], b[P] = np.eye(n) / at.K_n + G[block][..., 1, 1], -G[block][..., 1, 0], -1.0, -gap[a]
        A[Q, Q], A[Q, P] = np.eye(n) / at.K_t + G[block][..., 0, 0], -G[block][..., 0, 1]
        A[Q, c], A[Q, c_0] = xi[a], -1.0
        A[2 * n, P], b[2 * n] = cell, load
        A[2 * n + 1, Q] = cell
        A[2 * n + 2, 2 * n - 1] = 1.0
        solved = np.linalg.solve(A, b)
        p, q = np.zeros(len(xi)), np.zeros(len(xi))
        p[a], q[a] = solved[P], solved[Q]
        inside = solved[d] - gap + G[..., 1, 0] @ q - G[..., 1, 1] @ p
        now = np.where(touching, p > 0, inside > 0)
        if (now != touching).sum() <= (2 if change >= SETTLED else 0):
            resistance = float((p * xi).sum()) * cell / (at.radius * load)
            return Steady(resistance, float(solved[d]), float(xi[a[-1]]), -float(xi[a[0]]), xi, p, q)
        touching = now
    raise RuntimeError(f"the moving contact at {v:g} m/s and {load:g} N was not found in {WAYS} changes")


def foundation(at: Rolling, material: Material) -> tuple[float, Array, Array]:
    """A thin layer as a foundation in uniaxial strain, with the contact springs before it: pressure per held depth,
    k + sum of k_j exp(-t / t_j), as k, k_j (n,) [N/m3 per depth, so N/m2] and t_j (n,) [s].

    w = c_0 p + sum of x_i with tau_i x_i' + x_i = c_i p; with p eliminated x' = A x + (c / tau) w / c_0.
    """
    J, tau = (part.detach().numpy() for part in material.chain())
    nu = material.nu.item()
    M = material.E.item() * (1 - nu) / ((1 + nu) * (1 - 2 * nu))  # the constrained modulus
    c_0, c = 1 / at.K_n, J * at.height / (M * at.depth)
    A = -np.diag(1 / tau) - np.outer(c / tau, np.ones(len(c))) / c_0
    rates, V = (np.real(part) for part in np.linalg.eig(A))  # all decay
    settled = -np.linalg.solve(A, c / tau) / c_0
    strengths = V.sum(0) * np.linalg.solve(V, settled) / c_0
    return float(1 / (c_0 + c.sum())), strengths, -1 / rates


def winkler(at: Rolling, material: Material, load: float, v: float) -> tuple[float, float]:
    """Resistance over load [1] and the front's place a [m] of a disc on the foundation, from the pressure

    p(xi) = k (a^2 - xi^2) / 2R + sum of k_j / R (l_j (xi + l_j) - l_j (a + l_j) exp((xi - a) / l_j)), l_j = v t_j,

    which ends behind where it falls to zero.
    """
    k, strengths, times = foundation(at, material)
    length = v * times

    def pressure(a: float) -> tuple[Array, Array]:
        xi = np.linspace(a, -a, 4001)
        p = k * (a**2 - xi**2) / 2
        for k_j, l in zip(strengths, length):
            p = p + k_j * l * ((xi + l) - (a + l) * np.exp((xi - a) / l))
        ends = np.flatnonzero(p[1:] <= 0)
        p[ends[0] + 1 if len(ends) else len(p) :] = 0.0
        return xi[::-1], p[::-1] / at.radius

    def excess(a: float) -> float:
        xi, p = pressure(a)
        return float(np.trapezoid(p, xi)) - load

    a = float(brentq(excess, 1e-5 * at.radius, 0.9 * at.radius, rtol=1e-10))  # pyright: ignore[reportArgumentType]
    xi, p = pressure(a)
    return float(np.trapezoid(p * xi, xi)) / (at.radius * load), a


def peak(v: Sequence[float], coefficient: Sequence[float]) -> tuple[float, float] | None:
    """Speed and height of the largest coefficient, by a parabola through it and its neighbours over the logarithms; None
    where it is the first or the last."""
    x, y = np.log(v), np.log(coefficient)
    top = int(np.argmax(y))
    if top in (0, len(y) - 1):
        return None
    bend, slope, height = np.polyfit(x[top - 1 : top + 2] - x[top], y[top - 1 : top + 2], 2)
    return float(np.exp(x[top] - slope / (2 * bend))), float(np.exp(height - slope**2 / (4 * bend)))
