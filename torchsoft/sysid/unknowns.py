"""Unknowns: parameters with bounds and scales, faults of sensors, and the vector of coordinates in
which fits move.

A coordinate is the logarithm of a value, or the value over the width of its bounds; so its standard
deviation is a relative one either way.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Self, TypeVar, get_args

import numpy as np
from pydantic import Field, model_validator

from torchsoft.display import suggestion
from torchsoft.physics.channels import Touch
from torchsoft.physics.rig import Rig
from torchsoft.sysid.initial_state import BOUNDS, PREFIX
from torchsoft.sysid.recording import REACH, Array, Mask, Recording
from torchsoft.tables import Table, line, shown

T = TypeVar("T")

SPREAD = 10.0
"""Default bounds of a logarithmic parameter: its nominal value divided and multiplied by this."""


Per = Literal["all", "recording"]
"""Whether one value holds for all recordings, or each has its own."""


class Prior(Table):
    """Prior distribution of a value: normal with standard deviation `sd` about the `median`, or
    "log-normal", where `sd` is that of the natural logarithm."""

    median: float
    """median of the prior [the unknown's unit]"""
    sd: float = Field(gt=0, le=1e12)
    """standard deviation of the value or, if log-normal, of its natural logarithm [the unknown's
    unit or 1]"""
    kind: Literal["normal", "log-normal"] = "normal"
    """distribution of the value"""

    @model_validator(mode="after")
    def _has_a_logarithm(self) -> Self:
        if self.kind == "log-normal" and self.median <= 0:
            raise ValueError(f"a log-normal prior needs median > 0, but it is {self.median}")
        return self

    def row(self, value: float) -> tuple[float, float]:
        """The residual (value - median) / sd, or that of logarithms, and its derivative by the
        value."""
        if self.kind == "log-normal":
            return math.log(value / self.median) / self.sd, 1 / (value * self.sd)
        return (value - self.median) / self.sd, 1 / self.sd


class Unknown(Table):
    """One parameter to identify, by its name in the rig or its alias, user-defined laws included.

    Bounds must lie within the parameter's own (`Rig.quantity`).
    """

    nominal: float | None = None
    """initial value of the search; that of the rig file if not given [the parameter's unit]"""
    low: float | None = None
    """lower bound; that of the parameter itself if not given [the parameter's unit]"""
    high: float | None = None
    """upper bound; that of the parameter itself if not given [the parameter's unit]"""
    scale: Literal["log", "linear"] = "log"
    """scale of the search; `linear` needs `low` and `high`, `log` needs positive values"""
    ratio_to: str | None = None
    """another parameter: value, bounds and prior are then ratios to it"""
    fixed: bool = False
    """true: hold the value at `nominal`; with `ratio_to`, hold the ratio"""
    per: Per = "all"
    """one value for all recordings, or one for each"""
    prior: Prior | None = None
    """prior distribution, which counts as one more measurement"""

    @model_validator(mode="after")
    def _bounds_are_ordered(self) -> Self:
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"low = {self.low} must be below high = {self.high}")
        if self.scale == "linear" and (self.low is None or self.high is None):
            raise ValueError("a linear scale needs `low` and `high`")
        for name in ("nominal", "low", "high"):
            value = getattr(self, name)
            if self.scale == "log" and value is not None and value <= 0:
                raise ValueError(f"a logarithmic scale needs {name} > 0, but it is {value}")
        if self.fixed and self.prior is not None:
            raise ValueError("a fixed unknown needs no prior")
        return self


Nuisance = Literal[
    "bias", "delay", "gain", "drift", "misalignment", "inertia", "clock", "lag", "backlash"
]
NUISANCES: tuple[Nuisance, ...] = get_args(Nuisance)
"""Faults of a sensor, in the order of a problem's coordinates."""


class Fault(NamedTuple):
    """A fault of a sensor: its unit, where {} is the channel's; if it is tested, the `clause` for
    it, the `amount` of a variation and the range of a new fit, which count in `scale`. One that
    `grows` does so along a recording; one that is `one_sided` is not negative."""

    unit: str
    clause: str = ""
    amount: float = 0.0
    most: float = 0.0
    grows: bool = False
    one_sided: bool = False

    def scale(self, sensor: "Sensor", duration: float) -> float:
        """The noise where the unit is the channel's, over a `duration` [s] where it grows."""
        return (sensor.noise if "{}" in self.unit else 1.0) / (duration if self.grows else 1.0)


