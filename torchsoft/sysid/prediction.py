"""Predicted signals of a recording, and the readings of its sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.special import log_ndtr
from torch import Tensor

from torchsoft.physics.channels import Seen, measurable, read
from torchsoft.physics.motion import Reference
from torchsoft.physics.names import effort_channel, rate_channel
from torchsoft.physics.rig import Rig
from torchsoft.solve.diagnostics import doubts
from torchsoft.solve.gradients import directions
from torchsoft.solve.simulate import unjudged
from torchsoft.solve.trajectory import Trajectory
from torchsoft.sysid.initial_state import PREFIX, reference_from
from torchsoft.sysid.recording import REACH, Array, Grid, Recording, RunContext
from torchsoft.sysid.unknowns import NUISANCES, Nuisance, Sensor


class Prediction(NamedTuple):
    """Signals (G, channels) of `Recording.channels` on a grid t (G,) [s], their derivatives (G,
    channels, n), if any, and the ends `knots` [s] of steps chosen by a tolerance; `step` is the
    expected time of a step [s] in a run of a changed recording, 0 for one as stated."""

    t: Array
    signals: Array
    derivatives: Array | None = None
    knots: Array | None = None
    step: float = 0.0


class FailedRun(NamedTuple):
    """A failed run: reason and time [s]."""

    reason: str
    time: float


class Term(NamedTuple):
    """A term of a reading: `factor` times the derivative of some `order` of a channel, which is a
    `column` of the signals, and the derivative of the factor by a nuisance."""

    column: int
    order: int
    factor: float
    by: tuple[Nuisance, float] | None = None


@dataclass(frozen=True)
class Readout:
    """One channel as read by its sensor, for given values of the sensor's nuisances. Its `repr` is
    complete."""

    channel: str
    noise: float
    low: float | None
    high: float | None
    gain: float
    bias: float
    drift: float
    delay: float
    middle: float
    terms: tuple[Term, ...]
    clock: float = 0.0
    lag: float = 0.0
    backlash: float = 0.0

    def quantity(self, t: Array, signals: Array) -> Array:
        """The measured quantity (G, ...) at times t (G,) [s], from signals (G, channels, ...)."""
        parts = [
            one.factor * slope(t, signals[:, one.column], one.order)
            for one in self.terms
            if one.factor != 0.0
        ]
        return np.sum(parts, 0)

    def expected(
        self, run: Prediction, times: Array
    ) -> tuple[Array, Array | None, dict[Nuisance, Array]]:
        """Noiseless reading (k,) of a run at `times`, its derivatives (k, n) by the parameters of
        the run's sensitivities, and those by the nuisances; by no backlash it is the secant to one
        as large as the noise."""
        y, later = self.quantity(run.t, run.signals), times - self.middle
        source, side = taken_up(y, self.backlash)
        held, slopes = y[source] - 0.5 * self.backlash * side, None

        def curves(columns: Array, lag: float) -> CubicSpline:
            return CubicSpline(run.t, lagged(run.t, columns, lag))

        def behind(columns: Array, lag: float = self.lag) -> Array:
            return curves(columns, lag)(self.own_times(times))

        rate = curves(held, self.lag)(self.own_times(times), 1)
        by_lag = -rate
        if self.lag > 0:
            less, more = (behind(held, (1 + part) * self.lag) for part in (-LAG_STEP, LAG_STEP))
            by_lag = (more - less) / (2 * LAG_STEP * self.lag)
        by: dict[Nuisance, Array] = {
            kind: self.gain * behind(column)
            for kind, column in self._by_signals(run, y, source, side).items()
        }
        seen = behind(held)
        by |= {
            "gain": seen,
            "bias": np.ones(len(times)),
            "drift": later,
            "delay": -self.gain * rate,
            "clock": -self.gain * rate * later,
            "lag": self.gain * by_lag,
        }
        if run.derivatives is not None:
            slopes = self.gain * behind(self.quantity(run.t, run.derivatives)[source])
        return self.gain * seen + self.bias + self.drift * later, slopes, by

    def _by_signals(
        self, run: Prediction, y: Array, source: NDArray[np.intp], side: Array
    ) -> dict[Nuisance, Array]:
        """Derivatives (G,) of the quantity y (G,) with backlash by the nuisances that act on the
        grid."""
        if self.backlash == 0.0:
            other, side = taken_up(y, self.noise)
            side = side - 2 * (y[other] - y) / self.noise
        by: dict[Nuisance, Array] = {"backlash": -0.5 * side}
        for one in self.terms:
            if one.by is not None:
                kind, factor = one.by
                rise = slope(run.t, run.signals[:, one.column], one.order)
                by[kind] = by.get(kind, 0.0) + factor * rise[source]
        return by

    def residuals(self, y: Array, measured: Array) -> tuple[Array, Array]:
        """Expected less measured values over the noise (k,), and the derivative by the expected
        values.

        For a saturated sample, half the squared residual is the negative log probability that value
        plus noise exceeds the limit (Tobin, 1958).
        """
        r, weight = (y - measured) / self.noise, np.full(len(y), 1 / self.noise)
        for limit, sign in ((self.high, 1.0), (self.low, -1.0)):
            if limit is not None:
                at = sign * measured >= sign * limit
                beyond, slope = censored(sign * (y[at] - limit) / self.noise)
                r[at], weight[at] = sign * beyond, slope / self.noise
        return r, weight

    def pulled_back(self, run: Prediction, times: Array, v: Array) -> Array:
        """Weights (G, channels) on the channels, from weights v (k,) on the expected reading."""
        t, held = run.t, np.zeros(len(run.t))
        source, _ = taken_up(self.quantity(t, run.signals), self.backlash)
        curves = CubicSpline(t, lagged(t, np.eye(len(t)), self.lag))
        np.add.at(held, source, self.gain * (v @ curves(self.own_times(times))))
        out = np.zeros(run.signals.shape)
        for one in self.terms:
            if one.factor != 0.0:
                back = held @ slope(t, np.eye(len(t)), one.order)
                out[:, one.column] += one.factor * back
        return out

    def own_times(self, times: Array) -> Array:
        """Times (k,) [s] of the readings that the sensor stamps with `times`."""
        return times - self.delay - self.clock * (times - self.middle)


def slope(t: Array, y: Array, order: int) -> Array:
    """Derivative (G, ...) of some order of signals y (G, ...) at times t (G,) [s]."""
    return CubicSpline(t, y)(t, order) if order else y


def taken_up(y: Array, backlash: float) -> tuple[NDArray[np.intp], Array]:
    """Where a reading with backlash stands: the sample (G,) of the signal y (G,) that moved it
    last, and on which side, 1 for up and -1 for down; 0 before the play is taken up. Without
    backlash every sample moves it, and there are no sides. Not smooth where the direction
    changes."""
    if backlash == 0.0:
        return np.arange(len(y)), np.zeros(len(y))
    moved, k, way, at = list[tuple[int, int]](), 0, 0, float(y[0])
    for i, value in enumerate(y.tolist()):
        if abs(value - at) > 0.5 * backlash:
            k, way = i, 1 if value > at else -1
            at = value - 0.5 * backlash * way
        moved.append((k, way))
    source, side = np.array(moved).T
    return source, side.astype(float)


LAG_STEP = 1e-4
"""Relative change of a lag by which readings are differentiated."""


def lagged(t: Array, y: Array, lag: float) -> Array:
    """Signals y (G, ...) on lines between the times t (G,) [s] behind a low-pass of first order
    with the time constant `lag` [s], at rest at the first of them."""
    if lag == 0.0:
        return y
    out, spans = y.copy(), np.diff(t)
    for k, (h, rise) in enumerate(zip(spans, np.diff(y, axis=0))):
        behind = lag * rise / h  # of a line that has lasted
        out[k + 1] = y[k + 1] - behind + np.exp(-h / lag) * (out[k] - y[k] + behind)
    return out


def censored(z: Array) -> tuple[Array, Array]:
    """-sqrt(-2 ln Phi(z)) (k,) for values expected z standard deviations beyond a limit, and its
    derivative; Phi is the normal distribution function. It tends to z far short of the limit, and
    to zero far beyond."""
    log = log_ndtr(z)
    r = -np.sqrt(-2 * log)
    density = np.exp(-0.5 * z**2 - log) / np.sqrt(2 * np.pi)
    return r, np.divide(density, -r, out=np.zeros_like(r), where=r < 0)


def partner(rig: Rig, channel: str) -> tuple[str, float]:
    """The perpendicular channel, and the sign with which a rotated sensor sees it. Raises
    `ValueError`."""
    known = measurable(rig)
    for a, b, sign in (
        ("x_", "y_", 1.0),
        ("y_", "x_", -1.0),
        ("v_x_", "v_y_", 1.0),
        ("v_y_", "v_x_", -1.0),
    ):
        if channel.startswith(a) and (other := b + channel.removeprefix(a)) in known:
            return other, sign
    for name, actuator in rig.actuators.items():
        body, axis = actuator.pushes.split(".")
        other = {"x": "y", "y": "x"}.get(axis)
        twin = next((k for k, a in rig.actuators.items() if a.pushes == f"{body}.{other}"), None)
        if channel == effort_channel(name) and twin is not None:
            return effort_channel(twin), 1.0 if axis == "x" else -1.0
    raise ValueError(
        f"sensors.{channel}.misalignment: `{channel}` has no channel at right angles that it could "
        "see"
    )


def pushed(rig: Rig, channel: str) -> str:
    """Channel of the rate of the coordinate that an actuator pushes, by the channel of its effort.
    Raises `ValueError` for other channels."""
    for name, actuator in rig.actuators.items():
        if channel == effort_channel(name):
            body, axis = actuator.pushes.split(".")
            return rate_channel(f"{axis}_{rig.symbols[body]}")
    raise ValueError(f"sensors.{channel}.inertia: `{channel}` is not the force of an actuator")


def readout(
    recording: Recording, channel: str, sensor: Sensor, values: Mapping[Nuisance, float]
) -> Readout:
    """The readout of a sensor with the nuisances' `values` in a recording. Raises `ValueError` for
    a nuisance that the channel cannot have."""
    rig, column = recording.rig, recording.channels.index
    first, last = float(recording.times[0]), float(recording.times[-1])
    at = {kind: values.get(kind, float(kind == "gain")) for kind in NUISANCES}
    c, s = np.cos(at["misalignment"]), np.sin(at["misalignment"])
    if sensor.misalignment > 0:
        other, sign = partner(rig, channel)
        terms = [
            Term(column(channel), 0, float(c), ("misalignment", -float(s))),
            Term(column(other), 0, float(sign * s), ("misalignment", float(sign * c))),
        ]
    else:
        terms = [Term(column(channel), 0, 1.0)]
    if sensor.clock * 0.5 * (last - first) + sensor.delay > REACH:
        raise ValueError(
            f"sensors.{channel}.clock = {sensor.clock:g} is more than {REACH:g} s at the ends of a "
            f"recording of {last - first:g} s, with its delay; take less"
        )
    if sensor.inertia > 0:
        terms.append(Term(column(pushed(rig, channel)), 1, -at["inertia"], ("inertia", -1.0)))
    return Readout(
        channel,
        sensor.sd,
        sensor.low,
        sensor.high,
        at["gain"],
        at["bias"],
        at["drift"],
        at["delay"],
        0.5 * (first + last),
        tuple(terms),
        at["clock"],
        at["lag"],
        at["backlash"],
    )


# Runs: signals with derivatives


TOLERANCE = 1e-8
"""Newton tolerance [N] of the runs in fits: far below any sensor, above rounding errors with the
largest dashpots."""


class Frozen:
    """Frozen steps of a run: their ends `knots` (steps + 1,) [s]. Its `repr` identifies them to the
    bit."""

    def __init__(self, knots: Array) -> None:
        self.knots, self._name = knots, sha256(knots.tobytes()).hexdigest()

    def __repr__(self) -> str:
        return f"Frozen({self._name})"


Steps = float | Frozen
"""Steps of a run: a relative tolerance that chooses them, or frozen ones."""


@torch.no_grad()
def set_parameters(rig: Rig, values: Mapping[str, float]) -> None:
    """Set parameters of the rig, by the names of `Rig.parameter`; coordinates of a start are left
    out."""
    for name, value in values.items():
        if not name.startswith(PREFIX):
            rig.parameter(name).fill_(value)


def prepared(
    context: RunContext, values: Mapping[str, float], names: Sequence[str]
) -> tuple[Tensor, list[Tensor]]:
    """Set the rig's parameters, and make its initial state y0 (size,), differentiable by `names`,
    whose tensors are returned, too."""
    set_parameters(context.rig, values)
    at = {
        name: torch.tensor(value, dtype=torch.float64, requires_grad=name in names)
        for name, value in values.items()
        if name.startswith(PREFIX)
    }
    parameters = tuple(name for name in names if name not in at)
    assert tuple(names[: len(parameters)]) == parameters
    inputs = [*map(context.rig.parameter, parameters), *(at[name] for name in names if name in at)]
    return context.y0(at), inputs


def derivatives(
    rig: Rig, run: Trajectory, names: Sequence[str], reference: Reference, places: Sequence[Tensor]
) -> Array:
    """Derivatives (T, channels, n) of the channels `names` by the run's parameters and start. Those
    of touch come from the run; others follow from the sensitivities of the bodies' motion, and from
    the controllers' own parameters and set-points, of the `reference`, which is also made of the
    start's `places`."""
    slopes = {name: slope.numpy() for name, slope in run.touch_sensitivities.items()}
    if moved := [name for name in names if name not in slopes]:
        slopes |= dict(zip(moved, by_motion(rig, run, moved, reference, places).swapaxes(0, 1)))
    return np.stack([slopes[name] for name in names], 1)


