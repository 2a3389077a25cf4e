"""The state vector of a rig: which component stands where, and how it is taken apart."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor


class OwnState(NamedTuple):
    """A state that a law has of its own: its unit, in which q stands for that of the coordinate an
    actuator measures and F for that of its effort, and the name of the parameter of the law that it
    begins with; without one it begins at zero."""

    unit: str
    start: str = ""


def own_states(law: object) -> dict[str, OwnState]:
    """States that a law has of its own, by name; most have none."""
    return dict(getattr(law, "states", {}))


def begin_states(law: object, shape: Sequence[int]) -> Tensor:
    """States (*shape, states) that a law begins with."""
    zero = torch.zeros((), dtype=torch.float64)
    begin = [getattr(law, one.start) if one.start else zero for one in own_states(law).values()]
    return torch.stack(begin or [zero])[: len(begin)].expand(*shape, len(begin))


class State(NamedTuple):
    """One state, batch dimensions leading, every part by the name of its pad, contact or body. SI
    units.

    pads: of condensed pads the nodal forces that have set in (..., branches, nodes, 2) [N], of
    nodal pads the displacements (..., nodes, 2 fields) [m], those of relaxing branches beside the
    nodes' own; stretch: of contacts (..., points); pose,
    velocity: of bodies (..., 3), x, y and theta, those that are fixed or driven included; rates:
    velocities of inertial pads' nodes (..., nodes, 2), absolute; friction: of contacts whose law of
    friction has states of its own (..., states, points); control: of actuators whose law has some
    (..., states).
    """

    pads: dict[str, Tensor]
    stretch: dict[str, Tensor]
    pose: dict[str, Tensor]
    rates: dict[str, Tensor]
    velocity: dict[str, Tensor]
    friction: Mapping[str, Tensor] = MappingProxyType({})
    control: Mapping[str, Tensor] = MappingProxyType({})


class Layout:
    """Layout of the flat state vector: pads, contacts' stretches and states of friction, free
    coordinates, pads' velocities, free velocities, states of actuators.

    `shapes` are by (part, name), with part one of State's fields; parts that are not there are left
    out, and so are those of no component but a body's. The free coordinates are ("pose", body) and
    ("velocity", body), `free` their places among (x, y, theta). `size` is the vector's length,
    `slices` the places in it.
    """

    def __init__(
        self, free: Mapping[str, list[int]], shapes: Mapping[tuple[str, str], tuple[int, ...]]
    ) -> None:
        self.free = {name: list(axes) for name, axes in free.items()}
        of = lambda *parts: {key: shape for key, shape in shapes.items() if key[0] in parts}
        bodies = lambda part: {(part, name): (len(axes),) for name, axes in self.free.items()}
        self.shapes: dict[tuple[str, str], tuple[int, ...]] = (
            of("pads") | of("stretch", "friction") | bodies("pose") | of("rates")
            | bodies("velocity") | of("control")
        )  # fmt: skip
        self.slices, self.size = {}, 0
        for key, shape in self.shapes.items():
            self.slices[key] = slice(self.size, self.size + math.prod(shape))
            self.size += math.prod(shape)

    def components(self, *parts: str) -> list[int]:
        """Components of some parts of the state."""
        own = (s for (part, _), s in self.slices.items() if part in parts)
        return [i for s in own for i in range(s.start, s.stop)]

    @property
    def rigid(self) -> list[int]:
        """Components of the bodies' free coordinates, then of their rates."""
        return self.components("pose", "velocity")

    @property
    def measured(self) -> list[int]:
        """Components that motion and efforts of actuators are made of: `rigid`, and then the states
        of actuators."""
        return self.components("pose", "velocity", "control")

    def without_surfaces(self) -> "Layout":
        """The layout of the components `measured` alone."""
        own = {key: shape for key, shape in self.shapes.items() if key[0] == "control"}
        return Layout(self.free, own)

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
