"""Question: can an interval be wrong without a warning beside it, when the rig is not the one that
the fit assumes?

An independent simulator (`foreign/`: own finite elements, one dense Newton system, backward Euler
at 20 us, no function shared with torchsoft) makes recordings of rigs that differ in what a
laboratory would not know: the mesh, the friction law, the place of the disc, its radius. Others
differ in the sensors (zero, sign, delay, colour) or in what is noted down (set-points at the
samples only, F_ff left out, whose x the loop measures). `torchsoft.sysid` identifies eight
parameters from each, with noise of 10 um, 0.5 mrad and 0.1 N at 200 Hz; every case has the same
noise, so that cases differ by what is wrong and not by luck. An interval holds the truth or not; a
warning names the cause or not.

Command: .venv/bin/python -m experiments.validation.foreign_rigs [--smoke] [--only "mesh 240 x 6"]
[--workers 2]
Expected: every interval holds, or a warning names the cause; no case is silent. About an hour on
two cores, the recordings included.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from experiments.frame import options
from experiments.identify_contact import LAW, MU_S, RUBBER
from experiments.validation import suspects
from experiments.validation.foreign_recordings import RATE, SIGNALS, Case, Sensing, chosen
from torchsoft import Reference
from torchsoft.physics.motion import Profile, Sampled
from torchsoft.sysid.recording import Array


def late(rows: int) -> Sensing:
    """A camera whose samples are late by rows of the simulator."""

    def sensed(channels: Mapping[str, Array]) -> Mapping[str, Array]:
        return {name: np.roll(channels[name], rows) for name in ("x_C", "y_C", "theta")}

    return sensed


def at_samples(reference: Reference, duration: float) -> Reference:
    """Set-points as a file at the sensors' rate has them: values, and splines between them."""
    t = torch.from_numpy(np.arange(0.0, duration + 0.5 / RATE, 1 / RATE))
    values = reference(t, SIGNALS)[..., 0].detach()
    return Reference(**{name: Sampled(t, values[:, i]) for i, name in enumerate(SIGNALS)})


def without_feed_forward(reference: Reference, duration: float) -> Reference:
    """Set-points without the force that was fed forward."""
    signals = {name: reference[name] for name in ("x_d", "y_d")}
    return Reference(**signals, F_ff=Profile([0.0], [0.0]))


HARD = ("deep chirp", "light shaking", "light jerks")
FAST = ("deep pressing", "light shaking", "hard shaking")

CASES = (
    Case("same assumptions, gentle"),
    Case("same assumptions, hard", motions=HARD),
    Case("slip at 0.15 m/s", motions=FAST),
    Case("mesh 240 x 6", words=("mesh", "element"), differs={"across": 240, "through": 6}),
    Case("literal Coulomb", words=("none of the assumptions",), differs={"literal": True}),
    Case("x_C0 off by 40 um", words=("disc begins",), differs={"x_C0": 60.34e-3}),
    Case("theta zeroed elsewhere", words=("theta",),
         sensed=lambda channels: {"theta": channels["theta"] + 0.02}),
    Case("set-points at 200 Hz", words=("set-point", "setpoint"), setpoints=at_samples),
    Case("F_ff left out", words=("F_ff", "fed forward", "feed-forward"),
         setpoints=without_feed_forward),
    Case("loop convention wrong", words=("senses", "x_d"), noted={"control.senses": "disc.x"},
         rejected=True),
    Case("sign of F_x flipped", words=("sign",), rejected=True,
         sensed=lambda channels: {"F_x": -channels["F_x"]}),
    Case("AR(1) noise of 0.9", words=("colour", "white", "AR(", "autocorrel"), colour=0.9),
    Case("camera 2 ms late", words=("delay", "late"), sensed=late(2)),
    Case("radius off by 0.5 %", words=("radius",), differs={"radius": 1.005 * 19.37e-3}),
)  # fmt: skip

SMOKE = ("same assumptions, gentle", "sign of F_x flipped")
SMOKE_UNKNOWNS = (MU_S, f"{LAW}.K_n", f"{RUBBER}.E", f"{RUBBER}.tau")


@dataclass(frozen=True)
class Config(suspects.Settings):
    out: Path = Path("out/foreign_rigs")
    seeds: int = 1
    first: int = 7


def main(config: Config) -> None:
    cases = chosen(CASES, config.only or (SMOKE if config.smoke else ()))
    if config.smoke:
        cases = [replace(case, motions=("shaking",), unknowns=SMOKE_UNKNOWNS) for case in cases]
        config = replace(config, workers=1, rtol=1e-4, step=5e-5)
    suspects.study(cases, config, "cases")


if __name__ == "__main__":
    main(options(Config, __doc__))
