"""A run as an xarray Dataset, and back: everything that a `Trajectory` holds but its graph, under
the names that it has there."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from torchsoft.channels import CHANNELS
from torchsoft.physics.mesh import StoredMesh
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.setup import Setup
from torchsoft.physics.state import Layout, State
from torchsoft.solve.trajectory import Stats, Trajectory, load

MESH = {
    "nodes": (("axis",), "m", "places of the nodes of the mesh of the pad {}, in its own frame"),
    "elements": (("corner",), "1", "nodes of the elements of the pad {}, anticlockwise"),
    "bonded": ((), "1", "1 for nodes of the pad {} that are bonded to its base"),
    "face": ((), "1", "nodes along the free face of the pad {}"),
}
"""Arrays of a mesh: dimensions after its own, unit and meaning."""

PARTS = ("channels", "energy", "dissipated", "supplied")

Column = tuple[tuple[str, ...], Any, str, str]
"""Dimensions, values, unit and meaning."""


def to_xarray(run: Trajectory) -> xr.Dataset:
    """Raises `ValueError` where a channel has the name of another array."""
    columns = [*recorded(run), *built(run.setup)]
    names = [name for name, _ in columns]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(
            f"the channel `{min(twice)}` has the name of another array of the file; give the "
            "body, signal or actuator another name"
        )
    data = {
        name: (
            dims,
            values.detach().numpy() if isinstance(values, Tensor) else values,
            {"units": unit, "long_name": meaning},
        )
        for name, (dims, values, unit, meaning) in columns
    }
    coords = {
        "time": ("time", run.t.detach().numpy(), {"units": "s", "long_name": "time"}),
        "axis": ["x", "y"], "coordinate": list(COORDINATES), "body": list(run.state.pose),
    }  # fmt: skip
    about = {
        "stats": vars(run.stats), "setup": run.setup.plain(), "wrt": list(run.wrt),
        "touch": list(run.touch_sensitivities),
        "parts": {part: list(getattr(run, part)) for part in PARTS},
        **run.made_by,
    }  # fmt: skip
    return xr.Dataset(data, coords, {name: json.dumps(value) for name, value in about.items()})


def recorded(run: Trajectory) -> list[tuple[str, Column]]:
    """Results of the run, by name."""
    time = ("time",)
    out: list[tuple[str, Column]] = []
    for name, value in run.channels.items():
        known = CHANNELS.get(name)
        unit = run.units.get(name, known.unit if known else "")
        meaning = known.meaning if known and known.unit == unit else f"channel {name}"
        out.append((name, (time, value, unit, meaning)))
    for key, force in run.force.items():
        points = ("time", f"{key}_point")
        for i, kind in enumerate(("normal", "friction")):
            meaning = f"{kind} force on the pad at the contact {key}"
            out.append((f"{kind}_force_{key}", (points, force[..., i], "N", meaning)))
        stretch = run.state.stretch[key]
        out.append((f"stretch_{key}", (points, stretch, "m", "stretch of the momentary springs")))
        state = run.contact_state[key]
        meaning = "0 separated, 1 sticking, 2 slipping; -1 not known"
        out.append((f"contact_state_{key}", (points, state, "1", meaning)))
    for key, u in run.displacement.items():
        nodes = (f"{key}_node", "axis")
        meaning = f"displacements of the nodes of the pad {key}, in its base's frame"
        out.append((f"displacement_{key}", (("time", *nodes), u, "m", meaning)))
        if key in run.state.rates:
            meaning = f"velocities of the nodes of the pad {key}"
            values = run.state.rates[key]
            out.append((f"velocity_{key}", (("time", *nodes), values, "m/s", meaning)))
        else:
            meaning = f"nodal forces of the pad {key} that have set in, by retardation time"
            where = ("time", f"{key}_branch", *nodes)
            out.append((f"nodal_force_{key}", (where, run.state.pads[key], "N", meaning)))
    bodies = ("time", "body", "coordinate")
    for name, values, unit, meaning in (
        ("pose", run.state.pose, "m, m, rad", "x, y and theta of the bodies"),
        ("velocity", run.state.velocity, "m/s, m/s, rad/s", "their rates"),
        ("loads", run.loads, "N, N, N.m", "forces and moment of contacts and pads on the bodies"),
    ):
        out.append((name, (bodies, torch.stack(list(values.values()), 1), unit, meaning)))
    out.append(("injected", (time, run.injected, "J", "positive part of the sources' work")))
    residual = run.energy_residual
    out.append(("energy_residual", (time, residual, "J", "stored - supplied + dissipated")))
    for kind in PARTS[1:]:
        for name, value in getattr(run, kind).items():
            out.append((f"{kind}_{name}", (time, value, "J", f"{kind}: {name}")))
    out.append(("knots", (("knot",), run.knots, "s", "where the steps began and ended")))
    if run.sensitivities is not None:
        dims = ("time", "component", "unknown")
        meaning = "derivatives of the state's last components by the unknowns"
        out.append(("sensitivities", (dims, run.sensitivities, "", meaning)))
    for name, value in run.touch_sensitivities.items():
        meaning = f"derivatives of the channel {name} by the unknowns"
        out.append((f"sensitivities_{name}", (("time", "unknown"), value, "", meaning)))
    return out


def built(setup: Setup) -> list[tuple[str, Column]]:
    """Meshes and outlines."""
    out: list[tuple[str, Column]] = []
    for name, pad in setup.pads.items():
        own = {"nodes": "mesh_node", "bonded": "mesh_node", "elements": "element", "face": "face"}
        for part, (more, unit, meaning) in MESH.items():
            values = np.asarray(getattr(pad.mesh, part))
            values = values.astype(np.int8 if values.dtype == bool else values.dtype)
            dims = (f"{name}_{own[part]}", *more)
            out.append((f"mesh_{part}_{name}", (dims, values, unit, meaning.format(name))))
    for name, body in setup.bodies.items():
        if body.outline is not None:
            dims = (f"{name}_outline", "axis")
            meaning = f"outline of {name} about its centre"
            out.append((f"outline_{name}", (dims, body.outline, "m", meaning)))
    return out


def from_xarray(data: xr.Dataset, source: str = "the dataset") -> Trajectory:
    """The run of `to_xarray`. Raises `ValueError` naming what is missing."""
    about = {}
    for name, value in data.attrs.items():
        try:
            about[name] = json.loads(value)
        except (TypeError, ValueError):
            about[name] = value
    if "setup" not in about or "parts" not in about:
        raise ValueError(
            f"{source} is no whole run: it has no `setup`; simulate it again, or read its arrays "
            "with torchsoft.solve.trajectory.load"
        )

    def of(name: str) -> Tensor:
        if name not in data:
            raise ValueError(f"{source} is no whole run: it has no `{name}`")
        return torch.from_numpy(np.array(data[name].values))

    def by(prefix: str, names: list[str]) -> dict[str, Tensor]:
        return {name: of(f"{prefix}_{name}") for name in names}

    stats, plain, wrt, parts, touch = (
        about.pop(name) for name in ("stats", "setup", "wrt", "parts", "touch")
    )
    bodies, contacts = list(plain["bodies"]), list(plain["contacts"])
    setup = Setup.again(
        plain,
        {name: of(f"outline_{name}").numpy() for name in bodies if f"outline_{name}" in data},
        {
            name: StoredMesh(
                **{
                    part: array.astype(bool) if part == "bonded" else array
                    for part in MESH
                    for array in [of(f"mesh_{part}_{name}").numpy()]
                }
            )
            for name in plain["pads"]
        },
    )
    pose, velocity, loads = (
        dict(zip(bodies, of(name).unbind(1))) for name in ("pose", "velocity", "loads")
    )
    inertial = {name: pad.inertial for name, pad in setup.pads.items()}
    displacement = by("displacement", list(inertial))
    pads = {
        name: displacement[name] if own else of(f"nodal_force_{name}")
        for name, own in inertial.items()
    }
    rates = by("velocity", [name for name, own in inertial.items() if own])
    state = State(pads, by("stretch", contacts), pose, rates, velocity)
    layout = Layout(
        {name: tuple(x.shape[1:]) for name, x in pads.items()},
        {name: x.shape[1] for name, x in state.stretch.items()},
        {
            name: [i for i, axis in enumerate(COORDINATES) if body.freedom[axis] == "free"]
            for name, body in setup.bodies.items()
        },
        {name: tuple(x.shape[1:]) for name, x in rates.items()},
    )
    return Trajectory(
        t=of("time"), y=layout.pack(state), state=state,
        channels={name: of(name) for name in parts["channels"]},
        force={
            name: torch.stack([of(f"{kind}_force_{name}") for kind in ("normal", "friction")], -1)
            for name in contacts
        },
        loads=loads, displacement=displacement,
        energy=by("energy", parts["energy"]), dissipated=by("dissipated", parts["dissipated"]),
        supplied=by("supplied", parts["supplied"]),
        injected=of("injected"), stats=Stats(**stats), knots=of("knots"), layout=layout,
        made_by=about, wrt=tuple(wrt),
        sensitivities=of("sensitivities") if "sensitivities" in data else None,
        touch_sensitivities=by("sensitivities", touch),
        units={name: data[name].attrs.get("units", "") for name in parts["channels"]},
        setup=setup, known_contact_state=by("contact_state", contacts),
    )  # fmt: skip


def read(path: str | Path) -> Trajectory:
    """The run of a file that `Trajectory.save` wrote. Raises `ValueError` and `OSError`."""
    return from_xarray(load(path), str(path))
