"""Shapes of rigid bodies against boundaries that are written down here, closed forms, differences
and each other."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import torch
from conftest import f64, rest, still, times
from matplotlib.path import Path as Polygon
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline
from scipy.optimize import minimize_scalar
from torch import Tensor, nn

from torchsoft import (
    Body,
    Circle,
    Contour,
    Eccentric,
    Ellipse,
    RigFile,
    RoundedBox,
    RoundedPolygon,
    Shape,
    Superellipse,
)
from torchsoft.physics.shapes.shape import moments
from torchsoft.physics.validity import check_shape

Array = NDArray[np.float64]
Boundary = Callable[[Array], Array]
"""Points (n, 2) [m] of a boundary, anticlockwise, of parameters (n,) from 0 to 1."""

BAND = 5e-4
"""How deep [m] contacts go, and from how far their shapes are asked."""

ANGLED = [[0.0, 0.0], [40e-3, 0.0], [40e-3, 14e-3], [16e-3, 14e-3], [16e-3, 34e-3], [0.0, 34e-3]]
TRIANGLE = [[-12e-3, -9e-3], [19e-3, -9e-3], [-12e-3, 18e-3]]


def pear(count: int = 60) -> Array:
    """Points around a smooth contour that is hollow on three sides."""
    t = np.arange(count) * 2 * np.pi / count
    r = 18e-3 * (1 + 0.12 * np.cos(3 * t) + 0.05 * np.sin(2 * t))
    return np.stack((r * np.cos(t), r * np.sin(t)), -1)


def superellipse(a: float, b: float, n: float) -> Boundary:
    def at(s: Array) -> Array:
        way = np.stack((np.cos(2 * np.pi * s), np.sin(2 * np.pi * s)), -1)
        return way / ((np.abs(way / [a, b]) ** n).sum(-1, keepdims=True)) ** (1 / n)

    return at


def rounded(vertices: list[list[float]], radius: float) -> Boundary:
    """Arcs and sides in turn, by their lengths; an arc's centre is where the lines meet that are
    its radius away from both sides."""
    v = np.array(vertices)
    ways = (np.roll(v, -1, 0) - v) / np.linalg.norm(np.roll(v, -1, 0) - v, axis=1)[:, None]
    centre, first, turn = np.empty_like(v), np.empty(len(v)), np.empty(len(v))
    for i, (corner, before, after) in enumerate(zip(v, np.roll(ways, 1, 0), ways)):
        bulge = np.sign(before[0] * after[1] - before[1] * after[0])
        inwards = [bulge * radius * np.array([-w[1], w[0]]) for w in (before, after)]
        along = np.linalg.solve(np.stack((before, -after), -1), inwards[1] - inwards[0])
        centre[i] = corner + inwards[0] + along[0] * before
        angles = [np.arctan2(-y, -x) for x, y in inwards]
        first[i], turn[i] = angles[0], bulge * ((bulge * (angles[1] - angles[0])) % (2 * np.pi))

    def arc(i: Array, part: Array) -> Array:
        angle = first[i] + part * turn[i]
        return centre[i] + radius * np.stack((np.cos(angle), np.sin(angle)), -1)

    every = np.arange(len(v))
    begin, end = arc(every, np.ones(len(v))), arc((every + 1) % len(v), np.zeros(len(v)))
    lengths = np.stack((radius * np.abs(turn), np.linalg.norm(end - begin, axis=1)), -1)
    before = np.concatenate(([0.0], np.cumsum(lengths)))

    def at(s: Array) -> Array:
        way = (s % 1.0) * before[-1]
        k = np.searchsorted(before, way, side="right") - 1
        i, part = k // 2, (way - before[k]) / lengths.ravel()[k]
        return np.where(
            (k % 2 == 0)[:, None], arc(i, part), begin[i] + part[:, None] * (end - begin)[i]
        )

    return at


def spline(control: Array) -> Boundary:
    count = len(control)
    curve = BSpline(
        np.arange(-3.0, count + 4), np.concatenate((control[-1:], control, control[:2])), 3
    )
    return lambda s: curve((s % 1.0) * count)


def box(a: float, b: float) -> list[list[float]]:
    return [[-a, -b], [a, -b], [a, b], [-a, b]]


@cache
def contour() -> Contour:
    return Contour(pear())


def centred(boundary: Boundary) -> tuple[Boundary, Array]:
    """The boundary about the centre of mass of a polygon of very many of its points, and that
    centre."""
    x = boundary(np.arange(200_000) / 200_000)
    cross = x[:, 0] * np.roll(x[:, 1], -1) - x[:, 1] * np.roll(x[:, 0], -1)
    centre = ((x + np.roll(x, -1, 0)) * cross[:, None]).sum(0) / (3 * cross.sum())
    return lambda s: boundary(s) - centre, centre


CASES: dict[str, tuple[Callable[[], Shape], Callable[[], Boundary]]] = {
    "ellipse": (lambda: Ellipse(20e-3, 12e-3), lambda: superellipse(20e-3, 12e-3, 2.0)),
    "squircle": (lambda: Superellipse(20e-3, 14e-3, 4.0), lambda: superellipse(20e-3, 14e-3, 4.0)),
    "nearly an ellipse": (
        lambda: Superellipse(12e-3, 20e-3, 2.3),
        lambda: superellipse(12e-3, 20e-3, 2.3),
    ),
    "nearly a box": (
        lambda: Superellipse(20e-3, 20e-3, 20.0),
        lambda: superellipse(20e-3, 20e-3, 20.0),
    ),
    "box": (lambda: RoundedBox(20e-3, 9e-3, 2e-3), lambda: rounded(box(20e-3, 9e-3), 2e-3)),
    "stadium": (
        lambda: RoundedBox(20e-3, 9e-3, 9e-3),
        lambda: rounded(box(20e-3, 9e-3), 8.999999999e-3),
    ),
    "triangle": (lambda: RoundedPolygon(TRIANGLE, 3e-3), lambda: rounded(TRIANGLE, 3e-3)),
    "angle": (lambda: RoundedPolygon(ANGLED[::-1], 2e-3), lambda: rounded(ANGLED, 2e-3)),
    "pear": (contour, lambda: spline(contour().control.detach().numpy())),
}


@cache
def known(name: str) -> tuple[Shape, Boundary]:
    """A shape, and its boundary about the same centre."""
    shape, boundary = (made() for made in CASES[name])
    return shape, centred(boundary)[0]


@pytest.fixture(params=CASES)
def case(request):
    return known(request.param)


def near(boundary: Boundary, count: int, band: float, seed: int = 0) -> Array:
    """Places up to `band` from the boundary, on both sides."""
    rng = np.random.default_rng(seed)
    return boundary(rng.random(count)) + band * rng.uniform(-0.7, 0.7, (count, 2))


def distance(boundary: Boundary, x: Array) -> float:
    """Signed distance: the nearest of many points, looked at again in between; inside by the
    polygon of these points."""
    s = np.arange(2000) / 2000
    dense = boundary(s)
    away = np.linalg.norm(dense - x, axis=1)
    found = []
    for k in np.argsort(away)[:4]:
        f = lambda t: float(np.linalg.norm(boundary(np.array([t]))[0] - x))
        found.append(
            minimize_scalar(
                f, bounds=(s[k] - 1e-3, s[k] + 1e-3), method="bounded", options={"xatol": 1e-12}
            ).fun
        )
    return min(found) * (-1 if Polygon(dense).contains_point(x) else 1)


@torch.no_grad()
def test_distance_is_that_of_the_nearest_point(case):
    """In the band of contacts, and far outside, where a run looks for what may touch."""
    shape, boundary = case
    for band, count in ((BAND, 40), (20e-3, 20)):
        x = near(boundary, count, band)
        expected = f64(*(distance(boundary, one) for one in x))
        which = expected > (-torch.inf if band == BAND else 0.0)
        phi = shape(torch.from_numpy(x))[0]
        assert int(which.sum()) > 5
        assert float((phi - expected)[which].abs().max()) < 1e-9


def test_normals_are_the_slopes_of_distances(case):
    shape, boundary = case
    x, h = torch.from_numpy(near(boundary, 200, BAND)), 1e-6
    with torch.no_grad():
        n = shape(x)[1]
        ways = torch.eye(2, dtype=torch.float64)
        slope = torch.stack(
            [(shape(x + h * way)[0] - shape(x - h * way)[0]) / (2 * h) for way in ways], -1
        )
    assert torch.allclose(n.norm(dim=-1), torch.ones(200).double(), rtol=0, atol=1e-14)
    assert (
        float((n - slope).abs().max()) < 1e-6
    )  # where an arc begins differences are of first order
    assert float((n - slope).abs().median()) < 1e-9


def turning(boundary: Boundary, s: Array, h: float = 1e-5) -> tuple[Array, Array]:
    """Outward normals (n, 2) and curvature (n,) [1/m] from differences along the boundary."""
    before, here, after = boundary(s - h), boundary(s), boundary(s + h)
    (x, y), (bend_x, bend_y) = (
        ((after - before) / (2 * h)).T,
        ((after - 2 * here + before) / h**2).T,
    )
    speed = np.hypot(x, y)
    return np.stack((y, -x), -1) / speed[:, None], (x * bend_y - y * bend_x) / speed**3


def test_curvature_is_that_of_the_boundary(case):
    shape, boundary = case
    s = 0.013 + np.arange(50) / 50
    normal, expected = turning(boundary, s)
    size = shape.size()
    for depth in (0.0, -2e-4, 2e-4):
        kappa = shape.curvature(torch.from_numpy(boundary(s) + depth * normal))
        assert np.abs(kappa.numpy() - expected).max() * size < 2e-3
        assert np.median(np.abs(kappa.numpy() - expected)) * size < 2e-5


# --- limits
# ----------------------------------------------------------------------

R = 19.37e-3
HEXAGON = [
    [R / np.cos(np.pi / 6) * np.cos(k * np.pi / 3), R / np.cos(np.pi / 6) * np.sin(k * np.pi / 3)]
    for k in range(6)
]
ROUND = {
    "superellipse": lambda: Superellipse(R, R, 2.0),
    "box": lambda: RoundedBox(R, R, R),
    "square": lambda: RoundedPolygon(box(R, R), R),
    "hexagon": lambda: RoundedPolygon(HEXAGON, R),
    "contour": lambda: Contour(
        R * np.stack([f(np.arange(480) * np.pi / 240) for f in (np.cos, np.sin)], -1),
        tolerance=1e-10,
    ),
}


@torch.no_grad()
@pytest.mark.parametrize("name", ROUND)
def test_full_rounding_is_the_circle(name):
    shape, circle = ROUND[name](), Circle(R)
    assert shape.well_posed() == ""
    x = torch.from_numpy(near(superellipse(R, R, 2.0), 300, 2e-3))
    for mine, its in zip(shape(x), circle(x)):
        assert float((mine - its).abs().max()) < (1e-9 if its.ndim == 1 else 1e-6)
    assert float(shape.area()) == pytest.approx(float(circle.area()), rel=1e-8)
    assert float(shape.gyration()) == pytest.approx(float(circle.gyration()), rel=1e-8)
    way = nn.functional.normalize(torch.from_numpy(near(superellipse(R, R, 2.0), 50, 0.0)), dim=-1)
    assert torch.allclose(shape.support(way), circle.support(way), rtol=0, atol=1e-9)
    assert float((shape.curvature(x) * R - 1).abs().max()) < 1e-3


@torch.no_grad()
@pytest.mark.parametrize(
    ("one", "other"),
    [
        (
            lambda: RoundedPolygon(np.array(ANGLED) + [3.0, -2.0], 2e-3),
            lambda: RoundedPolygon(ANGLED[::-1], 2e-3),
        ),
        (
            lambda: Contour(pear(200)[::-1] - [0.5, 0.2], tolerance=1e-8),
            lambda: Contour(pear(200), tolerance=1e-8),
        ),
    ],
)
def test_two_ways_to_one_body(one, other):
    """Whatever the class, the order of the points, and the point that they are given about."""
    one, other = one(), other()
    x = torch.rand(300, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 30e-3
    outside = other(x)[0] > -1e-3
    for mine, its in zip(one(x), other(x)):
        assert float((mine - its)[outside].abs().max()) < 1e-9
    for quantity in ("area", "gyration"):
        assert float(getattr(one, quantity)()) == pytest.approx(
            float(getattr(other, quantity)()), rel=1e-9
        )
    assert one.size() == pytest.approx(other.size(), rel=1e-9)


# --- area, centre of mass, inertia
# ----------------------------------------------------------------------


@torch.no_grad()
def test_moments_are_those_of_the_boundary(case):
    shape, boundary = case
    x = boundary((np.arange(400_000) + 0.5) / 400_000)
    y = np.roll(x, -1, 0)
    of = moments(torch.from_numpy(0.5 * (x + y)), torch.from_numpy(y - x))
    assert float(shape.area()) == pytest.approx(float(of.area), rel=1e-8)
    assert float(shape.gyration()) == pytest.approx(float(of.gyration), rel=1e-8)
    assert float(of.centre.abs().max()) < 1e-9


def test_moments_by_green_are_those_of_a_disc():
    t = torch.arange(40, dtype=torch.float64) * torch.pi / 20
    circle = torch.stack((t.cos(), t.sin()), -1)
    of = moments(
        0.3 * circle + f64(5.0, -7.0), 0.3 * torch.pi / 20 * torch.stack((-t.sin(), t.cos()), -1)
    )
    assert float(of.area) == pytest.approx(0.09 * np.pi, rel=1e-13)
    assert torch.allclose(of.centre, f64(5.0, -7.0), rtol=1e-14)
    assert float(of.gyration) == pytest.approx(0.045, rel=1e-11)


def test_a_uniform_body_has_mass_and_inertia_of_its_shape():
    body = Body.uniform(RoundedBox(20e-3, 10e-3, 1e-12), density=7800.0, depth=44e-3, theta=0.0)
    mass = body.mass.item()
    assert mass == pytest.approx(7800 * 44e-3 * 40e-3 * 20e-3, rel=1e-12)
    assert body.inertia.item() == pytest.approx(mass * (40e-3**2 + 20e-3**2) / 12, rel=1e-12)
    assert body.freedom["theta"] == "fixed"
    (slope,) = torch.autograd.grad(body.inertia, body.shape.half_width)
    assert float(slope) == pytest.approx(mass * 2 * 20e-3 / 3, rel=1e-9)


@torch.no_grad()
def test_support_outline_and_size_are_the_bodys(case):
    shape, boundary = case
    x = torch.from_numpy(boundary(np.arange(100_000) / 100_000))
    angle = times(6.2, 40)
    way = torch.stack((angle.cos(), angle.sin()), -1)
    assert float((shape.support(way) - (way @ x.mT).amax(-1)).abs().max()) < 1e-8
    assert shape.size() == pytest.approx(float(x.norm(dim=-1).max()), rel=1e-4)
    outline = shape.outline()
    assert float(shape(outline)[0].abs().max()) < 1e-9
    assert float((outline @ way.mT).amax(0).sub(shape.support(way)).abs().max()) < 1e-3
    if not isinstance(
        shape, RoundedPolygon
    ):  # whose inner corner is grazed by the rays that look for the boundary
        check_shape("body", shape_of_another(shape))


def shape_of_another(shape: Shape) -> Shape:
    """The same shape as somebody's own, which a run tries before it uses it."""

    class Own(Shape):
        def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
            return shape(x)

        def support(self, direction: Tensor) -> Tensor:
            return shape.support(direction)

    return Own()


