"""Energies of a rig: what its C and I fields store, R elements dissipate and sources supply, each
declared once, with its name.

Stored energies are functions of a state. The others are integrated beside it by the stepper, from
the same laws; `dissipated` and `supplied` read the powers off the ports of the multibond graph, so
that the balance at one instant can be checked without any stepper.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchsoft.physics.contact import (
    PointLaw,
    interface_law,
    moving_frame,
    point_place,
)
from torchsoft.physics.graph import Evaluation, Graph
from torchsoft.physics.pads import free_rates, under_forces
from torchsoft.physics.state import State

Displacements = Mapping[str, Tensor]
"""Displacements of pads (..., nodes, 2) [m], where they are known already."""

Store = Callable[[Graph, State, Displacements], Tensor]
"""Function of a rig's state to an energy (...) [J]."""


def strain_energy(rig: Graph, state: State, known: Displacements, pad: str) -> Tensor:
    return rig.pads[pad].strain_energy(state.pads[pad], known.get(pad))


def spring_energy(rig: Graph, state: State, known: Displacements, kind: int) -> Tensor:
    """Energy of the normal springs of all contacts, kind 0, or of the tangential ones, 1."""
    total = torch.zeros_like(next(iter(state.pose.values()))[..., 0])
    for name, contact in rig.contacts.items():
        depth = rig.penetration(name, state, known.get(contact.pad))
        energies = contact.law.stored(depth, state.stretch[name], rig.weight(name))
        total = total + energies[kind].sum(-1)
    return total


def kinetic_energy(
    rig: Graph, state: State, known: Displacements, body: str, axes: Sequence[int]
) -> Tensor:
    masses, velocity = rig.bodies[body].masses, state.velocity[body]
    return sum((0.5 * masses[i] * velocity[..., i] ** 2 for i in axes), velocity.new_zeros(()))


def inertial_energy(rig: Graph, state: State, known: Displacements, pad: str) -> Tensor:
    return 0.5 * (rig.pads[pad].masses()[:, None] * state.rates[pad] ** 2).sum((-2, -1))


def stores(rig: Graph) -> dict[str, Store]:
    """Energies that are stored, by name: strain of every pad, contact springs, kinetic energies of
    bodies and pads that move freely."""
    out: dict[str, Store] = {
        f"strain_{name}": partial(strain_energy, pad=name) for name in rig.pads
    }
    out["normal_springs"] = partial(spring_energy, kind=0)
    out["tangential_springs"] = partial(spring_energy, kind=1)
    for name, axes in rig.layout.free.items():
        for key, which in ((name, [i for i in axes if i < 2]), (f"{name}_spin", [2] * (2 in axes))):
            if which:
                out[key] = partial(kinetic_energy, body=name, axes=which)
    for name, pad in rig.pads.items():
        if pad.inertial:
            out[f"kinetic_{name}"] = partial(inertial_energy, pad=name)
    return out


def stored(rig: Graph, state: State, known: Displacements | None = None) -> dict[str, Tensor]:
    """Stored energies (...) [J]."""
    return {name: energy(rig, state, known or {}) for name, energy in stores(rig).items()}


class Integral(NamedTuple):
    """An energy [J] that the kernels integrate: "dissipated" or "supplied", its name, its number
    among theirs, and the factor by which theirs counts."""

    kind: Literal["dissipated", "supplied"]
    name: str
    number: int
    factor: float = 1.0


def integrals(rig: Graph) -> list[Integral]:
    """The energies that are dissipated and supplied, in the kernels' order: by pads, by dashpots
    and slip of all contacts, by actuators, by gravity and by the drives of all bodies; last comes
    the positive part of the sources' work. The kernels count what an actuator supplies."""
    names = [*(f"pad_{name}" for name in rig.pads), "contact_dashpots", "slip"]
    out = [Integral("dissipated", name, i) for i, name in enumerate(names)]
    for name, actuator in rig.actuators.items():
        kind, factor = ("dissipated", -1.0) if actuator.resists else ("supplied", 1.0)
        out.append(Integral(kind, f"control_{name}", len(out), factor))
    out.append(Integral("supplied", "gravity", len(out)))
    for i, (name, body) in enumerate(rig.bodies.items(), out[-1].number + 1):
        if "driven" in body.freedom.values():
            out.append(Integral("supplied", f"drive_{name}", i))
    return sorted(out, key=lambda one: one.kind)


