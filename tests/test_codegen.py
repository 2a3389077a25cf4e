"""Compiled laws against torch: values, Jacobians and pullbacks, conventions at kinks, and
refusals."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from torch.nn import functional as F

from torchsoft.codegen import UnknownOperation, compile_law, emit
from torchsoft.solve.kernel.invoke import call_linearise, call_pullback, call_value


@numba.njit(nogil=True)
def _call_all(value, linearise, pullback, x, p, w, out, again, J, p_bar):
    call_value(value, x, p, out)
    call_linearise(linearise, x, p, again, J)
    call_pullback(pullback, x, p, w, p_bar)


def _compiled_results(law, x, p, w, start=0.0):
    """Value, Jacobian, and what the pullback adds to the start."""
    out, again = np.empty(law.outputs), np.empty(law.outputs)
    J, p_bar = np.empty((law.linear, law.differentiated)), np.full(law.parameters, start)
    _call_all(law.value, law.linearise, law.pullback, x, p, w, out, again, J, p_bar)
    np.testing.assert_array_equal(out, again)
    return out, J, p_bar


def _torch_results(function, x, parameters, w):
    """Value, Jacobian in x, and gradient of w·value in all parameters, by torch's autograd."""
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in parameters.items()}
    x = x.clone().requires_grad_()
    out = function(x, leaves)
    ask = lambda scalar, wanted: torch.autograd.grad(
        scalar + 0 * x.sum() + sum(0 * q.sum() for q in leaves.values()), wanted, retain_graph=True
    )
    J = torch.stack([ask(o, [x])[0] for o in out])
    p_bar = (
        [g.flatten() for g in ask((out * w).sum(), list(leaves.values()))]
        if leaves
        else [x.new_zeros(0)]
    )
    return out.detach().numpy(), J.numpy(), torch.cat(p_bar).numpy()


def _assert_equal_to_torch(function, points, parameters, value_tolerance=1e-15):
    """The law compiled at the first point agrees with torch at every point."""
    law = compile_law(function, points[0], parameters)
    p = torch.cat([torch.zeros(0).double(), *(q.detach().flatten() for q in parameters.values())])
    w = torch.linspace(0.5, 1.7, law.outputs, dtype=torch.float64)
    for x in points:
        expected = _torch_results(function, x, parameters, w)
        found = _compiled_results(law, x.numpy(), p.numpy(), w.numpy())
        for reference, result, tolerance in zip(
            expected, found, (value_tolerance, 1e-13, 1e-13), strict=True
        ):
            scale = max(1.0, np.abs(reference).max(initial=0.0))
            np.testing.assert_allclose(result, reference, rtol=tolerance, atol=tolerance * scale)
    return law


def _points(n, count=5, seed=0):
    return list(
        torch.randn(count, n, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    )


def _numbers(**values):
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}


def test_a_network_inside_equals_torch():
    torch.manual_seed(1)
    net = torch.nn.Sequential(
        torch.nn.Linear(3, 8), torch.nn.Tanh(), torch.nn.Linear(8, 8), torch.nn.SiLU()
    )
    net = torch.nn.Sequential(net, torch.nn.Linear(8, 1)).double()

    def law(x, p):
        y = torch.func.functional_call(
            net, {k.removeprefix("net."): q for k, q in p.items() if k != "scale"}, x[:3]
        )
        return torch.cat([y * x[3:], p["scale"] * y.exp()])

    parameters = {**{f"net.{k}": q for k, q in net.named_parameters()}, **_numbers(scale=0.7)}
    compiled = _assert_equal_to_torch(law, _points(5), parameters, value_tolerance=4e-15)
    assert compiled.parameters == sum(value.numel() for value in parameters.values())


