"""Do the data agree with what was taken for granted, and how far would estimates move if it were otherwise?

One run a recording and variation, at the estimates, on the same steps: the difference d (m,) that it makes to the residuals is
one more column beside the Jacobian J. Its projection on J says how far estimates would move; the rest of it, along the
residuals, how much of it the data ask for. A constant of the computation is not known to be right: it enters the intervals as
a coordinate more, with a standard normal prior on its amplitude, so that data that cannot tell it cost certainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.sysid.assumptions import FAULTS, Assumption, Kind, assumptions
from torchsoft.sysid.information import fisher, shift, standard_deviations
from torchsoft.sysid.misfit import parts
from torchsoft.sysid.plan import USUAL
from torchsoft.sysid.prediction import FailedRun, Frozen
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.readout import Signals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.unknowns import Nuisance
from torchsoft.sysid.workers import Runner

ASKED = 20.0
"""Fall of chi2, over the misfit that is left per sample, from which the data ask for a variation: four and a half standard
deviations, for some twenty variations are looked at."""

PATTERN = 0.5
"""Part of the residuals' autocorrelation that a variation may leave and yet count as what the data ask for: a cause takes the
pattern away with it, while coloured noise lines up with anything slow."""

LAGS = 10
"""Autocorrelations that are looked at."""

BY_CHANCE = 2.0
"""What the statistic of Box and Pierce may be by chance, over its expectation."""

MOVED = 0.5
"""Standard deviations by which a constant of the computation may move an estimate without a word."""


@dataclass(frozen=True)
class Check:
    """One thing that was taken for granted, and what a variation of it by `amount` [unit] does.

    `moves` is how far each coordinate would move, in its standard deviations, by label; `gain` by how much the sum of squares
    would fall if the data could choose the amplitude, `asked` that amplitude [unit] and `asked_sd` its standard deviation;
    `significance` is the gain over the misfit per sample that would be left, `pattern` the part of the residuals'
    autocorrelation that would be left, 0 where there is none. `unchecked` says why there is no answer.
    """

    name: str
    kind: Kind
    stated: str
    otherwise: str
    amount: float
    unit: str
    moves: dict[str, float]
    gain: float
    asked: float
    asked_sd: float
    significance: float
    pattern: float = 0.0
    unchecked: str = ""

    @property
    def wanted(self) -> bool:
        """Whether the data ask for it."""
        either_side = self.kind in ("known", "sensor")
        return self.significance > ASKED and self.pattern < PATTERN and (either_side or self.asked > 0)

    @property
    def most_moved(self) -> tuple[str, float]:
        """The label of the coordinate that would move most, and by how many standard deviations."""
        return max(self.moves.items(), key=lambda item: abs(item[1]), default=("", 0.0))


class Checked(NamedTuple):
    """All checks; columns (m, k) of the constants of the computation, and those of the free coordinates' Jacobian (m, n)."""

    checks: list[Check]
    columns: Array
    J: Array

    def covariance(self) -> Array:
        """Covariance (n, n) of the free coordinates, which the constants of the computation enlarge."""
        k, n = self.columns.shape[1], self.J.shape[1]
        rows = np.block([[self.J, self.columns], [np.zeros((k, n)), np.eye(k)]])
        _, R = np.linalg.qr(rows[:, [*range(n, n + k), *range(n)]])
        return fisher(R[k:, k:])[0]

    def widening(self) -> Array:
        """What that is more than without them (n, n)."""
        return self.covariance() - fisher(self.J)[0]


