"""The statics experiment at smoke size: force, height and contact of the full grasp, and how they converge."""

import json
from types import ModuleType
from typing import Any

import pytest
import torch
from test_experiments import experiment


@pytest.fixture(scope="module")
def statics() -> ModuleType:
    return experiment("statics")


@pytest.fixture(scope="module")
def result(statics: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return statics.run(statics.Config(out=tmp_path_factory.mktemp("statics"), smoke=True))


def test_the_full_grasp(statics: ModuleType, result: Any) -> None:
    grasp = statics.full_grasp(result.meshes)["120 x 4"]
    assert grasp["force_N"] == pytest.approx(70.16, abs=0.01)
    assert grasp["y_C_mm"] == pytest.approx(23.20, abs=0.005)  # the paper's, to the digits it prints
    assert grasp["penetration_um"] == pytest.approx(82.2, abs=0.1)
    assert grasp["half_width_mm"] == pytest.approx(5.31, abs=0.01)
    assert grasp["nodes_touching"] == 11


def test_the_force_converges_in_mesh_and_penalty(statics: ModuleType, result: Any) -> None:
    # two curves and the expected order already foretell the limits of the whole experiment (70.54 and 79.33 N)
    assert result.families["mesh"].limit == pytest.approx(70.54, rel=2e-3)
    assert result.families["penalty"].limit == pytest.approx(79.33, rel=5e-3)
    assert statics.successive(result.meshes)["60 x 2"]["full_grasp"] == pytest.approx(0.0141, abs=1e-4)
    assert statics.successive(result.penalties)["1"]["full_grasp"] == pytest.approx(0.0869, abs=1e-4)


def test_force_and_contact_grow_with_compression(result: Any) -> None:
    for curve in (*result.meshes.values(), *result.penalties.values()):
        for grows in (curve.force, curve.half_width, curve.penetration, -curve.y_C):
            assert bool((grows.diff() > 0).all())
        assert bool((curve.touching.diff() >= 0).all())
        assert float(curve.compression[-1]) == pytest.approx(1.5e-3, abs=1e-15)


def test_half_width_is_interpolated_between_nodes(statics: ModuleType) -> None:
    x = torch.linspace(-5, 5, 11, dtype=torch.float64)
    assert float(statics.half_width(x, 2.3 - x.abs())) == pytest.approx(2.3, rel=1e-14)


def test_files(statics: ModuleType, result: Any) -> None:
    statics.write(result)
    numbers = json.loads((result.config.out / "summary.json").read_text())
    assert numbers["mesh"]["full_grasp"]["120 x 4"] == numbers["penalty"]["full_grasp"]["1"]
    assert numbers["mesh"]["full_grasp"]["60 x 2"]["nodes_touching"] == 5
    assert len(numbers["mesh"]["curves"]["120 x 4"]["force"]) == 3
    assert numbers["made_by"]["config"]["smoke"] == "True"
    assert (result.config.out / "statics.png").read_bytes().startswith(b"\x89PNG")
    assert statics.table("mesh", result.meshes).splitlines()[2].startswith("| 60 x 2 | 69.175 |")
