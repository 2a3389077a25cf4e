"""Rate-and-state friction: velocity steps, rests and sliders as in textbooks."""

import tomllib
from typing import Any

import numpy as np
import pytest
import torch

from torchsoft import BuiltRig, Reference, RigFile, Trajectory, simulate
from torchsoft.physics.contact import FADING
from torchsoft.physics.motion import Lines
from torchsoft.rigs.check import check

MU_0, A, B, D_C, V_0 = 0.6, 0.012, 0.02, 50e-6, 1e-3
SLOW, FAST, JUMP = 1e-3, 1e-2, 0.6


FRICTION = {"kind": "rate_and_state", "mu_0": MU_0, "a": A, "b": B, "D_c": D_C, "V_0": V_0,
            "theta_0": D_C / SLOW}  # fmt: skip


SLED = """
title = "velocity steps"
[bodies.block]
mass = 0.1
x = "driven"
y = 13.99e-3
theta = 0.0
weighted = false
shape = {kind = "rounded_box", half_width = 6e-3, half_height = 4e-3, radius = 2e-3}
[materials.plastic]
kind = "kelvin_voigt"
E = 2e8
nu = 0.3
tau = 1e-4
depth = 10e-3
[pads.track]
material = "plastic"
origin = [-20e-3, 0.0]
length = 40e-3
height = 10e-3
elements_x = 40
elements_y = 4
[laws.dry]
K_n = 1e5
R_n = 10.0
K_t = 1e6
R_t = 20.0
[contacts]
track = {pad = "track", body = "block", law = "dry"}
[motion."block.x"]
kind = "profile"
times = [0.0, 1.0]
values = [0.0, 1e-3]
[outputs]
duration = 0.7
interval = 1e-3
video = "none"
figures = false
"""


def sled(**friction: Any) -> RigFile:
    """A block that is drawn over a stiff pad, slowly and then ten times as fast, under the friction
    of these tests with other numbers, or of another `kind`."""
    tree = tomllib.loads(SLED)
    tree["laws"]["dry"]["friction"] = friction if "kind" in friction else FRICTION | friction
    return RigFile.from_tree(tree)


STEP = Reference(**{"block.x": Lines(
    [0.0, JUMP, JUMP + 0.1], [0.0, SLOW * JUMP, SLOW * JUMP + FAST * 0.1]
)})  # fmt: skip


def drawn(built: BuiltRig, rows: int | None = None) -> Trajectory:
    """A run along the velocity step."""
    return simulate(built.rig, built.t[:rows], y0=built.y0, reference=STEP, rtol=1e-5)


def steady(V: float) -> float:
    """Friction of steady slip."""
    return MU_0 + (A - B) * np.log(V / V_0)


def test_a_velocity_step_raises_friction_by_a_and_lowers_it_by_b_over_D_c():
    """Of a block on a track that is stiff over D_c: the direct effect a ln(V_2 / V_1), then the
    ageing law's way, theta = D_c / V_2 (1 + (V_2 / V_1 - 1) exp(-slip / D_c)), to the new steady
    friction. Energies balance."""
    built = sled().build()
    run = drawn(built)
    force = run.force["track"].sum(1)
    mu = (force[:, 1] / force[:, 0]).numpy()
    before, after = run.at(JUMP - 2e-3), run.t.numpy() - JUMP
    assert mu[before] == pytest.approx(steady(SLOW), abs=2e-4)
    assert mu[-1] == pytest.approx(steady(FAST), abs=2e-4)
    rise = mu.max() - steady(SLOW)
    assert 0.9 * A * np.log(10) < rise < A * np.log(10)
    for slips in (1.0, 2.0, 3.0):  # in D_c
        i = int(np.argmin(abs(after - slips * D_C / FAST)))
        aged = 1 + (FAST / SLOW - 1) * np.exp(-after[i] * FAST / D_C)
        assert mu[i] == pytest.approx(steady(FAST) + B * np.log(aged), abs=0.05 * B * np.log(10))
    assert run.energy_residual_rel < 1e-3


def test_a_contact_at_rest_grows_stronger_by_b():
    """Static friction after ten times the rest is higher by b ln 10: the age of points that do not
    slip is the time."""
    tops = []
    for rest in (1.0, 10.0):
        built = sled(theta_0=rest, D_c=2e-4).build()
        run = drawn(built, 200)
        force = run.force["track"].sum(1)
        tops.append(float((force[:, 1] / force[:, 0]).max()))
    assert tops[1] - tops[0] == pytest.approx(B * np.log(10), rel=0.1)


def test_a_spring_that_is_too_soft_for_the_fall_of_friction_is_told_of():
    """(b - a) F_N / D_c at the points' share of the load, by the check of a file."""
    (found,) = [one for one in check(sled(D_c=2e-9)) if "single-valued" in one.message]
    assert found.severity == "warning"
    assert "K_t = 1e+06 N/m is below (b - a) F_N / D_c" in found.message
    assert not [one for one in check(sled()) if "single-valued" in one.message]


def test_points_out_of_contact_have_no_age():
    built = sled(theta_0=0.5).build()
    run = drawn(built, 50)
    theta, touches = run.state.friction["track"][:, 0], run.force["track"][..., 0].amax(0) > 0
    assert 0 < int(touches.sum()) < len(touches)
    assert torch.equal(theta[0], 0.5 * touches)
    assert not theta[:, ~touches].any()


