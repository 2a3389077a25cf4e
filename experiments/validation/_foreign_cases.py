"""The cases: what each rig, sensor or note of the laboratory has that the fit does not know, and which words name it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from _foreign_recordings import RATE, SIGNALS, Made, Order, Samples, excitations, planned, sampled

from torchsoft import Parameters, Reference, SoftGrasp
from torchsoft.physics.motion import Profile, Sampled
from torchsoft.sysid import Recording

GENTLE = ("deep pressing", "light shaking", "light jerks")


@dataclass(frozen=True)
class Case:
    """A rig that `differs` by the names of `foreign.Numbers`, sensors that are late or coloured or have an `offset`, `flipped`
    channels, and what the laboratory notes wrongly: other settings, no `F_ff`, set-points at the samples only.

    `cause` are words one of which a warning must have to name what is wrong; none where nothing is.
    """

    name: str
    cause: tuple[str, ...] = ()
    excitations: tuple[str, ...] = GENTLE
    differs: Mapping[str, Any] = field(default_factory=dict)
    delay: Mapping[str, float] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)
    colour: float = 0.0
    flipped: tuple[str, ...] = ()
    noted: Mapping[str, Any] = field(default_factory=dict)
    no_feed_forward: bool = False
    sparse: bool = False

    def orders(self) -> list[Order]:
        """The runs that its recordings are sampled from."""
        return [Order(name, tuple(sorted(self.differs.items()))) for name in self.excitations]

    def samples(self, made: Made, seed: int) -> Samples:
        """What its sensors give of one run."""
        out = sampled(made, seed, self.delay, self.colour)
        for channel, offset in self.offset.items():
            out[channel] = (out[channel][0], out[channel][1] + offset)
        for channel in self.flipped:
            out[channel] = (out[channel][0], -out[channel][1])
        return out

    def recording(self, excitation: str, made: Made, seed: int, smoke: bool) -> Recording:
        """One run as the laboratory hands it over."""
        one = excitations(smoke)[excitation]
        settings, reference = planned(one, smoke)
        if self.sparse:
            reference = at_samples(reference, one.duration)
        if self.no_feed_forward:
            signals = {name: reference[name] for name in ("x_d", "y_d")}
            reference = Reference(**signals, F_ff=Profile([0.0], [0.0]))
        return handed_over(excitation, settings.override(dict(self.noted)), reference, self.samples(made, seed))


def handed_over(name: str, settings: Parameters, reference: Reference, samples: Samples) -> Recording:
    return Recording(name, SoftGrasp(settings, reference), samples)


def at_samples(reference: Reference, duration: float) -> Reference:
    """The reference as a file at the sensors' rate has it: values, and splines between them."""
    t = torch.from_numpy(np.arange(0.0, duration + 0.5 / RATE, 1 / RATE))
    values = reference(t, SIGNALS)[..., 0].detach()
    return Reference(**{name: Sampled(t, values[:, i]) for i, name in enumerate(SIGNALS)})


CASES = (
    Case("same assumptions, gentle"),
    Case("same assumptions, hard", excitations=("deep chirp", "light shaking", "light jerks")),
    Case("slip at 0.15 m/s", excitations=("deep pressing", "light shaking", "hard shaking")),
    Case("mesh 240 x 6", ("mesh", "element"), differs={"across": 240, "through": 6}),
    Case("literal Coulomb", ("friction", "Coulomb", "slip law"), differs={"literal": True}),
    Case("no ramp in the stretch rate", ("ramp", "epsilon", "touch-down"), differs={"ramp_stretch": False}),
    Case("epsilon 0.1 um", ("epsilon", "ramp", "touch-down"), differs={"epsilon": 1e-7}),
    Case("x_C0 off by 40 um", ("x_C0",), differs={"x_C0": 60.34e-3}),
    Case("theta zeroed elsewhere", ("theta",), offset={"theta": 0.02}),
    Case("set-points at 200 Hz", ("set-point", "setpoint"), sparse=True),
    Case("F_ff left out", ("F_ff", "fed forward", "feed-forward"), no_feed_forward=True),
    Case("loop convention wrong", ("senses", "x_d"), noted={"control.senses": "disc"}),
    Case("sign of F_x flipped", ("sign",), flipped=("F_x",)),
    Case("AR(1) noise of 0.9", ("colour", "white", "AR(", "autocorrel"), colour=0.9),
    Case("camera 2 ms late", ("delay", "late"), delay={"x_C": 2e-3, "y_C": 2e-3, "theta": 2e-3}),
    Case("radius off by 0.5 %", ("radius",), differs={"radius": 1.005 * 19.37e-3}),
)
