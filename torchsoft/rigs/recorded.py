"""Recorded motions: one column of a CSV file with units in its heading."""

import csv
from pathlib import Path

import numpy as np

from torchsoft import csvfile
from torchsoft.channels import UNITS
from torchsoft.files import check_file
from torchsoft.tables import line


def read_column(path: Path, column: str, unit: str) -> tuple[list[float], list[float]]:
    """Times [s] and values, in SI units, of a column that is to be in `unit` or what is converted to it; other columns are
    left out. Raises `ValueError` naming the file, the row (the heading is row 1) and the column.
    """
    try:
        there = names(path)
        for name in ("t", column):
            if name not in there:
                shown = ", ".join(f"`{line(one, 40)}`" for one in there) or "nothing"
                raise ValueError(f"{path} has no column `{name} [{'s' if name == 't' else unit}]`; it has {shown}")
        known = {"t": UNITS["s"], column: UNITS[unit]}
        table = csvfile.read(path, known, lambda *_: "", [name for name in there if name not in known])
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    times, values = table.values["t"], table.values[column]
    if len(times) < 2:
        raise ValueError(f"{path} has {len(times)} rows of numbers, but a motion needs two at least")
    for name, one in (("t", times), (column, values)):
        if (empty := np.flatnonzero(np.isnan(one))).size:
            raise ValueError(f"{path}, row {table.rows[empty[0]]}, column `{name}` is empty")
    if (back := np.flatnonzero(np.diff(times) <= 0)).size:
        i = back[0]
        raise ValueError(
            f"{path}, row {table.rows[i + 1]}, column `t`: {times[i + 1]:g} s follows {times[i]:g} s; times must increase"
        )
    return times.tolist(), values.tolist()


def names(path: Path) -> list[str]:
    """The names in the heading of a file, without their units."""
    try:
        with check_file(path, csvfile.LARGEST).open(newline="", encoding="utf-8-sig") as file:
            return [cell.partition("[")[0].strip() for cell in next(csv.reader(file), [])]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV file in UTF-8: {line(error)}") from None
