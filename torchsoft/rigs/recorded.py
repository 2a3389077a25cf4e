"""Recorded motions: one column of a CSV file with units in its heading."""

import csv
import math
import re
from pathlib import Path

from torchsoft.channels import UNITS
from torchsoft.tables import line, shown

HEADING = re.compile(r"\s*([^\[\]]*?)\s*\[\s*([^\[\]]*?)\s*\]\s*")


def read_column(path: Path, column: str, unit: str) -> tuple[list[float], list[float]]:
    """Times [s] and values, in SI units, of a column that is to be in `unit` or what is converted to it.

    Raises `ValueError` naming the file, the row (the heading is row 1) and the column.
    """
    times: list[float] = []
    values: list[float] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            head = next(reader, [])
            (t_at, to_s), (at, to_si) = (find(path, head, name, kind) for name, kind in (("t", "s"), (column, unit)))
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                where = f"{path}, row {reader.line_num}"
                if len(cells) != len(head):
                    raise ValueError(f"{where} has {len(cells)} cells, but there are {len(head)} columns")
                times.append(to_s * number(where, "t", cells[t_at]))
                values.append(to_si * number(where, column, cells[at]))
                if len(times) > 1 and not times[-1] > times[-2]:
                    raise ValueError(
                        f"{where}, column `t`: {times[-1]:g} s follows {times[-2]:g} s; times must increase"
                    )
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV file in UTF-8: {line(error)}") from None
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    if len(times) < 2:
        raise ValueError(f"{path} has {len(times)} rows of numbers, but a motion needs two at least")
    return times, values


def find(path: Path, head: list[str], name: str, unit: str) -> tuple[int, float]:
    """Where a column stands, and what its unit is in SI."""
    known = UNITS[unit]
    for at, cell in enumerate(head):
        match = HEADING.fullmatch(cell)
        if (match[1] if match else cell.strip()) != name:
            continue
        if match is None or match[2] not in known:
            given = "no unit" if match is None else f"the unit {shown(match[2])}"
            raise ValueError(
                f"{path}, row 1, column `{name}` has {given}; it can be in {', '.join(known)}: `{name} [{unit}]`"
            )
        return at, known[match[2]]
    there = ", ".join(f"`{line(cell, 40)}`" for cell in head) or "nothing"
    raise ValueError(f"{path} has no column `{name} [{unit}]`; it has {there}")


def number(where: str, column: str, cell: str) -> float:
    """A finite number."""
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where}, column `{column}`: {shown(cell.strip())} is not a finite number")
    return value
