"""Elements of nodal pads: bilinear quadrilaterals in plane strain, each an energy of the
displacements of its corners and a dissipation potential of their rates.

An element's inputs x are displacements u (8), rates u' (8), x and y corner by corner, and its
constants, as `element_constants` orders them. The force on a corner is the derivative of the energy
by its displacement plus that of the potential by its rate; the power that the element dissipates is
twice the potential.

The volume counts by its change at the centre, so that nearly incompressible elements do not lock.
At finite strain the energy of distortion is one of the deformation gradient F at the Gauss points,
that of dilatation one of J_0 = det F at the centre; mu (J - J_0)^2 / 3 is added (`WITHIN`), which
opposes changes of volume within the element that nothing else would: with it the limit of small
strains is the linear element.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.hyperelastic import Hyperelastic, power
from torchsoft.physics.material import Material
from torchsoft.physics.mesh.mesh import Array, gradients

GAUSS = [(a / np.sqrt(3), b / np.sqrt(3)) for a in (-1, 1) for b in (-1, 1)]
"""Places of the quadrature in the reference square."""

WITHIN = 1 / 3
"""Modulus against changes of volume within an element, over the shear modulus of small strains."""

CORNERS = 8
"""Displacements of an element."""

CONSTANTS = 9 * (1 + len(GAUSS))
"""Number of an element's constants."""


def element_constants(corners: Array) -> Array:
    """Constants (elements, 45) of elements with `corners` (elements, 4, 2) [m]: gradients of the
    shape functions (8) and area, at the centre of the whole element, then at every Gauss point of
    its share."""
    parts = []
    for xi, zeta in [(0.0, 0.0), *GAUSS]:
        _, gradient, determinant = gradients(corners, xi, zeta)
        share = 4.0 if not parts else 1.0
        parts += [gradient.reshape(-1, 8), share * abs(determinant)[:, None]]
    return np.concatenate(parts, 1)


class Place(NamedTuple):
    """An area of an element, and gradients there of the displacements and of their rates, each as
    (xx, xy, yx, yy), xy that of x along y; of the Gauss points with these along the last axis."""

    area: Tensor
    gradient: tuple[Tensor, Tensor, Tensor, Tensor]
    rate: tuple[Tensor, Tensor, Tensor, Tensor]


