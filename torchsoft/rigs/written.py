"""A rig file as TOML text: every field with its unit and meaning from the schema as a comment;
fields at their default are commented out."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic.fields import FieldInfo

from torchsoft.files import save_text
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import Group
from torchsoft.rigs.places import unit
from torchsoft.tables import read_toml, toml_row


def to_toml(file: RigFile) -> str:
    """TOML text that `RigFile.from_toml` reads."""
    seen: set[type[Group]] = set()
    lines = [*heading(type(file)), "", *scalars(file, [], seen)]
    for name, field in type(file).model_fields.items():
        value = getattr(file, name)
        if name in ("names", "sources"):
            rows = [toml_row(f'"{key}"', own) for key, own in value.items()]
            lines += ["", f"[{name}]", *rows] if rows else []
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
    own, meaning = unit(field), field.description or ""
    return meaning if not own or f"[{own}]" in meaning else f"{meaning} [{own}]"


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
