"""The multibond graph of the whole system as a drawing (the paper's Fig. 9) and as Graphviz text.

Both come from `multibond.topology` of the model's own ports, so they show what is simulated.
"""

import re

import networkx as nx
import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchsoft.model import SoftGrasp
from torchsoft.multibond import to_dot, topology
from torchsoft.pad import Array
from torchsoft.plot.figures import STYLE, new_figure
from torchsoft.plot.scene import INK

KINDS = {
    "1": ("1-junction", "#222222"),
    "MTF": ("(modulated) transformer", "#666666"),
    "I": ("I field", "#0077bb"),
    "C": ("C field, spring", "#00796b"),
    "R": ("R field, dashpot, slip", "#cc3311"),
    "Se": ("source of effort", "#aa3377"),
    "Sf": ("source of flow", "#8a6d00"),
}
"""Meaning and colour of each kind; its letter is always written too."""

BANDS = {
    "lower pad": (0.0, 2.7),
    "lower contact\ninterface": (2.7, 5.7),
    "disc": (5.7, 7.9),
    "upper contact\ninterface": (7.9, 10.9),
    "upper pad": (10.9, 13.1),
    "bracket": (13.1, 14.9),
    "controllers": (14.9, 17.6),
}
"""Subsystems, from y to y."""

HUBS = {  # name: x, y; angle and step [deg] and radius of the fan of its elements
    "ground": (1.2, 1.8, 180, 0, 2.1),
    "pad_L: field": (4.2, 1.8, 270, 76, 1.45),
    "pad_L": (7.6, 1.8, 0, 0, 2.6),
    "contact_L": (7.6, 4.2, 0, 13, 3.0),
    "spin": (4.2, 6.8, 180, 0, 2.4),
    "disc": (7.6, 6.8, 17, 0, 2.6),
    "weight": (9.7, 6.2, 0, 0, 1.9),
    "contact_U": (7.6, 9.4, 0, 13, 3.0),
    "pad_U": (7.6, 12.0, 0, 0, 2.6),
    "pad_U: field": (4.2, 12.0, 180, 30, 2.5),
    "bracket_spin": (4.2, 14.0, 180, 0, 2.5),
    "bracket": (7.6, 14.0, 0, 0, 2.6),
    "control_y": (5.6, 15.6, 90, 46, 1.6),
    "control_x": (9.8, 15.6, 90, 70, 1.6),
}

CAPTIONS = {
    "contact_L": "contact frame",
    "contact_U": "contact frame",
    "pad_L: field": "strain rate",
    "pad_U: field": "strain rate",
    "weight": "gravity",
    "control_x": "horizontal PD",
    "control_y": "vertical PD",
}

SIGNAL_X = 12.4
"""Where activated bonds run upwards, right of everything else."""


def graph_of(model: SoftGrasp) -> nx.DiGraph:
    """The topology of the model's ports; it does not depend on the state."""
    with torch.no_grad():
        state = model.layout.unpack(torch.zeros(model.layout.size, dtype=torch.float64))
        apart = state._replace(r_C=state.r_C + torch.tensor([0.0, 1.0]), r_Br=state.r_Br + torch.tensor([0.0, 3.0]))
        return topology(model.evaluate(0.0, apart).ports, model.junctions)


def dot(model: SoftGrasp) -> str:
    """Graphviz text of the model's multibond graph."""
    return to_dot(graph_of(model))


def positions(graph: nx.DiGraph) -> dict[str, Array]:
    """Position of every node: hubs as in `HUBS`, elements fanned out around theirs."""
    at = {name: np.array(HUBS[name][:2]) for name in graph if name in HUBS}
    for hub in list(at):
        _, _, angle, step, radius = HUBS[hub]
        own = [n for n in nx.all_neighbors(graph, hub) if n not in HUBS]
        for i, name in enumerate(own):
            turn = np.deg2rad(angle + step * (0.5 * (len(own) - 1) - i))
            at[name] = at[hub] + radius * np.array([np.cos(turn), np.sin(turn)])
    return at