def test_derivatives_inside_a_law_equal_torch():
    law = lambda x, p: torch.func.grad(lambda y: (torch.tanh(y * p["a"]) ** 3).sum())(x)
    reference = lambda x, p: (
        3 * torch.tanh(x * p["a"]) ** 2 * (1 - torch.tanh(x * p["a"]) ** 2) * p["a"]
    )
    parameters = _numbers(a=0.6)
    x, w = _points(3)[0], torch.ones(3).double()
    found = _compiled_results(
        compile_law(law, x, parameters), x.numpy(), np.array([0.6]), w.numpy()
    )
    for result, expected in zip(found, _torch_results(reference, x, parameters, w)):
        np.testing.assert_allclose(result, expected, rtol=1e-13)


ELEMENTWISE = {  # of u, any numbers, and v, positive numbers
    "sum": lambda u, v: 2 + u + v - (1 - u) + torch.add(u, v, alpha=3) - torch.sub(u, v, alpha=0.5),
    "product": lambda u, v: -u * v / (2 / v) * torch.reciprocal(v) / 3,
    "powers": lambda u, v: (
        u**2 + u**3 + v**2.5 + 2**u + v**u + v**-1 + v**-2 + v**0.5 + u**1 + u**0
    ),
    "arcs": lambda u, v: torch.asin(u.tanh()) + torch.acos(u.sin() / 2),
    "options": lambda u, v: (
        F.softplus(u, 3.0, 1.0) + F.silu(-700 * v) + F.leaky_relu(u, 0.1) + F.elu(u, 0.7)
    ),
    "tanh form": lambda u, v: F.gelu(u, approximate="tanh") + torch.atan2(u, v),
    "clamp": lambda u, v: u.clamp(-0.5, 0.5) + u.clamp(min=0.1) + u.clamp(max=v) + u.clamp(-v, v),
    "clamp_min": lambda u, v: (
        torch.clamp_min(u, 0.2) * torch.clamp_max(u, 0.7) + torch.clamp_max(u, v)
    ),
    "extrema": lambda u, v: torch.maximum(u, v) * torch.minimum(u, -v) + torch.max(u, -u),
    "where": lambda u, v: (
        torch.where(u > v, u, v) + torch.where(u <= 0, 2.0, v) + torch.where(u < 0, v, 1.0)
    ),
    "compare": lambda u, v: (
        (u >= v).double() * u + (u == v) * v + (u != 0).to(torch.float64) * v + u * (u < v)
    ),
    "logic": lambda u, v: torch.where((u > 0) & ~(v > 1) | (u > 1) ^ (v > 2), u, v),
    "logical": lambda u, v: torch.where(
        torch.logical_and(u > 0, v > 1).logical_or(torch.logical_not(u < 1)), u, v
    ),
    "xor": lambda u, v: (
        torch.where(torch.logical_xor(u > 0, v > 1) == (u > 0.5), u, v) + u.masked_fill(v > 1, 0.3)
    ),
    "mixed": lambda u, v: (
        torch.lerp(u, v, 0.3)
        + torch.addcmul(u, u, v, value=2)
        + torch.addcdiv(u, u, v)
        + u.hypot(v)
    ),
    "constants": lambda u, v: (
        u * torch.ones_like(u)
        + torch.full_like(u, 2.0)
        + torch.zeros_like(v)
        + u.new_tensor([1.0, 2, 3, 4])
    ),
    "factories": lambda u, v: (
        u * torch.arange(4)
        + v * torch.linspace(0, 1, 4, dtype=torch.float64)
        + torch.eye(4).double()[0]
    ),
}
OF_ONE = (
    "abs sign sgn sin cos tan atan deg2rad rad2deg tanh sinh cosh exp expm1 erf sigmoid relu "
    "square floor"
)
ELEMENTWISE |= {
    name: lambda u, v, name=name: getattr(torch, name)(u) * v for name in OF_ONE.split()
}
ELEMENTWISE |= {
    name: lambda u, v, name=name: getattr(torch, name)(v)
    for name in ("sqrt", "rsqrt", "log", "log1p")
}
ELEMENTWISE |= {
    name: lambda u, v, name=name: getattr(F, name)(u) * v
    for name in ("softplus", "silu", "elu", "selu", "gelu", "relu6", "leaky_relu", "hardtanh")
}
WHOLE = {  # of a (2, 3), b (3, 2), c (3,)
    "mm": lambda a, b, c: a @ b + b.T @ a.T,
    "mv": lambda a, b, c: a @ c + c @ b + torch.mv(a, c),
    "dot": lambda a, b, c: c @ c + torch.dot(a[0], c),
    "bmm": lambda a, b, c: (
        torch.bmm(a[None].expand(2, 2, 3), torch.stack([b, 2 * b])) + torch.matmul(a[None], b)
    ),
    "addmm": lambda a, b, c: torch.addmm(a[:, :2], a, b, beta=0.5, alpha=2.0),
    "addmv": lambda a, b, c: torch.addmv(c[:2], a, c),
    "linear": lambda a, b, c: F.linear(c, a, c[:2]) + F.linear(a, b.t(), c[:2]) + F.linear(c, a),
    "einsum": lambda a, b, c: torch.einsum("ij,jk,j->ik", a, b, c) + torch.outer(c[:2], c[1:]),
    "sum": lambda a, b, c: a.sum() + a.sum(0) + a.sum((0, 1), keepdim=True)[0] + b.sum(-1),
    "mean": lambda a, b, c: a.mean() + a.mean(0) + b.mean(1, keepdim=True)[:, 0],
    "prod": lambda a, b, c: a.prod() + a.prod(0) + b.prod(1),
    "norm": lambda a, b, c: (
        a.norm() + torch.linalg.vector_norm(a, dim=0) + torch.linalg.norm(c) + F.normalize(c, dim=0)
    ),
    "cumsum": lambda a, b, c: c.cumsum(0) + a.cumsum(1)[1] + b.cumsum(0)[:, 0],
    "extrema": lambda a, b, c: a.amax(0) + a.amin() + b.amax((0, 1)),
    "any": lambda a, b, c: (
        torch.where((a > 0).any(0), c, a[0]) + torch.where((a > -3).all(), c, 0.0)
    ),
    "cat": lambda a, b, c: torch.cat([c, a.flatten(), torch.ones(2, dtype=torch.float64)]) * 2,
    "stack": lambda a, b, c: torch.stack([a[0], c, b[:, 1]], dim=1) * torch.hstack([c[:1], c[1:]]),
    "index": lambda a, b, c: (
        a[1, [0, 2, 0]] + c[torch.tensor([True, False, True])][0] + c[-1] + c[[2, 1, 0]]
    ),
    "gather": lambda a, b, c: (
        c.gather(0, torch.tensor([2, 2, 1])) + torch.index_select(c, 0, torch.tensor([1, 0, 2]))
    ),
    "slice": lambda a, b, c: a[:, ::2] * b[1:, :] + a.select(1, 2)[:, None] + a.narrow(1, 1, 2),
    "views": lambda a, b, c: (
        a.reshape(3, 2) + a.view(-1).view(3, 2) + a.T.reshape(-1).unflatten(0, (3, 2)).contiguous()
    ),
    "axes": lambda a, b, c: (
        a[None].squeeze(0).unsqueeze(1).transpose(0, 2).permute(1, 2, 0)[0] + c.expand(2, 3) + b.mT
    ),
    "parts": lambda a, b, c: (
        sum(a.unbind(1)) + a.split(2, dim=1)[1][:, 0] + torch.chunk(b, 3)[0][0] + a.clone()[:, 0]
    ),
    "order": lambda a, b, c: (
        c.flip(0) + c.roll(1) + a.repeat(1, 2)[0, 1:4] + torch.diag(c)[1] + b.tril()[:, 0]
    ),
    "cross": lambda a, b, c: torch.linalg.cross(a, c.expand(2, 3)) + torch.cross(b[:, 0], c, dim=0),
    "pad": lambda a, b, c: F.pad(a, (1, 0), value=2.0) * 3,
    "vmap": lambda a, b, c: torch.func.vmap(lambda row: row @ c * row)(a),
}


