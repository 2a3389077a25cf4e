"""Fields of rig files: tables derived from constructors, and fields that take a number or a
word."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from functools import lru_cache, reduce
from inspect import signature
from operator import or_
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, get_args, get_origin

from pydantic import (
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    create_model,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from torchsoft.display import nearest
from torchsoft.physics.validity import sound
from torchsoft.quantity import metadata, quantity
from torchsoft.tables import LISTED, Table, shown


class Refused(ValueError):
    """An invalid value, with its field."""

    def __init__(self, field: str, sentence: str) -> None:
        super().__init__(f"{field}: {sentence}")
        self.field, self.sentence = field, sentence


@contextmanager
def at_field(field: str) -> Iterator[None]:
    """Turn errors in the value of a field into `Refused`, with the whole path of fields."""
    try:
        yield
    except Refused as error:
        raise Refused(f"{field}.{error.field}", error.sentence) from None
    except OSError as error:
        raise Refused(
            field, f"{error.filename}: {error.strerror}" if error.filename else str(error)
        ) from None
    except (ValueError, NotImplementedError) as error:
        raise Refused(field, str(error)) from None


class NumberOr:
    """A finite number in `unit`, or one of some words; None where it is `optional`."""

    def __init__(self, unit: str, *words: str, optional: bool = False) -> None:
        self.unit, self.words, self.optional = unit, words, optional

    def check(self, x: Any) -> float | str | None:
        if (isinstance(x, str) and x in self.words) or (x is None and self.optional):
            return x
        if isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x):
            return float(x)
        listed = ", ".join(f'"{word}"' for word in self.words)
        or_ = " or " if listed else ""
        raise ValueError(f"should be {listed}{or_}a number [{self.unit}], not {shown(x)}")

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"anyOf": [{"enum": list(self.words)}, {"type": "number", "unit": self.unit}]}


AUTO = "auto"
"""Word for a number that is taken from other parts of the rig."""


class OrAuto:
    """Lets a number be "auto", too."""

    @staticmethod
    def check(x: Any, number: Callable[[Any], Any]) -> Any:
        if isinstance(x, str) and x != AUTO:
            raise ValueError(f'should be "{AUTO}" or a number, not {shown(x)}')
        return x if x == AUTO else number(x)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_wrap_validator_function(
            self.check,
            handler(source),
            serialization=core_schema.plain_serializer_function_ser_schema(lambda x: x),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"anyOf": [{"const": AUTO}, handler(schema)]}


class Group(Table):
    """A table of a rig file."""

    @model_validator(mode="after")
    def _has_its_kind(self) -> Self:
        """A kind counts as given, also where a class says it: files need it."""
        if "kind" in type(self).model_fields:
            self.__pydantic_fields_set__.add("kind")
        return self


class PartTable(Group):
    """Table of a part: one field for each argument of its constructor, with the argument's
    quantity."""

    part: ClassVar[Callable[..., Any]]

    def arguments(self, folder: Path) -> tuple[tuple[str, Any], ...]:
        """Arguments of the constructor by name; `folder` is the base of relative file names."""
        given = {name: getattr(self, name) for name in signature(self.part).parameters}
        for name, one in given.items():
            if isinstance(one, PartTable):
                with at_field(name):
                    given[name] = one.build(folder)
        return tuple(given.items())

    def build(self, folder: Path) -> Any:
        """The part, with valid parameters. Raises `ValueError`."""
        return deepcopy(made(type(self).part, self.arguments(folder)))

    @model_validator(mode="after")
    def _is_sound(self) -> Self:
        tables = (self, *(getattr(self, name) for name in type(self).model_fields))
        if not any("file" in getattr(type(one), "model_fields", ()) for one in tables):
            self.build(Path())
        return self


@lru_cache(maxsize=32)
def made(part: Callable[..., Any], arguments: tuple[tuple[str, Any], ...]) -> Any:
    """A cached part: its log appears once, and a contour takes a while. Raises `ValueError`."""
    return sound(part(**dict(arguments)))


def table_of(
    part: Callable[..., Any], kind: str = "", base: type[PartTable] = PartTable, **fields: Any
) -> type[PartTable]:
    """The table of a part, called `kind` in files; `fields` are annotations or defaults that
    replace the constructor's."""
    found: dict[str, Any] = {"kind": (Literal[kind], kind)} if kind else {}
    for name, argument in signature(part).parameters.items():
        given = fields.get(name, argument.default)
        hint, default = (
            (given, ...) if get_origin(given) is not None else (argument.annotation, given)
        )
        declared = quantity(hint)
        texts = [one for one in metadata(hint) if isinstance(one, str)]
        meaning = texts[-1] if texts else declared.meaning if declared else None
        found[name] = (
            listed(hint),
            Field(... if default is argument.empty else default, description=meaning),
        )
    made = create_model(
        f"{getattr(part, '__name__', kind)}Table", __base__=base, __doc__=part.__doc__, **found
    )
    made.part = part
    return made


def listed(hint: Any) -> Any:
    """The annotation of a field, with a tuple in place of an iterable, which TOML gives as a
    list."""
    bare = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    if get_origin(bare) is Iterable:
        (inner,), entry = get_args(bare), quantity(hint)
        one = (
            Annotated[inner, entry]
            if inner is float
            else listed(tuple[(Annotated[float, entry],) * len(get_args(inner))])
        )
        return Annotated[
            tuple[one, ...], LISTED, Field(min_length=1, max_length=100_000), entry and entry.unit
        ]
    return Annotated[hint, LISTED] if get_origin(bare) is tuple else hint


def one_of(*tables: type[PartTable] | type[Group]) -> Any:
    """A union of tables, told apart by their `kind`."""
    return Annotated[reduce(or_, tables), Field(discriminator="kind")]


def with_entry(key: str, values: Any, places: list[int], value: Any) -> list[Any]:
    """A copy of a list with another entry at `places`, counted from one. Raises `ValueError`."""
    if not isinstance(values, list | tuple) or not 1 <= places[0] <= len(values):
        raise ValueError(f"{key}: there is no such entry")
    out, (first, *rest) = list(values), places
    out[first - 1] = with_entry(key, values[first - 1], rest, value) if rest else value
    return out


def called_alike(error: str, own: Mapping[str, Any], given: Mapping[str, Any]) -> str:
    """Question after the parts of a file that an error names and that were given but are not its
    `own`, where one of these is called alike."""
    return "".join(
        f"; did you mean {group}.{near}?"
        for group, parts in given.items()
        if isinstance(parts, Mapping) and isinstance(own.get(group), Mapping)
        for name in parts.keys() - own[group].keys()
        if f"{group}.{name}" in error and (near := nearest(name, own[group])) is not None
    )
