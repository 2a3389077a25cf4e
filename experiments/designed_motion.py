"""Question: how much more does a motion tell that is designed for eight parameters than the hand-made three?

The hand-made three of `identify_contact.py` last 5.4 s; the designed one has 2 s, grasp included, and the same sensors.
Lowered is the largest standard deviation, each over half of what the three predict for it. Bounds of travel, compression,
speed and force are those of the catalogue's hardest motions and somewhat more, two and a half times that of the horizontal
force. Beside the covariance the criterion counts how far a Gauss-Newton step would lead a fit astray, since samples are bent
and steps finite; motions whose samples depend on a parameter more than anybody could predict are left: chaos has information
that no fit can use. The motion is then recorded with many noise seeds and identified, and the intervals that hold the truth
are counted.

The search begins with a guess of two phases. With --starts evolution (CMA-ES) breeds others near it, with --iterations
gradients move knots; by finite differences a slope would take a run for each parameter and each knot. Both find motions that
look better and are lucky: where points slip and bounce, the same motion by other steps tells up to twice as much of mu_s, or
half.

Command: .venv/bin/python experiments/designed_motion.py [--seeds 50] [--duration 3.4] [--starts 120] [--motion FILE] [--smoke]
Expected: deviations of 0.16 to 0.77 times those of the three, and of 50 seeds 44 to 49 intervals hold the truth; half a minute,
and 21 min for the fits on two cores.
That motion is kept beside this file as designed_motion.toml.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import identify_contact
import numpy as np
from _experiment import COARSE, markdown, options, raw_config, timed, write
from identify_contact import FITTED, TRUTH
from matplotlib.figure import Figure
from scipy import stats
from tqdm import tqdm
from unknown_start import noisy

from torchsoft import Parameters
from torchsoft.excitation import CATALOGUE, Excitation, Knots, Strokes, begin
from torchsoft.sysid import RIG, IdentificationResult, Problem, Recording, Stage, identify, record
from torchsoft.sysid.design.criterion import Criterion, chosen, deviations
from torchsoft.sysid.design.design import Design, design
from torchsoft.sysid.design.design_figure import design_figure
from torchsoft.sysid.design.knots import Bounds
from torchsoft.sysid.design.zigzags import PHASES, Phase, ToAndFro
from torchsoft.sysid.fit.information import fisher
from torchsoft.sysid.problem.workers import Runner
from torchsoft.threads import side_by_side

GIVEN = Excitation(
    motion=Knots(x=((0.2, 10e-3), (0.4, 0.0)), y=((0.2, -5e-4), (0.4, 0.0))), depth=1e-3, grasp_time=0.06, settle=0.0
)
"""What the search begins with, but for its duration."""

SPEED = {"x_d": 1.2, "y_d": 0.2}
"""Of set-points [m/s]; the catalogue's hardest have 1.17 and 0.13."""

TRAVEL = 40e-3
"""Of the bracket to either side [m]; the catalogue's longest is 80 mm to one side."""

COMPRESSION = (-0.3e-3, 3.3e-3)
"""Of both pads together [m]; below zero the bracket is clear of the disc. The catalogue's deepest is 3.3 mm."""

Guess = tuple[float, tuple[float, float], tuple[float, float], float]

GUESS: dict[str, Guess] = {
    "light": (0.36, (49.42e-3, 12.21e-3), (10e-3, 0.18e-3), 0.04e-3),
    "rolled": (0.64, (66.54e-3, 15.62e-3), (46.07e-3, 0.10e-3), 3.19e-3),
}
"""Two phases that tell most together, of some 300 that were tried alone, as if they were independent: a convex problem. Of each
the share of time; of x_d and y_d the time from one end to the other [s] and how far it goes to either side [m]; and the
compression of both pads together in its middle [m]."""

FORCE = {"F_x": (-150.0, 150.0), "F_y": (-300.0, 300.0)}
"""Of the bracket's drives [N]; the catalogue's largest are 60 and 275."""

OFF = 1.0005
"""Where a fit begins, over the truth; so near that only the noise decides."""

SMOKE = {
    "strokes": Excitation(motion=Strokes(travel=8e-3, stroke_time=0.3), duration=0.9, senses="bracket"),
}


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/designed_motion")
    duration: float = 2.0  # of the designed motion, with its grasp [s]
    starts: int = 2  # motions that are tried before the gradient's, the guess among them
    iterations: int = 0  # of the gradient
    seeds: int = 50  # of the noise
    design_rtol: float = 1e-4  # of the search; the best few are judged by a tenth of it
    rtol: float = 1e-5  # of the fits; data have a tenth of it
    workers: int = 2
    seed: int = 0
    motion: Path | None = None  # a motion found before, which is only assessed
    shortest: float = 10e-3  # between two knots of a set-point [s]
    smoke: bool = False  # a few motions of few knots, one seed, four parameters


