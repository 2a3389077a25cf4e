"""States from coordinates of bodies: placed, moving, at rest on pads, touching or pressing."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.display import suggestion
from torchsoft.physics.arguments import number, tensor
from torchsoft.physics.contact import turned
from torchsoft.physics.graph import Graph
from torchsoft.physics.multibond import net_efforts
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.state import State
from torchsoft.physics.statics import (
    RESIDUAL,
    NoEquilibrium,
    no_signals,
    resting,
    standing,
    unstretched,
)
from torchsoft.physics.validity import check_values

REST = "rest"
"""The word for a coordinate in equilibrium."""

TOUCH = "touch"
"""The word for the height at which a body's pads just touch the bodies under them."""

PRESSES = "depth", "force"
"""Keys of a pressing start: way below "touch" [m], downward force [N]."""

RATES = {"v_x": "x", "v_y": "y", "omega": "theta"}
"""Rates by name, and the coordinates that they are of."""

UPWARDS = 0.1
"""Least upward component of the normal of a pad that can carry a body."""

MOMENT_ARM = 1e-2
"""Largest moment on a body at rest without a warning, over its size and the load."""

AWAY = 100.0
"""Height [m] of a body before its pads are lowered until they touch."""

CLEAR, DESCENTS = 1e-16, 50
"""Gap [m] between surfaces that just touch, above rounding errors, and the number of steps down to
it."""

Poses = dict[str, Tensor]
"""Poses (3,) [m, m, rad] by body."""

Starts = Mapping[str, Mapping[str, Any]]
"""Coordinates and rates of bodies by name."""


class NoPlace(NoEquilibrium):
    """A coordinate of a body that cannot start as asked for."""

    def __init__(self, body: str, axis: str, reason: str) -> None:
        super().__init__(f"`{axis}` of `{body}`: {reason}")
        self.body, self.axis, self.reason = body, axis, reason


def start(rig: Graph, bodies: Starts) -> Tensor:
    """Implementation of `Rig.state`."""
    for name in bodies:
        if name not in rig.bodies:
            raise ValueError(
                f"there is no body `{name}`; {suggestion(name, rig.bodies, 'the bodies are')}"
            )
    for name, body in rig.bodies.items():
        check_start(name, body.freedom, bodies.get(name, {}))
    check_values(rig)
    held, _ = rig.held(rig.follow(0.0))
    y = moving(rig, standing(rig, placed(rig, bodies, held)), bodies)
    warn_of_moments(rig, y, bodies)
    return y


@torch.no_grad()
def warn_of_moments(rig: Graph, y: Tensor, bodies: Starts) -> None:
    """Warns of bodies at rest whose angle was not given, where pads turn them."""
    named = [
        name for name, given in bodies.items()
        if given.get("y") == REST and "theta" not in given and 2 in rig.layout.free[name]
    ]  # fmt: skip
    if not named or any(pad.inertial for pad in rig.pads.values()):
        return
    graph = rig.evaluate(0.0, rig.unpack(y), settled=True)
    loads = rig.loads(graph, net_efforts(graph.ports, rig.junctions))
    pressed = sum(float(interface.F_N.sum()) for interface in graph.interfaces.values())
    for name in named:
        shape, moment = rig.bodies[name].shape, float(loads[name][2])
        if shape is None or shape.round:
            continue
        if abs(moment) > MOMENT_ARM * shape.size() * pressed:
            warn(
                f"`{name}` is held at theta = 0, where the pads turn it with {moment:.3g} N.m: a "
                'run from here begins with that; set theta = "rest", or another angle',
            )


def moving(rig: Graph, y: Tensor, bodies: Starts) -> Tensor:
    """The state y (size,) with the bodies' rates as given."""
    velocities = {}
    for name, axes in rig.layout.free.items():
        given, rates = bodies.get(name, {}), list(RATES)
        if any(rate in given for rate in rates):
            values = [scalar(f"{name}.{rates[i]}", given.get(rates[i], 0.0)) for i in axes]
            velocities["velocity", name] = torch.stack(values)
    parts = {part: y[where] for part, where in rig.layout.slices.items()} | velocities
    return torch.cat([parts[part] for part in rig.layout.slices]) if velocities else y


