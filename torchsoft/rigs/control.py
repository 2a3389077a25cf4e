"""Actuators of a rig file: PD loops, networks, feed-forward efforts, and controllers of several
coordinates.

Networks come from files of weights, which are data and never programs.
"""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from torchsoft.files import check_file
from torchsoft.physics.parts import (
    PD,
    Actuator,
    Gains,
    Integral,
    Lagging,
    ReversedPD,
    StateFeedback,
    controller,
)
from torchsoft.quantity import (
    DerivativeGain,
    EffortLimit,
    IntegralGain,
    Lag,
    ProportionalGain,
    quantity,
)
from torchsoft.rigs.fields import Group, at_field
from torchsoft.tables import LISTED, line

WEIGHTS = 2000
"""Most numbers of a network, since each becomes machine code."""

TOO_MANY = f"it has more than {WEIGHTS} numbers, which are too many to be compiled"

LARGEST = 10e6
"""Largest size [B] of a file of weights, packed or not."""

PYTHON = (
    "a module of another kind is given in Python: torchsoft.Actuator(measures, pushes, module, "
    "setpoint=...) or torchsoft.controller(module, ...)"
)

LOOP = "set-point", "its rate", "coordinate", "its rate"
"""Inputs of the network of one loop, in SI units."""


class NetworkPD(PD):
    """Sum of a PD law and a network of (set-point, its rate, coordinate, its rate) [N or N.m]."""

    def __init__(self, Kp: float, Kd: float, network: nn.Module, reversed: bool = False) -> None:
        super().__init__(Kp, Kd)
        self.network, self.sign = network, -1.0 if reversed else 1.0

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor
    ) -> Tensor:
        loop = self.Kp * (w - q) + self.Kd * (w_dot - q_dot)
        return (
            self.sign * loop
            + self.network(torch.stack((w, w_dot, q, q_dot), -1))[..., 0]
            + feed_forward
        )


class FedNetwork(nn.Module):
    """Sum of state feedback and a network of (set-points, their rates, coordinates, their rates) [N
    or N.m]; either may be missing."""

    def __init__(self, feedback: StateFeedback | None, network: nn.Module | None) -> None:
        super().__init__()
        self.feedback, self.network = feedback, network

    def forward(self, setpoints: Tensor, state: Tensor) -> Tensor:
        if self.network is None:
            assert self.feedback is not None
            return self.feedback(setpoints, state)
        efforts = self.network(torch.cat((setpoints, state), -1))
        return efforts if self.feedback is None else self.feedback(setpoints, state) + efforts


