"""Coloured noise, as an autoregression of estimated order.

Residuals (m,) of one channel are in units of the noise that its sensor states. An autoregression of
order p is

    u_k = phi_1 u_(k-1) + ... + phi_p u_(k-p) + scale e_k,   e_k independent, normal, of variance 1,

on a regular grid with possible gaps. Its whitener W has W' W = K^-1, with K the covariance of the
samples, so |W r|^2 + log det K is -2 log likelihood up to a constant, and W J is the Jacobian of W
r.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, signal, sparse

from torchsoft.sysid.recording import Array

JITTER = 0.05
"""Largest deviation of samples from their grid, over its spacing."""

MEMORY = 200
"""Most past samples in the prediction of one; p consecutive samples are enough for an exact one."""

ORDERS = 12
"""Largest order in a fit of noise."""

SAMPLES_AN_ORDER = 10
"""Fewest samples for each coefficient."""


def spacing(t: Array) -> float:
    """Spacing [s] of the grid of sample times t (m,) [s], which may have gaps: the mean distance of
    neighbours."""
    apart = np.diff(t)
    near = apart[apart < 1.5 * np.quantile(apart, 0.1)]
    return float(near.mean())


def positions(t: Array, h: float) -> tuple[Array, bool]:
    """Sample times t (m,) [s] over the spacing h [s], from 0, and whether they are whole numbers up
    to `JITTER`, to which they are then rounded."""
    apart = np.diff(t) / h
    whole = np.round(apart)
    regular = bool((np.abs(apart - whole) <= JITTER).all() and (whole >= 1).all())
    return np.concatenate(([0.0], np.cumsum(whole if regular else apart))), regular


def coefficients(reflections: Sequence[float] | Array) -> Array:
    """Coefficients phi (p,) from the p reflection coefficients, by the Levinson-Durbin
    recursion."""
    phi = np.zeros(0)
    for kappa in reflections:
        phi = np.append(phi - kappa * phi[::-1], kappa)
    return phi


def reflections(phi: Sequence[float]) -> Array:
    """Reflection coefficients, by the inverse recursion; the process is stationary where all are
    between -1 and 1."""
    a, out = np.array(phi, float), []
    while len(a):
        out.append(kappa := a[-1])
        if abs(kappa) >= 1:
            break
        a = (a[:-1] + kappa * a[-2::-1]) / (1 - kappa**2) if len(a) > 1 else a[:0]
    return np.array(out[::-1])


@dataclass(frozen=True)
class Autoregression:
    """Coloured noise of one channel: coefficients `phi` (p,), the standard deviation `scale` of the
    innovations, in units of the sensor's stated noise, and the `spacing` [s] of the samples; white
    without coefficients.

    Raises `ValueError` where it is not stationary.
    """

    phi: tuple[float, ...]
    scale: float
    spacing: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.phi).all() and (np.abs(reflections(self.phi)) < 1).all()):
            raise ValueError(
                f"noise with the coefficients {self.phi} grows without bound: it is not stationary"
            )
        if not (self.scale > 0 and self.spacing > 0):
            raise ValueError(
                f"`scale` and `spacing` of noise must be positive, but are {self.scale} and "
                f"{self.spacing}"
            )

    @classmethod
    def stated(cls, phi: Sequence[float], spacing: float) -> "Autoregression":
        """Noise of this colour with the standard deviation that the sensor states."""
        one = cls(tuple(phi), 1.0, spacing)
        return cls(one.phi, one.autocovariance(1)[0] ** -0.5, spacing)

    @property
    def order(self) -> int:
        return len(self.phi)

    @property
    def sd(self) -> float:
        """Standard deviation of the noise, over that stated for the sensor."""
        return float(self.autocovariance(1)[0] ** 0.5)

    def autocovariance(self, n: int) -> Array:
        """Autocovariance at lags 0 to n - 1 (n,)."""
        p = self.order
        a = np.concatenate(([1.0], -np.array(self.phi)))
        lag = np.abs(
            np.subtract.outer(np.arange(p + 1), np.arange(p + 1))
        )  # of Yule and Walker: sum_j a_j gamma_|i-j|
        equations = np.zeros((p + 1, p + 1))
        np.add.at(equations, (np.arange(p + 1)[:, None], lag), a)
        first = np.linalg.solve(equations, np.eye(p + 1)[0] * self.scale**2)
        if n <= p + 1:
            return first[:n]
        rest = np.zeros(n - p - 1)
        if p:  # gamma_k = sum_j phi_j gamma_(k-j)
            rest, _ = signal.lfilter([1.0], a, rest, zi=signal.lfiltic([1.0], a, first[:0:-1]))
        return np.concatenate((first, rest))

    def effective(self, n: int) -> float:
        """Number of independent samples that determine the variance as well as n of this noise."""
        rho = self.autocovariance(n) / self.autocovariance(1)[0]
        return n / (1 + 2 * float((1 - np.arange(1, n) / n) @ rho[1:] ** 2))

    def at_least(self, sd: float) -> "Autoregression":
        """The same colour, with a standard deviation of at least `sd`."""
        return Autoregression(self.phi, self.scale * max(1.0, sd / self.sd), self.spacing)

    def whitener(self, t: Array) -> sparse.csr_array:
        """W (m, m), lower triangular, for samples at t (m,) [s].

        A row is the sample less what the past predicts, over the standard deviation of that; gaps
        in the grid are exact, but for what lies more than `MEMORY` samples back. Off a regular grid
        only order 1 has a meaning, as phi to the power of the time between samples over `spacing`.
        Raises `ValueError` for higher orders there.
        """
        return whitener(self, np.asarray(t, np.float64).tobytes())


@lru_cache(maxsize=256)
def whitener(noise: Autoregression, times: bytes) -> sparse.csr_array:
    """`Autoregression.whitener`, made once for the same samples."""
    t = np.frombuffer(times)
    k, regular = positions(t, noise.spacing)
    if noise.order == 0:
        return sparse.csr_array(sparse.diags_array(np.full(len(t), 1 / noise.scale)))
    if regular:
        return gapped_whitener(noise, k.astype(int))
    if noise.order > 1 or noise.phi[0] < 0:
        raise ValueError(
            f"noise of order {noise.order} is known every {noise.spacing:g} s only, but the "
            "samples are not on such a grid"
        )
    rho = noise.phi[0] ** np.diff(k)
    sd = noise.sd * np.sqrt(np.concatenate(([1.0], 1 - rho**2)))
    below: Any = (0, -1)
    return sparse.csr_array(sparse.diags_array([1 / sd, -rho / sd[1:]], offsets=below))


def gapped_whitener(noise: Autoregression, grid: NDArray[np.int_]) -> sparse.csr_array:
    """The whitener (m, m) for samples at grid points (m,). Its rows depend only on how far back the
    past of a sample is."""
    m, p, first = len(grid), noise.order, pasts(grid, noise.order)
    gamma, rows = noise.autocovariance(grid[-1] + 1), list[Array]()
    usual = np.append(-np.array(noise.phi[::-1]), 1.0) / noise.scale
    known = {np.arange(p, -1, -1).tobytes(): usual, np.zeros(1, int).tobytes(): gamma[:1] ** -0.5}
    for i, start in enumerate(first):
        lags = grid[i] - grid[start : i + 1]
        key = lags.tobytes()
        if key not in known:
            K = gamma[np.abs(np.subtract.outer(lags, lags))]
            past = linalg.solve(K[:-1, :-1], K[:-1, -1], assume_a="pos")
            known[key] = np.append(-past, 1.0) / np.sqrt(K[-1, -1] - K[-1, :-1] @ past)
        rows.append(known[key])
    ends = np.cumsum([0, *map(len, rows)])
    columns = np.arange(ends[-1]) + np.repeat(first - ends[:-1], np.diff(ends))
    return sparse.csr_array((np.concatenate(rows), columns, ends), (m, m))


def pasts(grid: NDArray[np.int_], p: int) -> NDArray[np.int_]:
    """For samples at grid points `grid` (m,), index (m,) of the first one needed to predict each
    from its past. Samples before p consecutive ones do not matter."""
    i = np.arange(len(grid))
    starts = np.concatenate(([True], np.diff(grid) != 1))
    run = i - np.maximum.accumulate(np.where(starts, i, 0)) + 1  # samples in a row, up to this one
    last = np.maximum.accumulate(np.where(run >= p, i - p + 1, 0))
    return np.maximum(np.concatenate(([0], last[:-1])), i - MEMORY)


def log_det(W: sparse.csr_array) -> float:
    """log det K of the noise with the whitener W."""
    return -2 * float(np.log(W.diagonal()).sum())


class NoiseFit(NamedTuple):
    """The selected noise, -2 log likelihood of white noise less that of this one, and the number of
    the other orders that were compared with white noise."""

    noise: Autoregression
    likelihood_ratio: float
    orders: int


def fit_noise(
    series: Sequence[tuple[Array, Array]], parameters: float = 0.0, most: int = ORDERS
) -> NoiseFit:
    """Noise of one channel from its residuals: times (m,) [s] and residuals (m,) of each recording.

    Every order up to `most`, as far as the samples go, is fitted by Burg's method for segments (de
    Waele and Broersen, 2000), whose noise is always stationary, and the order with the least
    Bayesian information criterion is selected. The likelihood is exact, with gaps, and where a
    recording is sampled at a whole fraction of the highest rate. `parameters` is the number of
    unknowns fitted to these residuals. Without such a grid the orders are 0 and 1, by maximum
    likelihood.
    """
    h, m = min(spacing(t) for t, _ in series), sum(len(t) for t, _ in series)
    if all(positions(t, h)[1] for t, _ in series):
        found = burg(
            [part for t, r in series for part in segments(t, r, h)],
            min(most, m // SAMPLES_AN_ORDER),
        )
        candidates = [tuple(coefficients(found[:p])) for p in range(len(found) + 1)]
    else:
        candidates = [(), (by_time(series, h),)]
    out, deviances = list[Autoregression](), list[float]()
    for phi in candidates:
        square, log = whitened_sum(Autoregression(phi, 1.0, h), series)
        scale = max(square / max(m - parameters, 1.0), 1e-300) ** 0.5
        deviances.append(2 * m * np.log(scale) + log + square / scale**2)
        out.append(Autoregression(phi, scale, h))
    bic = np.array(deviances) + np.log(m) * np.array([one.order + 1 for one in out])
    best = int(np.argmin(bic))
    return NoiseFit(out[best], deviances[0] - deviances[best], len(out) - 1)


def whitened_sum(
    noise: Autoregression, series: Sequence[tuple[Array, Array]]
) -> tuple[float, float]:
    """Sum of squares of residuals whitened with a noise, and the logarithm of the determinant of
    its covariance."""
    W = [(noise.whitener(t), r) for t, r in series]
    return sum(float(np.sum((w @ r) ** 2)) for w, r in W), sum(log_det(w) for w, _ in W)


def segments(t: Array, r: Array, h: float) -> list[Array]:
    """Residuals (m,), split at gaps."""
    k, _ = positions(t, h)
    return np.split(r, np.flatnonzero(np.diff(k) > 1.5) + 1)


def burg(parts: Sequence[Array], most: int) -> Array:
    """Reflection coefficients (most,) that minimise the forward and backward prediction errors
    within all segments; fewer where the segments are too short."""
    forward, backward, out = [p.copy() for p in parts], [p.copy() for p in parts], []
    for _ in range(most):
        pairs = [(f[1:], b[:-1]) for f, b in zip(forward, backward) if len(f) > 1]
        power = sum(float(f @ f + b @ b) for f, b in pairs)
        if sum(len(f) for f, _ in pairs) < SAMPLES_AN_ORDER * (len(out) + 1) or power == 0:
            break
        kappa = 2 * sum(float(f @ b) for f, b in pairs) / power
        out.append(kappa)
        forward, backward = [f - kappa * b for f, b in pairs], [b - kappa * f for f, b in pairs]
    return np.array(out)


def by_time(series: Sequence[tuple[Array, Array]], h: float) -> float:
    """Maximum-likelihood correlation over h [s] of noise that decays exponentially with time."""
    m = sum(len(t) for t, _ in series)

    def correlation(z: float) -> float:
        return float(np.exp(-np.exp(-z)))

    def deviance(z: float) -> float:
        square, log = whitened_sum(Autoregression((correlation(z),), 1.0, h), series)
        return m * np.log(max(square, 1e-300)) + log

    found: Any = optimize.minimize_scalar(deviance, bounds=(-3.0, 9.0), method="bounded")
    return correlation(found.x)
