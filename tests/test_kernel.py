"""The compiled kernel equals the module: node law, its Jacobian, and the rates of a whole stage."""

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import coarse, random_state
from torch import Tensor

from torchsoft import kernels
from torchsoft.contact import cross, moving_frame
from torchsoft.implicit import ImplicitStepper
from torchsoft.kernel_inputs import constants, pad_state
from torchsoft.kernels.node import contact_node
from torchsoft.kernels.pad import pad_work
from torchsoft.kernels.run import GAMMA, run
from torchsoft.kernels.stage import finish_pad, solve_stage
from torchsoft.model import SoftGrasp
from torchsoft.state import State

NODES = 400


def module_node(model: SoftGrasp, x: Tensor, share: float, ah: float) -> tuple[Tensor, Tensor]:
    """Force on one node at x = (w_x, w_y, omega, d_x, d_y, theta, s*), and the kernel's ten outputs, by the module."""
    w, omega, d, theta, s = x[:2], x[2], x[3:5], x[5], x[6:]
    frame = moving_frame(model.shape, d[None], torch.zeros(2, dtype=torch.float64), theta)
    v = w + omega * cross(d)
    g_dot, v_T = (frame.n[0] * v).sum(), (frame.t[0] * v).sum()
    share_ = torch.tensor([share], dtype=torch.float64)
    out = model.contact(frame.g, g_dot[None], v_T[None], s, share_, stage=ah)
    force = out.F_N[0] * frame.n[0] + out.F_T[0] * frame.t[0]
    rest = (out.F_N[0], out.F_T[0], out.e[0], out.gamma_dot[0], out.rho[0], frame.g[0], g_dot, v_T)
    return force, torch.stack((*force, *rest))


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
    scalars = constants(model)
    seen = {"separated": 0, "touching": 0, "stick": 0, "slip": 0, "cut": 0}
    for node in random_nodes(model, seed=1):
        J, out, share = np.empty((3, 7)), np.empty(10), node["share"]
        touches = contact_node(*node.values(), ah, scalars, J, out)
        names = ("wx", "wy", "omega", "dx", "dy", "theta", "s")
        x = torch.tensor([node[name] for name in names], dtype=torch.float64)

        def force_and_rate(x: Tensor, share: float = share) -> Tensor:
            force, rest = module_node(model, x, share, ah)
            return torch.cat((force, rest[6:7] * rest[9:10] - rest[5:6]))  # s' = rho v_T - gamma'

        force, rest = module_node(model, x, share, ah)
        if not touches:
            seen["separated"] += 1
            assert rest[7] <= 0
            continue
        seen["touching" if rest[7] < 5e-6 else "slip" if rest[5] != 0 else "stick"] += 1
        seen["cut"] += int(rest[2] == 0)
        np.testing.assert_allclose(out[:2], force.detach(), rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(out[2:], rest[2:].detach(), rtol=1e-10, atol=1e-13)
        jacobian = torch.autograd.functional.jacobian(force_and_rate, x).numpy()
        # a slipping Coulomb node has zeros in it; g = R - |d| rounds to 4e-18 m, 4e-12 epsilon
        scale = np.abs(jacobian).max(0) + [441, 441, 9, 1e5, 1e5, 1e3, 1e5]
        assert np.all(np.abs(J - jacobian) <= 1e-11 * scale), (J, jacobian)
    assert min(seen.values()) >= 10, seen


@torch.no_grad()
@pytest.mark.parametrize(("seed", "senses"), [(0, "disc"), (1, "disc"), (2, "bracket")])
def test_stage_rates_equal_forward(fidelity: str, seed: int, senses: str) -> None:
    """k of a solved stage is f(t, y + a h k): pads, contact, friction, disc, bracket and control all at once."""
    model = coarse(pad__fidelity=fidelity, control__senses=senses)
    stepper = ImplicitStepper(model, tolerance=1e-9)
    y = random_state(model, seed)
    state, h = model.layout.unpack(y), 1e-3
    ah = GAMMA * h
    pads, scalars = stepper.pad_arrays(h), stepper.constants
    parts = tuple(pad_state(model, k, state) for k in "LU")
    works = tuple(pad_work(pad) for pad in pads)
    q = torch.cat((state.r_C, state.theta[None], state.r_Br)).numpy()
    V_star = torch.cat((state.v_C, state.omega[None], state.v_Br)).numpy()
    V, powers = V_star.copy(), np.zeros(8)
    want = torch.stack(model.reference(torch.tensor(0.0, dtype=torch.float64))).detach().numpy()
    converged, _ = solve_stage(pads, parts, works, q, V_star, V, want, ah, scalars, 1e-9, 40, 3e-4)
    assert converged
    for p in range(2):
        finish_pad(pads[p], parts[p], works[p], q, V, ah, scalars, powers, p)
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


def test_no_stale_kernel_is_ever_used(tmp_path: Path) -> None:
    """The cache's folder is named after all sources: a changed callee gives its callers another folder."""
    assert kernels.digest(kernels.HERE) in run.stats.cache_path
    for name, text in (("law.py", "a = 1"), ("step.py", "b = 2")):
        (tmp_path / name).write_text(text)
    before = kernels.digest(tmp_path)
    assert kernels.digest(tmp_path) == before
    (tmp_path / "law.py").write_text("a = 3")
    assert kernels.digest(tmp_path) != before
