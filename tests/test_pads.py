"""Pads: masses, where they stand, condensation against the full stiffness, contact points, and gradients.

The oracle is scikit-fem, assembled in the world frame: the upper pad's mesh really hangs from its base there.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from conftest import coarse
from fem_oracle import CM_HEIGHT, matching, world_stiffness
from torch import Tensor

from torchsoft import KelvinVoigt, Pad, PadMesh
from torchsoft.paper.parameters import PadParameters

ROUNDING = 1e-13
"""Relative to the largest entry: two assemblies of the same integrals, in another order of summation."""

SOLVED = 1e-10
"""Relative: two linear solves of the same stiffness, whose condition number is below 1e5."""

SMALL = {"elements_x": 12, "elements_y": 3, "length": 0.02, "height": 4e-3, "nu": 0.47}

Place = tuple[str, bool]


@pytest.fixture(params=["lower", "upper", "enclosed"])
def place(request: pytest.FixtureRequest) -> Place:
    """Which pad ("L" or "U"), and whether the bracket holds the upper one's sides."""
    return ("L" if request.param == "lower" else "U"), request.param == "enclosed"


def pad_at(place: Place, *, inertial: bool, points: int = 0, **changes: float) -> tuple[Pad, PadParameters]:
    p = PadParameters(**SMALL | {"enclosed": place[1]} | changes)
    upper = place[0] == "U"
    mesh = PadMesh(p.length, p.height, p.elements_x, p.elements_y, bonded_sides=upper and p.enclosed)
    at = {"base": "bracket", "origin": (-p.length / 2, -CM_HEIGHT), "mirrored": True} if upper else {}
    return Pad(mesh, KelvinVoigt(p.E, p.nu, p.rho, p.tau, p.depth), inertial=inertial, points=points, **at), p


# masses -------------------------------------------------------------------------------------------------------------


def test_lumped_masses_are_those_of_the_free_share_of_the_pad(place: Place) -> None:
    pad, p = pad_at(place, inertial=True)
    masses = pad.masses().detach()
    width = p.length * (1 - 1 / p.elements_x if place[1] else 1)  # held nodes take their half elements along
    area = width * p.height * (1 - 1 / (2 * p.elements_y))
    assert float(masses.min()) > 0
    assert float(masses.sum()) == pytest.approx(p.rho * p.depth * area, rel=1e-13)
    a, b = p.length / p.elements_x, p.height / p.elements_y
    assert float(masses.max()) == pytest.approx(p.rho * p.depth * a * b, rel=1e-13)  # an inner node: one element


def test_tributary_lengths_add_up_to_the_free_surface(place: Place) -> None:
    pad, p = pad_at(place, inertial=False)
    held = p.length / p.elements_x if place[1] else 0.0  # half a spacing at each held corner
    assert float(pad.mesh.tributary.sum()) == pytest.approx(p.length - held, rel=1e-14)


# the pads in the world ----------------------------------------------------------------------------------------------


def test_pads_stand_where_the_base_is(place: Place) -> None:
    massless, p = pad_at(place, inertial=False)
    inertial, _ = pad_at(place, inertial=True)
    positions = massless.positions.numpy()
    assert np.array_equal(positions, inertial.positions[inertial.surface].numpy())
    face = p.height if place[0] == "L" else -CM_HEIGHT - p.height
    assert np.allclose(positions[:, 1], face, rtol=0, atol=1e-17)
    assert np.all(np.diff(positions[:, 0]) > 0)
    assert len(positions) == p.elements_x + (-1 if place[1] else 1)


