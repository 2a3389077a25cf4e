"""Test that a law is one of a single contact point: several points at once give the same values as
each of them alone."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.codegen.graph import Graph
from torchsoft.codegen.operations import Nodes
from torchsoft.codegen.trace import Trace, UnknownOperation, traced

POINTS = 3
"""Points that are traced side by side."""

REMEDY = (
    "a law is of one point, so leave the points' own dimension alone: mean(-1) of a stack of a "
    "point's numbers is fine"
)


class Watch(Trace):
    """A trace of several points side by side, entry i of x of point i // `size`; refuses operations
    that couple them."""

    size: int

    def __init__(self, graph: Graph) -> None:
        super().__init__(graph)
        self._points: dict[int, frozenset[int]] = {}

    def points(self, node: int) -> frozenset[int]:
        """Points that a node depends on."""
        if node not in self._points:
            own = (self.graph.args[node][0] // self.size,) if self.graph.ops[node] == "x" else ()
            self._points[node] = frozenset(own).union(*map(self.points, self.graph.operands(node)))
        return self._points[node]

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple = (), kwargs: Any = None
    ) -> Any:
        result = super().__torch_dispatch__(func, types, args, kwargs)
        given = args[0] if args else None
        if not isinstance(result, Tensor) or not self.holds(result):
            return result
        after = self._owners(self.nodes(result))
        before = after
        if isinstance(given, Tensor) and given.shape == result.shape and self.holds(given):
            before = self._owners(self.nodes(given))
        if (after == MIXED).any() or _swapped(before, after):
            raise self.refused(f"the operation {func}, which couples contact points", REMEDY)
        return result

    def _owners(self, nodes: Nodes) -> Nodes:
        """Of every entry the point it belongs to, `NONE` or `MIXED`."""
        found = [self.points(int(node)) for node in nodes.flatten()]
        each = [next(iter(one)) if len(one) == 1 else MIXED if one else NONE for one in found]
        return np.array(each, dtype=np.int64).reshape(nodes.shape)


NONE, MIXED = -1, -2


def _swapped(before: Nodes, after: Nodes) -> bool:
    """Whether an entry of one point has become one of another."""
    both = (before >= 0) & (after >= 0)
    return bool((before[both] != after[both]).any())


def check_pointwise(
    function: Callable[[Tensor, dict[str, Tensor]], Tensor],
    x: Tensor,
    parameters: Mapping[str, Tensor],
) -> None:
    """Raises UnknownOperation for function(x, parameters), an (..., outputs) tensor of x (...,
    inputs), whose value at a point depends on other points; names the operation and its line. A law
    that fails otherwise is left to `traced`."""
    graph, size = Graph(), x.numel()
    many = torch.stack([x.detach() * (1 + 0.1 * k) for k in range(POINTS)])

    def parallel_map(flat: Tensor, values: dict[str, Tensor]) -> Tensor:
        return function(flat.unflatten(0, (POINTS, size)), values).flatten()

    watch = type("Watch", (Watch,), {"size": size})
    try:
        together = traced(graph, parallel_map, many.flatten(), parameters, kind=watch)
        alone = [traced(graph, function, row, parameters, k * size) for k, row in enumerate(many)]
    except UnknownOperation as error:
        if "couples contact points" in str(error):
            raise
        return
    except Exception:
        return
    if together == [node for row in alone for node in row]:
        return
    see, each = watch(graph), len(together) // POINTS
    if any(see.points(node) - {i // each} for i, node in enumerate(together)):
        raise UnknownOperation(
            f"The law cannot be compiled because it couples contact points; {REMEDY}."
        )
