"""Checks of a rig file before any run; each finding has a severity, a field and a sentence.

Each check here is a function of the estimated course of the bodies. Checks in static equilibrium
are in `balance`.
"""

import itertools
from collections.abc import Callable, Iterator

import networkx as nx
import numpy as np
import torch

from torchsoft.diagnostic import SEVERITIES, Diagnostic
from torchsoft.physics.motion import Sampled
from torchsoft.physics.pads import Pad
from torchsoft.rigs.balance import at_moments
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.course import Estimate, signals
from torchsoft.rigs.fields import Refused
from torchsoft.rigs.geometry import Scene, at, collision, nodes, tied
from torchsoft.rigs.motion import CsvTable
from torchsoft.solve.ledger import COMPRESSED
from torchsoft.threads import single_threaded

JUMP = {"m": 1e-4, "rad": 1e-2}
"""Largest initial distance between a set-point and its coordinate without a warning."""

TOUCH = 1e-6
"""Depth [m] up to which touching things do not count as overlapping."""

LONGER, FARTHER, TURNED = 100.0, 10.0, 20 * np.pi
"""How often a recorded motion is longer than the run, how often a set-point goes farther than the
rig is large, and how far it turns [rad], from where units are in doubt."""

OUTPUTS_PER_PERIOD = 4
"""Fewest outputs in a period of a motion."""


@single_threaded()
def check(file: RigFile) -> list[Diagnostic]:
    """Findings on a rig file, errors first. Takes some seconds."""
    try:
        estimate = Estimate(file, file.build())
    except Refused as error:
        return [Diagnostic("error", error.field, error.sentence)]
    except ValueError as error:
        field, _, sentence = str(error).partition(": ")
        return [Diagnostic("error", field, sentence)]
    found = [one for look in CHECKS for one in look(estimate)]
    if not any(one.severity == "error" for one in found):
        found += at_moments(estimate)
    return sorted(found, key=lambda one: SEVERITIES.index(one.severity))


def ties(e: Estimate) -> Iterator[Diagnostic]:
    """Errors on loops that cannot move the body that they measure, and on efforts of controllers
    that move none of the measured coordinates."""
    graph = tied(e.rig, e.rig.contacts)
    wanted = [(one.field, one.pushes, (one.measured,)) for one in e.loops]
    wanted += [
        (f"controllers.{k}.pushes", pushed, one.measures)
        for k, one in e.file.controllers.items()
        for pushed in one.pushes
    ]
    for field, pushed, measured in wanted:
        bodies = [at(one)[0] for one in measured]
        if not any(nx.has_path(graph, body, at(pushed)[0]) for body in bodies):
            yield Diagnostic(
                "error", field,
                f"it measures {', '.join(measured)} and pushes {pushed}, but no pad and contact "
                f"tie `{at(pushed)[0]}` to `{'`, `'.join(bodies)}`: whatever it does, it moves "
                f"nothing that it sees; add a contact, or measure {pushed}",
            )  # fmt: skip


def recordings(e: Estimate) -> Iterator[Diagnostic]:
    """Findings on recorded motions that do not cover the run, and on waves too fast for the
    outputs."""
    interval = e.file.outputs.interval
    for name, motion in e.file.motion.items():
        one, fastest = e.rig.reference[name], motion.fastest()
        if isinstance(motion, CsvTable) and isinstance(one, Sampled):
            first, last = float(one.times[0]), float(one.times[-1])
            if last < e.file.outputs.duration * (1 - 1e-9):
                yield Diagnostic(
                    "error", f"motion.{name}.file",
                    f"{motion.file} ends at {last:g} s, but the run lasts until "
                    f"{e.file.outputs.duration:g} s: nothing says what is wanted then; shorten "
                    f"outputs.duration to {last:g}, or record longer",
                )  # fmt: skip
            if last > LONGER * e.file.outputs.duration:
                yield Diagnostic(
                    "warning", f"motion.{name}.file",
                    f"{motion.file} lasts {last:g} s, and the run shows "
                    f"{e.file.outputs.duration:g} s of it: are its times in milliseconds?",
                )  # fmt: skip
            if first > 0:
                sentence = f"{motion.file} begins at {first:g} s; until then its first value holds"
                yield Diagnostic("warning", f"motion.{name}.file", sentence)
        if fastest * interval * OUTPUTS_PER_PERIOD > 1:
            yield Diagnostic(
                "warning", "outputs.interval",
                f"outputs every {interval:g} s do not show motion.{name}, which goes up to "
                f"{fastest:g} Hz; take {1 / (OUTPUTS_PER_PERIOD * fastest):.2g} s or less",
            )  # fmt: skip


