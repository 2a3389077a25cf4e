"""The paper's rig from the lists: a disc between two soft pads, the upper one in a bracket under
two PD controllers."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torchsoft.paper.parameters import Parameters
from torchsoft.physics.contact import Coulomb, SlipLaw, SmoothSlip
from torchsoft.physics.material import KelvinVoigt, Material
from torchsoft.physics.mesh import PadMesh
from torchsoft.physics.motion import Reference, hold
from torchsoft.physics.pads import Pad, Taxels
from torchsoft.physics.parts import PD, Actuator, Body, Contact
from torchsoft.physics.rig import Rig
from torchsoft.physics.shapes import Circle, Shape

NAMES = {
    **{f"pad.{name}": f"pad.{name}" for name in ("E", "nu", "rho", "tau", "depth")},
    **{f"contact.{name}": f"contact.{name}" for name in ("K_n", "R_n", "K_t", "R_t")},
    **{f"contact.{name}": f"contact.friction.{name}" for name in ("mu_s", "mu_k", "v_s")},
    "control.K_81": "control.x.Kp",
    "control.R_80": "control.x.Kd",
    "control.K_98": "control.y.Kp",
    "control.R_99": "control.y.Kd",
    "disc.radius": "disc.shape.radius",
    "disc.mass": "disc.mass",
    "disc.inertia_ratio": "disc.inertia_ratio",
    "bracket.mass": "bracket.mass",
    "scenario.gravity": "gravity",
}
"""Names of the rig's module parameters by the names of `Parameters`."""


