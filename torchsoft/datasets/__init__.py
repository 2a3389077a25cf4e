"""Synthetic datasets: designed, simulated and written shard by shard, checked, and read for
training."""

from torchsoft.extras import needed

needed("zarr", "datasets")

from torchsoft.datasets.reader import Trajectories, open_dataset  # noqa: E402

__all__ = ["Trajectories", "open_dataset"]
