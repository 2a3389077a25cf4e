"""A rig file: tables, from TOML or from Python, and what is built from them: the rig with its reference, its state at the
start, and the times of its outputs."""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from torchsoft.physics.mesh import Array
from torchsoft.physics.motion import Piecewise, Reference
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.statics import NoEquilibrium, resting, standing
from torchsoft.physics.validity import sound
from torchsoft.rigs.bodies import REST
from torchsoft.rigs.fields import at_field
from torchsoft.rigs.geometry import points, reach, surface
from torchsoft.rigs.motion import MotionContext, flattened
from torchsoft.rigs.schema import RigTables
from torchsoft.tables import from_toml

UPWARDS = 0.1
"""Least upward part of the normal of a pad that something may rest on."""


STIFF = 100.0
"""How many times as stiff as a point of the pad a contact may be for statics to be sure of balance."""


M = TypeVar("M", bound=nn.Module)


class BuiltRig(NamedTuple):
    """A rig with what it follows, its state y0 (size,) at the start, and the times t (T,) [s] of the outputs."""

    rig: Rig
    y0: Tensor
    t: Tensor


def assemble(
    file: RigTables, held: Mapping[str, Mapping[str, float]] | None = None, loops: Collection[str] | None = None
) -> Rig:
    """The rig without a reference; `held` are coordinates that are fixed, by body and axis, and `loops` names its actuators
    (none of a controller), all by default."""
    actuators = {
        name: made(f"actuators.{name}", partial(one.build, file.folder))
        for name, one in file.actuators.items() if loops is None or name in loops
    }  # fmt: skip
    for name, one in file.controllers.items() if loops is None else ():
        with at_field(f"controllers.{name}"):
            actuators |= one.build(name, file.folder)
    materials = {
        name: made(f"materials.{name}", partial(one.build, file.folder)) for name, one in file.materials.items()
    }
    laws = {name: table.build(file.folder) for name, table in file.laws.items()}
    held = held or {}
    return Rig(
        bodies={
            name: made(f"bodies.{name}", partial(one.build, file.folder, dict(held.get(name, {}))))
            for name, one in file.bodies.items()
        },
        pads={
            name: made(f"pads.{name}", partial(one.build, materials[one.material], file.folder))
            for name, one in file.pads.items()
        },
        contacts={name: one.build(laws) for name, one in file.contacts.items()},
        actuators=actuators,
        gravity=file.gravity,
        symbols={name: one.symbol or name for name, one in file.bodies.items()},
    )  # fmt: skip


def made(field: str, build: Callable[[], M]) -> M:
    """What `build` makes, with parameters that are physical together. Raises `ValueError` with the field's name."""
    with at_field(field):
        return sound(build())


def signal(file: RigTables, name: str, pose: Mapping[str, Array] | None) -> Piecewise:
    """One motion, with bodies that start at `pose` (3,)."""
    setpoints = {coordinate for role, coordinate in file.followers()[name] if role == "setpoint"}
    start = None
    if pose is not None and len(setpoints) == 1:
        body, _, axis = setpoints.pop().partition(".")
        start = float(pose[body][COORDINATES.index(axis)])
    asked = MotionContext(name, file.unit(name), start, file.outputs.duration, file.folder)
    try:
        return file.motion[name].build(asked)
    except ValueError as error:
        prefix = "" if str(error).startswith("motion.") else f"motion.{name}: "
        raise ValueError(f"{prefix}{error}") from None


def starts(file: RigTables, driven: Mapping[str, float]) -> dict[str, Array]:
    """Poses (3,) [m, m, rad] by body at the start, those that rest solved for; `driven` are where driven coordinates begin."""
    pose: dict[str, Array] = {}
    wanted: list[tuple[str, str]] = []
    for name, body in file.bodies.items():
        row = []
        for axis, kind in body.freedom.items():
            place = (
                getattr(body.start, axis) if kind == "free" else driven[f"{name}.{axis}"] if kind == "driven" else kind
            )
            if place == REST:
                wanted.append((name, axis))
            row.append(0.0 if place is None or place == REST else float(place))
        pose[name] = np.array(row)
    if not wanted:
        return pose
    held = {
        name: {axis: float(at) for axis, at in zip(COORDINATES, row) if (name, axis) not in wanted}
        for name, row in pose.items()
    }
    rig = assemble(file, held, loops=()).requires_grad_(False)
    for name, axis in wanted:
        if axis == "y":
            pose[name][1] = above(rig, name, pose)
    try:
        found = resting(rig, {name: torch.from_numpy(at) for name, at in pose.items()})
    except NoEquilibrium as error:
        name, axis = wanted[0]
        raise ValueError(too_stiff(file, rig) or f"bodies.{name}.start.{axis}: {error}") from None
    return {name: at.numpy() for name, at in found.items()}