KINK = 0.0, 0.5, -0.5, 1.0, -1.0
"""Places of u at which operations have their kinks."""


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_an_elementwise_operation_equals_torch(name):
    law = lambda x, p: ELEMENTWISE[name](x * p["scale"], 0.1 + x * x)
    parameters = {"scale": torch.tensor([1.0, 0.8, 1.2, -0.9], dtype=torch.float64)}
    points = [*_points(4, 8), *(torch.eye(1, 4)[0].double() * kink for kink in KINK)]
    _assert_equal_to_torch(law, points, parameters, value_tolerance=4e-15)


@pytest.mark.parametrize("name", WHOLE)
def test_an_operation_on_matrices_and_vectors_equals_torch(name):
    law = lambda x, p: WHOLE[name](
        x[:6].reshape(2, 3) * p["scale"], x[6:12].reshape(3, 2), x[12:]
    ).reshape(-1)
    parameters = {"scale": torch.tensor([1.0, 0.8, 1.2], dtype=torch.float64)}
    _assert_equal_to_torch(law, _points(15), parameters, value_tolerance=4e-15)


def test_sums_products_and_quotients_are_bitwise_those_of_torch_and_roots_are_rounded_correctly():
    law = lambda x, p: torch.cat(
        [(x * x[0] + p["a"]) / x[1] - (x * x + 1) * p["a"] / 3, x.abs().sqrt()]
    )
    parameters = _numbers(a=0.3)
    compiled = compile_law(law, _points(4)[0], parameters)
    for x in _points(4, 50):
        found = _compiled_results(compiled, x.numpy(), np.array([0.3]), np.ones(8))[0]
        np.testing.assert_array_equal(found[:4], law(x, parameters).numpy()[:4])
        np.testing.assert_array_equal(found[4:], np.sqrt(np.abs(x.numpy())))


