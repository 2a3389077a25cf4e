"""Files: written whole or not at all, checksums at their ends, and JSON without infinities."""

import errno
import json
import os
import re
import secrets
import stat
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from glob import escape
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

SEAL, DIGEST = b"\ntorchsoft-sha256\n", 64
"""End of a file with a checksum, and length of the checksum before it."""

SEALED = 64e9
"""Size [B] of a file with a checksum at the most."""

BLOCK = 2**20
"""Bytes that are read at once."""

CHECKPOINT = "torchsoft-checkpoint"
"""File that marks a folder of unfinished runs."""

PARTIAL = re.compile(r"\.[0-9a-f]{16}\.partial$")
"""End of the name of a partial file, after the name of the file that it becomes."""

NO_LOCKS = errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK
"""Errors of file systems without locks."""


@contextmanager
def replacing(path: str | Path, durable: bool = False) -> Iterator[Path]:
    """A path beside `path` to write to, which replaces `path` at the end: the file appears whole or
    not at all. A `durable` one outlasts a power failure: it is on the disk when this ends.

    Missing folders are made. The partial file is removed when writing it fails; one that a killed
    process left is removed by the next that writes the same file. Its writer holds a lock on it, so
    that nobody removes it before. Raises, before anything is written, `IsADirectoryError` where
    `path` is a folder, and `ValueError` for a name that the locale cannot write.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; name a file, perhaps one in it")
    remove_partials(path.parent.glob(f"{escape(path.name)}.*.partial"))
    try:
        while True:
            partial = path.with_name(f"{path.name}.{secrets.token_hex(8)}.partial")
            if (own := held(partial)) is not None:  # another process may take it for a left one
                break
    except UnicodeEncodeError:
        raise ValueError(
            f"{str(path)!r} cannot be a file's name in this locale, whose names are in "
            f"{sys.getfilesystemencoding()}; take another name, or set LC_ALL=C.UTF-8"
        ) from None
    try:
        yield partial
        if durable:
            flush(partial)
        partial.replace(path)
        if durable:
            with suppress(OSError):  # of file systems that cannot
                flush(path.parent)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(partial), partial):
            error.filename = str(path)  # a full disk does not say for which file
        raise
    finally:
        own.release()


def held(path: Path) -> FileLock | None:
    """A lock on the file `path` itself, made where it is not there and left as it is; None where
    another process has it. It is not locked where a file system has no locks."""
    make_folder(path.parent)
    own = FileLock(path, timeout=0, fallback_to_soft=False)
    try:
        own.acquire()
    except Timeout:
        return None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    return own


def remove_partials(paths: Iterable[Path]) -> None:
    """Remove those of the paths that are partial files whose writers are gone."""
    for path in paths:
        if not PARTIAL.search(path.name):
            continue
        with suppress(OSError):  # not ours to touch
            if (own := held(path)) is None:
                continue
            try:
                if own.is_locked:
                    path.unlink(missing_ok=True)
            finally:
                own.release()


def make_folder(path: Path) -> None:
    """Make a folder, and those above it."""
    path.mkdir(parents=True, exist_ok=True)


MEGABYTE = 1e6

RESULTS = {"summary.json": 100e6, "answer.json": 1e9}
"""Files by which a folder of results is known, with their size [B] at the most."""


def claim(folder: Path, force: bool = False) -> None:
    """Make a folder for results, or take one that results were written to. Raises `ValueError` for
    a folder of anything else, unless by `force`, and `OSError`."""
    make_folder(folder)
    if not force and not is_results(folder) and (there := sorted(folder.iterdir())):
        raise ValueError(
            f"--out: {folder} holds {there[0].name}, which is no result of torchsoft and might be "
            "overwritten; name a new folder, or use --force"
        )


def is_results(folder: Path) -> bool:
    """Whether results of this package were written to a folder, or were begun."""
    for name, most in RESULTS.items():
        with suppress(OSError, ValueError):
            if b'"torchsoft' in check_file(folder / name, most).read_bytes():
                return True
    return any(folder.glob(f"*/{CHECKPOINT}"))


def check_file(path: str | Path, most: float) -> Path:
    """The path of a file that may be read whole. Raises `ValueError` for a device, a pipe, and a
    file of more than `most` [B]; `OSError` where there is none."""
    status = os.stat(path)
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(
            f"{path} is not a regular file but a device or a pipe; save its content to a file "
            "first, and name that"
        )
    if status.st_size > most:
        raise ValueError(
            f"{path} has {status.st_size / MEGABYTE:.3g} MB, but at most {most / MEGABYTE:.3g} MB "
            "are read of such a file; is it the right one?"
        )
    return Path(path)


def flush(path: Path) -> None:
    """Have the operating system write a file, or the names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def seal(path: Path) -> None:
    """Append the checksum of a file's content to it, where formats such as HDF5 do not look."""
    with path.open("r+b") as file:
        checksum = file_digest(file, "sha256").hexdigest()
        file.write(checksum.encode() + SEAL)


def check_seal(path: str | Path) -> Path:
    """The path of a file that ends with the checksum of its content. Raises `ValueError` for any
    other.

    The libraries that read a format may hang or crash with a damaged file, and do not report it.
    """
    with check_file(path, SEALED).open("rb") as file:
        content, left = sha256(), os.fstat(file.fileno()).st_size - DIGEST - len(SEAL)
        while left > 0 and (part := file.read(min(left, BLOCK))):
            content.update(part)
            left -= len(part)
        end = file.read()
    if not end.endswith(SEAL):
        raise ValueError(
            f"{path} has no checksum at its end: it is a file of another kind, or was cut or "
            "changed; save it anew"
        )
    if end != content.hexdigest().encode() + SEAL:
        raise ValueError(
            f"{path} is damaged: its content is not what was saved; save it anew or restore it "
            "from a copy"
        )
    return Path(path)


def finite(value: Any) -> Any:
    """The value with None for every number that is not finite, which JSON cannot express, and
    numpy's numbers as Python's."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value


def save_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8. It appears whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: str | Path, content: Any) -> None:
    """Write a JSON file, with null for numbers that are not finite."""
    save_text(path, json.dumps(finite(content), indent=2, allow_nan=False) + "\n")