def by_motion(
    rig: Rig, run: Trajectory, names: Sequence[str], reference: Reference, places: Sequence[Tensor]
) -> Array:
    """Derivatives (T, channels, n) of channels that the bodies' motion determines."""
    assert run.sensitivities is not None
    signals = rig.follow(run.t, reference)
    along = [
        torch.zeros((), dtype=torch.float64, requires_grad=True)
        for _ in range(run.sensitivities.shape[-1])
    ]
    slopes, own = run.sensitivities, rig.layout.measured
    slopes = slopes[:, own] if slopes.shape[1] == run.y.shape[1] else slopes
    q = run.y[:, own].detach() + slopes @ torch.stack(along)
    state = rig.layout.without_surfaces().unpack(q, *rig.held(signals))
    known = read(Seen(rig, state, signals), names)
    measured = torch.stack([known[name] for name in names], -1)
    return directions(measured, along) + directions(
        measured, [*map(rig.parameter, run.wrt), *places]
    )


def choice(steps: Steps) -> dict[str, Any]:
    """Arguments of `simulate` for its steps and tolerance."""
    chosen = (
        {"knots": torch.from_numpy(steps.knots)} if isinstance(steps, Frozen) else {"rtol": steps}
    )
    return chosen | {"tolerance": TOLERANCE}


