"""Generation of a dataset, or of one part. A second run on the same folder makes the missing
shards.

Each part has shards of its own.
"""

import math
import statistics
import sys
import time
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import qmc
from tqdm import tqdm

from torchsoft.cost import Cost, rig_row, rig_step, steps_per_second
from torchsoft.datasets.card import write_card
from torchsoft.datasets.config import Config
from torchsoft.datasets.files import MANIFEST, Manifest, read_bytes
from torchsoft.datasets.schema import energies, surfaces
from torchsoft.datasets.subject import Row, Subject, Task
from torchsoft.datasets.writer import Store, open_or_create
from torchsoft.parallel import executor, local_processes, single_threaded
from torchsoft.physics.rig import Rig
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import simulate
from torchsoft.solve.trajectory import Trajectory

# One trajectory: its parameters and motion from the configuration and its index alone, and its
# run or the reason of its failure.


COUNTS = ("steps", "newton_iterations")


def points(config: Config) -> NDArray[np.floating]:
    """The design in the unit cube, shape (trajectories, dimensions): a Sobol sequence, which is a
    prefix of every longer one of the same seed."""
    sobol = qmc.Sobol(config.subject.dimensions, rng=np.random.default_rng(config.seed))
    power = int(np.ceil(np.log2(config.trajectories)))
    return sobol.random_base2(power)[: config.trajectories]


def simulate_task(config: Config, task: Task) -> Row:
    """Every variable of the schema for one trajectory, without its first dimension.

    A simulation that fails has NaN (and no contact) for its series, and its reason.
    """
    subject = config.subject
    out = (
        {name: variable.empty for name, variable in config.subject.variables.items()}
        | task.labels
        | {"failed": 1}
    )
    t = torch.arange(config.samples, dtype=torch.float64) * config.sample_interval
    try:
        rig, y0 = subject.begin(task)
        run = simulate(rig, t, y0=y0, **subject.steps)
    except SimulationFailed as failure:
        done = (
            {name: getattr(failure.trajectory.stats, name) for name in COUNTS}
            if failure.trajectory
            else {}
        )
        return out | done | {"reason": failure.reason, "failure_time": failure.time}
    except (np.linalg.LinAlgError, RuntimeError, ValueError) as failure:
        return out | {"reason": f"{type(failure).__name__}: {failure}"}
    row = out | series(subject, rig, run) | {"failed": 0}
    bad = config.subject.not_finite(row)
    return out | {"reason": f"not finite: {', '.join(bad)}"} if bad else row


@torch.no_grad()
def series(subject: Subject, rig: Rig, run: Trajectory) -> Row:
    """The series and numbers of a finished run."""
    out: Row = {name: run[name].numpy() for name in subject.channels}
    for pad, touching in surfaces(subject.template).items() if subject.config.nodal else ():
        for name in touching:
            out[f"normal_force_{name}"] = run.force[name][..., 0].numpy()
            out[f"friction_force_{name}"] = run.force[name][..., 1].numpy()
            depth = rig.penetration(name, run.state)
            out[f"contact_{name}"] = (depth > 0).numpy().astype(np.uint8)
        out[f"displacement_{pad}"] = (rig.pads[pad].interpolation @ run.displacement[pad]).numpy()
    for kind, (_, parts) in energies(subject.template).items():
        known = run.energy if kind == "stored" else getattr(run, kind)
        out[f"{kind}_energy"] = np.stack([known[part].numpy() for part in parts], -1)
    out["injected_energy"], out["energy_residual"] = (
        run.injected.numpy(),
        run.energy_residual.numpy(),
    )
    out["energy_residual_rel"] = run.energy_residual_rel
    return out | {name: getattr(run.stats, name) for name in COUNTS}


# Shards, and the processes that make them


THREADS = 3
"""Most threads of one process: a third of a trajectory's time is interpreted code, which holds the
interpreter's lock."""

STATICS = 0.5
"""Time [s] of a trajectory without its steps: static equilibrium of the start and of the grasp, and
energies."""

MANY, TRIED = 200, 8
"""Number of trajectories from which some are timed for the estimate, and the number timed: a power
of two, so that a Sobol sequence has every kind among them in proportion."""

PATIENCE = 60.0
"""Longest time [s] that the timed trajectories may take."""

SURE = 2.0
"""Half width of the estimated range of times, in standard errors of the mean."""


class Part(NamedTuple):
    """Every `of`-th shard, from number - 1 on. Parts are disjoint."""

    number: int = 1
    of: int = 1

    def shards(self, config: Config) -> range:
        """Its shards. Raises `ValueError` for a part that has none."""
        if self.of > config.shards:
            raise ValueError(
                f"part {self.number} of {self.of} is empty, since trajectories come in shards of "
                f"{config.trajectories_per_shard}: make at most {config.shards} parts of the set, "
                "or smaller shards (trajectories_per_shard)"
            )
        return range(self.number - 1, config.shards, self.of)


WHOLE = Part()


def unfinished(config: Config, url: str, part: Part = WHOLE) -> list[int]:
    """Unfinished shards of a part, all of them where no dataset is begun."""
    begun = read_bytes(url, MANIFEST) is not None
    finished = Manifest.read(url).layout.whole(url) if begun else set[int]()
    return [shard for shard in part.shards(config) if shard not in finished]


