"""Question: can an interval be wrong without a warning beside it, when the rig is not the one that the fit takes for granted?

A second simulator (`tests/foreign`: own finite elements, one dense Newton system, backward Euler at 20 us, no function shared
with torchsoft) makes recordings of rigs that differ in what a laboratory would not know: the mesh, the friction law, the ramps
at touch-down, the place of the disc, its radius. Others differ in the sensors (zero, sign, delay, colour) or in what is noted
down (set-points at the samples only, F_ff left out, whose x the loop measures). `torchsoft.sysid` identifies eight
parameters from each, with noise of 10 um, 0.5 mrad and 0.1 N at 200 Hz; every case has the same noise, so that cases differ
by what is wrong and not by luck. An interval holds the truth or not; a warning names the cause or not.

Command: .venv/bin/python experiments/validation/foreign_rigs.py [--smoke] [--only "mesh 240 x 6"] [--workers 2]
Expected: every interval holds, or a warning names the cause; no case is silent. About a quarter of an hour on two cores, the
recordings included, which are kept in the folder --out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from _foreign_cases import CASES, Case
from _foreign_recordings import SMOKE_UNKNOWNS, TRUTH, Made, Order, make_all
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchsoft.experiment import markdown, options, raw_config, write
from torchsoft.sysid import RIG, IdentificationResult, Problem, Unknown, Unreachable, explain
from torchsoft.sysid.problem.journal import forget
from torchsoft.sysid.problem.workers import Runner

VERDICTS = {
    "holds": "C0",
    "cause named": "C2",
    "warned, cause not named": "C1",
    "silent": "C3",
}
"""What may be said of a case, and its colour: every interval holds the truth; one does not, and a warning names the cause, or
says only that something is wrong; or nothing is said."""

START = 1.6
"""Every parameter begins off by this factor, one up and the next one down."""

SMOKE = ("same assumptions, gentle", "sign of F_x flipped")


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/foreign_rigs")
    rtol: float = 1e-5  # of the fits' last stage
    step: float = 20e-6  # of the stranger's simulator [s]
    seed: int = 7  # of the noise
    workers: int = 2
    only: tuple[str, ...] = ()  # names of cases; all of them by default
    smoke: bool = False  # two cases, four parameters, two short recordings on a coarse mesh


@dataclass(frozen=True)
class Outcome:
    """One case with what came of it: the result, or the sentence with which it was refused."""

    case: Case
    truth: Mapping[str, float]
    made: list[Made]
    found: IdentificationResult | None
    refused: str
    wall_s: float
    cpu_s: float
    differences_s: float
    """Processor time that the fit's Jacobians alone would take by forward differences: a measured run for each unknown."""

    @property
    def warnings(self) -> list[str]:
        return [self.refused] if self.found is None else list(self.found.notices)

    @property
    def wrong(self) -> list[str]:
        """Parameters whose interval does not hold the truth; one without an interval claims nothing."""
        rows = self.parameters()
        return [name for name, row in rows.items() if row["inside"] is False]

    @property
    def naming(self) -> list[str]:
        """The warnings that name what is wrong."""
        return [text for text in self.warnings if any(word.lower() in text.lower() for word in self.case.cause)]

    @property
    def verdict(self) -> str:
        if self.found is not None and not self.wrong:
            return "holds"
        if self.naming:
            return "cause named"
        return "warned, cause not named" if self.warnings else "silent"

    def parameters(self) -> dict[str, dict[str, Any]]:
        out = {}
        for name, truth in self.truth.items():
            row: dict[str, Any] = {"truth": truth, "estimate": None, "ci95": None, "relative_sd": None, "inside": None}
            if self.found is not None:
                e = self.found[name]
                row |= {"estimate": e.value, "ci95": e.ci95, "relative_sd": e.relative_sd}
                row["inside"] = None if e.ci95 is None else bool(e.ci95[0] <= truth <= e.ci95[1])
            out[name] = row
        return out

    def summary(self) -> dict[str, Any]:
        case, found = self.case, self.found
        return {
            "name": case.name, "parameters": self.parameters(), "warnings": self.warnings, "verdict": self.verdict,
            "naming_the_cause": self.naming, "wrong": self.wrong, "refused": found is None,
            "chi2": None if found is None else found.chi2, "converged": None if found is None else found.converged,
            "recordings": list(case.excitations), "fastest_slip": max(one.slip for one in self.made),
            "identify_wall_s": self.wall_s, "identify_cpu_s": self.cpu_s, "jacobians_by_differences_cpu_s": self.differences_s,
            "recordings_wall_s": sum(one.wall_s for one in self.made),
        }  # fmt: skip


