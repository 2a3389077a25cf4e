"""Tables of a rig file, and the rules between them."""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, PrivateAttr, model_validator

from torchsoft.physics.names import check_names
from torchsoft.physics.parts import COORDINATES, coordinate_unit
from torchsoft.physics.start import REST, Starts
from torchsoft.quantity import Gravity
from torchsoft.rigs.control import ActuatorTable, ControllerTable, Loop
from torchsoft.rigs.fields import Group
from torchsoft.rigs.motion import MotionTable
from torchsoft.rigs.outputs import OutputsTable, SolverTable
from torchsoft.rigs.parts import (
    AnyPad,
    BodyTable,
    ContactTable,
    LawTable,
    MaterialTable,
    TaxelsTable,
)
from torchsoft.rigs.places import place
from torchsoft.tables import LISTED, line

PARTS = (
    "bodies", "materials", "pads", "laws", "contacts", "taxels", "actuators", "controllers",
)  # fmt: skip
"""Tables of parts, by name."""

REFERENCES = (
    ("pads", "material", "materials"), ("pads", "base", "bodies"), ("contacts", "pad", "pads"),
    ("contacts", "body", "bodies"), ("contacts", "law", "laws"), ("taxels", "pad", "pads"),
)  # fmt: skip
"""Fields that name an entry of another table, and that table."""

USED = {
    "materials": ("pads", "material", "no pad is made of it; name it as the material of one"),
    "laws": ("contacts", "law", "no contact follows it; name it as the law of one"),
}
"""Tables whose every entry must be named by others, with the naming table and field."""

SOURCES = "published", "assumed"
"""First words of a number's source."""

Names = Annotated[tuple[str, ...], LISTED, Field(min_length=1)]


