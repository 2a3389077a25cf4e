"""Question: do the 95 % intervals of an identification hold the truth in 95 % of repetitions?

Only the noise differs from seed to seed. Each seed's intervals either hold the truth or not; with N
seeds the share of those that do is binomial, and so is its own interval (Clopper-Pearson). Errors
over the predicted standard deviations should be normal with mean 0 and deviation 1.

- The paper's rig: the three motions of `identify_contact.py`, 1.4 s of each, on half the usual
  mesh, eight parameters, started where most are some standard deviations off. White noise, then
  noise that is an autoregression of order one (rho = 0.9, as large as stated), which nobody
  declares, so that `identify` has to find it.
- Rig files: two fingers that lift a disc and two jaws that turn one, with other numbers than their
  files state. `identify` gets the recording as a CSV file, the rig's file, and eight unknowns by
  the names of that file, and starts at the numbers that the file states. Assumptions are tested for
  the first seed only: the model is right. The fingers do what their file says; the jaws of
  `orientation.toml` never slip, so that here they grip lightly and twist the disc until it does.

Command: .venv/bin/python -m experiments.validation.interval_coverage [--seeds 100] [--workers 2]
[--cases white "two jaws"] [--smoke]
Expected: of 100 seeds between 90 and 99 for every parameter of the paper's rig. Of rig files, 50
seeds, between 86 and 100 %, about 94 % of all, no notice. A quarter of an hour for 100 seeds of the
paper's rig, twenty minutes for 50 of both rig files.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from experiments.frame import COARSE, Table, options, repeated, write
from experiments.identify_contact import (
    FEW,
    HELD_OUT,
    SENSORS,
    TRUTH,
    coloured,
    motions,
    nominal,
    problem,
)
from torchsoft import RigFile, csvfile, excite
from torchsoft.sysid import IdentificationResult, Sensor, Stage, identify, record
from torchsoft.sysid.initial_state import Standing
from torchsoft.sysid.measured import load
from torchsoft.tables import toml_row

OFF = 1.002
"""Where a fit of the paper's rig starts, over the truth."""

LONGEST = 1.4
"""Duration of a motion of the paper's rig [s]."""

RHO = 0.9
"""Correlation of neighbouring samples of the coloured noise."""

RATE, EXACT = 200.0, 1e-7
"""Of rig files: samples a second, and relative tolerance of the runs that are recorded."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/interval_coverage")
    seeds: int = 100
    cases: tuple[str, ...] = field(default_factory=lambda: tuple(CASES))
    rtol: float = 3e-5  # of the fits of the paper's rig; data have a hundredth of it
    workers: int = 2
    checked: int = 1  # seeds of a rig file whose assumptions are tested
    smoke: bool = False  # two seeds, a few unknowns, short motions, nothing tested


class Case(NamedTuple):
    """Truth by unknown, and the identification of a seed."""

    truth: dict[str, float]
    identified: Callable[[int], IdentificationResult]


# the paper's rig
# ----------------------------------------------------------------------


def papers(config: Config, rho: float) -> Case:
    """The paper's rig with noise whose neighbouring samples correlate by rho."""
    truth, file = FEW if config.smoke else TRUTH, nominal(config.smoke).override(COARSE)
    exact = []
    for name, e in motions(config.smoke).items():
        if config.smoke or name != HELD_OUT:
            built = excite(file, e._replace(duration=min(e.duration, LONGEST))).build()
            exact.append(record(name, built, truth, SENSORS, rtol=1e-2 * config.rtol, noise=0.0))

    def identified(seed: int) -> IdentificationResult:
        rng, recordings = np.random.default_rng(seed), []
        for one in exact:
            samples = {
                channel: (t, y + SENSORS[channel].noise * coloured(len(t), rho, rng))
                for channel, (t, y) in one.samples.items()
            }
            recordings.append(replace(one, samples=samples))
        stated = problem(recordings, {name: OFF * value for name, value in truth.items()})
        labels = stated.coordinates.labels
        plan = [Stage("all", stated.names, labels, config.rtol, tolerance=1e-3)]
        return identify(stated, plan=plan, assumptions="trusted")  # the model is right

    return Case(truth, identified)


# rig files
# ----------------------------------------------------------------------


def noises(places: str, angles: str, forces: str) -> dict[str, float]:
    """Standard deviations [m, rad, N] of channels, by what they measure."""
    sizes = (places, 1e-5), (angles, 5e-4), (forces, 0.05)
    return {channel: sd for names, sd in sizes for channel in names.split()}


@dataclass(frozen=True)
class Laboratory:
    """A ready rig, the settings that are known, the truth of what is not over what the file states
    (the first three for the smoke test), and the noise of sensors."""

    file: str
    settings: dict[str, Any]
    truth: dict[str, float]
    noise: dict[str, float]


