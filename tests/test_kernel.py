"""The compiled kernel equals the module: node law, its Jacobian, and the rates of a whole stage."""

import numpy as np
import pytest
import torch
from conftest import coarse, random_state
from torch import Tensor

from torchsoft.contact import Contact, cross, moving_frame
from torchsoft.implicit import ImplicitStepper
from torchsoft.model import SoftGrasp
from torchsoft.node_kernel import contact_node
from torchsoft.run_kernel import GAMMA
from torchsoft.stage_kernel import finish_pad, pad_work, solve_stage
from torchsoft.state import State

NODES = 400


def module_force(
    model: SoftGrasp, contact: Contact, d: Tensor, w: Tensor, omega: Tensor, theta: Tensor, s: Tensor, share: float
) -> tuple[Tensor, Tensor]:
    """Force on one node and (F_N, F_T, e, gamma', rho, g, g', v_T), from the module's own functions."""
    frame = moving_frame(model.shape, d[None], torch.zeros(2, dtype=torch.float64), theta)
    v = w + omega * cross(d)
    g_dot, v_T = (frame.n[0] * v).sum(), (frame.t[0] * v).sum()
    out = contact(frame.g, g_dot[None], v_T[None], s[None], torch.tensor([share], dtype=torch.float64))
    force = out.F_N[0] * frame.n[0] + out.F_T[0] * frame.t[0]
    rest = torch.stack((out.F_N[0], out.F_T[0], out.e[0], out.gamma_dot[0], out.rho[0], frame.g[0], g_dot, v_T))
    return force, rest


def random_nodes(model: SoftGrasp, seed: int) -> list[dict[str, float]]:
    """Nodes that touch deeply, just touch (within a few epsilon), and do not touch; slow and fast; stretched or not."""
    rng = np.random.default_rng(seed)
    R = model.settings.disc.radius
    depth = np.where(rng.random(NODES) < 0.5, rng.uniform(-2e-6, 5e-6, NODES), rng.uniform(-1e-5, 1e-4, NODES))
    angle, speed = rng.uniform(-np.pi, np.pi, NODES), 10.0 ** rng.uniform(-5, -0.5, NODES)
    return [
        {
            "dx": (R - depth[i]) * np.cos(angle[i]),
            "dy": (R - depth[i]) * np.sin(angle[i]),
            "wx": speed[i] * rng.normal(),
            "wy": speed[i] * rng.normal(),
            "omega": speed[i] / R * rng.normal(),
            "theta": rng.uniform(-2, 2),
            "s": rng.choice([0.0, 1e-5, 1e-4]) * rng.normal(),
            "share": rng.choice([0.5, 1.0, 2.0]),
        }
        for i in range(NODES)
    ]


@pytest.mark.parametrize("ah", [0.0, 6e-4])
def test_node_law_and_its_jacobian_equal_the_module(friction: str, ah: float) -> None:
    model = coarse(contact__friction=friction)
    constants = ImplicitStepper(model).constants()
    stage_law = Contact(model.settings.contact)  # at a stage the stretch is local: R_t + a h K_t for R_t
    stage_law.R_t.data += ah * stage_law.K_t.data
    seen = {"separated": 0, "touching": 0, "stick": 0, "slip": 0, "cut": 0}
    for node in random_nodes(model, seed=1):
        G, out = np.empty((2, 3)), np.empty(10)
        touches = contact_node(*node.values(), ah, constants, G, out)
        d0, w0, omega0, theta0, s = (
            torch.tensor(x, dtype=torch.float64)
            for x in ([node["dx"], node["dy"]], [node["wx"], node["wy"]], node["omega"], node["theta"], node["s"])
        )

        def force(v: Tensor, d0=d0, w0=w0, omega0=omega0, theta0=theta0, s=s, share=node["share"]) -> Tensor:
            d, theta = d0 - ah * (v[:2] - w0), theta0 + ah * (v[2] - omega0)
            return module_force(model, stage_law, d, v[:2], v[2], theta, s, share)[0]

        expected, rest = module_force(model, stage_law, d0, w0, omega0, theta0, s, node["share"])
        if not touches:
            seen["separated"] += 1
            assert rest[5] <= 0
            continue
        slips = rest[3] != 0
        seen["touching" if rest[5] < 5e-6 else "slip" if slips else "stick"] += 1
        seen["cut"] += int(rest[0] == 0)
        np.testing.assert_allclose(out[:2], expected.detach(), rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(out[2:], rest.detach(), rtol=1e-10, atol=1e-13)
        jacobian = torch.autograd.functional.jacobian(force, torch.cat((w0, omega0[None])))
        scale = float(jacobian.abs().max()) + model.settings.contact.R_n  # a slipping Coulomb node has derivative zero
        np.testing.assert_allclose(G, jacobian, rtol=0, atol=1e-11 * scale)  # g = R - |d| rounds to 4e-18 m, 4e-12 epsilon
    assert min(seen.values()) >= 10, seen


@torch.no_grad()
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_stage_rates_equal_forward(fidelity: str, seed: int) -> None:
    """k of a solved stage is f(t, y + a h k): pads, contact, friction, disc, bracket and control all at once."""
    model = coarse(pad__fidelity=fidelity)
    stepper = ImplicitStepper(model, tolerance=1e-9)
    y = random_state(model, seed)
    state, h = model.layout.unpack(y), 1e-3
    ah = GAMMA * h
    pads, constants = stepper.pad_arrays(h), stepper.constants()
    parts = tuple(stepper._pad_state(k, state) for k in "LU")
    works = tuple(pad_work(pad) for pad in pads)
    q = torch.cat((state.r_C, state.theta[None], state.r_Br)).numpy()
    V_star = torch.cat((state.v_C, state.omega[None], state.v_Br)).numpy()
    V, powers = V_star.copy(), np.zeros(8)
    want = torch.stack(model.reference(torch.tensor(0.0, dtype=torch.float64))).detach().numpy()
    converged, _ = solve_stage(pads, parts, works, q, V_star, V, want, ah, constants, 1e-9, 40, 3e-4)
    assert converged
    for p in range(2):
        finish_pad(pads[p], parts[p], works[p], q, V, ah, constants, powers, p)
    tensor = torch.from_numpy
    acceleration = tensor((V - V_star) / ah)
    k = model.layout.pack(
        State(
            *(tensor(w.u_dot).reshape(-1, 2) for w in works),
            *(tensor(w.s_dot) for w in works),
            tensor(V[:2]),
            tensor(V[2:3])[0],
            tensor(V[3:]),
            *(tensor(w.v_dot).reshape(-1, 2) for w in works),
            acceleration[:2],
            acceleration[2],
            acceleration[3:],
        )
    )
    expected = model.layout.unpack(model(0.0, y + ah * k))
    got = model.layout.unpack(k)
    for name in State._fields:
        a, b = getattr(got, name), getattr(expected, name)
        if a.numel():
            scale = float(b.abs().max()) + 1e-9
            assert float((a - b).abs().max()) / scale < 1e-7, name
