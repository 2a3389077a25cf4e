"""A zarr store whose files are vouched for by their digests: what no digest vouches for is not there."""

from collections.abc import AsyncGenerator, Collection, Iterable
from typing import Any

from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import FsspecStore, LocalStore, WrapperStore

from torchsoft.datasets.manifest import COPY, Manifest, again, digest, read_record, record_key
from torchsoft.datasets.storage import StoreError, folder, write_bytes


class Vouched(WrapperStore[Store]):
    """Reads the files laid out at the start and those of the `finished` shards, each checked against its digest when it is
    first touched; the files of other shards are not there. `digests` gains those of what is written.

    Raises `StoreError` for a file that is missing or not what was written: zarr alone would give its fill value.
    """

    def __init__(self, url: str, manifest: Manifest, finished: Collection[int] = (), *, read_only: bool = True) -> None:
        here = folder(url)
        super().__init__(
            LocalStore(here, read_only=read_only) if here else FsspecStore.from_url(url, read_only=read_only)
        )
        self.url, self.layout, self.finished = url, manifest.layout, frozenset(finished)
        self.digests = dict(manifest.digests)
        self.checked: set[str] = set()
        self.recorded: set[int] = set()

    async def digest(self, key: str) -> str | None:
        """What vouches for a file; the record of its shard is read when it is first asked for."""
        shard = self.layout.shard(key)
        if shard in self.finished and shard not in self.recorded:
            data = await self._store.get(record_key(shard), default_buffer_prototype())
            self.digests |= read_record(self.url, self.layout, shard, None if data is None else data.to_bytes())
            self.recorded.add(shard)
        return self.digests.get(key)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        expected = await self.digest(key)
        if expected is None:
            return None
        if key in self.checked and byte_range is not None:
            found = await self._store.get(key, prototype, byte_range)
        else:
            found = await self._store.get(key, prototype)
            if found is not None and digest(found.to_bytes()) != expected:
                raise StoreError(f"{self.url}/{key} is damaged: its bytes are not those written; {self.remedy(key)}")
            self.checked.add(key)
            if found is not None and byte_range is not None:
                found = await self._store.get(key, prototype, byte_range)
        if found is None:
            raise StoreError(f"{self.url}/{key} is missing; {self.remedy(key)}")
        return found

    def remedy(self, key: str) -> str:
        """What to do about a damaged file."""
        shard = self.layout.shard(key)
        return COPY if shard is None else again(self.url, shard)

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    async def _get_many(
        self, requests: Iterable[tuple[str, BufferPrototype, ByteRequest | None]]
    ) -> AsyncGenerator[tuple[str, Buffer | None], None]:
        for key, prototype, byte_range in requests:
            yield key, await self.get(key, prototype, byte_range)

    async def set(self, key: str, value: Buffer, byte_range: Any = None) -> None:
        self._check_writable()
        data = value.to_bytes()
        if isinstance(self._store, LocalStore):
            write_bytes(self.url, key, data)
        else:
            await self._store.set(key, value)
        self.digests[key] = digest(data)
