"""Odd calls of the public names: wrong types, shapes, dtypes, names and numbers. Every one is
refused with one sentence.

What is built of odd parts may be refused where it is built or where it is run.
"""

import copy
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from conftest import coarse, f64, grasp, times
from torch import nn

from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    Coulomb,
    Ellipse,
    GeneralisedKelvin,
    KelvinVoigt,
    NoEquilibrium,
    Pad,
    PadMesh,
    Parameters,
    Profile,
    Prony,
    Reference,
    Rig,
    Sampled,
    Shape,
    SimulationFailed,
    SmoothSlip,
    SoftContact,
    SoftGrasp,
    StandardLinearSolid,
    hold,
    press,
    rest,
    simulate,
)  # fmt: skip

pytestmark = pytest.mark.slow

REFUSALS = (ValueError, TypeError, KeyError, NotImplementedError, SimulationFailed, NoEquilibrium)
T = times(4e-3, 3)
NAN, INF = float("nan"), float("inf")
NOT_A_NUMBER: list[Any] = [
    None,
    "3",
    "abc",
    True,
    [],
    {},
    object(),
    1j,
    NAN,
    INF,
    -INF,
    np.zeros(2),
    f64(1.0, 2.0),
]
NOT_POSITIVE: list[Any] = [*NOT_A_NUMBER, 0.0, -1.0]

Call = tuple[str, Callable[[], Any]]


def of_simulate() -> Iterator[Call]:
    model = coarse(pad__elements_x=24)
    y0, model.reference = grasp(model, (0.01, 0.0))
    size = model.layout.size
    run = lambda **changes: simulate(
        changes.pop("rig", model), changes.pop("t", T), **({"y0": y0} | changes)
    )
    tensors: list[Any] = [
        3, "x", [0.0, 1.0], {}, object(), True, np.linspace(0, 1, size), y0.float(), y0.half(),
        y0.to(torch.complex128), y0.to("meta"),
        y0.to_sparse(), f64(), f64(1.0), y0[None], y0 * NAN, y0 / 0, y0.long(), y0.bool(),
        torch.stack((y0, y0)), y0[:-1], torch.tensor(1.0),
    ]  # fmt: skip
    for i, odd in enumerate(tensors):
        yield f"y0 #{i}", lambda odd=odd: run(y0=odd)
    for i, odd in enumerate(
        [
            *tensors,
            None,
            T.flip(0),
            T[:1],
            T[[0, 0, 1]],
            T.clone().requires_grad_(),
            T * 1e300,
            T + 1e16,
            T * 1e-320,
        ]
    ):
        yield f"t #{i}", lambda odd=odd: run(t=odd)
    for i, odd in enumerate(
        [None, 3, "model", SoftGrasp, Parameters(), nn.Linear(1, 1), model.pads["L"], model.forward]
    ):
        yield f"rig #{i}", lambda odd=odd: run(rig=odd)
    for name in ("step", "tolerance", "rtol", "atol"):
        for odd in (*NOT_POSITIVE, f64(1.0)[0], 1e-300):
            if odd is None and name != "tolerance":  # which is not given then
                continue
            yield f"{name} = {odd!r:.20}", lambda name=name, odd=odd: run(**{name: odd})
    yield "tolerance below rounding", lambda: run(tolerance=1e-14)
    for odd in (
        3,
        "x",
        Profile([0.0], [1.0]),
        Reference(),
        {},
        hold(x_d=0.06),
        Reference,
        model,
    ):
        yield f"reference = {type(odd).__name__}", lambda odd=odd: run(reference=odd)
    for odd in (None, "", "Discrete", "adjoint", "forwards", 3, True, ["none"], ("discrete",), {}):
        yield f"gradient = {odd!r}", lambda odd=odd: run(gradient=odd)
    for odd in (
        "pad.E",
        None,
        3,
        [3],
        ["pad.Q"],
        ["E"],
        [""],
        ["contact.epsilon"],
        [model.pad.E],
        {"pad.E": 1},
        [],
        ["pad.e"],
    ):
        yield f"wrt = {odd!r:.30}", lambda odd=odd: run(gradient="forward", wrt=odd)
    for route in ("none", "discrete"):
        yield f"wrt with {route}", lambda route=route: run(gradient=route, wrt=["pad.E"])
        yield (
            f"dy0 with {route}",
            lambda route=route: run(gradient=route, dy0=torch.zeros(size, 1).double()),
        )
        yield f"rigid with {route}", lambda route=route: run(gradient=route, rigid=True)
    for i, odd in enumerate(
        [
            y0,
            torch.zeros(size, 1),
            np.zeros((size, 1)),
            torch.full((size, 1), NAN).double(),
            3,
            "x",
            torch.zeros(size + 1, 1).double(),
        ]
    ):
        yield f"dy0 #{i}", lambda odd=odd: run(gradient="forward", wrt=["pad.E"], dy0=odd)

    def inside(context: Any, **options: Any) -> Any:
        with context:
            return run(**options)

    yield (
        "forward under inference_mode",
        lambda: inside(torch.inference_mode(), gradient="forward", wrt=["pad.E"]),
    )

    def of_E(E: torch.Tensor) -> torch.Tensor:
        call = lambda value: torch.func.functional_call(
            _Simulated(model, y0), {"model.pad.E": value}, ()
        )
        return call(E)

    yield "torch.func.grad", lambda: torch.func.grad(of_E)(f64(7e5)[0])
    yield "torch.func.vmap", lambda: torch.func.vmap(of_E)(f64(7e5, 8e5))
    yield "torch.func.jvp", lambda: torch.func.jvp(of_E, (f64(7e5)[0],), (f64(1.0)[0],))
    yield "a gradient of a gradient", lambda: _ours(lambda: _twice(of_E))
    yield "a dual y0", lambda: _dual(y0, lambda dual: run(y0=dual))
    for kind in (torch.float32, torch.float16, torch.bfloat16, torch.complex128):
        yield f"a model in {kind}", lambda kind=kind: run(rig=copy.deepcopy(model).to(kind))
    yield "a model on meta", lambda: run(rig=copy.deepcopy(model).to("meta"))
    yield "another default device", lambda: inside(torch.device("meta"))
    yield "a state that is not finite", lambda: run(gradient="discrete", y0=y0 * NAN)
    yield "y0 of another rig", lambda: run(y0=grasp(coarse(pad__elements_x=26))[0])
    ended = run(gradient="discrete")
    for odd in (NAN, INF, -INF):
        for row in (0, -1):
            weights = torch.ones(len(T), dtype=torch.float64)
            weights[row] = odd
            yield (
                f"a cotangent {odd} at {row}",
                lambda w=weights: _ours(lambda: ended["theta"].backward(w, retain_graph=True)),
            )
    yield (
        "the gradient of a moment",
        lambda: _ours(lambda: ended["bracket_moment"].sum().backward(retain_graph=True)),
    )
    for odd in ("", "x", "xC", 3, None, "theta_"):
        yield f"channel {odd!r}", lambda odd=odd: ended[odd]


