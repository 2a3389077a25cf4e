"""Question: do the data name the law that made them, and do they say so where they cannot tell?

Two pairs of laws: friction that falls smoothly with the speed of slip or Coulomb's with one coefficient; rubber of
Kelvin and Voigt, or in series with a spring (the standard linear solid). Truths are drawn about the nominal
parameters, each law by turns; both laws are fitted to the noisy recording, from the nominal parameters, with 2 to 4
unknowns, and `torchsoft.sysid.laws.compare` judges. Three motions show the difference, two hardly do with sensors 4 and 5
times worse, and two do not: gentle rolling without slip, and a slow roll with sensors 10 times worse. Whether data
can tell is measured without their noise: the wrong law is fitted to the exact recording, and what it leaves is D
times the noise of one sample. By the rule (`torchsoft.sysid.answer.comparison`) the right law should be named in more than
95 % of cases from D = 7.3 on, and a wrong one in no more than 0.06 %, whatever D.

Coulomb's law has one coefficient here: with two, efforts jump where slip begins and gradients are biased. The smooth
law's mu_k / mu_s ends at 0.9 and the solid's E_instant / E at 4, because without such bounds either contains the
other law.

Command: .venv/bin/python experiments/law_comparison.py [--cases 100] [--workers 2] [--smoke]
Expected: at least 95 of 100 named right where motions show the difference, none named wrong anywhere, "cannot tell"
where they do not. A quarter of an hour on two cores.
"""

from collections import Counter
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from _law_cases import RTOL, SETTINGS, Case, data, draw, plan, problems
from identify_contact import FiniteDifferences
from matplotlib.figure import Figure
from tqdm import tqdm

from torchsoft.experiment import markdown, options, raw_config, timed, write
from torchsoft.sysid import Problem
from torchsoft.sysid.answer.comparison import Comparison
from torchsoft.sysid.laws.compare import compare, fitted
from torchsoft.sysid.laws.evidence import Evidence, FittedLaw
from torchsoft.sysid.problem.workers import Runner
from torchsoft.sysid.report.comparison_figure import plot
from torchsoft.threads import parallel_map

TELLING = ("shaken until it slips", "one stroke that slips", "pressed at 8 Hz")
"""Motions that show the difference."""

