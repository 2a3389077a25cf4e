"""Question: what do recordings tell that begin in motion, in mid-grasp, or with friction that
nobody saw locked in?

A rig with known parameters makes runs of which only what comes after a cut is given: in the middle
of a roll, in the middle of the grasp, and half a second into fast strokes, where stretched springs
keep what happened before. `estimate_initial_state` makes coordinates of the poses, velocities and
stretches at the cut, with priors from the first 50 ms of samples, which then do not count. Eight
parameters are identified from each recording alone, with many noise seeds. Beside it stand the
price, the deviations that would be predicted if the state at the cut were known, and what comes of
assuming rest.

Command: .venv/bin/python experiments/unknown_start.py [--seeds 20] [--workers 2] [--smoke]
Expected: every parameter that a recording shows (predicted deviation below 0.5) lies within its 95
% interval for 17 to 20 of 20 seeds; not knowing the start makes deviations 1 to 3 times as large,
those of K_t, K_n and E most. Where rest is assumed nothing is identified without a warning. A fit
takes half a minute on one core.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import identify_contact
import numpy as np
import torch
from identify_contact import LAW, RUBBER, TRUTH, noisy
from scipy import stats

from torchsoft import RigFile, excite
from torchsoft.experiment import COARSE, RIG, markdown, options, repeated, timed, write
from torchsoft.sysid import (
    IdentificationResult,
    Known,
    MovingStart,
    Problem,
    Recording,
    Stage,
    Unreachable,
    estimate_initial_state,
    identify,
)
from torchsoft.sysid.fit import fisher
from torchsoft.sysid.initial_state import SETTLE, Standing
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import Runner

CUTS = {
    "mid-roll": ("strokes", 0.85),
    "mid-grasp": ("strokes", 0.2),
    "hidden history": ("fast strokes", 1.0),
}
"""Motion, and when the recording of it begins [s]."""

RATE = 200.0  # of the samples [Hz]
SHOWN = (
    0.5  # Predicted standard deviation of a logarithm below which a recording shows a parameter.
)


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/unknown_start")
    seeds: int = 20
    rtol: float = 1e-4  # of the fit; data have a hundredth of it
    workers: int = 2
    smoke: bool = False  # one case, one seed, three parameters, few evaluations


@dataclass(frozen=True)
class Cut:
    """A run without noise from a cut on, and the state at the cut."""

    recording: Recording
    y0: torch.Tensor


@dataclass(frozen=True)
class Price:
    """Predicted standard deviations at the truth, where the start is unknown and where it is known,
    by parameter; seconds of a Jacobian, and of the runs that make one by finite differences."""

    unknown: dict[str, float]
    known: dict[str, float]
    coordinates: int
    exact_s: float
    differences_s: float


@dataclass(frozen=True)
class Result:
    """By case the fits of all seeds, the price, and what comes of assuming rest."""

    found: dict[str, list[IdentificationResult]]
    prices: dict[str, Price]
    rest: dict[str, dict[str, object]]


def cut(case: str, config: Config) -> Cut:
    """What the rig gives after the cut of a case; half of the usual mesh."""
    name, since = CUTS[case]
    file = excite(RigFile.ready("paper").override({"contact.v_s": 0.05} | COARSE), name)
    planned = file.build()
    real, given = (file.override(own).assemble() for own in (TRUTH, known(config)))
    real.reference = given.reference = planned.rig.reference
    until = since + 0.5 if config.smoke else file.outputs.duration
    at = since + np.arange(0.0, until - since + 0.5 / RATE, 1.0 / RATE)
    t = torch.from_numpy(np.append(-SETTLE, at))
    run = replace(planned, rig=real).run(t, y0=planned.y0, rtol=1e-2 * config.rtol)
    samples = {channel: (at, run[channel][1:].detach().numpy()) for channel in RIG}
    at_rest = Standing.of(given, planned.y0, rests={"disc": [1]})
    return Cut(Recording(case, given, samples, at_rest), run.y[1].detach())


def sought(config: Config) -> dict[str, float]:
    some = (f"{LAW}.K_n", f"{RUBBER}.E", f"{RUBBER}.tau") if config.smoke else TRUTH
    return {name: TRUTH[name] for name in some}


def known(config: Config) -> dict[str, float]:
    return {name: value for name, value in TRUTH.items() if name not in sought(config)}


def problem(recording: Recording, config: Config, off: float) -> Problem:
    """All parameters from one recording, begun `off` times the truth."""
    return identify_contact.problem(
        [recording], {name: off * value for name, value in sought(config).items()}
    )


def fit(recording: Recording, config: Config) -> IdentificationResult:
    stated = problem(recording, config, 1.1)
    most = 6 if config.smoke else 40
    plan = [
        Stage("everything", stated.names, stated.coordinates.labels, config.rtol, evaluations=most)
    ]
    return identify(stated, plan=plan, assumptions="trusted")


def price(cut: Cut, config: Config) -> Price:
    """What the first seed's recording would tell with the start unknown and known, by Jacobians at
    the true parameters and the state that the first samples give."""
    recording = estimate_initial_state(noisy(cut.recording, 0), RIG)
    start = recording.start
    assert isinstance(start, MovingStart)
    stated = problem(recording, config, 1.0)
    runner, free, x = Runner(stated.recordings), stated.coordinates.free, stated.coordinates.start
    at = stated.residuals(runner, x, stated.names, config.rtol, free)
    _, exact = timed(lambda: stated.residuals(runner, x, stated.names, at.steps, free))
    _, plain = timed(lambda: stated.residuals(runner, x, stated.names, at.steps))
    other = problem(replace(recording, start=Known(cut.y0, start.lead)), config, 1.0)
    c = other.coordinates
    better = other.residuals(Runner(other.recordings), c.start, other.names, config.rtol, c.free)
    unknown, known = (
        {name: deviation(p, J, name) for name in sought(config)}
        for p, J in ((stated, at.J), (other, better.J))
    )
    return Price(unknown, known, len(x), exact, plain * (len(x) + 1))


def deviation(stated: Problem, J: Array, name: str) -> float:
    """Predicted standard deviation of a parameter's logarithm."""
    c = stated.coordinates
    i = next(k for k, one in enumerate(c.all) if one.name == name)
    along = np.zeros(len(c))
    along[[i, *(k for k, one in enumerate(c.all) if one.name == c.all[i].ratio_to)]] = 1.0
    return float(np.sqrt(along @ fisher(J)[0] @ along))


