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
    StandardLinearSolid,
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
REFUSALS = ValueError, TypeError, IndexError, NotImplementedError, NoEquilibrium
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


def disc(**wrong: Callable[..., Tensor]) -> object:
    return ran(shape=Disc(**wrong))


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
    (lambda: resting(shape=Superellipse(20e-3, 20e-3, 1.9)),
     r"bodies\.disc\.shape: parameter `n` must be from 2 to 20, but is 1.9"),
    (lambda: resting(shape=Superellipse(20e-3, 20e-3, NAN)),
     r"bodies\.disc\.shape: parameter `n` must be finite"),
    (lambda: resting(shape=Superellipse(20e-3, 6e-3, 4.0)), "differ by more than a factor of 3"),
    (lambda: resting(shape=RoundedBox(20e-3, 9e-3, 9.1e-3)),
     "corners' radius 0.0091 is larger than half of the box, 0.009"),
    (lambda: resting(shape=RoundedBox(20e-3, 9e-3, 0.0)),
     r"bodies\.disc\.shape: parameter `radius` must be from 1e-06 to 10 m, but is 0"),
    (lambda: Contour(CIRCLE[:7]), "must be at least 8 places around a contour, but are 7"),
    (lambda: Contour([*CIRCLE, CIRCLE[-1]]), "has the same place twice: point 23"),
    (lambda: Contour([*CIRCLE[:-1], [0.1, INF]]),
     r"`points` must be finite numbers of the shape \(n, 2\)"),
    (lambda: Contour("pear.csv"), r"of the shape \(n, 2\), but is 'pear.csv'"),
    (lambda: Contour(FLAT), "turns by .* degrees"),
    (lambda: Contour(EIGHT), "a contour that crosses itself"),
    (lambda: Contour(NECK, tolerance=1e-3),
     "so sharp, or so narrow, that the nearest point is the only one up to"),
    (lambda: Contour(WAVY, tolerance=1e-14),
     "a contour of 512 pieces still passes the points, or the spline .*, at .* m"),
    (lambda: Contour(CIRCLE, tolerance=0), "`tolerance` must be positive and finite, but is 0"),
    (lambda: RoundedPolygon(TRIANGLE, 9e-3),
     "corners of radius 0.009 do not fit on side . of the polygon"),
    (lambda: RoundedPolygon([[-2, -2], [1.6, 2], [2, -2], [-1.6, 2]], 0.1),
     "the polygon crosses itself"),  # no area
    (lambda: RoundedPolygon(TRIANGLE, 0.0), "`radius` must be positive and finite, but is 0"),
    (lambda: RoundedPolygon([[0, 0], [1, 0]], 0.1), "`vertices` must be 3 to 64 places, but are 2"),
    (lambda: RoundedPolygon([[0, 0], [1, 0], [True, "a"]], 0.1),
     "`vertices` must be finite numbers"),
    (lambda: disc(phi=lambda d: 0.9 * (d - 0.02)), "phi is not a distance"),
    (lambda: disc(n=lambda n: 1.01 * n), "its normal is not of unit length"),
    (lambda: disc(n=lambda n: -n), "its normal is not the slope of phi"),
    (lambda: disc(support=lambda d: 0.019 * d.norm(dim=-1)),
     "`support` is less than how far it reaches"),
    (lambda: disc(support=lambda d: 0.021 * d.norm(dim=-1)),
     "`support` is more than how far it reaches"),
    (lambda: disc(gyration=lambda: f64(-1.0)[0]),
     r"`bodies.disc.inertia` must be from 1e-24 to 1e\+06 kg.m2"),
    (lambda: check_shape("disc", Oval(0.03, 0.02)), "called `round`, but is not"),
    # meshes and pads
    (lambda: quads(quads=[[0, 3, 4]]), "`quads` must be quadrilaterals of four numbers"),
    (lambda: quads(quads=[[0, 3, 4, 9]]), "numbers of the 9 points, from 0 on"),
    (lambda: quads(quads=[[0, 4, 3, 1], *QUADS[1:]]), "quadrilateral 0 is folded"),
    (lambda: quads(quads=[[0, 3, 4, 1], [9, 10, 11, 12]], points=APART), "not connected"),
    (lambda: quads(face=[[2, 4]]), r"`face_sides` has \(2, 4\), which is no side on the boundary"),
    (lambda: quads(face=[[1, 4]]), r"`face_sides` has \(1, 4\), which is no side on the boundary"),
    (lambda: quads(face=[[2, 5], [6, 7]]), "`face_sides` must be one line with two ends"),
    (lambda: quads(face=[[2, 5], [5, 8], [0, 1], [1, 2], [8, 7], [7, 6], [6, 3], [3, 0]]),
    "one line with two ends"),
    (lambda: quads(bonded=[[0, 3, 6]]), r"`bonded_sides` has \(0, 3, 6\), which is no side"),
    (lambda: quads(points=[[0, 0, 0]]), r"`points` must be finite numbers of the shape \(n, 2\)"),
    (lambda: curved(radius=14e-3), "`radius` must be at least half of the length, 0.015 m"),
    (lambda: curved(radius=16e-3), "makes the arc deeper than the `height` of 0.006 m"),
    (lambda: curved(radius=NAN), "`radius` must be at least half of the length"),
    (lambda: curved(bonded_edges=("top",)), "must be some of base, left, right, but is"),
    (lambda: curved(bonded_edges=()), "must be some of base, left, right, but is"),
    (lambda: curved(bonded_sides=True), "`bonded_sides` must be left out"),
    (lambda: FingertipMesh(8e-3, 10), "`elements_around` must be a multiple of 4, but is 10"),
    (lambda: FingertipMesh(0.0, 8), "`radius` must be positive and finite, but is 0"),
    (lambda: small(pads=lambda pad, _: {"P": pad(points=-1)}),
     "`points` must be a whole number from 0 on, but is -1"),
    # materials
    (lambda: Prony(**RUBBER, moduli=[1e5], tau=[0.1, 1.0]),
     "as many `moduli` as `tau`, from 1 to 20, but has 1 and 2"),
    (lambda: GeneralisedKelvin(**RUBBER, J=[], tau=[]),
     "as many `J` as `tau`, from 1 to 20, but has 0 and 0"),
    (lambda: Prony(**RUBBER, moduli="12", tau=[0.1, 1.0]),
     "`E` must be a list of numbers, but is '12'"),
    (lambda: GeneralisedKelvin(**RUBBER, J=[0.1, True], tau=[1, 2]),
     "`J_2` must be a number, but is True"),
    (lambda: resting(material=Prony(**RUBBER, moduli=[1e5, 2e5], tau=[0.1, 0.1])),
     "two relaxation times are equal"),
    (lambda: resting(material=Prony(**RUBBER, moduli=[-2e5], tau=[0.1])),
     r"`E_1` must be from 1 to 1e\+13 Pa, but"),
    (lambda: resting(material=Prony(**RUBBER, moduli=[1e5], tau=[5e-5])),
     "tau_instant = 0.0001 s must be below the shortest"),
    (lambda: resting(material=GeneralisedKelvin(**RUBBER, J=[0.6, 0.5], tau=[0.1, 1])),
    "fractions J sum to 1.1, above one"),
    (lambda: resting(material=GeneralisedKelvin(**RUBBER, J=[0.6], tau=[0.0])),
     "`tau_1` must be from 1e-09 to"),
    (lambda: resting(material=GeneralisedKelvin(**RUBBER, J=[NAN], tau=[0.1])),
     "`J_1` must be finite, but is nan"),
    (lambda: resting(material=StandardLinearSolid(**RUBBER, E_instant=1e5, tau=0.1)),
    "E_instant is below E"),
    (lambda: chain([0.7, 0.5], [0.01, 0.1]),
     r"must sum to one, but \[0.7, 0.5\] sum to 1.2; divide both J and E by that sum"),
    (lambda: chain([1.2, -0.2], [0.01, 0.1]),
     "the fractions J of the material of `L` must not be negative"),
    (lambda: chain([0.5, NAN], [0.01, 0.1]),
     "the fractions J of the material of `L` must not be negative"),
    (lambda: chain([0.5, 0.5], [0.01, 0.0]),
     "times tau of the material of `L` must be positive and finite"),
    (lambda: chain([0.5, 0.5], [0.01, INF]),
     "times tau of the material of `L` must be positive and finite"),
    (lambda: chain([0.5, 0.5], [0.01]),
     r"`tau` of the material of `L` must have shape \(branches,\) = \(2,\)"),
    (lambda: chain([[0.5, 0.5]], [0.01, 0.1]), "`J` of the material of `L` must have shape"),
    (lambda: chain([0.5, 0.5], 0.01),
     "`tau of the material of L` must be a float64 tensor, but is float"),
    (lambda: chain([0.5, 0.5], torch.ones(2)), "`tau of the material of L` must be float64"),
    (lambda: chain([1.0, 0.0]), "`chain` of the material of `L` must give two tensors, J and tau"),
    (lambda: small(pads=lambda *_: {"L": Pad(PadMesh(0.04, 4e-3, 8, 2), Prony(**RUBBER,
    moduli=[1e5], tau=[0.1]), inertial=True)}),
     "`L` needs a material of one retardation time, being inertial, but has"),
    # laws of contact
    (lambda: SoftContact(1e5, 1.0, 1e5, 1.0, friction=None),
     "`friction` must be a function or a module"),
    (lambda: slipping(rated(lambda N: N.mean().expand_as(N))),
     r"aten\.mean\.default, which couples contact points at .*test_"),
    (lambda: slipping(rated(lambda N: N.reshape(-1).cumsum(0).reshape(N.shape))), "cumsum"),
    (lambda: slipping(rated(lambda N: N.reshape(-1).flip(0).reshape(N.shape))),
    r"aten\.flip\.default, which couples contact"),
    (lambda: slipping(rated(lambda N: N.reshape(-1)[0] + 0 * N)),
     "couples contact points at .*test_refusals"),
    (lambda: slipping(rated(lambda N: N / N.numel())),
     "several points at once other rates .*numel"),
    (lambda: slipping(rated(lambda N: (-1 - N).sqrt())),
     "the slip law of `L` gives nan at an effort of 0.001 N"),
    (lambda: rest(still(friction=of_one_point)),
     "the slip law of `L` must take three tensors .*RuntimeError"),
    (lambda: slipping(nn.Dropout()), r"the slip law of `L` must take three tensors .*TypeError"),
    (lambda: slipping(lambda E, F_N, R: None),
     "the slip law of `L` must give a tensor of shape .*, but gives NoneType"),
    # control laws
    (lambda: fed(pushes={"x": "disc.x", "y": "disc.y"}),
     r"gives \(1,\) for one state, but must give one effort for each of"),
    (lambda: fed(measures="disc.x"), "are sequences of names"),
    (lambda: fed(feed_forward={"z": "F"}), "`feed_forward` names z, but `pushes` has x"),
    (lambda: fed(setpoints=["w", "v"]), "measures 1 coordinates and follows 2 set-points"),
    (lambda: fed(measures=[3]), "must be a name, or a sequence of them"),
    (lambda: fed(law=lambda w, q: q), "must be a torch module"),
    (lambda: StateFeedback([[1.0, 2.0], [1.0]]), "rows of one length"),
    (lambda: looped(lambda w, w_dot, f, q, q_dot: 3.0), MUST + r"TypeError: for one state it gives "
                                                               r"3\.0"),
    (lambda: looped(lambda w, w_dot, f, q, q_dot: torch.stack((w, q))), MUST + r".* a tensor of "
                                                                               r"shape \(2,\)"),
    (lambda: looped(lambda w, q: w - q), MUST + "TypeError: .* takes 2 positional arguments but 5 "
                                                "were given"),
    (lambda: looped(lambda w, w_dot, f, q, q_dot: (w - q)[3]), MUST + "IndexError"),
    (lambda: looped(lambda w, w_dot, f, q, q_dot: next(NUMBERS) * q),
     "`actuators.x`: The law changed between calls"),
    # signals
    (lambda: Profile([0.0, 0.0], [1.0, 2.0]), "increase strictly"),
    (lambda: Sampled([0.0, NAN], [1.0, 2.0]), "increase strictly"),
    (lambda: Profile([0.0, 1.0], [1.0]), "per time"),
    (lambda: Profile([0.0], [NAN]), "finite"),
    (lambda: Profile([], []), "from one time on"),
    (lambda: Sampled([0.0, 1.0], [1.0, 2.0], [0.0, INF]),
     "`rates` must hold one finite number per time"),
    (lambda: Reference(x=0.1), "the signal `x` must be a module such as `Profile`, but is float"),
    # bodies and rigs
    (lambda: Body(1.0, Circle(0.1), y="loose"),
     "`y` must be 'free', 'driven' or a number, but is 'loose'"),
    (lambda: Body(1.0), "needs an `inertia`, or a `shape`"),
    (lambda: Body.uniform(Circle(0.02), density=0, depth=0.044),
     "`density` must be positive and finite, but is 0"),
    (lambda: small(pads=lambda pad, _: {"P": pad(base="hand")}),
     "pad `P` is bonded to `hand`, but the bodies are disc"),
    (lambda: small(pads=lambda pad, _: {"P": pad(base="disc")}),
     "is bonded to the body `disc` itself"),
    (lambda: small(contacts=lambda _, c: {"d": c("Q", "disc")}),
     "contact `d` is between `Q` and `disc`, which are not"),
    (lambda: small(contacts=lambda _, c: {"d": c("P", "dish")}),
     "contact `d` is between `P` and `dish`, which are not"),
    (lambda: small(contacts=lambda _, c: {"d": c("P", "disc")}),
     r"contacts\.d: it is between the same pad and body as `c`"),
    (lambda: small(bodies=lambda *_: {"disc": Body(0.4, theta=0.0)}),
     "contact `c` needs a shape, but the body `disc` has"),
    (lambda: small(
        bodies=lambda *_: {"hand": Body(0.4, inertia=1e-3)}, pads=lambda pad,
        _: {"P": pad(base="hand", inertial=True)}
    ), "pad `P` is inertial and its base `hand` may turn"),
    (lambda: pushed(pushes="disc.up"),
     r"actuator `a` speaks of `disc\.up`, which is not a coordinate; there are disc\.x"),
    (lambda: pushed(measures="dish.x"),
     r"actuator `a` speaks of `dish\.x`, which is not a coordinate"),
    (lambda: pushed()(0.0, torch.zeros(33, dtype=torch.float64)),
     "the reference has no signal `w`; it has none"),
    (lambda: coarse().parameter("pad.Young"),
     r"`pad.Young` is not a parameter of this rig; known: .*pad\.E"),
    (lambda: coarse()(0.0, torch.zeros(376)), "`y` must be float64 of shape"),
    # verbs
    (lambda: odeint(nn.Identity(), f64(0.0), T, method=METHOD),
     r"integrates a torchsoft\.Rig, but got Identity"),
    (lambda: odeint(m := coarse(), grasped(m), T, method=METHOD, options={"stepsize": 1e-3}),
    r"no option \['stepsize'\]; it"),
    (lambda: check_array("x", f64(1.0).to_sparse()), "`x` must be "),
    (lambda: torch.func.grad(lambda x: check_array("x", x) or x.sum())(f64(1.0)),
    "inside a transform of torch.func"),
]  # fmt: skip


