"""Runs of the model, side by side in threads, each result kept on disk until the identification is done.

A fit is a deterministic function of its runs, so started again it reads what it already has, to the bit, and goes on from
there.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchsoft.cost import steps_per_second
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.problem.journal import Journal
from torchsoft.sysid.problem.noise import Autoregression
from torchsoft.sysid.problem.prediction import FailedRun, Frozen, Prediction, Steps, misfit, predict
from torchsoft.sysid.problem.readout import Readout, Signals
from torchsoft.sysid.problem.recording import Array, Recording, RunContext
from torchsoft.sysid.problem.unknowns import NUISANCES
from torchsoft.threads import parallel_map, single_threaded


class Job(NamedTuple):
    """One run: which recording, the values of what is unknown, the names to differentiate by, and the steps.

    `interpolated` asks for a grid between the samples; `judged` asks for the misfit and its gradient in place of the signals:
    by every sensor's readout and the colour of its noise.
    """

    recording: int
    values: dict[str, float]
    names: tuple[str, ...]
    steps: Steps
    interpolated: bool = False
    judged: tuple[tuple[Readout, Autoregression | None], ...] | None = None


class Runner:
    """Runs jobs in `workers` threads (in this one, if it is one), and remembers their results in the folder `journal`."""

    def __init__(self, recordings: Sequence[Recording], workers: int = 1, journal: Path | None = None) -> None:
        if workers < 1:
            raise ValueError(f"`workers` must be positive, but is {workers}")
        self.recordings, self.workers, self.folder = tuple(recordings), workers, journal
        self.simulations = self.jacobians = self.gradients = self.steps = self.remembered = 0
        self._journal = Journal(journal, self.recordings) if journal is not None else None
        self._idle: list[list[RunContext]] = [[] for _ in self.recordings]  # models that no thread is using

    def run(self, jobs: Sequence[Job]) -> list[Any]:
        """Results in the order of the jobs: `Prediction`, `Misfit` or `FailedRun`."""
        out = [self._journal.recall(job) if self._journal is not None else None for job in jobs]
        for job, result in zip(jobs, out):
            self._count(job, result is not None)
        todo = [i for i, result in enumerate(out) if result is None]
        todo.sort(key=lambda i: self._length(jobs[i]), reverse=True)  # the longest first
        with single_threaded():
            for i, result in parallel_map(lambda k: self._made(jobs[todo[k]]), len(todo), self.workers):
                out[todo[i]] = result
                self.steps += result.steps if isinstance(result, Prediction) else 0
        return out

    def _made(self, job: Job) -> Any:
        """The result of a run that is made now, and kept even if an interruption is waiting for its end."""
        idle = self._idle[job.recording]
        try:
            begun = idle.pop()
        except IndexError:
            begun = self.recordings[job.recording].begin()
        result = simulated(self.recordings[job.recording], begun, job)
        idle.append(begun)
        if self._journal is not None:
            self._journal.keep(job, result)
        return result

    def _length(self, job: Job) -> float:
        """Steps of a run [1], by experience where they are not chosen yet."""
        if isinstance(job.steps, Frozen):
            return len(job.steps.knots) - 1
        return steps_per_second(job.steps) * self.recordings[job.recording].duration

    def _count(self, job: Job, remembered: bool) -> None:
        self.remembered += remembered
        if job.judged is not None:
            self.gradients += 1
        elif job.names:
            self.jacobians += 1
        else:
            self.simulations += 1


def simulated(recording: Recording, begun: RunContext, job: Job) -> Any:
    """A `Prediction`, a `Misfit`, or a `FailedRun`, by a rig that nobody else is using."""
    run = begun, job.values, recording.grid(job.interpolated), job.names, job.steps
    try:
        if job.judged is None:
            return predict(*run)
        return misfit(*run, lambda signals: judge(recording, job.judged or (), signals))
    except SimulationFailed as failure:
        return FailedRun(failure.reason, failure.time)


def judge(
    recording: Recording, judged: Sequence[tuple[Readout, Autoregression | None]], signals: Signals
) -> tuple[float, Array, Array]:
    """Half the sum of squared residuals, its derivatives by the signals (G, channels), and by the nuisances of every readout
    (readouts, nuisances)."""
    loss, on_signals, on_nuisances = 0.0, np.zeros(signals.values.shape), np.zeros((len(judged), len(NUISANCES)))
    for k, (one, noise) in enumerate(judged):
        t, measured = recording.samples[one.channel]
        y, _, by = one.expected(signals, t)
        r, weight = one.residuals(y, measured)
        if noise is not None:
            W = noise.whitener(t)
            r = W @ r
            v = weight * (W.T @ r)
        else:
            v = weight * r
        loss, on_signals = loss + 0.5 * float(r @ r), on_signals + one.pulled_back(signals, t, v)
        on_nuisances[k] = [v @ by[kind] if kind in by else 0.0 for kind in NUISANCES]
    return loss, on_signals, on_nuisances
