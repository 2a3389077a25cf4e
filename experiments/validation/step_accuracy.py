"""Question: which tolerance, and which step, means which accuracy of motion, force and gradient,
and at what cost?

Three motions: the paper's grasp and roll out (10 s), light shaking (1 s), and a stroke of 2 mm in
20 ms. Each is run by tolerances and by equal steps against a run by a much smaller tolerance:
largest errors of the disc's pose and of the forces over their range, and the relative errors of d
theta(end) / d parameter for eight parameters, by the discrete adjoint. Times are the least of
several, for the run alone, with the gradient with respect to all parameters, and with the Jacobian
with respect to eight.

Command: .venv/bin/python -m experiments.validation.step_accuracy [--smoke]
Expected: rtol = 1e-3 is about as near as a step of 2 ms, for a third of its cost in the
manipulation; gradients converge later: the worst of eight parameters is off by 2 and 3 % at
rtol = 1e-6 in the roll and in the stroke (22 and 235 % at 2 ms), in shaking, where some are a
thousand times smaller than others, by 17 % at 1e-7. A gradient costs at most 0.6 of a run by a
tolerance. Two minutes on one core.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from experiments.frame import COARSE, numbers, options, timed, write
from torchsoft import BuiltRig, RigFile, excite
from torchsoft.rigs.excite import Excitation, sines, strokes

EIGHT = (
    *(f"contact.{name}" for name in ("K_n", "R_n", "K_t", "R_t", "mu_s", "mu_k")),
    *("pad.E", "pad.tau"),
)
SIGNALS = "x_C", "y_C", "theta_C", "effort_x", "effort_y"


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/step_accuracy")
    rtols: tuple[float, ...] = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
    steps_ms: tuple[float, ...] = (2.0, 1.0, 0.5)  # equal steps [ms]
    exact: float = 1e-8  # relative tolerance of the run they are compared with
    roll: float = 10.0  # of the manipulation [s]
    repeats: int = 3  # timings of which the least is taken
    smoke: bool = False  # the stroke alone, on a coarse mesh


def motions(config: Config) -> dict[str, BuiltRig]:
    paper = RigFile.ready("paper").override(COARSE if config.smoke else {})
    shaking = sines(1e-3, (2.0, 10.0), 0), sines(5e-5, (2.0, 10.0), 1)
    stroke, fine = "stroke of 2 mm in 20 ms", {"outputs.interval": 5e-3}
    files = {
        "grasp and roll out": paper.override(outputs={"duration": config.roll, "snapshots": []}),
        "light shaking": excite(paper, Excitation(*shaking, duration=1.0)).override(fine),
        stroke: excite(paper, Excitation(strokes(2e-3, 0.02), duration=0.54)).override(fine),
    }
    return {name: files[name].build() for name in ([stroke] if config.smoke else files)}


def gradient(built: BuiltRig, **steps: Any) -> Tensor:
    """d theta(end) / d log p of the eight parameters."""
    run = built.run(gradient="discrete", **steps)
    p = [built.rig.parameter(name) for name in EIGHT]
    parts = torch.autograd.grad(run["theta_C"][-1], p)
    return torch.stack([part * value.detach() for part, value in zip(parts, p)])


def study(built: BuiltRig, config: Config) -> dict[str, dict[str, Any]]:
    """One motion: errors and times [s] by the way in which steps are chosen."""
    exact, wanted = built.run(rtol=config.exact), gradient(built, rtol=config.exact)
    ways: dict[str, dict[str, Any]] = {f"rtol = {rtol:g}": {"rtol": rtol} for rtol in config.rtols}
    ways |= {f"step = {h:g} ms": {"step": 1e-3 * h} for h in config.steps_ms}
    out = {}
    for way, steps in ways.items():
        forward = {"gradient": "forward", "wrt": EIGHT, "rigid": True, **steps}
        run, got = built.run(**steps), gradient(built, **steps)
        tasks = (
            lambda steps=steps: built.run(**steps),
            lambda steps=steps: gradient(built, **steps),
            lambda how=forward: built.run(**how),
        )
        turns = [[timed(task)[1] for task in tasks] for _ in range(config.repeats)]
        alone, adjoint, jacobian = (min(walls) for walls in zip(*turns))
        off = ((got - wanted) / wanted).abs()
        errors = {
            name: (run[name] - exact[name]).abs().max() / (exact[name].max() - exact[name].min())
            for name in SIGNALS
        }
        out[way] = {
            "steps": run.stats.steps, "refused": run.stats.refused_steps, "run [s]": alone,
            "gradient / run": adjoint / alone, "Jacobian / run": jacobian / alone,
            **{name: error.item() for name, error in errors.items()},
            "energy residual": run.energy_residual_rel, "gradient": off.max().item(),
            "gradients": dict(zip(EIGHT, off.tolist())),
        }  # fmt: skip
    return out


def main(config: Config) -> None:
    if config.smoke:
        config = replace(config, rtols=(1e-3, 1e-6), steps_ms=(2.0,), repeats=1)
    every = tqdm(motions(config).items(), unit="motion", disable=None)
    found = {title: study(built, config) for title, built in every}
    hidden = "refused", "gradients"
    tables = {
        title: numbers(
            "steps",
            {way: {k: x for k, x in row.items() if k not in hidden} for way, row in rows.items()},
            ".3g",
        )
        for title, rows in found.items()
    }
    write(config, {"motions": found}, tables)


if __name__ == "__main__":
    main(options(Config, __doc__))
