"""Question: do the 95 % intervals of eight parameters hold the truth in 95 % of repetitions, also
where the noise is coloured?

The three motions of `identify_contact.py`, 1.4 s of each, on half the usual mesh, many noise seeds:
white noise, then noise that is an autoregression of order one (rho = 0.9, as large as stated),
which nobody declares, so that `identify` has to find it; then the same recordings by white least
squares, as if the colour were ignored. Each seed's intervals either hold the truth or not; with N
seeds the fraction of those that do is binomial, and so is its own interval (Clopper-Pearson). The
errors over the predicted standard deviations should be normal with mean 0 and deviation 1. Seeds
differ in the noise only, and fits begin where most parameters are some standard deviations off.

Command: .venv/bin/python experiments/validation/interval_coverage.py [--seeds 100] [--workers 2]
[--smoke] Expected: between 90 and 99 % for every parameter where colour is found or is not there,
about half where it is ignored; a false alarm about one of a hundred recordings with white noise.
About a quarter of an hour on two cores.
"""

import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy import stats
from scipy.signal import lfilter

from torchsoft import Parameters
from torchsoft.excitation import CATALOGUE, Excitation, MultiSine, Strokes, begin
from torchsoft.experiment import COARSE, markdown, options, repeated, write
from torchsoft.sysid import RIG, IdentificationResult, Problem, Recording, Stage, identify, record
from torchsoft.sysid.estimate import Estimate, estimates
from torchsoft.sysid.fit import chord, fisher
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import Runner

sys.path.insert(0, str(Path(__file__).parents[1]))

import identify_contact
from identify_contact import FITTED, TRUTH

FEW = ("pad.E", "pad.tau", "contact.K_n", "contact.mu_s")
"""Parameters of the smoke test."""

LONGEST = 1.4
"""Duration of a motion [s]."""

OFF = 1.002
"""Where a fit begins, over the truth."""

SHORT = {
    "strokes": Excitation(
        motion=Strokes(travel=12e-3, stroke_time=0.2), duration=0.9, senses="bracket"
    ),
    "shaking": Excitation(
        motion=MultiSine(amplitude_x=8e-3, amplitude_y=2e-4, frequency=(2.0, 12.0)),
        duration=0.9,
        senses="bracket",
    ),
}
"""Excitations of the smoke test."""

WHITE, FOUND, IGNORED = "white", "coloured", "coloured, ignored"


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/interval_coverage")
    seeds: int = 100
    rtol: float = 3e-5  # of the fit; data have a hundredth of it
    rho: float = 0.9  # correlation of neighbouring samples of the coloured noise
    workers: int = 2
    smoke: bool = False  # two seeds, one thread, four parameters from two short recordings


class Repetition(NamedTuple):
    """One seed: by parameter its error over the predicted standard deviation and whether its
    interval holds; notices, and the orders of the noise that was found, by channel."""

    errors: dict[str, tuple[float, bool]]
    notices: list[str]
    orders: dict[str, int]


@dataclass(frozen=True)
class Result:
    config: Config
    truth: dict[str, float]
    cases: dict[str, list[Repetition]]

    def errors(self, case: str, name: str) -> list[float]:
        """Logarithm of estimate over truth, over the predicted standard deviation, of every
        seed."""
        return [one.errors[name][0] for one in self.cases[case]]

    def inside(self, case: str, name: str) -> int:
        """How many intervals hold the truth."""
        return sum(one.errors[name][1] for one in self.cases[case])


def exact(config: Config, truth: dict[str, float]) -> list[Recording]:
    """What the rig gives without noise."""
    rest = {"contact.mu_k": 0.5} if config.smoke else {}
    nominal = Parameters().override({"contact.v_s": 0.05} | rest | COARSE)
    shorter = {name: min(CATALOGUE[name].duration, LONGEST) for name in FITTED}
    motions = {
        name: CATALOGUE[name].model_copy(update={"duration": duration})
        for name, duration in shorter.items()
    }
    motions = SHORT if config.smoke else motions
    return [
        record(name, begin(e, nominal), truth, RIG, rtol=1e-2 * config.rtol, noise=0.0)
        for name, e in motions.items()
    ]


def noise(rho: float, m: int, rng: np.random.Generator) -> Array:
    """Samples (m,) of variance one, neighbours of which correlate by rho."""
    e = rng.standard_normal(m)
    e[1:] *= (1 - rho**2) ** 0.5
    return np.asarray(lfilter([1.0], [1.0, -rho], e))


def problem(recordings: list[Recording], truth: dict[str, float], rho: float, seed: int) -> Problem:
    """Noisy recordings, and where a fit begins."""
    rng, noisy = np.random.default_rng(seed), []
    for r in recordings:
        samples = {
            c: (t, y + RIG[c].noise * noise(rho, len(t), rng)) for c, (t, y) in r.samples.items()
        }
        noisy.append(replace(r, samples=samples))
    return identify_contact.problem(noisy, {name: OFF * value for name, value in truth.items()})


