"""Relaxation and creep tests, and the materials fitted to them: nonnegative least squares on a grid
of times, then the times themselves.

A relaxation test gives a relaxation series (`Prony`), a creep test a chain of Kelvin elements
(`GeneralisedKelvin`), in how many terms Schwarz's criterion (BIC) says. Residuals count relative to
the largest response, or to the response of each row (`Measured.relative`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from torchsoft import csvfile
from torchsoft.channels import UNITS
from torchsoft.physics.arguments import positive
from torchsoft.physics.material import INSTANT, KINDS, Material

# Relaxation and creep tests in one dimension: strain and nominal stress over time, read from CSV
# files in SI units.
#
# A file has the column `t` and one pair of these, each with its unit in the heading: `strain`,
# `stretch` or `elongation` with `stress` or `force`; or `modulus` alone, the stress over a strain
# put on at t = 0 and held; or `compliance` alone, the strain over a stress held so.


Array = NDArray[np.float64]

Test = Literal["relaxation", "creep"]
"""The controlled quantity: strain, so that the stress relaxes; or stress, so that the strain
creeps."""

PRESSURE = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9}
KNOWN: dict[str, csvfile.Units] = {
    "t": {**UNITS["s"], "min": 60.0, "h": 3600.0},
    "strain": {"1": 1.0, "%": 1e-2},
    "stretch": {"1": 1.0},
    "elongation": UNITS["m"],
    "stress": PRESSURE,
    "force": UNITS["N"],
    "modulus": PRESSURE,
    "compliance": {f"1/{unit}": 1 / size for unit, size in PRESSURE.items()},
}
"""Columns, and the units that each may have."""

LEAST = 8
"""Rows that a file needs."""

DECADE = 10.0
"""Ratio of the largest to the smallest response above which residuals count relative to each."""

FLOWING = 0.8
"""Power of time above which creep at the end of a test is a flow: 1 is a dashpot's."""

SMALL_STRAIN = 0.1
"""Strain up to which a linear material is taken at its word."""


