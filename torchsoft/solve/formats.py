"""Files of runs: NetCDF and HDF5 with units, MCAP logs, and VTK series of the pads."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as xml

import numpy as np
import torch
import xarray as xr
from numpy.typing import ArrayLike
from torch import Tensor

from torchsoft.extras import needed
from torchsoft.files import check_file, check_seal, replacing, seal
from torchsoft.physics.mesh import Array, StoredMesh
from torchsoft.physics.pads import von_mises
from torchsoft.physics.parts import COORDINATES, coordinate_unit
from torchsoft.physics.setup import Setup
from torchsoft.physics.state import Layout, State, StateBlock
from torchsoft.solve.progress import Stats
from torchsoft.solve.trajectory import Trajectory
from torchsoft.tables import line

# A run as an xarray Dataset, and back: everything that a `Trajectory` holds but its graph, under
# the names that it has there.


MESH = {
    "nodes": (("axis",), "m", "places of the nodes of the mesh of the pad {}, in its own frame"),
    "elements": (("corner",), "1", "nodes of the elements of the pad {}, anticlockwise"),
    "bonded": ((), "1", "1 for nodes of the pad {} that are bonded to its base"),
    "face": ((), "1", "nodes along the free face of the pad {}"),
}
"""Arrays of a mesh: dimensions after its own, unit and meaning."""

PARTS = ("channels", "energy", "dissipated", "supplied")

STATES = {
    "pads": ("nodal_force_{}", ("{}_branch", "{}_node", "axis"),
             "nodal forces of the pad {} that have set in, by retardation time"),
    "stretch": ("stretch_{}", ("{}_point",), "stretch of the momentary springs of the contact {}"),
    "friction": ("friction_state_{}", ("{}_state", "{}_point"),
                 "states of the law of friction of the contact {}"),
    "rates": ("velocity_{}", ("{}_node", "axis"), "velocities of the nodes of the pad {}"),
    "control": ("control_{}", ("{}_control",), "states of the law of the actuator {}"),
}  # fmt: skip
"""Arrays of states by the field of `State`: name, dimensions after time, and meaning. The state of
a nodal pad is in its `displacement` and `relaxing`, that of bodies in `pose` and `velocity`."""

ABOUT = ("stats", "setup", "wrt", "parts", "touch", "states")
"""What is said about the arrays, in JSON."""

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
        "touch": list(run.touch_sensitivities), "states": [*run.layout.blocks.values()],
        "parts": {part: list(getattr(run, part)) for part in PARTS},
        **run.made_by,
    }  # fmt: skip
    return xr.Dataset(data, coords, {name: json.dumps(value) for name, value in about.items()})


def add_results(run: Trajectory, add: Add) -> None:
    """Results of the run."""
    time, named = ("time",), run.setup.meanings
    for name, value in run.channels.items():
        meaning = f"rate of {name[:-4]}" if name.endswith("_dot") else f"signal {name}"
        add(name, time, value, run.units.get(name, ""), named.get(name, meaning))
    for key, force in run.force.items():
        points = ("time", f"{key}_point")
        for i, kind in enumerate(("normal", "friction")):
            meaning = f"{kind} force on the pad at the contact {key}"
            add(f"{kind}_force_{key}", points, force[..., i], "N", meaning)
        meaning = "0 separated, 1 sticking, 2 slipping; -1 not known"
        add(f"contact_state_{key}", points, run.contact_state[key], "1", meaning)
    for key, u in run.displacement.items():
        nodes = (f"{key}_node", "axis")
        meaning = f"displacements of the nodes of the pad {key}, in its base's frame"
        add(f"displacement_{key}", ("time", *nodes), u, "m", meaning)
        if run.setup.pads[key].nodal and run.state.pads[key].shape[-1] > 2:
            meaning = f"displacements of the relaxing branches of the pad {key}"
            v = run.state.pads[key][..., 2:].unflatten(-1, (-1, 2)).movedim(-2, 1)
            add(f"relaxing_{key}", ("time", f"{key}_branch", *nodes), v, "m", meaning)
    for block in own_arrays(run.layout, run.setup):
        name, dims, meaning = STATES[block.field]
        value, unit = getattr(run.state, block.field)[block.name], ", ".join(block.units)
        own = [one.format(block.name) for one in (*dims, meaning)]
        add(name.format(block.name), ("time", *own[:-1]), value, unit, own[-1])
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


def own_arrays(layout: Layout, setup: Setup) -> Iterator[StateBlock]:
    """States that have an array of their own."""
    for block in layout.blocks.values():
        if block.field in STATES and not (block.field == "pads" and setup.pads[block.name].nodal):
            yield block


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


class NoWholeRun(ValueError):
    """A file or dataset that is not all of a run; the message says what is wrong."""


def from_xarray(data: xr.Dataset, source: str = "the dataset") -> Trajectory:
    """The run of `to_xarray`. Raises `NoWholeRun` naming an array that is missing, not of finite
    numbers, or of other dimensions or another unit than that of a run."""
    about: dict[str, Any] = {}
    for name, value in data.attrs.items():
        try:
            about[str(name)] = json.loads(value)
        except (TypeError, ValueError):
            about[str(name)] = value

    def refused(what: str) -> NoWholeRun:
        return NoWholeRun(
            f"{source} is no whole run: {what}; simulate it again, or read its arrays with "
            "torchsoft.solve.formats.load"
        )

    def of(name: str) -> Tensor:
        if name not in data:
            raise refused(f"it has no `{name}`")
        values = np.array(data[name].values)
        if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
            raise refused(f"`{name}` must be finite numbers")
        return torch.from_numpy(values)

    if lacking := [name for name in ABOUT if name not in about]:
        raise refused(f"it has no `{lacking[0]}`")
    made_by = line(about.get("torchsoft", "nobody"), 40)
    try:
        run = _assembled(data, about, of)
        whole = to_xarray(run)
    except NoWholeRun:
        raise
    except Exception as error:  # whatever parts that do not fit together raise
        raise refused(
            f"its parts do not fit together ({line(repr(error), 160)}), since it was changed, or "
            f"written by a version with another form, torchsoft {made_by}"
        ) from error
    if not bool((run.t.diff() > 0).all()):
        raise refused("`time` must increase strictly")
    for name, one in whole.variables.items():
        if (found := data[name]).dims != one.dims:
            raise refused(f"`{name}` must be over {one.dims}, not {found.dims}")
        units = {one.attrs.get("units")}
        if name in run.channels:
            units = _channel_units(run, str(name))
        if (unit := found.attrs.get("units")) not in units:
            listed = " or ".join(f"`{one}`" for one in sorted(map(str, units)))
            raise refused(f"the unit of `{name}` must be {listed}, not {line(repr(unit), 40)}")
    return run


def _channel_units(run: Trajectory, name: str) -> set[str | None]:
    """Units that a channel may have: its own, where the setup tells it, or that of any."""
    known: dict[str, str] = {one.channel: one.unit for one in run.setup.actuators.values()}
    for body in run.setup.bodies.values():
        known |= {channel: coordinate_unit(axis) for axis, channel in body.channels.items()}
    plain = ("m", "rad", "N", "N.m")
    return {known[name]} if name in known else {*plain, *(f"{x}/s" for x in plain), "kg.m2/s"}


def _assembled(data: xr.Dataset, about: dict[str, Any], of: Callable[[str], Tensor]) -> Trajectory:
    """The run of arrays and of what is said about them."""

    def by(prefix: str, names: list[str]) -> dict[str, Tensor]:
        return {name: of(f"{prefix}_{name}") for name in names}

    stats, plain, wrt, parts, touch, states = (about.pop(name) for name in ABOUT)
    words = isinstance(wrt, list) and isinstance(touch, list) and {*map(type, wrt + touch)} <= {str}
    if not words or not all(isinstance(x, int | float) for x in stats.values()):
        raise TypeError("stats, wrt or touch")
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
    displacement = by("displacement", list(setup.pads))
    free = {
        name: [i for i, axis in enumerate(COORDINATES) if body.freedom[axis] == "free"]
        for name, body in setup.bodies.items()
    }
    layout = Layout(free, (StateBlock.again(*block) for block in states))
    fields: dict[str, dict[str, Tensor]] = {field: {} for field in State._fields}
    for block in own_arrays(layout, setup):
        fields[block.field][block.name] = of(STATES[block.field][0].format(block.name))
    for name, pad in setup.pads.items():
        if pad.nodal:
            relaxing = f"relaxing_{name}"
            more = [of(relaxing).movedim(1, -2).flatten(-2)] if relaxing in data else []
            fields["pads"][name] = torch.cat((displacement[name], *more), -1)
    state = State(**fields | {"pose": pose, "velocity": velocity})
    layout.check(y := layout.pack(state))
    energy = by("energy", parts["energy"])
    return Trajectory(
        t=of("time"), y=y, state=state,
        channels={name: of(name) for name in parts["channels"]},
        force={
            name: torch.stack([of(f"{kind}_force_{name}") for kind in ("normal", "friction")], -1)
            for name in contacts
        },
        loads=loads, displacement=displacement,
        energy=energy, stored_energy=sum(energy.values(), torch.zeros_like(of("time"))),
        step_choice=about.get("steps", {}), dissipated=by("dissipated", parts["dissipated"]),
        supplied=by("supplied", parts["supplied"]),
        injected=of("injected"), stats=Stats(**stats), knots=of("knots"), layout=layout,
        made_by=about, wrt=tuple(wrt),
        sensitivities=of("sensitivities") if "sensitivities" in data else None,
        touch_sensitivities=by("sensitivities", touch),
        units={name: data[name].attrs.get("units", "") for name in parts["channels"]},
        setup=setup, contact_state=by("contact_state", contacts),
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


def read(path: str | Path) -> Trajectory:
    """The run of a file that `Trajectory.save` wrote. Raises `ValueError` and `OSError`."""
    return from_xarray(load(path), str(path))


# Runs as MCAP logs: one message of JSON a sample, whose schema says unit and meaning of every
# channel.


TOPIC = "/torchsoft"

LARGEST = 2e9
"""Size [B] of a log at the most."""

NANO = 1_000_000_000


def write_log(path: Path, data: xr.Dataset, about: Mapping[str, str]) -> None:
    """Write the variables over time of a run, with `about` as metadata. Raises `ValueError` for a
    number that is not finite."""
    writing = needed("mcap.writer", "export")
    series = {str(name): one for name, one in data.data_vars.items() if one.dims == ("time",)}
    fields = {"t": {"type": "number", "unit": "s", "description": "time since the start"}}
    for name, one in series.items():
        unit, meaning = one.attrs.get("units", "1"), one.attrs.get("long_name", "")
        fields[name] = {"type": "number", "unit": unit, "description": meaning}
    if bad := [name for name, one in series.items() if not np.isfinite(one.values).all()]:
        raise ValueError(f"`{bad[0]}` is not finite, and a log in JSON has finite numbers only")
    times = data["time"].values.tolist()
    columns = [times, *(one.values.tolist() for one in series.values())]
    with replacing(path) as partial, partial.open("wb") as file:
        writer = writing.Writer(file, enable_data_crcs=True)
        writer.start(library="torchsoft")
        schema = {"type": "object", "title": "torchsoft.Sample", "properties": fields}
        known = writer.register_schema(
            "torchsoft.Sample", "jsonschema", json.dumps(schema).encode()
        )
        channel = writer.register_channel(TOPIC, "json", known)
        writer.add_metadata("torchsoft", dict(about))
        for row in zip(*columns, strict=True):
            at = round(row[0] * NANO)
            message = json.dumps(dict(zip(fields, row)), allow_nan=False)
            writer.add_message(channel, log_time=at, publish_time=at, data=message.encode())
        writer.finish()


def read_log(path: Path) -> xr.Dataset:
    """The variables over time of a log that `write_log` wrote, or one like it. Raises `ValueError`
    for anything else, and `OSError`."""
    reading = needed("mcap.reader", "export")
    rows, fields = list[dict[str, float]](), dict[str, dict[str, str]]()
    try:
        with check_file(path, LARGEST).open("rb") as file:
            reader = reading.NonSeekingReader(file, validate_crcs=True)  # which reads all of it
            for schema, channel, message in reader.iter_messages(topics=[TOPIC]):
                if channel.message_encoding != "json" or schema is None:
                    raise ValueError(f"{TOPIC} is in {channel.message_encoding}, not in json")
                fields = fields or json.loads(schema.data)["properties"]
                rows.append(json.loads(message.data))
        if not rows:
            raise ValueError(f"it has no messages on {TOPIC}")
        columns = {name: np.array([row[name] for row in rows], float) for name in fields}
        times = columns.pop("t")
    except OSError:
        raise
    except Exception as error:  # whatever a damaged file makes a library raise
        raise ValueError(
            f"{path} is not a log of torchsoft: {line(error) or 'it was cut short'}"
        ) from None
    found = {
        name: ("time", one, {"units": fields[name].get("unit")}) for name, one in columns.items()
    }
    return xr.Dataset(found, coords={"time": times})


# Pads of a run as VTK files: deformed by `displacement`, with strain and stress of their
# elements, for ParaView, and for meshio, which reads them back.


def tensors(xx: Array, yy: Array, zz: Array, xy: Array) -> Array:
    """Symmetric tensors (..., 9) of plane components."""
    zero = np.zeros_like(xx)
    return np.stack((xx, xy, zero, xy, yy, zero, zero, zero, zz), -1)


def write(run: Trajectory, path: Path, times: Sequence[float] | None = None) -> list[Path]:
    """Write `path`, a .pvd that lists a .vtu for each of the samples nearest to `times` [s] (all by
    default); the files written. All pads are in one file, at their places of rest in the world [m]
    with their base as it is then, and told apart by the number `pad`.

    Points have `displacement` [m] from there; elements `strain`, `stress` [Pa], the elastic part,
    and `von_mises` [Pa]. Raises `ValueError` for another suffix.
    """
    import meshio  # takes half a second, and few need it

    if path.suffix != ".pvd":
        raise ValueError(f"`path` must end in .pvd, but is {path}")
    rows = range(len(run.t)) if times is None else sorted({run.at(time) for time in times})
    pads = run.setup.pads
    cells, first = [], 0
    for pad in pads.values():
        cells.append(("quad", pad.mesh.elements + first))
        first += len(pad.mesh.nodes)
    root = xml.Element("VTKFile", type="Collection", version="0.1")
    listed, written = xml.SubElement(root, "Collection"), []
    for number, row in enumerate(rows):
        points, moved = [], []
        fields: dict[str, list[ArrayLike]] = {
            k: [] for k in ("pad", "strain", "stress", "von_mises")
        }
        for i, (name, pad) in enumerate(pads.items()):
            own = pad.displacement(run.displacement[name][row].detach().numpy())
            x, y, angle = (
                (0.0, 0.0, 0.0) if pad.base is None
                else run.state.pose[pad.base][row].detach().tolist()
            )  # fmt: skip
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            axes = turn @ pad.axes.numpy()
            points.append(pad.placed(pad.mesh.nodes) @ turn.T + [x, y])
            moved.append(own @ axes.T)
            strain = pad.strain(own)
            stress, zero = pad.stress(own), np.zeros(len(strain))
            fields["pad"].append(np.full(len(strain), i))
            for key, own_axes in (
                ("strain", tensors(strain[:, 0], strain[:, 1], zero, strain[:, 2])),
                ("stress", tensors(*stress.T)),
            ):
                world = np.eye(3)
                world[:2, :2] = axes
                turned = world @ own_axes.reshape(-1, 3, 3) @ world.T
                fields[key].append(turned.reshape(-1, 9))
            fields["von_mises"].append(von_mises(stress))
        flat = lambda parts: np.pad(np.concatenate(parts), ((0, 0), (0, 1)))
        mesh = meshio.Mesh(
            flat(points), cells, point_data={"displacement": flat(moved)}, cell_data=fields
        )
        file = path.with_name(f"{path.stem}_{number:05d}.vtu")
        with replacing(file) as partial:
            meshio.write(partial, mesh, file_format="vtu")
        entry = {"timestep": f"{float(run.t[row])!r}", "part": "0", "file": file.name}
        xml.SubElement(listed, "DataSet", entry)
        written.append(file)
    with replacing(path) as partial:
        partial.write_bytes(xml.tostring(root, "utf-8", xml_declaration=True))
    return [path, *written]
