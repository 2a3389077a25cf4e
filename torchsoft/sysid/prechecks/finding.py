"""What looks wrong with recordings before anything is fitted: a sentence each, and whether to go on with it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from torchsoft.tables import shown


class Finding(NamedTuple):
    """Something that looks wrong in one recording.

    `what` names it, such as "sign of F_x", and so does the user who means it so. A `grave` one makes a fit worthless.
    """

    what: str
    recording: str
    sentence: str
    grave: bool = False


def together(found: Sequence[Finding]) -> list[Finding]:
    """One of every kind: what several recordings have is said of the first, with the names of the others."""
    out: list[Finding] = []
    for what in dict.fromkeys(f.what for f in found):
        first, *others = (f for f in found if f.what == what)
        names = ", ".join(f"`{name}`" for name in dict.fromkeys(f.recording for f in others) if name != first.recording)
        also = f"; so it is in {names}" if names else ""
        out.append(first._replace(sentence=first.sentence + also, grave=any((first.grave, *(f.grave for f in others)))))
    return out


def accepted(found: Sequence[Finding], acknowledged: Sequence[str]) -> list[str]:
    """The sentences of what is not grave, or was said to be meant so. Raises `ValueError` for the others, and for what is meant
    and was not found."""
    names = dict.fromkeys(one.what for one in found)
    if strange := [name for name in acknowledged if name not in names]:
        there = f"what was found is {', '.join(names)}" if names else "nothing looks wrong"
        raise ValueError(
            f"acknowledged: nothing was found that is called {shown(strange[0])}, so leave it out; {there}"
        )
    for one in found:
        if one.grave and one.what not in acknowledged:
            raise ValueError(f'{one.sentence}; if it is so, say acknowledged = ["{one.what}"]')
    return [f"{f.sentence} (acknowledged)" if f.what in acknowledged else f.sentence for f in found]


MISTAKEN = {
    "rad": {180 / math.pi: ("degrees", "radians"), 1e3: ("milliradians", "radians")},
    "m": {1e2: ("centimetres", "metres"), 1e3: ("millimetres", "metres"), 1e6: ("micrometres", "metres")},
    "N": {1e3: ("millinewtons", "newtons"), 1 / 9.81: ("kilograms", "newtons")},
}
"""What makes values of a dimension too large by a factor when it is taken for the other."""


def confusions(unit: str) -> list[tuple[float, str]]:
    """Factors by which a channel in `unit` may be too large, with the units that were confused."""
    known = MISTAKEN.get(unit.removesuffix("/s"), {})
    over = [(factor, f"{a} taken for {b}") for factor, (a, b) in known.items()]
    return over + [(1 / factor, f"{b} taken for {a}") for factor, (a, b) in known.items()]
