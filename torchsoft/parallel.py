"""Runs side by side: threads, whose compiled kernels hold no lock, and pools of processes.

Python code does hold a lock; a run has about two milliseconds of it.
"""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed, wait
from contextlib import contextmanager, nullcontext
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

import torch
from threadpoolctl import ThreadpoolController

# Threads


P = ParamSpec("P")
T = TypeVar("T")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_single: list[Any] = []
_entering = threading.Lock()


@lru_cache(maxsize=1)
def controller(modules: int) -> ThreadpoolController:
    """The libraries with threads that are loaded, when so many modules are imported: to look for
    them takes as long as a short run."""
    return ThreadpoolController()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """torch on one thread: on a busy core its threads wait for each other, and arrays here are
    small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def ungraphed(run: Callable[P, T]) -> Callable[P, T]:
    """A function that `torch.compile` leaves to Python, with what it calls."""

    @wraps(run)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        if "torch._dynamo" not in sys.modules:  # whose import takes a second
            return run(*args, **kwargs)
        reason = "rigs are no graph for torch.compile, and their runs are compiled already"
        plain: Any = torch.compiler.disable(run, reason=reason)
        return plain(*args, **kwargs)

    return called


@contextmanager
def single_threaded() -> Iterator[None]:
    """torch and the linear algebra libraries on one thread each, until everybody who asked for it
    is done.

    Sums taken by more threads round differently, and contacts that stick amplify it.
    """
    with _entering:
        limited = None if _single else controller(len(sys.modules)).limit(limits=1)
        _single.append(limited)
    try:
        with one_torch_thread():
            yield
    finally:
        with _entering:
            if len(_single) == 1:
                _single[0].restore_original_limits()
                _single.clear()
            else:
                _single.pop()


def executor(threads: int) -> ThreadPoolExecutor:
    """A pool of threads that compute on one core each."""
    return ThreadPoolExecutor(threads, "torchsoft", torch.set_num_threads, (1,))


_own = threading.local()


@contextmanager
def released_turn() -> Iterator[None]:
    """Let the other threads of a batch compute in Python while compiled code runs in this one."""
    turn: threading.Lock | None = getattr(_own, "turn", None)
    if turn is None:
        yield
        return
    turn.release()
    try:
        yield
    finally:
        turn.acquire()


def parallel_map(
    work: Callable[[int], T], count: int, threads: int | None = None, *, turns: bool = False
) -> Iterator[tuple[int, T]]:
    """`work(i)` for i below `count`, in so many threads (one a core by default), as (i, result) in
    the order of their ends.

    The threads inherit torch's grad mode; each computes on one core. With `turns` one thread at a
    time computes in Python: torch releases the interpreter's lock at every operation, and threads
    that hand it over each time are slower than one alone. An exception cancels work that has not
    begun, and so does Ctrl-C; running work is waited for.
    """
    threads = min(count, cores() if threads is None else threads)
    if threads <= 1:
        for i in range(count):
            yield i, work(i)
        return
    mode = torch.is_grad_enabled()

    turn = threading.Lock() if turns else None

    def one(i: int) -> T:
        with turn or nullcontext(), torch.set_grad_enabled(mode):
            _own.turn = turn
            try:
                return work(i)
            finally:
                _own.turn = None

    with single_threaded(), executor(threads) as pool:
        futures = {pool.submit(one, i): i for i in range(count)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            for future in futures:
                future.cancel()
            wait(futures)


# Simulations side by side: a pool of processes, one thread each, that end with their parent.


THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def prepare_worker() -> None:
    """Leave Ctrl-C to the parent, end with it however it ends, and compute on one thread."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def local_processes(workers: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of spawned processes. Scripts that use it need the usual `if __name__ ==
    "__main__"`."""
    for name in THREADS:
        os.environ[name] = "1"
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, initializer=prepare_worker)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
