"""Rules of Python's interface that are not bounds of one number: parts that do not fit together,
laws that are none, invalid arguments of a run, and rigs changed in place. The message has the field
and the remedy."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, RUBBER, coarse, f64, grasped, paper, rest, still, times
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
    FingertipMesh,
    KelvinVoigt,
    NoEquilibrium,
    Pad,
    PadMesh,
    Profile,
    Prony,
    QuadMesh,
    Reference,
    Rig,
    RoundedPolygon,
    SoftContact,
    StateFeedback,
    Superellipse,
    controller,
    hold,
    simulate,
)
from torchsoft.physics.validity import check_slip

NAN = float("nan")
T = times(4e-3, 3)
REJECTIONS = ValueError, TypeError, IndexError, NotImplementedError, NoEquilibrium

# parts
# ----------------------------------------------------------------------

ROUND = np.arange(24) * np.pi / 12
CIRCLE = 20e-3 * np.stack((np.cos(ROUND), np.sin(ROUND)), -1)
TRIANGLE = [[-12e-3, -9e-3], [19e-3, -9e-3], [-12e-3, 18e-3]]
EIGHT = [[np.sin(2 * t), np.sin(t)] for t in (np.arange(200) + 0.3) * np.pi / 100]
NECK = [[np.cos(t), np.sin(t) * (0.005 + np.cos(t) ** 2)] for t in np.arange(400) * np.pi / 200]
FLAT = np.concatenate((CIRCLE[:12], np.linspace([-0.02, 0], [0.02, 0], 9)[1:]))
MESH, SOFT = PadMesh(0.04, 4e-3, 8, 2), KelvinVoigt(**RUBBER, tau=0.01)
SERIES = Prony(**RUBBER, moduli=[1e5], tau=[0.1])
LAW = SoftContact(1e5, 400.0, 1e5, 400.0, friction=Coulomb(0.8, 0.7))
ONE = {"measures": ["disc.x"], "setpoints": ["w"], "pushes": {"x": "disc.x"}}
FEEDBACK = StateFeedback([[1.0, 1.0]])


def quads(**changes: Any) -> QuadMesh:
    """Four unit squares."""
    points = [[x, y] for x in (0.0, 1.0, 2.0) for y in (0.0, 1.0, 2.0)]
    elements = [[0, 3, 4, 1], [3, 6, 7, 4], [1, 4, 5, 2], [4, 7, 8, 5]]
    sides = {"face": [[2, 5], [5, 8]], "bonded": [[0, 3], [3, 6]]}
    return QuadMesh.of(**{"points": points, "quads": elements, **sides} | changes)


class Stretched(KelvinVoigt):
    """Fractions that sum to more than one."""

    def chain(self) -> Any:
        return f64(1.2), self.tau[None]


class Disc(Circle):
    """A circle, right in every respect but for what is given."""

    def __init__(self, **wrong: Any) -> None:
        super().__init__(0.02)
        self.wrong = wrong

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        phi, n = super().forward(x)
        return self.wrong.get("phi", 1.0) * phi, self.wrong.get("n", 1.0) * n

    def gyration(self) -> Tensor:
        return self.wrong.get("gyration", 1.0) * super().gyration()

    def support(self, direction: Tensor) -> Tensor:
        return self.wrong.get("support", 1.0) * super().support(direction)


def resting(**parts: Any) -> Tensor:
    """The paper's coarse rig with a part replaced, at rest: every part is checked."""
    return rest(still(COARSE, **parts))


def ran(**parts: Any) -> object:
    """A run of the rig with a part replaced, from no state in particular."""
    model = still(COARSE, **parts)
    return simulate(model, T, y0=torch.zeros(model.layout.size, dtype=torch.float64))


def small(**more: dict[str, Any]) -> Rig:
    """A disc on a pad on the ground, with more or other parts."""
    parts = {
        "bodies": {"disc": Body(0.4, Circle(0.02))}, "pads": {"P": Pad(MESH, SOFT)},
        "contacts": {"c": Contact("P", "disc", LAW)}, "actuators": {},
    }  # fmt: skip
    return Rig(**{name: part | more.get(name, {}) for name, part in parts.items()})


