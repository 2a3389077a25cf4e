"""The shape of the rigid object: a signed distance and its gradient, in the object's own frame.

The contact model asks nothing else of the object, so another shape is another class here and another branch in
the kernel's `body_distance`.
"""

from typing import Protocol

import torch
from torch import Tensor, nn


class Shape(Protocol):
    """What the contact model asks of a rigid object."""

    def signed_distance(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Distance phi [m], shape (...), negative inside, and outward unit normal, shape (..., 2), at x (..., 2) [m]."""
        ...


class Circle(nn.Module):
    """A disc of radius R [m] about its centre of mass. Not smooth at the centre."""

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = nn.Parameter(torch.tensor(radius, dtype=torch.float64))

    def signed_distance(self, x: Tensor) -> tuple[Tensor, Tensor]:
        d = torch.linalg.vector_norm(x, dim=-1)
        return d - self.radius, x / d[..., None]
