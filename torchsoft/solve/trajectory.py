"""What a simulation leaves behind: times, states, nodal forces, efforts, energies, and how it was
made."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchsoft.channels import MEASURED, PADS, VARIABLES
from torchsoft.files import replacing, sealed, unsealed
from torchsoft.physics.parts import COORDINATES, coordinate_unit
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import Layout, State
from torchsoft.solve.touch import Touch

if TYPE_CHECKING:  # takes as long to import as all of this package
    import xarray as xr


@dataclass(frozen=True)
class Stats:
    """How the run went: steps, linear solves (Newton iterations), steps that Newton did not solve
    and that were taken shorter, steps refused for their error, and wall time [s]."""

    steps: int
    newton_iterations: int
    failed_steps: int
    refused_steps: int
    wall_s: float

    @property
    def newton_per_step(self) -> float:
        return self.newton_iterations / max(self.steps, 1)


@dataclass(frozen=True)
class Trajectory:
    """A run sampled at t (T,) [s]. SI units, every tensor float64 and shaped (T, ...).

    y: flat states (T, size). channels: what can be measured or was asked for, by key, (T,) each.
    force: normal and friction force (T, points, 2) [N] on the points of each contact, along n and t
    of their moving frames. recorded (T, recorded): all forces, of which `touch` makes its channels,
    `run["skin.normal.7"]`. load: what the contacts and pads do to each body (T, 3), a force [N] and
    a moment about its centre [N.m], world axes. displacement: of the nodes of each pad (T, nodes,
    2) [m], in its base's frame. energy: stored [J]; dissipated, supplied and `injected` [J] since
    t[0].

    units: of the channels, by key, as far as the rig knows them.

    knots (steps + 1,): where the steps began and ended [s]; given to another run, that takes the
    same ones.

    sensitivities (T, components, n): derivatives of the state's last `components` by the n
    parameters `wrt`, and along the further directions of the start, where asked for;
    touch_sensitivities: those of channels of touch (T, n), by key.
    """

    t: Tensor
    y: Tensor
    state: State = field(repr=False)
    channels: dict[str, Tensor] = field(repr=False)
    force: dict[str, Tensor] = field(repr=False)
    load: dict[str, Tensor] = field(repr=False)
    recorded: Tensor = field(repr=False)
    displacement: dict[str, Tensor] = field(repr=False)
    energy: dict[str, Tensor] = field(repr=False)
    dissipated: dict[str, Tensor] = field(repr=False)
    supplied: dict[str, Tensor] = field(repr=False)
    injected: Tensor = field(repr=False)
    stats: Stats
    knots: Tensor = field(repr=False)
    layout: Layout = field(repr=False)
    touch: Touch = field(repr=False)
    made_by: dict[str, Any] = field(repr=False)
    wrt: tuple[str, ...] = ()
    sensitivities: Tensor | None = field(default=None, repr=False)
    touch_sensitivities: dict[str, Tensor] = field(default_factory=dict, repr=False)
    units: dict[str, str] = field(default_factory=dict, repr=False)

    def __getitem__(self, channel: str) -> Tensor:
        """A channel (T,). Raises `KeyError` naming those that are there."""
        if channel in self.channels:
            return self.channels[channel]
        if channel in self.touch:
            return self.touch[channel].value(self.recorded)
        raise KeyError(
            f"the run has no channel `{channel}`; it has {', '.join(self.channels)}, and of touch "
            f"{self.touch.shown}"
        )

    def together(self, *channels: str) -> Tensor:
        """Channels side by side (T, channels)."""
        return torch.stack([self[name] for name in channels], -1)

    @property
    def energy_residual(self) -> Tensor:
        """Stored energy gained, less supplied, plus dissipated (T,) [J]; zero but for the
        integration error."""
        zero = torch.zeros_like(self.t)
        total = sum(self.energy.values(), zero)
        return (
            total
            - total[0]
            - sum(self.supplied.values(), zero)
            + sum(self.dissipated.values(), zero)
        )

    @property
    def energy_residual_rel(self) -> float:
        """Largest energy residual over the energy that the sources injected."""
        scale = self.injected[-1].detach().clamp(min=1e-300)
        return float(self.energy_residual.detach().abs().max() / scale)

    def at(self, time: float) -> int:
        """Index of the sample nearest to `time` [s]."""
        return int((self.t - time).abs().argmin())

    def to_dataset(self) -> xr.Dataset:
        """The run as an xarray Dataset with named dimensions, units, and how it was made."""
        import xarray as xr

        columns: dict[str, tuple[tuple[str, ...], Tensor, str, str]] = {}
        left = dict(self.channels)
        papers = all(
            name in left for name in MEASURED
        )  # another rig may call by these names what is something else
        for name, variable in VARIABLES.items() if papers else ():
            keys = list(variable.symbols)
            if all(key in left for key in keys):
                parts = [left.pop(key) for key in keys]
                dims = ("time", "axis") if len(parts) == 2 else ("time",)
                value = torch.stack(parts, -1) if len(parts) == 2 else parts[0]
                columns[name] = (dims, value, variable.unit, variable.meaning)
        columns |= {
            name: (("time",), value, self.units.get(name, ""), "channel of the rig")
            for name, value in left.items()
        }
        columns["energy_injected"] = (
            ("time",),
            self.injected,
            "J",
            "positive part of the sources' work",
        )
        columns["energy_residual"] = (
            ("time",),
            self.energy_residual,
            "J",
            "stored - supplied + dissipated",
        )
        for key, force in self.force.items():
            name = PADS.get(key, key)
            points = ("time", f"{name}_surface")
            columns[f"normal_force_{name}"] = (
                points,
                force[..., 0],
                "N",
                f"normal force at the contact {name}",
            )
            columns[f"friction_force_{name}"] = (
                points,
                force[..., 1],
                "N",
                f"friction at the contact {name}",
            )
            stretch = self.state.stretch[key]
            columns[f"stretch_{name}"] = (points, stretch, "m", "stretch of the momentary springs")
        for key, u in self.displacement.items():
            name = PADS.get(key, key)
            nodes = ("time", f"{name}_node", "axis")
            columns[f"displacement_{name}"] = (nodes, u, "m", f"displacements of the pad {name}")
            if key in self.state.rates:
                columns[f"velocity_{name}"] = (
                    nodes,
                    self.state.rates[key],
                    "m/s",
                    f"nodal velocities of the pad {name}",
                )
        for kind in ("energy", "dissipated", "supplied"):
            for name, value in getattr(self, kind).items():
                columns[f"{kind}_{name}"] = (("time",), value, "J", f"{kind}: {name}")
        data = {
            name: (dims, value.detach().numpy(), {"units": unit, "long_name": meaning})
            for name, (dims, value, unit, meaning) in columns.items()
        }
        coords = {"time": ("time", self.t.numpy(), {"units": "s"}), "axis": ["x", "y"]}
        attrs = {
            "stats": json.dumps(vars(self.stats)),
            **{k: json.dumps(v) for k, v in self.made_by.items()},
        }
        return xr.Dataset(data, coords, attrs)

    def save(self, path: str | Path) -> None:
        """Write NetCDF with a checksum. The file appears whole or not at all."""
        save(self.to_dataset(), path)


def save(data: xr.Dataset, path: str | Path) -> None:
    """Write a trajectory's dataset, perhaps a changed one, as NetCDF with a checksum at the end of
    the file."""
    with replacing(path) as partial:
        partial.write_bytes(sealed(data.to_netcdf(engine="h5netcdf")))


def load(path: str | Path) -> xr.Dataset:
    """What `save` wrote. Raises `ValueError` for any other file and for one that is damaged, and
    `OSError`."""
    import xarray as xr

    content = BytesIO(unsealed(path))
    try:
        return xr.load_dataset(content, engine="h5netcdf", decode_times=False)
    except Exception as error:  # whatever the libraries make of other content
        raise ValueError(f"{path} is not a NetCDF file ({type(error).__name__})") from error


def channels(
    rig: Rig, state: State, signals: Tensor, moments: dict[str, Tensor] | None = None
) -> dict[str, Tensor]:
    """Every channel of states (...) by its key: coordinates and rates of the bodies, signals,
    efforts, moments.

    A moment is what the bonded nodes give (Eq. 35), with undeformed arms; the graph's, which a
    turning base feels and which conserves power, has deformed ones.
    """
    out: dict[str, Tensor] = {}
    for name in rig.bodies:
        symbol, pose, velocity = rig.symbols[name], state.pose[name], state.velocity[name]
        for i, key in enumerate((f"x_{symbol}", f"y_{symbol}", f"theta_{symbol}")):
            out[key] = pose[..., i]
        for i, key in enumerate((f"v_x_{symbol}", f"v_y_{symbol}", f"omega_{symbol}")):
            out[key] = velocity[..., i]
        if rig.bodies[name].freedom["theta"] == "free":
            out[f"L_{symbol}"] = rig.bodies[name].inertia * velocity[..., 2]
    for i, name in enumerate(rig.signals):
        out[name], out[f"{name}_dot"] = signals[..., i, 0], signals[..., i, 1]
    for name in rig.actuators:
        out[f"F_{name}"] = rig.actuator_effort(name, state, signals)
    out |= {f"M_{name}": moment for name, moment in (moments or {}).items()}
    return {rig.renamed.get(key, key): value for key, value in out.items()}


def units(rig: Rig) -> dict[str, str]:
    """SI unit of every channel, by its key; a signal's follows from what uses it."""
    out: dict[str, str] = {}

    def signal(name: str, unit: str) -> None:
        out[name], out[f"{name}_dot"] = unit, f"{unit}/s"

    for name, symbol in rig.symbols.items():
        for i, axis in enumerate(COORDINATES):
            unit = coordinate_unit(axis)
            key = f"{axis}_{symbol}"
            out[key], out[rate_channel(key)] = unit, f"{unit}/s"
            if rig.bodies[name].freedom[axis] == "driven":
                signal(f"{name}.{axis}", unit)
        out[f"L_{symbol}"] = "kg.m2/s"
    for name, actuator in rig.actuators.items():
        for coordinate, setpoint in actuator.follows:
            signal(setpoint, coordinate_unit(coordinate))
        if actuator.feed_forward is not None:
            signal(actuator.feed_forward, actuator.effort_unit)
        out[f"F_{name}"] = actuator.effort_unit
    out |= {f"M_{name}": "N.m" for name in rig.pads}
    return {rig.renamed.get(key, key): unit for key, unit in out.items()}


def measurable(rig: Rig) -> tuple[str, ...]:
    """Channels that a sensor can measure, whose derivatives follow from the bodies' motion: free
    coordinates, their rates in the same order, and the actuators' efforts."""
    poses, rates = [], []
    for name, axes in rig.layout.free.items():
        for axis in axes:
            poses.append(f"{COORDINATES[axis]}_{rig.symbols[name]}")
            rates.append(rate_channel(poses[-1]))
    keys = (*poses, *rates, *(f"F_{name}" for name in rig.actuators))
    return tuple(rig.renamed.get(key, key) for key in keys)


def rate_channel(key: str) -> str:
    """The key of a coordinate's rate by the coordinate's own, before a rig renames either."""
    return f"omega{key.removeprefix('theta')}" if key.startswith("theta") else f"v_{key}"
