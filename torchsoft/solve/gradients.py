"""Derivatives of a whole run: the discrete adjoint, and forward sensitivities."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.parallel import parallel_map, released_turn
from torchsoft.physics.channels import Sums
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import Layout
from torchsoft.solve.kernel.arrays import Backward, Forward
from torchsoft.solve.kernel.objects import call
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.progress import Progress, Segment
from torchsoft.solve.stepper import ImplicitStepper

# Exact gradients of a whole run: the discrete adjoint of the implicit stepper, swept backwards in
# the compiled kernels.
#
# The inputs of a run are fixed when it is made: the vector of parameters and the signals at its
# stages are inputs of one autograd function, and the tensors that these were computed from
# receive their gradient, even where modules have changed since.


TAPE_BYTES = 1e9
"""Tapes kept of one run [bytes]; beyond that the backward sweep makes each segment's again from
where it began."""


AMPLIFIED = 1e8
"""Change of a run, over its own size, by a parameter or a start that changes by their own size,
from which on a gradient is of no use."""

SMALL = 1e-3
"""Size [N, m, rad, m/s] below which a part of the state or a force counts as that large."""


def sizes_of(layout: Layout, y: Array) -> Array:
    """Sizes (size,) of the components of states y (T, size): of the largest of their part."""
    sizes = np.full(layout.size, SMALL)
    for where in layout.slices.values():
        sizes[where] = np.abs(y[:, where]).max(initial=SMALL)
    return sizes


def warn_of_amplified(most: float) -> None:
    """A warning of a gradient that is `most` times as large as what is differentiated."""
    if most > AMPLIFIED:
        warn(
            f"a parameter or a start that changes by 1e-{math.floor(math.log10(most)):02d} of "
            "itself moves the run by its own size: the gradient is exact for the steps that ran "
            "and holds for no change that matters, since the rig amplifies differences, by an "
            "unstable loop that friction or lost contact bounds, or by impacts; differentiate a "
            "shorter run, or a stable rig",
        )


class GradientFailed(RuntimeError):
    """A gradient that there is not, or that is not finite: when [s] it ceased to be."""


Route = Literal["none", "discrete", "forward"]
"""Ways to a derivative: none; the exact adjoint of the run; sensitivities along `wrt`."""


class Task(NamedTuple):
    """A run that may begin: the arguments of `simulate`, checked. The stepper has a snapshot of the
    `rig`; `leaves` are the parameters `wrt`, and more tensors, of which start and reference were
    made."""

    stepper: ImplicitStepper
    t: Tensor
    y0: Tensor
    gradient: Route = "discrete"
    wrt: tuple[str, ...] = ()
    dy0: Tensor | None = None
    rigid: bool = False
    touch: tuple[str, ...] = ()
    rig: Rig | None = None
    leaves: tuple[Tensor, ...] = ()


class Solved(NamedTuple):
    """A run, finished or growing: its results, its segments where a gradient is needed, and the
    derivatives of states and of sums of forces where those are asked for."""

    task: Task
    out: Progress
    segments: list[Segment] | None
    slopes: tuple[Tensor, Tensor] | None = None

    @property
    def rows(self) -> tuple[Tensor, Tensor]:
        """States (T, size) and recorded forces (T, recorded), without a graph."""
        return torch.from_numpy(self.out.y), torch.from_numpy(self.out.recorded)


def march(task: Task, tape_bytes: float = TAPE_BYTES) -> Iterator[Solved]:
    """The run after every compiled call; the last is complete."""
    wanted = torch.is_grad_enabled() and wants_gradient(task.stepper, task.y0)
    segments: list[Segment] | None = [] if wanted else None
    for out in task.stepper.integrate(task.y0.detach(), task.t, segments, tape_bytes):
        yield Solved(task, out, segments)


def attached(runs: Sequence[Solved], threads: int = 1) -> list[tuple[Tensor, Tensor]]:
    """The `rows` of finished runs with the discrete adjoint behind them, by y0, parameters and
    signals, but not by the times, where anything wants it. The backward sweeps of several runs go
    side by side in so many threads."""
    differentiated = [run for run in runs if run.segments is not None]
    inputs: list[Tensor] = []
    for run in differentiated:
        stepper, t = run.task.stepper, run.task.t
        times = [segment.plan.stage_times.ravel() for segment in run.segments or []]
        signals = stepper.signals_at(np.concatenate([*times, t.numpy() - stepper.origin]))
        inputs += [run.task.y0, stepper.parameters.p, signals[: -len(t)], signals[-len(t) :]]
    flat = iter(_Solutions.apply(differentiated, threads, *inputs) if differentiated else ())
    solutions = zip(flat, flat)
    return [run.rows if run.segments is None else next(solutions) for run in runs]


def wants_gradient(stepper: ImplicitStepper, y0: Tensor) -> bool:
    """Whether anything that a run is made with requires a gradient."""
    tensors = (y0, stepper.parameters.p, *stepper.reference.parameters())
    return any(x.requires_grad for x in tensors) or stepper.signals_at_start.requires_grad


class _Solutions(torch.autograd.Function):
    """Passes the solutions through; its backward is the discrete adjoint of each."""

    @staticmethod
    def forward(
        ctx: Any, runs: Sequence[Solved], threads: int, *inputs: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.runs, ctx.threads = runs, threads
        ctx.set_materialize_grads(False)
        return tuple(part.clone() for run in runs for part in run.rows)

    @staticmethod
    def backward(ctx: Any, *given: Tensor | None) -> Any:
        if (
            torch.is_grad_enabled()
        ):  # its graph would lack the dependence of the cotangents on the run
            raise GradientFailed(
                "a run has no second derivative; ask for its gradient without create_graph"
            )
        bars: list[Tensor | None] = [None] * (4 * len(ctx.runs))
        pairs = list(zip(given[::2], given[1::2]))
        needed = [i for i, (y, forces) in enumerate(pairs) if y is not None or forces is not None]

        def sweep(k: int) -> tuple[Tensor, ...]:
            return run_adjoint(ctx.runs[needed[k]], *pairs[needed[k]])

        for k, result in parallel_map(sweep, len(needed), ctx.threads, turns=True):
            bars[4 * needed[k] : 4 * needed[k] + 4] = result
        return None, None, *bars


def columned(bars: Array) -> Array:
    """Cotangents (., signals, 2) of signals, as (., 2 signals, 1)."""
    return bars.reshape(len(bars), bars.shape[-2] * bars.shape[-1], 1)


def run_adjoint(
    run: Solved, y_bar: Tensor | None, recorded_bar: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cotangents of y0 (size,), of the parameters' vector and of the signals at stages and outputs
    (., signals, 2), from those of the rows. Raises `GradientFailed` where one is not finite."""
    stepper, t = run.task.stepper, run.task.t
    size = stepper.layout.size
    rows: Array = np.zeros((len(t), size)) if y_bar is None else y_bar.numpy().copy()
    forces: Array = np.zeros((len(t), 0))
    if recorded_bar is not None:
        forces = np.ascontiguousarray(recorded_bar.numpy())
    for bar in rows, forces:
        if not np.isfinite(bar).all():
            raise GradientFailed(
                f"the cotangent of output {np.argwhere(~np.isfinite(bar))[0][0]} is not finite"
            )
    sizes = sizes_of(stepper.layout, run.out.y)
    input_size = float((np.abs(rows) @ sizes).sum())
    input_size += float(np.abs(forces).sum()) * float(np.abs(run.out.recorded).max(initial=SMALL))
    carried, p_bar = np.zeros(size), np.zeros(len(stepper.parameters.p))
    segments, outputs_bar = run.segments or [], np.zeros((len(t), *run.out.signals.shape[1:]))
    signals_bar = [np.zeros_like(segment.stages) for segment in segments]
    room = stepper.parameters.model.take(stepper.parameters.numbers)
    for segment, signal_bar in zip(reversed(segments), reversed(signals_bar)):
        plan, (tape, out_tape) = segment.plan, stepper.tapes(segment, room)
        failed, here = np.zeros(1, np.int64), segment.rows
        sweep = Backward(
            room.system, room.work, room.of("Directions", columns=1), tape,
            plan.h, segment.stages, plan.out_step, plan.out_part, out_tape, segment.at_outputs,
            rows[here], forces[here], columned(outputs_bar[here]), carried[:, None], p_bar[:, None],
            columned(signal_bar), failed,
        )  # fmt: skip
        with released_turn():
            call("backward", sweep)
        if failed[0] >= 0:
            time = stepper.origin + plan.starts[failed[0]]
            raise GradientFailed(f"the gradient is not finite at t = {time:.4f} s")
    stepper.parameters.model.give(room)
    if input_size > 0:
        by_parameters = np.abs(p_bar * stepper.parameters.p.detach().numpy()).max(initial=0.0)
        warn_of_amplified(max(np.abs(carried * sizes).max(), by_parameters) / input_size)
    parts = carried, p_bar, np.concatenate(signals_bar), outputs_bar
    return tuple(torch.from_numpy(part) for part in parts)  # pyright: ignore[reportReturnType]