def driven(law: Any, pushes: str = "disc.x") -> Rig:
    return small(actuators={"x": Actuator("disc.x", pushes, law, setpoint="w")})


def looped(law: Any) -> object:
    rig = driven(law)
    rig.reference = hold(w=0.0)
    return simulate(rig, T, y0=torch.zeros(rig.layout.size, dtype=torch.float64))


NUMBERS = itertools.count(1000)


def rated(change: Callable[..., Tensor], mu: float | None = None) -> Callable[..., Tensor]:
    """A slip law like Coulomb's with another normal force, unlike any other in this process if `mu`
    is not given."""
    own = 0.5 + 1e-6 * next(NUMBERS) if mu is None else mu
    return lambda E, F_N, R: (E - own * change(F_N)).clamp(min=0.0) / R


PARTS = [
    # shapes
    (lambda: resting(shape=Superellipse(20e-3, 6e-3, 4.0)), "differ by more than a factor of 3"),
    (lambda: Contour(FLAT), "turns by .* degrees"),
    (lambda: Contour(EIGHT), "a contour that crosses itself"),
    (lambda: Contour(NECK, tolerance=1e-3), "so sharp, or so narrow"),
    (lambda: RoundedPolygon(TRIANGLE, 9e-3), "corners of radius 0.009 do not fit on side ."),
    (lambda: ran(shape=Disc(phi=0.9)), "phi is not a distance"),
    (lambda: ran(shape=Disc(n=-1.0)), "its normal is not the slope of phi"),
    (lambda: ran(shape=Disc(support=0.95)), "`support` is less than how far"),
    (lambda: ran(shape=Disc(gyration=-1.0)), r"`bodies.disc.inertia` must be from 1e-24 to"),
    # meshes
    (lambda: quads(quads=[[0, 4, 3, 1], [3, 6, 7, 4]]), "quadrilateral 0 is folded"),
    (lambda: quads(quads=[[0, 3, 4, 1]]), r"`face_sides` has \(2, 5\), which is no side"),
    (lambda: CurvedPadMesh(30e-3, 6e-3, 3, 2, radius=16e-3), "deeper than the `height` of 0.006 m"),
    (lambda: FingertipMesh(8e-3, 10), "`elements_around` must be a multiple of 4, but is 10"),
    # materials; more in `test_material`
    (lambda: Prony(**RUBBER, moduli=[1e5], tau=[0.1, 1.0]), "as many `moduli` as .* 1 and 2"),
    (lambda: resting(material=Stretched(**RUBBER, tau=0.01)), "1.2; divide both J and E by that"),
    (lambda: small(pads={"L": Pad(MESH, SERIES, inertial=True)}),
     "`L` needs a material of one retardation time, being inertial"),
    # laws
    (lambda: SoftContact(1e5, 1.0, 1e5, 1.0, friction=None), "`friction` must be a function or a"),
    (lambda: ran(friction=rated(lambda N: N.mean().expand_as(N))),
     r"aten\.mean\.default, which couples contact points at .*test_"),
    (lambda: ran(friction=rated(lambda N: N / N.numel())), "points together .*numel"),
    (lambda: resting(friction=rated(lambda N: torch.eye(4, 2).double() @ N)),
     "of `L` must take three tensors .*RuntimeError"),
    (lambda: controller(FEEDBACK, **ONE | {"pushes": {"x": "disc.x", "y": "disc.y"}}),
     "must give one effort for each of"),
    (lambda: controller(FEEDBACK, feed_forward={"z": "F"}, **ONE), "`feed_forward` names z, but"),
    (lambda: StateFeedback([[1.0, 2.0], [1.0]]), "rows of one length"),
    (lambda: looped(lambda *seen: 3.0), r"law of `actuators.x` must .* TypeError: .* gives 3\."),
    (lambda: looped(lambda *seen: next(NUMBERS) * seen[3]), "`actuators.x`: The law changed betwe"),
    # signals, bodies and rigs
    (lambda: Profile([0.0, 0.0], [1.0, 2.0]), "increase strictly"),
    (lambda: Body(1.0, Circle(0.1), y="loose"), "`y` must be 'free', .* but is 'loose'"),
    (lambda: Body(0.4, Circle(0.02), inertia=1e-4, inertia_ratio=2.0), "but is 2.0; leave it out"),
    (lambda: small(contacts={"d": Contact("P", "disc", LAW)}), r"contacts\.d: .* body as `c`"),
    (lambda: small(contacts={"d": Contact("Q", "disc", LAW)}), "`d` is between `Q` and `disc`"),
    (lambda: small(pads={"P": Pad(MESH, SOFT, base="disc")}), "to the body `disc` itself"),
    (lambda: driven(PD(1.0, 1.0), "disc.up"), r"`x` speaks of `disc\.up`, .*there are disc\.x"),
    (lambda: driven(PD(1.0, 1.0))(0.0, torch.zeros(33).double()), "no signal `w`; it has none"),
    (lambda: odeint(nn.Identity(), f64(0.0), T, method=METHOD), r"torchsoft\.Rig, but got Iden"),
    (lambda: odeint(m := coarse(), grasped(m), T, method=METHOD, options={"stepsize": 1e-3}),
     r"no option \['stepsize'\]; it"),
    (lambda: Pad(MESH, SOFT, origin=(10**400, 0)), "`origin.*must be"),
    (lambda: paper(COARSE).run(T, rtol=10**400), "`rtol` must be"),
]  # fmt: skip


