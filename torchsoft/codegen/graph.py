"""The scalar expression graph of a law.

A node is an integer; its operation and arguments are in `ops` and `args` of the graph. Equal
expressions are one node, and an argument always has a smaller number than the node that uses it.
"""

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence

LEAVES = ("x", "p", "w", "d")  # inputs, parameters, output weights, a direction of parameters
LOOKUPS = {"lookup": "p", "direction": "d"}  # of which leaves
COMPARISONS = {
    "lt": operator.lt,
    "le": operator.le,
    "gt": operator.gt,
    "ge": operator.ge,
    "eq": operator.eq,
    "ne": operator.ne,
}
LOGIC = {"and": operator.and_, "or": operator.or_, "not": operator.not_}
ARITHMETIC = {"add": operator.add, "sub": operator.sub, "mul": operator.mul, "neg": operator.neg}
FOLDED = {**COMPARISONS, **LOGIC, **ARITHMETIC}
COMMUTATIVE = {"add", "mul", "eq", "ne", "and", "or"}
# the value is the first argument; the derivative rule speaks of the arguments after it
NAMED = {"stop", "norm", "sigmoid", "maximum", "minimum", "guarded"}
# finite for every finite argument, overflow apart
ENTIRE = {
    "add",
    "sub",
    "mul",
    "neg",
    "abs",
    "select",
    "sin",
    "cos",
    "tanh",
    "atan",
    "atan2",
    "erf",
    "floor",
}


