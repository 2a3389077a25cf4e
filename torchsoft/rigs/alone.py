"""Bodies on pads that none faces: what falls onto a pad, and what is dragged over it."""

import warnings
from collections.abc import Iterator

import numpy as np
import torch

from torchsoft.diagnostic import Diagnostic
from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.statics import NoEquilibrium, resting, standing
from torchsoft.rigs.course import BALANCED, Estimate
from torchsoft.rigs.geometry import Scene
from torchsoft.rigs.gripped import CURE, LINEAR, Moment, Rub, sheared, turning
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import simulate

ROUGH = 1e-3
"""Relative tolerance of a trial of a fall: forces to 1 %."""

STOPPED = 4.0
"""Time in which a pad stops what falls onto it, over that in which it would pass its height."""

SHOWN = 60
"""Outputs of a trial while the pad stops the body."""

TIPPED = 0.3
"""Largest angle [rad] by which a body is tipped for a trial."""


def falls(e: Estimate) -> Iterator[Diagnostic]:
    """Warnings on pads that a body falls onto, or is thrown at, beyond linear elasticity: by a
    rough run of the rig until a pad has stopped it."""
    for body in e.rig.bodies:
        if (landing := first_touch(e, body)) is None:
            continue
        key, touch, speed = landing
        pad, name = e.rig.pads[e.rig.contacts[key].pad], e.rig.contacts[key].pad
        if isinstance(pad.material, Hyperelastic):
            continue
        stop = touch + STOPPED * pad.mesh.height / speed
        t = torch.cat((torch.zeros(1), torch.linspace(touch, stop, SHOWN))).double()
        cause = f"`{body}` comes onto `{name}` with {speed:.3g} m/s"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                run = simulate(e.rig, t[t <= e.end], y0=e.y0, rtol=ROUGH)
        except SimulationFailed as failed:
            yield Diagnostic("warning", f"bodies.{body}", f"{cause}, and a trial fails: {failed}")
            continue
        give = run.displacement[name].norm(dim=-1).amax(-1) / pad.mesh.height
        k = int(give.argmax())
        if give[k] > LINEAR:
            yield Diagnostic(
                "warning", f"pads.{name}",
                f"the strain leaves linear elasticity: {cause}, and at t = {float(run.t[k]):.3g} s "
                f"it gives way by {float(give[k]):.0%} of its height, and above {LINEAR:.0%} "
                "forces are off; let it fall less far, or take a thicker or stiffer pad",
            )  # fmt: skip


def first_touch(e: Estimate, body: str) -> tuple[str, float, float] | None:
    """The contact at which a body that starts clear of all its pads comes down first, the time
    [s] and the speed [m/s]; None where it does not fly, or does not come down in the run."""
    scene, table, rig = Scene(e.rig, e.start), e.file.bodies[body], e.rig
    own = [key for key, contact in rig.contacts.items() if contact.body == body]
    if not all(e.is_own(body, axis) for axis in (0, 1)) or not own:
        return None
    gaps = {key: -scene.pressed(key) for key in own}
    if min(gaps.values()) <= 0:
        return None
    pulled = np.array([0.0, -e.file.gravity if table.weighted else 0.0])
    moves, found = np.array([table.start.v_x, table.start.v_y]), list[tuple[float, float, str]]()
    for key, gap in gaps.items():
        surface = scene.surface(key)
        v, g = (-float(one @ surface.normal) for one in (moves, pulled))
        under = v**2 + 2 * g * gap
        if under <= 0 or under**0.5 + v <= 0:  # it stops before, or goes away
            continue
        speed = under**0.5
        time = 2 * gap / (speed + v)
        place = e.start[body][:2] + moves * time + 0.5 * pulled * time**2
        if time < e.end and surface.off(place) < 0:
            found.append((time, speed, key))
    return None if not found else (min(found)[2], *min(found)[:2])


def dragged(e: Estimate, there: list[Moment]) -> Iterator[Diagnostic]:
    """Warnings on pads that a body is dragged over: friction shears them until it slips, or tips
    the body onto an edge."""
    rig = there[0].scene.rig
    faced = {
        key for m in there for body in rig.bodies for pair in m.scene.facing(body) for key in pair
    }
    for key, contact in rig.contacts.items():
        body, name = contact.body, contact.pad
        touching = [scene for _, scene in e.course if scene.pressed(key) > 0]
        if key in faced or not touching or isinstance(e.rig.pads[name].material, Hyperelastic):
            continue
        most = max(there, key=lambda m: Rub.of(m, key).normal)
        rub, surfaces = Rub.of(most, key), [scene.surface(key) for scene in touching]
        apart = [(s.pose[body][:2] - at.middle) @ at.along for s, at in zip(touching, surfaces)]
        way, height = float(np.ptp(apart)), rig.pads[name].mesh.height
        if rub.normal == 0.0 or way == 0.0:
            continue
        free = rig.bodies[body].freedom["theta"] == "free" and e.is_own(body, 2)
        normal = surfaces[0].normal
        if free and turning(touching[0], body, normal, way)[1] <= 0.1 * height:
            continue  # it rolls
        force = min(way / rub.give, rub.mu * rub.normal)
        cause = f"`{body}` is dragged over it by {1e3 * way:.3g} mm"
        yield from sheared(name, force * rub.give / height, cause)
        reach = touching[0].reach(body, -normal)
        if not free or force * reach <= rub.normal * rub.width / 2:
            continue
        part = max(tipped(most, key, sign * min(TIPPED, way / reach)) for sign in (-1.0, 1.0))
        if part > LINEAR:
            yield Diagnostic(
                "warning", f"bodies.{body}",
                f"`{body}` is dragged over `{name}` by {1e3 * way:.3g} mm: friction tips it onto "
                f"an edge, which presses the pad in by {part:.0%} of its height under the same "
                f"load, where strains leave linear elasticity; {CURE}",
            )  # fmt: skip


@torch.no_grad()
def tipped(m: Moment, key: str, turn: float) -> float:
    """Give of the pad of a contact over its height, under the normal force that it has at a
    moment, once the body is turned by an angle [rad]; 0 where that has no balance."""
    rig, body = m.scene.rig, m.scene.rig.contacts[key].body
    n = m.scene.surface(key).normal
    pose = {name: x.copy() for name, x in m.scene.pose.items()}
    pose[body][2] += turn
    pose[body][:2] += (Scene(rig, pose).reach(body, -n) - m.scene.reach(body, -n)) * n
    load = np.append(-Rub.of(m, key).normal * n, 0.0)
    if rig.bodies[body].weighted:
        load[1] += float(rig.gravity * rig.bodies[body].masses[1])
    placed = {name: torch.from_numpy(x) for name, x in pose.items()}
    axis = int(np.abs(n).argmax())
    try:
        held = resting(
            rig, placed, {body: [axis]}, actuators=(), pushed={body: torch.from_numpy(load)},
            residual=BALANCED,
        )  # fmt: skip
        state = rig.unpack(standing(rig, held), rig.follow(0.0))
    except NoEquilibrium:
        return 0.0
    pad = rig.contacts[key].pad
    give = rig.displacement(pad, state).norm(dim=-1).max()
    return float(give) / rig.pads[pad].mesh.height