HUGE = 10**400
"""An integer that no float holds, which ended in an OverflowError."""
INTEGERS: dict[str, Callable[[], Any]] = {
    "parameter": lambda: Body(HUGE),
    "coordinate": lambda: Body(1.0, theta=HUGE),
    "length": lambda: PadMesh(HUGE, 1e-2, 10, 2),
    "values": lambda: Profile([0, 1], [0, HUGE]),
    "times": lambda: Profile([0, HUGE], [0, 1]),
    "origin": lambda: Pad(PadMesh(0.1, 1e-2, 10, 2), KelvinVoigt(tau=1e-2, **RUBBER),
                          origin=(HUGE, 0)),
    "rtol": lambda: paper(COARSE).run(T, rtol=HUGE),
    "atol": lambda: paper(COARSE).run(T, atol=HUGE),
    "t": lambda: paper(COARSE).run([0, HUGE]),
}  # fmt: skip


@pytest.mark.parametrize("what", INTEGERS)
def test_integers_of_400_digits_are_refused_in_a_short_sentence(what):
    with pytest.raises(ValueError, match=r"`.*must be") as refused:
        INTEGERS[what]()
    assert len(str(refused.value)) < 200


class Simulated(nn.Module):
    """A run by its modulus, start or times."""

    def __init__(self) -> None:
        super().__init__()
        self.model = coarse()
        self.y0 = rest(self.model).detach()

    def forward(self, *, y0: Any = None, t: Any = T) -> Tensor:
        start = rest(self.model) if y0 is None else y0
        return simulate(self.model, t, y0=start, gradient="discrete")["x_C"][-1]


