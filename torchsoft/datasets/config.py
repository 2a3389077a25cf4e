"""What a dataset is made of: the TOML file, validated."""

import hashlib
import itertools
import math
import warnings
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Literal, Self, TypeVar

from pydantic import Field, model_validator

from torchsoft.display import suggestion
from torchsoft.excitation import MOST, Frequency, Time
from torchsoft.paper.parameters import Parameters, check
from torchsoft.tables import LISTED, SEED, Table, from_toml, line

T = TypeVar("T", bound=float)

SPLITS = ("train", "validation", "test")

RATIO = "contact.mu_k/contact.mu_s"
"""The one derived parameter: a range for the ratio keeps mu_k below a ranged mu_s."""

SHAPING = ("pad.elements_x", "pad.elements_y", "pad.length", "pad.fidelity", "pad.enclosed")
"""Parameters that may not differ between trajectories, because the mesh is common."""

DECIDED = tuple(
    f"scenario.{name}" for name in ("y_Br_grasp", "travel", "roll_time", "hold_time", "rest_time")
)
"""Parameters that have no part in a dataset: `grasp_depth`, `kinds` and `duration` are in their
place."""

MOTION = 0.4
"""Shortest time [s] of a motion."""

DEFAULTS = {name: row["value"] for name, row in Parameters().table().items()}

RTOL = 1e-4
"""Relative tolerance of the stepper where neither it nor a step is given: data are not
differentiated."""

STEP = 0.02
"""Largest step [s] of the stepper: twice the pads' own time, and the energy balance is off by
percents."""


class Range(Table, Generic[T]):
    """From `low` to `high`, uniformly in the value or in its logarithm."""

    low: T
    high: T
    scale: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low = {self.low} exceeds high = {self.high}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"a logarithmic range needs low > 0, but low = {self.low}")
        return self

    def at(self, u: float) -> float:
        """The value at u in [0, 1]."""
        low, high = self.low, self.high
        if self.scale == "log":
            value = math.exp(math.log(low) + u * (math.log(high) - math.log(low)))
            return min(max(value, low), high)  # the ends are not rounded beyond themselves
        return low + u * (high - low)

    def ends(self, where: str) -> dict[str, float]:
        """Both ends by what messages call them."""
        return {f"{where}.low": self.low, f"{where}.high": self.high}


class Lengths(Range[Annotated[float, Field(ge=1e-9, le=10.0)]]):
    """A range of lengths [m]."""


class Times(Range[Time]):
    """A range of times [s]."""


class Frequencies(Range[Frequency]):
    """A range of frequencies [Hz]."""


class RandomMotion(Table):
    """A kind of motion, drawn in proportion to `weight`; `motion` is its name in
    `torchsoft.excitation`, its own by default."""

    kind: str
    weight: float = Field(1.0, ge=1e-6, le=1e6)
    motion: ClassVar[str | None] = None
    sets: ClassVar[dict[str, Any]] = {}  # parameters that this kind needs

    @property
    def ranges(self) -> dict[str, Range]:
        """What is drawn for every trajectory, by name."""
        return {name: value for name, value in self if isinstance(value, Range)}


class SlowRoll(RandomMotion):
    """Out by `travel` [m], to either side, and rest there."""

    kind: Literal["slow_roll"] = "slow_roll"
    travel: Lengths = Lengths(low=5e-3, high=20e-3)


class Strokes(RandomMotion):
    """There and back by `travel` [m], `stroke_time` [s] each way, until the end."""

    kind: Literal["strokes"] = "strokes"
    travel: Lengths = Lengths(low=5e-3, high=15e-3)
    stroke_time: Times = Times(low=0.4, high=1.0)


class MultiSine(RandomMotion):
    """Sums of `components` sines of random phase in x and y; amplitudes [m] are of the sum's peak
    at most."""

    kind: Literal["multi_sine"] = "multi_sine"
    amplitude_x: Lengths = Lengths(low=1e-3, high=4e-3)
    amplitude_y: Lengths = Lengths(low=5e-5, high=3e-4)
    frequency: Frequencies = Frequencies(low=0.5, high=8.0, scale="log")
    """every component's frequency lies in this range [Hz]"""
    components: int = Field(5, ge=1, le=50)


class Chirp(RandomMotion):
    """Sweeps in x and y from `start` to `end` [Hz]; amplitudes in m."""

    kind: Literal["chirp"] = "chirp"
    amplitude_x: Lengths = Lengths(low=5e-4, high=2e-3)
    amplitude_y: Lengths = Lengths(low=5e-5, high=2e-4)
    start: Frequencies = Frequencies(low=0.2, high=0.5)
    end: Frequencies = Frequencies(low=4.0, high=10.0)


