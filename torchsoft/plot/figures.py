"""Style of figures, and pictures of instants of a run.

Times in s, lengths in mm, forces in N, stresses in kPa.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from matplotlib import rc_context, rcParams
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from torchsoft.display import suggestion
from torchsoft.files import replacing
from torchsoft.plot.scene import (
    STRESS,
    Scene,
    instants,
    keys,
    largest_stress,
    limits,
)
from torchsoft.solve.trajectory import Trajectory

STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "figure.titlesize": 12,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.4,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}

DESIRED, ACTUAL, OTHER = "#999999", "#0077bb", "#ee7733"

COLOURS = ("#0077bb", "#ee7733", "#009988", "#cc3311", "#33bbee", "#ee3377", "#bbbbbb")
"""Colours of bodies, contacts and actuators, in order."""

SNAPSHOTS = 6
"""Default number of pictures in a figure of snapshots."""

SHORT, ENLARGED = 0.03, 1 / 3
"""Share of a time axis on which a change looks like a vertical line, and its share enlarged."""

ROUND = partial(MaxNLocator, steps=[1, 2, 5, 10], min_n_ticks=1)
"""Chooses at most as many intervals, with round ends."""

Look = Literal["screen", "page", "column"]
"""Style of a figure: for a screen, with a title; or camera-ready without one, for the width of a
page or a column."""


class Size(NamedTuple):
    """Width of a figure [in], its font [pt], panels side by side, whether it has a title, and the
    height [in] that it should not exceed."""

    width: float
    font: float
    columns: int
    titled: bool
    height: float


SIZES: dict[str, Size] = {
    "screen": Size(13.0, 10.0, 3, True, float("inf")),
    "page": Size(7.1, 7.0, 3, False, 9.8),
    "column": Size(3.46, 7.5, 1, False, 9.8),
}


@contextmanager
def looking(look: Look) -> Iterator[Size]:
    """Apply the style of a look. Raises `ValueError` for an unknown one."""
    if look not in SIZES:
        raise ValueError(
            f"`look` must be one of {', '.join(get_args(Look))}, but is {look!r}; "
            f"{suggestion(look, SIZES)}"
        )
    size = SIZES[look]
    fonts = {
        "font.size": size.font, "axes.titlesize": size.font, "legend.fontsize": 0.9 * size.font,
        "figure.titlesize": 1.2 * size.font, "lines.linewidth": 0.13 * size.font,
    }  # fmt: skip
    with rc_context(STYLE | fonts):
        yield size


def save(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write the figure in the format of the suffix: PNG, or PDF and SVG with text as text. The file
    appears whole or not at all."""
    with replacing(path) as partial, rc_context(STYLE):
        figure.savefig(partial, dpi=dpi, format=path.suffix[1:])


class _EmbeddedFonts(Figure):
    """A figure that is saved as `save` does, with text as text: journals refuse Type 3 fonts."""

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """`savefig` of matplotlib."""
        with rc_context({name: STYLE[name] for name in ("pdf.fonttype", "svg.fonttype")}):
            super().savefig(*args, **kwargs)

    def __repr__(self) -> str:
        width, height = self.get_size_inches()
        return f"Figure of {width:g} x {height:g} in: show it in a notebook, or .savefig(FILE)"

    def _repr_png_(self) -> bytes:
        """The picture that a notebook shows."""
        with BytesIO() as file:
            self.savefig(file, format="png", dpi=100)
            return file.getvalue()


def new_figure(title: str, width: float, height: float) -> Figure:
    figure = _EmbeddedFonts(figsize=(width, height), layout="constrained")
    if title:
        figure.suptitle(title, x=0.01, ha="left")
    return figure


def timeline(axes: Axes, label: str, run: Trajectory) -> NDArray[np.float64]:
    """Label the axis of a panel over time; returns the times [s]."""
    axes.set_ylabel(label)
    t = run.t.numpy()
    axes.set_xlim(float(t[0]), float(t[-1]) + 0.01 * float(t[-1] - t[0]))
    return t


