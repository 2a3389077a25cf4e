"""What is wrong or dangerous in a rig file, said before any run: findings, each with its severity, its field and a sentence."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple, get_args

import networkx as nx
import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.contact import SmoothSlip
from torchsoft.physics.equilibrium import NoEquilibrium
from torchsoft.physics.motion import Reference, Sampled, hold
from torchsoft.physics.resting import massless, standing
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import Ready, RigFile
from torchsoft.rigs.course import Course, Estimate, at, signals
from torchsoft.rigs.geometry import crossing, facing, outline, overlap, pressed, surface
from torchsoft.rigs.motion import CsvTable
from torchsoft.solve.ledger import COMPRESSED
from torchsoft.solve.stability import NEUTRAL, Modes, modes

LINEAR = 0.25
"""Part of its height by which a pad may be pressed in without a warning (assumed): strains under a contact are of that order,
and the stress of rubber leaves the straight line of small strains by some ten per cent there."""

TOUCH = 1e-6
"""Depth [m] up to which things that touch do not overlap."""

JUMP = {"m": 1e-4, "rad": 1e-2}
"""How far a set-point may be from its coordinate at the start without a warning."""

SAMPLES = 61
"""Times at which the course of the bodies is looked at, besides the motions' knots."""

MOMENTS = 5
"""Times at which the rig is brought into balance, at the most."""

STEPS_PER_PERIOD = 5
"""Steps that a period of an oscillation needs at the least: 2 ms for the paper's, 4e-3 of its forces off."""

OUTPUTS_PER_PERIOD = 4
"""Outputs that a period of a motion needs at the least."""

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)


class Finding(NamedTuple):
    """An "error" makes no sense or comes to a bad end, a "warning" may, a "note" is worth knowing."""

    severity: Severity
    field: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.field}: {self.sentence}"


def check(file: RigFile) -> list[Finding]:
    """Findings on a rig file, errors first. Takes some seconds."""
    try:
        ready = file.build()
    except ValueError as error:
        field, _, sentence = str(error).partition(": ")
        return [Finding("error", field, sentence)]
    estimate = Estimate(file, ready)
    found = [
        *ties(file), *recordings(file, ready), *jumps(file, ready, estimate), *carried(file, ready, estimate),
        *overlaps(ready.rig, estimate),
    ]  # fmt: skip
    if not any(one.severity == "error" for one in found):
        found += at_moments(file, ready, estimate)
    return sorted(found, key=lambda one: SEVERITIES.index(one.severity))


def ties(file: RigFile) -> Iterator[Finding]:
    """Loops that measure a body which they cannot move."""
    graph = nx.Graph()
    graph.add_nodes_from(file.bodies)
    graph.add_edges_from(
        (file.pads[one.pad].base, one.body) for one in file.contacts.values() if file.pads[one.pad].base is not None
    )
    for name, actuator in file.actuators.items():
        (measured, _), (pushed, _) = at(actuator.measured), at(actuator.pushes)
        if actuator.setpoint is not None and not nx.has_path(graph, measured, pushed):
            yield Finding(
                "error", f"actuators.{name}",
                f"it measures {actuator.measured} and pushes {actuator.pushes}, but no pad and contact tie `{pushed}` to "
                f"`{measured}`: whatever it does, it moves nothing that it sees; add a contact, or measure {actuator.pushes}",
            )  # fmt: skip


def recordings(file: RigFile, ready: Ready) -> Iterator[Finding]:
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


def jumps(file: RigFile, ready: Ready, estimate: Estimate) -> Iterator[Finding]:
    """Set-points that begin elsewhere than their coordinate."""
    values = signals(ready.rig, 0.0)
    for name, actuator in file.actuators.items():
        if actuator.setpoint is None:
            continue
        body, axis = at(actuator.measured)
        unit = file.unit(actuator.setpoint)
        here, wanted = estimate.start[body][axis], values[actuator.setpoint]
        if abs(wanted - here) > JUMP[unit]:
            yield Finding(
                "warning", f"motion.{actuator.setpoint}",
                f"it begins at {wanted:.6g} {unit}, but {actuator.measured} at {here:.6g} {unit}: the loop `{name}` pushes "
                f'with {abs(actuator.Kp * (wanted - here)):.3g} at once; begin at "start"',
            )  # fmt: skip


def carried(file: RigFile, ready: Ready, estimate: Estimate) -> Iterator[Finding]:
    """Bodies that nothing carries against gravity."""
    rig, pose = ready.rig, estimate.start
    pushed = {actuator.pushes for actuator in file.actuators.values()}
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


