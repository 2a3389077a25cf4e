"""Runs of the model, side by side in processes, each result kept on disk until the identification is done.

The journal is what makes an identification resume: a fit is a deterministic function of its runs, so started again it reads
what it already has, to the bit, and goes on from there.
"""

import pickle
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, Self

from threadpoolctl import threadpool_limits

from torchsoft.files import replacing
from torchsoft.processes import local_processes
from torchsoft.solve.kernel import HERE, digest
from torchsoft.solve.stepper import SimulationFailed
from torchsoft.sysid.prediction import Prediction, misfit, predict, set_parameters
from torchsoft.sysid.recording import Recording, Start

ENGINE = HERE, HERE.parent, HERE.parents[1] / "codegen", HERE.parents[1] / "physics"
"""Folders of everything that decides a run."""


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


class FailedRun(NamedTuple):
    """A run that could not be finished, and why."""

    reason: str
    time: float


_recordings: tuple[Recording, ...] = ()
_models: dict[int, Start] = {}


def _prepare(recordings: tuple[Recording, ...]) -> None:
    global _recordings
    _recordings = recordings
    _models.clear()


def _run(job: Job) -> Any:
    """A `Prediction`, a misfit with its gradient, or `FailedRun`."""
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
        self.recordings, self.workers, self.journal = tuple(recordings), workers, journal
        self.simulations = self.jacobians = self.gradients = self.steps = self.remembered = 0
        self._open, self._pool = ExitStack(), None
        self._own = sha256(
            repr((version("torchsoft"), digest(*ENGINE), [r.fingerprint for r in recordings])).encode()
        ).digest()

    def __enter__(self) -> Self:
        if self.journal is not None:
            self.journal.mkdir(parents=True, exist_ok=True)
        if self.workers > 1:
            self._pool = self._open.enter_context(local_processes(self.workers, _prepare, self.recordings))
        else:
            _prepare(self.recordings)
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def run(self, jobs: Sequence[Job]) -> list[Any]:
        """Results in the order of the jobs: `Prediction`, misfit or `FailedRun`."""
        waiting: list[Any] = []
        for job in jobs:
            self._count(job)
            known = self._recall(job)
            if known is None:
                known = self._pool.submit(_run, job) if self._pool is not None else _run(job)
                if self._pool is None:
                    self._keep(job, known)
            waiting.append(known)
        out = []
        for job, result in zip(jobs, waiting):
            if isinstance(result, Future):
                result = result.result()
                self._keep(job, result)
            out.append(result)
        return out

    def _count(self, job: Job) -> None:
        if job.nuisance is not None:
            self.gradients += 1
        elif job.names:
            self.jacobians += 1
        else:
            self.simulations += 1

    def _file(self, job: Job) -> Path:
        assert self.journal is not None
        return self.journal / (sha256(self._own + repr(job).encode()).hexdigest()[:32] + ".pickle")

    def _recall(self, job: Job) -> Any:
        if self.journal is None or not (path := self._file(job)).exists():
            return None
        self.remembered += 1
        return pickle.loads(path.read_bytes())

    def _keep(self, job: Job, result: Any) -> None:
        if isinstance(result, Prediction):
            self.steps += result.steps
        if self.journal is not None:
            with replacing(self._file(job)) as partial:
                partial.write_bytes(pickle.dumps(result))


def forget(folder: Path) -> None:
    """Remove a checkpoint: its own files, and the folder if it holds nothing else."""
    for pattern in ("*.pickle", "*.partial"):
        for file in folder.glob(pattern):
            file.unlink(missing_ok=True)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
