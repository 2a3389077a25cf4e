"""Parameters of the paper's rig: defaults and their sources. Units, bounds and meanings are those
of the parts' constructors.

Every number is `published` (printed in the paper) or `assumed` (chosen here, because the paper does
not give it). A value that differs from its default is `assumed` whatever the default was.
"""

import math
import warnings
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, TypeAdapter, model_validator

from torchsoft.physics.contact import Coulomb, SlipLaw, SmoothSlip, SoftContact
from torchsoft.physics.material import KelvinVoigt
from torchsoft.physics.mesh import PadMesh
from torchsoft.physics.mesh.mesh import MEMORY
from torchsoft.physics.parts import PD, Body
from torchsoft.physics.rig import Rig
from torchsoft.physics.shapes import Circle
from torchsoft.physics.validity import sound
from torchsoft.quantity import quantities
from torchsoft.tables import Table, from_toml, line, refusing

Source = Literal["published", "assumed"]


def of(
    part: type, name: str, default: float, source: Source, note: str = "", unit: str = ""
) -> Any:
    """A parameter of the paper's rig: an argument of a part's constructor, with its default and
    source; `note` replaces its meaning."""
    declared = quantities(part)[name]
    return number(
        default,
        unit or declared.unit,
        source,
        note or declared.meaning,
        declared.low,
        declared.high,
    )


def number(default: float, unit: str, source: Source, meaning: str, low: float, high: float) -> Any:
    """A field for a number with its bounds."""
    return Field(
        default,
        description=meaning,
        json_schema_extra={"unit": unit, "source": source},
        ge=low,
        le=high,
    )


def choice(default: Any, source: Source, meaning: str) -> Any:
    """A field for a setting that is not a number."""
    return Field(default, description=meaning, json_schema_extra={"unit": "1", "source": source})


MASS = "441.7149 = 2 sqrt(1.2e5 m): critically damped loops"


class PadParameters(Table):
    """One soft pad; the upper one is the lower one mirrored."""

    length: float = of(PadMesh, "length", 0.120, "published", "L_x")
    height: float = of(PadMesh, "height", 4.59e-3, "published", "L_y")
    depth: float = of(
        KelvinVoigt,
        "depth",
        0.044,
        "assumed",
        "out-of-plane depth; a steel disc of the assumed mass",
    )
    E: float = of(KelvinVoigt, "E", 0.75e6, "assumed", "Young's modulus; Shore A 20 silicone")
    nu: float = of(KelvinVoigt, "nu", 0.45, "assumed")
    rho: float = of(KelvinVoigt, "rho", 1100.0, "assumed", "density (inertial pads only)")
    tau: float = of(KelvinVoigt, "tau", 10e-3, "assumed", "Kelvin-Voigt time, R = tau K")
    elements_x: int = number(120, "1", "assumed", "elements along the pad", 4, 100_000)
    elements_y: int = of(PadMesh, "elements_y", 4, "assumed", "elements through the pad")
    enclosed: bool = choice(False, "assumed", "bracket bonded to the upper pad's sides as well")
    fidelity: Literal["massless", "inertial"] = choice(
        "massless", "assumed", "statically condensed surface, or the full I, C, R fields"
    )

    @property
    def mesh(self) -> PadMesh:
        """Mesh of the lower pad."""
        return PadMesh(self.length, self.height, self.elements_x, self.elements_y)

    @property
    def memory(self) -> float:
        """Memory [GiB] of the mesh's stiffness and its loads."""
        return self.mesh.memory if self.fidelity == "massless" else self.mesh.memory / 6


