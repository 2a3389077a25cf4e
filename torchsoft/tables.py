"""Tables: validated data, from Python or from a TOML file. A table rejects input in one sentence
that names every wrong field, its value and the values allowed.
"""

import json
import re
import reprlib
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeVar
from unicodedata import category

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Strict,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from torchsoft.display import suggestion
from torchsoft.files import check_file

T = TypeVar("T")

LISTED = Strict(False)
"""Marks a tuple that may be given as a list, as in TOML."""

SHOWN = 3
"""Findings that a sentence states; of more it gives the number."""

SEED = 2**63 - 1
"""Largest seed: the largest integer of TOML."""

HUGE = 1e300
"""Integers from which on formulas leave the range of floats."""

LARGEST = 10e6
"""Size [B] of a TOML file at the most."""

Number = Annotated[
    float,
    BeforeValidator(lambda value: float("nan") if value is None else value),
    WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "null"}]}),
]
"""A number of a file, null there where it is not finite."""


class InvalidTable(ValueError):
    """Rejection of a table, in one sentence."""


@contextmanager
def refusing(data: Any = None, within: str = "") -> Iterator[None]:
    """Turns pydantic's findings on `data` into `InvalidTable`."""
    try:
        yield
    except ValidationError as error:
        raise InvalidTable(findings(error, data, within)) from None


