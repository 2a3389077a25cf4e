"""A recording: the rig, the start of its run, and the samples of the sensors, which may have
gaps."""

import inspect
from collections.abc import Collection
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchsoft.display import suggestion
from torchsoft.physics.channels import Touch, measurable, units
from torchsoft.physics.pads import Pad
from torchsoft.physics.rig import Rig
from torchsoft.sysid.extensions import extend
from torchsoft.sysid.initial_state import InitialState, Start, StartCoordinate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BETWEEN = 1e-3
"""Spacing [s] of the simulated regular grid where samples are interpolated (an unknown delay) or
denser than it, with a cubic spline between its points."""

REACH = 0.1
"""Largest delay [s] of a sensor, and time before the first and after the last sample that runs
cover."""

SAME = 1e-9
"""Difference [s] below which two times are equal."""


class RunContext(NamedTuple):
    """Context of a run: its own copy of the rig, the initial state, and the recorded channels."""

    rig: Rig
    start: Start
    y0: InitialState
    channels: tuple[str, ...]


class Grid(NamedTuple):
    """Times t (G,) [s] to simulate; the first `early` of them are not part of the signals."""

    t: Tensor
    early: int


@dataclass(frozen=True)
class Recording:
    """One run of a rig, measured by sensors.

    `rig` has the known parameters, nominal values of the unknown ones, the laws, and the reference
    that the run followed; runs use copies of it. `samples` holds times (k,) [s] and values (k,) by
    channel, each with its own times; channels are those of `measurable`, and those of touch.
    `start` is the start of the run. `dataclasses.replace` makes variants, such as one with another
    law.
    """

    name: str
    rig: Rig = field(repr=False)
    samples: dict[str, tuple[Array, Array]] = field(repr=False)
    start: Start

    def __post_init__(self) -> None:
        if not self.samples:
            raise ValueError(f"recording `{self.name}` has no samples")
        full = {self.rig.full(channel): given for channel, given in self.samples.items()}
        object.__setattr__(self, "samples", full)
        known, touch = measurable(self.rig), Touch(self.rig)
        for channel, (t, y) in self.samples.items():
            if channel not in known and channel not in touch:
                raise ValueError(
                    f"`{channel}` is not a channel of the rig of `{self.name}`; "
                    f"{suggestion(channel, known, 'known:')}, and of touch {touch.shown}"
                )
            if t.shape != y.shape or t.ndim != 1 or len(t) < 2:
                raise ValueError(
                    f"`{channel}` of `{self.name}` needs at least two samples, times and values "
                    "alike"
                )
            if not (np.isfinite(t).all() and np.isfinite(y).all()):
                raise ValueError(f"`{channel}` of `{self.name}` must have finite times and values")
            for i in np.flatnonzero(np.diff(t) <= 0)[:1]:
                raise ValueError(
                    f"times of `{channel}` of `{self.name}` must increase, but {t[i + 1]:.9g} s "
                    f"follows {t[i]:.9g} s: sort the samples, and leave out one of two at the same "
                    "time"
                )

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Recorded channels of runs: all measurable channels of the motion, and the sampled
        channels of touch."""
        motion = measurable(self.rig)
        return (*motion, *(channel for channel in self.samples if channel not in motion))

    @cached_property
    def units(self) -> dict[str, str]:
        """SI units of the rig's channels and signals."""
        touch = Touch(self.rig)
        return units(self.rig) | {name: touch.unit(name) for name in self.samples if name in touch}

    @cached_property
    def times(self) -> Array:
        """All times of samples (m,) [s]."""
        every = np.unique(np.concatenate([t for t, _ in self.samples.values()]))
        return every[np.append(True, np.diff(every) > SAME)]

    @property
    def run_start(self) -> float:
        """Initial time of the run [s]."""
        return float(self.times[0] - self.start.lead)

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.times[-1] - self.times[0])

    @cached_property
    def speed(self) -> float:
        """Root mean square speed of the horizontal set-points and drives [m/s]; slow recordings are
        easy to fit."""
        pairs = [pair for a in self.rig.actuators.values() for pair in a.follows]
        names = [setpoint for coordinate, setpoint in pairs if coordinate.endswith(".x")]
        names += [name for name in self.rig.signals if name.endswith(".x")]
        if not names:
            return 0.0
        t = torch.from_numpy(np.linspace(self.times[0], self.times[-1], 2000))
        return float(self.rig.reference(t, names)[..., 1].detach().square().mean().sqrt())

    @cached_property
    def start_coordinates(self) -> tuple[StartCoordinate, ...]:
        """Unknown coordinates of the start."""
        return self.start.coordinates(self.rig, self.samples)

    @cached_property
    def parameters(self) -> dict[str, float]:
        """Values that can be identified, by name: the rig's scalar parameters, under their aliases
        where they have one, and the start's coordinates."""
        names = {own: name for name, own in self.rig.names.items()}
        numbers = {
            names.get(own, own): float(value.detach())
            for own, value in self.rig.named_parameters()
            if value.ndim == 0 and not own.startswith("reference.")
        }
        return numbers | {c.name: c.mean for c in self.start_coordinates}

    def run_context(self) -> RunContext:
        """A copy of the rig, and the start of its runs."""
        rig = deepcopy(self.rig)
        for name, value in rig.named_parameters():
            value.requires_grad_(not name.startswith("reference."))
        initial = self.start.initial_state(rig, self.samples)
        return RunContext(rig, self.start, initial, self.channels)

    def on_a_grid(self, interpolated: bool) -> bool:
        """Whether to simulate a regular grid, every `BETWEEN`, in place of the samples' own times:
        where these are denser, or `interpolated`."""
        return interpolated or self.duration < 0.99 * BETWEEN * (len(self.times) - 1)

    def grid(self, interpolated: bool) -> Grid:
        """Times to simulate: the initial time, where it is before the samples, then the samples'
        own times, or a regular grid from `REACH` before the first, but not before the initial time,
        to `REACH` after the last."""
        t, lead = self.times, self.start.lead
        if self.on_a_grid(interpolated):
            t = np.arange(t[0] - min(REACH, lead), t[-1] + REACH + BETWEEN, BETWEEN)
        start = self.run_start
        early = int(t[0] - start > SAME)
        return Grid(torch.from_numpy(np.append([start] * early, t)), early)

    @cached_property
    def start_fingerprint(self) -> str:
        """Checksum of everything that determines the initial state, besides the unknowns."""
        return self._checksum(self.run_start)

    @cached_property
    def fingerprint(self) -> str:
        """Checksum of everything that determines a run or a residual of this recording."""
        measured = sorted(self.samples.items())
        rows = (k.encode() + t.tobytes() + y.tobytes() for k, (t, y) in measured)
        return self._checksum(np.linspace(self.run_start, self.times[-1], 2000), b"".join(rows))

    def _checksum(self, t: float | Array, measured: bytes = b"") -> str:
        """Checksum of the rig, of its signals at times t [s], of what was `measured` and of the
        start."""
        signals = self.rig.follow(torch.as_tensor(t)).detach().numpy().tobytes()
        return sha256(
            identity(self.rig) + signals + measured + repr(self.start).encode()
        ).hexdigest()


