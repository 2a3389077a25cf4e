"""Recordings of the rig that a rig file describes.

Columns are the rig's own channels and signals, by the names that a run of the file writes. A signal
without a column is the file's own motion, counted from the same zero of time. What a recording at
rest begins with is held against where the file has bodies and motions start.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from torchsoft.channels import UNITS
from torchsoft.physics.motion import Piecewise, Reference, Sampled
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import State
from torchsoft.physics.statics import net_loads
from torchsoft.rigs.build import RigFile
from torchsoft.solve.touch import Touch
from torchsoft.solve.trajectory import channels, measurable, units
from torchsoft.sysid.columns import Tables, Vocabulary
from torchsoft.sysid.configuration import Beginning, Moving
from torchsoft.sysid.first_samples import estimate_initial_state
from torchsoft.sysid.initial_state import BOUNDS, PREFIX, Standing, Start
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.setpoints import channel as channel_of
from torchsoft.sysid.unknowns import Sensor, by_channel

FARTHEST = 10.0
"""How many times as far from the origin as anything of the rig a place may be."""

LARGEST = {"rad": 100.0, "m/s": 10.0, "rad/s": 1e3, "N": 1e4, "N.m": 1e3}
"""Largest plausible values of other columns, by unit."""

APART = {"m": 1e-3, "rad": 0.05}
"""How far [m, rad] the first sample of a coordinate may be from the file's start, besides what its
sensor does: a body may roll into a dent while it settles."""

ASIDE = {"m": 3e-4, "rad": 0.05}
"""How far [m, rad] the first set-point may be from the file's: a body that is pushed must not press
already."""

BEGINNING, CREEP = 10e-3, 20e-3
"""For so long [s] nothing may move faster than this [m/s] besides what the file does: a body put
down on a pad still settles."""

WAY_OUT = 'or say start = {kind = "moving"} for a recording that begins in motion or in mid-grasp'

SLACK = 0.05
"""Time [s] by which a recording may begin after the file's own motions, or end after them."""


def vocabulary(rig: Rig, headings: Mapping[str, str]) -> Vocabulary:
    """Columns that recordings of a rig may have. Raises `ValueError` for a heading that stands for
    something else."""
    known, signals, touch = units(rig), rig.signals, Touch(rig)
    known |= {name: touch.unit(name) for name in touch}
    names = (*signals, *(f"{name}_dot" for name in signals), *measurable(rig), *touch)
    columns = {"t": "s"} | {name: known[name] for name in names if known[name] in UNITS}
    return Vocabulary(columns, signals).renamed(headings)


def followed(tables: Tables, rig: Rig) -> Reference:
    """The signals that tables have, with the rates of their columns, if there are any; the others
    are those of the rig."""
    columns, signals = tables.columns, {}
    for name in tables.known.signals:
        if name in columns:
            rate = columns.get(f"{name}_dot")
            times, values = (torch.tensor(column) for column in columns[name])
            signals[name] = Sampled(times, values, None if rate is None else torch.tensor(rate[1]))
        else:
            signals[name] = rig.reference[name]
    return Reference(**signals)


