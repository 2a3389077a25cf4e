"""The paper's manipulation: rest, grasp, roll out, hold, roll back, rest."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsoft.paper.equilibrium import rest
from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.motion import Profile, Reference
from torchsoft.physics.statics import NoEquilibrium
from torchsoft.solve.simulate import simulate

SETTLE = 0.5
"""Time [s] after the grasp at which the bracket is judged to be at rest."""


@dataclass(frozen=True)
class Manipulation:
    """A model that follows the paper's reference, its initial state (size,), and the grasping force
    [N] fed forward."""

    model: SoftGrasp
    y0: Tensor
    grasp_force: float


def grasp_and_roll(
    model: SoftGrasp, *, grasp_force: float | None = None, **steps: Any
) -> Manipulation:
    """Give `model` the paper's reference, and find the grasping force that holds the bracket at
    y_Br(t_g).

    The force is fed forward along the grasp's own 7th-order profile and constant from t_g on.
    Friction locked in during the grasp stiffens the pads, so a static estimate is too low: the
    grasp itself is simulated, by the secant method, until the vertical loop holds the bracket
    within 1 um. Pass `grasp_force` [N] to skip that; `steps` say how `simulate` chooses its steps.
    """
    y0 = rest(model).detach()
    if grasp_force is None:
        grasp_force = find_grasp_force(model, y0, **steps)
    model.reference = reference(model, y0, grasp_force)
    return Manipulation(model, y0, grasp_force)


def reference(model: SoftGrasp, y0: Tensor, grasp_force: float) -> Reference:
    """Eq. 20-30 from the state y0, with `grasp_force` [N] fed forward to the bracket
    (downwards)."""
    p, pose = model.settings.scenario, model.unpack(y0).pose
    x_0, y_0 = float(pose["disc"][0]), float(pose["bracket"][1])
    times = [0.0, p.roll_time, p.roll_time + p.hold_time, 2 * p.roll_time + p.hold_time]
    if p.hold_time == 0:
        times.pop(1)
    out = [x_0 + p.travel] * (len(times) - 2)
    return Reference(
        x_d=Profile(times, [x_0, *out, x_0]),  # (22)-(29)
        y_d=Profile([0.0, p.grasp_time], [y_0, p.y_Br_grasp]),  # (30)
        F_ff=Profile([0.0, p.grasp_time], [0.0, -grasp_force]),
    )


def find_grasp_force(model: SoftGrasp, y0: Tensor, tolerance: float = 1e-6, **steps: Any) -> float:
    """Grasping force [N] that leaves the vertical loop nothing to do once the grasp has settled.

    `tolerance` [m] is on the bracket's height; `steps` say how `simulate` chooses its steps.
    """
    p = model.settings.scenario
    t = torch.tensor([0.0, p.grasp_time, p.grasp_time + SETTLE], dtype=torch.float64)

    def height_error(force: float) -> float:
        run = simulate(model, t, y0=y0, reference=reference(model, y0, force), **steps)
        return float(run["y_Br"][-1]) - p.y_Br_grasp

    force, error = 0.0, height_error(0.0)
    gain = 2.0 * float(
        model.parameter("control.K_98").detach()
    )  # the pads are about as stiff as the loop
    for _ in range(20):
        if abs(error) <= tolerance:
            return force
        new = force + gain * error
        new_error = height_error(new)
        gain = (new - force) / (error - new_error)
        force, error = new, new_error
    raise NoEquilibrium(
        f"no grasping force found: the bracket is still {error:.2g} m off at {force:.4g} N"
    )
