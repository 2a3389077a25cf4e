"""Tests of rubber in one dimension, read from tables in SI units: relaxation and creep over time,
frequency sweeps, pulls and compressions.

A table has `t` with one of `strain`, `stretch` and `elongation` and one of `stress` and `force`; or
with `modulus` alone, the stress over a strain put on at t = 0 and held, or `compliance` alone, the
strain over a stress held so. A frequency sweep has `frequency` with storage and loss moduli, of
tension or of shear; a pull needs no `t`.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from torchsoft import csvfile
from torchsoft.csvfile import UNITS
from torchsoft.materials.kinds import PULLS, PullTest, Test
from torchsoft.physics.arguments import positive
from torchsoft.physics.material import INSTANT_TIME

Array = NDArray[np.float64]

PRESSURE = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "psi": 6894.757293168}
SWEPT = {"storage_modulus": "loss_modulus", "storage_shear_modulus": "loss_shear_modulus"}
"""Storage modulus and loss modulus of a sweep, in tension or in shear."""

KNOWN: dict[str, csvfile.Units] = {
    "t": {**UNITS["s"], "h": 3600.0},
    "strain": {"1": 1.0, "%": 1e-2},
    "stretch": {"1": 1.0},
    "elongation": UNITS["m"],
    "stress": PRESSURE,
    "force": UNITS["N"],
    "modulus": PRESSURE,
    "compliance": {f"1/{unit}": 1 / size for unit, size in PRESSURE.items()},
    "frequency": {"Hz": 2 * np.pi, "kHz": 2e3 * np.pi, "rad/s": 1.0, "1/s": 1.0},
    **dict.fromkeys((*SWEPT, *SWEPT.values()), PRESSURE),
    "tan_delta": {"1": 1.0},
}
"""Columns, and the units that each may have."""

POSITIVE = {"modulus", "compliance", "frequency", *SWEPT, *SWEPT.values(), "tan_delta"}
"""Columns without negative values; only a modulus or a compliance may be zero at first."""

LEAST = 8
"""Rows that a file needs; of a sweep, which has two numbers in each, half as many."""

HELD = 0.05
"""Change over the second half of a test, relative to the largest value, up to which a quantity was
held."""

DECADE = 10.0
"""Ratio of the largest to the smallest response above which residuals count relative to each."""

FLOWING = 0.8
"""Power of time above which creep at the end of a test is a flow: 1 is a dashpot's."""

ROUNDED = 1e-6
"""Part of the largest strain by which a range counts as wider: its ends are inside in spite of
rounding."""

INSTANT_PART = 0.1
"""Largest retardation time of the instantaneous spring, over the shortest time of the series."""

NOISES = 12.0
"""Fall of a quantity that must grow, over the standard deviation of its noise, up to which it may
be noise."""

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
    test: Literal["relaxation", "creep"]
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
    def largest_strain(self) -> float | None:
        """Largest strain [1]; None where the table does not state it."""
        return None if self.per_load else float(np.abs(self.strain).max())

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

    def responses(self, tau: Array) -> Array:
        """Response to each coefficient of a series of times tau (terms,) [s], (n, 1 + terms)."""
        return responses(self.test, self.t, self.driven, tau)


@dataclass(frozen=True)
class Spectrum:
    """A frequency sweep: storage and loss modulus E', E'' (n,) [Pa] at circular frequencies (n,)
    [1/s] that grow. `answer` (2n,) is of the one, then of the other; residuals are relative to
    their absolute value |E*|."""

    path: Path
    omega: Array
    storage: Array
    loss: Array
    test: Literal["sweep"] = "sweep"
    per_load: bool = True
    largest_strain: None = None
    relative: bool = True
    flows: bool = False

    @property
    def t(self) -> Array:
        """Times (n,) [s] that the frequencies correspond to."""
        return 1.0 / self.omega

    @property
    def answer(self) -> Array:
        return np.concatenate((self.storage, self.loss))

    @property
    def size(self) -> Array:
        return np.tile(np.hypot(self.storage, self.loss), 2)

    @property
    def window(self) -> tuple[float, float]:
        """The shortest and the longest time [s], of the highest and the lowest frequency."""
        return float(self.t.min()), float(self.t.max())

    def responses(self, tau: Array) -> Array:
        """Response to each coefficient of a series of times tau (terms,) [s], (2n, 1 + terms): i
        omega tau / (1 + i omega tau) of E_i, its real part over its imaginary one."""
        z = 1j * self.omega[:, None] * tau
        z = np.column_stack((np.ones_like(self.omega, complex), z / (1 + z)))
        return np.concatenate((z.real, z.imag))


