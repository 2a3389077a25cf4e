"""What every mesh and its pads guarantee, against scikit-fem, meshed where the pad stands, and
closed forms; meshes from files."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from conftest import RUBBER, dry
from fem_oracle import dilatation, matrices, shear
from skfem import (
    Basis,
    ElementQuad2,
    ElementQuadS2,
    ElementVector,
    FacetBasis,
    LinearForm,
    MeshQuad,
    condense,
    solve,
)
from test_material import MATERIALS, made

from torchsoft import (
    Body,
    Circle,
    Contact,
    CurvedPadMesh,
    FingertipMesh,
    KelvinVoigt,
    Pad,
    PadMesh,
    QuadMesh,
    Rig,
    Taxels,
    simulate,
)
from torchsoft.physics.mesh import Array, Mesh, lame_moduli
from torchsoft.physics.mesh.element import Element
from torchsoft.physics.mesh.mesh import StoredMesh

ROUNDING, SOLVED = 1e-12, 1e-10
"""Parts of the largest entry: two assemblies of the same integrals; two solutions of one system."""

RADIUS = 8e-3


def trapezium() -> QuadMesh:
    """A skew, ragged mesh whose points are numbered at random, and some of whose quadrilaterals are
    clockwise."""
    rng = np.random.default_rng(4)
    s, t = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 4), indexing="ij")
    inner = (s * (1 - s) > 0) & (t * (1 - t) > 0)
    s, t = (x + w * inner * rng.standard_normal(s.shape) for x, w in ((s, 0.02), (t, 0.05)))
    points = np.stack((30e-3 * s + 4e-3 * t * (1 - 2 * s), 6e-3 * t + 1e-3 * s), -1).reshape(-1, 2)
    number = np.arange(len(points)).reshape(s.shape)
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    quads = np.stack(corners, -1).reshape(-1, 4)
    quads[::3] = quads[::3, ::-1]
    face, base = (np.stack((row[:-1], row[1:]), -1) for row in (number[:, -1], number[:, 0]))
    mixed = rng.permutation(len(points) + 1)  # the last belongs to no quadrilateral
    shuffled = np.empty((len(points) + 1, 2))
    shuffled[mixed] = np.concatenate((points, [[9.0, 9.0]]))
    return QuadMesh.of(shuffled, mixed[quads], mixed[face[::-1]], mixed[base])


# A new mesh is one line.
MESHES: dict[str, Callable[[], Mesh]] = {
    "block": lambda: PadMesh(20e-3, 4.59e-3, 11, 4),
    "enclosed": lambda: PadMesh(20e-3, 4e-3, 12, 3, bonded_sides=True),
    "crowned": lambda: CurvedPadMesh(30e-3, 6e-3, 15, 3, radius=40e-3),
    "hollow": lambda: CurvedPadMesh(
        30e-3, 4e-3, 15, 3, radius=-50e-3, bonded_edges=("base", "right")
    ),
    "fingertip": lambda: FingertipMesh(RADIUS, 12),
    "trapezium": trapezium,
}


@pytest.fixture(params=MESHES)
def mesh(request):
    return MESHES[request.param]()


def rubber() -> KelvinVoigt:
    return KelvinVoigt(**RUBBER, tau=0.01)


def test_assembly_equals_scikit_fem(mesh):
    *stiffness, M = matrices(mesh.nodes, mesh.elements)
    for moduli, want in zip(((1.0, 0.0), (0.0, 1.0)), stiffness):
        got = mesh.stiffness(*moduli, all_nodes=True).toarray()
        assert np.abs(got - want).max() < ROUNDING * np.abs(want).max()
    assert mesh.areas == pytest.approx(M.sum(1)[::2], rel=1e-12)


PLACES: dict[str, dict[str, Any]] = {
    "on the ground": {},
    "under a bracket": {"base": "bracket", "origin": (-0.01, -2.18e-3), "mirrored": True},
    "turned": {"base": "jaw", "origin": (2e-3, -1e-3), "angle": 0.7},
}


@pytest.mark.parametrize("place", PLACES)
def test_a_pad_is_the_mesh_where_it_stands(mesh, place):
    """Places, masses, forces of the inertial pad and compliance of the condensed one, against
    elements meshed there."""
    where = PLACES[place]
    c, s = np.cos(where.get("angle", 0.0)), np.sin(where.get("angle", 0.0))
    axes = np.array([[c, -s], [s, c]]) @ np.diag([1.0, -1.0 if "mirrored" in where else 1.0])
    nodes = mesh.nodes @ axes.T + where.get("origin", (0.0, 0.0))
    K_lambda, K_mu, M = matrices(nodes, mesh.elements)
    free = np.flatnonzero(~mesh.bonded)
    dofs = (2 * free[:, None] + np.arange(2)).ravel()
    massless, inertial = (Pad(mesh, rubber(), inertial=how, **where) for how in (False, True))
    order = [int(np.abs(nodes[free] - x).sum(1).argmin()) for x in inertial.positions.numpy()]
    assert np.abs(nodes[free][order] - inertial.positions.numpy()).max() < 1e-15
    assert torch.equal(massless.positions, inertial.positions[inertial.surface])
    masses = 1100.0 * 44e-3 * M.sum(1)[2 * free[order]]
    assert inertial.masses().detach().numpy() == pytest.approx(masses, rel=1e-12)

    lame_lambda, lame_mu = lame_moduli(0.75e6, 0.45)
    K = 44e-3 * (lame_lambda * K_lambda + lame_mu * K_mu)[dofs][:, dofs]
    mine = (2 * np.array(order)[:, None] + np.arange(2)).ravel()
    u = 1e-4 * torch.randn(
        2, inertial.nodes, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    with torch.no_grad():
        force = inertial.internal_force(u, 0 * u).flatten(-2).numpy()
    want = u.flatten(-2).numpy() @ K[mine][:, mine]
    assert np.abs(force - want).max() < ROUNDING * np.abs(K).max() * float(u.abs().max())
    on = mine.reshape(-1, 2)[inertial.surface.numpy()].ravel()
    C = np.linalg.inv(K)[on][:, on]
    assert np.abs(massless.compliance().detach().numpy() - C).max() < SOLVED * np.abs(C).max()


@pytest.mark.parametrize("points", [0, 1, 3])
def test_contact_points_stand_for_the_whole_face(mesh, points):
    """Lengths add up to the sides between free nodes, shape functions to one; three Gauss points
    integrate s^4 along the face exactly."""
    pad = Pad(mesh, rubber(), points=points)
    face = mesh.nodes[mesh.face]
    way = np.concatenate(([0.0], np.linalg.norm(np.diff(face, axis=0), axis=1).cumsum()))
    every = way - 0.5 * way[-1]
    s = every[~mesh.bonded[mesh.face]]
    beside = 0.5 * (every[-1] - every[0] - s[-1] + s[0])  # half of the sides to a held node
    lengths = pad.point_lengths
    assert lengths.sum() == pytest.approx(s[-1] - s[0] + beside * (points == 0), rel=1e-12)
    assert pad.interpolation.sum(1).numpy() == pytest.approx(np.ones(len(lengths)), abs=1e-15)
    assert len(lengths) == (len(s) if points == 0 else points * (len(s) - 1))
    if points == 3:
        integral = (lengths * pad.point_coordinates**4).sum()
        assert integral == pytest.approx((s[-1] ** 5 - s[0] ** 5) / 5, rel=1e-12)


# an element that is not shipped: a quadratic quadrilateral of eight nodes

AROUND = np.array([[-1, -1], [0, -1], [1, -1], [1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0]], float)
GAUSS_3 = tuple((x, y, v * w) for x, v in zip(*np.polynomial.legendre.leggauss(3))
                for y, w in zip(*np.polynomial.legendre.leggauss(3)))  # fmt: skip


def serendipity(x: Any, y: Any) -> tuple[Array, Array]:
    """Shape functions (8,) and their slopes (8, 2)."""
    powers = lambda x, y: np.stack((x**0, x, y, x * y, x**2, y**2, x**2 * y, x * y**2), -1)
    by_x = np.array([0, 1, 0, y, 2 * x, 0, 2 * x * y, y**2])
    by_y = np.array([0, 0, 1, x, 0, 2 * y, x**2, 2 * x * y])
    weights = np.linalg.inv(powers(*AROUND.T))
    return powers(x, y) @ weights, np.stack((by_x @ weights, by_y @ weights), -1)


QUADRATIC = Element(8, 3, serendipity, GAUSS_3, GAUSS_3)


class QuadraticMesh(StoredMesh):
    element = QUADRATIC


def quadratic() -> QuadraticMesh:
    """A block of 4 by 2 elements whose inner corners are anywhere."""
    block = PadMesh(20e-3, 6e-3, 8, 4)
    x, grid = block.nodes.reshape(9, 5, 2).copy(), block.grid
    x[2:-1:2, 2] += 0.6e-3 * np.random.default_rng(5).standard_normal((3, 2))
    x[1::2, ::2] = 0.5 * (x[:-1:2, ::2] + x[2::2, ::2])
    x[:, 1::2] = 0.5 * (x[:, :-1:2] + x[:, 2::2])
    column, row = (AROUND.T + 1).astype(int)
    elements = np.stack([grid[i + column, j + row] for i in range(0, 8, 2) for j in (0, 2)])
    used, elements = np.unique(elements, return_inverse=True)
    nodes, face = x.reshape(-1, 2)[used], np.searchsorted(used, grid[:, -1])
    return QuadraticMesh(nodes, elements.reshape(-1, 8), nodes[:, 1] == 0, face)


def test_a_linear_pad_has_quadratic_elements():
    """Its compliance is that of scikit-fem's, and its contact points are on the face."""
    mesh = quadratic()
    pad, moduli = Pad(mesh, rubber(), points=3), lame_moduli(0.75e6, 0.45)
    corners = mesh.elements[:, ::2]
    used, quads = np.unique(corners, return_inverse=True)
    grid = MeshQuad(mesh.nodes[used].T.copy(), quads.reshape(-1, 4).T.copy())
    basis = Basis(grid, ElementVector(ElementQuadS2()), intorder=5)
    K = moduli[0] * dilatation.assemble(basis) + moduli[1] * shear.assemble(basis)
    dofs = np.asarray(basis.doflocs).T
    order = np.array([np.abs(dofs - x).sum(1).argsort()[:2] for x in mesh.nodes[mesh.free]])
    order = np.sort(order, 1).ravel()  # x before y
    on = (2 * mesh.surface[:, None] + np.arange(2)).ravel()
    C = np.linalg.inv(44e-3 * K.toarray()[order][:, order])[on][:, on]
    assert np.abs(pad.compliance().detach().numpy() - C).max() < SOLVED * np.abs(C).max()
    place = pad.point_positions.numpy()
    assert place[:, 1] == pytest.approx(np.full(len(place), 6e-3), rel=1e-12)
    assert pad.point_lengths.sum() == pytest.approx(20e-3, rel=1e-12)
    integral = (pad.point_lengths * place[:, 0] ** 4).sum()
    assert integral == pytest.approx(20e-3**5 / 5, rel=1e-12)
    contacts = {"P": Contact("P", "disc", dry())}
    rig = Rig(bodies={"disc": Body(0.4, Circle(0.02))}, pads={"P": pad}, contacts=contacts)
    state = rig.unpack(rig.state(disc={"x": 0.01, "y": "rest"}).detach())
    assert float(state.pads["P"][..., 1].sum()) == pytest.approx(-0.4 * 9.81, rel=1e-9)
    with pytest.raises(NotImplementedError, match=r"`P` has 3 nodes on a side, .* compiled for 2"):
        simulate(rig, [0.0, 0.01], y0=rig.pack(state))
    with pytest.raises(NotImplementedError, match="bilinear quadrilaterals"):
        Pad(mesh, rubber(), inertial=True)


