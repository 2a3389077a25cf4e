"""Tests of an identification's assumptions: agreement with the data, and effect on the estimates.

A variation takes one run for each recording, at the estimates, on the same steps: its change d (m,)
of the residuals is another column beside the Jacobian J. The projection of d on J gives the shift
of the estimates; its orthogonal part, along the residuals, the amplitude that the data favour. A
constant of the computation is not known to be right: it enters the intervals as another coordinate,
with a standard normal prior on its amplitude, so that intervals become wider where the data cannot
determine it.
"""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from torchsoft.display import hidden
from torchsoft.sysid.assumptions import AMOUNTS, FAULTS, Assumption, Variation, assumptions
from torchsoft.sysid.fit import Fit, fisher, shift, standard_deviations
from torchsoft.sysid.plan import settle
from torchsoft.sysid.recording import Array
from torchsoft.sysid.refits import (
    NEARLY,
    across,
    columns,
    far_off,
    joint_fit,
    likeness,
    refit,
    shares,
)
from torchsoft.sysid.residual_tests import Verdict, judge_residuals, parts, systematic
from torchsoft.tables import Number, plain

EVIDENT = 20.0
"""Fall of chi2, over the remaining misfit per sample, above which the data favour a variation: four
and a half standard deviations, since some twenty variations are tested."""

PATTERN = 0.5
"""Largest fraction of the residuals' autocorrelation that a favoured variation leaves: a cause
removes the pattern, while coloured noise correlates with anything slow."""

LAGS = 10
"""Number of autocorrelations in this test."""

BY_CHANCE = 2.0
"""Largest statistic of Box and Pierce, over its expectation, that counts as chance."""

MOST = 12
"""Most suspects with which a fit is repeated, besides laws and constants of the computation."""

RIVAL = 0.3
"""Fraction of the best suspect's gain to first order above which another one is its rival."""

FIRST_ORDER = 3.0
"""Standard deviations by which estimates may move in a test to first order."""

TIGHTENINGS = 2
"""Most times that a repeated fit goes on with a tenth of its tolerance."""

BESIDES = 3
"""Most effects that are looked for besides the likeliest suspect."""


@dataclass(frozen=True)
class AssumptionTest(Assumption):
    """Test of one assumption: the effect of its variation by `amount` [unit].

    `moves` is the shift of each estimate in its standard deviations, by label; `gain` the fall of
    the sum of squares, to `left`, at the amplitude that the data favour: `favoured` [unit] with the
    standard deviation `favoured_sd`. `significance` is the gain over the remaining misfit per
    sample, `pattern` the remaining fraction of the residuals' autocorrelation, 0 where there is
    none. With `refitted` the result is that of a new fit, else it is to first order. `unchecked` is
    the reason of a missing test. `value` is the favoured value of the `parameter`, `under` are the
    estimates at the favoured amplitude, by label. `suspected` is whether the data favour the
    variation, `passed` whether residuals under it pass the tests of a fit, and `odds` its share of
    the evidence among all suspects that do. `detectable` is the least amount [unit] that the data
    would show.
    """

    moves: dict[str, Number] = field(default_factory=dict)
    gain: Number = 0.0
    left: Number = 0.0
    favoured: Number = 0.0
    favoured_sd: Number = float("inf")
    significance: Number = 0.0
    pattern: Number = 0.0
    refitted: bool = False
    unchecked: str = ""
    value: Number = float("nan")
    under: dict[str, Number] = field(default_factory=dict)
    odds: Number = 0.0
    suspected: bool | None = None
    passed: bool = False
    detectable: Number = float("inf")

    def __post_init__(self) -> None:
        if self.suspected is None:
            either_side = self.kind in ("known", "sensor") and not self.one_sided
            enough = (
                self.significance > EVIDENT
                and self.pattern < PATTERN
                and (either_side or self.favoured > 0)
            )
            object.__setattr__(self, "suspected", enough and not self.beyond_first_order)

    @property
    def beyond_first_order(self) -> bool:
        """Whether a parameter of the rig would have to vanish or to double, so that a test to first
        order is void."""
        return (
            self.kind == "known"
            and self.unit == "%"
            and not self.refitted
            and abs(self.favoured) >= 100
        )

    @property
    def falls(self) -> str:
        """The fall of the sum of squares, as the end of a sentence."""
        return (
            f"falls by {self.gain:.0f} in a new fit"
            if self.refitted
            else f"would fall by {self.gain:.0f}"
        )

    @property
    def found(self) -> str:
        """The variation that fits best, as the end of a sentence."""
        if self.kind == "several":
            return self.otherwise
        amount = f"{self.favoured:+.3g} {self.unit}".rstrip()
        if self.parameter and self.unit == "%":
            return (
                f" with {self.parameter} = {self.value:.6g} ({amount}, +- {self.favoured_sd:.2g})"
            )
        if self.parameter:
            sd = self.favoured_sd * self.step / self.amount
            return f" with {self.parameter} = {self.value:.4g} +- {sd:.2g} {self.unit}".rstrip()
        if self.kind in ("known", "sensor"):
            return f" if {self.otherwise} ({amount} fit best, +- {self.favoured_sd:.2g})"
        return f" if {self.otherwise}"

    @property
    def impact(self) -> tuple[str, float, float]:
        """Label of the coordinate that moves most, its shift in standard deviations, and the amount
        [unit] that makes it: the largest that the data would not show, up to `AMOUNTS` times that
        of the variation."""
        size = min(self.detectable, AMOUNTS * self.amount)
        label, move = self.most_moved
        return label, move * size / self.amount, size

    @property
    def shift(self) -> tuple[str, float]:
        """Label of the coordinate that moves most under the variation, and by how many of its
        standard deviations."""
        label, move = self.most_moved
        linear = self.kind in ("known", "sensor") and not self.refitted
        return label, move * self.favoured / self.amount if linear else move

    @property
    def far(self) -> bool:
        """Whether estimates under the variation are too far away for a test to first order."""
        return not self.refitted and abs(self.shift[1]) > FIRST_ORDER

    @property
    def most_moved(self) -> tuple[str, float]:
        """Label of the coordinate with the largest shift, and the shift in standard deviations."""
        return max(self.moves.items(), key=lambda item: abs(item[1]), default=("", 0.0))


