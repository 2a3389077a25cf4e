"""Make a dataset: `python -m torchsoft.datasets.generate CONFIG.toml --out DIR [--workers N]
[--scheduler tcp://...]`.

Started again on the same folder it makes what is missing. Ctrl-C and kill are safe at any moment.
"""

import argparse
import math
import os
import sys
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchsoft import threads
from torchsoft.cost import RUN, Cost, agree, rig_row, rig_step, steps_per_second
from torchsoft.datasets.config import Config
from torchsoft.datasets.files import StoreError
from torchsoft.datasets.schema import variables
from torchsoft.datasets.simulation import points, simulate_task, task
from torchsoft.datasets.writer import Store, open_or_create
from torchsoft.processes import local_processes
from torchsoft.tables import line

CLUSTER = 16
"""Workers that a cluster is taken to have."""

MOST = 1000
"""Local workers."""

THREADS = 3
"""Threads of one process at the most: a third of a trajectory's time is not compiled, and holds the
interpreter's lock."""

COARSE = 5e-3
"""Steps longer than this [s] get a note."""

HELP = "take fewer trajectories, a looser rtol or a shorter duration"


def cost(config: Config, workers: int) -> Cost:
    """Of the whole dataset, made by that many workers."""
    subject, at_once = config.subject, max(min(workers, config.shards), 1)
    seconds, step = config.duration + subject.prelude, subject.steps.get("step")
    if step is not None:
        steps = seconds / config.sample_interval * math.ceil(config.sample_interval / step)
    else:  # an output between two steps takes half the time of a step
        rtol = subject.steps.get("rtol") or 10 * subject.steps["atol"]
        steps = seconds * steps_per_second(rtol) + 0.5 * config.samples
    kept = sum(  # of one trajectory [GiB]
        v.kept.itemsize * math.prod(v.shape[1:]) / 2**30 for v in variables(config).values()
    )
    shard = 2 * kept * min(
        config.trajectories_per_shard, config.trajectories
    ) + config.samples * rig_row(subject.template)
    design = 8 * 2 * config.trajectories * subject.drawn / 2**30
    return Cost(
        steps=config.trajectories * steps,
        seconds=config.trajectories * (steps * rig_step(subject.template) + RUN) / at_once,
        memory=design + shard * at_once,
        disk=kept * config.trajectories,
    )


class Serial(Executor):
    """Runs every call at once, in this process."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def run_shard(store: Store, shard: int, design: Any) -> tuple[int, int]:
    """Simulate and write one shard; how many trajectories it holds and how many of them failed."""
    config = store.config
    with threads.single_threaded():
        rows = [
            simulate_task(config, task(config, i, u))
            for i, u in zip(config.rows(shard), design, strict=True)
        ]
    store.write(shard, rows)
    return len(rows), sum(int(row["failed"]) for row in rows)


def generate(
    config: Config, url: str, executor: Executor, workers: int = 1, progress: bool = True
) -> int:
    """Make every unfinished shard at `url`; the number of failed simulations among them.

    At most a few shards a worker are submitted at a time, so that Ctrl-C is heard and memory is
    bounded. Raises `StoreError`.
    """
    store, design = open_or_create(url, config), points(config)
    left, failed, running = store.unfinished()[::-1], 0, set[Future[tuple[int, int]]]()
    finished = config.trajectories - sum(len(config.rows(shard)) for shard in left)
    what: Any = {
        "unit": " simulated s",
        "unit_scale": config.duration,
        "disable": not progress,
        "smoothing": 0.05,
    }
    with tqdm(total=config.trajectories, initial=finished, **what) as bar:
        try:
            while left or running:
                while left and len(running) < 3 * max(workers, 1):
                    here = config.rows(shard := left.pop())
                    running.add(
                        executor.submit(run_shard, store, shard, design[here.start : here.stop])
                    )
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for count, bad in (future.result() for future in done):
                    failed += bad
                    bar.set_postfix_str(f"{failed} failed", refresh=False)
                    bar.update(count)
        finally:
            for future in running:
                future.cancel()
    return failed


def local_workers(workers: int) -> AbstractContextManager[Executor]:
    """So many threads of this process, which begin at once; processes where there are too many for
    one; with 0 neither."""
    if workers > THREADS:
        return local_processes(workers)
    return threads.executor(workers) if workers else Serial()


@contextmanager
def dask_cluster(address: str) -> Iterator[Executor]:
    """An existing Dask cluster behind the same interface; shards of a lost worker are made by the
    others."""
    try:
        from distributed import Client
    except ImportError:
        raise StoreError("--scheduler needs Dask: pip install 'torchsoft[scale]'") from None
    with Client(address) as client:
        yield client.get_executor(retries=3, pure=False)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m torchsoft.datasets.generate", description=__doc__
    )
    parser.add_argument("config", type=Path, help="TOML file, see data_gen/configs")
    parser.add_argument("--out", required=True, help="folder or fsspec URL of the store")
    workers = "threads, or processes if more than a few"
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help=workers)
    parser.add_argument("--scheduler", help="address of a Dask scheduler, such as tcp://host:8786")
    parser.add_argument(
        "--yes", action="store_true", help="begin even what takes hours, or much memory or disk"
    )
    given = parser.parse_args(arguments)
    if not 0 <= given.workers <= MOST:
        parser.error(f"argument --workers: should be from 0 to {MOST}, not {given.workers}")
    workers = CLUSTER if given.scheduler else given.workers
    try:
        config = Config.from_toml(given.config)
        agree(cost(config, workers), given.yes, HELP)
        if config.step is not None and config.step > COARSE:
            note = (
                f"note: step = {config.step:g} s is coarse: the energy balance may be off by "
                "percents"
            )
            print(note, file=sys.stderr)
        with (
            dask_cluster(given.scheduler) if given.scheduler else local_workers(workers) as executor
        ):
            failed = generate(config, given.out, executor, workers)
    except (ValueError, StoreError, OSError) as error:
        said = (
            f"{error.filename}: {error.strerror}"
            if isinstance(error, OSError) and error.filename
            else error
        )
        print(f"error: {line(said, 2000)}", file=sys.stderr)
        return 2
    except BrokenProcessPool:
        print(
            "error: a worker was killed, perhaps for memory; start again to make what is missing",
            file=sys.stderr,
        )
        return 3
    except KeyboardInterrupt:
        print(
            "interrupted: finished shards are kept; start again to make what is missing",
            file=sys.stderr,
        )
        return 130
    print(
        f"{config.trajectories} trajectories in {given.out}; {failed} of those made now failed, "
        "each with its reason"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
