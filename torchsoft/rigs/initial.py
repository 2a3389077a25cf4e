"""Where the bodies of a rig file start and which motions its rig follows: functions of the rig's
parameters, differentiable in them."""

from collections.abc import Callable, Collection, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsoft.physics.motion import Piecewise, Reference
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.start import NoPlace, Poses, placed
from torchsoft.physics.statics import (
    NoEquilibrium,
    no_signals,
    resting,
    standing,
    standing_loads,
)
from torchsoft.rigs.geometry import at
from torchsoft.rigs.motion import HELD, MotionContext
from torchsoft.rigs.schema import RigTables

Held = Callable[[str, float], Tensor]
"""Effort () [N, N.m] that holds a coordinate at a time [s]."""

Signals = Mapping[str, Piecewise] | Reference
"""Signals by name."""

STIFF = 100.0
"""Largest stiffness of a contact, over that of a point of its pad, at which a failed equilibrium is
not blamed on the contact."""


def initial_poses(file: RigTables, rig: Rig, driven: Mapping[str, Piecewise]) -> Poses:
    """Initial poses (3,) [m, m, rad] by body; `driven` gives the motions of driven coordinates.
    Raises `ValueError` naming the field."""
    none = torch.zeros((), dtype=torch.float64)
    held = {name: [body.fixed.get(axis, none) for axis in COORDINATES]
            for name, body in rig.bodies.items()}  # fmt: skip
    for name, one in driven.items():
        body, axis = at(name)
        held[body][axis] = one(none)[0]
    try:
        return placed(rig, file.starts, {name: torch.stack(rows) for name, rows in held.items()})
    except NoPlace as error:
        raise ValueError(f"bodies.{error.body}.start.{error.axis}: {error.reason}") from None
    except NoEquilibrium as error:
        name, (axis, *_) = next(iter(file.rests().items()))
        weight = file.bodies[name].weighted * rig.bodies[name].mass.item() * rig.gravity.item()
        reason = f"no rest under its weight of {weight:.3g} N is found; {error}"
        raise ValueError(
            too_stiff(file, rig) or f"bodies.{name}.start.{COORDINATES[axis]}: {reason}"
        ) from None


def settled_pads(file: RigTables, rig: Rig, poses: Poses, reference: Reference) -> Tensor:
    """State (size,) of bodies that stand at `poses`, their pads settled around them, at the start
    of a reference. Raises `ValueError`."""
    try:
        return standing(rig, poses, 0.0, reference)
    except NoEquilibrium as error:
        raise ValueError(
            too_stiff(file, rig) or f"bodies: the pads cannot settle where bodies start: {error}"
        ) from None


def signal(
    file: RigTables, name: str, poses: Mapping[str, Tensor] | None = None, held: Held | None = None
) -> Piecewise:
    """One motion, for bodies that start at `poses`. Raises `ValueError` naming the field."""
    follower, fed = sole_user(file, name, "setpoint"), sole_user(file, name, "feed_forward")
    start = placed_at(poses, follower) if poses is not None and follower else None
    effort = partial(held, fed) if held and fed else None
    context = MotionContext(
        name, file.unit(name), start, effort, file.outputs.duration, file.folder
    )
    try:
        return file.motion[name].build(context)
    except ValueError as error:
        prefix = "" if str(error).startswith("motion.") else f"motion.{name}: "
        raise ValueError(f"{prefix}{error}") from None


def ordered(file: RigTables) -> list[str]:
    """Names of motions, those that coordinates follow before those that are fed forward."""
    return sorted(file.motion, key=lambda name: bool(sole_user(file, name, "feed_forward")))


def reference(
    file: RigTables, poses: Mapping[str, Tensor], held: Callable[[Signals, str, float], Tensor]
) -> Reference:
    """All motions, for bodies that start at `poses`; `held` is the effort that holds a coordinate
    at a time where signals are. Raises `ValueError` naming the field."""
    made = dict[str, Piecewise]()
    known = cache(partial(held, made))
    for name in ordered(file):
        made[name] = signal(file, name, poses, known)
    return Reference(**{name: made[name] for name in file.motion})


