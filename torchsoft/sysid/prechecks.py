"""Comparison of recordings with their rig, before any fit: set-points, control loops, signs and
units.

The law of an actuator is known. So a recording of its force and of the coordinate that it measures
is held against it without a run: means over windows of time, which need no derivative of measured
samples, agree within the noise of the sensors. Where they do not, one thing at a time is tried: the
sign of the force, its unit, the force that is fed forward. Whose set-points are those of a loop is
told by the body that follows them. Other channels are held against a run with the parameters of the
start.
"""

import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from torchsoft.diagnostic import Diagnostic
from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.parts import COORDINATES, Actuator
from torchsoft.sysid.initial_state import PREFIX
from torchsoft.sysid.plan import LOOSE
from torchsoft.sysid.prediction import Prediction, Readout, Signals
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import BETWEEN, Array, Recording
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.setpoints import channel, found, setpoint_findings
from torchsoft.sysid.unknowns import Sensor
from torchsoft.tables import shown


def together(every: Sequence[Diagnostic]) -> list[Diagnostic]:
    """One diagnostic of every code: the first, with the names of the other recordings."""
    out: list[Diagnostic] = []
    for code in dict.fromkeys(one.code for one in every):
        first, *others = sorted(
            (one for one in every if one.code == code), key=lambda one: one.severity
        )
        names = ", ".join(
            f"`{name}`"
            for name in dict.fromkeys(one.where for one in others)
            if name != first.where
        )
        out.append(
            first._replace(message=first.message + (f"; so it is in {names}" if names else ""))
        )
    return out


def accepted(every: Sequence[Diagnostic], acknowledged: Sequence[str]) -> list[str]:
    """Messages of warnings, and of errors that are acknowledged. Raises `ValueError` for other
    errors, and for a code that was acknowledged and not found."""
    codes = dict.fromkeys(one.code for one in every)
    if strange := [code for code in acknowledged if code not in codes]:
        there = f"what was found is {', '.join(codes)}" if codes else "nothing looks wrong"
        raise ValueError(
            f"acknowledged: nothing was found that is called {shown(strange[0])}, so leave it out; "
            f"{there}"
        )
    for one in every:
        if one.severity == "error" and one.code not in acknowledged:
            raise ValueError(f'{one.message}; if it is so, say acknowledged = ["{one.code}"]')
    return [
        f"{one.message} (acknowledged)" if one.code in acknowledged else one.message
        for one in every
    ]


MISTAKEN = {
    "rad": {180 / math.pi: ("degrees", "radians"), 1e3: ("milliradians", "radians")},
    "m": {
        1e2: ("centimetres", "metres"),
        1e3: ("millimetres", "metres"),
        1e6: ("micrometres", "metres"),
    },
    "N": {1e3: ("millinewtons", "newtons"), 1 / 9.81: ("kilograms", "newtons")},
}
"""What makes values of a dimension too large by a factor when it is taken for the other."""


def confusions(unit: str) -> list[tuple[float, str]]:
    """Factors by which a channel in `unit` may be too large, with the units that were confused."""
    known = MISTAKEN.get(unit.removesuffix("/s"), {})
    over = [(factor, f"{a} taken for {b}") for factor, (a, b) in known.items()]
    return over + [(1 / factor, f"{b} taken for {a}") for factor, (a, b) in known.items()]


class Signal(NamedTuple):
    """A channel's samples: times (k,) [s], values (k,), and the sensor."""

    channel: str
    t: Array
    y: Array
    sensor: Sensor

    @property
    def spacing(self) -> float:
        return float(np.median(np.diff(self.t)))

    @property
    def faulty(self) -> bool:
        """Whether a fault of the sensor is declared that a fit will estimate."""
        one = self.sensor
        return any((one.bias, one.delay, one.gain, one.drift))


def sampled(recording: Recording, sensors: Mapping[str, Sensor], name: str) -> Signal | None:
    """The samples of a coordinate or a force whose sensor sees nothing else and is never saturated,
    or None."""
    own = channel(recording.rig, name)
    if own not in recording.samples or own not in sensors:
        return None
    one, (t, y) = sensors[own], recording.samples[own]
    clean = one.inertia == 0 and one.misalignment == 0 and not one.saturated(y).any() and len(t) > 3
    return Signal(own, t, y, one) if clean else None


WINDOW = 20e-3
"""Length [s] of a window, or four samples where that is longer."""

FEWEST = 8
"""Windows without which nothing is said."""

ROUGH = 0.03
"""Part of the force by which both sides of a loop may differ besides the noise: drives are not
exact."""

EXPLAINED = 0.15
"""Part of a disagreement, and of the force, that may be left by its explanation."""

SLOW = 0.3
"""Part of a disagreement by which it may change from window to window where a force fed forward is
missing."""


