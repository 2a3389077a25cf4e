"""Random models: a finite run whose energies balance or that says that they do not, or a failure in
one sentence; in time."""

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from torchsoft import (
    Circle,
    Ellipse,
    KelvinVoigt,
    Parameters,
    Shape,
    SimulationFailed,
    SoftGrasp,
    StandardLinearSolid,
    Trajectory,
    simulate,
)
from torchsoft.excitation import (
    Chirp,
    Excitation,
    MultiSine,
    Press,
    Roll,
    Strokes,
    reference,
    start,
)
from torchsoft.physics.statics import NoEquilibrium
from torchsoft.solve.adjoint import GradientFailed
from torchsoft.solve.ledger import NEGLIGIBLE, RESIDUAL

pytestmark = pytest.mark.slow

REFUSALS = (ValueError, SimulationFailed, NoEquilibrium, GradientFailed, NotImplementedError)
LONGEST = 30.0
"""Time [s] that one model may take."""
WILD = (0.0, -1.0, float("nan"), float("inf"), -float("inf"), 1e-300, 1e308, 1e30, -1e5)
SET = (
    "pad.E", "pad.nu", "pad.rho", "pad.tau", "pad.depth", "contact.K_n", "contact.R_n",
    "contact.K_t", "contact.R_t", "contact.mu_s",
    "contact.mu_k", "contact.v_s", "contact.eta", "contact.epsilon", "control.K_81", "control.R_80",
    "control.K_98", "control.R_99",
    "disc.radius", "disc.mass", "bracket.mass", "scenario.gravity",
)  # fmt: skip