def initial_state(
    context: RunContext, values: Mapping[str, float], names: Sequence[str]
) -> tuple[Tensor, Tensor]:
    """Initial state y0 (size,) of a run, and its derivatives (size, n) by `names`. Raises
    `SimulationFailed`."""
    y0, inputs = prepared(context, values, names)
    return y0.detach(), torch.from_numpy(directions(y0, inputs))


def predict(
    context: RunContext,
    values: Mapping[str, float],
    grid: Grid,
    names: Sequence[str],
    steps: Steps,
    start: tuple[Tensor, Tensor] | None = None,
) -> Prediction:
    """Signals on the grid, and their derivatives by `names`, if any. `start` is the
    `initial_state`, if known. Raises `SimulationFailed`."""
    rig, keys = context.rig, context.channels
    y0, dy0 = start or initial_state(context, values, names)
    set_parameters(rig, values)
    touch = [key for key in keys if key not in measurable(rig)] if names else ()
    wrt = tuple(name for name in names if not name.startswith(PREFIX))
    places = [y0.new_zeros(()).requires_grad_() for _ in names[len(wrt) :]]  # of the start
    leaves = [*map(rig.parameter, wrt), *places]
    along = torch.stack([x - x.detach() for x in leaves]) if leaves else y0.new_zeros(0)
    reference = reference_from(rig, context.start, rig.unpack(y0 + dy0 @ along).pose)
    out = unjudged(
        rig,
        grid.t,
        y0=y0,
        reference=reference,
        gradient="forward" if names else "none",
        wrt=wrt,
        dy0=dy0 if names else None,
        rigid=bool(names),
        touch=touch,
        more=places,
        **choice(steps),
    )
    rows = slice(grid.early, None)
    slopes = derivatives(rig, out, keys, reference, places)[rows] if names else None
    knots = None if isinstance(steps, Frozen) else out.knots.numpy()
    return Prediction(
        grid.t[rows].numpy(),
        out.together(*keys)[rows].detach().numpy(),
        slopes,
        knots,
    )


def run_doubts(
    context: RunContext, values: Mapping[str, float], grid: Grid, steps: Steps
) -> list[str]:
    """Warnings of the run at the end of a fit, which those on the way to it do not give. Raises
    `SimulationFailed`."""
    y0, _ = prepared(context, values, ())
    reference = reference_from(context.rig, context.start, context.rig.unpack(y0.detach()).pose)
    run = unjudged(context.rig, grid.t, y0=y0.detach(), reference=reference, **choice(steps))
    return list(doubts(run, context.rig, differentiated=True).values())
