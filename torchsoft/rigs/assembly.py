"""Assembly of a rig from the tables of its file, and the names that its parameters have there."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from torch import nn

from torchsoft.display import suggestion
from torchsoft.physics.material import Series
from torchsoft.physics.rig import Rig
from torchsoft.physics.validity import check_numbers, sound
from torchsoft.rigs.fields import at_field
from torchsoft.solve.trajectory import units
from torchsoft.tables import line

if TYPE_CHECKING:
    from torchsoft.rigs.build import RigFile

M = TypeVar("M")

STIFF = 100.0
"""Largest stiffness of a contact, over that of a point of its pad, at which a failed equilibrium is
not blamed on the contact."""


def assemble(file: RigFile, parts: Mapping[str, Any]) -> Rig:
    """Implementation of `RigFile.assemble`."""
    folder, left = file.folder, dict(parts)

    def made(group: str, build: Callable[[str, Any], M]) -> dict[str, M]:
        found = {}
        for name, table in getattr(file, group).items():
            with at_field(f"{group}.{name}"):
                own = left.pop(f"{group}.{name}", None)
                found[name] = sound(build(name, table) if own is None else checked(own))
        return found

    def law(name: str, table: Any) -> Any:
        pressed = [pads[c.pad] for c in file.contacts.values() if c.law == name]
        sized, friction = table.numbers(pressed), left.pop(f"laws.{name}.friction", None)
        if friction is None:
            return sized.build(folder)
        with at_field("friction"):
            own = checked(friction)
        return table.part(**dict(sized.arguments(folder)) | {"friction": own})

    def shape(body: str) -> Any:
        with at_field("shape"):
            return checked(left.pop(f"bodies.{body}.shape", None))

    actuators = made("actuators", lambda _, one: one.build(folder))
    for name, one in file.controllers.items():
        with at_field(f"controllers.{name}"):
            actuators |= one.build(name, folder)
    materials = made("materials", lambda _, one: one.build(folder))
    pads = made("pads", lambda _, one: one.build(materials[one.material], folder))
    laws = made("laws", law)
    rig = Rig(
        bodies=made("bodies", lambda name, one: one.build(folder, shape(name))),
        pads=pads,
        contacts=made("contacts", lambda _, one: one.build(laws)),
        actuators=actuators,
        gravity=file.gravity,
        symbols={name: one.symbol or name for name, one in file.bodies.items()},
        taxels=made("taxels", lambda _, one: one.build(folder)),
    )
    for name in left:
        known = [f"{group}.{key}" for group in PARTS for key in getattr(file, group)]
        known += [f"laws.{key}.friction" for key in file.laws]
        known += [f"bodies.{key}.shape" for key in file.bodies]
        raise ValueError(
            f"parts: there is no part `{line(name, 80)}` in the file; {suggestion(name, known)}"
        )
    named = {own_name(file, rig, *name.split(".")): name for name, _ in rig.named_parameters()}
    rig.aliases = {alias: name for alias, name in named.items() if alias != name}
    rig.short = short_names(file, rig, named)
    if not parts:
        rig.tables = file.model_dump(mode="json", exclude_unset=True)
    return rig


PARTS = "bodies", "materials", "pads", "laws", "contacts", "taxels", "actuators"
"""Tables of which each is one part of a rig."""


def checked(part: M) -> M:
    """A part of one's own whose numbers are in bounds. Raises `ValueError` where they are not."""
    if isinstance(part, nn.Module):
        check_numbers(part)
    return part


def short_names(file: RigFile, rig: Rig, parameters: Collection[str]) -> dict[str, str]:
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


def own_name(file: RigFile, rig: Rig, group: str, part: str = "", *rest: str) -> str:
    """Name in the file of a parameter of its rig, such as "materials.silicone.E"."""
    made = {a: name for name, one in file.controllers.items() for a in one.actuators(name)}
    if group == "pads" and rest[:1] == ("material",):
        material = rig.pads[part].material
        group, part, rest = "materials", file.pads[part].material, rest[1:]
        if isinstance(material, Series):
            last = re.sub(rf"^{material.symbol}(?=_\d)", material.strength, rest[-1])
            rest = (*rest[:-1], last)
    elif group == "contacts" and rest[:1] == ("law",):
        group, part, rest = "laws", file.contacts[part].law, rest[1:]
    elif part in made:
        group, part = "controllers", made[part]
        rest = tuple(one for one in rest if one not in ("law", "module", "feedback"))
    elif group in ("actuators", "bodies"):
        rest = tuple(one for one in rest if one not in ("law", "fixed"))
    last = ["inertia" if name == "own_inertia" else name for name in rest]
    return ".".join([group, part, *last] if part else [group])


def too_stiff(file: RigFile, rig: Rig) -> str:
    """Error message on a contact too stiff for its pad to be solved; empty if there is none."""
    for name, contact in rig.contacts.items():
        give = float(rig.pads[contact.pad].compliance().diagonal().max())
        ratio = float((rig.weight(name) * contact.law.K_n).max()) * give
        if ratio > STIFF:
            law, K_n = file.contacts[name].law, contact.law.K_n.item()
            return (
                f"laws.{law}.K_n: no rest is found with {K_n:g} N/m, {ratio:.2g} times as stiff as "
                f"the pad `{contact.pad}` that it presses; take {K_n * STIFF / ratio:.1g} N/m or "
                "less, the pad gives way long before the contact does"
            )
    return ""
