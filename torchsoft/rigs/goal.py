"""Goal of a rig file's motion, from a TOML file, and the plan that reaches it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from torchsoft.physics.rig import Rig
from torchsoft.plan import Bounds, Limit, Plan, Target, plan
from torchsoft.plan.knots import Range, knots
from torchsoft.plan.planning import RTOL, Method, misses
from torchsoft.plan.problem import Terms
from torchsoft.plan.search import SLACK
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import at_field
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import simulate
from torchsoft.tables import SEED, Table, from_toml

Name = Annotated[str, Field(min_length=1)]


class Goal(Table):
    """Goal of a run of a rig file. The plan keeps it for the stated values of `uncertain`
    parameters and for random draws of them."""

    free: dict[Name, Bounds | Range] = Field(min_length=1)
    """motions and parameters of the rig file that the plan may change, by name; parameters have
    `low` and `high` only"""
    targets: dict[Name, Target] = Field(min_length=1)
    """targets of channels, by a name of your choice"""
    limits: dict[Name, Limit] = Field(default_factory=dict)
    """limits of channels, by a name of your choice"""
    uncertain: dict[Name, Range] = Field(default_factory=dict)
    """ranges of parameters that are not known exactly, by name"""
    draws: int = Field(default=8, ge=1, le=10_000)
    """random values of the uncertain parameters that the plan takes into account"""
    method: Method = "slsqp"
    """optimiser: "slsqp" uses sequential quadratic programming, "adam" first-order steps"""
    iterations: int = Field(default=50, ge=1, le=100_000)
    """iterations at most"""
    starts: int = Field(default=1, ge=1, le=4096)
    """number of initial plans"""
    seconds: float = Field(default=1e6, gt=0)
    """time after which the search stops [s]"""
    rtol: float = Field(default=RTOL, ge=1e-7, le=1e-2)
    """relative tolerance of the simulations [1]"""
    seed: int = Field(default=0, ge=0, le=SEED)
    """seed of the initial plans and of the draws"""

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read from a TOML file. Raises `InvalidTable` in one sentence."""
        return from_toml(path, cls.model_validate)


Draws = Mapping[str, Sequence[float] | NDArray[np.float64]]
"""Draws (1 + count,) of parameters of a rig file by name, the estimates first."""


class Planned(NamedTuple):
    """A plan, and the rig file that carries it out."""

    plan: Plan
    file: RigFile


def drawn(
    file: RigFile, goal: Goal, count: int, seed: int, known: Draws | None = None
) -> dict[str, Tensor]:
    """Draws (1 + count, ...) of the uncertain parameters by name, the stated values first, with the
    draws of `known` as given. Raises `ValueError`."""
    rng, every, known = np.random.default_rng(seed), list[Rig](), known or {}
    if twice := known.keys() & goal.uncertain.keys():
        raise ValueError(f"uncertain.{min(twice)} is drawn by the identification; leave it out")
    for i in range(1 + count):
        values = {name: rng.uniform(one.low, one.high) for name, one in goal.uncertain.items()}
        values = (values if i else {}) | {name: float(one[i]) for name, one in known.items()}
        with at_field("uncertain"):
            every.append(file.override(values).assemble())
    return {
        name: torch.stack([one.parameter(name).detach() for one in every])
        for name in (*goal.uncertain, *known)
    }


def plan_file(
    file: RigFile, goal: Goal, known: Draws | None = None, *, progress: bool = False
) -> Planned:
    """The plan that reaches a goal, and the rig file with it. `known` are draws of the parameters
    that an identification of the file left uncertain (`IdentificationResult.draws`), `goal.draws`
    of them after the estimates; the written file has the estimates.

    Raises `ValueError` for names that the rig or its run does not have, and where no start can be
    run.
    """
    if known:
        with at_field("uncertain"):
            file = file.override({name: float(one[0]) for name, one in known.items()})
    over = drawn(file, goal, goal.draws, goal.seed, known) if goal.uncertain or known else {}
    built = file.build()
    found = plan(
        built.rig, built.t, goal.free, targets=goal.targets, limits=goal.limits,
        y0=built.initial, over=over, method=goal.method,
        iterations=goal.iterations, starts=goal.starts, seconds=goal.seconds, rtol=goal.rtol,
        seed=goal.seed, progress=progress,
    )  # fmt: skip
    moved = [name for name, one in goal.free.items() if isinstance(one, Bounds)]
    numbers = {name: value.tolist() for name, value in found.parameters.items()}
    written = file.override(motion=knots(found.reference, moved)).override(numbers)
    return Planned(run_again(found, written, goal), written)


def run_again(found: Plan, written: RigFile, goal: Goal) -> Plan:
    """The plan, its first draw judged by a run of the file that carries it out.

    That run differs where the file makes something anew with the planned values: "rest", "held" and
    "auto".
    """
    try:
        built = written.build()
        run = simulate(built.rig, built.t, y0=built.y0, rtol=found.made_by["checked_rtol"])
        terms = Terms(None, goal.targets, goal.limits)
        _, errors, excess = (part.detach() for part in terms.of(run))
    except (ValueError, SimulationFailed) as failure:
        reason = f"the written file cannot be run: {failure}"
        return replace(found, reached=False, reasons=(*found.reasons, reason))
    found = replace(found, trajectory=run)
    for numbers, values in ((found.errors, errors), (found.excess, excess)):
        for one, now in zip(numbers.values(), values):
            one[0] = now
    if not found.reached or bool((errors.abs() <= 1).all() and (excess <= SLACK).all()):
        return found
    reason = (
        'the plan\'s own run keeps them: the file makes "rest", "held" or "auto" anew with what '
        "was planned; give numbers in their place"
    )
    reasons = (*found.reasons, *misses(found.errors, found.excess), reason)
    return replace(found, reached=False, reasons=reasons)
