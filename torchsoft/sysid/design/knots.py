"""What a designed motion may do: knots of a reference's profiles as variables, within bounds of travel, speed and duration.

Between knots a profile is monotone and its speed peaks at `PEAK` times the mean one: the bounds hold everywhere when they hold
from knot to knot, and are linear in values and times of the knots.
"""

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from scipy.optimize import linprog
from torch import Tensor

from torchsoft.physics.motion import Profile, Reference
from torchsoft.sysid.recording import Array
from torchsoft.tables import Table

PEAK = 35 / 16
"""Largest over mean speed of the 7th-order profile."""


class Bounds(Table):
    """What a signal of the reference may do: values from `low` to `high` [its unit], at `speed` [its unit/s] at most.

    Knots later than `after` [s] are free. Their times are free too if `shortest` [s] is given, the least time between two.
    """

    low: float
    high: float
    speed: float = Field(gt=0)
    after: float = 0.0
    shortest: float | None = Field(default=None, gt=0)

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if self.low >= self.high:
            raise ValueError(f"low = {self.low:g} must be below high = {self.high:g}")
        return self


def profile(reference: Reference, name: str) -> Profile:
    """A signal of the reference. Raises `ValueError` where it is none, or no `Profile`."""
    try:
        found = reference[name]
    except KeyError:
        found = None
    if type(found) is not Profile:
        raise ValueError(f"the reference has no Profile called `{name}`: only knots of profiles can be designed")
    return found


class Moves:
    """The variables z (n,) of a motion: values, and times where they are free, of the free knots of some signals, which end by
    `end` [s]; each over a unit of its own, the way or the time between two knots that are as far apart as speed allows.

    Raises `ValueError` for signals without free knots, and where the motion given is more than the bounds leave to it.
    """

    def __init__(self, reference: Reference, bounds: Mapping[str, Bounds], end: float) -> None:
        if not bounds:
            raise ValueError("`bounds` names no signal whose knots may move")
        self.given, self.bounds, self.end = reference, dict(bounds), end
        self.knots: dict[str, tuple[Array, Array, int]] = {}  # times, values, the first free one
        units, z = [], []
        for name, one in bounds.items():
            signal = profile(reference, name)
            times, values = signal.times.numpy(), signal.values.detach().numpy()
            first = int(np.searchsorted(times, one.after, side="right"))
            if first == len(times):
                raise ValueError(f"`{name}` has no knot after {one.after:g} s that could move")
            if first == 0 or times[-1] > end * (1 + 1e-9):
                raise ValueError(
                    f"`{name}` must have a knot at or before {one.after:g} s that stays, and none after {end:g} s"
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
        self.A = np.stack([self._excess(e) - origin for e in np.eye(self.n)], -1)  # excess is affine in z
        self.b = -origin
        self.start = self.nearest(flat / self.unit)

    def split(self, z: Any) -> dict[str, tuple[Any, Any]]:
        """Times and values of the free knots by signal, of z over its units, as arrays or tensors."""
        physical, out, at = z * (torch.from_numpy(self.unit) if isinstance(z, Tensor) else self.unit), {}, 0
        for name, (times, _, first) in self.knots.items():
            count = len(times) - first
            values, at = physical[at : at + count], at + count
            moved = times[first:]
            if self.bounds[name].shortest is not None:
                moved, at = physical[at : at + count], at + count
            out[name] = moved, values
        return out

    def reference(self, z: Tensor) -> Reference:
        """The motion, with the graph of z."""
        signals = {name.replace(":", "."): signal for name, signal in self.given.signals.items()}
        for name, (times, values) in self.split(z).items():
            known_times, known_values, first = self.knots[name]
            moved = times if isinstance(times, Tensor) else torch.from_numpy(times)
            signals[name] = Profile(
                torch.cat((torch.from_numpy(known_times[:first]), moved)),
                torch.cat((torch.from_numpy(known_values[:first]), values)),
            )
        return Reference(**signals)

    def _excess(self, z: Array) -> Array:
        """What must not be positive: beyond the bounds, faster than allowed, closer than `shortest`, too late."""
        rows = []
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
        """The motion within the bounds that is nearest to z, by the sum of what variables move. Raises `ValueError` where there
        is none."""
        if (self.A @ z <= self.b + 1e-9 * np.abs(self.A).max(1)).all():
            return z
        I, scale = np.eye(self.n), np.abs(self.A).max(1)
        A = np.block([[self.A / scale[:, None], np.zeros((len(self.A), self.n))], [I, -I], [-I, -I]])
        out: Any = linprog(
            np.append(np.zeros(self.n), np.ones(self.n)), A_ub=A, b_ub=np.concatenate((self.b / scale, z, -z)),
            bounds=[(None, None)] * self.n + [(0, None)] * self.n, method="highs",
        )  # fmt: skip
        if out.status != 0:
            raise ValueError("no motion of these knots keeps within the bounds: allow more travel, speed or time")
        return np.asarray(out.x[: self.n], np.float64)

    def active(self, z: Array) -> list[str]:
        """Which bounds a motion touches, and at how many knots, in words."""
        out = []
        for name, (times, values) in self.split(z).items():
            one, (known_times, known_values, first) = self.bounds[name], self.knots[name]
            way = np.diff(np.append(known_values[first - 1], values))
            span: Array = np.ediff1d(np.append(known_times[first - 1], times)).astype(np.float64) * (one.speed / PEAK)
            near = 1e-3 * (one.high - one.low)
            for what, count in (
                (f"low = {one.low:g}", int(np.sum(values < one.low + near))),
                (f"high = {one.high:g}", int(np.sum(values > one.high - near))),
                (f"speed = {one.speed:g}", int(np.sum(np.abs(way) > 0.99 * span))),
            ):
                if count:
                    out.append(f"{name} at {what} in {count} of {len(values)} knots")
        return out