def extended(recording: Recording, names: Collection[str]) -> Recording:
    """The recording with more parameters of its rig, at their neutral values. Raises `ValueError`
    for a name that is not an extension of the rig."""
    rig = deepcopy(recording.rig)
    extend(rig, names)
    return replace(recording, rig=rig)


ARRAYS = np.ndarray, Tensor
VALUES = int, float, str, np.generic, tuple, list, dict, FunctionType, partial, type(None)
"""Types of attributes that identify a part."""


def identity(rig: Rig) -> bytes:
    """Identity of a rig without its reference: numbers and plain attributes of its parts, and the
    source of user-defined parts."""
    modules = rig.named_modules()
    parts = {name: part for name, part in modules if name.split(".")[0] != "reference"}
    text = [f"{name} {type(part).__qualname__} {plain(part)}" for name, part in parts.items()]
    text += [f"{name} {taxels}" for name, taxels in rig.taxels.items()]
    values = [getattr(v, "func", v) for part in parts.values() for v in vars(part).values()]
    code = [*map(type, parts.values()), *filter(inspect.isfunction, values)]
    own = {source(c) for c in code if c.__module__.split(".")[0] not in ("torch", "torchsoft")}
    return repr(text).encode() + b"".join(sorted(own))


def plain(part: nn.Module) -> str:
    """A part's own parameters and buffers, and its attributes that are numbers, text, arrays,
    functions or tuples of them, as text."""
    known: dict[str, Any] = dict(part.named_parameters(recurse=False))
    known |= dict(part.named_buffers(recurse=False))
    for name, value in vars(part).items():
        public = not name.startswith("_") and isinstance(value, VALUES)
        if name not in ("tables", "short") and (public or isinstance(value, ARRAYS)):
            known[name] = value  # no run depends on "tables" and "short"
    if isinstance(part, Pad):
        known["mesh"] = part.mesh.nodes.tolist(), part.mesh.bonded.tolist()
    return repr(sorted((name, stated(value)) for name, value in known.items()))


def stated(value: Any) -> Any:
    """A value in a form with a complete `repr`: an array as its checksum, a function as its name
    and the values that it holds."""
    if isinstance(value, ARRAYS):
        array = value.detach().numpy() if isinstance(value, Tensor) else value
        return array.shape, sha256(array.tobytes()).hexdigest()
    if isinstance(value, partial):
        return stated(value.func), [*map(stated, value.args)], stated(value.keywords)
    if isinstance(value, FunctionType):
        held = (value.__defaults__, value.__kwdefaults__, inspect.getclosurevars(value).nonlocals)
        return f"{value.__module__}.{value.__qualname__}", [*map(stated, held)]
    if isinstance(value, dict):
        return {key: stated(one) for key, one in value.items()}
    return [*map(stated, value)] if isinstance(value, tuple | list) else value


def source(code: Any) -> bytes:
    """Content of the file that defines a class or a function; empty for one typed in."""
    try:
        return Path(inspect.getfile(code)).read_bytes()
    except (OSError, TypeError):
        return b""
