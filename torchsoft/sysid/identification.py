"""`identify`: a plan of stages, the tests at their end, and the result with its notices;
`explain`."""

import platform
import sys
import time as clock
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field
from tqdm import tqdm

from torchsoft.parallel import single_threaded
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.colour import (
    allow_for_colour,
    colour_notices,
    rewhitened,
    spread,
    undeclared_colour,
)
from torchsoft.sysid.estimate import directions, estimates, nrmse, residual_channels
from torchsoft.sysid.fit import (
    FAR_OFF,
    Fit,
    Loss,
    Stage,
    Unreachable,
    covariance,
    fisher,
)
from torchsoft.sysid.plan import (
    FINER,
    JACOBIAN_ERROR,
    STEP_BIAS,
    default_plan,
    run_plan,
    settle,
    shown,
)
from torchsoft.sysid.prechecks import accepted, precheck
from torchsoft.sysid.prediction import run_doubts
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array
from torchsoft.sysid.refits import coarsened
from torchsoft.sysid.residual_tests import (
    judge_residuals,
    parts,
    residual_notices,
    systematic,
)
from torchsoft.sysid.result import (
    ChannelNoise,
    IdentificationResult,
    recorded_rigs,
    seen_together,
    undetermined,
)
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sensitivity import Checked, check_assumptions
from torchsoft.sysid.suspects import assumption_doubts, assumption_notices, unseen
from torchsoft.sysid.unknowns import Coordinates
from torchsoft.tables import SEED, Table, plain

RTOL = 1e-5
"""Relative tolerance of the last stage, at which derivatives are usually right to a tenth, and
estimates to a fraction of a standard deviation with sensors as good as `good_sensors`."""

PACKAGES = ("torchsoft", "torch", "numpy", "scipy", "llvmlite")
"""Packages whose versions a result records."""

Assumed = Literal["checked", "explained", "trusted"]
"""Whether assumptions are tested to first order, tested and followed by new fits that look for a
cause, or trusted."""


EFFORT = 4.0
"""Work of new fits, over that of the fit itself, after which `explain` begins no other."""


class Settings(Table):
    """Settings of a fit, which are arguments of `identify`."""

    rtol: float = Field(RTOL, ge=1e-8, le=1e-2)
    starts: int = Field(1, ge=1, le=2**20)
    loss: Loss = "linear"
    workers: int = Field(1, ge=1, le=1000)
    seed: int = Field(0, ge=0, le=SEED)
    tightenings: int = Field(2, ge=0, le=10)
    assumptions: Assumed = "checked"
    effort: float = Field(EFFORT, gt=0, le=1e6)


# Conclusion of a fit


def at_rest(planned: Fit, tightenings: int) -> Fit:
    """The fit of a plan, continued with its noise until its steps do not matter, with a tighter
    tolerance at most `tightenings` times."""
    check = partial(shown, "check of the steps", partial(settle, tightenings=tightenings))
    colour = partial(shown, "colour of the noise", allow_for_colour)
    fit = colour(planned)
    end = check(fit)
    if end.colour and len(end.stages) > len(fit.stages):
        end = check(colour(end))  # its noise was that of the residuals before
    return end


def is_hopeless(planned: Fit) -> bool:
    """Whether a fit is far above the noise, and not by its steps."""
    if planned.loss != "linear" or planned.chi2 <= FAR_OFF:
        return False
    fine = planned.residuals(steps=FINER * planned.rtol)
    return not fine.failed and float(np.mean(fine.r**2)) > FAR_OFF


