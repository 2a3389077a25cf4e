"""The numbers of the model: SI units, bounds, and where each one comes from.

Every quantity is `published` (printed in the paper) or `assumed` (chosen here, because the paper does not give
it). A value that differs from its default is `assumed` whatever the default was.
"""

import math
import warnings
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from annotated_types import Ge, Le
from pydantic import ConfigDict, Field, TypeAdapter, model_validator

from torchsoft.tables import Table, from_toml, line, refusing

Source = Literal["published", "assumed"]

MEMORY = 8.0
"""Largest memory [GiB] that the stiffness of a pad's mesh may need."""


ORDERED = ("contact.mu_k", "contact.mu_s")
"""The first must not exceed the second."""


def quantity(default: Any, unit: str, source: Source, meaning: str, **bounds: Any) -> Any:
    """A field of a parameter group: default [unit], its source, its meaning and pydantic bounds.

    The bounds are wide: they end where sums and products of such numbers would not be finite.
    """
    return Field(default, description=meaning, json_schema_extra={"unit": unit, "source": source}, **bounds)


def condensation_memory(surface: int, free: int, band: int) -> float:
    """What it takes to condense a mesh onto its surface [GiB], about: the nodes that move, `free`, under loads on so many nodes
    of the `surface`, and their products; the stiffness, in which nodes up to `band` apart meet, and its factor."""
    return 8 * 4 * free * (6 * surface + 2 * band) / 2**30


class PadParameters(Table):
    """One soft pad; the upper one is the lower one mirrored."""

    length: float = quantity(0.120, "m", "published", "L_x", ge=1e-4, le=100.0)
    height: float = quantity(4.59e-3, "m", "published", "L_y", ge=1e-5, le=10.0)
    depth: float = quantity(
        0.044, "m", "assumed", "out-of-plane depth; a steel disc of the assumed mass", ge=1e-5, le=100.0
    )
    E: float = quantity(0.75e6, "Pa", "assumed", "Young's modulus; Shore A 20 silicone", ge=1.0, le=1e13)
    nu: float = quantity(0.45, "1", "assumed", "Poisson's ratio", ge=-0.999, le=0.4999)
    rho: float = quantity(1100.0, "kg/m3", "assumed", "density (inertial pads only)", ge=1e-3, le=1e6)
    tau: float = quantity(10e-3, "s", "assumed", "Kelvin-Voigt time, R = tau K", ge=1e-9, le=1e6)
    elements_x: int = quantity(120, "1", "assumed", "elements along the pad", ge=4, le=100_000)
    elements_y: int = quantity(4, "1", "assumed", "elements through the pad", ge=1, le=1000)
    enclosed: bool = quantity(False, "1", "assumed", "bracket bonded to the upper pad's sides as well")
    fidelity: Literal["massless", "inertial"] = quantity(
        "massless", "1", "assumed", "statically condensed surface, or the full I, C, R fields"
    )

    @property
    def memory(self) -> float:
        """What the stiffness of the mesh and its loads take [GiB]."""
        surface = self.elements_x + 1
        whole = condensation_memory(surface, surface * self.elements_y, self.elements_y + 2)
        return whole if self.fidelity == "massless" else whole / 6