@pytest.mark.parametrize("row", range(len(PARTS)))
def test_what_cannot_be_a_part_or_a_call_is_rejected(row):
    call, expected = PARTS[row]
    with pytest.raises(REJECTIONS, match=expected):
        call()


def test_a_coupled_law_is_rejected_after_its_pointwise_twin():
    """For one point both have the same expression, which is compiled already."""
    model = still(COARSE, friction=rated(lambda N: N, mu=0.49))
    simulate(model, T, y0=rest(model).detach())
    with pytest.raises(ValueError, match="other rates for several points together"):
        ran(friction=rated(lambda N: N.sum().expand_as(N), mu=0.49))


def test_squares_that_share_a_corner_are_connected():
    mesh = quads(
        points=[[0, 0], [0, 1], [1, 0], [1, 1], [1, 2], [2, 1], [2, 2]],
        quads=[[0, 2, 3, 1], [3, 5, 6, 4]], face=[[4, 6]], bonded=[[0, 2]],
    )  # fmt: skip
    assert len(mesh.nodes) == 7


def test_a_slip_law_that_supplies_power_is_reported():
    assert check_slip("c", Coulomb(0.8, 0.7), 500.0) == ""
    for wrong in (lambda E, F_N, R: 1.5 * E / R, lambda E, F_N, R: E - F_N):
        assert "must be from 0 to the effort" in check_slip("c", wrong, 500.0)


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
    still = hold(y_d=0.0486, F_ff=-80.0)
    return {"reference": Reference(x_d=Turned(change), **still.signals)}


FORWARD = {"gradient": "forward", "wrt": ["contact.K_x"]}
RUNS = [
    ({"t": f64(0.0, 0.1, 0.1)}, r"increase strictly .* t\[1:3\]"),
    ({"t": f64(0.0, NAN)}, "finite"),
    ({"t": T.clone().requires_grad_()}, "`t` must not require a gradient"),
    ({"y0": torch.full((376,), NAN).double()}, "must be finite, but component 0"),
    ({"tolerance": 1e-14}, "`tolerance` must be at least 1e-10 N"),
    ({"step": 1e-3, "rtol": 1e-4}, "`step` and `rtol or atol` each say which steps to take"),
    ({"knots": f64(0.0, 1e-3)}, "`knots` must go from"),
    (FORWARD, r"`contact.K_x` is not .*; did you mean `contact.K_t`\?"),
    ({"gradient": "discrete", "wrt": ["pad.E"]}, "`wrt` names the parameters of .*'forward'"),
    (signal(lambda value, t: torch.where(t > 2e-3, torch.nan, value)),
     r"the signal `x_d` of the reference is not finite at t = 0\.00"),
    (signal(lambda value, t: value + 1e-6 * torch.rand_like(t)), "gives other values when asked"),
]  # fmt: skip


@pytest.fixture(scope="module")
def start():
    model = coarse()
    return model, grasped(model)


