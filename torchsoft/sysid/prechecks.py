"""Comparison of recordings with the capability of their rig, before any fit: signs, units, set-points, delays, zeros."""

import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.motion import Sampled, spline_rates
from torchsoft.physics.parts import COORDINATES, Actuator
from torchsoft.physics.rig import Rig
from torchsoft.sysid.initial_state import PREFIX, AtRest
from torchsoft.sysid.loops import Finding, another_sense, channel, confusions, loop_findings, together
from torchsoft.sysid.plan import LOOSE
from torchsoft.sysid.prediction import Prediction, Readout, Signals
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import REACH, Array, Recording
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import Sensor

# Are recorded set-points close enough together for their motion, and are their rates theirs?


NOTICED = 0.2
"""Part of a sensor's noise from which what happens between rows is said: residuals would be off by it everywhere."""

HOPELESS, ORDERLESS = 100.0, 1.0
"""Times a sensor's noise by which the unknown between rows makes a fit worthless, if it does not even fall by this order where
rows are closer."""

ORDERS = (0.5, 4.0)
"""Least and largest order that is believed; a cubic through exact values has the largest."""

BETWEEN = (0.0, 0.25, 0.5, 0.75)
"""Where between rows signals are compared."""

OTHER_RATE = 0.25
"""Part of a rate by which it may differ from that of the spline through the values, which must be sure to half of it."""


class Gap(NamedTuple):
    """What happens between rows: an error [SI], rms, in units of the noise of a channel, and the order with which it falls."""

    channel: str
    error: float
    noises: float
    order: float


def cubic(signal: Sampled, every: int, derived: bool) -> Sampled:
    """The signal by one in so many rows; rates that were `derived` from all rows are derived from these."""
    rates = None if derived else signal.rates.detach()[::every]
    return Sampled(signal.times[::every], signal.values.detach()[::every], rates)


def is_derived(signal: Sampled) -> bool:
    """Whether its rates are those of the spline through its values."""
    own = spline_rates(signal.times, signal.values)
    return bool(torch.allclose(own, signal.rates, rtol=1e-9, atol=1e-12))


def extrapolated(by: Mapping[int, Tensor]) -> tuple[float, float]:
    """RMS error of a quantity at every row, from those by every row, every second and every fourth; and the observed order."""
    half, quarter = (float((by[2 * k] - by[k]).square().mean().sqrt()) for k in (1, 2))
    order = float(np.clip(np.log2(max(quarter, 1e-300) / max(half, 1e-300)), *ORDERS))
    return half / (2**order - 1), order


