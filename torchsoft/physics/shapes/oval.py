"""Round bodies that a few numbers describe: circle, ellipse, superellipse."""

from typing import Annotated, ClassVar

import torch
from torch import Tensor

from torchsoft.physics.shapes.shape import Shape, parameter
from torchsoft.quantity import Length, Quantity

HalfAxisX = Annotated[Length, "half-axis along the body's own x"]
HalfAxisY = Annotated[Length, "half-axis along the body's own y"]
Exponent = Annotated[float, Quantity("1", 2.0, 20.0, "exponent; 2 is the ellipse")]


class Circle(Shape):
    """A disc of radius R [m] about its centre of mass. Not smooth at the centre."""

    round: ClassVar = True

    def __init__(self, radius: Annotated[Length, "radius"]) -> None:
        super().__init__()
        self.radius = parameter(radius)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        d = torch.linalg.vector_norm(x, dim=-1)
        return d - self.radius, x / d[..., None]

    def area(self) -> Tensor:
        return torch.pi * self.radius**2

    def gyration(self) -> Tensor:
        return 0.5 * self.radius**2

    def support(self, direction: Tensor) -> Tensor:
        return self.radius * torch.linalg.vector_norm(direction, dim=-1)


class Superellipse(Shape):
    """The body inside |x / a|^n + |y / b|^n = 1 with half-axes a and b [m] along its x and y: an
    ellipse where n = 2, with flatter sides and sharper corners the larger n is. It may be from 2 to
    20, the axes differ by a factor of three.

    An eighth of the boundary is a graph, (A u, B v) with v = (1 - u^n)^(1/n) over the half-axis A
    from the end of the other, B, to the diagonal. There the nearest point is found by `ITERATIONS`
    steps of Newton's method between bounds, and one more carries the derivatives: exact to rounding
    within a few sizes outside, and inside down to half of the smallest radius of curvature, which
    is sqrt(2) a / (2^(1/n) (n - 1)) for equal axes, at the diagonal. The curvature vanishes at the
    ends of the axes, with a cusp where n is below 3; below 2 it would be infinite there.
    """

    ITERATIONS, SLIM = 8, 3
    ROUNDING = 1e-12
    """How far a step of Newton's method may lead beyond known bounds [1]; farther, it goes to their
    middle."""

    def __init__(self, a: HalfAxisX, b: HalfAxisY, n: Exponent) -> None:
        super().__init__()
        self.a, self.b, self.n = parameter(a), parameter(b), parameter(n)

    def well_posed(self) -> str:
        """Conflict between the parameters; empty where there is none."""
        low, high = sorted((self.a.item(), self.b.item()))
        return (
            f"the axes a and b differ by more than a factor of {self.SLIM}"
            if high > self.SLIM * low
            else ""
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        a, b, n = self.a, self.b, self.n
        mirrored = x.detach() < 0
        X, Y = torch.where(mirrored, -x, x).unbind(-1)
        corner = 0.5 ** (
            1 / n.detach()
        )  # u and v where the halves of the quarter meet, on whose normal both begin
        over = (b * (Y - b * corner) - a * (X - a * corner)).detach() >= 0
        A, B, X, Y = (torch.where(over, *pair) for pair in ((a, b), (b, a), (X, Y), (Y, X)))
        u = self.nearest(A.detach(), B.detach(), n.detach(), X.detach(), Y.detach(), corner)
        f, slope = self.stationarity(A, B, n, X, Y, u)
        turn = -f / slope.detach()
        u = u + (turn - turn.detach())
        w = 1 - u**n
        v = w ** (1 / n)
        along, across = B * u ** (n - 1) * v / w, A
        size = torch.sqrt(along * along + across * across)
        along, across = along / size, across / size
        phi = (X - A * u) * along + (Y - B * v) * across
        pair = torch.where(over, along, across), torch.where(over, across, along)
        normal = torch.stack(pair, -1)
        return phi, torch.where(mirrored, -normal, normal)

    @staticmethod
    def stationarity(
        A: Tensor, B: Tensor, n: Tensor, X: Tensor, Y: Tensor, u: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Half of the derivative of the squared distance of (X, Y) from (A u, B v) by -u [m2], and
        its slope in u."""
        q = u ** (n - 2)
        w = 1 - q * u * u
        v = w ** (1 / n)
        turn = q * u * v / w  # -dv/du
        f = A * (X - A * u) - B * (Y - B * v) * turn
        return f, -(A * A) - (B * turn) ** 2 - B * (Y - B * v) * (n - 1) * q * v / (w * w)

    @torch.no_grad()
    def nearest(
        self, A: Tensor, B: Tensor, n: Tensor, X: Tensor, Y: Tensor, corner: Tensor
    ) -> Tensor:
        """u of the point nearest to (X, Y), between 0 and `corner`."""
        low = torch.zeros_like(X)
        high = low + corner
        u = torch.minimum(X / A, corner)
        for _ in range(self.ITERATIONS):
            f, slope = self.stationarity(A, B, n, X, Y, u)
            rising = f >= 0
            low, high = torch.where(rising, u, low), torch.where(rising, high, u)
            u = torch.minimum((u - f / slope).clamp(min=0.0), corner)
            inside = (slope < 0) & (u >= low - self.ROUNDING) & (u <= high + self.ROUNDING)
            u = torch.where(inside, u, 0.5 * (low + high))
        return u

    def area(self) -> Tensor:
        n = self.n
        return (
            4
            * self.a
            * self.b
            * torch.exp(2 * torch.lgamma(1 / n) - torch.lgamma(1 + 2 / n))
            / n**2
        )

    def gyration(self) -> Tensor:
        n = self.n
        log = (
            torch.lgamma(3 / n)
            + torch.lgamma(1 + 2 / n)
            - torch.lgamma(1 / n)
            - torch.lgamma(1 + 4 / n)
        )
        return (self.a**2 + self.b**2) * torch.exp(log)

    def support(self, direction: Tensor) -> Tensor:
        m = self.n / (self.n - 1)
        return (
            (self.a * direction[..., 0]).abs() ** m + (self.b * direction[..., 1]).abs() ** m
        ) ** (1 / m)


class Ellipse(Superellipse):
    """An ellipse with half-axes a and b [m] along the body's x and y, which differ by a factor of
    three at the most."""

    def __init__(self, a: HalfAxisX, b: HalfAxisY) -> None:
        super().__init__(a, b, 2.0)
        del self.n
        self.register_buffer("n", torch.tensor(2.0, dtype=torch.float64), persistent=False)

    def area(self) -> Tensor:
        return torch.pi * self.a * self.b

    def gyration(self) -> Tensor:
        return 0.25 * (self.a**2 + self.b**2)
