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
from typing import Literal, NamedTuple

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
from torchsoft.sysid.plan import FINER, continued, default_plan, run_plan
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.residual_tests import (
    Part,
    judge_residuals,
    parts,
    residual_findings,
)
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sentences import Finding

# Result of a comparison


EVIDENCE = 5.0
"""Logarithm of Bayes' factor from which evidence is very strong (Kass and Raftery 1995)."""

APART = 2.0
"""Standard deviations by which a likelihood ratio must differ from zero."""

FITS = 1e-3
"""p-value of the sum of squared residuals below which a law does not explain the data."""

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
    def misses(self) -> str:
        """Why the law does not explain the data, as the end of a sentence; empty if it does."""
        if self.p < FITS:
            return f"has chi2 = {self.chi2:.3g} (p = {self.p:.1g})"
        if self.heldout_p is not None and self.heldout_p < FITS:
            return f"misses the held-out recordings (p = {self.heldout_p:.1g})"
        return "leaves residuals that follow the motion" if self.patterned else ""

    @property
    def fits(self) -> bool:
        """Whether the law explains the fitted and the held-out recordings."""
        return not self.misses


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
    def doubts(self) -> list[str]:
        """Clauses on why the other law is not refuted; empty if it is."""
        a, b, out = f"`{self.best}`", f"`{self.other}`", []
        if self.z_heldout is not None and self.z_heldout <= -APART:
            out.append(
                f"held-out recordings speak for {b} and fitted ones for {a}, each by more than "
                "noise does"
            )
        sure = self.evidence - self.numerical
        if sure < EVIDENCE or self.z < APART:
            doubt = (
                f"the evidence for {a} over {b} is {self.evidence:.2g} nats ({EVIDENCE:g} are "
                f"needed), and z = {self.z:.2g} ({APART:g} is needed)"
            )
            if self.evidence >= EVIDENCE > sure and self.z >= APART:
                doubt += (
                    f", but the steps of the simulation move that by {self.numerical:.2g}: take a "
                    "tighter tolerance"
                )
            elif self.distance < 2 * APART:
                doubt += (
                    f"; their predictions differ by {self.distance:.2g} times the noise over all "
                    "samples together, so that these motions and sensors cannot tell them apart"
                )
            out.append(doubt)
        return out


@dataclass(frozen=True)
class Comparison:
    """Competing laws, the best first, and the best against every other. `law` is the law named by
    the data, if any, and `verdict` the conclusion in plain words."""

    outcome: Outcome
    law: str | None
    verdict: str
    laws: list[LawFit]
    against: list[Versus]
    samples: int
    heldout: list[str]

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
        write_json(path, asdict(self))

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


def judged(laws: list[LawFit], against: list[Versus]) -> tuple[Outcome, str | None, str]:
    """Outcome, named law, and verdict, by the rule."""
    best = laws[0]
    doubts = [doubt for versus in against for doubt in versus.doubts]
    unsure = [
        f"the fit of `{one.name}` has not converged, so it may be better than it looks"
        for one in laws
        if not one.converged
    ]
    ahead = [v.other for v in against if not v.doubts]
    if not best.fits:
        verdict = f"none of the laws explains these data: the best, `{best.name}`, {best.misses}"
        if ahead:
            verdict += f"; it is nearer than {listed(ahead)}, but that does not make it right"
        return (
            "none fits",
            None,
            f"{verdict}. Or the noise is not as it was stated: it is larger, or coloured.",
        )
    if doubts or unsure:
        return "cannot tell", None, "the data cannot tell: " + "; ".join((*doubts, *unsure)) + "."
    sentences = [f"`{best.name}` made these data"]
    for versus in against:
        sentences.append(
            f"`{versus.other}` is behind by {versus.evidence:.3g} nats, {versus.z:.2g} standard "
            "deviations"
        )
    verdict = " ".join([". ".join(sentences) + ".", *map(str, best.left)])
    return "law", best.name, verdict


def listed(names: list[str]) -> str:
    return " and ".join(f"`{name}`" for name in names)


# Densities of recordings under a law


COLOUR = 3
"""Largest order of the autoregression that gives the variance of a likelihood ratio its
correlation."""


class Density(NamedTuple):
    """Predictive density of some recordings under a law: whitened residuals r (m,), s = S^-1 r with
    S = 1 + J C J' the covariance of the prediction in units of the noise, and the logarithm of the
    samples' density in SI units."""

    parts: list[Part]
    r: Array
    s: Array
    log: float

    @property
    def p(self) -> float:
        """p-value of the weighted sum of squared residuals."""
        return float(stats.chi2.sf(self.r @ self.s, self.samples))

    @property
    def samples(self) -> int:
        """Number of samples that saturation has not changed."""
        return sum(len(part.t) for part in self.parts)


