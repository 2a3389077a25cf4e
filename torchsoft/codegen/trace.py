"""One run of a torch function, recorded as scalar expressions."""

import inspect
import linecache
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.codegen.graph import ScalarGraph
from torchsoft.codegen.operations import (
    COMPOSED,
    CONSTANT,
    ELEMENTWISE,
    MOVES,
    READS,
    WHOLE,
    Nodes,
    mapped,
)

try:
    from torch.overrides import TorchFunctionMode
    from torch.utils._python_dispatch import TorchDispatchMode
    from torch.utils._pytree import tree_leaves, tree_map
except ImportError as error:
    raise ImportError(
        f"torch {torch.__version__} has no torch.utils._python_dispatch.TorchDispatchMode, "
        "with which laws are read: install another version of torch."
    ) from error

_SKIPPED = tuple(os.path.dirname(str(file)) + os.sep for file in (torch.__file__, __file__))
_BRANCH = "use torch.where in place of a Python branch, and torch.stack in place of torch.tensor"
_PYTHON_READS = {torch.tensor, torch.as_tensor, Tensor.tolist, Tensor.numpy, Tensor.__array__}
_BITWISE = {"bitwise_and", "bitwise_or", "bitwise_xor", "bitwise_not"}  # no rule for whole numbers


class UnknownOperation(TypeError):
    """The law does something that has no meaning as an expression of its inputs; the sentence names
    the operation and its place."""


def source_line() -> str:
    """The innermost line outside torch and this package, and its source."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_SKIPPED):
        frame = frame.f_back
    file, line = frame.f_code.co_filename, frame.f_lineno
    return f"{file}:{line}, `{linecache.getline(file, line, frame.f_globals).strip()}`"


class _Reads(TorchFunctionMode):
    """Refuses the functions that copy a symbolic tensor's memory without asking the dispatcher."""

    def __init__(self, trace: "Trace") -> None:
        super().__init__()
        self.trace = trace

    def __torch_function__(
        self, func: Any, types: Any, args: tuple = (), kwargs: Any = None
    ) -> Any:
        if func in _PYTHON_READS and self.trace.holds((args, kwargs)):
            raise self.trace.refused(f"reading a value into Python ({func.__name__})", _BRANCH)
        return func(*args, **(kwargs or {}))


