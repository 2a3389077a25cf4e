"""Geometry and parts of a run: pads, outlines, contacts and actuators as they were, for files and
pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch

from torchsoft.physics.channels import declared
from torchsoft.physics.mesh import Array, StoredMesh
from torchsoft.physics.names import effort_channel
from torchsoft.physics.pads import Pad
from torchsoft.physics.rig import Rig


@dataclass(frozen=True)
class BodySetup:
    """A body as it was: its outline (points, 2) [m] about its centre, None where nothing touches
    it, how each of its coordinates was free, and the channel that it is."""

    outline: Array | None
    freedom: dict[str, str]
    channels: dict[str, str]

    @property
    def size(self) -> float:
        """Largest distance of the outline from the centre [m]; 0 without one."""
        return 0.0 if self.outline is None else float(np.linalg.norm(self.outline, axis=1).max())


@dataclass(frozen=True)
class ContactSetup:
    """A contact: its pad, its body, and the coefficients of friction that its law has, by name."""

    pad: str
    body: str
    friction: dict[str, float]


@dataclass(frozen=True)
class ActuatorSetup:
    """An actuator: the coordinate that it pushes, its channel, the unit of its effort, and the
    set-points that coordinates follow, by coordinate."""

    pushes: str
    channel: str
    unit: str
    follows: dict[str, str]


@dataclass(frozen=True)
class Setup:
    """Bodies, pads, contacts and actuators as a run had them, and short names and meanings of
    channels."""

    bodies: dict[str, BodySetup] = field(default_factory=dict)
    pads: dict[str, Pad] = field(default_factory=dict)
    contacts: dict[str, ContactSetup] = field(default_factory=dict)
    actuators: dict[str, ActuatorSetup] = field(default_factory=dict)
    short: dict[str, str] = field(default_factory=dict)
    meanings: dict[str, str] = field(default_factory=dict)

    @classmethod
    @torch.inference_mode(False)  # outlines need torch's graphs
    @torch.no_grad()
    def of(cls, rig: Rig) -> Self:
        """A rig as it is now."""
        return cls(
            bodies={
                name: BodySetup(
                    None if body.shape is None else body.shape.outline().detach().numpy().copy(),
                    dict(body.freedom),
                    {axis: f"{axis}_{rig.symbols[name]}" for axis in body.freedom},
                )
                for name, body in rig.bodies.items()
            },
            pads={name: Pad.again(pad.described(), pad.mesh) for name, pad in rig.pads.items()},
            contacts={
                name: ContactSetup(
                    contact.pad, contact.body,
                    {
                        mu: float(value)
                        for mu in ("mu_s", "mu_k")
                        for value in [getattr(contact.law.friction, mu, None)]
                        if isinstance(value, torch.Tensor)
                    },
                )
                for name, contact in rig.contacts.items()
            },
            actuators={
                name: ActuatorSetup(
                    one.pushes, effort_channel(name), one.effort_unit,
                    {at: signal for at, signal in one.follows if signal != one.feed_forward},
                )
                for name, one in rig.actuators.items()
            },
            short=dict(rig.short), meanings={one.name: one.meaning for one in declared(rig)},
        )  # fmt: skip

    def plain(self) -> dict[str, Any]:
        """Everything but arrays, for JSON."""
        bodies = {k: {n: x for n, x in vars(one).items() if n != "outline"}
                  for k, one in self.bodies.items()}  # fmt: skip
        return {
            "bodies": bodies,
            "pads": {name: one.described() for name, one in self.pads.items()},
            "contacts": {name: vars(one) for name, one in self.contacts.items()},
            "actuators": {name: vars(one) for name, one in self.actuators.items()},
            "short": self.short, "meanings": self.meanings,
        }  # fmt: skip

    @classmethod
    def again(
        cls, plain: dict[str, Any], outlines: dict[str, Array], meshes: dict[str, StoredMesh]
    ) -> Self:
        """The setup of `plain` and its arrays."""
        bodies, contacts, actuators = (plain[name] for name in ("bodies", "contacts", "actuators"))
        return cls(
            {k: BodySetup(outline=outlines.get(k), **one) for k, one in bodies.items()},
            {k: Pad.again(one, meshes[k]) for k, one in plain["pads"].items()},
            {k: ContactSetup(**one) for k, one in contacts.items()},
            {k: ActuatorSetup(**one) for k, one in actuators.items()},
            plain["short"], plain["meanings"],
        )  # fmt: skip
