"""One MCAP log for each trajectory."""

from pathlib import Path

from torchsoft.datasets.export import Source
from torchsoft.solve.formats import write_log


def write(source: Source, out: Path) -> str:
    """Write the channels of every trajectory to a log; its drawn parameters are the log's
    metadata."""
    labels = (*source.drawn, "split")
    for run in source.runs(source.sound.tolist(), (*source.channels, *labels)):
        about = {name: str(run[name].item()) for name in (*labels, "trajectory")}
        write_log(out / f"{run.trajectory.item():06d}.mcap", run[source.channels], about)
    return f"{len(source.sound)} logs of {len(source.channels)} channels"
