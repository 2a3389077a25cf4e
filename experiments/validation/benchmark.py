"""Question: what do a run, its gradient, its Jacobian and batches cost, how do they grow, and against what?

All in one process and one run, medians of repeated timings in turns, so that the ratios hold on a noisy machine:

- the 30 s manipulation by two tolerances and by equal steps; errors against a run at rtol 1e-7; `scenario_wall_s` is that of
  the loosest tolerance with the accuracy of a step of 2 ms (motion 3e-4, forces 0.5 % of their range);
- over the run the sweep for the gradient of all parameters, and what the Jacobian for 8 parameters adds; peak memory;
- 64 trajectories of 4 s and 1,000 of 0.3 s with parameters of their own, on one and two threads;
- growth with the surface nodes, the nodes that touch, the simulated time and the size of a batch, with fitted exponents;
- with `--peers` the same equations, compiled, under scipy's, torchdiffeq's and diffrax's integrators, equally exact.

Command: .venv/bin/python experiments/validation/benchmark.py [--peers] [--smoke]
Expected: the sweep at most 0.6 of a run and the Jacobian at most 2 by tolerances, more by equal steps; forces need rtol 1e-4 to
be as exact as by 2 ms. About five minutes, three more with `--peers`.
"""

import cProfile
import json
import pstats
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

from _benchmark_batches import batches
from _benchmark_common import Config, interleaved, prepare, tasks, wall, ways
from _benchmark_growth import Growth, growth, growth_figure, growth_table
from matplotlib.figure import Figure
from step_accuracy import errors
from tqdm import tqdm

from torchsoft import simulate
from torchsoft.experiment import grid, made_by, markdown, options, write

ACCURACY = {"motion": 3e-4, "forces": 5e-3}
"""Largest errors over the range of what a step of 2 ms gives."""

MEASURED = ("nothing", "run", "gradient", "jacobian")
"""Tasks of which the peak memory is taken."""


@dataclass(frozen=True)
class Result:
    config: Config
    figures: dict[str, Any]
    growth: list[Growth]


def costs(config: Config) -> dict[str, Any]:
    """Times of the three tasks by every way, with errors and peak memory."""
    m, t = prepare(), grid(config.duration)
    exact = simulate(m.model, t, y0=m.y0, rtol=config.exact)
    every = {(way, name): task for way, steps in ways(config).items() for name, task in tasks(m, t, steps).items()}
    times = interleaved({f"{way}, {name}": wall(task) for (way, name), task in every.items()}, config.repeats)
    out: dict[str, Any] = {"timings": times}
    for way, steps in ways(config).items():
        one = simulate(m.model, t, y0=m.y0, **steps)
        seconds = {name: median(times[f"{way}, {name}"]) for name in ("run", "gradient", "jacobian")}
        part = lambda name, seconds=seconds: seconds[name] / seconds["run"]
        out[way] = {
            "seconds": seconds, "steps": one.stats.steps, "solves": one.stats.newton_iterations,
            "errors": errors(one, exact), "gradient_total_over_run": part("gradient"),
            "gradient_over_run": part("gradient") - 1, "jacobian8_total_over_run": part("jacobian"),
            "jacobian8_over_run": part("jacobian") - 1,
        }  # fmt: skip
    return out | {"peak_memory_MB": memory(config)}


def memory(config: Config) -> dict[str, float]:
    """Peak memory [MB] of processes that do one task each, at the tighter tolerance."""
    out, way = {}, list(ways(config))[1]
    for name in MEASURED:
        flags = [f"--measure={name}, {way}", f"--duration={config.duration}", f"--step={config.step}"]
        done = subprocess.run([sys.executable, __file__, *flags], capture_output=True, text=True, check=True)
        out[name] = float(done.stdout.split()[-1])
    return out


def peak_memory(config: Config) -> None:
    """Do one task once and print this process's peak resident memory [MB] (Linux: VmHWM, which starts anew at exec)."""
    name, way = config.measure.split(", ")
    m = prepare()
    if name != "nothing":
        tasks(m, grid(config.duration), ways(config)[way])[name]()
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    print(next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024)