def measured_samples(
    tables: Tables, sensors: Mapping[str, Sensor]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Times [s] and values of every measured channel, without gaps. Raises `ValueError` for a
    sensor with fewer than two samples, and where no sensor has any."""
    samples = {}
    for channel in (c for c in tables.known.measured if c in tables):
        t, y = tables.columns[channel]
        here = np.isfinite(y)
        if here.sum() >= 2:
            samples[channel] = (t[here], y[here])
        elif channel in sensors:
            raise ValueError(
                f"{tables.of(channel).path}, column `{channel}` has {here.sum()} samples, but "
                "needs at least two"
            )
    if not set(samples) & set(sensors):
        files = ", ".join(str(table.path) for table in tables.tables)
        raise ValueError(f"{files} has no column for any of the sensors {', '.join(sensors)}")
    return samples


def recorded(
    name: str, rig: Rig, tables: Tables, sensors: Mapping[str, Sensor], start: Beginning,
    at_rest: Start,
) -> Recording:  # fmt: skip
    """The recording that tables hold, begun at rest, or in motion, which its first samples tell."""
    made = Recording(name, rig, measured_samples(tables, sensors), at_rest)
    if not isinstance(start, Moving):
        return made
    given = {coordinate: (one.mean, one.sd) for coordinate, one in start.given.items()}
    used = {channel: sensors[channel] for channel in sensors if channel in made.samples}
    return estimate_initial_state(made, used, lead=start.lead, given=given)


def rig_recording(
    file: RigFile, tables: Tables, name: str, sensors: Mapping[str, Sensor], start: Beginning
) -> Recording:
    """The recording that tables hold, of the rig of a file. Raises `ValueError` naming row and
    column, or the file's field."""
    rig, y0, _ = file.build()
    sensors, own = by_channel([rig], sensors), rig.reference
    check_clock(file, rig, tables, start)
    check_plausible(rig, rig.unpack(y0), tables)
    rig.reference = followed(tables, rig)
    if isinstance(start, Moving):
        return recorded(name, rig, tables, sensors, start, Standing.of(rig, y0))
    at_rest = Standing.of(rig, y0, start.lead, file.rests(), start.position_sd)
    made = recorded(name, rig, tables, sensors, start, at_rest)
    check_start(made, y0, own, tables, sensors)
    return made


def check_plausible(rig: Rig, state: State, tables: Tables) -> None:
    """Raises `ValueError` naming row and column for values that no such rig can have."""
    reach = [float(pad.positions.norm(dim=-1).max()) for pad in rig.pads.values()]
    reach += [float(pose[:2].norm()) for pose in state.pose.values()]
    reach += [body.shape.size() for body in rig.bodies.values() if body.shape is not None]
    for name in rig.signals:
        signal = rig.reference[name]
        if tables.known.units.get(name) == "m" and isinstance(signal, Piecewise):
            reach.append(float(signal.values.detach().abs().max()))
    for name, (_, column) in tables.columns.items():
        unit, table = tables.known.units[name], tables.of(name)
        most = LARGEST.get(unit, FARTHEST * max(reach))
        for i in np.flatnonzero(np.abs(column) > most)[:1].tolist():
            raise ValueError(
                f"{table.at(i)}, column `{name}`: {column[i]:.4g} {unit} is not plausible, it "
                f"should be between {-most:.3g} and {most:.3g} {unit}"
                + (f", {FARTHEST:g} times as far as the rig reaches" if unit == "m" else "")
                + "; is the unit in the heading right?"
            )


def check_clock(file: RigFile, rig: Rig, tables: Tables, start: Beginning) -> None:
    """Raises `ValueError` naming row and column for times outside the file's own motions, where a
    signal has no column, and for a recording at rest that begins after their start."""
    own = [signal for signal in rig.signals if signal not in tables]
    end = file.outputs.duration
    for table in tables.tables if own else ():
        t = table.values["t"]
        if t[-1] > end + SLACK:
            raise ValueError(
                f"{table.at(-1)}, column `t`: {t[-1]:g} s is after the end of the file's own "
                f"motions, {end:g} s, which `{own[0]}` follows; count times from their start, give "
                "a column of it, or say in the settings how long they last, outputs.duration"
            )
        if not isinstance(start, Moving) and t[0] > SLACK:
            raise ValueError(
                f"{table.at(0)}, column `t`: a recording that begins at rest begins with the "
                f"file's own motions, at 0 s, not at {t[0]:g} s; count times from there, or say "
                'start = {kind = "moving"}'
            )


def check_start(
    made: Recording, y0: Tensor, own: Reference, tables: Tables, sensors: Mapping[str, Sensor]
) -> None:
    """Raises `ValueError` naming row and column for a recording that does not begin at rest, with
    coordinates and set-points where the rig file says; `own` are the file's motions."""
    rig, start, first = made.rig, made.start, tables.begin
    assert isinstance(start, Standing)
    with torch.no_grad():
        signals = rig.follow(first)
        here = channels(rig, rig.unpack(y0, signals), signals)
        asked = own(torch.tensor(first, dtype=torch.float64), rig.signals)[:, 0]
    places = {name: [float(value)] for name, value in here.items() if name in made.samples}
    places |= {name: [float(value)] for name, value in zip(rig.signals, asked)}
    for coordinate, setpoint in (pair for one in rig.actuators.values() for pair in one.follows):
        places[setpoint].append(float(here[channel_of(rig, coordinate)]))
    unsure = {
        channel_of(rig, one.name.removeprefix(PREFIX)): BOUNDS * one.sd
        for one in made.start_coordinates
    }
    unsure |= dict.fromkeys(rig.signals, max(unsure.values(), default=0.0))
    speed, rush = pace(made, rig.unpack(y0, signals), own, first)
    smallest = min(body.shape.size() for body in rig.bodies.values() if body.shape is not None)
    for name, (t, column) in tables.columns.items():
        unit, rows = tables.known.units[name], np.flatnonzero(np.isfinite(column))
        late = name in made.samples and made.samples[name][0][0] > first + BEGINNING
        if not len(rows) or late or not unit.startswith(("m", "rad")):
            continue
        t, y, table, sensor = t[rows], column[rows], tables.of(name), sensors.get(name)
        noise, bias = (8 * sensor.sd, sensor.bias) if sensor else (0.0, 0.0)
        near = (ASIDE if name in rig.signals else APART).get(unit, np.inf)
        near += noise + bias + unsure.get(name, 0.0)
        for place in places.get(name, ())[:1]:
            if min(abs(y[0] - one) for one in places[name]) > near:
                opposite = abs(y[0] + place) <= near
                raise ValueError(
                    f"{table.at(int(rows[0]))}, column `{name}`: it begins at {y[0]:.5g} {unit}, "
                    f"but the rig file at {place:.5g} {unit}; "
                    + ("is its sign opposite?" if opposite else f"say so there, {WAY_OUT}")
                )
        early = (t <= first + BEGINNING) | (np.arange(len(t)) < 2)
        fastest = (speed + rush * (t - first + start.lead)) / (smallest if "rad" in unit else 1.0)
        moving = np.abs(y - y[0]) > fastest * (t - t[0]) + noise
        if unit.endswith("/s"):
            moving = np.abs(y) > fastest + noise + bias
        for i in np.flatnonzero(early & moving)[:1].tolist():
            raise ValueError(
                f"{table.at(int(rows[i]))}, column `{name}` moves already: a recording must begin "
                f"at rest, its bodies where the rig file has them start, {WAY_OUT}"
            )


def pace(made: Recording, state: State, own: Reference, first: float) -> tuple[float, float]:
    """How fast [m/s] anything may move at the first sample by the rig file, with its start in
    `state` and its motions; and how much faster a body that nothing holds gets from the start on
    [m/s2]."""
    rig, lead = made.rig, made.start.lead
    around = torch.linspace(first - lead, first + BEGINNING, 51, dtype=torch.float64)
    with torch.no_grad():
        rates = [own(around, (name,))[..., 1].abs().max().item() for name in rig.signals
                 if made.units[name] in ("m", "rad")]  # fmt: skip
        loads = net_loads(rig, state, rig.follow(first))
        held = {contact.body for name, contact in rig.contacts.items()
                if rig.penetration(name, state).max() > 0}  # fmt: skip
    held |= {one.pushes.split(".")[0] for one in rig.actuators.values()}
    speeds = [rate.abs().max().item() for rate in state.velocity.values()]
    rushes = [(loads[name][:2].norm() / body.mass).item() for name, body in rig.bodies.items()
              if lead == 0 or name not in held]  # fmt: skip
    return CREEP + 2 * max(rates, default=0.0) + max(speeds, default=0.0), max(rushes, default=0.0)