def errors(found: dict[str, Estimate], truth: dict[str, float]) -> dict[str, tuple[float, bool]]:
    out = {}
    for name, value in truth.items():
        e = found[name]
        assert e.ci95 is not None
        out[name] = float(np.log(e.last / value)) / e.relative_sd, e.ci95[0] <= value <= e.ci95[1]
    return out


def by_identify(stated: Problem, truth: dict[str, float], rtol: float) -> Repetition:
    """As a user would have it, in one stage; the model is known to be right."""
    plan = [Stage("all", stated.names, stated.coordinates.labels, rtol, tolerance=1e-3)]
    result: IdentificationResult = identify(stated, plan=plan, assumptions="trusted")
    orders = {one.channel: one.model.order for one in result.noise}
    return Repetition(errors({name: result[name] for name in truth}, truth), result.notices, orders)


def by_white_least_squares(stated: Problem, truth: dict[str, float], rtol: float) -> Repetition:
    """As if all noise were white: a few steps by one Jacobian, which is enough from so near."""
    c, runner = stated.coordinates, Runner(stated.recordings)
    at, steps = stated.freeze(runner, c.start, stated.names, rtol, c.free)
    end = chord(stated, runner, c.start, at, which=stated.names, free=c.free, steps=steps)
    found = estimates(stated, end.x, c.free, fisher(at.J)[0] * max(1.0, end.chi2), np.zeros(len(c)))
    return Repetition(errors({e.name: e for e in found}, truth), [], {})


def run(config: Config) -> Result:
    config = replace(config, seeds=2, workers=1, rtol=1e-4) if config.smoke else config
    truth = {name: TRUTH[name] for name in FEW} if config.smoke else TRUTH
    recordings, out = exact(config, truth), {}
    for case, rho, way in (
        (WHITE, 0.0, by_identify), (FOUND, config.rho, by_identify),
        (IGNORED, config.rho, by_white_least_squares),
    ):  # fmt: skip
        out[case] = repeated(
            lambda seed, rho=rho, way=way: way(
                problem(recordings, truth, rho, seed), truth, config.rtol
            ),
            config.seeds, config.workers, case,
        )  # fmt: skip
    return Result(config, truth, out)


def figure(result: Result) -> Figure:
    """Coverage by parameter and case with its own interval."""
    fig = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes, names = fig.subplots(), list(result.truth)
    axes.axvspan(90, 99, color="0.92")
    for k, case in enumerate(result.cases):
        y = np.arange(len(names)) + 0.22 * (k - 1)
        counts = [result.inside(case, name) for name in names]
        own = np.array(
            [stats.binomtest(inside, result.config.seeds).proportion_ci(0.95) for inside in counts]
        )
        axes.plot(100 * own.T, np.stack((y, y)), color=f"C{k}", lw=1.5)
        axes.plot(
            [100 * inside / result.config.seeds for inside in counts],
            y,
            "o",
            color=f"C{k}",
            ms=5,
            label=case,
        )
    axes.set_yticks(range(len(names)), [name.split(".")[1] for name in names])
    axes.set(xlabel="intervals that hold the truth [%]", ylim=(len(names) - 0.5, -0.5))
    axes.legend(loc="lower left", frameon=False)
    return fig


def main(config: Config) -> None:
    result = run(config)
    n, rows, cells = result.config.seeds, {}, []
    for case, repetitions in result.cases.items():
        kinds = Counter(
            " ".join(notice.split()[:4]) for one in repetitions for notice in one.notices
        )
        orders = Counter(order for one in repetitions for order in one.orders.values())
        found = {str(k): v for k, v in sorted(orders.items())}
        rows[case] = {"notices": dict(kinds), "orders": found, "parameters": {}}
        for name in result.truth:
            inside, off = result.inside(case, name), result.errors(case, name)
            own = stats.binomtest(inside, n).proportion_ci(0.95)
            mean, spread = float(np.mean(off)), float(np.std(off, ddof=1))
            rows[case]["parameters"][name] = {
                "inside": inside, "share": inside / n, "ci95": [own.low, own.high], "mean": mean,
                "sd": spread, "errors": off,
            }  # fmt: skip
            share = f"{own.low:.0%} .. {own.high:.0%}"
            cells.append((case, name, f"{inside} of {n}", share, f"{mean:+.2f}", f"{spread:.2f}"))
    head = (
        "noise",
        "parameter",
        "intervals that hold the truth",
        "its own 95 % interval",
        "mean error / sd",
        "sd of that",
    )
    table = markdown(head, cells)
    for case, row in rows.items():
        print(f"{case}: notices {row['notices']}, orders found {row['orders']}")
    write(result.config, {"seeds": n, "cases": rows}, {"interval_coverage": figure(result)}, table)


if __name__ == "__main__":
    main(options(Config, __doc__))
