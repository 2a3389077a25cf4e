"""CSV files of numbers under headings `name [unit]` or `name (unit)`, read in SI units, or written.

Every error is a `ValueError` in a sentence that names the file, the row (the heading is row 1) and
the column.
"""

import csv
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.files import check_file, replacing
from torchsoft.tables import line, shown

LARGEST = 2e9
"""Size [B] of a CSV file at the most."""

Units = Mapping[str, float]
"""Units that a column may have, and what they are in SI."""

Hint = Callable[[str, int], str]
"""Remedy for an unknown column, from its name and the number of columns of the table."""


class Numbers(NamedTuple):
    """Values (n,) by column, NaN where a cell is empty, the number of every row in the file, and
    the columns left out."""

    values: dict[str, NDArray[np.float64]]
    rows: list[int]
    ignored: tuple[str, ...]


def read(
    path: Path, known: Mapping[str, Units], hint: Hint, ignore: Collection[str] = ()
) -> Numbers:
    """The columns `known` of a file, without those that are to be ignored. Raises `ValueError`, and
    `OSError`."""
    values: list[list[float]] = []
    rows: list[int] = []
    try:
        with check_file(path, LARGEST).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            first = next(reader, [])
            head = heading(path, first, known, hint, ignore)
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                row = reader.line_num
                if len(cells) != len(head):
                    raise ValueError(
                        f"{path}, row {row} has {len(cells)} cells, but there are {len(head)} "
                        "columns"
                    )
                rows.append(row)
                used = [(*one, cell) for one, cell in zip(head, cells) if one]
                values.append([number(path, row, name, cell) * unit for name, unit, cell in used])
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV file in UTF-8: {line(error)}") from None
    names = [one[0] for one in head if one]
    columns = np.array(values).reshape(len(rows), len(names)).T
    left_out = tuple(name_and_unit(cell)[0] for cell, one in zip(first, head) if one is None)
    return Numbers(dict(zip(names, columns)), rows, left_out)


def write(path: Path, columns: Mapping[str, NDArray[np.float64]], units: Mapping[str, str]) -> None:
    """Write columns (n,) by name, with their units in the heading."""
    head = ",".join(f"{name} [{units[name]}]" for name in columns)
    with replacing(path) as partial:
        table = np.stack(list(columns.values()), 1)
        np.savetxt(partial, table, "%.12g", ",", header=head, comments="", encoding="utf-8")


def name_and_unit(cell: str) -> tuple[str, str | None]:
    """Name and unit of a heading `name [unit]` or `name (unit)`; None where it has no unit."""
    match = re.fullmatch(r"\s*([^\[\]()]*?)\s*(?:[\[(]\s*([^\[\]()]*?)\s*[\])])?\s*", cell)
    return (match[1], match[2]) if match else (cell.strip(), None)


def heading(
    path: Path,
    cells: Sequence[str],
    known: Mapping[str, Units],
    hint: Hint,
    ignore: Collection[str],
) -> list[tuple[str, float] | None]:
    """Name of each column, and what its unit is in SI; None for those left out. Raises `ValueError`
    naming the column."""
    out: list[tuple[str, float] | None] = []
    for cell in cells:
        name, unit = name_and_unit(cell)
        where = f"{path}, row 1, column `{line(name, 80)}`"
        if name in ignore:
            out.append(None)
            continue
        if name not in known:
            raise ValueError(f"{where} is not known{hint(name, len(cells))}")
        if unit is None:
            raise ValueError(f"{where} has no unit: write `{name} [{next(iter(known[name]))}]`")
        if unit not in known[name]:
            raise ValueError(
                f"{where} cannot be in {shown(unit)}; it can be in {', '.join(known[name])}"
            )
        if name in (one[0] for one in out if one):
            raise ValueError(f"{where} is there twice")
        out.append((name, known[name][unit]))
    return out


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
            f"{path}, row {row}, column `{column}`: {shown(text)} is not a finite number; leave "
            "the cell empty where a sample is missing"
        )
    return value
