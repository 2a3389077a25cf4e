"""Checks for pytest: of a rig's gradients, of its energies, and of custom laws.

Each returns what it found and raises `CheckFailed`, an `AssertionError`, with a sentence on every
fault.
"""

from torchsoft.testing.energy import CheckFailed, check_energy, check_power
from torchsoft.testing.gradients import Derivative, GradientCheck, check_gradients
from torchsoft.testing.laws import check_law

__all__ = [
    "CheckFailed",
    "Derivative",
    "GradientCheck",
    "check_energy",
    "check_gradients",
    "check_law",
    "check_power",
]
