"""What is known at the end of a fit: intervals, verdicts on the misfit and on what was taken for granted, and the result."""

import time as clock
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.answer.estimate import directions, estimates, nrmse, residual_channels
from torchsoft.sysid.answer.recorded import untold
from torchsoft.sysid.answer.result import IdentificationResult, described
from torchsoft.sysid.checks import checks, misfit
from torchsoft.sysid.checks.colour import Coloured, colour_notices, rewhitened
from torchsoft.sysid.checks.parts import parts
from torchsoft.sysid.fit import robust
from torchsoft.sysid.fit.information import fisher
from torchsoft.sysid.fit.plan import Stage
from torchsoft.sysid.fit.robust import Loss
from torchsoft.sysid.fit.settle import FINER, STEP_BIAS, Settled, settle
from torchsoft.sysid.fit.stages import progress_bar, stage_entry
from torchsoft.sysid.problem.problem import Problem, Residuals
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.workers import Runner
from torchsoft.sysid.settings import Settings


class How(NamedTuple):
    """How an identification goes about it, beside its stages; `identify` says what the fields mean."""

    fitted: list[str]
    heldout: tuple[str, ...]
    acknowledged: tuple[str, ...]
    settings: Settings

    @property
    def loss(self) -> Loss:
        return self.settings.loss

    @property
    def tightenings(self) -> int:
        """How often the tolerance may become tighter; a robust fit ends on the steps that it has."""
        return self.settings.tightenings if self.loss == "linear" else 0


def conclude(
    coloured: Coloured, runner: Runner, stage: Stage, stages: list[dict[str, Any]], how: How, looks: list[str],
    began: float, progress: bool,
) -> IdentificationResult:  # fmt: skip
    """The result, from the fit of the last stage with the noise that was found; `looks` are sentences on the recordings
    themselves, `began` is on the clock [s]."""
    problem, fit = coloured.problem, coloured.fit
    c = problem.coordinates
    free, start = np.isin(c.labels, stage.free), clock.perf_counter()
    with progress_bar("check of the steps", progress) as notify:
        end = settle(problem, runner, stage, fit, free, how.tightenings, notify)
    x, at, rtol = end.x, end.at, end.rtol
    for number, (by, one) in enumerate(end.fits):
        name = "steps chosen anew" if by == (end.fits[number - 1][0] if number else stage.rtol) else "tighter tolerance"
        stages = [*stages, stage_entry(name, stage, by, one, start)]
    J = at.J[:, free]
    C_free, values, vectors = fisher(J)
    left = parts(problem, at.r, stage.recordings)
    exact = np.concatenate([np.arange(0), *(part.rows for part in left)])  # not saturated
    rows = np.append(exact, np.arange(len(at.r) - len(c.priors), len(at.r)))
    chi2 = float(at.r[rows] @ at.r[rows]) / max(len(rows) - int(free.sum()), 1)
    verdicts = misfit.judge(
        left, at.r, J, robust=how.loss != "linear",
        priors=[c.labels[i] for i, _ in c.priors],
    )  # fmt: skip
    declared = [name for name, one in problem.sensors.items() if one.colour == "ar"]
    colour, bound = bool(coloured.found.keys() - set(declared)), bool((free & c.at_bound(x)).any())
    larger = any(one.alarming and not (one.test == "level" and one.size < 1) for one in verdicts)
    doubtful = not end.at_rest or colour or bound or larger
    checked = None
    if how.settings.assumptions != "trusted":
        checked = tested_assumptions(coloured, runner, end, stage, free, doubtful, how, progress)
    C, shift = np.zeros((len(x), len(x))), np.zeros(len(x)) if end.bias is None else end.bias
    C_fit = (
        C_free * max(1.0, chi2) if how.loss == "linear" else robust.covariance(J, at.r, how.loss, len(c.priors), exact)
    )
    C[np.ix_(free, free)] = C_fit + (checked.widening() if checked is not None else 0.0)
    labels = [label for label, one in zip(c.labels, free) if one]
    found = estimates(problem, x, free, C, shift)
    predicted, notices = {}, list(looks)
    if how.heldout:
        held = problem.with_noise({}).residuals(runner, x, how.heldout, rtol)
        if held.lost:
            notices += [f"held-out recording `{k}` could not be simulated: {v.reason}" for k, v in held.lost.items()]
        else:
            predicted = nrmse(problem, held.r, list(how.heldout))
            notices += guesses(problem, x, how.heldout)
    sd = np.sqrt(np.diag(C_free))
    notices += notices_on(found, end.at_rest, rtol, end.bias is None)
    notices += checks.notices(checked) if checked is not None else []
    notices += misfit.notices(verdicts, max(1.0, chi2) ** 0.5 if how.loss == "linear" else 1.0)
    notices += colour_notices(coloured.found, declared)
    return IdentificationResult(
        estimates=found,
        labels=labels,
        x=[float(v) for v in x],
        correlation=(C_free / np.outer(sd, sd)).tolist(),
        directions=directions(labels, values, vectors),
        chi2=chi2,
        chi2_stated=sum(float(one.raw @ one.raw) for one in left) / max(len(exact) - int(free.sum()), 1),
        converged=end.at_rest,
        residuals=residual_channels(problem, at, how.fitted),
        heldout=predicted,
        notices=notices,
        stages=stages,
        cost={
            "simulations": runner.simulations, "jacobians": runner.jacobians, "gradients": runner.gradients,
            "remembered": runner.remembered, "samples": len(at.r), "wall_s": clock.perf_counter() - began,
            "data_seconds": sum(r.duration for r in problem.recordings if r.name in how.fitted),
        },
        made_by={
            "torchsoft": version("torchsoft"), **how.settings.model_dump(), "rtol": rtol, "rtol_asked": stage.rtol,
            "acknowledged": list(how.acknowledged), "untried": list(checked.untried) if checked is not None else [],
            "candidates": list(checked.candidates) if checked is not None else [],
            "unknowns": {name: u.model_dump() for name, u in problem.unknowns.items()},
            "sensors": {name: s.model_dump() for name, s in problem.sensors.items()},
            "recordings": {r.name: r.fingerprint for r in problem.recordings},
        },
        covariance=C.tolist(),
        **described(
            problem, x, free, at.J, C, how.fitted, tried={channel: one.scores for channel, one in coloured.found.items()},
            checks=checked.checks if checked is not None else (),
        ),
    )  # fmt: skip


