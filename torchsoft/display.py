"""Representations of objects at a prompt and in a notebook, and near names for wrong ones."""

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from html import escape
from pathlib import Path

ALIKE = 0.6
"""Least ratio of common letters of two names that are alike."""

FEW, SHOWN = 20, 6
"""Most names that are all shown besides the nearest one, and number shown of longer lists."""


def enumerated(names: Iterable[str]) -> str:
    """Names one after the other, those of an array as one, for messages."""
    last: dict[str, str] = {}
    for name in names:
        array, _, number = name.rpartition(".")
        last[array if number.isdecimal() else name] = number if number.isdecimal() else ""
    return ", ".join(
        f"{name}.0 to {number}".removeprefix(".") if number else name
        for name, number in last.items()
    )


def alike(name: object, known: Iterable[str], most: int, least: float) -> list[str]:
    """The known names, capitals aside, that are most like another one, the best first."""
    folded = {one.casefold(): one for one in known}
    return [folded[one] for one in get_close_matches(str(name).casefold(), folded, most, least)]


def nearest(name: object, known: Iterable[str]) -> str | None:
    """The known name that is most like another one; None where none is."""
    return next(iter(alike(name, known, 1, ALIKE)), None)


def suggestion(name: object, known: Iterable[str], listed: str = "known are") -> str:
    """The end of a rejection of `name`: the nearest of the known names, and after the words
    `listed` all of them, or those next to it where they are many."""
    names = list(dict.fromkeys(known))
    near = nearest(name, names)
    if near is None:
        return f"{listed} {enumerated(names) or 'none'}"
    many = len(names) > FEW
    some = [*alike(name, names, SHOWN, 0.0), "..."] if many else names
    return f"did you mean `{near}`? ({listed} {', '.join(some)})"


def hidden(progress: bool) -> bool | None:
    """What `disable` of tqdm is to be: a bar is shown where it is asked for, and on terminals and
    in notebooks only, since a file would hold a line for every step of it."""
    return None if progress else True


def amount(x: float, unit: str) -> str:
    """A number with its unit, in four digits."""
    return f"{x:.4g} {unit}" if unit and unit != "1" else f"{x:.4g}"


class Shown:
    """An object that shows itself as a title and rows of two columns."""

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        """Title and rows."""
        raise NotImplementedError

    def __repr__(self) -> str:
        title, rows = self.shown()
        width = max((len(name) for name, _ in rows), default=0)
        return "\n".join([title, *(f"  {name.ljust(width)}  {text}" for name, text in rows)])

    def _repr_html_(self) -> str:
        title, rows = self.shown()
        cells = "".join(
            f'<tr><th style="text-align:left">{escape(name)}</th>'
            f'<td style="text-align:left">{escape(text)}</td></tr>'
            for name, text in rows
        )
        return f"<div><b>{escape(title)}</b><table>{cells}</table></div>"


@dataclass(frozen=True)
class Film:
    """A video, or a player, in a file; a notebook shows it."""

    path: Path

    def __repr__(self) -> str:
        return f"Film: {self.path}, {1e-6 * self.path.stat().st_size:.2g} MB"

    def _repr_html_(self) -> str:
        if self.path.suffix == ".html":
            page = escape(self.path.read_text(encoding="utf-8"))
            return f'<iframe srcdoc="{page}" style="width:100%;height:640px;border:0"></iframe>'
        kind = "video/mp4" if self.path.suffix == ".mp4" else "image/gif"
        data = f"data:{kind};base64,{base64.b64encode(self.path.read_bytes()).decode()}"
        return f'<video controls src="{data}"></video>' if kind[0] == "v" else f'<img src="{data}">'


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