class _Recorded(torch.autograd.Function):
    """Series without a gradient beside states that have one: its backward raises
    `GradientFailed`."""

    @staticmethod
    def forward(ctx: Any, name: str, series: Tensor, y: Tensor) -> Tensor:
        ctx.name = name
        return series.clone()

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        if bool((bar != 0).any()):
            raise GradientFailed(
                f"the integral `{ctx.name}` is a sum over the steps and has no gradient; detach() "
                "it, or take powers of channels, which have one"
            )
        return None, None, None


def without_gradient(name: str, series: Tensor, y: Tensor) -> Tensor:
    """A series (T,) that came out of the run of states y (T, size), whose gradient would be wrong
    rather than zero."""
    return _Recorded.apply(name, series, y) if y.requires_grad else series  # pyright: ignore[reportReturnType]


# Forward sensitivities: the derivative of a whole run along a handful of parameters, in one pass
# of the compiled kernels.


def directions(value: Tensor, wrt: Sequence[Tensor]) -> Array:
    """d value / d (scalar tensors) (..., n) from the graph of `value` (...): its pullback is linear
    in the weights, so differentiated by them it pushes forward."""
    out = np.zeros((*value.shape, len(wrt)))
    weights = torch.zeros_like(value, requires_grad=True)
    pulled = (
        torch.autograd.grad(value, wrt, weights, create_graph=True, allow_unused=True)
        if wrt and value.requires_grad
        else ()
    )
    if columns := [k for k, part in enumerate(pulled) if part is not None and part.requires_grad]:
        some = [pulled[k] for k in columns]

        def pushed(one: Tensor) -> Tensor:
            (row,) = torch.autograd.grad(some, weights, [*one], retain_graph=True)
            return row

        rows = torch.func.vmap(pushed)(torch.eye(len(columns), dtype=torch.float64))
        out[..., columns] = rows.movedim(0, -1).numpy()
    return out


