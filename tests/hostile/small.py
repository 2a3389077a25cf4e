"""A dataset small enough to be made hundreds of times, and processes that may die without harm."""

import os
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import torch

from torchsoft.datasets import generate as generation
from torchsoft.datasets.config import Config
from torchsoft.datasets.generate import Serial, generate
from torchsoft.datasets.simulation import simulate_task

TOML = """
title = "Small"
seed = 5
trajectories = 3
trajectories_per_shard = 2
duration = 0.5
sample_interval = 0.025
step = 0.005
samples_per_chunk = 16
settle = 0.0
grasp_depth = { low = 1.3e-3, high = 1.5e-3 }
[fixed]
"pad.elements_x" = 40
"pad.elements_y" = 1
"contact.v_s" = 0.05
"scenario.grasp_time" = 0.1
[parameters]
"pad.E" = { low = 7e5, high = 8e5, scale = "log" }
[[kinds]]
kind = "multi_sine"
amplitude_x = { low = 2e-4, high = 4e-4 }
amplitude_y = { low = 1e-5, high = 3e-5 }
"""


def config(folder: Path, trajectories: int = 3) -> tuple[Config, Path]:
    """The configuration, and the file that holds it."""
    path = folder / f"small-{trajectories}.toml"
    path.write_text(TOML.replace("trajectories = 3", f"trajectories = {trajectories}"))
    return Config.from_toml(path), path


_rows: dict[tuple[str, int], Any] = {}


def remembered(config: Config, task: Any) -> Any:
    """A simulated row: in this process, and those forked from it, the one that was simulated
    first."""
    key = (config.hash, task.index)
    if key not in _rows:
        _rows[key] = simulate_task(config, task)
    return dict(_rows[key])


def make(config: Config, folder: Path) -> None:
    """Generate in this process; a row that was simulated before is written without being simulated
    again."""
    torch.set_num_threads(1)
    with mock.patch.object(generation, "simulate_task", remembered):
        assert generate(config, str(folder), Serial(), progress=False) == 0


def in_memory(otherwise: Path) -> Iterator[Path]:
    """A folder that is flushed at once, where there is one: waiting for a disk would take most of
    the trial's time."""
    memory = Path("/dev/shm")
    if os.access(memory, os.W_OK):
        with TemporaryDirectory(dir=memory) as folder:
            yield Path(folder)
    else:
        yield otherwise


def tree(folder: Path) -> dict[str, bytes | None]:
    """Every file with its content, every folder with None."""
    return {
        str(p.relative_to(folder)): None if p.is_dir() else p.read_bytes()
        for p in sorted(folder.rglob("*"))
    }


def difference(folder: Path, expected: dict[str, bytes | None]) -> str:
    """What there is too much, too little and otherwise; empty where all is the same to the byte."""
    here = tree(folder)
    wrong = sorted(
        key for key in here.keys() | expected.keys() if here.get(key, 0) != expected.get(key, 0)
    )
    return ", ".join(wrong)


def restore(folder: Path, source: Path) -> None:
    """Make `folder` a copy of `source`."""
    shutil.rmtree(folder, ignore_errors=True)
    if source.exists():
        shutil.copytree(source, folder)


DIED = 9
"""Exit status of a process that died where it was told to."""


def fork(function: Callable[[], Any], seconds: int = 120) -> int:
    """The id of a process that runs the function and ends, with status 0, or 1 after its traceback;
    it never lasts longer."""
    sys.stdout.flush()
    sys.stderr.flush()
    if pid := os.fork():
        return pid
    status = 1
    try:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(seconds)
        function()
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def forked(function: Callable[[], Any], seconds: int = 120) -> int:
    """Exit status of such a process, negative for the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(fork(function, seconds), 0)[1])
