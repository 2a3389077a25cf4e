"""A rig file as tables, from TOML or from Python, and its result: the rig with its reference, its
initial state, and the output times."""

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import torch
from pydantic import Field, PrivateAttr, model_validator
from torch import nn

from torchsoft.display import Shown, suggestion
from torchsoft.parallel import single_threaded
from torchsoft.physics.channels import units
from torchsoft.physics.names import check_names
from torchsoft.physics.parts import COORDINATES, ORDERS, PD, Actuator, coordinate_unit
from torchsoft.physics.rig import Rig
from torchsoft.physics.start import REST, moving, warn_of_moments
from torchsoft.physics.validity import check_numbers, sound
from torchsoft.quantity import Gravity
from torchsoft.rigs.built import BuiltRig
from torchsoft.rigs.control import ActuatorTable, ControllerTable, Loop
from torchsoft.rigs.fields import Group, at_field, called_alike, with_entry
from torchsoft.rigs.initial import (
    followed_motions,
    holding_effort,
    initial_poses,
    reference,
    setpoints,
    settled_pads,
    signal,
)
from torchsoft.rigs.motion import MotionTable, flattened
from torchsoft.rigs.outputs import OutputsTable, SolverTable
from torchsoft.rigs.parts import (
    AnyPad,
    BodyTable,
    ContactTable,
    LawTable,
    MaterialTable,
    TaxelsTable,
)
from torchsoft.rigs.places import entries, entry, listed, place, replaced, unit
from torchsoft.solve.simulate import Initial
from torchsoft.tables import LISTED, InvalidTable, from_toml, line

M = TypeVar("M")

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


READY = Path(__file__).with_name("ready")
"""Folder of the ready rigs."""

SOURCES = "published", "assumed"
"""First words of a number's source."""

Names = Annotated[tuple[str, ...], LISTED, Field(min_length=1)]


def ready() -> list[str]:
    """Names of the ready rigs."""
    return sorted(path.stem for path in READY.glob("*.toml"))


