"""Windows of motion, their loss, and the routes to its gradient, judged by central differences."""

import statistics
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchdiffeq import odeint_adjoint

from torchsoft import Parameters, Profile, Reference, SoftGrasp, press, simulate
from torchsoft.experiment import COARSE, at_the_points, timed
from torchsoft.paper.equilibrium import holding_force
from torchsoft.scenario import grasp_and_roll, reference
from torchsoft.solve.trajectory import channels

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from unrolled import unrolled_solution  # pyright: ignore[reportMissingImports]

NEWTON = 1e-10  # Newton's tolerance of every run here [N].


FLOOR = (1e-7, 1e-7, 1e-6, 1e-6, 1e-6, 1e-5, 1e-7, 1e-7, 1e-3, 1e-3)
"""Smallest scale of each signal in the loss: m, m, rad, m/s, m/s, rad/s, m, m, N, N."""


CHANNELS = ("x_C", "y_C", "theta", "v_x", "v_y", "omega", "x_Br", "y_Br", "F_x", "F_y")


INERT = ("pad.rho",)  # Parameters that massless pads do not use.


RADIUS = "disc.radius"


FINER = {RADIUS: 1e-2}  # Factors on the relative steps of central differences.


INSENSITIVE = 1e-6
"""Part of the largest p dL/dp below which the continuous adjoint's gradient is not compared in relative terms."""
Gradient = dict[str, float]


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/gradient_accuracy")
    steps: tuple[float, ...] = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 1e-6)
    """relative steps of the central differences; a hundredth of them for the radius, of which 1e-4 is two ramps"""
    full_steps: tuple[float, ...] = (3e-5, 1e-5)  # the same over the whole manipulation, where a run takes a second
    coulomb_ms: float = 0.02  # step of the runs with Coulomb's law [ms]
    coulomb_runs: int = 81  # runs over which the slope of its loss is averaged
    refinement_ms: tuple[float, ...] = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125, 0.0625)
    """steps of the convergence through slip [ms]; half the last is the reference"""
    touch_ms: tuple[float, ...] = (0.4, 0.2, 0.1, 0.05, 0.025, 0.0125)  # steps across a touch-down [ms]
    continuous_ms: float = 0.3
    """length of the continuous adjoint's sub-window, with two outputs [ms]: 14 / tau times their spacing is 0.2"""
    repeats: int = 5  # runs of which a time is the median (three for the continuous adjoint)
    duration: float = 30.0  # of the full window [s]
    only: tuple[str, ...] = ()  # scalar parameters; all of them if none is named
    changes: tuple[tuple[str, float | int], ...] = ()  # parameter overrides, a coarser mesh for instance
    smoke: bool = False  # a size that takes seconds


def smoke(config: Config) -> Config:
    """The same questions for three parameters on a coarse mesh."""
    only = ("contact.K_n", "contact.mu_s", "pad.E")
    return replace(
        config, steps=(3e-4, 1e-4, 3e-5), full_steps=(1e-4, 1e-5), coulomb_ms=0.25, coulomb_runs=17, touch_ms=(0.4, 0.1),
        continuous_ms=0.1, refinement_ms=(2.0, 1.0), repeats=1, duration=0.6, only=only,
        changes=tuple(COARSE.items()),
    )  # fmt: skip


@dataclass(frozen=True)
class Window:
    """A run whose gradient is computed: from y0 (size,) through the outputs t (T,) [s] in steps of `step` [s]."""

    name: str
    model: SoftGrasp
    y0: Tensor
    t: Tensor
    step: float


def linspace(start: float, end: float, step: float) -> Tensor:
    return torch.linspace(start, end, round((end - start) / step) + 1, dtype=torch.float64)


def states(window: Window, route: str = "discrete") -> Tensor:
    """The run (T, size), differentiable if gradients are on."""
    w = window
    if route == "unrolled":
        return unrolled_solution(w.model, w.y0, w.t, step=w.step)
    if route == "continuous":
        return odeint_adjoint(w.model, w.y0, w.t, method="dopri5", rtol=1e-8, atol=1e-11)  # pyright: ignore[reportReturnType]
    return simulate(w.model, w.t, y0=w.y0, step=w.step, tolerance=NEWTON, gradient=route).y  # pyright: ignore[reportArgumentType]