class Trace(TorchDispatchMode):
    """Runs every operation and, where it depends on a symbolic tensor, records each entry of the
    result: without derivatives where torch records none, as under torch.no_grad()."""

    def __init__(self, graph: ScalarGraph) -> None:
        super().__init__()
        self.graph = graph
        self._nodes: dict[
            int, tuple[Tensor, Nodes]
        ] = {}  # the tensors are held, so no id is used twice
        self.refusal: UnknownOperation | None = None

    def refused(self, cause: str, remedy: str) -> UnknownOperation:
        """Error for an operation. It is kept, since torch's operators swallow a TypeError and
        report another."""
        self.refusal = UnknownOperation(
            f"The law cannot be compiled because of {cause} at {source_line()}; {remedy}."
        )
        return self.refusal

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Do not import torch's compiler, which takes a second and is not used here."""
        return False

    def register(self, tensor: Tensor, nodes: Nodes) -> None:
        """Make `tensor` symbolic: entry i is nodes[i]."""
        self._nodes[id(tensor)] = (tensor, nodes)

    def holds(self, values: Any) -> bool:
        """Whether a symbolic tensor is among the values."""
        return any(id(leaf) in self._nodes for leaf in tree_leaves(values))

    def nodes(self, tensor: Tensor) -> Nodes:
        """The nodes of a tensor's entries; constants where it is not symbolic."""
        if id(tensor) in self._nodes:
            return self._nodes[id(tensor)][1]
        if tensor.dtype not in (torch.float64, torch.bool, torch.int64):
            raise self.refused(f"a constant of {tensor.dtype}", "make it float64")
        return mapped(self.graph.constant, tensor.detach().numpy())

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        name = func._schema.name.partition("::")[2]
        if torch.Tag.nondeterministic_seeded in func.tags:
            raise self.refused(
                f"the random operation {func}", "give random numbers as inputs or parameters"
            )
        for leaf in tree_leaves((args, kwargs)):
            if (
                isinstance(leaf, Tensor)
                and leaf.requires_grad
                and id(leaf) not in self._nodes
                and name != "detach"
            ):
                raise self.refused(
                    "a tensor that requires a gradient and is no parameter of the law",
                    "make it an nn.Parameter of the law's module, or detach it",
                )
        if not self.holds((args, kwargs)) or name in CONSTANT:
            return func(*args, **kwargs)
        if name in READS:
            raise self.refused(f"reading a value into Python ({func})", _BRANCH)
        if func._schema.is_mutable and name not in MOVES:
            raise self.refused(
                f"the in-place operation {func}", "make a new tensor, for example by torch.stack"
            )
        whole = any(
            isinstance(x, Tensor) and x.dtype == torch.int64 for x in tree_leaves((args, kwargs))
        )
        if not any(name in table for table in (MOVES, WHOLE, ELEMENTWISE, COMPOSED)) or (
            whole and name in _BITWISE
        ):
            raise self.refused(
                f"the operation {func}", "it has no rule, so write it with other operations"
            )
        try:
            if name in COMPOSED:
                with self:
                    return COMPOSED[name](*args, **kwargs)
            nodes = self._recorded(name, func, args, kwargs)
        except UnknownOperation:
            raise
        except TypeError as error:
            raise self.refused(
                f"the operation {func} ({error})",
                "it has no rule, so write it with other operations",
            ) from error
        result = func(*args, **kwargs)
        for tensor, entries in zip(tree_leaves(result), tree_leaves(nodes), strict=True):
            self._keep(func, tensor, entries)
        return result

    def _keep(self, func: Any, tensor: Tensor, nodes: Any) -> None:
        if tensor.dtype not in (torch.float64, torch.bool, torch.int64):
            raise self.refused(
                f"the operation {func} with a result of {tensor.dtype}",
                "keep all numbers in float64",
            )
        typed = self.graph.truth if tensor.dtype == torch.bool else self.graph.number
        nodes = mapped(typed, np.asarray(nodes))
        if nodes.shape != tuple(tensor.shape):
            raise RuntimeError(
                f"the rule of {func} gives shape {nodes.shape}, torch {tuple(tensor.shape)}"
            )
        if tensor.dtype == torch.float64 and not torch.is_grad_enabled():
            nodes = self.stopped(nodes)
        self.register(tensor, nodes)

    def stopped(self, nodes: Nodes) -> Nodes:
        """The same values without derivatives."""
        g = self.graph
        return mapped(lambda node: node if g.ops[node] == "stop" else g("stop", node), nodes)

    def _recorded(self, name: str, func: Any, args: tuple, kwargs: Mapping[str, Any]) -> Any:
        if name in MOVES:
            if self.holds((args[1:], kwargs)):
                remedy = (
                    "use torch.where, or torch.nn.functional.embedding to look up rows of a "
                    "parameter"
                )
                raise self.refused(f"{func} at places that depend on values", remedy)
            place = lambda t: (
                torch.from_numpy(np.array(self.nodes(t))) if isinstance(t, Tensor) else t
            )
            return func(tree_map(place, args[0]), *args[1:], **kwargs)
        if name in WHOLE:
            whole = lambda t: self.nodes(t) if isinstance(t, Tensor) else t
            return WHOLE[name](
                self.graph, *map(whole, args), **{k: whole(v) for k, v in kwargs.items()}
            )
        return self._elementwise(ELEMENTWISE[name], args, kwargs)

    def _elementwise(
        self, rule: Callable[..., int], args: tuple, kwargs: Mapping[str, Any]
    ) -> Nodes:
        """The rule on every entry: tensors and numbers are broadcast, all other arguments are
        passed on."""
        values = [*args, *kwargs.values()]
        arrays = [self.nodes(v) if isinstance(v, Tensor) else self._constant(v) for v in values]
        entries = [i for i, array in enumerate(arrays) if array is not None]

        given = [array for array in arrays if array is not None]
        if len(given) == len(args) == len(values):
            return mapped(partial(rule, self.graph), *given)

        def one(*nodes: int) -> int:
            filled = list(values)
            for i, node in zip(entries, nodes):
                filled[i] = node
            return rule(self.graph, *filled[: len(args)], **dict(zip(kwargs, filled[len(args) :])))

        return mapped(one, *given)

    def _constant(self, value: Any) -> Nodes | None:
        return (
            np.asarray(self.graph.constant(value))
            if isinstance(value, bool | int | float)
            else None
        )


