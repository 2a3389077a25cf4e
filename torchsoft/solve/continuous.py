"""The continuous adjoint, guarded: `torchdiffeq.odeint_adjoint` with an explicit method on `forward`, short windows only.

The continuous adjoint integrates the state backwards between two outputs. Backwards a dissipative system grows, at its
stiffest rate: the error grows by exp(rate x output spacing), and the gradient is lost without any other sign.
"""

import torch
from torch import Tensor, nn
from torchdiffeq import odeint_adjoint

from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig

LONGEST = 5.0
"""Largest stiffest rate x output spacing for which the continuous adjoint is any good."""


class OutputsTooCoarse(ValueError):
    """Output times too far apart for the state to be integrated backwards between them."""


class _Following(nn.Module):
    """A rig under a reference, as torchdiffeq takes it."""

    def __init__(self, rig: Rig, reference: Reference) -> None:
        super().__init__()
        self.rig, self.reference = rig, reference

    def forward(self, t: Tensor, y: Tensor) -> Tensor:
        return self.rig(t, y, self.reference)


@torch.no_grad()
def stiffest_rate(rig: Rig, y: Tensor, time: float = 0.0, *, iterations: int = 30) -> float:
    """Largest |eigenvalue| [1/s] of the right-hand side's Jacobian at one state (size,), by power iteration.

    Along differences of `forward` that are small against penetrations; rates of nodes that are not slipping at y, but soon
    will be (K_t / eta), are not in it.
    """
    size = torch.full_like(y, 1e-9)
    for (part, name), where in rig.layout.slices.items():
        if part == "pads" and not rig.pads[name].inertial:
            size[where] /= float(rig.pads[name].compliance().diagonal().max())
    v = torch.randn(y.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    base, rate = rig(time, y), 0.0
    for _ in range(iterations):
        v = v / v.norm()
        v = (rig(time, y + size * v) - base) / size
        rate = float(v.norm())
    return rate


def continuous_solution(
    rig: Rig, y0: Tensor, t: Tensor, reference: Reference | None = None, *, step: float = 0.0, method: str = "dopri5",
    rtol: float = 1e-8, atol: float = 1e-11,
) -> Tensor:  # fmt: skip
    """States (T, size) at t (T,) by an explicit method of torchdiffeq, with the continuous adjoint behind them; `step` is not
    used. Raises `OutputsTooCoarse` when the stiffest rate at y0 times the widest output interval exceeds `LONGEST`."""
    rate, widest = stiffest_rate(rig, y0.detach(), float(t[0])), float(t.diff().max())
    if rate * widest > LONGEST:
        raise OutputsTooCoarse(
            f"the stiffest rate at y0 is {rate:.3g} 1/s and outputs are up to {widest:.3g} s apart: {rate * widest:.3g} > "
            f"{LONGEST:g}, where the continuous adjoint loses the gradient. Ask for outputs at most {LONGEST / rate:.2g} s "
            "apart, or use gradient='discrete'"
        )
    following = _Following(rig, reference or rig.reference)
    return odeint_adjoint(following, y0, t, method=method, rtol=rtol, atol=atol)  # pyright: ignore[reportReturnType]
