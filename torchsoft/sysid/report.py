"""A page about an identification: one HTML file with its pictures inside, that any browser opens without a network."""

import base64
import io
import json
from collections.abc import Callable
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchsoft.channels import CHANNELS
from torchsoft.files import replacing
from torchsoft.sysid.figures import (
    Trace,
    correlation_figure,
    direction_name,
    estimates_figure,
    spectrum_figure,
    trace_figure,
)
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.result import IdentificationResult, split
from torchsoft.sysid.workers import Runner

STYLE_SHEET = Path(__file__).with_name("report.css")


def report(
    result: IdentificationResult, problem: Problem, path: str | Path, *, checkpoint: str | Path | None = None
) -> None:
    """Write the page about `result`, which `identify` found for `problem`. It appears whole or not at all.

    Every recording is simulated once more, unless the `checkpoint` folder has it. Raises `ValueError` where the result
    belongs to another problem.
    """
    if result.made_by["recordings"] != {r.name: r.fingerprint for r in problem.recordings}:
        raise ValueError("the result was made from other recordings than the problem's")
    drawn, lost = traces(result, problem, Path(checkpoint) if checkpoint is not None else None)
    with replacing(path) as partial:
        partial.write_text(page(result, problem, drawn, lost), encoding="utf-8")


def traces(result: IdentificationResult, problem: Problem, journal: Path | None) -> tuple[list[Trace], dict[str, str]]:
    """Measured and predicted samples of every recording at the result, and why others could not be simulated."""
    x, rtol, out, lost = np.array(result.x), float(result.made_by["rtol"]), [], {}
    samples = {recording.name: recording.samples for recording in problem.recordings}
    runner = Runner(problem.recordings, journal=journal)
    for name in problem.names:
        got = problem.residuals(runner, x, [name], rtol)
        lost |= {name: loss.reason for name, loss in got.lost.items()}
        for (_, channel), r in split(problem, got.r, [name]).items() if not got.lost else ():
            t, y = samples[name][channel]
            out.append(Trace(name, channel, t, y, y + r * problem.sensors[channel].noise, r))
    return out, lost


def starts(result: IdentificationResult, problem: Problem) -> list[float]:
    """Value of every estimate at the start; biases and delays start at zero."""
    out = []
    for e in result.estimates:
        k = problem.names.index(e.recording) if e.recording in problem.names else 0
        out.append(problem.values(problem.coordinates.start, k).get(e.name, 0.0))
    return out


