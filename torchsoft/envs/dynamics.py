"""A rig under actions at a control rate, in torch: from a state and an action to the next state, an
observation and a reward, all differentiable."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from scipy import sparse
from torch import Tensor

from torchsoft.display import suggestion
from torchsoft.physics.arguments import number, positive, whole
from torchsoft.physics.channels import Seen, Touch, declared, measurable
from torchsoft.physics.motion import Lines, Reference
from torchsoft.physics.parts import COORDINATES
from torchsoft.rigs.built import BuiltRig
from torchsoft.solve.gradients import TAPE_BYTES, Solved, Task, attached
from torchsoft.solve.simulate import prepare, run, started
from torchsoft.solve.stepper import ImplicitStepper
from torchsoft.solve.steps import check_knots
from torchsoft.solve.trajectory import Trajectory

Ranges = Mapping[str, tuple[float, float]]
"""Lower and upper bound by name, in SI units."""

Reward = Callable[[Trajectory, Tensor], Any]
"""Reward of the run over one control interval, and of the action (actions,) at its end."""

SHORTEST = 1e-4
"""Shortest control interval [s]."""

LOOK = 1e-3
"""Length [s] of a run made for the sake of its first sample."""


@dataclass(frozen=True)
class TargetPose:
    """Target pose of a body. The reward of a step is 1 / (1 + d^2) less `changes` times the squared
    change of the action; d^2 is the sum of squared distances of the coordinates over their `scale`
    [m, rad].

    target: by coordinate ("x", "y", "theta"), a number [m, rad], or lower and upper bound of a
    uniform draw in each episode.
    """

    body: str
    target: Mapping[str, float | tuple[float, float]]
    scale: Mapping[str, float]
    changes: float = 0.01


class Moment(NamedTuple):
    """State of an episode at a control time: the rig's state y (size,); the last action (actions,);
    the number of control intervals so far; the target (coordinates,) [m, rad] of the goal; the
    index of the interval after which each disturbance peaks, with its peak (disturbances, 2); and
    the recorded forces (recorded,) for observations."""

    y: Tensor
    action: Tensor
    steps: int
    target: Tensor
    peaks: Tensor
    recorded: Tensor


class Transition(NamedTuple):
    """Result of an action: the next moment, the observation (n,) and the reward (), both float64
    and differentiable, and the run between."""

    moment: Moment
    observation: Tensor
    reward: Tensor
    solved: Solved

    @property
    def knots(self) -> Tensor:
        """Times [s] of the steps, for a run with frozen steps."""
        return torch.from_numpy(self.solved.out.knots)


class Dynamics:
    """A built rig under actions. `actions` are the ranges of the signals of the reference that an
    action in [-1, 1] sets, `observations` those of channels, by which they are scaled to [-1, 1]
    (not clipped); an array of touch such as "skin.normal" names all of its channels.

    An observation holds the channels, then the distances to the goal over their scales, then the
    action that was reached. Between two control times, `interval` [s] apart, a signal goes linearly
    from one action to the next. Until `begin` [s] the rig follows its own motion, and all other
    signals always do. `disturbances` are signals that nothing observes: an episode adds a peak to
    each, at one control time, from the one before and until the one after; between control times
    they are lines. `samples` are the outputs of the run that a custom reward is given.

    Raises `ValueError` naming the field.
    """

    def __init__(
        self, built: BuiltRig, *, actions: Ranges, observations: Ranges, interval: float,
        goal: TargetPose | None, reward: Reward | None, begin: float, samples: int,
        solver: Mapping[str, Any], disturbances: Ranges,
    ) -> None:  # fmt: skip
        self.rig, self._built, self.solver = built.rig, built, dict(solver)
        self._read: Read | None = None
        self.goal, self.reward = goal, reward
        self.interval, self.samples = positive("interval", interval), whole("samples", samples, 1)
        if self.interval < SHORTEST:
            raise ValueError(
                f"`interval` must be at least {SHORTEST:g} s, but is {interval:g} s; every control "
                "interval is a run of its own"
            )
        self.start = number("begin", begin)
        if not 0 <= self.start < float("inf"):
            raise ValueError(f"`begin` must be a time from 0 s on, but is {begin} s")
        if (goal is None) == (reward is None):
            raise ValueError("give either `goal` or `reward`: each defines the reward")
        rig = self.rig
        if not actions:
            raise ValueError(f"`actions` is empty; name signals of {', '.join(rig.signals)}")
        self.actions = checked("actions", actions, rig.signals, "signals are")
        self._low, self._half = limits(self.actions)
        others = [name for name in rig.signals if name not in self.actions]
        self.disturbances = checked(
            "disturbances", disturbances, others, "signals that no action sets are"
        )
        free = ((body, i) for body, axes in rig.layout.free.items() for i in axes)
        names = (f"{body}.{COORDINATES[i]}" for body, i in free)
        self.coordinates = dict(zip(names, rig.layout.rigid))
        self._set_observed(observations)
        self._set_goal()
        self.size = len(self._order) + len(self._goal_at) + len(self.actions)

    def _set_observed(self, ranges: Ranges) -> None:
        """Sort observed channels into entries of the state, sums of recorded forces, and others."""
        rig, touch = self.rig, Touch(self.rig)
        at = dict(zip(measurable(rig), rig.layout.rigid))
        every = {one.name: one for one in declared(rig) if one.forces is None}
        spread = {one: x for name, x in ranges.items() for one in touch.expanded([name])}
        checked("observations", spread, [*every, *touch], "channels are")
        self._origin, self._span = limits(spread)
        state = [name for name in spread if name in at]
        plain = lambda name: touch.force_sums([name])[0].over is None
        felt = [name for name in spread if name in touch and plain(name)]
        others = [name for name in spread if name not in (*state, *felt)]
        self._other = [every[name] if name in every else touch[name] for name in others]
        self._state = torch.tensor([at[name] for name in state], dtype=torch.int64)
        start, places, weight = touch.sums(felt)
        sums = sparse.csr_array((weight, places, start), (len(felt), places.max(initial=0) + 1))
        self._sums = torch.from_numpy(sums.toarray())
        order = [*state, *felt, *others]
        self._order = torch.tensor([order.index(name) for name in spread], dtype=torch.int64)

    def _set_goal(self) -> None:
        goal, free = self.goal, self.coordinates
        target = dict(goal.target) if goal else {}
        body = goal.body if goal else ""
        check_names("goal.target", [f"{body}.{x}" for x in target], free, "free are")
        if goal and target.keys() != goal.scale.keys():
            raise ValueError(
                f"`goal.scale` must have the coordinates of `goal.target`, {', '.join(target)}, "
                f"but has {', '.join(goal.scale) or 'none'}"
            )
        goal_at = [free[f"{body}.{axis}"] for axis in target]
        self._goal_at = torch.tensor(goal_at, dtype=torch.int64)
        drawn = {axis: x for axis, x in target.items() if isinstance(x, Sequence)}
        drawn = checked("goal.target", drawn, target, "")
        ends = [drawn.get(axis, (x, x)) for axis, x in target.items()]
        self.targets = torch.tensor(ends, dtype=torch.float64).reshape(-1, 2)
        scale = [positive(f"goal.scale[{x!r}]", goal.scale[x]) for x in target] if goal else []
        self._scale = torch.tensor(scale, dtype=torch.float64)

    def begin(self, target: Tensor | None = None) -> Moment:
        """The moment at the time `begin`, after the rig's own motion, without disturbance. The
        parameters are read here, and their graph serves one backward pass. Raises
        `SimulationFailed`."""
        self._read, t = self._read_parameters(), torch.tensor([0.0, self.start or LOOK]).double()
        own = self.reference
        y, recorded = attached([self._run(t, self._read.y0, None)])[0]
        there = -1 if self.start else 0
        with torch.no_grad():
            now = own(torch.tensor(self.start, dtype=torch.float64), list(self.actions))[:, 0]
        target = self.targets.mean(1) if target is None else target
        reached = (now - self._low) / self._half - 1
        none = torch.zeros(len(self.disturbances), 2, dtype=torch.float64)
        return Moment(y[there], reached, 0, target, none, recorded[there])

    def _read_parameters(self) -> "Read":
        """What follows from the parameters of the rig as they are."""
        y0, reference = started(self.rig, self._built.initial, "discrete")
        with torch.enable_grad():  # a step may be differentiated, whatever is done here
            stepper = prepare(
                self.rig, [0.0, 1.0], y0=y0, reference=reference, gradient="discrete",
                **self.solver,
            ).stepper  # fmt: skip
        t, lines = torch.tensor([0.0, LOOK]).double(), torch.zeros(len(self._set_by), 2).double()
        motion = stepper.parameters.kernel_signals(self._following(reference, t, lines), 0.0)
        return Read(y0, reference, stepper, motion)

    @property
    def _known(self) -> "Read":
        """What was read of the rig last, or now."""
        if self._read is None:
            self._read = self._read_parameters()
        return self._read

    @property
    def reference(self) -> Reference:
        """The rig's own motion, with the parameters that were read."""
        return self._known.reference

    @property
    def _set_by(self) -> list[str]:
        """Signals that actions or disturbances set."""
        return [*self.actions, *self.disturbances]

    def __getstate__(self) -> dict[str, Any]:
        """Without what was read: a copy reads the parameters of its own rig."""
        return self.__dict__ | {"_read": None}

    def step(self, now: Moment, action: Tensor, knots: Tensor | None = None) -> Transition:
        """The transition from a moment to the next control time, with an action (actions,) in [-1,
        1]; `knots` are the frozen steps of another run. There is no graph under `torch.no_grad()`.
        Raises `ValueError` for an action out of range, and `SimulationFailed`."""
        self.check_action(action)
        begin = self.start + now.steps * self.interval
        end = self.start + (now.steps + 1) * self.interval
        t = torch.linspace(begin, end, self.samples + 1, dtype=torch.float64)
        both = torch.stack((now.action, action))
        both = (self._low + self._half * (1 + both)).mT
        solved = self._run(t, now.y, torch.cat((both, self._disturbed(now))), knots)
        rows = attached([solved])[0]
        moment = now._replace(
            y=rows[0][-1], action=action, steps=now.steps + 1, recorded=rows[1][-1]
        )
        distance = self.distance(moment)
        if self.reward is not None:
            given = self.reward(Trajectory.of(solved, rows), action)
            value = torch.as_tensor(given, dtype=torch.float64)
            if value.ndim or not bool(value.isfinite()):
                raise ValueError(f"`reward` must give one finite number, but gives {given!r}")
        else:
            assert self.goal is not None
            change = action - now.action
            value = (1 + distance.dot(distance)).reciprocal()
            value = value - self.goal.changes * change.dot(change)
        seen = self._seen(moment, distance, solved.task.stepper)
        return Transition(moment, seen, value, solved)

    def look(self, now: Moment) -> Trajectory:
        """A short run from a moment, whose first sample is that moment."""
        t = self.start + now.steps * self.interval + torch.tensor([0.0, LOOK]).double()
        held = self._low + self._half * (1 + now.action)
        held = torch.cat((held, self._disturbed(now)[:, 0]))[:, None].expand(-1, 2)
        with torch.no_grad():
            return Trajectory.of(self._run(t, now.y, held))

    def distance(self, now: Moment) -> Tensor:
        """Distances of the goal's coordinates from their targets, over their scales."""
        return (now.target - now.y[self._goal_at]) / self._scale

    def observe(self, now: Moment) -> Tensor:
        """The observation (n,) at a moment to which the rig's own motion led."""
        return self._seen(now, self.distance(now), None)

    def _seen(self, now: Moment, distance: Tensor, stepper: ImplicitStepper | None) -> Tensor:
        """The observation at a moment to which the motion of a stepper led, or the rig's own."""
        y, rig = now.y, self.rig
        parts = [y[self._state], self._sums @ now.recorded[: self._sums.shape[1]]]
        if self._other:
            t = torch.tensor(self.start + now.steps * self.interval, dtype=torch.float64)
            signals = rig.follow(t, self.reference) if stepper is None else stepper.signals_now(t)
            seen = Seen(rig, rig.unpack(y, signals), signals, now.recorded)
            parts += [own.read(seen)[None] for own in self._other]
        seen = (torch.cat(parts)[self._order] - self._origin) / self._span - 1
        return torch.cat((seen, distance, now.action))

    def check_action(self, action: Tensor) -> None:
        """Raises `ValueError` for an action of another shape, not finite, or out of [-1, 1]."""
        names = list(self.actions)
        if action.shape != (len(names),):
            raise ValueError(
                f"`action` must hold {len(names)} numbers, for {', '.join(names)}, but has shape "
                f"{tuple(action.shape)}"
            )
        for name, value in zip(names, action.tolist()):
            if not abs(value) <= 1 + 1e-6:
                raise ValueError(
                    f"`action` sets `{name}` to {value:g}, but must be from -1 to 1; clip it, or "
                    "wrap the environment in gymnasium.wrappers.ClipAction"
                )

    def _disturbed(self, now: Moment) -> Tensor:
        """Disturbed signals (disturbances, 2) at both ends of the next interval."""
        if not self.disturbances:
            return now.peaks
        steps = now.steps + torch.arange(2)
        t = self.start + self.interval * steps.double()
        own = torch.stack([self.reference(x, list(self.disturbances))[:, 0] for x in t], -1)
        when, peak = now.peaks[:, :1], now.peaks[:, 1:]
        return own + torch.where((when == steps) & (steps > 0), peak, 0.0)

    def _following(self, own: Reference, times: Tensor, values: Tensor) -> Reference:
        """The rig's own reference, with lines between two values each (signals, 2) for signals set
        by actions or disturbances."""
        signals = {name: own[name] for name in self.rig.signals}
        lines = {name: Lines(times, row) for name, row in zip(self._set_by, values)}
        return Reference(**signals | lines)

    def _run(
        self, t: Tensor, y: Tensor, values: Tensor | None, knots: Tensor | None = None
    ) -> Solved:
        """A run with lines between `values` (signals, 2) for signals set by actions or
        disturbances, or by the rig's own motion."""
        _, own, stepper, motion = self._known
        steps_are_given = knots is not None or stepper.step is not None
        if values is None:
            stepper = stepper.following(own)
        elif motion.known and not steps_are_given and not torch.is_grad_enabled():
            first, last = t.numpy()[[0, -1]]
            signals = self.rig.signals
            places = [signals.index(name) for name in self._set_by]
            stepper = stepper.moving(motion.on_lines(places, first, last, values.numpy()), first)
        else:
            stepper = stepper.following(self._following(own, t[[0, -1]], values))
        stepper = stepper if knots is None else stepper.along(check_knots(knots))
        return run(Task(stepper, t, y), TAPE_BYTES, explained=False)


