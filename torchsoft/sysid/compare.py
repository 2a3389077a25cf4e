"""Comparison of competing laws: fits of each to the recordings, and the law that the data favour.

The rule. Against every other law b, a law a has the evidence, in nats,

    E = LR_fitted / c + LR_heldout / c - max(0, k_a - k_b) ln(n) / 2,        z = LR / sd(LR),

LR being the logarithm of the ratio of the likelihoods, k the number of what each has fitted, n the
samples that were fitted. That is the logarithm of Bayes' factor, with Schwarz's approximation for
the recordings that were fitted and the predictive density for those that were held out, but that no
law is named for having fewer parameters. LR changes with the noise by sd(LR), which is the whitened
distance D of the two predictions where the noise is as stated; c >= 1 is how much its variance
grows by what the residuals of a have of size and colour (quasi-likelihood: Burnham and Anderson
2002, section 2.5). z is Vuong's statistic (1989) for given motions: with samples drawn at random it
would take evidence that stands in a few of them, as of one slip, for luck.

Law a is named if against every other law E >= `EVIDENCE` and z >= `APART`, whatever a tenth of the
tolerance changes in E, if the held-out recordings do not speak against it (z_heldout > -`APART`),
if every fit has converged, and if its own residuals are as large as the noise (chi-squared, p >=
`FITS`) and do not follow the motion (`misfit`). With noise as stated a wrong law is named with a
probability of at most 6e-4, whatever D, and the right one with 95 % from D = 7.3 on. Else the
answer is that the data cannot tell, or that no law fits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from scipy import stats
from scipy.sparse.linalg import spsolve_triangular

from torchsoft.display import suggestion
from torchsoft.files import write_json
from torchsoft.parallel import single_threaded
from torchsoft.sysid.colour import allow_for_colour
from torchsoft.sysid.fit import Fit, Stage, Unreachable
from torchsoft.sysid.identification import RTOL
from torchsoft.sysid.noise import Autoregression, fit_noise, log_det
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.residual_tests import (
    Part,
    ResidualTest,
    judge_residuals,
    parts,
    residual_findings,
)
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sentences import Finding
from torchsoft.sysid.stages import FINER, continued, default_plan, run_plan

EVIDENCE = 5.0
"""Logarithm of Bayes' factor from which evidence is very strong (Kass and Raftery 1995)."""

APART = 2.0
"""Standard deviations by which a likelihood ratio must differ from zero."""

FITS = 1e-3
"""p-value of the sum of squared residuals below which a law does not explain the data."""

CLOSE = 1e-3
"""Relative tolerance of the last fits, on the misfit and on the coordinates."""

SAME = 1e-6
"""Relative difference below which signals of two references are equal."""

COLOUR = 3
"""Largest order of the autoregression that gives the variance of a likelihood ratio its
correlation."""


# Result of a comparison


Outcome = Literal["law", "cannot tell", "none fits"]


@dataclass(frozen=True)
class LawFit:
    """Results of one law: the number of its parameters, the log likelihood of the fitted samples in
    SI units, the reduced chi-squared with its p-value, the Bayesian information criterion, and the
    log density per sample of held-out recordings, with the p-value of their sum of
    squares. `numerical` is the change of the log likelihood by a tenth of the tolerance; `left` has
    findings on deviations of the residuals from the stated noise, by the tests of
    `torchsoft.sysid.residual_tests`, and `patterned` is whether residuals follow the motion."""

    name: str
    parameters: int
    estimates: dict[str, float]
    log_likelihood: float
    chi2: float
    p: float
    bic: float
    heldout: float | None
    heldout_p: float | None
    numerical: float
    converged: bool
    left: list[Finding]
    patterned: bool

    @property
    def misses(self) -> dict[str, Any]:
        """Facts on why the law does not explain the data; empty if it does."""
        if self.p < FITS:
            return {"chi2": self.chi2, "p": self.p}
        if self.heldout_p is not None and self.heldout_p < FITS:
            return {"heldout_p": self.heldout_p}
        return {"patterned": "the motion"} if self.patterned else {}


