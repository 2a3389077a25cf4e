"""The price of work: hours and memory need the user's word, minutes do not; estimates are of the right order."""

import tomllib
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from torchsoft import Parameters
from torchsoft.cost import Cost, Costly, agree, duration, row_memory, step_seconds
from torchsoft.datasets.config import Config
from torchsoft.datasets.cost import cost

SMOKE = tomllib.loads((Path(__file__).parent.parent / "data_gen" / "configs" / "smoke.toml").read_text())
CHEAP, LONG, LARGE = Cost(1e4, 60.0, 0.1), Cost(1e9, 2e5, 0.1), Cost(1e4, 60.0, 1e6)


def test_minutes_need_no_word() -> None:
    agree(CHEAP, False, "take less")


@pytest.mark.parametrize("price", [LONG, LARGE], ids=["hours", "memory"])
def test_hours_and_memory_need_the_users_word(price: Cost) -> None:
    agree(price, True, "take less")
    with mock.patch("sys.stdin") as keys, mock.patch("sys.stderr") as screen:
        keys.isatty.return_value = False
        with pytest.raises(Costly, match=r"^this takes about .* GiB of memory; take less, or say --yes to begin$"):
            agree(price, False, "take less")
        keys.isatty.return_value = screen.isatty.return_value = True
        keys.readline.return_value = "n\n"
        with pytest.raises(Costly):
            agree(price, False, "take less")
        keys.readline.return_value = "y\n"
        agree(price, False, "take less")


def test_times_are_said_in_their_unit() -> None:
    times = {0.5: "0.5 seconds", 80.0: "80 seconds", 600.0: "10 minutes", 2.5e5: "2.9 days", 1e9: "32 years"}
    assert {t: duration(t) for t in times} == times


def test_a_step_costs_more_on_a_finer_mesh_and_with_derivatives() -> None:
    usual = step_seconds(Parameters())
    assert 1e-4 < usual < 2e-4
    assert step_seconds(Parameters().override({"pad.elements_x": 480})) > 8 * usual
    assert step_seconds(Parameters(), differentiated=True) > 2 * usual
    assert step_seconds(Parameters().override({"pad.fidelity": "inertial"})) > 5 * usual
    assert row_memory(Parameters()) * 2**30 > 8 * 4 * 242


@pytest.mark.parametrize(
    ("change", "seconds"),
    [({}, (0.1, 10.0)), ({"trajectories": 1_000_000}, (2e4, 1e6)), ({"step": 1e-6}, (300.0, 3000.0))],
)
def test_what_a_dataset_costs(change: dict[str, Any], seconds: tuple[float, float]) -> None:
    price = cost(Config.model_validate(SMOKE | change), 2)
    assert seconds[0] < price.seconds < seconds[1]
    assert price.memory < 1.0
    assert (price.disk > 100.0) == ("trajectories" in change)
