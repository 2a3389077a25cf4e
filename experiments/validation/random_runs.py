"""Question: does every run end, and say why, wherever the parameters lie?

Random rigs and short motions (about 0.3 s), each run by tolerances and by equal steps. Parameters are drawn where a rig
exists, far inside the bounds that the parts' quantities declare: stiffnesses, dashpots, times, masses and gains by a
factor of 10 up and down from their defaults (log-uniform, as is the touch-down depth, and a factor of 3 for the pad's
depth), mu_s from 0.05 to 2 with mu_k at 30 to 100 % of it, nu from 0 to 0.495, heights at 70 to 150 %, three meshes,
both friction laws, contact points on nodes or two an element, whose x the loop senses. Motions are rolls, strokes,
sines, chirps and presses after a grasp of 0.2 to 2 mm within 0.1 s, and the beginning of the grasp and roll. A draw
that gives no start (a disc so heavy that it sinks in deeper than the grasp, a bad geometry) is counted and drawn again.
Gains and masses so drawn make many loops unstable: their runs end with the disc lost, which is an answer.

Every run should be finite to its end or raise `SimulationFailed`, `NoEquilibrium` or `ValueError` with one sentence. A run
that takes more than `limit` of the processor's time counts as hung, and its process is ended.

Command: .venv/bin/python experiments/validation/random_runs.py [--smoke]
Expected: no run hangs, none ends without a sentence or with numbers that are not finite. About twenty minutes on two cores.
"""

import multiprocessing
import os
import threading
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from signal import SIGKILL
from statistics import median
from time import monotonic, process_time, sleep
from typing import Any

import numpy as np
from _random_rigs import Drawn, draw
from matplotlib.figure import Figure
from tqdm import tqdm

from torchsoft import NoEquilibrium, SimulationFailed, simulate
from torchsoft.experiment import made_by, markdown, options, write
from torchsoft.processes import THREADS, prepare_worker

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

STILL, HUNG_STATUS = 3600.0, 75
"""Wall time [s] after which a run has hung even if it takes no processor time; exit status of a process that ends itself."""

FINISHED, NOT_FINITE, HUNG = "finished", "finished with numbers that are not finite", "hung: its process was ended"


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
    """How a run ended: its kind, the sentence if it failed, the simulated time it reached [s], its wall time [s], the
    processor's time [s], the wall time of its steps [s], and counters."""

    kind: str
    sentence: str = ""
    reached: float = 0.0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    stepping_s: float = 0.0
    steps: int = 0
    refused: int = 0
    failed: int = 0
    doubts: int = 0


@dataclass(frozen=True)
class Result:
    config: Config
    outcomes: dict[str, dict[int, Outcome]]  # by way and number of the run
    refusals: list[tuple[int, Outcome]]  # draws without a start, by number of the run
    motions: dict[int, str]
    seconds: float  # wall time of all


def sentence(error: Exception) -> str:
    """What a run says when it ends early; raises what is not meant to be said to a user, or in more than one line."""
    text = str(error)
    if not isinstance(error, SimulationFailed | NoEquilibrium | ValueError) or not text or "\n" in text:
        raise error
    return text


def kind(error: Exception) -> str:
    """What a failure counts as."""
    known = next((kind for part, kind in REASONS.items() if part in str(error)), "other")
    return "refused with a ValueError" if isinstance(error, ValueError) else known


def prepare(number: int, seed: int) -> tuple[Drawn, list[Outcome]]:
    """Run `number`, and how the draws before it were refused. Raises `RuntimeError` if none of many has a start."""
    rng, refusals = np.random.default_rng((seed, number)), list[Outcome]()
    for _ in range(DRAWS):
        try:
            return draw(rng), refusals
        except (NoEquilibrium, ValueError) as error:
            refusals.append(Outcome(kind(error), sentence(error)))
    raise RuntimeError(f"none of {DRAWS} draws has a start")