@dataclass(frozen=True)
class Versus:
    """The best law against another one: log likelihood ratios of fitted and of held-out samples,
    the whitened distance D of the predictions, the inflation c of the variance, E and z of the
    rule, z of held-out recordings alone, and the change of E by a tenth of the tolerance."""

    best: str
    other: str
    fitted: float
    heldout: float | None
    distance: float
    inflation: float
    evidence: float
    z: float
    z_heldout: float | None
    numerical: float

    @property
    def doubts(self) -> list[Finding]:
        """Why the other law is not refuted; empty if it is."""
        facts, out = {"best": self.best, "other": self.other}, list[Finding]()
        if self.z_heldout is not None and self.z_heldout <= -APART:
            out.append(Finding("law-contradicted", "note", {**facts}))
        sure = self.evidence - self.numerical
        if sure < EVIDENCE or self.z < APART:
            numbers = {"evidence": self.evidence, "enough": EVIDENCE, "z": self.z, "apart": APART}
            if self.evidence >= EVIDENCE > sure and self.z >= APART:
                numbers["numerical"] = self.numerical
            elif self.distance < 2 * APART:
                numbers["distance"] = self.distance
            out.append(Finding("law-evidence", "note", facts | numbers))
        return out


@dataclass(frozen=True)
class Comparison:
    """Competing laws, the best first, and the best against every other. `law` is the law named by
    the data, if any, and `findings` the conclusion."""

    outcome: Outcome
    law: str | None
    findings: list[Finding]
    laws: list[LawFit]
    against: list[Versus]

    @property
    def verdict(self) -> str:
        """The conclusion in words."""
        return " ".join(map(str, self.findings))

    def __getitem__(self, name: str) -> LawFit:
        for one in self.laws:
            if one.name == name:
                return one
        raise KeyError(
            f"no law `{name}` was compared; "
            f"{suggestion(name, [one.name for one in self.laws], 'there are')}"
        )

    def save(self, path: str | Path) -> None:
        """Write the JSON file. It appears whole or not at all."""
        write_json(path, asdict(self) | {"verdict": self.verdict})

    def table(self) -> str:
        """A line for each law, with differences from the best."""
        head = ("law", "k", "log L", "chi2", "dBIC", "held out")
        rows = ["{:20s} {:>3s} {:>11s} {:>7s} {:>9s} {:>9s}".format(*head)]
        least = min(one.bic for one in self.laws)
        for one in self.laws:
            own = f"{one.name:20s} {one.parameters:3d} {one.log_likelihood:11.1f} {one.chi2:7.3f}"
            density = "" if one.heldout is None else f" {one.heldout:9.3f}"
            rows.append(f"{own} {one.bic - least:9.1f}{density}")
        return "\n".join(rows)


def judged(
    laws: Sequence[LawFit], against: Sequence[Versus]
) -> tuple[Outcome, str | None, list[Finding]]:
    """Outcome, named law, and findings, by the rule."""
    best, doubts = laws[0], [doubt for versus in against for doubt in versus.doubts]
    refuted = [versus for versus in against if not versus.doubts]
    if best.misses:
        ahead = [f"`{versus.other}`" for versus in refuted]
        facts = {"best": best.name, "ahead": ahead} | best.misses
        return "none fits", None, [Finding("no-law", "error", facts)]
    for one in laws:
        if not one.converged:
            doubts.append(Finding("law-unconverged", "note", {"law": one.name}))
    if doubts:
        return "cannot tell", None, [Finding("laws-alike", "warning"), *doubts]
    cases = [{"other": one.other, "evidence": one.evidence, "z": one.z} for one in refuted]
    facts = {"law": best.name, "cases": cases}
    return "law", best.name, [Finding("law", "note", facts), *best.left]


# Densities of recordings under a law


class Density(NamedTuple):
    """Predictive density of some recordings under a law: whitened residuals r (m,), s = S^-1 r with
    S = 1 + J C J' the covariance of the prediction in units of the noise, and the logarithm of the
    samples' density in SI units. Samples that saturation has changed are in no part."""

    parts: list[Part]
    r: Array
    s: Array
    log: float

    @property
    def samples(self) -> int:
        return sum(len(part.t) for part in self.parts)

    @property
    def p(self) -> float:
        """p-value of the weighted sum of squared residuals."""
        return float(stats.chi2.sf(self.r @ self.s, self.samples))


