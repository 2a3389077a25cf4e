"""The command `torchsoft`: help, errors in one line, one identification from files,
interruption."""

import csv
import json
import os
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from test_material_fit import plain, relaxing
from test_sysid_measured import CONFIG, EXAMPLE, F_Y, X_C, X_D, Table, scale, write

from torchsoft.cli import main
from torchsoft.sysid import Unreachable
from torchsoft.sysid.measured import load, unreachable
from torchsoft.sysid.prediction import FailedRun

OPTIONS = ("--out", "--workers", "--rtol", "--checkpoint", "--yes", "--no-progress")


def rows(count: int) -> Table:
    """Cells of the first `count` lines of the example, its heading among them."""
    with (EXAMPLE / "rolling.csv").open(newline="") as file:
        return list(csv.reader(file))[:count]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, with the first 0.3 s of the example in data.csv and their
    configuration in rig.toml."""
    write(tmp_path / "data.csv", rows(62))
    (tmp_path / "rig.toml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "code", ["import torchsoft", "from torchsoft.cli import main; main(['--help'])"]
)
def test_neither_an_import_nor_help_waits_for_torch(code):
    slow = "'torch', 'scipy', 'numba', 'matplotlib', 'xarray'"
    code = (
        f"import sys\ntry: {code}\nexcept SystemExit: pass\nassert not sys.modules.keys() & "
        f"{{{slow}}}"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_help_names_every_command_argument_and_option(capsys):
    for arguments, words in (
        (["--help"], ("identify", "material")),
        (["material", "--help"], ("fit", "presets")),
        (
            ["material", "fit", "--help"],
            ("FILE", "--out", "--test", "--terms", "--length", "--range", "--nu", "compliance"),
        ),
        (["material", "presets", "--help"], ("published",)),
        (["identify", "--help"], ("DATA.csv", "CONFIG.toml", *OPTIONS)),
        (["explain", "--help"], ("DATA.csv", "CONFIG.toml", *OPTIONS)),
        (["rehearse", "--help"], ("CONFIG.toml", *OPTIONS)),
        (["--version"], ("torchsoft 0.",)),
    ):
        with pytest.raises(SystemExit) as end:
            main(arguments)
        assert end.value.code == 0
        out, err = capsys.readouterr()
        assert err == ""
        assert [word for word in words if word not in out] == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "COMMAND"),
        (["identify"], "DATA.csv"),
        (["material", "fit"], "required: FILE"),
        (["identify", "rig.toml", "--rtol", "fast"], "invalid float value: 'fast'"),
    ],
)
def test_a_wrong_command_line_shows_the_usage_and_ends_with_2(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("usage: torchsoft")
    assert message in err.splitlines()[-1]


ERRORS: dict[str, tuple[list[str], str]] = {
    "no config": (["identify", "data.csv"], "one CONFIG.toml is needed, but 0 were given"),
    "no such file": (["identify", "other.csv", "rig.toml"], "other.csv: No such file or directory"),
    "a folder": (["identify", "folder.csv", "rig.toml"], "folder.csv: Is a directory"),
    "no data": (["identify", "rig.toml"], "there is nothing to identify from"),
    "not a table": (
        ["identify", "picture.csv", "rig.toml"],
        "picture.csv is not a table of text in UTF-8, UTF-16 or Windows-1252",
    ),
    "empty": (["identify", "empty.csv", "rig.toml"], "empty.csv is empty"),
    "rtol": (
        ["identify", "data.csv", "rig.toml", "--rtol", "-1"],
        "rtol should be greater than or equal to 1e-08, not -1.0",
    ),
    "many starts": (
        ["identify", "data.csv", "many.toml"],
        "; take a larger rtol, fewer starts or less data, or say --yes to begin",
    ),
    "out is a file": (
        ["identify", "data.csv", "rig.toml", "--out", "data.csv"],
        "--out: results cannot be written to data.csv (",
    ),
    "material: an area": (
        ["material", "fit", "test.csv", "--area", "1e-5"],
        "`stress` needs no `area`",
    ),
    "material: ratio": (
        ["material", "fit", "test.csv", "--nu", "0.6"],
        "pad.nu should be less than or equal to 0.4999",
    ),
    "material: out": (
        ["material", "fit", "test.csv", "--out", "test.csv"],
        "--out: results cannot be written to test.csv (",
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_is_one_line_and_ends_with_2(folder, name, capsys):
    (folder / "folder.csv").mkdir()
    contents = {
        "picture.csv": b"\x89PNG\r\n\x1a\n", "empty.csv": b"",
        "many.toml": f"{CONFIG}starts = 1_000_000\n".encode(),
    }  # fmt: skip
    for path, content in contents.items():
        (folder / path).write_bytes(content)
    plain(folder, relaxing(1e-3))
    before = sorted(folder.rglob("*"))
    arguments, message = ERRORS[name]
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("torchsoft: error: ")
    assert message in err
    assert err.count("\n") == 1
    assert sorted(folder.rglob("*")) == before  # nothing is left behind


def test_in_a_locale_without_our_signs_it_shows_their_numbers(folder):
    (folder / "µ.toml").write_text(CONFIG.replace("rubber.K_n", "rubber.µ"), encoding="utf-8")
    command = [sys.executable, "-m", "torchsoft", "identify", "data.csv", "µ.toml"]
    environment = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    ended = subprocess.run(command, capture_output=True, check=False, timeout=120, env=environment)
    assert ended.returncode == 2
    assert b"`laws.steel_on_rubber.\\xb5` cannot be identified" in ended.stderr
    assert ended.stderr.count(b"\n") == 1


def test_a_checkpoint_folder_of_others_is_refused_and_left_alone(folder, capsys):
    mine = folder / "mine"
    mine.mkdir()
    for name in ("a.pickle", "b.partial"):
        (mine / name).write_text("mine", encoding="utf-8")
    assert main(["identify", "data.csv", "rig.toml", "--checkpoint", "mine"]) == 2
    said = capsys.readouterr().err
    assert (
        said == "torchsoft: error: the checkpoint mine holds other files; give a new or an empty "
        "folder\n"
    )
    assert sorted(path.name for path in mine.iterdir()) == ["a.pickle", "b.partial"]


@pytest.mark.slow
def test_a_trajectory_that_the_model_cannot_reach_is_named_with_its_row(folder, capsys):
    table = rows(122)
    for column in (X_D, X_C, 8):
        scale(column, 1.0, -0.3)(table)
    scale(X_D, 0.5, 30.0)(table)
    write(
        folder / "data.csv", [cells[:2] + cells[3:] for cells in table]
    )  # without the rate of x_d
    config = CONFIG.replace('"bracket.x"', '"disc.x"').replace("60.3e-3", "60e-3")
    (folder / "rig.toml").write_text(
        config.replace("[unknowns", "actuators.x.Kp = 1e6\nactuators.x.Kd = 0.0\n[unknowns", 1)
    )
    assert main(["identify", "data.csv", "rig.toml", "--out", "out", "--no-progress"]) == 2
    message = capsys.readouterr().err
    where = r"data\.csv, row (\d+) \(t = (\S+) s\): the model cannot follow recording `data` here: "
    found = re.search(
        where + r"at t = (\S+) s the body was lost: it left the space over a pad", message
    )
    assert found, message
    row, t, inside = int(found[1]), float(found[2]), float(found[3])
    assert t == pytest.approx(inside, abs=1e-3)
    assert row == 2 + np.ceil(t / 5e-3 - 1e-6)
    assert message.count("\n") == 1
    tables = load(["data.csv"], "rig.toml").tables
    assert "data.csv, before row 2 (t = -0.1 s): the model" in unreachable(
        Unreachable({"data": FailedRun("gone", -0.1)}), tables
    )


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The command, carried out in this process; its folder and its data."""
    folder = tmp_path_factory.mktemp("command")
    (folder / "rig.toml").write_text(f'{CONFIG}assumptions = "trusted"\n')
    files = [str(write(folder / "data.csv", rows(42))), str(folder / "rig.toml")]
    assert main(["identify", *files, "--out", str(folder / "out"), "--no-progress"]) == 0
    return folder, files


