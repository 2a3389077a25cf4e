"""Videos: bodies, deformed pads and contact forces over the whole run, of any rig; the paper's
among them."""

import importlib.util
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from torchsoft.files import replacing
from torchsoft.physics.mesh import Array
from torchsoft.physics.rig import Rig
from torchsoft.plot.figures import ACTUAL, DESIRED, STYLE, timeline
from torchsoft.plot.general import curves
from torchsoft.plot.scene import (
    DISC,
    FRICTION,
    INK,
    LAYER,
    NORMAL,
    PAD,
    STEEL,
    Scene,
    force_scale,
    instants,
    outwards,
)
from torchsoft.solve.trajectory import Trajectory

FRAMES_PER_SECOND = 12

PAPER = "Bodies, pads and contact forces (paper: the video); the first half second in slow motion"
"""Title of the paper's video."""

Picture = NDArray[np.uint8]


def frame_times(trajectory: Trajectory, frames: int, even: bool = False) -> Array:
    """Times [s] of the frames; unless they are to be `even`, one in eight goes to the first half
    second, where the grasp is."""
    start, end = float(trajectory.t[0]), float(trajectory.t[-1])
    if even:
        return np.linspace(start, end, frames)
    slow = min(start + 0.5, end)
    grasp = frames if slow == end else max(2, frames // 8)
    return np.concatenate(
        (np.linspace(start, slow, grasp), np.linspace(slow, end, frames - grasp + 1)[1:])
    )


def render(
    trajectory: Trajectory, rig: Rig, times: Array, dpi: int, title: str, follow: str
) -> Iterator[Picture]:
    """RGB pictures (height, width, 3) at `times` [s]: the scene, and a coordinate over time under
    it. The axes are drawn once; per picture only what moves."""
    shown = instants(rig, trajectory, times.tolist())
    curve = next(curve for curve in curves(trajectory, rig) if curve.name == follow)
    scale = force_scale(rig, shown)
    x_limits, y_limits = Scene(Figure().subplots(), rig, curves=scale).limits(shown)
    tall = (y_limits[1] - y_limits[0]) / (x_limits[1] - x_limits[0])
    with rc_context(STYLE):
        figure = Figure(
            figsize=(8.0, min(max(5.8, 7.0 * tall + 2.2), 8.6)), dpi=dpi, layout="constrained"
        )
        canvas = FigureCanvasAgg(figure)
        whole, strip = figure.subplots(2, 1, height_ratios=(figure.get_figheight() - 1.26, 1.26))
        scene = Scene(whole, rig, columns=5, curves=scale)
        whole.set(xlim=x_limits, ylim=y_limits, xlabel="x [mm]", ylabel="y [mm]", title=title)
        scene.scale_bar(whole)
        whole.grid(False)
        whole.plot([], [], "o-", color=NORMAL, ms=3, label="normal force")
        whole.plot([], [], color=FRICTION, label=f"friction ({outwards(rig, shown[0])})")
        whole.legend(loc="lower left")
        t = timeline(strip, curve.label, trajectory)
        if curve.setpoint is not None:
            strip.plot(t, curve.setpoint, color=DESIRED, lw=3, label="desired")
        strip.plot(t, curve.values, color=ACTUAL, lw=1, label="actual")
        if curve.setpoint is not None:
            strip.legend(loc="lower right", ncols=2)
        (cursor,) = strip.plot([], [], "o", color=INK, ms=6)
        clock = whole.text(
            0.012, 0.97, "", transform=whole.transAxes, va="top", family="monospace", fontsize=12
        )
        clock.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 2})
    moving: list[Artist] = [*scene.moving, clock, cursor]
    for artist in moving:
        artist.set_animated(True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for instant in shown:
        scene.show(instant)
        cursor.set_data([instant.time], [curve.values[trajectory.at(instant.time)]])
        clock.set_text(f"t = {instant.time:6.3f} s")
        canvas.restore_region(background)
        for artist in moving:
            assert artist.axes is not None
            artist.axes.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def animate(
    trajectory: Trajectory, rig: Rig, path: Path, *, frames: int = 150, dpi: int = 110,
    progress: bool = True, title: str = PAPER, follow: str = "", even: bool = False,
) -> None:  # fmt: skip
    """Write `frames` pictures of the whole run as .gif, or as .mp4 where imageio-ffmpeg is
    installed.

    `follow` is the coordinate under the picture, by default x of the first body; with `even` all
    pictures are equally far apart in time. The file appears whole or not at all. Raises
    `ValueError` for another suffix, and `ModuleNotFoundError` for .mp4 without imageio-ffmpeg.
    """
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"`path` must end in .gif or .mp4, but is {path}")
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ModuleNotFoundError(
            f"{path} needs imageio-ffmpeg: pip install 'torchsoft[video]', or write a .gif"
        )
    times = frame_times(trajectory, frames, even)
    followed = follow or f"{next(iter(rig.bodies))}.x"
    bar = tqdm(
        render(trajectory, rig, times, dpi, title, followed),
        "animation",
        len(times),
        unit="frame",
        disable=not progress,
    )
    with replacing(path) as partial:
        (write_gif if path.suffix == ".gif" else write_mp4)(bar, partial)


def write_gif(pictures: Iterable[Picture], path: Path) -> None:
    """All pictures on the first one's palette, which keeps still areas identical and so the file
    small."""
    images = [Image.fromarray(picture) for picture in pictures]
    middle = images[len(images) // 2].copy()
    for i, colour in enumerate(
        (NORMAL, FRICTION, PAD, LAYER, DISC, STEEL, ACTUAL)
    ):  # few pixels have some of them
        middle.paste(colour, (0, 12 * i, middle.width, 12 * (i + 1)))
    palette = middle.quantize(96)
    reduced = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    pause = round(1000 / FRAMES_PER_SECOND)
    reduced[0].save(path, "GIF", save_all=True, append_images=reduced[1:], duration=pause, loop=0)


def write_mp4(pictures: Iterable[Picture], path: Path) -> None:
    """H.264 through the ffmpeg that imageio-ffmpeg brings along."""
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports] -- an optional dependency

    writer = None
    for picture in pictures:
        even = np.ascontiguousarray(
            picture[: len(picture) // 2 * 2, : picture.shape[1] // 2 * 2]
        )  # H.264 asks for it
        if writer is None:
            size = (even.shape[1], even.shape[0])
            writer = imageio_ffmpeg.write_frames(
                str(path),
                size,
                fps=FRAMES_PER_SECOND,
                macro_block_size=2,
                output_params=["-f", "mp4"],
            )
            writer.send(None)
        writer.send(even)
    if writer is not None:
        writer.close()