# --- derivatives
# ----------------------------------------------------------------------


def test_derivatives_are_those_of_differences(case):
    """Of distance and normal by the place and by each of the parameters, along a direction."""
    shape, boundary = case
    generator = torch.Generator().manual_seed(2)
    own = {name: p.detach() for name, p in shape.named_parameters()} | {
        "x": torch.from_numpy(near(boundary, 30, BAND, 3))
    }
    for name, p in own.items():
        way = torch.randn(p.shape, generator=generator, dtype=torch.float64) * (
            1.0 if name == "n" else 1e-3
        )

        def value(by: Tensor, name: str = name, p: Tensor = p, way: Tensor = way) -> Tensor:
            moved = own | {name: p + by * way}
            phi, n = torch.func.functional_call(
                shape, {k: v for k, v in moved.items() if k != "x"}, (moved["x"],)
            )
            return torch.cat((1e2 * phi[:, None], n), -1)

        slope = torch.autograd.functional.jvp(value, f64(0.0)[0], f64(1.0)[0])[1]
        fine, coarse = ((value(f64(h)[0]) - value(f64(-h)[0])) / (2 * h) for h in (5e-4, 1e-3))
        expected = (4 * fine - coarse) / 3
        error = (slope - expected).abs().amax(-1) / expected.abs().max()
        assert float(error.median()) < 1e-8, name
        assert int((error > 1e-6).sum()) <= 2, (
            name
        )  # of thirty points, some come from a side onto an arc


