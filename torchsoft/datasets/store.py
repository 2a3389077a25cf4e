"""The zarr store: laid out whole at the start, then written one shard at a time, each with its flag after its data."""

import errno
import json
import subprocess
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import zarr
from fsspec.implementations.local import LocalFileSystem
from numpy.typing import NDArray
from zarr.codecs import BloscCodec

from torchsoft.channels import PADS
from torchsoft.datasets.config import Config
from torchsoft.datasets.reader import local_path
from torchsoft.datasets.schema import Variable, sizes, variables
from torchsoft.datasets.simulation import Row
from torchsoft.files import write_json
from torchsoft.parameters import Parameters
from torchsoft.physics.paper import SoftGrasp

MANIFEST = "manifest.json"


class StoreError(RuntimeError):
    """A store that cannot be used, and what to do about it."""


class Store:
    """A dataset at `url` (a folder, or what fsspec opens). Trajectories lie in shards of equal size, along `trajectory`.

    Every array has the same shard boundaries, so that one task writes whole shards only and no two tasks share one.
    """

    def __init__(self, url: str, config: Config) -> None:
        self.url, self.config = url, config
        self.group = zarr.open_group(local_path(url), mode="r+", zarr_format=3)

    def rows(self, shard: int) -> range:
        """The trajectories of a shard."""
        size = self.config.trajectories_per_shard
        return range(shard * size, min((shard + 1) * size, self.config.trajectories))

    def unfinished(self) -> list[int]:
        """Shards whose flag is not set."""
        return np.flatnonzero(np.asarray(self.array("done")[:]) == 0).tolist()

    def array(self, name: str) -> zarr.Array[Any]:
        found = self.group[name]
        assert isinstance(found, zarr.Array)
        return found

    def write(self, shard: int, rows: list[Row]) -> None:
        """Write a whole shard, then its flag. Raises `StoreError` when there is no room or no permission."""
        here = self.rows(shard)
        if len(rows) != len(here):
            raise ValueError(f"shard {shard} holds {len(here)} trajectories, but {len(rows)} were given")
        with store_errors(self.url):
            for name, variable in variables(self.config).items():
                array = self.array(name)
                assert (array.shards or array.chunks)[0] == self.config.trajectories_per_shard, f"{name} is not aligned"
                dtype = object if variable.dtype == "str" else variable.dtype
                values = np.array([row[name] for row in rows], dtype)
                assert values.shape[1:] == array.shape[1:], f"{name} has another shape"  # zarr would cut it
                array[here.start : here.stop] = values
            self.array("done")[shard] = 1


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
        raise StoreError(f"{url}: {type(error).__name__}: {error}") from error


