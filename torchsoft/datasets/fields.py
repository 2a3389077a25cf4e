"""Fields of the configuration of a dataset."""

import hashlib
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from torchsoft.datasets.distributions import Distribution, Kind
from torchsoft.datasets.rig_files import outputs_of
from torchsoft.tables import LISTED, SEED, Table

STEP = 0.02
"""Largest step [s] of the stepper: twice the pads' own time, and the energy balance is off by
percents."""


class Fractions(Table):
    """Fractions of the trajectories; the rest is for testing."""

    train: float = Field(0.7, gt=0, lt=1)
    """fraction of the trajectories for training [1]"""
    validation: float = Field(0.15, ge=0, lt=1)
    """fraction for validation [1]"""

    @model_validator(mode="after")
    def _leave_some_for_testing(self) -> Self:
        if self.train + self.validation >= 1:
            raise ValueError(
                f"train + validation must stay below 1, but is {self.train + self.validation}"
            )
        return self


class Fields(Table):
    """Fields of a configuration, each possible by itself; `Config` is one that is possible as a
    whole."""

    title: str
    """title of the card and of pictures"""
    description: str = ""
    """paragraph of the card"""
    license: str = ""
    """license of the data, by its name in SPDX, such as CC-BY-4.0"""
    seed: int = Field(ge=0, le=SEED)
    """seed of the design, the splits and random phases"""
    trajectories: int = Field(ge=1, le=10_000_000)
    """number of trajectories"""
    trajectories_per_shard: int = Field(16, ge=1, le=100_000)
    """trajectories that a worker simulates at once and keeps in memory, and that a file holds"""
    samples_per_chunk: int = Field(250, ge=1, le=10_000_000)
    """samples of one trajectory that are read and decompressed at once"""
    duration: float = Field(ge=1e-3, le=1e4)
    """duration of every trajectory; that of the rig file if not given [s]"""
    sample_interval: float = Field(5e-3, ge=1e-6, le=1.0)
    """time between samples; that of the rig file if not given [s]"""
    rtol: float | None = Field(None, ge=1e-9, le=1e-2)
    """relative tolerance of the steps; that of the rig file or else 1e-4 if not given [1]"""
    step: float | None = Field(None, ge=1e-6, le=STEP)
    """length of equal steps at most, in place of `rtol` [s]"""
    node_precision: Literal["float32", "float64"] = "float32"
    """type of arrays per contact point; all others are float64"""
    ledger_tolerance: float = Field(0.02, ge=1e-12, le=1.0)
    """largest energy residual, over the energy injected, that the check accepts [1]"""
    splits: Fractions = Fractions(train=0.7, validation=0.15)
    """fractions of the trajectories; the rest is for testing"""
    fixed: dict[str, Any] = Field(default_factory=dict)
    """fields of the rig file that differ in all trajectories, by dotted name"""
    parameters: dict[str, Distribution] = Field(default_factory=dict)
    """distributions of the parameters that differ between trajectories, by dotted name"""
    kinds: Annotated[tuple[Kind, ...], LISTED] = Field((), max_length=100)
    """kinds of trajectories, such as one for each motion"""
    rig: dict[str, Any]
    """rig file, relative to the configuration's folder, or the name of a ready rig; its tables in
    Python"""
    files: dict[str, str] = Field(default_factory=dict)
    """contents of the files that the rig file names, in base 64"""
    channels: Annotated[tuple[str, ...], LISTED] | None = None
    """channels to keep; all of them if not given"""
    nodal: bool = True
    """true: keep forces and displacements of every contact point"""

    @model_validator(mode="before")
    @classmethod
    def _times_are_those_of_the_rig(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or not isinstance(data.get("rig"), Mapping):
            return data
        return outputs_of(data["rig"]) | dict(data)

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if abs(self.duration / self.sample_interval - (self.samples - 1)) > 1e-6:
            raise ValueError(
                f"duration = {self.duration} s is not a whole number of sample_interval = "
                f"{self.sample_interval} s"
            )
        if self.step is not None and self.rtol is not None:
            raise ValueError(
                f"rtol = {self.rtol:g} and step = {self.step:g} s each say which steps to take; "
                "give one of them"
            )
        if self.step is not None and self.step > self.sample_interval:
            raise ValueError(
                f"step = {self.step} s exceeds sample_interval = {self.sample_interval} s"
            )
        return self

    @model_serializer(mode="wrap")
    def _own_fields(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        unsaid = [name for name in ("license", "kinds") if not getattr(self, name)]
        return {name: x for name, x in handler(self).items() if name not in unsaid}

    @property
    def samples(self) -> int:
        """Times on the output grid, both ends included."""
        return round(self.duration / self.sample_interval) + 1

    @property
    def shards(self) -> int:
        return -(-self.trajectories // self.trajectories_per_shard)

    def rows(self, shard: int) -> range:
        """The trajectories of a shard."""
        size = self.trajectories_per_shard
        return range(shard * size, min((shard + 1) * size, self.trajectories))

    @property
    def hash(self) -> str:
        """Sixteen hexadecimal digits of the SHA-256 of the configuration."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]
