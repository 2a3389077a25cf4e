"""A recording: the reference that the controllers followed and the samples of the sensors, which may have gaps."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.channels import MEASURED
from torchsoft.excitation import start
from torchsoft.parameters import Parameters
from torchsoft.physics.motion import Reference
from torchsoft.physics.pads import Pad
from torchsoft.physics.paper import NAMES, SoftGrasp
from torchsoft.physics.state import State

Array = NDArray[np.float64]

Build = Callable[[Parameters, Reference], SoftGrasp]
"""Makes the model of a recording from its settings and reference: `SoftGrasp` itself, or a function that gives it laws of the
user's own, such as a friction law."""

SETTLE = 0.2
"""Time [s] that the disc is given, before the first sample, to sink into the pad: twenty of the pads' own times 1/tau."""

BETWEEN = 1e-3
"""Spacing [s] of the regular grid that is simulated where samples are needed between (an unknown delay), or are denser than it;
a cubic spline lies between its points."""

REACH = 0.1
"""Largest delay [s] of a sensor: for so long before the first sample and after the last one runs are known."""

SAME = 1e-9
"""Times [s] closer than this are one time."""


class Start(NamedTuple):
    """A model and where it starts: the state, and by massless pad the displacements (2 nodes,) [m], E depth [N/m] and nu that
    its forces belong to."""

    model: SoftGrasp
    state: State
    held: dict[str, tuple[Tensor, float, float]]

    @property
    def y0(self) -> Tensor:
        """The state (size,) from which to simulate, with its derivative by the model's parameters: displacements stay when
        parameters change, and massless pads get the forces that hold them so."""
        pads = dict(self.state.pads)
        for name, (u, stiffness, nu) in self.held.items():
            pads[name] = held_forces(self.model.pads[name], pads[name], u, stiffness, nu)
        return self.model.pack(self.state._replace(pads=pads))


def held_forces(pad: Pad, z: Tensor, u: Tensor, stiffness: float, nu: float) -> Tensor:
    """Forces z (branches, nodes, 2) [N] for the pad's present material, at the displacements u that they made before.

    They are in proportion to E depth, which needs no linear solve: a solve's last bits differ from call to call, and a run that
    is made again must be the same.
    """
    material = pad.material
    if float(material.nu.detach()) != nu:
        f = torch.linalg.solve(pad.compliance(), u)
        f = torch.round(f.detach(), decimals=9) + (f - f.detach())
        return f.unflatten(0, (-1, 2)).expand(z.shape)
    scaled = z * (material.E * material.depth / stiffness)
    C, dC = pad.unit_compliance()
    by_nu = -torch.linalg.solve(C, dC @ scaled.detach().flatten(-2).mT).mT.reshape(z.shape)
    return scaled + by_nu * (material.nu - material.nu.detach())


def lying(model: SoftGrasp) -> Start:
    """The disc at rest on the lower pad and the bracket clear of it, by the model's own parameters."""
    state, held = model.unpack(start(model).detach()), {}
    for name, pad in model.pads.items():
        if not pad.inertial:
            material = pad.material
            u = model.displacement(name, state).detach().flatten()
            held[name] = u, float((material.E * material.depth).detach()), float(material.nu.detach())
    return Start(model, state, held)


