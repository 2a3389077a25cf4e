"""Fast rollouts of small equations: an exact recursion for linear ones, a compiled L-stable step for the others.

scipy's stiff solvers would serve, but call Python at every step and cost more than the simulator that is being reduced.
"""

import math
from typing import Any

import numpy as np
from numba import njit
from scipy.signal import cont2discrete

GAMMA = 1 + 1 / math.sqrt(2)
"""Of the Rosenbrock method ROS2: second order, L-stable."""

TOLERANCE = 1e-3
"""Largest difference, in parts of the states' scale, between a rollout and that with half its step."""

HALVINGS = 8
"""Halvings of the step after which a rollout is taken as it is."""


def linear_rollout(A: np.ndarray, B: np.ndarray, h: float, y0: np.ndarray, w: np.ndarray) -> np.ndarray:
    """y' = A y + B w (T, states) from y0 at steps of h [s], w (T, inputs) straight between them: exact."""
    n = len(A)
    discrete: Any = cont2discrete((A, B, np.eye(n), np.zeros_like(B)), h, method="foh")
    F, G, _, D, _ = discrete
    return recursion(F, w @ G.T, y0 - D @ w[0]) + w @ D.T


@njit(cache=True)
def recursion(F, f, x0):
    """x[k+1] = F x[k] + f[k] from x[0] = x0, as (T, n) with f (T, n)."""
    T, n = f.shape
    x = np.empty((T, n))
    x[0] = x0
    for k in range(T - 1):
        for i in range(n):
            total = f[k, i]
            for j in range(n):
                total += F[i, j] * x[k, j]
            x[k + 1, i] = total
    return x


def nonlinear_rollout(
    parts: tuple[np.ndarray, ...], t: np.ndarray, y0: np.ndarray, w: np.ndarray, limit: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """y (T, states) at t (T,) [s], NaN once it is beyond `limit` (states,); the step is halved until nothing changes.

    parts: S (states, states), C (states, terms), the control law K (inputs, states + outer), the terms' forms (terms,
    factors, variables), and 1 where a factor is a tanh, 2 where it is a modulus (terms, factors).
    """

    def stepped(pieces: int) -> np.ndarray:
        step: Any = _rosenbrock
        return step(*parts, t, y0, w, limit, pieces)

    y = stepped(1)
    for halving in range(1, HALVINGS + 1):
        coarse, y = y, stepped(2**halving)
        error = np.abs(y - coarse) / scale
        if np.isfinite(y).all() and np.isfinite(coarse).all() and error.max() <= TOLERANCE:
            break
        if halving >= 3 and np.isnan(y[-1, 0]) and np.isnan(coarse[-1, 0]):
            break  # it diverges at either step
    return y


@njit(cache=True)
def _rates(S, C, K, forms, shapes, y, w, f, J, slope):
    """f(y, w) and, if `slope`, its derivative J by y: `features` of `ode` with the chain rule, in place."""
    n, m, p = len(y), len(K), forms.shape[1]
    z, values, slopes = np.empty(n + m + 1), np.empty(p), np.empty(p)
    z[n + m] = 1.0
    for i in range(n):
        z[i] = y[i]
    for i in range(m):
        z[n + i] = 0.0
        for j in range(n):
            z[n + i] += K[i, j] * y[j]
        for j in range(len(w)):
            z[n + i] += K[i, n + j] * w[j]
    for i in range(n):
        f[i] = 0.0
        for j in range(n):
            f[i] += S[i, j] * y[j]
            if slope:
                J[i, j] = S[i, j]
    for i in range(forms.shape[0]):
        product = 1.0
        for j in range(p):
            x = 0.0
            for q in range(n + m + 1):
                x += forms[i, j, q] * z[q]
            values[j], slopes[j] = x, 1.0
            if shapes[i, j] == 1:
                values[j] = math.tanh(x)
                slopes[j] = 1.0 - values[j] ** 2
            elif shapes[i, j] == 2:
                values[j], slopes[j] = abs(x), math.copysign(1.0, x)
            product *= values[j]
        for row in range(n):
            f[row] += C[row, i] * product
        if not slope:
            continue
        for j in range(p):
            outer = slopes[j]
            for q in range(p):
                if q != j:
                    outer *= values[q]
            if outer == 0.0:
                continue
            for column in range(n):
                x = forms[i, j, column]
                for q in range(m):
                    x += forms[i, j, n + q] * K[q, column]
                for row in range(n):
                    J[row, column] += C[row, i] * outer * x


@njit(cache=True)
def _rosenbrock(S, C, K, forms, shapes, t, y0, w, limit, pieces):
    n = len(y0)
    out = np.full((len(t), n), np.nan)
    out[0] = y0
    y, f, later, J, one = y0.copy(), np.empty(n), np.empty(n), np.empty((n, n)), np.eye(n)
    for k in range(len(t) - 1):
        h, rise = (t[k + 1] - t[k]) / pieces, (w[k + 1] - w[k]) / pieces
        for piece in range(pieces):
            here = w[k] + rise * piece
            _rates(S, C, K, forms, shapes, y, here, f, J, True)
            _rates(S, C, K, forms, shapes, y, here + rise, later, J, False)
            drift = GAMMA * (later - f)
            inverse = np.linalg.inv(one - GAMMA * h * J)
            k1 = inverse @ (f + drift)
            _rates(S, C, K, forms, shapes, y + h * k1, here + rise, later, J, False)
            k2 = inverse @ (later - 2 * k1 - drift)
            y = y + h * (1.5 * k1 + 0.5 * k2)
            for i in range(n):
                if not abs(y[i]) <= limit[i]:
                    return out
        out[k + 1] = y
    return out