def sole_user(file: RigTables, motion: str, role: str) -> str:
    """The one coordinate that uses a motion in a role; empty where there is none, or several."""
    users = {coordinate for one, coordinate in file.followers()[motion] if one == role}
    return users.pop() if len(users) == 1 else ""


def placed_at(poses: Mapping[str, Tensor], coordinate: str) -> Tensor:
    """Value () [m or rad] of a coordinate such as "disc.x"."""
    body, axis = at(coordinate)
    return poses[body][axis]


class FollowedStart(NamedTuple):
    """The coordinate whose start the values of a motion follow, such as "bracket.y", its place
    [m or rad] when they were made, and their derivatives (k,) or (1,) with respect to it."""

    coordinate: str
    place: float
    weights: tuple[float, ...]

    def shift(self, poses: Mapping[str, Tensor]) -> Tensor:
        """Change (k,) or (1,) of the values for bodies that start at `poses`."""
        moved = placed_at(poses, self.coordinate) - self.place
        return moved * torch.tensor(self.weights, dtype=torch.float64)


class Followed(NamedTuple):
    """A motion with values given as "start" or "held": the signal and its values (k,) as built, and
    the start that they follow."""

    signal: Piecewise
    values: Tensor
    start: FollowedStart | None


def followed_motions(
    file: RigTables, poses: Mapping[str, Tensor], built: Reference
) -> dict[str, Followed]:
    """Motions with values given as "start" or "held", by name, those that coordinates follow before
    those that are fed forward; as built for bodies that start at `poses`."""
    out = {}
    for name in ordered(file):
        motion = file.motion[name]
        if not motion.follows_start:
            continue
        start = None
        if any(weights := motion.start_weights):
            follower = sole_user(file, name, "setpoint")
            start = FollowedStart(follower, float(placed_at(poses, follower)), tuple(weights))
        one: Any = built[name]
        out[name] = Followed(one, one.values.detach().clone(), start)
    return out


def holding_effort(
    file: RigTables, rig: Rig, start: Poses, signals: Signals, coordinate: str, time: float
) -> Tensor:
    """The effort () [N, N.m] that holds a coordinate, without friction, with bodies at their
    set-points at a time [s], or else where they rest or start. Raises `ValueError`."""
    poses, known = at_setpoints(file, start, signals, time)
    rests = file.rests(known)
    try:
        if rests:
            poses = resting(rig, poses, rests, signals=no_signals(rig), actuators=())
        loads = standing_loads(rig, poses)
    except NoEquilibrium as error:
        raise ValueError(
            f'"{HELD}" asks for balance where set-points are at t = {time:g} s, and there is '
            f"none: {error}"
        ) from None
    return -placed_at(loads, coordinate)


def at_setpoints(
    file: RigTables, start: Poses, signals: Signals, time: float
) -> tuple[Poses, Collection[tuple[str, int]]]:
    """Poses at a time [s] of bodies that follow set-points and drives exactly and start at `start`,
    and the coordinates that do, by body and axis."""
    rows = {name: list(pose.unbind()) for name, pose in start.items()}
    moved, t = set[tuple[str, int]](), torch.tensor(time, dtype=torch.float64)
    for name, users in file.followers().items():
        for body, axis in (at(one) for role, one in users if role in ("driven", "setpoint")):
            rows[body][axis] = signals[name](t)[0]
            moved.add((body, axis))
    return {name: torch.stack(row) for name, row in rows.items()}, moved


def too_stiff(file: RigTables, rig: Rig) -> str:
    """Error message on a contact too stiff for its pad to be solved; empty if there is none."""
    for name, contact in rig.contacts.items():
        give = float(rig.pads[contact.pad].compliance().diagonal().max())
        ratio = float((rig.weight(name) * contact.law.K_n).max()) * give
        if ratio > STIFF:
            law, K_n = file.contacts[name].law, contact.law.K_n.item()
            return (
                f"laws.{law}.K_n: no rest is found with {K_n:g} N/m, {ratio:.2g} times as stiff as "
                f"the pad `{contact.pad}` that it presses; take {K_n * STIFF / ratio:.1g} N/m or "
                "less, the pad deflects long before the contact does"
            )
    return ""
