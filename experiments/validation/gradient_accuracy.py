"""Question: how exact are gradients, in every contact mode?

The loss over a window of outputs t_k is L = mean over k and i of (1/2 + (t_k - t_0)/(t_T - t_0))
(z_ki + z_ki^2 / 2), with z = (q - mean q) / std q of the nominal run, constants both, and q = (x_C,
y_C, theta, v_C, omega, x_Br, y_Br, F_x, F_y). dL/dp for every scalar parameter p, the state at t_0
held, comes from the discrete adjoint of the implicit stepper (forward sensitivities of the same
steps are held against it in the tests) and is judged by central differences D(d) = (L(p + d) - L(p
- d)) / 2d of the stepper at a Newton tolerance of 1e-10 N. Each neighbouring pair of relative steps
d gives a Richardson value; the three in a row that agree best are the plateau, and their spread is
the judge's own uncertainty. No gradient is looked at to choose the step.

Windows: `stick` (gentle rolling in the grasp), `slip` (a 2 mm stroke in 20 ms with mu_s = 0.3, mu_k
= 0.2, v_s = 50 mm/s), `make-break` (rolling at 4.4 mm/s), `grasp` (the bracket coming down from 20
um above touching) and `full` (the 30 s manipulation). The step that a
gradient needs, and its cost, are in `step_accuracy.py`.

Command: .venv/bin/python -m experiments.validation.gradient_accuracy [--smoke]
Expected, largest error among parameters whose central difference is itself known to 1e-6: 6e-7 in
each of the short windows, 6e-6 over 30 s and 180 node events; elsewhere within the judge's
uncertainty. About five minutes on one core.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from experiments.frame import COARSE, Table, grid, options, write
from torchsoft import Rig, RigFile, Trajectory, simulate
from torchsoft.physics.energy import SLIPPING

NEWTON = 1e-10
"""Newton's tolerance of every run here [N]."""

SIGNALS = {
    "x_C": 1e-7, "y_C": 1e-7, "theta_C": 1e-6, "v_x_C": 1e-6, "v_y_C": 1e-6, "omega_C": 1e-5,
    "x_Br": 1e-7, "y_Br": 1e-7, "effort_x": 1e-3, "effort_y": 1e-3,
}  # fmt: skip
"""Signals in the loss, with the smallest scale of each: m, rad, m/s, rad/s, N."""

FEW = "laws.steel_on_rubber.K_n", "laws.steel_on_rubber.friction.mu_s", "materials.rubber.E"
"""Parameters of the smoke size."""

FINER = {"bodies.disc.shape.radius": 1e-2}
"""Factors on the relative steps of central differences; of the radius 1e-4 is two ramps."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/gradient_accuracy")
    # relative steps of the central differences; fewer for `full`, where a run takes a second
    steps: tuple[float, ...] = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 1e-6)
    full_steps: tuple[float, ...] = (3e-5, 1e-5)
    duration: float = 30.0  # of the full window [s]
    smoke: bool = False  # three parameters on a coarse mesh


@dataclass(frozen=True)
class Window:
    """A run whose gradient is computed: from y0 (size,) through the outputs t (T,) [s] in steps of
    `step` [s]."""

    name: str
    model: Rig
    y0: Tensor
    t: Tensor
    step: float

    def run(self) -> Trajectory:
        """The run, differentiable if gradients are on."""
        how: dict[str, Any] = {"step": self.step, "tolerance": NEWTON, "gradient": "discrete"}
        return simulate(self.model, self.t, y0=self.y0, **how)

    def parameters(self, few: bool) -> dict[str, Tensor]:
        """The trained scalar parameters, called as in the rig file."""
        names = FEW if few else self.model.description()["parameters"]
        every = {name: self.model.parameter(name) for name in names}
        return {name: p for name, p in every.items() if p.requires_grad}


def events(run: Trajectory) -> dict[str, int]:
    """Points that touch, leave and start to slip between the outputs."""
    states = torch.cat(list(run.contact_state.values()), -1)
    on, slips = states > 0, states == SLIPPING
    starts = lambda now: int((now[1:] & ~now[:-1]).sum())
    return {"touch": starts(on), "leave": starts(~on), "slip_onsets": starts(slips)}


def signals(run: Trajectory) -> Tensor:
    """`SIGNALS` of a run, (T, signals)."""
    return torch.stack([run[name] for name in SIGNALS], -1)


@torch.no_grad()
def make_loss(window: Window) -> Callable[[Trajectory], Tensor]:
    """The loss of the docstring as a function of a run, its constants from the nominal one."""
    t, nominal = window.t, signals(window.run())
    floor = torch.tensor(list(SIGNALS.values()), dtype=torch.float64)
    centre, scale = nominal.mean(0), torch.maximum(nominal.std(0), floor)
    weight = (0.5 + (t - t[0]) / (t[-1] - t[0]))[:, None]

    def loss(run: Trajectory) -> Tensor:
        z = (signals(run) - centre) / scale
        return (weight * (z + 0.5 * z**2)).mean()

    return loss


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
def central_difference(
    window: Window, loss: Callable[[Trajectory], Tensor], p: Tensor, steps: tuple[float, ...]
) -> tuple[float, float]:
    """dL/dp by central differences, and the judge's uncertainty over it."""
    nominal, values = p.clone(), []
    for relative in steps:
        ends, losses = [nominal * (1 + sign * relative) for sign in (1, -1)], []
        for end in ends:
            p.copy_(end)
            losses.append(loss(window.run()).item())
        values.append((losses[0] - losses[1]) / (ends[0] - ends[1]).item())
    p.copy_(nominal)
    value, spread = richardson(values, steps)
    return value, spread / abs(value) if value else 0.0


