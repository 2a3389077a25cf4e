"""Motions that make parameters visible: a grasp of a given depth, then strokes, sines, chirps,
presses, jerks or knots.

An `Excitation` is plain validated data; `begin` turns it into a model at rest with the reference
that its controllers follow.
"""

from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from torchsoft.paper.equilibrium import holding_force, press, rest
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import SoftGrasp, apart
from torchsoft.physics.motion import FADE, PERIODS, Knotted, Profile, Reference, Wave, Waves, wave
from torchsoft.physics.statics import BuiltRig
from torchsoft.tables import LISTED, SEED, Table

MOST = 10_000
"""Strokes in one motion."""

INTERVAL = 0.01
"""Time [s] between outputs."""


Length = Annotated[float, Field(ge=-10.0, le=10.0)]
"""An amplitude or a distance [m]."""

Time = Annotated[float, Field(ge=1e-6, le=1e5)]
"""A time [s] that something takes."""

Frequency = Annotated[float, Field(ge=1e-6, le=1e5)]
"""A frequency [Hz]."""


class Roll(Table):
    """A roll by `travel` [m] to the right over the whole time of the motion."""

    kind: Literal["slow_roll"] = "slow_roll"
    travel: Length = 10e-3


class Strokes(Table):
    """There and back by `travel` [m], `stroke_time` [s] each way, until the end."""

    kind: Literal["strokes"] = "strokes"
    travel: Length = 10e-3
    stroke_time: Time = 1.0


class MultiSine(Table):
    """Sums of `components` sines in x and y, one in each part of the band `frequency` [Hz];
    amplitudes [m] are of the sum's peak at most. Phases, and frequencies within their part, come
    from `seed`."""

    kind: Literal["multi_sine"] = "multi_sine"
    amplitude_x: Length = 4e-3
    amplitude_y: Length = 2e-4
    frequency: Annotated[tuple[Frequency, Frequency], LISTED] = (0.5, 8.0)
    components: int = Field(default=5, ge=1, le=50)
    seed: int = Field(default=0, ge=0, le=SEED)

    @property
    def fastest(self) -> float:
        """Largest frequency [Hz]."""
        return max(self.frequency)


class Chirp(Table):
    """Sweeps in x and y from `start` to `end` [Hz], of amplitudes in m."""

    kind: Literal["chirp"] = "chirp"
    amplitude_x: Length = 1e-3
    amplitude_y: Length = 1e-4
    start: Frequency = 0.3
    end: Frequency = 8.0

    @property
    def fastest(self) -> float:
        """Largest frequency [Hz]."""
        return max(self.start, self.end)


class Press(Table):
    """The bracket's height modulated by `amplitude` [m] at `frequency` [Hz] while the disc rolls by
    `travel` [m]."""

    kind: Literal["press"] = "press"
    amplitude: Length = 2e-4
    frequency: Frequency = 2.0
    travel: Length = 5e-3


Knot = Annotated[tuple[Time, Length], LISTED]
"""When a set-point is reached [s], and how far it is [m]."""


class Knots(Table):
    """From set-point to set-point along the paper's profiles, at rest at each: `x` and `y` are
    knots, times [s] since the motion began and distances [m] from where the grasp ended."""

    kind: Literal["knots"] = "knots"
    x: Annotated[tuple[Knot, ...], LISTED] = ()
    y: Annotated[tuple[Knot, ...], LISTED] = ()

    @model_validator(mode="after")
    def _times_increase(self) -> Self:
        for name, knots in (("x", self.x), ("y", self.y)):
            for (before, _), (after, _) in pairwise(knots):
                if after <= before:
                    raise ValueError(
                        f"the times of motion.{name} must increase, but {after:g} s follows "
                        f"{before:g} s"
                    )
        return self


Motion = Annotated[Roll | Strokes | MultiSine | Chirp | Press | Knots, Field(discriminator="kind")]


