"""The same equations under other integrators, each at its best and equally exact, over a window in mid-roll.

All of them call the compiled right-hand side (`torchsoft.solve.rates`), which takes tens of microseconds, and get absolute
tolerances of the size of every part of the state. Every method is run by a series of tolerances, from loose to tight, until it
is as exact as the stepper, in the disc's place and in the nodal forces, at all outputs; that run is timed. What `simulate` does
before its first step and after its last counts for the stepper (its steps alone are in a row of their own); what the others
compile, and making the right-hand side, does not count for them. Implicit methods difference their Jacobians, those of diffrax
through a derivative rule of the callback; with the laws rewritten in JAX they would have them exactly.
"""

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

import numpy as np
import torch
from _benchmark_common import Config, prepare
from scipy.integrate import odeint, solve_ivp
from torch import Tensor
from tqdm import tqdm

from torchsoft import SoftGrasp, simulate
from torchsoft.experiment import markdown, timed
from torchsoft.solve.kernel.arrays import Array
from torchsoft.solve.rates import Rates

BEGIN = 2.0
"""Where the window begins [s]."""

RTOLS = tuple(10.0**-n for n in range(2, 9))
"""Tolerances tried, from 1e-2 to 1e-8."""

OURS = "torchsoft (SDIRK2)"


@dataclass(frozen=True)
class Attempt:
    """One method at one tolerance: wall time of the window [s], right-hand sides, largest errors."""

    method: str
    rtol: float
    wall_s: float
    calls: int
    position_nm: float
    force: float  # over the largest


class Window:
    """The piece of the roll: start, output times, sizes of the state's components, the exact states, the right-hand side."""

    def __init__(self, config: Config) -> None:
        m = prepare()
        self.model: SoftGrasp = m.model
        to_begin = torch.tensor([0.0, BEGIN], dtype=torch.float64)
        self.y0: Tensor = simulate(self.model, to_begin, y0=m.y0, rtol=1e-6).y[-1]
        self.t = torch.linspace(BEGIN, BEGIN + config.window, 11, dtype=torch.float64)
        self.exact: Array = simulate(self.model, self.t, y0=self.y0, rtol=1e-8).y.numpy()
        slices = self.model.layout.slices
        self.size = np.ones(self.model.layout.size)
        for (part, _), here in slices.items():
            values = self.exact[:, here] - (self.exact[0, here] if part == "pose" else 0.0)
            self.size[here] = np.abs(values).max()
        self.place = slices["pose", "disc"].start + np.arange(2)
        self.pads = np.concatenate([np.arange(s.start, s.stop) for (part, _), s in slices.items() if part == "pads"])
        self.f = Rates(self.model)

    def attempt(self, method: str, rtol: float, solve: Callable[[], Array], repeats: int) -> Attempt:
        """Run and time one method; repeated runs are timed after the first."""
        self.f.calls = 0
        try:
            y, first = timed(solve)
        except (RuntimeError, AssertionError):  # a trial state without forces, or steps that underflow
            return Attempt(method, rtol, np.inf, self.f.calls, np.inf, np.inf)
        if y.shape != self.exact.shape:  # given up on the way
            return Attempt(method, rtol, first, self.f.calls, np.inf, np.inf)
        calls = self.f.calls
        walls = [timed(solve)[1] for _ in range(repeats)] or [first]
        position = 1e9 * float(np.abs(y - self.exact)[:, self.place].max())
        off = np.linalg.norm((y - self.exact)[:, self.pads], axis=1).max()
        force = float(off / np.linalg.norm(self.exact[:, self.pads], axis=1).max())
        return Attempt(method, rtol, median(walls), calls, position, force)


Solver = Callable[[float], Callable[[], Array]]
"""A method: the integration (T, size) at a relative tolerance."""