def stroke(file: RigFile) -> Window:
    """A 2 mm stroke in 20 ms out of a frictionless grasp, with little friction: nodes break away
    one after another."""
    slippery = {"contact.v_s": 0.05, "contact.mu_s": 0.3, "contact.mu_k": 0.2}
    roll = {"kind": "profile", "times": [0.0, 0.02], "values": [0.0, -2e-3], "offset": "start"}
    motions = {
        "motion.x_d": roll, "motion.y_d": {"kind": "hold"},
        "motion.F_ff": {"kind": "hold", "value": "held"},
    }  # fmt: skip
    grasped = {"bodies.bracket.start.y": file["motion.y_d.values"][-1]}
    model, y0, _ = file.override(slippery | motions | grasped).build()
    return Window("slip", model, y0, grid(6e-3, 2.5e-4), 2.5e-4)


def windows(config: Config) -> list[Window]:
    """The five windows."""
    file = RigFile.ready("paper").override(COARSE if config.smoke else {})
    early, roll, stick, broken, grasp = (
        (0.5, 0.5, 0.01, 0.05, 0.2) if config.smoke else (0.6, 4.5, 0.05, 0.5, 0.4)
    )
    model, y0, _ = file.build()
    with torch.no_grad():
        path = Window("path", model, y0, grid(roll, 0.01), 2e-3).run().y
    above = float(model.unpack(y0).pose["bracket"][1]) + 2e-5
    lowered, y_above, _ = file.override({"bodies.bracket.start.y": above}).build()
    return [
        Window("stick", model, path[round(100 * early)], early + grid(stick, 1e-3), 1e-3),
        stroke(file),
        Window("make-break", model, path[-1], roll + grid(broken, 2e-3), 2e-3),
        Window("grasp", lowered, y_above, grid(grasp, 2e-3), 2e-3),
        Window("full", model, y0, grid(config.duration, 0.01), 2e-3),
    ]


def judge(window: Window, config: Config) -> dict[str, Any]:
    """Errors of the adjoint over one window."""
    loss, parameters = make_loss(window), window.parameters(few=config.smoke)
    run = window.run()
    changes = events(run)
    gradient = torch.autograd.grad(loss(run), list(parameters.values()), materialize_grads=True)
    steps = config.full_steps if window.name == "full" else config.steps
    errors, unsure = {}, {}
    for (name, p), found in zip(parameters.items(), gradient):
        finer = tuple(FINER.get(name, 1.0) * relative for relative in steps)
        value, unsure[name] = central_difference(window, loss, p, finer)
        off = abs(found.item() - value)
        errors[name] = off / abs(value) if value else float("inf") if off else 0.0
    return {"events": changes, "relative_error": errors, "judge_uncertainty": unsure}


def table(found: dict[str, dict[str, Any]]) -> Table:
    """By window the largest error, and the largest where the judge is sure."""
    rows = []
    for name, window in found.items():
        errors, unsure = window["relative_error"], window["judge_uncertainty"]
        worst = max(errors, key=lambda n: errors[n])
        known = max((errors[n] for n in errors if unsure[n] <= 1e-6), default=float("nan"))
        counts = " / ".join(map(str, window["events"].values()))
        largest = f"{errors[worst]:.1e} ({worst}, {unsure[worst]:.0e})"
        rows.append((name, counts, largest, f"{known:.1e}"))
    head = ("window", "touch / leave / slip onsets",
            "largest error (parameter, judge's own uncertainty)",
            "largest where the judge knows 1e-6")  # fmt: skip
    return Table(head, rows)


def main(config: Config) -> None:
    if config.smoke:
        config = replace(config, steps=(3e-4, 1e-4, 3e-5), full_steps=(1e-4, 1e-5), duration=0.6)
    every = tqdm(windows(config), unit="window", disable=None)
    found = {window.name: judge(window, config) for window in every}
    write(config, {"windows": found}, {"gradients": table(found)})


if __name__ == "__main__":
    main(options(Config, __doc__))