def overlaps(rig: Rig, estimate: Estimate) -> Iterator[Finding]:
    """Things that lie in each other without a contact between them: at the start, and those whose course is known later."""
    said: set[tuple[str, str]] = set()
    contacts = {(contact.pad, contact.body) for contact in rig.contacts.values()}
    shaped = [name for name, body in rig.bodies.items() if body.shape is not None]
    for time, pose in estimate.sampled(SAMPLES):
        sure = [name for name in shaped if time == 0 or estimate.known(name)]
        moved = {name: surface(pad, pose).corners for name, pad in rig.pads.items()}
        lying = [
            (f"bodies.{a}", f"bodies.{b}", max(overlap(rig, a, b, pose), overlap(rig, b, a, pose)))
            for a, b in itertools.combinations(sure, 2)
        ]
        lying += [
            (f"bodies.{body}", f"pads.{pad}", crossing(outline(rig, body, pose), corners))
            for body in sure for pad, corners in moved.items()
            if (pad, body) not in contacts and rig.pads[pad].base != body
        ]  # fmt: skip
        lying += [
            (f"pads.{a}", f"pads.{b}", crossing(x, y)) for (a, x), (b, y) in itertools.combinations(moved.items(), 2)
        ]
        for one, other, depth in lying:
            if depth > TOUCH and (one, other) not in said:
                said.add((one, other))
                yield Finding(
                    "error", one,
                    f"it and {other} overlap by {1e3 * depth:.3g} mm at t = {time:.3g} s, and no contact is between them: they "
                    "would pass through each other; move one of them, or let a pad be between",
                )  # fmt: skip


class Moment(NamedTuple):
    """The rig in balance at a time [s]: poses by body, state (size,) of settled pads, and the signals, held."""

    time: float
    pose: Course
    y: Tensor
    reference: Reference


@torch.no_grad()
def at_moments(file: RigFile, ready: Ready, estimate: Estimate) -> list[Finding]:
    """What comes of the rig in balance at some of its motions' knots: strains, modes, steps, friction."""
    rig, found, there = massless(ready.rig), list[Finding](), list[Moment]()
    for time in estimate.moments(MOMENTS):
        pose = estimate.balanced(time)
        found += [one for one in fits(rig, time, pose) if (one.field, one.severity) not in {x[1::-1] for x in found}]
        if found and found[-1].severity == "error":
            return found
        try:
            y = standing(rig, {name: torch.from_numpy(x) for name, x in pose.items()})
        except NoEquilibrium as error:
            found.append(
                Finding("error", "motion", f"pads cannot settle where bodies are at t = {time:.3g} s: {error}")
            )
            return found
        there.append(Moment(time, pose, y, hold(**signals(rig, time))))
    return [*found, *presses(rig, there), *strains(rig, there), *swings(file, rig, there), *slips(file, rig, there)]


def fits(rig: Rig, time: float, pose: Course) -> Iterator[Finding]:
    """Bodies that pads have no room for."""
    pairs = [pair for body in rig.bodies for pair in facing(rig, body, pose)]
    alone = [(key,) for key in rig.contacts if not any(key in pair for pair in pairs)]
    for group in [*pairs, *alone]:
        give, height = room(rig, group, pose)
        if give / height >= COMPRESSED:
            body, pads = rig.contacts[group[0]].body, " and ".join(f"`{rig.contacts[key].pad}`" for key in group)
            yield Finding(
                "error", f"contacts.{group[-1]}",
                f"`{body}` does not fit: at t = {time:.3g} s it asks {pads} to give way by {1e3 * give:.3g} mm, "
                f"{give / height:.0%} of their height, far beyond linear elasticity; leave it more room",
            )  # fmt: skip


def room(rig: Rig, group: Sequence[str], pose: Course) -> tuple[float, float]:
    """By how much the pads of some contacts of one body have to give way [m], together, and their heights [m]; negative where
    they are apart, or the body is beyond the end of one."""
    at_pads = [surface(rig.pads[rig.contacts[key].pad], pose) for key in group]
    beside = max(float(s.off(pose[rig.contacts[key].body][:2])) for s, key in zip(at_pads, group))
    give = sum(pressed(rig, key, pose) for key in group)
    return -beside if beside > 0 else give, sum(s.height for s in at_pads)


def presses(rig: Rig, there: list[Moment]) -> Iterator[Finding]:
    """Pads that face each other and never press what is between them."""
    pairs = {pair for moment in there for body in rig.bodies for pair in facing(rig, body, moment.pose)}
    for pair in sorted(pairs):
        nearest = max(room(rig, pair, moment.pose)[0] for moment in there)
        if nearest <= 0:
            pads = " and ".join(f"`{rig.contacts[key].pad}`" for key in pair)
            yield Finding(
                "warning", f"contacts.{pair[-1]}",
                f"{pads} never press `{rig.contacts[pair[0]].body}`: at the motions' knots they come no nearer than "
                f"{-1e3 * nearest:.3g} mm",
            )  # fmt: skip


