"""Tests of an identification's assumptions: agreement with the data, and effect on the estimates.

A numerical setting is not known to be right: it enters the intervals as another coordinate, with a
standard normal prior on its amplitude, so that intervals become wider where the data cannot
determine it.
"""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from torchsoft.physics.names import effort_channel
from torchsoft.sysid.assumption_tests import AssumptionTest, Linearised, assumption_test
from torchsoft.sysid.assumptions import Suspect, suspects
from torchsoft.sysid.fit import Fit, fisher
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import ResidualTest
from torchsoft.sysid.search import difference_column, exact_columns, search
from torchsoft.sysid.unknowns import NUISANCES

TEMPERED = 0.46
"""Power of the likelihood in scores. Suspects only resemble what is wrong, so that one is named
beside the best, with a score of 1 %, that leaves `EVIDENT` more of the sum of squares."""


class Checked(NamedTuple):
    """Tests of the assumptions, the likeliest suspect, and columns (m, k) of the numerical settings
    beside the Jacobian (m, n) of the free coordinates."""

    checks: list[AssumptionTest]
    columns: Array
    J: Array
    searched: bool = False
    """Whether suspects were refitted."""
    untried: tuple[str, ...] = ()
    """Tests left out by an interruption."""
    not_refitted: tuple[str, ...] = ()
    """Suspects that were not refitted, since the others took all of the effort."""
    besides: tuple[AssumptionTest, ...] = ()
    """Effects that the data favour besides the likeliest suspect, each beside those before it."""
    fails_as_stated: tuple[ResidualTest, ...] = ()
    """Tests that the residuals of the fit fail."""
    fails_best: tuple[ResidualTest, ...] = ()
    """Tests that residuals under the likeliest suspect fail."""
    fails_besides: tuple[ResidualTest, ...] = ()
    """Tests that they fail with the effects besides also free."""
    sd: Mapping[str, float] = MappingProxyType({})
    """Standard deviations of the free coordinates, by label."""

    @property
    def favoured(self) -> list[AssumptionTest]:
        """Suspects that the data favour, the likeliest first."""
        mine = [one for one in self.checks if one.score > 0.0]
        return sorted(mine, key=lambda one: (-one.score, -one.passed, -one.gain))

    @property
    def explained(self) -> bool:
        """Whether nothing is left under the likeliest suspect alone, and without it something
        is."""
        return bool(self.favoured and self.fails_as_stated) and not self.fails_best

    @property
    def wider(self) -> dict[str, float]:
        """Factor on the standard deviation of every free coordinate by the numerical settings."""
        plain, wider = fisher(self.J)[0], self.covariance()
        return dict(zip(self.sd, np.sqrt(np.diag(wider) / np.diag(plain)).tolist()))

    def covariance(self) -> Array:
        """Covariance (n, n) of the free coordinates, widened by the numerical settings."""
        k, n = self.columns.shape[1], self.J.shape[1]
        rows = np.block([[self.J, self.columns], [np.zeros((k, n)), np.eye(k)]])
        _, R = np.linalg.qr(rows[:, [*range(n, n + k), *range(n)]])
        return fisher(R[k:, k:])[0]

    def widening(self) -> Array:
        """Part (n, n) of that covariance due to the numerical settings."""
        plain = fisher(self.J)[0]
        return self.covariance() - plain if self.columns.size else np.zeros_like(plain)


def check_assumptions(end: Fit, *, doubtful: bool = False, effort: float = 0.0) -> Checked:
    """Score tests of the assumptions at the end of a fit, `search.coarsened`; with an `effort`, the
    search for the cause if it is `doubtful`. An interruption keeps what was tested."""
    scored = score_tests(end, [one for one in suspects_of(end) if doubtful or not one.costly])
    refits = Refits(scored.tests)
    if effort and doubtful and not scored.untried:
        refits = refitted(end, scored, effort)
    linear = scored.linear
    tests = with_scores([*refits.tests.values()], linear.dof)
    numerical = [d for one, d in scored.columns.values() if one.kind == "numerical"]
    done = Checked(
        tests,
        np.stack(numerical, 1) if numerical else np.zeros((len(linear.r), 0)),
        linear.J,
        searched=bool(refits.fits),
        untried=scored.untried + refits.untried,
        not_refitted=()
        if any(c.refitted and c.suspected and c.passed for c in tests)
        else refits.left,
        fails_as_stated=tuple(linear.alarms(linear.r, linear.J)),
        sd=dict(zip(linear.labels, linear.sd.tolist())),
    )
    if not done.favoured:
        return done._replace(fails_best=done.fails_as_stated)
    best = done.favoured[0]
    besides, alone, left = linear.besides(best, refits.fits.get(best.name), scored.columns)
    return done._replace(besides=tuple(besides), fails_best=tuple(alone), fails_besides=tuple(left))


