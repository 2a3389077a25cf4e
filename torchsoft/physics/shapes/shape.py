"""Interface of the shape of a rigid body, and properties of closed curves: moments by Green's
theorem, whether they cross themselves, and how far from them the nearest point stays the only
one."""

import logging
import math
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchsoft.physics.arguments import number


def parameter(value: float, name: str = "a parameter", *, trained: bool = True) -> nn.Parameter:
    """A scalar parameter in float64, independent of torch's default. Raises `ValueError` unless the
    value is a number."""
    return nn.Parameter(
        torch.tensor(number(name, value), dtype=torch.float64), requires_grad=trained
    )


log = logging.getLogger("torchsoft")

Array = NDArray[np.float64]

NOTED = 1e-9
"""Distance [m] between the origin of given coordinates and the centre of mass from which on a note
is written."""


DEEPEST = 33, 9, 9
"""Points along each side of the grids, one inside the other, that find the place farthest inside a
body."""

CENTRAL = 1e-3
"""Depth given up for each distance from the middle of a body by its place farthest inside."""


class Shape(nn.Module):
    """Interface of a rigid body's shape; lengths are numbers in m, about the centre of mass. A
    `round` one looks the same however it is turned, and its turning is left out of the law."""

    round: ClassVar[bool] = False

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance phi [m], shape (...), negative inside, and outward unit normal (..., 2),
        at x (..., 2) [m]."""
        raise NotImplementedError

    def prepared(self) -> "Shape":
        """The shape that a law is compiled from: the same, with everything computed already that
        depends on no point. Its parameters are tensors with a graph, through which gradients reach
        this shape's."""
        return self

    def area(self) -> Tensor:
        """Area [m2]."""
        raise NotImplementedError

    def gyration(self) -> Tensor:
        """Squared radius of gyration [m2]: moment of inertia over mass, of uniform density."""
        raise NotImplementedError

    def support(self, direction: Tensor) -> Tensor:
        """Support function (...) [m]: extent of the body along unit vectors (..., 2) of its own
        frame. A body that is not convex has that of its convex hull."""
        raise NotImplementedError

    def size(self) -> float:
        """Radius [m] of a circle about the centre that holds the body, the smallest to 4e-5."""
        angle = torch.linspace(0, 2 * torch.pi, 361, dtype=torch.float64)
        reach = self.support(torch.stack((angle.cos(), angle.sin()), -1)).detach().max()
        return float(reach) / math.cos(
            torch.pi / 360
        )  # a boundary point is half a degree from one of the directions

    @torch.no_grad()
    def deepest(self) -> tuple[float, float, float]:
        """The place (x, y) [m] farthest inside the body, nearly, and its depth [m]; the most
        central where there are several."""
        outline = self.outline()
        low, high = outline.amin(0), outline.amax(0)
        best, across = 0.5 * (low + high), 0.5 * (high - low)
        central = best.clone()
        for points in DEEPEST:
            part = torch.linspace(-1.0, 1.0, points, dtype=torch.float64)
            x = best + across * torch.cartesian_prod(part, part)
            off = self(x)[0].nan_to_num(nan=torch.inf) + CENTRAL * (x - central).norm(dim=-1)
            best, across = x[off.argmin()], 2 * across / (points - 1)
        return float(best[0]), float(best[1]), -float(self(best[None])[0])

    def curvature(self, x: Tensor) -> Tensor:
        """Curvature [1/m] (...) of the boundary at its points nearest to x (..., 2) [m], positive
        where it bulges outwards.

        The normal turns by kappa / (1 + kappa phi) a length, as that of the parallel curve at the
        distance phi.
        """
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            phi, n = self(x)
            t = torch.stack((-n[..., 1], n[..., 0]), -1).detach()
            rows = [
                torch.autograd.grad(n[..., i].sum(), x, retain_graph=i == 0)[0] for i in range(2)
            ]
        turning = (t * torch.stack([(row * t).sum(-1) for row in rows], -1)).sum(-1)
        return (turning / (1 - turning * phi)).detach()

    def outline(self, points: int = 181) -> Tensor:
        """Points on the boundary of a convex body (points, 2) [m], for drawing: the support
        function and its slope."""
        angle = torch.linspace(0, 2 * torch.pi, points, dtype=torch.float64, requires_grad=True)
        with torch.enable_grad():
            h = self.support(torch.stack((angle.cos(), angle.sin()), -1))
            (slope,) = torch.autograd.grad(h.sum(), angle)
        n, t = (
            torch.stack((x, y), -1)
            for x, y in ((angle.cos(), angle.sin()), (-angle.sin(), angle.cos()))
        )
        return (h[:, None] * n + slope[:, None] * t).detach()


