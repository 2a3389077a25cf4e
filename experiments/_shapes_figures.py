"""Figures and video of `shapes_and_materials.py`: force distributions side by side, paths, and resistance against speed."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _shapes_resistance import HEIGHT, Resistance, Roll
from _shapes_rolls import FORCE, Rolled, per_millimetre
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tqdm import tqdm

from torchsoft.files import replacing
from torchsoft.plot.animation import FRAMES_PER_SECOND, Picture, write_gif
from torchsoft.plot.figures import STYLE, new_figure
from torchsoft.plot.general import COLOURS
from torchsoft.plot.scene import FRICTION, INK, NORMAL, Scene, force_scale, instants

WIDE = 13.0
"""Half of the part of the pad that is shown [mm]."""


def close_up(axes: Axes, rolled: Rolled, time: float) -> None:
    """The object and its pads at a moment."""
    (instant,) = instants(rolled.model, rolled.run, [time])
    scene = Scene(axes, rolled.model, columns=4)
    scene.show(instant)
    x, y = instant.pose["disc"][:2]
    axes.set(xlim=(x - 26, x + 26), ylim=(y - 30, y + 30), xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def forces(axes: Axes, rolled: Rolled, time: float) -> None:
    """Normal force and friction along both pads, from the object's centre."""
    for contact, line in (("L", "-"), ("U", "--")):
        x, force = per_millimetre(rolled, contact, rolled.run.at(time))
        for column, colour in ((0, NORMAL), (1, FRICTION)):
            axes.plot(x, force[:, column], line, color=colour, lw=1.2)
    axes.axhline(0, color=INK, lw=0.5)
    axes.set_xlim(-WIDE, WIDE)