class Scored(NamedTuple):
    """The suspects that were tested, with their tests and columns by name; names of those that an
    interruption left out."""

    linear: Linearised
    tested: list[Suspect]
    tests: dict[str, AssumptionTest]
    columns: dict[str, tuple[Suspect, Array]]
    untried: tuple[str, ...]


def score_tests(end: Fit, every: Sequence[Suspect]) -> Scored:
    """Score tests of suspects, of those that need a run of their own last."""
    exact, J = exact_columns(end, every)
    linear, tests = Linearised(end, J), dict[str, AssumptionTest]()
    columns = dict[str, tuple[Suspect, Array]]()
    alternatives = [one for one in every if one.change is not None]
    found = chain(exact, (difference_column(end, one) for one in alternatives))
    with suppress(KeyboardInterrupt), warnings.catch_warnings(action="ignore"):
        for one, d, reason in found:
            if d is None:
                unchecked = {"left": linear.square, "unchecked": reason}
                tests[one.name] = assumption_test(one, **unchecked)
            elif d.any() or one.change is not None:
                columns[one.name] = one, d
                tests[one.name] = linear.score_test(one, d)
    untried = tuple(one.name for one in alternatives if one.name not in tests)
    return Scored(linear, [one for one in every if one.name in tests], tests, columns, untried)


class Refits(NamedTuple):
    """Tests, those of refitted suspects by their refits, and the refits, by name; suspects that the
    effort, or an interruption, left out."""

    tests: dict[str, AssumptionTest]
    fits: Mapping[str, Fit] = MappingProxyType({})
    left: tuple[str, ...] = ()
    untried: tuple[str, ...] = ()


def refitted(end: Fit, scored: Scored, effort: float) -> Refits:
    """The search for the cause among the suspects with a score test, and laws without one."""
    tests, fits = dict(scored.tests), dict[str, Fit]()
    some = [one for one in scored.tested if one.kind == "law" or one.name in scored.columns]
    left = [one.name for one in some]
    try:
        for test, fit in search(end, some, scored.tests, scored.linear, effort):
            tests[test.name] = test
            left.remove(test.name)
            fits |= {} if fit is None else {test.name: fit}
    except KeyboardInterrupt:
        return Refits(tests, fits, untried=tuple(f"a refit with {name} free" for name in left))
    return Refits(tests, fits, tuple(left))


def suspects_of(end: Fit) -> list[Suspect]:
    """Suspects of the recordings of a fit."""
    problem = end.problem
    recordings = [one for one in problem.recordings if one.name in end.which]
    c = problem.coordinates
    faults = [f"{one.kind} of {one.name}" for one in c.all if one.kind in NUISANCES]
    return suspects(recordings, {*c.names, *faults}, problem.sensors, largest_efforts(end))


def largest_efforts(end: Fit) -> dict[str, float]:
    """Largest effort [N or N.m] of every controller in the runs at the end of a fit."""
    out = dict[str, float]()
    jobs = end.problem.jobs(end.x, end.which, end.at.steps or end.rtol, None)
    for job, run in zip(jobs, end.runner.run(jobs)):
        recording = end.problem.recordings[job.recording]
        if isinstance(run, FailedRun):
            continue
        for name in recording.rig.actuators:
            effort = run.signals[:, recording.channels.index(effort_channel(name))]
            out[name] = max(out.get(name, 0.0), float(np.abs(effort).max()))
    return out


def with_scores(tests: Sequence[AssumptionTest], dof: int) -> list[AssumptionTest]:
    """Tests with scores: shares of the evidence, by Schwarz's criterion and `TEMPERED`, of the
    suspects that the data favour and that pass the tests of a fit with `dof` degrees of freedom, or
    of all where none does. Where suspects were refitted, only these count. An alternative that
    holds or does not has no amplitude to pay for in a refit."""
    out, refitted = list(tests), any(one.refitted for one in tests)
    favoured = [one for one in out if one.suspected and one.refitted == refitted]
    some = [one for one in favoured if one.passed] or favoured
    if not some:
        return out
    rest = max(1.0, min(one.left for one in some) / dof)
    amplitudes = [float(not one.refitted or one.has_amount) for one in some]
    left = np.array([one.left for one in some])
    deviance = left / rest + np.log(dof) * np.array(amplitudes)
    likelihood = np.exp(-0.5 * TEMPERED * (deviance - deviance.min()))
    for one, share in zip(some, likelihood / likelihood.sum()):
        out[out.index(one)] = replace(one, score=float(share))
    return out
