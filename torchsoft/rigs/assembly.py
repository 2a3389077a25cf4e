"""From the tables of a rig file to the rig, its motions and its start."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import torch
from torch import nn

from torchsoft.display import suggestion
from torchsoft.parallel import single_threaded
from torchsoft.physics.rig import Rig
from torchsoft.physics.start import moving, warn_of_moments
from torchsoft.physics.validity import check_numbers, sound
from torchsoft.rigs.built import BuiltRig
from torchsoft.rigs.fields import at_field
from torchsoft.rigs.initial import (
    followed_motions,
    holding_effort,
    initial_poses,
    reference,
    settled_pads,
    signal,
)
from torchsoft.rigs.naming import own_name, short_names
from torchsoft.rigs.schema import RigTables
from torchsoft.solve.simulate import Initial
from torchsoft.tables import line

M = TypeVar("M")


def assemble(file: RigTables, parts: Mapping[str, Any] | None = None) -> Rig:
    """The rig without a reference; `parts` are as of `build`. Raises `ValueError` with the
    field's name for parts that are not physical."""
    folder, left, known = file.folder, dict(parts or {}), list[str]()

    def given(name: str) -> Any:
        known.append(name)
        part = left.pop(name, None)
        if isinstance(part, nn.Module):
            check_numbers(part)
        elif isinstance(part, dict):
            raise ValueError(
                "must be one part, but is a dict; `controller` returns a dict of actuators: pass "
                "each by its name"
            )
        return part

    def made(group: str, build: Callable[[str, Any], M]) -> dict[str, M]:
        found = {}
        for name, table in getattr(file, group).items():
            with at_field(f"{group}.{name}"):
                own = given(f"{group}.{name}")
                found[name] = sound(build(name, table) if own is None else own)
        return found

    def law(name: str, table: Any) -> Any:
        pressed = [pads[c.pad] for c in file.contacts.values() if c.law == name]
        with at_field("friction"):
            friction = given(f"laws.{name}.friction")
        return table.matched_to(pressed, folder, friction)

    def shape(body: str) -> Any:
        with at_field("shape"):
            return given(f"bodies.{body}.shape")

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
        raise ValueError(
            f"parts: there is no part `{line(name, 80)}` in the file; {suggestion(name, known)}"
        )
    named = {own_name(file, rig, *name.split(".")): name for name, _ in rig.named_parameters()}
    rig.aliases = {alias: name for alias, name in named.items() if alias != name}
    rig.short = short_names(file, rig, named)
    rig.matched = {
        f"laws.{file.contacts[name].law}.{key}": f"contacts.{name}.law.{key}"
        for name, contact in rig.contacts.items() for key in contact.law.matched
    }  # fmt: skip
    if not parts:
        rig.tables = file.model_dump(mode="json", exclude_unset=True)
    return rig


@single_threaded()
@torch.no_grad()
def build(file: RigTables, parts: Mapping[str, Any] | None = None) -> BuiltRig:
    """The rig of a file with its start and its output times. Raises `ValueError`."""
    rig = assemble(file, parts)
    poses = initial_poses(file, rig, {name: signal(file, name) for name in file.driven})
    rig.reference = reference(file, poses, partial(holding_effort, file, rig, poses))
    y0 = settled_pads(file, rig, poses, rig.reference)
    warn_of_moments(rig, y0, file.starts)
    followed = followed_motions(file, poses, rig.reference)
    solver, y0 = file.solver.model_dump(exclude_none=True), moving(rig, y0, file.starts)
    built = BuiltRig(rig, y0, file.outputs.times(), file, followed, solver)
    built.last.update(key=built.key(rig), start=Initial(y0, rig.reference))
    return built
