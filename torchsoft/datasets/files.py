"""Files of a dataset, in a local folder or any store of fsspec: their layout, the manifest, and a
digest (SHA-256) of each.

`manifest.json` holds the digests of the files laid out at the start. Each shard has a record with
the digests of its own files; the record is written last and marks the shard as finished. A record
has the form of `sha256sum`: `cd SET && sha256sum --check --quiet finished/*.sha256` checks all
shards.
"""

import errno
import json
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import fsspec
from annotated_types import Ge
from fsspec.implementations.local import LocalFileSystem

from torchsoft.files import replacing
from torchsoft.tables import LISTED, InvalidTable, Table, line

T = TypeVar("T")

MANIFEST = "manifest.json"
CARD = "README.md"
FINISHED = "finished"
RECORD = f"{FINISHED}/{{shard}}.sha256"
COPY = "restore it from a copy, or make the dataset anew in another folder"

FULL = "the disk is full; make room and start again: finished shards are kept"
FILE = "a part of this path is a file; choose another folder"
REMEDIES = {
    errno.ENOSPC: FULL,
    errno.EDQUOT: FULL,
    errno.EFBIG: "a file outgrew the limit on file sizes (ulimit -f); raise it or make smaller "
    "shards",
    errno.ENOTDIR: FILE,
    errno.EEXIST: FILE,
    errno.EROFS: "may not be written, the file system is read-only; choose another folder",
}
"""Remedies for errors of the operating system, by number."""


MOST = 20
"""Most spans of shards that a message lists."""


class StoreError(RuntimeError):
    """A dataset that cannot be used; the message names the remedy."""


@contextmanager
def store_errors(url: str) -> Iterator[None]:
    """Turn errors of the operating system, or of the client of an object store, into a
    `StoreError`."""
    try:
        yield
    except IsADirectoryError as error:
        where = error.filename2 or error.filename or url
        raise StoreError(f"{where} is a folder where a file should be; remove it") from error
    except PermissionError as error:
        raise StoreError(
            f"{url}: may not be written ({error.strerror or error}); choose another folder"
        ) from error
    except OSError as error:
        raise StoreError(f"{url}: {REMEDIES.get(error.errno or 0, line(error, 2000))}") from error
    except Exception as error:
        if isinstance(error, StoreError) or folder(url):
            raise
        raise StoreError(f"{url}: {type(error).__name__}: {line(error, 2000)}") from error


def filesystem(url: str) -> tuple[Any, str]:
    """The filesystem with its cache emptied, since others may write, and the path in it."""
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
    """Content of a file of the dataset, None where there is none. Raises `StoreError` for a file
    that cannot be read."""
    fs, root = filesystem(url)
    try:
        return fs.cat_file(f"{root}/{key}")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise StoreError(f"{url}/{key} cannot be read: {error.strerror or error}") from error


def write_bytes(url: str, key: str, data: bytes) -> None:
    """Write a file of the dataset, which appears whole or not at all."""
    if here := folder(url):
        with replacing(here / key, durable=True) as partial:
            partial.write_bytes(data)
    else:
        fs, root = filesystem(url)
        fs.pipe_file(f"{root}/{key}", data)


def keys(url: str, under: str = "") -> list[str]:
    """Sorted keys of all files, or of those in the folder `under`."""
    fs, root = filesystem(url)
    return sorted(
        path.removeprefix(root).lstrip("/") for path in fs.find(f"{root}/{under}".rstrip("/"))
    )


