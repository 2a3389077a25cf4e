"""`plan`: the free variables of a rig that reach targets within limits, by exact gradients."""

import time as clock
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from torchsoft.display import Shown, hidden
from torchsoft.physics.arguments import Numbers, tensor, whole
from torchsoft.physics.energy import SLIPPING
from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig
from torchsoft.plan.problem import Evaluation, Evaluator, Free, Term, Terms, Variables
from torchsoft.plan.search import SLACK, Criterion, Search, Stopped, Visit, adam
from torchsoft.plan.sqp import slsqp
from torchsoft.solve.simulate import Start, started
from torchsoft.solve.trajectory import Trajectory

RTOL = 1e-4
"""Relative tolerance of runs in a search."""

CHECK = 0.01
"""Relative tolerance of the run that checks a plan, over that of the search."""

POLISH = 0.1
"""Relative tolerance of a second search, over that of the first, where the check fails."""

LOADED = 0.01
"""Part of its largest normal force above which a contact carries load."""

Method = Literal["slsqp", "adam"]


@dataclass(frozen=True, repr=False)
class Plan(Shown):
    """A plan, and its provenance.

    `reference` and `parameters` are the planned motion and parameters. `reached` is whether every
    target and limit is kept in the first draw, by runs of a hundredth of the tolerance; `holds` is
    the fraction of draws in which they are. `errors` holds the errors of targets over their
    tolerance and `excess` that of limits over their scale, (draws,) by name. `trajectory` is the
    run of the first draw. `reasons` names missed targets and their obstacles, `notices` other facts
    about the search.
    """

    rig: Rig = field(repr=False)
    reference: Reference
    parameters: dict[str, Tensor]
    trajectory: Trajectory
    value: float
    errors: dict[str, Tensor]
    excess: dict[str, Tensor]
    reached: bool
    holds: float
    reasons: tuple[str, ...]
    notices: tuple[str, ...]
    history: tuple[Visit, ...]
    made_by: dict[str, Any]

    def summary(self) -> dict[str, Any]:
        """The plan as JSON."""
        return {
            "reached": self.reached, "holds": self.holds, "value": self.value,
            "errors": {name: e.tolist() for name, e in self.errors.items()},
            "excess": {name: e.tolist() for name, e in self.excess.items()},
            "reasons": self.reasons, "notices": self.notices,
            "parameters": {name: value.tolist() for name, value in self.parameters.items()},
            "history": [one._asdict() for one in self.history], "made_by": self.made_by,
        }  # fmt: skip

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        rows = [
            *((name, f"{float(e[0]):+z.2f} tolerances off") for name, e in self.errors.items()),
            *((name, f"{float(e[0]):+.2%} beyond") for name, e in self.excess.items() if e[0] > 0),
            *(("not reached", reason) for reason in self.reasons),
            *(("note", notice) for notice in self.notices),
        ]
        kept = "reached" if self.reached else "NOT reached"
        draws = max(map(len, (*self.errors.values(), *self.excess.values())), default=1)
        holds = f", holds in {self.holds:.0%} of {draws} draws" if draws > 1 else ""
        cost = f"{self.made_by['evaluations']} evaluations, {self.made_by['wall_s']:.1f} s"
        return f"Plan: {kept}{holds}; {cost}", rows