def test_face_outline_and_base_are_those_of_the_nodes(mesh):
    face = mesh.nodes[mesh.face]
    assert np.all(np.diff(face[:, 0]) > 0)  # from left to right
    assert np.all(np.isin(mesh.face, mesh.outline))
    x, y = mesh.nodes[mesh.outline].T
    area = 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
    assert mesh.areas.sum() == pytest.approx(area, rel=1e-13)
    corners, under = mesh.back
    np.testing.assert_array_equal(corners[[0, -1]], face[[-1, 0]])
    base, way = mesh.base, np.linalg.norm(np.diff(corners, axis=0), axis=1)
    assert 0.7 <= way[under].sum() / (base[1, 0] - base[0, 0]) <= 1.1
    low, high = mesh.space
    assert np.all(low <= mesh.nodes.min(0))
    assert np.all(mesh.nodes.max(0) <= high)
    fine = mesh.refined(3)
    assert len(fine.face) - 1 == 3 * (len(mesh.face) - 1)
    assert fine.nodes[fine.face][::3] == pytest.approx(face, abs=1e-15)


def test_equal_descriptions_are_one_mesh():
    for make in MESHES.values():
        assert make() == make()
        assert hash(make()) == hash(make())


@pytest.mark.parametrize("radius", [40e-3, -40e-3, np.inf])
def test_a_curved_block_has_an_arc_for_a_face(radius):
    """Of its height in the middle; without curvature it is the block."""
    edges = ("base", "left", "right")
    mesh = CurvedPadMesh(30e-3, 6e-3, 10, 2, radius=radius, bonded_edges=edges)
    face, (x, y) = mesh.nodes[mesh.face], mesh.nodes.T
    assert face[5] == pytest.approx([15e-3, 6e-3], abs=1e-15)
    assert np.array_equal(mesh.bonded, (y == 0) | (x == 0) | (x == 30e-3))
    if np.isfinite(radius):
        off = np.linalg.norm(face - [15e-3, 6e-3 - radius], axis=1)
        assert off == pytest.approx(np.full(11, 40e-3), rel=1e-13)
    else:
        plain = PadMesh(30e-3, 6e-3, 10, 2, bonded_sides=True)
        pads = [Pad(one, rubber()).compliance().detach() for one in (plain, mesh)]
        assert torch.allclose(*pads, rtol=1e-10)


