"""One task simulated: the arrays of one trajectory, or the reason why there are none."""

from typing import Any

import numpy as np
import torch

from torchsoft.channels import PADS
from torchsoft.datasets.config import RATIO, Config
from torchsoft.datasets.design import Task, excitation
from torchsoft.datasets.schema import KEPT, energies, not_finite, sizes, variables
from torchsoft.excitation import reference
from torchsoft.paper.equilibrium import holding_force, press, rest
from torchsoft.paper.rig import SoftGrasp
from torchsoft.scenario import find_grasp_force
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import simulate
from torchsoft.solve.trajectory import Trajectory

Row = dict[str, Any]

POSITION, NODAL_FORCE, FORCE = 10, 8, 4
"""Decimals that starting poses and displacements [m], nodal forces [N] and grasping forces [N] are rounded to: linear solvers
differ in the last bits with the alignment of memory, and a run may amplify that."""


def simulate_task(config: Config, task: Task) -> Row:
    """Every variable of the schema for one trajectory, without its first dimension.

    A simulation that fails leaves NaN (and no contact) in its series, and its reason.
    """
    out = empty_row(config) | labels(task)
    t = torch.arange(config.samples, dtype=torch.float64) * config.sample_interval
    try:
        model = SoftGrasp(task.parameters)
        y0 = start(model)
        if config.feed_forward == "found":
            force = find_grasp_force(model, y0, **config.steps)
        else:
            force = holding_force(model, press(model, task.parameters.scenario.y_Br_grasp))
        force = round(force, FORCE)
        y_Br = float(model.unpack(y0).pose["bracket"][1])
        motion = reference(excitation(config, task), model, y_Br, force)
        run = simulate(model, t, y0=y0, reference=motion, **config.steps)
    except SimulationFailed as failure:
        stats = failure.trajectory.stats if failure.trajectory is not None else None
        done = {"steps": stats.steps, "newton_iterations": stats.newton_iterations} if stats else {}
        return out | done | {"failed": 1, "reason": failure.reason, "failure_time": failure.time}
    except (np.linalg.LinAlgError, RuntimeError, ValueError) as failure:
        return out | {"failed": 1, "reason": f"{type(failure).__name__}: {failure}"}
    row = out | series(config, model, run) | {"grasp_force": force}
    if bad := not_finite(config, row):
        return out | {"failed": 1, "reason": f"not finite: {', '.join(bad)}"}
    return row


def start(model: SoftGrasp) -> torch.Tensor:
    """The state (size,) at rest, rounded."""
    y0 = rest(model).detach()
    for (part, name), where in model.layout.slices.items():
        forces = part == "pads" and not model.pads[name].inertial
        y0[where] = torch.round(y0[where], decimals=NODAL_FORCE if forces else POSITION) + 0.0  # no negative zeros
    return y0


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
def series(config: Config, model: SoftGrasp, run: Trajectory) -> Row:
    """The series and numbers of a finished run."""
    data = run.to_dataset()
    out = {name: data[name].values for name in KEPT}
    for kind, (_, parts) in energies(config).items():
        prefix = "energy" if kind == "stored" else kind
        out[f"{kind}_energy"] = np.stack([data[f"{prefix}_{part}"].values for part in parts], -1)
    for key, pad in PADS.items():
        for name in ("normal_force", "friction_force"):
            out[f"{name}_{pad}"] = data[f"{name}_{pad}"].values
        out[f"displacement_{pad}"] = (model.pads[key].spread @ run.displacement[key]).numpy()
        out[f"contact_{pad}"] = (model.penetration(key, run.state) > 0).numpy().astype(np.uint8)
    return out | {
        "injected_energy": run.injected.numpy(),
        "energy_residual": run.energy_residual.numpy(),
        "energy_residual_rel": run.energy_residual_rel,
        "steps": run.stats.steps,
        "newton_iterations": run.stats.newton_iterations,
    }
