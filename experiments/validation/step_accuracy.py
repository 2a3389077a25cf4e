"""Question: which tolerance, and which step, means which accuracy of motion, force and gradient,
and at what cost?

Three motions: the paper's grasp and roll out (10 s), light shaking (1 s), and a stroke of 2 mm in
20 ms. Each is run by tolerances and by equal steps against a run by a much smaller tolerance:
largest errors of the disc's pose and of the forces over their range, and the relative errors of d
theta(end) / d parameter for eight parameters, by the discrete adjoint.

Command: .venv/bin/python experiments/validation/step_accuracy.py [--smoke]
Expected: rtol = 1e-3 is about as near as a step of 2 ms, for a third of its cost in the
manipulation; gradients are right later: the worst of eight parameters' is off by 2 and 3 % at
rtol = 1e-6 in the roll and in the stroke (22 and 235 % at 2 ms), in shaking, where some are a
thousand times smaller than others, by 17 % at 1e-7. About a minute on one core.
"""

from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchsoft import BuiltRig, RigFile, Trajectory, excite
from torchsoft.experiment import COARSE, numbers, options, timed, write
from torchsoft.rigs.excite import Excitation

EIGHT = (
    *(f"contact.{name}" for name in ("K_n", "R_n", "K_t", "R_t", "mu_s", "mu_k")),
    *("pad.E", "pad.tau"),
)
SIGNALS = "x_C", "y_C", "theta_C", "effort_x", "effort_y"


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/step_accuracy")
    rtols: tuple[float, ...] = (
        1e-3,
        1e-4,
        1e-5,
        1e-6,
        1e-7,
    )  # relative tolerances; a tenth of it is the absolute one
    steps_ms: tuple[float, ...] = (2.0, 1.0, 0.5)  # equal steps [ms]
    exact: float = 1e-8  # relative tolerance of the run they are compared with
    roll: float = 10.0  # of the manipulation [s]
    repeats: int = 3  # timings of which the median is taken
    smoke: bool = False  # a size that takes seconds


def motions(config: Config) -> dict[str, BuiltRig]:
    """The three motions; with `smoke` the stroke on a coarse mesh alone."""
    paper = RigFile.ready("paper").override(COARSE if config.smoke else {})
    roll = {"kind": "strokes", "travel": 2e-3, "stroke_time": 0.02}
    shake = {"kind": "multi_sine", "band": (2.0, 10.0)}
    shaking = shake | {"amplitude": 1e-3, "seed": 0}, shake | {"amplitude": 5e-5, "seed": 1}
    stroke, fine = "stroke of 2 mm in 20 ms", {"outputs.interval": 5e-3}
    files = {
        "grasp and roll out": paper.override(outputs={"duration": config.roll, "snapshots": []}),
        "light shaking": excite(paper, Excitation(*shaking, duration=1.0)).override(fine),
        stroke: excite(paper, Excitation(roll, duration=0.54)).override(fine),
    }
    return {name: files[name].build() for name in ([stroke] if config.smoke else files)}


def gradient(built: BuiltRig, **steps: Any) -> Tensor:
    """d theta(end) / d log p of the eight parameters."""
    run = built.run(gradient="discrete", **steps)
    p = [built.rig.parameter(name) for name in EIGHT]
    parts = torch.autograd.grad(run["theta_C"][-1], p)
    return torch.stack([part * value.detach() for part, value in zip(parts, p)])


def errors(run: Trajectory, exact: Trajectory) -> dict[str, float]:
    """Largest error of every signal over its range."""
    pairs = {name: (run[name], exact[name]) for name in SIGNALS}
    return {
        name: ((x - y).abs().max() / (y.max() - y.min())).item() for name, (x, y) in pairs.items()
    }


def run(config: Config) -> dict[str, dict[str, dict[str, Any]]]:
    if config.smoke:
        config = Config(
            out=config.out, rtols=(1e-3, 1e-6), steps_ms=(2.0,), exact=1e-8, repeats=1, smoke=True
        )
    ways: dict[str, dict[str, Any]] = {f"rtol = {rtol:g}": {"rtol": rtol} for rtol in config.rtols}
    ways |= {f"step = {h:g} ms": {"step": 1e-3 * h} for h in config.steps_ms}
    every = motions(config)
    out: dict[str, dict[str, dict[str, Any]]] = {}
    for title, motion in tqdm(every.items(), unit="motion", disable=None):
        exact = motion.run(rtol=config.exact)
        wanted = gradient(motion, rtol=config.exact)
        out[title] = {}
        for key, steps in ways.items():
            runs = [motion.run(**steps) for _ in range(config.repeats)]
            got, wall = timed(lambda: gradient(motion, **steps))  # noqa: B023
            off = ((got - wanted) / wanted).abs()
            out[title][key] = {
                "steps": runs[0].stats.steps,
                "refused": runs[0].stats.refused_steps,
                "wall_s": median(one.stats.wall_s for one in runs),
                "with_gradient_s": wall,
                **errors(runs[0], exact),
                "energy_residual": runs[0].energy_residual_rel,
                "gradient": off.max().item(),
                "gradients": dict(zip(EIGHT, off.tolist())),
            }
    return out


COLUMNS = "steps", "wall_s", "with_gradient_s", *SIGNALS, "energy_residual", "gradient"


def table(rows: dict[str, dict[str, Any]]) -> str:
    """A Markdown table of one motion."""
    return numbers("", {key: {name: row[name] for name in COLUMNS} for key, row in rows.items()}, 3)


def main(config: Config) -> None:
    found = run(config)
    tables = "\n\n".join(f"{title}\n\n{table(rows)}" for title, rows in found.items())
    write(config, {"motions": found}, table=tables)


if __name__ == "__main__":
    main(options(Config, __doc__))
