"""Question: how exact are the two routes to a gradient, in every contact mode?

The loss over a window of outputs t_k is L = mean over k and i of (1/2 + (t_k - t_0)/(t_T - t_0))
(z_ki + z_ki^2 / 2), with z = (q - mean q) / std q of the nominal run, constants both, and q = (x_C,
y_C, theta, v_C, omega, x_Br, y_Br, F_x, F_y). dL/dp for every scalar parameter p, the state at t_0
held, comes from
  discrete     the discrete adjoint of the implicit stepper,
  forward      forward sensitivities of the same steps, contracted with dL/dy,
and is judged by central differences D(d) = (L(p + d) - L(p - d)) / 2d of the stepper at a Newton
tolerance of 1e-10 N. Each neighbouring pair of relative steps d gives a Richardson value; the three
in a row that agree best are the plateau, and their spread is the judge's own uncertainty. No
gradient is looked at to choose the step.

Windows: `stick` (gentle rolling in the grasp), `slip` (a 2 mm stroke in 20 ms with mu_s = 0.3, mu_k
= 0.2, v_s = 50 mm/s), `make-break` (rolling at 4.4 mm/s), `grasp` (the bracket coming down from 20
um above touching) and `full` (the 30 s manipulation).

Further: the literal Coulomb law, whose force jumps at break-away unless mu_s = mu_k. How far
gradients depend on the step is in `step_accuracy.py`, and their price in `benchmark.py`.

Command: .venv/bin/python experiments/validation/gradient_accuracy.py [--smoke]
Expected, largest error of both routes among parameters whose central difference is itself known to
1e-6: 6e-7 in each of the short windows, 6e-6 over 30 s and 180 node events; elsewhere within the
judge's uncertainty. Coulomb's law with mu_s > mu_k: the adjoint calls dL/dmu_s 0, the loss falls
with a slope of -0.105 +- 0.01; with mu_s = mu_k they agree to 2e-4. About six minutes on one core.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchsoft import Parameters, Profile, Reference, SoftGrasp, press, simulate
from torchsoft.experiment import COARSE, at_the_points, markdown, options, write
from torchsoft.paper.equilibrium import holding_force
from torchsoft.scenario import grasp_and_roll, reference
from torchsoft.solve.trajectory import channels

NEWTON = 1e-10  # Newton's tolerance of every run here [N].


FLOOR = (1e-7, 1e-7, 1e-6, 1e-6, 1e-6, 1e-5, 1e-7, 1e-7, 1e-3, 1e-3)
"""Smallest scale of each signal in the loss: m, m, rad, m/s, m/s, rad/s, m, m, N, N."""


CHANNELS = ("x_C", "y_C", "theta", "v_x", "v_y", "omega", "x_Br", "y_Br", "F_x", "F_y")


INERT = ("pad.rho",)  # Parameters that massless pads do not use.


RADIUS = "disc.radius"


FINER = {RADIUS: 1e-2}  # Factors on the relative steps of central differences.


Gradient = dict[str, float]


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/gradient_accuracy")
    steps: tuple[float, ...] = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 1e-6)
    """relative steps of the central differences; a hundredth of them for the radius, of which 1e-4
    is two ramps"""
    full_steps: tuple[float, ...] = (
        3e-5,
        1e-5,
    )  # the same over the whole manipulation, where a run takes a second
    coulomb_ms: float = 0.02  # step of the runs with Coulomb's law [ms]
    coulomb_runs: int = 81  # runs over which the slope of its loss is averaged
    duration: float = 30.0  # of the full window [s]
    only: tuple[str, ...] = ()  # scalar parameters; all of them if none is named
    changes: tuple[
        tuple[str, float | int], ...
    ] = ()  # parameter overrides, a coarser mesh for instance
    smoke: bool = False  # a size that takes seconds


@dataclass(frozen=True)
class Window:
    """A run whose gradient is computed: from y0 (size,) through the outputs t (T,) [s] in steps of
    `step` [s]."""

    name: str
    model: SoftGrasp
    y0: Tensor
    t: Tensor
    step: float


def linspace(start: float, end: float, step: float) -> Tensor:
    return torch.linspace(start, end, round((end - start) / step) + 1, dtype=torch.float64)


def states(window: Window) -> Tensor:
    """The run (T, size), differentiable if gradients are on."""
    w = window
    return simulate(w.model, w.t, y0=w.y0, step=w.step, tolerance=NEWTON, gradient="discrete").y


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
    centre, scale = (
        nominal.mean(0),
        torch.maximum(nominal.std(0), torch.tensor(FLOOR, dtype=torch.float64)),
    )
    weight = (0.5 + (t - t[0]) / (t[-1] - t[0]))[:, None]

    def loss(y: Tensor) -> Tensor:
        z = (signals(model, y, t) - centre) / scale
        return (weight * (z + 0.5 * z**2)).mean()

    return loss


def scalars(model: SoftGrasp, config: Config) -> dict[str, Tensor]:
    """The trained scalar parameters, called as in `Parameters`."""
    own = dict(model.named_parameters())
    every = {
        name: own[path] for name, path in model.aliases.items() if path in own and name not in INERT
    }
    chosen = {name: p for name, p in every.items() if not config.only or name in config.only}
    return {name: p for name, p in chosen.items() if p.requires_grad}


def collect(model: SoftGrasp, names: Iterable[str]) -> Gradient:
    """The parameters' gradients, taken away from them."""
    out = {n: 0.0 if (g := model.parameter(n).grad) is None else g.item() for n in names}
    model.zero_grad(set_to_none=True)
    return out


