"""Question: are posteriors right, over everything that the prior thinks possible?

Simulation-based calibration: truths from the prior, data with noise from each, a fit, draws of its posterior, and the rank of
the truth among them, which is uniform where all of this is right. Two problems: strokes that slip, four parameters, where
Laplace's approximation should do; and a roll that sees the stiffnesses of pads and contacts in series, where the posterior is
bent, Laplace's Gaussian wrong, and NUTS is needed. "Gaussian" stands for Laplace's draws without their importance weights.
Two tests by parameter, chi-squared on bins and the deviation of the distribution function; flat is what none of them rejects at
5 %, by Bonferroni's correction. Costs by finite differences are as many runs as forward differences need, times the measured
time of a run.

Command: .venv/bin/python experiments/calibration.py [--runs 100] [--nuts 20] [--workers 2] [--smoke]
Expected: Laplace flat for the strokes by 100 truths, NUTS flat in series by 20; 100 truths do not tell the Gaussian there
from a flat one either (least p 0.018 of four tests), though its posteriors are visibly bent. Laplace says of 19 of 20 of these
that its weights are not to be trusted, NUTS of all that so few draws make rough intervals. About 90 min of one core, most of
it NUTS.
"""

import time as clock
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _calibration_cases import CASES
from _calibration_figures import one_posterior, rank_histograms
from _experiment import markdown, options, raw_config, timed, write
from matplotlib.figure import Figure

from torchsoft.sysid.certainty.calibration import Calibration, calibrate, fitted, simulated
from torchsoft.sysid.certainty.nuts import nuts
from torchsoft.sysid.certainty.optimum import Optimum
from torchsoft.sysid.certainty.posterior import Posterior, inside, laplace
from torchsoft.sysid.certainty.profile import Profile, profiles
from torchsoft.sysid.fit.information import combinations
from torchsoft.sysid.problem.problem import Problem

Posteriors = Callable[[Optimum, int], Posterior]

