"""Criteria of optimal design, and a ranking of candidate recordings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from torchsoft.sysid.fit import fisher
from torchsoft.sysid.initial_state import PREFIX
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.runs import Runner

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


@dataclass(frozen=True)
class Outlook:
    """A candidate recording: its duration [s], the relative standard deviations of parameters
    without it and with it, and the gain of the criterion, in the logarithm of standard deviations.
    `lost` is the reason of a failed run."""

    name: str
    seconds: float
    before: dict[str, float]
    after: dict[str, float]
    gain: float
    lost: str = ""


def next_recording(
    problem: Problem, x: Array, candidates: Sequence[Recording], *,
    names: Sequence[str] | None = None, criterion: Optimality = "D", rtol: float = 1e-4,
    workers: int = 1,
) -> list[Outlook]:  # fmt: skip
    """Rank candidates for the next recording, after those of `problem`, at the coordinates x (n,),
    such as the end of a fit.

    The Fisher matrix of every candidate is added to that of the recordings; only the times of its
    samples count. The best comes first, by the decrease of the `criterion` ("D", "A" or "worst") of
    the parameters `names`. The prediction holds as far as the model does, and for small errors.
    Raises `ValueError` for candidates that do not fit the problem.
    """
    if not candidates:
        raise ValueError("there is no candidate to rank")
    both = Problem(
        [*problem.recordings, *candidates], problem.sensors, problem.unknowns, problem.noise
    )
    known = dict(zip(problem.coordinates.labels, x))
    c = both.coordinates
    x = c.begun(known)
    names, T = chosen(both, x, names)
    runner, priors = Runner(both.recordings, workers), len(c.priors)
    have = both.residuals(runner, x, problem.names, rtol, c.free)
    if have.lost:
        raise ValueError(f"`x` does not reproduce what was recorded: {have.reasons}")

    def covariance(J: Array, those: Sequence[str]) -> Array:
        """Of the coordinates that matter to some recordings; zero for the others."""
        mine = np.array([a.recording in (None, *those) for a in c.all]) & c.free
        rows = np.ones(len(J), bool)
        rows[len(J) - priors :] = [mine[i] for i, _ in c.priors]
        C = np.zeros((len(x), len(x)))
        C[np.ix_(mine, mine)] = fisher(J[np.ix_(rows, mine)])[0]
        return C

    C = covariance(have.J, problem.names)
    before, out = deviations(names, T, C), []
    for one in candidates:
        new = both.residuals(runner, x, [one.name], rtol, c.free)
        if new.lost:
            out.append(
                Outlook(one.name, one.duration, before, before, 0.0, new.lost[one.name].reason)
            )
            continue
        J = np.concatenate((have.J[: len(have.J) - priors], new.J))
        after = covariance(J, [*problem.names, one.name])
        gain = optimality(criterion, T @ C @ T.T)[0] - optimality(criterion, T @ after @ T.T)[0]
        out.append(Outlook(one.name, one.duration, before, deviations(names, T, after), gain))
    return sorted(out, key=lambda o: (bool(o.lost), -o.gain))