def store_error(error: OSError, url: str) -> StoreError:
    """An operating system's error with what to do about it."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StoreError(f"{url}: the disk is full; make room and start again: finished shards are kept")
    if error.errno == errno.EFBIG:
        return StoreError(f"{url}: a file outgrew the limit on file sizes (ulimit -f); raise it or make smaller shards")
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        return StoreError(f"{url}: a part of this path is a file; choose another folder")
    if isinstance(error, PermissionError) or error.errno == errno.EROFS:
        return StoreError(f"{url}: may not be written ({error.strerror or error}); choose another folder")
    return StoreError(f"{url}: {error}")


def filesystem(url: str) -> tuple[Any, str]:
    """The filesystem and the path in it, with nothing remembered of what others may have written since."""
    try:
        fs, root = fsspec.url_to_fs(url)
    except ImportError as error:  # a known protocol whose package is not installed
        raise StoreError(f"{url}: {error}") from error
    fs.invalidate_cache()
    return fs, root


def read_text(url: str, name: str) -> str | None:
    """A small file of the store, or None where there is none."""
    fs, root = filesystem(url)
    path = f"{root}/{name}"
    return fs.cat_file(path).decode() if fs.exists(path) else None


def open_or_create(url: str, config: Config) -> Store:
    """The store of this configuration: a new one in an empty place, or the unfinished one that is there.

    Raises `StoreError` for a folder that holds anything else, or that cannot be written.
    """
    with store_errors(url):
        text = read_text(url, MANIFEST)
        if text is None:
            create(url, config)
        else:
            check_same(url, text, config)
            remove_partials(url)
        return Store(url, config)


def check_same(url: str, text: str, config: Config) -> None:
    """Refuse to go on with another configuration's or another version's dataset."""
    try:
        manifest = json.loads(text)
    except json.JSONDecodeError as error:
        raise StoreError(f"{url}/{MANIFEST} is not JSON ({error}); choose another folder") from error
    here = {"config_hash": config.hash, "torchsoft": version("torchsoft")}
    for key, value in here.items():
        if manifest.get(key) != value:
            raise StoreError(
                f"{url} holds another dataset ({key} is {manifest.get(key)}, not {value}); choose another folder"
            )


def remove_partials(url: str) -> None:
    """Remove the partial files that a killed run left behind in a local folder; object stores show whole objects only."""
    fs, root = filesystem(url)
    if isinstance(fs, LocalFileSystem):
        for partial in Path(root).rglob("*.partial"):
            partial.unlink(missing_ok=True)


def create(url: str, config: Config) -> None:
    """Lay the whole store out; the manifest comes last, and a store without one is no store."""
    fs, root = filesystem(url)
    marker = f"{root}/.creating"
    if fs.exists(root) and not fs.isdir(root):
        raise StoreError(f"{url} is a file; give a folder")
    if fs.exists(root) and fs.ls(root) and not fs.exists(marker):
        raise StoreError(f"{url} is not empty and holds no dataset; choose an empty or a new folder")
    fs.makedirs(root, exist_ok=True)
    fs.pipe_file(marker, b"this dataset is being laid out")
    attributes: dict[str, Any] = {"title": config.title, "description": config.description, "config_hash": config.hash}
    group = zarr.create_group(local_path(url), overwrite=False, zarr_format=3, attributes=attributes)\
        if not fs.exists(f"{root}/zarr.json") else zarr.open_group(local_path(url), mode="r+", zarr_format=3)  # fmt: skip
    for name, variable in variables(config).items():
        create_array(group, name, variable, config)
    coordinates(group, config)
    done: dict[str, Any] = {"units": "1", "long_name": "1 where the shard is finished"}
    group.create_array(
        "done", shape=(config.shards,), chunks=(1,), dtype="uint8", fill_value=0, compressors=None, attributes=done,
        dimension_names=("shard",), overwrite=True,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # consolidated metadata is zarr-python's and xarray's own addition
        zarr.consolidate_metadata(group.store)
    write_manifest(url, manifest(config))
    fs.rm_file(marker)


def create_array(group: zarr.Group, name: str, variable: Variable, config: Config) -> None:
    """One empty array: a chunk is one trajectory's stretch of time, a shard is one task's."""
    length = sizes(config)
    shape = tuple(length[dim] for dim in variable.dims)
    group_size, rest = config.trajectories_per_shard, shape[2:]
    if len(shape) == 1:
        layout: dict[str, Any] = {"chunks": (group_size,)}
    else:
        samples = min(config.samples_per_chunk, shape[1])
        layout = {
            "chunks": (1, samples, *rest),
            "shards": (group_size, samples * -(-shape[1] // samples), *rest),
            "compressors": BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"),
        }
    attributes: dict[str, Any] = {"units": variable.unit, "long_name": variable.meaning}
    if variable.components:
        attributes["components"] = list(variable.components)
    group.create_array(
        name, shape=shape, dtype=variable.dtype, dimension_names=variable.dims, attributes=attributes, overwrite=True,
        fill_value="" if variable.dtype == "str" else np.nan if variable.dtype.startswith("float") else 0, **layout,
    )  # fmt: skip


def coordinates(group: zarr.Group, config: Config) -> None:
    """Time and the surface nodes' positions; the axes by name."""
    pads = SoftGrasp(Parameters().override(config.fixed)).pads
    x = {f"{pad}_surface": pads[k].point_positions[:, 0].numpy() for k, pad in PADS.items()}
    time = np.arange(config.samples) * config.sample_interval
    columns: dict[str, tuple[NDArray[Any], str, str]] = {
        "time": (time, "s", "time since the start"),
        "lower_surface": (x["lower_surface"], "m", "x of the lower pad's surface nodes, undeformed"),
        "upper_surface": (x["upper_surface"], "m", "x of the upper pad's, relative to the bracket's centre"),
        "trajectory": (np.arange(config.trajectories), "1", "number of the trajectory in the design"),
    }
    for name, (values, unit, meaning) in columns.items():
        attributes: dict[str, Any] = {"units": unit, "long_name": meaning}
        array = group.create_array(
            name, shape=values.shape, dtype=values.dtype, dimension_names=(name,), attributes=attributes, overwrite=True
        )
        array[:] = values
    axis = group.create_array("axis", shape=(2,), dtype="str", dimension_names=("axis",), overwrite=True)
    axis[:] = np.array(["x", "y"], object)


def manifest(config: Config) -> dict[str, Any]:
    """How the dataset is made."""
    return {
        "torchsoft": version("torchsoft"),
        "commit": commit(),
        "seed": config.seed,
        "config_hash": config.hash,
        "config": config.model_dump(mode="json"),
        "parameters": {name: row["value"] for name, row in Parameters().override(config.fixed).table().items()},
        "layout": {"shards": config.shards, "trajectories_per_shard": config.trajectories_per_shard},
    }


def write_manifest(url: str, content: dict[str, Any]) -> None:
    """The file appears whole or not at all."""
    fs, root = filesystem(url)
    if isinstance(fs, LocalFileSystem):
        write_json(f"{root}/{MANIFEST}", content)
    else:  # object stores put whole objects
        fs.pipe_file(f"{root}/{MANIFEST}", (json.dumps(content, indent=2) + "\n").encode())


def commit() -> str:
    """The commit that made it, empty outside a repository."""
    try:
        here = Path(__file__).parent
        found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return found.stdout.strip()
