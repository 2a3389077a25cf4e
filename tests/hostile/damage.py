"""Damages: to the bytes and the place of a file, and to a tree of TOML."""

import copy
import json
import math
import os
import pickle
from collections.abc import Callable, Iterator
from functools import reduce
from hashlib import sha256
from io import BytesIO
from operator import getitem
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

# files
# ----------------------------------------------------------------------


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


class Victim(NamedTuple):
    """A file to be damaged, another of its kind, and how its reader would seal a content; the trap
    shows whether anything was executed."""

    path: Path
    rng: np.random.Generator
    other: Path = Path("none")
    trap: Trap = Trap(Path("executed"))
    seal: Callable[[bytes], bytes] = bytes

    @property
    def content(self) -> bytes:
        return self.path.read_bytes()

    @property
    def place(self) -> int:
        return int(self.rng.integers(len(self.content) + 1))


Damages = dict[str, Callable[[Victim], bytes | None]]
"""By what is done: the new content, or None where the file was changed already."""


def flipped(content: bytes, rng: np.random.Generator) -> bytes:
    """With one bit changed."""
    at = int(rng.integers(8 * len(content)))
    return content[: at // 8] + bytes([content[at // 8] ^ 1 << at % 8]) + content[at // 8 + 1 :]


def archive(**arrays: Any) -> bytes:
    out = BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def objects(trap: Trap) -> bytes:
    """An archive of numpy that holds a pickle."""
    held = np.empty(1, dtype=object)
    held[0] = trap
    return archive(kind=np.asarray("Prediction"), t=held)


def replaced(by: Callable[[Path], object]) -> Callable[[Victim], None]:
    """The file is gone, and `by` makes something else in its place."""

    def change(v: Victim) -> None:
        v.path.unlink()
        by(v.path)

    return change


def exchanged(v: Victim) -> bytes:
    mine, other = v.content, v.other.read_bytes()
    v.other.write_bytes(mine)
    return other


def inserted(v: Victim) -> bytes:
    """Bytes that do not belong there."""
    at = v.place
    return v.content[:at] + ODD[v.rng.integers(len(ODD))] + v.content[at:]


ODD = (
    b"\xff\xfe", b"\x00", b"\xc3(", b"[" * 5000, b"[[[", b'"""', b"=", b"9" * 5000, b"\r",
    b"\xe9", b"a.b.c.d=1\n",
)  # fmt: skip


def encoded(v: Victim) -> bytes:
    """In another encoding, or with other ends of lines."""
    coding, end = CODINGS[v.rng.integers(len(CODINGS))]
    return v.content.decode().replace("\n", end).encode(coding)


CODINGS = (
    ("utf-16", "\n"), ("utf-32", "\n"), ("utf-8-sig", "\n"), ("utf-8", "\r\n"), ("utf-8", "\r"),
    ("latin-1", "# \xb5\n"),
)  # fmt: skip

BYTES = {
    "a bit": lambda v: flipped(v.content, v.rng),
    "a bit of the beginning": lambda v: flipped(v.content[:32], v.rng) + v.content[32:],
    "ones": lambda v: b"\x01" * 64 + v.content[64:],
    "all noise": lambda v: v.rng.bytes(len(v.content)),
    "cut": lambda v: v.content[: v.place],
    "empty": lambda v: b"",
    "longer": lambda v: v.content + v.rng.bytes(int(v.rng.integers(1, 5000))),
    "text": lambda v: b"t [s], x_C [mm]\n0, 1\n",
}
TEXT = BYTES | {"inserted": inserted, "another encoding": encoded}
PLANTED = {
    "a pickle": lambda v: pickle.dumps(v.trap),
    "a sealed pickle within an archive": lambda v: v.seal(objects(v.trap)),
    "a sealed beginning of HDF5": lambda v: v.seal(b"\x89HDF\r\n\x1a\n"),
    "a sealed archive of others": lambda v: v.seal(archive(kind=np.asarray("Trap"), x=np.zeros(2))),
}
FOREIGN = {
    "another's": lambda v: v.other.read_bytes(),
    "exchanged": exchanged,
}
GONE = {"gone": replaced(bool), "a folder": replaced(Path.mkdir)}
SPECIAL = {
    "a pipe": replaced(os.mkfifo),
    "a link to itself": replaced(lambda path: path.symlink_to(path)),
}


def damage(how: Callable[[Victim], bytes | None], victim: Victim) -> None:
    """Damage a file by other bytes, or by what becomes of its place."""
    if (content := how(victim)) is not None:
        victim.path.write_bytes(content)


def forged(name: bytes, content: bytes) -> bytes:
    """With the checksum that a journal or a cache would write."""
    return sha256(name + content).digest() + content


# trees
# ----------------------------------------------------------------------

VALUES = (
    True, False, "", "abc", "1_0", "1e3", "nan", math.nan, math.inf, -math.inf, 1e308, -1e308,
    1e-300, 5e-324, -1.0, -1, 0, 0.0, 10**400, -(10**19), 2**63, [], [1.0], [[1.0]], {},
    {"low": 1.0}, "µ°", "'", "\n", 1e5, 1e-5, 3, 0.5, 1e15,
)  # fmt: skip
"""For the place of any other."""

CHANGES = {
    "value": 0.45, "scale": 0.25, "another's": 0.08, "delete": 0.07, "misspell": 0.1, "nest": 0.05
}  # fmt: skip
"""What becomes of a leaf of a tree, with its probability."""

Place = tuple[str | int, ...]


def number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


class Mutant(NamedTuple):
    """A tree, the only place in it that changed (empty where more did), and what stood and stands
    there."""

    tree: Any = None
    place: Place = ()
    old: Any = None
    new: Any = None

    @property
    def no_number(self) -> bool:
        """Whether a number was replaced by what is none."""
        return number(self.old) and isinstance(self.new, bool | str | list | dict)

    def named(self, text: str) -> bool:
        """Whether a rejection names the changed place, by its last name, or the place in a table of
        measurements that it contradicts; a range or a table is named by itself."""
        names = [part for part in self.place if isinstance(part, str)]
        if names and names[-1] not in ("kind", "low", "high"):
            names = [names[-1], names[-1].rpartition(".")[2]]
        return not names or ", row " in text or any(name in text for name in names)


def leaves(tree: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Every value that is neither a table nor a list, with its place."""
    if isinstance(tree, dict | list):
        items = tree.items() if isinstance(tree, dict) else enumerate(tree)
        for key, value in items:
            yield from leaves(value, (*place, key))
    else:
        yield place, tree


def mutant(tree: Any, rng: np.random.Generator) -> Mutant:
    """A copy of a tree with one of `CHANGES`."""
    tree = copy.deepcopy(tree)
    places = list(leaves(tree))
    (place, old), (_, other) = (places[i] for i in rng.integers(len(places), size=2))
    kind, last = rng.choice([*CHANGES], p=[*CHANGES.values()]), place[-1]
    table = reduce(getitem, place[:-1], tree)
    if kind in ("delete", "misspell") and isinstance(last, str):
        del table[last]
        if kind == "misspell":
            table[last + str(rng.choice(["x", "_", " ", "é", ".E"]))] = old
        return Mutant(tree)
    if kind == "another's":
        table[last] = other
        return Mutant(tree)
    new = VALUES[rng.integers(len(VALUES))]
    if kind == "nest":
        new = {str(last): old}
    elif kind == "scale" and number(old):
        new = type(old)(old * float(10.0 ** rng.uniform(-12, 12) * rng.choice([1, 1, 1, -1])))
    table[last] = new
    return Mutant(tree, place, old, new)


def toml(value: Any) -> str:
    """A value as TOML; a table within braces."""
    match value:
        case dict():
            return "{" + ", ".join(f"{toml(k)} = {toml(v)}" for k, v in value.items()) + "}"
        case list():
            return "[" + ", ".join(map(toml, value)) + "]"
        case float():
            return repr(value)
    return json.dumps(value, ensure_ascii=False)


def document(tree: dict[str, Any]) -> str:
    """A tree as a TOML file, every value in one line."""
    return "".join(f"{toml(name)} = {toml(value)}\n" for name, value in tree.items())


def written(path: Path, tree: Any, way: str, rng: np.random.Generator) -> Mutant:
    """Write a tree to a file with one of its values changed, or (`way` "text") its text damaged."""
    changed = mutant(tree, rng) if way == "values" else Mutant(tree)
    path.write_text(document(changed.tree), encoding="utf-8")
    if way == "text":
        damage(rng.choice([*TEXT.values()]), Victim(path, rng))
    return changed
