"""The least-squares problem: recordings, sensors and unknowns; residuals in units of the sensors' noise."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.channels import MEASURED
from torchsoft.parameters import ORDERED
from torchsoft.physics.paper import NAMES
from torchsoft.sysid.prediction import FailedRun, Frozen, Prediction, read
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.unknowns import Coordinates, Sensor, Unknown
from torchsoft.sysid.workers import Job, Runner
from torchsoft.tables import line

StepsByName = float | Mapping[str, Frozen]
"""The steps of runs: a relative tolerance that chooses them, or frozen ones by recording."""


class Residuals(NamedTuple):
    """Residuals r (m,) over the sensors' noise, their Jacobian J (m, n) by the coordinates (zero where not free), and
    what was lost: recordings that could not be simulated, with the reason. With a loss r and J are infinite."""

    r: Array
    J: Array
    lost: dict[str, FailedRun]


def check_ends(coordinates: Coordinates, recordings: Sequence[Recording]) -> None:
    """Raises `ValueError` where the bounds of an unknown leave no rig: a disc that does not fit between the pads, say."""
    for c in coordinates.all:
        if c.kind != "parameter" or c.ratio_to or c.name not in NAMES or c.name in ORDERED:
            continue
        for recording in recordings:
            for field, value in (("low", c.low), ("high", c.high)):
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore")  # of a steep friction law, which a search may pass through
                        recording.settings.override({c.name: value})
                except ValueError as error:
                    raise ValueError(f"unknowns.{c.name}.{field} = {value:g} is impossible: {error}") from None


class Problem:
    """Which parameters explain these recordings?

    `recordings` have names of their own; `sensors` are the channels that count, with their noise; `unknowns` the parameters.
    Raises `ValueError` where these do not fit together.
    """

    def __init__(
        self, recordings: Sequence[Recording], sensors: dict[str, Sensor], unknowns: dict[str, Unknown]
    ) -> None:
        names = [recording.name for recording in recordings]
        if not recordings or len(set(names)) < len(names):
            raise ValueError(f"recordings need names of their own, but are called {names}")
        if not unknowns or all(u.fixed for u in unknowns.values()):
            raise ValueError("there is nothing to identify: no unknown is free")
        for channel in sensors:
            if channel not in MEASURED:
                raise ValueError(f"sensors: `{line(channel, 80)}` is not a channel; known: {', '.join(MEASURED)}")
            if not any(channel in recording.samples for recording in recordings):
                raise ValueError(f"sensors: no recording has samples of `{channel}`")
        for recording in recordings:
            if not set(sensors) & set(recording.samples):
                raise ValueError(f"recording `{recording.name}` has samples of none of the sensors {list(sensors)}")
        self.recordings, self.sensors, self.unknowns = tuple(recordings), sensors, unknowns
        self.coordinates = Coordinates(unknowns, sensors, names, recordings[0].parameters)
        check_ends(self.coordinates, recordings)
        self.interpolated = any(sensor.delay > 0 for sensor in sensors.values())

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(recording.name for recording in self.recordings)

    def samples(self, which: Sequence[str] | None = None) -> int:
        """Number of samples that count, in some recordings or in all."""
        return sum(
            len(t)
            for recording in self.recordings
            if which is None or recording.name in which
            for channel, (t, _) in recording.samples.items()
            if channel in self.sensors
        )

    @property
    def data_seconds(self) -> float:
        return sum(recording.duration for recording in self.recordings)

    def values(self, x: Array, k: int) -> dict[str, float]:
        """Values of the unknown parameters in recording number k."""
        recording = self.recordings[k]
        return self.coordinates.values(x, recording.name, recording.parameters)

    def jobs(
        self, x: Array, which: Sequence[str], steps: StepsByName, free: NDArray[np.bool_] | None, adjoint: bool = False
    ) -> list[Job]:
        """One run a recording; with `free` they are differentiated by the parameters that free coordinates (n,) move."""
        c, out = self.coordinates, []
        for k, recording in enumerate(self.recordings):
            if recording.name not in which:
                continue
            values, names = self.values(x, k), ()
            if free is not None:
                moved = (c.jacobian(x, recording.name, values)[:, free] != 0).any(1)
                names = tuple(name for name, moves in zip(c.names, moved) if moves)
            nuisance = None
            if adjoint:
                noise = {channel: sensor.noise for channel, sensor in self.sensors.items()}
                bias, delay = ({ch: c.nuisance(x, ch, kind)[0] for ch in noise} for kind in ("bias", "delay"))
                nuisance = noise, bias, delay
            mine = steps[recording.name] if isinstance(steps, Mapping) else steps
            out.append(Job(k, values, names, mine, self.interpolated, nuisance))
        return out

    def residuals(
        self, runner: Runner, x: Array, which: Sequence[str], steps: StepsByName, free: NDArray[np.bool_] | None = None
    ) -> Residuals:
        """Residuals of some recordings at x (n,); the Jacobian's columns of `free` coordinates. On frozen steps they are smooth
        in x."""
        jobs = self.jobs(x, which, steps, free)
        return self.gather(x, jobs, runner.run(jobs))

    def freeze(
        self, runner: Runner, x: Array, which: Sequence[str], rtol: float, free: NDArray[np.bool_] | None = None
    ) -> tuple[Residuals, dict[str, Frozen]]:
        """`residuals` by runs whose steps `rtol` chooses, and those steps by recording; none where one is lost."""
        jobs = self.jobs(x, which, rtol, free)
        runs = runner.run(jobs)
        at = self.gather(x, jobs, runs)
        names = [self.recordings[job.recording].name for job in jobs]
        return at, {} if at.lost else {name: Frozen(run.knots) for name, run in zip(names, runs)}

    def gather(self, x: Array, jobs: Sequence[Job], results: Sequence[Any]) -> Residuals:
        """Residuals at x (n,) from the results of its jobs."""
        lost = {
            self.recordings[job.recording].name: got for job, got in zip(jobs, results) if isinstance(got, FailedRun)
        }
        if lost:
            m = self.samples([self.recordings[job.recording].name for job in jobs])
            return Residuals(np.full(m, np.inf), np.full((m, len(x)), np.inf), lost)
        parts = [self._compare(x, job, got) for job, got in zip(jobs, results)]
        return Residuals(np.concatenate([r for r, _ in parts]), np.concatenate([J for _, J in parts]), {})

    def _compare(self, x: Array, job: Job, prediction: Prediction) -> tuple[Array, Array]:
        """Residuals and Jacobian of one recording."""
        c, recording = self.coordinates, self.recordings[job.recording]
        chain = c.jacobian(x, recording.name, job.values)[[c.names.index(name) for name in job.names]]
        rs, Js = [], []
        for channel, sensor in self.sensors.items():
            if channel not in recording.samples:
                continue
            (t, measured), (bias, at_bias) = recording.samples[channel], c.nuisance(x, channel, "bias")
            delay, at_delay = c.nuisance(x, channel, "delay")
            reading = read(prediction, channel, t, delay)
            J = np.zeros((len(t), len(x)))
            if reading.derivatives is not None:
                J += reading.derivatives @ chain
            if at_bias >= 0:
                J[:, at_bias] = c.all[at_bias].slope(x[at_bias])
            if at_delay >= 0:
                J[:, at_delay] = -reading.rates * c.all[at_delay].slope(x[at_delay])
            rs.append((reading.values + bias - measured) / sensor.noise)
            Js.append(J / sensor.noise)
        return np.concatenate(rs), np.concatenate(Js)

    def misfit(
        self, runner: Runner, x: Array, which: Sequence[str], steps: StepsByName, free: NDArray[np.bool_]
    ) -> tuple[float, Array, dict[str, FailedRun]]:
        """Half the sum of squares and its gradient (n,), by the discrete adjoint; infinite where a run is lost."""
        c, jobs = self.coordinates, self.jobs(x, which, steps, free, adjoint=True)
        total, gradient, lost = 0.0, np.zeros(len(x)), {}
        for job, got in zip(jobs, runner.run(jobs)):
            name = self.recordings[job.recording].name
            if isinstance(got, FailedRun):
                lost[name] = got
                continue
            rows = [c.names.index(n) for n in job.names]
            total, gradient = total + got.loss, gradient + got.parameters @ c.jacobian(x, name, job.values)[rows]
            for kind in ("bias", "delay"):
                for channel, slope in zip(self.sensors, getattr(got, kind)):
                    _, at = c.nuisance(x, channel, kind)
                    if at >= 0:
                        gradient[at] += slope * c.all[at].slope(x[at])
        if lost:
            return np.inf, np.full(len(x), np.nan), lost
        return total, np.where(free, gradient, 0.0), {}
