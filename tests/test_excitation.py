"""Excitations: what cannot be carried out is refused by its field before anything is simulated."""

from typing import Any

import pytest

from torchsoft.excitation import CATALOGUE, Excitation
from torchsoft.tables import InvalidTable

ROLL = {"kind": "slow_roll"}


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"motion": ROLL, "duration": 0.4}, "duration = 0.4 s leaves no motion: grasp_time = 0.375 s and settle = 0.125 s"),
        ({"motion": {"kind": "chirp"}, "duration": 0.7}, "chirp needs more than 0.3 s after them"),
        ({"motion": ROLL, "duration": 1e308}, "duration should be less than or equal to 100000"),
        ({"motion": {"kind": "strokes", "stroke_time": 1e-5}, "duration": 9.0}, "motion.stroke_time = 1e-05 s makes more than"),
        ({"motion": {"kind": "multi_sine", "frequency": [1.0, "2"]}}, "motion.frequency.1 should be a valid number, not '2'"),
        ({"motion": ROLL, "depth": True}, "depth should be a valid number, not True"),
        ({"motion": {"kind": "hop"}}, "motion.kind should be one of"),
    ],
)  # fmt: skip
def test_an_impossible_excitation_is_refused_by_its_field(tree: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidTable) as error:
        Excitation.model_validate(tree)
    assert message in str(error.value)


def test_lists_stand_for_bands() -> None:
    shaking = CATALOGUE["shaking"].model_dump(mode="json")
    assert Excitation.model_validate(shaking) == CATALOGUE["shaking"]
