"""How much each recording, and the priors, told about what was estimated.

Samples over their noise enter a least-squares estimate by the factors C J', C = (J' J)^-1 being its covariance. The variance of
a combination g'x is the sum of the squares of its factors, and so that of g' C F_k C g over recordings, where F_k = J_k' J_k is
what each adds to Fisher's information: these parts are the recordings' weights in the estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.answer.estimate import IDENTIFIABLE, quantities, split
from torchsoft.sysid.fit.information import fisher
from torchsoft.sysid.problem.problem import Problem
from torchsoft.sysid.problem.recording import Array


@dataclass(frozen=True)
class Contribution:
    """What one recording told about the estimates, or what the priors did (`source` is None then): its share of the weight in
    each, by label, all sources together being 1, and how many times larger the standard deviation would be without it; none
    where the others do not determine the estimate."""

    source: str | None
    rows: int
    shares: dict[str, float]
    without: dict[str, float | None]


def contributions(
    problem: Problem, x: Array, free: NDArray[np.bool_], J: Array, fitted: Sequence[str]
) -> list[Contribution]:
    """Of the recordings `fitted`, whose rows the whitened Jacobian J (m, n) at x (n,) has, before those of the priors."""
    rows, at = dict[str | None, slice](), 0
    for (name, _), part in split(problem, J, list(fitted)).items():
        begin = rows[name].start if name in rows else at
        at += len(part)
        rows[name] = slice(begin, at)
    if at < len(J):
        rows[None] = slice(at, len(J))
    J = J[:, free]
    C, wanted = fisher(J)[0], {one.label: one.slope[free] for one in quantities(problem, x, free)}
    sd = {label: float(np.sqrt(g @ C @ g)) for label, g in wanted.items()}
    parts = {
        name: {label: float(np.sum((J[own] @ (C @ g)) ** 2)) for label, g in wanted.items()}
        for name, own in rows.items()
    }
    total = {label: max(sum(part[label] for part in parts.values()), 1e-300) for label in wanted}
    out = []
    for name, own in rows.items():
        left = fisher(np.delete(J, own, 0))[0] if len(rows) > 1 else None
        without: dict[str, float | None] = dict.fromkeys(wanted)
        for label, g in wanted.items():
            alone = float(np.sqrt(g @ left @ g)) if left is not None else np.inf
            if alone < IDENTIFIABLE and sd[label] > 0:
                without[label] = alone / sd[label]
        shares = {label: parts[name][label] / total[label] for label in wanted}
        out.append(Contribution(name, own.stop - own.start, shares, without))
    return out
