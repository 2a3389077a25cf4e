"""Configuration of a dataset: the TOML file, validated."""

from functools import lru_cache
from pathlib import Path
from typing import Self

from pydantic import model_validator

from torchsoft.datasets.fields import Fields
from torchsoft.datasets.rig_files import embedded
from torchsoft.datasets.subject import Subject
from torchsoft.tables import from_toml


class Config(Fields):
    """One dataset, of the rig of a file. `ValueError` names the field that is wrong.

    Everything but `title`, `description` and `license` decides the data; `trajectories_per_shard`
    and `samples_per_chunk` decide only where they lie. Parameters are known by the names of the
    rig file's tables.
    """

    @model_validator(mode="after")
    def _fits_the_rig(self) -> Self:
        Subject(self).check()
        return self

    @property
    def subject(self) -> Subject:
        """The subject of this configuration; a process keeps those of the last few."""
        return subject_of(self.model_dump_json())

    @classmethod
    def from_toml(cls, path: str | Path) -> "Config":
        """Read a TOML file, and the rig file that it names. Raises `ValueError` naming the file and
        the field, `OSError` for one that cannot be read."""
        return from_toml(path, lambda tree: cls.model_validate(embedded(tree, Path(path).parent)))


@lru_cache(maxsize=4)
def subject_of(config: str) -> Subject:
    """The subject of a valid configuration, written in JSON."""
    return Subject(Fields.model_validate_json(config))
