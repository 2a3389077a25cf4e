"""Exact gradients of a whole run: the discrete adjoint of the implicit stepper, swept backwards in the compiled kernels.

What a run was made with is fixed when it is made: the vector of parameters and the signals at its stages are inputs of one
autograd function, and whatever these were computed from receives its gradient, whatever has become of the modules since.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.solve.kernel.adjoint import backward
from torchsoft.solve.kernel.arrays import Array
from torchsoft.solve.kernel.scratch import cotangents, scratch
from torchsoft.solve.progress import Progress, Segment
from torchsoft.solve.stepper import ImplicitStepper

TAPE_BYTES = 1e9
"""Tapes kept of one run [bytes]; beyond that the backward sweep makes each segment's again from where it began."""


class GradientFailed(RuntimeError):
    """A gradient that there is not, or that is not finite: when [s] it ceased to be."""


def iterate(stepper: ImplicitStepper, y0: Tensor, t: Tensor) -> Iterator[tuple[Tensor, Progress]]:
    """States (T, size) at the times t (T,) as the run grows; the last yield has the discrete adjoint behind it, if
    anything that
    the run was made with wants a gradient and gradients are enabled: y0 (size,), parameters, signals, but not t."""
    segments: list[Segment] | None = [] if torch.is_grad_enabled() and wants_gradient(stepper, y0) else None
    out = None
    for out in stepper.integrate(y0.detach(), t, segments, TAPE_BYTES):
        yield torch.from_numpy(out.y), out
    assert out is not None
    solution = torch.from_numpy(out.y)
    if segments is not None:
        signals = stepper.signals([segment.plan for segment in segments])
        solution = _Solution.apply(stepper, segments, solution, y0, stepper.compiled.p, signals)
    yield solution, out  # pyright: ignore[reportReturnType]


def wants_gradient(stepper: ImplicitStepper, y0: Tensor) -> bool:
    """Whether anything that a run is made with requires a gradient."""
    tensors = (y0, stepper.compiled.p, *stepper.reference.parameters(), stepper.signals_at_start)
    return any(tensor.requires_grad for tensor in tensors)


class _Solution(torch.autograd.Function):
    """Passes the solution through; its backward is the discrete adjoint."""

    @staticmethod
    def forward(
        ctx: Any, stepper: ImplicitStepper, segments: list[Segment], y: Tensor, y0: Tensor, p: Tensor, signals: Tensor
    ) -> Tensor:
        ctx.stepper, ctx.segments, ctx.shape = stepper, segments, signals.shape
        return y.clone()

    @staticmethod
    def backward(ctx: Any, y_bar: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        if torch.is_grad_enabled():  # a graph of it would lack how the cotangents depend on what ran
            raise GradientFailed("a run has no second derivative; ask for its gradient without create_graph")
        return None, None, None, *run_adjoint(ctx.stepper, ctx.segments, y_bar)


def run_adjoint(stepper: ImplicitStepper, segments: list[Segment], y_bar: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cotangents of y0 (size,), of the parameters' vector and of the signals (stages, signals, 2), from those of the outputs,
    y_bar (T, size). Raises `GradientFailed` where one is not finite."""
    rows: Array = np.ascontiguousarray(y_bar.numpy())
    if not np.isfinite(rows).all():
        raise GradientFailed(f"the cotangent of output {int(np.argwhere(~np.isfinite(rows))[0][0])} is not finite")
    size = stepper.layout.size
    carried, p_bar = np.zeros(size), np.zeros(len(stepper.compiled.p))
    signals_bar = [np.zeros(segment.signals.shape) for segment in segments]
    for number in range(len(segments) - 1, -1, -1):
        segment = segments[number]
        plan, tape = segment.plan, stepper.tape(segment)
        s = stepper.compiled.system(float(plan.h[0]))
        failed = backward(
            s, scratch(s, size), cotangents(s, size), plan.h, tape, segment.signals, plan.out_step, plan.out_part,
            rows[segment.rows], carried, p_bar, signals_bar[number],
        )  # fmt: skip
        if failed >= 0:
            raise GradientFailed(f"the gradient is not finite at t = {plan.starts[failed]:.4f} s")
    return torch.from_numpy(carried) + y_bar[0], torch.from_numpy(p_bar), torch.from_numpy(np.concatenate(signals_bar))


class _Recorded(torch.autograd.Function):
    """A recorded series beside the states that have a gradient: it has none, and says so when one is asked for."""

    @staticmethod
    def forward(ctx: Any, name: str, series: Tensor, y: Tensor) -> Tensor:
        ctx.name = name
        return series.clone()

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        if bool((bar != 0).any()):
            raise GradientFailed(f"the channel `{ctx.name}` is recorded and has no gradient; detach() it")
        return None, None, None


def recorded(name: str, series: Tensor, y: Tensor) -> Tensor:
    """A series (T,) that came out of the run of states y (T, size), whose gradient would be wrong rather than zero."""
    return _Recorded.apply(name, series, y) if y.requires_grad else series  # pyright: ignore[reportReturnType]
