"""The multibond graph of the whole system as a drawing (the paper's Fig. 9) and as Graphviz text.

Both come from `multibond.topology` of the rig's own ports, so they show the simulated equations of
any rig.
"""

import re
from collections.abc import Mapping

import networkx as nx
import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchsoft.physics.mesh import Array
from torchsoft.physics.multibond import to_dot, topology
from torchsoft.physics.names import GROUND
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

BANDS = {
    "lower pad": (0.0, 2.7),
    "lower contact\ninterface": (2.7, 5.7),
    "disc": (5.7, 7.9),
    "upper contact\ninterface": (7.9, 10.9),
    "upper pad": (10.9, 13.1),
    "bracket": (13.1, 14.9),
    "controllers": (14.9, 17.6),
}
"""Subsystems of the paper's rig, with their least and largest y in the drawing."""

Hub = tuple[float, float, float, float, float]
"""x and y; angle and step [deg] and radius of the fan of its elements."""

HUBS: dict[str, Hub] = {  # of the paper's rig
    "ground": (1.2, 1.8, 180, 0, 2.1),
    "pad_L: field": (4.2, 1.8, 270, 76, 1.45),
    "pad_L": (7.6, 1.8, 0, 0, 2.6),
    "contact_L": (7.6, 4.2, 0, 13, 3.0),
    "disc_spin": (4.2, 6.8, 180, 0, 2.4),
    "disc": (7.6, 6.8, 17, 0, 2.6),
    "weight_disc": (9.7, 6.2, 0, 0, 1.9),
    "contact_U": (7.6, 9.4, 0, 13, 3.0),
    "pad_U": (7.6, 12.0, 0, 0, 2.6),
    "pad_U: field": (4.2, 12.0, 180, 30, 2.5),
    "bracket_spin": (4.2, 14.0, 180, 0, 2.5),
    "bracket": (7.6, 14.0, 0, 0, 2.6),
    "control_y": (5.6, 15.6, 90, 46, 1.6),
    "control_x": (9.8, 15.6, 90, 70, 1.6),
}

CAPTIONS = {  # of the paper's rig
    "pad_L": "lower pad nodes",
    "pad_U": "upper pad nodes",
    "contact_L": "contact frame",
    "contact_U": "contact frame",
    "pad_L: field": "strain rate",
    "pad_U: field": "strain rate",
    "weight_disc": "gravity",
    "control_x": "horizontal PD",
    "control_y": "vertical PD",
}

SPACING, LAYER = 6.4, 3.4
"""Distances between the hubs of any other rig, along and across its layers."""

FANS = ((270, 76, 1.5), (0, 30, 2.4), (0, 13, 3.0), (0, 30, 2.2), (90, 46, 1.6))
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
    """Place of every junction and transformer: `HUBS` for the paper's rig, else layer by layer from
    the ground to the actuators."""
    hubs = [name for name, data in graph.nodes(data=True) if is_hub(data["kind"])]
    if set(hubs) == set(HUBS):
        return HUBS
    layers: list[list[str]] = [[] for _ in range(5)]
    for name in hubs:
        pad, source = name.startswith("pad_"), name.startswith(("weight_", "control_"))
        field = name == GROUND or name.endswith(": field")
        layers[
            0 if field else 1 if pad else 2 if name.startswith("contact_") else 4 if source else 3
        ].append(name)
    x = {name: float(i) for layer in layers for i, name in enumerate(layer)}

    def near(name: str) -> float:
        """Mean place of a hub's neighbours; a body and its spin stay side by side."""
        pair = {name, name.removesuffix("_spin"), f"{name}_spin"} & set(graph)
        own = [
            x[n] for one in pair for n in nx.all_neighbors(graph, one) if n in x and n not in pair
        ]
        return sum(own) / len(own) if own else 0.0

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


def node_text(name: str, kind: str, label: str, captions: Mapping[str, str]) -> str:
    """Text of a node in mathtext; `captions` replace names of the rig."""
    if is_hub(kind):
        caption = captions.get(name, label.removeprefix("1: ").replace("_", " "))
        return rf"$\mathbf{{{kind}}}$" + "\n" + caption
    _, _, law = label.strip().partition(": ")
    if name.startswith("contact_") and not captions:  # the contact's name stands at its hub
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


def bond(
    axes: Axes, tail: Array, head: Array, sizes: tuple[Array, Array], signal_x: float | None
) -> None:
    """Draw a bond between two boxes of half `sizes`: solid with a half arrow for power; dashed with
    a full arrow, by way of x = `signal_x`, for a signal."""
    activated = signal_x is not None
    path = (
        np.array([tail, [signal_x, tail[1]], [signal_x, head[1]], head])
        if activated
        else np.array([tail, head])
    )
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
    """The rig's multibond graph; the paper's rig is drawn by subsystems."""
    graph = graph_of(rig)
    at, half, papers = positions(graph), {}, hubs_of(graph) is HUBS
    every = np.stack(list(at.values()))
    signal_x = every[:, 0].max() + (1.6 if papers else 1.2)
    low, high = (0.0, 17.6) if papers else (every[:, 1].min() - 1.0, every[:, 1].max() + 1.0)
    left = -3.6 if papers else every[:, 0].min() - 1.6
    width, height = 0.55 * (signal_x - left) + 0.1, 0.52 * (high - low) + 1.4
    figure = new_figure(
        "Multibond graph of bodies, pads, contacts and actuators (paper: Fig. 9)", width, height
    )
    axes = figure.subplots()
    for i, (label, band) in enumerate(BANDS.items() if papers else ()):
        axes.axhspan(*band, color="#f4f4f1" if i % 2 else "#e9ebee", lw=0)
        axes.text(
            -3.4,
            0.5 * sum(band),
            label,
            va="center",
            ha="left",
            fontsize=10,
            weight="bold",
            color="#555555",
        )
    for name, data in graph.nodes(data=True):
        hub = is_hub(data["kind"])
        text = node_text(name, data["kind"], data["label"], CAPTIONS if papers else {})
        letters = len(re.sub(r"\\[a-z]+|[{}$^_\\]", "", text.split("\n")[-1]))
        half[name] = np.array([0.075 * letters + 0.14, 0.36 if hub else 0.22])
        x, y = at[name]
        white = None if papers else {"facecolor": "white", "edgecolor": "none", "pad": 1}
        style = {"color": KINDS[data["kind"]][1], "fontsize": 9 if hub else 11, "bbox": white}
        axes.text(x, y, text, ha="center", va="center", **style)
    for tail, head, data in graph.edges(data=True):
        bond(
            axes,
            at[tail],
            at[head],
            (half[tail], half[head]),
            signal_x if data["activated"] else None,
        )
    axes.set(xlim=(left, signal_x + 0.5), ylim=(low, high))
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
