"""The price of work: hours and memory need the user's word, minutes do not; estimates are of the
right order."""

import re
from pathlib import Path
from unittest import mock

import pytest
from conftest import still

from torchsoft.cli import main
from torchsoft.cost import Cost, Costly, agree, rig_row, rig_step
from torchsoft.datasets.config import Config
from torchsoft.datasets.generate import cost
from torchsoft.rigs.written import template, to_toml

SMOKE = Path(__file__).parents[1] / "data_gen/configs/smoke.toml"
CHEAP, LONG, LARGE = Cost(1e4, 60.0, 0.1), Cost(1e9, 2e5, 0.1), Cost(1e4, 60.0, 1e6)


@pytest.mark.parametrize("price", [LONG, LARGE], ids=["hours", "memory"])
def test_hours_and_memory_need_the_users_word(price):
    agree(CHEAP, False, "take less")
    agree(price, True, "take less")
    with mock.patch("sys.stdin") as keys, mock.patch("sys.stderr") as screen:
        keys.isatty.return_value = False
        with pytest.raises(
            Costly, match=r"^this takes about .* GiB of memory; take less, or use --yes to begin$"
        ):
            agree(price, False, "take less")
        keys.isatty.return_value = screen.isatty.return_value = True
        keys.readline.return_value = "n\n"
        with pytest.raises(Costly):
            agree(price, False, "take less")
        keys.readline.return_value = "y\n"
        agree(price, False, "take less")


def test_a_step_costs_more_on_a_finer_mesh_and_with_derivatives():
    usual = rig_step(still())
    assert 1e-4 < usual < 2e-4
    assert rig_step(still({"pad.elements_x": 480})) > 8 * usual
    assert rig_step(still(), differentiated=1) > 2 * usual
    assert rig_step(still(), differentiated=40) > 3 * rig_step(still(), differentiated=8)
    assert rig_step(still({"pad.inertial": True})) > 5 * usual
    assert rig_row(still()) * 2**30 > 8 * 4 * 242


@pytest.mark.parametrize(
    ("change", "seconds"),
    [
        ({}, (0.1, 10.0)),
        ({"trajectories": 1_000_000}, (2e4, 1e6)),
        ({"step": 1e-6}, (300.0, 3000.0)),
    ],
)
def test_what_a_dataset_costs(change, seconds):
    price = cost(Config.from_toml(SMOKE).model_copy(update=change), 2)
    assert seconds[0] < price.seconds < seconds[1]
    assert price.memory < 1.0
    assert (price.disk > 100.0) == ("trajectories" in change)


@pytest.mark.parametrize(
    ("command", "changes", "words"),
    [
        ("run", {"solver.step": 1e-7, "outputs.duration": 20.0}, r"about .* \(2e\+08 steps\).*"),
        ("run", {"pads.lower.elements_y": 1000}, "GiB of memory; .*"),
        ("check", {"pads.lower.elements_y": 1000}, "GiB of memory; .*"),
    ],
)
def test_a_run_of_hours_or_of_the_machines_memory_asks_first(
    command, changes, words, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(to_toml(template("t").override(changes)))
    with mock.patch("torchsoft.cost.machine_memory", return_value=1.0):
        assert main([command, "rig.toml"]) == 2
    assert re.search(words + "or use --yes to begin", capsys.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["rig.toml"]