TRANSFORMED: dict[str, Any] = {
    "E": lambda run, E: torch.func.functional_call(run, {"model.pads.L.material.E": E}),
    "y0": lambda run, E: run(y0=run.y0 * E),
    "list": lambda run, E: run(y0=list(run.y0 * E)),
    "t": lambda run, E: run(y0=run.y0, t=T * E),
    "knots": lambda run, E: Profile([0.0, 1.0], torch.stack([E, E])),
}


@pytest.mark.parametrize("by", TRANSFORMED)
@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev, torch.func.vmap])
def test_a_run_in_a_transform_of_torch_func_is_refused_in_a_sentence(by, transform):
    """grad ended in "Cannot access data pointer of Tensor that doesn't have storage"."""
    run, E = Simulated(), f64(1.0)
    with pytest.raises(ValueError, match=r"inside a transform of torch\.func.*gradient='discrete'"):
        transform(lambda x: TRANSFORMED[by](run, x))(E if transform is torch.func.vmap else E[0])


@pytest.mark.parametrize("row", range(len(PARTS)))
def test_a_part_or_call_that_is_none_is_refused(row):
    call, sentence = PARTS[row]
    with pytest.raises(REFUSALS, match=sentence):
        call()


def test_a_coupled_law_is_refused_after_its_pointwise_twin():
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
    ({"t": f64(0.0)}, "two times or more"),
    ({"t": f64(0.0, NAN)}, "finite"),
    ({"t": T.clone().requires_grad_()}, "`t` must not require a gradient"),
    ({"t": 1e-300 * T}, "must be further apart than 1e-12 s"),
    ({"t": f64(0.0, 1e299)}, r"ask for 1e\+300 steps, .*by tolerance no step is longer than 0\.1 "
                             r"s"),
    ({"y0": torch.zeros(376, dtype=torch.complex128)}, "must be float64"),
    ({"y0": f64(0.0, 0.0, 0.0)}, "must be float64 of shape"),
    ({"y0": torch.full((376,), NAN).double()}, "must be finite, but component 0"),
    ({"y0": np.full(376, "0")}, "`y0` must be numbers"),
    ({"rig": Rig}, "`rig` must be a Rig"),
    ({"reference": {}}, "`reference` must be a Reference, but is dict"),
    *(({name: value}, f"`{name}` must be positive") for name in ("step",
    "tolerance") for value in (0.0, -1e-3, NAN)),
    ({"step": True}, "`step` must be positive and finite, but is True"),
    ({"step": 1e-300}, r"at most 1e[+]08 can be taken"),
    ({"tolerance": 1e-14}, "`tolerance` must be at least 1e-10 N"),
    ({"step": 1e-3, "rtol": 1e-4}, "`step` and `rtol or atol` each say which steps to take"),
    ({"rtol": -1.0}, "`rtol` must be positive"),
    ({"rtol": 2.0}, "`rtol` must be below 1, but is 2; where only `atol` is given"),
    ({"knots": f64(0.0, 1e-3)}, "`knots` must go from"),
    ({"gradient": "Discrete"}, "`gradient` must be one of none, discrete, forward"),
    ({"wrt": "pad.E", "gradient": "forward"}, "`wrt` must be a list of parameters' names"),
    ({"rigid": True}, "belong to gradient='forward'"),
    (FORWARD | {"dy0": torch.zeros(376, 1) > 0}, "`dy0` must be float64"),
    (FORWARD | {"dy0": torch.zeros(3, 1).double()},
     r"`dy0` must have shape \(376, 1\), or more columns, but has"),
    (FORWARD | {"wrt": ["pad.E", "contact.K_x"]},
     r"`contact.K_x` is not a parameter of this rig; "
     r"did you mean `contact.K_t`\? .known: .*contact.K_n"),
    (FORWARD | {"wrt": []}, "gradient='forward' needs the parameters' names `wrt`, or directions "
                            "`dy0`"),
    ({"gradient": "discrete", "wrt": ["pad.E"]},
     "`wrt` names the parameters of gradient='forward'"),
    (signal(lambda value, t: torch.where(t > 2e-3, torch.nan, value)),
     r"the signal `x_d` of the reference is not finite at t = 0\.00"),
    (signal(lambda value, t: value + 1e-6 * torch.rand_like(t)),
     "gives other values when asked again"),
    (signal(lambda value, t: value.float()), "the signal `x_d` must give float64"),
]  # fmt: skip