def outcome(drawn: Drawn, steps: dict[str, Any]) -> Outcome:
    """One run by one way."""
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        began, ticked = monotonic(), process_time()
        try:
            run, end, said = simulate(drawn.begun.model, drawn.t, y0=drawn.begun.y0, **steps), FINISHED, ""
        except (SimulationFailed, ValueError) as error:
            run, end, said = getattr(error, "trajectory", None), kind(error), sentence(error)
        wall, cpu = monotonic() - began, process_time() - ticked
    if run is None:
        return Outcome(end, said, wall_s=wall, cpu_s=cpu)
    if end == FINISHED and not (run.y.isfinite().all() and all(x.isfinite().all() for x in run.channels.values())):
        end = NOT_FINITE
    s = run.stats
    return Outcome(
        end, said, float(run.t[-1]), wall, cpu, s.wall_s, s.steps, s.refused_steps, s.failed_steps, len(doubts)
    )


Ends = tuple[str, dict[str, Outcome], list[Outcome]]
"""What a run does, its outcomes by way, and the draws before it that had no start."""

WAYS = ("tolerances", "equal steps")


def both(number: int, config: Config) -> Ends:
    """Run `number` by both ways."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        drawn, refusals = prepare(number, config.seed)
    steps = ({"rtol": config.rtol}, {"step": config.step})
    return drawn.motion, {way: outcome(drawn, how) for way, how in zip(WAYS, steps)}, refusals


def watch(began: list[float], limit: float) -> None:
    """End the process when its run has taken too much of the processor's time; kernels do not keep this thread waiting."""
    while process_time() - began[0] < limit:
        sleep(0.5)
    os._exit(HUNG_STATUS)


def work(connection: Connection, config: Config) -> None:
    """A worker process: numbers of runs in, outcomes out."""
    prepare_worker()
    began = [process_time()]
    threading.Thread(target=watch, args=(began, config.limit), daemon=True).start()
    while True:
        number = connection.recv()
        began[0] = process_time()
        try:
            connection.send(both(number, config))
        except Exception as error:
            unsaid = Outcome(f"error without a sentence: {type(error).__name__}", str(error)[:200])
            connection.send(("unknown", dict.fromkeys(WAYS, unsaid), []))


class Worker:
    """A process that does one run after the other, and the run that it is at."""

    def __init__(self, config: Config) -> None:
        self.connection, other = multiprocessing.get_context("spawn").Pipe()
        self.process = multiprocessing.get_context("spawn").Process(target=work, args=(other, config), daemon=True)
        self.process.start()
        other.close()
        self.number, self.began = -1, monotonic()

    def give(self, number: int) -> None:
        self.number, self.began = number, monotonic()
        self.connection.send(number)

    @property
    def late(self) -> bool:
        """Whether its run neither ends nor takes the processor's time."""
        return monotonic() - self.began > STILL

    def end(self) -> int | None:
        """End the process, if it has not; its exit status."""
        self.process.join(1.0)
        self.process.kill()
        self.process.join()
        return self.process.exitcode


def outcomes(config: Config) -> Iterator[tuple[int, Ends]]:
    """All runs in the order of their ends. A worker whose run has hung is replaced."""
    for name in THREADS:
        os.environ[name] = "1"
    todo, began = iter(range(config.first, config.first + config.runs)), monotonic()
    workers = [Worker(config) for _ in range(config.workers)]
    for worker, number in zip(workers, todo):
        worker.give(number)
    while busy := [worker for worker in workers if worker.number >= 0]:
        ready = wait([worker.connection for worker in busy], 1.0)
        for at, worker in enumerate(workers):
            if worker.number < 0 or not (worker.connection in ready or worker.late):
                continue
            number, again = worker.number, worker
            try:
                if worker.connection not in ready:
                    raise EOFError
                ends: Ends = worker.connection.recv()
            except (EOFError, ConnectionError):
                hung = worker.end() in (HUNG_STATUS, -SIGKILL)
                ends = "unknown", dict.fromkeys(WAYS, Outcome(HUNG if hung else "its process died")), []
                again = workers[at] = Worker(config)
            yield number, ends
            following = next(todo, -1) if monotonic() - began < 60 * config.minutes else -1
            if following >= 0:
                again.give(following)
            else:
                again.number = -1
    for worker in workers:
        worker.end()


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
    out: dict[str, Any] = {
        "runs": len(result.motions),
        "seconds": result.seconds,
        "motions": Counter(result.motions.values()),
    }
    for way, ends in result.outcomes.items():
        slowest = sorted(ends, key=lambda n: -ends[n].cpu_s)[:10]
        done = [one for one in ends.values() if one.kind == FINISHED]
        out[way] = {
            "kinds": dict(Counter(one.kind for one in ends.values()).most_common()),
            "median_cpu_s": median(one.cpu_s for one in done) if done else None,
            "longest_wall_s": max((one.wall_s for one in ends.values()), default=0.0),
            "longest_cpu_s": max((one.cpu_s for one in ends.values()), default=0.0),
            "longest_stepping_s": max((one.stepping_s for one in ends.values()), default=0.0),
            "most_steps": max((one.steps + one.refused for one in ends.values()), default=0),
            "with_doubts": sum(one.doubts > 0 for one in done),
            "slowest": {str(n): asdict(ends[n]) for n in slowest},
            "examples": {
                one.kind: {"run": n, "sentence": one.sentence} for n, one in sorted(ends.items(), reverse=True)
            },
        }
    out["draws without a start"] = {
        "kinds": dict(Counter(one.kind for _, one in result.refusals).most_common()),
        "examples": {one.kind: {"run": n, "sentence": one.sentence} for n, one in reversed(result.refusals)},
    }
    tolerances, equal = (result.outcomes[way] for way in WAYS)
    out["kinds"] = {str(n): [ends[n].kind for ends in (tolerances, equal)] for n in sorted(result.motions)}
    pairs = Counter((equal[n].kind == FINISHED, tolerances[n].kind == FINISHED) for n in equal if n in tolerances)
    out["finished"] = {
        "by both": pairs[True, True], "by tolerances alone": pairs[False, True],
        "by equal steps alone": pairs[True, False], "by neither": pairs[False, False],
    }  # fmt: skip
    return out


