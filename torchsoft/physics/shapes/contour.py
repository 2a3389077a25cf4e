"""A body inside any smooth closed contour: a periodic cubic spline."""

from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
from torch import Tensor, nn

from torchsoft import csvfile
from torchsoft.physics.arguments import LENGTHS, places, positive
from torchsoft.physics.shapes.shape import (
    Array,
    Moments,
    Outlined,
    Prepared,
    Shape,
    crossing,
    gauss,
    moments,
    reach,
)

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

FINE = 64
"""Intervals a piece in which lengths along a spline are summed up."""

LEAST, STEEPEST = 8, np.radians(60)
"""Points that are a contour, and by how much it may turn at one of them [rad]: a spline would swing
around a corner."""

WIDEST = 2.0
"""Largest width [m] of the outline in a file: a wider one is in another unit than its heading."""

PIECES = (32, 64, 128, 256, 512)
"""Allowed numbers of pieces of a contour; the tolerance decides."""

BETWEEN = 8
"""Places from point to point at which a contour is held against the spline through the points."""

SHARPEST = 1e-2
"""Least distance from a contour, over its size, up to which the nearest point must be unique."""

JUDGED = 1024
"""Number of points, about, at which a contour is judged."""

EXACT = 1e-9
"""Largest error of distances [m] and normals [1], up to half the distance at which the nearest
point ceases to be unique."""


