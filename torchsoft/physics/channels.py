"""Channels of a rig: the series of its coordinates, signals, efforts and moments in a run, each
with its unit, meaning and value.

A moment is that of the bonded nodes (Eq. 35), with undeformed arms; the graph's, which a turning
base feels and which conserves power, has deformed ones.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

from torch import Tensor

from torchsoft.physics.graph import Graph
from torchsoft.physics.names import effort_channel, rate_channel
from torchsoft.physics.parts import COORDINATES, coordinate_unit
from torchsoft.physics.state import State


class Seen(NamedTuple):
    """What channels are read from: a rig, its states (...), the signals (..., signals, 2) that it
    follows, and the moments (...) [N.m] of its pads, where they are known."""

    rig: Graph
    state: State
    signals: Tensor
    moments: Mapping[str, Tensor] = MappingProxyType({})


POSE, RATE, EFFORT, MOMENT = "pose", "rate", "effort", "moment"
"""Kinds of channels: the motion of a free coordinate and efforts, which a sensor can measure, and
moments, which states alone do not tell."""


class Channel(NamedTuple):
    """A channel of a run: its name, SI unit, owner and meaning, the function of `Seen` to its
    values (...), and its kind, if it has one."""

    name: str
    unit: str
    owner: str
    meaning: str
    read: Callable[[Seen], Tensor]
    kind: str = ""


def declared(rig: Graph) -> Iterator[Channel]:
    """Every channel, in the order of a run. A signal's unit follows from its use; one with several
    uses comes several times."""
    for name in rig.bodies:
        yield from of_body(rig, name)
    yield from of_signals(rig)
    for name, actuator in rig.actuators.items():
        yield Channel(
            effort_channel(name), actuator.effort_unit, f"the effort of the actuator `{name}`",
            f"effort of the actuator {name} on {actuator.pushes}",
            lambda seen, name=name: seen.rig.actuator_effort(name, seen.state, seen.signals),
            EFFORT,
        )  # fmt: skip
    for name in rig.pads:
        yield Channel(
            f"M_{name}", "N.m", f"the moment on the pad `{name}`",
            f"moment of the pad {name} on its base", lambda seen, name=name: seen.moments[name],
            MOMENT,
        )  # fmt: skip


def of_body(rig: Graph, name: str) -> Iterator[Channel]:
    """Coordinates of a body, their rates, and its angular momentum where it may turn."""
    body, symbol = rig.bodies[name], rig.symbols[name]
    what = {
        axis: f"{'angle (anticlockwise)' if axis == 'theta' else axis} of the body {name}"
        for axis in COORDINATES
    }
    free = {axis: kind == "free" for axis, kind in body.freedom.items()}
    for i, axis in enumerate(COORDINATES):
        yield Channel(
            f"{axis}_{symbol}", coordinate_unit(axis), f"{name}.{axis}", what[axis],
            lambda seen, i=i: seen.state.pose[name][..., i], POSE * free[axis],
        )  # fmt: skip
    for i, axis in enumerate(COORDINATES):
        yield Channel(
            rate_channel(f"{axis}_{symbol}"), f"{coordinate_unit(axis)}/s",
            f"the rate of {name}.{axis}", f"rate of {what[axis]}",
            lambda seen, i=i: seen.state.velocity[name][..., i], RATE * free[axis],
        )  # fmt: skip
    if free["theta"]:
        yield Channel(
            f"angular_momentum_{symbol}", "kg.m2/s",
            f"the angular momentum of the body `{name}`", f"angular momentum of the body {name}",
            lambda seen: seen.rig.bodies[name].inertia * seen.state.velocity[name][..., 2],
        )  # fmt: skip


def of_signals(rig: Graph) -> Iterator[Channel]:
    """Signals and their rates, by each of their uses."""
    uses: list[tuple[str, str, str]] = []
    for actuator in rig.actuators.values():
        feed = actuator.feed_forward
        for coordinate, setpoint in actuator.follows:
            of = f"set-point of {coordinate}" if setpoint != feed else f"signal {setpoint}"
            uses.append((setpoint, coordinate_unit(coordinate), of))
        if feed is not None:
            uses.append((feed, actuator.effort_unit, f"signal {feed}"))
    for name, body in rig.bodies.items():
        for axis, freedom in body.freedom.items():
            if freedom == "driven":
                own = f"{name}.{axis}"
                uses.append((own, coordinate_unit(axis), f"motion that drives {own}"))

    def row(seen: Seen, i: int, rate: int) -> Tensor:
        return seen.signals[..., i, rate]

    at = {name: i for i, name in enumerate(rig.signals)}
    for name, unit, meaning in uses:
        i = at[name]
        yield Channel(name, unit, f"the motion `{name}`", meaning, partial(row, i=i, rate=0))
        yield Channel(
            f"{name}_dot", f"{unit}/s", f"the rate of the motion `{name}`", f"rate of {name}",
            partial(row, i=i, rate=1),
        )  # fmt: skip


def read(seen: Seen, names: Collection[str] | None = None) -> dict[str, Tensor]:
    """Channels (...) by name, in the order of a run: those of some names, or all that are known."""
    every = {one.name: one for one in declared(seen.rig)}
    known = (name for name, one in every.items() if one.kind != MOMENT or seen.moments)
    return {name: every[name].read(seen) for name in known if names is None or name in names}


def units(rig: Graph) -> dict[str, str]:
    """SI unit of every channel, by its name."""
    return {one.name: one.unit for one in declared(rig)}


def measurable(rig: Graph) -> tuple[str, ...]:
    """Channels that a sensor can measure, whose derivatives follow from the bodies' motion: free
    coordinates, their rates in the same order, and the actuators' efforts."""
    every = [*declared(rig)]
    return tuple(one.name for kind in (POSE, RATE, EFFORT) for one in every if one.kind == kind)
