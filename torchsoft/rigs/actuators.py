"""Actuators of a rig file: PD loops, networks, and efforts that are fed forward."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from torchsoft.physics.parts import PD, Actuator, ReversedPD
from torchsoft.rigs.fields import Group, Within, at_field
from torchsoft.rigs.network import NetworkPD, read_network


class ActuatorTable(Group):
    """An effort on one free coordinate, Kp (w - q) + Kd (w' - q') + network(w, w', q, q') + what is fed forward. The coordinate
    q that it measures may be another one, of another body, and of another kind: "disc.theta" through "bracket.x"."""

    pushes: str = Field(description='the coordinate that it pushes, such as "bracket.x"')
    measures: str | None = Field(
        default=None, description="the coordinate q that it measures; the one that it pushes if not given"
    )
    setpoint: str | None = Field(
        default=None, description="name of the motion w that q is to follow; none: no loop, only feed_forward"
    )
    feed_forward: str | None = Field(
        default=None, description="name of the motion that is added as an effort [N or N.m]"
    )
    Kp: Annotated[float, Within(0.0, 1e12, "N/m, N, N.m/rad")] = Field(default=0.0, description="proportional gain")
    Kd: Annotated[float, Within(0.0, 1e12, "N.s/m, N.s, N.m.s/rad")] = Field(default=0.0, description="derivative gain")
    reversed: bool = Field(
        default=False, description="the gains push the other way, for a q that falls where the pushed coordinate rises"
    )
    network: str | None = Field(
        default=None,
        description="an .npz file of weights, from the folder of this one: layers 0.weight, 0.bias, 2.weight, ... with tanh "
        "between them, from w, w', q, q' in SI units to an effort",
    )

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        if self.setpoint is None and (self.Kp or self.Kd):
            raise ValueError("setpoint is missing: the gains Kp and Kd need a motion to follow")
        if self.setpoint is None and self.network is not None:
            raise ValueError("setpoint is missing: the network is one of a motion w and the coordinate that follows it")
        if self.setpoint is not None and not (self.Kp or self.Kd or self.network):
            raise ValueError(
                "Kp and Kd are both 0, so that the setpoint would have no effect; give a gain, or a network"
            )
        if self.setpoint is None and self.feed_forward is None:
            raise ValueError("it does nothing: give a setpoint with gains, or feed_forward")
        return self

    @property
    def measured(self) -> str:
        return self.measures or self.pushes

    def build(self, folder: Path) -> Actuator:
        """The actuator; `folder` is where its network lies. Raises `ValueError`."""
        followed = self.setpoint or self.feed_forward  # without gains it does not matter which signal is the set-point
        assert followed is not None
        law = ReversedPD(self.Kp, self.Kd) if self.reversed else PD(self.Kp, self.Kd)
        elements = ("C: Kp", "R: Kd")
        if self.network is not None:
            with at_field("network"):
                law = NetworkPD(self.Kp, self.Kd, read_network(folder / self.network), self.reversed)
            elements = (*elements, "Se: network")
        return Actuator(
            self.measured, self.pushes, law, setpoint=followed, feed_forward=self.feed_forward, elements=elements
        )  # fmt: skip
