"""The element: a bilinear quadrilateral."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]


Modulus = TypeVar("Modulus", float, Tensor)

CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
"""Of the square that an element is the image of."""


def lame_moduli(E: Modulus, nu: Modulus) -> tuple[Modulus, Modulus]:
    """lambda = E nu / ((1 + nu)(1 - 2 nu)), mu = E / (2 (1 + nu)), in the unit of E."""
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def gradients(corners: Array, xi: float, zeta: float) -> tuple[Array, Array, Array]:
    """Shape functions (4,) at a place of the square, their gradients (..., 4, 2) [1/m] in elements of `corners` (..., 4, 2)
    [m], and the determinant of the map (...) [m2]."""
    across, along = 1 + CORNERS[:, 0] * xi, 1 + CORNERS[:, 1] * zeta
    slopes = np.stack((CORNERS[:, 0] * along, CORNERS[:, 1] * across), -1) / 4
    J = np.swapaxes(corners, -1, -2) @ slopes  # d(x, y) / d(xi, zeta)
    determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
    cofactors = np.stack((J[..., 1, 1], -J[..., 0, 1], -J[..., 1, 0], J[..., 0, 0]), -1).reshape(J.shape)
    inverse = cofactors / determinant[..., None, None]
    return across * along / 4, slopes @ inverse, determinant


def strains(gradient: Array) -> Array:
    """B (..., 3, 8): (e_xx, e_yy, 2 e_xy) of the nodes' displacements, dofs (x, y) node by node."""
    B = np.zeros((*gradient.shape[:-2], 3, 8))
    B[..., 0, 0::2], B[..., 1, 1::2] = gradient[..., 0], gradient[..., 1]
    B[..., 2, 0::2], B[..., 2, 1::2] = gradient[..., 1], gradient[..., 0]
    return B


def element_matrices(corners: Array) -> tuple[Array, Array, Array]:
    """K_lambda, K_mu (per modulus and depth) [1] and the consistent M (per density and depth) [m2], each (..., 8, 8), of
    elements with `corners` (..., 4, 2) [m] anticlockwise."""
    _, gradient, quarter = gradients(corners, 0.0, 0.0)
    divergence = gradient.reshape(*gradient.shape[:-2], 8)
    K_lambda = 4 * quarter[..., None, None] * divergence[..., :, None] * divergence[..., None, :]
    K_mu, M, gauss = np.zeros_like(K_lambda), np.zeros_like(K_lambda), 1 / np.sqrt(3)
    for xi in (-gauss, gauss):
        for zeta in (-gauss, gauss):
            N, gradient, area = gradients(corners, xi, zeta)
            B = strains(gradient)
            K_mu += area[..., None, None] * (np.swapaxes(B, -1, -2) @ np.diag([2.0, 2.0, 1.0]) @ B)
            M += area[..., None, None] * np.kron(np.outer(N, N), np.eye(2))
    return K_lambda, K_mu, M
