"""The result of an identification: estimates with intervals, what is identifiable, and the quality of the fit."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from torchsoft.channels import unit
from torchsoft.files import finite, replacing
from torchsoft.parameters import Parameters
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.start import PREFIX
from torchsoft.sysid.unknowns import Coordinate

CONFIDENCE = 0.95

IDENTIFIABLE = 0.5
"""Standard deviation of a coordinate [1] above which it counts as not identifiable: its interval spans a factor of seven."""

LAGS = 20
"""Autocorrelations that the test of whiteness looks at."""


@dataclass(frozen=True)
class Estimate:
    """One parameter (or a sensor's bias or delay) in one recording or in all: value, 95 % interval, standard deviation over
    the value. A parameter that is not identifiable has neither, but `last`, where the search happened to end."""

    name: str
    unit: str
    recording: str | None
    value: float | None
    ci95: tuple[float, float] | None
    relative_sd: float
    last: float
    identifiable: bool
    at_bound: bool
    step_bias_sd: float  # what the finite steps of the simulation shift the estimate by, in standard deviations

    @property
    def label(self) -> str:
        """Its name, with the recording it belongs to."""
        return self.name + (f" in {self.recording}" if self.recording else "")


@dataclass(frozen=True)
class Direction:
    """An eigenvector of the Fisher matrix in the coordinates: its standard deviation and its largest components by label."""

    sd: float
    identifiable: bool
    components: dict[str, float]


@dataclass(frozen=True)
class ChannelResiduals:
    """Residuals of one channel in one recording, over the noise: their rms, the first autocorrelation, and the Ljung-Box
    p-value of their whiteness."""

    recording: str
    channel: str
    rms: float
    lag1: float
    p_white: float


@dataclass(frozen=True)
class IdentificationResult:
    """The result of `identify`: estimates, correlations, directions, residuals, predictions, and how it was made."""

    estimates: list[Estimate]
    labels: list[str]
    x: list[float]
    correlation: list[list[float]]
    directions: list[Direction]
    chi2: float  # sum of squared residuals over degrees of freedom; 1 where model and noise are right
    converged: bool
    residuals: list[ChannelResiduals]
    heldout: dict[str, dict[str, float]]  # NRMSE of recordings that were not fitted, by recording and channel
    notices: list[str]
    stages: list[dict[str, Any]]
    cost: dict[str, float]
    made_by: dict[str, Any]
    covariance: list[list[float]] = field(repr=False)

    def __getitem__(self, name: str) -> Estimate:
        """The first estimate of that name."""
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise KeyError(f"no estimate of `{name}`; there are {', '.join(e.name for e in self.estimates)}")

    def to_json(self) -> str:
        """JSON in which `identifiable` is called `seen`, its name since the first version of the file."""
        content = finite(asdict(self))
        for entry in (*content["estimates"], *content["directions"]):
            entry["seen"] = entry.pop("identifiable")
        return json.dumps(content, indent=1, allow_nan=False)

    def save(self, path: str | Path) -> None:
        """Write the JSON file. It appears whole or not at all."""
        with replacing(path) as partial:
            partial.write_text(self.to_json(), encoding="utf-8")

    def table(self) -> str:
        """One line an estimate."""
        rows = [f"{'parameter':34s} {'estimate':>12s}   95 % interval"]
        for e in self.estimates:
            if e.value is None or e.ci95 is None:
                rows.append(
                    f"{e.label:34s} {'none':>12s}   not identifiable (the search ended at {e.last:.3g} {e.unit})"
                )
            else:
                rows.append(f"{e.label:34s} {e.value:12.5g}   {e.ci95[0]:.5g} .. {e.ci95[1]:.5g} {e.unit}")
        return "\n".join(rows)


def autocorrelation(r: Array) -> Array:
    """Of residuals r (m,) at lags 1, 2, ..., at most `LAGS` and a quarter of the samples."""
    c = r - r.mean()
    lags, power = min(LAGS, len(r) // 4), float(c @ c)
    return np.array([c[k:] @ c[:-k] / power for k in range(1, lags + 1)]) if power > 0 else np.zeros(lags)


def whiteness(r: Array) -> tuple[float, float]:
    """First autocorrelation and Ljung-Box p-value of one channel's residuals (m,)."""
    rho, m = autocorrelation(r), len(r)
    if not rho.any():
        return 0.0, 1.0
    Q = m * (m + 2) * float((rho**2 / (m - np.arange(1, len(rho) + 1))).sum())
    return float(rho[0]), float(stats.chi2.sf(Q, len(rho)))


def split(problem: Problem, r: Array, which: list[str]) -> dict[tuple[str, str], Array]:
    """Residuals (m,) by recording and channel, in the order of `Problem.residuals`."""
    out, at = {}, 0
    for recording in problem.recordings:
        for channel in problem.sensors if recording.name in which else ():
            if channel in recording.samples:
                n = len(recording.samples[channel][0])
                out[recording.name, channel] = r[at : at + n]
                at += n
    return out


def nrmse(problem: Problem, r: Array, which: list[str]) -> dict[str, dict[str, float]]:
    """RMS residual over the range of what was measured, by recording and channel."""
    out: dict[str, dict[str, float]] = {name: {} for name in which}
    measured = {recording.name: recording.samples for recording in problem.recordings}
    for (name, channel), part in split(problem, r, which).items():
        y = measured[name][channel][1]
        rms = float(np.sqrt(np.mean(part**2))) * problem.sensors[channel].noise
        out[name][channel] = rms / max(float(np.ptp(y)), 1e-300)
    return out


def estimates(problem: Problem, x: Array, free: NDArray[np.bool_], C: Array, shift: Array) -> list[Estimate]:
    """Parameters in physical units, then biases and delays; C (n, n) and shift (n,) are of all coordinates."""
    c, q = problem.coordinates, float(stats.norm.ppf(0.5 + CONFIDENCE / 2))
    units = {name: row["unit"] for name, row in Parameters().table().items()}
    low, high = c.bounds
    edge = free & ((x - low < 1e-4 * (high - low)) | (high - x < 1e-4 * (high - low)))
    out = []

    def add(
        name: str, unit: str, recording: str | None, value: float, sd: float, relative_sd: float,
        interval: tuple[float, float], at_bound: Any, bias: float,
    ) -> None:  # fmt: skip
        known = (value, interval) if (identifiable := sd < IDENTIFIABLE) else (None, None)
        out.append(Estimate(name, unit, recording, *known, relative_sd, value, identifiable, bool(at_bound), bias))

    for k, recording in enumerate(problem.recordings):
        values = problem.values(x, k)
        chain = c.jacobian(x, recording.name, values)
        for row, name in enumerate(name for name in c.names if not name.startswith(PREFIX)):
            mine = [i for i in np.flatnonzero(chain[row]) if free[i]]
            own = any(c.all[i].recording is not None for i in mine)
            if not mine or (k > 0 and not own):
                continue
            slope, value = chain[row] / values[name], values[name]
            sd = float(np.sqrt(max(slope @ C @ slope, 0.0)))
            bias = float(slope @ shift) / sd if sd > 0 else 0.0
            if c.all[mine[0]].scale == "log":
                reach = min(q * sd, 700.0)  # a parameter without any trace in the data would overflow
                interval = (value * float(np.exp(-reach)), value * float(np.exp(reach)))
            else:
                interval = (value - q * sd * abs(value), value + q * sd * abs(value))
            where = recording.name if own else None
            add(name, units.get(name, ""), where, value, sd, sd, interval, edge[mine].any(), bias)
    for i, one in enumerate(c.all):
        if one.kind != "parameter" and free[i]:
            spread = float(np.sqrt(C[i, i]))
            value, sd = one.to_value(x[i]), spread * float(one.slope(x[i]))
            interval, relative = (value - q * sd, value + q * sd), sd / max(abs(value), 1e-300)
            name = one._replace(recording=None).label
            add(name, nuisance_unit(one), one.recording, value, spread, relative, interval, edge[i], float(shift[i]) / spread)
    return out


def nuisance_unit(one: Coordinate) -> str:
    """Unit of a start's coordinate, or of what is wrong with a sensor."""
    if one.kind == "start":
        axis = one.name.split(".")[2]
        return "rad/s" if axis == "v_theta" else "m/s" if axis.startswith("v_") else "rad" if axis == "theta" else "m"
    own = unit(one.name)
    units = {"bias": own, "drift": f"{own}/s", "delay": "s", "gain": "1", "misalignment": "rad", "inertia": "kg"}
    return units[one.kind]


def directions(labels: list[str], values: Array, vectors: Array) -> list[Direction]:
    """Eigenvectors of the Fisher matrix, the best determined first."""
    out = []
    for k in np.argsort(values)[::-1]:
        sd = float(1.0 / np.sqrt(max(values[k], 1e-12)))
        order = np.argsort(-np.abs(vectors[:, k]))
        parts = {labels[i]: float(vectors[i, k]) for i in order if abs(vectors[i, k]) > 0.2}
        out.append(Direction(sd, sd < IDENTIFIABLE, parts))
    return out


def residual_channels(problem: Problem, residuals: Residuals, which: list[str]) -> list[ChannelResiduals]:
    return [
        ChannelResiduals(name, channel, float(np.sqrt(np.mean(r**2))), *whiteness(r))
        for (name, channel), r in split(problem, residuals.r, which).items()
    ]
