"""What a rig asks of the shape of a rigid body."""

import logging
import math
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from torchsoft.physics.arguments import number


def parameter(value: float, trained: bool = True) -> nn.Parameter:
    """A scalar parameter in float64, whatever torch's default is. Raises `ValueError` for what is not a number."""
    return nn.Parameter(torch.tensor(number("a parameter", value), dtype=torch.float64), requires_grad=trained)


log = logging.getLogger("torchsoft")

NOTED = 1e-9
"""Distance [m] from the origin of given coordinates from which on a centre of mass is told."""


def note_centre(field: str, centre: Tensor) -> None:
    """Say where in the coordinates of `field` the centre of mass (2,) [m] is, which poses speak of, if not at their origin."""
    x, y = centre.tolist()
    if max(abs(x), abs(y)) > NOTED:
        log.warning(
            "the centre of mass is at (%.9g, %.9g) m of `%s`: the body's pose is that of this point", x, y, field
        )


class Shape(nn.Module):
    """What a rig asks of a rigid body's shape; lengths are numbers in m, about the centre of mass. A `round` one looks the same
    however it is turned, and its turning is left out of the law."""

    round: ClassVar[bool] = False

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance phi [m], shape (...), negative inside, and outward unit normal (..., 2), at x (..., 2) [m]."""
        raise NotImplementedError

    def prepared(self) -> "Shape":
        """The shape that a law is compiled from: the same, with everything computed already that depends on no point. Its
        parameters are tensors with a graph, through which gradients reach this shape's."""
        return self

    def area(self) -> Tensor:
        """Area [m2]."""
        raise NotImplementedError

    def gyration(self) -> Tensor:
        """Squared radius of gyration [m2]: moment of inertia over mass, of uniform density."""
        raise NotImplementedError

    def support(self, direction: Tensor) -> Tensor:
        """How far the body reaches along unit vectors (..., 2) of its own frame [m], shape (...). Of a body that is not convex
        it is its convex hull's: where a plane that comes from outside first touches."""
        raise NotImplementedError

    def size(self) -> float:
        """Radius [m] of a circle about the centre that holds the body, the smallest to 4e-5."""
        angle = torch.linspace(0, 2 * torch.pi, 361, dtype=torch.float64)
        reach = self.support(torch.stack((angle.cos(), angle.sin()), -1)).detach().max()
        return float(reach) / math.cos(torch.pi / 360)  # a boundary point is half a degree from one of the directions

    def curvature(self, x: Tensor) -> Tensor:
        """Curvature [1/m] (...) of the boundary at its points nearest to x (..., 2) [m], positive where it bulges outwards.

        The normal turns by kappa / (1 + kappa phi) a length, as that of the parallel curve at the distance phi.
        """
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            phi, n = self(x)
            t = torch.stack((-n[..., 1], n[..., 0]), -1).detach()
            rows = [torch.autograd.grad(n[..., i].sum(), x, retain_graph=i == 0)[0] for i in range(2)]
        turning = (t * torch.stack([(row * t).sum(-1) for row in rows], -1)).sum(-1)
        return (turning / (1 - turning * phi)).detach()

    def outline(self, points: int = 181) -> Tensor:
        """Points on the boundary of a convex body (points, 2) [m], for drawing: the support function and its slope."""
        angle = torch.linspace(0, 2 * torch.pi, points, dtype=torch.float64, requires_grad=True)
        with torch.enable_grad():
            h = self.support(torch.stack((angle.cos(), angle.sin()), -1))
            (slope,) = torch.autograd.grad(h.sum(), angle)
        n, t = (torch.stack((x, y), -1) for x, y in ((angle.cos(), angle.sin()), (-angle.sin(), angle.cos())))
        return (h[:, None] * n + slope[:, None] * t).detach()


class Prepared(Shape):
    """A shape whose parameters are `tensors` that were computed, with their graph."""

    @classmethod
    def of(cls, **tensors: Tensor) -> Self:
        shape = cls()
        parameters: dict[str, Any] = shape._parameters  # where torch itself puts leaves of graphs only
        parameters.update(tensors)
        return shape