def test_condensed_compliance_is_the_surface_block_of_the_full_inverse(place: Place) -> None:
    massless, p = pad_at(place, inertial=False)
    inertial, _ = pad_at(place, inertial=True)
    nodes, K = world_stiffness(p, place[0])
    full = np.linalg.inv(K)
    surface = matching(massless.positions, nodes)
    everywhere = matching(inertial.positions, nodes)
    scale = np.abs(full).max()
    with torch.no_grad():
        condensed = massless.compliance().numpy()
        forces = torch.randn(massless.nodes, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        extended = inertial.static_displacement(forces).flatten().numpy()
    assert np.abs(condensed - full[surface][:, surface]).max() < SOLVED * scale
    assert np.abs(extended - full[everywhere][:, surface] @ forces.flatten().numpy()).max() < SOLVED * scale * len(
        forces
    )


def test_elastic_force_of_the_inertial_pad_is_the_assembled_stiffness(place: Place) -> None:
    pad, p = pad_at(place, inertial=True)
    nodes, K = world_stiffness(p, place[0])
    dofs = matching(pad.positions, nodes)
    u = 1e-4 * torch.randn(2, 3, pad.nodes, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    f = elastic_force(pad, u)
    want = u.flatten(-2).numpy() @ K[dofs][:, dofs]
    assert np.abs(f.flatten(-2).numpy() - want).max() < ROUNDING * np.abs(K).max() * float(u.abs().max())


def elastic_force(pad: Pad, u: Tensor) -> Tensor:
    with torch.no_grad():
        return pad.elastic_force(u)


def test_massless_displacement_is_the_inertial_pads_static_one(place: Place) -> None:
    massless, _ = pad_at(place, inertial=False)
    inertial, _ = pad_at(place, inertial=True)
    f_s = torch.randn(massless.nodes, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    with torch.no_grad():
        u_s = (massless.compliance() @ f_s.flatten()).unflatten(0, (-1, 2))
    unit = torch.eye(2 * inertial.nodes, dtype=torch.float64).unflatten(-1, (-1, 2))
    K = elastic_force(inertial, unit).flatten(-2)
    f = torch.zeros(inertial.nodes, 2, dtype=torch.float64).index_add(0, inertial.surface, f_s)
    u = torch.linalg.solve(K, f.flatten()).unflatten(0, (-1, 2))
    assert float((u[inertial.surface] - u_s).abs().max()) < SOLVED * float(u.abs().max())
    with torch.no_grad():
        assert float((inertial.static_displacement(f_s) - u).abs().max()) < SOLVED * float(u.abs().max())


@pytest.mark.parametrize("which", ["L", "U"])
@torch.no_grad()
def test_a_rigid_translation_costs_force_only_if_the_base_stays_behind(which: str) -> None:
    model = coarse(pad__elements_x=24, pad__fidelity="inertial")
    state = model.unpack(torch.zeros(model.layout.size, dtype=torch.float64))
    speed = torch.tensor([0.02, -0.03, 0.0], dtype=torch.float64)
    rates = {name: rate + speed[:2] for name, rate in state.rates.items()}
    state = state._replace(pose=state.pose | {"disc": state.pose["disc"] + 1.0}, rates=rates)
    force = {}
    for base, v_Br in (("behind", 0 * speed), ("along", speed)):
        moving = state._replace(velocity=state.velocity | {"bracket": v_Br})
        force[base] = model.evaluate(0.0, moving).ports[f"pad_{which}"].effort
    assert float(force["behind"].sum(0) @ speed[:2]) > 0  # the base holds the pad back
    if which == "U":
        assert float(force["along"].abs().max()) < 1e-13 * float(force["behind"].abs().max())
    else:  # the ground does not move along with the bracket
        assert torch.equal(force["along"], force["behind"])


# contact points -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("points", [0, 1, 3])
def test_contact_points_stand_for_the_whole_surface(place: Place, points: int) -> None:
    """Lengths add up, shape functions to one; Gauss points integrate a cubic along the surface exactly from two on."""
    pad, p = pad_at(place, inertial=False, points=points)
    count = p.elements_x + (-2 if place[1] else 0)
    assert len(pad.spread) == (pad.nodes if points == 0 else points * count)
    held = 2 * p.length / p.elements_x if place[1] and points else p.length / p.elements_x if place[1] else 0.0
    assert float(pad.point_lengths.sum()) == pytest.approx(p.length - held, rel=1e-13)
    assert torch.allclose(pad.spread.sum(1), torch.ones(len(pad.spread), dtype=torch.float64), rtol=0, atol=1e-15)
    x = pad.point_positions[:, 0].numpy() - pad.positions[:, 0].numpy().mean()
    if points == 3:
        end = (p.length - held) / 2
        assert float((pad.point_lengths * x**4).sum()) == pytest.approx(2 * end**5 / 5, rel=1e-12)


def test_a_negative_number_of_points_is_refused() -> None:
    with pytest.raises(ValueError, match="`points` must be a whole number from 0 on, but is -1"):
        pad_at(("L", False), inertial=False, points=-1)


# gradients ----------------------------------------------------------------------------------------------------------


def central(function: Callable[[float], float], at: float, step: float) -> float:
    """Derivative by central differences, the error of second order taken out."""
    first, second = ((function(at + h) - function(at - h)) / (2 * h) for h in (step, step / 2))
    return (4 * second - first) / 3


@pytest.mark.parametrize("name", ["E", "depth", "nu"])
def test_gradient_of_the_compliance(name: str) -> None:
    pad, p = pad_at(("U", False), inertial=False)
    generator = torch.Generator().manual_seed(3)
    weights = torch.randn(2 * pad.nodes, 2 * pad.nodes, generator=generator, dtype=torch.float64)

    def weighted(value: float) -> float:
        with torch.no_grad():
            return float((weights * pad_at(("U", False), inertial=False, **{name: value})[0].compliance()).sum())

    (gradient,) = torch.autograd.grad((weights * pad.compliance()).sum(), getattr(pad.material, name))
    at = getattr(p, name)
    assert float(gradient) == pytest.approx(central(weighted, at, 1e-3 * at), rel=1e-7)
    if name == "nu":
        scale = p.E * p.depth
        assert float((weights * pad.unit_compliance()[1]).sum() / scale) == pytest.approx(float(gradient), rel=1e-12)


@pytest.mark.parametrize("name", ["E", "depth"])
def test_gradient_of_the_static_displacement(name: str) -> None:
    pad, p = pad_at(("U", False), inertial=True)
    F = torch.randn(len(pad.surface), 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    u = pad.static_displacement(F)
    (gradient,) = torch.autograd.grad(u[:, 1].sum(), getattr(pad.material, name))
    assert float(gradient) == pytest.approx(-float(u.detach()[:, 1].sum()) / getattr(p, name), rel=1e-12)


def test_compliance_follows_a_change_of_nu() -> None:
    pad, _ = pad_at(("L", False), inertial=False)
    before = pad.compliance().detach().clone()
    with torch.no_grad():
        pad.material.nu.fill_(0.3)
    fresh, _ = pad_at(("L", False), inertial=False, nu=0.3)
    after = pad.compliance().detach()
    assert torch.equal(after, fresh.compliance().detach())
    assert float((after - before).abs().max()) > 0.01 * float(before.abs().max())


def test_gradient_of_the_elastic_force() -> None:
    pad, p = pad_at(("U", False), inertial=True)
    u = torch.randn(pad.nodes, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    (u * pad.elastic_force(u)).sum().backward()
    for name in ("E", "nu", "depth"):
        at = getattr(p, name)

        def energy(value: float, name: str = name) -> float:
            return float((u * elastic_force(pad_at(("U", False), inertial=True, **{name: value})[0], u)).sum())

        assert float(getattr(pad.material, name).grad) == pytest.approx(central(energy, at, 1e-3 * at), rel=1e-7)


def test_compliance_is_symmetric_and_positive(place: Place) -> None:
    C = pad_at(place, inertial=False)[0].compliance().detach()
    assert float((C - C.mT).abs().max()) < SOLVED * float(C.abs().max())
    assert float(torch.linalg.eigvalsh((C + C.mT) / 2).min()) > 0
