"""Contacts that cannot close, bodies that go off the ends of their pads, and efforts that no pad can bear."""

from collections.abc import Iterator

import numpy as np
import torch

from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import Pad
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.course import Course, Estimate, at, signals
from torchsoft.rigs.finding import Finding
from torchsoft.rigs.geometry import FACING, Surface, facing, nodes, outline, pressed, reach, surface
from torchsoft.solve.ledger import COMPRESSED


def unreachable(file: RigFile, rig: Rig, estimate: Estimate, course: list[tuple[float, Course]]) -> Iterator[Finding]:
    """Contacts whose body comes nowhere near the pad on its way."""
    slack = wanders(file, rig, estimate, course)
    for key, contact in rig.contacts.items():
        pad = rig.pads[contact.pad]
        free = slack[contact.body] + (0.0 if pad.base is None else slack[pad.base])
        gaps = []
        for _, pose in course:
            body, there = outline(rig, contact.body, pose), nodes(pad, pose)
            apart = np.maximum(there.min(0) - body.max(0), body.min(0) - there.max(0))
            gaps.append(float((apart - np.where(free > 0, free, pad.mesh.height)).max()))
        if min(gaps) > 0:
            near = min(-pressed(rig, key, pose) for _, pose in course)
            yield Finding(
                "warning", f"contacts.{key}",
                f"it cannot close: `{contact.body}` comes no nearer to `{contact.pad}` than {near:.3g} m; change "
                f"pads.{contact.pad}.origin, the starts or the motions, or leave the contact out",
            )  # fmt: skip


def wanders(file: RigFile, rig: Rig, estimate: Estimate, course: list[tuple[float, Course]]) -> dict[str, Array]:
    """How far bodies may go in x and y (2,) [m] besides their course: along a coordinate that no motion holds, with the others
    and the pads, and as they are thrown or fall."""
    poses = {name: np.stack([pose[name][:2] for _, pose in course]) for name in rig.bodies}
    travel = sum(float(np.ptp(one, axis=0).sum()) for one in poses.values())
    travel += sum(pad.mesh.length + pad.mesh.height for pad in rig.pads.values())
    out = {}
    for name, body in file.bodies.items():
        thrown = np.abs(body.start.velocity[:2]) * estimate.end
        thrown[1] += 0.5 * file.gravity * estimate.end**2 * body.weighted
        own = [estimate.is_own(name, axis) for axis in (0, 1)]
        out[name] = np.where(own, travel + thrown, 0.0)
    return out


def apart(file: RigFile, rig: Rig, estimate: Estimate, course: list[tuple[float, Course]]) -> Iterator[Finding]:
    """Motions that take a body past the end of a pad that it had touched. A body that no motion holds may be anywhere on
    the pad opposite."""
    closed, said = set[str](), set[str]()
    for time, pose in course:
        at_pads = {key: surface(rig.pads[one.pad], pose) for key, one in rig.contacts.items()}
        closed |= {key for key in rig.contacts if pressed(rig, key, pose) > 0}
        for key in sorted(closed):
            body, own, base = rig.contacts[key].body, at_pads[key], rig.pads[rig.contacts[key].pad].base
            there = {body: (pose[body][:2], 0.0)} | {
                rig.pads[rig.contacts[other].pad].base: (at_pads[other].middle, at_pads[other].half)
                for other in closed if rig.contacts[other].body == body and at_pads[other].normal @ own.normal < FACING
            }  # fmt: skip
            off = {by: float(own.off(middle)) - half for by, (middle, half) in there.items() if held(estimate, by, own)}
            presses = own.depth(pose[body][:2]) + reach(rig, body, pose, -own.normal) > 0
            if body not in said and presses and held(estimate, base, own) and max(off.values(), default=0.0) > 0:
                said.add(body)
                by = max(off, key=lambda one: off[one])
                yield Finding(
                    "warning", f"motion.{mover(file, estimate, pose, {by, base})}",
                    f"at t = {time:.3g} s it has taken `{body}` {off[by]:.3g} m past the end of `{rig.contacts[key].pad}`, "
                    f"which contacts.{key} presses until then; let it go less far, or take a longer pad",
                )  # fmt: skip


def crossed(file: RigFile, rig: Rig, estimate: Estimate, course: list[tuple[float, Course]]) -> Iterator[Finding]:
    """Motions that take a pad through the body between it and another one."""
    for body in rig.bodies:
        for pair in facing(rig, body, course[0][1]):
            for time, pose in course:
                a, b = (surface(rig.pads[rig.contacts[key].pad], pose) for key in pair)
                if a.depth(b.middle) > a.height and a.off(b.middle) < b.half and a.normal @ b.normal < FACING:
                    one, other = (rig.pads[rig.contacts[key].pad].base for key in pair)
                    yield Finding(
                        "error", f"motion.{mover(file, estimate, pose, {body, one, other})}",
                        f"at t = {time:.3g} s it has taken the pads of contacts.{pair[0]} and contacts.{pair[1]} through "
                        f"each other, and through `{body}` between them; let it go less far",
                    )  # fmt: skip
                    break


def held(estimate: Estimate, body: str | None, on: Surface) -> bool:
    """Whether motions or fixed values hold a body along a surface; they do the ground."""
    return body is None or not any(abs(on.along[axis]) > 0.1 and estimate.is_own(body, axis) for axis in (0, 1))


def mover(file: RigFile, estimate: Estimate, pose: Course, bodies: set[str | None]) -> str:
    """The motion that has taken some bodies furthest."""
    follow = {one.measured: one.setpoint for one in file.loops()}
    follow |= {f"{body}.{axis}": f"{body}.{axis}" for body, axis, kind in file.coordinates() if kind == "driven"}
    way = {
        name: abs(pose[body][axis] - estimate.start[body][axis])
        for coordinate, name in follow.items() for body, axis in [at(coordinate)] if body in bodies and axis < 2
    }  # fmt: skip
    return max(way, key=lambda name: way[name])


def overloads(file: RigFile, rig: Rig, estimate: Estimate) -> Iterator[Finding]:
    """Efforts that would press the pads of a body in too far, however they were spread over them."""
    for name, actuator in file.actuators.items():
        body, axis = at(actuator.pushes)
        pads = {one.pad for one in rig.contacts.values() if body in (one.body, rig.pads[one.pad].base)}
        if actuator.feed_forward is None or axis == 2 or not pads:
            continue
        effort, time = max((abs(signals(rig, time)[actuator.feed_forward]), time) for time in estimate.knots())
        most = sum(bears(rig.pads[pad]) for pad in pads) + actuator.Kp * max(rig.pads[pad].mesh.height for pad in pads)
        if effort > most:
            yield Finding(
                "error", f"motion.{actuator.feed_forward}",
                f"at t = {time:.3g} s it pushes `{body}` with {effort:.3g} N, but {most:.3g} N press its pads in by "
                f"{COMPRESSED:.0%} of their height wherever they touch, far beyond linear elasticity; push less, or take "
                "stiffer pads",
            )  # fmt: skip


def bears(pad: Pad) -> float:
    """The force [N] that presses the whole face of a pad in by the most that can be run."""
    C = pad.compliance().detach().unflatten(0, (-1, 2)).unflatten(2, (-1, 2))
    up = torch.ones(len(C), dtype=C.dtype)
    return float(torch.linalg.solve(C[:, 1, :, 1], up).sum()) * COMPRESSED * pad.mesh.height
