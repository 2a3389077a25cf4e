"""Whether every body is still where its contacts can be computed: over its pads, and in front of
them."""

from typing import Any

import numpy as np

from torchsoft.solve.kernel import compiled, condensed
from torchsoft.solve.kernel.arrays import (
    CONDENSED,
    CONVERGED,
    CRUSHED,
    LOST,
    OFF_THE_PAD,
    PASSED_THROUGH,
    SIDE,
)
from torchsoft.solve.kernel.invoke import call_value
from torchsoft.solve.kernel.linear import bounds
from torchsoft.solve.kernel.table import Array

LEAST_WAY = 0.25
"""Part of a body's inner radius by which a search along a pad's base goes on at least."""


@compiled
def departed(rig: Any, work: Any, y: Array, a: float) -> tuple[int, int]:
    """Whether a body has left the domain of a contact in the step that ended in y with a stage of
    length a [s], and the number of that contact. A body must not leave the space over its pad or
    touch the pad's ends (unless it may leave), reach the pad's bonded base, or get behind the pad's
    surface. work.inner receives the places (contacts, 2) [m] of the bodies' innermost points in the
    frames of the bases; work.inner_before has those of the step's start."""
    for c in range(rig.contact_pad.size):
        pad = rig.contact_pad[c]
        at, limit = rig.pad_point_start[pad], rig.contact_limits[c]
        for i in range(work.actives[pad] if limit[0] > -np.inf else 0):
            k = work.active[at + i]
            if k == rig.contact_point_start[c] or k == rig.contact_point_start[c + 1] - 1:
                return OFF_THE_PAD, c
        x, y_centre = work.relative[c, 0], work.relative[c, 1]
        if not (limit[0] <= x <= limit[1] and limit[2] <= y_centre <= limit[3]):
            return LOST, c
        innermost(rig, work, c)
        if reaches_base(rig, work, c):
            return CRUSHED, c
        if passed_through(rig, work, c, y, a):
            return PASSED_THROUGH, c
    return CONVERGED, -1


@compiled
def innermost(rig: Any, work: Any, c: int) -> None:
    """Place of the innermost point of a contact's body into work.inner[c]."""
    cos, sin = np.cos(work.relative[c, 2]), np.sin(work.relative[c, 2])
    x, y = rig.contact_inner[c, 0], rig.contact_inner[c, 1]
    work.inner[c, 0] = work.relative[c, 0] + cos * x - sin * y
    work.inner[c, 1] = work.relative[c, 1] + sin * x + cos * y


@compiled
def reaches_base(rig: Any, work: Any, c: int) -> bool:
    """Whether a body overlaps a bonded side under the pad's face: its distance from a point of the
    side is also how far the search along the side may go on."""
    pad, x = rig.contact_pad[c], work.probe
    p = rig.p[bounds(rig.contact_p_start, c)]
    least = LEAST_WAY * rig.contact_inner[c, 2]
    for j in range(2, 5):
        x[j] = work.relative[c, j - 2]
    for i in range(rig.back_start[pad], rig.back_start[pad + 1] - 1):
        if rig.back_bonded[i] == 0:
            continue
        ax, ay = rig.back_X[i, 0], rig.back_X[i, 1]
        tx, ty = rig.back_X[i + 1, 0] - ax, rig.back_X[i + 1, 1] - ay
        length = np.hypot(tx, ty)
        tx, ty = tx / length, ty / length
        along = tx * (work.relative[c, 0] - ax) + ty * (work.relative[c, 1] - ay)
        nearest = min(max(along, 0.0), length)
        off_x = work.relative[c, 0] - ax - nearest * tx
        off_y = work.relative[c, 1] - ay - nearest * ty
        size = rig.contact_size[c]
        if np.hypot(off_x, off_y) > size:
            continue
        way, end = max(along - size, 0.0), min(along + size, length)
        while way <= end:
            x[0], x[1] = ax + way * tx, ay + way * ty
            call_value(rig.contact_distance[c], x, p, work.phi)
            if work.phi[0] < 0.0:
                return True
            way += work.phi[0] if work.phi[0] > least else least
    return False