def placed(rig: Graph, bodies: Starts, held: Mapping[str, Tensor]) -> Poses:
    """Poses of bodies that start as given, by what `held` has of coordinates that are not free.

    First bodies rest, then others come down until they touch, then these are pressed and the
    resting ones give way. Differentiable; raises `NoPlace` and `NoEquilibrium`, and `ValueError` in
    inference mode, which has no graphs.
    """
    if torch.is_inference_mode_enabled():
        raise ValueError(
            "statics need torch's graphs, which torch.inference_mode() has not; use torch.no_grad()"
        )
    pose = {name: list(at.unbind()) for name, at in held.items()}
    rests: dict[str, list[int]] = {}
    presses: dict[str, Any] = {}
    for name, axes in rig.layout.free.items():
        for i in axes:
            value = bodies.get(name, {}).get(COORDINATES[i], 0.0)
            if isinstance(value, str) and value == REST:
                rests.setdefault(name, []).append(i)
            elif isinstance(value, str | Mapping):
                presses[name] = value
            else:
                pose[name][i] = scalar(f"{name}.{COORDINATES[i]}", value)
    places = lifted({name: torch.stack(at) for name, at in pose.items()}, presses)
    for name, axes in rests.items():
        if 1 in axes:
            places[name] = at_height(places[name], scalar(name, above(rig, places, name)))
    return balanced(rig, places, rests, presses)


def lifted(pose: Mapping[str, Tensor], names: Iterable[str]) -> Poses:
    """Poses (3,) with some bodies high above all others."""
    away = torch.tensor(AWAY, dtype=torch.float64)
    return {**pose} | {name: at_height(pose[name], away) for name in names}


def balanced(
    rig: Graph, pose: Mapping[str, Tensor], rests: Mapping[str, Sequence[int]],
    presses: Mapping[str, Any], residual: float = RESIDUAL,
) -> Poses:  # fmt: skip
    """Poses (3,) with the coordinates `rests` in balance, first with the pressing bodies out of
    contact and then with them `pressed`; the balance to a last step `residual` [m]. Raises as
    `placed`."""
    places = lifted(pose, presses)
    if rests:
        places = resting(
            rig, places, rests, signals=no_signals(rig), actuators=(), residual=residual
        )
    return pressed(rig, places, presses, rests)


def pressed(
    rig: Graph, pose: Poses, presses: Mapping[str, Any], rests: Mapping[str, Sequence[int]]
) -> Poses:
    """Poses of bodies whose pads come down upon others until they touch, and are pressed by a depth
    or a force, {"bracket": {"depth": 1e-3}}; the coordinates `rests` give way. Raises as
    `placed`."""
    places, pushed = dict(pose), dict[str, Tensor]()
    for name, value in presses.items():
        height = upon(rig, places, name)
        if isinstance(value, Mapping) and "force" in value:
            force = scalar(f"{name}.y.force", value["force"])
            pushed[name] = at_height(torch.zeros(3, dtype=torch.float64), -force)
        elif isinstance(value, Mapping):
            height = height - scalar(f"{name}.y.depth", value["depth"])
        places[name] = at_height(places[name], height)
    if any(value != TOUCH for value in presses.values()):
        free = {**rests} | {name: sorted({*rests.get(name, ()), 1}) for name in pushed}
        places = resting(rig, places, free, signals=no_signals(rig), actuators=(), pushed=pushed)
    return places


def at_height(pose: Tensor, y: Tensor) -> Tensor:
    """A pose (3,) at another height [m]."""
    return torch.stack((pose[0], y, pose[2]))


def check_start(body: str, freedom: Mapping[str, str], given: Any) -> None:
    """Raises `ValueError` for coordinates and rates of a body by other names, with other values,
    without meaning, or missing."""
    if not isinstance(given, Mapping):
        raise ValueError(
            f"`{body}` must be given coordinates by name, such as {{'x': 0.06, 'y': '{REST}'}}, "
            f"but is {given!r}"
        )
    words = {"y": (REST, TOUCH), "theta": (REST,)}
    for key, value in given.items():
        axis = RATES.get(key, key)
        if axis not in COORDINATES:
            raise ValueError(
                f"`{key}` is no coordinate of `{body}`; {suggestion(key, (*COORDINATES, *RATES))}"
            )
        if freedom[axis] != "free":
            raise ValueError(f"`{key}` of `{body}` has no meaning: {axis} is {freedom[axis]}")
        pressed = isinstance(value, Mapping) and list(value) in [[one] for one in PRESSES]
        if key == "y" and pressed:
            scalar(f"{body}.y.{next(iter(value))}", next(iter(value.values())))
        elif isinstance(value, str | Mapping) and value not in words.get(key, ()):
            allowed = " or ".join(["a number", *map(repr, words.get(key, ()))])
            raise ValueError(f"`{key}` of `{body}` must be {allowed}, but is {value!r}")
    for axis, kind in freedom.items():
        if kind == "free" and axis != "theta" and axis not in given:
            raise ValueError(
                f"`{axis}` of `{body}` is missing: it is free, so say where it starts [m]"
                + (f', or "{REST}"' if axis == "y" else "")
            )


