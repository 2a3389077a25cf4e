"""Targets and limits of a plan, as functions of a run."""

from collections.abc import Callable, Mapping
from typing import Self

import torch
from pydantic import Field, model_validator
from torch import Tensor

from torchsoft.display import suggestion
from torchsoft.solve.trajectory import Trajectory
from torchsoft.tables import Table

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
    """Target for a channel: `value` [its unit] at the time `at` [s], by default the end of the run,
    within `tolerance`."""

    channel: str
    value: float
    tolerance: float = Field(gt=0)
    at: float | None = None

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
    """Limit of a channel: between `low` and `high` [its unit], one of which may be missing, from
    `since` to `until` [s]."""

    channel: str
    low: float | None = None
    high: float | None = None
    since: float | None = None
    until: float | None = None

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
