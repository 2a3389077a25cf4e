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
from conftest import coarse, grasp, times
from torch import Tensor, nn

from hostile.trial import Tally, count, random
from torchsoft import (
    Circle,
    Ellipse,
    KelvinVoigt,
    Parameters,
    Profile,
    Reference,
    RoundedBox,
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

REFUSALS = ValueError, SimulationFailed, NoEquilibrium, GradientFailed, NotImplementedError
WILD = 0.0, -1.0, float("nan"), float("inf"), -float("inf"), 1e-300, 1e308, 1e30, -1e5
SIZES = "pad.length", "pad.height", "disc.radius", "bracket.cm_height", "contact.node_spacing"
"""Numbers that leave no rig if they are changed much."""


class Network(nn.Module):
    """A slip rate by a small network."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__()
        draw = lambda *shape: nn.Parameter(torch.from_numpy(rng.standard_normal(shape)))
        self.W, self.b, self.w = draw(4, 2), draw(4), draw(4)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        hidden = torch.tanh(self.W @ torch.stack((E, F_N)) / 10 + self.b)
        mu = 0.3 + 0.2 * torch.tanh(self.w @ hidden)
        return (E - mu * F_N).clamp(min=0.0) / (R + 10.0)


# random models
# ----------------------------------------------------------------------


def spread(rng: np.random.Generator, value: float, decades: float) -> float:
    return float(value * 10 ** rng.uniform(-decades, decades))


def settings(rng: np.random.Generator) -> Parameters:
    """Numbers about the usual ones, near for some models and three decades away for others."""
    decades, base = float(rng.choice([0.1, 0.5, 1.0, 3.0])), Parameters()
    values: dict[str, Any] = {
        name: spread(rng, row["value"], min(decades, 0.02) if name in SIZES else decades)
        for name, row in base.table().items()
        if isinstance(row["value"], float)
        and not name.startswith("scenario.")
        and rng.random() < 0.4
    }
    values |= {
        "pad.nu": float(rng.uniform(-0.9, 0.499)), "pad.elements_x": int(rng.integers(8, 33)),
        "pad.elements_y": int(rng.integers(1, 4)),
        "pad.fidelity": str(rng.choice(["massless", "massless", "inertial"])),
        "pad.enclosed": bool(rng.random() < 0.2),
        "contact.friction": str(rng.choice(["smooth", "smooth", "coulomb"])),
        "contact.points": int(rng.integers(0, 3)),
        "contact.mu_k": values.get("contact.mu_s", base.contact.mu_s) * rng.uniform(0.3, 1.0),
    }  # fmt: skip
    return base.override(values)


def excitation(rng: np.random.Generator) -> Excitation:
    wide = float(rng.choice([0.3, 1.0]))
    near = partial(spread, rng, decades=wide)
    x, y, frequency = near(2e-3), near(1e-4), (5.0, 40.0)
    motions = [
        Roll(travel=near(5e-3)),
        Strokes(travel=near(5e-3), stroke_time=0.05),
        MultiSine(amplitude_x=x, amplitude_y=y, frequency=frequency, seed=int(rng.integers(99))),
        Chirp(amplitude_x=x, start=2.0, end=30.0),
        Press(amplitude=2 * y, frequency=20.0),
    ]
    return Excitation(
        motion=motions[rng.integers(5)], duration=0.45, depth=spread(rng, 1e-3, 0.5),
        grasp_time=0.06, settle=0.02, senses=("disc", "bracket")[rng.integers(2)],
    )  # fmt: skip


def build(rng: np.random.Generator, motion: Excitation) -> SoftGrasp:
    """A rig of random parts; one number in seven rigs is set to what it cannot be."""
    p = motion.settings(settings(rng))
    r, rubber = p.disc.radius, (p.pad.nu, p.pad.rho, p.pad.tau, p.pad.depth)
    shapes = [
        Ellipse(spread(rng, r, 0.05), spread(rng, r, 0.05)),
        RoundedBox(r, r, r * float(rng.uniform(0.3, 0.9))),
    ]
    solids = [StandardLinearSolid(p.pad.E, p.pad.E * float(rng.uniform(0.9, 4.0)), *rubber)]
    laws = [Network(rng), lambda E, F_N, R: (E - 0.3 * F_N).clamp(min=0.0) / R]
    some = lambda usual, *others: [*[usual] * 3, *others][rng.integers(3 + len(others))]
    shape, material = some(Circle(r), *shapes), some(KelvinVoigt(p.pad.E, *rubber), *solids)
    model = SoftGrasp(p, friction=some(None, *laws), shape=shape, material=material)
    known = dict(model.named_parameters(remove_duplicate=False))
    names = [own for own in model.aliases.values() if own in known]
    if rng.random() < 0.15:
        known[names[rng.integers(len(names))]].data.fill_(float(rng.choice(WILD)))
    return model


def balanced(run: Trajectory, said: list[str]) -> None:
    """Raises `AssertionError` for a run that is not finite, or loses energy without a word."""
    stored, out, put_in = (
        torch.stack(list(x.values())).sum(0) for x in (run.energy, run.dissipated, run.supplied)
    )
    kinds = run.channels, run.force, run.load, run.energy, run.dissipated, run.supplied
    parts = [run.y, run.injected, *(x for kind in kinds for x in kind.values())]
    assert all(bool(torch.isfinite(x).all()) for x in parts), "not finite"
    scale = max(float(stored[0] + run.injected[-1]), NEGLIGIBLE)
    residual = float((stored - stored[0] + out - put_in).abs().max()) / scale
    told = any("do not balance" in text for text in said)
    assert residual <= RESIDUAL or told, f"energy residual {residual:.3g} without a word"
    assert not any("\n" in text for text in said), f"a warning of several lines: {said}"


def run_randomly(rng: np.random.Generator) -> bool:
    """A run of a random model, at times with gradients; true at its end."""
    motion = excitation(rng)
    model = build(rng, motion)
    t = torch.linspace(0, motion.duration, int(rng.integers(3, 40)), dtype=torch.float64)
    steps = float(rng.choice([5e-4, 1e-3, 2e-3, 2e-3, 5e-3, 2e-2]))
    how = {"step": steps, "tolerance": float(rng.choice([1e-10, 1e-9, 1e-7]))}
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
        gradients = torch.autograd.grad(
            again["x_C"][-1], leaves, allow_unused=True, materialize_grads=True
        )
        assert all(bool(torch.isfinite(g).all()) for g in gradients), "a gradient is not finite"
    return True


@pytest.mark.timeout(1800)
def test_random_models_run_or_say_why_not(tally: Callable[[str], Tally]) -> None:
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


def together(function: Callable[[int], Any]) -> list[Any]:
    """Results of a function in `THREADS` threads that begin at once; exceptions in their place."""
    barrier = Barrier(THREADS)

    def work(thread: int) -> Any:
        barrier.wait()
        try:
            return function(thread)
        except Exception as error:
            return error

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, range(THREADS)))


def same(one: Any, other: list[Tensor]) -> bool:
    return isinstance(one, list) and all(map(torch.equal, one, other))


def results(model: SoftGrasp, how: dict[str, Any]) -> list[Tensor]:
    """States, forces and derivatives of one run."""
    run = simulate(model, T, **how)
    if run.sensitivities is not None:
        return [run.y, run.force["L"], run.sensitivities]
    leaves = [p for p in model.parameters() if p.requires_grad]
    loss = run["theta"][-1] + 1e2 * run["x_C"][-1]
    gradients = torch.autograd.grad(loss, leaves, allow_unused=True, materialize_grads=True)
    return [run.y.detach(), run.force["L"], *gradients]


@pytest.mark.filterwarnings("ignore:the energies of the run")
def test_threads_give_the_bits_of_runs_alone(tally: Callable[[str], Tally]) -> None:
    """Eight threads, a hundred runs with gradients in each; two threads share a model."""
    line, rng, runs = tally("runs with gradients in threads"), random("threads"), []
    for changes in ({}, {"pad__fidelity": "inertial"}, {"contact__points": 2}, None):
        model = coarse(pad__elements_x=24, **changes or {})
        if changes is None:
            model = SoftGrasp(model.settings, friction=law(20))
        y0, held = grasp(model, (0.05, 0.0))
        for _ in range(MOTIONS):
            x = Profile([0.0, 6e-3], [0.06, 0.06 + 1e-4 * float(rng.standard_normal())])
            how: dict[str, Any] = {"gradient": "discrete"}
            if rng.random() < 0.25:
                how = {"gradient": "forward", "wrt": ["pad.E", "contact.K_n"]}
            moved = Reference(x_d=x, y_d=held["y_d"], F_ff=held["F_ff"])
            runs.append((model, how | {"y0": y0, "reference": moved}))
    alone = [results(*one) for one in runs]

    def work(thread: int) -> list[bool]:
        numbers = [MOTIONS * (thread % 4) + (thread + i) % MOTIONS for i in range(count(RUNS))]
        return [same(results(*runs[number]), alone[number]) for number in numbers]

    for thread, found in enumerate(together(work)):
        for right in found if isinstance(found, list) else [False]:
            line.held(right, f"thread {thread}: other bits, or {found!r:.300}")


def test_laws_first_compiled_in_many_threads_are_right(tally: Callable[[str], Tally]) -> None:
    """Every thread meets the same new law at the same time, round after round."""
    line, base = tally("laws first compiled in threads"), coarse(pad__elements_x=24)
    y0, held = grasp(base, (0.05, 0.0))
    for number in range(count(15)):
        models = [SoftGrasp(base.settings, friction=law(number)) for _ in range(THREADS)]
        run = lambda k, models=models: [simulate(models[k], T, y0=y0, reference=held).y]
        found, alone = together(run), run(0)
        for one in found:
            line.held(same(one, alone), f"law {number}: {one!r:.300}")
