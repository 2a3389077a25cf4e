"""Odd calls of the public names: wrong types, shapes, dtypes, names and numbers. Every one is
refused with one sentence, where a part is built or where it is run."""

import copy
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from conftest import coarse, f64, grasp, times
from torch import Tensor, nn

from hostile.trial import Tally
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
    RoundedBox,
    Sampled,
    SimulationFailed,
    SmoothSlip,
    SoftContact,
    SoftGrasp,
    StandardLinearSolid,
    hold,
    press,
    rest,
    simulate,
)
from torchsoft.paper.rig import NAMES
from torchsoft.quantity import quantities
from torchsoft.solve.adjoint import GradientFailed

pytestmark = pytest.mark.slow

REFUSALS = (
    ValueError, TypeError, KeyError, NotImplementedError, SimulationFailed, NoEquilibrium,
    GradientFailed,
)  # fmt: skip
T = times(4e-3, 3)
NAN, INF = math.nan, math.inf
NO_NUMBER: list[Any] = [
    None, "3", "abc", True, [], {}, object(), 1j, NAN, INF, -INF, np.zeros(2), f64(1.0, 2.0),
]  # fmt: skip
NOT_POSITIVE = [*NO_NUMBER, 0.0, -1.0]
NO_NAME: list[Any] = [None, 3, "", "disc", "disc.up", "dish.x"]

Attack = tuple[Callable[..., Any], dict[str, Any], dict[str, list[Any]]]
"""A call, its right arguments, and odd values of some of them."""

# parts
# ----------------------------------------------------------------------

RUBBER = {"E": 7.5e5, "nu": 0.45, "rho": 1100.0, "depth": 0.044}
SERIES = RUBBER | {"tau": [1.0, 2.0]}
SPRINGS = {"K_n": 1e5, "R_n": 400.0, "K_t": 1e5, "R_t": 400.0, "friction": Coulomb(0.5, 0.4)}
SLIP = {"mu_s": 0.8, "mu_k": 0.7, "v_s": 0.05, "eta": 10.0}
MESH = {"length": 0.04, "height": 4e-3, "elements_x": 8, "elements_y": 2}
PUSH = {"measures": "disc.x", "pushes": "bracket.x", "law": PD(1.0, 1.0), "setpoint": "x_d"}


def grasping(**parts: Any) -> Any:
    return simulate(SoftGrasp(coarse(pad__elements_x=24).settings, **parts), T)


def falling(body: Body, mesh: PadMesh | None = None, points: Any = 0, **law: Any) -> Any:
    """A body over a pad."""
    pad = Pad(mesh or PadMesh(**MESH), KelvinVoigt(**RUBBER, tau=0.01), points=points)
    touch = SoftContact(**SPRINGS | law)
    rig = Rig(bodies={"disc": body}, pads={"P": pad}, contacts={"c": Contact("P", "disc", touch)})
    return simulate(rig, T, y0=torch.zeros(rig.layout.size, dtype=torch.float64))


def acting(**how: Any) -> Any:
    model = coarse(pad__elements_x=24)
    model.actuators["x"] = Actuator(**how)  # pyright: ignore
    del model.control["x"]  # pyright: ignore
    return simulate(model, T)


DISC = Body(0.4, Circle(0.02))
PARTS: list[tuple[type, dict[str, Any], Callable[[Any], Any]]] = [
    (Circle, {"radius": 0.019}, lambda part: grasping(shape=part)),
    (Ellipse, {"a": 0.019, "b": 0.019}, lambda part: grasping(shape=part)),
    (RoundedBox, {"half_width": 0.019, "half_height": 0.019, "radius": 0.01},
     lambda part: grasping(shape=part)),
    (KelvinVoigt, RUBBER | {"tau": 0.01}, lambda part: grasping(material=part)),
    (StandardLinearSolid, RUBBER | {"tau": 0.01, "E_instant": 1e6},
     lambda part: grasping(material=part)),
    (Prony, SERIES | {"moduli": [1e5, 1e5]}, lambda part: grasping(material=part)),
    (GeneralisedKelvin, SERIES | {"J": [0.1, 0.1]}, lambda part: grasping(material=part)),
    (SmoothSlip, SLIP, lambda part: grasping(friction=part)),
    (Coulomb, {"mu_s": 0.8, "mu_k": 0.7}, lambda part: grasping(friction=part)),
    (Body, {"mass": 0.4, "shape": Circle(0.02), "inertia": 1e-4}, falling),
    (PD, {"Kp": 1.0, "Kd": 1.0}, lambda part: acting(**PUSH | {"law": part})),
    (dict, SPRINGS, lambda law: falling(DISC, **law)),
]  # fmt: skip
"""Constructors, right arguments, and a run with the part."""


