"""One trajectory: its parameters and motion from the configuration and its index alone, and its run
or the reason of its failure."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import qmc

from torchsoft.datasets.config import Config
from torchsoft.datasets.schema import energies, not_finite, variables
from torchsoft.datasets.subject import Row, Subject, Task
from torchsoft.physics.rig import Rig
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import simulate
from torchsoft.solve.trajectory import Trajectory

COUNTS = ("steps", "newton_iterations")


def points(config: Config) -> NDArray[np.floating]:
    """The design in the unit cube, shape (trajectories, dimensions).

    A Sobol sequence is a prefix of every longer one of the same seed; a Latin hypercube belongs to
    its size.
    """
    dimensions, rng = config.subject.drawn, np.random.default_rng(config.seed)
    if config.method == "latin_hypercube":
        return qmc.LatinHypercube(dimensions, rng=rng).random(config.trajectories)
    power = int(np.ceil(np.log2(config.trajectories)))
    return qmc.Sobol(dimensions, scramble=True, rng=rng).random_base2(power)[: config.trajectories]


def simulate_task(config: Config, task: Task) -> Row:
    """Every variable of the schema for one trajectory, without its first dimension.

    A simulation that fails has NaN (and no contact) for its series, and its reason.
    """
    subject = config.subject
    out = (
        {name: variable.empty for name, variable in variables(config).items()}
        | task.labels
        | {"failed": 1}
    )
    t = torch.arange(config.samples, dtype=torch.float64) * config.sample_interval
    try:
        rig, y0 = subject.begin(task)
        run = simulate(rig, t, y0=y0, **subject.steps)
    except SimulationFailed as failure:
        done = (
            {name: getattr(failure.trajectory.stats, name) for name in COUNTS}
            if failure.trajectory
            else {}
        )
        return out | done | {"reason": failure.reason, "failure_time": failure.time}
    except (np.linalg.LinAlgError, RuntimeError, ValueError) as failure:
        return out | {"reason": f"{type(failure).__name__}: {failure}"}
    row = out | series(subject, rig, run) | {"failed": 0}
    bad = not_finite(config, row)
    return out | {"reason": f"not finite: {', '.join(bad)}"} if bad else row


@torch.no_grad()
def series(subject: Subject, rig: Rig, run: Trajectory) -> Row:
    """The series and numbers of a finished run."""
    out: Row = {name: run[name].numpy() for name in subject.signals}
    for pad, touching in subject.surfaces.items() if subject.config.nodal else ():
        for name in touching:
            out[f"normal_force_{name}"] = run.force[name][..., 0].numpy()
            out[f"friction_force_{name}"] = run.force[name][..., 1].numpy()
            depth = rig.penetration(name, run.state)
            out[f"contact_{name}"] = (depth > 0).numpy().astype(np.uint8)
        out[f"displacement_{pad}"] = (rig.pads[pad].spread @ run.displacement[pad]).numpy()
    for kind, (_, parts) in energies(subject).items():
        known = run.energy if kind == "stored" else getattr(run, kind)
        out[f"{kind}_energy"] = np.stack([known[part].numpy() for part in parts], -1)
    out["injected_energy"], out["energy_residual"] = (
        run.injected.numpy(),
        run.energy_residual.numpy(),
    )
    out["energy_residual_rel"] = run.energy_residual_rel
    return out | {name: getattr(run.stats, name) for name in COUNTS}
