"""Bodies that pads grip between them: room, and friction where the pads are moved along them."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from torchsoft.diagnostic import Diagnostic
from torchsoft.physics.contact import Friction
from torchsoft.physics.mesh import Array
from torchsoft.physics.motion import Reference
from torchsoft.physics.pads import nodal
from torchsoft.physics.state import State
from torchsoft.rigs.course import Estimate
from torchsoft.rigs.geometry import Scene, turned

LINEAR = 0.25
"""Largest indentation over a pad's height without a warning (assumed): strains under a contact are
of that order, and there the stress of rubber deviates from linear elasticity by some ten per
cent."""


class Moment(NamedTuple):
    """The rig with massless pads in equilibrium at a time [s]: the scene, the state (size,) with
    settled pads and its parts, and the signals as constants."""

    time: float
    scene: Scene
    y: Tensor
    state: State
    reference: Reference


def room(scene: Scene, group: Sequence[str]) -> float:
    """Total indentation [m] of the pads of some contacts of one body; negative where they are
    apart, or the body is beyond the end of one."""
    beside = max(
        scene.surface(key).off(scene.pose[scene.rig.contacts[key].body][:2]) for key in group
    )
    return -beside if beside > 0 else sum(scene.pressed(key) for key in group)


class Rub(NamedTuple):
    """Friction of a contact at a moment: the largest give of its pad per force along the surface
    that is spread as the normal forces are [m/N], these [N], the largest coefficient of friction
    [1], and the width of the contact [m]."""

    give: float
    normal: float
    mu: float
    width: float

    @classmethod
    def of(cls, m: Moment, key: str) -> Self:
        contact, pad = m.scene.rig.contacts[key], m.scene.pad(key)
        forces, law = m.state.pads[contact.pad][0].norm(dim=-1), contact.law.friction
        total, touching = float(forces.sum()), forces > 0
        if total == 0.0:
            return cls(0.0, 0.0, 0.0, 0.0)
        along = torch.stack((forces / total, torch.zeros_like(forces)), -1)
        give = float(nodal(pad.compliance(), along).norm(dim=-1).max())
        mu = float(law.mu_s) if isinstance(law, Friction) else np.inf
        places = pad.positions[touching][:, 0]
        return cls(give, total, mu, float(places.max() - places.min()))


def drags(e: Estimate, there: list[Moment]) -> Iterator[Diagnostic]:
    """Warnings on pads that are moved along a body between them that cannot roll: friction shears
    them until it slips, or tilts the body."""
    rig = there[0].scene.rig
    for body, pair in sorted(
        {(b, p) for m in there for b in rig.bodies for p in m.scene.facing(b)}
    ):
        grips = [
            scene for _, scene in e.course
            if pair in scene.facing(body) and room(scene, pair) > 0
        ]  # fmt: skip
        one, other = (max((Rub.of(m, key) for m in there), key=lambda r: r.normal) for key in pair)
        if not grips or not one.normal * other.normal > 0:
            continue
        scene, surfaces = grips[0], [[s.surface(key) for s in grips] for key in pair]
        apart = [(b.middle - a.middle) @ a.along for a, b in zip(*surfaces)]
        way, free = float(np.ptp(apart)), rig.bodies[body].freedom["theta"] == "free"
        across, grows = turning(scene, body, surfaces[0][0].normal, way)
        heights = [scene.pad(key).mesh.height for key in pair]
        if free and grows <= LINEAR * sum(heights):
            continue  # it rolls
        force = min(way / (one.give + other.give), *(r.mu * r.normal for r in (one, other)))
        cause = f"`{body}` cannot roll, and the pads are moved along it by {1e3 * way:.3g} mm"
        for key, rub, height in zip(pair, (one, other), heights):
            yield from sheared(rig.contacts[key].pad, force * rub.give / height, cause)
        if free and any(force * across / 2 > r.normal * r.width / 6 for r in (one, other)):
            yield Diagnostic(
                "warning", f"bodies.{body}",
                f"{cause}: friction tilts it onto its edges, and turned as far as they go it "
                f"is {1e3 * grows:.3g} mm higher, {grows / sum(heights):.0%} of the pads' height, "
                f"where strains leave linear elasticity; {CURE}",
            )  # fmt: skip


CURE = "move or press less, or take less friction, or a thicker or stiffer pad"
"""Remedies for a pad that a body is moved over."""


def sheared(pad: str, part: float, cause: str) -> Iterator[Diagnostic]:
    """Warning on a pad that friction shears by a part of its height beyond linear elasticity."""
    if part > LINEAR:
        yield Diagnostic(
            "warning", f"pads.{pad}",
            f"the strain leaves linear elasticity: {cause}: friction shears it by up to "
            f"{part:.0%} of its height; {CURE}",
        )  # fmt: skip


def turning(scene: Scene, body: str, n: Array, way: float) -> tuple[float, float]:
    """Height [m] of a body across two pads of normal n, and by how much it grows where the body
    turns with pads that are moved along it by `way` [m]."""
    across = scene.reach(body, n) + scene.reach(body, -n)
    turns = np.linspace(-1.0, 1.0, 9) * way / across
    ends = ((turned(n, turn), turned(-n, turn)) for turn in turns)
    most = max(scene.reach(body, up) + scene.reach(body, down) for up, down in ends)
    return across, most - across
