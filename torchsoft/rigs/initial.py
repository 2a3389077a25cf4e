"""Where the bodies of a rig file start and which motions its rig follows: functions of the rig's
parameters, differentiable in them."""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsoft.physics.motion import Piecewise, Reference
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.start import NoPlace, Poses, placed
from torchsoft.physics.statics import NoEquilibrium, resting, standing, standing_loads
from torchsoft.rigs.geometry import at
from torchsoft.rigs.motion import HELD, MotionContext

RigFile = Any
"""A `RigFile`, whose module imports this one."""

Held = Callable[[str, float], Tensor]
"""Effort () [N, N.m] that holds a coordinate at a time [s]."""

STIFF = 100.0
"""Largest stiffness of a contact, over that of a point of its pad, at which a failed equilibrium is
not blamed on the contact."""


def initial_poses(file: RigFile, rig: Rig, driven: Mapping[str, Piecewise]) -> Poses:
    """Initial poses (3,) [m, m, rad] by body; `driven` gives the motions of driven coordinates.
    Raises `ValueError` naming the field."""
    none = torch.zeros((), dtype=torch.float64)
    held = {name: [body.fixed.get(axis, none) for axis in COORDINATES]
            for name, body in rig.bodies.items()}  # fmt: skip
    for name, one in driven.items():
        body, axis = at(name)
        held[body][axis] = one(none)[0]
    starts = {name: body.given for name, body in file.bodies.items()}
    try:
        return placed(rig, starts, {name: torch.stack(rows) for name, rows in held.items()})
    except NoPlace as error:
        raise ValueError(f"bodies.{error.body}.start.{error.axis}: {error.reason}") from None
    except NoEquilibrium as error:
        name, (axis, *_) = next(iter(file.rests().items()))
        weight = file.bodies[name].weighted * rig.bodies[name].mass.item() * rig.gravity.item()
        reason = f"no rest under its weight of {weight:.3g} N is found; {error}"
        raise ValueError(
            too_stiff(file, rig) or f"bodies.{name}.start.{COORDINATES[axis]}: {reason}"
        ) from None


def settled_pads(file: RigFile, rig: Rig, poses: Poses, reference: Reference) -> Tensor:
    """State (size,) of bodies that stand at `poses`, their pads settled around them, at the start
    of a reference. Raises `ValueError`."""
    try:
        return standing(rig, poses, 0.0, reference)
    except NoEquilibrium as error:
        raise ValueError(
            too_stiff(file, rig) or f"bodies: the pads cannot settle where bodies start: {error}"
        ) from None


def signal(
    file: RigFile, name: str, poses: Mapping[str, Tensor] | None = None, held: Held | None = None
) -> Piecewise:
    """One motion, for bodies that start at `poses`. Raises `ValueError` naming the field."""
    roles: dict[str, set[str]] = {}
    for role, coordinate in file.followers()[name]:
        roles.setdefault(role, set()).add(coordinate)
    (follows, *more), (fed, *others) = (
        sorted(roles.get(role, ())) or [""] for role in ("setpoint", "feed_forward")
    )
    body, axis = at(follows) if follows and not more else ("", 0)
    start = poses[body][axis] if poses is not None and body else None
    effort = partial(held, fed) if held and fed and not others else None
    context = MotionContext(
        name, file.unit(name), start, effort, file.outputs.duration, file.folder
    )
    try:
        return file.motion[name].build(context)
    except ValueError as error:
        prefix = "" if str(error).startswith("motion.") else f"motion.{name}: "
        raise ValueError(f"{prefix}{error}") from None


def reference(file: RigFile, poses: Mapping[str, Tensor], held: Held) -> Reference:
    """All motions, for bodies that start at `poses`. Raises `ValueError` naming the field."""
    return Reference(**{name: signal(file, name, poses, held) for name in file.motion})


def started_values(file: RigFile, rig: Rig, poses: Poses) -> dict[str, Tensor]:
    """Values (k,) of the motions that have some given as "start" or "held", by name."""
    held = partial(holding_effort, file, rig, poses)
    names = [name for name, motion in file.motion.items() if motion.follows_start]
    return {name: signal(file, name, poses, held).values for name in names}


def holding_effort(file: RigFile, rig: Rig, start: Poses, coordinate: str, time: float) -> Tensor:
    """The effort () [N, N.m] that holds a coordinate, without friction, with bodies at their
    set-points at a time [s], or else where they rest or start. Raises `ValueError`."""
    poses, known = at_setpoints(file, start, time)
    still = torch.zeros(len(rig.signals), 2, dtype=torch.float64)
    rests = file.rests(known)
    try:
        if rests:
            poses = resting(rig, poses, rests, signals=still, actuators=())
        loads = standing_loads(rig, poses)
    except NoEquilibrium as error:
        raise ValueError(
            f'"{HELD}" asks for balance where set-points are at t = {time:g} s, and there is '
            f"none: {error}"
        ) from None
    body, axis = at(coordinate)
    return -loads[body][axis]


def at_setpoints(
    file: RigFile, start: Poses, time: float
) -> tuple[Poses, Collection[tuple[str, int]]]:
    """Poses at a time [s] of bodies that follow set-points and drives exactly and start at `start`,
    and the coordinates that do, by body and axis."""
    rows = {name: list(pose.unbind()) for name, pose in start.items()}
    moved, t = set[tuple[str, int]](), torch.tensor(time, dtype=torch.float64)
    for name, users in file.followers().items():
        for body, axis in (at(one) for role, one in users if role in ("driven", "setpoint")):
            rows[body][axis] = signal(file, name, start)(t)[0]
            moved.add((body, axis))
    return {name: torch.stack(row) for name, row in rows.items()}, moved


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
                "less, the pad deflects long before the contact does"
            )
    return ""
