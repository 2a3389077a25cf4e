"""Geometry of undeformed rigs: points of pads and outlines of bodies in the world, and overlaps."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

from torchsoft.physics.graph import Graph
from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.shapes import Shape

PARTS = 32
"""Number of points on each side of a pad's outline that are tested for being inside another pad."""

Poses = Mapping[str, Array]
"""Poses (3,) [m, m, rad] by body."""


def at(coordinate: str) -> tuple[str, int]:
    """Body and index of a coordinate such as "disc.x"."""
    body, _, axis = coordinate.partition(".")
    return body, COORDINATES.index(axis)


def turned(v: Array, angle: float) -> Array:
    """Vectors (..., 2) rotated by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    return v @ np.array([[c, s], [-s, c]])


def in_world(pad: Pad, pose: Poses, placed: Array) -> Array:
    """Points (..., 2) in the world from the frame of a pad's base [m]."""
    base = np.zeros(3) if pad.base is None else pose[pad.base]
    return base[:2] + turned(placed, base[2])


def nodes(pad: Pad, pose: Poses) -> Array:
    """All nodes (nodes, 2) of an undeformed pad in the world [m]."""
    return in_world(pad, pose, pad.placed(pad.mesh.nodes))


def collision(one: Pad, other: Pad, pose: Poses) -> float:
    """Depth [m] of the deepest point on the outline of either of two undeformed pads, which may be
    hollow, inside the other; 0 where they are apart."""
    corners = [nodes(pad, pose)[pad.mesh.outline] for pad in (one, other)]
    parts = np.linspace(0.0, 1.0, PARTS, endpoint=False)[:, None, None]
    sides = [(ends + parts * (np.roll(ends, -1, 0) - ends)).reshape(-1, 2) for ends in corners]
    return max(depth_inside(sides[0], corners[1]), depth_inside(sides[1], corners[0]))


def depth_inside(places: Array, corners: Array) -> float:
    """Largest distance from the sides among points (n, 2) inside a polygon (corners, 2); 0 where
    all are outside. A point is inside where a line to its right crosses the sides an odd number of
    times."""
    places = places[((places > corners.min(0)) & (places < corners.max(0))).all(1)]
    way = np.roll(corners, -1, 0) - corners
    to = places[:, None] - corners
    part = ((to * way).sum(-1) / (way**2).sum(-1)).clip(0.0, 1.0)
    distance = np.linalg.norm(to - part[..., None] * way, axis=-1).min(1)
    level = (to[..., 1] < 0) != (to[..., 1] < way[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        right = to[..., 1] * way[:, 0] / way[:, 1] > to[..., 0]
    return float(distance[(level & right).sum(1) % 2 == 1].max(initial=0.0))


class Scene(NamedTuple):
    """A rig with its bodies at given poses and its pads undeformed."""

    rig: Graph
    pose: Poses

    def shape(self, body: str) -> Shape:
        """Shape of a body that has one."""
        shape = self.rig.bodies[body].shape
        assert shape is not None
        return shape

    def points(self, contact: str) -> Array:
        """Contact points (points, 2) of a contact's pad in the world [m]."""
        pad = self.rig.pads[self.rig.contacts[contact].pad]
        return in_world(pad, self.pose, pad.point_positions.numpy())

    def inside(self, body: str, places: Array) -> float:
        """Depth [m] of the deepest of some points (n, 2) of the world in a body; negative where all
        are outside."""
        own = turned(places - self.pose[body][:2], -self.pose[body][2])
        return -float(self.shape(body)(torch.from_numpy(own))[0].detach().min())

    def outline(self, body: str) -> Array:
        """Points on the outline of a body (points, 2) [m]."""
        return self.pose[body][:2] + turned(self.shape(body).outline().numpy(), self.pose[body][2])

    def carried(self, body: str) -> bool:
        """Whether one of the body's contacts is with a pad that it touches or that lies under its
        centre."""
        x, y, _ = self.pose[body]
        for name, contact in self.rig.contacts.items():
            if contact.body != body:
                continue
            points = self.points(name)
            over = points[:, 0].min() < x < points[:, 0].max()
            below = points[np.abs(points[:, 0] - x).argmin(), 1] < y
            if (over and below) or self.inside(body, points) > 0:
                return True
        return False

    def overlaps(self) -> dict[tuple[str, str], float]:
        """Depths [m] of overlaps between all pairs of bodies and pads without a contact, negative
        or 0 where they are apart, by the fields of a rig file."""
        rig, depths = self.rig, dict[tuple[str, str], float]()
        solid = [name for name, body in rig.bodies.items() if body.shape is not None]
        touching = {(contact.body, contact.pad) for contact in rig.contacts.values()}
        for i, one in enumerate(solid):
            for other in solid[i + 1 :]:
                depths[f"bodies.{one}", f"bodies.{other}"] = max(
                    self.inside(other, self.outline(one)), self.inside(one, self.outline(other))
                )
            for name, pad in rig.pads.items():
                if (one, name) not in touching and pad.base != one:
                    depth = self.inside(one, nodes(pad, self.pose))
                    depths[f"bodies.{one}", f"pads.{name}"] = depth
        pads = list(rig.pads)
        for i, one in enumerate(pads):
            for other in pads[i + 1 :]:
                depth = collision(rig.pads[one], rig.pads[other], self.pose)
                depths[f"pads.{one}", f"pads.{other}"] = depth
        return depths
