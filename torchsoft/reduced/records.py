"""Records: time series of a reduced model's variables, from trajectories and datasets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from torchsoft.display import Shown, amount, suggestion
from torchsoft.reduced.ode import UNITS
from torchsoft.solve.trajectory import Trajectory

STATES = ("x_C", "theta", "x_Br", "v_C", "omega", "v_Br")
KINEMATICS = {"x_C": "v_C", "theta": "omega", "x_Br": "v_Br"}
VARIABLES = (*STATES, "F_x", "x_d", "x_d_dot")
"""Series of a record."""

CHANNELS = {
    "theta": ("theta_C",), "v_C": ("v_x_C", "v_x"), "omega": ("omega_C",), "v_Br": ("v_x_Br",),
    "F_x": ("effort_x",),
}  # fmt: skip
"""Other names of series in a dataset of rigs/paper.toml, of this version or an older one."""

EVEN = 1e-6
"""Largest difference between equal steps, over their size."""

ALIKE = 1e-9
"""Largest difference [m] between starts that count as equal."""


@dataclass(frozen=True, repr=False)
class Record(Shown):
    """One motion: equally spaced times t (T,) [s] and series (T,) by variable in SI units,
    positions relative to their start; `mass` [kg] of the bracket, on which F_x acts, where it is
    known."""

    t: np.ndarray
    series: dict[str, np.ndarray]
    mass: float | None = None

    def __post_init__(self) -> None:
        """Raises `ValueError` for times that are not equally spaced, and for series of another
        length."""
        steps = np.diff(self.t)
        if len(steps) < 2 or not np.isfinite(steps).all() or not steps.min() > 0:
            raise ValueError("`t` must hold at least three equally spaced times that rise")
        usual = float(np.median(steps))
        if not np.allclose(steps, usual, rtol=EVEN, atol=0):
            i = int(np.argmax(np.abs(steps - usual)))
            raise ValueError(
                f"the times of a record are not equally spaced: after t = {self.t[i]:g} s a step "
                f"is {1e3 * steps[i]:.4g} ms, and others are {1e3 * usual:.4g} ms; make a record "
                "of each part without a gap, or interpolate to equal steps"
            )
        for name, x in self.series.items():
            if x.shape != self.t.shape:
                raise ValueError(f"series {name!r} has shape {x.shape}, but `t` {self.t.shape}")

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        title = (
            f"Record: {self.t[0]:g} to {self.t[-1]:g} s, {len(self.t)} samples, one every "
            f"{1e3 * self.step:.4g} ms"
        )
        return title, [
            (name, f"{x.min():.4g} to {amount(float(x.max()), UNITS.get(name, name))}")
            for name, x in self.series.items()
        ]

    @property
    def step(self) -> float:
        return float(self.t[1] - self.t[0])

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Series side by side (T, names). Raises `ValueError` for a missing one."""
        lacking = [name for name in names if name not in self.series]
        if lacking:
            raise ValueError(
                f"the record has no series {', '.join(lacking)}; it has {', '.join(self.series)}"
            )
        return np.column_stack([self.series[name] for name in names])


