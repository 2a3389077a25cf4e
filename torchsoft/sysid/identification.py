"""`identify` and `explain`: from a problem to its answer."""

import platform
import sys
import time as clock
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field
from tqdm import tqdm

from torchsoft.parallel import single_threaded
from torchsoft.sysid.assumption_checks import Checked, check_assumptions
from torchsoft.sysid.colour import allow_for_colour
from torchsoft.sysid.conclusion import (
    ResidualCheck,
    check_residuals,
    estimate_findings,
    full_covariance,
    model_findings,
    ordering_constraints,
    predicted,
    run_findings,
    step_findings,
)
from torchsoft.sysid.estimate import estimates, residual_channels
from torchsoft.sysid.fit import FAR_OFF, Fit, Loss, Stage, Unreachable
from torchsoft.sysid.prechecks import accepted, precheck
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.result import IdentificationResult, recorded_rigs, seen_together
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.search import coarsened
from torchsoft.sysid.sentences import SEVERITIES, Finding
from torchsoft.sysid.stages import FINER, default_plan, refine_steps, run_plan, shown
from torchsoft.tables import SEED, Table, plain

RTOL = 1e-5
"""Relative tolerance of the last stage, at which derivatives are usually right to a tenth, and
estimates to a fraction of a standard deviation with sensors as good as `good_sensors`."""

PACKAGES = ("torchsoft", "torch", "numpy", "scipy", "llvmlite")
"""Packages whose versions a result records."""

Assumed = Literal["checked", "explained", "trusted"]
"""Whether assumptions get score tests, score tests and refits that look for a cause, or no test."""

EFFORT = 2.0
"""Work of refits, over that of the fit itself, after which `explain` starts no other."""


