"""Trajectory number `index`: parameters and motion by the configuration alone, then the run, or why
there is none."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import qmc

from torchsoft.datasets.config import RATIO, SPLITS, Config, MultiSine
from torchsoft.datasets.schema import KEPT, PADS, energies, not_finite, variables
from torchsoft.excitation import Excitation, reference
from torchsoft.paper.equilibrium import holding_force, press, rest
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import SoftGrasp
from torchsoft.scenario import find_grasp_force
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import simulate
from torchsoft.solve.trajectory import Trajectory

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)

POSITION, NODAL_FORCE, FORCE = 10, 8, 4
"""Decimals that starting poses and displacements [m], nodal forces [N] and grasping forces [N] are
rounded to: linear solvers differ in the last bits with the alignment of memory, and a run may
amplify that."""

COUNTS = ("steps", "newton_iterations")

Row = dict[str, Any]


class Task(NamedTuple):
    """One trajectory: its parameters, its motion, and what is known of it before it is
    simulated."""

    index: int
    parameters: Parameters
    excitation: Excitation
    labels: Row


def points(config: Config) -> NDArray[np.floating]:
    """The design in the unit cube, shape (trajectories, dimensions).

    A Sobol sequence is a prefix of every longer one of the same seed; a Latin hypercube belongs to
    its size.
    """
    dimensions = len(config.parameters) + 2 + max(len(kind.ranges) for kind in config.kinds)
    rng = np.random.default_rng(config.seed)
    if config.method == "latin_hypercube":
        return qmc.LatinHypercube(dimensions, rng=rng).random(config.trajectories)
    power = int(np.ceil(np.log2(config.trajectories)))
    return qmc.Sobol(dimensions, scramble=True, rng=rng).random_base2(power)[: config.trajectories]


def task(config: Config, index: int, u: NDArray[np.floating]) -> Task:
    """Trajectory `index` at the point u (dimensions,) of the design."""
    n, rng = len(config.parameters), np.random.default_rng((config.seed, index))
    *own, common, which = u[: n + 2].tolist()
    sampled = {name: r.at(x) for (name, r), x in zip(config.parameters.items(), own)}
    edges = np.cumsum([kind.weight for kind in config.kinds])
    kind = config.kinds[
        min(int(np.searchsorted(edges, which * edges[-1], side="right")), len(edges) - 1)
    ]
    motion: Any = {name: r.at(x) for (name, r), x in zip(kind.ranges.items(), u[n + 2 :].tolist())}
    depth = motion.pop("depth", config.grasp_depth.at(common))  # a kind may have a range of its own
    side = float(rng.choice((-1.0, 1.0)))
    if "travel" in motion:
        motion["travel"] *= side
    if isinstance(kind, MultiSine):
        motion |= {
            "frequency": (kind.frequency.low, kind.frequency.high),
            "components": kind.components,
        }
        motion["seed"] = int(rng.integers(2**31))
    p = config.physics(sampled | kind.sets, depth)
    excitation = Excitation(
        motion=motion | {"kind": kind.motion or kind.kind}, duration=config.duration, depth=depth,
        senses=p.control.senses, grasp_time=p.scenario.grasp_time, settle=config.settle,
        x_C0=p.scenario.x_C0,
    )  # fmt: skip
    labels: Row = {name.replace("/", "_over_"): value for name, value in sampled.items()}
    if RATIO in sampled:
        labels["contact.mu_k"] = p.contact.mu_k
    labels |= {"grasp_depth": depth, "kind": kind.kind, "split": split(config, index)}
    return Task(index, p, excitation, labels)


def split(config: Config, index: int) -> str:
    """Train, validation or test: the golden-ratio sequence from a seeded start, so that small sets
    keep the fractions."""
    u = (np.random.default_rng((config.seed, 0)).random() + index * GOLDEN) % 1.0
    edges = (config.splits.train, config.splits.train + config.splits.validation)
    return SPLITS[int(np.searchsorted(edges, u, side="right"))]


def simulate_task(config: Config, task: Task) -> Row:
    """Every variable of the schema for one trajectory, without its first dimension.

    A simulation that fails has NaN (and no contact) for its series, and its reason.
    """
    out = (
        {name: variable.empty for name, variable in variables(config).items()}
        | task.labels
        | {"failed": 1}
    )
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
        motion = reference(task.excitation, model, y_Br, force)
        run = simulate(model, t, y0=y0, reference=motion, **config.steps)
    except SimulationFailed as failure:
        done = (
            {name: getattr(failure.trajectory.stats, name) for name in COUNTS}
            if failure.trajectory
            else {}
        )
        return out | done | {"reason": failure.reason, "failure_time": failure.time}
    except (np.linalg.LinAlgError, RuntimeError, ValueError) as failure:
        return out | {"reason": f"{type(failure).__name__}: {failure}"}
    row = out | series(config, model, run) | {"grasp_force": force, "failed": 0}
    bad = not_finite(config, row)
    return out | {"reason": f"not finite: {', '.join(bad)}"} if bad else row


def start(model: SoftGrasp) -> torch.Tensor:
    """The state (size,) at rest, rounded."""
    y0 = rest(model).detach()
    for (part, name), where in model.layout.slices.items():
        forces = part == "pads" and not model.pads[name].inertial
        y0[where] = (
            torch.round(y0[where], decimals=NODAL_FORCE if forces else POSITION) + 0.0
        )  # no negative zeros
    return y0


@torch.no_grad()
def series(config: Config, model: SoftGrasp, run: Trajectory) -> Row:
    """The series and numbers of a finished run."""
    out: Row = {name: run[name].numpy() for name in KEPT}
    out["injected_energy"], out["energy_residual"] = (
        run.injected.numpy(),
        run.energy_residual.numpy(),
    )
    out["energy_residual_rel"] = run.energy_residual_rel
    for kind, (_, parts) in energies(config).items():
        of = run.energy if kind == "stored" else getattr(run, kind)
        out[f"{kind}_energy"] = np.stack([of[part].numpy() for part in parts], -1)
    for pad in PADS:
        for i, kind in enumerate(("normal", "friction")):
            out[f"{kind}_force_{pad}"] = run.force[pad][..., i].numpy()
        out[f"displacement_{pad}"] = (model.pads[pad].spread @ run.displacement[pad]).numpy()
        out[f"contact_{pad}"] = (model.penetration(pad, run.state) > 0).numpy().astype(np.uint8)
    return out | {name: getattr(run.stats, name) for name in COUNTS}
