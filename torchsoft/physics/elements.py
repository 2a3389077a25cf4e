"""Elements of nodal pads: bilinear quadrilaterals in plane strain, each an energy of the
displacements of its corners and a dissipation potential of their rates.

Its inputs x (see `mesh/element`) have the v_b of every relaxing branch beside the displacements u.
The force on a corner is the derivative of the energy by its displacement plus that of the potential
by its rate; the power that the element dissipates is twice the potential.

The volume counts by its change at the centre, so that nearly incompressible elements do not lock.
At finite strain the energy of distortion is one of the deformation gradient F at the Gauss points,
that of dilatation one of J_0 = det F at the centre; mu (J - J_0)^2 / 3 is added (`WITHIN`), which
opposes changes of volume within the element that nothing else would: with it the limit of small
strains is the linear element.

A relaxing branch is a second network in the same pad, whose nodes, displaced by v_b, flow after
those at u. Of F = 1 + grad u only F F_b^-1, F_b = 1 + grad v_b, distorts its spring, and J - J_b
changes its volume: the energy is the material's, times the branch's modulus over the relaxed one,
at 1 + J - J_b. Its dashpot takes the deviator of the rate of deformation, the symmetric part of
F_b' F_b^-1, and J_b', with the moduli of small strains times tau_b: C_b = F_b^T F_b and J_b go to C
and J with the relaxation time tau_b at any strain. The network bears no load, and the forces on its
nodes are zero. At rest v_b = u; at small strains v_b' = (u - v_b) / tau_b, the linear pad's branch.
Turning u or v_b costs nothing, and what is dissipated is never negative.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchsoft.physics.hyperelastic import Hyperelastic, power
from torchsoft.physics.material import Material
from torchsoft.physics.mesh.element import QUADRILATERAL, Place, Places, linear, places

WITHIN = 1 / 3
"""Modulus against changes of volume within an element, over the shear modulus of small strains."""


def element_potentials(material: Material, factors: Tensor, x: Tensor) -> Tensor:
    """Energy [J] and dissipation potential [W] (..., 2) of an element in the state x (..., 16
    (branches + 1) + 45); `factors` (..., 4 + 2 branches) are the pad's depth [m], retardation time
    tau [s], and the Lame moduli lambda and mu [Pa] of small strains, then of every branch its
    modulus over the relaxed one and its relaxation time [s]."""
    parts = element_energy(material, factors, x), element_potential(material, factors, x)
    return torch.stack(parts, -1)


def element_energy(material: Material, factors: Tensor, x: Tensor) -> Tensor:
    """Energy (...) [J] of an element in the state x (..., inputs)."""
    depth, _, lame_lambda, lame_mu, *arms = factors.unbind(-1)
    displaced, *others = places(QUADRILATERAL, x)
    if not isinstance(material, Hyperelastic):
        return depth * linear(lame_lambda, lame_mu, *displaced, "gradient")
    W = finite_energy(material, lame_mu, *displaced)
    for share, flown in zip(arms[::2], others):
        W = W + share * finite_energy(material, lame_mu, *displaced, flown)
    return depth * W


def element_potential(material: Material, factors: Tensor, x: Tensor) -> Tensor:
    """Dissipation potential (...) [W] of an element in the state x (..., inputs)."""
    depth, tau, lame_lambda, lame_mu, *arms = factors.unbind(-1)
    displaced, *others = places(QUADRILATERAL, x)
    if not isinstance(material, Hyperelastic):
        return depth * tau * linear(lame_lambda, lame_mu, *displaced, "rate")
    bulk = lame_lambda + 2 / 3 * lame_mu
    total = tau * finite_potential(bulk, lame_mu, *displaced)
    for share, time, flown in zip(arms[::2], arms[1::2], others):
        total = total + share * time * flow_potential(bulk, lame_mu, *flown)
    return depth * total


def finite_energy(
    material: Hyperelastic, shear: Tensor, centre: Place, gauss: Place, flown: Places | None = None
) -> Tensor:
    """Energy per depth at finite strain, of a branch that has `flown` if given."""
    (J_0, _), (J, _), elastic = volume(centre), volume(gauss), gauss.gradient
    if flown is not None:
        (J_0_b, _), (J_b, _) = map(volume, flown)
        J_0, J = 1 + (J_0 - J_0_b), 1 + (J - J_b)
        elastic = over([one - other for one, other in zip(elastic, flown[1].gradient)], flown[1])
    xx, xy, yx, yy = elastic
    zero, one = torch.zeros_like(J), torch.ones_like(J)
    rows = (1 + xx, xy, zero), (yx, 1 + yy, zero), (zero, zero, one)
    W = material.distortion(torch.stack([torch.stack(row, -1) for row in rows], -2))
    W = W + WITHIN * shear * (J - J_0) ** 2
    return (centre.area * material.dilatation(J_0)).sum(-1) + (gauss.area * W).sum(-1)


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
    within = WITHIN * (J_rate - J_0_rate) ** 2
    distortion = (gauss.area * shear * (square + within)).sum(-1)
    return (0.5 * bulk * centre.area * J_0_rate**2).sum(-1) + distortion


def flow_potential(bulk: Tensor, shear: Tensor, centre: Place, gauss: Place) -> Tensor:
    """Dissipation potential of a branch's dashpot per depth and relaxation time: quadratic in the
    deviator of the rate of deformation, and in the rates of J_0 and of J - J_0."""
    (_, J_0_rate), (_, J_rate) = volume(centre), volume(gauss)
    x, a, b, y = over(gauss.rate, gauss)
    square = x**2 + y**2 + 0.5 * (a + b) ** 2 - (x + y) ** 2 / 3
    within = WITHIN * (J_rate - J_0_rate) ** 2
    distortion = (gauss.area * shear * (square + within)).sum(-1)
    return (0.5 * bulk * centre.area * J_0_rate**2).sum(-1) + distortion


def over(A: Sequence[Tensor], place: Place) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A F^-1 of A and F = 1 + gradient, as (xx, xy, yx, yy)."""
    (xx, xy, yx, yy), (J, _) = place.gradient, volume(place)
    a, b, c, d = A
    return (
        (a * (1 + yy) - b * yx) / J,
        (b * (1 + xx) - a * xy) / J,
        (c * (1 + yy) - d * yx) / J,
        (d * (1 + xx) - c * xy) / J,
    )


def volume(place: Place) -> tuple[Tensor, Tensor]:
    """J = det F and its rate."""
    (xx, xy, yx, yy), (a, b, c, d) = place.gradient, place.rate
    J = (1 + xx) * (1 + yy) - xy * yx
    return J, a * (1 + yy) + (1 + xx) * d - b * yx - xy * c
