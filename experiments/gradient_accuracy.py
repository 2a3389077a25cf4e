"""Question: how exact are the four routes to a gradient, in every contact mode, and what do they cost?

The loss over a window of outputs t_k is L = mean over k and i of (1/2 + (t_k - t_0)/(t_T - t_0)) (z_ki + z_ki^2 / 2), with
z = (q - mean q) / std q of the nominal run, constants both, and q = (x_C, y_C, theta, v_C, omega, x_Br, y_Br, F_x, F_y).
dL/dp for every scalar parameter p comes from
  discrete     the discrete adjoint of the implicit stepper,
  forward      forward sensitivities of the same steps, contracted with dL/dy,
  unrolled     backpropagation through the plain torch step,
  continuous   `torchdiffeq.odeint_adjoint` with rk4 (25 us) on the right-hand side,
and is judged by central differences D(d) = (L(p + d) - L(p - d)) / 2d of the stepper at a Newton tolerance of 1e-10 N. Each
neighbouring pair of relative steps d gives a Richardson value; the three in a row that agree best are the plateau, and their
spread is the judge's own uncertainty. No gradient is looked at to choose the step.

Windows: `stick` (gentle rolling in the grasp), `slip` (a 2 mm stroke in 20 ms with mu_s = 0.3, mu_k = 0.2, v_s = 50 mm/s),
`make-break` (rolling at 4.4 mm/s), `grasp` (the bracket coming down from 20 um above touching) and `full` (the 30 s
manipulation). The unrolled and the continuous route are slow, so they are run over a sub-window of a few steps about
the window's first event, against central differences over that sub-window; the continuous one solves the ODE and not the
steps, so it is compared with the discrete adjoint at a step of 1 us.

Further: the literal Coulomb law, whose force jumps at break-away unless mu_s = mu_k; dL/dp through slip as the step is
refined; d omega / d K_n before and after a node touches; and a window that starts at `rest`, where the upper pad's gap is
exactly zero and central differences straddle the kink.

Command: .venv/bin/python experiments/gradient_accuracy.py [--smoke]
Expected, largest error of the discrete and forward routes among parameters whose central difference is itself known to 1e-6:
6e-7 in each of the short windows, 6e-6 over 30 s and 180 node events; elsewhere within the judge's uncertainty. Unrolled equals
discrete to 3e-8. Backward at 0.3 to 0.8 of the forward run. Coulomb's law with mu_s > mu_k: the adjoint calls dL/dmu_s 0, the
loss falls with a slope of -0.105 +- 0.01; with mu_s = mu_k they agree to 2e-4. Through slip dL/dmu_s is 9 % off at 2 ms. About
seven minutes on one core.
"""

import json
import statistics
import time as clock
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
import tyro
from matplotlib.figure import Figure
from torch import Tensor
from torchdiffeq import odeint, odeint_adjoint
from tqdm import tqdm

from torchsoft import Parameters, SoftGrasp, press
from torchsoft.adjoint import differentiable_solution
from torchsoft.control import Profile, Reference
from torchsoft.equilibrium import holding_force
from torchsoft.implicit import ImplicitStepper
from torchsoft.scenario import grasp_and_roll, reference
from torchsoft.sensitivity import sensitivities
from torchsoft.unrolled import unrolled_solution