def truths(config: Config) -> dict[str, float]:
    return {name: TRUTH[name] for name in SMOKE_UNKNOWNS} if config.smoke else TRUTH


def unknowns(config: Config) -> dict[str, Unknown]:
    """Starts off by `START`; mu_k by its ratio to mu_s."""
    out = {name: Unknown(nominal=value * START ** (-1) ** i) for i, (name, value) in enumerate(truths(config).items())}
    if "contact.mu_k" in out:
        out["contact.mu_k"] = Unknown(nominal=0.9, ratio_to="contact.mu_s", low=0.1, high=1.0)
    return out


def chosen(config: Config) -> list[Case]:
    """The cases that were asked for. Raises `ValueError` for a name that is not there."""
    names = config.only or (SMOKE if config.smoke else tuple(case.name for case in CASES))
    known = {case.name: case for case in CASES}
    if strange := [name for name in names if name not in known]:
        raise ValueError(f"there is no case {strange[0]!r}; the cases are {', '.join(known)}")
    return [
        replace(known[name], excitations=("pressing", "shaking")) if config.smoke else known[name] for name in names
    ]


def runs(case: Case, config: Config) -> Path:
    """Where the runs of a fit are kept until all cases are done: begun again, it goes through them in seconds."""
    return config.out / f"runs-{case.name.replace(' ', '-').replace('/', '-')}"


def study(case: Case, made: Mapping[Order, Made], config: Config) -> Outcome:
    """Identify one case."""
    mine, began = [made[order] for order in case.orders()], (perf_counter(), process_time())
    found, refused, problem = None, "", None
    try:
        recordings = [
            case.recording(name, one, config.seed + 10 * k, config.smoke)
            for k, (name, one) in enumerate(zip(case.excitations, mine))
        ]
        problem = Problem(recordings, RIG, unknowns(config))
        found = explain(
            problem, rtol=config.rtol, workers=config.workers, checkpoint=runs(case, config), progress=not config.smoke
        )
    except (Unreachable, ValueError) as error:
        refused = str(error)
    wall, cpu, differences = perf_counter() - began[0], process_time() - began[1], 0.0
    if found is not None and problem is not None:
        differences = found.cost["jacobians"] * (len(problem.coordinates) + 1) * a_run(problem, config)
    return Outcome(case, truths(config), mine, found, refused, wall, cpu, differences)


def a_run(problem: Problem, config: Config) -> float:
    """Processor time of the mean recording's run [s], where the fit begins."""
    began = process_time()
    problem.residuals(Runner(problem.recordings), problem.coordinates.start, problem.names, config.rtol)
    return (process_time() - began) / len(problem.recordings)


def run(config: Config) -> list[Outcome]:
    """All cases; the summary is written anew after each."""
    config = replace(config, workers=1, step=2 * config.step) if config.smoke else config
    cases = chosen(config)
    orders = [order for case in cases for order in case.orders()]
    made = make_all(orders, config.step, config.smoke, config.out / "recordings", config.workers)
    outcomes = []
    for case in cases:
        outcomes.append(study(case, made, config))
        print(f"\n{case.name}: {outcomes[-1].verdict}", *outcomes[-1].warnings, sep="\n  ")
        write(config.out, summary(config, outcomes), {"foreign_rigs": figure(outcomes)}, table(outcomes))
    for case in cases:
        forget(runs(case, config))
    return outcomes


def summary(config: Config, outcomes: list[Outcome]) -> dict[str, Any]:
    verdicts = [one.verdict for one in outcomes]
    return {
        **raw_config(config),
        "noise": {channel: sensor.noise for channel, sensor in RIG.items()},
        "verdicts": {verdict: verdicts.count(verdict) for verdict in VERDICTS},
        "cases": [one.summary() for one in outcomes],
    }


