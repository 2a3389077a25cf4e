"""What a TOML file states of an identification: what is known, what is unknown, and how good the
sensors are."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from torchsoft.paper.rig import NAMES
from torchsoft.physics.material import INSTANT
from torchsoft.plan.knots import Bounds
from torchsoft.sysid.criterion import Optimality
from torchsoft.sysid.design import RTOL
from torchsoft.sysid.identification import Settings
from torchsoft.sysid.initial_state import LEAD, SETTLE
from torchsoft.sysid.unknowns import Sensor, Unknown
from torchsoft.tables import LISTED, SEED, Table, from_toml

VOCABULARY = {own: name for name, own in NAMES.items()}
"""The rig's own names of parameters, by which they are understood too, with those of
`Parameters`."""

Name = Annotated[str, Field(min_length=1, max_length=100)]
File = Annotated[str, Field(min_length=1, max_length=1000)]


SURE = 1e-12
"""Standard deviations [SI], over the value where that is larger than one, below which a number is
known: say 0."""


def told_apart(sd: float, value: float = 1.0) -> float:
    """A standard deviation that is zero or can be computed with. Raises `ValueError` for
    another."""
    if 0 < sd < (least := SURE * max(abs(value), 1.0)):
        raise ValueError(f"should be 0, or at least {least:g}, but is {sd}")
    return sd


class Rest(Table):
    """A recording that begins at rest, `lead` [s] after its bodies were put where they stand. In
    the paper's rig the disc stands on the lower pad at `scenario.x_C0`, known to `position_sd` [m],
    and the bracket clear of it; in another one they stand where the rig file has them start."""

    kind: Literal["rest"] = "rest"
    lead: float = Field(default=SETTLE, ge=0, le=10)
    position_sd: Annotated[float, AfterValidator(told_apart)] = Field(default=0.0, ge=0, le=0.1)


class Known(Table):
    """What is known of a coordinate: mean and standard deviation [m, rad, m/s or rad/s]."""

    mean: float = Field(ge=-1e6, le=1e6)
    sd: float = Field(ge=0, le=1e6)

    @model_validator(mode="after")
    def _is_a_distribution(self) -> "Known":
        told_apart(self.sd, self.mean)
        return self


class Moving(Table):
    """A recording that begins anywhere, in motion or in mid-grasp: its samples of the first `lead`
    [s] tell where, with what is `given` of coordinates such as "disc.x" and "disc.v_x"."""

    kind: Literal["moving"] = "moving"
    lead: float = Field(default=LEAD, gt=0, le=10)
    given: dict[Name, Known] = Field(default_factory=dict)


Beginning = Annotated[Rest | Moving, Field(discriminator="kind")]


class Missing(Table):
    """Constants [m, N] in the place of columns that a recording does not have."""

    x_d: float | None = Field(default=None, ge=-100, le=100)
    y_d: float | None = Field(default=None, ge=-100, le=100)
    F_ff: float | None = Field(default=None, ge=-1e9, le=1e9)

    def over(self, other: "Missing") -> dict[str, float]:
        """Those of this table, and of the other where this has none."""
        return other.model_dump(exclude_none=True) | self.model_dump(exclude_none=True)


class KelvinVoigtPads(Table):
    """Pads of one retardation time, `pad.tau`."""

    kind: Literal["kelvin_voigt"] = "kelvin_voigt"


class StandardLinearPads(Table):
    """Pads that are stiffer at first: `E_instant` [Pa] above `pad.E`, which is the relaxed
    modulus."""

    kind: Literal["standard_linear_solid"] = "standard_linear_solid"
    E_instant: float = Field(ge=1.0, le=1e13)
    tau_instant: float = Field(default=INSTANT, ge=1e-9, le=1e6)


Times = Annotated[tuple[Annotated[float, Field(ge=1e-9, le=1e6)], ...], LISTED]


class GeneralisedKelvinPads(Table):
    """Pads that creep in several times `tau` [s], each by a fraction `J` of the relaxed compliance
    1 / `pad.E`."""

    kind: Literal["generalised_kelvin"] = "generalised_kelvin"
    J: Annotated[tuple[Annotated[float, Field(gt=0, le=1)], ...], LISTED]
    tau: Times
    tau_instant: float = Field(default=INSTANT, ge=1e-9, le=1e6)


class PronyPads(Table):
    """Pads with a relaxation series: `moduli` [Pa] on top of `pad.E`, the relaxed one, that fade in
    the times `tau` [s]."""

    kind: Literal["prony"] = "prony"
    moduli: Annotated[tuple[Annotated[float, Field(ge=1e-6, le=1e13)], ...], LISTED]
    tau: Times
    tau_instant: float = Field(default=INSTANT, ge=1e-9, le=1e6)


Pads = Annotated[
    KelvinVoigtPads | StandardLinearPads | GeneralisedKelvinPads | PronyPads,
    Field(discriminator="kind"),
]


class Entry(Table):
    """One more recording, called `name` or like its file: its columns stand in `file`, or in
    several `files` next to the configuration, each with times of its own. Without a file it has
    what is particular about the recording of that name."""

    name: Name | None = None
    file: File | None = None
    files: Annotated[tuple[File, ...], LISTED] = ()
    settings: dict[str, Any] = Field(default_factory=dict)
    start: Beginning | None = None
    missing: Missing = Missing()

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
    """A competing law: `settings` that differ, such as `contact.friction`, another material of the
    `pads`, `unknowns` that it has besides or with other bounds, and those that it is `without`."""

    settings: dict[str, Any] = Field(default_factory=dict)
    pads: Pads | None = None
    unknowns: dict[str, Unknown] = Field(default_factory=dict)
    without: Annotated[tuple[str, ...], LISTED] = ()


class Rehearsal(Table):
    """Of a rehearsal: samples a second, the recordings' `duration` [s] (that of the rig file if not
    given), the `seed` of the noise, and the factor by which the search begins `away` from the
    truth."""

    rate: float = Field(default=200.0, ge=1.0, le=1e5)
    duration: float | None = Field(default=None, ge=1e-2, le=1e4)
    seed: int = Field(default=0, ge=0)
    away: float = Field(default=1.3, ge=1.0, le=3.0)


class DesignTable(Table):
    """Of a design of motions: settings of the rig file by the name of a candidate, `bounds` of
    signals whose knots may move, `limits` (low, high) [SI] of channels, the `criterion` of the
    unknowns, or of the `parameters` alone."""

    candidates: dict[Name, dict[str, Any]] = Field(default_factory=dict)
    bounds: dict[Name, Bounds] = Field(default_factory=dict)
    limits: dict[Name, Annotated[tuple[float, float], LISTED]] = Field(default_factory=dict)
    criterion: Optimality = "D"
    parameters: Annotated[tuple[Name, ...], LISTED] = ()
    iterations: int = Field(default=40, ge=0, le=100_000)
    rtol: float = Field(default=RTOL, ge=1e-8, le=1e-2)
    seed: int = Field(default=0, ge=0, le=SEED)


class Config(Table):
    """An identification as a TOML file states it.

    `settings` are known numbers, by the groups and names of `Parameters`; `unknowns` and `sensors`
    are tables by the dotted names of parameters and by channels. With a `rig` file the names are
    those of its tables, and `settings` replaces fields of it. `columns` has channels and signals by
    headings of another name, `heldout` names recordings that are predicted and not fitted, `ignore`
    columns that are left out, and `acknowledged` findings that are no mistakes. `missing` and
    `start` hold for all recordings that say nothing else.
    `compare` has competing laws by name.
    """

    unknowns: dict[str, Unknown]
    sensors: dict[str, Sensor]
    rig: File | None = None
    columns: dict[Name, Name] = Field(default_factory=dict)
    settings: dict[str, Any] = Field(default_factory=dict)
    pads: Pads = KelvinVoigtPads()
    start: Beginning = Rest()
    missing: Missing = Missing()
    fit: Settings = Field(default_factory=lambda: Settings.model_validate({}))
    recordings: Annotated[tuple[Entry, ...], LISTED] = ()
    compare: dict[Name, Law] = Field(default_factory=dict)
    rehearsal: Rehearsal = Rehearsal()
    design: DesignTable = DesignTable()
    heldout: Annotated[tuple[str, ...], LISTED] = ()
    ignore: Annotated[tuple[str, ...], LISTED] = ()
    acknowledged: Annotated[tuple[str, ...], LISTED] = ()

    def understood(self, name: str) -> str:
        """A parameter's name among `Parameters`, where the paper's rig has it by its own."""
        return VOCABULARY.get(name, name) if self.rig is None else name

    @model_validator(mode="after")
    def _the_rig_says_what_it_is_made_of(self) -> "Config":
        if self.rig is None:
            return self
        for field in ("pads", "missing"):
            if field in self.model_fields_set:
                raise ValueError(f"{field} are of the paper's rig; say it in the rig file")
        for name, law in self.compare.items():
            if law.pads is not None:
                raise ValueError(
                    f"compare.{name}.pads are of the paper's rig; say it by compare.{name}.settings"
                )
        return self

    @model_validator(mode="after")
    def _laws_have_likelihoods(self) -> "Config":
        if self.compare and self.fit.loss != "linear":
            raise ValueError(
                f"compare needs likelihoods: fit.loss must be 'linear', not '{self.fit.loss}'"
            )
        known = {self.understood(name) for name in self.unknowns}
        for law, one in self.compare.items():
            if strange := [name for name in one.without if self.understood(name) not in known]:
                raise ValueError(f"compare.{law}.without: `{strange[0]}` is not an unknown")
        return self

    @model_validator(mode="after")
    def _recordings_state_what_is_known(self) -> "Config":
        unknown = {self.understood(name): name for name in self.unknowns}
        for i, entry in enumerate(self.recordings):
            stated = [self.understood(name) for name, _ in flattened(entry.settings)]
            if strange := [name for name in stated if name in unknown]:
                raise ValueError(
                    f"recordings.{i}.settings: {strange[0]} is unknown, so that no recording can "
                    "state it: leave it out there, "
                    f'and say by unknowns."{unknown[strange[0]]}".nominal where the search starts'
                )
        return self


def read_config(path: str | Path) -> Config:
    """Raises `ValueError` naming the file and the field, `OSError` for a file that cannot be
    read."""
    return from_toml(path, Config.model_validate)


def in_one_vocabulary(
    unknowns: Mapping[str, Unknown], understood: Callable[[str], str]
) -> dict[str, Unknown]:
    """Unknowns by the names that are `understood`. Raises `ValueError` for one that is there by
    two."""
    out: dict[str, Unknown] = {}
    for name, one in unknowns.items():
        if understood(name) in out:
            raise ValueError(f"unknowns.{name} is there twice: it is {understood(name)} too")
        ratio = one.ratio_to
        out[understood(name)] = (
            one.model_copy(update={"ratio_to": understood(ratio)}) if ratio is not None else one
        )
    return out


def flattened(settings: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    """Values by their dotted names."""
    for key, value in settings.items():
        if isinstance(value, dict) and value:
            yield from flattened(value, f"{within}{key}.")
        else:
            yield within + key, value


def groups(*settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by group and name, the later ones first."""
    tree: dict[str, Any] = {}
    for given in settings:
        for name, value in flattened(given):
            group, _, field = VOCABULARY.get(name, name).partition(".")
            if not field:
                tree[group] = value
            else:
                old = tree.get(group)
                tree[group] = (old if isinstance(old, dict) else {}) | {field: value}
    return tree