NEWTON = 1e-10
"""Newton's tolerance of every run here [N]."""
FLOOR = (1e-7, 1e-7, 1e-6, 1e-6, 1e-6, 1e-5, 1e-7, 1e-7, 1e-3, 1e-3)
"""Smallest scale of each signal in the loss: m, m, rad, m/s, m/s, rad/s, m, m, N, N."""
INERT = ("material.rho",)
"""Parameters that massless pads do not use."""
RADIUS = "shape.radius"
FINER = {RADIUS: 1e-2}
"""Factors on the relative steps of central differences."""
INSENSITIVE = 1e-6
"""Part of the largest p dL/dp below which the continuous adjoint's gradient is not compared in relative terms."""
WIDTHS = (0.04, 0.02, 0.01)
"""Relative half-widths over which the slope of a loss with steps is averaged."""
Gradient = dict[str, float]


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/gradient_accuracy")
    steps: tuple[float, ...] = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 1e-6)
    """relative steps of the central differences; a hundredth of them for the radius, of which 1e-4 is two ramps"""
    full_steps: tuple[float, ...] = (3e-5, 1e-5)
    """the same over the whole manipulation, where a run takes a second"""
    coulomb_ms: float = 0.02
    """step of the runs with Coulomb's law [ms]"""
    coulomb_runs: int = 81
    """runs over which the slope of its loss is averaged"""
    refinement_ms: tuple[float, ...] = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125, 0.0625)
    """steps of the convergence through slip [ms]; half the last is the reference"""
    touch_ms: tuple[float, ...] = (0.4, 0.2, 0.1, 0.05, 0.025, 0.0125)
    """steps across a touch-down [ms]"""
    continuous_ms: float = 0.3
    """length of the continuous adjoint's sub-window, with two outputs [ms]: 14 / tau times their spacing is 0.2"""
    repeats: int = 5
    """runs of which a time is the median (three for the continuous adjoint)"""
    duration: float = 30.0
    """of the full window [s]"""
    only: tuple[str, ...] = ()
    """scalar parameters; all of them if none is named"""
    changes: tuple[tuple[str, float | int], ...] = ()
    """parameter overrides, a coarser mesh for instance"""
    smoke: bool = False
    """a size that takes seconds"""


def smoke(config: Config) -> Config:
    """The same questions for three parameters on a coarse mesh."""
    only = ("contact.K_n", "contact.friction.mu_s", "material.E")
    return replace(
        config, steps=(3e-4, 1e-4, 3e-5), full_steps=(1e-4, 1e-5), coulomb_ms=0.25, coulomb_runs=17, touch_ms=(0.4, 0.1),
        continuous_ms=0.1, refinement_ms=(2.0, 1.0), repeats=1, duration=0.6, only=only,
        changes=(("pad.elements_x", 60), ("pad.elements_y", 2)),
    )  # fmt: skip


@dataclass(frozen=True)
class Window:
    """A run whose gradient is wanted: from y0 (size,) through the outputs t (T,) [s] in steps of `step` [s]."""

    name: str
    model: SoftGrasp
    y0: Tensor
    t: Tensor
    step: float


@dataclass(frozen=True)
class Result:
    config: Config
    windows: dict[str, dict[str, Any]]
    coulomb: dict[str, Any]
    refinement: dict[str, Any]
    touch_down: dict[str, Any]
    rest: dict[str, Any]


def linspace(start: float, end: float, step: float) -> Tensor:
    return torch.linspace(start, end, round((end - start) / step) + 1, dtype=torch.float64)


def states(window: Window) -> Tensor:
    """The run (T, size), differentiable if gradients are on."""
    stepper = ImplicitStepper(window.model, step=window.step, tolerance=NEWTON)
    return differentiable_solution(stepper, window.y0, window.t)[0]


def signals(model: SoftGrasp, y: Tensor, t: Tensor) -> Tensor:
    """(T, 10): pose and velocity of the disc, pose of the bracket, control force."""
    s = model.layout.unpack(y)
    force = torch.stack(model.controllers(model.reference(t), s.r_C, s.v_C, s.r_Br, s.v_Br), -1)
    return torch.cat((s.r_C, s.theta[:, None], s.v_C, s.omega[:, None], s.r_Br, force), -1)


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


def scalars(model: SoftGrasp, config: Config) -> dict[str, torch.nn.Parameter]:
    every = {name: p for name, p in model.named_parameters() if p.ndim == 0 and name not in INERT}
    return {name: p for name, p in every.items() if not config.only or name in config.only}


