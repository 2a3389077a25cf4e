"""`identify`: a plan of stages, the tests at their end, and the result with its notices;
`explain`."""

import platform
import sys
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from tqdm import tqdm

from torchsoft.sysid.colour import (
    WORSE,
    Coloured,
    Refit,
    allow_for_colour,
    colour_notices,
    refusal,
    rewhitened,
    spread,
    without,
)
from torchsoft.sysid.estimate import contributions, directions, estimates, nrmse, residual_channels
from torchsoft.sysid.fit import (
    FAR_OFF,
    Fit,
    Loss,
    Notify,
    Unreachable,
    chord,
    covariance,
    fisher,
)
from torchsoft.sysid.plan import (
    FINER,
    JACOBIAN_ERROR,
    STEP_BIAS,
    Method,
    Settled,
    Stage,
    default_plan,
    on_steps,
    progress_bar,
    run_plan,
    settle,
    stage_entry,
)
from torchsoft.sysid.prechecks import accepted, precheck
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.refits import ended
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


class Settings(Table):
    """Settings of a fit, which are arguments of `identify`."""

    rtol: float = Field(RTOL, ge=1e-8, le=1e-2)
    starts: int = Field(1, ge=1, le=2**20)
    loss: Loss = "linear"
    method: Method = "gauss_newton"
    workers: int = Field(1, ge=1, le=1000)
    seed: int = Field(0, ge=0, le=SEED)
    tightenings: int = Field(2, ge=0, le=10)
    assumptions: Assumed = "checked"

    @model_validator(mode="after")
    def _the_method_has_the_loss(self) -> "Settings":
        if self.loss != "linear" and self.method != "gauss_newton":
            raise ValueError(
                f"the method '{self.method}' has no robust loss: for loss = '{self.loss}' take "
                "method = 'gauss_newton'"
            )
        return self


# Conclusion of a fit


class FitContext(NamedTuple):
    """Arguments of an identification besides its stages; `identify` documents the fields."""

    fitted: list[str]
    heldout: tuple[str, ...]
    acknowledged: tuple[str, ...]
    settings: Settings

    @property
    def loss(self) -> Loss:
        return self.settings.loss

    @property
    def tightenings(self) -> int:
        """Most times that the tolerance may become tighter; a robust fit keeps its steps."""
        return self.settings.tightenings if self.loss == "linear" else 0