class Prepared(Shape):
    """A shape whose parameters are `tensors` that were computed, with their graph."""

    @classmethod
    def of(cls, **tensors: Tensor) -> Self:
        shape = cls()
        parameters: dict[str, Any] = (
            shape._parameters
        )  # where torch itself puts leaves of graphs only
        parameters.update(tensors)
        return shape


class Outlined(Shape):
    """A shape given by points around it, about any point: its own frame has its origin at the
    centre of mass."""

    def moments(self) -> "Moments":
        """In the coordinates of the given points."""
        raise NotImplementedError

    def boundary(self, points: int) -> Tensor:
        """About so many points around (points, 2) [m], in the coordinates of the given ones."""
        raise NotImplementedError

    def note_centre(self) -> None:
        """Say where among the given points the centre of mass (2,) [m] is, which poses speak of, if
        not at their origin."""
        x, y = self.moments().centre.tolist()
        if max(abs(x), abs(y)) > NOTED:
            log.warning(
                "the centre of mass is at (%.3f, %.3f) mm in the outline's coordinates; x and y of "
                "the body are those of this point",
                1e3 * x,
                1e3 * y,
            )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.prepared()(x)

    def area(self) -> Tensor:
        return self.moments().area

    def gyration(self) -> Tensor:
        return self.moments().gyration

    @torch.no_grad()
    def outline(self, points: int = 181) -> Tensor:
        around = self.boundary(points) - self.moments().centre
        return torch.cat((around, around[:1]))


class Moments(NamedTuple):
    """Area [m2], centre of mass (2,) [m], and squared radius of gyration about it [m2]."""

    area: Tensor
    centre: Tensor
    gyration: Tensor


def gauss(points: int) -> tuple[Tensor, Tensor]:
    """Places and weights (points,) of Gauss' quadrature from 0 to 1."""
    place, weight = np.polynomial.legendre.leggauss(points)
    return torch.from_numpy(0.5 * (1 + place)), torch.from_numpy(0.5 * weight)


def moments(x: Tensor, dx: Tensor) -> Moments:
    """Moments of the area to the left of a closed contour, from points x (points, 2) [m] of a
    quadrature along it, and its tangents there times their weights, dx (points, 2) [m]: the
    integral of x^k dA is that of x^(k+1) dy / (k+1)."""
    middle = x.detach().mean(0)
    x, y = (x - middle).unbind(-1)
    dx, dy = dx.unbind(-1)
    area = 0.5 * (x * dy - y * dx).sum()
    centre = torch.stack(((x**2 * dy).sum(), -(y**2 * dx).sum())) / (2 * area)
    square = ((x**3 * dy).sum() - (y**3 * dx).sum()) / (3 * area)
    return Moments(area, centre + middle, square - (centre**2).sum())


SAME = 1e-9
"""Distance, over the curve's size, at which points next to each other are one."""


def crossing(points: Array) -> bool:
    """Whether the closed polygon through points (n, 2) crosses itself."""
    size = np.ptp(points, 0).max()
    points = points[np.linalg.norm(points - np.roll(points, 1, 0), axis=1) > SAME * size]
    start, way = points, np.roll(points, -1, 0) - points
    way_x, way_y = way.T
    to = start[None] - start[:, None]
    begins = (
        way_x[:, None] * to[..., 1] - way_y[:, None] * to[..., 0]
    )  # on which side of a row's segment a column's begins
    ends = np.roll(begins, -1, 1)
    divided = (begins > 0) != (ends > 0)
    count = np.arange(len(points))
    apart = np.abs(count[:, None] - count)
    return bool((divided & divided.T & (apart > 1) & (apart < len(points) - 1)).any())


def reach(points: Array, normals: Array, curvature: Array) -> float:
    """Reach [m] of a smooth closed curve: the distance up to which the nearest point on it is
    unique. From points (n, 2) [m], normals (n, 2) and curvature (n,) [1/m]: the smallest radius of
    curvature, or of a circle that touches the curve at one of the points and passes through another
    (Federer 1959, Curvature measures, Theorem 4.18)."""
    to = points[None] - points[:, None]
    off = np.abs((to * normals[:, None]).sum(-1))
    np.fill_diagonal(off, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.where(off > 0, (to**2).sum(-1) / (2 * off), np.inf)
    return float(min(radius.min(), 1 / np.abs(curvature).max()))
