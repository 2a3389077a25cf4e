"""Shapes of a few numbers: rounded boxes and polygons, circles, ellipses and superellipses.

Boundaries of boxes and polygons are segments and arcs that continue each other's tangents. Distance
and normal are exact wherever the nearest point is the only one, in particular down to the corners'
radius; the curvature jumps where an arc begins.
"""

from typing import Annotated, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from torchsoft.physics.arguments import places, positive
from torchsoft.physics.shapes.shape import (
    Moments,
    Outlined,
    Prepared,
    Shape,
    crossing,
    gauss,
    moments,
    parameter,
)
from torchsoft.quantity import Length, Points, Quantity


class Sides(NamedTuple):
    """A polygon's sides and the arcs before them, anticlockwise: unit tangents and outward normals
    (n, 2), where the sides begin (n, 2) [m] and how long they are (n,) [m]; the arcs' centres (n,
    2) [m], by how much they turn (n,) [rad], and 1 where they bulge outwards, else -1."""

    tangent: Tensor
    normal: Tensor
    start: Tensor
    length: Tensor
    centre: Tensor
    turn: Tensor
    bulge: Tensor


class Rounded(Outlined):
    """A polygon of segments and arcs, from its `vertices` (n, 2) [m] before rounding and the
    `radius` [m] of its corners."""

    ARC = 16
    """Points of the quadrature along an arc: exact to rounding up to half a turn."""

    vertices: Tensor
    radius: Tensor

    def sides(self) -> Sides:
        v = self.vertices
        x, y = v.detach().unbind(-1)
        if float((x * y.roll(-1) - y * x.roll(-1)).sum()) < 0:
            v = v.flip(0)
        edge = v.roll(-1, 0) - v
        length = torch.linalg.vector_norm(edge, dim=-1)
        t = edge / length[:, None]
        before = t.roll(1, 0)
        cross = before[:, 0] * t[:, 1] - before[:, 1] * t[:, 0]
        dot = (before * t).sum(-1)
        bulge = torch.where(cross >= 0, 1.0, -1.0).double()
        trim = (
            self.radius * bulge * cross / (1 + dot)
        )  # r tan(|turn| / 2): length that an arc takes from both of its sides
        normal, start = torch.stack((t[:, 1], -t[:, 0]), -1), v + trim[:, None] * t
        centre = start - (bulge * self.radius)[:, None] * normal
        return Sides(
            t, normal, start, length - trim - trim.roll(-1), centre, torch.atan2(cross, dot), bulge
        )

    def along_arcs(self, sides: Sides, part: Tensor) -> tuple[Tensor, Tensor]:
        """Places (n, parts, 2) [m] on the arcs at these parts of their turn, and the directions in
        which they go on there."""
        angle = (sides.turn[:, None] * (part - 1))[
            ..., None
        ]  # from the arc's end, where the side begins
        normal, tangent = (x[:, None] for x in (sides.normal, sides.tangent))
        out = angle.cos() * normal + angle.sin() * tangent
        on = angle.cos() * tangent - angle.sin() * normal
        return sides.centre[:, None] + (sides.bulge * self.radius)[:, None, None] * out, on

    def moments(self) -> Moments:
        sides = self.sides()
        (half, halves), (part, weight) = gauss(2), gauss(self.ARC)
        way = sides.length[:, None] * sides.tangent
        on_sides = sides.start[:, None] + half[:, None] * way[:, None]
        on_arcs, on = self.along_arcs(sides, part)
        length = self.radius * sides.turn.abs()
        steps = (halves[:, None] * way[:, None], (weight * length[:, None])[..., None] * on)
        return moments(
            *(torch.cat([x.flatten(0, 1) for x in parts]) for parts in ((on_sides, on_arcs), steps))
        )

    def support(self, direction: Tensor) -> Tensor:
        sides = self.sides()
        centre = (sides.centre - self.moments().centre)[sides.bulge > 0]
        return (direction @ centre.mT).amax(-1) + self.radius * torch.linalg.vector_norm(
            direction, dim=-1
        )

    @torch.no_grad()
    def boundary(self, points: int) -> Tensor:
        """About so many points around (points, 2) [m], among the vertices."""
        part = torch.linspace(0, 1, max(2, points // len(self.vertices)), dtype=torch.float64)
        return self.along_arcs(self.sides(), part)[0].flatten(0, 1)


class RoundedBox(Rounded):
    """A box with half of its width and of its height [m] along the body's x and y, and corners
    rounded to `radius` [m]: a circle where all three are equal."""

    def __init__(
        self,
        half_width: Annotated[Length, "half of the size along the body's own x"],
        half_height: Annotated[Length, "half of the size along the body's own y"],
        radius: Annotated[Length, "radius of the corners, at most the smaller half size"],
    ) -> None:
        super().__init__()
        self.half_width, self.half_height, self.radius = (
            parameter(value, name)
            for name, value in (
                ("half_width", half_width),
                ("half_height", half_height),
                ("radius", radius),
            )
        )

    def well_posed(self) -> str:
        """Conflict between the parameters; empty where there is none."""
        most = min(self.half_width.item(), self.half_height.item())
        radius = self.radius.item()
        return (
            f"the corners' radius {radius:g} is larger than half of the box, {most:g}"
            if radius > most
            else ""
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        mirrored = x.detach() < 0
        qx, qy = torch.where(mirrored, -x, x).unbind(-1)
        qx = qx - (self.half_width - self.radius)
        qy = qy - (self.half_height - self.radius)
        corner, side = (qx >= 0) & (qy >= 0) & (qx + qy > 0), qx > qy
        far = torch.sqrt(torch.where(corner, qx * qx + qy * qy, 1.0))
        one, zero = torch.ones_like(far), torch.zeros_like(far)
        nx = torch.where(corner, qx / far, torch.where(side, one, zero))
        ny = torch.where(corner, qy / far, torch.where(side, zero, one))
        phi = torch.where(corner, far, torch.where(side, qx, qy)) - self.radius
        n = torch.stack((nx, ny), -1)
        return phi, torch.where(mirrored, -n, n)

    outline = Shape.outline

    @property
    def vertices(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        a, b = self.half_width, self.half_height
        return torch.stack([torch.stack(corner) for corner in ((-a, -b), (a, -b), (a, b), (-a, b))])


class RoundedPolygon(Rounded):
    """A polygon with `vertices` (n, 2) [m] in their order, whose corners, inner ones too, are
    rounded to `radius` [m].

    The arcs touch the sides that meet at a vertex, so that the sides stay where they are. The
    vertices may be given about any point: the body's own frame has its origin at the centre of
    mass, wherever the vertices move it, and the note that says so tells where that is. They are one
    parameter with the shape (n, 2), which gradients reach; only `radius` is a scalar that can be
    asked for by name in a Jacobian or an identification. Raises `ValueError` for anything but from
    3 to `MOST` places, for corners that do not fit on their sides, and for sides that cross.
    """

    MOST = 64

    def __init__(
        self,
        vertices: Annotated[Points, "corners before rounding, in their order, [x, y] each"],
        radius: Annotated[Length, "radius of the corners, inner ones too"],
    ) -> None:
        super().__init__()
        given = places("vertices", vertices)
        if not 3 <= len(given) <= self.MOST:
            raise ValueError(f"`vertices` must be 3 to {self.MOST} places, but are {len(given)}")
        self.vertices, self.radius = (
            nn.Parameter(given),
            parameter(positive("radius", radius)),
        )
        if wrong := self.well_posed():
            raise ValueError(f"`vertices` cannot be used as a polygon: {wrong}")
        self.note_centre()

    def well_posed(self) -> str:
        """Conflict between the parameters; empty where there is none."""
        sides, r = self.sides(), self.radius.item()
        short = sides.length.detach() / self.vertices.detach().abs().max()
        if not bool((short > -1e-12).all()):
            worst = int(torch.nan_to_num(short, nan=-torch.inf).argmin())
            return (
                f"corners of radius {r:g} do not fit on side {worst} of the polygon (from 0 on, "
                "anticlockwise): there it is too short, or folds back"
            )
        return "the polygon crosses itself" if crossing(self.boundary(181).numpy()) else ""

    def prepared(self) -> Shape:
        sides, origin = self.sides(), self.moments().centre
        start = sides.start - origin
        offset = [(axis * start).sum(-1, keepdim=True) for axis in (sides.tangent, sides.normal)]
        edges = torch.cat((sides.tangent, *offset, sides.length[:, None]), -1)
        arcs = torch.cat((sides.centre - origin, sides.bulge[:, None]), -1)
        return SidesAndArcs.of(edges=edges, arcs=arcs, radius=self.radius)


class SidesAndArcs(Prepared):
    """Constants of a rounded polygon's compiled law.

    `edges` (n, 5): the sides' unit tangents, the tangents' and the normals' components of their
    beginnings [m], their lengths [m]; `arcs` (n, 3): the centres [m] of the arcs before them, and 1
    where they bulge outwards, else -1; `radius` [m].
    """

    edges: Tensor
    arcs: Tensor
    radius: Tensor

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        nearest, count = self.nearest(x.detach()), len(self.edges)
        round_ = nearest >= count
        side = torch.where(round_, nearest - count, nearest)
        tx, ty, _, offset, _ = nn.functional.embedding(side, self.edges).unbind(-1)
        cx, cy, bulge = nn.functional.embedding(side, self.arcs).unbind(-1)
        dx, dy = x[..., 0] - cx, x[..., 1] - cy
        far = torch.sqrt(torch.where(round_, dx * dx + dy * dy, 1.0))
        phi = torch.where(
            round_, bulge * (far - self.radius), ty * x[..., 0] - tx * x[..., 1] - offset
        )
        nx, ny = (
            torch.where(round_, bulge * dx / far, ty),
            torch.where(round_, bulge * dy / far, -tx),
        )
        return phi, torch.stack((nx, ny), -1)

    @torch.no_grad()
    def nearest(self, x: Tensor) -> Tensor:
        """Number of the side nearest to x, or, behind the last, of the arc. An arc counts where its
        centre's directions to its ends enclose x, a side's ends belong to arcs."""
        tx, ty, start, offset, length = self.edges.detach().unbind(-1)
        cx, cy, _ = self.arcs.detach().unbind(-1)
        x, y = x[..., 0, None], x[..., 1, None]
        along, across = tx * x + ty * y - start, ty * x - tx * y - offset
        beyond = along - torch.minimum(along.clamp(min=0.0), length)
        far = torch.sqrt((x - cx) ** 2 + (y - cy) ** 2)
        enclosed = ((along - length).roll(1, -1) >= 0) & (along <= 0)
        to_arc = torch.where(enclosed, (far - self.radius.detach()).abs(), torch.inf)
        return torch.cat((across.abs() + beyond.abs(), to_arc), -1).argmin(-1)


# Round bodies that a few numbers describe: circle, ellipse, superellipse.


HalfAxisX = Annotated[Length, "half-axis along the body's own x"]
HalfAxisY = Annotated[Length, "half-axis along the body's own y"]
Exponent = Annotated[float, Quantity("1", 2.0, 20.0, "exponent; 2 is the ellipse")]


class Circle(Shape):
    """A disc of radius R [m] about its centre of mass. Not smooth at the centre."""

    round: ClassVar = True

    def __init__(self, radius: Annotated[Length, "radius"]) -> None:
        super().__init__()
        self.radius = parameter(radius, "radius")

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
    """Largest overshoot of known bounds by a step of Newton's method [1]; beyond it the step goes
    to their middle."""

    def __init__(self, a: HalfAxisX, b: HalfAxisY, n: Exponent) -> None:
        super().__init__()
        self.a, self.b, self.n = parameter(a, "a"), parameter(b, "b"), parameter(n, "n")

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
