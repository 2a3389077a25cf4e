"""Adam within bounds, of plans with many variables and of designed motions."""

from collections.abc import Callable

import torch

from torchsoft.plan.knots import Array


class ProjectedAdam:
    """A point z (n,) that Adam moves, and that `nearest` brings back within bounds. `memory` is how
    much of the slopes, and of their squares, is remembered from one step to the next."""

    def __init__(
        self, start: Array, nearest: Callable[[Array], Array], memory: tuple[float, float]
    ) -> None:
        self._z = torch.from_numpy(start.copy()).requires_grad_()
        self._adam, self._nearest = torch.optim.Adam([self._z], betas=memory), nearest

    @property
    def z(self) -> Array:
        return self._z.detach().numpy().copy()

    def step(self, slope: Array, rate: float) -> None:
        """Against the slope (n,), each number by about `rate`."""
        self._adam.param_groups[0]["lr"] = rate
        self._z.grad = torch.from_numpy(slope)
        self._adam.step()
        self.set(self._nearest(self.z))

    def set(self, z: Array) -> None:
        """Go to another point, and remember the slopes."""
        self._z.data.copy_(torch.from_numpy(z))
