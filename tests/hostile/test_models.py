"""Random models, and models in many threads: a run is finite and its energies balance or it says
that they do not, or it fails in one sentence, in time; and threads give the bits of runs alone."""

import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Barrier
from typing import Any

import numpy as np
import pytest
import torch
from conftest import PAPER, coarse, grasp, still, times
from torch import Tensor, nn

from hostile.trial import Tally, count, random
from torchsoft import (
    Circle,
    Ellipse,
    KelvinVoigt,
    Profile,
    Reference,
    Rig,
    RoundedBox,
    SimulationFailed,
    StandardLinearSolid,
    Trajectory,
    simulate,
)
from torchsoft.physics.statics import NoEquilibrium
from torchsoft.rigs.excite import Excitation
from torchsoft.solve.diagnostics import NEGLIGIBLE, RESIDUAL
from torchsoft.solve.gradients import GradientFailed

pytestmark = pytest.mark.slow

REFUSALS = ValueError, SimulationFailed, NoEquilibrium, GradientFailed, NotImplementedError
WILD = 0.0, -1.0, float("nan"), float("inf"), -float("inf"), 1e-300, 1e308, 1e30, -1e5
grad = partial(torch.autograd.grad, allow_unused=True, materialize_grads=True)
SIZES = "pad.length", "pad.height", "disc.radius", "bracket.cm_height", "contact.node_spacing"
"""Numbers that leave no rig if they are changed much."""


class Network(nn.Module):
    """A slip rate by a small network."""

    def __init__(self) -> None:
        super().__init__()
        self.mu = nn.Sequential(nn.Linear(2, 4), nn.Tanh(), nn.Linear(4, 1), nn.Tanh()).double()

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        mu = 0.3 + 0.2 * self.mu(torch.stack((E, F_N), -1) / 10)[..., 0]
        return (E - mu * F_N).clamp(min=0.0) / (R + 10.0)


# random models
# ----------------------------------------------------------------------


def spread(rng: np.random.Generator, value: float, decades: float) -> float:
    return float(value * 10 ** rng.uniform(-decades, decades))


def settings(rng: np.random.Generator) -> Parameters:
    """Numbers about the usual ones, near for some models and three decades away for others."""
    decades, base = float(rng.choice([0.1, 0.5, 1.0, 3.0])), PAPER
    values: dict[str, Any] = {
        name: spread(rng, row["value"], min(decades, 0.02) if name in SIZES else decades)
        for name, row in base.table().items()
        if isinstance(row["value"], float) and "scenario" not in name and rng.random() < 0.4
    }
    values |= {name: choices[rng.integers(len(choices))] for name, choices in CHOICES.items()}
    values["pad.nu"] = float(rng.uniform(-0.9, 0.499))
    values["contact.mu_k"] = values.get("contact.mu_s", base.contact.mu_s) * rng.uniform(0.3, 1.0)
    return base.override(values)


CHOICES: dict[str, Any] = {
    "pad.elements_x": range(8, 33),
    "pad.elements_y": (1, 2, 3),
    "pad.fidelity": ("massless", "massless", "inertial"),
    "pad.enclosed": (False, False, False, False, True),
    "contact.friction": ("smooth", "smooth", "coulomb"),
    "contact.points": (0, 1, 2),
}


def build(rng: np.random.Generator) -> tuple[Excitation, Rig]:
    """A motion, and a rig of random parts; of one rig in seven a number is set to what it cannot
    be."""
    near = partial(spread, rng, decades=float(rng.choice([0.3, 1.0])))
    some = lambda *options: options[rng.integers(len(options))]
    motion = some(
        Roll(travel=near(5e-3)),
        Strokes(travel=near(5e-3), stroke_time=0.05),
        MultiSine(amplitude_x=near(2e-3), frequency=(5.0, 40.0), seed=int(rng.integers(99))),
        Chirp(amplitude_x=near(1e-3), start=2.0, end=30.0),
        Press(amplitude=near(2e-4), frequency=20.0),
    )
    excitation = Excitation(
        motion=motion, duration=0.45, depth=spread(rng, 1e-3, 0.5), grasp=0.06, since=0.08,
        senses=some("disc", "bracket"),
    )  # fmt: skip
    p = excitation.settings(settings(rng))
    r, rubber = p.disc.radius, (p.pad.nu, p.pad.rho, p.pad.tau, p.pad.depth)
    box = RoundedBox(r, r, r * float(rng.uniform(0.3, 0.9)))
    oval = Ellipse(spread(rng, r, 0.05), spread(rng, r, 0.05))
    usual = KelvinVoigt(p.pad.E, *rubber)
    solid = StandardLinearSolid(p.pad.E, p.pad.E * float(rng.uniform(0.9, 4.0)), *rubber)
    torch.manual_seed(int(rng.integers(99)))
    law = some(None, None, None, Network(), lambda E, F_N, R: (E - 0.3 * F_N).clamp(min=0.0) / R)
    model = still(
        p, friction=law, shape=some(*[Circle(r)] * 4, oval, box), material=some(*[usual] * 5, solid)
    )
    numbers = [x for x in model.parameters() if x.ndim == 0]
    if rng.random() < 0.15:
        some(*numbers).data.fill_(float(rng.choice(WILD)))
    return excitation, model


