"""Caches of compiled kernels that are damaged, planted, another's, or not to be written; users and
terminals of all kinds.

Kernels of a few lines stand for the real ones wherever no physics matters, since those take a
minute to compile.
"""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_kernel_cache import Trap, flipped

from hostile.starts import ROLLING, ROOT, TINY, USER, need_users, package, python
from hostile.tiny import kernels, remembered
from hostile.trial import Tally
from torchsoft.solve.kernel import cache

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The only folder of this process's cache."""
    monkeypatch.setattr(cache, "FOLDERS", [tmp_path / "kernels"])
    monkeypatch.setattr(cache, "announce", lambda: None)
    cache._said.clear()
    yield tmp_path / "kernels"
    cache._said.clear()


@pytest.fixture(scope="module")
def rolled() -> list[str]:
    """What the rolling gives; its kernels are in the package's cache from then on."""
    status, out, err = python(ROLLING + "print(json.dumps(roll()))")
    assert status == 0, err
    return json.loads(out)


Damage = Callable[[np.random.Generator, bytes, Trap], bytes]
DAMAGES: dict[str, Damage] = {
    "empty": lambda rng, content, trap: b"",
    "cut": lambda rng, content, trap: content[: rng.integers(len(content))],
    "one bit": lambda rng, content, trap: flipped(content),
    "a bit anywhere": lambda rng, content, trap: bit(rng, content),
    "noise": lambda rng, content, trap: rng.bytes(len(content)),
    "longer": lambda rng, content, trap: content + b"\0",
    "zeros": lambda rng, content, trap: content[:200] + bytes(64) + content[264:],
    "a pickle": lambda rng, content, trap: pickle.dumps(trap),
    "a pickle with a checksum of its own": lambda rng, content, trap: (
        bytes(32) + pickle.dumps(trap)
    ),
}


