"""The pads' finite elements: patch test, rigid motions, independent assembly, locking, order, condensation, gradients.

The oracle is scikit-fem, assembled in the world frame: the upper pad's mesh really hangs from its base there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest
import torch
from skfem import (
    Basis,
    BilinearForm,
    ElementQuad1,
    ElementQuad2,
    ElementVector,
    FacetBasis,
    LinearForm,
    MeshQuad,
    condense,
    solve,
)
from skfem.helpers import ddot, div, dot, sym_grad
from torch import Tensor

from torchsoft.model import SoftGrasp
from torchsoft.pad import (
    Array,
    InertialPad,
    MasslessPad,
    Material,
    Pad,
    PadMesh,
    build_pads,
    element_matrices,
    lame_moduli,
)
from torchsoft.parameters import PadParameters, Parameters

ROUNDING = 1e-13
"""Relative to the largest entry: two assemblies of the same integrals, in another order of summation."""

SOLVED = 1e-10
"""Relative: two linear solves of the same stiffness, whose condition number is below 1e5."""

CM_HEIGHT = 2.18e-3

Quadrature = Literal["centre", "full"]


def stiffness(mesh: PadMesh, nu: float, E: float = 1.0, all_nodes: bool = True) -> Array:
    """Dense stiffness per depth of the package."""
    lame_lambda, lame_mu = lame_moduli(E, nu)
    K_lambda, K_mu, _ = mesh.matrices
    return mesh.assemble(lame_lambda * K_lambda + lame_mu * K_mu, all_nodes).toarray()


# the oracle ---------------------------------------------------------------------------------------------------------


@BilinearForm
def dilatation(u, v, _):
    return div(u) * div(v)


@BilinearForm
def shear(u, v, _):
    return 2 * ddot(sym_grad(u), sym_grad(v))


@BilinearForm
def mass(u, v, _):
    return dot(u, v)


def oracle(x: Array, y: Array, dilatational: Quadrature = "centre") -> tuple[Array, Array, Array]:
    """scikit-fem's K_lambda, K_mu, M on the grid x, y [m]; nodes column by column, dofs (x, y) node by node."""
    mesh = MeshQuad.init_tensor(x, y)
    element = ElementVector(ElementQuad1())
    basis = Basis(mesh, element, intorder=2)
    assert basis.dx.shape[1] == 4  # 2 x 2 points
    centre = Basis(mesh, element, quadrature=(np.full((2, 1), 0.5), np.ones(1)))
    order = basis.nodal_dofs[:, np.lexsort((mesh.p[1], mesh.p[0]))].T.ravel()
    forms = (dilatation, centre if dilatational == "centre" else basis), (shear, basis), (mass, basis)
    K_lambda, K_mu, M = (form.assemble(b).toarray()[order][:, order] for form, b in forms)
    return K_lambda, K_mu, M


def world_stiffness(p: PadParameters, which: str) -> tuple[Array, Array]:
    """Positions [m] (n, 2) and dense stiffness [N/m] of a pad's free nodes, meshed where it stands in the world."""
    if which == "L":
        left, base, top = 0.0, 0.0, p.height
    else:
        left, base, top = -p.length / 2, -CM_HEIGHT, -CM_HEIGHT - p.height
    x = np.linspace(left, left + p.length, p.elements_x + 1)
    y = np.linspace(min(base, top), max(base, top), p.elements_y + 1)
    K_lambda, K_mu, _ = oracle(x, y)
    lame_lambda, lame_mu = lame_moduli(p.E, p.nu)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    held = nodes[:, 1] == base
    if which == "U" and p.enclosed:
        held |= (nodes[:, 0] == x[0]) | (nodes[:, 0] == x[-1])
    dofs = (2 * np.flatnonzero(~held)[:, None] + np.arange(2)).ravel()
    return nodes[~held], p.depth * (lame_lambda * K_lambda + lame_mu * K_mu)[dofs][:, dofs]


def matching(positions: Tensor, nodes: Array) -> Array:
    """Dofs of the oracle's `nodes`, in the order of a pad's `positions`."""
    distance = np.linalg.norm(positions.numpy()[:, None] - nodes, axis=-1)
    assert distance.min(1).max() < 1e-15
    return (2 * distance.argmin(1)[:, None] + np.arange(2)).ravel()


SMALL = {"elements_x": 12, "elements_y": 3, "length": 0.02, "height": 4e-3, "nu": 0.47}


@pytest.fixture(params=["lower", "upper", "enclosed"])
def place(request: pytest.FixtureRequest) -> tuple[str, bool]:
    """Which pad ("L" or "U"), and whether the bracket holds the upper one's sides."""
    return ("L" if request.param == "lower" else "U"), request.param == "enclosed"


