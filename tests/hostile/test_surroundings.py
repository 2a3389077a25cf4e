"""Users, disks and terminals of all kinds, and command lines that make no sense.

Kernels of a few lines stand for the real ones wherever no physics matters, since those take a
minute to compile.
"""

import json
import os
import shutil
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

from hostile.damage import Trap, Victim, damage, document
from hostile.processes import ROOT, USER, start
from hostile.specimens import IDENTIFICATION, ROLL, ROLLING, cells, csv_text
from hostile.trial import Tally, count, random
from torchsoft import cli
from torchsoft.datasets import generate as generation
from torchsoft.solve.kernel import cache
from torchsoft.sysid import identification

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

TINY = """
import json
from hostile.processes import kernels, remembered
kernel = kernels()
print(json.dumps([kernel(3.0, 4.0), remembered(kernel)]))
"""
COMPILED, REMEMBERED = "[25.0, 0]\n", "[25.0, 1]\n"
NOTE = "torchsoft: note: compiled kernels cannot be kept in "

Lines = Callable[[str], Tally]

# caches of compiled kernels
# ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def rolled() -> str:
    """What the rolling gives; its kernels are in the package's cache from then on."""
    status, out, err = start("-c", ROLL)
    assert status == 0, err
    return out


def test_damaged_kernels_of_the_simulator_are_made_again(
    tally: Lines, rolled: str, tmp_path: Path
) -> None:
    """In a start of its own for every damage; the simulator's own results keep their bits."""
    line, trap = tally("damaged files of the simulator's kernels"), Trap(tmp_path / "executed")
    for kind in ("empty", "a bit", "all noise", "a folder", "another's"):
        place = tmp_path / kind
        kept = shutil.copytree(cache.FOLDERS[0], place / "torchsoft" / cache.NAME)
        (path,) = kept.glob("torchsoft.solve.kernel.run.run-*.kernel")
        other = next(file for file in sorted(kept.iterdir()) if file != path)
        damage(kind, Victim(path, random(kind), other, trap))
        status, out, err = start("-c", ROLL, NUMBA_CACHE_DIR=str(place))
        held = status == 0 and out == rolled and not trap.path.exists()
        line.held(held, f"{kind}: {status} {out[-500:]} {err[-1000:]}")


@pytest.fixture(scope="module")
def other_user() -> int:
    """Another user, where there may be one."""
    if os.getuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can run programs as another user, with `setpriv`")
    status, _, err = start("-c", "print(1)", user=USER)
    if status != 0:
        pytest.skip(f"another user cannot run this Python: {err[-200:]}")
    return USER


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the package without compiled kernels; the folder to import it from."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "torchsoft", tmp_path / "package" / "torchsoft", ignore=ignored)
    return tmp_path / "package"


def test_changed_sources_give_changed_physics(
    tally: Lines, rolled: str, other_user: int, package: Path, tmp_path: Path
) -> None:
    """Where the package cannot be written, and the kernels of before lie in the user's cache."""
    line, home = tally("upgrades of a package that cannot be written"), tmp_path / "home"
    kept = home / ".cache" / "torchsoft"
    shutil.copytree(cache.FOLDERS[0], kept / cache.NAME)
    for path in (home, *home.rglob("*")):
        os.chown(path, other_user, other_user)
    program = f"{ROLL}from torchsoft.solve.kernel import cache\nprint(cache.NAME)"
    where = {"package": package, "HOME": str(home)}
    where |= dict.fromkeys(("XDG_CACHE_HOME", "NUMBA_CACHE_DIR"))
    before = start("-c", program, user=other_user, **where)
    line.held(before == (0, f"{rolled}{cache.NAME}\n", ""), f"before: {before}")
    source = package / "torchsoft" / "solve" / "kernel" / "interface.py"
    text = source.read_text(encoding="utf-8")
    changed = text.replace("u += row[j] * zeta[j]", "u += 3.0 * row[j] * zeta[j]")
    assert changed != text
    source.write_text(changed, encoding="utf-8")
    status, out, err = start("-c", program, user=other_user, **where)
    other = rolled not in out and cache.NAME not in out
    line.held(status == 0 and other, f"after: {status} {out} {err}")
    line.held(len(list(kept.iterdir())) == 2, "the kernels of both are kept, apart")


def test_users_without_rights(tally: Lines, rolled: str, other_user: int, package: Path) -> None:
    """With root's cache they simulate at once; without any they compile, and one line says so."""
    line = tally("users who can write neither the package nor a home")
    nowhere: list[dict[str, str | None]] = [
        {"HOME": "/nonexistent"}, {"HOME": None}, {"HOME": ""},
        {"HOME": "/", "XDG_CACHE_HOME": "/proc/nothing"},
        {"HOME": None, "MPLCONFIGDIR": None, "TMPDIR": "/nonexistent"},
        {"NUMBA_CACHE_DIR": "/nonexistent"},
    ]  # fmt: skip
    for where in nowhere:
        status, out, err = start("-c", TINY, user=other_user, package=package, **where)
        held = status == 0 and out == COMPILED and err.count(NOTE) == 1 and err.count("\n") <= 2
        line.held(held, f"cold, {where}: {status} {out} {err}")
    warm = package / "torchsoft" / "solve" / "kernel" / "__pycache__" / cache.NAME
    shutil.copytree(cache.FOLDERS[0], warm)
    for where in nowhere[:3]:
        ended = start("-c", ROLL, user=other_user, package=package, **where)
        line.held(ended == (0, rolled, ""), f"warm, {where}: {ended}")


