"""MCAP logs of the trajectories of a dataset."""

import shutil
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from tqdm import tqdm

from torchsoft.datasets.config import Config
from torchsoft.datasets.files import Manifest, check_apart, store_errors
from torchsoft.datasets.reader import Vouched
from torchsoft.files import make_folder
from torchsoft.solve.mcap import write_log


def export_logs(url: str, out: Path) -> str:
    """Write the channels of every trajectory that did not fail to a log of its own, with its drawn
    parameters as metadata; returns a summary. The new folder `out` appears whole or not at all.

    Raises `StoreError` for a dataset that is damaged or unfinished, and `ValueError` for one
    without a sound trajectory, and for a folder that is not empty.
    """
    data = Vouched(url).data(chunks=None)
    subject = Config.model_validate(Manifest.read(url).config).subject
    sound = np.flatnonzero(data.failed.values == 0)
    if not len(sound):
        raise ValueError(f"{url}: every trajectory failed; there is nothing to export")
    check_apart(url, "--out", out)
    if out.is_dir() and any(out.iterdir()):
        raise ValueError(f"--out: {out} is not empty; name a new folder")
    channels, labels = list(subject.channels), [*subject.config.parameters, "split"]
    kept, parent = data[[*channels, *labels]], out.absolute().parent
    with store_errors(str(out)):
        make_folder(parent)
        partial = Path(mkdtemp(prefix=f"{out.name}.", suffix=".partial", dir=parent))
        try:
            for index in tqdm(sound, unit=" trajectories", leave=False, disable=None):
                run = kept.isel(trajectory=index).load()
                about = {name: str(run[name].item()) for name in (*labels, "trajectory")}
                write_log(partial / f"{index:06d}.mcap", run[channels], about)
            partial.chmod(0o755)
            partial.replace(out)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    failed = data.sizes["trajectory"] - len(sound)
    return (
        f"{len(sound)} logs of {len(channels)} channels; {failed} failed trajectories are left "
        f"out; written to {out}"
    )
