"""The paper's rig as the subject of a dataset: its kinds of motion, and its grasp before them."""

import itertools
import warnings
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from torchsoft.channels import CHANNELS
from torchsoft.datasets.distributions import Frequencies, Lengths, Range, Times
from torchsoft.datasets.schema import Label
from torchsoft.datasets.subject import (
    RTOL,
    Begun,
    Row,
    Subject,
    Task,
    rounded,
    split,
    stated_steps,
)
from torchsoft.display import suggestion
from torchsoft.excitation import MOST, Excitation, reference
from torchsoft.paper.equilibrium import holding_force, press, rest
from torchsoft.paper.parameters import Parameters, check
from torchsoft.paper.rig import SoftGrasp
from torchsoft.scenario import SETTLE, find_grasp_force
from torchsoft.tables import Table, line

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

FOUND = 6
"""Runs of the grasp that finding its force takes."""

FORCE = 4
"""Decimals that grasping forces [N] are rounded to."""

SIGNALS = {
    name: Label(one.unit, one.meaning)
    for name, one in CHANNELS.items()
    if name not in ("t", "angular_momentum")
}
"""Channels that a dataset keeps of every trajectory."""

PADS = {"L": "lower", "U": "upper"}
"""Pads by their names, in words."""


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


class PaperRun(NamedTuple):
    """What a trajectory of the paper's rig needs."""

    parameters: Parameters
    excitation: Excitation


