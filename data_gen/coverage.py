"""A picture of what a dataset covers."""

from itertools import pairwise

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from data_gen.config import Config
from data_gen.design import SPLITS

COLOURS = {"train": "C0", "validation": "C1", "test": "C2"}


def figure(data: xr.Dataset, config: Config) -> Figure:
    """Pairs of parameters by split, failures crossed; trajectories of each kind; some of the motions."""
    split, failed, kind = (np.asarray(data[name]) for name in ("split", "failed", "kind"))
    names = [name.replace("/", "_over_") for name in config.parameters] + ["grasp_depth"]
    pairs = neighbours(names)
    columns = 4
    rows = -(-len(pairs) // columns)
    fig = Figure(figsize=(13, 2.9 * (rows + 1)), layout="constrained")
    grid = fig.add_gridspec(rows + 1, columns)
    for i, (a, b) in enumerate(pairs):
        ax = fig.add_subplot(grid[i // columns, i % columns])
        for name in SPLITS:
            here = (split == name) & (failed == 0)
            ax.plot(data[a][here], data[b][here], ".", ms=4, color=COLOURS[name], label=name)
        ax.plot(data[a][failed == 1], data[b][failed == 1], "rx", ms=4, label="failed")
        ax.set(xlabel=label(data, a), ylabel=label(data, b))
        for name, axis in ((a, ax.set_xscale), (b, ax.set_yscale)):
            if name in config.parameters and config.parameters[name].scale == "log":
                axis("log")
        ax.tick_params(labelsize=7, which="both")
        if i == 0:
            ax.legend(fontsize=7)
    ax = fig.add_subplot(grid[rows, 0])
    kinds = sorted(set(kind))
    bottom = np.zeros(len(kinds))
    for name in SPLITS:
        count = np.array([((kind == k) & (split == name)).sum() for k in kinds])
        ax.bar(kinds, count, bottom=bottom, color=COLOURS[name], label=name)
        bottom += count
    ax.set(ylabel="trajectories [1]", title="kinds")
    ax.tick_params(axis="x", rotation=30, labelsize=7)
    motions = (("disc_position", 0, "x_C"), ("bracket_position", 1, "y_Br"), ("control_force", 1, "F_y"))
    for column, (name, axis, symbol) in enumerate(motions, 1):
        ax = fig.add_subplot(grid[rows, column])
        for colour, k in enumerate(kinds):
            for n, i in enumerate(np.flatnonzero((kind == k) & (failed == 0))[:3]):
                scale = 1.0 if name == "control_force" else 1e3
                told = k if n == 0 else None
                ax.plot(data["time"], scale * data[name][i, :, axis], lw=0.7, color=f"C{colour}", label=told)
        ax.set(xlabel="time [s]", ylabel=f"{symbol} [{'N' if name == 'control_force' else 'mm'}]")
        if column == 1:
            ax.legend(fontsize=7)
    fig.suptitle(f"{config.title}: {len(split)} trajectories, {int(failed.sum())} failed")
    return fig


def neighbours(names: list[str]) -> list[tuple[str, str]]:
    """Each name with the next one, so that every one is seen twice."""
    return list(pairwise(names)) + ([(names[0], names[-1])] if len(names) > 2 else [])


def label(data: xr.Dataset, name: str) -> str:
    unit = data[name].attrs["units"]
    return f"{name.replace('_over_contact.', ' / ')} [{unit}]"
