"""Recordings and problems as files state them, and the cost of an identification.

Every error is a `ValueError` in a sentence that names the file, and the row and column or the
field.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.cost import RUN, Cost, rig_row, rig_step, steps_per_second
from torchsoft.csvfile import UNITS
from torchsoft.display import suggestion
from torchsoft.physics.channels import Seen, Touch, measurable, read, units
from torchsoft.physics.motion import Piecewise, Reference, Sampled
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import State
from torchsoft.physics.statics import net_loads
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import at_field
from torchsoft.sysid.columns import Columns, Tables, Vocabulary, read_tables
from torchsoft.sysid.configuration import (
    Column,
    Config,
    Entry,
    Law,
    Moving,
    StartTable,
    read_config,
)
from torchsoft.sysid.first_samples import estimate_initial_state
from torchsoft.sysid.fit import Unreachable
from torchsoft.sysid.initial_state import BOUNDS, PREFIX, Standing
from torchsoft.sysid.prechecks import channel as channel_of
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.stages import ALL, FINER, FIRST, FREE, LAST, LOOSE, USUAL
from torchsoft.sysid.unknowns import Sensor, by_channel
from torchsoft.tables import line, shown

# Recordings of the rig that a rig file describes.
#
# Columns are the rig's own channels and signals, by the names that a run of the file writes. A
# signal without a column is the file's own motion, counted from the same zero of time. What a
# recording at rest starts with is compared with where the file has bodies and motions start.


FARTHEST = 10.0
"""Largest distance of a measured place from the origin, over that of any part of the rig."""

LARGEST = {"rad": 100.0, "m/s": 10.0, "rad/s": 1e3, "N": 1e4, "N.m": 1e3}
"""Largest plausible values of other columns, by unit."""

APART = {"m": 1e-3, "rad": 0.05}
"""Largest distance [m, rad] of the first sample of a coordinate from the file's start, besides the
sensor's error: a body may roll into a dent while it settles."""

ASIDE = {"m": 3e-4, "rad": 0.05}
"""Largest distance [m, rad] of the first set-point from the file's: a pushed body must not press
already."""

EARLY, CREEP = 10e-3, 20e-3
"""Time [s] from the first sample during which coordinates may not exceed a speed [m/s] besides that
of the file: a body put down on a pad still settles."""

WAY_OUT = 'or set start = {kind = "moving"} for a recording that begins in motion or in mid-grasp'

SLACK = 0.05
"""Time [s] by which a recording may start after the file's own motions, or end after them."""


def vocabulary(rig: Rig, stated: Mapping[str, Column]) -> Vocabulary:
    """Columns that recordings of a rig may have, with what is `stated` of headings. Raises
    `ValueError` for a heading that stands for something else."""
    known, signals, touch = units(rig), rig.signals, Touch(rig)
    known |= {name: touch.unit(name) for name in touch}
    names = (*signals, *(f"{name}_dot" for name in signals), *measurable(rig), *touch)
    columns = {"t": "s"} | {name: known[name] for name in names if known[name] in UNITS}
    usual = {short: full for short, full in rig.short.items() if full in columns}
    usual |= {name: name for name in columns}
    headings, unwrapped = dict[str, str](), list[str]()
    for heading, one in stated.items():
        name = usual.get(one.of or heading, one.of or heading)
        if name not in columns:
            raise ValueError(
                f"columns.{heading} = {shown(name)} is no channel of the rig; "
                f"{suggestion(name, columns, 'there are')}"
            )
        if one.unwrap and columns[name] != "rad":
            raise ValueError(
                f"columns.{heading}.unwrap: `{name}` is in {columns[name]}, and only angles "
                "wrap: leave it out"
            )
        headings |= {heading: name} if one.of else {}
        unwrapped += [name] if one.unwrap else []
    usual = {heading: name for heading, name in usual.items() if name not in headings.values()}
    return Vocabulary(columns, signals, usual | headings, tuple(unwrapped))


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
                f"{tables.of(channel).path}, column `{tables.known.heading(channel)}` has "
                f"{here.sum()} samples, but needs at least two"
            )
    if not set(samples) & set(sensors):
        files = ", ".join(str(table.path) for table in tables.tables)
        raise ValueError(f"{files} has no column for any of the sensors {', '.join(sensors)}")
    return samples