def names_of(rig: Graph, kind: Literal["dissipated", "supplied"]) -> tuple[str, ...]:
    """Names of the energies of one kind."""
    return tuple(one.name for one in integrals(rig) if one.kind == kind)


def dissipated(rig: Graph, state: State, graph: Evaluation) -> dict[str, Tensor]:
    """Powers [W] that the R elements take out, each shaped like the batch and never negative."""
    powers, dashpots, slip = dict[str, Tensor](), 0.0, 0.0
    for name, pad in rig.pads.items():
        port = graph.ports[f"pad_{name}"]
        rates = graph.pad_rates(name) if pad.nodal else port.effort
        powers[f"pad_{name}"] = pad.dissipation(state.pads[name], rates)
    for interface in graph.interfaces.values():
        dashpots, slip = (
            dashpots + interface.law.dashpots.sum(-1),
            slip + interface.law.slip.sum(-1),
        )
    powers |= {"contact_dashpots": torch.as_tensor(dashpots), "slip": torch.as_tensor(slip)}
    resisting = (f"control_{name}" for name, one in rig.actuators.items() if one.resists)
    return powers | {name: graph.ports[name].power(graph.flows) for name in resisting}


def supplied(graph: Evaluation) -> dict[str, Tensor]:
    """Powers [W] that the sources put in, by their port, each shaped like the batch."""
    return {name: port.power(graph.flows) for name, port in graph.ports.items() if port.source}


# Which contact points are separated, stick or slip, in recorded states under recorded forces.


SEPARATED, STICKING, SLIPPING = 0, 1, 2
"""States of a contact point."""


@torch.no_grad()
def contact_states(
    rig: Graph, state: State, force: Mapping[str, Tensor], rates: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """State of every point by contact, int8 (..., points); `force` (..., points, 2) [N] and the
    `rates` of nodal pads (..., nodes, 2 fields) [m/s] as a run records them.

    The recorded forces say how fast condensed pads give way, so that nothing is solved for. A point
    without normal force is separated; one whose slip dissipates power slips.
    """
    out = {}
    for name, pad in rig.pads.items():
        keys = rig.contacts_of(name)
        touched = {key: force[key][..., 0].flatten(0, -2).any(0).nonzero()[:, 0] for key in keys}
        u = rig.displacement(name, state)
        rate = rates[name][..., :2] if pad.nodal else _rates(rig, name, touched, state, u, force)
        for key, which in touched.items():
            law, shape = rig.contacts[key].law, rig.shape_of(key)
            shares = pad.interpolation[which]
            x = rig.point_inputs(key, state, shares @ u, shares @ rate, which)
            slips = torch.zeros(force[key].shape[:-1], dtype=torch.int8)
            slips[..., which] = (PointLaw.of(interface_law(law, shape, x)).slip > 0).to(torch.int8)
            out[key] = (force[key][..., 0] > 0).to(torch.int8) * (STICKING + slips)
    return out


def _rates(
    rig: Graph, name: str, touched: Mapping[str, Tensor], state: State, u: Tensor,
    force: Mapping[str, Tensor],
) -> Tensor:  # fmt: skip
    """Rates (..., nodes, 2) [m/s] of the displacements u of a condensed pad's nodes."""
    pad = rig.pads[name]
    f = torch.zeros_like(u)
    for key, which in touched.items():
        shares = pad.interpolation[which]
        at = shares @ u
        x = rig.point_inputs(key, state, at, torch.zeros_like(at), which)
        frame = moving_frame(rig.shape_of(key), *point_place(x))
        F_N, F_T = force[key][..., which, :].split(1, -1)
        f = f + shares.mT @ (F_N * frame.n + F_T * frame.t)
    free, P = free_rates(pad, state.pads[name], 0.0)
    return free + under_forces(P, f)