def balanced(run: Trajectory, said: list[str]) -> None:
    """Raises `AssertionError` for a run that is not finite, or loses energy without a word."""
    stored, out, put_in = (
        torch.stack(list(x.values())).sum(0) for x in (run.energy, run.dissipated, run.supplied)
    )
    kinds = run.channels, run.force, run.loads, run.energy, run.dissipated, run.supplied
    parts = [run.y, run.injected, *(x for kind in kinds for x in kind.values())]
    assert all(bool(torch.isfinite(x).all()) for x in parts), "not finite"
    scale = max(float(stored[0] + run.injected[-1]), NEGLIGIBLE)
    residual = float((stored - stored[0] + out - put_in).abs().max()) / scale
    told = any("do not balance" in text for text in said)
    assert residual <= RESIDUAL or told, f"energy residual {residual:.3g} without a word"
    assert not any("\n" in text for text in said), f"a warning of several lines: {said}"


def run_randomly(rng: np.random.Generator) -> bool:
    """A run of a random model, at times with gradients; true at its end."""
    motion, model = build(rng)
    t = torch.linspace(0, motion.duration, int(rng.integers(3, 40)), dtype=torch.float64)
    steps = float(rng.choice([5e-4, 1e-3, 2e-3, 2e-3, 5e-3, 2e-2]))
    by: Any = {"step": steps} if rng.random() < 0.5 else {"rtol": float(rng.choice([1e-5, 1e-3]))}
    how = by | {"tolerance": float(rng.choice([1e-10, 1e-9, 1e-7]))}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        y0 = start(model).detach()
        height = float(model.unpack(y0).pose["bracket"][1])
        model.reference = reference(motion, model, height, spread(rng, 5.0, 0.7))
        run = simulate(model, t, y0=y0, **how)
    balanced(run, [str(w.message) for w in caught])
    if rng.random() < 0.1:
        leaves = [p for p in model.parameters() if p.requires_grad]
        again = simulate(model, t[:5], y0=y0, gradient="discrete", **how)
        gradients = grad(again["x_C"][-1], leaves)
        assert all(bool(torch.isfinite(g).all()) for g in gradients), "a gradient is not finite"
    return True


@pytest.mark.timeout(1800)
def test_random_models_run_or_say_why_not(tally):
    line, ran = tally("random models"), 0
    for number in range(count(1000)):
        run = partial(run_randomly, random("models", number))
        ran += bool(line.call(f"model {number}", run, REFUSALS, limit=30.0))
    assert ran >= 0.3 * line.tried, f"only {ran} of {line.tried} models ran"


# threads
# ----------------------------------------------------------------------

T = times(6e-3, 4)
THREADS, RUNS, MOTIONS = 8, 100, 5


def law(number: int) -> Callable[..., Tensor]:
    """A friction law of one's own, compiled anew."""
    mu = 0.2 + 0.01 * number
    return lambda E, F_N, R: (E - mu * F_N).clamp(min=0.0) / (R + 10.0 + number)


def together(line: Tally, run: Callable[[int, int], list[Tensor]], runs: int) -> None:
    """Runs in `THREADS` threads that begin at once have the bits of the same runs alone."""
    barrier = Barrier(THREADS)

    def work(thread: int) -> list[Any]:
        barrier.wait()
        return [run(thread, i) for i in range(runs)]

    with ThreadPoolExecutor(THREADS) as pool:
        done = [pool.submit(work, thread) for thread in range(THREADS)]
    for thread, future in enumerate(done):
        results = future.result() if future.exception() is None else [[]] * runs
        for i, found in enumerate(results):
            alone = run(thread, i)
            same = len(found) == len(alone) and all(map(torch.equal, found, alone))
            line.held(same, f"thread {thread}, run {i}: other bits, or {future.exception()!r}")


@pytest.mark.filterwarnings("ignore:the energies of the run")
def test_threads_give_the_bits_of_runs_alone(tally):
    """Eight threads, a hundred runs with gradients in each; two threads share a model."""
    models = [
        coarse(pad__elements_x=24),
        coarse(pad__elements_x=24, pad__inertial=True),
        coarse(pad__elements_x=24, contact__points=2),
        still(coarse(pad__elements_x=24).settings, friction=law(20)),
    ]
    starts = [grasp(model, (0.05, 0.0)) for model in models]

    def run(thread: int, number: int) -> list[Tensor]:
        """States, forces and derivatives."""
        model, (y0, held) = models[thread % 4], starts[thread % 4]
        x = Profile([0.0, 6e-3], [0.06, 0.06 + 2e-5 * ((thread + number) % MOTIONS)])
        moved = Reference(x_d=x, y_d=held["y_d"], F_ff=held["F_ff"])
        how = {"y0": y0, "reference": moved}
        if number % 4 == 3:
            run = simulate(model, T, **how, gradient="forward", wrt=["pad.E", "contact.K_n"])
            return [run.y, run.force["L"], run.sensitivities]
        run = simulate(model, T, **how, gradient="discrete")
        loss = run["theta"][-1] + 1e2 * run["x_C"][-1]
        leaves = [p for p in model.parameters() if p.requires_grad]
        return [run.y.detach(), run.force["L"], *grad(loss, leaves)]

    together(tally("runs with gradients in threads"), run, count(RUNS))


def test_laws_first_compiled_in_many_threads_are_right(tally):
    """Every thread meets the same new law at the same time, round after round."""
    line, base = tally("laws first compiled in threads"), coarse(pad__elements_x=24)
    y0, held = grasp(base, (0.05, 0.0))
    for number in range(count(15)):
        models = [still(base.settings, friction=law(number)) for _ in range(THREADS)]
        run = lambda k, _, models=models: [simulate(models[k], T, y0=y0, reference=held).y]
        together(line, run, 1)
