"""Every channel of the rig: its key, the variable and component that hold it in files and datasets,
unit, symbol."""

import math
from typing import Any, NamedTuple


class Variable(NamedTuple):
    """An array over time in files and datasets: SI unit, long name, and the LaTeX symbol of each
    component by its key.

    Two components are those along x and y.
    """

    unit: str
    meaning: str
    symbols: dict[str, str]


class Channel(NamedTuple):
    """One signal (T,): the variable that holds it and the component there, None for a scalar; SI
    unit, name, symbol."""

    variable: str
    axis: int | None
    unit: str
    meaning: str
    symbol: str

    def of(self, values: Any) -> Any:
        """This channel (...,) of its variable's values, (...,) or (..., 2)."""
        return values if self.axis is None else values[..., self.axis]


VARIABLES = {
    "time": Variable("s", "time since the start", {"t": "t"}),
    "disc_position": Variable("m", "centre of mass of the disc", {"x_C": "x_C", "y_C": "y_C"}),
    "disc_angle": Variable("rad", "rotation of the disc, anticlockwise", {"theta": r"\theta"}),
    "bracket_position": Variable(
        "m", "centre of mass of the bracket; it does not turn", {"x_Br": "x_{Br}", "y_Br": "y_{Br}"}
    ),
    "disc_velocity": Variable(
        "m/s", "velocity of the disc's centre", {"v_x": r"\dot x_C", "v_y": r"\dot y_C"}
    ),
    "disc_spin": Variable("rad/s", "angular velocity of the disc", {"omega": r"\dot\theta"}),
    "bracket_velocity": Variable(
        "m/s", "velocity of the bracket", {"v_x_Br": r"\dot x_{Br}", "v_y_Br": r"\dot y_{Br}"}
    ),
    "control_force": Variable(
        "N",
        "controllers' force on the bracket, feed-forward included (Eq. 32, 34)",
        {"F_x": "F_x", "F_y": "F_y"},
    ),
    "bracket_moment": Variable(
        "N.m", "moment on the bracket about its centre (Eq. 35)", {"bracket_moment": "M_{Br}"}
    ),
    "angular_momentum": Variable(
        "kg.m2/s", "angular momentum of the disc (Fig. 17)", {"angular_momentum": r"I_C \omega"}
    ),
    "desired_x": Variable("m", "x_d of the disc", {"x_d": "x_d"}),
    "desired_x_velocity": Variable("m/s", "rate of x_d", {"x_d_dot": r"\dot x_d"}),
    "desired_y": Variable("m", "y_d of the bracket", {"y_d": "y_d"}),
    "desired_y_velocity": Variable("m/s", "rate of y_d", {"y_d_dot": r"\dot y_d"}),
    "feed_forward": Variable("N", "vertical force fed forward to the bracket", {"F_ff": "F_{ff}"}),
}
"""Every variable by its name in a trajectory file and in a dataset."""

CHANNELS = {
    key: Channel(
        variable, axis if len(v.symbols) > 1 else None, v.unit,
        v.meaning + (f", {'xy'[axis]} component" if len(v.symbols) > 1 else ""), symbol,
    )
    for variable, v in VARIABLES.items() for axis, (key, symbol) in enumerate(v.symbols.items())
}  # fmt: skip
"""Every channel by its key."""


UNITS = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180},
    "N": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "N.m": {"N.m": 1.0, "mN.m": 1e-3, "N.mm": 1e-3},
}
"""Units by dimension, and what they are in SI."""


MEASURED = (
    "x_C",
    "y_C",
    "theta",
    "x_Br",
    "y_Br",
    "v_x",
    "v_y",
    "omega",
    "v_x_Br",
    "v_y_Br",
    "F_x",
    "F_y",
)
"""Channels that a sensor can measure: poses, their rates in the same order, and the controllers'
forces."""

SETPOINTS = ("x_d", "y_d")
FEED_FORWARD = ("x_d_dot", "y_d_dot", "F_ff")
"""Channels of the reference: set-points, and what may be fed forward besides them."""

PADS = {"L": "lower", "U": "upper"}
"""What files call the paper's pads."""
