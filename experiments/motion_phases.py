"""Question: what could a motion of 2 s tell at most of eight parameters, if it were put together of phases?

In a phase the bracket goes to and fro along x and along y, each at a pace of its own, about some compression. Hundreds are run
alone, after a short grasp; of each, by two tolerances, the Fisher matrix a second. Those whose deviations by the two do not
agree within a quarter are left out: their information is that of chaos. If phases told as much one after the other as alone,
matrices would add up, and the shares of time that make the largest deviation least would be a convex problem. So the best
mixture is a bound of a kind on what a search for motions can come to. Its largest phases are then put together: what that
motion tells says whether they add up. Phases are drawn at random first, then near those that the mixture has, in some rounds.

Command: .venv/bin/python experiments/motion_phases.py [--count 240] [--rounds 4] [--smoke]
Expected: of 400 phases 273 can be used; the best mixture leaves at most 0.40 of the deviations of the hand-made three, two
phases 0.80, the largest four put together 1.13: they do not add up. About a quarter of an hour on two cores.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import designed_motion
import numpy as np
from _experiment import markdown, options, raw_config, timed, write
from designed_motion import COMPRESSION, FORCE, GIVEN, SPEED, TRAVEL, by_hand, guessed, stated
from identify_contact import TRUTH
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import qmc
from tqdm import tqdm

from torchsoft.excitation import Excitation, Knots
from torchsoft.physics.statics import NoEquilibrium
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid import RIG, record
from torchsoft.sysid.design.criterion import chosen
from torchsoft.sysid.design.design import Design
from torchsoft.sysid.design.knots import PEAK
from torchsoft.sysid.problem.workers import Runner
from torchsoft.threads import side_by_side

Array = NDArray[np.float64]

GRASP = 0.15
"""Before a phase that is run alone, to the compression in its middle [s]."""

LIGHTEST = 0.2e-3
"""Compression of such a grasp, at least: the disc must be held before it is let go [m]."""

SHORTEST, SLOWEST = 10e-3, (12.0, 8.0)
"""From one end to the other [s], and how many times that at most, along x and y."""

TOGETHER = 4
"""Phases that are put one after the other."""

AGREE = 1.3
"""Ratio of a deviation by two tolerances up to which a phase is not chaotic."""

NEAR = 0.08
"""Standard deviation of the numbers of a phase that is drawn near another."""

SHARES = np.linspace(0.05, 0.95, 19)
"""Of time, for the first of two phases."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/motion_phases")
    count: int = 240  # phases drawn at random
    rounds: int = 4  # of phases drawn near those of the mixture
    per_round: int = 40
    seconds: float = 0.6  # of a phase
    duration: float = 2.0  # of a motion, its grasp included [s]
    rtol: float = 1e-4  # and a third of it
    workers: int = 2
    seed: int = 0
    smoke: bool = False  # a few short phases, four parameters


class Phase(NamedTuple):
    """To and fro: compression of both pads together [m]; along x and y how far to either side [m] and from one end to the other
    in which time [s]."""

    compression: float
    x: float
    x_time: float
    y: float
    y_time: float

    @classmethod
    def of(cls, u: Array) -> "Phase":
        """Of five numbers from 0 to 1, within all bounds."""
        x_time, y_time = (SHORTEST * most**part for most, part in zip(SLOWEST, u[:2]))
        compression = COMPRESSION[1] * u[2] ** 2  # where the grasp is light, little changes much
        far = 0.999 * np.array([SPEED["x_d"] * x_time, SPEED["y_d"] * y_time]) / PEAK / 2
        room = min(COMPRESSION[1] - compression, compression - COMPRESSION[0])
        return cls(compression, min(u[3] * far[0], TRAVEL), x_time, min(u[4] * far[1], room), y_time)

    def excitation(self, seconds: float) -> Excitation:
        """The phase alone, after a grasp."""

        def course(middle: float, far: float, time: float) -> tuple[tuple[float, float], ...]:
            return tuple(((k + 1) * time, middle + far * (-1) ** k) for k in range(int(seconds / time * (1 + 1e-12))))

        depth = max(self.compression, LIGHTEST)
        motion = Knots(x=course(0.0, self.x, self.x_time), y=course(depth - self.compression, self.y, self.y_time))
        return Excitation(motion=motion, duration=GRASP + seconds, depth=depth, grasp_time=GRASP, settle=0.0)

    def __str__(self) -> str:
        return (f"compression {1e3 * self.compression:.2f} mm, x +-{1e3 * self.x:.1f} mm in {1e3 * self.x_time:.0f} ms, "
                f"y +-{1e3 * self.y:.2f} mm in {1e3 * self.y_time:.0f} ms")  # fmt: skip