def conclude(
    planned: Fit,
    settings: Settings,
    heldout: Sequence[str],
    acknowledged: Sequence[str],
    findings: list[str],
    rtol_asked: float,
    began: float,
) -> IdentificationResult:
    """The result, from the fit at the end of the plan. `findings` are sentences on the recordings,
    `rtol_asked` is the tolerance of the whole plan, `began` is on the clock [s]."""
    hopeless, linear = is_hopeless(planned), planned.loss == "linear"
    end = at_rest(planned, settings.tightenings if linear and not hopeless else 0)
    stalled = end.stalled or (hopeless and planned.stalled)  # whatever noise was found after that
    end = end._replace(stalled=stalled, converged=end.converged and not stalled)
    problem, x, at, rtol, free = end.problem, end.x, end.at, end.rtol, end.free
    c, fitted, runner = problem.coordinates, list(end.which), end.runner
    check, own = end.check, undeclared_colour(end)
    C_free, values, vectors = fisher(end.J)
    left = parts(problem, at.r, fitted)
    exact = np.concatenate([np.arange(0), *(part.rows for part in left)])  # not saturated
    rows = np.append(exact, np.arange(len(at.r) - len(c.priors), len(at.r)))
    whitened = float(at.r[rows] @ at.r[rows]) / max(len(rows) - int(free.sum()), 1)
    coloured = problem.with_noise({**problem.noise, **{k: one.noise for k, one in own.items()}})
    white = rewhitened(coloured, at, left)
    verdicts = judge_residuals(
        parts(coloured, white.r, fitted),
        white.r,
        white.J[:, free],
        robust=not linear,
        priors=[c.labels[i] for i, _ in c.priors] if end.converged else (),
    )
    larger = any(one.alarming and not (one.test == "level" and one.size < 1) for one in verdicts)
    bound = bool((free & c.at_bound(x)).any())
    doubtful = not end.converged or bool(own) or bound or larger
    checked = Checked([], np.zeros((len(at.r), 0)), end.J)
    if settings.assumptions != "trusted":
        effort = settings.effort if settings.assumptions == "explained" else 0.0
        checked = tested_assumptions(end, doubtful, effort)
    C, shift = np.zeros((len(x), len(x))), np.zeros(len(x)) if check.bias is None else check.bias
    C_fit = (
        C_free * max(1.0, whitened)
        if linear
        else covariance(end.J, at.r, end.loss, len(c.priors), exact)
    )
    C_fit = C_fit + spread(end.J, C_free, left, own)
    C[np.ix_(free, free)] = C_fit + checked.widening()
    found = estimates(end, C, shift)
    predicted, notices = {}, [*findings, *(planned if hopeless else end).notices]
    if heldout:
        held = problem.with_noise({}).residuals(runner, x, heldout, rtol)
        if held.failed:
            notices += [
                f"held-out recording `{k}` could not be simulated: {v.reason}"
                for k, v in held.failed.items()
            ]
        else:
            predicted = nrmse(problem, held.r, list(heldout))
            notices += guesses(problem, x, heldout)
    notices += run_notices(end)
    notices += notices_on(
        found,
        ordering_constraints(problem),
        end.converged or bool(check.rough) or hopeless or stalled,
        rtol,
        check.bias is None,
    )
    if hopeless:
        notices.append(
            f"steps were checked and not made finer, since chi2 = {planned.chi2:.3g} is "
            "far above the noise"
        )
    notices += rough_notices(c, check.rough)
    if check.jacobian_error > JACOBIAN_ERROR and not check.rough and not hopeless:
        notices.append(
            f"the tolerance rtol = {rtol:g} is too coarse for derivatives: their error is "
            f"{check.jacobian_error:.2g} of the noise, and estimates scatter more than their "
            f"intervals say; take rtol = {FINER * rtol:g}"
        )
    alarms = residual_notices(verdicts, max(1.0, whitened) ** 0.5 if linear else 1.0)
    against, plain = assumption_doubts(checked), not systematic(verdicts) and not checked.favoured
    notices += [*against, *assumption_notices(checked), *alarms.values()]
    notices += colour_notices(own)
    return IdentificationResult(
        estimates=found,
        labels=[*end.labels],
        x=[float(v) for v in x],
        correlation=(C_free / np.outer(end.sd, end.sd)).tolist(),
        directions=directions([*end.labels], values, vectors),
        chi2=sum(float(one.raw @ one.raw) for one in left) / max(len(exact) - int(free.sum()), 1),
        chi2_whitened=whitened,
        converged=end.converged,
        residuals=residual_channels(end),
        heldout=predicted,
        notices=notices,
        doubts=against + [text for kind, text in alarms.items() if kind != "smaller"],
        explained=plain or checked.explained,
        unseen=unseen(checked) if plain else [],
        stages=[*end.stages],
        cost={
            "simulations": runner.simulations,
            "jacobians": runner.jacobians,
            "remembered": runner.remembered,
            "samples": len(at.r),
            "wall_s": clock.perf_counter() - began,
            "data_seconds": sum(r.duration for r in problem.recordings if r.name in fitted),
        },
        made_by={
            "torchsoft": version("torchsoft"),
            **settings.model_dump(),
            "rtol": rtol,
            "rtol_asked": rtol_asked,
            "acknowledged": list(acknowledged),
            "untried": list(checked.untried),
            "late": list(checked.late),
            "candidates": list(checked.candidates),
            "unknowns": {name: u.model_dump() for name, u in problem.unknowns.items()},
            "sensors": {name: s.model_dump() for name, s in problem.sensors.items()},
            "recordings": {r.name: r.fingerprint for r in problem.recordings},
        },
        covariance=C.tolist(),
        recordings=recorded_rigs(end),
        unknowns=dict(problem.unknowns),
        sensors=dict(problem.sensors),
        coordinates=[replace(one, fixed=not is_free) for one, is_free in zip(c.all, free)],
        combinations=seen_together(end, C),
        noise=[
            ChannelNoise(name, model, [*end.colour[name].scores] if name in end.colour else [])
            for name, model in problem.noise.items()
        ],
        assumptions=checked.checks,
        versions={"python": platform.python_version()} | {one: version(one) for one in PACKAGES},
        rigs={recording.name: recording.rig for recording in problem.recordings},
    )


