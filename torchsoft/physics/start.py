"""A rig's state from coordinates of its bodies: placed, moving, or at rest on pads."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchsoft.display import suggestion
from torchsoft.physics.arguments import number, tensor
from torchsoft.physics.contact import turned
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.statics import NoEquilibrium, resting, standing

REST = "rest"
"""The word for a coordinate that is solved for."""

RATES = {"v_x": "x", "v_y": "y", "omega": "theta"}
"""Rates by name, and the coordinates that they are of."""

UPWARDS = 0.5
"""Least upward part of the normal of a pad that something may rest on."""


def start(rig: Rig, bodies: Mapping[str, Mapping[str, Any]]) -> Tensor:
    """Implementation of `Rig.state`."""
    for name in bodies:
        if name not in rig.bodies:
            raise ValueError(
                f"there is no body `{name}`; {suggestion(name, rig.bodies, 'the bodies are')}"
            )
    held, _ = rig.held(rig.follow(0.0))
    pose = {name: list(at.unbind()) for name, at in held.items()}
    wanted: dict[str, list[int]] = {}
    rates: dict[str, list[Tensor]] = {}
    for name, body in rig.bodies.items():
        given = checked(name, bodies.get(name, {}))
        for i, axis in enumerate(COORDINATES):
            rate = next(key for key, of in RATES.items() if of == axis)
            if body.freedom[axis] != "free":
                for key in {axis, rate} & given.keys():
                    raise ValueError(
                        f"`{key}` of `{name}` has no meaning: {axis} is {body.freedom[axis]}"
                    )
                continue
            if axis not in given and axis != "theta":
                raise ValueError(
                    f"`{axis}` of `{name}` is missing: it is free, so say where it starts [m]"
                    + (f', or "{REST}"' if axis == "y" else "")
                )
            if isinstance(place := given.get(axis, 0.0), str):
                wanted.setdefault(name, []).append(i)
            else:
                pose[name][i] = scalar(f"{name}.{axis}", place)
            rates.setdefault(name, []).append(scalar(f"{name}.{rate}", given.get(rate, 0.0)))
    places = {name: torch.stack(at) for name, at in pose.items()}
    for name, axes in wanted.items():
        if 1 in axes:
            places[name] = places[name] + torch.tensor([0.0, above(rig, places, name), 0.0])
    if wanted:
        places = resting(
            rig, places, wanted, signals=torch.zeros(len(rig.signals), 2).double(), actuators=()
        )
    y = standing(rig, places)
    if any(bool(v.any()) for at in rates.values() for v in at):
        own = {("velocity", name): torch.stack(at) for name, at in rates.items()}
        parts = {part: y[where] for part, where in rig.layout.slices.items()} | own
        y = torch.cat([parts[part] for part in rig.layout.slices])
    return y


def checked(body: str, given: Any) -> Mapping[str, Any]:
    """Coordinates and rates of a body by name. Raises `ValueError` for other names and values."""
    if not isinstance(given, Mapping):
        raise ValueError(
            f"`{body}` must be given coordinates by name, such as {{'x': 0.06, 'y': '{REST}'}}, "
            f"but is {given!r}"
        )
    for key, value in given.items():
        if key not in (*COORDINATES, *RATES):
            raise ValueError(
                f"`{key}` is no coordinate of `{body}`; {suggestion(key, (*COORDINATES, *RATES))}"
            )
        if isinstance(value, str) and (value != REST or key not in ("y", "theta")):
            allowed = f"a number or {REST!r}" if key in ("y", "theta") else "a number"
            raise ValueError(f"`{key}` of `{body}` must be {allowed}, but is {value!r}")
    return given


def scalar(name: str, value: Any) -> Tensor:
    """A finite number as a tensor, with its graph. Raises `ValueError`."""
    out = tensor(name, value if isinstance(value, Tensor) else [number(name, value)]).squeeze()
    if out.ndim or not bool(out.isfinite()):
        raise ValueError(f"`{name}` must be one finite number, but is {value!r}")
    return out


@torch.no_grad()
def above(rig: Rig, pose: Mapping[str, Tensor], body: str) -> float:
    """A height [m] at which a body is clear of the pads under it. Raises `NoEquilibrium` where
    there is none."""
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
        normal = turned(pad.axes[:, 1], base[2])
        under = points[(points[:, 0] > x - left) & (points[:, 0] < x + right)]
        if normal[1] > UPWARDS and len(under):
            heights.append(float(under[:, 1].max()) + below)
    if not heights:
        raise NoEquilibrium(
            f'`y` of `{body}` is "{REST}", but no pad that it has a contact with lies under x = '
            f"{float(x):g} m; place it over one, or say at which height it starts"
        )
    return max(heights)
