"""The state vector of a rig: which component stands where, and how it is taken apart."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor


class State(NamedTuple):
    """One state, batch dimensions leading, every part by the name of its pad, contact or body. SI
    units.

    pads: of condensed pads the nodal forces that have set in (..., branches, nodes, 2) [N], of
    nodal pads the displacements (..., nodes, 2 fields) [m], those of relaxing branches beside the
    nodes' own; stretch: of contacts (..., points); pose,
    velocity: of bodies (..., 3), x, y and theta, those that are fixed or driven included; rates:
    velocities of inertial pads' nodes (..., nodes, 2), absolute; friction: of contacts whose law of
    friction has states of its own (..., states, points).
    """

    pads: dict[str, Tensor]
    stretch: dict[str, Tensor]
    pose: dict[str, Tensor]
    rates: dict[str, Tensor]
    velocity: dict[str, Tensor]
    friction: Mapping[str, Tensor] = MappingProxyType({})


class Layout:
    """Layout of the flat state vector: pads, contacts' stretches and states of friction, free
    coordinates, pads' velocities, free velocities.

    `size` is the vector's length; `slices` and `shapes` are by (part, name), with part one of
    State's fields; the free coordinates are ("pose", body) and ("velocity", body), `free` their
    places among (x, y, theta).
    """

    def __init__(
        self, pads: Mapping[str, tuple[int, ...]], stretch: Mapping[str, int],
        free: Mapping[str, list[int]], inertial: Mapping[str, tuple[int, ...]],
        friction: Mapping[str, int],
    ) -> None:  # fmt: skip
        self.free = {name: list(axes) for name, axes in free.items()}
        self.shapes: dict[tuple[str, str], tuple[int, ...]] = {}
        self.shapes |= {("pads", name): shape for name, shape in pads.items()}
        for name, count in stretch.items():
            self.shapes["stretch", name] = (count,)
            if friction.get(name):
                self.shapes["friction", name] = friction[name], count
        self.shapes |= {("pose", name): (len(axes),) for name, axes in free.items()}
        self.shapes |= {("rates", name): shape for name, shape in inertial.items()}
        self.shapes |= {("velocity", name): (len(axes),) for name, axes in free.items()}
        self.slices, self.size = {}, 0
        for key, shape in self.shapes.items():
            self.slices[key] = slice(self.size, self.size + math.prod(shape))
            self.size += math.prod(shape)

    @property
    def rigid(self) -> list[int]:
        """Components of the bodies' free coordinates, then of their rates."""
        return [
            i
            for (part, _), s in self.slices.items()
            if part in ("pose", "velocity")
            for i in range(s.start, s.stop)
        ]

    def check(self, y: Tensor) -> None:
        """Raises `ValueError` for another length or dtype than float64."""
        if y.shape[-1:] != (self.size,) or y.dtype != torch.float64:
            raise ValueError(
                f"`y` must be float64 of shape (..., {self.size}), but is {y.dtype} of shape "
                f"{tuple(y.shape)}; build it with `Rig.state` or `Rig.pack`"
            )

    def unpack(
        self, y: Tensor, held: Mapping[str, Tensor], held_rates: Mapping[str, Tensor]
    ) -> State:
        """The parts of y (..., size); `held` and `held_rates` (..., 3) fill in the coordinates of
        bodies that are not free."""
        self.check(y)
        parts: dict[str, dict[str, Tensor]] = {name: {} for name in State._fields}
        for (part, name), shape in self.shapes.items():
            parts[part][name] = y[..., self.slices[part, name]].reshape((*y.shape[:-1], *shape))
        for part, others in (("pose", held), ("velocity", held_rates)):
            for name, axes in self.free.items():
                own, rows = (
                    parts[part][name],
                    list(others[name].expand(*y.shape[:-1], 3).unbind(-1)),
                )
                for i, axis in enumerate(axes):
                    rows[axis] = own[..., i]
                parts[part][name] = torch.stack(rows, -1)
        return State(**parts)

    def pack(self, state: State) -> Tensor:
        """The flat vector (..., size) of a state; the inverse of `unpack`."""
        rows = []
        for (part, name), shape in self.shapes.items():
            value = getattr(state, part)[name]
            value = value[..., self.free[name]] if part in ("pose", "velocity") else value
            rows.append(value.reshape(*value.shape[: value.ndim - len(shape)], -1))
        return torch.cat(rows, -1)
