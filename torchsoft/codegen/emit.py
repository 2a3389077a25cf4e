"""Machine code of a law's entry points: LLVM IR written as text and compiled by llvmlite's MCJIT.

There is no fast-math flag and no contraction, so a sum or product rounds as torch's does. The
instructions are emitted once each, in the order of the graph, and no optimisation pass runs over
them: shared expressions are shared already.
"""

import ctypes.util
import hashlib
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import llvmlite.binding as llvm
import numpy as np
import torch
from torch import Tensor

from torchsoft.codegen.graph import LEAVES, LOOKUPS, NAMED, ScalarGraph
from torchsoft.codegen.operations import Nodes
from torchsoft.codegen.trace import Trace, UnknownOperation, traced

POINTER = "ptr" if llvm.llvm_version_info[0] >= 17 else "double*"
INSTRUCTIONS = {  # F is the type of a number, B that of a truth value
    "add": "fadd F {}, {}",
    "sub": "fsub F {}, {}",
    "mul": "fmul F {}, {}",
    "div": "fdiv F {}, {}",
    "neg": "fneg F {}",
    "lt": "fcmp olt F {}, {}",
    "le": "fcmp ole F {}, {}",
    "gt": "fcmp ogt F {}, {}",
    "ge": "fcmp oge F {}, {}",
    "eq": "fcmp oeq F {}, {}",
    "ne": "fcmp une F {}, {}",
    "and": "and B {}, {}",
    "or": "or B {}, {}",
    "select": "select B {}, F {}, F {}",
}
FUNCTIONS = {  # one argument, but for pow and atan2
    "abs": "llvm.fabs.f64",
    "sqrt": "llvm.sqrt.f64",
    "floor": "llvm.floor.f64",
    **{
        name: name for name in ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")
    },
    **{name: name for name in ("exp", "expm1", "log", "log1p", "erf", "pow", "atan2")},
}
_engines: dict[str, llvm.ExecutionEngine] = {}


def function(
    g: ScalarGraph, name: str, pointers: Iterable[str], results: Mapping[str, Iterable[int]],
    added: Mapping[str, Iterable[tuple[int, int]]] | None = None, lanes: int = 1,
) -> str:  # fmt: skip
    """IR of void `name`(pointers...), which stores the nodes of `results` where the pointer of that
    name points.

    `added` has pairs of nodes, a parameter or a look-up of one and what is added where it stands
    from that pointer on. With several `lanes` it is the function of as many x and w at once, entry
    by entry side by side, as are the results, and of one p, to which all lanes add.
    """
    body = _Body(g, lanes)
    for letter, nodes in results.items():
        for index, node in enumerate(nodes):
            body.store(letter, index, node)
    for letter, pairs in (added or {}).items():
        for index, (target, node) in enumerate(pairs):
            if g.value(node) != 0.0:
                body.add(letter, index, target, node)
    head = f"define void @{name}({', '.join(f'{POINTER} %{p}' for p in pointers)}) nounwind {{"
    return "\n".join([head, *body.lines, "ret void", "}"])


