"""A control loop whose force and coordinate were measured: both sides of its law, as means over windows of time.

Means over a window need no derivative of what was measured: that of a rate is the difference of its ends.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly
from scipy.optimize import lsq_linear

from torchsoft.physics.parts import Actuator
from torchsoft.physics.rig import Rig
from torchsoft.sysid.problem.recording import BETWEEN, REACH, Array, Recording
from torchsoft.sysid.problem.unknowns import Sensor

WINDOW = 20e-3
"""Length [s] of a window, or four samples where that is longer."""

FEWEST = 8
"""Windows without which nothing is said."""


class Signal(NamedTuple):
    """A channel's samples: times (k,) [s], values (k,), the standard deviation of their noise, and the sensor."""

    channel: str
    t: Array
    y: Array
    sensor: Sensor

    @property
    def spacing(self) -> float:
        return float(np.median(np.diff(self.t)))


class Noise(NamedTuple):
    """Standard deviation [N] of the mean over a window of a disagreement that is noise: if that is `white`, and if it stays the
    same for longer than a window (`coloured`); and the force per coordinate that the law gives (`gain`)."""

    white: float
    coloured: float
    gain: float


@dataclass(frozen=True)
class Loop:
    """An actuator with its force F and the coordinate x that it measures, over windows between `edges` (w + 1,) [s]; `keep`
    (w,) are those n that both have samples in. `reference` gives set-point and force fed forward (k, 2) at times (k,). Shifts
    in time go up to `reach` [s]; the force is taken to be `lag` [s] late."""

    actuator: Actuator
    reference: Callable[[Array], Array]
    F: Signal
    x: Signal
    edges: Array
    keep: NDArray[np.bool_]
    reach: float
    lag: float = 0.0

    @cached_property
    def width(self) -> Array:
        return np.diff(self.edges)[self.keep]

    @cached_property
    def inner(self) -> NDArray[np.bool_]:
        """Windows (n,) that can be shifted."""
        first, last = self.edges[0] + self.reach, self.edges[-1] - self.reach
        return ((self.edges[:-1] >= first) & (self.edges[1:] <= last))[self.keep]

    @cached_property
    def curves(self) -> tuple[PPoly, PPoly, PPoly]:
        """Integral of the force, integral of the coordinate, the coordinate."""
        F, x = (CubicSpline(one.t, one.y) for one in (self.F, self.x))
        return F.antiderivative(), x.antiderivative(), x

    def force(self, late: float = 0.0) -> Array:
        """Mean of the force over each window (n,), if its samples are `late` [s]."""
        return self._over(self.curves[0](self.edges + self.lag + late))

    @cached_property
    def signals(self) -> tuple[PPoly, PPoly, PPoly]:
        """Integral of the set-point, the set-point, integral of the force fed forward."""
        t = np.arange(self.edges[0] - self.reach, self.edges[-1] + self.reach + BETWEEN, BETWEEN)
        x, F = (CubicSpline(t, column) for column in self.reference(t).T)
        return x.antiderivative(), x, F.antiderivative()

    def asked(self, late: float = 0.0) -> Array:
        """Set-point, its rate, and the force fed forward (n, 3)."""
        return np.stack([self._over(one(self.edges + late)) for one in self.signals], -1)

    def found(self, late: float = 0.0) -> Array:
        """The coordinate and its rate (n, 2)."""
        return np.stack([self._over(one(self.edges + late)) for one in self.curves[1:]], -1)

    def _over(self, at_edges: Array) -> Array:
        return np.diff(at_edges)[self.keep] / self.width

    def given(self, asked: Array, found: Array) -> Array:
        """The force that the law gives (n,)."""
        return self.actuator(torch.from_numpy(np.concatenate((asked, found), -1))).detach().numpy()

    @cached_property
    def noise(self) -> "Noise":
        """How uncertain the sensors' noise makes the difference of both sides."""
        inputs = torch.from_numpy(np.concatenate((self.asked(), self.found()), -1)).requires_grad_(True)
        (slope,) = torch.autograd.grad(self.actuator(inputs).sum(), inputs)
        by_x, by_v = slope[:, 3].numpy(), slope[:, 4].numpy()
        variance = []
        for part in (lambda one: one.spacing / self.width, lambda one: 1.0):
            x = self.x.sensor.noise**2 * (by_x**2 * part(self.x) + 2 * by_v**2 / self.width**2)
            variance.append(np.mean(self.F.sensor.noise**2 * part(self.F) + x))
        return Noise(float(np.sqrt(variance[0])), float(np.sqrt(variance[1])), float(np.abs(by_x).mean()))

    @property
    def unfed(self) -> bool:
        """Whether a force might be fed forward, and none ever is."""
        return self.actuator.feed_forward is not None and not self.asked()[:, 2].any()

    def beyond(self, e: Array) -> Array:
        """What is left of a disagreement e (n,) [N] if the faults that the sensors declare explain of it what they can."""
        F, x, gain = self.F.sensor, self.x.sensor, self.noise.gain
        t = (0.5 * (self.edges[1:] + self.edges[:-1]))[self.keep]
        faults = [
            (np.ones(len(e)), F.bias + gain * x.bias), (t - t.mean(), F.drift + gain * x.drift), (self.force(), F.gain),
            (gain * self.found()[:, 0], x.gain),
        ]  # fmt: skip
        if not (declared := [(column, bound) for column, bound in faults if bound > 0]):
            return e
        columns, bounds = np.stack([column for column, _ in declared], -1), np.array([bound for _, bound in declared])
        return e - columns @ lsq_linear(columns, e, (-bounds, bounds)).x


def channel(rig: Rig, name: str) -> str:
    """The channel of a coordinate such as "disc.x", or of the force of an actuator such as "x"."""
    body, _, axis = name.partition(".")
    own = f"{axis}_{rig.symbols[body]}" if axis else f"F_{body}"
    return rig.renamed.get(own, own)


def sampled(recording: Recording, sensors: Mapping[str, Sensor], name: str) -> Signal | None:
    """The samples of a coordinate or a force whose sensor sees nothing else and is never saturated, or None."""
    own = channel(recording.rig, name)
    if own not in recording.samples or own not in sensors:
        return None
    one, (t, y) = sensors[own], recording.samples[own]
    clean = one.inertia == 0 and one.misalignment == 0 and not one.saturated(y).any() and len(t) > 3
    return Signal(own, t, y, one) if clean else None


def windows(recording: Recording, actuator: Actuator, F: Signal | None, x: Signal | None) -> Loop | None:
    """The loop of two signals over windows that both have samples in; None where there are too few of them."""
    if F is None or x is None:
        return None
    length = max(WINDOW, 4 * F.spacing, 4 * x.spacing)
    first, last = max(F.t[0], x.t[0]), min(F.t[-1], x.t[-1])
    reach = min(REACH, (last - first) / 8)
    count = int((last - first) / length)
    if last - first - 2 * reach < FEWEST * length:
        return None
    edges = first + length * np.arange(count + 1)
    keep = np.logical_and.reduce([np.diff(np.searchsorted(s.t, edges)) * s.spacing > 0.5 * length for s in (F, x)])
    names = [actuator.setpoint, *([actuator.feed_forward] if actuator.feed_forward else [])]

    def reference(t: Array) -> Array:
        at = recording.rig.reference(torch.from_numpy(t), names).detach().numpy()[..., 0]
        return at if actuator.feed_forward else np.stack((at[:, 0], np.zeros(len(t))), -1)

    return Loop(actuator, reference, F, x, edges, keep, reach) if keep.sum() >= FEWEST else None
