"""A rig file as tables, from TOML or from Python, and its result: the rig with its reference, its
initial state, and the output times."""

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
import torch
from pydantic import Field, PrivateAttr, model_validator
from torch import Tensor

from torchsoft.display import suggestion
from torchsoft.parallel import single_threaded
from torchsoft.physics.material import Series
from torchsoft.physics.mesh import Array
from torchsoft.physics.motion import Piecewise, Reference
from torchsoft.physics.names import check_names, check_unique
from torchsoft.physics.parts import COORDINATES, coordinate_unit
from torchsoft.physics.rig import Rig
from torchsoft.physics.statics import (
    BuiltRig,
    NoEquilibrium,
    massless,
    net_loads,
    resting,
    standing,
)
from torchsoft.physics.validity import sound
from torchsoft.quantity import Gravity, Quantity, Time
from torchsoft.rigs.control import ActuatorTable, ControllerTable, Loop
from torchsoft.rigs.fields import Group, at_field, called_alike, with_entry
from torchsoft.rigs.geometry import AWAY, Scene, above, at, upon
from torchsoft.rigs.motion import HELD, MotionContext, MotionTable, flattened
from torchsoft.rigs.parts import (
    REST,
    TOUCH,
    AnyPad,
    BodyTable,
    ContactTable,
    LawTable,
    MaterialTable,
    TaxelsTable,
)
from torchsoft.solve.trajectory import units
from torchsoft.tables import LISTED, InvalidTable, from_toml, line

M = TypeVar("M")

ENTRY = re.compile(r"(.+?)((?:_\d+)+)")
"""Name of an entry of a list, such as tau_2."""

ROWS = 1_000_000
"""Most outputs of one run."""

STIFF = 100.0
"""Largest stiffness of a contact, over that of a point of its pad, at which a failed equilibrium is
not blamed on the contact."""

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


class OutputsTable(Group):
    """Duration of the run, and files to be written."""

    duration: Annotated[float, Quantity("s", 1e-3, 1e5)] = Field(description="of the run")
    interval: Annotated[float, Quantity("s", 1e-6, 1e3)] = Field(
        default=0.01, description="between outputs"
    )
    figures: bool = Field(default=True, description="write the figures")
    player: bool | None = Field(
        default=None, description="write player.html; as figures says if not given"
    )
    snapshots: Annotated[tuple[Time, ...], LISTED, Field(max_length=12)] = Field(
        default=(),
        description="times of the pictures in snapshots.png; six over the whole run if none is "
        "given [s]",
    )
    video: Literal["gif", "mp4", "none"] = Field(
        default="gif", description="kind of the video, or none; mp4 needs imageio-ffmpeg"
    )
    frames: Annotated[int, Field(ge=2, le=10_000)] = Field(
        default=150, description="pictures of the video, 12 a second"
    )
    follow: str = Field(
        default="",
        description='coordinate under the video, such as "disc.x"; the one that moves most if not '
        "given",
    )

    @model_validator(mode="after")
    def _are_possible(self) -> Self:
        if self.interval > self.duration:
            raise ValueError(
                f"interval = {self.interval:g} s is longer than duration = {self.duration:g} s"
            )
        if self.duration / self.interval > ROWS:
            raise ValueError(
                f"interval = {self.interval:g} s makes more than {ROWS} outputs in "
                f"{self.duration:g} s"
            )
        if late := [time for time in self.snapshots if time > self.duration]:
            raise ValueError(
                f"snapshots: {late[0]:g} s is after the end of the run, duration = "
                f"{self.duration:g} s"
            )
        return self

    def times(self) -> Tensor:
        """Output times [s]: equal intervals, and the times of snapshots."""
        count = max(1, round(self.duration / self.interval)) + 1
        grid = torch.linspace(0, self.duration, count, dtype=torch.float64)
        more = [t for t in self.snapshots if float((grid - t).abs().min()) > 1e-6]
        return torch.cat((grid, torch.tensor(more, dtype=torch.float64))).sort().values


