"""Reading of a dataset, for torch's `DataLoader` and for xarray. Files unlike their digests are
rejected."""

import os
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
import xarray as xr
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info
from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import FsspecStore, LocalStore, WrapperStore

from torchsoft.cost import machine_memory
from torchsoft.datasets.files import (
    Manifest,
    StoreError,
    digest,
    folder,
    listed,
    read_record,
    record_key,
)
from torchsoft.datasets.subject import SPLITS
from torchsoft.display import Shown, suggestion
from torchsoft.physics.arguments import whole

DTYPES = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
"""Types in which windows can be read."""

HELD = 0.25
"""Largest fraction of the machine's memory that windows take by default."""

ALL = slice(None)


class Vouched(WrapperStore[Store]):
    """A read-only store of the files laid out at the start and of those of the `finished` shards.
    Each is checked against its digest when it is first touched; files without a digest are hidden.

    Raises `StoreError` for a file that is missing or not what was written (zarr alone would give
    its fill value), and for a dataset that is not finished unless that is allowed.
    """

    def __init__(self, url: str, *, unfinished: bool = False) -> None:
        manifest = Manifest.read(url)
        self.url, self.layout, self.digests = url, manifest.layout, dict(manifest.digests)
        self.finished = self.layout.finished(url)
        if (lacking := set(range(self.layout.shards)) - self.finished) and not unfinished:
            raise StoreError(
                f"{url}: {len(lacking)} of {self.layout.shards} shards are not finished "
                f"({listed(lacking)}); start `torchsoft dataset make` again to make them, or give "
                "`unfinished=True` to leave their trajectories out"
            )
        here = folder(url)
        super().__init__(
            LocalStore(here, read_only=True) if here else FsspecStore.from_url(url, read_only=True)
        )
        self.unread, self.checked = set(self.finished), set[str]()

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        shard = self.layout.shard(key)
        if shard in self.unread:
            data = await self._store.get(record_key(shard), prototype)
            self.digests |= read_record(
                self.url, self.layout, shard, None if data is None else data.to_bytes()
            )
            self.unread.discard(shard)
        if key not in self.digests:
            return None
        first = key not in self.checked
        found = await self._store.get(key, prototype, None if first else byte_range)
        sound = found is not None and not (first and digest(found.to_bytes()) != self.digests[key])
        found = self.layout.vouch(self.url, key, found, sound)
        self.checked.add(key)
        return (
            await self.get(key, prototype, byte_range)
            if first and byte_range is not None
            else found
        )

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    _get_many = Store._get_many  # which asks `get`

    def data(self, **options: Any) -> xr.Dataset:
        """The arrays, lazily."""
        return xr.open_zarr(self, consolidated=True, zarr_format=3, **options)


def open_dataset(url: str, *, unfinished: bool = False) -> xr.Dataset:
    """The whole store, lazily, with named dimensions and units; without the trajectories of
    unfinished shards where `unfinished` allows them.

    Raises `StoreError` for a dataset that is damaged or unfinished; the same when a damaged file is
    first touched.
    """
    store = Vouched(url, unfinished=unfinished)
    data = store.data()
    if len(store.finished) < store.layout.shards:
        shard = np.arange(data.sizes["trajectory"]) // store.layout.trajectories_per_shard
        data = data.isel(trajectory=np.isin(shard, list(store.finished)))
    return data


