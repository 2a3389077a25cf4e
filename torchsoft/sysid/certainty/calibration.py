"""Simulation-based calibration: are posteriors right, over everything that the prior thinks possible?

A truth is drawn from the prior, data with noise from the truth, and draws from the posterior of these data. Where all of it is
right, the rank of the truth among the draws is uniform (Talts et al. 2018), for every coordinate. Two tests say whether it is:
chi-squared on bins, and the largest deviation of the ranks' distribution function from what uniform ranks could have
(Saeilynoja, Buerkner and Vehtari 2022), which is found by simulation.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.sparse.linalg import spsolve_triangular
from tqdm import tqdm

from torchsoft.sysid.certainty.optimum import Optimum
from torchsoft.sysid.certainty.posterior import Posterior
from torchsoft.sysid.fit.fit import Unreachable, gauss_newton
from torchsoft.sysid.problem.prediction import FailedRun
from torchsoft.sysid.problem.problem import Problem
from torchsoft.sysid.problem.readout import Signals
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.workers import Runner
from torchsoft.threads import side_by_side, single_threaded

Counts = NDArray[np.int64]

LEVEL = 0.05
"""Part of all calibrations of right posteriors that are called not flat."""

EXPECTED = 5
"""Fewest ranks that a bin of the chi-squared test should expect."""

SIMULATED = 2000
"""Sets of uniform ranks that the second test is compared with."""

EXACT = 1e-2
"""Tolerance of the runs that data are made of, over that of the fits."""

ROUNDS = 2
"""Fits of each data set, the last one on steps that are chosen at the end of the one before."""


@dataclass(frozen=True)
class Calibration:
    """Ranks (runs, n) of the truth among `draws` draws, from 0 to `draws`, for the coordinates `labels`; the truths (runs, n)
    in physical units, p-values of the two tests by label, and what went wrong."""

    labels: list[str]
    draws: int
    ranks: list[list[int]] = field(repr=False)
    truths: list[list[float]] = field(repr=False)
    p_chi2: dict[str, float]
    p_ecdf: dict[str, float]
    warned: int  # posteriors that came with a notice
    notices: list[str]

    @property
    def flat(self) -> bool:
        """Whether no test of any coordinate, by Bonferroni's correction for their number, rejects uniform ranks."""
        every = [*self.p_chi2.values(), *self.p_ecdf.values()]
        return min(every) * len(every) > LEVEL


class Replication(NamedTuple):
    """The truth (n,) in physical units, and by posterior its ranks (n,) among the draws, and what it warned of."""

    truth: Array
    ranks: dict[str, Counts]
    warnings: dict[str, list[str]]


