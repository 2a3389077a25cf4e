"""What is wrong or dangerous in a rig file, said before any run: findings, each with its severity, its field and a sentence."""

import itertools
from collections.abc import Iterator
from typing import Literal, NamedTuple

import networkx as nx
import numpy as np
import torch

from torchsoft.physics.contact import SmoothSlip
from torchsoft.physics.equilibrium import NoEquilibrium
from torchsoft.physics.motion import Sampled, hold
from torchsoft.physics.resting import massless, standing
from torchsoft.rigs.build import Ready, RigFile
from torchsoft.rigs.course import Course, Estimate, at, sampled, signals
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

MOMENTS = 8
"""Times at which the modes are computed, at the most."""

STEPS_PER_PERIOD = 5
"""Steps that a period of an oscillation needs at the least: 2 ms for the paper's, 4e-3 of its forces off."""

OUTPUTS_PER_PERIOD = 4
"""Outputs that a period of a motion needs at the least."""

Severity = Literal["error", "warning", "note"]


class Finding(NamedTuple):
    """An "error" makes no sense or comes to a bad end, a "warning" may, a "note" is worth knowing."""

    severity: Severity
    field: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.field}: {self.sentence}"


def check(file: RigFile) -> list[Finding]:
    """Findings on a rig file, errors first. Takes a second or so."""
    try:
        ready = file.build()
    except ValueError as error:
        field, _, sentence = str(error).partition(": ")
        return [Finding("error", field, sentence)]
    estimate = Estimate(ready)
    course = sampled(estimate, SAMPLES)
    found = [
        *ties(file), *recordings(file, ready), *jumps(file, ready, estimate), *carried(file, ready, estimate),
        *overlaps(file, ready, estimate, course), *fits(ready, course),
    ]  # fmt: skip
    if not any(one.severity == "error" for one in found):
        found += [*dynamics(file, ready, estimate)]
    return sorted(found, key=lambda one: ("error", "warning", "note").index(one.severity))


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


def overlaps(file: RigFile, ready: Ready, estimate: Estimate, course: list[tuple[float, Course]]) -> Iterator[Finding]:
    """Things that lie in each other without a contact between them: at the start, and those whose course is known later."""
    rig, said = ready.rig, set()
    contacts = {(contact.pad, contact.body) for contact in rig.contacts.values()}
    shaped = [name for name, body in rig.bodies.items() if body.shape is not None]
    for time, pose in course:
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


def fits(ready: Ready, course: list[tuple[float, Course]]) -> Iterator[Finding]:
    """How much pads would have to give way, over their heights."""
    rig, worst = ready.rig, dict[tuple[str, ...], tuple[float, float, float]]()
    for time, pose in course:
        pairs = [pair for body in rig.bodies for pair in facing(rig, body, pose)]
        alone = [(key,) for key in rig.contacts if time == 0 and not any(key in pair for pair in pairs)]
        for group in [*pairs, *alone]:
            off = [surface(rig.pads[rig.contacts[k].pad], pose).off(pose[rig.contacts[k].body][:2]) for k in group]
            give = sum(pressed(rig, key, pose) for key in group) if max(off) < 0 else -np.inf
            height = sum(rig.pads[rig.contacts[key].pad].mesh.height for key in group)
            worst[group] = max(worst.get(group, (-np.inf, 0.0, 0.0)), (give / height, give, time))
    for group, (part, give, time) in worst.items():
        body, pads = rig.contacts[group[0]].body, " and ".join(f"`{rig.contacts[key].pad}`" for key in group)
        field = f"contacts.{group[-1]}"
        asked = (
            f"at t = {time:.3g} s `{body}` asks {pads} to give way by {1e3 * give:.3g} mm, {part:.0%} of their height"
        )
        if part >= COMPRESSED:
            yield Finding(
                "error", field, f"`{body}` does not fit: {asked}, far beyond linear elasticity; leave it more room"
            )
        elif part > LINEAR:
            yield Finding(
                "warning", field, f"the strain leaves linear elasticity: {asked}; above {LINEAR:.0%} forces are off"
            )
        elif len(group) == 2 and -np.inf < part <= 0:
            yield Finding(
                "warning", field, f"{pads} never press `{body}`: they come no nearer than {-1e3 * give:.3g} mm to it"
            )


@torch.no_grad()
def dynamics(file: RigFile, ready: Ready, estimate: Estimate) -> Iterator[Finding]:
    """Loops that are unstable, steps too long for the modes, and friction that is not single-valued, at the motions' knots."""
    rig = massless(ready.rig)
    slowest, fastest, least, largest = np.inf, 0.0, None, dict.fromkeys(rig.contacts, 0.0)
    for time, pose in moments(estimate):
        try:
            y = standing(rig, {name: torch.from_numpy(x) for name, x in pose.items()})
        except NoEquilibrium as error:
            yield Finding("warning", "motion", f"pads do not settle as they would at t = {time:.3g} s: {error}")
            continue
        reference = hold(**signals(rig, time))
        for key, contact in rig.contacts.items():
            pad, most = rig.pads[contact.pad], rig.weight(key).max()
            forces = rig.unpack(y, rig.follow(0.0, reference)).pads[contact.pad][0]
            largest[key] = max(largest[key], float(forces.norm(dim=-1).max() / most) if pad.points == 0 else 0.0)
        found = modes(rig, y, reference)
        swinging = found.values[found.values.imag.abs() > found.values.real.abs()].imag.abs()
        fastest = max(fastest, float(swinging.max()) if len(swinging) else 0.0)
        if float(found.values[0].real) > NEUTRAL and file.actuators:
            yield unstable(file, found, time)
            break
        decaying = found.values[found.values.real < -NEUTRAL]
        if len(decaying) and float(-decaying.real.max()) < slowest:
            slowest, least = float(-decaying.real.max()), (complex(decaying[0]), time)
    if least is not None and file.actuators:
        yield Finding("note", "actuators", f"stable; the slowest mode is {shown(least[0])} at t = {least[1]:.3g} s")
    yield from steps(file, fastest)
    for key, contact in rig.contacts.items():
        law, slip = contact.law, contact.law.friction
        if isinstance(slip, SmoothSlip):
            falls = float((slip.mu_s - slip.mu_k) * largest[key] / slip.v_s)
            if float(slip.eta + law.R_t) < falls:
                yield Finding(
                    "warning", f"laws.{file.contacts[key].law}.friction",
                    f"slip is not single-valued at a normal force of {largest[key]:.3g} N: eta + R_t = "
                    f"{float(slip.eta + law.R_t):.3g} N.s/m is below (mu_s - mu_k) F_N / v_s = {falls:.3g}; raise v_s or eta",
                )  # fmt: skip


def moments(estimate: Estimate) -> list[tuple[float, Course]]:
    """Times [s] of the motions' knots and the poses there, those left out that are like an earlier one."""
    out: list[tuple[float, Course]] = []
    for time in estimate.knots():
        pose = estimate(time)
        if not any(all(np.allclose(pose[k], old[k], rtol=0, atol=1e-6) for k in pose) for _, old in out):
            out.append((time, pose))
    return [out[i] for i in np.unique(np.linspace(0, len(out) - 1, min(MOMENTS, len(out))).astype(int))]


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
