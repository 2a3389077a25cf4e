"""Names and sources of the numbers in a rig file: changes by name, units, and the table of all."""

import re
from collections.abc import Collection, Mapping
from typing import Any

from torchsoft.display import suggestion
from torchsoft.physics.channels import units
from torchsoft.physics.parts import ORDERS, PD, Actuator
from torchsoft.physics.rig import Rig
from torchsoft.rigs.fields import with_entry
from torchsoft.rigs.places import entries, entry, place, unit
from torchsoft.rigs.schema import RigTables
from torchsoft.tables import line


def merged(old: Any, new: Any) -> Any:
    """A table with the entries of another, in which "tau_2" is the second of a list; one of another
    kind replaces it as a whole. Raises `ValueError` for an entry of a list that is not there."""
    both = isinstance(old, dict) and isinstance(new, dict)
    if not both or new.get("kind", old.get("kind")) != old.get("kind"):
        return new
    out = dict(old)
    for key, value in new.items():
        name, within = entry(key, old)
        if within and isinstance(old[name], list | tuple):
            out[name] = with_entry(key, out[name], within, value)
        else:
            out[key] = merged(old.get(key), value)
    return out


def still_true(before: RigTables, after: RigTables, tree: Mapping[str, Any]) -> dict[str, Any]:
    """The names and sources of changed tables, without names of entries that the change takes away
    and sources of numbers that it changes."""

    def is_there(name: str) -> bool:
        try:
            return "." not in name or bool(place(after, name))
        except ValueError:
            return False

    names = {
        short: full for short, full in tree.get("names", {}).items()
        if short not in before.names or all(map(is_there, before.full(short)))
    }  # fmt: skip
    sources = {
        name: text for name, text in tree.get("sources", {}).items()
        if before.sources.get(name) != text
        or (is_there(name) and place(after, name).value == place(before, name).value)
    }  # fmt: skip
    return {key: x for key, x in (("names", names), ("sources", sources)) if x}


def table(file: RigTables) -> dict[str, dict[str, Any]]:
    """Every number that a file states, by its name: value, unit, source ("published" or "assumed",
    and where) and meaning."""
    hidden = "names.", "sources.", "outputs.", "title"
    return {
        name: {
            "value": value, "unit": unit_of(file, name),
            "source": file.sources.get(name, "assumed"), "meaning": field.description or "",
        }
        for name, value, field in entries(file)
        if not name.startswith(hidden) and type(value) in (float, int, tuple)
    }  # fmt: skip


def unit_of(file: RigTables, name: str) -> str:
    """Unit of an entry by its name, full or short, "1" for one without. Raises `ValueError` for
    an unknown name."""
    keys, _, field = place(file, file.full(name)[0])
    own, (group, *way) = unit(field) or "1", keys
    if not re.search(r",| or ", own) or len(way) < 2:
        return own
    if group == "motion":
        return file.unit(str(way[0]))
    if group == "actuators":
        one = file.actuators[str(way[0])]
        order, pushed, measured = ORDERS.get(str(way[1])), one.pushes, one.measured
    else:
        part, _, row, column = way if len(way) == 4 else (*way, 0, 0)
        one = file.controllers[str(part)]
        order, number = divmod(int(column), len(one.measures))
        pushed, measured = one.pushes[int(row)], one.measures[number]
    loop = Actuator(measured, pushed, PD(1.0, 1.0), setpoint="w")
    return loop.effort_unit if order is None else loop.gain_unit(order)


def short_names(file: RigTables, rig: Rig, parameters: Collection[str]) -> dict[str, str]:
    """Short names of the rig's parameters and channels. Raises `ValueError`."""
    known, out = units(rig), dict[str, str]()
    for short in file.names:
        if short in known or short in parameters:
            raise ValueError(f"names.{short}: it is the name of something else already")
        full = file.full(short)
        for name in full:
            if "." not in name and name not in known:
                raise ValueError(
                    f"names.{short}: the rig has no channel `{line(name, 80)}`; "
                    f"{suggestion(name, known)}"
                )
        if len(full) == 1 and (full[0] in known or full[0] in parameters):
            out[short] = full[0]
    return out


HIDDEN = {
    "bodies": ("fixed", "contour"), "actuators": ("law",),
    "controllers": ("law", "module", "feedback"),
}  # fmt: skip
"""Modules of parts whose parameters belong to the part itself in the file."""


def own_name(file: RigTables, rig: Rig, group: str, part: str = "", *rest: str) -> str:
    """Name in the file of a parameter of its rig, such as "materials.silicone.E"."""
    made = {a: name for name, one in file.controllers.items() for a in one.actuators(name)}
    if group == "pads" and rest[:1] == ("material",):
        material = rig.pads[part].material
        group, part, rest = "materials", file.pads[part].material, rest[1:]
        symbol, _, number = rest[-1].rpartition("_")
        if symbol in material.lists and number.isdigit():
            rest = (*rest[:-1], f"{material.lists[symbol]}_{number}")
    elif group == "contacts" and rest[:1] == ("law",):
        group, part, rest = "laws", file.contacts[part].law, rest[1:]
    elif part in made:
        group, part = "controllers", made[part]
    elif group == "bodies" and rest[-1].startswith("centre_"):
        rest = rest[1:]
    last = [one for one in rest if one not in HIDDEN.get(group, ())]
    last = ["inertia" if name == "own_inertia" else name for name in last]
    return ".".join([group, part, *last] if part else [group])
