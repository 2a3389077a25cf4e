"""Rehearsal of an experiment: simulated recordings with the sensors' noise, whose identification
shows the information of the experiment before it is built."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsoft import csvfile
from torchsoft.physics.statics import BuiltRig
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import at_field
from torchsoft.sysid.configuration import Beginning, Config, Entry, Rest
from torchsoft.sysid.initial_state import Standing
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.rig_recordings import vocabulary
from torchsoft.sysid.synthetic import record
from torchsoft.sysid.unknowns import Unknown

FINER = 0.1
"""Tolerance of the simulated experiment, over the fit's."""


def planned(
    stated: Config, file: RigFile, built: BuiltRig[Any], name: str, rtol: float,
    start: Beginning | None = None, **how: Any,
) -> Recording:  # fmt: skip
    """A planned recording of a file's rig, `built`, by a configuration, from a run with the
    tolerance `rtol`; `how` are further arguments of `record`. Raises `ValueError`, and
    `SimulationFailed`."""
    plan, start = stated.rehearsal, start or stated.start
    if plan.duration is not None:
        built = built._replace(t=torch.tensor([0.0, plan.duration]).double())
    lead = start.lead if isinstance(start, Rest) else 0.0
    at_rest = Standing.of(built.rig, built.y0, lead, file.rests())
    return record(name, built, {}, stated.sensors, start=at_rest, rate=plan.rate, rtol=rtol, **how)


def rehearsed(config: Path, stated: Config, out: Path) -> tuple[Config, list[Path]]:
    """Simulate the recordings of a configuration, with the parameters of its rig file, and write
    them to `out` as CSV files, which are templates of those to record.

    Returns the configuration of their identification, whose search begins away from the truth, and
    the files. Raises `ValueError`, and `SimulationFailed` for a motion that the rig cannot follow.
    """
    file, plan = RigFile.from_toml(config.parent / stated.rig), stated.rehearsal
    entries = stated.recordings or (Entry(name="rehearsal"),)
    paths, random = [], np.random.default_rng(plan.seed)
    for entry in entries:
        name = entry.name or Path(entry.paths[0]).stem
        with at_field("settings"):
            mine = file.override(**stated.settings).override(**entry.settings)
        built = mine.build()
        known, rtol = vocabulary(built.rig, stated.columns), FINER * stated.fit.rtol
        try:
            made = planned(stated, mine, built, name, rtol, entry.start, seed=random)
        except ValueError as error:
            raise ValueError(f"{config}: {error}") from None
        rig = made.rig
        followed = rig.follow(torch.from_numpy(made.times)).detach()[..., 0].numpy().T
        columns = {"t": made.times} | dict(zip(rig.signals, followed))
        columns |= {channel: y for channel, (_, y) in made.samples.items()}
        called = {of: heading for heading, of in known.headings.items()}
        units = {called.get(one, one): known.units[one] for one in columns}
        paths.append(out / f"{name}.csv")
        csvfile.write(paths[-1], dict(zip(units, columns.values())), units)
    own = [
        entry.model_copy(update={"name": path.stem, "file": None, "files": ()})
        for entry, path in zip(entries, paths)
    ]
    unknowns = dict(away(stated.unknowns, file, plan.away))
    return stated.model_copy(update={"recordings": tuple(own), "unknowns": unknowns}), paths


def away(
    unknowns: dict[str, Unknown], file: RigFile, factor: float
) -> Iterator[tuple[str, Unknown]]:
    """The unknowns, with unstated starts moved by a factor, up and down in turns. Parameters that
    bound each other stay."""
    rig = file.assemble()
    bound = {name for pair in rig.ordered.items() for name in pair}
    for k, (name, one) in enumerate(unknowns.items()):
        free = one.nominal is None and one.ratio_to is None and not one.fixed and name not in bound
        if free and one.scale == "log":
            value = rig.parameter(name).item() * factor ** (-1) ** k
            low, high = one.low or 0.0, np.inf if one.high is None else one.high
            one = one.model_copy(update={"nominal": float(np.clip(value, low, high))})
        yield name, one
