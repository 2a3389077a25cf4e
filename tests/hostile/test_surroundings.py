"""Users, disks and terminals of all kinds, and command lines that make no sense.

Kernels of a few lines stand for the real ones wherever no physics matters, since those take a
minute to compile.
"""

import json
import os
import re
import shutil
import subprocess
import tomllib
from collections.abc import Callable, Sequence
from typing import Any
from unittest import mock

import pytest

from hostile.damage import BYTES, FOREIGN, GONE, Trap, Victim, damage, document
from hostile.processes import ROOT, USER, start
from hostile.specimens import IDENTIFICATION, ROLL, ROLLING, cells, csv_text
from hostile.trial import Tally, count, random
from torchsoft import cli
from torchsoft.datasets import generate as generation
from torchsoft.solve.kernel import objects
from torchsoft.sysid import identification

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

TINY = """
import json
from hostile.processes import kernel
print(json.dumps(kernel()))
"""
COMPILED, REMEMBERED = r"\[true, false\]\n", r"\[true, true\]\n"
KEPT_NOWHERE = "torchsoft: note: compiled kernels cannot be kept in [^\n]*\n"

Lines = Callable[[str], Tally]

# caches of compiled kernels
# ----------------------------------------------------------------------


def expect(
    line: Tally, *arguments: str, status: int = 0, out: str = ".+", err: str = "", **how: Any
) -> None:
    """Count one start of Python: its status, and patterns of both of its outputs."""
    ended, said, told = start(*arguments, **how)
    right = ended == status and re.fullmatch(out, said, re.S) and re.fullmatch(err, told, re.S)
    held = bool(right) and "Traceback" not in told
    line.held(held, f"{arguments} {how}: {ended} {said[-500:]!r} {told[-1000:]!r}")


@pytest.fixture(scope="module")
def rolled():
    """What the rolling gives; its kernels are in the package's cache from then on."""
    status, out, err = start("-c", ROLL)
    assert status == 0, err
    return re.escape(out)


@pytest.fixture(scope="module")
def other_user():
    """Another user, where there may be one."""
    if os.getuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can run programs as another user, with `setpriv`")
    if start("-c", "print(1)", user=USER)[0] != 0:
        pytest.skip("another user cannot run this Python")
    return USER


@pytest.fixture
def package(tmp_path):
    """A copy of the package without compiled kernels; the folder to import it from."""
    ignored = shutil.ignore_patterns("__pycache__", "objects")
    shutil.copytree(ROOT / "torchsoft", tmp_path / "package" / "torchsoft", ignore=ignored)
    return tmp_path / "package"


def test_damaged_kernels_of_the_simulator_are_made_again(tally, rolled, tmp_path):
    """In a start of its own for every damage; the simulator's own results keep their bits."""
    line, trap = tally("damaged files of the simulator's kernels"), Trap(tmp_path / "executed")
    kinds = BYTES | GONE | FOREIGN
    for kind in ("empty", "a bit", "all noise", "a folder", "another's"):
        kept = tmp_path / kind / objects.NAME
        shutil.copytree(objects.FOLDERS[0], kept)
        path = kept / f"run-{objects.level()}.o"
        (other, *_) = sorted({*kept.iterdir()} - {path})
        damage(kinds[kind], Victim(path, random(kind), other, trap))
        expect(line, "-c", ROLL, out=rolled, err=".*", TORCHSOFT_CACHE_DIR=str(tmp_path / kind))
    line.held(not trap.path.exists(), "executed")


def test_changed_sources_give_changed_physics(tally, rolled, other_user, package, tmp_path):
    """Where the package cannot be written, and the kernels of before lie in the user's cache."""
    line, home = tally("upgrades of a package that cannot be written"), tmp_path / "home"
    kept = home / ".cache" / "torchsoft"
    shutil.copytree(objects.FOLDERS[0], kept / objects.NAME)
    for path in (home, *home.rglob("*")):
        os.chown(path, other_user, other_user)
    where = {"user": other_user, "package": package, "HOME": str(home)}
    where |= dict.fromkeys(("XDG_CACHE_HOME", "TORCHSOFT_CACHE_DIR"))
    expect(line, "-c", ROLL, out=rolled, **where)
    source = package / "torchsoft" / "solve" / "kernel" / "interface.py"
    text = source.read_text(encoding="utf-8")
    changed = text.replace("= soft * dot(row, zeta)", "= 3.0 * soft * dot(row, zeta)")
    assert changed != text
    source.write_text(changed, encoding="utf-8")
    expect(line, "-c", ROLL, out=f"(?!{rolled}).+", err=".*", **where)
    line.held(len(list(kept.iterdir())) == 2, "the kernels of both are kept, apart")


