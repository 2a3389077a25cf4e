"""The information in a Jacobian: covariance of the coordinates, their shift by an error of the model, and which combinations
of parameters are seen where each of them is not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoft.sysid.problem.recording import Array


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


CLOSER = 3.0
"""How many times better than each of its parameters a combination must be known, to be worth a sentence."""

AS_GOOD = 1.3
"""How much larger the standard deviation of a combination may become by rounding its exponents."""

MINE = 0.7
"""Correlation of a parameter with a direction above which its uncertainty comes from there."""

EXPONENTS = {1.0: 0.1, 0.5: 0.1, 0.1: 0.2, 0.05: 0.2}
"""What exponents are rounded to multiples of, the roundest first, and the part of its parameters' least standard deviation that
a combination may then have whatever it had."""


@dataclass(frozen=True)
class Combination:
    """A product of powers of parameters that data see better than each of its factors: exponents and standard deviations of
    the parameters by label, and the standard deviation of the product, all relative."""

    exponents: dict[str, float]
    sds: dict[str, float]
    sd: float

    @property
    def formula(self) -> str:
        """Such as `contact.K_n / contact.R_n` or `pad.E * contact.K_n^0.4`."""
        powers = {name: "" if abs(p) == 1 else f"^{abs(p):g}" for name, p in self.exponents.items()}
        above = [name + powers[name] for name, p in self.exponents.items() if p > 0]
        below = [name + powers[name] for name, p in self.exponents.items() if p < 0]
        return " * ".join(above) + "".join(f" / {one}" for one in below)

    @property
    def sentence(self) -> str:
        each = ", ".join(f"{name} {percent(sd)}" for name, sd in self.sds.items())
        return f"the data see {self.formula} to {percent(self.sd)}, not each ({each})"


def percent(sd: float) -> str:
    """A relative standard deviation."""
    return "not at all" if sd >= 10 else f"{100 * sd:.2g} %"


def combinations(labels: Sequence[str], C: Array, blurred: float) -> list[Combination]:
    """What is seen of parameters that are not: for every direction in which they are less certain than `blurred` together, the
    best determined product of powers of the parameters that take part.

    C (n, n) is the covariance of the logarithms of the parameters `labels`, whatever else was fitted being left out of it. A
    direction whose product is not `CLOSER` times better known than each of its factors is left out: its parameters are not
    seen at all.
    """
    values, vectors = np.linalg.eigh(C)
    out: list[Combination] = []
    for k in np.argsort(values)[::-1]:
        part = np.flatnonzero(np.abs(vectors[:, k]) * np.sqrt(values[k] / np.diag(C)) > MINE)
        if values[k] < blurred**2 or len(part) < 2:
            continue
        own = C[np.ix_(part, part)]
        exponents = rounded(np.linalg.eigh(own)[1][:, 0], own)
        sd, sds = float(np.sqrt(exponents @ own @ exponents)), np.sqrt(np.diag(own))
        used, names = exponents != 0, [labels[int(i)] for i in part]
        found = Combination(
            {name: float(p) for name, p in zip(names, exponents) if p},
            {name: float(s) for name, s, p in zip(names, sds, exponents) if p},
            sd,
        )
        if used.sum() > 1 and CLOSER * sd < (sds * np.abs(exponents))[used].min() and found not in out:
            out.append(found)
    return out


def rounded(direction: Array, C: Array) -> Array:
    """A direction (n,) whose largest component is 1, the others rounded as far as the variance in C (n, n) allows."""
    exact = direction / direction[np.argmax(np.abs(direction))]
    own, least = float(exact @ C @ exact), float(np.diag(C).min())
    for part, small in EXPONENTS.items():
        p = np.round(part * np.round(exact / part), 3)
        if float(p @ C @ p) <= max(AS_GOOD**2 * own, small**2 * least):
            return p
    return np.round(exact, 3)