class Alone(NamedTuple):
    """A phase that was run alone, by its numbers: the information (p, p) a second about relative errors."""

    u: Array
    phase: Phase
    rate: Array


@dataclass(frozen=True)
class Mixture:
    """Shares of the time for some phases, and the deviations (p,) that follow."""

    phases: list[Alone]
    shares: Array
    deviations: Array


class Study:
    """The parameters that are asked for, and what phases tell of them."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.truth = {name: TRUTH[name] for name in (list(TRUTH)[:4] if config.smoke else TRUTH)}
        self.real = guessed(self.truth).override(self.truth)
        self.hand_made = by_hand(self.truth, self.real, config.rtol, config.smoke)

    @property
    def time(self) -> float:
        """That phases may share [s]."""
        return self.config.duration - GIVEN.grasp_time

    def information(self, phase: Phase, rtol: float) -> Array | None:
        """(p, p) a second, of the samples after the grasp; None where forces go beyond their limits. Raises
        `SimulationFailed`."""
        made = record("phase", phase.excitation(self.config.seconds), self.real, self.real, RIG, rtol=rtol, noise=0.0)
        if any(not low <= value <= high for name, (low, high) in FORCE.items() for value in made.samples[name][1]):
            return None
        problem = stated([made], self.truth)
        x = problem.coordinates.start
        at = problem.residuals(Runner(problem.recordings), x, problem.names, rtol, problem.coordinates.free)
        if at.lost:
            raise SimulationFailed(at.lost["phase"].reason, 0.0)
        later = np.concatenate([made.samples[channel][0] > GRASP for channel in problem.readouts(x, 0)])
        J = at.J[: len(later)][later] @ np.linalg.inv(chosen(problem, x, list(self.truth))[1])
        return J.T @ J / self.config.seconds

    def alone(self, u: Array) -> Alone | None:
        """A phase by its numbers; None where it cannot be run, asks for more force than there is, or is chaotic."""
        phase = Phase.of(u)
        try:
            rates = [self.information(phase, rtol) for rtol in (self.config.rtol, self.config.rtol / 3)]
        except (SimulationFailed, NoEquilibrium):
            return None
        coarse, fine = rates
        if coarse is None or fine is None:
            return None
        ratio = np.sqrt(np.diag(fine) / np.diag(coarse))
        if not (ratio.min() > 1 / AGREE and ratio.max() < AGREE):
            return None
        return Alone(u, phase, min(coarse, fine, key=np.trace))

    def mixed(self, phases: Sequence[Alone], targets: Array) -> Mixture:
        """The shares for which the largest variance, over the square of its target, is least: a convex problem."""
        rates, p = np.array([one.rate for one in phases]), len(targets)

        def slack(v: Array) -> Array:
            """Of every variance to the largest allowed, the last of the variables."""
            C = np.linalg.inv(self.time * np.einsum("k,kij->ij", v[:-1], rates))
            return v[-1] - np.diag(C) / targets**2

        def slopes(v: Array) -> Array:
            C = np.linalg.inv(self.time * np.einsum("k,kij->ij", v[:-1], rates))
            by_share = self.time * np.einsum("ia,kab,bi->ik", C, rates, C) / targets[:, None] ** 2
            return np.hstack((by_share, np.ones((p, 1))))

        even = np.full(len(rates), 1 / len(rates))
        last = np.zeros(len(rates) + 1)
        last[-1] = 1.0
        solution = minimize(
            lambda v: v[-1], np.append(even, -slack(np.append(even, 0.0)).min()), jac=lambda v: last, method="SLSQP",
            bounds=[(0.0, 1.0)] * len(rates) + [(0.0, None)], options={"maxiter": 300, "ftol": 1e-6},
            constraints=[{"type": "ineq", "fun": slack, "jac": slopes},
                         {"type": "eq", "fun": lambda v: v[:-1].sum() - 1, "jac": lambda v: 1 - last}],
        )  # fmt: skip
        if not solution.success:
            raise RuntimeError(f"no best mixture was found: {solution.message}")
        return self.mixture(phases, solution.x[:-1] / solution.x[:-1].sum())

    def mixture(self, phases: Sequence[Alone], shares: Array) -> Mixture:
        C = np.linalg.inv(self.time * sum(w * one.rate for w, one in zip(shares, phases)))
        return Mixture(list(phases), shares, np.sqrt(np.diag(C)))

    def composed(self, mixture: Mixture) -> Design:
        """The `TOGETHER` phases that have most of the time, one after the other, the lightest first."""
        most = sorted(np.argsort(-mixture.shares)[:TOGETHER], key=lambda k: mixture.phases[k].phase.compression)
        guess = {}
        for k in most:
            one = mixture.phases[k].phase
            guess[str(one)] = float(mixture.shares[k]), (one.x_time, one.x), (one.y_time, one.y), one.compression
        config = designed_motion.Config(duration=self.config.duration, design_rtol=self.config.rtol)
        half = {name: 0.5 * sd for name, sd in self.hand_made.items()}
        return designed_motion.search(self.truth, self.real, half, config, guess)

    def pair(self, phases: Sequence[Alone], targets: Array) -> Mixture:
        """The best two, by all pairs and some shares."""
        rates, best = np.array([one.rate for one in phases]), (np.inf, 0, 0, 0.5)
        for i in range(len(phases)):
            both = self.time * (SHARES[:, None, None, None] * rates[i] + (1 - SHARES)[:, None, None, None] * rates[:i])
            C = np.linalg.inv(both) if i else np.empty((len(SHARES), 0, *rates.shape[1:]))
            worst = np.sqrt(np.diagonal(C, axis1=-2, axis2=-1) / targets**2).max(-1)
            if worst.size and worst.min() < best[0]:
                s, j = np.unravel_index(int(worst.argmin()), worst.shape)
                best = float(worst.min()), i, int(j), float(SHARES[s])
        _, i, j, share = best
        return self.mixture([phases[i], phases[j]], np.array([share, 1 - share]))


class Result(NamedTuple):
    study: Study
    tried: int
    phases: list[Alone]
    mixtures: dict[str, Mixture]
    together: Design
    seconds: float

    def ratios(self, name: str) -> Array:
        """Deviations over those of the hand-made three."""
        return self.mixtures[name].deviations / np.array(list(self.study.hand_made.values()))


def run(config: Config) -> Result:
    if config.smoke:
        config = replace(config, count=8, rounds=1, per_round=4, seconds=0.3, rtol=1e-3, workers=1)
    study, rng = Study(config), np.random.default_rng(config.seed)
    targets = 0.5 * np.array(list(study.hand_made.values()))
    phases, tried = list[Alone](), 0

    def take(us: Array) -> None:
        """Run phases alone, and keep those that are of use."""
        work = side_by_side(lambda i: study.alone(us[i]), len(us), config.workers)
        found = dict(tqdm(work, desc="phases", total=len(us), disable=config.smoke))
        phases.extend(one for _, one in sorted(found.items()) if one is not None)

    def search() -> dict[str, Mixture]:
        nonlocal tried
        us = qmc.LatinHypercube(5, rng=rng).random(config.count)
        for _ in range(config.rounds + 1):
            take(us)
            tried += len(us)
            if len(phases) < 2:
                raise RuntimeError(f"of {tried} phases {len(phases)} can be used; two are needed")
            mixture = study.mixed(phases, targets)
            print(
                f"{tried} phases, {len(phases)} of use: the largest ratio is {0.5 * (mixture.deviations / targets).max():.3f}"
            )
            own = [phases[k].u for k in rng.choice(len(phases), config.per_round, p=mixture.shares)]
            us = np.abs(own + NEAR * rng.standard_normal((config.per_round, 5)))
            us = 1 - np.abs(1 - us)  # reflected at both ends
        return {"all phases": mixture, "two phases": study.pair(phases, targets)}

    mixtures, seconds = timed(search)
    return Result(study, tried, phases, mixtures, study.composed(mixtures["all phases"]), seconds)


def figure(result: Result) -> Figure:
    """What mixtures come to, and where their phases are."""
    fig = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = fig.subplots(1, 2)
    names = [name.split(".")[1] for name in result.study.truth]
    for k, name in enumerate(result.mixtures):
        left.bar(np.arange(len(names)) + 0.4 * k - 0.2, result.ratios(name), 0.38, label=name)
    left.axhline(0.5, color="k", lw=0.8, ls="--", label="half")
    left.set_xticks(range(len(names)), names)
    left.set(ylabel="deviation over that of the hand-made three")
    left.legend(fontsize=8)
    at = np.array([[1e3 * one.phase.compression, 1e3 * one.phase.x_time] for one in result.phases])
    right.plot(*at.T, ".", color="0.75", ms=4)
    for k, (name, mixture) in enumerate(result.mixtures.items()):
        own = np.array([[1e3 * one.phase.compression, 1e3 * one.phase.x_time] for one in mixture.phases])
        right.scatter(*own.T, s=400 * mixture.shares, facecolors="none", edgecolors=f"C{k}", label=name)
    right.set(xscale="log", xlabel="compression of both pads [mm]", ylabel="time along x [ms]")
    right.set_title("areas are shares of the time", fontsize=9)
    return fig


def main(config: Config) -> None:
    result = run(config)
    names = list(result.study.truth)
    ratios = {name: dict(zip(names, result.ratios(name).tolist())) for name in result.mixtures}
    ratios["put together"] = {name: result.together.after[name] / sd for name, sd in result.study.hand_made.items()}
    table = markdown(
        ("parameter", *ratios),
        [(name, *(f"{of[name]:.2f}" for of in ratios.values())) for name in names],
    )
    supports = {
        name: [
            (float(share), one.phase)
            for share, one in sorted(zip(mixture.shares, mixture.phases), key=lambda pair: -pair[0])
            if share > 0.02
        ]
        for name, mixture in result.mixtures.items()
    }
    sentences = [
        f"of {result.tried} phases {len(result.phases)} can be used; the largest ratio is "
        + ", ".join(f"{max(of.values()):.2f} with {name}" for name, of in ratios.items()),
        *result.together.notices,
        *(f"{name}: {share:.2f} of {phase}" for name, some in supports.items() for share, phase in some),
    ]
    print(table, *sentences, sep="\n")
    summary = raw_config(result.study.config) | {
        "tried": result.tried, "used": len(result.phases), "hand_made": result.study.hand_made, "ratios": ratios,
        "phases": {name: [{"share": share, **one._asdict()} for share, one in some] for name, some in supports.items()},
        "seconds": result.seconds, "sentences": sentences,
    }  # fmt: skip
    write(result.study.config.out, summary, {"motion_phases": figure(result)}, table)


if __name__ == "__main__":
    main(options(Config, __doc__))
