"""Findings on a run of a rig file: its early end, strains of pads, contacts, friction, overlaps,
and loops."""

from collections.abc import Iterator
from typing import NamedTuple

import networkx as nx
import numpy as np
import torch
from torch import Tensor

from torchsoft.diagnostic import Diagnostic
from torchsoft.physics.graph import Graph
from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.motion import hold
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import State
from torchsoft.physics.statics import NoEquilibrium, standing, with_condensed_pads
from torchsoft.rigs.built import BuiltRig
from torchsoft.rigs.geometry import Scene, at
from torchsoft.rigs.schema import RigTables
from torchsoft.solve.diagnostics import COMPRESSED, NEUTRAL, SMALL_STRAIN, UNSTABLE, modes, strained
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import Interrupted
from torchsoft.solve.trajectory import Trajectory

LINEAR = 0.25
"""Largest displacement of a pad's nodes over its height without a warning (assumed): strains under
a contact are of that order, and there the stress of rubber deviates from linear elasticity by some
ten per cent."""

SOFTENED = 0.05
"""Part of the give that the springs of a law may take without a note."""

TOUCH = 1e-6
"""Depth [m] up to which touching things do not count as overlapping."""

SAMPLES = 61
"""Most outputs of a run that are searched for overlaps and soft springs."""

NEAR = 1e-4
"""Gap [m] below which a body is about to touch a pad."""


class Run(NamedTuple):
    """A run of a rig, complete or up to its early end, and the cause of that end if there is one
    besides its effort."""

    ready: BuiltRig
    trajectory: Trajectory
    stopped: SimulationFailed | Interrupted | None = None

    @property
    def file(self) -> RigTables:
        return self.ready.file

    @property
    def rig(self) -> Rig:
        return self.ready.rig

    @property
    def complete(self) -> bool:
        """Whether it went on until the end of the motion."""
        return float(self.trajectory.t[-1]) == float(self.ready.t[-1])

    @property
    def samples(self) -> list[int]:
        """Some outputs, the first and the last included."""
        rows = np.linspace(0, len(self.trajectory.t) - 1, SAMPLES).astype(int)
        return np.unique(rows).tolist()

    def time(self, row: int) -> float:
        """Time [s] of an output."""
        return float(self.trajectory.t[row])

    def scene(self, row: int) -> Scene:
        """The rig with its bodies where they are at an output."""
        poses = self.trajectory.state.pose
        return Scene(self.rig, {name: pose[row].detach().numpy() for name, pose in poses.items()})

    def state(self, row: int | list[int]) -> State:
        """State at an output, or at several."""
        parts = self.trajectory.state
        return State(*({name: x[row].detach() for name, x in part.items()} for part in parts))

    def normal(self, contact: str) -> Tensor:
        """Normal forces (T, points) [N] of a contact."""
        return self.trajectory.force[contact][..., 0].detach()

    def loaded(self) -> int:
        """Output at which the contacts carry most."""
        loads = [self.normal(name).sum(-1) for name in self.rig.contacts]
        return int(torch.stack(loads).sum(0).argmax())


def end(file: RigTables, failure: SimulationFailed) -> Diagnostic:
    """The end of a run that stops early: an error where it is certain, a warning where a body that
    moves freely leaves its pad, or where another tolerance may help."""
    if not failure.contact:
        severity = "error" if failure.time == 0 else "warning"
        return Diagnostic(severity, "solver", f"a run at a loose tolerance ends early: {failure}")
    body = file.contacts[failure.contact].body
    measured = {loop.measured for loop in file.loops()}
    free = {f"{body}.{axis}" for axis in file.bodies[body].free}
    may_be_meant = failure.left and failure.time > 0 and not free <= measured
    return Diagnostic(
        "warning" if may_be_meant else "error", f"bodies.{body}", f"the run ends early: {failure}"
    )


def stopped(run: Run) -> Diagnostic:
    """The end of a run that takes too many iterations to be judged as a whole: a warning where
    Newton's method fails in most steps."""
    stats, until = run.trajectory.stats, run.time(-1)
    if 2 * stats.failed_steps > stats.steps:
        return Diagnostic(
            "warning", "solver",
            f"Newton's method fails in most steps near t = {until:.3g} s, so that a run takes very "
            "long; take softer springs and dashpots, a larger v_s of the friction law, or a finer "
            "pad; what happens later is not checked",
        )  # fmt: skip
    return Diagnostic(
        "note", "solver", f"the run is long: what happens after t = {until:.3g} s is not checked"
    )


