"""Question: does an identification by a rig file find the numbers of the rig, with intervals that
hold?

Two ready rigs, two fingers that lift a disc and two jaws that turn one, are made with other numbers
than their files state, and recorded with the noise of sensors. `identify` gets the recording as a
CSV file, the rig's file, and eight unknowns by the names of that file: the pads' material, the
contact, friction, a mass, gains of controllers. It begins at the numbers that the file states. Only
the noise differs from seed to seed; the share of intervals that hold is binomial, and so is its own
interval (Clopper-Pearson). Assumptions are tested for the first seed only: the model is right.

The fingers do what their file says. The jaws of `orientation.toml` never slip, so that friction
could not be told to better than a half: here they grip lightly and twist the disc to and fro until
it slips.

Command: .venv/bin/python experiments/validation/rig_files.py [--seeds 50] [--workers 2] [--smoke]
Expected: between 86 and 100 % of 50 seeds, about 94 % of all intervals; no notice. Some twenty
minutes on one core.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from torchsoft.experiment import markdown, options, repeated, write
from torchsoft.files import replacing
from torchsoft.rigs import RigFile
from torchsoft.sysid import Recording, Sensor, identify, record
from torchsoft.sysid.measured import load

RIGS = Path(__file__).parents[2] / "rigs"

RATE, EXACT = 200.0, 1e-7
"""Samples a second, and the relative tolerance of the runs that recordings are made of."""

PLACE, ANGLE, FORCE = 1e-5, 5e-4, 0.05
"""Noise of the sensors [m, rad, N]."""


@dataclass(frozen=True)
class Case:
    """A rig file, the settings that the laboratory knows, the truth of what it does not know over
    what the file states, and the noise of sensors."""

    file: str
    settings: dict[str, Any]
    truth: dict[str, float]
    noise: dict[str, float]
    few: tuple[str, ...]
    """Unknowns of the smoke test."""


def noise(places: str, angles: str, forces: str) -> dict[str, float]:
    """Of channels, by what they measure."""
    sizes = (places, PLACE), (angles, ANGLE), (forces, FORCE)
    return {channel: sd for names, sd in sizes for channel in names.split()}


TWIST, CARRY = [0.5, 0.55, 0.65, 0.7], [1.0, 1.1, 1.3, 1.4]
"""When the disc is twisted to and fro, and when it is carried to and fro [s]."""

CASES = {
    "two fingers": Case(
        "two_fingers.toml",
        {
            "pads": {
                "table": {"elements_x": 25, "elements_y": 3},
                "left_tip": {"elements_x": 18, "elements_y": 3},
                "right_tip": {"elements_x": 18, "elements_y": 3},
            }
        },
        {
            "materials.silicone.E": 0.85, "materials.silicone.tau": 1.25, "laws.dry.K_n": 1.2,
            "laws.dry.friction.mu_s": 1.1, "bodies.disc.mass": 1.06, "actuators.left_x.Kp": 0.9,
            "actuators.left_x.Kd": 1.2, "actuators.right_x.Kd": 0.85,
        },
        noise(
            "x_disc y_disc x_left y_left x_right y_right", "theta_disc theta_left theta_right",
            "F_left_x F_left_y F_right_x F_right_y",
        ),
        ("materials.silicone.E", "bodies.disc.mass", "actuators.left_x.Kd"),
    ),
    "two jaws": Case(
        "orientation.toml",
        {
            "pads": {jaw: {"elements_x": 35, "elements_y": 3} for jaw in ("lower", "upper")},
            "motion": {
                "theta_d": {"times": TWIST, "values": [0.0, 0.6, -0.6, 0.0]},
                "x_d": {"times": CARRY, "values": [0.0, 8e-3, -8e-3, 0.0]},
                "y_d": {"kind": "hold"},
                "y_rate": {"kind": "hold"},
                "grip": {"values": [-5.5, -5.5]},
                "bear": {"values": [9.5, 9.5]},
            },
            "outputs": {"duration": 1.6, "snapshots": []},
        },
        {
            "materials.rubber.E": 0.85, "materials.rubber.tau": 1.25, "laws.dry.K_n": 1.2,
            "laws.dry.friction.mu_s": 1.04, "bodies.disc.mass": 1.02,
            "actuators.turn_lower.Kp": 0.95, "actuators.carry_lower.Kp": 1.05,
            "actuators.grip.Kd": 1.2,
        },
        noise(
            "x_disc y_disc x_lower y_lower x_upper y_upper", "theta_disc",
            "F_turn_lower F_turn_upper F_carry_lower F_lift F_grip",
        ),
        ("materials.rubber.E", "bodies.disc.mass", "actuators.carry_lower.Kp"),
    ),
}  # fmt: skip

SHORTER = {"two fingers": 0.8, "two jaws": 0.8}
"""Durations of the smoke test [s]."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/rig_files")
    seeds: int = 50
    rigs: tuple[str, ...] = field(default_factory=lambda: tuple(CASES))
    workers: int = 2
    checked: int = (
        1  # seeds whose assumptions are tested too, as `identify` does unless told not to
    )
    smoke: bool = False  # two seeds, three unknowns, the beginnings of the motions, nothing tested


