"""The state vector: what stands where, taken apart and put together."""

import pytest
import torch
from conftest import coarse, f64, turning

from torchsoft import Body, Circle, Rig, hold


def test_sizes_of_the_papers_rig() -> None:
    """61 surface nodes a pad: forces and stretches, five free coordinates and their rates."""
    layout = coarse().layout
    assert layout.size == 2 * (2 * 61 + 61) + 2 * 5
    assert layout.shapes["pads", "L"] == (1, 61, 2)
    assert layout.free == {"disc": [0, 1, 2], "bracket": [0, 1]}
    inertial = coarse(pad__fidelity="inertial").layout
    assert inertial.shapes["pads", "U"] == inertial.shapes["rates", "U"] == (122, 2)  # two elements high, the base held
    assert turning().layout.size == layout.size + 2


def test_what_is_not_free_is_filled_in() -> None:
    """A driven coordinate comes from its signal at t, a fixed one from its number; neither is in the vector."""
    rig = Rig(
        bodies={"a": Body(1.0, Circle(0.01), x="driven", y=0.25), "b": Body(1.0, theta=0.1)}, pads={}, contacts={},
        reference=hold(**{"a.x": 0.7}),
    )  # fmt: skip
    assert rig.signals == ("a.x",)
    assert rig.layout.size == 2 * (1 + 2)
    state = rig.unpack(f64(0.5, 3.0, 4.0, 0.05, 0.3, 0.4))
    assert state.pose["a"].tolist() == [0.7, 0.25, 0.5]
    assert state.pose["b"].tolist() == [3.0, 4.0, 0.1]
    assert state.velocity["a"].tolist() == [0.0, 0.0, 0.05]
    assert state.velocity["b"].tolist() == [0.3, 0.4, 0.0]
    moved = rig.unpack(torch.zeros(6, dtype=torch.float64), f64(0.9, -2.0).reshape(1, 2))
    assert moved.pose["a"].tolist() == [0.9, 0.25, 0.0]
    assert moved.velocity["a"].tolist() == [-2.0, 0.0, 0.0]


@pytest.mark.parametrize("wrong", ["short", "float32"])
def test_wrong_states_are_refused(wrong: str) -> None:
    model = coarse()
    y = torch.zeros(model.layout.size - 1, dtype=torch.float64) if wrong == "short" else torch.zeros(model.layout.size)
    for refuse in (model.unpack, lambda y: model(0.0, y)):
        with pytest.raises(ValueError, match="`y` must be float64 of shape"):
            refuse(y)
