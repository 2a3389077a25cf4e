"""Numbers given by the caller: taken as they are, or refused with a sentence that names them."""

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch._C._functorch import peek_interpreter_stack  # private, and the only way to tell

Numbers = Tensor | np.ndarray[Any, Any] | Sequence[Any]
"""Numbers in any usual form."""

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Units [m] in which files may give lengths."""


def check_transforms() -> None:
    """Raises `ValueError` inside a transform of torch.func, whose tensors have no numbers."""
    if peek_interpreter_stack() is not None:
        raise ValueError(
            "a run cannot be inside a transform of torch.func, such as grad, vmap or jvp; use "
            "gradient='discrete' with backward(), or simulate_batch"
        )


def number(name: str, value: Any) -> float:
    """Raises `ValueError` unless a value is a real number; text and truth values are not."""
    if not isinstance(value, Real) or isinstance(value, bool):
        raise ValueError(f"`{name}` must be a number, but is {line(value)}")
    try:
        return float(value)
    except OverflowError:  # of integers, or fractions of them
        raise ValueError(f"`{name}` must be below 1.8e308, but is {line(value)}") from None


def positive(name: str, value: Any) -> float:
    """Raises `ValueError` unless a value is a positive, finite number."""
    real = isinstance(value, Real) and not isinstance(value, bool)
    found = number(name, value) if real else math.nan
    if not 0 < found < math.inf:
        raise ValueError(f"`{name}` must be positive and finite, but is {line(value)}")
    return found


def whole(name: str, value: Any, least: int) -> int:
    """Raises `ValueError` unless a value is a whole number from `least` on."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise ValueError(f"`{name}` must be a whole number from {least} on, but is {value!r}")
    return int(value)


def tensor(name: str, value: Any) -> Tensor:
    """Numbers as a float64 tensor: a tensor with its graph, numpy's arrays, lists. Raises
    `ValueError` for other values; tensors that no run can take stay as they are."""
    check_transforms()
    if isinstance(value, Tensor):
        usual = value.device.type == "cpu" and value.layout == torch.strided
        real = not value.dtype.is_complex and value.dtype != torch.bool
        return value.double() if usual and real and value.dtype != torch.float64 else value
    try:
        given = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):  # of several lengths, or tensors with graphs
        given = np.zeros(0, object)
    if given.dtype.kind not in "iuf":
        raise ValueError(
            f"`{name}` must be numbers (a tensor, an array or a list), but is {line(value)}"
        )
    return torch.from_numpy(given.astype(np.float64))


def places(name: str, value: Any) -> Tensor:
    """Places in the plane (n, 2) in float64, a copy. Raises `ValueError` for other values."""
    try:
        given = np.array(value.detach() if isinstance(value, Tensor) else value)
        if not isinstance(value, Tensor | np.ndarray) and any(
            isinstance(x, bool) for row in value for x in row
        ):
            given = np.zeros(0)  # numpy takes one among numbers for 1
    except (TypeError, ValueError):  # rows of different lengths
        given = np.zeros(0)
    if (
        given.ndim != 2
        or given.shape[-1] != 2
        or given.dtype.kind not in "iuf"
        or not np.isfinite(given).all()
    ):
        raise ValueError(
            f"`{name}` must be finite numbers of the shape (n, 2), but is {line(value)}"
        )
    return torch.from_numpy(given.astype(np.float64))


def names(name: str, value: Any, known: tuple[str, ...]) -> None:
    """Raises `ValueError` unless names are known, each of them once."""
    fine = isinstance(value, tuple) and all(isinstance(one, str) and one in known for one in value)
    if not fine or not value or len({*value}) != len(value):
        raise ValueError(f"`{name}` must be some of {', '.join(known)}, but is {line(value)}")


def line(value: Any) -> str:
    """Representation of a value in one short line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