class Loop(NamedTuple):
    """Both sides of a loop as means over n windows of a `width` (n,) [s]: the measured force F
    (n,), and `inputs` (n, k) of the actuator. `signals` are those of the force and of the
    coordinates."""

    actuator: Actuator
    F: Array
    inputs: Array
    signals: tuple[Signal, ...]
    width: Array

    @property
    def fed(self) -> int:
        """Column of the force fed forward."""
        return 2 * len(self.actuator.setpoints)

    def given(self, feed_forward: float = 1.0) -> Array:
        """The effort (n,) of the actuator, with the force fed forward times a factor."""
        inputs = self.inputs.copy()
        inputs[:, self.fed] *= feed_forward
        return self.actuator(torch.from_numpy(inputs)).detach().numpy()

    @property
    def noise(self) -> tuple[float, float]:
        """Standard deviation [N] of a mean of the disagreement by white noise, and by noise that
        outlasts a window."""
        inputs = torch.from_numpy(self.inputs).requires_grad_(True)
        (slope,) = torch.autograd.grad(self.actuator(inputs).sum(), inputs)
        by = slope.numpy()[:, self.fed + 1 :]
        force, *coordinates = self.signals
        white, lasting = (
            force.sensor.noise**2 * force.spacing / self.width,
            np.full(len(self.width), force.sensor.noise**2),
        )
        for one, by_x, by_v in zip(coordinates, by.T[::2], by.T[1::2]):
            rate = 2 * by_v**2 / self.width**2
            white = white + one.sensor.noise**2 * (by_x**2 * one.spacing / self.width + rate)
            lasting = lasting + one.sensor.noise**2 * (by_x**2 + rate)
        return float(np.sqrt(np.mean(white))), float(np.sqrt(np.mean(lasting)))


def windows(
    recording: Recording, actuator: Actuator, signals: Sequence[Signal | None]
) -> Loop | None:
    """The loop of the force and the coordinates over windows that all have samples in; None where
    there are too few."""
    known = tuple(one for one in signals if one is not None)
    if len(known) < len(signals):
        return None
    length = max(WINDOW, *(4 * one.spacing for one in known))
    first, last = max(one.t[0] for one in known), min(one.t[-1] for one in known)
    edges = first + length * np.arange(int(max(last - first, 0.0) / length) + 1)
    keep = np.logical_and.reduce(
        [np.diff(np.searchsorted(s.t, edges)) * s.spacing > 0.5 * length for s in known]
    )
    if keep.sum() < FEWEST:
        return None
    width, t = np.diff(edges)[keep], np.arange(first, last + BETWEEN, BETWEEN)
    names = [*actuator.setpoints, *([actuator.feed_forward] if actuator.feed_forward else [])]
    columns = [np.zeros(len(t))]
    if names:
        columns = [
            *recording.rig.reference(torch.from_numpy(t), names).detach().numpy()[..., 0].T,
            *columns,
        ]
    asked = [CubicSpline(t, column) for column in columns[: len(actuator.setpoints)]]
    force, *coordinates = [CubicSpline(one.t, one.y) for one in known]
    integrals = [part for one in asked for part in (one.antiderivative(), one)]
    integrals.append(CubicSpline(t, columns[len(asked)]).antiderivative())
    integrals += [part for one in coordinates for part in (one.antiderivative(), one)]
    inputs = np.stack([np.diff(one(edges))[keep] / width for one in integrals], -1)
    return Loop(
        actuator, np.diff(force.antiderivative()(edges))[keep] / width, inputs, known, width
    )


class Change(NamedTuple):
    """One thing that may be otherwise: its code, a clause, the disagreement (n,) [N] that is left,
    and whether it is grave."""

    code: str
    clause: str
    left: Array
    grave: bool = True


def rms(e: Array) -> float:
    return float(np.sqrt(np.mean(e**2)))


def loop_findings(
    recording: Recording, sensors: Mapping[str, Sensor], unknown: Collection[str] = ()
) -> Iterator[Diagnostic]:
    """Diagnostics on the control loops of a recording whose force and coordinate were measured, and
    whose gains are not among the parameters that are `unknown`."""
    rig = recording.rig
    tensors = {id(rig.parameter(name)) for name in unknown}
    for name, actuator in rig.actuators.items():
        F, coordinates = (
            sampled(recording, sensors, name),
            [sampled(recording, sensors, x) for x in actuator.measures],
        )
        if F is not None and None in coordinates and not actuator.is_loop:
            missing = channel(rig, actuator.measures[coordinates.index(None)])
            yield Diagnostic(
                "note", recording.name, f"recording `{recording.name}`: {F.channel} is not "
                f"compared with its controller, since {missing} is not recorded",
                f"controller of {F.channel}",
            )  # fmt: skip
        loop = windows(recording, actuator, [F, *coordinates])
        if loop is None or any(id(p) in tensors for p in actuator.parameters()):
            continue
        change = disagreement(loop)
        if change is not None:
            force, *others = loop.signals
            seen = ", ".join([*actuator.setpoints, *(one.channel for one in others)])
            text = (
                f"{change.clause} (what the controller makes of {seen} differs from "
                f"{force.channel} by {rms(loop.F - loop.given()):.3g} {actuator.effort_unit} rms, "
                f"and would by {rms(change.left):.3g})"
            )
            yield found(change.code, recording, text, change.grave)


