"""Derivatives that a law leaves out: where torch was told to record none, by `detach()` or
`torch.no_grad()`, though the value changes."""

import ctypes
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.codegen import Law, compile_law
from torchsoft.codegen.graph import ScalarGraph
from torchsoft.codegen.operations import Nodes
from torchsoft.codegen.trace import Trace, source_line, traced

Function = Callable[[Tensor, dict[str, Tensor]], Tensor]
Array = NDArray[np.float64]

SAME = 1e-6
"""Part of the largest derivative by which two ways to a derivative may differ."""


class Opened(Trace):
    """A trace through what torch records no derivative of, but for the lines that are `shut`;
    `lines` are all of them, in their order."""

    shut: ClassVar[frozenset[str]] = frozenset()
    lines: ClassVar[dict[str, None]] = {}

    def stopped(self, nodes: Nodes) -> Nodes:
        line = source_line()
        self.lines[line] = None
        return super().stopped(nodes) if line in self.shut else nodes

    def _recorded(self, name: str, func: Any, args: tuple, kwargs: Mapping[str, Any]) -> Any:
        if name == "detach":
            return self.stopped(self.nodes(args[0]))
        return super()._recorded(name, func, args, kwargs)


def opened(shut: frozenset[str] = frozenset()) -> type[Opened]:
    return type("Opened", (Opened,), {"shut": shut, "lines": {}})


class LeftOut(NamedTuple):
    """Inputs, by their number, and parameters whose derivatives a law leaves out, and the lines
    that do it."""

    inputs: tuple[int, ...]
    parameters: tuple[str, ...]
    lines: tuple[str, ...]


class Evaluated(NamedTuple):
    """A compiled law at samples: values (samples, outputs), Jacobians (samples, outputs, inputs),
    and derivatives of weighted outputs by the parameters (samples, parameters)."""

    value: Array
    by_input: Array
    by_parameter: Array


def evaluate(law: Law, x: Tensor, parameters: Mapping[str, Tensor], weights: Array) -> Evaluated:
    """A compiled law at samples x (samples, inputs), its outputs weighted by (outputs,) for the
    derivatives by its parameters."""
    flat = [p.detach().reshape(-1) for p in parameters.values()]
    p = torch.cat([torch.zeros(0).double(), *flat]).numpy()
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4)
    linearise, pull = kind(law.linearise), kind(law.pull)
    out = np.zeros((len(x), law.outputs))
    J = np.zeros((len(x), law.linear, law.differentiated))
    p_bar = np.zeros((len(x), law.parameters))
    for k, row in enumerate(x.detach().contiguous().numpy()):
        linearise(*(a.ctypes.data for a in (row, p, out[k], J[k])))
        pull(*(a.ctypes.data for a in (row, p, weights, p_bar[k])))
    return Evaluated(out, J, p_bar)


def left_out(
    function: Function, x: Tensor, parameters: Mapping[str, Tensor], conjugates: int | None = None
) -> LeftOut | None:
    """What function(x, parameters) leaves out of its derivatives at samples x (samples, inputs), by
    the inputs and by the parameters that require a gradient; None where it leaves out nothing. With
    `conjugates`, as `compile_law` has them, of the forces and of their derivatives.

    Raises `UnknownOperation` as `compile_law` does.
    """
    every = opened()
    traced(ScalarGraph(), function, x[0], parameters, kind=every)
    if not every.lines:
        return None

    def made(kind: type[Trace]) -> Evaluated:
        law = compile_law(function, x[0], parameters, kind=kind, conjugates=conjugates)
        return evaluate(law, x, parameters, np.linspace(0.5, 1.7, law.outputs))

    whole, plain = made(opened()), made(Trace)
    by_input = np.asarray(_differ(plain.by_input, whole.by_input).any((0, 1)))
    if conjugates is not None:  # the forces are derivatives themselves
        by_input[:conjugates] |= np.any(_differ(plain.value, whole.value), axis=0)[:conjugates]
    inputs = tuple(np.flatnonzero(by_input).tolist())
    entries = np.any(_differ(plain.by_parameter, whole.by_parameter), axis=0).tolist()
    names, start = list[str](), 0
    for name, p in parameters.items():
        end = start + p.numel()
        if p.requires_grad and any(entries[start:end]):
            names.append(name)
        start = end
    if not inputs and not names:
        return None
    guilty = []
    for line in every.lines:
        alone = made(opened(frozenset({line})))
        pairs = zip(alone, whole)
        if any(_differ(one, other).any() for one, other in pairs):
            guilty.append(line)
    return LeftOut(inputs, tuple(names), tuple(guilty or every.lines))


def _differ(one: Array, other: Array) -> NDArray[np.bool_]:
    """Which derivatives (samples, ...) are not the same."""
    largest = np.maximum(np.abs(one), np.abs(other)).max(axis=0, initial=0.0)
    with np.errstate(invalid="ignore"):
        same = np.abs(one - other) <= SAME * largest
    return np.asarray(~(same | (np.isnan(one) & np.isnan(other))))