def traced(
    graph: ScalarGraph,
    function: Callable[[Tensor, dict[str, Tensor]], Tensor],
    x: Tensor,
    parameters: Mapping[str, Tensor],
    first: int = 0,
    kind: type[Trace] = Trace,
) -> list[int]:
    """The nodes of function(x, parameters), an (outputs,) float64 tensor, from one run at these
    values.

    Entry i of x is the leaf `first` + i. Raises UnknownOperation for an operation that cannot be
    recorded, and TypeError for a result of another kind.
    """
    trace = kind(graph)
    x = x.detach().clone()
    copies = {name: tensor.detach().clone() for name, tensor in parameters.items()}
    trace.register(x, mapped(partial(graph.leaf, "x"), first + np.arange(x.numel())))
    start = 0
    for tensor in copies.values():
        index = np.arange(start, start + tensor.numel()).reshape(tuple(tensor.shape))
        trace.register(tensor, mapped(partial(graph.leaf, "p"), index))
        start += tensor.numel()
    out = None
    try:
        with torch.enable_grad(), _Reads(trace), trace:
            out = function(x, copies)
    except Exception:
        if trace.refusal is None:
            raise
    if trace.refusal is not None:
        raise trace.refusal
    if not isinstance(out, Tensor) or out.ndim != 1 or out.dtype != torch.float64:
        given = (
            f"{out.dtype} of shape {tuple(out.shape)}"
            if isinstance(out, Tensor)
            else type(out).__name__
        )
        raise TypeError(f"a law must return a 1-D float64 tensor, not {given}")
    return trace.nodes(out).tolist()


def check_backward(
    function: Callable[[Tensor, dict[str, Tensor]], Tensor],
    x: Tensor,
    parameters: Mapping[str, Tensor],
) -> None:
    """Raises UnknownOperation for a law that applies a torch.autograd.Function of its own: a node
    of the graph of its result that Python made. A law that fails otherwise is left to `traced`."""
    given = {name: tensor.detach().clone().requires_grad_() for name, tensor in parameters.items()}
    try:
        with torch.enable_grad():
            out = function(x.detach().clone().requires_grad_(), given)
    except Exception:
        return
    found, seen = [one.grad_fn for one in tree_leaves(out) if isinstance(one, Tensor)], set()
    while found:
        node = found.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        if isinstance(node, torch.autograd.function.FunctionCtx):
            name = node.name().removesuffix("Backward")
            if name == "CompiledFunction":
                raise UnknownOperation(
                    "The law cannot be compiled because torch.compile is around it, or around what "
                    "runs it; leave that out: laws are compiled here, with their derivatives."
                )
            raise UnknownOperation(
                f"The law cannot be compiled because of the torch.autograd.Function {name} at "
                f"{_defined(name)}; its own backward cannot be compiled, so write it with torch's "
                "operations."
            )
        found += [following for following, _ in node.next_functions]


def _defined(name: str) -> str:
    """Line of the definition of a torch.autograd.Function, as far as it can be found."""
    kinds: list[type] = [torch.autograd.Function]
    for kind in kinds:
        kinds += kind.__subclasses__()
    for kind in reversed(kinds):
        with suppress(OSError, TypeError):
            if kind.__name__ == name:
                lines, line = inspect.getsourcelines(kind)
                return f"{inspect.getsourcefile(kind)}:{line}, `{lines[0].strip()}`"
    return "a place that cannot be found"
