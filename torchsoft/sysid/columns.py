"""Tables of measurements: CSV with units in the heading, and the trajectory files of this project,
in SI units.

Every error is a `ValueError` in a sentence that names the file, the row and the column.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from torchsoft import csvfile
from torchsoft.csvfile import UNITS
from torchsoft.display import enumerated, nearest
from torchsoft.solve.mcap import read_log
from torchsoft.solve.netcdf import load
from torchsoft.sysid.recording import Array
from torchsoft.tables import shown


class Vocabulary(NamedTuple):
    """Columns of the recordings of a rig: `units` by column, the names of signals, the column that
    every heading stands for, and the angles that are `unwrapped`."""

    units: Mapping[str, str]
    signals: tuple[str, ...]
    headings: Mapping[str, str]
    unwrapped: tuple[str, ...] = ()

    def full(self, name: str) -> str:
        """The column that a name stands for, itself if it is no heading."""
        return self.headings.get(name, name)

    def heading(self, column: str) -> str:
        """The heading of a column."""
        return {of: heading for heading, of in self.headings.items()}[column]

    @property
    def asked(self) -> tuple[str, ...]:
        """Signals and their rates."""
        rates = (f"{name}_dot" for name in self.signals)
        return tuple(name for name in (*self.signals, *rates) if name in self.units)

    @property
    def measured(self) -> tuple[str, ...]:
        """Channels that sensors measure."""
        return tuple(name for name in self.units if name not in ("t", *self.asked))


ROWS = 10
"""A table with set-points has at least as many rows."""

ROUNDED = 16 * np.finfo(np.float64).eps
"""Least time between two rows over the largest: closer ones have lost their last digits."""

GAP = 0.1
"""Longest time [s] between rows: set-points are interpolated between them."""


@dataclass(frozen=True)
class Columns:
    """A table in SI units: `values` (n,) by column, NaN where a sample is missing, the number of
    every row in the file, the columns that are `known`, and the names of those left out."""

    path: Path
    values: dict[str, Array]
    rows: Sequence[int]
    known: Vocabulary
    row: str = "row"
    ignored: tuple[str, ...] = ()

    def at(self, i: int, column: str) -> str:
        """The row and the column as messages name them, the column by its heading."""
        heading = self.known.heading(column)
        channel = "" if heading == column else f" ({column})"
        return f"{self.path}, {self.row} {self.rows[i]}, column `{heading}`{channel}"

    def near(self, time: float) -> str:
        """Names the first row at or after a time [s]."""
        t = self.values["t"]
        i = min(int(np.searchsorted(t, time)), len(t) - 1)
        before = "before " if time < t[0] else ""
        return f"{before}{self.row} {self.rows[i]} (t = {time:.4g} s)"


@dataclass(frozen=True)
class Tables:
    """The tables of one recording, each with times of its own; a column stands in one of them."""

    tables: tuple[Columns, ...]
    known: Vocabulary

    def __contains__(self, column: str) -> bool:
        return any(column in table.values for table in self.tables)

    def of(self, column: str) -> Columns:
        """The table with a column."""
        return next(table for table in self.tables if column in table.values)

    @property
    def columns(self) -> dict[str, tuple[Array, Array]]:
        """Times (n,) [s] and values (n,) by column."""
        return {
            name: (table.values["t"], column)
            for table in self.tables
            for name, column in table.values.items()
            if name != "t"
        }

    @property
    def first_time(self) -> float:
        """When the first sample was taken [s]."""
        measured = (self.columns[name] for name in self.known.measured if name in self)
        times = [float(t[np.isfinite(y)][0]) for t, y in measured if np.isfinite(y).any()]
        return min(times, default=float(self.tables[0].values["t"][0]))

    def near(self, time: float) -> str:
        """Names the file with the set-points, and the first row at or after a time [s]."""
        asked = (self.of(name) for name in self.known.signals if name in self)
        table = next(asked, self.tables[0])
        return f"{table.path}, {table.near(time)}"


def read_tables(paths: Sequence[Path], ignore: Collection[str], known: Vocabulary) -> Tables:
    """The tables of one recording. Raises `ValueError` for a column that is there twice, and for
    samples at times without set-points."""
    tables = [read_table(path, ignore, known) for path in paths]
    names = ", ".join(str(path) for path in paths)
    for i, table in enumerate(tables):
        for other in tables[:i]:
            if twice := (table.values.keys() & other.values.keys()) - {"t"}:
                raise ValueError(
                    f"column `{min(twice)}` is in {other.path} and in {table.path}: one recording "
                    "has it once"
                )
    there = {name for table in tables for name in table.values}
    for name in known.signals:
        if f"{name}_dot" in there and not any(
            {name, f"{name}_dot"} <= table.values.keys() for table in tables
        ):
            raise ValueError(f"{names}: the columns `{name}` and `{name}_dot` must be in one file")
    made = Tables(tuple(tables), known)
    check_times(made)
    return made


def check_times(tables: Tables) -> None:
    """Raises `ValueError` for samples that were taken where a set-point is not known."""
    for name in (name for name in tables.known.signals if name in tables):
        known = tables.of(name)
        t = known.values["t"]
        for table in tables.tables:
            own = table.values["t"]
            for i, over, where in ((0, t[0] - own[0], "begins"), (-1, own[-1] - t[-1], "ends")):
                if over > np.diff(t).max():
                    raise ValueError(
                        f"{table.at(i, 't')}: {own[i]:g} s is {over:.3g} s outside the "
                        f"times of `{name}`, which {where} at {t[i]:g} s ({known.path}): nothing "
                        "says what was asked for then"
                    )


def read_table(path: Path, ignore: Collection[str], known: Vocabulary) -> Columns:
    """A CSV, NetCDF or MCAP file, by its suffix, without the columns `ignore`, and with angles
    unwrapped. Raises `ValueError` for others that wrap."""
    binary = path.suffix in (".nc", ".h5", ".mcap")
    table = (read_trajectory if binary else read_csv)(path, ignore, known)
    for name, y in table.values.items():
        if known.units[name] != "rad":
            continue
        rows = np.flatnonzero(np.isfinite(y))
        if name in known.unwrapped:
            y[rows] = np.unwrap(y[rows])
        elif len(turns := wraps(y[rows])):
            i = int(turns[0])
            raise ValueError(
                f"{table.at(int(rows[i + 1]), name)} jumps by a turn, from "
                f"{y[rows[i]]:.4g} to {y[rows[i + 1]]:.4g} rad, as an angle does that wraps: set "
                f"columns.{known.heading(name)}.unwrap = true"
            )
    return table


def wraps(angle: Array) -> NDArray[np.intp]:
    """Samples of an angle [rad] after which it jumps by a turn, while it mostly moves by far
    less."""
    apart = np.abs(np.diff(angle))
    if not len(apart) or np.median(apart) > math.pi / 2:
        return np.zeros(0, np.intp)
    return np.flatnonzero(np.abs(apart - 2 * math.pi) <= math.pi / 2)


def hint(name: str, columns: int, names: Collection[str]) -> str:
    """Remedy for an unknown column: the nearest name, and how to leave the column out."""
    known = f"columns are {enumerated(names)}, each with its unit in brackets"
    if columns == 1:
        return f"; separate columns with commas, semicolons or tabs; {known}"
    plain = {re.sub(r"[^a-z]", "", one.lower()): one for one in names} | {"time": "t"}
    near = nearest(re.sub(r"[^a-z]", "", name.lower()), plain)
    meant = f": did you mean `{plain[near]}`? If" if near else "; if"
    return (
        f"{meant} it has nothing to do with the motion, set ignore = [{shown(name)}]; if it is one "
        f"under another name, state that in [columns]; {known}"
    )


def read_csv(path: Path, ignore: Collection[str], known: Vocabulary) -> Columns:
    """A table of numbers under `name [unit]`. Raises `ValueError` naming the row and the column."""
    units = {name: UNITS[unit] for name, unit in known.units.items()}
    table = csvfile.read(path, units, lambda name, n: hint(name, n, units), ignore, known.headings)
    return check_table(Columns(path, table.values, table.rows, known, ignored=table.ignored))


def read_trajectory(path: Path, ignore: Collection[str], known: Vocabulary) -> Columns:
    """The table in a file of `Trajectory.save` or `to_mcap`; rows are called samples, counted from
    0. Raises `ValueError`."""
    data = read_log(path) if path.suffix == ".mcap" else load(path)
    values = read_channels(data, path, known)
    left_out = tuple(name for name in ignore if values.pop(known.full(name), None) is not None)
    table = Columns(path, values, list(range(len(values.get("t", ())))), known, "sample", left_out)
    for name, column in values.items():
        if (bad := np.flatnonzero(~np.isfinite(column))).size:
            raise ValueError(f"{table.at(bad[0], name)} is not a finite number")
    return check_table(table)


def read_channels(data: xr.Dataset, path: Path, known: Vocabulary) -> dict[str, Array]:
    """The channels of a trajectory. Raises `ValueError` where it has none of them, or has one in
    another unit or form than the rig's."""
    there = {name: data[name] for name in known.units if name in data and name != "t"}
    if "time" not in data.coords or not there:
        raise ValueError(
            f"{path} is not a trajectory file of this rig: it has no time and channels"
        )
    for name, one in there.items():
        if one.dims != ("time",) or one.dtype != np.float64:
            raise ValueError(
                f"{path} is not a trajectory file: `{name}` should be float64 over time"
            )
        if one.attrs.get("units") != known.units[name]:
            raise ValueError(
                f"{path}, `{name}` should be in {known.units[name]}, not "
                f"{shown(one.attrs.get('units'))}"
            )
    values = {"t": data["time"], **there}
    return {name: np.array(one.values, float) for name, one in values.items()}


