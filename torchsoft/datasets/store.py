"""The writing of a dataset: laid out whole at the start, then one shard at a time, each with its record after its data."""

import subprocess
from importlib.metadata import version
from pathlib import Path

import numpy as np
import zarr

from torchsoft.datasets import layout
from torchsoft.datasets.config import Config
from torchsoft.datasets.manifest import MANIFEST, Manifest, digest, finished, record, record_key
from torchsoft.datasets.schema import not_finite, variables
from torchsoft.datasets.simulation import Row
from torchsoft.datasets.storage import (
    StoreError,
    filesystem,
    keys,
    read_bytes,
    remove_leftovers,
    store_errors,
    write_bytes,
)  # fmt: skip
from torchsoft.datasets.vouched import Vouched
from torchsoft.files import PARTIAL, finite
from torchsoft.paper.parameters import Parameters


class Store:
    """A dataset at `url` (a folder, or what fsspec opens). Trajectories lie in shards of equal size, along `trajectory`.

    Every array has the same shard boundaries, so that one task writes whole files only and no two tasks share one.
    """

    def __init__(self, url: str, config: Config) -> None:
        self.url, self.config = url, config
        self.manifest = Manifest.read(url)

    def rows(self, shard: int) -> range:
        """The trajectories of a shard."""
        size = self.config.trajectories_per_shard
        return range(shard * size, min((shard + 1) * size, self.config.trajectories))

    def unfinished(self) -> list[int]:
        """Shards that have no record."""
        return sorted(set(range(self.config.shards)) - finished(self.url, self.manifest.layout))

    def write(self, shard: int, rows: list[Row]) -> None:
        """Write a whole shard, then its record. Raises `StoreError` when there is no room or no permission, and
        `ValueError` for a trajectory that is neither finite nor failed."""
        here = self.rows(shard)
        if len(rows) != len(here):
            raise ValueError(f"shard {shard} holds {len(here)} trajectories, but {len(rows)} were given")
        for index, row in zip(here, rows, strict=True):
            if bad := not_finite(self.config, row):
                raise ValueError(f"trajectory {index} is not marked as failed, but not finite: {', '.join(bad)}")
        with store_errors(self.url):
            store = Vouched(self.url, self.manifest, read_only=False)
            group = zarr.open_group(store, mode="r+", zarr_format=3)
            for name, variable in variables(self.config).items():
                array = group[name]
                assert isinstance(array, zarr.Array)
                assert (array.shards or array.chunks)[0] == self.config.trajectories_per_shard, f"{name} is not aligned"
                dtype = object if variable.dtype == "str" else variable.dtype
                values = np.array([row[name] for row in rows], dtype)
                assert values.shape[1:] == array.shape[1:], f"{name} has another shape"  # zarr would cut it
                array.with_config({"write_empty_chunks": True})[here.start : here.stop] = values
            digests = {key: store.digests[key] for key in self.manifest.layout.of(shard)}
            write_bytes(self.url, record_key(shard), record(digests))


def open_or_create(url: str, config: Config) -> Store:
    """The store of this configuration: a new one in an empty place, or the unfinished one that is there.

    Raises `StoreError` for a folder that holds anything else, or that cannot be written.
    """
    with store_errors(url):
        if read_bytes(url, MANIFEST) is None:
            create(url, config)
        check_same(url, Manifest.read(url), config)
        remove_leftovers(url)
        return Store(url, config)


def check_same(url: str, manifest: Manifest, config: Config) -> None:
    """Refuse to go on with another configuration's or another version's dataset."""
    for key, value in {"config_hash": config.hash, "torchsoft": version("torchsoft")}.items():
        there = getattr(manifest, key)
        if there != value:
            raise StoreError(f"{url} holds another dataset ({key} is {there}, not {value}); choose another folder")


def create(url: str, config: Config) -> None:
    """Lay the whole store out; the manifest comes last, and a store without one is no store."""
    fs, root = filesystem(url)
    if fs.exists(root) and not fs.isdir(root):
        raise StoreError(f"{url} is a file; give a folder")
    content = layout.files(config)
    if not only_layout(url, content):
        if read_bytes(url, MANIFEST) is None:
            raise StoreError(f"{url} is not empty and holds no dataset; choose an empty or a new folder")
        return  # another process has laid it out meanwhile
    for key, data in content.items():
        write_bytes(url, key, data)
    if read_bytes(url, MANIFEST) is None:
        write_bytes(url, MANIFEST, manifest(config, content).text().encode())


def only_layout(url: str, content: dict[str, bytes]) -> bool:
    """Whether all that is at `url` are files of this layout, as a killed run leaves them behind."""
    fs, root = filesystem(url)
    names = {path.rstrip("/").rpartition("/")[2] for path in fs.ls(root, detail=False)} if fs.exists(root) else set()
    mine = {key.partition("/")[0] for key in (*content, MANIFEST)}
    if not {PARTIAL.sub("", name) for name in names} <= mine:
        return False
    return all(
        PARTIAL.sub("", key) in (*content, MANIFEST)
        if PARTIAL.search(key)
        else read_bytes(url, key) == content.get(key)
        for key in keys(url)
    )


def manifest(config: Config, content: dict[str, bytes]) -> Manifest:
    """How the dataset is made, and the digests of the files that are laid out."""
    return Manifest(
        torchsoft=version("torchsoft"),
        commit=commit(),
        seed=config.seed,
        config_hash=config.hash,
        config=finite(config.model_dump(mode="json")),
        parameters=finite({name: row["value"] for name, row in Parameters().override(config.fixed).table().items()}),
        layout=layout.shards(config),
        digests={key: digest(data) for key, data in sorted(content.items())},
    )


def commit() -> str:
    """The commit that made it, empty outside a repository."""
    try:
        here = Path(__file__).parent
        found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return found.stdout.strip()
