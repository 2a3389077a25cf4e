"""Contacts of a rig file: laws by name, and which pad touches which body by which law."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from torchsoft.physics.contact import Coulomb, SlipLaw, SmoothSlip, SoftContact
from torchsoft.physics.parts import Contact
from torchsoft.rigs.fields import Coefficient, Dashpot, Group, Length, Within

Stiffness = Annotated[float, Within(1e-3, 1e12, "N/m")]


class Coefficients(Group):
    """Static and kinetic coefficient of friction."""

    mu_s: Coefficient = Field(description="static coefficient of friction")
    mu_k: Coefficient = Field(description="kinetic coefficient of friction, not above mu_s")

    @model_validator(mode="after")
    def _falls(self) -> Self:
        if self.mu_k > self.mu_s:
            raise ValueError(f"mu_k = {self.mu_k:g} is above mu_s = {self.mu_s:g}: slip would supply power")
        return self


class SmoothTable(Coefficients):
    """Stick and slip with a coefficient that falls smoothly from mu_s to mu_k."""

    kind: Literal["smooth"] = "smooth"
    v_s: Annotated[float, Within(1e-9, 1e3, "m/s")] = Field(default=5e-3, description="slip speed over which it falls")
    eta: Dashpot = Field(default=10.0, description="viscosity of the slip element")

    def build(self) -> SlipLaw:
        return SmoothSlip(self.mu_s, self.mu_k, self.v_s, self.eta)


class CoulombTable(Coefficients):
    """Coulomb's law with a jump from mu_s to mu_k where slip begins."""

    kind: Literal["coulomb"] = "coulomb"

    def build(self) -> SlipLaw:
        return Coulomb(self.mu_s, self.mu_k)


FrictionTable = Annotated[SmoothTable | CoulombTable, Field(discriminator="kind")]


class LawTable(Group):
    """A law of contact: springs and dashpots of one point, per `node_spacing` of surface, and friction."""

    K_n: Stiffness = Field(description="normal spring")
    R_n: Dashpot = Field(description="normal dashpot")
    K_t: Stiffness = Field(description="tangential spring, momentary: until the point slips")
    R_t: Dashpot = Field(description="tangential dashpot")
    epsilon: Annotated[float, Within(1e-12, 1e-2, "m")] = Field(
        default=1e-6, description="depth over which dashpots and friction come in at touch-down"
    )
    node_spacing: Length = Field(default=1e-3, description="length of surface that the four numbers belong to")
    friction: FrictionTable

    @model_validator(mode="after")
    def _is_well_posed(self) -> Self:
        if isinstance(self.friction, CoulombTable) and self.R_t == 0:
            raise ValueError(
                "friction of the kind coulomb needs R_t > 0: the stretch is re-anchored through the dashpot"
            )
        if isinstance(self.friction, SmoothTable) and self.R_t + self.friction.eta <= 0:
            raise ValueError("R_t and friction.eta must not both be 0: the slip rate is effort / (eta + R_t)")
        return self

    def build(self) -> SoftContact:
        return SoftContact(
            self.K_n, self.R_n, self.K_t, self.R_t, friction=self.friction.build(), epsilon=self.epsilon,
            node_spacing=self.node_spacing,
        )  # fmt: skip


class ContactTable(Group):
    """What may touch: a pad and a body. What has no contact passes through each other."""

    pad: str = Field(description="name of one of the pads")
    body: str = Field(description="name of one of the bodies, with a shape")
    law: str = Field(description="name of one of the laws")
    may_leave: bool = Field(
        default=False, description="true: the run goes on where the body leaves the space over the pad"
    )

    def build(self, laws: dict[str, SoftContact]) -> Contact:
        return Contact(self.pad, self.body, laws[self.law], may_leave=self.may_leave)
