"""Estimates with intervals, identifiability, and residuals by channel."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from torchsoft.sysid.fit import Fit
from torchsoft.sysid.initial_state import PREFIX
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import parts, whiteness
from torchsoft.sysid.unknowns import FAULTS, Coordinate, Prior
from torchsoft.tables import Number

IDENTIFIABLE = 0.5
"""Standard deviation of a coordinate [1] above which it counts as not identifiable: its interval
spans a factor of seven."""

NOTHING = 0.1
"""Part of the width of its bounds below which a parameter on a linear scale is next to zero, where
its interval may be wider than itself."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of one parameter, coordinate of a start, or fault of a sensor, in one recording or
    in all: value, 95 % interval, standard deviation over the value.

    One that is not identifiable has neither value nor interval, only `last`, the end of the search.
    `kind` is "parameter", "start", or the fault of the sensor; `start` is the start of the search,
    and `step_bias_sd` the shift of the estimate by the simulation's finite steps, in standard
    deviations.
    """

    name: str
    unit: str
    recording: str | None
    value: float | None
    ci95: tuple[float, float] | None
    relative_sd: Number
    last: float
    identifiable: bool
    at_bound: bool
    step_bias_sd: Number
    kind: str = "parameter"
    start: float | None = None
    prior: Prior | None = None

    @property
    def label(self) -> str:
        """Name, with the recording to which it belongs."""
        return self.name + (f" in {self.recording}" if self.recording else "")

    @property
    def found(self) -> str:
        """Value and interval, or where the search ended."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        if self.value is None or self.ci95 is None:
            return f"not identifiable (the search ended at {self.last:.3g}{unit})"
        low, high = self.ci95
        return f"{self.value:.5g}{unit}, 95 % {low:.5g} to {high:.5g}"


@dataclass(frozen=True)
class ChannelResiduals:
    """Whitened residuals of one channel in one recording, without samples changed by saturation:
    rms, first autocorrelation, and the Ljung-Box p-value of their whiteness."""

    recording: str
    channel: str
    rms: Number
    lag1: Number
    p_white: Number
    stated: Number  # rms over the noise that the sensor states


class Quantity(NamedTuple):
    """An estimated quantity: its value, its value at the start, and the derivative `slope` by the
    coordinates (n,) of its logarithm, or of the value over `size`. `places` are the coordinates on
    which it depends."""

    name: str
    kind: str
    recording: str | None
    unit: str
    value: float
    start: float
    size: float | None
    slope: Array
    places: list[int]
    prior: Prior | None

    def identifiable(self, sd: float) -> bool:
        """Whether the data determine it to a standard deviation of the logarithm, or of the value
        over `size`."""
        known = sd < IDENTIFIABLE
        if self.size is None or self.kind != "parameter":
            return known
        return known and sd * self.size < IDENTIFIABLE * max(abs(self.value), NOTHING * self.size)

    def interval(self, sd: float) -> tuple[float, float]:
        """95 % interval for a standard deviation of the logarithm, or of the value over `size`."""
        reach = float(stats.norm.ppf(0.975)) * sd
        if self.size is not None:
            return self.value - reach * self.size, self.value + reach * self.size
        reach = min(reach, 700.0)  # a parameter without any trace in the data would overflow
        return self.value * float(np.exp(-reach)), self.value * float(np.exp(reach))


def quantities(fit: Fit) -> Iterator[Quantity]:
    """Fitted parameters in physical units, then coordinates of starts and faults of sensors."""
    x, c = fit.x, fit.problem.coordinates
    for k, recording in enumerate(fit.problem.recordings):
        for one in parameter_quantities(fit, k):
            if k == 0 or one.recording == recording.name:
                yield one
    for i, one in enumerate(c.all):
        if one.kind != "parameter" and fit.free[i]:
            name, unit = replace(one, recording=None).label, nuisance_unit(one, fit.problem)
            slope, size, value = np.eye(len(c))[i], float(one.slope(x[i])), one.to_value(x[i])
            yield Quantity(
                name, one.kind, one.recording, unit, value, one.nominal, size, slope, [i], one.prior
            )


def parameter_quantities(fit: Fit, k: int) -> Iterator[Quantity]:
    """Fitted parameters of recording k."""
    problem, c, recording = fit.problem, fit.problem.coordinates, fit.problem.recordings[k]
    values, before = problem.values(fit.x, k), problem.values(c.start, k)
    for name, row in zip(c.names, c.jacobian(fit.x, recording.name, values)):
        places = [int(i) for i in np.flatnonzero(row) if fit.free[i]]
        if name.startswith(PREFIX) or not places:
            continue
        first, value = c.all[places[0]], values[name]
        alone, size = len(places) == 1 and first.name == name and not first.ratio_to, None
        if first.scale == "linear":
            size = first.high - first.low if alone else abs(value)
        declared = recording.rig.quantity(name)
        own = any(c.all[i].recording is not None for i in places)
        yield Quantity(
            name,
            "parameter",
            recording.name if own else None,
            declared.unit if declared else "",
            value,
            first.nominal if alone else before[name],
            size,
            row / (value if size is None else size),
            places,
            first.prior if alone else None,
        )


def estimates(fit: Fit, C: Array, shift: Array) -> list[Estimate]:
    """All estimates in physical units; covariance C (n, n) and shift by the steps (n,) are those of
    all coordinates."""
    edge, out = fit.free & fit.problem.coordinates.at_bound(fit.x), []
    for one in quantities(fit):
        sd = float(np.sqrt(max(one.slope @ C @ one.slope, 0.0)))
        identifiable = one.identifiable(sd)
        found = Estimate(
            one.name,
            one.unit,
            one.recording,
            one.value if identifiable else None,
            one.interval(sd) if identifiable else None,
            sd if one.size is None else sd * one.size / max(abs(one.value), 1e-300),
            one.value,
            identifiable,
            bool(edge[one.places].any()),
            float(one.slope @ shift) / sd if sd > 0 else 0.0,
            one.kind,
            one.start,
            one.prior,
        )
        out.append(found)
    return out


def nuisance_unit(one: Coordinate, problem: Problem) -> str:
    """Unit of a coordinate of a start, or of a fault of a sensor."""
    if one.kind == "start":
        axis = one.name.split(".")[2]
        return ("rad" if axis.endswith("theta") else "m") + ("/s" if axis.startswith("v_") else "")
    return FAULTS[one.kind].unit.format(problem.unit(one.name))


def nrmse(problem: Problem, r: Array, which: list[str]) -> dict[str, dict[str, float]]:
    """RMS residual over the measured range, by recording and channel, without samples changed by
    saturation."""
    out: dict[str, dict[str, float]] = {name: {} for name in which}
    measured = {recording.name: recording.samples for recording in problem.recordings}
    for part in parts(problem.with_noise({}), r, which):
        y = measured[part.recording][part.channel][1]
        rms = float(np.sqrt(np.mean(part.raw**2))) * problem.sensors[part.channel].sd
        out[part.recording][part.channel] = rms / max(float(np.ptp(y)), 1e-300)
    return out


def residual_channels(fit: Fit) -> list[ChannelResiduals]:
    """Residuals of every channel of the fitted recordings."""
    out = []
    for part in parts(fit.problem, fit.at.r, fit.which):
        r, order = fit.at.r[part.rows], 0 if part.noise is None else part.noise.order
        rms, stated = (float(np.sqrt(np.mean(rows**2))) for rows in (r, part.raw))
        white = whiteness(r, order)
        out.append(ChannelResiduals(part.recording, part.channel, rms, *white, stated))
    return out
