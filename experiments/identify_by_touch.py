"""Question: what does a row of taxels add to a camera and the force F_x, for eight contact and pad
parameters?

The rig of `identify_contact.py` with 40 taxels of 3 mm on its lower pad (a force is felt 1 mm about
its place, noise 0.05 N) and a load cell under that pad (0.1 N, 2 N.mm). For gentle and for harder
motions of a catalogue the Fisher matrix of the sensors' samples at 200 Hz, at the truth, gives the
standard deviation of every parameter by four sets of sensors: poses and F_x; those and the load
cell; and the taxels' normal forces; and their shear forces too. A parameter counts as identifiable
below 50 %. Two identifications from noisy strokes, without and with the row, started off by factors
of up to 1.5, confirm it. A Jacobian with the 40 normal forces is timed beside one without, on the
same steps.

Command: .venv/bin/python experiments/identify_by_touch.py [--smoke]
Expected: with the row gentle strokes identify what motion and F_x leave open, and intervals of the
others shrink severalfold; a Jacobian costs at most 1.3 times as much. Some three minutes on one
core.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import identify_contact
import numpy as np
from identify_contact import LAW, MU_K, MU_S, RUBBER, TRUTH

from torchsoft import RigFile, excite
from torchsoft.experiment import COARSE, RIG, markdown, options, timed, write
from torchsoft.rigs.excite import CATALOGUE, Excitation
from torchsoft.sysid import Problem, Recording, identify, record
from torchsoft.sysid.fit import percent, standard_deviations
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import Sensor, by_channel

FITTED = "strokes"
"""Recording of the two identifications."""
FELT = RigFile.ready("paper").override(
    {"contact.v_s": 0.05},
    taxels={"skin": {"pad": "L", "width": 3e-3, "count": 40, "spread": 1e-3}},
)
"""The paper's rig with the row of taxels."""
SETS = {
    "poses and F_x": {name: sensor for name, sensor in RIG.items() if name != "effort_y"},
    "load cell": {
        "L.force_x": Sensor(noise=0.1),
        "L.force_y": Sensor(noise=0.1),
        "M_L": Sensor(noise=2e-3),
    },
    "taxels, normal": {"skin.normal": Sensor(noise=0.05)},
    "taxels, shear": {"skin.shear": Sensor(noise=0.05)},
}
"""Sensors by what they are added with, each set to those before it but the load cell, which the
taxels do without."""
WITH = {
    "poses and F_x": ("poses and F_x",),
    "+ load cell": ("poses and F_x", "load cell"),
    "+ taxels": ("poses and F_x", "taxels, normal"),
    "+ taxels with shear": ("poses and F_x", "taxels, normal", "taxels, shear"),
}


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/identify_by_touch")
    rtol: float = 1e-5  # of the runs that are fitted
    motions: tuple[str, ...] = ("slow roll", "strokes", "deep pressing", "light shaking")
    repeats: int = 7  # timings of a Jacobian
    smoke: bool = False  # one short motion on a coarse mesh, four parameters


def sensors(*sets: str) -> dict[str, Sensor]:
    """Sensors of some sets, by channel."""
    return by_channel([FELT.assemble()], {k: v for one in sets for k, v in SETS[one].items()})


def recording(config: Config, truth: dict[str, float], name: str, motion: Excitation) -> Recording:
    """What all sensors give, with noise."""
    planned = excite(FELT.override(COARSE if config.smoke else {}), motion)
    return record(name, planned.build(), truth, sensors(*SETS))


def problem(data: Recording, sets: tuple[str, ...], start: dict[str, float]) -> Problem:
    """Parameters that begin there, from some of the sensors."""
    used = sensors(*sets)
    samples = {channel: data.samples[channel] for channel in used}
    return identify_contact.problem([replace(data, samples=samples)], start, used)


def jacobian(config: Config, stated: Problem) -> tuple[Array, Any]:
    """That of the residuals at the nominal values, and the steps of the run."""
    c, runner = stated.coordinates, Runner(stated.recordings)
    at = stated.residuals(runner, c.start, stated.names, config.rtol, c.free)
    return at.J, at.steps


def cost(config: Config, data: Recording, truth: dict[str, float]) -> dict[str, float]:
    """Seconds of a Jacobian on frozen steps, with the normal taxels and without, in turns."""
    both = {name: problem(data, WITH[name], truth) for name in ("poses and F_x", "+ taxels")}
    _, steps = jacobian(config, both["poses and F_x"])
    seconds: dict[str, list[float]] = {name: [] for name in both}
    for _ in range(config.repeats):
        for name, one in both.items():
            c, runner = one.coordinates, Runner(one.recordings)
            seconds[name].append(
                timed(lambda: one.residuals(runner, c.start, one.names, steps, c.free))[1]  # noqa: B023
            )
    without, with_row = (median(seconds[name]) for name in both)
    return {"without_s": without, "with_taxels_s": with_row, "ratio": with_row / without}


def main(config: Config) -> None:
    few = f"{RUBBER}.E", f"{LAW}.K_n", MU_S, MU_K
    truth = {name: TRUTH[name] for name in few} if config.smoke else TRUTH
    motions = {name: CATALOGUE[name] for name in config.motions}
    if config.smoke:
        short = {"kind": "strokes", "travel": 8e-3, "stroke_time": 0.2}
        motions = {FITTED: Excitation(short, duration=0.9)}
        config = replace(config, repeats=1)
    recordings = {name: recording(config, truth, name, motion) for name, motion in motions.items()}
    deviations = {
        name: {
            label: dict(
                zip(truth, standard_deviations(jacobian(config, problem(data, sets, truth))[0]))
            )
            for label, sets in WITH.items()
        }
        for name, data in recordings.items()
    }
    random, fits, chi2 = np.random.default_rng(0), dict[str, Any](), dict[str, float]()
    start = {k: v * float(random.uniform(1 / 1.5, 1.5)) for k, v in truth.items()}
    start[MU_K] = min(start[MU_K], 0.95 * start[MU_S])
    for label in ("poses and F_x", "+ taxels"):
        stated = problem(recordings[FITTED], WITH[label], start)
        found = identify(stated, rtol=config.rtol, assumptions="trusted")
        print(f"\n{FITTED}, {label}", found.table(), *found.findings, sep="\n")
        chi2[label] = found.chi2
        fits[label] = {
            name: {
                "truth": value, "estimate": found[name].value, "seen": found[name].identifiable,
                "error_in_sd": (found[name].last / value - 1) / found[name].relative_sd,
            }
            for name, value in truth.items()
        }  # fmt: skip
    seconds = cost(config, recordings[FITTED], truth)
    content = {"relative_sd": deviations, "fits": fits, "chi2": chi2, "jacobian": seconds}
    rows = [
        (motion, label, *(percent(sd) for sd in sds.values()))
        for motion, by in deviations.items()
        for label, sds in by.items()
    ]
    head = ("motion", "sensors", *(name.rpartition(".")[2] for name in truth))
    write(config, content, table=markdown(head, rows))
    print(
        f"a Jacobian with the row of taxels takes {seconds['with_taxels_s']:.3g} s, "
        f"{seconds['ratio']:.2f} times one without"
    )


if __name__ == "__main__":
    main(options(Config, __doc__))
