"""Tables of numbers as laboratories' programs write them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from openpyxl import Workbook

from torchsoft import csvfile
from torchsoft.csvfile import UNITS

KNOWN = {"t": UNITS["s"], "force": UNITS["N"], "x": UNITS["m"], "strain": {"1": 1.0, "%": 0.01}}
T, FORCE, X = [0.0, 0.5, 1.25], [1.5, -2.0, 3e3], [1e-3, 2e-3, 4e-3]

PLAIN = "t [s],force [N],x [mm]\n0,1.5,1\n0.5,-2,2\n1.25,3e3,4\n"
COMMAS = "t [s];force [kN];x [mm]\n0;0,0015;1\n0,5;-0,002;2\n1,25;3,0;4\n"
SAME = {
    "a preamble": ("Machine;Zwick\nDate: 2024-01-02, 3 rows\n\nOperator, x, y\n" + PLAIN, "utf-8"),
    "a row of units": (PLAIN.replace("t [s],force [N],x [mm]", "t,force,x\ns,N,mm"), "utf-8"),
    "a row of units in brackets":
        (COMMAS.replace("t [s];force [kN];x [mm]", "t;force;x\n[s];[kN];(mm)"), "utf-8"),
    "quotes": ('"t [s]","force [N]","x [mm]"\n"0","1.5","1"\n0.5,-2,2\n1.25,3e3,4\n', "utf-8"),
}  # fmt: skip


def read(path: Path, **options) -> csvfile.Numbers:
    return csvfile.read(path, KNOWN, lambda name, columns: f"; {columns} columns", **options)


@pytest.mark.parametrize("form", SAME)
def test_every_form_reads_the_same(form, tmp_path):
    text, encoding = SAME[form]
    path = tmp_path / "test.csv"
    path.write_bytes(text.encode(encoding))
    table = read(path)
    for name, expected in (("t", T), ("force", FORCE), ("x", X)):
        assert np.allclose(table.values[name], expected, rtol=1e-14)
    lines = text.replace("\r\n", "\n").split("\n")
    assert all(lines[row - 1].strip('"')[0].isdigit() for row in table.rows)


FORMS = st.fixed_dictionaries({
    "separator": st.sampled_from(",;\t"), "mark": st.sampled_from(".,"),
    "encoding": st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    "end": st.sampled_from(["\n", "\r\n"]), "column": st.sampled_from(
        [("x", "mm"), ("x", "\xb5m"), ("x", "m"), *(("force", unit) for unit in UNITS["N"])]
    ),
})  # fmt: skip
NUMBERS = st.lists(
    st.tuples(*[st.floats(-1e6, 1e6).filter(lambda x: x == 0 or abs(x) > 1e-9)] * 2),
    min_size=1, max_size=5,
)  # fmt: skip


@settings(max_examples=30, derandomize=True)
@given(FORMS, NUMBERS)
def test_numbers_come_back_whatever_the_form(tmp_path_factory, form, rows):
    """Over separators, decimal marks, encodings, ends of lines and units."""
    separator, mark, (name, unit) = form["separator"], form["mark"], form["column"]
    assume(separator != mark)
    lines = [("t [s]", f"{name} [{unit}]"), *((repr(t), repr(x)) for t, x in rows)]
    text = form["end"].join(separator.join(one) for one in lines)
    heading, _, body = text.partition(form["end"])
    path = tmp_path_factory.mktemp("csv") / "test.csv"
    path.write_bytes(f"{heading}{form['end']}{body.replace('.', mark)}".encode(form["encoding"]))
    table, (_, values) = read(path), zip(*rows)
    assert np.allclose(table.values["t"], [t for t, _ in rows], rtol=1e-14, atol=0)
    expected = UNITS["m" if name == "x" else "N"][unit] * np.array(values)
    assert np.allclose(table.values[name], expected, rtol=1e-14, atol=0)


CELLS = ["1", "-2.5", "3e2", "", " 4 ", "1,5", "2.000,5", "x", "nan", "inf", "1_0", "0x1", "\uff11",
         "1%", '"5"', "1e999", "+.5", "#"]  # fmt: skip
ROWS = st.lists(st.lists(st.sampled_from(CELLS), max_size=4), max_size=5)
ROWS |= st.lists(st.lists(st.sampled_from(CELLS[:3]), min_size=3, max_size=3), max_size=5)


@settings(max_examples=200, derandomize=True)
@given(ROWS, st.sampled_from(",;\t"))
def test_pandas_reads_what_the_cells_say_or_leaves_it(tmp_path_factory, rows, separator):
    """Values, numbers of rows and errors are those of the reader of single cells."""
    lines = [["t [s]", "strain [1]", "note [N]"], *rows]
    path = tmp_path_factory.mktemp("csv") / "test.csv"
    path.write_text("\n".join(map(separator.join, lines)), encoding="utf-8")
    found = []
    for body in (csvfile.plain_body, lambda *_: None):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(csvfile, "plain_body", body)
            try:
                table = read(path, ignore=["note"])
                found.append([*table.rows, *map(repr, table.values["t"]), *table.values["strain"]])
            except ValueError as error:
                found.append(str(error))
    assert repr(found[0]) == repr(found[1])


def test_other_headings_and_columns_to_ignore(tmp_path):
    path = tmp_path / "test.csv"
    path.write_text("Zeit [s],Kraft [N],Temp,Weg [mm]\n0,1.5,20,1\n0.5,-2,x,2\n1.25,3e3,,4\n")
    headings = {"Zeit": "t", "Kraft": "force", "Weg": "x"}
    table = read(path, headings=headings, ignore=["Temp"])
    assert table.ignored == ("Temp",)
    assert np.allclose(table.values["x"], X)
    for wrong, message in (
        ({}, "`Temp` is not known"),
        ({"Kraft": "forse"}, "is given as `forse`"),
    ):
        with pytest.raises(ValueError, match=message):
            read(path, headings=headings | wrong)
    assert read(path, headings={"Zeit": "t"}, ignore=None).ignored == ("Kraft", "Temp", "Weg")
    path.write_text("Zeit [s],Kraft [N]\n0,n/a\n")
    with pytest.raises(ValueError, match="row 2, column `Kraft`: 'n/a' is not a finite number"):
        read(path, headings={"Zeit": "t", "Kraft": "force"})


def test_forces_of_scales_are_weights():
    """Of standard gravity."""
    assert (UNITS["N"]["gf"], UNITS["N"]["kgf"]) == pytest.approx((9.80665e-3, 9.80665), rel=1e-12)


def workbook(path: Path, **sheets: list[list[Any]]) -> Workbook:
    """A workbook of sheets with these rows, saved to a path."""
    book = Workbook()
    book.remove(book.worksheets[0])
    for title, rows in sheets.items():
        sheet = book.create_sheet(title)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return book


def test_workbooks(tmp_path):
    path = tmp_path / "test.xlsx"
    heading = [["made by", None, None], ["t", "force", "x"], ["s", "N", "mm"], [None] * 3]
    rows = [*heading, *map(list, zip(T, FORCE, (1, 2, 4)))]
    workbook(path, Data=rows)
    table = read(path)
    assert np.allclose(table.values["force"], FORCE)
    assert (table.heading, table.rows) == (2, [5, 6, 7])
    workbook(path, Data=rows, Copy=rows)
    with pytest.raises(ValueError, match="a table in each of the sheets Data, Copy: keep one"):
        read(path)


@pytest.mark.parametrize("state", ["hidden", "veryHidden"])
def test_hidden_worksheets_are_not_read(state, tmp_path):
    path = tmp_path / "test.xlsx"
    shown = [["t [s]", "x [mm]"], [0, 1], [1, 2]]
    book = workbook(path, shown=shown, old=[["t [s]", "force [N]"], [0, 7], [1, 8]])
    book["old"].sheet_state = state
    book.create_chartsheet("chart")
    book.save(path)
    assert read(path).values.keys() == {"t", "x"}
    book.remove(book["shown"])
    book.active = 1
    book.save(path)
    with pytest.raises(ValueError, match=r"no visible worksheet .* unhide old"):
        read(path)


@pytest.mark.parametrize(
    ("heading", "form", "value", "expected"),
    [
        ("strain [%]", "0.0%", 0.01, 0.01),
        ("strain [1]", '0.0"%"', 1, 0.01),
        ("strain [%]", '0.0"%"', 1, 0.01),
        ("x [mm]", "0%", 0.01, "row 3, column `x`: '1%' .* plain numbers in mm"),
        ("force [kN]", "0.0,", 1500, "row 3, column `force`: '1500 .displayed in thousands"),
    ],
)
def test_cells_of_workbooks_mean_what_they_display(heading, form, value, expected, tmp_path):
    path = tmp_path / "test.xlsx"
    book = workbook(path, Data=[["t [s]", heading], [0, 0], [1, value]])
    book["Data"]["B3"].number_format = form
    book.save(path)
    if isinstance(expected, str):
        with pytest.raises(ValueError, match=expected):
            read(path)
    else:
        assert read(path).values[heading.split()[0]][1] == pytest.approx(expected, rel=1e-14)


def test_a_hundred_thousand_columns(tmp_path):
    """Longer rows than the largest cell of Python's reader, which the wrong separators meet."""
    path = tmp_path / "test.csv"
    others = [f"c{i}" for i in range(100_000)]
    path.write_text("\n".join([",".join(["t [s]", *others]), "0.5" + ",1" * len(others)]))
    table = read(path, ignore=None)
    assert table.values["t"] == 0.5
    assert len(table.ignored) == len(others)
    path.write_text('t [s],x [m]\n0,"1' + "0" * 140_000)
    with pytest.raises(ValueError, match=r"row 2: a cell has more than .* quotation mark"):
        read(path)


BAD = {
    "both decimals": (COMMAS.replace("0,0015", "0.0015"), "decimal commas and decimal points"),
    "thousands": (COMMAS.replace("3,0", "3.000,0"), r"row 4, column `force`: '3\.000,0' is not a"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_an_ambiguous_table_is_rejected(name, tmp_path):
    text, message = BAD[name]
    path = tmp_path / "test.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        read(path)
