"""Motions that a design may begin with: a few phases, in each of which every signal goes to and fro at a pace of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from torchsoft.physics.motion import Profile, Reference
from torchsoft.sysid.design.knots import PEAK, Moves
from torchsoft.sysid.problem.recording import Array

PHASES = 3
"""Parts of a motion that differ, where nothing is known of them."""

UNEQUAL = 6.0
"""The longest over the shortest phase, at most."""

SLOWEST = 8.0
"""Longest over shortest time from one end to the other, where times are free."""


@dataclass(frozen=True)
class ToAndFro:
    """A signal in a phase: from one end to the other in `every` [s], between `middle` - `by` and `middle` + `by` [its unit]."""

    every: float
    middle: float
    by: float


@dataclass(frozen=True)
class Phase:
    """A part of a motion: how long it is, beside the other phases, and what every signal does in it."""

    share: float
    signals: Mapping[str, ToAndFro]


class Zigzags:
    """Motions by numbers u (n,) from 0 to 1: of every phase how long it is, and in it of every signal the time from one end to
    the other, the level in the middle, and how far it goes, as a part of what its speed and its bounds allow.

    A signal whose times are free gets as many knots as it needs; another one keeps the times of the motion given."""

    def __init__(self, moves: Moves, phases: int = PHASES) -> None:
        self.moves, self.phases, self.n = moves, phases, phases * (1 + 3 * len(moves.bounds))

    def numbers(self, phases: Sequence[Phase]) -> Array:
        """Those of a motion, the nearest that the bounds allow. Raises `ValueError` unless every phase says what every signal
        does."""
        names = list(self.moves.bounds)
        if len(phases) != self.phases or any(set(phase.signals) != set(names) for phase in phases):
            raise ValueError(f"every phase must say what {', '.join(names)} do, and nothing else")
        if any(min(phase.share, *(s.every for s in phase.signals.values())) <= 0 for phase in phases):
            raise ValueError("`share` and `every` of a phase must be positive")
        shares = np.log([phase.share for phase in phases]) / np.log(UNEQUAL)
        rows = []
        for name in names:
            one = self.moves.bounds[name]
            for signal in (phase.signals[name] for phase in phases):
                every, pace = signal.every, 0.0
                if one.shortest is not None:
                    every = float(np.clip(every, one.shortest, SLOWEST * one.shortest))
                    pace = np.log(every / one.shortest) / np.log(SLOWEST)
                far = min(one.speed * every / PEAK, one.high - one.low) / 2
                rows += [pace, (signal.middle - one.low) / (one.high - one.low), abs(signal.by) / far]
        return np.clip([*(shares - shares.min()), *rows], 0.0, 1.0)

    def reference(self, u: Array) -> Reference:
        """The motion; it keeps within the bounds."""
        share = UNEQUAL ** u[: self.phases]
        signals = {name.replace(":", "."): one for name, one in self.moves.given.signals.items()}
        rows = u[self.phases :].reshape(-1, self.phases, 3)
        return Reference(
            **signals | {name: self.course(name, share, row) for name, row in zip(self.moves.bounds, rows)}
        )

    def course(self, name: str, share: Array, rows: Array) -> Profile:
        """One signal, from the last knot that stays; `share` (phases,) of the time, and rows (phases, 3) of numbers."""
        one, (known_times, known_values, first) = self.moves.bounds[name], self.moves.knots[name]
        t, v, side = known_times[first - 1], known_values[first - 1], 1.0
        end = known_times[-1] if one.shortest is None else self.moves.end
        edges, times, values = t + np.cumsum(share) / np.sum(share) * (end - t), [], []
        for (pace, level, part), until in zip(rows, edges):
            within = (known_times > t) & (known_times <= until * (1 + 1e-12))
            at = (
                known_times[within]
                if one.shortest is None
                else evenly(t, one.shortest, one.shortest * SLOWEST**pace, until)
            )
            for to in at:
                way, side = (1 - 1e-9) * one.speed * (to - t) / PEAK, -side
                goal = one.low + level * (one.high - one.low) + side * part * min(way, one.high - one.low) / 2
                t, v = to, v + np.clip(np.clip(goal, one.low, one.high) - v, -way, way)
                times.append(t)
                values.append(v)
        return Profile(
            torch.from_numpy(np.append(known_times[:first], times)),
            torch.from_numpy(np.append(known_values[:first], values)),
        )


def evenly(start: float, shortest: float, spacing: float, end: float) -> Array:
    """Times after `start` until `end`: one at least, unless that is too near."""
    spacing = max(min(spacing, end - start), shortest)
    count = int((end - start) / spacing * (1 + 1e-12))
    return np.linspace(start + spacing, start + count * spacing, count)
