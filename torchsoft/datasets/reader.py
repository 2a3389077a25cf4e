"""Datasets of trajectories in a zarr store, for torch's `DataLoader` and for xarray. What was not written so is refused."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import xarray as xr
import zarr
from torch import Tensor
from torch.utils.data import Dataset

from torchsoft.datasets.manifest import Manifest, finished
from torchsoft.datasets.storage import StoreError
from torchsoft.datasets.vouched import Vouched
from torchsoft.physics.arguments import whole

DTYPES = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
"""What numbers may be given as."""


def vouched(url: str, *, unfinished: bool = False) -> Vouched:
    """The store for reading. Raises `StoreError` for a dataset that is damaged, or not finished unless that is allowed."""
    manifest = Manifest.read(url)
    there = finished(url, manifest.layout)
    if (lacking := manifest.layout.shards - len(there)) and not unfinished:
        raise StoreError(
            f"{url}: {lacking} of {manifest.layout.shards} shards are not finished; start `python -m data_gen.generate` "
            "again to make them, or give `unfinished=True` to leave their trajectories out"
        )
    return Vouched(url, manifest, there)


class Trajectories(Dataset[dict[str, Tensor]]):
    """Windows of the trajectories of one split, read on access.

    Item i holds every variable of `variables` in SI units, a series as (window, ...) and a number of the trajectory as (), in
    one of `DTYPES`, besides `trajectory` and `start`, its origin. `window` is a number of samples, the whole run by
    default; windows of a trajectory begin every `stride` samples, `window` by default. Failed simulations are left out, and
    trajectories of unfinished shards too where `unfinished` says so. The object is small, can be pickled, and opens the store
    in each process for itself, forked ones included. Each of these reads a file whole when it first touches it, to hold it
    against its digest.

    Raises `ValueError` for an unknown variable or split, another dtype, or a window or stride that does not fit, and
    `StoreError` for a dataset that is damaged or unfinished; the same when a damaged file is first touched, and `ValueError`
    for an item with a number that is too large for the dtype.
    """

    def __init__(
        self, url: str, variables: Sequence[str], *, split: str | None = None, window: int | None = None,
        stride: int | None = None, dtype: torch.dtype = torch.float64, unfinished: bool = False,
    ) -> None:  # fmt: skip
        self.url, self.variables, self.dtype, self.unfinished = str(url), tuple(variables), dtype, unfinished
        if dtype not in DTYPES:
            raise ValueError(f"`dtype` must be one of {', '.join(map(str, DTYPES))}, but is {dtype!r}")
        self._group: zarr.Group | None = None
        self._opened_by = 0
        for name in self.variables:
            if name not in self.group or self.dims(name)[0] != "trajectory" or self.array(name).dtype.kind not in "fiu":
                known = [k for k, a in self.group.arrays() if self.dims(k)[0] == "trajectory" and a.dtype.kind in "fiu"]
                raise ValueError(f"`variables` has no numbers named {name!r}; known: {', '.join(sorted(known))}")
        samples = self.array("time").shape[0]
        self.window = samples if window is None else whole("window", window, 1)
        if self.window > samples:
            raise ValueError(f"`window` must be 1 to {samples} samples, but is {window}")
        step = self.window if stride is None else whole("stride", stride, 1)
        self.starts = range(0, samples - self.window + 1, step)
        self.trajectories = self._usable(split)

    def _usable(self, split: str | None) -> np.ndarray[Any, Any]:
        """Numbers of the trajectories that are sound and in the split; those of unfinished shards count as failed."""
        usable = np.asarray(self.array("failed")[:]) == 0
        if split is not None:
            if split not in ("train", "validation", "test"):
                raise ValueError(f"`split` must be 'train', 'validation' or 'test', but is {split!r}")
            usable &= np.asarray(self.array("split")[:]) == split
        return np.flatnonzero(usable)

    @property
    def group(self) -> zarr.Group:
        """The store, opened on first use; once more after a fork, which connections do not survive."""
        if self._group is None or self._opened_by != os.getpid():
            self._group = opened(vouched(self.url, unfinished=self.unfinished))
            self._opened_by = os.getpid()
        return self._group

    def array(self, name: str) -> zarr.Array[Any]:
        found = self.group[name]
        assert isinstance(found, zarr.Array)
        return found

    def dims(self, name: str) -> tuple[str | None, ...]:
        """Names of a variable's dimensions."""
        return tuple(getattr(self.array(name).metadata, "dimension_names", None) or (None,))

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_group": None}

    def __len__(self) -> int:
        return len(self.trajectories) * len(self.starts)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} is out of range for {len(self)} windows")
        which, window = divmod(index % len(self), len(self.starts))
        trajectory, start = int(self.trajectories[which]), self.starts[window]
        item = {"trajectory": torch.tensor(trajectory), "start": torch.tensor(start)}
        for name in self.variables:
            array = self.array(name)
            at = (trajectory, slice(start, start + self.window)) if array.ndim > 1 else trajectory
            given = torch.from_numpy(np.array(array[at], dtype=float))
            item[name] = given.to(self.dtype)
            lost = given[item[name].isinf() & given.isfinite()]
            if len(lost):
                raise ValueError(
                    f"`{name}` of trajectory {trajectory} holds {float(lost[0]):.3g}, which {self.dtype} cannot; take a wider "
                    "`dtype`"
                )
        return item


def opened(store: Vouched) -> zarr.Group:
    """The arrays."""
    return zarr.open_group(store, mode="r", zarr_format=3, use_consolidated=True)


def open_dataset(url: str, *, unfinished: bool = False) -> xr.Dataset:
    """The whole store, lazily, with named dimensions and units; without unfinished trajectories where that is allowed.

    Raises `StoreError` for a dataset that is damaged or unfinished; the same when a damaged file is first touched.
    """
    store = vouched(url, unfinished=unfinished)
    data = xr.open_zarr(store, consolidated=True, zarr_format=3)
    if len(store.finished) < store.layout.shards:
        shard = np.arange(data.sizes["trajectory"]) // store.layout.trajectories_per_shard
        data = data.isel(trajectory=np.isin(shard, list(store.finished)))
    return data