def scipy_solvers(w: Window) -> dict[str, Solver]:
    """scipy's own: LSODA by its Fortran loop, the others by `solve_ivp`; they difference the Jacobian themselves."""
    y0, t = w.y0.numpy(), w.t.numpy()

    def lsoda(rtol: float) -> Callable[[], Array]:
        return lambda: odeint(w.f, y0, t, tfirst=True, rtol=rtol, atol=rtol * w.size, mxstep=100_000)

    def ivp(method: str) -> Solver:
        return lambda rtol: (
            lambda: solve_ivp(w.f, (t[0], t[-1]), y0, method=method, t_eval=t, rtol=rtol, atol=rtol * w.size).y.T
        )

    return {"scipy LSODA": lsoda} | {f"scipy {name}": ivp(name) for name in ("BDF", "Radau", "RK23", "RK45")}


def torchdiffeq_solvers(w: Window) -> dict[str, Solver]:
    """torchdiffeq's explicit methods on the compiled right-hand side; it has no adaptive implicit one."""
    from torchdiffeq import odeint as integrate

    def f(t: Tensor, y: Tensor) -> Tensor:
        return torch.from_numpy(w.f(float(t), y.numpy()))

    def solver(method: str) -> Solver:
        size = torch.from_numpy(w.size)

        def at(rtol: float) -> Callable[[], Array]:
            def solve() -> Array:
                out = integrate(f, w.y0, w.t, rtol=rtol, atol=rtol * size, method=method)  # pyright: ignore
                assert isinstance(out, Tensor)
                return out.numpy()

            return solve

        return at

    return {f"torchdiffeq {name}": solver(name) for name in ("adaptive_heun", "bosh3", "dopri5")}


def diffrax_solvers(w: Window) -> dict[str, Solver]:
    """diffrax's, jitted, with the right-hand side as a callback; implicit ones get its directional differences."""
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    import diffrax  # pyright: ignore[reportMissingImports]
    import jax  # pyright: ignore[reportMissingImports]

    jax.config.update("jax_enable_x64", True)
    shape, size = jax.ShapeDtypeStruct(w.size.shape, np.float64), jax.numpy.asarray(w.size)

    def called(t: Any, y: Any) -> Array:
        return w.f(float(t), np.asarray(y))

    base: dict[bytes, Array] = {}

    def differenced(t: Any, y: Any, direction: Any) -> Array:
        y, v, time = np.asarray(y), np.asarray(direction), float(t)
        length = np.abs(v / w.size).max()
        if length == 0.0:
            return np.zeros_like(v)
        key = np.float64(time).tobytes() + y.tobytes()
        if key not in base:  # one for all columns of a Jacobian
            base.clear()
            base[key] = w.f(time, y)
        part = 1e-7 / length
        return (w.f(time, y + part * v) - base[key]) / part

    @jax.custom_jvp
    def rhs(t: Any, y: Any) -> Any:
        return jax.pure_callback(called, shape, t, y, vmap_method="sequential")

    @rhs.defjvp
    def _(at: Any, directions: Any) -> Any:
        (t, y), (_, v) = at, directions
        return rhs(t, y), jax.pure_callback(differenced, shape, t, y, v, vmap_method="sequential")

    term, t, y0 = diffrax.ODETerm(lambda t, y, _: rhs(t, y)), w.t.numpy(), jax.numpy.asarray(w.y0.numpy())

    def solver(make: Any) -> Solver:
        @jax.jit
        def integrate(y: Any, rtol: Any) -> Any:
            control = diffrax.PIDController(rtol=rtol, atol=rtol * size)
            saved = diffrax.SaveAt(ts=jax.numpy.asarray(t))
            return diffrax.diffeqsolve(
                term, make(), t[0], t[-1], 1e-4, y, saveat=saved, stepsize_controller=control, max_steps=100_000
            ).ys

        return lambda rtol: lambda: np.asarray(integrate(y0, rtol))

    made = [diffrax.Heun, diffrax.Bosh3, diffrax.Tsit5, diffrax.Kvaerno3]
    return {f"diffrax {one.__name__}": solver(one) for one in made}


