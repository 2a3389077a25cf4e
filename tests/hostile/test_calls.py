"""Odd calls of the public names: wrong types, shapes, dtypes, names and numbers. Every one is
refused with one sentence, where a part is built or where it is run."""

import copy
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RUBBER, coarse, f64, grasp, press, rest, still, times
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
    Profile,
    Prony,
    Reference,
    Rig,
    RoundedBox,
    Sampled,
    SimulationFailed,
    SmoothSlip,
    SoftContact,
    StandardLinearSolid,
    hold,
    simulate,
)
from torchsoft.quantity import quantities
from torchsoft.solve.gradients import GradientFailed

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

SERIES = RUBBER | {"tau": [1.0, 2.0]}
SPRINGS = {"K_n": 1e5, "R_n": 400.0, "K_t": 1e5, "R_t": 400.0, "friction": Coulomb(0.5, 0.4)}
SLIP = {"mu_s": 0.8, "mu_k": 0.7, "v_s": 0.05}
MESH = {"length": 0.04, "height": 4e-3, "elements_x": 8, "elements_y": 2}
PUSH = {"measures": "disc.x", "pushes": "bracket.x", "law": PD(1.0, 1.0), "setpoint": "x_d"}


def grasping(**parts: Any) -> Any:
    model = still(COARSE | {"pad.elements_x": 24}, **parts)
    return simulate(model, T, y0=rest(model).detach())


def falling(body: Any = None, law: Any = None, mesh: Any = None, points: Any = 0) -> Any:
    """A body over a pad."""
    pad = Pad(mesh or PadMesh(**MESH), KelvinVoigt(**RUBBER, tau=0.01), points=points)
    touch = Contact("P", "disc", law or SoftContact(**SPRINGS))
    rig = Rig(bodies={"disc": body or DISC}, pads={"P": pad}, contacts={"c": touch})
    return simulate(rig, T, y0=torch.zeros(rig.layout.size, dtype=torch.float64))


def acting(**how: Any) -> Any:
    model = coarse(pad__elements_x=24)
    y0 = rest(model).detach()
    model.actuators["x"] = Actuator(**PUSH | how)
    return simulate(model, T, y0=y0)


DISC = Body(0.4, Circle(0.02))
PARTS: list[tuple[type, dict[str, Any], str, Callable[..., Any]]] = [
    (Circle, {"radius": 0.019}, "shape", grasping),
    (Ellipse, {"a": 0.019, "b": 0.019}, "shape", grasping),
    (RoundedBox, {"half_width": 0.019, "half_height": 0.019, "radius": 0.01}, "shape", grasping),
    (KelvinVoigt, RUBBER | {"tau": 0.01}, "material", grasping),
    (StandardLinearSolid, RUBBER | {"tau": 0.01, "E_instant": 1e6}, "material", grasping),
    (Prony, SERIES | {"moduli": [1e5, 1e5]}, "material", grasping),
    (GeneralisedKelvin, SERIES | {"J": [0.1, 0.1]}, "material", grasping),
    (SmoothSlip, SLIP, "friction", grasping),
    (Coulomb, {"mu_s": 0.8, "mu_k": 0.7}, "friction", grasping),
    (SoftContact, SPRINGS, "law", falling),
    (Body, {"mass": 0.4, "shape": Circle(0.02), "inertia": 1e-4}, "body", falling),
    (PD, {"Kp": 1.0, "Kd": 1.0}, "law", acting),
]
"""Constructors, right arguments, and a run with the part under a name."""


def of_constructors() -> Iterator[Attack]:
    """Every declared quantity: no number, or just beyond its bounds."""
    for part, right, role, used in PARTS:
        for name in quantities(part).keys() & right.keys():
            declared = quantities(part)[name]
            odds = [*NO_NUMBER, declared.low - 1.0, 1.1 * declared.high]
            if isinstance(right[name], list):
                odds = [[odd, right[name][1]] for odd in odds]
            build = lambda part=part, role=role, used=used, **given: used(**{role: part(**given)})
            yield build, right, {name: odds}


def of_parts() -> Iterator[Attack]:
    yield lambda **mesh: falling(mesh=PadMesh(**mesh)), MESH, dict.fromkeys(MESH, NOT_POSITIVE)
    yield lambda x: falling(Body(0.4, Circle(0.02), x=x)), {}, {"x": [None, NAN, "drive", ""]}
    spacing = lambda **how: falling(law=SoftContact(**SPRINGS, **how))
    yield spacing, {}, {"node_spacing": NOT_POSITIVE}
    yield falling, {}, {"points": [-1, 1.5, "2", None]}
    yield grasping, {}, {"shape": ["disc"], "friction": [3, lambda E, F_N: E]}
    names = dict.fromkeys(("measures", "pushes", "setpoint"), NO_NAME)
    yield acting, {}, names | {"law": [None, 3, "law", lambda w: w]}
    lists = [[], [1.0], [NAN, 1.0], [0.0, INF], None, [[0.0, 1.0]], ["a", "b"], "01", 3]
    for kind in (Profile, Sampled):
        yield kind, {"times": [0.0, 1.0], "values": [0.0, 1.0]}, {"times": lists, "values": lists}
    yield Reference, {}, {"x_d": [3, None, "x", [0.0, 1.0], lambda t: t]}
    starts = [odd for odd in NO_NUMBER if not isinstance(odd, dict)]
    for key in ("depth", "force"):
        starts += [{key: odd} for odd in NO_NUMBER]
    starts += [{}, {"depth": 1e-3, "force": 1.0}, "down"]
    yield press, {"rig": coarse(pad__elements_x=24)}, {"height": starts, "x": NO_NUMBER}