def conclude(
    coloured: Coloured, runner: Runner, stage: Stage, stages: list[dict[str, Any]],
    context: FitContext, findings: list[str], rtol_asked: float, began: float, progress: bool,
) -> IdentificationResult:  # fmt: skip
    """The result, from the fit of the last stage with its estimated noise. `findings` are sentences
    on the recordings and the plan, `rtol_asked` is the tolerance of the whole plan, `began` is on
    the clock [s]."""
    c = coloured.problem.coordinates
    free, stages = np.isin(c.labels, stage.free), list(stages)
    hopeless = context.loss == "linear" and coloured.before[1].chi2 > FAR_OFF
    if hopeless:  # or only its steps are too coarse
        fine, _ = coloured.before[0].freeze(
            runner, coloured.fit.x, stage.recordings, FINER * stage.rtol
        )
        hopeless = not fine.failed and float(np.mean(fine.r**2)) > FAR_OFF
    tightenings = 0 if hopeless else context.tightenings

    def at_rest() -> Settled:
        """Continue the fit with its noise until its steps do not matter."""
        start, by = clock.perf_counter(), stage.rtol
        with progress_bar("check of the steps", progress) as notify:
            end = settle(coloured.problem, runner, stage, coloured.fit, free, tightenings, notify)
        for rtol, one, at in end.fits:
            name = "steps chosen anew" if rtol == by else "tighter tolerance"
            stages.append(stage_entry(name, stage, rtol, one, start, at))
            by, start = rtol, at
        return end

    end = at_rest()
    if coloured.found and end.fits:  # its noise was that of the residuals before
        stage, start = replace(stage, rtol=end.rtol), clock.perf_counter()
        with progress_bar("colour of the noise", progress) as notify:
            last = end.fits[-1][1]
            refit = refitting(runner, stage, last, context.loss, context.settings.method, notify)
            coloured = allow_for_colour(
                coloured.problem, last, free, stage.recordings, refit
            )._replace(before=coloured.before)
        stages += noise_entries(coloured, stage, start)
        end = at_rest()
    if (worse := coloured.grown(end.at.r, stage.recordings)) > WORSE:
        with progress_bar("fit without the colour of the noise", progress) as notify:
            refit = refitting(
                runner, stage, coloured.before[1], context.loss, context.settings.method, notify
            )
            coloured = without(coloured, worse, free, stage.recordings, refit)
        end = at_rest()
    problem, x, at, rtol = coloured.problem, end.x, end.at, end.rtol
    J = at.J[:, free]
    C_free, values, vectors = fisher(J)
    left = parts(problem, at.r, stage.recordings)
    exact = np.concatenate([np.arange(0), *(part.rows for part in left)])  # not saturated
    rows = np.append(exact, np.arange(len(at.r) - len(c.priors), len(at.r)))
    chi2 = float(at.r[rows] @ at.r[rows]) / max(len(rows) - int(free.sum()), 1)
    verdicts = judge_residuals(
        left, at.r, J, robust=context.loss != "linear",
        priors=[c.labels[i] for i, _ in c.priors] if end.at_rest else (),
    )  # fmt: skip
    declared = [name for name, one in problem.sensors.items() if one.colour == "ar"]
    own = {*coloured.found, *coloured.refused} - {*declared}
    colour, bound = bool(own), bool((free & c.at_bound(x)).any())
    larger = any(one.alarming and not (one.test == "level" and one.size < 1) for one in verdicts)
    doubtful = not end.at_rest or colour or bound or larger
    checked = None
    if context.settings.assumptions != "trusted":
        checked = tested_assumptions(
            coloured, runner, end, stage, free, doubtful, context, progress
        )
    C, shift = np.zeros((len(x), len(x))), np.zeros(len(x)) if end.bias is None else end.bias
    C_fit = (
        C_free * max(1.0, chi2)
        if context.loss == "linear"
        else covariance(J, at.r, context.loss, len(c.priors), exact)
    )
    C_fit = C_fit + spread(J, C_free, left, coloured.refused)
    C[np.ix_(free, free)] = C_fit + (checked.widening() if checked is not None else 0.0)
    labels = [one.label for one in c.within(free)]
    found = estimates(problem, x, free, C, shift)
    predicted, notices = {}, list(findings)
    if context.heldout:
        held = problem.with_noise({}).residuals(runner, x, context.heldout, rtol)
        if held.failed:
            notices += [
                f"held-out recording `{k}` could not be simulated: {v.reason}"
                for k, v in held.failed.items()
            ]
        else:
            predicted = nrmse(problem, held.r, list(context.heldout))
            notices += guesses(problem, x, context.heldout)
    sd = np.sqrt(np.diag(C_free))
    notices += notices_on(
        found, ordering_constraints(problem), end.at_rest or bool(end.rough) or hopeless, rtol,
        end.bias is None,
    )  # fmt: skip
    if hopeless:
        notices.append(
            f"steps were checked and not made finer, since chi2 = {coloured.before[1].chi2:.3g} is "
            "far above the noise"
        )
    notices += rough_notices(c, end.rough)
    if end.jacobian_error > JACOBIAN_ERROR and not end.rough and not hopeless:
        notices.append(
            f"the tolerance rtol = {rtol:g} is too coarse for derivatives: their error is "
            f"{end.jacobian_error:.2g} of the noise, and estimates scatter more than their "
            f"intervals say; take rtol = {FINER * rtol:g}"
        )
    alarms = residual_notices(verdicts, max(1.0, chi2) ** 0.5 if context.loss == "linear" else 1.0)
    doubts = [sentence for kind, sentence in alarms.items() if kind != "smaller"]
    explained, hidden = not systematic(verdicts), list[str]()
    if checked is not None:
        against = assumption_doubts(checked)
        notices += against + assumption_notices(checked)
        doubts = against + doubts
        hidden = unseen(checked) if explained and not checked.favoured else []
        explained = checked.explained or (explained and not checked.favoured)
    notices += alarms.values()
    notices += refusal(coloured) + colour_notices(coloured.found, declared)
    return IdentificationResult(
        estimates=found,
        labels=labels,
        x=[float(v) for v in x],
        correlation=(C_free / np.outer(sd, sd)).tolist(),
        directions=directions(labels, values, vectors),
        chi2=chi2,
        chi2_stated=sum(float(one.raw @ one.raw) for one in left)
        / max(len(exact) - int(free.sum()), 1),
        converged=end.at_rest,
        residuals=residual_channels(problem, at, context.fitted),
        heldout=predicted,
        notices=notices,
        doubts=doubts,
        explained=explained,
        unseen=hidden,
        stages=stages,
        cost={
            "simulations": runner.simulations, "jacobians": runner.jacobians,
            "gradients": runner.gradients, "remembered": runner.remembered, "samples": len(at.r),
            "wall_s": clock.perf_counter() - began,
            "data_seconds": sum(r.duration for r in problem.recordings if r.name in context.fitted),
        },
        made_by={
            "torchsoft": version("torchsoft"), **context.settings.model_dump(), "rtol": rtol,
            "rtol_asked": rtol_asked, "acknowledged": list(context.acknowledged),
            "untried": list(checked.untried) if checked is not None else [],
            "candidates": list(checked.candidates) if checked is not None else [],
            "unknowns": {name: u.model_dump() for name, u in problem.unknowns.items()},
            "sensors": {name: s.model_dump() for name, s in problem.sensors.items()},
            "recordings": {r.name: r.fingerprint for r in problem.recordings},
        },
        covariance=C.tolist(),
        recordings=recorded_rigs(problem, x, context.fitted), unknowns=dict(problem.unknowns),
        sensors=dict(problem.sensors),
        coordinates=[replace(one, fixed=not is_free) for one, is_free in zip(c.all, free)],
        contributions=contributions(problem, x, free, at.J, context.fitted),
        combinations=seen_together(problem, free, C),
        noise=[
            ChannelNoise(
                name, model, list(coloured.found[name].scores) if name in coloured.found else []
            )
            for name, model in problem.noise.items()
        ],
        assumptions=checked.checks if checked is not None else [],
        versions={"python": platform.python_version()} | {one: version(one) for one in PACKAGES},
        rigs={recording.name: recording.rig for recording in problem.recordings},
    )  # fmt: skip


