"""A rig file as TOML text: every field with its unit and meaning from the schema as a comment;
fields at their default are commented out. Fields by dotted names."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

from pydantic.fields import FieldInfo

from torchsoft.files import save_text
from torchsoft.quantity import Quantity, metadata
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import Group, NumberOr
from torchsoft.tables import Table, line, read_toml, toml_row


def to_toml(file: RigFile) -> str:
    """TOML text that `RigFile.from_toml` reads."""
    seen: set[type[Group]] = set()
    lines = [*heading(type(file)), "", *scalars(file, [], seen)]
    for name, field in type(file).model_fields.items():
        value = getattr(file, name)
        if name == "channels" and value:
            lines += ["", "[channels]", *(toml_row(f'"{key}"', own) for key, own in value.items())]
        elif isinstance(value, Mapping):
            for key, table in value.items():
                lines += ["", *(heading(type(table)) if type(table) not in seen else ())]
                lines += section(table, f"{name}.{key}", kinds(field), seen)
        elif isinstance(value, Group):
            lines += ["", *heading(type(value)), *section(value, name, kinds(field), seen)]
    return "\n".join(lines) + "\n"


def save(file: RigFile, path: Path) -> None:
    """Write the file to any folder, atomically; files that it names are referred to by absolute
    paths."""
    save_text(path, to_toml(located(file)))


def heading(table: type[Group]) -> list[str]:
    """First paragraph of the table's description, as comments."""
    first = (table.__doc__ or "").strip().replace("`", "").split("\n\n")[0]
    return [f"# {line.strip()}" for line in first.splitlines()]


def section(table: Group, path: str, known: list[str], seen: set[type[Group]]) -> Iterator[str]:
    """Lines of a table, its heading, and its inner tables."""
    yield f"[{path}]"
    yield from scalars(table, known, seen)
    for name, field in type(table).model_fields.items():
        value = getattr(table, name)
        if isinstance(value, Group) and (name in table.model_fields_set or field.is_required()):
            yield from section(value, f"{path}.{name}", kinds(field), seen)


def scalars(table: Group, known: list[str], seen: set[type[Group]]) -> Iterator[str]:
    """A line for every field that is not a table, with a comment; fields at their default only in
    the first table of each type."""
    again = type(table) in seen
    seen.add(type(table))
    fields = type(table).model_fields
    if "kind" in fields:
        yield toml_row("kind", table.model_dump()["kind"], f"one of {', '.join(known)}")
    for name, field in fields.items():
        value = getattr(table, name)
        if (
            name == "kind"
            or isinstance(value, Group | Mapping)
            or (value is None and any(tables(field.annotation)))
        ):
            continue
        if value is not None and (name in table.model_fields_set or field.is_required()):
            yield toml_row(name, value, remark(field))
        elif not again:
            yield toml_row(f"# {name}", value, remark(field))


def remark(field: FieldInfo) -> str:
    """Meaning and unit of a field."""
    annotations = (*field.metadata, *metadata(field.annotation))
    unit = next(
        (
            one.unit
            for one in annotations
            if isinstance(one, Quantity | NumberOr) and one.unit not in ("", "1")
        ),
        "",
    )
    meaning = field.description or ""
    return meaning if not unit or f"[{unit}]" in meaning else f"{meaning} [{unit}]"


def tables(annotation: Any) -> Iterator[type[Group]]:
    """The table types within an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, Group):
        yield annotation
    for one in get_args(annotation):
        yield from tables(one)


def kinds(field: FieldInfo) -> list[str]:
    """The kinds of table that a field accepts."""
    found = (
        one.model_fields["kind"].default
        for one in tables(field.annotation)
        if "kind" in one.model_fields
    )
    return list(dict.fromkeys(found))


def template(title: str) -> RigFile:
    """A rig to start from: a disc pressed and rolled between two pads."""
    return RigFile.from_tree(
        read_toml(Path(__file__).with_name("template.toml")) | {"title": title}
    )


def located(file: RigFile) -> RigFile:
    """A copy with absolute paths of the files that it names."""
    tree = file.model_dump(exclude_unset=True)
    return RigFile.model_validate(
        files_renamed(tree, lambda name: str((file.folder / name).resolve()))
    )


# Access to fields of a rig file by dotted names.


class Place(NamedTuple):
    """A place in a rig file: keys of its tables, the value, and its field."""

    keys: tuple[str | int, ...]
    value: Any
    field: FieldInfo


def place(file: RigFile, name: str) -> Place:
    """The place of a name such as "materials.silicone.E" or "motion.lift.values.2". Raises
    `ValueError` for an unknown name."""
    at: Any = file
    keys, left, field = list[str | int](), name.split("."), FieldInfo()
    while left:
        here = ".".join(map(str, keys)) or "the rig file"
        if isinstance(at, Table):
            known, n = list(type(at).model_fields), 1
            key: str | int = left[0]
            if key in known:
                field, at = type(at).model_fields[key], getattr(at, key)
        elif isinstance(at, Mapping):  # names of motions may have dots in them
            known = list(at)
            n = next((n for n in range(len(left), 0, -1) if ".".join(left[:n]) in at), 1)
            key = ".".join(left[:n])
            at = at.get(key)
        elif isinstance(at, tuple):
            known, n = [str(i) for i in range(len(at))], 1
            key = int(left[0]) if left[0] in known else left[0]
            at = at[key] if isinstance(key, int) else at
        else:
            known, n, key = [], 1, left[0]
        if str(key) not in known:
            there = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
            raise ValueError(
                f"`{line(name, 80)}` is not in the rig file: {here} has {there or 'no parts'}"
            )
        keys, left = [*keys, key], left[n:]
    return Place(tuple(keys), at, field)


def replaced(file: RigFile, values: Mapping[str, Any]) -> RigFile:
    """A copy of the rig file with other values at these names. Raises `ValueError`."""
    tree, whole = (listed(file.model_dump(exclude_unset=some)) for some in (True, False))
    for name, value in values.items():
        *way, last = place(file, name).keys
        node, full = tree, whole
        for key in way:
            if isinstance(node, dict) and key not in node:
                node[key] = full[key]
            node, full = node[key], full[key]
        node[last] = value
    return RigFile.from_tree(tree, file.folder)


FILES = ("file", "network")
"""Fields of a rig file that name another file."""


def files_renamed(tree: Any, name: Callable[[str], str]) -> Any:
    """A copy of some tables of a rig file, which may have dotted names, with every file name mapped
    by `name`."""
    if isinstance(tree, dict):
        return {
            key: name(x)
            if key.rpartition(".")[2] in FILES and isinstance(x, str)
            else files_renamed(x, name)
            for key, x in tree.items()
        }
    return [files_renamed(x, name) for x in tree] if isinstance(tree, list) else tree


def listed(value: Any) -> Any:
    """A copy with dictionaries and lists, which can be changed."""
    if isinstance(value, dict):
        return {key: listed(x) for key, x in value.items()}
    return [listed(x) for x in value] if isinstance(value, list | tuple) else value
