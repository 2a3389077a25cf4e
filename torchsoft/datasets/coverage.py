"""A picture of what a dataset covers."""

from itertools import pairwise

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from torchsoft.channels import CHANNELS
from torchsoft.datasets.config import Config
from torchsoft.datasets.design import SPLITS

COLOURS = {"train": "C0", "validation": "C1", "test": "C2"}

SHOWN = {"m": (1e3, "mm"), "s": (1e3, "ms"), "Pa": (1e-6, "MPa"), "N/m": (1e-3, "kN/m")}
"""Factor and unit in which values are drawn, where it is not the SI unit."""

MOTIONS = ("x_C", "y_Br", "F_y")
"""Channels that are drawn over time."""


def figure(data: xr.Dataset, config: Config) -> Figure:
    """Pairs of parameters by split, failures crossed; trajectories of each kind; some of the motions."""
    names = [name.replace("/", "_over_") for name in config.parameters] + ["grasp_depth"]
    logarithmic = {name.replace("/", "_over_") for name, r in config.parameters.items() if r.scale == "log"}
    pairs = neighbours(names)
    columns = min((4, 5), key=lambda n: -len(pairs) % n)
    rows = max(1, -(-len(pairs) // columns))
    fig = Figure(figsize=(13, 2.9 * (rows + 1)), layout="constrained")
    above, below = np.asarray(fig.subfigures(2, 1, height_ratios=(rows, 1)))
    for ax, (a, b) in zip(above.subplots(rows, columns, squeeze=False).flat, pairs):
        scatter(ax, data, a, b)
        for name, axis, scale in ((a, ax.xaxis, ax.set_xscale), (b, ax.yaxis, ax.set_yscale)):
            if name in logarithmic:
                scale("log")
                axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axis.set_major_formatter("{x:g}")
                axis.set_minor_locator(NullLocator())
            else:
                axis.set_major_locator(MaxNLocator(5))
    for ax in above.axes[len(pairs) :]:
        ax.set_axis_off()
    above.legend(*above.axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=4, fontsize=7)
    panels = below.subplots(1, 4)
    count(panels[0], data)
    for ax, motion in zip(panels[1:], MOTIONS):
        draw(ax, data, motion)
    panels[1].legend(fontsize=7)
    fig.suptitle(f"{config.title}: {data.sizes['trajectory']} trajectories, {int(data['failed'].sum())} failed")
    return fig


def scatter(ax: Axes, data: xr.Dataset, a: str, b: str) -> None:
    """One parameter against another, by split, failures crossed."""
    split, failed = np.asarray(data["split"]), np.asarray(data["failed"])
    (x, x_label), (y, y_label) = shown(data, a), shown(data, b)
    for name in SPLITS:
        here = (split == name) & (failed == 0)
        ax.plot(x[here], y[here], ".", ms=4, color=COLOURS[name], label=name)
    if failed.any():
        ax.plot(x[failed == 1], y[failed == 1], "rx", ms=4, label="failed")
    ax.set(xlabel=x_label, ylabel=y_label)
    ax.tick_params(labelsize=7, which="both")


def count(ax: Axes, data: xr.Dataset) -> None:
    """Trajectories of each kind, by split."""
    split, kind = np.asarray(data["split"]), np.asarray(data["kind"])
    kinds = sorted(set(kind))
    bottom = np.zeros(len(kinds))
    for name in SPLITS:
        height = np.array([((kind == k) & (split == name)).sum() for k in kinds])
        ax.bar(kinds, height, bottom=bottom, color=COLOURS[name], label=name)
        bottom += height
    ax.set(ylabel="trajectories [1]", title="kinds")
    ax.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    ax.tick_params(axis="x", rotation=30, labelsize=7)


def draw(ax: Axes, data: xr.Dataset, key: str) -> None:
    """A channel of up to three sound runs of each kind over time."""
    channel = CHANNELS[key]
    factor, unit = SHOWN.get(channel.unit, (1.0, channel.unit))
    kind, failed = np.asarray(data["kind"]), np.asarray(data["failed"])
    for colour, k in enumerate(sorted(set(kind))):
        for n, i in enumerate(np.flatnonzero((kind == k) & (failed == 0))[:3]):
            values = factor * channel.of(data[channel.variable][i])
            ax.plot(data["time"], values, lw=0.7, color=f"C{colour}", label=k if n == 0 else None)
    ax.set(xlabel="time [s]", ylabel=f"${channel.symbol}$ [{unit}]")


def neighbours(names: list[str]) -> list[tuple[str, str]]:
    """Each name with the next one, so that every one is drawn twice."""
    return list(pairwise(names)) + ([(names[0], names[-1])] if len(names) > 2 else [])


def shown(data: xr.Dataset, name: str) -> tuple[np.ndarray, str]:
    """A parameter's values and label in the unit that it is drawn in."""
    factor, unit = SHOWN.get(data[name].attrs["units"], (1.0, data[name].attrs["units"]))
    return factor * np.asarray(data[name]), f"{name.replace('_over_contact.', ' / ')} [{unit}]"
