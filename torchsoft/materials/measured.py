"""Relaxation and creep tests in one dimension: strain and nominal stress over time, read from CSV
files in SI units.

A file has the column `t` and one pair of these, each with its unit in the heading: `strain`,
`stretch` or `elongation` with `stress` or `force`; or `modulus` alone, the stress over a strain put
on at t = 0 and held; or `compliance` alone, the strain over a stress held so.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from torchsoft import csvfile
from torchsoft.channels import UNITS
from torchsoft.physics.arguments import positive

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
        """The shortest and the longest time [s] that the rows resolve: the shortest interval, and
        all of the test."""
        intervals = np.diff(self.t, prepend=0.0)
        return float(intervals[intervals > 0].min()), float(self.t[-1])


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
