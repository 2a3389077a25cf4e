"""Stiffness of a pad's mesh, in a band, and compliance of its surface."""

from functools import lru_cache

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph

from torchsoft.physics.mesh.mesh import Array, Index, Mesh, dofs_of, lame_moduli


def banded(matrix: sparse.csr_array) -> Array:
    """Lower banded storage of a symmetric sparse matrix: `out[i - j, j]` is entry (i, j)."""
    entries = matrix.tocoo()
    row, col = entries.row, entries.col
    lower = row >= col
    out = np.zeros(((row - col).max() + 1, matrix.shape[0]))  # pyright: ignore[reportOptionalSubscript]
    out[(row - col)[lower], col[lower]] = entries.data[lower]
    return out


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


@lru_cache(maxsize=16)
def unit_compliance(mesh: Mesh, nu: float) -> tuple[Array, Array]:
    """Displacements of the surface per force on it, (K^-1)_ss for E depth = 1, and their derivative
    by nu, -K^-1 (dK/dnu) K^-1, both (2 surface, 2 surface)."""
    surface = dofs_of(mesh.surface)
    X = solved(mesh.stiffness(*lame_moduli(1.0, nu)), unit_loads(2 * len(mesh.free), surface))
    with torch.inference_mode(False), torch.enable_grad():
        nu_ = torch.tensor(nu, dtype=torch.float64, requires_grad=True)
        moduli = lame_moduli(torch.ones_like(nu_), nu_)
    slopes = (torch.autograd.grad(x, nu_, retain_graph=True)[0].item() for x in moduli)
    return X[surface], -(X.T @ (mesh.stiffness(*slopes) @ X))
