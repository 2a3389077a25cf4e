"""The design: parameters and motion of trajectory number `index`, given the configuration alone."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from torchsoft.datasets.config import Config, Kind, MultiSine, ranges
from torchsoft.excitation import Excitation
from torchsoft.paper.parameters import Parameters

SPLITS = ("train", "validation", "test")

SIDED = ("travel",)
"""Quantities that a task takes to either side, by a draw of its own."""

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True)
class Task:
    """One trajectory: its parameters, the kind of its motion with the kind's quantities, and a seed of its own."""

    index: int
    parameters: Parameters
    sampled: dict[str, float]
    grasp_depth: float
    kind: Kind
    excitation: dict[str, float]
    seed: tuple[int, int]
    split: str


def points(config: Config) -> NDArray[np.floating]:
    """The design in the unit cube, shape (trajectories, dimensions).

    A Sobol sequence is a prefix of every longer one of the same seed; a Latin hypercube belongs to its size.
    """
    dimensions = len(config.parameters) + 2 + max(len(ranges(kind)) for kind in config.kinds)
    rng = np.random.default_rng(config.seed)
    if config.method == "latin_hypercube":
        return qmc.LatinHypercube(dimensions, rng=rng).random(config.trajectories)
    power = int(np.ceil(np.log2(config.trajectories)))
    return qmc.Sobol(dimensions, scramble=True, rng=rng).random_base2(power)[: config.trajectories]


def task(config: Config, index: int, u: NDArray[np.floating]) -> Task:
    """Trajectory `index` at the point u (dimensions,) of the design."""
    n = len(config.parameters)
    sampled = {name: r.at(float(x)) for (name, r), x in zip(config.parameters.items(), u)}
    depth = config.grasp_depth.at(float(u[n]))
    kind = choose_kind(config.kinds, float(u[n + 1]))
    excitation = {name: r.at(float(x)) for (name, r), x in zip(ranges(kind).items(), u[n + 2 :])}
    depth = excitation.pop("depth", depth)  # a kind may have a range of its own
    p = config.physics(sampled | kind.sets, depth)
    return Task(index, p, sampled, depth, kind, excitation, (config.seed, index), split(config, index))


def choose_kind(kinds: tuple[Kind, ...], u: float) -> Kind:
    """The kind at u in [0, 1), each in proportion to its weight."""
    edges = np.cumsum([kind.weight for kind in kinds])
    return kinds[min(int(np.searchsorted(edges, u * edges[-1], side="right")), len(kinds) - 1)]


def split(config: Config, index: int) -> str:
    """Train, validation or test: the golden-ratio sequence from a seeded start, so that small sets keep the fractions."""
    start = np.random.default_rng((config.seed, 0)).random()
    u = (start + index * GOLDEN) % 1.0
    edges = (config.splits.train, config.splits.train + config.splits.validation)
    return SPLITS[int(np.searchsorted(edges, u, side="right"))]


def excitation(config: Config, task: Task) -> Excitation:
    """The motion that the controllers of this task follow."""
    p, rng = task.parameters, np.random.default_rng(task.seed)
    side = float(rng.choice((-1.0, 1.0)))
    motion: Any = {name: (side if name in SIDED else 1.0) * value for name, value in task.excitation.items()}
    motion["kind"] = task.kind.motion or task.kind.kind
    if isinstance(task.kind, MultiSine):
        band = task.kind.frequency
        motion |= {"frequency": (band.low, band.high), "components": task.kind.components}
        motion["seed"] = int(rng.integers(2**31))
    return Excitation(
        motion=motion, duration=config.duration, depth=task.grasp_depth, senses=p.control.senses,
        grasp_time=p.scenario.grasp_time, settle=config.settle, x_C0=p.scenario.x_C0,
    )  # fmt: skip