class RigFile(Shown, Group):
    """A rig and its run. SI units throughout: m, kg, s, N, rad, Pa; 4.59e-3 is 4.59 mm. The model
    is planar: x to the right, y upwards, theta anticlockwise."""

    title: str = Field(default="", description="what it is")
    gravity: Gravity = Field(default=9.81, description="acts downwards")
    bodies: dict[str, BodyTable] = Field(min_length=1)
    materials: dict[str, MaterialTable] = Field(min_length=1)
    pads: dict[str, AnyPad] = Field(min_length=1)
    laws: dict[str, LawTable] = Field(min_length=1)
    contacts: dict[str, ContactTable] = Field(min_length=1)
    taxels: dict[str, TaxelsTable] = Field(default_factory=dict)  # pyright: ignore[reportInvalidTypeForm]
    actuators: dict[str, ActuatorTable] = Field(default_factory=dict)
    controllers: dict[str, ControllerTable] = Field(default_factory=dict)
    motion: dict[str, MotionTable] = Field(default_factory=dict)
    names: dict[str, str | Names] = Field(
        default_factory=dict,
        description="short names of entries of the file and of channels, for typing",
    )
    sources: dict[str, str] = Field(
        default_factory=dict, description="where numbers come from, published or assumed"
    )
    outputs: OutputsTable
    solver: SolverTable = SolverTable()
    _folder: Path = PrivateAttr(default_factory=Path)

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read from a TOML file. Raises `ValueError` in one sentence with the file and the field,
        and `OSError`."""
        return from_toml(path, lambda tree: cls.from_tree(tree, Path(path).parent))

    @classmethod
    def ready(cls, name: str) -> Self:
        """A ready rig, such as "paper". Raises `ValueError` naming those that there are."""
        if name not in ready():
            known = suggestion(name, ready(), "there are")
            raise ValueError(f"there is no ready rig `{line(name, 80)}`; {known}")
        return cls.from_toml(READY / f"{name}.toml")

    @staticmethod
    def path(name: str | Path, folder: Path = Path()) -> Path:
        """Path of a rig file that is named from a folder, or of a ready rig of that name. Raises
        `ValueError` for a file that is not there."""
        path = folder / name
        if not path.exists() and str(name) in ready():
            return READY / f"{name}.toml"
        if not path.exists():
            raise ValueError(
                f"{line(path)}: No such file or directory; the ready rigs are {', '.join(ready())}"
            )
        return path

    @classmethod
    def from_tree(cls, tree: Any, folder: Path = Path()) -> Self:
        """Read from the parsed TOML of a file in `folder`. Raises `ValueError`."""
        if isinstance(tree, dict) and "motion" in tree:
            tree = tree | {"motion": flattened(tree["motion"])}
        file = cls.model_validate(tree)
        file._folder = folder
        return file

    def override(
        self, values: Mapping[str, Any] | None = None, /, **groups: dict[str, Any]
    ) -> Self:
        """A copy with some entries replaced, by their names, full or short, or by tables:
        `override({"materials.rubber.E": 1e6}, outputs={"duration": 0.1})`. Entries of lists are
        counted from one: tau_2, or gain_1_3, the third of the first row.

        A name stands for what is there, of which nothing is left. Tables are merged with those that
        are there; a table of another kind replaces the old one as a whole. What was replaced loses
        its source. Raises `ValueError`.
        """

        def merged(old: Any, new: Any) -> Any:
            both = isinstance(old, dict) and isinstance(new, dict)
            if not both or new.get("kind", old.get("kind")) != old.get("kind"):
                return new
            out = dict(old)
            for key, value in new.items():
                name, within = entry(key, old)
                if within and isinstance(old[name], list | tuple):
                    out[name] = with_entry(key, out[name], within, value)
                else:
                    out[key] = merged(old.get(key), value)
            return out

        file, own = self, self.model_dump(exclude_unset=True) if groups else {}
        try:
            if groups:
                file = type(self).from_tree(self._still_true(merged(own, groups)), self._folder)
        except InvalidTable as error:
            raise InvalidTable(f"{error}{called_alike(str(error), own, groups)}") from None
        if not values:
            return file
        full = {name: value for key, value in values.items() for name in file.full(key)}
        return type(self).from_tree(file._still_true(replaced(file, full)), self._folder)

    def changed(self, settings: Mapping[str, Any], /) -> Self:
        """A copy with some entries replaced as by `override`, names and tables in one. Raises
        `ValueError`."""
        names = {key: x for key, x in settings.items() if "." in key or key in self.names}
        return self.override(names, **{key: x for key, x in settings.items() if key not in names})

    def _still_true(self, tree: dict[str, Any]) -> dict[str, Any]:
        """Changed tables of this file, without sources of numbers that are others now and names of
        entries that are gone."""

        def value(name: str, tree: Any = tree, above: int = 0) -> Any:
            node, keys = tree, place(self, name).keys
            for key in keys[: len(keys) - above]:
                many = range(len(node)) if isinstance(node, list | tuple) else ()
                if key not in (node if isinstance(node, Mapping) else many):
                    return None
                node = node[key]  # pyright: ignore[reportCallIssue, reportArgumentType]
            return listed(node)

        def gone(name: str) -> bool:
            if "." not in name or value(name) is not None:
                return False
            table, before = value(name, above=1), value(name, own, above=1) or {}
            kept = isinstance(table, dict) and table.get("kind") == before.get("kind")
            return not kept or value(name, own) is not None  # one by default is still there

        own = self.model_dump(exclude_unset=True)
        for name in tree.get("sources", {}).keys() & self.sources.keys():
            if value(name) != value(name, own):
                tree = tree | {"sources": {k: x for k, x in tree["sources"].items() if k != name}}
        kept = {
            short: full for short, full in tree.get("names", {}).items()
            if short not in self.names or not any(map(gone, self.full(short)))
        }  # fmt: skip
        return tree | ({"names": kept} if "names" in tree else {})

    def full(self, name: str) -> tuple[str, ...]:
        """What a name stands for: entries or a channel, itself if it is not a short one."""
        found = self.names.get(name, name)
        return (found,) if isinstance(found, str) else found

    def __getitem__(self, name: str) -> Any:
        """Value of an entry, by its name, full or short. Raises `ValueError` for an unknown one."""
        return place(self, self.full(name)[0]).value

    def table(self) -> dict[str, dict[str, Any]]:
        """Every number that the file states, by its name: value, unit, source ("published" or
        "assumed", and where) and meaning."""
        hidden = "names.", "sources.", "outputs.", "title"
        return {
            name: {
                "value": value, "unit": self.unit_of(name),
                "source": self.sources.get(name, "assumed"), "meaning": field.description or "",
            }
            for name, value, field in entries(self)
            if not name.startswith(hidden) and type(value) in (float, int, tuple)
        }  # fmt: skip

    def unit_of(self, name: str) -> str:
        """Unit of an entry by its name, full or short, "1" for one without. Raises `ValueError` for
        an unknown name."""
        keys, _, field = place(self, self.full(name)[0])
        own, (group, *way) = unit(field) or "1", keys
        if not re.search(r",| or ", own) or len(way) < 2:
            return own
        if group == "motion":
            return self.unit(str(way[0]))
        if group == "actuators":
            one = self.actuators[str(way[0])]
            order, pushed, measured = ORDERS.get(str(way[1])), one.pushes, one.measured
        else:
            part, _, row, column = way if len(way) == 4 else (*way, 0, 0)
            one = self.controllers[str(part)]
            order, number = divmod(int(column), len(one.measures))
            pushed, measured = one.pushes[int(row)], one.measures[number]
        loop = Actuator(measured, pushed, PD(1.0, 1.0), setpoint="w")
        return loop.effort_unit if order is None else loop.gain_unit(order)

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        return f"RigFile: {self.title or 'a rig'}", [
            (name, f"{line(row['value'], 40)} {row['unit']}; {row['source']}")
            for name, row in self.table().items()
        ]

    def __reduce__(self) -> Any:  # since tables of parts are no attributes of a module
        return _again, (type(self), self.model_dump(exclude_unset=True), self._folder)

    __str__ = Shown.__repr__  # pyright: ignore[reportAssignmentType]

    @property
    def folder(self) -> Path:
        """Base of relative file names: the folder of the rig file, or the working directory."""
        return self._folder

    def coordinates(self) -> Iterator[tuple[str, str, float | str]]:
        """Body, axis and freedom of every coordinate."""
        for name, body in self.bodies.items():
            for axis, kind in body.freedom.items():
                yield name, axis, kind

    def loops(self) -> list[Loop]:
        """Control loops of all actuators and controllers."""
        groups = *self.actuators.items(), *self.controllers.items()
        return [loop for name, one in groups for loop in one.loops(name)]

    def followers(self) -> dict[str, list[tuple[str, str]]]:
        """Followers of each motion: roles ("setpoint", "feed_forward" or "driven") and coordinates
        by the motion's name."""
        fed = [
            (one.feed_forward, "feed_forward", one.pushes)
            for one in self.actuators.values()
            if one.feed_forward
        ]
        driven = [f"{body}.{axis}" for body, axis, kind in self.coordinates() if kind == "driven"]
        out: dict[str, list[tuple[str, str]]] = {}
        for motion, role, coordinate in (
            *((loop.setpoint, "setpoint", loop.measured) for loop in self.loops()), *fed,
            *((name, "driven", name) for name in driven),
        ):  # fmt: skip
            out.setdefault(motion, []).append((role, coordinate))
        return out

    def unit(self, motion: str) -> str:
        """Unit of a motion, from its followers."""
        (role, coordinate), *_ = self.followers()[motion]
        return (
            coordinate_unit(coordinate)
            if role != "feed_forward"
            else "N.m"
            if coordinate.endswith(".theta")
            else "N"
        )

    @model_validator(mode="after")
    def _names_are_names(self) -> Self:
        for group in (*PARTS, "motion"):
            check_names(group, getattr(self, group), dotted=group == "motion")
        for name, body in self.bodies.items():
            check_names(f"bodies.{name}.symbol", [body.symbol] if body.symbol else [])
        for short in self.names:
            for name in self.full(short):
                try:
                    _ = "." not in name or place(self, name)
                except ValueError as error:
                    raise ValueError(f"names.{short}: {error}") from None
        for name, text in self.sources.items():
            if not text.startswith(SOURCES):
                raise ValueError(
                    f'sources.{name}: it should begin with "published" or "assumed", not '
                    f"{line(text, 40)}"
                )
            try:
                place(self, name)
            except ValueError as error:
                raise ValueError(f"sources.{error}") from None
        return self

    @model_validator(mode="before")
    @classmethod
    def _has_names(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and "channels" in data:
            raise ValueError(
                "channels is not known: channels have one name each; say [names], the short name "
                'first: theta = "theta_C"'
            )
        return data

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

    def assemble(self, parts: Mapping[str, Any] | None = None) -> Rig:
        """The rig without a reference; `parts` are as of `build`. Raises `ValueError` with the
        field's name for parts that are not physical."""
        folder, left = self.folder, dict(parts or {})

        def made(group: str, build: Callable[[str, Any], M]) -> dict[str, M]:
            found = {}
            for name, table in getattr(self, group).items():
                with at_field(f"{group}.{name}"):
                    own = left.pop(f"{group}.{name}", None)
                    found[name] = sound(build(name, table) if own is None else checked(own))
            return found

        def law(name: str, table: Any) -> Any:
            pressed = [pads[c.pad] for c in self.contacts.values() if c.law == name]
            with at_field("friction"):
                friction = checked(left.pop(f"laws.{name}.friction", None))
            return table.matched_to(pressed, folder, friction)

        def shape(body: str) -> Any:
            with at_field("shape"):
                return checked(left.pop(f"bodies.{body}.shape", None))

        actuators = made("actuators", lambda _, one: one.build(folder))
        for name, one in self.controllers.items():
            with at_field(f"controllers.{name}"):
                actuators |= one.build(name, folder)
        materials = made("materials", lambda _, one: one.build(folder))
        pads = made("pads", lambda _, one: one.build(materials[one.material], folder))
        laws = made("laws", law)
        rig = Rig(
            bodies=made("bodies", lambda name, one: one.build(folder, shape(name))),
            pads=pads,
            contacts=made("contacts", lambda _, one: one.build(laws)),
            actuators=actuators,
            gravity=self.gravity,
            symbols={name: one.symbol or name for name, one in self.bodies.items()},
            taxels=made("taxels", lambda _, one: one.build(folder)),
        )
        for name in left:
            known = [f"{group}.{key}" for group in PARTS[:-1] for key in getattr(self, group)]
            known += [f"laws.{key}.friction" for key in self.laws]
            known += [f"bodies.{key}.shape" for key in self.bodies]
            raise ValueError(
                f"parts: there is no part `{line(name, 80)}` in the file; {suggestion(name, known)}"
            )
        named = {own_name(self, rig, *name.split(".")): name for name, _ in rig.named_parameters()}
        rig.aliases = {alias: name for alias, name in named.items() if alias != name}
        rig.short = short_names(self, rig, named)
        rig.matched = {
            f"laws.{self.contacts[name].law}.{key}": f"contacts.{name}.law.{key}"
            for name, contact in rig.contacts.items() for key in contact.law.matched
        }  # fmt: skip
        if not parts:
            rig.tables = self.model_dump(mode="json", exclude_unset=True)
        return rig

    @single_threaded()
    @torch.no_grad()
    def build(self, parts: Mapping[str, Any] | None = None) -> BuiltRig:
        """The rig, its initial state and its output times, ready to `run`.

        `parts` are parts of your own, by the names of those that they replace: a friction law by
        "laws.steel.friction", a shape by "bodies.disc.shape", any other by its table, such as
        "materials.rubber". Pads are settled around the bodies where these start. Raises
        `ValueError` with the field's name: for motions that cannot be, recorded ones that cannot be
        read, bodies that find no rest, and bodies too deep in a pad for it to settle.
        """
        rig = self.assemble(parts)
        starts = {name: body.given for name, body in self.bodies.items()}
        driven = [f"{body}.{axis}" for body, axis, kind in self.coordinates() if kind == "driven"]
        poses = initial_poses(self, rig, {name: signal(self, name) for name in driven})
        held = partial(holding_effort, self, rig, poses, setpoints(self, poses))
        rig.reference = reference(self, poses, held)
        y0 = settled_pads(self, rig, poses, rig.reference)
        warn_of_moments(rig, y0, starts)
        followed = followed_motions(self, poses, held, rig.reference)
        solver, y0 = self.solver.model_dump(exclude_none=True), moving(rig, y0, starts)
        built = BuiltRig(rig, y0, self.outputs.times(), self, followed, solver)
        built.last.update(key=built.key(rig), start=Initial(y0, rig.reference))
        return built

    def rests(self, but: Collection[tuple[str, int]] = ()) -> dict[str, list[int]]:
        """Coordinates with the start "rest", by body, without those in `but`."""
        out: dict[str, list[int]] = {}
        for name, axis, kind in self.coordinates():
            i = COORDINATES.index(axis)
            rests = kind == "free" and getattr(self.bodies[name].start, axis) == REST
            if rests and (name, i) not in but:
                out.setdefault(name, []).append(i)
        return out


def checked(part: M) -> M:
    """A part of one's own whose numbers are in bounds. Raises `ValueError` where they are not."""
    if isinstance(part, nn.Module):
        check_numbers(part)
    return part


def short_names(file: RigFile, rig: Rig, parameters: Collection[str]) -> dict[str, str]:
    """Short names of the rig's parameters and channels. Raises `ValueError`."""
    known, out = units(rig), dict[str, str]()
    for short in file.names:
        if short in known or short in parameters:
            raise ValueError(f"names.{short}: it is the name of something else already")
        full = file.full(short)
        for name in full:
            if "." not in name and name not in known:
                raise ValueError(
                    f"names.{short}: the rig has no channel `{line(name, 80)}`; "
                    f"{suggestion(name, known)}"
                )
        if len(full) == 1 and (full[0] in known or full[0] in parameters):
            out[short] = full[0]
    return out


def own_name(file: RigFile, rig: Rig, group: str, part: str = "", *rest: str) -> str:
    """Name in the file of a parameter of its rig, such as "materials.silicone.E"."""
    made = {a: name for name, one in file.controllers.items() for a in one.actuators(name)}
    if group == "pads" and rest[:1] == ("material",):
        material = rig.pads[part].material
        group, part, rest = "materials", file.pads[part].material, rest[1:]
        symbol, _, number = rest[-1].rpartition("_")
        if symbol in material.lists and number.isdigit():
            rest = (*rest[:-1], f"{material.lists[symbol]}_{number}")
    elif group == "contacts" and rest[:1] == ("law",):
        group, part, rest = "laws", file.contacts[part].law, rest[1:]
    elif part in made:
        group, part = "controllers", made[part]
        rest = tuple(one for one in rest if one not in ("law", "module", "feedback"))
    elif group == "actuators":
        rest = tuple(one for one in rest if one != "law")
    elif group == "bodies":
        rest = tuple(one for one in rest if one not in ("fixed", "contour"))
        rest = rest[1:] if rest[-1].startswith("centre_") else rest
    last = ["inertia" if name == "own_inertia" else name for name in rest]
    return ".".join([group, part, *last] if part else [group])


def _again(kind: type[RigFile], tree: Any, folder: Path) -> RigFile:
    """The rig file that was pickled."""
    return kind.from_tree(tree, folder)