def run_notices(end: Fit) -> list[str]:
    """Warnings of the runs at the end of a fit, each of the first recording that has it."""
    found = dict[str, str]()
    for k, recording in enumerate(end.problem.recordings):
        if recording.name in end.which:
            with suppress(SimulationFailed):
                values, grid = end.problem.values(end.x, k), recording.grid(False)
                for text in run_doubts(recording.begin(), values, grid, end.rtol):
                    found.setdefault(text, f"the run of recording `{recording.name}`: {text}")
    return [*found.values()]


def tested_assumptions(end: Fit, doubtful: bool, effort: float) -> Checked:
    """Tests of the assumptions at the end of a fit."""
    return check_assumptions(coarsened(end), doubtful=doubtful, effort=effort)._replace(J=end.J)


def guesses(problem: Problem, x: Array, heldout: Sequence[str]) -> list[str]:
    """Sentences on held-out recordings that were predicted with parameters of their own, which no
    fitted recording determines."""
    out = []
    for k in (k for k, name in enumerate(problem.names) if name in heldout):
        mine = [
            c for c in problem.coordinates.all if c.recording == problem.names[k] and not c.fixed
        ]
        values = problem.values(x, k)
        if own := {c.name: values[c.name] for c in mine if c.kind == "parameter"}:
            out.append(
                f"held-out recording `{problem.names[k]}` is predicted with what is "
                f"{undetermined(own)}"
            )
    return out


NEXT_TO = 1e-2
"""Relative distance of an estimate at a bound from the known number that is the bound."""


def ordering_constraints(problem: Problem) -> dict[str, tuple[str, float]]:
    """Known numbers that unknown ones may not pass, such as mu_k of mu_s: name and value by the
    name of the unknown."""
    out, unknown = dict[str, tuple[str, float]](), problem.coordinates.names
    for recording in problem.recordings:
        for pair in recording.rig.ordered.items():
            for mine, other in (pair, pair[::-1]):
                if mine in unknown and other not in unknown:
                    out[mine] = other, recording.parameters[other]
    return out


def notices_on(
    found: list[Any],
    held: Mapping[str, tuple[str, float]],
    converged: bool,
    rtol: float,
    unchecked: bool,
) -> list[str]:
    """Sentences on unidentifiable estimates, active bounds, tolerance and convergence."""
    out = []
    for e in found:
        if not e.identifiable:
            change = (
                f"a change by {e.relative_sd:.0%}"
                if e.relative_sd < 9
                else "a change by a factor of ten"
            )
            out.append(
                f"{e.label} is not identifiable from these data: {change} would not show in them"
            )
        if e.at_bound and e.identifiable:
            other, value = held.get(e.name, ("", np.nan))
            remedy = "widen the bound or question the model"
            if np.isclose(e.last, value, rtol=NEXT_TO):
                remedy = f"{other} = {value:.4g}, which is known, holds it there; is that right?"
            out.append(f"{e.label} ended at a bound ({e.last:.4g}): {remedy}")
    movable = [e for e in found if e.identifiable and not e.at_bound]
    worst = max(movable, key=lambda e: abs(e.step_bias_sd), default=None)
    if unchecked:
        out.append(
            f"the tolerance rtol = {rtol:g} could not be checked: a run failed that was made to "
            "check it"
        )
    elif worst is not None and abs(worst.step_bias_sd) > STEP_BIAS:
        part = worst.step_bias_sd * worst.relative_sd
        size = f"{part:+.2%}"
        if abs(part) > 1:  # of a fault of a sensor that is next to nothing
            size = f"{part * abs(worst.last):+.2g} {worst.unit}"
        out.append(
            f"the tolerance rtol = {rtol:g} is too coarse for these data: it shifts {worst.label} "
            f"by {abs(worst.step_bias_sd):.2g} standard deviations ({size}); take rtol = "
            f"{FINER * rtol:g}"
        )
    if not converged:
        out.append("the last stage stopped before it converged: give it more evaluations")
    return out


