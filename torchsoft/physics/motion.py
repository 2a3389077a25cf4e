"""What a rig is asked to do: signals of time, such as the paper's 7th-order profiles (Eq. 20-29)."""

from collections.abc import Sequence

import torch
from scipy.interpolate import CubicSpline
from torch import Tensor, nn


class Profile(nn.Module):
    """A signal that goes from value to value along 7th-order polynomials, at rest (rate, second and third derivative
    zero) at every knot (Eq. 20-29); constant before the first knot and after the last.

    times (k,) [s] strictly increasing, values (k,). Raises `ValueError` for anything else.
    """

    times: Tensor
    values: Tensor

    def __init__(self, times: Sequence[float] | Tensor, values: Sequence[float] | Tensor) -> None:
        super().__init__()
        knots = torch.as_tensor(times, dtype=torch.float64)
        if knots.ndim != 1 or not bool(torch.all(knots.diff() > 0)) or not bool(torch.isfinite(knots).all()):
            raise ValueError(f"`times` must increase strictly, but are {times}")
        listed = values if isinstance(values, Tensor) else [torch.as_tensor(v, dtype=torch.float64) for v in values]
        many = listed if isinstance(listed, Tensor) else torch.stack(listed) if listed else torch.zeros(0)
        if many.shape != knots.shape or not bool(torch.isfinite(many).all()):
            raise ValueError(f"`values` must hold one finite number per time ({len(knots)}), but are {values}")
        self.register_buffer("times", knots)
        # a tensor with a graph keeps it; anything else becomes a parameter that is not trained unless asked for
        self.values = many.double() if many.requires_grad else nn.Parameter(many.double(), requires_grad=False)

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Value and rate at t (...)."""
        if len(self.times) == 1:
            return self.values[0].expand(t.shape), torch.zeros_like(t)
        i = torch.searchsorted(self.times, t.detach().contiguous(), right=True).clamp(1, len(self.times) - 1)
        span = self.times[i] - self.times[i - 1]
        u = ((t - self.times[i - 1]) / span).clamp(0.0, 1.0)
        start, step = self.values[i - 1], self.values[i] - self.values[i - 1]
        blend = u**4 * (35.0 + u * (-84.0 + u * (70.0 - 20.0 * u)))  # (20) with (22)-(24)
        rate = 140.0 * u**3 * (1.0 - u) ** 3 / span  # (21)
        return start + step * blend, step * rate


class Sampled(Profile):
    """A recorded set-point: the cubic through values (k,) at times (k,) [s] with the given rates (k,), or with those of the
    natural choice, a cubic spline; constant before the first and after the last."""

    rates: Tensor

    def __init__(
        self,
        times: Sequence[float] | Tensor,
        values: Sequence[float] | Tensor,
        rates: Sequence[float] | Tensor | None = None,
    ) -> None:
        super().__init__(times, values)
        if rates is None:
            rates = CubicSpline(times, values).derivative()(times).tolist() if len(times) > 1 else [0.0]
        slope = torch.as_tensor(rates, dtype=torch.float64)
        if slope.shape != self.times.shape or not bool(torch.isfinite(slope).all()):
            raise ValueError(f"`rates` must hold one finite number per time ({len(self.times)}), but are {rates}")
        self.register_buffer("rates", slope)

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Value and rate at t (...)."""
        if len(self.times) == 1:
            return super().forward(t)
        i = torch.searchsorted(self.times, t.detach().contiguous(), right=True).clamp(1, len(self.times) - 1)
        span = self.times[i] - self.times[i - 1]
        u = (t - self.times[i - 1]) / span
        inside = ((u >= 0) & (u <= 1)).to(t.dtype)
        u = u.clamp(0.0, 1.0)
        a, step = self.values[i - 1], self.values[i] - self.values[i - 1]
        p, q = span * self.rates[i - 1] - step, step - span * self.rates[i]
        value = a + u * step + u * (1 - u) * ((1 - u) * p + u * q)
        rate = (step + (1 - 2 * u) * ((1 - u) * p + u * q) + u * (1 - u) * (q - p)) / span
        return value, rate * inside


class Reference(nn.Module):
    """What a rig is asked to do: named signals of time, setpoints, feed-forward efforts and driven coordinates.

    Raises `ValueError` for a signal that is not a module giving (value, rate) at t.
    """

    def __init__(self, **signals: nn.Module) -> None:
        super().__init__()
        for name, signal in signals.items():
            if not isinstance(signal, nn.Module):
                raise ValueError(
                    f"the signal `{name}` must be a module such as `Profile`, but is {type(signal).__name__}"
                )
        self.signals = nn.ModuleDict({name.replace(".", ":"): signal for name, signal in signals.items()})

    def forward(self, t: Tensor, names: Sequence[str]) -> Tensor:
        """Values and rates (..., names, 2) at t (...) [s]. Raises `ValueError` for a signal that is not there."""
        rows = []
        for name in names:
            if name.replace(".", ":") not in self.signals:
                known = ", ".join(key.replace(":", ".") for key in self.signals) or "none"
                raise ValueError(f"the reference has no signal `{name}`; it has {known}")
            rows.append(self._asked(name, t))
        return torch.stack(rows, -2) if rows else t.new_zeros((*t.shape, 0, 2))

    def _asked(self, name: str, t: Tensor) -> Tensor:
        """Value and rate (..., 2) of one signal."""
        given = self[name](t)
        if not isinstance(given, tuple) or len(given) != 2 or not all(isinstance(x, Tensor) for x in given):
            raise ValueError(
                f"the signal `{name}` must give two tensors, value and rate, but gives {type(given).__name__}"
            )
        for x in given:
            if x.shape != t.shape or x.dtype != torch.float64:
                raise ValueError(
                    f"the signal `{name}` must give float64 of shape {tuple(t.shape)}, but gives {x.dtype} of {tuple(x.shape)}"
                )
        return torch.stack(given, -1)

    def __getitem__(self, name: str) -> nn.Module:
        return self.signals[name.replace(".", ":")]


def hold(**values: float) -> Reference:
    """The reference that stays where it is."""
    return Reference(**{name: Profile([0.0], [value]) for name, value in values.items()})