@dataclass(frozen=True)
class Measured:
    """A test: times t (n,) [s] since the load was put on, strain (n,) [1], nominal stress (n,)
    [Pa], and which of them was controlled.

    Between rows the controlled quantity is linear in time; it begins at t = 0 with a step to its
    value in the first row. Both may be `per_load`, divided by a controlled quantity that is
    unknown.
    """

    path: Path
    test: Test
    t: Array
    strain: Array
    stress: Array
    per_load: bool = False

    @property
    def driven(self) -> Array:
        """Controlled quantity (n,)."""
        return self.strain if self.test == "relaxation" else self.stress

    @property
    def answer(self) -> Array:
        """Measured response (n,)."""
        return self.stress if self.test == "relaxation" else self.strain

    @property
    def window(self) -> tuple[float, float]:
        """The shortest and the longest time [s] that the rows resolve: that of two neighbouring
        intervals, so that one odd row counts for nothing, and all of the test."""
        intervals = np.diff(self.t, prepend=0.0)
        intervals = intervals[intervals > 0]
        return float(np.maximum(intervals[1:], intervals[:-1]).min()), float(self.t[-1])

    @property
    def relative(self) -> bool:
        """Whether residuals count relative to the response at each row: of a modulus or a
        compliance that spans more than a decade, so that the series is as good at all times."""
        least, most = self.answer.min(), self.answer.max()
        return self.per_load and bool(most > DECADE * least > 0)

    @property
    def size(self) -> Array:
        """Response (n,) that residuals are relative to."""
        size = np.abs(self.answer)
        return size if self.relative else np.full_like(size, size.max())

    @property
    def flows(self) -> bool:
        """Whether strain goes on in proportion to time under a held stress at the end."""
        if self.test == "relaxation" or np.ptp(self.stress[len(self.t) // 2 :]) > 0:
            return False
        half = np.interp(0.5 * self.t[-1], self.t, self.strain)
        return bool(self.strain[-1] > 2**FLOWING * half)


def read(
    path: str | Path,
    *,
    test: Test | None = None,
    length: float | None = None,
    area: float | None = None,
) -> Measured:
    """The test in a CSV file. `length` [m] is the gauge length, which elongations are divided by,
    `area` [m2] the cross-section before the test, for forces. Without `test`, the controlled one of
    strain and stress is that which changes less over the second half of the rows. Raises
    `ValueError` naming file, row and column, and `OSError`.
    """
    path = Path(path)
    table = csvfile.read(path, KNOWN, hint)
    values = table.values
    check_rows(path, table)
    if (alone := {"modulus", "compliance"} & values.keys()) and len(values) > 2:
        raise ValueError(
            f"{path}: `{min(alone)}` stands alone beside `t`, but there is {', '.join(values)}"
        )
    one = np.ones_like(values["t"])
    if alone:
        own: Test = "relaxation" if alone == {"modulus"} else "creep"
        if test not in (None, own):
            raise ValueError(f"{path}: `{min(alone)}` is of a {own} test, not of a {test} test")
        for name, given in (("length", length), ("area", area)):
            if given is not None:
                raise ValueError(f"{path}: nothing is to be divided by the `{name}`")
        strain, stress = (
            (one, values["modulus"]) if own == "relaxation" else (values["compliance"], one)
        )
        return Measured(path, own, values["t"], strain, stress, per_load=True)
    gauge = "an elongation needs the gauge length, `length` [m]"
    section = "a force needs the cross-section, `area` [m2]"
    strain = nominal(path, values, ("strain", "stretch", "elongation"), "length", length, gauge)
    stress = nominal(path, values, ("stress", "force"), "area", area, section)
    for name, x in (("strain", strain), ("stress", stress)):
        if not np.abs(x).max() > 0:
            raise ValueError(f"{path}: the {name} is zero throughout")
    if float(strain @ stress) <= 0:
        raise ValueError(
            f"{path}: strain and stress are opposite; is one of them positive in compression?"
        )
    return Measured(path, test or held(strain, stress), values["t"], strain, stress)


def held(strain: Array, stress: Array) -> Test:
    """The test, by the quantity that changes less, relative to its largest value, in the second
    half of the rows."""
    late = slice(len(strain) // 2, None)
    change = [np.ptp(x[late]) / np.abs(x).max() for x in (strain, stress)]
    return "relaxation" if change[0] <= change[1] else "creep"


def nominal(
    path: Path,
    values: dict[str, Array],
    names: tuple[str, ...],
    option: str,
    size: float | None,
    needs: str,
) -> Array:
    """Nominal strain [1] or stress [Pa] (n,) from the one of the columns `names` that is there, the
    last over `size`. Raises `ValueError` unless it is given in one way."""
    there = [name for name in names if name in values]
    if len(there) != 1:
        found = f"has {' and '.join(there)}" if there else "has none of them"
        raise ValueError(f"{path} needs one of the columns {', '.join(names)}, but {found}")
    (name,), divided = there, there[0] == names[-1]
    if (size is not None) != divided:
        raise ValueError(f"{path}: {needs if size is None else f'`{name}` needs no `{option}`'}")
    if divided:
        return values[name] / positive(option, size)
    return values[name] - 1.0 if name == "stretch" else values[name]


def check_rows(path: Path, table: csvfile.Numbers) -> None:
    """Raises `ValueError` for too few rows, empty cells, and times that do not grow from zero."""
    if "t" not in table.values:
        raise ValueError(f"{path} has no column `t`{hint('t', 2)}")
    if len(table.rows) < LEAST:
        raise ValueError(
            f"{path} has {len(table.rows)} rows of numbers, but needs at least {LEAST}"
        )
    for name, column in table.values.items():
        if (empty := np.flatnonzero(np.isnan(column))).size:
            raise ValueError(f"{path}, row {table.rows[empty[0]]}, column `{name}` is empty")
    t = table.values["t"]
    if t[0] < 0:
        raise ValueError(
            f"{path}, row {table.rows[0]}, column `t`: {t[0]:g} s is before the load; count times "
            "from it"
        )
    if (back := np.flatnonzero(np.diff(t) <= 0)).size:
        i = back[0] + 1
        raise ValueError(
            f"{path}, row {table.rows[i]}, column `t`: {t[i]:g} s is not after {t[i - 1]:g} s"
        )


def hint(name: str, columns: int) -> str:
    """Remedy for an unknown column."""
    known = "; ".join(f"{column} [{', '.join(units)}]" for column, units in KNOWN.items())
    return (
        f"{'; separate columns with commas' if columns == 1 else ''}; columns and their units are "
        f"{known}"
    )


# Fit


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

ROUNDING = 1e-12
"""Residual over the largest answer below which a fit is exact."""

INSTANT_PART = 0.1
"""Largest retardation time of the instantaneous spring, over the shortest time of the series."""


@dataclass(frozen=True)
class Fit:
    """A series fitted to a test: `values` of E [Pa] and of every E_i [Pa] or J_i [1], and tau_i
    [s], with their standard deviations `sd`; the `fitted` answer (n,); and the criterion by the
    number of terms, the least being the best.

    Where residuals follow a pattern the deviations count as many independent rows as their
    correlation leaves.
    """

    measured: Measured
    values: Mapping[str, float]
    sd: Mapping[str, float]
    fitted: Array
    scores: Mapping[int, float]
    correlation: float
    notices: tuple[str, ...]

    @property
    def kind(self) -> str:
        """Kind of the material in files."""
        return "prony" if self.measured.test == "relaxation" else "generalised_kelvin"

    @property
    def terms(self) -> int:
        return (len(self.values) - 1) // 2

    @property
    def residual(self) -> Array:
        """Measured less fitted (n,)."""
        return self.measured.answer - self.fitted

    @property
    def rms(self) -> float:
        """Root mean square of the residual relative to `Measured.size`."""
        return float(np.sqrt(np.mean((self.residual / self.measured.size) ** 2)))

    @property
    def residual_of(self) -> str:
        """The response that `rms` is a part of."""
        return "of each row" if self.measured.relative else "of the largest"

    def table(self) -> dict[str, Any]:
        """The arguments of the material's constructor that the test tells, and tau_instant."""
        symbol, argument = ("E", "moduli") if self.kind == "prony" else ("J", "J")
        numbers = range(1, self.terms + 1)
        tau = [self.values[f"tau_{k}"] for k in numbers]
        strengths = [self.values[f"{symbol}_{k}"] for k in numbers]
        instant = min(INSTANT, INSTANT_PART * min(tau))
        return {"E": self.values["E"], argument: strengths, "tau": tau, "tau_instant": instant}

    def material(self, *, nu: float, rho: float, depth: float) -> Material:
        """The material, with stated values where a test in one dimension has no information."""
        return KINDS[self.kind](**self.table(), nu=nu, rho=rho, depth=depth)


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


def fit(measured: Measured, *, terms: int | None = None) -> Fit:
    """The series with the least criterion, or with as many `terms` as asked for. Raises
    `ValueError` where the rows are too few for these, or tell no modulus that remains."""
    shortest, longest = measured.window
    most = min(MOST, 2 + int(math.log10(longest / shortest)), (len(measured.t) - 2) // 2)
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
    return concluded(measured, tried[best], {count: trial.score for count, trial in tried.items()})


def beginnings(measured: Measured, count: int) -> list[Array]:
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


def coefficients(measured: Measured, tau: Array) -> Array:
    """Nonnegative coefficients (1 + terms,) of the series with given times."""
    size = measured.size
    A = responses(measured.test, measured.t, measured.driven, tau) / size[:, None]
    scale = np.abs(A).max(0)
    return nnls(A / scale, measured.answer / size, maxiter=PASSES * len(scale))[0] / scale


def refined(measured: Measured, tau: Array) -> Trial | None:
    """The least-squares fit from these times on, within what the rows resolve; None where a term,
    or the modulus that remains, vanishes."""
    size, (low, high) = measured.size, measured.window
    c, count = coefficients(measured, tau), len(tau)

    def weighted(tau: Array) -> Array:
        return responses(measured.test, measured.t, measured.driven, tau) / size[:, None]

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
    needed = c if measured.test == "relaxation" else c[1:]  # what creeps may have no spring
    if not (needed > VANISHED * c.sum()).all() or not done.success:
        return None
    order = np.argsort(tau)
    own, every = [0, *(1 + order)], [0, *(1 + order), *(1 + count + order)]
    return Trial(c[own], scale[own], tau[order], done.fun, done.jac[:, every])


def concluded(measured: Measured, best: Trial, scores: Mapping[int, float]) -> Fit:
    """Values and standard deviations, and the combinations that the data cannot constrain."""
    names, values, G = named(measured, best)
    correlation = (
        float(np.corrcoef(best.r[1:], best.r[:-1])[0, 1]) if np.ptp(best.r) > ROUNDING else 0.0
    )
    n, parameters = best.J.shape
    independent = (1 - min(max(correlation, 0.0), 0.99)) / (1 + min(max(correlation, 0.0), 0.99))
    _, s, V = np.linalg.svd(best.J, full_matrices=False)
    root = G @ (V.T / np.maximum(s, 1e-300))
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


def named(measured: Measured, best: Trial) -> tuple[list[str], Array, Array]:
    """Names and values of the material's coefficients, and their slopes by those of the trial."""
    count = len(best.tau)
    G = np.zeros((1 + 2 * count, 1 + 2 * count))
    G[1 + count :, 1 + count :] = np.diag(best.tau)
    if measured.test == "relaxation":
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
    measured: Measured, values: Mapping[str, float], sd: Mapping[str, float],
    scores: Mapping[int, float], correlation: float
) -> list[str]:  # fmt: skip
    """Sentences on unidentifiable coefficients, and on assumptions."""
    (shortest, longest), terms = measured.window, (len(values) - 1) // 2
    verb = "relaxes" if measured.test == "relaxation" else "creeps"
    sentences = [
        f"the rows resolve times from {shortest:.3g} to {longest:.3g} s: they do not tell what "
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
    unsure = [name for name in values if not sd[name] <= UNSURE * values[name]]
    if unsure:
        sentences.append(
            f"hardly determined, with a standard deviation above {UNSURE:.0%}: {', '.join(unsure)}"
        )
    if len(scores) > 1 and terms == max(scores):
        sentences.append(
            f"more terms than {terms} might fit better still: the criterion was falling up to there"
        )
    if measured.flows:
        sentences.append(
            "the creep flows: under a held stress the strain still grows in proportion to time at "
            "the end, so that no E remains; the slowest term stands for a dashpot, and holds up to "
            "the end of the test only"
        )
    if correlation > COLOURED:
        sentences.append(
            f"the residuals follow a pattern (neighbours correlate by {correlation:.2f}): the "
            "series, or the theory, misses something; the standard deviations count as many rows "
            "as that leaves independent, and are too small still"
        )
    largest = float(np.abs(measured.strain).max())
    if measured.per_load:
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


def faded(t: Array, x: Array, tau: Array) -> Array:
    """The integral of exp(-(t - s) / tau) x'(s) over the past s, (n, terms), at times t (n,) [s] >=
    0 of a history x (n,) that steps to x[0] at t = 0, for times tau (terms,) [s]."""
    intervals = np.diff(t, prepend=0.0)[:, None] / tau
    a = np.exp(-intervals)
    slow = np.where(
        intervals > 0, -np.expm1(-intervals) / np.where(intervals > 0, intervals, 1.0), 1.0
    )
    b = np.diff(x, prepend=x[0])[:, None] * slow
    b[0] = x[0] * a[0]
    step = 1  # h_i = a_i h_{i-1} + b_i, twice as many terms summed in every pass
    while step < len(t):
        b[step:], a[step:] = b[step:] + a[step:] * b[:-step], a[step:] * a[:-step]
        step *= 2
    return b


def responses(test: str, t: Array, x: Array, tau: Array) -> Array:
    """Response to each coefficient (n, 1 + terms): of a relaxation series E, E_i [Pa] to the stress
    under the strain x; of a creep series J_0, J_i [1/Pa] to the strain under the stress x."""
    h = faded(t, x, tau)
    return np.column_stack((x, h if test == "relaxation" else x[:, None] - h))
