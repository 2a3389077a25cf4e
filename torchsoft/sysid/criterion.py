"""Criteria of optimal design, a ranking of recordings that could be made next, and the bounds of a
designed motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args

import numpy as np
import torch
from pydantic import Field, model_validator
from scipy.optimize import linprog
from torch import Tensor

from torchsoft.physics.motion import Profile, Reference
from torchsoft.sysid.fit import fisher
from torchsoft.sysid.initial_state import PREFIX
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.runs import Runner
from torchsoft.tables import Table

Optimality = Literal["D", "A", "worst"]

SHARPNESS = 12.0
"""Of the smooth maximum: it exceeds the largest logarithm by ln(parameters) over this at most."""


@dataclass(frozen=True)
class Criterion:
    """One number for a covariance C (s, s) of parameters' relative errors: the logarithm of a
    standard deviation, the smaller the better.

    "D" is the mean logarithm along the axes of the ellipsoid of errors, its volume; "A" the root
    mean square of the standard deviations over `targets` (s,), 1 where there are none; "worst" the
    largest of them, smoothed. With one parameter the three are the same, and are called
    c-optimality. Raises `ValueError`.
    """

    optimality: Optimality = "D"
    targets: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.optimality not in get_args(Optimality):
            raise ValueError(
                f"`optimality` must be one of {', '.join(get_args(Optimality))}, not "
                f"{self.optimality!r}"
            )
        if self.targets is not None and not (
            np.isfinite(self.targets).all() and np.min(self.targets) > 0
        ):
            raise ValueError(
                f"`targets` must be positive standard deviations, but are {self.targets}"
            )

    def __call__(self, C: Array) -> tuple[float, Array]:
        """Its value and derivative (s, s) by C."""
        if self.optimality == "D":
            return 0.5 * float(np.linalg.slogdet(C)[1]) / len(C), 0.5 * np.linalg.inv(C) / len(C)
        scaled = np.diag(C) / np.square(1.0 if self.targets is None else self.targets)
        if self.optimality == "A":
            return 0.5 * float(np.log(scaled.mean())), np.diag(
                0.5 * scaled / np.diag(C) / scaled.sum()
            )
        logs = 0.5 * np.log(scaled)
        parts = np.exp(SHARPNESS * (logs - logs.max()))
        value = float(logs.max() + np.log(parts.sum()) / SHARPNESS)
        return value, np.diag(0.5 * parts / parts.sum() / np.diag(C))

    def check(self, names: Sequence[str]) -> None:
        """Raises `ValueError` unless there is a target for every parameter, or none."""
        if self.targets is not None and len(self.targets) != len(names):
            raise ValueError(
                f"`targets` has {len(self.targets)} standard deviations for the {len(names)} of "
                f"{names}"
            )


VOLUME = Criterion()


def chosen(
    problem: Problem, x: Array, names: Sequence[str] | None
) -> tuple[tuple[str, ...], Array]:
    """The parameters `names`, by default every free one that all recordings share, and what their
    relative errors (s,) are of those of the coordinates x (n,): a matrix (s, n). Raises
    `ValueError` for others."""
    c, one = problem.coordinates, problem.recordings[0]
    values = c.values(x, one.name, one.parameters)
    rows = c.jacobian(x, one.name, values) * c.free / np.array([[values[name]] for name in c.names])
    own = {a.name for a in c.all if a.recording is not None}
    known = [
        name
        for name, row in zip(c.names, rows)
        if row.any() and name not in own and not name.startswith(PREFIX)
    ]
    wanted = tuple(known if names is None else names)
    if not wanted or len(set(wanted)) < len(wanted) or not set(wanted) <= set(known):
        raise ValueError(
            f"`names` must be some of the parameters {', '.join(known)}, each once, but is "
            f"{list(wanted)}"
        )
    return wanted, np.stack([rows[c.names.index(name)] for name in wanted])


def deviations(names: Sequence[str], T: Array, C: Array) -> dict[str, float]:
    """Relative standard deviations of parameters, T (s, n) being what they are of coordinates with
    the covariance C."""
    return dict(zip(names, np.sqrt(np.diag(T @ C @ T.T)).tolist()))


@dataclass(frozen=True)
class Outlook:
    """A recording that could be made: its duration [s], the relative standard deviations that
    parameters have without it and would have with it, and the criterion's gain, a logarithm of
    standard deviations. `lost` says why it cannot be made."""

    name: str
    seconds: float
    before: dict[str, float]
    after: dict[str, float]
    gain: float
    lost: str = ""


def next_recording(
    problem: Problem, x: Array, candidates: Sequence[Recording], *,
    names: Sequence[str] | None = None, criterion: Criterion = VOLUME, per_second: bool = False,
    rtol: float = 1e-4, workers: int = 1,
) -> list[Outlook]:  # fmt: skip
    """What should be recorded after the recordings of `problem`, whose coordinates are x (n,), say
    at the end of a fit?

    Every candidate's Fisher matrix is added to theirs; of its samples only the times count. The
    best comes first, by what it takes off the `criterion` of the parameters `names`, or by that per
    second. A prediction: it holds as far as the model does, and for small errors. Raises
    `ValueError` for candidates that do not fit the problem.
    """
    if not candidates:
        raise ValueError("there is no candidate to rank")
    both = Problem(
        [*problem.recordings, *candidates], problem.sensors, problem.unknowns, problem.noise
    )
    known = dict(zip(problem.coordinates.labels, x))
    c, x = (
        both.coordinates,
        np.array(
            [known.get(a.label, s) for a, s in zip(both.coordinates.all, both.coordinates.start)]
        ),
    )
    names, T = chosen(both, x, names)
    criterion.check(names)
    runner, priors = Runner(both.recordings, workers), len(c.priors)
    have = both.residuals(runner, x, problem.names, rtol, c.free)
    if have.lost:
        reasons = "; ".join(f"`{name}`: {lost.reason}" for name, lost in have.lost.items())
        raise ValueError(f"`x` does not reproduce what was recorded: {reasons}")

    def covariance(J: Array, those: Sequence[str]) -> Array:
        """Of the coordinates that matter to some recordings; zero for the others."""
        mine = np.array([a.recording in (None, *those) for a in c.all]) & c.free
        rows = np.ones(len(J), bool)
        rows[len(J) - priors :] = [mine[i] for i, _ in c.priors]
        C = np.zeros((len(x), len(x)))
        C[np.ix_(mine, mine)] = fisher(J[np.ix_(rows, mine)])[0]
        return C

    C = covariance(have.J, problem.names)
    before, out = deviations(names, T, C), []
    for one in candidates:
        new = both.residuals(runner, x, [one.name], rtol, c.free)
        if new.lost:
            out.append(
                Outlook(one.name, one.duration, before, before, 0.0, new.lost[one.name].reason)
            )
            continue
        J = np.concatenate((have.J[: len(have.J) - priors], new.J))
        after = covariance(J, [*problem.names, one.name])
        gain = criterion(T @ C @ T.T)[0] - criterion(T @ after @ T.T)[0]
        out.append(Outlook(one.name, one.duration, before, deviations(names, T, after), gain))
    return sorted(out, key=lambda o: (bool(o.lost), -o.gain / (o.seconds if per_second else 1.0)))


# Bounds of a designed motion: travel, speed and duration of the knots


PEAK = 35 / 16
"""Largest over mean speed of the 7th-order profile."""


class Bounds(Table):
    """What a signal of the reference may do: values from `low` to `high` [its unit], at `speed`
    [its unit/s] at most.

    Knots later than `after` [s] are free. Their times are free too if `shortest` [s] is given, the
    least time between two.
    """

    low: float
    high: float
    speed: float = Field(gt=0)
    after: float = 0.0
    shortest: float | None = Field(default=None, gt=0)

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if self.low >= self.high:
            raise ValueError(f"low = {self.low:g} must be below high = {self.high:g}")
        return self


def profile(reference: Reference, name: str) -> Profile:
    """A signal of the reference. Raises `ValueError` where it is none, or no `Profile`."""
    try:
        found = reference[name]
    except KeyError:
        found = None
    if type(found) is not Profile:
        raise ValueError(
            f"the reference has no Profile called `{name}`: only knots of profiles can be designed"
        )
    return found


class Moves:
    """The variables z (n,) of a motion: values, and times where they are free, of the free knots of
    some signals, which end by `end` [s]; none where `bounds` names no signal. Each is over a unit
    of its own, the way or the time between two knots that are as far apart as speed allows.

    Raises `ValueError` for signals without free knots, and where the motion given is more than the
    bounds leave to it.
    """

    def __init__(self, reference: Reference, bounds: Mapping[str, Bounds], end: float) -> None:
        self.given, self.bounds, self.end = reference, dict(bounds), end
        self.knots: dict[str, tuple[Array, Array, int]] = {}  # times, values, the first free one
        units, z = [np.zeros(0)], [np.zeros(0)]
        for name, one in bounds.items():
            signal = profile(reference, name)
            times, values = signal.times.numpy(), signal.values.detach().numpy()
            first = int(np.searchsorted(times, one.after, side="right"))
            if first == len(times):
                raise ValueError(f"`{name}` has no knot after {one.after:g} s that could move")
            if first == 0 or times[-1] > end * (1 + 1e-9):
                raise ValueError(
                    f"`{name}` must have a knot at or before {one.after:g} s that stays, and none "
                    f"after {end:g} s"
                )
            self.knots[name] = times, values, first
            spans = np.diff(times[first - 1 :])
            units.append(np.minimum(one.speed * spans / PEAK, one.high - one.low))
            z.append(values[first:])
            if one.shortest is not None:
                units.append(spans)
                z.append(times[first:])
        self.unit, flat = np.concatenate(units), np.concatenate(z)
        self.n, origin = len(flat), self._excess(np.zeros(len(flat)))
        columns = [self._excess(e) - origin for e in np.eye(self.n)]  # excess is affine in z
        self.A = np.array(columns).reshape(self.n, len(origin)).T
        self.b = -origin
        self.start = self.nearest(flat / self.unit)

    def split(self, z: Any) -> dict[str, tuple[Any, Any]]:
        """Times and values of the free knots by signal, of z over its units, as arrays or
        tensors."""
        physical, out, at = (
            z * (torch.from_numpy(self.unit) if isinstance(z, Tensor) else self.unit),
            {},
            0,
        )
        for name, (times, _, first) in self.knots.items():
            count = len(times) - first
            values, at = physical[at : at + count], at + count
            moved = times[first:]
            if self.bounds[name].shortest is not None:
                moved, at = physical[at : at + count], at + count
            out[name] = moved, values
        return out

    def reference(self, z: Tensor) -> Reference:
        """The motion, with the graph of z."""
        signals = {name.replace(":", "."): signal for name, signal in self.given.signals.items()}
        for name, (times, values) in self.split(z).items():
            known_times, known_values, first = self.knots[name]
            moved = times if isinstance(times, Tensor) else torch.from_numpy(times)
            signals[name] = Profile(
                torch.cat((torch.from_numpy(known_times[:first]), moved)),
                torch.cat((torch.from_numpy(known_values[:first]), values)),
            )
        return Reference(**signals)

    def _excess(self, z: Array) -> Array:
        """What must not be positive: beyond the bounds, faster than allowed, closer than
        `shortest`, too late."""
        rows = [np.zeros(0)]
        for name, (times, values) in self.split(z).items():
            one, (known_times, known_values, first) = self.bounds[name], self.knots[name]
            t = np.concatenate((known_times[first - 1 : first], times))
            v = np.concatenate((known_values[first - 1 : first], values))
            way, span = np.diff(v), np.diff(t) * one.speed / PEAK
            rows += [(v[1:] - one.high), (one.low - v[1:]), way - span, -way - span]
            if one.shortest is not None:
                rows += [one.shortest - np.diff(t), t[-1:] - self.end]
        return np.concatenate(rows)

    def nearest(self, z: Array) -> Array:
        """The motion within the bounds that is nearest to z, by the sum of what variables move.
        Raises `ValueError` where there is none."""
        if not self.n or (self.A @ z <= self.b + 1e-9 * np.abs(self.A).max(1)).all():
            return z
        I, scale = np.eye(self.n), np.abs(self.A).max(1)
        A = np.block(
            [[self.A / scale[:, None], np.zeros((len(self.A), self.n))], [I, -I], [-I, -I]]
        )
        out: Any = linprog(
            np.append(np.zeros(self.n), np.ones(self.n)), A_ub=A,
            b_ub=np.concatenate((self.b / scale, z, -z)),
            bounds=[(None, None)] * self.n + [(0, None)] * self.n, method="highs",
        )  # fmt: skip
        if out.status != 0:
            raise ValueError(
                "no motion of these knots keeps within the bounds: allow more travel, speed or time"
            )
        return np.asarray(out.x[: self.n], np.float64)

    def active(self, z: Array) -> list[str]:
        """Which bounds a motion touches, and at how many knots, in words."""
        out = []
        for name, (times, values) in self.split(z).items():
            one, (known_times, known_values, first) = self.bounds[name], self.knots[name]
            way = np.diff(np.append(known_values[first - 1], values))
            span: Array = np.ediff1d(np.append(known_times[first - 1], times)).astype(
                np.float64
            ) * (one.speed / PEAK)
            near = 1e-3 * (one.high - one.low)
            for what, count in (
                (f"low = {one.low:g}", int(np.sum(values < one.low + near))),
                (f"high = {one.high:g}", int(np.sum(values > one.high - near))),
                (f"speed = {one.speed:g}", int(np.sum(np.abs(way) > 0.99 * span))),
            ):
                if count:
                    out.append(f"{name} at {what} in {count} of {len(values)} knots")
        return out
