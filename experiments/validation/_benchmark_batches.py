"""Many runs with parameters of their own in one call, on one and on two threads."""

from collections.abc import Callable
from statistics import median
from typing import Any

import torch
from _benchmark_common import Config, interleaved, prepare
from torch import Tensor

from torchsoft import SoftGrasp
from torchsoft.experiment import grid, timed


def own_parameters(model: SoftGrasp, count: int) -> dict[str, Tensor]:
    """Every run's own stiffness, dashpot and retardation time: up to 20 % to either side of the model's."""
    part = torch.linspace(0.8, 1.2, count, dtype=torch.float64)
    names = ("contact.K_n", "contact.R_t", "pad.tau")
    return {name: model.parameter(name).detach() * part.roll(i * count // 3) for i, name in enumerate(names)}


def batches(config: Config) -> dict[str, Any]:
    """Simulated seconds per wall second of long and of short runs on one and two threads."""
    from torchsoft import simulate_batch

    m, failures = prepare(), dict[str, int]()

    def task(name: str, count: int, duration: float, threads: int) -> Callable[[], float]:
        t, parameters = grid(duration), own_parameters(m.model, count)

        def one() -> float:
            run = lambda: simulate_batch(
                m.model, t, y0=m.y0, parameters=parameters, threads=threads, rtol=config.rtols[0]
            )
            batch, wall = timed(run)
            failures[name] = len(batch.failures)
            return wall

        return one

    sizes = {
        "trajectories": (config.trajectories, config.batch_duration),
        "short runs": (config.short_runs, config.short_duration),
    }
    named = {(name, threads): task(name, *sizes[name], threads) for name in sizes for threads in (1, 2)}
    every = interleaved(
        {f"{name}, {threads}": one for (name, threads), one in named.items()}, max(1, config.repeats // 2)
    )
    out: dict[str, Any] = {}
    for name, (count, duration) in sizes.items():
        seconds = {threads: median(every[f"{name}, {threads}"]) for threads in (1, 2)}
        out[name] = {
            "runs": count, "simulated_s": duration, "failures": failures[name],
            "wall_s": {str(threads): s for threads, s in seconds.items()},
            "simulated_per_wall": {str(threads): count * duration / s for threads, s in seconds.items()},
            "runs_per_wall_s": {str(threads): count / s for threads, s in seconds.items()},
            "two_threads_over_one": seconds[1] / seconds[2],
        }  # fmt: skip
    return out
