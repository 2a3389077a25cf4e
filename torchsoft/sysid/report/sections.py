"""Sections of a page about an identification, each from its answer and as HTML."""

import json
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime

import numpy as np

from torchsoft.sysid.estimate import Estimate
from torchsoft.sysid.report.comparison_figure import plot
from torchsoft.sysid.report.figures import (
    Trace,
    contributions_figure,
    correlation_figure,
    direction_name,
    estimates_figure,
    profile_figure,
    spectrum_figure,
    trace_figure,
)
from torchsoft.sysid.report.page import (
    Cell,
    definitions,
    folded,
    grouped,
    heading,
    interval,
    listing,
    paragraph,
    picture,
    signed,
    table,
    verbatim,
)
from torchsoft.sysid.result import IdentificationResult

MOVED = 0.5
"""Standard deviations by which something that was taken for granted may move an estimate and still be folded away."""


def summary(result: IdentificationResult) -> Iterator[str]:
    """What was fitted, and what a reader must know first."""
    fitted = ", ".join(one.name for one in result.recordings if one.fitted)
    yield paragraph(
        f"{fitted}: {result.cost['data_seconds']:.3g} s of data, {result.cost['samples']:.0f} samples. χ² is the sum of "
        "squared residuals over the noise, per degree of freedom: 1 where model and noise are right.",
        "soft",
    )
    notices = [*result.notices, *(n for one in result.profiles for n in one.notices)]
    notices += result.posterior.notices if result.posterior is not None else []
    notices += (
        [result.comparison.verdict] if result.comparison is not None and result.comparison.outcome != "law" else []
    )
    if notices:
        inside = f"<strong>Read this first</strong>{listing(dict.fromkeys(notices))}"
        yield f'<div class="notices" role="note">{inside}</div>'
    else:
        yield paragraph("Converged, residuals white, steps fine enough: there is nothing to warn of.", "fine")


def estimates(result: IdentificationResult) -> Iterator[str]:
    """Parameters, those of single recordings, starts and sensors, apart from each other."""
    of = [e for e in result.estimates if e.kind == "parameter"]
    yield heading("Estimates")
    groups = {
        "": [e for e in of if e.recording is None],
        "Parameters of which each recording has its own": [e for e in of if e.recording is not None],
        "Where the runs began": [e for e in result.estimates if e.kind == "start"],
        "What the sensors add": [e for e in result.estimates if e.kind not in ("parameter", "start")],
    }
    profiled = {one.label: one.ci95 for one in result.profiles}
    posterior = {one.label: one.ci95 for one in result.posterior.marginals} if result.posterior is not None else {}
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
                e.name, ("", e.recording or ""), *found(e), interval(*profiled[e.label]) if e.label in profiled else "",
                interval(*posterior[e.label]) if e.label in posterior else "", "" if e.unit == "1" else e.unit,
                "" if e.start is None else grouped(e.start), prior(e), ("weak", "at a bound") if e.at_bound else "",
            ]
            for e in sorted(group, key=lambda e: e.name if e.recording else "")
        ]  # fmt: skip
        if rows:
            yield table(head, rows, caption)
    figure = estimates_figure(of)
    if figure is not None:
        ratios = [
            f"{e.label} {f'{e.value / e.start:.3g} times its start' if e.value is not None else 'not identifiable'}"
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


def told(result: IdentificationResult) -> Iterator[str]:
    """How much each recording told."""
    figure = contributions_figure(result)
    if figure is None:
        return
    yield heading("How much each recording told")
    yield paragraph(
        "The weight that each recording has in an estimate, and in brackets how many times larger the standard deviation "
        "would be without it; “only here” where the others do not determine the parameter."
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
    alt = "; ".join(f"{row[0]}: " + ", ".join(f"{s} {c}" for s, c in zip(sources, row[1:])) for row in rows)
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
        "Each bar is a combination of parameters (of their logarithms) that the data determine on its own: the shorter, the "
        "better. Long orange bars are combinations that may change without a trace in the data."
    )
    spectrum = "; ".join(f"{direction_name(d)}: standard deviation {d.sd:.2g}" for d in result.directions)
    ends = f". Not identifiable: {'; '.join(weak)}" if weak else ". All are identifiable"
    shown = picture(spectrum_figure(result), f"Fisher spectrum: {spectrum}{ends}", "Fisher spectrum")
    strong = correlations(result)
    shown += picture(correlation_figure(result), f"Correlations: {strong}", "Correlation of the estimates")
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
        "How the misfit rises when one parameter is held and all others are fitted again, beside the parabola that the "
        "covariance stands for. Where the two part, the profile's interval (shaded) is the one to take."
    )
    shown = [
        picture(profile_figure(one, units.get(one.label, "")), f"Profile of {one.label}: {interval(*one.ci95)}")
        for one in result.profiles
    ]
    yield f'<div class="grid">{"".join(shown)}</div>'


