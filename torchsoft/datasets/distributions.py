"""Distributions of the parameters that differ between trajectories, as quantile functions of u in
[0, 1], a coordinate of the design."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    model_serializer,
    model_validator,
)
from scipy.special import ndtr, ndtri

from torchsoft.datasets.rig_files import place
from torchsoft.rigs.build import RigFile
from torchsoft.tables import LISTED, Table, is_huge

WIDTH = 4.0
"""Default distance of both bounds of a normal distribution from its mean, in standard
deviations."""

SURE = 1e-12
"""Least probability between the bounds of a normal distribution; below it, quantiles are rounding
errors."""


class Related(Table):
    """A drawn parameter; with `ratio_to`, a multiple of the parameter of that name."""

    ratio_to: str | None = None
    """another parameter: the drawn number is then multiplied by its value"""

    @property
    def related(self) -> str:
        """The parameter that it multiplies, in words."""
        return f", times `{self.ratio_to}`" if self.ratio_to else ""

    @model_serializer(mode="wrap")
    def _only_what_is_said(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        unsaid = {"ratio_to": None, "either_sign": False}
        return {key: x for key, x in handler(self).items() if unsaid.get(key, ...) != x}


class Uniform(Related):
    """Uniform from `low` to `high`, in the value or in its logarithm; with `either_sign`, the sign
    is positive or negative with equal probability."""

    low: float
    """lowest value [the parameter's unit]"""
    high: float
    """highest value [the parameter's unit]"""
    scale: Literal["linear", "log"] = "linear"
    """"log": draw the logarithm uniformly"""
    either_sign: bool = False
    """true: positive or negative with equal probability"""

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low = {self.low} exceeds high = {self.high}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"a logarithmic range needs low > 0, but low = {self.low}")
        return self

    @property
    def words(self) -> str:
        """The distribution in words."""
        scale = ", logarithmic" if self.scale == "log" else ""
        sign = ", of either sign" if self.either_sign else ""
        return f"{self.low:g} to {self.high:g}{scale}{sign}{self.related}"

    def at(self, u: float) -> float:
        """The value at u in [0, 1]."""
        if self.either_sign:
            half = self.model_copy(update={"either_sign": False})
            return half.at(2 * u - 1) if u >= 0.5 else -half.at(1 - 2 * u)
        low, high = self.low, self.high
        if self.scale == "log":
            value = math.exp(math.log(low) + u * (math.log(high) - math.log(low)))
            return min(max(value, low), high)  # the ends are not rounded beyond themselves
        return low + u * (high - low)

    def ends(self, where: str) -> dict[str, float]:
        """Both bounds by their names in messages, and their negatives where the sign varies."""
        ends = {f"{where}.low": self.low, f"{where}.high": self.high}
        return ends | {f"-{name}": -x for name, x in ends.items() if self.either_sign}


