"""Rigs in files: a TOML file, or the same tables in Python, to a run with its figures, for somebody
who writes no Python."""

from torchsoft.physics.statics import BuiltRig
from torchsoft.rigs.build import RigFile

__all__ = ["BuiltRig", "RigFile"]
