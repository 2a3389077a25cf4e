"""A control loop whose force and coordinate were measured: both sides of its law, as means over windows of time.

Means over a window need no derivative of what was measured: that of a rate is the difference of its ends.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly
from scipy.optimize import lsq_linear, minimize_scalar

from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.parts import Actuator, coordinate_unit
from torchsoft.physics.rig import Rig
from torchsoft.sysid.recording import BETWEEN, REACH, Array, Recording
from torchsoft.sysid.unknowns import Sensor
from torchsoft.tables import shown


class Finding(NamedTuple):
    """Something that looks wrong in one recording.

    `what` names it, such as "sign of F_x", and so does the user who means it so. A `grave` one makes a fit worthless.
    """

    what: str
    recording: str
    sentence: str
    grave: bool = False


def together(found: Sequence[Finding]) -> list[Finding]:
    """One of every kind: what several recordings have is said of the first, with the names of the others."""
    out: list[Finding] = []
    for what in dict.fromkeys(f.what for f in found):
        first, *others = (f for f in found if f.what == what)
        names = ", ".join(f"`{name}`" for name in dict.fromkeys(f.recording for f in others) if name != first.recording)
        also = f"; so it is in {names}" if names else ""
        out.append(first._replace(sentence=first.sentence + also, grave=any((first.grave, *(f.grave for f in others)))))
    return out


def accepted(found: Sequence[Finding], acknowledged: Sequence[str]) -> list[str]:
    """The sentences of what is not grave, or was said to be meant so. Raises `ValueError` for the others, and for what is meant
    and was not found."""
    names = dict.fromkeys(one.what for one in found)
    if strange := [name for name in acknowledged if name not in names]:
        there = f"what was found is {', '.join(names)}" if names else "nothing looks wrong"
        raise ValueError(
            f"acknowledged: nothing was found that is called {shown(strange[0])}, so leave it out; {there}"
        )
    for one in found:
        if one.grave and one.what not in acknowledged:
            raise ValueError(f'{one.sentence}; if it is so, say acknowledged = ["{one.what}"]')
    return [f"{f.sentence} (acknowledged)" if f.what in acknowledged else f.sentence for f in found]


MISTAKEN = {
    "rad": {180 / math.pi: ("degrees", "radians"), 1e3: ("milliradians", "radians")},
    "m": {1e2: ("centimetres", "metres"), 1e3: ("millimetres", "metres"), 1e6: ("micrometres", "metres")},
    "N": {1e3: ("millinewtons", "newtons"), 1 / 9.81: ("kilograms", "newtons")},
}
"""What makes values of a dimension too large by a factor when it is taken for the other."""


def confusions(unit: str) -> list[tuple[float, str]]:
    """Factors by which a channel in `unit` may be too large, with the units that were confused."""
    known = MISTAKEN.get(unit.removesuffix("/s"), {})
    over = [(factor, f"{a} taken for {b}") for factor, (a, b) in known.items()]
    return over + [(1 / factor, f"{b} taken for {a}") for factor, (a, b) in known.items()]


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


# Do the measured force, the measured coordinate and the set-point of a control loop belong together?


ROUGH = 0.03
"""Part of the force by which both sides may differ besides the noise: drives are not exact."""

SURE = 5.0
"""Standard deviations from which a mean, a factor or a time is called different."""

EXPLAINED = 0.15
"""Part of a disagreement, and of the force, that may be left by what explains it."""

SLOW = 0.3
"""Part of a disagreement by which it may change from window to window where a force fed forward is missing."""

AS_GOOD = 1.15
"""What fits as well: so many times what the best leaves."""

LATE = 1e-3
"""Shift in time [s] from which something is said."""

SHIFTS = 41
"""Shifts in time that are tried, of which the best one is made better."""

RESIZED = 5.0
"""Largest factor on a force that is not one of mistaken units."""


class Change(NamedTuple):
    """One thing that may be otherwise: what, as a clause, what is left of the disagreement [N], and whether it is grave."""

    what: str
    said: str
    left: Array
    grave: bool = False


def rms(e: Array) -> float:
    return float(np.sqrt(np.mean(e**2)))


def loop_findings(
    recording: Recording, sensors: Mapping[str, Sensor], unknown: Collection[str] = ()
) -> Iterator[Finding]:
    """What looks wrong with the control loops of a recording whose force and coordinate were measured; `unknown` are the
    parameters whose values are not known."""
    rig = recording.rig
    tensors = {id(rig.parameter(name)) for name in unknown}
    for name, actuator in rig.loops.items():
        F = sampled(recording, sensors, name)
        loop = windows(recording, actuator, F, sampled(recording, sensors, actuator.measured))
        if loop is None:
            continue
        body, _, axis = actuator.measured.partition(".")
        others = {one: f"{one}.{axis}" for one in rig.bodies if one != body}
        rivals = {o: windows(recording, actuator, F, sampled(recording, sensors, x)) for o, x in others.items()}
        loop, rivals = with_its_lag(loop), {o: with_its_lag(its) for o, its in rivals.items() if its is not None}
        free = any(id(p) in tensors for p in actuator.parameters())
        found = disagreement_of_signs(rig, loop, body, rivals) if free else disagreement(rig, loop, body, rivals)
        if found is not None:
            e = loop.force() - loop.given(loop.asked(), loop.found())
            text = (
                f"recording `{recording.name}`: {found.said} (what the controller makes of {actuator.setpoint} and "
                f"{loop.x.channel} differs from {loop.F.channel} by {rms(e):.3g} {actuator.effort_unit} rms, and would by "
                f"{rms(found.left):.3g})"
            )
            yield Finding(found.what, recording.name, text, found.grave)


def with_its_lag(loop: Loop) -> Loop:
    """The loop with the force as late as fits best, of what its sensors declare."""
    reach = loop.F.sensor.delay + loop.x.sensor.delay
    given = loop.given(loop.asked(), loop.found())
    return replace(loop, lag=best_shift(loop, lambda late: loop.force(late) - given, reach)[0]) if reach > 0 else loop


def disagreement_of_signs(rig: Rig, loop: Loop, body: str, rivals: Mapping[str, Loop]) -> Change | None:
    """What is wrong with a loop about a body whose gains are not known: its sign, or what it senses."""
    F, given = loop.force(), loop.given(loop.asked(), loop.found())
    as_it_is, changes = rms(scaled(F, given)), [flipped(loop, F, given)._replace(left=scaled(-F, given))]
    for other, its in rivals.items():
        e = scaled(its.force(), its.given(its.asked(), its.found()))
        changes.append(another_sense(rig, loop.actuator, body, other, e))
    best = min(changes, key=left)
    clear = as_it_is > 2 * loop.noise.white + ROUGH * rms(F) and left(best) < 0.5 * min(as_it_is, rms(F))
    return best if clear else None


def scaled(F: Array, given: Array) -> Array:
    """What is left of forces if the law's gains may all be larger, or smaller."""
    return F - given * max(over(float(F @ given), float(given @ given)), 0.0)