@pytest.fixture(scope="module")
def start():
    model = coarse()
    return model, grasped(model)


@pytest.mark.parametrize("row", range(len(RUNS)))
def test_a_run_that_is_none_is_refused(row, start):
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
    (filled("pad.E", 1e308), r"parameter `materials.rubber.E` must be below 1e\+100"),
    (
        filled("contact.K_n", -1.2e5),
        r"parameter `.*K_n` must be from 0.001 to 1e\+12 N/m, but is -120000",
    ),
    (filled("contact.K_n", NAN), r"parameter `.*K_n` must be finite, but is nan"),
    (filled("pad.nu", 0.5), r"parameter `.*nu` must be from -0\.999 to 0\.4999"),
    (filled("control.K_81", -1.0), r"parameter `.*Kp` must be from 0 to 1e\+12"),
    (filled("gravity", NAN), r"parameter `gravity` must be finite"),
    (filled("contact.mu_k", 0.9), "mu_k = 0.9 > mu_s = 0.8"),
    (
        filled("contact.R_t", 0.0),
        r"R_t must be positive",
    ),
    (lambda m: m.float(), "`gravity` must be float64"),
    (lambda m: m.to("meta"), "on meta"),
    (
        lambda m: setattr(m.parameter("pad.E"), "data", torch.ones(2).double()),
        r"parameter `materials.rubber.E` must be one number",
    ),
    (
        grouped,
        "`pad.E` belongs to no body, pad",
    ),
    (
        lambda m: setattr(m.contacts["L"].law, "friction", Coulomb(0.3, 0.4)),
        "mu_k = 0.4 > mu_s = 0.3",
    ),
    (lambda m: setattr(m.contacts["L"], "body", "dish"), "contact `L` is between `L` and `dish`"),
    (
        lambda m: m.reference["x_d"].times.fill_(NAN),
        "the signal `x_d` of the reference is none any more",
    ),
]


