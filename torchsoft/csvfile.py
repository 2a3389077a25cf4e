"""Tables of numbers under headings `name [unit]` or `name (unit)`, as laboratories' programs write
them, read in SI units, or written.

Read are CSV with commas, semicolons or tabs, in UTF-8, UTF-16 or Windows-1252, and Excel workbooks;
rows of text before the heading; units in the heading or in the row below it; decimal points, and
decimal commas where these separate no columns. Of a workbook only visible sheets are read, and a
cell displayed as `1 %` is one percent: 0.01 under `strain [1]`, 1 under `strain [%]`. Every error
is a `ValueError` that names the file, the row (as an editor counts them) and the column.
"""

import csv
import math
import re
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from io import StringIO
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.extras import needed
from torchsoft.files import check_file, replacing
from torchsoft.tables import line, shown

UNITS = {
    "s": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180},
    "N": {
        "N": 1.0,
        "mN": 1e-3,
        "uN": 1e-6,
        "kN": 1e3,
        "gf": 9.80665e-3,
        "kgf": 9.80665,
        "lbf": 4.4482216152605,
    },
    "N.m": {"N.m": 1.0, "mN.m": 1e-3, "N.mm": 1e-3},
}
"""Units by dimension, and what they are in SI."""

LARGEST = 2e9
"""Size [B] of a file at the most."""

PREAMBLE = 200
"""Rows that may stand before the heading."""

SEPARATORS = ",;\t"
"""Separators of columns."""

DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")

CONTROL = r"[\x00-\x08\x0e-\x1f]"
"""Characters that no text has."""

LITERAL = r'"[^"]*"|\\.|_.|\*.|\[[^\]]*\]'
"""Parts of Excel's number formats that display text, colours, space or a currency."""

THOUSANDS = r"[0#?],+([^0#?,]|$)"
"""Commas by which Excel's number formats divide by thousands."""

Units = Mapping[str, float]
"""Units that a column may have, and what they are in SI."""

Hint = Callable[[str, int], str]
"""Remedy for an unknown column, from its name and the number of columns of the table."""

Rows = list[tuple[int, list[str]]]
"""Number in the file and cells of every row that is not empty."""


class Column(NamedTuple):
    """A known column: its name and its heading in the file, its unit, and the size in SI units of
    that unit and of one percent, NaN where the column has a dimension."""

    name: str
    written: str
    unit: str
    size: float
    percent: float


class Numbers(NamedTuple):
    """Values (n,) by column, NaN where a cell is empty, the number of every row in the file, the
    columns left out, and the row of the heading."""

    values: dict[str, NDArray[np.float64]]
    rows: Sequence[int]
    ignored: tuple[str, ...]
    heading: int


def read(
    path: Path,
    known: Mapping[str, Units],
    hint: Hint,
    ignore: Collection[str] | None = (),
    headings: Mapping[str, str] | None = None,
) -> Numbers:
    """The columns `known` of a file, without those that are to be ignored; None ignores all others.
    `headings` are names of columns in the file in place of those that are known. Raises
    `ValueError`, and `OSError`."""
    headings = headings or {}
    for written, name in headings.items():
        if name not in known:
            raise ValueError(
                f"{path}: the column {shown(written)} is given as `{line(name, 80)}`, which is not "
                f"known{hint(written, 2)}"
            )
    names = {name: name for name in known.keys() - headings.values()} | dict(headings)
    rows, separator, lines = opened(path, {*names, *(ignore or ())})
    if not rows:
        raise ValueError(f"{path} is empty{hint('', 1)}")
    (first, cells), *rows = rows
    last = first
    if rows and unit_row(cells, [cell.strip() for cell in rows[0][1]]):
        last, units = rows.pop(0)
        named = ((cell.strip(), unit.strip().strip("[]()")) for cell, unit in zip(cells, units))
        cells = [f"{name} [{unit}]" if unit else name for name, unit in named]
    columns = heading(f"{path}, row {first}", cells, known, names, hint, ignore)
    comma = separator in (";", "\t")
    values, numbers = plain_body(lines[last:], columns, separator, comma), range(0)
    if values is not None:
        numbers = range(last + 1, last + 1 + len(values))
    else:
        rows = separated(path, lines[last:], separator, last) if lines else rows
        values, numbers = body(path, rows, columns, comma), [row for row, _ in rows]
    left_out = tuple(name_and_unit(cell)[0] for cell, one in zip(cells, columns) if one is None)
    by_name = dict(zip((one.name for one in columns if one), values.T))
    return Numbers(by_name, numbers, left_out, first)