class Contour(Outlined):
    """A body inside a periodic cubic B-spline through points (n, 2) [m] of its contour in their
    order, which may be given about any point: the body's own frame has its origin at the centre of
    mass, and a note says where that is.

    The contour is smooth: curvature is continuous. It passes the points, and between them their
    periodic cubic spline over the chords' lengths, at `residual` [m], which is at most the
    `tolerance` [m]. Its `control` points, (pieces, 2) [m], are one parameter, which gradients
    reach. Distance and normal are exact up to half as far from the contour as the nearest point is
    the only one, which the sharpest curvature and the narrowest neck decide.

    Raises `ValueError` for points that are too few or turn too sharply, and for a contour that
    passes them farther than the tolerance, crosses itself, or is so sharp, narrow or intricate that
    the nearest points cannot be told apart.
    """

    POINTS = 6
    """Quadrature points along a piece, whose moments are polynomials of degree 11."""

    def __init__(self, points: object, *, tolerance: float = 1e-6) -> None:
        super().__init__()
        (spline, chords), tolerance = (
            closed_spline(contour_points(points)),
            positive("tolerance", tolerance),
        )
        between = np.linspace(chords[:-1], chords[1:], BETWEEN, endpoint=False).ravel()
        given = torch.from_numpy(spline(between))
        self._judged = (b"", "")
        for pieces in PIECES:
            self.control = nn.Parameter(torch.from_numpy(control_points(spline, chords, pieces)))
            with torch.no_grad():
                self.residual = float(self(given - self.moments().centre)[0].abs().max())
            if self.residual <= tolerance:
                break
        else:
            raise ValueError(
                f"a contour of {PIECES[-1]} pieces still passes the points, or the spline between "
                f"them, at {self.residual:.2g} m; give a `tolerance` above that, or points with "
                "rounded corners"
            )
        if wrong := self.well_posed():
            raise ValueError(f"`points` cannot be used as a contour: {wrong}")
        self.note_centre()

    @classmethod
    def from_csv(cls, path: str | Path, *, tolerance: float = 1e-6) -> Self:
        """The contour through the points of a file: two columns with a unit in their heading, such
        as `x [mm],y [mm]`. Raises `ValueError` naming file and row for anything else, and
        `OSError`."""
        points = read_points(path)
        try:
            return cls(points, tolerance=tolerance)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def well_posed(self) -> str:
        """Fault of the control points; empty where there is none."""
        control = self.control.detach().numpy().tobytes()
        if self._judged[0] != control:
            self._judged = control, self.judged()
        return self._judged[1]

    @torch.no_grad()
    def judged(self) -> str:
        """Fault of the control points, searched for along the whole contour."""
        each = min(8, max(2, JUDGED // len(self.control)))
        points, way, bend = (
            x.flatten(0, 1) for x in self.along(torch.arange(each, dtype=torch.float64) / each)
        )
        moments = self.moments()
        points = points - moments.centre
        size, speed = float(points.norm(dim=-1).max()), way.norm(dim=-1, keepdim=True)
        if not float(moments.area) > 0 or float(speed.min()) == 0 or crossing(points.numpy()):
            return "it crosses itself, or goes round clockwise"
        normals = torch.stack((way[:, 1], -way[:, 0]), -1) / speed
        curvature = (way[:, 0] * bend[:, 1] - way[:, 1] * bend[:, 0]) / speed[:, 0] ** 3
        unique = reach(points.numpy(), normals.numpy(), curvature.numpy())
        if unique < SHARPEST * size:
            return (
                "it is so sharp, or so narrow, that the nearest point is the only one up to "
                f"{unique:.2g} m from it, which must be {SHARPEST:g} of its size, "
                f"{SHARPEST * size:.2g} m"
            )
        shape = self.prepared()
        for depth in (-0.5 * unique, 0.5 * unique):
            phi, n = shape(points + depth * normals)
            off = max(float((phi - depth).abs().max()), float((n - normals).abs().max()))
            if not off <= EXACT:
                return (
                    "it is so intricate that nearest points are not found: they are off by "
                    f"{off:.2g}"
                )
        return ""

    def cubics(self) -> Tensor:
        """Coefficients (pieces, 4, 2) [m] of the pieces' polynomials in the part of each from 0 to
        1."""
        before, here, after, last = (self.control.roll(by, 0) for by in (1, 0, -1, -2))
        parts = (
            (before + 4 * here + after) / 6,
            (after - before) / 2,
            (before - 2 * here + after) / 2,
            (last - before + 3 * (here - after)) / 6,
        )
        return torch.stack(parts, 1)

    def along(self, part: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Places (pieces, parts, 2) [m] at these parts of every piece, and their first two
        derivatives by the part."""
        t = part[:, None]
        k = self.cubics()[:, :, None].unbind(1)
        return (
            ((k[3] * t + k[2]) * t + k[1]) * t + k[0],
            (3 * k[3] * t + 2 * k[2]) * t + k[1],
            6 * k[3] * t + 2 * k[2],
        )

    def moments(self) -> Moments:
        part, weight = gauss(self.POINTS)
        x, way, _ = self.along(part)
        return moments(x.flatten(0, 1), (weight[:, None] * way).flatten(0, 1))

    def prepared(self) -> Shape:
        k = self.cubics()
        return Pieces.of(
            cubics=torch.cat((k[:, :1] - self.moments().centre, k[:, 1:]), 1).flatten(1)
        )

    def support(self, direction: Tensor) -> Tensor:
        k = torch.einsum("pjx,...x->...pj", self.cubics(), direction)
        with (
            torch.no_grad()
        ):  # where the contour's component has no slope: the roots of a quadratic a piece
            _, b, c, d = k.unbind(-1)
            root = torch.sqrt((c * c - 3 * b * d).clamp(min=0.0))
            q = -(c + torch.where(c < 0, -root, root))
            flat = torch.stack((torch.zeros_like(b), q / (3 * d), b / q), -1)
            flat = torch.where((flat >= 0) & (flat <= 1), flat, 0.0)
        heights = sum(k[..., j, None] * flat**j for j in range(4))
        return torch.as_tensor(heights).flatten(-2).amax(-1) - direction @ self.moments().centre

    def boundary(self, points: int) -> Tensor:
        part = torch.arange(max(1, points // len(self.control)), dtype=torch.float64)
        return self.along(part / len(part))[0].flatten(0, 1)


class Pieces(Prepared):
    """Constants of a contour's compiled law: `cubics` (pieces, 8) [m], the coefficients of every
    piece's x and y."""

    STARTS, ITERATIONS = 64, 8
    """Points of the contour at the most among which the nearest is looked for, and steps of
    Newton's method from there."""
    ROUNDING = 1e-9
    """Largest overshoot of known bounds by a step of Newton's method [pieces]; beyond it the step
    goes to their middle."""

    cubics: Tensor

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        s = self.nearest(x.detach())
        piece, part = self.place(s)
        row = nn.functional.embedding(piece, self.cubics)
        f, slope = self.stationarity(row, part, x)
        turn = -f / slope.detach()
        (cx, cy), (tx, ty), _ = self.curve(row, part + (turn - turn.detach()))
        size = torch.sqrt(tx * tx + ty * ty)
        nx, ny = ty / size, -tx / size
        return (x[..., 0] - cx) * nx + (x[..., 1] - cy) * ny, torch.stack((nx, ny), -1)

    def place(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Number of the piece, and the part of it, at s pieces from the start, around any number of
        times."""
        count = len(self.cubics)
        around = s - count * torch.floor(s / count)
        piece = torch.floor(around).clamp(max=count - 1.0)
        return piece.long(), around - piece

    @staticmethod
    def curve(row: Tensor, t: Tensor) -> tuple[tuple[Tensor, Tensor], ...]:
        """x and y on a piece (..., 8) at its part t, and their first two derivatives by it."""
        ax, ay, bx, by, cx, cy, dx, dy = row.unbind(-1)
        return (
            (((dx * t + cx) * t + bx) * t + ax, ((dy * t + cy) * t + by) * t + ay),
            ((3 * dx * t + 2 * cx) * t + bx, (3 * dy * t + 2 * cy) * t + by),
            (6 * dx * t + 2 * cx, 6 * dy * t + 2 * cy),
        )

    def stationarity(self, row: Tensor, t: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Half of the derivative of the squared distance of x from the place t by t [m2], and its
        slope."""
        (cx, cy), (tx, ty), (bx, by) = self.curve(row, t)
        ex, ey = cx - x[..., 0], cy - x[..., 1]
        return ex * tx + ey * ty, tx * tx + ty * ty + ex * bx + ey * by

    @torch.no_grad()
    def nearest(self, x: Tensor) -> Tensor:
        """Pieces from the start to the point nearest to x."""
        cubics, step = self.cubics.detach(), -(-len(self.cubics) // self.STARTS)
        start = cubics[::step, :2]
        away = (start[:, 0] - x[..., 0, None]) ** 2 + (start[:, 1] - x[..., 1, None]) ** 2
        s = step * away.argmin(-1).to(torch.float64)
        first, last = low, high = s - step, s + step
        for _ in range(self.ITERATIONS):
            piece, part = self.place(s)
            f, slope = self.stationarity(nn.functional.embedding(piece, cubics), part, x)
            falling = f < 0
            low, high = torch.where(falling, s, low), torch.where(falling, high, s)
            s = torch.minimum(torch.maximum(s - f / slope, first), last)
            inside = (slope > 0) & (s >= low - self.ROUNDING) & (s <= high + self.ROUNDING)
            s = torch.where(inside, s, 0.5 * (low + high))
        return s


def contour_points(points: object) -> Array:
    """Points (n, 2) [m] around a contour, the first of which is not there again at the end. Raises
    `ValueError` for too few points, and for points of which some are the same, turn by more than
    `STEEPEST`, or go along lines that cross."""
    given = places("points", points).numpy()
    if len(given) > 1 and np.array_equal(given[0], given[-1]):
        given = given[:-1]
    if len(given) < LEAST:
        raise ValueError(
            f"`points` must be at least {LEAST} places around a contour, but are {len(given)}"
        )
    x, y = (np.roll(given, -1, 0) - given).T
    if not (np.hypot(x, y) > 0).all():
        raise ValueError(
            f"`points` has the same place twice: point {int(np.hypot(x, y).argmin())} and the one "
            "after it"
        )
    turn = np.arctan2(np.roll(x, 1) * y - np.roll(y, 1) * x, np.roll(x, 1) * x + np.roll(y, 1) * y)
    sharpest = int(np.abs(turn).argmax())
    if abs(turn[sharpest]) > STEEPEST:
        raise ValueError(
            f"`points` turns by {abs(np.degrees(turn[sharpest])):.3g} degrees at point {sharpest}, "
            f"a smooth contour by {np.degrees(STEEPEST):.3g} at most; give more points there, or a "
            "RoundedPolygon"
        )
    if crossing(given):
        raise ValueError("`points` go along a contour that crosses itself")
    return given


def read_points(path: str | Path) -> Array:
    """Points (n, 2) [m] of a CSV file with columns x and y whose headings have units in brackets.
    Raises `ValueError` naming file and row for anything else, and `OSError`."""
    needed = "the columns must be `x [mm]` and `y [mm]`, in m, cm or mm"
    table = csvfile.read(Path(path), dict.fromkeys("xy", LENGTHS), lambda *_: f": {needed}")
    if table.values.keys() != {"x", "y"}:
        raise ValueError(f"{path}, row 1: {needed}, but are {', '.join(table.values) or 'none'}")
    points = np.stack((table.values["x"], table.values["y"]), -1)
    if (empty := np.flatnonzero(np.isnan(points).any(1))).size:
        raise ValueError(
            f"{path}, row {table.rows[empty[0]]} has an empty cell; a point needs x and y"
        )
    if (width := np.ptp(points, axis=0).max()) > WIDEST:
        raise ValueError(
            f"{path}: the outline is {width:.3g} m wide; is the unit in the heading right? It must "
            f"be at most {WIDEST:g} m wide"
        )
    return points


def closed_spline(points: Array) -> "tuple[CubicSpline, Array]":
    """The periodic cubic spline through points (n, 2) [m] over the lengths of their chords,
    anticlockwise, and these lengths from the first point on to the first point again (n + 1,)
    [m]."""
    x, y = points.T
    if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0:
        points = points[::-1]
    closed = np.concatenate((points, points[:1]))
    chords = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    from scipy.interpolate import CubicSpline  # a third of a second

    return CubicSpline(chords, closed, bc_type="periodic"), chords


def control_points(spline: "CubicSpline", chords: Array, pieces: int) -> Array:
    """Control points (pieces, 2) [m] of the uniform periodic cubic B-spline that meets a closed
    spline where its pieces do, at places equally far apart along it."""
    t = np.linspace(0, chords[-1], FINE * max(pieces, len(chords)) + 1)
    speed = np.linalg.norm(spline(t, 1), axis=1)
    length = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))))
    from scipy.interpolate import CubicSpline

    at = CubicSpline(length, t)(np.linspace(0, length[-1], pieces, endpoint=False))
    turn = 2 * np.pi * np.arange(pieces) / pieces
    return np.fft.ifft(
        np.fft.fft(spline(at), axis=0) / ((4 + 2 * np.cos(turn)) / 6)[:, None], axis=0
    ).real.copy()
