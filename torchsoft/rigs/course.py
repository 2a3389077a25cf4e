"""Estimated course of the bodies before any run: driven bodies, bodies moved by loops, and bodies
gripped between two pads.

There are two estimates. The geometric one holds at any time: loops reach their set-points, a body
between two pressing pads is midway between them, and moves with them if both are on bodies; one
that lies on a pad of a body moves with that body. The static one, at a few moments, balances the
forces of loops and feed-forward efforts with those of pads, without friction. All other coordinates
keep their place.
"""

from functools import cached_property

import numpy as np
import torch

from torchsoft.physics.graph import Graph
from torchsoft.physics.mesh import Array
from torchsoft.physics.motion import Piecewise
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.statics import NoEquilibrium, resting
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.built import BuiltRig
from torchsoft.rigs.geometry import Scene, at, turned

ALONG = 0.7
"""Least component of a surface's normal along an axis by which two pads hold a body along this
axis."""

BALANCED = 1e-9
"""Residual [m] of the static estimate."""

KNOTS = 100
"""Most knots of a motion that are looked at one by one; a motion with more is a recording."""

SAMPLES = 61
"""Number of times of the estimated course, besides the motions' knots."""


class Estimate:
    """Estimated poses of a rig's bodies at any time of its run."""

    def __init__(self, file: RigFile, ready: BuiltRig) -> None:
        self.file, self.rig, self.end = file, ready.rig, float(ready.t[-1])
        self.start = {
            name: x.detach().numpy().copy() for name, x in self.rig.unpack(ready.y0).pose.items()
        }
        self.y0, self.loops = ready.y0, file.loops()
        self.measured = {one.measured for one in self.loops}
        self.unbalanced: dict[float, str] = {}

    def known(self, body: str) -> bool:
        """Whether the motions alone determine every coordinate of a body."""
        return not any(self.is_own(body, axis) for axis in range(3))

    def is_own(self, body: str, axis: int) -> bool:
        """Whether a coordinate is free and measured by no loop."""
        name = COORDINATES[axis]
        return name in self.file.bodies[body].free and f"{body}.{name}" not in self.measured

    def __call__(self, time: float) -> dict[str, Array]:
        """Poses (3,) by body, by the geometric estimate."""
        before = [pose for knot, pose in self._past if knot < time]
        return self._next(before[-1] if before else self.start, time)

    @cached_property
    def _past(self) -> list[tuple[float, dict[str, Array]]]:
        """The knots, and the poses at them."""
        past, pose = [], self.start
        for knot in self.knots():
            pose = self._next(pose, knot)
            past.append((knot, pose))
        return past

    def _next(self, before: dict[str, Array], time: float) -> dict[str, Array]:
        """Poses at a time [s] from those at the knot before."""
        pose = {name: x.copy() for name, x in before.items()}
        followed = self.rig.follow(time).detach()
        values, (held, _) = signals(self.rig, time), self.rig.held(followed)
        for body, axis, kind in self.file.coordinates():
            if kind != "free":
                i = COORDINATES.index(axis)
                pose[body][i] = float(held[body][i])
        for one in self.loops:
            (body, axis), (pushed, other) = at(one.measured), at(one.pushes)
            pose[body][axis] = values[one.setpoint]
            if one.pushes not in self.measured and axis == other:  # it goes along
                pose[pushed][axis] = (
                    self.start[pushed][axis] + values[one.setpoint] - self.start[body][axis]
                )
        was, now = Scene(self.rig, before), Scene(self.rig, pose)
        for name in self.rig.bodies:
            self._carry(name, was, now)
            for pair in now.facing(name):
                n, (one, other) = now.surface(pair[0]).normal, (now.pressed(key) for key in pair)
                if one + other > 0 and all(abs(n[i]) < 0.1 or self.is_own(name, i) for i in (0, 1)):
                    pose[name][:2] += 0.5 * (one - other) * n
        return pose

    def _carry(self, name: str, was: Scene, now: Scene) -> None:
        """Move a body with the two bodies whose pads grip it, by their mean motion, or with the
        one on whose pad it lies."""
        pairs = was.facing(name)
        lying = [] if pairs or not self.file.bodies[name].weighted else [
            (key,) for key, contact in self.rig.contacts.items()
            if contact.body == name and was.surface(key).normal[1] > ALONG
        ]  # fmt: skip
        for group in [*pairs, *lying]:
            bases = [base for key in group if (base := was.pad(key).base) is not None]
            if len(bases) < len(group) or min(was.pressed(key) for key in group) <= 0:
                continue
            old, new = (np.mean([scene.pose[base] for base in bases], 0) for scene in (was, now))
            turn = new[2] - old[2]
            moved = np.append(
                new[:2] + turned(was.pose[name][:2] - old[:2], turn), was.pose[name][2] + turn
            )
            own = [self.is_own(name, axis) for axis in range(3)]
            now.pose[name][own] = moved[own]

    @torch.no_grad()
    def balanced(self, time: float) -> dict[str, Array]:
        """Poses by the static estimate, by the geometric one where no equilibrium is found.
        Coordinates in equilibrium are those pushed by their own loop, and those of bodies on pads
        along the direction of the press; on a pad that none faces where a balance is found."""
        scene = Scene(self.rig, self(time))
        own = [name for name, one in self.file.actuators.items() if one.measured == one.pushes]
        freed = {at(self.file.actuators[name].pushes) for name in own}
        pairs = [(name, one) for name in self.rig.bodies for one, _ in scene.facing(name)]
        freed |= self._across(scene, pairs)
        touched = [
            (contact.body, key) for key, contact in self.rig.contacts.items()
            if scene.pressed(key) > 0
        ]  # fmt: skip
        followed = self.rig.follow(time) * torch.tensor([1.0, 0.0], dtype=torch.float64)
        pose = {name: torch.from_numpy(x) for name, x in scene.pose.items()}
        for sought in (freed | self._across(scene, touched), freed):
            free = {name: [i for i in range(3) if (name, i) in sought] for name in self.rig.bodies}
            if not sought:
                continue
            try:
                found = resting(
                    self.rig, pose, free, signals=followed, actuators=own, residual=BALANCED
                )
            except NoEquilibrium as error:
                if sought == freed:
                    self.unbalanced[time] = str(error)
            else:
                return {name: x.numpy() for name, x in found.items()}
        return dict(scene.pose)

    def _across(self, scene: Scene, touched: list[tuple[str, str]]) -> set[tuple[str, int]]:
        """Coordinates of bodies across the pads of some of their contacts, that no loop
        measures."""
        return {
            (name, i)
            for name, key in touched
            for i in (0, 1)
            if abs(scene.surface(key).normal[i]) > ALONG and self.is_own(name, i)
        }

    def knots(self) -> list[float]:
        """Times [s] of the run's ends, and those at which motions begin, end or have their
        extremes."""
        found, fine = {0.0, self.end}, torch.linspace(0.0, self.end, 401, dtype=torch.float64)
        for name in self.rig.signals:
            one = self.rig.reference[name]
            if isinstance(one, Piecewise) and len(one.stops) <= KNOTS:
                found |= {float(t) for t in one.stops if 0 <= float(t) <= self.end}
            value = one(fine)[0].detach()
            found |= {float(fine[value.argmin()]), float(fine[value.argmax()])}
        return sorted(found)

    @cached_property
    def course(self) -> list[tuple[float, Scene]]:
        """Times [s] over the whole run, knots included, and the scenes there by the geometric
        estimate."""
        times = np.union1d(np.linspace(0.0, self.end, SAMPLES), self.knots())
        return [(float(time), Scene(self.rig, self(float(time)))) for time in times]

    def moments(self, most: int) -> list[float]:
        """Up to so many of the knots [s] at which the rig is in different poses or pushed by other
        feed-forward efforts: the first, those at which pads are pressed and bodies are pushed most,
        and others."""
        fed = [one.feed_forward for one in self.file.actuators.values() if one.feed_forward]
        seen: list[tuple[float, Scene, Array]] = []
        for time in self.knots():
            pose, values = self(time), signals(self.rig, time)
            pushes = np.array([values[name] for name in fed])
            if not any(
                all(np.allclose(pose[k], old.pose[k], rtol=0, atol=1e-6) for k in pose)
                and np.allclose(pushes, before, rtol=1e-3, atol=0)
                for _, old, before in seen
            ):
                seen.append((time, Scene(self.rig, pose), pushes))
        grips = [
            max((scene.pressed(key) for key in self.rig.contacts), default=0.0)
            for _, scene, _ in seen
        ]
        loads = [float(np.abs(pushes).sum()) for *_, pushes in seen]
        chosen = {0, int(np.argmax(grips)), int(np.argmax(loads))}
        spread = np.linspace(0, len(seen) - 1, min(most - len(chosen) + 1, len(seen))).astype(int)
        return [seen[i][0] for i in sorted(chosen.union(spread.tolist()))][:most]


def signals(rig: Graph, time: float) -> dict[str, float]:
    """The values of all motions at a time [s]."""
    return dict(zip(rig.signals, rig.follow(time).detach()[:, 0].tolist()))