def assumption_test(one: Assumption, **outcome: Any) -> AssumptionTest:
    """The test of an assumption with this outcome."""
    return AssumptionTest(
        **{each.name: getattr(one, each.name) for each in fields(Assumption)}, **outcome
    )


class Again(NamedTuple):
    """A repeated fit with some assumptions varied at once, and their tests to first order."""

    name: str
    tried: list[Variation]
    linear: list[AssumptionTest]
    fit: Fit


class Checked(NamedTuple):
    """All tests; columns (m, k) of the constants of the computation, and the Jacobian (m, n) of the
    free coordinates."""

    checks: list[AssumptionTest]
    columns: Array
    J: Array
    untried: tuple[str, ...] = ()
    """Tests left out by an interruption."""
    candidates: tuple[str, ...] = ()
    """Suspects that only new fits can judge: none explains the misfit to first order, or several
    do."""
    besides: tuple[AssumptionTest, ...] = ()
    """Effects that the data favour to first order besides the likeliest suspect, each beside those
    before it."""
    alarms: tuple[Verdict, ...] = ()
    """Alarms of the residuals under the likeliest suspect, or of the fit without a suspect."""
    left: tuple[Verdict, ...] = ()
    """Alarms under the likeliest suspect and the effects besides."""
    as_stated: tuple[Verdict, ...] = ()
    """Alarms of the residuals of the fit itself."""
    sd: Mapping[str, float] = MappingProxyType({})
    """Standard deviations of the free coordinates, by label."""

    @property
    def favoured(self) -> list[AssumptionTest]:
        """Suspects that the data favour, the likeliest first, those that pass the tests before
        others."""
        mine = [one for one in self.checks if one.suspected]
        return sorted(mine, key=lambda one: (-one.odds, -one.passed, -one.gain))

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