def rig_recording(
    file: RigFile, tables: Tables, name: str, sensors: Mapping[str, Sensor], start: StartTable
) -> Recording:
    """The recording that tables hold, of the rig of a file. Raises `ValueError` naming row and
    column, or the file's field."""
    built = file.build()
    rig, y0, _ = built
    sensors, own = by_channel([rig], sensors), rig.reference
    check_clock(file, rig, tables, start)
    check_plausible(rig, rig.unpack(y0), tables)
    rig.reference = followed(tables, rig)
    if isinstance(start, Moving):
        initial = Standing.of(rig, y0)
    else:
        initial = Standing.built(built, start.lead, start.position_sd)
        mine = {name: one for name, one in initial.followed.items() if name not in tables}
        initial = initial._replace(followed=mine)
    made = Recording(name, rig, measured_samples(tables, sensors), initial)
    if not isinstance(start, Moving):
        check_start(made, y0, own, tables, sensors)
        return made
    given = {coordinate: (one.mean, one.sd) for coordinate, one in start.given.items()}
    used = {channel: sensors[channel] for channel in sensors if channel in made.samples}
    return estimate_initial_state(made, used, lead=start.lead, given=given)


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
                f"{table.at(i, name)}: {column[i]:.4g} {unit} is not plausible, it "
                f"should be between {-most:.3g} and {most:.3g} {unit}"
                + (f", {FARTHEST:g} times as far as the rig reaches" if unit == "m" else "")
                + "; is the unit in the heading right?"
            )


def check_clock(file: RigFile, rig: Rig, tables: Tables, start: StartTable) -> None:
    """Raises `ValueError` naming row and column for times outside the file's own motions, where a
    signal has no column, and for a recording at rest that starts after theirs."""
    own = [signal for signal in rig.signals if signal not in tables]
    end = file.outputs.duration
    for table in tables.tables if own else ():
        t = table.values["t"]
        if t[-1] > end + SLACK:
            raise ValueError(
                f"{table.at(-1, 't')}: {t[-1]:g} s is after the end of the file's own motions, "
                f"{end:g} s, which `{own[0]}` follows; count times from their start, give a column "
                "of it, or set in the settings how long they last, outputs.duration"
            )
        if not isinstance(start, Moving) and t[0] > SLACK:
            raise ValueError(
                f"{table.at(0, 't')}: a recording that begins at rest begins with the file's "
                f"own motions, at 0 s, not at {t[0]:g} s; count times from there, "
                'or set start = {kind = "moving"}'
            )


class FirstRows(NamedTuple):
    """A column of lengths, angles or their rates: its name and unit, its table with the rows that
    have samples, times t (k,) [s] and values y (k,) there, and the noise and bias of its sensor."""

    name: str
    unit: str
    table: Columns
    rows: Sequence[int]
    t: Array
    y: Array
    noise: float
    bias: float

    def at(self, i: int) -> str:
        return self.table.at(self.rows[i], self.name)


def check_start(
    made: Recording, y0: Tensor, own: Reference, tables: Tables, sensors: Mapping[str, Sensor]
) -> None:
    """Raises `ValueError` naming row and column for a recording that does not start at rest, with
    coordinates and set-points where the rig file says; `own` are the file's motions."""
    first, columns = tables.first_time, list[FirstRows]()
    for name, (t, y) in tables.columns.items():
        unit, rows = tables.known.units[name], np.flatnonzero(np.isfinite(y))
        late = name in made.samples and made.samples[name][0][0] > first + EARLY
        if len(rows) and not late and unit.startswith(("m", "rad")):
            sensor = sensors.get(name)
            noise, bias = (8 * sensor.sd, sensor.bias) if sensor else (0.0, 0.0)
            table = tables.of(name)
            columns.append(
                FirstRows(name, unit, table, rows.tolist(), t[rows], y[rows], noise, bias)
            )
    check_places(made, y0, own, first, columns)
    check_rest(made, y0, own, first, columns)


