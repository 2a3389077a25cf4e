"""Penetration and slip speed of contact points, of which no channel is made."""

import torch
from torch import Tensor

from torchsoft import Rig


@torch.no_grad()
def at_the_points(rig: Rig, t: Tensor, y: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
    """By contact the penetration [m] and the slip speed [m/s] of its points, each (T, points), in
    the states y (T, size)."""
    state, out = rig.unpack(y, rig.follow(t)), {}
    for name, interface in rig.evaluate(t, state).interfaces.items():
        depth = interface.frame.g
        at = rig.contacts[name].law(
            depth, *interface.flow.unbind(-1), state.stretch[name], rig.weight(name),
            z=state.friction[name].mT if name in state.friction else None,
        )  # fmt: skip
        out[name] = depth, at.gamma_dot.abs()
    return out