def profile(config: Config) -> dict[str, float]:
    """Part of a run's time that is spent in the compiled kernel, by a deterministic profiler."""
    m, (way, *_) = prepare(), ways(config).values()
    profiler = cProfile.Profile()
    profiler.runcall(tasks(m, grid(config.duration), way)["run"])
    rows = pstats.Stats(profiler).get_stats_profile()
    return {"kernel_share": rows.func_profiles["run"].tottime / rows.total_tt}


def run(config: Config) -> Result:
    if config.smoke:
        config = replace(
            config, duration=0.5, exact=1e-5, repeats=1, trajectories=2, batch_duration=0.2, short_runs=3,
            short_duration=0.05, elements_x=(60, 120), window=5e-3,
        )  # fmt: skip
    parts: dict[str, Callable[[Config], Any]] = {
        "costs": costs, "batches": batches, "growth": growth, "profile": profile,
    }  # fmt: skip
    if config.peers:
        from _benchmark_peers import peers

        parts["peers"] = peers
    done = {name: part(config) for name, part in tqdm(parts.items(), unit="part")}
    grown: list[Growth] = done.pop("growth")
    cost, batch = done["costs"], done["batches"]
    *chosen, equal = (cost[way] for way in ways(config))
    rtol = next((r for r, one in zip(config.rtols, chosen) if exact_enough(one["errors"])), None)
    own = chosen[-1] if rtol is None else cost[f"rtol = {rtol:g}"]
    scenario_s = None if rtol is None else own["seconds"]["run"]
    top = {
        "scenario_wall_s": scenario_s, "scenario_rtol": rtol, "scenario_wall_s_loose": chosen[0]["seconds"]["run"],
        "scenario_wall_s_tight": chosen[-1]["seconds"]["run"],
        "scenario_wall_s_equal_steps": equal["seconds"]["run"],
        **{name: own[name] for name in own if name.endswith("over_run")},
        **{f"{name}_equal_steps": equal[name] for name in equal if name.endswith("over_run")},
        "batch_sim_s_per_wall_s": batch["trajectories"]["simulated_per_wall"]["2"],
        "batch_sim_s_per_wall_s_one_thread": batch["trajectories"]["simulated_per_wall"]["1"],
        "batch_two_threads_over_one": batch["trajectories"]["two_threads_over_one"],
    }  # fmt: skip
    return Result(config, top | done | {"growth": [one.summary() for one in grown]}, grown)


def worst(errors: dict[str, float]) -> dict[str, float]:
    """The largest errors of the motion and of the forces."""
    parts = {"motion": ("x_C", "y_C", "theta"), "forces": ("F_x", "F_y")}
    return {part: max(errors[name] for name in names) for part, names in parts.items()}


def exact_enough(errors: dict[str, float]) -> bool:
    """Whether a run is as exact as by a step of 2 ms."""
    return all(error <= ACCURACY[part] for part, error in worst(errors).items())


def cost_table(config: Config, numbers: dict[str, Any]) -> str:
    """Every way with its times, errors and memory."""
    head = (
        "steps by", "run [s]", "error of motion [1]", "error of forces [1]", "gradient: sweep over run", "total",
        "Jacobian for 8: added over run", "total",
    )  # fmt: skip
    rows: list[tuple[object, ...]] = []
    for way in ways(config):
        one = numbers["costs"][way]
        motion, forces = worst(one["errors"]).values()
        ratios = ("gradient_over_run", "gradient_total_over_run", "jacobian8_over_run", "jacobian8_total_over_run")
        rows.append(
            (way, f"{one['seconds']['run']:.3g}", f"{motion:.1e}", f"{forces:.1e}", *(f"{one[r]:.2f}" for r in ratios))
        )  # fmt: skip
    peak = ", ".join(f"{name} {one:.0f}" for name, one in numbers["costs"]["peak_memory_MB"].items())
    return f"{markdown(head, rows)}\n\nPeak memory at {list(ways(config))[1]} [MB]: {peak}"


