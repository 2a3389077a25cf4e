"""Exact gradients of a whole run: the discrete adjoint of the implicit stepper, swept backwards in
the compiled kernels.

What a run was made with is fixed when it is made: the vector of parameters and the signals at its
stages are inputs of one autograd function, and whatever these were computed from receives its
gradient, whatever has become of the modules since.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.solve.kernel.arrays import Backward, room
from torchsoft.solve.kernel.objects import call
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.progress import Progress, Segment
from torchsoft.solve.stepper import ImplicitStepper
from torchsoft.threads import others_turn, parallel_map

TAPE_BYTES = 1e9
"""Tapes kept of one run [bytes]; beyond that the backward sweep makes each segment's again from
where it began."""


class GradientFailed(RuntimeError):
    """A gradient that there is not, or that is not finite: when [s] it ceased to be."""


class Solved(NamedTuple):
    """A run, finished or growing: what it was made with, what it left, and its segments if anything
    wants a gradient."""

    stepper: ImplicitStepper
    y0: Tensor
    out: Progress
    segments: list[Segment] | None

    @property
    def y(self) -> Tensor:
        """States (T, size), without a graph."""
        return torch.from_numpy(self.out.y)


def march(
    stepper: ImplicitStepper, y0: Tensor, t: Tensor, tape_bytes: float = TAPE_BYTES
) -> Iterator[Solved]:
    """The run from y0 (size,) through the times t (T,), after every compiled call; the last is
    complete."""
    segments: list[Segment] | None = (
        [] if torch.is_grad_enabled() and wants_gradient(stepper, y0) else None
    )
    for out in stepper.integrate(y0.detach(), t, segments, tape_bytes):
        yield Solved(stepper, y0, out, segments)


def attached(runs: Sequence[Solved], threads: int = 1) -> list[Tensor]:
    """The states (T, size) of finished runs with the discrete adjoint behind them, by y0,
    parameters and signals, but not by the times, where anything wants it. The backward sweeps of
    several runs go side by side in so many threads."""
    wanted = [run for run in runs if run.segments is not None]
    inputs: list[Tensor] = []
    for run in wanted:
        signals = run.stepper.signals([segment.plan for segment in run.segments or []])
        inputs += [run.y0, run.stepper.compiled.p, signals]
    solutions = iter(_Solutions.apply(wanted, threads, *inputs) if wanted else ())
    return [run.y if run.segments is None else next(solutions) for run in runs]


def wants_gradient(stepper: ImplicitStepper, y0: Tensor) -> bool:
    """Whether anything that a run is made with requires a gradient."""
    tensors = (y0, stepper.compiled.p, *stepper.reference.parameters(), stepper.signals_at_start)
    return any(tensor.requires_grad for tensor in tensors)


class _Solutions(torch.autograd.Function):
    """Passes the solutions through; its backward is the discrete adjoint of each."""

    @staticmethod
    def forward(
        ctx: Any, runs: Sequence[Solved], threads: int, *inputs: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.runs, ctx.threads = runs, threads
        ctx.set_materialize_grads(False)
        return tuple(run.y.clone() for run in runs)

    @staticmethod
    def backward(ctx: Any, *y_bars: Tensor | None) -> Any:
        if (
            torch.is_grad_enabled()
        ):  # a graph of it would lack how the cotangents depend on what ran
            raise GradientFailed(
                "a run has no second derivative; ask for its gradient without create_graph"
            )
        bars: list[Tensor | None] = [None] * (3 * len(y_bars))
        asked = [(i, y_bar) for i, y_bar in enumerate(y_bars) if y_bar is not None]

        def sweep(k: int) -> tuple[Tensor, Tensor, Tensor]:
            i, y_bar = asked[k]
            return run_adjoint(ctx.runs[i].stepper, ctx.runs[i].segments, y_bar)

        for k, result in parallel_map(sweep, len(asked), ctx.threads, turns=True):
            bars[3 * asked[k][0] : 3 * asked[k][0] + 3] = result
        return None, None, *bars


def run_adjoint(
    stepper: ImplicitStepper, segments: list[Segment], y_bar: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Cotangents of y0 (size,), of the parameters' vector and of the signals (stages, signals, 2),
    from those of the outputs, y_bar (T, size). Raises `GradientFailed` where one is not finite."""
    rows: Array = np.ascontiguousarray(y_bar.numpy())
    if not np.isfinite(rows).all():
        raise GradientFailed(
            f"the cotangent of output {int(np.argwhere(~np.isfinite(rows))[0][0])} is not finite"
        )
    size = stepper.layout.size
    carried, p_bar = np.zeros(size), np.zeros(len(stepper.compiled.p))
    signals_bar = [np.zeros(segment.signals.shape) for segment in segments]
    for number in range(len(segments) - 1, -1, -1):
        segment = segments[number]
        plan, tape = segment.plan, stepper.tape(segment)
        s = stepper.compiled.system(float(plan.h[0]))
        failed = np.zeros(1, np.int64)
        sweep = Backward(
            s, room("Work", s, size, columns=1), room("Cotangents", s, size), tape, plan.h,
            segment.signals, plan.out_step, plan.out_part, rows[segment.rows], carried, p_bar,
            signals_bar[number], failed,
        )  # fmt: skip
        with others_turn():
            call("backward", sweep)
        if failed[0] >= 0:
            time = plan.starts[failed[0]]
            raise GradientFailed(f"the gradient is not finite at t = {time:.4f} s")
    return (
        torch.from_numpy(carried) + y_bar[0],
        torch.from_numpy(p_bar),
        torch.from_numpy(np.concatenate(signals_bar)),
    )


class _Recorded(torch.autograd.Function):
    """A recorded series beside the states that have a gradient: it has none, and says so when one
    is asked for."""

    @staticmethod
    def forward(ctx: Any, name: str, series: Tensor, y: Tensor) -> Tensor:
        ctx.name = name
        return series.clone()

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        if bool((bar != 0).any()):
            raise GradientFailed(
                f"the channel `{ctx.name}` is recorded and has no gradient; detach() it"
            )
        return None, None, None


def recorded(name: str, series: Tensor, y: Tensor) -> Tensor:
    """A series (T,) that came out of the run of states y (T, size), whose gradient would be wrong
    rather than zero."""
    return _Recorded.apply(name, series, y) if y.requires_grad else series  # pyright: ignore[reportReturnType]
