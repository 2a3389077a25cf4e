"""Do the data agree with what was taken for granted, and how far would estimates move if it were
otherwise?

One run a recording and variation, at the estimates, on the same steps: the difference d (m,) that
it makes to the residuals is one more column beside the Jacobian J. Its projection on J says how far
estimates would move; the rest of it, along the residuals, how much of it the data favour. A
constant of the computation is not known to be right: it enters the intervals as a coordinate more,
with a standard normal prior on its amplitude, so that data that cannot tell it cost certainty.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from tqdm import tqdm

from torchsoft.sysid.assumptions import (
    FAULTS,
    Assumption,
    End,
    Refit,
    Variation,
    assumptions,
    difference,
    ended,
    refit,
)
from torchsoft.sysid.fit import Loss, fisher, shift, standard_deviations
from torchsoft.sysid.prediction import FailedRun, Signals
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import LEVEL, parts
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import Nuisance
from torchsoft.tables import Number, plain

EVIDENT = 20.0
"""Fall of chi2, over the misfit that is left per sample, from which the data favour a variation:
four and a half standard deviations, for some twenty variations are looked at."""

PATTERN = 0.5
"""Part of the residuals' autocorrelation that a variation may leave and yet count as what the data
favour: a cause takes the pattern away with it, while coloured noise lines up with anything slow."""

LAGS = 10
"""Autocorrelations that are looked at."""

BY_CHANCE = 2.0
"""What the statistic of Box and Pierce may be by chance, over its expectation."""

RIVALS = 3
"""Numbers of the rig that are taken to be unknown where a doubtful fit is repeated, one at a
time."""

UNDER = 8
"""Estimates that a sentence states under an alternative."""

MOVED = 0.5
"""Standard deviations by which a constant of the computation may move an estimate without a
word."""


@dataclass(frozen=True)
class AssumptionTest(Assumption):
    """Test of one assumption: the effect of its variation by `amount` [unit].

    `moves` is the shift of each estimate in its standard deviations, by label; `gain` the fall of
    the sum of squares, to `left`, by the amplitude that the data favour: `favoured` [unit] with the
    standard deviation `favoured_sd`. `significance` is the gain over the misfit per sample that
    would be left, `pattern` the part of the residuals' autocorrelation that would be left, 0 where
    there is none. With `refitted` that is the result of a new fit, else it is to first order.
    `unchecked` is the reason why there is no test. `value` is the favoured value of the
    `parameter`, `under` are the estimates with the favoured amplitude, by label. `suspected`: the
    data favour the variation.
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
    suspected: bool | None = None

    def __post_init__(self) -> None:
        if self.suspected is None:
            either_side = self.kind in ("known", "sensor")
            enough = (
                self.significance > EVIDENT
                and self.pattern < PATTERN
                and (either_side or self.favoured > 0)
            )
            object.__setattr__(self, "suspected", enough and not self.absurd)

    @property
    def absurd(self) -> bool:
        """Whether a number of the rig would have to vanish or to double: a test to first order says
        nothing then."""
        return (
            self.kind == "known"
            and self.unit == "%"
            and not self.refitted
            and abs(self.favoured) >= 100
        )

    @property
    def falls(self) -> str:
        """What it does to the sum of squares, as a sentence has it."""
        return (
            f"falls by {self.gain:.0f} in a new fit"
            if self.refitted
            else f"would fall by {self.gain:.0f}"
        )

    @property
    def most_moved(self) -> tuple[str, float]:
        """The label of the coordinate that would move most, and by how many standard deviations."""
        return max(self.moves.items(), key=lambda item: abs(item[1]), default=("", 0.0))


def assumption_test(one: Assumption, **outcome: Any) -> AssumptionTest:
    """The test of an assumption with this outcome."""
    return AssumptionTest(
        **{each.name: getattr(one, each.name) for each in fields(Assumption)}, **outcome
    )


class Checked(NamedTuple):
    """All checks; columns (m, k) of the constants of the computation, and those of the free
    coordinates' Jacobian (m, n)."""

    checks: list[AssumptionTest]
    columns: Array
    J: Array
    untried: tuple[str, ...] = ()
    """What an interrupt left out."""
    candidates: tuple[str, ...] = ()
    """Assumptions without which a new fit may explain a misfit that no check explains to first
    order."""

    def covariance(self) -> Array:
        """Covariance (n, n) of the free coordinates, which the constants of the computation
        enlarge."""
        k, n = self.columns.shape[1], self.J.shape[1]
        rows = np.block([[self.J, self.columns], [np.zeros((k, n)), np.eye(k)]])
        _, R = np.linalg.qr(rows[:, [*range(n, n + k), *range(n)]])
        return fisher(R[k:, k:])[0]

    def widening(self) -> Array:
        """What that is more than without them (n, n)."""
        return self.covariance() - fisher(self.J)[0]