@dataclass(frozen=True)
class Result:
    config: Config
    truth: dict[str, float]
    hand_made: dict[str, float]
    designed: dict[str, float]
    found: Design | None
    excitation: Excitation
    answers: list[IdentificationResult]
    seconds: dict[str, float]

    @property
    def ratio(self) -> dict[str, float]:
        """Predicted standard deviation of the designed motion over that of the three."""
        return {name: self.designed[name] / sd for name, sd in self.hand_made.items()}

    def inside(self, name: str) -> int:
        """How many intervals hold the truth."""
        found = [one[name].ci95 for one in self.answers]
        return sum(bool(ci95 is not None and ci95[0] <= self.truth[name] <= ci95[1]) for ci95 in found)


def smoke(config: Config) -> Config:
    return replace(config, starts=4, iterations=1, seeds=1, workers=1, rtol=1e-3, design_rtol=1e-3, shortest=60e-3)


def given(config: Config) -> Excitation:
    """What the search begins with."""
    return GIVEN.model_copy(update={"duration": config.duration})


def stated(recordings: list[Recording], truth: dict[str, float], off: float = 1.0) -> Problem:
    """All parameters unknown, a fit begins `off` times the truth."""
    return identify_contact.problem(recordings, {name: off * value for name, value in truth.items()})


def predicted(problem: Problem, rtol: float) -> dict[str, float]:
    """Relative standard deviations of the parameters, by the Jacobian at the truth."""
    x = problem.coordinates.start
    at, _ = problem.freeze(Runner(problem.recordings), x, problem.names, rtol, problem.coordinates.free)
    if at.lost:
        raise RuntimeError("; ".join(f"{name}: {one.reason}" for name, one in at.lost.items()))
    names, T = chosen(problem, x, None)
    return deviations(names, T, fisher(at.J)[0])


def guessed(truth: dict[str, float]) -> Parameters:
    """Nominal parameters, but for those that are known because `truth` does not ask for them."""
    known = {name: value for name, value in TRUTH.items() if name not in truth}
    return Parameters().override({"contact.v_s": 0.05} | COARSE | known)


def by_hand(truth: dict[str, float], real: Parameters, rtol: float, smoke: bool) -> dict[str, float]:
    """What the hand-made three predict, or the strokes in their place."""
    three = SMOKE if smoke else {name: CATALOGUE[name] for name in FITTED}
    made = [record(name, one, real, real, RIG, rtol=rtol, noise=0.0) for name, one in three.items()]
    return predicted(stated(made, truth), rtol)


def search(
    truth: dict[str, float], real: Parameters, half: dict[str, float], config: Config, guess: dict[str, Guess] = GUESS
) -> Design:
    """The motion whose largest deviation over its target is least, from a guess of some phases."""
    plan = stated([record("designed", given(config), real, real, RIG, rtol=1e-3, noise=0.0)], truth)
    x_0, open_at = GIVEN.x_C0, begin(given(config), real).model.settings.scenario.y_Br_grasp + GIVEN.depth
    since = GIVEN.grasp_time * (1 + 1e-9)
    bounds = {
        "x_d": Bounds(low=x_0 - TRAVEL, high=x_0 + TRAVEL, speed=SPEED["x_d"], after=since, shortest=config.shortest),
        "y_d": Bounds(
            low=open_at - COMPRESSION[1], high=open_at - COMPRESSION[0], speed=SPEED["y_d"], after=since,
            shortest=config.shortest,
        ),
    }  # fmt: skip
    phases = [
        Phase(share, {"x_d": ToAndFro(x[0], x_0, x[1]), "y_d": ToAndFro(y[0], open_at - depth, y[1])})
        for share, x, y, depth in guess.values()
    ]
    names, _ = chosen(plan, plan.coordinates.start, None)
    return design(
        plan, "designed", bounds, limits=FORCE, criterion=Criterion("worst", tuple(half[name] for name in names)),
        phases=PHASES if config.smoke else phases, starts=config.starts, iterations=config.iterations,
        rtol=config.design_rtol, workers=config.workers, seed=config.seed,
        progress=True,
    )  # fmt: skip


