"""A rig in a few lines, with its numbers."""

from collections.abc import Iterable
from typing import Any

from torch import Tensor

from torchsoft.display import amount
from torchsoft.physics.parts import law_name
from torchsoft.physics.rig import Rig

NUMBERS = ("E", "tau", "K_n", "K_t", "mu_s", "mu_k", "Kp", "Kd")
"""Parameters of laws that are shown."""


def numbers(rig: Rig, owner: str, part: object, names: Iterable[str]) -> str:
    """Parameters of a part with their units."""
    shown = []
    for name in names:
        value = getattr(part, name, None)
        if isinstance(value, Tensor) and not value.ndim:
            quantity = rig.quantity(f"{owner}.{name}")
            shown.append(
                f"{name} {amount(float(value.detach()), quantity.unit if quantity else '')}"
            )
    return ", ".join(shown)


def summary(rig: Rig) -> tuple[str, list[tuple[str, str]]]:
    """Title and rows."""
    rows = []
    for name, body in rig.bodies.items():
        kinds: dict[str, list[str]] = {}
        for axis, kind in body.freedom.items():
            kinds.setdefault(kind, []).append(axis)
        freedom = ", ".join(f"{' '.join(axes)} {kind}" for kind, axes in kinds.items())
        shape = "no shape" if body.shape is None else type(body.shape).__name__
        if body.shape is not None:
            shape += f" of radius {amount(body.shape.size(), 'm')}"
        rows.append(
            (f"body {name}", f"{shape}, {amount(float(body.mass.detach()), 'kg')}; {freedom}")
        )
    for name, pad in rig.pads.items():
        mesh, material = pad.mesh, pad.material
        sizes = f"{1e3 * mesh.length:g} x {1e3 * mesh.height:g} mm"
        law = numbers(rig, f"pads.{name}.material", material, NUMBERS)
        rows.append(
            (
                f"pad {name}",
                f"{type(mesh).__name__} {sizes}, {len(mesh.elements)} elements, on "
                f"{pad.base or 'the ground'}, {'inertial' if pad.inertial else 'massless'}; "
                f"{type(material).__name__} {law}",
            )
        )
    for name, contact in rig.contacts.items():
        owner, law = f"contacts.{name}.law", contact.law
        rows.append(
            (
                f"contact {name}",
                f"{contact.body} on {contact.pad}; {numbers(rig, owner, law, NUMBERS)}; "
                f"{law_name(law.friction)} "
                f"{numbers(rig, f'{owner}.friction', law.friction, NUMBERS)}".rstrip(),
            )
        )
    for name, actuator in rig.actuators.items():
        follows = ", ".join(f"{at} to {signal}" for at, signal in actuator.follows)
        law = numbers(rig, f"actuators.{name}.law", actuator.law, NUMBERS)
        rows.append(
            (
                f"actuator {name}",
                f"pushes {actuator.pushes}, brings {follows or ', '.join(actuator.measures)}; "
                f"{law_name(actuator.law)} {law}".rstrip(),
            )
        )
    rows.append(("reference", ", ".join(rig.signals) or "no signals"))
    counts = ", ".join(
        f"{len(parts)} {one if len(parts) == 1 else several}"
        for one, several, parts in (
            ("body", "bodies", rig.bodies), ("pad", "pads", rig.pads),
            ("contact", "contacts", rig.contacts), ("actuator", "actuators", rig.actuators),
        )
    )  # fmt: skip
    return f"{type(rig).__name__}: {counts}, a state of {rig.layout.size} numbers", rows


def description(rig: Rig) -> dict[str, Any]:
    """Implementation of `Rig.description`."""
    names, values = {own: name for name, own in rig.names.items()}, dict[str, Any]()
    for own, value in rig.named_parameters():
        if own.startswith("reference."):
            continue
        owner, behind, last = own.partition(".parametrizations.")
        if behind:  # the value, not what it is made of
            last = last.partition(".")[0]
            own, value = f"{owner}.{last}", getattr(rig.get_submodule(owner), last)
        values[names.get(own, own)] = value.detach().tolist()
    return {
        "parameters": values,
        "friction": {
            name: law_name(contact.law.friction) for name, contact in rig.contacts.items()
        },
        "control": {name: law_name(actuator.law) for name, actuator in rig.actuators.items()},
        "shape": {
            name: type(body.shape).__name__
            for name, body in rig.bodies.items()
            if body.shape is not None
        },
        "material": {name: type(pad.material).__name__ for name, pad in rig.pads.items()},
        "mesh": {
            k: f"{type(pad.mesh).__name__}, {len(pad.mesh.nodes)} nodes"
            for k, pad in rig.pads.items()
        },
    }
