"""Actuators with states of their own, integral action and a lag, and with a limit."""

from typing import ClassVar

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RUBBER, f64, times
from scipy.linalg import expm
from torch import Tensor, nn

from torchsoft import (
    PD,
    Actuator,
    Body,
    Integral,
    KelvinVoigt,
    Lagging,
    Pad,
    PadMesh,
    Profile,
    Reference,
    Rig,
    Trajectory,
    simulate,
    simulate_batch,
)
from torchsoft.physics.state import OwnState
from torchsoft.solve.diagnostics import linearised
from torchsoft.sysid import Problem, Sensor, Unknown, identify, record
from torchsoft.testing import check_gradients, check_law

MASS, KP, KD, KI, LAG, PULLED = 0.4, 400.0, 20.0, 3e3, 8e-3, 1e-3
KI_Y, LAG_Y = "actuators.y.Ki", "actuators.y.lag"


def cart(law: nn.Module, limit: float | None = None) -> Rig:
    """A body on no ground, `PULLED` towards its set-point by a law."""
    rubber = KelvinVoigt(**RUBBER, tau=0.01)
    return Rig(
        bodies={"cart": Body(MASS, y=1.0, theta=0.0, weighted=False)},
        pads={"pad": Pad(PadMesh(20e-3, 4e-3, 4, 1), rubber)},
        contacts={},
        actuators={"x": Actuator("cart.x", "cart.x", law, setpoint="x_d", limit=limit)},
        reference=Reference(x_d=Profile([0.0], [PULLED])),
    )


def exact(A: np.ndarray, y: list[float], t: Tensor) -> np.ndarray:
    """States of y' = A y at t."""
    return np.stack([expm(A * float(one)) @ y for one in t])


def test_a_lag_is_that_of_a_linear_system_from_the_effort_of_the_start():
    """m x'' = F, lag F' = Kp (w - x) - Kd x' - F, of the error e = x - w."""
    rig, t = cart(Lagging(PD(KP, KD), LAG)), times(0.2, 21)
    y0 = rig.state(cart={"x": 0.0})
    assert rig.unpack(y0).control["x"].item() == pytest.approx(KP * PULLED, rel=1e-12)
    run = simulate(rig, t, y0=y0, rtol=1e-7)
    A = np.array([[0, 1, 0], [0, 0, 1 / MASS], [-KP / LAG, -KD / LAG, -1 / LAG]])
    wanted = exact(A, [-PULLED, 0.0, KP * PULLED], t)
    for ours, column in zip((run["x_cart"] - PULLED, run["v_x_cart"], run["effort_x"]), wanted.T):
        np.testing.assert_allclose(ours.detach(), column, atol=1e-5 * np.abs(column).max())


def test_an_integral_is_that_of_a_linear_system():
    """m x'' = Kp (w - x) - Kd x' + Ki I, I' = w - x."""
    rig, t = cart(Integral(PD(KP, KD), KI)), times(0.4, 21)
    run = simulate(rig, t, y0=rig.state(cart={"x": 0.0}), rtol=1e-7)
    A = np.array([[0, 1, 0], [-KP / MASS, -KD / MASS, KI / MASS], [-1, 0, 0]])
    wanted = exact(A, [-PULLED, 0.0, 0.0], t)
    integral = run.state.control["x"][:, 0]
    for ours, column in zip((run["x_cart"] - PULLED, run["v_x_cart"], integral), wanted.T):
        np.testing.assert_allclose(ours.detach(), column, atol=1e-5 * np.abs(column).max())


def test_an_integral_holds_a_load_that_gains_alone_let_sink():
    """The grip at the set-point of the height, without the force that the file holds it by."""
    file = PAPER.override(COARSE | {"motion.F_ff": {"kind": "hold", "value": 0.0}})
    sinks = {}
    for Ki in (0.0, 5e6):
        run = file.override({KI_Y: Ki}).build().run(times(1.5, 16), rtol=1e-4)
        sinks[Ki] = float(run["y_Br"][-1] - run["y_d"][-1])
    assert sinks[0.0] > 3e-4
    assert abs(sinks[5e6]) < 1e-5


@pytest.mark.parametrize("lag", [2e-3, 2e-7])
def test_a_rig_file_has_both_and_a_run_keeps_their_states(tmp_path, lag):
    file = PAPER.override(COARSE | {KI_Y: 1e6, LAG_Y: lag, "actuators.x.lag": 1e-3})
    built = file.build()
    assert file.unit_of(KI_Y) == "N/(m.s)"
    known = {name: built.rig.quantity(name) for name in (KI_Y, LAG_Y)}
    assert [one and one.unit for one in known.values()] == ["N/(m.s)", "s"]
    assert built.rig.actuators["y"].states == {"integral": "m.s", "effort": "N"}
    units = [(one.field, one.name, unit) for one, _, unit in built.rig.layout.groups()]
    assert units[-3:] == [("control", "x", "N"), ("control", "y", "m.s"), ("control", "y", "N")]
    assert ("pads", "L", "N") in units
    assert [unit for field, name, unit in units if (field, name) == ("pose", "disc")] == [
        "m",
        "rad",
    ]
    run = simulate(built.rig, times(0.3, 4), y0=built.y0, rtol=1e-4)
    run.save(tmp_path / "run.nc")
    again = Trajectory.load(tmp_path / "run.nc")
    assert torch.equal(again.y, run.y)
    assert {k: x.shape for k, x in again.state.control.items()} == {"x": (4, 1), "y": (4, 2)}
    np.testing.assert_array_equal(again["F_y"], again.state.control["y"][:, 1])
    batch = simulate_batch(
        built.rig, times(0.3, 4), y0=built.y0, parameters={LAG_Y: f64(lag, 2 * lag)}, rtol=1e-4
    )
    assert torch.equal(batch.y[0], run.y)
    A = linearised(built.rig, built.y0, built.rig.reference)
    assert float(torch.linalg.eigvals(A).real.min()) <= -0.9 / lag