def noise_entries(coloured: Coloured, stage: Stage, began: float) -> list[dict[str, Any]]:
    """The result's entries on the fits with estimated noise."""
    name, out = "with the noise that was found", []
    for one, at in coloured.fits:
        out.append(stage_entry(name, stage, stage.rtol, one, began, at))
        began = at
    return out


def tested_assumptions(
    coloured: Coloured, runner: Runner, end: Settled, stage: Stage, free: NDArray[np.bool_],
    doubtful: bool, context: FitContext, progress: bool,
) -> Checked:  # fmt: skip
    """Tests of the assumptions at the end of a fit, on residuals whitened by declared colour only:
    undeclared colour may be the trace of a wrong assumption. The columns in the result are whitened
    by all of the noise."""
    problem, which = coloured.problem, stage.recordings
    declared = {
        channel: noise
        for channel, noise in problem.noise.items()
        if problem.sensors[channel].colour == "ar"
    }
    plain = problem.with_noise(declared)
    finer = rewhitened(plain, end.finer, parts(problem, end.finer.r, which))
    there = ended(plain, plain.runner(runner), end.x, finer, free, which, end.rtol, end.steps)
    found = check_assumptions(
        plain, there, doubtful=doubtful, explain=context.settings.assumptions == "explained",
        loss=context.loss, progress=progress,
    )  # fmt: skip
    rows = Residuals(found.columns[:, 0] if found.columns.size else finer.r, found.columns, {})
    columns: Array = rewhitened(problem, rows, parts(plain, rows.r, which)).J
    return found._replace(columns=columns, J=end.at.J[:, free])


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
    found: list[Any], held: Mapping[str, tuple[str, float]], converged: bool, rtol: float,
    unchecked: bool,
) -> list[str]:  # fmt: skip
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