class Excitation(Table):
    """A grasp that compresses both pads together by `depth` [m] within `grasp_time` [s], a pause of
    `settle` [s], then the motion, until `duration` [s].

    `senses` is whose x the horizontal loop measures: with "bracket" the disc may slip freely, which
    a light grasp and hard strokes make it do ("forced slip"). `x_C0` [m] is off the nodes and the
    middle on purpose: an exactly symmetric start breaks on rounding. Where the loop senses the disc
    it should be a node's place, such as 60 mm: while the upper pad is clear of the disc nothing
    ties the two together, and the least roll of the disc sends the bracket off.
    """

    motion: Motion
    duration: Time = 2.0
    depth: float = Field(default=1.5e-3, ge=1e-7, le=10.0)
    senses: Literal["disc", "bracket"] = "bracket"
    grasp_time: Time = 0.375
    settle: float = Field(default=0.125, ge=0, le=1e5)
    x_C0: float = 60.3e-3

    @model_validator(mode="after")
    def _motion_has_time(self) -> Self:
        since, motion = self.grasp_time + self.settle, self.motion
        needed = {
            "slow_roll": 0.0,
            "press": 2 * FADE,
            "multi_sine": 2 * FADE,
            "chirp": 2 * FADE,
        }.get(motion.kind)
        if needed is not None and self.duration <= since + needed:
            raise ValueError(
                f"duration = {self.duration:g} s leaves no motion: grasp_time = "
                f"{self.grasp_time:g} s and settle = {self.settle:g} s take {since:g} s, and "
                f"{motion.kind} needs more than {needed:g} s after them"
            )
        if isinstance(motion, Strokes) and (self.duration - since) / motion.stroke_time > MOST:
            raise ValueError(
                f"duration = {self.duration:g} s at motion.stroke_time = {motion.stroke_time:g} s "
                f"makes more than {MOST} strokes; take fewer"
            )
        fastest = motion.fastest if isinstance(motion, MultiSine | Chirp) else 0.0
        if fastest * (self.duration - since) > PERIODS:
            raise ValueError(
                f"duration = {self.duration:g} s at {fastest:g} Hz makes more than {PERIODS:g} "
                "periods; take a lower frequency or a shorter time"
            )
        if isinstance(motion, Knots):
            last = since + max(
                (knots[-1][0] for knots in (motion.x, motion.y) if knots), default=0.0
            )
            if last > self.duration * (1 + 1e-9):
                raise ValueError(
                    f"duration = {self.duration:g} s ends before the last knot of the motion, at "
                    f"{last:g} s"
                )
        return self

    def settings(self, p: Parameters) -> Parameters:
        """The parameters p with this excitation's grasp. Raises `ValueError` for a grasp that is
        not possible."""
        return p.override(
            {
                "scenario.y_Br_grasp": apart(p) - self.depth,
                "scenario.grasp_time": self.grasp_time,
                "scenario.travel": 0.0,
                "scenario.x_C0": self.x_C0,
                "control.senses": self.senses,
            }
        )


CATALOGUE = {
    "slow roll": Excitation(motion=Roll(travel=16e-3), duration=4.0),
    "strokes": Excitation(motion=Strokes(travel=20e-3, stroke_time=0.75), duration=2.0),
    "fast strokes": Excitation(motion=Strokes(travel=20e-3, stroke_time=0.25), duration=2.0),
    "strokes, loop about the disc": Excitation(
        motion=Strokes(travel=10e-3, stroke_time=0.75), duration=2.0, senses="disc", x_C0=60e-3
    ),
    "shaking": Excitation(
        motion=MultiSine(amplitude_x=10e-3, amplitude_y=2e-4, frequency=(2.0, 15.0)), duration=2.0
    ),
    "pressing": Excitation(motion=Press(amplitude=4e-4, frequency=8.0, travel=10e-3), duration=2.0),
    "deep pressing": Excitation(
        motion=Press(amplitude=8e-4, frequency=25.0, travel=30e-3), duration=2.0, depth=2.5e-3
    ),
    "deep chirp": Excitation(
        motion=Chirp(amplitude_x=5e-3, amplitude_y=5e-4, start=1.0, end=25.0), duration=2.0,
        depth=2.5e-3,
    ),
    "light shaking": Excitation(
        motion=MultiSine(amplitude_x=6e-3, amplitude_y=2e-4, frequency=(4.0, 20.0)), duration=2.0,
        depth=3e-4,
    ),
    "light jerks": Excitation(
        motion=Strokes(travel=80e-3, stroke_time=0.25), duration=1.4, depth=2e-4
    ),
    "hard light jerks": Excitation(
        motion=Strokes(travel=80e-3, stroke_time=0.15), duration=1.3, depth=2e-4
    ),
    "deep jerks": Excitation(motion=Strokes(travel=40e-3, stroke_time=0.1), duration=1.3),
}  # fmt: skip
"""Ready excitations by name, from gentle to hard; `experiments/experiment_design.py` ranks them."""