def over(a: float, b: float) -> float:
    """a / b for b from zero on; large, where that is zero."""
    return a / max(b, 1e-300)


def disagreement(rig: Rig, loop: Loop, body: str, rivals: Mapping[str, Loop]) -> Change | None:
    """What is wrong with a loop about a body, if anything is."""
    F, given = loop.force(), loop.given(loop.asked(), loop.found())
    e, noise = loop.beyond(F - given), loop.noise
    limit, coloured = (2 * sd + ROUGH * rms(F) for sd in (noise.white, noise.coloured))
    if rms(e) <= limit:
        return fine(loop, F, given)
    changes = [flipped(loop, F, given)]
    for other, its in rivals.items():
        left_by_it = its.beyond(its.force() - its.given(its.asked(), its.found()))
        changes.append(another_sense(rig, loop.actuator, body, other, left_by_it))
    missing = fed_forward(loop, e) if loop.unfed or rms(e) > coloured else None
    if missing is not None and loop.unfed:
        return min((missing, *changes), key=left)
    changes += [*resized(loop, F, given), *feed_flipped(loop, F), *([offset(loop, e)] if is_off(loop, F, e) else [])]
    for more in (lambda: [], lambda: [shifted(loop)]):  # which takes longer
        changes += more()
        best = min(changes, key=left)
        if left(best) <= max(limit, EXPLAINED * min(rms(e), rms(F))) and left(best) < 0.5 * rms(e):
            return best
    if missing is not None or rms(e) <= coloured:
        return missing
    said = f"{loop.F.channel} is not what the controller gives: are its gains right, the units, and the set-points?"
    return Change(f"loop of {loop.F.channel}", said, e)


