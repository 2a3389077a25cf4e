"""The graph: duality of every transformer, rigid motions without flow, and the names of the
paper."""

import pytest
import torch
from conftest import coarse, random_state

from torchsoft.physics.multibond import net_efforts, to_dot, topology


def test_the_moment_arm_is_the_points_and_not_the_radius():
    """The paper's Eq. 5-6 give |d|, not R, in v_T: with R on the flow side alone, power is lost at
    penetrated nodes."""
    model = coarse()
    graph = model.evaluate(0.0, model.unpack(random_state(model, 0)))
    frame = graph.interfaces["L"].frame
    arm = graph.ports["contact_L"].transformer.blocks["disc_spin"].matrix[..., 1, 0]
    assert torch.allclose(arm, frame.d.norm(dim=-1), rtol=1e-14)
    assert (
        float((arm.detach() - model.parameter("disc.radius").detach())[frame.g > 0].abs().max())
        > 1e-5
    )


@torch.no_grad()
def test_bracket_moment_is_the_bonded_nodes_sum():
    """Eq. 35: the moment at the constrained rotation is the sum over bonded nodes of r x F, plus
    that of the displacements with the forces on the nodes that move, which linear elasticity leaves
    out."""
    model = coarse(pad__inertial=True)
    state = model.unpack(random_state(model, 3))
    graph = model.evaluate(0.0, state)
    moment = float(net_efforts(graph.ports, model.junctions)["bracket_spin"])
    pad, u = model.pads["U"], model.displacement("U", state)
    mesh, material, axes = pad.mesh, pad.material, pad.axes
    port = graph.ports["pad_U"]
    strain = u + material.chain()[1] * port.transformer.flow(graph.flows)
    lame_lambda, lame_mu = (x.item() for x in pad.factors()[2:])
    K_lambda, K_mu, _ = mesh.matrices
    K = mesh.assemble(
        material.depth.item() * (lame_lambda * K_lambda + lame_mu * K_mu), all_nodes=True
    )
    displaced = torch.zeros(len(mesh.nodes), 2, dtype=torch.float64)
    displaced[torch.from_numpy(mesh.free)] = strain @ axes
    on_nodes = torch.from_numpy(K @ displaced.flatten().numpy()).reshape(-1, 2) @ axes.mT
    bonded, base = torch.from_numpy(mesh.bonded), torch.from_numpy(pad.placed(mesh.nodes))
    F, r = (
        -on_nodes[bonded],
        base[bonded],
    )  # the bracket receives the opposite of what holds the nodes
    cross = lambda r, F: float((r[:, 0] * F[:, 1] - r[:, 1] * F[:, 0]).sum())
    assert cross(r, F) + cross(u, port.effort) == pytest.approx(moment, rel=1e-9)


def test_topology_names_the_rigs_elements():
    model = coarse()
    graph = topology(
        model.evaluate(0.0, model.unpack(random_state(model, 0))).ports, model.junctions
    )
    labels = {data["label"] for _, data in graph.nodes(data=True)}
    assert {
        "C: K_n,L",
        "R: R_n,L",
        "C: K_t,U",
        "R: slip_U",
        "C: Kp",
        "R: Kd",
        "Se: m_C g",
        "Sf: 0",
    } <= labels
    signals = [(a, b) for a, b, data in graph.edges(data=True) if data["activated"]]
    assert signals == [
        ("disc", "control_x")
    ]  # the non-collocated loop: senses the disc, pushes the bracket
    assert "style=dashed" in to_dot(graph)


def test_sensing_the_bracket_makes_the_horizontal_loop_collocated():
    model = coarse(control__senses="bracket.x")
    graph = topology(
        model.evaluate(0.0, model.unpack(random_state(model, 0))).ports, model.junctions
    )
    assert not [edge for *edge, data in graph.edges(data=True) if data["activated"]]