class ContactParameters(Table):
    """Penalty contact per surface node at the reference spacing; other spacings scale by tributary
    length."""

    K_n: float = of(SoftContact, "K_n", 1.2e5, "assumed", "normal spring, K_28 and K_64")
    R_n: float = of(SoftContact, "R_n", 441.7149, "assumed", "normal dashpot, R_29 and R_65")
    K_t: float = of(
        SoftContact, "K_t", 1.2e5, "assumed", "momentary tangential spring, K_23 and K_59"
    )
    R_t: float = of(SoftContact, "R_t", 441.7149, "assumed", "tangential dashpot, R_24 and R_60")
    mu_s: float = of(SmoothSlip, "mu_s", 0.8, "assumed")
    mu_k: float = of(SmoothSlip, "mu_k", 0.7, "assumed")
    v_s: float = of(SmoothSlip, "v_s", 5e-3, "assumed")
    node_spacing: float = of(
        SoftContact, "node_spacing", 1e-3, "assumed", "spacing the per-node values refer to"
    )
    friction: Literal["smooth", "coulomb"] = choice(
        "smooth", "assumed", "slip element, or Eq. 12-13 with the force's modulus and re-anchoring"
    )
    points: int = number(
        0,
        "1",
        "assumed",
        "contact points an element; 0 puts one on every node, as the paper does",
        0,
        8,
    )

    def law(self, friction: SlipLaw | None = None) -> SoftContact:
        """Law of a contact point; `friction` replaces the one of the settings."""
        smooth = self.friction == "smooth"
        slip = (
            SmoothSlip(self.mu_s, self.mu_k, self.v_s) if smooth else Coulomb(self.mu_s, self.mu_k)
        )
        return SoftContact(
            self.K_n,
            self.R_n,
            self.K_t,
            self.R_t,
            friction=slip if friction is None else friction,
            node_spacing=self.node_spacing,
        )

    @model_validator(mode="after")
    def _laws_are_well_posed(self) -> Self:
        law = self.law()
        for part in (law.friction, law):
            sound(part)
        return self


class DiscParameters(Table):
    radius: float = of(Circle, "radius", 19.37e-3, "published", "radius of the disc")
    mass: float = of(Body, "mass", 0.4065, "assumed", MASS)
    inertia_ratio: float = of(Body, "inertia_ratio", 1.0, "assumed")


class BracketParameters(Table):
    mass: float = of(Body, "mass", 0.4065, "assumed", MASS)
    cm_height: float = number(
        2.18e-3, "m", "assumed", "centre of mass above the pad's bonded face", -10.0, 10.0
    )


class ControlParameters(Table):
    K_81: float = of(
        PD, "Kp", 1.2e5, "published", "horizontal loop, proportional gain, Eq. 34", "N/m"
    )
    R_80: float = of(
        PD, "Kd", 441.7149, "published", "horizontal loop, derivative gain, Eq. 34", "N.s/m"
    )
    K_98: float = of(
        PD, "Kp", 1.2e5, "published", "vertical loop, proportional gain, Eq. 32", "N/m"
    )
    R_99: float = of(
        PD, "Kd", 441.7149, "published", "vertical loop, derivative gain, Eq. 32", "N.s/m"
    )
    senses: Literal["disc", "bracket"] = choice(
        "disc",
        "published",
        "whose x the horizontal loop measures; the bracket's makes the loop collocated",
    )


class ScenarioParameters(Table):
    """Grasp, roll out, hold, roll back, rest."""

    gravity: float = of(
        Rig, "gravity", 9.81, "assumed", "gravitational acceleration, acting on the disc (Eq. 17)"
    )
    x_C0: float = number(60e-3, "m", "published", "x_C(0), Eq. 22", -100.0, 100.0)
    y_Br_grasp: float = number(48.6e-3, "m", "published", "y_Br(t_g), Eq. 30", 1e-4, 100.0)
    grasp_time: float = number(0.375, "s", "published", "t_g", 1e-6, 1e5)
    travel: float = number(
        -20e-3, "m", "published", "displacement of the disc, Eq. 23", -100.0, 100.0
    )
    roll_time: float = number(10.0, "s", "published", "time of the roll, each way", 1e-6, 1e5)
    hold_time: float = number(5.0, "s", "published", "time at the far end", 0, 1e5)
    rest_time: float = number(5.0, "s", "published", "rest at the end", 0, 1e5)

    @property
    def duration(self) -> float:
        """Length of the whole manipulation [s]."""
        return 2.0 * self.roll_time + self.hold_time + self.rest_time