def check_assumptions(end: Fit, *, doubtful: bool = False, explain: bool = False) -> Checked:
    """Tests of the assumptions at the end of a fit, `refits.coarsened`, to first order.

    With `explain` a `doubtful` fit is repeated without one assumption after the other, until one
    explains the misfit: a test to first order says little where a fit has run far off.
    """
    candidates, problem = list[Variation](), end.problem
    recordings = [recording for recording in problem.recordings if recording.name in end.which]
    c = problem.coordinates
    faults = [f"{one.kind} of {one.name}" for one in c.all if one.kind in FAULTS]
    every = assumptions(recordings, {*c.names, *faults}, problem.sensors)
    taken = [one for one in every if doubtful or not one.costly]
    checks, constants = dict[str, AssumptionTest](), list[Array]()
    untried = [one.name for one in taken if one.vary is not None]
    # such as of pads that creep longer than the lead of a run
    with warnings.catch_warnings(action="ignore"):
        found, J = columns(end, taken)
    judge = Judge(end, J)
    try:
        for one, d, reason in found:
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
        if explain and candidates:
            untried = [f"a new fit with another {one.name}" for one in candidates]
            near = end.by(judge.finest) if explained else end  # rivals differ by little
            tested = [one for one in taken if one.name in checks and not one.costly]
            for one in new_fits(near, candidates, tested, judge, checks):
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
        names,
        as_stated=tuple(judge.alarms(judge.r, judge.J)),
        sd=sd,
    )
    return compared(done, judge)


def new_fits(
    end: Fit,
    candidates: Sequence[Variation],
    tested: Sequence[Variation],
    judge: "Judge",
    checks: dict[str, AssumptionTest],
) -> Iterator[Variation]:
    """Repeat the fit with one suspect after the other, and replace its test in `checks`.

    Sensors that explain the misfit by one kind of fault come first, in one fit, and costly suspects
    last. Where one suspect explains it, or `NEARLY` all of it, the fit goes on until it is at rest;
    those with much smaller gains are then left out, and costly ones; where that one was too far off
    for tests to first order, the gains are those of the effects at the end under it, of all that
    were `tested`. Where all numbers together leave more than `RIVAL` of the misfit, or are at rest
    far off, none is the cause alone, and they are left out; so are effects too small for it.
    """
    gains, joint = {one.name: checks[one.name].gain for one in candidates}, None
    linear = dict(checks)
    bar = tqdm(total=len(candidates) + 1, unit="fit", disable=hidden(end.progress))
    with warnings.catch_warnings(action="ignore"), bar:
        end = end._replace(notify=lambda chi2: bar.set_postfix_str(f"chi2 = {chi2:.4g}"))
        far = far_off(end)
        if far:
            bar.set_description("new fit with all suspects unknown at once")
            joint = joint_fit(end, candidates, judge.explained_chi2)
        explains = joint is not None and joint.square <= judge.explained_chi2
        together = list[str]()
        if joint is not None:
            parts, together = shares(end, joint, candidates)
            gains |= {name: explains * judge.square * part for name, part in parts.items()}
            much = judge.misfit(joint.square) > RIVAL * judge.misfit(judge.square)
            if not explains and (much or (joint.converged and far_off(joint))):
                checks |= {name: replace(checks[name], suspected=False) for name in parts}
                candidates = [one for one in candidates if one.name not in parts]
        candidates = [one for one in candidates if judge.large_enough(one)]
        blind = far and not explains  # gains to first order say little
        order = [
            [one]
            for one in sorted(
                candidates,
                key=lambda one: (one.costly, blind and one.kind != "law", -gains[one.name]),
            )
        ]
        if explains and len(together) > 1:
            alone = {one.name: checks[one.name].gain for one in candidates}
            order = [*alike(candidates, together, alone), *order]
        bar.set_description("new fit with all assumptions")
        as_stated = refit(end, ())
        bar.update()
        enough = 0.0
        for number, some in enumerate(order if as_stated is not None else (), 1):
            name = " and ".join(one.name for one in some)
            gain = gains.get(name, judge.square)
            if gain < enough or (enough and some[0].costly):
                continue
            bar.set_description(plain(f"new fit with another {name} ({number} of {len(order)})"))
            tried = [one.within(checks[one.name].favoured) for one in some]
            other = refit(end, tried, joint if explains else None)
            if other is not None and as_stated is not None:
                again = Again(name, tried, [checks[one.name] for one in some], other)
                found = judge.fit(again, as_stated)
                if judge.nearly(found):
                    found = judge.at_rest(again, as_stated)
                if found.refitted:
                    checks[name] = found
            bar.update()
            if len(some) == 1:
                yield some[0]
            if name in checks and judge.nearly(checks[name]):
                alone = len(some) == 1 and some[0].kind in ("known", "sensor") and not enough
                if alone and name in judge.ends and (far or linear[name].far):
                    bar.set_description(plain(f"effects of the others under another {name}"))
                    before = {one.name for some in order[:number] for one in some}
                    parts = likeness(
                        judge.ends[name].fit,
                        tried[0],
                        [one for one in tested if one.name not in before],
                    )
                    gain = checks[name].gain
                    gains |= {other: part * gain for other, part in parts.items()}
                    known = {one.name for some in order for one in some}
                    more = [one for one in tested if one.name in parts.keys() - known]
                    more = sorted(more, key=lambda one: -gains[one.name])[:MOST]
                    order += [[one] for one in more]
                    bar.total += len(more)
                enough = max(enough, RIVAL * gain)
        near = {name: one for name, one in judge.ends.items() if not far_off(one.fit)}
        best = max(
            (name for name in near if checks[name].suspected),
            key=lambda name: (checks[name].passed, checks[name].gain),
            default="",
        )
        if best and as_stated is not None and not judge.nearly(checks[best]):
            bar.set_description(plain(f"new fit with another {best}, by finer steps"))
            checks[best] = judge.at_rest(near[best], as_stated)


