"""What the parts of the benchmark share: its options, the manipulation, its three tasks, and fair timings."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch

from torchsoft import Parameters, SoftGrasp, simulate
from torchsoft.experiment import timed
from torchsoft.scenario import Manipulation, grasp_and_roll

EIGHT = ("contact.K_n", "contact.R_n", "contact.K_t", "contact.R_t", "contact.mu_s", "contact.mu_k", "pad.E", "pad.tau")

GRASP_FORCE = 80.66
"""Force [N] that holds the grasp of the usual rig, so that every version need not search for it."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/benchmark")
    duration: float = 30.0  # simulated time of the manipulation [s]
    rtols: tuple[float, float, float] = (1e-3, 1e-4, 1e-5)  # relative tolerances, the loosest first
    step: float = 2e-3  # of the equal steps [s]
    exact: float = 1e-7  # relative tolerance of the run that errors are measured against
    repeats: int = 5  # timings of which the median is taken
    trajectories: int = 64  # of a batch
    batch_duration: float = 4.0  # simulated time of each of them [s]
    short_runs: int = 1000  # of the batch of short runs
    short_duration: float = 0.3  # simulated time of each of them [s]
    elements_x: tuple[int, ...] = (60, 120, 240, 480)  # meshes, a thirtieth of that through the pad
    peers: bool = False  # the same equations under other integrators; needs `pip install torchsoft[peers]`
    window: float = 0.1  # simulated time that the other integrators get, in mid-roll [s]
    measure: str = ""  # used by the benchmark itself: print the peak memory of one task
    smoke: bool = False  # a size that takes seconds


def prepare(elements_x: int = 120, **changes: Any) -> Manipulation:
    """The manipulation on a mesh of so many elements, with other parameters of the scenario."""
    own = {f"scenario.{name}": value for name, value in changes.items()}
    mesh = {"pad.elements_x": elements_x, "pad.elements_y": elements_x // 30}
    return grasp_and_roll(SoftGrasp(Parameters().override(mesh | own)), grasp_force=GRASP_FORCE)


def ways(config: Config) -> dict[str, dict[str, Any]]:
    """How steps are chosen: by the two tolerances, and equal ones."""
    return {f"rtol = {rtol:g}": {"rtol": rtol} for rtol in config.rtols} | {
        f"step = {1e3 * config.step:g} ms": {"step": config.step}
    }


def tasks(m: Manipulation, t: torch.Tensor, steps: Mapping[str, Any]) -> dict[str, Callable[[], object]]:
    """The run, the run with its gradient by all parameters, the run with its Jacobian by eight."""

    def gradient() -> None:
        m.model.zero_grad()
        run = simulate(m.model, t, y0=m.y0, gradient="discrete", **steps)
        (run["theta"].square().sum() + 1e3 * run.together("x_C", "y_C").square().sum()).backward()

    return {
        "run": lambda: simulate(m.model, t, y0=m.y0, **steps),
        "gradient": gradient,
        "jacobian": lambda: simulate(m.model, t, y0=m.y0, gradient="forward", wrt=EIGHT, rigid=True, **steps),
    }


def interleaved(tasks: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """What each task returns, so many times in turns after one warm-up each: noise that comes and goes hits them all."""
    for task in tasks.values():
        task()
    out: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(repeats):
        for name, task in tasks.items():
            out[name].append(task())
    return out


def wall(task: Callable[[], object]) -> Callable[[], float]:
    """The same task as one that returns its wall time [s]."""
    return lambda: timed(task)[1]


def median_time(task: Callable[[], object], repeats: int) -> float:
    """Median wall time [s] after one warm-up."""
    return median(interleaved({"": wall(task)}, repeats)[""])