def test_a_fingertip_is_half_a_disc():
    areas = []
    for around in (8, 16, 32):
        mesh = FingertipMesh(RADIUS, around)
        face = mesh.nodes[mesh.face]
        off = np.linalg.norm(face - [RADIUS, 0.0], axis=1)
        assert off == pytest.approx(np.full(around + 1, RADIUS), rel=1e-14)
        assert np.ptp(np.linalg.norm(np.diff(face, axis=0), axis=1)) < 1e-15
        assert np.array_equal(mesh.bonded, mesh.nodes[:, 1] == 0)
        ways = np.diff(mesh.nodes[mesh.elements[:, [0, 1, 2, 3, 0]]], axis=1)
        sides = np.linalg.norm(ways, axis=-1)
        assert (sides.max(1) / sides.min(1)).max() < 2.5
        areas.append(mesh.areas.sum())
    errors = 1 - np.array(areas) / (0.5 * np.pi * RADIUS**2)
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(np.full(2, 2.0), abs=0.02)


def test_taxels_share_every_force_between_them():
    """Side by side about the middle; a force at an end of them belongs to one by half."""
    pad = Pad(PadMesh(20e-3, 4e-3, 20, 2), rubber())
    shares = Taxels("pad", 5e-3, count=4).weights(pad).sum(0)
    assert shares.tolist() == [0.5, *[1.0] * 19, 0.5]