def picture(figure: Figure, alt: str, caption: str = "") -> str:
    """The figure as an element with its PNG inside."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=160)
    inside = base64.b64encode(buffer.getvalue()).decode()
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img alt="{escape(alt)}" src="data:image/png;base64,{inside}">{below}</figure>'


def table(head: list[str], rows: list[list[Any]], caption: str = "") -> str:
    """Numbers to the right; a cell that is a pair brings its class along."""

    def cell(label: str, value: Any) -> str:
        kind, text = value if isinstance(value, tuple) else ("n" if is_number(value) else "", value)
        return f'<td class="{kind}" data-label="{escape(label)}">{escape(str(text))}</td>'

    numeric = [any(is_number(row[i]) for row in rows) for i in range(len(head))]
    top = "".join(f'<th scope="col" class="{"n" if n else ""}">{escape(h)}</th>' for h, n in zip(head, numeric))
    body = "".join(f"<tr>{''.join(cell(h, v) for h, v in zip(head, row))}</tr>" for row in rows)
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f'<div class="wide"><table>{above}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def is_number(value: Any) -> bool:
    return isinstance(value, str) and value.strip(" −-+").replace(" … ", "")[:1].isdigit()


def grouped(value: float) -> str:
    """Five digits, thousands set apart, such as 159 090."""
    text = f"{value:.5g}"
    whole = 1e4 <= abs(value) < 1e9
    return f"{float(text):,.0f}".replace(",", "\u202f") if whole else text


def estimates_table(result: IdentificationResult, start: list[float]) -> str:
    rows = []
    for e, s in zip(result.estimates, start):
        unit = "" if e.unit == "1" else e.unit
        if e.value is None or e.ci95 is None:
            found = [("weak", "not identifiable"), ("weak", "none")]
        else:
            found = [grouped(e.value), f"{grouped(e.ci95[0])} … {grouped(e.ci95[1])}"]
        rows.append(
            [
                e.label,
                *found,
                unit,
                grouped(s),
                "yes" if e.identifiable else ("weak", "no"),
                "yes" if e.at_bound else "no",
            ]
        )
    return table(["parameter", "estimate", "95 % interval", "unit", "start", "identifiable", "at a bound"], rows)


def page(result: IdentificationResult, problem: Problem, drawn: list[Trace], lost: dict[str, str]) -> str:
    """The whole HTML text."""
    start, cost, made = starts(result, problem), result.cost, result.made_by
    count = sum(e.identifiable for e in result.estimates)
    head = f"{count} of {len(result.estimates)} parameters identifiable, χ² = {result.chi2:.3g}"
    if result.notices:
        items = "".join(f"<li>{escape(notice)}</li>" for notice in result.notices)
        notices = f'<div class="notices" role="note"><strong>Read this first</strong><ul>{items}</ul></div>'
    else:
        notices = '<p class="fine">Converged, residuals white, steps fine enough: there is nothing to warn of.</p>'
    within = {(c.recording, c.channel): c for c in result.residuals}
    parts = [
        f"<h1>{escape(head)}</h1>",
        f'<p class="soft">{escape(", ".join(r for r in problem.names if r not in result.heldout))}: '
        f"{cost['data_seconds']:.3g} s of data, {cost['samples']:.0f} samples. χ² is the sum of squared residuals over the "
        "noise, per degree of freedom: 1 where model and noise are right.</p>",
        notices,
        "<h2>Estimates</h2>",
        estimates_table(result, start),
    ]
    if (figure := estimates_figure(result, start)) is not None:
        ratios = "; ".join(
            f"{e.label} {f'{e.value / s:.3g} times its start' if e.value is not None else 'not identifiable'}"
            for e, s in zip(result.estimates, start) if s > 0
        )  # fmt: skip
        parts.append(picture(figure, f"Estimates over their start values: {ratios}"))
    weak = [direction_name(d) for d in result.directions if not d.identifiable]
    parts += [
        "<h2>What is identifiable, and what is not</h2>",
        "<p>Each bar is a combination of parameters (of their logarithms) that the data determine on its own: the shorter, the "
        "better. Long orange bars are combinations that may change without a trace in the data.</p>",
        '<div class="grid">',
        picture(
            spectrum_figure(result),
            "Fisher spectrum: "
            + "; ".join(f"{direction_name(d)}: standard deviation {d.sd:.2g}" for d in result.directions)
            + (f". Not identifiable: {'; '.join(weak)}" if weak else ". All are identifiable"),
            "Fisher spectrum",
        ),
        picture(correlation_figure(result), f"Correlations: {correlations(result)}", "Correlation of the estimates"),
        "</div>",
        "<h2>Data against prediction</h2>",
    ]
    for name in problem.names:
        kind = "held out: predicted, not fitted" if name in result.heldout else "fitted"
        parts.append(f"<h3>{escape(name)} ({kind})</h3>")
        if name in lost:
            parts.append(f'<p class="notices">Could not be simulated: {escape(lost[name])}</p>')
        parts.append('<div class="grid">')
        for trace in (one for one in drawn if one.recording == name):
            rms = float(np.sqrt(np.mean(trace.residual**2)))
            alt = f"{trace.channel} of {name}, measured and predicted: residuals are {rms:.2f} times the noise"
            parts.append(picture(trace_figure(trace, within.get((name, trace.channel))), alt))
        parts.append("</div>")
    if result.heldout:
        rows = [[r, c, f"{100 * v:.3g} %"] for r, channels in result.heldout.items() for c, v in channels.items()]
        caption = "RMS error of the prediction over the range of what was measured"
        parts += ["<h2>Held-out recordings</h2>", table(["recording", "channel", "NRMSE"], rows, caption)]
    stages = [
        [s["name"], ", ".join(s["free"]), f"{s['rtol']:g}", f"{s['evaluations']}", f"{s['chi2']:.4g}",
         "yes" if s["converged"] else "no", f"{s['wall_s']:.1f} s"] for s in result.stages
    ]  # fmt: skip
    runs = ", ".join(
        f"{cost[k]:.0f} {name}"
        for k, name in (("simulations", "simulations"), ("jacobians", "Jacobians"), ("gradients", "gradients"),
                        ("remembered", "of them read from the checkpoint")) if cost[k]
    )  # fmt: skip
    parts += [
        "<h2>Stages and cost</h2>",
        table(["stage", "free", "tolerance", "evaluations", "χ²", "converged", "time"], stages),
        f"<p>{runs}; {cost['wall_s']:.1f} s in all.</p>",
        "<h2>How it was made</h2>",
        made_list(made),
        "<details><summary>Everything that decides the result</summary>"
        f"<pre>{escape(json.dumps(made, indent=1, ensure_ascii=False))}</pre></details>",
    ]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width,initial-scale=1"><title>{escape(head)}</title>'
        f"<style>\n{STYLE_SHEET.read_text(encoding='utf-8')}</style></head><body><main>{''.join(parts)}</main></body></html>\n"
    )


def correlations(result: IdentificationResult) -> str:
    """The strong ones, in words."""
    C, labels = result.correlation, result.labels
    strong = [
        f"{labels[i]} and {labels[j]} {C[i][j]:.2f}" for i in range(len(labels)) for j in range(i) if abs(C[i][j]) > 0.7
    ]
    return "; ".join(strong) or "none is beyond 0.7"


def made_list(made: dict[str, Any]) -> str:
    """Version, method and seed as a definition list."""
    when = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    labels: dict[str, Callable[[], str]] = {
        "torchsoft": lambda: made["torchsoft"],
        "method": lambda: f"{made['method']}, loss {made['loss']}",
        "tolerance": lambda: f"{made['rtol']:g}",
        "seed": lambda: str(made["seed"]),
        "sensors": lambda: ", ".join(f"{k} ± {s['noise']:g} {CHANNELS[k].unit}" for k, s in made["sensors"].items()),
        "units": lambda: "SI throughout; pictures show lengths in mm",
        "written": lambda: when,
    }
    return "<dl>" + "".join(f"<dt>{k}</dt><dd>{escape(text())}</dd>" for k, text in labels.items()) + "</dl>"
