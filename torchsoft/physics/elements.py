"""Elements of nodal pads: bilinear quadrilaterals in plane strain, each a law of the displacements
and rates of its corners.

The law's inputs x are displacements u (8), rates u' (8), x and y corner by corner, and the
element's constants, as `element_constants` orders them; its outputs the forces (8) of the corners
on the element and the power that it dissipates.
"""

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.mesh.mesh import Array, gradients

GAUSS = [(a / np.sqrt(3), b / np.sqrt(3)) for a in (-1, 1) for b in (-1, 1)]
"""Places of the quadrature in the reference square."""

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


def linear_forces(u: Tensor, constants: Tensor, lame_lambda: Tensor, lame_mu: Tensor) -> Tensor:
    """Forces (..., 8) [N/m] per depth of a linear element under u (..., 8) [m]; the Lame moduli
    [Pa]. The volume's part is that of the centre, so that the element does not lock."""
    ux, uy = u[..., 0::2], u[..., 1::2]

    def at(place: int) -> tuple[Tensor, Tensor, Tensor]:
        own = constants[..., 9 * place : 9 * place + 9]
        return own[..., 0:8:2], own[..., 1:8:2], own[..., 8:]

    gx, gy, area = at(0)
    pressure = lame_lambda * area * (gx * ux + gy * uy).sum(-1, keepdim=True)
    fx, fy = pressure * gx, pressure * gy
    for place in range(1, 1 + len(GAUSS)):
        gx, gy, area = at(place)
        weight = lame_mu * area
        xx = 2 * weight * (gx * ux).sum(-1, keepdim=True)
        yy = 2 * weight * (gy * uy).sum(-1, keepdim=True)
        xy = weight * (gy * ux + gx * uy).sum(-1, keepdim=True)
        fx, fy = fx + xx * gx + xy * gy, fy + yy * gy + xy * gx
    return torch.stack((fx, fy), -1).flatten(-2)


def linear_element(x: Tensor, moduli: Tensor) -> Tensor:
    """A linear Kelvin-Voigt element (..., 9): K (u + tau u') and tau u' K u' of x (..., 61), with
    moduli = (depth lambda, depth mu, tau)."""
    u, rate, constants = x[..., :8], x[..., 8:16], x[..., 16:]
    lame_lambda, lame_mu, tau = moduli.unbind(-1)
    viscous = tau * linear_forces(rate, constants, lame_lambda, lame_mu)
    forces = linear_forces(u, constants, lame_lambda, lame_mu) + viscous
    return torch.cat((forces, (rate * viscous).sum(-1, keepdim=True)), -1)