LOOKUPS = {  # x (3,), table (4, 3)
    "nearest row": lambda x, t: F.embedding(((t - x) ** 2).sum(-1).argmin(), t) * x,
    "rows around": lambda x, t: F.embedding(torch.stack([x.argmin(), x.argmax() + 1]), t).prod(0),
    "by a cut number": lambda x, t: F.embedding((1.5 + x[:1].tanh()).floor().long(), t)[0] * x,
    "column": lambda x, t: F.embedding(x.argmin(), t.T[:, 1:]) * x,
    "expressions": lambda x, t: F.embedding((t @ x).argmin(), torch.sin(t) * x) + x,
    "inputs": lambda x, t: F.embedding(t[:, 1].argmin() * 0 + x.argmax(), x[:, None]) * t[0],
    "constants": lambda x, t: F.embedding(x.argmin(), torch.eye(3).double()) * x + t[0],
    "stopped": lambda x, t: F.embedding((t @ x).argmin(), t.detach()) * x + t[0],
    "counts": lambda x, t: x * (x > 0).sum() + t[0] * (-x[0]).long() + t[1] * (3 * x[1]).long(),
}


@pytest.mark.parametrize("name", LOOKUPS)
def test_rows_at_computed_places_equal_torch(name):
    table = {"table": torch.stack(_points(3, 4, seed=7))}
    _assert_equal_to_torch(
        lambda x, p: LOOKUPS[name](x, p["table"]), _points(3, 12), table, value_tolerance=4e-15
    )


@pytest.mark.parametrize("place", [-1.0, 4.0, 1e300, np.nan])
def test_a_place_outside_a_table_is_its_first(place):
    law = lambda x, p: F.embedding((x[0] - 1.0).long().clamp(-9, 9), p["table"]) * x[1]
    compiled = compile_law(
        law, torch.tensor([2.0, 1.0]).double(), {"table": torch.zeros(4, 1).double()}
    )
    out, _, p_bar = _compiled_results(
        compiled, np.array([place + 1.0, 3.0]), np.arange(5.0, 9.0), np.ones(1)
    )
    assert (out[0], *p_bar) == (15.0, 3.0, 0.0, 0.0, 0.0)