def signal_directions(
    stepper: ImplicitStepper, times: Array, wrt: Sequence[Tensor], columns: int
) -> Array:
    """Derivatives (stages, 2 signals, columns) of the values and rates of the signals at stages, by
    the scalar tensors `wrt`; none, (0, 0, columns), where no signal depends on them. Raises
    `ValueError` where bodies are driven by signals that do."""
    start = stepper.signals_at_start
    if not start.requires_grad or not any(
        one is not None
        for one in torch.autograd.grad(start.sum(), wrt, retain_graph=True, allow_unused=True)
    ):
        return np.zeros((0, 0, columns))
    signals = stepper.signals_at(times)
    out = np.zeros((*signals.shape[:2], 2, columns))
    out[..., : len(wrt)] = directions(signals, wrt)
    driving = stepper.parameters.system.body_signal
    if out[:, driving[driving >= 0]].any():
        raise ValueError(
            "gradient='forward' has no derivatives by parameters that move fixed or driven bodies; "
            "take gradient='discrete'"
        )
    return out.reshape(len(times), -1, columns)


def iterate(task: Task, wrt: Sequence[Tensor], columns: list[int], sums: Sums) -> Iterator[Solved]:
    """The run with derivatives (T, components, n) of the states by the scalar tensors `wrt`, and
    those of sums of forces (T, sums, n), as it grows; `columns` are the components of the state
    that are kept. The task's dy0 (size, n) is the derivative of the initial state, zero by default;
    its columns beyond those of `wrt` are directions of the start, and of the reference as far as it
    is made of the task's leaves, one for each column."""
    stepper, t, dy0 = task.stepper, task.t, task.dy0
    size, count = stepper.layout.size, len(sums.start) - 1
    dy = np.zeros((size, len(wrt))) if dy0 is None else dy0.detach().numpy().copy()
    n = dy.shape[1]
    dp = np.zeros((len(stepper.parameters.p), n))
    dp[:, : len(wrt)] = directions(stepper.parameters.p, wrt)
    kept, forces = np.zeros((len(t), len(columns), n)), np.zeros((len(t), count, n))
    segments: list[Segment] = []
    room = stepper.parameters.model.take(stepper.parameters.numbers)
    work, along = (room.of(kind, columns=n) for kind in ("Work", "Directions"))
    growing = stepper.integrate(task.y0.detach(), t, segments, float("inf"), outputs_too=count > 0)
    for out in growing:
        while segments:  # none if the first step of a chunk was not solved, and is to be halved
            segment = segments.pop(0)
            plan, (tape, out_tape) = segment.plan, stepper.tapes(segment, room)
            rows = np.empty((len(plan.out_step), size, n))
            dsignals = signal_directions(stepper, plan.stage_times.ravel(), task.leaves, n)
            sweep = Forward(
                room.system, work, along, tape, plan.h, segment.stages, plan.out_step,
                plan.out_part, out_tape, segment.at_outputs, *sums, dy, dp, dsignals, rows,
                forces[segment.rows],
            )  # fmt: skip
            with released_turn():
                call("forward", sweep)
            kept[segment.rows] = rows[:, columns]
        yield Solved(task, out, None, (torch.from_numpy(kept), torch.from_numpy(forces)))
    stepper.parameters.model.give(room)
    rigid = [k for k, column in enumerate(columns) if column in set(stepper.layout.rigid)]
    values = np.array([float(p.detach()) for p in wrt])
    moved = np.abs(kept[:, rigid, : len(wrt)] * values).max((0, 2), initial=0.0)
    sizes = sizes_of(stepper.layout, out.y)[[columns[k] for k in rigid]]
    warn_of_amplified(float((moved / sizes).max(initial=0.0)))
