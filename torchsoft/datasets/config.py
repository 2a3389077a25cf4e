"""What a dataset is made of: the TOML file, validated."""

import hashlib
import itertools
import math
import tomllib
import warnings
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, ValidationError, model_validator

from torchsoft.excitation import Table
from torchsoft.files import findings
from torchsoft.parameters import Parameters

RATIO = "contact.mu_k/contact.mu_s"
"""The one derived parameter: a range for the ratio keeps mu_k below a ranged mu_s."""

SHAPING = ("pad.elements_x", "pad.elements_y", "pad.length", "pad.fidelity", "pad.enclosed", "scenario.y_Br_grasp")
"""Parameters that may not differ between trajectories: the mesh is common, and the grasp has a range of its own."""


class Range(Table):
    """From `low` to `high`, uniformly in the value or in its logarithm."""

    low: float
    high: float
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
        if self.scale == "log":
            return math.exp(math.log(self.low) + u * (math.log(self.high) - math.log(self.low)))
        return self.low + u * (self.high - self.low)


class PositiveRange(Range):
    """A range of positive values."""

    low: float = Field(gt=0)


class RandomMotion(Table):
    """A kind of motion, drawn in proportion to `weight`; `motion` is its name in `torchsoft.excitation`, its own by default."""

    kind: str
    weight: float = Field(1.0, gt=0)
    motion: ClassVar[str | None] = None
    sets: ClassVar[dict[str, Any]] = {}  # parameters that this kind needs


class SlowRoll(RandomMotion):
    """Out by `travel` [m], to either side, and rest there."""

    kind: Literal["slow_roll"] = "slow_roll"
    travel: PositiveRange = PositiveRange(low=5e-3, high=20e-3)


class Strokes(RandomMotion):
    """There and back by `travel` [m], `stroke_time` [s] each way, until the end."""

    kind: Literal["strokes"] = "strokes"
    travel: PositiveRange = PositiveRange(low=5e-3, high=15e-3)
    stroke_time: PositiveRange = PositiveRange(low=0.4, high=1.0)


class MultiSine(RandomMotion):
    """Sums of `components` sines of random phase in x and y; amplitudes [m] are of the sum's peak at most."""

    kind: Literal["multi_sine"] = "multi_sine"
    amplitude_x: PositiveRange = PositiveRange(low=1e-3, high=4e-3)
    amplitude_y: PositiveRange = PositiveRange(low=5e-5, high=3e-4)
    frequency: PositiveRange = PositiveRange(low=0.5, high=8.0, scale="log")
    """every component's frequency lies in this range [Hz]"""
    components: int = Field(5, ge=1, le=50)


class Chirp(RandomMotion):
    """Sweeps in x and y from `start` to `end` [Hz]; amplitudes in m."""

    kind: Literal["chirp"] = "chirp"
    amplitude_x: PositiveRange = PositiveRange(low=5e-4, high=2e-3)
    amplitude_y: PositiveRange = PositiveRange(low=5e-5, high=2e-4)
    start: PositiveRange = PositiveRange(low=0.2, high=0.5)
    end: PositiveRange = PositiveRange(low=4.0, high=10.0)


class Press(RandomMotion):
    """The bracket's height modulated by `amplitude` [m] at `frequency` [Hz] while the disc rolls by `travel` [m]."""

    kind: Literal["press"] = "press"
    amplitude: PositiveRange = PositiveRange(low=5e-5, high=4e-4)
    frequency: PositiveRange = PositiveRange(low=1.0, high=5.0)
    travel: PositiveRange = PositiveRange(low=1e-3, high=10e-3)


class Jerk(RandomMotion):
    """Forced slip: strokes of the bracket, whose own x the horizontal loop measures, over a disc grasped lightly, to `depth`
    [m] in place of the common depth."""

    kind: Literal["jerk"] = "jerk"
    motion: ClassVar[str] = "strokes"
    sets: ClassVar[dict[str, Any]] = {"control.senses": "bracket"}
    depth: PositiveRange = PositiveRange(low=2e-4, high=4e-4)
    travel: PositiveRange = PositiveRange(low=20e-3, high=40e-3)
    stroke_time: PositiveRange = PositiveRange(low=0.06, high=0.12)


Kind = SlowRoll | Strokes | MultiSine | Chirp | Press | Jerk


def ranges(kind: Kind) -> dict[str, Range]:
    """The ranged quantities of a kind, by name."""
    values = {name: getattr(kind, name) for name in type(kind).model_fields}
    return {name: value for name, value in values.items() if isinstance(value, Range)}


class Fractions(Table):
    """Fractions of the trajectories; the rest is for testing."""

    train: float = Field(0.7, gt=0, lt=1)
    validation: float = Field(0.15, ge=0, lt=1)

    @model_validator(mode="after")
    def _leave_some_for_testing(self) -> Self:
        if self.train + self.validation >= 1:
            raise ValueError(f"train + validation must stay below 1, but is {self.train + self.validation}")
        return self