def of_constructors() -> Iterator[Attack]:
    """Every declared quantity: no number, or just beyond its bounds."""
    for part, right, used in PARTS:
        declared = quantities(SoftContact if part is dict else part)
        for name in declared.keys() & right.keys():
            low, high = declared[name].low, declared[name].high
            odds = [*NO_NUMBER, low - 1.0, 1.1 * high]
            if isinstance(right[name], list):
                odds = [[odd, right[name][1]] for odd in odds]
            build: Any = lambda part=part, used=used, **given: used(part(**given))
            build.__name__ = part.__name__
            yield build, right, {name: odds}


def of_parts() -> Iterator[Attack]:
    branching = lambda E, F_N, R: E / R if E > F_N else 0 * E
    yield (
        grasping,
        {},
        {
            "shape": ["disc", Ellipse(5e-3, 20e-3)],
            "friction": [3, Learned(), branching, lambda E, F_N: E],
        },
    )
    yield lambda **mesh: falling(DISC, PadMesh(**mesh)), MESH, dict.fromkeys(MESH, NOT_POSITIVE)
    yield falling, {"body": DISC}, {"node_spacing": NOT_POSITIVE, "points": [-1, 1.5, "2", None]}
    fixed: Any = lambda x: falling(Body(0.4, Circle(0.02), x=x))
    yield fixed, {}, {"x": [None, NAN, "drive", "drivn"]}
    laws = [None, 3, "law", lambda w: w]
    yield acting, PUSH, dict.fromkeys(("measures", "pushes", "setpoint"), NO_NAME) | {"law": laws}
    lists = [[], [1.0], [NAN, 1.0], [0.0, INF], None, [[0.0, 1.0]], ["a", "b"], 3, [0.0, 1.0, 2.0]]
    odds = {"times": [*lists, [1.0, 0.0], [0.0, 0.0], "01"], "values": lists}
    for kind in (Profile, Sampled):
        yield kind, {"times": [0.0, 1.0], "values": [0.0, 1.0]}, odds
    yield Reference, {}, {"x_d": [3, None, "x", [0.0, 1.0], lambda t: t]}
    yield press, {"model": coarse(pad__elements_x=24)}, {"bracket_height": [*NO_NUMBER, 1.0]}


