"""Channels of a rig: series of a run, each with its unit, meaning and value. Those of coordinates,
signals, efforts and moments are in every run (`declared`); forces at points, on taxels, pads and
bodies are made where they are asked for (`Touch`).

A moment is that of the bonded nodes (Eq. 35), with undeformed arms; the graph's, which a turning
base feels and which conserves power, has deformed ones.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchsoft.display import enumerated
from torchsoft.physics.graph import Graph
from torchsoft.physics.mesh import Array, Index
from torchsoft.physics.names import FORCES, ON_BODY, effort_channel, rate_channel
from torchsoft.physics.parts import COORDINATES, coordinate_unit
from torchsoft.physics.state import State


def recorded_slices(rig: Graph) -> dict[tuple[str, str], slice]:
    """Places of a part in the forces (..., recorded) that a run records, by its kind and name:
    normal and friction force at every point of a contact, force and moment of a pad on its base,
    force and moment on a body, all in SI units. What the ground carries comes last."""
    widths = {("contact", name): 2 * count for name, count in rig.point_counts.items()}
    widths |= {("pad", name): 3 for name in rig.pads} | {("body", name): 3 for name in rig.bodies}
    ends = np.cumsum([0, *widths.values()]).tolist()
    return {key: slice(*both) for key, both in zip(widths, pairwise(ends))}


LIGHT = 1e-3
"""Force [N] that a centre of pressure counts besides the normal forces, at coordinate zero: there
it lies without contact, and with 10 N it is off by a ten-thousandth."""


class ForceSum(NamedTuple):
    """A sum of weight times recorded force; for a centre of pressure over that of `over` and
    `LIGHT`."""

    at: Index
    weight: Array
    over: Array | None = None

    def read(self, seen: "Seen") -> Tensor:
        """Values (...) where the recorded forces are known."""
        assert seen.recorded is not None
        return self.value(seen.recorded)

    def value(self, recorded: Tensor) -> Tensor:
        """(...) of the recorded forces (..., recorded)."""
        total = recorded[..., torch.from_numpy(self.at)] @ torch.from_numpy(self.weight)
        return total if self.over is None else total / self.divisor(recorded)

    def divisor(self, recorded: Tensor) -> Tensor:
        """Divisor of a centre's moment (...) [N]."""
        return recorded[..., torch.from_numpy(self.at)] @ torch.from_numpy(self.over) + LIGHT


class Seen(NamedTuple):
    """What channels are read from: a rig, its states (...), the signals (..., signals, 2) that it
    follows, and the recorded forces (..., recorded), where they are known."""

    rig: Graph
    state: State
    signals: Tensor
    recorded: Tensor | None = None


POSE, RATE, EFFORT = "pose", "rate", "effort"
"""Kinds of channels that a sensor can measure: the motion of a free coordinate, and efforts."""


class Channel(NamedTuple):
    """A channel of a run: its name, SI unit, owner and meaning, the function of `Seen` to its
    values (...), its kind, if it has one, and the sum of recorded forces that it is, if it is
    one."""

    name: str
    unit: str
    owner: str
    meaning: str
    read: Callable[[Seen], Tensor]
    kind: str = ""
    forces: ForceSum | None = None


def moment_of(rig: Graph, name: str) -> Channel:
    """The moment of a pad."""
    at = recorded_slices(rig)["pad", name].start + 2
    forces = ForceSum(np.array([at]), np.ones(1))
    return Channel(
        f"M_{name}", "N.m", f"the moment on the pad `{name}`",
        f"moment of the pad {name} on its base", forces.read, forces=forces,
    )  # fmt: skip


def declared(rig: Graph) -> Iterator[Channel]:
    """Every channel that is in all runs, in their order. A signal's unit follows from its use; one
    with several uses comes several times."""
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
        yield moment_of(rig, name)


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
                coordinate = f"{name}.{axis}"
                uses.append((coordinate, coordinate_unit(axis), f"motion that drives {coordinate}"))

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
    """Channels (...) by name, in the order of a run: those of some names, or all; without recorded
    forces, those that need none."""
    every = {one.name: one for one in declared(seen.rig)}
    known = (k for k, one in every.items() if one.forces is None or seen.recorded is not None)
    return {name: every[name].read(seen) for name in known if names is None or name in names}


def units(rig: Graph) -> dict[str, str]:
    """SI unit of every channel, by its name."""
    return {one.name: one.unit for one in declared(rig)}


def measurable(rig: Graph) -> tuple[str, ...]:
    """Channels that a sensor can measure, whose derivatives follow from the bodies' motion: free
    coordinates, their rates in the same order, and the actuators' efforts."""
    every = [*declared(rig)]
    return tuple(one.name for kind in (POSE, RATE, EFFORT) for one in every if one.kind == kind)


# Channels of touch, by what sensors on pads, under them and at bodies read.
#
# `NAME.QUANTITY`, in an array `NAME.QUANTITY.NUMBER`: load_x, load_y, load_theta of a body (by
# contacts and pads, world axes), force_x, force_y of a pad (on its base, in the base's axes; its
# moment is the channel M_NAME), normal and shear of a contact's points and of taxels, and the
# centre of their normal forces.


