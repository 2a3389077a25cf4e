"""Relaxation series and chains of Kelvin elements fitted to tests: nonnegative least squares on a
grid of times, then the times themselves.

A relaxation test and a frequency sweep give a relaxation series (`Prony`), a creep test a chain of
Kelvin elements (`GeneralisedKelvin`), in how many terms Schwarz's criterion (BIC) says. Residuals
count relative to the largest response, or to the response of each row (`Measured.relative`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares, nnls

from torchsoft.materials.measured import SMALL_STRAIN, Array, Measured, Spectrum, instant_time
from torchsoft.physics.hyperelastic import KINDS
from torchsoft.physics.material import Material

GRID = 10
"""Times a decade of the grid that fits begin on."""

STEP = 1e-5
"""Change of a time's logarithm by which its slopes are taken."""

PASSES = 100
"""Iterations of the nonnegative fit for each time of the grid, at the most."""

MOST = 12
"""Terms that are tried at the most; at the most one for every decade that the rows resolve, and one
more."""

PATIENCE = 2
"""Numbers of terms, one after the other, that may fit worse than the best one before no more are
tried."""

UNSURE = 0.5
"""Relative standard deviation from which a coefficient is called hardly determined."""

COLOURED = 0.3
"""Correlation of neighbouring residuals from which they are called a pattern."""

EDGE = 1.05
"""A time within this factor of the shortest or longest one that the rows resolve stands at the
edge."""

VANISHED = 1e-6
"""Strength over the sum of all below which a term is none."""

FLOW = 100.0
"""Longest time of a chain that represents a flow, over that of the test."""

ROUNDING = 1e-12
"""Residual over the largest answer below which a fit is exact."""

SWEPT_PART = 0.01
"""That time over the shortest one of a sweep."""


@dataclass(frozen=True)
class Fit:
    """A series fitted to a test: `values` of E [Pa] and of every E_i [Pa] or J_i [1], and tau_i
    [s], with their standard deviations `sd`; the `fitted` answer (n,); and the criterion by the
    number of terms, the least being the best.

    Where residuals follow a pattern the deviations count as many independent rows as their
    correlation leaves.
    """

    measured: Measured | Spectrum
    values: Mapping[str, float]
    sd: Mapping[str, float]
    fitted: Array
    scores: Mapping[int, float]
    correlation: float
    notices: tuple[str, ...]

    @property
    def test(self) -> str:
        """Kind of test."""
        return self.measured.test

    @property
    def kind(self) -> str:
        """Kind of the material in files."""
        return "generalised_kelvin" if self.measured.test == "creep" else "prony"

    @property
    def terms(self) -> int:
        return (len(self.values) - 1) // 2

    @property
    def undetermined(self) -> list[str]:
        """Terms, with their values, whose strength the rows do not determine."""
        return [
            f"{name} = {self.values[name]:.3g} at {self.values[f'tau_{number}']:.3g} s"
            for name in unsure(self.values, self.sd)
            for symbol, _, number in [name.partition("_")]
            if number and symbol != "tau"
        ]

    @property
    def residual(self) -> Array:
        """Measured less fitted (n,)."""
        return self.measured.answer - self.fitted

    @property
    def rms(self) -> float:
        """Root mean square of the residual relative to `Measured.size`."""
        return float(np.sqrt(np.mean((self.residual / self.measured.size) ** 2)))

    @property
    def described(self) -> str:
        """What was fitted, and how well."""
        part = "of each row" if self.measured.relative else "of the largest"
        return f"{self.kind} of {self.terms} terms, residual {self.rms:.2%} {part}"

    def method(self) -> dict[str, Any]:
        """How the coefficients were found, and how well they fit, for a summary in JSON."""
        return {
            "method": "nonnegative least squares on a logarithmic grid of times, then least "
            "squares in strengths and times together; the number of terms by Schwarz's criterion "
            "(BIC)",
            "rows": len(self.measured.t),
            "resolved_s": list(self.measured.window),
            "largest_strain": self.measured.largest_strain,
            "criterion": {str(count): score for count, score in self.scores.items()},
            "residual_rms": self.rms,
            "residual_of": "of each row" if self.measured.relative else "of the largest",
            "residual_correlation": self.correlation,
        }

    def table(self) -> dict[str, Any]:
        """The arguments of the material's constructor that the test determines, and tau_instant."""
        own = arguments(self.values, {"E": "moduli"})
        instant = instant_time(own["tau"])
        if isinstance(self.measured, Spectrum):  # its dashpot adds omega tau_instant to the loss
            instant = min(instant, SWEPT_PART * self.measured.window[0])
        return own | {"tau_instant": instant}

    def material(self, **others: float) -> Material:
        """The material, with stated values of nu, rho and depth, of which a test in one dimension
        has no information."""
        return KINDS[self.kind](**self.table(), **others)


