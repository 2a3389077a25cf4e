"""What a fit left, channel by channel: residuals whose noise is normal, and the reading that the model predicts beside them."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve_triangular
from scipy.special import ndtri_exp

from torchsoft.sysid.problem.noise import Autoregression
from torchsoft.sysid.problem.problem import Problem
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.unknowns import Sensor

CLEAR = 4.0
"""Standard deviations of the noise that a prediction must be within the range of a sensor that is saturated, so that its
residual has a normal distribution; and from the prediction, beyond which a sample counts wherever it is."""

FEWEST = 4
"""Samples that are left of a sensor that is saturated, below which nothing is said of it."""


class Part(NamedTuple):
    """One channel of one recording at the fit, without what saturation has changed: times t (m,) [s], the rows (m,) of r and J
    that are its own, the residuals `raw` (m,) over the noise that the sensor states, the `reading` (m,) that the model
    predicts [unit], the noise that is assumed (white as stated, if None), whether its level was `found` from such residuals,
    what whitens (m,) or (m, k), and how many samples were `saturated`."""

    recording: str
    channel: str
    t: Array
    rows: NDArray[np.int_]
    raw: Array
    reading: Array
    noise: Autoregression | None = None
    found: bool = False
    whitened: Callable[[Array], Array] = lambda rows: rows
    saturated: int = 0

    @property
    def name(self) -> str:
        """As sentences name it."""
        return f"{self.channel} of `{self.recording}`"


def parts(problem: Problem, r: Array, which: Sequence[str]) -> list[Part]:
    """The parts of residuals r of `Problem.residuals`, whitened by the problem's noise; none of a channel that is saturated
    but for less than `FEWEST` samples.

    Of a sensor that is saturated samples are left out where the prediction is near the end of its range or beyond, whether
    they are saturated or not: the noise of those that are not is not normal. What is far from the prediction stays."""
    out, at = [], 0
    for recording in problem.recordings:
        for channel, sensor in problem.sensors.items() if recording.name in which else ():
            if channel not in recording.samples:
                continue
            t, measured = recording.samples[channel]
            rows, noise = at + np.arange(len(t)), problem.noise.get(channel)
            at += len(t)
            raw = r[rows] if noise is None else spsolve_triangular(noise.whitener(t), r[rows])
            reading, found = predicted(sensor, measured, raw), noise is not None
            saturated = int(sensor.saturated(measured).sum())
            if saturated:
                near = sensor.saturated(reading - CLEAR * sensor.noise) | sensor.saturated(
                    reading + CLEAR * sensor.noise
                )
                kept = ~near | (np.abs(raw) > CLEAR)
                if kept.sum() < FEWEST:
                    continue
                t, rows, raw, reading = t[kept], rows[kept], raw[kept], reading[kept]
            whitened = partial(problem.whitened, recording, channel)
            out.append(Part(recording.name, channel, t, rows, raw, reading, noise, found, whitened, saturated))
    return out


def predicted(sensor: Sensor, measured: Array, raw: Array) -> Array:
    """Readings without noise (m,), from samples and residuals over the noise: infinite where a saturated one leaves nothing."""
    y = measured + sensor.noise * raw
    for limit, sign in ((sensor.high, 1.0), (sensor.low, -1.0)):
        if limit is not None:
            at = sign * measured >= sign * limit
            y[at] = limit + sign * sensor.noise * ndtri_exp(-0.5 * raw[at] ** 2)
    return y
