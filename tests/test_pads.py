"""Pads: masses, where they stand, condensation against the full stiffness, contact points, and
gradients.

The oracle is scikit-fem, assembled in the world frame: the upper pad's mesh really hangs from its
base there.
"""

import numpy as np
import pytest
import torch
from conftest import RUBBER
from fem_oracle import CM_HEIGHT, matching, world_stiffness
from torch import Tensor

from torchsoft import KelvinVoigt, Pad, PadMesh
from torchsoft.physics.balance import Balance

ROUNDING = 1e-13
"""Relative to the largest entry: two assemblies of the same integrals, in another order of
summation."""

SOLVED = 1e-10
"""Relative: two linear solves of the same stiffness, whose condition number is below 1e5."""

LENGTH = 0.02
"""Of a small pad [m]."""

Place = tuple[str, bool]


@pytest.fixture(params=["lower", "upper", "enclosed"])
def place(request):
    """Which pad ("L" or "U"), and whether the bracket holds the upper one's sides."""
    return ("L" if request.param == "lower" else "U"), request.param == "enclosed"


def pad_at(place: Place, *, inertial: bool, points: int = 0) -> Pad:
    upper, enclosed = place[0] == "U", place[1]
    mesh = PadMesh(LENGTH, 4e-3, 12, 3, bonded_sides=enclosed)
    at = {"base": "bracket", "origin": (-LENGTH / 2, -CM_HEIGHT), "mirrored": True} if upper else {}
    rubber = KelvinVoigt(**RUBBER | {"nu": 0.47}, tau=0.01)
    return Pad(mesh, rubber, inertial=inertial, points=points, **at)


# masses
# ----------------------------------------------------------------------


def test_lumped_masses_are_those_of_the_free_share_of_the_pad(place):
    pad = pad_at(place, inertial=True)
    p, masses = pad.mesh, pad.masses().detach()
    width = p.length * (
        1 - 1 / p.elements_x if place[1] else 1
    )  # held nodes take their half elements along
    area = width * p.height * (1 - 1 / (2 * p.elements_y))
    assert float(masses.min()) > 0
    assert float(masses.sum()) == pytest.approx(1100.0 * 0.044 * area, rel=1e-13)
    a, b = p.length / p.elements_x, p.height / p.elements_y
    assert float(masses.max()) == pytest.approx(
        1100.0 * 0.044 * a * b, rel=1e-13
    )  # an inner node: one element


# the pads in the world
# ----------------------------------------------------------------------


def test_pads_stand_where_the_base_is(place):
    massless = pad_at(place, inertial=False)
    inertial = pad_at(place, inertial=True)
    p, positions = massless.mesh, massless.positions.numpy()
    assert np.array_equal(positions, inertial.positions[inertial.surface].numpy())
    face = p.height if place[0] == "L" else -CM_HEIGHT - p.height
    assert np.allclose(positions[:, 1], face, rtol=0, atol=1e-17)
    assert np.all(np.diff(positions[:, 0]) > 0)
    assert len(positions) == p.elements_x + (-1 if place[1] else 1)


def test_condensed_compliance_is_the_surface_block_of_the_full_inverse(place):
    massless = pad_at(place, inertial=False)
    inertial = pad_at(place, inertial=True)
    nodes, K = world_stiffness(massless)
    full = np.linalg.inv(K)
    surface = matching(massless.positions, nodes)
    everywhere = matching(inertial.positions, nodes)
    scale = np.abs(full).max()
    with torch.no_grad():
        condensed = massless.compliance().numpy()
        forces = torch.randn(
            massless.nodes, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64
        )
    extended = displaced(inertial, forces).detach().flatten().numpy()
    slopes = [
        torch.autograd.grad((w * u).sum(), pad.material.nu)[0]
        for w in [torch.arange(2.0 * massless.nodes).reshape(-1, 2)]
        for pad, u in (
            (massless, (massless.compliance() @ forces.flatten()).reshape(-1, 2)),
            (inertial, displaced(inertial, forces)[inertial.surface]),
        )
    ]
    assert slopes[0].item() == pytest.approx(slopes[1].item(), rel=1e-9)
    assert np.abs(condensed - full[surface][:, surface]).max() < SOLVED * scale
    assert np.abs(
        extended - full[everywhere][:, surface] @ forces.flatten().numpy()
    ).max() < SOLVED * scale * len(forces)


def test_elastic_force_of_the_inertial_pad_is_the_assembled_stiffness(place):
    pad = pad_at(place, inertial=True)
    nodes, K = world_stiffness(pad)
    dofs = matching(pad.positions, nodes)
    u = 1e-4 * torch.randn(
        2, 3, pad.nodes, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    f = elastic_force(pad, u)
    want = u.flatten(-2).numpy() @ K[dofs][:, dofs]
    assert np.abs(f.flatten(-2).numpy() - want).max() < ROUNDING * np.abs(K).max() * float(
        u.abs().max()
    )


def displaced(pad: Pad, forces: Tensor) -> Tensor:
    """Displacements (nodes, 2) [m] of a nodal pad under forces on its surface nodes."""
    balance = Balance(pad, pad.element_forces, lambda u: forces + 0 * u)
    u, factors, left = balance.found(torch.zeros(pad.nodes, 2).double(), 1e-15, 3)
    assert left < 1e-15
    return balance.corrected(u, factors)


def elastic_force(pad: Pad, u: Tensor) -> Tensor:
    with torch.no_grad():
        return pad.internal_force(u, torch.zeros_like(u))


# contact points
# ----------------------------------------------------------------------


@pytest.mark.parametrize("points", [0, 1, 3])
def test_contact_points_stand_for_the_whole_surface(place, points):
    """Lengths add up, shape functions to one; Gauss points integrate a cubic along the surface
    exactly from two on."""
    pad = pad_at(place, inertial=False, points=points)
    p = pad.mesh
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
