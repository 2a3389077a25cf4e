"""A recording: the reference that the controllers followed and the samples of the sensors, which may have gaps."""

from dataclasses import dataclass
from hashlib import sha256

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.channels import MEASURED
from torchsoft.control import Reference
from torchsoft.excitation import start
from torchsoft.model import SoftGrasp
from torchsoft.parameters import Parameters

Array = NDArray[np.float64]

SETTLE = 0.2
"""Time [s] that the disc is given, before the first sample, to sink into the pad: twenty of the pads' own times 1/tau."""

SPACINGS = 4
"""A recording whose samples are spaced in more ways than this is simulated on a regular grid and interpolated."""

SAME = 1e-9
"""Times [s] closer than this are one time."""


@dataclass(frozen=True)
class Recording:
    """One run of the rig, begun with the disc at rest on the lower pad and the bracket clear of it.

    `settings` are the known numbers, and the nominal ones of what is unknown; `samples` holds times (k,) [s] and values (k,)
    by channel, each with times of its own. The run is simulated from `SETTLE` before the first sample, at rest as nominal
    parameters would have it: what that gets wrong has died away by then, so the start needs no derivative.
    """

    name: str
    settings: Parameters
    reference: Reference
    samples: dict[str, tuple[Array, Array]]

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
        return float(self.reference(t).x_dot.detach().square().mean().sqrt())

    @property
    def fingerprint(self) -> str:
        """Names everything that decides a run or a residual of this recording."""
        t = torch.from_numpy(np.linspace(self.times[0] - SETTLE, self.times[-1], 2000))
        setpoints = torch.stack(self.reference(t)).detach().numpy().tobytes()
        measured = b"".join(k.encode() + t.tobytes() + y.tobytes() for k, (t, y) in sorted(self.samples.items()))
        return sha256(self.settings.model_dump_json().encode() + setpoints + measured).hexdigest()

    def begin(self) -> tuple[SoftGrasp, Tensor]:
        """A model with the settings and the reference, and the state (size,) from which to simulate."""
        model = SoftGrasp(self.settings, self.reference)
        return model, start(model).detach()

    def grid(self, step: float, interpolated: bool) -> Tensor:
        """Times (G,) [s] to simulate: `SETTLE` before the first sample, then the samples' own times, or, where they are
        irregular or needed between (`interpolated`), every `step` [s] from a little before the first to after the last."""
        t = self.times
        if not interpolated and len(np.unique(np.round(np.diff(t) / SAME).astype(np.int64))) <= SPACINGS:
            return torch.from_numpy(np.concatenate(([t[0] - SETTLE], t)))
        around = np.arange(t[0] - 10 * step, t[-1] + 11 * step, step)
        return torch.from_numpy(np.concatenate(([t[0] - SETTLE], around)))
