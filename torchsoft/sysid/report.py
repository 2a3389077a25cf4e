"""HTML report of an identification, self-contained for any browser. `report.html` holds the text,
this module the data."""

import base64
import io
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchsoft.files import save_text
from torchsoft.plot.figures import ACTUAL, OTHER, STYLE
from torchsoft.sysid.assumption_tests import AssumptionTest
from torchsoft.sysid.estimate import Estimate
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.problem import Problem, Reading
from torchsoft.sysid.result import IdentificationResult
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.suspect_findings import CONTRADICTED, MOVED
from torchsoft.tables import plain

PAGES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    finalize=lambda value: value if isinstance(value, Markup) else plain(str(value)),
)
"""Templates that escape their values and remove control characters."""

SHOWN = {"m": ("mm", 1e3), "m/s": ("mm/s", 1e3)}
"""Units in figures, by SI unit, with the factor to them; others stay as they are."""

SIZE = 5.4, 3.6
"""Size of a figure [in], at which its text is legible on a phone."""

STRONG = 0.7
"""Least correlation of two coordinates that the page names."""


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
    x, journal = np.array(result.x), None if checkpoint is None else Path(checkpoint)
    runner = Runner(problem.recordings, journal=journal)
    jobs = problem.jobs(x, problem.names, float(result.made_by["rtol"]), None)
    readings, failures = dict[str, list[Reading]](), dict[str, str]()
    for job, run in zip(jobs, runner.run(jobs)):
        name = problem.names[job.recording]
        failed = isinstance(run, FailedRun)
        failures |= {name: run.reason} if failed else {}
        readings[name] = [] if failed else [*problem.readings(x, job, run)]
    save_text(path, page(result, problem, readings, failures))


# Words and figures


def grouped(value: float, digits: int = 5) -> str:
    """A number with significant digits, grouped thousands such as 159 090, and a true minus."""
    text = f"{value:.{digits}g}"
    if 10.0**digits / 10 <= abs(value) < 1e9:
        text = f"{float(text):,.0f}".replace(",", "\u202f")
    return text.replace("-", "−", 1) if value < 0 else text


def signed(value: float) -> str:
    """A number with its sign."""
    return ("+" if value > 0 else "") + grouped(value, 2)


def columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[tuple[int, str]]:
    """Columns of a table that are not empty, with their class: "n" for right-aligned numbers,
    except in the first."""
    out = []
    for i in range(len(head)):
        texts = [row[i] for row in rows if row[i]]
        numbers = sum(text.strip(" −+×")[:1].isdigit() for text in texts)
        out += [(i, "n" if i > 0 and 2 * numbers > len(texts) else "")] if texts else []
    return out


@rc_context(STYLE)
def figure(one: Reading, unit: str) -> Figure:
    """Measured and predicted samples, and residuals over the noise."""
    shown, scale = SHOWN.get(unit, (unit, 1.0))
    out = Figure(figsize=SIZE, layout="constrained")
    above, below = out.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    above.plot(one.t, scale * one.measured, ".", color=OTHER, ms=3.5, label="measured")
    above.plot(one.t, scale * one.expected, color=ACTUAL, lw=1.1, label="predicted")
    name = fill(f"{plain(one.channel)} [{shown}]", 40).replace("$", r"\$")
    above.set_title(name)
    above.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=2)
    below.axhspan(-1.96, 1.96, color="#e8f1f7", lw=0)
    below.plot(one.t, one.r, ".", color=ACTUAL, ms=2.5)
    below.set(title="residual over noise (band: 95 %)", xlabel="time [s]")
    below.set_ylim(*(1.1 * max(3.0, float(np.abs(one.r).max())) * np.array([-1, 1])))
    for axes in (above, below):
        axes.yaxis.set_major_locator(MaxNLocator(4))
    return out


def png(one: Figure) -> Markup:
    """The figure as base 64 of a PNG."""
    buffer = io.BytesIO()
    one.savefig(buffer, format="png", dpi=160)
    return Markup(base64.b64encode(buffer.getvalue()).decode())


# Rows of tables


def estimates(result: IdentificationResult) -> dict[str, list[list[str]]]:
    """Rows by caption: shared parameters, parameters of single recordings, starts, and faults of
    sensors."""
    own = "Parameters of which each recording has its own"
    captions = {"start": "Where the runs began"}
    groups = {caption: list[list[str]]() for caption in ("", own, *captions.values())}
    sensors = "What the sensors add"
    for e in sorted(result.estimates, key=lambda e: e.name if e.recording else ""):
        parameter = own if e.recording else ""
        caption = parameter if e.kind == "parameter" else captions.get(e.kind, sensors)
        found = ["not identifiable", "none"]
        if e.value is not None and e.ci95 is not None:
            found = [grouped(e.value), " … ".join(map(grouped, e.ci95))]
        start = "" if e.start is None else grouped(e.start)
        unit, bound = "" if e.unit == "1" else e.unit, "at a bound" if e.at_bound else ""
        row = [e.name, e.recording or "", *found, unit, start, prior(e), bound]
        groups.setdefault(caption, []).append(row)
    return groups


def prior(e: Estimate) -> str:
    """Median and standard deviation of the prior."""
    if e.prior is None:
        return ""
    sd = f"×/÷ {np.exp(e.prior.sd):.3g}" if e.prior.kind == "log-normal" else f"± {e.prior.sd:.2g}"
    return f"{grouped(e.prior.median)} {sd}"


