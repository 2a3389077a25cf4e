"""Smooth friction that ages: static friction grows with the logarithm of the time at rest
(Rabinowicz, Proc. Phys. Soc. 71, 1958), and slip renews it."""

from typing import Annotated, ClassVar

import torch
from torch import Tensor

from torchsoft.physics.contact import FallingSpeed, KineticFriction, SmoothSlip, StaticFriction
from torchsoft.physics.shapes import parameter
from torchsoft.physics.state import OwnState
from torchsoft.quantity import Quantity

ITERATIONS, STEEP, SETTLED = 8, 0.99, 1e-9
"""Secant steps for the slip rate, the largest slope that they count with, and the part of the rate
below which a step tells no slope: of 200,000 random points that spring and dashpot hold none was
left with an error above 1e-9 of its effort."""

DIFFERENTIATED = 2
"""Last of these steps that are differentiated: each leaves a part of the derivative's error that is
the relative error of the slope."""


class AgeingSlip(SmoothSlip):
    """Smooth slip whose static friction is

        mu_s + ageing ln(1 + age / t_0),    age' = 1 - |gamma'| age / D_c

    so that it rises by `ageing` for every factor e of the time at rest beyond t_0. The age is a
    state of every point [s], zero at touch-down (`SoftContact`) and `age_0` at the start of points
    in contact. Not smooth at slip onset. The slip rate is single-valued where the tangential spring
    outweighs the fall of friction with slip, K_t >= ageing F_N / D_c, beside what `SmoothSlip`
    needs. Without `ageing` it is that law.
    """

    states: ClassVar = {"age": OwnState("s", "age_0")}
    ages: ClassVar = True

    def __init__(
        self,
        mu_s: StaticFriction,
        mu_k: KineticFriction,
        v_s: FallingSpeed = 5e-3,
        ageing: Annotated[
            float, Quantity("1", 0.0, 1.0, "rise of static friction with ln of the time at rest")
        ] = 0.0,
        D_c: Annotated[
            float, Quantity("m", 1e-9, 1.0, "slip over which the age is renewed")
        ] = 5e-6,
        t_0: Annotated[
            float, Quantity("s", 1e-9, 1e6, "time at rest from which on mu_s rises")
        ] = 1e-3,
        age_0: Annotated[float, Quantity("s", 0.0, 1e12, "age of contacts at the start")] = 1.0,
    ) -> None:  # fmt: skip
        super().__init__(mu_s, mu_k, v_s)
        self.ageing = parameter(ageing)
        self.D_c, self.t_0, self.age_0 = (parameter(x, trained=False) for x in (D_c, t_0, age_0))

    def at_rest(self) -> Tensor:
        """Static friction [1] at the start of a run."""
        return self.mu_s + self.ageing * torch.log1p(self.age_0 / self.t_0)

    def jumps(self, F_N: float, R_t: Tensor, K_t: Tensor) -> str:
        """Why the slip rate jumps under F_N [N] between a dashpot [N.s/m] and a spring [N/m]; empty
        if it does not."""
        falls, holds = (self.ageing * F_N / self.D_c).item(), K_t.item()
        if holds < falls:
            return (
                f"K_t = {holds:.3g} N/m is below ageing F_N / D_c = {falls:.3g}; raise K_t or D_c"
            )
        return super().jumps(F_N, R_t, K_t)

    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, E: Tensor, F_N: Tensor, R: Tensor, z: Tensor, stage: Tensor | float
    ) -> tuple[Tensor, Tensor]:
        """Slip rate (...) [m/s] and age' (..., 1), with the age at the end of the stage."""

        age, presses = z[..., 0], F_N > 0

        def at(rate: Tensor) -> Tensor:
            older = torch.log1p((age + stage) / (1 + stage * rate / self.D_c) / self.t_0)
            return self.slip(E, F_N, R, self.mu_s + self.ageing * older)

        first = at(torch.zeros_like(E))  # zero where a point that presses sticks
        old, before, rate, secant = torch.zeros_like(E), first, first, torch.zeros_like(E)
        for left in reversed(range(ITERATIONS)):
            if left + 1 == DIFFERENTIATED:
                old, before, rate, secant = (one.detach() for one in (old, before, rate, secant))
            way, there = rate - old, at(rate)
            far = way.abs() > SETTLED * rate
            slope = (there - before) / torch.where(far, way, 1.0)
            secant = torch.where(far, slope.clamp(0.0, STEEP), secant)
            old, before = rate, there
            rate = torch.where(presses, rate + (there - rate) / (1 - secant), first)
        renewed = rate / self.D_c  # how often [1/s]
        return rate, ((1 - renewed * age) / (1 + stage * renewed))[..., None]
