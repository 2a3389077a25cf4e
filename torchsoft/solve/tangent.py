"""Forward sensitivities: the derivative of a whole run along a handful of parameters, in one pass
of the compiled kernels."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from torchsoft.solve.kernel.arrays import Forward, room
from torchsoft.solve.kernel.objects import call
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.progress import Progress, Segment
from torchsoft.solve.stepper import ImplicitStepper
from torchsoft.solve.touch import Sums
from torchsoft.threads import others_turn


def directions(value: Tensor, wanted: Sequence[Tensor]) -> Array:
    """d value / d (scalar tensors) (..., n) from the graph of `value` (...): its pullback is linear
    in the weights, so differentiated by them it pushes forward."""
    out = np.zeros((*value.shape, len(wanted)))
    weights = torch.zeros_like(value, requires_grad=True)
    pulled = (
        torch.autograd.grad(value, wanted, weights, create_graph=True, allow_unused=True)
        if wanted and value.requires_grad
        else ()
    )
    for k, part in enumerate(pulled):
        if part is not None and part.requires_grad:
            (row,) = torch.autograd.grad(part, weights, retain_graph=True)
            out[..., k] = row.numpy()
    return out


def iterate(
    stepper: ImplicitStepper, y0: Tensor, t: Tensor, wanted: Sequence[Tensor], dy0: Tensor | None,
    columns: list[int], sums: Sums,
) -> Iterator[tuple[Tensor, Tensor, Progress]]:  # fmt: skip
    """Derivatives (T, components, n) of the states by the scalar tensors `wanted`, and those of
    sums of forces (T, sums, n), as the run grows; `columns` are the components of the state that
    are kept. dy0 (size, n) is the derivative of the initial state, zero by default; its columns
    beyond those of `wanted` are directions of the start alone."""
    size, count = stepper.layout.size, len(sums.start) - 1
    dy = np.zeros((size, len(wanted))) if dy0 is None else dy0.detach().numpy().copy()
    n = dy.shape[1]
    dp = np.zeros((len(stepper.compiled.p), n))
    dp[:, : len(wanted)] = directions(stepper.compiled.p, wanted)
    kept, felt = np.zeros((len(t), len(columns), n)), np.zeros((len(t), count, n))
    segments: list[Segment] = []
    for out in stepper.integrate(y0.detach(), t, segments, float("inf"), outputs_too=count > 0):
        while segments:  # none if the first step of a chunk was not solved, and is to be halved
            segment = segments.pop(0)
            plan, (tape, out_tape), s = (
                segment.plan,
                stepper.tapes(segment),
                stepper.system(segment),
            )
            rows = np.empty((len(plan.out_step), size, n))
            work, tangents = (room(kind, s, size, columns=n) for kind in ("Work", "Tangents"))
            sweep = Forward(
                s, stepper.still, work, tangents, tape, plan.h, segment.signals, plan.out_step,
                plan.out_part, out_tape, segment.at_outputs, *sums, dy, dp, rows,
                felt[segment.rows],
            )  # fmt: skip
            with others_turn():
                call("forward", sweep)
            kept[segment.rows] = rows[:, columns]
        yield torch.from_numpy(kept), torch.from_numpy(felt), out