def alike(
    candidates: Sequence[Variation], together: Sequence[str], gains: Mapping[str, float]
) -> list[list[Variation]]:
    """The sensors whose faults explain the misfit `together`, with faults of one kind: of each kind
    that explains about as much of it alone, since to first order a lag is a delay."""
    some = [one for one in candidates if one.name in together]
    faults = {one.fault: one for one in candidates if one.fault is not None}
    if any(one.fault is None for one in some):
        return []
    out = list[list[Variation]]()
    for kind in dict.fromkeys(kind for _, kind in faults):
        same = [faults.get((one.fault[0], kind)) for one in some if one.fault]
        if all(
            other and gains[other.name] > RIVAL * gains[one.name] for one, other in zip(some, same)
        ):
            out.append([one for one in same if one])
    return out


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


def compared(checked: Checked, judge: "Judge") -> Checked:
    """Tests with odds: shares of the evidence, by Schwarz's criterion, of the suspects that pass
    the tests of a fit, or of all where none does. A new fit with a law that holds or does not has
    no amplitude."""
    out = list(checked.checks)
    favoured = [one for one in out if one.suspected]
    if not favoured:
        return checked._replace(alarms=checked.as_stated)
    some = [one for one in favoured if one.passed] or favoured
    rest = max(1.0, min(one.left for one in some) / judge.dof)
    amplitudes = [
        one.amount
        if one.kind == "several"
        else float(not one.refitted or one.kind in ("known", "sensor"))
        for one in some
    ]
    left = np.array([one.left for one in some])
    score = left / rest + np.log(judge.dof) * np.array(amplitudes)
    odds = np.exp(-0.5 * (score - score.min()))
    for one, share in zip(some, odds / odds.sum()):
        out[out.index(one)] = replace(one, odds=float(share))
    besides, alone, left = judge.besides(some[int(score.argmin())], out)
    return checked._replace(checks=out, besides=besides, alarms=tuple(alone), left=tuple(left))