# runs
# ----------------------------------------------------------------------


def of_runs() -> Iterator[Attack]:
    model = coarse(pad__elements_x=24)
    y0, model.reference = grasp(model, (0.01, 0.0))
    right = {"rig": model, "t": T, "y0": y0}
    zeros, ones = torch.zeros(len(y0), 1, dtype=torch.float64), torch.ones_like(y0)
    tensors: list[Any] = [
        3, "x", {}, object(), True, y0 / 0,
        y0.to(torch.complex128), y0.to("meta"), y0.to_sparse(), f64(), f64(1.0), y0[None],
        y0.long(), y0.bool(), torch.stack((y0, y0)), y0[:-1], torch.tensor(1.0),
    ]  # fmt: skip
    lengths = [*NOT_POSITIVE[1:], f64(1.0)[0], 1e-300]
    yield (
        simulate,
        right,
        {
            "y0": [*tensors, [0.0, 1.0]],
            "t": [*tensors, None, T * 1e300, T + 1e16, T * 1e-320],
            "rig": [
                None,
                3,
                "model",
                PAPER,
                nn.Linear(1, 1),
                model.pads["L"],
                model.forward,
            ],
            "reference": [3, "x", Profile([0.0], [1.0]), Reference(), hold(x_d=0.06), model],
            "gradient": [None, "", "adjoint", "forwards", 3, True, ["none"], ("discrete",), {}],
            **dict.fromkeys(("step", "tolerance", "rtol", "atol"), lengths),
        },
    )
    known = [
        None,
        3,
        [3],
        ["pad.Q"],
        ["E"],
        [""],
        [model.parameter("pad.E")],
        {"pad.E": 1},
        ["pad.e"],
    ]
    rows = [y0, zeros / 0, 3, "x", torch.cat((zeros, zeros))]
    yield simulate, right | {"gradient": "forward", "wrt": ["pad.E"]}, {"wrt": known, "dy0": rows}
    discrete = right | {"gradient": "discrete"}
    yield simulate, discrete, {"wrt": [["pad.E"]], "dy0": [zeros], "rigid": [True]}
    of_y0 = lambda y: simulate(**discrete | {"y0": y})["theta"][-1]
    for transformed in (
        lambda y: torch.func.grad(of_y0)(y),
        lambda y: torch.func.vmap(of_y0)(torch.stack((y, y))),
        lambda y: torch.func.jvp(of_y0, (y,), (ones,)),
    ):
        yield transformed, {}, {"y": [y0]}
    ended = simulate(**right)
    yield lambda channel: ended[channel], {}, {"channel": ["", "x", "xC", 3, None, "theta_"]}
    yield model.parameter, {}, {"name": ["", "E", 3, None]}
    kinds = [torch.float16, torch.bfloat16, torch.complex128]
    yield lambda dtype: simulate(model.to(dtype), T, y0=y0), {}, {"dtype": kinds}


def of_values() -> Iterator[Attack]:
    """Values put in the place of a model's."""
    model = coarse(pad__elements_x=24)
    y0, model.reference = grasp(model)

    def put(name: str, value: float, statics: bool = False) -> Any:
        other = copy.deepcopy(model)
        other.parameter(name).data.fill_(value)
        return rest(other) if statics else simulate(other, T, y0=y0)

    known = [name for name in model.short.values() if "." in name]
    for name in known:
        declared = model.quantity(name)
        assert declared is not None
        odds = [declared.low - 1.0, 1.1 * declared.high, NAN, INF, 1e308]
        yield put, {"name": name}, {"value": odds}
        yield put, {"name": name, "statics": True}, {"value": odds[:1]}


class Accepted(Exception):
    """Raised by a call that should have been refused."""


@pytest.mark.parametrize("attacks", [of_constructors, of_parts, of_runs, of_values])
def test_odd_calls_are_refused_with_a_sentence(tally, attacks):
    line = tally(f"odd calls {attacks.__name__.replace('_', ' ')}")
    for call, right, odds in attacks():
        for name, values in odds.items():
            for odd in values:

                def refused(call: Any = call, given: dict[str, Any] = right | {name: odd}) -> None:
                    call(**given)
                    raise Accepted

                attack = f"{call.__name__} {[*right]}: {name} = {odd!r:.40}"
                line.call(attack, refused, REFUSALS)
