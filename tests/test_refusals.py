"""Bad inputs of Python's interface: what is called or changed, and the sentence that names the
field and the remedy."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, RUBBER, coarse, f64, grasped, paper, random_state, rest, still, times
from torch import Tensor, nn
from torchdiffeq import odeint

from torchsoft import (
    METHOD,
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    Contour,
    Coulomb,
    CurvedPadMesh,
    Ellipse,
    FingertipMesh,
    GeneralisedKelvin,
    KelvinVoigt,
    NoEquilibrium,
    Pad,
    PadMesh,
    Profile,
    Prony,
    QuadMesh,
    Reference,
    Rig,
    RoundedBox,
    RoundedPolygon,
    Sampled,
    Shape,
    SimulationFailed,
    SmoothSlip,
    SoftContact,
    StateFeedback,
    Superellipse,
    controller,
    hold,
    simulate,
)
from torchsoft.physics.material import Material
from torchsoft.physics.validity import check_array, check_shape, check_slip
from torchsoft.solve.system import Rates

NAN, INF = float("nan"), float("inf")
T = times(4e-3, 3)
REJECTIONS = ValueError, TypeError, IndexError, NotImplementedError, NoEquilibrium
Call = Callable[[], object]


def resting(**parts: Any) -> Tensor:
    """The paper's coarse rig with a part replaced, at rest: every part is checked."""
    return rest(still(COARSE, **parts))


# parts
# ----------------------------------------------------------------------

ROUND = np.arange(24) * np.pi / 12
CIRCLE = 20e-3 * np.stack((np.cos(ROUND), np.sin(ROUND)), -1)
TRIANGLE = [[-12e-3, -9e-3], [19e-3, -9e-3], [-12e-3, 18e-3]]
EIGHT = [[np.sin(2 * t), np.sin(t)] for t in (np.arange(200) + 0.3) * np.pi / 100]
NECK = [[np.cos(t), np.sin(t) * (0.005 + np.cos(t) ** 2)] for t in np.arange(400) * np.pi / 200]
WAVY = [
    [(1 + 0.1 * np.cos(3 * t)) * f(t) for f in (np.cos, np.sin)]
    for t in np.arange(500) * np.pi / 250
]
FLAT = np.concatenate((CIRCLE[:12], np.linspace([-0.02, 0], [0.02, 0], 9)[1:]))
SQUARES = [[x, y] for x in (0.0, 1.0, 2.0) for y in (0.0, 1.0, 2.0)]
QUADS = [[0, 3, 4, 1], [3, 6, 7, 4], [1, 4, 5, 2], [4, 7, 8, 5]]
AROUND = [2, 5], [5, 8], [0, 1], [1, 2], [8, 7], [7, 6], [6, 3], [3, 0]
SERIES = Prony(**RUBBER, moduli=[1e5], tau=[0.1])
APART = [*SQUARES, [5, 5], [6, 5], [6, 6], [5, 6]]


def quads(**changes: Any) -> QuadMesh:
    return QuadMesh.of(
        **{"points": SQUARES, "quads": QUADS, "face": [[2, 5], [5, 8]], "bonded": [[0, 3], [3, 6]]}
        | changes
    )


def curved(**changes: Any) -> CurvedPadMesh:
    return CurvedPadMesh(30e-3, 6e-3, 3, 2, **changes)


class Chain(Material):
    """A material with the chain that it is given."""

    def __init__(self, *given: object) -> None:
        super().__init__(**RUBBER)
        self.given = given

    def chain(self) -> Any:
        return tuple(
            torch.tensor(x, dtype=torch.float64) if isinstance(x, list) else x for x in self.given
        )

    @property
    def branches(self) -> int:
        return 2


def chain(*given: object) -> Tensor:
    return resting(material=Chain(*given))


def fed(**changes: Any) -> object:
    """A controller of one coordinate."""
    given = {"measures": ["disc.x"], "setpoints": ["w"], "pushes": {"x": "disc.x"}} | changes
    return controller(given.pop("law", StateFeedback([[1.0, 1.0]])), **given)


