"""Runs of the model in threads, and their results on disk.

A fit is a deterministic function of its runs: started again, it reads the stored results, to the
bit, and continues. Results are data with checksums in a marked folder; a damaged file, or one of
another run, is made again.
"""

import io
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.cost import rig_step, steps_per_second
from torchsoft.files import (
    CHECKPOINT,
    SEALED,
    check_file,
    make_folder,
    remove_partials,
    replacing,
    save_text,
)
from torchsoft.parallel import parallel_map, single_threaded
from torchsoft.solve.kernel.objects import digest
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.prediction import (
    FailedRun,
    Frozen,
    Prediction,
    Steps,
    initial_state,
    predict,
)
from torchsoft.sysid.recording import Recording, RunContext

MEANING = (
    "Runs of an identification that is not done; torchsoft removes the .run files in this folder "
    "when it is.\n"
)

RUN = re.compile(r"[0-9a-f]{64}\.run")
"""Names of files with results."""

KINDS = {kind.__name__: kind for kind in (Prediction, FailedRun)}
"""Types of results of a run."""

PROGRAM = (
    digest(Path(__file__).parents[1]),
    *(version(name) for name in ("torchsoft", "torch", "numpy", "scipy", "llvmlite")),
)
"""Digest of the source, and versions of the packages, that determine a run besides its data."""


def encoded(result: Any) -> bytes:
    """A result as numpy's archive of its fields, without None."""
    fields = {
        name: np.asarray(value) for name, value in result._asdict().items() if value is not None
    }
    archive = io.BytesIO()
    contents: Any = {"kind": np.asarray(type(result).__name__)} | fields
    np.savez(archive, **contents)
    return archive.getvalue()


def decoded(content: bytes) -> Any:
    """The result from its archive, to the bit."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        fields = {
            name: archive[name] if archive[name].ndim else archive[name].item()
            for name in archive.files
        }
    kind: Any = KINDS[fields.pop("kind")]
    return kind(**fields)


class Journal:
    """Results of runs of some recordings in a folder, by run; a run is any object with a complete
    `repr`.

    Raises `ValueError` for a folder that holds anything else.
    """

    def __init__(self, folder: Path, recordings: Sequence[Recording]) -> None:
        self.folder, self._warned = folder, False
        self._own = repr((PROGRAM, [recording.fingerprint for recording in recordings]))
        self._open()

    def _open(self) -> None:
        """Make the folder, and mark it as a journal."""
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(
                f"the checkpoint {self.folder} is a file; give a new or an empty folder"
            )
        make_folder(self.folder)
        if not (self.folder / CHECKPOINT).is_file():
            if any(self.folder.iterdir()):
                raise ValueError(
                    f"the checkpoint {self.folder} holds other files; give a new or an empty folder"
                )
            save_text(self.folder / CHECKPOINT, MEANING)

    def _place(self, run: object) -> tuple[bytes, Path]:
        """Prefix of the checksum of a run's file, and the file."""
        name = sha256((self._own + repr(run)).encode())
        return name.digest(), self.folder / f"{name.hexdigest()}.run"

    def recall(self, run: object) -> Any:
        """The result of a run; None where it is missing or damaged."""
        name, path = self._place(run)
        if not path.is_file():
            return None
        try:
            content = check_file(path, SEALED).read_bytes()
            if content[:32] == sha256(name + content[32:]).digest():
                return decoded(content[32:])
        except Exception:  # a reader meets a forged archive in a hundred ways
            pass
        if not self._warned:
            warn(
                f"the checkpoint {self.folder} holds damaged results, whose runs are made again",
            )
            self._warned = True
        return None

    def keep(self, run: object, result: Any) -> None:
        """Write the result of a run."""
        name, path = self._place(run)
        content = encoded(result)
        if not (
            self.folder / CHECKPOINT
        ).is_file():  # another identification was done with the folder
            self._open()
        with replacing(path, durable=True) as partial:
            partial.write_bytes(sha256(name + content).digest() + content)


def forget(folder: Path) -> None:
    """Remove a journal's own files, and the folder if it holds nothing else; other folders are left
    alone."""
    if not (folder / CHECKPOINT).is_file():
        return
    for path in folder.iterdir():
        if RUN.fullmatch(path.name) and path.is_file():
            path.unlink(missing_ok=True)
    remove_partials(path for path in folder.glob("*.partial") if RUN.match(path.name))
    if [path.name for path in folder.iterdir()] == [CHECKPOINT]:
        (folder / CHECKPOINT).unlink(missing_ok=True)
        folder.rmdir()


# Runs in threads


class Job(NamedTuple):
    """One run: index of the recording, values of the unknowns, names to differentiate by, and
    steps.

    `interpolated` requests a grid between the samples; `changes` are amounts of changes of the
    recording, by name.
    """

    recording: int
    values: dict[str, float]
    names: tuple[str, ...]
    steps: Steps
    interpolated: bool = False
    changes: tuple[tuple[str, float], ...] = ()


Change = Callable[[Recording, float], Recording | None]
"""A recording changed by an amount [SI]; None where the change has no meaning for it."""