def too_stiff(file: RigTables, rig: Rig) -> str:
    """The law of a contact so much stiffer than its pad that its force is rounding of its depth; empty if there is none."""
    for name, contact in rig.contacts.items():
        give = float(rig.pads[contact.pad].compliance().detach().diagonal().max())
        ratio = float((rig.weight(name) * contact.law.K_n).detach().max()) * give
        if ratio > STIFF:
            law, K_n = file.contacts[name].law, contact.law.K_n.item()
            return (
                f"laws.{law}.K_n: no rest is found with {K_n:g} N/m, {ratio:.2g} times as stiff as the pad `{contact.pad}`"
                f" that it presses; take {K_n * STIFF / ratio:.1g} N/m or less, the pad gives way long before the contact does"
            )
    return ""


def above(rig: Rig, body: str, pose: Mapping[str, Array]) -> float:
    """A height [m] at which a body is clear of the pads under it. Raises `ValueError` where there is none."""
    below = reach(rig, body, pose, np.array([0.0, -1.0]))
    beside = [reach(rig, body, pose, np.array([side, 0.0])) for side in (-1.0, 1.0)]
    heights = []
    for contact in rig.contacts.values():
        at = surface(rig.pads[contact.pad], pose)
        x, places = float(pose[body][0]), points(rig.pads[contact.pad], pose)
        under = (places[:, 0] > x - beside[0]) & (places[:, 0] < x + beside[1])
        if contact.body == body and at.normal[1] > UPWARDS and places[:, 0].min() < x < places[:, 0].max():
            if not under.any():
                raise ValueError(
                    f"bodies.{body}.shape: {1e3 * sum(beside):.3g} mm wide, it falls between points of `{contact.pad}`, which"
                    f" are {1e3 * float(rig.pads[contact.pad].point_lengths.max()):.3g} mm apart; make it "
                    f"larger, or give pads.{contact.pad} more elements or points"
                )
            heights.append(float(places[under, 1].max()) + below)
    if not heights:
        raise ValueError(
            f'bodies.{body}.start.y: "{REST}", but no pad that it has a contact with lies under x = {pose[body][0]:g} m; '
            "place it over one, or say at which height it starts"
        )
    return max(heights)


def output_times(file: RigTables) -> Tensor:
    """Equal intervals, and the times of snapshots [s]."""
    o = file.outputs
    grid = torch.linspace(0, o.duration, max(1, round(o.duration / o.interval)) + 1, dtype=torch.float64)
    more = [t for t in o.snapshots if float((grid - t).abs().min()) > 1e-6]
    return torch.cat((grid, torch.tensor(more, dtype=torch.float64))).sort().values


class RigFile(RigTables):
    """A rig and its run. SI units throughout: m, kg, s, N, rad, Pa; 4.59e-3 is 4.59 mm. The model is planar: x to the right, y
    upwards, theta anticlockwise."""

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read from a TOML file. Raises `ValueError` in one sentence with the file and the field, and `OSError`."""
        file = from_toml(path, cls.from_tree)
        file._folder = Path(path).parent
        return file

    @classmethod
    def from_tree(cls, tree: Any) -> Self:
        """From what TOML makes of a file. Raises `ValueError`."""
        if isinstance(tree, dict) and "motion" in tree:
            tree = tree | {"motion": flattened(tree["motion"])}
        return cls.model_validate(tree)

    def override(self, **groups: dict[str, Any]) -> Self:
        """Another file with some fields replaced: `override(outputs={"duration": 0.1}, pads={"lower": {"elements_x": 30}})`.
        A table of another kind replaces the whole of the old one. Raises `ValueError`."""

        def merged(old: Any, new: Any) -> Any:
            if not (isinstance(old, dict) and isinstance(new, dict)) or new.get("kind", old.get("kind")) != old.get(
                "kind"
            ):
                return new
            return old | {key: merged(old.get(key), value) for key, value in new.items()}

        file = type(self).model_validate(merged(self.model_dump(exclude_unset=True), groups))
        file._folder = self._folder
        return file

    def build(self) -> BuiltRig:
        """What the file describes, ready for `simulate(rig, t, y0=y0)`.

        Pads are settled around the bodies where these start. Raises `ValueError` with the field's name: for motions that cannot
        be, recorded ones that cannot be read, bodies that find no rest, and bodies too deep in a pad for it to settle.
        """
        known = {name: signal(self, name, None) for name, who in self.followers().items() if who[0][0] == "driven"}
        pose = starts(
            self, {name: float(one(torch.zeros((), dtype=torch.float64))[0].detach()) for name, one in known.items()}
        )
        signals = {name: known.get(name) or signal(self, name, pose) for name in self.motion}
        rig = assemble(self)
        rig.reference = Reference(**signals)
        try:
            y0 = standing(rig, {name: torch.from_numpy(at) for name, at in pose.items()})
        except NoEquilibrium as error:
            raise ValueError(
                too_stiff(self, rig) or f"bodies: the pads cannot settle where bodies start: {error}"
            ) from None
        for name, body in self.bodies.items():
            rates = [v for v, axis in zip(body.start.velocity, COORDINATES) if axis in body.free]
            y0[rig.layout.slices["velocity", name]] = torch.tensor(rates, dtype=torch.float64)
        return BuiltRig(rig, y0, output_times(self))