class SolverTable(Group):
    """Choice of steps: by tolerance, or equal ones."""

    rtol: Annotated[float, Quantity("1", 1e-9, 1e-1)] | None = Field(
        default=None, description="relative tolerance; 1e-5 if not given"
    )
    atol: Annotated[float, Quantity("1", 1e-12, 1.0)] | None = Field(
        default=None,
        description="absolute tolerance, in N, mm and rad; a tenth of rtol if not given",
    )
    step: Annotated[float, Quantity("s", 1e-7, 1.0)] | None = Field(
        default=None, description="equal steps no longer than this instead"
    )
    tolerance: Annotated[float, Quantity("N", 1e-10, 1e-3)] = Field(
        default=1e-9, description="Newton's, on every nodal force"
    )

    @model_validator(mode="after")
    def _choose_once(self) -> Self:
        if self.step is not None and (self.rtol or self.atol) is not None:
            raise ValueError(
                "step and rtol (or atol) each say which steps to take; give one of them"
            )
        return self


class RigFile(Group):
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
    channels: dict[str, str] = Field(default_factory=dict)
    outputs: OutputsTable
    solver: SolverTable = SolverTable()
    _folder: Path = PrivateAttr(default_factory=Path)

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read from a TOML file. Raises `ValueError` in one sentence with the file and the field,
        and `OSError`."""
        return from_toml(path, lambda tree: cls.from_tree(tree, Path(path).parent))

    @classmethod
    def from_tree(cls, tree: Any, folder: Path = Path()) -> Self:
        """Read from the parsed TOML of a file in `folder`. Raises `ValueError`."""
        if isinstance(tree, dict) and "motion" in tree:
            tree = tree | {"motion": flattened(tree["motion"])}
        file = cls.model_validate(tree)
        file._folder = folder
        return file

    def override(self, **groups: dict[str, Any]) -> Self:
        """A copy with some fields replaced: `override(outputs={"duration": 0.1}, pads={"lower":
        {"elements_x": 30}})`. Entries of lists are counted from one: tau_2, or gain_1_3, the third
        of the first row. A table of another kind replaces the old one as a whole. Raises
        `ValueError`."""

        def merged(old: Any, new: Any) -> Any:
            both = isinstance(old, dict) and isinstance(new, dict)
            if not both or new.get("kind", old.get("kind")) != old.get("kind"):
                return new
            out = dict(old)
            for key, value in new.items():
                entry = ENTRY.fullmatch(key)
                if entry and key not in old and isinstance(old.get(entry[1]), list | tuple):
                    places = [int(one) for one in entry[2].split("_")[1:]]
                    out[entry[1]] = with_entry(key, out[entry[1]], places, value)
                else:
                    out[key] = merged(old.get(key), value)
            return out

        own = self.model_dump(exclude_unset=True)
        try:
            file = type(self).model_validate(merged(own, groups))
        except InvalidTable as error:
            raise InvalidTable(f"{error}{called_alike(str(error), own, groups)}") from None
        file._folder = self._folder
        return file

    def __reduce__(self) -> Any:  # since tables of parts are no attributes of a module
        return _again, (type(self), self.model_dump(exclude_unset=True), self._folder)

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
        for name, new in self.channels.items():
            check_names(f"channels.{name}", [new], dotted=True)
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

    def assemble(self) -> Rig:
        """The rig without a reference. Raises `ValueError` with the field's name for parts that are
        not physical."""
        folder = self.folder

        def made(group: str, build: Callable[[Any], M]) -> dict[str, M]:
            found = {}
            for name, table in getattr(self, group).items():
                with at_field(f"{group}.{name}"):
                    found[name] = sound(build(table))
            return found

        actuators = made("actuators", lambda one: one.build(folder))
        for name, one in self.controllers.items():
            with at_field(f"controllers.{name}"):
                actuators |= one.build(name, folder)
        materials = made("materials", lambda one: one.build(folder))
        pads = made("pads", lambda one: one.build(materials[one.material], folder))
        pressed = lambda law: [
            pads[c.pad] for c in self.contacts.values() if self.laws[c.law] is law
        ]
        laws = made("laws", lambda one: one.numbers(pressed(one)).build(folder))
        rig = Rig(
            bodies=made("bodies", lambda one: one.build(folder)),
            pads=pads,
            contacts=made("contacts", lambda one: one.build(laws)),
            actuators=actuators,
            gravity=self.gravity,
            symbols={name: one.symbol or name for name, one in self.bodies.items()},
            taxels=made("taxels", lambda one: one.build(folder)),
        )
        known = units(rig)
        for name in self.channels:
            if name not in known:
                raise ValueError(
                    f"channels.{line(name, 80)}: the rig has no such channel; "
                    f"{suggestion(name, known)}"
                )
        rig.renamed = dict(self.channels)
        check_unique(rig)
        named = {self._own_name(rig, *name.split(".")): name for name, _ in rig.named_parameters()}
        rig.aliases = {alias: name for alias, name in named.items() if alias != name}
        return rig

    def _own_name(self, rig: Rig, group: str, part: str = "", *rest: str) -> str:
        """Name in this file of a parameter of its rig, such as "materials.silicone.E"."""
        made = {a: name for name, one in self.controllers.items() for a in one.actuators(name)}
        if group == "pads" and rest[:1] == ("material",):
            material = rig.pads[part].material
            group, part, rest = "materials", self.pads[part].material, rest[1:]
            if isinstance(material, Series):
                last = re.sub(rf"^{material.symbol}(?=_\d)", material.strength, rest[-1])
                rest = (*rest[:-1], last)
        elif group == "contacts" and rest[:1] == ("law",):
            group, part, rest = "laws", self.contacts[part].law, rest[1:]
        elif part in made:
            group, part = "controllers", made[part]
            rest = tuple(one for one in rest if one not in ("law", "module", "feedback"))
        elif group in ("actuators", "bodies"):
            rest = tuple(one for one in rest if one not in ("law", "fixed"))
        last = ["inertia" if name == "own_inertia" else name for name in rest]
        return ".".join([group, part, *last] if part else [group])

    @single_threaded()
    @torch.no_grad()
    def build(self) -> BuiltRig[Rig]:
        """The rig, its initial state and its output times, ready for `simulate(rig, t, y0=y0)`.

        Pads are settled around the bodies where these start. Raises `ValueError` with the field's
        name: for motions that cannot be, recorded ones that cannot be read, bodies that find no
        rest, and bodies too deep in a pad for it to settle.
        """
        rig = self.assemble()
        pose = self._starts(rig)
        rig.reference = self.reference(pose, lambda *arguments: self._held(rig, pose, *arguments))
        try:
            y0 = standing(rig, {name: torch.from_numpy(at) for name, at in pose.items()})
        except NoEquilibrium as error:
            raise ValueError(
                too_stiff(self, rig)
                or f"bodies: the pads cannot settle where bodies start: {error}"
            ) from None
        for name, body in self.bodies.items():
            rates = [v for v, axis in zip(body.start.velocity, COORDINATES) if axis in body.free]
            y0[rig.layout.slices["velocity", name]] = torch.tensor(rates, dtype=torch.float64)
        return BuiltRig(rig, y0, self.outputs.times())

    def reference(
        self, pose: Mapping[str, Array], held: Callable[[str, float], float]
    ) -> Reference:
        """All motions, for bodies that start at `pose` (3,); `held` gives the effort that holds a
        coordinate at a time [s]. Raises `ValueError` naming the field."""
        return Reference(**{name: self._signal(name, pose, held) for name in self.motion})

    def _signal(
        self, name: str, pose: Mapping[str, Array] | None = None,
        held: Callable[[str, float], float] | None = None,
    ) -> Piecewise:  # fmt: skip
        roles: dict[str, set[str]] = {}
        for role, coordinate in self.followers()[name]:
            roles.setdefault(role, set()).add(coordinate)
        (follows, *more), (fed, *others) = (
            sorted(roles.get(role, ())) or [""] for role in ("setpoint", "feed_forward")
        )
        body, axis = at(follows) if follows and not more else ("", 0)
        start = float(pose[body][axis]) if pose is not None and body else None
        effort = partial(held, fed) if held and fed and not others else None
        context = MotionContext(
            name, self.unit(name), start, effort, self.outputs.duration, self.folder
        )
        try:
            return self.motion[name].build(context)
        except ValueError as error:
            prefix = "" if str(error).startswith("motion.") else f"motion.{name}: "
            raise ValueError(f"{prefix}{error}") from None

    def _follow(
        self, pose: dict[str, Array], time: float, roles: Collection[str],
        start: Mapping[str, Array] | None = None,
    ) -> set[tuple[str, int]]:  # fmt: skip
        """Set the coordinates that follow motions in these roles to the motions' values at a time
        [s]; returns those coordinates."""
        moved = set[tuple[str, int]]()
        for name, users in self.followers().items():
            for body, axis in (at(coordinate) for role, coordinate in users if role in roles):
                value, _ = self._signal(name, start)(torch.tensor(time, dtype=torch.float64))
                pose[body][axis] = float(value)
                moved.add((body, axis))
        return moved

    def _starts(self, rig: Rig) -> dict[str, Array]:
        """Initial poses (3,) [m, m, rad] by body, solved for where bodies rest or touch."""
        pose = {name: np.zeros(3) for name in self.bodies}
        for name, axis, kind in self.coordinates():
            given = getattr(self.bodies[name].start, axis) if kind == "free" else kind
            if given == TOUCH or not isinstance(given, str):
                pose[name][COORDINATES.index(axis)] = AWAY if given == TOUCH else given or 0.0
        self._follow(pose, 0.0, ("driven",))
        for name, axes in (resting_axes := self.rests()).items():
            if 1 in axes:
                pose[name][1] = above(Scene(rig, pose), name)
        try:
            pose = self._rested(rig, pose, resting_axes)
        except NoEquilibrium as error:
            name, (axis, *_) = next(iter(resting_axes.items()))
            weight = self.bodies[name].weighted * rig.bodies[name].mass.item() * rig.gravity.item()
            reason = f"no rest under its weight of {weight:.3g} N is found; {error}"
            raise ValueError(
                too_stiff(self, rig) or f"bodies.{name}.start.{COORDINATES[axis]}: {reason}"
            ) from None
        for name, body in self.bodies.items():
            if body.y == "free" and body.start.y == TOUCH:
                pose[name][1] = upon(Scene(rig, pose), name)
        return pose

    def rests(self, but: Collection[tuple[str, int]] = ()) -> dict[str, list[int]]:
        """Coordinates with the start "rest", by body, without those in `but`."""
        out: dict[str, list[int]] = {}
        for name, axis, kind in self.coordinates():
            i = COORDINATES.index(axis)
            rests = kind == "free" and getattr(self.bodies[name].start, axis) == REST
            if rests and (name, i) not in but:
                out.setdefault(name, []).append(i)
        return out

    def _rested(
        self, rig: Rig, pose: Mapping[str, Array], axes: Mapping[str, list[int]]
    ) -> dict[str, Array]:
        """Poses with these coordinates in equilibrium, without efforts of actuators. Raises
        `NoEquilibrium`."""
        if not axes:
            return dict(pose)
        places = {name: torch.from_numpy(x) for name, x in pose.items()}
        still = torch.zeros(len(rig.signals), 2).double()
        found = resting(rig, places, axes, signals=still, actuators=())
        return {name: x.numpy() for name, x in found.items()}

    def _held(self, rig: Rig, start: Mapping[str, Array], coordinate: str, time: float) -> float:
        """The effort [N, N.m] that holds a coordinate, without friction, with bodies at their
        set-points at a time [s], or else where they rest or start. Raises `ValueError`."""
        pose = {name: x.copy() for name, x in start.items()}
        known = self._follow(pose, time, ("driven", "setpoint"), start)
        soft, (body, axis) = massless(rig), at(coordinate)
        still = torch.zeros(len(rig.signals), 2, dtype=torch.float64)
        try:
            pose = self._rested(soft, pose, self.rests(known))
            y = standing(soft, {name: torch.from_numpy(x) for name, x in pose.items()})
        except NoEquilibrium as error:
            raise ValueError(
                f'"{HELD}" asks for balance where set-points are at t = {time:g} s, and there is '
                f"none: {error}"
            ) from None
        return -float(net_loads(soft, soft.unpack(y, still), still, ())[body][axis])


def _again(kind: type[RigFile], tree: Any, folder: Path) -> RigFile:
    """The rig file that was pickled."""
    return kind.from_tree(tree, folder)


def too_stiff(file: RigFile, rig: Rig) -> str:
    """Error message on a contact too stiff for its pad to be solved; empty if there is none."""
    for name, contact in rig.contacts.items():
        give = float(rig.pads[contact.pad].compliance().diagonal().max())
        ratio = float((rig.weight(name) * contact.law.K_n).max()) * give
        if ratio > STIFF:
            law, K_n = file.contacts[name].law, contact.law.K_n.item()
            return (
                f"laws.{law}.K_n: no rest is found with {K_n:g} N/m, {ratio:.2g} times as stiff as "
                f"the pad `{contact.pad}` that it presses; take {K_n * STIFF / ratio:.1g} N/m or "
                "less, the pad gives way long before the contact does"
            )
    return ""
