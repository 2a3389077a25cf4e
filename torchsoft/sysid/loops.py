"""Do the measured force, the measured coordinate and the set-point of a control loop belong together?

The law of an actuator is known. So a recording that has its force and the coordinate that it measures is held against it without
a run: means over windows of time of both sides agree within the sensors' noise. Where they do not, one thing at a time is taken
to be otherwise: the sign of the force, the body that the loop senses, a zero, a factor, a time, what is fed forward.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline, PPoly

from torchsoft.channels import unit
from torchsoft.physics.parts import Actuator
from torchsoft.physics.paper import SoftGrasp
from torchsoft.physics.rig import Rig
from torchsoft.sysid.finding import Finding, confusions
from torchsoft.sysid.recording import REACH, Array, Recording
from torchsoft.sysid.unknowns import Sensor

WINDOW = 20e-3
"""Length [s] of a window, or four samples where that is longer."""

INSIDE = 16
"""Points of a window at which the reference is evaluated."""

FEWEST = 8
"""Windows without which nothing is said."""

ROUGH = 0.03
"""Part of the force by which both sides may differ besides the noise: drives are not exact."""

SURE = 5.0
"""Standard deviations from which a mean, a factor or a time is called different."""

EXPLAINED = 0.15
"""Part of a disagreement that may be left by what explains it."""

SLOW = 0.3
"""Part of a disagreement by which it may change from window to window where a force fed forward is missing."""

AS_GOOD = 1.15
"""What fits as well: so many times what the best leaves."""

LATE = 1e-3
"""Shift in time [s] from which something is said."""

SHIFTS = 161
"""Shifts in time that are tried."""

RESIZED = 5.0
"""Largest factor on a force that is not one of mistaken units."""


class Signal(NamedTuple):
    """A channel's samples: times (k,) [s], values (k,), the standard deviation of their noise, and the sensor."""

    channel: str
    t: Array
    y: Array
    sensor: Sensor

    @property
    def spacing(self) -> float:
        return float(np.median(np.diff(self.t)))


@dataclass(frozen=True)
class Loop:
    """An actuator with its force F and the coordinate x that it measures, over windows between `edges` (w + 1,) [s]; `keep` (w,)
    are those n that both have samples in. `reference` gives set-point and force fed forward (..., 2) at times."""

    actuator: Actuator
    reference: Callable[[Array], Array]
    F: Signal
    x: Signal
    edges: Array
    keep: Array
    reach: float

    @cached_property
    def width(self) -> Array:
        return np.diff(self.edges)[self.keep]

    @cached_property
    def curves(self) -> tuple[PPoly, PPoly, PPoly]:
        """Integral of the force, integral of the coordinate, the coordinate."""
        F, x = (CubicSpline(one.t, one.y) for one in (self.F, self.x))
        return F.antiderivative(), x.antiderivative(), x

    def force(self, late: float = 0.0) -> Array:
        """Mean of the force over each window (n,), if its samples are `late` [s]."""
        return self._over(self.curves[0](self.edges + late))

    def asked(self, late: float = 0.0) -> Array:
        """Set-point, its rate, and the force fed forward (n, 3)."""
        inside = np.linspace(self.edges[:-1], self.edges[1:], 2 * INSIDE + 1)[1::2]
        mean, ends = self.reference(inside + late).mean(0)[self.keep], self.reference(self.edges + late)[:, 0]
        return np.stack((mean[:, 0], self._over(ends), mean[:, 1]), -1)

    def found(self, late: float = 0.0) -> Array:
        """The coordinate and its rate (n, 2)."""
        return np.stack([self._over(one(self.edges + late)) for one in self.curves[1:]], -1)

    def _over(self, at_edges: Array) -> Array:
        return np.diff(at_edges)[self.keep] / self.width

    def given(self, asked: Array, found: Array) -> Array:
        """The force that the law gives (n,)."""
        return self.actuator(torch.from_numpy(np.concatenate((asked, found), -1))).detach().numpy()

    @cached_property
    def noise(self) -> tuple[float, float]:
        """How uncertain noise makes the difference of both sides, rms [N], and how much force the law gives per coordinate."""
        inputs = torch.from_numpy(np.concatenate((self.asked(), self.found()), -1)).requires_grad_(True)
        (slope,) = torch.autograd.grad(self.actuator(inputs).sum(), inputs)
        by_x, by_v = slope[:, 3].numpy(), slope[:, 4].numpy()
        F, x = ((one.sensor.noise**2, one.spacing / self.width) for one in (self.F, self.x))
        variance = F[0] * F[1] + x[0] * (by_x**2 * x[1] + 2 * by_v**2 / self.width**2)
        return float(np.sqrt(variance.mean())), float(np.abs(by_x).mean())