KINKS = {
    "minimum": lambda x: torch.minimum(x, 2 * x),
    "norm": lambda x: x.norm() * torch.ones(2, dtype=torch.float64),
    "atan2": lambda x: torch.atan2(x, x * 2),
    "square": lambda x: x**2 + x**1.5,
    "prod": lambda x: x * x.prod() + x.prod(),
    "power of zero": lambda x: x.pow(torch.tensor([0.0, 2.0]).double()) + (x + 1).pow(x),
}


@pytest.mark.parametrize("name", KINKS)
def test_conventions_at_kinks_are_those_of_torch(name):
    points = [torch.tensor(x, dtype=torch.float64) for x in ([0.0, 0.0], [1.0, 0.0])]
    _assert_equal_to_torch(lambda x, p: KINKS[name](x), points, {})


MASKS = {
    "sqrt": lambda x: torch.sqrt(x),
    "log": lambda x: x * torch.log(x) + torch.log1p(x - 1),
    "quotient": lambda x: 1 / (x + x.abs()) + x / x.relu(),
    "power": lambda x: x**0.3 + x**-1.5 + x.pow(x),
    "asin": lambda x: torch.asin(1 + x * 0 - x) + torch.acos(2 * x - 1),
    "exp": lambda x: torch.exp(1 / x) * torch.rsqrt(x),
}


@pytest.mark.parametrize("name", MASKS)
@pytest.mark.parametrize("x", [-1.0, 0.0, -1e-320])
def test_a_singular_branch_that_is_not_chosen_leaves_no_trace(name, x):
    def law(x, p):
        branch = MASKS[name](x * p["a"])
        return torch.cat([torch.where(x > 0, scale * branch, -x * p["a"]) for scale in (1, 2)])

    compiled = compile_law(law, torch.ones(1).double(), _numbers(a=2.0))
    out, J, p_bar = _compiled_results(
        compiled, np.array([x]), np.array([2.0]), np.array([1.0, 0.0])
    )
    assert (*out, *J.ravel(), *p_bar) == (-2 * x, -2 * x, -2.0, -2.0, -x)


def test_an_output_of_zero_weight_leaves_no_trace_in_the_pullback():
    compiled = compile_law(
        lambda x, p: torch.sqrt(x * p["a"]), torch.ones(2).double(), _numbers(a=1.0)
    )
    p_bar = _compiled_results(compiled, np.array([0.0, 4.0]), np.array([0.0]), np.zeros(2))[2]
    assert p_bar[0] == 0.0


def _detached(x, p):
    return x.detach() * x + (p["a"] * x).detach() + p["a"].detach() * p["a"]


def _under_no_grad(x, p):
    with torch.no_grad():
        y = torch.where(x > 0, p["a"] * x, x[0])
        with torch.enable_grad():
            y = y * x.exp()
    return y * x


def _by_a_slope(x, p):
    """A derivative that is taken without its own graph is a number to torch."""
    with torch.enable_grad():
        y = x.detach().requires_grad_()
        (slope,) = torch.autograd.grad((y**3 * p["a"]).sum(), y)
    return slope * x


@pytest.mark.parametrize("law", [_detached, _under_no_grad, _by_a_slope])
def test_where_torch_records_no_derivative_a_law_has_none(law):
    _assert_equal_to_torch(law, _points(3), _numbers(a=0.4))


