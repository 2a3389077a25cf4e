"""Command lines that make no sense: the status is 2 and the last line says why; nothing is begun
and no traceback shown."""

import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

from hostile.asked import in_time
from hostile.mutation import toml
from hostile.test_inputs import datasets
from hostile.test_inputs_recordings import EXAMPLE, table, written
from hostile.trial import Tally, count, random
from torchsoft import cli
from torchsoft.datasets import generate as generation
from torchsoft.sysid import identification

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
NUMBERS = (
    "1e-300",
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "1_0",
    "abc",
    "",
    "1e-9",
    "9" * 400,
    "0x1",
    "True",
    "１",
    "5e-3",
    "1",
)
PATHS = (
    "data.csv",
    "rig.toml",
    "set.toml",
    "none.csv",
    "none.toml",
    ".",
    "/dev/null",
    "/proc/self/mem",
    "a\nb.csv",
    "x" * 300,
    "é.toml",
    "",
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "data.csv").write_bytes(written(table()))
    for name in ("second", "checking"):
        (tmp_path / f"{name}.csv").write_bytes(written(table()))
    (tmp_path / "rig.toml").write_bytes((EXAMPLE / "rolling.toml").read_bytes())
    (tmp_path / "set.toml").write_text(toml(datasets()[2]))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_random_arguments(
    folder: Path, tally: Callable[[str], Tally], capsys: pytest.CaptureFixture[str]
) -> None:
    """In this process, with the work itself left out."""
    rng = random(5)
    begun = RuntimeError("begun")
    both = ("--workers", "--out", "--yes", "--seed")
    for name, line, run, options in (
        (
            "identify",
            tally("command lines: identify"),
            cli.main,
            (*both, "--rtol", "--checkpoint", "--no-progress"),
        ),
        ("generate", tally("command lines: generate"), generation.main, both),
    ):
        with (
            mock.patch.object(identification, "identify", side_effect=begun),
            mock.patch.object(generation, "generate", return_value=0),
        ):
            for _ in range(count(400)):
                arguments = [str(p) for p in rng.choice(PATHS, rng.integers(0, 4))]
                for option in rng.choice(options, rng.integers(0, 3)):
                    arguments += [
                        str(option),
                        str(
                            rng.choice(
                                NUMBERS if option != "--out" else ["o", "data.csv", "none/x"]
                            )
                        ),
                    ]
                if name == "identify":
                    arguments = ["identify", *arguments]
                try:
                    with in_time():
                        status = run(arguments)
                except SystemExit as end:
                    status = end.code
                except BaseException as error:
                    if isinstance(error, KeyboardInterrupt):
                        raise
                    status = f"{type(error).__name__}: {error}"
                said = capsys.readouterr().err
                one_line = said.startswith("usage") or len(said.strip().splitlines()) <= 1
                line.held(
                    status in (0, 2) and one_line and "Traceback" not in said,
                    f"{arguments}: {status}: {said}",
                )


COMMANDS: tuple[tuple[list[str], str], ...] = (
    (["torchsoft", "identify", "data.csv", "rig.toml", "--rtol", "1e-300"], "rtol"),
    (["torchsoft", "identify", "data.csv", "many.toml"], "--yes"),
    (["torchsoft", "identify", "data.csv", "µ.toml"], "µ"),
    (["torchsoft", "identify", "µ.csv", "rig.toml"], "x_Ç"),
    (["torchsoft", "identify", "data.csv", "bad.toml"], "not a TOML file"),
    (["torchsoft", "identify", "data.csv", "deep.toml"], "nested too deeply"),
    (["data_gen.generate", "million.toml", "--out", "o"], "--yes"),
    (["data_gen.generate", "huge.toml", "--out", "o"], "elements_x"),
    (["data_gen.generate", "text.toml", "--out", "o"], "fixed.pad.height"),
    (["data_gen.generate", "long.toml", "--out", "o"], "duration"),
    (["data_gen.generate", "bad.toml", "--out", "o"], "not a TOML file"),
    (["data_gen.generate", "none.toml", "--out", "o"], "none.toml"),
    (["data_gen.generate", "set.toml", "--out", "data.csv/o", "--workers", "0"], "data.csv"),
    (["data_gen.generate", "set.toml", "--out", "o", "--workers", "-1"], "--workers"),
)

LOCALES: tuple[dict[str, str], ...] = (
    {},
    {"LC_ALL": "C"},
    {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
)


def test_commands_as_processes(folder: Path, tally: Callable[[str], Tally]) -> None:
    rig = tomllib.loads((folder / "rig.toml").read_text())
    line, made = tally("commands as processes"), datasets()[2]
    files: dict[str, bytes] = {
        "many.toml": toml(rig | {"fit": rig.get("fit", {}) | {"starts": 1_000_000}}).encode(),
        "µ.toml": toml(rig | {"µ": 1}).encode(),
        "µ.csv": written([["x_Ç [mm]", *table()[0][1:]], *table()[1:]]),
        "bad.toml": b"title = '\xff'\n",
        "deep.toml": b"a = " + b"[" * 20_000,
        "million.toml": toml(made | {"trajectories": 1_000_000}).encode(),
        "huge.toml": toml(made | {"fixed": {"pad.elements_x": 40_000}}).encode(),
        "text.toml": toml(made | {"fixed": {"pad.height": "abc"}}).encode(),
        "long.toml": toml(made | {"duration": 1e308}).encode(),
    }
    for name, content in files.items():
        (folder / name).write_bytes(content)
    before = sorted(path.name for path in folder.iterdir())
    for i in range(count(24)):
        (module, *arguments), word = COMMANDS[i % len(COMMANDS)]
        extra = LOCALES[(i + i // len(COMMANDS)) % len(LOCALES)]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | extra
        ended = subprocess.run(
            [sys.executable, "-m", module, *arguments], capture_output=True,
            stdin=subprocess.DEVNULL, env=environment, check=False, timeout=120,
        )  # fmt: skip
        said = ended.stderr.decode("utf-8", "replace")
        last = said.strip().splitlines()[-1] if said.strip() else ""
        shown = (
            word in last
            or word.encode("ascii", "backslashreplace").decode() in last
            or "\\udc" in last
        )
        holds = ended.returncode == 2 and "Traceback" not in said and shown and ended.stdout == b""
        line.held(holds, f"{extra} {module} {arguments}: {ended.returncode}: {said[-600:]}")
    assert sorted(path.name for path in folder.iterdir()) == before, "something was begun"