def arguments(
    values: Mapping[str, float], names: Mapping[str, str] = MappingProxyType({})
) -> dict[str, Any]:
    """Coefficients as the arguments of a constructor: `mu_2` is the second entry of the list `mu`,
    or of the list that `names` has for it."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        symbol, _, number = name.partition("_")
        if number:
            out.setdefault(names.get(symbol, symbol), []).append(value)
        else:
            out[name] = value
    return out


def unsure(values: Mapping[str, float], sd: Mapping[str, float]) -> list[str]:
    """Coefficients with large standard deviations."""
    return [name for name in values if not sd[name] <= UNSURE * abs(values[name])]


def hardly_determined(values: Mapping[str, float], sd: Mapping[str, float]) -> list[str]:
    """A notice on coefficients with large standard deviations, if there are any."""
    names = ", ".join(unsure(values, sd))
    known = f"hardly determined, with a standard deviation above {UNSURE:.0%}: {names}"
    return [known] if names else []


def covariance_root(jacobian: Array) -> Array:
    """A matrix R (n, n), for which R times its transpose is the inverse of that of the jacobian
    (rows, n) times it."""
    unit = np.linalg.norm(jacobian, axis=0)
    _, s, V = np.linalg.svd(jacobian / unit, full_matrices=False)
    return V.T / np.maximum(s, 1e-300) / unit[:, None]


class Trial(NamedTuple):
    """A fit with some number of times: coefficients c (1 + terms,) and the unit of each, times tau
    (terms,) [s], residuals (n,) over the largest answer, and their slopes (n, 1 + 2 terms) by c in
    its units and by ln tau."""

    c: Array
    unit: Array
    tau: Array
    r: Array
    J: Array

    @property
    def score(self) -> float:
        n, parameters = self.J.shape
        return n * math.log(max(float(self.r @ self.r) / n, ROUNDING**2)) + parameters * math.log(n)


def fit(measured: Measured | Spectrum, *, terms: int | None = None) -> Fit:
    """The series with the least criterion among those whose every strength the rows determine, if
    there is one, or with as many `terms` as asked for. Raises `ValueError` where the rows are too
    few for these, or determine no relaxed modulus."""
    shortest, longest = measured.window
    most = min(MOST, 2 + int(math.log10(longest / shortest)), (len(measured.answer) - 2) // 2)
    if terms is not None and not 1 <= terms <= most:
        raise ValueError(
            f"`terms` must be from 1 to {most} for what {measured.path} resolves, but is {terms}"
        )
    tried: dict[int, Trial] = {}
    for count in range(1, most + 1) if terms is None else (terms,):
        found = [
            trial
            for begin in beginnings(measured, count)
            if (trial := refined(measured, begin)) is not None
        ]
        if found:
            tried[count] = min(found, key=lambda trial: trial.score)
        best = min(tried, key=lambda k: tried[k].score, default=count)
        if count - best >= PATIENCE:
            break
    if not tried:
        raise ValueError(
            f"{measured.path}: no relaxed modulus remains, or nothing changes in time: a series "
            "needs an E above zero, and terms; measure for longer, or look at the columns"
        )
    scores = {count: trial.score for count, trial in tried.items()}
    fits = [concluded(measured, tried[k], scores) for k in sorted(tried, key=scores.__getitem__)]
    determined = [one for one in fits if not one.undetermined]
    if terms is not None or not determined or determined[0] is fits[0]:
        return fits[0]
    left = (
        f"{fits[0].terms} terms fit better, but {determined[0].terms} are taken: the rows do not "
    )
    left += f"determine {', '.join(fits[0].undetermined)} of the others"
    return replace(determined[0], notices=(*determined[0].notices, left))


def beginnings(measured: Measured | Spectrum, count: int) -> list[Array]:
    """Times [s] that a fit may begin with: spread evenly over the decades, and where nonnegative
    least squares on the grid finds them, neighbours put together until so many are left."""
    low, high = (math.log(x) for x in measured.window)
    even = np.linspace(low, high, 2 * count + 1)[1::2]
    grid = np.linspace(low, high, max(2, round(GRID * (high - low) / math.log(10))))
    c = coefficients(measured, np.exp(grid))[1:]
    groups = [(c[i], grid[i]) for i in np.flatnonzero(c)]
    while len(groups) > count:
        i = int(np.argmin([groups[i + 1][1] - groups[i][1] for i in range(len(groups) - 1)]))
        (a, x), (b, y) = groups[i : i + 2]
        groups[i : i + 2] = [(a + b, (a * x + b * y) / (a + b))]
    own = [np.array([x for _, x in groups])] if len(groups) == count else []
    return [np.exp(x) for x in (even, *own)]


def coefficients(measured: Measured | Spectrum, tau: Array) -> Array:
    """Nonnegative coefficients (1 + terms,) of the series with given times."""
    size = measured.size
    A = measured.responses(tau) / size[:, None]
    scale = np.abs(A).max(0)
    return nnls(A / scale, measured.answer / size, maxiter=PASSES * len(scale))[0] / scale


def refined(measured: Measured | Spectrum, tau: Array) -> Trial | None:
    """The least-squares fit from these times on, within what the rows resolve; None where a term,
    or the modulus that remains, vanishes."""
    size, (low, high) = measured.size, measured.window
    high *= FLOW if measured.flows else 1.0
    c, count = coefficients(measured, tau), len(tau)

    def weighted(tau: Array) -> Array:
        return measured.responses(tau) / size[:, None]

    scale = 1.0 / np.abs(weighted(tau)).max(0)

    def residuals(z: Array) -> Array:
        A = weighted(np.exp(z[count + 1 :]))
        return A @ (z[: count + 1] * scale) - measured.answer / size

    def slopes(z: Array) -> Array:
        A, later, sooner = (weighted(np.exp(z[count + 1 :] + by)) for by in (0.0, STEP, -STEP))
        by_tau = (later - sooner)[:, 1:] / (2 * STEP) * (z[1 : count + 1] * scale[1:])
        return np.column_stack((A * scale, by_tau))

    z = np.concatenate((np.maximum(c / scale, 1e-6), np.log(tau)))
    bounds = (
        np.repeat([0.0, math.log(low)], [count + 1, count]),
        np.repeat([np.inf, math.log(high)], [count + 1, count]),
    )
    z = np.clip(z, bounds[0] + 1e-9, bounds[1] - 1e-9)
    close: Any = {"xtol": 1e-10, "ftol": 1e-10, "gtol": 1e-12, "max_nfev": 300, "x_scale": "jac"}
    done = least_squares(residuals, z, slopes, bounds, **close)  # pyright: ignore[reportArgumentType]
    c, tau = done.x[: count + 1] * scale, np.exp(done.x[count + 1 :])
    needed = c[1:] if measured.test == "creep" else c  # what creeps may have no spring
    if not (needed > VANISHED * c.sum()).all() or not done.success:
        return None
    order = np.argsort(tau)
    own, every = [0, *(1 + order)], [0, *(1 + order), *(1 + count + order)]
    return Trial(c[own], scale[own], tau[order], done.fun, done.jac[:, every])


def concluded(measured: Measured | Spectrum, best: Trial, scores: Mapping[int, float]) -> Fit:
    """Values and standard deviations, and the combinations that the data cannot constrain."""
    names, values, G = named(measured, best)
    correlation = (
        float(np.corrcoef(best.r[1:], best.r[:-1])[0, 1]) if np.ptp(best.r) > ROUNDING else 0.0
    )
    n, parameters = best.J.shape
    independent = (1 - min(max(correlation, 0.0), 0.99)) / (1 + min(max(correlation, 0.0), 0.99))
    root = G @ covariance_root(best.J)
    sd = np.sqrt((root**2).sum(1) * float(best.r @ best.r) / ((n - parameters) * independent))
    fitted = measured.answer + best.r * measured.size
    made = dict(zip(names, values.tolist())), dict(zip(names, sd.tolist()))
    return Fit(
        measured,
        *made,
        fitted,
        scores,
        correlation,
        tuple(notices(measured, *made, scores, correlation)),
    )


def named(measured: Measured | Spectrum, best: Trial) -> tuple[list[str], Array, Array]:
    """Names and values of the material's coefficients, and their slopes by those of the trial."""
    count = len(best.tau)
    G = np.zeros((1 + 2 * count, 1 + 2 * count))
    G[1 + count :, 1 + count :] = np.diag(best.tau)
    if measured.test != "creep":
        symbol, strengths = "E", best.c
        G[: 1 + count, : 1 + count] = np.diag(best.unit)
    else:  # E = 1 / sum of c, and J_k = c_k E
        symbol, total = "J", float(best.c.sum())
        strengths = np.append(1.0, best.c[1:]) / total
        G[: 1 + count, : 1 + count] = -np.outer(strengths, best.unit) / total
        G[range(1, 1 + count), range(1, 1 + count)] += best.unit[1:] / total
    numbers = range(1, 1 + count)
    names = ["E", *(f"{symbol}_{k}" for k in numbers), *(f"tau_{k}" for k in numbers)]
    return names, np.concatenate((strengths, best.tau)), G


