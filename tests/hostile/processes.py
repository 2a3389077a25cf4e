"""Processes that die where they are told to, new starts of Python in other surroundings, and the
files that they leave."""

import builtins
import io
import os
import shutil
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torchsoft

ROOT = Path(torchsoft.__file__).parents[1]

DIED = 9
"""Exit status of a process that died where it was told to."""

CHANGES = {
    "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate",
    "shutil.rmtree",
}  # fmt: skip
"""Events of Python's audit hooks, raised before a folder's content changes."""

# forks
# ----------------------------------------------------------------------


def fork(function: Callable[[], Any], seconds: int = 120) -> int:
    """The id of a process that runs the function and ends, with its status if that is a number, or
    1 after its traceback; it leads a group of its own and never lasts longer."""
    sys.stdout.flush()
    sys.stderr.flush()
    if pid := os.fork():
        return pid
    status = 1
    try:
        os.setpgrp()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(seconds)
        made = function()
        status = made if isinstance(made, int) else 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def ended(pid: int) -> int:
    """Exit status of a process, negative for the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def alive(pid: int) -> bool:
    """Whether a process has not ended yet; `ended` may still ask for its status."""
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None


def performed(
    function: Callable[[], Any], folder: Path, last: int | None = None
) -> tuple[int, list[str]]:
    """Exit status of a process that does the function and dies before (or halfway in) operation
    `last` on files below `folder`; without `last`, also every operation in order."""
    done = []
    report = folder.with_suffix(".operations")

    def tick(operation: str, path: Any) -> bool:
        """Count an operation; whether it is the last."""
        named = isinstance(path, str | bytes | os.PathLike)
        if not named or not os.fsdecode(path).startswith(str(folder)):
            return False
        done.append(operation)
        return len(done) - 1 == last

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        opened = event == "open" and isinstance(arguments[2], int)
        writes = opened and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if (writes or event in CHANGES) and tick(event, arguments[0]):
            os._exit(DIED)

    def watched() -> None:
        flush, opened = os.fsync, io.open

        def fsync(handle: int) -> None:
            if tick("os.fsync", os.readlink(f"/proc/self/fd/{handle}")):
                os._exit(DIED)
            flush(handle)

        def torn(file: Any, mode: str = "r", *others: Any, **more: Any) -> Any:
            got = opened(file, mode, *others, **more)
            whole = got.write

            def write(data: Any) -> int:
                if tick("half a write", file):
                    whole(data[: len(data) // 2])
                    got.flush()
                    os._exit(DIED)
                return whole(data)

            if set(mode) & set("wax+"):
                got.write = write
            return got

        os.fsync = fsync
        io.open = builtins.open = torn
        sys.addaudithook(hook)
        function()
        report.write_text("\n".join(done))

    status = ended(fork(watched))
    return status, report.read_text().splitlines() if last is None else []


# folders
# ----------------------------------------------------------------------


def tree(folder: Path) -> dict[str, bytes | None]:
    """Every file with its content, every folder with None."""
    return {
        str(p.relative_to(folder)): None if p.is_dir() else p.read_bytes()
        for p in sorted(folder.rglob("*"))
    }


def difference(folder: Path, expected: dict[str, bytes | None]) -> str:
    """Names of files that are too many, missing or otherwise; empty where all bytes agree."""
    here = tree(folder)
    names = here.keys() | expected.keys()
    return ", ".join(sorted(k for k in names if here.get(k, 0) != expected.get(k, 0)))


def restore(folder: Path, source: Path) -> None:
    """Make `folder` a copy of `source`."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source, folder)


# new starts
# ----------------------------------------------------------------------


def environment(package: Path = ROOT, **changes: str | None) -> dict[str, str]:
    """Variables of a new Python with `package` to import from; None takes one away."""
    given = {"PYTHONPATH": f"{package}:{ROOT}/tests", "PYTHONDONTWRITEBYTECODE": "1"}
    given = os.environ | given | {"OMP_NUM_THREADS": "1"} | changes
    return {name: value for name, value in given.items() if value is not None}


def execute(*arguments: str) -> None:
    """Become a new Python."""
    os.execve(sys.executable, [sys.executable, *arguments], environment())


def start(*arguments: str, user: int | None = None, **changes: Any) -> tuple[int, str, str]:
    """Exit status and both outputs of a new Python; as another user if one is given, who may read
    everything and write nothing."""
    rights = ["--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"]
    switch = ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups", *rights]
    done = subprocess.run(
        [*(switch if user is not None else []), sys.executable, *arguments], check=False, cwd="/",
        capture_output=True, stdin=subprocess.DEVNULL, timeout=600, env=environment(**changes),
    )  # fmt: skip
    return done.returncode, *(x.decode("utf-8", "replace") for x in (done.stdout, done.stderr))
