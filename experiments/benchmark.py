"""Question: what do a run, its gradient and its Jacobian cost, how do they grow, and against what?

All in one process and one run, medians of repeated timings, so that the ratios hold on a noisy machine:

- the 30 s manipulation: stepping, discrete adjoint of all parameters, Jacobian for 8 parameters, peak memory of each;
- 1, 8 and 64 trajectories on one and on two cores (processes, as the dataset generator will do it);
- growth with the surface nodes (61 to 481) and with the simulated time;
- the same right-hand side under scipy's LSODA, BDF and Radau (with a Jacobian from one batched call) and torchdiffeq's
  dopri5, over a window that they finish, as wall time per simulated second;
- where the time of a run goes.

Command: .venv/bin/python experiments/benchmark.py [--smoke]
Expected: the run under 2 s, the gradient of everything (run included) under 2 times that, the Jacobian about 3 times, 64
trajectories at more than 10 simulated seconds per second and core. About four minutes.
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

import numpy as np
import torch
from _experiment import grid, made_by, options, timed, write
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from scipy.integrate import solve_ivp
from torchdiffeq import odeint
from tqdm import tqdm

from torchsoft import Parameters, SoftGrasp, simulate
from torchsoft.processes import local_processes
from torchsoft.scenario import Manipulation, grasp_and_roll

EIGHT = ("contact.K_n", "contact.R_n", "contact.K_t", "contact.R_t", "contact.mu_s", "contact.mu_k", "pad.E", "pad.tau")


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/benchmark")
    duration: float = 30.0  # simulated time of the manipulation [s]
    step: float = 2e-3  # of the stepper [s]
    repeats: int = 5  # timings of which the median is taken
    trajectories: tuple[int, ...] = (1, 8, 64)  # batches
    batch_duration: float = 3.0  # simulated time of each trajectory of a batch [s]
    elements_x: tuple[int, ...] = (60, 120, 240, 480)  # meshes, a thirtieth of that through the pad
    window: float = 0.02  # simulated time that the other integrators get, in mid-roll [s]
    measure: str = ""  # used by the benchmark itself: print the peak memory of one task
    smoke: bool = False  # a size that takes seconds


@dataclass(frozen=True)
class Result:
    config: Config
    figures: dict[str, Any]


def prepare(elements_x: int = 120) -> Manipulation:
    changes = {"pad.elements_x": elements_x, "pad.elements_y": elements_x // 30}
    return grasp_and_roll(SoftGrasp(Parameters().override(changes)), grasp_force=80.66)


def tasks(m: Manipulation, t: torch.Tensor, step: float) -> dict[str, Callable[[], object]]:
    """The run, the run with its gradient, the run with its Jacobian."""

    def gradient() -> None:
        m.model.zero_grad()
        run = simulate(m.model, t, y0=m.y0, step=step, gradient="discrete")
        (run["theta"].square().sum() + 1e3 * run.together("x_C", "y_C").square().sum()).backward()

    return {
        "run": lambda: simulate(m.model, t, y0=m.y0, step=step),
        "gradient": gradient,
        "jacobian": lambda: simulate(m.model, t, y0=m.y0, step=step, gradient="forward", wrt=EIGHT, rigid=True),
    }


def median_time(task: Callable[[], object], repeats: int) -> float:
    """Median wall time [s] after one warm-up."""
    task()
    return median(timed(task)[1] for _ in range(repeats))


def costs(config: Config) -> dict[str, Any]:
    """Times of the three tasks, as ratios to the run, and the peak memory of a process that does one of them."""
    m = prepare()
    seconds = {
        name: median_time(task, config.repeats) for name, task in tasks(m, grid(config.duration), config.step).items()
    }
    memory = {}
    for name in ("nothing", *seconds):
        flags = [f"--measure={name}", f"--duration={config.duration}", f"--step={config.step}"]
        out = subprocess.run([sys.executable, __file__, *flags], capture_output=True, text=True, check=True)
        memory[name] = float(out.stdout.split()[-1])
    return {
        "seconds": seconds,
        "ratio": {name: s / seconds["run"] for name, s in seconds.items()},
        "peak_memory_MB": memory,
        "simulated_per_wall": config.duration / seconds["run"],
    }


def peak_memory(config: Config) -> None:
    """Do one task once and print this process's peak resident memory [MB] (Linux: VmHWM, which starts anew at exec)."""
    m = prepare()
    if config.measure != "nothing":
        tasks(m, grid(config.duration), config.step)[config.measure]()
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    print(next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024)


