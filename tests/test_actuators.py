"""What every actuator guarantees, against linear systems: motion, effort, states, power, gradients,
saturation; and actuators of rig files."""

from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RUBBER, times
from scipy.linalg import expm
from torch import nn

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
    StateFeedback,
    controller,
    simulate,
)
from torchsoft.physics.multibond import topology
from torchsoft.physics.parts import Guide
from torchsoft.physics.state import OwnState
from torchsoft.solve.diagnostics import linearised
from torchsoft.testing import check_energy, check_gradients, check_law, check_power

MASS, KP, KD, KI, LAG, PULLED = 0.4, 400.0, 20.0, 3e3, 8e-3, 1e-3


def loop(law: nn.Module, limit: float | None = None) -> dict[str, Actuator]:
    return {"x": Actuator("cart.x", "cart.x", law, setpoint="x_d", limit=limit)}


def cart(actuators: dict[str, Any]) -> Rig:
    """A body on no ground, `PULLED` towards its set-point."""
    rubber = KelvinVoigt(**RUBBER, tau=0.01)
    return Rig(
        bodies={"cart": Body(MASS, y=1.0, theta=0.0, weighted=False)},
        pads={"pad": Pad(PadMesh(20e-3, 4e-3, 4, 1), rubber)}, contacts={}, actuators=actuators,
        reference=Reference(x_d=Profile([0.0], [PULLED])),
    )  # fmt: skip


# A new actuator is one line: rows of y' = A y of the error x - w, its rate and the law's states.
PULL = [0, 1], [-KP / MASS, -KD / MASS]
ACTUATORS = {
    "PD": (lambda: loop(PD(KP, KD)), [*PULL]),
    "feedback": (lambda: controller(
        StateFeedback([[KP, KD]]), measures=["cart.x"], setpoints=["x_d"], pushes={"x": "cart.x"}),
        [*PULL]),
    "integral": (lambda: loop(Integral(PD(KP, KD), KI)),
                 [[0, 1, 0], [*PULL[1], KI / MASS], [-1, 0, 0]]),
    "lag": (lambda: loop(Lagging(PD(KP, KD), LAG)),
            [[0, 1, 0], [0, 0, 1 / MASS], [-KP / LAG, -KD / LAG, -1 / LAG]]),
    "lag of an integral": (lambda: loop(Lagging(Integral(PD(KP, KD), KI), LAG)), [
        [0, 1, 0, 0], [0, 0, 0, 1 / MASS], [-1, 0, 0, 0],
        [-KP / LAG, -KD / LAG, KI / LAG, -1 / LAG]]),
}  # fmt: skip


@pytest.mark.parametrize("name", ACTUATORS)
def test_a_body_on_an_actuator_moves_as_its_linear_system(name):
    """From the effort of the start; power is balanced, and gradients are those of differences."""
    make, rows = ACTUATORS[name]
    rig, t, A = cart(make()), times(0.2, 11), np.array(rows)
    y0 = rig.state(cart={"x": 0.0})
    begin = np.zeros(len(A))
    begin[0] = -PULLED
    if "lag" in name:
        begin[-1] = KP * PULLED
        assert rig.unpack(y0).control["x"][-1].item() == pytest.approx(KP * PULLED, rel=1e-12)
    wanted = np.stack([expm(A * float(one)) @ begin for one in t])
    run = simulate(rig, t, y0=y0, rtol=1e-7)
    found = [run["x_cart"] - PULLED, run["v_x_cart"]]
    if len(A) > 2:
        found += run.state.control["x"].unbind(-1)
    for ours, column in zip(found, wanted.T, strict=True):
        np.testing.assert_allclose(ours.detach(), column, atol=1e-5 * np.abs(column).max())
    effort = MASS * (wanted @ A.T)[:, 1]
    np.testing.assert_allclose(run["effort_x"].detach(), effort, atol=1e-5 * effort.max())
    check_power(rig, run.y[3])
    checked = check_gradients(rig, t[:4], y0, each=False, step_error=False)
    assert all(one.clear for one in checked.derivatives)


