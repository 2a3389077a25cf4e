"""What every shape guarantees, against boundaries written down here: signed distance, unit normals,
curvature, moments, support and gradients."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import torch
from conftest import COARSE, f64, rest, still
from matplotlib.path import Path as Polygon
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline

from torchsoft import (
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

Array = NDArray[np.float64]
Boundary = Callable[[Array], Array]
"""Points (n, 2) [m] of a boundary, anticlockwise, of parameters (n,) of period 1."""

BAND = 5e-4
"""Depth of contacts [m], and the distance from which shapes are evaluated."""

ANGLED = [[0.0, 0.0], [40e-3, 0.0], [40e-3, 14e-3], [16e-3, 14e-3], [16e-3, 34e-3], [0.0, 34e-3]]
TRIANGLE = [[-12e-3, -9e-3], [19e-3, -9e-3], [-12e-3, 18e-3]]
R = 19.37e-3
TAU = 2 * np.pi


def pear(count: int = 60) -> Array:
    """Points around a smooth contour that is hollow on three sides."""
    t = np.arange(count) * TAU / count
    r = 18e-3 * (1 + 0.12 * np.cos(3 * t) + 0.05 * np.sin(2 * t))
    return np.stack((r * np.cos(t), r * np.sin(t)), -1)


def superellipse(a: float, b: float, n: float) -> Boundary:
    def at(s):
        way = np.stack((np.cos(TAU * s), np.sin(TAU * s)), -1)
        return way / ((np.abs(way / [a, b]) ** n).sum(-1, keepdims=True)) ** (1 / n)

    return at


def rounded(vertices: list[list[float]], radius: float) -> Boundary:
    """Arcs and sides in turn, by their lengths, as complex numbers."""
    v = np.array(vertices) @ [1, 1j]
    after = np.roll(v, -1) - v
    after /= abs(after)
    before = np.roll(after, 1)
    turn = np.angle(after / before)
    trim = radius * np.tan(abs(turn) / 2)
    begin, end = v - trim * before, v + trim * after
    centre, sides = begin + 1j * np.sign(turn) * radius * before, np.roll(begin, -1) - end
    lengths = np.stack((radius * abs(turn), abs(sides)), -1).ravel()
    start = np.concatenate(([0.0], np.cumsum(lengths)))

    def at(s):
        way = (s % 1.0) * start[-1]
        k = np.searchsorted(start, way, side="right") - 1
        i, part = k // 2, (way - start[k]) / lengths[k]
        arc = centre[i] + (begin - centre)[i] * np.exp(1j * turn[i] * part)
        z = np.where(k % 2 == 0, arc, end[i] + part * sides[i])
        return np.stack((z.real, z.imag), -1)

    return at


def spline(control: Array) -> Boundary:
    count = len(control)
    around = np.concatenate((control[-1:], control, control[:2]))
    curve = BSpline(np.arange(-3.0, count + 4), around, 3)
    return lambda s: curve((s % 1.0) * count)


def box(a: float, b: float) -> list[list[float]]:
    return [[-a, -b], [a, -b], [a, b], [-a, b]]


@cache
def contour() -> Contour:
    """Given clockwise, and about a point far outside."""
    return Contour(pear()[::-1] - [0.5, 0.2])


CONTROL = lambda: spline(contour().control.detach().numpy())

# A new shape is one line: how it is made, and its boundary, about any point.
CASES = {
    "circle": (lambda: Circle(R), lambda: superellipse(R, R, 2.0)),
    "ellipse": (lambda: Ellipse(20e-3, 12e-3), lambda: superellipse(20e-3, 12e-3, 2.0)),
    "squircle": (lambda: Superellipse(20e-3, 14e-3, 4.0), lambda: superellipse(20e-3, 14e-3, 4.0)),
    "nearly an ellipse": (
        lambda: Superellipse(12e-3, 20e-3, 2.3), lambda: superellipse(12e-3, 20e-3, 2.3)
    ),
    "nearly a box": (
        lambda: Superellipse(20e-3, 20e-3, 20.0), lambda: superellipse(20e-3, 20e-3, 20.0)
    ),
    "box": (lambda: RoundedBox(20e-3, 9e-3, 2e-3), lambda: rounded(box(20e-3, 9e-3), 2e-3)),
    "stadium": (
        lambda: RoundedBox(20e-3, 9e-3, 9e-3), lambda: rounded(box(20e-3, 9e-3), 8.999999999e-3)
    ),
    "triangle": (lambda: RoundedPolygon(TRIANGLE, 3e-3), lambda: rounded(TRIANGLE, 3e-3)),
    "angle, clockwise": (
        lambda: RoundedPolygon(np.array(ANGLED)[::-1] + [3.0, -2.0], 2e-3),
        lambda: rounded(ANGLED, 2e-3),
    ),
    "pear": (contour, CONTROL),
    "eccentric pear": (lambda: Eccentric(contour(), 3e-3, -1e-3), CONTROL),
}  # fmt: skip


def polygon_moments(x: Array) -> tuple[float, Array, float]:
    """Area, centre and squared radius of gyration of the polygon through points x (n, 2)."""
    x, middle = x - x.mean(0), x.mean(0)
    y = np.roll(x, -1, 0)
    cross = x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]
    centre = ((x + y) * cross[:, None]).sum(0) / (3 * cross.sum())
    square = (cross * (x * x + x * y + y * y).sum(-1)).sum() / (6 * cross.sum())
    return 0.5 * cross.sum(), centre + middle, square - (centre**2).sum()


@cache
def known(name: str) -> tuple[Shape, Boundary, Array]:
    """A shape, its boundary about its centre of mass, and many points of that."""
    shape, boundary = (made() for made in CASES[name])
    dense = boundary(np.arange(100_000) / 100_000)
    centre = polygon_moments(dense)[1] + (
        shape.centre.detach().numpy() if isinstance(shape, Eccentric) else 0.0
    )
    return shape, lambda s: boundary(s) - centre, dense - centre


@pytest.fixture(params=CASES)
def case(request):
    return known(request.param)


def near(boundary: Boundary, count: int, band: float, seed: int = 0) -> Array:
    """Places up to `band` from the boundary, on both sides."""
    rng = np.random.default_rng(seed)
    return boundary(rng.random(count)) + band * rng.uniform(-0.7, 0.7, (count, 2))


def distance(boundary: Boundary, x: Array) -> Array:
    """Signed distances (n,): the nearest of many points, refined; inside by their polygon."""
    s = np.arange(4000) / 4000
    dense = boundary(s)
    best = s[np.linalg.norm(x[:, None] - dense, axis=-1).argmin(1)]
    for level in range(7):
        tried = best[:, None] + np.linspace(-1, 1, 21) / 4000 / 8**level
        off = np.linalg.norm(boundary(tried.ravel()).reshape(*tried.shape, 2) - x[:, None], axis=-1)
        best = np.take_along_axis(tried, off.argmin(1)[:, None], 1)[:, 0]
    return off.min(1) * np.where(Polygon(dense).contains_points(x), -1, 1)


@torch.no_grad()
def test_phi_is_the_signed_distance_to_the_nearest_point(case):
    """In the band of contacts, and far outside, where a run looks for touching bodies."""
    shape, boundary, _ = case
    for band, count in ((BAND, 60), (20e-3, 40)):
        x = near(boundary, count, band)
        expected = distance(boundary, x)
        judged = (expected > 0) | (band == BAND)
        phi = shape(torch.from_numpy(x))[0].numpy()
        assert judged.sum() > 10
        assert np.abs(phi - expected)[judged].max() < 1e-9


def test_normals_are_unit_slopes_of_the_distance_and_derivatives_are_those_of_differences(case):
    """With respect to the place and to each parameter, along a direction."""
    shape, boundary, _ = case
    generator = torch.Generator().manual_seed(2)
    x = torch.from_numpy(near(boundary, 200, BAND, 1)).requires_grad_()
    phi, n = shape(x)
    assert torch.allclose(torch.autograd.grad(phi.sum(), x)[0], n, rtol=0, atol=1e-12)
    assert torch.allclose(n.norm(dim=-1), torch.ones(200).double(), rtol=0, atol=1e-14)
    given = {name: p.detach() for name, p in shape.named_parameters()}
    given["x"] = torch.from_numpy(near(boundary, 30, BAND, 3))
    for name, p in given.items():
        way = torch.randn(p.shape, generator=generator, dtype=torch.float64)
        way = way * (1.0 if name == "n" else 1e-3)

        def value(by, name=name, p=p, way=way):
            moved = given | {name: p + by * way}
            where = moved.pop("x")
            phi, n = torch.func.functional_call(shape, moved, (where,))
            return torch.cat((1e2 * phi[:, None], n), -1)

        slope = torch.autograd.functional.jvp(value, f64(0.0)[0], f64(1.0)[0])[1]
        expected = (value(f64(1e-4)[0]) - value(f64(-1e-4)[0])) / 2e-4
        error = (slope - expected).abs().amax(-1) / expected.abs().max()
        assert float(error.median()) < 1e-7, name
        assert int((error > 1e-5).sum()) <= 2, name  # a few points move from a side onto an arc


def test_curvature_is_that_of_the_boundary(case):
    shape, boundary, _ = case
    s, h = 0.013 + np.arange(50) / 50, 1e-5
    before, here, after = (boundary(s + by) for by in (-h, 0.0, h))
    (x, y), (bend_x, bend_y) = (
        ((after - before) / (2 * h)).T,
        ((after - 2 * here + before) / h**2).T,
    )
    speed = np.hypot(x, y)
    normal, expected = np.stack((y, -x), -1) / speed[:, None], (x * bend_y - y * bend_x) / speed**3
    for depth in (0.0, -2e-4, 2e-4):
        kappa = shape.curvature(torch.from_numpy(here + depth * normal)).numpy()
        assert np.abs(kappa - expected).max() * shape.size() < 2e-3
        assert np.median(np.abs(kappa - expected)) * shape.size() < 2e-5


@torch.no_grad()
def test_moments_support_size_and_outline_are_those_of_the_boundary(case):
    shape, _, dense = case
    area, centre, gyration = polygon_moments(dense)
    assert float(shape.area()) == pytest.approx(area, rel=1e-8)
    assert float(shape.gyration()) == pytest.approx(gyration, rel=1e-8)
    off = shape.centre.numpy() if isinstance(shape, Eccentric) else 0.0
    assert np.abs(centre + off).max() < 1e-9
    angle = torch.linspace(0.0, 6.2, 40, dtype=torch.float64)
    x, way = torch.from_numpy(dense), torch.stack((angle.cos(), angle.sin()), -1)
    assert float((shape.support(way) - (way @ x.mT).amax(-1)).abs().max()) < 1e-8
    assert shape.size() == pytest.approx(float(x.norm(dim=-1).max()), rel=1e-4)
    outline = shape.outline()
    assert float(shape(outline)[0].abs().max()) < 1e-9
    assert float((outline @ way.mT).amax(0).sub(shape.support(way)).abs().max()) < 1e-3


@torch.no_grad()
def test_a_prepared_shape_is_the_shape(case):
    shape, boundary, _ = case
    x = torch.from_numpy(near(boundary, 20, BAND))
    for given, expected in zip(shape.prepared()(x[:, None]), shape(x)):
        assert torch.equal(given[:, 0], expected)


# contours through points


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8])
def test_a_contour_follows_the_spline_through_its_points(tolerance):
    shape, closed = Contour(pear(), tolerance=tolerance), np.concatenate((pear(), pear()[:1]))
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    dense = CubicSpline(way, closed, bc_type="periodic")(np.linspace(0, way[-1], 3000))
    with torch.no_grad():
        off = shape(torch.from_numpy(dense) - shape.moments().centre)[0].abs().max().item()
    assert 0.5 * shape.residual < off <= 1.1 * shape.residual <= 1.1 * tolerance


def test_a_contour_is_read_from_a_file_whose_columns_have_names_and_units(tmp_path):
    file, points = tmp_path / "pear.csv", pear()
    rows = "".join(f"{1e2 * y},{1e3 * x}\n\n" for x, y in points)
    file.write_text("y [cm], x [mm]\n" + rows, encoding="utf-8")
    assert torch.allclose(Contour.from_csv(file).control, Contour(points).control, atol=1e-12)
    for text, match in (
        ("", "is empty"),
        ("x [mm],y [mm],z [mm]\n1,2,3\n", "column `z` is not known"),
        ("x [mm],y [mm]\n1,2\n", r"pear.csv: `points` must be at least 8 places"),
        (
            "x [m],y [m]\n-15,0\n15,0\n",
            "the outline is 30 m wide; is the unit in the heading right",
        ),
    ):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=match):
            Contour.from_csv(file)


# shapes in rigs


def test_a_contour_made_sharp_afterwards_is_rejected():
    shape = Contour(pear())
    with torch.no_grad():
        shape.control[3] *= 3.0
    with pytest.raises(ValueError, match="so sharp, or so narrow"):
        rest(still(COARSE, shape=shape))


def test_a_body_held_upright_although_its_pad_would_turn_it_is_warned_about():
    tilted = {"pads.ground.angle": 0.2, "bodies.ellipse.start": {"x": 0.06, "y": "rest"}}
    with pytest.warns(UserWarning, match="`ellipse` is held at theta = 0, where the pads turn it"):
        RigFile.ready("drop").override(tilted).build()


def test_a_centre_of_mass_without_a_shape_is_rejected():
    body = {"mass": 1.0, "theta": 0.0, "centre_x": 1e-3, "start": {"x": 0.0, "y": 0.0}}
    with pytest.raises(ValueError, match="have no meaning without a shape"):
        RigFile.from_tree({"bodies": {"a": body}})