def disagreement(loop: Loop) -> Change | None:
    """The cause of a disagreement of a loop, if there is one."""
    F, name, unit, feed = (
        loop.F,
        loop.signals[0].channel,
        loop.actuator.effort_unit,
        loop.actuator.feed_forward,
    )
    given = loop.given()
    e = F - given
    white, lasting = (2 * sd + ROUGH * rms(F) for sd in loop.noise)
    if rms(e) <= white:
        return None
    opposite = "looks as if its sign were opposite"
    changes = [
        Change(f"sign of {name}", f"{name} {opposite}", -F - given),
        *(
            Change(
                f"unit of {name}",
                f"{name} looks as if it were in another unit: {words}",
                F / factor - given,
            )
            for factor, words in confusions(unit)
        ),
    ]
    if feed:
        changes.append(Change(f"sign of {feed}", f"{feed} {opposite}", F - loop.given(-1.0)))
    best = min(changes, key=lambda change: rms(change.left))
    enough = max(white, EXPLAINED * min(rms(e), rms(F)))
    if rms(best.left) <= enough and rms(best.left) < 0.5 * rms(e):
        return best
    fed = feed and not loop.inputs[:, loop.fed].any()
    if any(one.faulty for one in loop.signals) or rms(e) <= (white if fed else lasting):
        return None
    slow, began = np.diff(e) / np.sqrt(2), float(e[: max(2, len(e) // 20)].mean())
    if feed and rms(slow) <= max(SLOW * rms(e), white) and abs(began) <= 0.5 * rms(e):
        words = (
            f"{name} is {float(e.mean()):+.3g} {unit} more, on the average, than the controller "
            "gives"
        )
        return Change(
            feed, f"{words}: was a force fed forward that {feed} does not have?", slow, grave=False
        )
    words = (
        f"{name} is not what the controller gives: are its gains, units, zeros, times and "
        "set-points right?"
    )
    return Change(f"loop of {name}", words, e, grave=False)


MOVES = 5.0
"""Times its noise that a channel moves, where its motion says something."""

OPPOSITE = -0.5
"""Correlation with the run below which a sign is called opposite: wrong parameters do not do
that."""

LARGER = 8.0
"""Factor between the sizes of motions from which parameters, off by three, do not explain it."""

NEAR = math.log(4.0)
"""How near such a factor must be to one of mistaken units, in its logarithm."""

SAME, APART = 0.1, 0.3
"""Part of its motion by which a coordinate that follows a set-point may differ from it, and by
which another one differs."""

Expected = Mapping[str, tuple[Readout, Signals]]
"""The sensors of a run, with its signals."""


def precheck(
    problem: Problem, runner: Runner, which: Sequence[str] | None = None
) -> list[Diagnostic]:
    """Diagnostics on some recordings of a problem, or on all: one of every code."""
    every, x = list[Diagnostic](), problem.coordinates.start
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
            expected = {
                name: (one, signals) for name, one in problem.readouts(x, job.recording).items()
            }
        every += findings(recording, problem.sensors, expected, unknown)
    return together(every)


def findings(
    recording: Recording,
    sensors: Mapping[str, Sensor],
    expected: Expected,
    unknown: Collection[str] = (),
) -> list[Diagnostic]:
    """Diagnostics on one recording, beside a run from the start, if there is one; `unknown` are the
    names of unknown parameters. A recording with an error is not held against the run."""
    every = [*setpoint_findings(recording, sensors), *rounded(recording, sensors)]
    every += another_body(recording, sensors, expected)
    if not any(one.severity == "error" for one in every):
        every += loop_findings(recording, sensors, unknown)
    if any(one.severity == "error" for one in every):
        return every
    codes = {one.code for one in every}
    return every + [
        one for one in against_run(recording, sensors, expected) if one.code not in codes
    ]


COARSE = 1.2
"""Steps of a sensor over its noise from which they widen the noise by 6 % and more."""


def rounded(recording: Recording, sensors: Mapping[str, Sensor]) -> Iterator[Diagnostic]:
    """Readings in steps that the stated noise and resolution leave out."""
    for name, sensor in sensors.items():
        if name not in recording.samples:
            continue
        apart = np.diff(np.unique(unsaturated(recording, sensors, name)[1]))
        q = float(apart.min(initial=math.inf))
        if not COARSE * max(sensor.noise, sensor.resolution) < q < math.inf:
            continue
        if np.abs(apart / q - np.round(apart / q)).max() < 1e-3:
            text = (
                f"{name} comes in steps of {q:.3g} {recording.units[name]}, "
                f"{q / sensor.noise:.2g} times its noise: say so by its `resolution`"
            )
            yield found(f"resolution of {name}", recording, text)


def unsaturated(
    recording: Recording, sensors: Mapping[str, Sensor], name: str
) -> tuple[Array, Array]:
    """Times and values of a channel, without those that are saturated."""
    t, y = recording.samples[name]
    inside = ~sensors[name].saturated(y)
    return t[inside], y[inside]


def against_run(
    recording: Recording, sensors: Mapping[str, Sensor], expected: Expected
) -> Iterator[Diagnostic]:
    """Signs and units of channels that cannot be those of the run."""
    for name, (one, signals) in expected.items():
        (t, y), noise = unsaturated(recording, sensors, name), sensors[name].sd
        if len(t) < 2 * MOVES:
            continue
        p = one.expected(signals, t)[0]
        measured, run = float(np.std(y)), float(np.std(p))
        if max(measured, run) < MOVES * noise:
            continue
        ratio = measured / max(run, 1e-300)
        if not 1 / LARGER < ratio < LARGER and run > 0:
            text = (
                f"{name} moves {ratio:.3g} times as much as in a run with the parameters of the "
                "start"
            )
            known = [
                (abs(math.log(ratio / factor)), said)
                for factor, said in confusions(recording.units[name])
            ]
            distance, said = min(known, default=(math.inf, ""))
            if distance < NEAR and not 1 / LARGER**1.5 < ratio < LARGER**1.5:
                yield found(f"unit of {name}", recording, f"{text}: {said}?", grave=True)
            else:
                yield found(
                    f"size of {name}",
                    recording,
                    f"{text}: is its unit right, and are these parameters?",
                )
        elif min(measured, run) >= MOVES * noise:
            alike = float(np.mean((y - y.mean()) * (p - p.mean()))) / (measured * run)
            if alike < OPPOSITE:
                text = (
                    f"{name} looks as if its sign were opposite: its correlation with a run from "
                    f"the start is {alike:.2f}"
                )
                yield found(f"sign of {name}", recording, text, grave=True)


def another_body(
    recording: Recording, sensors: Mapping[str, Sensor], expected: Expected
) -> Iterator[Diagnostic]:
    """A set-point that another body follows than the one whose coordinate the loop is taken to
    measure; or that this one does not follow, as it does in the run."""
    rig = recording.rig
    movable = {
        f"{body}.{COORDINATES[axis]}" for body, axes in rig.layout.free.items() for axis in axes
    }
    for actuator in rig.loops.values():
        body, _, axis = actuator.measured.partition(".")
        own, setpoint = channel(rig, actuator.measured), actuator.setpoint
        mine, run = (apart(recording, sensors, setpoint, own, by) for by in (None, expected))
        others = [name for name in rig.bodies if name != body and f"{name}.{axis}" in movable]
        for other in others:
            its = channel(rig, f"{other}.{axis}")
            far, there = (apart(recording, sensors, setpoint, its, by) for by in (None, expected))
            near = any(part is not None and part < APART for part in (mine, there))
            if far is not None and far < SAME and not near:
                said = f"{its} follows it to {far:.1%} of its motion"
            elif (
                mine is not None
                and mine > APART
                and far is None
                and (run is None or run < SAME)
                and len(others) == 1
            ):
                said = f"{own} does not follow it, and differs by {mine:.0%} of its motion"
            else:
                continue
            paper = isinstance(rig, SoftGrasp) and axis == "x"
            remedy = f' (say control.senses = "{other}")' if paper else ""
            code = "control.senses" if paper else f"what {setpoint} is of"
            text = (
                f"{setpoint} looks like the set-point of the {other}, not of the {body}{remedy}; "
                f"or are {own} and {its} exchanged? ({said})"
            )
            yield found(code, recording, text, grave=True)


def apart(
    recording: Recording,
    sensors: Mapping[str, Sensor],
    setpoint: str,
    name: str,
    expected: Expected | None,
) -> float | None:
    """Distance of a channel, as it is measured or expected, from a set-point, over the motion of
    that; None without samples, or where it hardly moves."""
    if name not in (recording.samples.keys() & sensors.keys() if expected is None else expected):
        return None
    t, y = unsaturated(recording, sensors, name)
    if expected is not None:
        one, signals = expected[name]
        y = one.expected(signals, t)[0]
    asked = recording.rig.reference(torch.from_numpy(t), [setpoint]).detach().numpy()[:, 0, 0]
    moved = float(np.std(asked))
    return float(np.std(asked - y)) / moved if moved > MOVES * sensors[name].sd else None