def taken_for_granted(result: IdentificationResult) -> Iterator[str]:
    """What estimates hang on, and what the data say of it; the harmless ones are folded away."""
    if not result.assumptions:
        return
    first, rest = list[list[Cell]](), list[list[Cell]]()
    most = [max((abs(move) for move in one.moves.values()), default=0.0) for one in result.assumptions]
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
    yield heading("What was taken for granted")
    yield paragraph(
        "How far the estimate that moves most would move (in its standard deviations) if something that was stated were "
        "otherwise, and how much of that the data favour."
    )
    head = ["taken for granted", "if", "would move", "do the data favour it?"]
    if first:
        yield table(head, first)
    if rest:
        yield folded(f"{len(rest)} that move nothing by more than {MOVED:g} standard deviations", table(head, rest))


def laws(result: IdentificationResult) -> Iterator[str]:
    """Competing laws, if there are any."""
    compared = result.comparison
    if compared is None:
        return
    yield heading("Which law")
    yield paragraph(compared.verdict)
    best = compared.laws[0]
    rows = [
        [one.name, str(one.parameters), f"{one.chi2:.3f}", f"{one.log_likelihood:.1f}", f"{one.aicc - best.aicc:.1f}",
         f"{one.bic - best.bic:.1f}", "" if one.heldout is None else f"{one.heldout:.3f}",
         "yes" if one.fits else ("weak", "no")]
        for one in compared.laws
    ]  # fmt: skip
    yield table(["law", "parameters", "χ²", "log likelihood", "ΔAICc", "ΔBIC", "held out, per sample", "fits"], rows)
    if compared.series and compared.against:
        yield picture(plot(compared), "Where in the motion the evidence stands.", kind="broad")


def data(result: IdentificationResult, drawn: Sequence[Trace], lost: dict[str, str]) -> Iterator[str]:
    """Samples against predictions, residuals and their colour, held-out recordings."""
    within = {(one.recording, one.channel): one for one in result.residuals}
    noise = {one.channel: one.model for one in result.noise}
    yield heading("Data against prediction")
    rows = [
        [one.recording, one.channel, f"{one.rms:.2f}", grouped(one.lag1, 2), f"{one.p_white:.2g}",
         f"order {noise[one.channel].order}, {noise[one.channel].sd:.2g} × as stated" if one.channel in noise else "white"]
        for one in result.residuals
    ]  # fmt: skip
    head = ["recording", "channel", "rms over noise", "lag-1 correlation", "p (white)", "noise"]
    yield table(head, rows, "Residuals of what was fitted: 1, 0 and no small p where model and noise are right")
    if result.heldout:
        rows = [[r, c, f"{100 * v:.3g} %"] for r, channels in result.heldout.items() for c, v in channels.items()]
        yield heading("Held-out recordings", 3)
        yield table(
            ["recording", "channel", "NRMSE"], rows, "RMS error of the prediction over the range of what was measured"
        )
    for one in result.recordings:
        yield heading(f"{one.name} ({'fitted' if one.fitted else 'held out: predicted, not fitted'})", 3)
        if one.name in lost:
            yield paragraph(f"Could not be simulated: {lost[one.name]}", "notices")
        shown = ""
        for trace in (trace for trace in drawn if trace.recording == one.name):
            rms = float(np.sqrt(np.mean(trace.residual**2)))
            alt = f"{trace.channel} of {one.name}, measured and predicted: residuals are {rms:.2f} times the noise"
            figure = trace_figure(trace, within.get((one.name, trace.channel)), noise.get(trace.channel))
            shown += picture(figure, alt)
        yield f'<div class="grid">{shown}</div>'


def cost(result: IdentificationResult) -> Iterator[str]:
    """Stages, and what they took."""
    rows = [
        [s["name"], ", ".join(s["free"]), f"{s['rtol']:g}", f"{s['evaluations']}", f"{s['chi2']:.4g}",
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
        [one.name, "fitted" if one.fitted else "held out", f"{one.duration:.4g} s", str(one.samples), one.rig, one.start,
         ("", one.fingerprint[:12])] for one in result.recordings
    ]  # fmt: skip
    yield table(["recording", "used", "length", "samples", "rig", "begins", "fingerprint"], rows)
    by = result.made_by
    yield definitions(
        [
            ("method", f"{by['method']}, loss {by['loss']}"),
            ("tolerance", f"{by['rtol']:g}"),
            ("seed", str(by["seed"])),
            ("sensors", ", ".join(f"{k} ± {s.noise:g} {units.get(k, '')}" for k, s in result.sensors.items())),
            ("versions", ", ".join(f"{name} {number}" for name, number in result.versions.items())),
            ("units", "SI throughout; pictures show lengths in mm"),
            ("written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")),
        ]
    )
    if result.command:
        yield paragraph("The command that repeats it:")
        yield verbatim(result.command)
    yield folded("Everything that decides the result", verbatim(json.dumps(by, indent=1, ensure_ascii=False)))