def pad_at(place: tuple[str, bool], fidelity: Literal["massless", "inertial"]) -> tuple[Pad, PadParameters]:
    p = PadParameters(**SMALL, enclosed=place[1], fidelity=fidelity)
    return build_pads(p, CM_HEIGHT)["LU".index(place[0])], p


# the element --------------------------------------------------------------------------------------------------------


def uniform_traction(x: Array, y: Array, stress: Array) -> Array:
    """Consistent nodal forces (nodes, 2) per depth of a uniform stress on the outline of the grid x, y."""
    f = np.zeros((len(x), len(y), 2))
    for axis, sides in ((0, y), (1, x)):
        edges = np.diff(sides)
        share = np.zeros(len(sides))
        share[:-1] += edges / 2
        share[1:] += edges / 2
        for end, sign in ((0, -1), (-1, 1)):
            side = f[end] if axis == 0 else f[:, end]
            side += sign * share[:, None] * stress[:, axis]
    return f.reshape(-1, 2)


def linear_field(nodes: Array, nu: float) -> tuple[Array, Array]:
    """A linear displacement (nodes, 2) with strain and spin, and its stress (2, 2) for E = 1 in plane strain."""
    gradient = np.array([[0.3, -0.7], [1.1, 0.4]])
    strain = (gradient + gradient.T) / 2
    lame_lambda, lame_mu = lame_moduli(1.0, nu)
    return nodes @ gradient.T + [0.2, -0.1], lame_lambda * np.trace(strain) * np.eye(2) + 2 * lame_mu * strain


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45, 0.4999])
def test_patch_test_on_the_regular_mesh(nu: float) -> None:
    mesh = PadMesh(0.7, 0.3, 5, 3)
    u, stress = linear_field(mesh.nodes, nu)
    x, y = np.unique(mesh.nodes[:, 0]), np.unique(mesh.nodes[:, 1])
    want = uniform_traction(x, y, stress)
    K = stiffness(mesh, nu)
    assert np.abs(K @ u.ravel() - want.ravel()).max() < ROUNDING * np.abs(K).max()


@pytest.mark.parametrize("nu", [0.3, 0.4999])
def test_patch_test_on_unequal_rectangles(nu: float) -> None:
    x, y = np.array([0.0, 0.1, 0.5, 0.6]), np.array([0.0, 0.3, 0.35])
    lame_lambda, lame_mu = lame_moduli(1.0, nu)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    number = np.arange(len(nodes)).reshape(len(x), len(y))
    K = np.zeros((2 * len(nodes), 2 * len(nodes)))
    for i, a in enumerate(np.diff(x)):
        for j, b in enumerate(np.diff(y)):
            K_lambda, K_mu, _ = element_matrices(a, b)
            corners = number[[i, i + 1, i + 1, i], [j, j, j + 1, j + 1]]
            dofs = (2 * corners[:, None] + np.arange(2)).ravel()
            K[np.ix_(dofs, dofs)] += lame_lambda * K_lambda + lame_mu * K_mu
    u, stress = linear_field(nodes, nu)
    f = (K @ u.ravel()).reshape(-1, 2)
    assert np.abs(f - uniform_traction(x, y, stress)).max() < ROUNDING * np.abs(K).max()


def zero_energy_modes(K: Array) -> Array:
    """Eigenvectors (dofs, modes) of a stiffness without energy."""
    values, vectors = np.linalg.eigh(K)
    return vectors[:, np.abs(values) < 1e-12 * values[-1]]


@pytest.mark.parametrize("nu", [0.3, 0.49])
def test_only_the_three_rigid_motions_cost_no_energy(nu: float) -> None:
    mesh = PadMesh(0.7, 0.3, 5, 3)
    K = stiffness(mesh, nu)
    modes = zero_energy_modes(K)
    assert modes.shape[1] == 3
    x, y = mesh.nodes.T
    for vx, vy in ((1 + 0 * x, 0 * x), (0 * x, 1 + 0 * x), (-y, x)):
        rigid = np.stack((vx, vy), -1).ravel()
        rigid /= np.linalg.norm(rigid)
        assert np.linalg.norm(rigid - modes @ (modes.T @ rigid)) < 1e-12
    assert np.linalg.eigvalsh(K)[3] > 1e-4 * np.abs(K).max()  # no soft mode that the count above just misses


