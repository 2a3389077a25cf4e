"""The multibond graph: its moment on the bracket against assembled forces, and its drawing."""

import pytest
import torch
from conftest import coarse, random_state
from rig_tester import at_random
from test_every_rig import RIGS

from torchsoft.physics.contact import turned
from torchsoft.physics.multibond import net_efforts, to_dot, topology


@torch.no_grad()
def test_the_moment_on_the_bracket_is_that_of_the_bonded_nodes():
    """Eq. 35: the sum over bonded nodes of r x F, plus that of the displacements with the forces on
    the nodes that move, which linear elasticity leaves out."""
    model = coarse(pad__inertial=True)
    state = model.unpack(random_state(model, 3))
    graph = model.evaluate(0.0, state)
    moment = float(net_efforts(graph.ports, model.junctions)["bracket_spin"])
    pad, u = model.pads["U"], model.displacement("U", state)
    mesh, material, axes = pad.mesh, pad.material, pad.axes
    port = graph.ports["pad_U"]
    strain = u + material.chain()[1] * port.transformer.flow(graph.flows)
    lame_lambda, lame_mu = (x.item() for x in pad.factors()[2:])
    displaced = torch.zeros(len(mesh.nodes), 2, dtype=torch.float64)
    displaced[torch.from_numpy(mesh.free)] = strain @ axes
    K = material.depth.item() * mesh.stiffness(lame_lambda, lame_mu, all_nodes=True)
    force = torch.from_numpy(K @ displaced.flatten().numpy()).reshape(-1, 2) @ axes.mT
    bonded, base = torch.from_numpy(mesh.bonded), torch.from_numpy(pad.placed(mesh.nodes))
    cross = lambda r, F: float((r[:, 0] * F[:, 1] - r[:, 1] * F[:, 0]).sum())
    expected = cross(base[bonded], -force[bonded]) + cross(u, port.effort)
    assert moment == pytest.approx(expected, rel=1e-9)


@torch.no_grad()
def test_flows_of_nodes_are_the_rates_of_their_places_on_turning_bases():
    start, t, h = RIGS["turning jaws"](), 0.01, 1e-7
    rig, y = start[0], at_random(start, 0)
    rate, flows = rig(t, y), rig.evaluate(t, rig.unpack(y, t=t)).flows

    def places(name: str, h: float) -> torch.Tensor:
        state = rig.unpack(y + h * rate, t=t + h)
        (place, _), u = rig.base_motion(name, state), rig.displacement(name, state)
        return place[:2] + turned(rig.pads[name].positions + u, place[2])

    for name in rig.pads:
        expected = (places(name, h) - places(name, -h)) / (2 * h)
        assert (flows[f"pad_{name}"] - expected).abs().max() < 1e-6 * expected.abs().max()


@pytest.mark.parametrize("senses", ["disc.x", "bracket.x"])
def test_a_drawing_names_elements_and_shows_loops_that_are_not_collocated_as_signals(senses):
    model = coarse(control__senses=senses)
    state = model.unpack(random_state(model, 0))
    graph = topology(model.evaluate(0.0, state).ports, model.junctions)
    labels = {data["label"] for _, data in graph.nodes(data=True)}
    assert {"C: K_n,L", "R: slip_U", "C: Kp", "R: Kd", "Se: m_C g", "Sf: 0"} <= labels
    signals = [tuple(edge) for *edge, data in graph.edges(data=True) if data["activated"]]
    assert signals == ([("disc", "control_x")] if senses == "disc.x" else [])
    assert ("style=dashed" in to_dot(graph)) == bool(signals)
