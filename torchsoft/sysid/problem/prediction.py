"""One run of a recording's rig for given parameters: signals with derivatives, or the misfit with its gradient."""

from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.rig import Rig
from torchsoft.physics.state import Layout
from torchsoft.solve.simulate import simulate
from torchsoft.solve.tangent import directions
from torchsoft.solve.trajectory import Trajectory, channels, measurable
from torchsoft.sysid.problem.readout import Signals
from torchsoft.sysid.problem.recording import Array, Grid, RunContext
from torchsoft.sysid.problem.start import PREFIX

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
    """Signals (G, channels) of `Recording.channels` on a grid t (G,) [s], the number of steps, the signals' derivatives
    (G, channels, n), if there are any, and the steps' ends `knots` [s] where a tolerance chose them."""

    t: Array
    signals: Array
    steps: int
    derivatives: Array | None = None
    knots: Array | None = None


class Misfit(NamedTuple):
    """Half the sum of squared residuals of one recording, its derivatives by the run's parameters (n,), and by every channel's
    nuisances (channels, nuisances), and the stepper's steps."""

    loss: float
    parameters: Array
    nuisances: Array
    steps: int


class FailedRun(NamedTuple):
    """A run that could not be finished: why, and when [s]."""

    reason: str
    time: float


Judge = Callable[[Signals], tuple[float, Array, Array]]
"""Half the sum of squared residuals of a run's signals, its derivatives by them (G, channels), and by the nuisances."""


@torch.no_grad()
def set_parameters(rig: Rig, values: Mapping[str, float]) -> None:
    """Give the rig other parameters, by the names that `Rig.parameter` knows."""
    for name, value in values.items():
        rig.parameter(name).fill_(value)


class Run(NamedTuple):
    """What a run begins with: the state y0 (size,), and the tensors by which it is differentiated, those of parameters
    before those of the start."""

    y0: Tensor
    parameters: tuple[str, ...]
    wanted: list[Tensor]


def prepared(begun: RunContext, values: Mapping[str, float], names: Sequence[str]) -> Run:
    """Gives the rig its parameters, and makes the state where it begins, with its derivatives by `names`."""
    set_parameters(begun.rig, {name: value for name, value in values.items() if not name.startswith(PREFIX)})
    at = {
        name: torch.tensor(value, dtype=torch.float64, requires_grad=name in names)
        for name, value in values.items()
        if name.startswith(PREFIX)
    }
    parameters = tuple(name for name in names if name not in at)
    assert tuple(names[: len(parameters)]) == parameters
    wanted = [*map(begun.rig.parameter, parameters), *(at[name] for name in names if name in at)]
    return Run(begun.y0(at), parameters, wanted)


def derivatives(rig: Rig, run: Trajectory, names: Sequence[str]) -> Array:
    """Derivatives (T, channels, n) of the channels `names` by the run's parameters and start: along the motion of the bodies,
    and of the controllers' own parameters."""
    assert run.sensitivities is not None
    bodies, signals = Layout({}, {}, rig.layout.free, {}), rig.follow(run.t, rig.reference).detach()
    along = [torch.zeros((), dtype=torch.float64, requires_grad=True) for _ in range(run.sensitivities.shape[-1])]
    q = run.y[:, rig.layout.rigid].detach() + run.sensitivities @ torch.stack(along)
    known = channels(rig, bodies.unpack(q, *rig.held(signals)), signals)
    measured = torch.stack([known[name] for name in names], -1)
    out = directions(measured, along)
    out[..., : len(run.wrt)] += directions(measured, [rig.parameter(name) for name in run.wrt])
    return out


def choice(steps: Steps) -> dict[str, Any]:
    """The arguments of `simulate` that say which steps to take, and how exactly."""
    chosen = {"knots": torch.from_numpy(steps.knots)} if isinstance(steps, Frozen) else {"rtol": steps}
    return chosen | {"tolerance": TOLERANCE}


def predict(
    begun: RunContext, values: Mapping[str, float], grid: Grid, names: Sequence[str], steps: Steps
) -> Prediction:
    """Signals on the grid, and their derivatives by `names`, if there are any. Raises
    `SimulationFailed`."""
    rig, run = begun.rig, prepared(begun, values, names)
    dy0 = torch.from_numpy(directions(run.y0, run.wanted)) if names else None
    out = simulate(
        rig, grid.t, y0=run.y0, gradient="forward" if names else "none", wrt=run.parameters, dy0=dy0, rigid=bool(names),
        **choice(steps),
    )  # fmt: skip
    keys, rows = measurable(rig), slice(grid.early, None)
    slopes = derivatives(rig, out, keys)[rows] if names else None
    knots = None if isinstance(steps, Frozen) else out.knots.numpy()
    return Prediction(grid.t[rows].numpy(), out.together(*keys)[rows].detach().numpy(), out.stats.steps, slopes, knots)


def misfit(
    begun: RunContext, values: Mapping[str, float], grid: Grid, names: Sequence[str], steps: Steps, judge: Judge
) -> Misfit:
    """The misfit that `judge` finds, with its gradient by `names`, by the discrete adjoint. Raises `SimulationFailed`."""
    rig, run = begun.rig, prepared(begun, values, names)
    out = simulate(rig, grid.t, y0=run.y0, gradient="discrete", **choice(steps))
    keys, rows = measurable(rig), slice(grid.early, None)
    signals = out.together(*keys)[rows]
    loss, weights, nuisances = judge(Signals(grid.t[rows].numpy(), keys, signals.detach().numpy(), None))
    gradient = torch.autograd.grad(signals, run.wanted, torch.from_numpy(weights), allow_unused=True)
    by = np.array([0.0 if g is None else float(g) for g in gradient])
    return Misfit(loss, by, nuisances, out.stats.steps)
