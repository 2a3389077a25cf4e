"""Access to fields of a rig file by dotted names."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from pydantic.fields import FieldInfo

from torchsoft.rigs.build import RigFile
from torchsoft.tables import Table, line


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
