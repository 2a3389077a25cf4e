"""Tables of measurements: CSV with units in the heading, and the trajectory files of this project,
in SI units.

Every error is a `ValueError` in a sentence that names the file, the row and the column.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import xarray as xr

from torchsoft import csvfile
from torchsoft.channels import CHANNELS, FEED_FORWARD, MEASURED, SETPOINTS, UNITS, VARIABLES
from torchsoft.solve.trajectory import load
from torchsoft.sysid.recording import Array
from torchsoft.tables import shown

COLUMNS = ("t", *SETPOINTS, *FEED_FORWARD, *MEASURED)
"""Names that a column may have."""

ROWS = 10
"""A table with set-points has at least as many rows."""

LATE = 1e6
"""Largest time [s]: later ones lose their last digits."""

GAP = 0.1
"""Longest time [s] between rows: set-points are interpolated between them."""


@dataclass(frozen=True)
class Columns:
    """A table in SI units: `values` (n,) by column, NaN where a sample is missing, the number of
    every row in the file, and the names of columns that were left out."""

    path: Path
    values: dict[str, Array]
    rows: list[int]
    row: str = "row"
    ignored: tuple[str, ...] = ()

    def at(self, i: int) -> str:
        """The row as messages name it."""
        return f"{self.path}, {self.row} {self.rows[i]}"

    def near(self, time: float) -> str:
        """Names the first row at or after a time [s]."""
        t = self.values["t"]
        i = min(int(np.searchsorted(t, time)), len(t) - 1)
        before = "before " if time < t[0] else ""
        return f"{before}{self.row} {self.rows[i]} (t = {time:.4g} s)"


@dataclass(frozen=True)
class Tables:
    """The tables of one recording, each with times of its own; a column stands in one of them.
    `constants` are columns that were stated in the place of missing ones."""

    tables: tuple[Columns, ...]
    constants: tuple[str, ...] = ()

    def __contains__(self, column: str) -> bool:
        return any(column in table.values for table in self.tables)

    def of(self, column: str) -> Columns:
        """The table with a column. Raises `KeyError`."""
        for table in self.tables:
            if column in table.values:
                return table
        raise KeyError(column)

    @property
    def columns(self) -> dict[str, tuple[Array, Array]]:
        """Times (n,) [s] and values (n,) by column."""
        return {
            name: (table.values["t"], column)
            for table in self.tables for name, column in table.values.items() if name != "t"
        }  # fmt: skip

    @property
    def begin(self) -> float:
        """When the first sample was taken [s]."""
        measured = [t[np.isfinite(y)] for name, (t, y) in self.columns.items() if name in MEASURED]
        return min(
            (float(t[0]) for t in measured if len(t)), default=float(self.tables[0].values["t"][0])
        )

    def near(self, time: float) -> str:
        """Names the file with the set-points, and the first row at or after a time [s]."""
        table = self.of("y_d")
        return f"{table.path}, {table.near(time)}"


def read_tables(
    paths: Sequence[Path], ignore: Collection[str], constants: Mapping[str, float]
) -> Tables:
    """The tables of one recording; a column that none has is a constant, where one is stated.
    Raises `ValueError` for a column that is there twice, or is needed and missing, and for samples
    at times without set-points."""
    tables = [read_table(path, ignore) for path in paths]
    names = ", ".join(str(path) for path in paths)
    for i, table in enumerate(tables):
        for other in tables[:i]:
            if twice := (table.values.keys() & other.values.keys()) - {"t"}:
                raise ValueError(
                    f"column `{min(twice)}` is in {other.path} and in {table.path}: one recording "
                    "has it once"
                )
    there = {name for table in tables for name in table.values}
    for name in SETPOINTS:
        if name not in there and name not in constants:
            raise ValueError(
                f"{names} has no column `{name}`; it needs t, x_d, y_d and at least one of "
                f"{', '.join(MEASURED)}"
            )
        if f"{name}_dot" in there and not any(
            {name, f"{name}_dot"} <= table.values.keys() for table in tables
        ):
            raise ValueError(f"{names}: the columns `{name}` and `{name}_dot` must be in one file")
    if "F_ff" not in there and "F_ff" not in constants:
        raise ValueError(
            f"{names} has no column `F_ff`, and nothing says which force was fed forward to the "
            f"bracket: give the column, or state a constant [N], missing = {{F_ff = 0.0}} where "
            "there was none"
        )
    most = max(range(len(tables)), key=lambda i: len({*SETPOINTS} & tables[i].values.keys()))
    stated = {name: value for name, value in constants.items() if name not in there}
    table = tables[most]
    filled = {name: np.full(len(table.rows), value) for name, value in stated.items()}
    tables[most] = check_table(replace(table, values=table.values | filled))
    made = Tables(tuple(tables), tuple(stated))
    check_times(made)
    return made


def check_times(tables: Tables) -> None:
    """Raises `ValueError` for samples that were taken where a set-point is not known."""
    asked = {name: tables.of(name) for name in (*SETPOINTS, "F_ff")}
    for name, known in asked.items():
        t = known.values["t"]
        slack = float(np.diff(t).max())
        for table in tables.tables:
            for i, where in ((0, "begins"), (-1, "ends")):
                over = (t[0] - table.values["t"][0]) if i == 0 else (table.values["t"][-1] - t[-1])
                if over > slack:
                    raise ValueError(
                        f"{table.at(i)}, column `t`: {table.values['t'][i]:g} s is {over:.3g} s "
                        f"outside the times of `{name}`, which {where} at {t[i]:g} s "
                        f"({known.path}): nothing says what was asked for then"
                    )


def read_table(path: Path, ignore: Collection[str] = ()) -> Columns:
    """A CSV or NetCDF file, by its suffix, without the columns `ignore`."""
    return (
        read_trajectory(path, ignore) if path.suffix in (".nc", ".h5") else read_csv(path, ignore)
    )


def hint(name: str, columns: int) -> str:
    """What helps with a column that is not known: the nearest name, and how to leave it out."""
    known = f"columns are {', '.join(COLUMNS)}, each with its unit in brackets"
    if columns == 1:
        return f"; separate columns with commas; {known}"
    plain = {re.sub(r"[^a-z]", "", one.lower()): one for one in COLUMNS} | {"time": "t"}
    near = get_close_matches(re.sub(r"[^a-z]", "", name.lower()), plain, n=1, cutoff=0.6)
    meant = f": is it `{plain[near[0]]}`? If" if near else "; if"
    return f"{meant} it has nothing to do with the motion, say ignore = [{shown(name)}]; {known}"


def read_csv(path: Path, ignore: Collection[str] = ()) -> Columns:
    """A table of numbers under `name [unit]`. Raises `ValueError` naming the row (the heading is
    row 1) and the column."""
    table = csvfile.read(path, {name: UNITS[CHANNELS[name].unit] for name in COLUMNS}, hint, ignore)
    return check_table(Columns(path, table.values, table.rows, ignored=table.ignored))


def read_trajectory(path: Path, ignore: Collection[str] = ()) -> Columns:
    """The table in a file of `Trajectory.save`; rows are called samples, counted from 0. Raises
    `ValueError`."""
    data = load(path)
    values = read_columns(data, path)
    left_out = tuple(name for name in values if name in ignore)
    values = {name: column for name, column in values.items() if name not in ignore}
    table = Columns(path, values, list(range(len(values.get("t", ())))), "sample", left_out)
    for name, column in values.items():
        if (bad := np.flatnonzero(~np.isfinite(column))).size:
            raise ValueError(f"{table.at(bad[0])}, `{name}` is not a finite number")
    return check_table(table)


def read_columns(data: xr.Dataset, path: Path) -> dict[str, Array]:
    """The columns of a trajectory. Raises `ValueError` where it has not what a trajectory has."""
    columns = {name: CHANNELS[name] for name in COLUMNS}
    if CHANNELS["y_d_dot"].variable not in data:  # as in files of the first edition
        del columns["y_d_dot"]
    variables = {c.variable: VARIABLES[c.variable] for c in columns.values()}
    if missing := [name for name in variables if name not in data]:
        raise ValueError(f"{path} is not a trajectory file: it has no {', '.join(missing)}")
    for name, variable in variables.items():
        one, axes = data[name], ("time", "axis")[: 1 if len(variable.symbols) == 1 else 2]
        if (
            one.dims != axes
            or one.dtype != np.float64
            or ("axis" in axes and one.sizes["axis"] != 2)
        ):
            raise ValueError(
                f"{path} is not a trajectory file: `{name}` should be float64 over "
                f"{' and '.join(axes)}"
            )
        if one.attrs.get("units") != variable.unit:
            raise ValueError(
                f"{path}, `{name}` should be in {variable.unit}, not "
                f"{shown(one.attrs.get('units'))}"
            )
    return {name: np.array(c.of(data[c.variable].values), float) for name, c in columns.items()}


def check_table(table: Columns) -> Columns:
    """The table, where its times and set-points can be used. Raises `ValueError` naming row and
    column."""
    path, values = table.path, table.values
    if "t" not in values:
        raise ValueError(f"{path} has no column `t`")
    asked = [name for name in (*SETPOINTS, *FEED_FORWARD) if name in values]
    if len(table.rows) < (least := ROWS if asked else 2):
        raise ValueError(
            f"{path} has {len(table.rows)} rows of numbers, but needs at least {least}"
        )
    for name in ("t", *asked):
        if (empty := np.flatnonzero(np.isnan(values[name]))).size:
            raise ValueError(
                f"{table.at(empty[0])}, column `{name}` is empty; only measured channels may have "
                "gaps"
            )
    apart_by = np.diff(values["t"])
    for i in np.flatnonzero(~((apart_by > 0) & (apart_by <= (GAP if asked else np.inf))))[:1]:
        t, before = values["t"][i + 1], values["t"][i]
        if t == before:
            what = f"the time {t:g} s is there twice"
        elif t < before:
            what = f"time goes back, from {before:g} to {t:g} s"
        else:
            what = (
                f"{t - before:.3g} s are missing before it; set-points are needed every {GAP} s or "
                "oftener"
            )
        raise ValueError(f"{table.at(i + 1)}, column `t`: {what}")
    if (late := np.flatnonzero(np.abs(values["t"]) > LATE)).size:
        raise ValueError(
            f"{table.at(late[0])}, column `t`: {values['t'][late[0]]:.9g} s is too far from zero; "
            "count times from the start"
        )
    return table
