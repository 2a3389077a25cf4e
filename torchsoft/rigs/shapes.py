"""Shapes of bodies in a rig file. Another one is another class here, and one more name in `ShapeTable`."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from torchsoft.physics.shapes import Circle, Ellipse, Shape
from torchsoft.rigs.fields import Group, Length


class CircleTable(Group):
    """A disc."""

    kind: Literal["circle"] = "circle"
    radius: Length = Field(description="radius")

    def build(self, folder: Path) -> Shape:
        """The shape; `folder` is where a file that a table names lies."""
        return Circle(self.radius)


class EllipseTable(Group):
    """An ellipse; the half-axes may differ by a factor of three."""

    kind: Literal["ellipse"] = "ellipse"
    a: Length = Field(description="half-axis along the body's own x")
    b: Length = Field(description="half-axis along the body's own y")

    def build(self, folder: Path) -> Shape:
        return Ellipse(self.a, self.b)


ShapeTable = Annotated[CircleTable | EllipseTable, Field(discriminator="kind")]
