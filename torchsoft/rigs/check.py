"""Check of a rig file: rules on the file and its start, and then findings on a run of it at a loose
tolerance. Each finding has a severity, a field and a message."""

import warnings
from collections.abc import Callable, Iterator
from itertools import pairwise

import networkx as nx
import numpy as np
import torch

from torchsoft.diagnostic import SEVERITIES, Diagnostic
from torchsoft.parallel import single_threaded
from torchsoft.rigs import findings
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.built import BuiltRig
from torchsoft.rigs.fields import Refused
from torchsoft.rigs.findings import Run, overlapping, tied
from torchsoft.rigs.geometry import Scene, at
from torchsoft.rigs.motion import ProfileTable
from torchsoft.rigs.recorded import recordings
from torchsoft.rigs.schema import RigTables
from torchsoft.solve import simulate
from torchsoft.solve.kernel.arrays import PASSED
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.trajectory import Trajectory

LOOSE = 1e-3
"""Relative tolerance of the run that is judged: forces to 1 %."""

EFFORT = 20_000
"""Newton iterations after which that run is stopped."""

ROWS = 501
"""Number of outputs of that run."""

JUMP = {"m": 1e-4, "rad": 1e-2}
"""Largest initial distance between a set-point and its coordinate without a warning."""

CORNERS = 1440
"""Number of points of an outline at which its curvature is computed."""

STEPS_PER_PERIOD = 5
"""Fewest steps in a period of an oscillation."""

STEPS_PER_PROFILE = 20
"""Fewest steps between two values of a profile."""


@single_threaded()
def check(file: RigFile) -> list[Diagnostic]:
    """Findings on a rig file, errors first. Takes as long as a run at a loose tolerance, which only
    a rig without errors at its start needs."""
    try:
        ready = file.build()
    except Refused as error:
        return [Diagnostic("error", error.field, error.sentence)]
    except ValueError as error:
        field, _, sentence = str(error).partition(": ")
        return [Diagnostic("error", field, sentence)]
    found = [one for rule in RULES for one in rule(ready)]
    if not any(one.severity == "error" for one in found):
        found += trial(ready)
    return sorted(found, key=lambda one: SEVERITIES.index(one.severity))


# Rules on a file and its start


def start(ready: BuiltRig) -> Scene:
    """The rig with its bodies where they start."""
    poses = ready.rig.unpack(ready.y0).pose
    return Scene(ready.rig, {name: pose.detach().numpy() for name, pose in poses.items()})


