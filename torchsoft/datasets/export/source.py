"""The sound trajectories of a dataset, as exporters read them."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from tqdm import tqdm

from torchsoft.datasets.config import Config
from torchsoft.datasets.subject import SPLITS


class Source(NamedTuple):
    """A dataset, and the indices of its `sound` trajectories."""

    config: Config
    data: xr.Dataset
    sound: NDArray[np.integer]

    @property
    def splits(self) -> dict[str, list[int]]:
        """Indices of the sound trajectories of every split that has any."""
        split = self.data.split.values[self.sound]
        found = {name: self.sound[split == name].tolist() for name in SPLITS}
        return {name: some for name, some in found.items() if some}

    @property
    def channels(self) -> list[str]:
        """Series of the rig: coordinates, efforts, motions."""
        return list(self.config.subject.signals)

    @property
    def motions(self) -> list[str]:
        """Channels that are set-points of the rig, or their rates."""
        of = self.config.subject.template.signals
        return [name for name in self.channels if name.removesuffix("_dot") in of]

    @property
    def drawn(self) -> list[str]:
        """Names of the drawn parameters."""
        return list(self.config.subject.labels)

    def runs(self, rows: Sequence[int], names: Iterable[str]) -> Iterator[xr.Dataset]:
        """The arrays `names` of each trajectory in `rows`, one trajectory after the other, in
        memory."""
        some = self.data[[*names]]
        for index in tqdm(rows, unit=" trajectories", leave=False, disable=None):
            yield some.isel(trajectory=index).load()
