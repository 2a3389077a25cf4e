"""Geometry of undeformed rigs: surfaces of pads and outlines of bodies in the world, gaps and
overlaps."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import networkx as nx
import numpy as np
import torch

from torchsoft.physics.graph import Graph
from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.shapes import Shape

FACING = -0.9
"""Scalar product of two surfaces' normals below which they face each other."""

CORNERS = 1440
"""Number of points of an outline at which its curvature is computed."""

Poses = Mapping[str, Array]
"""Poses (3,) [m, m, rad] by body."""


class Surface(NamedTuple):
    """An undeformed pad in the world: highest middle of its free surface [m], outward normal and
    direction along it (2,); its half length and its height [m]; and its profile from left to right
    (nodes, 2) [m], along the surface from the middle and outwards."""

    middle: Array
    normal: Array
    along: Array
    half: float
    height: float
    profile: Array

    def depth(self, place: Array) -> Array:
        """Depth [m] of points (..., 2) under the surface, along the normal at its middle; negative
        above it."""
        outwards = np.interp((place - self.middle) @ self.along, *self.profile.T)
        return outwards - (place - self.middle) @ self.normal

    def off(self, place: Array) -> float:
        """Distance [m] of a point (2,) beyond the pad's ends; negative between them."""
        return float(abs((place - self.middle) @ self.along) - self.half)

    def faces(self, other: "Surface") -> bool:
        """Whether two surfaces face each other."""
        return bool(self.normal @ other.normal < FACING)


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


def surface(pad: Pad, pose: Poses) -> Surface:
    """Surface of a pad with its base at its pose."""
    mesh = pad.mesh
    own = mesh.nodes[mesh.free[mesh.surface]]
    left, right, top = own[:, 0].min(), own[:, 0].max(), own[:, 1].max()
    middle = np.array([0.5 * (left + right), top])
    origin, along, normal = in_world(
        pad, pose, pad.placed(middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    )
    profile = (own - middle)[np.argsort(own[:, 0], kind="stable")]
    return Surface(
        origin, normal - origin, along - origin, 0.5 * (right - left), mesh.height, profile
    )


def nodes(pad: Pad, pose: Poses) -> Array:
    """All nodes (nodes, 2) of an undeformed pad in the world [m]."""
    return in_world(pad, pose, pad.placed(pad.mesh.nodes))


PARTS = 32
"""Number of points on each side of a pad's outline that are tested for being inside another pad."""


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
        """Shape of a body that has a contact."""
        shape = self.rig.bodies[body].shape
        assert shape is not None
        return shape

    def pad(self, contact: str) -> Pad:
        return self.rig.pads[self.rig.contacts[contact].pad]

    def surface(self, contact: str) -> Surface:
        """Surface of a contact's pad."""
        return surface(self.pad(contact), self.pose)

    def points(self, contact: str) -> Array:
        """Contact points (points, 2) of a contact's pad in the world [m]."""
        pad = self.pad(contact)
        return in_world(pad, self.pose, pad.point_positions.numpy())

    def away(self, contact: str) -> bool:
        """Whether a body is outside the space over the pad of a contact that it must not leave."""
        own, (low, high) = self.rig.contacts[contact], self.pad(contact).space
        base = np.zeros(3) if (on := self.pad(contact).base) is None else self.pose[on]
        place = turned(self.pose[own.body][:2] - base[:2], -base[2])
        return not own.may_leave and bool(((place < low) | (place > high)).any())

    def reach(self, body: str, direction: Array) -> float:
        """Extent [m] of a body from its centre along a unit vector of the world."""
        return float(
            self.shape(body)
            .support(torch.from_numpy(turned(direction, -self.pose[body][2])))
            .detach()
        )

    def inside(self, body: str, places: Array) -> float:
        """Depth [m] of the deepest of some points (n, 2) of the world in a body; negative where all
        are outside."""
        own = turned(places - self.pose[body][:2], -self.pose[body][2])
        return -float(self.shape(body)(torch.from_numpy(own))[0].detach().min())

    def pressed(self, contact: str) -> float:
        """Depth [m] of the undeformed pad of a contact in the body; negative where they are
        apart."""
        return self.inside(self.rig.contacts[contact].body, self.points(contact))

    def outline(self, body: str) -> Array:
        """Points on the outline of a body (points, 2) [m]."""
        return self.pose[body][:2] + turned(self.shape(body).outline().numpy(), self.pose[body][2])

    def corner(self, body: str) -> float:
        """Smallest convex radius of curvature of a body [m]."""
        return 1 / float(self.shape(body).curvature(self.shape(body).outline(CORNERS)).max())

    def facing(self, body: str) -> list[tuple[str, str]]:
        """Pairs of contacts of a body whose pads face each other across it."""
        at = {
            key: self.surface(key)
            for key, contact in self.rig.contacts.items()
            if contact.body == body
        }
        own = list(at)
        return [
            (a, b) for i, a in enumerate(own) for b in own[i + 1 :]
            if at[a].faces(at[b]) and at[a].depth(at[b].middle) < at[a].height
            and abs((at[b].middle - at[a].middle) @ at[a].along) < at[a].half + at[b].half
        ]  # fmt: skip


def tied(rig: Graph, contacts: Iterable[str]) -> nx.Graph:
    """Graph of the bodies, with an edge where one of the contacts is between a body and a pad on
    another body. The ground connects nothing."""
    graph = nx.Graph()
    graph.add_nodes_from(rig.bodies)
    pairs = ((rig.pads[rig.contacts[key].pad].base, rig.contacts[key].body) for key in contacts)
    graph.add_edges_from((base, body) for base, body in pairs if base is not None)
    return graph
