"""Motions with movable knots: bounds, and variables of a search."""

from collections.abc import Iterable, Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.optimize import linprog
from torch import Tensor

from torchsoft.display import suggestion
from torchsoft.physics.motion import Profile, Reference
from torchsoft.tables import Table

Array = NDArray[np.float64]

PEAK = 35 / 16
"""Peak over mean speed of the 7th-order profile."""


class Range(Table):
    """Range of a value."""

    low: float
    """lowest value [its unit]"""
    high: float
    """highest value [its unit]"""

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if self.low >= self.high:
            raise ValueError(f"low = {self.low:g} must be below high = {self.high:g}")
        return self


class Bounds(Range):
    """Bounds of a signal of the reference, whose knots the search may move."""

    speed: float = Field(gt=0)
    """largest rate of the signal [its unit/s]"""
    after: float = 0.0
    """time after which knots are free [s]"""
    shortest: float | None = Field(default=None, gt=0)
    """least time between two knots; if given, the times of knots are free too [s]"""


def profile(reference: Reference, name: str) -> Profile:
    """A signal of the reference. Raises `ValueError` for an unknown one, and for one that is not a
    `Profile`."""
    try:
        found = reference[name]
    except KeyError:
        found = None
    if type(found) is not Profile:
        known = [
            key.replace(":", ".") for key, one in reference.signals.items() if type(one) is Profile
        ]
        raise ValueError(
            f"the reference has no Profile called `{name}`: only knots of profiles can move; "
            f"{suggestion(name, known, 'it has')}"
        )
    return found


def knots(reference: Reference, names: Iterable[str]) -> dict[str, Any]:
    """Profiles of some signals, as whole tables of a rig file: nothing of older ones is kept."""
    signals = {name: profile(reference, name) for name in names}
    return {
        name: {
            "kind": "profile",
            "times": one.times.detach().tolist(),
            "values": one.values.detach().tolist(),
            "offset": 0.0,
        }
        for name, one in signals.items()
    }


