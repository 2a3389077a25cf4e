"""Interface of a pad's mesh, its stiffness and compliance."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import permutations
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.csgraph import reverse_cuthill_mckee
from torch import Tensor

from torchsoft.physics.mesh.element import (
    QUADRILATERAL,
    Array,
    element_stiffness,
    gradients,
)

Index = NDArray[np.int64]

MEMORY = 8.0
"""Largest memory [GiB] that condensing a mesh may need."""


Modulus = TypeVar("Modulus", float, Tensor)


def lame_moduli(E: Modulus, nu: Modulus) -> tuple[Modulus, Modulus]:
    """lambda = E nu / ((1 + nu)(1 - 2 nu)), mu = E / (2 (1 + nu)), in the unit of E."""
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def dofs_of(nodes: Index) -> Index:
    """Degrees of freedom (2 n,) of nodes (n,): x and y of each."""
    return (2 * nodes[:, None] + np.arange(2)).ravel()


def quads(number: Index) -> Index:
    """Elements (n, 4) of a grid of nodes, anticlockwise, by the nodes' numbers (columns, rows)."""
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    return np.stack(corners, -1).reshape(-1, 4)


class Mesh:
    """A pad's mesh in its own frame: it gives `nodes` (N, 2) [m], `elements` (n, 4) anticlockwise,
    which nodes are `bonded`, and `face`, the nodes along the free surface from left to right; its
    extents `length` and `height` [m] along x and y, and how many elements are along the face and,
    about, through it.

    Meshes of the same description are equal and have one hash, so that results of one serve all.
    """

    nodes: Any
    elements: Any
    bonded: Any
    face: Any
    length: Any
    height: Any
    elements_x: Any
    elements_y: Any
    element: Any = QUADRILATERAL

    numbers: Any = "the elements of its file"
    """Arguments that say how many elements it has, for messages."""

    def counts(self) -> tuple[int, int, int]:
        """Nodes on the face, nodes that move, and the largest difference between node numbers of
        one element, about."""
        return len(self.face), len(self.free), self.band

    @property
    def memory(self) -> float:
        """Memory [GiB] for condensing the mesh onto its surface, about: loads on the surface,
        displacements under them, their products, and the blocks of the factor."""
        surface, free, band = self.counts()
        return 8 * 4 * free * (4 * surface + 4 * min(band, free // band)) / 2**30

    def check_memory(self) -> None:
        """Raises `ValueError` for a mesh too fine to be condensed; inertial pads are condensed too,
        to find the start."""
        if (need := self.memory) > MEMORY:
            raise ValueError(
                f"{self.numbers} take about {need:.3g} GiB of memory, but {MEMORY:g} GiB are the "
                "most; take fewer"
            )

    def refined(self, finer: int) -> "Mesh":
        """The mesh of the same pad with `finer` times as many elements each way."""
        raise NotImplementedError

    @cached_property
    def free(self) -> Index:
        """Numbers of the nodes that move."""
        return np.flatnonzero(~self.bonded)

    @cached_property
    def surface(self) -> Index:
        """Numbers, among the free nodes, of those on the free surface, from left to right."""
        return np.searchsorted(self.free, self.face[~self.bonded[self.face]])

    @cached_property
    def tributary(self) -> Array:
        """Length of surface that each surface node stands for [m], shape (surface,)."""
        lengths = np.linalg.norm(np.diff(self.nodes[self.face], axis=0), axis=1)
        shares = 0.5 * (np.concatenate(([0.0], lengths)) + np.concatenate((lengths, [0.0])))
        return shares[~self.bonded[self.face]]

    @property
    def corners(self) -> Array:
        """Places of the nodes of every element (elements, nodes, 2) [m], or of the first (1, nodes,
        2) where all elements are alike."""
        return self.nodes[self.elements]

    def stiffness(
        self, lame_lambda: float, lame_mu: float, all_nodes: bool = False
    ) -> sparse.csr_array:
        """Global stiffness per depth, on the dofs of the free nodes or of all of them."""
        K = element_stiffness(self.element, self.corners, lame_lambda, lame_mu)
        dofs = dofs_of(self.elements.ravel()).reshape(len(self.elements), -1)
        shape = *dofs.shape, dofs.shape[1]
        row, column = (np.broadcast_to(x, shape).ravel() for x in (dofs[:, :, None], dofs[:, None]))
        entries, size = np.broadcast_to(K, shape).ravel(), 2 * len(self.nodes)
        full = sparse.csr_array((entries, (row, column)), shape=(size, size))
        keep = dofs_of(self.free)
        return full if all_nodes else full[keep][:, keep]

    @cached_property
    def areas(self) -> Array:
        """Lumped mass per density and depth of every node [m2], shape (N,)."""
        total = np.zeros(len(self.nodes))
        for xi, zeta, weight in self.element.distortion:
            _, determinant = gradients(self.element, self.nodes[self.elements], xi, zeta)
            share, _ = self.element.functions(xi, zeta)
            np.add.at(total, self.elements, weight * abs(determinant)[:, None] * share)
        return total

    @property
    def band(self) -> int:
        """Largest difference between node numbers of one element."""
        return int(np.ptp(self.elements, axis=1).max())

    @property
    def space(self) -> Array:
        """Two corners (2, 2) [m] of the rectangle in which the centre of a body must be to touch
        the pad."""
        low, high = self.nodes.min(0), self.nodes.max(0)
        return np.stack((low - self.length, high + self.length))

    @property
    def base(self) -> Array:
        """Two corners (2, 2) [m] of the rectangle around the bonded nodes."""
        held = self.nodes[self.bonded]
        return np.stack((held.min(0), held.max(0)))

    @cached_property
    def outline(self) -> Index:
        """Numbers of the nodes around the pad, anticlockwise."""
        return max(loops(self.elements), key=len)

    @cached_property
    def back(self) -> tuple[Array, NDArray[np.bool_]]:
        """The boundary behind the face: its corners (corners, 2) [m] from the face's right end
        round to the left one, and which of its sides (corners - 1,) are bonded and lie under the
        face, where a body would have to be in the pad's rigid base."""
        loop = next(one for one in loops(self.elements) if self.face[0] in one)
        loop = np.roll(loop, -int(np.flatnonzero(loop == self.face[0])[0]))
        behind = loop[: int(np.flatnonzero(loop == self.face[-1])[0]) + 1][::-1]
        x, face, around = (
            self.nodes[behind],
            self.nodes[self.face],
            self.nodes[np.append(loop, loop[0])],
        )
        way = np.diff(x, axis=0)
        inwards = np.stack((way[:, 1], -way[:, 0]), -1)
        under = self.bonded[behind[:-1]] & self.bonded[behind[1:]]
        for i in np.flatnonzero(under):
            hits = [first_hit(x[i] + 0.5 * way[i], inwards[i], line) for line in (face, around)]
            under[i] = hits[0] < (1 + STRAIGHT) * hits[1]
        straight = np.abs(way[1:, 0] * way[:-1, 1] - way[1:, 1] * way[:-1, 0]) <= (
            STRAIGHT * np.linalg.norm(way[1:], axis=1) * np.linalg.norm(way[:-1], axis=1)
        )
        corner = np.concatenate(([True], ~straight | (under[1:] != under[:-1]), [True]))
        return x[corner], under[corner[:-1]]

    @cached_property
    def sides(self) -> Index:
        """Nodes (sides, 2) of the elements' sides, each once."""
        return np.unique(np.sort(edges(self.elements), 1), axis=0)


class FreeMesh(Mesh):
    """A mesh whose nodes are in no rows and columns."""

    @property
    def length(self) -> float:
        return float(np.ptp(self.nodes[:, 0]))

    @property
    def height(self) -> float:
        return float(np.ptp(self.nodes[:, 1]))

    @property
    def elements_x(self) -> int:
        return len(self.face) - 1

    @property
    def elements_y(self) -> int:
        return max(1, round(len(self.elements) / self.elements_x))


@dataclass(frozen=True, eq=False)
class StoredMesh(FreeMesh):
    """The numbers of a mesh, as files keep them."""

    nodes: Array
    elements: Index
    bonded: NDArray[np.bool_]
    face: Index


def edges(elements: Index) -> Index:
    """Sides of all elements (4 elements, 2), from node to node."""
    return np.stack((elements, np.roll(elements, -1, 1)), -1).reshape(-1, 2)


def boundary(elements: Index) -> Index:
    """Sides (sides, 2) that belong to one element only, with the elements to their left."""
    sides = edges(elements)
    _, first, count = np.unique(np.sort(sides, 1), axis=0, return_index=True, return_counts=True)
    return sides[first[count == 1]]


def loops(elements: Index) -> list[Index]:
    """Numbers of the nodes around the elements, anticlockwise, and around each hole, clockwise."""
    after = {int(a): int(b) for a, b in boundary(elements)}
    found: list[Index] = []
    while after:
        start, node = after.popitem()
        loop = [start]
        while node != start:
            loop.append(node)
            node = after.pop(node)
        found.append(np.array(loop))
    return found


STRAIGHT = 1e-9
"""Sine of the angle between two sides of an outline up to which they are one."""

AHEAD = 1e-6
"""Distance, over the length of the direction, at which `first_hit` starts to look."""


def first_hit(start: Array, direction: Array, line: Array) -> float:
    """Distance, in lengths of the direction (2,), at which a ray from a point (2,) first meets a
    line through points (points, 2); infinite where it does not."""
    way, to = np.diff(line, axis=0), line[:-1] - start
    cross = direction[0] * way[:, 1] - direction[1] * way[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (to[:, 0] * way[:, 1] - to[:, 1] * way[:, 0]) / cross
        part = (to[:, 0] * direction[1] - to[:, 1] * direction[0]) / cross
    hit = (along > AHEAD) & (part >= -STRAIGHT) & (part <= 1 + STRAIGHT)
    return float(along[hit].min(initial=np.inf))


def in_band(nodes: Array, elements: Index) -> Index:
    """The order of the nodes in which those of one element are close to each other (reverse
    Cuthill-McKee)."""
    pairs = np.array([*permutations(range(elements.shape[1]), 2)])
    rows, cols = elements[:, pairs[:, 0]].ravel(), elements[:, pairs[:, 1]].ravel()
    graph = sparse.csr_array((np.ones(len(rows)), (rows, cols)), shape=(len(nodes), len(nodes)))
    return reverse_cuthill_mckee(sparse.csr_matrix(graph), symmetric_mode=True).astype(np.int64)


# Compliance of a pad's surface.


SMALLEST_BLOCK = 96
"""Rows of a block at least: fewer cost more in calls than they save."""


@torch.no_grad()
def solved(matrix: sparse.csr_array, loads: Array) -> Array:
    """X (n, k) of matrix X = loads for a symmetric positive definite sparse matrix: a block
    Cholesky factorisation in the order of the smallest band, so that an interrupt is heard between
    any two blocks."""
    order = csgraph.reverse_cuthill_mckee(matrix, symmetric_mode=True)
    A = matrix[order][:, order]
    row, col = A.nonzero()
    size = max(SMALLEST_BLOCK, abs(row - col).max())
    blocks = [slice(k, k + size) for k in range(0, len(order), size)]
    dense = lambda rows, columns: torch.from_numpy(A[rows, columns].toarray())
    X = [torch.from_numpy(loads[order[here]]) for here in blocks]
    diagonal, below = [], []  # of the factor: L_kk and L_(k+1)k
    for k, here in enumerate(blocks):
        D = dense(here, here)
        if k:
            D -= below[-1] @ below[-1].mT
            X[k] -= below[-1] @ X[k - 1]
        diagonal.append(torch.linalg.cholesky(D))
        X[k] = torch.linalg.solve_triangular(diagonal[k], X[k], upper=False)
        if k + 1 < len(blocks):
            below.append(
                torch.linalg.solve_triangular(
                    diagonal[k], dense(here, blocks[k + 1]), upper=False
                ).mT
            )
    for k in reversed(range(len(blocks))):
        if k + 1 < len(blocks):
            X[k] -= below[k].mT @ X[k + 1]
        X[k] = torch.linalg.solve_triangular(diagonal[k].mT, X[k], upper=True)
    out = np.empty_like(loads)
    for here, part in zip(blocks, X):
        out[order[here]] = part.numpy()
    return out


def unit_loads(size: int, dofs: Index) -> Array:
    """One load (size, dofs) on each of some dofs."""
    loads = np.zeros((size, len(dofs)))
    loads[dofs, np.arange(len(dofs))] = 1.0
    return loads


def lame_slopes(nu: float) -> tuple[float, float]:
    """Derivatives by nu of the Lame moduli for E = 1."""
    with torch.inference_mode(False), torch.enable_grad():
        nu_ = torch.tensor(nu, dtype=torch.float64, requires_grad=True)
        both = lame_moduli(torch.ones_like(nu_), nu_)
        first, second = (torch.autograd.grad(x, nu_, retain_graph=True)[0].item() for x in both)
    return first, second


@lru_cache(maxsize=16)
def unit_compliance(mesh: Mesh, nu: float) -> tuple[Array, Array]:
    """Displacements of the surface per force on it, (K^-1)_ss for E depth = 1, and their derivative
    by nu, -K^-1 (dK/dnu) K^-1, both (2 surface, 2 surface)."""
    surface = dofs_of(mesh.surface)
    X = solved(mesh.stiffness(*lame_moduli(1.0, nu)), unit_loads(2 * len(mesh.free), surface))
    return X[surface], -(X.T @ (mesh.stiffness(*lame_slopes(nu)) @ X))
