"""Runs of the model, side by side in processes, each result kept on disk until the identification is done.

A fit is a deterministic function of its runs, so started again it reads what it already has, to the bit, and goes on from
there.
"""

from collections.abc import Sequence
from concurrent.futures import Future, as_completed
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple, Self

from threadpoolctl import threadpool_limits

from torchsoft.processes import local_processes
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.journal import Journal
from torchsoft.sysid.prediction import FailedRun, Prediction, misfit, predict, set_parameters
from torchsoft.sysid.recording import Recording, Start


class Job(NamedTuple):
    """One run: which recording, the unknown parameters' values, the names to differentiate by, and the step [s].

    `interpolated` asks for a grid between the samples; `nuisance` (noise, bias and delay by channel) asks for the misfit and
    its gradient in place of the signals.
    """

    recording: int
    values: dict[str, float]
    names: tuple[str, ...]
    step: float
    interpolated: bool = False
    nuisance: tuple[dict[str, float], dict[str, float], dict[str, float]] | None = None


_recordings: tuple[Recording, ...] = ()
_models: dict[int, Start] = {}


def _prepare(recordings: tuple[Recording, ...]) -> None:
    global _recordings
    _recordings = recordings
    _models.clear()


def _run(job: Job) -> Any:
    """A `Prediction`, a `Misfit`, or a `FailedRun`."""
    recording = _recordings[job.recording]
    if job.recording not in _models:
        _models[job.recording] = recording.begin()
    model = _models[job.recording].model
    set_parameters(model, job.values)
    y0 = _models[job.recording].y0
    t = recording.grid(job.step, job.interpolated)
    with threadpool_limits(1):
        try:
            if job.nuisance is None:
                return predict(model, y0, t, job.names, job.step)
            return misfit(model, y0, recording, t, job.names, job.step, *job.nuisance)
        except SimulationFailed as failure:
            return FailedRun(failure.reason, failure.time)


class Runner:
    """Runs jobs in `workers` processes (in this one, if it is one), and remembers their results in the folder `journal`.

    A context manager. Scripts that use more than one worker need the usual `if __name__ == "__main__"`.
    """

    def __init__(self, recordings: Sequence[Recording], workers: int = 1, journal: Path | None = None) -> None:
        if workers < 1:
            raise ValueError(f"`workers` must be positive, but is {workers}")
        self.recordings, self.workers = tuple(recordings), workers
        self.simulations = self.jacobians = self.gradients = self.steps = self.remembered = 0
        self._open, self._pool = ExitStack(), None
        self._journal = Journal(journal, self.recordings) if journal is not None else None

    def __enter__(self) -> Self:
        if self.workers > 1:
            self._pool = self._open.enter_context(local_processes(self.workers, _prepare, self.recordings))
        else:
            _prepare(self.recordings)
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def run(self, jobs: Sequence[Job]) -> list[Any]:
        """Results in the order of the jobs: `Prediction`, `Misfit` or `FailedRun`."""
        out: list[Any] = []
        running: dict[Future[Any], int] = {}
        for i, job in enumerate(jobs):
            self._count(job)
            out.append(self._journal.recall(job) if self._journal is not None else None)
            self.remembered += out[i] is not None
            if out[i] is None and self._pool is not None:
                running[self._pool.submit(_run, job)] = i
            elif out[i] is None:
                out[i] = self._keep(job, _run(job))
        try:
            for future in as_completed(running):
                out[running[future]] = self._keep(jobs[running[future]], future.result())
        except KeyboardInterrupt:  # what is running ends by itself, and is kept
            for future in as_completed([future for future in running if not future.cancel()]):
                self._keep(jobs[running[future]], future.result())
            raise
        return out

    def _count(self, job: Job) -> None:
        if job.nuisance is not None:
            self.gradients += 1
        elif job.names:
            self.jacobians += 1
        else:
            self.simulations += 1

    def _keep(self, job: Job, result: Any) -> Any:
        if isinstance(result, Prediction):
            self.steps += result.steps
        if self._journal is not None:
            self._journal.keep(job, result)
        return result
