"""Reduced models for any rig with one body between two pads: sparse equations of the motion of the
body (`disc`) and of the base of one pad (`bracket`), recovered from runs of the full model."""

from torchsoft.reduced.fit import Choice, Recipe, assemble, choose, fit, loop, rollout_of, score
from torchsoft.reduced.ode import ReducedModel
from torchsoft.reduced.records import Record, record, rolling_radius
from torchsoft.reduced.terms import friction, joined, mechanics

__all__ = [
    "Choice", "Recipe", "Record", "ReducedModel", "assemble", "choose", "fit", "friction", "joined",
    "loop", "mechanics", "record", "rolling_radius", "rollout_of", "score",
]  # fmt: skip