FINGERS = Laboratory(
    "two_fingers",
    {
        "pads": {
            "table": {"elements_x": 25, "elements_y": 3},
            "left_tip": {"elements_x": 18, "elements_y": 3},
            "right_tip": {"elements_x": 18, "elements_y": 3},
        }
    },
    {
        "materials.silicone.E": 0.85, "bodies.disc.mass": 1.06, "actuators.left_x.Kd": 1.2,
        "materials.silicone.tau": 1.25, "laws.dry.K_n": 1.2, "laws.dry.friction.mu_s": 1.1,
        "actuators.left_x.Kp": 0.9, "actuators.right_x.Kd": 0.85,
    },
    noises(
        "x_disc y_disc x_left y_left x_right y_right", "theta_disc theta_left theta_right",
        "effort_left_x effort_left_y effort_right_x effort_right_y",
    ),
)  # fmt: skip
JAWS = Laboratory(
    "orientation",
    {
        "pads": {jaw: {"elements_x": 35, "elements_y": 3} for jaw in ("lower", "upper")},
        "motion": {
            "theta_d": {"times": [0.5, 0.55, 0.65, 0.7], "values": [0.0, 0.6, -0.6, 0.0]},
            "x_d": {"times": [1.0, 1.1, 1.3, 1.4], "values": [0.0, 8e-3, -8e-3, 0.0]},
            "y_d": {"kind": "hold"},
            "y_rate": {"kind": "hold"},
            "grip": {"values": [-5.5, -5.5]},
            "bear": {"values": [9.5, 9.5]},
        },
        "outputs": {"duration": 1.6, "snapshots": []},
    },
    {
        "materials.rubber.E": 0.85, "bodies.disc.mass": 1.02, "actuators.carry_lower.Kp": 1.05,
        "materials.rubber.tau": 1.25, "laws.dry.K_n": 1.2, "laws.dry.friction.mu_s": 1.04,
        "actuators.turn_lower.Kp": 0.95, "actuators.grip.Kd": 1.2,
    },
    noises(
        "x_disc y_disc x_lower y_lower x_upper y_upper", "theta_disc",
        "effort_turn_lower effort_turn_upper effort_carry_lower effort_lift effort_grip",
    ),
)  # fmt: skip


def of_a_file(config: Config, lab: Laboratory) -> Case:
    """A rig file: recordings and identification are files, as a user's are."""
    shorter = {"outputs": {"duration": 0.8, "snapshots": []}} if config.smoke else {}
    settings = lab.settings | shorter
    file = RigFile.ready(lab.file).override(**settings)
    rig = file.assemble()
    some = islice(lab.truth.items(), 3 if config.smoke else None)
    truth = {name: factor * rig.parameter(name).item() for name, factor in some}
    folder = config.out / lab.file
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "fit.toml").write_text(stated(lab, settings, truth), encoding="utf-8")
    sensors = {channel: Sensor(noise=sd) for channel, sd in lab.noise.items()}
    built = file.build()
    # at rest with the true numbers
    start = Standing.of(built.rig, built.y0)._replace(rests=file.rests())
    exact = record("measured", built, truth, sensors, start=start, rate=RATE, rtol=EXACT, noise=0.0)

    def identified(seed: int) -> IdentificationResult:
        rng, path = np.random.default_rng(seed), folder / f"{seed}.csv"
        columns = {"t": exact.times} | {
            channel: y + lab.noise[channel] * rng.standard_normal(len(y))
            for channel, (_, y) in exact.samples.items()
        }
        csvfile.write(path, columns, {"t": "s", **exact.units})
        one = load([path], folder / "fit.toml")
        how: dict[str, Any] = one.config.fit.model_dump()
        how |= {} if seed < config.checked else {"assumptions": "trusted"}
        result = identify(one.problem, **how)
        path.unlink()
        return result

    return Case(truth, identified)


def stated(lab: Laboratory, settings: Mapping[str, Any], truth: Mapping[str, float]) -> str:
    """The identification, as a user would write it."""
    lines = [toml_row("rig", lab.file), "[settings]"]
    lines += [toml_row(name, one) for name, one in settings.items()]
    lines += ["[unknowns]", *(f'"{name}" = {{}}' for name in truth)]
    return "\n".join([*lines, "[sensors]", *(f"{k}.noise = {v}" for k, v in lab.noise.items())])


CASES: dict[str, Callable[[Config], Case]] = {
    "white": lambda c: papers(c, 0.0),
    "coloured": lambda c: papers(c, RHO),
    "two fingers": lambda c: of_a_file(c, FINGERS),
    "two jaws": lambda c: of_a_file(c, JAWS),
}


def judged(truth: Mapping[str, float], found: list[IdentificationResult]) -> dict[str, Any]:
    """Of all seeds of a case: by unknown, errors of its logarithm over their predicted standard
    deviations, and how many intervals hold; findings by their code."""
    parameters = {}
    for name, value in truth.items():
        every = [result[name] for result in found]
        errors = [float(np.log(e.last / value)) / e.relative_sd for e in every]
        inside = sum(e.ci95 is not None and e.ci95[0] <= value <= e.ci95[1] for e in every)
        own = stats.binomtest(inside, len(found)).proportion_ci(0.95)
        parameters[name] = {
            "truth": value, "relative_sd": float(np.median([e.relative_sd for e in every])),
            "inside": inside, "ci95": [own.low, own.high], "mean": float(np.mean(errors)),
            "sd": float(np.std(errors, ddof=1)), "errors": errors,
        }  # fmt: skip
    notices = Counter(one.code for result in found for one in result.findings)
    return {"notices": notices, "parameters": parameters}


def main(config: Config) -> None:
    if config.smoke:
        config = replace(config, seeds=2, workers=1, rtol=1e-4, checked=0)
    rows, cells = {}, []
    for name in config.cases:
        case = CASES[name](config)
        found = repeated(case.identified, config.seeds, config.workers, name)
        rows[name] = judged(case.truth, found)
        for unknown, one in rows[name]["parameters"].items():
            cells.append((
                name, unknown, f"{one['relative_sd']:.2%}", f"{one['inside']} of {config.seeds}",
                "{:.0%} .. {:.0%}".format(*one["ci95"]), f"{one['mean']:+.2f}", f"{one['sd']:.2f}",
            ))  # fmt: skip
        print(f"{name}: notices {dict(rows[name]['notices'])}")
    head = (
        "case", "unknown", "standard deviation", "intervals that hold the truth",
        "its own 95 % interval", "mean error / sd", "sd of that",
    )  # fmt: skip
    write(config, {"seeds": config.seeds, "cases": rows}, {"intervals": Table(head, cells)})


if __name__ == "__main__":
    main(options(Config, __doc__))