class Change(NamedTuple):
    """One thing that may be otherwise: what, as a clause, what is left of the disagreement [N], and whether it is grave."""

    what: str
    said: str
    left: Array
    grave: bool = False


def rms(e: Array) -> float:
    return float(np.sqrt(np.mean(e**2)))


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
    low, high = -np.inf if one.low is None else one.low, np.inf if one.high is None else one.high
    clean = one.inertia == 0 and one.misalignment == 0 and low < y.min() and y.max() < high and len(t) > 3
    return Signal(own, t, y, one) if clean else None


def windows(recording: Recording, actuator: Actuator, F: Signal | None, x: Signal | None) -> Loop | None:
    """The loop of two signals over windows that both have samples in; None where there are too few of them."""
    if F is None or x is None:
        return None
    length = max(WINDOW, 4 * F.spacing, 4 * x.spacing)
    first, last = max(F.t[0], x.t[0]), min(F.t[-1], x.t[-1])
    reach = min(REACH, (last - first) / 8)
    count = int((last - first - 2 * reach) / length)
    if count < FEWEST:
        return None
    edges = first + reach + length * np.arange(count + 1)
    keep = np.logical_and.reduce([np.diff(np.searchsorted(s.t, edges)) * s.spacing > 0.5 * length for s in (F, x)])
    names = [actuator.setpoint, *([actuator.feed_forward] if actuator.feed_forward else [])]

    def reference(t: Array) -> Array:
        at = recording.rig.reference(torch.from_numpy(np.ascontiguousarray(t)), names).detach().numpy()[..., 0]
        return at if actuator.feed_forward else np.stack((at[..., 0], np.zeros(t.shape)), -1)

    return Loop(actuator, reference, F, x, edges, keep, reach) if keep.sum() >= FEWEST else None


def loop_findings(
    recording: Recording, sensors: Mapping[str, Sensor], unknown: Collection[str] = ()
) -> Iterator[Finding]:
    """What looks wrong with the control loops of a recording whose force and coordinate were measured; `unknown` are the
    parameters whose values are not known."""
    rig = recording.rig
    tensors = {id(rig.parameter(name)) for name in unknown}
    for name, actuator in rig.actuators.items():
        F = sampled(recording, sensors, name)
        loop = windows(recording, actuator, F, sampled(recording, sensors, actuator.measures))
        if loop is None:
            continue
        body, _, axis = actuator.measures.partition(".")
        others = {one: f"{one}.{axis}" for one in rig.bodies if one != body}
        rivals = {o: windows(recording, actuator, F, sampled(recording, sensors, x)) for o, x in others.items()}
        found = disagreement(
            rig, loop, body, {k: v for k, v in rivals.items() if v is not None},
            any(id(p) in tensors for p in actuator.parameters()),
        )  # fmt: skip
        if found is not None:
            e = loop.force() - loop.given(loop.asked(), loop.found())
            text = (
                f"recording `{recording.name}`: {found.said} (what the controller makes of {actuator.setpoint} and "
                f"{loop.x.channel} differs from {loop.F.channel} by {rms(e):.3g} {unit(loop.F.channel)} rms, and would by "
                f"{rms(found.left):.3g})"
            )
            yield Finding(found.what, recording.name, text, found.grave)


