"""Actuators of a rig file: PD loops, networks, efforts that are fed forward, and controllers of several coordinates."""

from pathlib import Path
from typing import Annotated, NamedTuple, Self

from pydantic import Field, model_validator

from torchsoft.physics.controllers import StateFeedback, controller
from torchsoft.physics.parts import PD, Actuator, ReversedPD
from torchsoft.quantity import DerivativeGain, ProportionalGain, Quantity
from torchsoft.rigs.fields import Group, at_field
from torchsoft.rigs.network import LOOP, FedNetwork, NetworkPD, read_network
from torchsoft.tables import LISTED

Names = Annotated[tuple[str, ...], LISTED]
Gains = Annotated[float, Quantity("N/m, N.m/rad, N.s/m, N.m.s/rad", -1e12, 1e12)]
Rows = Annotated[tuple[Annotated[tuple[Gains, ...], LISTED], ...], LISTED]


class Loop(NamedTuple):
    """A coordinate that is to follow a motion: the field that says so, what is pushed for it, by actuators of the rig."""

    field: str
    measured: str
    pushes: str
    setpoint: str
    actuators: tuple[str, ...]


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
    Kp: ProportionalGain = Field(default=0.0, description="proportional gain")
    Kd: DerivativeGain = Field(default=0.0, description="derivative gain")
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

    def loops(self, name: str) -> list[Loop]:
        """What follows what."""
        if self.setpoint is None:
            return []
        return [Loop(f"actuators.{name}", self.measured, self.pushes, self.setpoint, (name,))]

    def build(self, folder: Path) -> Actuator:
        """The actuator; `folder` is where its network lies. Raises `ValueError`."""
        followed = self.setpoint or self.feed_forward  # without gains it does not matter which signal is the set-point
        assert followed is not None
        law = ReversedPD(self.Kp, self.Kd) if self.reversed else PD(self.Kp, self.Kd)
        elements = ("C: Kp", "R: Kd")
        if self.network is not None:
            with at_field("network"):
                law = NetworkPD(self.Kp, self.Kd, read_network(folder / self.network, LOOP), self.reversed)
            elements = (*elements, "Se: network")
        return Actuator(
            self.measured, self.pushes, law, setpoint=followed, feed_forward=self.feed_forward, elements=elements
        )  # fmt: skip


class ControllerTable(Group):
    """A law of several coordinates with several efforts: gain . (set-points less coordinates, and their rates) + network(...).
    The efforts' actuators are called by the controller and by what they push: F_NAME_bracket_x of bracket.x."""

    measures: Names = Field(min_length=1, description='coordinates that it sees, such as "disc.x", with their rates')
    setpoints: Names = Field(
        default=(), description="names of the motions that the first of these are to follow, in their order"
    )
    pushes: Names = Field(min_length=1, description="coordinates that it pushes, one for each effort")
    gain: Rows | None = Field(
        default=None,
        description="a row for each effort: gains of the coordinates' errors [N/m, N.m/rad, ...], then of their rates'; errors "
        "are counted from zero where a coordinate has no set-point",
    )
    network: str | None = Field(
        default=None,
        description="an .npz file of weights, from the folder of this one: layers 0.weight, 0.bias, 2.weight, ... with tanh "
        "between them, from set-points, their rates, coordinates, their rates in SI units to the efforts",
    )

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for field in ("measures", "setpoints", "pushes"):
            names = getattr(self, field)
            if len(set(names)) < len(names):
                raise ValueError(f"{field}: every name once")
        if len(self.setpoints) > len(self.measures):
            raise ValueError(
                f"setpoints: {len(self.setpoints)} motions, but it measures {len(self.measures)} coordinates to follow them"
            )
        if self.gain is None and self.network is None:
            raise ValueError("it does nothing: give a gain, a network, or both")
        if self.gain is not None and [len(row) for row in self.gain] != [2 * len(self.measures)] * len(self.pushes):
            raise ValueError(
                f"gain: {len(self.pushes)} efforts of {len(self.measures)} coordinates and their rates need "
                f"{len(self.pushes)} rows of {2 * len(self.measures)} numbers"
            )
        if self.gain is not None and not any(any(row) for row in self.gain) and self.network is None:
            raise ValueError("gain: all zeros, so that it does nothing")
        return self

    def actuators(self, name: str) -> dict[str, str]:
        """What is pushed, by the names of the actuators."""
        return {f"{name}_{pushed.replace('.', '_')}": pushed for pushed in self.pushes}

    def loops(self, name: str) -> list[Loop]:
        """What follows what; pushed for it is the same coordinate where it is pushed, else one along the same axis, else the
        first."""

        def towards(coordinate: str) -> str:
            same = [one for one in self.pushes if one.partition(".")[2] == coordinate.partition(".")[2]]
            return coordinate if coordinate in self.pushes else (*same, *self.pushes)[0]

        field, made = f"controllers.{name}", tuple(self.actuators(name))
        return [Loop(field, one, towards(one), motion, made) for one, motion in zip(self.measures, self.setpoints)]

    def build(self, name: str, folder: Path) -> dict[str, Actuator]:
        """Its actuators; `folder` is where its network lies. Raises `ValueError`."""
        network, inputs = None, [*self.setpoints, *(f"{one}'" for one in self.setpoints)]
        inputs += [*self.measures, *(f"{one}'" for one in self.measures)]
        if self.network is not None:
            with at_field("network"):
                network = read_network(folder / self.network, inputs, len(self.pushes))
        feedback = None if self.gain is None else StateFeedback(self.gain)
        return controller(
            FedNetwork(feedback, network), measures=self.measures, setpoints=self.setpoints, pushes=self.actuators(name)
        )
