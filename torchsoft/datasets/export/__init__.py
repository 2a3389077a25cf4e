"""Export of datasets to the formats of other projects. The exported folder appears whole or not at
all."""

import importlib
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import mkdtemp
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from tqdm import tqdm

from torchsoft.datasets.config import Config
from torchsoft.datasets.files import Manifest, check_apart, store_errors
from torchsoft.datasets.reader import Vouched
from torchsoft.datasets.subject import SPLITS
from torchsoft.display import suggestion
from torchsoft.files import make_folder

WRITERS = {"the-well": "the_well", "lerobot": "lerobot", "mcap": "mcap"}


def export(url: str, to: str, out: Path) -> str:
    """Write the sound trajectories of a finished dataset to a new folder; returns a summary
    sentence. Raises `StoreError` for a dataset that is damaged or unfinished, and `ValueError` for
    one that the format cannot hold, and for a folder that is not empty."""
    if to not in WRITERS:
        raise ValueError(f"--to: `{to}` is no form; {suggestion(to, WRITERS)}")
    data, config = Vouched(url).data(chunks=None), Config.model_validate(Manifest.read(url).config)
    sound = np.flatnonzero(data.failed.values == 0)
    if not len(sound):
        raise ValueError(f"{url}: every trajectory failed; there is nothing to be exported")
    check_apart(url, "--out", out)
    if out.is_dir() and any(out.iterdir()):
        raise ValueError(f"--out: {out} is not empty; name a new folder")
    write = importlib.import_module(f"torchsoft.datasets.export.{WRITERS[to]}").write
    with store_errors(str(out)):
        make_folder(out.absolute().parent)
        partial = Path(mkdtemp(prefix=f"{out.name}.", suffix=".partial", dir=out.absolute().parent))
        try:
            content = write(Source(config, data, sound), partial)
            partial.chmod(0o755)
            partial.replace(out)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    failed = data.sizes["trajectory"] - len(sound)
    return f"{content}; {failed} failed trajectories are left out; written to {out}"


# The sound trajectories of a dataset, as exporters read them.


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