def small(**changes: Callable[..., Any]) -> Rig:
    """A disc on a pad on the ground, with more or other parts."""
    mesh, rubber = PadMesh(0.04, 4e-3, 8, 2), KelvinVoigt(**RUBBER, tau=0.01)
    law = SoftContact(1e5, 400.0, 1e5, 400.0, friction=SmoothSlip(0.8, 0.7, 0.05))
    parts: dict[str, Any] = {
        "bodies": {"disc": Body(0.4, Circle(0.02))}, "pads": {"P": Pad(mesh, rubber)},
        "contacts": {"c": Contact("P", "disc", law)}, "actuators": {},
    }  # fmt: skip
    for name, change in changes.items():
        parts[name] |= change(
            lambda **how: Pad(mesh, rubber, **how), lambda pad, body: Contact(pad, body, law)
        )
    return Rig(**parts)


def pushed(measures: str = "disc.x", pushes: str = "disc.x") -> Rig:
    return small(
        actuators=lambda pad, contact: {"a": Actuator(measures, pushes, PD(1.0, 1.0), setpoint="w")}
    )


class Disc(Shape):
    """A circle of 20 mm, right in every respect but for what is given."""

    def __init__(self, **wrong: Callable[..., Tensor]) -> None:
        super().__init__()
        self.wrong = wrong

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        d = x.norm(dim=-1)
        n = x / d[..., None]
        return self.wrong.get("phi", lambda d: d - 0.02)(d), self.wrong.get("n", lambda n: n)(n)

    def gyration(self) -> Tensor:
        return self.wrong.get("gyration", lambda: f64(2e-4)[0])()

    def support(self, direction: Tensor) -> Tensor:
        return self.wrong.get("support", lambda d: 0.02 * d.norm(dim=-1))(direction)


class Oval(Ellipse):
    """Called round, and not."""

    round = True


def ran(**parts: Any) -> object:
    """A run of the rig with a part replaced, from no state in particular."""
    model = still(COARSE, **parts)
    return simulate(model, T, y0=torch.zeros(model.layout.size, dtype=torch.float64))


def disc(shape: Shape | None = None, **wrong: Callable[..., Tensor]) -> object:
    return ran(shape=shape or Disc(**wrong))


NUMBERS = itertools.count(1000)


def rated(change: Callable[..., Tensor], mu: float | None = None) -> Callable[..., Tensor]:
    """A slip law like Coulomb's with another normal force, unlike any other in this process if `mu`
    is not given."""
    own = 0.5 + 1e-6 * next(NUMBERS) if mu is None else mu
    return lambda E, F_N, R: (E - own * change(F_N)).clamp(min=0.0) / R