class ContactParameters(Table):
    """Penalty contact per surface node at the reference spacing; other spacings scale by tributary length."""

    K_n: float = quantity(1.2e5, "N/m", "assumed", "normal spring, K_28 and K_64", ge=1e-3, le=1e12)
    R_n: float = quantity(441.7149, "N.s/m", "assumed", "normal dashpot, R_29 and R_65", ge=0, le=1e9)
    K_t: float = quantity(1.2e5, "N/m", "assumed", "momentary tangential spring, K_23 and K_59", ge=1e-3, le=1e12)
    R_t: float = quantity(441.7149, "N.s/m", "assumed", "tangential dashpot, R_24 and R_60", ge=0, le=1e9)
    mu_s: float = quantity(0.8, "1", "assumed", "static friction coefficient", ge=0, le=100.0)
    mu_k: float = quantity(0.7, "1", "assumed", "kinetic friction coefficient", ge=0, le=100.0)
    eta: float = quantity(10.0, "N.s/m", "assumed", "viscosity of the slip element; 0 is Coulomb's limit", ge=0, le=1e9)
    v_s: float = quantity(5e-3, "m/s", "assumed", "slip speed over which mu falls from mu_s to mu_k", ge=1e-9, le=1e3)
    epsilon: float = quantity(1e-6, "m", "assumed", "touch-down depth of the ramp g / (g + epsilon)", ge=1e-12, le=1.0)
    node_spacing: float = quantity(1e-3, "m", "assumed", "spacing the per-node values refer to", ge=1e-7, le=1.0)
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


class DiscParameters(Table):
    radius: float = quantity(19.37e-3, "m", "published", "radius of the disc", ge=1e-4, le=10.0)
    mass: float = quantity(
        0.4065, "kg", "assumed", "441.7149 = 2 sqrt(1.2e5 m): critically damped loops", ge=1e-6, le=1e5
    )


class BracketParameters(Table):
    mass: float = quantity(
        0.4065, "kg", "assumed", "441.7149 = 2 sqrt(1.2e5 m): critically damped loops", ge=1e-6, le=1e5
    )
    cm_height: float = quantity(
        2.18e-3, "m", "assumed", "centre of mass above the pad's bonded face", ge=-10.0, le=10.0
    )


class ControlParameters(Table):
    K_81: float = quantity(1.2e5, "N/m", "published", "horizontal loop, proportional gain, Eq. 34", ge=0, le=1e12)
    R_80: float = quantity(441.7149, "N.s/m", "published", "horizontal loop, derivative gain, Eq. 34", ge=0, le=1e12)
    K_98: float = quantity(1.2e5, "N/m", "published", "vertical loop, proportional gain, Eq. 32", ge=0, le=1e12)
    R_99: float = quantity(441.7149, "N.s/m", "published", "vertical loop, derivative gain, Eq. 32", ge=0, le=1e12)
    senses: Literal["disc", "bracket"] = quantity(
        "disc", "1", "published", "whose x the horizontal loop measures; the bracket's makes the loop collocated"
    )


class ScenarioParameters(Table):
    """Grasp, roll out, hold, roll back, rest."""

    gravity: float = quantity(
        9.81, "m/s2", "assumed", "gravitational acceleration, acting on the disc (Eq. 17)", ge=0, le=1e3
    )
    x_C0: float = quantity(60e-3, "m", "published", "x_C(0), Eq. 22", ge=-100.0, le=100.0)
    y_Br_grasp: float = quantity(48.6e-3, "m", "published", "y_Br(t_g), Eq. 30", ge=1e-4, le=100.0)
    grasp_time: float = quantity(0.375, "s", "published", "t_g", ge=1e-6, le=1e5)
    travel: float = quantity(-20e-3, "m", "published", "displacement of the disc, Eq. 23", ge=-100.0, le=100.0)
    roll_time: float = quantity(10.0, "s", "published", "time of the roll, each way", ge=1e-6, le=1e5)
    hold_time: float = quantity(5.0, "s", "published", "time at the far end", ge=0, le=1e5)
    rest_time: float = quantity(5.0, "s", "published", "rest at the end", ge=0, le=1e5)

    @property
    def duration(self) -> float:
        """Length of the whole manipulation [s]."""
        return 2.0 * self.roll_time + self.hold_time + self.rest_time


