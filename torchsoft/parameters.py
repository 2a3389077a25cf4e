"""The numbers of the model: SI units, bounds, and where each one comes from.

Every quantity is `published` (printed in the paper) or `assumed` (chosen here, because the paper does not give
it). A value that differs from its default is `assumed` whatever the default was.
"""

import math
import tomllib
import warnings
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

Source = Literal["published", "assumed"]


def quantity(default: Any, unit: str, source: Source, meaning: str, **bounds: Any) -> Any:
    """A field of a parameter group: default [unit], its source, its meaning and pydantic bounds."""
    return Field(default, description=meaning, json_schema_extra={"unit": unit, "source": source}, **bounds)


class Group(BaseModel):
    """A frozen group of quantities; unknown names, non-finite numbers and values out of bounds are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PadParameters(Group):
    """One soft pad; the upper one is the lower one mirrored."""

    length: float = quantity(0.120, "m", "published", "L_x", gt=0)
    height: float = quantity(4.59e-3, "m", "published", "L_y", gt=0)
    depth: float = quantity(0.044, "m", "assumed", "out-of-plane depth; a steel disc of the assumed mass", gt=0)
    E: float = quantity(0.75e6, "Pa", "assumed", "Young's modulus; Shore A 20 silicone", gt=0)
    nu: float = quantity(0.45, "1", "assumed", "Poisson's ratio", gt=-1, lt=0.5)
    rho: float = quantity(1100.0, "kg/m3", "assumed", "density (inertial pads only)", gt=0)
    tau: float = quantity(10e-3, "s", "assumed", "Kelvin-Voigt time, R = tau K", gt=0)
    elements_x: int = quantity(120, "1", "assumed", "elements along the pad", ge=4)
    elements_y: int = quantity(4, "1", "assumed", "elements through the pad", ge=1)
    enclosed: bool = quantity(False, "1", "assumed", "bracket bonded to the upper pad's sides as well")
    fidelity: Literal["massless", "inertial"] = quantity(
        "massless", "1", "assumed", "statically condensed surface, or the full I, C, R fields"
    )


class ContactParameters(Group):
    """Penalty contact per surface node at the reference spacing; other spacings scale by tributary length."""

    K_n: float = quantity(1.2e5, "N/m", "assumed", "normal spring, K_28 and K_64", gt=0)
    R_n: float = quantity(441.7149, "N.s/m", "assumed", "normal dashpot, R_29 and R_65", ge=0)
    K_t: float = quantity(1.2e5, "N/m", "assumed", "momentary tangential spring, K_23 and K_59", gt=0)
    R_t: float = quantity(441.7149, "N.s/m", "assumed", "tangential dashpot, R_24 and R_60", ge=0)
    mu_s: float = quantity(0.8, "1", "assumed", "static friction coefficient", ge=0)
    mu_k: float = quantity(0.7, "1", "assumed", "kinetic friction coefficient", ge=0)
    eta: float = quantity(10.0, "N.s/m", "assumed", "viscosity of the slip element; 0 is Coulomb's limit", ge=0)
    v_s: float = quantity(5e-3, "m/s", "assumed", "slip speed over which mu falls from mu_s to mu_k", gt=0)
    epsilon: float = quantity(1e-6, "m", "assumed", "touch-down depth of the ramp g / (g + epsilon)", gt=0)
    node_spacing: float = quantity(1e-3, "m", "assumed", "spacing the per-node values refer to", gt=0)
    friction: Literal["smooth", "coulomb"] = quantity(
        "smooth", "1", "assumed", "slip element, or Eq. 12-13 with the force's modulus and re-anchoring"
    )
    points: int = quantity(
        0, "1", "assumed", "contact points an element; 0 puts one on every node, as the paper does", ge=0, le=8
    )

    @model_validator(mode="after")
    def _laws_are_well_posed(self) -> Self:
        if self.mu_k > self.mu_s:
            raise ValueError(f"mu_k must not exceed mu_s, but mu_k = {self.mu_k} > mu_s = {self.mu_s}")
        if self.eta + self.R_t <= 0:
            raise ValueError("eta + R_t must be positive: the slip rate is effort / (eta + R_t)")
        if self.friction == "coulomb" and self.R_t <= 0:
            raise ValueError("friction = 'coulomb' needs R_t > 0: the stretch is re-anchored through the dashpot")
        return self


class DiscParameters(Group):
    radius: float = quantity(19.37e-3, "m", "published", "radius of the disc", gt=0)
    mass: float = quantity(0.4065, "kg", "assumed", "441.7149 = 2 sqrt(1.2e5 m): critically damped loops", gt=0)


class BracketParameters(Group):
    mass: float = quantity(0.4065, "kg", "assumed", "441.7149 = 2 sqrt(1.2e5 m): critically damped loops", gt=0)
    cm_height: float = quantity(2.18e-3, "m", "assumed", "centre of mass above the pad's bonded face")


class ControlParameters(Group):
    K_81: float = quantity(1.2e5, "N/m", "published", "horizontal loop, proportional gain, Eq. 34", ge=0)
    R_80: float = quantity(441.7149, "N.s/m", "published", "horizontal loop, derivative gain, Eq. 34", ge=0)
    K_98: float = quantity(1.2e5, "N/m", "published", "vertical loop, proportional gain, Eq. 32", ge=0)
    R_99: float = quantity(441.7149, "N.s/m", "published", "vertical loop, derivative gain, Eq. 32", ge=0)
    senses: Literal["disc", "bracket"] = quantity(
        "disc", "1", "published", "whose x the horizontal loop measures; the bracket's makes the loop collocated"
    )


class ScenarioParameters(Group):
    """Grasp, roll out, hold, roll back, rest."""

    gravity: float = quantity(9.81, "m/s2", "assumed", "gravitational acceleration, acting on the disc (Eq. 17)", ge=0)
    x_C0: float = quantity(60e-3, "m", "published", "x_C(0), Eq. 22")
    y_Br_grasp: float = quantity(48.6e-3, "m", "published", "y_Br(t_g), Eq. 30", gt=0)
    grasp_time: float = quantity(0.375, "s", "published", "t_g", gt=0)
    travel: float = quantity(-20e-3, "m", "published", "displacement of the disc, Eq. 23")
    roll_time: float = quantity(10.0, "s", "published", "time of the roll, each way", gt=0)
    hold_time: float = quantity(5.0, "s", "published", "time at the far end", ge=0)
    rest_time: float = quantity(5.0, "s", "published", "rest at the end", ge=0)

    @property
    def duration(self) -> float:
        """Length of the whole manipulation [s]."""
        return 2.0 * self.roll_time + self.hold_time + self.rest_time


class Parameters(Group):
    """All numbers of one simulation.

    Raises `ValueError` (pydantic's `ValidationError`, naming the field) for a value out of bounds, an unknown
    name, a disc that does not fit between the pads, or a scenario that rolls off them. Warns where the friction
    law is not single-valued at the full grasp.
    """

    pad: PadParameters = PadParameters()
    contact: ContactParameters = ContactParameters()
    disc: DiscParameters = DiscParameters()
    bracket: BracketParameters = BracketParameters()
    control: ControlParameters = ControlParameters()
    scenario: ScenarioParameters = ScenarioParameters()

    @property
    def compression(self) -> float:
        """How much the two pads together are compressed in the grasp [m]."""
        face = self.scenario.y_Br_grasp - self.bracket.cm_height
        return 2.0 * self.pad.height + 2.0 * self.disc.radius - face

    @model_validator(mode="after")
    def _geometry_is_possible(self) -> Self:
        if self.compression <= 0:
            raise ValueError(
                f"the disc does not fit: at scenario.y_Br_grasp = {self.scenario.y_Br_grasp} m the pads are "
                f"{-self.compression:.3g} m apart from a disc of radius {self.disc.radius} m; lower the bracket"
            )
        if self.compression >= self.pad.height:
            raise ValueError(
                f"the disc does not fit: scenario.y_Br_grasp = {self.scenario.y_Br_grasp} m asks the two pads to give "
                f"way by {self.compression:.3g} m, but linear elasticity ends well below half of 2 x "
                f"{self.pad.height} m; raise the bracket or take a smaller disc.radius"
            )
        half_width = math.sqrt(self.disc.radius * self.compression)
        ends = sorted((self.scenario.x_C0, self.scenario.x_C0 + self.scenario.travel))
        if ends[0] - half_width < 0 or ends[1] + half_width > self.pad.length:
            raise ValueError(
                f"the trajectory leaves the pad: scenario.x_C0 and scenario.travel take the disc from {ends[0]} to "
                f"{ends[1]} m, its contact is {half_width:.3g} m wide to each side, and the pad reaches from 0 to "
                f"pad.length = {self.pad.length} m"
            )
        return self

    @model_validator(mode="after")
    def _slip_is_single_valued(self) -> Self:
        c, force = self.contact, 10.0 * self.contact.node_spacing / 1e-3  # [N], middle node of the full grasp
        if c.friction == "smooth" and c.eta + c.R_t < (c.mu_s - c.mu_k) * force / c.v_s:
            warnings.warn(
                f"the slip law is not single-valued at a normal force of {force:.3g} N: eta + R_t = {c.eta + c.R_t:.3g} "
                f"N.s/m is below (mu_s - mu_k) F_N / v_s = {(c.mu_s - c.mu_k) * force / c.v_s:.3g}; the slip rate, and "
                "every gradient, jumps at slip onset. Raise contact.v_s or contact.eta.",
                stacklevel=2,
            )
        return self

    def override(self, values: dict[str, Any]) -> "Parameters":
        """A validated copy with `values` replaced, keyed by dotted names such as `"pad.E"`."""
        tree = self.model_dump()
        for name, value in values.items():
            group, _, field = name.partition(".")
            if group not in tree or field not in tree[group]:
                raise ValueError(f"`{name}` is not a parameter; known names: {', '.join(self.table())}")
            tree[group][field] = value
        return Parameters.model_validate(tree)

    @classmethod
    def paper_like(cls) -> "Parameters":
        """The friction set whose lateral forces fade in the grasp, as the paper reports: dashpot-dominated."""
        return cls().override({"contact.K_t": 100.0})

    @classmethod
    def from_toml(cls, path: str | Path) -> "Parameters":
        """Read a TOML file with a table per group. Raises `ValueError` naming the file and the field."""
        try:
            return cls.model_validate(tomllib.loads(Path(path).read_text()))
        except (ValidationError, tomllib.TOMLDecodeError) as error:
            raise ValueError(f"{path}: {error}") from error

    def table(self) -> dict[str, dict[str, Any]]:
        """Every parameter by its dotted name: value, unit, source (`published` or `assumed`) and meaning."""
        rows = {}
        for group_name in Parameters.model_fields:
            group = getattr(self, group_name)
            for name, field in type(group).model_fields.items():
                value, extra = getattr(group, name), field.json_schema_extra
                assert isinstance(extra, dict)
                source = extra["source"] if value == field.default else "assumed"
                rows[f"{group_name}.{name}"] = {
                    "value": value,
                    "unit": extra["unit"],
                    "source": source,
                    "meaning": field.description,
                }
        return rows