def of_one_point(E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
    """A law that several points at once break."""
    W, b = torch.eye(4, 2, dtype=torch.float64), torch.ones(4, dtype=torch.float64)
    mu = torch.tanh(W @ torch.stack((E, F_N)) + b)
    return (E - mu.sum() * F_N).clamp(min=0.0) / R


def slipping(law: Any) -> object:
    return ran(friction=law)


def looped(law: Any) -> object:
    rig = Rig(
        bodies={"disc": Body(1.0, Circle(0.02), weighted=False)}, pads={}, contacts={},
        reference=hold(x_d=0.0), actuators={"x": Actuator("disc.x", "disc.x", law, setpoint="x_d")},
    )  # fmt: skip
    return simulate(rig, times(0.01, 2), y0=torch.zeros(6, dtype=torch.float64))


MUST = r"the law of `actuators.x` must take five tensors .* and return the effort, .* but "

PARTS: list[tuple[Call, str]] = [
    # shapes
    (lambda: resting(shape=Superellipse(20e-3, 6e-3, 4.0)), "differ by more than a factor of 3"),
    (lambda: resting(shape=RoundedBox(20e-3, 9e-3, 9.1e-3)), "radius 0.0091 .* half of the box"),
    (lambda: Contour(CIRCLE[:7]), "at least 8 places around a contour, but are 7"),
    (lambda: Contour(FLAT), "turns by .* degrees"),
    (lambda: Contour(EIGHT), "a contour that crosses itself"),
    (lambda: Contour(NECK, tolerance=1e-3), "so sharp, or so narrow"),
    (lambda: Contour(WAVY, tolerance=1e-14), "512 pieces still passes the points, .*, at .* m"),
    (lambda: RoundedPolygon(TRIANGLE, 9e-3), "corners of radius 0.009 do not fit on side ."),
    (lambda: RoundedPolygon([[-2, -2], [1.6, 2], [2, -2], [-1.6, 2]], 0.1), "crosses itself"),
    (lambda: disc(phi=lambda d: 0.9 * (d - 0.02)), "phi is not a distance"),
    (lambda: disc(n=lambda n: -n), "its normal is not the slope of phi"),
    (lambda: disc(support=lambda d: 0.019 * d.norm(dim=-1)), "`support` is less than how far"),
    (lambda: disc(support=lambda d: 0.021 * d.norm(dim=-1)), "`support` is more than how far"),
    (lambda: disc(gyration=lambda: f64(-1.0)[0]), r"`bodies.disc.inertia` must be from 1e-24 to"),
    (lambda: disc(Oval(0.03, 0.02)), "called `round`, but is not"),
    # meshes
    (lambda: quads(quads=[[0, 3, 4, 9]]), "numbers of the 9 points, from 0 on"),
    (lambda: quads(quads=[[0, 4, 3, 1], *QUADS[1:]]), "quadrilateral 0 is folded"),
    (lambda: quads(quads=[[0, 3, 4, 1], [9, 10, 11, 12]], points=APART), "not connected"),
    (lambda: quads(face=[[1, 4]]), r"`face_sides` has \(1, 4\), which is no side on the boundary"),
    (lambda: quads(face=[*AROUND]), "one line with two ends"),
    (lambda: curved(radius=14e-3), "`radius` must be at least half of the length, 0.015 m"),
    (lambda: curved(radius=16e-3), "makes the arc deeper than the `height` of 0.006 m"),
    (lambda: curved(bonded_edges=("top",)), "must be some of base, left, right, but is"),
    (lambda: FingertipMesh(8e-3, 10), "`elements_around` must be a multiple of 4, but is 10"),
    # materials
    (lambda: Body(0.4, Circle(0.02), inertia=1e-4, inertia_ratio=2.0), "but is 2.0; leave it out"),
    (lambda: Prony(**RUBBER, moduli=[1e5], tau=[0.1, 1.0]), "as many `moduli` as .* 1 and 2"),
    (lambda: Prony(**RUBBER, moduli="12", tau=[0.1, 1.0]), "a list of numbers, but is '12'"),
    (lambda: resting(material=Prony(**RUBBER, moduli=[1e5, 2e5], tau=[0.1, 0.1])), "are equal"),
    (lambda: resting(material=Prony(**RUBBER, moduli=[1e5], tau=[5e-5])),
     "tau_instant = 0.0001 s must be below the shortest"),
    (lambda: resting(material=GeneralisedKelvin(**RUBBER, J=[0.6, 0.5], tau=[0.1, 1])),
     "fractions J sum to 1.1, above one"),
    (lambda: chain([0.7, 0.5], [0.01, 0.1]), "sum to 1.2; divide both J and E by that sum"),
    (lambda: chain([1.2, -0.2], [0.01, 0.1]), "fractions J .* of `L` must not be negative"),
    (lambda: chain([0.5, 0.5], [0.01, 0.0]), "times tau .* of `L` must be positive and finite"),
    (lambda: small(pads=lambda *_: {"L": Pad(PadMesh(0.04, 4e-3, 8, 2), SERIES, inertial=True)}),
     "`L` needs a material of one retardation time, being inertial"),
    # laws of contact
    (lambda: SoftContact(1e5, 1.0, 1e5, 1.0, friction=None), "`friction` must be a function or a"),
    (lambda: slipping(rated(lambda N: N.mean().expand_as(N))),
     r"aten\.mean\.default, which couples contact points at .*test_"),
    (lambda: slipping(rated(lambda N: N / N.numel())), "several points at once other .*numel"),
    (lambda: slipping(rated(lambda N: (-1 - N).sqrt())), "`L` gives nan at an effort of 0.001 N"),
    (lambda: rest(still(friction=of_one_point)), "of `L` must take three tensors .*RuntimeError"),
    # control laws
    (lambda: fed(pushes={"x": "disc.x", "y": "disc.y"}), "must give one effort for each of"),
    (lambda: fed(feed_forward={"z": "F"}), "`feed_forward` names z, but `pushes` has x"),
    (lambda: fed(setpoints=["w", "v"]), "measures 1 coordinates and follows 2 set-points"),
    (lambda: StateFeedback([[1.0, 2.0], [1.0]]), "rows of one length"),
    (lambda: looped(lambda w, w_dot, f, q, q_dot: 3.0), MUST + r"TypeError: .* gives 3\.0"),
    (lambda: looped(lambda w, q: w - q), MUST + "TypeError: .* 2 positional arguments but 5"),
    (lambda: looped(lambda w, w_dot, f, q, q_dot: next(NUMBERS) * q),
     "`actuators.x`: The law changed between calls"),
    # signals
    (lambda: Profile([0.0, 0.0], [1.0, 2.0]), "increase strictly"),
    (lambda: Profile([0.0, 1.0], [1.0]), "per time"),
    (lambda: Sampled([0.0, 1.0], [1.0, 2.0], [0.0, INF]), "`rates` .* one finite number per time"),
    # bodies and rigs
    (lambda: Body(1.0, Circle(0.1), y="loose"), "`y` must be 'free', .* but is 'loose'"),
    (lambda: Body(1.0), "needs an `inertia`, or a `shape`"),
    (lambda: small(pads=lambda pad, _: {"P": pad(base="hand")}), "`P` is bonded to `hand`, but"),
    (lambda: small(contacts=lambda _, c: {"d": c("P", "disc")}), r"contacts\.d: .* body as `c`"),
    (lambda: small(bodies=lambda *_: {"disc": Body(0.4, theta=0.0)}), "contact `c` needs a shape"),
    (lambda: small(bodies=lambda *_: {"hand": Body(0.4, inertia=1e-3)},
                   pads=lambda pad, _: {"P": pad(base="hand", inertial=True)}),
     "pad `P` is inertial and its base `hand` may turn"),
    (lambda: pushed(pushes="disc.up"), r"`a` speaks of `disc\.up`, .* there are disc\.x"),
    (lambda: pushed()(0.0, torch.zeros(33, dtype=torch.float64)), "has no signal `w`; it has none"),
    (lambda: coarse().parameter("pad.Young"), r"`pad.Young` is not a parameter .*: .*pad\.E"),
    (lambda: odeint(nn.Identity(), f64(0.0), T, method=METHOD), r"torchsoft\.Rig, but got Iden"),
    (lambda: odeint(m := coarse(), grasped(m), T, method=METHOD, options={"stepsize": 1e-3}),
     r"no option \['stepsize'\]; it"),
    # integers that no float holds
    (lambda: Profile([0, 1], [0, 10**400]), "must be"),
    (lambda: small(pads=lambda pad, _: {"P": pad(origin=(10**400, 0))}), "`origin.*must be"),
    (lambda: paper(COARSE).run(T, rtol=10**400), "`rtol` must be"),
    (lambda: paper(COARSE).run([0, 10**400]), "`t` must be"),
]  # fmt: skip


class Run(nn.Module):
    """A run as a module."""

    def __init__(self, rig: Rig, y0: Tensor) -> None:
        super().__init__()
        self.rig, self.y0 = rig, y0

    def forward(self) -> Tensor:
        return simulate(self.rig, T, y0=self.y0)["x_C"][-1]


TRANSFORMED: dict[str, Callable[[Rig, Tensor, Tensor], object]] = {
    "E": lambda rig, y0, x: torch.func.functional_call(Run(rig, y0), {"rig.pads.L.material.E": x}),
    "y0": lambda rig, y0, x: simulate(rig, T, y0=y0 * x),
    "list": lambda rig, y0, x: simulate(rig, T, y0=list(y0 * x)),
    "t": lambda rig, y0, x: simulate(rig, T * x, y0=y0),
    "knots": lambda rig, y0, x: Profile([0.0, 1.0], torch.stack([x, x])),
}  # fmt: skip


@pytest.mark.parametrize("by", TRANSFORMED)
@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.vmap])
def test_a_run_in_a_transform_of_torch_func_is_rejected_with_the_way_on(by, transform, start):
    x = f64(1.0) if transform is torch.func.vmap else f64(1.0)[0]
    with pytest.raises(ValueError, match=r"inside a transform of torch\.func.*gradient='discrete'"):
        transform(lambda x: TRANSFORMED[by](*start, x))(x)


