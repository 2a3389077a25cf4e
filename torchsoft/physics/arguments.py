"""Numbers given by the caller: taken as they are, or refused with a sentence that names them."""

import math
from numbers import Integral, Real
from typing import Any


def number(name: str, value: Any) -> float:
    """Raises `ValueError` for what is not a real number; text and truth values are not."""
    if not isinstance(value, Real) or isinstance(value, bool):
        raise ValueError(f"`{name}` must be a number, but is {value!r}")
    return float(value)


def positive(name: str, value: Any) -> float:
    """Raises `ValueError` for what is not a positive, finite number."""
    if not isinstance(value, Real) or isinstance(value, bool) or not (math.isfinite(value) and float(value) > 0):
        raise ValueError(f"`{name}` must be positive and finite, but is {value!r}")
    return float(value)


def whole(name: str, value: Any, least: int) -> int:
    """Raises `ValueError` for what is not a whole number from `least` on."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise ValueError(f"`{name}` must be a whole number from {least} on, but is {value!r}")
    return int(value)
