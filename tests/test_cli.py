"""The command `torchsoft`: help, errors in one line, one identification from files,
interruption."""

import csv
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from test_material_fit import plain, relaxing
from test_sysid_measured import CONFIG, EXAMPLE, F_Y, X_C, X_D, Table, scale, write

from torchsoft import files
from torchsoft.cli import main
from torchsoft.rigs import RigFile
from torchsoft.solve import model, stepper
from torchsoft.sysid import Unreachable, runs
from torchsoft.sysid.measured import load, unreachable
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.runs import Job

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
        "--nu should be from -0.999 to 0.4999, not 0.6",
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
    why = r"the run was lost at t = (\S+) s: the closed loop is unstable: .* mostly of bracket\.x; "
    found = re.search(where + why, message)
    assert found, message
    row, t, inside = int(found[1]), float(found[2]), float(found[3])
    rounding = 1e-3
    assert t == pytest.approx(inside, abs=rounding)
    assert -rounding < (row - 2) * 5e-3 - t < 5e-3 + rounding, "the first row after the loss"
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
        "torchsoft: error: recording `data`: effort_y looks as if its sign were opposite: "
    )
    assert message.endswith('; if it is so, say acknowledged = ["sign of effort_y"]\n')
    assert not (folder / "out" / "answer.json").exists()


@pytest.mark.slow
def test_competing_laws_are_compared(folder, capsys, monkeypatch):
    """The law of the file is compared by the runs of its identification."""
    made, inner = list[str](), runs.simulated

    def simulated(recording: Any, begun: Any, job: Job, *start: Any, **grid: Any) -> Any:
        made.append(f"{recording.fingerprint} {job} {grid}")
        return inner(recording, begun, job, *start, **grid)

    monkeypatch.setattr(runs, "simulated", simulated)
    law = '{kind = "coulomb", mu_s = 0.8, mu_k = 0.7}'
    laws = f"[compare.coulomb]\nsettings.laws.steel_on_rubber.friction = {law}\n"
    (folder / "rig.toml").write_text(f"{CONFIG}{laws}")
    assert main(["identify", "data.csv", "rig.toml", "--out", "out", "--no-progress"]) == 0
    text, _ = capsys.readouterr()
    answer = json.loads((folder / "out" / "comparison.json").read_text())
    assert sorted(one["name"] for one in answer["laws"]) == ["as stated", "coulomb"]
    assert len(made) == len(set(made))
    assert answer["verdict"] in text
    assert sorted(path.name for path in (folder / "out").iterdir()) == [
        "answer.json",
        "comparison.json",
        "report.html",
    ]


# streams, signals and names
# ----------------------------------------------------------------------


def test_what_nobody_reads_does_not_undo_the_work(monkeypatch, tmp_path, capsys):
    """`... | true` and `>/dev/full` ended in 2 after the work was complete."""
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
    """On a full disk an empty one was left, which was "there already" the next time."""
    path = tmp_path / "rig.toml"
    with monkeypatch.context() as full:
        full.setattr(Path, "write_text", lambda *_, **__: raised(OSError(28, "No space left")))
        assert main(["init", str(path)]) == 2
        assert f"{path}: No space left" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert main(["init", os.fsdecode(bytes(tmp_path) + b"/r\xff")]) == 0
    assert RigFile.from_toml(os.fsdecode(bytes(tmp_path) + b"/r\xff.toml")).title == "r\ufffd"
    with monkeypatch.context() as ascii_only:
        ascii_only.setattr(files, "held", lambda _: "\xf6".encode("ascii"))
        assert main(["init", str(tmp_path / "m\xf6bel")]) == 2
        assert "cannot be a file's name in this locale" in capsys.readouterr().err
    assert main(["init", str(path)]) == 0


def raised(error: Exception) -> None:
    raise error


def test_a_line_break_in_a_name_is_refused(tmp_path, capsys):
    assert main(["init", str(tmp_path / "a\nb")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert "has a line break in it; leave it out" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_is_told_to_end_keeps_what_is_simulated(sign, tmp_path, monkeypatch):
    """SIGTERM, by which schedulers end a job, lost it."""
    file, integrate = tmp_path / "rig.toml", stepper.ImplicitStepper.integrate
    assert main(["init", str(file)]) == 0

    def told(self, *arguments, **options):
        for number, out in enumerate(integrate(self, *arguments, **options)):
            yield out
            if number == 1:
                os.kill(os.getpid(), sign)

    monkeypatch.setattr(stepper.ImplicitStepper, "integrate", told)
    monkeypatch.setattr(model, "CHUNK", 50)
    assert main(["run", str(file), "--out", str(tmp_path / "out")]) == 130
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["stopped"] == "interrupted"
    assert 0 < summary["simulated_s"] < RigFile.from_toml(file).outputs.duration


def test_a_window_system_that_is_not_there_is_not_asked(tmp_path):
    """Files are drawn; an unknown MPLBACKEND failed after the run."""
    code = "import sys; from torchsoft.cli import main; sys.exit(main(['version']))"
    code = code.replace("sys.exit(", "main(['version']); import matplotlib; sys.exit(0 * ")
    env = os.environ | {"MPLBACKEND": "nonsense"}
    subprocess.run([sys.executable, "-c", code], check=True, env=env, stdout=subprocess.DEVNULL)


@pytest.mark.slow
def test_an_interrupt_among_the_assumptions_draws_nothing(folder, monkeypatch, capsys):
    """Ctrl-C took 5 s, in which figures of a report were drawn."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("torchsoft.sysid.refits.difference", interrupted)
    write(folder / "data.csv", rows(42))
    assert main(["identify", "data.csv", "rig.toml", "--out", "out", "--no-progress"]) == 130
    assert sorted(os.listdir("out")) == ["answer.json", "unfinished"]
    out, err = capsys.readouterr()
    assert "interrupted; the same command continues" in err
    assert "report.html" not in out
    monkeypatch.undo()
