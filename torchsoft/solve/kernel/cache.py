"""Compiled kernels on disk, in files that are checked before they are used.

numba's own cache does not notice a changed function in another file, ends every later start where
one of its files is damaged, and unpickles what anyone may have put there. Here the folder is named
after everything the machine code was made from, every file carries its checksum, and a file counts
only if it belongs to whoever may change this program anyway. Whatever cannot be read is compiled
again; where nothing can be written, every start compiles, and says so.
"""

import logging
import multiprocessing
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba import config
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from torchsoft.files import replacing

log = logging.getLogger("torchsoft")

HERE = Path(__file__).parent

SOURCES = HERE, HERE.parents[1] / "codegen" / "invoke.py"
"""What is compiled: the kernels, and how they call a law."""

SETTINGS = (
    "OPT",
    "BOUNDSCHECK",
    "LOOP_VECTORIZE",
    "SLP_VECTORIZE",
    "USING_SVML",
    "DEBUGINFO_DEFAULT",
)
"""numba's own settings that change the machine code; the processor's name and features are in every
file's name."""

_said: set[str] = set()


def digest(*sources: Path) -> str:
    """Names files, and the modules in folders: the same for the same text, another for any
    change."""
    paths = [
        (root, path)
        for root in sources
        for path in (sorted(root.rglob("*.py")) if root.is_dir() else [root])
    ]
    texts = [(str(path.relative_to(root.parent)), path.read_bytes()) for root, path in paths]
    return sha256(repr(texts).encode()).hexdigest()[:16]


def made_from() -> str:
    """Names everything that the machine code of the kernels is made from, but for the processor."""
    made_by = sys.implementation.cache_tag, numba.__version__, llvmlite.__version__, np.__version__
    settings = [(name, getattr(config, name, None)) for name in SETTINGS]
    return sha256(repr((digest(*SOURCES), made_by, settings)).encode()).hexdigest()[:16]


def folders(name: str) -> list[Path]:
    """Where the kernels called `name` may lie: in NUMBA_CACHE_DIR if that is set, else beside the
    sources and in the user's cache. Read from all, written to the first that can be."""
    if chosen := config.CACHE_DIR:  # pyright: ignore[reportAttributeAccessIssue]
        return [Path(chosen) / "torchsoft" / name]
    out = [HERE / "__pycache__" / name]
    with suppress(RuntimeError):  # a user without a home
        out.append(
            Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchsoft" / name
        )
    return out


NAME = made_from()

FOLDERS = folders(NAME)


def note(text: str) -> None:
    """Say it once, in one line; workers leave it to their parent."""
    if text not in _said and multiprocessing.parent_process() is None:
        print(f"torchsoft: note: {text}", file=sys.stderr)
    _said.add(text)


def announce() -> None:
    """Say, once, what the first run is waiting for."""
    if "compiling" not in _said:
        log.warning("compiling the kernels (about half a minute, once)")
    _said.add("compiling")


def trusted(status: os.stat_result) -> bool:
    """Whether a file was written by this user, by root or by the owner of the sources, and can be
    changed by no one else: reading machine code is running it."""
    if not hasattr(os, "getuid"):  # the system has no such owners
        return True
    return status.st_uid in (os.getuid(), 0, HERE.stat().st_uid) and not status.st_mode & 0o022


def checksum(path: Path, content: bytes) -> bytes:
    """Of a kernel's file with its name and its folder's, so that none stands for another."""
    return sha256(f"{path.parent.name}/{path.name}\0".encode() + content).digest()


def read(path: Path) -> bytes | None:
    """What `write` has put there; None where that is nothing, damaged, or another user's."""
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file:
            if not trusted(os.fstat(file.fileno())):
                note(f"{path.parent} holds kernels that other users may change, which are not used")
                return None
            found, content = file.read(32), file.read()
    except OSError:  # gone by now, or not to be read
        return None
    if found != checksum(path, content):
        note(f"{path.parent} holds damaged kernels, which are not used")
        return None
    return content


def write(path: Path, content: bytes) -> None:
    """Put a file there that only this user may change, with its checksum."""
    with replacing(path) as partial:
        partial.chmod(0o644)
        partial.write_bytes(checksum(path, content) + content)


class KernelCache(_Cache):
    """numba's cache of one function."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = f"{function.__module__}.{function.__qualname__}"

    @property
    def cache_path(self) -> str:
        return str(FOLDERS[0])

    def files(self, signature: Any, codegen: Any) -> Iterator[Path]:
        """The file of one signature on this processor, in every folder."""
        key = sha256(repr((signature, codegen.magic_tuple())).encode()).hexdigest()[:16]
        return (folder / f"{self.function}-{key}.kernel" for folder in FOLDERS)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        target_context.refresh()
        for path in self.files(sig, target_context.codegen()):
            if (content := read(path)) is not None:
                return CompileResult._rebuild(target_context, *pickle.loads(content))
        announce()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        if (
            data.lifted or data.library.has_dynamic_globals or made_from() != NAME
        ):  # the sources changed since the start
            return
        content = dumps(data._reduce())
        for path in self.files(sig, data.codegen):
            with suppress(OSError):
                write(path, content)
                return
        note(
            f"compiled kernels cannot be kept in {' or '.join(map(str, FOLDERS))}; compiling at "
            "every start"
        )

    def enable(self) -> None: ...

    def disable(self) -> None: ...

    def flush(self) -> None: ...