class _Body:
    """Instructions of a function, with the name of every value that they have made."""

    def __init__(self, g: ScalarGraph, lanes: int) -> None:
        self.g, self.lanes = g, lanes
        self.lines: list[str] = []
        self.text: dict[int, str] = {}
        many = lanes > 1
        self.number, self.truth = (f"<{lanes} x {t}>" if many else t for t in ("double", "i1"))

    def store(self, letter: str, index: int, node: int) -> None:
        """Store a node as entry `index` from the pointer on."""
        self.evaluate(node)
        place, at = f"%{letter}{index}", index * self.lanes
        self.lines += [
            f"{place} = getelementptr double, {POINTER} %{letter}, i64 {at}",
            f"store {self.number} {self.text[node]}, {POINTER} {place}, align 8",
        ]

    def add(self, letter: str, index: int, target: int, node: int) -> None:
        """Add a node, of all lanes, where the target stands from the pointer on."""
        for needed in (node, *self.g.operands(target)):
            self.evaluate(needed)
        operands = [self.text[a] for a in self.g.operands(target)]
        for lane in range(self.lanes):
            place, value, at = f"%{letter}{index}", self.text[node], operands
            if self.lanes > 1:
                place, value = f"{place}.{lane}", self.lane(f"{place}.{lane}.value", value, lane)
                at = [self.lane(f"{place}.at{i}", x, lane) for i, x in enumerate(operands)]
            self.lines += [
                *_address(self.g, target, letter, place, at),
                f"{place}.old = load double, {POINTER} {place}",
                f"{place}.new = fadd double {place}.old, {value}",
                f"store double {place}.new, {POINTER} {place}",
            ]

    def lane(self, name: str, value: str, lane: int) -> str:
        """The number of one lane, under a name."""
        self.lines.append(f"{name} = extractelement {self.number} {value}, i32 {lane}")
        return name

    def evaluate(self, root: int) -> None:
        """Give `root` its value."""
        g, text, pending = self.g, self.text, [root]
        while pending:
            node = pending.pop()
            if node in text:
                continue
            op = g.ops[node]
            needed = g.operands(node)
            missing = [a for a in needed if a not in text]
            if missing:
                pending += [node, *reversed(missing)]
                continue
            if op == "constant":
                text[node] = self.literal(g.args[node][0])
            elif op in NAMED:
                text[node] = text[g.args[node][0]]
            else:
                text[node] = f"%v{node}"
                self.lines += self.instruction(node, [text[a] for a in needed])

    def literal(self, value: float | bool) -> str:
        """A constant in every lane."""
        one, kind = _literal(value), "i1" if isinstance(value, bool) else "double"
        return one if self.lanes == 1 else f"<{', '.join([f'{kind} {one}'] * self.lanes)}>"

    def instruction(self, node: int, operands: list[str]) -> Iterator[str]:
        g, op, v = self.g, self.g.ops[node], f"%v{node}"
        if op in LEAVES:
            at = g.args[node][0]
            if op in ("x", "w") and self.lanes > 1:
                yield f"%a{node} = getelementptr double, {POINTER} %{op}, i64 {at * self.lanes}"
                yield f"{v} = load {self.number}, {POINTER} %a{node}, align 8"
                return
            yield from _address(g, node, op, f"%a{node}", operands)
            one = v if self.lanes == 1 else f"{v}.0"
            yield f"{one} = load double, {POINTER} %a{node}"
            if self.lanes > 1:  # the same in every lane
                yield f"{v}.1 = insertelement {self.number} undef, double {one}, i32 0"
                yield (
                    f"{v} = shufflevector {self.number} {v}.1, {self.number} undef, "
                    f"<{self.lanes} x i32> zeroinitializer"
                )
        elif op in INSTRUCTIONS:
            text = INSTRUCTIONS[op].replace("F", self.number).replace("B", self.truth)
            yield f"{v} = {text.format(*operands)}"
        elif op == "not":
            yield f"{v} = xor {self.truth} {operands[0]}, {self.literal(True)}"
        elif self.lanes == 1:
            yield from self.called(node, v, operands)
        else:  # lane by lane
            before = "undef"
            for lane in range(self.lanes):
                extracted = [f"{v}.{lane}.{i}" for i in range(len(operands))]
                for name, operand in zip(extracted, operands):
                    yield f"{name} = extractelement {self.number} {operand}, i32 {lane}"
                yield from self.called(node, f"{v}.{lane}", extracted)
                after = v if lane == self.lanes - 1 else f"{v}.{lane}.all"
                yield (
                    f"{after} = insertelement {self.number} {before}, double {v}.{lane}, i32 {lane}"
                )
                before = after

    def called(self, node: int, name: str, operands: list[str]) -> Iterator[str]:
        """A function, or a look-up, of single numbers."""
        op = self.g.ops[node]
        if op in LOOKUPS:
            yield from _address(self.g, node, LOOKUPS[op], f"{name}.at", operands)
            yield f"{name} = load double, {POINTER} {name}.at"
        else:
            given = ", ".join("double " + a for a in operands)
            yield f"{name} = call double @{FUNCTIONS[op]}({given})"