class Press(RandomMotion):
    """The bracket's height modulated by `amplitude` [m] at `frequency` [Hz] while the disc rolls by
    `travel` [m]."""

    kind: Literal["press"] = "press"
    amplitude: Lengths = Lengths(low=5e-5, high=4e-4)
    frequency: Frequencies = Frequencies(low=1.0, high=5.0)
    travel: Lengths = Lengths(low=1e-3, high=10e-3)


class Jerk(RandomMotion):
    """Forced slip: strokes of the bracket, whose own x the horizontal loop measures, over a disc
    grasped lightly, to `depth` [m] in place of the common depth."""

    kind: Literal["jerk"] = "jerk"
    motion: ClassVar[str] = "strokes"
    sets: ClassVar[dict[str, Any]] = {"control.senses": "bracket"}
    depth: Lengths = Lengths(low=2e-4, high=4e-4)
    travel: Lengths = Lengths(low=20e-3, high=40e-3)
    stroke_time: Times = Times(low=0.06, high=0.12)


Kind = Annotated[SlowRoll | Strokes | MultiSine | Chirp | Press | Jerk, Field(discriminator="kind")]


class Fractions(Table):
    """Fractions of the trajectories; the rest is for testing."""

    train: float = Field(0.7, gt=0, lt=1)
    validation: float = Field(0.15, ge=0, lt=1)

    @model_validator(mode="after")
    def _leave_some_for_testing(self) -> Self:
        if self.train + self.validation >= 1:
            raise ValueError(
                f"train + validation must stay below 1, but is {self.train + self.validation}"
            )
        return self


