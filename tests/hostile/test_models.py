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
from conftest import COARSE, PAPER, coarse, grasp, rolled, still, times
from torch import Tensor, nn

from hostile.trial import Tally, count, random
from torchsoft import (
    BuiltRig,
    Ellipse,
    Profile,
    Reference,
    RigFile,
    RoundedBox,
    SimulationFailed,
    Trajectory,
    simulate,
)
from torchsoft.physics.statics import NoEquilibrium
from torchsoft.rigs.excite import Excitation, excite
from torchsoft.solve.diagnostics import NEGLIGIBLE, RESIDUAL
from torchsoft.solve.gradients import GradientFailed

pytestmark = pytest.mark.slow

REFUSALS = ValueError, SimulationFailed, NoEquilibrium, GradientFailed, NotImplementedError
WILD = 0.0, -1.0, float("nan"), float("inf"), -float("inf"), 1e-300, 1e308, 1e30, -1e5
grad = partial(torch.autograd.grad, allow_unused=True, materialize_grads=True)
SIZES = ("length", "height", "radius", "origin", "elements_x", "elements_y", "x", "theta", "nu")
"""Numbers that leave no rig if they are changed much, or at all."""


class Network(nn.Module):
    """A coefficient of friction that a small network makes of the normal force."""

    def __init__(self) -> None:
        super().__init__()
        self.mu = nn.Sequential(nn.Linear(1, 4), nn.Tanh(), nn.Linear(4, 1), nn.Tanh()).double()

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        mu = 0.3 + 0.2 * self.mu(F_N[..., None] / 10)[..., 0]
        return (E - mu * F_N).clamp(min=0.0) / R


# random models
# ----------------------------------------------------------------------


def spread(rng: np.random.Generator, value: float, decades: float) -> float:
    return float(value * 10 ** rng.uniform(-decades, decades))


def numbers(rng: np.random.Generator) -> RigFile:
    """Numbers about the usual ones, near for some models and three decades away for others."""
    decades = float(rng.choice([0.1, 0.5, 1.0, 3.0]))
    values: dict[str, Any] = {
        name: spread(rng, row["value"], decades)
        for name, row in PAPER.table().items()
        if isinstance(row["value"], float) and name.rpartition(".")[2] not in SIZES
        and rng.random() < 0.4
    }  # fmt: skip
    values |= {name: choices[rng.integers(len(choices))] for name, choices in CHOICES.items()}
    values["pad.nu"] = float(rng.uniform(-0.9, 0.499))
    values["disc.radius"] = spread(rng, 19.37e-3, 0.02)
    values["contact.mu_k"] = values.get(f"{FRICTION}.mu_s", 0.8) * rng.uniform(0.3, 1.0)
    if rng.random() < 0.2:
        values |= dict.fromkeys(("pads.L.bonded_sides", "pads.U.bonded_sides"), True)
    return PAPER.override(values)


FRICTION = "laws.steel_on_rubber.friction"
CHOICES: dict[str, Any] = {
    "pad.elements_x": range(8, 33),
    "pad.elements_y": (1, 2, 3),
    "pad.inertial": (False, False, True),
    "contact.points": (0, 1, 2),
}


def build(rng: np.random.Generator) -> BuiltRig:
    """A rig of random parts under a random motion; of one in seven a number is set to what it
    cannot be."""
    near = partial(spread, rng, decades=float(rng.choice([0.3, 1.0])))
    some = lambda *options: options[rng.integers(len(options))]
    sines = {"kind": "multi_sine", "band": (5.0, 40.0), "seed": int(rng.integers(99))}
    sweep = {"kind": "chirp", "first": 2.0, "last": 30.0}
    roll, press = some(
        (rolled(near(5e-3), 0.45, 0.08), None),
        ({"kind": "strokes", "travel": near(5e-3), "stroke_time": 0.05}, None),
        (sines | {"amplitude": near(2e-3)}, sines | {"amplitude": 2e-4}),
        (sweep | {"amplitude": near(1e-3)}, sweep | {"amplitude": 1e-4}),
        (rolled(5e-3, 0.45, 0.08), sweep | {"amplitude": near(2e-4), "first": 20.0, "last": 20.0}),
    )
    excitation = Excitation(
        roll, press, duration=0.45, depth=spread(rng, 1e-3, 0.5), grasp=0.06, since=0.08
    )
    file = excite(numbers(rng), excitation, senses=some("disc", None))
    r, rubber = file.bodies["disc"].shape.radius, file.materials["rubber"]
    box = RoundedBox(r, r, r * float(rng.uniform(0.3, 0.9)))
    oval = Ellipse(spread(rng, r, 0.05), spread(rng, r, 0.05))
    torch.manual_seed(int(rng.integers(99)))
    law = some(None, None, None, Network(), lambda E, F_N, R: (E - 0.3 * F_N).clamp(min=0.0) / R)
    parts: dict[str, Any] = {FRICTION: law, "bodies.disc.shape": some(*[None] * 4, oval, box)}
    if rng.random() < 1 / 6:
        stiff = rubber.E * float(rng.uniform(0.9, 4.0))
        solid = {"kind": "standard_linear_solid", "E_instant": stiff}
        own = rubber.model_dump(include={"E", "nu", "rho", "tau", "depth"}, exclude_unset=True)
        file = file.override({"materials.rubber": own | solid})
    if rng.random() < 1 / 3:
        mu = file.laws["steel_on_rubber"].friction
        file = file.override({FRICTION: {"kind": "coulomb", "mu_s": mu.mu_s, "mu_k": mu.mu_k}})
    built = file.build({name: part for name, part in parts.items() if part is not None})
    scalars = [x for x in built.rig.parameters() if x.ndim == 0]
    if rng.random() < 0.15:
        some(*scalars).data.fill_(float(rng.choice(WILD)))
    return built


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
    t = torch.linspace(0, 0.45, int(rng.integers(3, 40)), dtype=torch.float64)
    steps = float(rng.choice([5e-4, 1e-3, 2e-3, 2e-3, 5e-3, 2e-2]))
    by: Any = {"step": steps} if rng.random() < 0.5 else {"rtol": float(rng.choice([1e-5, 1e-3]))}
    how = by | {"tolerance": float(rng.choice([1e-10, 1e-9, 1e-7]))}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model, y0, _ = build(rng)
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


SAID = pytest.mark.filterwarnings("ignore:the energies of the run", "ignore:the slip law of")


@SAID
def test_threads_give_the_bits_of_runs_alone(tally):
    """Eight threads, a hundred runs with gradients in each; two threads share a model."""
    base = COARSE | {"pad.elements_x": 24}
    models = [
        coarse(pad__elements_x=24),
        coarse(pad__elements_x=24, pad__inertial=True),
        coarse(pad__elements_x=24, contact__points=2),
        still(base, friction=law(20)),
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


@SAID
def test_laws_first_compiled_in_many_threads_are_right(tally):
    """Every thread meets the same new law at the same time, round after round."""
    line, base = tally("laws first compiled in threads"), COARSE | {"pad.elements_x": 24}
    y0, held = grasp(still(base), (0.05, 0.0))
    for number in range(count(15)):
        models = [still(base, friction=law(number)) for _ in range(THREADS)]
        run = lambda k, _, models=models: [simulate(models[k], T, y0=y0, reference=held).y]
        together(line, run, 1)
