"""What the torch operations mean for scalar nodes: tables `operation -> function`, at torch's conventions.

A function takes the graph and the operation's own arguments. In `ELEMENTWISE` every tensor and number is one node; in
`WHOLE` every tensor is an int64 array of nodes; `MOVES` names the operations that only place entries anew.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchsoft.codegen.graph import Graph, power, sign

Nodes = NDArray[np.int64]

_MOVES = (
    "_reshape_alias _unsafe_view alias cat clone diagonal diag_embed expand expand_copy flip gather index index_select "
    "lift_fresh lift_fresh_copy narrow permute repeat reshape roll select slice split split_with_sizes squeeze stack t "
    "transpose tril triu unbind unfold unsqueeze view squeeze_ unsqueeze_ t_ transpose_"
)
MOVES = set(_MOVES.split())
# results that do not depend on the values of the arguments
_CONSTANT = "zeros_like ones_like full_like empty_like new_zeros new_ones new_full new_empty new_empty_strided"
CONSTANT = set(_CONSTANT.split())
READS = {"_local_scalar_dense", "is_nonzero", "item", "nonzero", "masked_select", "equal"}


def mapped(function: Callable[..., Any], *arrays: Nodes) -> Nodes:
    """`function` of the entries of the broadcast arrays."""
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*arrays)).astype(np.int64)


def _maximum(g: Graph, a: int, b: int) -> int:
    return g("maximum", g("select", g("or", g("ge", a, b), g("ne", a, a)), a, b), a, b)


def _minimum(g: Graph, a: int, b: int) -> int:
    return g("minimum", g("select", g("or", g("le", a, b), g("ne", a, a)), a, b), a, b)


def _sigmoid(g: Graph, a: int) -> int:
    return g("sigmoid", g("div", g.one, g("add", g.one, g("exp", g("neg", a)))), a)


def _norm(g: Graph, *entries: int) -> int:
    return g("norm", g("sqrt", g.total(g("mul", a, a) for a in entries)), *entries)


def _clamp(g: Graph, a: int, min: int | None = None, max: int | None = None) -> int:
    if min is not None:
        a = g("select", g("lt", a, min), min, a)
    return a if max is None else g("select", g("gt", a, max), max, a)


def _hardtanh(g: Graph, a: int, low: int | None = None, high: int | None = None) -> int:
    """The clamp whose derivative is zero at the bounds."""
    low = g.constant(-1.0) if low is None else low
    high = g.one if high is None else high
    return g("select", g("le", a, low), low, g("select", g("ge", a, high), high, a))


def _leaky_relu(g: Graph, a: int, slope: int | None = None) -> int:
    slope = g.constant(0.01) if slope is None else slope
    return g("select", g("gt", a, g.zero), a, g("mul", slope, a))


def _elu(g: Graph, a: int, alpha: int | None = None, scale: int | None = None, input_scale: int | None = None) -> int:
    scale = g.one if scale is None else scale
    inside = a if input_scale is None else g("mul", input_scale, a)
    below = g("mul", g("mul", scale, g.one if alpha is None else alpha), g("expm1", inside))
    return g("select", g("le", a, g.zero), below, g("mul", scale, a))


def _softplus(g: Graph, a: int, beta: int | None = None, threshold: int | None = None) -> int:
    beta = g.one if beta is None else beta
    scaled = g("mul", a, beta)
    smooth = g("div", g("log1p", g("exp", scaled)), beta)
    return g("select", g("gt", scaled, g.constant(20.0) if threshold is None else threshold), a, smooth)


def _gelu(g: Graph, a: int, approximate: str = "none") -> int:
    if approximate == "none":
        inner = g("erf", g("mul", a, g.constant(math.sqrt(0.5))))
    else:
        cube = g("mul", g("mul", a, a), a)
        inner = g("add", a, g("mul", g.constant(0.044715), cube))
        inner = g("tanh", g("mul", g.constant(math.sqrt(2 / math.pi)), inner))
    return g("mul", g("mul", g.constant(0.5), a), g("add", g.one, inner))


def _add(g: Graph, a: int, b: int, alpha: int | None = None) -> int:
    return g("add", a, b if alpha is None else g("mul", alpha, b))


def _sub(g: Graph, a: int, b: int, alpha: int | None = None) -> int:
    return g("sub", a, b if alpha is None else g("mul", alpha, b))


def _div(g: Graph, a: int, b: int, rounding_mode: str | None = None) -> int:
    if rounding_mode is not None:
        raise TypeError("a division that rounds")
    return g("div", a, b)


def _converted(g: Graph, a: int, dtype: Any = None, **_: Any) -> int:
    """The same number; to a whole one the part after the point is cut off."""
    if dtype != torch.int64:
        return a
    return g("select", g("lt", a, g.zero), g("neg", g("floor", g("neg", a))), g("floor", a))


def _primitive(op: str) -> Callable[..., int]:
    return lambda g, *args: g(op, *args)


_SAME = "neg abs sqrt sin cos tan asin acos atan atan2 sinh cosh tanh exp expm1 log log1p erf floor lt le gt ge eq ne"
ELEMENTWISE: dict[str, Callable[..., int]] = {
    **{name: _primitive(name) for name in _SAME.split()},
    "add": _add,
    "sub": _sub,
    "rsub": lambda g, a, b, alpha=None: _sub(g, b, a, alpha),
    "mul": _primitive("mul"),
    "div": _div,
    "reciprocal": lambda g, a: g("div", g.one, a),
    "pow": power,
    "square": lambda g, a: g("mul", a, a),
    "rsqrt": lambda g, a: g("div", g.one, g("sqrt", a)),
    "sign": sign,
    "sgn": sign,
    "hypot": _norm,
    "sigmoid": _sigmoid,
    "silu": lambda g, a: g("mul", a, _sigmoid(g, a)),
    "softplus": _softplus,
    "relu": lambda g, a: g("select", g("le", a, g.zero), g.zero, a),
    "leaky_relu": _leaky_relu,
    "elu": _elu,
    "gelu": _gelu,
    "hardtanh": _hardtanh,
    "clamp": _clamp,
    "clamp_min": _clamp,
    "clamp_max": lambda g, a, high: _clamp(g, a, None, high),
    "maximum": _maximum,
    "minimum": _minimum,
    "where": _primitive("select"),
    "masked_fill": lambda g, a, mask, value: g("select", mask, value, a),
    "logical_and": _primitive("and"),
    "bitwise_and": _primitive("and"),
    "logical_or": _primitive("or"),
    "bitwise_or": _primitive("or"),
    "logical_not": _primitive("not"),
    "bitwise_not": _primitive("not"),
    "logical_xor": lambda g, a, b: g("ne", g.truth(a), g.truth(b)),
    "bitwise_xor": lambda g, a, b: g("ne", a, b),
    "lerp": lambda g, a, b, weight: g("add", a, g("mul", weight, g("sub", b, a))),
    "addcmul": lambda g, a, b, c, value=None: _add(g, a, g("mul", b, c), value),
    "addcdiv": lambda g, a, b, c, value=None: _add(g, a, g("div", b, c), value),
    "deg2rad": lambda g, a: g("mul", a, g.constant(math.pi / 180)),
    "rad2deg": lambda g, a: g("mul", a, g.constant(180 / math.pi)),
    "detach": _primitive("stop"),
    "_to_copy": _converted,
    "copy": lambda g, a, b, *options: b,
    "fill": lambda g, a, value: value,
    # the derivatives that torch.func.grad takes inside a law
    "tanh_backward": lambda g, adj, y: g("mul", adj, g("sub", g.one, g("mul", y, y))),
    "sigmoid_backward": lambda g, adj, y: g("mul", adj, g("mul", g("sub", g.one, y), y)),
    "threshold_backward": lambda g, adj, a, threshold: g("select", g("le", a, threshold), g.zero, adj),
}


def _reduced(fold: Callable[..., int], g: Graph, x: Nodes, dim: Any = None, keepdim: bool = False, **_: Any) -> Nodes:
    """`fold(graph, entries)` over the axes `dim`; over all where it is None or empty."""
    axes = range(x.ndim) if dim is None else [dim] if isinstance(dim, int) else dim
    axes = sorted(a % x.ndim for a in axes) if x.ndim else []
    axes = axes or list(range(x.ndim))
    kept = [a for a in range(x.ndim) if a not in axes]
    rows = x.transpose(kept + axes).reshape(*(x.shape[a] for a in kept), math.prod(x.shape[a] for a in axes))
    out = np.empty(rows.shape[:-1], np.int64)
    for index in np.ndindex(out.shape):
        out[index] = fold(g, rows[index].tolist())
    return np.expand_dims(out, tuple(axes)) if keepdim else out


def _place(better: str) -> Callable[..., int]:
    """Where the first of the best entries stands, as a number that has no derivative."""

    def fold(g: Graph, entries: Sequence[int]) -> int:
        best, place = entries[0], g.zero
        for i, entry in enumerate(entries[1:], 1):
            found = g(better, entry, best)
            best, place = g("select", found, entry, best), g("select", found, g.constant(i), place)
        return place

    return fold


def _entry(g: Graph, entries: Sequence[int], place: int) -> int:
    return g.lookup(place, entries)


def _looked_up(
    g: Graph, table: Nodes, places: Nodes, padding: int = -1, scaled: bool = False, sparse: bool = False
) -> Nodes:
    """Rows table[places], (..., columns)."""
    if padding >= 0 or scaled:
        raise TypeError("a look-up with gradients of its own")
    columns = table.T.tolist()
    return np.stack([mapped(partial(_entry, g, column), places) for column in columns], -1)


def _mean(g: Graph, entries: Sequence[int]) -> int:
    return g("div", g.total(entries), g.constant(len(entries)))


def _vector_norm(g: Graph, x: Nodes, ord: float = 2, dim: Any = None, keepdim: bool = False, **_: Any) -> Nodes:
    if ord != 2:
        raise TypeError(f"a vector norm of order {ord}")
    return _reduced(lambda g, entries: _norm(g, *entries), g, x, dim, keepdim)


def _cumsum(g: Graph, x: Nodes, dim: int, **_: Any) -> Nodes:
    rows = np.moveaxis(x, dim, -1) if x.ndim else x.reshape(1)
    sums = np.empty_like(rows)
    for index in np.ndindex(rows.shape):
        sums[index] = g.total(rows[*index[:-1], : index[-1] + 1].tolist())
    return np.moveaxis(sums, -1, dim) if x.ndim else sums.reshape(())


def matmul(g: Graph, a: Nodes, b: Nodes) -> Nodes:
    """Matrix products a (..., n, k) by b (..., k, m)."""
    products = mapped(partial(g, "mul"), a[..., :, None, :], np.swapaxes(b, -1, -2)[..., None, :, :])
    return _reduced(Graph.total, g, products, -1)


def _mv(g: Graph, a: Nodes, b: Nodes) -> Nodes:
    return matmul(g, a, b[:, None])[:, 0]


def _added(product: Callable[..., Nodes]) -> Callable[..., Nodes]:
    def rule(g: Graph, bias: Nodes, a: Nodes, b: Nodes, beta: float = 1, alpha: float = 1) -> Nodes:
        scaled = mapped(lambda y: g("mul", g.constant(alpha), y), product(g, a, b))
        return mapped(lambda c, y: g("add", g("mul", g.constant(beta), c), y), bias, scaled)

    return rule


def _cross(g: Graph, a: Nodes, b: Nodes, dim: int = -1) -> Nodes:
    turned = lambda first, second: mapped(partial(g, "mul"), np.roll(a, first, dim), np.roll(b, second, dim))
    return mapped(partial(g, "sub"), turned(-1, -2), turned(-2, -1))


def _pad(g: Graph, x: Nodes, pad: Sequence[int], value: float = 0.0) -> Nodes:
    return torch.constant_pad_nd(torch.from_numpy(x), pad, g.constant(float(value))).numpy()


def _folded(function: Callable[..., int]) -> Callable[..., Nodes]:
    return partial(_reduced, lambda g, entries: reduce(partial(function, g), entries))


WHOLE: dict[str, Callable[..., Nodes]] = {
    "mm": matmul,
    "bmm": matmul,
    "matmul": matmul,
    "mv": _mv,
    "dot": lambda g, a, b: matmul(g, a[None, :], b[:, None])[0, 0],
    "vdot": lambda g, a, b: matmul(g, a[None, :], b[:, None])[0, 0],
    "addmm": _added(matmul),
    "baddbmm": _added(matmul),
    "addmv": _added(_mv),
    "linear": lambda g, x, weight, bias=None: (
        matmul(g, x, weight.T) if bias is None else _added(matmul)(g, bias, x, weight.T)
    ),
    "sum": partial(_reduced, Graph.total),
    "mean": partial(_reduced, _mean),
    "prod": partial(_reduced, lambda g, entries: reduce(partial(g, "mul"), entries, g.one)),
    "any": partial(_reduced, lambda g, entries: reduce(partial(g, "or"), entries, g.constant(False))),
    "all": partial(_reduced, lambda g, entries: reduce(partial(g, "and"), entries, g.constant(True))),
    "amax": _folded(_maximum),
    "amin": _folded(_minimum),
    "argmax": partial(_reduced, _place("gt")),
    "argmin": partial(_reduced, _place("lt")),
    "embedding": _looked_up,
    "linalg_vector_norm": _vector_norm,
    "cumsum": _cumsum,
    "linalg_cross": _cross,
    "constant_pad_nd": _pad,
}
