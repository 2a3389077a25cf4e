"""The time grid of a run: output times, and the equal steps that each output interval is cut into."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.physics.validity import check_array

CHUNK = 500
"""Steps per compiled call: how often progress is shown and Ctrl-C is heard."""


class Chunk(NamedTuple):
    """Equal steps of h [s], taken in one compiled call: their starting times, and which of them end at an output."""

    h: float
    starts: NDArray[np.floating]
    keep: NDArray[np.bool_]

    def part(self, first: int, end: int) -> "Chunk":
        """Some of the steps."""
        return Chunk(self.h, self.starts[first:end], self.keep[first:end])

    def halved(self, step: int) -> "Chunk":
        """One of the steps, as two of half the length."""
        begin, h = self.starts[step], 0.5 * self.h
        return Chunk(h, np.array([begin, begin + h]), np.array([False, self.keep[step]]))


MOST_STEPS = 100_000_000
"""Steps that one run may take at the most."""


SHORTEST = 1e-12
"""Time [s] between two outputs at the least."""


def check_times(t: Tensor, step: float | None = None) -> None:
    """Raises `ValueError` unless t is a float64 vector of at least two finite, strictly increasing times, no more than
    `MOST_STEPS` steps of `step` [s] apart in all."""
    check_array("t", t)
    if t.ndim != 1 or len(t) < 2:
        raise ValueError(
            f"`t` must be a float64 vector of two times or more, but is {t.dtype} of shape {tuple(t.shape)}"
        )
    if t.requires_grad:
        raise ValueError("`t` must not require a gradient, since none is computed by the times; use t.detach()")
    if not bool(torch.isfinite(t).all()) or not bool((t.diff() > 0).all()):
        bad = int((~(t.diff() > 0)).nonzero()[0, 0]) if bool(torch.isfinite(t).all()) else 0
        raise ValueError(
            f"`t` must increase strictly and be finite, but t[{bad}:{bad + 2}] = {t[bad : bad + 2].tolist()}"
        )
    if step is not None and float(t[-1] - t[0]) / step > MOST_STEPS:
        count = float(t[-1] - t[0]) / step
        raise ValueError(
            f"`t` and `step` ask for {count:.3g} steps, but at most {MOST_STEPS:.3g} can be taken in one run"
        )
    finest = max(SHORTEST, 16 * torch.finfo(torch.float64).eps * float(t.abs().max()))
    if float(t.diff().min()) < finest or (step is not None and step < finest):
        raise ValueError(
            f"`t` and `step` must be further apart than {finest:.1g} s, what times so long after zero resolve"
        )


def chunks(t: Tensor, step: float) -> Iterator[Chunk]:
    """Cut the intervals between the times t (T,) [s] into equal steps no longer than `step` [s], CHUNK at a time."""
    times = t.numpy()
    spans = np.diff(times)
    counts = np.maximum(1, np.ceil(spans / step * (1 - 1e-9))).astype(int)
    sizes = spans / counts
    changes = (np.diff(counts) != 0) | (np.abs(np.diff(sizes)) > 1e-9 * sizes[:-1])
    for equal in np.split(np.arange(len(spans)), np.flatnonzero(changes) + 1):
        n, h = int(counts[equal[0]]), float(sizes[equal[0]])
        starts = (times[equal, None] + h * np.arange(n)).ravel()
        keep = np.zeros(len(starts), np.bool_)
        keep[n - 1 :: n] = True
        for k in range(0, len(starts), CHUNK):
            yield Chunk(h, starts[k : k + CHUNK], keep[k : k + CHUNK])
