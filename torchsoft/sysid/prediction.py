"""Predicted samples of one recording's sensors for given parameters, with derivatives: one run of the model."""

from collections.abc import Mapping, Sequence
from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from torchsoft.channels import MEASURED
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import Layout
from torchsoft.solve.simulate import simulate
from torchsoft.solve.tangent import directions
from torchsoft.solve.trajectory import Trajectory, channels
from torchsoft.sysid.recording import Array, Recording

TOLERANCE = 1e-8
"""Newton tolerance [N] of the runs that fits are made of: far below any sensor, above rounding with the largest dashpots."""


class Frozen:
    """The steps of a run, to be taken again: their ends `knots` (steps + 1,) [s]. Its `repr` names them to the bit."""

    def __init__(self, knots: Array) -> None:
        self.knots, self._name = knots, sha256(knots.tobytes()).hexdigest()

    def __repr__(self) -> str:
        return f"Frozen({self._name})"


Steps = float | Frozen
"""The steps of a run: a relative tolerance that chooses them, or those of another run."""


class Prediction(NamedTuple):
    """Signals (G, channels) on a grid t (G,) [s], the number of steps, their derivatives (G, channels, n), if there are any,
    and the steps' ends `knots` [s] where a tolerance chose them."""

    t: Array
    signals: Array
    steps: int
    derivatives: Array | None = None
    knots: Array | None = None


class Misfit(NamedTuple):
    """Half the sum of squared residuals of one recording, its derivatives by parameters (n,), and by bias and delay of every
    channel that has noise, and the stepper's steps."""

    loss: float
    parameters: Array
    bias: Array
    delay: Array
    steps: int


class FailedRun(NamedTuple):
    """A run that could not be finished: why, and when [s]."""

    reason: str
    time: float


@torch.no_grad()
def set_parameters(rig: Rig, values: Mapping[str, float]) -> None:
    """Give the rig other parameters, by the names that `Rig.parameter` knows."""
    for name, value in values.items():
        rig.parameter(name).fill_(value)


def derivatives(rig: Rig, run: Trajectory) -> Array:
    """Derivatives (T, channels, n) of every channel of `MEASURED` by the run's n parameters: along the motion of the bodies,
    and of the controllers' own parameters."""
    assert run.sensitivities is not None
    bodies, signals = Layout({}, {}, rig.layout.free, {}), rig.follow(run.t, rig.reference).detach()
    along = [torch.zeros((), dtype=torch.float64, requires_grad=True) for _ in run.wrt]
    q = run.y[:, rig.layout.rigid].detach() + run.sensitivities @ torch.stack(along)
    known = channels(rig, bodies.unpack(q, *rig.held(signals)), signals)
    measured = torch.stack([known[name] for name in MEASURED], -1)
    return directions(measured, along) + directions(measured, [rig.parameter(name) for name in run.wrt])


def choice(steps: Steps) -> dict[str, Any]:
    """The arguments of `simulate` that say which steps to take, and how exactly."""
    chosen = {"knots": torch.from_numpy(steps.knots)} if isinstance(steps, Frozen) else {"rtol": steps}
    return chosen | {"tolerance": TOLERANCE}


def predict(rig: Rig, y0: Tensor, t: Tensor, names: Sequence[str], steps: Steps) -> Prediction:
    """Signals from the state y0 on the grid t (G,), and their derivatives by the parameters `names`, if there are any.

    The first time, from which the disc only settles, is left out. Raises `SimulationFailed`.
    """
    dy0 = torch.from_numpy(directions(y0, [rig.parameter(name) for name in names])) if names else None
    run = simulate(
        rig, t, y0=y0, gradient="forward" if names else "none", wrt=names, dy0=dy0, rigid=bool(names), **choice(steps)
    )
    slopes = derivatives(rig, run)[1:] if names else None
    knots = None if isinstance(steps, Frozen) else run.knots.numpy()
    return Prediction(t[1:].numpy(), run.together(*MEASURED)[1:].detach().numpy(), run.stats.steps, slopes, knots)


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
    rig: Rig, y0: Tensor, recording: Recording, t: Tensor, names: Sequence[str], steps: Steps,
    noise: dict[str, float], bias: dict[str, float], delay: dict[str, float],
) -> Misfit:  # fmt: skip
    """The misfit with its gradient by the parameters `names`, by the discrete adjoint, and by `bias` and `delay` (one entry a
    channel in `noise`). Raises `SimulationFailed`."""
    at, loss = t[1:], torch.zeros((), dtype=torch.float64)
    run = simulate(rig, t, y0=y0, gradient="discrete", **choice(steps))
    by_bias, by_delay = np.zeros(len(noise)), np.zeros(len(noise))
    for k, (channel, sigma) in enumerate(noise.items()):
        if channel not in recording.samples:
            continue
        times, measured = recording.samples[channel]
        spline = torch.from_numpy(interpolation(at.numpy(), times - delay[channel]))
        r = (spline @ run[channel][1:] + bias[channel] - torch.from_numpy(measured)) / sigma
        loss = loss + 0.5 * r.square().sum()
        rates = CubicSpline(at.numpy(), run[channel][1:].detach().numpy())(times - delay[channel], 1)
        by_bias[k], by_delay[k] = float(r.detach().sum()) / sigma, -float(r.detach().numpy() @ rates) / sigma
    gradient = torch.autograd.grad(loss, [rig.parameter(name) for name in names], allow_unused=True)
    by_parameters = np.array([0.0 if g is None else float(g) for g in gradient])
    return Misfit(float(loss.detach()), by_parameters, by_bias, by_delay, run.stats.steps)