class PaperGrasp(Subject):
    """Grasps and rolls of the paper's rig. Parameters are those of `Parameters`, by its names."""

    signals: Mapping[str, Label] = SIGNALS

    @cached_property
    def template(self) -> SoftGrasp:  # pyright: ignore[reportIncompatibleVariableOverride]
        return SoftGrasp(Parameters().override(self.config.fixed))

    def columns(self) -> dict[str, tuple[tuple[str, ...], NDArray[np.float64], str, str]]:
        return {
            f"{pad}_point": (
                (f"{pad}_point",), self.template.pads[pad].point_positions[:, 0].numpy(), "m",
                f"x of the {words} pad's contact points in its base's frame, undeformed",
            )
            for pad, words in PADS.items()
        }  # fmt: skip

    @property
    def labels(self) -> dict[str, Label]:
        table, parameters = Parameters().table(), self.config.parameters
        table[RATIO] = {"unit": "1", "meaning": "ratio of the friction coefficients"}
        names = (*parameters, *(["contact.mu_k"] if RATIO in parameters else []))
        return {
            name.replace("/", "_over_"): Label(
                table[name]["unit"], f"parameter: {table[name]['meaning']}"
            )
            for name in names
        } | {
            "grasp_depth": Label(
                "m", "set-point of the compression of both pads together in the grasp"
            ),
            "grasp_force": Label("N", "grasping force fed forward"),
        }

    @property
    def ranges(self) -> dict[str, Any]:
        return super().ranges | {"grasp_depth": self.config.grasp_depth}

    words: Mapping[str, Label] = {"kind": Label("1", "kind of motion", "str")}

    @property
    def constants(self) -> dict[str, Any]:
        table = Parameters().override(self.config.fixed).table()
        return {name: row["value"] for name, row in table.items()}

    @property
    def drawn(self) -> int:
        config = self.config
        return len(config.parameters) + 2 + max(len(kind.ranges) for kind in config.kinds)

    @property
    def steps(self) -> dict[str, Any]:
        return stated_steps(self.config) or {"rtol": RTOL}

    @property
    def prelude(self) -> float:
        if self.config.feed_forward != "found":
            return 0.0
        return FOUND * (self.template.settings.scenario.grasp_time + SETTLE)

    def physics(self, values: dict[str, Any], grasp_depth: float) -> Parameters:
        """Parameters of one trajectory: defaults, then `fixed`, then `values`, the bracket lowered
        by `grasp_depth`."""
        tree = DEFAULTS | self.config.fixed | values
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
        value = self.config.fixed.get(name, DEFAULTS[name])
        return (r.low, r.high) if (r := self.config.parameters.get(name)) else (value, value)

    def task(self, index: int, u: list[float]) -> Task:
        """Trajectory `index` at the point u of the design."""
        config = self.config
        n, rng = len(config.parameters), np.random.default_rng((config.seed, index))
        *own, common, which = u[: n + 2]
        sampled = {name: r.at(x) for (name, r), x in zip(config.parameters.items(), own)}
        edges = np.cumsum([kind.weight for kind in config.kinds])
        kind = config.kinds[
            min(int(np.searchsorted(edges, which * edges[-1], side="right")), len(edges) - 1)
        ]
        motion: Any = {name: r.at(x) for (name, r), x in zip(kind.ranges.items(), u[n + 2 :])}
        depth = motion.pop("depth", config.grasp_depth.at(common))  # a kind may have its own range
        side = float(rng.choice((-1.0, 1.0)))
        if "travel" in motion:
            motion["travel"] *= side
        if isinstance(kind, MultiSine):
            motion |= {
                "frequency": (kind.frequency.low, kind.frequency.high),
                "components": kind.components,
            }
            motion["seed"] = int(rng.integers(2**31))
        p = self.physics(sampled | kind.sets, depth)
        excitation = Excitation(
            motion=motion | {"kind": kind.motion or kind.kind}, duration=config.duration,
            depth=depth, senses=p.control.senses, grasp_time=p.scenario.grasp_time,
            settle=config.settle, x_C0=p.scenario.x_C0,
        )  # fmt: skip
        labels: Row = {name.replace("/", "_over_"): value for name, value in sampled.items()}
        if RATIO in sampled:
            labels["contact.mu_k"] = p.contact.mu_k
        labels |= {"grasp_depth": depth, "kind": kind.kind, "split": split(config, index)}
        return Task(index, PaperRun(p, excitation), labels)

    def begin(self, task: Task) -> Begun:
        given: PaperRun = task.given
        model, config = SoftGrasp(given.parameters), self.config
        y0 = rounded(model, rest(model))
        if config.feed_forward == "found":
            force = find_grasp_force(model, y0, **self.steps)
        else:
            force = holding_force(model, press(model, given.parameters.scenario.y_Br_grasp))
        force = round(force, FORCE)
        y_Br = float(model.unpack(y0).pose["bracket"][1])
        motion = reference(given.excitation, model, y_Br, force)
        return Begun(model, y0, motion, {"grasp_force": force})

    def check(self) -> None:
        if not self.config.kinds:
            raise ValueError("kinds is missing: say which motions there are")
        self._check_values()
        self._check_times()
        self._check_ranges()

    def _check_values(self) -> None:
        config = self.config
        for name in (*config.parameters, *config.fixed):
            where = f"{'parameters' if name in config.parameters else 'fixed'}.{line(name, 80)}"
            if name in DECIDED:
                raise ValueError(
                    f"{where} has no part in a dataset: grasp_depth, kinds and duration decide it"
                )
            if name not in DEFAULTS and where != f"parameters.{RATIO}":
                raise ValueError(
                    f"{where} is not a parameter; {suggestion(name, (*DEFAULTS, RATIO), 'known:')}"
                )
            if name in config.parameters and name in config.fixed:
                raise ValueError(f"{where} is in `fixed` as well; leave one of them out")
        for name, value in config.fixed.items():
            check(name, value, f"fixed.{name}")
        for name, r in config.parameters.items():
            if name in SHAPING or not isinstance(DEFAULTS.get(name, 0.0), float):
                raise ValueError(
                    f"parameters.{name} must be the same in every trajectory; set it in `fixed`"
                )
            if r.ratio_to is not None:
                raise ValueError(
                    f"parameters.{name}.ratio_to is of a rig file; for friction draw {RATIO}"
                )
            for where, value in r.ends(f"parameters.{name}").items():
                if name != RATIO:
                    check(name, value, where)
                elif not 0 <= value <= 1:
                    raise ValueError(f"{where} must lie in [0, 1], but is {value}")
        if RATIO in config.parameters and "contact.mu_k" in {*config.parameters, *config.fixed}:
            raise ValueError(
                f"parameters.{RATIO} and contact.mu_k exclude each other; leave one of them out"
            )

    def _check_times(self) -> None:
        config = self.config
        grasp = self.extremes("scenario.grasp_time")[1]
        begin = grasp + config.settle
        if config.duration < begin + MOTION:
            raise ValueError(
                f"duration = {config.duration} s leaves no motion: scenario.grasp_time = {grasp} s "
                f"and settle = {config.settle} s take {begin:.6g} s, and a motion at least "
                f"{MOTION} s"
            )
        for i, kind in enumerate(config.kinds):
            if (
                isinstance(kind, Strokes | Jerk)
                and (config.duration - begin) / kind.stroke_time.low > MOST
            ):
                raise ValueError(
                    f"kinds.{i}.stroke_time.low = {kind.stroke_time.low} s makes more than {MOST} "
                    f"strokes in duration = {config.duration} s"
                )

    def _check_ranges(self) -> None:
        config = self.config
        length, starts = self.extremes("pad.length")[1], self.extremes("scenario.x_C0")
        depths = config.grasp_depth.ends("grasp_depth")
        for i, kind in enumerate(config.kinds):
            travel = kind.ranges.get("travel")
            if travel and (starts[0] - travel.high < 0 or starts[1] + travel.high > length):
                raise ValueError(
                    f"kinds.{i}.travel.high = {travel.high} m leaves the pad: scenario.x_C0 is "
                    f"between {starts[0]} and {starts[1]} m, and pad.length = {length} m"
                )
            if isinstance(kind, Jerk):
                depths |= kind.depth.ends(f"kinds.{i}.depth")
        ratio = {RATIO: config.parameters[RATIO].low} if RATIO in config.parameters else {}
        few = (1, 2) if config.parameters else (0,)  # at a time
        for names in itertools.chain.from_iterable(
            itertools.combinations(config.parameters, n) for n in few
        ):
            for u, (where, depth) in itertools.product(
                itertools.product((0, 1), repeat=len(names)), depths.items()
            ):
                ends = {name: config.parameters[name].at(end) for name, end in zip(names, u)}
                try:
                    self.physics(ratio | ends, depth)
                except ValueError as error:
                    values = "".join(f"parameters.{name} = {x:g}, " for name, x in ends.items())
                    raise ValueError(
                        f"{values}{where} = {depth:g} is impossible: {error}"
                    ) from None