FAULTS: dict[str, Fault] = {
    "bias": Fault("{}", "read too much", 0.1, 1e4),
    "delay": Fault("s", "came late", 1e-4, 0.02),
    "gain": Fault("1", "were too sensitive", 1e-3, 0.5),
    "drift": Fault("{}/s", "drifted upwards", 0.1, 1e4, grows=True),
    "misalignment": Fault("rad", "were turned", 1e-3, 0.2),
    "inertia": Fault("kg"),
    "clock": Fault("1", "ran too fast", 1e-4, 0.05, grows=True),
    "lag": Fault("s", "came through a low-pass", 1e-4, 0.05, one_sided=True),
    "backlash": Fault("{}", "had backlash", 0.1, 300.0, one_sided=True),
}
"""The faults of sensors; those with a clause are tested where they are not unknowns."""


class Sensor(Table):
    """A measured channel: its noise, the largest size of its faults, and its range.

    A fault of size zero is left out; others are identified. A saturated sample states only that
    value plus noise is at that end of the range or beyond (Tobin's likelihood); the noise must be
    white then.
    """

    noise: float = Field(ge=1e-15, le=1e6)
    """standard deviation of the noise [the channel's unit]"""
    bias: float = Field(default=0.0, ge=0, le=1e6)
    """largest constant offset [the channel's unit]"""
    delay: float = Field(default=0.0, ge=0, le=REACH)
    """largest delay [s]"""
    gain: float = Field(default=0.0, ge=0, le=0.5)
    """largest relative error of the gain [1]"""
    drift: float = Field(default=0.0, ge=0, le=1e6)
    """largest drift, counted from the middle of the recording [the channel's unit/s]"""
    misalignment: float = Field(default=0.0, ge=0, le=0.5)
    """largest rotation of the sensor about the axis out of the plane [rad]"""
    inertia: float = Field(default=0.0, ge=0, le=1e5)
    """largest mass between a force sensor and the body that it pushes; the sensor does not measure
    the force that accelerates it [kg]"""
    clock: float = Field(default=0.0, ge=0, le=0.1)
    """largest relative error of the sensor's clock, counted from the middle of the recording [1]"""
    lag: float = Field(default=0.0, ge=0, le=REACH)
    """largest time constant of a first-order low-pass filter, in equilibrium at the first sample
    [s]"""
    backlash: float = Field(default=0.0, ge=0, le=1e6)
    """largest width of a backlash, centred at the first sample [the channel's unit]"""
    resolution: float = Field(default=0.0, ge=0, le=1e6)
    """step of the readings; adds a variance of its square over twelve [the channel's unit]"""
    per: Per = "all"
    """one value of each fault for all recordings, or one for each"""
    low: float | None = None
    """lower end of the range; samples at or below it are saturated [the channel's unit]"""
    high: float | None = None
    """upper end of the range; samples at or above it are saturated [the channel's unit]"""
    colour: Literal["white", "ar"] = "white"
    """"white" for independent noise; "ar" for an autoregression with estimated coefficients"""

    @model_validator(mode="after")
    def _has_a_range(self) -> Self:
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"low = {self.low} must be below high = {self.high}")
        return self

    @property
    def sd(self) -> float:
        """Standard deviation [unit] of noise and quantisation together."""
        return math.hypot(self.noise, self.resolution / math.sqrt(12))

    def saturated(self, y: Array) -> Mask:
        """Mask of samples y (k,) [unit] at an end of the range or beyond."""
        low, high = (
            -math.inf if self.low is None else self.low,
            math.inf if self.high is None else self.high,
        )
        return (y <= low) | (y >= high)

    @property
    def nuisances(self) -> dict[Nuisance, tuple[float, float, float]]:
        """Least, nominal and largest value of each fault to identify."""
        out: dict[Nuisance, tuple[float, float, float]] = {}
        for kind in NUISANCES:
            nominal, reach = float(kind == "gain"), float(getattr(self, kind))
            if nominal + reach > nominal:
                least = 0.0 if FAULTS[kind].one_sided else nominal - reach
                out[kind] = least, nominal, nominal + reach
        return out