def richardson(values: list[float], steps: tuple[float, ...]) -> tuple[float, float]:
    """Plateau and uncertainty of central differences at falling steps: median and spread of the
    three neighbouring extrapolations that agree best; with fewer, the last one and how far the two
    last values are apart."""
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
) -> tuple[Gradient, Gradient]:
    """dL/dp by central differences, and the judge's uncertainty over it."""
    value, unsure = {}, {}
    for name, p in scalars(window.model, config).items():
        keep, at = p.clone(), []
        for relative in steps:
            ends, got = (
                [keep * (1 + sign * relative * FINER.get(name, 1.0)) for sign in (1, -1)],
                [],
            )
            for end in ends:
                p.copy_(end)
                got.append(loss(states(window)).item())
            at.append((got[0] - got[1]) / (ends[0] - ends[1]).item())
        p.copy_(keep)
        value[name], spread = richardson(at, steps)
        unsure[name] = spread / abs(value[name]) if value[name] else 0.0
    return value, unsure


def relative_errors(got: Gradient, judge: Gradient) -> Gradient:
    """|got - judge| / |judge|; a gradient that both call exactly zero has no error."""
    return {
        n: 0.0 if got[n] == x else abs(got[n] - x) / abs(x) if x else float("inf")
        for n, x in judge.items()
    }


def by_backward(window: Window, loss: Callable[[Tensor], Tensor], config: Config) -> Gradient:
    """Gradient by the discrete adjoint."""
    loss(states(window)).backward()
    return collect(window.model, scalars(window.model, config))


def by_sensitivities(window: Window, loss: Callable[[Tensor], Tensor], config: Config) -> Gradient:
    """Gradient by forward sensitivities of all parameters at once."""
    chosen, w = scalars(window.model, config), window
    how: dict[str, Any] = {"tolerance": NEWTON, "gradient": "forward", "wrt": list(chosen)}
    run = simulate(w.model, w.t, y0=w.y0, step=w.step, **how)
    assert run.sensitivities is not None
    y = run.y.clone().requires_grad_(True)
    y_bar, *direct = torch.autograd.grad(loss(y), (y, *chosen.values()), allow_unused=True)
    explicit = torch.stack([torch.zeros_like(y_bar[0, 0]) if g is None else g for g in direct])
    return dict(
        zip(chosen, (torch.einsum("ti,tin->n", y_bar, run.sensitivities) + explicit).tolist())
    )


ROUTES = {"discrete": by_backward, "forward": by_sensitivities}


@torch.no_grad()
def events(window: Window, y: Tensor) -> dict[str, Any]:
    """Nodes that touch, leave and begin to slip between the outputs."""
    parts = [
        at_the_points(window.model, window.t[rows], y[rows])
        for rows in torch.arange(len(y)).split(200)
    ]
    depth, speed = (torch.cat(part) for part in zip(*parts))
    on, slips = depth > 0, (speed > 0) & (depth > 0)
    changes = {"touch": on[1:] & ~on[:-1], "leave": on[:-1] & ~on[1:]}
    changes |= {"slip_onsets": slips[1:] & ~slips[:-1]}
    return {name: some.sum().item() for name, some in changes.items()}


def stroke(
    config: Config, end: float, step: float, changes: dict[str, Any], every: float | None = None
) -> Window:
    """A 2 mm stroke in 20 ms out of a frictionless grasp, with little friction: nodes break away
    one after another."""
    slippery = {"contact.v_s": 0.05, "contact.mu_s": 0.3, "contact.mu_k": 0.2}
    model = SoftGrasp(Parameters().override({**slippery, **dict(config.changes), **changes}))
    y0 = press(model, height := model.settings.scenario.y_Br_grasp).detach()
    load = -holding_force(model, y0)
    x = model.unpack(y0).pose["disc"][0].item()
    model.reference = Reference(
        x_d=Profile([0.0, 0.02], [x, x - 2e-3]),
        y_d=Profile([0.0], [height]),
        F_ff=Profile([0.0], [load]),
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
        Window(
            "stick", model, path[round(100 * early)], linspace(early, early + stick, 1e-3), 1e-3
        ),
        stroke(config, 6e-3, 2.5e-4, {}),
        Window(
            "make-break",
            model,
            path[-1],
            linspace(roll, roll + (0.05 if config.smoke else 0.5), 2e-3),
            2e-3,
        ),
        Window("grasp", lowered, above, linspace(0.0, grasp, 2e-3), 2e-3),
    ]
    return [
        *out,
        Window("full", model, manipulation.y0, linspace(0.0, config.duration, 0.01), 2e-3),
    ]