def travels(e: Estimate) -> Iterator[Diagnostic]:
    """Motions that go much farther than the rig is large, or turn it round and round."""
    scene, every = Scene(e.rig, e.start), [signals(e.rig, time) for time in e.knots()]
    shapes = [scene.outline(name) for name, body in e.rig.bodies.items() if body.shape is not None]
    places = np.concatenate([*(nodes(pad, scene.pose) for pad in e.rig.pads.values()), *shapes])
    size = float(np.ptp(places, axis=0).max())
    limits = {
        "m": (FARTHER * size, "m", f"the whole rig is {size:.2g} m large", "millimetres"),
        "rad": (TURNED, "rad", f"that is more than {TURNED / (2 * np.pi):g} turns", "degrees"),
    }
    for name in e.file.motion:
        most, unit, beside, other = limits.get(e.file.unit(name), (np.inf, "", "", ""))
        if (far := float(np.ptp([values[name] for values in every]))) > most:
            sentence = f"it goes {far:.3g} {unit}, and {beside}: is it in {other}?"
            yield Diagnostic("warning", f"motion.{name}", sentence)


def jumps(e: Estimate) -> Iterator[Diagnostic]:
    """Warnings on set-points that begin away from their coordinate."""
    values, followed = signals(e.rig, 0.0), e.rig.follow(0.0)
    for loop in e.loops:
        body, axis = at(loop.measured)
        unit, here, wanted = e.file.unit(loop.setpoint), e.start[body][axis], values[loop.setpoint]
        if abs(wanted - here) > JUMP[unit]:
            state = e.rig.unpack(e.y0, followed)
            efforts = [
                float(e.rig.actuator_effort(name, state, followed).detach())
                for name in loop.actuators
            ]
            yield Diagnostic(
                "warning", f"motion.{loop.setpoint}",
                f"it begins at {wanted:.6g} {unit}, but {loop.measured} at {here:.6g} {unit}: "
                f"`{loop.field}` pushes "
                f'with {max(map(abs, efforts)):.3g} at once; begin at "start"',
            )  # fmt: skip


def carried(e: Estimate) -> Iterator[Diagnostic]:
    """Errors on bodies without support against gravity."""
    scene = Scene(e.rig, e.start)
    pushed = {one.pushes for one in e.file.actuators.values()}
    pushed |= {coordinate for one in e.file.controllers.values() for coordinate in one.pushes}
    for name, body in e.file.bodies.items():
        if (
            e.file.gravity == 0
            or not body.weighted
            or "y" not in body.free
            or f"{name}.y" in pushed
        ):
            continue
        own, place = (
            [key for key, contact in e.rig.contacts.items() if contact.body == name],
            e.start[name][:2],
        )
        over = {key: s for key in own if (s := scene.surface(key)).off(place) < 0}
        if any(
            (s.normal[1] > 0.3 and s.depth(place) < 0) or scene.pressed(key) > 0
            for key, s in over.items()
        ):
            continue
        why = (
            "no pad that it has a contact with lies under it"
            if own
            else "it has no contact with any pad"
        )
        yield Diagnostic(
            "error", f"bodies.{name}",
            f"nothing carries it: {why}, no actuator pushes {name}.y, and gravity pulls; it would "
            "fall out of the picture. Put a pad with a contact under it, fix y, or say weighted = "
            "false",
        )  # fmt: skip


