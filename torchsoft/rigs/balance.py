"""Checks of a rig in static equilibrium at some moments of its motions: room, strains, modes and
steps, friction."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import networkx as nx
import numpy as np
import torch
from torch import Tensor

from torchsoft.diagnostic import Diagnostic
from torchsoft.physics.motion import Reference, hold
from torchsoft.physics.state import State
from torchsoft.physics.statics import NoEquilibrium, massless, standing
from torchsoft.rigs.course import Estimate, signals
from torchsoft.rigs.geometry import Scene, at, tied
from torchsoft.rigs.motion import ProfileTable
from torchsoft.solve.kernel.arrays import PASSED
from torchsoft.solve.ledger import COMPRESSED
from torchsoft.solve.stability import NEUTRAL, modes

LINEAR = 0.25
"""Largest indentation over a pad's height without a warning (assumed): strains under a contact are
of that order, and there the stress of rubber deviates from linear elasticity by some ten per
cent."""

MOMENTS = 5
"""Most times at which the rig is brought into equilibrium."""

NEAR = 1e-4
"""Gap [m] below which a body counts as touching a pad."""

STEPS_PER_PERIOD = 5
"""Fewest steps in a period of an oscillation."""

STEPS_PER_PROFILE = 20
"""Fewest steps between two values of a profile."""


class Moment(NamedTuple):
    """The rig with massless pads in equilibrium at a time [s]: the scene, the state (size,) with
    settled pads and its parts, and the signals as constants."""

    time: float
    scene: Scene
    y: Tensor
    state: State
    reference: Reference


@torch.no_grad()
def at_moments(e: Estimate) -> list[Diagnostic]:
    """Findings on the rig in equilibrium at some knots of its motions: room, strains, modes, steps,
    friction."""
    rig, found, there = massless(e.rig), list[Diagnostic](), list[Moment]()
    for time in e.moments(MOMENTS):
        scene = Scene(rig, e.balanced(time))
        found += [
            one for one in fits(time, scene) if one.where not in {other.where for other in found}
        ]
        if found:
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
    for time, why in list(e.unbalanced.items())[:1]:
        found.append(
            Diagnostic(
                "warning", "motion",
                f"nothing was found to be in balance at t = {time:.3g} s, so that strains and "
                "stability are not judged under the efforts there, only where set-points put "
                f"bodies: {why}; push less, or leave bodies more room",
            )
        )  # fmt: skip
    return [*found, *presses(there), *strains(there), *swings(e, there), *slips(e, there)]


def fits(time: float, scene: Scene) -> Iterator[Diagnostic]:
    """Errors on bodies that do not fit between their pads."""
    pairs = [pair for body in scene.rig.bodies for pair in scene.facing(body)]
    alone = [(key,) for key in scene.rig.contacts if not any(key in pair for pair in pairs)]
    for group in [*pairs, *alone]:
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


def room(scene: Scene, group: Sequence[str]) -> float:
    """Total indentation [m] of the pads of some contacts of one body; negative where they are
    apart, or the body is beyond the end of one."""
    beside = max(
        scene.surface(key).off(scene.pose[scene.rig.contacts[key].body][:2]) for key in group
    )
    return -beside if beside > 0 else sum(scene.pressed(key) for key in group)


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
        nearest = max(room(moment.scene, pair) for moment in there)
        if nearest <= 0:
            yield Diagnostic(
                "warning", f"contacts.{pair[-1]}",
                f"{named(scene, pair)} never press `{scene.rig.contacts[pair[0]].body}`: at the "
                f"motions' knots they come no nearer than {-1e3 * nearest:.3g} mm",
            )  # fmt: skip


def strains(there: list[Moment]) -> Iterator[Diagnostic]:
    """Warnings on pads that are indented beyond linear elasticity."""
    rig = there[0].scene.rig
    for name, pad in rig.pads.items():
        parts = [
            float(rig.displacement(name, m.state).norm(dim=-1).max()) / pad.mesh.height
            for m in there
        ]
        worst = int(np.argmax(parts))
        if parts[worst] > LINEAR:
            yield Diagnostic(
                "warning", f"pads.{name}",
                f"the strain leaves linear elasticity: at t = {there[worst].time:.3g} s it gives "
                f"way by {parts[worst]:.0%} of its height, and above {LINEAR:.0%} forces are off; "
                "press less, or take a thicker or stiffer pad",
            )  # fmt: skip


def swings(e: Estimate, there: list[Moment]) -> Iterator[Diagnostic]:
    """Findings on loops that are unstable or not tied to their measured coordinate, and on steps
    that are too long. Coordinates out of reach of every loop may be unstable: a disc on the top of
    a node rolls off it."""
    rig, fastest, least = there[0].scene.rig, 0.0, (complex("-inf"), 0.0)
    for moment in there:
        depth = {key: float(rig.penetration(key, moment.state).max()) for key in rig.contacts}
        if any(0 < deep < float(rig.contacts[key].law.epsilon) for key, deep in depth.items()):
            continue  # it only just touches, which it does not for long
        ties = tied(rig, [key for key, deep in depth.items() if deep > -NEAR])
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
                f"{1 / growing.real:.2g} s; lower the gains, raise the pads' tau or E, or measure "
                "what is pushed",
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
            why = (
                f"motion.{name} goes from value to value within {span:g} s; take "
                f"{span / STEPS_PER_PROFILE:.2g} s or less"
            )
            limits.append((span / STEPS_PER_PROFILE, why))
    if flies > 0:
        why = (
            "a body comes flying and may be through a pad between two of them; take "
            f"{PASSED / flies:.2g} s or less"
        )
        limits.append((PASSED / flies, why))
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
    for most, why in limits:
        if step > most:
            yield Diagnostic(
                "warning", "solver.step",
                f"steps of {step:g} s are too coarse: {why}, or leave step out and let rtol choose",
            )  # fmt: skip


def slips(e: Estimate, there: list[Moment]) -> Iterator[Diagnostic]:
    """Warnings on friction whose decrease with slip makes the slip rate ambiguous."""
    rig = there[0].scene.rig
    for key, contact in rig.contacts.items():
        if rig.pads[contact.pad].points:
            continue
        force = max(float(m.state.pads[contact.pad][0].norm(dim=-1).max()) for m in there)
        if why := contact.law.jumps(force / float(rig.weight(key).max())):
            yield Diagnostic(
                "warning", f"laws.{e.file.contacts[key].law}.friction", f"{why}; raise v_s or eta"
            )
