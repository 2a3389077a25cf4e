"""Checks of recordings against their rig before any fit: set-points, controllers, signs, units.

Signs and units of channels are compared with a run at the start's parameters. The mean recorded
force of an actuator is compared with its known law at the measured coordinates.
"""

import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from torchsoft.physics.motion import Sampled, spline_rates
from torchsoft.physics.names import effort_channel
from torchsoft.physics.parts import Actuator
from torchsoft.physics.rig import Rig
from torchsoft.sysid.initial_state import PREFIX
from torchsoft.sysid.prediction import Prediction, Readout
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sentences import Finding
from torchsoft.sysid.stages import LOOSE
from torchsoft.sysid.unknowns import Sensor
from torchsoft.tables import shown

Expected = Mapping[str, tuple[Readout, Prediction]]
"""Readouts of a run, with the run, by channel."""


def precheck(problem: Problem, runner: Runner, which: Sequence[str] | None = None) -> list[Finding]:
    """Findings on some recordings of a problem, by default all: one for each name."""
    every, x = list[Finding](), problem.coordinates.start
    which = problem.names if which is None else which
    unknown = [name for name in problem.coordinates.names if not name.startswith(PREFIX)]
    jobs = problem.jobs(x, which, LOOSE, None)
    with warnings.catch_warnings(action="ignore"):  # of motions that a mistake makes violent
        runs = runner.run(jobs)
    for job, run in zip(jobs, runs):
        recording, expected = problem.recordings[job.recording], {}
        if isinstance(run, Prediction):
            readouts = problem.readouts(x, job.recording)
            expected = {name: (one, run) for name, one in readouts.items()}
        every += findings(recording, problem.sensors, expected, unknown)
    return together(every)


def findings(
    recording: Recording,
    sensors: Mapping[str, Sensor],
    expected: Expected,
    unknown: Collection[str] = (),
) -> list[Finding]:
    """Findings on one recording, compared with the readouts `expected` of a run from the start,
    if there is one; `unknown` are the names of unknown parameters. A recording with an error is not
    compared with the run."""
    here = {name: one for name, one in sensors.items() if name in recording.samples}
    every = [*setpoint_findings(recording, here), *noise_findings(recording, here)]
    every += resolution_findings(recording, here)
    for more in (
        run_findings(recording, here, expected),
        controller_findings(recording, here, unknown),
    ):
        if not any(one.severity == "error" for one in every):
            every += more
    return every


def found(code: str, name: str, recording: Recording, grave: bool = False, **facts: Any) -> Finding:
    """A finding on one recording, an error if it is `grave`; `name` is what a user acknowledges."""
    facts = {"name": name, "recording": recording.name} | facts
    return Finding(code, "error" if grave else "warning", facts)


def together(every: Sequence[Finding]) -> list[Finding]:
    """One finding for each name: the gravest, with the names of the other recordings."""
    out = list[Finding]()
    for name in dict.fromkeys(one.facts["name"] for one in every):
        mine = [one for one in every if one.facts["name"] == name]
        first, *others = sorted(mine, key=lambda one: one.severity)
        alike = dict.fromkeys(f"`{one.facts['recording']}`" for one in others)
        alike.pop(f"`{first.facts['recording']}`", None)
        more = {"others_alike": [*alike]} if alike else {}
        out.append(replace(first, facts=first.facts | more))
    return out


def accepted(every: Sequence[Finding], acknowledged: Sequence[str]) -> list[Finding]:
    """Findings on recordings, those that are acknowledged as notes. Raises `ValueError` for other
    errors, and for an acknowledged name without a finding."""
    names = dict.fromkeys(one.facts["name"] for one in every)
    if strange := [name for name in acknowledged if name not in names]:
        there = f"the findings are {', '.join(names)}" if names else "nothing looks wrong"
        raise ValueError(
            f"acknowledged: there is no finding {shown(strange[0])}, so leave it out; {there}"
        )
    for one in every:
        if one.severity == "error" and one.facts["name"] not in acknowledged:
            raise ValueError(f'{one} If it is right, set acknowledged = ["{one.facts["name"]}"]')
    return [replace(one, severity="note") for one in every]