def check(
    problem: Problem, x: Array, at: Residuals, free: NDArray[np.bool_], which: Sequence[str], rtol: float, *,
    workers: int = 1, journal: Path | None = None,
) -> Checked:  # fmt: skip
    """Vary what was taken for granted at the estimates x (n,), where `at` holds residuals and Jacobian of the recordings
    `which`."""
    rtol, J = max(rtol, USUAL), at.J[:, free]
    Q, _ = np.linalg.qr(J)
    sd = standard_deviations(J)
    labels = [label for label, one in zip(problem.coordinates.labels, free) if one]
    runner = Runner(problem.recordings, workers, journal)
    base, steps = problem.freeze(runner, x, which, rtol)
    r, places = at.r, [part.rows for part in parts(problem, at.r, which)]
    left = max(1.0, float(r @ r) / max(len(r) - int(free.sum()), 1))
    checks, columns = [], []

    def judged(one: Assumption, d: Array) -> Check:
        across = d - Q @ (Q.T @ d)
        square, along = float(across @ across), float(across @ r)
        moves = -shift(J, d) / sd
        if square < 1e-12 * max(float(d @ d), 1e-300) or square == 0.0:
            return Check(one.name, one.kind, one.stated, one.otherwise, one.amount, one.unit,
                         dict(zip(labels, moves.tolist())), 0.0, 0.0, float("inf"), 0.0)  # fmt: skip
        gain, alpha = along**2 / square, -along / square
        rest = max(1.0, (float(r @ r) - gain) / max(len(r) - int(free.sum()) - 1, 1))
        pattern = pattern_of(places, r + alpha * across, r)
        return Check(one.name, one.kind, one.stated, one.otherwise, one.amount, one.unit, dict(zip(labels, moves.tolist())),
                     gain, alpha * one.amount, float((left / square) ** 0.5) * one.amount, gain / rest, pattern)  # fmt: skip

    recordings = [recording for recording in problem.recordings if recording.name in which]
    taken = assumptions(recordings, set(problem.coordinates.names))
    for one in taken:
        if one.kind == "known" and one.values is not None:
            continue
        d, reason = difference(problem, x, which, one, base, steps, workers, journal)
        if d is None:
            checks.append(Check(one.name, one.kind, one.stated, one.otherwise, one.amount, one.unit, {}, 0.0, 0.0, float("inf"),
                                0.0, unchecked=reason))  # fmt: skip
            continue
        checks.append(judged(one, d))
        if one.kind == "numerical":
            columns.append(d)
    known = [one for one in taken if one.kind == "known" and one.values is not None]
    checks += [judged(one, d) for one, d in columns_of(problem, runner, x, which, steps, known) if d.any()]
    return Checked(checks, np.stack(columns, 1) if columns else np.zeros((len(r), 0)), J)