class Runner:
    """Runs jobs in `workers` threads (in this one, if it is one), and stores their results in the
    folder `journal`. `changes` of recordings are those that jobs name."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        workers: int = 1,
        journal: Path | None = None,
        changes: Mapping[str, Change] | None = None,
    ) -> None:
        if workers < 1:
            raise ValueError(f"`workers` must be positive, but is {workers}")
        self.changes = dict(changes or {})
        self.recordings, self.workers, self.folder = tuple(recordings), workers, journal
        self.simulations = self.jacobians = self.remembered = 0
        self._work = 0.0
        self._journal = Journal(journal, self.recordings) if journal is not None else None
        starts = {recording.start_fingerprint for recording in self.recordings}
        self._alike, self._lock = len(starts) < len(self.recordings), Lock()
        self._starts: dict[Any, tuple[Tensor, Tensor]] = {}
        self._idle: list[list[RunContext]] = [
            [] for _ in self.recordings
        ]  # models that no thread is using
        self._parent: Runner | None = None

    def of(
        self, recordings: Sequence[Recording], changes: Mapping[str, Change] | None = None
    ) -> "Runner":
        """A runner for other recordings, with the same number of threads and the same folder; what
        it runs counts here too."""
        out = Runner(recordings, self.workers, self.folder, changes)
        out._parent = self
        return out

    def run(self, jobs: Sequence[Job]) -> list[Any]:
        """Results in the order of the jobs: `Prediction` or `FailedRun`."""
        self._starts = {}
        out = [self._journal.recall(job) if self._journal is not None else None for job in jobs]
        remembered = [result is not None for result in out]
        todo = [i for i, result in enumerate(out) if result is None]
        todo.sort(key=lambda i: self._length(jobs[i]), reverse=True)  # the longest first
        with single_threaded():
            for i, result in parallel_map(
                lambda k: self._made(jobs[todo[k]]), len(todo), self.workers
            ):
                out[todo[i]] = result
        for job, result, known in zip(jobs, out, remembered):
            self._count(job, known, self._cost(job, result))
        return out

    @property
    def work(self) -> float:
        """Expected time [s] of all runs of this runner and of those that count here, and of the one
        that it counts for: the same in every repetition, remembered or not."""
        return self._work if self._parent is None else self._parent.work

    def _cost(self, job: Job, result: Any) -> float:
        """Expected time [s] of the steps of a run, on a usual machine."""
        knots = getattr(result, "knots", None)
        steps = self._length(job) if knots is None else len(knots) - 1
        step = getattr(result, "step", 0.0)
        return steps * (step or rig_step(self.recordings[job.recording].rig, len(job.names)))

    def _made(self, job: Job) -> Any:
        """Run a job and store its result, even if an interruption is pending."""
        if job.changes:
            result = self._changed(job)
        else:
            idle = self._idle[job.recording]
            try:
                context = idle.pop()
            except IndexError:
                context = self.recordings[job.recording].run_context()
            start = partial(self._start, context, job) if self._alike else None
            result = simulated(self.recordings[job.recording], context, job, start)
            idle.append(context)
        if self._journal is not None:
            self._journal.keep(job, result)
        return result

    def _changed(self, job: Job) -> Any:
        """Run a job of a changed recording."""
        stated = self.recordings[job.recording]
        recording: Recording | None = stated
        try:
            with warnings.catch_warnings(action="ignore"):  # such as of pads that creep for long
                for name, amount in job.changes:
                    recording = recording and self.changes[name](recording, amount)
                if recording is None:
                    raise ValueError(f"it has no meaning where recording `{stated.name}` starts")
                context = recording.run_context()
                steps = since(job.steps, recording.run_start)
                made = simulated(recording, context, job._replace(steps=steps))
        except ValueError as error:  # an impossible rig
            return FailedRun(str(error), 0.0)
        if isinstance(made, FailedRun) or recording.rig is stated.rig:
            return made
        return made._replace(step=rig_step(recording.rig, len(job.names)))

    def _start(self, context: RunContext, job: Job) -> tuple[Tensor, Tensor]:
        """The initial state of a run, computed once for recordings that begin alike."""
        key = self.recordings[job.recording].start_fingerprint, repr((job.values, job.names))
        with self._lock:
            if key not in self._starts:
                self._starts[key] = initial_state(context, job.values, job.names)
            return self._starts[key]

    def _length(self, job: Job) -> float:
        """Steps of a run [1], estimated where a tolerance chooses them."""
        if isinstance(job.steps, Frozen):
            return len(job.steps.knots) - 1
        return steps_per_second(job.steps) * self.recordings[job.recording].duration

    def _count(self, job: Job, remembered: bool, work: float) -> None:
        self._work += work
        self.remembered += remembered
        if job.names:
            self.jacobians += 1
        else:
            self.simulations += 1
        if self._parent is not None:
            self._parent._count(job, remembered, work)


EARLY = 2e-3
"""Steps [s] before frozen ones, or after them, where a run is longer than that of the fit."""


def since(steps: Steps, start: float) -> Steps:
    """The same steps for a run that starts at another time [s]."""
    if not isinstance(steps, Frozen) or start == steps.knots[0]:
        return steps
    knots = steps.knots
    early = np.arange(start, knots[0], EARLY) if start < knots[0] else np.array([start])
    return Frozen(np.concatenate((early, knots[knots > early[-1] + 1e-3 * EARLY])))


def simulated(
    recording: Recording,
    context: RunContext,
    job: Job,
    start: Callable[[], tuple[Tensor, Tensor]] | None = None,
) -> Any:
    """A `Prediction` or a `FailedRun`, with a rig that no other thread uses; `start` computes the
    initial state."""
    grid = recording.grid(job.interpolated)
    try:
        known = start() if start is not None else None
        return predict(context, job.values, grid, job.names, job.steps, known)
    except SimulationFailed as failure:
        return FailedRun(failure.reason, failure.time)