def plan(
    rig: Rig, t: Numbers, free: Free, *, objective: Term | None = None,
    targets: Mapping[str, Term] | None = None, limits: Mapping[str, Term] | None = None,
    y0: Numbers | Start, reference: Reference | None = None,
    over: Mapping[str, Numbers] | None = None,
    method: Method = "slsqp", iterations: int = 50, rate: float = 0.02,
    starts: int = 1, seconds: float = float("inf"), rtol: float = RTOL, seed: int = 0,
    progress: bool = False,
) -> Plan:  # fmt: skip
    """Choose the free variables of a rig so that its run from y0 (size,) over the times t (T,) [s]
    reaches all targets within all limits. A `y0` that is a function of the rig, such as
    `BuiltRig.initial`, is evaluated at the parameters of every run.

    `free` names motions, with `Bounds` of their knots, and parameters of any shape, with their
    least and largest value (infinite ones are allowed). `objective` (a number, which is lowered),
    `targets` (errors over a tolerance, which are brought to zero) and `limits` (excess over a
    scale, which is kept from being positive) are functions in torch of a `Trajectory`, such as
    `Target` and `Limit`, by name. Without an objective the plan is the one nearest to the motion
    given, by half the squared change of the variables in units of the speed or range allowed.

    `over` holds draws of uncertain parameters by name (draws, ...), y0 their starts (draws, size)
    if these differ, the first draw being the nominal one. The mean error of every target is brought
    to zero, or within a quarter of the tolerance where there are more targets than free values, and
    the spread of errors lowered with the objective's mean. Limits are kept in every draw.

    "slsqp" takes up to `iterations` steps of sequential quadratic programming; "adam" as many
    steps of Adam at `rate`, projected onto the bounds, with squared errors and excess as a price:
    for networks. It begins at the best of `starts`: the values given, and points of Sobol's
    sequence. A run that fails is worse than any other. The search ends after `seconds`, and on
    Ctrl-C, with the best plan so far.

    Raises `ValueError` for arguments that do not fit together, and where no start can be run.
    """
    t, y0 = tensor("t", t), y0 if callable(y0) else tensor("y0", y0)
    if method not in get_args(Method):
        raise ValueError(f"`method` must be one of {', '.join(get_args(Method))}, not {method!r}")
    whole("iterations", iterations, 1)
    whole("starts", starts, 1)
    if objective is None and not targets:
        raise ValueError("nothing to plan for: give an `objective`, `targets` or both")
    drawn = {name: tensor(f"over[{name!r}]", values) for name, values in (over or {}).items()}
    followed = rig.reference if reference is None else reference
    variables = Variables(rig, followed, free, float(t[-1]))
    terms = Terms(objective, targets or {}, limits or {})
    evaluator = Evaluator(rig, t, variables, terms, y0, drawn, rtol)
    change = 1.0 if objective is None else 0.0
    notices, checked = list[str](), None
    with tqdm(desc="plan", unit=" evaluations", disable=hidden(progress)) as bar:
        criterion = Criterion(variables, change)
        search = Search(evaluator, criterion, seconds, bar)
        try:
            search.begin(starts, seed)
            if method == "slsqp":
                slsqp(search, search.found.z, iterations)
            else:
                adam(search, search.found.z, iterations, rate)
            checked = evaluator.evaluate(search.found.z, CHECK * rtol, gradient=False)
            if method == "slsqp" and not kept(checked)[:1].all():
                search.refine(POLISH * rtol)
                slsqp(search, search.found.z, iterations)
        except KeyboardInterrupt:
            if search.best is None:
                raise
            notices.append(f"interrupted after {evaluator.evaluations} evaluations")
        except Stopped:
            notices.append(f"ended after {seconds:g} s, as was asked for")
    if search.failures:
        notices.append(
            f"{len(search.failures)} plans could not be run, the first: {search.failures[0]}"
        )
    return finished(search, checked, rig, notices, {
        "torchsoft": version("torchsoft"), "method": method,
        "free": {k: tuple(v) if isinstance(v, tuple) else v.model_dump() for k, v in free.items()},
        "draws": evaluator.draws, "iterations": iterations, "starts": starts, "rtol": rtol,
        "seed": seed,
    })  # fmt: skip


def kept(evaluation: Evaluation) -> NDArray[np.bool_]:
    """Mask of the draws (draws,) with every target and limit kept; False for a failed run."""
    if evaluation.failure:
        return np.zeros(1, bool)
    return np.logical_and(
        (np.abs(evaluation.errors) <= 1).all(axis=1), (evaluation.excess <= SLACK).all(axis=1)
    )


