"""What comes of a rig in balance at some moments of its motions: room, strains, modes and steps, friction."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import networkx as nx
import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.contact import SmoothSlip
from torchsoft.physics.motion import Reference, hold
from torchsoft.physics.rig import Rig
from torchsoft.physics.statics import NoEquilibrium, massless, standing
from torchsoft.rigs.build import BuiltRig, RigFile
from torchsoft.rigs.course import Course, Estimate, at, signals
from torchsoft.rigs.finding import Finding
from torchsoft.rigs.geometry import facing, pressed, surface, tied
from torchsoft.rigs.motion import ProfileTable
from torchsoft.solve.kernel.run import PASSED
from torchsoft.solve.ledger import COMPRESSED
from torchsoft.solve.stability import NEUTRAL, Modes, modes

LINEAR = 0.25
"""Part of its height by which a pad may be pressed in without a warning (assumed): strains under a contact are of that order,
and the stress of rubber leaves the straight line of small strains by some ten per cent there."""

MOMENTS = 5
"""Times at which the rig is brought into balance, at the most."""

NEAR = 1e-4
"""A gap [m] that loops close before what they measure has gone anywhere."""

STEPS_PER_PERIOD = 5
"""Steps that a period of an oscillation needs at the least."""

STEPS_PER_PROFILE = 20
"""Steps from one value of a profile to the next at the least."""


class Moment(NamedTuple):
    """The rig in balance at a time [s]: poses by body, state (size,) of settled pads, and the signals, held."""

    time: float
    pose: Course
    y: Tensor
    reference: Reference


@torch.no_grad()
def at_moments(file: RigFile, ready: BuiltRig, estimate: Estimate) -> list[Finding]:
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
    if estimate.unbalanced:
        time, why = next(iter(estimate.unbalanced.items()))
        found.append(
            Finding(
                "warning", "motion",
                f"nothing was found to be in balance at t = {time:.3g} s, so that strains and stability are not judged under "
                f"the efforts there, only where set-points put bodies: {why}; push less, or leave bodies more room",
            )
        )  # fmt: skip
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
    """Loops that are unstable or not tied to what they measure, and steps that are too long. What goes off where no loop
    reaches is no loop's fault: a disc on the top of a node rolls off it."""
    loops = file.loops()
    fastest, least = 0.0, (complex("-inf"), 0.0)
    for moment in there:
        depth = depths(rig, moment)
        if any(0 < deep < float(rig.contacts[key].law.epsilon) for key, deep in depth.items()):
            continue  # it only just touches, which it does not for long
        ties = tied(rig, [key for key, deep in depth.items() if deep > -NEAR])
        for one in loops:
            (measured, _), (pushed, _) = at(one.measured), at(one.pushes)
            if not nx.has_path(ties, measured, pushed):
                yield Finding(
                    "warning", one.field,
                    f"at t = {moment.time:.3g} s nothing that touches ties {one.measured}, which it measures, to {one.pushes}: "
                    f"what `{measured}` does by itself drives `{pushed}` away; start where they touch, or measure {one.pushes}",
                )  # fmt: skip
        found = modes(rig, moment.y, moment.reference)
        swinging = found.values[found.values.imag.abs() > found.values.real.abs()].imag.abs()
        fastest = max(fastest, float(swinging.max()) if len(swinging) else 0.0)
        reached = nx.node_connected_component(ties, found.moves.partition(".")[0])
        if float(found.values[0].real) > NEUTRAL and any(
            at(coordinate)[0] in reached for one in loops for coordinate in (one.measured, one.pushes)
        ):
            yield unstable(file, found, moment.time)
            return
        decaying = found.values[found.values.real < -NEUTRAL]
        if len(decaying) and float(decaying[0].real) > least[0].real:
            least = complex(decaying[0]), moment.time
    if loops and np.isfinite(least[0].real):
        yield Finding(
            "note", "actuators", f"stable; the mode that lasts longest is {shown(least[0])}, at t = {least[1]:.3g} s"
        )
    yield from steps(file, fastest, flight(file, rig, there[0].pose))


def depths(rig: Rig, moment: Moment) -> dict[str, float]:
    """How deep the deepest point of each contact is in the body [m]; negative where they are apart."""
    state = rig.unpack(moment.y, rig.follow(0.0, moment.reference))
    return {key: float(rig.penetration(key, state).max()) for key in rig.contacts}


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
    across = [one.field for one in file.loops() if one.measured != one.pushes]
    field = across[0] if across else "actuators"
    return Finding(
        "error", field,
        f"the rig is unstable at t = {time:.3g} s: its leading mode is {shown(mode)}, mostly of {found.moves}, and grows by "
        f"a factor of e in {1 / mode.real:.2g} s; lower the gains, raise the pads' tau or E, or measure what is pushed",
    )  # fmt: skip


def flight(file: RigFile, rig: Rig, pose: Course) -> float:
    """The largest speed over its size [1/s] with which a body that starts in the air reaches a pad."""
    most = 0.0
    for key, contact in rig.contacts.items():
        start, shape = file.bodies[contact.body].start, rig.bodies[contact.body].shape
        gap = max(0.0, -pressed(rig, key, pose)) if file.bodies[contact.body].weighted else 0.0
        assert shape is not None
        most = max(most, (start.v_x**2 + start.v_y**2 + 2 * file.gravity * gap) ** 0.5 / shape.size())
    return most


def steps(file: RigFile, fastest: float, flies: float) -> Iterator[Finding]:
    """Equal steps that are too long for the rig's modes, its motions, or a body that comes flying."""
    step = file.solver.step
    for name, motion in file.motion.items():
        if step is not None and isinstance(motion, ProfileTable) and len(motion.times) > 1:
            span = min(b - a for a, b in pairwise(motion.times))
            if step * STEPS_PER_PROFILE > span:
                yield Finding(
                    "warning", "solver.step",
                    f"steps of {step:g} s are too coarse: motion.{name} goes from value to value within {span:g} s; take "
                    f"{span / STEPS_PER_PROFILE:.2g} s or less, or leave step out and let rtol choose",
                )  # fmt: skip
    causes = {f"a mode of the rig swings with {fastest:.3g} rad/s": fastest}
    causes |= {f"motion.{k} goes up to {m.fastest():g} Hz": 2 * np.pi * m.fastest() for k, m in file.motion.items()}
    if step is not None and flies * step > PASSED:
        yield Finding(
            "warning", "solver.step",
            f"steps of {step:g} s are too coarse: a body comes flying and may be through a pad between two of them; take "
            f"{PASSED / flies:.2g} s or less, or leave step out and let rtol choose",
        )  # fmt: skip
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