def at_rest(cut: Cut, config: Config) -> dict[str, object]:
    """What becomes of the first seed's recording where rest is assumed."""
    try:
        found = fit(noisy(cut.recording, 0), config)
    except Unreachable as error:
        return {"library": [str(error)]}
    given = [name for name in sought(config) if found[name].ci95 is not None]
    wrong = [name for name in given if not holds(found, name)]
    return {
        "library": [*map(str, found.findings)],
        "chi2": found.chi2,
        "intervals": given,
        "wrong": wrong,
    }


def holds(found: IdentificationResult, name: str) -> bool:
    """Whether the 95 % interval holds the truth; one that is not given holds it if the standard
    deviation says so."""
    e = found[name]
    low, high = e.ci95 or (e.last * np.exp(sign * 1.96 * e.relative_sd) for sign in (-1, 1))
    return bool(low <= TRUTH[name] <= high)


def run(config: Config) -> Result:
    config = replace(config, seeds=1, workers=1) if config.smoke else config
    cuts = {case: cut(case, config) for case in (["hidden history"] if config.smoke else CUTS)}

    def fits(case: str, one: Cut) -> list[IdentificationResult]:
        known = lambda seed: estimate_initial_state(noisy(one.recording, seed), RIG)
        return repeated(lambda seed: fit(known(seed), config), config.seeds, config.workers, case)

    return Result(
        {case: fits(case, one) for case, one in cuts.items()},
        {case: price(one, config) for case, one in cuts.items()},
        {case: at_rest(one, config) for case, one in cuts.items()},
    )


def main(config: Config) -> None:
    result, cases, cells = run(config), {}, []
    for case, found in result.found.items():
        at, rows = result.prices[case], {}
        for name, sd in at.unknown.items():
            inside = sum(holds(one, name) for one in found)
            own = stats.binomtest(inside, len(found)).proportion_ci(0.95)
            rows[name] = {
                "shown": sd < SHOWN, "inside": inside, "ci95": [own.low, own.high],
                "sd_unknown": sd, "sd_known": at.known[name],
                "errors": [
                    float(np.log(one[name].last / TRUTH[name])) / one[name].relative_sd
                    for one in found
                ],
            }  # fmt: skip
            cells.append(
                (
                    case,
                    name,
                    f"{sd:.1%}",
                    f"{at.known[name]:.1%}",
                    f"{sd / at.known[name]:.2f}",
                    f"{inside} of {len(found)}" if sd < SHOWN else "not shown",
                )
            )
        cases[case] = {
            "parameters": rows, "coordinates": at.coordinates, "jacobian_s": at.exact_s,
            "jacobian_by_differences_s": at.differences_s, "assuming_rest": result.rest[case],
            "findings": [[*map(str, one.findings)] for one in found],
        }  # fmt: skip
        print(
            f"\n{case}: {at.coordinates} unknowns, a Jacobian in {at.exact_s:.2g} s, by "
            f"differences in {at.differences_s:.2g} s\nrest assumed: {result.rest[case]}"
        )
    head = ("recording", "parameter", "predicted sd", "start known", "price",
            "intervals that hold the truth")  # fmt: skip
    write(config, {"cases": cases}, table=markdown(head, cells))


if __name__ == "__main__":
    main(options(Config, __doc__))
