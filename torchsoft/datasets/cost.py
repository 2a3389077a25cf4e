"""What a dataset will cost."""

import math

import numpy as np

from torchsoft.cost import RUN, Cost, row_memory, step_seconds, steps_per_second
from torchsoft.datasets.config import Config
from torchsoft.datasets.schema import sizes, variables
from torchsoft.scenario import SETTLE

FOUND = 6
"""Runs of the grasp that finding its force takes."""


def cost(config: Config, workers: int) -> Cost:
    """Of the whole dataset, made by that many workers."""
    p = config.physics({}, config.grasp_depth.low)
    seconds = config.duration
    if config.feed_forward == "found":
        seconds += FOUND * (p.scenario.grasp_time + SETTLE)
    if config.step is not None:
        steps = seconds / config.sample_interval * math.ceil(config.sample_interval / config.step)
    else:  # an output between two steps takes half the time of a step
        steps = seconds * steps_per_second(config.steps["rtol"]) + 0.5 * config.samples
    length = sizes(config)
    kept = 0.0  # of one trajectory [GiB]
    for variable in variables(config).values():
        size = 8 if variable.dtype == "str" else np.dtype(variable.dtype).itemsize
        kept += size * math.prod(length[dimension] for dimension in variable.dims[1:]) / 2**30
    shard = 2 * kept * min(config.trajectories_per_shard, config.trajectories) + config.samples * row_memory(p)
    design = 8 * 2 * config.trajectories * (len(config.parameters) + 8) / 2**30
    return Cost(
        steps=config.trajectories * steps,
        seconds=config.trajectories * (steps * step_seconds(p) + RUN) / max(min(workers, config.shards), 1),
        memory=design + shard * max(min(workers, config.shards), 1),
        disk=kept * config.trajectories,
    )