def calibrate(
    problem: Problem, posteriors: Mapping[str, Callable[[Optimum, int], Posterior]], *, rtol: float, runs: int = 100,
    draws: int = 99, workers: int = 1, seed: int = 0, progress: bool = False,
) -> dict[str, Calibration]:  # fmt: skip
    """Ranks of truths that are drawn from the priors of `problem`, uniform between the bounds where there is none.

    Its recordings give the motions and the times of the samples, whose values are made anew. Each of the `posteriors` makes
    draws from the same optima, of which `draws` are picked, and a seed. Replications run side by side in `workers` threads.
    Those that fail are left out and counted in the notices: what is tested is then not the whole prior. Raises `ValueError`
    where the priors depend on the data, and `RuntimeError` where hardly a replication succeeds.
    """

    def one(k: int) -> Replication | str:
        rng = np.random.default_rng([seed, k])
        x = truth(problem, rng)
        data = simulated(problem, x, EXACT * rtol, rng)
        if isinstance(data, str):
            return data
        try:
            optimum, number = fitted(data, rtol), int(rng.integers(2**31))
            found = {name: make(optimum, number) for name, make in posteriors.items()}
        except (Unreachable, ValueError) as failure:
            return str(failure)
        values = optimum.values(x[optimum.free])
        ranks = {name: (each.pick(draws, rng) < values).sum(0) for name, each in found.items()}
        return Replication(values, ranks, {name: each.notices for name, each in found.items()})

    with single_threaded():
        work = side_by_side(one, runs, workers)
        done = dict(tqdm(work, desc="replications", total=runs, disable=not progress))
    results = [done[k] for k in range(runs)]
    kept, lost = [r for r in results if not isinstance(r, str)], [r for r in results if isinstance(r, str)]
    if len(kept) < max(2 * EXPECTED, runs // 2):
        raise RuntimeError(f"only {len(kept)} of {runs} replications succeeded: {lost[0]}")
    notices = [f"{len(lost)} of {runs} replications failed and are left out: {lost[0]}"] if lost else []
    labels = [label for label, free in zip(problem.coordinates.labels, problem.coordinates.free) if free]
    return {name: collected(labels, draws, name, kept, notices) for name in posteriors}


def collected(labels: list[str], draws: int, name: str, kept: Sequence[Replication], notices: list[str]) -> Calibration:
    """The calibration of one of the posteriors."""
    ranks = np.array([one.ranks[name] for one in kept])
    warned = [one.warnings[name][0] for one in kept if one.warnings[name]]
    if warned:
        told = f"{len(warned)} of {len(kept)} posteriors came with a warning, such as: {warned[0]}"
        notices = [*notices, told]
    by_label = {label: ranks[:, i] for i, label in enumerate(labels)}
    return Calibration(
        labels=labels,
        draws=draws,
        ranks=ranks.tolist(),
        truths=[one.truth.tolist() for one in kept],
        p_chi2={label: chi2_test(some, draws) for label, some in by_label.items()},
        p_ecdf={label: ecdf_test(some, draws) for label, some in by_label.items()},
        warned=len(warned),
        notices=notices,
    )


def truth(problem: Problem, rng: np.random.Generator) -> Array:
    """Coordinates (n,) from their priors within the bounds; fixed ones stay."""
    x = problem.coordinates.start
    for i, c in enumerate(problem.coordinates.all):
        while not c.fixed:
            value = c.to_value(rng.uniform(c.to_x(c.low), c.to_x(c.high))) if c.prior is None else c.prior.draw(rng)
            if c.low <= value <= c.high:
                x[i] = c.to_x(value)
                break
    return x


def simulated(problem: Problem, x: Array, rtol: float, rng: np.random.Generator) -> Problem | str:
    """The problem with the samples that its sensors would give at x (n,), with noise; or why there is no run at x."""
    jobs = problem.jobs(x, problem.names, rtol, None)
    recordings = []
    for job, run in zip(jobs, Runner(problem.recordings).run(jobs)):
        recording, samples = problem.recordings[job.recording], {}
        if isinstance(run, FailedRun):
            return f"recording `{recording.name}` cannot be simulated from the prior: {run.reason}"
        signals = Signals(run.t, recording.channels, run.signals, None)
        for channel, sensor in problem.readouts(x, job.recording).items():
            t, _ = recording.samples[channel]
            noise = rng.standard_normal(len(t))
            if channel in problem.noise:
                noise = np.asarray(spsolve_triangular(problem.noise[channel].whitener(t), noise))
            y = sensor.expected(signals, t)[0] + sensor.noise * noise
            samples[channel] = t, np.clip(y, sensor.low, sensor.high)
        recordings.append(replace(recording, samples=samples))
    out = Problem(recordings, problem.sensors, problem.unknowns, problem.noise)
    if out.coordinates.all != problem.coordinates.all:
        raise ValueError("priors or bounds depend on the data, so there is nothing to draw a truth from")
    return out


def fitted(problem: Problem, rtol: float) -> Optimum:
    """The optimum that a fit from the nominal values finds. Raises `Unreachable`."""
    optimum = Optimum(problem, problem.coordinates.start, rtol=rtol)
    for _ in range(ROUNDS):
        fit = gauss_newton(
            problem, optimum.runner, optimum.x, which=optimum.which, free=optimum.free, steps=optimum.steps,
            first=optimum.at,
        )  # fmt: skip
        optimum = Optimum(problem, fit.x, rtol=rtol)
    return optimum


def chi2_test(ranks: Counts, draws: int) -> float:
    """p-value of ranks (runs,) from 0 to `draws` being uniform, by as many equal bins as expect `EXPECTED` each."""
    fitting = [b for b in range(2, draws + 2) if (draws + 1) % b == 0 and len(ranks) / b >= EXPECTED]
    if not fitting:
        raise ValueError(f"{len(ranks)} ranks up to {draws} cannot be put into equal bins")
    counts = np.bincount((ranks * fitting[-1]) // (draws + 1), minlength=fitting[-1])
    return float(stats.chisquare(counts).pvalue)


def deviation(ranks: Counts, draws: int) -> Array:
    """By set of ranks (sets, runs), the least probability of any point of their distribution function, were they uniform."""
    sets, runs = ranks.shape
    counts = np.bincount((ranks + (draws + 1) * np.arange(sets)[:, None]).ravel(), minlength=sets * (draws + 1))
    below = counts.reshape(sets, draws + 1).cumsum(-1)[:, :-1]
    chance, possible = stats.binom(runs, np.arange(1, draws + 1) / (draws + 1)), np.arange(runs + 1)[:, None]
    either = np.minimum(chance.cdf(possible), chance.sf(possible - 1))  # (counts, draws)
    return either[below, np.arange(draws)].min(-1)


@cache
def uniform_deviations(runs: int, draws: int) -> Array:
    """Deviations of `SIMULATED` sets of uniform ranks."""
    return deviation(np.random.default_rng(0).integers(0, draws + 1, (SIMULATED, runs)), draws)


def ecdf_test(ranks: Counts, draws: int) -> float:
    """p-value of ranks (runs,) from 0 to `draws` being uniform, by the largest deviation of their distribution function."""
    least = uniform_deviations(len(ranks), draws)
    return float((1 + (least <= deviation(ranks[None], draws)[0]).sum()) / (1 + SIMULATED))


def envelope(runs: int, draws: int) -> tuple[Array, Array]:
    """Least and largest numbers of ranks below 1, ..., `draws` (draws,) that 95 % of sets of uniform ranks stay within."""
    level = float(np.quantile(uniform_deviations(runs, draws), LEVEL))
    chance = stats.binom(runs, np.arange(1, draws + 1) / (draws + 1))
    return chance.ppf(level), chance.isf(level)