COARSE = {"pad.elements_x": 60, "pad.elements_y": 3}


# --- what is refused, and what is said
# ----------------------------------------------------------------------


def test_control_points_that_were_spoilt_are_refused():
    shape = Contour(pear())
    with torch.no_grad():
        shape.control[3] *= 3.0
    with pytest.raises(ValueError, match="so sharp, or so narrow"):
        rest(still(COARSE, shape=shape))


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-8])
def test_a_contour_follows_the_spline_through_its_points(tolerance):
    shape, closed = Contour(pear(), tolerance=tolerance), np.concatenate((pear(), pear()[:1]))
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    dense = CubicSpline(way, closed, bc_type="periodic")(np.linspace(0, way[-1], 3000))
    with torch.no_grad():
        off = shape(torch.from_numpy(dense) - shape.moments().centre)[0].abs().max().item()
    assert off <= 1.1 * shape.residual <= 1.1 * tolerance
    assert off > 0.5 * shape.residual


def test_a_contour_from_a_file(tmp_path):
    file, points = tmp_path / "pear.csv", pear()
    file.write_text(
        "y [cm], x [mm]\n" + "".join(f"{1e2 * y},{1e3 * x}\n\n" for x, y in points),
        encoding="utf-8",
    )
    shape = Contour.from_csv(file)
    assert torch.allclose(shape.control, Contour(points).control, rtol=0, atol=1e-12)
    assert shape.residual < 1e-6
    for text, match in (
        ("", "is empty: the columns must be `x .mm.` and `y .mm.`, in m, cm or mm"),
        ("x [mm],y [in]\n1,2\n", "column `y` cannot be in 'in'; it can be in m, cm, mm"),
        ("x [mm],y [mm],z [mm]\n1,2,3\n", "column `z` is not known: the columns must be"),
        ("x [mm],y [mm]\n1,\n", "row 2 has an empty cell"),
        ("x [mm],y [mm]\n1,2\n", r"pear.csv: `points` must be at least 8 places"),
    ):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=match):
            Contour.from_csv(file)