def pattern_of(places: Sequence[slice], left: Array, r: Array) -> float:
    """What is left of the autocovariances of residuals r, by the root of the sum of their squares; 0 where r has none beyond
    chance."""

    def statistic(r: Array) -> tuple[float, float]:
        """That of Box and Pierce, over the stated noise in place of the residuals' own, and what chance may make of it."""
        total = chance = 0.0
        for rows in places:
            own, n = r[rows], len(r[rows])
            gamma = np.array([own[k:] @ own[:-k] / n for k in range(1, min(LAGS, n // 4) + 1)])
            total += n * float(gamma @ gamma)
            chance += BY_CHANCE * len(gamma) * max(1.0, float(own @ own) / n) ** 2
        return total, chance

    before, chance = statistic(r)
    return (statistic(left)[0] / before) ** 0.5 if before > chance else 0.0


def difference(
    problem: Problem, x: Array, which: Sequence[str], one: Assumption, base: Residuals, steps: dict[str, Frozen], workers: int,
    journal: Path | None,
) -> tuple[Array | None, str]:  # fmt: skip
    """What a variation adds to the residuals, or None and why that is not known."""
    if base.lost:
        return None, "the estimates cannot be simulated by the tolerance of the checks"
    if one.values is not None:
        varied, factors = problem, one.values
        runner = Runner(problem.recordings, workers, journal)
    else:
        assert one.vary is not None
        factors, made = {}, []
        for recording in problem.recordings:
            other = one.vary(recording) if recording.name in which else recording
            if other is None:
                return None, f"it has no meaning where recording `{recording.name}` begins"
            made.append(other)
        try:
            varied = Problem(made, problem.sensors, problem.unknowns, problem.noise)
        except ValueError as error:  # an unknown that the varied rig has not
            return None, str(error)
        runner = Runner(varied.recordings, workers, journal)
    jobs = varied.jobs(x, which, steps, None)
    for k, job in enumerate(jobs):
        given = varied.recordings[job.recording].parameters
        more = {name: factor * job.values.get(name, given[name]) for name, factor in factors.items()}
        jobs[k] = job._replace(values=job.values | more)
    got = varied.gather(x, jobs, runner.run(jobs))
    if got.lost:
        return None, f"a run failed: {next(iter(got.lost.values())).reason}"
    return got.r - base.r, ""


def columns_of(
    problem: Problem, runner: Runner, x: Array, which: Sequence[str], steps: dict[str, Frozen], known: Sequence[Assumption]
) -> list[tuple[Assumption, Array]]:  # fmt: skip
    """What other values of `known` parameters, and faults of sensors that are not unknown, would add to the residuals, to first
    order: of one run a recording, with its derivatives. Nothing where a run fails."""
    names = tuple(name for one in known for name in one.values or ())
    jobs = [job._replace(names=names) for job in problem.jobs(x, which, steps, None)]
    runs = runner.run(jobs)
    if any(isinstance(run, FailedRun) for run in runs):
        return []
    faults: list[tuple[str, Nuisance]] = [(channel, kind) for channel in problem.sensors for kind in FAULTS]
    have = {(one.name, one.kind) for one in problem.coordinates.all}
    rows = np.zeros((len(problem.coordinates.priors), len(names) + len(faults)))
    blocks = []
    for job, run in zip(jobs, runs):
        recording = problem.recordings[job.recording]
        signals = Signals(run.t, recording.channels, run.signals, run.derivatives)
        sizes = [
            (factor - 1) * recording.parameters[name] for one in known for name, factor in (one.values or {}).items()
        ]
        for channel, one in problem.readouts(x, job.recording).items():
            t, measured = recording.samples[channel]
            y, slopes, by = one.expected(signals, t)
            _, weight = one.residuals(y, measured)
            block = np.zeros((len(t), len(names) + len(faults)))
            if slopes is not None:
                block[:, : len(names)] = slopes * sizes
            for k, (other, kind) in enumerate(faults):
                if other == channel:
                    block[:, len(names) + k] = by[kind] * FAULTS[kind].size(problem.sensors[channel], recording)
            blocks.append(problem.whitened(recording, channel, weight[:, None] * block))
    D = np.concatenate([*blocks, rows])
    sensors = [FAULTS[kind].assumption(channel, problem.sensors[channel]) for channel, kind in faults]
    out = [(one, d) for one, d in zip((*known, *sensors), D.T)]
    return [pair for k, pair in enumerate(out) if k < len(known) or faults[k - len(known)] not in have]


def notices(checked: Checked) -> list[str]:
    """Sentences on what the data ask for, the strongest first, and on constants of the computation that estimates hang on."""
    out, checks = [], checked.checks
    asked = sorted((c for c in checks if c.wanted), key=lambda c: -c.gain)
    if asked:
        best = asked[0]
        rivals = [c.name for c in asked[1:] if c.gain > 0.5 * best.gain]
        label, move = best.most_moved
        text = f"the data contradict that {best.stated}: the sum of squares would fall by {best.gain:.0f} if {best.otherwise}"
        if best.kind in ("known", "sensor"):
            text += f" ({best.asked:+.3g} {best.unit} fit best, +- {best.asked_sd:.2g})"
            move *= best.asked / best.amount
        text += f"; {label} would move by {abs(move):.2g} standard deviations" if label else ""
        out.append(text + (f"; so would it with others: {', '.join(rivals)}" if rivals else ""))
        out += [
            f"the data also ask for another value of what is stated: {c.stated} (the sum of squares would fall by {c.gain:.0f})"
            for c in asked[1:4]
            if c.gain <= 0.5 * best.gain and c.gain > 0.1 * best.gain
        ]
    for c in checks:
        if c.kind == "numerical" and c.unchecked:
            out.append(f"it could not be checked what it does that {c.stated}: {c.unchecked}")
        elif c.kind == "numerical" and not c.wanted and c.asked_sd > MOVED:
            label, move = c.most_moved
            if abs(move) > MOVED:
                out.append(
                    f"{label} hangs on a constant of the computation: {c.stated}; if {c.otherwise} it would move by "
                    f"{abs(move):.2g} standard deviations, and the data cannot tell: the interval allows for that"
                )
    return out
