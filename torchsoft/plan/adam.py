"""Projected Adam, for plans with many variables and for designed motions."""

from collections.abc import Callable

import torch

from torchsoft.plan.knots import Array


class ProjectedAdam:
    """Adam from a point z (n,) with projection by `nearest`. `memory` holds the decay rates of the
    first and second moments of the gradient."""

    def __init__(
        self, start: Array, nearest: Callable[[Array], Array], memory: tuple[float, float]
    ) -> None:
        self._z = torch.from_numpy(start.copy()).requires_grad_()
        self._adam, self._nearest = torch.optim.Adam([self._z], betas=memory), nearest

    @property
    def z(self) -> Array:
        return self._z.detach().numpy().copy()

    def step(self, slope: Array, rate: float) -> None:
        """Step against the gradient (n,), each variable by about `rate`."""
        self._adam.param_groups[0]["lr"] = rate
        self._z.grad = torch.from_numpy(slope)
        self._adam.step()
        self.set(self._nearest(self.z))

    def set(self, z: Array) -> None:
        """Move to another point and keep the moments of the gradient."""
        self._z.data.copy_(torch.from_numpy(z))