def finished(
    search: Search,
    checked: Evaluation | None,
    rig: Rig,
    notices: list[str],
    made_by: dict[str, Any],
) -> Plan:
    """The best plan of a search, judged by a run of a finer tolerance: `checked`, if that is of
    this plan. A plan whose finer run fails is not reached."""
    evaluator, z = search.evaluator, search.found.z
    rtol = CHECK * made_by["rtol"]
    if checked is None or not np.array_equal(checked.z, z):
        checked = evaluator.evaluate(z, rtol, gradient=False)
    evaluation, held = checked, kept(checked)
    if evaluation.failure:
        notices.append(f"by rtol = {rtol:g} a run fails: {evaluation.failure}")
        evaluation = search.found
    assert evaluation.batch is not None
    run = next(one for one in evaluation.batch.trajectories if one is not None)
    errors, excess = (
        {name: torch.from_numpy(column) for name, column in zip(names, values.T)}
        for names, values in zip(
            evaluator.terms.labels(run), (evaluation.errors, evaluation.excess)
        )
    )
    reasons = [] if held[0] else [*misses(errors, excess), *obstacles(search, run)]
    variables, now = evaluator.variables, torch.from_numpy(z)
    planned, parameters, start = deepcopy(rig), variables.parameters(now), evaluator.starts[0]
    with torch.no_grad():
        for name, value in parameters.items():
            planned.parameter(name).copy_(value)
    start = started(planned, start, "none") if callable(start) else start
    planned.reference = reference = variables.reference(now, start.reference)
    return Plan(
        rig=planned, reference=reference, parameters=parameters, trajectory=run,
        value=float(evaluation.value.mean()),
        errors=errors, excess=excess, reached=bool(held[0]), holds=float(held.mean()),
        reasons=tuple(reasons), notices=tuple(notices), history=tuple(search.history),
        made_by=made_by | {
            "evaluations": evaluator.evaluations, "wall_s": clock.perf_counter() - search.began,
            "checked_rtol": rtol,
        },
    )  # fmt: skip


def misses(errors: Mapping[str, Tensor], excess: Mapping[str, Tensor]) -> list[str]:
    """Sentences on targets and limits that the first draw misses."""
    off = {name: float(e[0]) for name, e in errors.items() if abs(float(e[0])) > 1}
    over = {name: float(e[0]) for name, e in excess.items() if float(e[0]) > SLACK}
    return [
        *(f"{name} is {error:+.3g} tolerances off" for name, error in off.items()),
        *(f"{name} is exceeded by {part:.2%}" for name, part in over.items()),
    ]


def obstacles(search: Search, run: Trajectory) -> list[str]:
    """What holds the best plan of a search back: too few free values, active bounds, slip while it
    may move, and a run that fails."""
    variables, targets = search.evaluator.variables, search.found.errors.shape[1]
    since = min((one.after for one in variables.moves.bounds.values()), default=0.0)
    few = (
        f"free: more targets ({targets}) than values ({variables.n}): add knots, or free a "
        "parameter"
    )
    return [
        *([few] if variables.n < targets else []),
        *variables.active(search.found.z),
        *slips(run, since),
        *(f"further on a run fails: {reason}" for reason in search.failures[-1:]),
    ]


def slips(run: Trajectory, since: float) -> list[str]:
    """Sentences on contacts whose points all slip under load at some time from `since` [s] on."""
    out = []
    for name, state in run.contact_state.items():
        load = run.force[name][..., 0].sum(-1)
        gross = (
            (run.t >= since)
            & (load > LOADED * load.max())
            & ((state == SLIPPING) | (state == 0)).all(-1)
        )
        if bool(gross.any()):
            first, last = run.t[gross][[0, -1]].tolist()
            out.append(
                f"every touching point of the contact `{name}` slips at some time from "
                f"{first:.3g} to {last:.3g} s: press harder, go slower, or take more friction"
            )
    return out