def identify(
    problem: Problem, *, rtol: float = RTOL, plan: Sequence[Stage] | None = None, starts: int = 1,
    loss: Loss = "linear", method: Method = "gauss_newton", heldout: Sequence[str] = (),
    workers: int = 1, checkpoint: str | Path | None = None, progress: bool = False, seed: int = 0,
    tightenings: int = 2, assumptions: Assumed = "checked", acknowledged: Sequence[str] = (),
) -> IdentificationResult:  # fmt: skip
    """Find the unknown parameters of `problem`, with intervals, and find which of them the data do
    not determine.

    Every stage of the `plan` (`default_plan` by default, whose first stage is begun from `starts`
    Sobol points by `seed`) freezes the steps that its tolerance chooses at its start, one sequence
    a recording, so that residuals are smooth in the unknowns. `rtol` is the last stage's. At the
    end a run with a tenth of it tells how far the steps shift the estimates: where that is more
    than `STEP_BIAS` standard deviations, the fit goes on with a tenth of the tolerance, up to
    `tightenings` times (with the linear loss). `loss` is scipy's robust loss; `method` may descend
    on the adjoint instead, with the linear loss only. Recordings named in `heldout` are predicted,
    not fitted; `workers` threads run side by side. With a `checkpoint` folder every run is kept
    there: an identification that was interrupted, called again with the same arguments, continues
    where it was.

    At the end the assumptions (mesh, place of the disc, numbers that are called
    known, faults of sensors, the friction law) are tested to first order, a run each, and intervals
    allow for constants of the computation that the data cannot tell. Where no test explains a
    misfit, a notice names the candidates, and `explain` tries them. Before the fit recordings are
    held against what such a rig can do at all: signs, units, delays, zeros, set-points, the body
    that a loop senses; `acknowledged` names findings that are no mistakes. With `assumptions` =
    "trusted" the tests at the end are left out, but not the checks of the recordings.

    Raises `ValueError` for what `Settings` does not take, and for recordings that are not there or
    cannot be what they are taken for, `Unreachable` where the model cannot follow the data.
    """
    unknown = set(heldout) - set(problem.names)
    if unknown or len(set(heldout)) == len(problem.recordings):
        raise ValueError(
            f"`heldout` must name some of {list(problem.names)}, but not all; it is {list(heldout)}"
        )
    settings = Settings(
        rtol=rtol, starts=starts, loss=loss, method=method, workers=workers, seed=seed,
        tightenings=tightenings, assumptions=assumptions,
    )  # fmt: skip
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
        end = run_plan(
            problem,
            runner,
            plan,
            problem.coordinates.start,
            loss=loss,
            method=method,
            seed=seed,
            progress=progress,
        )
    except Unreachable as error:  # what looked wrong with the recordings may be behind it
        raise Unreachable(error.failed, findings) from None
    before = clock.perf_counter()
    with progress_bar("colour of the noise", progress) as bar:
        free = np.isin(problem.coordinates.labels, end.stage.free)
        refit = refitting(runner, end.stage, end.fit, loss, method, bar)
        coloured = allow_for_colour(problem, end.fit, free, end.stage.recordings, refit)
    stages = end.entries + noise_entries(coloured, end.stage, before)
    context = FitContext(fitted, tuple(heldout), tuple(acknowledged), settings)
    findings += end.notices
    return conclude(
        coloured, runner, end.stage, stages, context, findings, plan[-1].rtol, began, progress
    )


def explain(problem: Problem, **options: Any) -> IdentificationResult:
    """Identify, and look for the cause of a misfit that no test of an assumption explains to first
    order.

    The fit is repeated without one assumption after the other (another law, number, mesh, place,
    sensor) until one explains the data: some minutes each, with progress that names it. Takes the
    arguments of `identify`, and with its `checkpoint` begins where that ended; Ctrl-C keeps what
    was tried. Raises what `identify` does.
    """
    return identify(problem, **options, assumptions="explained")


def refitting(
    runner: Runner, stage: Stage, fit: Fit, loss: Loss, method: Method, notify: Notify
) -> Refit:
    """The fit of a stage continued with other noise: with a new Jacobian first, then with the last
    one."""

    def refit(one: Problem, last: Fit, number: int) -> Fit:
        if number > 0 and loss == "linear":
            common: dict[str, Any] = {"which": stage.recordings, "notify": notify}
            free = np.isin(one.coordinates.labels, stage.free)
            return chord(one, runner, last.x, last.at, steps=fit.steps, free=free, **common)
        return on_steps(one, runner, stage, last.x, fit.steps, loss, method, notify, last.at)

    return refit