@pytest.mark.parametrize("row", range(len(PARTS)))
def test_what_cannot_be_a_part_or_a_call_is_rejected(row):
    call, sentence = PARTS[row]
    with pytest.raises(REJECTIONS, match=sentence):
        call()


def test_a_coupled_law_is_rejected_after_its_pointwise_twin():
    """For one point both have the same expression, which is compiled already."""
    model = still(COARSE, friction=rated(lambda N: N, mu=0.49))
    simulate(model, T, y0=rest(model).detach())
    with pytest.raises(ValueError, match="several points at once other rates"):
        slipping(rated(lambda N: N.sum().expand_as(N), mu=0.49))


def test_what_only_looks_wrong_passes():
    """Two squares that share a corner hang together."""
    corner = quads(
        quads=[QUADS[0], QUADS[3]], points=[*SQUARES, [5.0, 5.0]], face=[[5, 8]], bonded=[[0, 3]]
    )
    assert len(corner.nodes) == 7
    for shape in (Disc(), Circle(0.02), Ellipse(0.03, 0.02)):
        check_shape("disc", shape)


# runs
# ----------------------------------------------------------------------


class Turned(Profile):
    """A signal with something put in."""

    def __init__(self, change: Callable[[Tensor, Tensor], Tensor]) -> None:
        super().__init__([0.0], [0.06])
        self.change = change

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        value, rate = super().forward(t)
        return self.change(value, t), rate