def density(
    problem: Problem, which: Sequence[str], r: Array, spread: Array | None = None
) -> Density:
    """Density of whitened residuals r (m,), with the uncertainty of the estimates in `spread` (m,
    n) = J C^(1/2)."""
    mine, s, log = parts(problem, r, which), r, 0.0
    if spread is not None:
        inner = np.eye(spread.shape[1]) + spread.T @ spread
        s = r - spread @ np.linalg.solve(inner, spread.T @ r)
        log = -0.5 * float(np.linalg.slogdet(inner)[1])
    log -= 0.5 * float(r @ s)
    for one in mine:
        log -= len(one.t) * float(np.log(problem.sensors[one.channel].sd * (2 * np.pi) ** 0.5))
        if one.noise is not None:
            log -= 0.5 * log_det(one.noise.whitener(one.t))
    return Density(mine, r, s, log)


class Evidence(NamedTuple):
    """Densities under a law, by its fit, of the fitted recordings and of held-out ones, from runs
    with a tenth of the fit's tolerance; `numerical` is the change that this makes. `tests` are
    those of the residuals."""

    name: str
    fit: Fit
    parameters: int
    fitted: Density
    heldout: Density | None
    numerical: float
    tests: list[ResidualTest]

    @property
    def total(self) -> float:
        """Logarithm of the density of all recordings, less Schwarz's penalty."""
        held = 0.0 if self.heldout is None else self.heldout.log
        penalty = 0.5 * self.parameters * float(np.log(len(self.fitted.r)))
        return self.fitted.log + held - penalty

    def result(self) -> LawFit:
        """Results of the law."""
        r, k, held = self.fitted.r, self.parameters, self.heldout
        square, dof = float(r @ r), max(self.fitted.samples - int(self.fit.free.sum()), 1)
        return LawFit(
            self.name,
            k,
            {
                one.label: one.to_value(x)
                for one, x in zip(self.fit.coordinates, self.fit.x[self.fit.free])
            },
            self.fitted.log,
            square / dof,
            float(stats.chi2.sf(square, dof)),
            k * float(np.log(len(r))) - 2 * self.fitted.log,
            None if held is None else held.log / len(held.r),
            None if held is None else held.p,
            self.numerical,
            self.fit.converged,
            residual_findings(self.tests),
            any(test.alarming and test.test == "motion" for test in self.tests),
        )


def evidence_of(name: str, fit: Fit, heldout: Sequence[str] = ()) -> Evidence:
    """The evidence for a law at the end of its fit. Raises `ValueError` where a run fails."""
    problem, free, low_high = fit.problem, fit.free, fit.bounds

    def at(which: Sequence[str], rtol: float, jacobian: bool) -> tuple[Residuals, Array]:
        """Residuals at the estimates, and those of the samples alone."""
        got = problem.residuals(fit.runner, fit.x, which, rtol, free if jacobian else None)
        if got.failed:
            raise ValueError(
                f"the law `{name}` cannot be run at its estimates: {Unreachable(got.failed)}"
            )
        return got, got.r[: problem.samples(which)]

    _, usual = at(fit.which, fit.rtol, False)
    fine, r = at(fit.which, FINER * fit.rtol, True)
    fitted, J, held = density(problem, fit.which, r), fine.J[:, free], None
    if heldout:
        low, high = low_high
        F = J.T @ J + np.diag(12 / (high - low) ** 2)  # what is unknown is between its bounds
        there, r_held = at(heldout, FINER * fit.rtol, True)
        root = np.linalg.cholesky(F)
        spread = np.linalg.solve(root, there.J[: len(r_held), free].T).T
        held = density(problem, heldout, r_held, np.asarray(spread, np.float64))
    count = int(free.sum()) + sum(one.order + 1 for one in problem.noise.values())
    numerical = abs(0.5 * float(usual @ usual - r @ r))
    tests = judge_residuals(fitted.parts, fine.r, J)
    return Evidence(name, fit, count, fitted, held, numerical, tests)