def in_full(rigs: Sequence[Rig], given: Mapping[str, T]) -> dict[str, T]:
    """Entries by the full names of the rigs' parameters and channels.

    Raises `ValueError` for two entries of one name, and for a short name of two meanings.
    """
    out, origin = dict[str, T](), dict[str, str]()
    for name, one in given.items():
        meanings = sorted({rig.short[name] for rig in rigs if name in rig.short})
        if len(meanings) > 1:
            raise ValueError(
                f"`{name}` is short for {' and '.join(meanings)} in different rigs; give the full "
                "name"
            )
        (full,) = meanings or [name]
        if full in out:
            raise ValueError(f"`{name}` and `{origin[full]}` are one, given twice; leave out one")
        out[full], origin[full] = one, name
    return out


def by_parameter(rigs: Sequence[Rig], unknowns: Mapping[str, Unknown]) -> dict[str, Unknown]:
    """Unknowns by the full names of the rigs' parameters."""
    out = in_full(rigs, unknowns)
    for name, one in out.items():
        if one.ratio_to is not None:
            (base,) = in_full(rigs, {one.ratio_to: one})
            out[name] = one.model_copy(update={"ratio_to": base})
    return out


def by_channel(
    rigs: Sequence[Rig], sensors: Mapping[str, Sensor], sampled: Collection[str] | None = None
) -> dict[str, Sensor]:
    """Sensors by the full names of channels. A sensor named after an array of touch of the rigs,
    such as "skin.normal", stands for each of its channels (of those `sampled`, if given) without a
    sensor of its own."""
    arrays = {name: size for rig in rigs for name, size in Touch(rig).arrays.items()}
    shared, own = dict[str, Sensor](), dict[str, Sensor]()
    for name, sensor in in_full(rigs, sensors).items():
        every = [f"{name}.{i}" for i in range(arrays.get(name, 0))]
        there = [one for one in every if sampled is None or one in sampled]
        shared |= dict.fromkeys(there, sensor)
        own |= {} if there else {name: sensor}
    return shared | own


@dataclass(frozen=True)
class Coordinate:
    """One entry of the vector of coordinates: name and kind, its bounds and start in physical
    units, its scale, and its prior. An `alternative` changes the recordings by an amount."""

    name: str
    kind: Literal["parameter", "start", "alternative"] | Nuisance
    recording: str | None
    nominal: float
    low: float
    high: float
    scale: Literal["log", "linear"] = "linear"
    ratio_to: str | None = None
    fixed: bool = False
    prior: Prior | None = None

    @property
    def of_the_rig(self) -> bool:
        """Whether a run depends on it; otherwise only a sensor's reading of the run does."""
        return self.kind in ("parameter", "start")

    @property
    def label(self) -> str:
        """Readable name: `materials.rubber.E`, `bodies.a.mass / bodies.b.mass`, `delay of x_C`."""
        plain = self.of_the_rig or self.kind == "alternative"
        quantity = self.name if plain else f"{self.kind} of {self.name}"
        ratio = f" / {self.ratio_to}" if self.ratio_to else ""
        return f"{quantity}{ratio}" + (f" in {self.recording}" if self.recording else "")

    def to_x(self, value: float) -> float:
        return math.log(value) if self.scale == "log" else value / (self.high - self.low)

    def to_value(self, x: float) -> float:
        return math.exp(x) if self.scale == "log" else x * (self.high - self.low)

    def slope(self, x: float) -> float:
        """d value / d x."""
        return math.exp(x) if self.scale == "log" else self.high - self.low


def limits(name: str, unknowns: Mapping[str, Unknown], recording: Recording) -> tuple[float, float]:
    """Bounds of an unknown, or of its ratio, from the declaration of its part's constructor and
    from fixed parameters."""
    ordered, ratio_to = recording.rig.ordered, unknowns[name].ratio_to
    if ratio_to is not None:
        return (
            1.0 if ordered.get(ratio_to) == name else -math.inf,
            1.0 if ordered.get(name) == ratio_to else math.inf,
        )
    declared = None if name.startswith(PREFIX) else recording.rig.quantity(name)
    if declared is None:
        return -math.inf, math.inf
    least, most = declared.low, declared.high
    for lower, upper in ordered.items():
        if name == lower and (known := known_value(upper, unknowns, recording)) is not None:
            most = min(most, known)
        if name == upper and (known := known_value(lower, unknowns, recording)) is not None:
            least = max(least, known)
    return least, most


