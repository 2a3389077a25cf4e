"""Tables of an identification in TOML: knowns, unknowns, sensors, recordings and the fit."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from torchsoft.plan.knots import Bounds
from torchsoft.sysid.design_criterion import RTOL, Optimality
from torchsoft.sysid.identification import Settings
from torchsoft.sysid.initial_state import LEAD, SETTLE
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
    """A recording that starts at rest, some time after its bodies were put where the rig file has
    them start."""

    kind: Literal["rest"] = "rest"
    lead: float = Field(default=SETTLE, ge=0, le=10)
    """time between putting the bodies in place and the first sample [s]"""
    position_sd: dict[Name, Annotated[float, AfterValidator(resolvable), Field(ge=0, le=0.1)]] = (
        Field(default_factory=dict)
    )
    """standard deviation of the place of a coordinate, such as "disc.x", by its name [m or rad]"""


class Given(Table):
    """Prior knowledge of a coordinate or rate."""

    mean: float = Field(ge=-1e6, le=1e6)
    """mean [m, rad, m/s or rad/s]"""
    sd: float = Field(ge=0, le=1e6)
    """standard deviation; 0 for a known value [as the mean]"""

    @model_validator(mode="after")
    def _is_a_distribution(self) -> "Given":
        resolvable(self.sd, self.mean)
        return self


class Moving(Table):
    """A recording that starts in motion or in mid-grasp. Its first samples determine the initial
    state, together with what is `given`."""

    kind: Literal["moving"] = "moving"
    lead: float = Field(default=LEAD, gt=0, le=10)
    """duration of the first samples, from which the initial state is estimated [s]"""
    given: dict[Name, Given] = Field(default_factory=dict)
    """prior knowledge of coordinates and rates, such as "disc.x" and "disc.v_x", by name"""


StartTable = Annotated[Rest | Moving, Field(discriminator="kind")]


class Column(Table):
    """A column of the data, by its heading."""

    of: Name | None = None
    """channel, motion or `t` that the column holds; the heading itself if not given"""
    unwrap: bool = False
    """true: remove jumps of an angle by a full turn"""

    @model_validator(mode="before")
    @classmethod
    def _a_name_alone(cls, data: Any) -> Any:
        return {"of": data} if isinstance(data, str) else data


class Entry(Table):
    """One more recording. Without a file it states the details of a recording of that `name` that
    is given on the command line."""

    name: Name | None = None
    """name of the recording; that of its file, without suffix, if not given"""
    file: File | None = None
    """data file, relative to the configuration's folder"""
    files: Annotated[tuple[File, ...], LISTED] = ()
    """several data files of one recording, each with its own times"""
    settings: dict[str, Any] = Field(default_factory=dict)
    """fields of the rig file that differ in this recording, by dotted name; no unknowns"""
    start: StartTable | None = None
    """start of this recording, in place of `[start]`"""

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
    """A competing law, such as another friction or material."""

    settings: dict[str, Any] = Field(default_factory=dict)
    """fields of the rig file that differ under this law, by dotted name"""
    unknowns: dict[str, Unknown] = Field(default_factory=dict)
    """additional unknowns, or other bounds for existing ones, by parameter"""
    without: Annotated[tuple[str, ...], LISTED] = ()
    """unknowns that this law does not have"""


class Rehearsal(Table):
    """Settings of a rehearsal: an identification from simulated recordings."""

    rate: float = Field(default=200.0, ge=1.0, le=1e5)
    """samples per second [Hz]"""
    duration: float | None = Field(default=None, ge=1e-2, le=1e4)
    """duration of each recording; that of the rig file if not given [s]"""
    seed: int = Field(default=0, ge=0)
    """seed of the simulated noise"""
    away: float = Field(default=1.3, ge=1.0, le=3.0)
    """ratio of the search's initial values to the true ones [1]"""


class DesignTable(Table):
    """Settings of a design of motions for an identification."""

    candidates: dict[Name, dict[str, Any] | Name] = Field(default_factory=dict)
    """settings of the rig file, or the name of an excitation, by the name of the candidate"""
    bounds: dict[Name, Bounds] = Field(default_factory=dict)
    """signals of the reference whose profile knots the search may move, with their bounds"""
    limits: dict[Name, Annotated[tuple[float, float], LISTED]] = Field(default_factory=dict)
    """lowest and highest permitted value of a channel, by its name [its unit]"""
    criterion: Optimality = "D"
    """what to minimise: "D", the volume of the ellipsoid of errors, or "A", the
    root mean square standard deviation"""
    parameters: Annotated[tuple[Name, ...], LISTED] = ()
    """unknowns that count; all of them if not given"""
    iterations: int = Field(default=40, ge=0, le=100_000)
    """iterations of the search that moves knots"""
    rtol: float = Field(default=RTOL, ge=1e-8, le=1e-2)
    """relative tolerance of the simulations [1]"""
    seed: int = Field(default=0, ge=0, le=SEED)
    """seed of the search"""


class Config(Table):
    """An identification as a TOML file states it."""

    rig: File
    """rig file, relative to the configuration's folder, or the name of a ready rig"""
    unknowns: dict[str, Unknown]
    """parameters to identify, by their dotted names in the rig file"""
    sensors: dict[str, Sensor]
    """sensors, by the channel that they measure"""
    columns: dict[Name, Column] = Field(default_factory=dict)
    """columns whose heading differs from the name of their channel or motion, by heading; `camera =
    "theta"` is short for `camera = {of = "theta"}`"""
    settings: dict[str, Any] = Field(default_factory=dict)
    """fields of the rig file that differ in all recordings, by dotted name"""
    start: StartTable = Rest()
    """state at the first sample of every recording that has no `start` of its own"""
    fit: Settings = Field(default_factory=lambda: Settings.model_validate({}))
    """numerical settings of the fit"""
    recordings: Annotated[tuple[Entry, ...], LISTED] = ()
    """additional recordings, or details of the recordings on the command line"""
    compare: dict[Name, Law] = Field(default_factory=dict)
    """competing laws, fitted to the same data, by name"""
    rehearsal: Rehearsal = Rehearsal()
    """settings of `torchsoft rehearse`"""
    design: DesignTable = DesignTable()
    """settings of `torchsoft design`"""
    heldout: Annotated[tuple[str, ...], LISTED] = ()
    """names of recordings that are predicted and not fitted"""
    ignore: Annotated[tuple[str, ...], LISTED] = ()
    """columns to leave out"""
    acknowledged: Annotated[tuple[str, ...], LISTED] = ()
    """findings of the checks before the fit to accept, in the words of their message"""

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
                    f'and set by unknowns."{strange[0]}".nominal where the search starts'
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
