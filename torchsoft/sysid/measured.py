"""Measured data, and a TOML file that states what is known, what is unknown, and how good the sensors are.

Every error is a `ValueError` in a sentence that names the file, and the row and column or the field.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field, TypeAdapter, model_validator

from torchsoft.channels import CHANNELS, MEASURED, SETPOINTS
from torchsoft.parameters import Parameters
from torchsoft.physics.motion import Reference, Sampled
from torchsoft.physics.paper import SoftGrasp, apart
from torchsoft.sysid.columns import Columns, read_table
from torchsoft.sysid.fit import Loss, Unreachable
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.solve import RTOL, Method
from torchsoft.sysid.unknowns import Sensor, Unknown
from torchsoft.tables import LISTED, SEED, InvalidTable, Table, from_toml, line, refusing

BEGINNING, CREEP = 10e-3, 20e-3
"""For so long [s] nothing may move faster than this [m/s]: a disc put down on a pad still settles."""

APART = 1e-3
"""How far [m] the first samples may be from where the run begins; the disc may roll into a dent while it settles."""

SUNK = 3e-4
"""How far [m] below undeformed touch the bracket may begin: a disc sinks into its pad under its weight."""


class Settings(Table):
    """How to fit: the arguments of `identify` by the same names."""

    rtol: float = Field(RTOL, ge=1e-8, le=1e-2)
    starts: int = Field(1, ge=1, le=2**20)
    loss: Loss = "linear"
    method: Method = "gauss_newton"
    workers: int = Field(1, ge=1, le=1000)
    seed: int = Field(0, ge=0, le=SEED)

    @model_validator(mode="before")
    @classmethod
    def _has_no_step(cls, given: Any) -> Any:
        if isinstance(given, dict) and "step" in given:
            raise ValueError(
                "there is no `step` any more: tolerances choose the steps; leave it out, or give the relative tolerance `rtol` "
                f"({RTOL:g})"
            )
        return given


class Entry(Table):
    """One more recording (`file`, next to the configuration, called `name` or like the file), or, without a file, settings
    of its own for the recording called `name`."""

    name: str | None = Field(None, min_length=1, max_length=100)
    file: str | None = Field(None, min_length=1, max_length=1000)
    settings: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _is_named(self) -> "Entry":
        if self.name is None and self.file is None:
            raise ValueError("a recording needs a `file`, or the `name` of one that is given elsewhere")
        return self


class Config(Table):
    """An identification as a TOML file states it.

    `settings` are known numbers, by the groups and names of `Parameters`; `unknowns` and `sensors` are tables by the dotted
    names of parameters and by channels; `heldout` names recordings that are predicted and not fitted.
    """

    unknowns: dict[str, Unknown]
    sensors: dict[str, Sensor]
    settings: dict[str, Any] = Field(default_factory=dict)
    fit: Settings = Field(default_factory=lambda: Settings.model_validate({}))
    recordings: Annotated[tuple[Entry, ...], LISTED] = ()
    heldout: Annotated[tuple[str, ...], LISTED] = ()


@dataclass(frozen=True)
class Case:
    """A problem as its files state it; `tables` are the recordings' by name."""

    problem: Problem
    config: Config
    tables: dict[str, Columns]


def read_config(path: str | Path) -> Config:
    """Raises `ValueError` naming the file and the field, `OSError` for a file that cannot be read."""
    return from_toml(path, Config.model_validate)