def left(change: Change) -> float:
    return rms(change.left)


def flipped(loop: Loop, F: Array, given: Array) -> Change:
    name = loop.F.channel
    return Change(f"sign of {name}", f"{name} looks as if its sign were opposite", loop.beyond(-F - given), True)


def another_sense(rig: Rig, actuator: Actuator, body: str, other: str, left: Array) -> Change:
    paper = isinstance(rig, SoftGrasp) and actuator.measured.endswith(".x")
    axis = actuator.measured.partition(".")[2]
    remedy = f' (say control.senses = "{other}")' if paper else ""
    said = (
        f"{actuator.setpoint} looks like the set-point of the {other}, not of the {body}{remedy}; or are "
        f"{channel(rig, f'{body}.{axis}')} and {channel(rig, f'{other}.{axis}')} exchanged?"
    )
    return Change("control.senses" if paper else f"what {actuator.setpoint} is of", said, left, True)


def offset(loop: Loop, e: Array) -> Change:
    """A constant more of the force, or of the coordinate."""
    loops, gain = loop.actuator, loop.noise.gain
    F, x, mean, unit, own = (
        loop.F.channel,
        loop.x.channel,
        float(e.mean()),
        loops.effort_unit,
        coordinate_unit(loops.measured),
    )
    zeros = f", or {x} and {loops.setpoint} have zeros {abs(mean) / gain:.3g} {own} apart" if gain > 0 else ""
    return Change(f"zero of {x}", f"{F} reads {mean:+.3g} {unit} too much{zeros}", e - mean)


def resized(loop: Loop, F: Array, given: Array) -> Iterator[Change]:
    """A factor on the force: of a mistaken unit, or not much of one."""
    g, name = over(float(F @ given), float(given @ given)), loop.F.channel
    for factor, words in confusions(loop.actuator.effort_unit):
        said = f"{name} looks as if it were in another unit: {words}"
        yield Change(f"unit of {name}", said, loop.beyond(F / factor - given), True)
    if 1 / RESIZED < g < RESIZED:
        said = f"{name} is {g:.4g} times what it should be: is that its gain, or the controller's?"
        yield Change(f"size of {name}", said, loop.beyond(F / g - given))


def feed_flipped(loop: Loop, F: Array) -> Iterator[Change]:
    """The opposite of what is fed forward."""
    if name := loop.actuator.feed_forward:
        given = loop.given(loop.asked() * [1, 1, -1], loop.found())
        yield Change(f"sign of {name}", f"{name} looks as if its sign were opposite", loop.beyond(F - given), True)


def best_shift(loop: Loop, rest: Callable[[float], Array], reach: float) -> tuple[float, Array]:
    """The shift in time [s], up to `reach` to each side, that leaves least of a disagreement, and what it leaves."""

    def still(late: float) -> Array:
        return loop.beyond(rest(late))[loop.inner]

    times = np.linspace(-reach, reach, SHIFTS)
    near, step = float(min(times, key=lambda late: rms(still(late)))), float(times[1] - times[0])
    found = minimize_scalar(lambda late: rms(still(late)), bounds=(near - step, near + step), options={"xatol": 1e-5})
    late = float(np.clip(found.x, -reach, reach))
    return late, still(late)


