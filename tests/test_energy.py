"""Power balance, momentum balance, and nothing that creates energy: at random states of several
rigs, without any stepper."""

import pytest
import torch
from conftest import coarse, f64, random_state

from torchsoft import Body, Rig, simulate
from torchsoft.physics.energy import stored
from torchsoft.physics.multibond import topology
from torchsoft.physics.parts import Actuator, Guide
from torchsoft.rigs import RigFile
from torchsoft.testing import check_energy


def test_stored_energies_by_hand():
    """Springs, spin and translation of a state with one touching node and known velocities."""
    rig = coarse()
    state = rig.unpack(random_state(rig, 2))
    velocity = {"disc": f64(3e-2, 4e-2, 2.0), "bracket": f64(0.0, -0.1, 0.0)}
    with torch.no_grad():
        energy = {
            name: float(x) for name, x in stored(rig, state._replace(velocity=velocity)).items()
        }
        u = rig.displacement("U", state)
        force = torch.linalg.solve(rig.pads["U"].compliance(), u.flatten())
        depth = torch.cat([rig.penetration(k, state).clamp(min=0) for k in "LU"])
        weights, stretch = (
            torch.cat([part[k] for k in "LU"])
            for part in ({k: rig.weight(k) for k in "LU"}, state.stretch)
        )
    assert energy["disc"] == pytest.approx(0.5 * 0.4065 * 0.05**2, rel=1e-14)
    assert energy["bracket"] == pytest.approx(0.5 * 0.4065 * 0.1**2, rel=1e-14)
    assert energy["disc_spin"] == pytest.approx(0.5 * 0.5 * 0.4065 * 19.37e-3**2 * 4.0, rel=1e-13)
    assert energy["strain_U"] == pytest.approx(0.5 * float(force @ u.flatten()), rel=1e-11)
    assert energy["normal_springs"] == pytest.approx(
        float((0.5 * 1.2e5 * weights * depth**2).sum()), rel=1e-13
    )
    assert energy["tangential_springs"] == pytest.approx(
        float((0.5 * 1.2e5 * weights * stretch**2).sum()), rel=1e-13
    )


def test_the_energy_residual_of_a_fall_falls_with_the_tolerance():
    """An ellipse in free flight and on a pad, with long steps between outputs."""
    ready = RigFile.ready("drop").override(outputs={"duration": 0.2, "snapshots": []}).build()
    runs = [simulate(ready.rig, ready.t, y0=ready.y0, rtol=rtol) for rtol in (1e-4, 1e-6)]
    assert runs[0].energy_residual_rel < 2e-4
    assert runs[1].energy_residual_rel < 0.2 * runs[0].energy_residual_rel
    flight = [float(run.energy_residual[run.t < 0.02].abs().max()) for run in runs]
    assert max(flight) < 1e-9 * float(runs[0].injected[-1])


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
    run = check_energy(rig, torch.linspace(0.0, 1.0, 51), y0, rtol=1e-6)
    for axis, kinetic in (("x", "slider"), ("theta", "slider_spin")):
        lost = run.energy[kinetic][0] - run.energy[kinetic]
        assert torch.allclose(run.dissipated[f"control_{axis}"], lost, rtol=1e-3, atol=1e-9)
    assert {*run.supplied} == {"gravity"}
    assert float(run.injected[-1]) == 0.0
    graph = topology(rig.evaluate(0.0, rig.unpack(y0)).ports, rig.junctions)
    assert graph.nodes["control_x: R: guide of x"]["kind"] == "R"
    assert ("control_x", "control_x: R: guide of x") in graph.edges  # power goes in
    assert ("slider", "control_x") in graph.edges