class Normal(Related):
    """Normal with mean `mean` and standard deviation `sd`, truncated at `low` and `high`, by
    default four standard deviations from the mean."""

    mean: float
    """mean [the parameter's unit]"""
    sd: float = Field(gt=0)
    """standard deviation [the parameter's unit]"""
    low: float = math.nan
    """lower bound; four standard deviations below the mean if not given [the parameter's unit]"""
    high: float = math.nan
    """upper bound; four standard deviations above the mean if not given [the parameter's unit]"""
    scale: ClassVar[Literal["linear"]] = "linear"

    @model_validator(mode="before")
    @classmethod
    def _is_cut(cls, data: Any) -> Any:
        given = data if isinstance(data, Mapping) else {}
        mean, sd = (given.get(key) for key in ("mean", "sd"))
        if not isinstance(mean, int | float) or not isinstance(sd, int | float):
            return data
        if is_huge(mean) or is_huge(sd):
            return data
        return {"low": mean - WIDTH * sd, "high": mean + WIDTH * sd} | dict(data)

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if not self.low < self.high:
            raise ValueError(
                f"low = {self.low} should be below high = {self.high}; without stated bounds "
                f"they are {WIDTH:g} times sd = {self.sd} from mean = {self.mean}"
            )
        below, above = self._tails
        if not above - below > SURE:
            raise ValueError(
                f"next to nothing of mean = {self.mean}, sd = {self.sd} lies between low = "
                f"{self.low} and high = {self.high}"
            )
        return self

    @property
    def words(self) -> str:
        """The distribution in words."""
        spread = f"normal, mean {self.mean:g}, standard deviation {self.sd:g}"
        return f"{spread}, {self.low:g} to {self.high:g}{self.related}"

    @property
    def _tails(self) -> tuple[float, float]:
        """Cumulative probabilities of the untruncated distribution at both bounds."""
        ends = (self.low - self.mean) / self.sd, (self.high - self.mean) / self.sd
        return float(ndtr(ends[0])), float(ndtr(ends[1]))

    def at(self, u: float) -> float:
        """The quantile at u in [0, 1]."""
        below, above = self._tails
        value = self.mean + self.sd * float(ndtri(below + u * (above - below)))
        return min(max(value, self.low), self.high)

    def ends(self, where: str) -> dict[str, float]:
        """Both bounds by their names in messages."""
        reach = WIDTH * self.sd
        cut = self.low == self.mean - reach, self.high == self.mean + reach
        low = f"{where}: mean - {WIDTH:g} sd" if cut[0] else f"{where}.low"
        high = f"{where}: mean + {WIDTH:g} sd" if cut[1] else f"{where}.high"
        return {low: self.low, high: self.high}


class Choice(Related):
    """One of the numbers `choices`, with equal probability."""

    choices: Annotated[tuple[float, ...], LISTED] = Field(min_length=1, max_length=10_000)
    """values, drawn with equal probability [the parameter's unit]"""
    scale: ClassVar[Literal["linear"]] = "linear"

    @property
    def words(self) -> str:
        """The distribution in words."""
        return f"one of {', '.join(f'{x:g}' for x in self.choices)}{self.related}"

    @property
    def low(self) -> float:
        return min(self.choices)

    @property
    def high(self) -> float:
        return max(self.choices)

    def at(self, u: float) -> float:
        """The quantile at u in [0, 1]."""
        return self.choices[min(int(u * len(self.choices)), len(self.choices) - 1)]

    def ends(self, where: str) -> dict[str, float]:
        """Every choice by its name in messages."""
        return {f"{where}.choices.{i}": x for i, x in enumerate(self.choices)}


def distribution(given: Any) -> str:
    """Tag of the distribution that a table states, by its keys."""
    keys = given if isinstance(given, Mapping) else getattr(type(given), "model_fields", ())
    return "choice" if "choices" in keys else "normal" if {"mean", "sd"} & {*keys} else "uniform"


Distribution = Annotated[
    Annotated[Uniform, Tag("uniform")]
    | Annotated[Normal, Tag("normal")]
    | Annotated[Choice, Tag("choice")],
    Discriminator(distribution),
]


class Kind(Table):
    """A kind of trajectory, drawn with probability proportional to `weight`. `fixed` holds its
    constants, such as a whole motion; `parameters` are added to those of all kinds, or replace
    them."""

    name: str = Field(min_length=1, max_length=100)
    """name in the array `kind`"""
    weight: float = Field(default=1.0, ge=1e-6, le=1e6)
    """relative frequency of this kind [1]"""
    fixed: dict[str, Any] = Field(default_factory=dict)
    """fields or whole tables of the rig file, such as a motion, by dotted name"""
    parameters: dict[str, Distribution] = Field(default_factory=dict)
    """distributions of this kind, added to those of all kinds or in place of them"""


def in_ratio(
    file: RigFile, parameters: Mapping[str, Distribution], drawn: Mapping[str, float]
) -> dict[str, float]:
    """Parameters by name from the drawn numbers, which are values or ratios to other parameters."""
    out = dict(drawn)
    for name, one in parameters.items():
        if (base := one.ratio_to) is not None:
            of = drawn[base] if base in drawn else place(file, base).value
            out[name] = drawn[name] * of
    return out