def collect(model: SoftGrasp, names: Iterable[str]) -> Gradient:
    """The parameters' gradients, taken away from them."""
    parameters = dict(model.named_parameters())
    out = {n: 0.0 if (g := parameters[n].grad) is None else g.item() for n in names}
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


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    start = clock.perf_counter()
    out = function()
    return out, clock.perf_counter() - start


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
            run = sensitivities(window.model, window.y0, window.t, list(chosen), step=window.step, tolerance=NEWTON)
            y = run.y.clone().requires_grad_(True)
            y_bar, *direct = torch.autograd.grad(loss(y), (y, *chosen.values()), allow_unused=True)
            explicit = torch.stack([torch.zeros_like(y_bar[0, 0]) if g is None else g for g in direct])
            return torch.einsum("ti,tin->n", y_bar, run.dy) + explicit

        total, spent = timed(contract)
        gradient = dict(zip(chosen, total.tolist()))
        seconds.append((plain, spent - plain, spent))
    plain, extra, spent = (statistics.median(x) for x in zip(*seconds))
    return gradient, {"forward_s": plain, "gradient": extra / plain, "total": spent / plain}


@torch.no_grad()
def events(window: Window, y: Tensor) -> dict[str, Any]:
    """Nodes that touch, leave, slip and begin to slip between the outputs, and the first row with such an event."""
    on, slipping, fastest = [], [], 0.0
    for rows in torch.arange(len(y)).split(200):
        graph = window.model.evaluate(window.t[rows], window.model.layout.unpack(y[rows]))
        contact = [interface.contact for interface in graph.interfaces.values()]
        on.append(torch.cat([interface.frame.g > 0 for interface in graph.interfaces.values()], -1))
        speed = torch.cat([c.gamma_dot.abs() for c in contact], -1) * on[-1]
        slipping.append(speed > 0)
        fastest = max(fastest, speed.max().item())
    on, slipping = torch.cat(on), torch.cat(slipping)
    touch, leave, onset = on[1:] & ~on[:-1], on[:-1] & ~on[1:], slipping[1:] & ~slipping[:-1]
    first = (touch | leave | onset).any(1).nonzero()[:, 0]
    return {
        "steps": len(y) - 1,
        "touching": on.sum(1).max().item(),
        "touch": touch.sum().item(),
        "leave": leave.sum().item(),
        "slipping": slipping.any(0).sum().item(),
        "slip_onsets": onset.sum().item(),
        "fastest_slip_mm_s": 1e3 * fastest,
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
    x = model.layout.unpack(y0).r_C[0].item()
    model.reference = Reference(Profile([0.0, 0.02], [x, x - 2e-3]), Profile([0.0], [height]), Profile([0.0], [load]))
    return Window("slip", model, y0, linspace(0.0, end, every or step), step)


def windows(config: Config) -> list[Window]:
    """The five windows."""
    model = SoftGrasp(Parameters().override(dict(config.changes)))
    manipulation = grasp_and_roll(model, grasp_force=75.0 if config.smoke else None)
    roll = 0.5 if config.smoke else 4.5
    with torch.no_grad():
        path = states(Window("path", model, manipulation.y0, linspace(0.0, roll, 0.01), 2e-3))
    above = manipulation.y0.clone()
    above[model.layout.slices["r_Br"].stop - 1] += 2e-5
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
    seen = events(window, y)
    judge, unsure, _ = central_differences(window, loss, config, config.full_steps if full else config.steps)
    bar.update()
    gradients, costs = {}, {}
    gradients["discrete"], costs["discrete"] = by_backward(window, loss, lambda: states(window), config)
    gradients["forward"], costs["forward"] = by_sensitivities(window, loss, config)
    bar.update()
    out: dict[str, Any] = {
        "events": seen,
        "gradient": judge,
        "judge_uncertainty": {n: unsure[n] / abs(x) if x else 0.0 for n, x in judge.items()},
        "relative_error": {route: relative_errors(g, judge) for route, g in gradients.items()},
        "discrete_against_forward": relative_errors(gradients["forward"], gradients["discrete"]),
        "cost_ratio": costs,
    }
    if full or (config.smoke and window.name != "slip"):
        return out
    begin = max(0, min(seen["first_row"] - 1, len(window.t) - 4))
    part = replace(window, y0=y[begin].clone(), t=window.t[begin : begin + 4])
    loss = make_loss(part)
    with torch.no_grad():
        out["sub_window_events"] = events(part, states(part))
    judge, unsure, _ = central_differences(part, loss, config, config.steps)
    out["judge_uncertainty_sub_window"] = {n: unsure[n] / abs(x) if x else 0.0 for n, x in judge.items()}
    exact, _ = by_backward(part, loss, lambda: states(part), config)
    got, costs["unrolled"] = by_backward(
        part, loss, lambda: unrolled_solution(part.model, part.y0, part.t, step=part.step), config
    )
    out["relative_error"]["unrolled"] = relative_errors(got, judge)
    out["unrolled_against_discrete"] = relative_errors(got, exact)
    bar.update()
    with torch.no_grad():
        start = states(part)[1 if begin else 0].clone()
    t = part.t[1 if begin else 0] + 1e-3 * linspace(0.0, config.continuous_ms, config.continuous_ms / 2)
    fine = replace(part, y0=start, t=t, step=1e-6)
    loss = make_loss(fine)
    exact, _ = by_backward(fine, loss, lambda: states(fine), replace(config, repeats=1))

    def continuous() -> Tensor:
        solve = odeint_adjoint if torch.is_grad_enabled() else odeint
        return solve(fine.model, fine.y0, fine.t, method="rk4", options={"step_size": 2.5e-5})  # pyright: ignore[reportReturnType]

    got, costs["continuous"] = by_backward(fine, loss, continuous, replace(config, repeats=min(config.repeats, 3)))
    values = {n: p.item() for n, p in scalars(fine.model, config).items()}
    largest = max(abs(values[n] * x) for n, x in exact.items())
    floor = {n: INSENSITIVE * largest / value for n, value in values.items()}
    out["relative_error"]["continuous"] = relative_errors(got, exact, floor)
    with torch.no_grad():
        out["continuous_events"] = events(fine, states(fine))
    bar.update()
    return out


def coulomb(config: Config) -> dict[str, Any]:
    """The adjoint's bias with the literal Coulomb law, by least squares over L(mu), which has steps, at several widths.

    With mu_s = mu_k both are varied together.
    """
    out: dict[str, Any] = {}
    h = 1e-3 * config.coulomb_ms
    for label, mu_k, varied in (
        ("mu_s, of mu_s > mu_k", 0.2, ("mu_s",)),
        ("mu_k, of mu_s > mu_k", 0.2, ("mu_k",)),
        ("mu_s = mu_k", 0.3, ("mu_s", "mu_k")),
    ):
        window = stroke(config, 8e-3, h, {"contact.friction": "coulomb", "contact.mu_k": mu_k}, every=2.5e-4)
        loss, parameters = make_loss(window), dict(window.model.contact.friction.named_parameters())  # pyright: ignore[reportAttributeAccessIssue]
        y = states(window)
        loss(y).backward()
        adjoint = sum(parameters[name].grad.item() for name in varied)  # pyright: ignore[reportOptionalMemberAccess]
        middle, scan = parameters[varied[0]].item(), []
        changes = torch.linspace(-max(WIDTHS), max(WIDTHS), config.coulomb_runs, dtype=torch.float64)
        with torch.no_grad():
            for change in changes:
                for name in varied:
                    parameters[name].fill_(middle * (1 + change.item()))
                scan.append(loss(states(window)).item())
            for name in varied:
                parameters[name].fill_(middle)
        slopes = []
        for width in WIDTHS:
            near = changes.abs() <= width * (1 + 1e-9)
            x = middle * changes[near]
            slopes.append(((x * torch.tensor(scan, dtype=torch.float64)[near]).sum() / x.square().sum()).item())
        slope = sum(slopes) / len(slopes)
        out[label] = {
            "events": events(window, y.detach()), "adjoint": adjoint, "slope": slope, "slopes": slopes, "widths": WIDTHS,
            "uncertainty": (max(slopes) - min(slopes)) / 2, "mu": (middle * (1 + changes)).tolist(), "loss": scan,
        }  # fmt: skip
    return out


def refinement(config: Config) -> dict[str, Any]:
    """dL/dp through slip, at the same outputs, as the step is refined; errors against the finest step's."""
    steps = [1e-3 * h for h in (*config.refinement_ms, config.refinement_ms[-1] / 2)]
    names = ("contact.friction.mu_s", "contact.friction.mu_k", "contact.K_t")
    base = stroke(config, 16e-3, steps[-1], {}, every=4e-3)
    loss, table = make_loss(base), {}
    for h in steps:
        value = loss(states(replace(base, step=h)))
        value.backward()
        table[f"{1e3 * h:g}"] = {"loss": value.item(), **collect(base.model, names)}
    with torch.no_grad():
        dense = replace(base, t=linspace(0.0, 16e-3, 2.5e-4), step=2.5e-4)
        seen = events(dense, states(dense))
    exact = list(table.values())[-1]
    error = {key: {n: abs(row[n] - exact[n]) / abs(exact[n]) for n in exact} for key, row in list(table.items())[:-1]}
    return {"events": seen, "gradient": table, "relative_error": error}


def touch_down(config: Config, window: Window) -> dict[str, Any]:
    """d omega / d K_n at the end of windows that end before and after a node touches, with two ramps, at several steps.

    Continuous in the window's end if its largest change within a step, over its range, goes to zero with the step.
    """
    out: dict[str, Any] = {}
    name = "contact.K_n"
    with torch.no_grad():
        path = states(window)
    rows = events(window, path)["touch_rows"] or [3]
    start, y0 = window.t[rows[0] - 1].item(), path[rows[0] - 1]
    for label, epsilon in (("1 um", 1e-6), ("10 nm", 1e-8)):
        model = SoftGrasp(window.model.settings.override({"contact.epsilon": epsilon}))
        model.reference = window.model.reference
        at, p = model.layout.slices["omega"].start, dict(model.named_parameters())[name]
        out[label] = {"step_ms": [], "jump": [], "end": [], "before_error": [], "after_error": []}
        for h in (1e-3 * x for x in config.touch_ms):
            short = replace(window, model=model, y0=y0, t=linspace(start, start + 8e-3, h), step=h)
            run = sensitivities(model, y0, short.t, [name], step=h, tolerance=NEWTON)
            value, ends = run.dy[:, at, 0], []
            touch = (events(short, run.y)["touch_rows"] or [len(value) // 2])[0]
            with torch.no_grad():
                keep = p.clone()
                for sign in (1, -1):
                    p.copy_(keep * (1 + sign * 1e-5))
                    ends.append(states(short)[:, at])
                p.copy_(keep)
            error = (value - (ends[0] - ends[1]) / (2e-5 * keep)).abs() / value.abs()
            row = out[label]
            row["step_ms"].append(1e3 * h)
            row["jump"].append((value.diff().abs().max() / (value.max() - value.min())).item())
            row["end"].append(value[-1].item())
            row["before_error"].append(error[touch].item())
            row["after_error"].append(error[touch + 1].item())
            row["time_ms"], row["trace"] = (1e3 * (short.t - short.t[touch + 1])).tolist(), value.tolist()
    return out


def from_rest(config: Config) -> dict[str, Any]:
    """dL/dradius from `rest`, where the gap is exactly zero, and with the bracket 5 um higher."""
    out: dict[str, Any] = {}
    for label, offset in (("at rest", 0.0), ("5 um above", 5e-6)):
        model = SoftGrasp(Parameters().override(dict(config.changes)))
        manipulation = grasp_and_roll(model, grasp_force=75.0)
        y0 = manipulation.y0.clone()
        y0[model.layout.slices["r_Br"].stop - 1] += offset
        model.reference = reference(model, y0, 75.0)
        window = Window("rest", model, y0, linspace(0.0, 0.1, 2e-3), 2e-3)
        loss, chosen = make_loss(window), replace(config, only=(RADIUS,))
        judge, _, at = central_differences(window, loss, chosen, config.steps)
        loss(states(window)).backward()
        got = collect(model, judge)
        out[label] = {
            "adjoint": got[RADIUS], "central_differences": at[RADIUS], "steps": config.steps,
            "relative_error": relative_errors(got, judge)[RADIUS],
        }  # fmt: skip
    return out


def run(config: Config) -> Result:
    config = smoke(config) if config.smoke else config
    bar = tqdm(total=4 * 4 + 2 + 4, unit="part")
    every = windows(config)
    judged = {}
    for window in every:
        bar.set_description(window.name)
        judged[window.name] = judge_window(window, config, bar)
    rest = []
    for part in (coulomb, refinement, lambda c: touch_down(c, every[2]), from_rest):
        rest.append(part(config))
        bar.update()
    bar.close()
    return Result(config, judged, *rest)


def table(result: Result) -> str:
    """Markdown: per window and route the largest error and the cost; then the Coulomb bias and the convergence."""
    lines = ["| window | touch / leave / slip onsets | route | largest error (parameter, judge's own uncertainty) | "
             "largest where the judge knows 1e-6 | gradient / forward | total / forward |"]  # fmt: skip
    lines.append("|---" * 7 + "|")
    for name, window in result.windows.items():
        for route, errors in window["relative_error"].items():
            worst, cost = max(errors, key=lambda n: errors[n]), window["cost_ratio"][route]
            seen = {"unrolled": "sub_window_events", "continuous": "continuous_events"}.get(route, "events")
            e, unsure = window[seen], window["judge_uncertainty" + ("" if seen == "events" else "_sub_window")]
            if route == "continuous":  # judged by the discrete adjoint
                unsure = dict.fromkeys(errors, 0.0)
            known = max((errors[n] for n in errors if unsure[n] <= 1e-6), default=float("nan"))
            lines.append(
                f"| {name} | {e['touch']} / {e['leave']} / {e['slip_onsets']} | {route} | {errors[worst]:.1e} "
                f"({worst}, {unsure[worst]:.0e}) | {known:.1e} | {cost['gradient']:.2f} | {cost['total']:.2f} |"
            )
    lines += ["", "| Coulomb, literal: dL/dmu | adjoint | slope of L | by width |", "|---|---|---|---|"]
    for label, c in result.coulomb.items():
        widths = ", ".join(f"{x:.3g}" for x in c["slopes"])
        lines.append(f"| {label} | {c['adjoint']:.4g} | {c['slope']:.3g} +- {c['uncertainty']:.1g} | {widths} |")
    names = list(next(iter(result.refinement["relative_error"].values())))
    lines += ["", "| step [ms] | " + " | ".join(names) + " |", "|---" * (1 + len(names)) + "|"]
    for step, errors in result.refinement["relative_error"].items():
        lines.append(f"| {step} | " + " | ".join(f"{errors[n]:.1e}" for n in names) + " |")
    lines += ["", "| ramp | step [ms] | largest change in a step / range | end value | error before | error after |"]
    lines.append("|---" * 6 + "|")
    for label, row in result.touch_down.items():
        for k, h in enumerate(row["step_ms"]):
            numbers = f"{row['jump'][k]:.2f} | {row['end'][k]:.3g} | {row['before_error'][k]:.0e} | {row['after_error'][k]:.0e}"
            lines.append(f"| {label} | {h:g} | {numbers} |")
    lines += [
        "",
        "| start | adjoint dL/dradius | "
        + " | ".join(f"d = {FINER[RADIUS] * d:g}" for d in result.config.steps)
        + " |",
    ]
    lines.append("|---" * (2 + len(result.config.steps)) + "|")
    for label, row in result.rest.items():
        lines.append(
            f"| {label} | {row['adjoint']:.6g} | " + " | ".join(f"{x:.6g}" for x in row["central_differences"]) + " |"
        )
    return "\n".join(lines)


def figure(result: Result) -> Figure:
    """Errors per parameter and window; convergence through slip; Coulomb's jumps; both sides of a touch-down."""
    fig = Figure(figsize=(13, 11), layout="constrained")
    grid = fig.add_gridspec(2, 3, height_ratios=(1.2, 1.0))
    top, below = fig.add_subplot(grid[0, :]), [fig.add_subplot(grid[1, k]) for k in range(3)]
    names = list(next(iter(result.windows.values()))["gradient"])
    smallest = 1e-16
    markers = {"discrete": "o", "forward": "x", "unrolled": "s", "continuous": "^"}
    for i, (window, numbers) in enumerate(result.windows.items()):
        for route, errors in numbers["relative_error"].items():
            x = [k + 0.16 * (i - 2) for k in range(len(names))]
            hollow = {} if route == "forward" else {"markerfacecolor": "none"}
            top.semilogy(
                x, [max(errors[n], smallest) for n in names], markers[route], color=f"C{i}", ms=6, ls="none", **hollow
            )
        top.plot([], [], "-", color=f"C{i}", label=window, lw=4)
    for route, marker in markers.items():
        top.plot([], [], marker, color="k", ls="none", markerfacecolor="none" if marker != "x" else "k", label=route)
    for k in range(len(names) - 1):
        top.axvline(k + 0.5, color="0.9", lw=0.8, zorder=0)
    top.set_xticks(range(len(names)), [n.split(".")[-1] for n in names], rotation=45)
    top.set(
        ylabel="relative error [1]", title=f"Gradient against central differences ({smallest:g}: both exactly zero)"
    )
    top.set_xlim(-0.6, len(names) - 0.4)
    top.legend(ncols=9, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    errors = result.refinement["relative_error"]
    h = [float(key) for key in errors]
    for (n, label), marker in zip((("contact.friction.mu_s", "mu_s"), ("contact.friction.mu_k", "mu_k"),
                                   ("contact.K_t", "K_t"), ("loss", "the loss itself")), "osvD"):  # fmt: skip
        below[0].loglog(h, [row[n] for row in errors.values()], marker=marker, label=label)
    below[0].loglog(h, [errors[f"{h[0]:g}"]["loss"] * (x / h[0]) ** 2 for x in h], "k--", label="second order")
    below[0].set(xlabel="step [ms]", ylabel="relative error [1]", title="dL/dp through slip against the finest step")
    below[0].set_xticks(h, [f"{x:g}" for x in h])
    below[0].minorticks_off()
    below[0].legend()
    for k, (label, c) in enumerate(result.coulomb.items()):
        if label.startswith("mu_k"):
            continue
        mu, L = torch.tensor(c["mu"]), torch.tensor(c["loss"])
        shift = mu - mu[len(mu) // 2]
        below[1].plot(mu, L - L.mean(), f"C{k}.", ms=3, label=f"L by {label}")
        below[1].plot(mu, c["adjoint"] * shift, f"C{k}-", label="adjoint's slope")
        below[1].plot(mu, c["slope"] * shift, f"C{k}--", label="L's own slope")
    below[1].set(xlabel="mu [1]", ylabel="L less its mean [1]", title="Coulomb's law to the letter")
    below[1].legend(fontsize=8)
    for k, (label, row) in enumerate(result.touch_down.items()):
        below[2].plot(row["time_ms"], row["trace"], f"C{k}.-", ms=2, lw=0.8, label=f"ramp of {label}")
    below[2].axvline(0, color="0.7", lw=0.8)
    below[2].set(xlabel="end of the window after a node touched [ms]", ylabel="d omega / d K_n [rad/s per N/m]",
                 xlim=(-1.0, 2.0), title="Both sides of a touch-down")  # fmt: skip
    below[2].legend(fontsize=8)
    return fig


def write(result: Result) -> None:
    """summary.json, table.md and gradient_accuracy.png into the output folder."""
    out = result.config.out
    out.mkdir(parents=True, exist_ok=True)
    made = {"torchsoft": version("torchsoft"), "config": {k: str(v) for k, v in asdict(result.config).items()}}
    parts = {k: getattr(result, k) for k in ("windows", "coulomb", "refinement", "touch_down", "rest")}
    (out / "summary.json").write_text(json.dumps({**parts, "made_by": made}, indent=2))
    (out / "table.md").write_text(table(result) + "\n")
    figure(result).savefig(out / "gradient_accuracy.png", dpi=150)


def main() -> None:
    torch.set_num_threads(1)
    result = run(tyro.cli(Config, description=__doc__))
    write(result)
    print("\n" + table(result))
    print(f"\nwritten to {result.config.out}")


if __name__ == "__main__":
    main()