def channel(rig: Rig, name: str) -> str:
    """Channel of a coordinate such as "disc.x", or of the effort of an actuator such as "x"."""
    body, _, axis = name.partition(".")
    return f"{axis}_{rig.symbols[body]}" if axis else effort_channel(body)


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


# Set-points: their spacing in time, and the agreement of rates with values.
#
# A recorded signal is known at its rows only, with a cubic between them. The error of the cubic
# is estimated from that of the cubic through every second row, and from that with other rates, of a
# spline through the values. It is stated by its effect: the error of the set-point over the noise
# of that coordinate's sensor, and that of the effort over the noise of the force.


NOTICED = 0.2
"""Error between rows, over a sensor's noise, above which a warning is given: residuals would be off
by it everywhere."""

HOPELESS = 100.0
"""Error between rows, over a sensor's noise, that makes a fit worthless."""

ORDER = 3.0
"""Order by which the error of a cubic falls with the distance of its rows, where the curve has
bends between them; 4 where it is smooth."""

PARTS = (0.0, 0.25, 0.5, 0.75)
"""Positions between rows at which signals are compared."""

OTHER_RATE = 0.25
"""Largest relative difference of a rate from that of the spline through the values, which must be
known to half of it."""


class Gap(NamedTuple):
    """Error between rows: rms [SI], and over the noise of a channel."""

    channel: str
    error: float
    noises: float


def setpoint_findings(recording: Recording, sensors: Mapping[str, Sensor]) -> Iterator[Finding]:
    """Findings on the set-points of a recording. For controllers of several coordinates only
    rates are tested here."""
    rig = recording.rig
    setpoints = {name for one in rig.actuators.values() for name in one.setpoints}
    recorded = {
        name: signal
        for name in sorted(setpoints)
        if isinstance(signal := rig.reference[name], Sampled)
    }
    wrong = {name: rate_findings(recording, name, one) for name, one in recorded.items()}
    for finding in wrong.values():
        yield from finding
    for name, actuator in rig.loops.items():
        if actuator.setpoint in recorded and not wrong[actuator.setpoint]:
            signal = recorded[actuator.setpoint]
            worst = max(gaps(recording, sensors, name), key=lambda gap: gap.noises, default=None)
            if worst is not None and worst.noises > NOTICED:
                yield sparse(recording, actuator.setpoint, signal, worst)


def rate_findings(recording: Recording, setpoint: str, signal: Sampled) -> list[Finding]:
    """A finding on rates unlike those of the values."""
    times, values = signal.times, signal.values.detach()
    given, own = signal.rates.detach().numpy(), spline_rates(times, values).numpy()
    fewer = spline_rates(times[::2], values[::2]).numpy()
    size, off = rms(own), rms(given - own)
    unsure = rms(fewer - own[::2]) > OTHER_RATE / 2 * size
    if unsure or off <= OTHER_RATE * max(size, rms(given)):
        return []
    factor = float(given @ own) / max(float(own @ own), 1e-300)
    looks = {"opposite" if factor < 0 else "factor": factor}
    facts = {"setpoint": setpoint, "off": off, "size": size} | looks
    return [found("rate", f"rate of {setpoint}", recording, True, **facts)]


def sparse(recording: Recording, setpoint: str, signal: Sampled, worst: Gap) -> Finding:
    """Finding on set-points that are too far apart in time."""
    apart = 1e3 * float(signal.times.diff().max())
    return found(
        "set-points",
        f"set-points {setpoint}",
        recording,
        worst.noises > HOPELESS,
        setpoint=setpoint,
        apart=apart,
        error=worst.error,
        unit=recording.units[worst.channel],
        noises=worst.noises,
        channel=worst.channel,
        enough=apart * (NOTICED / worst.noises) ** (1 / ORDER),
        **{"lacking" if is_derived(signal) else "given": f"{setpoint}_dot"},
    )


