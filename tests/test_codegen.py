"""Compiled laws against torch: values, Jacobians and pulls of every operation, also at kinks
and singular places; what torch does not differentiate; what is rejected."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from torch.nn import functional as F
from torch.utils._python_dispatch import TorchDispatchMode

from torchsoft.codegen import UnknownOperation, compile_law, emit, operations
from torchsoft.solve.kernel.invoke import call_linearise, call_pull, call_push, call_value


@numba.njit(nogil=True)
def _call_all(value, linearise, push, pull, x, p, d, w, out, again, J, along, p_bar):
    call_value(value, x, p, out)
    call_linearise(linearise, x, p, again, J)
    call_push(push, x, p, d, along)
    call_pull(pull, x, p, w, p_bar)


def _compiled(law, x, p, w, start=0.0):
    """Value, Jacobian, and what the pull adds to the start, whose transpose the push is."""
    x, p, w = (torch.as_tensor(one, dtype=torch.float64).numpy() for one in (x, p, w))
    out, again = np.empty(law.outputs), np.empty(law.outputs)
    J, p_bar = np.empty((law.linear, law.differentiated)), np.full(law.parameters, start)
    d, along = np.linspace(0.3, 1.1, law.parameters), np.empty(law.linear)
    entries = law.value, law.linearise, law.push, law.pull
    _call_all(*entries, x, p, d, w, out, again, J, along, p_bar)
    np.testing.assert_array_equal(out, again)
    parts, weighted = d * (p_bar - start), w[w != 0] * along[w != 0]
    size = max(np.abs(parts).max(initial=1.0), np.abs(weighted).max(initial=1.0))
    np.testing.assert_allclose(weighted.sum(), parts.sum(), rtol=1e-11, atol=1e-12 * size)
    return out, J, p_bar


def _by_torch(function, x, parameters, w):
    """Value, Jacobian in x, and gradient of w times the value in all parameters."""
    leaves = {name: p.detach().clone().requires_grad_() for name, p in parameters.items()}
    x = x.clone().requires_grad_()
    wanted = [x, *leaves.values()]
    out = function(x, leaves) + 0 * sum(one.sum() for one in wanted)
    ask = lambda scalar: torch.autograd.grad(scalar, wanted, retain_graph=True)
    bars = [torch.zeros(0).double(), *(g.flatten() for g in ask((out * w).sum())[1:])]
    return out.detach(), torch.stack([ask(one)[0] for one in out]), torch.cat(bars)


def _assert_equal_to_torch(function, points, parameters):
    """The law compiled at the first point agrees with torch at every point."""
    law = compile_law(function, points[0], parameters)
    p = torch.cat([torch.zeros(0).double(), *(q.detach().flatten() for q in parameters.values())])
    w = torch.linspace(0.5, 1.7, law.outputs, dtype=torch.float64)
    for x in points:
        expected = [one.numpy() for one in _by_torch(function, x, parameters, w)]
        for one, found, tolerance in zip(expected, _compiled(law, x, p, w), (4e-15, 1e-13, 1e-13)):
            scale = max(1.0, np.abs(one).max(initial=0.0))
            np.testing.assert_allclose(found, one, rtol=tolerance, atol=tolerance * scale)
    return law


def _points(n, count=5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return list(torch.randn(count, n, dtype=torch.float64, generator=generator))


def _numbers(**values):
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}


# operations

ELEMENTWISE = """
2 + u + v - (1 - u) + torch.add(u, v, alpha=3) - torch.sub(u, v, alpha=0.5)
-u * v / (2 / v) * torch.reciprocal(v) / 3
u**2 + u**3 + v**2.5 + 2**u + v**u + v**-1 + v**-2 + v**0.5 + u**1 + u**0
abs(u)**1.5 + u.pow(torch.tensor([0.0, 2.0, 1.0, 3.0]).double()) + (v + 1).pow(u)
torch.asin(u.tanh()) + torch.acos(u.sin() / 2)
F.softplus(u, 3.0, 1.0) + F.silu(-700 * v) + F.leaky_relu(u, 0.1) + F.elu(u, 0.7)
F.gelu(u, approximate="tanh") + torch.atan2(u, v)
torch.atan2(u, 2 * u)
u.clamp(-0.5, 0.5) + u.clamp(min=0.1) + u.clamp(max=v) + u.clamp(-v, v)
torch.clamp_min(u, 0.2) * torch.clamp_max(u, 0.7) + torch.clamp_max(u, v)
torch.maximum(u, v) * torch.minimum(u, -v) + torch.max(u, -u) + torch.minimum(u, 2 * u)
torch.where(u > v, u, v) + torch.where(u <= 0, 2.0, v) + torch.where(u < 0, v, 1.0)
(u >= v).double() * u + (u == v) * v + (u != 0).to(torch.float64) * v + u * (u < v)
torch.where((u > 0) & ~(v > 1) | (u > 1) ^ (v > 2), u, v)
torch.where(torch.logical_and(u > 0, v > 1).logical_or(torch.logical_not(u < 1)), u, v)
torch.where(torch.logical_xor(u > 0, v > 1) == (u > 0.5), u, v) + u.masked_fill(v > 1, 0.3)
torch.lerp(u, v, 0.3) + torch.addcmul(u, u, v, value=2) + torch.addcdiv(u, u, v) + u.hypot(v)
u * torch.ones_like(u) + torch.full_like(u, 2) + torch.zeros_like(v) + u.new_tensor([1.0, 2, 3, 4])
u * torch.arange(4) + v * torch.linspace(0, 1, 4, dtype=torch.float64) + torch.eye(4).double()[0]
abs(u) * v + u.sign() * v + u.sgn() + u.floor() * v
u.sin() * v + u.cos() + u.tan() * v + u.atan() + u.tanh() * v
torch.deg2rad(u) + torch.rad2deg(v) + u.sinh() * v + u.cosh()
u.exp() * v + u.expm1() * v + u.erf() * v + u.sigmoid() * v
u.relu() * v + u.square() * v + F.softplus(u) * v
v.sqrt() + v.rsqrt() + v.log() + v.log1p()
F.silu(u) * v + F.elu(u) * v + F.selu(u) * v + F.gelu(u) * v
F.relu6(u) * v + F.leaky_relu(u) * v + F.hardtanh(u) * v
"""
"""Of u (4,), any numbers, and v (4,), positive numbers."""
WHOLE = """
a @ b + b.T @ a.T
a @ c + c @ b + torch.mv(a, c)
c @ c + torch.dot(a[0], c) + torch.vdot(c, a[1])
torch.bmm(a[None].expand(2, 2, 3), torch.stack([b, 2 * b])) + torch.matmul(a[None], b)
torch.baddbmm(a[None, :, :2], a[None], b[None], beta=0.5)
torch.addmm(a[:, :2], a, b, beta=0.5, alpha=2.0)
torch.addmv(c[:2], a, c)
F.linear(c, a, c[:2]) + F.linear(a, b.t(), c[:2]) + F.linear(c, a)
torch.einsum("ij,jk,j->ik", a, b, c) + torch.outer(c[:2], c[1:])
a.sum() + a.sum(0) + a.sum((0, 1), keepdim=True)[0] + b.sum(-1)
a.mean() + a.mean(0) + b.mean(1, keepdim=True)[:, 0]
a.prod() + a.prod(0) + b.prod(1) + c * c[:2].prod()
a.norm() + torch.linalg.vector_norm(a, dim=0) + torch.linalg.norm(c)
c.cumsum(0) + a.cumsum(1)[1] + b.cumsum(0)[:, 0]
(c + t).amax(0) + (a + t[:2]).amin() + (b.T - t[:2]).amax((0, 1))
torch.where((a > 0).any(0), c, a[0]) + torch.where((a > -3).all(), c, 0.0)
torch.cat([c, a.flatten(), torch.ones(2, dtype=torch.float64)]) * 2
torch.stack([a[0], c, b[:, 1]], dim=1) * torch.hstack([c[:1], c[1:]])
a[1, [0, 2, 0]] + c[torch.tensor([True, False, True])][0] + c[-1] + c[[2, 1, 0]]
c.gather(0, torch.tensor([2, 2, 1])) + torch.index_select(c, 0, torch.tensor([1, 0, 2]))
a[:, ::2] * b[1:, :] + a.select(1, 2)[:, None] + a.narrow(1, 1, 2)
a.reshape(3, 2) + a.view(-1).view(3, 2) + a.T.reshape(-1).unflatten(0, (3, 2)).contiguous()
a[None].squeeze(0).unsqueeze(1).transpose(0, 2).permute(1, 2, 0)[0] + c.expand(2, 3) + b.mT
sum(a.unbind(1)) + a.split(2, dim=1)[1][:, 0] + torch.chunk(b, 3)[0][0] + a.clone()[:, 0]
c.flip(0) + c.roll(1) + a.repeat(1, 2)[0, 1:4] + torch.diag(c)[1] + b.tril()[:, 0]
torch.linalg.cross(a, c.expand(2, 3)) + torch.cross(b[:, 0], c, dim=0)
F.pad(a, (1, 0), value=2.0) * 3
torch.func.vmap(lambda row: row @ c * row)(a)
"""
"""Of a (2, 3), b (3, 2), c (3,)."""
LOOKUPS = """
F.embedding(((t - c) ** 2).sum(-1).argmin(), t) * c
F.embedding(torch.stack([c.argmin(), c.argmax() + 1]), t).prod(0)
F.embedding((1.5 + c[:1].tanh()).floor().long(), t)[0] * c
F.embedding(c.argmin(), t.T[:, 1:]) * c
F.embedding((t @ c).argmin(), torch.sin(t) * c) + c
F.embedding(t[:, 1].argmin() * 0 + c.argmax(), c[:, None]) * t[0]
F.embedding(c.argmin(), torch.eye(3).double()) * c + t[0]
F.embedding((t @ c).argmin(), t.detach()) * c + t[0]
c * (c > 0).sum() + t[0] * (-c[0]).long() + t[1] * (3 * c[1]).long()
"""
"""Of c (3,) and a table t (4, 3)."""
EXPRESSIONS = [one for all in (ELEMENTWISE, WHOLE, LOOKUPS) for one in all.strip().splitlines()]
SCALES = torch.tensor([1.0, 0.5, 2.0, -1.0]).double()
KINKS = [[0.0, 1.0, -0.25, -1.0], [-1.0, -1.0, 0.5, 0.0], [0.0] * 4]
"""Places x of u = `SCALES` x at which operations have their kinks."""


def _law(expression):
    code = compile(expression, expression, "eval")

    def law(x, p):
        a, b, c = (x[:6] * p["scale"][0]).reshape(2, 3), x[6:12].reshape(3, 2), x[12:]
        of = {"u": x[:4] * p["scale"], "v": 0.1 + x[:4] ** 2, "a": a, "b": b, "c": c, "t": p["t"]}
        return eval(code, {"torch": torch, "F": F} | of).reshape(-1)

    return law


PARAMETERS = {"scale": SCALES, "t": torch.stack(_points(3, 4, seed=7))}
POINTS = [*_points(15), *(torch.tensor([*x, *[0.0] * 11]).double() for x in KINKS)]


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_an_operation_equals_torch(expression):
    _assert_equal_to_torch(_law(expression), POINTS, PARAMETERS)


def test_every_operation_that_has_a_rule_is_compared_with_torch():
    class Seen(TorchDispatchMode):
        @classmethod
        def _should_skip_dynamo(cls):  # which takes a second to import
            return False

        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            seen.add(func._schema.name.partition("::")[2])
            return func(*args, **(kwargs or {}))

    seen = set()
    with Seen():
        for expression in EXPRESSIONS:
            _law(expression)(POINTS[0], PARAMETERS)
    rules = {*operations.ELEMENTWISE, *operations.WHOLE, *operations.COMPOSED}
    decomposed = {"fill", "square", "copy", "linear", "matmul"}  # by torch
    inside = {
        "tanh_backward",
        "sigmoid_backward",
        "threshold_backward",
    }  # in derivatives inside a law
    assert rules - seen <= decomposed | inside


def test_sums_products_and_quotients_are_bitwise_those_of_torch_and_roots_are_rounded_correctly():
    law = lambda x, p: torch.cat(
        [(x * x[0] + p["a"]) / x[1] - (x * x + 1) * p["a"] / 3, x.abs().sqrt()]
    )
    parameters = _numbers(a=0.3)
    compiled = compile_law(law, _points(4)[0], parameters)
    for x in _points(4, 50):
        found = _compiled(compiled, x, [0.3], np.ones(8))[0]
        np.testing.assert_array_equal(found[:4], law(x, parameters).numpy()[:4])
        np.testing.assert_array_equal(found[4:], np.sqrt(np.abs(x.numpy())))


def test_derivatives_inside_a_law_equal_torch():
    def law(x, p):
        of = lambda y: (torch.tanh(y * p["a"]) ** 3 + torch.sigmoid(y) + torch.relu(y)).sum()
        return torch.func.grad(of)(x)

    _assert_equal_to_torch(law, _points(3), _numbers(a=0.6))


@pytest.mark.parametrize("place", [-1.0, 4.0, 1e300, np.nan])
def test_a_place_outside_a_table_is_its_first(place):
    law = lambda x, p: F.embedding((x[0] - 1.0).long().clamp(-9, 9), p["table"]) * x[1]
    table = {"table": torch.zeros(4, 1).double()}
    compiled = compile_law(law, torch.tensor([2.0, 1.0]).double(), table)
    out, _, p_bar = _compiled(compiled, [place + 1.0, 3.0], np.arange(5.0, 9.0), [1.0])
    assert (out[0], *p_bar) == (15.0, 3.0, 0.0, 0.0, 0.0)


MASKED = [
    lambda x: torch.sqrt(x),
    lambda x: x * torch.log(x) + torch.log1p(x - 1),
    lambda x: 1 / (x + x.abs()) + x / x.relu(),
    lambda x: x**0.3 + x**-1.5 + x.pow(x),
    lambda x: torch.asin(1 + x * 0 - x) + torch.acos(2 * x - 1),
    lambda x: torch.exp(1 / x) * torch.rsqrt(x),
]


@pytest.mark.parametrize("of", MASKED)
def test_a_singular_branch_that_is_not_chosen_leaves_no_trace(of):
    def law(x, p):
        branch = of(x * p["a"])
        return torch.cat([torch.where(x > 0, scale * branch, -x * p["a"]) for scale in (1, 2)])

    compiled = compile_law(law, torch.ones(1).double(), _numbers(a=2.0))
    for x in (-1.0, 0.0, -1e-320):
        out, J, p_bar = _compiled(compiled, [x], [2.0], [1.0, 0.0])
        assert (*out, *J.ravel(), *p_bar) == (-2 * x, -2 * x, -2.0, -2.0, -x)


def test_an_output_of_zero_weight_leaves_no_trace_in_the_pull():
    law = lambda x, p: torch.sqrt(x * p["a"])
    compiled = compile_law(law, torch.ones(2).double(), _numbers(a=1.0))
    assert _compiled(compiled, [0.0, 4.0], [0.0], [0.0, 0.0])[2][0] == 0.0


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


def test_leading_outputs_and_inputs_are_chosen_and_the_pull_accumulates():
    law = lambda x, p: torch.cat([x * p["a"], x**2])
    compiled = compile_law(law, _points(3)[0], _numbers(a=2.0), linear=2, differentiated=1)
    _, J, p_bar = _compiled(compiled, [1.0, 2.0, 3.0], [2.0], [1.0, 10.0], start=10.0)
    np.testing.assert_array_equal(J, [[2.0], [0.0]])
    assert p_bar[0] == 10 + 1 + 20


def test_laws_without_parameters_or_inputs_or_outputs_work():
    _assert_equal_to_torch(lambda x, p: x * 2, _points(2), {})
    _assert_equal_to_torch(lambda x, p: x * 2, _points(2), {"none": torch.zeros(0, 3).double()})
    empty = compile_law(lambda x, p: p["a"].reshape(1), torch.zeros(0).double(), _numbers(a=1.0))
    out, J, p_bar = _compiled(empty, [], [3.0], [2.0])
    assert (out[0], J.shape, p_bar[0]) == (3.0, (1, 0), 2.0)
    assert compile_law(lambda x, p: x[:0], torch.ones(2).double(), {}).outputs == 0


# what is rejected


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


REJECTED = [
    (lambda x, p: torch.special.bessel_j0(x), "bessel_j0"),
    (lambda x, p: x if x[0] > 0 else -x, r"use torch\.where"),
    (lambda x, p: x * float(x[0]), "_local_scalar_dense"),
    (lambda x, p: x * x.tolist()[0], "tolist"),
    (lambda x, p: x * torch.from_numpy(x.numpy() * 2), "numpy"),
    (lambda x, p: torch.tensor([x[0], x[1]], dtype=torch.float64), "tensor"),
    (lambda x, p: x[x > 0], "places that depend on values"),
    (lambda x, p: x.clone().add_(1), "in-place operation aten.add_"),
    (lambda x, p: x.to(torch.float32).double(), "float32"),
    (lambda x, p: x * (x.argmin() & 1), "bitwise_and"),
    (lambda x, p: torch.index_select(x, 0, x.argmin().reshape(1)), "look up rows of a parameter"),
    (lambda x, p: F.embedding(x.argmin(), x[:, None], padding_idx=1), "look-up with grad"),
    (lambda x, p: _Straight.apply(x), "the torch.autograd.Function _Straight at .* be compiled"),
    (lambda x, p: _Reversed.apply(x), "the torch.autograd.Function _Reversed"),
    (lambda x, p: x + torch.rand(2, dtype=torch.float64), "random operation aten.rand"),
    (lambda x, p: torch.linalg.vector_norm(x, 1).reshape(1), "linalg_vector_norm"),
    (lambda x, p: torch.div(x, 2, rounding_mode="floor"), "a division that rounds"),
]


@pytest.mark.parametrize(("law", "reason"), REJECTED, ids=[reason for _, reason in REJECTED])
def test_what_cannot_be_compiled_is_rejected_with_its_line(law, reason):
    with pytest.raises(UnknownOperation, match=reason) as error:
        compile_law(law, torch.ones(2).double(), {})
    assert f"{__file__}:" in str(error.value)
    source = str(error.value).split("`")[1]
    assert source
    assert source in Path(__file__).read_text(encoding="utf-8")


def test_a_law_that_torch_compiled_says_so():
    law = torch.compile(lambda x, p: x * p["a"], backend="aot_eager")
    with pytest.raises(UnknownOperation, match=r"torch\.compile is around it, .* leave that out"):
        compile_law(law, torch.ones(2).double(), _numbers(a=1.0))


def test_a_law_with_a_state_or_a_captured_parameter_is_rejected():
    """The state, or the gradient, would be lost without a word."""
    state, x = [], torch.ones(2).double()
    outside = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    with pytest.raises(UnknownOperation, match="keeps a state"):
        compile_law(lambda x, p: x * len(state.append(1) or state), x, {})
    with pytest.raises(UnknownOperation, match="requires a gradient and is no parameter"):
        compile_law(lambda x, p: x * (2 * outside), x, {})
    compile_law(lambda x, p: x * outside.detach(), x, {})


@pytest.mark.parametrize(
    "changes",
    [
        {"x": torch.ones(2)}, {"parameters": {"a": torch.ones(2)}}, {"linear": 3},
        {"x": torch.ones(2, 2).double()}, {"function": lambda x, p: x[0]},
        {"function": lambda x, p: (x, x)}, {"differentiated": -1},
    ],
)  # fmt: skip
def test_wrong_arguments_and_results_are_rejected(changes):
    given = {"function": lambda x, p: x, "x": torch.ones(2).double(), "parameters": {}} | changes
    with pytest.raises((TypeError, ValueError)):
        compile_law(**given)


def test_the_same_law_is_compiled_once():
    spring = lambda x, p: p["K"] * x.clamp(min=0.0)
    first, second = (compile_law(spring, x, _numbers(K=K)) for x, K in zip(_points(6), (1.0, 2.0)))
    other = compile_law(lambda x, p: spring(x, p) * 1.5, _points(6)[0], _numbers(K=1.0))
    assert first == second
    assert first.value != other.value


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


@pytest.mark.parametrize(("law", "x"), [(1, np.ones(4)[::2]), (1.5, np.ones(2))])
def test_arrays_of_another_kind_are_rejected_when_numba_compiles(law, x):
    call = numba.njit(lambda law, x, p, out: call_value(law, x, p, out))
    with pytest.raises(numba.TypingError, match=r"C-contiguous float64|integer"):
        call(law, x, np.ones(0), np.ones(2))