def check_table(table: Columns) -> Columns:
    """The table, where its times and set-points can be used. Raises `ValueError` naming row and
    column."""
    path, values = table.path, table.values
    if "t" not in values:
        raise ValueError(f"{path} has no column `t`")
    setpoints = [name for name in table.known.asked if name in values]
    if len(table.rows) < (least := ROWS if setpoints else 2):
        raise ValueError(
            f"{path} has {len(table.rows)} rows of numbers, but needs at least {least}"
        )
    for name in ("t", *setpoints):
        if (empty := np.flatnonzero(np.isnan(values[name]))).size:
            raise ValueError(
                f"{table.at(empty[0], name)} is empty; only measured channels may have gaps"
            )
    t, most = values["t"], GAP if setpoints else np.inf
    apart = np.diff(t)
    for i in np.flatnonzero(~((apart > 0) & (apart <= most)))[:1]:
        fault = (
            f"{apart[i]:.3g} s are missing before it; set-points are needed every {GAP} s or "
            "more often"
        )
        if apart[i] == 0:
            fault = (
                f"the time {t[i]:g} s is there twice: delete one of the two rows, or, if times "
                "were rounded, write them with more digits"
            )
        elif apart[i] < 0:
            fault = (
                f"time goes back, from {t[i]:g} to {t[i + 1]:g} s: sort the rows by time, or, if "
                "the clock started again there, give what follows as a recording of its own"
            )
        raise ValueError(f"{table.at(i + 1, 't')}: {fault}")
    for i in np.flatnonzero(apart < ROUNDED * np.abs(t).max())[:1]:
        raise ValueError(
            f"{table.at(i + 1, 't')}: {t[i + 1]:.9g} s is too far from zero to be told from "
            "the time before it; count times from the start"
        )
    return table
