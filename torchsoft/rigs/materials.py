"""Materials of pads in a rig file. Another one is another class here, and one more name in `MaterialTable`."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, TypeAdapter, model_validator

from torchsoft.materials.presets import PRESETS
from torchsoft.physics.material import GeneralisedKelvin, KelvinVoigt, Material, Prony, StandardLinearSolid
from torchsoft.rigs.fields import Group, Length, Within, at_field
from torchsoft.tables import LISTED, line, read_toml, refusing

Modulus = Annotated[float, Within(1.0, 1e13, "Pa")]

Retardation = Annotated[float, Within(1e-9, 1e6, "s")]

TERMS = 20
"""Of a series at the most."""

Retardations = Annotated[tuple[Retardation, ...], LISTED, Field(min_length=1, max_length=TERMS)]

DEPTH = "how deep the pads are, out of the plane"

INSTANT = "retardation time of the instantaneous spring, small: below every tau"


class Elastic(Group):
    """What every material has."""

    E: Modulus = Field(description="Young's modulus, relaxed; rubber has 0.1e6 to 10e6")
    nu: Annotated[float, Within(-0.999, 0.4999)] = Field(default=0.45, description="Poisson's ratio")
    depth: Length = Field(description=DEPTH)
    rho: Annotated[float, Within(1e-3, 1e6, "kg/m3")] = Field(
        default=1100.0, description="density, of inertial pads only"
    )


class KelvinVoigtTable(Elastic):
    """A spring beside a dashpot."""

    kind: Literal["kelvin_voigt"] = "kelvin_voigt"
    tau: Retardation = Field(description="retardation time: the dashpot's viscosity over the modulus")

    def build(self, folder: Path) -> Material:
        """The material; `folder` is where a file that a table names lies. Raises `ValueError`."""
        return KelvinVoigt(self.E, self.nu, self.rho, self.tau, self.depth)


class StandardLinearSolidTable(Elastic):
    """A spring in series with a spring beside a dashpot: stiffer at first than when it has relaxed."""

    kind: Literal["standard_linear_solid"] = "standard_linear_solid"
    E_instant: Modulus = Field(description="Young's modulus at first, above E")
    tau: Retardation = Field(description="retardation time")
    tau_instant: Retardation = Field(default=1e-4, description=INSTANT)

    def build(self, folder: Path) -> Material:
        return StandardLinearSolid(
            self.E, self.E_instant, self.nu, self.rho, self.tau, self.depth, self.tau_instant
        )  # fmt: skip


class SeriesTable(Elastic):
    """What materials of several times have."""

    tau: Retardations = Field(description="times, one per term [s]")
    tau_instant: Retardation = Field(default=1e-4, description=INSTANT)

    def paired(self, name: str) -> Self:
        """Raises `ValueError` where there are not as many strengths, under this name, as times."""
        if len(getattr(self, name)) != len(self.tau):
            raise ValueError(
                f"{name} has {len(getattr(self, name))} numbers, but tau {len(self.tau)}; give one of each per term"
            )
        return self


class GeneralisedKelvinTable(SeriesTable):
    """A creep series, springs beside dashpots in a row: under a held stress the fractions J of 1 / E set in with the times tau,
    and what they leave of one at once."""

    kind: Literal["generalised_kelvin"] = "generalised_kelvin"
    J: Annotated[tuple[Annotated[float, Within(1e-9, 1.0)], ...], LISTED, Field(min_length=1, max_length=TERMS)] = (
        Field(description="fractions of the relaxed compliance, one per tau; their sum is at most 1")
    )

    @model_validator(mode="after")
    def _are_pairs(self) -> Self:
        return self.paired("J")

    def build(self, folder: Path) -> Material:
        return GeneralisedKelvin(self.E, self.nu, self.rho, self.depth, self.J, self.tau, self.tau_instant)


class PronyTable(SeriesTable):
    """A relaxation series: after a step of strain the modulus is E + sum of moduli exp(-t / tau)."""

    kind: Literal["prony"] = "prony"
    moduli: Annotated[tuple[Modulus, ...], LISTED, Field(min_length=1, max_length=TERMS)] = Field(
        description="what fades, one per tau [Pa]"
    )

    @model_validator(mode="after")
    def _are_pairs(self) -> Self:
        return self.paired("moduli")

    def build(self, folder: Path) -> Material:
        return Prony(self.E, self.nu, self.rho, self.depth, self.moduli, self.tau, self.tau_instant)


class PresetTable(Group):
    """A rubber from the literature; `torchsoft material presets` lists them with the source of every coefficient."""

    kind: Literal["preset"] = "preset"
    name: str = Field(description='its name, such as "Dragon Skin 20"')
    depth: Length = Field(description=DEPTH)

    @model_validator(mode="after")
    def _is_known(self) -> Self:
        if self.name not in PRESETS:
            raise ValueError(f"name: there is no preset `{line(self.name, 80)}`; there are {', '.join(PRESETS)}")
        return self

    def build(self, folder: Path) -> Material:
        return PRESETS[self.name].material(self.depth)


class FileTable(Group):
    """A material of another TOML file, such as the one that `torchsoft material fit` writes."""

    kind: Literal["file"] = "file"
    file: str = Field(description="the file, from the folder of this one")
    name: str | None = Field(default=None, description="which of its materials; not needed where it has one only")
    depth: Length | None = Field(default=None, description=f"{DEPTH}; as the file says if not given")

    def build(self, folder: Path) -> Material:
        path = folder / self.file
        with at_field("file"):
            tree = read_toml(path).get("materials")
            found = tree if isinstance(tree, dict) else {}
            if self.name is None and len(found) != 1:
                raise ValueError(
                    f"{path} has {len(found)} tables [materials.*]; say by name which one is meant, or one"
                )
            name = next(iter(found)) if self.name is None else self.name
            if name not in found:
                raise ValueError(f"{path} has no [materials.{name}]; it has {', '.join(found) or 'none'}")
            given = {} if self.depth is None else {"depth": self.depth}
            try:
                with refusing(found[name], f"materials.{name}"):
                    table = OwnTable.validate_python(found[name])
                    table = table.model_validate(table.model_dump(exclude_unset=True) | given)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
        return table.build(path.parent)


Own = Annotated[
    KelvinVoigtTable | StandardLinearSolidTable | GeneralisedKelvinTable | PronyTable, Field(discriminator="kind")
]
OwnTable: TypeAdapter[Own] = TypeAdapter(Own)
"""What a file may hold: no further files."""

MaterialTable = Annotated[
    KelvinVoigtTable | StandardLinearSolidTable | GeneralisedKelvinTable | PronyTable | PresetTable | FileTable,
    Field(discriminator="kind"),
]