ENOUGH = 7.3
"""D from which the rule names the right law in 95 % of cases."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/law_comparison")
    cases: int = 100  # in all of the motions that show the difference; an eighth as many in each of the others
    seed: int = 0
    workers: int = 2
    smoke: bool = False  # two cases of two motions


@dataclass(frozen=True)
class Judged:
    """One case: what the comparison said, and `apart`, the D of the wrong law on data without noise."""

    case: Case
    apart: float
    said: Comparison
    wall_s: float

    @property
    def answer(self) -> str:
        if self.said.law is None:
            return self.said.outcome
        return "right" if self.said.law == self.case.law else "wrong"


@dataclass(frozen=True)
class Result:
    config: Config
    judged: list[Judged]
    baseline: dict[str, tuple[float, float, float]]
    """by motion wall time [s] of the fits of both laws on exact sensitivities and by finite differences, and the largest
    difference of a logarithm of an estimate"""


def counts(config: Config) -> dict[str, int]:
    """Cases by motion."""
    if config.smoke:
        return {"one stroke that slips": 2, "rolled gently": 2}
    each = -(-config.cases // len(TELLING))
    some = {name: min(each, config.cases - i * each) for i, name in enumerate(TELLING)}
    others = [name for name in SETTINGS if name not in TELLING]
    return some | {name: max(2, config.cases // 8) for name in others}


def judge(case: Case) -> Judged:
    laws = problems(case, data(case, 1.0))
    found, wall = timed(lambda: compare(laws, plans={name: plan(one) for name, one in laws.items()}))
    exact = problems(case, data(case, 0.0))
    wrong = next(name for name in exact if name != case.law)
    left = Evidence(fit(wrong, exact[wrong]), Runner(exact[wrong].recordings), exact[wrong].names, [])
    return Judged(case, float(np.linalg.norm(left.fitted.r)), found, wall)


def fit(name: str, problem: Problem) -> FittedLaw:
    """One law, as `compare` fits it."""
    return fitted(name, problem, Runner(problem.recordings), problem.names, plan(problem), RTOL, 1, False)


def against_differences(seed: int) -> dict[str, tuple[float, float, float]]:
    """The first case of each telling motion fitted once more, both ways, one after the other."""
    out = {}
    for name in TELLING:
        case = draw(name, 0, seed)
        recording, ways = data(case, 1.0), []
        for kind in (Problem, FiniteDifferences):
            laws = problems(case, recording, kind)
            ways.append(timed(lambda laws=laws: [fit(law, problem).x for law, problem in laws.items()]))
        (exact, by_exact), (differences, by_differences) = ways
        off = max(float(np.abs(a - b).max()) for a, b in zip(exact, differences))
        out[name] = by_exact, by_differences, off
    return out


def run(config: Config) -> Result:
    config = replace(config, workers=1) if config.smoke else config
    cases = [draw(name, k, config.seed) for name, number in counts(config).items() for k in range(number)]
    work = parallel_map(lambda k: judge(cases[k]), len(cases), config.workers)
    done = dict(tqdm(work, desc="cases", total=len(cases), disable=config.smoke))
    return Result(
        config, [done[k] for k in range(len(cases))], {} if config.smoke else against_differences(config.seed)
    )


def figure(result: Result) -> Figure:
    """z of the rule over D, a colour a kind of answer, and the answers by D."""
    fig = Figure(figsize=(10.0, 4.0), layout="constrained")
    left, right = fig.subplots(1, 2)
    colours = {"right": "C0", "cannot tell": "0.6", "wrong": "C3", "none fits": "C1"}
    D, z = [], []
    for one in result.judged:
        versus = one.said.against[0]
        D.append(max(one.apart, 0.05))
        z.append(versus.z if versus.best == one.case.law else -versus.z)
    for answer, colour in colours.items():
        here = [i for i, one in enumerate(result.judged) if one.answer == answer]
        left.plot([D[i] for i in here], [z[i] for i in here], "o", color=colour, ms=4, label=answer)
    grid = np.geomspace(0.05, max(D), 100)
    left.plot(grid, grid / 2, "k", lw=1, label="expected, D / 2")
    left.fill_between(grid, grid / 2 - 2, grid / 2 + 2, color="0.9", lw=0)
    left.axhspan(-2, 2, color="#f6e3d6", lw=0, zorder=0)
    left.set(xscale="log", xlabel="D without noise", ylabel="z for the law that made the data", yscale="symlog")
    left.legend()
    edges = [0.0, 2.0, 4.0, ENOUGH, 15.0, 40.0, np.inf]
    names = [f"{a:g} .. {b:g}" if b < np.inf else f"over {a:g}" for a, b in pairwise(edges)]
    bottom = np.zeros(len(names))
    for answer, colour in colours.items():
        number = np.array(
            [sum(one.answer == answer and a <= one.apart < b for one in result.judged) for a, b in pairwise(edges)]
        )
        right.bar(names, number, bottom=bottom, color=colour, label=answer)
        bottom += number
    right.set(xlabel="D without noise", ylabel="cases")
    return fig


def rows(result: Result) -> list[dict]:
    """By motion, then for all data that can tell, and all that cannot, by D."""
    groups = {name: [one for one in result.judged if one.case.setting == name] for name in counts(result.config)}
    groups |= {
        "motions that show the difference": [one for one in result.judged if one.case.setting in TELLING],
        f"D of {ENOUGH:g} or more": [one for one in result.judged if one.apart >= ENOUGH],
        f"D below {ENOUGH:g}": [one for one in result.judged if one.apart < ENOUGH],
    }
    out = []
    for name, some in groups.items():
        answers, D = Counter(one.answer for one in some), [one.apart for one in some]
        spread = [float(v) for v in np.quantile(D, [0, 0.5, 1])] if D else []
        told = {key: answers[key] for key in ("right", "wrong", "cannot tell", "none fits")}
        wall = float(np.median([one.wall_s for one in some])) if some else None
        out.append({"group": name, "cases": len(some), **told, "D": spread, "median_wall_s": wall})
    return out


def main(config: Config) -> None:
    result = run(config)
    summed = rows(result)
    cells = []
    for row in summed:
        D = " / ".join(f"{v:.2g}" for v in row["D"])
        cells.append((row["group"], row["cases"], D, *(row[k] for k in ("right", "wrong", "cannot tell", "none fits"))))
    table = markdown(("data", "cases", "D least / median / most", "right", "wrong", "cannot tell", "none fits"), cells)
    print(table)
    cases = [
        {
            "motion": one.case.setting, "law": one.case.law, "truth": one.case.truth, "seed": one.case.seed, "D": one.apart,
            "answer": one.answer, "wall_s": one.wall_s, "verdict": one.said.verdict,
            "laws": [asdict(law) for law in one.said.laws], "against": [asdict(v) for v in one.said.against],
        }
        for one in result.judged
    ]  # fmt: skip
    summary = {**raw_config(result.config), "groups": summed, "cases": cases, "finite_differences": result.baseline}
    figures = {"law_comparison": figure(result)}
    for name in ("one stroke that slips", "pressed at 8 Hz"):
        shown = next((one for one in result.judged if one.case.setting == name and one.answer == "right"), None)
        if shown is not None:
            figures[f"where, {name}"] = plot(shown.said)
            print(shown.said.verdict)
    for name, (exact, differences, off) in result.baseline.items():
        print(f"{name}: both fits {exact:.1f} s, by finite differences {differences:.1f} s, estimates {off:.2g} apart")
    write(result.config.out, summary, figures, table)


if __name__ == "__main__":
    main(options(Config, __doc__))
