"""States from starts of bodies: places, forces in balance, derivatives by the implicit function
theorem, and refusals."""

from typing import Any, NamedTuple

import pytest
import torch
from conftest import coarse as build
from conftest import f64, holding_force, press, rest
from torch import Tensor

from torchsoft import NoEquilibrium, Rig, RigFile
from torchsoft.physics.multibond import net_efforts
from torchsoft.physics.state import State

BALANCE = 1e-9
"""Of forces, relative to the weight: residuals are below 1e-13 m, against springs of 1e5 N/m."""


def contact_force(rig: Rig, y: Tensor, which: str, body: str = "disc") -> Tensor:
    """Force of one pad's contact on a body (2,) [N], by the multibond graph and not by the
    equilibrium solver."""
    port = rig.evaluate(0.0, rig.unpack(y)).ports[f"contact_{which}"]
    return net_efforts({"contact": port}, rig.junctions)[body][0]


class Scene(NamedTuple):
    """A rig with a bracket over a body on a pad, their names, and parameters to differentiate
    by."""

    rig: Rig
    body: str
    lower: str
    upper: str
    lengths: tuple[str, ...]
    turned: float = 0.0

    def start(self, bracket: Any) -> Tensor:
        """The state with the body at rest, and the bracket's height as given."""
        own = {"x": 60e-3, "y": "rest", "theta": self.turned}
        return self.rig.state({self.body: own, "bracket": {"x": 60e-3, "y": bracket}})

    def heights(self, state: State) -> tuple[float, float]:
        return float(state.pose[self.body][1]), float(state.pose["bracket"][1])

    def forces(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """What the lower and the upper pad push the body upwards with [N]."""
        lower, upper = (contact_force(self.rig, y, pad, self.body)[1]
                        for pad in (self.lower, self.upper))  # fmt: skip
        return lower, upper

    @property
    def weight(self) -> float:
        return float(self.rig.bodies[self.body].mass * self.rig.gravity)


def scene(name: str, **changes: Any) -> Scene:
    """The paper's rig, or an ellipse askew, on coarse meshes."""
    if name == "paper":
        return Scene(build(**changes), "disc", "L", "U", ("bodies.disc.shape.radius",))
    coarse = {"elements_x": 60, "elements_y": 2}
    file = RigFile.ready("ellipse").override(pads={"lower": coarse, "upper": coarse})
    rig = file.assemble()
    rig.reference = file.build().rig.reference
    axes = "bodies.ellipse.shape.a", "bodies.ellipse.shape.b"
    return Scene(rig, "ellipse", "lower", "upper", axes, 0.3)


SCENES = "paper", "ellipse"
PRESSED = {"depth": 1e-3}, {"force": 20.0}


# places and balance
# ----------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
@torch.no_grad()
def test_a_bracket_that_touches_just_touches(name):
    one = scene(name)
    y = one.start("touch")
    state = one.rig.unpack(y)
    g = one.rig.penetration(one.upper, state)
    assert float(g.max().abs()) < 1e-15
    assert int((g > -1e-9).sum()) == 1
    assert float(state.pose["bracket"][0]) == float(state.pose[one.body][0]) == 60e-3
    assert float(state.pose[one.body][2]) == one.turned
    lower, upper = one.forces(y)
    assert upper == 0.0
    assert float(lower) == pytest.approx(one.weight, rel=BALANCE)


@pytest.mark.parametrize("name", SCENES)
@torch.no_grad()
def test_a_depth_counts_from_the_touch(name):
    one = scene(name)
    low, touch = one.heights(one.rig.unpack(one.start("touch")))
    for depth in (1e-5, 1e-3):
        y = one.start({"depth": depth})
        body, bracket = one.heights(one.rig.unpack(y))
        assert bracket == pytest.approx(touch - depth, abs=1e-15)
        assert touch - depth - bracket < low - body < depth  # both pads give way
        lower, upper = one.forces(y)
        assert float(upper) < 0.0
        assert float(lower + upper) == pytest.approx(one.weight, rel=1e-7)


@pytest.mark.parametrize("name", SCENES)
@torch.no_grad()
def test_a_force_is_what_the_upper_pad_presses_with(name):
    one = scene(name)
    y = one.start({"force": 20.0})
    lower, upper = one.forces(y)
    assert float(upper) == pytest.approx(-20.0, rel=BALANCE)
    assert float(lower) == pytest.approx(20.0 + one.weight, rel=BALANCE)
    height = one.heights(one.rig.unpack(y))[1]
    assert (one.start(height) - y).abs().max() < 1e-7  # the same, held at its height [N, m]
    depth = one.heights(one.rig.unpack(one.start("touch")))[1] - height
    assert (one.start({"depth": depth}) - y).abs().max() < 1e-7


@pytest.mark.parametrize("inertial", [False, True])
@pytest.mark.parametrize("at", ["rest", "grasp"])
@torch.no_grad()
def test_nothing_but_the_bracket_accelerates(inertial, at):
    model = build(pad__inertial=inertial)
    y = rest(model) if at == "rest" else press(model)
    rate = model.unpack(model(0.0, y))
    gravity = float(model.gravity)
    assert float(rate.velocity["disc"][:2].abs().max()) < BALANCE * gravity
    assert float(rate.velocity["disc"][2].abs()) < BALANCE * gravity / float(
        model.parameter("disc.radius")
    )
    creep = 1e-12 / model.parameter("pad.tau").item()  # [m/s]: residual over tau
    for name, pad in model.pads.items():
        u_dot = rate.pads[name] if pad.inertial else model.displacement(name, rate)
        assert float(u_dot.abs().max()) < creep
        if pad.inertial:
            assert float((rate.rates[name] * pad.masses()[:, None]).abs().max()) < 1e-7  # [N]
    if at == "rest":  # hangs just clear of the disc, on its loop
        assert float(rate.velocity["bracket"][0].abs()) < 1e-9


@torch.no_grad()
@pytest.mark.parametrize("x", [58.1e-3, 59.4e-3, 59.7e-3, 60.1e-3, 60.7e-3, 61e-3])
def test_a_weightless_disc_rests_where_nothing_pushes_it(x):
    """In balance at any height above its pad: left just clear of it, as if it had no sag between
    two nodes, 26 um for a chord of 2 mm."""
    model = build(gravity=0.0)
    state = model.unpack(rest(model, x))
    assert -2.6e-5 < float(model.penetration("L", state).max()) <= 0.0
    assert float(model.displacement("L", state).abs().max()) < 1e-12


@torch.no_grad()
def test_pads_with_and_without_mass_agree():
    massless, inertial = (build(pad__inertial=kind) for kind in (False, True))
    one, other = massless.unpack(press(massless)), inertial.unpack(press(inertial))
    assert float((one.pose["disc"] - other.pose["disc"]).abs().max()) < 1e-13
    u = massless.displacement("U", one)
    assert float((u - other.pads["U"][inertial.pads["U"].surface]).abs().max()) < 1e-13


# derivatives
# ----------------------------------------------------------------------


def outcome(one: Scene, start: Any) -> Tensor:
    """The body's and the bracket's height, a surface displacement, and the force from below: in um
    and N."""
    y = one.start(start)
    state = one.rig.unpack(y)
    u = one.rig.displacement(one.lower, state)
    middle = len(u) // 2
    lengths = torch.stack(
        (state.pose[one.body][1], state.pose["bracket"][1], u[middle, 1], u[middle + 2, 0])
    )
    return torch.cat((1e6 * lengths, one.forces(y)[0][None]))


@pytest.mark.parametrize("start", ["touch", *PRESSED], ids=str)
@pytest.mark.parametrize("name", ["paper", pytest.param("ellipse", marks=pytest.mark.slow)])
def test_derivatives_by_autograd_are_those_by_differences(name, start):
    """Along one direction in which every parameter counts."""
    one = scene(name)
    law = "steel_on_rubber" if name == "paper" else "dry"
    leaves = [one.rig.parameter(key) for key in (
        "materials.rubber.E", "materials.rubber.nu", "materials.rubber.depth", f"laws.{law}.K_n",
        f"bodies.{one.body}.mass", *one.lengths)]  # fmt: skip
    ask = lambda row: torch.autograd.grad(row, leaves, retain_graph=True, materialize_grads=True)
    by = torch.stack([torch.stack(ask(row)) for row in outcome(one, start)])
    values = torch.stack(leaves).detach()
    ways = values * f64(1.0, -1.1, 1.2, -1.3, 1.4, -1.5, 0.9)[: len(values)]
    assert float((by * values).abs().amax(0).min()) > 0.1

    @torch.no_grad()
    def moved(h: float) -> Tensor:
        for leaf, value in zip(leaves, values + h * ways):
            leaf.copy_(value)
        return outcome(one, start)

    wide, narrow = ((moved(h) - moved(-h)) / (2 * h) for h in (1e-4, 5e-5))
    exact, differences = by @ ways, (4 * narrow - wide) / 3
    # measured: 1e-8 and 7e-7 (um, N), the residuals of 1e-13 m divided by the step
    assert torch.allclose(exact, differences, rtol=1e-7, atol=5e-6)


@pytest.mark.parametrize("name", ["paper", pytest.param("ellipse", marks=pytest.mark.slow)])
def test_a_depth_and_a_force_are_differentiated_by(name):
    """The bracket goes down by as much as a depth grows; by a force as differences say."""
    one = scene(name)

    def top(key: str, value: Any) -> Tensor:
        return one.rig.unpack(one.start({key: value})).pose["bracket"][1]

    by = {}
    for (key, value), *_ in (way.items() for way in PRESSED):
        x = torch.tensor(value, dtype=torch.float64, requires_grad=True)
        (by[key],) = torch.autograd.grad(top(key, x), x)
    assert float(by["depth"]) == pytest.approx(-1.0, abs=1e-12)
    with torch.no_grad():
        change = float(top("force", 20.01) - top("force", 19.99)) / 0.02
    assert float(by["force"]) == pytest.approx(change, rel=1e-5)


# refusals
# ----------------------------------------------------------------------


def test_a_disc_that_is_hardly_pressed_is_pressed_lightly():
    one = scene("paper")
    with torch.no_grad():
        force = -float(one.forces(one.start({"depth": 1e-6}))[1])
    # the middle node's spring of 0.24 N/um, in series with the pads: measured 0.018 N
    assert 0 < force < 0.24


@pytest.mark.parametrize(
    ("bracket", "words"),
    [
        ("hold", "`y` of `bracket` must be a number or 'rest' or 'touch', but is 'hold'"),
        ({"weight": 1.0}, "`y` of `bracket` must be a number or 'rest' or 'touch'"),
        ({"depth": 1e-3, "force": 1.0}, "`y` of `bracket` must be"),
        ({"depth": "deep"}, "bracket.y.depth"),
        ({"force": float("nan")}, "bracket.y.force"),
    ],
)
def test_a_start_that_means_nothing_is_refused(bracket, words):
    with pytest.raises(ValueError, match=r".") as error:
        scene("paper").start(bracket)
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("disc", "bracket", "words"),
    [
        ({"x": 0.5, "y": "rest"}, {"x": 60e-3, "y": "touch"},
         '`y` of `disc`: "rest", but no pad that it has a contact with lies under x = 0.5 m'),
        ({"x": 60e-3, "y": "rest"}, {"x": 0.5, "y": "touch"},
         '`y` of `bracket`: "touch", but no pad bonded to it comes down upon a body'),
        ({"x": 60e-3, "y": "touch"}, {"x": 60e-3, "y": 0.05}, '`y` of `disc`: "touch", but no pad'),
        ({"x": 60e-3, "y": "rest"}, {"x": 60e-3}, "`y` of `bracket` is missing"),
        ({"x": 60e-3, "y": "rest"}, {"x": 60e-3, "y": "touch", "theta": 0.1},
         "`theta` of `bracket` has no meaning"),
    ],
)  # fmt: skip
def test_a_start_that_cannot_be_is_refused(disc, bracket, words):
    with pytest.raises((ValueError, NoEquilibrium), match=r".") as error:
        build().state(disc=disc, bracket=bracket)
    assert words in str(error.value)


def test_statics_in_inference_mode_are_refused():
    model = build()
    with torch.inference_mode(), pytest.raises(ValueError, match=r"use torch\.no_grad\(\)"):
        rest(model)


def test_a_rig_that_is_not_physical_any_more_is_refused():
    model = build()
    with torch.no_grad():
        model.parameter("pad.E").fill_(-1.0)
    with pytest.raises(ValueError, match=r"`materials.rubber.E` must be from 1 to 1e\+13 Pa"):
        rest(model)


def test_no_equilibrium_is_reported_when_newton_does_not_converge(monkeypatch):
    monkeypatch.setattr("torchsoft.physics.statics.ITERATIONS", 2)
    with pytest.raises(NoEquilibrium, match=r"no equilibrium found: after 2 steps .* push disc\.y"):
        press(build())


@pytest.mark.parametrize("inertial", [False, True])
def test_holding_force_is_what_the_upper_contact_presses_with(inertial):
    model = build(pad__inertial=inertial)
    y = press(model)
    assert holding_force(model, y) == pytest.approx(
        -float(contact_force(model, y, "U")[1].detach()), rel=1e-9
    )
