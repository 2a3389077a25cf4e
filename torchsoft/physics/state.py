"""The state vector of a rig: which component stands where, and how it is taken apart."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor


class OwnState(NamedTuple):
    """A state that a law has of its own: its unit, in which q stands for that of the coordinate an
    actuator measures and F for that of its effort, and the name of the parameter of the law that it
    begins with; without one it begins at zero."""

    unit: str
    start: str = ""


def law_states(law: object) -> dict[str, OwnState]:
    """States that a law has of its own, by name; most have none."""
    return dict(getattr(law, "states", {}))


def ages(law: object) -> bool:
    """Whether the state of a law of friction is the age of the contact, which starts at
    touch-down."""
    return getattr(law, "ages", False)


def begin_states(law: object, shape: Sequence[int]) -> Tensor:
    """States (*shape, states) that a law begins with."""
    zero = torch.zeros((), dtype=torch.float64)
    begin = [getattr(law, one.start) if one.start else zero for one in law_states(law).values()]
    return torch.stack(begin or [zero])[: len(begin)].expand(*shape, len(begin))


class StateBlock(NamedTuple):
    """States of one kind that a part of a rig declares: the field of `State`, the part's name,
    their shape, and `groups` of components of which errors are judged together, in the order of the
    flat vector: how many, and their unit."""

    field: str
    name: str
    shape: tuple[int, ...]
    groups: tuple[tuple[int, str], ...]

    @classmethod
    def of(cls, field: str, name: str, shape: tuple[int, ...], unit: str) -> "StateBlock":
        """States of one unit, judged together."""
        return cls(field, name, shape, ((math.prod(shape), unit),))

    @classmethod
    def again(
        cls, field: str, name: str, shape: Sequence[int], groups: Sequence[Sequence[Any]]
    ) -> Self:
        """A block as it stands in a file."""
        return cls(field, name, tuple(shape), tuple((int(n), str(unit)) for n, unit in groups))

    @property
    def units(self) -> tuple[str, ...]:
        """Units of its components, each once."""
        return tuple(dict.fromkeys(unit for count, unit in self.groups if count))


def law_blocks(
    field: str, name: str, units: Sequence[str], shape: tuple[int, ...] = ()
) -> list[StateBlock]:
    """States (states, *shape) of a law, of these units, each judged by itself; none without."""
    groups = tuple((math.prod(shape), unit) for unit in units)
    return [StateBlock(field, name, (len(units), *shape), groups)] if units else []


def body_blocks(name: str, axes: Sequence[int]) -> list[StateBlock]:
    """Free coordinates of a body, numbers among (x, y, theta), and their rates."""
    turns = int(2 in axes)
    return [
        StateBlock(
            field, name, (len(axes),), ((len(axes) - turns, f"m{per}"), (turns, f"rad{per}"))
        )
        for field, per in (("pose", ""), ("velocity", "/s"))
    ]


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


ORDER = {
    "pads": 0, "stretch": 1, "friction": 1, "pose": 2, "rates": 3, "velocity": 4, "control": 5,
}  # fmt: skip
"""Order of the fields of `State` in the flat vector; states of friction follow the stretches of
their contact."""


class Layout:
    """Layout of the flat state vector: pads, contacts' stretches and states of friction, free
    coordinates, pads' velocities, free velocities, states of actuators.

    `blocks` are those that its parts declare, by (field of State, name); the free coordinates are
    ("pose", body) and ("velocity", body), `free` their places among (x, y, theta). `size` is the
    vector's length, `slices` the places in it.
    """

    def __init__(self, free: Mapping[str, list[int]], blocks: Iterable[StateBlock]) -> None:
        self.free = {name: list(axes) for name, axes in free.items()}
        ordered = sorted(blocks, key=lambda block: ORDER[block.field])
        self.blocks = {(block.field, block.name): block for block in ordered}
        self.slices, self.size = {}, 0
        for key, block in self.blocks.items():
            self.slices[key] = slice(self.size, self.size + math.prod(block.shape))
            self.size += math.prod(block.shape)

    def groups(self) -> Iterator[tuple[StateBlock, slice, str]]:
        """Groups of components of one unit, in order."""
        for key, block in self.blocks.items():
            first = self.slices[key].start
            for count, unit in block.groups:
                if count:
                    yield block, slice(first, first + count), unit
                first += count

    def components(self, *parts: str) -> list[int]:
        """Components of some parts of the state."""
        slices = (s for (part, _), s in self.slices.items() if part in parts)
        return [i for s in slices for i in range(s.start, s.stop)]

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
        fields = ("pose", "velocity", "control")
        return Layout(self.free, [one for one in self.blocks.values() if one.field in fields])

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
        for (part, name), block in self.blocks.items():
            values = y[..., self.slices[part, name]]
            parts[part][name] = values.reshape((*y.shape[:-1], *block.shape))
        for part, others in (("pose", held), ("velocity", held_rates)):
            for name, axes in self.free.items():
                values, rows = (
                    parts[part][name],
                    list(others[name].expand(*y.shape[:-1], 3).unbind(-1)),
                )
                for i, axis in enumerate(axes):
                    rows[axis] = values[..., i]
                parts[part][name] = torch.stack(rows, -1)
        return State(**parts)

    def pack(self, state: State) -> Tensor:
        """The flat vector (..., size) of a state; the inverse of `unpack`."""
        rows = []
        for (part, name), block in self.blocks.items():
            value = getattr(state, part)[name]
            value = value[..., self.free[name]] if part in ("pose", "velocity") else value
            rows.append(value.reshape(*value.shape[: value.ndim - len(block.shape)], -1))
        return torch.cat(rows, -1)
