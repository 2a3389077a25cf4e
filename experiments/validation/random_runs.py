"""Question: does every run end, and say why, wherever the parameters lie?

Random rigs and short motions (about 0.3 s), each run by tolerances and by equal steps. Parameters
are drawn where a rig exists, far inside the bounds that the parts' quantities declare: stiffnesses,
dashpots, times, masses and gains by a factor of 10 up and down from their defaults (log-uniform, as
is the touch-down depth, and a factor of 3 for the pad's depth), mu_s from 0.05 to 2 with mu_k at 30
to 100 % of it, nu from 0 to 0.495, heights at 70 to 150 %, three meshes, both friction laws,
contact points on nodes or two an element, whose x the loop senses. Motions are rolls, strokes,
sines, chirps and presses after a grasp of 0.2 to 2 mm within 0.1 s, and the beginning of the grasp
and roll. A draw that gives no start (a disc so heavy that it sinks in deeper than the grasp, a bad
geometry) is counted and drawn again. Gains and masses so drawn make many loops unstable: their runs
end with the disc lost, which is an answer.

Every run should be finite to its end or raise `SimulationFailed`, `NoEquilibrium` or `ValueError`
with one sentence. A run that takes more than `limit` of the processor's time counts as hung, and
its process is ended.

Command: .venv/bin/python experiments/validation/random_runs.py [--smoke]
Expected: no run hangs, none ends without a sentence or with numbers that are not finite. About
twenty minutes on two cores.
"""

import math
import os
import threading
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from statistics import median
from time import monotonic, process_time, sleep
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from torchsoft import NoEquilibrium, Parameters, SimulationFailed, SoftGrasp, simulate
from torchsoft.excitation import (
    Chirp,
    Excitation,
    MultiSine,
    Press,
    Roll,
    Strokes,
    begin,
)
from torchsoft.experiment import grid, markdown, options, write
from torchsoft.paper.equilibrium import holding_force, press, rest
from torchsoft.physics.motion import FADE
from torchsoft.physics.statics import BuiltRig
from torchsoft.processes import local_processes
from torchsoft.scenario import reference
from torchsoft.threads import parallel_map

SCALED = (
    "pad.E", "pad.tau", "contact.K_n", "contact.R_n", "contact.K_t", "contact.R_t", "contact.eta",
    "contact.v_s", "contact.epsilon", "disc.mass", "bracket.mass", "control.K_81", "control.R_80",
    "control.K_98", "control.R_99",
)  # fmt: skip
"""Drawn log-uniformly by a factor of 10 about their defaults."""

GRASP, SETTLE, MOVING = 0.1, 0.02, 0.18
"""Times [s] of the grasp, of the pause and of the motion after it; waves take what their fading
needs more."""


def settings(rng: np.random.Generator) -> Parameters:
    """Random parameters; raises `ValueError` for a rig that does not exist."""
    defaults, changes = Parameters().table(), dict[str, Any]()
    for name in SCALED:
        changes[name] = defaults[name]["value"] * 10.0 ** rng.uniform(-1, 1)
    changes["contact.mu_s"] = math.exp(rng.uniform(math.log(0.05), math.log(2.0)))
    changes["contact.mu_k"] = changes["contact.mu_s"] * rng.uniform(0.3, 1.0)
    changes["pad.nu"] = rng.uniform(0.0, 0.495)
    changes["pad.depth"] = defaults["pad.depth"]["value"] * 3.0 ** rng.uniform(-1, 1)
    changes["pad.height"] = defaults["pad.height"]["value"] * rng.uniform(0.7, 1.5)
    wide = (
        2 * changes["pad.height"]
        + 2 * defaults["disc.radius"]["value"]
        + defaults["bracket.cm_height"]["value"]
    )
    changes["scenario.y_Br_grasp"] = wide - 1e-3  # every excitation has its own
    changes["pad.elements_x"], changes["pad.elements_y"] = [(40, 2), (60, 2), (120, 4)][
        rng.integers(3)
    ]
    changes["contact.friction"] = rng.choice(["smooth", "coulomb"], p=[0.75, 0.25]).item()
    changes["contact.points"] = int(rng.choice([0, 2], p=[0.75, 0.25]))
    return Parameters().override(changes)


def excitation(rng: np.random.Generator) -> Excitation:
    """A random motion after a random grasp."""
    low, high = sorted(np.exp(rng.uniform(math.log(1.0), math.log(40.0), 2)))
    x, y = np.exp(rng.uniform(np.log([2e-4, 2e-5]), np.log([1e-2, 3e-4])))
    waves = MOVING + FADE
    motion, moving = [
        (Roll(travel=x), MOVING),
        (
            Strokes(
                travel=2 * x, stroke_time=math.exp(rng.uniform(math.log(0.02), math.log(0.18)))
            ),
            MOVING,
        ),
        (
            MultiSine(
                amplitude_x=x, amplitude_y=y, frequency=(low, high), seed=int(rng.integers(1000))
            ),
            waves,
        ),
        (Chirp(amplitude_x=x, amplitude_y=y, start=low, end=high), waves),
        (Press(amplitude=y, frequency=high, travel=x), waves),
    ][rng.integers(5)]
    return Excitation(
        motion=motion, duration=GRASP + SETTLE + moving, grasp_time=GRASP, settle=SETTLE,
        depth=math.exp(rng.uniform(math.log(2e-4), math.log(2e-3))),
        senses=rng.choice(["bracket", "disc"]).item(),
    )  # fmt: skip


