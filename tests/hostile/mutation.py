"""Mutations of what a user may hand in: trees of TOML, text, tables of numbers."""

import copy
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

NUMBERS = (
    True, False, "", "abc", "1_0", "1e3", "nan", math.nan, math.inf, -math.inf, 1e308, -1e308,
    1e-300, 5e-324, -1.0, -1, 0, 0.0, 10**400, -(10**19), 2**63, [], [1.0], [[1.0]], {},
    {"low": 1.0}, "µ°", "'", "\n", 1e5, 1e-5, 3, 0.5, 1e15,
)  # fmt: skip
"""Values for the place of any other."""

NOT_NUMBERS = (bool, str, list, dict)


class Mutant(NamedTuple):
    """A tree, the only place in it that changed (empty where more did), and what stands there
    now."""

    tree: Any
    place: tuple[str | int, ...]
    old: Any = None
    new: Any = None


def leaves(
    tree: Any, place: tuple[str | int, ...] = ()
) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Every value that is not a table, with its place."""
    items = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree)
        if isinstance(tree, list)
        else None
    )
    if items is None:
        yield place, tree
        return
    for key, value in items:
        yield from leaves(value, (*place, key))


def at(tree: Any, place: tuple[str | int, ...]) -> Any:
    for key in place:
        tree = tree[key]
    return tree


def replaced(tree: Any, place: tuple[str | int, ...], value: Any) -> Any:
    """A copy with another value in a place."""
    tree = copy.deepcopy(tree)
    at(tree, place[:-1])[place[-1]] = value
    return tree


def mutant(tree: Any, rng: np.random.Generator) -> Mutant:
    """One of: another value, another magnitude, a swap, a missing key, one more, or a table in the
    place of a value."""
    places = list(leaves(tree))
    place, old = places[rng.integers(len(places))]
    kind = rng.choice(
        ["value", "scale", "swap", "delete", "misspell", "nest"],
        p=[0.45, 0.25, 0.08, 0.07, 0.1, 0.05],
    )
    if kind == "scale" and isinstance(old, int | float) and not isinstance(old, bool):
        factor = float(10.0 ** rng.uniform(-12, 12) * rng.choice([1.0, 1.0, 1.0, -1.0]))
        new: Any = (
            round(old * factor) if isinstance(old, int) and rng.random() < 0.7 else old * factor
        )
        return Mutant(replaced(tree, place, new), place, old, new)
    if kind == "swap":
        other, value = places[rng.integers(len(places))]
        return Mutant(replaced(replaced(tree, place, value), other, old), ())
    if kind in ("delete", "misspell") and isinstance(place[-1], str):
        tree = copy.deepcopy(tree)
        value = at(tree, place[:-1]).pop(place[-1])
        if kind == "misspell":
            at(tree, place[:-1])[place[-1] + str(rng.choice(["x", "_", " ", "é", ".E"]))] = value
        return Mutant(tree, ())
    if kind == "nest":
        new = {str(place[-1]): old}
        return Mutant(replaced(tree, place, new), place, old, new)
    new = NUMBERS[rng.integers(len(NUMBERS))]
    return Mutant(replaced(tree, place, new), place, old, new)


def toml(tree: dict[str, Any]) -> str:
    """A tree as TOML, everything inline."""
    return "".join(f"{key(name)} = {value(one)}\n" for name, one in tree.items())


def key(name: str) -> str:
    return text(name)


def text(words: str) -> str:
    shown = "".join(c if c.isprintable() and c not in '"\\' else f"\\u{ord(c):04x}" for c in words)
    return f'"{shown}"'


def value(one: Any) -> str:
    match one:
        case bool():
            return str(one).lower()
        case dict():
            return "{" + ", ".join(f"{key(k)} = {value(v)}" for k, v in one.items()) + "}"
        case list():
            return "[" + ", ".join(map(value, one)) + "]"
        case str():
            return text(one)
    return repr(one)


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(len(data))]


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        out[rng.integers(len(out))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def insert(data: bytes, rng: np.random.Generator) -> bytes:
    """Something that does not belong there."""
    odd = (
        b"\xff\xfe",
        b"\x00",
        b"\xc3(",
        b"[" * 5000,
        b"[[[",
        b'"""',
        b"=",
        b"9" * 5000,
        b"\r",
        "é".encode("latin-1"),
        b"a.b.c.d=1\n",
    )
    where, what = int(rng.integers(len(data) + 1)), odd[rng.integers(len(odd))]
    return data[:where] + what + data[where:]


def zeroed(data: bytes, rng: np.random.Generator) -> bytes:
    where = int(rng.integers(len(data)))
    length = int(rng.integers(1, 65))
    return data[:where] + bytes(len(data[where : where + length])) + data[where + length :]


def twice(data: bytes, rng: np.random.Generator) -> bytes:
    """One line again, elsewhere."""
    lines = data.splitlines(keepends=True)
    lines.insert(int(rng.integers(len(lines))), lines[rng.integers(len(lines))])
    return b"".join(lines)


def encoded(data: bytes, rng: np.random.Generator) -> bytes:
    """In another encoding, with a mark of its order, or with other ends of lines."""
    words = data.decode("utf-8")
    return [
        words.encode("utf-16"), words.encode("utf-32"), b"\xef\xbb\xbf" + data,
        words.replace("\n", "\r\n").encode(), words.replace("\n", "\r").encode(),
        (words + "# µ\n").encode("latin-1"), b"",
    ][rng.integers(7)]  # fmt: skip


TEXTS: tuple[Callable[[bytes, np.random.Generator], bytes], ...] = (
    cut,
    flip,
    insert,
    zeroed,
    twice,
    encoded,
)


def written(path: Path, tree: Any, way: str, number: int, rng: np.random.Generator) -> Mutant:
    """Write a table to a file with one of its values changed, or (`way` other than "values") its
    text."""
    if way == "values":
        changed = mutant(tree, rng)
        path.write_text(toml(changed.tree), encoding="utf-8")
        return changed
    path.write_bytes(TEXTS[number % len(TEXTS)](toml(tree).encode(), rng))
    return Mutant(None, (), new=number)