def bit(rng: np.random.Generator, content: bytes) -> bytes:
    out, at = bytearray(content), int(rng.integers(8 * len(content)))
    out[at // 8] ^= 1 << at % 8
    return bytes(out)


def damage(path: Path, kind: str, rng: np.random.Generator, trap: Trap) -> None:
    if kind in DAMAGES:
        path.write_bytes(DAMAGES[kind](rng, path.read_bytes(), trap))
    elif kind == "others may write":
        path.chmod(0o666)
    elif kind == "another kernel's":
        others = sorted(
            other for other in path.parent.iterdir() if other != path and other.is_file()
        )
        path.write_bytes(others[int(rng.integers(len(others)))].read_bytes())
    else:
        path.unlink()
        if kind == "a folder":
            path.mkdir()
        elif kind == "a pipe":
            os.mkfifo(path)


KINDS = [*DAMAGES, "others may write", "another kernel's", "a folder", "a pipe", "gone"]


def test_damaged_kernels_are_made_again(
    folder: Path,
    tally: Callable[[str], Tally],
    count: Any,
    random: Any,
    tmp_path: Path,
    capsys: Any,
) -> None:
    line, trap = tally("damaged and planted files of small kernels"), Trap(tmp_path / "executed")
    for number in range(count(280)):
        rng = random(96, number)
        shutil.rmtree(folder, ignore_errors=True)
        assert kernels()(3.0, 4.0) == 25.0
        paths = sorted(folder.iterdir())
        chosen = {"entry": [p for p in paths if "hypotenuse" in p.name], "all": paths}[
            "entry" if number % 2 else "all"
        ]
        kind = KINDS[number // 2 % len(KINDS)]
        for path in chosen:
            damage(path, kind, rng, trap)
        try:
            for _ in range(2):
                cache._said.clear()
                capsys.readouterr()
                again = kernels()
                right, said = again(3.0, 4.0) == 25.0, capsys.readouterr().err
            healed = remembered(again) == 1 or kind == "a folder"
            line.held(
                right and healed and not trap.path.exists() and said.count("\n") <= 1,
                f"{number}, {kind}: {said}",
            )
        except BaseException as error:
            line.held(False, f"{number}, {kind}: {error!r}")


def test_damaged_kernels_of_the_simulator_are_made_again(
    tally: Callable[[str], Tally], random: Any, rolled: list[str], tmp_path: Path
) -> None:
    """In a start of its own for every kind; the simulator's own results keep their bits."""
    line, trap = tally("damaged files of the simulator's kernels"), Trap(tmp_path / "executed")
    program = f"""{ROLLING}
import os
from pathlib import Path
from torchsoft.solve.kernel import cache
for folder in sys.argv[1:]:
    sys.stdout.flush()
    if os.fork() == 0:
        cache.FOLDERS[:] = [Path(folder)]
        print(json.dumps(roll()), flush=True)
        os._exit(0)
    print(os.wait()[1], flush=True)
"""
    kinds = ["empty", "one bit", "noise", "a folder", "another kernel's"]
    folders = []
    for number, kind in enumerate(kinds):
        source = shutil.copytree(cache.FOLDERS[0], tmp_path / f"{number}" / cache.NAME)
        (path,) = source.glob("torchsoft.solve.kernel.run.run-*.kernel")
        damage(path, kind, random(97, number), trap)
        folders.append(str(source))
    status, out, err = python(program.replace("sys.argv[1:]", repr(folders)))
    lines = out.splitlines()
    for number, kind in enumerate(kinds):
        held = status == 0 and lines[2 * number : 2 * number + 2] == [json.dumps(rolled), "0"]
        line.held(held and not trap.path.exists(), f"{kind}: {status} {out[-500:]} {err[-1000:]}")


def test_changed_sources_give_changed_physics(
    tally: Callable[[str], Tally], rolled: list[str], tmp_path: Path
) -> None:
    """Where the package cannot be written, and the kernels of before lie in the user's cache."""
    need_users()
    line, home = tally("upgrades of a package that cannot be written"), tmp_path / "home"
    old = package(tmp_path / "package", warm=False)
    shutil.copytree(cache.FOLDERS[0], home / ".cache" / "torchsoft" / cache.NAME)
    for path in (home, *home.rglob("*")):
        os.chown(path, USER, USER)
    program = (
        ROLLING
        + "from torchsoft.solve.kernel import cache\nprint(json.dumps([roll(), cache.NAME]))"
    )
    surroundings: dict[str, str | None] = {
        "HOME": str(home),
        "XDG_CACHE_HOME": None,
        "NUMBA_CACHE_DIR": None,
    }
    status, out, err = python(program, USER, old, **surroundings)
    line.held(
        status == 0 and json.loads(out) == [rolled, cache.NAME] and err == "",
        f"before: {out} {err}",
    )
    source = old / "torchsoft" / "solve" / "kernel" / "interface.py"
    text = source.read_text(encoding="utf-8")
    changed = text.replace("u += row[j] * zeta[j]", "u += 3.0 * row[j] * zeta[j]")
    assert changed != text
    source.write_text(changed, encoding="utf-8")
    status, out, err = python(program, USER, old, **surroundings)
    line.held(
        status == 0 and rolled not in json.loads(out) and cache.NAME not in out,
        f"after: {status} {out} {err}",
    )
    line.held(
        len(list((home / ".cache" / "torchsoft").iterdir())) == 2,
        "the kernels of both are kept, apart",
    )


def test_users_without_rights(
    tally: Callable[[str], Tally], rolled: list[str], tmp_path: Path
) -> None:
    """With root's cache they simulate at once; without any they compile, and one line says so."""
    need_users()
    line = tally("users who can write neither the package nor a home")
    warm, cold = package(tmp_path / "warm", warm=True), package(tmp_path / "cold", warm=False)
    nowhere: list[dict[str, str | None]] = [
        {"HOME": "/nonexistent"}, {"HOME": None}, {"HOME": ""},
        {"HOME": "/", "XDG_CACHE_HOME": "/proc/nothing"},
        {"HOME": None, "MPLCONFIGDIR": None, "TMPDIR": "/nonexistent"},
        {"NUMBA_CACHE_DIR": "/nonexistent"},
    ]  # fmt: skip
    for surroundings in nowhere:
        status, out, err = python(TINY, USER, cold, **surroundings)
        said = err.splitlines()
        note = [
            text
            for text in said
            if text.startswith("torchsoft: note: compiled kernels cannot be kept in ")
        ]
        held = status == 0 and json.loads(out) == [25.0, 0] and len(note) == 1 and len(said) <= 2
        line.held(held, f"cold, {surroundings}: {status} {out} {err}")
    for surroundings in nowhere[:3]:
        status, out, err = python(ROLLING + "print(json.dumps(roll()))", USER, warm, **surroundings)
        line.held(
            status == 0 and json.loads(out) == rolled and err == "",
            f"warm, {surroundings}: {status} {out} {err}",
        )


def test_caches_of_other_users(tally: Callable[[str], Tally], tmp_path: Path) -> None:
    """Are not used, and one line says so; those of root and of the package's owner are."""
    need_users()
    line, theirs = tally("caches of other users"), tmp_path / "cache"
    for owner, mode, used in (
        (0, 0o644, True), (USER, 0o644, True), (USER, 0o400, True), (54321, 0o644, False),
        (0, 0o666, False), (0, 0o664, False), (USER, 0o646, False),
    ):  # fmt: skip
        shutil.rmtree(theirs, ignore_errors=True)
        assert python(TINY, NUMBA_CACHE_DIR=str(theirs))[0] == 0
        for path in theirs.rglob("*.kernel"):
            path.chmod(mode)
            os.chown(path, owner, owner)
        status, out, err = python(TINY, USER, NUMBA_CACHE_DIR=str(theirs))
        warned = "holds kernels that other users may change, which are not used\n" in err
        held = status == 0 and json.loads(out) == [25.0, int(used)] and warned != used
        line.held(held, f"of {owner} with {mode:o}: {status} {out} {err}")


def test_full_disk(tally: Callable[[str], Tally], tmp_path: Path) -> None:
    line, disk = tally("full disks"), tmp_path / "disk"
    disk.mkdir()
    mounted = os.getuid() == 0 and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=40k", "none", str(disk)], check=False
    )
    if not mounted or mounted.returncode != 0:
        pytest.skip("a small disk cannot be mounted")
    try:
        for filled in (0, 8, 20, 30, 36, 40):
            shutil.rmtree(disk / "torchsoft", ignore_errors=True)
            (disk / "filler").write_bytes(bytes(1024 * filled))
            status, out, err = python(TINY, NUMBA_CACHE_DIR=str(disk))
            left = [path.name for path in disk.rglob("*.partial")]
            noted = "torchsoft: note: compiled kernels cannot be kept in " in err
            held = (
                status == 0 and json.loads(out) == [25.0, 0] and not left and (noted or filled < 36)
            )
            line.held(held and "Traceback" not in err, f"{filled} kB: {status} {out} {err} {left}")
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_many_at_one_cache(
    folder: Path, tally: Callable[[str], Tally], count: Any, random: Any, tmp_path: Path
) -> None:
    """Processes that compile at once, some of them killed at it: every other has what it needs, and
    nothing is left."""
    line = tally("processes at one cache, a third of them killed")
    for number in range(count(20)):
        rng, children = random(98, number), {}
        for k in range(6):
            cache._said.clear()
            sys.stdout.flush()
            child = os.fork()
            if child == 0:
                os._exit(int(kernels()(3.0, 4.0) != 25.0))
            children[child] = k % 3 == 0
        time.sleep(0.4 * rng.random())
        for child, killed in children.items():
            if killed:
                os.kill(child, signal.SIGKILL)
        for child, killed in children.items():
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            line.held(status == 0 or (killed and status == -signal.SIGKILL), f"{number}: {status}")
        again = kernels()
        line.held(again(3.0, 4.0) == 25.0, f"{number}: wrong")
        if number % 4 == 3:
            for path in folder.glob("*.kernel"):
                path.unlink()
            kernels()(3.0, 4.0)
            line.held(
                not list(folder.glob("*.partial")),
                f"{number}: {[path.name for path in folder.iterdir()]}",
            )
            shutil.rmtree(folder)


def test_first_use_in_many_threads(
    tally: Callable[[str], Tally], count: Any, rolled: list[str]
) -> None:
    """Kernels and laws are loaded and compiled once, whoever comes first."""
    line = tally("threads whose first runs are at once")
    program = f"""{ROLLING}
from concurrent.futures import ThreadPoolExecutor
barrier = threading.Barrier(8)
def together(k):
    barrier.wait()
    return roll()
with ThreadPoolExecutor(8) as pool:
    print(json.dumps(list(pool.map(together, range(8)))))
"""
    for number in range(count(3)):
        status, out, err = python(program)
        results = json.loads(out) if status == 0 else [None] * 8
        for result in results:
            line.held(result == rolled, f"{number}: {status} {out[-300:]} {err[-1000:]}")


COMMANDS = {
    "identify": ["-m", "torchsoft", "identify", "--help"],
    "generate": ["-m", "data_gen.generate", "--help"],
    "experiment": ["experiments/grasp_and_roll.py", "--help"],
}


def test_terminals_that_know_ascii_only(tally: Callable[[str], Tally], tmp_path: Path) -> None:
    """Files are read and written as ever, and a sign that cannot be shown ends no command."""
    line = tally("commands where everything is ASCII")
    ascii_only = {
        "LC_ALL": "C",
        "PYTHONUTF8": "0",
        "PYTHONCOERCECLOCALE": "0",
        "OMP_NUM_THREADS": "1",
    }

    def command(*arguments: str) -> subprocess.CompletedProcess[bytes]:
        return subprocess.run(
            [sys.executable, *arguments],
            capture_output=True,
            check=False,
            timeout=300,
            cwd=ROOT,
            env=os.environ | ascii_only,
        )

    for name, arguments in COMMANDS.items():
        ended = command(*arguments)
        line.held(
            ended.returncode == 0 and ended.stdout != b"",
            f"{name}: {ended.stderr.decode()[-1000:]}",
        )
    from test_sysid_measured import CONFIG, EXAMPLE

    rows = (EXAMPLE / "rolling.csv").read_text(encoding="utf-8").splitlines()[:42]
    data, config = tmp_path / "größe µ.csv", tmp_path / "αβ.toml"
    data.write_text("\n".join(rows) + "\n", encoding="utf-8")
    config.write_text("# Reibung µ, Größe θ\n" + CONFIG, encoding="utf-8")
    ended = command(
        "-m",
        "torchsoft",
        "identify",
        str(data),
        str(config),
        "--out",
        str(tmp_path / "ö"),
        "--no-progress",
    )
    held = ended.returncode == 0 and b"Traceback" not in ended.stderr
    line.held(held, f"identify: {ended.returncode} {ended.stdout!r} {ended.stderr!r}")
    written = (tmp_path / "ö" / "answer.json").read_text(encoding="utf-8") if held else "{}"
    line.held("größe µ" in str(json.loads(written)), f"the name is lost: {written[-500:]}")
    config.write_text("[unknowns.'pad.µ']\n" + CONFIG, encoding="utf-8")
    ended = command(
        "-m",
        "torchsoft",
        "identify",
        str(data),
        str(config),
        "--out",
        str(tmp_path / "ö"),
        "--no-progress",
    )
    held = (
        ended.returncode == 2
        and ended.stderr.count(b"\n") == 1
        and b"Traceback" not in ended.stderr
    )
    line.held(held, f"an error: {ended.returncode} {ended.stdout!r} {ended.stderr!r}")
