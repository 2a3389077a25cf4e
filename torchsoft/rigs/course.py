"""Where bodies will be, before any run: what is driven, what loops follow, and what is gripped between two pads.

Two estimates. By geometry alone, at any time: loops are taken to reach their set-points, a body between two pads that press
it to be in their middle, and to go along with them if both are on bodies. By statics, at a few moments: loops and efforts
that are fed forward press pads against bodies until both are in balance, without friction. Everything else is taken to stay
where it is.
"""

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.mesh import Array
from torchsoft.physics.motion import Piecewise, hold
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.statics import NoEquilibrium, resting
from torchsoft.rigs.build import BuiltRig, RigFile, assemble
from torchsoft.rigs.geometry import facing, pressed, surface, turned

Course = dict[str, Array]
"""Poses (3,) by body at one time."""

ALONG = 0.7
"""Least part of a surface's normal along an axis by which two pads hold a body along this axis."""

BALANCED = 1e-9
"""Residual [m] of an estimate by statics."""

KNOTS = 100
"""A motion with more knots than these is a recording."""


class Estimate:
    """The poses of a rig's bodies at any time of its run."""

    def __init__(self, file: RigFile, ready: BuiltRig) -> None:
        self.file, self.rig, self.end = file, ready.rig, float(ready.t[-1])
        with torch.no_grad():
            self.start = {name: x.numpy().copy() for name, x in self.rig.unpack(ready.y0).pose.items()}
        self.loops = file.loops()
        self.measured = {one.measured for one in self.loops}
        self.own = [name for name, one in file.actuators.items() if one.measured == one.pushes]
        self._past: list[tuple[float, Course]] = []
        self.unbalanced: dict[float, str] = {}

    def known(self, body: str) -> bool:
        """Whether no coordinate of a body is left to the run."""
        return all(f"{body}.{axis}" in self.measured for axis in self.file.bodies[body].free)

    def __call__(self, time: float) -> Course:
        """By geometry."""
        for knot in self.knots() if not self._past else ():
            self._past.append((knot, self._next(self._past[-1][1] if self._past else self.start, knot)))
        before = [pose for knot, pose in self._past if knot < time]
        return self._next(before[-1] if before else self.start, time)

    def _next(self, before: Course, time: float) -> Course:
        """At a time [s], after the poses of the knot before."""
        pose = {name: x.copy() for name, x in before.items()}
        followed = self.rig.follow(time).detach()
        values = dict(zip(self.rig.signals, followed[:, 0].tolist()))
        held, _ = self.rig.held(followed)
        for body, axis, kind in self.file.coordinates():
            if kind != "free":
                i = COORDINATES.index(axis)
                pose[body][i] = float(held[body][i])
        for one in self.loops:
            (body, axis), (pushed, other) = at(one.measured), at(one.pushes)
            pose[body][axis] = values[one.setpoint]
            if one.pushes not in self.measured and axis == other:  # it goes along
                pose[pushed][axis] = self.start[pushed][axis] + values[one.setpoint] - self.start[body][axis]
        for name in self.rig.bodies:
            self._carry(name, before, pose)
            for pair in facing(self.rig, name, pose):
                n = surface(self.rig.pads[self.rig.contacts[pair[0]].pad], pose).normal
                deep = [pressed(self.rig, key, pose) for key in pair]
                if sum(deep) > 0 and all(abs(n[i]) < 0.1 or self.is_own(name, i) for i in (0, 1)):
                    pose[name][:2] += 0.5 * (deep[0] - deep[1]) * n
        return pose

    def _carry(self, name: str, before: Course, pose: Course) -> None:
        """Takes a body along with the two others between whose pads it was gripped: as they move in the mean."""
        for pair in facing(self.rig, name, before):
            bases = [base for key in pair if (base := self.rig.pads[self.rig.contacts[key].pad].base) is not None]
            if len(bases) < 2 or min(pressed(self.rig, key, before) for key in pair) <= 0:
                continue
            was, now = (np.mean([at[base] for base in bases], 0) for at in (before, pose))
            turn = now[2] - was[2]
            moved = np.append(now[:2] + turned(before[name][:2] - was[:2], turn), before[name][2] + turn)
            own = [self.is_own(name, axis) for axis in range(3)]
            pose[name] = np.where(own, moved, pose[name])

    def is_own(self, body: str, axis: int) -> bool:
        """Whether a coordinate is free, and no loop measures it."""
        name = f"{body}.{COORDINATES[axis]}"
        return COORDINATES[axis] in self.file.bodies[body].free and name not in self.measured

    def balanced(self, time: float) -> Course:
        """By statics: the coordinates in balance are those whose own loop pushes them, and bodies between pads along what these
        press. By geometry where no balance is found."""
        pose = self(time)
        freed = {at(self.file.actuators[name].pushes) for name in self.own}
        for name in self.rig.bodies:
            for one, _ in facing(self.rig, name, pose):
                n = surface(self.rig.pads[self.rig.contacts[one].pad], pose).normal
                freed |= {(name, i) for i in (0, 1) if abs(n[i]) > ALONG and self.is_own(name, i)}
        if not freed:
            return pose
        held = {
            name: {axis: float(x[i]) for i, axis in enumerate(COORDINATES) if (name, i) not in freed}
            for name, x in pose.items()
        }
        rig = assemble(self.file, held, loops=self.own).requires_grad_(False)
        rig.reference = hold(**signals(self.rig, time))
        try:
            found = resting(rig, {name: torch.from_numpy(x) for name, x in pose.items()}, BALANCED)
        except NoEquilibrium as error:
            self.unbalanced[time] = str(error)
            return pose
        return {name: x.numpy() for name, x in found.items()}

    def knots(self) -> list[float]:
        """Times [s] at which motions begin or end, or are furthest out, and those of the run's begin and end."""
        found, fine = {0.0, self.end}, torch.linspace(0.0, self.end, 401, dtype=torch.float64)
        for name in self.rig.signals:
            one = self.rig.reference[name]
            if isinstance(one, Piecewise) and len(one.stops) <= KNOTS:
                found |= {float(t) for t in one.stops if 0 <= float(t) <= self.end}
            value = one(fine)[0].detach()
            found |= {float(fine[value.argmin()]), float(fine[value.argmax()])}
        return sorted(found)

    def sampled(self, count: int) -> list[tuple[float, Course]]:
        """Times [s] over the whole run, knots among them, and the poses there by geometry."""
        times = np.union1d(np.linspace(0.0, self.end, count), self.knots())
        return [(float(time), self(float(time))) for time in times]

    def moments(self, most: int) -> list[float]:
        """Up to so many of the knots [s] at which the rig is in different poses: the first, the one at which pads are pressed
        most, and others."""
        seen: list[tuple[float, Course]] = []
        for time in self.knots():
            pose = self(time)
            if not any(all(np.allclose(pose[k], old[k], rtol=0, atol=1e-6) for k in pose) for _, old in seen):
                seen.append((time, pose))

        def grip(pose: Course) -> float:
            return max((pressed(self.rig, key, pose) for key in self.rig.contacts), default=0.0)

        deepest = max(range(len(seen)), key=lambda i: grip(seen[i][1]))
        chosen = {0, deepest, *np.linspace(0, len(seen) - 1, min(most - 1, len(seen))).astype(int).tolist()}
        return [seen[i][0] for i in sorted(chosen)][:most]


def signals(rig: Rig, time: float) -> dict[str, float]:
    """The values of all motions at a time [s]."""
    followed: Tensor = rig.follow(time).detach()
    return dict(zip(rig.signals, followed[:, 0].tolist()))


def at(coordinate: str) -> tuple[str, int]:
    """Body and number of a coordinate such as "disc.x"."""
    body, _, axis = coordinate.partition(".")
    return body, COORDINATES.index(axis)
