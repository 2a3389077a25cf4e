"""The element of a pad's mesh, in plane strain: its size, its shape functions, its quadrature, and
its energy at small strains, of which the stiffness is the Hessian.

An element's inputs x are displacements u (dofs,), x and y node by node, then further fields v_b
like it, the rates of them all, and its constants, as `element_constants` orders them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Weighted = tuple[tuple[float, float, float], ...]
"""Places (xi, zeta) of the reference square, from -1 to 1 both ways, with their weights."""


@dataclass(frozen=True)
class Element:
    """An element of `nodes`, anticlockwise, of which the first `side` are those of one side.

    `functions` gives the shape functions (nodes,) at (xi, zeta) and their slopes (nodes, 2) there;
    changes of volume count at the places `dilatation`, changes of shape at `distortion`.
    """

    nodes: int
    side: int
    functions: Callable[[float, float], tuple[Array, Array]]
    dilatation: Weighted
    distortion: Weighted

    @property
    def dofs(self) -> int:
        """Displacements of one field."""
        return 2 * self.nodes

    @property
    def constants(self) -> int:
        """Constants: at every place the gradients of the shape functions, and an area."""
        return (self.dofs + 1) * len(self.dilatation + self.distortion)


CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
"""Corners of the reference square."""


def bilinear(xi: float, zeta: float) -> tuple[Array, Array]:
    """Shape functions (4,) of the corners, and their slopes (4, 2)."""
    across, along = 1 + CORNERS[:, 0] * xi, 1 + CORNERS[:, 1] * zeta
    return across * along / 4, np.stack((CORNERS[:, 0] * along, CORNERS[:, 1] * across), -1) / 4


GAUSS = tuple((a / np.sqrt(3), b / np.sqrt(3), 1.0) for a in (-1, 1) for b in (-1, 1))

QUADRILATERAL = Element(4, 2, bilinear, ((0.0, 0.0, 4.0),), GAUSS)
"""Changes of volume count at its centre, so that it does not lock where it is incompressible."""


def gradients(element: Element, nodes: Array, xi: float, zeta: float) -> tuple[Array, Array]:
    """Gradients (..., nodes, 2) [1/m] of the shape functions at a place of elements with `nodes`
    (..., nodes, 2) [m], and the determinant of the map (...) [m2]."""
    _, slopes = element.functions(xi, zeta)
    J = np.swapaxes(nodes, -1, -2) @ slopes  # d(x, y) / d(xi, zeta)
    determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
    cofactors = np.stack((J[..., 1, 1], -J[..., 0, 1], -J[..., 1, 0], J[..., 0, 0]), -1).reshape(
        J.shape
    )
    return slopes @ (cofactors / determinant[..., None, None]), determinant


def element_constants(element: Element, nodes: Array) -> Array:
    """Constants (elements, constants) of elements with `nodes` (elements, nodes, 2) [m]: gradients
    of the shape functions (dofs) and area of its share, at every place of `dilatation` and then of
    `distortion`."""
    parts = []
    for xi, zeta, weight in element.dilatation + element.distortion:
        gradient, determinant = gradients(element, nodes, xi, zeta)
        parts += [gradient.reshape(-1, element.dofs), weight * abs(determinant)[:, None]]
    return np.concatenate(parts, 1)


class Place(NamedTuple):
    """Areas of an element, and gradients there of displacements and of their rates, each as (xx,
    xy, yx, yy), xy that of x along y; with the places along the last axis."""

    area: Tensor
    gradient: tuple[Tensor, Tensor, Tensor, Tensor]
    rate: tuple[Tensor, Tensor, Tensor, Tensor]


Places = tuple[Place, Place]
"""Those where changes of volume count, and those where changes of shape do."""


def places(element: Element, x: Tensor) -> list[Places]:
    """Places of an element with the gradients of u, and with those of every v_b."""
    constants = x[..., -element.constants :].unflatten(-1, (-1, element.dofs + 1))
    gx, gy, area = constants[..., :-1:2], constants[..., 1:-1:2], constants[..., -1]

    def gradient(of: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        ux, uy = of[..., None, 0::2], of[..., None, 1::2]
        xx, xy = (gx * ux).sum(-1), (gy * ux).sum(-1)
        return xx, xy, (gx * uy).sum(-1), (gy * uy).sum(-1)

    moved, volumes = x[..., : -element.constants], len(element.dilatation)
    moved, fields = moved.unflatten(-1, (2, -1, element.dofs)), []
    for u, rate in zip(moved[..., 0, :, :].unbind(-2), moved[..., 1, :, :].unbind(-2)):
        of_u, of_rate = gradient(u), gradient(rate)

        def at(which: slice, of_u: Any = of_u, of_rate: Any = of_rate) -> Place:
            xx, xy, yx, yy = (one[..., which] for one in of_u)
            x, a, b, y = (one[..., which] for one in of_rate)
            return Place(area[..., which], (xx, xy, yx, yy), (x, a, b, y))

        fields.append((at(slice(volumes)), at(slice(volumes, None))))
    return fields


def linear(lame_lambda: Any, lame_mu: Any, volume: Place, shape: Place, kind: str) -> Tensor:
    """Energy per depth at small strains, or the same of their rates."""
    x, _, _, y = getattr(volume, kind)
    xx, xy, yx, yy = getattr(shape, kind)
    bulk = 0.5 * lame_lambda * volume.area * (x + y) ** 2
    shear = lame_mu * shape.area * (xx**2 + yy**2 + 0.5 * (xy + yx) ** 2)
    return bulk.sum(-1) + shear.sum(-1)


@torch.inference_mode(False)
def element_stiffness(element: Element, nodes: Array, lame_lambda: float, lame_mu: float) -> Array:
    """Stiffness per depth (elements, dofs, dofs) of elements with `nodes` (elements, nodes, 2) [m]:
    the forces under a unit displacement of every dof."""
    constants = torch.from_numpy(element_constants(element, nodes))
    with torch.enable_grad():
        u = torch.eye(element.dofs, dtype=torch.float64)[:, None].repeat(1, len(nodes), 1)
        x = torch.cat(
            (u.requires_grad_(), torch.zeros_like(u), constants.expand(len(u), -1, -1)), -1
        )
        energy = linear(lame_lambda, lame_mu, *places(element, x)[0], "gradient").sum()
        (forces,) = torch.autograd.grad(energy, u)
    return forces.movedim(0, -2).numpy()
