"""Motions of a rig file as functions of time: set-points of loops, feed-forward efforts and driven
coordinates."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from torchsoft import csvfile
from torchsoft.csvfile import UNITS
from torchsoft.physics.motion import FADE, PERIODS, Piecewise, Profile, Sampled, Waves, wave
from torchsoft.quantity import Quantity, Time
from torchsoft.rigs.fields import Group, NumberOr
from torchsoft.tables import LISTED, SEED, line, shown

START = "start"
"""The word for the initial value of the coordinate that follows a motion."""

HELD = "held"
"""The word for the feed-forward effort that holds a coordinate in place."""

TURNS, TURNS_PART = 10, 0.05
"""Fewest turns between rest and jump of a column that was digitised, and their part of its rows."""

ROUNDED = 0.01
"""Largest distance of such a jump from a multiple of the step, over the step."""

STROKES = 10_000
"""Most strokes of one motion."""

Value = Annotated[float | str, NumberOr("m, rad, N or N.m", START, HELD)]

Times = Annotated[tuple[Time, ...], LISTED, Field(min_length=1, max_length=100_000)]
Values = Annotated[tuple[Value, ...], LISTED, Field(min_length=1, max_length=100_000)]

Frequency = Annotated[float, Quantity("Hz", 1e-6, 1e5)]


class MotionContext(NamedTuple):
    """Context of a motion: its name and unit; the initial value () of the one free coordinate that
    follows it (None if there is none); the effort (), at a time [s], that holds the one coordinate
    to which it is fed forward (None if there is none); the end of the run [s]; and the folder of
    the rig file."""

    name: str
    unit: str
    start: Tensor | None
    held: Callable[[float], Tensor] | None
    end: float
    folder: Path

    def value(self, field: str, value: float | str, time: float = 0.0) -> Any:
        """The number of a field, which may be the word "start", or "held" at a time [s]: a tensor
        then, with its graph. Raises `ValueError`."""
        if not isinstance(value, str):
            return value
        if value == HELD:
            if self.held is None:
                raise ValueError(
                    f'motion.{self.name}.{field}: "{HELD}" stands for the effort that holds the '
                    "one coordinate that it is fed forward to, and there is none such here; give a "
                    "number"
                )
            return self.held(time)
        if self.start is None:
            raise ValueError(
                f'motion.{self.name}.{field}: "{START}" stands for where the one free coordinate '
                "that follows a motion as its "
                "set-point starts, and there is none such here; give a number"
            )
        return self.start


class Motion(Group):
    """A function of time, in m or rad where a coordinate follows it, in N or N.m where it is fed
    forward."""

    def build(self, context: MotionContext) -> Piecewise:
        """The signal. Raises `ValueError` naming the field."""
        raise NotImplementedError

    def fastest(self) -> float:
        """Highest frequency [Hz], 0 for motions without waves."""
        return 0.0

    @property
    def words(self) -> tuple[Any, ...]:
        """The offset, and the values at the knots, as they are given."""
        values = (self.value,) if isinstance(self, HoldTable) else getattr(self, "values", (0.0,))
        return getattr(self, "offset", 0.0), *values

    @property
    def follows_start(self) -> bool:
        """Whether a value is given as "start" or "held"."""
        return any(isinstance(x, str) for x in self.words)

    @property
    def start_weights(self) -> list[float]:
        """Derivatives (k,), or (1,) for all alike, of the values with respect to the start."""
        offset, *values = self.words
        return [float(offset == START) + float(x == START) for x in values]


class HoldTable(Motion):
    """Stays where it is."""

    kind: Literal["hold"] = "hold"
    value: Value = Field(
        default=START, description=f'"{START}": initial value of the coordinate that follows'
    )

    def build(self, context: MotionContext) -> Piecewise:
        return Profile([0.0], [context.value("value", self.value)])


class Knots(Motion):
    """Values at given times."""

    times: Times = Field(description="increasing times; values are constant before and after [s]")
    values: Values = Field(
        description=f'one per time; "{START}": initial value of the coordinate that follows; '
        f'"{HELD}", of efforts fed forward: the static effort, without friction, that holds the '
        "coordinate at the set-points of that time"
    )
    offset: Value = Field(
        default=0.0,
        description=f'added to all values; "{START}": initial value of the coordinate that follows',
    )

    @model_validator(mode="after")
    def _are_pairs(self) -> Self:
        if len(self.times) != len(self.values):
            raise ValueError(
                f"times has {len(self.times)} numbers, but values {len(self.values)}; give one "
                "value per time"
            )
        for before, after in pairwise(self.times):
            if after <= before:
                raise ValueError(
                    f"times must increase, but {after:g} s follows {before:g} s; let a jump take a "
                    "millisecond"
                )
        return self

    def knots(self, context: MotionContext) -> tuple[list[float], list[Any]]:
        """Times, and values as numbers or tensors."""
        offset = context.value("offset", self.offset)
        known = zip(self.values, self.times)
        return list(self.times), [offset + context.value("values", *one) for one in known]


class ProfileTable(Knots):
    """From value to value along polynomials of 7th order, at rest at each."""

    kind: Literal["profile"] = "profile"

    def build(self, context: MotionContext) -> Piecewise:
        return Profile(*self.knots(context))


class StrokesTable(Motion):
    """There and back, from `since` to `until`, along polynomials of 7th order, at rest at each
    end."""

    kind: Literal["strokes"] = "strokes"
    travel: Annotated[float, Quantity("m, rad, N or N.m", -1e6, 1e6)] = Field(
        description="length of a stroke, with its sign"
    )
    stroke_time: Time = Field(description="duration of one stroke", gt=0)
    offset: Value = Field(
        default=START,
        description=f'value at the near end; "{START}": initial value of the coordinate',
    )
    since: Time = Field(default=0.0, description="start of the first stroke")
    until: Time | None = Field(
        default=None, description="end of the last stroke; the end of the run if not given"
    )

    def build(self, context: MotionContext) -> Piecewise:
        until = context.end if self.until is None else self.until
        count = int((until - self.since) / self.stroke_time + 1e-9)
        if not 1 <= count <= STROKES:
            raise ValueError(
                f"motion.{context.name}.stroke_time = {self.stroke_time:g} s makes {count} strokes "
                f"from {self.since:g} to {until:g} s, but a motion has 1 to {STROKES}; take another"
            )
        near = context.value("offset", self.offset)
        times = [self.since + i * self.stroke_time for i in range(count + 1)]
        return Profile(times, [near + i % 2 * self.travel for i in range(count + 1)])


class SplineTable(Knots):
    """A cubic spline through the values, at rest at the first and the last."""

    kind: Literal["spline"] = "spline"

    def build(self, context: MotionContext) -> Piecewise:
        times, values = self.knots(context)
        return Sampled(times, values, clamped=True) if len(times) > 1 else Profile(times, values)


class ModulatedMotion(Knots):
    """Waves on top of a profile, from `since` to `until`, where they come and go."""

    times: Times = Field(
        default=(0.0,), description="times of the profile that the waves are added to [s]"
    )
    values: Values = Field(
        default=(START,),
        description=f'values of it; "{START}": initial value of the coordinate that follows',
    )
    since: Time = Field(default=0.0, description="start of the waves, which fade in over 0.15 s")
    until: Time | None = Field(
        default=None,
        description="end of the waves, which fade out over 0.15 s; the end of the run if not given",
    )

    def window(self, context: MotionContext) -> tuple[float, float]:
        """Begin and end [s] of the waves. Raises `ValueError`."""
        until = context.end if self.until is None else self.until
        if not until - self.since > 2 * FADE:
            raise ValueError(
                f"motion.{context.name}.since = {self.since:g} s leaves {until - self.since:g} s "
                f"until {until:g} s, but waves take {2 * FADE:g} s to come and go"
            )
        if self.fastest() * (until - self.since) > PERIODS:
            raise ValueError(
                f"motion.{context.name} has more than {PERIODS:g} periods; take a lower frequency "
                "or a shorter time"
            )
        return self.since, until


class ComponentTable(Group):
    """One sine."""

    amplitude: Annotated[float, Quantity("m, rad, N or N.m", -1e6, 1e6)] = Field(
        description="amplitude"
    )
    frequency: Frequency = Field(description="frequency")
    phase: Annotated[float, Quantity("rad", -1e3, 1e3)] = Field(default=0.0, description="phase")


class SinesTable(ModulatedMotion):
    """Sines on top of a profile."""

    kind: Literal["sines"] = "sines"
    components: Annotated[
        tuple[ComponentTable, ...], LISTED, Field(min_length=1, max_length=100)
    ] = Field(description="amplitude, frequency [Hz] and phase [rad] of each sine")

    def fastest(self) -> float:
        return max(one.frequency for one in self.components)

    def build(self, context: MotionContext) -> Piecewise:
        columns = np.array(
            [(one.amplitude, one.frequency, 0.0, one.phase) for one in self.components]
        ).T
        return Waves(self.knots(context), *self.window(context), wave(*columns))


class MultiSineTable(ModulatedMotion):
    """Sines on top of a profile, one in each part of a band of frequencies; their phases, and their
    places in the parts, are random."""

    kind: Literal["multi_sine"] = "multi_sine"
    amplitude: Annotated[float, Quantity("m, rad, N or N.m", -1e6, 1e6)] = Field(
        description="largest amplitude of the sum"
    )
    band: Annotated[tuple[Frequency, Frequency], LISTED] = Field(
        description="lowest and highest frequency [Hz]"
    )
    components: Annotated[int, Field(ge=1, le=100)] = Field(
        default=5, description="number of sines"
    )
    seed: Annotated[int, Field(ge=0, le=SEED)] = Field(
        default=0, description="seed of phases and frequencies"
    )

    def fastest(self) -> float:
        return max(self.band)

    def build(self, context: MotionContext) -> Piecewise:
        rng, n = np.random.default_rng(self.seed), self.components
        low, high = np.log(self.band)
        frequency = np.exp(low + (np.arange(n) + rng.random(n)) / n * (high - low))
        phase = rng.uniform(0, 2 * np.pi, n)
        waves = wave(np.full(n, self.amplitude / n), frequency, np.zeros(n), phase)
        return Waves(self.knots(context), *self.window(context), waves)


class ChirpTable(ModulatedMotion):
    """A sine on top of a profile, its frequency going from `first` to `last`."""

    kind: Literal["chirp"] = "chirp"
    amplitude: Annotated[float, Quantity("m, rad, N or N.m", -1e6, 1e6)] = Field(
        description="amplitude"
    )
    first: Frequency = Field(description="initial frequency")
    last: Frequency = Field(description="final frequency")

    def fastest(self) -> float:
        return max(self.first, self.last)

    def build(self, context: MotionContext) -> Piecewise:
        since, until = self.window(context)
        sweep = (self.last - self.first) / (until - since)
        return Waves(
            self.knots(context), since, until, wave(self.amplitude, self.first, sweep, 0.0)
        )


class CsvTable(Motion):
    """A recorded motion: a cubic spline through a column of a table, with units in its heading:
    `t [s], x_d [mm]`."""

    kind: Literal["csv"] = "csv"
    file: str = Field(description="the file, from the folder of this one")
    column: str = Field(description="the column's name, without its unit")
    time: str = Field(default="t", description="the name of the column of times, without its unit")
    from_first: bool = Field(
        default=False, description="true: the first row has time zero, as for the times of a clock"
    )
    scale: Annotated[float, Quantity("1", -1e6, 1e6)] = Field(
        default=1.0, description="factor of the column; -1 reverses its sign"
    )
    offset: Value = Field(
        default=0.0,
        description=f'added after scaling; "{START}": initial value of the coordinate that follows',
    )

    def build(self, context: MotionContext) -> Piecewise:
        if self.scale == 0:
            raise ValueError(f"motion.{context.name}.scale: it must not be zero")
        try:
            path = context.folder / self.file
            times, values = read_column(path, self.column, context.unit, self.time)
        except ValueError as error:
            raise ValueError(f"motion.{context.name}.file: {error}") from None
        offset = context.value("offset", self.offset)
        since = times[0] if self.from_first else 0.0
        at, measured = torch.tensor([times, values], dtype=torch.float64)
        return Sampled(at - since, offset + self.scale * measured)


def quantum(values: np.ndarray) -> float:
    """The step in which values (k,) were digitised, as by an encoder: they rest and jump by it in
    turn; zero where they do not."""
    jumps = np.abs(np.diff(values))
    rests = jumps == 0
    turns = int((rests[1:] != rests[:-1]).sum())
    if turns < max(TURNS, TURNS_PART * len(jumps)):
        return 0.0
    step = float(jumps[~rests].min())
    return step if (np.abs(jumps / step - np.rint(jumps / step)) < ROUNDED).all() else 0.0


def read_column(
    path: Path, column: str, unit: str, time: str = "t"
) -> tuple[list[float], list[float]]:
    """Times [s], from the column `time`, and values, in SI units, from a column in `unit` or one
    that converts to it. Raises `ValueError` naming the file, the row (the heading is row 1) and the
    column."""
    known = {time: UNITS["s"], column: UNITS[unit]}
    try:
        table = csvfile.read(path, known, lambda *_: "", None)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    for name in (time, column):
        if name not in table.values:
            there = [*table.values, *table.ignored]
            shown = ", ".join(f"`{line(one, 40)}`" for one in there) or "nothing"
            raise ValueError(
                f"{path} has no column `{name} [{'s' if name == time else unit}]`, in this "
                f"unit or one like it; it has {shown}; name the right one in "
                f"`{'time' if name == time else 'column'}`"
            )
    times, values = table.values[time], table.values[column]
    if len(times) < 2:
        raise ValueError(
            f"{path} has {len(times)} rows of numbers, but a motion needs two at least"
        )
    csvfile.check_complete(path, table, time)
    return times.tolist(), values.tolist()


MotionTable = Annotated[
    HoldTable
    | ProfileTable
    | StrokesTable
    | SplineTable
    | SinesTable
    | MultiSineTable
    | ChirpTable
    | CsvTable,
    Field(discriminator="kind"),
]


def flattened(motion: object, within: str = "") -> object:
    """Motions by their full names, from TOML's nested tables: [motion.upper.y] is the motion of the
    coordinate "upper.y"."""
    if not isinstance(motion, dict):
        return motion
    out: dict[str, object] = {}
    for key, value in motion.items():
        name = f"{within}.{key}" if within else str(key)
        inner = flattened(value, name) if is_nest(value) else {name: value}
        assert isinstance(inner, dict)
        for one, table in inner.items():
            if one in out:
                raise ValueError(f"motion.{shown(one)} is there twice")
            out[one] = table
    return out


def is_nest(value: object) -> bool:
    """Whether a table holds motions and is not one itself."""
    return (
        isinstance(value, dict)
        and "kind" not in value
        and bool(value)
        and all(isinstance(x, dict) for x in value.values())
    )