def test_a_centre_of_mass_off_the_origin_is_told(caplog):
    RoundedPolygon(box(20e-3, 9e-3), 2e-3)
    ROUND["contour"]()
    assert caplog.text == ""
    RoundedPolygon(np.array(box(20e-3, 9e-3)) + [0.5, 0.25], 2e-3)
    assert (
        "the centre of mass is at (0.5, 0.25) m of `vertices`: the body's pose is that of this "
        "point" in caplog.text
    )


def test_an_object_that_its_pads_would_turn_is_told_of():
    wedge = RoundedPolygon([[-20e-3, -10e-3], [20e-3, -10e-3], [20e-3, 10e-3], [-20e-3, 0.0]], 2e-3)
    with pytest.warns(
        UserWarning,
        match=r"`disc` is held at theta = 0, where the pads turn it with -?[\d.e-]+ N.m",
    ):
        rest(still(COARSE, shape=wedge))


def test_a_body_of_a_file_that_its_pad_would_turn_is_told_of():
    tilted = {"pads.ground.angle": 0.2, "bodies.ellipse.start": {"x": 0.06, "y": "rest"}}
    with pytest.warns(UserWarning, match="`ellipse` is held at theta = 0, where the pads turn it"):
        RigFile.ready("drop").override(tilted).build()


