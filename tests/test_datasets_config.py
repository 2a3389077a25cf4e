"""Configurations of datasets: what cannot be carried out is refused by the field that says it, in
one sentence."""

import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchsoft.cli import main
from torchsoft.datasets.config import Config
from torchsoft.datasets.distributions import Uniform
from torchsoft.datasets.generate import points
from torchsoft.datasets.rig_files import embedded
from torchsoft.tables import InvalidTable

PATH = Path(__file__).parent.parent / "data_gen" / "configs" / "smoke.toml"
SMOKE = embedded(tomllib.loads(PATH.read_text()), PATH.parent)
LAW, LIGHT = "laws.steel_on_rubber", {"low": 49.6e-3, "high": 49.8e-3}


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
        (("fixed", "pads.L.height"), "abc", "fixed.pads.L.height: pads.L"),
        (("fixed", "pads.L.elements_x"), 40_000, "elements_x = 40000"),
        (("parameters", f"{LAW}.friction.mu_k", "high"), 1.5, "mu_k.high = 1.5: impossible"),
        (("kinds", 0, "name"), 3, "kinds.0.name should be a valid string, not 3"),
        (("kinds", 0, "name"), "press", "kinds: every name once"),
        (("kinds", 0, "weight"), 0.0, "kinds.0.weight should be greater than or equal to"),
        (
            ("kinds", 0, "fixed", "motion.x_e"),
            {"kind": "hold"},
            "kinds.0.fixed.motion.x_e: `motion.x_e` is not in the rig file: did you mean `x_d`",
        ),
        (
            ("kinds", 0, "fixed", "motion.x_d", "times"),
            [0.5, 0.2],
            "kinds.0.fixed.motion.x_d: motion.x_d: times must increase",
        ),
        (
            ("kinds", 0, "fixed", "materials.rubber.E"),
            1e6,
            "kinds.0.parameters.materials.rubber.E is in `fixed` as well",
        ),
        (
            ("kinds", 1, "parameters", "motion.x_d.values_2"),
            {"low": 0.0, "high": 1.0},
            "kinds.1.parameters.motion.x_d.values_2: `motion.x_d.values_2` is not in the rig file",
        ),
        (
            ("kinds", 1, "parameters", "motion.x_d.stroke_time", "low"),
            1e-6,
            "kinds.1.parameters.motion.x_d.stroke_time.low = 1e-06: impossible: "
            "motion.x_d.stroke_time = 1e-06 s makes 500000 strokes",
        ),
        (
            ("kinds", 3, "fixed", "motion.x_d", "since"),
            0.8,
            "kinds.3.fixed: impossible: motion.x_d.since = 0.8 s leaves",
        ),
        (
            ("kinds", 4, "fixed", "motion.y_d"),
            {"kind": "hold", "value": 48.6e-3},
            "kinds.4.parameters.motion.y_d.components_1.amplitude: `motion.y_d.components",
        ),
        (
            ("kinds", 0, "fixed", "motion.y_d"),
            {"kind": "hold", "value": 48.6e-3},
            "kinds.0.parameters in their middle: impossible: `motion.y_d.values_2` is not in",
        ),
        (
            ("kinds", 0, "fixed", "motion.x_d", "values"),
            ["held", 0.0],
            'kinds.0.fixed: impossible: motion.x_d.values: "held" stands for the effort that holds',
        ),
        (
            ("kinds", 0, "fixed", "pads.L.elements_x"),
            60,
            "kinds.0.fixed: it changes the contact points of pads.L",
        ),
        (("workers",), 3, "`workers` is not known here"),
        (("parameters", "materials.rubber.E"), {"low": 9e5, "high": 8e5}, "rubber.E: low = 9"),
        (("parameters", "materials.rubber.E", "low"), -1.0, "logarithmic range needs low > 0"),
        (("duration",), 0.4, "kinds.1.fixed: impossible: motion.x_d.stroke_time = 0.3 s makes 0"),
        (("step",), 0.05, "step should be less than or equal to 0.02"),
        (("rig",), None, "rig should be a table"),
    ],
)
def test_a_mistake_is_blamed_on_its_field(place, value, message):
    with pytest.raises(InvalidTable) as error:
        Config.model_validate(changed(place, value))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_configuration_of_before_says_what_reads_it():
    before = {name: x for name, x in SMOKE.items() if name != "rig"} | {"grasp_depth": {}}
    with pytest.raises(InvalidTable, match=r"grasp_depth is of torchsoft 0\.2\.0 and before"):
        Config.model_validate(before)


def test_kinds_are_drawn_by_weight_with_their_own_numbers():
    """Files that a kind names are part of the configuration; its numbers may be those of all
    kinds, otherwise distributed."""
    light = {"name": "light", "weight": 3.0, "parameters": {"motion.y_d.values_2": LIGHT}}
    config = Config.model_validate(SMOKE | {"trajectories": 256, "kinds": [*SMOKE["kinds"], light]})
    tasks = [config.subject.task(i, u) for i, u in enumerate(points(config))]
    of = {
        kind.name: [one for one in tasks if one.labels["kind"] == kind.name]
        for kind in config.kinds
    }
    assert [len(of[name]) for name in of] == [32, 32, 32, 32, 32, 96]
    for name, low, high in (("light", 49.6e-3, 49.8e-3), ("chirp", 48.5e-3, 48.9e-3)):
        heights = [one.labels["motion.y_d.values_2"] for one in of[name]]
        assert low <= min(heights) < max(heights) <= high
    travel = np.array([one.values["motion.x_d.travel"] for one in of["strokes"]])
    assert (np.abs(np.abs(travel) - 1.5e-3) <= 0.5e-3).all()
    assert 8 < (travel < 0).sum() < 24
    assert all("motion.x_d.travel" not in one.labels for one in tasks)


@pytest.mark.parametrize("high", [0.4999, 0.3, 0.7e6, 3e-5])
def test_a_logarithmic_range_does_not_go_beyond_its_ends(high):
    r = Uniform(low=high / 7, high=high, scale="log")
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
    text = PATH.read_text()
    Path("million.toml").write_text(text.replace("trajectories = 8", "trajectories = 1000000"))
    assert main(["dataset", "make", file, "--out", out, "--workers", "0"]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not Path("set").exists()


def test_the_command_takes_no_nonsense_for_workers(capsys):
    with pytest.raises(SystemExit) as end:
        main(["dataset", "make", "set.toml", "--out", "set", "--workers", "-3"])
    assert end.value.code == 2
    assert "--workers: should be from 0 to 1000, not -3" in capsys.readouterr().err