def check_complete(path: Path, table: Numbers, time: str) -> None:
    """Raises `ValueError` for an empty cell, and for times in a column `time` that do not
    increase."""
    for name, column in table.values.items():
        if (empty := np.flatnonzero(np.isnan(column))).size:
            raise ValueError(f"{path}, row {table.rows[empty[0]]}, column `{name}` is empty")
    times = table.values.get(time, np.empty(0))
    if (back := np.flatnonzero(np.diff(times) <= 0)).size:
        i = back[0]
        raise ValueError(
            f"{path}, row {table.rows[i + 1]}, column `{time}`: {times[i + 1]:g} s follows "
            f"{times[i]:g} s; times must increase: sort the rows, and delete one of two at the "
            "same time"
        )


def plain_body(
    lines: Sequence[str], columns: Sequence[Column | None], separator: str, comma: bool
) -> NDArray[np.float64] | None:
    """Values (rows, columns) of the lines below the heading of a text, where every line has a row
    of plain numbers; None for all else, which `body` reads, or rejects with row and column."""
    import pandas as pd  # takes half a second, and runs without tables do not need it

    lines = lines[: len(lines) - sum(1 for _ in takewhile(str.isspace, reversed(lines)))]
    used = {place: one for place, one in enumerate(columns) if one}
    between = len(columns) - 1
    if not lines or any('"' in one or one.count(separator) != between for one in lines):
        return None
    try:
        frame = pd.read_csv(
            StringIO("".join(lines)), sep=separator, header=None, usecols=[*used], dtype=np.float64,
            decimal="," if comma and any("," in one for one in lines) else ".",
            na_values=[""], keep_default_na=False,
        )  # fmt: skip
    except ValueError:
        return None
    values = frame.to_numpy()
    if len(values) != len(lines) or np.isinf(values).any() or np.isnan(values).all(1).any():
        return None
    return values * [one.size for one in used.values()]


def body(
    path: Path, rows: Rows, columns: Sequence[Column | None], comma: bool
) -> NDArray[np.float64]:
    """Values (rows, columns) of the cells below a heading. Raises `ValueError` naming row and
    column."""
    values: list[list[float]] = []
    marks: set[str] = set()
    for row, cells in rows:
        if len(cells) != len(columns):
            raise ValueError(
                f"{path}, row {row} has {len(cells)} cells, but there are {len(columns)} columns; "
                "complete the row, or delete it"
            )
        used = [(one, cell) for one, cell in zip(columns, cells) if one]
        values.append([number(path, row, one, cell, comma) for one, cell in used])
        if comma and len(marks) < 2:
            marks.update(mark for _, cell in used for mark in ",." if mark in cell)
    if len(marks) > 1:
        raise ValueError(f"{path} has decimal commas and decimal points: write all with points")
    return np.array(values).reshape(len(rows), sum(one is not None for one in columns))


