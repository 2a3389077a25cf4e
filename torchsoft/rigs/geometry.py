"""Where things are: surfaces of pads and outlines of bodies in the world, gaps and overlaps, without any elasticity."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import networkx as nx
import numpy as np
import torch
from scipy.spatial import ConvexHull

from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import Pad
from torchsoft.physics.rig import Rig

FACING = -0.9
"""Product of two surfaces' normals below which they face each other."""

TOUCH = 1e-6
"""Depth [m] up to which things that touch do not overlap."""

CORNERS = 1440
"""Points of an outline at which its curvature is looked at."""

Poses = Mapping[str, Array]
"""Poses (3,) [m, m, rad] by body."""


class Surface(NamedTuple):
    """An undeformed pad in the world: the middle of its free surface, at its highest [m], outward normal, direction along it
    (2,); half its length and its height [m]; the surface itself from left to right (nodes, 2) [m], along it from the middle
    and outwards from there."""

    middle: Array
    normal: Array
    along: Array
    half: float
    height: float
    profile: Array

    def depth(self, place: Array) -> Array:
        """How deep places (..., 2) lie under the surface [m], along its middle's normal; negative above it."""
        outwards = np.interp((place - self.middle) @ self.along, *self.profile.T)
        return outwards - (place - self.middle) @ self.normal

    def off(self, place: Array) -> Array:
        """How far places (..., 2) lie beyond the pad's ends [m]; negative between them."""
        return np.abs((place - self.middle) @ self.along) - self.half


def turned(v: Array, angle: float) -> Array:
    """Vectors (..., 2) turned by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    return v @ np.array([[c, s], [-s, c]])


def in_world(pad: Pad, pose: Poses, own: Array) -> Array:
    """Places (..., 2) in a pad's own frame [m], in the world."""
    base = np.zeros(3) if pad.base is None else np.asarray(pose[pad.base])
    return base[:2] + turned(pad.placed(own), base[2])


def surface(pad: Pad, pose: Poses) -> Surface:
    """A pad with its base at its pose."""
    mesh = pad.mesh
    own = mesh.nodes[mesh.free[mesh.surface]]
    left, right, top = own[:, 0].min(), own[:, 0].max(), own[:, 1].max()
    middle = np.array([0.5 * (left + right), top])
    origin, along, normal = (in_world(pad, pose, middle + step) for step in ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0]))
    profile = (own - middle)[np.argsort(own[:, 0], kind="stable")]
    return Surface(origin, normal - origin, along - origin, 0.5 * (right - left), mesh.height, profile)


def reach(rig: Rig, body: str, pose: Poses, direction: Array) -> float:
    """How far a body reaches from its centre along a unit vector of the world [m]."""
    shape = rig.bodies[body].shape
    assert shape is not None
    with torch.no_grad():
        return float(shape.support(torch.from_numpy(turned(direction, -pose[body][2]))))


def inside(rig: Rig, body: str, pose: Poses, places: Array) -> float:
    """How deep the deepest of some places (n, 2) of the world is in a body [m]; negative where all are outside."""
    shape = rig.bodies[body].shape
    assert shape is not None
    own = turned(places - pose[body][:2], -pose[body][2])
    with torch.no_grad():
        return -float(shape(torch.from_numpy(own))[0].min())


def points(pad: Pad, pose: Poses) -> Array:
    """The contact points (points, 2) of an undeformed pad in the world [m]."""
    base = np.zeros(3) if pad.base is None else np.asarray(pose[pad.base])
    return base[:2] + turned(pad.point_positions.numpy(), base[2])


def pressed(rig: Rig, contact: str, pose: Poses) -> float:
    """How deep the undeformed pad of a contact is in the body [m]; negative where they are apart."""
    one = rig.contacts[contact]
    return inside(rig, one.body, pose, points(rig.pads[one.pad], pose))


def outline(rig: Rig, body: str, pose: Poses) -> Array:
    """Points around a body (points, 2) [m]."""
    shape = rig.bodies[body].shape
    assert shape is not None
    return pose[body][:2] + turned(shape.outline().numpy(), pose[body][2])