def start(model: SoftGrasp) -> Tensor:
    """State (size,): the disc at rest under its weight, the bracket at `apart`, so that its pad is
    clear of the disc by the depth to which the disc has sunk. Differentiable in the model's
    parameters, on which the bracket's place does not depend."""
    state, p = model.unpack(rest(model)), model.settings
    clear = torch.tensor([p.scenario.x_C0, apart(p), 0.0], dtype=torch.float64)
    return model.pack(state._replace(pose=state.pose | {"bracket": clear}))


def begin(
    excitation: Excitation, p: Parameters, *, grasp_force: float | None = None
) -> BuiltRig[SoftGrasp]:
    """The rig with the parameters p about to be excited, with outputs every `INTERVAL`;
    `grasp_force` [N] is fed forward, by default that of statics.

    Raises `ValueError` for an impossible grasp, `NoEquilibrium` where the disc finds no rest.
    """
    model = SoftGrasp(excitation.settings(p))
    y0 = start(model).detach()
    if grasp_force is None:
        grasp_force = holding_force(model, press(model, model.settings.scenario.y_Br_grasp))
    model.reference = reference(
        excitation, model, float(model.unpack(y0).pose["bracket"][1]), grasp_force
    )
    end = excitation.duration
    t = torch.linspace(0, end, max(1, round(end / INTERVAL)) + 1, dtype=torch.float64)
    return BuiltRig(model, y0, t)


def reference(
    excitation: Excitation, model: SoftGrasp, y_Br: float, grasp_force: float
) -> Reference:
    """The grasp from the height y_Br [m] with `grasp_force` [N] fed forward, then the motion."""
    p = model.settings.scenario
    since, until = p.grasp_time + excitation.settle, excitation.duration
    still, grasp = ([0.0], [p.x_C0]), ([0.0, p.grasp_time], [y_Br, p.y_Br_grasp])
    x, y = moved(excitation.motion, still, grasp, since, until)
    return Reference(x_d=x, y_d=y, F_ff=Profile([0.0, p.grasp_time], [0.0, -grasp_force]))


def moved(
    motion: Motion, still: Knotted, grasp: Knotted, since: float, until: float
) -> tuple[Profile, Profile]:
    """x_d and y_Br,d of a motion from `since` to `until` [s], on top of a still x and the grasp."""
    x_0 = still[1][-1]
    match motion:
        case Roll():
            return Profile([since, until], [x_0, x_0 + motion.travel]), Profile(*grasp)
        case Strokes():
            count = max(1, int((until - since) / motion.stroke_time + 1e-9))
            times = [since + i * motion.stroke_time for i in range(count + 1)]
            return Profile(
                times, [x_0 + (i % 2) * motion.travel for i in range(count + 1)]
            ), Profile(*grasp)
        case Knots():
            x, y = ([(since + t, at) for t, at in knots] for knots in (motion.x, motion.y))
            begin = [(since, 0.0)] if since > grasp[0][-1] else []
            x_d = Profile([since, *(t for t, _ in x)], [x_0, *(x_0 + at for _, at in x)])
            times = [*grasp[0], *(t for t, _ in [*begin, *y])]
            return x_d, Profile(times, [*grasp[1], *(grasp[1][-1] + at for _, at in [*begin, *y])])
        case MultiSine():
            rng, n = np.random.default_rng(motion.seed), motion.components
            low, high = np.log(motion.frequency)

            def sines(amplitude: Length) -> Wave:
                frequency = np.exp(low + (np.arange(n) + rng.random(n)) / n * (high - low))
                return wave(
                    np.full(n, amplitude / n), frequency, np.zeros(n), rng.uniform(0, 2 * np.pi, n)
                )

            waves = sines(motion.amplitude_x), sines(motion.amplitude_y)
            return Waves(still, since, until, waves[0]), Waves(grasp, since, until, waves[1])
        case Chirp():
            sweep = (motion.end - motion.start) / (until - since)
            waves = [
                wave(a, motion.start, sweep, 0.0) for a in (motion.amplitude_x, motion.amplitude_y)
            ]
            return Waves(still, since, until, waves[0]), Waves(grasp, since, until, waves[1])
        case Press():
            x = Profile([since, until], [x_0, x_0 + motion.travel])
            return x, Waves(grasp, since, until, wave(motion.amplitude, motion.frequency, 0.0, 0.0))