class Read(NamedTuple):
    """What follows from the parameters of a rig: its initial state y0 (size,), its own motion, its
    stepper, and the motion of one between control times as the kernels take it."""

    y0: Tensor
    reference: Reference
    stepper: ImplicitStepper
    motion: Any


def check_names(field: str, given: Iterable[str], known: Iterable[str], listed: str) -> None:
    """Raises `ValueError` for an unknown name."""
    names = list(known)
    for name in given:
        if name not in names:
            raise ValueError(f"`{field}` names `{name}`; {suggestion(name, names, listed)}")


def checked(field: str, ranges: Ranges, known: Iterable[str], listed: str) -> Ranges:
    """The ranges as given. Raises `ValueError` for an unknown name, and for an invalid range."""
    check_names(field, ranges, known, listed)
    for name, given in ranges.items():
        try:
            low, high = map(float, given)
        except (TypeError, ValueError):
            low, high = 0.0, 0.0
        if not -float("inf") < low < high < float("inf"):
            raise ValueError(
                f"`{field}[{name!r}]` must be a pair of finite numbers, low below high, but is "
                f"{given!r}"
            )
    return dict(ranges)


def limits(ranges: Ranges) -> tuple[Tensor, Tensor]:
    """Low ends (n,) and half widths (n,)."""
    ends = torch.tensor([tuple(x) for x in ranges.values()], dtype=torch.float64).reshape(-1, 2)
    return ends[:, 0], 0.5 * (ends[:, 1] - ends[:, 0])
