"""The compiled side equals the torch module: the laws of a point with their derivatives, and the stages of taken steps."""

import numba
import numpy as np
import pytest
import torch
from conftest import coarse, f64, times
from torch import Tensor, nn

from torchsoft import Ellipse, Shape, simulate
from torchsoft.codegen.invoke import call_linearise, call_pullback, call_value
from torchsoft.physics.contact import distance_law, interface_law
from torchsoft.scenario import grasp_and_roll
from torchsoft.solve.system import contact_laws

POINTS = 450


@numba.njit
def call_all(value, linearise, pullback, x, p, w, out, again, J, p_bar):
    call_value(value, x, p, out)
    call_linearise(linearise, x, p, again, J)
    call_pullback(pullback, x, p, w, p_bar)


def random_points(radius: float, seed: int, ah: float) -> np.ndarray:
    """Inputs (points, 9) that touch deeply, just touch (within a few epsilon), and do not touch; slow and fast; stretched or
    not."""
    rng = np.random.default_rng(seed)
    uniform = lambda low, high: rng.uniform(low, high, POINTS)
    depth = np.where(rng.random(POINTS) < 0.5, uniform(-2e-6, 5e-6), uniform(-1e-5, 1e-4))
    angle, speed = uniform(-np.pi, np.pi), 10.0 ** uniform(-5, -0.5)
    w, spin = speed * rng.normal(size=(2, POINTS)), speed / radius * rng.normal(size=POINTS)
    s, weight = rng.choice([0.0, 1e-5, 1e-4], POINTS) * rng.normal(size=POINTS), rng.choice([0.5, 1.0, 2.0], POINTS)
    d = (radius - depth) * np.array([np.cos(angle), np.sin(angle)])
    return np.stack((*w, spin, *d, uniform(-2, 2), s, weight, np.full(POINTS, ah)), -1)


class Interface(nn.Module):
    """The module's own law of a point, for `functional_call`."""

    def __init__(self, law: nn.Module, shape: nn.Module) -> None:
        super().__init__()
        self.law, self.shape = law, shape

    def forward(self, x: Tensor) -> Tensor:
        return interface_law(self.law, self.shape, x)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("ah", [0.0, 6e-4])
@pytest.mark.parametrize("shape", [None, Ellipse(19.4e-3, 19.3e-3)], ids=["circle", "ellipse"])
def test_the_law_of_a_point_equals_the_module(friction: str, shape: Shape | None, ah: float) -> None:
    """Values, Jacobian by the state and gradient by every parameter, at every kind of point."""
    model = coarse(contact__friction=friction)
    body = shape or model.shape
    module, laws = Interface(model.contact, body), contact_laws(model.contact, body)
    p = torch.cat([v.detach().reshape(1) for v in laws.parameters.values()])
    names, w = list(laws.parameters), f64(0.3, -0.7, 1e3)
    found = {"separated": 0, "touching": 0, "stick": 0, "slip": 0, "cut": 0}
    law, bars = laws.interface, []
    for row in random_points(19.37e-3, 1, ah):
        J, out, again, p_bar = np.empty((3, 7)), np.empty(7), np.empty(7), np.zeros(len(p))
        call_all(law.value, law.linearise, law.pullback, row, p.numpy(), w.numpy(), out, again, J, p_bar)
        np.testing.assert_array_equal(out, again)
        x = torch.from_numpy(row)
        with torch.no_grad():
            g = -float(distance_law(body, x)[0])
        if g <= 0:
            found["separated"] += 1
        else:
            found["touching" if g < 5e-6 else "slip" if out[6] != 0 else "stick"] += 1
            found["cut"] += int(out[3] == 0)

        def outputs(x: Tensor, p: Tensor, rest: Tensor = x[7:]) -> Tensor:
            values = dict(zip(names, p.unbind()))
            return torch.func.functional_call(module, values, (torch.cat((x, rest)),))

        with torch.no_grad():
            expected = module(x)
        pull = torch.func.vjp(outputs, x[:7], p)[1]
        rows = [pull(torch.eye(7, dtype=torch.float64)[i]) for i in range(3)]
        jacobian = torch.stack([by_x for by_x, _ in rows]).numpy()
        by_p = sum(weight * row for weight, (_, row) in zip(w, rows)).numpy()
        # a slipping Coulomb point has zeros in it; the distance from a boundary rounds to 4e-18 m, 4e-12 epsilon
        rounding = 1e-11 + 2e-17 * np.abs(jacobian[:, 3:5]).max()
        np.testing.assert_allclose(out[:5], expected[:5], rtol=1e-11, atol=rounding)
        np.testing.assert_allclose(out[5:], expected[5:], rtol=1e-10, atol=rounding)
        scale = np.abs(jacobian).max(0) + [441, 441, 9, 1e5, 1e5, 1e3, 1e5]
        assert np.all(np.abs(J - jacobian) <= 1e-11 * scale), (J, jacobian)
        bars.append((p_bar, by_p))
    assert min(found.values()) >= 10, found
    got, expected = np.moveaxis(np.array(bars), 1, 0)
    assert np.all(np.abs(got - expected) <= 1e-10 * np.abs(expected) + 1e-11 * np.abs(expected).max(0))
    idle = {names[i] for i in np.flatnonzero(np.abs(expected).max(0) == 0)}
    assert idle == ({"law.friction.mu_s"} if friction == "coulomb" else set())  # Coulomb's mu_s only says when


@torch.no_grad()
def test_recorded_forces_and_moments_equal_the_module(fidelity: str) -> None:
    """Nodal forces of a run, and the moment of the pads' efforts about the undeformed places of their nodes (Eq. 35)."""
    manipulation = grasp_and_roll(coarse(pad__fidelity=fidelity), grasp_force=75.0)
    model, run = manipulation.model, simulate(manipulation.model, times(0.5, 11), y0=manipulation.y0)
    for i in (0, 3, 7, 10):
        graph = model.evaluate(run.t[i], model.unpack(run.y[i], t=run.t[i]))
        for k in "LU":
            expected = graph.interfaces[k].out[..., 3:5]
            assert float((run.force[k][i] - expected).abs().max()) < 1e-8  # [N], ten times Newton's tolerance
        X, e = model.pads["U"].positions, graph.ports["pad_U"].effort
        moment = float((X[:, 0] * e[:, 1] - X[:, 1] * e[:, 0]).sum())
        assert float(run["bracket_moment"][i]) == pytest.approx(moment, abs=6e-9)  # ten points' 1e-8 N
