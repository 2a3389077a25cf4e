"""The torch dataset over a store: windows, splits, processes."""

import pickle
import warnings
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import torch
import zarr
from torch.utils.data import DataLoader

from torchsoft.datasets.files import MANIFEST, Layout, Manifest, digest, keys, record, record_key, write_bytes
from torchsoft.datasets.reader import Trajectories, open_dataset

COUNT, SAMPLES = 10, 21


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A store of known numbers, shards of four; trajectory 2 failed, the last shard is unfinished."""
    url = str(tmp_path_factory.mktemp("store") / "set")
    group = zarr.create_group(url, zarr_format=3)

    def put(name: str, values: np.ndarray, dims: tuple[str, ...], chunk: int) -> None:
        chunks = (chunk, *values.shape[1:])
        dtype = "str" if values.dtype == object else values.dtype
        array = group.create_array(
            name, shape=values.shape, dtype=dtype, chunks=chunks, dimension_names=dims, attributes={"units": "1"},
            fill_value=1 if name == "failed" else None, config={"write_empty_chunks": True},
        )  # fmt: skip
        array[:] = values

    put("time", np.arange(SAMPLES) * 0.1, ("time",), SAMPLES)
    values = np.arange(COUNT * SAMPLES * 2, dtype=float).reshape(COUNT, SAMPLES, 2)
    put("disc_position", values, ("trajectory", "time", "axis"), 4)
    put("pad.E", np.arange(COUNT) + 0.5, ("trajectory",), 4)
    put("large", np.array([6e4, np.inf, 0.0, 7e5, *[1.0] * (COUNT - 4)]), ("trajectory",), 4)
    put("failed", (np.arange(COUNT) == 2).astype(np.uint8), ("trajectory",), 4)
    put("split", np.array((["train", "test"] * COUNT)[:COUNT], object), ("trajectory",), 4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # consolidated metadata is zarr-python's and xarray's own addition
        zarr.consolidate_metadata(url)
    files = ("disc_position/c/{shard}/0/0", "pad.E/c/{shard}", "large/c/{shard}", "failed/c/{shard}", "split/c/{shard}")
    layout = Layout(shards=3, trajectories_per_shard=4, files=files)
    there = {key: digest((Path(url) / key).read_bytes()) for key in keys(url)}
    of_shards = {key: there.pop(key) for shard in range(3) for key in layout.of(shard)}
    made: dict[str, Any] = {
        "torchsoft": "0",
        "commit": "",
        "seed": 0,
        "config_hash": "",
        "config": {},
        "parameters": {},
    }
    write_bytes(url, MANIFEST, Manifest(**made, layout=layout, digests=there).text().encode())
    for shard in range(2):
        write_bytes(url, record_key(shard), record({key: of_shards[key] for key in layout.of(shard)}))
    return url


def reading(url: str, *what: Any, **how: Any) -> Trajectories:
    """What is finished."""
    return Trajectories(url, *what, **how, unfinished=True)


def test_windows_hold_what_the_store_holds(store: str) -> None:
    data = reading(store, ["disc_position", "pad.E"], split="train", window=5, stride=8)
    assert data.trajectories.tolist() == [0, 4, 6]  # 2 failed, 8 is unfinished
    assert len(data) == 3 * 3
    item = data[4]  # the second window of trajectory 4
    assert (int(item["trajectory"]), int(item["start"])) == (4, 8)
    torch.testing.assert_close(
        item["disc_position"], torch.arange(10.0, dtype=torch.float64).reshape(5, 2) + 4 * 42 + 16
    )
    assert item["pad.E"] == 4.5
    assert int(data[-1]["start"]) == 16


def test_splits_are_disjoint_and_all_is_their_union(store: str) -> None:
    train, test, everything = (set(reading(store, [], split=s).trajectories) for s in ("train", "test", None))
    assert not train & test
    assert train | test == everything == {0, 1, 3, 4, 5, 6, 7}


def test_it_pickles_small_and_loads_in_workers(store: str) -> None:
    data = reading(store, ["disc_position"], window=7, dtype=torch.float32)
    data[0]
    assert len(pickle.dumps(data)) < 2000
    batches = list(DataLoader(data, batch_size=4, num_workers=2, multiprocessing_context="fork"))
    got, want = torch.cat([b["disc_position"] for b in batches]), torch.stack([x["disc_position"] for x in data])
    assert got.dtype == torch.float32
    torch.testing.assert_close(got, want)


def test_object_stores_are_read_like_folders_and_by_forked_workers(store: str) -> None:
    url = "memory://copy/set"
    fsspec.filesystem("memory").put(store, "/copy/set", recursive=True)
    data, plain = (reading(place, ["disc_position", "pad.E"], window=7) for place in (url, store))
    data[0]  # opened before the fork
    batches = list(DataLoader(data, batch_size=4, num_workers=2, multiprocessing_context="fork", timeout=60))
    for name in data.variables:
        torch.testing.assert_close(torch.cat([b[name] for b in batches]), torch.stack([x[name] for x in plain]))
    assert open_dataset(url, unfinished=True).identical(open_dataset(store, unfinished=True))
    assert open_dataset(Path(store).as_uri(), unfinished=True).identical(open_dataset(store, unfinished=True))


def test_wrong_arguments_are_refused(store: str) -> None:
    with pytest.raises(ValueError, match=r"no numbers named 'disc_pose'; known: disc_position, failed, large, pad\.E"):
        reading(store, ["disc_pose"])
    with pytest.raises(ValueError, match="`window` must be 1 to 21"):
        reading(store, ["disc_position"], window=22)
    for name, value in (("window", 10.5), ("window", 0), ("stride", 0), ("stride", 2.5)):
        with pytest.raises(ValueError, match=f"`{name}` must be a whole number from 1 on, but is {value}"):
            reading(store, ["disc_position"], **{name: value})
    for dtype in (torch.int32, torch.bool, torch.complex64, "float32"):
        with pytest.raises(ValueError, match=r"`dtype` must be one of torch\.float64, .*, but is "):
            reading(store, ["disc_position"], dtype=dtype)
    with pytest.raises(ValueError, match="`split` must be"):
        reading(store, ["disc_position"], split="dev")
    with pytest.raises(IndexError):
        reading(store, ["disc_position"])[100]


def test_numbers_that_the_dtype_cannot_hold_are_refused(store: str) -> None:
    """And those that are not finite in the store are given as they are."""
    data = reading(store, ["disc_position", "large"], dtype=torch.float16)
    assert data[0]["large"] == 6e4
    assert torch.isinf(data[1]["large"])
    with pytest.raises(
        ValueError, match=r"`large` of trajectory 3 holds 7e\+05, which torch\.float16 cannot; take a wider `dtype`"
    ):
        data[2]


def test_xarray_reads_the_same(store: str) -> None:
    assert open_dataset(store, unfinished=True)["pad.E"].values[3] == 3.5
    assert Path(store).is_dir()
