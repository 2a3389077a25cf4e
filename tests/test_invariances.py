"""The same motion wherever the rig stands, whichever way it looks, in any order and at any size."""

import math
import warnings
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from conftest import times

from torchsoft import (
    Body,
    Contact,
    Ellipse,
    KelvinVoigt,
    Pad,
    PadMesh,
    Rig,
    SmoothSlip,
    SoftContact,
    simulate,
)

RTOL = 1e-5
SAME = 10 * RTOL
"""Largest difference of two motions over their range."""

LENGTH, HEIGHT, DEPTH = 60e-3, 8e-3, 30e-3


class Units(NamedTuple):
    """Factors of lengths, masses and times."""

    L: float = 1.0
    M: float = 1.0
    T: float = 1.0


SI = Units()


def moved_by(
    turn: float, mirror: float, shift: tuple[float, float], x: float, y: float
) -> tuple[float, float]:
    """A place mirrored in x, turned and then shifted."""
    c, s = math.cos(turn), math.sin(turn)
    x *= mirror
    return c * x - s * y + shift[0], s * x + c * y + shift[1]


def motion(
    turn: float = 0.0,
    mirror: float = 1.0,
    shift: tuple[float, float] = (0.0, 0.0),
    reordered: bool = False,
    weighted: bool = True,
    units: Units = SI,
    atol: float | None = None,
) -> np.ndarray:
    """Two ellipses thrown onto two pads, taken back into the first frame and units: (times, 6)."""
    L, M, T = units
    law = SoftContact(
        5e4 * M / T**2, 20.0 * M / T, 5e4 * M / T**2, 20.0 * M / T,
        friction=SmoothSlip(0.6, 0.6), node_spacing=1e-3 * L,
    )  # fmt: skip
    material = KelvinVoigt(0.15e6 * M / L / T**2, 0.45, 1e3 * M / L**3, 3e-3 * T, DEPTH * L)
    pads, bodies, contacts, start = {}, {}, {}, {}
    for name, left, tilt in (("one", 0.0, 0.4), ("two", 0.2, -0.7)):
        end = left if mirror > 0 else left + LENGTH  # the left one, mirrored
        origin = moved_by(turn, mirror, (shift[0] * L, shift[1] * L), L * end, 0.0)
        mesh = PadMesh(LENGTH * L, HEIGHT * L, 30, 3)
        pads[name] = Pad(mesh, material, origin=origin, angle=turn, points=2)
        bodies[name] = Body(0.1 * M, Ellipse(15e-3 * L, 9e-3 * L), weighted=weighted)
        contacts[name] = Contact(name, name, law)
        place = moved_by(
            turn, mirror, (shift[0] * L, shift[1] * L), L * (left + 0.5 * LENGTH), L * 25e-3
        )
        v = moved_by(turn, mirror, (0.0, 0.0), 0.15 * L / T, -0.4 * L / T)
        start[name] = {
            "x": place[0], "y": place[1], "theta": mirror * tilt + turn,
            "v_x": v[0], "v_y": v[1], "omega": 5.0 * mirror / T,
        }  # fmt: skip
    if reordered:
        pads, bodies, contacts = (dict(reversed(one.items())) for one in (pads, bodies, contacts))
    rig = Rig(bodies=bodies, pads=pads, contacts=contacts, gravity=weighted * 9.81 * L / T**2)
    run = simulate(rig, T * times(0.12, 25), y0=rig.state(start), rtol=RTOL, atol=atol)
    out = []
    c, s = math.cos(turn), math.sin(turn)
    for name in ("one", "two"):
        x, y, theta = (run[f"{axis}_{name}"].numpy() for axis in ("x", "y", "theta"))
        x, y = x / L - shift[0], y / L - shift[1]
        out += [mirror * (c * x + s * y), -s * x + c * y, mirror * (theta - turn)]
    return np.stack(out, -1)


def check(other: np.ndarray, first: np.ndarray) -> None:
    assert np.ptp(first[:, 1]) > 5e-3  # it falls, and it is thrown back or turned
    assert (np.abs(other - first).max(0) / np.ptp(first, axis=0)).max() < SAME


@pytest.fixture(scope="module")
def first() -> np.ndarray:
    return motion()


def test_a_moved_rig_moves_as_before(first):
    check(motion(shift=(1.0, -3.0)), first)


def test_a_mirrored_rig_moves_mirrored(first):
    check(motion(mirror=-1.0), first)


@pytest.mark.parametrize("turn", [0.5 * math.pi, math.pi, 0.3])
def test_a_turned_rig_moves_turned(turn):
    """Gravity points down, so without weight."""
    check(motion(turn=turn, weighted=False), motion(weighted=False))


def test_the_order_of_parts_does_not_matter(first):
    check(motion(reordered=True), first)


@pytest.mark.parametrize("L", [10.0, 0.1])
def test_motions_of_all_sizes_are_similar(L):
    """Lengths times L, masses times L^3, times by sqrt(L): under gravity nothing else is left."""
    check(motion(units=Units(L, L**3, math.sqrt(L))), motion())


@pytest.mark.parametrize(
    "units", [Units(T=0.1), Units(M=1e-4), Units(0.1, 1e-6), Units(0.01, 1e-9, 0.1)]
)
def test_motions_in_all_units_are_similar(units, first):
    """Forces down to 1e-8 N and steps of a tenth: tolerances count by the rig's own weight and
    size (1.6e-4 of the range where they count N and mm)."""
    assert np.abs(motion(units=units) - first).max() < RTOL


def test_a_run_says_that_atol_is_above_its_forces():
    """Without gravity nothing says beforehand how large forces are."""
    thrown = partial(motion, weighted=False)
    with pytest.warns(UserWarning, match=r"contact forces reach .*: take atol = ") as said:
        thrown(units=(small := Units(0.1, 1e-5)))
    atol = float(str(said[0].message).rpartition("= ")[2])
    with warnings.catch_warnings(action="error"):
        better = thrown(units=small, atol=atol)
    assert np.abs(better - thrown()).max() < SAME
    with pytest.warns(UserWarning, match=r"reach .*e-\d+ N, .*: take units that make them larger"):
        thrown(units=Units(0.01, 1e-9, 0.1))