def check_assumptions(
    problem: Problem, x: Array, at: Residuals, free: NDArray[np.bool_], which: Sequence[str],
    rtol: float, *, doubtful: bool = False, explain: bool = False, loss: Loss = "linear",
    workers: int = 1, journal: Path | None = None, progress: bool = False,
) -> Checked:  # fmt: skip
    """Tests of the assumptions at the estimates x (n,), to first order, where `at` holds residuals
    and Jacobian of the recordings `which`.

    With `explain` a `doubtful` fit is repeated by `loss` without one assumption after the other,
    until one explains the misfit: a test to first order says little where a fit has run far off.
    """
    end = ended(problem, x, at, free, which, rtol, workers, journal)
    candidates: list[Variation] = []
    recordings = [recording for recording in problem.recordings if recording.name in which]
    taken = assumptions(recordings, set(problem.coordinates.names))
    judge, checks, columns = Judge(problem, end), dict[str, AssumptionTest](), []
    untried = [one.name for one in taken if one.vary is not None]
    try:
        linear = columns_of(problem, Runner(problem.recordings, workers, journal), end, taken)
        checks |= {one.name: judge.column(one, d) for one, d in linear if d.any()}
        for one in taken:
            if one.vary is None:
                continue
            d, reason = difference(problem, end, one)
            checks[one.name] = judge.unchecked(one, reason) if d is None else judge.column(one, d)
            if one.kind == "numerical" and d is not None:
                columns.append(d)
            untried.remove(one.name)
        unexplained = doubtful and not end.base.lost and not judge.explained(checks.values())
        candidates = doubted(taken, checks, end.far) if unexplained else []
        if explain and candidates:
            untried = [f"a new fit with another {one.name}" for one in candidates]
            for one in new_fits(problem, end, candidates, loss, judge, checks, progress):
                untried.remove(f"a new fit with another {one.name}")
            untried, candidates = [], []
    except KeyboardInterrupt:  # the fit is done: what was tried is kept
        candidates = []
    rows = np.stack(columns, 1) if columns else np.zeros((len(at.r), 0))
    return Checked(
        list(checks.values()), rows, judge.J, tuple(untried), tuple(one.name for one in candidates)
    )


def new_fits(
    problem: Problem, end: End, candidates: Sequence[Variation], loss: Loss, judge: "Judge",
    checks: dict[str, AssumptionTest], progress: bool,
) -> Iterator[Variation]:  # fmt: skip
    """Repeats the fit without one assumption after the other, whose `checks` it replaces, until one
    explains the misfit."""
    with tqdm(total=len(candidates) + 1, unit="fit", disable=not progress) as bar:

        def notify(chi2: float) -> None:
            bar.set_postfix_str(f"chi2 = {chi2:.4g}")

        bar.set_description("new fit with all assumptions")
        as_stated = refit(problem, end, None, loss, notify)
        bar.update()
        for one in candidates if as_stated is not None else ():
            bar.set_description(plain(f"new fit with another {one.name}"))
            other = refit(problem, end, one, loss, notify)
            if other is not None and as_stated is not None:
                checks[one.name] = judge.fit(one, other, as_stated, checks[one.name])
            bar.update()
            yield one
            if judge.explained(checks.values()):
                return


def doubted(
    taken: Sequence[Variation], checks: Mapping[str, AssumptionTest], far: bool
) -> list[Variation]:
    """What a fit is repeated without, the likeliest first: all that either is so or is not, and
    `RIVALS` of the rig's numbers, those that would explain most or, where a fit ended `far` off,
    those whose variation would make the greatest misfit."""
    by_gain = sorted(
        (one for one in taken if one.name in checks), key=lambda one: -checks[one.name].gain
    )
    numbers = [
        one for one in by_gain if one.parameter and (far or checks[one.name].significance > EVIDENT)
    ]
    if far:
        numbers.sort(key=lambda one: checks[one.name].favoured_sd / one.amount)
    return [one for one in by_gain if one.vary is not None or one in numbers[:RIVALS]]


