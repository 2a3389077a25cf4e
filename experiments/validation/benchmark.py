"""Question: what do a run, its gradient, its Jacobian and batches cost, how do they grow, and
against what?

All in one process and one run, medians of repeated timings in turns, so that the ratios hold on a
noisy machine:

- the 30 s manipulation by two tolerances and by equal steps; errors against a run at rtol 1e-7;
- over the run the sweep for the gradient of all parameters, and what the Jacobian for 8 adds;
- 64 trajectories of 4 s and 1,000 of 0.3 s with parameters of their own, on one and two threads;
- growth with the surface nodes, with a fitted exponent;
- with `--peers` the same equations under scipy's, torchdiffeq's and diffrax's integrators over a
  window in mid-roll. All call the compiled right-hand side (`torchsoft.solve.system`). Every method
  is run by a series of tolerances, from loose to tight, until it is as exact as the stepper, in the
  disc's place and in the nodal forces; that run is timed, without compiling.

Command: .venv/bin/python experiments/validation/benchmark.py [--peers] [--smoke]
Expected: the sweep at most 0.6 of a run and the Jacobian at most 2 by tolerances, more by equal
steps; forces need rtol 1e-4 to be as exact as by 2 ms. About five minutes, three more with
`--peers`.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.integrate import solve_ivp
from step_accuracy import EIGHT, errors
from torch import Tensor
from tqdm import tqdm

from torchsoft import BuiltRig, Rig, RigFile, simulate, simulate_batch
from torchsoft.experiment import grid, markdown, numbers, options, timed, write
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.system import Rates

T = TypeVar("T")


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
    peers: bool = (
        False  # the same equations under other integrators; needs `pip install torchsoft[peers]`
    )
    window: float = 0.1  # simulated time that the other integrators get, in mid-roll [s]
    smoke: bool = False  # a size that takes seconds


def prepare(elements_x: int = 120) -> BuiltRig:
    """The manipulation on a mesh of so many elements."""
    mesh = {"pad.elements_x": elements_x, "pad.elements_y": elements_x // 30}
    return RigFile.ready("paper").override(mesh).build()


def ways(config: Config) -> dict[str, dict[str, Any]]:
    """How steps are chosen: by tolerances, and equal ones."""
    equal = {f"step = {1e3 * config.step:g} ms": {"step": config.step}}
    return {f"rtol = {rtol:g}": {"rtol": rtol} for rtol in config.rtols} | equal


def tasks(
    m: BuiltRig, t: torch.Tensor, steps: Mapping[str, Any]
) -> dict[str, Callable[[], object]]:
    """The run, the run with its gradient by all parameters, the run with its Jacobian by eight."""

    def gradient() -> None:
        m.rig.zero_grad()
        run = m.run(t, gradient="discrete", **steps)
        (run["theta_C"].square().sum() + 1e3 * run.together("x_C", "y_C").square().sum()).backward()

    return {
        "run": lambda: m.run(t, **steps),
        "gradient": gradient,
        "jacobian": lambda: m.run(t, gradient="forward", wrt=EIGHT, rigid=True, **steps),
    }


def interleaved(tasks: Mapping[str, Callable[[], T]], repeats: int) -> dict[str, list[T]]:
    """What each task returns, so many times in turns after one warm-up each: noise that comes and
    goes hits them all."""
    for task in tasks.values():
        task()
    out: dict[str, list[T]] = {name: [] for name in tasks}
    for _ in range(repeats):
        for name, task in tasks.items():
            out[name].append(task())
    return out


def batch(
    m: BuiltRig, config: Config, count: int, duration: float, threads: int
) -> tuple[int, float]:
    """Failures and wall time [s] of a batch in which every run has its own stiffness, dashpot and
    retardation time, up to 20 % to either side of the model's."""
    part, t = torch.linspace(0.8, 1.2, count, dtype=torch.float64), grid(duration)
    own = {
        name: m.rig.parameter(name).detach() * part.roll(i * count // 3)
        for i, name in enumerate(("contact.K_n", "contact.R_t", "pad.tau"))
    }
    run, wall = timed(
        lambda: simulate_batch(
            m.rig, t, y0=m.y0, parameters=own, threads=threads, rtol=config.rtols[0]
        )
    )
    return len(run.failures), wall


def batches(config: Config) -> dict[str, dict[str, float]]:
    """Simulated seconds per wall second of long and of short runs on one and two threads."""
    m, out = prepare(), dict[str, dict[str, float]]()
    sizes = [
        (config.trajectories, config.batch_duration),
        (config.short_runs, config.short_duration),
    ]
    cases = [(*size, threads) for size in sizes for threads in (1, 2)]
    every = interleaved(
        {str(case): partial(batch, m, config, *case) for case in cases}, max(1, config.repeats // 2)
    )
    for (count, duration, threads), some in zip(cases, every.values()):
        wall = median(seconds for _, seconds in some)
        out[f"{count} runs of {duration:g} s, {threads} threads"] = {
            "wall time [s]": wall, "simulated s per wall s": count * duration / wall,
            "failures": max(failures for failures, _ in some),
        }  # fmt: skip
    return out


def growth(config: Config) -> dict[str, Any]:
    """Median wall times [s] of a run by the surface nodes of a pad, at the loosest tolerance, and
    the slope of their logarithms by least squares."""

    def run(elements_x: int) -> Callable[[], float]:
        m, t = prepare(elements_x), grid(config.batch_duration)
        return lambda: timed(lambda: m.run(t, rtol=config.rtols[0]))[1]

    times = interleaved({str(n + 1): run(n) for n in config.elements_x}, min(config.repeats, 3))
    wall = {nodes: median(some) for nodes, some in times.items()}
    nodes, seconds = np.log(list(map(float, wall))), np.log(list(wall.values()))
    return {"wall_s": wall, "exponent": float(np.polyfit(nodes, seconds, 1)[0])}


BEGIN = 2.0  # Where the window of the other integrators begins [s].
RTOLS = tuple(10.0**-n for n in range(2, 9))  # Tolerances tried.
OURS = "torchsoft (SDIRK2)"


@dataclass(frozen=True)
class Attempt:
    """One method at one tolerance: wall time of the window [s], right-hand sides, largest errors of
    the disc's place [nm] and of the forces, over the largest."""

    method: str
    rtol: float
    wall_s: float
    calls: int
    position_nm: float
    force: float

    def as_exact(self, goal: "Attempt") -> bool:
        return self.position_nm <= goal.position_nm and self.force <= goal.force


Solver = Callable[[float], Array]
"""A method: the integration (T, size) at a relative tolerance."""


class Window:
    """The piece of the roll: start, output times, sizes of the state's components, the exact
    states, the right-hand side."""

    def __init__(self, config: Config) -> None:
        m = prepare()
        self.model: Rig = m.rig
        self.y0: Tensor = m.run([0.0, BEGIN], rtol=1e-6).y[-1]
        self.t = torch.linspace(BEGIN, BEGIN + config.window, 11, dtype=torch.float64)
        self.exact: Array = simulate(self.model, self.t, y0=self.y0, rtol=1e-8).y.numpy()
        slices = self.model.layout.slices
        self.size = np.ones(self.model.layout.size)
        for (part, _), here in slices.items():
            values = self.exact[:, here] - (self.exact[0, here] if part == "pose" else 0.0)
            self.size[here] = np.abs(values).max()
        self.place = slices["pose", "disc"].start + np.arange(2)
        self.pads = np.concatenate(
            [np.arange(s.start, s.stop) for (part, _), s in slices.items() if part == "pads"]
        )
        self.f = Rates(self.model)

    def attempt(self, method: str, rtol: float, solver: Solver, repeats: int) -> Attempt:
        """Run and time one method, in the first run with what it compiles."""
        self.f.calls, failed = 0, Attempt(method, rtol, np.inf, 0, np.inf, np.inf)
        try:
            y = solver(rtol)
        except (RuntimeError, AssertionError):  # a trial state without forces, or steps of nothing
            return failed
        if y.shape != self.exact.shape:  # given up on the way
            return failed
        calls, wall = self.f.calls, median(timed(partial(solver, rtol))[1] for _ in range(repeats))
        off = np.abs(y - self.exact)
        largest = np.linalg.norm(self.exact[:, self.pads], axis=1).max()
        force = float(np.linalg.norm(off[:, self.pads], axis=1).max() / largest)
        return Attempt(method, rtol, wall, calls, 1e9 * float(off[:, self.place].max()), force)


def scipy_solvers(w: Window) -> dict[str, Solver]:
    """scipy's own, which difference the Jacobian themselves."""
    y0, t = w.y0.numpy(), w.t.numpy()

    def solver(method: str) -> Solver:
        options: dict[str, Any] = {"method": method, "t_eval": t}
        return lambda rtol: (
            solve_ivp(w.f, (t[0], t[-1]), y0, rtol=rtol, atol=rtol * w.size, **options).y.T
        )

    return {f"scipy {name}": solver(name) for name in ("LSODA", "BDF", "Radau", "RK23", "RK45")}


def torchdiffeq_solvers(w: Window) -> dict[str, Solver]:
    """torchdiffeq's explicit methods; it has no adaptive implicit one."""
    from torchdiffeq import odeint

    def f(t: Tensor, y: Tensor) -> Tensor:
        return torch.from_numpy(w.f(float(t), y.numpy()))

    def solver(method: str) -> Solver:
        def solve(rtol: float) -> Array:
            atol: Any = rtol * torch.from_numpy(w.size)
            out: Any = odeint(f, w.y0, w.t, rtol=rtol, atol=atol, method=method)
            return out.numpy()

        return solve

    return {f"torchdiffeq {name}": solver(name) for name in ("adaptive_heun", "bosh3", "dopri5")}


def diffrax_solvers(w: Window) -> dict[str, Solver]:
    """diffrax's explicit methods, jitted, with the right-hand side as a callback."""
    os.environ.setdefault(
        "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    )
    import diffrax  # pyright: ignore[reportMissingImports]
    import jax  # pyright: ignore[reportMissingImports]

    jax.config.update("jax_enable_x64", True)
    shape, t = jax.ShapeDtypeStruct(w.size.shape, np.float64), w.t.numpy()

    def f(t: Any, y: Any, _: Any) -> Any:
        call = lambda t, y: w.f(float(t), np.asarray(y))
        return jax.pure_callback(call, shape, t, y, vmap_method="sequential")

    def solver(method: Any) -> Solver:
        @jax.jit
        def integrate(y: Any, rtol: Any) -> Any:
            return diffrax.diffeqsolve(
                diffrax.ODETerm(f), method(), t[0], t[-1], 1e-4, y, max_steps=100_000,
                saveat=diffrax.SaveAt(ts=t),
                stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol * w.size),
            ).ys  # fmt: skip

        return lambda rtol: np.asarray(integrate(w.y0.numpy(), rtol))

    made = [diffrax.Heun, diffrax.Bosh3, diffrax.Tsit5]
    return {f"diffrax {one.__name__}": solver(one) for one in made}


def peers(config: Config) -> dict[str, Any]:
    """For each of the stepper's tolerances every method at its loosest tolerance that is as
    exact."""
    w, repeats = Window(config), min(config.repeats, 3)
    solvers = scipy_solvers(w) | torchdiffeq_solvers(w) | diffrax_solvers(w)

    def ours(rtol: float) -> Array:
        return simulate(w.model, w.t, y0=w.y0, rtol=rtol).y.numpy()

    goals = {rtol: w.attempt(OURS, rtol, ours, 9) for rtol in config.rtols}
    hardest, attempts = goals[min(goals)], dict[str, list[Attempt]]()
    for name, solver in tqdm(solvers.items(), unit="integrator", leave=False, disable=None):
        attempts[name] = []
        for rtol in RTOLS[:: 2 if config.smoke else 1]:
            attempts[name].append(w.attempt(name, rtol, solver, repeats))
            if attempts[name][-1].as_exact(hardest):
                break
    out: dict[str, Any] = {"window_s": config.window, "begin_s": BEGIN, "equal": {}}
    for rtol, goal in goals.items():
        rows = {name: next((one for one in some if one.as_exact(goal)), None)
                for name, some in ({OURS: [goal]} | attempts).items()}  # fmt: skip
        out["equal"][f"rtol = {rtol:g}"] = {
            name: one and asdict(one) | {
                "wall_per_simulated": one.wall_s / config.window,
                "over_torchsoft": one.wall_s / goal.wall_s,
            }
            for name, one in rows.items()
        }  # fmt: skip
    return out


def peers_table(found: dict[str, Any]) -> str:
    """One table for every accuracy."""
    head = (
        "integrator", "its rtol", "wall time [s] per simulated s", "over torchsoft",
        "right-hand sides", "error of place [nm]", "error of forces [1]",
    )  # fmt: skip
    keys = ("rtol", "wall_per_simulated", "over_torchsoft", "calls", "position_nm", "force")
    out = []
    for way, rows in found["equal"].items():
        lines = [
            (name, *(f"{one[key]:.3g}" if one else "not reached" for key in keys))
            for name, one in rows.items()
        ]
        out.append(f"As exact as torchsoft at {way}\n\n{markdown(head, lines)}")
    return "\n\n".join(out)


def costs(config: Config) -> dict[str, Any]:
    """Times of the three tasks by every way, with errors."""
    m, t = prepare(), grid(config.duration)
    exact = m.run(t, rtol=config.exact)
    times = interleaved(
        {
            f"{way}, {name}": lambda task=task: timed(task)[1]
            for way, steps in ways(config).items()
            for name, task in tasks(m, t, steps).items()
        },
        config.repeats,
    )
    out: dict[str, Any] = {}
    for way, steps in ways(config).items():
        one = m.run(t, **steps)
        run, gradient, jacobian = (
            median(times[f"{way}, {name}"]) for name in ("run", "gradient", "jacobian")
        )
        out[way] = {
            "run [s]": run, "steps": one.stats.steps, "solves": one.stats.newton_iterations,
            **errors(one, exact), "gradient over run": gradient / run - 1,
            "Jacobian for 8 over run": jacobian / run - 1,
        }  # fmt: skip
    return out


def run(config: Config) -> dict[str, Any]:
    if config.smoke:
        config = replace(
            config, duration=0.5, exact=1e-5, repeats=1, trajectories=2, batch_duration=0.2,
            short_runs=3, short_duration=0.05, elements_x=(60, 120), window=5e-3,
        )  # fmt: skip
    parts: dict[str, Callable[[Config], Any]] = {
        "costs": costs, "batches": batches, "growth": growth,
    }  # fmt: skip
    parts |= {"peers": peers} if config.peers else {}
    return {name: part(config) for name, part in tqdm(parts.items(), unit="part", disable=None)}


def tables(found: dict[str, Any]) -> str:
    """All tables."""
    grown = found["growth"]
    parts = [
        numbers("steps by; errors over the range", found["costs"], 2),
        numbers("batch", found["batches"], 3),
        numbers("run by surface nodes [s]", {f"~ n^{grown['exponent']:.2f}": grown["wall_s"]}, 3),
    ]
    return "\n\n".join([*parts, peers_table(found["peers"])] if "peers" in found else parts)


def main(config: Config) -> None:
    found = run(config)
    write(config, found, table=tables(found))


if __name__ == "__main__":
    main(options(Config, __doc__))
