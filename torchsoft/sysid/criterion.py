"""Criteria of optimal design."""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from torchsoft.sysid.initial_state import PREFIX
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array

Optimality = Literal["D", "A", "worst"]

SHARPNESS = 12.0
"""Sharpness of the smooth maximum, which exceeds the largest logarithm by ln(parameters) over this
at most."""


def optimality(criterion: Optimality, C: Array) -> tuple[float, Array]:
    """One number for a covariance C (s, s) of parameters' relative errors, the logarithm of a
    standard deviation, the smaller the better, and its derivative (s, s) by C.

    "D" is the mean logarithm along the axes of the ellipsoid of errors, its volume; "A" the root
    mean square of the standard deviations; "worst" the largest of them, smoothed. With one
    parameter the three are the same, and are called c-optimality. Raises `ValueError` for another.
    """
    if criterion not in get_args(Optimality):
        raise ValueError(
            f"`criterion` must be one of {', '.join(get_args(Optimality))}, not {criterion!r}"
        )
    if criterion == "D":
        return 0.5 * float(np.linalg.slogdet(C)[1]) / len(C), 0.5 * np.linalg.inv(C) / len(C)
    variances = np.diag(C)
    if criterion == "A":
        return 0.5 * float(np.log(variances.mean())), 0.5 * np.eye(len(C)) / variances.sum()
    logs = 0.5 * np.log(variances)
    parts = np.exp(SHARPNESS * (logs - logs.max()))
    value = float(logs.max() + np.log(parts.sum()) / SHARPNESS)
    return value, np.diag(0.5 * parts / parts.sum() / variances)


def chosen(
    problem: Problem, x: Array, names: Sequence[str] | None
) -> tuple[tuple[str, ...], Array]:
    """The parameters `names`, by default every free one that all recordings share, and the matrix
    (s, n) from errors of the coordinates x (n,) to their relative errors (s,). Raises `ValueError`
    for unknown names."""
    c, one = problem.coordinates, problem.recordings[0]
    values = c.values(x, one.name, one.parameters)
    rows = c.jacobian(x, one.name, values) * c.free / np.array([[values[name]] for name in c.names])
    own = {a.name for a in c.all if a.recording is not None}
    known = [
        name
        for name, row in zip(c.names, rows)
        if row.any() and name not in own and not name.startswith(PREFIX)
    ]
    wanted = tuple(known if names is None else names)
    if not wanted or len(set(wanted)) < len(wanted) or not set(wanted) <= set(known):
        raise ValueError(
            f"`names` must be some of the parameters {', '.join(known)}, each once, but is "
            f"{list(wanted)}"
        )
    return wanted, np.stack([rows[c.names.index(name)] for name in wanted])


def deviations(names: Sequence[str], T: Array, C: Array) -> dict[str, float]:
    """Relative standard deviations of parameters, by the matrix T (s, n) of `chosen` and the
    covariance C of the coordinates."""
    return dict(zip(names, np.sqrt(np.diag(T @ C @ T.T)).tolist()))