def strains(run: Run) -> Iterator[Diagnostic]:
    """Findings on linear pads that are strained beyond linear elasticity, and notes on strains that
    are not small."""
    for name, u in run.trajectory.displacement.items():
        pad = run.rig.pads[name]
        if isinstance(pad.material, Hyperelastic):
            continue
        give = u.detach().norm(dim=-1)
        row, node = divmod(int(give.argmax()), give.shape[1])
        part = float(give[row, node]) / pad.mesh.height
        if part > LINEAR:
            along, across = (u[row, node].detach() @ pad.axes).abs().tolist()
            if along > across:
                how, severity = "friction shears it by", "warning"
            else:
                how = "it is compressed by"
                severity = "error" if across > COMPRESSED * pad.mesh.height else "warning"
            yield Diagnostic(
                severity, f"pads.{name}",
                f"the strain leaves linear elasticity: at t = {run.time(row):.3g} s {how} "
                f"{part:.0%} of its height, and forces are wrong above {LINEAR:.0%}; press "
                "or move less, take less friction, or a thicker or stiffer pad",
            )  # fmt: skip
        elif (strain := float(pad.largest_strain(u[row].detach().numpy()))) > SMALL_STRAIN:
            yield Diagnostic("note", f"pads.{name}", strained(strain, run.time(row)))


def touches(run: Run) -> Iterator[Diagnostic]:
    """Warnings on contacts that never touch in a complete run, and notes on those that let go."""
    for name, contact in run.rig.contacts.items():
        rows = run.normal(name).sum(-1).nonzero()[:, 0]
        if not len(rows) and run.complete:
            yield Diagnostic(
                "warning", f"contacts.{name}",
                f"`{contact.pad}` never touches `{contact.body}` in the run; bring it nearer, run "
                "longer, or leave the contact out",
            )  # fmt: skip
        elif len(rows) and int(rows[-1]) < len(run.trajectory.t) - 1:
            last = run.time(int(rows[-1]))
            yield Diagnostic(
                "note", f"contacts.{name}",
                f"`{contact.pad}` lets go of `{contact.body}`: they touch last at t = {last:.3g} s",
            )  # fmt: skip


def springs(run: Run) -> Iterator[Diagnostic]:
    """Notes on contacts whose springs take a good part of the give under load."""
    for name, contact in run.rig.contacts.items():
        pad, force = run.rig.pads[contact.pad], run.normal(name)[run.samples]
        u = run.trajectory.displacement[contact.pad][run.samples].detach()
        depth = run.rig.penetration(name, run.state(run.samples), u).detach().clamp(min=0.0)
        in_springs = (force * depth).sum(-1)
        whole = in_springs + (force * pad.at_points(u).norm(dim=-1)).sum(-1)
        row = int(whole.argmax())
        if in_springs[row] > SOFTENED * whole[row]:
            yield Diagnostic(
                "note", f"contacts.{name}",
                f"the contact springs account for {100 * float(in_springs[row] / whole[row]):.0f} "
                "% of the deflection under load, so that contact is softer than the pad; raise "
                'K_n, or set K_n = "auto"',
            )  # fmt: skip


def slips(run: Run) -> Iterator[Diagnostic]:
    """Warnings on friction whose decrease with slip makes the slip rate ambiguous."""
    for name, contact in run.rig.contacts.items():
        most = float((run.normal(name) / run.rig.weight(name)).max())
        if most > 0 and (reason := contact.law.jumps(most)):
            yield Diagnostic("warning", f"laws.{run.file.contacts[name].law}.friction", reason)


def overlaps(run: Run) -> Iterator[Diagnostic]:
    """Errors on overlapping things without a contact between them."""
    reported = set[tuple[str, str]]()
    for row in run.samples:
        yield from overlapping(run.scene(row), run.time(row), reported)


def overlapping(scene: Scene, time: float, reported: set[tuple[str, str]]) -> Iterator[Diagnostic]:
    """Errors on overlaps at a time [s], without and then with those that are reported already."""
    for (one, other), depth in scene.overlaps().items():
        if depth > TOUCH and (one, other) not in reported:
            reported.add((one, other))
            yield Diagnostic(
                "error", one,
                f"it and {other} overlap by {1e3 * depth:.3g} mm at t = {time:.3g} s, and no "
                "contact is between them: they would pass through each other; move one of them, or "
                "let a pad be between",
            )  # fmt: skip