class Sums(NamedTuple):
    """Sums of recorded forces: number c has the entries from start[c] on."""

    start: Index
    at: Index
    weight: Array


class Touch:
    """The channels of touch of a rig, by name; they are made when they are first asked for."""

    def __init__(self, rig: Graph) -> None:
        self._rig = rig

    @cached_property
    def _weights(self) -> dict[str, tuple[Any, Array]]:
        """Weights (., recorded) on the normal forces, and coordinates along the pad's surface, by
        the name of a contact or of taxels."""
        rig, slices = self._rig, recorded_slices(self._rig)
        size = sum(one.stop - one.start for one in slices.values())
        every, out = sparse.csr_array(sparse.identity(size)), dict[str, tuple[Any, Array]]()
        for name, contact in rig.contacts.items():
            out[name] = every[slices["contact", name]][::2], rig.pads[contact.pad].point_coordinates
        for name, taxels in rig.taxels.items():
            share = sparse.csr_array(taxels.weights(rig.pads[taxels.pad]))
            parts = [out[key][0] for key in rig.contacts_of(taxels.pad)]
            out[name] = (
                sum((share @ part for part in parts), sparse.csr_array((len(taxels.places), size))),
                taxels.places,
            )
        return out

    @cached_property
    def single(self) -> dict[str, Channel]:
        """The channels that are in no array."""
        rig, out = self._rig, list[Channel]()
        for name, (weights, places) in self._weights.items():
            over = np.ones(len(places)) @ weights
            at = np.flatnonzero(over)
            centre = ForceSum(at, (places @ weights)[at], over[at])
            out.append(self._channel(f"{name}.centre", "m", centre))
        axes = {"pad": ("force_x", "force_y"), "body": ON_BODY}
        for (kind, name), here in recorded_slices(rig).items():
            for i, axis in enumerate(axes.get(kind, ())):
                one = ForceSum(np.array([here.start + i]), np.ones(1))
                unit = "N.m" if axis == "load_theta" else "N"
                out.append(self._channel(f"{name}.{axis}", unit, one))
            if kind == "pad":
                out.append(moment_of(rig, name))
        return {one.name: one for one in out}

    def _channel(self, name: str, unit: str, forces: ForceSum) -> Channel:
        owner, _, quantity = name.partition(".")
        return Channel(name, unit, owner, f"{quantity} of {owner}", forces.read, forces=forces)

    @cached_property
    def arrays(self) -> dict[str, int]:
        """Arrays of forces [N], and how many there are in each."""
        sizes = {name: len(places) for name, (_, places) in self._weights.items()}
        return {f"{name}.{kind}": size for name, size in sizes.items() for kind in FORCES}

    def __iter__(self) -> Iterator[str]:
        yield from self.single
        yield from self.expanded([*self.arrays])

    @property
    def shown(self) -> str:
        """The names, for messages."""
        return enumerated(self)

    def __contains__(self, name: object) -> bool:
        array, _, number = str(name).rpartition(".")
        inside = number.isdecimal() and int(number) < self.arrays.get(array, 0)
        return name in self.single or (inside and str(int(number)) == number)

    def __getitem__(self, name: str) -> Channel:
        """Raises `KeyError` naming the channels that there are."""
        if name not in self:
            raise KeyError(f"there is no channel of touch `{name}`, but there are {self.shown}")
        if name in self.single:
            return self.single[name]
        owner, kind, number = name.rsplit(".", 2)
        row = self._weights[owner][0][[int(number)]]
        at = row.indices.astype(np.int64) + FORCES.index(kind)
        return self._channel(name, "N", ForceSum(at, row.data))

    def unit(self, name: str) -> str:
        """SI unit of a channel."""
        return self.single[name].unit if name in self.single else "N"

    def expanded(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names, with the channels of an array in the place of its own."""
        numbered = lambda name: [f"{name}.{i}" for i in range(self.arrays.get(name, 0))]
        return tuple(one for name in names for one in numbered(name) or [name])

    def force_sums(self, names: Sequence[str]) -> list[ForceSum]:
        """The sums that channels are."""
        return [one for name in names if (one := self[name].forces) is not None]

    def sums(self, names: Sequence[str]) -> Sums:
        """Weights of the channels: each one's sum, and then the divisors of centres."""
        forces = self.force_sums(names)
        parts = [(one.at, one.weight) for one in forces]
        parts += [(one.at, one.over) for one in forces if one.over is not None]
        none: Any = [np.zeros(0, np.int64)], [np.zeros(0)]
        return Sums(
            np.cumsum([0, *(len(at) for at, _ in parts)]),
            np.concatenate([*(at for at, _ in parts), *none[0]]),
            np.concatenate([*(weight for _, weight in parts), *none[1]]),
        )

    def slopes(self, names: Sequence[str], of_sums: Tensor, recorded: Tensor) -> Tensor:
        """Derivatives (T, channels, n) of the channels from those of their sums (T, sums, n)."""
        out, next_one = of_sums[:, : len(names)].clone(), len(names)
        for i, one in enumerate(self.force_sums(names)):
            if one.over is not None:
                down = one.value(recorded)[:, None] * of_sums[:, next_one]
                out[:, i] = (out[:, i] - down) / one.divisor(recorded)[:, None]
                next_one += 1
        return out
