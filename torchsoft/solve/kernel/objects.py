"""The object file of the kernels: found, checked, loaded and called; made where there is none.

It is named after the sources of the kernels and a level of processors, and carries its checksum.
A file counts only if it belongs to whoever may change this program anyway. A file that cannot be
read is compiled again, which needs numba; where nothing can be written, every start compiles, and
says so.
"""

import ctypes
import ctypes.util
import multiprocessing
import os
import platform
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import llvmlite.binding as llvm
from platformdirs import user_cache_path

from torchsoft.files import held, replacing
from torchsoft.solve.kernel.arrays import Backward, Forward, Run
from torchsoft.solve.kernel.table import address

HERE = Path(__file__).parent

ENTRIES: dict[str, tuple[str, Any]] = {
    "run": ("torchsoft.solve.kernel.run", Run),
    "backward": ("torchsoft.solve.kernel.adjoint", Backward),
    "forward": ("torchsoft.solve.kernel.tangent", Forward),
}
"""Kernels that Python calls: their module and the table that they take."""

LEVELS = {
    "linux-x86-64-v3": ("x86_64-unknown-linux-gnu", "x86-64-v3", ""),
    "linux-x86-64-v2": ("x86_64-unknown-linux-gnu", "x86-64-v2", ""),
    "linux-aarch64": ("aarch64-unknown-linux-gnu", "generic", ""),
    "native": (
        llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    ),
}  # fmt: skip
"""Levels of processors: LLVM's triple, processor and features. `native` is this machine."""

NEEDED = {
    "linux-x86-64-v3": ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"),
    "linux-x86-64-v2": ("cx16", "sahf", "popcnt", "sse4.1", "sse4.2", "ssse3"),
}
"""Features without which a level cannot run."""

CHANGED = (
    "the sources of the kernels have changed since this process started; start it again, so that "
    "what is compiled fits what runs"
)

_said: set[str] = set()


@cache
def level() -> str:
    """The level of this processor."""
    features, system = llvm.get_host_cpu_features(), (platform.system(), platform.machine())
    if system == ("Linux", "x86_64"):
        for name, needed in NEEDED.items():
            if all(features.get(feature) for feature in needed):
                return name
    return "linux-aarch64" if system == ("Linux", "aarch64") else "native"


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


def folders(name: str) -> list[Path]:
    """Folders of the objects called `name`: TORCHSOFT_CACHE_DIR if that is set, else beside the
    sources and in the user's cache. Objects are read from all, and written to the first
    possible."""
    if chosen := os.environ.get("TORCHSOFT_CACHE_DIR"):
        return [Path(chosen) / name]
    out = [HERE / "objects" / name]
    with suppress(RuntimeError):  # a user without a home
        out.append(user_cache_path("torchsoft") / name)
    return out


NAME = digest(HERE)

FOLDERS = folders(NAME)


def note(text: str) -> None:
    """Say it once, in one line; workers leave it to their parent."""
    if text not in _said and multiprocessing.parent_process() is None:
        print(f"torchsoft: note: {text}", file=sys.stderr)
    _said.add(text)


def trusted(status: os.stat_result) -> bool:
    """Whether a file was written by this user, by root or by the owner of the sources, and can be
    changed by no one else: reading machine code is running it."""
    if not hasattr(os, "getuid"):  # the system has no such owners
        return True
    return status.st_uid in (os.getuid(), 0, HERE.stat().st_uid) and not status.st_mode & 0o022


def checksum(path: Path, content: bytes) -> bytes:
    """Checksum of an object, its name and that of its folder, so that none passes for another."""
    return sha256(f"{path.parent.name}/{path.name}\0".encode() + content).digest()


def read(path: Path) -> bytes | None:
    """Content written by `write`; None where there is none, or it is damaged or another user's."""
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


def remove_old() -> None:
    """Delete the objects of other sources beside these."""
    for folder in (HERE / "objects").glob("*"):
        if folder.name != NAME:
            shutil.rmtree(folder, ignore_errors=True)


def keep(target: str, content: bytes) -> None:
    """Store the object for a level in the first folder that can be written."""
    for folder in FOLDERS:
        with suppress(OSError):
            write(folder / f"{target}.o", content)
            return
    note(
        f"compiled kernels cannot be kept in {' or '.join(map(str, FOLDERS))}; compiling at "
        "every start"
    )


def found() -> bytes | None:
    """The object for this processor, from the first folder that has it."""
    contents = (read(folder / f"{level()}.o") for folder in FOLDERS)
    return next((content for content in contents if content is not None), None)


@contextmanager
def alone() -> Iterator[None]:
    """While no other process compiles kernels for the same folder: waits until it has ended. Nobody
    waits where no folder can be written or locked."""
    lock = None
    for folder in FOLDERS:
        with suppress(OSError):
            while (lock := held(folder / "compiling")) is None:
                note(f"another process compiles kernels for {folder}; waiting for it")
                time.sleep(0.1)
            break
    try:
        yield
    finally:
        if lock is not None:
            lock.release()


def build() -> bytes:
    """The object for this processor: compiled, unless another process has just done so."""
    if digest(HERE) != NAME:
        raise RuntimeError(CHANGED)
    with alone():
        return found() or compile_missing()


def compile_missing() -> bytes:
    """Compile the object for this processor, in a process of its own."""
    note("compiling kernels, once, in half a minute")
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "torchsoft.solve.kernel.build", "--out", folder]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if done.returncode:
            raise RuntimeError(f"the kernels could not be compiled: {done.stdout}")
        path = Path(folder) / NAME / f"{level()}.o"
        if not path.exists():
            raise RuntimeError(CHANGED)
        content = path.read_bytes()
    keep(level(), content)
    return content


def load() -> dict[str, Any]:
    """The entries, by name, as functions of a table's address.

    Their sections lie in one block (`use_lmm`): elsewhere they may be further apart than a relative
    address of 32 bits reaches, in a process that has loaded gigabytes of CUDA.
    """
    content = found() or build()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    if llvm.address_of_symbol("log1p") is None and (path := ctypes.util.find_library("m")):
        llvm.load_library_permanently(path)
    machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine, use_lmm=True)
    engine.add_object_file(llvm.ObjectFileRef.from_data(content))
    engine.finalize_object()
    _engines.append(engine)
    room = (ctypes.c_int64 * 1)(), (ctypes.c_int64 * 1)()  # of results and errors: there are none
    pointer = ctypes.c_void_p
    kind = ctypes.CFUNCTYPE(ctypes.c_int, pointer, pointer, ctypes.c_int64)
    return {name: partial(kind(engine.get_function_address(name)), *room) for name in ENTRIES}


_loaded: dict[str, Any] = {}
_engines: list[Any] = []
_loading = threading.Lock()


def call(name: str, table: Any) -> None:
    """Run an entry on its table, without the interpreter's lock. Raises `RuntimeError` where the
    kernels cannot be compiled."""
    if not _loaded:
        with _loading:
            if not _loaded:
                _loaded.update(load())
    if _loaded[name](address(table)):
        raise RuntimeError(f"the kernel `{name}` ended early")