class Network(nn.Module):
    """A slip rate by a small network."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        draw = lambda *shape: nn.Parameter(
            torch.randn(*shape, generator=generator, dtype=torch.float64)
        )
        self.W, self.b, self.w = draw(4, 2), draw(4), draw(4)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        mu = 0.3 + 0.2 * torch.tanh(
            self.w @ torch.tanh(self.W @ torch.stack((E, F_N)) / 10 + self.b)
        )
        return (E - mu * F_N).clamp(min=0.0) / (R + 10.0)


class Rounded(Shape):
    """A square of half-side a with corners of radius r, as its distance."""

    def __init__(self, a: float, r: float) -> None:
        super().__init__()
        self.a, self.r = (nn.Parameter(torch.tensor(x, dtype=torch.float64)) for x in (a, r))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        q = x.abs() - (self.a - self.r)
        out = q.clamp(min=0.0)
        size = torch.sqrt((out * out).sum(-1) + 1e-300)
        inside = q.amax(-1).clamp(max=0.0)
        sign = torch.where(x >= 0, torch.ones_like(x), -torch.ones_like(x))
        corner = sign * out / size[..., None]
        along = (q[..., 0] >= q[..., 1])[..., None]
        flat = sign * torch.where(
            along, torch.eye(2, dtype=x.dtype)[0], torch.eye(2, dtype=x.dtype)[1]
        )
        return size + inside - self.r, torch.where((q.amax(-1) > 0)[..., None], corner, flat)

    def gyration(self) -> Tensor:
        return self.a**2 * 2 / 3

    def support(self, direction: Tensor) -> Tensor:
        return (self.a - self.r) * direction.abs().sum(-1) + self.r


def spread(rng: np.random.Generator, value: float, decades: float) -> float:
    return float(value * 10 ** rng.uniform(-decades, decades))


def settings(rng: np.random.Generator) -> Parameters:
    """Numbers about the usual ones, near for some models and three decades away for others."""
    decades, values = float(rng.choice([0.1, 0.5, 1.0, 3.0])), {}
    base = Parameters()
    for name, row in base.table().items():
        group = name.split(".")[0]
        if (
            group in ("pad", "contact", "control", "disc", "bracket")
            and isinstance(row["value"], float)
            and rng.random() < 0.4
        ):
            few = name in (
                "pad.length",
                "pad.height",
                "disc.radius",
                "bracket.cm_height",
                "contact.node_spacing",
            )
            values[name] = spread(rng, row["value"], min(decades, 0.02) if few else decades)
    values |= {
        "pad.nu": float(rng.uniform(-0.9, 0.499)), "pad.elements_x": int(rng.integers(8, 33)),
        "pad.elements_y": int(rng.integers(1, 4)),
        "pad.fidelity": str(rng.choice(["massless", "massless", "inertial"])),
        "pad.enclosed": bool(rng.random() < 0.2),
        "contact.friction": str(rng.choice(["smooth", "smooth", "coulomb"])),
        "contact.points": int(rng.integers(0, 3)),
        "control.senses": str(rng.choice(["disc", "bracket"])),
    }  # fmt: skip
    mu = values.get("contact.mu_s", base.contact.mu_s)
    values["contact.mu_k"] = mu * float(rng.uniform(0.3, 1.0))
    return base.override(values)


def excitation(rng: np.random.Generator) -> Excitation:
    wide = float(rng.choice([0.3, 1.0]))
    motion = [
        Roll(travel=spread(rng, 5e-3, wide)),
        Strokes(travel=spread(rng, 5e-3, wide), stroke_time=0.05),
        MultiSine(amplitude_x=spread(rng, 2e-3, wide), amplitude_y=spread(rng, 1e-4, wide),
        frequency=(5.0, 40.0),
                  seed=int(rng.integers(99))),
        Chirp(amplitude_x=spread(rng, 1e-3, wide), start=2.0, end=30.0),
        Press(amplitude=spread(rng, 2e-4, wide), frequency=20.0),
    ][rng.integers(5)]  # fmt: skip
    depth = spread(rng, 1e-3, 0.5)
    return Excitation(
        motion=motion,
        duration=0.45,
        depth=depth,
        grasp_time=0.06,
        settle=0.02,
        senses=str(rng.choice(["disc", "bracket"])),
    )  # pyright: ignore


def build(rng: np.random.Generator, tried: Excitation) -> SoftGrasp:
    p = tried.settings(settings(rng))
    kind = rng.random()
    shape = (
        Ellipse(*(spread(rng, p.disc.radius, 0.05) for _ in "ab"))
        if kind < 0.15
        else Circle(p.disc.radius)
    )
    shape = (
        Rounded(p.disc.radius, p.disc.radius * float(rng.uniform(0.3, 0.9)))
        if kind > 0.9
        else shape
    )
    soft = KelvinVoigt(p.pad.E, p.pad.nu, p.pad.rho, p.pad.tau, p.pad.depth)
    if rng.random() < 0.15:
        soft = StandardLinearSolid(
            p.pad.E,
            p.pad.E * float(rng.uniform(0.9, 4.0)),
            p.pad.nu,
            p.pad.rho,
            p.pad.tau,
            p.pad.depth,
        )
    own = [
        None,
        None,
        None,
        Network(int(rng.integers(99))),
        lambda E, F_N, R: (E - 0.3 * F_N).clamp(min=0.0) / R,
    ][rng.integers(5)]
    model = SoftGrasp(p, friction=own, shape=shape, material=soft)
    if rng.random() < 0.15:
        name = str(rng.choice(SET))
        known = dict(model.named_parameters(remove_duplicate=False))
        own_name = model.aliases[name]
        if own_name in known:
            known[own_name].data.fill_(float(rng.choice(WILD)))
    return model


def problems(run: Trajectory, said: list[str]) -> str:
    """What a run that came to its end should have said and did not; empty if nothing."""
    parts = [
        run.y,
        run.injected,
        *run.channels.values(),
        *run.force.values(),
        *run.load.values(),
        *run.energy.values(),
    ]
    if not all(
        bool(torch.isfinite(x).all())
        for x in (*parts, *run.dissipated.values(), *run.supplied.values())
    ):
        return "not finite"
    stored, out, put_in = (
        torch.stack(list(x.values())).sum(0) for x in (run.energy, run.dissipated, run.supplied)
    )
    scale = max(float(stored[0] + run.injected[-1]), NEGLIGIBLE)
    residual = float((stored - stored[0] + out - put_in).abs().max()) / scale
    if residual > RESIDUAL and not any("do not balance" in text for text in said):
        return f"energy residual {residual:.3g} without a word"
    if any("\n" in text for text in said):
        return f"a warning of several lines: {said}"
    return ""


def one(rng: np.random.Generator) -> tuple[str, str]:
    """What became of one model, and what is wrong with that; empty if nothing is."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            tried = excitation(rng)
            model = build(rng, tried)
            y0 = start(model).detach()
            model.reference = reference(
                tried, model, float(model.unpack(y0).pose["bracket"][1]), spread(rng, 5.0, 0.7)
            )
            t = torch.linspace(0, tried.duration, int(rng.integers(3, 40)), dtype=torch.float64)
            options = {
                "step": float(rng.choice([5e-4, 1e-3, 2e-3, 2e-3, 5e-3, 2e-2])),
                "tolerance": float(rng.choice([1e-10, 1e-9, 1e-7])),
            }
            run = simulate(model, t, y0=y0, **options)
            wrong = problems(run, [str(w.message) for w in caught])
            if not wrong and rng.random() < 0.1:
                leaves = [p for p in model.parameters() if p.requires_grad]
                again = simulate(model, t[:5], y0=y0, gradient="discrete", **options)
                gradients = torch.autograd.grad(again["x_C"][-1], leaves, allow_unused=True)
                if not all(g is None or bool(torch.isfinite(g).all()) for g in gradients):
                    wrong = "a gradient is not finite"
        except REFUSALS as refusal:
            text = str(refusal)
            fine = bool(text) and "\n" not in text and len(text) < 2000
            return (
                f"{type(refusal).__name__}: {text[:90]}",
                "" if fine else f"not one sentence: {text!r}",
            )
    return "ran, warned" if caught else "ran", wrong


@pytest.mark.timeout(1800)
def test_random_models_run_or_say_why_not(
    tally: Callable[[str], Any],
    count: Callable[[int], int],
    random: Callable[..., np.random.Generator],
) -> None:
    line, ran = tally("random models"), 0
    for number in range(count(1000)):
        began = time.perf_counter()
        try:
            became, wrong = one(random(73, number))
        except Exception as error:
            became, wrong = "raised", f"{type(error).__name__}: {error}"
        took = time.perf_counter() - began
        ran += became.startswith("ran")
        line.held(not wrong and took < LONGEST, f"model {number} ({took:.0f} s): {became}: {wrong}")
    assert ran >= 0.3 * line.tried, f"only {ran} of {line.tried} models ran"
