"""The same motion wherever and whenever the rig is, whichever way it looks, in any order, at any
size and in any units."""

import warnings
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
import torch
from conftest import f64, times
from torch import Tensor, nn

from torchsoft import (
    Body,
    Circle,
    Contact,
    Ellipse,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    Reference,
    Rig,
    Sampled,
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


def motion(
    turn: float = 0.0, mirror: float = 1.0, shift: complex = 0.0, reordered: bool = False,
    weighted: bool = True, units: Units = SI, atol: float | None = None,
) -> np.ndarray:  # fmt: skip
    """Two ellipses thrown onto two pads, taken back into the first frame and units: (times, 6);
    places are complex numbers."""
    L, M, T = units
    turned = lambda x, y: (mirror * x + 1j * y) * np.exp(1j * turn)
    law = SoftContact(
        5e4 * M / T**2, 20.0 * M / T, 5e4 * M / T**2, 20.0 * M / T,
        friction=SmoothSlip(0.6, 0.6), node_spacing=1e-3 * L,
    )  # fmt: skip
    material = KelvinVoigt(0.15e6 * M / L / T**2, 0.45, 1e3 * M / L**3, 3e-3 * T, DEPTH * L)
    pads, bodies, contacts, start = {}, {}, {}, {}
    for name, left, tilt in (("one", 0.0, 0.4), ("two", 0.2, -0.7)):
        end = left if mirror > 0 else left + LENGTH  # the left one, mirrored
        origin = L * (shift + turned(end, 0.0))
        mesh = PadMesh(LENGTH * L, HEIGHT * L, 30, 3)
        at = (float(origin.real), float(origin.imag))
        pads[name] = Pad(mesh, material, origin=at, angle=turn, points=2)
        bodies[name] = Body(0.1 * M, Ellipse(15e-3 * L, 9e-3 * L), weighted=weighted)
        contacts[name] = Contact(name, name, law)
        place, v = L * (shift + turned(left + 0.5 * LENGTH, 25e-3)), L / T * turned(0.15, -0.4)
        start[name] = {
            "x": place.real, "y": place.imag, "theta": mirror * tilt + turn,
            "v_x": v.real, "v_y": v.imag, "omega": 5.0 * mirror / T,
        }  # fmt: skip
    if reordered:
        pads, bodies, contacts = (dict(reversed(one.items())) for one in (pads, bodies, contacts))
    rig = Rig(bodies=bodies, pads=pads, contacts=contacts, gravity=weighted * 9.81 * L / T**2)
    run = simulate(rig, T * times(0.12, 25), y0=rig.state(start), rtol=RTOL, atol=atol)
    out = []
    for name in ("one", "two"):
        x, y, theta = (run[f"{axis}_{name}"].numpy() for axis in ("x", "y", "theta"))
        z = ((x + 1j * y) / L - shift) * np.exp(-1j * turn)
        out += [mirror * z.real, z.imag, mirror * (theta - turn)]
    return np.stack(out, -1)


def check(other: np.ndarray, first: np.ndarray) -> None:
    assert np.ptp(first[:, 1]) > 5e-3  # it falls, and it is thrown back or turned
    assert (np.abs(other - first).max(0) / np.ptp(first, axis=0)).max() < SAME


@pytest.fixture(scope="module")
def first() -> np.ndarray:
    return motion()


@pytest.mark.parametrize(
    "change",
    [
        {"shift": 1.0 - 3.0j}, {"mirror": -1.0}, {"reordered": True},
    ],
    ids=["moved", "mirrored", "in another order"],
)  # fmt: skip
def test_a_changed_rig_moves_like_the_first(change, first):
    check(motion(**change), first)


def test_a_turned_rig_moves_turned():
    """Gravity points down, so without weight."""
    check(motion(turn=0.3, weighted=False), motion(weighted=False))


@pytest.mark.parametrize("units", [Units(T=0.1), Units(M=1e-4), Units(0.01, 1e-9, 0.1)])
def test_motions_in_all_units_are_similar(units, first):
    """Forces down to 1e-8 N and steps of a tenth: tolerances scale with the rig's weight and
    size."""
    assert np.abs(motion(units=units) - first).max() < RTOL


def test_a_run_warns_that_atol_is_above_its_forces():
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


# when

CLOCK = 1.7e9
"""Time [s] at which runs start: today's Unix time."""


class Wiggle(nn.Module):
    """A signal that is a function of time, whole seconds of which are forgotten."""

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        w, part = 2 * torch.pi, t - t.floor()
        return 0.0298 - 1e-4 * (w * part).sin(), -1e-4 * w * (w * part).cos()


class Lost(nn.Module):
    """A signal that is not finite for a quarter of a second."""

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        return 0.03 + 0.0 / (t < CLOCK + 0.25).double(), torch.zeros_like(t)


def disc(motion: nn.Module | None = None) -> Rig:
    """A disc over a pad, driven along y by `motion`, or free to fall."""
    pad = Pad(PadMesh(0.06, 0.02, 12, 3), KelvinVoigt(4e4, 0.4, 1e3, 0.01, 0.04), origin=(-0.03, 0))
    law = SoftContact(5e4, 20.0, 5e4, 20.0, friction=SmoothSlip(0.5, 0.4, 0.05))
    free = "free" if motion is None else "driven"
    return Rig(
        bodies={"disc": Body(0.1, Circle(0.01), x=0.0, y=free, theta=0.0)},
        pads={"gel": pad}, contacts={"gel": Contact("gel", "disc", law)},
        reference=Reference() if motion is None else Reference(**{"disc.y": motion}),
    )  # fmt: skip


KNOTS, HEIGHTS = f64(0.0, 0.125, 0.25, 0.5), f64(0.0305, 0.0298, 0.0302, 0.0295)
T = torch.arange(65, dtype=torch.float64) / 128
MOTIONS = {
    "free": lambda t0: None, "profile": lambda t0: Profile(t0 + KNOTS, HEIGHTS),
    "sampled": lambda t0: Sampled(t0 + KNOTS, HEIGHTS), "function": lambda t0: Wiggle(),
}  # fmt: skip


@pytest.mark.parametrize("steps", [{"rtol": 1e-4}, {"step": 1e-4}], ids=["tolerance", "step"])
@pytest.mark.parametrize("kind", MOTIONS)
def test_a_run_that_counts_from_a_unix_clock_is_the_run_from_zero(kind, steps):
    runs = []
    for t0 in (0.0, CLOCK):
        one = disc(MOTIONS[kind](t0))
        y0 = one.state(disc={"y": 0.032, "v_y": -0.3}) if one.layout.rigid else one.state()
        runs.append(simulate(one, t0 + T, y0=y0, **steps))
    zero, late = runs
    assert torch.equal(late.t, CLOCK + T)
    assert (float(late.knots[0]), float(late.knots[-1])) == (CLOCK, float(late.t[-1]))
    assert float(zero["disc.load_y"].max()) > 0.1
    near = 2e-3 if kind == "function" else 1e-9  # the function is evaluated to 2e-7 s
    for name in ("y_disc", "disc.load_y"):
        scale = float(zero[name].abs().max())
        assert float((late[name] - zero[name]).abs().max()) < near * scale
    assert abs(late.stats.steps - zero.stats.steps) <= (10 if kind == "function" else 0)


def test_gradients_from_a_unix_clock_are_those_from_zero():
    found = []
    for t0 in (0.0, CLOCK):
        one = disc(MOTIONS["profile"](t0))
        values = one.reference["disc.y"].values.requires_grad_(True)
        wrt = [one.parameter("pads.gel.material.E"), values]
        run = simulate(one, t0 + T, y0=one.state().detach(), rtol=1e-4, gradient="discrete")
        found.append(torch.autograd.grad(run["disc.load_y"].sum(), wrt))
    for zero, late in zip(*found):
        assert torch.allclose(late, zero, rtol=1e-6)


def test_errors_give_the_user_s_time_and_times_that_are_not_resolved_are_rejected():
    one, falling = disc(Lost()), disc()
    with pytest.raises(ValueError, match=r"not finite at t = 17000000"):
        simulate(one, CLOCK + T, y0=one.state())
    with pytest.raises(ValueError, match="count them from the beginning of the run"):
        simulate(falling, CLOCK + T / 1e4, y0=falling.state(disc={"y": 0.032}))