class Parameters(Table):
    """All numbers of one simulation.

    Raises `InvalidTable`, a `ValueError` in one sentence that names the field, for a value out of
    bounds, an unknown name, a disc that does not fit between the pads, a scenario that rolls off
    them, or a mesh that would not fit in memory. Warns where the friction law is not single-valued
    at the full grasp.
    """

    pad: PadParameters = PadParameters()
    contact: ContactParameters = ContactParameters()
    disc: DiscParameters = DiscParameters()
    bracket: BracketParameters = BracketParameters()
    control: ControlParameters = ControlParameters()
    scenario: ScenarioParameters = ScenarioParameters()

    @property
    def compression(self) -> float:
        """Compression of both pads together in the grasp [m]."""
        face = self.scenario.y_Br_grasp - self.bracket.cm_height
        return 2.0 * self.pad.height + 2.0 * self.disc.radius - face

    @model_validator(mode="after")
    def _geometry_is_possible(self) -> Self:
        stack = (
            f"scenario.y_Br_grasp = {self.scenario.y_Br_grasp} m, with bracket.cm_height = "
            f"{self.bracket.cm_height} m, pad.height = {self.pad.height} m and disc.radius = "
            f"{self.disc.radius} m,"
        )
        if self.compression <= 0:
            raise ValueError(
                f"the disc does not fit: {stack} leaves the pads {-self.compression:.3g} m apart "
                "from the disc; lower the bracket"
            )
        if self.compression >= self.pad.height:
            raise ValueError(
                f"the disc does not fit: {stack} asks the two pads to give way by "
                f"{self.compression:.3g} m, but linear elasticity ends well below half of both "
                "heights; raise the bracket or take a smaller disc"
            )
        half_width = math.sqrt(self.disc.radius * self.compression)
        ends = sorted((self.scenario.x_C0, self.scenario.x_C0 + self.scenario.travel))
        if ends[0] - half_width < 0 or ends[1] + half_width > self.pad.length:
            raise ValueError(
                f"the trajectory leaves the pad: scenario.x_C0 = {self.scenario.x_C0} m and "
                f"scenario.travel = {self.scenario.travel} m take the disc from {ends[0]:.6g} to "
                f"{ends[1]:.6g} m, its contact is {half_width:.3g} m wide to each side "
                f"(disc.radius = {self.disc.radius} m, scenario.y_Br_grasp = "
                f"{self.scenario.y_Br_grasp} m, bracket.cm_height = {self.bracket.cm_height} m, "
                f"pad.height = {self.pad.height} m), and the pad reaches from 0 to pad.length = "
                f"{self.pad.length} m"
            )
        return self

    @model_validator(mode="after")
    def _mesh_fits_in_memory(self) -> Self:
        if self.pad.memory > MEMORY:
            try:
                self.pad.mesh.check_memory()
            except ValueError as error:
                raise ValueError(f"the mesh is too fine: pad.{error}") from None
        return self

    @model_validator(mode="after")
    def _slip_is_single_valued(self) -> Self:
        force = 10.0 * self.contact.node_spacing / 1e-3  # [N], middle node of the full grasp
        if reason := self.contact.law().jumps(force):
            warnings.warn(
                f"{reason}; the slip rate, and every gradient, jumps at slip onset. Raise "
                "contact.v_s or contact.R_t.",
                stacklevel=2,
            )
        return self

    def override(self, values: dict[str, Any]) -> "Parameters":
        """A validated copy with `values` replaced, keyed by dotted names such as `"pad.E"`."""
        tree = self.model_dump()
        for name, value in values.items():
            group, _, field = str(name).partition(".")
            if group not in tree or field not in tree[group]:
                raise ValueError(
                    f"`{line(name, 80)}` is not a parameter; known names: {', '.join(self.table())}"
                )
            tree[group][field] = value
        return Parameters.model_validate(tree)

    @classmethod
    def paper_like(cls) -> "Parameters":
        """Parameters whose lateral forces fade in the grasp, as the paper reports: the dashpots
        dominate the friction."""
        return cls().override({"contact.K_t": 100.0})

    @classmethod
    def from_toml(cls, path: str | Path) -> "Parameters":
        """Read a TOML file with a table per group. Raises `ValueError` naming the file and the
        field."""
        return from_toml(path, cls.model_validate)

    def table(self) -> dict[str, dict[str, Any]]:
        """Every parameter by its dotted name: value, unit, source (`published` or `assumed`) and
        meaning."""
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


@cache
def adapter(name: str) -> TypeAdapter[Any]:
    """Validator of a parameter by its dotted name. Raises `KeyError` for an unknown name."""
    group, _, field = name.partition(".")
    declared = type(Parameters.model_fields[group].default).model_fields[field]
    kind: Any = Annotated[declared.annotation, *declared.metadata, declared]
    return TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False))


def check(name: str, value: Any, where: str) -> None:
    """Raises `InvalidTable` naming `where` for a value out of the parameter's own bounds."""
    with refusing(within=where):
        adapter(name).validate_python(value)
