"""A rig file as an environment of gymnasium, and its pictures."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.envs.dynamics import (
    Dynamics,
    Moment,
    Ranges,
    Reward,
    TargetPose,
    check_names,
    checked,
)
from torchsoft.physics.arguments import number
from torchsoft.physics.channels import recorded_slices
from torchsoft.plot.scene import Instant, Scene, instants, limits
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.built import BuiltRig
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.trajectory import Trajectory

FRAMES_PER_SECOND = 10

DRAWS = 10
"""Most draws of parameters for one episode."""

SOLVER = {"rtol": 1e-3}
"""Default step control, where the rig file states none."""


class RedrawnStart(UserWarning):
    """The first draw of an episode's parameters had no initial state; others were drawn."""


class RigEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """The rig of a file, or one built in Python, under actions at a control rate.

    `actions`, `observations`, `interval`, `goal`, `reward`, `begin`, `disturbances` and `samples`
    are those of `torchsoft.envs.dynamics.Dynamics`; each episode draws a peak between the low and
    high of a disturbance, and its control time. `env.dynamics` and `env.moment` are the environment
    in torch, with gradients.

    duration: time limit [s] after `begin`, a multiple of `interval`; by default the rest of the
    file's. bounds: by coordinate such as "disc.y", beyond which an episode terminates [m, rad].
    held: bodies that terminate it when no contact touches them at a control time.
    failure_reward: the reward of such an end, and of a failed run. parameters: ranges between which
    each episode draws numbers of the rig file by name, such as "materials.rubber.E" [Pa] or
    "bodies.disc.start.x" [m]; the rig is then built anew each time, which takes some tenths of a
    second.

    `info` has the time [s], and "ended" or, where the simulation failed, "failure", as a sentence.
    Raises `ValueError` naming the field and the remedy.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FRAMES_PER_SECOND}  # noqa: RUF012

    def __init__(
        self, rig: RigFile | BuiltRig | str | Path, *, actions: Ranges,
        observations: Ranges, interval: float = 0.1, goal: TargetPose | None = None,
        reward: Reward | None = None, begin: float = 0.0, duration: float | None = None,
        bounds: Ranges | None = None, held: Sequence[str] = (), failure_reward: float = -1.0,
        parameters: Ranges | None = None, disturbances: Ranges | None = None, samples: int = 1,
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:  # fmt: skip
        self._file = RigFile.from_toml(RigFile.path(rig)) if isinstance(rig, str | Path) else rig
        if not isinstance(self._file, RigFile | BuiltRig):
            raise ValueError(
                "`rig` must be a rig file, its path, or a rig with its start (`BuiltRig`), but is "
                f"{type(rig).__name__}"
            )
        self.parameters = self._checked_parameters(parameters or {})
        self.failure_reward = number("failure_reward", failure_reward)
        built, solver = self._built({}), SOLVER
        if isinstance(self._file, RigFile):
            solver = self._file.solver.model_dump(exclude_none=True)
            solver = solver if solver.keys() - {"tolerance"} else solver | SOLVER
        self._arguments: dict[str, Any] = {
            "actions": actions, "observations": observations, "interval": interval, "goal": goal,
            "reward": reward, "begin": begin, "samples": samples, "solver": solver,
            "disturbances": disturbances or {},
        }  # fmt: skip
        self.dynamics = Dynamics(built, **self._arguments)
        rest = float(built.t[-1]) - begin
        if rest <= 0:
            raise ValueError(
                f"`begin` = {begin:g} s is not before the end of the rig's own motion, "
                f"{float(built.t[-1]):g} s"
            )
        left = rest if duration is None else number("duration", duration)
        self.limit = int(left / interval + 1e-9) if math.isfinite(left) else 0
        if self.limit < 1 or (duration is not None and abs(self.limit * interval - left) > 1e-9):
            cause = "" if duration is not None else ", the rest of the run after `begin`"
            raise ValueError(
                f"`duration` must be a multiple of `interval` = {interval:g} s, but is {left:g} s"
                f"{cause}"
            )
        free = self.dynamics.coordinates
        self.bounds = checked("bounds", bounds or {}, free, "free are")
        self.held = self._checked_held(held)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(
                f"`render_mode` must be 'rgb_array' or None, but is {render_mode!r}; show the "
                "pictures of `render` with matplotlib's `imshow`, or wrap the environment in "
                "gymnasium's `HumanRendering`"
            )
        self.render_mode, self._scene = render_mode, None
        most = float(np.finfo(np.float32).max)
        self.action_space = Box(-1.0, 1.0, (len(actions),), np.float32)
        self.observation_space = Box(-most, most, (self.dynamics.size,), np.float32)
        self._begun: Moment | None = None
        self._versions: list[int] = []
        self.moment: Moment | None = None
        self._over = False

    def _checked_parameters(self, ranges: Ranges) -> Ranges:
        file = self._file
        if ranges and not isinstance(file, RigFile):
            raise ValueError("`parameters` are numbers of a rig file; give the file as `rig`")
        for name, ends in checked("parameters", ranges, ranges, "").items():
            for end in ends:
                try:
                    file.override({name: float(end)})  # pyright: ignore[reportAttributeAccessIssue]
                except ValueError as error:
                    raise ValueError(f"`parameters[{name!r}]` = {end:g}: {error}") from None
        return dict(ranges)

    def _checked_held(self, held: Sequence[str]) -> dict[str, list[slice]]:
        """Recorded forces of the contacts of each body in `held`."""
        rig, slices = self.dynamics.rig, dict[str, list[slice]]()
        places = recorded_slices(rig)
        for name, contact in rig.contacts.items():
            here = places["contact", name]
            slices.setdefault(contact.body, []).append(slice(here.start, here.stop, 2))
        names = [held] if isinstance(held, str) else held
        check_names("held", names, slices, "there are")
        return {body: slices[body] for body in names}

    def _built(self, values: Mapping[str, float]) -> BuiltRig:
        if isinstance(self._file, RigFile):
            return self._file.override(values).build()
        return self._file

    @torch.no_grad()
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode. `options` may give the "target" of the goal [m, rad] by coordinate."""
        super().reset(seed=seed)
        versions = [x._version for x in self.dynamics.rig.parameters()]
        if self.parameters or self._begun is None or versions != self._versions:
            self._begun, self._versions = self._drawn_start(), versions
        target, peaks = self._drawn_target(options or {}), self._drawn_peaks()
        self.moment, self._over = self._begun._replace(target=target, peaks=peaks), False
        return self._seen(self.dynamics.observe(self.moment)), self._info(self.moment)

    def _drawn_target(self, options: Mapping[str, Any]) -> Tensor:
        """Target of an episode: the given coordinates, and draws of the others."""
        check_names("options", options, ["target"], "known is")
        goal, (low, high) = self.dynamics.goal, self.dynamics.targets.numpy().T
        target, axes = self.np_random.uniform(low, high), list(goal.target) if goal else []
        given = options.get("target") or {}
        check_names("target", given, axes, "the goal has")
        for name in given:
            target[axes.index(name)] = number("target", given[name])
        if not np.isfinite(target).all():
            raise ValueError(f"`target` must be finite, but is {given}")
        return torch.from_numpy(target)

    def _drawn_peaks(self) -> Tensor:
        """Control time and height of the peak of every disturbance."""
        ends, draw = self.dynamics.disturbances.values(), self.np_random
        peaks = [(draw.integers(1, max(self.limit, 2)), draw.uniform(*range_)) for range_ in ends]
        return torch.tensor(peaks, dtype=torch.float64).reshape(-1, 2)

    def _drawn_start(self) -> Moment:
        """The first moment, with newly drawn parameters."""
        message = ""
        for _ in range(DRAWS):
            values = {k: float(self.np_random.uniform(*x)) for k, x in self.parameters.items()}
            try:
                if values:
                    self.close()
                    self.dynamics = Dynamics(self._built(values), **self._arguments)
                start = self.dynamics.begin()
            except (SimulationFailed, ValueError, np.linalg.LinAlgError) as error:
                sample = ", ".join(f"{name} = {x:.4g}" for name, x in values.items())
                message = f"no episode begins with {sample or 'this rig'}: {error}"
                if not values:
                    raise ValueError(f"{message}; see `begin`") from None
                continue
            if message:
                warn(f"{message}; others were drawn", RedrawnStart)
            return start
        raise ValueError(f"{message}; narrow the ranges of `parameters`")

    @torch.no_grad()
    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Apply an action over one control interval. Raises `ValueError` for an action that is not
        finite or out of [-1, 1], and before `reset`."""
        now, dynamics = self.moment, self.dynamics
        if now is None or self._over:
            raise ValueError("the episode is over, or has not begun; call `reset` first")
        command = torch.as_tensor(np.asarray(action), dtype=torch.float64)
        dynamics.check_action(command)
        try:
            done = dynamics.step(now, command)
        except (SimulationFailed, np.linalg.LinAlgError) as failure:
            self._over = True
            info = self._info(now) | {"failure": str(failure)}
            return self._seen(dynamics.observe(now)), self.failure_reward, True, False, info
        self.moment = done.moment
        ended = self.ended(done.moment)
        truncated = done.moment.steps >= self.limit
        self._over = bool(ended) or truncated
        info = self._info(done.moment) | ({"ended": ended} if ended else {})
        reward = self.failure_reward if ended else float(done.reward)
        return self._seen(done.observation), reward, bool(ended), truncated, info

    def ended(self, now: Moment) -> str:
        """Reason why an episode terminates at a moment, empty where it goes on."""
        for name, (low, high) in self.bounds.items():
            x = now.y[self.dynamics.coordinates[name]].item()
            if not low <= x <= high:
                return f"{name} = {x:.4g} left its bounds, {low:g} to {high:g}"
        for body, slices in self.held.items():
            if not any((now.recorded.detach().numpy()[at] > 0).any() for at in slices):
                return f"{body} was dropped: no contact touches it"
        return ""

    def _seen(self, observation: Tensor) -> NDArray[np.float32]:
        return observation.numpy().astype(np.float32)

    def _info(self, now: Moment) -> dict[str, Any]:
        goal = {}
        if self.dynamics.goal is not None:
            goal = {"distance": math.hypot(*self.dynamics.distance(now).tolist())}
        return {"time": self.dynamics.start + now.steps * self.dynamics.interval} | goal

    def render(self) -> NDArray[np.uint8]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The picture (height, width, 3), with the limits and the scale of forces of the first one
        of this rig."""
        if self.moment is None or self.render_mode is None:
            raise ValueError("nothing to render: give a `render_mode`, and call `reset` first")
        run = self.dynamics.look(self.moment)
        (instant,) = instants(run, [float(run.t[0])])
        if self._scene is None:
            self._scene = scene_of(run, instant)
        self._scene.show(instant)
        axes = self._scene.axes
        axes.set_title(f"t = {instant.time:.3f} s")
        canvas = axes.figure.canvas
        assert isinstance(canvas, FigureCanvasAgg)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Forget the limits of the pictures."""
        self._scene = None


ROOM = 0.25
"""Margin around the first picture, over its size."""


def scene_of(run: Trajectory, first: Instant) -> Scene:
    """Axes for the pictures of an episode, with room around the first of them."""
    figure = Figure(figsize=(6.0, 4.8), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    scene = Scene(figure.subplots(), run.setup, [first], stressed=False)
    x, y = (side + ROOM * np.diff(side) * [-1, 1] for side in limits(run.setup, [first]))
    scene.axes.set(xlim=x, ylim=y)
    return scene
