"""The time grid of a run: output times, and the equal steps that each output interval is cut into."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

CHUNK = 500
"""Steps per compiled call: how often progress is shown and Ctrl-C is heard."""


class Chunk(NamedTuple):
    """Equal steps of h [s], taken in one compiled call: their starting times, and which of them end at an output."""

    h: float
    starts: NDArray[np.float64]
    keep: NDArray[np.bool_]


def check_times(t: Tensor) -> None:
    """Raises `ValueError` unless t is a float64 vector of at least two finite, strictly increasing times."""
    if t.ndim != 1 or len(t) < 2 or t.dtype != torch.float64:
        raise ValueError(
            f"`t` must be a float64 vector of two times or more, but is {t.dtype} of shape {tuple(t.shape)}"
        )
    if not bool(torch.isfinite(t).all()) or not bool((t.diff() > 0).all()):
        bad = int((~(t.diff() > 0)).nonzero()[0, 0]) if bool(torch.isfinite(t).all()) else 0
        raise ValueError(
            f"`t` must increase strictly and be finite, but t[{bad}:{bad + 2}] = {t[bad : bad + 2].tolist()}"
        )


def chunks(t: Tensor, step: float) -> Iterator[Chunk]:
    """Cut the intervals between the times t (T,) [s] into equal steps no longer than `step` [s], CHUNK at a time."""
    times = t.numpy()
    spans = np.diff(times)
    counts = np.maximum(1, np.ceil(spans / step * (1 - 1e-9))).astype(int)
    sizes = spans / counts
    first = 0
    while first < len(spans):
        last, total = first, 0
        same = lambda k: counts[k] == counts[first] and abs(sizes[k] - sizes[first]) <= 1e-9 * sizes[first]
        while last < len(spans) and same(last) and (total == 0 or total + counts[last] <= CHUNK):
            total += counts[last]
            last += 1
        n, h = counts[first], float(sizes[first])
        starts = (times[first:last, None] + h * np.arange(n)).ravel()
        keep = np.zeros(total, np.bool_)
        keep[n - 1 :: n] = True
        for k in range(0, total, CHUNK):  # one interval alone may be longer than a chunk
            yield Chunk(h, starts[k : k + CHUNK], keep[k : k + CHUNK])
        first = last