def known_value(name: str, unknowns: Mapping[str, Unknown], recording: Recording) -> float | None:
    """Value of a parameter in all fits of a recording, and None where a search moves it, or what
    it is tied to."""
    given, u = recording.parameters, unknowns.get(name)
    if u is None or name not in given:
        return given.get(name)
    if not u.fixed:
        return None
    if u.ratio_to is None:
        return given[name] if u.nominal is None else u.nominal
    base = known_value(u.ratio_to, unknowns, recording)
    ratio = given[name] / given[u.ratio_to] if u.nominal is None else u.nominal
    return None if base is None else ratio * base


def own_value(name: str, u: Unknown, recordings: Sequence[Recording]) -> float:
    """Value of an unknown, or of its ratio, in the rigs of all recordings. Raises `ValueError`
    where they differ."""
    own = [
        r.parameters[name] / (r.parameters[u.ratio_to] if u.ratio_to else 1.0) for r in recordings
    ]
    for r, value in zip(recordings, own):
        if not math.isclose(value, own[0], rel_tol=1e-9):
            raise ValueError(
                f"unknowns.{name}: it is {own[0]:g} in the rig of recording `{recordings[0].name}` "
                f"and {value:g} in that of `{r.name}`: set by `nominal` where the search starts"
            )
    return own[0]


def reach(
    name: str, of: Mapping[str, Coordinate], given: Mapping[str, float]
) -> tuple[float, float]:
    """Least and largest value of a parameter in a search; of a ratio, that of the ratio itself
    where nothing is `given`."""
    if (one := of.get(name)) is None:
        return given[name], given[name]
    low, high = (one.nominal, one.nominal) if one.fixed else (one.low, one.high)
    if one.ratio_to is None or not given:
        return low, high
    ends = [end * base for end in (low, high) for base in reach(one.ratio_to, of, given)]
    return min(ends), max(ends)


AT_BOUND = 1e-4
"""Distance from a bound, over the width of the bounds, below which a coordinate counts as being at
it."""


def check_unknown(
    name: str, u: Unknown, unknowns: Mapping[str, Unknown], recordings: Sequence[Recording]
) -> None:
    """Raises `ValueError` for an unknown that is no scalar parameter of every rig, or whose ratio
    is to something else."""
    rig, given = recordings[0].rig, parameters(recordings[0])
    for one in given.keys() & {name, u.ratio_to}:
        if without := next((r.name for r in recordings[1:] if one not in r.parameters), None):
            raise ValueError(f"unknowns: the rig of recording `{without}` has no `{line(one, 80)}`")
    if name not in given:
        several = dict(rig.named_parameters()).get(rig.aliases.get(name, name))
        why = ""
        if several is not None and several.ndim:
            why = f"it has {several.numel()} numbers, and an unknown is one"
        raise ValueError(
            f"unknowns: `{line(name, 80)}` cannot be identified; "
            f"{why or suggestion(name, given, 'known:')}"
        )
    if (base := u.ratio_to) is None:
        return
    if base not in given or base == name:
        raise ValueError(
            f"unknowns.{name}.ratio_to = {shown(base)} is not another parameter of the model"
        )
    if base in unknowns and unknowns[base].ratio_to:
        raise ValueError(f"unknowns.{name}.ratio_to = {shown(base)} is a ratio itself")


def parameters(recording: Recording) -> dict[str, float]:
    """Values of the parameters of a recording's rig."""
    return {k: value for k, value in recording.parameters.items() if not k.startswith(PREFIX)}


