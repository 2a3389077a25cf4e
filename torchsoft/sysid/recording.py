"""A recording: the rig that was there, where its run began, and the samples of the sensors, which
may have gaps."""

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
from torchsoft.physics.extensions import extend
from torchsoft.physics.pads import Pad
from torchsoft.physics.rig import Rig
from torchsoft.solve.touch import Touch
from torchsoft.solve.trajectory import measurable, units
from torchsoft.sysid.initial_state import AtRest, Begin, Start, StartCoordinate

Array = NDArray[np.float64]

BETWEEN = 1e-3
"""Spacing [s] of the regular grid that is simulated where samples are needed between (an unknown
delay), or are denser than it; a cubic spline lies between its points."""

REACH = 0.1
"""Largest delay [s] of a sensor: for so long before the first sample and after the last one runs
are known."""

SAME = 1e-9
"""Times [s] closer than this are one time."""


class RunContext(NamedTuple):
    """A rig of a run's own, where the run begins, and the channels that are looked at."""

    rig: Rig
    y0: Begin
    channels: tuple[str, ...]


class Grid(NamedTuple):
    """Times t (G,) [s] to simulate, and how many of them come before what is looked at."""

    t: Tensor
    early: int


REST = AtRest()


@dataclass(frozen=True)
class Recording:
    """One run of a rig, seen by sensors.

    `rig` has the known numbers and the nominal ones of what is unknown, the laws, and the reference
    that the run followed; runs are made of copies of it. `samples` holds times (k,) [s] and values
    (k,) by channel, each with times of its own; channels are those of the rig's trajectories that
    `measurable` names, and those of touch. `start` says where the run begins. `dataclasses.replace`
    makes variants, with another law, say.
    """

    name: str
    rig: Rig = field(repr=False)
    samples: dict[str, tuple[Array, Array]] = field(repr=False)
    start: Start = REST

    def __post_init__(self) -> None:
        if not self.samples:
            raise ValueError(f"recording `{self.name}` has no samples")
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
            if not (np.isfinite(t).all() and np.isfinite(y).all() and (np.diff(t) > 0).all()):
                raise ValueError(
                    f"`{channel}` of `{self.name}` must have finite values at increasing times"
                )

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """What runs are looked at for: what any sensor of this rig can measure of the motion, and
        the channels of touch that were sampled."""
        motion = measurable(self.rig)
        return (*motion, *(channel for channel in self.samples if channel not in motion))

    @cached_property
    def units(self) -> dict[str, str]:
        """SI units of the rig's channels and signals."""
        touch = Touch(self.rig)
        return units(self.rig) | {name: touch.unit(name) for name in self.samples if name in touch}

    @cached_property
    def times(self) -> Array:
        """Every time at which something was measured (m,) [s]."""
        every = np.unique(np.concatenate([t for t, _ in self.samples.values()]))
        return every[np.append(True, np.diff(every) > SAME)]

    @property
    def duration(self) -> float:
        """From the first to the last sample [s]."""
        return float(self.times[-1] - self.times[0])

    @cached_property
    def speed(self) -> float:
        """Root mean square of the speed of the horizontal setpoints and drives [m/s]: slow
        recordings are the easy ones."""
        pairs = [pair for a in self.rig.actuators.values() for pair in a.follows]
        names = [setpoint for coordinate, setpoint in pairs if coordinate.endswith(".x")]
        names += [name for name in self.rig.signals if name.endswith(".x")]
        if not names:
            return 0.0
        t = torch.from_numpy(np.linspace(self.times[0], self.times[-1], 2000))
        return float(self.rig.reference(t, names)[..., 1].detach().square().mean().sqrt())

    @cached_property
    def start_coordinates(self) -> tuple[StartCoordinate, ...]:
        """What is unknown of where the run begins."""
        return self.start.coordinates(self.rig, self.samples)

    @cached_property
    def parameters(self) -> dict[str, float]:
        """Every number that can be identified: the rig's scalar parameters, by their aliases where
        they have one, and the start's coordinates."""
        names = {own: name for name, own in self.rig.names.items()}
        mine = [
            (own, value)
            for own, value in self.rig.named_parameters()
            if not own.startswith("reference.")
        ]
        scalars = {names.get(own, own): value for own, value in mine if value.ndim == 0}
        numbers = {name: float(value.detach()) for name, value in scalars.items()}
        return numbers | {c.name: c.mean for c in self.start_coordinates}

    def begin(self) -> RunContext:
        """A copy of the rig, and where its runs begin."""
        rig = deepcopy(self.rig)
        for name, value in rig.named_parameters():
            value.requires_grad_(not name.startswith("reference."))
        return RunContext(rig, self.start.begin(rig, self.samples), self.channels)

    def on_a_grid(self, interpolated: bool) -> bool:
        """Whether a regular grid is simulated, every `BETWEEN`, in place of the samples' own times:
        where they are denser, or values between them are needed (`interpolated`)."""
        return interpolated or self.duration < 0.99 * BETWEEN * (len(self.times) - 1)

    def grid(self, interpolated: bool) -> Grid:
        """The times to simulate: the beginning, where that is before the samples, then the samples'
        own times, or a regular grid from `REACH` before the first, but not from before the
        beginning, to `REACH` after the last."""
        t, lead = self.times, self.start.lead
        if self.on_a_grid(interpolated):
            t = np.arange(t[0] - min(REACH, lead), t[-1] + REACH + BETWEEN, BETWEEN)
        begin = self.times[0] - lead
        early = int(t[0] - begin > SAME)
        return Grid(torch.from_numpy(np.append([begin] * early, t)), early)

    @cached_property
    def fingerprint(self) -> str:
        """Names everything that decides a run or a residual of this recording."""
        t = torch.from_numpy(np.linspace(self.times[0] - self.start.lead, self.times[-1], 2000))
        signals = self.rig.follow(t).detach().numpy().tobytes()
        measured = b"".join(
            k.encode() + t.tobytes() + y.tobytes() for k, (t, y) in sorted(self.samples.items())
        )
        return sha256(
            identity(self.rig) + signals + measured + repr(self.start).encode()
        ).hexdigest()


