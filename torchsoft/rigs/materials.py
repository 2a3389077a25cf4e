"""Materials of pads in a rig file. Another one is another class here, and one more name in `MaterialTable`."""

from typing import Annotated, Literal

from pydantic import Field

from torchsoft.physics.material import KelvinVoigt, Material, StandardLinearSolid
from torchsoft.rigs.fields import Group, Length, Within

Modulus = Annotated[float, Within(1.0, 1e13, "Pa")]

Retardation = Annotated[float, Within(1e-9, 1e6, "s")]


class Elastic(Group):
    """What every material has."""

    E: Modulus = Field(description="Young's modulus, relaxed; rubber has 0.1e6 to 10e6")
    nu: Annotated[float, Within(-0.999, 0.4999)] = Field(default=0.45, description="Poisson's ratio")
    depth: Length = Field(description="how deep the pads are, out of the plane")
    rho: Annotated[float, Within(1e-3, 1e6, "kg/m3")] = Field(
        default=1100.0, description="density, of inertial pads only"
    )


class KelvinVoigtTable(Elastic):
    """A spring beside a dashpot."""

    kind: Literal["kelvin_voigt"] = "kelvin_voigt"
    tau: Retardation = Field(description="retardation time: the dashpot's viscosity over the modulus")

    def build(self) -> Material:
        return KelvinVoigt(self.E, self.nu, self.rho, self.tau, self.depth)


class StandardLinearSolidTable(Elastic):
    """A spring in series with a spring beside a dashpot: stiffer at first than when it has relaxed."""

    kind: Literal["standard_linear_solid"] = "standard_linear_solid"
    E_instant: Modulus = Field(description="Young's modulus at first, above E")
    tau: Retardation = Field(description="retardation time")
    tau_instant: Retardation = Field(default=1e-4, description="retardation time of the first spring, small")

    def build(self) -> Material:
        return StandardLinearSolid(
            self.E, self.E_instant, self.nu, self.rho, self.tau, self.depth, self.tau_instant
        )  # fmt: skip


MaterialTable = Annotated[KelvinVoigtTable | StandardLinearSolidTable, Field(discriminator="kind")]
