"""Where things are: surfaces of pads and outlines of bodies in the world, gaps and overlaps, without any elasticity."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import networkx as nx
import numpy as np
import torch

from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import Pad
from torchsoft.physics.rig import Rig

FACING = -0.9
"""Product of two surfaces' normals below which they face each other."""

TOUCH = 1e-6
"""Depth [m] up to which things that touch do not overlap."""

Poses = Mapping[str, Array]
"""Poses (3,) [m, m, rad] by body."""


class Surface(NamedTuple):
    """An undeformed pad in the world: middle of its free surface [m], outward normal, direction along it (2,); half its length
    and its height [m]."""

    middle: Array
    normal: Array
    along: Array
    half: float
    height: float

    def depth(self, place: Array) -> Array:
        """How deep places (..., 2) lie under the surface's line [m]; negative above it."""
        return -(place - self.middle) @ self.normal

    def off(self, place: Array) -> Array:
        """How far places (..., 2) lie beyond the pad's ends [m]; negative between them."""
        return np.abs((place - self.middle) @ self.along) - self.half

    @property
    def corners(self) -> Array:
        """Of the whole pad (4, 2), around."""
        x, y = self.half * self.along, self.height * self.normal
        return self.middle + np.array([-x - y, x - y, x, -x])


def turned(v: Array, angle: float) -> Array:
    """Vectors (..., 2) turned by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    return v @ np.array([[c, s], [-s, c]])


def surface(pad: Pad, pose: Poses) -> Surface:
    """A pad with its base at its pose."""
    base = np.zeros(3) if pad.base is None else np.asarray(pose[pad.base])
    mesh, axes = pad.mesh, pad.axes.numpy()
    middle = pad.placed(np.array([0.5 * mesh.length, mesh.height]))
    normal, along = turned(axes[:, 1], base[2]), turned(axes[:, 0], base[2])
    return Surface(base[:2] + turned(middle, base[2]), normal, along, 0.5 * mesh.length, mesh.height)


def reach(rig: Rig, body: str, pose: Poses, direction: Array) -> float:
    """How far a body reaches from its centre along a unit vector of the world [m]."""
    shape = rig.bodies[body].shape
    assert shape is not None
    with torch.no_grad():
        return float(shape.support(torch.from_numpy(turned(direction, -pose[body][2]))))


def pressed(rig: Rig, contact: str, pose: Poses) -> float:
    """How deep a contact's body reaches under the undeformed surface of its pad [m]; negative where they are apart."""
    body = rig.contacts[contact].body
    at = surface(rig.pads[rig.contacts[contact].pad], pose)
    return float(at.depth(pose[body][:2])) + reach(rig, body, pose, -at.normal)


def outline(rig: Rig, body: str, pose: Poses) -> Array:
    """Points around a body (points, 2) [m]."""
    shape = rig.bodies[body].shape
    assert shape is not None
    return pose[body][:2] + turned(shape.outline().numpy(), pose[body][2])


def overlap(rig: Rig, one: str, other: str, pose: Poses) -> float:
    """How deep the outline of a body reaches into another body [m]; negative where they are apart."""
    shape = rig.bodies[other].shape
    assert shape is not None
    own = turned(outline(rig, one, pose) - pose[other][:2], -pose[other][2])
    with torch.no_grad():
        return -float(shape(torch.from_numpy(own))[0].min())


def into(rig: Rig, body: str, pose: Poses, pad: Surface) -> float:
    """How deep a body and an undeformed pad lie in each other [m]; negative where they are apart."""
    shape, places = rig.bodies[body].shape, outline(rig, body, pose)
    assert shape is not None
    deep = pad.depth(places)
    inside = np.minimum(np.minimum(deep, pad.height - deep), -pad.off(places)).max()
    own = turned(pad.corners - pose[body][:2], -pose[body][2])
    with torch.no_grad():
        return max(float(inside), -float(shape(torch.from_numpy(own))[0].min()))


def crossing(one: Array, other: Array) -> float:
    """How far two convex polygons (corners, 2), around, overlap along the direction in which they overlap least [m]."""
    least = np.inf
    for corners in (one, other):
        for edge in np.roll(corners, -1, 0) - corners:
            n = np.array([edge[1], -edge[0]]) / np.hypot(*edge)
            a, b = one @ n, other @ n
            least = min(least, a.max() - b.min(), b.max() - a.min())
    return float(least)


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