class Config(Table):
    """One dataset. `ValueError` names the field that is wrong.

    Everything but `title` and `description` decides the data; `trajectories_per_shard` and `samples_per_chunk` decide
    only where they lie.
    """

    title: str
    description: str = ""
    seed: int = Field(ge=0)
    trajectories: int = Field(ge=1)
    trajectories_per_shard: int = Field(16, ge=1)
    samples_per_chunk: int = Field(250, ge=1)
    method: Literal["sobol", "latin_hypercube"] = "sobol"
    duration: float = Field(gt=0)  # of every trajectory [s]
    sample_interval: float = Field(5e-3, gt=0)  # between samples [s]
    step: float = Field(1e-3, gt=0)  # largest step of the stepper [s]
    settle: float = Field(0.125, ge=0)  # time between the end of the grasp and the start of the motion [s]
    feed_forward: Literal["pressed", "found"] = "pressed"
    """grasping force of the frictionless statics, or found by simulating the grasp until the bracket holds its height"""
    node_precision: Literal["float32", "float64"] = "float32"
    """of everything that is kept per node; the rest is float64"""
    ledger_tolerance: float = Field(0.02, gt=0)
    """largest energy residual over the energy injected [1] that the check accepts"""
    grasp_depth: PositiveRange = PositiveRange(low=1.0e-3, high=1.6e-3)  # compression of both pads together [m]
    splits: Fractions = Fractions(train=0.7, validation=0.15)
    fixed: dict[str, Any] = Field(default_factory=dict)
    """parameters that differ from their defaults in every trajectory"""
    parameters: dict[str, Range] = Field(default_factory=dict)
    kinds: tuple[Kind, ...] = Field(min_length=1)

    @property
    def samples(self) -> int:
        """Times on the output grid, both ends included."""
        return round(self.duration / self.sample_interval) + 1

    @property
    def shards(self) -> int:
        return -(-self.trajectories // self.trajectories_per_shard)

    @property
    def hash(self) -> str:
        """Of everything in the file."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]

    def physics(self, values: dict[str, Any], grasp_depth: float) -> Parameters:
        """Parameters of one trajectory: defaults, then `fixed`, then `values`, the bracket lowered by `grasp_depth`."""
        tree = dict(self.fixed) | values
        ratio = tree.pop(RATIO, None)
        if ratio is not None:
            tree["contact.mu_k"] = ratio * tree.get("contact.mu_s", Parameters().contact.mu_s)

        def of(name: str) -> float:
            return tree.get(name, Parameters().table()[name]["value"])

        apart = 2 * (of("pad.height") + of("disc.radius")) + of("bracket.cm_height")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a steep friction law fails in simulation, with its reason, or does not
            return Parameters().override(tree | {"scenario.y_Br_grasp": apart - grasp_depth, "scenario.travel": 0.0})

    @model_validator(mode="after")
    def _times_fit(self) -> Self:
        if abs(self.duration / self.sample_interval - (self.samples - 1)) > 1e-6:
            raise ValueError(f"duration = {self.duration} s is not a whole number of sample_interval")
        if self.step > self.sample_interval:
            raise ValueError(f"step = {self.step} s exceeds sample_interval = {self.sample_interval} s")
        begin = Parameters().scenario.grasp_time + self.settle
        if self.duration < begin + 0.4:
            raise ValueError(f"duration = {self.duration} s leaves no motion: the grasp and settle take {begin} s")
        return self

    @model_validator(mode="after")
    def _names_are_known(self) -> Self:
        table = Parameters().table()
        for where, names in (("parameters", self.parameters), ("fixed", self.fixed)):
            for name in names:
                if name not in table and not (where == "parameters" and name == RATIO):
                    raise ValueError(f"{where}.{name} is not a parameter; known: {', '.join(table)}, {RATIO}")
        for name in self.parameters:
            if name in self.fixed:
                raise ValueError(f"parameters.{name} is in `fixed` as well")
            if name in SHAPING or (name in table and not isinstance(table[name]["value"], float)):
                raise ValueError(f"parameters.{name} must be the same in every trajectory; set it in `fixed`")
        if RATIO in self.parameters and "contact.mu_k" in {*self.parameters, *self.fixed}:
            raise ValueError(f"parameters.{RATIO} and contact.mu_k exclude each other")
        return self

    @model_validator(mode="after")
    def _ranges_are_possible(self) -> Self:
        depths = (self.grasp_depth.low, self.grasp_depth.high)
        table = Parameters().table()
        length = self.fixed.get("pad.length", table["pad.length"]["value"])
        x_C0 = self.fixed.get("scenario.x_C0", table["scenario.x_C0"]["value"])
        starts = self.parameters.get("scenario.x_C0", Range(low=x_C0, high=x_C0))
        for i, kind in enumerate(self.kinds):
            travel = ranges(kind).get("travel")
            if travel and (starts.low - travel.high < 0 or starts.high + travel.high > length):
                raise ValueError(
                    f"kinds.{i}.travel reaches {travel.high} m and leaves the pad, which is {length} m long"
                )
        for name, r in self.parameters.items():
            for value in (r.low, r.high):
                if name == RATIO and not 0 <= value <= 1:
                    raise ValueError(f"parameters.{name} must lie in [0, 1], but reaches {value}")
        ratio = {RATIO: self.parameters[RATIO].low} if RATIO in self.parameters else {}
        pairs = sorted(itertools.combinations_with_replacement(self.parameters, 2), key=lambda pair: pair[0] != pair[1])
        for a, b in pairs or [("", "")]:
            for u, v, depth in itertools.product((0, 1), (0, 1), depths):
                ends = {name: self.parameters[name].at(w) for name, w in ((a, u), (b, v)) if name}
                try:
                    self.physics(ratio | ends, depth)
                except ValueError as error:
                    reason = findings(error) if isinstance(error, ValidationError) else str(error)
                    where = ", ".join(f"parameters.{name} = {x:g}" for name, x in ends.items())
                    raise ValueError(
                        f"{where or 'fixed'} with grasp_depth = {depth:g} is impossible: {reason}"
                    ) from None
        return self

    @classmethod
    def from_toml(cls, path: str | Path) -> "Config":
        """Read a TOML file. Raises `ValueError` naming the file and the field."""
        try:
            return cls.model_validate(tomllib.loads(Path(path).read_text()))
        except (OSError, tomllib.TOMLDecodeError) as error:
            raise ValueError(f"{path}: {getattr(error, 'strerror', error)}") from error
        except ValidationError as error:
            raise ValueError(f"{path}: {findings(error)}") from error
