"""Pads: masses, where they stand, condensation against the full stiffness, contact points, and
gradients.

The oracle is scikit-fem, assembled in the world frame: the upper pad's mesh really hangs from its
base there.
"""

import numpy as np
import pytest
import torch
from fem_oracle import CM_HEIGHT, PadNumbers, matching, world_stiffness
from torch import Tensor

from torchsoft import KelvinVoigt, Pad, PadMesh

ROUNDING = 1e-13
"""Relative to the largest entry: two assemblies of the same integrals, in another order of
summation."""

SOLVED = 1e-10
"""Relative: two linear solves of the same stiffness, whose condition number is below 1e5."""

SMALL = {"elements_x": 12, "elements_y": 3, "length": 0.02, "height": 4e-3, "nu": 0.47}

Place = tuple[str, bool]


@pytest.fixture(params=["lower", "upper", "enclosed"])
def place(request):
    """Which pad ("L" or "U"), and whether the bracket holds the upper one's sides."""
    return ("L" if request.param == "lower" else "U"), request.param == "enclosed"


def pad_at(
    place: Place, *, inertial: bool, points: int = 0, **changes: float
) -> tuple[Pad, PadNumbers]:
    p = PadNumbers(**SMALL | {"enclosed": place[1]} | changes)
    upper = place[0] == "U"
    mesh = PadMesh(
        p.length, p.height, p.elements_x, p.elements_y, bonded_sides=upper and p.enclosed
    )
    at = (
        {"base": "bracket", "origin": (-p.length / 2, -CM_HEIGHT), "mirrored": True}
        if upper
        else {}
    )
    return Pad(
        mesh, KelvinVoigt(p.E, p.nu, p.rho, p.tau, p.depth), inertial=inertial, points=points, **at
    ), p


# masses
# ----------------------------------------------------------------------


def test_lumped_masses_are_those_of_the_free_share_of_the_pad(place):
    pad, p = pad_at(place, inertial=True)
    masses = pad.masses().detach()
    width = p.length * (
        1 - 1 / p.elements_x if place[1] else 1
    )  # held nodes take their half elements along
    area = width * p.height * (1 - 1 / (2 * p.elements_y))
    assert float(masses.min()) > 0
    assert float(masses.sum()) == pytest.approx(p.rho * p.depth * area, rel=1e-13)
    a, b = p.length / p.elements_x, p.height / p.elements_y
    assert float(masses.max()) == pytest.approx(
        p.rho * p.depth * a * b, rel=1e-13
    )  # an inner node: one element


# the pads in the world
# ----------------------------------------------------------------------


def test_pads_stand_where_the_base_is(place):
    massless, p = pad_at(place, inertial=False)
    inertial, _ = pad_at(place, inertial=True)
    positions = massless.positions.numpy()
    assert np.array_equal(positions, inertial.positions[inertial.surface].numpy())
    face = p.height if place[0] == "L" else -CM_HEIGHT - p.height
    assert np.allclose(positions[:, 1], face, rtol=0, atol=1e-17)
    assert np.all(np.diff(positions[:, 0]) > 0)
    assert len(positions) == p.elements_x + (-1 if place[1] else 1)


def test_condensed_compliance_is_the_surface_block_of_the_full_inverse(place):
    massless, p = pad_at(place, inertial=False)
    inertial, _ = pad_at(place, inertial=True)
    nodes, K = world_stiffness(p, place[0])
    full = np.linalg.inv(K)
    surface = matching(massless.positions, nodes)
    everywhere = matching(inertial.positions, nodes)
    scale = np.abs(full).max()
    with torch.no_grad():
        condensed = massless.compliance().numpy()
        forces = torch.randn(
            massless.nodes, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64
        )
        extended = inertial.static_displacement(forces).flatten().numpy()
    slopes = [
        torch.autograd.grad((w * u).sum(), pad.material.nu)[0]
        for w in [torch.arange(2.0 * massless.nodes).reshape(-1, 2)]
        for pad, u in (
            (massless, (massless.compliance() @ forces.flatten()).reshape(-1, 2)),
            (inertial, inertial.static_displacement(forces)[inertial.surface]),
        )
    ]
    assert slopes[0].item() == pytest.approx(slopes[1].item(), rel=1e-9)
    assert np.abs(condensed - full[surface][:, surface]).max() < SOLVED * scale
    assert np.abs(
        extended - full[everywhere][:, surface] @ forces.flatten().numpy()
    ).max() < SOLVED * scale * len(forces)


def test_elastic_force_of_the_inertial_pad_is_the_assembled_stiffness(place):
    pad, p = pad_at(place, inertial=True)
    nodes, K = world_stiffness(p, place[0])
    dofs = matching(pad.positions, nodes)
    u = 1e-4 * torch.randn(
        2, 3, pad.nodes, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    f = elastic_force(pad, u)
    want = u.flatten(-2).numpy() @ K[dofs][:, dofs]
    assert np.abs(f.flatten(-2).numpy() - want).max() < ROUNDING * np.abs(K).max() * float(
        u.abs().max()
    )


def elastic_force(pad: Pad, u: Tensor) -> Tensor:
    with torch.no_grad():
        return pad.elastic_force(u)


# contact points
# ----------------------------------------------------------------------


@pytest.mark.parametrize("points", [0, 1, 3])
def test_contact_points_stand_for_the_whole_surface(place, points):
    """Lengths add up, shape functions to one; Gauss points integrate a cubic along the surface
    exactly from two on."""
    pad, p = pad_at(place, inertial=False, points=points)
    count = p.elements_x + (-2 if place[1] else 0)
    assert len(pad.spread) == (pad.nodes if points == 0 else points * count)
    held = (
        2 * p.length / p.elements_x
        if place[1] and points
        else p.length / p.elements_x
        if place[1]
        else 0.0
    )
    assert float(pad.point_lengths.sum()) == pytest.approx(p.length - held, rel=1e-13)
    assert torch.allclose(
        pad.spread.sum(1), torch.ones(len(pad.spread), dtype=torch.float64), rtol=0, atol=1e-15
    )
    x = pad.point_positions[:, 0].numpy() - pad.positions[:, 0].numpy().mean()
    if points == 3:
        end = (p.length - held) / 2
        assert float((pad.point_lengths * x**4).sum()) == pytest.approx(2 * end**5 / 5, rel=1e-12)


# gradients
# ----------------------------------------------------------------------
