"""Rate-and-state friction: the ageing law of Dieterich (J. Geophys. Res. 84, 1979), regularised at
rest (Lapusta et al., J. Geophys. Res. 105, 2000).

A contact point has a state of its own, the age theta [s] of its asperities. At a steady slip rate V
friction is mu_0 + (a - b) ln(V / V_0); after a jump of V it rises by a at once and falls by b over
the slip D_c.
"""

from typing import Annotated, ClassVar

import torch
from torch import Tensor, nn

from torchsoft.physics.shapes import parameter
from torchsoft.physics.state import OwnState
from torchsoft.quantity import FrictionCoefficient, Quantity

ITERATIONS = 9
"""Newton steps for the slip rate: of 200,000 random points none was left with an error above 1e-9
of its effort (a from 0.001 to 0.03, b up to 2 a, efforts from 1e-6 to 100 N)."""

YOUNGEST = 1e-20
"""Age [s] that is added to others: the logarithm of an age that has just started is finite."""

SMALLEST = 1e-300
"""Effort [N] that keeps the logarithm of none finite."""


class RateAndState(nn.Module):
    """The slip element: R |gamma'| + mu F_N = E with

        mu = a asinh(|gamma'| / (2 V_0) exp((mu_0 + b ln(V_0 theta / D_c)) / a)),
        theta' = 1 - |gamma'| theta / D_c.

    The age starts with zero at touch-down (`SoftContact`), so that a point which enters a sliding
    contact has the age D_c / V of steady slip after a few D_c, whatever it did before. Friction of
    a body that slides over nodes is then that of one with a single age, but for b D_c over the
    contact's length, and a spring slider has the growth rates of linear theory. Friction has no
    threshold: below mu_0 F_N a point creeps, the slower the lower the effort by a, and counts as
    slipping. Smooth. The slip rate is single-valued where the dashpot and the tangential spring
    outweigh the fall of friction with slip, which needs K_t >= (b - a) F_N / D_c in a weakening
    contact. `theta_0` is the age at the start of points in contact.
    """

    states: ClassVar = {"theta": OwnState("s", "theta_0")}
    ages: ClassVar = True

    def __init__(
        self,
        mu_0: Annotated[FrictionCoefficient, "friction of steady slip at the rate V_0"],
        a: Annotated[
            float, Quantity("1", 1e-4, 1.0, "direct effect: rise of friction with ln of slip rate")
        ],
        b: Annotated[
            float, Quantity("1", 0.0, 1.0, "evolution effect: rise of friction with ln of age")
        ],
        D_c: Annotated[float, Quantity("m", 1e-9, 1.0, "slip over which the age is renewed")],
        V_0: Annotated[float, Quantity("m/s", 1e-12, 1e3, "slip rate of mu_0")] = 1e-6,
        theta_0: Annotated[float, Quantity("s", 1e-12, 1e12, "age of contacts at the start")] = 1.0,
    ) -> None:  # fmt: skip
        super().__init__()
        self.mu_0 = parameter(mu_0, "mu_0")
        self.a, self.b = parameter(a, "a"), parameter(b, "b")
        self.D_c = parameter(D_c, "D_c")
        self.V_0 = parameter(V_0, "V_0", trained=False)
        self.theta_0 = parameter(theta_0, "theta_0")

    def strength(self, theta: Tensor) -> Tensor:
        """ln of exp((mu_0 + b ln(V_0 theta / D_c)) / a) / V_0, of ages theta (...) [s]."""
        age = torch.log(theta / self.D_c * self.V_0)
        return (self.mu_0 + self.b * age) / self.a - torch.log(self.V_0)

    def jumps(self, F_N: float, R_t: Tensor, K_t: Tensor) -> str:
        """Why the slip rate jumps under F_N [N] between a dashpot [N.s/m] and a spring [N/m]; empty
        if it does not."""
        falls, holds = ((self.b - self.a) * F_N / self.D_c).item(), K_t.item()
        if holds >= falls:
            return ""
        return f"K_t = {holds:.3g} N/m is below (b - a) F_N / D_c = {falls:.3g}; raise K_t or D_c"

    def forward(
        self, E: Tensor, F_N: Tensor, R: Tensor, z: Tensor, stage: Tensor | float
    ) -> tuple[Tensor, Tensor]:
        """Slip rate (...) [m/s] and theta' (..., 1), with the age at the end of the stage."""
        theta, presses = z[..., 0] + YOUNGEST, F_N > 0
        E, A = E + SMALLEST, torch.where(presses, self.a * F_N, 1.0)
        x = torch.log(E / R)  # ln of the slip rate, at most: where nothing presses
        # where friction alone takes the effort, with the age of the fastest slip
        y = E / A
        held = y + torch.log(-torch.expm1(-2 * y)) - self.strength(self.aged(theta, stage, x))
        x = torch.where(presses, torch.minimum(x, held), x)
        for _ in range(ITERATIONS):
            V, age = torch.exp(x), self.aged(theta, stage, x)
            rise, slope = asinh_of_exp(x + self.strength(age))
            fall = self.b / self.a * age * stage * V / (self.D_c * (theta + stage))
            step = (R * V + A * rise - E) / (R * V + A * slope * (1 - fall))
            x = torch.where(presses, x - step.clamp(-4.0, 4.0), x)
        V = torch.exp(x)
        return V, (1 - V * self.aged(theta, stage, x) / self.D_c)[..., None]

    def aged(self, theta: Tensor, stage: Tensor | float, x: Tensor) -> Tensor:
        """Age [s] at the end of a stage that begins with theta, under the slip rate e^x [m/s]."""
        return (theta + stage) / (1 + stage * torch.exp(x) / self.D_c)


def asinh_of_exp(w: Tensor) -> tuple[Tensor, Tensor]:
    """asinh(e^w / 2) and its derivative by w."""
    large, u = torch.exp(-2 * w.clamp(min=0.0)), 0.5 * torch.exp(w.clamp(max=0.0))
    root, below = torch.sqrt(large + 0.25), torch.sqrt(1 + u * u)
    value = torch.where(w > 0, w + torch.log(0.5 + root), torch.log1p(u + u * u / (1 + below)))
    return value, torch.where(w > 0, 0.5 / root, u / below)