def parameter_coordinate(
    name: str, u: Unknown, unknowns: Mapping[str, Unknown], recordings: Sequence[Recording]
) -> Coordinate:
    """Coordinate of an unknown parameter, with its start and its bounds. Raises `ValueError` where
    these are impossible."""
    nominal = own_value(name, u, recordings) if u.nominal is None else u.nominal
    if u.scale == "log" and nominal <= 0:
        raise ValueError(
            f"unknowns.{name} = {nominal:g} is not on a logarithmic scale: give a positive "
            "`nominal`, or scale = 'linear'"
        )
    ends = [limits(name, unknowns, r) for r in recordings]
    least, most = max(least for least, _ in ends), min(most for _, most in ends)
    for field in ("low", "high", "nominal"):
        value = getattr(u, field)
        if value is not None and not least <= value <= most:
            quantity = f"{name} / {u.ratio_to}" if u.ratio_to else name
            where = " in all recordings" if len(set(ends)) > 1 else ""
            raise ValueError(
                f"unknowns.{name}.{field} = {value:g} is beyond what {quantity} may be"
                f"{where}, from {least:g} to {most:g}"
            )
    low = max(nominal / SPREAD, least) if u.low is None else u.low
    high = min(nominal * SPREAD, most) if u.high is None else u.high
    median = u.prior.median if u.prior else nominal
    for field, value in (("nominal", nominal), ("prior.median", median)):
        if not low <= value <= high or low == high:
            raise ValueError(
                f"unknowns.{name}.{field} = {value:g} is not between low = {low:g} and "
                f"high = {high:g}"
            )
    return Coordinate(
        name, "parameter", None, nominal, low, high, u.scale, u.ratio_to, u.fixed, u.prior
    )


def start_coordinates(recordings: Sequence[Recording]) -> Iterator[Coordinate]:
    """Coordinates of the starts of runs, with bounds at `BOUNDS` standard deviations."""
    for r in recordings:
        for name, mean, sd in r.start_coordinates:
            low, high, prior = mean - BOUNDS * sd, mean + BOUNDS * sd, Prior(median=mean, sd=sd)
            yield Coordinate(name, "start", r.name, mean, low, high, prior=prior)


def fault_coordinates(
    sensors: Mapping[str, Sensor], recordings: Sequence[Recording]
) -> Iterator[Coordinate]:
    """Coordinates of the faults of sensors to identify, one for all recordings or one for each."""
    for channel, sensor in sensors.items():
        seen = [r.name for r in recordings if channel in r.samples]
        for kind, (low, nominal, high) in sensor.nuisances.items():
            for where in seen if sensor.per == "recording" else [None]:
                yield Coordinate(channel, kind, where, nominal, low, high)


