"""The parts of a rig beside its pads: rigid bodies, contacts, and actuators with their control laws."""

from collections.abc import Callable
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor, nn

from torchsoft.physics.arguments import positive
from torchsoft.physics.contact import SoftContact
from torchsoft.physics.shapes import Shape, parameter

COORDINATES = ("x", "y", "theta")
"""The coordinates of a body [m, m, rad]."""

Freedom = Literal["free", "driven"] | float
"""A coordinate is free, driven by the reference's signal "body.coordinate", or fixed at a number."""


class Body(nn.Module):
    """A rigid body: mass [kg], moment of inertia [kg.m2] (by default that of its shape), shape (None: nothing touches it).

    Each coordinate is "free", "driven" or a number at which it is fixed. Gravity acts along -y where `weighted`. Raises
    `ValueError` for another coordinate, or a body without shape and inertia that may turn.
    """

    limits: ClassVar = {"mass": "positive", "own_inertia": "positive"}

    def __init__(
        self, mass: float = 1.0, shape: Shape | None = None, *, x: Freedom = "free", y: Freedom = "free",
        theta: Freedom = "free", inertia: float | None = None, weighted: bool = True,
    ) -> None:  # fmt: skip
        super().__init__()
        if shape is not None and not isinstance(shape, Shape):
            raise ValueError(f"`shape` must be a Shape, but is {shape!r}")
        self.freedom: dict[str, str] = {}
        for name, value in zip(COORDINATES, (x, y, theta)):
            if isinstance(value, str) and value not in ("free", "driven"):
                raise ValueError(f"`{name}` must be 'free', 'driven' or a number, but is {value!r}")
            self.freedom[name] = value if isinstance(value, str) else "fixed"
        fixed = {k: v for k, v in zip(COORDINATES, (x, y, theta)) if not isinstance(v, str)}
        self.fixed = nn.ParameterDict({name: parameter(float(value), trained=False) for name, value in fixed.items()})
        self.mass, self.shape, self.weighted = parameter(mass), shape, weighted
        self.own_inertia = None if inertia is None else parameter(inertia)
        if self.freedom["theta"] == "free" and shape is None and inertia is None:
            raise ValueError("a body that may turn needs an `inertia`, or a `shape` to compute it from")

    @classmethod
    def uniform(cls, shape: Shape, density: float, depth: float, **given: Any) -> Self:
        """A body of uniform `density` [kg/m3] over its `depth` [m]. Its mass is that of the shape as it is now, and a number of
        its own from then on; its inertia follows the shape. Raises `ValueError` for numbers that are not positive."""
        mass = positive("density", density) * positive("depth", depth) * float(shape.area().detach())
        return cls(mass, shape, **given)

    def well_posed(self) -> str:
        """What is wrong with the parameters together; empty if nothing is."""
        inertia = self.inertia.item()
        return "" if inertia > 0 else f"the moment of inertia is {inertia:g} kg.m2, but must be positive"

    @property
    def inertia(self) -> Tensor:
        """Moment of inertia about the centre of mass [kg.m2]."""
        if self.own_inertia is not None:
            return self.own_inertia
        return torch.ones_like(self.mass) if self.shape is None else self.mass * self.shape.gyration()

    @property
    def masses(self) -> tuple[Tensor, Tensor, Tensor]:
        """What the three coordinates' accelerations are multiplied with."""
        return self.mass, self.mass, self.inertia


class Contact(nn.Module):
    """What may touch: a pad (by name) and a body (by name), and the law at their points.

    A run ends when the body leaves the space over the pad, unless it `may_leave`.
    """

    def __init__(self, pad: str, body: str, law: SoftContact, *, may_leave: bool = False) -> None:
        super().__init__()
        self.pad, self.body, self.law, self.may_leave = pad, body, law, may_leave


class PD(nn.Module):
    """A proportional-derivative law: F = Kp (w - q) + Kd (w' - q') + feed-forward (Eq. 31-34)."""

    limits: ClassVar = {"Kp": "not negative", "Kd": "not negative"}

    def __init__(self, Kp: float, Kd: float) -> None:
        super().__init__()
        self.Kp, self.Kd = parameter(Kp), parameter(Kd)

    def forward(self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor) -> Tensor:
        return self.Kp * (w - q) + self.Kd * (w_dot - q_dot) + feed_forward


class ReversedPD(PD):
    """The same with the other sign, for a coordinate that falls where the one that is pushed rises: a bracket that goes to the
    right turns a disc under it clockwise. Its feed-forward keeps the sign."""

    def forward(self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor) -> Tensor:
        return feed_forward - self.Kp * (w - q) - self.Kd * (w_dot - q_dot)


class Actuator(nn.Module):
    """Measures one coordinate, such as "disc.x", and pushes one, such as "bracket.x", by a law.

    `law` (setpoint, its rate, feed-forward, coordinate, its rate) -> effort [N or N.m] is torch code: a `PD`, a
    function, or any
    module. `setpoint` and `feed_forward` name signals of the reference. `elements` are the graph's names of what is behind it.
    """

    def __init__(
        self, measures: str, pushes: str, law: Callable[..., Tensor], *, setpoint: str, feed_forward: str | None = None,
        elements: tuple[str, ...] = ("C: Kp", "R: Kd"),
    ) -> None:  # fmt: skip
        super().__init__()
        for name, value in (
            ("measures", measures),
            ("pushes", pushes),
            ("setpoint", setpoint),
            ("feed_forward", feed_forward or ""),
        ):
            if not isinstance(value, str):
                raise ValueError(f"`{name}` of an actuator must be a name, but is {value!r}")
        if not callable(law):
            raise ValueError(f"`law` of an actuator must be a function or a module, but is {law!r}")
        self.measures, self.pushes, self.law = measures, pushes, law
        self.setpoint, self.feed_forward, self.elements = setpoint, feed_forward, elements

    def forward(self, x: Tensor) -> Tensor:
        """Effort (...) of x = (setpoint, its rate, feed-forward, coordinate, its rate) (..., 5)."""
        return self.law(*x.unbind(-1))