def correlations(result: IdentificationResult) -> str:
    """Strong correlations in words."""
    C, labels = np.tril(np.array(result.correlation, float), -1), result.labels
    strong = [
        f"{labels[i]} and {labels[j]} {grouped(float(C[i, j]), 2)}"
        for i, j in np.argwhere(np.abs(C) > STRONG)
    ]
    return "; ".join(strong) or f"none is beyond {STRONG}"


def assumptions(result: IdentificationResult) -> tuple[list[list[str]], list[list[str]]]:
    """Rows on the tests of assumptions, suspects first, with those apart that matter neither to the
    estimates nor to the data."""
    moving, harmless = list[list[str]](), list[list[str]]()
    order = sorted(result.assumptions, key=lambda one: (-one.score, -abs(one.most_moved[1])))
    for one in order:
        label, move = one.most_moved
        favoured, seen, measurable = "", "", one.has_amount
        if np.isfinite(one.favoured_sd) and not one.unchecked:
            by = one.unit if measurable else "of that"
            favoured = f"{signed(one.favoured)} ± {grouped(one.favoured_sd, 2)} {by}".strip()
        if np.isfinite(one.detectable) and measurable:
            seen = f"{grouped(one.detectable, 2)} {one.unit}".strip()
        moved, found = f"{signed(move)} sd of {label}" if label else "", favour(one)
        row = [one.stated, one.otherwise, moved, favoured, found, seen]
        (moving if found or abs(move) > MOVED else harmless).append(row)
    return moving, harmless


def favour(one: AssumptionTest) -> str:
    """Conclusion of the test of an assumption; empty where the data agree with it."""
    if one.unchecked:
        return f"not checked: {one.unchecked}"
    if one.dropped:
        return (
            "not excluded: its refit was left to others that gained more" if one.suspected else ""
        )
    if one.suspected:
        how = "in a refit" if one.refitted else "by a score test"
        cause = "" if one.passed else ", but others are left"
        return f"suspected: lowers the sum of squares by {one.gain:.0f} {how}{cause}"
    if one.has_amount and abs(one.favoured) > CONTRADICTED * one.favoured_sd:
        return "differs by more than chance; other suspects explain more"
    return ""


def stages(result: IdentificationResult) -> list[list[str]]:
    """Rows on the fits."""
    out = []
    for s in result.stages:
        row = [s["name"], ", ".join(s["free"]), f"{s['rtol']:g}", f"{s['evaluations']}"]
        out.append([*row, f"{s['chi2']:.4g}", "yes" if s["converged"] else "no",
                    f"{s['wall_s']:.1f} s"])  # fmt: skip
    return out


def recordings(result: IdentificationResult) -> list[list[str]]:
    """Rows on the recordings."""
    out = []
    for one in result.recordings:
        row = [one.name, "fitted" if one.fitted else "held out", f"{one.duration:.4g} s"]
        out.append([*row, str(one.samples), one.rig, one.start, one.fingerprint[:12]])
    return out


def residuals(result: IdentificationResult) -> list[list[str]]:
    """Rows on the residuals of what was fitted, with the order and the standard deviation of the
    noise."""
    noise = {
        name: f"order {one.order}, {one.sd:.2g} × as stated" for name, one in result.noise.items()
    }
    out = []
    for one in result.residuals:
        row = [one.recording, one.channel, f"{one.rms:.2f}", grouped(one.lag1, 2)]
        out.append([*row, f"{one.p_white:.2g}", noise.get(one.channel, "white")])
    return out


def pictures(recording: str, readings: list[Reading], problem: Problem) -> list[tuple[Markup, str]]:
    """Pictures of the channels of a recording, with what they show."""
    out = []
    for one in readings:
        rms = float(np.sqrt(np.mean(one.r**2)))
        shown = f"{one.channel} of {recording}, measured and predicted: residuals are {rms:.2f}"
        out.append((png(figure(one, problem.unit(one.channel))), f"{shown} times the noise"))
    return out


def page(
    result: IdentificationResult,
    problem: Problem,
    readings: dict[str, list[Reading]],
    failures: dict[str, str],
) -> str:
    """The HTML text."""

    by: dict[str, Any] = result.made_by
    moving, harmless = assumptions(result)
    cost = {"simulations": "simulations", "jacobians": "Jacobians",
            "remembered": "of them read from the checkpoint"}  # fmt: skip
    noise = [f"{k} ± {s.noise:g} {problem.unit(k)}" for k, s in result.sensors.items()]
    return PAGES.get_template("report.html").render(
        result=result,
        columns=columns,
        failures=failures,
        pictures={name: pictures(name, mine, problem) for name, mine in readings.items()},
        moved=MOVED,
        fitted=", ".join(one.name for one in result.recordings if one.fitted),
        findings=[(one.severity, str(one)) for one in result.findings],
        estimates=estimates(result),
        combined=[one.sentence for one in result.combinations],
        strong=correlations(result),
        moving=moving,
        harmless=harmless,
        residuals=residuals(result),
        heldout=[
            [name, channel, f"{100 * value:.3g} %"]
            for name, channels in result.heldout.items()
            for channel, value in channels.items()
        ],
        stages=stages(result),
        runs=[f"{result.cost[k]:.0f} {name}" for k, name in cost.items() if result.cost[k]],
        recordings=recordings(result),
        definitions={
            "loss": by["loss"],
            "tolerance": f"{by['rtol']:g}",
            "seed": by["seed"],
            "sensors": ", ".join(noise),
            "versions": ", ".join(f"{name} {number}" for name, number in result.versions.items()),
            "units": "SI throughout; pictures show lengths in mm",
            "written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        },
    )
