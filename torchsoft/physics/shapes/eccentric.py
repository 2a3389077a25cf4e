"""A shape of a body whose centre of mass is off that of its area."""

from typing import Annotated

import torch
from torch import Tensor

from torchsoft.physics.shapes.shape import Shape, parameter
from torchsoft.quantity import Quantity

Offset = Annotated[float, Quantity("m", -1.0, 1.0)]
"""Coordinate of a centre of mass in the frame of a shape."""

CentreX = Annotated[Offset, "centre of mass of the body in the frame of its shape, along its own x"]
CentreY = Annotated[Offset, "centre of mass of the body in the frame of its shape, along its own y"]


class Eccentric(Shape):
    """The shape `contour` of a body whose centre of mass is at (`centre_x`, `centre_y`) [m] in the
    frame of the contour: the body's pose and moments are those of that point.

    The squared radius of gyration is that of a uniform density about the contour's own centre.
    """

    def __init__(self, contour: Shape, centre_x: CentreX = 0.0, centre_y: CentreY = 0.0) -> None:
        super().__init__()
        self.contour = contour
        self.centre_x, self.centre_y = (
            parameter(centre_x, "centre_x"),
            parameter(centre_y, "centre_y"),
        )

    @property
    def centre(self) -> Tensor:
        """Centre of mass (2,) [m] in the frame of the contour."""
        return torch.stack((self.centre_x, self.centre_y))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.contour(x + self.centre)

    def prepared(self) -> Shape:
        contour = self.contour.prepared()
        if contour is self.contour:
            return self
        made = Eccentric(contour)
        made._parameters.update(self._parameters)
        return made

    def area(self) -> Tensor:
        return self.contour.area()

    def gyration(self) -> Tensor:
        return self.contour.gyration()

    def support(self, direction: Tensor) -> Tensor:
        return self.contour.support(direction) - direction @ self.centre

    @torch.no_grad()
    def outline(self, points: int = 181) -> Tensor:
        return self.contour.outline(points) - self.centre