def overlaps(e: Estimate) -> Iterator[Diagnostic]:
    """Errors on overlapping things without a contact between them: at the start, and later those of
    known course."""
    said, rig = set[tuple[str, str]](), e.rig
    contacts = {(contact.pad, contact.body) for contact in rig.contacts.values()}
    for time, scene in e.course:
        sure = [
            name
            for name, body in rig.bodies.items()
            if body.shape is not None and (time == 0 or e.known(name))
        ]
        depths = {
            (f"bodies.{a}", f"bodies.{b}"): max(
                scene.inside(b, scene.outline(a)), scene.inside(a, scene.outline(b))
            )
            for a, b in itertools.combinations(sure, 2)
        }
        depths |= {
            (f"bodies.{body}", f"pads.{name}"): scene.inside(body, nodes(pad, scene.pose))
            for body in sure for name,
            pad in rig.pads.items() if (name, body) not in contacts and pad.base != body
        }  # fmt: skip
        depths |= {
            (f"pads.{a}", f"pads.{b}"): collision(rig.pads[a], rig.pads[b], scene.pose)
            for a, b in itertools.combinations(rig.pads, 2)
        }
        for (one, other), depth in depths.items():
            if depth > TOUCH and (one, other) not in said:
                said.add((one, other))
                yield Diagnostic(
                    "error", one,
                    f"it and {other} overlap by {1e3 * depth:.3g} mm at t = {time:.3g} s, and no "
                    "contact is between them: they would pass through each other; move one of "
                    "them, or let a pad be between",
                )  # fmt: skip


def corners(e: Estimate) -> Iterator[Diagnostic]:
    """Warnings on corners sharper than the spacing of contact points."""
    for contact in e.rig.contacts.values():
        spacing, sharpest = (
            float(e.rig.pads[contact.pad].point_lengths.max()),
            Scene(e.rig, e.start).corner(contact.body),
        )
        if sharpest < spacing:
            yield Diagnostic(
                "warning", f"bodies.{contact.body}.shape",
                f"its sharpest corner has a radius of {1e3 * sharpest:.3g} mm, but the contact "
                f"points of `{contact.pad}` are up to {1e3 * spacing:.3g} mm apart: forces jump as "
                f"it goes from one to the next; round it more, or give pads.{contact.pad} more "
                "elements or points",
            )  # fmt: skip


def overloads(e: Estimate) -> Iterator[Diagnostic]:
    """Errors on efforts that would compress the pads of a body too far, however the load were
    shared."""
    for actuator in e.file.actuators.values():
        body, axis = at(actuator.pushes)
        pads = {
            one.pad: e.rig.pads[one.pad]
            for one in e.rig.contacts.values()
            if body in (one.body, e.rig.pads[one.pad].base)
        }
        if actuator.feed_forward is None or axis == 2 or not pads:
            continue
        effort, time = max(
            (abs(signals(e.rig, time)[actuator.feed_forward]), time) for time in e.knots()
        )
        most = sum(map(bears, pads.values())) + actuator.Kp * max(
            pad.mesh.height for pad in pads.values()
        )
        if effort > most:
            yield Diagnostic(
                "error", f"motion.{actuator.feed_forward}",
                f"at t = {time:.3g} s it pushes `{body}` with {effort:.3g} N, but {most:.3g} N "
                f"press its pads in by {COMPRESSED:.0%} of their height wherever they touch, far "
                "beyond linear elasticity; push less, or take stiffer pads",
            )  # fmt: skip


def bears(pad: Pad) -> float:
    """Force [N] on the whole face of a pad at the largest compression that can be run."""
    C = pad.compliance().detach()[1::2, 1::2]
    return (
        float(torch.linalg.solve(C, torch.ones(len(C), dtype=C.dtype)).sum())
        * COMPRESSED
        * pad.mesh.height
    )


CHECKS: tuple[Callable[[Estimate], Iterator[Diagnostic]], ...] = (
    ties, recordings, travels, jumps, carried, overlaps, corners, overloads,
)  # fmt: skip
"""All checks, in order; a new one is added here."""
