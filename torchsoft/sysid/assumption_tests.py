"""Tests of an assumption: to first order at the end of a fit, and by a repeated fit.

A variation takes one run for each recording, at the estimates, on the same steps: its change d (m,)
of the residuals is another column beside the Jacobian J. The projection of d on J gives the shift
of the estimates; its orthogonal part, along the residuals, the amplitude that the data favour.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.assumptions import AMOUNTS, Assumption, Variation
from torchsoft.sysid.fit import Fit, shift, standard_deviations
from torchsoft.sysid.plan import refine_steps
from torchsoft.sysid.recording import Array
from torchsoft.sysid.refits import EVIDENT, NEARLY, REDUNDANT, across, pursuit
from torchsoft.sysid.residual_tests import ResidualTest, judge_residuals, parts, systematic
from torchsoft.sysid.sentences import SUSPECT, case
from torchsoft.tables import Number

PATTERN = 0.5
"""Largest fraction of the residuals' autocorrelation that a favoured variation leaves: a cause
removes the pattern, while coloured noise correlates with anything slow."""

LAGS = 10
"""Number of autocorrelations in this test."""

BY_CHANCE = 2.0
"""Largest statistic of Box and Pierce, over its expectation, that counts as chance."""

RIVAL = 0.3
"""Fraction of the best suspect's gain to first order above which another one is its rival."""

OVERSIZED = 100.0
"""Square of the effect of a law or a constant of the computation, over the misfit, above which it
is not the cause: new fits under such ones ended far above the one without."""

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
    variation, `passed` whether residuals under it pass the tests of a fit, and `score` its share of
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
    score: Number = 0.0
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
    def case(self) -> dict[str, Any]:
        """Its facts as a case of a finding: the value, or the amount, that the data favour."""
        if self.kind == "several":
            return {"name": self.otherwise}
        if self.kind not in ("known", "sensor"):
            return {"name": self.name}
        out = {"name": self.name, "favoured": self.favoured, "sd": self.favoured_sd}
        relative = self.parameter and self.unit == "%"
        return out | {"unit": self.unit} | ({"value": self.value} if relative else {})

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
        self.work = dict[str, float]()
        """Expected time [s] of a run of every variation."""
        self.places = [part.rows for part in parts(end.problem, self.r, end.which)]
        self.dof = max(sum(map(len, self.places)) - len(self.labels), 1)
        self.square = float(self.r @ self.r)
        misfit = self.misfit(self.square)
        self.explained_chi2 = self.square - NEARLY * misfit if misfit > 0.0 else 0.0
        """Sum of squares below which next to nothing is left above the noise."""

    def misfit(self, left: float) -> float:
        """Part of a sum of squares that is above the noise."""
        return left - self.dof

    def alarms(self, r: Array, J: Array) -> list[ResidualTest]:
        """What a wrong model would leave in residuals r (m,) with their Jacobian J (m, n)."""
        left = parts(self.end.problem, r, self.end.which)
        return systematic(judge_residuals(left, r, J, robust=self.end.loss != "linear"))

    def explained(self, checks: Iterable[AssumptionTest]) -> bool:
        """Whether with a suspected variation nothing is left."""
        return any(one.suspected and one.passed for one in checks)

    def of_size(self, one: Variation) -> bool:
        """Whether a law or a constant of the computation could be the cause: it has an effect of
        one size, which is to be that of the misfit, if it could be run. A law that is not costly
        may be small at this end and large elsewhere."""
        d = self.columns.get(one.name)
        if d is None or one.kind not in ("law", "numerical"):
            return True
        size, misfit = float(np.sum(across(d, self.Q) ** 2)), self.misfit(self.square)
        least = RIVAL * misfit if one.costly or one.kind == "numerical" else 0.0
        return least <= size <= OVERSIZED * max(misfit, EVIDENT)

    def complementary(self, some: Sequence[Variation], count: int) -> list[Variation]:
        """Some assumptions, as many as asked for: each explains most, to first order, of what those
        before it leave."""
        known = {one.name: one for one in some if one.name in self.columns}
        effects = {name: across(self.columns[name], self.Q) for name in known}
        one_sided = {name for name, one in known.items() if one.one_sided}
        names = pursuit(effects, across(self.r, self.Q), count, one_sided=one_sided)
        return [known[name] for name in names]

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
        least = 1e-12 if Q is self.Q else REDUNDANT  # it is what is taken in already
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
            otherwise=" and ".join(case(SUSPECT, one.case) for one in found),
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
        favoured, sd = one.amount, (rest / max(abs(gain), 1e-300)) ** 0.5 * abs(one.amount)
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

    def refined(self, again: Again, as_stated: Fit) -> AssumptionTest:
        """Test by a repeated fit that goes on until its steps do not matter, as that of the
        parameters did; without estimates where it does not come to rest."""
        fit = refine_steps(again.fit, TIGHTENINGS if again.fit.loss == "linear" else 0)
        found = self.fit(again._replace(fit=fit), as_stated)
        found = found if found.refitted else self.fit(again, as_stated)
        return found if fit.converged else replace(found, under={})

    def besides(
        self, best: AssumptionTest, checks: Sequence[AssumptionTest]
    ) -> tuple[tuple[AssumptionTest, ...], list[ResidualTest], list[ResidualTest]]:
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
