"""What objects show of themselves at a prompt and in a notebook, and near names for wrong ones."""

from collections.abc import Iterable
from difflib import SequenceMatcher
from html import escape

ALIKE = 0.6
"""Least ratio of common letters of two names that are alike."""


def nearest(name: object, known: Iterable[str]) -> str | None:
    """The known name that is most like another one, capitals aside first; None where none is."""

    def alike(one: str, other: str) -> float:
        shared = max(  # what both are in says nothing
            (i + 1 for i, c in enumerate(one) if c == "." and other.startswith(one[: i + 1])),
            default=0,
        )
        return SequenceMatcher(None, one[shared:], other[shared:]).ratio()

    given = str(name)
    ranked = [(alike(given.casefold(), one.casefold()), alike(given, one), one) for one in known]
    best = max(ranked, default=(0.0, 0.0, ""))
    return best[2] if best[0] >= ALIKE else None


def suggestion(name: object, known: Iterable[str], listed: str = "known are") -> str:
    """The end of a refusal of `name`: the nearest of the known names, and all of them after the
    words `listed`."""
    names = list(known)
    near = nearest(name, names)
    every = f"{listed} {', '.join(names) or 'none'}"
    return f"did you mean `{near}`? ({every})" if near else every


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
