"""Channels of touch: recorded forces of a run as read by sensors on pads, under them and at bodies.

`NAME.QUANTITY`, in an array `NAME.QUANTITY.NUMBER`: load_x, load_y, load_theta of a body (by
contacts and pads, world axes), force_x, force_y of a pad (on its base, in the base's axes; its
moment is the channel M_NAME), normal and shear of a contact's points and of taxels, and the centre
of their normal forces.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchsoft.display import enumerated
from torchsoft.physics.rig import Rig
from torchsoft.solve.kernel.table import Array, Index

LIGHT = 1e-3
"""Force [N] that a centre of pressure counts besides the normal forces, at coordinate zero: there
it lies without contact, and with 10 N it is off by a ten-thousandth."""

KINDS = ("normal", "shear")


class Felt(NamedTuple):
    """A channel: the sum of weight times recorded force, for a centre of pressure over that of
    `over` and `LIGHT`."""

    at: Index
    weight: Array
    over: Array | None = None

    def value(self, recorded: Tensor) -> Tensor:
        """(T,) of the recorded forces (T, recorded)."""
        parts = recorded[:, torch.from_numpy(self.at)]
        total = parts @ torch.from_numpy(self.weight)
        return total if self.over is None else total / self.lower(recorded)

    def lower(self, recorded: Tensor) -> Tensor:
        """Divisor of a centre's moment (T,) [N]."""
        return recorded[:, torch.from_numpy(self.at)] @ torch.from_numpy(self.over) + LIGHT


class Sums(NamedTuple):
    """Sums of recorded forces: number c has the entries from start[c] on."""

    start: Index
    at: Index
    weight: Array


class Touch:
    """The channels of touch of a rig, by name; they are made when they are first asked for."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig

    @cached_property
    def _arrays(self) -> dict[str, tuple[Any, Array]]:
        """By the name of a contact or of taxels, their weights on the normal forces at all points
        (., points), and their coordinates along the pad's surface."""
        rig, first, out = self._rig, dict[str, int](), dict[str, tuple[Any, Array]]()
        places = {name: rig.pads[c.pad].point_coordinates for name, c in rig.contacts.items()}
        count = sum(map(len, places.values()))
        every = sparse.csr_array(sparse.identity(count))
        for name, own in places.items():
            first[name] = sum(len(places[other]) for other in first)
            out[name] = every[first[name] : first[name] + len(own)], own
        for name, taxels in rig.taxels.items():
            own = sparse.csr_array(taxels.weights(rig.pads[taxels.pad]))
            parts = [out[k][0] for k, contact in rig.contacts.items() if contact.pad == taxels.pad]
            none = sparse.csr_array((len(taxels.places), count))
            out[name] = sum((own @ part for part in parts), none), taxels.places
        return out

    @cached_property
    def single(self) -> dict[str, tuple[str, Felt]]:
        """Unit and sum of the channels that are in no array."""
        rig, out = self._rig, dict[str, tuple[str, Felt]]()
        for name, (weights, places) in self._arrays.items():
            over = np.ones(len(places)) @ weights
            at = np.flatnonzero(over)
            out[f"{name}.centre"] = "m", Felt(2 * at, (places @ weights)[at], over[at])
        at = 2 * sum(len(self._arrays[name][1]) for name in rig.contacts)
        names = [
            (key, unit)
            for name in rig.pads
            for key, unit in (
                (f"{name}.force_x", "N"),
                (f"{name}.force_y", "N"),
                (rig.renamed.get(f"M_{name}", f"M_{name}"), "N.m"),
            )
        ] + [
            (f"{name}.load_{axis}", unit)
            for name in rig.bodies
            for axis, unit in (("x", "N"), ("y", "N"), ("theta", "N.m"))
        ]
        return out | {
            name: (unit, Felt(np.array([at + i]), np.ones(1)))
            for i, (name, unit) in enumerate(names)
        }

    @cached_property
    def arrays(self) -> dict[str, int]:
        """Arrays of forces [N], and how many there are in each."""
        sizes = {name: len(places) for name, (_, places) in self._arrays.items()}
        return {f"{name}.{kind}": size for name, size in sizes.items() for kind in KINDS}

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

    def __getitem__(self, name: str) -> Felt:
        """Raises `KeyError` naming the channels that there are."""
        if name not in self:
            raise KeyError(f"there is no channel of touch `{name}`, but there are {self.shown}")
        if name in self.single:
            return self.single[name][1]
        owner, kind, number = name.rsplit(".", 2)
        row = self._arrays[owner][0][[int(number)]]
        return Felt(2 * row.indices.astype(np.int64) + KINDS.index(kind), row.data)

    def unit(self, name: str) -> str:
        """SI unit of a channel."""
        return self.single[name][0] if name in self.single else "N"

    def expanded(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names, with the channels of an array in the place of its own."""
        numbered = lambda name: [f"{name}.{i}" for i in range(self.arrays.get(name, 0))]
        return tuple(one for name in names for one in numbered(name) or [name])

    def sums(self, names: Sequence[str]) -> Sums:
        """Weights of the channels: each one's sum, and then the divisors of centres."""
        felt = [self[name] for name in names]
        parts = [(one.at, one.weight) for one in felt]
        parts += [(one.at, one.over) for one in felt if one.over is not None]
        none: Any = [np.zeros(0, np.int64)], [np.zeros(0)]
        return Sums(
            np.cumsum([0, *(len(at) for at, _ in parts)]),
            np.concatenate([*(at for at, _ in parts), *none[0]]),
            np.concatenate([*(weight for _, weight in parts), *none[1]]),
        )

    def slopes(self, names: Sequence[str], of_sums: Tensor, recorded: Tensor) -> Tensor:
        """Derivatives (T, channels, n) of the channels from those of their sums (T, sums, n)."""
        out, next_one = of_sums[:, : len(names)].clone(), len(names)
        for i, felt in enumerate(self[name] for name in names):
            if felt.over is not None:
                down = felt.value(recorded)[:, None] * of_sums[:, next_one]
                out[:, i] = (out[:, i] - down) / felt.lower(recorded)[:, None]
                next_one += 1
        return out
