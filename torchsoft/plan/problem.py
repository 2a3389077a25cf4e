"""Problem of a plan: targets and limits, free variables, and their evaluation."""

import warnings
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from torchsoft.display import suggestion
from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig
from torchsoft.plan.knots import Array, Bounds, Moves, Range
from torchsoft.solve.batch import Batch, run_values, simulate_batch
from torchsoft.solve.simulate import Initial, Start, started
from torchsoft.solve.trajectory import Trajectory
from torchsoft.tables import Table

# Targets and limits of a plan, as functions of a run.


Term = Callable[[Trajectory], Tensor]
"""A torch function of a run, differentiable through the run."""


def samples(run: Trajectory, channel: str) -> Tensor:
    """A channel (T,). Raises `ValueError` for an unknown one."""
    if channel not in run:
        raise ValueError(
            f"there is no channel `{channel}`; {suggestion(channel, run.keys(), 'the run has')}"
        )
    return run[channel]


class Target(Table):
    """Target for a channel at one time."""

    channel: str
    """name of a channel of the run"""
    value: float
    """value to reach [the channel's unit]"""
    tolerance: float = Field(gt=0)
    """permitted error [the channel's unit]"""
    at: float | None = None
    """time at which it is reached; the end of the run if not given [s]"""

    def __call__(self, run: Trajectory) -> Tensor:
        """Error () over the tolerance, interpolated linearly between outputs."""
        y, t = samples(run, self.channel), run.t
        at = float(t[-1]) if self.at is None else self.at
        if not float(t[0]) <= at <= float(t[-1]) * (1 + 1e-12):
            raise ValueError(
                f"at = {at:g} s is outside the run, from {float(t[0]):g} to {float(t[-1]):g} s"
            )
        i = min(max(int(torch.searchsorted(t, at)), 1), len(t) - 1)
        part = (at - t[i - 1]) / (t[i] - t[i - 1])
        return (y[i - 1] + part * (y[i] - y[i - 1]) - self.value) / self.tolerance


class Limit(Table):
    """Limit of a channel over a time; `low` or `high` may be missing, not both."""

    channel: str
    """name of a channel of the run"""
    low: float | None = None
    """lower limit; none if not given [the channel's unit]"""
    high: float | None = None
    """upper limit; none if not given [the channel's unit]"""
    since: float | None = None
    """time from which it holds; the start of the run if not given [s]"""
    until: float | None = None
    """time until which it holds; the end of the run if not given [s]"""

    @model_validator(mode="after")
    def _has_a_bound(self) -> Self:
        if self.low is None and self.high is None:
            raise ValueError(f"a limit of {self.channel} needs `low`, `high` or both")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"low = {self.low:g} must be below high = {self.high:g}")
        return self

    @property
    def scale(self) -> float:
        """Scale of the excess [the channel's unit]."""
        if self.low is not None and self.high is not None:
            return self.high - self.low
        bound = self.high if self.low is None else self.low
        return abs(bound or 0.0) or 1.0

    def __call__(self, run: Trajectory) -> Tensor:
        """Largest excess (bounds,) over the scale; not positive within the limit."""
        y, t = samples(run, self.channel), run.t
        first = float(t[0]) if self.since is None else self.since
        last = float(t[-1]) if self.until is None else self.until
        y = y[(t >= first - 1e-12) & (t <= last + 1e-12)]
        if not len(y):
            raise ValueError(f"no output lies between {first:g} and {last:g} s")
        over = [] if self.high is None else [(y.max() - self.high) / self.scale]
        under = [] if self.low is None else [(self.low - y.min()) / self.scale]
        return torch.stack(over + under)


def evaluated(terms: Mapping[str, Term], run: Trajectory, field: str) -> dict[str, Tensor]:
    """Values of all terms on a run, as vectors. Raises `ValueError` naming the term."""
    out = {}
    for name, term in terms.items():
        try:
            value = term(run)
        except (ValueError, KeyError) as error:
            raise ValueError(f"{field}.{name}: {error}") from None
        if not isinstance(value, Tensor) or value.ndim > 1:
            raise ValueError(f"{field}.{name} must give one number or a vector as a tensor")
        if not bool(value.isfinite().all()):
            raise ValueError(f"{field}.{name} is not finite on this run")
        out[name] = value.reshape(-1)
    return out


# Free variables of a plan: knots of motions, and parameters of a rig of any shape.


Free = Mapping[str, Bounds | Range | tuple[float, float]]
"""Bounds of a motion's knots by its name, or lower and upper bound of a parameter by its name."""


