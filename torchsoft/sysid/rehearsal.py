"""Rehearsal of an experiment: its recordings are simulated, with the sensors' noise, before anyone
builds it, and what would be identified from them shows what the experiment is good for."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from torchsoft.files import replacing
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import at_field
from torchsoft.solve.simulate import simulate
from torchsoft.sysid.configuration import Config, Entry, Rest
from torchsoft.sysid.rig_recordings import vocabulary
from torchsoft.sysid.unknowns import Unknown, by_channel

FINER = 0.1
"""Tolerance of the simulated experiment, in parts of the fit's."""


def rehearsed(config: Path, stated: Config, out: Path) -> tuple[Config, list[Path]]:
    """Simulate the recordings of a configuration, of the rig as its file has it, and write them to
    `out` as CSV files, the templates of those to record.

    Returns the configuration of their identification, whose search begins away from the truth, and
    the files. Raises `ValueError`, and `SimulationFailed` for a motion that the rig cannot do.
    """
    if stated.rig is None:
        raise ValueError(
            f'{config}: a rehearsal simulates the rig of a file: say rig = "FILE.toml"'
        )
    file, plan = RigFile.from_toml(config.parent / stated.rig), stated.rehearsal
    entries = stated.recordings or (Entry(name="rehearsal"),)
    paths, random = [], np.random.default_rng(plan.seed)
    for entry in entries:
        name = entry.name or Path(entry.paths[0]).stem
        with at_field("settings"):
            mine = file.override(**stated.settings).override(**entry.settings)
        rig, y0, _ = mine.build()
        known, start = vocabulary(rig, stated.columns), entry.start or stated.start
        duration = mine.outputs.duration if plan.duration is None else plan.duration
        at = np.arange(0.0, duration + 0.5 / plan.rate, 1.0 / plan.rate)
        lead = start.lead if isinstance(start, Rest) else 0.0
        t = torch.from_numpy(np.append([-lead] if lead else [], at))
        run = simulate(rig, t, y0=y0, rtol=FINER * stated.fit.rtol)
        columns = {"t": at}
        sensors = by_channel([rig], stated.sensors)
        for channel in (*known.signals, *sensors):
            if channel not in run.channels and channel not in run.touch:
                raise ValueError(f"{config}: sensors: the rig has no channel `{channel}`")
            columns[channel] = run[channel].detach().numpy()[-len(at) :].copy()
        for channel, sensor in sensors.items():
            columns[channel] += sensor.noise * random.standard_normal(len(at))
        headings = {of: heading for heading, of in known.headings.items()}
        head = ",".join(f"{headings.get(one, one)} [{known.units[one]}]" for one in columns)
        paths.append(out / f"{name}.csv")
        with replacing(paths[-1]) as partial:
            table = np.stack(list(columns.values()), 1)
            np.savetxt(partial, table, "%.12g", ",", header=head, comments="", encoding="utf-8")
    own = [
        entry.model_copy(update={"name": path.stem, "file": None, "files": ()})
        for entry, path in zip(entries, paths)
    ]
    unknowns = dict(away(stated.unknowns, file, plan.away))
    return stated.model_copy(update={"recordings": tuple(own), "unknowns": unknowns}), paths


def away(
    unknowns: dict[str, Unknown], file: RigFile, factor: float
) -> Iterator[tuple[str, Unknown]]:
    """The unknowns, those whose start is not stated off by a factor, up and down in turns. Numbers
    that bound each other stay."""
    rig = file.assemble()
    bound = {name for pair in rig.ordered.items() for name in pair}
    for k, (name, one) in enumerate(unknowns.items()):
        free = one.nominal is None and one.ratio_to is None and not one.fixed and name not in bound
        if free and one.scale == "log":
            value = rig.parameter(name).item() * factor ** (-1) ** k
            low, high = one.low or 0.0, np.inf if one.high is None else one.high
            one = one.model_copy(update={"nominal": float(np.clip(value, low, high))})
        yield name, one