def overlap(rig: Rig, one: str, other: str, pose: Poses) -> float:
    """How deep the outline of a body reaches into another body [m]; negative where they are apart."""
    return inside(rig, other, pose, outline(rig, one, pose))


def nodes(pad: Pad, pose: Poses) -> Array:
    """All nodes (nodes, 2) of an undeformed pad in the world [m]."""
    return in_world(pad, pose, pad.mesh.nodes)


def hull(pad: Pad, pose: Poses) -> Array:
    """The corners (corners, 2), around, of the convex hull of an undeformed pad [m]."""
    places = nodes(pad, pose)
    return places[ConvexHull(places).vertices]


def crossing(one: Array, other: Array) -> float:
    """How far two convex polygons (corners, 2), around, overlap along the direction in which they overlap least [m]."""
    least = np.inf
    for corners in (one, other):
        for edge in np.roll(corners, -1, 0) - corners:
            n = np.array([edge[1], -edge[0]]) / np.hypot(*edge)
            a, b = one @ n, other @ n
            least = min(least, a.max() - b.min(), b.max() - a.min())
    return float(least)


def around(pad: Pad, pose: Poses) -> Array:
    """The corners (corners, 2), around, of an undeformed pad [m], which may be hollow."""
    return in_world(pad, pose, pad.mesh.nodes[pad.mesh.outline])


def within(places: Array, corners: Array) -> bool:
    """Whether any of some places (n, 2) is inside a polygon (corners, 2): a line to the right crosses it an odd number of
    times."""
    (x, y), (ax, ay) = places.T[:, :, None], corners.T
    bx, by = np.roll(corners, -1, 0).T
    level = (ay > y) != (by > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        right = ax + (y - ay) / (by - ay) * (bx - ax) > x
    return bool(((level & right).sum(1) % 2 == 1).any())


def collision(one: Pad, other: Pad, pose: Poses) -> float:
    """How far two undeformed pads overlap, as their convex hulls do [m]; zero where something lies in the hollow of another."""
    deep = crossing(hull(one, pose), hull(other, pose))
    if deep <= TOUCH or (is_convex(one) and is_convex(other)):
        return deep
    lie = within(nodes(one, pose), around(other, pose)) or within(nodes(other, pose), around(one, pose))
    return deep if lie else 0.0


def is_convex(pad: Pad) -> bool:
    """Whether a pad is its convex hull, but for rounding."""
    x, y = pad.mesh.nodes[pad.mesh.outline].T
    area = 0.5 * abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))
    return area > (1 - 1e-6) * ConvexHull(pad.mesh.nodes).volume  # of a plane body the area


def corner(rig: Rig, body: str) -> float:
    """The smallest radius of curvature of a body where it bulges outwards [m]."""
    shape = rig.bodies[body].shape
    assert shape is not None
    return 1 / float(shape.curvature(shape.outline(CORNERS)).max())


def tied(rig: Rig, contacts: Iterable[str]) -> nx.Graph:
    """Bodies, with an edge where one of the contacts is between a body and a pad of the other; the ground ties nothing."""
    graph = nx.Graph()
    graph.add_nodes_from(rig.bodies)
    for key in contacts:
        base = rig.pads[rig.contacts[key].pad].base
        if base is not None:
            graph.add_edge(base, rig.contacts[key].body)
    return graph


def facing(rig: Rig, body: str, pose: Poses) -> list[tuple[str, str]]:
    """Pairs of contacts between whose pads, which face each other, a body is."""
    own = [key for key, contact in rig.contacts.items() if contact.body == body]
    at = {key: surface(rig.pads[rig.contacts[key].pad], pose) for key in own}
    pairs = [(a, b) for i, a in enumerate(own) for b in own[i + 1 :]]
    return [
        (a, b) for a, b in pairs
        if at[a].normal @ at[b].normal < FACING and at[a].depth(at[b].middle) < at[a].height
        and (abs((at[b].middle - at[a].middle) @ at[a].along) < at[a].half + at[b].half)
    ]  # fmt: skip