class Variables:
    """The vector z (n,) of a plan's free variables. Each is over a unit of its own: for knots the
    distance that speed allows between two of them, for parameters their range, or their largest
    value where the range is infinite.

    Raises `ValueError` for names that the rig does not have, and for bounds that leave no freedom.
    """

    def __init__(self, rig: Rig, reference: Reference, free: Free, end: float) -> None:
        if not free:
            raise ValueError("`free` names no motion and no parameter: there is nothing to plan")
        self.moves = Moves(
            reference, {k: one for k, one in free.items() if isinstance(one, Bounds)}, end
        )
        self.shapes: dict[str, torch.Size] = {}
        z, low, high, units = [self.moves.start], [], [], []
        for name, one in free.items():
            if isinstance(one, Bounds):
                continue
            value = rig.parameter(name).detach()
            least, most = (one.low, one.high) if isinstance(one, Range) else one
            if not least < most:
                raise ValueError(f"free.{name} = ({least:g}, {most:g}): low must be below high")
            if not bool(((value >= least) & (value <= most)).all()):
                raise ValueError(
                    f"free.{name}: its value in the rig is not between {least:g} and {most:g}; "
                    "begin within the bounds"
                )
            self.shapes[name] = value.shape
            finite = np.isfinite([least, most]).all()
            unit = most - least if finite else float(value.abs().max()) or 1.0
            flat = value.double().reshape(-1).numpy()
            z.append(flat / unit)
            units.append(np.full(len(flat), unit))
            low.append(np.full(len(flat), least / unit))
            high.append(np.full(len(flat), most / unit))
        self.unit = np.concatenate([np.ones(self.moves.n), *units])
        self.start: Array = np.concatenate(z)
        self.n = len(self.start)
        unbounded = np.full(self.moves.n, np.inf)
        self.low = np.concatenate([-unbounded, *low])
        self.high = np.concatenate([unbounded, *high])
        # D z holds the ways between knots, so that a small change of it is a smooth one
        self.D = np.eye(self.n)
        self.D[: self.moves.n, : self.moves.n] = self.moves.ways
        # A z <= b keeps knots within their bounds
        self.A = np.pad(self.moves.A, ((0, 0), (0, self.n - self.moves.n)))
        self.b = self.moves.b

    def reference(self, z: Tensor, given: Reference | None = None) -> Reference:
        """The motion, by default of the given reference, differentiable with respect to z (n,)."""
        return self.moves.reference(z[: self.moves.n], given)

    def parameters(self, z: Tensor) -> dict[str, Tensor]:
        """Parameters by name for one or more z (..., n), differentiable by z."""
        out, at = {}, self.moves.n
        physical = z * torch.from_numpy(self.unit)
        for name, shape in self.shapes.items():
            count = shape.numel()
            out[name] = physical[..., at : at + count].reshape((*z.shape[:-1], *shape))
            at += count
        return out

    def nearest(self, z: Array) -> Array:
        """The nearest z within all bounds."""
        k = self.moves.n
        return np.concatenate(
            (self.moves.nearest(z[:k]), np.clip(z[k:], self.low[k:], self.high[k:]))
        )

    def spread(self, u: Array) -> Array:
        """The z at a point u (n,) of the unit cube, which is mapped to the bounds. Raises
        `ValueError` for parameters without bounds."""
        low, high = self.low.copy(), self.high.copy()
        for i, (least, most) in enumerate(self.moves.box()):
            low[i], high[i] = least, most
        if not (np.isfinite(low) & np.isfinite(high)).all():
            raise ValueError(
                "several starts need finite bounds of every parameter; give them, or `starts = 1`"
            )
        return self.nearest(low + u * (high - low))

    def active(self, z: Array) -> list[str]:
        """Active bounds at z, in words."""
        out, at = self.moves.active(z[: self.moves.n]), self.moves.n
        for name, shape in self.shapes.items():
            part = slice(at, at + shape.numel())
            at = part.stop
            for bound, side in ((self.low[part], "low"), (self.high[part], "high")):
                if (np.abs(z[part] - bound) < 1e-3).any():
                    out.append(f"{name} at its {side} = {bound[0] * self.unit[part][0]:g}")
        return out


# Runs of a plan: values, targets and limits for every draw of uncertain parameters, and their
# derivatives by the free variables.


class Terms(NamedTuple):
    """Functions of a run: an objective to minimise, targets whose errors over a tolerance should
    vanish, and limits whose excess should not be positive."""

    objective: Term | None
    targets: Mapping[str, Term]
    limits: Mapping[str, Term]

    def of(self, run: Trajectory) -> tuple[Tensor, Tensor, Tensor]:
        """Value (), errors (k,) and excess (m,) of a run. Raises `ValueError` naming the term."""
        alone = {} if self.objective is None else {"objective": self.objective}
        parts = []
        for field, terms in (("plan", alone), ("targets", self.targets), ("limits", self.limits)):
            found = list(evaluated(terms, run, field).values())
            parts.append(torch.cat(found) if found else torch.zeros(0, dtype=torch.float64))
        if self.objective is not None and len(parts[0]) != 1:
            raise ValueError("`objective` must give one number")
        return parts[0].sum(), parts[1], parts[2]

    def labels(self, run: Trajectory) -> tuple[list[str], list[str]]:
        """Names of the single errors, and of the single excesses."""

        def named(terms: Mapping[str, Term], field: str) -> list[str]:
            sizes = {name: len(v) for name, v in evaluated(terms, run, field).items()}
            return [
                name if size == 1 else f"{name}.{i}" for name, size in sizes.items()
                for i in range(size)
            ]  # fmt: skip

        return named(self.targets, "targets"), named(self.limits, "limits")