TUNE, FEW = 40, 19
"""Draws for tuning before those of NUTS, which are whitened and need few; and how many ranks are among, three times thinned."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/calibration")
    runs: int = 100  # truths, Laplace
    nuts: int = 20  # truths of NUTS, and of Laplace beside it, where posteriors are bent; none leaves them out
    draws: int = 100  # of Laplace, ranks are among one less
    rtol: float = 1e-4  # of the fits; data have a hundredth of it
    workers: int = 2
    seed: int = 0
    smoke: bool = False  # ten truths of the second problem, the Gaussian only


@dataclass(frozen=True)
class Way:
    """One way to posteriors: its calibration, seconds by the wall and of the processor, of all ways of the same pass, runs and
    gradients of its posteriors."""

    calibration: Calibration
    wall_s: float
    cpu_s: float
    simulations: float
    gradients: float


@dataclass(frozen=True)
class Look:
    """One posterior of a problem, looked at closely: by Laplace, by NUTS, its profiles; and seconds of a run, of a gradient and
    of a Jacobian."""

    gaussian: Posterior
    sampled: Posterior
    profiles: list[Profile]
    sentences: list[str]
    truth: list[float]
    profiles_s: float
    jacobians: int
    run_s: float
    gradient_s: float
    jacobian_s: float


@dataclass(frozen=True)
class Result:
    config: Config
    ways: dict[str, dict[str, Way]]
    looks: dict[str, Look]


def calibrated(
    problem: Problem, config: Config, runs: int, draws: int, posteriors: Mapping[str, Posteriors]
) -> dict[str, Way]:
    """Posteriors of the same data, in one pass."""
    costs: dict[str, list[dict[str, float]]] = {name: [] for name in posteriors}

    def counted(name: str, o: Optimum, seed: int) -> Posterior:
        found = posteriors[name](o, seed)
        costs[name].append(found.cost)
        return found

    cpu = clock.process_time()
    found, wall = timed(
        lambda: calibrate(
            problem, {name: partial(counted, name) for name in posteriors}, rtol=config.rtol, runs=runs, draws=draws,
            workers=config.workers, seed=config.seed, progress=True,
        )
    )  # fmt: skip
    cpu = clock.process_time() - cpu
    return {
        name: Way(one, wall, cpu, *(sum(cost[kind] for cost in costs[name]) for kind in ("simulations", "gradients")))
        for name, one in found.items()
    }


def ways(problem: Problem, bent: bool, config: Config) -> dict[str, Way]:
    """Laplace with and without its weights, and where posteriors are bent NUTS and Laplace for fewer truths."""

    def weighted(o: Optimum, seed: int) -> Posterior:
        return laplace(o, draws=config.draws, seed=seed)

    def unweighted(o: Optimum, seed: int) -> Posterior:
        x, _ = inside(np.random.default_rng(seed), o.x[o.free], o.covariance, *o.bounds, config.draws)
        equal = np.full((1, config.draws), 1 / config.draws)
        return Posterior(
            "laplace", list(o.labels), o.values(x)[None], equal, {}, [], {"simulations": 0, "gradients": 0}, {}
        )

    def sampled(o: Optimum, seed: int) -> Posterior:
        return nuts(o, chains=1, draws=3 * FEW, tune=TUNE, seed=seed)

    if config.smoke:
        return calibrated(problem, config, config.runs, FEW, {"Gaussian": unweighted})
    if not bent:
        return calibrated(problem, config, config.runs, config.draws - 1, {"Laplace": weighted, "Gaussian": unweighted})
    out = calibrated(problem, config, config.runs, config.draws - 1, {"Gaussian": unweighted})
    if config.nuts:
        out |= calibrated(problem, config, config.nuts, FEW, {"Laplace": weighted, "NUTS": sampled})
    return out


def look(problem: Problem, config: Config) -> Look:
    x, rng = problem.coordinates.start, np.random.default_rng(config.seed)
    data = simulated(problem, x, 1e-2 * config.rtol, rng)
    assert isinstance(data, Problem)
    o = fitted(data, config.rtol)
    o.workers, before = config.workers, o.runner.jacobians
    curves, wall = timed(lambda: profiles(o, progress=True))
    spent = o.runner.jacobians - before

    def seconds(of: Callable[[], Any]) -> float:
        return float(np.median([timed(of)[1] for _ in range(5)]))

    chains, draws, tune = (1, 20, 20) if config.smoke else (2, 200, 60)
    return Look(
        laplace(o, draws=100 if config.smoke else 400, seed=config.seed),
        nuts(o, chains=chains, draws=draws, tune=tune, seed=config.seed),
        curves, [one.sentence for one in combinations(o.labels, o.covariance, 0.1)], o.values(x).tolist(), wall, spent,
        seconds(lambda: o.residuals(o.x)), seconds(lambda: o.misfit(o.x)), seconds(lambda: o.residuals(o.x, True)),
    )  # fmt: skip


def run(config: Config) -> Result:
    config = replace(config, runs=10, workers=1) if config.smoke else config
    names = ["series"] if config.smoke else list(CASES)
    problems = {name: CASES[name].problem() for name in names}
    looks = {name: look(problem, config) for name, problem in problems.items()}
    return Result(config, {name: ways(problem, CASES[name].bent, config) for name, problem in problems.items()}, looks)


def summary(result: Result) -> dict[str, Any]:
    """Ranks, tests and costs of every way, and the posteriors that were looked at."""
    cases = {}
    for name, found in result.ways.items():
        one = result.looks[name]
        n = len(one.gaussian.labels)
        cases[name] = {
            "ways": {
                way: asdict(it.calibration) | {
                    "flat": it.calibration.flat, "wall_s": it.wall_s, "cpu_s": it.cpu_s,
                    "simulations": it.simulations, "gradients": it.gradients, "gradients_s": it.gradients * one.gradient_s,
                    "by_differences_s": it.gradients * (n + 1) * one.run_s,
                }
                for way, it in found.items()
            },
            "run_s": one.run_s, "gradient_s": one.gradient_s, "jacobian_s": one.jacobian_s,
            "profiles": [asdict(profile) for profile in one.profiles], "profiles_s": one.profiles_s,
            "profiles_jacobians": one.jacobians, "profiles_by_differences_s": one.jacobians * (n + 1) * one.run_s,
            "combinations": one.sentences, "truth": one.truth,
            "posteriors": [asdict(posterior.summary) | posterior.cost for posterior in (one.gaussian, one.sampled)],
        }  # fmt: skip
    return {**raw_config(result.config), "cases": cases}


def table(result: Result) -> str:
    rows = []
    for name, found in result.ways.items():
        for way, it in found.items():
            c = it.calibration
            least = min([*c.p_chi2.values(), *c.p_ecdf.values()])
            rows.append(
                (name, way, len(c.ranks), f"{least:.2g} of {2 * len(c.labels)}", "yes" if c.flat else "no",
                 f"{c.warned} of {len(c.ranks)}", f"{it.wall_s:.0f}")
            )  # fmt: skip
    head = ("problem", "posterior", "truths", "least p", "flat", "came with a warning", "wall time [s]")
    return markdown(head, rows)


def figures(result: Result) -> dict[str, Figure]:
    out = {
        f"ranks_{name}": rank_histograms({way: it.calibration for way, it in found.items()})
        for name, found in result.ways.items()
    }
    one = result.looks["series"]
    return out | {"posterior": one_posterior(one.gaussian, one.sampled, one.profiles, one.truth)}


def main(config: Config | None = None) -> None:
    config = options(Config, __doc__) if config is None else config
    began = clock.perf_counter()
    result = run(config)
    print(table(result))
    content = summary(result) | {"wall_s": clock.perf_counter() - began}
    write(config.out, content, figures(result), table(result))


if __name__ == "__main__":
    main()
