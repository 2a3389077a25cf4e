"""Users, disks and terminals of all kinds, and command lines that make no sense.

Kernels of a few lines stand for the real ones wherever no physics matters, since those take a
minute to compile.
"""

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from typing import Any

import pytest
from conftest import IDENTIFIED

from hostile.processes import ROOT, USER, start
from hostile.specimens import ROLL, ROLLING, cells, csv_text
from hostile.trial import Tally, count
from torchsoft.solve.kernel import objects

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

TINY = """
import json
from hostile.processes import kernel
print(json.dumps(kernel()))
"""
COMPILED = r"\[true, false\]\n"
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


def test_users_without_rights(tally, rolled, other_user, package):
    """With root's cache they simulate at once; without any they compile, and one line says so."""
    line, user = tally("users who can write nothing"), {"user": other_user, "package": package}
    nowhere: list[dict[str, str | None]] = [
        {"HOME": "/nonexistent"}, {"HOME": None, "MPLCONFIGDIR": None, "TMPDIR": "/nonexistent"},
        {"HOME": "/", "XDG_CACHE_HOME": "/proc/nothing"}, {"TORCHSOFT_CACHE_DIR": "/nonexistent"},
    ]  # fmt: skip
    for where in nowhere:
        expect(line, "-c", TINY, out=COMPILED, err=f"(.*\n)?{KEPT_NOWHERE}", **user, **where)
    warm = package / "torchsoft" / "solve" / "kernel" / "objects" / objects.NAME
    shutil.copytree(objects.FOLDERS[0], warm)
    expect(line, "-c", ROLL, out=rolled, **user, **nowhere[0])


def test_full_disk(tally, tmp_path):
    line, disk = tally("full disks"), tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=40k", "none", str(disk)]
    if os.getuid() != 0 or subprocess.run(mount, check=False).returncode != 0:
        pytest.skip("a small disk cannot be mounted")
    try:
        for filled in (0, 30, 40):
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
    {}, {"LC_ALL": "C"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
)  # fmt: skip
"""The last knows ASCII only."""


@pytest.mark.parametrize("locale", LOCALES)
def test_commands_say_why_in_any_locale(tmp_path, locale, tally):
    """Nothing is started, the status is 2, and the last line says why; names are kept in files."""
    line, identify = tally(f"commands under {locale}"), ("-m", "torchsoft", "identify")
    data, config = tmp_path / "größe µ.csv", tmp_path / "αβ.toml"
    data.write_text(csv_text(cells()), encoding="utf-8")
    command = *identify, str(data), str(config), "--out", str(tmp_path / "ö"), "--no-progress"
    for wrong, word in (
        (b"title = '\xff'\n", "not a TOML file"), (b"a = " + b"[" * 20_000, "nested too deeply"),
        ((IDENTIFIED + "[unknowns.'pad.µ']\n").encode(), "pad"),
        ((IDENTIFIED + "starts = 1000000\n").encode(), "--yes"),
    ):  # fmt: skip
        config.write_bytes(wrong)
        told = f"(.*\n)?[^\n]*{word}[^\n]*\n"
        expect(line, *command, status=2, out=".*", err=told, **locale)
    config.write_text("# Reibung µ, Größe θ\n" + IDENTIFIED, encoding="utf-8")
    expect(line, *command, err=".*", **locale)
    written = json.loads((tmp_path / "ö" / "answer.json").read_text(encoding="utf-8"))
    line.held("größe µ" in str(written), "the name is lost")