class Ratio(NamedTuple):
    """Log likelihood ratio, its variance under the stated noise, and its variance with the size and
    colour of the residuals."""

    log: float
    stated: float
    variance: float

    @property
    def inflation(self) -> float:
        return self.variance / self.stated if self.stated > 0 else 1.0

    @property
    def z(self) -> float:
        return self.log / self.variance**0.5 if self.variance > 0 else 0.0


def ratio(a: Density, b: Density) -> Ratio:
    """Likelihood ratio of two laws, with its variance under noise about the prediction of the
    first.

    The logarithm changes with the samples by the difference of the scores. Its variance is computed
    for the noise as stated, and for noise with the size and the colour of the first law's
    residuals, modelled as an autoregression of estimated order. The larger variance counts.
    """
    stated = variance = 0.0
    for mine, its in zip(a.parts, b.parts):
        other = b.s[its.rows]
        if mine.noise != its.noise:
            other = other if its.noise is None else its.noise.whitener(its.t).T @ other
            other = coloured(other, mine.noise, mine.t)
        score = other - a.s[mine.rows]
        left = fit_noise([(mine.t, a.r[mine.rows])], most=COLOUR).noise
        stated += float(score @ score)
        variance += float(np.sum(coloured(score, left, mine.t) ** 2))
    return Ratio(a.log - b.log, stated, max(stated, variance))


def coloured(score: Array, noise: Autoregression | None, t: Array) -> Array:
    """W'^-1 score (m,) for samples at t (m,) [s], with the whitener W of the noise; its squared
    norm is the variance of score' noise."""
    if noise is None:
        return score
    return spsolve_triangular(noise.whitener(t).T.tocsr(), score, lower=False)


def versus(best: Evidence, other: Evidence) -> Versus:
    """The best law against another, by the rule of `torchsoft.sysid.compare`."""
    fitted = every = ratio(best.fitted, other.fitted)
    evidence, held = fitted.log / fitted.inflation, None
    if best.heldout is not None and other.heldout is not None:
        held = ratio(best.heldout, other.heldout)
        evidence += held.log / held.inflation
        every = Ratio(*(a + b for a, b in zip(fitted, held)))
    more = max(best.parameters - other.parameters, 0)
    return Versus(
        best.name,
        other.name,
        fitted.log,
        None if held is None else held.log,
        every.stated**0.5,
        every.inflation,
        evidence - 0.5 * more * float(np.log(len(best.fitted.r))),
        every.z,
        None if held is None else held.z,
        (best.numerical + other.numerical) / fitted.inflation,
    )


# Competing laws, each with its own unknowns


@single_threaded()
def compare(
    laws: Mapping[str, Problem],
    *,
    heldout: Sequence[str] = (),
    plans: Mapping[str, Sequence[Stage]] | None = None,
    rtol: float = RTOL,
    starts: int = 1,
    workers: int = 1,
    checkpoint: Mapping[str, Path] | None = None,
    progress: bool = False,
) -> Comparison:
    """Fit every law to the same recordings, and say which one made them, or that the data cannot
    tell: `Comparison.verdict`, by the rule of `torchsoft.sysid.compare`.

    `laws` are problems by name with the same recordings and sensors, on rigs with other laws, and
    with unknowns of their own: `dataclasses.replace(recording, rig=...)` makes such a recording.
    Bounds belong to the law: one that contains another (a standard linear solid with any
    instantaneous modulus contains Kelvin and Voigt's) is never behind it by more than its penalty,
    unless its bounds keep it away from the other. Noise is what the sensors state: where one
    declares its `colour` it is found for every law, but no law may explain what it misses as noise
    that nobody declared.

    Recordings named in `heldout` are predicted, not fitted. `plans`, `rtol`, `starts` and `workers`
    are those of `identify`; `checkpoint` has a folder for each law, which may be that of an
    identification of it: what that has run is not run again. Every law but the best is fitted once
    more from where the best one ended, as far as they share coordinates, and the better end is
    kept: no law is to lose by its start.

    Raises `ValueError` for laws that were not given the same data, and for a law that cannot follow
    the data.
    """
    check_alike(laws, heldout)
    evidence = dict[str, Evidence]()
    for name, problem in laws.items():
        which = [one for one in problem.names if one not in heldout]
        runner = Runner(problem.recordings, workers, (checkpoint or {}).get(name))
        start = Fit(problem, runner, problem.coordinates.start, progress=progress)
        try:
            plan = (plans or {}).get(name)
            if plan is None:
                plan = default_plan(problem, runner, rtol, which, starts)
            evidence[name] = evidence_of(name, fitted(name, start, which, plan), heldout)
        except Unreachable as error:
            raise ValueError(f"the law `{name}` cannot follow the recordings: {error}") from None
    best = max(evidence.values(), key=lambda one: one.total)
    for name, own in evidence.items():
        again = None if own is best else refitted(own.fit, best.fit)
        if again is not None:
            evidence[name] = max(
                own, evidence_of(name, again, heldout), key=lambda one: one.fitted.log
            )
    first, *others = sorted(evidence.values(), key=lambda one: -one.total)
    against = [versus(first, one) for one in others]
    results = [one.result() for one in (first, *others)]
    return Comparison(*judged(results, against), results, against)


