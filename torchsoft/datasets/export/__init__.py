"""Export of datasets to the formats of other projects. The exported folder appears whole or not at
all."""

import importlib
import shutil
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from torchsoft.datasets.config import Config
from torchsoft.datasets.export.source import Source
from torchsoft.datasets.files import Manifest, store_errors
from torchsoft.datasets.reader import Vouched
from torchsoft.files import make_folder

WRITERS = {"the-well": "the_well", "lerobot": "lerobot", "mcap": "mcap"}


def export(url: str, to: str, out: Path) -> str:
    """Write the sound trajectories of a finished dataset to a new folder; returns a summary
    sentence. Raises `StoreError` for a dataset that is damaged or unfinished, and `ValueError` for
    one that the format cannot hold, and for a folder that is not empty."""
    data, config = Vouched(url).data(chunks=None), Config.model_validate(Manifest.read(url).config)
    sound = np.flatnonzero(data.failed.values == 0)
    if not len(sound):
        raise ValueError(f"{url}: every trajectory failed; there is nothing to be exported")
    if out.is_dir() and any(out.iterdir()):
        raise ValueError(f"--out: {out} is not empty; name a new folder")
    write = importlib.import_module(f"torchsoft.datasets.export.{WRITERS[to]}").write
    with store_errors(str(out)):
        make_folder(out.absolute().parent)
        partial = Path(mkdtemp(prefix=f"{out.name}.", suffix=".partial", dir=out.absolute().parent))
        try:
            said = write(Source(config, data, sound), partial)
            partial.chmod(0o755)
            partial.replace(out)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    failed = data.sizes["trajectory"] - len(sound)
    return f"{said}; {failed} failed trajectories are left out; written to {out}"