def opened(path: Path, names: Collection[str]) -> tuple[Rows, str, list[str]]:
    """Rows from the heading on, which is the row with most of the `names`: all of a workbook, the
    first ones of a text, with its separator and all its lines. Raises `ValueError` for numbers
    before the heading."""
    check_file(path, LARGEST)
    separator, lines = "", list[str]()
    if path.suffix.lower() in (".xlsx", ".xlsm"):
        rows = sheet(path, names)
    elif path.suffix.lower() == ".xls":
        raise ValueError(f"{path} is a workbook of an old Excel: save it as .xlsx or as CSV")
    else:
        lines = decoded(path).splitlines(keepends=True)
        first = {one: first_rows(path, lines, one) for one in SEPARATORS}
        separator = max(
            SEPARATORS, key=lambda one: (begin(first[one], names)[0], widest(first[one]))
        )
        rows = first[separator] or separated(path, lines, separator)
    at = begin(rows, names)[1]
    for row, cells in rows[:at]:
        if len(cells) == len(rows[at][1]) > 1 and all(numeric(cell) for cell in cells):
            raise ValueError(
                f"{path}, row {row} is of numbers, but stands before the heading in row "
                f"{rows[at][0]}"
            )
    return rows[at:], separator, lines


def begin(rows: Rows, names: Collection[str]) -> tuple[int, int]:
    """Number of the columns that the heading names, and its place among the rows."""
    counts = [
        sum(name_and_unit(cell)[0] in names for cell in cells) for _, cells in rows[:PREAMBLE]
    ]
    return (max(counts), counts.index(max(counts))) if counts else (0, 0)


def widest(rows: Rows) -> int:
    """Number of cells of the first row."""
    return len(rows[0][1]) if rows else 0


def decoded(path: Path) -> str:
    """The text of a file. Raises `ValueError` where it is none."""
    raw = path.read_bytes()
    utf16 = raw[:2] in (b"\xff\xfe", b"\xfe\xff")
    for encoding in ("utf-16",) if utf16 else ("utf-8-sig", "cp1252"):
        try:
            text = raw.decode(encoding)
        except UnicodeDecodeError:
            continue
        if not re.search(CONTROL, text):
            return text
    raise ValueError(f"{path} is not a table of text in UTF-8, UTF-16 or Windows-1252")


def first_rows(path: Path, lines: Sequence[str], separator: str) -> Rows:
    """Rows in which the heading is looked for; none where another separator must be the right one,
    since with this one a cell is too long."""
    try:
        return separated(path, lines[: PREAMBLE + 1], separator)
    except ValueError:
        return []


def separated(path: Path, lines: Sequence[str], separator: str, before: int = 0) -> Rows:
    """Rows of a text that so many lines stand `before`. Raises `ValueError` where it is no CSV."""
    reader = csv.reader(lines, delimiter=separator)
    try:
        return [
            (before + reader.line_num, cells) for cells in reader if any(x.strip() for x in cells)
        ]
    except csv.Error:
        raise ValueError(
            f"{path}, row {before + reader.line_num}: a cell has more than "
            f"{csv.field_size_limit()} characters: separate columns with commas, semicolons or "
            "tabs, and look for a quotation mark that is not closed"
        ) from None


def sheet(path: Path, names: Collection[str]) -> Rows:
    """Rows of the visible sheet of an Excel workbook with the heading. Raises `ValueError`."""
    try:
        with warnings.catch_warnings(action="ignore"):  # of styles that openpyxl does not know
            book = workbook(path)
            sheets = {
                one.title: [
                    (i, [displayed(cell) for cell in cells])
                    for i, cells in enumerate(one.iter_rows(), 1)
                    if any(cell.value is not None for cell in cells)
                ]
                for one in book.worksheets
                if one.sheet_state == "visible"
            }
        hidden = [one.title for one in book.worksheets if one.title not in sheets]
    except ModuleNotFoundError as missing:
        raise ValueError(f"{path} is an Excel workbook: {missing}, or save it as CSV") from None
    except Exception as error:  # of zip files, of XML, of whatever is in them
        raise ValueError(f"{path} is not an Excel workbook: {line(error)}") from None
    counts = {name: begin(rows, names)[0] for name, rows in sheets.items()}
    most = max(counts.values(), default=0)
    best = [name for name, count in counts.items() if count == most]
    if not sheets or (hidden and not most):
        left_out = f"; hidden sheets are not read: unhide {' or '.join(hidden)}" if hidden else ""
        raise ValueError(f"{path} has no visible worksheet with a known column{left_out}")
    if len(best) > 1 and most:
        raise ValueError(f"{path} has a table in each of the sheets {', '.join(best)}: keep one")
    return sheets[best[0]]


