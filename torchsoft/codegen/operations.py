"""Meanings of the torch operations for scalar nodes, at torch's conventions.

`MOVES` only place entries anew. `ELEMENTWISE` have rules for one node of every tensor, `WHOLE`
rules for tensors as int64 arrays of nodes. `COMPOSED` are written with the others, in torch.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.codegen.graph import ScalarGraph, power, sign

Nodes = NDArray[np.int64]

_MOVES = (
    "_reshape_alias _unsafe_view alias cat clone diagonal diag_embed expand expand_copy flip "
    "gather index index_select lift_fresh lift_fresh_copy narrow permute repeat reshape roll "
    "select slice split split_with_sizes squeeze stack t transpose tril triu unbind unfold "
    "unsqueeze view squeeze_ unsqueeze_ t_ transpose_"
)
MOVES = set(_MOVES.split())
# results that do not depend on the values of the arguments
_CONSTANT = (
    "zeros_like ones_like full_like empty_like new_zeros new_ones new_full new_empty "
    "new_empty_strided"
)
CONSTANT = set(_CONSTANT.split())
READS = {"_local_scalar_dense", "is_nonzero", "item", "nonzero", "masked_select", "equal"}


def mapped(function: Callable[..., Any], *arrays: Nodes) -> Nodes:
    """`function` of the entries of the broadcast arrays."""
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*arrays)).astype(np.int64)


def _extremum(op: str, better: str) -> Callable[..., int]:
    """The better of two numbers; NaN where one of them is NaN."""
    return lambda g, a, b: g(op, g("select", g("or", g(better, a, b), g("ne", a, a)), a, b), a, b)


_maximum, _minimum = _extremum("maximum", "ge"), _extremum("minimum", "le")


def _norm(g: ScalarGraph, *entries: int) -> int:
    return g("norm", g("sqrt", g.total(g("mul", a, a) for a in entries)), *entries)


def _add(g: ScalarGraph, a: int, b: int, alpha: int | None = None, op: str = "add") -> int:
    return g(op, a, b if alpha is None else g("mul", alpha, b))


def _div(g: ScalarGraph, a: int, b: int, rounding_mode: str | None = None) -> int:
    if rounding_mode is not None:
        raise TypeError("a division that rounds")
    return g("div", a, b)


def _converted(g: ScalarGraph, a: int, dtype: Any = None, **_: Any) -> int:
    """The same number; conversion to int64 truncates."""
    if dtype != torch.int64:
        return a
    return g("select", g("lt", a, g.zero), g("neg", g("floor", g("neg", a))), g("floor", a))


def _primitive(op: str) -> Callable[..., int]:
    return lambda g, *args: g(op, *args)


_SAME = (
    "neg abs sqrt sin cos tan asin acos atan atan2 sinh cosh tanh exp expm1 log log1p erf floor "
    "mul lt le gt ge eq ne"
)
_RENAMED = {"where": "select", "detach": "stop"} | {
    f"{kind}_{op}": op for kind in ("logical", "bitwise") for op in ("and", "or", "not")
}
ELEMENTWISE: dict[str, Callable[..., int]] = {
    **{
        name: _primitive(op) for name, op in [*zip(_SAME.split(), _SAME.split()), *_RENAMED.items()]
    },
    "add": _add,
    "sub": partial(_add, op="sub"),
    "rsub": lambda g, a, b, alpha=None: _add(g, b, a, alpha, "sub"),
    "div": _div,
    "reciprocal": lambda g, a: g("div", g.one, a),
    "pow": power,
    "sign": sign,
    "sgn": sign,
    "hypot": _norm,
    "sigmoid": lambda g, a: g(
        "sigmoid", g("div", g.one, g("add", g.one, g("exp", g("neg", a)))), a
    ),
    "maximum": _maximum,
    "minimum": _minimum,
    "logical_xor": lambda g, a, b: g("ne", g.truth(a), g.truth(b)),
    "bitwise_xor": _primitive("ne"),
    "_to_copy": _converted,
    "copy": lambda g, a, b, *options: b,
    "fill": lambda g, a, value: value,
}


def _reduced(
    fold: Callable[..., int],
    g: ScalarGraph,
    x: Nodes,
    dim: Any = None,
    keepdim: bool = False,
    **_: Any,
) -> Nodes:
    """`fold(graph, entries)` over the axes `dim`; over all where it is None or empty."""
    axes = range(x.ndim) if dim is None else [dim] if isinstance(dim, int) else dim
    axes = sorted(a % x.ndim for a in axes) if x.ndim else []
    axes = axes or list(range(x.ndim))
    kept = [a for a in range(x.ndim) if a not in axes]
    rows = x.transpose(kept + axes).reshape(
        *(x.shape[a] for a in kept), math.prod(x.shape[a] for a in axes)
    )
    out = np.empty(rows.shape[:-1], np.int64)
    for index in np.ndindex(out.shape):
        out[index] = fold(g, rows[index].tolist())
    return np.expand_dims(out, tuple(axes)) if keepdim else out


def _place(better: str) -> Callable[..., int]:
    """Place of the first of the best entries, as a number that has no derivative."""

    def fold(g: ScalarGraph, entries: Sequence[int]) -> int:
        best, place = entries[0], g.zero
        for i, entry in enumerate(entries[1:], 1):
            found = g(better, entry, best)
            best, place = g("select", found, entry, best), g("select", found, g.constant(i), place)
        return place

    return fold


_FOLDS: dict[str, Callable[[ScalarGraph, Sequence[int]], int]] = {
    "sum": ScalarGraph.total,
    "mean": lambda g, entries: g("div", g.total(entries), g.constant(len(entries))),
    "prod": lambda g, entries: reduce(partial(g, "mul"), entries, g.one),
    "any": lambda g, entries: reduce(partial(g, "or"), entries, g.constant(False)),
    "all": lambda g, entries: reduce(partial(g, "and"), entries, g.constant(True)),
    "amax": lambda g, entries: reduce(partial(_maximum, g), entries),
    "amin": lambda g, entries: reduce(partial(_minimum, g), entries),
    "argmax": _place("gt"),
    "argmin": _place("lt"),
}


def _vector_norm(g: ScalarGraph, x: Nodes, ord: float = 2, *axes: Any, **options: Any) -> Nodes:
    if ord != 2:
        raise TypeError(f"a vector norm of order {ord}")
    return _reduced(lambda g, entries: _norm(g, *entries), g, x, *axes, **options)


def _looked_up(
    g: ScalarGraph,
    table: Nodes,
    places: Nodes,
    padding: int = -1,
    scaled: bool = False,
    sparse: bool = False,
) -> Nodes:
    """Rows table[places], (..., columns)."""
    if padding >= 0 or scaled:
        raise TypeError("a look-up with gradients of its own")
    return np.stack([mapped(partial(g.lookup, column), places) for column in table.T.tolist()], -1)


def _pad(g: ScalarGraph, x: Nodes, pad: Sequence[int], value: float = 0.0) -> Nodes:
    return torch.constant_pad_nd(torch.from_numpy(x), pad, g.constant(float(value))).numpy()


WHOLE: dict[str, Callable[..., Nodes]] = {
    **{name: partial(_reduced, fold) for name, fold in _FOLDS.items()},
    "linalg_vector_norm": _vector_norm,
    "embedding": _looked_up,
    "constant_pad_nd": _pad,
}


def _matmul(a: Tensor, b: Tensor) -> Tensor:
    """Matrix products a (..., n, k) by b (..., k, m)."""
    return (a.unsqueeze(-2) * b.transpose(-1, -2).unsqueeze(-3)).sum(-1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _added(product: Callable[..., Tensor]) -> Callable[..., Tensor]:
    return lambda bias, a, b, beta=1, alpha=1: beta * bias + alpha * product(a, b)


def _clamp(a: Tensor, min: Any = None, max: Any = None) -> Tensor:
    if min is not None:
        a = torch.where(a < min, min, a)
    return a if max is None else torch.where(a > max, max, a)


def _hardtanh(a: Tensor, low: float = -1.0, high: float = 1.0) -> Tensor:
    """The clamp whose derivative is zero at the bounds."""
    return torch.where(a <= low, low, torch.where(a >= high, high, a))


def _softplus(a: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Tensor:
    scaled = a * beta
    return torch.where(scaled > threshold, a, scaled.exp().log1p() / beta)


def _gelu(a: Tensor, approximate: str = "none") -> Tensor:
    if approximate == "none":
        inner = (a * math.sqrt(0.5)).erf()
    else:
        inner = ((a + 0.044715 * (a * a * a)) * math.sqrt(2 / math.pi)).tanh()
    return 0.5 * a * (1 + inner)


def _cumsum(x: Tensor, dim: int, **_: Any) -> Tensor:
    return (
        torch.stack([x.narrow(dim, 0, i + 1).sum(dim) for i in range(x.shape[dim])], dim)
        if x.ndim
        else x.clone()
    )


def _cross(a: Tensor, b: Tensor, dim: int = -1) -> Tensor:
    return a.roll(-1, dim) * b.roll(-2, dim) - a.roll(-2, dim) * b.roll(-1, dim)


COMPOSED: dict[str, Callable[..., Tensor]] = {
    "square": lambda a: a * a,
    "rsqrt": lambda a: 1 / a.sqrt(),
    "silu": lambda a: a * a.sigmoid(),
    "softplus": _softplus,
    "relu": lambda a: torch.where(a <= 0, 0, a),
    "leaky_relu": lambda a, slope=0.01: torch.where(a > 0, a, slope * a),
    "elu": lambda a, alpha=1, scale=1, inner=1: torch.where(
        a <= 0, scale * alpha * (inner * a).expm1(), scale * a
    ),
    "gelu": _gelu,
    "hardtanh": _hardtanh,
    "clamp": _clamp,
    "clamp_min": _clamp,
    "clamp_max": lambda a, max: _clamp(a, None, max),
    "masked_fill": lambda a, mask, value: torch.where(mask, value, a),
    "lerp": lambda a, b, weight: a + weight * (b - a),
    "addcmul": lambda a, b, c, value=1: a + value * (b * c),
    "addcdiv": lambda a, b, c, value=1: a + value * (b / c),
    "deg2rad": lambda a: a * (math.pi / 180),
    "rad2deg": lambda a: a * (180 / math.pi),
    # the derivatives that torch.func.grad takes inside a law
    "tanh_backward": lambda adjoint, y: adjoint * (1 - y * y),
    "sigmoid_backward": lambda adjoint, y: adjoint * ((1 - y) * y),
    "threshold_backward": lambda adjoint, a, threshold: torch.where(a <= threshold, 0.0, adjoint),
    "mm": _matmul,
    "bmm": _matmul,
    "matmul": _matmul,
    "mv": _dot,
    "dot": _dot,
    "vdot": _dot,
    "addmm": _added(_matmul),
    "baddbmm": _added(_matmul),
    "addmv": _added(_dot),
    "linear": lambda x, weight, bias=0.0: (x.unsqueeze(-2) * weight).sum(-1) + bias,
    "cumsum": _cumsum,
    "linalg_cross": _cross,
}
