"""Shapes of bodies in a rig file. Another shape is one more line of `ShapeTable`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from torchsoft.physics.shapes import Circle, Contour, Ellipse, RoundedBox, RoundedPolygon, Superellipse
from torchsoft.physics.shapes.closed import read_points
from torchsoft.quantity import Quantity
from torchsoft.rigs.fields import PartTable, at_field, one_of, table_of


class ContourTable(PartTable):
    """A smooth closed contour through the points of a CSV file with the columns x and y, which have units in their headings:
    `x [mm],y [mm]`. They may be given about any point: the pose of the body is that of its centre of mass, and a note says
    where that is among them."""

    part = Contour
    kind: Literal["contour"] = "contour"
    file: str = Field(description="the CSV file, from the folder of this one")
    tolerance: Annotated[float, Quantity("m", 1e-9, 1e-2)] = Field(
        default=1e-6, description="how far the contour may pass the points"
    )

    def arguments(self, folder: Path) -> tuple[tuple[str, Any], ...]:
        points = read_points(folder / self.file)
        return ("points", tuple((x, y) for x, y in points.tolist())), ("tolerance", self.tolerance)

    def build(self, folder: Path) -> Any:
        with at_field("file"):
            return super().build(folder)


if TYPE_CHECKING:
    ShapeTable = PartTable
else:
    ShapeTable = one_of(
        table_of(Circle, "circle"),
        table_of(Ellipse, "ellipse"),
        table_of(Superellipse, "superellipse"),
        table_of(RoundedBox, "rounded_box"),
        table_of(RoundedPolygon, "rounded_polygon"),
        ContourTable,
    )