def finish_time_axis(axes: Axes) -> None:
    """Label the time axis of a panel. Where most of the change of its curves happens in a small
    first part, that part is enlarged to a third of the axis. Changes count by their squares, so
    that ripples do not hide a fast start."""
    axes.set_xlabel("time [s]")
    curves = [line for line in axes.get_lines() if line.get_transform() == axes.transData]
    t, (start, end) = np.asarray(curves[0].get_xdata())[1:], axes.get_xlim()
    sums = [np.nancumsum(np.diff(np.asarray(line.get_ydata())) ** 2) for line in curves]
    change = np.mean([one / (one[-1] or 1.0) for one in sums], 0)
    passed = (t - start) / (end - start)
    k = (change - passed).argmax()
    if passed[k] > SHORT or change[k] < 0.5:
        return
    length = ROUND(1).tick_values(0.0, float(t[k]) - start)[-1]
    knee = start + length
    times, places = (start, knee, end), (0.0, ENLARGED, 1.0)
    both = partial(np.interp, xp=times, fp=places), partial(np.interp, xp=places, fp=times)
    axes.set_xscale("function", functions=both)
    late = ROUND(4).tick_values(start, end)
    ticks = [start, start + length / 2, knee, *(x for x in late if knee + length < x <= end)]
    axes.set_xticks(ticks, [f"{x:g}" for x in ticks])
    axes.axvspan(start, knee, color="#f3f3f3", lw=0, zorder=0)
    axes.set_xlabel(f"time [s], the first {length:g} s enlarged")


def legend_above(axes: Axes) -> None:
    """Add a legend at the top of the panel, and extend its y axis to make room."""
    room, count = axes.get_window_extent(), len(axes.get_legend_handles_labels()[1])
    for rows in range(1, count + 1):
        legend = axes.legend(
            loc="upper left", ncols=-(-count // rows), fontsize="x-small", borderaxespad=0.0,
            handlelength=1.5, columnspacing=1.2,
        )  # fmt: skip
        box = legend.get_window_extent()
        if box.width <= room.width:
            break
    low, high = axes.get_ylim()
    axes.set_ylim(low, low + (high - low) / (1.0 - min(0.7, 1.1 * box.height / room.height)))


def letter(i: int) -> str:
    """Letter of panel i."""
    return f"{'abcdefghijklmnopqrstuvwxyz'[i % 26]})"


def stress_bar(figure: Figure, axes: Any, largest: float) -> None:
    """Add the colour bar of the von Mises stress."""
    if largest > 0:
        colours = ScalarMappable(Normalize(0.0, largest), STRESS)
        bar = figure.colorbar(colours, ax=axes, shrink=0.6, pad=0.01, aspect=30)
        bar.set_label("von Mises stress [kPa], elastic part", fontsize=rcParams["legend.fontsize"])
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]


def snapshots(run: Trajectory, times: Sequence[float] = (), *, title: str = "") -> Figure:
    """Bodies, deformed pads with their stress, contact points by their state, and contact forces at
    `times` [s], by default at six over the whole run."""
    setup = run.setup
    times = times or np.linspace(float(run.t[0]), float(run.t[-1]), SNAPSHOTS).tolist()
    shown = instants(run, times)
    with looking("screen") as size:
        x, y = limits(setup, shown)
        tall = float(np.clip(np.ptp(y) / np.ptp(x), 0.3, 1.5))
        columns = min(size.columns, len(shown))
        rows = -(-len(shown) // columns)
        width = min(size.width, 4.8 * columns)
        heading = title or "Bodies, pads and contact forces"
        figure = new_figure(heading, width, (0.93 * width / columns * tall + 0.35) * rows + 0.8)
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        markers = 0.1 * size.font * min(1.0, width / columns / 4.0)
        for i, (axes, instant) in enumerate(zip(grid.flat, shown)):
            scene = Scene(axes, setup, shown, size=markers)
            scene.show(instant)
            scene.scale_bar()
            axes.set_title(f"{letter(i)} t = {instant.time:g} s")
            if i + columns < len(shown):
                axes.set_xlabel("")
            else:
                axes.tick_params(labelbottom=True)
        for axes in grid[:, 1:].flat:
            axes.set_ylabel("")
        for axes in grid.flat[len(shown) :]:
            axes.set_visible(False)
        stress_bar(figure, list(grid.flat), largest_stress(shown))
        legend: Any = {"loc": "outside lower center", "ncols": min(5, 2 * columns)}
        figure.legend(handles=keys(setup, shown), **legend)
    return figure
