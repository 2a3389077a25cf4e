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

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch

from experiments.frame import Table, options, write
from experiments.identify_contact import TRUTH, judged
from experiments.validation.foreign_recordings import (
    FEW,
    RATE,
    SIGNALS,
    Case,
    Made,
    Sensing,
    chosen,
    make_all,
    stated,
)
from torchsoft import Reference
from torchsoft.physics.motion import Profile, Sampled
from torchsoft.sysid import Unreachable, explain
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import forget


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
    Case("loop convention wrong", words=("senses", "x_d"), noted={"control.senses": "disc.x"}),
    Case("sign of F_x flipped", words=("sign",), sensed=lambda channels: {"F_x": -channels["F_x"]}),
    Case("AR(1) noise of 0.9", words=("colour", "white", "AR(", "autocorrel"), colour=0.9),
    Case("camera 2 ms late", words=("delay", "late"), sensed=late(2)),
    Case("radius off by 0.5 %", words=("radius",), differs={"radius": 1.005 * 19.37e-3}),
)  # fmt: skip

SMOKE = ("same assumptions, gentle", "sign of F_x flipped")


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/foreign_rigs")
    rtol: float = 1e-5  # of the fits' last stage
    step: float = 20e-6  # of the simulator [s]; 1 ms is a multiple of twice as much
    seed: int = 7  # of the noise
    workers: int = 2
    only: tuple[str, ...] = ()  # names of cases; all of them by default
    smoke: bool = False  # two cases, four parameters, two short recordings on a coarse mesh


def study(case: Case, made: Sequence[Made], config: Config) -> dict[str, Any]:
    """Identify one case: its estimates, what is reported, and the verdict on both.

    Its runs are kept until it is done: a second start goes through them in seconds.
    """
    runs = config.out / f"runs-{case.name.replace(' ', '-').replace('/', '-')}"
    truth, start, chi2 = FEW if config.smoke else TRUTH, perf_counter(), None
    parameters: dict[str, dict[str, Any]] = {}
    try:
        recordings = [
            case.recording(order, one, config.seed + 10 * k)
            for k, (order, one) in enumerate(zip(case.orders(config.smoke), made))
        ]
        found = explain(
            stated(recordings, truth), rtol=config.rtol, workers=config.workers, checkpoint=runs,
            progress=not config.smoke,
        )  # fmt: skip
        parameters, chi2, notices = judged(found, truth), found.chi2, list(found.notices)
    except (Unreachable, ValueError) as error:
        notices = [str(error)]
    named = any(word.lower() in text.lower() for word in case.words for text in notices)
    if parameters and all(row["inside"] is not False for row in parameters.values()):
        verdict = "holds"
    else:
        verdict = "cause named" if named else "warned, cause not named" if notices else "silent"
    return {
        "name": case.name, "parameters": parameters, "chi2": chi2, "warnings": notices,
        "verdict": verdict, "fastest_slip": max(one.slip for one in made),
        "wall_s": perf_counter() - start,
    }  # fmt: skip


def table(cases: Sequence[Mapping[str, Any]]) -> Table:
    """Errors in percent, those outside of their interval in bold, and what is reported."""
    rows = []
    for one in cases:
        errors = [
            "-" if row["error"] is None else f"{100 * row['error']:+.2g}" if row["inside"]
            else f"**{100 * row['error']:+.2g}**"
            for row in one["parameters"].values()
        ]  # fmt: skip
        warnings = "; ".join(textwrap.shorten(text, 110) for text in one["warnings"])
        chi2 = "-" if one["chi2"] is None else f"{one['chi2']:.3f}"
        rows.append((
            one["name"], " ".join(errors), chi2, one["verdict"], f"{one['wall_s']:.0f}",
            warnings.replace("|", "/") or "-",
        ))  # fmt: skip
    head = ("what differs", "errors of the parameters [%]", "chi2", "verdict", "wall [s]",
            "warnings")  # fmt: skip
    return Table(head, rows)


def main(config: Config) -> None:
    cases = chosen(CASES, config.only or (SMOKE if config.smoke else ()))
    if config.smoke:
        config = replace(config, workers=1, step=5e-5)
        cases = [replace(case, motions=("pressing", "shaking")) for case in cases]
    every = [order for case in cases for order in case.orders(config.smoke)]
    made, found = make_all(every, config.step, config.workers), []
    for case in cases:
        found.append(study(case, [made[order] for order in case.orders(config.smoke)], config))
        print(f"\n{case.name}: {found[-1]['verdict']}", *found[-1]["warnings"], sep="\n  ")
        content = {"verdicts": Counter(one["verdict"] for one in found), "cases": found}
        write(config, content, {"cases": table(found)})
    for folder in config.out.glob("runs-*"):
        forget(folder)


if __name__ == "__main__":
    main(options(Config, __doc__))
