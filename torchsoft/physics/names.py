"""Names that a rig's parts and signals may have, and those of channels that follow from them."""

import re
from collections.abc import Iterable

from torch import nn

from torchsoft.physics.arguments import line

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")

TAKEN = frozenset(dir(nn.ModuleDict()))
"""Names that parts of a torch module cannot have."""

FORCES = "normal", "shear"
"""Channels of touch at the points of a contact and of taxels."""
ON_BODY = "load_x", "load_y", "load_theta"
"""Channels of touch of a body."""


def misnamed(name: object, dotted: bool = False) -> str:
    """Why a part cannot have a name; empty where it can. A `dotted` name may have two parts."""
    parts = str(name).split(".") if dotted else [str(name)]
    if len(parts) > 2 or not all(map(NAME.fullmatch, parts)):
        more = ", perhaps BODY.COORDINATE" if dotted else ""
        return f"the name should be letters, digits and underscores, from a letter on{more}"
    return "the name is taken by torch; take another one" if name in TAKEN else ""


def check_names(kind: str, names: Iterable[object], dotted: bool = False) -> None:
    """Raises `ValueError` for a name that a part of a kind cannot have."""
    for name in names:
        if wrong := misnamed(name, dotted):
            raise ValueError(f"{kind}.{line(name).strip(chr(39))}: {wrong}")


def rate_channel(key: str) -> str:
    """Channel of a coordinate's rate, from the coordinate's own."""
    return f"omega{key.removeprefix('theta')}" if key.startswith("theta") else f"v_{key}"


def effort_channel(actuator: str) -> str:
    """Channel of an actuator's effort."""
    return f"effort_{actuator}"