def notices(
    measured: Measured | Spectrum, values: Mapping[str, float], sd: Mapping[str, float],
    scores: Mapping[int, float], correlation: float
) -> list[str]:  # fmt: skip
    """Sentences on unidentifiable coefficients, and on assumptions."""
    (shortest, longest), terms = measured.window, (len(values) - 1) // 2
    verb = "creeps" if measured.test == "creep" else "relaxes"
    sentences = [
        f"the rows resolve times from {shortest:.3g} to {longest:.3g} s: they do not show what "
        f"{verb} faster, and what {verb} slower counts to the relaxed modulus E, which may be "
        "lower still"
    ]
    edge = [
        f"tau_{k}"
        for k in range(1, terms + 1)
        if not EDGE * shortest < values[f"tau_{k}"] < longest / EDGE
    ]
    if edge:
        sentences.append(f"at the edge of what the rows resolve, or beyond: {', '.join(edge)}")
    sentences += hardly_determined(values, sd)
    if len(scores) > 1 and terms == max(scores):
        sentences.append(
            f"more terms than {terms} might fit better still: the criterion was falling up to there"
        )
    if measured.flows:
        sentences.append(
            "the creep flows: under a held stress the strain still grows in proportion to time at "
            "the end, so that no E remains; the slowest term represents a dashpot, and holds up to "
            "the end of the test only"
        )
    if correlation > COLOURED:
        sentences.append(
            f"the residuals follow a pattern (neighbours correlate by {correlation:.2f}): the "
            "series, or the theory, misses something; the standard deviations count as many rows "
            "as that leaves independent, and are too small still"
        )
    largest = measured.largest_strain
    if largest is None:
        sentences.append(
            "the file does not say how large the strain was: the material is linear, and holds for "
            "small ones"
        )
    elif largest > SMALL_STRAIN:
        sentences.append(
            f"strains go up to {largest:.0%}, and the material is linear: these moduli are secants "
            "at that strain, and rubber that is stretched less is another one"
        )
    return sentences