@pytest.mark.parametrize("row", range(len(SPOILT)))
def test_a_model_that_was_spoilt_is_refused(row, start):
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


def test_another_mode_or_device_of_torch_is_refused(start):
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


class Dropping(nn.Module):
    """A law with a dropout."""

    def __init__(self) -> None:
        super().__init__()
        self.dropout = nn.Dropout(0.5)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return self.dropout((E - 0.5 * F_N).clamp(min=0.0)) / R


def test_a_law_in_training_is_refused_after_it_ran_in_evaluation(
    start,
):
    model = still(COARSE, friction=Dropping())
    model.reference = start[0].reference
    simulate(model.eval(), T, y0=start[1])
    with pytest.raises(TypeError, match="the random operation"):
        simulate(model.train(), T, y0=start[1])


def test_a_slip_law_that_supplies_power_is_told_of():
    for right in (SmoothSlip(0.8, 0.7, 5e-3), Coulomb(0.8, 0.7)):
        assert check_slip("c", right, 500.0) == ""
    for wrong in (lambda E, F_N, R: 1.5 * E / R, lambda E, F_N, R: E - F_N):
        assert "must be from 0 to the effort" in check_slip("c", wrong, 500.0)


def test_compiled_rates_refuse_what_they_cannot_give(start):
    """Inertial pads, and states at which there are no forces; they go on after that."""
    with pytest.raises(NotImplementedError, match="inertial pads"):
        Rates(coarse(pad__inertial=True))
    rates, y = Rates(start[0]), random_state(start[0], 0).numpy()
    fine = rates(0.0, y)
    with pytest.raises(SimulationFailed, match="no forces"):
        rates(0.0, np.full_like(y, np.nan))
    np.testing.assert_allclose(rates(0.0, y), fine, rtol=1e-9, atol=1e-9 * np.abs(fine).max())
