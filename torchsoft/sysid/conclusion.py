"""Conclusions at the end of a fit: tests of its residuals, its covariance, predictions of held-out
recordings, and findings on its steps and estimates."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.assumption_checks import Checked
from torchsoft.sysid.colour import colour_findings, rewhitened, spread, undeclared_colour
from torchsoft.sysid.estimate import ChannelResiduals, Estimate, nrmse
from torchsoft.sysid.fit import Fit, covariance, fisher
from torchsoft.sysid.noise import NoiseFit
from torchsoft.sysid.prediction import run_doubts
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import (
    Part,
    ResidualTest,
    judge_residuals,
    parts,
    residual_findings,
    systematic,
)
from torchsoft.sysid.sentences import Finding
from torchsoft.sysid.stages import FINER, JACOBIAN_ERROR, STEP_BIAS
from torchsoft.sysid.suspect_findings import risk_findings, suspect_findings, test_findings

# Residuals


class ResidualCheck(NamedTuple):
    """Residuals at the end of a fit: those that count, by channel, with their rows `exact` (k,),
    their tests, undeclared colour, and the sum of squares per degree of freedom over the stated
    noise, and once whitened."""

    left: list[Part]
    exact: NDArray[np.int_]
    tests: list[ResidualTest]
    undeclared: dict[str, NoiseFit]
    chi2: float
    chi2_whitened: float

    @property
    def larger(self) -> bool:
        """Whether a test gives an alarm other than that the noise is overstated."""
        return any(one.alarming and one.code != "smaller" for one in self.tests)


def check_residuals(end: Fit) -> ResidualCheck:
    """Tests of the residuals at the end of a fit, whitened with the colour that they show, declared
    or not."""
    problem, r, fitted, c = end.problem, end.at.r, list(end.which), end.problem.coordinates
    left, undeclared = parts(problem, r, fitted), undeclared_colour(end)
    exact = np.concatenate([np.arange(0), *(part.rows for part in left)])  # not saturated
    rows = np.append(exact, np.arange(len(r) - len(c.priors), len(r)))
    found = {channel: one.noise for channel, one in undeclared.items()}
    coloured = problem.with_noise({**problem.noise, **found})
    white = rewhitened(coloured, end.at, left)
    tests = judge_residuals(
        parts(coloured, white.r, fitted),
        white.r,
        white.J[:, end.free],
        robust=end.loss != "linear",
        priors=[c.labels[i] for i, _ in c.priors] if end.converged else (),
    )
    count, square = int(end.free.sum()), sum(float(one.raw @ one.raw) for one in left)
    chi2 = square / max(len(exact) - count, 1)
    whitened = float(r[rows] @ r[rows]) / max(len(rows) - count, 1)
    return ResidualCheck(left, exact, tests, undeclared, chi2, whitened)


def full_covariance(end: Fit, residuals: ResidualCheck, checked: Checked) -> Array:
    """Covariance (n, n) of all coordinates: widened where residuals exceed the noise or are
    coloured, and by numerical settings that the data cannot determine."""
    C_free, _, _ = fisher(end.J)
    if end.loss == "linear":
        C_fit = C_free * max(1.0, residuals.chi2_whitened)
    else:
        priors = len(end.problem.coordinates.priors)
        C_fit = covariance(end.J, end.at.r, end.loss, priors, residuals.exact)
    C_fit = C_fit + spread(end.J, C_free, residuals.left, residuals.undeclared)
    C = np.zeros((len(end.x), len(end.x)))
    C[np.ix_(end.free, end.free)] = C_fit + checked.widening()
    return C


# Findings


UNEXPLAINED = 1.25
"""RMS residual of a channel, over its stated noise, above which the model does not explain the
data."""


def model_findings(
    end: Fit, residuals: ResidualCheck, checked: Checked, channels: Sequence[ChannelResiduals]
) -> list[Finding]:
    """What residuals and tests of assumptions say of the model."""
    plain = not systematic(residuals.tests) and not checked.favoured
    unexplained = "warning" if plain or checked.explained else "error"
    widened = max(1.0, residuals.chi2_whitened) ** 0.5 if end.loss == "linear" else 1.0
    out = suspect_findings(checked, unexplained) + test_findings(checked)
    out += size_findings(residual_findings(residuals.tests, widened, unexplained), channels)
    if not any(one.severity == "error" for one in out):
        out += colour_findings(residuals.undeclared)
    return out + (risk_findings(checked) if plain else [])


def size_findings(alarms: Sequence[Finding], channels: Sequence[ChannelResiduals]) -> list[Finding]:
    """The alarms of residuals, of which those on their size are errors where a channel exceeds its
    noise by `UNEXPLAINED`; a warning where that may be chance, as with few or coloured samples."""
    worst = max(channels, key=lambda one: one.stated, default=None)
    if worst is None or worst.stated < UNEXPLAINED:
        return [*alarms]
    facts = {"channel": worst.channel, "ratio": worst.stated}
    first = [replace(one, severity="error") for one in alarms if one.code == "larger"]
    first = first or [Finding("unexplained", "warning", facts)]
    return first + [one for one in alarms if one.code != "larger"]


def run_findings(end: Fit) -> list[Finding]:
    """Warnings of the runs at the end of a fit, each of the first recording that has it."""
    found = dict[str, Finding]()
    for k, recording in enumerate(end.problem.recordings):
        if recording.name in end.which:
            with suppress(SimulationFailed):
                values, grid = end.problem.values(end.x, k), recording.grid(False)
                for text in run_doubts(recording.run_context(), values, grid, end.rtol):
                    facts = {"recording": recording.name, "text": text}
                    found.setdefault(text, Finding("run", "note", facts))
    return [*found.values()]


def step_findings(end: Fit, found: Sequence[Estimate], far_off: bool) -> list[Finding]:
    """Findings on the steps of a fit, and on its convergence; `far_off` is one that ends far above
    the noise, whose steps were not refined."""
    check, rtol, finer, out = end.check, end.rtol, FINER * end.rtol, list[Finding]()
    movable = [e for e in found if e.identifiable and not e.at_bound]
    worst = max(movable, key=lambda e: abs(e.step_bias_sd), default=None)
    if check.bias is None:
        out.append(Finding("steps-unchecked", "note", {"rtol": rtol}))
    elif worst is not None and abs(worst.step_bias_sd) > STEP_BIAS:
        part = worst.step_bias_sd * worst.relative_sd
        size = f"{part:+.2%}"
        if abs(part) > 1:  # of a fault of a sensor that is next to nothing
            size = f"{part * abs(worst.last):+.2g} {worst.unit}"
        facts = {"rtol": rtol, "estimate": worst.label, "shift": abs(worst.step_bias_sd)}
        out.append(Finding("steps-too-coarse", "note", facts | {"size": size, "finer": finer}))
    if not (end.converged or check.rough or far_off or end.stalled):
        out.append(Finding("not-converged", "note"))
    if far_off:
        out.append(Finding("steps-not-refined", "note", {"chi2": end.chi2}))
    if check.rough:
        starts = any(one.kind == "start" for one in end.coordinates if one.label in check.rough)
        remedy = {"measured": "every coordinate of the bodies"}
        if not starts:
            remedy = {"profiled": [*check.rough]}
        out.append(Finding("not-smooth", "note", {"coordinates": [*check.rough]} | remedy))
    elif check.jacobian_error > JACOBIAN_ERROR and not far_off:
        facts = {"rtol": rtol, "error": check.jacobian_error, "finer": finer}
        out.append(Finding("noisy-derivatives", "note", facts))
    return out


NEXT_TO = 1e-2
"""Relative distance of an estimate at a bound from the known number that is the bound."""


def ordering_constraints(problem: Problem) -> dict[str, tuple[str, float]]:
    """Known parameters that unknown ones may not pass, such as mu_k of mu_s: name and value by the
    name of the unknown."""
    out, unknown = dict[str, tuple[str, float]](), problem.coordinates.names
    for recording in problem.recordings:
        for pair in recording.rig.ordered.items():
            for mine, other in (pair, pair[::-1]):
                if mine in unknown and other not in unknown:
                    out[mine] = other, recording.parameters[other]
    return out


def estimate_findings(
    found: Sequence[Estimate], held: Mapping[str, tuple[str, float]]
) -> list[Finding]:
    """Findings on estimates that are not identifiable, and on those at a bound; `held` are the
    `ordering_constraints`."""
    out = list[Finding]()
    for e in found:
        if not e.identifiable:
            change = f"a factor of {min(1 + e.relative_sd, 10):.2g}"
            out.append(Finding("not-identifiable", "note", {"estimate": e.label, "change": change}))
        elif e.at_bound:
            other, value = held.get(e.name, ("", np.nan))
            facts = {"estimate": e.label, "value": e.last}
            if np.isclose(e.last, value, rtol=NEXT_TO):
                facts |= {"known": other, "known_value": value}
            else:
                facts["name"] = e.name
            out.append(Finding("at-bound", "note", facts))
    return out


# Held-out recordings


def predicted(
    end: Fit, heldout: Sequence[str]
) -> tuple[dict[str, dict[str, float]], list[Finding]]:
    """Errors of predicted recordings, that were not fitted, by recording and channel, with findings
    on runs that fail, and on values that no fitted recording determines."""
    if not heldout:
        return {}, []
    at = end.problem.with_noise({}).residuals(end.runner, end.x, heldout, end.rtol)
    if at.failed:
        failed = [{"recording": name, "reason": one.reason} for name, one in at.failed.items()]
        return {}, [Finding("heldout-failed", "note", facts) for facts in failed]
    out, problem = list[Finding](), end.problem
    for k in (k for k, name in enumerate(problem.names) if name in heldout):
        own = {
            c.name
            for c in problem.coordinates.all
            if c.recording == problem.names[k] and not c.fixed and c.kind == "parameter"
        }
        if values := {name: v for name, v in problem.values(end.x, k).items() if name in own}:
            facts = {"recording": problem.names[k], "values": values}
            out.append(Finding("heldout-unidentified", "note", facts))
    return nrmse(problem, at.r, list(heldout)), out