# compliance of fine meshes


def bump(middle: float, width: float) -> Callable[[Array], Array]:
    """A smooth pressure [Pa]."""
    return lambda x: np.exp(-(((x - middle) / width) ** 2))


ON_LAYER, ON_TIP = bump(0.02, 3e-3), bump(1.1 * RADIUS, 0.3 * RADIUS)
"""About as wide as the contact of a grasp and far from the layer's ends; beside the middle of a
fingertip."""


@cache
def work(mesh: Mesh, nu: float, pressure: Callable[[Array], Array]) -> float:
    """Work of a pressure downwards on the face with E = 1 and unit depth: scikit-fem, with full
    integration of biquadratic elements."""
    grid = MeshQuad(mesh.nodes.T, mesh.elements.T)
    element = ElementVector(ElementQuad2())
    sides = np.sort(np.stack((mesh.face[:-1], mesh.face[1:])), 0)
    face = [k for k, side in enumerate(grid.facets.T) if (side == sides.T).all(1).any()]
    basis = Basis(grid, element)
    facets = FacetBasis(grid, element, facets=np.array(face), intorder=10)
    lame_lambda, lame_mu = lame_moduli(1.0, nu)
    K = lame_lambda * dilatation.assemble(basis) + lame_mu * shear.assemble(basis)
    f = LinearForm(lambda v, w: -pressure(w.x[0]) * v[1]).assemble(facets)
    held = basis.get_dofs(lambda x: x[1] < 1e-12)
    return float(f @ solve(*condense(K, f, D=held)))


