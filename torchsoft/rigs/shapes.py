"""Shapes of bodies in a rig file. Another one is another class here, and one more name in `ShapeTable`."""

from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from torchsoft.physics.shapes import (
    Circle,
    Contour,
    Ellipse,
    RoundedBox,
    RoundedPolygon,
    Shape,
    Superellipse,
)
from torchsoft.physics.shapes.closed import read_points
from torchsoft.rigs.fields import Group, Length, Place, Within, at_field
from torchsoft.tables import LISTED

Vertex = Annotated[tuple[Place, Place], LISTED]


class CircleTable(Group):
    """A disc."""

    kind: Literal["circle"] = "circle"
    radius: Length = Field(description="radius")

    def build(self, folder: Path) -> Shape:
        """The shape; `folder` is where a file that a table names lies. Raises `ValueError`."""
        return Circle(self.radius)


class EllipseTable(Group):
    """An ellipse; the half-axes may differ by a factor of three."""

    kind: Literal["ellipse"] = "ellipse"
    a: Length = Field(description="half-axis along the body's own x")
    b: Length = Field(description="half-axis along the body's own y")

    def build(self, folder: Path) -> Shape:
        return Ellipse(self.a, self.b)


class SuperellipseTable(Group):
    """The body inside |x / a|^n + |y / b|^n = 1: flatter sides and sharper corners than an ellipse. The half-axes may differ by
    a factor of three."""

    kind: Literal["superellipse"] = "superellipse"
    a: Length = Field(description="half-axis along the body's own x")
    b: Length = Field(description="half-axis along the body's own y")
    n: Annotated[float, Within(Superellipse.LEAST, Superellipse.MOST)] = Field(description="exponent; 2 is the ellipse")

    def build(self, folder: Path) -> Shape:
        return Superellipse(self.a, self.b, self.n)


class RoundedBoxTable(Group):
    """A box with rounded corners."""

    kind: Literal["rounded_box"] = "rounded_box"
    half_width: Length = Field(description="half of its size along the body's own x")
    half_height: Length = Field(description="half of its size along the body's own y")
    radius: Length = Field(description="of the corners, at most the smaller half size")

    def build(self, folder: Path) -> Shape:
        return RoundedBox(self.half_width, self.half_height, self.radius)


class RoundedPolygonTable(Group):
    """A polygon with rounded corners. Its vertices may be given about any point: the pose of the body is that of its centre of
    mass, and a note says where that is among them."""

    kind: Literal["rounded_polygon"] = "rounded_polygon"
    vertices: Annotated[tuple[Vertex, ...], LISTED, Field(min_length=3, max_length=RoundedPolygon.MOST)] = Field(
        description="corners before they are rounded, in their order, [x, y] each [m]"
    )
    radius: Length = Field(description="of the corners, inner ones too")

    def build(self, folder: Path) -> Shape:
        return deepcopy(polygon(self.vertices, self.radius))


class ContourTable(Group):
    """A smooth closed contour through the points of a CSV file with the columns x and y, which have units in their headings:
    `x [mm],y [mm]`. They may be given about any point: the pose of the body is that of its centre of mass, and a note says
    where that is among them."""

    kind: Literal["contour"] = "contour"
    file: str = Field(description="the CSV file, from the folder of this one")
    tolerance: Annotated[float, Within(1e-9, 1e-2, "m")] = Field(
        default=1e-6, description="how far the contour may pass the points"
    )

    def build(self, folder: Path) -> Shape:
        with at_field("file"):
            points = read_points(folder / self.file)
            return deepcopy(contour(tuple((x, y) for x, y in points.tolist()), self.tolerance))


@lru_cache(maxsize=32)
def polygon(vertices: tuple[tuple[float, float], ...], radius: float) -> RoundedPolygon:
    """Made once, as the note on its centre of mass is to be said once."""
    return RoundedPolygon(vertices, radius)


@lru_cache(maxsize=32)
def contour(points: tuple[tuple[float, float], ...], tolerance: float) -> Contour:
    """Made once: it takes a while."""
    return Contour(points, tolerance=tolerance)


ShapeTable = Annotated[
    CircleTable | EllipseTable | SuperellipseTable | RoundedBoxTable | RoundedPolygonTable | ContourTable,
    Field(discriminator="kind"),
]