@dataclass(frozen=True)
class Pull:
    """A pull or a compression up to its largest strain: strain (n,) [1] and nominal stress (n,)
    [Pa] in the direction of the load, the strains between which they are taken, and notices on
    rows that are left out."""

    path: Path
    test: PullTest
    strain: Array
    stress: Array
    strains: tuple[float, float]
    notices: tuple[str, ...]


def read(
    path: str | Path,
    *,
    test: Test | None = None,
    length: float | None = None,
    area: float | None = None,
    nu: float | None = None,
    strains: tuple[float, float] | None = None,
    headings: Mapping[str, str] | None = None,
    ignore: Collection[str] = (),
    whole: bool = False,
    true: bool = False,
) -> Measured | Spectrum | Pull:
    """The test in a table. `length` [m] is the gauge length, which elongations are divided by,
    `area` [m2] the cross-section before the test, for forces, `nu` Poisson's ratio, for moduli of
    shear, `strains` [1] the range of a pull, all of it if the pull counts `whole`; `true` says that
    stresses are per area as it is, not as it was. `headings` are columns of other names, `ignore`
    those to leave out.

    Without `test` a table with `frequency` is a sweep, one without `t` a pull, and one over time
    controls what it holds over the second half. Raises `ValueError` naming file, row and column,
    for what no rubber does (a negative modulus, compression to nothing, a stress or storage modulus
    that falls), or where none was held, and `OSError`.
    """
    path = Path(path)
    table = csvfile.read(path, KNOWN, hint, ignore, headings)
    values = table.values
    check_rows(path, table)
    if "frequency" in values:
        reject(path, "a sweep needs no", length=length, area=area, strains=strains)
        if test not in (None, "sweep"):
            raise ValueError(f"{path}: `frequency` is of a sweep, not of a {test} test")
        return sweep(path, table, nu)
    if test == "sweep":
        raise ValueError(f"{path} has no column `frequency`{hint('frequency', 2)}")
    if {"modulus", "compliance"} & values.keys():
        reject(path, "nothing is to be divided by the", length=length, area=area)
        return per_load(path, values, test)
    strain, stress = loaded(path, table, test, length, area)
    if true and test != "shear":
        stress = stress / (1 + strain)
    pull: PullTest | None = next((one for one in PULLS if one == test), None)
    if pull is not None:
        return pulled(path, pull, table.rows, strain, stress, strains, whole)
    if "t" not in values:
        raise ValueError(
            f"{path} has no column `t`: over time it would be a relaxation or a creep test; for a "
            "modulus set test = tension or compression, and the range of strains"
        )
    if strains is not None:
        raise ValueError(f"{path}: a range of strains is of a tension or a compression test")
    own = test if test in ("relaxation", "creep") else held(path, strain, stress)
    return Measured(path, own, values["t"], strain, stress)


def reject(path: Path, reason: str, **options: object) -> None:
    """Raises `ValueError` for an option that is given although the table has no use for it."""
    for name, given in options.items():
        if given is not None:
            raise ValueError(f"{path}: {reason} `{name}`")


def per_load(path: Path, values: Mapping[str, Array], test: Test | None) -> Measured:
    """The test of a table that has the response to a unit load put on at t = 0. Raises `ValueError`
    for other columns or another test, and for a response that is zero."""
    response = "modulus" if "modulus" in values else "compliance"
    if values.keys() != {"t", response}:
        raise ValueError(
            f"{path}: `{response}` stands alone beside `t`, but there is {', '.join(values)}"
        )
    own = "relaxation" if response == "modulus" else "creep"
    if test not in (None, own):
        raise ValueError(f"{path}: `{response}` is of a {own} test, not of a {test} test")
    if not values[response].any():
        raise ValueError(f"{path}: the {response} is zero throughout")
    t, load, answer = values["t"], np.ones_like(values["t"]), values[response]
    strain, stress = (load, answer) if own == "relaxation" else (answer, load)
    return Measured(path, own, t, strain, stress, per_load=True)