@compiled
def passed_through(rig: Any, work: Any, c: int, y: Array, a: float) -> bool:
    """Whether the innermost point of a body is behind the surface of its pad as it is deformed, or
    has crossed the back of the pad in this step."""
    pad = rig.contact_pad[c]
    x, z, box = work.inner[c, 0], work.inner[c, 1], rig.back_box[pad]
    for i in range(rig.back_start[pad], rig.back_start[pad + 1] - 1):
        if crosses(work.inner_before[c], work.inner[c], rig.back_X[i], rig.back_X[i + 1]):
            return True
    if not (box[0] <= x <= box[1] and box[2] <= z <= box[3]):
        return False
    low, high = rig.pad_node_start[pad], rig.pad_node_start[pad + 1]
    if rig.pad_kind[pad] == CONDENSED:
        if not inside(rig, work, c, y, a, work.low[pad], work.high[pad]):
            return False
        condensed.displace(rig, work, pad, low, high)
    return inside(rig, work, c, y, a, low, high)


@compiled
def crosses(start: Array, end: Array, one: Array, other: Array) -> bool:
    """Whether the lines from `start` to `end` and from `one` to `other` cross."""
    dx, dy, tx, ty = end[0] - start[0], end[1] - start[1], other[0] - one[0], other[1] - one[1]
    first = dx * (one[1] - start[1]) - dy * (one[0] - start[0])
    second = dx * (other[1] - start[1]) - dy * (other[0] - start[0])
    third = tx * (start[1] - one[1]) - ty * (start[0] - one[0])
    fourth = tx * (end[1] - one[1]) - ty * (end[0] - one[0])
    return (first > 0.0) != (second > 0.0) and (third > 0.0) != (fourth > 0.0)


@compiled
def inside(rig: Any, work: Any, c: int, y: Array, a: float, low: int, high: int) -> bool:
    """Whether the innermost point of a body lies between the contact points and the back of its
    pad, with the displacements of the nodes from `low` to `high`: a line to its right crosses the
    boundary an odd number of times."""
    pad, odd = rig.contact_pad[c], False
    first, last = rig.back_start[pad], rig.back_start[pad + 1]
    px, py = work.inner[c, 0], work.inner[c, 1]
    x, z = rig.back_X[last - 1, 0], rig.back_X[last - 1, 1]
    points = rig.contact_point_start[c + 1] - rig.contact_point_start[c]
    for i in range(points + last - first):
        if i < points:
            x_next, z_next = deformed(rig, work, rig.contact_point_start[c] + i, y, a, low, high)
        else:
            j = first + i - points
            x_next, z_next = rig.back_X[j, 0], rig.back_X[j, 1]
        if (z > py) != (z_next > py) and px < x + (py - z) / (z_next - z) * (x_next - x):
            odd = not odd
        x, z = x_next, z_next
    return odd


@compiled
def deformed(
    rig: Any, work: Any, k: int, y: Array, a: float, low: int, high: int
) -> tuple[float, float]:
    """Place of a contact point at the end of the step, its nodes being where they were bonded
    unless they are among those from `low` to `high`."""
    pad = rig.contact_pad[rig.point_contact[k]]
    x, z = rig.point_X[k, 0], rig.point_X[k, 1]
    for j in range(SIDE):
        node, N = rig.point_node[k, j], rig.point_N[k, j]
        if N == 0.0 or node < low or node >= high:
            continue
        if rig.pad_kind[pad] == CONDENSED:
            near = work.low[pad] <= node < work.high[pad]
            rate = work.u_dot[node] if near else work.free[node]
            x += N * (work.u[node, 0] + a * rate[0])
            z += N * (work.u[node, 1] + a * rate[1])
        else:
            at = rig.pad_y_start[pad]
            x += N * y[at + rig.nodal_surface[2 * node]]
            z += N * y[at + rig.nodal_surface[2 * node + 1]]
    return x, z