def is_derived(signal: Sampled) -> bool:
    """Whether the rates are those of the spline through the values."""
    own = spline_rates(signal.times, signal.values)
    return bool(torch.allclose(own, signal.rates, rtol=1e-9, atol=1e-12))


def thinned(signal: Any, every: int, other_rates: bool) -> Any:
    """A recorded signal at every so-many-th row, with its own rates or those of a spline through
    the values; other signals as they are."""
    if not isinstance(signal, Sampled):
        return signal
    rates = None if other_rates or is_derived(signal) else signal.rates.detach()[::every]
    return Sampled(signal.times[::every], signal.values.detach()[::every], rates)


@torch.no_grad()
def gaps(recording: Recording, sensors: Mapping[str, Sensor], name: str) -> list[Gap]:
    """Errors between rows of an actuator's set-point, in the channels with sensors."""
    rig, actuator = recording.rig, recording.rig.actuators[name]
    signal = rig.reference[actuator.setpoint]
    if not isinstance(signal, Sampled) or len(signal.times) < 9:
        return []
    t, signals = signal.times, [rig.reference[one] for one in actuator.reads]
    inside = torch.cat([t[:-1] + part * t.diff() for part in PARTS]).sort().values
    inside = inside[inside <= t[2 * ((len(t) - 1) // 2)]]
    seen, places, efforts = signal(inside), list[Tensor](), list[Tensor]()
    for every, other_rates in ((1, False), (2, False), (1, True)):
        asked = [x for one in signals for x in thinned(one, every, other_rates)(inside)]
        places.append(asked[0])
        efforts.append(actuator(torch.stack((*asked, *seen), -1)))
    out = list[Gap]()
    for own, by in ((channel(rig, actuator.measured), places), (channel(rig, name), efforts)):
        if own in sensors:
            sparser, other = (rms((one - by[0]).numpy()) for one in by[1:])
            error = max(sparser / (2**ORDER - 1), other)
            out.append(Gap(own, error, error / sensors[own].sd))
    return out


# Noise and resolution


COARSE = 1.2
"""Least ratio of a sensor's quantisation to its noise for a warning; it widens the noise by 6 % and
more."""

ENOUGH, WIDTH = 10, 0.5
"""Samples of a channel whose range, over their noise, is not smaller than that by chance."""


def noise_findings(recording: Recording, sensors: Mapping[str, Sensor]) -> Iterator[Finding]:
    """Noise that is stated so large that samples could not be as near to each other as they are."""
    for name, sensor in sensors.items():
        y = recording.samples[name][1]
        if len(y) < ENOUGH:
            continue
        if np.ptp(y) == 0 and sensor.resolution < sensor.noise and not sensor.saturated(y).any():
            yield constant(recording, name, noise=sensor.noise)
        elif 0 < np.ptp(y) < WIDTH * sensor.noise:
            facts = {"noise": sensor.noise, "range": float(np.ptp(y))}
            facts |= {"channel": name, "unit": recording.units[name]}
            yield found("noise", f"noise of {name}", recording, True, **facts)


def constant(recording: Recording, name: str, **contradiction: float) -> Finding:
    """Finding on a channel whose samples are all equal, with what contradicts that: the stated
    `noise`, or the motion of a `run`."""
    y, unit = recording.samples[name][1], recording.units[name]
    facts = {"channel": name, "value": float(y[0]), "unit": unit, "samples": len(y)}
    return found("constant", f"constant {name}", recording, True, **facts, **contradiction)


def resolution_findings(recording: Recording, sensors: Mapping[str, Sensor]) -> Iterator[Finding]:
    """Warnings on quantised readings whose steps the stated noise and resolution omit."""
    for name, sensor in sensors.items():
        apart = np.diff(np.unique(unsaturated(recording, sensor, name)[1]))
        q = float(apart.min(initial=math.inf))
        if not COARSE * max(sensor.noise, sensor.resolution) < q < math.inf:
            continue
        if np.abs(apart / q - np.round(apart / q)).max() < 1e-3:
            facts = {"step": q, "unit": recording.units[name], "ratio": q / sensor.noise}
            yield found("resolution", f"resolution of {name}", recording, channel=name, **facts)


def unsaturated(recording: Recording, sensor: Sensor, name: str) -> tuple[Array, Array]:
    """Times and values of a channel's unsaturated samples."""
    t, y = recording.samples[name]
    inside = ~sensor.saturated(y)
    return t[inside], y[inside]


# Signs and units


MOVES = 5.0
"""Least motion of a channel, over its noise, for a judgement."""

OPPOSITE = -0.5
"""Correlation with the run below which a sign counts as opposite, beyond the effect of wrong
parameters."""

LARGER = 8.0
"""Factor between the sizes of motions above which wrong parameters, off by three, are no
explanation."""

NEAR = math.log(4.0)
"""Largest difference of the logarithm of such a factor from that of confused units."""

MISTAKEN = {
    "rad": {180 / math.pi: ("degrees", "radians"), 1e3: ("milliradians", "radians")},
    "m": {
        1e2: ("centimetres", "metres"),
        1e3: ("millimetres", "metres"),
        1e6: ("micrometres", "metres"),
    },
    "N": {1e3: ("millinewtons", "newtons"), 1 / 9.81: ("kilograms", "newtons")},
}
"""Factors between units that are commonly confused, by SI unit."""


def confusions(unit: str) -> list[tuple[float, str]]:
    """Factors by which a channel in `unit` may be too large, with the confused units."""
    known = MISTAKEN.get(unit.removesuffix("/s"), {})
    over = [(factor, f"{a} taken for {b}") for factor, (a, b) in known.items()]
    return over + [(1 / factor, f"{b} taken for {a}") for factor, (a, b) in known.items()]


def run_findings(
    recording: Recording, sensors: Mapping[str, Sensor], expected: Expected
) -> Iterator[Finding]:
    """Findings on channels whose sign or unit contradicts the run."""
    for name, (one, predicted) in expected.items():
        (t, y), least = unsaturated(recording, sensors[name], name), MOVES * sensors[name].sd
        if len(t) < 2 * MOVES:
            continue
        p = one.expected(predicted, t)[0]
        measured, run = float(np.std(y)), float(np.std(p))
        ratio = measured / max(run, 1e-300)
        if max(measured, run) < least:
            continue
        if measured == 0:
            yield constant(recording, name, run=run)
        elif run > 0 and not 1 / LARGER < ratio < LARGER:
            yield size_finding(recording, name, ratio)
        elif min(measured, run) >= least:
            alike = float(np.mean((y - y.mean()) * (p - p.mean()))) / (measured * run)
            if alike < OPPOSITE:
                more = {"channel": name, "correlation": alike}
                yield found("sign", f"sign of {name}", recording, True, **more)


def size_finding(recording: Recording, name: str, ratio: float) -> Finding:
    """Finding on a channel that moves by a `ratio` more than the run: its unit is another one,
    where that explains it, or the parameters are wrong."""
    known = [
        (abs(math.log(ratio / factor)), confusion)
        for factor, confusion in confusions(recording.units[name])
    ]
    distance, confusion = min(known, default=(math.inf, ""))
    facts = {"channel": name, "ratio": ratio}
    if distance < NEAR and not 1 / LARGER**1.5 < ratio < LARGER**1.5:
        return found("unit", f"unit of {name}", recording, True, **facts, confusion=confusion)
    return found("size", f"size of {name}", recording, **facts)


# Controllers


FEWEST = 8
"""Fewest samples for a judgement of a controller."""

ROUGH = 0.03
"""Relative difference, besides the noise, between a force and its controller's law that counts as
normal: drives are not exact."""


def controller_findings(
    recording: Recording, sensors: Mapping[str, Sensor], unknown: Collection[str] = ()
) -> Iterator[Finding]:
    """Findings on forces whose mean differs from their controller's, where no sensor of the
    force or of its coordinates has a fault to be estimated, and no gain is among the `unknown`
    parameters."""
    rig = recording.rig
    tensors = {id(rig.parameter(name)) for name in unknown}
    for name, actuator in rig.actuators.items():
        force, *others = every = [channel(rig, one) for one in (name, *actuator.measures)]
        lacking = [one for one in every if not comparable(recording, sensors, one)]
        if lacking and force not in lacking and not actuator.is_loop:
            name = f"controller of {force}"
            one = found("not-compared", name, recording, force=force, lacking=lacking[0])
            yield replace(one, severity="note")
        faults = [(s.bias, s.delay, s.gain, s.drift) for s in map(sensors.get, every) if s]
        if lacking or np.any(faults) or any(id(p) in tensors for p in actuator.parameters()):
            continue
        off, usual = mean_difference(recording, sensors, actuator, force, others)
        if abs(off) > usual:
            feed = actuator.feed_forward
            ask = {"feed": feed} if feed else {"loop": f"the actuator {name}"}
            facts: dict[str, Any] = {"force": force, "off": off, "unit": actuator.effort_unit}
            facts |= ask
            yield found("controller", feed or f"loop of {force}", recording, **facts)


def comparable(recording: Recording, sensors: Mapping[str, Sensor], name: str) -> bool:
    """Whether a channel has samples of a sensor without inertia, misalignment or saturation."""
    if name not in recording.samples or name not in sensors:
        return False
    one, y = sensors[name], recording.samples[name][1]
    return one.inertia == 0 and one.misalignment == 0 and not one.saturated(y).any() and len(y) > 3


def mean_difference(
    recording: Recording,
    sensors: Mapping[str, Sensor],
    actuator: Actuator,
    force: str,
    others: Sequence[str],
) -> tuple[float, float]:
    """Mean difference [N or N.m] of a recorded `force` from that of its actuator at the recorded
    coordinates `others`, and the difference that noise and an inexact drive may cause. Both are
    zero for too few samples."""
    t, F = recording.samples[force]
    for at, _ in (recording.samples[one] for one in others):  # not in a gap
        reach = 2 * float(np.median(np.diff(at)))
        near = np.searchsorted(at, t + reach) > np.searchsorted(at, t - reach)
        t, F = t[near], F[near]
    if len(t) < FEWEST:
        return 0.0, 0.0
    asked = [
        part for one in actuator.reads for part in recording.rig.reference[one](torch.tensor(t))
    ]
    splines = [CubicSpline(*recording.samples[one]) for one in others]
    seen = [torch.from_numpy(s(t, order)) for s in splines for order in (0, 1)]
    inputs = torch.stack((*asked, *seen), -1).detach().requires_grad_(True)
    given = actuator(inputs)
    (slopes,) = torch.autograd.grad(given.sum(), inputs)
    by = slopes[:, len(asked) :: 2].square().mean(0).tolist()
    noise = [slope * sensors[one].noise ** 2 for slope, one in zip(by, others)]
    apart = F - given.detach().numpy()
    apart -= shift_of_start(recording, actuator, t, apart, slopes[:, 0].numpy())
    return float(np.mean(apart)), 2 * (sensors[force].noise ** 2 + sum(noise)) ** 0.5 + ROUGH * rms(
        F
    )


def shift_of_start(
    recording: Recording, actuator: Actuator, t: Array, apart: Array, slope: Array
) -> Array:
    """Part (k,) of the difference `apart` of a force from its controller's that is the shift of a
    set-point with the start of a body, which the parameters that are not known yet decide: as large
    as the first samples have it. `slope` is the derivative with respect to the set-point."""
    followed = getattr(recording.start, "followed", {}).get(actuator.setpoint)
    if followed is None or not slope[:FEWEST].all():
        return np.zeros_like(apart)
    signal: Any = recording.rig.reference[actuator.setpoint]
    weights = torch.tensor(followed.weights, dtype=torch.float64).expand(signal.values.shape)
    by_start = slope * signal.with_values(weights)(torch.tensor(t))[0].detach().numpy()
    return float(np.mean(apart[:FEWEST] / slope[:FEWEST])) * by_start