@pytest.mark.parametrize("friction", [{}, {"kind": "ageing", "mu_s": 0.6, "mu_k": 0.6}])
def test_the_age_of_a_contact_starts_at_touch_down(friction):
    """A disc comes down at 2.4 mm/s and stays: its lowest point then is as old as it is since its
    height was the radius, and the adjoint has the derivative of that time with respect to the
    start's height. After it has gone up the age fades."""
    tree = sled(**friction).model_dump(exclude_unset=True)
    shape = {"kind": "circle", "radius": 10e-3}
    tree["bodies"]["block"] |= {"x": 0.0, "y": "driven", "shape": shape}
    tree["motion"] = {"block.y": {"kind": "hold", "value": 20.02e-3}}
    tree["outputs"]["duration"] = 0.35
    built = RigFile.from_tree(tree).build()
    heights = torch.tensor([20.02e-3, 19.9e-3, 19.9e-3, 20.02e-3]).double().requires_grad_()
    way = Reference(**{"block.y": Lines(torch.tensor([0.0, 0.05, 0.3, 0.31]).double(), heights)})
    run = simulate(built.rig, built.t, y0=built.y0, reference=way, gradient="discrete")
    lowest = run.y[:, built.rig.layout.slices["friction", "track"]][:, 20]
    touches = 0.05 * (20.02e-3 - 20e-3) / 0.12e-3
    assert lowest[300].item() == pytest.approx(0.3 - touches, rel=2e-3)
    parts = 0.3 + 0.01 * (20e-3 - 19.9e-3) / 0.12e-3
    faded = (parts - touches) * np.exp(-(0.35 - parts) / FADING)
    assert lowest[-1].item() == pytest.approx(faded, rel=0.05)
    lowest[300].backward()
    by_height = -0.05 * (20e-3 - 19.9e-3) / 0.12e-3**2
    assert float(heights.grad[0]) == pytest.approx(by_height, rel=0.1)


SLIDER_MASS, G, SPEED = 1.0, 9.81, 1e-3
CRITICAL = (B - A) * SLIDER_MASS * G / D_C


def rates_of(k: float) -> complex:
    """Rate of growth and frequency [1/s] of a slider on a spring k [N/m] of steady slip, for one
    age: u' = V - v, m v' = k u - F_N (mu_v dv + mu_theta dtheta), theta' = 1 - v theta / D_c."""
    theta = D_C / SPEED
    J = np.array([
        [0.0, -1.0, 0.0],
        [k / SLIDER_MASS, -G * A / SPEED, -G * B / theta],
        [0.0, -theta / D_C, -SPEED / D_C],
    ])  # fmt: skip
    return max(np.linalg.eigvals(J), key=lambda rate: rate.imag)


@pytest.mark.parametrize(
    "ratio", [1.3, *(pytest.param(ratio, marks=pytest.mark.slow) for ratio in (1.1, 1.5))]
)
def test_a_spring_slider_is_as_stable_as_linear_theory_has_it(ratio):
    """Over ten nodes, whose points begin with an old age; k_c is that of the mass too,
    1.17 (b - a) F_N / D_c. A thousandth of the age is the disturbance, in a run along the same
    steps."""
    tree = sled(theta_0=100.0).model_dump(exclude_unset=True)
    tree["bodies"]["block"] = {
        "mass": SLIDER_MASS, "theta": 0.0, "start": {"x": 0.0, "v_x": SPEED, "y": "rest"},
        "shape": {"kind": "circle", "radius": 0.1},
    }  # fmt: skip
    tree["pads"]["track"] |= {"origin": [-64e-3, 0.0], "length": 140e-3, "elements_x": 140}
    tree["laws"]["dry"]["K_n"] = 1e4
    tree["actuators"] = {"spring": {"pushes": "block.x", "setpoint": "pull", "Kp": 1.0, "Kd": 0.0}}
    tree["motion"] = {"pull": {"kind": "hold", "value": 0.0}}
    built = RigFile.from_tree(tree).build()

    def pulled(k: float, start: torch.Tensor, x: float, end: float, **how: Any) -> Trajectory:
        with torch.no_grad():
            built.rig.parameter("actuators.spring.Kp").fill_(k)
        t = torch.arange(0.0, end + 1e-9, 5e-3, dtype=torch.float64)
        way = Lines(np.array([0.0, end]), np.array([x, x + SPEED * end]))
        return simulate(built.rig, t, y0=start, reference=Reference(pull=way), **how)

    ahead = steady(SPEED) * SLIDER_MASS * G / (3 * CRITICAL)
    first = pulled(3 * CRITICAL, built.y0, ahead, 1.0, rtol=1e-4)
    ahead = float(first.force["track"][-1, :, 1].sum().abs()) / (ratio * CRITICAL)
    start, x = first.y[-1], float(first["x_block"][-1]) + ahead
    run = pulled(ratio * CRITICAL, start, x, 10.0, rtol=1e-4)
    other = start.clone()
    other[built.rig.layout.slices["friction", "track"]] *= 1 + 1e-3
    changed = pulled(ratio * CRITICAL, other, x, 10.0, knots=run.knots)
    expected = rates_of(ratio * CRITICAL)
    dx, dv = ((changed[name] - run[name]).numpy() for name in ("x_block", "v_x_block"))
    late = run.t.numpy() >= 1.0
    size = np.log(np.hypot(abs(expected) * dx[late], dv[late]))
    growth = np.polyfit(run.t.numpy()[late], size, 1)[0]
    assert growth == pytest.approx(expected.real, rel=0.05)
    force = run.force["track"].sum(1)
    assert float((force[:, 1] / force[:, 0]).mean()) == pytest.approx(steady(SPEED), abs=5e-5)
