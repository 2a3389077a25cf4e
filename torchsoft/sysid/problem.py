"""The least-squares problem: recordings, sensors and unknowns; whitened residuals."""

import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import deepcopy
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from torchsoft.display import Shown, amount, suggestion
from torchsoft.physics.channels import Touch
from torchsoft.physics.validity import check_values
from torchsoft.sysid.assumptions import Suspect
from torchsoft.sysid.extensions import extensions
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.prediction import (
    FailedRun,
    Frozen,
    Prediction,
    Readout,
    readout,
    set_parameters,
)
from torchsoft.sysid.recording import Array, Mask, Recording, extended
from torchsoft.sysid.runs import Job, Runner
from torchsoft.sysid.unknowns import (
    Coordinates,
    Nuisance,
    Sensor,
    Unknown,
    by_channel,
    by_parameter,
    in_full,
)
from torchsoft.tables import line

StepsByName = float | Mapping[str, Frozen]
"""Steps of runs: a relative tolerance that chooses them, or frozen ones by recording."""

DENSE = 1e-5
"""Relative tolerance that chooses the steps of a density."""


class Residuals(NamedTuple):
    """Residuals r (m,) over the sensors' noise, whitened where its colour is known, then those of
    the priors; their Jacobian J (m, n) by the coordinates (zero where not free); failed runs by
    recording, and the frozen steps of the others. With a failed run, r and J are infinite, and
    there are no steps. |r|^2 / 2 is the negative log posterior density up to a constant."""

    r: Array
    J: Array
    failed: dict[str, FailedRun]
    steps: Mapping[str, Frozen] = MappingProxyType({})

    @property
    def reason(self) -> str:
        """Reason of the first failed run, empty if there is none."""
        return next((one.reason for one in self.failed.values()), "")

    @property
    def reasons(self) -> str:
        """Every failed run with its reason."""
        return "; ".join(f"`{name}`: {one.reason}" for name, one in self.failed.items())


def with_extensions(
    recordings: Sequence[Recording], unknowns: dict[str, Unknown]
) -> tuple[Sequence[Recording], dict[str, Unknown]]:
    """Recordings whose rigs are extended by the unknown parameters, and the unknowns, with default
    bounds for extensions."""
    added, out = [], dict(unknowns)
    for recording in recordings:
        known = extensions(recording.rig)
        mine = [name for name in unknowns if name in known]
        for name in mine:
            one, u = known[name], out[name]
            scale = "log" if one.low > 0 else "linear"
            given = {"nominal": one.neutral, "low": one.low, "high": one.high, "scale": scale}
            out[name] = u.model_copy(update=given | u.model_dump(exclude_unset=True))
        added.append(extended(recording, mine) if mine else recording)
    return added, out


def check_sensors(
    recordings: Sequence[Recording], sensors: Collection[str], sampled: Collection[str]
) -> None:
    """Raises `ValueError` for a sensor of no channel, or without samples, and for a recording
    without samples of any sensor."""
    touch = [Touch(recording.rig) for recording in recordings]
    known = dict.fromkeys(c for recording in recordings for c in recording.channels)
    for channel in sensors:
        felt = any(channel in one or channel in one.arrays for one in touch)
        if channel not in known and not felt:
            raise ValueError(
                f"sensors: `{line(channel, 80)}` is not a channel; "
                f"{suggestion(channel, known, 'known:')}"
            )
        if channel not in sampled:
            raise ValueError(f"sensors: no recording has samples of `{channel}`")
    for recording in recordings:
        if not set(sensors) & set(recording.samples):
            raise ValueError(
                f"recording `{recording.name}` has samples of none of the sensors {list(sensors)}"
            )


def check_ends(
    coordinates: Coordinates, recordings: Sequence[Recording], held: Collection[str]
) -> None:
    """Raises `ValueError` where a bound of an unknown that is not held makes the rig impossible."""
    for c in coordinates.all:
        if c.kind != "parameter" or c.ratio_to or c.label in held:
            continue
        for recording in recordings:
            if c.name in {*recording.rig.ordered, *recording.rig.ordered.values()}:
                continue
            for field, value in (("low", c.low), ("high", c.high)):
                ratios = {d.name: d.nominal for d in coordinates.all if d.ratio_to == c.name}
                along = {name: value * ratio for name, ratio in ratios.items()}
                try:
                    check_possible(recording, {c.name: value} | along)
                except ValueError as error:
                    raise ValueError(
                        f"unknowns.{c.name}.{field} = {value:g} is impossible: {error}"
                    ) from None


