"""Where bodies will be, before any run: what is driven, what loops follow, and what is gripped between two pads.

An estimate: loops are taken to reach their set-points, and a body between two pads that press it to be in their middle.
Everything else is taken to stay where it starts.
"""

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.mesh import Array
from torchsoft.physics.motion import Piecewise
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import Ready
from torchsoft.rigs.geometry import facing, pressed, surface

Course = dict[str, Array]
"""Poses (3,) by body at one time."""


class Estimate:
    """The poses of a rig's bodies at any time of its run."""

    def __init__(self, ready: Ready) -> None:
        self.rig, self.end = ready.rig, float(ready.t[-1])
        with torch.no_grad():
            self.start = {name: x.numpy().copy() for name, x in self.rig.unpack(ready.y0).pose.items()}

    def known(self, body: str) -> bool:
        """Whether no coordinate of a body is left to the run."""
        free = {f"{body}.{axis}" for axis, kind in self.rig.bodies[body].freedom.items() if kind == "free"}
        return free <= {actuator.measures for actuator in self.rig.actuators.values()}

    def __call__(self, time: float) -> Course:
        rig = self.rig
        pose = {name: x.copy() for name, x in self.start.items()}
        values = signals(rig, time)
        held, _ = rig.held(rig.follow(time))
        for name, body in rig.bodies.items():
            for i, axis in enumerate(COORDINATES):
                if body.freedom[axis] != "free":
                    pose[name][i] = float(held[name][i].detach())
        measured = {a.measures for a in rig.actuators.values()}
        for actuator in rig.actuators.values():
            if actuator.setpoint == actuator.feed_forward:
                continue
            (body, axis), (pushed, other) = at(actuator.measures), at(actuator.pushes)
            moved = values[actuator.setpoint] - self.start[body][axis]
            pose[body][axis] = values[actuator.setpoint]
            if actuator.pushes not in measured and axis == other:  # it goes along
                pose[pushed][axis] = self.start[pushed][axis] + moved
        for name in rig.bodies:
            self._centre(name, pose)
        return pose

    def _centre(self, body: str, pose: Course) -> None:
        """Moves a body to the middle between pads that press it, where its coordinates are its own."""
        own = {actuator.measures for actuator in self.rig.actuators.values()}
        for one, other in facing(self.rig, body, pose):
            n = surface(self.rig.pads[self.rig.contacts[one].pad], pose).normal
            deep = pressed(self.rig, one, pose), pressed(self.rig, other, pose)
            bound = any(
                abs(n[i]) > 0.1 and (self.rig.bodies[body].freedom[axis] != "free" or f"{body}.{axis}" in own)
                for i, axis in enumerate(COORDINATES[:2])
            )
            if sum(deep) > 0 and not bound:
                pose[body][:2] += 0.5 * (deep[0] - deep[1]) * n

    def knots(self) -> list[float]:
        """Times [s] at which motions begin or end, those of the run's begin and end among them."""
        found = {0.0, self.end}
        for name in self.rig.signals:
            one = self.rig.reference[name]
            if isinstance(one, Piecewise) and len(one.stops) <= 100:
                found |= {float(t) for t in one.stops if 0 <= float(t) <= self.end}
        return sorted(found)


def signals(rig: Rig, time: float) -> dict[str, float]:
    """The values of all motions at a time [s]."""
    followed: Tensor = rig.follow(time).detach()
    return dict(zip(rig.signals, followed[:, 0].tolist()))


def at(coordinate: str) -> tuple[str, int]:
    """Body and number of a coordinate such as "disc.x"."""
    body, _, axis = coordinate.partition(".")
    return body, COORDINATES.index(axis)


def sampled(estimate: Estimate, count: int) -> list[tuple[float, Course]]:
    """Times [s] over the whole run, knots among them, and the poses there."""
    times = np.union1d(np.linspace(0.0, estimate.end, count), estimate.knots())
    return [(float(time), estimate(float(time))) for time in times]
