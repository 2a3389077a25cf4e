"""Make a dataset: `python -m data_gen.generate CONFIG.toml --out DIR [--workers N] [--scheduler tcp://...]`.

Started again on the same folder it makes what is missing. Ctrl-C and kill are safe at any moment.
"""

import argparse
import os
import sys
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

from tqdm import tqdm

from torchsoft import threads
from torchsoft.cost import agree
from torchsoft.datasets.config import Config
from torchsoft.datasets.cost import cost
from torchsoft.datasets.design import points, task
from torchsoft.datasets.simulation import simulate_task
from torchsoft.datasets.storage import StoreError
from torchsoft.datasets.store import Store, open_or_create
from torchsoft.processes import local_processes
from torchsoft.tables import line
from torchsoft.threads import single_threaded

CLUSTER = 16
"""Workers that a cluster is taken to have."""

MOST = 1000
"""Local workers."""

THREADS = 3
"""Threads of one process at the most: a third of a trajectory's time is not compiled, and holds the interpreter's lock."""

COARSE = 5e-3
"""Steps longer than this [s] get a note."""

HELP = "take fewer trajectories, a looser rtol or a shorter duration"


class Serial(Executor):
    """Runs every call at once, in this process."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def run_shard(config_json: str, url: str, shard: int, design: Any) -> tuple[int, int]:
    """Simulate and write one shard; how many trajectories it holds and how many of them failed."""
    config = Config.model_validate_json(config_json)
    store = Store(url, config)
    with single_threaded():
        rows = [simulate_task(config, task(config, i, u)) for i, u in zip(store.rows(shard), design, strict=True)]
    store.write(shard, rows)
    return len(rows), sum(int(row["failed"]) for row in rows)


def generate(config: Config, url: str, executor: Executor, workers: int = 1, progress: bool = True) -> int:
    """Make every unfinished shard at `url`; the number of failed simulations among them.

    At most a few shards a worker are submitted at a time, so that Ctrl-C is heard and memory is bounded. Raises `StoreError`.
    """
    store, design = open_or_create(url, config), points(config)
    todo = store.unfinished()
    left, failed, running = iter(todo), 0, set[Future[tuple[int, int]]]()
    finished = config.trajectories - sum(len(store.rows(shard)) for shard in todo)
    bar = tqdm(total=config.trajectories, initial=finished, unit="traj", disable=not progress, smoothing=0.05)
    began, made = perf_counter(), 0
    try:
        while True:
            while len(running) < 3 * max(workers, 1) and (shard := next(left, None)) is not None:
                here = store.rows(shard)
                job = (config.model_dump_json(), url, shard, design[here.start : here.stop])
                running.add(executor.submit(run_shard, *job))
            if not running:
                return failed
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                count, bad = future.result()
                made, failed = made + count, failed + bad
                rate = made * config.duration / (perf_counter() - began)
                bar.set_postfix_str(f"{rate:.3g} simulated s/s, {failed} failed", refresh=False)
                bar.update(count)
    finally:
        for future in running:
            future.cancel()
        bar.close()


@contextmanager
def local_workers(workers: int) -> Iterator[Executor]:
    """So many threads of this process, which begin at once; processes where there are too many for one."""
    with local_processes(workers) if workers > THREADS else threads.executor(workers) as executor:
        yield executor


@contextmanager
def dask_cluster(address: str) -> Iterator[Executor]:
    """An existing Dask cluster behind the same interface; shards of a lost worker are made by the others."""
    try:
        from distributed import Client
    except ImportError:
        raise StoreError("--scheduler needs Dask: pip install 'torchsoft[scale]'") from None
    with Client(address) as client:
        yield client.get_executor(retries=3, pure=False)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m data_gen.generate", description=__doc__)
    parser.add_argument("config", type=Path, help="TOML file, see data_gen/configs")
    parser.add_argument("--out", required=True, help="folder or fsspec URL of the store")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="threads, or processes if more than a few"
    )
    parser.add_argument("--scheduler", help="address of a Dask scheduler, such as tcp://host:8786")
    parser.add_argument("--yes", action="store_true", help="begin even what takes hours, or much memory or disk")
    given = parser.parse_args(arguments)
    if not 0 <= given.workers <= MOST:
        parser.error(f"argument --workers: should be from 0 to {MOST}, not {given.workers}")
    try:
        config = Config.from_toml(given.config)
        agree(cost(config, CLUSTER if given.scheduler else given.workers), given.yes, HELP)
        if config.step is not None and config.step > COARSE:
            print(
                f"note: step = {config.step:g} s is coarse: the energy balance may be off by percents", file=sys.stderr
            )
        if given.scheduler:
            with dask_cluster(given.scheduler) as executor:
                failed = generate(config, given.out, executor, CLUSTER)
        elif given.workers <= 0:
            failed = generate(config, given.out, Serial())
        else:
            with local_workers(given.workers) as executor:
                failed = generate(config, given.out, executor, given.workers)
    except (ValueError, StoreError) as error:
        print(f"error: {line(error, 2000)}", file=sys.stderr)
        return 2
    except OSError as error:
        where = f"{error.filename}: {error.strerror}" if error.filename else error
        print(f"error: {line(where, 2000)}", file=sys.stderr)
        return 2
    except BrokenProcessPool:
        print("error: a worker was killed, perhaps for memory; start again to make what is missing", file=sys.stderr)
        return 3
    except KeyboardInterrupt:
        print("interrupted: finished shards are kept; start again to make what is missing", file=sys.stderr)
        return 130
    print(f"{config.trajectories} trajectories in {given.out}; {failed} of those made now failed, each with its reason")
    return 0


if __name__ == "__main__":
    sys.exit(main())
