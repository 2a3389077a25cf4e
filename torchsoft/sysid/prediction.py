"""Predicted samples of one recording's sensors for given parameters, with derivatives: one run of the model."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from torchsoft.channels import MEASURED
from torchsoft.model import PARAMETERS, SoftGrasp
from torchsoft.sensitivity import parameter_derivatives, sensitivities
from torchsoft.simulate import simulate
from torchsoft.sysid.recording import Array, Recording

TOLERANCE = 1e-8
"""Newton tolerance [N] of the runs that fits are made of: far below any sensor, above rounding with the largest dashpots."""


class Prediction(NamedTuple):
    """Signals (G, channels) on a grid t (G,) [s], their derivatives (G, channels, n), or None, and the stepper's steps."""

    t: Array
    signals: Array
    derivatives: Array | None
    steps: int


def rigid_states(model: SoftGrasp, y: Tensor) -> Tensor:
    """Poses (x_C, y_C, theta, x_Br, y_Br) and their rates (..., 10) of states y (..., size)."""
    s = model.layout.unpack(y)
    return torch.cat((s.r_C, s.theta[..., None], s.r_Br, s.v_C, s.omega[..., None], s.v_Br), -1)


def signals(model: SoftGrasp, t: Tensor, q: Tensor) -> Tensor:
    """Every channel of `MEASURED` (G, channels) from poses and rates q (G, 10) at the times t (G,)."""
    F = model.controllers(model.reference(t), q[:, 0:2], q[:, 5:7], q[:, 3:5], q[:, 8:10])
    return torch.cat((q, torch.stack(F, -1)), -1)


@torch.no_grad()
def set_parameters(model: SoftGrasp, values: dict[str, float]) -> None:
    """Give the model other parameters, named as in `Parameters`."""
    known = dict(model.named_parameters())
    for name, value in values.items():
        known[PARAMETERS[name]].fill_(value)


@torch.no_grad()
def predict(model: SoftGrasp, y0: Tensor, t: Tensor, names: Sequence[str], step: float) -> Prediction:
    """Signals from the state y0 on the grid t (G,), and their derivatives by the parameters `names`, if there are any.

    The first time, from which the disc only settles, is left out. Raises `SimulationFailed`.
    """
    at = t[1:]
    if not names:
        run = simulate(model, t, y0=y0, step=step, tolerance=TOLERANCE)
        return Prediction(at.numpy(), signals(model, at, rigid_states(model, run.y[1:])).numpy(), None, run.stats.steps)
    inner = [PARAMETERS[name] for name in names]
    run = sensitivities(model, y0, t, inner, step=step, tolerance=TOLERANCE, rigid=True)
    q, dq = rigid_states(model, run.y[1:]), run.dy[1:]
    by_state = [
        torch.func.jvp(lambda q: signals(model, at, q), (q,), (dq[..., k].contiguous(),))[1] for k in range(len(inner))
    ]
    direct = parameter_derivatives(model, inner, ("controllers.",), lambda: signals(model, at, q))
    dy = torch.stack(by_state, -1).numpy() + direct  # pyright: ignore[reportArgumentType, reportCallIssue]
    return Prediction(at.numpy(), signals(model, at, q).numpy(), dy, run.run.steps)


class Reading(NamedTuple):
    """Predicted samples (k,) of one channel at its own times, their derivatives (k, n), and their rates (k,) [unit/s]."""

    values: Array
    derivatives: Array | None
    rates: Array


def read(prediction: Prediction, channel: str, times: Array, delay: float) -> Reading:
    """Samples of a sensor with a `delay` [s] at `times` (k,): the cubic spline through the prediction, `delay` earlier."""
    at, j = times - delay, MEASURED.index(channel)
    spline = CubicSpline(prediction.t, prediction.signals[:, j])
    slopes = None
    if prediction.derivatives is not None:
        slopes = CubicSpline(prediction.t, prediction.derivatives[:, j])(at)
    return Reading(spline(at), slopes, spline(at, 1))


def interpolation(t: Array, at: Array) -> Array:
    """The matrix (k, G) of the same spline."""
    return CubicSpline(t, np.eye(len(t)))(at)


def misfit(
    model: SoftGrasp, y0: Tensor, recording: Recording, t: Tensor, names: Sequence[str], step: float,
    noise: dict[str, float], bias: dict[str, float], delay: dict[str, float],
) -> tuple[float, dict[str, Array], int]:  # fmt: skip
    """Half the sum of squared residuals of one recording, with its gradient by the discrete adjoint: by parameters
    (`names`), and by `bias` and `delay` (one entry a channel in `noise`); and the stepper's steps. Raises `SimulationFailed`.
    """
    parameters = dict(model.named_parameters())
    unknown = [parameters[PARAMETERS[name]].requires_grad_(True) for name in names]
    at, loss = t[1:], torch.zeros((), dtype=torch.float64)
    run = simulate(model, t, y0=y0, step=step, tolerance=TOLERANCE, gradient="discrete")
    predicted = signals(model, at, rigid_states(model, run.y[1:]))
    out = {"bias": np.zeros(len(noise)), "delay": np.zeros(len(noise))}
    for k, (channel, sigma) in enumerate(noise.items()):
        if channel not in recording.samples:
            continue
        times, measured = recording.samples[channel]
        spline = torch.from_numpy(interpolation(at.numpy(), times - delay[channel]))
        r = (spline @ predicted[:, MEASURED.index(channel)] + bias[channel] - torch.from_numpy(measured)) / sigma
        loss = loss + 0.5 * r.square().sum()
        rates = read(Prediction(at.numpy(), predicted.detach().numpy(), None, 0), channel, times, delay[channel]).rates
        out["bias"][k], out["delay"][k] = float(r.detach().sum()) / sigma, -float(r.detach().numpy() @ rates) / sigma
    gradient = torch.autograd.grad(loss, unknown, allow_unused=True)
    out["parameters"] = np.array([0.0 if g is None else float(g) for g in gradient])
    return float(loss.detach()), out, run.stats.steps