def signal(change: Callable[[Tensor, Tensor], Tensor]) -> dict[str, Any]:
    return {
        "reference": Reference(
            x_d=Turned(change), y_d=Profile([0.0], [0.0486]), F_ff=Profile([0.0], [-80.0])
        )
    }


FORWARD = {"gradient": "forward", "wrt": ["pad.E"]}
RUNS: list[tuple[dict[str, Any], str]] = [
    ({"t": "soon"}, "`t` must be numbers .*, but is 'soon'"),
    ({"t": [[0.0], [1.0, 2.0]]}, "`t` must be numbers"),
    ({"t": f64(0.0, 0.1, 0.1)}, r"increase strictly .* t\[1:3\]"),
    ({"t": f64(0.0, NAN)}, "finite"),
    ({"t": T.clone().requires_grad_()}, "`t` must not require a gradient"),
    ({"t": f64(0.0, 1e299)}, r"1e\+300 steps, .* no step is longer than 0\.1 s"),
    ({"y0": f64(0.0, 0.0, 0.0)}, "must be float64 of shape"),
    ({"y0": torch.full((376,), NAN).double()}, "must be finite, but component 0"),
    ({"rig": Rig}, "`rig` must be a Rig"),
    *(({name: value}, f"`{name}` must be positive and finite, but is {value}")
      for name in ("step", "tolerance", "rtol", "atol") for value in (0.0, -1e-3, NAN, INF, True)),
    ({"tolerance": 1e-14}, "`tolerance` must be at least 1e-10 N"),
    ({"step": 1e-3, "rtol": 1e-4}, "`step` and `rtol or atol` each say which steps to take"),
    ({"rtol": 2.0}, "`rtol` must be below 1, but is 2; where only `atol` is given"),
    ({"knots": f64(0.0, 1e-3)}, "`knots` must go from"),
    ({"gradient": "Discrete"}, "`gradient` must be one of none, discrete, forward"),
    (FORWARD | {"dy0": torch.zeros(3, 1).double()}, r"`dy0` must have shape \(376, 1\), or more"),
    (FORWARD | {"wrt": ["contact.K_x"]}, r"`contact.K_x` is not .*; did you mean `contact.K_t`\?"),
    ({"gradient": "discrete", "wrt": ["pad.E"]}, "`wrt` names the parameters of .*'forward'"),
    (signal(lambda value, t: torch.where(t > 2e-3, torch.nan, value)),
     r"the signal `x_d` of the reference is not finite at t = 0\.00"),
    (signal(lambda value, t: value + 1e-6 * torch.rand_like(t)), "gives other values when asked"),
    (signal(lambda value, t: value.float()), "the signal `x_d` must give float64"),
]  # fmt: skip


