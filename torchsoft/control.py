"""Reference trajectories and the two PD controllers (Eq. 20-34)."""

from typing import NamedTuple

import torch
from scipy.interpolate import CubicSpline
from torch import Tensor, nn

from torchsoft.parameters import ControlParameters


class Setpoint(NamedTuple):
    """What the controllers want at one time, each of t's shape: x_d, x_d', y_Br,d, y_Br,d' and the feed-forward F_y."""

    x: Tensor
    x_dot: Tensor
    y: Tensor
    y_dot: Tensor
    F_y: Tensor


class Profile(nn.Module):
    """A signal that goes from value to value along 7th-order polynomials, at rest (rate, second and third derivative
    zero) at every knot (Eq. 20-29); constant before the first knot and after the last.

    times (k,) [s] strictly increasing, values (k,). Raises `ValueError` for anything else.
    """

    times: Tensor

    def __init__(self, times: list[float], values: list[float] | Tensor) -> None:
        super().__init__()
        knots = torch.as_tensor(times, dtype=torch.float64)
        if knots.ndim != 1 or not bool(torch.all(knots.diff() > 0)) or not bool(torch.isfinite(knots).all()):
            raise ValueError(f"`times` must increase strictly, but are {times}")
        value = torch.as_tensor(values, dtype=torch.float64)
        if value.shape != knots.shape or not bool(torch.isfinite(value).all()):
            raise ValueError(f"`values` must hold one finite number per time ({len(knots)}), but are {values}")
        self.register_buffer("times", knots)
        self.values = nn.Parameter(value, requires_grad=False)

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

    def __init__(self, times: list[float], values: list[float], rates: list[float] | None = None) -> None:
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
    """x_d(t) of the disc, y_Br,d(t) of the bracket, and the vertical effort F_y(t) fed forward to the bracket."""

    def __init__(self, x: Profile, y: Profile, F_y: Profile) -> None:
        super().__init__()
        self.x, self.y, self.F_y = x, y, F_y

    def forward(self, t: Tensor) -> Setpoint:
        x, x_dot = self.x(t)
        y, y_dot = self.y(t)
        return Setpoint(x, x_dot, y, y_dot, self.F_y(t)[0])


def hold(x: float, y: float, F_y: float = 0.0) -> Reference:
    """The reference that stays where it is."""
    return Reference(Profile([0.0], [x]), Profile([0.0], [y]), Profile([0.0], [F_y]))


class Controllers(nn.Module):
    """The PD loops: the vertical one about the bracket, the horizontal one about the disc (or, by `senses`, about the bracket
    as well), both acting on the bracket."""

    def __init__(self, p: ControlParameters) -> None:
        super().__init__()
        self.senses = p.senses
        self.K_81, self.R_80, self.K_98, self.R_99 = (
            nn.Parameter(torch.tensor(value, dtype=torch.float64)) for value in (p.K_81, p.R_80, p.K_98, p.R_99)
        )

    def forward(self, want: Setpoint, r_C: Tensor, v_C: Tensor, r_Br: Tensor, v_Br: Tensor) -> tuple[Tensor, Tensor]:
        """Forces F_x, F_y [N] on the bracket, shape (...)."""
        E_v, E_v_dot = want.y - r_Br[..., 1], want.y_dot - v_Br[..., 1]  # (31)
        F_y = self.K_98 * E_v + self.R_99 * E_v_dot + want.F_y  # (32) and the feed-forward
        r, v = (r_C, v_C) if self.senses == "disc" else (r_Br, v_Br)
        E_h, E_h_dot = want.x - r[..., 0], want.x_dot - v[..., 0]  # (33)
        return self.K_81 * E_h + self.R_80 * E_h_dot, F_y  # (34)