def check_places(
    made: Recording, y0: Tensor, own: Reference, first: float, columns: Sequence[FirstRows]
) -> None:
    """Raises `ValueError` for a column that starts elsewhere than the rig file."""
    places, unsure = start_places(made, y0, own, first)
    for one in columns:
        known, y, unit = places.get(one.name, [one.y[0]]), one.y[0], one.unit
        near = (ASIDE if one.name in made.rig.signals else APART).get(unit, np.inf)
        near += one.noise + one.bias + unsure.get(one.name, 0.0)
        if min(abs(y - place) for place in known) > near:
            raise ValueError(
                f"{one.at(0)}: it begins at {y:.5g} {unit}, but the rig file at {known[0]:.5g} "
                f"{unit}: are its unit, sign and zero right? If so, state it there, {WAY_OUT}"
            )


def check_rest(
    made: Recording, y0: Tensor, own: Reference, first: float, columns: Sequence[FirstRows]
) -> None:
    """Raises `ValueError` for a column that moves from the first sample on."""
    rig = made.rig
    speed, rush = pace(made, rig.unpack(y0, rig.follow(first).detach()), own, first)
    smallest = min(body.shape.size() for body in rig.bodies.values() if body.shape is not None)
    for one in columns:
        fastest = speed + rush * (one.t - first + made.start.lead)
        fastest /= smallest if "rad" in one.unit else 1.0
        size, most = np.abs(one.y - one.y[0]), fastest * (one.t - one.t[0]) + one.noise
        if one.unit.endswith("/s"):
            size, most = np.abs(one.y), fastest + one.noise + one.bias
        early = (one.t <= first + EARLY) | (np.arange(len(one.t)) < 2)
        for i in np.flatnonzero(early & (size > most))[:1]:
            raise ValueError(
                f"{one.at(i)} moves already, by {size[i]:.3g} {one.unit}: is its unit right? If it "
                "is, a recording must begin at rest, its bodies where the rig file has them start, "
                f"{WAY_OUT}"
            )