def strains(rig: Rig, there: list[Moment]) -> Iterator[Finding]:
    """Pads that are pressed in beyond linear elasticity."""
    for name, pad in rig.pads.items():
        parts = [
            float(rig.displacement(name, rig.unpack(m.y, rig.follow(0.0, m.reference))).norm(dim=-1).max())
            / pad.mesh.height
            for m in there
        ]
        worst = int(np.argmax(parts))
        if parts[worst] > LINEAR:
            yield Finding(
                "warning", f"pads.{name}",
                f"the strain leaves linear elasticity: at t = {there[worst].time:.3g} s it gives way by {parts[worst]:.0%} of "
                f"its height, and above {LINEAR:.0%} forces are off; press less, or take a thicker or stiffer pad",
            )  # fmt: skip


def swings(file: RigFile, rig: Rig, there: list[Moment]) -> Iterator[Finding]:
    """Loops that are unstable, and steps that are too long."""
    fastest, least = 0.0, (complex("-inf"), 0.0)
    for moment in there:
        if grazing(rig, moment):
            continue
        found = modes(rig, moment.y, moment.reference)
        swinging = found.values[found.values.imag.abs() > found.values.real.abs()].imag.abs()
        fastest = max(fastest, float(swinging.max()) if len(swinging) else 0.0)
        if float(found.values[0].real) > NEUTRAL and file.actuators:
            yield unstable(file, found, moment.time)
            return
        decaying = found.values[found.values.real < -NEUTRAL]
        if len(decaying) and float(decaying[0].real) > least[0].real:
            least = complex(decaying[0]), moment.time
    if file.actuators:
        yield Finding(
            "note", "actuators", f"stable; the mode that lasts longest is {shown(least[0])}, at t = {least[1]:.3g} s"
        )
    yield from steps(file, fastest)


def grazing(rig: Rig, moment: Moment) -> bool:
    """Whether a contact only just touches: what it ties, it does not tie for long."""
    state = rig.unpack(moment.y, rig.follow(0.0, moment.reference))
    deepest = {key: float(rig.penetration(key, state).max()) for key in rig.contacts}
    return any(0 < deep < float(rig.contacts[key].law.epsilon) for key, deep in deepest.items())


def slips(file: RigFile, rig: Rig, there: list[Moment]) -> Iterator[Finding]:
    """Friction that falls with slip faster than is single-valued."""
    for key, contact in rig.contacts.items():
        law, slip, pad = contact.law, contact.law.friction, rig.pads[contact.pad]
        if not isinstance(slip, SmoothSlip) or pad.points:
            continue
        forces = [rig.unpack(m.y, rig.follow(0.0, m.reference)).pads[contact.pad][0].norm(dim=-1).max() for m in there]
        largest = float(max(forces) / rig.weight(key).max())
        falls, damps = float((slip.mu_s - slip.mu_k) * largest / slip.v_s), float(slip.eta + law.R_t)
        if damps < falls:
            yield Finding(
                "warning", f"laws.{file.contacts[key].law}.friction",
                f"slip is not single-valued at a normal force of {largest:.3g} N: eta + R_t = {damps:.3g} N.s/m is below "
                f"(mu_s - mu_k) F_N / v_s = {falls:.3g}; raise v_s or eta",
            )  # fmt: skip


def unstable(file: RigFile, found: Modes, time: float) -> Finding:
    """A loop that goes off by itself."""
    mode = complex(found.values[0])
    across = [name for name, one in file.actuators.items() if one.setpoint and one.measured != one.pushes]
    field = f"actuators.{across[0]}" if across else "actuators"
    return Finding(
        "error", field,
        f"the rig is unstable at t = {time:.3g} s: its leading mode is {shown(mode)}, mostly of {found.moves}, and grows by "
        f"a factor of e in {1 / mode.real:.2g} s; lower the gains, raise the pads' tau or E, or measure what is pushed",
    )  # fmt: skip


def steps(file: RigFile, fastest: float) -> Iterator[Finding]:
    """Equal steps that are too long for the rig's modes or its motions."""
    step = file.solver.step
    causes = {f"a mode of the rig swings with {fastest:.3g} rad/s": fastest}
    causes |= {f"motion.{k} goes up to {m.fastest():g} Hz": 2 * np.pi * m.fastest() for k, m in file.motion.items()}
    for cause, w in causes.items():
        if step is not None and w * step * STEPS_PER_PERIOD > 2 * np.pi:
            yield Finding(
                "warning", "solver.step",
                f"steps of {step:g} s are too coarse: {cause}, and {STEPS_PER_PERIOD} steps a period take "
                f"{2 * np.pi / w / STEPS_PER_PERIOD:.2g} s; take shorter ones, or leave step out and let rtol choose",
            )  # fmt: skip


def shown(mode: complex) -> str:
    """A mode as messages show it."""
    swing = f" +- {abs(mode.imag):.3g}j" if mode.imag else ""
    return f"{mode.real:+.3g}{swing} 1/s"