@dataclass(frozen=True)
class Recording:
    """One run of the rig, begun with the disc at rest on the lower pad and the bracket clear of it.

    `settings` are the known numbers, and the nominal ones of what is unknown; `samples` holds times (k,) [s] and values (k,)
    by channel, each with times of its own. The run is simulated from `SETTLE` before the first sample, from where
    nominal parameters would have disc and pads at rest: most of what that gets wrong has died away at the first sample. `build`
    makes the model.
    """

    name: str
    settings: Parameters
    reference: Reference
    samples: dict[str, tuple[Array, Array]]
    build: Build = SoftGrasp

    def __post_init__(self) -> None:
        if not self.samples:
            raise ValueError(f"recording `{self.name}` has no samples")
        for channel, (t, y) in self.samples.items():
            if channel not in MEASURED:
                raise ValueError(f"`{channel}` is not a channel; known: {', '.join(MEASURED)}")
            if t.shape != y.shape or t.ndim != 1 or len(t) < 2:
                raise ValueError(f"`{channel}` of `{self.name}` needs at least two samples, times and values alike")
            if not (np.isfinite(t).all() and np.isfinite(y).all() and (np.diff(t) > 0).all()):
                raise ValueError(f"`{channel}` of `{self.name}` must have finite values at increasing times")

    @property
    def times(self) -> Array:
        """Every time at which something was measured (m,) [s]."""
        every = np.unique(np.concatenate([t for t, _ in self.samples.values()]))
        return every[np.append(True, np.diff(every) > SAME)]

    @property
    def duration(self) -> float:
        """From the first to the last sample [s]."""
        return float(self.times[-1] - self.times[0])

    @property
    def speed(self) -> float:
        """Root mean square of the horizontal speed of the set-point [m/s]: slow recordings are the easy ones."""
        t = torch.from_numpy(np.linspace(self.times[0], self.times[-1], 2000))
        return float(self.reference(t, ("x_d",))[..., 1].detach().square().mean().sqrt())

    @property
    def fingerprint(self) -> str:
        """Names everything that decides a run or a residual of this recording."""
        t = torch.from_numpy(np.linspace(self.times[0] - SETTLE, self.times[-1], 2000))
        setpoints = self.reference(t, ("x_d", "y_d", "F_ff")).detach().numpy().tobytes()
        measured = b"".join(k.encode() + t.tobytes() + y.tobytes() for k, (t, y) in sorted(self.samples.items()))
        return sha256(self.settings.model_dump_json().encode() + setpoints + measured + self._own_laws()).hexdigest()

    def _own_laws(self) -> bytes:
        """What `build` makes: the model's numbers, and the files with the code of `build`, of its modules and functions."""
        if self.build is SoftGrasp:
            return b""
        model = self.build(self.settings, self.reference)
        modules = list(model.modules())
        functions = [value for module in modules for value in vars(module).values() if inspect.isfunction(value)]
        code = {getattr(self.build, "func", self.build), *map(type, modules), *functions}
        named = {f"{one.__module__}.{one.__qualname__}": one for one in code}
        own = {name: one for name, one in named.items() if name.split(".")[0] not in ("torch", "torchsoft")}
        numbers = {name: value.tolist() for name, value in model.named_parameters()}
        return repr((sorted(named), numbers)).encode() + b"".join(source(own[name]) for name in sorted(own))

    @cached_property
    def parameters(self) -> dict[str, float]:
        """Every number of the model that can be identified, by its name in `Parameters`, or in the model where that is all."""
        model = self.build(self.settings, self.reference)
        names = {own: name for name, own in NAMES.items()}
        known = {names.get(own, own): value for own, value in model.named_parameters() if value.requires_grad}
        return {name: float(value.detach()) for name, value in known.items() if value.ndim == 0}

    def begin(self) -> Start:
        """A model with the settings and the reference, and where it starts."""
        return lying(self.build(self.settings, self.reference))

    def on_a_grid(self, interpolated: bool) -> bool:
        """Whether a regular grid is simulated, every `BETWEEN`, in place of the samples' own times: where they are denser, or
        values between them are needed (`interpolated`)."""
        return interpolated or self.duration < 0.99 * BETWEEN * (len(self.times) - 1)

    def grid(self, interpolated: bool) -> Tensor:
        """Times (G,) [s] to simulate: `SETTLE` before the first sample, then the samples' own, or a regular grid from `REACH`
        before the first to `REACH` after the last."""
        t = self.times
        around = np.arange(t[0] - REACH, t[-1] + REACH + BETWEEN, BETWEEN) if self.on_a_grid(interpolated) else t
        return torch.from_numpy(np.concatenate(([t[0] - SETTLE], around)))


def source(code: Any) -> bytes:
    """The file that a class or a function stands in; empty where it was typed in."""
    try:
        return Path(inspect.getfile(code)).read_bytes()
    except (OSError, TypeError):
        return b""
