"""Machine code of physical laws that are written as torch functions: value, Jacobian, and
derivatives by the parameters along a direction (push) and of weighted outputs (pull).

`compile_law` runs the function once, records its scalar expressions, differentiates them and
compiles all four. `torchsoft.solve.kernel.invoke` calls the result from kernels.
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsoft.codegen import emit
from torchsoft.codegen.graph import ScalarGraph, adjoints, dependent, jacobian
from torchsoft.codegen.trace import Trace, UnknownOperation, check_backward, traced

__all__ = ["Law", "UnknownOperation", "compile_law"]


@dataclass(frozen=True)
class Law:
    """A compiled law; the addresses stay valid until the process ends, and mean nothing in another
    process.

    value: void(x, p, out), linearise: void(x, p, out, J), push: void(x, p, d, out_d), pull: void(x,
    p, w, p_bar), all arguments double*: x (inputs,), p (parameters,), out (outputs,), J (linear,
    differentiated) by rows, d (parameters,), out_d (linear,) = Σ d[j]·∂out[o]/∂p[j], w (linear,),
    and p_bar (parameters,), to which Σ w[o]·∂out[o]/∂p[j] is added.
    """

    parameters: int
    outputs: int
    linear: int
    differentiated: int
    value: int
    linearise: int
    push: int
    pull: int


def compile_law(
    function: Callable[[Tensor, dict[str, Tensor]], Tensor],
    x: Tensor,
    parameters: Mapping[str, Tensor],
    *,
    linear: int | None = None,
    differentiated: int | None = None,
    conjugates: int | None = None,
    lanes: int = 1,
    kind: type[Trace] = Trace,
) -> Law:
    """Compile function(x, parameters), which gives an (outputs,) float64 tensor for x (inputs,) and
    float64 parameters.

    The values of `x` and `parameters` are examples: the code holds for all values, since a function
    that reads them is refused. Every other tensor that the function uses is a constant. The flat
    parameter vector is the parameters' entries in the order of the mapping. The first `linear`
    outputs are differentiated, in all parameters and in the first `differentiated` inputs; None
    stands for all.

    With `conjugates` = n the function gives an energy of the first n inputs, displacements, and a
    dissipation potential of these and of the n inputs after them, their rates; the law's outputs
    are then the n forces, each the derivative of the energy by a displacement plus that of the
    potential by its rate, and the power that the rates take out.

    Raises UnknownOperation (a TypeError) naming the line of the function that cannot be compiled,
    and TypeError or ValueError for arguments or results of another kind.
    """
    _check(x, parameters)
    check_backward(function, x, parameters)
    graph = ScalarGraph()
    outputs = traced(graph, function, x, parameters, kind=kind)
    elsewhere = {name: 0.9 * tensor.detach() + 0.01 for name, tensor in parameters.items()}
    if traced(graph, function, 0.9 * x.detach() + 0.01, elsewhere, kind=kind) != outputs:
        raise UnknownOperation(
            "The law gives other expressions at other values, so it reads a tensor outside torch "
            "or keeps a state."
        )
    if conjugates is not None:
        outputs = _forces(graph, outputs, conjugates)
    linear = _count("linear", linear, len(outputs))
    differentiated = _count("differentiated", differentiated, x.numel())
    count = sum(tensor.numel() for tensor in parameters.values())
    functions = _functions(graph, outputs, linear, differentiated, count, lanes)
    engine = emit.compiled(functions)
    names = ("value", "linearise", "push", "pull")
    addresses = [engine.get_function_address(name) for name in names]
    return Law(count, len(outputs), linear, differentiated, *addresses)


def _forces(g: ScalarGraph, potentials: list[int], n: int) -> list[int]:
    """Forces (n,) and power of an energy and a dissipation potential."""
    energy, potential = potentials
    u, rate = ([g.leaf("x", first + i) for i in range(n)] for first in (0, n))
    elastic = adjoints(g, {energy: g.one}, {}, dependent(g, u), u)
    viscous = adjoints(g, {potential: g.one}, {}, dependent(g, rate), rate)
    power = g.total(g("mul", v, force) for v, force in zip(rate, viscous))
    return [*(g("add", *both) for both in zip(elastic, viscous)), power]


def _functions(
    g: ScalarGraph,
    outputs: list[int],
    linear: int,
    differentiated: int,
    parameters: int,
    lanes: int,
) -> list[str]:
    """IR of the entry points of a law."""
    x = [g.leaf("x", i) for i in range(differentiated)]
    J = itertools.chain.from_iterable(jacobian(g, outputs[:linear], x))
    p, p_bar = _pulled(g, outputs[:linear], parameters)
    return [
        emit.function(g, "value", ("x", "p", "out"), {"out": outputs}, lanes=lanes),
        emit.function(
            g, "linearise", ("x", "p", "out", "J"), {"out": outputs, "J": J}, lanes=lanes
        ),
        _push(g, outputs[:linear], p, p_bar, lanes),
        emit.function(g, "pull", ("x", "p", "w", "p_bar"), {}, {"p_bar": zip(p, p_bar)}, lanes),
    ]


def _pulled(g: ScalarGraph, outputs: list[int], parameters: int) -> tuple[list[int], list[int]]:
    """The parameters, with look-ups of them, and their cotangents under weights of the outputs."""
    p = [g.leaf("p", j) for j in range(parameters)]
    seeds: dict[int, int] = {}
    for o, node in enumerate(outputs):
        weight = g.leaf("w", o)
        seeds[node] = g("add", seeds[node], weight) if node in seeds else weight
    lookups = [
        node for node, op in enumerate(g.ops) if op == "lookup"
    ]  # of parameters: known when it runs of which
    return p + lookups, adjoints(g, seeds, {}, dependent(g, p + lookups), p + lookups)


def _push(g: ScalarGraph, outputs: list[int], p: list[int], p_bar: list[int], lanes: int) -> str:
    """IR of the push: the pull is linear in its weights, and its derivative by them transposed is
    the push."""
    seeds: dict[int, int] = {}
    for node, bar in zip(p, p_bar):
        direction = g.direction(node)
        seeds[bar] = g("add", seeds[bar], direction) if bar in seeds else direction
    w = [g.leaf("w", o) for o in range(len(outputs))]
    along = adjoints(g, seeds, {}, dependent(g, w), w)
    return emit.function(g, "push", ("x", "p", "d", "out"), {"out": along}, lanes=lanes)


def _count(name: str, count: int | None, available: int) -> int:
    if count is not None and not 0 <= count <= available:
        raise ValueError(f"{name} must be from 0 to {available}, not {count}")
    return available if count is None else count


def _check(x: Tensor, parameters: Mapping[str, Tensor]) -> None:
    if x.ndim != 1:
        raise ValueError(f"the inputs of a law must be a 1-D tensor, not of shape {tuple(x.shape)}")
    for name, tensor in {**parameters, "x": x}.items():
        if tensor.dtype != torch.float64:
            raise TypeError(f"{name} must be float64, not {tensor.dtype}")
