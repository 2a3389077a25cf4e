"""Tests of an assumption at the end of a fit: a score test, and the comparison with a refit.

With residuals r (m,) and their Jacobian J (m, n) at the end of the fit, a suspect changes the
residuals by a column d (m,) for every amount of it. To first order estimates move by the projection
of d on J; its part across J, along r, gives the amount that the data favour, and the fall of the
sum of squares.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.assumptions import AMOUNTS, Assumption, Suspect
from torchsoft.sysid.fit import Fit, shift, standard_deviations
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import ResidualTest, judge_residuals, parts, systematic
from torchsoft.tables import Number

EVIDENT = 20.0
"""Fall of the sum of squares, over the remaining misfit per sample, from which on the data favour a
suspect: four and a half standard deviations. With a hundred suspects one gets there by chance in
0.08 % of all identifications."""

PATTERN = 0.5
"""Largest part of the residuals' autocorrelation that a suspect may leave: a cause removes the
pattern, while coloured noise correlates with anything slow."""

LAGS = 10
"""Number of autocorrelations in this test."""

BY_CHANCE = 2.0
"""Largest statistic of Box and Pierce, over its expectation, that counts as chance."""

FIRST_ORDER = 3.0
"""Standard deviations by which estimates may move in a score test."""

REDUNDANT = 1e-6
"""Part of the square of a column, across others, below which it is one of theirs."""

BESIDES = 3
"""Most effects that are looked for besides the likeliest suspect."""


@dataclass(frozen=True)
class AssumptionTest(Assumption):
    """Test of one assumption.

    `moves` is the shift of each estimate by the amount, in its standard deviations, by label;
    `gain` the fall of the sum of squares, to `left`, at the amount that the data favour: `favoured`
    [unit] with the standard deviation `favoured_sd`. `significance` is the gain over the remaining
    misfit per sample, `pattern` the remaining part of the residuals' autocorrelation, 0 where there
    is none. With `refitted` the result is that of a refit; `dropped` means that its refit was left
    to others that gained more, or could not start; else it is a score test. `unchecked` is the
    reason of a missing test. `value` is the favoured value of the `parameter`, `under` are the
    estimates at the favoured amount, by label. `suspected` is whether the data favour the suspect,
    `passed` whether residuals under it pass the tests of a fit, and `score` its share of the
    evidence among all suspects that do. `detectable` is the least amount [unit] that the data would
    show.
    """

    moves: dict[str, Number] = field(default_factory=dict)
    gain: Number = 0.0
    left: Number = 0.0
    favoured: Number = 0.0
    favoured_sd: Number = float("inf")
    significance: Number = 0.0
    pattern: Number = 0.0
    refitted: bool = False
    dropped: bool = False
    unchecked: str = ""
    value: Number = float("nan")
    under: dict[str, Number] = field(default_factory=dict)
    score: Number = 0.0
    suspected: bool | None = None
    passed: bool = False
    detectable: Number = float("inf")

    def __post_init__(self) -> None:
        if self.suspected is None:
            either_side = self.has_amount and not self.one_sided
            enough = (
                self.significance > EVIDENT
                and self.pattern < PATTERN
                and (either_side or self.favoured > 0)
            )
            object.__setattr__(self, "suspected", enough and not self.beyond_first_order)

    @property
    def beyond_first_order(self) -> bool:
        """Whether a parameter of the rig would have to change by 100 % or more, where a score test
        means nothing."""
        relative = self.kind == "known" and self.unit == "%" and not self.refitted
        return relative and abs(self.favoured) >= 100

    @property
    def case(self) -> dict[str, Any]:
        """Its facts as a case of a finding: the value, or the amount, that the data favour."""
        if not self.has_amount:
            return {"name": self.name}
        out = {"name": self.name, "favoured": self.favoured, "sd": self.favoured_sd}
        relative = self.parameter and self.unit == "%"
        return out | {"unit": self.unit} | ({"value": self.value} if relative else {})

    @property
    def most_moved(self) -> tuple[str, float]:
        """Label of the coordinate with the largest shift, and the shift in standard deviations."""
        return max(self.moves.items(), key=lambda item: abs(item[1]), default=("", 0.0))

    @property
    def shift(self) -> tuple[str, float]:
        """The same at the amount that the data favour."""
        label, move = self.most_moved
        return label, move * self.favoured / self.amount if self.has_amount else move

    @property
    def impact(self) -> tuple[str, float, float]:
        """The same at the largest amount [unit] that the data would not show, up to `AMOUNTS` times
        that of the assumption, and that amount."""
        size = min(self.detectable, AMOUNTS * self.amount)
        label, move = self.most_moved
        return label, move * size / self.amount, size

    @property
    def far(self) -> bool:
        """Whether estimates under the suspect are too far away for a score test."""
        return not self.refitted and abs(self.shift[1]) > FIRST_ORDER


class Linearised:
    """A fit at its end, linearised: residuals r (m,), their Jacobian J (m, n) with an orthonormal
    basis Q of its columns, and the standard deviations of the coordinates."""

    def __init__(self, end: Fit, J: Array | None = None) -> None:
        """J is the Jacobian on the steps of the columns, by default that of the check."""
        self.end, self.r, self.labels = end, end.check.finer.r, end.labels
        self.J = end.check.finer.J[:, end.free] if J is None else J
        self.Q, self.sd = np.linalg.qr(self.J)[0], standard_deviations(self.J)
        self.rows = [part.rows for part in parts(end.problem, self.r, end.which)]
        self.dof = max(sum(map(len, self.rows)) - len(self.labels), 1)
        self.square = float(self.r @ self.r)

    def alarms(self, r: Array, J: Array) -> list[ResidualTest]:
        """Tests that residuals r (m,) with their Jacobian J (m, n) fail, and that a wrong model
        would make them fail."""
        left = parts(self.end.problem, r, self.end.which)
        return systematic(judge_residuals(left, r, J, robust=self.end.loss != "linear"))

    def score_test(self, one: Assumption, d: Array) -> AssumptionTest:
        """Score test of a suspect whose amount changes the residuals by d (m,)."""
        test = self.beside(one, d, self.Q, self.r)
        if not test.suspected:
            return test
        J = np.column_stack((self.J, d))
        return replace(test, passed=not self.alarms(self.r - J @ shift(J, self.r), J))

    def beside(self, one: Assumption, d: Array, Q: Array, r: Array) -> AssumptionTest:
        """Score test on residuals r (m,), beside columns with the orthonormal basis Q (m, k)."""
        part, square = across(d, Q), float(r @ r)
        size, along = float(part @ part), float(part @ r)
        moves = -shift(self.J, d) / self.sd
        least = 1e-12 if Q is self.Q else REDUNDANT
        if size < least * float(d @ d) or size == 0.0:
            return self.outcome(one, moves, 0.0, square, 0.0, float("inf"), r, r)
        favoured = -along / size * one.amount
        sd = (max(1.0, square / self.dof) / size) ** 0.5 * one.amount
        amounts = -along / size if one.has_amount else 1.0
        amounts = max(amounts, 0.0) if one.one_sided else amounts
        after = r + amounts * part
        gain = max(square - float(after @ after), 0.0)
        test = self.outcome(one, moves, gain, square - gain, favoured, sd, after, r)
        x = self.end.x[self.end.free] + amounts * moves * self.sd
        return replace(test, detectable=EVIDENT**0.5 * sd, under=self.values(x))

    def refit_test(self, one: Suspect, fit: Fit, score: AssumptionTest) -> AssumptionTest:
        """Test of a suspect by a refit; without estimates where that has not converged."""
        r = fit.tested
        left, gain = float(r @ r), self.square - float(r @ r)
        rest = max(1.0, left / self.dof)
        favoured, sd = one.amount, (rest / max(abs(gain), 1e-300)) ** 0.5 * one.amount
        if one.has_amount:
            k = fit.labels.index(one.label)
            c, x = fit.coordinates[k], fit.by_label[one.label]
            per_step = one.amount / one.step
            favoured = (c.to_value(x) - one.nominal) * per_step
            sd = rest**0.5 * float(fit.sd[k]) * c.slope(x) * abs(per_step)
        x = np.array([fit.by_label[label] for label in self.labels])
        moves = (x - self.end.x[self.end.free]) / self.sd
        if one.has_amount and favoured != 0.0:
            moves = moves * one.amount / favoured
        test = self.outcome(
            one, moves, gain, left, favoured, sd, r, self.r, refitted=True,
            under=self.values(x) if fit.converged else {},
            passed=not self.alarms(r, fit.J),
        )  # fmt: skip
        return replace(test, detectable=score.detectable)

    def values(self, x: Array) -> dict[str, float]:
        """Fitted coordinates x (n,) in physical units, by label."""
        pairs = zip(self.end.coordinates, x.clip(-700, 700).tolist())
        return {c.label: c.to_value(v) for c, v in pairs}

    def outcome(
        self, one: Assumption, moves: Array, gain: float, left: float, favoured: float, sd: float,
        after: Array, before: Array, **more: Any,
    ) -> AssumptionTest:  # fmt: skip
        """The test of a suspect that turns residuals `before` (m,) into `after`."""
        outcome = {
            "moves": dict(zip(self.labels, moves.tolist())), "gain": gain, "left": left,
            "favoured": favoured, "favoured_sd": sd,
            "significance": gain / max(1.0, left / max(self.dof - 1, 1)),
            "pattern": pattern_left(self.rows, after, before),
            "value": one.nominal + favoured / one.amount * one.step,
        }  # fmt: skip
        return assumption_test(one, **outcome, **more)

    def besides(
        self, best: AssumptionTest, fit: Fit | None, columns: dict[str, tuple[Suspect, Array]]
    ) -> tuple[list[AssumptionTest], list[ResidualTest], list[ResidualTest]]:
        """Score tests of effects besides the likeliest suspect, at most `BESIDES`, each beside
        those before it; the tests that residuals fail under the suspect alone, and under all of
        them. `fit` is its refit, if there is one."""
        out = list[AssumptionTest]()
        if fit is not None:
            r, J = fit.tested, fit.J
        else:
            J = np.column_stack((self.J, columns[best.name][1]))
            r = self.r - J @ shift(J, self.r)
        alone = self.alarms(r, J)
        left = {name: one for name, one in columns.items() if name != best.name}
        for _ in range(BESIDES):
            Q = np.linalg.qr(J)[0]
            tests = [self.beside(one, d, Q, r) for one, d in left.values()]
            favoured = [one for one in tests if one.suspected]
            if not favoured:
                break
            out.append(max(favoured, key=lambda one: one.gain))
            _, d = left.pop(out[-1].name)
            r = r + out[-1].favoured / out[-1].amount * across(d, Q)
            J = np.column_stack((J, d))
        return out, alone, self.alarms(r, J)


def assumption_test(one: Assumption, **outcome: Any) -> AssumptionTest:
    """The test of an assumption with this outcome."""
    return AssumptionTest(
        **{each.name: getattr(one, each.name) for each in fields(Assumption)}, **outcome
    )


def across(d: Array, Q: Array) -> Array:
    """Component (m,) of d orthogonal to the span of an orthonormal basis Q (m, n)."""
    return d - Q @ (Q.T @ d)


def pattern_left(rows: Sequence[NDArray[np.int_]], left: Array, r: Array) -> float:
    """Part of the autocovariances of residuals r, beyond those of white noise, that residuals
    `left` retain, by the root of the sum of squares; 0 where r has none beyond chance."""

    def statistic(r: Array) -> tuple[float, float]:
        """Statistic of Box and Pierce, relative to the stated noise instead of the residuals' own,
        and its mean for white residuals."""
        total = white = 0.0
        for own in (r[one] for one in rows):
            n = len(own)
            gamma = np.array([own[k:] @ own[:-k] / n for k in range(1, min(LAGS, n // 4) + 1)])
            total += n * float(gamma @ gamma)
            white += len(gamma) * max(1.0, float(own @ own) / n) ** 2
        return total, white

    (before, by_chance), (after, rest) = statistic(r), statistic(left)
    if before <= BY_CHANCE * by_chance:
        return 0.0
    return (max(after - rest, 0.0) / (before - by_chance)) ** 0.5
