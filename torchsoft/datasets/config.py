"""Configuration of a dataset: the TOML file, validated."""

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
        """The subject of this configuration, cached by its hash."""
        key = self.hash
        if key not in _subjects:
            while len(_subjects) >= SUBJECTS:
                _subjects.pop(next(iter(_subjects)), None)
            _subjects[key] = Subject(self)
        return _subjects[key]

    @classmethod
    def from_toml(cls, path: str | Path) -> "Config":
        """Read a TOML file, and the rig file that it names. Raises `ValueError` naming the file and
        the field, `OSError` for one that cannot be read."""
        return from_toml(path, lambda tree: cls.model_validate(embedded(tree, Path(path).parent)))


SUBJECTS = 4
"""Most subjects in the cache of a process."""

_subjects: dict[str, Subject] = {}
