"""Recordings and problems as files state them, and the cost of an identification.

Every error is a `ValueError` in a sentence that names the file, and the row and column or the
field.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path

from torchsoft.cost import RUN, Cost, rig_row, rig_step, steps_per_second
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import at_field
from torchsoft.sysid.columns import Tables, read_tables
from torchsoft.sysid.configuration import Config, Entry, Law, read_config
from torchsoft.sysid.fit import Unreachable
from torchsoft.sysid.plan import ALL, FINER, FIRST, FREE, LAST, LOOSE, USUAL
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.rig_recordings import rig_recording, vocabulary
from torchsoft.tables import line

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
    try:
        file = RigFile.from_toml(config.parent / stated.rig)
        columns = vocabulary(file.assemble(), stated.columns)
    except ValueError as error:
        raise ValueError(f"{config}, rig: {error}") from None
    except OSError as error:
        raise ValueError(f"{config}, rig: {stated.rig}: {error.strerror}") from None
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

    def problem(law: Law, what: str) -> Problem:
        made = []
        for name, (entry, _) in entries.items():
            settings = (stated.settings, entry.settings, law.settings)
            try:
                with at_field("settings"):
                    mine = reduce(lambda one, given: one.override(**given), settings, file)
                start = entry.start or stated.start
                made.append(rig_recording(mine, tables[name], name, stated.sensors, start))
            except ValueError as error:
                known = any(str(table.path) in str(error) for table in tables[name].tables)
                raise (
                    error if known else ValueError(f"{config}{what}, recording `{name}`: {error}")
                ) from None
        unknowns = {k: one for k, one in (stated.unknowns | law.unknowns).items()
                    if k not in law.without}  # fmt: skip
        try:
            return Problem(made, stated.sensors, unknowns)
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


def unreachable(error: Unreachable, tables: Mapping[str, Tables]) -> str:
    """Which recording the model could not follow, and the row of its file where the run ended."""
    return "; ".join(
        f"{tables[name].near(lost.time)}: the model cannot follow recording `{name}` here: "
        f"{lost.reason}"
        for name, lost in error.lost.items()
    )
