"""Blocks: regular meshes whose nodes are numbered column by column, which keeps the matrices banded."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isnan
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from torchsoft.physics.arguments import names, number, positive, whole
from torchsoft.physics.mesh.element import Array, element_matrices
from torchsoft.physics.mesh.mesh import Index, Mesh
from torchsoft.quantity import Length, Quantity

SIDES = ("base", "left", "right")
"""Edges of a block that may be bonded; the fourth is its face."""


@dataclass(frozen=True)
class PadMesh(Mesh):
    """A rectangular block with a corner at the origin: bonded at y = 0, free at y = `height` [m]. The sides at x = 0 and at
    x = `length` [m] may be bonded as well."""

    length: Annotated[Length, "length along the surface"]
    height: Annotated[Length, "thickness"]
    elements_x: Annotated[int, Quantity("1", 1, 100_000, "finite elements along it; 1 mm each is usual")]
    elements_y: Annotated[int, Quantity("1", 1, 1000, "finite elements through it")]
    bonded_sides: Annotated[bool, "bonded at both ends as well"] = False

    def __post_init__(self) -> None:
        for name in ("length", "height"):
            positive(name, getattr(self, name))
        for name in ("elements_x", "elements_y"):
            whole(name, getattr(self, name), 1)

    @property
    def numbers(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return f"elements_x = {self.elements_x} by elements_y = {self.elements_y}"

    def counts(self) -> tuple[int, int, int]:
        return self.elements_x + 1, (self.elements_x + 1) * self.elements_y, self.elements_y + 2

    def refined(self, finer: int) -> Mesh:
        return replace(self, elements_x=finer * self.elements_x, elements_y=finer * self.elements_y)

    @cached_property
    def nodes(self) -> Array:
        """Reference positions [m], shape (N, 2)."""
        x = np.linspace(0, self.length, self.elements_x + 1)
        y = np.linspace(0, self.height, self.elements_y + 1)
        return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)

    @property
    def grid(self) -> Index:
        """Numbers of the nodes, (elements_x + 1, elements_y + 1)."""
        return np.arange((self.elements_x + 1) * (self.elements_y + 1)).reshape(
            self.elements_x + 1, self.elements_y + 1
        )

    @cached_property
    def elements(self) -> Index:
        """Node numbers of each element, anticlockwise, shape (elements, 4)."""
        number = self.grid
        corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        return np.stack(corners, -1).reshape(-1, 4)

    def edge(self, name: str) -> Index:
        """Numbers of the nodes on an edge of the block."""
        number = self.grid
        return {"base": number[:, 0], "left": number[0], "right": number[-1], "face": number[:, -1]}[name]

    def held(self) -> tuple[str, ...]:
        """Edges held by the ground or the bracket: the base, and the sides of an enclosed pad."""
        return SIDES if self.bonded_sides else SIDES[:1]

    @cached_property
    def bonded(self) -> NDArray[np.bool_]:
        """Nodes on edges that are held, shape (N,)."""
        held = np.zeros(len(self.nodes), np.bool_)
        for name in self.held():
            held[self.edge(name)] = True
        return held

    @cached_property
    def face(self) -> Index:
        """Numbers of the nodes on the free surface."""
        return self.edge("face")

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array]:
        """Element matrices K_lambda, K_mu, M (8, 8): all elements are alike."""
        K_lambda, K_mu, M = element_matrices(self.nodes[self.elements[0]])
        return K_lambda, K_mu, M

    @property
    def space(self) -> Array:
        return np.array([[0.0, -self.length], [self.length, self.length]])

    def lines(self, columns: int) -> list[Index]:
        number = self.grid
        return [*number.T, *number[::columns], number[-1]]


FaceRadius = Annotated[
    float, Quantity("m", -1e3, 1e3, "radius of the face, at least half of the length; negative: hollow")
]


@dataclass(frozen=True)
class CurvedPadMesh(PadMesh):
    """A block whose face is an arc of `radius` [m], flat where that is infinite: it bulges to the `height` [m] in the middle,
    or with a negative radius is hollow down to it. `bonded_edges` are some of "base", "left" and "right".

    Raises `ValueError` for an arc that does not span the length, or leaves nothing of the sides or of the middle.
    """

    radius: FaceRadius = inf
    bonded_edges: Annotated[tuple[str, ...], 'edges that are bonded: of "base", "left", "right"'] = SIDES[:1]

    def __post_init__(self) -> None:
        super().__post_init__()
        names("bonded_edges", self.bonded_edges, SIDES)
        number("radius", self.radius)
        if isnan(self.radius) or not abs(self.radius) >= 0.5 * self.length:
            raise ValueError(
                f"`radius` must be at least half of the length, {0.5 * self.length:g} m, but is {self.radius!r}"
            )
        if not self.profile(np.array([0.0]))[0] > 0:
            raise ValueError(f"`radius` {self.radius:g} m makes the arc deeper than the `height` of {self.height:g} m")
        if self.bonded_sides:
            raise ValueError("`bonded_sides` must be left out: the edges are told by `bonded_edges`")

    def held(self) -> tuple[str, ...]:
        return self.bonded_edges

    def profile(self, x: Array) -> Array:
        """Height of the face [m] at x [m]."""
        if self.radius in (inf, -inf):
            return np.full_like(x, self.height)
        R, off = abs(self.radius), x - 0.5 * self.length
        return self.height - np.sign(self.radius) * off**2 / (R + np.sqrt(R**2 - off**2))

    @cached_property
    def nodes(self) -> Array:
        """Reference positions [m], shape (N, 2): columns are vertical, layers share the height."""
        x = np.linspace(0, self.length, self.elements_x + 1)
        part = np.linspace(0, 1, self.elements_y + 1)
        y = part * self.profile(x)[:, None]
        return np.stack((np.broadcast_to(x[:, None], y.shape), y), -1).reshape(-1, 2)

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array]:
        return element_matrices(self.nodes[self.elements])
