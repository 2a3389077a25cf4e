"""The graph: duality of every transformer, power balance, momentum balance, and nothing that creates energy."""

import pytest
import torch
from conftest import coarse, random_state

from torchsoft.ledger import dissipated, stored, supplied
from torchsoft.model import SoftGrasp
from torchsoft.multibond import net_efforts, to_dot, topology

SEEDS = range(4)


def random_flows(model: SoftGrasp, seed: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        name: torch.randn(junction.nodes, junction.width, generator=generator, dtype=torch.float64)
        for name, junction in model.junctions.items()
    }


@pytest.mark.parametrize("seed", SEEDS)
def test_every_transformer_is_dual(fidelity: str, seed: int) -> None:
    """<e, T v> = <T^T e, v> for arbitrary efforts and flows."""
    model = coarse(pad__fidelity=fidelity)
    graph = model.evaluate(0.0, model.layout.unpack(random_state(model, seed)))
    v = random_flows(model, seed)
    for name, port in graph.ports.items():
        flow = port.transformer.flow(v)
        e = torch.randn(flow.shape, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
        back = port.transformer.effort(e, model.junctions)
        forward = (e * flow).sum()
        backward = sum((back[j] * v[j]).sum() for j in back)
        assert torch.isclose(forward, backward, rtol=1e-12, atol=1e-12), name


@pytest.mark.parametrize("seed", SEEDS)
def test_power_balance(fidelity: str, friction: str, seed: int) -> None:
    """dH/dt = P_control + P_gravity - D at random states, to rounding: H differentiated by autograd along y'."""
    model = coarse(pad__fidelity=fidelity, contact__friction=friction)
    y = random_state(model, seed).requires_grad_(True)
    energy = sum(stored(model, model.layout.unpack(y)).values())
    (slope,) = torch.autograd.grad(energy, y)
    with torch.no_grad():
        H_dot = (slope * model(0.0, y)).sum()
        state = model.layout.unpack(y)
        graph = model.evaluate(0.0, state)
        supply, loss = supplied(graph), dissipated(model, state, graph)
        powers = torch.stack([*supply.values(), *loss.values()])
        expected = sum(supply.values()) - sum(loss.values())
    assert abs(float(H_dot - expected)) < 1e-9 * float(powers.abs().sum())


@pytest.mark.parametrize("seed", SEEDS)
def test_no_resistor_supplies_power(fidelity: str, friction: str, seed: int) -> None:
    model = coarse(pad__fidelity=fidelity, contact__friction=friction)
    state = model.layout.unpack(random_state(model, seed, slip=0.1))
    with torch.no_grad():
        graph = model.evaluate(0.0, state)
        loss = dissipated(model, state, graph)
        scale = sum(x.abs() for x in loss.values())
        for name, power in loss.items():
            assert power > -1e-12 * scale, name
        for interface in graph.interfaces.values():
            contact = interface.contact
            assert bool(
                (contact.e * contact.gamma_dot >= -1e-13).all()
            )  # [W]; e of a free Coulomb node is 0 to rounding


@pytest.mark.parametrize("seed", SEEDS)
def test_momentum_balance(fidelity: str, seed: int) -> None:
    """Rate of total linear momentum = weight + control forces + ground reaction; internal forces cancel."""
    model = coarse(pad__fidelity=fidelity)
    y = random_state(model, seed)
    with torch.no_grad():
        state, rate = model.layout.unpack(y), model.layout.unpack(model(0.0, y))
        graph = model.evaluate(0.0, state)
        ground = net_efforts(graph.ports, model.junctions)["ground"][0]  # what the lower pad does to the ground
        momentum = model.m_C * rate.v_C + model.m_Br * rate.v_Br
        if fidelity == "inertial":
            for k in "LU":
                momentum = momentum + (model.nodal_masses(k) * getattr(rate, f"v_{k}")).sum(-2)
        F_x, F_y = (graph.ports[f"control_{axis}"].effort[0, 0] for axis in "xy")
        external = torch.stack((F_x, F_y - model.m_C * model.gravity)) - ground
        scale = 1.0 + graph.ports["contact_L"].effort.abs().sum()  # [N]
    assert float((momentum - external).abs().max()) < 1e-10 * float(scale)


def test_rigid_motion_costs_no_flow() -> None:
    """When everything, ground included, moves with one velocity, neither pads nor contacts see it; nor do contacts see
    a common rotation about the disc's centre."""
    model = coarse()
    state = model.layout.unpack(random_state(model, 0))
    graph = model.evaluate(0.0, state)
    v = {name: torch.zeros(j.nodes, j.width, dtype=torch.float64) for name, j in model.junctions.items()}
    for name in ("pad_L", "pad_U", "ground", "disc", "bracket"):
        v[name][:] = torch.tensor([0.3, -0.7], dtype=torch.float64)
    for name in ("pad_L", "pad_U", "contact_L", "contact_U"):
        assert float(graph.ports[name].transformer.flow(v).abs().max()) < 1e-15
    for k in "LU":
        d = graph.interfaces[k].frame.d
        turning = {name: torch.zeros_like(flow) for name, flow in v.items()}
        turning["spin"][:] = 2.0
        turning[f"pad_{k}"][:] = 2.0 * torch.stack((-d[:, 1], d[:, 0]), -1)
        assert float(graph.ports[f"contact_{k}"].transformer.flow(turning).abs().max()) < 1e-15


def test_radius_in_place_of_the_lever_would_break_duality() -> None:
    """The paper's Eq. 5-6 give |d|, not R, in v_T: with R on the flow side alone, power is lost at penetrated nodes."""
    model = coarse()
    graph = model.evaluate(0.0, model.layout.unpack(random_state(model, 0)))
    frame = graph.interfaces["L"].frame
    spin = graph.ports["contact_L"].transformer.blocks["spin"].matrix
    lever = spin[..., 1, 0]
    assert torch.allclose(lever, frame.d.norm(dim=-1), rtol=1e-14)
    touching = frame.g > 0
    assert float((lever - model.shape.radius.detach())[touching].abs().max()) > 1e-5


def test_bracket_moment_is_the_bonded_nodes_sum() -> None:
    """Eq. 35: the moment at the constrained rotation is the sum over bonded nodes of r x F."""
    model = coarse(pad__fidelity="inertial")
    state = model.layout.unpack(random_state(model, 3))
    with torch.no_grad():
        graph = model.evaluate(0.0, state)
        moment = float(net_efforts(graph.ports, model.junctions)["bracket_spin"])
        pad, mesh = model.pad_U, model.pad_U.mesh
        strain = state.u_U + model.material.tau * graph.ports["pad_U"].transformer.flow(graph.flows)
        lame_lambda, lame_mu = (x.item() for x in model.material.lame())
        K_lambda, K_mu, _ = mesh.matrices
        K = mesh.assemble(model.material.depth.item() * (lame_lambda * K_lambda + lame_mu * K_mu), all_nodes=True)
        displaced = torch.zeros(len(mesh.nodes), 2, dtype=torch.float64)
        displaced[torch.from_numpy(mesh.free)] = strain * pad.mirror
        on_nodes = torch.from_numpy(K @ displaced.flatten().numpy()).reshape(-1, 2) * pad.mirror
    base = torch.from_numpy(mesh.nodes) * pad.mirror
    base = base - torch.tensor([mesh.length / 2, model.settings.bracket.cm_height], dtype=torch.float64)
    bonded = torch.from_numpy(mesh.bonded)
    F, r = -on_nodes[bonded], base[bonded]  # the bracket receives the opposite of what holds the nodes
    assert float((r[:, 0] * F[:, 1] - r[:, 1] * F[:, 0]).sum()) == pytest.approx(moment, rel=1e-9)


def test_topology_names_the_papers_elements() -> None:
    model = coarse()
    graph = topology(model.evaluate(0.0, model.layout.unpack(random_state(model, 0))).ports, model.junctions)
    labels = {data["label"] for _, data in graph.nodes(data=True)}
    assert {"C: K_28^-1", "R: R_29", "C: K_59^-1", "C: K_81^-1", "R: R_99", "Se: mg", "Sf: 0"} <= labels
    signals = [(a, b) for a, b, data in graph.edges(data=True) if data["activated"]]
    assert signals == [("disc", "control_x")]  # the non-collocated loop: senses the disc, pushes the bracket
    assert "style=dashed" in to_dot(graph)


def test_sensing_the_bracket_makes_the_horizontal_loop_collocated() -> None:
    model = coarse(control__senses="bracket")
    graph = topology(model.evaluate(0.0, model.layout.unpack(random_state(model, 0))).ports, model.junctions)
    assert not [edge for *edge, data in graph.edges(data=True) if data["activated"]]
