"""Static, frictionless equilibria of the paper's rig: the object at rest under its weight, and
clamped between the pads."""

import warnings

import torch
from torch import Tensor

from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.arguments import number
from torchsoft.physics.multibond import net_efforts
from torchsoft.physics.state import State
from torchsoft.physics.statics import RESIDUAL, NoEquilibrium, resting, standing
from torchsoft.physics.validity import check_values

MOMENT_ARM = 1e-2
"""Largest moment on the object without a warning, over its size and the load."""

CLEAR = 1e-16
"""Gap [m] between surfaces that just touch: above rounding errors, so that no force acts."""

TOUCHING = 30
"""Newton iterations for the height of first touch on an undeformed pad."""


def rest(model: SoftGrasp) -> Tensor:
    """State (size,): the object at rest on the lower pad under its weight at the scenario's x_C0,
    the upper pad just touching it from above."""
    check_statics(model)
    weightless = float((model.disc.mass * model.gravity).detach()) == 0.0
    at = torch.tensor(model.settings.scenario.x_C0, dtype=torch.float64)
    top, (below, above) = model.settings.pad.height, reaches(model)
    start, away = (
        top + below - 0.1 * top,
        torch.tensor(10 * (top + below + above), dtype=torch.float64),
    )
    state = touching(model, at, away) if weightless else balanced(model, at, start, away)
    x, y, _ = state.pose["disc"]
    return model.pack(
        state._replace(pose=state.pose | {"bracket": place(x, model.touch_height(y) + CLEAR)})
    )


def press(model: SoftGrasp, bracket_height: float) -> Tensor:
    """State (size,): the object between the pads, with the bracket held at `bracket_height` [m],
    without friction.

    Raises `NoEquilibrium` when the bracket is too high for its pad to touch the object, which sinks
    in under its weight.
    """
    check_statics(model)
    number("bracket_height", bracket_height)
    p, (below, above) = model.settings, reaches(model)
    face, top = bracket_height - p.bracket.cm_height - p.pad.height, p.pad.height
    x, y_Br = (
        torch.tensor(value, dtype=torch.float64) for value in (p.scenario.x_C0, bracket_height)
    )
    state = (
        None
        if face >= top + below + above
        else balanced(model, x, 0.5 * (top + below + face - above), y_Br)
    )
    if state is None or not bool(state.pads["U"].any()):
        raise NoEquilibrium(
            f"the bracket at {bracket_height} m is too high for its pad to touch the disc; lower it"
        )
    return model.pack(state)


@torch.no_grad()
def holding_force(model: SoftGrasp, y: Tensor) -> float:
    """Downward force [N] on the bracket that balances the normal forces of the upper pad in the
    frictionless state y (size,)."""
    pad, part = model.pads["U"], model.unpack(y).pads["U"]
    force = pad.elastic_force(part) if pad.inertial else part[0]
    return float(force[:, 1].sum())


def check_statics(model: SoftGrasp) -> None:
    """Raises `ValueError` for impossible parameters, and in inference mode, which has no graphs."""
    if torch.is_inference_mode_enabled():
        raise ValueError(
            "statics need torch's graphs, which torch.inference_mode() has not; use torch.no_grad()"
        )
    check_values(model)


def reaches(model: SoftGrasp) -> list[float]:
    """Extent of the object below and above its centre [m]."""
    return model.shape.support(torch.tensor([[0.0, -1.0], [0.0, 1.0]]).double()).tolist()


def place(x: Tensor, y: Tensor) -> Tensor:
    """Pose (3,) of a body at angle zero."""
    return torch.stack((x, y, torch.zeros_like(y)))


def touching(model: SoftGrasp, x: Tensor, y_Br: Tensor) -> State:
    """The object just touching the undeformed lower pad: the equilibrium of a weightless body."""
    state = model.unpack(torch.zeros(model.layout.size, dtype=torch.float64))
    y = torch.tensor(model.settings.pad.height + 0.9 * reaches(model)[0], dtype=torch.float64)
    for _ in range(TOUCHING):
        with torch.enable_grad():
            y = y.detach().requires_grad_()
            at = state._replace(pose={"disc": place(x, y), "bracket": place(x, y_Br)})
            deepest = model.penetration("L", at).max()
            (slope,) = torch.autograd.grad(deepest, y, retain_graph=True)
        y = y.detach() - deepest / slope  # its gradient is the implicit function theorem's
    return at._replace(pose=at.pose | {"disc": place(x, y)})


def balanced(model: SoftGrasp, x: Tensor, y: float, y_Br: Tensor) -> State:
    """The object in equilibrium at x [m], from the initial guess y [m] of its height, with the
    bracket held at y_Br [m]. Warns where the pads exert a moment on it."""
    pose = {"disc": place(x, torch.full_like(x, y)), "bracket": place(x, y_Br)}
    try:
        pose = resting(model, pose, {"disc": [1]}, actuators=(), residual=RESIDUAL)
    except NoEquilibrium as error:
        raise NoEquilibrium(
            f"no static equilibrium found: {error}; are the contact springs far stiffer than the "
            "pads?"
        ) from None
    state = model.unpack(standing(model, pose))
    with torch.no_grad():
        graph = model.evaluate(0.0, state, settled=True)
        moment = float(model.loads(graph, net_efforts(graph.ports, model.junctions))["disc"][2])
        load = sum(float(interface.F_N.sum()) for interface in graph.interfaces.values())
    if abs(moment) > MOMENT_ARM * model.shape.size() * load:
        warnings.warn(
            f"the object is held at theta = 0, where the pads turn it with {moment:.3g} N.m: a run "
            "from here begins with that",
            stacklevel=3,
        )
    return state