def test_caches_of_other_users(tally: Lines, other_user: int, tmp_path: Path) -> None:
    """Are not used, and one line says so; those of root and of the package's owner are."""
    line, theirs = tally("caches of other users"), tmp_path / "cache"
    for owner, mode, used in (
        (0, 0o644, True), (USER, 0o644, True), (USER, 0o400, True), (54321, 0o644, False),
        (0, 0o666, False), (0, 0o664, False), (USER, 0o646, False),
    ):  # fmt: skip
        shutil.rmtree(theirs, ignore_errors=True)
        assert start("-c", TINY, NUMBA_CACHE_DIR=str(theirs))[0] == 0
        for path in theirs.rglob("*.kernel"):
            path.chmod(mode)
            os.chown(path, owner, owner)
        status, out, err = start("-c", TINY, user=other_user, NUMBA_CACHE_DIR=str(theirs))
        warned = "holds kernels that other users may change, which are not used\n" in err
        held = status == 0 and out == (REMEMBERED if used else COMPILED) and warned != used
        line.held(held, f"of {owner} with {mode:o}: {status} {out} {err}")


def test_full_disk(tally: Lines, tmp_path: Path) -> None:
    line, disk = tally("full disks"), tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=40k", "none", str(disk)]
    if os.getuid() != 0 or subprocess.run(mount, check=False).returncode != 0:
        pytest.skip("a small disk cannot be mounted")
    try:
        for filled in (0, 8, 20, 30, 36, 40):
            shutil.rmtree(disk / "torchsoft", ignore_errors=True)
            (disk / "filler").write_bytes(bytes(1024 * filled))
            status, out, err = start("-c", TINY, NUMBA_CACHE_DIR=str(disk))
            told = (NOTE in err or filled < 36) and "Traceback" not in err
            held = status == 0 and out == COMPILED and told and not [*disk.rglob("*.partial")]
            line.held(held, f"{filled} kB: {status} {out} {err}")
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_first_use_in_many_threads(tally: Lines, rolled: str) -> None:
    """Kernels and laws are loaded and compiled once, whoever comes first."""
    line = tally("starts whose first runs are at once in eight threads")
    program = f"""{ROLLING}
from concurrent.futures import ThreadPoolExecutor
barrier = threading.Barrier(8)
def together(k):
    barrier.wait()
    return roll()
with ThreadPoolExecutor(8) as pool:
    for rolled in pool.map(together, range(8)):
        print(json.dumps(rolled))
"""
    for number in range(count(3)):
        status, out, err = start("-c", program)
        line.held(status == 0 and out == 8 * rolled, f"{number}: {status} {out} {err[-1000:]}")


# commands
# ----------------------------------------------------------------------