def table(outcomes: list[Outcome]) -> str:
    """Errors in percent, those outside of their interval in bold, and what was said."""
    rows = []
    for one in outcomes:
        cells = []
        for row in one.parameters().values():
            if row["estimate"] is None:
                cells.append("-")
                continue
            text = f"{100 * (row['estimate'] / row['truth'] - 1):+.2g}"
            cells.append(text if row["inside"] else f"**{text}**")
        chi2 = "-" if one.found is None else f"{one.found.chi2:.3f}"
        said = "; ".join(text if len(text) < 110 else text[:107] + "..." for text in one.warnings) or "-"
        rows.append((one.case.name, *cells, chi2, one.verdict, f"{one.wall_s:.0f}", said.replace("|", "/")))
    short = [name.split(".")[1] for name in (outcomes[0].truth if outcomes else TRUTH)]
    return markdown(("case", *(f"{name} [%]" for name in short), "chi2", "verdict", "wall [s]", "warnings"), rows)


REACH = 3.0
"""The figure shows estimates up to this factor off the truth; beyond it an arrow stands at the edge."""


def figure(outcomes: list[Outcome]) -> Figure:
    """Estimates and intervals over the truth, a panel a parameter, a row a case."""
    names = list(outcomes[0].truth)
    fig = Figure(figsize=(3.0 + 1.55 * len(names), 1.6 + 0.36 * len(outcomes)), layout="constrained")
    axes = fig.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for ax, name in zip(axes, names):
        ax.axvline(0.0, color="0.6", lw=0.8)
        for i, one in enumerate(outcomes):
            row, colour = one.parameters()[name], VERDICTS[one.verdict]
            if row["estimate"] is None:
                ax.text(0.0, i, "refused" if one.found is None else "not seen", ha="center", va="center", fontsize=7,
                        color=colour, bbox={"fc": "w", "ec": "none", "pad": 0.5})  # fmt: skip
                continue
            low, value, high = np.log([row["ci95"][0], row["estimate"], row["ci95"][1]]) - np.log(row["truth"])
            edge = np.log(REACH)
            if abs(value) > edge:
                ax.plot(np.sign(value) * edge * 0.97, i, ">" if value > 0 else "<", color=colour, ms=7)
                continue
            ax.plot(np.clip([low, high], -edge, edge), [i, i], color=colour, lw=2.2, solid_capstyle="butt")
            ax.plot(value, i, "o" if row["inside"] else "X", color=colour, ms=4 if row["inside"] else 7)
        ax.set(xlim=(-np.log(REACH), np.log(REACH)), title=name.split(".")[1])
        ax.set_xscale("symlog", linthresh=0.02)
        percent = (-50, -10, -1, 0, 1, 10, 100)
        ax.set_xticks(np.log([1 + p / 100 for p in percent]), [f"{p:g}" for p in percent], fontsize=7)
        ax.minorticks_off()
        ax.tick_params(axis="y", length=0)
        ax.grid(axis="x", lw=0.3)
    axes[0].set_yticks(range(len(outcomes)), [one.case.name for one in outcomes], fontsize=8)
    axes[0].set_ylim(len(outcomes) - 0.5, -0.5)
    for i, one in enumerate(outcomes):
        said = "warned" if one.warnings else "no warning"
        axes[-1].text(1.06, i, said, transform=axes[-1].get_yaxis_transform(), va="center", fontsize=8)
    marks = [Line2D([], [], color=colour, marker="o", lw=2.2, label=verdict) for verdict, colour in VERDICTS.items()]
    marks.append(Line2D([], [], color="0.4", marker="X", ls="", ms=7, label="interval without the truth"))
    fig.legend(handles=marks, loc="outside lower center", ncols=len(marks), fontsize=8, frameon=False)
    fig.suptitle("Estimates and 95 % intervals: off the truth by so many percent", fontsize=10)
    return fig


def main(config: Config) -> None:
    outcomes = run(config)
    print("\n" + table(outcomes))


if __name__ == "__main__":
    main(options(Config, __doc__))
