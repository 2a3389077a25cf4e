"""Question: what does leaving the pads' inertia out change?

The manipulation is run with massless (statically condensed) and with inertial pads, the same step,
reference and grasping force, and every output is subtracted; so is a fast stroke of 20 mm in 0.5 s.
Condensation is exact but for inertia, because R = tau K; inertia should matter by about 1 / (tau
omega)^2, some 4e-4 of the pads' part, since every pad mode is overdamped.

Command: .venv/bin/python experiments/validation/pad_fidelity.py [--smoke]
Expected: on the manipulation the disc differs by some nanometres and the forces by some
millinewtons. About 20 s.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchsoft import Parameters, Profile, SoftGrasp, Trajectory, simulate
from torchsoft.experiment import grid, markdown, options, write
from torchsoft.scenario import grasp_and_roll

UNITS = {
    "x_C": ("um", 1e6), "y_C": ("um", 1e6), "theta": ("urad", 1e6), "x_Br": ("um", 1e6),
    "y_Br": ("um", 1e6), "v_x": ("um/s", 1e6), "omega": ("urad/s", 1e6), "F_x": ("mN", 1e3),
    "F_y": ("mN", 1e3), "M_Br": ("mN.m", 1e3), "nodal normal force": ("mN", 1e3),
    "nodal friction": ("mN", 1e3),
}  # fmt: skip


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/pad_fidelity")
    duration: float = 30.0  # of the manipulation [s]
    step: float = 2e-3  # of the stepper [s]; the fast stroke takes a quarter of it
    smoke: bool = False  # a size that takes seconds


@dataclass(frozen=True)
class Result:
    config: Config
    differences: dict[str, dict[str, dict[str, float]]]


def signals(run: Trajectory) -> dict[str, Tensor]:
    out = {
        name: run["bracket_moment" if name == "M_Br" else name]
        for name in UNITS
        if not name.startswith("nodal")
    }
    normal, friction = torch.cat(list(run.force.values()), 1).unbind(-1)
    return out | {"nodal normal force": normal, "nodal friction": friction}


def compare(
    duration: float, step: float, stroke: float | None, grasp_force: float
) -> dict[str, dict[str, float]]:
    """Largest inertial - massless difference of every output, beside the output's range.

    `stroke` [s] replaces the roll by one of 20 mm in that time, from 0.6 s on.
    """
    runs = {}
    for fidelity in ("massless", "inertial"):
        model = SoftGrasp(Parameters().override({"pad.fidelity": fidelity}))
        manipulation = grasp_and_roll(model, grasp_force=grasp_force)
        if stroke is not None:
            model.reference.signals["x_d"] = Profile([0.6, 0.6 + stroke], [0.06, 0.04])
        runs[fidelity] = signals(
            simulate(model, grid(duration), y0=manipulation.y0, step=step, progress=True)
        )
    out = {}
    for name, (_, scale) in UNITS.items():
        massless, inertial = runs["massless"][name], runs["inertial"][name]
        difference, span = (
            float((inertial - massless).abs().max()),
            float(massless.max() - massless.min()),
        )
        out[name] = {
            "difference": scale * difference,
            "range": scale * span,
            "relative": difference / span,
        }
    return out


def run(config: Config) -> Result:
    duration = 0.8 if config.smoke else config.duration
    force = grasp_and_roll(SoftGrasp()).grasp_force
    return Result(
        config,
        {
            "manipulation": compare(duration, config.step, None, force),
            "stroke of 20 mm in 0.5 s": compare(
                1.6, config.step if config.smoke else config.step / 4, 0.5, force
            ),
        },
    )


def table(result: Result) -> str:
    """A Markdown table, one row an output."""
    cases = list(result.differences)
    rows = []
    for name, (unit, _) in UNITS.items():
        cells = [result.differences[case][name] for case in cases]
        rows.append((name, unit, *(f"{c['difference']:.3g} | {c['relative']:.1e}" for c in cells)))
    return markdown(
        (
            "output",
            "unit",
            *(column for case in cases for column in (f"{case}: difference", "of range")),
        ),
        rows,
    )


def main() -> None:
    result = run(options(Config, __doc__))
    write(result.config, {"differences": result.differences}, table=table(result))


if __name__ == "__main__":
    main()
