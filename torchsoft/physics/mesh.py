"""Finite elements of a pad: Q4 plane strain on a regular mesh, in the pad's own frame.

The bonded base is at y = 0, the free surface at y = height. Nodes are numbered column by column, which keeps the matrices
banded.

Every stiffness is linear in the two Lame moduli, K = depth (lambda K_lambda + mu K_mu). The dilatational part is
integrated at the element's centre and the shear part at 2 x 2 points (selective reduced integration), which is free
of volumetric locking and of hourglass modes.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import linalg, sparse
from torch import Tensor

from torchsoft.physics.arguments import positive, whole

Array = NDArray[np.float64]


Modulus = TypeVar("Modulus", float, Tensor)


def lame_moduli(E: Modulus, nu: Modulus) -> tuple[Modulus, Modulus]:
    """lambda = E nu / ((1 + nu)(1 - 2 nu)), mu = E / (2 (1 + nu)), in the unit of E."""
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def element_matrices(a: float, b: float) -> tuple[Array, Array, Array]:
    """K_lambda, K_mu (per modulus and depth) [1] and the consistent M (per density and depth) [m2], each (8, 8).

    Bilinear rectangle of sides a, b [m], nodes anticlockwise from the lower left, dofs (x, y) node by node.
    """
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)

    def strain(xi: float, zeta: float) -> tuple[Array, Array]:
        N = (1 + corner[:, 0] * xi) * (1 + corner[:, 1] * zeta) / 4
        dx = corner[:, 0] * (1 + corner[:, 1] * zeta) / 4 * 2 / a
        dy = corner[:, 1] * (1 + corner[:, 0] * xi) / 4 * 2 / b
        B = np.zeros((3, 8))
        B[0, 0::2], B[1, 1::2] = dx, dy
        B[2, 0::2], B[2, 1::2] = dy, dx
        return N, B

    area, gauss = a * b, 1 / np.sqrt(3)
    divergence = strain(0.0, 0.0)[1][:2].sum(0)
    K_lambda = area * np.outer(divergence, divergence)
    K_mu, M = np.zeros((8, 8)), np.zeros((8, 8))
    for xi in (-gauss, gauss):
        for zeta in (-gauss, gauss):
            N, B = strain(xi, zeta)
            K_mu += area / 4 * B.T @ np.diag([2.0, 2.0, 1.0]) @ B
            M += area / 4 * np.kron(np.outer(N, N), np.eye(2))
    return K_lambda, K_mu, M


@dataclass(frozen=True)
class PadMesh:
    """Regular mesh of a pad in its own frame, its bonded nodes, and the matrices of its free nodes."""

    length: float
    height: float
    elements_x: int
    elements_y: int
    bonded_sides: bool = False

    def __post_init__(self) -> None:
        for name in ("length", "height"):
            positive(name, getattr(self, name))
        for name in ("elements_x", "elements_y"):
            whole(name, getattr(self, name), 1)

    @cached_property
    def nodes(self) -> Array:
        """Reference positions [m], shape (N, 2)."""
        x = np.linspace(0, self.length, self.elements_x + 1)
        y = np.linspace(0, self.height, self.elements_y + 1)
        return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)

    @cached_property
    def elements(self) -> NDArray[np.int64]:
        """Node numbers of each element, anticlockwise, shape (elements, 4)."""
        number = np.arange(len(self.nodes)).reshape(self.elements_x + 1, self.elements_y + 1)
        corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        return np.stack(corners, -1).reshape(-1, 4)

    @cached_property
    def bonded(self) -> NDArray[np.bool_]:
        """Nodes held by the ground or the bracket, shape (N,): the base, and the sides of an enclosed pad."""
        x, y = self.nodes.T
        return (y == 0) | (self.bonded_sides & ((x == 0) | (x == self.length)))

    @cached_property
    def free(self) -> NDArray[np.int64]:
        """Numbers of the nodes that move."""
        return np.flatnonzero(~self.bonded)

    @cached_property
    def surface(self) -> NDArray[np.int64]:
        """Numbers, among the free nodes, of those on the free surface, from left to right."""
        return np.flatnonzero(self.nodes[self.free, 1] == self.height)

    @cached_property
    def tributary(self) -> Array:
        """Length of surface that each surface node stands for [m], shape (surface,)."""
        x = self.nodes[self.free[self.surface], 0]
        spacing = self.length / self.elements_x
        return spacing * np.where((x == 0) | (x == self.length), 0.5, 1.0)

    def assemble(self, element: Array, all_nodes: bool = False) -> sparse.csr_array:
        """Global matrix of one (8, 8) element matrix, on the dofs of the free nodes or of all of them."""
        dofs = (2 * self.elements[:, :, None] + np.arange(2)).reshape(-1, 8)
        rows, cols = np.repeat(dofs, 8, 1).ravel(), np.tile(dofs, (1, 8)).ravel()
        size = 2 * len(self.nodes)
        full = sparse.csr_array((np.tile(element.ravel(), len(dofs)), (rows, cols)), shape=(size, size))
        keep = (2 * self.free[:, None] + np.arange(2)).ravel()
        return full if all_nodes else full[keep][:, keep]

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array]:
        """Element matrices K_lambda, K_mu, M of this mesh."""
        return element_matrices(self.length / self.elements_x, self.height / self.elements_y)

    def banded_stiffness(self, lame_lambda: float, lame_mu: float) -> Array:
        """Stiffness per depth of the free nodes [Pa] in scipy's lower banded storage, shape (band, 2 free)."""
        K_lambda, K_mu, _ = self.matrices
        return banded(self.assemble(lame_lambda * K_lambda + lame_mu * K_mu))

    @cached_property
    def nodal_areas(self) -> Array:
        """Lumped mass per density and depth of the free nodes [m2], shape (free,): row sums of the consistent M."""
        return self.assemble(self.matrices[2], all_nodes=True).sum(1)[::2][self.free]


def banded(matrix: sparse.csr_array) -> Array:
    """Lower banded storage of a symmetric sparse matrix: `out[i - j, j]` is entry (i, j)."""
    entries = matrix.tocoo()
    row, col = entries.row, entries.col
    lower = row >= col
    out = np.zeros(((row - col).max() + 1, matrix.shape[0]))  # pyright: ignore[reportOptionalSubscript]
    out[(row - col)[lower], col[lower]] = entries.data[lower]
    return out


@lru_cache(maxsize=16)
def unit_compliance(mesh: PadMesh, nu: float) -> tuple[Array, Array]:
    """Displacements of the surface per force on it, (K^-1)_ss for E depth = 1, and their derivative by nu, -K^-1 (dK/dnu) K^-1,
    both (2 surface, 2 surface)."""
    surface = (2 * mesh.surface[:, None] + np.arange(2)).ravel()
    loads = np.zeros((2 * len(mesh.free), len(surface)))
    loads[surface, np.arange(len(surface))] = 1.0
    factor = linalg.cholesky_banded(mesh.banded_stiffness(*lame_moduli(1.0, nu)), lower=True)
    X = linalg.cho_solve_banded((factor, True), loads)
    with torch.inference_mode(False), torch.enable_grad():
        nu_ = torch.tensor(nu, dtype=torch.float64, requires_grad=True)
        moduli = lame_moduli(torch.ones_like(nu_), nu_)
    d_lambda, d_mu = (torch.autograd.grad(modulus, nu_, retain_graph=True)[0].item() for modulus in moduli)
    K_lambda, K_mu, _ = mesh.matrices
    dK = mesh.assemble(d_lambda * K_lambda + d_mu * K_mu)
    return X[surface], -X.T @ (dK @ X)
