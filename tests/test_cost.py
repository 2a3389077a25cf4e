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

SMOKE = Path(__file__).parents[1] / "data_gen" / "configs" / "smoke.toml"
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


@pytest.fixture(scope="module")
def smoke():
    return Config.from_toml(SMOKE)


@pytest.mark.parametrize(
    ("change", "seconds"),
    [
        ({}, (0.1, 10.0)),
        ({"trajectories": 1_000_000}, (2e4, 1e6)),
        ({"step": 1e-6}, (300.0, 3000.0)),
    ],
)
def test_what_a_dataset_costs(change, seconds, smoke):
    price = cost(smoke.model_copy(update=change), 2)
    assert seconds[0] < price.seconds < seconds[1]
    assert price.memory < 1.0
    assert (price.disk > 100.0) == ("trajectories" in change)


def test_a_run_that_takes_long_asks_first(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(
        to_toml(template("t").override(solver={"step": 1e-7}, outputs={"duration": 20.0}))
    )
    assert main(["run", "rig.toml", "--out", "out"]) == 2
    error = capsys.readouterr().err
    assert re.search(r"this takes about .* \(2e\+08 steps\)", error), error
    assert "or use --yes to begin" in error
    assert not Path("out").exists()


@pytest.mark.parametrize("command", [("check",), ("run", "--out", "out")], ids=["check", "run"])
def test_a_rig_that_needs_the_machines_memory_asks_first(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(
        to_toml(template("t").override(pads={"lower": {"elements_x": 80, "elements_y": 1000}}))
    )
    with mock.patch("torchsoft.cost.machine_memory", return_value=1.0):
        assert main([command[0], "rig.toml", *command[1:]]) == 2
    assert re.search(r"GiB of memory; .*or use --yes to begin", capsys.readouterr().err)
