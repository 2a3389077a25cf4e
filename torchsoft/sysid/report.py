"""HTML report of an identification, self-contained for any browser. `report.html` holds the text,
this module the data."""

import base64
import io
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from torchsoft.files import save_text
from torchsoft.sysid.assumption_tests import AssumptionTest
from torchsoft.sysid.estimate import Estimate
from torchsoft.sysid.figures import (
    Trace,
    direction_name,
    estimates_figure,
    trace_figure,
)
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.result import IdentificationResult
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.suspects import CONTRADICTED, MOVED
from torchsoft.tables import plain

PAGES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    finalize=lambda value: value if isinstance(value, Markup) else plain(str(value)),
)
"""Templates that escape their values and remove control characters."""

Cell = str | tuple[str, str]
"""Text, or a class with text."""


def png(figure: Figure) -> Markup:
    """The figure as base 64 of a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=160)
    return Markup(base64.b64encode(buffer.getvalue()).decode())


def kept(head: Sequence[str], rows: Sequence[Sequence[Cell]]) -> list[tuple[int, str]]:
    """Columns of a table that are not empty, with their class: "n" for right-aligned numbers,
    except in the first."""
    out = []
    for i in range(len(head)):
        kinds = [kind for kind, text in (cell(row[i]) for row in rows) if text]
        if kinds:
            out.append((i, "n" if i > 0 and 2 * kinds.count("n") > len(kinds) else ""))
    return out


def cell(one: Cell, column: str = "n") -> tuple[str, str]:
    """Class and text of a cell; the class is "n" for text that begins like a number, or like an
    interval."""
    if isinstance(one, tuple):
        return one
    return "n" if column and one.strip(" −+×")[:1].isdigit() else "", one


def grouped(value: float, digits: int = 5) -> str:
    """A number with significant digits, grouped thousands such as 159 090, and a true minus."""
    text = f"{value:.{digits}g}"
    if 10.0**digits / 10 <= abs(value) < 1e9:
        text = f"{float(text):,.0f}".replace(",", "\u202f")
    return text.replace("-", "−", 1) if value < 0 else text


def signed(value: float) -> str:
    """A number with its sign."""
    return ("+" if value > 0 else "") + grouped(value, 2)


# Sections


def estimates(result: IdentificationResult) -> dict[str, list[list[Cell]]]:
    """Rows by caption: shared parameters, parameters of single recordings, starts, and faults of
    sensors."""
    groups: dict[str, list[Estimate]] = {
        "": [],
        "Parameters of which each recording has its own": [],
        "Where the runs began": [],
        "What the sensors add": [],
    }
    shared, single, starts, sensors = groups.values()
    for e in result.estimates:
        own = single if e.recording else shared
        {"parameter": own, "start": starts}.get(e.kind, sensors).append(e)

    def row(e: Estimate) -> list[Cell]:
        found: list[Cell] = [("weak", "not identifiable"), ("weak", "none")]
        if e.value is not None and e.ci95 is not None:
            found = [grouped(e.value), " … ".join(map(grouped, e.ci95))]
        return [
            e.name,
            ("", e.recording or ""),
            *found,
            "" if e.unit == "1" else e.unit,
            "" if e.start is None else grouped(e.start),
            prior(e),
            ("weak", "at a bound") if e.at_bound else "",
        ]

    return {
        caption: [row(e) for e in sorted(group, key=lambda e: e.name if e.recording else "")]
        for caption, group in groups.items()
    }


def prior(e: Estimate) -> Cell:
    """Median and standard deviation of the prior."""
    if e.prior is None:
        return ""
    sd = f"×/÷ {np.exp(e.prior.sd):.3g}" if e.prior.kind == "log-normal" else f"± {e.prior.sd:.2g}"
    return "", f"{grouped(e.prior.median)} {sd}"


def correlations(result: IdentificationResult) -> str:
    """Strong correlations in words."""
    C, labels = result.correlation, result.labels
    strong = [
        f"{labels[i]} and {labels[j]} {grouped(C[i][j], 2)}"
        for i in range(len(labels))
        for j in range(i)
        if abs(C[i][j]) > 0.7
    ]
    return "; ".join(strong) or "none is beyond 0.7"


def assumptions(result: IdentificationResult) -> dict[str, list[list[Cell]]]:
    """Rows on the tests of assumptions, with those apart that matter neither to the estimates nor
    to the data."""
    moving, harmless = list[list[Cell]](), list[list[Cell]]()
    for one in sorted(result.assumptions, key=lambda one: -abs(one.most_moved[1])):
        label, move = one.most_moved
        favoured, found = "", favour(one)
        if np.isfinite(one.favoured_sd) and not one.unchecked and one.kind != "several":
            by = one.unit if one.kind in ("known", "sensor") else "of that"
            favoured = f"{signed(one.favoured)} ± {grouped(one.favoured_sd, 2)} {by}".strip()
        moved = ("", f"{signed(move)} sd of {label}" if label else "")
        seen = f"{grouped(one.detectable, 2)} {one.unit}".strip()
        seen = seen if np.isfinite(one.detectable) and one.kind in ("known", "sensor") else ""
        row = [one.stated, one.otherwise, moved, favoured, ("weak" if found else "", found), seen]
        (moving if found or abs(move) > MOVED else harmless).append(row)
    return {"moving": moving, "harmless": harmless}


def favour(one: AssumptionTest) -> str:
    """Conclusion of the test of an assumption; empty where the data agree with it."""
    if one.unchecked:
        return f"not checked: {one.unchecked}"
    if one.suspected:
        how = "in a refit" if one.refitted else "by a score test"
        cause = "" if one.passed else ", but others are left"
        return f"suspected: lowers the sum of squares by {one.gain:.0f} {how}{cause}"
    if one.kind in ("known", "sensor") and abs(one.favoured) > CONTRADICTED * one.favoured_sd:
        return "differs by more than chance; other suspects explain more"
    return ""


def noise_of(model: Autoregression | None) -> str:
    """Order and standard deviation of the noise in words."""
    return "white" if model is None else f"order {model.order}, {model.sd:.2g} × as stated"


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
    drawn, failures = traces(result, problem, Path(checkpoint) if checkpoint is not None else None)
    save_text(path, page(result, drawn, failures))


def traces(
    result: IdentificationResult, problem: Problem, journal: Path | None
) -> tuple[list[Trace], dict[str, str]]:
    """Measured and predicted samples of every recording at the result, and the reasons of failed
    runs."""
    if result.noise:
        problem = problem.with_noise({one.channel: one.model for one in result.noise})
    x, out, failures = np.array(result.x), list[Trace](), dict[str, str]()
    runner, jobs = (
        Runner(problem.recordings, journal=journal),
        problem.jobs(x, problem.names, float(result.made_by["rtol"]), None),
    )
    for job, run in zip(jobs, runner.run(jobs)):
        recording = problem.recordings[job.recording]
        if isinstance(run, FailedRun):
            failures[recording.name] = run.reason
            continue
        for one in problem.readings(x, job, run):
            out.append(
                Trace(
                    recording.name,
                    one.channel,
                    recording.units[one.channel],
                    one.t,
                    one.measured,
                    one.expected,
                    one.r,
                    problem.whitened(recording, one.channel, one.r),
                )
            )
    return out, failures


def page(result: IdentificationResult, drawn: list[Trace], failures: dict[str, str]) -> str:
    """The HTML text."""
    within = {(one.recording, one.channel): one for one in result.residuals}
    noise = {one.channel: one.model for one in result.noise}
    units, by = {one.channel: one.unit for one in drawn}, result.made_by

    def traces(recording: str) -> list[tuple[Figure, str]]:
        out = []
        for trace in (trace for trace in drawn if trace.recording == recording):
            rms = float(np.sqrt(np.mean(trace.residual**2)))
            figure = trace_figure(
                trace, within.get((recording, trace.channel)), noise.get(trace.channel)
            )
            caption = f"{trace.channel} of {recording}, measured and predicted"
            out.append((figure, f"{caption}: residuals are {rms:.2f} times the noise"))
        return out

    parameters = [e for e in result.estimates if e.kind == "parameter"]
    weak = [direction_name(d) for d in result.directions if not d.identifiable]
    counts = {
        "simulations": "simulations",
        "jacobians": "Jacobians",
        "remembered": "of them read from the checkpoint",
    }
    return PAGES.get_template("report.html").render(
        result=result,
        png=png,
        kept=kept,
        cell=cell,
        failures=failures,
        traces=traces,
        moved=MOVED,
        fitted=", ".join(one.name for one in result.recordings if one.fitted),
        findings=[(one.severity, str(one)) for one in result.findings],
        estimates=estimates(result),
        estimates_figure=estimates_figure(parameters),
        ratios=[
            f"{e.label} not identifiable"
            if e.value is None
            else f"{e.label} {e.value / e.start:.3g} times its start"
            for e in parameters
            if e.start
        ],
        combined=[
            *(one.sentence for one in result.combinations),
            *(f"{name} may change without a trace in the data" for name in weak),
        ],
        strong=correlations(result),
        **assumptions(result),
        residuals=[
            [
                one.recording,
                one.channel,
                f"{one.rms:.2f}",
                grouped(one.lag1, 2),
                f"{one.p_white:.2g}",
                noise_of(noise.get(one.channel)),
            ]
            for one in result.residuals
        ],
        heldout=[
            [r, c, f"{100 * v:.3g} %"]
            for r, channels in result.heldout.items()
            for c, v in channels.items()
        ],
        stages=[
            [
                s["name"],
                ", ".join(s["free"]),
                f"{s['rtol']:g}",
                f"{s['evaluations']}",
                f"{s['chi2']:.4g}",
                "yes" if s["converged"] else "no",
                f"{s['wall_s']:.1f} s",
            ]
            for s in result.stages
        ],
        runs=[f"{result.cost[k]:.0f} {name}" for k, name in counts.items() if result.cost[k]],
        recordings=[
            [
                one.name,
                "fitted" if one.fitted else "held out",
                f"{one.duration:.4g} s",
                str(one.samples),
                one.rig,
                one.start,
                ("", one.fingerprint[:12]),
            ]
            for one in result.recordings
        ],
        definitions={
            "loss": by["loss"],
            "tolerance": f"{by['rtol']:g}",
            "seed": str(by["seed"]),
            "sensors": ", ".join(
                f"{k} ± {s.noise:g} {units.get(k, '')}" for k, s in result.sensors.items()
            ),
            "versions": ", ".join(f"{name} {number}" for name, number in result.versions.items()),
            "units": "SI throughout; pictures show lengths in mm",
            "written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        },
    )
