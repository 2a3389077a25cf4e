"""Gymnasium environments from rig files, with gradients through a step, and one ready-made
environment.

`gymnasium.make("torchsoft/Reorient-v0")`, after `import torchsoft.envs`: two soft jaws turn a disc
to an angle drawn for each episode, by the set-points and the grip of the jaws.
"""

from pathlib import Path
from typing import Any

from torchsoft.extras import needed

gymnasium = needed("gymnasium", "learn")

# these need gymnasium
from torchsoft.envs.dynamics import Dynamics, Moment, TargetPose, Transition  # noqa: E402
from torchsoft.envs.rig_env import RigEnv  # noqa: E402

__all__ = ["Dynamics", "Moment", "RigEnv", "TargetPose", "Transition", "reorient"]


RIG = Path(__file__).with_name("reorient.toml")
"""Rig file of the ready-made environment."""


def reorient(**changes: Any) -> RigEnv:
    """The environment "torchsoft/Reorient-v0"; `changes` are other arguments of `RigEnv`."""
    jaws = ("lower", "upper")
    stated: dict[str, Any] = {
        "rig": RIG,
        "actions": {"lower_x": (-12e-3, 12e-3), "upper_x": (-12e-3, 12e-3), "grip": (-20.0, -6.0)},
        "observations": {
            "x_disc": (-10e-3, 10e-3), "theta_disc": (-1.0, 1.0), "omega_disc": (-3.0, 3.0),
            **{f"x_{jaw}": (-12e-3, 12e-3) for jaw in jaws},
            **{f"{jaw}_skin.normal": (0.0, 10.0) for jaw in jaws},
        },
        "goal": TargetPose("disc", {"theta": (-0.6, 0.6), "x": 0.0}, {"theta": 0.1, "x": 2e-3}),
        "begin": 0.3, "bounds": {"disc.x": (-20e-3, 20e-3)}, "held": ["disc"],
    }  # fmt: skip
    return RigEnv(**stated | changes)


gymnasium.register("torchsoft/Reorient-v0", entry_point="torchsoft.envs:reorient")
