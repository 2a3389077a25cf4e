"""Random models, and models in many threads: a run is finite and its energies balance or it warns
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
from conftest import COARSE, PAPER, grasped, still, times, towards
from torch import Tensor

from hostile.trial import count, random
from torchsoft import (
    BuiltRig,
    Ellipse,
    NoEquilibrium,
    Profile,
    RoundedBox,
    SimulationFailed,
    excite,
    simulate,
)
from torchsoft.rigs.excite import Excitation
from torchsoft.solve.diagnostics import NEGLIGIBLE, RESIDUAL
from torchsoft.solve.gradients import GradientFailed

pytestmark = pytest.mark.slow

REJECTIONS = ValueError, SimulationFailed, NoEquilibrium, GradientFailed, NotImplementedError
WILD = 0.0, -1.0, float("nan"), float("inf"), 1e-300, 1e308, -1e5
FRICTION = "laws.steel_on_rubber.friction"
SIZES = ("length", "height", "radius", "origin", "elements_x", "elements_y", "x", "theta", "nu")
"""Values that leave no rig if they are changed much, or at all."""
grad = partial(torch.autograd.grad, allow_unused=True, materialize_grads=True)


def law(number: int) -> Callable[..., Tensor]:
    """A custom friction law, compiled anew."""
    mu = 0.2 + 0.01 * number
    return lambda E, F_N, R: (E - mu * F_N).clamp(min=0.0) / (R + 10.0 + number)


def build(rng: np.random.Generator) -> BuiltRig:
    """A rig of random parts under a random motion, with values near the usual ones for some and
    three decades away for others; in one of seven a value is set to what it cannot be."""
    decades = float(rng.choice([0.1, 0.5, 1.0, 3.0]))
    near = lambda value, decades=decades: float(value * 10 ** rng.uniform(-decades, decades))
    some = lambda *options: options[rng.integers(len(options))]
    values: dict[str, Any] = {
        name: near(row["value"])
        for name, row in PAPER.table().items()
        if isinstance(row["value"], float) and name.rpartition(".")[2] not in SIZES
        and rng.random() < 0.4
    }  # fmt: skip
    values |= {
        "pad.elements_x": some(*range(8, 33)), "pad.elements_y": some(1, 2, 3),
        "contact.points": some(0, 1, 2), "pads.L.bonded_sides": some(False, False, True),
        "pad.nu": float(rng.uniform(-0.9, 0.499)),
        "contact.mu_k": values.get(f"{FRICTION}.mu_s", 0.8) * rng.uniform(0.3, 1.0),
        "pad.inertial": some(False, False, True),
    }  # fmt: skip
    sines = {"kind": "multi_sine", "band": (5.0, 40.0), "seed": int(rng.integers(99))}
    roll, press = some(
        ({"kind": "strokes", "travel": near(5e-3), "stroke_time": 0.05}, None),
        (sines | {"amplitude": near(2e-3)}, sines | {"amplitude": 2e-4}),
        ({"kind": "chirp", "first": 2.0, "last": 30.0, "amplitude": near(1e-3)}, None),
    )
    motion = Excitation(roll, press, duration=0.45, depth=near(1e-3, 0.5), grasp=0.06, since=0.08)
    file = excite(PAPER.override(values), motion, senses=some("disc", None))
    r, rubber = file.bodies["disc"].shape.radius, file.materials["rubber"]
    shape = some(None, None, Ellipse(near(r, 0.05), near(r, 0.05)), RoundedBox(r, r, 0.6 * r))
    parts = {FRICTION: some(None, None, law(3)), "bodies.disc.shape": shape}
    if rng.random() < 1 / 6:
        own = rubber.model_dump(include={"E", "nu", "rho", "tau", "depth"}, exclude_unset=True)
        solid = {"kind": "standard_linear_solid", "E_instant": rubber.E * rng.uniform(0.9, 4.0)}
        file = file.override({"materials.rubber": own | solid})
    built = file.build({name: part for name, part in parts.items() if part is not None})
    if rng.random() < 0.15:
        scalars = [x for x in built.rig.parameters() if x.ndim == 0]
        some(*scalars).data.fill_(float(rng.choice(WILD)))
    return built


def run_randomly(rng: np.random.Generator) -> bool:
    """A run of a random model, at times with gradients; raises `AssertionError` for one that is not
    finite, or loses energy without a warning."""
    t = torch.linspace(0, 0.45, int(rng.integers(3, 40)), dtype=torch.float64)
    steps = {"step": float(rng.choice([5e-4, 2e-3, 2e-2]))}
    how = steps if rng.random() < 0.5 else {"rtol": float(rng.choice([1e-5, 1e-3]))}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model, y0, _ = build(rng)
        run = simulate(model, t, y0=y0, **how)
    texts = [str(w.message) for w in caught]
    stored, out, put_in = (
        torch.stack(list(x.values())).sum(0) for x in (run.energy, run.dissipated, run.supplied)
    )
    parts = [run.y, run.injected, stored, out, put_in, *run.channels.values(), *run.force.values()]
    assert all(bool(torch.isfinite(x).all()) for x in parts), "not finite"
    scale = max(float(stored[0] + run.injected[-1]), NEGLIGIBLE)
    residual = float((stored - stored[0] + out - put_in).abs().max()) / scale
    warned = any("do not balance" in text for text in texts)
    assert residual <= RESIDUAL or warned, f"energy residual {residual:.3g} without a warning"
    if rng.random() < 0.1:
        leaves = [p for p in model.parameters() if p.requires_grad]
        again = simulate(model, t[:5], y0=y0, gradient="discrete", **how)
        gradients = grad(again["x_C"][-1], leaves)
        assert all(bool(torch.isfinite(g).all()) for g in gradients), "a gradient is not finite"
    return True


@pytest.mark.timeout(1800)
def test_random_models_run_or_say_why_not(tally):
    ran = 0
    for number in range(count(1000)):
        run = partial(run_randomly, random("models", number))
        ran += bool(tally.call(f"model {number}", run, REJECTIONS, limit=30.0))
    assert ran >= 0.3 * tally.tried, f"only {ran} of {tally.tried} models ran"


T, THREADS = times(6e-3, 4), 8


@pytest.mark.filterwarnings("ignore:the energies of the run", "ignore:the slip law of")
@pytest.mark.parametrize(("number", "runs"), [(50, 2), (10, 50)], ids=["new laws", "runs"])
def test_threads_give_the_bits_of_runs_alone(number, runs, tally):
    """Eight threads that start at once, of which two share a model, round after round; with laws
    that all meet for the first time."""
    mesh = {"pad.elements_x": 24}
    for round in range(count(number)):
        models = [
            still(COARSE | mesh | own, **part)
            for own, part in (
                ({}, {}), ({"pad.inertial": True}, {}), ({"contact.points": 2}, {}),
                ({}, {"friction": law(round)}),
            )
        ]  # fmt: skip
        starts, barrier = [grasped(model, (0.05, 0.0)) for model in models], Barrier(THREADS)

        def run(thread: int, i: int, models: Any = models, starts: Any = starts) -> list[Tensor]:
            """States, forces and derivatives."""
            model, y0 = models[thread % 4], starts[thread % 4]
            x_d = Profile([0.0, 6e-3], [0.06, 0.06 + 2e-5 * ((thread + i) % 5)])
            how: dict[str, Any] = {"y0": y0, "reference": towards(model, x_d)}
            if i % 4 == 3:
                run = simulate(model, T, **how, gradient="forward", wrt=["pad.E", "contact.K_n"])
                return [run.y, run.force["L"], run.sensitivities]
            run = simulate(model, T, **how, gradient="discrete")
            leaves = [p for p in model.parameters() if p.requires_grad]
            slopes = grad(run["theta"][-1] + 1e2 * run["x_C"][-1], leaves)
            return [run.y.detach(), run.force["L"].detach(), *slopes]

        def work(thread: int, barrier: Barrier = barrier, run: Any = run) -> list[list[Tensor]]:
            barrier.wait()
            return [run(thread, i) for i in range(runs)]

        with ThreadPoolExecutor(THREADS) as pool:
            results = [*pool.map(work, range(THREADS))]
        for thread, found in enumerate(results):
            same = [all(map(torch.equal, one, run(thread, i))) for i, one in enumerate(found)]
            tally.held(all(same), f"round {round}, thread {thread}: other bits in {same}")