class ScalarGraph:
    """Scalar expressions of float64 and truth values, each held once."""

    def __init__(self) -> None:
        self.ops: list[str] = []
        self.args: list[tuple] = []
        self.boolean: list[bool] = []
        self.finite: list[bool] = []
        self._known: dict[tuple, int] = {}
        self.zero = self.constant(0.0)  # number 0: what torch fills padding with
        self.one = self.constant(1.0)

    def __call__(self, op: str, *args: int) -> int:
        """The node `op(*args)`, simplified where an argument is constant."""
        args = self._typed(op, args)
        if op in COMMUTATIVE and args[0] > args[1]:
            args = (args[1], args[0])
        simpler = self._simplified(op, args)
        if simpler is not None:
            return simpler
        finite = (
            op in LEAVES
            or op == "sigmoid"
            or ((op in ENTIRE or op in NAMED) and self._all_finite(op, args))
        )
        return self._node(op, args, (op, *args), op in COMPARISONS or op in LOGIC, finite)

    def leaf(self, kind: str, index: int) -> int:
        """Entry `index` of the inputs "x", the parameters "p", the output weights "w" of a pull
        or a direction "d" of the parameters."""
        return self._node(kind, (index,), (kind, index), False, True)

    def direction(self, node: int) -> int:
        """The entry of a direction of the parameters that belongs to a parameter or a look-up."""
        kind, args = {"p": "d", "lookup": "direction"}[self.ops[node]], self.args[node]
        return self._node(kind, args, (kind, *args), False, True)

    def constant(self, value: float | bool) -> int:
        """A constant; a `bool` is a truth value, every other number a float64."""
        if isinstance(value, bool):
            return self._node("constant", (value,), ("constant", value, "truth"), True, True)
        value = float(value)
        return self._node(
            "constant", (value,), ("constant", value.hex()), False, math.isfinite(value)
        )

    def operands(self, node: int) -> tuple[int, ...]:
        """The nodes whose values the instruction of `node` takes."""
        op, args = self.ops[node], self.args[node]
        return () if op in (*LEAVES, "constant") else args[:1] if op in (*NAMED, *LOOKUPS) else args

    def value(self, node: int) -> float | None:
        """The value of a constant node, and None for every other node."""
        return self.args[node][0] if self.ops[node] == "constant" else None

    def number(self, node: int) -> int:
        """The node as a float64: 1 for true and 0 for false."""
        return self("select", node, self.one, self.zero) if self.boolean[node] else node

    def truth(self, node: int) -> int:
        """The node as a truth value: whether a number differs from zero."""
        return node if self.boolean[node] else self("ne", node, self.zero)

    def total(self, nodes: Iterable[int]) -> int:
        """The sum of the nodes, from the left; zero where there are none."""
        total = self.zero
        for node in nodes:
            total = self("add", total, node)
        return total

    def lookup(self, entries: Sequence[int], index: int) -> int:
        """entries[index] of a whole number, entry 0 where there is none of that number. Parameters
        that stand equally far apart are read from their place; other entries are chosen among."""
        place = self.value(index)
        if place is not None:
            return entries[int(place)]
        if all(self.ops[entry] == "stop" for entry in entries):
            return self("stop", self.lookup([self.args[entry][0] for entry in entries], index))
        first, *rest = (self.args[entry][0] if self.ops[entry] == "p" else -1 for entry in entries)
        stride = rest[0] - first if rest else 1
        if first >= 0 and rest == [first + stride * (i + 1) for i in range(len(rest))]:
            args = index, first, stride, len(entries)
            return self._node("lookup", args, ("lookup", *args), False, True)
        chosen = entries[0]
        for i, entry in enumerate(entries[1:], 1):
            chosen = self("select", self("eq", index, self.constant(i)), entry, chosen)
        return chosen

    def product(self, adjoint: int, local: int) -> int:
        """adjoint·local, and 0 where the adjoint is exactly 0, however singular the local
        derivative is there."""
        if self.value(local) == 0.0:
            return self.zero
        result = self("mul", adjoint, local)
        return result if self.finite[local] else self.guarded(adjoint, result)

    def quotient(self, adjoint: int, divisor: int) -> int:
        """adjoint/divisor, and 0 where the adjoint is exactly 0."""
        return self.guarded(adjoint, self("div", adjoint, divisor))

    def guarded(self, adjoint: int, result: int) -> int:
        """`result`, and 0 where the adjoint is exactly 0; differentiated again it is `result`."""
        value = self("select", self("eq", adjoint, self.zero), self.zero, result)
        return value if value == result else self("guarded", value, result)

    def _node(self, op: str, args: tuple, key: tuple, boolean: bool, finite: bool) -> int:
        node = self._known.setdefault(key, len(self.ops))
        if node == len(self.ops):
            self.ops.append(op)
            self.args.append(args)
            self.boolean.append(boolean)
            self.finite.append(finite)
        return node

    def _all_finite(self, op: str, args: tuple[int, ...]) -> bool:
        if op in ("norm", "maximum", "minimum"):
            args = args[1:]
        return all(self.finite[a] for a in args)

    def _typed(self, op: str, args: tuple[int, ...]) -> tuple[int, ...]:
        """The arguments converted to numbers or truth values, as the operation takes them."""
        if op in LOGIC:
            return tuple(self.truth(a) for a in args)
        if op == "select":
            return (self.truth(args[0]), self.number(args[1]), self.number(args[2]))
        return tuple(self.number(a) for a in args) if any(self.boolean[a] for a in args) else args

    def _simplified(self, op: str, args: tuple[int, ...]) -> int | None:
        """A node known to be equal, or None. Signed zeros count as equal; x·0 is 0 where x is
        certainly finite."""
        values = [self.value(a) for a in args]
        if op in FOLDED and None not in values:
            return self.constant(FOLDED[op](*values))
        match op:
            case "select" if values[0] is not None or args[1] == args[2]:
                return args[1] if values[0] else args[2]
            case "neg" | "not" if self.ops[args[0]] == op:
                return self.args[args[0]][0]
            case "sub" | "div" if values[1] == (0.0 if op == "sub" else 1.0):
                return args[0]
            case "sub" if values[0] == 0.0:
                return self("neg", args[1])
            case "div" if values[0] is not None and values[1]:
                return self.constant(values[0] / values[1])
            case "add" | "mul" | "and" | "or":
                return self._simplified_pair(op, args, values)
        return None

    def _simplified_pair(self, op: str, args: tuple[int, ...], values: list) -> int | None:
        for value, other in zip(values, reversed(args)):
            if value is None:
                continue
            if value == {"add": 0.0, "mul": 1.0, "and": True, "or": False}[op]:
                return other
            if op == "mul" and value == -1.0:
                return self("neg", other)
            if (op == "mul" and value == 0.0 and self.finite[other]) or (
                op in LOGIC and value is (op == "or")
            ):
                return self.constant(value if op in LOGIC else 0.0)
        return None


def power(g: ScalarGraph, base: int, exponent: int) -> int:
    """base**exponent, with the products and roots that torch takes for small constant exponents."""
    square = lambda: g("mul", base, base)
    simple: dict[float, Callable[[], int]] = {
        0.0: lambda: g.one,
        1.0: lambda: base,
        2.0: square,
        3.0: lambda: g("mul", square(), base),
        0.5: lambda: g("sqrt", base),
        -0.5: lambda: g("div", g.one, g("sqrt", base)),
        -1.0: lambda: g("div", g.one, base),
        -2.0: lambda: g("div", g.one, square()),
    }
    value = g.value(exponent)
    return simple[value]() if value in simple else g("pow", base, exponent)


