"""What a rig must be before it runs: numbers, tensors, shapes and slip laws, each refused by its name."""

import pytest
from conftest import coarse, grasped, times
from torch import Tensor, nn

from torchsoft import (
    Coulomb,
    SmoothSlip,
    SoftGrasp,
    simulate,
)
from torchsoft.physics.validity import check_slip

T = times(4e-3, 3)


def test_a_slip_law_that_supplies_power_is_told_of() -> None:
    assert check_slip("c", SmoothSlip(0.8, 0.7, 5e-3, 10.0), 500.0) == ""
    assert check_slip("c", Coulomb(0.8, 0.7), 500.0) == ""
    assert "must be from 0 to the effort" in check_slip("c", lambda E, F_N, R: 1.5 * E / R, 500.0)
    assert "must be from 0 to the effort" in check_slip("c", lambda E, F_N, R: E - F_N, 500.0)
    model = SoftGrasp(coarse().settings, friction=lambda E, F_N, R: 1.5 * E / R)
    with pytest.warns(UserWarning, match="the slip law of `L` gives"):
        simulate(model, T, y0=grasped(model))


class Dropping(nn.Module):
    """A law with a dropout."""

    def __init__(self) -> None:
        super().__init__()
        self.dropout = nn.Dropout(0.5)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return self.dropout((E - 0.5 * F_N).clamp(min=0.0)) / (R + 10.0)


def test_a_law_in_training_is_refused_after_it_ran_in_evaluation() -> None:
    model = SoftGrasp(coarse().settings, friction=Dropping())
    y0 = grasped(model)
    model.eval()
    simulate(model, T, y0=y0)
    model.train()
    with pytest.raises(TypeError, match="the random operation"):
        simulate(model, T, y0=y0)