class Judge:
    """What variations are worth at the end of a fit."""

    def __init__(self, problem: Problem, end: End) -> None:
        self.end, self.r, self.J = end, end.at.r, end.at.J[:, end.free]
        self.Q, _ = np.linalg.qr(self.J)
        self.sd = standard_deviations(self.J)
        self.coordinates = [
            one for one, is_free in zip(problem.coordinates.all, end.free) if is_free
        ]
        self.labels = [one.label for one in self.coordinates]
        self.given = problem.recordings[0].parameters
        self.places = [part.rows for part in parts(problem, self.r, end.which)]
        self.dof = max(sum(map(len, self.places)) - len(self.labels), 1)
        self.square = float(self.r @ self.r)

    def explained(self, checks: Iterable[AssumptionTest]) -> bool:
        """Whether the data favour something with which residuals are no larger than the noise."""
        left = min((one.left for one in checks if one.suspected), default=np.inf)
        return float(stats.chi2.sf(left, self.dof)) > LEVEL

    def unchecked(self, one: Assumption, reason: str) -> AssumptionTest:
        return assumption_test(one, left=self.square, unchecked=reason)

    def made(
        self, one: Assumption, moves: Array, gain: float, left: float, favoured: float,
        favoured_sd: float, rest: float, pattern: float, refitted: bool = False,
    ) -> AssumptionTest:  # fmt: skip
        """Of a variation that leaves a sum of squares `left`, a misfit `rest` per sample."""
        by_label = dict(zip(self.labels, moves.tolist()))
        x = self.end.x[self.end.free] + moves * self.sd * (
            1.0 if refitted else favoured / one.amount
        )
        under = {
            c.label: c.to_value(v) for c, v in zip(self.coordinates, x.clip(-700, 700).tolist())
        }
        value = (1 + favoured / 100) * self.given[one.parameter] if one.parameter else float("nan")
        return assumption_test(
            one, moves=by_label, gain=gain, left=left, favoured=favoured, favoured_sd=favoured_sd,
            significance=gain / rest, pattern=pattern, refitted=refitted, value=value, under=under,
        )  # fmt: skip

    def column(self, one: Assumption, d: Array) -> AssumptionTest:
        """Of what a variation adds to the residuals (m,), to first order in its amplitude."""
        across = d - self.Q @ (self.Q.T @ d)
        size, along = float(across @ across), float(across @ self.r)
        moves = -shift(self.J, d) / self.sd
        if size < 1e-12 * max(float(d @ d), 1e-300) or size == 0.0:
            return self.made(one, moves, 0.0, self.square, 0.0, float("inf"), 1.0, 0.0)
        gain, alpha = along**2 / size, -along / size
        rest = max(1.0, (self.square - gain) / max(self.dof - 1, 1))
        pattern, sd = (
            pattern_of(self.places, self.r + alpha * across, self.r),
            (max(1.0, self.square / self.dof) / size) ** 0.5,
        )
        return self.made(
            one, moves, gain, self.square - gain, alpha * one.amount, sd * one.amount, rest, pattern
        )

    def fit(
        self, one: Assumption, again: Refit, as_stated: Refit, linear: AssumptionTest
    ) -> AssumptionTest:
        """Of a fit that was repeated with it, beside one that was repeated without; or what is
        known to first order, if that is worth more."""
        at, before = again.fit.at, as_stated.fit.at
        assert at is not None
        assert before is not None
        gain = float(before.r @ before.r - at.r @ at.r)
        if gain <= linear.gain:
            return linear
        left = float(at.r @ at.r)
        rest = max(1.0, left / self.dof)
        moves = np.array([again.of(label) for label in self.labels]) - self.end.x[self.end.free]
        favoured, sd = one.amount, (rest / gain) ** 0.5 * one.amount
        if one.parameter:
            labels = [
                label
                for label, is_free in zip(again.problem.coordinates.labels, again.free)
                if is_free
            ]
            k = again.problem.coordinates.labels.index(one.parameter)
            favoured = 100 * (np.exp(again.fit.x[k] - again.problem.coordinates.start[k]) - 1)
            sd = (
                100
                * rest**0.5
                * float(standard_deviations(at.J[:, again.free])[labels.index(one.parameter)])
            )
        pattern = pattern_of(self.places, at.r, before.r)
        return self.made(one, moves / self.sd, gain, left, favoured, sd, rest, pattern, True)


def pattern_of(places: Sequence[NDArray[np.int_]], left: Array, r: Array) -> float:
    """What is left of the autocovariances of residuals r beyond those of white noise, by the root
    of the sum of their squares; 0 where r has none beyond chance."""

    def statistic(r: Array) -> tuple[float, float]:
        """That of Box and Pierce, over the stated noise in place of the residuals' own, and its
        mean for white residuals."""
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


