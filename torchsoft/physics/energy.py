"""Energies of a rig: those stored in its C and I fields, element by element, at given states.

Dissipated and supplied energies are integrated beside the state by the stepper, from the same laws;
`powers` reads them off the ports of the multibond graph, so that the balance at one instant can be
checked without any stepper.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial

import torch
from torch import Tensor

from torchsoft.physics.contact import (
    PointLaw,
    interface_law,
    moving_frame,
    point_place,
)
from torchsoft.physics.graph import Evaluation, Graph
from torchsoft.physics.pads import free_rates, nodal
from torchsoft.physics.state import State

Store = Callable[["AtState"], Tensor]
"""Function of a rig's state to an energy (...) [J]."""


class AtState:
    """A rig in some states (...), with the displacements of its pads, where they are known already,
    and the energies [J] of its contacts' springs, normal and tangential."""

    def __init__(self, rig: Graph, state: State, displacement: Mapping[str, Tensor]) -> None:
        self.rig, self.state, self.displacement = rig, state, displacement

    @cached_property
    def springs(self) -> tuple[Tensor, Tensor]:
        rig, zero = self.rig, torch.zeros_like(next(iter(self.state.pose.values()))[..., 0])
        normal, tangential = zero, zero
        for name, contact in rig.contacts.items():
            depth = rig.penetration(name, self.state, self.displacement.get(contact.pad))
            parts = contact.law.stored(depth, self.state.stretch[name], rig.weight(name))
            normal, tangential = normal + parts[0].sum(-1), tangential + parts[1].sum(-1)
        return normal, tangential


def stores(rig: Graph) -> dict[str, Store]:
    """Energies that are stored, by name: strain of every pad, contact springs, kinetic energies of
    bodies and pads that move freely."""

    def strain(at: AtState, name: str) -> Tensor:
        known = at.displacement.get(name)
        return at.rig.pads[name].strain_energy(at.state.pads[name], known)

    def kinetic(at: AtState, name: str, axes: Sequence[int]) -> Tensor:
        masses, velocity = at.rig.bodies[name].masses, at.state.velocity[name]
        return sum((0.5 * masses[i] * velocity[..., i] ** 2 for i in axes), velocity.new_zeros(()))

    def inertial(at: AtState, name: str) -> Tensor:
        masses, rates = at.rig.pads[name].masses(), at.state.rates[name]
        return 0.5 * (masses[:, None] * rates**2).sum((-2, -1))

    out: dict[str, Store] = {f"strain_{name}": partial(strain, name=name) for name in rig.pads}
    out["normal_springs"] = lambda at: at.springs[0]
    out["tangential_springs"] = lambda at: at.springs[1]
    for name, axes in rig.layout.free.items():
        for key, own in ((name, [i for i in axes if i < 2]), (f"{name}_spin", [2] * (2 in axes))):
            if own:
                out[key] = partial(kinetic, name=name, axes=own)
    for name, pad in rig.pads.items():
        if pad.inertial:
            out[f"kinetic_{name}"] = partial(inertial, name=name)
    return out


def stored(
    rig: Graph, state: State, displacement: Mapping[str, Tensor] | None = None
) -> dict[str, Tensor]:
    """Stored energies (...) [J]; `displacement` are those of the pads, where they are known
    already."""
    at = AtState(rig, state, displacement or {})
    return {name: energy(at) for name, energy in stores(rig).items()}


class Integrals:
    """Names of the running integrals [J]: energies dissipated and supplied by element, those
    supplied that there are in the rig, and the positive part of the sources' work."""

    def __init__(self, rig: Graph) -> None:
        self.dissipated = (*(f"pad_{name}" for name in rig.pads), "contact_dashpots", "slip")
        drives = {f"drive_{k}": "driven" in body.freedom.values() for k, body in rig.bodies.items()}
        self.supplied = (*(f"control_{name}" for name in rig.actuators), "gravity", *drives)
        self.names = (*self.dissipated, *self.supplied, "injected")
        self.active = tuple(name for name in self.supplied if drives.get(name, True))


def dissipated(rig: Graph, state: State, graph: Evaluation) -> dict[str, Tensor]:
    """Powers [W] that the R elements take out, each shaped like the batch and never negative."""
    powers, dashpots, slip = {}, 0.0, 0.0
    for name, pad in rig.pads.items():
        port = graph.ports[f"pad_{name}"]
        rates = graph.pad_rates(name) if pad.nodal else port.effort
        powers[f"pad_{name}"] = pad.dissipation(state.pads[name], rates)
    for interface in graph.interfaces.values():
        dashpots, slip = (
            dashpots + interface.law.dashpots.sum(-1),
            slip + interface.law.slip.sum(-1),
        )
    return powers | {"contact_dashpots": torch.as_tensor(dashpots), "slip": torch.as_tensor(slip)}


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
        own = rig.contacts_of(name)
        touched = {key: force[key][..., 0].flatten(0, -2).any(0).nonzero()[:, 0] for key in own}
        u = rig.displacement(name, state)
        rate = rates[name][..., :2] if pad.nodal else _rates(rig, name, touched, state, u, force)
        for key, which in touched.items():
            law, shape = rig.contacts[key].law, rig.shape_of(key)
            spread = pad.spread[which]
            x = rig.point_inputs(key, state, spread @ u, spread @ rate, which)
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
        spread = pad.spread[which]
        at = spread @ u
        x = rig.point_inputs(key, state, at, torch.zeros_like(at), which)
        frame = moving_frame(rig.shape_of(key), *point_place(x))
        F_N, F_T = force[key][..., which, :].split(1, -1)
        f = f + spread.mT @ (F_N * frame.n + F_T * frame.t)
    free, P = free_rates(pad, state.pads[name], 0.0)
    return free + nodal(P, f)
