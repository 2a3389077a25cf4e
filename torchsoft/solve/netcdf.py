"""A run as an xarray Dataset, and back: everything that a `Trajectory` holds but its graph, under
the names that it has there."""

import json
from collections.abc import Callable, Sequence
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

Add = Callable[[str, Sequence[str], Any, str, str], None]
"""Adds an array: name, dimensions, values, unit and meaning."""


def to_xarray(run: Trajectory) -> xr.Dataset:
    """Raises `ValueError` where a channel has the name of another array."""
    data = {}

    def add(name: str, dims: Sequence[str], values: Any, unit: str, meaning: str) -> None:
        if name in data:
            raise ValueError(
                f"the channel `{name}` has the name of another array of the file; give the "
                "body, signal or actuator another name"
            )
        values = values.detach().numpy() if isinstance(values, Tensor) else values
        data[name] = dims, values, {"units": unit, "long_name": meaning}

    add_results(run, add)
    add_setup(run.setup, add)
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


def add_results(run: Trajectory, add: Add) -> None:
    """Results of the run."""
    time = ("time",)
    for name, value in run.channels.items():
        known = CHANNELS.get(name)
        unit = run.units.get(name, known.unit if known else "")
        meaning = known.meaning if known and known.unit == unit else f"channel {name}"
        add(name, time, value, unit, meaning)
    for key, force in run.force.items():
        points = ("time", f"{key}_point")
        for i, kind in enumerate(("normal", "friction")):
            meaning = f"{kind} force on the pad at the contact {key}"
            add(f"{kind}_force_{key}", points, force[..., i], "N", meaning)
        meaning = "stretch of the momentary springs"
        add(f"stretch_{key}", points, run.state.stretch[key], "m", meaning)
        meaning = "0 separated, 1 sticking, 2 slipping; -1 not known"
        add(f"contact_state_{key}", points, run.contact_state[key], "1", meaning)
    for key, u in run.displacement.items():
        nodes = (f"{key}_node", "axis")
        meaning = f"displacements of the nodes of the pad {key}, in its base's frame"
        add(f"displacement_{key}", ("time", *nodes), u, "m", meaning)
        if key in run.state.rates:
            meaning = f"velocities of the nodes of the pad {key}"
            add(f"velocity_{key}", ("time", *nodes), run.state.rates[key], "m/s", meaning)
        else:
            meaning = f"nodal forces of the pad {key} that have set in, by retardation time"
            where = ("time", f"{key}_branch", *nodes)
            add(f"nodal_force_{key}", where, run.state.pads[key], "N", meaning)
    bodies = ("time", "body", "coordinate")
    for name, values, unit, meaning in (
        ("pose", run.state.pose, "m, m, rad", "x, y and theta of the bodies"),
        ("velocity", run.state.velocity, "m/s, m/s, rad/s", "their rates"),
        ("loads", run.loads, "N, N, N.m", "forces and moment of contacts and pads on the bodies"),
    ):
        add(name, bodies, torch.stack(list(values.values()), 1), unit, meaning)
    add("injected", time, run.injected, "J", "positive part of the sources' work")
    add("energy_residual", time, run.energy_residual, "J", "stored - supplied + dissipated")
    for kind in PARTS[1:]:
        for name, value in getattr(run, kind).items():
            add(f"{kind}_{name}", time, value, "J", f"{kind}: {name}")
    add("knots", ("knot",), run.knots, "s", "where the steps began and ended")
    if run.sensitivities is not None:
        meaning = "derivatives of the state's last components by the unknowns"
        add("sensitivities", ("time", "component", "unknown"), run.sensitivities, "", meaning)
    for name, value in run.touch_sensitivities.items():
        meaning = f"derivatives of the channel {name} by the unknowns"
        add(f"sensitivities_{name}", ("time", "unknown"), value, "", meaning)


def add_setup(setup: Setup, add: Add) -> None:
    """Meshes and outlines."""
    for name, pad in setup.pads.items():
        own = {"nodes": "mesh_node", "bonded": "mesh_node", "elements": "element", "face": "face"}
        for part, (more, unit, meaning) in MESH.items():
            values = np.asarray(getattr(pad.mesh, part))
            values = values.astype(np.int8 if values.dtype == bool else values.dtype)
            dims = (f"{name}_{own[part]}", *more)
            add(f"mesh_{part}_{name}", dims, values, unit, meaning.format(name))
    for name, body in setup.bodies.items():
        if body.outline is not None:
            dims = (f"{name}_outline", "axis")
            meaning = f"outline of {name} about its centre"
            add(f"outline_{name}", dims, body.outline, "m", meaning)


def from_xarray(data: xr.Dataset, source: str = "the dataset") -> Trajectory:
    """The run of `to_xarray`. Raises `ValueError` naming a missing array."""
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
