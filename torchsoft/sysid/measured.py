"""Recordings and problems as files state them, and the cost of an identification.

Every error is a `ValueError` in a sentence that names the file, and the row and column or the
field.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from torchsoft.channels import CHANNELS, MEASURED, SETPOINTS
from torchsoft.cost import RUN, Cost, rig_row, rig_step, steps_per_second
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import SoftGrasp, apart
from torchsoft.physics.material import KINDS, StandardLinearSolid
from torchsoft.physics.motion import Reference
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import at_field
from torchsoft.sysid.columns import PAPER, Tables, read_tables
from torchsoft.sysid.configuration import (
    Beginning,
    Config,
    Entry,
    KelvinVoigtPads,
    Law,
    Missing,
    Moving,
    Pads,
    Rest,
    StandardLinearPads,
    groups,
    in_one_vocabulary,
    read_config,
)
from torchsoft.sysid.fit import Unreachable
from torchsoft.sysid.initial_state import BOUNDS, AtRest
from torchsoft.sysid.plan import ALL, FINER, FIRST, FREE, LAST, LOOSE, USUAL
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.rig_recordings import (
    followed,
    recorded,
    rig_recording,
    vocabulary,
)
from torchsoft.sysid.unknowns import Sensor, Unknown
from torchsoft.tables import InvalidTable, line, refusing, shown

CHECKED = 30
"""Runs that a recording is asked for to check what is taken for granted."""

FEW, COLUMN = 8, 0.09
"""So many unknowns are a few; what each one more adds to the time of a step that is
differentiated."""


def cost(
    problem: Problem,
    rtol: float,
    starts: int,
    workers: int,
    heldout: tuple[str, ...] = (),
    method: str = "gauss_newton",
) -> Cost:
    """Of `default_plan` where every stage takes all its evaluations, and of the checks before and
    after it; descents on the adjoint take more of them, and memory for a matrix that interpolates
    between the rows."""
    fitted = [r for r in problem.recordings if r.name not in heldout]
    slowest = min(fitted, key=lambda r: r.speed)
    rows = {r.name: len(r.grid(problem.interpolated).t) for r in problem.recordings}
    loose, usual = max(LOOSE, rtol), max(USUAL, rtol)

    descent, steps, seconds = method != "gauss_newton", 0.0, list[float]()
    for recording in fitted:
        first = starts * FIRST if recording is slowest else 0
        stages = [(first + ALL, loose), (FREE, usual), (LAST if rtol < usual else 0, rtol)]
        runs = [((4 if descent else 1) * number, by, True) for number, by in stages]
        runs += [(1, loose, False), (1, FINER * rtol, False), (CHECKED, usual, False)]
        mine = [c for c in problem.coordinates.all
                if c.of_the_rig and c.recording in (None, recording.name)]  # fmt: skip
        more, span = 1 + COLUMN * max(len(mine) - FEW, 0), recording.duration + recording.start.lead
        seconds.append(0.0)
        for number, by, differentiated in runs:
            length = span * steps_per_second(by) + rows[recording.name]
            step = rig_step(recording.rig, differentiated) * (more if differentiated else 1.0)
            steps += number * length
            seconds[-1] += number * (length * step + RUN)
    matrix = 3 * 8 / 2**30 if descent else 0.0
    memory = sorted(
        rows[r.name] * (rig_row(r.rig) + matrix * rows[r.name]) for r in problem.recordings
    )
    at_once = max(1, min(workers, len(fitted)))
    return Cost(
        steps=steps,
        seconds=max(sum(seconds) / at_once, max(seconds)),
        memory=sum(memory[-at_once:]),
    )


def one_by_one(costs: Iterable[Cost]) -> Cost:
    """Of several identifications, such as those of competing laws."""
    every = list(costs)
    return Cost(
        sum(c.steps for c in every), sum(c.seconds for c in every), max(c.memory for c in every)
    )


# Recordings and problems


BEGINNING, CREEP = 10e-3, 20e-3
"""For so long [s] nothing may move faster than this [m/s]: a disc put down on a pad still
settles."""

APART = 1e-3
"""How far [m] the first samples may be from where the run begins; the disc may roll into a dent
while it settles."""

SUNK = 3e-4
"""How far [m] below undeformed touch the bracket may begin: a disc sinks into its pad under its
weight."""

WAY_OUT = 'or say start = {kind = "moving"} for a recording that begins in motion or in mid-grasp'

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


def known_parameters(
    config: Path, name: str, tables: Tables, *settings: dict[str, Any]
) -> Parameters:
    """Parameters of the recording `name`: the settings, the later ones first, with the reach of its
    set-points as scenario.

    Raises `ValueError` naming the configuration and the field, or the row where nothing is grasped.
    """
    tree, whose = groups(*settings), f"{config}, settings of `{name}`"
    made: dict[str, Any] = {}
    for group, declared in Parameters.model_fields.items():
        kind: Any = declared.annotation
        with refusing(tree.get(group), f"{whose}: {group}"):
            made[group] = TypeAdapter(kind).validate_python(tree.get(group, {}))
    across, down = (tables.of(one) for one in SETPOINTS)
    x, y = across.values["x_d"], down.values["y_d"]
    if y.min() >= (touch := apart(Parameters.model_construct(**made))):
        raise ValueError(
            f"{down.at(int(y.argmin()))}, column `y_d`: the bracket never comes lower than "
            f"{1e3 * y.min():.4g} mm, but the pads of {config} touch the disc at {1e3 * touch:.4g} "
            f"mm ({STACK}): nothing is grasped"
        )
    scenario = tree.get("scenario")
    given = scenario if isinstance(scenario, dict) else {}
    signed = x - (made["scenario"].x_C0 if "x_C0" in given else x[0])
    part = (
        0.5 if made["control"].senses == "bracket" else 1.0
    )  # a disc rolls half as far as the bracket
    lowest, farthest = int(y.argmin()), int(np.abs(signed).argmax())
    mine = {"y_Br_grasp": float(y[lowest]), "travel": part * float(signed[farthest])}
    try:
        return Parameters.model_validate(tree | {"scenario": mine | given})
    except InvalidTable as error:
        raise ValueError(
            f"{whose}: {error} (scenario.y_Br_grasp and scenario.travel, unless given, are those "
            f"of {down.at(lowest)}, column `y_d`, and of {across.row} {across.rows[farthest]}, "
            "column `x_d`)"
        ) from None


STACK = "twice pad.height and disc.radius, and bracket.cm_height"
"""What decides where the pads touch."""


def check_plausible(tables: Tables, p: Parameters, sensors: Mapping[str, Sensor]) -> None:
    """Raises `ValueError` for values that no such rig can have; it names row and column."""
    L, H = p.pad.length, apart(p)
    ranges = {"rad": (-100.0, 100.0), "m/s": (-10.0, 10.0), "rad/s": (-1e3, 1e3), "N": (-1e4, 1e4)}
    for name, (_, column) in tables.columns.items():
        unit, table = CHANNELS[name].unit, tables.of(name)
        low, high = ranges.get(unit, (-L, 2 * L) if name.startswith("x") else (0.25 * H, 2 * H))
        by = "" if unit in ranges else " (pad.length)" if name.startswith("x") else f" ({STACK})"
        for i in np.flatnonzero((column < low) | (column > high))[:1].tolist():
            raise ValueError(
                f"{table.at(i)}, column `{name}`: {column[i]:.4g} {unit} is not plausible, it "
                f"should be between {low:.3g} and {high:.3g} {unit}{by}; is the unit in the "
                "heading right?"
            )


def check_rest(
    tables: Tables, p: Parameters, sensors: Mapping[str, Sensor], position_sd: float
) -> None:
    """Raises `ValueError` for a recording that does not begin at rest, with the disc where
    `scenario.x_C0` says and the bracket clear of it; it names row and column."""
    H, x_C0, first = apart(p), p.scenario.x_C0, tables.begin
    down = tables.of("y_d")
    begin = {"x_d": x_C0, "x_C": x_C0, "x_Br": x_C0, "theta": 0.0, "y_Br": down.values["y_d"][0]}
    for name, (t, column) in tables.columns.items():
        unit, table, here = (
            CHANNELS[name].unit,
            tables.of(name),
            np.flatnonzero(np.isfinite(column)),
        )
        asked = name not in MEASURED
        if not here.size or unit == "N" or (not asked and t[here[0]] > first + BEGINNING):
            continue
        sensor, size = sensors.get(name), 1 / p.disc.radius if unit.startswith("rad") else 1.0
        slack, bias = (8 * sensor.sd, sensor.bias) if sensor else (0.0, 0.0)
        reach = (APART + BOUNDS * position_sd) * size + slack + bias
        if name in begin and abs(column[here[0]] - begin[name]) > reach:
            what = (
                "scenario.x_C0"
                if name.startswith("x")
                else "the set-point y_d"
                if name == "y_Br"
                else "the start"
            )
            opposite = abs(column[here[0]] + begin[name]) <= reach
            raise ValueError(
                f"{table.at(int(here[0]))}, column `{name}`: it begins at {column[here[0]]:.5g} "
                f"{unit}, but {what} is {begin[name]:.5g} {unit}"
                + ("; is its sign opposite?" if opposite else f"; fix that, {WAY_OUT}")
            )
        t = t[here]
        early = (t <= first + BEGINNING) | (np.arange(len(t)) < 2)
        y, t = column[here][early], t[early]
        moving = np.abs(y) > CREEP * size + slack + bias
        if not unit.endswith("/s"):
            moving = np.abs(y - y[0]) > CREEP * size * (t - t[0]) + slack
        for i in np.flatnonzero(moving)[:1].tolist():
            raise ValueError(
                f"{table.at(int(here[i]))}, column `{name}` moves already: a recording must begin "
                f"at rest, the disc on the lower pad and the bracket clear of it, {WAY_OUT}"
            )
    if (y := down.values["y_d"][0]) < H - SUNK:
        raise ValueError(
            f"{down.at(0)}, column `y_d`: the bracket must begin clear of the disc, but begins at "
            f"{1e3 * y:.4g} mm, and the pads touch the disc at {1e3 * H:.4g} mm ({STACK}); fix "
            f"that, {WAY_OUT}"
        )


AT_REST, PLAIN = Rest(), KelvinVoigtPads()
"""How a recording begins, and what the pads are made of, where nothing is said."""


def recording(
    tables: Tables,
    name: str,
    p: Parameters,
    sensors: dict[str, Sensor],
    start: Beginning = AT_REST,
    pads: Pads = PLAIN,
) -> Recording:
    """The recording that tables hold, of a rig with the parameters p. Raises `ValueError` naming
    row and column."""
    check_plausible(tables, p, sensors)
    if isinstance(start, Rest):
        check_rest(tables, p, sensors, start.position_sd)
    at_rest = AtRest() if isinstance(start, Moving) else AtRest(start.position_sd, lead=start.lead)
    return recorded(name, rig(p, followed(tables), pads), tables, sensors, start, at_rest)


def rig(p: Parameters, reference: Reference, pads: Pads) -> SoftGrasp:
    """The paper's rig, on pads of the material that is stated. Raises `ValueError` for moduli that
    do not fit together."""
    q, material = p.pad, None
    if isinstance(pads, StandardLinearPads):
        if pads.E_instant <= p.pad.E:
            raise ValueError(
                f"pads.E_instant = {pads.E_instant:g} must be above pad.E = {p.pad.E:g}, the "
                "relaxed modulus"
            )
        material = StandardLinearSolid(
            q.E, pads.E_instant, q.nu, q.rho, q.tau, q.depth, pads.tau_instant
        )
    elif not isinstance(pads, KelvinVoigtPads):
        series = pads.model_dump(exclude={"kind"})
        material = KINDS[pads.kind](E=q.E, nu=q.nu, rho=q.rho, depth=q.depth, **series)
        if wrong := material.well_posed():
            raise ValueError(f"pads: {wrong}")
    return SoftGrasp(p, reference, material=material)


def stem(path: Path) -> str:
    """The name of a file without its ending, in UTF-8 even where the system knows ASCII only."""
    return os.fsencode(path.stem).decode("utf-8", "replace")


def sources(
    data: Sequence[str | Path], config: Path, stated: Config
) -> dict[str, tuple[Entry, list[Path]]]:
    """What is particular about every recording, and its files, by name. Raises `ValueError` for
    names that do not fit."""
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
            f"names are {', '.join(names)}"
        )
    if stated.heldout and set(stated.heldout) == set(names):
        raise ValueError(
            f"{config}, heldout: it names every recording, so that nothing is left to fit"
        )
    return {name: (own.get(name, Entry(name=name)), paths) for name, paths in files}


def load(data: Sequence[str | Path], config: str | Path, stated: Config | None = None) -> Case:
    """The problem that data files and a configuration state; `stated` is what the file says, where
    that is known already. Raises `ValueError`, and `OSError` for
    what cannot be read."""
    config = Path(config)
    stated = read_config(config) if stated is None else stated
    entries, tables = sources(data, config, stated), dict[str, Tables]()
    file, columns = None, PAPER
    try:
        if stated.rig is None:
            columns = PAPER.renamed(stated.columns)
        else:
            file = RigFile.from_toml(config.parent / stated.rig)
            columns = vocabulary(file.assemble(), stated.columns)
    except ValueError as error:
        where = config if stated.rig is None else f"{config}, rig"
        raise ValueError(f"{where}: {error}") from None
    except OSError as error:
        raise ValueError(f"{config}, rig: {stated.rig}: {error.strerror}") from None
    for name, (entry, paths) in entries.items():
        try:
            constants = entry.missing.over(stated.missing)
            tables[name] = read_tables(paths, stated.ignore, constants, columns)
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
    for where, missing, of in (
        (f"{config}, missing", stated.missing, list(tables.values())),
        *(
            (f"{config}, recordings: missing of `{k}`", entry.missing, [tables[k]])
            for k, (entry, _) in entries.items()
        ),
    ):
        filled = {name for one in of for name in one.constants}
        if strange := [name for name in missing.over(Missing()) if name not in filled]:
            raise ValueError(
                f"{where}: {strange[0]} is not missing, there is a column; leave the constant out, "
                f"or the column: say ignore = [{shown(strange[0])}]"
            )

    def problem(law: Law, what: str) -> Problem:
        made = []
        for name, (entry, _) in entries.items():
            settings, start = (stated.settings, entry.settings, law.settings), entry.start
            start = start or stated.start
            if file is None:
                p = known_parameters(config, name, tables[name], *settings)
            try:
                if file is not None:
                    with at_field("settings"):
                        mine = reduce(lambda one, given: one.override(**given), settings, file)
                    made.append(rig_recording(mine, tables[name], name, stated.sensors, start))
                    continue
                pads = law.pads or stated.pads
                made.append(recording(tables[name], name, p, stated.sensors, start, pads))
            except ValueError as error:
                known = any(str(table.path) in str(error) for table in tables[name].tables)
                raise (
                    error if known else ValueError(f"{config}{what}, recording `{name}`: {error}")
                ) from None
        try:
            return Problem(made, stated.sensors, unknowns_of(stated, law))
        except ValueError as error:
            raise ValueError(f"{config}{what}: {error}") from None

    main = problem(Law(), "")
    laws = {name: problem(law, f", compare.{name}") for name, law in stated.compare.items()}
    if STATED in laws:
        raise ValueError(
            f"{config}, compare: the law of the file itself is called `{STATED}`; call the other "
            "one otherwise"
        )
    return Case(main, stated, tables, {STATED: main, **laws} if laws else {})


def unknowns_of(stated: Config, law: Law) -> dict[str, Unknown]:
    """What a law has to be found."""
    without = {stated.understood(name) for name in law.without}
    both = (in_one_vocabulary(x, stated.understood) for x in (stated.unknowns, law.unknowns))
    mine = reduce(or_, both)
    return {name: one for name, one in mine.items() if name not in without}


def unreachable(error: Unreachable, tables: Mapping[str, Tables]) -> str:
    """Which recording the model could not follow, and the row of its file where the run ended."""
    return "; ".join(
        f"{tables[name].near(lost.time)}: the model cannot follow recording `{name}` here: "
        f"{lost.reason}"
        for name, lost in error.lost.items()
    )
