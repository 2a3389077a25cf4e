"""The law of one contact node as a compiled kernel, with its closed-form Jacobian.

`contact` defines the physics; what stands here must equal it to rounding, and `tests/test_kernel.py` holds it to that.
At a stage s = s* + a h s' of a diagonally implicit method the stretch is local: the law with the dashpot R + a h K in
place of R, and s* in place of s, is the law at the end of the stage.

Derivative names: `N_g` is dF_N/dg and so on; `w` is the velocity of the object's centre relative to the node.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.kernels import compiled

Array = NDArray[np.float64]


class Constants(NamedTuple):
    """Scalars of the model, SI units; `coulomb` selects Eq. 12-13 to the letter, `sensed` is the place in q of the coordinate
    that the horizontal loop measures."""

    K_n: float
    R_n: float
    K_t: float
    R_t: float
    eta: float
    mu_s: float
    mu_k: float
    v_s: float
    epsilon: float
    coulomb: bool
    tau: float
    radius: float
    m_C: float
    I_C: float
    m_Br: float
    gravity: float
    K_81: float
    R_80: float
    K_98: float
    R_99: float
    sensed: int
    pad_length: float


@compiled
def body_distance(radius: float, x: float, y: float) -> tuple[float, float, float, float]:
    """Signed distance, its gradient and its curvature (per length along the boundary) at a body-frame point."""
    d = np.sqrt(x * x + y * y)
    return d - radius, x / d, y / d, 1.0 / d


@compiled
def slip(E: float, F_N: float, R: float, share: float, c: Any) -> tuple[float, float, float]:
    """Slip rate w under the trial effort E, with dw/dE and dw/dF_N; `SmoothSlip` and `Coulomb` of `contact`."""
    if c.mu_s * F_N >= E:
        return 0.0, 0.0, 0.0
    if c.coulomb:
        return (E - c.mu_k * F_N) / R, 1.0 / R, -c.mu_k / R
    a = share * c.eta + R
    b = a * c.v_s - (E - c.mu_k * F_N)
    q = c.v_s * (E - c.mu_s * F_N)
    root = np.sqrt(b * b + 4.0 * a * q)
    w = 2.0 * q / (b + root) if b >= 0.0 else (root - b) / (2.0 * a)
    fall = c.v_s / (c.v_s + w)
    mu = c.mu_k + (c.mu_s - c.mu_k) * fall
    slope = a - (c.mu_s - c.mu_k) * F_N * fall * fall / c.v_s
    return w, 1.0 / slope, -mu / slope


@compiled
def tangential(s: float, flow: float, F_N: float, R: float, K: float, share: float, c: Any) -> tuple[float, ...]:
    """Effort e and slip rate gamma' of the Voigt pair in series with the slip element, with their derivatives.

    At a stage s = s* + a h (flow - gamma'), so e = K s* + (R + a h K)(flow - gamma'): called with s* and with
    R + a h K for R, this is the continuous law of `contact.Contact` at the end of the stage. Returns e, gamma',
    de/dtrial, dgamma'/dtrial, de/dF_N, dgamma'/dF_N, where trial = K s + R flow.
    """
    trial = K * s + R * flow
    sign = 1.0 if trial > 0.0 else -1.0
    w, w_E, w_N = slip(abs(trial), F_N, R, share, c)
    return trial - R * sign * w, sign * w, 1.0 - R * w_E, w_E, -R * sign * w_N, sign * w_N


@compiled
def contact_node(
    dx: float, dy: float, wx: float, wy: float, omega: float, theta: float, s: float, share: float, ah: float, c: Any,
    J: Array, out: Array,
) -> bool:  # fmt: skip
    """Force of the object on one node at the end of a stage, and its stretch rate, with their Jacobian.

    d is the node's lever about the object's centre, w = v_C - p', s the stage's s*. `out` receives f_x, f_y, F_N, F_T, e,
    gamma', rho, g, g', v_T, and J (3, 7) the derivatives of (f_x, f_y, s') with respect to (w_x, w_y, omega, d_x, d_y,
    theta, s*), each with the others held. Returns whether the node touches; if not, nothing is written.
    """
    cos, sin = np.cos(theta), np.sin(theta)
    phi, mx, my, curvature = body_distance(c.radius, cos * dx + sin * dy, cos * dy - sin * dx)
    g = -phi
    if g <= 0.0:
        return False
    nx, ny = cos * mx - sin * my, sin * mx + cos * my
    tx, ty = -ny, nx
    arm_n, arm_t = -nx * dy + ny * dx, -tx * dy + ty * dx  # n.(z x d), t.(z x d)
    g_dot = nx * wx + ny * wy + omega * arm_n
    v_T = tx * wx + ty * wy + omega * arm_t
    rho = g / (g + c.epsilon)
    rho_g = c.epsilon / (g + c.epsilon) ** 2

    F_N = share * (c.K_n * g + c.R_n * rho * g_dot)  # (8), (9)
    N_g, N_v = share * (c.K_n + c.R_n * rho_g * g_dot), share * c.R_n * rho
    if F_N <= 0.0:
        F_N, N_g, N_v = 0.0, 0.0, 0.0
    K, R = share * c.K_t, share * (c.R_t + ah * c.K_t)
    e, gamma_dot, e_trial, slip_trial, e_N, slip_N = tangential(s, rho * v_T, F_N, R, K, share, c)  # (10)-(13)
    F_T = rho * e

    for j in range(6):
        dwx, dwy, dom = 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0
        ddx, ddy, dth = 1.0 if j == 3 else 0.0, 1.0 if j == 4 else 0.0, 1.0 if j == 5 else 0.0
        dg = arm_n * dth - nx * ddx - ny * ddy
        turn = curvature * (tx * ddx + ty * ddy) + (1.0 - curvature * arm_t) * dth
        dvx, dvy = dwx - dom * dy - omega * ddy, dwy + dom * dx + omega * ddx
        dg_dot = nx * dvx + ny * dvy + v_T * turn
        dv_T = tx * dvx + ty * dvy - g_dot * turn
        dN = N_g * dg + N_v * dg_dot
        dflow = rho_g * dg * v_T + rho * dv_T
        dT = rho_g * dg * e + rho * (e_trial * R * dflow + e_N * dN)
        J[0, j] = dN * nx + dT * tx + (F_N * tx - F_T * nx) * turn
        J[1, j] = dN * ny + dT * ty + (F_N * ty - F_T * ny) * turn
        J[2, j] = dflow - slip_trial * R * dflow - slip_N * dN
    J[0, 6] = rho * e_trial * K * tx
    J[1, 6] = rho * e_trial * K * ty
    J[2, 6] = -slip_trial * K

    out[0], out[1] = F_N * nx + F_T * tx, F_N * ny + F_T * ty
    out[2], out[3], out[4], out[5], out[6], out[7], out[8], out[9] = F_N, F_T, e, gamma_dot, rho, g, g_dot, v_T
    return True
