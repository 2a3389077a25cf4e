"""Writing of a dataset: the whole layout first, then one shard at a time, and its record after its
data."""

import subprocess
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer
from zarr.core.buffer.cpu import Buffer as Content
from zarr.storage import MemoryStore

from torchsoft.datasets.config import Config
from torchsoft.datasets.files import (
    MANIFEST,
    Layout,
    Manifest,
    StoreError,
    digest,
    filesystem,
    folder,
    keys,
    read_bytes,
    record,
    record_key,
    store_errors,
    write_bytes,
)  # fmt: skip
from torchsoft.datasets.schema import coordinates
from torchsoft.files import PARTIAL, finite, remove_partials

SMALL = (ZstdCodec(level=3), Crc32cCodec())
LARGE = (BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"), Crc32cCodec())
"""Compression and checksum of the chunks of small arrays and of series. The index of a shard has a
checksum by default."""


class Store:
    """A dataset at `url`, a local folder or any store of fsspec. Trajectories lie in shards of
    equal size, along `trajectory`.

    Every array has the same shard boundaries, so that one task writes whole files only and no two
    tasks share one.
    """

    def __init__(self, url: str, config: Config) -> None:
        self.url, self.config = url, config
        self.manifest = Manifest.read(url)

    def unfinished(self) -> list[int]:
        """Shards that have no record, or lack a file."""
        return sorted(set(range(self.config.shards)) - self.manifest.layout.whole(self.url))

    def finished(self, shard: int) -> bool:
        """Whether a shard has a record and all its files."""
        fs, root = filesystem(self.url)
        needed = record_key(shard), *self.manifest.layout.of(shard)
        return all(fs.exists(f"{root}/{key}") for key in needed)

    def write(self, shard: int, rows: list[dict[str, Any]]) -> None:
        """Write a whole shard, then its record. Raises `StoreError` when there is no room or no
        permission, and `ValueError` for a trajectory that is neither finite nor failed."""
        here, digests = self.config.rows(shard), dict[str, str]()
        for index, row in zip(here, rows, strict=True):
            if bad := self.config.subject.not_finite(row):
                raise ValueError(
                    f"trajectory {index} is not marked as failed, but not finite: {', '.join(bad)}"
                )
        with store_errors(self.url):
            encoded: dict[str, Buffer] = {
                "zarr.json": Content.from_bytes(self.manifest.laid_out(self.url, "zarr.json"))
            }
            group = zarr.open_group(MemoryStore(encoded), mode="r+", zarr_format=3)
            for (name, variable), key in zip(
                self.config.subject.variables.items(), self.manifest.layout.of(shard), strict=True
            ):
                array = group[name]
                assert isinstance(array, zarr.Array)
                values = np.stack([np.broadcast_to(row[name], variable.shape[1:]) for row in rows])
                array.with_config({"write_empty_chunks": True})[here.start : here.stop] = (
                    values.astype(variable.kept)
                )
                data = encoded.pop(key).to_bytes()
                write_bytes(self.url, key, data)
                digests[key] = digest(data)
            write_bytes(self.url, record_key(shard), record(digests))


def open_or_create(url: str, config: Config) -> Store:
    """The store of this configuration: a new one in an empty place, or the unfinished one that is
    there.

    Raises `StoreError` for a folder that holds anything else, or that cannot be written.
    """
    with store_errors(url):
        if read_bytes(url, MANIFEST) is None:
            create(url, config)
        store = Store(url, config)
        for key, value in {"config_hash": config.hash, "torchsoft": version("torchsoft")}.items():
            if (there := getattr(store.manifest, key)) != value:
                raise StoreError(
                    f"{url} holds another dataset ({key} is {there}, not {value}); choose another "
                    "folder"
                )
        if here := folder(url):
            remove_partials(here.rglob("*.partial"))  # that killed runs left behind
        return store


def create(url: str, config: Config) -> None:
    """Lay the whole store out. The manifest comes last: a store without one counts as none."""
    fs, root = filesystem(url)
    if fs.exists(root) and not fs.isdir(root):
        raise StoreError(f"{url} is a file; give a folder")
    content = laid_out(config)
    content[MANIFEST] = manifest(config, content).text().encode()
    if is_part(url, content):
        for key, data in content.items():
            if read_bytes(url, key) is None:
                write_bytes(url, key, data)
    elif read_bytes(url, MANIFEST) is None:  # or another process has laid it out meanwhile
        raise StoreError(
            f"{url} is not empty and holds no dataset; choose an empty or a new folder"
        )


def is_part(url: str, content: dict[str, bytes]) -> bool:
    """Whether all files at `url` are of this content, whole or partial, as a killed run leaves
    them."""
    fs, root = filesystem(url)
    names = (
        {PARTIAL.sub("", Path(path).name) for path in fs.ls(root, detail=False)}
        if fs.exists(root)
        else set()
    )
    return names <= {
        key.partition("/")[0] for key in content
    } and all(  # before a look at all that is below
        PARTIAL.sub("", key) in content
        if PARTIAL.search(key)
        else read_bytes(url, key) == content.get(key)
        for key in keys(url)
    )


def laid_out(config: Config) -> dict[str, bytes]:
    """Content of every file of an empty dataset by its key: the metadata of every array, and the
    coordinates. It follows from the configuration, so that several processes may lay out one
    folder."""
    content: dict[str, Buffer] = {}
    about: Any = {
        "title": config.title,
        "description": config.description,
        "config_hash": config.hash,
    }
    group = zarr.create_group(MemoryStore(content), zarr_format=3, attributes=about)
    size = config.trajectories_per_shard
    for name, variable in config.subject.variables.items():
        _, *series = variable.shape
        storage: dict[str, Any] = {"chunks": (size,), "compressors": SMALL}
        if series:  # a chunk is one trajectory's stretch of time, a shard is one task's
            time, *rest = series
            samples = min(config.samples_per_chunk, time)
            shard = (size, samples * -(-time // samples), *rest)
            storage = {"chunks": (1, samples, *rest), "shards": shard, "compressors": LARGE}
        attributes: dict[str, Any] = {"units": variable.unit, "long_name": variable.meaning}
        if variable.components:
            attributes["components"] = list(variable.components)
        group.create_array(
            name, shape=variable.shape, dtype=variable.dtype, dimension_names=tuple(variable.sizes),
            attributes=attributes, fill_value=int(name == "failed") or variable.empty, **storage,
            # what was never written counts as failed
        )  # fmt: skip
    for name, one in coordinates(config, config.subject.template).items():
        group.create_array(
            name, data=one.values, chunks=one.values.shape, dimension_names=one.dimensions,
            attributes={"units": one.unit, "long_name": one.meaning}, compressors=SMALL,
            config={"write_empty_chunks": True},
        )  # fmt: skip
    # consolidated metadata is zarr-python's and xarray's own addition
    with warnings.catch_warnings(action="ignore"):
        zarr.consolidate_metadata(group.store)
    return {key: data.to_bytes() for key, data in content.items()}


def manifest(config: Config, content: dict[str, bytes]) -> Manifest:
    """The manifest of a dataset with these files. Every array has one file in each shard."""
    files = (
        f"{name}/c/{{shard}}" + "/0" * (len(v.shape) - 1)
        for name, v in config.subject.variables.items()
    )
    size = config.trajectories_per_shard
    return Manifest(
        torchsoft=version("torchsoft"),
        commit=commit(),
        seed=config.seed,
        config_hash=config.hash,
        config=finite(config.model_dump(mode="json")),
        parameters=finite(config.subject.constants),
        layout=Layout(shards=config.shards, trajectories_per_shard=size, files=tuple(files)),
        digests={key: digest(data) for key, data in sorted(content.items())},
    )


def commit() -> str:
    """The commit of torchsoft's source, empty outside a repository."""
    try:
        here = Path(__file__).parent
        found = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=False
        )
    except OSError:
        return ""
    return found.stdout.strip()