def sign(g: ScalarGraph, a: int) -> int:
    """1, 0 or -1, as constants that have no derivative."""
    below = g("select", g("lt", a, g.zero), g.constant(-1.0), g.zero)
    return g("select", g("gt", a, g.zero), g.one, below)


# Derivatives of scalar expressions, as nodes of the same graph: torch's conventions at kinks and
# at zero adjoints.


Partials = list[tuple[int, int]]  # pairs (argument, partial derivative)


def _plus_square(g: ScalarGraph, a: int, sign: str = "add") -> int:
    return g(sign, g.one, g("mul", a, a))


def _div(g: ScalarGraph, adj: int, y: int, a: int, b: int) -> tuple:
    over = g.quotient(adj, b)
    return over, g("neg", g.product(over, y))


def _pow(g: ScalarGraph, adj: int, y: int, a: int, b: int) -> tuple:
    by_base = g.product(adj, g("mul", b, power(g, a, g("sub", b, g.one))))
    by_base = g("select", g("eq", b, g.zero), g.zero, by_base)
    flat = g("and", g("eq", a, g.zero), g("ge", b, g.zero))
    by_exponent = g("select", flat, g.zero, g.product(adj, g("mul", y, g("log", a))))
    return by_base, by_exponent


def _atan2(g: ScalarGraph, adj: int, y: int, a: int, b: int) -> tuple:
    square = g("add", g("mul", a, a), g("mul", b, b))
    inverse = g("select", g("eq", square, g.zero), g.zero, g("div", g.one, square))
    return g.product(adj, g("mul", b, inverse)), g("neg", g.product(adj, g("mul", a, inverse)))


def _select(g: ScalarGraph, adj: int, y: int, c: int, a: int, b: int) -> tuple:
    return None, g("select", c, adj, g.zero), g("select", c, g.zero, adj)


def _extremum(above: str) -> Callable[..., tuple]:
    def rule(g: ScalarGraph, adj: int, y: int, value: int, a: int, b: int) -> tuple:
        tie, half = g("eq", a, b), g("mul", adj, g.constant(0.5))
        first = g(above, a, b)
        to = lambda chosen: g("select", tie, half, g("select", chosen, adj, g.zero))
        return None, to(first), to(g("not", first))

    return rule


def _norm(g: ScalarGraph, adj: int, y: int, value: int, *entries: int) -> tuple:
    flat = g("eq", value, g.zero)
    return None, *(g.product(adj, g("select", flat, g.zero, g("div", a, value))) for a in entries)


# operation -> function(graph, adjoint, node, *arguments) giving the adjoint passed to each
# argument, None for none; an operation that is not named here has no derivative
RULES: dict[str, Callable[..., tuple]] = {
    "add": lambda g, adj, y, a, b: (adj, adj),
    "sub": lambda g, adj, y, a, b: (adj, g("neg", adj)),
    "mul": lambda g, adj, y, a, b: (g.product(adj, b), g.product(adj, a)),
    "div": _div,
    "neg": lambda g, adj, y, a: (g("neg", adj),),
    "abs": lambda g, adj, y, a: (g.product(adj, sign(g, a)),),
    "sqrt": lambda g, adj, y, a: (g.quotient(adj, g("add", y, y)),),
    "pow": _pow,
    "sin": lambda g, adj, y, a: (g.product(adj, g("cos", a)),),
    "cos": lambda g, adj, y, a: (g("neg", g.product(adj, g("sin", a))),),
    "tan": lambda g, adj, y, a: (g.product(adj, _plus_square(g, y)),),
    "asin": lambda g, adj, y, a: (g.quotient(adj, g("sqrt", _plus_square(g, a, "sub"))),),
    "acos": lambda g, adj, y, a: (g("neg", g.quotient(adj, g("sqrt", _plus_square(g, a, "sub")))),),
    "atan": lambda g, adj, y, a: (g("div", adj, _plus_square(g, a)),),
    "atan2": _atan2,
    "sinh": lambda g, adj, y, a: (g.product(adj, g("cosh", a)),),
    "cosh": lambda g, adj, y, a: (g.product(adj, g("sinh", a)),),
    "tanh": lambda g, adj, y, a: (g.product(adj, _plus_square(g, y, "sub")),),
    "exp": lambda g, adj, y, a: (g.product(adj, y),),
    "expm1": lambda g, adj, y, a: (g.product(adj, g("add", y, g.one)),),
    "log": lambda g, adj, y, a: (g.quotient(adj, a),),
    "log1p": lambda g, adj, y, a: (g.quotient(adj, g("add", a, g.one)),),
    "erf": lambda g, adj, y, a: (
        g(
            "mul",
            g("mul", adj, g.constant(2 / math.sqrt(math.pi))),
            g("exp", g("neg", g("mul", a, a))),
        ),
    ),
    "sigmoid": lambda g, adj, y, value, a: (None, g.product(adj, g("mul", y, g("sub", g.one, y)))),
    "select": _select,
    "guarded": lambda g, adj, y, value, result: (None, adj),
    "maximum": _extremum("gt"),
    "minimum": _extremum("lt"),
    "norm": _norm,
}