class Evaluation:
    """A plan at z (n,): value (draws,), errors (draws, k) and excess (draws, m) of its runs, and
    their derivatives. `failure` is the reason of a failed run."""

    def __init__(
        self, z: Array, rows: Tensor, batch: Batch | None, terms: Terms, failure: str
    ) -> None:
        self.z, self.rows, self.batch, self.failure = z, rows, batch, failure
        if batch is None or failure:
            return
        parts = [terms.of(run) for run in batch.trajectories if run is not None]
        self._value, self._errors, self._excess = (torch.stack(part) for part in zip(*parts))
        self.value: Array = self._value.detach().numpy()
        self.errors: Array = self._errors.detach().numpy()
        self.excess: Array = self._excess.detach().numpy()

    @cached_property
    def slopes(self) -> tuple[Array, Array, Array]:
        """Derivatives by z of values (draws, n), errors (draws, k, n) and excess (draws, m, n); one
        backward pass over every run for each column. Raises `GradientFailed`."""

        def by(columns: Tensor) -> Array:
            if not columns.requires_grad:  # nothing of the run is in it
                return np.zeros((*columns.shape, self.rows.shape[-1]))
            found = [
                torch.autograd.grad(column.sum(), self.rows, retain_graph=True)[0]
                for column in columns.unbind(1)
            ]
            return torch.stack(found, 1).numpy()

        return by(self._value[:, None])[:, 0], by(self._errors), by(self._excess)


class Evaluator:
    """Evaluation of plans by runs. `over` holds draws of parameters by name (draws, ...), y0 their
    initial states (size,) or (draws, size), or a start as a function of the rig."""

    def __init__(
        self, rig: Rig, t: Tensor, variables: Variables, terms: Terms, y0: Tensor | Start,
        over: Mapping[str, Tensor], rtol: float,
    ) -> None:  # fmt: skip
        if twice := set(over) & set(variables.shapes):
            raise ValueError(f"`{min(twice)}` is both free and drawn; leave it out of one of them")
        counts = {name: len(values) for name, values in over.items()}
        if isinstance(y0, Tensor) and y0.ndim == 2:
            counts["y0"] = len(y0)
        if len(set(counts.values())) > 1:
            listed = ", ".join(f"{name} {count}" for name, count in counts.items())
            raise ValueError(f"every draw needs one entry, but there are: {listed}")
        self.draws = next(iter(counts.values()), 1)
        self.rig, self.t, self.variables, self.terms = rig, t, variables, terms
        self.over, self.rtol, self.evaluations = dict(over), rtol, 0
        self.starts = self._starts(y0)

    def _starts(self, y0: Tensor | Start) -> list[Initial | Start]:
        """Start of every draw: a function of the rig where free parameters may change it."""
        if isinstance(y0, Tensor):
            rows = y0.expand(self.draws, -1)
            return [Initial(row, self.variables.moves.given) for row in rows]
        if self.variables.shapes:
            return [y0] * self.draws
        values = [run_values(self.rig, self.over, i) for i in range(self.draws)]
        return [started(self.rig, y0, "none", values=one) for one in values]

    def _planned(self, z: Tensor, start: Initial | Start) -> Initial | Start:
        """A start, with the motion of a plan at z."""
        if callable(start):
            return lambda rig: self._moving(z, start(rig))
        return self._moving(z, start)

    def _moving(self, z: Tensor, start: Initial) -> Initial:
        return start._replace(reference=self.variables.reference(z, start.reference))

    def evaluate(self, z: Array, rtol: float | None = None, *, gradient: bool = True) -> Evaluation:
        """The plan at z, with the evaluator's relative tolerance or another. Raises `ValueError`
        for impossible values."""
        self.evaluations += 1
        rows = torch.from_numpy(np.tile(z, (self.draws, 1))).requires_grad_(gradient)
        # the run that is kept is made again, and warns
        with warnings.catch_warnings(action="ignore"):
            batch = simulate_batch(
                self.rig, self.t, parameters=self.over | self.variables.parameters(rows),
                y0=[self._planned(*one) for one in zip(rows, self.starts)],
                rtol=self.rtol if rtol is None else rtol,
                gradient="discrete" if gradient else "none",
            )  # fmt: skip
        failure = "; ".join(f"draw {i}: {reason}" for i, reason in list(batch.failures.items())[:1])
        return Evaluation(z, rows, batch, self.terms, failure)