def table(numbers: dict[str, Any]) -> str:
    """Counts of every kind of end, by equal steps and by tolerances."""
    ways = ("equal steps", "tolerances")
    kinds = dict.fromkeys(kind for way in ways for kind in numbers[way]["kinds"])
    rows: list[tuple[object, ...]] = [(kind, *(numbers[way]["kinds"].get(kind, 0) for way in ways)) for kind in kinds]
    measured = {
        "median processor time of those finished [s]": "median_cpu_s",
        "longest processor time [s]": "longest_cpu_s",
        "longest wall time [s]": "longest_wall_s",
        "longest wall time in steps [s]": "longest_stepping_s",
        "most steps, refused ones included": "most_steps",
    }
    rows += [(title, *(f"{numbers[way][key] or 0:.3g}" for way in ways)) for title, key in measured.items()]
    return markdown((f"of {numbers['runs']} runs", *ways), rows)


def figure(result: Result) -> Figure:
    """How runs ended, and how long they took."""
    fig = Figure(figsize=(12, 4), layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=(1.3, 1))
    colours = {"tolerances": "#0072b2", "equal steps": "#e69f00"}
    kinds = list(dict.fromkeys(one.kind for ends in result.outcomes.values() for one in ends.values()))
    kinds.sort(key=lambda kind: -sum(one.kind == kind for one in result.outcomes["tolerances"].values()))
    for shift, (way, ends) in zip((-0.2, 0.2), result.outcomes.items()):
        counts = Counter(one.kind for one in ends.values())
        at = np.arange(len(kinds)) + shift
        bars = left.barh(at, [max(counts[k], 0.5) for k in kinds], 0.4, color=colours[way], label=f"by {way}", log=True)
        left.bar_label(bars, [str(counts[k]) for k in kinds], padding=3, fontsize=8)
        walls = np.array([one.cpu_s for one in ends.values() if one.cpu_s > 0])
        if len(walls):
            bins = np.geomspace(walls.min(), walls.max() * 1.01, 40)
            right.hist(walls, bins.tolist(), histtype="step", color=colours[way], label=f"by {way}", log=True)
    left.set_yticks(np.arange(len(kinds)), kinds)
    left.invert_yaxis()
    left.margins(x=0.1)
    left.set(xlabel="runs", title=f"How {len(result.motions)} random runs ended")
    right.set(xscale="log", xlabel="processor time of a run [s]", ylabel="runs", title="How long they took")
    right.legend()
    left.legend()
    return fig


def main() -> None:
    result = run(options(Config, __doc__))
    numbers = summary(result)
    print(table(numbers))
    write(
        result.config.out,
        numbers | {"made_by": made_by(result.config)},
        {"random_runs": figure(result)},
        table(numbers),
    )


if __name__ == "__main__":
    main()
