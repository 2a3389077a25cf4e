"""The pad's surface compliance: bilinear plane-strain elements on a regular mesh, put together from
bars in x and in y.

On a regular mesh every integral over the pad is a product of one over x and one over y, so that the
stiffness is a sum of Kronecker products of two one-dimensional matrices. The volume's part takes
one point an element (its midpoint): no locking.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from experiments.validation.foreign.numbers import Numbers

Array = NDArray[np.float64]


def bars(length: float, count: int) -> tuple[sparse.csr_array, ...]:
    """Of two-node elements in a row: the integrals of N' N', N N, N' N, and of N N by the midpoint,
    (count + 1, count + 1)."""
    a = length / count
    elements = (
        np.array([[1.0, -1.0], [-1.0, 1.0]]) / a,
        np.array([[2.0, 1.0], [1.0, 2.0]]) * a / 6,
        np.array([[-1.0, -1.0], [1.0, 1.0]]) / 2,
        np.full((2, 2), a / 4),
    )
    out = []
    for e in elements:
        full = sparse.lil_array((count + 1, count + 1))
        for k in range(count):
            full[k : k + 2, k : k + 2] += e
        out.append(full.tocsr())
    return tuple(out)


def compliance(p: Numbers) -> Array:
    """What unit forces on the free surface displace it by [m/N], (2 nodes, 2 nodes), x and y of one
    node after the other; the base is bonded, the sides are free."""
    A_x, M_x, G_x, P_x = bars(p.length, p.across)
    A_y, M_y, G_y, P_y = (
        one[1:, 1:] for one in bars(p.height, p.through)
    )  # without the bonded row
    mu = p.E / (2 * (1 + p.nu))
    lam = 2 * mu * p.nu / (1 - 2 * p.nu)
    kron = sparse.kron
    K_xx = lam * kron(A_x, P_y) + mu * (2 * kron(A_x, M_y) + kron(M_x, A_y))
    K_yy = lam * kron(P_x, A_y) + mu * (2 * kron(M_x, A_y) + kron(A_x, M_y))
    K_xy = lam * kron(G_x, G_y.T) + mu * kron(G_x.T, G_y)
    K = sparse.block_array([[K_xx, K_xy], [K_xy.T, K_yy]]).tocsc() * p.depth
    top = np.arange(p.across + 1) * p.through + p.through - 1  # nodes go up each column
    dofs = np.stack((top, top + (p.across + 1) * p.through), -1).ravel()
    loads = np.zeros((2 * (p.across + 1) * p.through, len(dofs)))
    loads[dofs, np.arange(len(dofs))] = 1.0
    return np.ascontiguousarray(splu(K).solve(loads)[dofs])
