"""Videos and interactive players: bodies, deformed pads and contact forces over a whole run."""

import base64
import json
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from torchsoft.display import hidden, suggestion
from torchsoft.extras import needed
from torchsoft.files import replacing, save_text
from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import von_mises
from torchsoft.plot.dashboard import (
    ACTUAL,
    RIPPLE,
    Chart,
    draw,
    frame_rows,
    liveliest,
    motions,
    ripples,
    sums,
)
from torchsoft.plot.figures import COLOURS, STYLE, finish_time_axis, stress_bar
from torchsoft.plot.scene import (
    DISC,
    FRICTION,
    INK,
    LAYER,
    MM,
    NORMAL,
    PAD,
    STEEL,
    Scene,
    behind,
    foot,
    force_scale,
    friction_sign,
    instants,
    keys,
    limits,
    own_axes,
    own_places,
    plates,
    straight_up,
)
from torchsoft.solve.trajectory import Trajectory

FRAMES_PER_SECOND = 12.5
"""Frame rate; the delay of a GIF's frame is a multiple of 10 ms."""

Picture = NDArray[np.uint8]


def frame_times(run: Trajectory, frames: int, slow: float) -> Array:
    """Times [s] of the frames; one in eight goes to the first `slow` [s], unless that is zero."""
    start, end = float(run.t[0]), float(run.t[-1])
    first = slow if 0 < slow < end - start else (end - start) / 8
    return np.interp(np.linspace(0, 8, frames), (0, 1, 8), (start, start + first, end))


def pace(speed: float) -> str:
    """Playback speed in words, empty at real time."""
    times = float(f"{max(speed, 1 / speed):.2g}")
    if times == 1:
        return ""
    return f"\n{times:g} times {'as fast' if speed > 1 else 'slower'}"