def signals(model: SoftGrasp, y: Tensor, t: Tensor) -> Tensor:
    """(T, 10): pose and velocity of the disc, pose of the bracket, control force."""
    follow = model.follow(t)
    values = channels(model, model.unpack(y, follow), follow)
    return torch.stack([values[name] for name in CHANNELS], -1)


@torch.no_grad()
def make_loss(window: Window) -> Callable[[Tensor], Tensor]:
    """The loss of the docstring as a function of the states, its constants from the nominal run."""
    model, t = window.model, window.t
    nominal = signals(model, states(window), t)
    centre, scale = nominal.mean(0), torch.maximum(nominal.std(0), torch.tensor(FLOOR, dtype=torch.float64))
    weight = (0.5 + (t - t[0]) / (t[-1] - t[0]))[:, None]

    def loss(y: Tensor) -> Tensor:
        z = (signals(model, y, t) - centre) / scale
        return (weight * (z + 0.5 * z**2)).mean()

    return loss


def scalars(model: SoftGrasp, config: Config) -> dict[str, Tensor]:
    """The trained scalar parameters, called as in `Parameters`."""
    own = dict(model.named_parameters())
    every = {name: own[path] for name, path in model.aliases.items() if path in own and name not in INERT}
    chosen = {name: p for name, p in every.items() if not config.only or name in config.only}
    return {name: p for name, p in chosen.items() if p.requires_grad}


def collect(model: SoftGrasp, names: Iterable[str]) -> Gradient:
    """The parameters' gradients, taken away from them."""
    out = {n: 0.0 if (g := model.parameter(n).grad) is None else g.item() for n in names}
    model.zero_grad(set_to_none=True)
    return out


def richardson(values: list[float], steps: tuple[float, ...]) -> tuple[float, float]:
    """Plateau and uncertainty of central differences at falling steps: median and spread of the three neighbouring
    extrapolations that agree best; with fewer, the last one and how far the two last values are apart."""
    ratios = [(a / b) ** 2 for a, b in pairwise(steps)]
    better = [b + (b - a) / (r - 1) for a, b, r in zip(values, values[1:], ratios)]
    if len(better) < 3:
        found = better if len(better) > 1 else values
        return better[-1], abs(found[-1] - found[0])
    triples = [sorted(better[k : k + 3]) for k in range(len(better) - 2)]
    low, middle, high = min(triples, key=lambda x: x[2] - x[0])
    return middle, high - low


@torch.no_grad()
def central_differences(
    window: Window, loss: Callable[[Tensor], Tensor], config: Config, steps: tuple[float, ...]
) -> tuple[Gradient, Gradient, dict[str, list[float]]]:
    """dL/dp by central differences, the judge's uncertainty, and the values at every relative step."""
    value, unsure, at = {}, {}, {}
    for name, p in scalars(window.model, config).items():
        keep, at[name] = p.clone(), []
        for relative in steps:
            ends = [keep * (1 + sign * relative * FINER.get(name, 1.0)) for sign in (1, -1)]
            got = []
            for end in ends:
                p.copy_(end)
                got.append(loss(states(window)).item())
            at[name].append((got[0] - got[1]) / (ends[0] - ends[1]).item())
        p.copy_(keep)
        value[name], unsure[name] = richardson(at[name], steps)
    return value, unsure, at


def relative_errors(got: Gradient, judge: Gradient, floor: Gradient | None = None) -> Gradient:
    """|got - judge| / max(|judge|, floor); a gradient that both call exactly zero has no error."""
    size = {n: max(abs(x), floor[n] if floor else 0.0) for n, x in judge.items()}
    return {n: 0.0 if got[n] == x else abs(got[n] - x) / size[n] if size[n] else float("inf") for n, x in judge.items()}