def check_possible(recording: Recording, values: Mapping[str, float]) -> None:
    """Raises `ValueError` for parameter values that make the rig impossible."""
    # of a steep friction law, through which a search may pass
    with warnings.catch_warnings(action="ignore"):
        rig = deepcopy(recording.rig)
        set_parameters(rig, values)
        check_values(rig)


DIFFERENCE = 0.1
"""Part of the amount of an alternative by which its column is differenced."""


class Reading(NamedTuple):
    """One channel of a run as read by its sensor: times (k,) [s], samples, expected readings with
    their derivatives (k, n) by the run's parameters and by nuisances; residuals r (k,) over the
    noise, not whitened, and their derivative by the expected readings."""

    channel: str
    t: Array
    measured: Array
    expected: Array
    slopes: Array | None
    by: dict[Nuisance, Array]
    r: Array
    weight: Array


class Problem(Shown):
    """The problem of finding the parameters that explain some recordings.

    `recordings` have distinct names; `sensors` are the channels that count, with their noise;
    `unknowns` are the parameters, `extensions` of the rigs included; `noise` is the colour of a
    channel's noise, white by default. Amounts of `alternatives` to the recordings are coordinates
    too; those whose labels are `held` are not free. Short names are taken here, and the problem and
    its results have the full ones. Raises `ValueError` where these do not fit together.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        sensors: dict[str, Sensor],
        unknowns: dict[str, Unknown],
        noise: Mapping[str, Autoregression] | None = None,
        alternatives: Sequence[Suspect] = (),
        held: Collection[str] = (),
    ) -> None:
        names = [recording.name for recording in recordings]
        sampled = {channel for recording in recordings for channel in recording.samples}
        rigs = [recording.rig for recording in recordings]
        sensors, unknowns = by_channel(rigs, sensors, sampled), by_parameter(rigs, unknowns)
        if not recordings or len(set(names)) < len(names):
            raise ValueError(f"recordings need names of their own, but are called {names}")
        check_sensors(recordings, sensors, sampled)
        recordings, unknowns = with_extensions(recordings, unknowns)
        unknowns = {
            name: u.model_copy(update={"fixed": True}) if name in held else u
            for name, u in unknowns.items()
        }
        self.recordings, self.sensors, self.unknowns = tuple(recordings), sensors, unknowns
        self.alternatives, self.held = {one.name: one for one in alternatives}, frozenset(held)
        amounts = {one.name: one.bounds for one in alternatives}
        self.coordinates = Coordinates(unknowns, sensors, recordings, amounts, held)
        if not self.coordinates.free.any():
            raise ValueError("there is nothing to identify: no unknown is free")
        check_ends(self.coordinates, recordings, held)
        self.interpolated = any(
            c.kind in ("delay", "inertia", "clock", "lag", "backlash") and not c.fixed
            for c in self.coordinates.all
        )
        self.noise = in_full(rigs, noise or {})
        for k in range(len(recordings)):
            self.readouts(self.coordinates.start, k)
        self.check_saturated()

    def check_saturated(self) -> None:
        """Raises `ValueError` for saturated samples with coloured noise, whose likelihood is
        intractable."""
        for recording, channel, sensor in self.measured():
            coloured = sensor.colour == "ar" or channel in self.noise
            if coloured and sensor.saturated(recording.samples[channel][1]).any():
                raise ValueError(
                    f"sensors.{channel}: in `{recording.name}` samples are at its `low` or `high`, "
                    'which cannot go together with noise of `colour = "ar"`; declare it "white", '
                    "or record within the range"
                )

    def with_noise(self, noise: Mapping[str, Autoregression]) -> "Problem":
        """The same problem with other noise, by channel."""
        return Problem(
            self.recordings,
            self.sensors,
            self.unknowns,
            noise,
            [*self.alternatives.values()],
            self.held,
        )

    def runner(self, like: Runner) -> Runner:
        """A runner for this problem, with the threads and the folder of another."""
        changes = {name: one.change for name, one in self.alternatives.items() if one.change}
        return like.of(self.recordings, changes)

    def amounts(self, x: Array) -> tuple[tuple[str, float], ...]:
        """Amounts [SI] of the alternatives at x (n,), by name, where they are not zero."""
        pairs = [
            (c.name, c.to_value(x[i]))
            for i, c in enumerate(self.coordinates.all)
            if c.kind == "alternative"
        ]
        return tuple((name, amount) for name, amount in pairs if amount != 0.0)

    def samples_at(self, x: Array, k: int) -> dict[str, tuple[Array, Array]]:
        """Samples of recording k, under the alternatives at x (n,)."""
        recording = self.recordings[k]
        for name, size in self.amounts(x):
            one = self.alternatives[name]
            if one.of_samples and one.change is not None:
                recording = one.change(recording, size) or recording
        return recording.samples

    def whitened(self, recording: Recording, channel: str, rows: Array) -> Array:
        """Rows (k,) or (k, n) of a channel's samples, whitened."""
        noise = self.noise.get(channel)
        return rows if noise is None else noise.whitener(recording.samples[channel][0]) @ rows

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        free = [one for one in self.coordinates.all if one.kind == "parameter" and not one.fixed]
        rows = [
            (one.label, f"{one.low:.4g} to {one.high:.4g}, from {one.nominal:.4g}") for one in free
        ]
        rows += [
            (name, f"measured to {amount(one.noise, self.unit(name))}")
            for name, one in self.sensors.items()
        ]
        return f"Problem: {len(free)} unknowns, recordings {', '.join(self.names)}", rows

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(recording.name for recording in self.recordings)

    def measured(
        self, which: Collection[str] | None = None
    ) -> Iterator[tuple[Recording, str, Sensor]]:
        """Recordings, by default all, with each channel that counts and its sensor, in the order of
        residuals."""
        for recording in self.recordings:
            if which is None or recording.name in which:
                for channel, sensor in self.sensors.items():
                    if channel in recording.samples:
                        yield recording, channel, sensor

    def samples(self, which: Collection[str] | None = None) -> int:
        """Number of samples that count in some recordings, by default all."""
        return sum(len(one.samples[channel][0]) for one, channel, _ in self.measured(which))

    def values(self, x: Array, k: int) -> dict[str, float]:
        """Values of the unknowns of the rig and of the start in recording k."""
        recording = self.recordings[k]
        return self.coordinates.values(x, recording.name, recording.parameters)

    def readouts(self, x: Array, k: int) -> dict[str, Readout]:
        """Readouts of the sensors with samples in recording k, at x (n,)."""
        recording, out = self.recordings[k], {}
        for _, channel, sensor in self.measured([recording.name]):
            at = self.coordinates.nuisances(x, channel, recording.name)
            values: dict[Nuisance, float] = {kind: value for kind, (value, _) in at.items()}
            out[channel] = readout(recording, channel, sensor, values)
        return out

    def unit(self, channel: str) -> str:
        """SI unit of a channel that a sensor measures."""
        return next(r.units[channel] for r in self.recordings if channel in r.units)

    def jobs(
        self,
        x: Array,
        which: Sequence[str],
        steps: StepsByName,
        free: Mask | None,
    ) -> list[Job]:
        """One run for each recording; with `free`, differentiated by the parameters that depend on
        free coordinates (n,)."""
        c, out, changes = self.coordinates, [], self.amounts(x)
        for k, recording in enumerate(self.recordings):
            if recording.name not in which:
                continue
            values, names = self.values(x, k), ()
            if free is not None:
                moved = (c.jacobian(x, recording.name, values)[:, free] != 0).any(1)
                names = tuple(name for name, moves in zip(c.names, moved) if moves)
            mine = steps[recording.name] if isinstance(steps, Mapping) else steps
            out.append(Job(k, values, names, mine, self.interpolated, changes))
        return out

    def residuals(
        self,
        runner: Runner,
        x: Array,
        which: Sequence[str],
        steps: StepsByName,
        free: Mask | None = None,
    ) -> Residuals:
        """Residuals of some recordings at x (n,), with the Jacobian's columns of `free`
        coordinates, and the steps of their runs, on which residuals are smooth in x.

        Columns of alternatives are differences of two runs. Runs of changed recordings choose their
        own steps, and both runs take those of the first.
        """
        jobs = self.jobs(x, which, steps, free)
        if not isinstance(steps, Mapping) and self.amounts(x):
            plain = self.jobs(x, which, steps, None)
            first = self.gather(x, plain, runner.run(plain))
            if first.failed:
                return first
            jobs = self.jobs(x, which, first.steps, free)
        at = self.gather(x, jobs, runner.run(jobs))
        if free is None or at.failed:
            return at
        for i in np.flatnonzero(free):
            one = self.coordinates.all[i]
            if one.kind == "alternative":
                step = DIFFERENCE * self.alternatives[one.name].step / (one.high - one.low)
                moved = x + step * np.eye(len(x))[i]
                there = self.residuals(runner, moved, which, at.steps)
                if there.failed:
                    return there._replace(J=np.full_like(at.J, np.inf))
                at.J[:, i] = (there.r - at.r) / step
        return at

    def gather(self, x: Array, jobs: Sequence[Job], results: Sequence[Any]) -> Residuals:
        """Residuals at x (n,) from the results of jobs."""
        named = {self.recordings[job.recording].name: got for job, got in zip(jobs, results)}
        if failed := {k: got for k, got in named.items() if isinstance(got, FailedRun)}:
            m = self.samples([*named]) + len(self.coordinates.priors)
            return Residuals(np.full(m, np.inf), np.full((m, len(x)), np.inf), failed)
        parts = [self._compare(x, job, got) for job, got in zip(jobs, results)]
        r, J = (np.concatenate(some) for some in zip(*parts, self._priors(x)))
        steps = {
            name: job.steps if isinstance(job.steps, Frozen) else Frozen(got.knots)
            for job, (name, got) in zip(jobs, named.items())
        }
        return Residuals(r, J, {}, steps)

    def _priors(self, x: Array) -> tuple[Array, Array]:
        """Residuals of the priors, and their Jacobian."""
        c = self.coordinates
        r, J = np.zeros(len(c.priors)), np.zeros((len(c.priors), len(x)))
        for row, (i, prior) in enumerate(c.priors):
            r[row], slope = prior.row(c.all[i].to_value(x[i]))
            J[row, i] = slope * c.all[i].slope(x[i])
        return r, J

    def _compare(self, x: Array, job: Job, prediction: Prediction) -> tuple[Array, Array]:
        """Residuals and Jacobian of one recording."""
        c, recording, rs, Js = self.coordinates, self.recordings[job.recording], [], []
        chain = c.jacobian(x, recording.name, job.values)[
            [c.names.index(name) for name in job.names]
        ]
        for one in self.readings(x, job, prediction):
            J = np.zeros((len(one.t), len(x)))
            if one.slopes is not None:
                J += one.slopes @ chain
            for kind, (_, at) in c.nuisances(x, one.channel, recording.name).items():
                J[:, at] = one.by[kind] * c.all[at].slope(x[at])
            rs.append(self.whitened(recording, one.channel, one.r))
            Js.append(self.whitened(recording, one.channel, one.weight[:, None] * J))
        return np.concatenate(rs), np.concatenate(Js)

    def readings(self, x: Array, job: Job, run: Prediction) -> Iterator[Reading]:
        """Readings of the sensors in a job's recording at x (n,)."""
        samples = self.samples_at(x, job.recording)
        for channel, one in self.readouts(x, job.recording).items():
            t, measured = samples[channel]
            y, slopes, by = one.expected(run, t)
            yield Reading(channel, t, measured, y, slopes, by, *one.residuals(y, measured))

    def log_density(
        self, x: Array, steps: StepsByName = DENSE, runner: Runner | None = None
    ) -> float:
        """Logarithm of the posterior density of the coordinates x (n,), up to a constant: that of
        the samples and of the priors. Coordinates without a prior are uniform within their bounds.

        The same frozen `steps` at every x make it smooth. Minus infinity beyond the bounds, and
        where a run fails.
        """
        return self._log_density(x, steps, runner, None)[0]

    def log_density_and_gradient(
        self, x: Array, steps: StepsByName = DENSE, runner: Runner | None = None
    ) -> tuple[float, Array]:
        """The `log_density` at x (n,), and its exact gradient (n,) with respect to the free
        coordinates: zero for the others, NaN where the density is zero."""
        return self._log_density(x, steps, runner, self.coordinates.free)

    def _log_density(
        self, x: Array, steps: StepsByName, runner: Runner | None, free: Mask | None
    ) -> tuple[float, Array]:
        (low, high), nowhere = self.coordinates.bounds, (-np.inf, np.full(len(x), np.nan))
        if (x < low).any() or (x > high).any():
            return nowhere
        which = list(steps) if isinstance(steps, Mapping) else self.names
        at = self.residuals(runner or Runner(self.recordings), x, which, steps, free)
        if at.failed:
            return nowhere
        volume, by = self.coordinates.log_prior_volume(x)
        value, gradient = volume - 0.5 * float(at.r @ at.r), by - at.J.T @ at.r
        return value, gradient if free is None else np.where(free, gradient, 0.0)