def digest(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return sha256(data).hexdigest()


class Layout(Table):
    """Number and size of the shards, and the keys of a shard's files, in which `{shard}` stands for
    its number."""

    shards: Annotated[int, Ge(1)]
    trajectories_per_shard: Annotated[int, Ge(1)]
    files: Annotated[tuple[str, ...], LISTED]

    def of(self, shard: int) -> list[str]:
        """Keys of the files of a shard."""
        return [key.replace("{shard}", str(shard)) for key in self.files]

    def shard(self, key: str) -> int | None:
        """The shard that the file or record belongs to, None for others."""
        found = re.fullmatch(r"(.+/c/|finished/)(0|[1-9]\d*)((?:/0)*|\.sha256)", key)
        if found is None or f"{found[1]}{{shard}}{found[3]}" not in (*self.files, RECORD):
            return None
        return number if (number := int(found[2])) < self.shards else None

    def finished(self, url: str) -> set[int]:
        """The shards that have a record."""
        return {shard for key in keys(url, FINISHED) if (shard := self.shard(key)) is not None}

    def whole(self, url: str) -> set[int]:
        """The shards that have a record and all their files."""
        there = set(keys(url))
        return {shard for shard in self.finished(url) if there.issuperset(self.of(shard))}

    def vouch(self, url: str, key: str, content: T | None, sound: bool) -> T:
        """The content of a file. Raises `StoreError` with the remedy where it is missing or not
        `sound`."""
        if content is not None and sound:
            return content
        remedy = COPY
        if (shard := self.shard(key)) is not None:
            again = "start `torchsoft dataset make` again, which makes this shard anew"
            remedy = f"remove {url}/{record_key(shard)} and {again}"
        raise StoreError(f"{url}/{key} is {'missing' if content is None else 'damaged'}; {remedy}")


class Manifest(Table):
    """Origin of the dataset. `digests` are those of the files laid out at the start, `digest` is
    that of the other fields."""

    torchsoft: str
    commit: str
    seed: int
    config_hash: str
    config: dict[str, Any]
    parameters: dict[str, Any]
    layout: Layout
    digests: dict[str, str]
    digest: str = ""

    def text(self) -> str:
        """Content of the file, with its own digest."""
        content = self.model_dump(mode="json", exclude={"digest"})
        return (
            json.dumps(content | {"digest": digest(json.dumps(content).encode())}, indent=2) + "\n"
        )

    @classmethod
    def read(cls, url: str) -> Self:
        """The manifest of the dataset. Raises `StoreError` where it is missing, damaged or of
        another version."""
        data = read_bytes(url, MANIFEST)
        if data is None:
            raise StoreError(
                f"{url}/{MANIFEST} is missing; this is no dataset, or not any more: {COPY}"
            )
        try:
            manifest = cls.model_validate_json(data)
        except InvalidTable as error:
            raise StoreError(
                f"{url}/{MANIFEST} is damaged or of another version ({error}); {COPY}"
            ) from error
        if manifest.text().encode(errors="replace") != data:
            raise StoreError(
                f"{url}/{MANIFEST} is damaged: its digest is not that of its content; {COPY}"
            )
        return manifest

    def laid_out(self, url: str, key: str) -> bytes:
        """Content of a file that was laid out at the start. Raises `StoreError` where it is missing
        or damaged."""
        data = read_bytes(url, key)
        return self.layout.vouch(url, key, data, digest(data or b"") == self.digests[key])


def listed(shards: Iterable[int]) -> str:
    """Numbers of shards as spans: 0, 3-7, 9."""
    spans = list[list[int]]()
    for shard in sorted(shards):
        if spans and shard == spans[-1][-1] + 1:
            spans[-1] = [spans[-1][0], shard]
        else:
            spans.append([shard])
    some = ["-".join(map(str, one)) for one in spans]
    return ", ".join(some if len(some) <= MOST else [*some[:MOST], "..."])


def record_key(shard: int) -> str:
    """The key of a shard's record."""
    return RECORD.replace("{shard}", str(shard))


def record(digests: dict[str, str]) -> bytes:
    """The record of a shard whose files have these digests."""
    return "".join(f"{digests[key]}  {key}\n" for key in sorted(digests)).encode()


def read_record(url: str, layout: Layout, shard: int, data: bytes | None) -> dict[str, str]:
    """Digests of a shard's files by their keys, from its record. Raises `StoreError` for a record
    that is missing or damaged."""
    lines = re.findall(rb"([0-9a-f]{64})  (.+)\n", data or b"")
    digests = {key.decode(errors="replace"): found.decode() for found, key in lines}
    layout.vouch(
        url,
        record_key(shard),
        data,
        record(digests) == data and set(digests) == set(layout.of(shard)),
    )
    return digests