def start_places(
    made: Recording, y0: Tensor, own: Reference, first: float
) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Values of coordinates and set-points at the start by the rig file, by column, and by how much
    they may differ; a set-point may also be where its coordinate is."""
    rig = made.rig
    with torch.no_grad():
        signals = rig.follow(first)
        here = read(Seen(rig, rig.unpack(y0, signals), signals))
        # a recording at rest starts with the file's motions, whatever its clock counts from
        stated = own(torch.zeros((), dtype=torch.float64), rig.signals)[:, 0]
    places = {name: [float(value)] for name, value in here.items() if name in made.samples}
    places |= {name: [float(value)] for name, value in zip(rig.signals, stated)}
    for coordinate, setpoint in (pair for one in rig.actuators.values() for pair in one.follows):
        places[setpoint].append(float(here[channel_of(rig, coordinate)]))
    unsure = {
        channel_of(rig, one.name.removeprefix(PREFIX)): BOUNDS * one.sd
        for one in made.start_coordinates
    }
    return places, unsure | dict.fromkeys(rig.signals, max(unsure.values(), default=0.0))


def pace(made: Recording, state: State, own: Reference, first: float) -> tuple[float, float]:
    """Largest speed [m/s] at the first sample by the rig file, with its start in `state` and its
    motions; and acceleration [m/s2] of a body that nothing holds."""
    rig, lead = made.rig, made.start.lead
    around = torch.linspace(-lead, EARLY, 51, dtype=torch.float64)
    with torch.no_grad():
        rates = [
            own(around, (name,))[..., 1].abs().max().item()
            for name in rig.signals
            if made.units[name] in ("m", "rad")
        ]
        loads = net_loads(rig, state, rig.follow(first))
        held = {
            contact.body
            for name, contact in rig.contacts.items()
            if rig.penetration(name, state).max() > 0
        }
    held |= {one.pushes.split(".")[0] for one in rig.actuators.values()}
    speeds = [rate.abs().max().item() for rate in state.velocity.values()]
    rushes = [
        (loads[name][:2].norm() / body.mass).item()
        for name, body in rig.bodies.items()
        if lead == 0 or name not in held
    ]
    return CREEP + 2 * max(rates, default=0.0) + max(speeds, default=0.0), max(rushes, default=0.0)


# Problems as files state them, and their cost


CHECKED = 30
"""Runs that a recording is asked for to check what is taken for granted."""


def cost(
    problem: Problem, rtol: float, starts: int, workers: int, heldout: tuple[str, ...] = ()
) -> Cost:
    """Cost of `default_plan` where every stage takes all its evaluations, and of the checks before
    and after it."""
    fitted = [r for r in problem.recordings if r.name not in heldout]
    slowest, coordinates = min(fitted, key=lambda r: r.speed), problem.coordinates.all
    loose, usual = max(LOOSE, rtol), max(USUAL, rtol)
    steps, seconds, memory = 0.0, list[float](), list[float]()
    for one in fitted:
        rows = len(one.grid(problem.interpolated).t)
        own = [c for c in coordinates if c.of_the_rig and c.recording in (None, one.name)]
        plain, derived = (rig_step(one.rig, count) for count in (0, max(len(own), 1)))
        first = starts * FIRST if one is slowest else 0
        took = 0.0
        for count, by, step in (
            (first + ALL, loose, derived),
            (FREE, usual, derived),
            (LAST if rtol < usual else 0, rtol, derived),
            (1, loose, plain),
            (1, FINER * rtol, plain),
            (CHECKED, usual, plain),
        ):
            length = (one.duration + one.start.lead) * steps_per_second(by) + rows
            steps += count * length
            took += count * (length * step + RUN)
        seconds.append(took)
        memory.append(rows * rig_row(one.rig))
    at_once = max(1, min(workers, len(fitted)))
    longest = max(sum(seconds) / at_once, max(seconds))
    return Cost(steps=steps, seconds=longest, memory=sum(sorted(memory)[-at_once:]))


def one_by_one(costs: Iterable[Cost]) -> Cost:
    """Cost of several identifications, such as those of competing laws."""
    every = list(costs)
    return Cost(
        sum(c.steps for c in every), sum(c.seconds for c in every), max(c.memory for c in every)
    )


# Recordings and problems


STATED = "as stated"
"""The name of the law of the file itself among competing ones."""


@dataclass(frozen=True)
class Case:
    """A problem as its files state it; `tables` are the recordings' by name; `laws`, if there are
    competing ones, are that problem and those with the others."""

    problem: Problem
    config: Config
    tables: dict[str, Tables]
    laws: dict[str, Problem] = field(default_factory=dict)


def stem(path: Path) -> str:
    """The name of a file without its ending, in UTF-8 even where the system knows ASCII only."""
    return os.fsencode(path.stem).decode("utf-8", "replace")


def sources(
    data: Sequence[str | Path], config: Path, stated: Config
) -> dict[str, tuple[Entry, list[Path]]]:
    """Entry and files of every recording, by name. Raises `ValueError` for names that do not
    fit."""
    own = {entry.name or stem(Path(entry.paths[0])): entry for entry in stated.recordings}
    files = [(stem(Path(file)), [Path(file)]) for file in data]
    files += [
        (name, [config.parent / path for path in entry.paths])
        for name, entry in own.items()
        if entry.paths
    ]
    names = [name for name, _ in files]
    if not files:
        raise ValueError(
            "there is nothing to identify from: no data file, and no recording with a file in "
            f"{config}"
        )
    if len(own) < len(stated.recordings) or len(set(names)) < len(names):
        raise ValueError(
            f"{config}: recordings need names of their own, but are called {line(', '.join(names))}"
        )
    if strange := [name for name in (*own, *stated.heldout) if name not in names]:
        where = "heldout" if strange[0] in stated.heldout else "recordings"
        raise ValueError(
            f"{config}, {where}: there is no recording `{line(strange[0], 80)}`; the recordings' "
            f"names are {line(', '.join(names))}"
        )
    if stated.heldout and set(stated.heldout) == set(names):
        raise ValueError(
            f"{config}, heldout: it names every recording, so that nothing is left to fit"
        )
    return {name: (own.get(name, Entry(name=name)), paths) for name, paths in files}


@contextmanager
def stated_in(place: str) -> Iterator[None]:
    """Raises errors of values and files as `ValueError` that names the place that states them."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None
    except OSError as error:
        raise ValueError(f"{place}: {line(error.filename)}: {error.strerror}") from None