def test_the_count_of_zero_energy_modes_sees_hourglassing() -> None:
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    B = np.zeros((3, 8))  # a unit square, shear at its centre as well: two modes more than the rigid ones
    B[0, 0::2], B[1, 1::2] = corner[:, 0] / 2, corner[:, 1] / 2
    B[2, 0::2], B[2, 1::2] = corner[:, 1] / 2, corner[:, 0] / 2
    assert zero_energy_modes(B.T @ np.diag([2.0, 2.0, 1.0]) @ B + np.outer(B[:2].sum(0), B[:2].sum(0))).shape[1] == 5


def test_assembly_equals_scikit_fem() -> None:
    mesh = PadMesh(0.02, 4.59e-3, 11, 4)
    x, y = np.unique(mesh.nodes[:, 0]), np.unique(mesh.nodes[:, 1])
    for mine, theirs in zip(mesh.matrices, oracle(x, y), strict=True):
        assert np.abs(mesh.assemble(mine, all_nodes=True).toarray() - theirs).max() < ROUNDING * np.abs(theirs).max()
    full = oracle(x, y, "full")[0]
    mine = mesh.assemble(mesh.matrices[0], all_nodes=True).toarray()
    assert np.abs(mine - full).max() > 0.1 * np.abs(full).max()  # the quadrature matters to the comparison above


def test_banded_storage_holds_the_whole_matrix() -> None:
    mesh = PadMesh(0.02, 4e-3, 7, 3, bonded_sides=True)
    ab = mesh.banded_stiffness(*lame_moduli(1.0, 0.4))
    n = ab.shape[1]
    lower = sum(np.diag(ab[k, : n - k], -k) for k in range(len(ab)))
    K = stiffness(mesh, 0.4, all_nodes=False)
    assert np.abs(lower + np.tril(lower, -1).T - K).max() < ROUNDING * np.abs(K).max()


# locking and order --------------------------------------------------------------------------------------------------

LENGTH, HEIGHT, WIDTH = 0.04, 4.59e-3, 3e-3


def pressure(x: Array) -> Array:
    """A smooth pressure [Pa], about as wide as the contact of the full grasp and far from the layer's ends."""
    return np.exp(-(((x - LENGTH / 2) / WIDTH) ** 2))


@dataclass(frozen=True)
class Layer:
    """Work of the pressure on a bonded layer with E = 1 Pa and unit depth, by scikit-fem."""

    nu: float

    def work(self, elements_x: int, elements_y: int, order: Literal[1, 2]) -> float:
        """With full integration of bilinear (order 1) or biquadratic (order 2) elements."""
        x, y = np.linspace(0, LENGTH, elements_x + 1), np.linspace(0, HEIGHT, elements_y + 1)
        mesh = MeshQuad.init_tensor(x, y).with_boundaries(
            {"top": lambda x: x[1] == HEIGHT, "base": lambda x: x[1] == 0}
        )
        element = ElementVector(ElementQuad1() if order == 1 else ElementQuad2())
        basis, facets = Basis(mesh, element), FacetBasis(mesh, element, facets="top", intorder=10)
        lame_lambda, lame_mu = lame_moduli(1.0, self.nu)
        K = lame_lambda * dilatation.assemble(basis) + lame_mu * shear.assemble(basis)
        f = LinearForm(lambda v, w: -pressure(w.x[0]) * v[1]).assemble(facets)
        return float(f @ solve(*condense(K, f, D=basis.get_dofs("base"))))


def pad_work(nu: float, elements_x: int, elements_y: int) -> float:
    """The same work by the massless pad, the pressure lumped to its nodes as contact forces are."""
    pad = MasslessPad(PadMesh(LENGTH, HEIGHT, elements_x, elements_y), (0.0, 0.0), mirrored=False)
    C = pad.compliance(Material(PadParameters(E=1.0, depth=1.0, nu=nu))).detach().numpy()
    f = np.zeros((pad.nodes, 2))
    f[:, 1] = -pressure(pad.positions[:, 0].numpy()) * pad.tributary.numpy()
    return float(f.ravel() @ C @ f.ravel())


# full integration misses at least this share of the work on 1 mm elements; measured 17 and 93 %
@pytest.mark.parametrize(("nu", "lost_by_full_integration"), [(0.49, 0.15), (0.4999, 0.9)])
def test_a_nearly_incompressible_layer_does_not_lock(nu: float, lost_by_full_integration: float) -> None:
    reference = Layer(nu).work(160, 20, order=2)  # itself good to 3e-4 at nu = 0.4999
    assert abs(pad_work(nu, 40, 4) / reference - 1) < 0.02  # the default 1 mm elements: measured 1.4 and 1.5 %
    assert Layer(nu).work(40, 4, order=1) / reference - 1 < -lost_by_full_integration