def _ours(function: Callable[[], Any]) -> Any:
    """Failed gradients count as refusals, other errors of torch do not."""
    from torchsoft.solve.adjoint import GradientFailed

    try:
        return function()
    except GradientFailed as failed:
        raise ValueError(str(failed)) from failed


def _twice(function: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    E = f64(7e5)[0].requires_grad_()
    (slope,) = torch.autograd.grad(function(E), E, create_graph=True)
    return torch.autograd.grad(slope, E)


class _Simulated(nn.Module):
    """A run as a module, for functional_call."""

    def __init__(self, model: SoftGrasp, y0: torch.Tensor) -> None:
        super().__init__()
        self.model, self.y0 = model, y0

    def forward(self) -> torch.Tensor:
        return simulate(self.model, T, y0=self.y0, gradient="discrete")["theta"][-1]


def _dual(x: torch.Tensor, function: Callable[[torch.Tensor], Any]) -> Any:
    with torch.autograd.forward_ad.dual_level():
        return function(torch.autograd.forward_ad.make_dual(x, torch.ones_like(x)))


def of_parts() -> Iterator[Call]:
    settings = coarse(pad__elements_x=24).settings
    p, c = settings.pad, settings.contact

    def grasping(**parts: Any) -> Any:
        model = SoftGrasp(settings, **parts)
        return simulate(model, T)

    def contact(*values: Any, **options: Any) -> Any:
        law = SoftContact(*values, **({"friction": Coulomb(0.5, 0.4)} | options))
        model = SoftGrasp(settings)
        model.contact = law
        for touching in model.contacts.values():
            touching.law = law
        return simulate(model, T)

    for odd in NOT_POSITIVE:
        yield f"Circle({odd!r:.20})", lambda odd=odd: grasping(shape=Circle(odd))
        yield f"Ellipse(a={odd!r:.20})", lambda odd=odd: grasping(shape=Ellipse(odd, 19e-3))
        for i in range(5):
            values: list[Any] = [p.E, p.nu, p.rho, p.tau, p.depth]
            values[i] = 0.5 if i == 1 and isinstance(odd, float) else odd
            yield (
                f"KelvinVoigt #{i} = {odd!r:.20}",
                lambda v=values: grasping(material=KelvinVoigt(*v)),
            )
        for i in range(2):
            series = [1e5, 1.0]
            series[i] = odd
            common = {"E": p.E, "nu": p.nu, "rho": p.rho, "depth": p.depth, "tau": [series[1], 2.0]}
            yield (
                f"Prony #{i} = {odd!r:.20}",
                lambda q=common, x=series[0]: grasping(material=Prony(**q, moduli=[x, 1e5])),
            )
            yield (
                f"GeneralisedKelvin #{i} = {odd!r:.20}",
                lambda q=common, x=1e-6 * series[0] if i else series[0]: grasping(
                    material=GeneralisedKelvin(**q, J=[x, 0.1])
                ),
            )
        for i in (0, 2):
            values = [c.K_n, c.R_n, c.K_t, c.R_t]
            values[i] = odd
            yield f"SoftContact #{i} = {odd!r:.20}", lambda v=values: contact(*v)
        yield (
            f"v_s = {odd!r:.20}",
            lambda odd=odd: grasping(friction=SmoothSlip(0.8, 0.7, odd, 10.0)),
        )
        yield f"Body mass {odd!r:.20}", lambda odd=odd: _falling(Body(odd, Circle(0.02)))
        yield (
            f"node_spacing = {odd!r:.20}",
            lambda odd=odd: contact(c.K_n, c.R_n, c.K_t, c.R_t, node_spacing=odd),
        )
    yield "an ellipse too slim", lambda: grasping(shape=Ellipse(5e-3, 20e-3))
    yield (
        "E_instant below E",
        lambda: grasping(material=StandardLinearSolid(p.E, 0.5 * p.E, p.nu, p.rho, p.tau, p.depth)),
    )
    yield "mu_k above mu_s", lambda: grasping(friction=Coulomb(0.4, 0.5))
    yield (
        "eta + R_t = 0",
        lambda: contact(c.K_n, c.R_n, c.K_t, 0.0, friction=SmoothSlip(0.8, 0.7, 0.05, 0.0)),
    )
    for shape in (Bulged(), Stretched(), Short(), Turned(), Flat()):
        yield f"shape {type(shape).__name__}", lambda shape=shape: grasping(shape=shape)
    yield "a law in training", lambda: grasping(friction=Dropping())
    yield "a law in float32", lambda: grasping(friction=Learned())
    yield (
        "a law that branches",
        lambda: grasping(friction=lambda E, F_N, R: E / R if E > F_N else 0 * E),
    )
    yield "a law of two numbers", lambda: grasping(friction=lambda E, F_N: E)
    yield "no law", lambda: grasping(friction=3)
    yield "no shape", lambda: grasping(shape="disc")
    for odd in (3, "free", None, NAN, "drive"):
        if odd != "free":
            yield (
                f"a coordinate {odd!r}",
                lambda odd=odd: _falling(
                    Body(0.4, Circle(0.02), theta=odd, x="drivn" if odd == 3 else "free")
                ),
            )


def _falling(body: Body) -> Any:
    """A body over a pad."""
    mesh, rubber = PadMesh(0.04, 4e-3, 8, 2), KelvinVoigt(7e5, 0.45, 1100.0, 0.01, 0.044)
    law = SoftContact(1e5, 400.0, 1e5, 400.0, friction=SmoothSlip(0.8, 0.7, 0.05, 10.0))
    rig = Rig(
        bodies={"disc": body},
        pads={"P": Pad(mesh, rubber)},
        contacts={"c": Contact("P", "disc", law)},
    )
    return simulate(rig, T, y0=torch.zeros(rig.layout.size, dtype=torch.float64))


class Bulged(Shape):
    """Its phi is no distance: squared."""

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        d = x.norm(dim=-1)
        return (d * d / 0.02 - 0.02) * 0.6, x / d[..., None]

    def gyration(self) -> torch.Tensor:
        return f64(2e-4)[0]

    def support(self, direction: torch.Tensor) -> torch.Tensor:
        return 0.02 * direction.norm(dim=-1)


class Stretched(Bulged):
    """Its normal is too long."""

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        d = x.norm(dim=-1)
        return d - 0.02, 1.1 * x / d[..., None]


class Turned(Bulged):
    """Its normal is not the slope of its distance."""

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        d = x.norm(dim=-1)
        return d - 0.02, torch.stack((x[..., 1], -x[..., 0]), -1) / d[..., None]


class Short(Stretched):
    """It reaches further than its support says, so that points would be missed."""

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        d = x.norm(dim=-1)
        return d - 0.02, x / d[..., None]

    def support(self, direction: torch.Tensor) -> torch.Tensor:
        return 0.01 * direction.norm(dim=-1)


class Flat(Short):
    """It has no moment of inertia."""

    support = Bulged.support

    def gyration(self) -> torch.Tensor:
        return f64(0.0)[0]


class Dropping(nn.Module):
    """In training, so that no two calls are alike."""

    def __init__(self) -> None:
        super().__init__()
        self.dropout = nn.Dropout(0.5)

    def forward(self, E: torch.Tensor, F_N: torch.Tensor, R: torch.Tensor) -> torch.Tensor:
        return self.dropout((E - 0.5 * F_N).clamp(min=0.0)) / (R + 10.0)


class Learned(Dropping):
    """With a layer in torch's default dtype."""

    def __init__(self) -> None:
        super().__init__()
        self.dropout, self.layer = nn.Identity(), nn.Linear(2, 1, dtype=torch.float32)


def of_values() -> Iterator[Call]:
    model = coarse(pad__elements_x=24)
    y0, model.reference = grasp(model)
    bad: dict[str, list[float]] = {
        "pad.E": [0.0, -1.0], "pad.nu": [0.5, -1.0, 0.7], "pad.rho": [0.0], "pad.tau": [0.0, -1e-3],
        "pad.depth": [0.0], "contact.K_n": [0.0, -1e5], "contact.R_n": [-1.0],
        "contact.K_t": [0.0, -1.0], "contact.R_t": [-1.0], "contact.epsilon": [0.0],
        "contact.mu_s": [-0.1], "contact.mu_k": [-0.1], "contact.v_s": [0.0, -1.0],
        "contact.eta": [-1.0], "control.K_81": [-1.0],
        "control.R_80": [-1.0], "control.K_98": [-1.0], "control.R_99": [-1.0],
        "disc.radius": [0.0, -1e-3], "disc.mass": [0.0, -1.0],
        "bracket.mass": [0.0, -1.0], "scenario.gravity": [-9.81],
    }  # fmt: skip
    for name, values in bad.items():
        for value in (*values, NAN, INF, 1e308):

            def put(name: str = name, value: float = value) -> Any:
                other = copy.deepcopy(model)
                other.parameter(name).data.fill_(value)
                return simulate(other, T, y0=y0)

            yield f"{name} = {value} in place", put
            if value == values[0]:
                yield (
                    f"{name} = {value}, statics",
                    lambda name=name, value=value: rest(_with(model, name, value)),
                )
    for name in ("pad.E", "contact.K_n", "disc.mass", "control.x.Kp"):
        yield (
            f"{name} of two numbers",
            lambda name=name: simulate(_with(model, name, f64(1.0, 2.0)), T, y0=y0),
        )
        yield (
            f"{name} in float32",
            lambda name=name: simulate(_with(model, name, torch.tensor(1.0)), T, y0=y0),
        )

    def lone(group: str, part: nn.Module) -> Any:
        other = copy.deepcopy(model)
        setattr(other, group, part)
        return simulate(other, T, y0=y0)

    yield (
        "a material in the group only",
        lambda: lone("pad", KelvinVoigt(7e5, 0.45, 1100.0, 0.01, 0.044)),
    )
    yield "a contact in the group only", lambda: lone("contact", copy.deepcopy(model.contact))
    yield "a disc in the group only", lambda: lone("disc", Body(0.4, Circle(0.019)))
    for odd in ("pad.Young", "", "E", 3, None):
        yield f"parameter({odd!r})", lambda odd=odd: model.parameter(odd)
    for odd in (*NOT_A_NUMBER[:7], NAN, INF, 1.0):
        yield f"press at {odd!r:.20}", lambda odd=odd: press(model, odd)


def _with(model: SoftGrasp, name: str, value: Any) -> SoftGrasp:
    other = copy.deepcopy(model)
    parameter = other.parameter(name)
    parameter.data = value if isinstance(value, torch.Tensor) else f64(value)[0]
    return other


def of_lists() -> Iterator[Call]:
    for odd in (
        [],
        [1.0, 0.0],
        [0.0, 0.0],
        [NAN, 1.0],
        [0.0, INF],
        None,
        "01",
        [[0.0, 1.0]],
        [0.0, 1.0, 2.0],
        ["a", "b"],
        3,
    ):
        yield f"Profile times {odd!r}", lambda odd=odd: Profile(odd, [0.0, 1.0])  # pyright: ignore
        yield f"Sampled times {odd!r}", lambda odd=odd: Sampled(odd, [0.0, 1.0])  # pyright: ignore
    for odd in ([], [1.0], [NAN, 1.0], [0.0, INF], None, [[0.0, 1.0]], ["a", "b"], 3):
        yield f"Profile values {odd!r}", lambda odd=odd: Profile([0.0, 1.0], odd)  # pyright: ignore
    for odd in (3, None, "x", [0.0, 1.0], lambda t: t):
        yield f"a signal {type(odd).__name__}", lambda odd=odd: Reference(x_d=odd)  # pyright: ignore
    for odd in (
        (0, 1e-3, 8, 2),
        (0.1, -1e-3, 8, 2),
        (0.1, 1e-3, 0, 2),
        (0.1, 1e-3, 8, 0),
        (0.1, 1e-3, 8.5, 2),
        (NAN, 1e-3, 8, 2),
        ("a", 1, 1, 1),
    ):
        yield (
            f"PadMesh{odd}",
            lambda odd=odd: Pad(PadMesh(*odd), KelvinVoigt(7e5, 0.45, 1100.0, 0.01, 0.044)),
        )
    for odd in (-1, 1.5, "2", None):
        yield (
            f"points = {odd!r}",
            lambda odd=odd: Pad(
                PadMesh(0.04, 4e-3, 8, 2), KelvinVoigt(7e5, 0.45, 1100.0, 0.01, 0.044), points=odd
            ),
        )
    model = coarse(pad__elements_x=24)
    for odd in (None, 3, "disc", "disc.up", "dish.x", ""):
        yield (
            f"measures {odd!r}",
            lambda odd=odd: _acting(
                model, Actuator(odd, "bracket.x", PD(1.0, 1.0), setpoint="x_d")
            ),
        )
        yield (
            f"pushes {odd!r}",
            lambda odd=odd: _acting(model, Actuator("disc.x", odd, PD(1.0, 1.0), setpoint="x_d")),
        )
        yield (
            f"setpoint {odd!r}",
            lambda odd=odd: _acting(
                model, Actuator("disc.x", "bracket.x", PD(1.0, 1.0), setpoint=odd)
            ),
        )
    for odd in (None, 3, "law", lambda w: w):
        yield (
            f"an actuator's law {type(odd).__name__}",
            lambda odd=odd: _acting(model, Actuator("disc.x", "bracket.x", odd, setpoint="x_d")),
        )


def _acting(model: SoftGrasp, actuator: Actuator) -> Any:
    other = copy.deepcopy(model)
    other.actuators["x"] = actuator  # pyright: ignore
    del other.control["x"]  # pyright: ignore
    return simulate(other, T)


class Accepted(Exception):
    """What should have been refused."""


def _refused(what: str, call: Callable[[], Any]) -> None:
    call()
    raise Accepted(what)


@pytest.mark.parametrize("table", [of_simulate, of_parts, of_values, of_lists])
def test_odd_calls_are_refused_with_a_sentence(
    tally: Callable[[str], Any], table: Callable[[], Iterator[Call]]
) -> None:
    line = tally(f"odd calls {table.__name__.replace('_', ' ')}")
    for what, call in table():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            line.call(what, lambda what=what, call=call: _refused(what, call), REFUSALS)
