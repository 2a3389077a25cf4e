"""Records: the variables of a reduced model over time, from trajectories and datasets, with or
without noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchsoft.channels import MEASURED
from torchsoft.reduced.ode import ALIASES
from torchsoft.solve.trajectory import Trajectory

STATES = ("x_C", "theta", "x_Br", "v_C", "omega", "v_Br")
KINEMATICS = {"x_C": "v_C", "theta": "omega", "x_Br": "v_Br"}
VARIABLES = (*STATES, "F_x", "x_d", "x_d_dot")
"""What a record may hold."""


@dataclass(frozen=True)
class Record:
    """One motion: times t (T,) [s], equally spaced, and series (T,) by variable, SI units,
    positions from their start."""

    t: np.ndarray
    series: dict[str, np.ndarray]

    @property
    def step(self) -> float:
        return float(self.t[1] - self.t[0])

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Series side by side (T, names). Raises `ValueError` for one that the record does not
        have."""
        lacking = [name for name in names if name not in self.series]
        if lacking:
            raise ValueError(
                f"the record has no series {', '.join(lacking)}; it has {', '.join(self.series)}"
            )
        return np.column_stack([self.series[name] for name in names])

    def part(self, begin: int, end: int) -> "Record":
        """Samples `begin` to `end`, positions as they are."""
        return Record(self.t[begin:end], {name: x[begin:end] for name, x in self.series.items()})


def record(
    source: Trajectory | Mapping[Any, Any], t: Any = None, *, begin: float | None = None
) -> Record:
    """A record of a `Trajectory`, or of series by their names in a dataset (an `xarray.Dataset` of
    one trajectory or an item of `torchsoft.datasets.Trajectories`) at times t [s].

    Samples before `begin` [s] are left out, and positions and angle counted from the first one
    kept; x_d from the disc's. What the source lacks the record lacks. Raises `ValueError` for times
    that are not equally spaced, for a value that is not finite, naming the series, and for a source
    without any of them, such as the run of a rig that is not the paper's.
    """
    if isinstance(source, Trajectory):
        t = source.t if t is None else t
        # another rig may call by these names what is something else
        source = source.channels if all(name in source for name in MEASURED) else {}
    times = np.asarray(source["time"] if t is None else t, dtype=float)
    keep = times >= (times[0] if begin is None else begin)
    if keep.sum() < 3 or not np.allclose(np.diff(times), times[1] - times[0], rtol=1e-6, atol=0):
        raise ValueError("`t` must hold at least three equally spaced times")
    series = {}
    channels = {name: ALIASES.get(name, name) for name in VARIABLES}
    for name, channel in channels.items():
        if channel not in source:
            continue
        x = np.asarray(source[channel], dtype=float)[keep]
        if not np.isfinite(x).all():
            first = times[keep][~np.isfinite(x)][0]
            raise ValueError(
                f"series {name!r} ({channel}) has values that are not finite, first at t "
                f"= {first:g} s"
            )
        series[name] = x
    if not series:
        known = ", ".join(dict.fromkeys(channels.values()))
        raise ValueError(
            f"`source` has none of {known}; take a run of `SoftGrasp`, or give series by these "
            "names"
        )
    origin = {name: float(series[name][0]) for name in ("x_C", "theta", "x_Br") if name in series}
    if "x_d" in series and "x_C" in origin:
        origin["x_d"] = origin["x_C"]
    return Record(times[keep], {name: x - origin.get(name, 0.0) for name, x in series.items()})


def noisy(source: Record, level: float, seed: int) -> Record:
    """The record with white noise on every measured series, `level` times its standard deviation;
    x_d is not measured."""
    rng, clean = np.random.default_rng(seed), ("x_d", "x_d_dot")
    return Record(
        source.t,
        {
            k: x if k in clean else x + level * x.std() * rng.standard_normal(x.shape)
            for k, x in source.series.items()
        },
    )


def rolling_radius(records: Sequence[Record]) -> float:
    """r [m] of v_Br = -2 r omega, by least squares over records of slow rolling."""
    v, omega = (np.concatenate([one.series[name] for one in records]) for name in ("v_Br", "omega"))
    return float(-0.5 * (v @ omega) / (omega @ omega))