def rough_notices(c: Coordinates, rough: Sequence[str]) -> list[str]:
    """A sentence on coordinates in which samples are not smooth at the end of the fit, with the
    remedy."""
    if not rough:
        return []
    remedy = "judge the intervals by profile likelihoods (torchsoft.sysid.profile)"
    if any(one.kind == "start" for one in c.all if one.label in rough):
        remedy = (
            "measure every coordinate of the bodies when the recording begins, say what is known "
            "of it by start.given, or begin at rest"
        )
    return [
        f"contact points touch, leave or begin to slip where the fit ended, and samples are not "
        f"smooth in {', '.join(rough[:3])}{', ...' if len(rough) > 3 else ''}: the fit has not "
        f"come to rest, and intervals may be too narrow; {remedy}"
    ]


# Identification and explanation


@single_threaded()
def identify(
    problem: Problem,
    *,
    rtol: float = RTOL,
    plan: Sequence[Stage] | None = None,
    starts: int = 1,
    loss: Loss = "linear",
    heldout: Sequence[str] = (),
    workers: int = 1,
    checkpoint: str | Path | None = None,
    progress: bool = False,
    seed: int = 0,
    tightenings: int = 2,
    assumptions: Assumed = "checked",
    effort: float = EFFORT,
    acknowledged: Sequence[str] = (),
) -> IdentificationResult:
    """Find the unknown parameters of `problem`, with intervals, and find which of them the data do
    not determine.

    Every stage of the `plan` (`default_plan` by default, whose first stage is begun from `starts`
    Sobol points by `seed`) freezes the steps that its tolerance chooses at its start, one sequence
    a recording, so that residuals are smooth in the unknowns. `rtol` is the last stage's. At the
    end a run with a tenth of it tells how far the steps shift the estimates: where that is more
    than `STEP_BIAS` standard deviations, the fit goes on with a tenth of the tolerance, up to
    `tightenings` times (with the linear loss). `loss` is scipy's robust loss. Recordings named in
    `heldout` are predicted, not fitted; `workers` threads run side by side. With a `checkpoint`
    folder every run is kept there: an identification that was interrupted, called again with the
    same arguments, continues where it was.

    At the end the assumptions (mesh, place of the disc, numbers that are called
    known, faults of sensors, the friction law) are tested to first order, a run each, and intervals
    allow for constants of the computation that the data cannot tell. Where no test explains a
    misfit, a notice names the candidates, and `explain` tries them, until new fits took `effort`
    times the work of the fit itself. Before the fit recordings are held against what such a rig can
    do at all: signs, units, delays, zeros, set-points, the body that a loop senses; `acknowledged`
    names findings that are no mistakes. With `assumptions` = "trusted" the tests at the end are
    left out, but not the checks of the recordings.

    Raises `ValueError` for what `Settings` does not take, and for recordings that are not there or
    cannot be what they are taken for, `Unreachable` where the model cannot follow the data.
    """
    unknown = set(heldout) - set(problem.names)
    if unknown or len(set(heldout)) == len(problem.recordings):
        raise ValueError(
            f"`heldout` must name some of {list(problem.names)}, but not all; it is {list(heldout)}"
        )
    settings = Settings(
        rtol=rtol,
        starts=starts,
        loss=loss,
        workers=workers,
        seed=seed,
        tightenings=tightenings,
        assumptions=assumptions,
        effort=effort,
    )
    if plan is not None and (starts > 1 or rtol not in (RTOL, *(stage.rtol for stage in plan))):
        raise ValueError(
            "`starts` and `rtol` are those of the default plan: say them of the stages of `plan` "
            "instead"
        )
    fitted, began = [name for name in problem.names if name not in heldout], clock.perf_counter()
    runner = Runner(
        problem.recordings, workers, Path(checkpoint) if checkpoint is not None else None
    )
    findings = accepted(precheck(problem, runner, fitted), acknowledged)
    for look in findings if progress else ():
        tqdm.write(plain(f"note: {look}"), file=sys.stderr)
    try:
        if plan is None:
            plan = default_plan(problem, runner, rtol, fitted, starts)
        start = problem.coordinates.start
        begin = Fit(problem, runner, start, loss=loss, progress=progress)
        planned = run_plan(begin, plan, seed=seed)
    except Unreachable as error:  # what looked wrong with the recordings may be behind it
        raise Unreachable(error.failed, findings) from None
    return conclude(planned, settings, heldout, acknowledged, findings, plan[-1].rtol, began)


def explain(problem: Problem, **options: Any) -> IdentificationResult:
    """Identify, and look for the cause of a misfit that no test of an assumption explains to first
    order.

    The fit is repeated without one assumption after the other (another law, number, mesh, place,
    sensor) until one explains the data, or until new fits took `effort` times the work of the fit:
    notices name the assumptions that are left then. Progress names each. Takes the arguments of
    `identify`, and with its `checkpoint` begins where that ended; Ctrl-C keeps what
    was tried. Raises what `identify` does.
    """
    return identify(problem, **options, assumptions="explained")