def test_a_long_box_rests_on_its_whole_side():
    model = still(COARSE, shape=RoundedBox(30e-3, 5e-3, 1e-3))
    state = model.unpack(rest(model).detach())
    g = model.penetration("L", state)
    x = model.pads["L"].positions[:, 0] - state.pose["disc"][0]
    assert torch.equal(g > 0, x.abs() < 29.5e-3)
    assert float(state.pads["L"][0, :, 1].sum()) == pytest.approx(
        -float(model.bodies["disc"].mass.detach()) * 9.81, rel=1e-9
    )


# A centre of mass off that of the area

ECCENTRIC = {
    "bodies": {"disc": {
        "mass": 0.4, "inertia": 8e-5, "shape": {"kind": "circle", "radius": 19e-3},
        "centre_y": -4e-3, "start": {"x": 60e-3, "y": "rest", "theta": 0.05},
    }},
    "materials": {"gel": {
        "kind": "kelvin_voigt", "E": 1e6, "nu": 0.45, "tau": 1e-4, "depth": 40e-3,
    }},
    "pads": {"ground": {
        "material": "gel", "length": 120e-3, "height": 12e-3, "elements_x": 240, "elements_y": 8,
    }},
    "laws": {"dry": {
        "K_n": 1e6, "R_n": 20.0, "K_t": 1e6, "R_t": 20.0,
        "friction": {"kind": "smooth", "mu_s": 0.8, "mu_k": 0.7, "v_s": 50e-3},
    }},
    "contacts": {"ground": {"pad": "ground", "body": "disc", "law": "dry"}},
    "outputs": {"duration": 0.9, "interval": 2e-3},
}  # fmt: skip
"""A disc with its centre of mass below that of its area, which rocks on a pad."""


