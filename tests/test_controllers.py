"""Control laws that see the whole state and give several efforts."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from test_rig_parts import coarse_tree
from torch import nn

from torchsoft import StateFeedback
from torchsoft.rigs import RigFile
from torchsoft.rigs.check import check
from torchsoft.rigs.written import to_toml

TIMING = {"outputs": {"duration": 0.3, "interval": 0.02}, "solver": {"rtol": 1e-6}}


def test_coordinates_without_set_points_are_regulated():
    law = StateFeedback([[1.0, 10.0, 100.0, 1000.0]])
    efforts = law(torch.tensor([2.0, 3.0]).double(), torch.tensor([0.5, 0.25, 0.5, 0.125]).double())
    assert efforts.item() == pytest.approx(1.5 - 2.5 + 250.0 - 125.0, rel=1e-15)


def file(**changes: Any) -> RigFile:
    """The ready template, coarse, with one controller in the place of its loops."""
    tree = coarse_tree()
    tree["actuators"] = {"press": {"pushes": "bracket.y", "feed_forward": "press"}}
    tree["controllers"] = {
        "jaw": {
            "measures": ["bracket.x", "bracket.y"], "setpoints": ["x_d", "y_d"],
            "pushes": ["bracket.x", "bracket.y"],
            "gain": [[1e5, 0.0, 400.0, 0.0], [0.0, 1e5, 0.0, 400.0]],
        } | changes
    }  # fmt: skip
    return RigFile.from_tree(tree | TIMING)


def test_a_controller_in_a_file_is_the_loops_that_it_stands_for(tmp_path):
    asked = file()
    (tmp_path / "rig.toml").write_text(to_toml(asked), encoding="utf-8")
    read = RigFile.from_toml(tmp_path / "rig.toml")
    assert read.model_dump() == asked.model_dump()
    assert [str(one) for one in check(read) if one.severity != "note"] == []
    loops = RigFile.from_tree(coarse_tree() | TIMING)
    runs = [one.build().run() for one in (read, loops)]
    assert "effort_jaw_bracket_x" in runs[0].units
    for name in ("x_disc", "theta_disc", "y_bracket"):
        assert torch.allclose(runs[0][name], runs[1][name], rtol=0, atol=1e-7)


def test_a_network_of_the_state_in_a_file(tmp_path):
    """Its weights, with the gain beside it, are those of the module in Python; another size is
    rejected."""
    torch.manual_seed(1)
    net = nn.Sequential(nn.Linear(8, 3), nn.Tanh(), nn.Linear(3, 2)).double()
    np.savez(
        tmp_path / "law.npz",
        **{name: value.detach().numpy() for name, value in net.state_dict().items()},
    )
    asked = file(network="law.npz")
    asked._folder = tmp_path
    rig = asked.build().rig
    x = torch.linspace(-1.0, 1.0, 9, dtype=torch.float64)
    setpoints, state = x[[0, 2, 1, 3]], x[[5, 7, 6, 8]]
    wanted = net(torch.cat((setpoints, state))) + StateFeedback(asked.controllers["jaw"].gain)(
        setpoints, state
    )
    x = torch.cat((x[:4], x[5:]))
    for i, name in enumerate(("jaw_bracket_x", "jaw_bracket_y")):
        assert torch.allclose(rig.actuators[name](x), wanted[i], rtol=1e-14)
    asked = file(network="law.npz", measures=["bracket.x", "bracket.y", "disc.x"], gain=None)
    asked._folder = tmp_path
    (found, *_) = check(asked)
    assert (found.severity, found.where) == ("error", "controllers.jaw.network")
    assert re.search(r"has the shape \(3, 8\).* from 10 inputs \(x_d, y_d, x_d', ", found.message)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"gain": [[1.0, 2.0]]},
            r"controllers\.jaw.*gain: 2 efforts of 2 coordinates and their rates need 2 rows of 4 "
            r"numbers",
        ),
        ({"gain": None}, r"controllers\.jaw.*it does nothing: give a gain, a network, or both"),
        ({"setpoints": ["x_d", "y_d", "press"]}, r"setpoints: 3 motions, but it measures 2"),
        (
            {"measures": ["bracket.x", "disc.z"]},
            r"controllers\.jaw\.measures: `disc\.z` is not a coordinate",
        ),
        (
            {"pushes": ["bracket.x", "bracket.theta"]},
            r"controllers\.jaw\.pushes: bracket\.theta is fixed at 0",
        ),
    ],
)
def test_controllers_that_make_no_sense_are_rejected(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        file(**changes)


def test_an_unstable_controller_is_found_before_the_run():
    found = check(file(gain=[[1e5, 0.0, -4000.0, 0.0], [0.0, 1e5, 0.0, 400.0]]))
    assert any(one.severity == "error" and "the rig is unstable" in one.message for one in found)
