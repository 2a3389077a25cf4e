"""The information in a Jacobian: covariance of the coordinates, and their shift by an error of the model."""

import numpy as np

from torchsoft.sysid.recording import Array


def fisher(J: Array) -> tuple[Array, Array, Array]:
    """Covariance (n, n) of the coordinates, eigenvalues (n,) and eigenvectors (n, n) of the Fisher matrix of a whitened
    Jacobian J (m, n); directions without any information get a very large variance, not an infinite one."""
    values, vectors = np.linalg.eigh(J.T @ J)
    floor = np.maximum(values, 1e-12 * max(values.max(initial=0.0), 1e-300))
    return (vectors / floor) @ vectors.T, values, vectors


def standard_deviations(J: Array) -> Array:
    """Cramer-Rao: standard deviations (n,) of the coordinates of a whitened Jacobian (m, n); huge without information."""
    return np.sqrt(np.diag(fisher(J)[0]))


def shift(J: Array, difference: Array) -> Array:
    """How far coordinates (n,) at a least-squares fit are from those of a finer model: `difference` (m,) is what the residuals
    of the finer one, at the fit, have more."""
    return np.asarray(np.linalg.lstsq(J, difference, rcond=None)[0], np.float64)
