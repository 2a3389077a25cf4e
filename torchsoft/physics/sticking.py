"""Which contact points are separated, stick or slip, in recorded states under recorded forces."""

from collections.abc import Mapping

import torch
from torch import Tensor

from torchsoft.physics.condensed import free_rates, nodal
from torchsoft.physics.contact import cross, interface_law, moving_frame, turned
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import State

SEPARATED, STICKING, SLIPPING = 0, 1, 2
"""States of a contact point."""


@torch.no_grad()
def contact_states(rig: Rig, state: State, force: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """State of every point by contact, int8 (..., points); `force` as a run records it (...,
    points, 2) [N].

    The recorded forces say how fast massless pads give way, so that nothing is solved for. A point
    without normal force is separated; one whose slip dissipates power slips.
    """
    out = {}
    for name, pad in rig.pads.items():
        own = rig.contacts_of(name)
        touched = {key: force[key][..., 0].flatten(0, -2).any(0).nonzero()[:, 0] for key in own}
        u = rig.displacement(name, state)
        rate = _rates(rig, name, touched, state, u, force)
        for key, which in touched.items():
            law, shape = rig.contacts[key].law, rig.shape_of(key)
            spread = pad.spread[which]
            x = rig.point_inputs(key, state, spread @ u, spread @ rate, which)
            slips = torch.zeros(force[key].shape[:-1], dtype=torch.int8)
            slips[..., which] = (interface_law(law, shape, x)[..., 6] > 0).to(torch.int8)
            out[key] = (force[key][..., 0] > 0).to(torch.int8) * (STICKING + slips)
    return out


def _rates(
    rig: Rig, name: str, touched: Mapping[str, Tensor], state: State, u: Tensor,
    force: Mapping[str, Tensor],
) -> Tensor:  # fmt: skip
    """Rates (..., nodes, 2) [m/s] of the displacements u of a pad's nodes, in its base's frame."""
    pad = rig.pads[name]
    if pad.inertial:
        pose, velocity = rig.base_motion(name, state)
        angle = pose[..., 2, None]
        arm = turned(pad.positions + u, angle)
        carried = velocity[..., None, :2] + velocity[..., None, 2:] * cross(arm)
        return turned(state.rates[name] - carried, -angle)
    f = torch.zeros_like(u)
    for key, which in touched.items():
        spread = pad.spread[which]
        at = spread @ u
        x = rig.point_inputs(key, state, at, torch.zeros_like(at), which)
        frame = moving_frame(rig.shape_of(key), x[..., 3:5], x[..., 5])
        F_N, F_T = force[key][..., which, :].split(1, -1)
        f = f + spread.mT @ (F_N * frame.n + F_T * frame.t)
    free, P = free_rates(pad, state.pads[name], 0.0)
    return free + nodal(P, f)
