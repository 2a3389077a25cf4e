"""Runs of the model, side by side in threads, each result kept on disk until the identification is done.

A fit is a deterministic function of its runs, so started again it reads what it already has, to the bit, and goes on from
there.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchsoft.cost import steps_per_second
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.journal import Journal
from torchsoft.sysid.prediction import (
    FailedRun,
    Frozen,
    Prediction,
    Steps,
    misfit,
    predict,
    set_parameters,
)
from torchsoft.sysid.recording import Recording, Start
from torchsoft.threads import side_by_side, single_threaded


class Job(NamedTuple):
    """One run: which recording, the unknown parameters' values, the names to differentiate by, and the steps.

    `interpolated` asks for a grid between the samples; `nuisance` (noise, bias and delay by channel) asks for the misfit and
    its gradient in place of the signals.
    """

    recording: int
    values: dict[str, float]
    names: tuple[str, ...]
    steps: Steps
    interpolated: bool = False
    nuisance: tuple[dict[str, float], dict[str, float], dict[str, float]] | None = None


class Runner:
    """Runs jobs in `workers` threads (in this one, if it is one), and remembers their results in the folder `journal`."""

    def __init__(self, recordings: Sequence[Recording], workers: int = 1, journal: Path | None = None) -> None:
        if workers < 1:
            raise ValueError(f"`workers` must be positive, but is {workers}")
        self.recordings, self.workers = tuple(recordings), workers
        self.simulations = self.jacobians = self.gradients = self.steps = self.remembered = 0
        self._journal = Journal(journal, self.recordings) if journal is not None else None
        self._idle: list[list[Start]] = [[] for _ in self.recordings]  # models that no thread is using

    def run(self, jobs: Sequence[Job]) -> list[Any]:
        """Results in the order of the jobs: `Prediction`, `Misfit` or `FailedRun`."""
        out = [self._journal.recall(job) if self._journal is not None else None for job in jobs]
        for job, result in zip(jobs, out):
            self._count(job, result is not None)
        todo = [i for i, result in enumerate(out) if result is None]
        todo.sort(key=lambda i: self._length(jobs[i]), reverse=True)  # the longest first
        with single_threaded():
            for i, result in side_by_side(lambda k: self._made(jobs[todo[k]]), len(todo), self.workers):
                out[todo[i]] = result
                self.steps += result.steps if isinstance(result, Prediction) else 0
        return out

    def _made(self, job: Job) -> Any:
        """The result of a run that is made now, and kept even if an interruption is waiting for its end."""
        idle = self._idle[job.recording]
        try:
            start = idle.pop()
        except IndexError:
            start = self.recordings[job.recording].begin()
        result = simulated(self.recordings[job.recording], start, job)
        idle.append(start)
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
        if job.nuisance is not None:
            self.gradients += 1
        elif job.names:
            self.jacobians += 1
        else:
            self.simulations += 1


def simulated(recording: Recording, start: Start, job: Job) -> Any:
    """A `Prediction`, a `Misfit`, or a `FailedRun`, by a model that nobody else is using."""
    set_parameters(start.model, job.values)
    t = recording.grid(job.interpolated)
    try:
        if job.nuisance is None:
            return predict(start.model, start.y0, t, job.names, job.steps)
        return misfit(start.model, start.y0, recording, t, job.names, job.steps, *job.nuisance)
    except SimulationFailed as failure:
        return FailedRun(failure.reason, failure.time)
