"""Question: how much of the paper's manipulation is the mesh and the slip element's viscosity?

The first 10 s (grasp and roll out) are run on several meshes and with several viscosities eta, down
to Coulomb's limit eta = 0. The per-node contact values refer to 1 mm of surface and scale with a
node's tributary length, so that all meshes have the same contact. What the step decides is in
`step_accuracy.py`.

Command: .venv/bin/python experiments/validation/refinement.py [--smoke]
Expected: x_C(10 s) does not depend on the mesh, y_C in the grasp changes by less than 0.03 mm, and
the peak of F_x, which rides on node transitions, falls with the mesh. About half a minute on one
core.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchsoft import Parameters, SoftGrasp, Trajectory, simulate
from torchsoft.experiment import grid, numbers, options, write
from torchsoft.scenario import grasp_and_roll


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/refinement")
    elements_x: tuple[int, ...] = (
        60,
        120,
        240,
        480,
    )  # elements along the pad; a thirtieth of that through it
    etas: tuple[float, ...] = (
        100.0,
        10.0,
        1.0,
        0.1,
        0.0,
    )  # viscosities of the slip element [N.s/m]
    roll: float = 10.0  # of the runs on other meshes and with other viscosities [s]
    smoke: bool = False  # a size that takes seconds


@dataclass(frozen=True)
class Result:
    config: Config
    meshes: dict[str, dict[str, float]]
    etas: dict[str, dict[str, float]]


def manipulate(changes: dict[str, Any], duration: float) -> Trajectory:
    """The paper's manipulation with some parameters changed, its first `duration` seconds on a 10
    ms grid."""
    model = SoftGrasp(Parameters().override(changes))
    return simulate(model, grid(duration), y0=grasp_and_roll(model).y0, step=2e-3)


def figures_of_merit(run: Trajectory) -> dict[str, float]:
    """Numbers that sum up one run of the manipulation."""
    normal, friction = run.force["L"].unbind(-1)
    grasped = run.at(0.375)
    return {
        "x_C_end_mm": 1e3 * run["x_C"][-1].item(),
        "y_C_grasp_mm": 1e3 * run["y_C"][grasped].item(),
        "theta_end_rad": run["theta"][-1].item(),
        "F_y_grasp_N": -run["F_y"][grasped].item(),
        "F_x_peak_N": run["F_x"].abs().max().item(),
        "locked_friction": (friction[grasped].abs().sum() / normal[grasped].sum()).item(),
        "slip_loss_mJ": 1e3 * run.dissipated["slip"][-1].item(),
        "energy_residual_rel": run.energy_residual_rel,
        "newton_per_step": run.stats.newton_per_step,
        "failed_steps": run.stats.failed_steps,
        "wall_s": run.stats.wall_s,
    }


def run(config: Config) -> Result:
    if config.smoke:
        config = Config(
            out=config.out, elements_x=(60, 120), etas=(10.0, 0.0), roll=0.6, smoke=True
        )

    def merit(changes: dict[str, Any]) -> dict[str, float]:
        return figures_of_merit(manipulate(changes, config.roll))

    meshes = {
        f"{n} x {n // 30}": merit({"pad.elements_x": n, "pad.elements_y": n // 30})
        for n in tqdm(config.elements_x, "meshes")
    }
    etas = {f"{eta:g}": merit({"contact.eta": eta}) for eta in tqdm(config.etas, "etas")}
    return Result(config, meshes, etas)


def main() -> None:
    result = run(options(Config, __doc__))
    parts = {"meshes": result.meshes, "etas": result.etas}
    titles = "mesh", "eta [N.s/m]"
    tables = "\n\n".join(numbers(title, rows, 5) for title, rows in zip(titles, parts.values()))
    write(result.config, parts, table=tables)


if __name__ == "__main__":
    main()