def test_leading_outputs_and_inputs_are_chosen_and_the_pullback_accumulates():
    law = lambda x, p: torch.cat([x * p["a"], x**2])
    compiled = compile_law(law, _points(3)[0], _numbers(a=2.0), linear=2, differentiated=1)
    x, w = np.array([1.0, 2.0, 3.0]), np.array([1.0, 10.0])
    _, J, p_bar = _compiled_results(compiled, x, np.array([2.0]), w, start=10.0)
    np.testing.assert_array_equal(J, [[2.0], [0.0]])
    assert p_bar[0] == 10 + 1 + 20


def test_laws_without_parameters_or_inputs_or_outputs_work():
    _assert_equal_to_torch(lambda x, p: x * 2, _points(2), {})
    _assert_equal_to_torch(lambda x, p: x * 2, _points(2), {"none": torch.zeros(0, 3).double()})
    empty = compile_law(lambda x, p: p["a"].reshape(1), torch.zeros(0).double(), _numbers(a=1.0))
    out, J, p_bar = _compiled_results(empty, np.zeros(0), np.array([3.0]), np.array([2.0]))
    assert (out[0], J.shape, p_bar[0]) == (3.0, (1, 0), 2.0)
    assert compile_law(lambda x, p: x[:0], torch.ones(2).double(), {}).outputs == 0


class _Straight(torch.autograd.Function):
    """A limit through which the gradient passes as if there were none."""

    @staticmethod
    def forward(ctx, x):
        return x.clamp(max=0.5)

    @staticmethod
    def backward(ctx, g):
        return g


class _Reversed(_Straight):
    """The same number with another gradient, by no operation at all."""

    @staticmethod
    def forward(ctx, x):
        return x


