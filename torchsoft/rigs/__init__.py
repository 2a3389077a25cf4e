"""Rigs from TOML files, or from the same tables in Python, through to a run with its figures."""

from torchsoft.physics.statics import BuiltRig
from torchsoft.rigs.build import RigFile

__all__ = ["BuiltRig", "RigFile"]