class Settings(Table):
    """Settings of a fit, which are arguments of `identify`."""

    rtol: float = Field(RTOL, ge=1e-8, le=1e-2)
    """relative tolerance of the simulations in the last stage [1]"""
    starts: int = Field(1, ge=1, le=2**20)
    """number of initial values for the first stage, from a Sobol sequence"""
    loss: Loss = "linear"
    """loss function of the residuals; the last two limit the influence of outliers"""
    workers: int = Field(1, ge=1, le=1000)
    """threads, one recording each"""
    seed: int = Field(0, ge=0, le=SEED)
    """seed of the initial values"""
    tightenings: int = Field(2, ge=0, le=10)
    """how often the fit may continue at a tenth of the tolerance where the discretisation error
    shifts estimates"""
    assumptions: Assumed = "checked"
    """"checked": score tests of assumptions; "explained": also refits that look for the cause of a
    misfit; "trusted": no tests"""
    effort: float = Field(EFFORT, gt=0, le=1e6)
    """work of refits, as a multiple of that of the fit, after which no new one starts [1]"""


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

    1. The recordings are compared with what such a rig can do: signs, units, zeros, set-points.
       `acknowledged` names findings that are no mistakes.
    2. The stages of the `plan` are fitted, by default those of `default_plan`, whose last has the
       tolerance `rtol`, and whose first starts from `starts` Sobol points by `seed`. Each stage
       freezes the steps that its tolerance chooses at its start, so that residuals are smooth.
       `loss` is scipy's robust loss.
    3. A run with a tenth of the tolerance measures how far the steps shift the estimates. Where
       that is more than `STEP_BIAS` standard deviations, the fit continues with a tenth of the
       tolerance, up to `tightenings` times (with the linear loss).
    4. Residuals are tested: size, colour, correlation with the motion and between channels.
    5. Assumptions (mesh, places, known parameters, sensors, laws) get score tests. With
       `assumptions` = "explained", suspects of a misfit are refitted, until refits took `effort`
       times the work of the fit; with "trusted" there are no tests of assumptions.
    6. Recordings named in `heldout` are predicted, not fitted.

    `workers` threads run side by side. With a `checkpoint` folder every run is kept there: an
    identification that was interrupted, called again with the same arguments, continues where it
    was.

    Raises `ValueError` for what `Settings` rejects, and for recordings that are not there or cannot
    be what they are taken for, `Unreachable` where the model cannot follow the data.
    """
    settings = Settings(
        rtol=rtol, starts=starts, loss=loss, workers=workers, seed=seed,
        tightenings=tightenings, assumptions=assumptions, effort=effort,
    )  # fmt: skip
    check_arguments(problem, settings, plan, heldout)
    started, folder = clock.perf_counter(), Path(checkpoint) if checkpoint is not None else None
    fitted = [name for name in problem.names if name not in heldout]
    runner = Runner(problem.recordings, workers, folder)

    looks = accepted(precheck(problem, runner, fitted), acknowledged)
    for finding in looks if progress else ():
        tqdm.write(plain(f"{finding.severity}: {finding}"), file=sys.stderr)
    start = Fit(problem, runner, problem.coordinates.start, loss=loss, progress=progress)
    planned = fit_plan(start, plan, settings, fitted, looks)
    far_off = is_far_off(planned)
    end = refined(planned, 0 if far_off or loss != "linear" else tightenings)
    residuals = check_residuals(end)
    checked = check_suspects(end, residuals, settings)

    made_by: dict[str, Any] = settings.model_dump()
    made_by |= {"rtol": end.rtol, "rtol_asked": asked(plan, settings)}
    made_by |= {"acknowledged": [*acknowledged]}
    answer = concluded(end, residuals, checked, heldout, made_by, far_off)
    return completed(answer, looks, clock.perf_counter() - started)


def completed(
    answer: IdentificationResult, looks: Sequence[Finding], wall_s: float
) -> IdentificationResult:
    """The answer with what was found before the fit, the cause of a misfit and the gravest findings
    first, and the time that it took [s]."""

    def order(one: Finding) -> tuple[bool, int]:
        return one.code not in ("cause", "causes"), SEVERITIES.index(one.severity)

    findings = sorted([*looks, *answer.findings], key=order)
    return replace(answer, findings=findings, cost=answer.cost | {"wall_s": wall_s})


def explain(problem: Problem, **options: Any) -> IdentificationResult:
    """Identify, and look for the cause of a misfit: refit the data with one suspect free after the
    other (a law, a parameter, the mesh, a place, a sensor) and compare the fits.

    It stops when refits took `effort` times the work of the fit: a finding names the suspects that
    are left then. Takes the arguments of `identify`, and with its `checkpoint` starts where that
    ended; Ctrl-C keeps what was tested. Raises what `identify` does.
    """
    return identify(problem, **options, assumptions="explained")


def check_arguments(
    problem: Problem, settings: Settings, plan: Sequence[Stage] | None, heldout: Sequence[str]
) -> None:
    """Raises `ValueError` for held-out recordings that are not there, or are all, and for a plan
    that contradicts the settings."""
    if set(heldout) - set(problem.names) or len(set(heldout)) == len(problem.recordings):
        raise ValueError(
            f"`heldout` must name some of {list(problem.names)}, but not all; it is {list(heldout)}"
        )
    own = [] if plan is None else [stage.rtol for stage in plan]
    if plan is not None and (settings.starts > 1 or settings.rtol not in (RTOL, *own)):
        raise ValueError(
            "`starts` and `rtol` are those of the default plan: set them in the stages of `plan` "
            "instead"
        )


def fit_plan(
    start: Fit,
    plan: Sequence[Stage] | None,
    settings: Settings,
    fitted: Sequence[str],
    looks: Sequence[Finding],
) -> Fit:
    """The fit of a plan, by default of `default_plan`. Raises `Unreachable` with what looks wrong
    with the recordings, since that may be its cause."""
    try:
        if plan is None:
            rtol, starts = settings.rtol, settings.starts
            plan = default_plan(start.problem, start.runner, rtol, fitted, starts)
        return run_plan(start, plan, seed=settings.seed)
    except Unreachable as error:
        raise Unreachable(error.failed, looks) from None


def asked(plan: Sequence[Stage] | None, settings: Settings) -> float:
    """Tolerance of the last stage of a plan."""
    return settings.rtol if plan is None else plan[-1].rtol


def is_far_off(planned: Fit) -> bool:
    """Whether a fit is far above the noise, and not because of its steps."""
    if planned.loss != "linear" or planned.chi2 <= FAR_OFF:
        return False
    fine = planned.residuals(steps=FINER * planned.rtol)
    return not fine.failed and float(np.mean(fine.r**2)) > FAR_OFF


def refined(planned: Fit, tightenings: int) -> Fit:
    """The fit of a plan, continued with declared colour of the noise until its steps do not matter,
    with a tighter tolerance at most `tightenings` times."""
    refine = partial(shown, "check of the steps", partial(refine_steps, tightenings=tightenings))
    colour = partial(shown, "colour of the noise", allow_for_colour)
    fit = colour(planned)
    end = refine(fit)
    if end.colour and len(end.stages) > len(fit.stages):
        end = refine(colour(end))  # its noise was that of the residuals before
    stalled = end.stalled or (planned.stalled and tightenings == 0)
    return end._replace(stalled=stalled, converged=end.converged and not stalled)


def check_suspects(end: Fit, residuals: ResidualCheck, settings: Settings) -> Checked:
    """Tests of the assumptions at the end of a fit."""
    if settings.assumptions == "trusted":
        return Checked([], np.zeros((len(end.at.r), 0)), end.J)
    bound = bool((end.free & end.problem.coordinates.at_bound(end.x)).any())
    doubtful = not end.converged or bool(residuals.undeclared) or bound or residuals.larger
    effort = settings.effort if settings.assumptions == "explained" else 0.0
    return check_assumptions(coarsened(end), doubtful=doubtful, effort=effort)._replace(J=end.J)


def concluded(
    end: Fit,
    residuals: ResidualCheck,
    checked: Checked,
    heldout: Sequence[str],
    made_by: dict[str, Any],
    far_off: bool,
) -> IdentificationResult:
    """The answer at the end of a fit."""
    problem = end.problem
    C = full_covariance(end, residuals, checked)
    shift = np.zeros(len(end.x)) if end.check.bias is None else end.check.bias
    found, channels = estimates(end, C, shift), residual_channels(end)
    errors, findings = predicted(end, heldout)
    findings += [*end.findings, *run_findings(end)]
    findings += estimate_findings(found, ordering_constraints(problem))
    findings += step_findings(end, found, far_off)
    findings += model_findings(end, residuals, checked, channels)
    return IdentificationResult(
        estimates=found,
        labels=[*end.labels],
        x=[float(v) for v in end.x],
        correlation=(end.covariance / np.outer(end.sd, end.sd)).tolist(),
        chi2=residuals.chi2,
        chi2_whitened=residuals.chi2_whitened,
        converged=end.converged,
        residuals=channels,
        heldout=errors,
        findings=findings,
        stages=[*end.stages],
        cost=work(end),
        made_by=made_by | provenance(problem),
        covariance=C.tolist(),
        recordings=recorded_rigs(end),
        combinations=seen_together(end, C),
        assumptions=checked.checks,
        **described(end),
    )


def described(end: Fit) -> dict[str, Any]:
    """The problem of a fit, as fields of its answer."""
    problem = end.problem
    return {
        "unknowns": dict(problem.unknowns),
        "sensors": dict(problem.sensors),
        "coordinates": [
            replace(one, fixed=not is_free)
            for one, is_free in zip(problem.coordinates.all, end.free)
        ],
        "noise": dict(problem.noise),
        "versions": {"python": platform.python_version()} | {one: version(one) for one in PACKAGES},
        "rigs": {recording.name: recording.rig for recording in problem.recordings},
    }


def work(end: Fit) -> dict[str, float]:
    """Numbers of runs, of residuals, and seconds of data of a fit."""
    runner, recordings = end.runner, end.problem.recordings
    return {
        "simulations": runner.simulations,
        "jacobians": runner.jacobians,
        "remembered": runner.remembered,
        "samples": len(end.at.r),
        "data_seconds": sum(one.duration for one in recordings if one.name in end.which),
    }


def provenance(problem: Problem) -> dict[str, Any]:
    """What a problem was made of."""
    return {
        "torchsoft": version("torchsoft"),
        "unknowns": {name: one.model_dump() for name, one in problem.unknowns.items()},
        "sensors": {name: one.model_dump() for name, one in problem.sensors.items()},
        "recordings": {one.name: one.fingerprint for one in problem.recordings},
    }