def test_gradients_of_gains_and_lags_hold_against_differences():
    """In the grasp, where nothing touches down."""
    states = {
        f"actuators.{axis}.{key}": x for axis in "xy" for key, x in (("Ki", 1e6), ("lag", 1e-3))
    }
    built = PAPER.override(COARSE | states).build()
    y = built.run(times(0.6, 4), rtol=1e-5).y[-1].detach()
    check_gradients(built.rig, 0.6 + times(0.1, 5), y, wrt=[*states, "actuators.y.Kp"])


def test_a_gain_and_a_lag_are_identified_from_motion_and_effort():
    file = PAPER.override(COARSE | {KI_Y: 1e6, LAG_Y: 4e-3, "outputs.snapshots": []})
    truth = {KI_Y: 1.4e6, LAG_Y: 6e-3}
    sensors = {"y_Br": Sensor(noise=1e-5), "F_y": Sensor(noise=0.1)}
    nominal = file.override({"outputs.duration": 0.5, "outputs.interval": 5e-3}).build()
    recording = record("grasp", nominal, truth, sensors, noise=0.0)
    unknowns = {name: Unknown() for name in truth}
    answer = identify(Problem([recording], sensors, unknowns), assumptions="trusted")
    for name, value in truth.items():
        assert answer[name].identifiable
        assert answer[name].value == pytest.approx(value, rel=2e-3)


def test_an_effort_saturates_at_its_limit():
    """A constant force until the law says less, and the gradient by the limit until then."""
    limit = 0.25 * KP * PULLED
    rig, t = cart(PD(KP, KD), limit), times(0.08, 41)
    y0 = rig.state(cart={"x": 0.0})
    run = simulate(rig, t, y0=y0, rtol=1e-7)
    fallen = 0.5 * limit / MASS * t**2
    wanted = KP * (PULLED - fallen) - KD * limit / MASS * t
    held = wanted > limit
    assert 10 < held.sum() < 40
    np.testing.assert_allclose(run["x_cart"][held].detach(), fallen[held], atol=1e-9)
    np.testing.assert_allclose(run["effort_x"][held].detach(), limit, rtol=1e-12)
    assert (run["effort_x"][~held] < limit).all()
    opposite = simulate(rig, t, y0=rig.state(cart={"x": 2 * PULLED}), rtol=1e-7)
    np.testing.assert_allclose(opposite["effort_x"].detach(), -run["effort_x"].detach(), atol=1e-9)
    check_gradients(rig, t[:10], y0, wrt=["actuators.x.limit", "bodies.cart.mass"])


def test_a_rig_file_limits_an_effort_that_has_a_lag():
    name, most = "actuators.y.limit", 60.0
    file = PAPER.override(COARSE | {LAG_Y: 2e-3, name: most})
    assert file.unit_of(name) == "N"
    built = file.build()
    assert built.rig.actuators["y"].elements[-2:] == ("Se: lag", "Se: limit")
    assert "Lagging limit 60 N\n" in str(built.rig)
    efforts = [
        one.run(times(0.3, 31), rtol=1e-4)["effort_y"].abs().max().item()
        for one in (PAPER.override(COARSE | {LAG_Y: 2e-3}).build(), built)
    ]
    assert efforts[0] > 1.01 * most
    assert efforts[1] == pytest.approx(most, rel=1e-12)
    with pytest.raises(ValueError, match=r"actuators\.y\.limit"):
        PAPER.override({name: 0.0})


class Wrong(nn.Module):
    """A law whose rates are of another number than its states."""

    states: ClassVar = {"memory": OwnState("q.s")}

    def forward(self, w, w_dot, fed, q, q_dot, z, stage):
        return w - q + z[..., 0], torch.stack((w, q), -1)


def test_what_cannot_be_is_refused():
    rig = cart(Wrong())
    with pytest.raises(TypeError, match=r"gives a tensor of shape \(2,\) for the rates of its sta"):
        simulate(rig, times(0.1, 2), y0=rig.state(cart={"x": 0.0}))
    with pytest.raises(ValueError, match=r"put the lag around it: Lagging\(Integral"):
        Integral(Lagging(PD(KP, KD), LAG), KI)
    with pytest.raises(ValueError, match="the gains Kp, Kd and Ki need a motion to follow"):
        PAPER.override({"actuators.y.setpoint": None, "actuators.y.Ki": 1.0})
    with pytest.raises(ValueError, match=r"actuators\.y\.lag"):
        PAPER.override({LAG_Y: -1.0})
    check_law(Lagging(PD(1.0, 1.0), 1e-3))
