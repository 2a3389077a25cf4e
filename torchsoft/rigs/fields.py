"""What the fields of a rig file are made of: numbers with unit and bounds, words, and tables that know their own keys."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Annotated, Any, Self, TypeVar

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema, core_schema
from torch import nn

from torchsoft.tables import Table, shown

M = TypeVar("M", bound=nn.Module)


class Refused(ValueError):
    """What cannot be, with the field that says so."""

    def __init__(self, field: str, sentence: str) -> None:
        super().__init__(f"{field}: {sentence}")
        self.field, self.sentence = field, sentence


@contextmanager
def at_field(field: str) -> Iterator[None]:
    """Turns errors in what a field says into `Refused`, those of a field within it too."""
    try:
        yield
    except Refused as error:
        raise Refused(f"{field}.{error.field}", error.sentence) from None
    except OSError as error:
        raise Refused(field, f"{error.filename}: {error.strerror}" if error.filename else str(error)) from None
    except (ValueError, NotImplementedError) as error:
        raise Refused(field, str(error)) from None


def sound(part: M) -> M:
    """A part whose parameters are physical together. Raises `ValueError` where they are not."""
    well_posed = getattr(part, "well_posed", None)
    if well_posed is not None and (wrong := well_posed()):
        raise ValueError(wrong)
    return part


@dataclass(frozen=True)
class Within:
    """A number from `low` to `high`, in `unit`: all three are said where another one is refused, and in the schema."""

    low: float
    high: float
    unit: str = "1"

    def check(self, x: float) -> float:
        if not self.low <= x <= self.high:
            unit = "" if self.unit == "1" else f" {self.unit}"
            raise ValueError(f"should be from {self.low:g} to {self.high:g}{unit}, not {x:g}")
        return x

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return handler(schema) | {"minimum": self.low, "maximum": self.high, "unit": self.unit}


class NumberOr:
    """A finite number in `unit`, or one of some words; None where it is `optional`."""

    def __init__(self, unit: str, *words: str, optional: bool = False) -> None:
        self.unit, self.words, self.optional = unit, words, optional

    def check(self, x: Any) -> float | str | None:
        if (isinstance(x, str) and x in self.words) or (x is None and self.optional):
            return x
        if isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x):
            return float(x)
        said = ", ".join(f'"{word}"' for word in self.words)
        raise ValueError(f"should be {said} or a number [{self.unit}], not {shown(x)}")

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [{"enum": list(self.words)}, {"type": "number", "unit": self.unit}]}


class Group(Table):
    """A table of a rig file; a key that it has not is refused with the one that may be meant."""

    @model_validator(mode="before")
    @classmethod
    def _known(cls, data: Any) -> Any:
        if isinstance(data, Mapping):
            for key in data:
                if key not in cls.model_fields:
                    near = get_close_matches(str(key), cls.model_fields, n=1)
                    meant = f"is it `{near[0]}`?" if near else f"known are {', '.join(cls.model_fields)}"
                    raise ValueError(f"`{key}` is not known here; {meant}")
        return data

    @model_validator(mode="after")
    def _has_its_kind(self) -> Self:
        """A kind counts as given, also where a class says it: files need it."""
        if "kind" in type(self).model_fields:
            self.__pydantic_fields_set__.add("kind")
        return self


Length = Annotated[float, Within(1e-6, 10.0, "m")]
"""A size."""

Place = Annotated[float, Within(-100.0, 100.0, "m")]
"""A coordinate."""

Angle = Annotated[float, Within(-1e3, 1e3, "rad")]

Mass = Annotated[float, Within(1e-6, 1e5, "kg")]

Time = Annotated[float, Within(0.0, 1e5, "s")]

Coefficient = Annotated[float, Within(0.0, 100.0)]
"""A coefficient of friction."""

Dashpot = Annotated[float, Within(0.0, 1e9, "N.s/m")]
