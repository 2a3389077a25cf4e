"""Death at a given operation on files: none of what the process would do after it happens."""

import builtins
import io
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hostile.small import DIED, fork, forked

CHANGES = (
    "os.rename",
    "os.mkdir",
    "os.remove",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
    "shutil.rmtree",
)
"""Events of Python's audit hooks that change what is in a folder; they are raised before the
operation."""


class Torn:
    """A file opened for writing: each `write` may be the last thing that happens, half done."""

    def __init__(self, file: Any, tick: Callable[[str], bool]) -> None:
        self._file, self._tick = file, tick

    def write(self, data: Any) -> int:
        if self._tick("half a write"):
            self._file.write(data[: len(data) // 2])
            self._file.flush()
            os._exit(DIED)
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> "Torn":
        return self

    def __exit__(self, *error: Any) -> None:
        self._file.close()


class Points:
    """Counts operations on files below `folder`, and dies before (or halfway in) number `last`."""

    def __init__(self, folder: Path, last: int | None = None) -> None:
        self.folder, self.last, self.count = str(folder), last, 0
        self.at: list[str] = []

    def tick(self, what: str) -> bool:
        """Whether this is the operation to die at."""
        self.count += 1
        self.at.append(what)
        return self.count - 1 == self.last

    def inside(self, path: Any) -> bool:
        return isinstance(path, str | bytes | os.PathLike) and os.fsdecode(path).startswith(
            self.folder
        )

    def install(self) -> None:
        """For the rest of this process's life."""
        flush, opened = os.fsync, io.open

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            writes = (
                event == "open"
                and isinstance(arguments[2], int)
                and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            )
            if (writes or event in CHANGES) and self.inside(arguments[0]) and self.tick(event):
                os._exit(DIED)

        def fsync(handle: int) -> None:
            if self.inside(os.readlink(f"/proc/self/fd/{handle}")) and self.tick("os.fsync"):
                os._exit(DIED)
            flush(handle)

        def torn(file: Any, mode: str = "r", *others: Any, **more: Any) -> Any:
            got = opened(file, mode, *others, **more)
            return Torn(got, self.tick) if self.inside(file) and set(mode) & set("wax+") else got

        os.fsync = fsync
        io.open = builtins.open = torn
        sys.addaudithook(hook)


def points(function: Callable[[], Any], folder: Path) -> list[str]:
    """Every operation below `folder` that the function does, in order; it is done in a process of
    its own."""
    read, write = os.pipe()

    def counted() -> None:
        operations = Points(folder)
        operations.install()
        function()
        with os.fdopen(write, "w") as pipe:
            pipe.write("\n".join(operations.at))

    pid = fork(counted)
    os.close(write)
    with os.fdopen(read) as pipe:
        found = pipe.read().splitlines()
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    return found


def die_at(point: int, function: Callable[[], Any], folder: Path) -> int:
    """Exit status of a process that does the function and dies at that operation."""
    return forked(lambda: (Points(folder, point).install(), function()))
