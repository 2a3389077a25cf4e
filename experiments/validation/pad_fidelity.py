"""Question: what does leaving the pads' inertia out change, and what does the mesh?

The manipulation is run with massless (statically condensed) and with inertial pads, the same step,
reference and grasping force, and every output is subtracted; so is a fast stroke of 20 mm in 0.5 s.
Condensation is exact but for inertia, because R = tau K; inertia should matter by about 1 / (tau
omega)^2, some 4e-4 of the pads' part, since every pad mode is overdamped. The same on a mesh of
twice as many elements each way, whose contact per length is the same.

Command: .venv/bin/python experiments/validation/pad_fidelity.py [--smoke]
Expected: on the manipulation inertia moves the disc by some nanometres and changes forces by some
millinewtons; the mesh moves its height in the grasp by less than 0.03 mm. About 40 s.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsoft import RigFile, Trajectory
from torchsoft.experiment import grid, markdown, options, write

UNITS = {
    "x_C": ("um", 1e6), "y_C": ("um", 1e6), "theta_C": ("urad", 1e6), "x_Br": ("um", 1e6),
    "y_Br": ("um", 1e6), "v_x_C": ("um/s", 1e6), "omega_C": ("urad/s", 1e6),
    "effort_x": ("mN", 1e3), "effort_y": ("mN", 1e3), "M_U": ("mN.m", 1e3),
    "nodal normal force": ("mN", 1e3), "nodal friction": ("mN", 1e3),
}  # fmt: skip


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/pad_fidelity")
    duration: float = 30.0  # of the manipulation [s]
    step: float = 2e-3  # of the stepper [s]; the fast stroke takes a quarter of it
    smoke: bool = False  # a size that takes seconds


def signals(run: Trajectory) -> dict[str, Tensor]:
    out = {name: run[name] for name in UNITS if not name.startswith("nodal")}
    normal, friction = torch.cat(list(run.force.values()), 1).unbind(-1)
    return out | {"nodal normal force": normal, "nodal friction": friction}


def compare(
    changes: dict[str, Any], duration: float, step: float, stroke: float | None = None
) -> dict[str, dict[str, float]]:  # fmt: skip
    """Largest difference that changed parameters make to every output, beside the output's range;
    nodal ones where the nodes are the same.

    `stroke` [s] replaces the roll by one of 20 mm in that time, from 0.6 s on.
    """
    roll = {} if stroke is None else {
        "motion.x_d.times": [0.6, 0.6 + stroke], "motion.x_d.values": ["start", 40e-3]
    }  # fmt: skip
    files = (RigFile.ready("paper").override(roll | own) for own in ({}, changes))
    runs = [signals(file.build().run(grid(duration), step=step, progress=True)) for file in files]
    out = {}
    for name, (_, scale) in UNITS.items():
        usual, changed = (run[name] for run in runs)
        if usual.shape != changed.shape:
            continue
        difference, span = float((changed - usual).abs().max()), float(usual.max() - usual.min())
        out[name] = {
            "difference": scale * difference,
            "range": scale * span,
            "relative": difference / span,
        }
    return out


def run(config: Config) -> dict[str, dict[str, dict[str, float]]]:
    duration, fine = (0.8, config.step) if config.smoke else (config.duration, config.step / 4)
    inertial, some = {"pad.inertial": True}, min(duration, 10.0)
    finer = {"pad.elements_x": 240, "pad.elements_y": 8}
    return {
        "manipulation": compare(inertial, duration, config.step),
        "stroke of 20 mm in 0.5 s": compare(inertial, 1.6, fine, 0.5),
        "240 x 8 elements": compare(finer, some, config.step),
    }


def table(differences: dict[str, dict[str, dict[str, float]]]) -> str:
    """A Markdown table, one row an output."""
    rows = []
    for name, (unit, _) in UNITS.items():
        cells = [one.get(name) for one in differences.values()]
        shown = (f"{c['difference']:.3g} ({c['relative']:.1e})" if c else "" for c in cells)
        rows.append((name, unit, *shown))
    return markdown(("difference (of range)", "unit", *differences), rows)


def main(config: Config) -> None:
    differences = run(config)
    write(config, {"differences": differences}, table=table(differences))


if __name__ == "__main__":
    main(options(Config, __doc__))