@pytest.fixture(scope="module")
def start():
    model = coarse()
    return model, grasped(model)


@pytest.mark.parametrize("row", range(len(RUNS)))
def test_invalid_arguments_of_a_run_are_rejected(row, start):
    changes, sentence = RUNS[row]
    with pytest.raises(ValueError, match=sentence):
        simulate(**{"rig": start[0], "t": T, "y0": start[1]} | changes)


def filled(name: str, value: float) -> Callable[[Rig], object]:
    return lambda model: model.parameter(name).detach().fill_(value)


def grouped(model: Rig) -> None:
    """A group that no part of the rig is in."""
    model.groups, model.pad = ("pad",), KelvinVoigt(**RUBBER, tau=0.01)


SPOILT: list[tuple[Callable[[Rig], object], str]] = [
    (filled("pad.E", 0.0), r"parameter `.*\.E` must be from 1 to 1e\+13 Pa, but is 0"),
    (filled("contact.K_n", NAN), r"parameter `.*K_n` must be finite, but is nan"),
    (filled("contact.mu_k", 0.9), "mu_k = 0.9 > mu_s = 0.8"),
    (lambda m: m.float(), "`gravity` must be float64"),
    (lambda m: setattr(m.parameter("pad.E"), "data", torch.ones(2).double()), "be one number"),
    (grouped, "`pad.E` belongs to no body, pad"),
    (lambda m: setattr(m.contacts["L"].law, "friction", Coulomb(0.3, 0.4)), "mu_k = 0.4 > mu_s ="),
    (lambda m: m.reference["x_d"].times.fill_(NAN), "`x_d` of the reference is none any more"),
]  # fmt: skip


@pytest.mark.parametrize("row", range(len(SPOILT)))
def test_a_rig_changed_in_place_to_the_impossible_is_rejected(row, start):
    spoil, sentence = SPOILT[row]
    model = coarse()
    model.reference = hold(x_d=0.06, y_d=0.0486, F_ff=-80.0)
    spoil(model)
    for verb in (
        lambda: simulate(model, T, y0=start[1]),
        *([lambda: rest(model)] if row in (0, 2) else []),
    ):
        with pytest.raises(ValueError, match=sentence):
            verb()


def test_another_mode_or_device_of_torch_is_rejected(start):
    model, y0 = start
    with (
        torch.device("meta"),
        pytest.raises(ValueError, match=r"call torch.set_default_device\('cpu'\)"),
    ):
        simulate(model, T, y0=y0)
    with torch.inference_mode():
        with pytest.raises(ValueError, match=r"torch.inference_mode\(\) has not"):
            simulate(model, T, y0=y0, **FORWARD)
        with pytest.raises(ValueError, match=r"use torch.no_grad\(\)"):
            rest(model)
    with torch.autograd.forward_ad.dual_level(), pytest.raises(ValueError, match="has a tangent"):
        check_array("x", torch.autograd.forward_ad.make_dual(y0, y0))


def test_a_slip_law_that_supplies_power_is_reported():
    for right in (SmoothSlip(0.8, 0.7, 5e-3), Coulomb(0.8, 0.7)):
        assert check_slip("c", right, 500.0) == ""
    for wrong in (lambda E, F_N, R: 1.5 * E / R, lambda E, F_N, R: E - F_N):
        assert "must be from 0 to the effort" in check_slip("c", wrong, 500.0)


def test_compiled_rates_reject_what_they_cannot_give(start):
    """Inertial pads, and states at which there are no forces; they go on after that."""
    with pytest.raises(NotImplementedError, match="inertial pads"):
        Rates(coarse(pad__inertial=True))
    rates, y = Rates(start[0]), random_state(start[0], 0).numpy()
    fine = rates(0.0, y)
    with pytest.raises(SimulationFailed, match="no forces"):
        rates(0.0, np.full_like(y, np.nan))
    np.testing.assert_allclose(rates(0.0, y), fine, rtol=1e-9, atol=1e-9 * np.abs(fine).max())