def tested_assumptions(
    coloured: Coloured, runner: Runner, end: Settled, stage: Stage, free: NDArray[np.bool_], doubtful: bool, how: How,
    progress: bool,
) -> checks.Checked:  # fmt: skip
    """The checks at the end of a fit, on residuals with the colour that was declared and no other: what was found unasked may
    be the very trace of a wrong assumption. Their columns then get all the noise."""
    problem, which = coloured.problem, stage.recordings
    declared = {channel: noise for channel, noise in problem.noise.items() if problem.sensors[channel].colour == "ar"}
    plain = problem.with_noise(declared)
    finer = rewhitened(plain, end.finer, parts(problem, end.finer.r, which))
    found = checks.check(
        plain, end.x, finer, free, which, end.rtol, doubtful=doubtful, explain=how.settings.assumptions == "explained",
        loss=how.loss, workers=runner.workers, journal=runner.folder, progress=progress,
    )  # fmt: skip
    rows = Residuals(found.columns[:, 0] if found.columns.size else finer.r, found.columns, {})
    columns: Array = rewhitened(problem, rows, parts(plain, rows.r, which)).J
    return found._replace(columns=columns, J=end.at.J[:, free])


def guesses(problem: Problem, x: Array, heldout: Sequence[str]) -> list[str]:
    """Sentences on recordings that were predicted with values of their own, which no recording that was fitted tells."""
    out = []
    for k in (k for k, name in enumerate(problem.names) if name in heldout):
        mine = [c for c in problem.coordinates.all if c.recording == problem.names[k] and not c.fixed]
        values = problem.values(x, k)
        if own := {c.name: values[c.name] for c in mine if c.kind == "parameter"}:
            out.append(f"held-out recording `{problem.names[k]}` is predicted with what is {untold(own)}")
    return out


def notices_on(found: list[Any], converged: bool, rtol: float, unchecked: bool) -> list[str]:
    """Sentences on what a reader must know before using the numbers."""
    out = []
    for e in found:
        if not e.identifiable:
            change = f"a change by {e.relative_sd:.0%}" if e.relative_sd < 9 else "a change by a factor of ten"
            out.append(f"{e.label} is not identifiable from these data: {change} would not show in them")
        if e.at_bound and e.identifiable:
            out.append(f"{e.label} ended at a bound ({e.last:.4g}): widen the bound or question the model")
    worst = max(found, key=lambda e: abs(e.step_bias_sd), default=None)
    if unchecked:
        out.append(f"the tolerance rtol = {rtol:g} could not be checked: a run failed that was made to check it")
    elif worst is not None and abs(worst.step_bias_sd) > STEP_BIAS:
        out.append(
            f"the tolerance rtol = {rtol:g} is too coarse for these data: it shifts {worst.label} by "
            f"{abs(worst.step_bias_sd):.2g} standard deviations ({worst.step_bias_sd * worst.relative_sd:+.2%}); take "
            f"rtol = {FINER * rtol:g}"
        )
    if not converged:
        out.append("the last stage stopped before it converged: give it more evaluations")
    return out
