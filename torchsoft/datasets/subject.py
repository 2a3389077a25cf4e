"""The subject of a dataset: the rig, the numbers that are drawn, and the run of one trajectory."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.datasets.schema import Label, Variable, arrays
from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig

if TYPE_CHECKING:
    from torchsoft.datasets.config import Config

RTOL = 1e-4
"""Relative tolerance of the stepper where neither it nor a step is given: data are not
differentiated."""

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)

SPLITS = ("train", "validation", "test")

POSITION, NODAL_FORCE = 10, 8
"""Decimals that starting poses and displacements [m] and nodal forces [N] are rounded to: linear
solvers differ in the last bits with the alignment of memory, and a run may amplify that."""

Row = dict[str, Any]


class Task(NamedTuple):
    """One trajectory: its number, what its run needs, and what is known before it is simulated."""

    index: int
    given: Any
    labels: Row


class Begun(NamedTuple):
    """A rig about to run: its state y0 (size,) at the start, the reference that it follows, and
    what is known of the trajectory besides."""

    rig: Rig
    y0: Tensor
    reference: Reference
    labels: Row


class Subject(ABC):
    """What a configuration makes trajectories of.

    `template` has the parts and meshes of every trajectory's rig, `signals` are the channels that
    are kept, `words` texts of every trajectory; `prelude` is the time [s] that is simulated before
    a trajectory can begin.
    """

    signals: Mapping[str, Label]
    template: Rig
    words: Mapping[str, Label] = {}
    prelude: float = 0.0

    def __init__(self, config: "Config") -> None:
        self.config = config

    @abstractmethod
    def check(self) -> None:
        """Raises `ValueError` with the field's name for a configuration that cannot be carried
        out."""

    @property
    @abstractmethod
    def labels(self) -> dict[str, Label]:
        """Numbers of every trajectory, besides those of any run."""

    @property
    def ranges(self) -> dict[str, Any]:
        """Distributions of the numbers that are drawn for every trajectory, by their arrays."""
        return {name.replace("/", "_over_"): r for name, r in self.config.parameters.items()}

    @property
    @abstractmethod
    def constants(self) -> dict[str, Any]:
        """Numbers and words that all trajectories share, by name."""

    @property
    @abstractmethod
    def drawn(self) -> int:
        """Dimensions of the design."""

    @abstractmethod
    def task(self, index: int, u: list[float]) -> Task:
        """Trajectory `index` at the point u of the design."""

    @abstractmethod
    def begin(self, task: Task) -> Begun:
        """The rig of a trajectory, ready to run. Raises what its statics do."""

    @property
    @abstractmethod
    def steps(self) -> dict[str, Any]:
        """How `simulate` is to choose its steps."""

    @property
    def surfaces(self) -> dict[str, str]:
        """Pads that something may touch, and their names in the dataset."""
        touched = {contact.pad for contact in self.template.contacts.values()}
        return {name: name for name in self.template.pads if name in touched}

    def touching(self, pad: str) -> dict[str, str]:
        """Contacts of a pad, and their names in the dataset."""
        rig = self.template
        return {name: name for name, one in rig.contacts.items() if one.pad == pad}

    @cached_property
    def variables(self) -> dict[str, Variable]:
        """Every array of the dataset by its name."""
        return arrays(self)

    @abstractmethod
    def columns(self) -> dict[str, tuple[tuple[str, ...], NDArray[np.float64], str, str]]:
        """Places of the contact points, and what else belongs to the rig of all trajectories:
        dimensions, values, unit and meaning."""


def stated_steps(config: "Config") -> dict[str, Any]:
    """How `simulate` is to choose its steps, as far as the configuration says it."""
    given = {"step": config.step, "rtol": config.rtol}
    return {name: value for name, value in given.items() if value is not None}


def split(config: "Config", index: int) -> str:
    """Train, validation or test: the golden-ratio sequence from a seeded start, so that small sets
    keep the fractions."""
    u = (np.random.default_rng((config.seed, 0)).random() + index * GOLDEN) % 1.0
    edges = (config.splits.train, config.splits.train + config.splits.validation)
    return SPLITS[int(np.searchsorted(edges, u, side="right"))]


def rounded(rig: Rig, y0: Tensor) -> Tensor:
    """The state (size,) at the start, rounded."""
    y0 = y0.detach().clone()
    for (part, name), where in rig.layout.slices.items():
        forces = part == "pads" and not rig.pads[name].inertial
        y0[where] = (
            torch.round(y0[where], decimals=NODAL_FORCE if forces else POSITION) + 0.0
        )  # no negative zeros
    return y0
