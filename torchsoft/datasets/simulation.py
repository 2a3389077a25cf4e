"""One task simulated: the arrays of one trajectory, or the reason why there are none."""

from typing import Any

import numpy as np
import torch

from torchsoft.datasets.config import RATIO, Config
from torchsoft.datasets.design import Task, excitation
from torchsoft.datasets.schema import KEPT, STORES, sizes, variables
from torchsoft.equilibrium import holding_force, press, rest
from torchsoft.excitation import reference
from torchsoft.implicit import SimulationFailed
from torchsoft.kernels.run import DISSIPATED, SUPPLIED
from torchsoft.model import SoftGrasp
from torchsoft.scenario import find_grasp_force
from torchsoft.simulate import simulate
from torchsoft.trajectory import Trajectory

Row = dict[str, Any]

POSITION, FORCE = 10, 4
"""Decimals that starting displacements [m] and grasping forces [N] are rounded to: linear solvers differ in the last bits
with the alignment of memory, and a run may amplify that."""


def simulate_task(config: Config, task: Task) -> Row:
    """Every variable of the schema for one trajectory, without its first dimension.

    A simulation that fails leaves NaN (and no contact) in its series, and its reason.
    """
    out = empty_row(config) | labels(task)
    t = torch.arange(config.samples, dtype=torch.float64) * config.sample_interval
    try:
        model = SoftGrasp(task.parameters)
        y0 = torch.round(rest(model).detach(), decimals=POSITION) + 0.0  # no negative zeros
        if config.feed_forward == "found":
            force = find_grasp_force(model, y0, config.step)
        else:
            force = holding_force(model, press(model, task.parameters.scenario.y_Br_grasp))
        force = round(force, FORCE)
        y_Br = float(model.layout.unpack(y0).r_Br[1])
        model.reference = reference(excitation(config, task), model, y_Br, force)
        run = simulate(model, t, y0=y0, step=config.step)
    except SimulationFailed as failure:
        stats = failure.trajectory.stats if failure.trajectory is not None else None
        done = {"steps": stats.steps, "newton_iterations": stats.newton_iterations} if stats else {}
        return out | done | {"failed": 1, "reason": failure.reason, "failure_time": failure.time}
    except (np.linalg.LinAlgError, RuntimeError, ValueError) as failure:
        return out | {"failed": 1, "reason": f"{type(failure).__name__}: {failure}"}
    return out | series(model, run) | {"grasp_force": force}


def empty_row(config: Config) -> Row:
    """A trajectory of nothing: NaN, and zero where there is no NaN."""
    length, out = sizes(config), {}
    for name, variable in variables(config).items():
        shape = tuple(length[dim] for dim in variable.dims[1:])
        if variable.dtype == "str":
            out[name] = ""
        else:
            out[name] = np.full(shape, np.nan if variable.dtype.startswith("float") else 0, variable.dtype)
    return out


def labels(task: Task) -> Row:
    """What is known before the simulation."""
    sampled = {name.replace("/", "_over_"): value for name, value in task.sampled.items()}
    if RATIO in task.sampled:
        sampled["contact.mu_k"] = task.parameters.contact.mu_k
    return sampled | {"grasp_depth": task.grasp_depth, "kind": task.kind.kind, "split": task.split}


@torch.no_grad()
def series(model: SoftGrasp, run: Trajectory) -> Row:
    """The series and numbers of a finished run."""
    s, data = run.state, run.to_dataset()
    out: Row = {
        "desired_y_velocity": run.desired[:, 3],
        "injected_energy": run.injected,
        "energy_residual": run.energy_residual,
        "stored_energy": torch.stack([run.energy[name] for name in STORES], -1),
        "dissipated_energy": torch.stack([run.dissipated[name] for name in DISSIPATED], -1),
        "supplied_energy": torch.stack([run.supplied[name] for name in SUPPLIED], -1),
    }
    for k, pad in (("L", "lower"), ("U", "upper")):
        force, u = getattr(run, f"force_{k}"), getattr(s, f"u_{k}")
        out[f"normal_force_{pad}"], out[f"friction_force_{pad}"] = force.unbind(-1)
        out[f"displacement_{pad}"] = u[:, model.pads[k].surface]
        out[f"contact_{pad}"] = (model.frame(k, s).g > 0).to(torch.uint8)
    channels = {name: data[name].values for name in KEPT if name in data}
    stats = {"steps": run.stats.steps, "newton_iterations": run.stats.newton_iterations}
    arrays = {name: value.numpy() for name, value in out.items()}
    return {**channels, **arrays, **stats, "energy_residual_rel": run.energy_residual_rel}
