"""A run as an xarray Dataset and as a NetCDF file, and back: everything that a `Trajectory` holds
but its graph.

`arrays` lists the arrays of a run, each once: writing and reading follow it.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from torchsoft.files import check_seal, replacing, seal
from torchsoft.physics.mesh import StoredMesh
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.setup import Setup
from torchsoft.physics.state import Layout, State, StateBlock
from torchsoft.solve.progress import Stats
from torchsoft.solve.trajectory import Trajectory
from torchsoft.tables import line

ABOUT = ("stats", "setup", "outlined", "states", "units", "energies", "wrt", "forward", "touch")
"""What is said about the arrays, in JSON: the statistics of the steps, the setup and which bodies
have an outline, the blocks of the state, the units of the channels, names of the energies by kind,
parameters with sensitivities, whether there are any, and channels of touch with some."""

MESH = {
    "nodes": ("{}_mesh_node axis", "m", "places of the nodes of the pad {}, in its own frame"),
    "elements": ("{}_element corner", "1", "nodes of the elements of the pad {}, anticlockwise"),
    "bonded": ("{}_mesh_node", "1", "1 for nodes of the pad {} that are bonded to its base"),
    "face": ("{}_face", "1", "nodes along the free face of the pad {}"),
}  # fmt: skip
"""Arrays of a mesh: dimensions, unit and meaning."""

STATES = {
    "pads": ("nodal_force_{}", "{}_branch {}_node axis",
             "nodal forces of the pad {} that have set in, by retardation time"),
    "stretch": ("stretch_{}", "{}_point", "stretch of the momentary springs of the contact {}"),
    "friction": ("friction_state_{}", "{}_state {}_point",
                 "states of the law of friction of the contact {}"),
    "rates": ("velocity_{}", "{}_node axis", "velocities of the nodes of the pad {}"),
    "control": ("control_{}", "{}_control", "states of the law of the actuator {}"),
}  # fmt: skip
"""Arrays of states by the field of `State`: name, dimensions after time, and meaning. The state of
a nodal pad is in its `displacement` and `relaxing`, that of bodies in `pose` and `velocity`."""

BODIES = {
    "pose": ("m, m, rad", "x, y and theta of the bodies"),
    "velocity": ("m/s, m/s, rad/s", "their rates"),
    "loads": ("N, N, N.m", "forces and moment of contacts and pads on the bodies"),
}
"""Arrays over the bodies: unit and meaning."""


class Stored(NamedTuple):
    """An array of a file: the field of the run and the key there that it holds, its name in the
    file, its dimensions in one text, its unit and its meaning."""

    field: str
    key: str
    name: str
    dims: str
    unit: str
    meaning: str


def arrays(about: Mapping[str, Any]) -> Iterator[Stored]:
    """The arrays of a run, of what is said about it."""
    setup, blocks = about["setup"], [StateBlock.again(*block) for block in about["states"]]
    for key, unit in about["units"].items():
        yield Stored("channels", key, key, "time", unit, setup["meanings"][key])
    for key in setup["contacts"]:
        points = f"time {key}_point"
        for kind in ("normal", "friction"):
            meaning = f"{kind} force on the pad at the contact {key}"
            field = f"{kind}_force"
            yield Stored(field, key, f"{field}_{key}", points, "N", meaning)
        meaning = "0 separated, 1 sticking, 2 slipping"
        yield Stored("contact_state", key, f"contact_state_{key}", points, "1", meaning)
    for key in setup["pads"]:
        meaning = f"displacements of the nodes of the pad {key}, in its base's frame"
        name, dims = f"displacement_{key}", f"time {key}_node axis"
        yield Stored("displacement", key, name, dims, "m", meaning)
        for part, (dims, unit, meaning) in MESH.items():
            rest = dims.format(key, key), unit, meaning.format(key)
            yield Stored(part, key, f"mesh_{part}_{key}", *rest)
    for key in about["outlined"]:
        meaning = f"outline of {key} about its centre"
        yield Stored("outline", key, f"outline_{key}", f"{key}_outline axis", "m", meaning)
    for block in blocks:
        key = block.name
        if block.field == "pads" and block.units == ("m",):
            if block.shape[-1] > 2:
                meaning = f"displacements of the relaxing branches of the pad {key}"
                dims = f"time {key}_branch {key}_node axis"
                yield Stored("relaxing", key, f"relaxing_{key}", dims, "m", meaning)
        elif block.field in STATES:
            name, dims, meaning = (text.format(key, key) for text in STATES[block.field])
            unit = ", ".join(block.units)
            yield Stored(block.field, key, name, f"time {dims}", unit, meaning)
    for field, (unit, meaning) in BODIES.items():
        yield Stored(field, "", field, "time body coordinate", unit, meaning)
    for kind, names in about["energies"].items():
        for key in names:
            yield Stored(kind, key, f"{kind}_{key}", "time", "J", f"{kind}: {key}")
    yield Stored("injected", "", "injected", "time", "J", "positive part of the sources' work")
    meaning = "stored - supplied + dissipated"
    yield Stored("energy_residual", "", "energy_residual", "time", "J", meaning)
    yield Stored("knots", "", "knots", "knot", "s", "where the steps began and ended")
    if about["forward"]:
        dims, meaning = "time component unknown", "derivatives of the state's last components"
        yield Stored("sensitivities", "", "sensitivities", dims, "", f"{meaning} by the unknowns")
    for key in about["touch"]:
        meaning = f"derivatives of the channel {key} by the unknowns"
        name = f"sensitivities_{key}"
        yield Stored("touch_sensitivities", key, name, "time unknown", "", meaning)


def value(run: Trajectory, field: str, key: str) -> Any:
    """The values of a stored array in a run."""
    if field.endswith("_force"):
        return run.force[key][..., ("normal_force", "friction_force").index(field)]
    if field in MESH:
        values = np.asarray(getattr(run.setup.pads[key].mesh, field))
        return values.astype(np.int8) if values.dtype == bool else values
    if field == "outline":
        return run.setup.bodies[key].outline
    if field == "relaxing":
        return run.state.pads[key][..., 2:].unflatten(-1, (-1, 2)).movedim(-2, 1)
    whole = getattr(run.state if field in State._fields else run, field)
    if field in BODIES:
        return torch.stack(list(whole.values()), 1)
    return whole[key] if key else whole


def to_xarray(run: Trajectory) -> xr.Dataset:
    """Raises `ValueError` where a channel has the name of another array."""
    kinds = ("energy", "dissipated", "supplied")
    about = {
        "stats": vars(run.stats), "setup": run.setup.plain(),
        "outlined": [k for k, one in run.setup.bodies.items() if one.outline is not None],
        "states": [*run.layout.blocks.values()], "units": {k: run.units.get(k, "") for k in run},
        "energies": {kind: list(getattr(run, kind)) for kind in kinds}, "wrt": list(run.wrt),
        "forward": run.sensitivities is not None, "touch": list(run.touch_sensitivities),
        **run.made_by,
    }  # fmt: skip
    data = {}
    for one in arrays(about):
        if one.name in data:
            raise ValueError(
                f"the channel `{one.name}` has the name of another array of the file; give the "
                "body, signal or actuator another name"
            )
        values = value(run, one.field, one.key)
        values = values.detach().numpy() if isinstance(values, Tensor) else values
        attributes = {"units": one.unit, "long_name": one.meaning}
        data[one.name] = one.dims.split(), values, attributes
    coords = {
        "time": ("time", run.t.detach().numpy(), {"units": "s", "long_name": "time"}),
        "axis": ["x", "y"], "coordinate": list(COORDINATES), "body": list(run.state.pose),
    }  # fmt: skip
    return xr.Dataset(data, coords, {name: json.dumps(part) for name, part in about.items()})


class NoWholeRun(ValueError):
    """A file or dataset that is not all of a run; the message says what is wrong."""


def from_xarray(data: xr.Dataset, source: str = "the dataset") -> Trajectory:
    """The run of `to_xarray`. Raises `NoWholeRun` naming an array that is missing, not of finite
    numbers, or of other dimensions or another unit than that of a run."""
    about: dict[str, Any] = {}
    for name, text in data.attrs.items():
        try:
            about[str(name)] = json.loads(text)
        except (TypeError, ValueError):
            about[str(name)] = text
    try:
        if lacking := [name for name in ABOUT if name not in about]:
            raise NoWholeRun(f"it has no `{lacking[0]}`")
        found = {(one.field, one.key): checked(data, one) for one in arrays(about)}
        time = Stored("t", "", "time", "time", "s", "")
        if not bool(((t := checked(data, time)).diff() > 0).all()):
            raise NoWholeRun("`time` must increase strictly")
        return assembled(t, about, found)
    except NoWholeRun as error:
        wrong = str(error)
    except Exception as error:  # whatever parts that do not fit together raise
        wrong = (
            f"its parts do not fit together ({line(repr(error), 160)}), since it was changed, or "
            "written by a version with another form, torchsoft "
            f"{line(about.get('torchsoft', 'nobody'), 40)}"
        )
    raise NoWholeRun(
        f"{source} is no whole run: {wrong}; simulate it again, or read its arrays with "
        "torchsoft.solve.netcdf.load"
    )


def checked(data: xr.Dataset, one: Stored) -> Tensor:
    """A stored array. Raises `NoWholeRun` for one that is not as it is written."""
    if one.name not in data:
        raise NoWholeRun(f"it has no `{one.name}`")
    values, dims = np.array(data[one.name].values), tuple(one.dims.split())
    if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise NoWholeRun(f"`{one.name}` must be finite numbers")
    if (given := data[one.name].dims) != dims:
        raise NoWholeRun(f"`{one.name}` must be over {dims}, not {given}")
    if (unit := data[one.name].attrs.get("units")) != one.unit:
        raise NoWholeRun(
            f"the unit of `{one.name}` must be `{one.unit}`, not {line(repr(unit), 40)}"
        )
    return torch.from_numpy(values)


def assembled(
    t: Tensor, about: dict[str, Any], found: Mapping[tuple[str, str], Tensor]
) -> Trajectory:
    """The run of times and arrays, and of what is said about them."""
    of = lambda field: {key: x for (part, key), x in found.items() if part == field}
    stats, plain, _, states, units, _, wrt, _, _ = (about.pop(name) for name in ABOUT)
    if not all(isinstance(x, int | float) for x in stats.values()):
        raise TypeError("stats")
    meshes = {
        name: StoredMesh(**{part: found[part, name].numpy() for part in MESH if part != "bonded"},
                         bonded=found["bonded", name].numpy().astype(bool))
        for name in plain["pads"]
    }  # fmt: skip
    outlines = {name: outline.numpy() for name, outline in of("outline").items()}
    setup = Setup.again(plain, outlines, meshes)
    by_body = {kind: dict(zip(setup.bodies, found[kind, ""].unbind(1))) for kind in BODIES}
    free = {
        name: [i for i, axis in enumerate(COORDINATES) if body.freedom[axis] == "free"]
        for name, body in setup.bodies.items()
    }
    layout = Layout(free, (StateBlock.again(*block) for block in states))
    displacement, fields = of("displacement"), {field: of(field) for field in State._fields}
    for name, pad in setup.pads.items():
        if pad.nodal:
            parts = [displacement[name]]
            if ("relaxing", name) in found:
                parts.append(found["relaxing", name].movedim(1, -2).flatten(-2))
            fields["pads"][name] = torch.cat(parts, -1)
    loads = by_body.pop("loads")
    state = State(**fields | by_body)
    layout.check(y := layout.pack(state))
    energy = of("energy")
    return Trajectory(
        t=t, y=y, state=state, channels=of("channels"), units=units, loads=loads,
        force={k: torch.stack((x, found["friction_force", k]), -1)
               for k, x in of("normal_force").items()},
        displacement=displacement, contact_state=of("contact_state"), energy=energy,
        stored_energy=sum(energy.values(), torch.zeros_like(t)), dissipated=of("dissipated"),
        supplied=of("supplied"), injected=found["injected", ""], stats=Stats(**stats),
        knots=found["knots", ""], layout=layout, made_by=about, step_choice=about["steps"],
        wrt=tuple(wrt), sensitivities=found.get(("sensitivities", "")),
        touch_sensitivities=of("touch_sensitivities"), setup=setup,
    )  # fmt: skip


def save(data: xr.Dataset, path: str | Path) -> None:
    """Write a trajectory's dataset, perhaps a changed one, as NetCDF with a checksum at the end of
    the file."""
    with replacing(path) as partial:
        partial.write_bytes(data.to_netcdf(engine="h5netcdf"))
        seal(partial)


def load(path: str | Path) -> xr.Dataset:
    """The run in a file of `save`. Raises `ValueError` for any other file and for one that is
    damaged, and `OSError`."""
    with check_seal(path).open("rb") as file:
        try:
            return xr.load_dataset(file, engine="h5netcdf", decode_times=False)
        except Exception as error:  # whatever the libraries make of other content
            raise ValueError(f"{path} is not a NetCDF file ({type(error).__name__})") from error
