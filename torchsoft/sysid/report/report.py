"""A page about an identification: one HTML file with its pictures inside, that any browser opens without a network."""

from pathlib import Path

import numpy as np

from torchsoft.files import replacing
from torchsoft.sysid.prediction import FailedRun, Signals
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.report import sections
from torchsoft.sysid.report.figures import Trace
from torchsoft.sysid.report.page import document, heading
from torchsoft.sysid.result import IdentificationResult
from torchsoft.sysid.runs import Runner


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
        partial.write_text(page(result, drawn, lost), encoding="utf-8")


def traces(result: IdentificationResult, problem: Problem, journal: Path | None) -> tuple[list[Trace], dict[str, str]]:
    """Measured and predicted samples of every recording at the result, and why others could not be simulated."""
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
            out.append(Trace(recording.name, channel, recording.units[channel], t, measured, y, r, white))
    return out, lost


def page(result: IdentificationResult, drawn: list[Trace], lost: dict[str, str]) -> str:
    """The whole HTML text."""
    head = result.headline
    about = (
        sections.summary, sections.estimates, sections.told, sections.identifiable, sections.profiles,
        sections.taken_for_granted, sections.laws,
    )  # fmt: skip
    parts = [heading(head, 1), *(part for section in about for part in section(result))]
    parts += [
        *sections.data(result, drawn, lost),
        *sections.cost(result),
        *sections.made(result, {one.channel: one.unit for one in drawn}),
    ]
    return document(head, parts)
