"""SIGKILL at random moments of a generation; started again it ends in the same bytes, and nothing
is left over."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hostile.small import config, difference, fork, in_memory, make, tree
from hostile.trial import Tally

pytestmark = pytest.mark.slow


@pytest.fixture
def tmp_path(tmp_path: Path) -> Iterator[Path]:
    yield from in_memory(tmp_path)


ROOT = Path(__file__).parent.parent.parent


def kill(pid: int) -> bool:
    """Whether the process was still there to be killed."""
    os.kill(pid, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL


def test_killed_generations(
    tmp_path: Path, tally: Callable[[str], Tally], random: Any, count: Callable[[int], int]
) -> None:
    """Killed once, twice or three times, and then started again."""
    small, _ = config(tmp_path)
    make(small, tmp_path / "whole")
    expected, out, line = tree(tmp_path / "whole"), tmp_path / "set", tally("kills of a generation")
    began = time.perf_counter()
    os.waitpid(fork(lambda: make(small, tmp_path / "again")), 0)
    duration = time.perf_counter() - began
    rng, trial = random(300), 0
    while line.tried < count(40):
        trial += 1
        assert trial < 10 * count(40), "most end before they are killed"
        times = rng.uniform(0, duration, rng.integers(1, 4))
        shutil.rmtree(out, ignore_errors=True)
        killed = 0
        for moment in times:
            pid = fork(lambda: make(small, out))
            time.sleep(moment)
            killed += kill(pid)
        make(small, out)
        wrong = difference(out, expected)
        for _ in range(killed):
            line.held(
                not wrong, f"trial {trial}, killed after {times} s: not as undisturbed: {wrong}"
            )


def test_killed_generators_at_once(
    tmp_path: Path, tally: Callable[[str], Tally], random: Any, count: Callable[[int], int]
) -> None:
    """Two on one folder, begun at nearly the same time; one is killed and the other ends well."""
    small, _ = config(tmp_path)
    make(small, tmp_path / "whole")
    expected, out, line = (
        tree(tmp_path / "whole"),
        tmp_path / "set",
        tally("kills of one of two generators at once"),
    )
    rng, trial = random(301), 0
    while line.tried < count(14):
        trial += 1
        assert trial < 10 * count(14), "most end before they are killed"
        shutil.rmtree(out, ignore_errors=True)
        first = fork(lambda: make(small, out))
        time.sleep(rng.uniform(0, 0.1))
        second = fork(lambda: make(small, out))
        time.sleep(rng.uniform(0, 0.6))
        died, other = (first, second) if rng.random() < 0.5 else (second, first)
        killed = kill(died)
        status = os.waitstatus_to_exitcode(os.waitpid(other, 0)[1])
        make(small, out)
        wrong = difference(out, expected)
        if killed:
            line.held(
                status == 0 and not wrong,
                f"trial {trial}: the other ended with {status}; not as undisturbed: {wrong}",
            )


@pytest.mark.parametrize("workers", [1, 2])
def test_killed_commands(
    workers: int,
    tmp_path: Path,
    tally: Callable[[str], Tally],
    random: Any,
    count: Callable[[int], int],
) -> None:
    """The command with its worker processes, killed again and again on one folder, most times soon
    after it wrote something."""
    small, path = config(tmp_path, trajectories=16)
    out, line = tmp_path / "set", tally(f"kills of the command with {workers} workers")
    command = [
        sys.executable,
        "-m",
        "data_gen.generate",
        str(path),
        "--out",
        str(out),
        "--workers",
        str(workers),
    ]
    rng: np.random.Generator = random(302, workers)
    quiet: dict[str, Any] = {
        "cwd": ROOT,
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
    }
    killed = 0
    for trial in range(count(8)):
        before = sum(1 for _ in out.rglob("*"))
        process = subprocess.Popen(command, **quiet)
        while trial % 4 and process.poll() is None and sum(1 for _ in out.rglob("*")) == before:
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.3 if trial % 4 else 5.0))
        process.kill()
        killed += process.wait() == -signal.SIGKILL
    status = subprocess.run(command, check=False, **quiet).returncode
    make(small, tmp_path / "whole")
    wrong = difference(out, tree(tmp_path / "whole"))
    assert killed
    for _ in range(killed):
        line.held(
            status == 0 and not wrong,
            f"the last start ended with {status}; not as undisturbed: {wrong}",
        )