class Coordinates:
    """All coordinates of a problem, in a fixed order, and the map from their vector x (n,) to
    parameters of the rig, starts of runs, faults of sensors, and amounts of alternatives, which
    have bounds by name. Coordinates `held`, by label, are not free.

    Raises `ValueError` for unknowns that some recording's rig lacks, a ratio to an unknown
    parameter, or a nominal value or median of a prior out of bounds.
    """

    def __init__(
        self,
        unknowns: dict[str, Unknown],
        sensors: dict[str, Sensor],
        recordings: Sequence[Recording],
        amounts: Mapping[str, tuple[float, float]] | None = None,
        held: Collection[str] = (),
    ) -> None:
        self.recordings, self.all = tuple(r.name for r in recordings), list[Coordinate]()
        for name, u in unknowns.items():
            check_unknown(name, u, unknowns, recordings)
            one = parameter_coordinate(name, u, unknowns, recordings)
            every = (None,) if u.per == "all" else self.recordings
            self.all += [replace(one, recording=where) for where in every]
        for r in recordings:
            for pair in r.rig.ordered.items():
                self._check_order(*pair, r.parameters)
        self.all += [*start_coordinates(recordings), *fault_coordinates(sensors, recordings)]
        for name, (low, high) in (amounts or {}).items():
            self.all.append(Coordinate(name, "alternative", None, 0.0, low, high))
        self.all = [replace(c, fixed=c.fixed or c.label in held) for c in self.all]
        self.names = tuple(dict.fromkeys(c.name for c in self.all if c.of_the_rig))

    def _check_order(self, lower: str, upper: str, given: Mapping[str, float]) -> None:
        """Raises `ValueError` where a search could move the first of two ordered parameters above
        the second."""
        of = {c.name: c for c in self.all}
        bases = [of[name].ratio_to if name in of else None for name in (lower, upper)]
        if bases[0] == upper or bases[1] == lower or not of.keys() & {lower, upper}:
            return
        if not {lower, upper} <= of.keys() | given.keys():
            return
        together = bases[0] is not None and bases[0] == bases[1]
        (_, most), (least, _) = (
            reach(name, of, {} if together else given) for name in (lower, upper)
        )
        if most > least * (1 + 1e-9):
            raise ValueError(
                f"unknowns.{lower} must not exceed {upper}, but may be up to {most:g} and the "
                f"other down to {least:g}: give unknowns.{lower}.ratio_to = '{upper}'"
            )

    def __len__(self) -> int:
        return len(self.all)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(c.label for c in self.all)

    @property
    def start(self) -> Array:
        """Vector x of the nominal values (n,)."""
        return np.array([c.to_x(c.nominal) for c in self.all])

    @property
    def bounds(self) -> tuple[Array, Array]:
        return np.array([c.to_x(c.low) for c in self.all]), np.array(
            [c.to_x(c.high) for c in self.all]
        )

    def with_known(self, known: Mapping[str, float]) -> Array:
        """Vector x (n,) with the `known` entries by label, and the nominal values elsewhere."""
        return np.array([known.get(label, own) for label, own in zip(self.labels, self.start)])

    def within(self, mask: Mask) -> list[Coordinate]:
        """The coordinates of a mask (n,)."""
        return [one for one, is_in in zip(self.all, mask) if is_in]

    def at_bound(self, x: Array) -> Mask:
        """Mask of coordinates (n,) within `AT_BOUND` of a bound."""
        low, high = self.bounds
        return np.minimum(x - low, high - x) < AT_BOUND * (high - low)

    @property
    def free(self) -> Mask:
        return np.array([not c.fixed for c in self.all], bool)

    def values(self, x: Array, recording: str, given: Mapping[str, float]) -> dict[str, float]:
        """Values of the unknown parameters in one recording; `given` holds those that a ratio may
        refer to."""
        mine = [
            (i, c)
            for i, c in enumerate(self.all)
            if c.of_the_rig and c.recording in (None, recording)
        ]
        out = {c.name: c.to_value(x[i]) for i, c in mine}
        for _, c in mine:
            if c.ratio_to:
                out[c.name] *= out.get(c.ratio_to, given[c.ratio_to])
        return out

    def jacobian(self, x: Array, recording: str, values: dict[str, float]) -> Array:
        """d (parameters `names`) / d x (names, n) in one recording; `values` are those of
        `values(x, recording)`."""
        out = np.zeros((len(self.names), len(self.all)))
        for i, c in enumerate(self.all):
            if c.of_the_rig and c.recording in (None, recording):
                row = self.names.index(c.name)
                out[row, i] = c.slope(x[i]) * (
                    values[c.name] / c.to_value(x[i]) if c.ratio_to else 1.0
                )
                for other in self.all:  # a ratio moves with what it is a ratio to
                    if other.ratio_to == c.name and other.recording in (None, recording):
                        part = values[other.name] / values[c.name]
                        out[self.names.index(other.name), i] += part * c.slope(x[i])
        return out

    def nuisances(
        self, x: Array, channel: str, recording: str
    ) -> dict[Nuisance, tuple[float, int]]:
        """Values [SI] of a sensor's faults in one recording, and their indices in x."""
        return {
            c.kind: (c.to_value(x[i]), i)
            for i, c in enumerate(self.all)
            if c.name == channel and not c.of_the_rig and c.recording in (None, recording)
        }  # pyright: ignore[reportReturnType]

    def log_prior_volume(self, x: Array) -> tuple[float, Array]:
        """Logarithm of d value / d x at x (n,) of the coordinates whose prior is normal on a
        logarithmic scale, or log-normal on a linear one, and its gradient (n,): the factor between
        densities of values and of coordinates."""
        total, gradient = 0.0, np.zeros(len(x))
        for i, prior in self.priors:
            c = self.all[i]
            if c.scale == "log" and prior.kind == "normal":
                total, gradient[i] = total + float(x[i]), 1.0
            elif c.scale == "linear" and prior.kind == "log-normal":
                value = c.to_value(x[i])
                total, gradient[i] = total - math.log(value), -c.slope(x[i]) / value
        return total, gradient

    @property
    def priors(self) -> list[tuple[int, Prior]]:
        """Indices of free coordinates with a prior, and the priors."""
        return [(i, c.prior) for i, c in enumerate(self.all) if c.prior is not None and not c.fixed]