def gaps(recording: Recording, sensors: Mapping[str, Sensor], name: str) -> list[Gap]:
    """What the rows of an actuator's set-point leave open, in the channels that have sensors."""
    rig, out = recording.rig, []
    actuator = rig.actuators[name]
    signal = rig.reference[actuator.setpoint]
    if not isinstance(signal, Sampled) or len(signal.times) < 9:
        return []
    feed = rig.reference[actuator.feed_forward] if actuator.feed_forward else None
    t, derived = signal.times, is_derived(signal)
    inside = torch.cat([t[:-1] + part * t.diff() for part in BETWEEN]).sort().values
    inside = inside[inside <= t[4 * ((len(t) - 1) // 4)]]
    x, v = signal(inside)
    places, efforts = {}, {}
    for every in (1, 2, 4):
        places[every], rate = cubic(signal, every, derived)(inside)
        efforts[every] = demanded(actuator, feed, every, inside, places[every], rate, x, v)
    for own, by in ((channel(rig, actuator.measured), places), (channel(rig, name), efforts)):
        if own in sensors and own in recording.samples:
            error, order = extrapolated(by)
            out.append(Gap(own, error, error / sensors[own].noise, order))
    return out


@torch.no_grad()
def demanded(
    actuator: Actuator, feed: nn.Module | None, every: int, t: Tensor, place: Tensor, rate: Tensor, x: Tensor, v: Tensor
) -> Tensor:
    """What the controller makes (n,) of a set-point while its coordinate is at x and moves at v."""
    known = cubic(feed, every, is_derived(feed)) if isinstance(feed, Sampled) else feed
    more = torch.zeros_like(x) if known is None else known(t)[0]
    return actuator(torch.stack((place, rate, more, x, v), -1))


def setpoint_findings(recording: Recording, sensors: Mapping[str, Sensor]) -> Iterator[Finding]:
    """What looks wrong with the set-points of a recording. Of laws of several coordinates only rates are judged here: that
    they are too sparse shows when every second one is left out (`checks`)."""
    rig = recording.rig
    recorded = {n for one in rig.actuators.values() for n in one.setpoints if isinstance(rig.reference[n], Sampled)}
    findings = {name: other_rate(recording, name) for name in sorted(recorded)}
    yield from (one for one in findings.values() if one is not None)
    for name, actuator in rig.loops.items():
        if actuator.setpoint in recorded and findings[actuator.setpoint] is None:
            sparse = sparse_finding(recording, sensors, name)
            if sparse is not None:
                yield sparse


def sparse_finding(recording: Recording, sensors: Mapping[str, Sensor], name: str) -> Finding | None:
    """The words on set-points that are too far apart."""
    found = gaps(recording, sensors, name)
    if not found or (worst := max(found, key=lambda gap: gap.noises)).noises <= NOTICED:
        return None
    setpoint = recording.rig.actuators[name].setpoint
    signal = recording.rig.reference[setpoint]
    assert isinstance(signal, Sampled)
    apart = float(signal.times.diff().max())
    enough = apart * (NOTICED / worst.noises) ** (1 / worst.order)
    rates = f", and its rate is not known (no column {setpoint}_dot)" if is_derived(signal) else ""
    if worst.order <= ORDERS[0] and not is_derived(signal):  # closer rows would not help
        text = (
            f"recording `{recording.name}`: values and rates of {setpoint} disagree however close the rows are, by "
            f"{worst.noises:.2g} times the noise of {worst.channel}: is a clock, or a unit of time, a little off?"
        )
        return Finding(f"rate of {setpoint}", recording.name, text, worst.noises > HOPELESS)
    size = f"{worst.error:.2g} {recording.units[worst.channel]}, {worst.noises:.2g} times the noise of {worst.channel}"
    text = (
        f"recording `{recording.name}`: set-points {setpoint} every {1e3 * apart:.3g} ms are too sparse for this motion"
        f"{rates}: what they leave open between them makes {size}; give them every {1e3 * enough:.2g} ms"
    )
    return Finding(f"set-points {setpoint}", recording.name, text, worst.noises > HOPELESS and worst.order <= ORDERLESS)


def other_rate(recording: Recording, setpoint: str) -> Finding | None:
    """The words on rates that are not those of the values."""
    signal = recording.rig.reference[setpoint]
    assert isinstance(signal, Sampled)
    times, values = signal.times, signal.values.detach()
    given, own = signal.rates.detach().numpy(), spline_rates(times, values).numpy()
    fewer = spline_rates(times[::2], values[::2]).numpy()
    size, off, unsure = (float(np.sqrt(np.mean(e**2))) for e in (own, given - own, fewer - own[::2]))
    if off <= OTHER_RATE * max(size, float(np.sqrt(np.mean(given**2)))) or unsure > OTHER_RATE / 2 * size:
        return None
    factor = float(given @ own) / max(float(own @ own), 1e-300)
    looks = "its sign looks opposite" if factor < 0 else f"it is {factor:.3g} times that"
    text = (
        f"recording `{recording.name}`: {setpoint}_dot is not the rate of {setpoint}: it differs by {off:.3g} rms from that "
        f"of a spline through it, {size:.3g}; {looks}"
    )
    return Finding(f"rate of {setpoint}", recording.name, text, grave=True)


# Do recordings mean what the model takes them to mean? Looked at before a fit, which would give wrong numbers without a word.


MOVES = 5.0
"""Times its noise that a channel moves, where its motion says something."""

OPPOSITE = -0.5
"""Correlation with the run below which a sign is called opposite: wrong parameters do not do that."""

LARGER = 8.0
"""Factor between the sizes of motions from which parameters, off by three, do not explain it."""

NEAR = math.log(4.0)
"""How near such a factor must be to one of mistaken units, in its logarithm."""

LATE = 40e-3
"""Delay [s] from which wrong parameters do not explain it."""

SAME = 0.1
"""Part of its motion by which what follows a set-point may differ from it."""

APART = 0.3
"""And by which what does not follow it differs."""

EARLY = 10e-3
"""Time [s] from the first sample on in which nothing moves that begins at rest."""

SURE, COLOURED = 5.0, 3.5
"""Standard deviations from which a mean is called different: those of a mean, and those of one sample, which a mean of
coloured noise may have."""


def precheck(problem: Problem, runner: Runner, which: Sequence[str] | None = None) -> list[Finding]:
    """What looks wrong in some recordings of a problem, or in all: one finding of every kind."""
    found, x = list[Finding](), problem.coordinates.start
    which = problem.names if which is None else which
    unknown = [name for name in problem.coordinates.names if not name.startswith(PREFIX)]
    jobs = problem.jobs(x, which, LOOSE, None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of motions that a mistake makes violent
        runs = runner.run(jobs)
    for job, got in zip(jobs, runs):
        recording, expected = problem.recordings[job.recording], {}
        if isinstance(got, Prediction):
            signals = Signals(got.t, recording.channels, got.signals, None)
            expected = {name: (one, signals) for name, one in problem.readouts(x, job.recording).items()}
        found += findings(recording, problem.sensors, expected, unknown)
    return together(found)


Expected = Mapping[str, tuple[Readout, Signals]]
"""The sensors of a run, with its signals."""


def findings(
    recording: Recording, sensors: Mapping[str, Sensor], expected: Expected, unknown: Collection[str] = ()
) -> list[Finding]:
    """What looks wrong in one recording, which is expected to look as in a run from the start, if there is one; `unknown` are
    the parameters whose values are not known. Nothing is held against the run where something grave is found without it."""
    found = [*setpoint_findings(recording, sensors), *loop_findings(recording, sensors, unknown)]
    if not any(one.grave for one in found):
        found += another_body(recording, sensors, expected)
    if any(one.grave for one in found):
        return found
    blamed = {one.what for one in found}
    return found + [one for one in against_run(recording, sensors, expected) if one.what not in blamed]


def samples(recording: Recording, sensors: Mapping[str, Sensor], name: str) -> tuple[Array, Array]:
    """Times and values of a channel, without those that are saturated."""
    t, y = recording.samples[name]
    inside = ~sensors[name].saturated(y)
    return t[inside], y[inside]


def against_run(recording: Recording, sensors: Mapping[str, Sensor], expected: Expected) -> Iterator[Finding]:
    """Signs, units, delays and zeros of channels that cannot be what the run has."""
    early = {}
    for name, (one, signals) in expected.items():
        t, y = samples(recording, sensors, name)
        if len(t) < 2 * MOVES:
            continue
        p, _, _ = one.expected(signals, t)
        if (said := shape(name, recording.units[name], t, y, p, sensors[name], one, signals)) is None:
            early[name] = (y - p)[t <= t[0] + EARLY]
        else:
            what, words, grave = said
            yield Finding(what, recording.name, f"recording `{recording.name}`: {words}", grave)
    if isinstance(recording.start, AtRest):
        yield from zeros(recording, sensors, early)


def shape(
    name: str, unit: str, t: Array, y: Array, p: Array, sensor: Sensor, one: Readout, signals: Signals
) -> tuple[str, str, bool] | None:
    """What is wrong with a channel's motion, if anything is: what, words, and whether that is grave."""
    measured, run = float(np.std(y)), float(np.std(p))
    if max(measured, run) < MOVES * sensor.noise:
        return None
    ratio = measured / max(run, 1e-300)
    if not 1 / LARGER < ratio < LARGER and run > 0:
        words = f"{name} moves {ratio:.3g} times as much as in a run with the parameters of the start"
        known = [(abs(math.log(ratio / factor)), said) for factor, said in confusions(unit)]
        distance, said = min(known, default=(math.inf, ""))
        if distance < NEAR and not 1 / LARGER**1.5 < ratio < LARGER**1.5:
            return f"unit of {name}", f"{words}: {said}?", True
        return f"size of {name}", f"{words}: is its unit right, and are these parameters?", False
    if min(measured, run) < MOVES * sensor.noise:
        return None
    correlation = alike(y, p)
    if correlation < OPPOSITE:
        words = (
            f"{name} looks as if its sign were opposite: its correlation with a run from the start is {correlation:.2f}"
        )
        return f"sign of {name}", words, True
    shifts = np.linspace(-REACH, REACH, 41)
    inside = (t - REACH >= signals.t[0]) & (t + REACH <= signals.t[-1])
    if inside.sum() < 2 * MOVES:
        return None
    by = [alike(y[inside], one.expected(signals, t[inside] - late)[0]) for late in shifts]
    late = float(shifts[int(np.argmax(by))])
    if abs(late) >= LATE + sensor.delay and 1 - max(by) < 0.2 * (1 - alike(y[inside], p[inside])):
        side = "late" if late > 0 else "early"
        words = f"{name} is about {1e3 * abs(late):.0f} ms {side}: are its times counted from the same beginning?"
        return f"time of {name}", words, False
    return None


def alike(y: Array, p: Array) -> float:
    """Correlation [1]."""
    size = float(np.std(y) * np.std(p))
    return float(np.mean((y - y.mean()) * (p - p.mean()))) / size if size > 0 else 0.0


def zeros(recording: Recording, sensors: Mapping[str, Sensor], early: Mapping[str, Array]) -> Iterator[Finding]:
    """Of the coordinates that controllers hold at their set-points in the beginning, and of the disc's angle: it rolls into the
    dent that it makes, so that its angle and its place belong together."""
    rig = recording.rig
    for actuator in rig.loops.values():
        name = channel(rig, actuator.measured)
        if name not in early or actuator.measured != actuator.pushes:
            continue
        sensor, mean, count = sensors[name], float(early[name].mean()), len(early[name])
        if abs(mean) > surely(sensor, count) + sensor.bias:
            words = f"{name} begins {mean:+.3g} {recording.units[name]} from {actuator.setpoint}: do both have the same zero?"
            yield Finding(f"zero of {name}", recording.name, f"recording `{recording.name}`: {words}")
    if isinstance(rig, SoftGrasp) and {"x_C", "theta"} <= early.keys():
        R, (x, theta) = rig.settings.disc.radius, (sensors[name] for name in ("x_C", "theta"))
        off = float(early["theta"].mean() + early["x_C"].mean() / R)
        sure = math.hypot(surely(theta, len(early["theta"])), surely(x, len(early["x_C"])) / R)
        if abs(off) > sure + theta.bias + x.bias / R:
            words = (
                f"theta begins {off:+.3g} rad from where the disc would have it that has rolled to its x_C: is zero its "
                "angle as it is put down at scenario.x_C0, and is that its x?"
            )
            yield Finding("zero of theta", recording.name, f"recording `{recording.name}`: {words}")


def surely(sensor: Sensor, count: int) -> float:
    """What a mean of so many samples is by noise at most, be it coloured."""
    return sensor.noise * max(SURE / math.sqrt(count), COLOURED)


def another_body(recording: Recording, sensors: Mapping[str, Sensor], expected: Expected) -> Iterator[Finding]:
    """A set-point that another body follows than the one whose coordinate the loop is taken to measure; or that this one
    does not follow, as it does in the run."""
    rig = recording.rig
    for actuator in rig.loops.values():
        body, _, axis = actuator.measured.partition(".")
        own, asked = channel(rig, actuator.measured), actuator.setpoint
        mine, run = off(recording, sensors, asked, own), off_in_run(recording, sensors, asked, own, expected)
        others = [name for name in rig.bodies if name != body and f"{name}.{axis}" in movable(rig)]
        for other in others:
            its = channel(rig, f"{other}.{axis}")
            far, there = off(recording, sensors, asked, its), off_in_run(recording, sensors, asked, its, expected)
            if below(far, SAME) and not below(mine, APART) and not below(there, APART):
                said = f"{its} follows it to {far:.1%} of its motion"
            elif mine is not None and mine > APART and far is None and (run is None or run < SAME) and len(others) == 1:
                said = f"{own} does not follow it, and differs by {mine:.0%} of its motion"
            else:
                continue
            change = another_sense(rig, actuator, body, other, np.zeros(1))
            yield Finding(
                change.what, recording.name, f"recording `{recording.name}`: {change.said} ({said})", grave=True
            )


def below(part: float | None, limit: float) -> bool:
    """Whether something is known, and below a limit."""
    return part is not None and part < limit


def movable(rig: Rig) -> list[str]:
    """Coordinates that are free, such as "disc.x"."""
    return [f"{body}.{COORDINATES[axis]}" for body, axes in rig.layout.free.items() for axis in axes]


def off(recording: Recording, sensors: Mapping[str, Sensor], setpoint: str, name: str) -> float | None:
    """How far a channel is from a set-point, over how far that moves; None without samples, or where it hardly moves."""
    if name not in recording.samples or name not in sensors:
        return None
    t, y = samples(recording, sensors, name)
    return parted(recording, setpoint, t, y, sensors[name].noise)


def off_in_run(
    recording: Recording, sensors: Mapping[str, Sensor], setpoint: str, name: str, expected: Expected
) -> float | None:
    """The same of the run from the start."""
    if name not in expected:
        return None
    (one, signals), (t, _) = expected[name], samples(recording, sensors, name)
    return parted(recording, setpoint, t, one.expected(signals, t)[0], sensors[name].noise)


def parted(recording: Recording, setpoint: str, t: Array, y: Array, noise: float) -> float | None:
    asked = recording.rig.reference(torch.from_numpy(t), [setpoint]).detach().numpy()[:, 0, 0]
    moved = float(np.std(asked))
    return float(np.std(asked - y)) / moved if moved > MOVES * noise else None