def by_backward(
    window: Window, loss: Callable[[Tensor], Tensor], run: Callable[[], Tensor], config: Config
) -> tuple[Gradient, dict[str, float]]:
    """Gradient of a route that is a forward run and a backward pass, and its median times over its own plain run."""
    seconds: list[tuple[float, float, float]] = []
    gradient: Gradient = {}
    for _ in range(config.repeats):
        with torch.no_grad():
            _, plain = timed(run)
        value, forward = timed(lambda: loss(run()))
        _, backward = timed(value.backward)
        gradient = collect(window.model, scalars(window.model, config))
        seconds.append((plain, backward, forward + backward))
    plain, backward, total = (statistics.median(x) for x in zip(*seconds))
    return gradient, {"forward_s": plain, "gradient": backward / plain, "total": total / plain}


def by_sensitivities(
    window: Window, loss: Callable[[Tensor], Tensor], config: Config
) -> tuple[Gradient, dict[str, float]]:
    """Gradient by forward sensitivities of all parameters at once, and its median times over the plain run."""
    chosen, seconds = scalars(window.model, config), []
    gradient: Gradient = {}
    for _ in range(config.repeats):
        with torch.no_grad():
            _, plain = timed(lambda: states(window))

        def contract() -> Tensor:
            run = simulate(
                window.model,
                window.t,
                y0=window.y0,
                step=window.step,
                tolerance=NEWTON,
                gradient="forward",
                wrt=list(chosen),
            )
            assert run.sensitivities is not None
            y = run.y.clone().requires_grad_(True)
            y_bar, *direct = torch.autograd.grad(loss(y), (y, *chosen.values()), allow_unused=True)
            explicit = torch.stack([torch.zeros_like(y_bar[0, 0]) if g is None else g for g in direct])
            return torch.einsum("ti,tin->n", y_bar, run.sensitivities) + explicit

        total, spent = timed(contract)
        gradient = dict(zip(chosen, total.tolist()))
        seconds.append((plain, spent - plain, spent))
    plain, extra, spent = (statistics.median(x) for x in zip(*seconds))
    return gradient, {"forward_s": plain, "gradient": extra / plain, "total": spent / plain}


@torch.no_grad()
def events(window: Window, y: Tensor) -> dict[str, Any]:
    """Nodes that touch, leave, slip and begin to slip between the outputs, and the first row with such an event."""
    parts = [at_the_points(window.model, window.t[rows], y[rows]) for rows in torch.arange(len(y)).split(200)]
    depth, speed = (torch.cat(part) for part in zip(*parts))
    on = depth > 0
    slipping = (speed > 0) & on
    touch, leave, onset = on[1:] & ~on[:-1], on[:-1] & ~on[1:], slipping[1:] & ~slipping[:-1]
    first = (touch | leave | onset).any(1).nonzero()[:, 0]
    return {
        "steps": len(y) - 1,
        "touching": on.sum(1).max().item(),
        "touch": touch.sum().item(),
        "leave": leave.sum().item(),
        "slipping": slipping.any(0).sum().item(),
        "slip_onsets": onset.sum().item(),
        "fastest_slip_mm_s": 1e3 * (speed * on).max().item(),
        "first_row": first[0].item() if len(first) else 0,
        "slip_rows": onset.any(1).nonzero()[:, 0].tolist(),
        "touch_rows": touch.any(1).nonzero()[:, 0].tolist(),
    }


def stroke(config: Config, end: float, step: float, changes: dict[str, Any], every: float | None = None) -> Window:
    """A 2 mm stroke in 20 ms out of a frictionless grasp, with little friction: nodes break away one after another."""
    slippery = {"contact.v_s": 0.05, "contact.mu_s": 0.3, "contact.mu_k": 0.2}
    model = SoftGrasp(Parameters().override({**slippery, **dict(config.changes), **changes}))
    y0 = press(model, height := model.settings.scenario.y_Br_grasp).detach()
    load = -holding_force(model, y0)
    x = model.unpack(y0).pose["disc"][0].item()
    model.reference = Reference(
        x_d=Profile([0.0, 0.02], [x, x - 2e-3]), y_d=Profile([0.0], [height]), F_ff=Profile([0.0], [load])
    )
    return Window("slip", model, y0, linspace(0.0, end, every or step), step)


