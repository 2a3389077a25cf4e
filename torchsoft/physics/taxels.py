"""Taxels: an array of sensitive areas on the surface of a pad."""

from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from scipy.special import ndtr

from torchsoft.display import suggestion
from torchsoft.physics.arguments import whole
from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import Pad
from torchsoft.quantity import Length, Quantity, quantities


@dataclass(frozen=True)
class Taxels:
    """Areas of `width` [m] along the undeformed surface of the pad called `pad`.

    `count` of them lie side by side around the surface's middle; or `centres` [m] are the
    coordinates of their middles along the surface, from its middle. Each takes the part of a force
    that a Gaussian of standard deviation `spread` [m] about the place of that force has inside the
    area. Without a spread a force belongs to the area that it acts on, by halves at an edge.
    Raises `ValueError` unless one of count and centres is given, and for numbers out of range.
    """

    pad: str
    width: Annotated[Length, "width of a taxel along the surface"]
    _: KW_ONLY
    count: int | None = None
    centres: Annotated[
        Iterable[float], Quantity("m", -100.0, 100.0, "middles along the surface, from its middle")
    ] = ()
    spread: Annotated[
        float, Quantity("m", 0.0, 1.0, "standard deviation of the place where a force is felt")
    ] = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "centres", tuple(map(float, self.centres)))
        if (self.count is None) == (self.centres == ()):
            raise ValueError("taxels need a `count` or their `centres`, and not both")
        if self.count is not None:
            whole("count", self.count, 1)
        for name, known in quantities(type(self)).items():
            given = getattr(self, name)
            for value in given if name == "centres" else [given]:
                try:
                    known.check(float(value))
                except ValueError as error:
                    raise ValueError(f"`{name}` {error}") from None

    @cached_property
    def places(self) -> Array:
        """Coordinates of the middles along the surface (taxels,) [m]."""
        if self.count is None:
            return np.array(self.centres)
        return (np.arange(float(self.count)) - 0.5 * (self.count - 1)) * self.width

    def weights(self, pad: Pad) -> Array:
        """Part of a force at every contact point of the pad that each taxel takes (taxels,
        points)."""
        off = self.places[:, None] - pad.point_coordinates
        left, right = (np.round(off + side * self.width, 12) for side in (0.5, -0.5))
        if self.spread == 0.0:
            return 0.5 * (np.sign(left) - np.sign(right))
        return ndtr(left / self.spread) - ndtr(right / self.spread)


def check_taxels(
    taxels: Mapping[str, Taxels], pads: Mapping[str, Pad], contacts: Iterable[str]
) -> None:
    """Raises `ValueError` for taxels on no pad, and for those that are called like a contact."""
    for name, one in taxels.items():
        if one.pad not in pads:
            raise ValueError(
                f"taxels.{name}: they lie on `{one.pad}`, "
                f"{suggestion(one.pad, pads, 'but the pads are')}"
            )
        if name in contacts:
            raise ValueError(
                f"taxels.{name}: a contact is called `{name}` too, whose forces have the same "
                "names; call one of them otherwise"
            )
