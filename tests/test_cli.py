"""The command `torchsoft`: help, errors in one line, one identification from files,
interruption."""

import json
import math
import os
import re
import shlex
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from conftest import IDENTIFIED as CONFIG

from torchsoft import RigFile, files
from torchsoft.cli import main
from torchsoft.solve import model, stepper

EXAMPLE = Path(__file__).parents[1] / "examples" / "identify" / "rolling.csv"


def recorded(path: Path, count: int) -> Path:
    """The first rows of the example."""
    path.write_text("\n".join(EXAMPLE.read_text().splitlines()[:count]))
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, with the first 0.3 s of the example in data.csv, their configuration
    in rig.toml, and a relaxation test."""
    recorded(tmp_path / "data.csv", 62)
    (tmp_path / "rig.toml").write_text(CONFIG)
    rows = "".join(f"{t / 10},5,{10 + 5 * math.exp(-0.2 * t)}\n" for t in range(60))
    (tmp_path / "test.csv").write_text(f"t [s],strain [%],stress [kPa]\n{rows}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def identify(*more: str, verb: str = "identify", config: str = "rig.toml") -> int:
    return main([verb, "data.csv", config, "--out", "out", "--no-progress", *more])


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


COMMANDS = (
    "", "init", "check", "run", "plot", "plan", "reduce", "design", "rehearse", "identify",
    "explain", "profile", "material fit", "material presets", "dataset make", "dataset check",
)  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([*command.split(), "--help"])
    out, err = capsys.readouterr()
    assert (end.value.code, err) == (0, "")
    assert out.startswith(f"usage: torchsoft {command}".rstrip())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [("", "COMMAND"), ("identify", "DATA.csv"), ("identify rig.toml --rtol fast", "float: 'fast'")],
)
def test_a_wrong_command_line_shows_the_usage_and_ends_with_2(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments.split())
    assert end.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith("usage: torchsoft")
    assert message.split()[-1] in err.splitlines()[-1]


ERRORS = [
    ("identify data.csv", "one CONFIG.toml is needed, but 0 were given"),
    ("identify other.csv rig.toml", "other.csv: No such file or directory"),
    ("identify folder.csv rig.toml", "folder.csv: Is a directory"),
    ("identify rig.toml", "there is nothing to identify from"),
    ("identify picture.csv rig.toml", "picture.csv is not a table of text in UTF-8, UTF-16 or"),
    ("identify empty.csv rig.toml", "empty.csv is empty"),
    ("identify data.csv many.toml", "fewer starts or less data, or use --yes to begin"),
    ("identify data.csv rig.toml --out data.csv", "--out: results cannot be written to data.csv"),
    ("identify data.csv rig.toml --checkpoint mine", "mine holds other files; give a new"),
    ("material fit test.csv --area 1e-5", "`stress` needs no `area`"),
    ("material fit test.csv --out test.csv", "--out: results cannot be written to test.csv ("),
    *((f"{verb} data.csv rig.toml --{name} {value}", f"{name} should be .*not {value}")
      for verb, name, values in (
          ("identify", "rtol", ("-1.0", "nan", "inf", "0.1")),
          ("identify", "workers", ("0", "1001")),
          ("explain", "effort", ("0.0", "-1.0", "nan", "inf")))
      for value in values),
    *((f"material fit test.csv --{name} {value}", f"--{name} should be .*not {value}")
      for name in ("nu", "rho", "depth", "tau") for value in ("nan", "inf", "-1")),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), ERRORS)
def test_an_error_is_one_line_and_ends_with_2(arguments, message, folder, capsys):
    (folder / "folder.csv").mkdir()
    (folder / "mine").mkdir()
    (folder / "mine" / "a.pickle").write_text("mine")
    (folder / "picture.csv").write_bytes(b"\x89PNG\r\n\x1a\n")
    (folder / "empty.csv").write_bytes(b"")
    (folder / "many.toml").write_text(f"{CONFIG}starts = 1_000_000\n")
    before = {*folder.rglob("*")}
    assert main(arguments.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("torchsoft: error: ")
    assert re.search(message.replace("(", r"\("), err), err
    assert err.count("\n") == 1
    left = {*folder.rglob("*")} - before
    assert not [path for path in left if not path.is_dir()]


def test_neither_locale_nor_window_system_matters(tmp_path):
    """Signs that the terminal cannot show become their numbers; windows are not asked for."""
    code = "import sys; from torchsoft.cli import main; said = main(sys.argv[1:])\n"
    code += "import matplotlib; sys.exit(said)"
    strange = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "MPLBACKEND": "none"}
    ended = subprocess.run(
        [sys.executable, "-c", code, "check", "\xb5.toml"], capture_output=True, check=False,
        timeout=120, env=os.environ | strange, cwd=tmp_path,
    )  # fmt: skip
    assert ended.returncode == 2
    assert re.fullmatch(rb"torchsoft: error: \\u\w+\\u\w+\.toml: No such.*\n", ended.stderr)


def test_a_fitted_material_has_the_assumed_numbers_that_the_test_does_not_tell(folder):
    assert main(["material", "fit", "test.csv", "--rho", "1200"]) == 0
    text = Path("out/material/material.toml").read_text()
    (table,) = tomllib.loads(text)["materials"].values()
    assert [re.search(f"{name} = .*: (.*)", text)[1] for name in ("rho", "nu")] == [
        "stated", "assumed"
    ]  # fmt: skip
    assert (table["depth"], table["nu"], table["rho"]) == (44e-3, 0.45, 1200.0)


# identification
# ----------------------------------------------------------------------


@pytest.mark.slow
def test_a_trajectory_that_the_model_cannot_reach_is_named_with_its_row(folder, capsys):
    unstable = "actuators.x.Kp = 1e6\nactuators.x.Kd = 0.0\n[unknowns"
    config = CONFIG.replace('"bracket.x"', '"disc.x"').replace("[unknowns", unstable, 1)
    (folder / "rig.toml").write_text(config.replace("60.3e-3", "60e-3"))
    table = pd.read_csv(EXAMPLE, nrows=121).drop(columns="x_d_dot [mm/s]")
    table[["x_C [mm]", "x_Br [mm]"]] -= 0.3
    table["x_d [mm]"] = 0.5 * (table["x_d [mm]"] - 0.3) + 30.0
    table.to_csv("data.csv", index=False)
    assert identify() == 2
    message = capsys.readouterr().err
    where = r"data\.csv, row (\d+) \(t = (\S+) s\): the model cannot follow recording `data` here: "
    why = r"the run was lost at t = (\S+) s: the closed loop is unstable: .* mostly of bracket\.x; "
    found = re.search(where + why, message)
    assert found, message
    row, t, inside = int(found[1]), float(found[2]), float(found[3])
    assert t == pytest.approx(inside, abs=1e-3)
    assert -1e-3 < (row - 2) * 5e-3 - t < 6e-3, "the first row after the loss"


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The command, carried out in this process; its folder and its arguments."""
    folder = tmp_path_factory.mktemp("command")
    config = CONFIG.replace('[unknowns."laws.steel_on_rubber.K_n"]\nnominal = 1e5\n', "")
    config = config.replace("[settings]", "[settings]\nlaws.steel_on_rubber.K_n = 47e3")
    (folder / "rig.toml").write_text(f'{config}assumptions = "trusted"\ntightenings = 0\n')
    command = ["identify", str(recorded(folder / "data.csv", 22)), str(folder / "rig.toml")]
    assert main([*command, "--out", str(folder / "out"), "--no-progress"]) == 0
    return folder, command


