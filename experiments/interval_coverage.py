"""Question: do the 95 % intervals hold the truth in 95 % of repetitions?

A small problem, many noise seeds: two short recordings, four parameters, from starts 10 % off. Each seed's intervals either
hold the truth or not; with N seeds the fraction of those that do is binomial, and so is its own interval (Clopper-Pearson).
The errors over the predicted standard deviations should be normal with mean 0 and deviation 1.

Command: .venv/bin/python experiments/interval_coverage.py [--seeds 50] [--workers 2] [--smoke]
Expected: between 88 and 100 % for every parameter with 50 seeds. About a minute and a half on two cores.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from _experiment import COARSE, markdown, options, raw_config, write
from matplotlib.figure import Figure
from scipy import stats
from tqdm import tqdm

from torchsoft import Parameters
from torchsoft.excitation import Excitation, MultiSine, Strokes
from torchsoft.sysid import RIG, Problem, Recording, Stage, Unknown, identify, record
from torchsoft.threads import side_by_side

TRUTH = {"pad.E": 0.9e6, "pad.tau": 0.012, "contact.K_n": 1.6e5, "contact.mu_s": 0.65}
EXCITATIONS = {
    "strokes": Excitation(motion=Strokes(travel=12e-3, stroke_time=0.2), duration=1.0, senses="bracket"),
    "shaking": Excitation(
        motion=MultiSine(amplitude_x=8e-3, amplitude_y=2e-4, frequency=(2.0, 12.0)), duration=1.0, senses="bracket"
    ),
}


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/interval_coverage")
    seeds: int = 50
    rtol: float = 1e-4  # of the fit; data have a hundredth of it
    workers: int = 2
    smoke: bool = False  # four seeds, one thread


@dataclass(frozen=True)
class Result:
    config: Config
    errors: dict[str, list[float]]
    """logarithm of estimate over truth, over the predicted standard deviation, by parameter"""
    inside: dict[str, int]


def exact(rtol: float) -> list[Recording]:
    """What the rig gives without noise; half of the usual mesh."""
    nominal = Parameters().override({"contact.v_s": 0.05, "contact.mu_k": 0.5} | COARSE)
    rig = nominal.override(TRUTH)
    return [record(name, e, rig, nominal, RIG, rtol=1e-2 * rtol, noise=0.0) for name, e in EXCITATIONS.items()]


def repeat(recordings: list[Recording], rtol: float, seed: int) -> dict[str, tuple[float, bool]]:
    """One repetition: by parameter its error over the predicted standard deviation, and whether its interval holds."""
    rng, noisy = np.random.default_rng(seed), []
    for r in recordings:
        samples = {c: (t, y + RIG[c].noise * rng.standard_normal(len(t))) for c, (t, y) in r.samples.items()}
        noisy.append(replace(r, samples=samples))
    problem = Problem(noisy, RIG, {name: Unknown(nominal=1.1 * value) for name, value in TRUTH.items()})
    plan = [Stage("all", problem.names, problem.coordinates.labels, rtol)]
    result = identify(problem, plan=plan)
    out = {}
    for name, truth in TRUTH.items():
        e = result[name]
        assert e.ci95 is not None
        out[name] = float(np.log(e.last / truth)) / e.relative_sd, e.ci95[0] <= truth <= e.ci95[1]
    return out


def run(config: Config) -> Result:
    config = replace(config, seeds=4, workers=1) if config.smoke else config
    recordings = exact(config.rtol)
    work = side_by_side(lambda seed: repeat(recordings, config.rtol, seed), config.seeds, config.workers)
    found = [one for _, one in sorted(tqdm(work, desc="seeds", total=config.seeds), key=lambda pair: pair[0])]
    errors = {name: [one[name][0] for one in found] for name in TRUTH}
    return Result(config, errors, {name: sum(one[name][1] for one in found) for name in TRUTH})


def figure(result: Result) -> Figure:
    """Errors over their predicted standard deviations, beside the normal distribution."""
    fig = Figure(figsize=(3.0 * len(result.errors), 3.0), layout="constrained")
    z = np.linspace(-4, 4, 200)
    for ax, (name, errors) in zip(fig.subplots(1, len(result.errors), sharey=True), result.errors.items()):
        ax.hist(errors, bins=np.linspace(-4, 4, 17).tolist(), density=True, color="C0", alpha=0.6)
        ax.plot(z, stats.norm.pdf(z), "k", lw=1)
        ax.set(title=f"{name}: {result.inside[name]} of {len(errors)} inside", xlabel="error / predicted sd")
    return fig


def main() -> None:
    result = run(options(Config, __doc__))
    n, rows, cells = result.config.seeds, {}, []
    for name, inside in result.inside.items():
        own = stats.binomtest(inside, n).proportion_ci(0.95)
        mean, spread = float(np.mean(result.errors[name])), float(np.std(result.errors[name], ddof=1))
        rows[name] = {"inside": inside, "share": inside / n, "ci95": [own.low, own.high], "mean": mean, "sd": spread}
        interval = f"{own.low:.0%} .. {own.high:.0%}"
        cells.append((name, f"{inside} of {n}", f"{inside / n:.0%}", interval, f"{mean:+.2f}", f"{spread:.2f}"))
    head = (
        "parameter",
        "intervals that hold the truth",
        "fraction",
        "its own 95 % interval",
        "mean error / sd",
        "sd of that",
    )
    print(markdown(head, cells))
    summary = {**raw_config(result.config), "seeds": n, "parameters": rows, "errors": result.errors}
    write(result.config.out, summary, {"interval_coverage": figure(result)})


if __name__ == "__main__":
    main()