@pytest.mark.parametrize("nu", [0.3, 0.45, 0.49])
def test_work_converges_with_the_square_of_the_spacing(nu: float) -> None:
    reference = Layer(nu).work(160, 20, order=2)  # good to 1.5e-5 and better
    errors = np.array([abs(pad_work(nu, 20 * k, 2 * k) / reference - 1) for k in (2, 4, 8)])
    order = np.log2(errors[:-1] / errors[1:])
    assert np.all(order > 1.9)
    assert np.all(order < 2.2)
    assert errors[-1] < 1e-3


# masses -------------------------------------------------------------------------------------------------------------


def test_lumped_masses_are_those_of_the_free_share_of_the_pad(place: tuple[str, bool]) -> None:
    pad, p = pad_at(place, "inertial")
    assert isinstance(pad, InertialPad)
    masses = pad.masses(Material(p)).detach()
    width = p.length * (1 - 1 / p.elements_x if place[1] else 1)  # held nodes take their half elements along
    area = width * p.height * (1 - 1 / (2 * p.elements_y))
    assert float(masses.min()) > 0
    assert float(masses.sum()) == pytest.approx(p.rho * p.depth * area, rel=1e-13)
    a, b = p.length / p.elements_x, p.height / p.elements_y
    assert float(masses.max()) == pytest.approx(p.rho * p.depth * a * b, rel=1e-13)  # an inner node: one element


def test_tributary_lengths_add_up_to_the_free_surface(place: tuple[str, bool]) -> None:
    pad, p = pad_at(place, "massless")
    held = p.length / p.elements_x if place[1] else 0.0  # half a spacing at each held corner
    assert float(pad.tributary.sum()) == pytest.approx(p.length - held, rel=1e-14)


# the pads in the world ----------------------------------------------------------------------------------------------


def test_pads_stand_where_the_base_is(place: tuple[str, bool]) -> None:
    massless, p = pad_at(place, "massless")
    inertial, _ = pad_at(place, "inertial")
    positions = massless.positions.numpy()
    assert np.array_equal(positions, inertial.positions[inertial.surface].numpy())
    face = p.height if place[0] == "L" else -CM_HEIGHT - p.height
    assert np.allclose(positions[:, 1], face, rtol=0, atol=1e-17)
    assert np.all(np.diff(positions[:, 0]) > 0)
    assert len(positions) == p.elements_x + (-1 if place[1] else 1)


def test_condensed_compliance_is_the_surface_block_of_the_full_inverse(place: tuple[str, bool]) -> None:
    massless, p = pad_at(place, "massless")
    inertial, _ = pad_at(place, "inertial")
    nodes, K = world_stiffness(p, place[0])
    full = np.linalg.inv(K)
    surface = matching(massless.positions, nodes)
    everywhere = matching(inertial.positions, nodes)
    scale = np.abs(full).max()
    with torch.no_grad():
        condensed, extended = massless.compliance(Material(p)).numpy(), inertial.compliance(Material(p)).numpy()
    assert np.abs(condensed - full[surface][:, surface]).max() < SOLVED * scale
    assert np.abs(extended - full[everywhere][:, surface]).max() < SOLVED * scale


