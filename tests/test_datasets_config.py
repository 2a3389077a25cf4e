"""Configurations of datasets: what cannot be carried out is refused by the field that says it, in
one sentence."""

import copy
import tomllib
from pathlib import Path
from typing import Any

import pytest

from torchsoft.datasets.config import Config
from torchsoft.datasets.distributions import Range
from torchsoft.datasets.generate import main
from torchsoft.tables import InvalidTable

PATH = Path(__file__).parent.parent / "data_gen" / "configs" / "smoke.toml"
SMOKE = tomllib.loads(PATH.read_text())
DEEP = {"low": 2e-4, "high": 9e-3}


def changed(place: tuple[str | int, ...], value: Any) -> Any:
    """The configuration with another value in a place."""
    tree = copy.deepcopy(SMOKE)
    inner = tree
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return tree


def test_numbers_that_are_whole_are_numbers():
    assert Config.model_validate(changed(("duration",), 1)) == Config.model_validate(SMOKE)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("fixed", "pad.height"), "abc", "fixed.pad.height should be a valid number, not 'abc'"),
        (
            ("fixed", "pad.fidelity"),
            "firm",
            "fixed.pad.fidelity should be 'massless' or 'inertial', not 'firm'",
        ),
        (("fixed", "pad.elements_x"), 40_000, "pad.elements_x = 40000"),
        (("fixed", "pad.height"), 1e-3, "pad.height = 0.001 m"),
        (("fixed", "scenario.travel"), 1e-3, "fixed.scenario.travel has no part in a dataset"),
        (("fixed", "scenario.grasp_time"), 0.9, "scenario.grasp_time = 0.9 s"),
        (
            ("parameters", "pad.E", "high"),
            1e300,
            "parameters.pad.E.high should be less than or equal to",
        ),
        (
            ("parameters", "contact.mu_k/contact.mu_s", "high"),
            1.5,
            "parameters.contact.mu_k/contact.mu_s.high must lie in",
        ),
        (("kinds", 0, "kind"), "hop", "kinds.0.kind should be one of"),
        (("kinds", 0, "travel", "high"), 1.0, "kinds.0.travel.high = 1.0 m leaves the pad"),
        (
            ("kinds", 1, "stroke_time", "low"),
            1e-6,
            "kinds.1.stroke_time.low = 1e-06 s makes more than",
        ),
        (("kinds", 2, "amplitude_x"), 3, "kinds.2.amplitude_x should be a table, not 3"),
        (("workers",), 3, "workers is not known here"),
        (("parameters", "pad.E"), {"low": 9e5, "high": 8e5}, "parameters.pad.E"),
        (("channels",), ["x_C"], "channels is of a rig file, and there is none"),
        (("parameters", "pad.E", "ratio_to"), "pad.nu", "pad.E.ratio_to is of a rig file"),
        (
            ("kinds", 0),
            {"kind": "jerk", "depth": DEEP, "travel": {"low": 2e-2, "high": 3e-2}},
            "kinds.0.depth.high = 0.009 is impossible: the disc does not fit",
        ),
        (("parameters", "pad.Young"), {"low": 1.0, "high": 2.0}, "pad.Young"),
        (("grasp_depth", "high"), 0.02, "grasp_depth.high = 0.02"),
        (("parameters",), {"contact.mu_s": {"low": 0.3, "high": 0.9}}, "contact.mu_s = 0.3"),
        (("duration",), 0.5, "duration"),
        (("step",), 0.05, "step should be less than or equal to 0.02"),
    ],
)
def test_a_mistake_is_blamed_on_its_field(place, value, message):
    with pytest.raises(InvalidTable) as error:
        Config.model_validate(changed(place, value))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("high", [0.4999, 0.3, 0.7e6, 3e-5])
def test_a_logarithmic_range_does_not_go_beyond_its_ends(high):
    r = Range(low=high / 7, high=high, scale="log")
    assert r.low <= r.at(0.0) <= r.at(1e-16) <= r.at(1.0) <= r.high


@pytest.mark.parametrize(
    ("file", "out", "message"),
    [
        ("million.toml", "set", "or say --yes to begin"),
        ("none.toml", "set", "No such file"),
        (str(PATH), "nowhere://set", "Protocol not known: nowhere"),
    ],
)
def test_the_command_refuses_in_one_line(tmp_path, monkeypatch, capsys, file, out, message):
    monkeypatch.chdir(tmp_path)
    text = PATH.read_text().replace("trajectories = 8", "trajectories = 1000000")
    Path("million.toml").write_text(text)
    assert main([file, "--out", out, "--workers", "0"]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not Path("set").exists()


def test_the_command_takes_no_nonsense_for_workers(capsys):
    with pytest.raises(SystemExit) as end:
        main(["set.toml", "--out", "set", "--workers", "-3"])
    assert end.value.code == 2
    assert "--workers: should be from 0 to 1000, not -3" in capsys.readouterr().err