def load(data: Sequence[str | Path], config: str | Path, stated: Config | None = None) -> Case:
    """The problem that data files and a configuration state; `stated` is what the file says, where
    that is known already. Raises `ValueError`, and `OSError` for
    what cannot be read."""
    config = Path(config)
    stated = read_config(config) if stated is None else stated
    entries, tables = sources(data, config, stated), dict[str, Tables]()
    with stated_in(f"{config}, rig"):
        file = RigFile.from_toml(RigFile.path(stated.rig, config.parent))
        columns = vocabulary(file.assemble(), stated.columns)
    with stated_in(str(config)):
        stated.check_unknowns(file.full)
    for name, (entry, paths) in entries.items():
        try:
            tables[name] = read_tables(paths, stated.ignore, columns)
        except OSError as error:
            if not entry.paths:
                raise
            own = "files" if entry.files else "file"
            raise ValueError(
                f"{config}, recordings: `{own}` of `{name}`: {line(error.filename)}: "
                f"{error.strerror}"
            ) from None
    left_out = {name for one in tables.values() for table in one.tables for name in table.ignored}
    if strange := [name for name in stated.ignore if name not in left_out]:
        raise ValueError(f"{config}, ignore: no file has a column `{line(strange[0], 80)}`")
    if STATED in stated.compare:
        raise ValueError(
            f"{config}, compare: the law of the file itself is called `{STATED}`; call the other "
            "one otherwise"
        )
    laws = {
        name: law_problem(f"{config}{field}", file, stated, law, entries, tables)
        for name, law, field in (
            (STATED, Law(), ""),
            *((name, law, f", compare.{name}") for name, law in stated.compare.items()),
        )
    }
    return Case(laws[STATED], stated, tables, laws if stated.compare else {})


def law_problem(
    place: str,
    file: RigFile,
    stated: Config,
    law: Law,
    entries: Mapping[str, tuple[Entry, list[Path]]],
    tables: Mapping[str, Tables],
) -> Problem:
    """The problem with a competing law, which `place` states."""
    made = []
    for name, (entry, _) in entries.items():
        settings = (stated.settings, entry.settings, law.settings)
        try:
            with at_field("settings"):
                mine = reduce(RigFile.changed, settings, file)
            start = entry.start or stated.start
            made.append(rig_recording(mine, tables[name], name, stated.sensors, start))
        except ValueError as error:
            if any(str(table.path) in str(error) for table in tables[name].tables):
                raise
            raise ValueError(f"{place}, recording `{name}`: {error}") from None
    full = made[0].rig.full
    without = {full(name) for name in law.without}
    unknowns = {full(name): one for name, one in (stated.unknowns | law.unknowns).items()}
    with stated_in(place):
        kept = {name: one for name, one in unknowns.items() if name not in without}
        return Problem(made, stated.sensors, kept)


def unreachable(error: Unreachable, tables: Mapping[str, Tables]) -> str:
    """Recordings that the model could not follow, and rows of their files where the runs ended."""
    return "; ".join(
        f"{tables[name].near(failed.time)}: the model cannot follow recording `{name}` here: "
        f"{failed.reason}"
        for name, failed in error.failed.items()
    )
