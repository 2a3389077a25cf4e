"""Tests of an identification's assumptions: agreement with the data, and effect on the estimates.

A constant of the computation is not known to be right: it enters the intervals as another
coordinate, with a standard normal prior on its amplitude, so that intervals become wider where the
data cannot determine it.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from torchsoft.sysid.assumption_tests import RIVAL, AssumptionTest, Judge
from torchsoft.sysid.assumptions import Variation, assumptions
from torchsoft.sysid.fit import Fit, fisher
from torchsoft.sysid.new_fits import MOST, NewFits
from torchsoft.sysid.recording import Array
from torchsoft.sysid.refits import columns
from torchsoft.sysid.residual_tests import ResidualTest
from torchsoft.sysid.unknowns import NUISANCES

TEMPERED = 0.46
"""Power of the likelihood in scores. Suspects only resemble what is wrong, so that one is named
beside the best, with a score of 1 %, that leaves `EVIDENT` more of the sum of squares."""


class Checked(NamedTuple):
    """All tests; columns (m, k) of the constants of the computation, and the Jacobian (m, n) of the
    free coordinates."""

    checks: list[AssumptionTest]
    columns: Array
    J: Array
    untried: tuple[str, ...] = ()
    """Tests left out by an interruption."""
    late: tuple[str, ...] = ()
    """Suspects of new fits that were not begun, since the others took all of the effort."""
    candidates: tuple[str, ...] = ()
    """Suspects that only new fits can judge: none explains the misfit to first order, or several
    do."""
    besides: tuple[AssumptionTest, ...] = ()
    """Effects that the data favour to first order besides the likeliest suspect, each beside those
    before it."""
    alarms: tuple[ResidualTest, ...] = ()
    """Alarms of the residuals under the likeliest suspect, or of the fit without a suspect."""
    left: tuple[ResidualTest, ...] = ()
    """Alarms under the likeliest suspect and the effects besides."""
    as_stated: tuple[ResidualTest, ...] = ()
    """Alarms of the residuals of the fit itself."""
    sd: Mapping[str, float] = MappingProxyType({})
    """Standard deviations of the free coordinates, by label."""

    @property
    def favoured(self) -> list[AssumptionTest]:
        """Suspects that the data favour, the likeliest first, those that pass the tests before
        others."""
        mine = [one for one in self.checks if one.suspected]
        return sorted(mine, key=lambda one: (-one.score, -one.passed, -one.gain))

    @property
    def explained(self) -> bool:
        """Whether nothing is left under the likeliest suspect alone, and without it something is.
        Several suspects at once explain what none of them causes."""
        return bool(self.favoured and self.as_stated) and not self.alarms

    @property
    def wider(self) -> dict[str, float]:
        """Factor on the standard deviation of every free coordinate by the constants of the
        computation."""
        plain, wider = fisher(self.J)[0], self.covariance()
        return dict(zip(self.sd, np.sqrt(np.diag(wider) / np.diag(plain)).tolist()))

    def covariance(self) -> Array:
        """Covariance (n, n) of the free coordinates, widened by the constants of the
        computation."""
        k, n = self.columns.shape[1], self.J.shape[1]
        rows = np.block([[self.J, self.columns], [np.zeros((k, n)), np.eye(k)]])
        _, R = np.linalg.qr(rows[:, [*range(n, n + k), *range(n)]])
        return fisher(R[k:, k:])[0]

    def widening(self) -> Array:
        """Part (n, n) of that covariance due to the constants of the computation."""
        plain = fisher(self.J)[0]
        return self.covariance() - plain if self.columns.size else np.zeros_like(plain)


def check_assumptions(end: Fit, *, doubtful: bool = False, effort: float = 0.0) -> Checked:
    """Tests of the assumptions at the end of a fit, `refits.coarsened`, to first order.

    With an `effort` a `doubtful` fit is repeated without one assumption after the other, until one
    explains the misfit, or new fits took so many times the work of the fit itself: a test to first
    order says little where a fit has run far off.
    """
    candidates, late, problem = list[Variation](), list[str](), end.problem
    recordings = [recording for recording in problem.recordings if recording.name in end.which]
    c = problem.coordinates
    faults = [f"{one.kind} of {one.name}" for one in c.all if one.kind in NUISANCES]
    every = assumptions(recordings, {*c.names, *faults}, problem.sensors)
    taken = [one for one in every if doubtful or not one.costly]
    checks, constants = dict[str, AssumptionTest](), list[Array]()
    untried = [one.name for one in taken if one.vary is not None]
    # such as of pads that creep longer than the lead of a run
    with warnings.catch_warnings(action="ignore"):
        found, J = columns(end, taken)
    judge, spent = Judge(end, J), end.runner.work
    try:
        for one, d, reason in found:
            judge.work[one.name], spent = end.runner.work - spent, end.runner.work
            if one.vary is None and d is not None and not d.any():
                continue
            checks[one.name] = judge.first_order(one, d, reason)
            if d is not None and one.kind == "numerical":
                constants.append(d)
            if one.vary is not None:
                untried.remove(one.name)
        explained = judge.explained(checks.values())
        if doubtful and not end.at.failed:
            candidates = (rivals if explained else doubted)(taken, checks)
        if effort and candidates:
            untried = [f"a new fit with another {one.name}" for one in candidates]
            near = end.by(judge.finest) if explained else end  # rivals differ by little
            tested = [one for one in taken if one.name in checks and not one.costly]
            fits = NewFits(near, candidates, tested, judge, checks, effort)
            late = fits.late
            for one in fits:
                untried = [name for name in untried if name != f"a new fit with another {one.name}"]
            untried, candidates = [], []
    except KeyboardInterrupt:  # the fit is done: what was tried is kept
        candidates = []
    rows = np.stack(constants, 1) if constants else np.zeros((len(judge.r), 0))
    names = tuple(one.name for one in candidates)
    sd = dict(zip(judge.labels, judge.sd.tolist()))
    done = Checked(
        [*checks.values()],
        rows,
        judge.J,
        tuple(untried),
        tuple(late),
        names,
        as_stated=tuple(judge.alarms(judge.r, judge.J)),
        sd=sd,
    )
    return compared(done, judge)


def doubted(suspects: Iterable[Variation], checks: Mapping[str, AssumptionTest]) -> list[Variation]:
    """Suspects for repeated fits, in order of their gain: the first `MOST`, and every law and
    constant of the computation, which may have a run elsewhere though none at the end of the
    fit."""
    tested = [one for one in suspects if one.name in checks]
    known = [one for one in tested if one.kind == "law" or not checks[one.name].unchecked]
    known.sort(key=lambda one: -checks[one.name].gain)
    return [one for k, one in enumerate(known) if k < MOST or one.kind in ("law", "numerical")]


def rivals(suspects: Iterable[Variation], checks: Mapping[str, AssumptionTest]) -> list[Variation]:
    """Suspects that the data favour to first order nearly as much as the likeliest one, if there
    are any: only new fits can tell them apart, or where estimates are under a single one."""
    favoured = [one for one in suspects if one.name in checks and checks[one.name].suspected]
    best = max((checks[one.name].gain for one in favoured), default=0.0)
    near = [one for one in favoured if checks[one.name].gain > RIVAL * best]
    return near if len(near) > 1 or any(checks[one.name].far for one in near) else []


def with_scores(checks: Sequence[AssumptionTest], dof: int) -> list[AssumptionTest]:
    """Tests with scores: shares of the evidence, by Schwarz's criterion and `TEMPERED`, of the
    suspects that pass the tests of a fit with `dof` degrees of freedom, or of all where none does.
    A new fit with a law that holds or does not has no amplitude."""
    out = list(checks)
    favoured = [one for one in out if one.suspected]
    some = [one for one in favoured if one.passed] or favoured
    if not some:
        return out
    rest = max(1.0, min(one.left for one in some) / dof)
    amplitudes = [
        one.amount
        if one.kind == "several"
        else float(not one.refitted or one.kind in ("known", "sensor"))
        for one in some
    ]
    left = np.array([one.left for one in some])
    deviance = left / rest + np.log(dof) * np.array(amplitudes)
    likelihood = np.exp(-0.5 * TEMPERED * (deviance - deviance.min()))
    for one, share in zip(some, likelihood / likelihood.sum()):
        out[out.index(one)] = replace(one, score=float(share))
    return out


def compared(checked: Checked, judge: Judge) -> Checked:
    """Tests with scores, and what is left under the likeliest suspect."""
    out = with_scores(checked.checks, judge.dof)
    favoured = [one for one in out if one.suspected]
    if not favoured:
        return checked._replace(alarms=checked.as_stated)
    besides, alone, left = judge.besides(max(favoured, key=lambda one: one.score), out)
    return checked._replace(checks=out, besides=besides, alarms=tuple(alone), left=tuple(left))