def answer(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "answer.json").read_text())


def test_it_writes_answer_and_page(answered):
    folder, command = answered
    out = folder / "out"
    assert {path.name for path in out.iterdir()} == {"answer.json", "report.html"}
    found = answer(out)
    assert [one["name"] for one in found["estimates"]] == ["materials.rubber.E"]
    line = shlex.join(["torchsoft", *command, "--out", str(out), "--no-progress"])
    assert found["command"] == line
    page = (out / "report.html").read_text()
    assert page.startswith("<!doctype html>")
    assert line in page


def test_profiles_are_those_of_the_answer(answered, capsys):
    folder, (_, *files) = answered
    out, found = folder / "profile", answer(folder / "out")
    options = ["--answer", str(folder / "out" / "answer.json"), "--of", "pad.E"]
    assert main(["profile", *files, *options, "--out", str(out), "--no-progress"]) == 0
    (one,) = json.loads((out / "profile.json").read_text())
    (stated,) = (e for e in found["estimates"] if e["name"] == one["label"])
    assert one["label"] == "materials.rubber.E"
    assert one["best"] == pytest.approx(stated["last"])
    assert one["wald95"] == pytest.approx(stated["ci95"], rel=0.05)
    assert "written to" in capsys.readouterr().out


@pytest.mark.slow
def test_options_come_before_the_configuration(answered, capsys):
    folder, command = answered
    out, kept = folder / "coarser", folder / "kept"
    options = ["--out", str(out), "--rtol", "2e-3", "--checkpoint", str(kept), "--no-progress"]
    assert main([*command, *options]) == 0
    rtols = [{stage["rtol"] for stage in answer(one)["stages"]} for one in (folder / "out", out)]
    assert rtols == [{1e-3}, {2e-3}]
    assert not kept.exists()  # a checkpoint is removed once the answer is there
    text, err = capsys.readouterr()
    assert str(out / "answer.json") in text
    assert "materials.rubber.E" in text
    assert err == ""