# Loops


def tied(rig: Graph, contacts: list[str]) -> nx.Graph:
    """Graph of the bodies, with an edge where one of the contacts is between a body and a pad on
    another body. The ground connects nothing."""
    graph = nx.Graph()
    graph.add_nodes_from(rig.bodies)
    pairs = ((rig.pads[rig.contacts[key].pad].base, rig.contacts[key].body) for key in contacts)
    graph.add_edges_from((base, body) for base, body in pairs if base is not None)
    return graph


def untied(run: Run) -> Iterator[Diagnostic]:
    """Warnings on loops that are not closed through contacts at the start, where none of these is
    about to touch, or where the contacts carry most."""
    reported, loops = set[str](), run.file.loops()
    for row in (0, run.loaded()) if loops else ():
        state, rig = run.state(row), run.rig
        gaps = {name: -float(rig.penetration(name, state).detach().max()) for name in rig.contacts}
        if any(0 < gap < NEAR for gap in gaps.values()):
            continue
        graph = tied(rig, [name for name, gap in gaps.items() if gap < 0])
        for loop in loops:
            (measured, _), (pushed, _) = at(loop.measured), at(loop.pushes)
            if loop.field not in reported and not nx.has_path(graph, measured, pushed):
                reported.add(loop.field)
                yield Diagnostic(
                    "warning", loop.field,
                    f"at t = {run.time(row):.3g} s nothing that touches ties {loop.measured}, "
                    f"which it measures, to {loop.pushes}: what `{measured}` does by itself drives "
                    f"`{pushed}` away; start where they touch, or measure {loop.pushes}",
                )  # fmt: skip


@torch.no_grad()
def stability(run: Run) -> tuple[Diagnostic | None, float]:
    """A finding on the modes where the contacts carry most, by the growth of one that a loop
    reaches: a disc on the top of a node rolls off it in any case. And the fastest swing [rad/s]."""
    row, rig, loops = run.loaded(), with_condensed_pads(run.rig), run.file.loops()
    poses = {name: pose[row].detach() for name, pose in run.trajectory.state.pose.items()}
    still = hold(**{name: float(run.trajectory[name][row]) for name in rig.signals})
    try:
        values, moves = modes(rig, standing(rig, poses), still)
    except NoEquilibrium as error:
        message = f"stability is not judged: {error}"
        return Diagnostic("warning", "actuators", message) if loops else None, 0.0
    if not len(values):
        return None, 0.0
    swings = values[values.imag.abs() > values.real.abs()].imag.abs()
    fastest = float(swings.max()) if len(swings) else 0.0
    touching = [name for name in rig.contacts if run.normal(name)[row].sum() > 0]
    reached = nx.node_connected_component(tied(rig, touching), moves.partition(".")[0])
    judged = [one for one in loops if {at(one.measured)[0], at(one.pushes)[0]} & reached]
    leading, time = complex(values[0]), run.time(row)
    decaying = values[values.real < -NEUTRAL]
    finding = None
    if judged and leading.real > NEUTRAL:
        field = next((one.field for one in loops if one.measured != one.pushes), "actuators")
        message = (
            f"the rig is unstable at t = {time:.3g} s: its leading mode is {shown(leading)}, "
            f"mostly of {moves}, and grows by a factor of e in {1 / leading.real:.2g} s; {UNSTABLE}"
        )
        finding = Diagnostic("error", field, message)
    elif loops and len(decaying):
        slowest = shown(complex(decaying[0]))
        message = f"stable; the mode that lasts longest is {slowest}, at t = {time:.3g} s"
        finding = Diagnostic("note", "actuators", message)
    return finding, fastest


def shown(mode: complex) -> str:
    """A mode as messages show it."""
    swing = f" +- {abs(mode.imag):.3g}j" if mode.imag else ""
    return f"{mode.real:+.3g}{swing} 1/s"


def landing(run: Run) -> float:
    """Largest speed over size [1/s] of a body when it meets a pad, 0 where none does."""
    most = 0.0
    for name, contact in run.rig.contacts.items():
        touching = run.normal(name).sum(-1) > 0
        meets = (~touching[:-1] & touching[1:]).nonzero()[:, 0]
        speed = run.trajectory.state.velocity[contact.body].detach()[meets, :2].norm(dim=-1)
        most = max(most, float(speed.max()) / run.rig.shape_of(name).size()) if len(meets) else most
    return most