class Drawn(NamedTuple):
    """A model, its start and its output times, and what it does."""

    begun: BuiltRig[SoftGrasp]
    motion: str


def draw(rng: np.random.Generator) -> Drawn:
    """A random run; raises `ValueError` or `NoEquilibrium` if it has no start."""
    wanted, p = excitation(rng), settings(rng)
    if rng.random() < 0.8:
        return Drawn(begin(wanted, p), wanted.motion.kind)
    own = {"scenario.grasp_time": GRASP, "scenario.roll_time": 0.5, "scenario.travel": -2e-3}
    model = SoftGrasp(p.override(own))
    force = holding_force(model, press(model, model.settings.scenario.y_Br_grasp))
    y0 = rest(model).detach()
    model.reference = reference(model, y0, force)
    return Drawn(BuiltRig(model, y0, grid(GRASP + SETTLE + MOVING)), "grasp_and_roll")


REASONS = {
    "disc was lost": "the disc was lost: unstable loop",
    "reached the end of a pad": "the body was lost: end of a pad",
    "left the space over a pad": "the body was lost: left the pad",
    "Newton's iteration": "Newton did not converge",
    "tolerances would need": "steps below the shortest",
    "not finite any more": "the state was not finite",
    "no static equilibrium": "statics did not converge",
    "too high for its pad": "the disc sinks in deeper than the grasp",
}
"""What the sentence of a failure contains, and the kind it counts as."""

DRAWS = 50
"""How often a run is drawn until there is one that can begin."""

STILL = 3600.0  # Wall time [s] after which a run has hung even if it takes no processor time.

FINISHED, NOT_FINITE, HUNG = (
    "finished",
    "finished with numbers that are not finite",
    "hung: its process was ended",
)


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/random_runs")
    runs: int = 10_000
    rtol: float = 1e-3  # relative tolerance; a tenth of it is the absolute one
    step: float = 2e-3  # of the equal steps [s]
    limit: float = 60.0  # processor time [s] after which a run, by both ways, counts as hung
    workers: int = 2  # processes
    seed: int = 0
    minutes: float = 60.0  # wall time after which no run is begun any more
    first: int = 0  # number of the first run, to do one again
    smoke: bool = False  # a size that takes seconds


@dataclass(frozen=True)
class Outcome:
    """How a run ended: its kind, the sentence if it failed, its wall time [s], the processor's time
    [s], steps and those refused."""

    kind: str
    sentence: str = ""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    steps: int = 0
    refused: int = 0


@dataclass(frozen=True)
class Result:
    config: Config
    outcomes: dict[str, dict[int, Outcome]]  # by way and number of the run
    refusals: list[tuple[int, Outcome]]  # draws without a start, by number of the run
    motions: dict[int, str]
    seconds: float  # wall time of all


def sentence(error: Exception) -> str:
    """What a run says when it ends early; raises what is not meant to be said to a user, or in more
    than one line."""
    text = str(error)
    if (
        not isinstance(error, SimulationFailed | NoEquilibrium | ValueError)
        or not text
        or "\n" in text
    ):
        raise error
    return text


def kind(error: Exception) -> str:
    """What a failure counts as."""
    known = next((kind for part, kind in REASONS.items() if part in str(error)), "other")
    return "refused with a ValueError" if isinstance(error, ValueError) else known


def prepare(number: int, seed: int) -> tuple[Drawn, list[Outcome]]:
    """Run `number`, and how the draws before it were refused. Raises `RuntimeError` if none of many
    has a start."""
    rng, refusals = np.random.default_rng((seed, number)), list[Outcome]()
    for _ in range(DRAWS):
        try:
            return draw(rng), refusals
        except (NoEquilibrium, ValueError) as error:
            refusals.append(Outcome(kind(error), sentence(error)))
    raise RuntimeError(f"none of {DRAWS} draws has a start")