def node_text(name: str, kind: str, label: str) -> str:
    """The text at a node, in mathtext."""
    if kind in ("1", "MTF"):
        caption = CAPTIONS.get(name, label.removeprefix("1: "))
        return rf"$\mathbf{{{kind}}}$" + "\n" + caption
    _, _, law = label.strip().partition(": ")
    law = re.sub(r"_(\w+)", r"_{\1}", law).replace("^-1", "^{-1}").replace("slip", r"\mathrm{slip}")
    return rf"$\mathbf{{{kind[0]}}}" + (f"_{kind[1]}" if kind[1:] else "") + f": {law}$"


def bond(axes: Axes, tail: Array, head: Array, sizes: tuple[Array, Array], activated: bool) -> None:
    """A bond between two boxes of half `sizes`: half arrow for power, dashed with a full arrow for a signal."""
    path = np.array([tail, [SIGNAL_X, tail[1]], [SIGNAL_X, head[1]], head]) if activated else np.array([tail, head])
    for end, inner, size in ((0, 1, sizes[0]), (-1, -2, sizes[1])):
        way = path[inner] - path[end]
        path[end] = path[end] + way * np.min(size / np.maximum(np.abs(way), 1e-9))
    style = {"color": INK, "lw": 1.2, "solid_capstyle": "butt"}
    axes.plot(*path.T, **style, ls=(0, (4, 3)) if activated else "-")
    along = (path[-1] - path[-2]) / np.linalg.norm(path[-1] - path[-2])
    across = np.array([-along[1], along[0]])
    for side in (1, -1) if activated else (1,):
        axes.plot(*np.stack((path[-1], path[-1] - 0.24 * along + 0.13 * side * across), -1), **style)


@rc_context(STYLE)
def multibond_graph(model: SoftGrasp) -> Figure:
    """The model's multibond graph, subsystem by subsystem."""
    graph = graph_of(model)
    figure = new_figure("Multibond graph of disc, pads, bracket and controllers (paper: Fig. 9)", 9.2, 10.6)
    axes = figure.subplots()
    for i, (label, (low, high)) in enumerate(BANDS.items()):
        axes.axhspan(low, high, color="#f4f4f1" if i % 2 else "#e9ebee", lw=0)
        axes.text(-3.4, 0.5 * (low + high), label, va="center", ha="left", fontsize=10, weight="bold", color="#555555")
    at, half = positions(graph), {}
    for name, data in graph.nodes(data=True):
        hub = data["kind"] in ("1", "MTF")
        text = node_text(name, data["kind"], data["label"])
        letters = len(text.split("\n")[1]) if hub else len(data["label"].strip().replace("_", "").replace("^", ""))
        half[name] = np.array([0.075 * letters + 0.14, 0.36 if hub else 0.22])
        x, y = at[name]
        axes.text(x, y, text, ha="center", va="center", color=KINDS[data["kind"]][1], fontsize=9 if hub else 11)
    for tail, head, data in graph.edges(data=True):
        bond(axes, at[tail], at[head], (half[tail], half[head]), data["activated"])
    low, high = min(b[0] for b in BANDS.values()), max(b[1] for b in BANDS.values())
    axes.set(xlim=(-3.6, SIGNAL_X + 0.5), ylim=(low, high))
    axes.set_aspect("equal")
    axes.set_axis_off()
    keys = [Line2D([], [], ls="", marker="s", color=colour, label=meaning) for meaning, colour in KINDS.values()]
    keys += [Line2D([], [], color=INK, lw=1.2, label="bond, half arrow towards positive power")]
    keys += [Line2D([], [], color=INK, lw=1.2, ls=(0, (4, 3)), label="activated bond: information only")]
    figure.legend(handles=keys, loc="outside lower left", ncols=3)
    return figure
