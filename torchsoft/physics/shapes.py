"""The shape of a rigid body: signed distance and outward normal, in the body's own frame.

The contact asks nothing else of a body, so another shape is another class here: the compiled kernels are generated from its
`forward`.
"""

from typing import ClassVar

import torch
from torch import Tensor, nn

from torchsoft.physics.arguments import number


def parameter(value: float, trained: bool = True) -> nn.Parameter:
    """A scalar parameter in float64, whatever torch's default is. Raises `ValueError` for what is not a number."""
    return nn.Parameter(torch.tensor(number("a parameter", value), dtype=torch.float64), requires_grad=trained)


class Shape(nn.Module):
    """What a rig asks of a rigid body's shape; lengths are numbers in m, about the centre of mass. A `round` one looks the same
    however it is turned, and its turning is left out of the law."""

    round: ClassVar[bool] = False

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance phi [m], shape (...), negative inside, and outward unit normal (..., 2), at x (..., 2) [m]."""
        raise NotImplementedError

    def gyration(self) -> Tensor:
        """Squared radius of gyration [m2]: moment of inertia over mass, of uniform density."""
        raise NotImplementedError

    def support(self, direction: Tensor) -> Tensor:
        """How far the body reaches along unit vectors (..., 2) of its own frame [m], shape (...)."""
        raise NotImplementedError

    def size(self) -> float:
        """Radius [m] of the circle about the centre that holds the body."""
        angle = torch.linspace(0, 2 * torch.pi, 361, dtype=torch.float64)
        return float(self.support(torch.stack((angle.cos(), angle.sin()), -1)).detach().max())

    def outline(self, points: int = 181) -> Tensor:
        """Points on the boundary of a convex body (points, 2) [m], for drawing: the support function and its slope."""
        angle = torch.linspace(0, 2 * torch.pi, points, dtype=torch.float64, requires_grad=True)
        with torch.enable_grad():
            h = self.support(torch.stack((angle.cos(), angle.sin()), -1))
            (slope,) = torch.autograd.grad(h.sum(), angle)
        n, t = (torch.stack((x, y), -1) for x, y in ((angle.cos(), angle.sin()), (-angle.sin(), angle.cos())))
        return (h[:, None] * n + slope[:, None] * t).detach()


class Circle(Shape):
    """A disc of radius R [m] about its centre of mass. Not smooth at the centre."""

    round: ClassVar = True
    limits: ClassVar = {"radius": "positive"}

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = parameter(radius)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        d = torch.linalg.vector_norm(x, dim=-1)
        return d - self.radius, x / d[..., None]

    def gyration(self) -> Tensor:
        return 0.5 * self.radius**2

    def support(self, direction: Tensor) -> Tensor:
        return self.radius * torch.linalg.vector_norm(direction, dim=-1)


class Ellipse(Shape):
    """An ellipse with half-axes a and b [m] along the body's x and y.

    The nearest point of the boundary is found by `ITERATIONS` steps of a fixed-point iteration on the evolute and one Newton
    step with derivatives, exact to rounding where the axes differ by less than a factor of three. Not smooth on the evolute's
    inner part of the axes, far from the boundary.
    """

    limits: ClassVar = {"a": "positive", "b": "positive"}
    ITERATIONS, SLIM = 12, 3

    def __init__(self, a: float, b: float) -> None:
        super().__init__()
        self.a, self.b = parameter(a), parameter(b)

    def well_posed(self) -> str:
        """What is wrong with the parameters together; empty if nothing is."""
        low, high = sorted((self.a.item(), self.b.item()))
        return f"the axes a and b differ by more than a factor of {self.SLIM}" if high > self.SLIM * low else ""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        a, b = self.a, self.b
        px, py = x[..., 0], x[..., 1]
        with torch.no_grad():  # cos and sin of the parameter of the nearest point, in the quadrant of x
            X, Y, A, B = px.detach().abs(), py.detach().abs(), a.detach(), b.detach()
            c = s = torch.full_like(X, 0.5**0.5)
            for _ in range(self.ITERATIONS):
                ex, ey = (A * A - B * B) * c**3 / A, (B * B - A * A) * s**3 / B
                rx, ry, qx, qy = A * c - ex, B * s - ey, X - ex, Y - ey
                ratio = torch.sqrt((rx * rx + ry * ry) / (qx * qx + qy * qy))
                c, s = ((qx * ratio + ex) / A).clamp(0.0, 1.0), ((qy * ratio + ey) / B).clamp(0.0, 1.0)
                size = torch.sqrt(c * c + s * s)
                c, s = c / size, s / size
            c, s = torch.where(px.detach() < 0, -c, c), torch.where(py.detach() < 0, -s, s)
        # one Newton step on the stationarity of the distance carries the derivatives
        slope = (b * b - a * a) * s * c + a * px * s - b * py * c
        turn = -slope / ((b * b - a * a) * (c * c - s * s) + a * px * c + b * py * s)
        cos, sin = torch.cos(turn), torch.sin(turn)
        c, s = c * cos - s * sin, s * cos + c * sin
        nx, ny = b * c, a * s
        size = torch.sqrt(nx * nx + ny * ny)
        nx, ny = nx / size, ny / size
        return (px - a * c) * nx + (py - b * s) * ny, torch.stack((nx, ny), -1)

    def gyration(self) -> Tensor:
        return 0.25 * (self.a**2 + self.b**2)

    def support(self, direction: Tensor) -> Tensor:
        return torch.sqrt((self.a * direction[..., 0]) ** 2 + (self.b * direction[..., 1]) ** 2)