def outcome(drawn: Drawn, steps: dict[str, Any]) -> Outcome:
    """One run by one way."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        began, ticked = monotonic(), process_time()
        try:
            run, end, said = (
                simulate(drawn.begun.rig, drawn.begun.t, y0=drawn.begun.y0, **steps),
                FINISHED,
                "",
            )
        except (SimulationFailed, ValueError) as error:
            run, end, said = getattr(error, "trajectory", None), kind(error), sentence(error)
        wall, cpu = monotonic() - began, process_time() - ticked
    if run is None:
        return Outcome(end, said, wall_s=wall, cpu_s=cpu)
    if end == FINISHED and not (
        run.y.isfinite().all() and all(x.isfinite().all() for x in run.channels.values())
    ):
        end = NOT_FINITE
    return Outcome(end, said, wall, cpu, run.stats.steps, run.stats.refused_steps)


Ends = tuple[str, dict[str, Outcome], list[Outcome]]
"""What a run does, its outcomes by way, and the draws before it that had no start."""

WAYS: tuple[str, ...] = ("tolerances", "equal steps")


CLOCKS = [0.0, 0.0]
"""Of a worker process: its processor time and the wall time when its run began."""


def both(number: int, config: Config) -> Ends:
    """Run `number` by both ways."""
    CLOCKS[:] = process_time(), monotonic()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        drawn, refusals = prepare(number, config.seed)
    steps = ({"rtol": config.rtol}, {"step": config.step})
    return drawn.motion, {way: outcome(drawn, how) for way, how in zip(WAYS, steps)}, refusals


def watched(limit: float) -> None:
    """Begin a worker process that ends itself when its run takes too long; kernels do not keep that
    thread waiting."""
    CLOCKS[:] = process_time(), monotonic()

    def watch() -> None:
        while process_time() - CLOCKS[0] < limit and monotonic() - CLOCKS[1] < STILL:
            sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def outcomes(config: Config) -> Iterator[tuple[int, Ends]]:
    """All runs in the order of their ends, every thread with a process of its own. One whose run
    has hung is replaced."""
    last, pools = monotonic() + 60 * config.minutes, SimpleQueue[ProcessPoolExecutor]()
    with ExitStack() as stack:

        def attempt(k: int) -> Ends | None:
            if (began := monotonic()) > last:
                return None
            try:
                pool = pools.get_nowait()
            except Empty:
                pool = stack.enter_context(local_processes(1, watched, config.limit))
            try:
                ends = pool.submit(both, config.first + k, config).result()
            except BrokenProcessPool:
                end = HUNG if monotonic() - began >= config.limit else "its process died"
                return "unknown", dict.fromkeys(WAYS, Outcome(end)), []
            except Exception as error:
                unsaid = Outcome(
                    f"error without a sentence: {type(error).__name__}", str(error)[:200]
                )
                ends = "unknown", dict.fromkeys(WAYS, unsaid), []
            pools.put(pool)
            return ends

        for k, ends in parallel_map(attempt, config.runs, config.workers):
            if ends is not None:
                yield config.first + k, ends


def run(config: Config) -> Result:
    if config.smoke:
        config = replace(config, runs=12)
    result, began = Result(config, {way: {} for way in WAYS}, [], {}, 0.0), monotonic()
    for number, (motion, ends, refusals) in tqdm(outcomes(config), total=config.runs, unit="run"):
        result.motions[number] = motion
        result.refusals.extend((number, one) for one in refusals)
        for way, one in ends.items():
            result.outcomes[way][number] = one
    return replace(result, seconds=monotonic() - began)


def summary(result: Result) -> dict[str, Any]:
    """Counts by kind, the longest runs, and one example of every kind."""

    def counted(ends: list[tuple[int, Outcome]]) -> dict[str, Any]:
        examples = {
            one.kind: {"run": n, "sentence": one.sentence}
            for n, one in sorted(ends, key=lambda end: -end[0])
        }
        return {
            "kinds": dict(Counter(one.kind for _, one in ends).most_common()),
            "examples": examples,
        }

    out: dict[str, Any] = {
        "runs": len(result.motions), "seconds": result.seconds,
        "motions": Counter(result.motions.values()),
        "draws without a start": counted(result.refusals),
    }  # fmt: skip
    for way, ends in result.outcomes.items():
        slowest = sorted(ends, key=lambda n: -ends[n].cpu_s)[:10]
        every, done = list(ends.values()), [one for one in ends.values() if one.kind == FINISHED]
        out[way] = counted(list(ends.items())) | {
            "median_cpu_s": median(one.cpu_s for one in done) if done else None,
            "longest_wall_s": max((one.wall_s for one in every), default=0.0),
            "longest_cpu_s": max((one.cpu_s for one in every), default=0.0),
            "most_steps": max((one.steps + one.refused for one in every), default=0),
            "slowest": {str(n): asdict(ends[n]) for n in slowest},
        }  # fmt: skip
    return out


def table(numbers: dict[str, Any]) -> str:
    """Counts of every kind of end, by equal steps and by tolerances."""
    ways = ("equal steps", "tolerances")
    kinds = dict.fromkeys(kind for way in ways for kind in numbers[way]["kinds"])
    rows: list[tuple[object, ...]] = [
        (kind, *(numbers[way]["kinds"].get(kind, 0) for way in ways)) for kind in kinds
    ]
    measured = {
        "median processor time of those finished [s]": "median_cpu_s",
        "longest processor time [s]": "longest_cpu_s",
        "longest wall time [s]": "longest_wall_s",
        "most steps, refused ones included": "most_steps",
    }
    rows += [
        (title, *(f"{numbers[way][key] or 0:.3g}" for way in ways))
        for title, key in measured.items()
    ]
    return markdown((f"of {numbers['runs']} runs", *ways), rows)


def main() -> None:
    result = run(options(Config, __doc__))
    numbers = summary(result)
    write(result.config, numbers, table=table(numbers))


if __name__ == "__main__":
    main()
