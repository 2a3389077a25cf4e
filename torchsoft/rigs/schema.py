"""The tables of a rig and its run together: names that are there, coordinates that can be pushed, motions that are followed."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Self

from pydantic import Field, PrivateAttr, model_validator
from torch import nn

from torchsoft.physics.parts import COORDINATES
from torchsoft.quantity import Gravity
from torchsoft.rigs.actuators import ActuatorTable, ControllerTable, Loop
from torchsoft.rigs.bodies import UNITS, BodyTable
from torchsoft.rigs.contacts import ContactTable, LawTable
from torchsoft.rigs.fields import Group
from torchsoft.rigs.materials import MaterialTable
from torchsoft.rigs.motion import MotionTable
from torchsoft.rigs.outputs import OutputsTable, SolverTable
from torchsoft.rigs.pads import AnyPad
from torchsoft.tables import line

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
TAKEN = frozenset(dir(nn.ModuleDict()))
"""Names that parts of a torch module cannot have."""


class RigTables(Group):
    """What a rig and its run consist of, and whether it fits together by its names."""

    title: str = Field(default="", description="what it is")
    gravity: Gravity = Field(default=9.81, description="acts downwards")
    bodies: dict[str, BodyTable] = Field(min_length=1)
    materials: dict[str, MaterialTable] = Field(min_length=1)
    pads: dict[str, AnyPad] = Field(min_length=1)
    laws: dict[str, LawTable] = Field(min_length=1)
    contacts: dict[str, ContactTable] = Field(min_length=1)
    actuators: dict[str, ActuatorTable] = Field(default_factory=dict)
    controllers: dict[str, ControllerTable] = Field(default_factory=dict)
    motion: dict[str, MotionTable] = Field(default_factory=dict)
    outputs: OutputsTable
    solver: SolverTable = SolverTable()
    _folder: Path = PrivateAttr(default_factory=Path)

    @property
    def folder(self) -> Path:
        """Where files that it names are looked for: its own folder, or the working directory."""
        return self._folder

    def coordinates(self) -> Iterator[tuple[str, str, float | str]]:
        """Body, axis and freedom of every coordinate."""
        for name, body in self.bodies.items():
            for axis, kind in body.freedom.items():
                yield name, axis, kind

    def followers(self) -> dict[str, list[tuple[str, str]]]:
        """What follows each motion: roles ("setpoint", "feed_forward" or "driven") and coordinates by the motion's name."""
        out: dict[str, list[tuple[str, str]]] = {}
        for loop in self.loops():
            out.setdefault(loop.setpoint, []).append(("setpoint", loop.measured))
        for actuator in self.actuators.values():
            if actuator.feed_forward is not None:
                out.setdefault(actuator.feed_forward, []).append(("feed_forward", actuator.pushes))
        for body, axis, kind in self.coordinates():
            if kind == "driven":
                out.setdefault(f"{body}.{axis}", []).append(("driven", f"{body}.{axis}"))
        return out

    def loops(self) -> list[Loop]:
        """What follows motions, by actuators and by controllers."""
        groups = *self.actuators.items(), *self.controllers.items()
        return [loop for name, one in groups for loop in one.loops(name)]

    def pushed(self) -> dict[str, str]:
        """The coordinates that are pushed, by the actuators of the rig that do so."""
        own = {name: one.pushes for name, one in self.actuators.items()}
        return own | {key: at for name, one in self.controllers.items() for key, at in one.actuators(name).items()}

    def unit(self, motion: str) -> str:
        """Unit of a motion, from what follows it."""
        (role, coordinate), *_ = self.followers()[motion]
        turns = coordinate.endswith(".theta")
        return ("N.m" if turns else "N") if role == "feed_forward" else UNITS["theta" if turns else "x"]

    @model_validator(mode="after")
    def _names_are_names(self) -> Self:
        for group in ("bodies", "materials", "pads", "laws", "contacts", "actuators", "controllers"):
            for name in getattr(self, group):
                if not NAME.fullmatch(name) or name in TAKEN:
                    why = (
                        "is taken by torch; take another one"
                        if name in TAKEN
                        else "should be letters, digits and underscores"
                    )
                    raise ValueError(f"{group}.{line(name, 80)}: the name {why}")
        return self

    @model_validator(mode="after")
    def _names_are_there(self) -> Self:
        def known(field: str, name: str | None, group: str) -> None:
            there = getattr(self, group)
            if name is not None and name not in there:
                raise ValueError(
                    f"{field}: there is no `{line(name, 80)}` among {group}; there is {', '.join(there) or 'nothing'}"
                )

        for name, pad in self.pads.items():
            known(f"pads.{name}.material", pad.material, "materials")
            known(f"pads.{name}.base", pad.base, "bodies")
            if pad.inertial and pad.base is not None and not isinstance(self.bodies[pad.base].theta, float):
                raise ValueError(
                    f"pads.{name}.inertial: the base `{pad.base}` may turn, which inertial pads cannot; fix its theta"
                )
        for name, contact in self.contacts.items():
            for field, group in (("pad", "pads"), ("body", "bodies"), ("law", "laws")):
                known(f"contacts.{name}.{field}", getattr(contact, field), group)
            if self.bodies[contact.body].shape is None:
                raise ValueError(
                    f"contacts.{name}.body: `{contact.body}` has no shape to touch anything with; give it one"
                )
            if self.pads[contact.pad].base == contact.body:
                raise ValueError(
                    f"contacts.{name}: the pad `{contact.pad}` is bonded to the body `{contact.body}` itself"
                )
        for name in sorted(self.materials.keys() - {pad.material for pad in self.pads.values()}):
            raise ValueError(f"materials.{name}: no pad is made of it; name it as the material of one, or leave it out")
        for name in sorted(self.laws.keys() - {contact.law for contact in self.contacts.values()}):
            raise ValueError(f"laws.{name}: no contact follows it; name it as the law of one, or leave it out")
        for name, actuator in self.actuators.items():
            for field in ("pushes", "measures"):
                self._check_coordinate(f"actuators.{name}.{field}", getattr(actuator, field))
        for name, one in self.controllers.items():
            for field in ("pushes", "measures"):
                for coordinate in getattr(one, field):
                    self._check_coordinate(f"controllers.{name}.{field}", coordinate)
            for taken in sorted(one.actuators(name).keys() & self.actuators.keys()):
                raise ValueError(f"controllers.{name}: one of its efforts would be called `{taken}`, as an actuator is")
        return self

    def _check_coordinate(self, field: str, coordinate: str | None) -> None:
        """Raises `ValueError` for what a loop can neither measure nor push."""
        if coordinate is None:
            return
        body, _, axis = coordinate.partition(".")
        if body not in self.bodies or axis not in COORDINATES:
            there = ", ".join(f"{body}.{axis}" for body, axis, kind in self.coordinates() if kind == "free") or "none"
            raise ValueError(f"{field}: `{line(coordinate, 80)}` is not a coordinate; free ones are {there}")
        kind = self.bodies[body].freedom[axis]
        if kind != "free":
            how = "driven by its motion" if kind == "driven" else f"fixed at {kind:g}"
            verb = "push" if field.endswith("pushes") else "learn"
            raise ValueError(
                f"{field}: {coordinate} is {how}, so that there is nothing to {verb}; make it free, or leave this out"
            )

    @model_validator(mode="after")
    def _motions_are_followed(self) -> Self:
        followers = self.followers()
        for name, who in followers.items():
            role, coordinate = who[0]
            if name not in self.motion:
                why = {
                    "setpoint": f"{coordinate} is to follow it", "feed_forward": f"{coordinate} is to be pushed by it",
                    "driven": "the coordinate is driven by it",
                }[role]  # fmt: skip
                raise ValueError(f"motion.{line(name, 80)} is missing: {why}")
            units = {(r == "feed_forward", c.endswith(".theta")) for r, c in who}
            if len(units) > 1:
                raise ValueError(
                    f"motion.{name} would be in two units: {' and '.join(f'{r} of {c}' for r, c in who)} use it"
                )
        for name in self.motion:
            if name not in followers:
                raise ValueError(
                    f"motion.{line(name, 80)}: nothing follows it; name it as setpoint or feed_forward of an actuator, or make "
                    'a coordinate of that name "driven"'
                )
        return self
