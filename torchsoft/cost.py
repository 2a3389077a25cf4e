"""Cost of work, stated before it begins: hours, and more memory than there is, need the user's
consent.

The times are those of one core of a usual machine; they distinguish minutes from hours.
"""

import os
import sys
from typing import NamedTuple

from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.rig import Rig

LONG = 3600.0
"""Work that takes longer than this [s] needs the user's word."""

RUN = 0.05
"""Time [s] that a run takes without its steps."""

DIFFERENTIATED = {False: 2.5, True: 2.0}
"""Times of a step without sensitivities that one with a few takes, of condensed and of nodal
pads."""

FEW, COLUMN = 8, 0.09
"""Number of parameters that are a few, and the part of such a step that each further one takes."""

PER_NODE = {False: 2.2e-6, True: 6.5e-6}
"""Time of one step [s] for every node of two nodal pads, linear and at finite strain."""

FIELDS = 1.8
"""Power of the number of fields that the time of a step grows with."""

SHARE = 0.8
"""And so does work that needs more than this part of the machine's memory."""


class Cost(NamedTuple):
    """Steps of the stepper, time [s], and memory and disk space [GiB]. Of a range of times
    `seconds` is the longest, by which work is judged, and `least` the shortest."""

    steps: float
    seconds: float
    memory: float
    disk: float = 0.0
    least: float = 0.0

    def part(self, share: float) -> "Cost":
        """Cost of a share of the work, done one piece after the other."""
        steps, seconds, memory, disk, least = self
        return Cost(share * steps, share * seconds, memory, share * disk, share * least)

    @property
    def sentence(self) -> str:
        disk = f", and {self.disk:.3g} GiB on the disk" if self.disk >= 1 else ""
        return (
            f"this takes {span(self.least, self.seconds)} ({self.steps:.2g} steps), "
            f"{self.memory:.2g} GiB of memory{disk}"
        )


class Costly(ValueError):
    """Work that the user has not agreed to."""


def agree(cost: Cost, yes: bool, help: str) -> None:
    """Ask whether to begin where it costs much and `yes` was not said; where nobody can be asked
    that is `Costly`.

    `help` is the advice that lowers the cost.
    """
    if yes or (cost.seconds <= LONG and cost.memory <= SHARE * machine_memory()):
        return
    if sys.stdin.isatty() and sys.stderr.isatty():
        print(f"{cost.sentence}; begin? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return
    raise Costly(f"{cost.sentence}; {help}, or use --yes to begin")


def rig_step(rig: Rig, differentiated: int = 0) -> float:
    """Time of one step [s] of a rig, with sensitivities by so many parameters."""
    more = 1.0 + COLUMN * max(differentiated - FEW, 0)
    seconds = 0.0
    for pad in rig.pads.values():
        points = len(pad.point_nodes) if pad.points else 0
        nodal = len(pad.mesh.free) if pad.nodal else 0
        finite = isinstance(pad.material, Hyperelastic)
        own = 0.5 * step_time(len(pad.mesh.surface), points, nodal, finite, pad.fields)
        seconds += own * (more * DIFFERENTIATED[pad.nodal] if differentiated else 1.0)
    return seconds


def step_time(surface: int, points: int, nodal: int, finite: bool, fields: int = 1) -> float:
    """Time of one step [s] with two pads of so many nodes on the `surface`, contact `points`
    between nodes, and `nodal` nodes each whose displacements are in the state, at `finite` strain
    or linear, in so many fields."""
    own = PER_NODE[finite] * nodal * fields**FIELDS
    return 0.5e-6 * points + (own if nodal else 50e-6 + 90e-6 * (surface / 121) ** 2)


def steps_per_second(rtol: float) -> float:
    """Rate of steps [1/s] by a tolerance for a disc that is rolled and shaken, from experience; a
    gentle motion needs a tenth."""
    return 3700.0 * (1e-5 / rtol) ** 0.3


def rig_row(rig: Rig) -> float:
    """Memory [GiB] of one row of a run of a rig: states, forces, displacements and energies."""
    pads = [(pad.fields * pad.nodes, len(pad.point_nodes)) for pad in rig.pads.values()]
    return 0.5 * sum(row_bytes(*one) for one in pads) / 2**30


def row_bytes(nodes: int, points: int) -> float:
    """Memory [B] of one row of a run with so many nodes a pad and contact points between them."""
    return 8 * (16 * nodes + 12 * (points or nodes) + 100)


def machine_memory() -> float:
    """Memory of this machine [GiB]; infinite where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (AttributeError, ValueError, OSError):
        return float("inf")


def span(least: float, most: float) -> str:
    """A range of times as people say it; with 0 for the least of them the longest alone."""
    low, high = duration(least or most), duration(most)
    number, _, unit = low.partition(" ")
    if low == high:
        return f"about {high}"
    return f"{number if high.endswith(unit) else low} to {high}"


def duration(seconds: float) -> str:
    """A time as people say it."""
    for size, unit in (
        (365.25 * 86400.0, "years"),
        (86400.0, "days"),
        (3600.0, "hours"),
        (60.0, "minutes"),
    ):
        if seconds >= 1.5 * size:
            return (
                f"{seconds / size:.2g} {unit}"
                if seconds < 100 * size
                else f"{seconds / size:.0f} {unit}"
            )
    return f"{seconds:.2g} seconds"