class Moves:
    """The variables z (n,) of a motion: values, and times where these are free, of the free knots
    of some signals, which end by `end` [s]; none for empty `bounds`. Each is over a unit of its
    own: the largest distance that the speed allows between two knots, or the time between them.

    Raises `ValueError` for signals without free knots, and for bounds that no motion of these knots
    can keep.
    """

    def __init__(self, reference: Reference, bounds: Mapping[str, Bounds], end: float) -> None:
        self.given, self.bounds, self.end = reference, dict(bounds), end
        self.knots: dict[str, tuple[Array, Array, int]] = {}  # times, values, the first free one
        units, z = [np.zeros(0)], [np.zeros(0)]
        for name, one in bounds.items():
            signal = profile(reference, name)
            times, values = signal.times.numpy(), signal.values.detach().numpy()
            first = int(np.searchsorted(times, one.after, side="right"))
            if first == len(times):
                raise ValueError(f"`{name}` has no knot after {one.after:g} s that could move")
            if first == 0 or times[-1] > end * (1 + 1e-9):
                raise ValueError(
                    f"`{name}` must have a knot at or before after = {one.after:g} s that stays, "
                    f"and none beyond the end, {end:g} s; it has knots at "
                    f"{', '.join(f'{t:g}' for t in times)} s: change `after`, or the motion"
                )
            self.knots[name] = times, values, first
            spans = np.diff(times[first - 1 :])
            units.append(np.minimum(one.speed * spans / PEAK, one.high - one.low))
            z.append(values[first:])
            if one.shortest is not None:
                units.append(spans)
                z.append(times[first:])
        self.unit, flat = np.concatenate(units), np.concatenate(z)
        self.n, origin = len(flat), self._excess(np.zeros(len(flat)))
        columns = [self._excess(e) - origin for e in np.eye(self.n)]  # excess is affine in z
        self.A = np.array(columns).reshape(self.n, len(origin)).T
        self.b = -origin
        self.start = self.nearest(flat / self.unit)

    def split(self, z: Any) -> dict[str, tuple[Any, Any]]:
        """Times and values of the free knots by signal, from z, as arrays or tensors."""
        physical, out, at = (
            z * (torch.from_numpy(self.unit) if isinstance(z, Tensor) else self.unit),
            {},
            0,
        )
        for name, (times, _, first) in self.knots.items():
            count = len(times) - first
            values, at = physical[at : at + count], at + count
            moved = times[first:]
            if self.bounds[name].shortest is not None:
                moved, at = physical[at : at + count], at + count
            out[name] = moved, values
        return out

    def ways(self) -> Array:
        """Matrix (n, n) from the variables to the distances between knots, and the times."""
        D, at = np.eye(self.n), 0
        for name, (times, _, first) in self.knots.items():
            count = len(times) - first
            rows = np.arange(at + 1, at + count)
            D[rows, rows - 1] = -self.unit[rows - 1] / self.unit[rows]
            at += count if self.bounds[name].shortest is None else 2 * count
        return D

    def box(self) -> list[tuple[float, float]]:
        """Lower and upper bound of every variable."""
        out, at = list[tuple[float, float]](), 0
        for name, (times, _, first) in self.knots.items():
            one, count = self.bounds[name], len(times) - first
            ranges = [(one.low, one.high)]
            if one.shortest is not None:
                ranges.append((float(times[first - 1]), self.end))
            for low, high in ranges:
                out += [(low / unit, high / unit) for unit in self.unit[at : at + count]]
                at += count
        return out

    def reference(self, z: Tensor, given: Reference | None = None) -> Reference:
        """The motion, by default of the given reference, with the free knots z, differentiable with
        respect to z."""
        signals = dict[str, Profile]()
        for name, (times, values) in self.split(z).items():
            known_times, known_values, first = self.knots[name]
            moved = times if isinstance(times, Tensor) else torch.from_numpy(times)
            signals[name] = Profile(
                torch.cat((torch.from_numpy(known_times[:first]), moved)),
                torch.cat((torch.from_numpy(known_values[:first]), values)),
            )
        return (self.given if given is None else given).replaced(signals)

    def _excess(self, z: Array) -> Array:
        """Excess over the constraints, not positive where they are kept: bounds of values, speed,
        `shortest` and the end."""
        rows = [np.zeros(0)]
        for name, (times, values) in self.split(z).items():
            one, (known_times, known_values, first) = self.bounds[name], self.knots[name]
            t = np.concatenate((known_times[first - 1 : first], times))
            v = np.concatenate((known_values[first - 1 : first], values))
            way, span = np.diff(v), np.diff(t) * one.speed / PEAK
            rows += [(v[1:] - one.high), (one.low - v[1:]), way - span, -way - span]
            if one.shortest is not None:
                rows += [one.shortest - np.diff(t), t[-1:] - self.end]
        return np.concatenate(rows)

    def nearest(self, z: Array) -> Array:
        """The nearest z within the bounds, by the sum of absolute changes. Raises `ValueError`
        where there is none."""
        if not self.n or (self.A @ z <= self.b + 1e-9 * np.abs(self.A).max(1)).all():
            return z
        I, scale = np.eye(self.n), np.abs(self.A).max(1)
        A = np.block(
            [[self.A / scale[:, None], np.zeros((len(self.A), self.n))], [I, -I], [-I, -I]]
        )
        out: Any = linprog(
            np.append(np.zeros(self.n), np.ones(self.n)), A_ub=A,
            b_ub=np.concatenate((self.b / scale, z, -z)),
            bounds=[(None, None)] * self.n + [(0, None)] * self.n, method="highs",
        )  # fmt: skip
        if out.status != 0:
            raise ValueError(
                "no motion of these knots keeps within the bounds: allow more travel, speed or time"
            )
        return np.asarray(out.x[: self.n], np.float64)

    def active(self, z: Array) -> list[str]:
        """Active bounds of a motion, with the number of their knots, in words."""
        out = []
        for name, (times, values) in self.split(z).items():
            one, (known_times, known_values, first) = self.bounds[name], self.knots[name]
            way = np.diff(np.append(known_values[first - 1], values))
            span: Array = np.ediff1d(np.append(known_times[first - 1], times)).astype(
                np.float64
            ) * (one.speed / PEAK)
            near = 1e-3 * (one.high - one.low)
            for limit, count in (
                (f"low = {one.low:g}", int(np.sum(values < one.low + near))),
                (f"high = {one.high:g}", int(np.sum(values > one.high - near))),
                (f"speed = {one.speed:g}", int(np.sum(np.abs(way) > 0.99 * span))),
            ):
                if count:
                    out.append(f"{name} at {limit} in {count} of {len(values)} knots")
        return out
