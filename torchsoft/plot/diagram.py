"""The multibond graph of the whole system as a drawing (the paper's Fig. 9), from
`multibond.topology` of the rig's own ports, so that it shows the simulated equations of any rig."""

import re

import networkx as nx
import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchsoft.physics.mesh import Array
from torchsoft.physics.multibond import topology
from torchsoft.physics.rig import Rig
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

SPACING, LAYER = 6.4, 3.4
"""Distances between hubs, along and across layers."""

DASHES = "-", (0, (4, 3))
"""Line styles of bonds of power and of signals."""

STEP, RADIUS = 13.0, 3.0
"""Step [deg] and radius of the fan of a hub's elements."""


def graph_of(rig: Rig) -> nx.DiGraph:
    """The topology of the rig's ports. It does not depend on the state; here bodies are a kilometre
    apart."""
    with torch.no_grad():
        signals = torch.zeros(len(rig.signals), 2, dtype=torch.float64)
        state = rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64), signals)
        pose = {
            name: torch.tensor([0.0, 1e3 * (k + 1), 0.0]).double()
            for k, name in enumerate(rig.bodies)
        }
        return topology(rig.evaluate(0.0, state._replace(pose=pose), signals).ports, rig.junctions)


def is_hub(kind: str) -> bool:
    """Whether a node joins bonds: a junction or a transformer, not an element."""
    return kind in ("1", "MTF")


def positions(graph: nx.DiGraph) -> dict[str, Array]:
    """Position of every node: junctions and transformers in layers, by their distance from the
    bodies in contact in bonds, with what else pushes these bodies above them; elements in a fan to
    the right of their hub."""
    bonds = nx.Graph((a, b) for a, b, signal in graph.edges(data="activated") if not signal)
    hubs = bonds.copy()
    hubs.remove_nodes_from([name for name in bonds if not is_hub(graph.nodes[name]["kind"])])
    names = list(hubs)
    contacts = [name for name in names if name.startswith("contact_")]
    bodies = {n for name in contacts for n in hubs[name] if not n.startswith("pad_")}
    distance = nx.multi_source_dijkstra_path_length(hubs, bodies or set(hubs))
    numbered = nx.convert_node_labels_to_integers(hubs)  # the order of names in sets varies
    order = [names[i] for i in nx.spectral_ordering(numbered, seed=0)]
    if contacts and order.index(contacts[0]) > order.index(contacts[-1]):
        order.reverse()
    layers: dict[float, list[str]] = {}
    for name in order:
        below = distance.get(name, 0)
        layers.setdefault(1 if below == 1 and name not in contacts else -below, []).append(name)
    widest = max(len(layers), *map(len, layers.values())) - 1
    placed = nx.multipartite_layout(hubs, layers, align="horizontal", scale=0.5 * widest)
    at = {name: place * [SPACING, LAYER] for name, place in placed.items()}
    for hub in hubs:
        own = [name for name in bonds[hub] if name not in hubs]
        for i, name in enumerate(own):
            turn = np.deg2rad(STEP * (min(0.5 * (len(own) - 1), 0.5) - i))
            at[name] = at[hub] + RADIUS * np.array([np.cos(turn), np.sin(turn)])
    return at


def node_text(name: str, kind: str, label: str) -> str:
    """Text of a node in mathtext."""
    if is_hub(kind):
        caption = label.removeprefix("1: ").replace("_", " ")
        return rf"$\mathbf{{{kind}}}$" + "\n" + caption
    _, _, law = label.strip().partition(": ")
    if name.startswith("contact_"):  # the contact's name stands at its hub
        law = re.sub(
            r"[_,]" + re.escape(name.partition(":")[0].removeprefix("contact_")) + "$", "", law
        )
    law = re.sub(
        r"_(.+?)(?=\]|\^| g$|$)",
        lambda m: "_{" + m[1].replace("_", r"\_").replace(" ", r"\ ") + "}",
        law,
    )
    law = (
        law.replace("^-1", "^{-1}")
        .replace("slip", r"\mathrm{slip}")
        .replace("drive", r"\mathrm{drive}")
    )
    return rf"$\mathbf{{{kind[0]}}}" + (f"_{kind[1]}" if kind[1:] else "") + f": {law}$"


