"""What a simulation leaves behind: times, states, nodal forces, controls and the energy ledger."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import xarray as xr
from torch import Tensor

from torchsoft.state import Layout, State


@dataclass(frozen=True)
class Stats:
    """How the run went: steps, linear solves (Newton iterations), steps that failed and were halved, and wall time [s]."""

    steps: int
    newton_iterations: int
    failed_steps: int
    wall_s: float
    step_s: float

    @property
    def newton_per_step(self) -> float:
        return self.newton_iterations / max(self.steps, 1)


@dataclass(frozen=True)
class Trajectory:
    """A run sampled at t (T,) [s]. SI units, every tensor float64 and shaped (T, ...).

    y: flat states (T, size). force_L, force_U: normal and friction force (T, surface, 2) [N] on each surface node, along
    n and t of its moving frame. control: F_x, F_y (T, 2) [N] on the bracket (Eq. 32, 34). bracket_moment (T,) [N.m]
    (Eq. 35). desired: x_d, x_d', y_d, y_d', F_y (T, 5). energy: stored [J] and work: dissipated, supplied and
    `injected` [J] since t[0], by name, (T,) each.
    """

    t: Tensor
    y: Tensor
    force_L: Tensor
    force_U: Tensor
    control: Tensor
    bracket_moment: Tensor
    desired: Tensor
    energy: dict[str, Tensor]
    dissipated: dict[str, Tensor]
    supplied: dict[str, Tensor]
    injected: Tensor
    stats: Stats
    layout: Layout = field(repr=False)
    made_by: dict[str, Any] = field(repr=False)
    inertia: float = field(repr=False)

    @property
    def state(self) -> State:
        """The states by name, time leading."""
        return self.layout.unpack(self.y)

    @property
    def energy_residual(self) -> Tensor:
        """Stored energy gained, less supplied, plus dissipated (T,) [J]; zero but for the integration error."""
        total = sum(self.energy.values(), torch.zeros_like(self.t))
        flows = sum(self.supplied.values(), torch.zeros_like(self.t)) - sum(
            self.dissipated.values(), torch.zeros_like(self.t)
        )
        return total - total[0] - flows

    @property
    def energy_residual_rel(self) -> float:
        """Largest ledger residual over the energy that the sources injected."""
        return float(self.energy_residual.abs().max() / self.injected[-1].clamp(min=1e-300))

    def at(self, time: float) -> int:
        """Index of the sample nearest to `time` [s]."""
        return int((self.t - time).abs().argmin())

    def to_dataset(self) -> xr.Dataset:
        """The run as an xarray Dataset with named dimensions, units, and how it was made."""
        s, t = self.state, ("time",)
        axis, pads = ("time", "axis"), {"L": "lower", "U": "upper"}
        columns: dict[str, tuple[tuple[str, ...], Tensor, str, str]] = {
            "disc_position": (axis, s.r_C, "m", "centre of mass of the disc"),
            "disc_angle": (t, s.theta, "rad", "rotation of the disc, anticlockwise"),
            "disc_velocity": (axis, s.v_C, "m/s", "velocity of the disc's centre"),
            "disc_spin": (t, s.omega, "rad/s", "angular velocity of the disc"),
            "angular_momentum": (t, self.inertia * s.omega, "kg.m2/s", "angular momentum of the disc (Fig. 17)"),
            "bracket_position": (axis, s.r_Br, "m", "centre of mass of the bracket"),
            "bracket_velocity": (axis, s.v_Br, "m/s", "velocity of the bracket"),
            "bracket_moment": (t, self.bracket_moment, "N.m", "moment on the bracket about its centre (Eq. 35)"),
            "control_force": (axis, self.control, "N", "controllers' force on the bracket (Eq. 32, 34)"),
            "desired_x": (t, self.desired[:, 0], "m", "x_d (Eq. 20)"),
            "desired_x_velocity": (t, self.desired[:, 1], "m/s", "x_d' (Eq. 21)"),
            "desired_y": (t, self.desired[:, 2], "m", "y_Br,d (Eq. 30)"),
            "feed_forward": (t, self.desired[:, 4], "N", "vertical effort fed forward"),
            "energy_injected": (t, self.injected, "J", "positive part of the sources' work"),
            "energy_residual": (t, self.energy_residual, "J", "stored - supplied + dissipated"),
        }
        for k, name in pads.items():
            force, u, nodes = getattr(self, f"force_{k}"), getattr(s, f"u_{k}"), ("time", f"{name}_surface")
            columns[f"normal_force_{name}"] = (nodes, force[..., 0], "N", f"normal force on the {name} pad's nodes")
            columns[f"friction_force_{name}"] = (nodes, force[..., 1], "N", f"friction on the {name} pad's nodes")
            columns[f"stretch_{name}"] = (nodes, getattr(s, f"s_{k}"), "m", "stretch of the momentary springs")
            columns[f"displacement_{name}"] = (
                ("time", f"{name}_node", "axis"),
                u,
                "m",
                f"{name} pad's displacements",
            )
            if getattr(s, f"v_{k}").numel():
                nodes3 = ("time", f"{name}_node", "axis")
                columns[f"velocity_{name}"] = (nodes3, getattr(s, f"v_{k}"), "m/s", f"{name} pad's nodal velocities")
        for kind in ("energy", "dissipated", "supplied"):
            for name, value in getattr(self, kind).items():
                columns[f"{kind}_{name}"] = (t, value, "J", f"{kind}: {name}")
        data = {
            name: (dims, value.detach().numpy(), {"units": unit, "long_name": meaning})
            for name, (dims, value, unit, meaning) in columns.items()
        }
        coords = {"time": ("time", self.t.numpy(), {"units": "s"}), "axis": ["x", "y"]}
        attrs = {"stats": json.dumps(vars(self.stats)), **{k: json.dumps(v) for k, v in self.made_by.items()}}
        return xr.Dataset(data, coords, attrs)

    def save(self, path: str | Path) -> None:
        """Write NetCDF. The file appears whole or not at all."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".partial")
        self.to_dataset().to_netcdf(partial, engine="h5netcdf")
        partial.replace(path)