def shifted(loop: Loop) -> Change:
    """Samples of the force, of the coordinate, or set-points, that are late or early: one of them, or what fits as well."""
    asked, found, force = loop.asked(), loop.found(), loop.force()
    tried: dict[str, Callable[[float], Array]] = {
        loop.F.channel: lambda late: loop.force(late) - loop.given(asked, found),
        loop.x.channel: lambda late: force - loop.given(asked, loop.found(late)),
        loop.actuator.setpoint: lambda late: force - loop.given(loop.asked(late), found),
    }
    made = []
    for name, rest in tried.items():
        late, e = best_shift(loop, rest, loop.reach)
        made.append(Change(name, f"{name} is {1e3 * abs(late):.3g} ms {'late' if late > 0 else 'early'}", e))
    best = min(made, key=left)
    return best._replace(
        what=f"time of {best.what}", said=" or ".join(one.said for one in made if left(one) <= AS_GOOD * left(best))
    )


def fed_forward(loop: Loop, e: Array) -> Change | None:
    """A force that was fed forward and is not in the recording: a disagreement that is slow, and not there from the start."""
    name, F = loop.actuator.feed_forward, loop.F.channel
    slow, began = np.diff(e) / np.sqrt(2), float(e[: max(2, len(e) // 20)].mean())
    if name is None or rms(slow) > max(SLOW * rms(e), 2 * loop.noise.white) or abs(began) > 0.5 * rms(e):
        return None
    said = (
        f"{F} is {float(e.mean()):+.3g} {loop.actuator.effort_unit} more, on the average, than the controller gives: was a "
        f"force fed forward that {name} does not have?"
    )
    return Change(name, said, slow)


def inflated(e: Array) -> float:
    """How much larger the standard deviation of a mean of e (n,) is for their correlation: that of coloured noise, say."""
    d = e - e.mean()
    rho = np.correlate(d, d, "full")[len(d) - 1 :] / max(float(d @ d), 1e-300)
    until = int(np.argmax(rho <= 0)) if (rho <= 0).any() else len(rho)
    return float(np.sqrt(max(1.0, 1 + 2 * rho[1:until].sum())))


def is_off(loop: Loop, F: Array, e: Array) -> bool:
    """Whether the mean of a disagreement is not that of noise. Where nothing was fed forward, noise is taken to be white."""
    sd = loop.noise.white if loop.unfed else max(loop.noise.white, rms(e - e.mean())) * inflated(e)
    return bool(abs(e.mean()) > SURE * sd / np.sqrt(len(e)) + 0.02 * rms(F))


def fine(loop: Loop, F: Array, given: Array) -> Change | None:
    """A zero, a factor or a time that is off by more than its own uncertainty, where both sides agree roughly."""
    e = loop.beyond(F - given)
    noise = loop.noise.white * inflated(e)
    if is_off(loop, F, e):
        return fed_forward(loop, e) or offset(loop, e)
    off, by_noise = over(float(e @ given), float(given @ given)), over(noise, rms(given))
    if abs(off) > ROUGH + SURE * by_noise / np.sqrt(len(F)) + 2 * by_noise**2:
        return next((one for one in resized(loop, F, given) if not one.grave), None)
    slope = ((loop.force(LATE) - loop.force(-LATE)) / (2 * LATE))[loop.inner]
    late, sd = over(float(e[loop.inner] @ slope), float(slope @ slope)), over(noise, float(np.sqrt(slope @ slope)))
    if abs(late) > LATE + SURE * sd:
        return best if left(best := shifted(loop)) < 0.8 * rms(e) else None
    return None