class Found(NamedTuple):
    """One seed: by unknown its error over the predicted standard deviation, that deviation [1] and
    whether its interval holds; chi2, notices, and the wall time [s]."""

    unknowns: dict[str, tuple[float, float, bool]]
    chi2: float
    notices: list[str]
    seconds: float


@dataclass(frozen=True)
class Result:
    config: Config
    truth: dict[str, dict[str, float]]
    found: dict[str, list[Found]]

    def inside(self, case: str, name: str) -> int:
        """How many intervals hold the truth."""
        return sum(one.unknowns[name][2] for one in self.found[case])


def exact(case: Case, file: RigFile, truth: Mapping[str, float]) -> Recording:
    """What the rig with the true numbers gives without noise, by the set-points of the file."""
    sensors = {channel: Sensor(noise=sd) for channel, sd in case.noise.items()}
    return record("measured", file.build(), truth, sensors, rate=RATE, rtol=EXACT, noise=0.0)


def stated(case: Case, settings: Mapping[str, Any], truth: list[str]) -> str:
    """The identification, as a user would write it."""
    lines = [f'rig = "{(RIGS / case.file).as_posix()}"']
    lines += ["[settings]", *(f"{name} = {literal(one)}" for name, one in settings.items())]
    lines += ["[unknowns]", *(f'"{name}" = {{}}' for name in truth)]
    return "\n".join([*lines, "[sensors]", *(f"{k}.noise = {v}" for k, v in case.noise.items())])


