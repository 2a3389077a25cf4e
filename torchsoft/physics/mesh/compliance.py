"""What a pad's mesh is as a whole: its stiffness in a band, and how its surface gives way."""

from functools import lru_cache

import numpy as np
import torch
from scipy import linalg, sparse

from torchsoft.physics.mesh.element import Array, lame_moduli
from torchsoft.physics.mesh.mesh import Mesh


def banded(matrix: sparse.csr_array) -> Array:
    """Lower banded storage of a symmetric sparse matrix: `out[i - j, j]` is entry (i, j)."""
    entries = matrix.tocoo()
    row, col = entries.row, entries.col
    lower = row >= col
    out = np.zeros(((row - col).max() + 1, matrix.shape[0]))  # pyright: ignore[reportOptionalSubscript]
    out[(row - col)[lower], col[lower]] = entries.data[lower]
    return out


BLOCK = 5e8
"""Entries of a factor times right-hand sides of one call: about a second."""


@lru_cache(maxsize=16)
def unit_compliance(mesh: Mesh, nu: float) -> tuple[Array, Array]:
    """Displacements of the surface per force on it, (K^-1)_ss for E depth = 1, and their derivative by nu, -K^-1 (dK/dnu) K^-1,
    both (2 surface, 2 surface)."""
    surface = (2 * mesh.surface[:, None] + np.arange(2)).ravel()
    loads = np.zeros((2 * len(mesh.free), len(surface)))
    loads[surface, np.arange(len(surface))] = 1.0
    K_lambda, K_mu, _ = mesh.matrices
    lame_lambda, lame_mu = lame_moduli(1.0, nu)
    factor = linalg.cholesky_banded(banded(mesh.assemble(lame_lambda * K_lambda + lame_mu * K_mu)), lower=True)
    size = max(1, int(BLOCK / factor.size))  # right-hand sides of a call, between which an interrupt is heard
    X = np.concatenate(
        [
            linalg.cho_solve_banded((factor, True), loads[:, k : k + size], check_finite=False)
            for k in range(0, len(surface), size)
        ],
        1,
    )
    with torch.inference_mode(False), torch.enable_grad():
        nu_ = torch.tensor(nu, dtype=torch.float64, requires_grad=True)
        moduli = lame_moduli(torch.ones_like(nu_), nu_)
    d_lambda, d_mu = (torch.autograd.grad(modulus, nu_, retain_graph=True)[0].item() for modulus in moduli)
    dK = mesh.assemble(d_lambda * K_lambda + d_mu * K_mu)
    return X[surface], -X.T @ (dK @ X)
