"""Kinds of tests and of strain energies, for modules that read them and for the command, which
imports nothing else to know its options."""

from collections.abc import Mapping
from typing import Literal, get_args

PullTest = Literal["tension", "compression", "planar", "biaxial", "shear"]
"""Tests of a modulus or a strain energy: along one direction, along one with the width held, along
two, and simple shear, whose strain is its amount."""

PULLS: tuple[PullTest, ...] = get_args(PullTest)

Test = Literal["relaxation", "creep", "sweep"] | PullTest
"""The controlled quantity over time: strain, so that the stress relaxes; or stress, so that the
strain creeps; a sweep over frequencies; or a pull."""

ENERGIES: Mapping[str, tuple[str, ...]] = {
    "neo_hookean": ("E",),
    "mooney_rivlin": ("C10", "C01"),
    "yeoh": ("C10", "C20", "C30"),
    "ogden": ("mu", "alpha"),
}
"""Energies, and the arguments of their constructors that tests determine."""
