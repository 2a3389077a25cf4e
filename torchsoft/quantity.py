"""Quantities: unit, bounds and meaning of a number, declared once, in the signature of the
constructor that takes it.

Everything else that speaks of the number reads it there: the check of a module's parameters, the
tables of rig files, the bounds of an identification.
"""

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, get_args, get_origin


def short(x: float) -> str:
    """A number for messages: six digits, and all of them where they are needed to tell it from its
    bound."""
    if isinstance(x, int):
        text = str(x)
        return text if len(text) < 20 else f"{text[:17]}..."
    six = f"{x:g}"
    return six if float(six) == x or x != x else repr(float(x))


@dataclass(frozen=True)
class Quantity:
    """Closed interval [`low`, `high`] in `unit`, and the meaning of the number; an annotation of a
    constructor's argument, and of a pydantic field. Bounds are wide: they end where sums and
    products of such numbers would not be finite."""

    unit: str
    low: float
    high: float
    meaning: str = ""

    @property
    def range(self) -> str:
        """The interval with its unit, for messages."""
        return f"from {self.low:g} to {self.high:g}{'' if self.unit == '1' else f' {self.unit}'}"

    def check(self, x: float) -> float:
        """Raises `ValueError` for a number outside the interval."""
        if not self.low <= x <= self.high:
            raise ValueError(f"should be {self.range}, not {short(x)}")
        return x

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return handler(schema) | {"minimum": self.low, "maximum": self.high, "unit": self.unit}


def metadata(hint: Any) -> Iterator[Any]:
    """Metadata of an annotation, from the inside out."""
    for inner in get_args(hint):
        yield from metadata(inner)
    if get_origin(hint) is Annotated:
        yield from hint.__metadata__


def quantity(hint: Any) -> Quantity | None:
    """Quantity of an annotation, if it has one; text in the annotation is its meaning."""
    found = None
    for one in metadata(hint):
        if isinstance(one, Quantity):
            found = one
        elif isinstance(one, str) and found is not None:
            found = replace(found, meaning=one)
    return found


@cache
def quantities(part: type) -> Mapping[str, Quantity]:
    """Quantities of the arguments of a part's constructor, and of those of its base classes, by
    name."""
    found: dict[str, Quantity] = {}
    for owner in reversed(part.__mro__):
        arguments = (
            inspect.signature(owner.__init__).parameters if "__init__" in vars(owner) else {}
        )
        declared = {name: quantity(argument.annotation) for name, argument in arguments.items()}
        found |= {name: one for name, one in declared.items() if one is not None}
    return MappingProxyType(found)


def check_declared(part: object, *names: str) -> None:
    """Raises `ValueError` for arguments of a part, kept under their names, outside what its
    constructor declares."""
    for name in names:
        given = getattr(part, name)
        for value in given if isinstance(given, tuple) else [given]:
            try:
                quantities(type(part))[name].check(value)
            except ValueError as error:
                raise ValueError(f"`{name}` {error}") from None


def quantity_of(part: object, name: str) -> Quantity | None:
    """Quantity of the parameter `name` of a part, if its constructor declares it: "tau_2" is an
    entry of "tau", "gain_1_3" of "gain", "own_inertia" the argument "inertia"."""
    known, name = quantities(type(part)), name.removeprefix("own_")
    return known.get(name, known.get(re.sub(r"(_\d+)+$", "", name)))


Length = Annotated[float, Quantity("m", 1e-6, 10.0)]
"""A size."""

Place = Annotated[float, Quantity("m", -100.0, 100.0)]
"""A coordinate."""

Angle = Annotated[float, Quantity("rad", -1e3, 1e3)]

Points = Annotated[Iterable[tuple[float, float]], Quantity("m", -100.0, 100.0)]
"""Places in the plane."""

Mass = Annotated[float, Quantity("kg", 1e-12, 1e5, "mass")]

Inertia = Annotated[
    float, Quantity("kg.m2", 1e-24, 1e6, "moment of inertia about the centre of mass")
]

InertiaRatio = Annotated[
    float, Quantity("1", 1e-3, 1e3, "moment of inertia over that of a body of uniform density")
]

Ratio = Annotated[float, Quantity("1", 1e-3, 1e3)]

Depth = Annotated[float, Quantity("m", 1e-6, 10.0, "depth out of the plane")]

Modulus = Annotated[
    float, Quantity("Pa", 1.0, 1e13, "Young's modulus, relaxed; rubber has 0.1e6 to 10e6")
]

PoissonRatio = Annotated[float, Quantity("1", -0.999, 0.4999, "Poisson's ratio")]

Density = Annotated[float, Quantity("kg/m3", 1e-3, 1e6, "density")]

Retardation = Annotated[
    float, Quantity("s", 1e-9, 1e6, "retardation time: the dashpot's viscosity over the modulus")
]

Stiffness = Annotated[float, Quantity("N/m", 1e-3, 1e12)]

Dashpot = Annotated[float, Quantity("N.s/m", 0.0, 1e9)]

FrictionCoefficient = Annotated[float, Quantity("1", 0.0, 100.0)]

ProportionalGain = Annotated[float, Quantity("N/m, N, N.m/rad", 0.0, 1e12, "proportional gain")]

DerivativeGain = Annotated[float, Quantity("N.s/m, N.s, N.m.s/rad", 0.0, 1e12, "derivative gain")]

IntegralGain = Annotated[
    float, Quantity("N/(m.s), N/(rad.s), N.m/(rad.s)", 0.0, 1e12, "integral gain")
]

Lag = Annotated[float, Quantity("s", 0.0, 1e3, "time constant of the lag of an effort")]

EffortLimit = Annotated[
    float, Quantity("N, N.m", 1e-9, 1e9, "largest size of an effort, at which it saturates")
]

Gravity = Annotated[float, Quantity("m/s2", 0.0, 1e3, "gravitational acceleration, downwards")]

Time = Annotated[float, Quantity("s", 0.0, 1e5)]