def places(x: Tensor) -> tuple[Place, Place]:
    """The centre, for the whole element, and the Gauss points."""
    u, rate = x[..., :8], x[..., 8:16]
    constants = x[..., 16:].unflatten(-1, (1 + len(GAUSS), 9))
    gx, gy, area = constants[..., 0:8:2], constants[..., 1:8:2], constants[..., 8]

    def gradient(of: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        ux, uy = of[..., None, 0::2], of[..., None, 1::2]
        xx, xy = (gx * ux).sum(-1), (gy * ux).sum(-1)
        return xx, xy, (gx * uy).sum(-1), (gy * uy).sum(-1)

    of_u, of_rate = gradient(u), gradient(rate)

    def at(which: int | slice) -> Place:
        xx, xy, yx, yy = (one[..., which] for one in of_u)
        x, a, b, y = (one[..., which] for one in of_rate)
        return Place(area[..., which], (xx, xy, yx, yy), (x, a, b, y))

    return at(0), at(slice(1, None))


def element_potentials(material: Material, factors: Tensor, x: Tensor) -> Tensor:
    """Energy [J] and dissipation potential [W] (..., 2) of an element in the state x (..., 61);
    `factors` (..., 4) are the pad's depth [m], retardation time tau [s], and the Lame moduli lambda
    and mu [Pa] of small strains."""
    parts = element_energy(material, factors, x), element_potential(material, factors, x)
    return torch.stack(parts, -1)


def element_energy(material: Material, factors: Tensor, x: Tensor) -> Tensor:
    """Energy (...) [J] of an element in the state x (..., 61)."""
    depth, _, lame_lambda, lame_mu = factors.unbind(-1)
    centre, gauss = places(x)
    if isinstance(material, Hyperelastic):
        return depth * finite_energy(material, lame_mu, centre, gauss)
    return depth * linear(lame_lambda, lame_mu, centre, gauss, "gradient")


def element_potential(material: Material, factors: Tensor, x: Tensor) -> Tensor:
    """Dissipation potential (...) [W] of an element in the state x (..., 61)."""
    depth, tau, lame_lambda, lame_mu = factors.unbind(-1)
    centre, gauss = places(x)
    if isinstance(material, Hyperelastic):
        bulk = lame_lambda + 2 / 3 * lame_mu
        return depth * tau * finite_potential(bulk, lame_mu, centre, gauss)
    return depth * tau * linear(lame_lambda, lame_mu, centre, gauss, "rate")


def linear(lame_lambda: Tensor, lame_mu: Tensor, centre: Place, gauss: Place, kind: str) -> Tensor:
    """Energy per depth at small strains, or the same of their rates."""
    x, _, _, y = getattr(centre, kind)
    xx, xy, yx, yy = getattr(gauss, kind)
    shear = lame_mu * gauss.area * (xx**2 + yy**2 + 0.5 * (xy + yx) ** 2)
    return 0.5 * lame_lambda * centre.area * (x + y) ** 2 + shear.sum(-1)


def finite_energy(material: Hyperelastic, shear: Tensor, centre: Place, gauss: Place) -> Tensor:
    """Energy per depth at finite strain."""
    (J_0, _), (J, _) = volume(centre), volume(gauss)
    xx, xy, yx, yy = gauss.gradient
    zero, one = torch.zeros_like(J), torch.ones_like(J)
    rows = (1 + xx, xy, zero), (yx, 1 + yy, zero), (zero, zero, one)
    W = material.distortion(torch.stack([torch.stack(row, -1) for row in rows], -2))
    W = W + WITHIN * shear * (J - J_0[..., None]) ** 2
    return centre.area * material.dilatation(J_0) + (gauss.area * W).sum(-1)


def finite_potential(bulk: Tensor, shear: Tensor, centre: Place, gauss: Place) -> Tensor:
    """Dissipation potential per depth and retardation time at finite strain: quadratic in the rates
    of J_0, of J - J_0, and of (C J^(-2/3) - 1) / 2, C = F^T F."""
    (_, J_0_rate), (J, J_rate) = volume(centre), volume(gauss)
    (xx, xy, yx, yy), G = gauss.gradient, gauss.rate
    F = 1 + xx, xy, yx, 1 + yy
    C = F[0] ** 2 + F[2] ** 2, F[1] ** 2 + F[3] ** 2, F[0] * F[1] + F[2] * F[3]
    half = (  # of the rate of C
        F[0] * G[0] + F[2] * G[2],
        F[1] * G[1] + F[3] * G[3],
        0.5 * (F[0] * G[1] + F[1] * G[0] + F[2] * G[3] + F[3] * G[2]),
    )
    isochoric, part = power(J, -2 / 3), J_rate / (3 * J)
    e_xx, e_yy, e_xy = (isochoric * (one - part * c) for one, c in zip(half, C))
    e_zz = -isochoric * part
    square = e_xx**2 + e_yy**2 + e_zz**2 + 2 * e_xy**2
    within = WITHIN * (J_rate - J_0_rate[..., None]) ** 2
    distortion = (gauss.area * shear * (square + within)).sum(-1)
    return 0.5 * bulk * centre.area * J_0_rate**2 + distortion


def volume(place: Place) -> tuple[Tensor, Tensor]:
    """J = det F and its rate."""
    (xx, xy, yx, yy), (a, b, c, d) = place.gradient, place.rate
    J = (1 + xx) * (1 + yy) - xy * yx
    return J, a * (1 + yy) + (1 + xx) * d - b * yx - xy * c
