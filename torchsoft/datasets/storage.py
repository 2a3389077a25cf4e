"""Where a dataset lies: a folder, or what fsspec opens. Its files by their keys, and errors with what to do about them."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fsspec
from fsspec.implementations.local import LocalFileSystem

from torchsoft.files import remove_partials, replacing
from torchsoft.tables import line


class StoreError(RuntimeError):
    """A store that cannot be used, and what to do about it."""


@contextmanager
def store_errors(url: str) -> Iterator[None]:
    """Turn errors of the operating system, or of the client of an object store, into a `StoreError`."""
    try:
        yield
    except OSError as error:
        raise store_error(error, url) from error
    except Exception as error:
        if isinstance(error, StoreError) or isinstance(filesystem(url)[0], LocalFileSystem):
            raise
        raise StoreError(f"{url}: {type(error).__name__}: {line(error, 2000)}") from error


def store_error(error: OSError, url: str) -> StoreError:
    """An operating system's error with what to do about it."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StoreError(f"{url}: the disk is full; make room and start again: finished shards are kept")
    if error.errno == errno.EFBIG:
        return StoreError(f"{url}: a file outgrew the limit on file sizes (ulimit -f); raise it or make smaller shards")
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        return StoreError(f"{url}: a part of this path is a file; choose another folder")
    if error.errno == errno.EISDIR:
        return StoreError(f"{error.filename2 or error.filename or url} is a folder where a file should be; remove it")
    if isinstance(error, PermissionError) or error.errno == errno.EROFS:
        return StoreError(f"{url}: may not be written ({error.strerror or error}); choose another folder")
    return StoreError(f"{url}: {line(error, 2000)}")


def filesystem(url: str) -> tuple[Any, str]:
    """The filesystem and the path in it, with nothing remembered of what others may have written since."""
    try:
        fs, root = fsspec.url_to_fs(url)
    except ImportError as error:  # a known protocol whose package is not installed
        raise StoreError(f"{url}: {error}") from error
    fs.invalidate_cache()
    return fs, root


def folder(url: str) -> Path | None:
    """The folder of a dataset that is a local one, such as `file:///data/set`."""
    fs, root = filesystem(url)
    return Path(root) if isinstance(fs, LocalFileSystem) else None


def read_bytes(url: str, key: str) -> bytes | None:
    """A file of the dataset, None where there is none. Raises `StoreError` for what cannot be read."""
    fs, root = filesystem(url)
    try:
        return fs.cat_file(f"{root}/{key}")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise StoreError(f"{url}/{key} cannot be read: {error.strerror or error}") from error


def write_bytes(url: str, key: str, data: bytes) -> None:
    """Write a file of the dataset, which appears whole or not at all; object stores put whole objects."""
    if (here := folder(url)) is not None:
        with replacing(here / key) as partial:
            partial.write_bytes(data)
    else:
        fs, root = filesystem(url)
        fs.pipe_file(f"{root}/{key}", data)


def keys(url: str, under: str = "") -> list[str]:
    """Keys of all files, or of those in the folder `under`, in order."""
    fs, root = filesystem(url)
    return sorted(path.removeprefix(root).lstrip("/") for path in fs.find(f"{root}/{under}".rstrip("/")))


def remove_leftovers(url: str) -> None:
    """Remove the partial files that killed runs left behind in a local folder."""
    if (here := folder(url)) is not None:
        remove_partials(here.rglob("*.partial"))