def test_it_writes_answer_and_page(answered):
    out = answered[0] / "out"
    assert sorted(path.name for path in out.iterdir()) == ["answer.json", "report.html"]
    answer = json.loads((out / "answer.json").read_text())
    found = {e["name"]: e for e in answer["estimates"]}
    assert set(found) == {"laws.steel_on_rubber.K_n", "materials.rubber.E"}
    assert answer["converged"]
    command = shlex.join(
        ["torchsoft", "identify", *answered[1], "--out", str(out), "--no-progress"]
    )
    assert answer["command"] == command
    page = (out / "report.html").read_text()
    assert command in page
    assert page.startswith("<!doctype html>")
    assert all(notice in page or "&" in notice for notice in answer["notices"])


@pytest.mark.slow
def test_options_come_before_the_configuration(answered, capsys):
    folder, files = answered
    out, kept = folder / "coarser", folder / "kept"
    command = [
        "identify",
        *files,
        "--out",
        str(out),
        "--rtol",
        "2e-3",
        "--checkpoint",
        str(kept),
        "--no-progress",
    ]
    assert main(command) == 0
    first, second = (
        json.loads((folder / name / "answer.json").read_text()) for name in ("out", "coarser")
    )
    assert [{stage["rtol"] for stage in one["stages"]} for one in (first, second)] == [
        {1e-3},
        {2e-3},
    ]
    assert not kept.exists()  # a checkpoint is removed once the answer is there
    text, err = capsys.readouterr()
    assert str(out / "answer.json") in text
    assert "laws.steel_on_rubber.K_n" in text
    assert err == ""


def test_a_recording_that_looks_wrong_is_refused_with_the_way_on(folder, capsys):
    flipped = rows(62)
    scale(F_Y, -1.0)(flipped)
    write(folder / "data.csv", flipped)
    assert main(["identify", "data.csv", "rig.toml", "--out", "out", "--no-progress"]) == 2
    message = capsys.readouterr().err
    assert message.startswith(
        "torchsoft: error: recording `data`: F_y looks as if its sign were opposite: "
    )
    assert message.endswith('; if it is so, say acknowledged = ["sign of F_y"]\n')
    assert not (folder / "out" / "answer.json").exists()


@pytest.mark.slow
def test_competing_laws_are_compared(folder, capsys):
    law = '{kind = "coulomb", mu_s = 0.8, mu_k = 0.7}'
    laws = f"[compare.coulomb]\nsettings.laws.steel_on_rubber.friction = {law}\n"
    (folder / "rig.toml").write_text(f"{CONFIG}{laws}")
    assert main(["identify", "data.csv", "rig.toml", "--out", "out", "--no-progress"]) == 0
    text, _ = capsys.readouterr()
    answer = json.loads((folder / "out" / "comparison.json").read_text())
    assert sorted(one["name"] for one in answer["laws"]) == ["as stated", "coulomb"]
    assert answer["verdict"] in text
    assert sorted(path.name for path in (folder / "out").iterdir()) == [
        "answer.json",
        "comparison.json",
        "report.html",
    ]
