"""Pieces of a page: text, tables and pictures as HTML that stands alone. Everything that is given is escaped."""

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape as escaped
from pathlib import Path

from matplotlib.figure import Figure

from torchsoft.tables import plain

STYLE_SHEET = Path(__file__).with_name("report.css")

Cell = str | tuple[str, str]
"""Text, or a class with text."""


def escape(text: str) -> str:
    """Text as HTML, without control characters."""
    return escaped(plain(text))


def document(title: str, parts: Iterable[str]) -> str:
    """The whole page."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width,initial-scale=1"><title>{escape(title)}</title>'
        f"<style>\n{STYLE_SHEET.read_text(encoding='utf-8')}</style></head><body><main>{''.join(parts)}</main></body></html>\n"
    )


def heading(text: str, level: int = 2) -> str:
    return f"<h{level}>{escape(text)}</h{level}>"


def paragraph(text: str, kind: str = "") -> str:
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def listing(items: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(item)}</li>' for item in items)}</ul>"


def verbatim(text: str) -> str:
    return f"<pre>{escape(text)}</pre>"


def folded(summary: str, inside: str) -> str:
    """What is there for those who open it."""
    return f"<details><summary>{escape(summary)}</summary>{inside}</details>"


def definitions(pairs: Iterable[tuple[str, str]]) -> str:
    return "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in pairs if v) + "</dl>"


def picture(figure: Figure, alt: str, caption: str = "", kind: str = "") -> str:
    """The figure with its PNG inside."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=160)
    inside = base64.b64encode(buffer.getvalue()).decode()
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    of = f' class="{kind}"' if kind else ""
    return f'<figure{of}><img alt="{escape(alt)}" src="data:image/png;base64,{inside}">{below}</figure>'


def table(head: Sequence[str], rows: Sequence[Sequence[Cell]], caption: str = "") -> str:
    """Numbers to the right, but for the first column; columns without anything in them are left out."""
    kept = [i for i in range(len(head)) if any(text_of(row[i]) for row in rows)]
    numeric = {i for i in kept[1:] if any(kind_of(row[i]) == "n" for row in rows)}

    def cell(i: int, value: Cell) -> str:
        kind = "" if i == kept[0] and isinstance(value, str) else kind_of(value)
        return f'<td class="{kind}" data-label="{escape(head[i])}">{escape(text_of(value))}</td>'

    top = "".join(f'<th scope="col" class="{"n" if i in numeric else ""}">{escape(head[i])}</th>' for i in kept)
    body = "".join(f"<tr>{''.join(cell(i, row[i]) for i in kept)}</tr>" for row in rows)
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f'<div class="wide"><table>{above}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def text_of(cell: Cell) -> str:
    return cell[1] if isinstance(cell, tuple) else cell


def kind_of(cell: Cell) -> str:
    """Its class; "n" for what begins like a number, or like an interval."""
    if isinstance(cell, tuple):
        return cell[0]
    return "n" if cell.strip(" −+×").removeprefix("open … ")[:1].isdigit() or cell == "open … open" else ""


def grouped(value: float, digits: int = 5) -> str:
    """So many digits, thousands set apart, such as 159 090, and a true minus."""
    text = f"{value:.{digits}g}"
    if 10.0**digits / 10 <= abs(value) < 1e9:
        text = f"{float(text):,.0f}".replace(",", "\u202f")
    return text.replace("-", "−", 1) if value < 0 else text


def signed(value: float, digits: int = 2) -> str:
    """With its sign."""
    return ("+" if value > 0 else "") + grouped(value, digits)


def interval(low: float | None, high: float | None) -> str:
    """Two numbers; an end that is not known is open."""
    return f"{'open' if low is None else grouped(low)} … {'open' if high is None else grouped(high)}"
