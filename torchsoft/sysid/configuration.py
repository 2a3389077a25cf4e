"""Tables of an identification in TOML: knowns, unknowns, sensors, recordings and the fit."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from torchsoft.plan.knots import Bounds
from torchsoft.sysid.identification import Settings
from torchsoft.sysid.initial_state import LEAD, SETTLE
from torchsoft.sysid.planner import RTOL, Optimality
from torchsoft.sysid.unknowns import Sensor, Unknown
from torchsoft.tables import LISTED, SEED, Table, from_toml, line

Name = Annotated[str, Field(min_length=1, max_length=100)]
File = Annotated[str, Field(min_length=1, max_length=1000)]


SURE = 1e-12
"""Standard deviations [SI], over the value where that is larger than one, below which a number is
known: say 0."""


def resolvable(sd: float, value: float = 1.0) -> float:
    """A standard deviation that is zero or can be computed with. Raises `ValueError` for
    another."""
    if 0 < sd < (least := SURE * max(abs(value), 1.0)):
        raise ValueError(f"should be 0, or at least {least:g}, but is {sd}")
    return sd


class Rest(Table):
    """A recording that starts at rest, `lead` [s] after its bodies were put where the rig file has
    them start; `position_sd` has by coordinate how well that is known [m or rad]."""

    kind: Literal["rest"] = "rest"
    lead: float = Field(default=SETTLE, ge=0, le=10)
    position_sd: dict[Name, Annotated[float, AfterValidator(resolvable), Field(ge=0, le=0.1)]] = (
        Field(default_factory=dict)
    )


class Given(Table):
    """Prior knowledge of a coordinate: mean and standard deviation [m, rad, m/s or rad/s]."""

    mean: float = Field(ge=-1e6, le=1e6)
    sd: float = Field(ge=0, le=1e6)

    @model_validator(mode="after")
    def _is_a_distribution(self) -> "Given":
        resolvable(self.sd, self.mean)
        return self


class Moving(Table):
    """A recording that starts anywhere, in motion or in mid-grasp: its samples of the first `lead`
    [s] tell where, with what is `given` of coordinates such as "disc.x" and "disc.v_x"."""

    kind: Literal["moving"] = "moving"
    lead: float = Field(default=LEAD, gt=0, le=10)
    given: dict[Name, Given] = Field(default_factory=dict)


StartTable = Annotated[Rest | Moving, Field(discriminator="kind")]


class Column(Table):
    """A column of the data by its heading: the channel or motion that it is `of`, where it has
    another name, and whether its jumps by a turn are taken out (`unwrap`)."""

    of: Name | None = None
    unwrap: bool = False

    @model_validator(mode="before")
    @classmethod
    def _a_name_alone(cls, data: Any) -> Any:
        return {"of": data} if isinstance(data, str) else data


class Entry(Table):
    """One more recording, called `name` or like its file: its columns stand in `file`, or in
    several `files` next to the configuration, each with times of its own. Without a file it has
    what is particular about the recording of that name."""

    name: Name | None = None
    file: File | None = None
    files: Annotated[tuple[File, ...], LISTED] = ()
    settings: dict[str, Any] = Field(default_factory=dict)
    start: StartTable | None = None

    @model_validator(mode="after")
    def _is_named(self) -> "Entry":
        if self.file is not None and self.files:
            raise ValueError("a recording has a `file` or `files`, not both")
        if self.name is None and self.file is None:
            raise ValueError(
                "a recording needs a `file`, or the `name` of one that is given elsewhere"
            )
        return self

    @property
    def paths(self) -> tuple[str, ...]:
        return self.files or ((self.file,) if self.file is not None else ())


class Law(Table):
    """A competing law: `settings` that differ, such as the `friction` of a law or a material,
    `unknowns` that it has besides or with other bounds, and those that it is `without`."""

    settings: dict[str, Any] = Field(default_factory=dict)
    unknowns: dict[str, Unknown] = Field(default_factory=dict)
    without: Annotated[tuple[str, ...], LISTED] = ()


class Rehearsal(Table):
    """Settings of a rehearsal: samples a second, the recordings' `duration` [s] (by default that
    of the rig file), the `seed` of the noise, and the factor by which the search starts `away` from
    the truth."""

    rate: float = Field(default=200.0, ge=1.0, le=1e5)
    duration: float | None = Field(default=None, ge=1e-2, le=1e4)
    seed: int = Field(default=0, ge=0)
    away: float = Field(default=1.3, ge=1.0, le=3.0)


class DesignTable(Table):
    """Settings of a design of motions: those of the rig file by the name of a candidate, `bounds`
    of signals whose knots may move, `limits` (low, high) [SI] of channels, the `criterion` of the
    unknowns, or of the `parameters` alone."""

    candidates: dict[Name, dict[str, Any] | Name] = Field(default_factory=dict)
    bounds: dict[Name, Bounds] = Field(default_factory=dict)
    limits: dict[Name, Annotated[tuple[float, float], LISTED]] = Field(default_factory=dict)
    criterion: Optimality = "D"
    parameters: Annotated[tuple[Name, ...], LISTED] = ()
    iterations: int = Field(default=40, ge=0, le=100_000)
    rtol: float = Field(default=RTOL, ge=1e-8, le=1e-2)
    seed: int = Field(default=0, ge=0, le=SEED)


class Config(Table):
    """An identification as a TOML file states it.

    `rig` is the rig file, whose fields have the names of its tables: `settings` replaces known
    ones, `unknowns` are tables by the dotted names of parameters, `sensors` by channels. `columns`
    has channels and signals by headings of another name, and angles to `unwrap`; `heldout` names
    recordings that are predicted and not fitted, `ignore` columns that are left out, and
    `acknowledged` findings that are no mistakes. `start` holds for all recordings that say nothing
    else. `compare` has competing laws by name.
    """

    rig: File
    unknowns: dict[str, Unknown]
    sensors: dict[str, Sensor]
    columns: dict[Name, Column] = Field(default_factory=dict)
    settings: dict[str, Any] = Field(default_factory=dict)
    start: StartTable = Rest()
    fit: Settings = Field(default_factory=lambda: Settings.model_validate({}))
    recordings: Annotated[tuple[Entry, ...], LISTED] = ()
    compare: dict[Name, Law] = Field(default_factory=dict)
    rehearsal: Rehearsal = Rehearsal()
    design: DesignTable = DesignTable()
    heldout: Annotated[tuple[str, ...], LISTED] = ()
    ignore: Annotated[tuple[str, ...], LISTED] = ()
    acknowledged: Annotated[tuple[str, ...], LISTED] = ()

    @model_validator(mode="after")
    def _laws_have_likelihoods(self) -> "Config":
        if self.compare and self.fit.loss != "linear":
            raise ValueError(
                f"compare needs likelihoods: fit.loss must be 'linear', not '{self.fit.loss}'"
            )
        return self

    def check_unknowns(self, full: Callable[[str], object]) -> None:
        """Raises `ValueError` for a law without what is no unknown, and a recording that states
        one; `full` gives what a name stands for."""
        unknown = {full(name): name for name in self.unknowns}
        for law, one in self.compare.items():
            if strange := [name for name in one.without if full(name) not in unknown]:
                raise ValueError(
                    f"compare.{law}.without: `{line(strange[0], 80)}` is not an unknown"
                )
        for i, entry in enumerate(self.recordings):
            if strange := [
                unknown[x] for x in map(full, flattened(entry.settings)) if x in unknown
            ]:
                raise ValueError(
                    f"recordings.{i}.settings: {strange[0]} is unknown, so that no recording can "
                    "state it: leave it out there, "
                    f'and say by unknowns."{strange[0]}".nominal where the search starts'
                )


def read_config(path: str | Path) -> Config:
    """Raises `ValueError` naming the file and the field, `OSError` for a file that cannot be
    read."""
    return from_toml(path, Config.model_validate)


def flattened(settings: Mapping[str, Any], within: str = "") -> Iterator[str]:
    """Dotted names of values."""
    for key, value in settings.items():
        if isinstance(value, dict) and value:
            yield from flattened(value, f"{within}{key}.")
        else:
            yield within + key
