"""Tables: how a kernel is given everything that it works on, as one address.

A table is a named tuple of numbers, arrays and other tables. In memory it is a row of 64-bit words:
a number takes one, another table one, its address, and an array its address and its lengths. The
annotations of the tuple are the only declaration; the builder reads the same ones.
"""

import struct
from array import array
from ctypes import addressof, c_char
from functools import cache, cached_property
from typing import (
    Annotated,
    Any,
    NamedTuple,
    TypeAlias,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import NDArray

Kind = TypeVar("Kind", bound=type)

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Matrix: TypeAlias = Annotated[Array, 2]
Cube: TypeAlias = Annotated[Array, 3]
Hypercube: TypeAlias = Annotated[Array, 4]
IndexMatrix: TypeAlias = Annotated[Index, 2]
"""Types of the fields: C-contiguous arrays of so many dimensions. Another table whose class is made
at the start is `Annotated[Any, Table]`."""


class Field(NamedTuple):
    """A field's name, type (int, float, a numpy dtype or a table), dimensions and first word."""

    name: str
    kind: Any
    ndim: int
    word: int


def table(kind: Kind) -> Kind:
    """Make a table of a named tuple."""
    attributes = {"packed": cached_property(_packed), "__getstate__": lambda self: None}
    made: Any = type(kind.__name__, (kind,), attributes | {"__doc__": kind.__doc__})
    made.packed.__set_name__(made, "packed")
    made.__module__, made.__qualname__ = kind.__module__, kind.__qualname__
    made.__annotations__ = kind.__annotations__
    return made


@cache
def layout(kind: Any) -> tuple[Field, ...]:
    """The fields of a table, in their order."""
    fields, word = [], 0
    for name, hint in get_type_hints(kind, include_extras=True).items():
        ndim = 0
        if get_origin(hint) is Annotated and get_args(hint)[0] is Any:
            hint = get_args(hint)[1]
        elif get_origin(hint) is Annotated:
            hint, ndim = get_args(hint)
        elif get_origin(hint) is not None:
            ndim = 1
        if ndim:
            dtype = get_args(hint)[
                -1
            ]  # of NDArray, which is a generic array or, from numpy 2.5 on, named
            hint = np.dtype(next(iter(get_args(dtype)), dtype))
        fields.append(Field(name, hint, ndim, word))
        word += 1 + ndim
    return tuple(fields)


def _packed(self: Any) -> Any:
    """The words of a table. Raises `TypeError` for an array of another type than declared."""
    words: list[int] = []
    for (name, kind, ndim, _), value in zip(layout(type(self)), self):
        if ndim:
            if value.dtype != kind or value.ndim != ndim or not value.flags.c_contiguous:
                raise TypeError(
                    f"`{name}` of {type(self).__name__} must be a C-contiguous array of {kind} "
                    f"with {ndim} dimensions, not of {value.dtype} with {value.ndim}"
                )
            words += (place(value), *value.shape)
        elif kind is float:
            words.append(struct.unpack("q", struct.pack("d", value))[0])
        else:
            words.append(int(value) if kind is int else address(value))
    return array("q", words)


def place(numbers: Any) -> int:
    """Address of an array's numbers, in a tenth of the time of numpy's attributes where they may be
    written to; 0 where there are none."""
    if numbers.size and numbers.flags.writeable:
        return addressof(c_char.from_buffer(numbers))
    return numbers.__array_interface__["data"][0] if numbers.size else 0


def address(one: Any) -> int:
    """Address of the words of a table, valid while the table lives."""
    return one.packed.buffer_info()[0]