def pad_work(mesh: Mesh, nu: float, pressure: Callable[[Array], Array]) -> float:
    """The same by the massless pad, the pressure lumped to its nodes as contact forces are."""
    pad = Pad(mesh, KelvinVoigt(1.0, nu, 1.0, 1.0, depth=1.0))
    f = np.zeros((pad.nodes, 2))
    f[:, 1] = -pressure(pad.positions[:, 0].numpy()) * pad.mesh.tributary
    return float(f.ravel() @ pad.compliance().detach().numpy() @ f.ravel())


def layer(fineness: int) -> PadMesh:
    return PadMesh(0.04, 4.59e-3, 10 * fineness, fineness)


def tip(fineness: int) -> FingertipMesh:
    return FingertipMesh(RADIUS, 4 * fineness)


def test_a_nearly_incompressible_layer_does_not_lock():
    """Full integration misses 93 % of the work on 1 mm elements at nu = 0.4999."""
    reference = work(layer(12), 0.4999, ON_LAYER)
    assert abs(pad_work(layer(4), 0.4999, ON_LAYER) / reference - 1) < 0.02


@pytest.mark.parametrize(
    ("make", "pressure", "nu", "bound"),
    [(layer, ON_LAYER, 0.3, 1e-3), (layer, ON_LAYER, 0.49, 1e-3), (tip, ON_TIP, 0.49, 6e-3)],
    ids=["layer", "stiff layer", "fingertip"],
)
def test_work_converges_with_the_square_of_the_spacing(make, pressure, nu, bound):
    reference = work(make(24 if make is tip else 18), nu, pressure)
    errors = np.array([abs(pad_work(make(k), nu, pressure) / reference - 1) for k in (4, 8, 16)])
    order = np.log2(errors[:-1] / errors[1:])
    low, high = (1.7, np.inf) if make is tip else (1.9, 2.2)
    assert np.all((low < order) & (order < high))
    assert errors[-1] < bound


# files