def peers(config: Config) -> dict[str, Any]:
    """For each of the stepper's tolerances every method at its loosest tolerance that is as exact."""
    w, repeats = Window(config), min(config.repeats, 3)
    stepping: dict[float, list[float]] = {}

    def ours(rtol: float) -> Callable[[], Array]:
        def solve() -> Array:
            run = simulate(w.model, w.t, y0=w.y0, rtol=rtol)
            stepping.setdefault(rtol, []).append(run.stats.wall_s)
            return run.y.numpy()

        return solve

    solvers = scipy_solvers(w) | torchdiffeq_solvers(w) | diffrax_solvers(w)
    goals = {rtol: w.attempt(OURS, rtol, ours(rtol), max(repeats, 9)) for rtol in config.rtols}
    hardest, attempts = goals[min(goals)], dict[str, list[Attempt]]()
    for name, solver in tqdm(solvers.items(), unit="integrator", leave=False):
        attempts[name] = []
        for rtol in RTOLS[:: 2 if config.smoke else 1]:
            attempts[name].append(w.attempt(name, rtol, solver(rtol), 0))
            if as_exact(attempts[name][-1], hardest):
                break
    out: dict[str, Any] = {"window_s": config.window, "begin_s": BEGIN, "equal": {}}
    for rtol, goal in goals.items():
        rows: dict[str, Any] = {OURS: described(goal, goal, config) | {"stepping_s": median(stepping[rtol][1:])}}
        for name, some in attempts.items():
            rows[name] = None
            for found in (one for one in some if as_exact(one, goal)):  # timed again, it has to be as exact again
                again = w.attempt(name, found.rtol, solvers[name](found.rtol), repeats if found.wall_s < 2 else 1)
                if as_exact(again, goal):
                    rows[name] = described(again, goal, config)
                    break
        out["equal"][f"rtol = {rtol:g}"] = rows
    out["attempts"] = {name: [asdict(one) for one in some] for name, some in attempts.items()}
    out["right_hand_side_us"] = 1e6 * call_time(w)
    return out


def described(one: Attempt, goal: Attempt, config: Config) -> dict[str, Any]:
    """An attempt beside the stepper's."""
    over = {"wall_per_simulated": one.wall_s / config.window, "over_torchsoft": one.wall_s / goal.wall_s}
    return asdict(one) | over


def as_exact(one: Attempt, goal: Attempt) -> bool:
    return one.position_nm <= goal.position_nm and one.force <= goal.force


def call_time(w: Window) -> float:
    """Wall time of one right-hand side [s] at states along the window."""
    states = [y + 1e-6 * w.size * (-1) ** i for i, y in enumerate(np.repeat(w.exact, 20, axis=0))]
    return median(timed(lambda: [w.f(BEGIN, y) for y in states])[1] / len(states) for _ in range(5))


def peers_table(numbers: dict[str, Any]) -> str:
    """One table for every accuracy."""
    head = (
        "integrator", "its rtol", "wall time [s] per simulated s", "over torchsoft", "right-hand sides",
        "error of place [nm]", "error of forces [1]",
    )  # fmt: skip
    steps = f"{OURS}, steps alone"
    out = []
    for way, rows in numbers["equal"].items():
        lines = [
            (
                name, f"{one['rtol']:.2g}", f"{one['wall_per_simulated']:.3g}", f"{one['over_torchsoft']:.3g}",
                one["calls"] if name != OURS else "", f"{one['position_nm']:.2g}", f"{one['force']:.1e}",
            ) if one is not None else (name, "", "not reached", "", "", "", "")
            for name, one in rows.items()
        ]  # fmt: skip
        ours = rows[OURS]
        alone = ours["stepping_s"] / numbers["window_s"], ours["stepping_s"] / ours["wall_s"]
        lines.insert(1, (steps, "", f"{alone[0]:.3g}", f"{alone[1]:.3g}", "", "", ""))
        out.append(f"As exact as torchsoft at {way}\n\n{markdown(head, lines)}")
    return "\n\n".join(out)
