"""Random rigs and short motions: what the random runs draw."""

import math
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from torchsoft import Parameters, SoftGrasp
from torchsoft.excitation import FADE, Chirp, Excitation, MultiSine, Press, Roll, RunContext, Strokes, begin
from torchsoft.experiment import grid
from torchsoft.paper.equilibrium import holding_force, press, rest
from torchsoft.scenario import reference

SCALED = (
    "pad.E", "pad.tau", "contact.K_n", "contact.R_n", "contact.K_t", "contact.R_t", "contact.eta", "contact.v_s",
    "contact.epsilon", "disc.mass", "bracket.mass", "control.K_81", "control.R_80", "control.K_98", "control.R_99",
)  # fmt: skip
"""Drawn log-uniformly by a factor of 10 about their defaults."""

GRASP, SETTLE, MOVING = 0.1, 0.02, 0.18
"""Times [s] of the grasp, of the pause and of the motion after it; waves take what their fading needs more."""


def settings(rng: np.random.Generator) -> Parameters:
    """Random parameters; raises `ValueError` for a rig that does not exist."""
    defaults, changes = Parameters().table(), dict[str, Any]()
    for name in SCALED:
        changes[name] = defaults[name]["value"] * 10.0 ** rng.uniform(-1, 1)
    changes["contact.mu_s"] = math.exp(rng.uniform(math.log(0.05), math.log(2.0)))
    changes["contact.mu_k"] = changes["contact.mu_s"] * rng.uniform(0.3, 1.0)
    changes["pad.nu"] = rng.uniform(0.0, 0.495)
    changes["pad.depth"] = defaults["pad.depth"]["value"] * 3.0 ** rng.uniform(-1, 1)
    changes["pad.height"] = defaults["pad.height"]["value"] * rng.uniform(0.7, 1.5)
    wide = 2 * changes["pad.height"] + 2 * defaults["disc.radius"]["value"] + defaults["bracket.cm_height"]["value"]
    changes["scenario.y_Br_grasp"] = wide - 1e-3  # every excitation has its own
    changes["pad.elements_x"], changes["pad.elements_y"] = [(40, 2), (60, 2), (120, 4)][rng.integers(3)]
    changes["contact.friction"] = rng.choice(["smooth", "coulomb"], p=[0.75, 0.25]).item()
    changes["contact.points"] = int(rng.choice([0, 2], p=[0.75, 0.25]))
    return Parameters().override(changes)


def excitation(rng: np.random.Generator) -> Excitation:
    """A random motion after a random grasp."""
    low, high = sorted(np.exp(rng.uniform(math.log(1.0), math.log(40.0), 2)))
    x, y = np.exp(rng.uniform(np.log([2e-4, 2e-5]), np.log([1e-2, 3e-4])))
    waves = MOVING + FADE
    motion, moving = [
        (Roll(travel=x), MOVING),
        (Strokes(travel=2 * x, stroke_time=math.exp(rng.uniform(math.log(0.02), math.log(0.18)))), MOVING),
        (MultiSine(amplitude_x=x, amplitude_y=y, frequency=(low, high), seed=int(rng.integers(1000))), waves),
        (Chirp(amplitude_x=x, amplitude_y=y, start=low, end=high), waves),
        (Press(amplitude=y, frequency=high, travel=x), waves),
    ][rng.integers(5)]
    return Excitation(
        motion=motion, duration=GRASP + SETTLE + moving, grasp_time=GRASP, settle=SETTLE,
        depth=math.exp(rng.uniform(math.log(2e-4), math.log(2e-3))), senses=rng.choice(["bracket", "disc"]).item(),
    )  # fmt: skip


class Drawn(NamedTuple):
    """A model and its start, its output times (T,) [s], and what it does."""

    begun: RunContext
    t: Tensor
    motion: str


def draw(rng: np.random.Generator) -> Drawn:
    """A random run; raises `ValueError` or `NoEquilibrium` if it has no start."""
    wanted, p = excitation(rng), settings(rng)
    if rng.random() < 0.8:
        return Drawn(begin(wanted, p), grid(wanted.duration), wanted.motion.kind)
    own = {"scenario.grasp_time": GRASP, "scenario.roll_time": 0.5, "scenario.travel": -2e-3}
    model = SoftGrasp(p.override(own))
    force = holding_force(model, press(model, model.settings.scenario.y_Br_grasp))
    y0 = rest(model).detach()
    model.reference = reference(model, y0, force)
    return Drawn(RunContext(model, y0), grid(GRASP + SETTLE + MOVING), "grasp_and_roll")
