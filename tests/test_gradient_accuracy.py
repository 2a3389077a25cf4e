"""The experiment that judges gradients, at smoke size."""

import json

import pytest
from test_experiments import experiment

EXACT = 1e-6
"""Relative error allowed where the judge itself is that good."""


@pytest.mark.slow
def test_gradient_accuracy_smoke(tmp_path):
    module = experiment("gradient_accuracy")
    module.main(module.Config(out=tmp_path, smoke=True))
    numbers = json.loads((tmp_path / "summary.json").read_text())
    assert set(numbers["windows"]) == {"stick", "slip", "make-break", "grasp", "full"}
    slip, stick, grasp = (numbers["windows"][name] for name in ("slip", "stick", "grasp"))
    assert slip["events"]["slip_onsets"] > 0
    assert stick["events"]["slip_onsets"] + stick["events"]["touch"] == 0
    assert grasp["events"]["touch"] > 3
    for window in (slip, stick):
        errors, unsure = window["relative_error"], window["judge_uncertainty"]
        assert max(errors[name] for name in errors if unsure[name] <= EXACT) <= EXACT
    assert (tmp_path / "table.md").read_text().count("|\n") == 7
