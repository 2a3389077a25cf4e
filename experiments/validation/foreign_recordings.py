"""Recordings by the independent simulator of rigs that differ from what a laboratory states."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from experiments.frame import repeated
from experiments.identify_contact import (
    LAW,
    RUBBER,
    SENSORS,
    TRUTH,
    coloured,
    problem,
)
from experiments.validation.foreign import Numbers, simulate
from torchsoft import Reference, RigFile, excite
from torchsoft.rigs.excite import Excitation, chirp, roll_to, sines, strokes
from torchsoft.sysid import Problem, Recording
from torchsoft.sysid.initial_state import Standing
from torchsoft.sysid.recording import Array

SIGNALS = ("x_d", "y_d", "F_ff")
CALLED = {"theta_C": "theta", "effort_x": "F_x", "effort_y": "F_y"}
"""Channels as the independent simulator calls them."""

SETTLE = 0.2
"""Time [s] that the rig is simulated before the first sample: the disc has been put down then."""

CLEAR = 1e-4
"""Initial gap [m] between disc and upper pad."""

KEPT, RATE = 1e-3, 200.0
"""Spacing [s] of the rows that are kept, and samples a second."""

FACTOR = 1.6
"""Every parameter starts off by this factor, one up and the next one down."""


GENTLE = ("deep pressing", "light shaking", "light jerks")
"""Motions that show all eight parameters together."""

SHAKEN = (4.0, 20.0)
"""Band of shaking [Hz]."""

ACROSS = sines(2e-4, SHAKEN, 1)
"""Shaking across the pads."""

MOTIONS = {
    "deep pressing": Excitation(
        roll_to(20e-3, 1.2), chirp(8e-4, 17.0, 17.0), duration=1.2, depth=2.4e-3
    ),
    "light shaking": Excitation(sines(6e-3, SHAKEN, 0), ACROSS, duration=1.2, depth=2e-4),
    "light jerks": Excitation(strokes(80e-3, 0.2), duration=1.0, depth=1e-4),
    "deep chirp": Excitation(
        chirp(5e-3, 1.0, 25.0), chirp(5e-4, 1.0, 25.0), duration=1.3, depth=2.4e-3
    ),
    "hard shaking": Excitation(sines(12.5e-3, SHAKEN, 0), ACROSS, duration=1.2, depth=2e-4),
    "long shaking": Excitation(sines(12.5e-3, SHAKEN, 0), ACROSS, duration=1.5, depth=2e-4),
    "gentle roll": Excitation(strokes(10e-3, 0.6), duration=1.5, depth=1.4e-3),
    "shaking": Excitation(
        sines(6e-3, (4.0, 17.0), 0), sines(2e-4, (4.0, 17.0), 1), duration=0.9, depth=3e-4
    ),
}
"""Motions of a second or so; the last one is that of smoke runs."""


class Order(NamedTuple):
    """One run that is to be made: a motion by name, and how the rig differs, by the names of
    `foreign.Numbers`."""

    motion: str
    differs: tuple[tuple[str, Any], ...]


class Made(NamedTuple):
    """One run: its motion, times (n,) [s] every `KEPT`, and channels (n,) by the simulator's
    names."""

    motion: str
    t: Array
    channels: dict[str, Array]


def planned(motion: str) -> RigFile:
    """What the laboratory has planned; the unknown numbers are the usual ones."""
    file = RigFile.ready("paper").override({"contact.v_s": 0.05})
    return excite(file, MOTIONS[motion]._replace(grip=-CLEAR))


def numbers(file: RigFile, differs: Mapping[str, Any]) -> Numbers:
    """The rig of the simulator: the known numbers, the truth of the unknown ones, and what
    differs."""
    stated = {name: row["value"] for name, row in file.table().items()}
    known = {
        "v_s": f"{LAW}.friction.v_s", "nu": f"{RUBBER}.nu", "depth": f"{RUBBER}.depth",
        "length": "pads.U.length", "height": "pads.U.height", "across": "pads.U.elements_x",
        "through": "pads.U.elements_y", "radius": "bodies.disc.shape.radius",
        "mass": "bodies.disc.mass", "bracket_mass": "bodies.bracket.mass", "gravity": "gravity",
        "x_C0": "bodies.disc.start.x", "K_x": "actuators.x.Kp", "R_x": "actuators.x.Kd",
        "K_y": "actuators.y.Kp", "R_y": "actuators.y.Kd",
    }  # fmt: skip
    return Numbers(**{
        **{own: stated[name] for own, name in known.items()},
        **{name.rpartition(".")[2]: value for name, value in TRUTH.items()},
        "cm_height": -stated["pads.U.origin"][1], "spacing": 1e-3,
        "senses_disc": file.actuators["x"].measures == "disc.x",
        **differs,
    })  # fmt: skip


def run(order: Order, step: float) -> Made:
    """A run of the independent simulator on steps of `step` [s]."""
    file = planned(order.motion)
    count = round((file.outputs.duration + SETTLE) / step)
    t: Array = (step * (np.arange(count + 1) - round(SETTLE / step))).astype(np.float64)
    signals = file.build().rig.reference(torch.from_numpy(t), SIGNALS).detach().numpy()
    made = simulate(numbers(file, dict(order.differs)), t, signals, round(KEPT / step))
    return Made(order.motion, made.t, made.channels)


def make(order: Order, step: float) -> Made:
    """Runs on steps of `step` and of twice that, extrapolated to none, for the error of backward
    Euler is of first order. The literal law jumps, and is not extrapolated."""
    fine = run(order, step)
    if dict(order.differs).get("literal"):
        return fine
    coarse = run(order, 2 * step)
    return fine._replace(
        channels={name: 2 * value - coarse.channels[name] for name, value in fine.channels.items()}
    )


def make_all(orders: Iterable[Order], step: float, workers: int) -> dict[Order, Made]:
    """All runs, side by side in threads."""
    every = list(dict.fromkeys(orders))
    made = repeated(lambda i: make(every[i], step), len(every), workers, "recordings")
    return dict(zip(every, made))


Sensing = Callable[[Mapping[str, Array]], Mapping[str, Array]]
"""A fault of sensors: new channels, by the simulator's names, every `KEPT`, before there is
noise."""

Alter = Callable[[Recording, np.random.Generator], Recording]
"""A fault of a sensor, or of what is noted down, put into a recording."""

Noting = Callable[[Reference, float], Reference]
"""What is noted of the set-points of a recording of some duration [s]."""


@dataclass(frozen=True)
class Case:
    """A rig that `differs` by the names of `foreign.Numbers`, sensors that sense something else or
    have noise of a `colour`, a recording that is altered, and what the laboratory notes: settings
    of the rig file, and set-points.

    A name with one of `suspects` in it is that of a true suspect; a notice with one of the `words`
    names it. Both are empty where nothing is wrong. A case that is `rejected` may end with an error
    in place of estimates; any other may not.
    """

    name: str
    suspects: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    differs: Mapping[str, Any] = field(default_factory=dict)
    sensed: Sensing | None = None
    colour: float | Literal["pink"] = 0.0
    alter: Alter | None = None
    noted: Mapping[str, Any] = field(default_factory=dict)
    setpoints: Noting | None = None
    rejected: bool = False
    unknowns: tuple[str, ...] = tuple(TRUTH)
    motions: tuple[str, ...] = GENTLE

    @property
    def orders(self) -> list[Order]:
        differs = tuple(sorted(self.differs.items()))
        return [Order(motion, differs) for motion in self.motions]

    def problem(self, made: Sequence[Made], seed: int) -> Problem:
        """The identification of the unknowns from one run a motion, every one off by `FACTOR`."""
        recordings = [self.recording(one, seed + 10 * k) for k, one in enumerate(made)]
        initial = {name: TRUTH[name] * FACTOR ** (-1) ** i for i, name in enumerate(self.unknowns)}
        return problem(recordings, initial)

    def recording(self, made: Made, seed: int) -> Recording:
        """One run as the laboratory hands it over, sampled by its sensors."""
        file = planned(made.motion)
        reference = file.build().rig.reference
        if self.setpoints is not None:
            reference = self.setpoints(reference, file.outputs.duration)
        if self.sensed is not None:
            made = made._replace(channels={**made.channels, **self.sensed(made.channels)})
        known = {name: value for name, value in TRUTH.items() if name not in self.unknowns}
        rig, y0, _ = file.override({**known, **self.noted}).build()
        rig.reference = reference
        at_rest = Standing.of(rig, y0, rests={"disc": [1]})
        recording = Recording(made.motion, rig, sampled(made, seed, self.colour), at_rest)
        if self.alter is not None:
            recording = self.alter(recording, np.random.default_rng(1000 + seed))
        return recording


def pink(count: int, rng: np.random.Generator) -> Array:
    """Noise (count,) of deviation 1 whose power falls with the frequency, down to one period a
    recording."""
    spectrum = np.fft.rfft(rng.standard_normal(count))
    spectrum /= np.maximum(np.arange(len(spectrum)), 1.0) ** 0.5
    noise = np.fft.irfft(spectrum, count)
    return noise / noise.std()


def sampled(
    made: Made, seed: int, colour: float | Literal["pink"]
) -> dict[str, tuple[Array, Array]]:
    """Times [s] and values by channel: what the sensors give at `RATE` from t = 0 on.

    Their noise has their own deviation and the first autocorrelation `colour`, or is pink; it is
    the same for the same seed.
    """
    rng, out = np.random.default_rng(seed), {}
    every, first = round(1 / RATE / KEPT), int(np.searchsorted(made.t, -0.5 * KEPT))
    at = np.arange(first, len(made.t), every)
    for channel, sensor in SENSORS.items():
        noise = pink(len(at), rng) if colour == "pink" else coloured(len(at), colour, rng)
        exact = made.channels[CALLED.get(channel, channel)][at]
        out[channel] = (made.t[at], exact + sensor.noise * noise)
    return out


def chosen(cases: Iterable[Case], only: Sequence[str]) -> list[Case]:
    """The cases that were asked for, or all. Raises `ValueError` for a name that is not there."""
    known = {case.name: case for case in cases}
    if strange := [name for name in only if name not in known]:
        raise ValueError(f"there is no case {strange[0]!r}; the cases are {', '.join(known)}")
    return [known[name] for name in only or known]
