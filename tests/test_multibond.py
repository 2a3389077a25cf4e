"""The graph: duality of every transformer, rigid motions without flow, and the names of the paper."""

from collections.abc import Callable

import pytest
import torch
from conftest import coarse, f64, random_state, turning

from torchsoft import Rig
from torchsoft.physics.multibond import net_efforts, to_dot, topology

SEEDS = range(4)


def random_flows(model: Rig, seed: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        name: torch.randn(junction.nodes, junction.width, generator=generator, dtype=torch.float64)
        for name, junction in model.junctions.items()
    }


@pytest.mark.parametrize("seed", SEEDS)
def test_every_transformer_is_dual(build: Callable[..., Rig], seed: int) -> None:
    """<e, T v> = <T^T e, v> for arbitrary efforts and flows."""
    model = build()
    graph = model.evaluate(0.0, model.unpack(random_state(model, seed)))
    v = random_flows(model, seed)
    for name, port in graph.ports.items():
        flow = port.transformer.flow(v)
        e = torch.randn(flow.shape, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
        back = port.transformer.effort(e, model.junctions)
        forward = (e * flow).sum()
        backward = sum((back[j] * v[j]).sum() for j in back)
        assert torch.isclose(forward, backward, rtol=1e-12, atol=1e-12), name


@torch.no_grad()
def test_rigid_motion_costs_no_flow(build: Callable[..., Rig]) -> None:
    """When everything, ground included, moves with one velocity, neither pads nor contacts see it; nor do contacts see
    a common rotation about the disc's centre."""
    model = build()
    state = model.unpack(random_state(model, 0))
    graph = model.evaluate(0.0, state)
    v = {name: torch.zeros(j.nodes, j.width, dtype=torch.float64) for name, j in model.junctions.items()}
    for name in ("pad_L", "pad_U", "ground", "disc", "bracket"):
        v[name][:] = f64(0.3, -0.7)
    for name in ("pad_L", "pad_U", "contact_L", "contact_U"):
        assert float(graph.ports[name].transformer.flow(v).abs().max()) < 1e-15
    for k in "LU":
        nodes = model.pads[k].surface
        d = torch.zeros(model.pads[k].nodes, 2, dtype=torch.float64)
        d[nodes] = graph.interfaces[k].frame.d
        spinning = {name: torch.zeros_like(flow) for name, flow in v.items()}
        spinning["disc_spin"][:] = 2.0
        spinning[f"pad_{k}"][:] = 2.0 * torch.stack((-d[:, 1], d[:, 0]), -1)
        assert float(graph.ports[f"contact_{k}"].transformer.flow(spinning).abs().max()) < 1e-15


@torch.no_grad()
def test_a_pad_that_turns_with_its_base_is_not_strained() -> None:
    """Base and nodes in one rotation about any point: no strain rate, and no force."""
    model = turning()
    state = model.unpack(random_state(model, 0))
    graph = model.evaluate(0.0, state)
    v = {name: torch.zeros(j.nodes, j.width, dtype=torch.float64) for name, j in model.junctions.items()}
    r_B, angle = state.pose["bracket"][:2], state.pose["bracket"][2]
    c, s = torch.cos(angle), torch.sin(angle)
    arm = (model.pads["U"].positions + model.displacement("U", state)) @ torch.stack((c, s, -s, c)).reshape(2, 2)
    about = f64(0.02, 0.01)
    turned = lambda r: 3.0 * torch.stack((-r[..., 1], r[..., 0]), -1)
    v["bracket"][:], v["bracket_spin"][:], v["pad_U"][:] = turned(r_B - about), 3.0, turned(r_B + arm - about)
    assert float(graph.ports["pad_U"].transformer.flow(v).abs().max()) < 1e-15


def test_the_moment_arm_is_the_points_and_not_the_radius() -> None:
    """The paper's Eq. 5-6 give |d|, not R, in v_T: with R on the flow side alone, power is lost at penetrated nodes."""
    model = coarse()
    graph = model.evaluate(0.0, model.unpack(random_state(model, 0)))
    frame = graph.interfaces["L"].frame
    arm = graph.ports["contact_L"].transformer.blocks["disc_spin"].matrix[..., 1, 0]
    assert torch.allclose(arm, frame.d.norm(dim=-1), rtol=1e-14)
    assert float((arm.detach() - model.parameter("disc.radius").detach())[frame.g > 0].abs().max()) > 1e-5


@torch.no_grad()
def test_bracket_moment_is_the_bonded_nodes_sum() -> None:
    """Eq. 35: the moment at the constrained rotation is the sum over bonded nodes of r x F, plus that of the displacements
    with the forces on the nodes that move, which linear elasticity leaves out."""
    model = coarse(pad__fidelity="inertial")
    state = model.unpack(random_state(model, 3))
    graph = model.evaluate(0.0, state)
    moment = float(net_efforts(graph.ports, model.junctions)["bracket_spin"])
    pad, u = model.pads["U"], model.displacement("U", state)
    mesh, material, axes = pad.mesh, pad.material, pad.axes
    port = graph.ports["pad_U"]
    strain = u + material.chain()[1] * port.transformer.flow(graph.flows)
    lame_lambda, lame_mu = (x.item() for x in material.lame())
    K_lambda, K_mu, _ = mesh.matrices
    K = mesh.assemble(material.depth.item() * (lame_lambda * K_lambda + lame_mu * K_mu), all_nodes=True)
    displaced = torch.zeros(len(mesh.nodes), 2, dtype=torch.float64)
    displaced[torch.from_numpy(mesh.free)] = strain @ axes
    on_nodes = torch.from_numpy(K @ displaced.flatten().numpy()).reshape(-1, 2) @ axes.mT
    bonded, base = torch.from_numpy(mesh.bonded), torch.from_numpy(pad.placed(mesh.nodes))
    F, r = -on_nodes[bonded], base[bonded]  # the bracket receives the opposite of what holds the nodes
    cross = lambda r, F: float((r[:, 0] * F[:, 1] - r[:, 1] * F[:, 0]).sum())
    assert cross(r, F) + cross(u, port.effort) == pytest.approx(moment, rel=1e-9)


def test_topology_names_the_rigs_elements() -> None:
    model = coarse()
    graph = topology(model.evaluate(0.0, model.unpack(random_state(model, 0))).ports, model.junctions)
    labels = {data["label"] for _, data in graph.nodes(data=True)}
    assert {"C: K_n,L", "R: R_n,L", "C: K_t,U", "R: slip_U", "C: K_81^-1", "R: R_99", "Se: m_C g", "Sf: 0"} <= labels
    signals = [(a, b) for a, b, data in graph.edges(data=True) if data["activated"]]
    assert signals == [("disc", "control_x")]  # the non-collocated loop: senses the disc, pushes the bracket
    assert "style=dashed" in to_dot(graph)


def test_sensing_the_bracket_makes_the_horizontal_loop_collocated() -> None:
    model = coarse(control__senses="bracket")
    graph = topology(model.evaluate(0.0, model.unpack(random_state(model, 0))).ports, model.junctions)
    assert not [edge for *edge, data in graph.edges(data=True) if data["activated"]]
