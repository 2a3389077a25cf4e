"""Synthetic rolling datasets: designed, simulated, written shard by shard, checked, and read for
training."""

from torchsoft.datasets.reader import Trajectories, open_dataset

__all__ = ["Trajectories", "open_dataset"]