class RigTables(Group):
    """All tables of a rig file."""

    title: str = Field(default="", description="title of the rig")
    gravity: Gravity = Field(default=9.81, description="gravitational acceleration, downwards")
    bodies: dict[str, BodyTable] = Field(min_length=1)
    """rigid bodies, by name"""
    materials: dict[str, MaterialTable] = Field(min_length=1)
    """materials of pads, by name"""
    pads: dict[str, AnyPad] = Field(min_length=1)
    """soft pads, by name"""
    laws: dict[str, LawTable] = Field(min_length=1)
    """contact laws, by name"""
    contacts: dict[str, ContactTable] = Field(min_length=1)
    """pairs of a pad and a body that may touch, by name"""
    taxels: dict[str, TaxelsTable] = Field(default_factory=dict)  # pyright: ignore[reportInvalidTypeForm]
    """arrays of taxels on pads, by name"""
    actuators: dict[str, ActuatorTable] = Field(default_factory=dict)
    """single actuators, by name"""
    controllers: dict[str, ControllerTable] = Field(default_factory=dict)
    """controllers of several coordinates, by name"""
    motion: dict[str, MotionTable] = Field(default_factory=dict)
    """set-points, efforts fed forward and motions of driven coordinates, by name"""
    names: dict[str, str | Names] = Field(
        default_factory=dict,
        description="aliases of entries of the file and of channels",
    )
    sources: dict[str, str] = Field(
        default_factory=dict, description="published or assumed, and where, by the name of a value"
    )
    outputs: OutputsTable
    """duration of the run, and files to write"""
    solver: SolverTable = SolverTable()
    """choice of the steps"""
    _folder: Path = PrivateAttr(default_factory=Path)

    @property
    def folder(self) -> Path:
        """Base of relative file names: the folder of the rig file, or the working directory."""
        return self._folder

    def full(self, name: str) -> tuple[str, ...]:
        """What a name stands for: entries or a channel, itself if it is not a short one."""
        found = self.names.get(name, name)
        return (found,) if isinstance(found, str) else found

    def __getitem__(self, name: str) -> Any:
        """Value of an entry, by its name, full or short. Raises `ValueError` for an unknown one."""
        return place(self, self.full(name)[0]).value

    def coordinates(self) -> Iterator[tuple[str, str, float | str]]:
        """Body, axis and freedom of every coordinate."""
        for name, body in self.bodies.items():
            for axis, kind in body.freedom.items():
                yield name, axis, kind

    def loops(self) -> list[Loop]:
        """Control loops of all actuators and controllers."""
        groups = *self.actuators.items(), *self.controllers.items()
        return [loop for name, one in groups for loop in one.loops(name)]

    @property
    def starts(self) -> Starts:
        """Coordinates and rates at which bodies start, by body."""
        return {name: body.given for name, body in self.bodies.items()}

    @property
    def driven(self) -> list[str]:
        """The coordinates that their motions drive, such as "table.theta"."""
        return [f"{body}.{axis}" for body, axis, kind in self.coordinates() if kind == "driven"]

    def followers(self) -> dict[str, list[tuple[str, str]]]:
        """Followers of each motion: roles ("setpoint", "feed_forward" or "driven") and coordinates
        by the motion's name."""
        users = [(loop.setpoint, "setpoint", loop.measured) for loop in self.loops()]
        users += [
            (one.feed_forward, "feed_forward", one.pushes)
            for one in self.actuators.values() if one.feed_forward
        ]  # fmt: skip
        users += [(name, "driven", name) for name in self.driven]
        out: dict[str, list[tuple[str, str]]] = {}
        for motion, role, coordinate in users:
            out.setdefault(motion, []).append((role, coordinate))
        return out

    def unit(self, motion: str) -> str:
        """Unit of a motion, from its followers."""
        (role, coordinate), *_ = self.followers()[motion]
        if role == "feed_forward":
            return "N.m" if coordinate.endswith(".theta") else "N"
        return coordinate_unit(coordinate)

    def rests(self, but: Collection[tuple[str, int]] = ()) -> dict[str, list[int]]:
        """Coordinates with the start "rest", by body, without those in `but`."""
        out: dict[str, list[int]] = {}
        for name, axis, kind in self.coordinates():
            i = COORDINATES.index(axis)
            rests = kind == "free" and getattr(self.bodies[name].start, axis) == REST
            if rests and (name, i) not in but:
                out.setdefault(name, []).append(i)
        return out

    @model_validator(mode="after")
    def _names_are_names(self) -> Self:
        for group in (*PARTS, "motion"):
            check_names(group, getattr(self, group), dotted=group == "motion")
        for name, body in self.bodies.items():
            check_names(f"bodies.{name}.symbol", [body.symbol] if body.symbol else [])
        for name, text in self.sources.items():
            if not text.startswith(SOURCES):
                raise ValueError(
                    f'sources.{name}: it should begin with "published" or "assumed", not '
                    f"{line(text, 40)}"
                )
        entries = [(f"names.{short}: ", name) for short in self.names for name in self.full(short)]
        for field, name in entries + [("sources.", name) for name in self.sources]:
            try:
                _ = ("." not in name and field != "sources.") or place(self, name)
            except ValueError as error:
                raise ValueError(f"{field}{error}") from None
        return self

    @model_validator(mode="after")
    def _names_are_there(self) -> Self:
        for group, field, others in REFERENCES:
            there = getattr(self, others)
            for key, table in getattr(self, group).items():
                name = getattr(table, field)
                if name is not None and name not in there:
                    raise ValueError(
                        f"{group}.{key}.{field}: there is no `{line(name, 80)}` among {others}; "
                        f"there is {', '.join(there) or 'nothing'}"
                    )
        for name, pad in self.pads.items():
            if (
                pad.inertial
                and pad.base is not None
                and not isinstance(self.bodies[pad.base].theta, float)
            ):
                raise ValueError(
                    f"pads.{name}.inertial: the base `{pad.base}` may turn, which inertial pads "
                    "cannot; fix its theta"
                )
        for name, contact in self.contacts.items():
            if self.bodies[contact.body].shape is None:
                raise ValueError(
                    f"contacts.{name}.body: `{contact.body}` has no shape to touch anything with; "
                    "give it one"
                )
            if self.pads[contact.pad].base == contact.body:
                raise ValueError(
                    f"contacts.{name}: the pad `{contact.pad}` is bonded to the body "
                    f"`{contact.body}` itself"
                )
        for name in sorted(self.taxels.keys() & self.contacts.keys()):
            raise ValueError(
                f"taxels.{name}: a contact is called `{name}` too, whose forces have the same "
                "names; call one of them otherwise"
            )
        for group, (others, field, reason) in USED.items():
            named = {getattr(other, field) for other in getattr(self, others).values()}
            for name in sorted(getattr(self, group).keys() - named):
                raise ValueError(f"{group}.{name}: {reason}, or leave it out")
        return self

    @model_validator(mode="after")
    def _coordinates_are_free(self) -> Self:
        for group in ("actuators", "controllers"):
            for name, one in getattr(self, group).items():
                for field in ("pushes", "measures"):
                    given = getattr(one, field) or ()
                    for coordinate in (given,) if isinstance(given, str) else given:
                        self._check_coordinate(f"{group}.{name}.{field}", coordinate)
        efforts = dict.fromkeys(self.actuators, "an actuator")
        for name, one in self.controllers.items():
            for made in one.actuators(name):
                if made in efforts:
                    raise ValueError(
                        f"controllers.{name}: one of its efforts would be called `{made}`, as "
                        f"{efforts[made]} is"
                    )
                efforts[made] = f"one of controllers.{name}"
        return self

    def _check_coordinate(self, field: str, coordinate: str) -> None:
        """Raises `ValueError` for a coordinate that is unknown or not free."""
        kinds = {f"{body}.{axis}": kind for body, axis, kind in self.coordinates()}
        if coordinate not in kinds:
            there = ", ".join(name for name, kind in kinds.items() if kind == "free") or "none"
            raise ValueError(
                f"{field}: `{line(coordinate, 80)}` is not a coordinate; free ones are {there}"
            )
        if (kind := kinds[coordinate]) != "free":
            kinematics = "driven by its motion" if kind == "driven" else f"fixed at {kind:g}"
            verb = "push" if field.endswith("pushes") else "learn"
            raise ValueError(
                f"{field}: {coordinate} is {kinematics}, so that there is nothing to {verb}; make "
                "it free, or leave this out"
            )

    @model_validator(mode="after")
    def _motions_are_followed(self) -> Self:
        followers = self.followers()
        for name, users in followers.items():
            role, coordinate = users[0]
            if name not in self.motion:
                reason = f"it is the {role} of" if role != "driven" else "it drives"
                raise ValueError(
                    f"motion.{line(name, 80)} is missing: {reason} {coordinate}; give a motion, "
                    'such as {kind = "hold", value = 0.0}'
                )
            if len({(r == "feed_forward", c.endswith(".theta")) for r, c in users}) > 1:
                raise ValueError(
                    f"motion.{name} would be in two units: "
                    f"{' and '.join(f'{r} of {c}' for r, c in users)} use it"
                )
        for name in self.motion:
            if name not in followers:
                raise ValueError(
                    f"motion.{line(name, 80)}: nothing follows it; name it as setpoint or "
                    "feed_forward of an actuator, or make "
                    'a coordinate of that name "driven"'
                )
        return self