def known_parameters(config: Path, name: str, table: Columns, *settings: dict[str, Any]) -> Parameters:
    """Parameters of the recording `name`: the settings, the later ones first, with the reach of its set-points as scenario.

    Raises `ValueError` naming the configuration and the field, or the row where nothing is grasped.
    """
    tree: dict[str, Any] = {}
    for given in settings:
        for key, value in given.items():
            group, _, field = key.partition(".")
            new = {field: value} if field else value
            old = tree.get(group, {})
            tree[group] = old | new if isinstance(old, dict) and isinstance(new, dict) else new
    whose = f"{config}, settings of `{name}`"
    groups: dict[str, Any] = {}
    for group, declared in Parameters.model_fields.items():
        kind: Any = declared.annotation
        with refusing(tree.get(group), f"{whose}: {group}"):
            groups[group] = TypeAdapter(kind).validate_python(tree.get(group, {}))
    x, y = table.values["x_d"], table.values["y_d"]
    if y.min() >= (touch := apart(Parameters.model_construct(**groups))):
        raise ValueError(
            f"{table.at(int(y.argmin()))}, column `y_d`: the bracket never comes lower than {1e3 * y.min():.4g} mm, but "
            f"the pads of {config} touch the disc at {1e3 * touch:.4g} mm ({STACK}): nothing is grasped"
        )
    signed = x - (groups["scenario"].x_C0 if "x_C0" in tree.get("scenario", {}) else x[0])
    part = 0.5 if groups["control"].senses == "bracket" else 1.0  # a disc rolls half as far as the bracket
    lowest, farthest = int(y.argmin()), int(np.abs(signed).argmax())
    mine = {"y_Br_grasp": float(y[lowest]), "travel": part * float(signed[farthest])}
    try:
        return Parameters.model_validate(tree | {"scenario": mine | tree.get("scenario", {})})
    except InvalidTable as error:
        raise ValueError(
            f"{whose}: {error} (scenario.y_Br_grasp and scenario.travel, unless given, are those of {table.at(lowest)}, column "
            f"`y_d`, and of {table.row} {table.rows[farthest]}, column `x_d`)"
        ) from None


STACK = "twice pad.height and disc.radius, and bracket.cm_height"
"""What decides where the pads touch."""


def check_plausible(table: Columns, p: Parameters, sensors: dict[str, Sensor]) -> None:
    """Raises `ValueError` for values that no such rig can have, and for a run that does not begin at rest, with the disc
    where `scenario.x_C0` says and the bracket clear of it; it names row and column."""
    L, H, begin = p.pad.length, apart(p), p.scenario.x_C0
    ranges = {"rad": (-100.0, 100.0), "m/s": (-10.0, 10.0), "rad/s": (-1e3, 1e3), "N": (-1e4, 1e4)}
    start = {"x_d": begin, "x_C": begin, "x_Br": begin, "theta": 0.0, "y_Br": table.values["y_d"][0]}
    for name, column in table.values.items():
        unit = CHANNELS[name].unit
        if name == "t":
            continue
        low, high = ranges.get(unit, (-L, 2 * L) if name.startswith("x") else (0.25 * H, 2 * H))
        by = "" if unit in ranges else " (pad.length)" if name.startswith("x") else f" ({STACK})"
        for i in np.flatnonzero((column < low) | (column > high))[:1].tolist():
            raise ValueError(
                f"{table.at(i)}, column `{name}`: {column[i]:.4g} {unit} is not plausible, it should be between {low:.3g} "
                f"and {high:.3g} {unit}{by}; is the unit in the heading right?"
            )
        here = np.flatnonzero(np.isfinite(column))
        if not here.size or name in ("F_x", "F_y", "F_ff"):
            continue
        sensor, size = sensors.get(name), 1 / p.disc.radius if unit.startswith("rad") else 1.0
        slack, bias = (8 * sensor.noise, sensor.bias) if sensor else (0.0, 0.0)
        if name in start and abs(column[here[0]] - start[name]) > APART * size + slack + bias:
            what = "scenario.x_C0" if name.startswith("x") else "the set-point y_d" if name == "y_Br" else "the start"
            raise ValueError(
                f"{table.at(int(here[0]))}, column `{name}`: it begins at {column[here[0]]:.5g} {unit}, but {what} is "
                f"{start[name]:.5g} {unit}"
            )
        t = table.values["t"][here] - table.values["t"][0]
        early = (t <= BEGINNING) | (np.arange(len(t)) < 2)
        y, t = column[here][early], t[early]
        moving = np.abs(y) > CREEP * size + slack + bias
        if not unit.endswith("/s"):
            moving = np.abs(y - y[0]) > CREEP * size * (t - t[0]) + slack
        for i in np.flatnonzero(moving)[:1].tolist():
            raise ValueError(
                f"{table.at(int(here[i]))}, column `{name}` moves already: a recording must begin at rest, the disc on the "
                "lower pad and the bracket clear of it"
            )
    if (y := table.values["y_d"][0]) < H - SUNK:
        raise ValueError(
            f"{table.at(0)}, column `y_d`: the bracket must begin clear of the disc, but begins at {1e3 * y:.4g} mm, and the "
            f"pads touch the disc at {1e3 * H:.4g} mm ({STACK})"
        )