def scalar(name: str, value: Any) -> Tensor:
    """A finite number as a tensor, with its graph. Raises `ValueError`."""
    out = tensor(name, value if isinstance(value, Tensor) else [number(name, value)]).squeeze()
    if out.ndim or not bool(out.isfinite()):
        raise ValueError(f"`{name}` must be one finite number, but is {value!r}")
    return out


@torch.no_grad()
def above(rig: Graph, pose: Mapping[str, Tensor], body: str) -> float:
    """A height [m] at which a body is clear of the pads under it. Raises `NoPlace` where there is
    none."""
    shape, (x, _, theta) = rig.bodies[body].shape, pose[body]
    heights = []
    for contact in rig.contacts.values():
        if contact.body != body or shape is None:
            continue
        pad = rig.pads[contact.pad]
        base = torch.zeros(3, dtype=torch.float64) if pad.base is None else pose[pad.base]
        points = turned(pad.point_positions, base[2]) + base[:2]
        ways = torch.tensor([[0.0, -1.0], [-1.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
        below, left, right = shape.support(turned(ways, -theta)).tolist()
        along = points[:, 0]
        if turned(pad.axes[:, 1], base[2])[1] <= UPWARDS or not along.min() < x < along.max():
            continue
        under = points[(along > x - left) & (along < x + right)]
        if not len(under):
            raise NoPlace(
                body, "y",
                f"{1e3 * (left + right):.3g} mm wide, it falls between points of "
                f"`{contact.pad}`, which are {1e3 * float(pad.point_lengths.max()):.3g} mm apart; "
                f"make its shape larger (a radius), or give pads.{contact.pad} more points or "
                "elements_x",
            )  # fmt: skip
        heights.append(float(under[:, 1].max()) + below)
    if not heights:
        raise NoPlace(
            body, "y",
            f'"{REST}", but no pad that it has a contact with lies under x = {float(x):g} m; place '
            "it over one, or say at which height it starts",
        )  # fmt: skip
    return max(heights)


def upon(rig: Graph, pose: Mapping[str, Tensor], body: str) -> Tensor:
    """Height [m] at which the undeformed pads of a body, lowered from above, just touch: one step
    of Newton's method with a graph after those without. Raises `NoPlace` where they touch
    nothing."""
    contacts = [key for key, one in rig.contacts.items() if rig.pads[one.pad].base == body]
    at_rest = {name: torch.zeros_like(at) for name, at in pose.items()}

    def gap(y: Tensor) -> Tensor:
        """Distance [m] to what is touched first."""
        at = {**pose, body: at_height(pose[body], y)}
        state = State({}, unstretched(rig, ()), at, {}, at_rest)
        deepest = []
        for key in contacts:
            pad = rig.pads[rig.contacts[key].pad]
            undeformed = torch.zeros(pad.nodes, 2, dtype=torch.float64)
            deepest.append(rig.penetration(key, state, undeformed).max())
        return -torch.stack(deepest).max()

    y, left = pose[body][1].detach(), torch.tensor(torch.inf)
    with torch.no_grad():
        for _ in range(DESCENTS if contacts else 0):
            left = gap(y)
            y = y - left
    if not abs(float(left)) < 1e-9:
        raise NoPlace(
            body, "y",
            f'"{TOUCH}", but no pad bonded to it comes down upon a body that it has a contact '
            "with; place it over one by x, or say at which height it starts",
        )  # fmt: skip
    if torch.is_grad_enabled():
        at = y.clone().requires_grad_()
        left = gap(at)
        (slope,) = torch.autograd.grad(left, at, retain_graph=True)
        y = y - (left - left.detach()) / slope  # by the implicit function theorem
    return y + CLEAR
