"""What is wrong or dangerous in a rig file, said before any run: findings, each with its severity, its field and a sentence."""

import itertools
from collections.abc import Iterator

import networkx as nx

from torchsoft.physics.motion import Sampled
from torchsoft.physics.rig import Rig
from torchsoft.rigs.balance import at_moments
from torchsoft.rigs.build import BuiltRig, RigFile
from torchsoft.rigs.course import Course, Estimate, at, signals
from torchsoft.rigs.fields import Refused
from torchsoft.rigs.finding import SEVERITIES, Finding
from torchsoft.rigs.geometry import TOUCH, collision, corner, inside, nodes, overlap, pressed, surface, tied
from torchsoft.rigs.motion import CsvTable
from torchsoft.rigs.reach import apart, crossed, overloads, unreachable

JUMP = {"m": 1e-4, "rad": 1e-2}
"""How far a set-point may be from its coordinate at the start without a warning."""

SAMPLES = 61
"""Times at which the course of the bodies is looked at, besides the motions' knots."""

OUTPUTS_PER_PERIOD = 4
"""Outputs that a period of a motion needs at the least."""


def check(file: RigFile) -> list[Finding]:
    """Findings on a rig file, errors first. Takes some seconds."""
    try:
        ready = file.build()
    except Refused as error:
        return [Finding("error", error.field, error.sentence)]
    except ValueError as error:
        field, _, sentence = str(error).partition(": ")
        return [Finding("error", field, sentence)]
    estimate = Estimate(file, ready)
    course = estimate.sampled(SAMPLES)
    found = [
        *ties(file, ready.rig), *unseen(file, ready.rig), *recordings(file, ready), *jumps(file, ready, estimate),
        *carried(file, ready, estimate), *overlaps(ready.rig, estimate, course), *corners(file, ready.rig),
        *unreachable(file, ready.rig, estimate, course), *apart(file, ready.rig, estimate, course),
        *crossed(file, ready.rig, estimate, course), *overloads(file, ready.rig, estimate),
    ]  # fmt: skip
    if not any(one.severity == "error" for one in found):
        found += at_moments(file, ready, estimate)
    return sorted(found, key=lambda one: SEVERITIES.index(one.severity))


def ties(file: RigFile, rig: Rig) -> Iterator[Finding]:
    """Loops that measure a body which they cannot move."""
    graph = tied(rig, rig.contacts)
    for loop in file.loops():
        (measured, _), (pushed, _) = at(loop.measured), at(loop.pushes)
        if not nx.has_path(graph, measured, pushed):
            yield Finding(
                "error", loop.field,
                f"it measures {loop.measured} and pushes {loop.pushes}, but no pad and contact tie `{pushed}` to "
                f"`{measured}`: whatever it does, it moves nothing that it sees; add a contact, or measure {loop.pushes}",
            )  # fmt: skip


def unseen(file: RigFile, rig: Rig) -> Iterator[Finding]:
    """Efforts of controllers that move nothing of what these see."""
    graph = tied(rig, rig.contacts)
    for name, one in file.controllers.items():
        for pushed in one.pushes:
            if not any(nx.has_path(graph, at(measured)[0], at(pushed)[0]) for measured in one.measures):
                yield Finding(
                    "error", f"controllers.{name}.pushes",
                    f"no pad and contact tie `{at(pushed)[0]}` to anything that it measures: pushing {pushed} moves nothing "
                    "that it sees; add a contact, or measure it",
                )  # fmt: skip


def recordings(file: RigFile, ready: BuiltRig) -> Iterator[Finding]:
    """Recorded motions that do not cover the run, and waves that outputs do not show."""
    end, interval = file.outputs.duration, file.outputs.interval
    for name, motion in file.motion.items():
        one = ready.rig.reference[name]
        if isinstance(motion, CsvTable) and isinstance(one, Sampled):
            first, last = float(one.times[0]), float(one.times[-1])
            if last < end * (1 - 1e-9):
                yield Finding(
                    "error", f"motion.{name}.file",
                    f"{motion.file} ends at {last:g} s, but the run lasts until {end:g} s: nothing says what is wanted then; "
                    f"shorten outputs.duration to {last:g}, or record longer",
                )  # fmt: skip
            if first > 0:
                yield Finding(
                    "warning",
                    f"motion.{name}.file",
                    f"{motion.file} begins at {first:g} s; until then its first value holds",
                )
        if motion.fastest() * interval * OUTPUTS_PER_PERIOD > 1:
            yield Finding(
                "warning", "outputs.interval",
                f"outputs every {interval:g} s do not show motion.{name}, which goes up to {motion.fastest():g} Hz; take "
                f"{1 / (OUTPUTS_PER_PERIOD * motion.fastest()):.2g} s or less",
            )  # fmt: skip


