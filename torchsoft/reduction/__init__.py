"""Reduced models: sparse equations of the disc's and the bracket's motion, recovered from runs of the full model."""

from torchsoft.reduction.fit import Choice, Recipe, assemble, choose, fit, rollout_of, score
from torchsoft.reduction.ode import ReducedModel
from torchsoft.reduction.records import Record, noisy, record, rolling_radius
from torchsoft.reduction.terms import friction, joined, mechanics, polynomials

__all__ = [
    "Choice",
    "Recipe",
    "Record",
    "ReducedModel",
    "assemble",
    "choose",
    "fit",
    "friction",
    "joined",
    "mechanics",
    "noisy",
    "polynomials",
    "record",
    "rolling_radius",
    "rollout_of",
    "score",
]  # fmt: skip
