"""The excitation of one task: the kind's quantities as drawn, as an `Excitation`."""

from typing import Any

import numpy as np

from torchsoft.datasets.config import Config, MultiSine
from torchsoft.datasets.design import Task
from torchsoft.excitation import Excitation

SIDED = ("travel",)
"""Quantities that a task takes to either side, by a draw of its own."""


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
