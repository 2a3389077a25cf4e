"""Channels of the paper's rig: unit, meaning, symbol; and units of measurement."""

import math
from typing import NamedTuple


class Channel(NamedTuple):
    """One signal (T,): SI unit, meaning, and LaTeX symbol."""

    unit: str
    meaning: str
    symbol: str


CHANNELS = {
    "t": Channel("s", "time since the start", "t"),
    "x_C": Channel("m", "centre of mass of the disc, x", "x_C"),
    "y_C": Channel("m", "centre of mass of the disc, y", "y_C"),
    "theta": Channel("rad", "rotation of the disc, anticlockwise", r"\theta"),
    "x_Br": Channel("m", "centre of mass of the bracket, x", "x_{Br}"),
    "y_Br": Channel("m", "centre of mass of the bracket, y", "y_{Br}"),
    "v_x": Channel("m/s", "velocity of the disc's centre, x", r"\dot x_C"),
    "v_y": Channel("m/s", "velocity of the disc's centre, y", r"\dot y_C"),
    "omega": Channel("rad/s", "angular velocity of the disc", r"\dot\theta"),
    "v_x_Br": Channel("m/s", "velocity of the bracket, x", r"\dot x_{Br}"),
    "v_y_Br": Channel("m/s", "velocity of the bracket, y", r"\dot y_{Br}"),
    "F_x": Channel("N", "controller's force on the bracket, x (Eq. 32)", "F_x"),
    "F_y": Channel("N", "controller's force on the bracket, y, with what is fed forward", "F_y"),
    "bracket_moment": Channel("N.m", "moment on the bracket about its centre (Eq. 35)", "M_{Br}"),
    "angular_momentum": Channel("kg.m2/s", "angular momentum of the disc (Fig. 17)", r"I_C \omega"),
    "x_d": Channel("m", "set-point of the disc's x", "x_d"),
    "x_d_dot": Channel("m/s", "rate of x_d", r"\dot x_d"),
    "y_d": Channel("m", "set-point of the bracket's y", "y_d"),
    "y_d_dot": Channel("m/s", "rate of y_d", r"\dot y_d"),
    "F_ff": Channel("N", "vertical force fed forward to the bracket", "F_{ff}"),
}
"""Channels of the paper's rig by their names, in runs, files and datasets alike."""


UNITS = {
    "s": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180},
    "N": {
        "N": 1.0,
        "mN": 1e-3,
        "uN": 1e-6,
        "kN": 1e3,
        "gf": 9.80665e-3,
        "kgf": 9.80665,
        "lbf": 4.4482216152605,
    },
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
"""Channels of the reference: set-points, and signals that may be fed forward."""