def judge_window(window: Window, config: Config) -> dict[str, Any]:
    """Errors of the routes over one window."""
    loss = make_loss(window)
    with torch.no_grad():
        found = events(window, states(window))
    steps = config.full_steps if window.name == "full" else config.steps
    judge, unsure = central_differences(window, loss, config, steps)
    gradients = {name: route(window, loss, config) for name, route in ROUTES.items()}
    return {
        "events": found, "gradient": judge, "judge_uncertainty": unsure,
        "relative_error": {route: relative_errors(g, judge) for route, g in gradients.items()},
        "discrete_against_forward": relative_errors(gradients["forward"], gradients["discrete"]),
    }  # fmt: skip


WIDTHS = (
    0.04,
    0.02,
    0.01,
)  # Relative half-widths over which the slope of a loss with steps is averaged.


def coulomb(config: Config) -> dict[str, Any]:
    """The adjoint's bias with the literal Coulomb law, by least squares over L(mu), which has
    steps, at several widths.

    With mu_s = mu_k both are varied together.
    """
    out: dict[str, Any] = {}
    h = 1e-3 * config.coulomb_ms
    for label, mu_k, varied in (
        ("mu_s, of mu_s > mu_k", 0.2, ("mu_s",)),
        ("mu_k, of mu_s > mu_k", 0.2, ("mu_k",)),
        ("mu_s = mu_k", 0.3, ("mu_s", "mu_k")),
    ):
        window = stroke(
            config, 8e-3, h, {"contact.friction": "coulomb", "contact.mu_k": mu_k}, every=2.5e-4
        )
        loss, parameters = (
            make_loss(window),
            {name: window.model.parameter(f"contact.{name}") for name in varied},
        )
        y = states(window)
        loss(y).backward()
        adjoint = sum(parameters[name].grad.item() for name in varied)  # pyright: ignore[reportOptionalMemberAccess]
        middle, scan = parameters[varied[0]].item(), []
        changes = torch.linspace(
            -max(WIDTHS), max(WIDTHS), config.coulomb_runs, dtype=torch.float64
        )
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
            slopes.append(
                (
                    (x * torch.tensor(scan, dtype=torch.float64)[near]).sum() / x.square().sum()
                ).item()
            )
        slope = sum(slopes) / len(slopes)
        out[label] = {
            "events": events(window, y.detach()), "adjoint": adjoint, "slope": slope,
            "slopes": slopes, "uncertainty": (max(slopes) - min(slopes)) / 2,
        }  # fmt: skip
    return out


@dataclass(frozen=True)
class Result:
    config: Config
    windows: dict[str, dict[str, Any]]
    coulomb: dict[str, Any]


def run(config: Config) -> Result:
    if config.smoke:  # the same questions for three parameters on a coarse mesh
        config = replace(
            config, steps=(3e-4, 1e-4, 3e-5), full_steps=(1e-4, 1e-5), coulomb_ms=0.25,
            coulomb_runs=17, duration=0.6, only=("contact.K_n", "contact.mu_s", "pad.E"),
            changes=tuple(COARSE.items()),
        )  # fmt: skip
    judged = {
        window.name: judge_window(window, config) for window in tqdm(windows(config), unit="window")
    }
    return Result(config, judged, coulomb(config))


def table(result: Result) -> str:
    """Markdown: per window and route the largest error; then the Coulomb bias."""
    rows = []
    for name, window in result.windows.items():
        for route, errors in window["relative_error"].items():
            worst = max(errors, key=lambda n: errors[n])
            e, unsure = window["events"], window["judge_uncertainty"]
            known = max((errors[n] for n in errors if unsure[n] <= 1e-6), default=float("nan"))
            counts = f"{e['touch']} / {e['leave']} / {e['slip_onsets']}"
            largest = f"{errors[worst]:.1e} ({worst}, {unsure[worst]:.0e})"
            rows.append((name, counts, route, largest, f"{known:.1e}"))
    head = ("window", "touch / leave / slip onsets", "route",
    "largest error (parameter, judge's own uncertainty)",
            "largest where the judge knows 1e-6")  # fmt: skip
    tables = [markdown(head, rows)]
    rows = [
        (label, f"{c['adjoint']:.4g}", f"{c['slope']:.3g} +- {c['uncertainty']:.1g}",
         ", ".join(f"{x:.3g}" for x in c["slopes"]))
        for label, c in result.coulomb.items()
    ]  # fmt: skip
    tables.append(markdown(("Coulomb, literal: dL/dmu", "adjoint", "slope of L", "by width"), rows))
    return "\n\n".join(tables)


def main() -> None:
    result = run(options(Config, __doc__))
    parts = {"windows": result.windows, "coulomb": result.coulomb}
    write(result.config, parts, table=table(result))


if __name__ == "__main__":
    main()
