"""Springs and dashpots of a contact that are matched to its pads ("auto" in a rig file): functions
of the pads' present parameters."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchsoft.physics.pads import Pad

STIFFER = 10.0
"""Matched spring over the plane-strain stiffness of a pad's surface on the length of one contact
point (assumed): springs then take about one per cent of the compression of ten points."""


class Matched(nn.Module):
    """Numbers of a contact law for the pads that have it, per `node_spacing` [m].

    A spring K_n or K_t [N/m] is `STIFFER` times as stiff as the surface of the stiffest pad, a
    dashpot R_n or R_t [N.s/m] its spring times that pad's shortest retardation time, and R_pad
    [N.s/m] the least instantaneous dashpot of the pads' surfaces. Not smooth where another pad
    becomes the stiffest.
    """

    def __init__(self, pads: Sequence[Pad], node_spacing: float) -> None:
        super().__init__()
        self.pads, self.node_spacing = nn.ModuleList(pads), node_spacing

    def value(self, law: Any, name: str) -> Tensor:
        """A number () of a law."""
        pads: list[Pad] = [*self.pads]  # pyright: ignore[reportAssignmentType]
        if name == "R_pad":
            return torch.stack([surface_dashpot(pad) for pad in pads]).min() * self.node_spacing
        stiffness = torch.stack([surface_stiffness(pad) for pad in pads])
        stiffest = int(stiffness.argmax())
        if name in ("K_n", "K_t"):
            return STIFFER * stiffness[stiffest] * self.node_spacing
        spring = law.K_n if name == "R_n" else law.K_t
        return pads[stiffest].material.whole_chain()[1].min() * spring


def surface_stiffness(pad: Pad) -> Tensor:
    """Plane-strain stiffness () of a pad's surface over the length of a contact point [N/m2]."""
    material = pad.material
    return material.E / (1 - material.nu**2) * material.depth / float(pad.point_lengths.mean())


def surface_dashpot(pad: Pad) -> Tensor:
    """Instantaneous dashpot () of a pad's surface over the length of a contact point [N.s/m2],
    where all of it slides: one node, which its neighbours do not help to move, has some ten times
    as much."""
    J, tau = pad.material.whole_chain()
    mobility = pad.compliance()[::2, ::2].abs().sum(1).max() * (J / tau).sum()
    return 1 / mobility / float(pad.point_lengths.mean())
