"""Excitations: what cannot be carried out is refused by its field before anything is simulated."""

import pytest
from conftest import PAPER, excited, f64

from torchsoft.rigs.excite import CATALOGUE, Excitation
from torchsoft.tables import InvalidTable

ROLL = {"kind": "slow_roll"}


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"motion": ROLL, "duration": 0.4},
         "duration = 0.4 s leaves no motion: grasp_time = 0.375 s and settle = 0.125 s"),
        ({"motion": {"kind": "chirp"}, "duration": 0.7}, "chirp needs more than 0.3 s after them"),
        ({"motion": {"kind": "multi_sine"}, "duration": 1e5}, "makes more than 100000 periods"),
        ({"motion": {"kind": "strokes", "stroke_time": 1e-5}, "duration": 9.0},
        "motion.stroke_time = 1e-05 s makes more than"),
        ({"motion": {"kind": "knots", "x": [[0.1, 1e-3], [0.1, 0.0]]}},
         "times of motion.x must increase, but 0.1 s"),
        ({"motion": {"kind": "knots", "y": [[2.0, 1e-3]]}},
         "duration = 2 s ends before the last knot of the motion, at 2.5 s"),
    ],
)  # fmt: skip
def test_an_impossible_excitation_is_refused_by_its_field(tree, message):
    with pytest.raises(InvalidTable) as error:
        Excitation.model_validate(tree)
    assert message in str(error.value)


def test_lists_stand_for_bands():
    shaking = CATALOGUE["shaking"].model_dump(mode="json")
    assert Excitation.model_validate(shaking) == CATALOGUE["shaking"]


def test_knots_are_reached_from_the_grasp():
    """At rest at each, on top of where the grasp ended."""
    knots, p = Knots(x=((0.1, 4e-3), (0.3, -2e-3)), y=((0.2, -1e-4),)), PAPER
    excitation = Excitation(motion=knots, grasp=0.2, since=0.3, duration=0.8, depth=1e-3)
    reference, since = excited(excitation, p).rig.reference, 0.3
    t = f64(0.0, since, since + 0.1, since + 0.2, since + 0.3, 5.0)
    value, rate = reference(t, ["x_d", "y_d"]).unbind(-1)
    x, y = 60.3e-3, apart(p)
    assert value[:, 0].tolist() == pytest.approx([x, x, x + 4e-3, x + 1e-3, x - 2e-3, x - 2e-3])
    assert value[:, 1].tolist() == pytest.approx(
        [y, y - 1e-3, y - 1.05e-3, y - 1.1e-3, y - 1.1e-3, y - 1.1e-3]
    )
    assert rate[[0, 1, 2, 4, 5], 0].abs().max() == 0
