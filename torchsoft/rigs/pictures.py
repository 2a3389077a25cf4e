"""What a run of a rig file looks like: its figures and its video."""

from pathlib import Path

from tqdm import tqdm

from torchsoft.physics.rig import Rig
from torchsoft.plot import figures, general
from torchsoft.plot.animation import animate
from torchsoft.rigs.build import RigFile
from torchsoft.solve.trajectory import Trajectory
from torchsoft.tables import plain

SNAPSHOTS = 6
"""Pictures of the run where the file does not say when."""


def draw(file: RigFile, rig: Rig, run: Trajectory, out: Path, progress: bool) -> list[str]:
    """Write the figures and the video that a file asks for to `out`; the names of the files written."""
    end, written = float(run.t[-1]), []
    times = [t for t in file.outputs.snapshots if t <= end] or [i * end / (SNAPSHOTS - 1) for i in range(SNAPSHOTS)]
    title = plain(file.title) or "Bodies, pads and contact forces"
    made = {
        "snapshots": lambda: figures.snapshots(run, rig, times, title),
        "motion": lambda: general.motions(run, rig),
        "forces": lambda: general.efforts(run, rig),
        "energy": lambda: figures.energy_balance(run),
    }
    if file.outputs.figures:
        for name, figure in tqdm(made.items(), "figures", unit="figure", disable=not progress):
            figures.save(figure(), out / f"{name}.png")
            written.append(f"{name}.png")
    if file.outputs.video != "none":
        name = f"video.{file.outputs.video}"
        animate(
            run, rig, out / name, frames=file.outputs.frames, progress=progress, title=title, even=True,
            follow=file.outputs.follow or general.liveliest(run, rig),
        )  # fmt: skip
        written.append(name)
    return written