def signal_path(tail: Array, head: Array, side: float, rank: int) -> Array:
    """Way of a signal (points, 2) around the drawing, whose left end is at `side`, and clear of
    signals of another `rank`."""
    far, over, under = side - 0.4 * rank, tail[1] + 1 + 0.2 * rank, head[1] - 1 - 0.2 * rank
    return np.array(
        [tail, (tail[0] - 0.4, over), (far, over), (far, under), (head[0], under), head]
    )


def bond(axes: Axes, path: Array, sizes: tuple[Array, Array], activated: bool) -> None:
    """Draw a bond along a path (points, 2) between two boxes of half `sizes`: solid with a half
    arrow for power; dashed with a full arrow for a signal."""
    for end, inner, size in ((0, 1, sizes[0]), (-1, -2, sizes[1])):
        way = path[inner] - path[end]
        path[end] = path[end] + way * np.min(size / np.maximum(np.abs(way), 1e-9))
    style = {"color": INK, "lw": 1.2, "solid_capstyle": "butt"}
    axes.plot(*path.T, **style, ls=DASHES[activated])
    along = (path[-1] - path[-2]) / np.linalg.norm(path[-1] - path[-2])
    across = np.array([-along[1], along[0]])
    for side in (1, -1) if activated else (1,):
        axes.plot(
            *np.stack((path[-1], path[-1] - 0.24 * along + 0.13 * side * across), -1), **style
        )


@rc_context(STYLE)
def multibond_graph(rig: Rig) -> Figure:
    """The rig's multibond graph, as the paper's Fig. 9 is: solid bonds for power, dashed ones for
    signals."""
    graph = graph_of(rig)
    at, half = positions(graph), {}
    every = np.stack(list(at.values()))
    (left, low), (right, high) = every.min(0) - (1.6, 1.2), every.max(0) + (1.6, 1.0)
    signals = list(dict.fromkeys(a for a, _, signal in graph.edges(data="activated") if signal))
    side, left = left, left - 0.4 * len(signals)
    width, height = max(0.55 * (right - left), 7.4), 0.52 * (high - low) + 1.4
    figure = new_figure(
        "Multibond graph of bodies, pads, contacts and actuators (paper: Fig. 9)", width, height
    )
    axes = figure.subplots()
    for name, data in graph.nodes(data=True):
        hub = is_hub(data["kind"])
        text = node_text(name, data["kind"], data["label"])
        letters = len(re.sub(r"\\[a-z]+|[{}$^_\\]", "", text.split("\n")[-1]))
        half[name] = np.array([0.075 * letters + 0.14, 0.36 if hub else 0.22])
        x, y = at[name]
        white = {"facecolor": "white", "edgecolor": "none", "pad": 1}
        style = {"color": KINDS[data["kind"]][1], "fontsize": 9 if hub else 11, "bbox": white}
        axes.text(x, y, text, ha="center", va="center", **style)
    for tail, head, data in graph.edges(data=True):
        path = np.array([at[tail], at[head]])
        if data["activated"]:
            path = signal_path(at[tail], at[head], side, signals.index(tail))
        bond(axes, path, (half[tail], half[head]), data["activated"])
    axes.set(xlim=(left, right), ylim=(low, high))
    axes.set_aspect("equal")
    axes.set_axis_off()
    keys = [
        Line2D([], [], ls="", marker="s", color=colour, label=meaning)
        for meaning, colour in KINDS.values()
    ]
    for activated, meaning in enumerate(
        ("bond, half arrow towards positive power", "activated bond: information only")
    ):
        keys.append(Line2D([], [], color=INK, lw=1.2, ls=DASHES[activated], label=meaning))
    figure.legend(handles=keys, loc="outside lower left", ncols=3)
    return figure
