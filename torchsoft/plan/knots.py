"""Motions with movable knots: bounds, and variables of a search."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.linalg import block_diag
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
    """time after which the values of knots are free [s]"""


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


class FreeKnots(NamedTuple):
    """Knots of a signal: times [s] and values (k,), of which those from number `first` on are free,
    and how far the speed lets each free one be from the one before."""

    times: Array
    values: Array
    first: int
    reach: Array


class Moves:
    """The variables z (n,) of a motion: values of the free knots of some signals, which end by
    `end` [s]; none for empty `bounds`. Each is over a unit of its own, the largest distance that
    the speed allows between two knots. `ways` (n, n) makes distances between knots of them, and A z
    <= b keeps bounds and speed.

    Raises `ValueError` for signals without free knots, and for bounds that no motion of these knots
    can keep.
    """

    def __init__(self, reference: Reference, bounds: Mapping[str, Bounds], end: float) -> None:
        self.given, self.bounds = reference, dict(bounds)
        self.knots = {
            name: free_knots(profile(reference, name), name, one, end)
            for name, one in bounds.items()
        }
        A, b, units, flat, ways = (
            [np.zeros((0, 0))],
            [np.zeros(0)],
            [np.zeros(0)],
            [np.zeros(0)],
            [],
        )
        for one, (_, values, first, reach) in zip(bounds.values(), self.knots.values()):
            k = len(reach)
            unit, way = np.minimum(reach, one.high - one.low), np.eye(k) - np.eye(k, k=-1)
            before = np.append(values[first - 1], np.zeros(k - 1))
            A.append(np.concatenate((np.eye(k), -np.eye(k), way, -way)) * unit)
            b += [np.full(k, one.high), np.full(k, -one.low), reach + before, reach - before]
            ways.append(way * unit / unit[:, None])
            units.append(unit)
            flat.append(values[first:])
        self.unit = np.concatenate(units)
        self.n = len(self.unit)
        self.A: Array = np.asarray(block_diag(*A))
        self.ways: Array = np.asarray(block_diag(*ways))
        self.b = np.concatenate(b)
        self.start = self.nearest(np.concatenate(flat) / self.unit)

    def values(self, z: Tensor) -> dict[str, Tensor]:
        """Values of the free knots by signal."""
        counts = [len(one.reach) for one in self.knots.values()]
        return dict(zip(self.knots, (z * torch.from_numpy(self.unit)).split(counts)))

    def box(self) -> list[tuple[float, float]]:
        """Lower and upper bound of every variable."""
        ends = [
            (one.low, one.high) for name, one in self.bounds.items() for _ in self.knots[name].reach
        ]
        return [(low / unit, high / unit) for (low, high), unit in zip(ends, self.unit)]

    def reference(self, z: Tensor, given: Reference | None = None) -> Reference:
        """The motion, by default of the given reference, with the free knots z, differentiable with
        respect to z."""
        signals = dict[str, Profile]()
        for name, moved in self.values(z).items():
            times, values, first, _ = self.knots[name]
            known = torch.from_numpy(values[:first])
            signals[name] = Profile(torch.from_numpy(times), torch.cat((known, moved)))
        return (self.given if given is None else given).replaced(signals)

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
        for name, moved in self.values(torch.from_numpy(z)).items():
            one, (_, known, first, reach) = self.bounds[name], self.knots[name]
            values = moved.numpy()
            way = np.diff(values, prepend=known[first - 1])
            near = 1e-3 * (one.high - one.low)
            for limit, count in (
                (f"low = {one.low:g}", int(np.sum(values < one.low + near))),
                (f"high = {one.high:g}", int(np.sum(values > one.high - near))),
                (f"speed = {one.speed:g}", int(np.sum(np.abs(way) > 0.99 * reach))),
            ):
                if count:
                    out.append(f"{name} at {limit} in {count} of {len(values)} knots")
        return out


def free_knots(signal: Profile, name: str, bounds: Bounds, end: float) -> FreeKnots:
    """The knots of a signal. Raises `ValueError` where none is free, or none before them stays."""
    times, values = signal.times.numpy(), signal.values.detach().numpy()
    first = int(np.searchsorted(times, bounds.after, side="right"))
    if first == len(times):
        raise ValueError(f"`{name}` has no knot after {bounds.after:g} s that could move")
    if first == 0 or times[-1] > end * (1 + 1e-9):
        raise ValueError(
            f"`{name}` must have a knot at or before after = {bounds.after:g} s that stays, "
            f"and none beyond the end, {end:g} s; it has knots at "
            f"{', '.join(f'{t:g}' for t in times)} s: change `after`, or the motion"
        )
    return FreeKnots(times, values, first, bounds.speed * np.diff(times[first - 1 :]) / PEAK)
