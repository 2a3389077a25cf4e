"""Places in a rig file by dotted names, such as "materials.silicone.E" or "motion.lift.values_2",
the second of a list."""

import re
from collections.abc import Container, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from pydantic.fields import FieldInfo

from torchsoft.display import suggestion
from torchsoft.quantity import Quantity, metadata
from torchsoft.rigs.fields import NumberOr
from torchsoft.tables import Table, line

ENTRY = re.compile(r"(.+?)((?:_\d+)+)")
"""Name of an entry of a list."""


class Place(NamedTuple):
    """A place in a rig file: keys of its tables and lists, the value, and its field."""

    keys: tuple[str | int, ...]
    value: Any
    field: FieldInfo


def entry(key: str, known: Container[str]) -> tuple[str, list[int]]:
    """A known list and the place in it that a key stands for, counted from one: tau_2, or gain_1_3,
    the third of the first row; the key and no place where it stands for itself."""
    found = ENTRY.fullmatch(key)
    if key in known or found is None or found[1] not in known:
        return key, []
    return found[1], [int(one) for one in found[2].split("_")[1:]]


def named(keys: Sequence[str | int]) -> str:
    """Name of a place."""
    return "".join(f".{key}" if isinstance(key, str) else f"_{key + 1}" for key in keys)[1:]


def place(file: Table, name: str) -> Place:
    """The place of a name such as "materials.silicone.E" or "controllers.turn.gain_1_3", the third
    of the first row. Raises `ValueError` for an unknown name."""
    at: Any = file
    left = name.split(".")
    keys, field = list[str | int](), FieldInfo()
    while left:
        here, within = named(keys) or "the rig file", list[int]()
        if isinstance(at, Table):
            known, n = list(type(at).model_fields), 1
            key, within = entry(left[0], known)
            if key in known:
                field, at = type(at).model_fields[key], getattr(at, key)
        elif isinstance(at, Mapping):  # names of motions may have dots in them
            known = list(at)
            n = next((n for n in range(len(left), 0, -1) if ".".join(left[:n]) in at), 1)
            key = ".".join(left[:n])
            at = at.get(key)
        else:
            known, n, key = [], 1, left[0]
        if key not in known:
            wrong, short = (left[0], []) if keys else (name, getattr(file, "names", ()))
            there = suggestion(wrong, [*known, *short], f"{here} has")
            raise ValueError(f"`{line(name, 80)}` is not in the rig file: {there}")
        keys, left = [*keys, key], left[n:]
        for number in within:
            values, own = at if isinstance(at, tuple) else (), named(keys)
            if not 1 <= number <= len(values):
                there = f"it has {own}_1 to _{len(values)}" if values else f"{own} is no list"
                raise ValueError(f"`{line(name, 80)}` is not in the rig file: {there}")
            keys, at = [*keys, number - 1], values[number - 1]
    return Place(tuple(keys), at, field)


def replaced(file: Table, values: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of a rig file with other values at these names. Raises `ValueError`."""
    tree, whole = (listed(file.model_dump(exclude_unset=some)) for some in (True, False))
    for name, value in values.items():
        *way, last = place(file, name).keys
        node, full = tree, whole
        for key in way:
            if isinstance(node, dict) and key not in node:
                node[key] = full[key]
            node, full = node[key], full[key]
        node[last] = value
    return tree


def listed(value: Any) -> Any:
    """A copy with dictionaries and lists, which can be changed."""
    if isinstance(value, dict):
        return {key: listed(x) for key, x in value.items()}
    return [listed(x) for x in value] if isinstance(value, list | tuple) else value


def entries(table: Table, within: str = "") -> Iterator[tuple[str, Any, FieldInfo]]:
    """Dotted name, value and field of everything that a table states, tables in it included."""
    for name, field in type(table).model_fields.items():
        if name in table.model_fields_set or field.is_required():
            yield from _entry(f"{within}{name}", getattr(table, name), field)


def _entry(name: str, value: Any, field: FieldInfo) -> Iterator[tuple[str, Any, FieldInfo]]:
    if isinstance(value, Table):
        yield from entries(value, f"{name}.")
    elif isinstance(value, Mapping):
        for key, one in value.items():
            yield from _entry(f"{name}.{key}", one, field)
    else:
        yield name, value, field


def unit(field: FieldInfo) -> str:
    """Unit of a field, empty for one that is not a number."""
    found = (*field.metadata, *metadata(field.annotation))
    units = (one.unit for one in found if isinstance(one, Quantity | NumberOr))
    return next((one for one in units if one not in ("", "1")), "")