class Table(BaseModel):
    """A frozen table: unknown keys, with the one that may be meant, numbers that are not finite,
    and text or booleans for numbers are `InvalidTable`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    if not TYPE_CHECKING:  # checkers see the fields as arguments

        def __init__(self, **data: Any) -> None:
            with refusing(data):
                super().__init__(**data)

        __init__.__pydantic_base_init__ = True  # a table in a table is validated as part of it

        def __setattr__(self, name: str, value: Any) -> None:
            with refusing():
                super().__setattr__(name, value)

    @model_validator(mode="before")
    @classmethod
    def _known(cls, data: Any) -> Any:
        known, given = cls.model_fields, data if isinstance(data, Mapping) else {}
        if strange := [line(str(key), 80) for key in given if key not in known]:
            more = f", nor are `{'`, `'.join(strange[1:4])}`" if strange[1:] else ""
            raise ValueError(
                f"`{strange[0]}` is not known here{more}; {suggestion(strange[0], known)}"
            )
        if large := [key for key, value in given.items() if is_huge(value)]:
            number = shown(given[large[0]])
            raise ValueError(f"{large[0]} should be a valid number, not {number}")
        return data

    @classmethod
    def model_validate(cls, obj: Any, **options: Any) -> Self:
        with refusing(obj):
            return super().model_validate(obj, **options)

    @classmethod
    def model_validate_json(cls, json_data: str | bytes | bytearray, **options: Any) -> Self:
        with refusing():
            return super().model_validate_json(json_data, **options)


def is_huge(value: Any) -> bool:
    """Whether a value is an integer that no float holds, or a list with one."""
    if isinstance(value, list | tuple):
        return any(map(is_huge, value))
    return isinstance(value, int) and abs(value) >= HUGE


def findings(error: ValidationError, data: Any = None, within: str = "") -> str:
    """pydantic's findings in one sentence, each with its field (`within` another), its value and
    the values allowed."""
    errors = error.errors(include_url=False)
    outer = {one["loc"][:n] for one in errors for n in range(len(one["loc"]))}
    found = list(  # a list that only its wrong entries leave too short has no finding of its own
        dict.fromkeys(
            finding(one, data, within)
            for one in errors
            if one["type"] != "too_short" or one["loc"] not in outer
        )
    )
    more = len(found) - SHOWN
    return "; ".join(found[:SHOWN]) + (f"; and {more} more" if more > 0 else "")


def finding(one: Mapping[str, Any], data: Any, within: str) -> str:
    """One finding: `pad.E should be greater than or equal to 1, not -1.0`."""
    kind = one["type"]
    judged = kind in (
        "value_error",
        "assertion_error",
    )  # a value that is there, not one that is missing or too many
    place = ".".join(part for part in (within, path(one["loc"], data, judged)) if part)
    field, given, text = place or "what is given", shown(one["input"]), one["msg"]
    if kind == "extra_forbidden":
        return f"{field} is not known here"
    if kind == "missing":
        return f"{field} is missing"
    if kind == "frozen_instance":
        return f"{field} cannot be set: a table stays as it was made; make another one"
    if kind.startswith("union_tag"):
        tag = one["ctx"]["discriminator"].strip("'")
        if "expected_tags" not in one["ctx"]:
            return f"{field}.{tag} is missing"
        return (
            f"{field}.{tag} should be one of {one['ctx']['expected_tags']}, not "
            f"{shown(one['input'][tag])}"
        )
    if judged:
        text = line(text.removeprefix("Value error, "))
        return f"{place}: {text}" if place else text
    if kind in ("dict_type", "model_type", "model_attributes_type"):
        return f"{field} should be a table, not {given}"
    text = SMALL.sub(lambda match: f"{float(match[0]):g}", text)  # as people write it: 1e-07
    return (
        f"{field} {text.removeprefix('Input ')}, not {given}"
        if text.startswith("Input ")
        else f"{field}: {text}"
    )


def path(loc: tuple[int | str, ...], data: Any, there: bool) -> str:
    """A place in `data`, which is `there` or not, as messages name it, without the names that
    pydantic gives to members of a union."""
    parts = []
    for i, part in enumerate(loc):
        if isinstance(data, Mapping) and part not in data and (there or i + 1 < len(loc)):
            continue
        parts.append(str(part))
        if isinstance(data, Mapping):
            data = data.get(part)
        elif isinstance(data, list | tuple):
            data = data[part] if isinstance(part, int) and part < len(data) else None
        else:
            data = getattr(data, str(part), None)
    return line(".".join(parts), 200)


SMALL = re.compile(r"(?<![\w.'])0\.0000\d+|(?<![\w.'])\d{6,}\.0\b")
COLUMN = 44
"""Column at which comments of a written TOML file begin."""

SHORT = reprlib.Repr()
SHORT.maxother = SHORT.maxstring = SHORT.maxlong = 40
SHORT.maxlevel = SHORT.maxdict = SHORT.maxlist = SHORT.maxtuple = 2


def shown(value: Any) -> str:
    """A value as messages show it: short."""
    return line(SHORT.repr(value), 120)


def plain(text: str) -> str:
    """Text in which characters that a terminal obeys or that turn the direction of writing are
    escaped; lines stay."""
    seen = (
        c
        if c.isprintable() or c == "\n" or category(c) == "Zs"
        else c.encode("unicode_escape").decode()
        for c in text
    )
    return "".join(seen)


def line(text: Any, length: int = 600) -> str:
    """Text as one line of limited length, without control characters."""
    one = plain(" ".join(str(text).split()))
    return one if len(one) <= length else one[: length - 3] + "..."


def toml_value(value: Any) -> str:
    """A value in TOML: a table in one line, a list, a number or text."""
    if isinstance(value, Table):
        value = {name: getattr(value, name) for name in type(value).model_fields}
    if isinstance(value, dict):
        return f"{{{', '.join(toml_row(name, one) for name, one in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(toml_value(one) for one in value)}]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def toml_row(name: str, value: Any, remark: str = "") -> str:
    """A row of a TOML file with a comment; without a value where that is None."""
    row = f"{name} =" if value is None else f"{name} = {toml_value(value)}"
    return f"{row.ljust(COLUMN - 1)} # {remark}" if remark else row


def read_toml(path: str | Path) -> dict[str, Any]:
    """A TOML file. Raises `ValueError` naming it unless it is TOML in UTF-8, and `OSError`."""
    check_file(path, LARGEST)
    try:
        return tomllib.loads(Path(path).read_bytes().removeprefix(b"\xef\xbb\xbf").decode("utf-8"))
    except RecursionError:
        raise ValueError(
            f"{path} is not a TOML file that can be read: its tables are nested too deeply"
        ) from None
    except ValueError as error:  # of TOML, of UTF-8, of integers with thousands of digits
        raise ValueError(f"{path} is not a TOML file: {line(error)}") from None


def from_toml(path: str | Path, make: Callable[[Any], T]) -> T:
    """Result of `make` for a TOML file. Raises `ValueError` naming the file and the field."""
    tree = read_toml(path)
    try:
        return make(tree)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