_worker: dict[str, Any] = {}


def _prepare_worker() -> None:
    _worker["manipulation"] = prepare()


def _one_of_many(job: tuple[int, float, float]) -> float:
    """Trajectory number k, which differs from the others in its start; returns where the disc ends [m]."""
    k, duration, step = job
    m: Manipulation = _worker["manipulation"]
    y0 = m.y0.clone()
    y0[m.model.layout.slices["velocity", "disc"]] = torch.tensor([1e-5 * k, 1e-5 * k, 0.0], dtype=torch.float64)
    return simulate(m.model, grid(duration), y0=y0, step=step)["x_C"][-1].item()


def batches(config: Config) -> dict[str, dict[str, float]]:
    """Simulated seconds per wall second of many trajectories on one and two cores, the processes already started."""
    out = {}
    for cores in (1, 2):
        with local_processes(cores, _prepare_worker) as pool:
            list(pool.map(_one_of_many, [(0, 0.1, config.step)] * (4 * cores)))
            for n in config.trajectories:
                jobs = [(k, config.batch_duration, config.step) for k in range(n)]
                seconds = median_time(
                    lambda pool=pool, jobs=jobs: list(pool.map(_one_of_many, jobs)), min(config.repeats, 3)
                )
                rate = n * config.batch_duration / seconds
                out[f"{n} on {cores}"] = {"simulated_per_wall": rate, "per_core": rate / min(cores, n)}
    return out


def growth(config: Config) -> dict[str, dict[str, float]]:
    """Seconds of a run per simulated second, over meshes and over simulated times."""
    meshes, durations = {}, {}
    for n in config.elements_x:
        m, t = prepare(n), grid(config.batch_duration)
        meshes[str(n + 1)] = (
            median_time(tasks(m, t, config.step)["run"], min(config.repeats, 3)) / config.batch_duration
        )
    m = prepare()
    for duration in (0.1, 0.3, 1.0):
        t = grid(duration * config.duration)
        durations[f"{duration * config.duration:g}"] = median_time(tasks(m, t, config.step)["run"], 3) / float(t[-1])
    return {"surface_nodes": meshes, "simulated_s": durations}


