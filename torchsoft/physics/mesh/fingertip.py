"""A half-round fingertip."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from torchsoft.physics.arguments import positive, whole
from torchsoft.physics.mesh.element import Array
from torchsoft.physics.mesh.mesh import FreeMesh, Index, Mesh, in_band
from torchsoft.quantity import Length, Quantity

CORE = 0.5
"""Half of the width of the core, and its height, over the radius."""


@dataclass(frozen=True)
class FingertipMesh(FreeMesh):
    """Half of a disc of `radius` [m], bonded along its diameter at y = 0 from x = 0 to 2 `radius`. Its face is the half circle,
    of `elements_around` elements of equal length, a multiple of four.

    Layers of elements, about as high as long, lead inwards to a core of rectangles. Raises `ValueError` for other numbers.
    """

    radius: Annotated[Length, "radius"]
    elements_around: Annotated[
        int, Quantity("1", 4, 100_000, "finite elements along the half circle, a multiple of 4; 1 mm each is usual")
    ]

    def __post_init__(self) -> None:
        positive("radius", self.radius)
        if whole("elements_around", self.elements_around, 4) % 4:
            raise ValueError(f"`elements_around` must be a multiple of 4, but is {self.elements_around}")

    @property
    def numbers(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return f"elements_around = {self.elements_around}"

    def counts(self) -> tuple[int, int, int]:
        k = self.elements_around // 4
        return 4 * k + 1, (2 * k + 1) * k + self.layers * (4 * k - 1), 4 * k + 2

    def refined(self, finer: int) -> Mesh:
        return replace(self, elements_around=finer * self.elements_around)

    @property
    def layers(self) -> int:
        """Of elements around the core."""
        return max(1, round((1 - CORE) * self.elements_around / np.pi))

    @cached_property
    def whole_mesh(self) -> tuple[Array, Index, Index]:
        """Nodes, elements, and nodes along the face."""
        R, k = self.radius, self.elements_around // 4
        layers = self.layers
        x, y = np.linspace(-CORE, CORE, 2 * k + 1) * R, np.linspace(0, CORE, k + 1) * R
        core = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        number = np.arange(len(core)).reshape(2 * k + 1, k + 1)
        inner = np.concatenate((number[0, :-1], number[:-1, -1], number[-1, ::-1]))  # up, to the right, and down
        angle = np.pi * (1 - np.arange(4 * k + 1) / (4 * k))
        outer = R * np.stack((np.cos(angle), np.sin(angle)), -1)
        outer[[0, -1], 1] = 0.0
        part = np.arange(1, layers + 1)[:, None, None] / layers
        ring = core[inner] + part * (outer - core[inner])
        rows = np.concatenate((inner[None], len(core) + np.arange(layers * (4 * k + 1)).reshape(layers, -1)))
        squares = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        sectors = rows[:-1, :-1], rows[:-1, 1:], rows[1:, 1:], rows[1:, :-1]
        elements = np.concatenate([np.stack(corners, -1).reshape(-1, 4) for corners in (squares, sectors)])
        nodes = np.concatenate((core, ring.reshape(-1, 2))) + [R, 0.0]
        order = in_band(nodes, elements)
        place = np.argsort(order)
        return nodes[order], place[elements], place[rows[-1]]

    @property
    def nodes(self) -> Array:
        """Reference positions [m], shape (N, 2)."""
        return self.whole_mesh[0]

    @property
    def elements(self) -> Index:
        """Node numbers of each element, anticlockwise, shape (elements, 4)."""
        return self.whole_mesh[1]

    @property
    def face(self) -> Index:
        """Numbers of the nodes on the half circle."""
        return self.whole_mesh[2]

    @property
    def bonded(self) -> NDArray[np.bool_]:
        """Nodes on the diameter, shape (N,)."""
        return self.nodes[:, 1] == 0