class SoftGrasp(Rig):
    """A rigid body between two soft pads, the upper one in a bracket; channels and signals have the
    paper's names.

    The reference's signals are x_d of the disc (or of the bracket, `control.senses`), y_d of the
    bracket and F_ff, the vertical effort fed forward; by default the bracket and the disc stay
    where they start. `friction`, `shape` and `material` replace those of the settings; `taxels` lie
    on the pads "L" and "U". Parts that both pads share are `pad` (the material), `contact`, `disc`,
    `bracket` and `control`.
    """

    renamed: Mapping[str, str] = {
        "disc_spin": "spin", "theta_C": "theta", "v_x_C": "v_x", "v_y_C": "v_y", "omega_C": "omega",
        "M_U": "bracket_moment", "L_C": "angular_momentum",
    }  # fmt: skip
    disc: Body
    bracket: Body

    def __init__(
        self, settings: Parameters | None = None, reference: Reference | None = None, *,
        friction: SlipLaw | None = None, shape: Shape | None = None,
        material: Material | None = None, taxels: Mapping[str, Taxels] | None = None,
    ) -> None:  # fmt: skip
        p = settings or Parameters()
        c, k = p.contact, p.control
        rubber = material or KelvinVoigt(p.pad.E, p.pad.nu, p.pad.rho, p.pad.tau, p.pad.depth)
        law = c.law(friction)
        disc = Body(p.disc.mass, shape or Circle(p.disc.radius), inertia_ratio=p.disc.inertia_ratio)
        bracket = Body(p.bracket.mass, theta=0.0, weighted=False)
        control = nn.ModuleDict({"x": PD(k.K_81, k.R_80), "y": PD(k.K_98, k.R_99)})
        upper = replace(p.pad.mesh, bonded_sides=p.pad.enclosed)
        common: dict[str, Any] = {
            "inertial": p.pad.fidelity == "inertial",
            "points": p.contact.points,
        }
        at_bracket = (-p.pad.length / 2, -p.bracket.cm_height)
        super().__init__(
            groups={
                "pad": rubber,
                "contact": law,
                "disc": disc,
                "bracket": bracket,
                "control": control,
            },
            bodies={"disc": disc, "bracket": bracket},
            pads={
                "L": Pad(p.pad.mesh, rubber, **common),
                "U": Pad(upper, rubber, base="bracket", origin=at_bracket, mirrored=True, **common),
            },
            contacts={name: Contact(name, "disc", law) for name in ("L", "U")},
            actuators={
                "x": Actuator(
                    f"{k.senses}.x",
                    "bracket.x",
                    control["x"],
                    setpoint="x_d",
                    elements=("C: K_81^-1", "R: R_80"),
                ),
                "y": Actuator(
                    "bracket.y",
                    "bracket.y",
                    control["y"],
                    setpoint="y_d",
                    feed_forward="F_ff",
                    elements=("C: K_98^-1", "R: R_99", "Se: F_y"),
                ),
            },
            reference=reference or hold(x_d=p.scenario.x_C0, y_d=apart(p), F_ff=0.0),
            gravity=p.scenario.gravity,
            symbols={"disc": "C", "bracket": "Br"},
            taxels=taxels,
        )
        self._settings = p

    @property
    def aliases(self) -> Mapping[str, str]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """`NAMES`, but without "disc.radius" where the object is not round: the radius of a box is
        that of its corners."""
        return {
            name: own for name, own in NAMES.items() if name != "disc.radius" or self.shape.round
        }

    def _values(self) -> dict[str, float | int | str | bool]:
        """Current values of the parameters of `Parameters` that this rig has."""
        out: dict[str, float | int | str | bool] = {}
        for name, own in self.aliases.items():
            owner, _, last = own.rpartition(".")
            try:
                out[name] = getattr(self.get_submodule(owner), last).item()
            except AttributeError:  # a part of another kind, which has no such number
                continue
        pad, upper, law = self.pads["L"], self.pads["U"].mesh, self.contacts["L"].law
        out |= {
            f"pad.{name}": getattr(pad.mesh, name)
            for name in ("length", "height", "elements_x", "elements_y")
        }
        out |= {
            "pad.enclosed": isinstance(upper, PadMesh) and upper.bonded_sides,
            "pad.fidelity": "inertial" if pad.inertial else "massless",
        }
        out |= {"contact.points": pad.points, "contact.node_spacing": law.node_spacing}
        if isinstance(law.friction, SmoothSlip | Coulomb):
            out["contact.friction"] = "coulomb" if isinstance(law.friction, Coulomb) else "smooth"
        return out

    @property
    def settings(self) -> Parameters:
        """Current values of the parameters, read from the modules. The scenario, and parameters
        that this rig's parts lack, have the values first given."""
        values: dict[str, dict[str, Any]] = {}
        for name, value in self._values().items():
            group, _, field = name.partition(".")
            values.setdefault(group, {})[field] = value
        groups = {
            group: getattr(self._settings, group).model_copy(update=new)
            for group, new in values.items()
        }
        return self._settings.model_copy(update=groups)

    def description(self) -> dict[str, Any]:
        """Current parameters and laws, without those of `Parameters` that this rig lacks."""
        own, whole = self._values(), super().description()
        absent = {name for name in (*NAMES, "contact.friction") if name not in own}
        given = {
            f"{group}.{field}": value
            for group in Parameters.model_fields
            for field, value in getattr(self._settings, group)
        }
        values = {name: own.get(name, x) for name, x in given.items() if name not in absent}
        others = {
            name: x for name, x in whole["parameters"].items() if name not in self.aliases.values()
        }
        return whole | {"parameters": values | others}

    @property
    def shape(self) -> Shape:
        """Shape of the manipulated object."""
        shape = self.bodies["disc"].shape
        assert shape is not None
        return shape

    def touch_height(self, y_C: Tensor | float) -> Tensor:
        """Height of the bracket's centre [m] at which its undeformed pad just touches the object at
        the height y_C [m]."""
        up, p = torch.tensor([0.0, 1.0], dtype=torch.float64), self._settings
        return y_C + self.shape.support(up) + p.pad.height + p.bracket.cm_height


def apart(p: Parameters) -> float:
    """Height [m] of the bracket above the ground at which both undeformed pads just touch the
    disc."""
    return 2 * (p.pad.height + p.disc.radius) + p.bracket.cm_height