def density(
    problem: Problem, which: Sequence[str], r: Array, spread: Array | None = None
) -> Density:
    """Density of whitened residuals r (m,), with the uncertainty of the estimates in `spread` (m,
    n) = J C^(1/2)."""
    mine, s, wider = parts(problem, r, which), r, 0.0
    if spread is not None:
        inner = np.eye(spread.shape[1]) + spread.T @ spread
        s, wider = (
            r - spread @ np.linalg.solve(inner, spread.T @ r),
            float(np.linalg.slogdet(inner)[1]),
        )
    log = -0.5 * (float(r @ s) + wider)
    for one in mine:
        log -= len(one.t) * np.log(problem.sensors[one.channel].sd * (2 * np.pi) ** 0.5)
        if one.noise is not None:
            log -= 0.5 * log_det(one.noise.whitener(one.t))
    return Density(mine, r, s, float(log))


class Evidence:
    """Densities under a law, by its fit, of the fitted recordings and of held-out ones.

    They come from runs with a tenth of the fit's tolerance; `numerical` is the change that this
    makes. Raises `ValueError` where a run fails.
    """

    def __init__(self, name: str, fit: Fit, heldout: Sequence[str] = ()) -> None:
        self.name, self.fit, which, free = name, fit, fit.which, fit.free
        problem = fit.problem
        self.parameters = int(free.sum()) + sum(one.order + 1 for one in problem.noise.values())
        m = problem.samples(which)
        usual = self._at(which, fit.rtol, False).r[:m]
        at = self._at(which, FINER * fit.rtol, True)
        J = at.J[:, free]
        self.fitted = density(problem, which, at.r[:m])
        self.tests = judge_residuals(self.fitted.parts, at.r, J)
        self.numerical = abs(0.5 * float(usual @ usual - self.fitted.r @ self.fitted.r))
        self.dof, self.heldout = max(self.fitted.samples - int(free.sum()), 1), None
        if heldout:
            low, high = fit.bounds
            F = J.T @ J + np.diag(12 / (high - low) ** 2)  # what is unknown is between its bounds
            m, at = problem.samples(heldout), self._at(heldout, FINER * fit.rtol, True)
            spread = np.linalg.solve(np.linalg.cholesky(F), at.J[:m, free].T).T
            self.heldout = density(problem, heldout, at.r[:m], np.asarray(spread, np.float64))

    def _at(self, which: Sequence[str], rtol: float, derivatives: bool) -> Residuals:
        """Residuals at the estimates, and their Jacobian with `derivatives`."""
        fit = self.fit
        at = fit.problem.residuals(
            fit.runner, fit.x, which, rtol, fit.free if derivatives else None
        )
        if at.failed:
            raise ValueError(
                f"the law `{self.name}` cannot be run at its estimates: {Unreachable(at.failed)}"
            )
        return at

    @property
    def total(self) -> float:
        """Logarithm of the density of all recordings, less Schwarz's penalty."""
        penalty = 0.5 * self.parameters * np.log(len(self.fitted.r))
        return (
            self.fitted.log
            + (self.heldout.log if self.heldout is not None else 0.0)
            - float(penalty)
        )


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
        score = b.s[its.rows] - a.s[mine.rows]
        if mine.noise != its.noise:
            other_score = (
                b.s[its.rows] if its.noise is None else its.noise.whitener(its.t).T @ b.s[its.rows]
            )
            score = coloured(other_score, mine.noise, mine.t) - a.s[mine.rows]
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


# Competing laws, each with its own unknowns


SAME = 1e-6
"""Relative difference below which signals of two references are equal."""

CLOSE = 1e-3
"""Relative tolerance of the last fits, on the misfit and on the coordinates."""