class Learned(nn.Module):
    """A law with a layer in torch's default dtype."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(2, 1, dtype=torch.float32)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return self.layer(torch.stack((E, F_N), -1))[..., 0] / R


# runs
# ----------------------------------------------------------------------


def of_runs() -> Iterator[Attack]:
    model = coarse(pad__elements_x=24)
    y0, model.reference = grasp(model, (0.01, 0.0))
    right = {"rig": model, "t": T, "y0": y0}
    size, zeros = len(y0), torch.zeros(len(y0), 1, dtype=torch.float64)
    tensors: list[Any] = [
        3, "x", [0.0, 1.0], {}, object(), True, np.linspace(0, 1, size), y0.half(), y0 / 0,
        y0.to(torch.complex128), y0.to("meta"), y0.to_sparse(), f64(), f64(1.0), y0[None],
        y0.long(), y0.bool(), torch.stack((y0, y0)), y0[:-1], torch.tensor(1.0),
        grasp(coarse(pad__elements_x=26))[0],
    ]  # fmt: skip
    rigs = None, 3, "model", Parameters(), nn.Linear(1, 1), model.pads["L"], model.forward
    references = 3, "x", Profile([0.0], [1.0]), Reference(), hold(x_d=0.06), Reference, model
    lengths = [*NOT_POSITIVE[1:], f64(1.0)[0], 1e-300]
    yield (
        simulate,
        right,
        {
            "y0": tensors,
            "t": [*tensors, None, T.flip(0), T * 1e300, T + 1e16, T * 1e-320],
            "rig": [*rigs],
            "reference": [*references],
            "gradient": [None, "", "adjoint", "forwards", 3, True, ["none"], ("discrete",), {}],
            **dict.fromkeys(("step", "tolerance", "rtol", "atol"), lengths),
        },
    )
    known = [None, 3, [3], ["pad.Q"], ["E"], [""], [model.pad.E], {"pad.E": 1}, ["pad.e"]]
    rows = [y0, zeros.float(), zeros.numpy(), zeros / 0, 3, "x", torch.cat((zeros, zeros))]
    forward = right | {"gradient": "forward", "wrt": ["pad.E"]}
    yield simulate, forward, {"wrt": known, "dy0": rows}
    for route in ("none", "discrete"):
        odds = {"wrt": [["pad.E"]], "dy0": [zeros], "rigid": [True]}
        yield simulate, right | {"gradient": route}, odds

    class Run(nn.Module):
        """A run as a module, for functional_call."""

        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self) -> Tensor:
            return simulate(model, T, y0=y0, gradient="discrete")["theta"][-1]

    def of_E(E: Tensor) -> Tensor:
        return torch.func.functional_call(Run(), {"model.pad.E": E}, ())

    def twice(E: Tensor) -> Any:
        (slope,) = torch.autograd.grad(of_E(E.requires_grad_()), E, create_graph=True)
        return torch.autograd.grad(slope, E)

    def dual(y: Tensor) -> Any:
        with torch.autograd.forward_ad.dual_level():
            tangent = torch.autograd.forward_ad.make_dual(y, torch.ones_like(y))
            return simulate(model, T, y0=tangent)

    E = f64(7e5)[0]
    yield lambda E: torch.func.grad(of_E)(E), {}, {"E": [E]}
    yield lambda E: torch.func.vmap(of_E)(E), {}, {"E": [f64(7e5, 8e5)]}
    yield lambda E: torch.func.jvp(of_E, (E,), (E,)), {}, {"E": [E]}
    yield twice, {}, {"E": [E]}
    yield dual, {}, {"y": [y0]}
    kinds = [torch.float16, torch.bfloat16, torch.complex128]
    yield lambda dtype: simulate(copy.deepcopy(model).to(dtype), T, y0=y0), {}, {"dtype": kinds}
    ended = simulate(**right)
    yield lambda channel: ended[channel], {}, {"channel": ["", "x", "xC", 3, None, "theta_"]}
    yield model.parameter, {}, {"name": ["pad.Young", "", "E", 3, None]}


def of_values() -> Iterator[Attack]:
    """Values put in the place of a model's, and parts in its groups only."""
    model = coarse(pad__elements_x=24)
    y0, model.reference = grasp(model)

    def put(name: str, value: Any, statics: bool = False) -> Any:
        other = copy.deepcopy(model)
        other.parameter(name).data = value if isinstance(value, Tensor) else f64(value)[0]
        return rest(other) if statics else simulate(other, T, y0=y0)

    for name in NAMES:
        declared = model.quantity(name)
        low, high = (declared.low, declared.high) if declared else (NAN, NAN)
        odds = [low - 1.0, 1.1 * high, NAN, INF, 1e308, f64(1.0, 2.0), torch.tensor(1.0)]
        yield put, {"name": name}, {"value": odds}
        yield put, {"name": name, "statics": True}, {"value": odds[:1]}

    def lone(group: str, part: nn.Module) -> Any:
        other = copy.deepcopy(model)
        setattr(other, group, part)
        return simulate(other, T, y0=y0)

    rubber = KelvinVoigt(**RUBBER, tau=0.01)
    for group, part in (("pad", rubber), ("contact", copy.deepcopy(model.contact)), ("disc", DISC)):
        yield lone, {"group": group}, {"part": [part]}


class Accepted(Exception):
    """Raised by a call that should have been refused."""


@pytest.mark.parametrize("attacks", [of_constructors, of_parts, of_runs, of_values])
def test_odd_calls_are_refused_with_a_sentence(
    tally: Callable[[str], Tally], attacks: Callable[[], Iterator[Attack]]
) -> None:
    line = tally(f"odd calls {attacks.__name__.replace('_', ' ')}")
    for call, right, odds in attacks():
        for name, values in odds.items():
            for i, odd in enumerate(values):

                def refused(call: Any = call, given: dict[str, Any] = right | {name: odd}) -> None:
                    call(**given)
                    raise Accepted

                attack = f"{getattr(call, '__name__', call)}: {name} #{i} = {odd!r:.40}"
                line.call(attack, refused, REFUSALS)
