"""What series of relaxation or retardation times answer to a measured history, exactly, for a history that is linear between
its samples."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def faded(t: Array, x: Array, tau: Array) -> Array:
    """The integral of exp(-(t - s) / tau) x'(s) over the past s, (n, terms), at times t (n,) [s] >= 0 of a history x (n,) that
    steps to x[0] at t = 0, for times tau (terms,) [s]."""
    intervals = np.diff(t, prepend=0.0)[:, None] / tau
    a = np.exp(-intervals)
    slow = np.where(intervals > 0, -np.expm1(-intervals) / np.where(intervals > 0, intervals, 1.0), 1.0)
    b = np.diff(x, prepend=x[0])[:, None] * slow
    b[0] = x[0] * a[0]
    step = 1  # h_i = a_i h_{i-1} + b_i, twice as many terms summed in every pass
    while step < len(t):
        b[step:], a[step:] = b[step:] + a[step:] * b[:-step], a[step:] * a[:-step]
        step *= 2
    return b


def responses(test: str, t: Array, x: Array, tau: Array) -> Array:
    """What each coefficient adds to the answer (n, 1 + terms): of a relaxation series E, E_i [Pa] to the stress under the
    strain x; of a creep series J_0, J_i [1/Pa] to the strain under the stress x."""
    h = faded(t, x, tau)
    return np.column_stack((x, h if test == "relaxation" else x[:, None] - h))
