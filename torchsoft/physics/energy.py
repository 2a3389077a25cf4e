"""Energies of a rig: those stored in its C and I fields, element by element, at given states.

Dissipated and supplied energies are integrated beside the state by the stepper, from the same laws;
`powers` reads them off the ports of the multibond graph, so that the balance at one instant can be
checked without any stepper.
"""

from collections.abc import Mapping

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
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.state import State


def stored(
    rig: Graph, state: State, displacement: Mapping[str, Tensor] | None = None
) -> dict[str, Tensor]:
    """Energies [J], each shaped like the batch: strain of every pad, contact springs, kinetic
    energies of bodies and pads that move freely.

    `displacement` are those of the pads, where they are known already.
    """
    known = displacement or {}
    energies = {}
    for name, pad in rig.pads.items():
        part = state.pads[name]
        if pad.nodal:
            energies[f"strain_{name}"] = pad.strain_energy(part)
        else:
            fractions, _ = pad.chain()
            if len(fractions) == 1:
                u = known[name] if name in known else rig.displacement(name, state)
                energies[f"strain_{name}"] = 0.5 * (part[..., 0, :, :] * u).sum((-2, -1))
            else:
                z = part.flatten(-2)
                energies[f"strain_{name}"] = 0.5 * (
                    fractions * ((z @ pad.compliance()) * z).sum(-1)
                ).sum(-1)
    zero = torch.zeros_like(next(iter(state.pose.values()))[..., 0])
    normal, tangential = zero, zero
    for name, contact in rig.contacts.items():
        parts = contact.law.stored(
            rig.penetration(name, state, known.get(contact.pad)),
            state.stretch[name],
            rig.weight(name),
        )
        normal, tangential = normal + parts[0].sum(-1), tangential + parts[1].sum(-1)
    energies["normal_springs"], energies["tangential_springs"] = normal, tangential
    for name, body in rig.bodies.items():
        free = [float(body.freedom[axis] == "free") for axis in COORDINATES]
        kinetic = [
            0.5 * f * m * state.velocity[name][..., i] ** 2
            for i, (f, m) in enumerate(zip(free, body.masses))
        ]
        if any(free[:2]):
            energies[name] = kinetic[0] + kinetic[1]
        if free[2]:
            energies[f"{name}_spin"] = kinetic[2]
    for name, pad in rig.pads.items():
        if pad.inertial:
            energies[f"kinetic_{name}"] = 0.5 * (
                pad.masses()[:, None] * state.rates[name] ** 2
            ).sum((-2, -1))
    return energies


def stores(rig: Graph) -> tuple[str, ...]:
    """Names of the energies that `stored` returns, in its order."""
    names = [f"strain_{name}" for name in rig.pads] + ["normal_springs", "tangential_springs"]
    for name, axes in rig.layout.free.items():
        names += [name] * any(axis < 2 for axis in axes) + [f"{name}_spin"] * (2 in axes)
    names += [f"kinetic_{name}" for name, pad in rig.pads.items() if pad.inertial]
    return tuple(names)


def dissipated(rig: Graph, state: State, graph: Evaluation) -> dict[str, Tensor]:
    """Powers [W] that the R elements take out, each shaped like the batch and never negative."""
    powers, dashpots, slip = {}, 0.0, 0.0
    for name, pad in rig.pads.items():
        port = graph.ports[f"pad_{name}"]
        if pad.nodal:
            powers[f"pad_{name}"] = pad.dissipation(state.pads[name], graph.pad_rates(name))
        else:
            fractions, times = pad.chain()
            rate = (
                (port.effort[..., None, :, :] - state.pads[name]) / times[:, None, None]
            ).flatten(-2)
            powers[f"pad_{name}"] = (
                fractions * times * ((rate @ pad.compliance()) * rate).sum(-1)
            ).sum(-1)
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