def render(run: Trajectory, times: Array, dpi: int, title: str, chart: Chart) -> Iterator[Picture]:
    """RGB pictures (height, width, 3) at `times` [s]: the scene, and below it a coordinate over
    time. The axes are drawn once; each picture redraws moving parts only."""
    setup, shown = run.setup, instants(run, times.tolist())
    with rc_context(STYLE):
        x, y = limits(setup, shown)
        tall = 7.0 * float(np.ptp(y) / np.ptp(x)) + 2.2
        height = 2 * round(0.5 * dpi * min(max(5.8, tall), 8.6)) / dpi  # H.264: even
        figure = Figure(figsize=(8.0, height), dpi=dpi, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        whole, strip = figure.subplots(2, 1, height_ratios=(height - 1.26, 1.26))
        scene = Scene(whole, setup, shown)
        scene.scale_bar()
        stress_bar(figure, whole, scene.stress)
        whole.set_title(title)
        figure.legend(handles=keys(setup, shown), loc="outside lower center", ncols=5)
        draw(strip, run, chart)
        finish_time_axis(strip)
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
        cursor.set_data([instant.time], [chart.curves[ACTUAL][run.at(instant.time)]])
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
    if path.suffix == ".mp4":
        needed("imageio_ffmpeg", "video")
    times, known = frame_times(run, frames, slow), {one.name: one for one in motions(run)}
    followed = follow or liveliest(run)
    if followed not in known:
        raise ValueError(
            f"`follow` is `{followed}`, no coordinate that moves; "
            f"{suggestion(followed, known, 'there are')}"
        )
    bar = tqdm(
        render(run, times, dpi, title, known[followed]),
        "animation",
        len(times),
        unit="frame",
        disable=hidden(progress),
    )
    with replacing(path) as partial:
        (write_gif if path.suffix == ".gif" else write_mp4)(bar, partial)


def write_gif(pictures: Iterable[Picture], path: Path) -> None:
    """Write a GIF with the palette of one picture, so that still areas stay identical and the file
    is small."""
    images = list(map(Image.fromarray, pictures))
    middle = images[len(images) // 2].copy()
    for i, colour in enumerate(
        (NORMAL, FRICTION, PAD, LAYER, DISC, STEEL, COLOURS[0])
    ):  # few pixels have some of them
        middle.paste(colour, (0, 12 * i, middle.width, 12 * (i + 1)))
    palette = middle.quantize(96)
    first, *rest = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    pause = round(1000 / FRAMES_PER_SECOND)
    first.save(path, "GIF", save_all=True, append_images=rest, duration=pause, loop=0)


def write_mp4(pictures: Iterable[Picture], path: Path) -> None:
    """Write H.264 through the ffmpeg of imageio-ffmpeg."""
    pictures = iter(pictures)
    first = next(pictures)
    writer = needed("imageio_ffmpeg", "video").write_frames(
        str(path), first.shape[1::-1], fps=FRAMES_PER_SECOND, macro_block_size=2,
        output_params=["-f", "mp4"],
    )  # fmt: skip
    writer.send(None)
    for picture in chain([first], pictures):
        writer.send(picture)
    writer.close()


# The interactive player: a run as one self-contained HTML file for any browser.
#
# Pads deform and show a quantity, bodies move, contact points show their state and forces; charts
# follow the time.


TEMPLATE = Path(__file__).with_name("player.html")

CHART_SAMPLES = 1500
"""Most samples of a chart."""

LEVELS = 65535


def packed(values: Array) -> dict[str, Any]:
    """Numbers quantised to 16 bits between their extremes, in base 64, with their shape."""
    low, high = float(np.min(values, initial=np.inf)), float(np.max(values, initial=-np.inf))
    if not values.size:
        low = high = 0.0
    step = (high - low) / LEVELS
    codes = np.round((values - low) / (step or 1.0)).astype("<u2")
    return {"low": low, "step": step, "codes": encoded(codes), "shape": list(values.shape)}


def encoded(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


def pads(run: Trajectory, rows: list[int]) -> dict[str, Any]:
    """Meshes, node positions in the frame of the base [mm] and stresses of the elements [kPa], by
    pad."""
    out, thickness = {}, plates(run.setup)
    for name, pad in run.setup.pads.items():
        whole = pad.displacement(run.displacement[name][rows].detach().numpy())
        stress = 1e-3 * pad.stress(whole)
        fields = {
            "von Mises stress": von_mises(stress),
            "pressure": -stress[..., :3].mean(-1),
            "shear stress": stress[..., 3],
        }
        out[name] = {
            "base": pad.base, "nodes": packed(MM * pad.placed(pad.mesh.nodes + whole)),
            "still": (MM * pad.placed(pad.mesh.nodes)).round(6).ravel().tolist(),
            "elements": pad.mesh.elements.ravel().tolist(),
            "outline": pad.mesh.outline.tolist(),
            "fields": {key: packed(values) for key, values in fields.items()},
        }  # fmt: skip
        if thickness[name]:
            corners = behind(pad, np.zeros(3), thickness[name])[[3, 2, 1, 0]]
            out[name]["plate"] = corners.ravel().tolist()
    return out


def contacts(run: Trajectory, rows: list[int]) -> dict[str, Any]:
    """Positions of the points in the frame of the base [mm], forces [N] and states, by contact;
    `along` is the direction along the surface, `up` its outward normal, `foot` a point [mm] of the
    line on which force curves stand."""
    out, thickness = {}, plates(run.setup)
    for name, contact in run.setup.contacts.items():
        pad = run.setup.pads[contact.pad]
        u = run.displacement[contact.pad][rows].detach().numpy()
        still = np.zeros(3)
        first = still if pad.base is None else run.state.pose[pad.base][rows[0]].detach().numpy()
        direction, up = own_axes(pad, still)
        force = run.force[name][rows].detach().numpy() * [1.0, friction_sign(pad, first)]
        out[name] = {
            "pad": contact.pad, "body": contact.body, "mu": contact.friction.get("mu_s"),
            "along": direction.tolist(), "up": up.tolist(),
            "foot": own_places(pad, still, foot(run.setup, thickness[contact.pad])).tolist(),
            "points": packed(MM * pad.surface_points(u)), "force": packed(force),
            "state": encoded(run.contact_state[name][rows].numpy().astype(np.int8)),
        }  # fmt: skip
    return out


def opening(run: Trajectory, rows: list[int]) -> int:
    """The first frame with as many contacts closed as ever at once, and half of the largest force
    that these carry."""
    normal = [x[rows, :, 0].detach().sum(-1).numpy() for x in run.force.values()]
    normal = np.array([np.zeros(len(rows)), *normal])
    closed = (normal > 0).sum(0)
    total = normal.sum(0) * (closed == closed.max())
    return int((total >= 0.5 * total.max()).argmax())


def charts(run: Trajectory, rows: list[int]) -> list[dict[str, Any]]:
    """All curves over the times of `rows`, in charts of one unit each. Sums of forces of less than
    a billionth of the largest are drawn as zero, and what is not a number too."""
    largest = [float(x[..., 0].detach().sum(-1).max()) for x in run.force.values()]
    least = {"N": 1e-9 * max(largest, default=0.0), "%": 1e-7}
    shown = {one for body in run.setup.bodies.values() for one in body.channels.values()}
    others = []
    for name, channel in run.channels.items():
        values = channel.detach().numpy()
        if name not in shown and np.abs(values).max() > 0:
            others.append(Chart(name, name, run.units.get(name, ""), {name: values}))
    every = [(one, least.get(one.unit, 0.0)) for one in (*motions(run), *sums(run))]
    return [
        {
            "name": one.label, "unit": one.unit,
            "series": [
                {"name": name, "colour": colour,
                 "values": packed(np.where(np.abs(x[rows]) > floor, x[rows], 0.0))}
                for name, x, colour in one.coloured()
            ],
        }
        for one, floor in (*every, *((one, 0.0) for one in others))
    ]  # fmt: skip


def player(run: Trajectory, path: Path, *, frames: int = 300, title: str = "") -> None:
    """Write the player with `frames` frames, a megabyte a hundred for pads like the paper's. The
    file appears whole or not at all. Raises `ValueError` for less than two frames."""
    if frames < 2:
        raise ValueError(f"`frames` must be 2 or more, but is {frames}")
    rows = frame_rows(run, frames)
    times = run.t.numpy()[rows]
    first_shown = opening(run, rows)
    shown = instants(run, times[[first_shown, len(times) // 2, -1]].tolist())
    samples = frame_rows(run, CHART_SAMPLES)
    about = {
        "title": title or "torchsoft", "times": times.round(9).tolist(),
        "opening": first_shown,
        "bodies": {
            name: {
                "pose": packed(run.state.pose[name][rows].detach().numpy() * [MM, MM, 1.0]),
                "outline": None if body.outline is None else (MM * body.outline).ravel().tolist(),
                "spoke": None if body.outline is None else straight_up(MM * body.outline).tolist(),
            }
            for name, body in run.setup.bodies.items()
        },
        "pads": pads(run, rows), "contacts": contacts(run, rows),
        "scale": force_scale(run.setup, shown), "t": run.t.numpy()[samples].round(9).tolist(),
        "charts": charts(run, samples),
        "note": RIPPLE if ripples(run) else "",
        "made": {k: str(v) for k, v in run.made_by.items() if isinstance(v, str)},
    }  # fmt: skip
    data = json.dumps(about, allow_nan=False).replace("<", "\\u003c")  # or it may end the script
    page = TEMPLATE.read_text(encoding="utf-8").replace("/*DATA*/null", data)
    save_text(path, page)
