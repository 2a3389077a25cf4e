"""Bodies, control laws and actuators."""

import pytest
import torch
from conftest import coarse, f64, grasped

from torchsoft import PD, Body, Circle, Ellipse


def test_pd_by_hand() -> None:
    """F = 3 (1 - 0.5) + 2 (0.1 - 0.4) + 7."""
    assert PD(3.0, 2.0)(*f64(1.0, 0.1, 7.0, 0.5, 0.4)).item() == pytest.approx(7.9, rel=1e-15)


@torch.no_grad()
def test_the_papers_controllers() -> None:
    """Eq. 31-34: the horizontal loop measures the disc, the vertical one the bracket, and both push the bracket."""
    model = coarse()
    state = model.unpack(grasped(model, (0.02, -0.01)))
    state = state._replace(pose=state.pose | {"bracket": state.pose["bracket"] + f64(1e-3, 2e-3, 0.0)})
    t = f64(0.0)[0]
    signals = model.follow(t)
    F_x, F_y = (float(model.actuator_effort(name, state, signals)) for name in "xy")
    x_d, y_d, F_ff = (float(model.reference[name](t)[0]) for name in ("x_d", "y_d", "F_ff"))
    x, y = float(state.pose["disc"][0]), float(state.pose["bracket"][1])
    assert F_x == pytest.approx(1.2e5 * (x_d - x) - 441.7149 * 0.02, rel=1e-13)
    assert F_y == pytest.approx(1.2e5 * (y_d - y) + F_ff, rel=1e-13)


def test_bodies_know_their_inertia() -> None:
    assert Body(2.0, Circle(0.1)).inertia.item() == pytest.approx(0.5 * 2.0 * 0.01, rel=1e-15)
    assert Body(2.0, Ellipse(0.3, 0.1)).inertia.item() == pytest.approx(0.25 * 2.0 * (0.09 + 0.01), rel=1e-15)
    assert Body(2.0, Circle(0.1), inertia=0.7).inertia.item() == 0.7
    radius = Body(2.0, Circle(0.1))
    (slope,) = torch.autograd.grad(radius.inertia, radius.shape.radius)
    assert float(slope) == pytest.approx(2.0 * 0.1, rel=1e-15)