@pytest.mark.parametrize("row", range(len(RUNS)))
def test_invalid_arguments_of_a_run_are_rejected(row, start):
    changes, expected = RUNS[row]
    with pytest.raises(ValueError, match=expected):
        simulate(**{"rig": start[0], "t": T, "y0": start[1]} | changes)


@pytest.mark.parametrize(
    "name", ["rig", "t", "y0", "reference", "gradient", "step", "tolerance", "rtol", "atol"]
)
def test_odd_values_of_an_argument_of_a_run_are_rejected_with_its_name(name, start):
    model, y0 = start
    tensors = y0.to("meta"), y0.to_sparse(), y0.to(torch.complex128), y0.bool(), y0[:-1]
    for odd in ("x", True, [], {}, object(), 1j, NAN, float("inf"), -1e-3, 0.0, *tensors):
        given = {"rig": model, "t": T, "y0": y0} | {name: odd}
        with pytest.raises((TypeError, ValueError), match=rf"`{name.replace('y0', 'y0?')}` must"):
            simulate(**given)


@pytest.mark.parametrize("name", ["gradient", "wrt", "touch"])
def test_odd_names_of_a_run_are_rejected(name, start):
    for odd in ("x", None, True, 3, NAN, np.zeros(3), f64(1, 2), [3], {}):
        given = {"gradient": "forward", "wrt": ["gravity"]} | {name: odd}
        with pytest.raises(ValueError, match=f"`{name}` must be"):
            simulate(start[0], T, y0=start[1], **given)


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.vmap])
@pytest.mark.parametrize("by", ["y0", "t", "knots"])
def test_a_run_in_a_transform_of_torch_func_is_rejected_with_the_way_on(by, transform, start):
    rig, y0 = start
    calls = {
        "y0": lambda x: simulate(rig, T, y0=list(y0 * x)),
        "t": lambda x: simulate(rig, T * x, y0=y0),
        "knots": lambda x: Profile([0.0, 1.0], torch.stack([x, x])),
    }
    x = f64(1.0) if transform is torch.func.vmap else f64(1.0)[0]
    with pytest.raises(ValueError, match=r"inside a transform of torch\.func.*gradient='discrete'"):
        transform(calls[by])(x)


def grouped(model: Rig) -> None:
    """A group that no part of the rig is in."""
    model.groups, model.pad = ("pad",), KelvinVoigt(**RUBBER, tau=0.01)


SPOILT = [
    (lambda m: m.parameter("pad.E").detach().fill_(0.0), r"`.*\.E` must be from 1 to .* but is 0"),
    (lambda m: m.parameter("pad.E").detach().fill_(1e308), r"`.*\.E` must be below 1e\+100"),
    (lambda m: m.parameter("contact.mu_k").detach().fill_(0.9), "mu_k = 0.9 > mu_s = 0.8"),
    (lambda m: m.float(), "`gravity` must be float64"),
    (lambda m: setattr(m.parameter("pad.E"), "data", torch.ones(2).double()), "be one number"),
    (grouped, "`pad.E` belongs to no body, pad"),
    (lambda m: setattr(m.contacts["L"].law, "friction", Coulomb(0.3, 0.4)), "mu_k = 0.4 > mu_s ="),
    (lambda m: m.reference["x_d"].times.fill_(NAN), "`x_d` of the reference is none any more"),
]  # fmt: skip


@pytest.mark.parametrize("row", range(len(SPOILT)))
def test_a_rig_changed_in_place_to_the_impossible_is_rejected(row, start):
    spoil, expected = SPOILT[row]
    model = coarse()
    model.reference = hold(x_d=0.06, y_d=0.0486, F_ff=-80.0)
    spoil(model)
    with pytest.raises(ValueError, match=expected):
        simulate(model, T, y0=start[1])


def test_another_mode_or_device_of_torch_is_rejected(start):
    model, y0 = start
    with torch.device("meta"), pytest.raises(ValueError, match=r"set_default_device\('cpu'\)"):
        simulate(model, T, y0=y0)
    with torch.inference_mode(), pytest.raises(ValueError, match=r"use torch.no_grad\(\)"):
        rest(model)
    with torch.autograd.forward_ad.dual_level(), pytest.raises(ValueError, match="has a tangent"):
        simulate(model, T, y0=torch.autograd.forward_ad.make_dual(y0, y0))