def dependent(g: ScalarGraph, targets: Iterable[int]) -> bytearray:
    """For every node of the graph, whether it has a derivative in one of the targets."""
    marks = bytearray(len(g.ops))
    for target in targets:
        marks[target] = 1
    for node, op in enumerate(g.ops):
        if op in RULES and any(marks[a] for a in g.args[node]):
            marks[node] = 1
    return marks


def adjoints(
    g: ScalarGraph,
    seeds: Mapping[int, int],
    rules: Mapping[int, Partials],
    marks: bytearray,
    targets: Sequence[int],
) -> list[int]:
    """Σ seed·∂node/∂target for each target: one reverse sweep over the nodes that `marks` calls
    dependent.

    Where `rules` has the partial derivatives of a node, they are used instead of the operation's
    rule.
    """
    total = dict(seeds)
    for node in range(max(seeds, default=-1), -1, -1):
        if node not in total or not marks[node]:
            continue
        for arg, part in _parts(g, node, total[node], rules):
            if part is not None and marks[arg]:
                total[arg] = g("add", total[arg], part) if arg in total else part
    return [total.get(target, g.zero) for target in targets]


def _parts(
    g: ScalarGraph, node: int, adjoint: int, rules: Mapping[int, Partials]
) -> Iterable[tuple[int, int | None]]:
    """The arguments of a node, each with its share of the node's adjoint."""
    if node in rules:
        return [(arg, g.product(adjoint, partial)) for arg, partial in rules[node]]
    args = g.args[node]
    return zip(args, RULES[g.ops[node]](g, adjoint, node, *args)) if g.ops[node] in RULES else ()


def jacobian(g: ScalarGraph, outputs: Sequence[int], targets: Sequence[int]) -> list[list[int]]:
    """∂output/∂target, one row per output: a reverse sweep each; nodes that several outputs have in
    common stand once."""
    marks = dependent(g, targets)
    rules = _shared(g, set(outputs), marks) if len(outputs) > 1 else {}
    return [adjoints(g, {node: g.one}, rules, marks, targets) for node in outputs]


def _shared(g: ScalarGraph, outputs: set[int], marks: bytearray) -> dict[int, Partials]:
    """Partial derivatives of the nodes through which alone the outputs depend on much of the graph.

    Such a node, a network's result for example, is differentiated once, in the arguments of the
    part of the graph that it alone uses (that it dominates), and no sweep of an output enters that
    part.
    """
    parents = _dominators(g, outputs, marks)
    inside: dict[int, set[int]] = {}
    for node in (
        n for n in sorted(parents) if g.ops[n] in RULES
    ):  # a node comes after all that it dominates
        inside.setdefault(node, set()).add(node)
        inside.setdefault(parents[node], set()).update(inside[node])
    rules: dict[int, Partials] = {}
    hidden: set[int] = set()
    for node in sorted(inside.keys() & parents.keys(), reverse=True):
        part = inside[node]
        edge = sorted({arg for n in part for arg in g.args[n] if marks[arg]} - part)
        if node not in hidden and len(part) > 2 * len(edge) + 2:
            hidden |= part
            rules[node] = list(
                zip(edge, adjoints(g, {node: g.one}, {arg: [] for arg in edge}, marks, edge))
            )
    return rules


def _dominators(g: ScalarGraph, outputs: set[int], marks: bytearray) -> dict[int, int]:
    """For every dependent node that an output uses, the first later node that all its ways to an
    output have in common.

    The number after all nodes stands for the outputs together.
    """
    root = len(marks)
    parents = {node: root for node in outputs if marks[node]}
    for node in range(root - 1, -1, -1):
        if node not in parents or g.ops[node] not in RULES:
            continue
        for arg in g.args[node]:
            if marks[arg]:
                parents[arg] = _meeting(parents, parents.get(arg, node), node)
    return parents


def _meeting(parents: Mapping[int, int], a: int, b: int) -> int:
    while a != b:
        a, b = (parents[a], b) if a < b else (a, parents[b])
    return a
