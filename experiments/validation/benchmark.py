"""Question: what do batches cost, and how does a run grow with the mesh?

All in one process, medians of timings in turns, so that the ratios hold on a noisy machine:

- 64 trajectories of 4 s and 1,000 of 0.3 s with parameters of their own, on one and two threads;
- growth with the surface nodes, with a fitted exponent.

What a run costs by its tolerance, its gradient and its Jacobian is in `step_accuracy.py`.

Command: .venv/bin/python -m experiments.validation.benchmark [--smoke]
Expected: time grows with the nodes to the power 1.3. About three minutes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

import numpy as np
import torch

from experiments.frame import grid, numbers, options, timed, write
from torchsoft import BuiltRig, RigFile, simulate_batch

T = TypeVar("T")


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/benchmark")
    rtol: float = 1e-3  # of batches
    repeats: int = 3  # timings of which the median is taken
    long_runs: int = 64
    long: float = 4.0  # simulated time of each of them, and of runs by mesh [s]
    short_runs: int = 1000
    short: float = 0.3  # simulated time of each of them [s]
    elements_x: tuple[int, ...] = (60, 120, 240, 480)  # meshes, a thirtieth of that through the pad
    smoke: bool = False  # a size that takes seconds


def prepare(elements_x: int = 120) -> BuiltRig:
    """The manipulation on a mesh of so many elements."""
    mesh = {"pad.elements_x": elements_x, "pad.elements_y": elements_x // 30}
    return RigFile.ready("paper").override(mesh).build()


def in_turns(tasks: Mapping[str, Callable[[], T]], repeats: int) -> dict[str, tuple[T, float]]:
    """What each task returns, and the median of its wall times [s], taken in turns after one
    warm-up each: noise that comes and goes hits them all."""
    results = {name: task() for name, task in tasks.items()}
    walls = [{name: timed(task)[1] for name, task in tasks.items()} for _ in range(repeats)]
    return {name: (one, median(wall[name] for wall in walls)) for name, one in results.items()}


def batches(config: Config) -> dict[str, dict[str, float]]:
    """Simulated seconds per wall second, on one and two threads, of runs with their own stiffness,
    dashpot and retardation time, up to 20 % to either side of the rig's."""
    m = prepare()

    def task(count: int, duration: float, threads: int) -> Callable[[], int]:
        part = torch.linspace(0.8, 1.2, count, dtype=torch.float64)
        own = {
            name: m.rig.parameter(name).detach() * part.roll(i * count // 3)
            for i, name in enumerate(("contact.K_n", "contact.R_t", "pad.tau"))
        }
        how: dict[str, Any] = {"y0": m.y0, "parameters": own, "rtol": config.rtol}
        return lambda: len(simulate_batch(m.rig, grid(duration), threads=threads, **how).failures)

    sizes = (config.long_runs, config.long), (config.short_runs, config.short)
    cases = [(*size, threads) for size in sizes for threads in (1, 2)]
    times = in_turns({str(case): task(*case) for case in cases}, config.repeats)
    return {
        f"{count} runs of {duration:g} s, {threads} threads": {
            "wall time [s]": wall, "simulated s per wall s": count * duration / wall,
            "failures": failures,
        }
        for (count, duration, threads), (failures, wall) in zip(cases, times.values())
    }  # fmt: skip


def growth(config: Config) -> tuple[dict[str, float], float]:
    """Wall times [s] of a run by the surface nodes of a pad, and the slope of their logarithms."""
    rigs, t = {str(n + 1): prepare(n) for n in config.elements_x}, grid(config.long)
    tasks = {nodes: lambda m=m: m.run(t, rtol=config.rtol) for nodes, m in rigs.items()}
    wall = {nodes: seconds for nodes, (_, seconds) in in_turns(tasks, config.repeats).items()}
    slope = np.polyfit(np.log([float(n) for n in wall]), np.log(list(wall.values())), 1)[0]
    return wall, float(slope)


def main(config: Config) -> None:
    if config.smoke:
        config = replace(
            config, repeats=1, long_runs=2, long=0.2, short_runs=3, short=0.05,
            elements_x=(60, 120),
        )  # fmt: skip
    wall, exponent = growth(config)
    found = {"batches": batches(config), "growth": {"wall_s": wall, "exponent": exponent}}
    tables = {
        "batches": numbers("batch", found["batches"], ".3g"),
        "growth": numbers("surface nodes", {f"run [s] ~ n^{exponent:.2f}": wall}, ".3g"),
    }
    write(config, found, tables)


if __name__ == "__main__":
    main(options(Config, __doc__))