LOCALES: tuple[dict[str, str], ...] = (
    {},
    {"LC_ALL": "C"},
    {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
)
"""The last knows ASCII only."""

NUMBERS = (
    "1e-300", "nan", "inf", "-1", "0", "1e308", "1_0", "abc", "", "1e-9", "9" * 400, "0x1", "True",
    "１", "5e-3", "1",
)  # fmt: skip
PATHS = (
    "data.csv", "rig.toml", "set.toml", "none.csv", "none.toml", ".", "/dev/null", "/proc/self/mem",
    "a\nb.csv", "x" * 300, "é.toml", "",
)  # fmt: skip
OPTIONS = "--workers", "--out", "--yes", "--seed", "--rtol", "--checkpoint", "--no-progress"
IDENTIFY, GENERATE = ("torchsoft", "identify"), ("data_gen.generate",)
COMMANDS: tuple[tuple[tuple[str, ...], str, str], ...] = (
    (IDENTIFY, "data.csv rig.toml --rtol 1e-300", "rtol"),
    (IDENTIFY, "data.csv many.toml", "--yes"),
    (IDENTIFY, "data.csv µ.toml", "µ"),
    (IDENTIFY, "µ.csv rig.toml", "x_Ç"),
    (IDENTIFY, "data.csv bad.toml", "not a TOML file"),
    (IDENTIFY, "data.csv deep.toml", "nested too deeply"),
    (GENERATE, "million.toml --out o", "--yes"),
    (GENERATE, "huge.toml --out o", "elements_x"),
    (GENERATE, "text.toml --out o", "fixed.pad.height"),
    (GENERATE, "long.toml --out o", "duration"),
    (GENERATE, "bad.toml --out o", "not a TOML file"),
    (GENERATE, "none.toml --out o", "none.toml"),
    (GENERATE, "set.toml --out data.csv/o --workers 0", "data.csv"),
    (GENERATE, "set.toml --out o --workers -1", "--workers"),
)
"""Commands that end with status 2, and a word of the last line."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Recordings, configurations, and some that are wrong."""
    rig = tomllib.loads(IDENTIFICATION)
    data = tomllib.loads(sorted((ROOT / "data_gen" / "configs").glob("*.toml"))[2].read_text())
    table = cells()
    trees = {
        "rig.toml": rig,
        "many.toml": rig | {"fit": {"starts": 1_000_000}},
        "µ.toml": rig | {"µ": 1},
        "set.toml": data,
        "million.toml": data | {"trajectories": 1_000_000},
        "huge.toml": data | {"fixed": {"pad.elements_x": 40_000}},
        "text.toml": data | {"fixed": {"pad.height": "abc"}},
        "long.toml": data | {"duration": 1e308},
    }
    files = {name: document(tree).encode() for name, tree in trees.items()} | {
        "data.csv": csv_text(table).encode(),
        "µ.csv": csv_text([["x_Ç [mm]", *table[0][1:]], *table[1:]]).encode(),
        "bad.toml": b"title = '\xff'\n",
        "deep.toml": b"a = " + b"[" * 20_000,
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_random_arguments(folder: Path, tally: Lines, capsys: pytest.CaptureFixture[str]) -> None:
    """In this process, with the work itself left out: no traceback, and one line says why."""
    begun = mock.Mock(side_effect=RuntimeError("begun"))
    for name, main, first, known in (
        ("identify", cli.main, ["identify"], OPTIONS),
        ("generate", generation.main, [], OPTIONS[:4]),
    ):
        line, rng = tally(f"command lines: {name}"), random(name)
        for _ in range(count(400)):
            arguments = [*first, *map(str, rng.choice(PATHS, rng.integers(0, 4)))]
            for option in rng.choice(known, rng.integers(0, 3)):
                values = ["o", "data.csv", "none/x"] if option == "--out" else NUMBERS
                arguments += [str(option), str(rng.choice(values))]

            def ended(main: Callable = main, arguments: list[str] = arguments) -> None:
                try:
                    status = main(arguments)
                except SystemExit as end:
                    status = end.code
                said = capsys.readouterr().err
                assert status in (0, 2), status
                assert said.startswith("usage") or len(said.strip().splitlines()) <= 1, said

            with (
                mock.patch.object(identification, "identify", begun),
                mock.patch.object(generation, "generate", return_value=0),
            ):
                line.call(f"{arguments}", ended, ())


def test_commands_as_processes(folder: Path, tally: Lines) -> None:
    """Nothing is begun, the status is 2, and the last line says why in any locale."""
    line, before = tally("commands as processes"), sorted(os.listdir(folder))
    for i in range(count(42)):
        module, arguments, word = COMMANDS[i % len(COMMANDS)]
        where = LOCALES[(i + i // len(COMMANDS)) % len(LOCALES)]
        status, out, err = start("-m", *module, *arguments.split(), cwd=folder, **where)
        words = word, word.encode("ascii", "backslashreplace").decode(), "\\udc"
        shown = any(one in (err.strip().splitlines() or [""])[-1] for one in words)
        held = status == 2 and shown and "Traceback" not in err and out == ""
        line.held(held, f"{where} {module} {arguments}: {status}: {err[-600:]}")
    assert sorted(os.listdir(folder)) == before, "something was begun"


def test_terminals_that_know_ascii_only(tally: Lines, tmp_path: Path) -> None:
    """Files are read and written as ever, and a sign that cannot be shown ends no command."""
    line, out = tally("commands where everything is ASCII"), tmp_path / "ö"
    data, config = tmp_path / "größe µ.csv", tmp_path / "αβ.toml"
    data.write_text(csv_text(cells()), encoding="utf-8")
    identify = "-m", "torchsoft", "identify"
    for arguments in (
        (*identify, "--help"),
        ("-m", "data_gen.generate", "--help"),
        (str(ROOT / "experiments" / "grasp_and_roll.py"), "--help"),
    ):
        status, said, err = start(*arguments, **LOCALES[-1])
        line.held(status == 0 and said != "", f"{arguments}: {err[-1000:]}")
    for head, expected in (("# Reibung µ, Größe θ\n", 0), ("[unknowns.'pad.µ']\n", 2)):
        config.write_text(head + IDENTIFICATION, encoding="utf-8")
        how = "--out", str(out), "--no-progress"
        status, said, err = start(*identify, str(data), str(config), *how, **LOCALES[-1])
        held = status == expected and "Traceback" not in err
        line.held(held and (status == 0 or err.count("\n") == 1), f"{status} {said} {err}")
    written = json.loads((out / "answer.json").read_text(encoding="utf-8"))
    line.held("größe µ" in str(written), "the name is lost")