def loaded(
    path: Path, table: csvfile.Numbers, test: Test | None, length: float | None, area: float | None
) -> tuple[Array, Array]:
    """Nominal strain [1] and stress [Pa] (n,), positive in tension. Raises `ValueError` where one
    is zero throughout or they are opposite, and for compression to nothing."""
    gauge = "an elongation needs the gauge length, `length` (--length) [m]"
    section = "a force needs the cross-section, `area` (--area) [m2]"
    values = table.values
    strain = nominal(path, values, ("strain", "stretch", "elongation"), "length", length, gauge)
    stress = nominal(path, values, ("stress", "force"), "area", area, section)
    for name, x in (("strain", strain), ("stress", stress)):
        if not np.abs(x).max() > 0:
            raise ValueError(f"{path}: the {name} is zero throughout")
    if float(strain @ stress) <= 0:
        raise ValueError(
            f"{path}: strain and stress are opposite; is one of them positive in compression?"
        )
    if test == "compression" and strain[np.abs(strain).argmax()] > 0:
        if "stretch" in values:
            raise ValueError(
                f"{path}: stretches go up to {values['stretch'].max():.4g}, but those of a "
                "compression test are below 1: a tension test?"
            )
        strain, stress = -strain, -stress
    if test != "shear" and (gone := np.flatnonzero(strain <= -1)).size:
        raise ValueError(
            f"{path}, row {table.rows[gone[0]]}: the strain is {strain[gone[0]]:.4g}, but a "
            "specimen that is compressed to nothing has -1: look at the unit of the column, at "
            "the gauge length, and at the test"
        )
    return strain, stress


