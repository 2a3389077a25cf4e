"""Users without rights, and first runs in many threads."""

import os
import re
import shutil
from typing import Any

import pytest

from hostile.processes import ROOT, start
from hostile.specimens import ROLL, ROLLING
from hostile.trial import Tally, count
from torchsoft.solve.kernel import objects

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

USER = 23456
"""Of no name, home or rights."""

KEEP = """
from torchsoft.solve.kernel import objects
objects.keep(objects.level(), b"code")
print(objects.found())
"""
"""Keeps a kernel of no content, since real ones take a minute to compile."""


def expect(
    tally: Tally, *arguments: str, status: int = 0, out: str = ".+", err: str = "", **how: Any
) -> None:
    """Count one start of Python: its status, and patterns of both of its outputs."""
    ended, said, told = start(*arguments, **how)
    right = ended == status and re.fullmatch(out, said, re.S) and re.fullmatch(err, told, re.S)
    held = bool(right) and "Traceback" not in told
    tally.held(held, f"{arguments} {how}: {ended} {said[-500:]!r} {told[-1000:]!r}")


@pytest.fixture(scope="module")
def rolled():
    """The output of the rolling program; its kernels are in the package's cache from then on."""
    status, out, err = start("-c", ROLL)
    assert status == 0, err
    return re.escape(out)


NOWHERE = [
    {"HOME": "/nonexistent"}, {"HOME": None, "MPLCONFIGDIR": None, "TMPDIR": "/nonexistent"},
    {"HOME": "/", "XDG_CACHE_HOME": "/proc/nothing"}, {"TORCHSOFT_CACHE_DIR": "/nonexistent"},
]  # fmt: skip


def test_users_without_rights(tally, rolled, tmp_path):
    """With root's cache they simulate at once; without any, one line says that nothing is kept."""
    if os.getuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can run programs as another user, with `setpriv`")
    if start("-c", "print(1)", user=USER)[0] != 0:
        pytest.skip("another user cannot run this Python")
    ignored = shutil.ignore_patterns("__pycache__", "objects")
    shutil.copytree(ROOT / "torchsoft", tmp_path / "torchsoft", ignore=ignored)
    user = {"user": USER, "package": tmp_path}
    told = "(.*\n)?torchsoft: note: compiled kernels cannot be kept in [^\n]*\n"
    for where in NOWHERE:
        expect(tally, "-c", KEEP, out="None\n", err=told, **user, **where)
    warm = tmp_path / "torchsoft" / "solve" / "kernel" / "objects" / objects.NAME
    shutil.copytree(objects.FOLDERS[0], warm)
    expect(tally, "-c", ROLL, out=rolled, **user, **NOWHERE[0])


def test_first_use_in_many_threads(tally, rolled):
    """Kernels and laws are loaded and compiled once, whoever comes first."""
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
        expect(tally, "-c", program, out=f"({rolled}){{8}}")