@rc_context(STYLE)
def objects_figure(rolled: Mapping[str, Rolled], moments: Sequence[float]) -> Figure:
    """A column an object: its picture in the middle of the roll, and the forces at the moments."""
    figure = new_figure(f"Objects between the paper's pads, {FORCE:g} N", 2.5 * len(rolled) + 0.6, 9)
    grid = figure.subplots(1 + len(moments), len(rolled), squeeze=False, height_ratios=(1.3, *[1] * len(moments)))
    for column, (name, one) in enumerate(rolled.items()):
        close_up(grid[0, column], one, moments[len(moments) // 2])
        grid[0, column].set_title(name)
        for row, time in enumerate(moments, 1):
            axes = grid[row, column]
            axes.sharey(grid[1, 0])
            forces(axes, one, time)
            axes.tick_params(labelleft=column == 0, labelbottom=row == len(moments))
            if column == 0:
                axes.set_ylabel(f"{time:g} s: force [N/mm]")
    grid[0, 0].text(
        0.0, -0.02, f"at {moments[len(moments) // 2]:g} s", transform=grid[0, 0].transAxes, va="top", fontsize=9
    )
    grid[-1, len(rolled) // 2].set_xlabel("place along the pad from the object's centre [mm]")
    handles = [
        grid[1, 0].plot([], [], style, color=colour, label=label)[0]
        for label, colour, style in (
            ("normal force, lower pad", NORMAL, "-"), ("normal force, upper pad", NORMAL, "--"),
            ("friction to the right, lower pad", FRICTION, "-"), ("friction to the right, upper pad", FRICTION, "--"),
        )
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=4 if len(rolled) > 3 else 2)
    return figure


@rc_context(STYLE)
def distributions(rolled: Mapping[str, Rolled], moments: Sequence[float]) -> Figure:
    """The paper's disc on every rubber: normal force and friction on the lower pad at the moments."""
    figure = new_figure(f"The paper's disc on rubbers, lower pad, {FORCE:g} N", 9, 2.6 * len(moments) + 1.2)
    grid = figure.subplots(len(moments), 2, squeeze=False, sharex=True, sharey="col")
    for row, time in enumerate(moments):
        for colour, (name, one) in zip(COLOURS, rolled.items()):
            x, force = per_millimetre(one, "L", one.run.at(time))
            for column in (0, 1):
                grid[row, column].plot(x, force[:, column], color=colour, lw=1.3, label=name)
        for axes, kind in zip(grid[row], ("normal force", "friction, to the right")):
            axes.axhline(0, color=INK, lw=0.5)
            axes.set(ylabel=f"{kind} [N/mm]", xlim=(-8, 8), title=f"{time:g} s")
    for axes in grid[-1]:
        axes.set_xlabel("place along the pad from the disc's centre [mm]")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


@rc_context(STYLE)
def paths(shaped: Mapping[str, Rolled], made_of: Mapping[str, Rolled]) -> Figure:
    """Angle, height of object and bracket, normal force and horizontal force of all rolls over time."""
    figure = new_figure("Grasp and roll out", 11, 11)
    grid = figure.subplots(5, 2, sharex=True)
    rows = ("theta [rad]", "y_C - y_C(0) [mm]", "y_Br - y_Br(0) [mm]", "normal force, lower pad [N]", "F_x [N]")
    for column, (title, several) in enumerate({"objects": shaped, "rubbers": made_of}.items()):
        for colour, (name, one) in zip(COLOURS, several.items()):
            run = one.run
            curves = (
                run["theta"], 1e3 * (run["y_C"] - run["y_C"][0]), 1e3 * (run["y_Br"] - run["y_Br"][0]),
                run.force["L"][..., 0].sum(-1), run["F_x"],
            )  # fmt: skip
            for axes, curve in zip(grid[:, column], curves):
                axes.plot(run.t, curve, color=colour, lw=1.2, label=name)
        for axes, label in zip(grid[:, column], rows):
            axes.set_ylabel(label)
        grid[0, column].set_title(title)
        grid[-1, column].set_xlabel("time [s]")
        grid[0, column].legend(fontsize=8, loc="upper left")
    figure.align_ylabels()
    return figure


@rc_context(STYLE)
def resistance_figure(curves: Mapping[str, Resistance], loads: Mapping[float, Roll]) -> Figure:
    """A panel a rubber: measured by force and by power, and both theories; then how far theory is off, by speed and by load."""
    figure = new_figure("Rolling resistance of a disc on a pad under a held load", 13, 7.8)
    rows, columns = (2, 3) if len(curves) > 1 else (1, 3)
    every = figure.subplots(rows, columns).ravel()
    panels, ratio, small = every[: len(curves)], every[-2], every[-1]
    for axes in every[len(curves) : -2]:
        axes.set_visible(False)
    for axes, colour, (name, one) in zip(panels, COLOURS, curves.items()):
        De = [one.deborah(r.speed) for r in one.rolls]
        between = [one.deborah(v) for v in one.speeds]
        axes.loglog(between, one.theory, color=colour, lw=1.6, label="theory: moving contact on the layer")
        axes.loglog(between, one.winkler, ":", color=INK, lw=1.2, label="closed form: thin layer")
        axes.loglog(
            De, [r.force for r in one.rolls], "o", color=colour, mfc="none", ms=7, label="measured: driving force"
        )
        axes.loglog(De, [r.power for r in one.rolls], "+", color=INK, ms=6, label="measured: dissipated power")
        axes.set(title=name, xlabel="De = v tau / a", ylabel="resistance / load")
        ratio.semilogx(De, [r.force / r.theory for r in one.rolls], "o-", color=colour, ms=4, lw=1, label=name)
    panels[0].legend(fontsize=8, loc="lower center")
    for axes in (ratio, small):
        axes.axhline(1, color=INK, lw=0.6)
        axes.set_ylabel("measured / theory")
    ratio.set(xlabel="De = v tau / a", title="by speed")
    ratio.legend(fontsize=8)
    small.plot(
        [r.depth / HEIGHT for r in loads.values()], [r.force / r.theory for r in loads.values()], "o-", color=COLOURS[1]
    )
    for load, r in loads.items():
        small.annotate(
            f"{load:g} N", (r.depth / HEIGHT, r.force / r.theory), (5, -11), textcoords="offset points", fontsize=8
        )
    small.set(
        xlabel="depth of the disc over the pad's height",
        title="by load, standard linear solid at De = 0.7",
        xlim=(0, None),
    )
    return figure


def pictures(rolled: Mapping[str, Rolled], times: Sequence[float]) -> Iterator[Picture]:
    """All rolls side by side, with their contact forces, frame by frame."""
    shown = {name: instants(one.model, one.run, times) for name, one in rolled.items()}
    scale = min((force_scale(one.model, shown[name]) for name, one in rolled.items()), key=lambda pair: pair[0])
    with rc_context(STYLE):
        columns = -(-len(rolled) // 2)
        figure = Figure(figsize=(2.9 * columns, 7.6), dpi=90, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        panels = figure.subplots(2, columns, squeeze=False).ravel()
        scenes = {}
        for axes, (name, one) in zip(panels, rolled.items()):
            scenes[name] = Scene(axes, one.model, columns=5, curves=scale)
            axes.set(xlim=(15, 85), ylim=(-26, 80), xticks=[], yticks=[], title=name)
            axes.grid(False)
            axes.spines[:].set_visible(False)
        for axes in panels[len(rolled) :]:
            axes.set_visible(False)
        first = panels[0]
        first.plot([], [], color=NORMAL, label="normal force")
        first.plot([], [], color=FRICTION, label="friction (outwards: to the right)")
        first.legend(loc="upper left", fontsize=7)
    for i, time in enumerate(times):
        for name, scene in scenes.items():
            scene.show(shown[name][i])
        figure.suptitle(f"Rolled between the paper's pads under {FORCE:g} N, t = {time:5.2f} s", x=0.01, ha="left")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def video(rolled: Mapping[str, Rolled], path: Path, frames: int = 6 * FRAMES_PER_SECOND) -> None:
    """All rolls side by side, from the start to the end, as a .gif."""
    end = min(float(one.run.t[-1]) for one in rolled.values())
    times: Any = np.linspace(0.0, end, frames)
    with replacing(path) as partial:
        write_gif(tqdm(pictures(rolled, times.tolist()), "video", frames, unit="frame"), partial)