def ties(ready: BuiltRig) -> Iterator[Diagnostic]:
    """Errors on loops that cannot move the body that they measure, and on efforts of controllers
    that move none of the measured coordinates."""
    graph = tied(ready.rig, list(ready.rig.contacts))
    loops = [(one.field, one.pushes, (one.measured,)) for one in ready.file.loops()]
    loops += [
        (f"controllers.{name}.pushes", pushed, one.measures)
        for name, one in ready.file.controllers.items()
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


def jumps(ready: BuiltRig) -> Iterator[Diagnostic]:
    """Warnings on set-points that begin away from their coordinate."""
    file, rig, poses, followed = ready.file, ready.rig, start(ready).pose, ready.rig.follow(0.0)
    values = dict(zip(rig.signals, followed.detach()[:, 0].tolist()))
    for loop in file.loops():
        body, axis = at(loop.measured)
        unit, here, setpoint = file.unit(loop.setpoint), poses[body][axis], values[loop.setpoint]
        if abs(setpoint - here) > JUMP[unit]:
            state = rig.unpack(ready.y0, followed)
            efforts = [
                abs(float(rig.actuator_effort(name, state, followed).detach()))
                for name in loop.actuators
            ]
            yield Diagnostic(
                "warning", f"motion.{loop.setpoint}",
                f"it begins at {setpoint:.6g} {unit}, but {loop.measured} at {here:.6g} {unit}: "
                f'`{loop.field}` pushes with {max(efforts):.3g} at once; begin at "start"',
            )  # fmt: skip


def carried(ready: BuiltRig) -> Iterator[Diagnostic]:
    """Errors on bodies without support against gravity."""
    scene, file = start(ready), ready.file
    pushed = {one.pushes for one in file.actuators.values()}
    pushed |= {coordinate for one in file.controllers.values() for coordinate in one.pushes}
    touching = {contact.body for contact in file.contacts.values()}
    for name in ready.rig.weighted:
        if file.gravity == 0 or f"{name}.y" in pushed or scene.carried(name):
            continue
        reason = (
            "no pad that it has a contact with lies under it"
            if name in touching
            else "it has no contact with any pad"
        )
        yield Diagnostic(
            "error", f"bodies.{name}",
            f"nothing carries it: {reason}, no actuator pushes {name}.y, and gravity pulls; it "
            "would fall out of the picture. Put a pad with a contact under it, fix y, or set "
            "weighted = false",
        )  # fmt: skip


def overlaps(ready: BuiltRig) -> Iterator[Diagnostic]:
    """Errors on things that overlap at the start without a contact between them."""
    return overlapping(start(ready), 0.0, set())


def corners(ready: BuiltRig) -> Iterator[Diagnostic]:
    """Warnings on corners sharper than the spacing of contact points."""
    for name, contact in ready.rig.contacts.items():
        shape = ready.rig.shape_of(name)
        spacing = float(ready.rig.pads[contact.pad].point_lengths.max())
        sharpest = 1 / float(shape.curvature(shape.outline(CORNERS)).max())
        if sharpest < spacing:
            yield Diagnostic(
                "warning", f"bodies.{contact.body}.shape",
                f"its sharpest corner has a radius of {1e3 * sharpest:.3g} mm, but the contact "
                f"points of `{contact.pad}` are up to {1e3 * spacing:.3g} mm apart: forces jump as "
                f"it goes from one to the next; round it more, or give pads.{contact.pad} more "
                "elements or points",
            )  # fmt: skip


RULES: tuple[Callable[[BuiltRig], Iterator[Diagnostic]], ...] = (
    ties, recordings, jumps, carried, overlaps, corners,
)  # fmt: skip
"""All rules that need no run, in order; a new one is added here."""


# Findings on a run


JUDGES: tuple[Callable[[Run], Iterator[Diagnostic]], ...] = (
    findings.overlaps, findings.strains, findings.touches, findings.springs, findings.slips,
    findings.untied,
)  # fmt: skip
"""All judgements of a run without its modes, in order; a new one is added here."""


def trial(ready: BuiltRig) -> list[Diagnostic]:
    """Findings on a run of a rig at a loose tolerance."""
    file, found = ready.file, list[Diagnostic]()
    t = torch.linspace(0.0, float(ready.t[-1]), ROWS, dtype=torch.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the run of the user repeats them
        try:
            tolerance = file.solver.tolerance
            task = simulate.prepare(ready.rig, t, y0=ready.y0, rtol=LOOSE, tolerance=tolerance)
            done = simulate.run(task, 0.0, explained=False, effort=EFFORT)
            trajectory = Trajectory.of(done, done.rows)
        except SimulationFailed as failure:
            found, trajectory = [findings.end(file, failure)], failure.trajectory
        except ValueError as error:
            return [Diagnostic("error", "solver", str(error))]
    if trajectory is None:
        return found
    run = Run(ready, trajectory)
    if not found and not run.complete:
        found = [findings.stopped(run)]
    found += [one for judge in JUDGES for one in judge(run)]
    if file.loops() or file.solver.step is not None:
        finding, fastest = findings.stability(run)
        found += [finding] if finding else []
        found += steps(file, fastest, findings.landing(run))
    return found


def steps(file: RigTables, fastest: float, landing: float) -> Iterator[Diagnostic]:
    """Warnings on equal steps that are too long for the rig's motions, for its `fastest` mode
    [rad/s], or for the `landing` of a body, its speed over its size [1/s]."""
    step, limits = file.solver.step, list[tuple[float, str]]()
    if step is None:
        return
    swings = {f"a mode of the rig swings with {fastest:.3g} rad/s": fastest}
    for name, motion in file.motion.items():
        swings[f"motion.{name} goes up to {motion.fastest():g} Hz"] = 2 * np.pi * motion.fastest()
        if isinstance(motion, ProfileTable) and len(motion.times) > 1:
            span = min(after - before for before, after in pairwise(motion.times))
            cause = f"motion.{name} goes from value to value within {span:g} s"
            limits.append((span / STEPS_PER_PROFILE, cause))
    if landing > 0:
        cause = "a body comes flying and may be through a pad between two of them"
        limits.append((PASSED / landing, cause))
    for cause, rate in swings.items():
        if rate > 0:
            needs = f"{cause}, and a period takes {STEPS_PER_PERIOD} steps"
            limits.append((2 * np.pi / rate / STEPS_PER_PERIOD, needs))
    for most, cause in limits:
        if step > most:
            yield Diagnostic(
                "warning", "solver.step",
                f"steps of {step:g} s are too coarse: {cause}; take {most:.2g} s or less, or leave "
                "step out and let rtol choose",
            )  # fmt: skip
