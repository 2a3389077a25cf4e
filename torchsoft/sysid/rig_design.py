"""Design of a rig file's motion for an identification: a ranking of candidates, and the best one's
knots moved by gradient, by one criterion."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchsoft.plan.knots import Moves, knots
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import at_field
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.configuration import Config
from torchsoft.sysid.criterion import Optimality
from torchsoft.sysid.design import RTOL, Design, design
from torchsoft.sysid.planner import Planner, Range
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.rehearsal import planned
from torchsoft.sysid.unknowns import Sensor, Unknown
from torchsoft.tables import line

AS_STATED = "as stated"
"""Name of the candidate that is the motion of the rig file itself."""


@dataclass(frozen=True)
class Rated:
    """A rated candidate: the criterion, a logarithm of standard deviations, the smaller the better;
    the relative standard deviations of the parameters, and the largest fraction of their limits
    that channels reach. `lost` is the reason of a failed run."""

    name: str
    value: float
    deviations: dict[str, float]
    peaks: dict[str, float]
    lost: str = ""

    @property
    def score(self) -> float:
        """The criterion; infinite beyond a limit."""
        beyond = self.lost or max(self.peaks.values(), default=0.0) > 1
        return np.inf if beyond else self.value


class Chosen(NamedTuple):
    """The candidates, the best first; the rig file with the best motion, and its design if knots
    were moved."""

    rated: list[Rated]
    file: RigFile
    found: Design | None

    def table(self) -> str:
        """A line for each candidate."""
        names = list(next((one.deviations for one in self.rated if not one.lost), {}))
        width = max([len(one.name) for one in self.rated] + [9])
        rows = [f"{'candidate':{width}s} criterion  {'  '.join(names)}"]
        for one in self.rated:
            cells = [f"{one.deviations.get(name, np.nan):{len(name)}.2%}" for name in names]
            said = f"cannot be made: {line(one.lost, 120)}" if one.lost else "  ".join(cells)
            limit = [f"{k} goes beyond its limits" for k, part in one.peaks.items() if part > 1]
            rows.append("  ".join([f"{one.name:{width}s} {one.value:9.3f}", said, *limit]))
        return "\n".join(rows)

    def summary(self) -> dict[str, Any]:
        """Content of `design.json`."""
        out: dict[str, Any] = {"candidates": [asdict(one) for one in self.rated]}
        if self.found is not None:
            one = self.found
            out |= {
                "before": one.before, "after": one.after, "limits": one.limits,
                "history": [asdict(visit) for visit in one.history], "notices": one.notices,
                "made_by": one.made_by,
            }  # fmt: skip
        return out


def rank(
    recorded: Sequence[Recording], candidates: Sequence[Recording], sensors: dict[str, Sensor],
    unknowns: dict[str, Unknown], *, limits: Mapping[str, Range] | None = None,
    criterion: Optimality = "D", names: Sequence[str] | None = None, rtol: float = RTOL,
    workers: int = 1,
) -> list[Rated]:  # fmt: skip
    """Candidates for the next recording, the best first: by the uncertainty of the parameters
    `names` (all by default), at their nominal values, from each together with what is `recorded`.

    Only the times of a candidate's samples count. `limits` are ranges (low, high) [unit] of
    channels. Raises `ValueError` for candidates that do not fit the problem.
    """
    rated = list[Rated]()
    for one in candidates:
        problem = Problem([*recorded, one], sensors, unknowns)
        planner = Planner(
            problem, one.name, Moves(one.rig.reference, {}, 0.0), limits or {}, criterion, names,
            rtol, workers,
        )  # fmt: skip
        x = problem.coordinates.start
        try:
            seen = planner.evaluate(np.zeros(0), x)
        except SimulationFailed as failure:
            rated.append(Rated(one.name, np.inf, {}, {}, str(failure)))
        else:
            rated.append(Rated(one.name, seen.value, planner.deviations(x, seen), seen.peaks))
    return sorted(rated, key=lambda one: (one.score, one.value))


def choose(
    config: Path, stated: Config, recorded: Sequence[Recording] = (), *, workers: int = 1,
    progress: bool = False,
) -> Chosen:  # fmt: skip
    """Rank a configuration's candidates for the motion by the uncertainty of its unknowns, together
    with the recordings in `recorded`, and move the knots of the best one that `bounds` name.

    The rig is that of its file. Raises `ValueError` for parts that do not fit together, and where
    no candidate can be run.
    """
    plan = stated.design
    with at_field("settings"):
        file = RigFile.from_toml(config.parent / stated.rig).override(**stated.settings)
    files, made, lost = dict[str, RigFile](), dict[str, Recording](), list[Rated]()
    for name, settings in ({AS_STATED: {}} | plan.candidates).items():
        with at_field(f"design.candidates.{name}"):
            files[name] = file.override(**settings)
            built = files[name].build()
        try:
            made[name] = planned(stated, files[name], built, name, plan.rtol, noise=0.0)
        except SimulationFailed as failure:
            lost.append(Rated(name, np.inf, {}, {}, str(failure)))
    common: dict[str, Any] = {
        "limits": plan.limits, "criterion": plan.criterion, "names": plan.parameters or None,
        "rtol": plan.rtol, "workers": workers,
    }  # fmt: skip
    rated = rank(recorded, [*made.values()], stated.sensors, stated.unknowns, **common) + lost
    best = rated[0].name
    if rated[0].lost:
        raise ValueError(f"{config}: no candidate can be made: {rated[0].lost}")
    found, chosen = None, files[best]
    if plan.bounds:
        problem = Problem([*recorded, made[best]], stated.sensors, stated.unknowns)
        found = design(
            problem, best, plan.bounds, iterations=plan.iterations, seed=plan.seed,
            progress=progress, **common,
        )  # fmt: skip
        chosen = chosen.override(motion=knots(found.recording.rig.reference, plan.bounds))
    return Chosen(rated, chosen, found)
