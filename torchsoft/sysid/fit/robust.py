"""Robust losses: what they do to outliers, and the covariance that belongs to them.

A fit makes half the sum of c^2 rho((r / c)^2) smallest, rho that of `scipy.optimize.least_squares`. The reach c says, in
standard deviations of the noise that sensors state, where residuals begin to count for less. So the scale is the stated one
and not estimated: where noise is understated by a factor, every residual is an outlier, and the fit loses precision, but its
covariance says so, because it is made of the residuals themselves (Huber, 1981, section 7.6). Whitening spreads an outlier over
as many samples as the noise has coefficients, and one more.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.fit.information import fisher
from torchsoft.sysid.problem.recording import Array

Loss = Literal["linear", "soft_l1", "huber", "cauchy", "arctan"]

REACH: dict[Loss, float] = {"linear": 1.0, "soft_l1": 1.287, "huber": 1.345, "cauchy": 2.385, "arctan": 2.571}
"""c of every loss, such that where the noise is Gaussian it has the `EFFICIENCY`."""

EFFICIENCY = 0.95
"""Variance of the least-squares estimate over the robust one's, with Gaussian noise."""


def rho(loss: Loss, z: Array) -> Array:
    """rho, rho' and rho'' (3, m) at z (m,), the squares of residuals over c."""
    one, zero = np.ones_like(z), np.zeros_like(z)
    match loss:
        case "linear":
            return np.stack((z, one, zero))
        case "soft_l1":
            root = np.sqrt(1 + z)
            return np.stack((2 * (root - 1), 1 / root, -0.5 / root**3))
        case "huber":
            root, near = np.sqrt(np.maximum(z, 1.0)), z <= 1
            return np.stack((np.where(near, z, 2 * root - 1), 1 / root, np.where(near, 0.0, -0.5 / root**3)))
        case "cauchy":
            return np.stack((np.log1p(z), 1 / (1 + z), -1 / (1 + z) ** 2))
        case "arctan":
            return np.stack((np.arctan(z), 1 / (1 + z**2), -2 * z / (1 + z**2) ** 2))


def spared(loss: Loss, priors: int) -> Callable[[Array], Array]:
    """The loss as `least_squares` takes it, linear in the last rows, which are `priors`; its `f_scale` is `REACH[loss]`."""

    def rows(z: Array) -> Array:
        data = len(z) - priors
        return np.concatenate((rho(loss, z[:data]), rho("linear", z[data:])), axis=1)

    return rows


def covariance(J: Array, r: Array, loss: Loss, priors: int = 0, exact: NDArray[np.int_] | None = None) -> Array:
    """Of the coordinates (n, n) where a robust fit has ended: J (m, n) and residuals r (m,) there, the last rows `priors`.

    With psi = rho' r, A = E[psi'] J'J and B = E[psi^2] J'J, both with the priors' own J'J, it is A^-1 B A^-1; expectations are
    means over the residuals, that of psi^2 over the degrees of freedom; over those `exact` (k,) only, where some samples are
    saturated. They are not taken below what Gaussian noise as stated
    gives, 1 over the loss's efficiency. Raises `ValueError` where so many residuals are outliers that nothing holds the
    estimates.
    """
    m, n = len(r) - priors, J.shape[1]
    own = r[:m] if exact is None else r[exact]
    z = (own / REACH[loss]) ** 2
    _, first, second = rho(loss, z)
    slope, power = float(np.mean(first + 2 * z * second)), float(np.sum((first * own) ** 2)) / max(len(own) - n, 1)
    if slope <= 0:
        raise ValueError(
            f"the loss `{loss}` holds on to nothing: most residuals count as outliers; state more noise, or take another loss"
        )
    inverse, _, _ = fisher(np.concatenate((slope**0.5 * J[:m], J[m:])))
    least = slope**2 / (1.0 if loss == "linear" else EFFICIENCY)
    return inverse @ (max(power, least) * J[:m].T @ J[:m] + J[m:].T @ J[m:]) @ inverse
