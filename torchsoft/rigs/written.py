"""A rig file as TOML text: every field with its unit and meaning as a comment, from the schema; what is left at its default is
commented out."""

import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, get_args, get_origin

from pydantic.fields import FieldInfo

from torchsoft.quantity import Quantity
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import Group, NumberOr

COLUMN = 44
"""Where comments begin."""


def to_toml(file: RigFile) -> str:
    """The text of a TOML file that `RigFile.from_toml` reads."""
    seen: set[type[Group]] = set()
    lines = [*heading(type(file)), "", *scalars(file, [], seen)]
    for name, field in type(file).model_fields.items():
        value = getattr(file, name)
        if isinstance(value, Mapping):
            for key, table in value.items():
                lines += ["", *(heading(type(table)) if type(table) not in seen else ())]
                lines += section(table, f"{name}.{key}", kinds(field), seen)
        elif isinstance(value, Group):
            lines += ["", *heading(type(value)), *section(value, name, kinds(field), seen)]
    return "\n".join(lines) + "\n"


def heading(table: type[Group]) -> list[str]:
    """First paragraph of the table's description, as comments."""
    first = (table.__doc__ or "").strip().replace("`", "").split("\n\n")[0]
    return [f"# {line.strip()}" for line in first.splitlines()]


def section(table: Group, path: str, known: list[str], seen: set[type[Group]]) -> Iterator[str]:
    """A table under its heading, and the tables in it."""
    yield f"[{path}]"
    yield from scalars(table, known, seen)
    for name, field in type(table).model_fields.items():
        value = getattr(table, name)
        if isinstance(value, Group) and (name in table.model_fields_set or field.is_required()):
            yield from section(value, f"{path}.{name}", kinds(field), seen)


def scalars(table: Group, known: list[str], seen: set[type[Group]]) -> Iterator[str]:
    """A line for every field that is no table, with a comment; those at their default only in the first table of its sort."""
    again = type(table) in seen
    seen.add(type(table))
    fields = type(table).model_fields
    if "kind" in fields:
        yield commented(f"kind = {text(table.model_dump()['kind'])}", f"one of {', '.join(known)}")
    for name, field in fields.items():
        value = getattr(table, name)
        if name == "kind" or isinstance(value, Group | Mapping) or (value is None and any(tables(field.annotation))):
            continue
        if value is not None and (name in table.model_fields_set or field.is_required()):
            yield commented(f"{name} = {text(value)}", remark(field))
        elif not again:
            yield commented(f"# {name} = {text(value)}" if value is not None else f"# {name} =", remark(field))


def commented(row: str, remark: str) -> str:
    """A line with its comment."""
    return f"{row.ljust(COLUMN - 1)} # {remark}" if remark else row


def remark(field: FieldInfo) -> str:
    """Meaning and unit of a field."""
    unit = next(
        (one.unit for one in metadata(field) if isinstance(one, Quantity | NumberOr) and one.unit not in ("", "1")), ""
    )
    meaning = field.description or ""
    return meaning if not unit or f"[{unit}]" in meaning else f"{meaning} [{unit}]"


def metadata(field: FieldInfo) -> Iterator[Any]:
    """What the annotation of a field says besides its type."""
    yield from field.metadata
    for one in get_args(field.annotation):
        if get_origin(one) is Annotated:
            yield from one.__metadata__


def tables(annotation: Any) -> Iterator[type[Group]]:
    """The tables that an annotation speaks of."""
    if isinstance(annotation, type) and issubclass(annotation, Group):
        yield annotation
    for one in get_args(annotation):
        yield from tables(one)


def kinds(field: FieldInfo) -> list[str]:
    """The kinds of table that a field may be."""
    found = (one.model_fields["kind"].default for one in tables(field.annotation) if "kind" in one.model_fields)
    return list(dict.fromkeys(found))


def text(value: Any) -> str:
    """A value in TOML."""
    if isinstance(value, Group):
        inner = ", ".join(f"{name} = {text(getattr(value, name))}" for name in type(value).model_fields)
        return f"{{{inner}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(text(one) for one in value)}]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)


def template(title: str) -> RigFile:
    """A rig that is meant to be changed."""
    pad = {
        "material": "rubber",
        "length": 80e-3,
        "height": 5e-3,
        "elements_x": 80,
        "elements_y": 4,
        "origin": (-40e-3, 0.0),
    }
    friction = {"kind": "smooth", "mu_s": 0.8, "mu_k": 0.7, "v_s": 0.05}
    return RigFile.from_tree(
        {
            "title": title,
            "bodies": {
                "disc": {
                    "mass": 0.4,
                    "shape": {"kind": "circle", "radius": 20e-3},
                    "start": {"x": 0.3e-3, "y": "rest"},
                },
                "bracket": {"mass": 0.4, "theta": 0.0, "weighted": False, "start": {"x": 0.0, "y": 50.1e-3}},
            },
            "materials": {"rubber": {"kind": "kelvin_voigt", "E": 0.75e6, "nu": 0.45, "tau": 10e-3, "depth": 44e-3}},
            "pads": {"lower": pad, "upper": pad | {"base": "bracket", "mirrored": True}},
            "laws": {"dry": {"K_n": 1.2e5, "R_n": 400.0, "K_t": 1.2e5, "R_t": 400.0, "friction": friction}},
            "contacts": {name: {"pad": name, "body": "disc", "law": "dry"} for name in ("lower", "upper")},
            "actuators": {
                "x": {"pushes": "bracket.x", "setpoint": "x_d", "Kp": 1e5, "Kd": 400.0},
                "y": {"pushes": "bracket.y", "setpoint": "y_d", "feed_forward": "press", "Kp": 1e5, "Kd": 400.0},
            },
            "motion": {
                "x_d": {"kind": "profile", "times": (0.5, 1.5), "values": ("start", 20e-3)},
                "y_d": {"kind": "profile", "times": (0.0, 0.4), "values": ("start", 49e-3)},
                "press": {"kind": "profile", "times": (0.0, 0.4), "values": (0.0, -30.0)},
            },
            "outputs": {"duration": 2.0},
        }
    )