def extended(recording: Recording, names: Collection[str]) -> Recording:
    """The recording of a rig with more parameters, at their neutral values. Raises `ValueError` for
    a name that the rig has no extension of."""
    rig = deepcopy(recording.rig)
    extend(rig, names)
    return replace(recording, rig=rig)


def identity(rig: Rig) -> bytes:
    """What a rig is made of: its parts' numbers and plain attributes, but for the reference, and
    the files with the code of parts that are the user's own."""
    parts = [
        (name, part) for name, part in rig.named_modules() if name.split(".")[0] != "reference"
    ]
    text = [f"{name} {type(part).__qualname__} {plain(part)}" for name, part in parts]
    text += [f"{name} {taxels}" for name, taxels in rig.taxels.items()]
    values = [getattr(v, "func", v) for _, part in parts for v in vars(part).values()]
    functions = [value for value in values if inspect.isfunction(value)]
    code = {
        f"{one.__module__}.{one.__qualname__}": one
        for one in (*(type(part) for _, part in parts), *functions)
    }
    own = {
        name: one for name, one in code.items() if name.split(".")[0] not in ("torch", "torchsoft")
    }
    return repr(text).encode() + b"".join(name.encode() + source(own[name]) for name in sorted(own))


ARRAYS = np.ndarray, Tensor
VALUES = int, float, str, np.generic, tuple, list, dict, FunctionType, partial, type(None)
"""Attributes that name a part."""


def plain(part: nn.Module) -> str:
    """A part's own parameters and buffers, and its attributes that are numbers, text, arrays,
    functions or tuples of them."""
    tensors = {
        **dict(part.named_parameters(recurse=False)),
        **dict(part.named_buffers(recurse=False)),
    }
    known: dict[str, Any] = {name: value.tolist() for name, value in tensors.items()}
    for name, value in vars(part).items():
        if isinstance(value, ARRAYS) or (not name.startswith("_") and isinstance(value, VALUES)):
            known[name] = stated(value)
    if isinstance(part, Pad):
        known["mesh"] = part.mesh.nodes.tolist(), part.mesh.bonded.tolist()
    return repr(sorted(known.items()))


def stated(value: Any) -> Any:
    """A value as its `repr` says all of it: an array by its checksum, a function by its name and
    the values that it holds."""
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
    """The file that a class or a function stands in; empty where it was typed in."""
    try:
        return Path(inspect.getfile(code)).read_bytes()
    except (OSError, TypeError):
        return b""
