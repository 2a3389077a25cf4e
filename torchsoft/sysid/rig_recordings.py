"""Recordings of the rig that a rig file describes.

Columns are the rig's own channels and signals, by the names that a run of the file writes. A signal
without a column is the file's own motion, counted from the same zero of time.
"""

from collections.abc import Mapping

import numpy as np
import torch

from torchsoft.channels import UNITS
from torchsoft.physics.motion import Reference, Sampled
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import RigFile
from torchsoft.solve.touch import Touch
from torchsoft.solve.trajectory import channels, measurable, units
from torchsoft.sysid.columns import Tables, Vocabulary
from torchsoft.sysid.configuration import Beginning, Moving
from torchsoft.sysid.first_samples import estimate_initial_state
from torchsoft.sysid.initial_state import Standing, Start
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.unknowns import Sensor, by_channel

APART = {"m": 1e-3, "rad": 0.05}
"""How far [m, rad] the first sample of a coordinate may be from the file's start, besides what its
sensor does."""

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


def followed(tables: Tables, rig: Rig | None = None) -> Reference:
    """The signals that tables have, with the rates of their columns, if there are any; the others
    are those of the rig."""
    columns, signals = tables.columns, {}
    for name in tables.known.signals:
        if name in columns:
            rate = columns.get(f"{name}_dot")
            times, values = (torch.tensor(column) for column in columns[name])
            signals[name] = Sampled(times, values, None if rate is None else torch.tensor(rate[1]))
        elif rig is not None:
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
    sensors = by_channel([rig], sensors)
    check_clock(file, rig, tables, start)
    rig.reference = followed(tables, rig)
    at_rest = Standing.of(rig, y0, start.lead, file.rests())
    made = recorded(name, rig, tables, sensors, start, at_rest)
    if isinstance(start, Moving):
        return made
    if start.position_sd:
        raise ValueError(
            "start.position_sd is of the paper's rig; where the places of bodies are not known, "
            'say start = {kind = "moving"}'
        )
    check_start(made, y0, tables, sensors)
    return made


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
    made: Recording, y0: torch.Tensor, tables: Tables, sensors: Mapping[str, Sensor]
) -> None:
    """Raises `ValueError` naming row and column for a coordinate that does not begin where the rig
    file says."""
    rig = made.rig
    with torch.no_grad():
        signals = rig.follow(made.times[0])
        here = channels(rig, rig.unpack(y0, signals), signals)
    for channel, (t, y) in made.samples.items():
        unit, sensor = made.units[channel], sensors.get(channel)
        if channel not in here or unit not in APART:
            continue
        slack = APART[unit] + (8 * sensor.sd + sensor.bias if sensor else 0.0)
        if abs(y[0] - float(here[channel])) > slack:
            table = tables.of(channel)
            row = int(np.searchsorted(table.values["t"], t[0]))
            raise ValueError(
                f"{table.at(row)}, column `{channel}`: it begins at {y[0]:.5g} {unit}, but the "
                f"rig file at {float(here[channel]):.5g} {unit}; say so there, or say start = "
                '{kind = "moving"} for a recording that begins elsewhere'
            )