def workbook(path: Path) -> Any:
    """An Excel workbook, its chart sheets empty: openpyxl fails where it does not know a drawing.
    Raises `ModuleNotFoundError`, and what openpyxl raises."""
    excel = needed("openpyxl.reader.excel", "excel")
    chartsheet = needed("openpyxl.chartsheet", "excel").Chartsheet

    class Reader(excel.ExcelReader):
        def read_chartsheet(self, sheet: Any, rel: Any) -> None:
            self.wb._add_sheet(chartsheet(parent=self.wb, title=sheet.name))

    reader = Reader(path, read_only=True, data_only=True)
    reader.read()
    return reader.wb


def displayed(cell: Any) -> str:
    """The text of a cell of a workbook: a number that Excel displays as a percentage is one. A
    number displayed in thousands is no plain number either, and is for `number` to reject."""
    value, form = cell.value, cell.number_format
    if value is None:
        return ""
    if type(value) not in (int, float) or form == "General":
        return str(value)
    codes = re.sub(LITERAL, "", form)
    if "%" in codes:
        return f"{100 * value:.15g}%"
    if "%" in form:  # as text, which does not scale the number
        return f"{value}%"
    return f"{value} (displayed in thousands)" if re.search(THOUSANDS, codes) else str(value)


def unit_row(cells: Sequence[str], below: Sequence[str]) -> bool:
    """Whether the row below a heading without units has them."""
    return (
        all(name_and_unit(cell)[1] is None for cell in cells)
        and len(below) == len(cells)
        and not any(numeric(cell) for cell in below)
    )


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
    row: str,
    cells: Sequence[str],
    known: Mapping[str, Units],
    names: Mapping[str, str],
    hint: Hint,
    ignore: Collection[str] | None,
) -> list[Column | None]:
    """The columns; None for those left out. Raises `ValueError` naming the column."""
    out: list[Column | None] = []
    for cell in cells:
        written, unit = name_and_unit(cell)
        where = f"{row}, column `{line(written, 80)}`"
        name = names.get(written)
        if name is None if ignore is None else written in ignore:
            out.append(None)
            continue
        if name is None:
            raise ValueError(f"{where} is not known{hint(written, len(cells))}")
        if unit is None:
            raise ValueError(f"{where} has no unit: write `{written} [{next(iter(known[name]))}]`")
        if unit not in known[name]:
            raise ValueError(
                f"{where} cannot be in {shown(unit)}; it can be in {', '.join(known[name])}"
            )
        if name in (one.name for one in out if one):
            raise ValueError(f"{where} is there twice")
        percent = 0.01 * known[name].get("1", math.nan)
        out.append(Column(name, written, unit, known[name][unit], percent))
    return out


def numeric(cell: str) -> bool:
    """Whether a cell is of a number or a percentage, its decimals after a point or a comma."""
    try:
        float(cell.strip().removesuffix("%").replace(",", ".", 1))
    except ValueError:
        return False
    return True


def number(path: Path, row: int, column: Column, cell: str, comma: bool = False) -> float:
    """A finite number in SI units, or NaN for an empty cell."""
    if not (text := cell.strip()):
        return math.nan
    plain, size = text, column.size
    if text.endswith("%"):
        plain, size = text[:-1].rstrip(), column.percent
    if comma and DECIMAL_COMMA.fullmatch(plain):
        plain = plain.replace(",", ".")
    try:
        value = float(plain) * size if plain.isascii() and "_" not in plain else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(
            f"{path}, row {row}, column `{column.written}`: {shown(text)} is not a finite number; "
            "leave the cell empty where a sample is missing, and write plain numbers in "
            f"{column.unit} elsewhere"
        )
    return value
