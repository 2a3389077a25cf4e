"""Checks of a rig file before any run; each finding has a severity, a field and a sentence.

They are made in static equilibrium at some moments of the motions, and along the estimated course
of the bodies.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import networkx as nx
import numpy as np
import torch

from torchsoft.diagnostic import SEVERITIES, Diagnostic
from torchsoft.parallel import single_threaded
from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.motion import hold
from torchsoft.physics.pads import Pad
from torchsoft.physics.setup import PadSetup
from torchsoft.physics.statics import NoEquilibrium, condensed, standing
from torchsoft.rigs.alone import dragged, falls
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.course import Estimate, signals
from torchsoft.rigs.fields import Refused
from torchsoft.rigs.geometry import Scene, at, collision, nodes, tied
from torchsoft.rigs.gripped import LINEAR, Moment, drags, room
from torchsoft.rigs.motion import ProfileTable
from torchsoft.rigs.recorded import recordings
from torchsoft.solve.diagnostics import COMPRESSED, NEUTRAL, SMALL_STRAIN, UNSTABLE, modes, strained
from torchsoft.solve.kernel.arrays import PASSED

# Checks of a rig in static equilibrium at some moments of its motions: room, strains, modes and
# steps, friction.


MOMENTS = 5
"""Most times at which the rig is brought into equilibrium."""

SOFTENED = 0.05
"""Part of the give that the springs of a law may take without a note."""

NEAR, GRAZING = 1e-4, 1e-7
"""Gap [m] below which a body is about to touch a pad, and the penetration over the pad's height
below which it only just does."""

STEPS_PER_PERIOD = 5
"""Fewest steps in a period of an oscillation."""

STEPS_PER_PROFILE = 20
"""Fewest steps between two values of a profile."""


@torch.no_grad()
def at_moments(e: Estimate) -> list[Diagnostic]:
    """Findings on the rig in equilibrium at some knots of its motions: room, strains, modes, steps,
    friction."""
    rig, found, there = condensed(e.rig), list[Diagnostic](), list[Moment]()
    for time in e.moments(MOMENTS):
        scene = Scene(rig, e.balanced(time))
        if found := list(fits(time, scene, Scene(rig, e(time)))):
            return found
        try:
            y = standing(rig, {name: torch.from_numpy(x) for name, x in scene.pose.items()})
        except NoEquilibrium as error:
            return [
                Diagnostic(
                    "error",
                    "motion",
                    f"pads cannot settle where bodies are at t = {time:.3g} s: {error}",
                )
            ]
        reference = hold(**signals(rig, time))
        there.append(Moment(time, scene, y, rig.unpack(y, rig.follow(0.0, reference)), reference))
    for time, reason in list(e.unbalanced.items())[:1]:
        found.append(
            Diagnostic(
                "warning", "motion",
                f"nothing was found to be in balance at t = {time:.3g} s, so that strains and "
                "stability are not judged under the efforts there, only where set-points put "
                f"bodies: {reason}; push less, or leave bodies more room",
            )
        )  # fmt: skip
    return [
        *found, *presses(there), *strains(e, there), *drags(e, there), *dragged(e, there),
        *falls(e), *softens(there), *swings(e, there), *slips(e, there),
    ]  # fmt: skip


def fits(time: float, balanced: Scene, placed: Scene) -> Iterator[Diagnostic]:
    """Errors on bodies that do not fit between their pads in a balance, or where set-points and
    the start put them on a pad that none faces."""
    pairs = [pair for body in balanced.rig.bodies for pair in balanced.facing(body)]
    alone = [(key,) for key in placed.rig.contacts if not any(key in pair for pair in pairs)]
    for group in [*pairs, *alone]:
        scene = balanced if len(group) > 1 else placed
        give, height = room(scene, group), sum(scene.pad(key).mesh.height for key in group)
        if give / height >= COMPRESSED:
            body, pads = scene.rig.contacts[group[0]].body, named(scene, group)
            yield Diagnostic(
                "error", f"contacts.{group[-1]}",
                f"`{body}` does not fit: at t = {time:.3g} s it asks {pads} to give way by "
                f"{1e3 * give:.3g} mm, {give / height:.0%} of their height, far beyond linear "
                "elasticity; leave it more room",
            )  # fmt: skip


def named(scene: Scene, group: Sequence[str]) -> str:
    """Names of the pads of some contacts."""
    return " and ".join(f"`{scene.rig.contacts[key].pad}`" for key in group)


def presses(there: list[Moment]) -> Iterator[Diagnostic]:
    """Warnings on facing pads that never press a body between them."""
    scene = there[0].scene
    for pair in sorted(
        {
            pair
            for moment in there
            for body in scene.rig.bodies
            for pair in moment.scene.facing(body)
        }
    ):
        rooms = [room(moment.scene, pair) for moment in there]
        body = scene.rig.contacts[pair[0]].body
        if max(rooms) <= 0:
            yield Diagnostic(
                "warning", f"contacts.{pair[-1]}",
                f"{named(scene, pair)} never press `{body}`: at the motions' knots they come no "
                f"nearer than {-1e3 * max(rooms):.3g} mm",
            )  # fmt: skip
        elif rooms[-1] <= 0:
            yield Diagnostic(
                "note", f"contacts.{pair[-1]}",
                f"{named(scene, pair)} let go of `{body}`: at t = {there[-1].time:.3g} s they are "
                f"{-1e3 * rooms[-1]:.3g} mm apart from it",
            )  # fmt: skip


def strains(e: Estimate, there: list[Moment]) -> Iterator[Diagnostic]:
    """Warnings on linear pads that are indented beyond linear elasticity, and notes on strains that
    are not small."""
    rig = there[0].scene.rig
    linear = {
        name: rig.pads[name] for name, pad in e.rig.pads.items()
        if not isinstance(pad.material, Hyperelastic)
    }  # fmt: skip
    for name, soft in linear.items():
        pad = PadSetup.of(soft)
        u = torch.stack([rig.displacement(name, m.state) for m in there])
        parts = u.norm(dim=-1).amax(-1) / pad.mesh.height
        worst = int(parts.argmax())
        if parts[worst] > LINEAR:
            yield Diagnostic(
                "warning", f"pads.{name}",
                f"the strain leaves linear elasticity: at t = {there[worst].time:.3g} s it gives "
                f"way by {parts[worst]:.0%} of its height, and above {LINEAR:.0%} forces are off; "
                "press less, or take a thicker or stiffer pad",
            )  # fmt: skip
            continue
        largest = pad.largest_strain(u.numpy())
        worst = int(largest.argmax())
        if largest[worst] > SMALL_STRAIN:
            yield Diagnostic("note", f"pads.{name}", strained(largest[worst], there[worst].time))


def softens(there: list[Moment]) -> Iterator[Diagnostic]:
    """Notes on contacts whose springs take a good part of the give under load."""
    rig = there[0].scene.rig
    for name, contact in rig.contacts.items():
        springs, whole = 0.0, 0.0
        for moment in there:
            u = rig.displacement(contact.pad, moment.state)
            g = rig.penetration(name, moment.state, u).clamp(min=0.0)
            F = rig.weight(name) * contact.law.spring(g)
            gives = float((F * (g + rig.pads[contact.pad].at_points(u).norm(dim=-1))).sum())
            if gives > whole:
                springs, whole = float((F * g).sum()), gives
        if springs > SOFTENED * whole:
            yield Diagnostic(
                "note", f"contacts.{name}",
                f"the springs of its law take {springs / whole:.0%} of the give under load, so "
                'that contact is softer than the pad; raise K_n, or say K_n = "auto"',
            )  # fmt: skip


def swings(e: Estimate, there: list[Moment]) -> Iterator[Diagnostic]:
    """Findings on loops that are unstable or not tied to their measured coordinate, and on steps
    that are too long. Coordinates out of reach of every loop may be unstable: a disc on the top of
    a node rolls off it. Where nothing is free pads only relax, and no mode swings or grows."""
    if not e.loops and e.file.solver.step is None:
        return  # nothing below would be reported
    rig, fastest, least = there[0].scene.rig, 0.0, (complex("-inf"), 0.0)
    for moment in there:
        depth = {key: float(rig.penetration(key, moment.state).max()) for key in rig.contacts}
        if any(
            -NEAR < deep < GRAZING * rig.pads[rig.contacts[key].pad].mesh.height
            for key, deep in depth.items()
        ):
            continue  # it only just touches, or is about to, which it does not for long
        if not rig.layout.rigid:
            continue
        ties = tied(rig, [key for key, deep in depth.items() if deep > 0])
        for one in e.loops:
            (measured, _), (pushed, _) = at(one.measured), at(one.pushes)
            if not nx.has_path(ties, measured, pushed):
                yield Diagnostic(
                    "warning", one.field,
                    f"at t = {moment.time:.3g} s nothing that touches ties {one.measured}, which "
                    f"it measures, to {one.pushes}: what `{measured}` does by itself drives "
                    f"`{pushed}` away; start where they touch, or measure {one.pushes}",
                )  # fmt: skip
        values, moves = modes(rig, moment.y, moment.reference)
        if not len(values):
            continue
        fastest = max([fastest, *values[values.imag.abs() > values.real.abs()].imag.abs().tolist()])
        reached = nx.node_connected_component(ties, moves.partition(".")[0])
        growing = complex(values[0])
        if growing.real > NEUTRAL and any(
            at(q)[0] in reached for one in e.loops for q in (one.measured, one.pushes)
        ):
            across = [one.field for one in e.loops if one.measured != one.pushes]
            yield Diagnostic(
                "error", (*across, "actuators")[0],
                f"the rig is unstable at t = {moment.time:.3g} s: its leading mode is "
                f"{shown(growing)}, mostly of {moves}, and grows by a factor of e in "
                f"{1 / growing.real:.2g} s; {UNSTABLE}",
            )  # fmt: skip
            return
        decaying = values[values.real < -NEUTRAL]
        if len(decaying) and float(decaying[0].real) > least[0].real:
            least = complex(decaying[0]), moment.time
    if e.loops and np.isfinite(least[0].real):
        yield Diagnostic(
            "note",
            "actuators",
            f"stable; the mode that lasts longest is {shown(least[0])}, at t = {least[1]:.3g} s",
        )
    if e.file.solver.step is not None:
        yield from steps(e, e.file.solver.step, fastest, flight(e, there[0].scene))


def shown(mode: complex) -> str:
    """A mode as messages show it."""
    swing = f" +- {abs(mode.imag):.3g}j" if mode.imag else ""
    return f"{mode.real:+.3g}{swing} 1/s"


def flight(e: Estimate, scene: Scene) -> float:
    """Largest speed over size [1/s] with which a body that starts in the air reaches a pad."""
    most = 0.0
    for key, contact in scene.rig.contacts.items():
        body = e.file.bodies[contact.body]
        fall = 2 * e.file.gravity * max(0.0, -scene.pressed(key)) if body.weighted else 0.0
        most = max(
            most,
            (body.start.v_x**2 + body.start.v_y**2 + fall) ** 0.5
            / scene.shape(contact.body).size(),
        )
    return most


def steps(e: Estimate, step: float, fastest: float, flies: float) -> Iterator[Diagnostic]:
    """Warnings on equal steps that are too long for the rig's modes, its motions, or a flying
    body."""
    limits: list[tuple[float, str]] = []
    for name, motion in e.file.motion.items():
        if isinstance(motion, ProfileTable) and len(motion.times) > 1:
            span = min(b - a for a, b in pairwise(motion.times))
            remedy = (
                f"motion.{name} goes from value to value within {span:g} s; take "
                f"{span / STEPS_PER_PROFILE:.2g} s or less"
            )
            limits.append((span / STEPS_PER_PROFILE, remedy))
    if flies > 0:
        remedy = (
            "a body comes flying and may be through a pad between two of them; take "
            f"{PASSED / flies:.2g} s or less"
        )
        limits.append((PASSED / flies, remedy))
    swinging = {f"a mode of the rig swings with {fastest:.3g} rad/s": fastest}
    swinging |= {
        f"motion.{k} goes up to {m.fastest():g} Hz": 2 * np.pi * m.fastest()
        for k, m in e.file.motion.items()
    }
    for cause, w in swinging.items():
        if w > 0:
            most = 2 * np.pi / w / STEPS_PER_PERIOD
            limits.append(
                (
                    most,
                    f"{cause}, and {STEPS_PER_PERIOD} steps a period take {most:.2g} s; take "
                    "shorter ones",
                )
            )
    for most, remedy in limits:
        if step > most:
            yield Diagnostic(
                "warning", "solver.step",
                f"steps of {step:g} s are too coarse: {remedy}, or leave step out and let rtol "
                "choose",
            )  # fmt: skip


def slips(e: Estimate, there: list[Moment]) -> Iterator[Diagnostic]:
    """Warnings on friction whose decrease with slip makes the slip rate ambiguous."""
    rig = there[0].scene.rig
    for key, contact in rig.contacts.items():
        if rig.pads[contact.pad].points:
            continue
        force = max(float(m.state.pads[contact.pad][0].norm(dim=-1).max()) for m in there)
        if reason := contact.law.jumps(force / float(rig.weight(key).max())):
            yield Diagnostic("warning", f"laws.{e.file.contacts[key].law}.friction", reason)


# Checks along the course of the bodies


JUMP = {"m": 1e-4, "rad": 1e-2}
"""Largest initial distance between a set-point and its coordinate without a warning."""

TOUCH = 1e-6
"""Depth [m] up to which touching things do not count as overlapping."""

FARTHER, TURNED = 10.0, 20 * np.pi
"""Thresholds of doubt in units: range of a set-point over the size of the rig, and turn of a
set-point [rad]."""


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
    loops = [(one.field, one.pushes, (one.measured,)) for one in e.loops]
    loops += [
        (f"controllers.{k}.pushes", pushed, one.measures)
        for k, one in e.file.controllers.items()
        for pushed in one.pushes
    ]
    for field, pushed, measured in loops:
        bodies = [at(one)[0] for one in measured]
        if not any(nx.has_path(graph, body, at(pushed)[0]) for body in bodies):
            yield Diagnostic(
                "error", field,
                f"it measures {', '.join(measured)} and pushes {pushed}, but no pad and contact "
                f"tie `{at(pushed)[0]}` to `{'`, `'.join(bodies)}`: whatever it does, it moves "
                f"nothing that it sees; add a contact, or measure {pushed}",
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
        unit, here = e.file.unit(loop.setpoint), e.start[body][axis]
        setpoint = values[loop.setpoint]
        if abs(setpoint - here) > JUMP[unit]:
            state = e.rig.unpack(e.y0, followed)
            efforts = [
                float(e.rig.actuator_effort(name, state, followed).detach())
                for name in loop.actuators
            ]
            yield Diagnostic(
                "warning", f"motion.{loop.setpoint}",
                f"it begins at {setpoint:.6g} {unit}, but {loop.measured} at {here:.6g} {unit}: "
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
        reason = (
            "no pad that it has a contact with lies under it"
            if own
            else "it has no contact with any pad"
        )
        yield Diagnostic(
            "error", f"bodies.{name}",
            f"nothing carries it: {reason}, no actuator pushes {name}.y, and gravity pulls; it "
            "would fall out of the picture. Put a pad with a contact under it, fix y, or say "
            "weighted = false",
        )  # fmt: skip


def lost(e: Estimate) -> Iterator[Diagnostic]:
    """Errors on bodies outside the space over a pad, where a run ends: at the start, and later
    those of known course."""
    for key, contact in e.rig.contacts.items():
        times = [time for time, scene in e.course if scene.away(key)]
        if times and (times[0] == 0 or e.known(contact.body)):
            yield Diagnostic(
                "error", f"bodies.{contact.body}",
                f"at t = {times[0]:.3g} s it is outside the space over the pad `{contact.pad}`, "
                "further from it than the pad is long, and the run would end there; bring it "
                f"nearer, or say may_leave = true of contacts.{key}",
            )  # fmt: skip


def overlaps(e: Estimate) -> Iterator[Diagnostic]:
    """Errors on overlapping things without a contact between them: at the start, and later those of
    known course."""
    reported, rig = set[tuple[str, str]](), e.rig
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
            if depth > TOUCH and (one, other) not in reported:
                reported.add((one, other))
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
        if actuator.feed_forward is None or actuator.Ki or axis == 2 or not pads:
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
    ties, recordings, travels, jumps, carried, lost, overlaps, corners, overloads,
)  # fmt: skip
"""All checks, in order; a new one is added here."""
