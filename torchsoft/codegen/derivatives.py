"""Derivatives of scalar expressions, as nodes of the same graph: torch's conventions at kinks and
at zero adjoints."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from torchsoft.codegen.graph import Graph, power, sign

Partials = list[tuple[int, int]]  # pairs (argument, partial derivative)


def _plus_square(g: Graph, a: int, sign: str = "add") -> int:
    return g(sign, g.one, g("mul", a, a))


def _div(g: Graph, adj: int, y: int, a: int, b: int) -> tuple:
    over = g.quotient(adj, b)
    return over, g("neg", g.product(over, y))


def _pow(g: Graph, adj: int, y: int, a: int, b: int) -> tuple:
    by_base = g.product(adj, g("mul", b, power(g, a, g("sub", b, g.one))))
    by_base = g("select", g("eq", b, g.zero), g.zero, by_base)
    flat = g("and", g("eq", a, g.zero), g("ge", b, g.zero))
    by_exponent = g("select", flat, g.zero, g.product(adj, g("mul", y, g("log", a))))
    return by_base, by_exponent


def _atan2(g: Graph, adj: int, y: int, a: int, b: int) -> tuple:
    square = g("add", g("mul", a, a), g("mul", b, b))
    inverse = g("select", g("eq", square, g.zero), g.zero, g("div", g.one, square))
    return g.product(adj, g("mul", b, inverse)), g("neg", g.product(adj, g("mul", a, inverse)))


def _select(g: Graph, adj: int, y: int, c: int, a: int, b: int) -> tuple:
    return None, g("select", c, adj, g.zero), g("select", c, g.zero, adj)


def _extremum(above: str) -> Callable[..., tuple]:
    def rule(g: Graph, adj: int, y: int, value: int, a: int, b: int) -> tuple:
        tie, half = g("eq", a, b), g("mul", adj, g.constant(0.5))
        first = g(above, a, b)
        to = lambda chosen: g("select", tie, half, g("select", chosen, adj, g.zero))
        return None, to(first), to(g("not", first))

    return rule


def _norm(g: Graph, adj: int, y: int, value: int, *entries: int) -> tuple:
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
    "maximum": _extremum("gt"),
    "minimum": _extremum("lt"),
    "norm": _norm,
}


def dependent(g: Graph, targets: Iterable[int]) -> bytearray:
    """For every node of the graph, whether it has a derivative in one of the targets."""
    marks = bytearray(len(g.ops))
    for target in targets:
        marks[target] = 1
    for node, op in enumerate(g.ops):
        if op in RULES and any(marks[a] for a in g.args[node]):
            marks[node] = 1
    return marks


def adjoints(
    g: Graph,
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
    g: Graph, node: int, adjoint: int, rules: Mapping[int, Partials]
) -> Iterable[tuple[int, int | None]]:
    """The arguments of a node, each with its share of the node's adjoint."""
    if node in rules:
        return [(arg, g.product(adjoint, partial)) for arg, partial in rules[node]]
    args = g.args[node]
    return zip(args, RULES[g.ops[node]](g, adjoint, node, *args)) if g.ops[node] in RULES else ()


def jacobian(g: Graph, outputs: Sequence[int], targets: Sequence[int]) -> list[list[int]]:
    """∂output/∂target, one row per output: a reverse sweep each; nodes that several outputs have in
    common stand once."""
    marks = dependent(g, targets)
    rules = _shared(g, set(outputs), marks) if len(outputs) > 1 else {}
    return [adjoints(g, {node: g.one}, rules, marks, targets) for node in outputs]


def _shared(g: Graph, outputs: set[int], marks: bytearray) -> dict[int, Partials]:
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


def _dominators(g: Graph, outputs: set[int], marks: bytearray) -> dict[int, int]:
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