def test_elastic_force_of_the_inertial_pad_is_the_assembled_stiffness(place: tuple[str, bool]) -> None:
    pad, p = pad_at(place, "inertial")
    nodes, K = world_stiffness(p, place[0])
    dofs = matching(pad.positions, nodes)
    u = 1e-4 * torch.randn(2, 3, pad.nodes, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    f = elastic_force(pad, p, u)
    want = u.flatten(-2).numpy() @ K[dofs][:, dofs]
    assert np.abs(f.flatten(-2).numpy() - want).max() < ROUNDING * np.abs(K).max() * float(u.abs().max())


def elastic_force(pad: Pad, p: PadParameters, u: Tensor) -> Tensor:
    assert isinstance(pad, InertialPad | MasslessPad)
    with torch.no_grad():
        return pad.elastic_force(Material(p), u)


def test_massless_displacement_is_the_inertial_pads_static_one(place: tuple[str, bool]) -> None:
    massless, p = pad_at(place, "massless")
    inertial, _ = pad_at(place, "inertial")
    f_s = torch.randn(massless.nodes, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    with torch.no_grad():
        u_s = (massless.compliance(Material(p)) @ f_s.flatten()).unflatten(0, (-1, 2))
    unit = torch.eye(2 * inertial.nodes, dtype=torch.float64).unflatten(-1, (-1, 2))
    K = elastic_force(inertial, p, unit).flatten(-2)
    f = torch.zeros(inertial.nodes, 2, dtype=torch.float64).index_add(0, inertial.surface, f_s)
    u = torch.linalg.solve(K, f.flatten()).unflatten(0, (-1, 2))
    assert float((u[inertial.surface] - u_s).abs().max()) < SOLVED * float(u.abs().max())
    assert float((elastic_force(massless, p, u_s) - f_s).abs().max()) < SOLVED * float(K.abs().max() * u_s.abs().max())


@pytest.mark.parametrize("which", ["L", "U"])
def test_a_rigid_translation_costs_force_only_if_the_base_stays_behind(which: str) -> None:
    small = {"pad.elements_x": 24, "pad.elements_y": 2, "pad.fidelity": "inertial"}
    model = SoftGrasp(Parameters().override(small))
    state = model.layout.unpack(torch.zeros(model.layout.size, dtype=torch.float64))
    speed = torch.tensor([0.02, -0.03], dtype=torch.float64)
    state = state._replace(r_C=state.r_C + 1.0, v_L=state.v_L + speed, v_U=state.v_U + speed)
    force = {}
    for base, v_Br in (("behind", 0 * speed), ("along", speed)):
        with torch.no_grad():
            force[base] = model.evaluate(0.0, state._replace(v_Br=v_Br)).ports[f"pad_{which}"].effort
    assert float(force["behind"].sum(0) @ speed) > 0  # the base holds the pad back
    if which == "U":
        assert float(force["along"].abs().max()) < 1e-13 * float(force["behind"].abs().max())
    else:  # the ground does not move along with the bracket
        assert torch.equal(force["along"], force["behind"])


# gradients ----------------------------------------------------------------------------------------------------------


def central(function: Callable[[float], float], at: float, step: float) -> float:
    """Derivative by central differences, the error of second order taken out."""
    first, second = ((function(at + h) - function(at - h)) / (2 * h) for h in (step, step / 2))
    return (4 * second - first) / 3


@pytest.mark.parametrize("fidelity", ["massless", "inertial"])
@pytest.mark.parametrize(("name", "step"), [("E", 1e-3), ("depth", 1e-3), ("nu", 1e-3)])
def test_gradient_of_the_compliance(fidelity: Literal["massless", "inertial"], name: str, step: float) -> None:
    pad, p = pad_at(("U", False), fidelity)
    weights = torch.randn(
        2 * pad.nodes, 2 * len(pad.surface), generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )

    def weighted(value: float) -> float:
        with torch.no_grad():
            return float((weights * pad.compliance(Material(p.model_copy(update={name: value})))).sum())

    material = Material(p)
    (weights * pad.compliance(material)).sum().backward()
    gradient = getattr(material, name).grad
    at = getattr(p, name)
    assert float(gradient) == pytest.approx(central(weighted, at, step * at), rel=1e-7)
    if name == "nu":
        assert float((weights * pad.compliance_by_nu(material)).sum().detach()) == pytest.approx(
            float(gradient), rel=1e-12
        )


def test_compliance_follows_a_change_of_nu() -> None:
    pad, p = pad_at(("L", False), "massless")
    material = Material(p)
    before = pad.compliance(material).detach().clone()
    with torch.no_grad():
        material.nu.fill_(0.3)
    fresh, _ = pad_at(("L", False), "massless")
    after = pad.compliance(material).detach()
    assert torch.equal(after, fresh.compliance(Material(p.model_copy(update={"nu": 0.3}))).detach())
    assert float((after - before).abs().max()) > 0.01 * float(before.abs().max())


def test_gradient_of_the_elastic_force() -> None:
    pad, p = pad_at(("U", False), "inertial")
    assert isinstance(pad, InertialPad)
    material = Material(p)
    u = torch.randn(pad.nodes, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    (u * pad.elastic_force(material, u)).sum().backward()
    for name in ("E", "nu", "depth"):
        at = getattr(p, name)

        def energy(value: float, name: str = name) -> float:
            return float((u * elastic_force(pad, p.model_copy(update={name: value}), u)).sum())

        assert float(getattr(material, name).grad) == pytest.approx(central(energy, at, 1e-3 * at), rel=1e-7)


def test_compliance_is_symmetric_and_positive(place: tuple[str, bool]) -> None:
    pad, p = pad_at(place, "massless")
    C = pad.compliance(Material(p)).detach()
    assert float((C - C.mT).abs().max()) < SOLVED * float(C.abs().max())
    assert float(torch.linalg.eigvalsh((C + C.mT) / 2).min()) > 0