def check_alike(laws: Mapping[str, Problem], heldout: Sequence[str]) -> None:
    """Raises `ValueError` where the laws have different data."""
    if len(laws) < 2:
        raise ValueError(f"a comparison needs two laws or more, not {len(laws)}")
    (first, one), *others = laws.items()
    if set(heldout) - set(one.names) or not set(one.names) - set(heldout):
        raise ValueError(
            f"`heldout` must name some of {list(one.names)}, but not all; it is {list(heldout)}"
        )
    for name, other in others:
        both = f"the laws `{first}` and `{name}`"
        if one.names != other.names:
            raise ValueError(
                f"{both} have other recordings: {', '.join(one.names)} and {', '.join(other.names)}"
            )
        if one.sensors != other.sensors:
            raise ValueError(
                f"{both} have other sensors, so that their likelihoods are of other data"
            )
        for mine, its in zip(one.recordings, other.recordings):
            a, b = mine.samples, its.samples
            if a.keys() != b.keys() or not all(np.array_equal(a[c], b[c]) for c in a):
                raise ValueError(f"recording `{mine.name}` of {both} has other samples")
            if not same_reference(mine, its):
                raise ValueError(
                    f"the rigs of {both} follow another reference in recording `{mine.name}`"
                )


def same_reference(one: Recording, other: Recording) -> bool:
    """Whether the signals that both rigs have are equal."""
    both = [name for name in one.rig.signals if name in other.rig.signals]
    t = torch.from_numpy(one.times)
    a, b = (r.rig.reference(t, both)[..., 0].detach() for r in (one, other))
    return bool(((a - b).abs().amax(0) <= SAME * a.abs().amax(0)).all())


def fitted(name: str, start: Fit, which: Sequence[str], plan: Sequence[Stage]) -> Fit:
    """A law at the end of its plan, with its noise estimated where sensors declare colour. Raises
    `Unreachable`."""
    if not plan or list(plan[-1].recordings) != list(which):
        raise ValueError(f"the last stage of the plan of `{name}` must fit {', '.join(which)}")
    fit = run_plan(start, plan, label=f"{name} ")
    if fit.failure is not None:  # laws are compared by the same tolerance
        raise fit.failure
    return allow_for_colour(fit)


def refitted(law: Fit, best: Fit) -> Fit | None:
    """The law fitted once more, from the estimates of another; None where they share no coordinate,
    or the fit cannot start there."""
    x, every = law.x.copy(), zip(best.problem.coordinates.all, best.x)
    known = {one.label: one.to_value(v) for one, v in every}
    for i, one in enumerate(law.problem.coordinates.all):
        if law.free[i] and one.label in known:
            x[i] = one.to_x(float(np.clip(known[one.label], one.low, one.high)))
    if (x == law.x).all():
        return None
    stage = Stage("again", law.which, law.labels, law.rtol, tolerance=CLOSE)
    return continued(law._replace(x=x), stage)
