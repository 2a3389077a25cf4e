"""Random models: a run is finite and its energies balance or it warns that they do not, or it fails
in one sentence, in time."""

import copy
import warnings
from collections.abc import Callable
from functools import partial, reduce
from operator import getitem

import numpy as np
import pytest
import torch
from torch import Tensor

from hostile.damage import leaves
from hostile.specimens import rigs
from hostile.trial import count, random
from torchsoft import (
    BuiltRig,
    Ellipse,
    NoEquilibrium,
    RigFile,
    RoundedBox,
    SimulationFailed,
    simulate,
)
from torchsoft.solve.diagnostics import NEGLIGIBLE, RESIDUAL
from torchsoft.solve.gradients import GradientFailed

pytestmark = pytest.mark.slow

REJECTIONS = ValueError, SimulationFailed, NoEquilibrium, GradientFailed, NotImplementedError
WILD = 0.0, -1.0, float("nan"), float("inf"), 1e-300, 1e308, -1e5
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
    tree = copy.deepcopy(some(*rigs()))
    for group in ("materials", "laws", "actuators"):
        for place, value in leaves(tree.get(group, {})):
            if isinstance(value, float) and place[-1] != "nu" and rng.random() < 0.4:
                reduce(getitem, place[:-1], tree[group])[place[-1]] = near(value)
    for material in tree["materials"].values():
        material["nu"] = float(rng.uniform(-0.9, 0.499))
        if material["kind"] == "kelvin_voigt" and rng.random() < 1 / 6:
            E = material["E"] * rng.uniform(0.9, 4.0)
            material |= {"kind": "standard_linear_solid", "E_instant": E}
    for pad in (pad for pad in tree["pads"].values() if "elements_x" in pad):
        pad |= {
            "elements_x": some(*range(8, 33)), "elements_y": some(1, 2, 3),
            "points": some(0, 1, 2), "inertial": some(False, False, True),
            "bonded_sides": some(False, False, True),
        }  # fmt: skip
    parts = {}
    for name, contact_law in tree["laws"].items():
        friction = contact_law["friction"]
        friction["mu_k"] = friction["mu_s"] * rng.uniform(0.3, 1.0)
        parts |= some({}, {}, {f"laws.{name}.friction": law(3)})
    for name, body in tree["bodies"].items():
        if r := body.get("shape", {}).get("radius"):
            oval, box = Ellipse(near(r, 0.05), near(r, 0.05)), RoundedBox(r, r, 0.6 * r)
            parts |= some({}, {}, *({f"bodies.{name}.shape": one} for one in (oval, box)))
    built = RigFile.from_tree(tree).build(parts)
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
        wanted = [p for p in model.parameters() if p.requires_grad]
        again = simulate(model, t[:5], y0=y0, gradient="discrete", **how)
        gradients = grad(again.y[-1].sum(), wanted)
        assert all(bool(torch.isfinite(g).all()) for g in gradients), "a gradient is not finite"
    return True


@pytest.mark.timeout(1800)
def test_random_models_run_or_say_why_not(tally):
    ran = 0
    for number in range(count(1000)):
        run = partial(run_randomly, random("models", number))
        ran += bool(tally.call(f"model {number}", run, REJECTIONS, limit=30.0))
    assert ran >= 0.3 * tally.tried, f"only {ran} of {tally.tried} models ran"