@pytest.mark.slow
def test_competing_laws_are_compared(folder, capsys):
    law = '{kind = "coulomb", mu_s = 0.8, mu_k = 0.7}'
    laws = f"[compare.coulomb]\nsettings.laws.steel_on_rubber.friction = {law}\n"
    (folder / "rig.toml").write_text(f"{CONFIG}{laws}")
    assert identify() == 0
    found = json.loads((folder / "out" / "comparison.json").read_text())
    assert {one["name"] for one in found["laws"]} == {"as stated", "coulomb"}
    assert found["verdict"] in capsys.readouterr().out


# streams, signals and names
# ----------------------------------------------------------------------


def test_output_that_nobody_reads_does_not_undo_the_work(monkeypatch, tmp_path, capsys):
    read, write_end = os.pipe()
    os.close(read)
    for number, handle in enumerate((write_end, os.open("/dev/full", os.O_WRONLY))):
        with os.fdopen(handle, "w") as stream:
            monkeypatch.setattr(sys, "stdout", stream)
            assert main(["init", str(tmp_path / f"rig{number}")]) == 0
            assert main(["material", "presets"]) == 0 if number == 0 else 2
    monkeypatch.undo()
    assert "the output cannot be written: No space left on device" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["stdin", "stdout", "stderr"])
def test_a_closed_stream_is_no_reason_to_do_nothing(name, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, name, None)
    assert main(["init", str(tmp_path / "rig")]) == 0
    assert (tmp_path / "rig.toml").is_file()
    assert main(["check", str(tmp_path / "none.toml")]) == 2
    getattr(sys, name).close()


def test_a_file_to_start_from_is_whole_or_not_there(monkeypatch, tmp_path, capsys):
    def full(*_, **__):
        raise OSError(28, "No space left")

    path = tmp_path / "rig.toml"
    with monkeypatch.context() as disk:
        disk.setattr(Path, "write_text", full)
        assert main(["init", str(path)]) == 2
        assert f"{path}: No space left" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert main(["init", os.fsdecode(bytes(tmp_path) + b"/r\xff")]) == 0
    assert RigFile.from_toml(os.fsdecode(bytes(tmp_path) + b"/r\xff.toml")).title == "r\ufffd"
    with monkeypatch.context() as ascii_only:
        ascii_only.setattr(files, "held", lambda _: "\xf6".encode("ascii"))
        assert main(["init", str(tmp_path / "m\xf6bel")]) == 2
        assert "cannot be a file's name in this locale" in capsys.readouterr().err
    assert main(["init", str(tmp_path / "a\nb")]) == 2
    assert "has a line break in it; leave it out" in capsys.readouterr().err


@pytest.mark.parametrize(
    "sign", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM]
)
def test_a_run_that_is_told_to_end_keeps_what_is_simulated(sign, tmp_path, monkeypatch):
    """By Ctrl-C, and by the signal of a scheduler."""
    file, integrate = tmp_path / "rig.toml", stepper.ImplicitStepper.integrate
    assert main(["init", str(file)]) == 0

    runs = iter(("check", "run"))

    def told(self, *arguments, **options):
        now = next(runs)
        for number, out in enumerate(integrate(self, *arguments, **options)):
            yield out
            if now == "run" and number == 1:
                os.kill(os.getpid(), sign)

    monkeypatch.setattr(stepper.ImplicitStepper, "integrate", told)
    monkeypatch.setattr(model, "CHUNK", 50)
    assert main(["run", str(file), "--out", str(tmp_path / "out")]) == 130
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["stopped"] == "interrupted"
    assert 0 < summary["simulated_s"] < RigFile.from_toml(file).outputs.duration