GMSH = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
1 5 "base"
1 7 "face"
2 1 "rubber"
$EndPhysicalNames
$Entities
0 2 1 0
1 0 0 0 20 0 0 1 5 0
2 0 5 0 20 5 0 1 7 0
1 0 0 0 20 5 0 1 1 0
$EndEntities
$Nodes
1 6 1 6
2 1 0 6
1
2
3
4
5
6
0 0 0
10 0 0
20 0 0
0 5 0
10 5 0
20 5 0
$EndNodes
$Elements
3 6 1 6
1 1 1 2
1 1 2
2 2 3
1 2 1 2
3 5 6
4 4 5
2 1 3 2
5 1 2 5 4
6 2 3 6 5
$EndElements
"""

UNNAMED = GMSH[: GMSH.index("$PhysicalNames")] + GMSH[GMSH.index("$Entities") :].replace(
    "0 1 5 0\n", "0 0 1 1\n"
).replace("0 1 7 0\n", "0 0 1 1\n").replace("0 1 1 0\n", "0 0 2 1 2\n").replace(
    "0 2 1 0\n", "1 2 1 0\n1 0 0 0 0\n"
)  # fmt: skip
"""As gmsh saves it by default, without physical groups: curves have bounding points."""

DECK = """*NODE, NSET=ALL
1, 0.0, 0.0
2, 10.0, 0.0
3, 20.0, 0.0
4, 0.0, 5.0
5, 10.0, 5.0
6, 20.0, 5.0
*ELEMENT, TYPE={kind}, ELSET=RUBBER
1, 1, 2, 5, 4
2, 2, 3, 6, 5
*NSET, NSET=FACE
4, 5, 6
*NSET, NSET=BASE
1, 2, 3
"""


@pytest.mark.parametrize(
    ("name", "text", "edges"),
    [
        ("block.msh", GMSH, ("face", "base")),
        ("block.msh", UNNAMED, ("curve 2", "curve 1")),
        *((f"{kind}.inp", DECK.format(kind=kind), ("FACE", "BASE"))
          for kind in ("CPE4", "CPE4H", "CPE4RH", "CPS4")),
    ],
)  # fmt: skip
def test_edges_are_named_by_groups_curves_and_sets_of_nodes(tmp_path, name, text, edges):
    (tmp_path / name).write_text(text, encoding="ascii")
    mesh = QuadMesh.read(tmp_path / name, unit="cm", face=edges[0], bonded=[edges[1]])
    assert mesh.nodes[mesh.face] == pytest.approx(np.array([[0.0, 0.05], [0.1, 0.05], [0.2, 0.05]]))
    assert mesh.nodes[mesh.bonded][:, 1].tolist() == [0.0, 0.0, 0.0]


TRIANGLES = """*NODE
1, 0.0, 0.0
2, 1.0, 0.0
3, 0.0, 1.0
*ELEMENT, TYPE=CPE3
1, 1, 2, 3
"""


@pytest.mark.parametrize(
    ("name", "text", "options", "match"),
    [
        ("a.msh", GMSH, {"unit": "inch"}, "`unit` must be one of m, cm, mm, but is 'inch'"),
        ("a.msh", GMSH, {"face": "skin"}, "no edge `skin`; there are base, "),
        ("a.msh", GMSH, {"bonded": []}, "`bonded_sides` must be sides of quadrilaterals"),
        ("a.msh", GMSH, {"bonded": ["face"]}, "fewer than two points of the face are free"),
        ("a.msh", GMSH.replace("10 5 0\n", "10 5 1\n"), {}, "points in a plane of constant z"),
        ("a.inp", TRIANGLES, {}, "quadrilaterals with four points, but has triangle"),
        ("a.inp", DECK.format(kind="CAX4"), {}, "a.inp is not a mesh that can be read: .*CAX4"),
        ("a.mesh2", "no mesh", {}, "a.mesh2 is not a mesh that can be read"),
        ("a.msh", GMSH[:300], {}, "a.msh is not a mesh that can be read"),
    ],
)  # fmt: skip
def test_files_that_are_no_pads_are_rejected(tmp_path, name, text, options, match):
    (tmp_path / name).write_text(text, encoding="ascii")
    with pytest.raises(ValueError, match=match):
        QuadMesh.read(tmp_path / name, **{"unit": "mm"} | options)


def test_elements_too_slender_to_be_computed_with_are_rejected():
    with pytest.raises(ValueError, match=r"elements of 5e-08 m by 10 m are too slender"):
        PadMesh(1e-6, 10.0, 20, 1)
    PadMesh(1.0, 1e-3, 20, 1)


def test_a_pad_is_made_again_of_its_description():
    """With its material, place and ratios; of a material of one's own the relaxed stiffness."""

    class Own(KelvinVoigt):
        pass

    mesh = PadMesh(8e-3, 4e-3, 4, 2)
    for material in (Own(**RUBBER, tau=0.01), *map(made, MATERIALS)):
        pad = Pad(mesh, material, base="hand", origin=(1e-3, 2e-3), angle=0.3, mirrored=True,
                  points=2, E_ratio=1.2)  # fmt: skip
        again = Pad.again(pad.described(), mesh)
        assert again.described() == pad.described()
        assert torch.equal(again.point_positions, pad.point_positions)
        u = np.random.default_rng(0).normal(scale=1e-5, size=(pad.nodes, 2))
        whole = pad.displacement(u)
        assert np.array_equal(again.stress(whole), pad.stress(whole))
        if type(material) is Own:
            with pytest.raises(NotImplementedError):
                again.chain()
        else:
            assert all(map(torch.equal, again.chain(), pad.chain()))