class Judge:
    """Tests of variations at the end of a fit."""

    def __init__(self, end: Fit, J: Array | None = None) -> None:
        """J (m, n) is the Jacobian of the fitted coordinates on the steps of the variations, by
        default that of the check."""
        self.end, self.finest, self.r = end, end.check.rtol, end.check.finer.r
        self.J = end.check.finer.J[:, end.free] if J is None else J
        self.Q, _ = np.linalg.qr(self.J)
        self.sd, self.labels = standard_deviations(self.J), end.labels
        self.columns, self.ends = dict[str, Array](), dict[str, Again]()
        self.places = [part.rows for part in parts(end.problem, self.r, end.which)]
        self.dof = max(sum(map(len, self.places)) - len(self.labels), 1)
        self.square = float(self.r @ self.r)
        misfit = self.misfit(self.square)
        self.explained_chi2 = self.square - NEARLY * misfit if misfit > 0.0 else 0.0
        """Sum of squares below which next to nothing is left above the noise."""

    def misfit(self, left: float) -> float:
        """Part of a sum of squares that is above the noise."""
        return left - self.dof

    def alarms(self, r: Array, J: Array) -> list[Verdict]:
        """What a wrong model would leave in residuals r (m,) with their Jacobian J (m, n)."""
        left = parts(self.end.problem, r, self.end.which)
        return systematic(judge_residuals(left, r, J, robust=self.end.loss != "linear"))

    def explained(self, checks: Iterable[AssumptionTest]) -> bool:
        """Whether with a suspected variation nothing is left."""
        return any(one.suspected and one.passed for one in checks)

    def large_enough(self, one: Variation) -> bool:
        """Whether what is costly, or a constant of the computation, could be the cause: it has an
        effect of one size, which is to be that of the misfit."""
        d = self.columns.get(one.name)
        if d is None or not (one.costly or one.kind == "numerical"):
            return True
        return float(np.sum(across(d, self.Q) ** 2)) > RIVAL * self.misfit(self.square)

    def nearly(self, one: AssumptionTest) -> bool:
        """Whether a new fit with a suspect leaves next to nothing above the noise."""
        return self.explained([one]) or (one.refitted and one.left < self.explained_chi2)

    def made(
        self,
        one: Assumption,
        moves: Array,
        gain: float,
        left: float,
        favoured: float,
        favoured_sd: float,
        rest: float,
        after: Array,
        before: Array,
        refitted: bool = False,
    ) -> AssumptionTest:
        """The test of a variation that turns residuals `before` (m,) into `after`, with a sum of
        squares `left`, and a misfit `rest` per sample."""
        by_label = dict(zip(self.labels, moves.tolist()))
        x = self.end.x[self.end.free] + moves * self.sd * (
            1.0 if refitted else favoured / one.amount
        )
        under = {
            c.label: c.to_value(v) for c, v in zip(self.end.coordinates, x.clip(-700, 700).tolist())
        }
        return assumption_test(
            one,
            moves=by_label,
            gain=gain,
            left=left,
            favoured=favoured,
            favoured_sd=favoured_sd,
            significance=gain / rest,
            pattern=pattern_of(self.places, after, before),
            refitted=refitted,
            value=one.nominal + favoured / one.amount * one.step,
            under=under,
        )

    def first_order(self, one: Assumption, d: Array | None, reason: str) -> AssumptionTest:
        """Test of a variation that adds the column d (m,) to the residuals, or that could not be
        run for a `reason`."""
        if d is None:
            return assumption_test(one, left=self.square, unchecked=reason)
        self.columns[one.name] = d
        test = self.column(one, d)
        if not test.suspected:
            return test
        J = np.column_stack((self.J, d))
        return replace(test, passed=not self.alarms(self.r - J @ shift(J, self.r), J))

    def column(
        self, one: Assumption, d: Array, Q: Array | None = None, r: Array | None = None
    ) -> AssumptionTest:
        """Test, to first order in its amplitude, of a variation that adds the column d (m,) to the
        residuals; on residuals r (m,) beside columns with the orthonormal basis Q (m, n), by
        default those of the fit."""
        Q, r = self.Q if Q is None else Q, self.r if r is None else r
        part = across(d, Q)
        size, along, square = float(part @ part), float(part @ r), float(r @ r)
        moves = -shift(self.J, d) / self.sd
        least = 1e-12 if Q is self.Q else 1e-6  # it is what is taken in already
        if size < least * max(float(d @ d), 1e-300) or size == 0.0:
            return self.made(one, moves, 0.0, square, 0.0, float("inf"), 1.0, r, r)
        gain, alpha = along**2 / size, -along / size
        rest = max(1.0, (square - gain) / max(self.dof - 1, 1))
        sd = (max(1.0, square / self.dof) / size) ** 0.5 * one.amount
        test = self.made(
            one, moves, gain, square - gain, alpha * one.amount, sd, rest, r + alpha * part, r
        )
        return replace(test, detectable=EVIDENT**0.5 * sd)

    def fit(self, again: Again, as_stated: Fit) -> AssumptionTest:
        """Test of one or several variations by a repeated fit, compared with one as stated; it is
        `refitted` only where that of each is."""
        found = [
            self.alone(one, again.fit, as_stated, linear)
            for one, linear in zip(again.tried, again.linear)
        ]
        refitted = all(one.refitted for one in found)
        if refitted:
            self.ends[again.name] = again
        if len(found) == 1:
            return found[0]
        return replace(
            found[0],
            name=again.name,
            kind="several",
            parameter="",
            amount=float(len(found)),
            unit="",
            refitted=refitted,
            stated=" and ".join(one.stated for one in found),
            otherwise=" and".join(one.found for one in found),
        )

    def alone(
        self, one: Variation, again: Fit, as_stated: Fit, linear: AssumptionTest
    ) -> AssumptionTest:
        """Test of one of the variations of a repeated fit; the test to first order, where the new
        fit gains less and has not converged."""
        left, gain = again.square, as_stated.square - again.square
        if gain <= linear.gain and not again.converged:
            return linear
        rest = max(1.0, left / self.dof)
        moves = np.array([again.by_label[k] for k in self.labels]) - self.end.x[self.end.free]
        favoured, sd = one.amount, (rest / max(gain, 1e-300)) ** 0.5 * abs(one.amount)
        if one.kind in ("known", "sensor"):
            place = again.labels.index(one.label)
            mine, x = again.coordinates[place], again.by_label[one.label]
            own = rest**0.5 * float(again.sd[place]) * mine.slope(x)
            by_amount = one.vary is not None or one.read is not None
            nominal, scale = (0.0, 1.0) if by_amount else (one.nominal, one.amount / one.step)
            favoured, sd = (mine.to_value(x) - nominal) * scale, own * scale
        test = self.made(
            one, moves / self.sd, gain, left, favoured, sd, rest, again.at.r, as_stated.at.r, True
        )
        return replace(
            test,
            amount=linear.amount,
            step=linear.step,
            detectable=linear.detectable,
            passed=not self.alarms(again.at.r, again.J),
        )

    def at_rest(self, again: Again, as_stated: Fit) -> AssumptionTest:
        """Test by a repeated fit that goes on until its steps do not matter, as that of the
        parameters did; without estimates where it does not come to rest."""
        fit = settle(again.fit, TIGHTENINGS if again.fit.loss == "linear" else 0)
        found = self.fit(again._replace(fit=fit), as_stated)
        found = found if found.refitted else self.fit(again, as_stated)
        return found if fit.converged else replace(found, under={})

    def besides(
        self, best: AssumptionTest, checks: Sequence[AssumptionTest]
    ) -> tuple[tuple[AssumptionTest, ...], list[Verdict], list[Verdict]]:
        """Tests to first order of effects besides one suspect, at most `BESIDES`, each beside those
        before it; the alarms of residuals under the suspect alone, and under all of them."""
        out: list[AssumptionTest] = []
        r, J = self.r, self.J
        if best.refitted:
            r, J = self.ends[best.name].fit.at.r, self.ends[best.name].fit.J
        else:
            J = np.column_stack((J, self.columns[best.name]))
            r = r - J @ shift(J, r)
        alone = self.alarms(r, J)
        left = [one for one in checks if one.name in self.columns and one.name != best.name]
        while left and len(out) < BESIDES:
            Q = np.linalg.qr(J)[0]
            tests = [self.column(one, self.columns[one.name], Q, r) for one in left]
            found = max(
                (one for one in tests if one.suspected), key=lambda one: one.gain, default=None
            )
            if found is None:
                break
            out.append(found)
            d = self.columns[found.name]
            r = r + found.favoured / found.amount * across(d, Q)
            J = np.column_stack((J, d))
            left = [one for one in left if one.name != found.name]
        return tuple(out), alone, self.alarms(r, J)


def pattern_of(places: Sequence[NDArray[np.int_]], left: Array, r: Array) -> float:
    """Fraction of the autocovariances of residuals r, beyond those of white noise, that residuals
    `left` retain, by the root of the sum of squares; 0 where r has none beyond chance."""

    def statistic(r: Array) -> tuple[float, float]:
        """Statistic of Box and Pierce, relative to the stated noise instead of the residuals' own,
        and its mean for white residuals."""
        total = white = 0.0
        for rows in places:
            own, n = r[rows], len(r[rows])
            gamma = np.array([own[k:] @ own[:-k] / n for k in range(1, min(LAGS, n // 4) + 1)])
            total += n * float(gamma @ gamma)
            white += len(gamma) * max(1.0, float(own @ own) / n) ** 2
        return total, white

    (before, by_chance), (after, rest) = statistic(r), statistic(left)
    if before <= BY_CHANCE * by_chance:
        return 0.0
    return (max(after - rest, 0.0) / (before - by_chance)) ** 0.5