@single_threaded()
def compare(
    laws: Mapping[str, Problem],
    *,
    heldout: Sequence[str] = (),
    plans: Mapping[str, Sequence[Stage]] | None = None,
    rtol: float = RTOL,
    starts: int = 1,
    workers: int = 1,
    checkpoint: str | Path | Mapping[str, str | Path] | None = None,
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

    Recordings named in `heldout` are predicted, not fitted. `plans`, `rtol`, `starts`, `workers`
    and the folder `checkpoint` are those of `identify`; a mapping has a folder for each law, which
    may be that of an identification of it: what that has run is not run again. Every law but the
    best is fitted once more from where the best one ended, as far as they share coordinates, and
    the better end is kept: no law is to lose by its start.

    Raises `ValueError` for laws that were not given the same data, and for a law that cannot follow
    the data.
    """
    check_alike(laws, heldout)
    which = [name for name in next(iter(laws.values())).names if name not in heldout]
    folders = dict(checkpoint) if isinstance(checkpoint, Mapping) else {}
    if checkpoint is not None and not isinstance(checkpoint, Mapping):
        folders = {name: Path(checkpoint) / name for name in laws}
    evidence = dict[str, Evidence]()
    for name, problem in laws.items():
        own = folders.get(name)
        runner = Runner(problem.recordings, workers, Path(own) if own is not None else None)
        start = Fit(problem, runner, problem.coordinates.start, progress=progress)
        try:
            plan = (plans or {}).get(name)
            if plan is None:
                plan = default_plan(problem, runner, rtol, which, starts)
            evidence[name] = Evidence(name, fitted(name, start, which, plan), heldout)
        except Unreachable as error:
            raise ValueError(f"the law `{name}` cannot follow the recordings: {error}") from None
    best = max(evidence, key=lambda name: evidence[name].total)
    for name in (name for name in laws if name != best):
        other = refitted(evidence[name].fit, evidence[best].fit)
        if other is not None:
            better = Evidence(name, other, heldout)
            if better.fitted.log > evidence[name].fitted.log:
                evidence[name] = better
    first = max(evidence.values(), key=lambda one: one.total)
    against = [versus(first, one) for one in evidence.values() if one is not first]
    law_list = sorted(law_fits(evidence), key=lambda one: -evidence[one.name].total)
    samples = len(first.fitted.r)
    return Comparison(*judged(law_list, against), law_list, against, samples, list(heldout))


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
            if a.keys() != b.keys() or not all(
                np.array_equal(a[c][i], b[c][i]) for c in a for i in (0, 1)
            ):
                raise ValueError(f"recording `{mine.name}` of {both} has other samples")
            if not same_reference(mine, its):
                raise ValueError(
                    f"the rigs of {both} follow another reference in recording `{mine.name}`"
                )


def same_reference(one: Recording, other: Recording) -> bool:
    """Whether the signals that both rigs have are equal."""
    t = torch.from_numpy(one.times)
    a, b = (
        dict(zip(r.rig.signals, r.rig.follow(t).detach()[..., 0].unbind(-1))) for r in (one, other)
    )
    return all(
        float((a[k] - b[k]).abs().max()) <= SAME * float(a[k].abs().max())
        for k in a.keys() & b.keys()
    )


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
    x, c = law.x.copy(), best.problem.coordinates
    known = {one.label: one.to_value(v) for one, v in zip(c.all, best.x)}
    for i, one in enumerate(law.problem.coordinates.all):
        if law.free[i] and one.label in known:
            x[i] = one.to_x(float(np.clip(known[one.label], one.low, one.high)))
    if (x == law.x).all():
        return None
    stage = Stage("again", law.which, law.labels, law.rtol, tolerance=CLOSE)
    return continued(law._replace(x=x), stage)


def versus(best: Evidence, other: Evidence) -> Versus:
    """The best law against another, by the rule of `torchsoft.sysid.compare`."""
    fitted, n = ratio(best.fitted, other.fitted), len(best.fitted.r)
    evidence = fitted.log / fitted.inflation
    log, stated, variance, held, z = fitted.log, fitted.stated, fitted.variance, None, None
    if best.heldout is not None and other.heldout is not None:
        ahead = ratio(best.heldout, other.heldout)
        evidence, log = evidence + ahead.log / ahead.inflation, log + ahead.log
        stated, variance = stated + ahead.stated, variance + ahead.variance
        held, z = ahead.log, ahead.z
    evidence -= 0.5 * max(best.parameters - other.parameters, 0) * float(np.log(n))
    return Versus(
        best.name,
        other.name,
        fitted.log,
        held,
        stated**0.5,
        variance / stated if stated > 0 else 1.0,
        evidence,
        log / variance**0.5 if variance > 0 else 0.0,
        z,
        (best.numerical + other.numerical) / fitted.inflation,
    )


def law_fits(evidence: Mapping[str, Evidence]) -> list[LawFit]:
    """Results of every law."""
    out = []
    for name, one in evidence.items():
        square, held = float(one.fitted.r @ one.fitted.r), one.heldout
        c, k, n = one.fit.problem.coordinates, one.parameters, len(one.fitted.r)
        found = zip(c.all, one.fit.x, one.fit.free)
        out.append(
            LawFit(
                name,
                k,
                {a.label: a.to_value(x) for a, x, free in found if free},
                one.fitted.log,
                square / one.dof,
                float(stats.chi2.sf(square, one.dof)),
                k * float(np.log(n)) - 2 * one.fitted.log,
                None if held is None else held.log / len(held.r),
                None if held is None else held.p,
                one.numerical,
                one.fit.converged,
                residual_findings(one.tests),
                any(test.alarming and test.test == "motion" for test in one.tests),
            )
        )
    return out