def test_an_eccentric_shape_is_its_contour_moved() -> None:
    box, c = RoundedBox(20e-3, 9e-3, 2e-3), f64([3e-3, -1e-3])
    moved = Eccentric(box, 3e-3, -1e-3)
    x = 25e-3 * torch.randn(200, 2, generator=torch.Generator().manual_seed(0)).double()
    for own, others in zip(moved(x), box(x + c)):
        assert torch.equal(own, others)
    way = f64([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    assert moved.support(way).flatten().tolist() == pytest.approx([17e-3, 10e-3, 23e-3, 8e-3])
    assert moved.size() == pytest.approx(float(moved.outline(2001).norm(dim=-1).max()), rel=1e-3)
    free = Eccentric(contour(), 1e-3, 0.0)  # whose law is compiled from another shape
    assert torch.allclose(free(x)[0], contour()(x + f64([1e-3, 0.0]))[0], atol=1e-12)
    assert torch.equal(free.prepared()(x)[0], free(x)[0])


def test_an_eccentric_disc_rocks_like_a_pendulum() -> None:
    built = RigFile.from_tree(ECCENTRIC).build()
    run = built.run(rtol=1e-5, gradient="discrete")
    theta, t = run["theta_disc"].detach().numpy(), run.t.numpy()
    down = np.flatnonzero((theta[:-1] > 0) & (theta[1:] <= 0))
    period = np.diff(
        t[down] + (t[down + 1] - t[down]) * theta[down] / (theta[down] - theta[down + 1])
    )
    m, e, R, J, g = 0.4, 4e-3, 19e-3, 8e-5, 9.81
    assert period == pytest.approx(
        2 * np.pi * np.sqrt((J + m * (R - e) ** 2) / (m * g * e)), rel=0.01
    )
    names = "bodies.disc.centre_x", "bodies.disc.centre_y"
    values = [built.rig.parameter(name) for name in names]
    got = torch.autograd.grad(run["theta_disc"][100], values)
    for name, value, slope in zip(names, values, got):
        ends = []
        for h in (-1e-9, 1e-9):
            with torch.no_grad():
                value += h
                ends.append(float(built.run(knots=run.knots)["theta_disc"][100]))
                value -= h
        assert float(slope) == pytest.approx((ends[1] - ends[0]) / 2e-9, rel=1e-5), name


def test_a_centre_of_mass_needs_a_shape() -> None:
    tree = {**ECCENTRIC, "contacts": {}, "pads": {}, "bodies": {"a": {
        "mass": 1.0, "theta": 0.0, "centre_x": 1e-3, "start": {"x": 0.0, "y": 0.0},
    }}}  # fmt: skip
    with pytest.raises(ValueError, match="have no meaning without a shape"):
        RigFile.from_tree(tree)
