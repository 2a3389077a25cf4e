"""Taxels: an array of sensitive areas on the surface of a pad."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from scipy.special import ndtr

from torchsoft.physics.arguments import whole
from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import Pad
from torchsoft.quantity import Length, Quantity, quantities

Spread = Annotated[
    float, Quantity("m", 0.0, 1.0, "standard deviation with which forces spread among taxels")
]


class Taxels:
    """Areas of `width` on the pad called `pad`, side by side along its undeformed surface.

    There are `count` of them around the surface's middle, or their middles have the coordinates
    `centres` (count,) [m] along the surface, counted from its middle. Each takes the part of a
    force that a Gaussian of the standard deviation `spread` [m], around where it acts, has within
    the area; with a spread of 0 a force belongs to the area that it acts on, and by halves to two
    at their edge. Raises `ValueError` unless just one of count and centres is given, and for
    numbers out of range.
    """

    def __init__(
        self, pad: str, width: Annotated[Length, "width of a taxel along the surface"], *,
        count: int | None = None,
        centres: Annotated[Sequence[float], Quantity("m", -100.0, 100.0, "middles")] | None = None,
        spread: Spread = 0.0,
    ) -> None:  # fmt: skip
        self.pad, self.width, self.spread = pad, float(width), float(spread)
        if (count is None) == (centres is None):
            raise ValueError("taxels need a `count` or their `centres`, and not both")
        if centres is None:
            n = whole("count", count, 1)
            self.places = (np.arange(n) - 0.5 * (n - 1)) * self.width
        else:
            self.places = np.array(centres, np.float64)
        if self.places.ndim != 1 or len(self.places) == 0:
            raise ValueError(f"`centres` must be a list of coordinates, but is {centres!r}")
        known = quantities(Taxels)
        for name, values in (
            ("width", [self.width]),
            ("spread", [self.spread]),
            ("centres", self.places),
        ):
            for value in values:
                try:
                    known[name].check(float(value))
                except ValueError as error:
                    raise ValueError(f"`{name}` {error}") from None

    def weights(self, pad: Pad) -> Array:
        """Part of a force at every contact point of the pad that each taxel takes (taxels,
        points)."""
        off = self.places[:, None] - pad.point_coordinates
        if self.spread == 0.0:
            step = lambda x: 0.5 * (1.0 + np.sign(np.where(np.abs(x) < 1e-12, 0.0, x)))
            return step(off + 0.5 * self.width) - step(off - 0.5 * self.width)
        return ndtr((off + 0.5 * self.width) / self.spread) - ndtr(
            (off - 0.5 * self.width) / self.spread
        )