class Config(Table):
    """One dataset. `ValueError` names the field that is wrong.

    Everything but `title` and `description` decides the data; `trajectories_per_shard` and
    `samples_per_chunk` decide only where they lie.
    """

    title: str
    description: str = ""
    seed: int = Field(ge=0, le=SEED)
    trajectories: int = Field(ge=1, le=10_000_000)
    trajectories_per_shard: int = Field(16, ge=1, le=100_000)
    samples_per_chunk: int = Field(250, ge=1, le=10_000_000)
    method: Literal["sobol", "latin_hypercube"] = "sobol"
    duration: float = Field(ge=1e-3, le=1e4)  # of every trajectory [s]
    sample_interval: float = Field(5e-3, ge=1e-6, le=1.0)  # between samples [s]
    rtol: float | None = Field(
        None, ge=1e-9, le=1e-2
    )  # relative tolerance of the stepper, `RTOL` by default
    step: float | None = Field(
        None, ge=1e-6, le=STEP
    )  # equal steps no longer than this [s] instead
    settle: float = Field(
        0.125, ge=0, le=1e4
    )  # time between the end of the grasp and the start of the motion [s]
    feed_forward: Literal["pressed", "found"] = "pressed"
    """grasping force of the frictionless statics, or found by simulating the grasp until the
    bracket holds its height"""
    node_precision: Literal["float32", "float64"] = "float32"
    """of everything that is kept per node; the rest is float64"""
    ledger_tolerance: float = Field(0.02, ge=1e-12, le=1.0)
    """largest energy residual over the energy injected [1] that the check accepts"""
    grasp_depth: Lengths = Lengths(low=1.0e-3, high=1.6e-3)  # compression of both pads together [m]
    splits: Fractions = Fractions(train=0.7, validation=0.15)
    fixed: dict[str, Any] = Field(default_factory=dict)
    """parameters that differ from their defaults in every trajectory"""
    parameters: dict[str, Range] = Field(default_factory=dict)
    kinds: Annotated[tuple[Kind, ...], LISTED] = Field(min_length=1, max_length=100)

    @property
    def samples(self) -> int:
        """Times on the output grid, both ends included."""
        return round(self.duration / self.sample_interval) + 1

    @property
    def shards(self) -> int:
        return -(-self.trajectories // self.trajectories_per_shard)

    def rows(self, shard: int) -> range:
        """The trajectories of a shard."""
        size = self.trajectories_per_shard
        return range(shard * size, min((shard + 1) * size, self.trajectories))

    @property
    def hash(self) -> str:
        """Of everything in the file."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]

    def physics(self, values: dict[str, Any], grasp_depth: float) -> Parameters:
        """Parameters of one trajectory: defaults, then `fixed`, then `values`, the bracket lowered
        by `grasp_depth`."""
        tree = DEFAULTS | self.fixed | values
        if (ratio := tree.pop(RATIO, None)) is not None:
            tree["contact.mu_k"] = ratio * tree["contact.mu_s"]
        grasped = (
            2 * (tree["pad.height"] + tree["disc.radius"]) + tree["bracket.cm_height"] - grasp_depth
        )
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # a steep friction law fails in simulation, with its reason, or does not
            return Parameters().override(
                tree | {"scenario.y_Br_grasp": grasped, "scenario.travel": 0.0}
            )

    def extremes(self, name: str) -> tuple[float, float]:
        """The least and the largest value of a parameter."""
        value = self.fixed.get(name, DEFAULTS[name])
        return (r.low, r.high) if (r := self.parameters.get(name)) else (value, value)

    @model_validator(mode="after")
    def _values_are_possible(self) -> Self:
        for name in (*self.parameters, *self.fixed):
            where = f"{'parameters' if name in self.parameters else 'fixed'}.{line(name, 80)}"
            if name in DECIDED:
                raise ValueError(
                    f"{where} has no part in a dataset: grasp_depth, kinds and duration decide it"
                )
            if name not in DEFAULTS and where != f"parameters.{RATIO}":
                raise ValueError(
                    f"{where} is not a parameter; {suggestion(name, (*DEFAULTS, RATIO), 'known:')}"
                )
            if name in self.parameters and name in self.fixed:
                raise ValueError(f"{where} is in `fixed` as well; leave one of them out")
        for name, value in self.fixed.items():
            check(name, value, f"fixed.{name}")
        for name, r in self.parameters.items():
            if name in SHAPING or not isinstance(DEFAULTS.get(name, 0.0), float):
                raise ValueError(
                    f"parameters.{name} must be the same in every trajectory; set it in `fixed`"
                )
            for where, value in r.ends(f"parameters.{name}").items():
                if name != RATIO:
                    check(name, value, where)
                elif not 0 <= value <= 1:
                    raise ValueError(f"{where} must lie in [0, 1], but is {value}")
        if RATIO in self.parameters and "contact.mu_k" in {*self.parameters, *self.fixed}:
            raise ValueError(
                f"parameters.{RATIO} and contact.mu_k exclude each other; leave one of them out"
            )
        return self

    @model_validator(mode="after")
    def _times_fit(self) -> Self:
        if abs(self.duration / self.sample_interval - (self.samples - 1)) > 1e-6:
            raise ValueError(
                f"duration = {self.duration} s is not a whole number of sample_interval = "
                f"{self.sample_interval} s"
            )
        if self.step is not None and self.rtol is not None:
            raise ValueError(
                f"rtol = {self.rtol:g} and step = {self.step:g} s each say which steps to take; "
                "give one of them"
            )
        if self.step is not None and self.step > self.sample_interval:
            raise ValueError(
                f"step = {self.step} s exceeds sample_interval = {self.sample_interval} s"
            )
        grasp = self.extremes("scenario.grasp_time")[1]
        begin = grasp + self.settle
        if self.duration < begin + MOTION:
            raise ValueError(
                f"duration = {self.duration} s leaves no motion: scenario.grasp_time = {grasp} s "
                f"and settle = {self.settle} s take {begin:.6g} s, and a motion at least {MOTION} s"
            )
        for i, kind in enumerate(self.kinds):
            if (
                isinstance(kind, Strokes | Jerk)
                and (self.duration - begin) / kind.stroke_time.low > MOST
            ):
                raise ValueError(
                    f"kinds.{i}.stroke_time.low = {kind.stroke_time.low} s makes more than {MOST} "
                    f"strokes in duration = {self.duration} s"
                )
        return self

    @model_validator(mode="after")
    def _ranges_are_possible(self) -> Self:
        length, starts = self.extremes("pad.length")[1], self.extremes("scenario.x_C0")
        depths = self.grasp_depth.ends("grasp_depth")
        for i, kind in enumerate(self.kinds):
            travel = kind.ranges.get("travel")
            if travel and (starts[0] - travel.high < 0 or starts[1] + travel.high > length):
                raise ValueError(
                    f"kinds.{i}.travel.high = {travel.high} m leaves the pad: scenario.x_C0 is "
                    f"between {starts[0]} and {starts[1]} m, and pad.length = {length} m"
                )
            if isinstance(kind, Jerk):
                depths |= kind.depth.ends(f"kinds.{i}.depth")
        ratio = {RATIO: self.parameters[RATIO].low} if RATIO in self.parameters else {}
        few = (1, 2) if self.parameters else (0,)  # at a time
        for names in itertools.chain.from_iterable(
            itertools.combinations(self.parameters, n) for n in few
        ):
            for u, (where, depth) in itertools.product(
                itertools.product((0, 1), repeat=len(names)), depths.items()
            ):
                ends = {name: self.parameters[name].at(end) for name, end in zip(names, u)}
                try:
                    self.physics(ratio | ends, depth)
                except ValueError as error:
                    values = "".join(f"parameters.{name} = {x:g}, " for name, x in ends.items())
                    raise ValueError(
                        f"{values}{where} = {depth:g} is impossible: {error}"
                    ) from None
        return self

    @property
    def steps(self) -> dict[str, Any]:
        """How `simulate` is to choose its steps."""
        return {"step": self.step} if self.step else {"rtol": self.rtol or RTOL}

    @classmethod
    def from_toml(cls, path: str | Path) -> "Config":
        """Read a TOML file. Raises `ValueError` naming the file and the field, `OSError` for one
        that cannot be read."""
        return from_toml(path, cls.model_validate)