def record(
    source: Trajectory | Mapping[Any, Any], t: Any = None, *, begin: float | None = None,
    disc: str = "disc", bracket: str = "bracket", measured: str | None = None,
) -> Record:  # fmt: skip
    """A record of a run of any rig, or of series by name, or by the channels of `CHANNELS` (an
    `xarray.Dataset` of one trajectory or an item of `torchsoft.datasets.Trajectories`) at times t
    [s].

    disc, bracket: names of the two bodies in the run. F_x is the sum of efforts on the bracket's x,
    x_d the set-point of the loop that pushes it, if there is only one and it measures an x.

    Samples before `begin` [s] are left out, and positions and angle counted from the first one
    kept; x_d from where the coordinate starts that its loop measures. A run knows this coordinate;
    of series, `measured` names it, "x_C" or "x_Br", where these start at different places. The
    record lacks series that the source lacks. Raises `ValueError` for times that are not equally
    spaced, for a value that is not finite, naming the series, for a body that is not in the run,
    for a set-point of an unknown coordinate, and for a source without any of the series.
    """
    mass = None
    if isinstance(source, Trajectory):
        given = source.made_by.get("parameters", {})
        mass = given.get(f"bodies.{bracket}.mass", given.get(f"{bracket}.mass"))
        t = source.t.detach() if t is None else t
        source, own = _of_run(source, disc, bracket)
        measured = measured or own
    times = np.asarray(source["time"] if t is None else t, dtype=float)
    keep = times >= (times[0] if begin is None else begin)
    if not keep.any():
        raise ValueError(f"`begin` = {begin:g} s is after the last sample, at {times[-1]:g} s")
    series = {}
    for name in VARIABLES:
        channel = next((c for c in (name, *CHANNELS.get(name, ())) if c in source), None)
        if channel is None:
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
        known = ", ".join(VARIABLES)
        raise ValueError(
            f"`source` has none of {known}; take a run, or give series by these names, as in "
            '{"x_C": data["x_disc"], ...}'
        )
    origin = {name: float(series[name][0]) for name in ("x_C", "theta", "x_Br") if name in series}
    if "x_d" in series:
        origin["x_d"] = _start(source, keep, origin, measured)
    counted = {name: x - origin.get(name, 0.0) for name, x in series.items()}
    return Record(times[keep], counted, mass)


def _start(
    source: Mapping[Any, Any], keep: np.ndarray, origin: Mapping[str, float], measured: str | None
) -> float:
    """Start [m] of the coordinate that the loop of x_d measures."""
    if measured is not None:
        if measured not in source:
            raise ValueError(f"`measured` = {measured!r} is not in `source`; give its series too")
        return float(np.asarray(source[measured], dtype=float)[keep][0])
    starts = {name: origin[name] for name in ("x_C", "x_Br") if name in origin}
    if not starts or max(starts.values()) - min(starts.values()) > ALIKE:
        where = " and ".join(f"{name} at {x:.9g} m" for name, x in starts.items())
        raise ValueError(
            f"x_d is counted from where the coordinate starts that its loop measures, but "
            f"{where or 'neither x_C nor x_Br'} may be it; give `measured`, as in "
            'measured="x_Br", or leave x_d out'
        )
    return next(iter(starts.values()))


def _of_run(run: Trajectory, disc: str, bracket: str) -> tuple[dict[str, np.ndarray], str | None]:
    """Series of a run, and the name of the coordinate that the loop of
    x_d measures."""
    setup, state = run.setup, run.state
    for field, name in (("disc", disc), ("bracket", bracket)):
        if name not in setup.bodies:
            raise ValueError(
                f"`{field}` = {name!r} is no body of the run; "
                f"{suggestion(name, setup.bodies, 'its bodies are')}: give the name of the body "
                + ("that rolls" if field == "disc" else "that carries the other pad")
                + f" (--{field})"
            )
    out = {
        "x_C": state.pose[disc][:, 0],
        "theta": state.pose[disc][:, 2],
        "x_Br": state.pose[bracket][:, 0],
        "v_C": state.velocity[disc][:, 0],
        "omega": state.velocity[disc][:, 2],
        "v_Br": state.velocity[bracket][:, 0],
    }
    pushing = [one for one in setup.actuators.values() if one.pushes == f"{bracket}.x"]
    if pushing:
        out["F_x"] = torch.stack([run[one.channel] for one in pushing]).sum(0)
    loops = [loop for one in pushing for loop in one.follows.items()]
    measured = None
    if len(loops) == 1 and loops[0][0].endswith(".x"):
        coordinate, signal = loops[0]
        body = coordinate.removesuffix(".x")
        measured = {disc: "x_C", bracket: "x_Br"}.get(body, coordinate)
        out |= {measured: state.pose[body][:, 0]}
        out |= {"x_d": run[signal], "x_d_dot": run[f"{signal}_dot"]}
    return {name: x.detach().numpy() for name, x in out.items()}, measured


def rolling_radius(records: Sequence[Record]) -> float:
    """Rolling radius r [m] in v_Br = -2 r omega, by least squares over records of slow rolling."""
    v, omega = (np.concatenate([one.series[name] for one in records]) for name in ("v_Br", "omega"))
    return float(-0.5 * (v @ omega) / (omega @ omega))
