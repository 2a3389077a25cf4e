"""How a dataset was made, and a digest of every file in it: of those laid out at the start in `manifest.json`, of a shard's in
a record of its own, which is written after them and says that the shard is finished.

A record has the form of `sha256sum`: `cd SET && sha256sum --check --quiet finished/*.sha256` checks all shards.
"""

import json
import re
from hashlib import sha256
from typing import Annotated, Any, Self

from annotated_types import Ge

from torchsoft.datasets.storage import StoreError, keys, read_bytes
from torchsoft.tables import LISTED, InvalidTable, Table

MANIFEST = "manifest.json"
FINISHED = "finished"
RECORD = re.compile(rf"{FINISHED}/(0|[1-9]\d*)\.sha256")
COPY = "restore it from a copy, or make the dataset anew in another folder"


class Layout(Table):
    """Number and size of the shards, and the keys of a shard's files, with its number for `{shard}`."""

    shards: Annotated[int, Ge(1)]
    trajectories_per_shard: Annotated[int, Ge(1)]
    files: Annotated[tuple[str, ...], LISTED]

    def of(self, shard: int) -> list[str]:
        """Keys of the files of a shard."""
        return [key.replace("{shard}", str(shard)) for key in self.files]

    def shard(self, key: str) -> int | None:
        """The shard whose file this is."""
        found = re.fullmatch(r"(.+/c/)(0|[1-9]\d*)((?:/0)*)", key)
        if found is None or f"{found[1]}{{shard}}{found[3]}" not in self.files or int(found[2]) >= self.shards:
            return None
        return int(found[2])


class Manifest(Table):
    """How the dataset was made. `digests` are those of the files that were laid out, `digest` is that of all else in here."""

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
        """The file, with its own digest."""
        content = self.model_dump(mode="json", exclude={"digest"})
        return json.dumps(content | {"digest": digest(json.dumps(content).encode())}, indent=2) + "\n"

    @classmethod
    def read(cls, url: str) -> Self:
        """The manifest of the dataset. Raises `StoreError` where there is none, or one that is not what was written."""
        data = read_bytes(url, MANIFEST)
        if data is None:
            raise StoreError(f"{url}/{MANIFEST} is missing; this is no dataset, or not any more: {COPY}")
        try:
            manifest = cls.model_validate_json(data)
        except InvalidTable as error:
            raise StoreError(f"{url}/{MANIFEST} is damaged or of another version ({error}); {COPY}") from error
        if manifest.text().encode(errors="replace") != data:
            raise StoreError(f"{url}/{MANIFEST} is damaged: its digest is not that of its content; {COPY}")
        return manifest


def digest(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return sha256(data).hexdigest()


def finished(url: str, layout: Layout) -> set[int]:
    """The shards that have a record."""
    found = (RECORD.fullmatch(key) for key in keys(url, FINISHED))
    return {int(match[1]) for match in found if match} & set(range(layout.shards))


def record_key(shard: int) -> str:
    return f"{FINISHED}/{shard}.sha256"


def record(digests: dict[str, str]) -> bytes:
    """The record of a shard whose files have these digests."""
    return "".join(f"{digests[key]}  {key}\n" for key in sorted(digests)).encode()


def read_record(url: str, layout: Layout, shard: int, data: bytes | None) -> dict[str, str]:
    """Digests of a shard's files by their keys, from its record. Raises `StoreError` for one that is not what was written."""
    lines = re.findall(rb"([0-9a-f]{64})  (.+)\n", data or b"")
    digests = {key.decode(errors="replace"): found.decode() for found, key in lines}
    if record(digests) != data or set(digests) != set(layout.of(shard)):
        what = "is missing" if data is None else "is damaged"
        raise StoreError(f"{url}/{record_key(shard)} {what}; {again(url, shard)}")
    return digests


def again(url: str, shard: int) -> str:
    """What to do about a damaged shard."""
    what = f"{url}/{record_key(shard)}"
    return f"remove {what} and start `python -m data_gen.generate` again, which makes this shard anew"
