"""Videos: bodies, deformed pads with their stress and contact forces over a whole run."""

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

from torchsoft.display import suggestion
from torchsoft.files import replacing
from torchsoft.physics.mesh import Array
from torchsoft.plot.dashboard import curves, liveliest, motion
from torchsoft.plot.figures import ACTUAL, SIZES, STYLE, stress_bar
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
    keys,
    largest_stress,
)
from torchsoft.solve.trajectory import Trajectory

FRAMES_PER_SECOND = 12.5
"""Frame rate; the delay of a GIF's frame is a multiple of 10 ms."""

Picture = NDArray[np.uint8]


def frame_times(run: Trajectory, frames: int, slow: float) -> Array:
    """Times [s] of the frames; one in eight goes to the first `slow` [s], unless that is zero."""
    start, end = float(run.t[0]), float(run.t[-1])
    if not 0 < slow < end - start:
        return np.linspace(start, end, frames)
    first = max(2, frames // 8)
    return np.concatenate(
        (
            np.linspace(start, start + slow, first),
            np.linspace(start + slow, end, frames - first + 1)[1:],
        )
    )


def pace(speed: float) -> str:
    """Playback speed in words, empty at real time."""
    times = float(f"{max(speed, 1 / speed):.2g}")
    if times == 1:
        return ""
    return f"\n{times:g} times {'as fast' if speed > 1 else 'slower'}"


def render(run: Trajectory, times: Array, dpi: int, title: str, follow: str) -> Iterator[Picture]:
    """RGB pictures (height, width, 3) at `times` [s]: the scene, and below it the coordinate
    `follow` over time. The axes are drawn once; each picture redraws moving parts only."""
    setup, shown = run.setup, instants(run, times.tolist())
    curve = next(curve for curve in curves(run) if curve.name == follow)
    scale = force_scale(setup, shown)
    x_limits, y_limits = Scene(Figure().subplots(), setup, curves=scale).limits(shown)
    tall = (y_limits[1] - y_limits[0]) / (x_limits[1] - x_limits[0])
    with rc_context(STYLE):
        figure = Figure(
            figsize=(8.0, min(max(5.8, 7.0 * tall + 2.2), 8.6)), dpi=dpi, layout="constrained"
        )
        canvas = FigureCanvasAgg(figure)
        whole, strip = figure.subplots(2, 1, height_ratios=(figure.get_figheight() - 1.26, 1.26))
        stress = largest_stress(shown)
        scene = Scene(whole, setup, curves=scale, stress=stress)
        stress_bar(figure, whole, stress, SIZES["screen"])
        whole.set(xlim=x_limits, ylim=y_limits, xlabel="x [mm]", ylabel="y [mm]", title=title)
        scene.scale_bar(whole)
        whole.grid(False)
        figure.legend(handles=keys(setup, shown), loc="outside lower center", ncols=5)
        motion(strip, run, curve)
        strip.set_xlabel("time [s]")
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
    for instant, speed in zip(shown, np.diff(times, prepend=2 * times[0] - times[1])):
        scene.show(instant)
        cursor.set_data([instant.time], [curve.values[run.at(instant.time)]])
        clock.set_text(f"t = {instant.time:6.3f} s{pace(speed * FRAMES_PER_SECOND)}")
        canvas.restore_region(background)
        for artist in moving:
            assert artist.axes is not None
            artist.axes.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def animate(
    run: Trajectory, path: Path, *, frames: int = 150, dpi: int = 110, progress: bool = False,
    title: str = "", follow: str = "", slow: float = 0.0,
) -> None:  # fmt: skip
    """Write `frames` pictures of the whole run as .gif, or as .mp4 where imageio-ffmpeg is
    installed.

    `follow` is the coordinate under the picture, by default the liveliest one; the first `slow` [s]
    take an eighth of the pictures, which are else equally far apart in time. The file appears whole
    or not at all. Raises `ValueError` for another suffix or coordinate, and `ModuleNotFoundError`
    for .mp4 without imageio-ffmpeg.
    """
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"`path` must end in .gif or .mp4, but is {path}")
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ModuleNotFoundError(
            f"{path} needs imageio-ffmpeg: pip install 'torchsoft[video]', or write a .gif"
        )
    times, known = frame_times(run, frames, slow), [curve.name for curve in curves(run)]
    followed = follow or liveliest(run)
    if followed not in known:
        raise ValueError(
            f"`follow` is `{followed}`, no coordinate that moves; "
            f"{suggestion(followed, known, 'there are')}"
        )
    bar = tqdm(
        render(run, times, dpi, title, followed),
        "animation",
        len(times),
        unit="frame",
        disable=not progress,
    )
    with replacing(path) as partial:
        (write_gif if path.suffix == ".gif" else write_mp4)(bar, partial)


def write_gif(pictures: Iterable[Picture], path: Path) -> None:
    """Write a GIF with the palette of one picture, so that still areas stay identical and the file
    is small."""
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
    """Write H.264 through the ffmpeg of imageio-ffmpeg."""
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