def literal(value: Any) -> str:
    """A value in a line of TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = {literal(one)}' for key, one in value.items()) + "}"
    return f'"{value}"' if isinstance(value, str) else str(value)


def found(
    folder: Path, data: Recording, case: Case, truth: dict[str, float], seed: int, checked: bool
) -> Found:
    """The identification of one noisy recording, by its file."""
    rng, path = np.random.default_rng(seed), folder / f"{seed}.csv"
    columns = [data.times]
    for channel, (_, y) in data.samples.items():
        columns.append(y + case.noise[channel] * rng.standard_normal(len(y)))
    head = ",".join(["t [s]", *(f"{name} [{data.units[name]}]" for name in data.samples)])
    with replacing(path) as partial:
        np.savetxt(partial, np.stack(columns, 1), "%.12g", ",", header=head, comments="")
    one = load([path], folder / "fit.toml")
    how: dict[str, Any] = one.config.fit.model_dump()
    how |= {} if checked else {"assumptions": "trusted"}
    answer = identify(one.problem, **how)
    path.unlink()
    out = {}
    for name, value in truth.items():
        e = answer[name]
        held = e.ci95 is not None and e.ci95[0] <= value <= e.ci95[1]
        out[name] = float(np.log(e.last / value)) / e.relative_sd, e.relative_sd, held
    return Found(out, answer.chi2, answer.notices, answer.cost["wall_s"])


def run(config: Config) -> Result:
    config = replace(config, seeds=2, workers=1, checked=0) if config.smoke else config
    truths, answers = {}, {}
    for name in config.rigs:
        case, settings = CASES[name], CASES[name].settings
        if config.smoke:
            settings = settings | {"outputs": {"duration": SHORTER[name], "snapshots": []}}
        file = RigFile.from_toml(RIGS / case.file).override(**settings)
        rig = file.assemble()
        truth = {k: factor * rig.parameter(k).item() for k, factor in case.truth.items()}
        truths[name] = {k: v for k, v in truth.items() if k in case.few or not config.smoke}
        folder = config.out / name.replace(" ", "_")
        folder.mkdir(parents=True, exist_ok=True)
        text = stated(case, settings, list(truths[name]))
        (folder / "fit.toml").write_text(text, encoding="utf-8")
        data = exact(case, file, truths[name])
        answers[name] = repeated(
            lambda seed, args=(folder, data, case, truths[name]): found(
                *args, seed, seed < config.checked
            ),
            config.seeds, config.workers, name,
        )  # fmt: skip
    return Result(config, truths, answers)


def figure(result: Result) -> Figure:
    """Coverage by unknown with its own interval, a panel a rig."""
    fig = Figure(figsize=(8.0, 2.4 * len(result.found)), layout="constrained")
    panels = fig.subplots(len(result.found), squeeze=False)[:, 0]
    for axes, (case, truth) in zip(panels, result.truth.items()):
        n, y = result.config.seeds, np.arange(len(truth))
        counts = [result.inside(case, name) for name in truth]
        own = np.array([stats.binomtest(k, n).proportion_ci(0.95) for k in counts])
        axes.axvspan(90, 99, color="0.92")
        axes.plot(100 * own.T, np.stack((y, y)), color="C0", lw=1.5)
        axes.plot(100 * np.array(counts) / n, y, "o", color="C0", ms=5)
        axes.set_yticks(y, list(truth))
        axes.set(title=case, ylim=(len(truth) - 0.5, -0.5))
    panels[-1].set_xlabel("intervals that hold the truth [%]")
    return fig


def main(config: Config) -> None:
    result = run(config)
    n, rows, cells = result.config.seeds, {}, []
    for case, answers in result.found.items():
        kinds = Counter(" ".join(note.split()[:6]) for one in answers for note in one.notices)
        seconds = float(np.median([one.seconds for one in answers]))
        rows[case] = {
            "notices": dict(kinds), "seconds": seconds, "chi2": [one.chi2 for one in answers],
            "unknowns": {},
        }  # fmt: skip
        for name, value in result.truth[case].items():
            inside, off = result.inside(case, name), [one.unknowns[name][0] for one in answers]
            own = stats.binomtest(inside, n).proportion_ci(0.95)
            mean, spread = float(np.mean(off)), float(np.std(off, ddof=1))
            sd = float(np.median([one.unknowns[name][1] for one in answers]))
            rows[case]["unknowns"][name] = {
                "truth": value, "sd": sd, "inside": inside, "share": inside / n,
                "ci95": [own.low, own.high], "mean": mean, "spread": spread, "errors": off,
            }  # fmt: skip
            share = f"{own.low:.0%} .. {own.high:.0%}"
            errors = f"{mean:+.2f}", f"{spread:.2f}"
            cells.append((case, name, f"{sd:.2%}", f"{inside} of {n}", share, *errors))
        print(f"{case}: {seconds:.0f} s each; notices {dict(kinds)}")
    head = (
        "rig",
        "unknown",
        "standard deviation",
        "intervals that hold the truth",
        "its own 95 % interval",
        "mean error / sd",
        "sd of that",
    )
    write(
        result.config, {"seeds": n, "rigs": rows}, {"rig_files": figure(result)},
        markdown(head, cells),
    )  # fmt: skip


if __name__ == "__main__":
    main(options(Config, __doc__))
