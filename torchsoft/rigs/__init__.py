"""Rigs from TOML files, or from the same tables in Python, through to a run with its figures."""

from torchsoft.rigs.build import RigFile
from torchsoft.rigs.built import BuiltRig

__all__ = ["BuiltRig", "RigFile"]
