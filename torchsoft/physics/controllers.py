"""Control laws of several coordinates and efforts: one module that sees the state, and an actuator for each of its efforts."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from torchsoft.physics.parts import Actuator


class StateFeedback(nn.Module):
    """Efforts K e of the errors e: set-points less coordinates, and their rates; without a set-point, less the coordinate.

    `gain` K (k, 2 m) has a row for each effort, and columns for the m coordinates and then their rates: a regulator of linear
    theory. Raises `ValueError` for another shape.
    """

    def __init__(self, gain: Sequence[Sequence[float]]) -> None:
        super().__init__()
        rows = {len(row) for row in gain}
        if len(rows) != 1 or rows.pop() % 2:
            raise ValueError("a gain has rows of one length, of a number for each coordinate and for each rate")
        self.gain = nn.Parameter(torch.tensor([[float(one) for one in row] for row in gain], dtype=torch.float64))

    def forward(self, setpoints: Tensor, state: Tensor) -> Tensor:
        given, there = setpoints.unflatten(-1, (2, -1)), state.unflatten(-1, (2, -1))
        missing = there.shape[-1] - given.shape[-1]
        wanted = torch.cat((given, torch.zeros_like(there[..., :missing])), -1)
        return (wanted - there).flatten(-2) @ self.gain.mT


class OneEffort(nn.Module):
    """One of the efforts of a controller, and what is fed forward: a law of several coordinates."""

    def __init__(self, module: nn.Module, number: int) -> None:
        super().__init__()
        self.module, self.number = module, number

    def forward(self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor) -> Tensor:
        efforts = self.module(torch.cat((w, w_dot), -1), torch.cat((q, q_dot), -1))
        return efforts[..., self.number] + feed_forward


def controller(
    module: nn.Module, *, measures: Sequence[str], setpoints: Sequence[str], pushes: Mapping[str, str],
    feed_forward: Mapping[str, str] | None = None, element: str = "Se: controller",
) -> dict[str, Actuator]:  # fmt: skip
    """Actuators of one control law that sees several coordinates and gives several efforts, by their names.

    `module` (set-points, state) -> efforts (..., k) [N or N.m]: set-points (..., 2 s) and state (..., 2 m) hold all values
    and then all rates, of the s signals `setpoints` and of the m coordinates that it `measures`, which may be all of all
    bodies. `pushes` names the actuators and what each pushes, in the order of the efforts: {"x": "bracket.x"}; the channel of
    the first is then F_x. `feed_forward` names signals that are added to efforts. The module is shared: its parameters are
    those of the first of the actuators, and those of the rig's group if it is one (`Rig(groups=)`). Raises `ValueError` for
    another number of efforts, and what `Actuator` does.
    """
    several, fed = tuple(measures), dict(feed_forward or {})
    if not isinstance(module, nn.Module):
        raise ValueError(f"`module` of a controller must be a torch module, but is {module!r}")
    if isinstance(measures, str) or isinstance(setpoints, str) or not isinstance(pushes, Mapping):
        raise ValueError(
            "`measures` and `setpoints` of a controller are sequences of names, and `pushes` names by names"
        )
    if unknown := fed.keys() - pushes.keys():
        raise ValueError(f"`feed_forward` names {', '.join(sorted(unknown))}, but `pushes` has {', '.join(pushes)}")
    made = {
        name: Actuator(
            several,
            pushed,
            OneEffort(module, i),
            setpoint=tuple(setpoints),
            feed_forward=fed.get(name),
            elements=(element,),
        )
        for i, (name, pushed) in enumerate(pushes.items())
    }
    with torch.no_grad():
        example = (torch.zeros(2 * len(names), dtype=torch.float64) for names in (setpoints, measures))
        efforts = module(*example)
    if not isinstance(efforts, Tensor) or efforts.shape != (len(pushes),):
        shown = tuple(efforts.shape) if isinstance(efforts, Tensor) else type(efforts).__name__
        raise ValueError(
            f"the controller gives {shown} for one state, but must give one effort for each of {list(pushes)}"
        )
    return made