def read_network(path: Path, inputs: Sequence[str], efforts: int = 1) -> nn.Sequential:
    """Linear layers with tanh between them from an .npz file of their weights and biases, with the
    names of torch's `Sequential(Linear, Tanh, Linear, ...)`: 0.weight, 0.bias, 2.weight, ...
    `inputs` are the words for its inputs.

    Raises `ValueError` naming the file for another kind of file, names or shapes, and `OSError`.
    """
    if path.suffix != ".npz":
        raise ValueError(
            f"{path} is not an .npz file: weights are data, and other files may be programs, which "
            f"are not run; save them by numpy.savez(file, **network.state_dict()). {PYTHON}"
        )
    check_file(path, LARGEST)
    try:
        with np.load(path, allow_pickle=False) as file:
            if sum(one.file_size for one in file.zip.infolist()) > LARGEST:  # unpacked
                raise ValueError(TOO_MANY)
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except (ValueError, EOFError, KeyError, MemoryError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not an .npz file of numbers: {line(error, 120)}") from None
    try:
        return layers(arrays, inputs, efforts)
    except ValueError as error:
        raise ValueError(f"{path}: {error}. {PYTHON}") from None


def layers(arrays: dict[str, np.ndarray], inputs: Sequence[str], efforts: int) -> nn.Sequential:
    """Linear layers with tanh between them. Raises `ValueError` for arrays of another network."""
    found = range(0, len(arrays), 2)
    if not found or {*arrays} != {f"{i}.{part}" for i in found for part in ("weight", "bias")}:
        raise ValueError(
            f"it has {', '.join(line(name, 40) for name in arrays) or 'nothing'}, but a network "
            "has 0.weight, 0.bias, 2.weight, 2.bias and so on: linear layers with tanh between them"
        )
    if sum(array.size for array in arrays.values()) > WEIGHTS:
        raise ValueError(TOO_MANY)
    for name, array in arrays.items():
        if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite numbers")
    width, parts = len(inputs), list[nn.Module]()
    for i in found:
        both = (arrays[f"{i}.{part}"].astype(np.float64) for part in ("weight", "bias"))
        weight, bias = map(torch.from_numpy, both)
        rows, shown = bias.numel(), "n"
        if i == found[-1]:
            rows, shown = efforts, str(efforts)
        if weight.shape != (rows, width) or bias.shape != (rows,):
            raise ValueError(
                f"{i}.weight has the shape {tuple(weight.shape)} and {i}.bias {tuple(bias.shape)}, "
                f"but must have ({shown}, {width}) and ({shown},): from {len(inputs)} inputs "
                f"({', '.join(inputs)}) to {efforts} effort{'s' * (efforts > 1)}"
            )
        linear = nn.Linear(width, rows, dtype=torch.float64)
        linear.load_state_dict({"weight": weight, "bias": bias})
        parts += [linear, nn.Tanh()]
        width = rows
    return nn.Sequential(*parts[:-1])


Names = Annotated[tuple[str, ...], LISTED]
Gain = Annotated[float, quantity(Gains)]
Rows = Annotated[tuple[Annotated[tuple[Gain, ...], LISTED], ...], LISTED]


class Loop(NamedTuple):
    """A coordinate with a set-point: the field of its controller, the coordinate pushed for it, and
    the actuators of the rig."""

    field: str
    measured: str
    pushes: str
    setpoint: str
    actuators: tuple[str, ...]


class ActuatorTable(Group):
    """An effort on one free coordinate: Kp (w - q) + Kd (w' - q'), Ki times the integral of w - q,
    network(w, w', q, q') and feed-forward, after a lag and up to a limit if there are such. The
    coordinate q that it measures may be another one, of another body, and of another kind:
    "disc.theta" through "bracket.x"."""

    pushes: str = Field(
        min_length=1, description='the coordinate that it pushes, such as "bracket.x"'
    )
    measures: str | None = Field(
        default=None,
        description="the coordinate q that it measures; the one that it pushes if not given",
    )
    setpoint: str | None = Field(
        default=None,
        description="name of the motion w that q is to follow; none: no loop, only feed_forward",
    )
    feed_forward: str | None = Field(
        default=None, description="name of the motion that is added as an effort [N or N.m]"
    )
    Kp: ProportionalGain = Field(default=0.0, description="proportional gain")
    Kd: DerivativeGain = Field(default=0.0, description="derivative gain")
    Ki: IntegralGain = Field(
        default=0.0, description="integral gain; the integral begins at zero and has no bounds"
    )
    lag: Lag | None = Field(
        default=None,
        description="time constant of a first-order lag of the whole effort, as drives have it, "
        "initially settled; none if not given",
    )
    limit: EffortLimit | None = Field(
        default=None,
        description="largest size of the whole effort, at which it saturates; an integral goes "
        "on; none if not given",
    )
    reversed: bool = Field(
        default=False,
        description="true: reverse the gains, for a q that falls where the pushed coordinate rises",
    )
    network: str | None = Field(
        default=None,
        description="an .npz file of weights, from the folder of this one: layers 0.weight, "
        "0.bias, 2.weight, ... with tanh between them, from w, w', q, q' in SI units to an effort",
    )

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        if self.setpoint is None and (self.Kp or self.Kd or self.Ki):
            raise ValueError("setpoint is missing: the gains Kp, Kd and Ki need a motion to follow")
        if self.setpoint is None and self.network is not None:
            raise ValueError(
                "setpoint is missing: the network is one of a motion w and the coordinate that "
                "follows it"
            )
        if self.setpoint is not None and not (self.Kp or self.Kd or self.Ki or self.network):
            raise ValueError(
                "Kp, Kd and Ki are 0, so that the setpoint would have no effect; give a gain, or "
                "a network"
            )
        if self.setpoint is None and self.feed_forward is None:
            raise ValueError("it does nothing: give a setpoint with gains, or feed_forward")
        return self

    @property
    def measured(self) -> str:
        return self.measures or self.pushes

    def loops(self, name: str) -> list[Loop]:
        """The control loop of the actuator, none without a set-point."""
        if self.setpoint is None:
            return []
        return [Loop(f"actuators.{name}", self.measured, self.pushes, self.setpoint, (name,))]

    def build(self, folder: Path) -> Actuator:
        """The actuator; its network is in `folder`. Raises `ValueError`."""
        followed = (
            self.setpoint or self.feed_forward
        )  # without gains it does not matter which signal is the set-point
        assert followed is not None
        law = ReversedPD(self.Kp, self.Kd) if self.reversed else PD(self.Kp, self.Kd)
        elements = ("C: Kp", "R: Kd")
        if self.network is not None:
            with at_field("network"):
                law = NetworkPD(
                    self.Kp, self.Kd, read_network(folder / self.network, LOOP), self.reversed
                )
            elements = (*elements, "Se: network")
        if self.Ki:
            law, elements = Integral(law, self.Ki, reversed=self.reversed), (*elements, "Se: Ki")
        if self.lag is not None:
            law, elements = Lagging(law, self.lag), (*elements, "Se: lag")
        if self.limit is not None:
            elements = (*elements, "Se: limit")
        return Actuator(
            self.measured, self.pushes, law, setpoint=followed, feed_forward=self.feed_forward,
            limit=self.limit, elements=elements
        )  # fmt: skip


class ControllerTable(Group):
    """A law of several coordinates with several efforts: gain . (set-points less coordinates, and
    their rates) + network(...). The efforts' actuators are named after the controller and the
    coordinate that they push: F_NAME_bracket_x of bracket.x."""

    measures: Names = Field(
        min_length=1, description='coordinates that it sees, such as "disc.x", with their rates'
    )
    setpoints: Names = Field(
        default=(),
        description="names of the motions that the first of these are to follow, in their order",
    )
    pushes: Names = Field(
        min_length=1, description="coordinates that it pushes, one for each effort"
    )
    gain: Rows | None = Field(
        default=None,
        description="a row for each effort: gains of the coordinates' errors [N/m, N.m/rad, ...], "
        "then of their rates'; errors are counted from zero where a coordinate has no set-point",
    )
    network: str | None = Field(
        default=None,
        description="an .npz file of weights, from the folder of this one: layers 0.weight, "
        "0.bias, 2.weight, ... with tanh between them, from set-points, their rates, coordinates, "
        "their rates in SI units to the efforts",
    )

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for field in ("measures", "setpoints", "pushes"):
            names = getattr(self, field)
            if len(set(names)) < len(names):
                raise ValueError(f"{field}: every name once")
        if len(self.setpoints) > len(self.measures):
            raise ValueError(
                f"setpoints: {len(self.setpoints)} motions, but it measures {len(self.measures)} "
                "coordinates to follow them"
            )
        if self.gain is None and self.network is None:
            raise ValueError("it does nothing: give a gain, a network, or both")
        if self.gain is not None and [len(row) for row in self.gain] != [
            2 * len(self.measures)
        ] * len(self.pushes):
            raise ValueError(
                f"gain: {len(self.pushes)} efforts of {len(self.measures)} coordinates and their "
                f"rates need {len(self.pushes)} rows of {2 * len(self.measures)} numbers"
            )
        if (
            self.gain is not None
            and not any(any(row) for row in self.gain)
            and self.network is None
        ):
            raise ValueError("gain: all zeros, so that it does nothing")
        return self

    def actuators(self, name: str) -> dict[str, str]:
        """Pushed coordinates by the names of the actuators."""
        return {f"{name}_{pushed.replace('.', '_')}": pushed for pushed in self.pushes}

    def loops(self, name: str) -> list[Loop]:
        """Control loops of the controller. The coordinate pushed for a measured one is itself if it
        is pushed, else one along the same axis, else the first."""

        def towards(coordinate: str) -> str:
            same = [
                one for one in self.pushes if one.partition(".")[2] == coordinate.partition(".")[2]
            ]
            return coordinate if coordinate in self.pushes else (*same, *self.pushes)[0]

        field, made = f"controllers.{name}", tuple(self.actuators(name))
        return [
            Loop(field, one, towards(one), motion, made)
            for one, motion in zip(self.measures, self.setpoints)
        ]

    def build(self, name: str, folder: Path) -> dict[str, Actuator]:
        """Its actuators; its network is in `folder`. Raises `ValueError`."""
        network, inputs = None, [*self.setpoints, *(f"{one}'" for one in self.setpoints)]
        inputs += [*self.measures, *(f"{one}'" for one in self.measures)]
        if self.network is not None:
            with at_field("network"):
                network = read_network(folder / self.network, inputs, len(self.pushes))
        feedback = None if self.gain is None else StateFeedback(self.gain)
        return controller(
            FedNetwork(feedback, network),
            measures=self.measures,
            setpoints=self.setpoints,
            pushes=self.actuators(name),
        )