def disagreement(rig: Rig, loop: Loop, body: str, rivals: Mapping[str, Loop], free: bool) -> Change | None:
    """What is wrong with the loop about a body, if anything is; `free` gains tell only the sign, and what is sensed."""
    F, given = loop.force(), loop.given(loop.asked(), loop.found())
    e, (noise, _) = F - given, loop.noise
    limit = 2 * noise + ROUGH * rms(F)
    changes = [flipped(loop, F, given), *sensed(rig, loop, body, rivals)]
    if free:
        as_it_is, *changes = (scaled(change, F) for change in (Change("", "", e), *changes))
        best = min(changes, key=left)
        clear = left(as_it_is) > limit and left(best) < min(0.5 * left(as_it_is), 0.5 * rms(F))
        return best if clear else None
    if rms(e) <= limit:
        return fine(loop, F, given)
    missing = fed_forward(loop, e)
    if missing is not None and not loop.asked()[:, 2].any():
        return min((missing, *changes), key=left)
    changes += [offset(loop, e), *resized(loop, F, given), *feed_flipped(loop, F)]
    for more in (lambda: [], lambda: [shifted(loop)]):  # which takes longer
        changes += more()
        best = min(changes, key=left)
        if left(best) <= max(limit, EXPLAINED * rms(e)) and left(best) < 0.5 * rms(e):
            return best
    return missing or Change(
        f"loop of {loop.F.channel}",
        f"{loop.F.channel} is not what the controller gives: are its gains right, the units, and the set-points?", e,
    )  # fmt: skip


def left(change: Change) -> float:
    return rms(change.left)


def scaled(change: Change, F: Array) -> Change:
    """What is left if the law's gains may all have another size."""
    given = F - change.left
    return change._replace(left=F - given * max(float(F @ given) / max(float(given @ given), 1e-300), 0.0))


def flipped(loop: Loop, F: Array, given: Array) -> Change:
    name = loop.F.channel
    return Change(f"sign of {name}", f"{name} looks as if its sign were opposite", -F - given, True)


def sensed(rig: Rig, loop: Loop, body: str, rivals: Mapping[str, Loop]) -> Iterator[Change]:
    """The coordinate of another body in the place of the one that the loop is taken to sense."""
    for other, its in rivals.items():
        count = min(len(its.edges), len(loop.edges))
        if count != len(its.edges) or not np.allclose(its.edges, loop.edges):
            continue
        F = its.force()
        yield another_sense(rig, loop.actuator, body, other, F - its.given(its.asked(), its.found()))


def another_sense(rig: Rig, actuator: Actuator, body: str, other: str, left: Array) -> Change:
    paper = isinstance(rig, SoftGrasp) and actuator.measures.endswith(".x")
    remedy = f': control.senses = "{other}"' if paper else ""
    said = f"{actuator.setpoint} looks like the set-point of the {other}, not of the {body}{remedy}"
    return Change("control.senses" if paper else f"what {actuator.setpoint} is of", said, left, True)


def offset(loop: Loop, e: Array) -> Change:
    """A constant more of the force, or of the coordinate."""
    F, x, mean, (_, gain) = loop.F.channel, loop.x.channel, float(e.mean()), loop.noise
    zeros = f", or {x} and {loop.actuator.setpoint} have zeros {abs(mean) / gain:.3g} {unit(x)} apart" if gain > 0 else ""
    return Change(f"zero of {F}", f"{F} reads {mean:+.3g} {unit(F)} too much{zeros}", e - mean)


def resized(loop: Loop, F: Array, given: Array) -> Iterator[Change]:
    """A factor on the force: of a mistaken unit, or not much of one."""
    g, name = float(F @ given) / float(given @ given), loop.F.channel
    for factor, words in confusions(name):
        said = f"{name} looks as if it were in another unit: {words}"
        yield Change(f"unit of {name}", said, F / factor - given, True)
    if 1 / RESIZED < g < RESIZED:
        said = f"{name} is {g:.4g} times what it should be: is that its gain, or the controller's?"
        yield Change(f"size of {name}", said, F / g - given)


