"""Any mesh of quadrilaterals, from numbers or from a file."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from torchsoft.display import suggestion
from torchsoft.physics.arguments import places
from torchsoft.physics.mesh.element import CORNERS, gradients
from torchsoft.physics.mesh.files import read_quads
from torchsoft.physics.mesh.mesh import (
    Array,
    FreeMesh,
    Index,
    Mesh,
    boundary,
    edges,
    in_band,
    quads,
)

Numbers = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class QuadMesh(FreeMesh):
    """Quadrilaterals, four numbers of `points` (x, y) [m] each, with the sides, two numbers each,
    that are its free face and those that are bonded. The face looks up: from left to right, the pad
    is on its right hand.

    Raises `ValueError` for quadrilaterals that are folded or not connected, for sides that are not
    on the boundary, for a face that is not one open line, and for a pad that is bonded nowhere.
    """

    points: tuple[tuple[float, float], ...]
    quads: Numbers
    face_sides: Numbers
    bonded_sides: Numbers

    @classmethod
    def of(cls, points: Any, quads: Any, face: Any, bonded: Any) -> Self:
        """From arrays: points (n, 2) [m], quads (m, 4), sides (., 2)."""
        x = tuple((float(x), float(y)) for x, y in places("points", points).tolist())
        return cls(
            x, *(tuple(tuple(map(int, row)) for row in rows) for rows in (quads, face, bonded))
        )

    @classmethod
    def read(
        cls, path: str | Path, *, unit: str, face: str = "face", bonded: Iterable[str] = ("base",)
    ) -> Self:
        """From a file that meshio reads, with coordinates in `unit` (m, cm or mm): its
        quadrilaterals, and the names of the face and of the bonded edges among its groups of lines
        (in gmsh physical curves), sets of nodes, and curves. Raises `ValueError` naming the
        file."""
        points, quads, groups = read_quads(path, unit)
        try:
            for name in (face, *bonded):
                if name not in groups:
                    raise ValueError(
                        f"there is no edge `{name}`; {suggestion(name, groups, 'there are')}; name "
                        "a group of lines or a set of nodes"
                    )
            return cls.of(
                points,
                quads,
                groups[face],
                np.concatenate([groups[name] for name in bonded] or [[]]),
            )
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def __post_init__(self) -> None:
        if not len(self.quads) or any(len(quad) != 4 for quad in self.quads):
            raise ValueError("`quads` must be quadrilaterals of four numbers of points")
        given = np.array(self.quads)
        if given.min() < 0 or given.max() >= len(self.points):
            raise ValueError(f"`quads` must be numbers of the {len(self.points)} points, from 0 on")
        nodes, elements = self.nodes, self.elements
        worst = np.min(
            [gradients(self.element, nodes[elements], *at)[1] for at in CORNERS.tolist()], axis=0
        )
        if not worst.min() > 0:
            raise ValueError(
                f"quadrilateral {int(worst.argmin())} is folded: it has an angle of 180 degrees or "
                "more"
            )
        sides = edges(elements)
        graph = sparse.csr_array(
            (np.ones(len(sides)), (sides[:, 0], sides[:, 1])), shape=(len(nodes), len(nodes))
        )
        if connected_components(graph, directed=False)[0] > 1:
            raise ValueError(
                "the quadrilaterals are not connected: points that are the same must have one "
                "number"
            )
        outside = {frozenset(side) for side in boundary(elements).tolist()}
        for name in ("face_sides", "bonded_sides"):
            found = getattr(self, name)
            if not found:
                raise ValueError(f"`{name}` must be sides of quadrilaterals, but there are none")
            for side in found:
                if (
                    len(side) != 2
                    or not {*side} <= self.number.keys()
                    or {self.number[i] for i in side} not in outside
                ):
                    raise ValueError(f"`{name}` has {side}, which is no side on the boundary")
        if len(self.surface) < 2:
            raise ValueError("fewer than two points of the face are free")

    @cached_property
    def number(self) -> dict[int, int]:
        """Node number by point number; points that belong to no quadrilateral are left out."""
        used, elements = np.unique(np.array(self.quads), return_inverse=True)
        order = in_band(np.array(self.points)[used], elements.reshape(-1, 4))
        return {int(used[old]): new for new, old in enumerate(order)}

    @cached_property
    def nodes(self) -> Array:
        """Reference positions [m], shape (N, 2)."""
        return np.array([self.points[i] for i in self.number])

    @cached_property
    def elements(self) -> Index:
        """Node numbers of each element, anticlockwise, shape (elements, 4)."""
        elements = np.array([[self.number[i] for i in quad] for quad in self.quads])
        x, y = self.nodes[elements].transpose(2, 0, 1)
        clockwise = (x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(1) < 0
        return np.where(clockwise[:, None], elements[:, ::-1], elements)

    @cached_property
    def face(self) -> Index:
        """Numbers of the nodes along the face."""
        sides = {frozenset(self.number[i] for i in side) for side in self.face_sides}
        before = {
            int(b): int(a)
            for a, b in boundary(self.elements)
            if frozenset((int(a), int(b))) in sides
        }
        starts = before.keys() - before.values()
        if len(starts) != 1:
            raise ValueError("`face_sides` must be one line with two ends")
        chain = [starts.pop()]
        while chain[-1] in before:
            chain.append(before[chain[-1]])
        if len(chain) != len(before) + 1:
            raise ValueError("`face_sides` must be one line with two ends")
        return np.array(chain)

    @cached_property
    def bonded(self) -> NDArray[np.bool_]:
        """Nodes on bonded sides, shape (N,)."""
        held = np.zeros(len(self.nodes), np.bool_)
        held[[self.number[i] for side in self.bonded_sides for i in side]] = True
        return held

    def refined(self, finer: int) -> Mesh:
        """Every quadrilateral divided; curved edges stay as straight between the points as they
        are."""
        known: dict[frozenset[tuple[int, int]], int] = {}
        points: list[Array] = []

        def at(corners: Sequence[int], weights: Sequence[int]) -> int:
            """Number of a new point between corners; it is the same from every element."""
            used = [(corner, weight) for corner, weight in zip(corners, weights) if weight]
            number = known.setdefault(frozenset(used), len(points))
            if number == len(points):
                points.append(
                    np.average(
                        [self.points[i] for i, _ in used], axis=0, weights=[w for _, w in used]
                    )
                )
            return number

        n, divided = range(finer + 1), list[Index]()
        for quad in self.quads:
            number = np.array(
                [
                    [
                        at(
                            quad,
                            ((finer - i) * (finer - j), i * (finer - j), i * j, (finer - i) * j),
                        )
                        for j in n
                    ]
                    for i in n
                ]
            )
            divided.append(quads(number))
        sides = [
            [
                [at(side, (finer * (finer - k - i), finer * (k + i))) for i in (0, 1)]
                for side in old
                for k in range(finer)
            ]
            for old in (self.face_sides, self.bonded_sides)
        ]
        return QuadMesh.of(np.array(points), np.concatenate(divided), *sides)
