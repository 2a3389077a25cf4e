"""Whether a closed curve is simple, and how far from it the nearest point stays the only one."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


SAME = 1e-9
"""Distance, over the curve's size, at which points next to each other are one."""


def crossing(points: Array) -> bool:
    """Whether the closed polygon through points (n, 2) crosses itself."""
    size = np.ptp(points, 0).max()
    points = points[np.linalg.norm(points - np.roll(points, 1, 0), axis=1) > SAME * size]
    start, way = points, np.roll(points, -1, 0) - points
    way_x, way_y = way.T
    to = start[None] - start[:, None]
    begins = (
        way_x[:, None] * to[..., 1] - way_y[:, None] * to[..., 0]
    )  # on which side of a row's segment a column's begins
    ends = np.roll(begins, -1, 1)
    divided = (begins > 0) != (ends > 0)
    count = np.arange(len(points))
    apart = np.abs(count[:, None] - count)
    return bool((divided & divided.T & (apart > 1) & (apart < len(points) - 1)).any())


def reach(points: Array, normals: Array, curvature: Array) -> float:
    """How far [m] from a smooth closed curve the nearest point on it is the only one, from points of it (n, 2) [m], normals
    (n, 2) and curvature (n,) [1/m] there: the smallest radius of a circle that touches it at one of the points and passes
    through another (Federer 1959, Curvature measures, Theorem 4.18), or of curvature."""
    to = points[None] - points[:, None]
    off = np.abs((to * normals[:, None]).sum(-1))
    np.fill_diagonal(off, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.where(off > 0, (to**2).sum(-1) / (2 * off), np.inf)
    return float(min(radius.min(), 1 / np.abs(curvature).max()))
