"""The steps of a run: equal ones between output times, or those that tolerances chose, and where
the outputs lie in them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.physics.validity import check_array

CHUNK = 500
"""Steps per compiled call: how often progress is shown and Ctrl-C is heard."""


class Plan(NamedTuple):
    """Steps taken in one compiled call: their starts and lengths h [s], and per output its step and
    the part of it (0 to 1)."""

    starts: NDArray[np.float64]
    h: NDArray[np.float64]
    out_step: NDArray[np.int64]
    out_part: NDArray[np.float64]

    def part(self, first: int, end: int) -> "Plan":
        """Some of the steps."""
        rows = (self.out_step >= first) & (self.out_step < end)
        return Plan(
            self.starts[first:end],
            self.h[first:end],
            self.out_step[rows] - first,
            self.out_part[rows],
        )

    def halved(self, step: int) -> "Plan":
        """One of the steps, as two of half the length."""
        begin, h, parts = (
            self.starts[step],
            0.5 * self.h[step],
            self.out_part[self.out_step == step],
        )
        later = parts > 0.5
        return Plan(
            np.array([begin, begin + h]),
            np.array([h, h]),
            later.astype(np.int64),
            np.where(later, 2 * parts - 1, 2 * parts),
        )

    @property
    def output_times(self) -> NDArray[np.float64]:
        """Times of the outputs [s]."""
        return self.starts[self.out_step] + self.out_part * self.h[self.out_step]


LONGEST = 0.1
"""Longest step [s] by tolerance."""

MOST_STEPS = 100_000_000
"""Steps that one run may take at the most."""


SHORTEST = 1e-12
"""Time [s] between two outputs at the least."""


def check_times(t: Tensor, step: float | None = None) -> None:
    """Raises `ValueError` unless t is a float64 vector of at least two finite, strictly increasing
    times, no more than `MOST_STEPS` steps of `step` [s], or of the longest by tolerance, apart in
    all."""
    check_array("t", t)
    if t.ndim != 1 or len(t) < 2:
        raise ValueError(
            f"`t` must be a float64 vector of two times or more, but is {t.dtype} of shape "
            f"{tuple(t.shape)}"
        )
    if t.requires_grad:
        raise ValueError(
            "`t` must not require a gradient, since none is computed by the times; use t.detach()"
        )
    if not bool(torch.isfinite(t).all()) or not bool((t.diff() > 0).all()):
        bad = int((~(t.diff() > 0)).nonzero()[0, 0]) if bool(torch.isfinite(t).all()) else 0
        raise ValueError(
            f"`t` must increase strictly and be finite, but t[{bad}:{bad + 2}] = "
            f"{t[bad : bad + 2].tolist()}"
        )
    if (count := float(t[-1] - t[0]) / (LONGEST if step is None else step)) > MOST_STEPS:
        raise ValueError(
            f"`t` and `step` ask for {count:.3g} steps, but at most {MOST_STEPS:.3g} can be taken "
            "in one run; take less time"
            + (
                f" (by tolerance no step is longer than {LONGEST:g} s)"
                if step is None
                else " or longer steps"
            )
        )
    finest = max(SHORTEST, 16 * torch.finfo(torch.float64).eps * float(t.abs().max()))
    if float(t.diff().min()) < finest or (step is not None and step < finest):
        raise ValueError(
            f"`t` and `step` must be further apart than {finest:.1g} s, what times so long after "
            "zero resolve"
        )


def equal_steps(t: Tensor, step: float) -> Iterator[Plan]:
    """Cut the intervals between the times t (T,) [s] into equal steps no longer than `step` [s],
    CHUNK at a time; the steps of one plan have one length."""
    times = t.numpy()
    spans = np.diff(times)
    counts = np.maximum(1, np.ceil(spans / step * (1 - 1e-9))).astype(int)
    sizes = spans / counts
    changes = (np.diff(counts) != 0) | (np.abs(np.diff(sizes)) > 1e-9 * sizes[:-1])
    for equal in np.split(np.arange(len(spans)), np.flatnonzero(changes) + 1):
        n, h = int(counts[equal[0]]), float(sizes[equal[0]])
        starts = (times[equal, None] + h * np.arange(n)).ravel()
        for k in range(0, len(starts), CHUNK):
            here = starts[k : k + CHUNK]
            ends = np.flatnonzero((np.arange(k, k + len(here)) + 1) % n == 0)
            yield Plan(
                np.asarray(here, np.float64), np.full(len(here), h), ends, np.ones(len(ends))
            )


def check_knots(knots: Tensor) -> NDArray[np.float64]:
    """The ends of given steps (steps + 1,) [s]. Raises `ValueError` unless they are two or more,
    finite and increasing."""
    check_array("knots", knots)
    if (
        knots.ndim != 1
        or len(knots) < 2
        or not bool(torch.isfinite(knots).all())
        or not bool((knots.diff() > 0).all())
    ):
        raise ValueError(
            "`knots` must be two times or more [s], finite and increasing, but has shape "
            f"{tuple(knots.shape)}"
        )
    return knots.detach().numpy()


def given_steps(t: Tensor, knots: NDArray[np.float64]) -> Iterator[Plan]:
    """The steps between `knots` (n + 1,) [s], of another run, with outputs at t (T,); CHUNK at a
    time.

    Raises `ValueError` unless they cover t from its first time on.
    """
    times, h = t.numpy(), np.diff(knots)
    if knots[0] != times[0] or knots[-1] < times[-1] - 1e-9 * h[-1]:
        raise ValueError(
            f"`knots` must go from t[0] = {times[0]:g} s to t[-1] = {times[-1]:g} s, but go from "
            f"{knots[0]:g} s to {knots[-1]:g} s"
        )
    at = np.minimum(np.searchsorted(knots, times[1:], side="left"), len(h)) - 1
    parts = (times[1:] - knots[at]) / h[at]
    parts = np.where(np.abs(parts - 1.0) < 1e-9, 1.0, parts)
    whole = Plan(knots[:-1], h, at, parts)
    for k in range(0, len(h), CHUNK):
        yield whole.part(k, min(k + CHUNK, len(h)))
