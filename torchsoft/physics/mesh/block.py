"""Meshes from a few numbers: blocks, whose nodes are numbered column by column, which keeps the
matrices banded, and half-round fingertips."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isfinite, isnan
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from torchsoft.physics.arguments import names, number, positive, whole
from torchsoft.physics.mesh.mesh import (
    Array,
    FreeMesh,
    Index,
    Mesh,
    in_band,
    quads,
)
from torchsoft.quantity import Length, Quantity, check_declared

SLENDER = 1e4
"""Largest ratio of the sides of an element; the stiffness is lost in rounding near 1e7."""

SIDES = ("base", "left", "right")
"""Edges of a block that may be bonded; the fourth is its face."""


@dataclass(frozen=True)
class PadMesh(Mesh):
    """A rectangular block with a corner at the origin: bonded at y = 0, free at y = `height` [m].
    The sides at x = 0 and at x = `length` [m] may be bonded as well."""

    length: Annotated[Length, "length along the surface"]
    height: Annotated[Length, "thickness"]
    elements_x: Annotated[
        int, Quantity("1", 1, 100_000, "finite elements along it; 1 mm each is usual")
    ]
    elements_y: Annotated[int, Quantity("1", 1, 1000, "finite elements through it")]
    bonded_sides: Annotated[bool, "bonded at both ends as well"] = False

    def __post_init__(self) -> None:
        for name in ("length", "height"):
            positive(name, getattr(self, name))
        for name in ("elements_x", "elements_y"):
            whole(name, getattr(self, name), 1)
        check_declared(self, "length", "height", "elements_x", "elements_y")
        wide, tall = self.length / self.elements_x, self.height / self.elements_y
        if not 1 / SLENDER <= wide / tall <= SLENDER:
            raise ValueError(
                f"elements of {wide:.3g} m by {tall:.3g} m are too slender to be computed with; "
                "take a `length` and a `height` nearer to each other, or other numbers of elements"
            )

    @property
    def numbers(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return f"elements_x = {self.elements_x} by elements_y = {self.elements_y}"

    def counts(self) -> tuple[int, int, int]:
        return self.elements_x + 1, (self.elements_x + 1) * self.elements_y, self.elements_y + 2

    def refined(self, finer: int) -> Mesh:
        return replace(self, elements_x=finer * self.elements_x, elements_y=finer * self.elements_y)

    @cached_property
    def nodes(self) -> Array:
        """Reference positions [m], shape (N, 2): columns are vertical, layers share the height."""
        x = np.linspace(0, self.length, self.elements_x + 1)
        part = np.linspace(0, 1, self.elements_y + 1)
        y = part * self.profile(x)[:, None]
        return np.stack((np.broadcast_to(x[:, None], y.shape), y), -1).reshape(-1, 2)

    def profile(self, x: Array) -> Array:
        """Height of the face [m] at x [m]."""
        return np.full_like(x, self.height)

    @property
    def grid(self) -> Index:
        """Numbers of the nodes, (elements_x + 1, elements_y + 1)."""
        return np.arange((self.elements_x + 1) * (self.elements_y + 1)).reshape(
            self.elements_x + 1, self.elements_y + 1
        )

    @cached_property
    def elements(self) -> Index:
        """Node numbers of each element, anticlockwise, shape (elements, 4)."""
        return quads(self.grid)

    def edge(self, name: str) -> Index:
        """Numbers of the nodes on an edge of the block."""
        number = self.grid
        return {
            "base": number[:, 0],
            "left": number[0],
            "right": number[-1],
            "face": number[:, -1],
        }[name]

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

    @property
    def corners(self) -> Array:
        return self.nodes[self.elements[:1]]

    @property
    def space(self) -> Array:
        return np.array([[0.0, -self.length], [self.length, self.length]])


FaceRadius = Annotated[
    float,
    Quantity("m", -1e3, 1e3, "radius of the face, at least half of the length; negative: hollow"),
]


@dataclass(frozen=True)
class CurvedPadMesh(PadMesh):
    """A block whose face is an arc of `radius` [m], flat where that is infinite: it bulges to the
    `height` [m] in the middle, or with a negative radius is hollow down to it. `bonded_edges` are
    some of "base", "left" and "right".

    Raises `ValueError` for an arc that does not span the length, or leaves nothing of the sides or
    of the middle.
    """

    radius: FaceRadius = inf
    bonded_edges: Annotated[
        tuple[str, ...], 'edges that are bonded: of "base", "left", "right"'
    ] = SIDES[:1]

    def __post_init__(self) -> None:
        super().__post_init__()
        names("bonded_edges", self.bonded_edges, SIDES)
        number("radius", self.radius)
        if isnan(self.radius) or not abs(self.radius) >= 0.5 * self.length:
            raise ValueError(
                f"`radius` must be at least half of the length, {0.5 * self.length:g} m, but is "
                f"{self.radius!r}"
            )
        if isfinite(self.radius):
            check_declared(self, "radius")
        if not self.profile(np.array([0.0]))[0] > 0:
            raise ValueError(
                f"`radius` {self.radius:g} m makes the arc deeper than the `height` of "
                f"{self.height:g} m"
            )
        if self.bonded_sides:
            raise ValueError(
                "`bonded_sides` must be left out: the edges are told by `bonded_edges`"
            )

    def held(self) -> tuple[str, ...]:
        return self.bonded_edges

    def profile(self, x: Array) -> Array:
        if self.radius in (inf, -inf):
            return super().profile(x)
        R, off = abs(self.radius), x - 0.5 * self.length
        return self.height - np.sign(self.radius) * off**2 / (R + np.sqrt(R**2 - off**2))

    @property
    def corners(self) -> Array:
        return self.nodes[self.elements]


CORE = 0.5
"""Half of the width of the core, and its height, over the radius."""


@dataclass(frozen=True)
class FingertipMesh(FreeMesh):
    """Half of a disc of `radius` [m], bonded along its diameter at y = 0 from x = 0 to 2 `radius`.
    Its face is the half circle, of `elements_around` elements of equal length, a multiple of four.

    Layers of elements, about as high as long, lead inwards to a core of rectangles. Raises
    `ValueError` for other numbers.
    """

    radius: Annotated[Length, "radius"]
    elements_around: Annotated[
        int,
        Quantity(
            "1",
            4,
            100_000,
            "finite elements along the half circle, a multiple of 4; 1 mm each is usual",
        ),
    ]

    def __post_init__(self) -> None:
        positive("radius", self.radius)
        whole("elements_around", self.elements_around, 4)
        check_declared(self, "radius", "elements_around")
        if self.elements_around % 4:
            raise ValueError(
                f"`elements_around` must be a multiple of 4, but is {self.elements_around}"
            )

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
        """Number of layers of elements around the core."""
        return max(1, round((1 - CORE) * self.elements_around / np.pi))

    @cached_property
    def whole_mesh(self) -> tuple[Array, Index, Index]:
        """Nodes, elements, and nodes along the face."""
        R, k = self.radius, self.elements_around // 4
        layers = self.layers
        x, y = np.linspace(-CORE, CORE, 2 * k + 1) * R, np.linspace(0, CORE, k + 1) * R
        core = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        number = np.arange(len(core)).reshape(2 * k + 1, k + 1)
        inner = np.concatenate(
            (number[0, :-1], number[:-1, -1], number[-1, ::-1])
        )  # up, to the right, and down
        angle = np.pi * (1 - np.arange(4 * k + 1) / (4 * k))
        outer = R * np.stack((np.cos(angle), np.sin(angle)), -1)
        outer[[0, -1], 1] = 0.0
        part = np.arange(1, layers + 1)[:, None, None] / layers
        ring = core[inner] + part * (outer - core[inner])
        rows = np.concatenate(
            (inner[None], len(core) + np.arange(layers * (4 * k + 1)).reshape(layers, -1))
        )
        elements = np.concatenate((quads(number), quads(rows)[:, [0, 3, 2, 1]]))
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