def batch_table(numbers: dict[str, Any]) -> str:
    """Both batches on one and two threads."""
    head = ("batch", "threads", "wall time [s]", "simulated s per wall s", "runs per wall s", "failures")
    return markdown(
        head,
        [
            (
                f"{one['runs']} runs of {one['simulated_s']:g} s", threads, f"{one['wall_s'][threads]:.3g}",
                f"{one['simulated_per_wall'][threads]:.3g}", f"{one['runs_per_wall_s'][threads]:.3g}", one["failures"],
            )
            for one in numbers["batches"].values() for threads in ("1", "2")
        ],
    )  # fmt: skip


def tables(result: Result) -> str:
    """All tables."""
    parts = [
        cost_table(result.config, result.figures), batch_table(result.figures), growth_table(result.growth)
    ]  # fmt: skip
    if "peers" in result.figures:
        from _benchmark_peers import peers_table

        parts.append(peers_table(result.figures["peers"]))
    return "\n\n".join(parts)


def figure(result: Result) -> Figure:
    """Wall times of the tasks by every way; batches; the other integrators, if any."""
    numbers, colours = result.figures, ("#0072b2", "#e69f00", "#009e73")
    fig = Figure(figsize=(13, 4.2), layout="constrained")
    left, middle, right = fig.subplots(1, 3, width_ratios=(1.6, 0.7, 1.3))
    every = list(ways(result.config))
    for i, (name, colour) in enumerate(zip(("run", "gradient", "jacobian"), colours)):
        label = {"run": "run", "gradient": "with gradient of all", "jacobian": "with Jacobian for 8"}[name]
        seconds = [numbers["costs"][way]["seconds"][name] for way in every]
        bars = left.bar([k + 0.27 * (i - 1) for k in range(len(every))], seconds, 0.25, color=colour, label=label)
        left.bar_label(bars, fmt="%.2g", fontsize=8)
    names = [way.replace(" = ", "\n") for way in every]
    left.set_xticks(range(len(names)), names)
    left.margins(y=0.1)
    left.set(ylabel="wall time [s]", title=f"{result.config.duration:g} s of manipulation, one core")
    left.legend(fontsize=8)
    batch = numbers["batches"]
    for i, threads in enumerate(("1", "2")):
        rates = [one["simulated_per_wall"][threads] for one in batch.values()]
        bars = middle.bar(
            [k + 0.36 * (i - 0.5) for k in range(2)], rates, 0.34, color=colours[i], label=f"{threads} thread{'s' * i}"
        )
        middle.bar_label(bars, fmt="%.3g", fontsize=8)
    middle.set_xticks(range(2), [f"{one['runs']} runs\nof {one['simulated_s']:g} s" for one in batch.values()])
    middle.margins(y=0.12)
    middle.set(ylabel="simulated s per wall s [1]", title="Batches")
    middle.legend(fontsize=8)
    if "peers" not in numbers:
        right.set_axis_off()
        return fig
    way = list(numbers["peers"]["equal"])[-1]
    reached = {name: one["wall_per_simulated"] for name, one in numbers["peers"]["equal"][way].items() if one}
    bars = right.barh(list(reached), list(reached.values()), color="#0072b2", log=True)
    right.bar_label(bars, fmt="%.2g", padding=3, fontsize=8)
    right.set_xlim(right=4 * max(reached.values()))
    right.invert_yaxis()
    right.set(xlabel="wall time [s] per simulated s", title=f"Same equations, as exact as {way}")
    return fig


def main() -> None:
    config = options(Config, __doc__)
    if config.measure:
        peak_memory(config)
        return
    result = run(config)
    print(json.dumps({k: v for k, v in result.figures.items() if not isinstance(v, dict | list)}, indent=2))
    print(tables(result))
    content = result.figures | {"made_by": made_by(config)}
    drawn = {"benchmark": figure(result), "growth": growth_figure(result.growth)}
    write(config.out, content, drawn, tables(result))


if __name__ == "__main__":
    main()
