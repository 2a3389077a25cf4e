"""What sensors make of a run: samples with gain, bias, drift, delay, misalignment and inertia, and their derivatives.

A reading is y(t) = (1 + error of the gain) * sum of a_k S_k(t - delay) + bias + drift (t - middle), where S_k are channels, or
rates of channels, of the run.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import log_ndtr

from torchsoft.physics.rig import Rig
from torchsoft.solve.trajectory import rate_channel
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.unknowns import NUISANCES, Nuisance, Sensor


class Signals(NamedTuple):
    """Channels of a run on a grid: t (G,) [s], values (G, channels) in the order of `names`, and their derivatives
    (G, channels, n), if there are any."""

    t: Array
    names: tuple[str, ...]
    values: Array
    derivatives: Array | None


class Term(NamedTuple):
    """A part of a reading: `factor` times the `order`-th rate of a channel, and the derivative of the factor by a nuisance."""

    channel: str
    order: int
    factor: float
    by: tuple[Nuisance, float] | None = None


@dataclass(frozen=True)
class Readout:
    """One channel as its sensor gives it, for given values of what is wrong with the sensor; its `repr` says all of it."""

    channel: str
    noise: float
    low: float | None
    high: float | None
    gain: float
    bias: float
    drift: float
    delay: float
    middle: float
    terms: tuple[Term, ...]

    def expected(self, signals: Signals, times: Array) -> tuple[Array, Array | None, dict[Nuisance, Array]]:
        """The reading (k,) at `times` without noise, its derivatives (k, n) by what the run was differentiated by, and by the
        nuisances."""
        y, rate, slopes = np.zeros(len(times)), np.zeros(len(times)), None
        by: dict[Nuisance, Array] = {}
        for term in self.terms:
            j, at = signals.names.index(term.channel), times - self.delay
            spline = CubicSpline(signals.t, signals.values[:, j])
            part = spline(at, term.order)
            y, rate = y + term.factor * part, rate + term.factor * spline(at, term.order + 1)
            if term.by is not None:
                kind, slope = term.by
                by[kind] = by.get(kind, 0.0) + self.gain * slope * part
            if signals.derivatives is not None and term.factor != 0.0:
                more = term.factor * CubicSpline(signals.t, signals.derivatives[:, j])(at, term.order)
                slopes = more if slopes is None else slopes + more
        by |= {
            "gain": y,
            "bias": np.ones(len(times)),
            "drift": times - self.middle,
            "delay": -self.gain * rate,
        }
        y = self.gain * y + self.bias + self.drift * (times - self.middle)
        return y, None if slopes is None else self.gain * slopes, by

    def residuals(self, y: Array, measured: Array) -> tuple[Array, Array]:
        """Expected less measured over the noise (k,), and its derivative by the expected.

        Of a saturated sample half the square is the negative logarithm of the probability that value and noise are together
        beyond the limit (Tobin, 1958)."""
        r, weight = (y - measured) / self.noise, np.full(len(y), 1 / self.noise)
        for limit, sign in ((self.high, 1.0), (self.low, -1.0)):
            if limit is not None:
                at = sign * measured >= sign * limit
                beyond, slope = censored(sign * (y[at] - limit) / self.noise)
                r[at], weight[at] = sign * beyond, slope / self.noise
        return r, weight

    def pulled_back(self, signals: Signals, times: Array, v: Array) -> Array:
        """What weights v (k,) on the expected reading are on the channels (G, channels)."""
        out, spline = np.zeros(signals.values.shape), CubicSpline(signals.t, np.eye(len(signals.t)))
        for term in self.terms:
            if term.factor != 0.0:
                j = signals.names.index(term.channel)
                out[:, j] += self.gain * term.factor * (v @ spline(times - self.delay, term.order))
        return out


def censored(z: Array) -> tuple[Array, Array]:
    """-sqrt(-2 ln Phi(z)) (k,), where values are expected z standard deviations beyond a limit, and its derivative; Phi is the
    normal distribution function. It is z far short of the limit, and nothing far beyond."""
    log = log_ndtr(z)
    r = -np.sqrt(-2 * log)
    density = np.exp(-0.5 * z**2 - log) / np.sqrt(2 * np.pi)
    return r, np.divide(density, -r, out=np.zeros_like(r), where=r < 0)


def partner(rig: Rig, channel: str) -> tuple[str, float]:
    """The channel at right angles, and the sign with which it enters when the sensor is turned. Raises `ValueError`."""
    names = {rig.renamed.get(key, key): key for key in every_key(rig)}
    key = names.get(channel, channel)
    for a, b, sign in (("x_", "y_", 1.0), ("y_", "x_", -1.0), ("v_x_", "v_y_", 1.0), ("v_y_", "v_x_", -1.0)):
        if key.startswith(a):
            other = b + key.removeprefix(a)
            if other in names.values():
                return rig.renamed.get(other, other), sign
    for name, actuator in rig.actuators.items():
        body, axis = actuator.pushes.split(".")
        other = {"x": "y", "y": "x"}.get(axis)
        twin = next((k for k, a in rig.actuators.items() if a.pushes == f"{body}.{other}"), None)
        if key == f"F_{name}" and twin is not None:
            return rig.renamed.get(f"F_{twin}", f"F_{twin}"), 1.0 if axis == "x" else -1.0
    raise ValueError(f"sensors.{channel}.misalignment: `{channel}` has no channel at right angles that it could see")


def every_key(rig: Rig) -> list[str]:
    """Keys of the free coordinates and their rates, before the rig renames any."""
    poses = [f"{['x', 'y', 'theta'][i]}_{rig.symbols[b]}" for b, axes in rig.layout.free.items() for i in axes]
    return [*poses, *map(rate_channel, poses)]


def pushed(rig: Rig, channel: str) -> str:
    """The channel of the rate of what an effort's actuator pushes. Raises `ValueError` for what is not an effort."""
    for name, actuator in rig.actuators.items():
        if channel == rig.renamed.get(f"F_{name}", f"F_{name}"):
            body, axis = actuator.pushes.split(".")
            key = rate_channel(f"{axis}_{rig.symbols[body]}")
            return rig.renamed.get(key, key)
    raise ValueError(f"sensors.{channel}.inertia: `{channel}` is not the force of an actuator")


def readout(
    rig: Rig, channel: str, sensor: Sensor, values: Mapping[Nuisance, float], span: tuple[float, float]
) -> Readout:
    """The readout of a sensor with the nuisances' `values`, in a recording over the times `span` [s]. Raises `ValueError` for
    a nuisance that the channel cannot have."""
    at = {kind: values.get(kind, float(kind == "gain")) for kind in NUISANCES}
    c, s = np.cos(at["misalignment"]), np.sin(at["misalignment"])
    if sensor.misalignment > 0:
        other, sign = partner(rig, channel)
        terms = [
            Term(channel, 0, float(c), ("misalignment", -float(s))),
            Term(other, 0, float(sign * s), ("misalignment", float(sign * c))),
        ]
    else:
        terms = [Term(channel, 0, 1.0)]
    if sensor.inertia > 0:
        terms.append(Term(pushed(rig, channel), 1, -at["inertia"], ("inertia", -1.0)))
    return Readout(
        channel, sensor.noise, sensor.low, sensor.high, at["gain"], at["bias"], at["drift"], at["delay"],
        0.5 * (span[0] + span[1]), tuple(terms),
    )  # fmt: skip
