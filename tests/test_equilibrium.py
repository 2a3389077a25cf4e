"""Equilibria: bodies that rest, touch and are pressed, and pads that settle around given bodies.
Balance by the multibond graph, derivatives against differences, closed forms, and the finite
elements of another program."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from conftest import (
    GRASPED,
    PAPER,
    RUBBER,
    dry,
    f64,
    holding_force,
    press,
    random_state,
    rest,
    still,
    turning,
)
from conftest import coarse as build
from fem_oracle import matrices
from torch import Tensor

from experiments.validation.half_plane import HalfPlane, hertz
from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    KelvinVoigt,
    NoEquilibrium,
    Pad,
    PadMesh,
    Profile,
    Reference,
    Rig,
    RigFile,
    RoundedBox,
    SmoothSlip,
    SoftContact,
    StandardLinearSolid,
)
from torchsoft.physics.mesh import lame_moduli
from torchsoft.physics.multibond import net_efforts
from torchsoft.physics.state import State
from torchsoft.physics.statics import resting, settled

BALANCE = 1e-9
"""Of forces, relative to the weight: residuals are below 1e-13 m, against springs of 1e5 N/m."""


class Scene(NamedTuple):
    """A rig with a bracket over a body on a pad, their names, and parameters to differentiate with
    respect to."""

    rig: Rig
    body: str
    lower: str
    upper: str
    law: str
    lengths: tuple[str, ...]
    turned: float = 0.0

    def start(self, bracket: Any) -> Tensor:
        """The state with the body at rest, and the bracket's height as given."""
        body = {"x": 60e-3, "y": "rest", "theta": self.turned}
        return self.rig.state({self.body: body, "bracket": {"x": 60e-3, "y": bracket}})

    def heights(self, y: Tensor) -> Tensor:
        pose = self.rig.unpack(y).pose
        return torch.stack((pose[self.body][1], pose["bracket"][1]))

    def forces(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """What the lower and the upper pad push the body upwards with [N], by the multibond graph
        and not by the equilibrium solver."""
        ports = self.rig.evaluate(0.0, self.rig.unpack(y)).ports
        of = lambda pad: net_efforts({"c": ports[f"contact_{pad}"]}, self.rig.junctions)
        lower, upper = (of(pad)[self.body][0, 1] for pad in (self.lower, self.upper))
        return lower, upper

    @property
    def weight(self) -> float:
        return float(self.rig.bodies[self.body].mass * self.rig.gravity)


def scene(name: str) -> Scene:
    """The paper's rig, or an ellipse askew, on coarse meshes."""
    if name == "paper":
        return Scene(build(), "disc", "L", "U", "steel_on_rubber", ("bodies.disc.shape.radius",))
    mesh = {"elements_x": 40, "elements_y": 2}
    rig = RigFile.ready("ellipse").override(pads={"lower": mesh, "upper": mesh}).build().rig
    axes = "bodies.ellipse.shape.a", "bodies.ellipse.shape.b"
    return Scene(rig, "ellipse", "lower", "upper", "dry", axes, 0.3)


SCENES = pytest.mark.parametrize("name", ["paper", "ellipse"])


# bodies


@SCENES
@torch.no_grad()
def test_a_bracket_that_touches_just_touches(name):
    one = scene(name)
    y = one.start("touch")
    state = one.rig.unpack(y)
    g = one.rig.penetration(one.upper, state)
    assert float(g.max().abs()) < 1e-15
    assert int((g > -1e-9).sum()) == 1
    assert state.pose["bracket"][0] == state.pose[one.body][0] == 60e-3
    assert state.pose[one.body][2] == one.turned
    lower, upper = one.forces(y)
    assert upper == 0.0
    assert float(lower) == pytest.approx(one.weight, rel=BALANCE)


@SCENES
@torch.no_grad()
def test_a_depth_counts_from_the_touch_and_a_force_is_what_the_upper_pad_presses_with(name):
    one = scene(name)
    low, touch = one.heights(one.start("touch")).tolist()
    for depth in (1e-5, 1e-3):
        y = one.start({"depth": depth})
        body, bracket = one.heights(y).tolist()
        assert bracket == pytest.approx(touch - depth, abs=1e-15)
        assert 0 < low - body < depth  # both pads are compressed
        lower, upper = one.forces(y)
        assert float(upper) < 0.0
        assert float(lower + upper) == pytest.approx(one.weight, rel=1e-7)
    y = one.start({"force": 20.0})
    lower, upper = one.forces(y)
    assert float(upper) == pytest.approx(-20.0, rel=BALANCE)
    assert float(lower) == pytest.approx(20.0 + one.weight, rel=BALANCE)
    height = float(one.heights(y)[1])
    for same in (height, {"depth": touch - height}):
        assert (one.start(same) - y).abs().max() < 1e-7  # [N, m]


@pytest.mark.parametrize("inertial", [False, True])
@pytest.mark.parametrize("start", [rest, press])
@torch.no_grad()
def test_nothing_but_the_bracket_accelerates(inertial, start):
    model = build(pad__inertial=inertial)
    rate = model.unpack(model(0.0, start(model)))
    linear, spin = BALANCE * float(model.gravity), BALANCE * 9.81 / 19.37e-3
    assert bool((rate.velocity["disc"].abs() < f64(linear, linear, spin)).all())
    for name, pad in model.pads.items():
        u_dot = rate.pads[name] if inertial else model.displacement(name, rate)
        assert float(u_dot.abs().max()) < 1e-12 / 0.01  # residual over tau [m/s]
        if inertial:
            assert float((rate.rates[name] * pad.masses()[:, None]).abs().max()) < 1e-7  # [N]


@torch.no_grad()
@pytest.mark.parametrize("x", [59.4e-3, 60.1e-3, 61e-3])
def test_a_weightless_disc_rests_where_nothing_pushes_it(x):
    """In balance at any height above its pad: left just clear of it, as if it had no sag between
    two nodes, 26 um for a chord of 2 mm."""
    model = build(gravity=0.0)
    state = model.unpack(rest(model, x))
    assert -2.6e-5 < float(model.penetration("L", state).max()) <= 0.0
    assert float(model.displacement("L", state).abs().max()) < 1e-12


def weightless(E: float) -> Rig:
    """A disc under 20 N that nothing turns, on a pad of modulus E [Pa]."""
    law = SoftContact(1e6, 0.0, 1e6, 10.0, friction=SmoothSlip(0.8, 0.8, 0.05))
    material = KelvinVoigt(E, 0.45, rho=1e3, tau=0.01, depth=0.02)
    press = Actuator("disc.y", "disc.y", PD(0.0, 0.0), setpoint="y_d", feed_forward="load")
    held = {"disc.x": 20.3e-3, "y_d": 0.0, "load": -20.0}
    return Rig(
        bodies={"disc": Body(0.1, Circle(0.01), x="driven", weighted=False)},
        pads={"pad": Pad(PadMesh(0.04, 0.005, 40, 4), material, points=2)},
        contacts={"pad": Contact("pad", "disc", law)}, actuators={"press": press},
        reference=Reference(**{name: Profile([0.0], [value]) for name, value in held.items()}),
    )  # fmt: skip


def test_a_neutral_direction_stays_where_it_is():
    """Its stiffness and load are rounding; the depth and its derivative are exact."""
    rig, start = weightless(1e6), {"disc": f64(20.3e-3, 14.8e-3, 0.3)}
    found = resting(rig, start)["disc"]
    assert found[2].item() == pytest.approx(0.3, abs=1e-12)
    alone = resting(rig, start, {"disc": (1,)})["disc"]
    assert found[1].item() == pytest.approx(alone[1].item(), abs=1e-13)
    (slope,) = torch.autograd.grad(found[1], rig.parameter("pads.pad.material.E"))
    with torch.no_grad():
        ends = [resting(weightless(1e6 + by), start)["disc"][1] for by in (100, -100)]
    assert slope.item() == pytest.approx((ends[0] - ends[1]).item() / 200, rel=1e-5)


def test_a_body_that_nothing_holds_has_no_equilibrium(monkeypatch):
    monkeypatch.setattr("torchsoft.physics.statics.ITERATIONS", 5)
    start, up = {"disc": f64(20.3e-3, 14.8e-3, 0.0)}, {"disc": f64(0.0, 30.0, 0.0)}
    with pytest.raises(
        NoEquilibrium, match=r"after 5 steps 10 N still push disc\.y; is there a pad"
    ):
        resting(weightless(1e6), start, pushed=up)


# derivatives


def outcome(one: Scene, start: Any) -> Tensor:
    """The body's and the bracket's height, a surface displacement, and the force from below: in um
    and N."""
    y = one.start(start)
    u = one.rig.displacement(one.lower, one.rig.unpack(y))
    middle = len(u) // 2
    moved = torch.stack((u[middle, 1], u[middle + 2, 0]))
    return torch.cat((1e6 * one.heights(y), 1e6 * moved, one.forces(y)[0][None]))


@pytest.mark.parametrize("start", [{}, {"force": 20.0}, {"depth": 1e-3}], ids=str)
@pytest.mark.parametrize("name", ["paper", pytest.param("ellipse", marks=pytest.mark.slow)])
def test_derivatives_by_autograd_are_those_by_differences(name, start):
    """Along one direction in which every parameter counts, and the force or depth that is given."""
    one, given = scene(name), {key: f64(x)[0].requires_grad_() for key, x in start.items()}
    names = [f"materials.rubber.{name}" for name in ("E", "nu", "depth")]
    names += [f"laws.{one.law}.K_n", f"bodies.{one.body}.mass", *one.lengths]
    leaves = [one.rig.parameter(key) for key in names] + [*given.values()]
    ask = lambda row: torch.autograd.grad(row, leaves, retain_graph=True, materialize_grads=True)
    by = torch.stack([torch.stack(ask(row)) for row in outcome(one, given or "touch")])
    values = torch.stack(leaves).detach()
    ways = values * f64(1.0, -1.1, 1.2, -1.3, 1.4, -1.5, 0.9, 0.8)[: len(values)]
    assert float((by * values).abs().amax(0).min()) > 0.1

    @torch.no_grad()
    def moved(h: float) -> Tensor:
        for leaf, value in zip(leaves, values + h * ways):
            leaf.copy_(value)
        return outcome(one, given or "touch")

    wide, narrow = ((moved(h) - moved(-h)) / (2 * h) for h in (1e-4, 5e-5))
    exact, differences = by @ ways, (4 * narrow - wide) / 3
    # measured: 1e-8 and 7e-7 (um, N), the residuals of 1e-13 m divided by the step
    assert torch.allclose(exact, differences, rtol=1e-7, atol=5e-6)


# starts that cannot be

DISC, BRACKET = {"x": 60e-3, "y": "rest"}, {"x": 60e-3, "y": "touch"}
BOTH = {"disc": DISC, "bracket": BRACKET}
WRONG = [
    ({"bracket": BRACKET | {"y": "hold"}},
     "`y` of `bracket` must be a number or 'rest' or 'touch'"),
    ({"bracket": BRACKET | {"y": {"depth": 1e-3, "force": 1.0}}}, "`y` of `bracket` must be"),
    ({"bracket": BRACKET | {"y": {"depth": "deep"}}}, "bracket.y.depth"),
    ({"bracket": BRACKET | {"x": 0.5}}, '`y` of `bracket`: "touch", but no pad bonded to it'),
    ({"bracket": {"x": 60e-3}}, "`y` of `bracket` is missing"),
    ({"bracket": BRACKET | {"theta": 0.1}}, "`theta` of `bracket` has no meaning"),
    ({"bracket": {"x": 0.06, "y": 0.06, "theta": 0.1}}, "`bracket` .*: theta is fixed"),
    ({"disc": DISC | {"x": 0.5}}, '`y` of `disc`: "rest", but no pad .* lies under x = 0.5 m'),
    ({"disc": DISC | {"y": "touch"}, "bracket": BRACKET | {"y": 0.05}},
     '`y` of `disc`: "touch", but no pad'),
    ({"disc": {"x": 0.06}}, "`y` of `disc` is missing: it is free"),
    ({"disc": DISC | {"y": "low"}}, "`y` of `disc` must be a number or 'rest'"),
    ({"disc": DISC | {"vx": 1.0}}, "`vx` is no coordinate of `disc`.* `v_x`"),
    ({"disc": [0.06, 0.02]}, "`disc` must be given coordinates by name"),
    ({"disk": {}}, "there is no body `disk`; did you mean `disc`"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "words"), WRONG)
def test_a_start_that_cannot_be_is_rejected(given, words):
    with pytest.raises((ValueError, NoEquilibrium), match=words):
        build().state(BOTH | given)


# pads around given bodies


def shaken(model: Rig) -> State:
    """The grasp with bodies displaced and points stretched; nothing moves."""
    return model.unpack(random_state(model, 0, slip=0.0))


def around(rig: Rig, state: State) -> Tensor:
    return settled(rig, state.pose, state.velocity, state.stretch)


def test_pads_settled_around_the_grasp_are_those_of_the_grasp():
    model = build(contact__points=2)
    y = press(model).detach()
    assert float((around(model, model.unpack(y)) - y).detach().abs().max()) < 1e-10  # [N]


@pytest.mark.parametrize("build", [build, turning])
def test_no_node_of_settled_pads_moves_and_another_thread_gives_the_same_bits(build):
    rig, state = build(), shaken(scene("paper").rig)
    y = around(rig, state)
    assert float(y[rig.layout.slices["pads", "U"]].detach().abs().max()) > 1.0  # [N]
    graph = rig.evaluate(0.0, rig.unpack(y.detach()))
    for name in rig.pads:
        rates = graph.ports[f"pad_{name}"].transformer.flow(graph.flows)
        assert float(rates.detach().abs().max()) < 1e-9  # [m/s]
    with ThreadPoolExecutor(2, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        for again in pool.map(lambda _: around(rig, state), range(2)):
            assert torch.equal(y, again)


def test_derivatives_of_settled_pads_are_those_of_differences():
    """Along directions of poses and stretches."""
    model = build()
    state = shaken(model)
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(model.layout.size, generator=generator, dtype=torch.float64)
    weights[model.layout.rigid] = 0.0  # what stands in the state as it was given

    def value(by: Tensor) -> Tensor:
        """Weighted state with the disc moved and the points stretched further."""
        pose = state.pose | {"disc": state.pose["disc"] + by[:3]}
        further = {k: s + by[3] * torch.linspace(-1, 1, len(s)) for k, s in state.stretch.items()}
        return weights @ around(model, state._replace(pose=pose, stretch=further))

    (exact,) = torch.autograd.grad(value(zero := torch.zeros(4).double().requires_grad_()), zero)
    with torch.no_grad():
        for h, slope in zip(torch.diag(f64(1e-8, 1e-8, 1e-6, 1e-8)), exact):
            difference = float(value(h) - value(-h)) / (2 * float(h.sum()))
            assert float(slope) == pytest.approx(difference, rel=1e-4, abs=1e-4)


def test_two_bodies_on_one_pad_share_it_and_every_branch_carries_them():
    """A body is moved by the dent of its neighbour."""
    rubber, law = StandardLinearSolid(**RUBBER, E_instant=1.5e6, tau=0.01), dry(node_spacing=2e-3)
    rig = Rig(
        bodies={name: Body(0.4, Circle(0.01)) for name in "ab"},
        pads={"P": Pad(PadMesh(0.12, 4.59e-3, 60, 2), rubber)},
        contacts={name: Contact("P", name, law) for name in "ab"},
    )
    total = []
    for x in (0.056, 0.1):
        y = rig.state(a={"x": 0.05, "y": 14.29e-3}, b={"x": x, "y": 14.29e-3})
        z = rig.unpack(y.detach()).pads["P"]
        assert torch.equal(z[0], z[1])
        total.append(float(z[0, :, 1].sum()))
    assert abs(total[0] / total[1] - 1) > 1e-3


def test_what_cannot_settle_is_rejected():
    model = build()
    state = shaken(model)
    far = {name: torch.full_like(s, 1e-3) for name, s in state.stretch.items()}
    deep = state.pose | {"disc": f64(0.06, 0.01, 0.0)}
    for changed, kind, message in (
        ({"pose": {"disc": state.pose["disc"]}}, ValueError, r"names \['disc', 'bracket'\]"),
        ({"pose": state.pose | {"disc": f64(0.0, 0.0)}}, ValueError, "3 finite numbers"),
        ({"pose": deep, "stretch": far}, NoEquilibrium, "`L` does not settle"),
    ):
        with pytest.raises(kind, match=message):
            around(model, state._replace(**changed))


# a flat punch

PAD = PAPER.pads["L"]
FLAT, DEPTH = 14.5e-3, 1e-4
"""Half of the flat side of a box, and how deep it is pressed into each of two pads [m]."""


def test_a_long_box_is_a_flat_punch_on_springs():
    """Pressed between the pads without weight: on the same mesh, assembled by scikit-fem, with a
    spring K_n between each node under the flat side and the box."""
    box = RoundedBox(half_width=15.5e-3, half_height=10e-3, radius=1e-3)
    model = still({"gravity": 0.0, "contact.K_n": 1.2e5}, shape=box)
    y = press(model, 2 * (PAD.height + 10e-3 - DEPTH) + 2.18e-3).detach()
    state, force = model.unpack(y), holding_force(model, y)
    pad = model.pads["L"]
    K_lambda, K_mu, _ = matrices(pad.mesh.nodes, pad.mesh.elements)
    lame_lambda, lame_mu = lame_moduli(pad.material.E.item(), pad.material.nu.item())
    nodes, free = pad.mesh.nodes[~pad.mesh.bonded], np.repeat(~pad.mesh.bonded, 2)
    K = pad.material.depth.item() * (lame_lambda * K_lambda + lame_mu * K_mu)[free][:, free]
    under = np.flatnonzero((nodes[:, 1] == PAD.height) & (np.abs(nodes[:, 0] - 60e-3) < FLAT))
    springs = 1.2e5 * np.bincount(2 * under + 1, minlength=len(K))
    depth = PAD.height - (float(state.pose["disc"][1]) - 10e-3)
    carried = springs * (depth + np.linalg.solve(K + np.diag(springs), -depth * springs))
    assert depth == pytest.approx(DEPTH, rel=1e-9)  # both pads are compressed equally
    assert len(under) == 29
    assert force == pytest.approx(carried.sum(), rel=1e-9)
    expected = -carried[1::2][nodes[:, 1] == PAD.height]
    assert state.pads["L"][0, :, 1].numpy() == pytest.approx(expected, rel=1e-7, abs=1e-9)


def grasped(elements_x: int, stiffening: float) -> tuple[float, float]:
    """Force on the upper pad [N] and height of the disc [m] in the full grasp."""
    mesh = {"pad.elements_x": elements_x, "pad.elements_y": elements_x // 30}
    K_n = stiffening * PAPER["laws.steel_on_rubber.K_n"]
    rig = PAPER.override(mesh | {"contact.K_n": K_n}).build().rig
    bracket = {"x": 60e-3, "y": GRASPED}
    state = rig.unpack(rig.state(disc={"x": 60e-3, "y": "rest"}, bracket=bracket))
    return float(state.pads["U"][0, :, 1].sum()), float(state.pose["disc"][1])


@pytest.mark.slow
@torch.no_grad()
def test_the_full_grasp_converges_with_the_mesh_and_the_penalty():
    """The paper's height to the digits that it prints; by meshes of 60 to 480 elements the force
    tends to 70.54 N, with the square of the spacing, and by springs up to 16 times as stiff to that
    of a rigid contact, 79.33 N, with 1 / K_n."""
    usual, y_C = grasped(120, 1.0)
    assert usual == pytest.approx(70.16, abs=0.01)
    assert y_C == pytest.approx(23.20e-3, abs=5e-6)

    coarse_mesh, stiff = grasped(60, 1.0)[0], grasped(120, 4.0)[0]
    assert usual + (usual - coarse_mesh) / 3 == pytest.approx(70.54, rel=2e-3)
    assert stiff + (stiff - usual) / 3 == pytest.approx(79.33, rel=5e-3)


def test_springs_far_stiffer_than_their_pad_have_an_equilibrium():
    """Forces do not have the rounding of places [m] times the stiffness of the springs [N/m]."""
    assert hertz(HalfPlane(elements=5, springs=400.0))["Hertz: p_0"] == pytest.approx(0.0, abs=0.03)