def test_users_without_rights(tally, rolled, other_user, package):
    """With root's cache they simulate at once; without any they compile, and one line says so."""
    line = tally("users who can write neither the package nor a home")
    nowhere: list[dict[str, str | None]] = [
        {"HOME": "/nonexistent"}, {"HOME": None}, {"HOME": ""},
        {"HOME": "/", "XDG_CACHE_HOME": "/proc/nothing"},
        {"HOME": None, "MPLCONFIGDIR": None, "TMPDIR": "/nonexistent"},
        {"TORCHSOFT_CACHE_DIR": "/nonexistent"},
    ]  # fmt: skip
    user = {"user": other_user, "package": package}
    for where in nowhere:
        expect(line, "-c", TINY, out=COMPILED, err=f"(.*\n)?{KEPT_NOWHERE}", **user, **where)
    warm = package / "torchsoft" / "solve" / "kernel" / "objects" / objects.NAME
    shutil.copytree(objects.FOLDERS[0], warm)
    for where in nowhere[:3]:
        expect(line, "-c", ROLL, out=rolled, **user, **where)


def test_caches_of_other_users(tally, other_user, tmp_path):
    """Are not used, and one line says so; those of root and of the package's owner are."""
    line, theirs = tally("caches of other users"), {"TORCHSOFT_CACHE_DIR": str(tmp_path)}
    warned = ".*holds kernels that other users may change, which are not used\n"
    for owner, mode, used in (
        (0, 0o644, True), (USER, 0o644, True), (USER, 0o400, True), (54321, 0o644, False),
        (0, 0o666, False), (0, 0o664, False), (USER, 0o646, False),
    ):  # fmt: skip
        shutil.rmtree(tmp_path / objects.NAME, ignore_errors=True)
        expect(line, "-c", TINY, out=COMPILED, err=".*", **theirs)
        for path in tmp_path.rglob("*.o"):
            path.chmod(mode)
            os.chown(path, owner, owner)
        said = {"out": REMEMBERED} if used else {"out": COMPILED, "err": f"{warned}.*"}
        expect(line, "-c", TINY, user=other_user, **said, **theirs)