REFUSED = {
    "operation without a rule": (lambda x, p: torch.special.bessel_j0(x), "bessel_j0"),
    "Python branch": (lambda x, p: x if x[0] > 0 else -x, r"use torch\.where"),
    "float": (lambda x, p: x * float(x[0]), "_local_scalar_dense"),
    "tolist": (lambda x, p: x * x.tolist()[0], "tolist"),
    "numpy": (lambda x, p: x * torch.from_numpy(x.numpy() * 2), "numpy"),
    "copy": (lambda x, p: torch.tensor([x[0], x[1]], dtype=torch.float64), "tensor"),
    "mask": (lambda x, p: x[x > 0], r"places that depend on values"),
    "in-place": (lambda x, p: x.clone().add_(1), "in-place operation aten.add_"),
    "float32": (lambda x, p: x.to(torch.float32).double(), "float32"),
    "bits": (lambda x, p: x * (x.argmin() & 1), "bitwise_and"),
    "whole quotient": (lambda x, p: x * (x.argmin() // 2), "floor_divide"),
    "place": (
        lambda x, p: torch.index_select(x, 0, x.argmin().reshape(1)),
        "look up rows of a parameter",
    ),
    "look-up without gradient": (
        lambda x, p: F.embedding(x.argmin(), x[:, None], padding_idx=1),
        "look-up with grad",
    ),
    "backward of one's own": (
        lambda x, p: _Straight.apply(x),
        "the torch.autograd.Function _Straight at .* cannot be compiled",
    ),
    "backward of one's own on nothing": (
        lambda x, p: _Reversed.apply(x),
        "the torch.autograd.Function _Reversed",
    ),
    "random": (lambda x, p: x + torch.rand(2, dtype=torch.float64), "random operation aten.rand"),
    "norm of order 1": (
        lambda x, p: torch.linalg.vector_norm(x, 1).reshape(1),
        "linalg_vector_norm",
    ),
    "rounding": (lambda x, p: torch.div(x, 2, rounding_mode="floor"), "a division that rounds"),
    "argument without a rule": (lambda x, p: torch.nan_to_num(x, nan=1.0), "nan_to_num"),
}


def test_a_law_that_torch_compiled_says_so():
    law = torch.compile(lambda x, p: x * p["a"], backend="aot_eager")
    with pytest.raises(UnknownOperation, match=r"torch\.compile is around it, .* leave that out"):
        compile_law(law, torch.ones(2).double(), _numbers(a=1.0))


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_compiled_is_refused_with_its_line(name):
    law, reason = REFUSED[name]
    with pytest.raises(UnknownOperation, match=reason) as error:
        compile_law(law, torch.ones(2).double(), {})
    assert f"{__file__}:" in str(error.value)
    assert "`" in str(error.value)
    source = str(error.value).split("`")[1]
    assert source
    assert source in Path(__file__).read_text(encoding="utf-8")


def test_a_law_that_depends_on_values_outside_torch_is_refused():
    state = []

    def law(x, p):
        state.append(1)
        return x * len(state)

    with pytest.raises(UnknownOperation, match="keeps a state"):
        compile_law(law, torch.ones(2).double(), {})


@pytest.mark.parametrize(
    "changes",
    [
        {"x": torch.ones(2)}, {"parameters": {"a": torch.ones(2)}},
        {"x": torch.ones(2, 2).double()}, {"function": lambda x, p: x[0]},
        {"function": lambda x, p: x > 0}, {"function": lambda x, p: (x, x)}, {"linear": 3},
        {"differentiated": -1},
    ],
)  # fmt: skip
def test_wrong_arguments_and_results_are_refused(changes):
    with pytest.raises((TypeError, ValueError)):
        compile_law(
            **{"function": lambda x, p: x, "x": torch.ones(2).double(), "parameters": {}} | changes
        )


def test_the_same_law_is_compiled_once():
    spring = lambda x, p: p["K"] * x.clamp(min=0.0)
    first, second = (compile_law(spring, x, _numbers(K=K)) for x, K in zip(_points(6), (1.0, 2.0)))
    other = compile_law(lambda x, p: spring(x, p) * 1.5, _points(6)[0], _numbers(K=1.0))
    assert first == second
    assert first.value != other.value


@numba.njit(nogil=True)
def _repeat(address, x, p, out, J, count):
    for k in range(count):
        call_linearise(address, x[k % 3], p[1:11], out[k % 3], J[k % 3])


def test_threads_that_compile_one_law_together_share_its_code(monkeypatch):
    """An engine that nobody holds is freed, and its addresses lead nowhere."""
    together, engine = threading.Barrier(8), emit._engine

    def slow(source):
        made = engine(source)
        together.wait(30)
        return made

    monkeypatch.setattr(emit, "_engine", slow)
    law = lambda x, p: torch.stack([x[0] * 17.25 + p["k"] * x[1]])
    arguments = _points(2)[0], {"k": torch.tensor(3.0, dtype=torch.float64)}
    with ThreadPoolExecutor(8) as pool:
        laws = list(pool.map(lambda _: compile_law(law, *arguments), range(8)))
    held = {engine.get_function_address("value") for engine in emit._engines.values()}
    assert {law.value for law in laws} <= held


def test_arrays_of_another_kind_are_refused_when_numba_compiles():
    law = compile_law(lambda x, p: x * 2, torch.ones(2).double(), {})
    with pytest.raises(numba.TypingError, match="C-contiguous float64"):
        _repeat(
            law.linearise,
            np.ones((3, 4))[:, ::2],
            np.ones(12),
            np.ones((3, 2)),
            np.ones((3, 2, 2)),
            1,
        )
    with pytest.raises(numba.TypingError, match="integer"):
        _repeat(1.5, np.ones((3, 2)), np.ones(12), np.ones((3, 2)), np.ones((3, 2, 2)), 1)


def test_a_captured_tensor_with_a_gradient_is_refused():
    """It would be a constant of the law, and its gradient lost without a word."""
    outside = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    with pytest.raises(
        UnknownOperation, match="requires a gradient and is no parameter of the law"
    ):
        compile_law(lambda x, p: x * (2 * outside), torch.ones(2, dtype=torch.float64), {})
    compile_law(lambda x, p: x * outside.detach(), torch.ones(2, dtype=torch.float64), {})
