"""The files of an empty dataset: the metadata of every array, and the coordinates. Arrays carry checksums (crc32c)."""

import warnings
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer
from zarr.storage import MemoryStore

from torchsoft.channels import PADS
from torchsoft.datasets.config import Config
from torchsoft.datasets.manifest import Layout
from torchsoft.datasets.schema import Variable, sizes, variables
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import SoftGrasp

SMALL = (ZstdCodec(level=3), Crc32cCodec())
LARGE = (BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"), Crc32cCodec())
"""Compression and checksum of the chunks of small arrays and of series. The index of a shard has a checksum by default."""


def shards(config: Config) -> Layout:
    """The shards: every array of trajectories has one file in each."""
    files = (f"{name}/c/{{shard}}" + "/0" * (len(v.dims) - 1) for name, v in variables(config).items())
    return Layout(shards=config.shards, trajectories_per_shard=config.trajectories_per_shard, files=tuple(files))


def files(config: Config) -> dict[str, bytes]:
    """The content of every file by its key. It follows from the configuration, so that several may lay out one folder."""
    content: dict[str, Buffer] = {}
    attributes: dict[str, Any] = {"title": config.title, "description": config.description, "config_hash": config.hash}
    group = zarr.create_group(MemoryStore(content), zarr_format=3, attributes=attributes)
    for name, variable in variables(config).items():
        create_array(group, name, variable, config)
    coordinates(group, config)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # consolidated metadata is zarr-python's and xarray's own addition
        zarr.consolidate_metadata(group.store)
    return {key: data.to_bytes() for key, data in content.items()}


def create_array(group: zarr.Group, name: str, variable: Variable, config: Config) -> None:
    """One empty array: a chunk is one trajectory's stretch of time, a shard is one task's."""
    length = sizes(config)
    shape = tuple(length[dim] for dim in variable.dims)
    group_size, rest = config.trajectories_per_shard, shape[2:]
    if len(shape) == 1:
        how: dict[str, Any] = {"chunks": (group_size,), "compressors": SMALL}
    else:
        samples = min(config.samples_per_chunk, shape[1])
        how = {
            "chunks": (1, samples, *rest),
            "shards": (group_size, samples * -(-shape[1] // samples), *rest),
            "compressors": LARGE,
        }
    attributes: dict[str, Any] = {"units": variable.unit, "long_name": variable.meaning}
    if variable.components:
        attributes["components"] = list(variable.components)
    if variable.dtype == "str":
        empty: Any = ""
    elif variable.dtype.startswith("float"):
        empty = np.nan
    else:
        empty = int(name == "failed")  # what was never written counts as failed
    group.create_array(
        name, shape=shape, dtype=variable.dtype, dimension_names=variable.dims, attributes=attributes,
        fill_value=empty, **how,
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
        "axis": (np.array(["x", "y"], object), "1", "names of the axes"),
    }
    for name, (values, unit, meaning) in columns.items():
        array = group.create_array(
            name, shape=values.shape, chunks=values.shape, dtype="str" if values.dtype == object else values.dtype,
            dimension_names=(name,), attributes={"units": unit, "long_name": meaning}, compressors=SMALL,
            config={"write_empty_chunks": True},
        )  # fmt: skip
        array[:] = values