def columns_of(
    problem: Problem, runner: Runner, end: End, taken: Sequence[Variation]
) -> list[tuple[Variation, Array]]:
    """What other values of known parameters, and faults of sensors that are not unknown, would add
    to the residuals, to first order: of one run a recording, with its derivatives. Nothing where a
    run fails."""
    if end.base.lost:
        return []
    known = [one for one in taken if one.parameter]
    names = tuple(one.parameter for one in known)
    jobs = [job._replace(names=names) for job in problem.jobs(end.x, end.which, end.steps, None)]
    runs = runner.run(jobs)
    if any(isinstance(run, FailedRun) for run in runs):
        return []
    faults: list[tuple[str, Nuisance]] = [
        (channel, kind) for channel in problem.sensors for kind in FAULTS
    ]
    have = {(one.name, one.kind) for one in problem.coordinates.all}
    rows = np.zeros((len(problem.coordinates.priors), len(names) + len(faults)))
    blocks = []
    for job, run in zip(jobs, runs):
        recording = problem.recordings[job.recording]
        signals = Signals(run.t, recording.channels, run.signals, run.derivatives)
        sizes = [one.amount / 100 * recording.parameters[one.parameter] for one in known]
        for channel, one in problem.readouts(end.x, job.recording).items():
            t, measured = recording.samples[channel]
            y, slopes, by = one.expected(signals, t)
            _, weight = one.residuals(y, measured)
            block = np.zeros((len(t), len(names) + len(faults)))
            if slopes is not None:
                block[:, : len(names)] = slopes * sizes
            for k, (other, kind) in enumerate(faults):
                if other == channel:
                    block[:, len(names) + k] = by[kind] * FAULTS[kind].size(
                        problem.sensors[channel], recording
                    )
            blocks.append(problem.whitened(recording, channel, weight[:, None] * block))
    D = np.concatenate([*blocks, rows])
    sensors = [
        FAULTS[kind].assumption(channel, problem.unit(channel), problem.sensors[channel])
        for channel, kind in faults
    ]
    out = [(one, d) for one, d in zip((*known, *sensors), D.T)]
    return [
        pair for k, pair in enumerate(out) if k < len(known) or faults[k - len(known)] not in have
    ]


def assumption_notices(checked: Checked) -> list[str]:
    """Sentences on what the data favour, the strongest first, and on constants of the computation
    that estimates hang on."""
    out, checks = [], checked.checks
    if checked.candidates:
        out.append(
            "no assumption explains to first order all that the fit left: `explain` looks for the "
            f"cause, with a new fit without each of {', '.join(checked.candidates)}"
        )
    if checked.untried:
        out.append(
            f"interrupted, so these were not tried: {', '.join(checked.untried)}; the same command "
            "tries them"
        )
    favoured = sorted((c for c in checks if c.suspected), key=lambda c: -c.gain)
    if favoured:
        best = favoured[0]
        rivals = [c.name for c in favoured[1:] if c.gain > 0.5 * best.gain]
        label, move = best.most_moved
        text = f"the data contradict that {best.stated}: the sum of squares {best.falls}"
        if best.parameter:
            text += (
                f" with {best.parameter} = {best.value:.6g} ({best.favoured:+.3g} {best.unit}, +- "
                f"{best.favoured_sd:.2g})"
            )
        else:
            text += f" if {best.otherwise}"
            if best.kind in ("known", "sensor"):
                text += f" ({best.favoured:+.3g} {best.unit} fit best, +- {best.favoured_sd:.2g})"
        if best.kind in ("known", "sensor"):
            move *= 1.0 if best.refitted else best.favoured / best.amount
        if label:
            under = ", ".join(
                f"{name} = {value:.4g}" for name, value in list(best.under.items())[:UNDER]
            )
            text += (
                f"; {label} would move by {abs(move):.2g} standard deviations; estimates under it: "
                f"{under}"
            )
        out.append(text + (f"; so would it with others: {', '.join(rivals)}" if rivals else ""))
        out += [
            f"the data also favour another value than stated: {c.stated} (the sum of squares "
            f"{c.falls})"
            for c in favoured[1:4]
            if c.gain <= 0.5 * best.gain and c.gain > 0.1 * best.gain
        ]
    for c in checks:
        if c.kind == "numerical" and c.unchecked:
            out.append(f"it could not be checked what it does that {c.stated}: {c.unchecked}")
        elif c.kind == "numerical" and not c.suspected and c.favoured_sd > MOVED:
            label, move = c.most_moved
            if abs(move) > MOVED:
                out.append(
                    f"{label} hangs on a constant of the computation: {c.stated}; if {c.otherwise} "
                    f"it would move by {abs(move):.2g} standard deviations, and the data cannot "
                    "tell: the interval allows for that"
                )
    return out