def feed_flipped(loop: Loop, F: Array) -> Iterator[Change]:
    """The opposite of what is fed forward."""
    if name := loop.actuator.feed_forward:
        given = loop.given(loop.asked() * [1, 1, -1], loop.found())
        yield Change(f"sign of {name}", f"{name} looks as if its sign were opposite", F - given, True)


def shifted(loop: Loop) -> Change:
    """Samples of the force, of the coordinate, or set-points, that are late or early: one of them, or what fits as well."""
    asked, found, force = loop.asked(), loop.found(), loop.force()
    tried: dict[str, Callable[[float], Array]] = {
        loop.F.channel: lambda late: loop.force(late) - loop.given(asked, found),
        loop.x.channel: lambda late: force - loop.given(asked, loop.found(late)),
        loop.actuator.setpoint: lambda late: force - loop.given(loop.asked(late), found),
    }
    made, times = [], np.linspace(-loop.reach, loop.reach, SHIFTS)
    for name, rest in tried.items():
        square = [rms(rest(late)) ** 2 for late in times]
        i = int(np.clip(np.argmin(square), 1, SHIFTS - 2))
        before, here, after = square[i - 1 : i + 2]
        bend = before - 2 * here + after
        late = float(times[i] + (0.5 * (before - after) / bend * (times[1] - times[0]) if bend > 0 else 0.0))
        made.append(Change(name, f"{name} is {1e3 * abs(late):.3g} ms {'late' if late > 0 else 'early'}", rest(late)))
    best = min(made, key=left)
    return best._replace(
        what=f"time of {best.what}", said=" or ".join(one.said for one in made if left(one) <= AS_GOOD * left(best))
    )


def fed_forward(loop: Loop, e: Array) -> Change | None:
    """A force that was fed forward and is not in the recording: a disagreement that is slow, and not there from the start."""
    name, F = loop.actuator.feed_forward, loop.F.channel
    slow, began = np.diff(e) / np.sqrt(2), float(e[: max(2, len(e) // 20)].mean())
    if name is None or rms(slow) > max(SLOW * rms(e), 2 * loop.noise[0]) or abs(began) > 0.5 * rms(e):
        return None
    said = (
        f"{F} is {float(e.mean()):+.3g} {unit(F)} more, on the average, than the controller gives: was a force fed forward "
        f"that {name} does not have?"
    )
    return Change(name, said, slow)


def fine(loop: Loop, F: Array, given: Array) -> Change | None:
    """A zero, a factor or a time that is off by more than its own uncertainty, where both sides agree roughly."""
    e, n, (noise, gain) = F - given, len(F), loop.noise
    known = loop.F.sensor.bias + gain * loop.x.sensor.bias
    if loop.F.sensor.drift or loop.x.sensor.drift or loop.x.sensor.gain:
        return None
    if abs(e.mean()) > SURE * noise / np.sqrt(n) + 0.02 * rms(F) + known:
        return fed_forward(loop, e) or offset(loop, e)
    off, by_noise = float(F @ given) / float(given @ given) - 1.0, noise / max(rms(given), 1e-300)
    if abs(off) > ROUGH + SURE * by_noise / np.sqrt(n) + 2 * by_noise**2 + loop.F.sensor.gain:
        return next((one for one in resized(loop, F, given) if not one.grave), None)
    slope = (loop.force(LATE) - loop.force(-LATE)) / (2 * LATE)
    late, sd = float(e @ slope / (slope @ slope)), noise / max(float(np.sqrt(slope @ slope)), 1e-300)
    if abs(late) > LATE + SURE * sd + loop.F.sensor.delay + loop.x.sensor.delay:
        return best if left(best := shifted(loop)) < 0.8 * rms(e) else None
    return None