def windows(config: Config) -> list[Window]:
    """The five windows."""
    model = SoftGrasp(Parameters().override(dict(config.changes)))
    manipulation = grasp_and_roll(model, grasp_force=75.0 if config.smoke else None)
    roll = 0.5 if config.smoke else 4.5
    with torch.no_grad():
        path = states(Window("path", model, manipulation.y0, linspace(0.0, roll, 0.01), 2e-3))
    above = manipulation.y0.clone()
    above[model.layout.slices["pose", "bracket"].stop - 1] += 2e-5
    lowered = SoftGrasp(model.settings)
    lowered.reference = reference(lowered, above, manipulation.grasp_force)
    stick, grasp = (0.01, 0.2) if config.smoke else (0.05, 0.4)
    early = 0.5 if config.smoke else 0.6
    out = [
        Window("stick", model, path[round(100 * early)], linspace(early, early + stick, 1e-3), 1e-3),
        stroke(config, 6e-3, 2.5e-4, {}),
        Window("make-break", model, path[-1], linspace(roll, roll + (0.05 if config.smoke else 0.5), 2e-3), 2e-3),
        Window("grasp", lowered, above, linspace(0.0, grasp, 2e-3), 2e-3),
    ]
    return [*out, Window("full", model, manipulation.y0, linspace(0.0, config.duration, 0.01), 2e-3)]


def judge_window(window: Window, config: Config, bar: Any) -> dict[str, Any]:
    """Errors and costs of the routes over one window, the slow routes over the few steps about its first event."""
    full = window.name == "full"
    loss = make_loss(window)
    with torch.no_grad():
        y = states(window)
    found = events(window, y)
    judge, unsure, _ = central_differences(window, loss, config, config.full_steps if full else config.steps)
    bar.update()
    gradients, costs = {}, {}
    gradients["discrete"], costs["discrete"] = by_backward(window, loss, lambda: states(window), config)
    gradients["forward"], costs["forward"] = by_sensitivities(window, loss, config)
    bar.update()
    out: dict[str, Any] = {
        "events": found,
        "gradient": judge,
        "judge_uncertainty": {n: unsure[n] / abs(x) if x else 0.0 for n, x in judge.items()},
        "relative_error": {route: relative_errors(g, judge) for route, g in gradients.items()},
        "discrete_against_forward": relative_errors(gradients["forward"], gradients["discrete"]),
        "cost_ratio": costs,
    }
    if full or (config.smoke and window.name != "slip"):
        return out
    begin = max(0, min(found["first_row"] - 1, len(window.t) - 4))
    part = replace(window, y0=y[begin].clone(), t=window.t[begin : begin + 4])
    loss = make_loss(part)
    with torch.no_grad():
        out["sub_window_events"] = events(part, states(part))
    judge, unsure, _ = central_differences(part, loss, config, config.steps)
    out["judge_uncertainty_sub_window"] = {n: unsure[n] / abs(x) if x else 0.0 for n, x in judge.items()}
    exact, _ = by_backward(part, loss, lambda: states(part), config)
    got, costs["unrolled"] = by_backward(part, loss, lambda: states(part, "unrolled"), config)
    out["relative_error"]["unrolled"] = relative_errors(got, judge)
    out["unrolled_against_discrete"] = relative_errors(got, exact)
    bar.update()
    with torch.no_grad():
        start = states(part)[1 if begin else 0].clone()
    t = part.t[1 if begin else 0] + 1e-3 * linspace(0.0, config.continuous_ms, config.continuous_ms / 2)
    fine = replace(part, y0=start, t=t, step=1e-6)
    loss = make_loss(fine)
    exact, _ = by_backward(fine, loss, lambda: states(fine), replace(config, repeats=1))

    few = replace(config, repeats=min(config.repeats, 3))
    got, costs["continuous"] = by_backward(fine, loss, lambda: states(fine, "continuous"), few)
    values = {n: p.item() for n, p in scalars(fine.model, config).items()}
    largest = max(abs(values[n] * x) for n, x in exact.items())
    floor = {n: INSENSITIVE * largest / value for n, value in values.items()}
    out["relative_error"]["continuous"] = relative_errors(got, exact, floor)
    with torch.no_grad():
        out["continuous_events"] = events(fine, states(fine))
    bar.update()
    return out
