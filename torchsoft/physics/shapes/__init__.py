"""Shapes of rigid bodies: signed distance and outward normal, in the body's own frame about its
centre of mass.

The contact asks nothing else of a body, so another shape is another class with a `forward`, from
which the compiled kernels are generated.
"""

from torchsoft.physics.shapes.contour import Contour
from torchsoft.physics.shapes.eccentric import Eccentric
from torchsoft.physics.shapes.rounded import (
    Circle,
    Ellipse,
    RoundedBox,
    RoundedPolygon,
    Superellipse,
)
from torchsoft.physics.shapes.shape import Shape, parameter

__all__ = [
    "Circle",
    "Contour",
    "Eccentric",
    "Ellipse",
    "RoundedBox",
    "RoundedPolygon",
    "Shape",
    "Superellipse",
    "parameter",
]
