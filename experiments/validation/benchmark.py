"""Question: what do batches cost, how does a run grow with the mesh, and what do other integrators
take?

All in one process, medians of timings in turns, so that the ratios hold on a noisy machine:

- 64 trajectories of 4 s and 1,000 of 0.3 s with parameters of their own, on one and two threads;
- growth with the surface nodes, with a fitted exponent;
- with `--peers` the same equations under scipy's and torchdiffeq's integrators over a window in
  mid-roll. All call the compiled right-hand side (`torchsoft.solve.system`). Every method
  is run by a series of tolerances, from loose to tight, until it is as exact as the stepper, in the
  disc's place and in the nodal forces; that run is timed, without compiling.

What a run costs by its tolerance, its gradient and its Jacobian is in `step_accuracy.py`.

Command: .venv/bin/python -m experiments.validation.benchmark [--peers] [--smoke]
Expected: time grows with the nodes to the power 1.3; the fastest of the other integrators takes
seven times as long. About three minutes, three more with `--peers`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torchdiffeq import odeint
from tqdm import tqdm

from experiments.frame import grid, numbers, options, timed, write
from torchsoft import BuiltRig, RigFile, simulate, simulate_batch
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.system import Rates

T = TypeVar("T")

START = 2.0
"""Where the window of the other integrators starts [s]."""

RTOLS = tuple(10.0**-n for n in range(2, 9))
"""Tolerances of the other integrators."""


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
    peers: bool = False  # other integrators too
    goal: float = 1e-4  # relative tolerance of the stepper that others are to be as exact as
    window: float = 0.1  # simulated time that they get, in mid-roll [s]
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


# other integrators
# ----------------------------------------------------------------------

Solver = Callable[[float], Array]
"""A method: the states (T, size) at a relative tolerance."""


def solvers(f: Rates, y0: Array, t: Array, size: Array) -> dict[str, Solver]:
    """scipy's methods, which difference the Jacobian themselves, and explicit ones of torchdiffeq;
    absolute tolerances are those of the `size` of each state."""

    def by_scipy(method: str, rtol: float) -> Array:
        how: dict[str, Any] = {"method": method, "t_eval": t, "rtol": rtol, "atol": rtol * size}
        return solve_ivp(f, (t[0], t[-1]), y0, **how).y.T

    def by_torchdiffeq(method: str, rtol: float) -> Array:
        rates = lambda t, y: torch.from_numpy(f(float(t), y.numpy()))
        atol: Any = rtol * torch.from_numpy(size)
        start, times = torch.from_numpy(y0), torch.from_numpy(t)
        out: Any = odeint(rates, start, times, rtol=rtol, atol=atol, method=method)
        return out.numpy()

    scipys, torchs = ("LSODA", "BDF", "Radau", "RK23", "RK45"), ("adaptive_heun", "bosh3", "dopri5")
    out: dict[str, Solver] = {f"scipy {name}": partial(by_scipy, name) for name in scipys}
    return out | {f"torchdiffeq {name}": partial(by_torchdiffeq, name) for name in torchs}


def peers(config: Config) -> dict[str, dict[str, float]]:
    """Every integrator at its loosest tolerance that is as exact as the stepper: wall time,
    right-hand sides, largest errors of the disc's place and of the forces over the largest. One
    that is never as exact has only its name."""
    m = prepare()
    y0 = m.run([0.0, START], rtol=1e-6).y[-1]
    t = START + grid(config.window, config.window / 10)
    exact = simulate(m.rig, t, y0=y0, rtol=1e-8).y.numpy()
    slices, f = m.rig.layout.slices, Rates(m.rig)
    size = np.ones(exact.shape[1])
    for (part, _), here in slices.items():
        size[here] = np.abs(exact[:, here] - (exact[0, here] if part == "pose" else 0.0)).max()
    place = slices["pose", "disc"].start + np.arange(2)
    pads = np.r_[tuple(here for (part, _), here in slices.items() if part == "pads")]
    most = np.linalg.norm(exact[:, pads], axis=1).max()

    def attempt(solver: Solver, rtol: float) -> dict[str, float] | None:
        f.calls = 0
        try:
            y = solver(rtol)
        except (RuntimeError, AssertionError):  # a trial state without forces, or steps of nothing
            return None
        if y.shape != exact.shape:  # given up on the way
            return None
        off, calls = np.abs(y - exact), f.calls
        return {
            "its rtol": rtol, "right-hand sides": calls,
            "wall time [s]": median(timed(lambda: solver(rtol))[1] for _ in range(config.repeats)),
            "error of place [nm]": 1e9 * float(off[:, place].max()),
            "error of forces": float(np.linalg.norm(off[:, pads], axis=1).max() / most),
        }  # fmt: skip

    ours = lambda rtol: simulate(m.rig, t, y0=y0, rtol=rtol).y.numpy()
    goal = attempt(ours, config.goal)
    assert goal is not None
    out = {"torchsoft (SDIRK2)": {**goal, "over torchsoft": 1.0}}
    every = solvers(f, y0.numpy(), t.numpy(), size)
    for name, solver in tqdm(every.items(), unit="integrator", leave=False, disable=None):
        out[name] = {}
        for rtol in RTOLS:
            one = attempt(solver, rtol)
            if one and all(one[key] <= goal[key] for key in goal if key.startswith("error")):
                over = one["wall time [s]"] / goal["wall time [s]"]
                out[name] = {**one, "over torchsoft": over}
                break
    return out


def main(config: Config) -> None:
    if config.smoke:
        config = replace(
            config, repeats=1, long_runs=2, long=0.2, short_runs=3, short=0.05,
            elements_x=(60, 120), window=5e-3,
        )  # fmt: skip
    wall, exponent = growth(config)
    found = {"batches": batches(config), "growth": {"wall_s": wall, "exponent": exponent}}
    tables = {
        "batches": numbers("batch", found["batches"], ".3g"),
        "growth": numbers("surface nodes", {f"run [s] ~ n^{exponent:.2f}": wall}, ".3g"),
    }
    if config.peers:
        found["peers"] = peers(config)
        tables["peers"] = numbers("as exact as torchsoft", found["peers"], ".3g")
    write(config, found, tables)


if __name__ == "__main__":
    main(options(Config, __doc__))
