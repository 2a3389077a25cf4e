"""Exact gradients of a whole run: the discrete adjoint of the implicit stepper.

The backward sweep is compiled (`kernels.adjoint`); it leaves one multiplier per law evaluation. What multiplies them, the
derivative of the laws with respect to the parameters, is one batched vector-Jacobian product through the module's own
functions, so that no law is differentiated by hand with respect to a parameter.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.implicit import ImplicitStepper, Progress, Segment
from torchsoft.kernels.adjoint import Bars, Multipliers, PadGradients, backward
from torchsoft.stage_laws import decay_rate, law_rows, rigid_loads, touching

TAPE_BYTES = 1e9
"""Tapes kept of one run [bytes]; beyond that the backward sweep makes each segment's again from where it began."""


class GradientFailed(RuntimeError):
    """A gradient that is not finite: when [s] and where it ceased to be."""


def differentiable_solution(stepper: ImplicitStepper, y0: Tensor, t: Tensor) -> tuple[Tensor, Progress]:
    """States (T, size) at the times t (T,) with the discrete adjoint behind them, and the run's other results.

    The gradient reaches y0 (size,) and every parameter of the model, those of its reference included, but not t.
    Raises `NotImplementedError` when a gradient is wanted and the pads are inertial.
    """
    *_, last = iterate(stepper, y0, t)
    return last


def iterate(stepper: ImplicitStepper, y0: Tensor, t: Tensor) -> Iterator[tuple[Tensor, Progress]]:
    """`differentiable_solution` as it grows; only the last yield is differentiable."""
    model = stepper.model
    parameters = [p for p in model.parameters() if p.requires_grad]
    wanted = torch.is_grad_enabled() and (y0.requires_grad or bool(parameters))
    if wanted and not model.massless:
        raise NotImplementedError(
            "the discrete adjoint is for massless pads; set pad.fidelity = 'massless', or use torch.no_grad()"
        )
    segments: list[Segment] | None = [] if wanted else None
    out = None
    for out in stepper.integrate(y0.detach(), t, segments, TAPE_BYTES):
        yield torch.from_numpy(out.y), out
    assert out is not None
    solution = torch.from_numpy(out.y)
    if segments is not None:
        solution = _Solution.apply(stepper, segments, solution, y0, *parameters)
    yield solution, out  # pyright: ignore[reportReturnType]


class _Solution(torch.autograd.Function):
    """Passes the solution through; its backward is the discrete adjoint."""

    @staticmethod
    def forward(
        ctx: Any, stepper: ImplicitStepper, segments: list[Segment], y: Tensor, y0: Tensor, *parameters: Tensor
    ) -> Tensor:
        ctx.stepper, ctx.segments = stepper, segments
        ctx.save_for_backward(*parameters)  # so that torch notices a parameter changed in place
        return y.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, y_bar: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        y0_bar, gradients = run_adjoint(ctx.stepper, ctx.segments, y_bar, ctx.saved_tensors)
        return None, None, None, y0_bar, *gradients


def run_adjoint(
    stepper: ImplicitStepper, segments: list[Segment], y_bar: Tensor, parameters: tuple[Tensor, ...]
) -> tuple[Tensor, list[Tensor]]:
    """Cotangents of y0 (size,) and of the parameters, from those of the outputs, y_bar (T, size)."""
    model, rows = stepper.model, np.ascontiguousarray(y_bar.numpy())
    n_u, n_s = 2 * (model.pad_L.nodes + model.pad_U.nodes), len(model.pad_L.surface) + len(model.pad_U.surface)
    bars = Bars(np.zeros(n_u), np.zeros(n_s), np.zeros(5), np.zeros(5))
    totals = [torch.zeros_like(p) for p in parameters]
    C_L, C_U = (np.zeros((2 * len(pad.surface), 2 * pad.nodes)) for pad in model.pads.values())
    pads = PadGradients(C_L, C_U, np.zeros(1), np.zeros(1))
    for segment in reversed(segments):
        tape, h, keep = stepper.tape(segment), segment.chunk.h, segment.chunk.keep
        out = Multipliers(np.zeros(tape.force.shape), np.zeros(tape.force.shape[:3]), np.zeros(tape.V.shape))
        pads.decay[0] = 0.0
        failed = backward(
            stepper.pad_arrays(h), h, stepper.constants, tape, keep, rows[segment.rows], bars, decay_rate(model, h).item(),
            out, pads,
        )  # fmt: skip
        if failed >= 0:
            node = np.argwhere(~np.isfinite(out.mu[2 * failed : 2 * failed + 2]).all(-1))
            where = f"node {tape.node[2 * failed + node[0][0], node[0][1], node[0][2]]}" if len(node) else "the disc"
            raise GradientFailed(f"the gradient is not finite at t = {segment.chunk.starts[failed]:.4f} s, at {where}")
        with torch.enable_grad():
            value = (torch.from_numpy(out.nu) * rigid_loads(model, segment.chunk, tape)).sum()
            for p in range(2):
                at = touching(tape, p)
                mu, s_bar = (torch.from_numpy(x[at[0], p, at[1]]) for x in (out.mu, out.s_bar))
                value = value + (law_rows(model, tape, p, h) * torch.cat((mu, s_bar[:, None]), -1)).sum()
            value = value + pads.decay[0] * decay_rate(model, h)
            parts = torch.autograd.grad(value, parameters, allow_unused=True)
        for total, part in zip(totals, parts):
            if part is not None:
                total += part
    with torch.enable_grad():
        value = pads.tau[0] * model.material.tau
        for pad, C_bar in zip(model.pads.values(), (pads.C_L, pads.C_U)):
            value = value + (torch.from_numpy(C_bar).mT * pad.compliance(model.material)).sum()
        parts = torch.autograd.grad(value, parameters, allow_unused=True)
    for total, part in zip(totals, parts):
        if part is not None:
            total += part
    y0_bar = torch.from_numpy(np.concatenate((bars.u, bars.s, bars.q, bars.V))) + y_bar[0]
    return y0_bar, totals
