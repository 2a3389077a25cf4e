"""Report of an identification: one HTML file with its pictures inside, that any browser opens
without a network."""

import base64
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from html import escape as escaped
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from torchsoft.files import replacing
from torchsoft.sysid.estimate import Estimate
from torchsoft.sysid.figures import (
    Trace,
    contributions_figure,
    correlation_figure,
    direction_name,
    estimates_figure,
    plot,
    profile_figure,
    spectrum_figure,
    trace_figure,
)
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.prediction import FailedRun, Signals
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.result import IdentificationResult
from torchsoft.sysid.runs import Runner
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
        '<meta name="viewport" '
        f'content="width=device-width,initial-scale=1"><title>{escape(title)}</title>'
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
    return (
        "<dl>"
        + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in pairs if v)
        + "</dl>"
    )


def picture(figure: Figure, alt: str, caption: str = "", kind: str = "") -> str:
    """The figure with its PNG inside."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=160)
    inside = base64.b64encode(buffer.getvalue()).decode()
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    of = f' class="{kind}"' if kind else ""
    image = f'<img alt="{escape(alt)}" src="data:image/png;base64,{inside}">'
    return f"<figure{of}>{image}{below}</figure>"


def table(head: Sequence[str], rows: Sequence[Sequence[Cell]], caption: str = "") -> str:
    """Columns of numbers to the right, but for the first; columns without anything in them are left
    out."""
    kept = [i for i in range(len(head)) if any(text_of(row[i]) for row in rows)]
    filled = {i: [kind_of(row[i]) for row in rows if text_of(row[i])] for i in kept}
    numeric = {i for i in kept[1:] if 2 * filled[i].count("n") > len(filled[i])}

    def cell(i: int, value: Cell) -> str:
        kind = "" if i not in numeric and isinstance(value, str) else kind_of(value)
        return f'<td class="{kind}" data-label="{escape(head[i])}">{escape(text_of(value))}</td>'

    top = "".join(
        f'<th scope="col" class="{"n" if i in numeric else ""}">{escape(head[i])}</th>'
        for i in kept
    )
    body = "".join(f"<tr>{''.join(cell(i, row[i]) for i in kept)}</tr>" for row in rows)
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    inside = f"{above}<thead><tr>{top}</tr></thead><tbody>{body}</tbody>"
    return f'<div class="wide"><table>{inside}</table></div>'


def text_of(cell: Cell) -> str:
    return cell[1] if isinstance(cell, tuple) else cell


def kind_of(cell: Cell) -> str:
    """Its class; "n" for what begins like a number, or like an interval."""
    if isinstance(cell, tuple):
        return cell[0]
    return (
        "n"
        if cell.strip(" −+×").removeprefix("open … ")[:1].isdigit() or cell == "open … open"
        else ""
    )


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
    return (
        f"{'open' if low is None else grouped(low)} … {'open' if high is None else grouped(high)}"
    )


# Sections


MOVED = 0.5
"""Standard deviations by which something that was taken for granted may move an estimate and still
be folded away."""


def summary(result: IdentificationResult) -> Iterator[str]:
    """What was fitted, and what a reader must know first."""
    fitted = ", ".join(one.name for one in result.recordings if one.fitted)
    yield paragraph(
        f"{fitted}: {result.cost['data_seconds']:.3g} s of data, {result.cost['samples']:.0f} "
        "samples. χ² is the sum of squared residuals over the noise, per degree of freedom: 1 "
        "where model and noise are right.",
        "soft",
    )
    notices = [*result.notices, *(n for one in result.profiles for n in one.notices)]
    notices += result.posterior.notices if result.posterior is not None else []
    notices += (
        [result.comparison.verdict]
        if result.comparison is not None and result.comparison.outcome != "law"
        else []
    )
    if notices:
        inside = f"<strong>Read this first</strong>{listing(dict.fromkeys(notices))}"
        yield f'<div class="notices" role="note">{inside}</div>'
    else:
        yield paragraph(
            "Converged, residuals white, steps fine enough: there is nothing to warn of.", "fine"
        )


def estimates(result: IdentificationResult) -> Iterator[str]:
    """Parameters, those of single recordings, starts and sensors, apart from each other."""
    of = [e for e in result.estimates if e.kind == "parameter"]
    yield heading("Estimates")
    groups = {
        "": [e for e in of if e.recording is None],
        "Parameters of which each recording has its own": [
            e for e in of if e.recording is not None
        ],
        "Where the runs began": [e for e in result.estimates if e.kind == "start"],
        "What the sensors add": [
            e for e in result.estimates if e.kind not in ("parameter", "start")
        ],
    }
    profiled = {one.label: one.ci95 for one in result.profiles}
    posterior = (
        {one.label: one.ci95 for one in result.posterior.marginals}
        if result.posterior is not None
        else {}
    )
    head = [
        "name",
        "recording",
        "estimate",
        "95 % interval",
        "by its profile",
        "by the posterior",
        "unit",
        "start",
        "prior",
        "note",
    ]
    for caption, group in groups.items():
        rows = [
            [
                e.name, ("", e.recording or ""), *found(e),
                interval(*profiled[e.label]) if e.label in profiled else "",
                interval(*posterior[e.label]) if e.label in posterior else "",
                "" if e.unit == "1" else e.unit, "" if e.start is None else grouped(e.start),
                prior(e), ("weak", "at a bound") if e.at_bound else "",
            ]
            for e in sorted(group, key=lambda e: e.name if e.recording else "")
        ]  # fmt: skip
        if rows:
            yield table(head, rows, caption)
    figure = estimates_figure(of)
    if figure is not None:
        ratios = [
            f"{e.label} {e.value / e.start:.3g} times its start"
            if e.value is not None
            else f"{e.label} not identifiable"
            for e in of
            if e.start
        ]
        yield picture(figure, f"Estimates over their start values: {'; '.join(ratios)}")


def found(e: Estimate) -> list[Cell]:
    """Value and interval."""
    if e.value is None or e.ci95 is None:
        return [("weak", "not identifiable"), ("weak", "none")]
    return [grouped(e.value), interval(*e.ci95)]


def prior(e: Estimate) -> Cell:
    """What was known before."""
    if e.prior is None:
        return ""
    sd = f"×/÷ {np.exp(e.prior.sd):.3g}" if e.prior.kind == "log-normal" else f"± {e.prior.sd:.2g}"
    return "", f"{grouped(e.prior.median)} {sd}"


def contributions_section(result: IdentificationResult) -> Iterator[str]:
    """Contribution of each recording."""
    figure = contributions_figure(result)
    if figure is None:
        return
    yield heading("Contribution of each recording")
    yield paragraph(
        "The weight that each recording has in an estimate, and in brackets how many times larger "
        "the standard deviation would be without it; “only here” where the others do not determine "
        "the parameter."
    )
    rows = []
    for e in (e for e in result.estimates if e.identifiable and e.kind == "parameter"):
        cells = []
        for one in result.contributions:
            factor = one.without[e.label]
            least = "only here" if factor is None else f"× {factor:.2f}"
            cells.append(f"{100 * one.shares[e.label]:.0f} % ({least})")
        rows.append([e.label, *cells])
    sources = [one.source or "priors" for one in result.contributions]
    alt = "; ".join(
        f"{row[0]}: " + ", ".join(f"{s} {c}" for s, c in zip(sources, row[1:])) for row in rows
    )
    yield picture(figure, f"Weight of the recordings in each estimate. {alt}")
    yield table(["parameter", *sources], rows)


def identifiable(result: IdentificationResult) -> Iterator[str]:
    """Directions and correlations, in words first."""
    yield heading("What is identifiable, and what is not")
    weak = [direction_name(d) for d in result.directions if not d.identifiable]
    words = [one.sentence for one in result.combinations] + [
        f"{name} may change without a trace in the data" for name in weak
    ]
    if words:
        yield listing(words)
    yield paragraph(
        "Each bar is a combination of parameters (of their logarithms) that the data determine on "
        "its own: the shorter, the better. Long orange bars are combinations that may change "
        "without a trace in the data."
    )
    spectrum = "; ".join(
        f"{direction_name(d)}: standard deviation {d.sd:.2g}" for d in result.directions
    )
    ends = f". Not identifiable: {'; '.join(weak)}" if weak else ". All are identifiable"
    shown = picture(
        spectrum_figure(result), f"Fisher spectrum: {spectrum}{ends}", "Fisher spectrum"
    )
    strong = correlations(result)
    shown += picture(
        correlation_figure(result), f"Correlations: {strong}", "Correlation of the estimates"
    )
    yield f'<div class="grid">{shown}</div>'
    yield paragraph(f"Strong correlations: {strong}.")


def correlations(result: IdentificationResult) -> str:
    """The strong ones, in words."""
    C, labels = result.correlation, result.labels
    strong = [
        f"{labels[i]} and {labels[j]} {grouped(C[i][j], 2)}"
        for i in range(len(labels))
        for j in range(i)
        if abs(C[i][j]) > 0.7
    ]
    return "; ".join(strong) or "none is beyond 0.7"


def profiles(result: IdentificationResult) -> Iterator[str]:
    """Profile likelihoods, if there are any."""
    if not result.profiles:
        return
    units = {e.label: e.unit for e in result.estimates}
    yield heading("Profiles")
    yield paragraph(
        "How the misfit rises when one parameter is held and all others are fitted again, beside "
        "the parabola that the covariance stands for. Where the two part, the profile's interval "
        "(shaded) is the one to take."
    )
    shown = [
        picture(
            profile_figure(one, units.get(one.label, "")),
            f"Profile of {one.label}: {interval(*one.ci95)}",
        )
        for one in result.profiles
    ]
    yield f'<div class="grid">{"".join(shown)}</div>'


def assumptions_section(result: IdentificationResult) -> Iterator[str]:
    """What estimates hang on, and what the data say of it; the harmless ones are folded away."""
    if not result.assumptions:
        return
    first, rest = list[list[Cell]](), list[list[Cell]]()
    most = [
        max((abs(move) for move in one.moves.values()), default=0.0) for one in result.assumptions
    ]
    for i in np.argsort([-m for m in most], kind="stable"):
        one = result.assumptions[i]
        label = max(one.moves, key=lambda name: abs(one.moves[name]), default="")
        amount, measured = "", one.kind in ("known", "sensor")
        if np.isfinite(one.favoured_sd) and not one.unchecked:
            by = one.unit if measured else "of that"
            amount = f" {signed(one.favoured)} ± {grouped(one.favoured_sd, 2)} {by}".rstrip()
        asks: Cell = f"no:{amount}" if amount else "they cannot tell"
        if one.suspected:
            asks = "weak", f"yes{amount}: the sum of squares would fall by {one.gain:.0f}"
        if one.unchecked:
            asks = "weak", f"not checked: {one.unchecked}"
        moved = f"{signed(one.moves[label])} sd of {label}" if label else ""
        row: list[Cell] = [one.stated, one.otherwise, ("", moved), asks]
        (first if one.suspected or most[i] > MOVED or one.unchecked else rest).append(row)
    yield heading("Assumptions")
    yield paragraph(
        "How far the estimate that moves most would move (in its standard deviations) if something "
        "that was stated were otherwise, and how much of that the data favour."
    )
    head = ["assumption", "if", "would move", "do the data favour it?"]
    if first:
        yield table(head, first)
    if rest:
        yield folded(
            f"{len(rest)} that move nothing by more than {MOVED:g} standard deviations",
            table(head, rest),
        )


def laws(result: IdentificationResult) -> Iterator[str]:
    """Competing laws, if there are any."""
    compared = result.comparison
    if compared is None:
        return
    yield heading("Which law")
    yield paragraph(compared.verdict)
    best = compared.laws[0]
    rows = [
        [one.name, str(one.parameters), f"{one.chi2:.3f}", f"{one.log_likelihood:.1f}",
        f"{one.aicc - best.aicc:.1f}",
         f"{one.bic - best.bic:.1f}", "" if one.heldout is None else f"{one.heldout:.3f}",
         "yes" if one.fits else ("weak", "no")]
        for one in compared.laws
    ]  # fmt: skip
    yield table(
        [
            "law",
            "parameters",
            "χ²",
            "log likelihood",
            "ΔAICc",
            "ΔBIC",
            "held out, per sample",
            "fits",
        ],
        rows,
    )
    if compared.series and compared.against:
        yield picture(plot(compared), "Where in the motion the evidence stands.", kind="broad")


def noise_of(model: Autoregression | None) -> str:
    """Order and size of coloured noise."""
    return "white" if model is None else f"order {model.order}, {model.sd:.2g} × as stated"


def data(
    result: IdentificationResult, drawn: Sequence[Trace], lost: dict[str, str]
) -> Iterator[str]:
    """Samples against predictions, residuals and their colour, held-out recordings."""
    within = {(one.recording, one.channel): one for one in result.residuals}
    noise = {one.channel: one.model for one in result.noise}
    yield heading("Data against prediction")
    rows = [
        [one.recording, one.channel, f"{one.rms:.2f}", grouped(one.lag1, 2), f"{one.p_white:.2g}",
         noise_of(noise.get(one.channel))]
        for one in result.residuals
    ]  # fmt: skip
    head = ["recording", "channel", "rms over noise", "lag-1 correlation", "p (white)", "noise"]
    yield table(
        head,
        rows,
        "Residuals of what was fitted: 1, 0 and no small p where model and noise are right",
    )
    if result.heldout:
        rows = [
            [r, c, f"{100 * v:.3g} %"]
            for r, channels in result.heldout.items()
            for c, v in channels.items()
        ]
        yield heading("Held-out recordings", 3)
        yield table(
            ["recording", "channel", "NRMSE"],
            rows,
            "RMS error of the prediction over the range of what was measured",
        )
    for one in result.recordings:
        yield heading(
            f"{one.name} ({'fitted' if one.fitted else 'held out: predicted, not fitted'})", 3
        )
        if one.name in lost:
            yield paragraph(f"Could not be simulated: {lost[one.name]}", "notices")
        shown = ""
        for trace in (trace for trace in drawn if trace.recording == one.name):
            rms = float(np.sqrt(np.mean(trace.residual**2)))
            alt = (
                f"{trace.channel} of {one.name}, measured and predicted: residuals are {rms:.2f} "
                "times the noise"
            )
            figure = trace_figure(
                trace, within.get((one.name, trace.channel)), noise.get(trace.channel)
            )
            shown += picture(figure, alt)
        yield f'<div class="grid">{shown}</div>'


def cost(result: IdentificationResult) -> Iterator[str]:
    """Stages, and what they took."""
    rows = [
        [s["name"], ", ".join(s["free"]), f"{s['rtol']:g}", f"{s['evaluations']}",
        f"{s['chi2']:.4g}",
         "yes" if s["converged"] else "no", f"{s['wall_s']:.1f} s"] for s in result.stages
    ]  # fmt: skip
    names = {
        "simulations": "simulations", "jacobians": "Jacobians", "gradients": "gradients",
        "remembered": "of them read from the checkpoint",
    }  # fmt: skip
    runs = ", ".join(f"{result.cost[k]:.0f} {name}" for k, name in names.items() if result.cost[k])
    yield heading("Stages and cost")
    yield table(["stage", "free", "tolerance", "evaluations", "χ²", "converged", "time"], rows)
    yield paragraph(f"{runs}; {result.cost['wall_s']:.1f} s in all.")


def made(result: IdentificationResult, units: Mapping[str, str]) -> Iterator[str]:
    """What was fitted to what, by what, and the command that repeats it."""
    yield heading("How it was made")
    rows = [
        [one.name, "fitted" if one.fitted else "held out", f"{one.duration:.4g} s",
        str(one.samples), one.rig, one.start,
         ("", one.fingerprint[:12])] for one in result.recordings
    ]  # fmt: skip
    yield table(["recording", "used", "length", "samples", "rig", "begins", "fingerprint"], rows)
    by = result.made_by
    yield definitions(
        [
            ("method", f"{by['method']}, loss {by['loss']}"),
            ("tolerance", f"{by['rtol']:g}"),
            ("seed", str(by["seed"])),
            (
                "sensors",
                ", ".join(
                    f"{k} ± {s.noise:g} {units.get(k, '')}" for k, s in result.sensors.items()
                ),
            ),
            ("versions", ", ".join(f"{name} {number}" for name, number in result.versions.items())),
            ("units", "SI throughout; pictures show lengths in mm"),
            ("written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")),
        ]
    )
    if result.command:
        yield paragraph("The command that repeats it:")
        yield verbatim(result.command)
    yield folded(
        "Everything that decides the result", verbatim(json.dumps(by, indent=1, ensure_ascii=False))
    )


# The page


def report(
    result: IdentificationResult,
    problem: Problem,
    path: str | Path,
    *,
    checkpoint: str | Path | None = None,
) -> None:
    """Write the page about `result`, which `identify` found for `problem`. It appears whole or not
    at all.

    Every recording is simulated once more, unless the `checkpoint` folder has it. Raises
    `ValueError` where the result belongs to another problem.
    """
    if result.made_by["recordings"] != {r.name: r.fingerprint for r in problem.recordings}:
        raise ValueError("the result was made from other recordings than the problem's")
    drawn, lost = traces(result, problem, Path(checkpoint) if checkpoint is not None else None)
    with replacing(path) as partial:
        partial.write_text(page(result, drawn, lost), encoding="utf-8")


def traces(
    result: IdentificationResult, problem: Problem, journal: Path | None
) -> tuple[list[Trace], dict[str, str]]:
    """Measured and predicted samples of every recording at the result, and why others could not be
    simulated."""
    if result.noise:
        problem = problem.with_noise({one.channel: one.model for one in result.noise})
    x, out, lost = np.array(result.x), list[Trace](), dict[str, str]()
    runner, jobs = (
        Runner(problem.recordings, journal=journal),
        problem.jobs(x, problem.names, float(result.made_by["rtol"]), None),
    )
    for job, run in zip(jobs, runner.run(jobs)):
        recording = problem.recordings[job.recording]
        if isinstance(run, FailedRun):
            lost[recording.name] = run.reason
            continue
        signals = Signals(run.t, recording.channels, run.signals, None)
        for channel, sensor in problem.readouts(x, job.recording).items():
            t, measured = recording.samples[channel]
            y, _, _ = sensor.expected(signals, t)
            r, _ = sensor.residuals(y, measured)
            white = problem.whitened(recording, channel, r)
            out.append(
                Trace(recording.name, channel, recording.units[channel], t, measured, y, r, white)
            )
    return out, lost


def page(result: IdentificationResult, drawn: list[Trace], lost: dict[str, str]) -> str:
    """The whole HTML text."""
    head = result.headline
    about = (
        summary, estimates, contributions_section, identifiable, profiles,
        assumptions_section, laws,
    )  # fmt: skip
    parts = [heading(head, 1), *(part for section in about for part in section(result))]
    parts += [
        *data(result, drawn, lost),
        *cost(result),
        *made(result, {one.channel: one.unit for one in drawn}),
    ]
    return document(head, parts)
