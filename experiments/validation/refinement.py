"""Question: how much of the paper's manipulation is the step, the mesh and the slip element's viscosity?

The whole 30 s are run at several steps against a fine one; the first 10 s (grasp and roll out) on several meshes and
with several viscosities eta, down to Coulomb's limit eta = 0. The per-node contact values refer to 1 mm of surface and
scale with a node's tributary length, so that all meshes have the same contact.

Command: .venv/bin/python experiments/validation/refinement.py [--smoke]
Expected: at the default step of 2 ms the largest error is below 3e-4 of the range in the motion (in y_C, during the grasp)
and below 0.5 % in the forces; x_C(10 s) does not depend on the mesh, y_C in the grasp changes by less than 0.03 mm, and
the peak of F_x, which rides on node transitions, falls with the mesh. About one minute on one core.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from tqdm import tqdm

from torchsoft import Parameters, SoftGrasp, Trajectory, simulate
from torchsoft.experiment import grid, numbers, options, write
from torchsoft.scenario import grasp_and_roll

SIGNALS = ("x_C", "y_C", "theta", "F_x", "F_y")


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/refinement")
    steps_ms: tuple[float, ...] = (5.0, 2.0, 1.0, 0.5)  # steps compared [ms]
    reference_ms: float = 0.2  # step of the run they are compared with [ms]
    elements_x: tuple[int, ...] = (60, 120, 240, 480)  # elements along the pad; a thirtieth of that through it
    etas: tuple[float, ...] = (100.0, 10.0, 1.0, 0.1, 0.0)  # viscosities of the slip element [N.s/m]
    duration: float = 30.0  # of the runs that the steps are compared over [s]
    roll: float = 10.0  # of the runs on other meshes and with other viscosities [s]
    smoke: bool = False  # a size that takes seconds


@dataclass(frozen=True)
class Result:
    config: Config
    steps: dict[str, dict[str, float]]
    meshes: dict[str, dict[str, float]]
    etas: dict[str, dict[str, float]]


def manipulate(changes: dict[str, Any], step: float, duration: float, grasp_force: float | None = None) -> Trajectory:
    """The paper's manipulation with some parameters changed, its first `duration` seconds on a 10 ms grid."""
    model = SoftGrasp(Parameters().override(changes))
    manipulation = grasp_and_roll(model, grasp_force=grasp_force)
    return simulate(model, grid(duration), y0=manipulation.y0, step=step)


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
        config = Config(out=config.out, steps_ms=(4.0, 2.0), reference_ms=0.5, elements_x=(60, 120), etas=(10.0, 0.0),
                        duration=0.6, roll=0.6, smoke=True)  # fmt: skip
    force = grasp_and_roll(SoftGrasp()).grasp_force
    fine, steps = manipulate({}, 1e-3 * config.reference_ms, config.duration, force), {}
    for step in tqdm(config.steps_ms, "steps"):
        coarse = manipulate({}, 1e-3 * step, config.duration, force)
        exact = {name: fine[name] for name in SIGNALS}
        error = {name: ((coarse[name] - x).abs().max() / (x.max() - x.min())).item() for name, x in exact.items()}
        steps[f"{step} ms"] = error | {k: v for k, v in figures_of_merit(coarse).items() if k[:2] in ("en", "ne", "wa")}

    def merit(changes: dict[str, Any]) -> dict[str, float]:
        return figures_of_merit(manipulate(changes, 2e-3, config.roll))

    meshes = {
        f"{n} x {n // 30}": merit({"pad.elements_x": n, "pad.elements_y": n // 30})
        for n in tqdm(config.elements_x, "meshes")
    }
    etas = {f"{eta:g}": merit({"contact.eta": eta}) for eta in tqdm(config.etas, "etas")}
    return Result(config, steps, meshes, etas)


def figure(result: Result) -> Figure:
    """Largest errors against the step."""
    fig = Figure(figsize=(6, 4), layout="constrained")
    axes = fig.subplots()
    h = [float(key.split()[0]) for key in result.steps]
    for name in SIGNALS:
        axes.loglog(h, [row[name] for row in result.steps.values()], "o-", label=name)
    axes.set(xlabel="step [ms]", ylabel="largest error over range [1]", title="Step refinement of the manipulation")
    axes.legend()
    return fig


def main() -> None:
    result = run(options(Config, __doc__))
    parts = {"steps": result.steps, "meshes": result.meshes, "etas": result.etas}
    titles = "step", "mesh", "eta [N.s/m]"
    tables = "\n\n".join(numbers(title, rows, 5) for title, rows in zip(titles, parts.values()))
    write(result.config, parts, {"refinement": figure(result)}, tables)


if __name__ == "__main__":
    main()
