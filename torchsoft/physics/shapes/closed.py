"""Closed contours through given points: from a file, and as the control points of a periodic cubic B-spline."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchsoft import csvfile
from torchsoft.physics.arguments import LENGTHS, places
from torchsoft.physics.shapes.simple import crossing

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]

FINE = 64
"""Intervals a piece in which lengths along a spline are summed up."""


LEAST, SHARPEST = 8, np.radians(60)
"""Points that are a contour, and by how much it may turn at one of them [rad]: a spline would swing around a corner."""


def contour_points(points: object) -> Array:
    """Points (n, 2) [m] around a contour, the first of which is not there again at the end. Raises `ValueError` for what is not
    enough points, or points of which some are the same, turn by more than `SHARPEST`, or go along lines that cross."""
    given = places("points", points).numpy()
    if len(given) > 1 and np.array_equal(given[0], given[-1]):
        given = given[:-1]
    if len(given) < LEAST:
        raise ValueError(f"`points` must be at least {LEAST} places around a contour, but are {len(given)}")
    x, y = (np.roll(given, -1, 0) - given).T
    if not (np.hypot(x, y) > 0).all():
        raise ValueError(
            f"`points` has the same place twice: point {int(np.hypot(x, y).argmin())} and the one after it"
        )
    turn = np.arctan2(np.roll(x, 1) * y - np.roll(y, 1) * x, np.roll(x, 1) * x + np.roll(y, 1) * y)
    sharpest = int(np.abs(turn).argmax())
    if abs(turn[sharpest]) > SHARPEST:
        raise ValueError(
            f"`points` turns by {abs(np.degrees(turn[sharpest])):.3g} degrees at point {sharpest}, a smooth contour by "
            f"{np.degrees(SHARPEST):.3g} at most; give more points there, or a RoundedPolygon"
        )
    if crossing(given):
        raise ValueError("`points` go along a contour that crosses itself")
    return given


def read_points(path: str | Path) -> Array:
    """Points (n, 2) [m] of a CSV file with columns x and y whose headings have units in brackets. Raises `ValueError` naming
    file and row for anything else, and `OSError`."""
    needed = "the columns must be `x [mm]` and `y [mm]`, in m, cm or mm"
    table = csvfile.read(Path(path), dict.fromkeys("xy", LENGTHS), lambda *_: f": {needed}")
    if table.values.keys() != {"x", "y"}:
        raise ValueError(f"{path}, row 1: {needed}, but are {', '.join(table.values) or 'none'}")
    points = np.stack((table.values["x"], table.values["y"]), -1)
    if (empty := np.flatnonzero(np.isnan(points).any(1))).size:
        raise ValueError(f"{path}, row {table.rows[empty[0]]} has an empty cell; a point needs x and y")
    return points


def closed_spline(points: Array) -> tuple[CubicSpline, Array]:
    """The periodic cubic spline through points (n, 2) [m] over the lengths of their chords, anticlockwise, and these lengths
    from the first point on to the first point again (n + 1,) [m]."""
    x, y = points.T
    if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0:
        points = points[::-1]
    closed = np.concatenate((points, points[:1]))
    chords = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    from scipy.interpolate import CubicSpline  # a third of a second

    return CubicSpline(chords, closed, bc_type="periodic"), chords


def control_points(spline: CubicSpline, chords: Array, pieces: int) -> Array:
    """Control points (pieces, 2) [m] of the uniform periodic cubic B-spline that meets a closed spline where its pieces do, at
    places equally far apart along it."""
    t = np.linspace(0, chords[-1], FINE * max(pieces, len(chords)) + 1)
    speed = np.linalg.norm(spline(t, 1), axis=1)
    length = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))))
    from scipy.interpolate import CubicSpline

    at = CubicSpline(length, t)(np.linspace(0, length[-1], pieces, endpoint=False))
    turn = 2 * np.pi * np.arange(pieces) / pieces
    return np.fft.ifft(np.fft.fft(spline(at), axis=0) / ((4 + 2 * np.cos(turn)) / 6)[:, None], axis=0).real.copy()