def read_recording(path: str | Path, name: str, p: Parameters, sensors: dict[str, Sensor]) -> Recording:
    """A recording of a CSV or NetCDF file with the given settings. Raises `ValueError` naming row and column."""
    return recording(read_table(Path(path)), name, p, sensors)


def recording(table: Columns, name: str, p: Parameters, sensors: dict[str, Sensor]) -> Recording:
    check_plausible(table, p, sensors)
    values, t, samples = table.values, table.values["t"], {}
    for channel in (c for c in MEASURED if c in values):
        here = np.isfinite(values[channel])
        if here.sum() >= 2:
            samples[channel] = (t[here], values[channel][here])
        elif channel in sensors:
            raise ValueError(f"{table.path}, column `{channel}` has {here.sum()} samples, but needs at least two")
    if not set(samples) & set(sensors):
        raise ValueError(f"{table.path} has no column for any of the sensors {', '.join(sensors)}")
    columns = {k: torch.tensor(column) for k, column in values.items()}
    x, y = (Sampled(columns["t"], columns[k], columns.get(f"{k}_dot")) for k in SETPOINTS)
    F = Sampled(columns["t"], columns.get("F_ff", torch.zeros(len(t), dtype=torch.float64)))
    return Recording(name, SoftGrasp(p, Reference(x_d=x, y_d=y, F_ff=F)), samples)


def stem(path: Path) -> str:
    """The name of a file without its ending, in UTF-8 even where the system knows ASCII only."""
    return os.fsencode(path.stem).decode("utf-8", "replace")


def load(data: Sequence[str | Path], config: str | Path) -> Case:
    """The problem that data files and a configuration state. Raises `ValueError`, and `OSError` for what cannot be read."""
    config = Path(config)
    stated, tables, recordings = read_config(config), {}, []
    own = {e.name or stem(Path(str(e.file))): e for e in stated.recordings}
    files = [(stem(Path(f)), Path(f)) for f in data]
    files += [(name, config.parent / e.file) for name, e in own.items() if e.file is not None]
    names = [name for name, _ in files]
    if not files:
        raise ValueError(f"there is nothing to identify from: no data file, and no recording with a file in {config}")
    if len(own) < len(stated.recordings) or len(set(names)) < len(names):
        raise ValueError(f"{config}: recordings need names of their own, but are called {line(', '.join(names))}")
    if strange := [name for name in (*own, *stated.heldout) if name not in names]:
        where = "heldout" if strange[0] in stated.heldout else "recordings"
        raise ValueError(
            f"{config}, {where}: there is no recording `{line(strange[0], 80)}`; the recordings' names are {', '.join(names)}"
        )
    for name, path in files:
        table = tables[name] = read_table(path)
        p = known_parameters(config, name, table, stated.settings, own[name].settings if name in own else {})
        recordings.append(recording(table, name, p, stated.sensors))
    try:
        problem = Problem(recordings, stated.sensors, stated.unknowns)
    except ValueError as error:
        raise ValueError(f"{config}: {error}") from None
    if stated.heldout and set(stated.heldout) == set(names):
        raise ValueError(f"{config}, heldout: it names every recording, so that nothing is left to fit")
    return Case(problem, stated, tables)


def unreachable(error: Unreachable, tables: dict[str, Columns]) -> str:
    """Which recording the model could not follow, and the row of its file where the run ended."""
    return "; ".join(
        f"{tables[name].path}, {tables[name].near(lost.time)}: the model cannot follow recording `{name}` here: {lost.reason}"
        for name, lost in error.lost.items()
    )