class Trajectories(Shown, Dataset[dict[str, Tensor]]):
    """Windows of the trajectories of one split, from memory where they fit.

    Item i holds every variable of `variables` in SI units, a series as (window, ...) and a number
    of the trajectory as (), in one of `DTYPES`, with `trajectory` and `start`, its origin.
    `window` is a number of samples, the whole run by default; windows of a trajectory begin every
    `stride` samples, `window` by default. Failed simulations are left out, and trajectories of
    unfinished shards too where `unfinished` says so.

    Variables that take less than `memory` [GiB], a quarter of the machine's by default, are read
    at once, and forked processes share them; others are read item by item, which is slow in any
    order, or in one sweep by `streamed`. The object is small when it is pickled, and opens the
    store in each process for itself, forked ones included. Each of these reads a file whole when
    it first touches it, to hold it against its digest.

    Raises `ValueError` for an unknown variable or split, another dtype, or a window or stride that
    does not fit, and `StoreError` for a dataset that is damaged or unfinished; the same when a
    damaged file is first touched, and `ValueError` for a number that is too large for the dtype.
    """

    def __init__(
        self, url: str, variables: Sequence[str], *, split: str | None = None,
        window: int | None = None, stride: int | None = None, dtype: torch.dtype = torch.float64,
        unfinished: bool = False, memory: float | None = None,
    ) -> None:  # fmt: skip
        self.url, self.variables = str(url), tuple(variables)
        self.dtype, self.unfinished = dtype, unfinished
        self._opened = dict[int, xr.Dataset]()
        if dtype not in DTYPES:
            raise ValueError(
                f"`dtype` must be one of {', '.join(map(str, DTYPES))}, but is {dtype!r}"
            )
        if split is not None and split not in SPLITS:
            raise ValueError(
                f"`split` must be one of {', '.join(map(repr, SPLITS))}, but is {split!r}"
            )
        arrays, samples = self.data.variables, self.data.sizes["time"]
        per_trajectory = {str(k): v for k, v in arrays.items() if v.dims[:1] == ("trajectory",)}
        known = sorted(name for name, v in per_trajectory.items() if v.dtype.kind in "fiu")
        for name in self.variables:
            if name not in known:
                raise ValueError(
                    f"`variables` has no numbers named {name!r}; "
                    f"{suggestion(name, known, 'known:')}"
                )
        self.window = samples if window is None else whole("window", window, 1)
        if self.window > samples:
            raise ValueError(f"`window` must be 1 to {samples} samples, but is {window}")
        step = self.window if stride is None else whole("stride", stride, 1)
        self.starts = range(0, samples - self.window + 1, step)
        usable = arrays["failed"].values == 0  # so that those of unfinished shards are not
        if split is not None:
            usable &= arrays["split"].values == split
        self.trajectories = np.flatnonzero(usable)
        if memory is not None and not memory >= 0:
            raise ValueError(f"`memory` must be a number of GiB, 0 or more, but is {memory!r}")
        most = HELD * machine_memory() if memory is None else memory
        self.fits = self.size <= most * 2**30
        if self.fits:
            self._all  # noqa: B018 -- read before processes are forked

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        units = {name: self.data.variables[name].attrs.get("units", "") for name in self.variables}
        title = (
            f"Trajectories: {len(self)} windows of {self.window} samples, of "
            f"{len(self.trajectories)} trajectories in {self.url}"
        )
        return title, [
            (name, f"{units[name] or '1'}, {'over time' if self._timed[name] else 'a number'}")
            for name in self.variables
        ]

    @property
    def size(self) -> int:
        """Memory [B] of the variables of all its trajectories."""
        one = sum(int(np.prod(self.data.variables[name].shape[1:])) for name in self.variables)
        return one * len(self.trajectories) * self.dtype.itemsize

    @property
    def data(self) -> xr.Dataset:
        """The store, opened on first use, and again after a fork, which connections do not
        survive."""
        if os.getpid() not in self._opened:
            self._opened = {
                os.getpid(): Vouched(self.url, unfinished=self.unfinished).data(chunks=None)
            }
        return self._opened[os.getpid()]

    def __getstate__(self) -> dict[str, Any]:
        """Without what was read: a copy reads it again."""
        return {k: x for k, x in vars(self).items() if k != "_all"} | {"_opened": {}}

    @cached_property
    def _all(self) -> dict[str, Tensor]:
        """The variables of all trajectories."""
        return self._read(self.trajectories)

    def __len__(self) -> int:
        return len(self.trajectories) * len(self.starts)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} is out of range for {len(self)} windows")
        which, window = divmod(index % len(self), len(self.starts))
        start = self.starts[window]
        if self.fits:
            return self._item(self._all, which, which, start, start)
        stretch = slice(start, start + self.window)
        return self._item(self._read(self.trajectories[[which]], stretch), 0, which, start, 0)

    def streamed(self, *, shards: int = 4, seed: int = 0) -> "Streamed":
        """All windows once a sweep, each file read once, for sets that do not fit in memory: so
        many `shards` are read at a time, in random order, and their windows shuffled."""
        return Streamed(self, whole("shards", shards, 1), whole("seed", seed, 0))

    def _item(
        self, held: dict[str, Tensor], row: int, which: int, start: int, first: int
    ) -> dict[str, Tensor]:
        """The window of trajectory number `which` that begins at sample `start`: what is `held` in
        row `row`, from its sample `first` on."""
        trajectory = int(self.trajectories[which])
        item = {"trajectory": torch.tensor(trajectory), "start": torch.tensor(start)}
        for name, values in held.items():
            part = values[row]
            item[name] = (part[first : first + self.window] if self._timed[name] else part).clone()
        return item

    @cached_property
    def _timed(self) -> dict[str, bool]:
        return {name: "time" in self.data.variables[name].dims for name in self.variables}

    def _read(self, trajectories: np.ndarray[Any, Any], at: slice = ALL) -> dict[str, Tensor]:
        """Variables of some trajectories in a stretch of time, shard by shard. Raises `ValueError`
        for a number that the dtype cannot hold."""
        size, out = self._shard_size, dict[str, Tensor]()
        for name in self.variables:
            variable, parts = self.data.variables[name], list[Tensor]()
            for shard in np.unique(trajectories // size):
                here = trajectories[trajectories // size == shard]
                where = {"trajectory": slice(int(here[0]), int(here[-1]) + 1), "time": at}
                rows = np.asarray(variable.isel(where, missing_dims="ignore").values)
                given = torch.from_numpy(np.array(rows[here - here[0]], dtype=float))
                parts.append(given.to(self.dtype))
                overflow = parts[-1].isinf() & given.isfinite()
                if bool(overflow.any()):
                    raise ValueError(
                        f"`{name}` of trajectory {int(here[overflow.nonzero()[0, 0]])} holds "
                        f"{float(given[overflow][0]):.3g}, which {self.dtype} cannot; take a wider "
                        "`dtype`"
                    )
            out[name] = torch.cat(parts) if parts else torch.empty(0, dtype=self.dtype)
        return out

    @cached_property
    def _shard_size(self) -> int:
        return Manifest.read(self.url).layout.trajectories_per_shard


class Streamed(IterableDataset[dict[str, Tensor]]):
    """The windows of `Trajectories` in one sweep, shuffled within groups of shards; workers of a
    `DataLoader` share the shards. The order is new in every sweep; it follows from `seed`, and with
    workers from torch's seed too."""

    def __init__(self, windows: Trajectories, shards: int, seed: int) -> None:
        self.windows, self.shards, self.seed, self.sweep = windows, shards, seed, 0

    def __len__(self) -> int:
        return len(self.windows)

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        windows, info = self.windows, get_worker_info()
        worker, of = (0, 1) if info is None else (info.id, info.num_workers)
        sweep = self.sweep if info is None else info.seed - info.id  # torch's, anew every sweep
        shuffle = np.random.default_rng((self.seed, sweep))
        self.sweep += 1
        shard = windows.trajectories // windows._shard_size
        order = shuffle.permutation(np.unique(shard))[worker::of]
        for i in range(0, len(order), self.shards):
            here = np.flatnonzero(np.isin(shard, order[i : i + self.shards]))
            held, count = windows._read(windows.trajectories[here]), len(windows.starts)
            for k in shuffle.permutation(len(here) * count).tolist():
                row, window = divmod(k, count)
                start = windows.starts[window]
                yield windows._item(held, row, int(here[row]), start, start)