def run(config: Config) -> Result:
    config = smoke(config) if config.smoke else config
    truth = (
        {name: TRUTH[name] for name in ("pad.E", "pad.tau", "contact.K_n", "contact.mu_s")} if config.smoke else TRUTH
    )
    nominal = guessed(truth)
    real, seconds = nominal.override(truth), {}
    hand_made, found = by_hand(truth, real, 1e-3 if config.smoke else 1e-4, config.smoke), None
    if config.motion is None:
        half = {name: 0.5 * sd for name, sd in hand_made.items()}
        found, seconds["design"] = timed(lambda: search(truth, real, half, config))
        excitation = found.excitation(given(config))
        config.out.mkdir(parents=True, exist_ok=True)
        (config.out / "motion.toml").write_text(excitation.to_toml(), encoding="utf-8")
    else:
        excitation = Excitation.from_toml(config.motion)
    fine = record("designed", excitation, real, nominal, RIG, rtol=0.1 * config.rtol, noise=0.0)
    alone = stated([fine], truth)
    designed, seconds["jacobian"] = timed(lambda: predicted(alone, config.rtol))
    x, runner = alone.coordinates.start, Runner(alone.recordings)
    seconds["run"] = timed(lambda: alone.residuals(runner, x, alone.names, config.rtol))[1]

    def fit(seed: int) -> IdentificationResult:
        problem = stated([noisy(fine, seed)], truth, OFF)
        plan = [Stage("all", problem.names, problem.coordinates.labels, config.rtol, tolerance=1e-3)]
        return identify(problem, plan=plan, assumptions="trusted")

    work = side_by_side(fit, config.seeds, config.workers)
    pairs, seconds["fits"] = timed(
        lambda: sorted(tqdm(work, desc="fits", total=config.seeds), key=lambda pair: pair[0])
    )
    return Result(config, truth, hand_made, designed, found, excitation, [one for _, one in pairs], seconds)


def figure(result: Result) -> Figure:
    """Deviations by hand and by design, and the coverage."""
    fig = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = fig.subplots(1, 2)
    names, n = list(result.truth), result.config.seeds
    at, labels = np.arange(len(names)), [name.split(".")[1] for name in names]
    rows = (
        (-0.2, result.hand_made, "0.6", "the hand-made three"),
        (0.2, result.designed, "C0", f"designed, {result.excitation.duration:g} s"),
    )
    for offset, sds, colour, label in rows:
        left.bar(at + offset, [100 * sds[name] for name in names], 0.38, color=colour, label=label)
    left.plot(at - 0.2, [50 * result.hand_made[name] for name in names], "k_", ms=12, label="half of that")
    left.set(yscale="log", ylabel="predicted standard deviation [%]")
    left.set_xticks(at, labels)
    left.legend(fontsize=8)
    right.axhspan(90, 99, color="0.92")
    for i, name in enumerate(names):
        own = stats.binomtest(result.inside(name), n).proportion_ci(0.95)
        right.plot([i, i], [100 * own.low, 100 * own.high], "C0", lw=1.5)
        right.plot(i, 100 * result.inside(name) / n, "C0o", ms=5)
    right.set(ylabel=f"intervals that hold the truth, of {n} [%]", ylim=(min(60, right.get_ylim()[0]), 101))
    right.set_xticks(at, labels)
    return fig


def main(config: Config) -> None:
    result = run(config)
    cells, rows, n = [], {}, result.config.seeds
    for name, ratio in result.ratio.items():
        inside = result.inside(name)
        rows[name] = {
            "hand_made": result.hand_made[name], "designed": result.designed[name], "ratio": ratio, "inside": inside,
            "errors": [float(np.log(one[name].last / result.truth[name])) / one[name].relative_sd for one in result.answers],
        }  # fmt: skip
        cells.append(
            (name, f"{result.hand_made[name]:.3%}", f"{result.designed[name]:.3%}", f"{ratio:.2f}", f"{inside} of {n}")
        )
    table = markdown(
        (
            "parameter",
            "the three, 5.4 s",
            f"designed, {result.excitation.duration:g} s",
            "ratio",
            "intervals that hold the truth",
        ),
        cells,
    )
    halved = sum(ratio <= 0.5 for ratio in result.ratio.values())
    sentences = [
        f"{halved} of {len(rows)} deviations are at most half; the largest ratio is {max(result.ratio.values()):.2f}"
    ]
    summary: dict[str, Any] = {**raw_config(result.config), "parameters": rows, "seconds": result.seconds}
    figures = {"designed_motion": figure(result)}
    if found := result.found:
        many = len(result.truth)
        knots = sum(len(axis) for axis in (result.excitation.motion.x, result.excitation.motion.y))  # pyright: ignore
        made = found.made_by
        slope = 2 * knots * (many + 1) * result.seconds["run"]
        sentences += [
            f"the search took {made['wall_s']:.0f} s: {made['runs']} runs with sensitivities, {made['gradients']} with the "
            f"adjoint; one slope of the criterion by its {2 * knots} values and times would take {slope:.0f} s by differences",
            *(f"limit: {one}" for one in found.limits), *found.notices,
        ]  # fmt: skip
        summary |= {
            "made_by": made,
            "limits": found.limits,
            "history": [vars(one) for one in found.history],
        }
        figures["motion"] = design_figure(found)
    print(table, *sentences, sep="\n")
    write(result.config.out, summary | {"sentences": sentences}, figures, table)


if __name__ == "__main__":
    main(options(Config, __doc__))