def cost(config: Config, workers: int, each: Cost | None = None) -> Cost:
    """Cost of the whole set on `workers` workers, from the times of a trajectory, by default by
    experience."""
    subject, count = config.subject, config.trajectories
    at_once = max(min(workers, config.shards), 1)
    one = usual(config) if each is None else each
    arrays = subject.variables.values()
    kept = sum(v.kept.itemsize * math.prod(v.shape[1:]) for v in arrays) / 2**30  # [GiB]
    rows = 2 * kept * min(config.trajectories_per_shard, count)
    shard = rows + config.samples * rig_row(subject.template)
    design = 8 * 2 * count * subject.dimensions / 2**30
    return Cost(
        steps=count * one.steps,
        seconds=count * one.seconds / at_once,
        least=count * one.least / at_once,
        memory=design + shard * at_once,
        disk=kept * count,
    )


def usual(config: Config) -> Cost:
    """A trajectory by experience, on the high side."""
    subject = config.subject
    duration, step = config.duration, subject.steps.get("step")
    if step is not None:
        steps = duration / config.sample_interval * math.ceil(config.sample_interval / step)
    else:  # an output between two steps takes half the time of a step
        rtol = subject.steps.get("rtol") or 10 * subject.steps["atol"]
        steps = duration * steps_per_second(rtol) + 0.5 * config.samples
    seconds = steps * rig_step(subject.template) + STATICS
    return Cost(steps, seconds, 0.0, least=seconds)


def measured(config: Config) -> Cost:
    """A trajectory by the first ones of the set. One run before them loads the kernels; the times
    are of the processor, which other programs hardly change."""
    design, times, steps = points(config), list[float](), list[int]()
    with single_threaded():
        for i in (0, *range(TRIED)):
            began = time.thread_time()
            steps.append(simulate_task(config, config.subject.task(i, design[i]))["steps"])
            times.append(time.thread_time() - began)
    mean, error = statistics.mean(times[1:]), SURE * statistics.stdev(times[1:]) / TRIED**0.5
    return Cost(statistics.mean(steps[1:]), mean + error, 0.0, least=max(mean - error, 0.0))


def estimate(config: Config, url: str, workers: int, part: Part = WHOLE) -> Cost:
    """Cost of the unfinished shards of a part; a few trajectories are timed where there are
    many."""
    count = sum(len(config.rows(shard)) for shard in unfinished(config, url, part))
    tried = count >= MANY and (TRIED + 1) * usual(config).seconds < PATIENCE
    whole = cost(config, workers, measured(config) if tried else None)
    return whole.part(count / config.trajectories)


class Serial(Executor):
    """An executor that runs every call at once, in this process."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def run_shard(store: Store, shard: int, design: Any) -> tuple[int, int]:
    """Simulate and write one shard. Returns how many of its trajectories are finished and how many
    of those simulated here failed."""
    config = store.config
    if store.finished(shard):  # by another process, since it was submitted
        return len(config.rows(shard)), 0
    with single_threaded():
        tasks = zip(config.rows(shard), design, strict=True)
        rows = [simulate_task(config, config.subject.task(i, u)) for i, u in tasks]
        store.write(shard, rows)
    return len(rows), sum(int(row["failed"]) for row in rows)


def generate(
    config: Config, url: str, executor: Executor, workers: int = 1, progress: bool = True,
    part: Part = WHOLE,
) -> int:  # fmt: skip
    """Make every unfinished shard of a part at `url`, and the set's card once all are finished; the
    number of failed simulations among them.

    At most a few shards a worker are submitted at a time, so that Ctrl-C is heard and memory is
    bounded. Raises `StoreError`, and `ValueError` for a part that has no shard.
    """
    mine = part.shards(config)
    store, design = open_or_create(url, config), points(config)
    left, failed = [shard for shard in store.unfinished() if shard in mine][::-1], 0
    running = set[Future[tuple[int, int]]]()
    of = lambda shards: sum(len(config.rows(shard)) for shard in shards)
    with tqdm(
        total=of(mine), initial=of(mine) - of(left), unit=" trajectories", disable=not progress,
        smoothing=0.05, mininterval=0.1 if sys.stderr.isatty() else 30.0,  # [s]
    ) as bar:  # fmt: skip
        try:
            while left or running:
                while left and len(running) < 3 * max(workers, 1):
                    here = config.rows(shard := left.pop())
                    some = design[here.start : here.stop]
                    running.add(executor.submit(run_shard, store, shard, some))
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    finished, bad = future.result()
                    failed += bad
                    bar.set_postfix_str(f"{failed} failed", refresh=False)
                    bar.update(finished)
        finally:
            for future in running:
                future.cancel()
    if not store.unfinished():
        write_card(url)
    return failed


def local_workers(workers: int) -> AbstractContextManager[Executor]:
    """An executor: threads of this process up to `THREADS` workers, processes above, and plain
    calls for 0."""
    if workers > THREADS:
        return local_processes(workers)
    return executor(workers) if workers else Serial()