def test_an_effort_saturates_at_its_limit():
    """A constant force until the law says less, and the gradient with respect to the limit."""
    limit = 0.25 * KP * PULLED
    rig, t = cart(loop(PD(KP, KD), limit)), times(0.08, 41)
    y0 = rig.state(cart={"x": 0.0})
    run = simulate(rig, t, y0=y0, rtol=1e-7)
    fallen = 0.5 * limit / MASS * t**2
    held = KP * (PULLED - fallen) - KD * limit / MASS * t > limit
    assert 10 < held.sum() < 40
    np.testing.assert_allclose(run["x_cart"][held].detach(), fallen[held], atol=1e-9)
    np.testing.assert_allclose(run["effort_x"][held].detach(), limit, rtol=1e-12)
    assert (run["effort_x"][~held] < limit).all()
    opposite = simulate(rig, t, y0=rig.state(cart={"x": 2 * PULLED}), rtol=1e-7)
    np.testing.assert_allclose(opposite["effort_x"].detach(), -run["effort_x"].detach(), atol=1e-9)
    check_gradients(rig, t[:10], y0, wrt=["actuators.x.limit", "bodies.cart.mass"])


def test_a_guide_is_a_resistance():
    """Its power is dissipated, not supplied, and equals the energy that a free body loses."""
    guides = {
        axis: Actuator(f"slider.{axis}", f"slider.{axis}", Guide(*numbers), setpoint=(),
                       elements=(f"R: guide of {axis}",))
        for axis, numbers in (("x", (0.3, 2.0)), ("theta", (1e-3, 5e-3)))
    }  # fmt: skip
    body = Body(0.5, y=0.0, inertia=1e-3, weighted=False)
    rig = Rig(bodies={"slider": body}, pads={}, contacts={}, actuators=guides)
    y0 = rig.state(slider={"x": 0.0, "v_x": 0.4, "omega": 3.0})
    run = check_energy(rig, times(1.0, 51), y0, rtol=1e-6)
    for axis, kinetic in (("x", "slider"), ("theta", "slider_spin")):
        lost = run.energy[kinetic][0] - run.energy[kinetic]
        assert torch.allclose(run.dissipated[f"control_{axis}"], lost, rtol=1e-3, atol=1e-9)
    assert {*run.supplied} == {"gravity"}
    assert float(run.injected[-1]) == 0.0
    graph = topology(rig.evaluate(0.0, rig.unpack(y0)).ports, rig.junctions)
    assert graph.nodes["control_x: R: guide of x"]["kind"] == "R"
    assert ("control_x", "control_x: R: guide of x") in graph.edges  # power goes in
    assert ("slider", "control_x") in graph.edges


KI_Y, LAG_Y, LIMIT_Y = "actuators.y.Ki", "actuators.y.lag", "actuators.y.limit"


def test_a_rig_file_has_integral_lag_and_limit_with_units():
    most = 60.0
    file = PAPER.override(COARSE | {KI_Y: 1e6, LAG_Y: 2e-3, LIMIT_Y: most})
    assert [file.unit_of(name) for name in (KI_Y, LAG_Y, LIMIT_Y)] == ["N/(m.s)", "s", "N"]
    built = file.build()
    assert built.rig.quantity(KI_Y).unit == "N/(m.s)"
    assert built.rig.actuators["y"].states == {"integral": "m.s", "effort": "N"}
    run = simulate(built.rig, times(0.3, 31), y0=built.y0, rtol=1e-4)
    assert run["effort_y"].abs().max().item() == pytest.approx(most, rel=1e-12)
    assert {k: x.shape for k, x in run.state.control.items()} == {"y": (31, 2)}


def test_a_lag_is_the_fastest_mode_of_a_rig():
    lag = 2e-7
    built = PAPER.override(COARSE | {LAG_Y: lag}).build()
    A = linearised(built.rig, built.y0, built.rig.reference)
    assert float(torch.linalg.eigvals(A).real.min()) <= -0.9 / lag


class Wrong(nn.Module):
    """A law whose rates are of another number than its states."""

    states: ClassVar = {"memory": OwnState("q.s")}

    def forward(self, w, w_dot, fed, q, q_dot, z, stage):
        return w - q + z[..., 0], torch.stack((w, q), -1)


def test_laws_with_wrong_states_are_rejected():
    rig = cart(loop(Wrong()))
    with pytest.raises(TypeError, match=r"gives a tensor of shape \(2,\) for the rates of its sta"):
        simulate(rig, times(0.1, 2), y0=rig.state(cart={"x": 0.0}))
    with pytest.raises(ValueError, match=r"put the lag around it: Lagging\(Integral"):
        Integral(Lagging(PD(KP, KD), LAG), KI)
    with pytest.raises(ValueError, match="the gains Kp, Kd and Ki need a motion to follow"):
        PAPER.override({"actuators.y.setpoint": None, "actuators.y.Ki": 1.0})
    check_law(Lagging(PD(1.0, 1.0), 1e-3))