def jumps(file: RigFile, ready: BuiltRig, estimate: Estimate) -> Iterator[Finding]:
    """Set-points that begin elsewhere than their coordinate."""
    values = signals(ready.rig, 0.0)
    state, followed = ready.rig.unpack(ready.y0), ready.rig.follow(0.0)
    for loop in file.loops():
        body, axis = at(loop.measured)
        unit = file.unit(loop.setpoint)
        here, wanted = estimate.start[body][axis], values[loop.setpoint]
        if abs(wanted - here) > JUMP[unit]:
            efforts = [float(ready.rig.actuator_effort(name, state, followed).detach()) for name in loop.actuators]
            yield Finding(
                "warning", f"motion.{loop.setpoint}",
                f"it begins at {wanted:.6g} {unit}, but {loop.measured} at {here:.6g} {unit}: `{loop.field}` pushes "
                f'with {max(map(abs, efforts)):.3g} at once; begin at "start"',
            )  # fmt: skip


def carried(file: RigFile, ready: BuiltRig, estimate: Estimate) -> Iterator[Finding]:
    """Bodies that nothing carries against gravity."""
    rig, pose = ready.rig, estimate.start
    pushed = {*file.pushed().values()}
    for name, body in file.bodies.items():
        if file.gravity == 0 or not body.weighted or "y" not in body.free or f"{name}.y" in pushed:
            continue
        own = [key for key, contact in rig.contacts.items() if contact.body == name]
        at_pads = {key: surface(rig.pads[rig.contacts[key].pad], pose) for key in own}
        under = [
            s for s in at_pads.values() if s.normal[1] > 0.3 and s.off(pose[name][:2]) < 0 < -s.depth(pose[name][:2])
        ]
        if under or any(pressed(rig, key, pose) > 0 and s.off(pose[name][:2]) < 0 for key, s in at_pads.items()):
            continue
        why = "no pad that it has a contact with lies under it" if own else "it has no contact with any pad"
        yield Finding(
            "error", f"bodies.{name}",
            f"nothing carries it: {why}, no actuator pushes {name}.y, and gravity pulls; it would fall out of the picture. Put "
            "a pad with a contact under it, fix y, or say weighted = false",
        )  # fmt: skip


def corners(file: RigFile, rig: Rig) -> Iterator[Finding]:
    """Corners that fall between contact points."""
    for contact in rig.contacts.values():
        spacing, sharpest = float(rig.pads[contact.pad].point_lengths.max()), corner(rig, contact.body)
        if sharpest < spacing:
            yield Finding(
                "warning", f"bodies.{contact.body}.shape",
                f"its sharpest corner has a radius of {1e3 * sharpest:.3g} mm, but the contact points of `{contact.pad}` "
                f"are up to {1e3 * spacing:.3g} mm apart: forces jump as it goes from one to the next; round it more, or give "
                f"pads.{contact.pad} more elements or points",
            )  # fmt: skip


def overlaps(rig: Rig, estimate: Estimate, course: list[tuple[float, Course]]) -> Iterator[Finding]:
    """Things that lie in each other without a contact between them: at the start, and those whose course is known later."""
    said: set[tuple[str, str]] = set()
    contacts = {(contact.pad, contact.body) for contact in rig.contacts.values()}
    shaped = [name for name, body in rig.bodies.items() if body.shape is not None]
    for time, pose in course:
        sure = [name for name in shaped if time == 0 or estimate.known(name)]
        lying = [
            (f"bodies.{a}", f"bodies.{b}", max(overlap(rig, a, b, pose), overlap(rig, b, a, pose)))
            for a, b in itertools.combinations(sure, 2)
        ]
        lying += [
            (f"bodies.{body}", f"pads.{name}", inside(rig, body, pose, nodes(pad, pose)))
            for body in sure for name, pad in rig.pads.items()
            if (name, body) not in contacts and pad.base != body
        ]  # fmt: skip
        lying += [
            (f"pads.{a}", f"pads.{b}", collision(rig.pads[a], rig.pads[b], pose))
            for a, b in itertools.combinations(rig.pads, 2)
        ]
        for one, other, depth in lying:
            if depth > TOUCH and (one, other) not in said:
                said.add((one, other))
                yield Finding(
                    "error", one,
                    f"it and {other} overlap by {1e3 * depth:.3g} mm at t = {time:.3g} s, and no contact is between them: they "
                    "would pass through each other; move one of them, or let a pad be between",
                )  # fmt: skip