class Parameters(Table):
    """All numbers of one simulation.

    Raises `InvalidTable`, a `ValueError` in one sentence that names the field, for a value out of bounds, an unknown name, a
    disc that does not fit between the pads, a scenario that rolls off them, or a mesh that would not fit in memory. Warns where
    the friction law is not single-valued at the full grasp.
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
        stack = (
            f"scenario.y_Br_grasp = {self.scenario.y_Br_grasp} m, with bracket.cm_height = {self.bracket.cm_height} m, "
            f"pad.height = {self.pad.height} m and disc.radius = {self.disc.radius} m,"
        )
        if self.compression <= 0:
            raise ValueError(
                f"the disc does not fit: {stack} leaves the pads {-self.compression:.3g} m apart from the disc; lower the "
                "bracket"
            )
        if self.compression >= self.pad.height:
            raise ValueError(
                f"the disc does not fit: {stack} asks the two pads to give way by {self.compression:.3g} m, but linear "
                "elasticity ends well below half of both heights; raise the bracket or take a smaller disc"
            )
        half_width = math.sqrt(self.disc.radius * self.compression)
        ends = sorted((self.scenario.x_C0, self.scenario.x_C0 + self.scenario.travel))
        if ends[0] - half_width < 0 or ends[1] + half_width > self.pad.length:
            raise ValueError(
                f"the trajectory leaves the pad: scenario.x_C0 = {self.scenario.x_C0} m and scenario.travel = "
                f"{self.scenario.travel} m take the disc from {ends[0]:.6g} to {ends[1]:.6g} m, its contact is "
                f"{half_width:.3g} m wide to each side (disc.radius = {self.disc.radius} m, scenario.y_Br_grasp = "
                f"{self.scenario.y_Br_grasp} m, bracket.cm_height = {self.bracket.cm_height} m, pad.height = "
                f"{self.pad.height} m), and the pad reaches from 0 to pad.length = {self.pad.length} m"
            )
        return self

    @model_validator(mode="after")
    def _mesh_fits_in_memory(self) -> Self:
        pad = self.pad
        if (need := pad.memory) > MEMORY:
            raise ValueError(
                f"the mesh is too fine: the stiffness of pad.elements_x = {pad.elements_x} by pad.elements_y = "
                f"{pad.elements_y} elements takes about {need:.3g} GiB of memory, but {MEMORY:g} GiB are the most; take fewer"
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
            group, _, field = str(name).partition(".")
            if group not in tree or field not in tree[group]:
                raise ValueError(f"`{line(name, 80)}` is not a parameter; known names: {', '.join(self.table())}")
            tree[group][field] = value
        return Parameters.model_validate(tree)

    @classmethod
    def paper_like(cls) -> "Parameters":
        """The friction set whose lateral forces fade in the grasp, as the paper reports: dashpot-dominated."""
        return cls().override({"contact.K_t": 100.0})

    @classmethod
    def from_toml(cls, path: str | Path) -> "Parameters":
        """Read a TOML file with a table per group. Raises `ValueError` naming the file and the field."""
        return from_toml(path, cls.model_validate)

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


class Bounds(NamedTuple):
    """The least and the largest value that a parameter may have."""

    low: float
    high: float


@cache
def _field(name: str) -> Any:
    """The declaration of a parameter by its dotted name. Raises `KeyError` for an unknown name."""
    group, _, field = name.partition(".")
    return type(Parameters.model_fields[group].default).model_fields[field]


@cache
def _adapter(name: str) -> TypeAdapter[Any]:
    field, config = _field(name), ConfigDict(strict=True, allow_inf_nan=False)
    kind: Any = Annotated[field.annotation, *field.metadata, field]
    return TypeAdapter(kind, config=config)


def bounds(name: str) -> Bounds:
    """Of a parameter by its dotted name, whatever the others are. Raises `KeyError` for an unknown name."""
    stated: dict[type, Any] = {type(one): one for one in _field(name).metadata}
    low, high = stated.get(Ge), stated.get(Le)
    return Bounds(-math.inf if low is None else low.ge, math.inf if high is None else high.le)


def check(name: str, value: Any, where: str) -> None:
    """Raises `InvalidTable` naming `where` for a value that the parameter may not have, whatever the others are."""
    with refusing(within=where):
        _adapter(name).validate_python(value)
