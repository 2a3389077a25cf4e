"""Multibonds: 1-junctions, modulated transformers, ports, and the sums that make equations of
motion of them.

Every I field (or massless body) owns a 1-junction with a flow vector per node. A port is one
multibond: its flow is f = sum_j T_j v_j over the junctions its transformer touches, and the efforts
it sends back are T_j^T e. Because the same T carries flow out and effort back, power is conserved
bond by bond, whatever the moduli.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import networkx as nx
from torch import Tensor

GROUND = "ground"
"""Junction of the ground."""


class Junction(NamedTuple):
    """A 1-junction: how many flow vectors it has, the field that stores or sets its flow, and the
    paper's name."""

    nodes: int
    element: str
    label: str


class Block(NamedTuple):
    """One junction's modulus: matrix (..., bonds or 1, m, width), after an interpolation of the
    junction's nodes at the bonds, interpolation (bonds, nodes); None where bonds are nodes, or the
    junction has a single node."""

    matrix: Tensor
    interpolation: Tensor | None = None


class Transformer:
    """(Modulated) transformer between 1-junctions and a multibond of flows (..., bonds, m)."""

    def __init__(self, blocks: Mapping[str, Block]) -> None:
        self.blocks = dict(blocks)

    def flow(self, flows: Mapping[str, Tensor]) -> Tensor:
        """f = sum_j T_j v_j."""
        total = 0.0
        for name, (matrix, interpolation) in self.blocks.items():
            v = flows[name] if interpolation is None else interpolation @ flows[name]
            total = total + (matrix @ v[..., None])[..., 0]
        assert isinstance(total, Tensor)
        return total

    def effort(self, e: Tensor, junctions: Mapping[str, Junction]) -> dict[str, Tensor]:
        """T_j^T e for every junction j, each shaped like that junction's flow."""
        out = {}
        for name, (matrix, interpolation) in self.blocks.items():
            back = (matrix.mT @ e[..., None])[..., 0]
            if interpolation is not None:
                back = interpolation.mT @ back
            elif junctions[name].nodes == 1:
                back = back.sum(-2, keepdim=True)
            out[name] = back
        return out


@dataclass(frozen=True)
class Port:
    """One multibond: its transformer, its effort (..., bonds, m), and the elements behind it, in
    the paper's names.

    `source` ports (Se) push the junctions, the others load them. `senses` names junctions whose
    flow reaches the element through an activated bond only, without power.
    """

    transformer: Transformer
    effort: Tensor
    elements: tuple[str, ...]
    source: bool = False
    senses: tuple[str, ...] = ()

    def power(self, flows: Mapping[str, Tensor]) -> Tensor:
        """e . f [W], shape (...): into the element, or out of it for a source."""
        return (self.effort * self.transformer.flow(flows)).sum((-2, -1))


def net_efforts(ports: Mapping[str, Port], junctions: Mapping[str, Junction]) -> dict[str, Tensor]:
    """Net effort at every 1-junction, which its I field integrates: sum of +-T^T e over the
    ports."""
    total: dict[str, Tensor] = {}
    for port in ports.values():
        for name, effort in port.transformer.effort(port.effort, junctions).items():
            signed = effort if port.source else -effort
            total[name] = total[name] + signed if name in total else signed
    return total


def topology(ports: Mapping[str, Port], junctions: Mapping[str, Junction]) -> nx.DiGraph:
    """The graph as drawn: junctions, their I fields and sources of flow, transformers, and the
    elements behind each port.

    Node attribute `kind` is one of "1", "MTF", "I", "C", "R", "Se", "Sf"; edge attribute
    `activated` marks signal bonds. A port that shares a junction's name stands under "<name>:
    field".
    """
    graph = nx.DiGraph()
    for name, junction in junctions.items():
        graph.add_node(name, kind="1", label=junction.label)
        if junction.element.startswith(
            "R"
        ):  # a massless pad's flow is set by the R field that its own port shows
            continue
        node, kind = f"{name}: own", junction.element.split(":")[0]
        graph.add_node(node, kind=kind, label=junction.element)
        graph.add_edge(*((node, name) if kind == "Sf" else (name, node)), activated=False)
    for name, port in ports.items():
        hub = f"{name}: field" if name in junctions else name
        graph.add_node(hub, kind="MTF", label=name)
        for junction in port.transformer.blocks:
            graph.add_edge(*((hub, junction) if port.source else (junction, hub)), activated=False)
        for junction in port.senses:
            graph.add_edge(junction, hub, activated=True)
        for element in port.elements:
            node = f"{name}: {element}"
            graph.add_node(node, kind=element.split(":")[0], label=element)
            graph.add_edge(*((node, hub) if port.source else (hub, node)), activated=False)
    return graph


def to_dot(graph: nx.DiGraph) -> str:
    """Graphviz text of `topology`: full arrows for power bonds, dashed ones for activated (signal)
    bonds."""
    lines = ["digraph multibond {", "  rankdir=LR; node [shape=plaintext];"]
    lines += [f'  "{node}" [label="{data["label"]}"];' for node, data in graph.nodes(data=True)]
    for tail, head, data in graph.edges(data=True):
        style = "style=dashed, arrowhead=normal" if data["activated"] else "arrowhead=halfopen"
        lines.append(f'  "{tail}" -> "{head}" [{style}];')
    return "\n".join([*lines, "}"]) + "\n"