def held(path: Path, strain: Array, stress: Array) -> Literal["relaxation", "creep"]:
    """The test, by the quantity that changes less, relative to its largest value, in the second
    half of the rows. Raises `ValueError` where both change."""
    late = slice(len(strain) // 2, None)
    change = [float(np.ptp(x[late]) / np.abs(x).max()) for x in (strain, stress)]
    if min(change) > HELD:
        raise ValueError(
            f"{path}: neither strain nor stress was held, they change by {change[0]:.0%} and "
            f"{change[1]:.0%} over the second half; set test = relaxation where the strain was "
            "controlled, creep where the stress was, tension or compression for a modulus"
        )
    return "relaxation" if change[0] <= change[1] else "creep"


def falling(values: Array) -> int | None:
    """The row after which values (n,) that must grow fall, by more than `HELD` of the largest and
    more than `NOISES` times their noise, which second differences show; None where they do not."""
    second = np.sort(np.abs(np.diff(values, 2)))
    noise = float(second[3 * (len(second) - 1) // 4]) / (1.15 * np.sqrt(6))  # upper quartile
    fall = np.maximum.accumulate(values) - values
    fallen = np.flatnonzero(fall > max(HELD * values.max(), NOISES * noise))
    return int(values[: fallen[0]].argmax()) if fallen.size else None


def sweep(path: Path, table: csvfile.Numbers, nu: float | None) -> Spectrum:
    """A frequency sweep, from moduli of tension, or of shear with Poisson's ratio. Raises
    `ValueError` for other columns, and for a storage modulus that falls."""
    values = table.values
    ways = {
        frozenset((one, loss)): one for one, own in SWEPT.items() for loss in (own, "tan_delta")
    }
    there = frozenset(values) - {"frequency"}
    if there not in ways:
        raise ValueError(
            f"{path}: beside `frequency` stand storage_modulus and loss_modulus, of tension, or "
            "storage_shear_modulus and loss_shear_modulus; tan_delta may replace the second; but "
            f"there is {', '.join(sorted(there)) or 'none'}"
        )
    one = ways[there]
    shear = "shear" in one
    if shear and nu is None:
        raise ValueError(f"{path}: moduli of shear need Poisson's ratio: E = 2 (1 + nu) G")
    factor = 2 * (1 + nu) if shear and nu is not None else 1.0
    storage = factor * values[one]
    lost = values[min(there - {one})]
    loss = storage * lost if "tan_delta" in there else factor * lost
    order = np.argsort(values["frequency"])
    if (last := falling(storage[order])) is not None:
        raise ValueError(
            f"{path}, row {table.rows[order[last + 1]]}: the storage modulus falls from "
            f"{storage[order[last]]:.4g} Pa although the frequency grows, which no relaxation "
            "does: leave out rows near a resonance or where the specimen slipped"
        )
    return Spectrum(path, values["frequency"][order], storage[order], loss[order])


def pulled(
    path: Path,
    test: PullTest,
    rows: Sequence[int],
    strain: Array,
    stress: Array,
    strains: tuple[float, float] | None,
    whole: bool = False,
) -> Pull:
    """A pull up to its largest strain. Raises `ValueError` without a range that the rows cover, for
    loads in the other direction, and where the strain goes back or the stress falls."""
    largest = int(np.argmax(np.abs(strain)))
    sign = -1.0 if strain[largest] < 0 else 1.0
    if test not in ("compression", "shear") and sign < 0:
        raise ValueError(
            f"{path}, row {rows[largest]}: the strain is negative, {strain[largest]:.4g}: a "
            "compression test?"
        )
    up, load = sign * strain[: largest + 1], sign * stress[: largest + 1]
    if strains is None and whole:
        strains = float(up.min()), float(up[-1])
    if strains is None:
        raise ValueError(
            f"{path}: state the strains between which the modulus is fitted: --range 0 0.1; the "
            f"test goes from {up[0]:.3g} to {up[-1]:.3g}"
        )
    low, high = strains
    back = np.maximum.accumulate(up) - up
    if (turned := np.flatnonzero(back > HELD * up[-1])).size:
        raise ValueError(
            f"{path}, row {rows[turned[0]]}: the strain goes back by {back.max():.2g} on its way "
            f"to the largest one, {up[-1]:.2g}: keep the rows of one loading"
        )
    rounding = ROUNDED * up[-1]
    below, above = up < low - rounding, up > high + rounding
    inside = ~(below | above)
    if not low < high or inside.sum() < LEAST:
        raise ValueError(
            f"{path} has {inside.sum()} rows with strains from {low:g} to {high:g}, but needs at "
            f"least {LEAST}; strains go from {up[0]:.3g} to {up[-1]:.3g}"
        )
    numbers = np.array(rows)
    x, y, numbers_inside = up[inside], load[inside], numbers[: largest + 1][inside]
    if (last := falling(y)) is not None:
        stretch = "" if test == "shear" else f" (a stretch of {1 + np.copysign(x[last], sign):.6g})"
        raise ValueError(
            f"{path}, row {numbers_inside[last + 1]}: the stress falls from {y[last]:.4g} Pa at a "
            f"strain of {x[last]:.6g}{stretch} on, as where a specimen tears or slips: leave out "
            f"rows {numbers_inside[last + 1]} to {numbers_inside[-1]} by a range of strains, "
            f"--range {round(low, 4):g} {x[last]:.6g}"
        )
    left_out = (
        (numbers[: largest + 1][below], f"strains below {low:g}"),
        (numbers[: largest + 1][above], f"strains above {high:g}"),
        (numbers[largest + 1 :], "after the largest strain"),
    )
    notices = tuple(
        f"rows {some[0]} to {some[-1]} were left out ({why})" for some, why in left_out if len(some)
    )
    return Pull(path, test, x, y, (low, high), notices)


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
    """Raises `ValueError` for too few rows, empty cells, negative moduli, and times that do not
    grow from zero."""
    least = LEAST // 2 if "frequency" in table.values else LEAST
    if len(table.rows) < least:
        raise ValueError(
            f"{path} has {len(table.rows)} rows of numbers, but needs at least {least}"
        )
    csvfile.check_complete(path, table, "t")
    for name, column in table.values.items():
        bad = column < 0 if name in ("modulus", "compliance") else column <= 0
        if name in POSITIVE and bad.any():
            unit = next(unit for unit, size in KNOWN[name].items() if size == 1)
            raise ValueError(
                f"{path}, row {table.rows[int(bad.argmax())]}, column `{name}`: "
                f"{column[bad.argmax()]:.4g} {unit} is not above zero: look at the signs and the "
                "offsets of the sensors, and leave out rows of noise alone"
            )
    since = float(table.values.get("t", np.zeros(1))[0])
    if since < 0:
        raise ValueError(
            f"{path}, row {table.rows[0]}, column `t`: {since:g} s is before the load; count times "
            "from it"
        )


def hint(name: str, columns: int) -> str:
    """Remedy for an unknown column."""
    known = "; ".join(f"{column} [{', '.join(units)}]" for column, units in KNOWN.items())
    return (
        f"{'; separate columns with commas, semicolons or tabs' if columns == 1 else ''}; columns "
        f"and their units are {known}; give one of another name by --column NAME={name or 'ITS'}"
        f"; leave others out by --ignore"
    )


def instant_time(tau: Sequence[float]) -> float:
    """Retardation time [s] of the instantaneous spring of a series of times tau [s]."""
    return min(INSTANT_TIME, INSTANT_PART * min(tau))


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