def others(config: Config) -> dict[str, dict[str, float]]:
    """Wall time per simulated second of other integrators on the module's own forward, in mid-roll, and their error."""
    m = prepare()
    model, begin = m.model, 2.0
    y0 = simulate(model, torch.tensor([0.0, begin], dtype=torch.float64), y0=m.y0, step=config.step).y[-1]
    t = torch.tensor([begin, begin + config.window], dtype=torch.float64)
    exact = simulate(model, t, y0=y0, step=config.window / 2000).y[-1]
    part = model.layout.slices["pose", "disc"].start + torch.arange(2)
    size = torch.ones(model.layout.size, dtype=torch.float64)
    for name, pad in model.pads.items():  # nodal forces, counted by the displacement that they make
        size[model.layout.slices["pads", name]] = 1 / pad.compliance().detach().diagonal().max()
    shift, atol = 1e-9 * torch.diag(size), 1e-9 * size

    @torch.no_grad()
    def rhs(time: float, y: np.ndarray) -> np.ndarray:
        return model(time, torch.from_numpy(y)).numpy()

    @torch.no_grad()
    def jacobian(time: float, y: np.ndarray) -> np.ndarray:
        base = torch.from_numpy(y)
        return ((model(time, base + shift) - model(time, base)) / shift.diagonal()[:, None]).numpy().T

    def scipy_solver(method: str) -> torch.Tensor:
        out = solve_ivp(rhs, t.tolist(), y0.numpy(), method=method, rtol=1e-6, atol=atol.numpy(), jac=jacobian)
        return torch.from_numpy(out.y[:, -1])

    @torch.no_grad()
    def dopri5() -> torch.Tensor:
        solution = odeint(model, y0, t, rtol=1e-6, atol=atol)  # pyright: ignore[reportArgumentType]
        assert isinstance(solution, torch.Tensor)
        return solution[-1]

    solvers: dict[str, Callable[[], torch.Tensor]] = {
        "sdirk2 (this stepper)": lambda: simulate(model, t, y0=y0, step=config.step).y[-1],
        "scipy LSODA": lambda: scipy_solver("LSODA"),
        "scipy BDF": lambda: scipy_solver("BDF"),
        "scipy Radau": lambda: scipy_solver("Radau"),
        "torchdiffeq dopri5": dopri5,
    }
    out = {}
    for name, solve in solvers.items():
        end, wall = timed(solve)
        out[name] = {
            "wall_per_simulated": wall / config.window,
            "position_error_nm": 1e9 * float((end - exact)[part].norm()),
        }
    longer = grid(config.batch_duration)  # a window is too short to time the stepper on
    wall = median_time(tasks(m, longer, config.step)["run"], config.repeats) / config.batch_duration
    out["sdirk2 (this stepper)"]["wall_per_simulated"] = wall
    return out


def profile(config: Config) -> dict[str, float]:
    """Part of a run's time that is spent in the compiled kernel, by a deterministic profiler."""
    m = prepare()
    run = tasks(m, grid(config.duration), config.step)["run"]
    profiler = cProfile.Profile()
    profiler.runcall(run)
    rows = pstats.Stats(profiler).get_stats_profile()
    return {"kernel_share": rows.func_profiles["run"].tottime / rows.total_tt}


def run(config: Config) -> Result:
    parts = {"costs": costs, "batches": batches, "growth": growth, "others": others, "profile": profile}
    return Result(config, {name: part(config) for name, part in tqdm(parts.items(), unit="part")})


def figure(result: Result) -> Figure:
    """Costs as ratios; growth with surface nodes; the other integrators."""
    fig = Figure(figsize=(12, 3.6), layout="constrained")
    left, middle, right = fig.subplots(1, 3)
    ratio = result.figures["costs"]["ratio"]
    columns = left.bar(list(ratio), list(ratio.values()), color="#0072b2")
    left.bar_label(columns, fmt="%.2f")
    left.margins(y=0.12)
    left.set(ylabel="time over a plain run [1]", title="Run, gradient of all, Jacobian for 8")
    nodes = result.figures["growth"]["surface_nodes"]
    middle.loglog([int(n) for n in nodes], [1e3 * s for s in nodes.values()], "o-", color="#0072b2")
    middle.set_xticks([int(n) for n in nodes], list(nodes))
    middle.xaxis.set_minor_locator(NullLocator())
    middle.set(xlabel="surface nodes a pad", ylabel="wall time [ms] per simulated s", title="Growth with the mesh")
    others_ = result.figures["others"]
    right.barh(list(others_), [x["wall_per_simulated"] for x in others_.values()], color="#0072b2", log=True)
    right.set(xlabel="wall time [s] per simulated s", title="Other integrators, same equations")
    right.invert_yaxis()
    return fig


def main() -> None:
    config = options(Config, __doc__)
    if config.measure:
        peak_memory(config)
        return
    if config.smoke:
        config = replace(
            config, duration=0.5, repeats=1, trajectories=(1, 2), batch_duration=0.2, elements_x=(60, 120), window=2e-3
        )
    result = run(config)
    print(json.dumps(result.figures, indent=2))
    write(config.out, result.figures | {"made_by": made_by(config)}, {"benchmark": figure(result)})


if __name__ == "__main__":
    main()