def test_full_disk(tally, tmp_path):
    line, disk = tally("full disks"), tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=40k", "none", str(disk)]
    if os.getuid() != 0 or subprocess.run(mount, check=False).returncode != 0:
        pytest.skip("a small disk cannot be mounted")
    try:
        for filled in (0, 8, 20, 30, 36, 40):
            shutil.rmtree(disk / objects.NAME, ignore_errors=True)
            (disk / "filler").write_bytes(bytes(1024 * filled))
            told = f"(.*\n)?{KEPT_NOWHERE}" if filled >= 36 else ".*"
            expect(line, "-c", TINY, out=COMPILED, err=told, TORCHSOFT_CACHE_DIR=str(disk))
            line.held(not [*disk.rglob("*.partial")], f"{filled} kB: a partial file is left")
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_first_use_in_many_threads(tally, rolled):
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
    for _ in range(count(3)):
        expect(line, "-c", program, out=f"({rolled}){{8}}")


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
IDENTIFY, GENERATE = ("torchsoft", "identify"), ("torchsoft", "dataset", "make")
COMMANDS: tuple[tuple[tuple[str, ...], str, str], ...] = (
    (IDENTIFY, "data.csv rig.toml --rtol 1e-300", "rtol"),
    (IDENTIFY, "data.csv many.toml", "--yes"),
    (IDENTIFY, "data.csv µ.toml", "µ"),
    (IDENTIFY, "µ.csv rig.toml", "x_Ç"),
    (IDENTIFY, "data.csv bad.toml", "not a TOML file"),
    (IDENTIFY, "data.csv deep.toml", "nested too deeply"),
    (GENERATE, "million.toml --out o", "--yes"),
    (GENERATE, "huge.toml --out o", "elements_x"),
    (GENERATE, "text.toml --out o", "fixed.pads.L.height"),
    (GENERATE, "long.toml --out o", "duration"),
    (GENERATE, "bad.toml --out o", "not a TOML file"),
    (GENERATE, "none.toml --out o", "none.toml"),
    (GENERATE, "set.toml --out data.csv/o --workers 0", "data.csv"),
    (GENERATE, "set.toml --out o --workers -1", "--workers"),
)
"""Commands that end with status 2, and a word of the last line."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Recordings, configurations, and some that are wrong."""
    rig = tomllib.loads(IDENTIFICATION)
    data = tomllib.loads(sorted((ROOT / "data_gen" / "configs").glob("*.toml"))[2].read_text())
    data["rig"] = "paper"
    table = cells()
    trees = {
        "rig.toml": rig,
        "many.toml": rig | {"fit": {"starts": 1_000_000}},
        "µ.toml": rig | {"µ": 1},
        "set.toml": data,
        "million.toml": data | {"trajectories": 1_000_000},
        "huge.toml": data | {"fixed": {"pads.L.elements_x": 40_000}},
        "text.toml": data | {"fixed": {"pads.L.height": "abc"}},
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


def test_random_arguments(folder, tally, capsys):
    """In this process, with the work itself left out: no traceback, and one line says why."""
    begun = mock.patch.object(identification, "identify", side_effect=RuntimeError("begun"))
    generated = mock.patch.object(generation, "generate", return_value=0)
    for name, command, options in (
        ("identify", IDENTIFY[1:], OPTIONS),
        ("generate", GENERATE[1:], OPTIONS[:4]),
    ):
        line, rng = tally(f"command lines: {name}"), random(name)
        for _ in range(count(400)):
            arguments = rng.choice(PATHS, rng.integers(0, 4)).tolist()
            for option in rng.choice(options, rng.integers(0, 3)).tolist():
                values = ["o", "data.csv", "none/x"] if option == "--out" else NUMBERS
                arguments += [option, str(rng.choice(values))]

            def ended(words: Sequence[str] = (*command, *arguments)) -> None:
                try:
                    status = cli.main(words)
                except SystemExit as end:
                    status = end.code
                said = capsys.readouterr().err
                assert status in (0, 2), status
                assert said.startswith("usage") or len(said.strip().splitlines()) <= 1, said

            with begun, generated:
                line.call(f"{arguments}", ended, ())


def test_commands_as_processes(folder, tally):
    """Nothing is begun, the status is 2, and the last line says why in any locale."""
    line, before = tally("commands as processes"), sorted(os.listdir(folder))
    for i in range(count(42)):
        module, arguments, word = COMMANDS[i % len(COMMANDS)]
        where = LOCALES[(i + i // len(COMMANDS)) % len(LOCALES)]
        words = map(re.escape, (word, word.encode("ascii", "backslashreplace").decode(), "\\udc"))
        told = f"(.*\n)?[^\n]*({'|'.join(words)})[^\n]*\n"
        command = "-m", *module, *arguments.split()
        expect(line, *command, status=2, out="", err=told, cwd=folder, **where)
    assert sorted(os.listdir(folder)) == before, "something was begun"


def test_terminals_that_know_ascii_only(tally, tmp_path):
    """Files are read and written as ever, and a sign that cannot be shown ends no command."""
    line, out = tally("commands where everything is ASCII"), tmp_path / "ö"
    data, config = tmp_path / "größe µ.csv", tmp_path / "αβ.toml"
    data.write_text(csv_text(cells()), encoding="utf-8")
    identify = "-m", "torchsoft", "identify"
    experiment = str(ROOT / "experiments" / "grasp_and_roll.py")
    for command in (identify, ("-m", "torchsoft", "dataset", "make"), (experiment,)):
        expect(line, *command, "--help", **LOCALES[-1])
    command = *identify, str(data), str(config), "--out", str(out), "--no-progress"
    config.write_text("# Reibung µ, Größe θ\n" + IDENTIFICATION, encoding="utf-8")
    expect(line, *command, err=".*", **LOCALES[-1])
    written = json.loads((out / "answer.json").read_text(encoding="utf-8"))
    line.held("größe µ" in str(written), "the name is lost")
    config.write_text(IDENTIFICATION + "[unknowns.'pad.µ']\n", encoding="utf-8")
    expect(line, *command, status=2, out=".*", err="[^\n]*\n", **LOCALES[-1])