def _address(
    g: ScalarGraph, node: int, pointer: str, name: str, operands: list[str]
) -> Iterator[str]:
    """The place of a leaf or a look-up from `pointer` on; a number outside the table, or none, is
    the first entry's."""
    if g.ops[node] in LEAVES:
        yield f"{name} = getelementptr double, {POINTER} %{pointer}, i64 {g.args[node][0]}"
        return
    (index,), (_, first, stride, count) = operands, g.args[node]
    yield f"{name}.least = fcmp oge double {index}, {_literal(0.0)}"
    yield f"{name}.most = fcmp olt double {index}, {_literal(float(count))}"
    yield f"{name}.inside = and i1 {name}.least, {name}.most"
    yield f"{name}.safe = select i1 {name}.inside, double {index}, double {_literal(0.0)}"
    yield f"{name}.whole = fptosi double {name}.safe to i64"
    yield f"{name}.steps = mul i64 {name}.whole, {stride}"
    yield f"{name}.place = add i64 {name}.steps, {first}"
    yield f"{name} = getelementptr double, {POINTER} %{pointer}, i64 {name}.place"


def _literal(value: float | bool) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"


def compiled(functions: Iterable[str]) -> llvm.ExecutionEngine:
    """The engine that holds the functions; the same text is compiled once a process and never
    freed."""
    declarations = [
        f"declare double @{name}({'double, double' if name in ('pow', 'atan2') else 'double'}) "
        "nounwind"
        for name in FUNCTIONS.values()
    ]
    source = "\n".join([*declarations, *functions])
    key = hashlib.sha256(source.encode()).hexdigest()
    if key not in _engines:
        _engines.setdefault(
            key, _engine(source)
        )  # of several threads that compiled it, all take the first engine
    return _engines[key]


def _engine(source: str) -> llvm.ExecutionEngine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    _load_libm()
    target = llvm.Target.from_default_triple()
    features = llvm.get_host_cpu_features().flatten()
    level = (
        2 if len(source) < 500_000 else 1
    )  # half the compile time of a large network, about the same speed
    machine = target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features, opt=level, jit=True
    )
    module = llvm.parse_assembly(source)
    module.triple = target.triple
    module.data_layout = str(machine.target_data)
    module.verify()
    engine = llvm.create_mcjit_compiler(module, machine, use_lmm=True)  # see kernel.objects.load
    engine.finalize_object()
    return engine


def _load_libm() -> None:
    """Make sure that the C mathematics library is among the libraries where symbols are looked
    up."""
    if llvm.address_of_symbol("log1p") is None and (path := ctypes.util.find_library("m")):
        llvm.load_library_permanently(path)


# Test that a law is one of a single contact point: several points at once give the same values as
# each of them alone.


POINTS = 3
"""Points that are traced side by side."""

REMEDY = (
    "a law describes one point, so leave the points' own dimension alone: mean(-1) of a stack of a "
    "point's numbers is fine"
)


class Watch(Trace):
    """A trace of several points side by side, entry i of x of point i // `size`; refuses operations
    that couple them."""

    size: int

    def __init__(self, graph: ScalarGraph) -> None:
        super().__init__(graph)
        self._points: dict[int, frozenset[int]] = {}

    def points(self, node: int) -> frozenset[int]:
        """Points that a node depends on."""
        if node not in self._points:
            here = (self.graph.args[node][0] // self.size,) if self.graph.ops[node] == "x" else ()
            self._points[node] = frozenset(here).union(*map(self.points, self.graph.operands(node)))
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
        """Point to which each entry belongs, `NONE` or `MIXED`."""
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
    graph, size = ScalarGraph(), x.numel()
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
