"""The multibond graph of the whole system as a drawing (the paper's Fig. 9) and as Graphviz text.

Both come from `multibond.topology` of the rig's own ports, so they show the simulated equations of
any rig.
"""

import re

import networkx as nx
import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchsoft.physics.mesh import Array
from torchsoft.physics.multibond import GROUND, to_dot, topology
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

Hub = tuple[float, float, float, float, float]
"""x and y; angle and step [deg] and radius of the fan of its elements."""

SPACING, LAYER = 6.4, 3.4
"""Distances between hubs, along and across layers."""

FANS = ((270, 76, 1.5), (0, 30, 2.4), (-15, 13, 3.0), (0, 30, 2.2), (90, 46, 1.6))
"""Angle and step [deg] and radius of the fans in each layer: fields, pads, contacts, bodies,
sources."""


def graph_of(rig: Rig) -> nx.DiGraph:
    """The topology of the rig's ports. It does not depend on the state; here bodies are far
    apart."""
    with torch.no_grad():
        signals = torch.zeros(len(rig.signals), 2, dtype=torch.float64)
        state = rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64), signals)
        sizes = [body.shape.size() for body in rig.bodies.values() if body.shape is not None]
        far = 10 * sum((*sizes, *(pad.mesh.length + pad.mesh.height for pad in rig.pads.values())))
        pose = {
            name: torch.tensor([0.0, (k + 1) * far, 0.0]).double()
            for k, name in enumerate(rig.bodies)
        }
        return topology(rig.evaluate(0.0, state._replace(pose=pose), signals).ports, rig.junctions)


def dot(rig: Rig) -> str:
    """Graphviz text of the rig's multibond graph."""
    return to_dot(graph_of(rig))


def is_hub(kind: str) -> bool:
    """Whether a node joins bonds: a junction or a transformer, not an element."""
    return kind in ("1", "MTF")


def hubs_of(graph: nx.DiGraph) -> dict[str, Hub]:
    """Place of every junction and transformer: layer by layer from the ground to the actuators."""
    hubs = [name for name, data in graph.nodes(data=True) if is_hub(data["kind"])]
    layers: list[list[str]] = [[] for _ in range(5)]
    for name in hubs:
        pad, source = name.startswith("pad_"), name.startswith(("weight_", "control_"))
        field = name == GROUND or name.endswith(": field")
        layers[
            0 if field else 1 if pad else 2 if name.startswith("contact_") else 4 if source else 3
        ].append(name)
    x = {name: float(i) for layer in layers for i, name in enumerate(layer)}

    def near(name: str) -> float:
        """Mean place of a hub's neighbours, of all hubs where it has none; a body and its spin stay
        side by side."""
        pair = {name, name.removesuffix("_spin"), f"{name}_spin"} & set(graph)
        own = [
            x[n] for one in pair for n in nx.all_neighbors(graph, one) if n in x and n not in pair
        ]
        own = own or list(x.values())
        return sum(own) / len(own)

    for layer in (*layers, *layers[::-1], *layers):
        targets = {name: near(name) for name in layer}
        layer.sort(key=lambda name, targets=targets: targets[name])
        free = -float("inf")
        for name in layer:
            x[name] = max(targets[name], free)
            free = x[name] + 1
    return {
        name: (SPACING * x[name], LAYER * i, *FANS[i])
        for i, layer in enumerate(layers)
        for name in layer
    }


def positions(graph: nx.DiGraph) -> dict[str, Array]:
    """Position of every node: hubs by `hubs_of`, and elements in a fan around their hub."""
    hubs = hubs_of(graph)
    at = {name: np.array(place[:2]) for name, place in hubs.items()}
    for hub, (_, _, angle, step, radius) in hubs.items():
        own = [n for n in nx.all_neighbors(graph, hub) if n not in hubs]
        for i, name in enumerate(own):
            turn = np.deg2rad(angle + step * (0.5 * (len(own) - 1) - i))
            at[name] = at[hub] + radius * np.array([np.cos(turn), np.sin(turn)])
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


def signal_path(tail: Array, head: Array, rank: int) -> Array:
    """Way of a signal (points, 2): across between two layers, clear of what stands on them and of
    signals of another `rank`."""
    side = 1.0 if head[0] >= tail[0] else -1.0
    level = tail[1] + (0.35 + 0.1 * (rank % 3)) * LAYER
    turns = [tail[0] + side * 1.6, level], [head[0] - side * 1.6, level]
    return np.array([tail, *(turns if abs(head[0] - tail[0]) > SPACING else turns[:1]), head])


def bond(
    axes: Axes, tail: Array, head: Array, sizes: tuple[Array, Array], rank: int | None
) -> None:
    """Draw a bond between two boxes of half `sizes`: solid with a half arrow for power; dashed with
    a full arrow for a signal, which has a `rank`."""
    activated = rank is not None
    path = signal_path(tail, head, rank) if activated else np.array([tail, head])
    for end, inner, size in ((0, 1, sizes[0]), (-1, -2, sizes[1])):
        way = path[inner] - path[end]
        path[end] = path[end] + way * np.min(size / np.maximum(np.abs(way), 1e-9))
    style = {"color": INK, "lw": 1.2, "solid_capstyle": "butt"}
    axes.plot(*path.T, **style, ls=(0, (4, 3)) if activated else "-")
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
    (left, low), (right, high) = every.min(0) - (1.6, 1.0), every.max(0) + (1.6, 1.0)
    width, height = 0.55 * (right - left) + 0.1, 0.52 * (high - low) + 1.4
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
    ranks = dict[str, int]()
    for tail, head, data in graph.edges(data=True):
        rank = ranks.setdefault(tail, len(ranks)) if data["activated"] else None
        bond(axes, at[tail], at[head], (half[tail], half[head]), rank)
    axes.set(xlim=(left, right), ylim=(low, high))
    axes.set_aspect("equal")
    axes.set_axis_off()
    keys = [
        Line2D([], [], ls="", marker="s", color=colour, label=meaning)
        for meaning, colour in KINDS.values()
    ]
    keys += [Line2D([], [], color=INK, lw=1.2, label="bond, half arrow towards positive power")]
    keys += [
        Line2D([], [], color=INK, lw=1.2, ls=(0, (4, 3)), label="activated bond: information only")
    ]
    figure.legend(handles=keys, loc="outside lower left", ncols=3)
    return figure
