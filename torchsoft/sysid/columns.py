"""Tables of measurements: CSV with units in the heading, and the trajectory files of this project, in SI units.

Every error is a `ValueError` in a sentence that names the file, the row and the column.
"""

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from torchsoft.channels import CHANNELS, FEED_FORWARD, MEASURED, SETPOINTS, VARIABLES
from torchsoft.solve.trajectory import load
from torchsoft.sysid.recording import Array
from torchsoft.tables import line, shown

COLUMNS = ("t", *SETPOINTS, *FEED_FORWARD, *MEASURED)
"""Names that a column may have."""

UNITS = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180},
    "N": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
}
"""Units by dimension, and what they are in SI."""

ROWS = 10
"""A recording has at least as many rows."""

LATE = 1e6
"""Largest time [s]: later ones lose their last digits."""

GAP = 0.1
"""Longest time [s] between rows: set-points are interpolated between them."""


@dataclass(frozen=True)
class Columns:
    """A table in SI units: `values` (n,) by column, NaN where a sample is missing, and the number of every row in the file."""

    path: Path
    values: dict[str, Array]
    rows: list[int]
    row: str = "row"

    def at(self, i: int) -> str:
        """The row as messages name it."""
        return f"{self.path}, {self.row} {self.rows[i]}"

    def near(self, time: float) -> str:
        """Names the first row at or after a time [s]."""
        t = self.values["t"]
        i = min(int(np.searchsorted(t, time)), len(t) - 1)
        before = "before " if time < t[0] else ""
        return f"{before}{self.row} {self.rows[i]} (t = {time:.4g} s)"


def read_table(path: Path) -> Columns:
    """A CSV or NetCDF file, by its suffix."""
    return read_trajectory(path) if path.suffix in (".nc", ".h5") else read_csv(path)


def heading(path: Path, cells: Sequence[str]) -> list[tuple[str, float]]:
    """Name of each column, and what its unit is in SI. Raises `ValueError` naming the column."""
    out: list[tuple[str, float]] = []
    for cell in cells:
        match = re.fullmatch(r"\s*([^\[\]]*?)\s*(?:\[\s*([^\[\]]*?)\s*\])?\s*", cell)
        name, unit = (match[1], match[2]) if match else (cell.strip(), None)
        where = f"{path}, row 1, column `{line(name, 80)}`"
        if name not in COLUMNS:
            hint = "; separate columns with commas" if len(cells) == 1 else ""
            raise ValueError(
                f"{where} is not known{hint}; columns are {', '.join(COLUMNS)}, each with its unit in brackets"
            )
        known = UNITS[CHANNELS[name].unit]
        if unit is None:
            raise ValueError(f"{where} has no unit: write `{name} [{next(iter(known))}]`")
        if unit not in known:
            raise ValueError(f"{where} cannot be in {shown(unit)}; it can be in {', '.join(known)}")
        if name in (other for other, _ in out):
            raise ValueError(f"{where} is there twice")
        out.append((name, known[unit]))
    return out


def read_csv(path: Path) -> Columns:
    """A table of numbers under `name [unit]`. Raises `ValueError` naming the row (the heading is row 1) and the column."""
    values: list[list[float]] = []
    rows: list[int] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            head = heading(path, next(reader, []))
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                row = reader.line_num
                if len(cells) != len(head):
                    raise ValueError(f"{path}, row {row} has {len(cells)} cells, but there are {len(head)} columns")
                rows.append(row)
                values.append([number(path, row, name, cell) * unit for (name, unit), cell in zip(head, cells)])
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV file in UTF-8: {line(error)}") from None
    columns = np.array(values).reshape(len(rows), len(head)).T
    return check_table(Columns(path, {name: column for (name, _), column in zip(head, columns)}, rows))


def number(path: Path, row: int, column: str, cell: str) -> float:
    """A finite number, or NaN for an empty cell."""
    if not (text := cell.strip()):
        return math.nan
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(
            f"{path}, row {row}, column `{column}`: {shown(text)} is not a finite number; leave the cell empty "
            "where a sample is missing"
        )
    return value


def read_trajectory(path: Path) -> Columns:
    """The table in a file of `Trajectory.save`; rows are called samples, counted from 0. Raises `ValueError`."""
    data = load(path)
    values = read_columns(data, path)
    table = Columns(path, values, list(range(len(values["t"]))), "sample")
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
        if one.dims != axes or one.dtype != np.float64 or ("axis" in axes and one.sizes["axis"] != 2):
            raise ValueError(f"{path} is not a trajectory file: `{name}` should be float64 over {' and '.join(axes)}")
        if one.attrs.get("units") != variable.unit:
            raise ValueError(f"{path}, `{name}` should be in {variable.unit}, not {shown(one.attrs.get('units'))}")
    return {name: np.array(c.of(data[c.variable].values), float) for name, c in columns.items()}


def check_table(table: Columns) -> Columns:
    """The table, where its times and set-points can be used. Raises `ValueError` naming row and column."""
    path, values = table.path, table.values
    for name in ("t", *SETPOINTS):
        if name not in values:
            raise ValueError(
                f"{path} has no column `{name}`; it needs t, x_d, y_d and at least one of {', '.join(MEASURED)}"
            )
    if len(table.rows) < ROWS:
        raise ValueError(f"{path} has {len(table.rows)} rows of numbers, but needs at least {ROWS}")
    for name in ("t", *SETPOINTS, *FEED_FORWARD):
        if name in values and (empty := np.flatnonzero(np.isnan(values[name]))).size:
            raise ValueError(f"{table.at(empty[0])}, column `{name}` is empty; only measured channels may have gaps")
    apart_by = np.diff(values["t"])
    for i in np.flatnonzero(~((apart_by > 0) & (apart_by <= GAP)))[:1]:
        t, before = values["t"][i + 1], values["t"][i]
        if t == before:
            what = f"the time {t:g} s is there twice"
        elif t < before:
            what = f"time goes back, from {before:g} to {t:g} s"
        else:
            what = f"{t - before:.3g} s are missing before it; set-points are needed every {GAP} s or oftener"
        raise ValueError(f"{table.at(i + 1)}, column `t`: {what}")
    if (late := np.flatnonzero(np.abs(values["t"]) > LATE)).size:
        raise ValueError(
            f"{table.at(late[0])}, column `t`: {values['t'][late[0]]:.9g} s is too far from zero; count times from the start"
        )
    return table
